"""Shaders put together from the files in shaders/, and how they are told of cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import moderngl
import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.render.lens_tessellation import nearest
from humansim_ros.render.uniforms import columns, set_uniform

#: Metres along the axis beyond which nothing is drawn.
_FAR = 200.0
#: OpenGL's name for cutting off what the lens does not see.
_CLIP_DISTANCE = 0x3000
_SHADERS = Path(__file__).parent / "shaders"


def shader(files: Sequence[str], switches: Sequence[str] = ()) -> str:
    """Files put together as one shader."""
    head = "#version 330\n"
    texts = [(_SHADERS / file).read_text().removeprefix(head) for file in files]
    return "".join([head, *(f"#define {name}\n" for name in switches), *texts])


def unit_square(cells: int) -> bytes:
    """Corners of the triangles of a square of so many cells a side."""
    low = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 1, 2)
    corners = low + np.array([(0, 0), (1, 0), (0, 1), (0, 1), (1, 0), (1, 1)])
    return bytes((corners / cells).astype("f4").tobytes())


def link(ctx: moderngl.Context, vertex: str, fragment: str, switches: Sequence[str] = ()) -> moderngl.Program:
    """A program of two files. ``switches``: names that are defined in both shaders."""
    lit = fragment == "lit.frag"
    before = [*(["develop.glsl"] if lit else []), *(["sunshine.glsl"] if "STILL" in switches else [])]
    before += ["finish.glsl"] if "FINISH" in switches else []
    answers = ["people.glsl"] if "PEOPLE" in switches else []
    return ctx.program(
        vertex_shader=shader(["lens.glsl", *answers, vertex], switches),
        fragment_shader=shader([*before, fragment], switches),
    )


def use_camera(ctx: moderngl.Context, program: moderngl.Program, camera: Camera) -> None:
    """Let what a program draws fall into a camera."""
    set_uniform(program, "optical_z", (*camera.R[2], camera.t[2]))
    set_uniform(program, "eye", tuple(camera.center.tolist()))
    near = nearest(camera)
    clip = camera.opengl_clip(near, _FAR)
    if not camera.distorted:
        set_uniform(program, "lens", 0)
        set_uniform(program, "clip", columns(clip @ camera.optical_from_world))
        ctx.disable_direct(_CLIP_DISTANCE)
        return
    lens = camera.lens
    set_uniform(program, "lens", 2 if lens.model == "equidistant" else 1)
    set_uniform(program, "clip", columns(clip))
    set_uniform(program, "optical", columns(camera.optical_from_world))
    set_uniform(program, "k", np.array((*lens.coefficients, *[0.0] * 8)[:8], dtype="f4").tobytes())
    set_uniform(program, "reach", lens.valid_radius)
    set_uniform(program, "nearest", near)
    ctx.enable_direct(_CLIP_DISTANCE)
