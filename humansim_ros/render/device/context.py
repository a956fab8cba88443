"""Create OpenGL contexts through EGL, and shader programs from the files in shaders/."""

from __future__ import annotations

import ctypes
import ctypes.util
import itertools
import os
import threading
import weakref
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any

import moderngl
import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import RenderError
from humansim_ros.render.device.lens_tessellation import near_plane
from humansim_ros.render.interface.lighting import Lighting
from humansim_ros.types import Array

#: Largest number of OpenGL devices that are tried.
_MAX_DEVICES = 16
_FORKED = (
    "OpenGL has been used in the process that this one was forked from, and does not work here. Start worker "
    'processes with "spawn" (multiprocessing.get_context("spawn"), DataLoader(..., '
    'multiprocessing_context="spawn")), and make a Simulation in each. Without a GPU, LP_NUM_THREADS=0 in '
    "the environment before the first Simulation helps, too"
)


class OpenGLContext:
    """OpenGL 3.3 context through EGL, for the thread that makes it.

    :meth:`close` frees the context. Without a call, it is freed when the last reference to it is gone, in any
    thread. An object on the device is freed after its last reference is gone, at the next :meth:`current`.
    It must never be released by hand, since moderngl would then fail to free it again.

    ``device``: number of the device in the order of EGL, GPUs first. If None, the first one that works.

    Attributes:
        gl: The context of moderngl, to create objects with.
        device: Name of the device, such as ``llvmpipe (LLVM 15.0.6, 256 bits)``.
        on_processor: Whether OpenGL runs on the CPU (Mesa's llvmpipe), so that images are in main memory.

    Raises:
        RenderError: There is no such device, or OpenGL is missing (the message names the packages to
            install), or the process was forked from one that has used OpenGL.
    """

    def __init__(self, device: int | None = None) -> None:
        _process.check()
        self.gl = _create(device)
        self.gl.gc_mode = "context_gc"
        self._pid, self._thread = os.getpid(), threading.get_ident()
        self._free = weakref.finalize(self, _free, self.gl, self._pid)
        self._free.atexit = False  # the end of the process frees everything
        # A new context is current. EGL frees a context in any thread, if the context is current in no thread.
        with self.gl:
            self.device = str(self.gl.info["GL_RENDERER"])
        self.on_processor = self.device.startswith("llvmpipe")
        _process.add(self)

    def close(self) -> None:
        """Free the context and all its objects. Raises RenderError in another thread."""
        if self._free.alive:
            self._check_thread()
            self._free()

    def check(self) -> None:
        """Raise RenderError if the context has been closed, or was made in another thread or process."""
        if not self._free.alive:
            raise RenderError("this renderer has been closed")
        if os.getpid() != self._pid:
            _process.check()
        self._check_thread()

    def _check_thread(self) -> None:
        if threading.get_ident() != self._thread:
            text = "a renderer and its Simulation belong to the thread that made them: make one per thread"
            raise RenderError(text)

    @contextmanager
    def current(self) -> Iterator[None]:
        """Make the context current for the duration of ``with``.

        Raises:
            RenderError: :meth:`check` fails, the context has been lost, or OpenGL failed.
        """
        self.check()
        with self.gl:
            try:
                # without a context, OpenGL fails silently and reads arbitrary memory, so an allocation is
                # tested
                self.gl.buffer(reserve=4)
            except moderngl.Error:
                raise RenderError(
                    "the OpenGL context was lost, for example because the GPU was reset or removed: create a "
                    "new renderer, or restart this node"
                ) from None
            try:
                self.gl.gc()
                yield
            except moderngl.Error as reason:
                text = f"OpenGL failed, possibly out of memory ({str(reason).splitlines()[0]})"
                raise RenderError(text) from None


class _Process:
    """Remembers which process used OpenGL first, to refuse OpenGL in processes forked from it. There, a call
    would wait for ever for threads of the driver, since a fork does not copy threads. Only Mesa's renderer
    for the CPU works after a fork, if LP_NUM_THREADS was 0 at its start, so that it has no threads."""

    def __init__(self) -> None:
        self._pid: int | None = None
        self._without_threads = False

    def check(self) -> None:
        """Raise RenderError in a forked process in which OpenGL does not work."""
        if self._pid is None:
            self._pid, self._without_threads = os.getpid(), os.environ.get("LP_NUM_THREADS") == "0"
        elif os.getpid() != self._pid and not self._without_threads:
            raise RenderError(_FORKED)

    def add(self, context: OpenGLContext) -> None:
        """Remember whether a new context uses a GPU. Drivers of GPUs have threads, so that OpenGL is then
        refused in forked processes."""
        self._without_threads &= context.on_processor


_process = _Process()


#: Finds a system library by name. Cached, since each search starts an external program.
_find_library = cache(ctypes.util.find_library)


