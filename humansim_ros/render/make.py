"""Renderers by their name in scene files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:  # the schema of scene files imports this module without OpenCV and OpenGL
    from humansim_ros.mesh.mesh import Mesh
    from humansim_ros.render.gl import GLRenderer
    from humansim_ros.render.lighting import Lighting
    from humansim_ros.render.pyrender import PyrenderRenderer
    from humansim_ros.render.renderer import Body

#: Name of a renderer in scene files.
RendererName = Literal["moderngl", "pyrender"]


def make_renderer(
    name: RendererName = "moderngl",
    static_meshes: Sequence[Mesh] = (),
    lighting: Lighting | None = None,
    device: int | None = None,
    static_bodies: Sequence[Body] = (),
) -> GLRenderer | PyrenderRenderer:
    """Create a renderer.

    Args:
        name: Name of the renderer.
        static_meshes: Meshes of the static scene, in ``map``, metres.
        lighting: Light; the default light if None.
        device: Number of the GPU in the order of EGL; the first one that works if None.
        static_bodies: Bodies that never move. They are rendered with the static scene, once per camera.

    Raises:
        RenderError: A library or the device is missing. The message says what to install.
    """
    if name == "pyrender":
        from humansim_ros.render.pyrender import PyrenderRenderer

        return PyrenderRenderer(static_meshes, lighting, device, static_bodies)
    from humansim_ros.render.gl import GLRenderer

    return GLRenderer(static_meshes, lighting, device, static_bodies)
