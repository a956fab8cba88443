"""Pictures and per-pixel ground truth of meshes as cameras see them."""

from humansim_ros.render.gl import GLRenderer, Lighting
from humansim_ros.render.renderer import CHANNELS, Body, Renderer, View

__all__ = ["CHANNELS", "Body", "GLRenderer", "Lighting", "Renderer", "View"]
