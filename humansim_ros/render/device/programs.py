"""Shader programs, made from the files in shaders/, with uniforms for cameras and light."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.render.device.lens_tessellation import near_plane
from humansim_ros.render.interface.lighting import Lighting
from humansim_ros.types import Array

#: Far plane, metres.
_FAR = 200.0
#: GL_CLIP_DISTANCE0. It clips points beyond the field of view of the lens.
_CLIP_DISTANCE = 0x3000
#: Texture units of the maps of a material.
MAP_UNITS = {"metal_rough": 9, "normal_map": 10, "emissive_map": 11, "alpha_map": 12}
_SHADERS = Path(__file__).parent / "shaders"


def shader(files: Sequence[str], switches: Sequence[str] = ()) -> str:
    """Join files into the text of one shader. ``switches``: names that are defined before the files."""
    head = "#version 330\n"
    texts = [(_SHADERS / file).read_text().removeprefix(head) for file in files]
    return "".join([head, *(f"#define {name}\n" for name in switches), *texts])


def unit_square(cells: int) -> bytes:
    """Corners of the triangles of a unit square that is divided into cells."""
    low = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 1, 2)
    corners = low + np.array([(0, 0), (1, 0), (0, 1), (0, 1), (1, 0), (1, 1)])
    return bytes((corners / cells).astype("f4").tobytes())


def link(ctx: moderngl.Context, vertex: str, fragment: str, switches: Sequence[str] = ()) -> moderngl.Program:
    """Create a program of a vertex and a fragment shader, with the files that they include.

    Args:
        ctx: OpenGL context.
        vertex: File of the vertex shader.
        fragment: File of the fragment shader.
        switches: Names that are defined in both shaders.
    """
    includes = ["tone_map.glsl"] if fragment == "lit.frag" else []
    includes += ["soft_shadow.glsl"] if "STATIC_SHADOWS" in switches else []
    includes += ["pbr.glsl"] if "PBR" in switches else []
    skin = ["skin_and_cloth.glsl"] if "SKIN_AND_CLOTH" in switches else []
    return ctx.program(
        vertex_shader=shader(["lens.glsl", *skin, vertex], switches),
        fragment_shader=shader([*includes, fragment], switches),
    )


def lit_program(
    ctx: moderngl.Context, lighting: Lighting, switches: Sequence[str] = (), sun: bool = True
) -> moderngl.Program:
    """Create a program that draws lit surfaces.

    Args:
        ctx: OpenGL context.
        lighting: Light.
        switches: More switches, in addition to those that ``lighting`` implies.
        sun: Whether the sun lights the surfaces.
    """
    implied = (("SHADELESS", lighting.mode == "shadeless"), ("FILMIC", lighting.tone_mapping == "filmic"))
    program = link(ctx, "lit.vert", "lit.frag", (*(name for name, used in implied if used), *switches))
    set_uniform(program, "sun", tuple(lighting.direction))
    set_uniform(program, "sun_color", lighting.brightness(lighting.sun_color) if sun else (0.0, 0.0, 0.0))
    set_uniform(program, "sky_color", lighting.brightness(lighting.sky_color))
    set_uniform(program, "ground_color", lighting.brightness(lighting.ground_color))
    set_uniform(program, "brightness", lighting.brightness((1.0, 1.0, 1.0))[0])
    set_uniform(program, "min_alpha", np.radians(lighting.sun_size_deg) / 4)
    # set for meshes without maps too, since samplers of different kinds cannot share a unit
    for name, unit in MAP_UNITS.items():
        set_uniform(program, name, unit)
    return program


def depth_program(ctx: moderngl.Context, switches: Sequence[str] = ()) -> moderngl.Program:
    """Create a program that draws depths only, for shadow maps."""
    return ctx.program(
        vertex_shader=shader(["shadow_map.vert"], switches),
        fragment_shader=shader(["shadow_map.frag"], switches),
    )


def use_camera(
    ctx: moderngl.Context,
    program: moderngl.Program,
    camera: Camera,
    offset: tuple[float, float] = (0.0, 0.0),
) -> None:
    """Set the uniforms of a program for a camera.

    Args:
        ctx: OpenGL context. Clipping at the edge of the lens is switched on or off in it.
        program: Program with ``lens.glsl``.
        camera: The camera.
        offset: Pixels (x, y) by which the image is shifted.
    """
    set_uniform(program, "optical_z", (*camera.R[2], camera.t[2]))
    set_uniform(program, "eye", tuple(camera.center.tolist()))
    near = near_plane(camera)
    clip = camera.opengl_clip(near, _FAR)
    clip[:2] += 2 * np.divide(offset, camera.size)[:, None] * clip[3]
    if not camera.distorted:
        set_uniform(program, "lens", 0)
        set_uniform(program, "clip", columns(clip @ camera.optical_from_world))
        ctx.disable_direct(_CLIP_DISTANCE)
        return
    lens = camera.lens
    set_uniform(program, "lens", 2 if lens.model == "equidistant" else 1)
    set_uniform(program, "clip", columns(clip))
    set_uniform(program, "optical_from_world", columns(camera.optical_from_world))
    set_uniform(program, "k", np.array((*lens.coefficients, *[0.0] * 8)[:8], dtype="f4").tobytes())
    set_uniform(program, "valid_radius", lens.valid_radius)
    set_uniform(program, "near", near)
    ctx.enable_direct(_CLIP_DISTANCE)


def set_uniform(program: moderngl.Program, name: str, value: Any) -> None:
    """Set a uniform. A uniform that the compiler has removed as unused is ignored."""
    uniform = program.get(name, None)  # `in` would iterate over all uniforms
    if uniform is None:
        return
    if isinstance(value, bytes):
        uniform.write(value)  # type: ignore[union-attr]
    else:
        uniform.value = value  # type: ignore[union-attr]


def columns(matrix: Array) -> bytes:
    """Bytes of a matrix column by column, as shaders expect."""
    return bytes(matrix.T.astype("f4").tobytes())