def _create(device: int | None) -> moderngl.Context:
    # glcontext reads memory before its list, and some drivers accept the number
    if device is not None and device < 0:
        raise RenderError(f"there is no OpenGL device {device}: the first is 0")
    settings: dict[str, Any] = {"backend": "egl"}
    settings |= {"libgl": _find_library("GL"), "libegl": _find_library("EGL")}
    reasons: list[str] = []
    for number in itertools.count() if device is None else [device]:
        try:
            settings["device_index"] = number
            return moderngl.create_context(require=330, standalone=True, **settings)
        except Exception as reason:  # moderngl and glcontext raise bare Exceptions
            reasons.append(str(reason).splitlines()[0])
            if "device index" in reasons[-1] or number >= _MAX_DEVICES:
                break
    if device is not None and "device index" in reasons[0]:
        raise RenderError(f"there is no OpenGL device {device}: {reasons[0]}")
    raise RenderError(
        f"no OpenGL through EGL ({reasons[0]}). "
        "On Debian or Ubuntu: sudo apt-get install -y libegl1 libgl1-mesa-dri"
    )


def _free(gl: moderngl.Context, pid: int) -> None:
    """Free a context. In a forked process, do nothing, since the driver could wait there for ever for its
    threads."""
    if os.getpid() == pid:
        gl.release()


#: glibc's mallopt parameters: trim threshold, top pad, mmap threshold.
_MALLOPT = ((-3, 32 << 20), (-1, 512 << 20), (-2, 64 << 20))


def keep_image_blocks() -> None:
    """Let malloc reuse the memory of large images, so that the system does not map new pages for each image.
    Without glibc the function has no effect."""
    with suppress(OSError, AttributeError):
        libc = ctypes.CDLL("libc.so.6")
        for parameter, value in _MALLOPT:
            libc.mallopt(parameter, value)


#: Far plane, metres.
_FAR = 200.0
#: GL_CLIP_DISTANCE0. It clips points beyond the field of view of the lens.
_CLIP_DISTANCE = 0x3000
#: Texture units of the maps of a material.
MAP_UNITS = {"metal_rough": 9, "normal_map": 10, "emissive_map": 11, "alpha_map": 12}
_SHADERS = Path(__file__).parent / "shaders"
_LENS, _SOFT_SHADOW = ("lens.glsl", ""), ("soft_shadow.glsl", "")
#: Files that a shader includes, each with the switch that it needs (empty: always).
_INCLUDES = {
    "lit.vert": (_LENS, ("skin_and_cloth.glsl", "SKIN_AND_CLOTH")),
    "lit.frag": (("tone_map.glsl", ""), ("soft_shadow.glsl", "STATIC_SHADOWS"), ("pbr.glsl", "PBR")),
    "triangle_ids.vert": (_LENS,),
    "contact_shadow.vert": (_LENS,),
    "apply_shadows.frag": (_SOFT_SHADOW,),
    "shadow_catcher.frag": (_SOFT_SHADOW,),
}


def _shader(file: str, switches: Sequence[str]) -> str:
    """Return the text of a shader with its included files. ``switches``: names that are defined before
    (#define)."""
    files = (name for name, switch in _INCLUDES.get(file, ()) if not switch or switch in switches)
    head = "#version 330\n"
    texts = [(_SHADERS / each).read_text().removeprefix(head) for each in (*files, file)]
    return "".join([head, *(f"#define {name}\n" for name in switches), *texts])


def unit_square(cells: int) -> bytes:
    """Return the corners of triangles that fill the unit square. ``cells``: number along each side."""
    low = np.stack(np.meshgrid(np.arange(cells), np.arange(cells)), axis=-1).reshape(-1, 1, 2)
    corners = low + np.array([(0, 0), (1, 0), (0, 1), (0, 1), (1, 0), (1, 1)])
    return bytes((corners / cells).astype("f4").tobytes())


def link(ctx: moderngl.Context, vertex: str, fragment: str, switches: Sequence[str] = ()) -> moderngl.Program:
    """Create a program of a vertex and a fragment shader, with the files that they include.

    Args:
        ctx: OpenGL context.
        vertex, fragment: Files of the shaders.
        switches: Names that are defined (#define) in both shaders.
    """
    return ctx.program(vertex_shader=_shader(vertex, switches), fragment_shader=_shader(fragment, switches))


def lit_program(
    ctx: moderngl.Context, lighting: Lighting, switches: Sequence[str] = (), sun: bool = True
) -> moderngl.Program:
    """Create a program that draws surfaces with light.

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
    """Create a program that draws only depths, for shadow maps."""
    return link(ctx, "shadow_map.vert", "shadow_map.frag", switches)


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


def rendering_device() -> str:
    """Name of the device that renders in this process. Raises RenderError if OpenGL is missing."""
    context = OpenGLContext()
    context.close()
    return context.device
