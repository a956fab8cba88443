"""Which renderer draws, by its name in scene files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.gl import GLRenderer
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.pyrender import PyrenderRenderer
from humansim_ros.render.renderer import Body

RendererName = Literal["moderngl", "pyrender"]


def make_renderer(
    name: RendererName = "moderngl",
    static: Sequence[Mesh] = (),
    lighting: Lighting | None = None,
    device: int | None = None,
    standing: Sequence[Body] = (),
) -> GLRenderer | PyrenderRenderer:
    """The renderer of a name. ``device``: number of the GPU as EGL counts them; the first that works if None.
    ``standing``: of the bodies that it will be given those that never move and are part of the still scene.

    Raises RenderError, saying what to install, where something is missing, and where there is no such device.
    """
    kinds: dict[str, type[GLRenderer] | type[PyrenderRenderer]] = {
        "moderngl": GLRenderer,
        "pyrender": PyrenderRenderer,
    }
    return kinds[name](static, lighting, device, standing)
