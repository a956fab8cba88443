"""Render views: images and per-pixel ground truth of meshes as cameras see them."""

from typing import TYPE_CHECKING

from humansim_ros import lazy_exports

if TYPE_CHECKING:
    from humansim_ros.render.channels import ALL_CHANNELS as ALL_CHANNELS
    from humansim_ros.render.channels import CHANNELS as CHANNELS
    from humansim_ros.render.channels import View as View
    from humansim_ros.render.gl import GLRenderer as GLRenderer
    from humansim_ros.render.gl import make_renderer as make_renderer
    from humansim_ros.render.lighting import Lighting as Lighting
    from humansim_ros.render.lighting import RendererName as RendererName
    from humansim_ros.render.pixel_geometry import ImageBackdrop as ImageBackdrop
    from humansim_ros.render.pixel_geometry import Panorama as Panorama
    from humansim_ros.render.pyrender import PyrenderRenderer as PyrenderRenderer
    from humansim_ros.render.renderer import AdjacentFrame as AdjacentFrame
    from humansim_ros.render.renderer import Backdrop as Backdrop
    from humansim_ros.render.renderer import Body as Body
    from humansim_ros.render.renderer import Renderer as Renderer

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "ALL_CHANNELS": "channels",
        "AdjacentFrame": "renderer",
        "Backdrop": "renderer",
        "Body": "renderer",
        "CHANNELS": "channels",
        "GLRenderer": "gl",
        "ImageBackdrop": "pixel_geometry",
        "Lighting": "lighting",
        "Panorama": "pixel_geometry",
        "PyrenderRenderer": "pyrender",
        "Renderer": "renderer",
        "RendererName": "lighting",
        "View": "channels",
        "make_renderer": "gl",
    },
)
