"""Pictures and per-pixel ground truth of meshes as cameras see them."""

from humansim_ros.render.gl import GLRenderer
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.make import RendererName, make_renderer
from humansim_ros.render.pyrender import PyrenderRenderer
from humansim_ros.render.renderer import ALL_CHANNELS, CHANNELS, AdjacentFrame, Body, Renderer, View

__all__ = [
    "ALL_CHANNELS",
    "CHANNELS",
    "AdjacentFrame",
    "Body",
    "GLRenderer",
    "Lighting",
    "PyrenderRenderer",
    "Renderer",
    "RendererName",
    "View",
    "make_renderer",
]
