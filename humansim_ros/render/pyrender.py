"""The second renderer: pyrender 0.1.45 draws what ours draws, to check it and to compare with.

Two passes: colour, with the light of our default renderer worked out at the vertices, twice as large and
averaged, so that sixteen samples make a pixel; and pyrender's segmentation, one sample at the pixel's centre,
for labels and depth, once more with each body alone for amodal masks. pyrender cannot move vertices: a body
in a new pose is a new mesh. It draws everything anew for each camera.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.errors import HumansimWarning, RenderError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.channels import CHANNEL_TABLE, CHANNELS, View
from humansim_ros.render.contact_shadow import ContactShadow
from humansim_ros.render.context import create_context, current
from humansim_ros.render.lens_tessellation import NEAR
from humansim_ros.render.lighting import Lighting
from humansim_ros.render.posed_mesh import PosedMesh, Topology
from humansim_ros.render.renderer import AdjacentFrame, Backdrop, Body, check_request
from humansim_ros.render.static_scene import FLOOR_SLACK, ExpandedMesh
from humansim_ros.types import Array, Float32Array

_FAR = 200.0
_TRIANGLES = 4
#: Times as large as the picture that colour is drawn, of pictures of at most so many pixels a side. With the
#: four samples of a pixel alone the middle of small things is up to 0.08 pixels off, so 0.03.
_FINER, _FINER_UP_TO = 2, 2048


class PyrenderRenderer:
    """Renders bodies in a static scene of meshes (world coordinates) with pyrender.

    Cameras may have skew but no distortion. It has an OpenGL context of its own, which others in the process
    do not notice. Use it from one thread.
    ``device``: see :func:`humansim_ros.render.context.create_context`. ``standing``: those of the bodies that
    never move; they leave no shadow. Raises RenderError where OpenGL or pyrender is missing.
    """

    channels = (*CHANNELS, "amodal")

    def __init__(
        self,
        static: Sequence[Mesh] = (),
        lighting: Lighting | None = None,
        device: int | None = None,
        standing: Sequence[Body] = (),
    ) -> None:
        self._lighting = lighting or Lighting()
        if self._lighting.shadow == "soft" or self._lighting.tone_mapping != "none":
            warnings.warn(
                "pyrender draws no soft shadows and maps no tones: its pictures will be without",
                HumansimWarning,
                stacklevel=2,
            )
        self._library, self._failure = import_pyrender()
        self._ctx = create_context(device)
        # left to themselves they would delete what is in another context
        quiet = type("QuietRenderer", (self._library.Renderer,), {"__del__": lambda self: None})
        self._passes = tuple(quiet(1, 1) for _ in range(2))
        self._closed = False
        self._shapes: dict[int, _Shape] = {}
        self._figures: dict[tuple[int, int], _Figure] = {}
        whole = [
            Body(m, m.vertices.astype(np.float32), np.zeros(len(m.triangles), np.uint8), 0, "object")
            for m in static
        ]
        self._static = [_Figure(self._library, _Shape(self._library, body), body) for body in whole]
        self._standing = tuple(standing)
        still = [(mesh.vertices, mesh.triangles) for mesh in static]
        still += [(body.vertices.astype(float), body.mesh.triangles) for body in standing]
        self._has_floor = any((np.abs(v[t][..., 2]) < FLOOR_SLACK).all(axis=1).any() for v, t in still)

    @property
    def device(self) -> str:
        """What draws, such as ``pyrender on llvmpipe (LLVM 15.0.6, 256 bits)``."""
        with self._ctx:
            return f"pyrender on {self._ctx.info['GL_RENDERER']}"

    def close(self) -> None:
        """Free the OpenGL context and what is in it."""
        if not self._closed:
            self._closed = True
            with self._ctx:
                for renderer in self._passes:
                    renderer.delete()
            self._ctx.release()

    def render(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        channels: Collection[str] = CHANNELS,
        moving_camera: bool = False,
        next_frame: AdjacentFrame | None = None,
        previous_frame: AdjacentFrame | None = None,
        backdrop: Backdrop | None = None,
    ) -> View:
        """See :class:`humansim_ros.render.Renderer`. RenderError for a camera that distorts, and for channels
        that only the default renderer has.
        """
        check_request(bodies, channels)
        if others := sorted(set(channels) - set(self.channels)):
            raise RenderError(f"pyrender does not draw {', '.join(others)}; the renderer moderngl does")
        if camera.distorted:
            raise RenderError(
                "pyrender knows no lens distortion: take the renderer moderngl, or an ideal camera"
            )
        figures = [*self._static, *(self._figure(body) for body in bodies)]
        view: dict[str, Any] = {}
        with current(self._ctx):
            if "rgb" in channels:
                view["rgb"] = self._colour(figures, camera, backdrop)
            if truth := set(channels) - {"rgb", "amodal"}:
                view |= self._truth(figures, camera, truth)
            if "amodal" in channels:
                moving = [figure for figure in figures[len(self._static) :] if figure.body.instance]
                view["amodal"] = {f.body.instance: self._numbers([f], camera)[0] > 0 for f in moving}
        return View(**view)

    def _figure(self, body: Body) -> _Figure:
        """The body as it stands, kept while it is the same one."""
        key = id(body.mesh), body.instance
        if key not in self._figures or self._figures[key].body is not body:
            shape = self._shapes.get(id(body.mesh))
            if shape is None or shape.parts is not body.parts:
                shape = self._shapes[id(body.mesh)] = _Shape(self._library, body)
            self._figures[key] = _Figure(self._library, shape, body)
        return self._figures[key]

    def _colour(
        self, figures: Sequence[_Figure], camera: Camera, backdrop: Backdrop | None
    ) -> NDArray[np.uint8]:
        light = self._lighting
        nodes = [figure.coloured(light, figure.sides(camera)) for figure in figures]
        shadows = []
        if light.shadow == "contact" and self._has_floor:
            still = {id(body) for body in self._standing}
            moving = [f for f in figures[len(self._static) :] if id(f.body) not in still]
            shadows = [figure.shadow(0.01 + 1e-4 * number) for number, figure in enumerate(moving)]
        background = np.append(np.array(light.background) / 255, 1.0)
        if backdrop is None:
            return self._averaged([*nodes, *shadows], camera, ("FLAT",), background)
        rgb = self._averaged([*nodes, *shadows], camera, ("FLAT",), np.zeros(4))
        alpha = self._averaged(nodes, camera, ("FLAT", "RGBA"), np.zeros(4))[..., 3:]
        return np.asarray(np.rint(rgb + (1 - alpha / 255) * backdrop.picture(camera)), dtype=np.uint8)

    def _averaged(
        self, nodes: Sequence[_Node], camera: Camera, how: Sequence[str], background: Array
    ) -> NDArray[np.uint8]:
        """A picture drawn larger than the camera's."""
        finer = _FINER if max(camera.size) <= _FINER_UP_TO else 1
        picture = self._draw(0, nodes, camera, how, background, finer=finer)[0]
        return np.asarray(cv2.resize(picture, camera.size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def _truth(self, figures: Sequence[_Figure], camera: Camera, channels: set[str]) -> dict[str, Any]:
        number, depth, table = self._numbers(figures, camera, "part" in channels)
        truth: dict[str, Any] = {}
        if "depth" in channels:
            truth["depth"] = np.where(number > 0, depth, np.inf).astype(np.float32)
        for column, name in enumerate(("instance", "part")):
            if name in channels:
                truth[name] = table[:, column].astype(CHANNEL_TABLE[name].dtype)[number]
        return truth

    def _numbers(
        self, figures: Sequence[_Figure], camera: Camera, by_part: bool = False
    ) -> tuple[NDArray[np.uint32], NDArray[np.float32], NDArray[Any]]:
        """Which surface (0: none) each pixel's centre shows (H, W), its depth, and the instance and part of
        each surface.
        """
        numbered = [(f.body.instance, *one) for f in figures for one in f.labelled(f.sides(camera), by_part)]
        # of the static scene and of things without a label only what they hide counts
        table = np.array([(0, 0), *((instance, part * (instance > 0)) for instance, part, _ in numbered)])
        colours = {node: _colour_of(number) for number, (*_, node) in enumerate(numbered, 1)}
        colour, depth = self._draw(1, list(colours), camera, ("SEG",), None, colours)
        return colour.astype(np.uint32) @ np.array([1, 256, 65536], np.uint32), depth, table

    def _draw(
        self,
        which: int,
        nodes: Sequence[_Node],
        camera: Camera,
        how: Sequence[str],
        background: Array | None = None,
        colours: dict[_Node, Array] | None = None,
        finer: int = 1,
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        renderer, flags = self._passes[which], self._library.RenderFlags
        renderer.viewport_width, renderer.viewport_height = (finer * side for side in camera.size)
        scene = _Scene(nodes, _Eye(camera), camera.world_from_optical, background)
        try:
            flag = sum((getattr(flags, name) for name in how), flags.OFFSCREEN)
            picture, depth = renderer.render(scene, flag, colours)
        except self._failure as reason:
            raise RenderError(f"OpenGL failed in pyrender ({type(reason).__name__})") from None
        return picture, depth


class _Shape:
    """What never changes about a body: its triangles, whole and by part, its looks.

    Sides: 1 draws the outside alone, 2 the inside as well (pyrender draws only what is counter-clockwise).
    """

    def __init__(self, library: Any, body: Body) -> None:
        self.parts = body.parts
        self.topology = Topology(body.mesh)
        self.expanded = ExpandedMesh(body.mesh)
        triangles = body.mesh.triangles
        self.by_part = [(int(n), *_compact(triangles[body.parts == n])) for n in np.unique(body.parts)]
        self.whole = _compact(triangles)
        texture = body.mesh.texture
        if texture is not None:
            # (rows of three bytes a pixel would have to be padded)
            texture = library.Texture(source=texture, source_channels="RGBA")
        self.material = library.MetallicRoughnessMaterial(baseColorTexture=texture)


class _Figure:
    """A body as it stands, as meshes of pyrender that are made when they are asked for."""

    def __init__(self, library: Any, shape: _Shape, body: Body) -> None:
        self.body, self._shape, self._library = body, shape, library
        self._posed = PosedMesh(shape.topology, body.vertices)
        self._low, self._high = body.vertices.min(0) - 2 * NEAR, body.vertices.max(0) + 2 * NEAR
        self._made: dict[Any, Any] = {}

    def sides(self, camera: Camera) -> int:
        """How many sides of the surface can show: the inside of a closed one only if the camera is there."""
        inside = ((camera.center > self._low) & (camera.center < self._high)).all()
        return 2 if inside or not self.body.mesh.closed else 1

    def coloured(self, lighting: Lighting, sides: int) -> _Node:
        """The whole surface, lit."""
        if ("rgb", sides) not in self._made:
            expanded = self._shape.expanded
            normals = self._posed.normals.take(expanded.source, axis=0)
            uv, plain = expanded.looks[:, :2], expanded.looks[:, 2:]
            arrays = {
                "positions": self.body.vertices.take(expanded.source, axis=0),
                "texcoord_0": uv,
                "color_0": plain * _light(lighting, normals),
            }
            if sides == 2:
                arrays = {name: np.concatenate([array, array]) for name, array in arrays.items()}
                arrays["color_0"][len(plain) :] = plain * _light(lighting, -normals)
            corners = _sided(expanded.corners, sides, len(plain))
            self._made["rgb", sides] = self._node(corners, self._shape.material, arrays)
        node: _Node = self._made["rgb", sides]
        return node

    def labelled(self, sides: int, by_part: bool) -> Iterator[tuple[int, _Node]]:
        """Part labels and their surfaces, or 1 and the whole one."""
        shape = self._shape
        for part, source, corners in shape.by_part if by_part else [(1, *shape.whole)]:
            key = (part, sides, by_part)
            if key not in self._made:
                positions = self.body.vertices.take(source, axis=0)
                self._made[key] = self._node(_sided(corners, sides, 0), None, {"positions": positions})
            yield part, self._made[key]

    def shadow(self, height: float) -> _Node:
        """What it leaves on the floor."""
        key = "shadow", height
        if key not in self._made:
            human = self.body.kind == "human"
            shadow: ContactShadow = self._posed.shadow if human else self._posed.shadow_of_thing
            corners = shadow.corners + np.array([0, 0, height], np.float32)
            darkness = np.dstack([np.zeros((*shadow.darkness.shape, 3), np.uint8), shadow.darkness[::-1]])
            texture = self._library.Texture(source=darkness, source_channels="RGBA")
            material = self._library.MetallicRoughnessMaterial(
                baseColorTexture=texture, alphaMode="BLEND", doubleSided=True
            )
            uv = np.array([(0, 0), (1, 0), (0, 1), (1, 1)], np.float32)
            arrays = {"positions": corners, "texcoord_0": uv}
            self._made[key] = self._node(np.array([(0, 1, 2), (2, 1, 3)]), material, arrays)
        node: _Node = self._made[key]
        return node

    def _node(self, corners: NDArray[Any], material: Any, arrays: dict[str, NDArray[Any]]) -> _Node:
        primitive = self._library.Primitive(indices=corners, material=material, mode=_TRIANGLES, **arrays)
        return _Node(self._library.Mesh([primitive]))


@dataclass(frozen=True, eq=False)
class _Node:
    mesh: Any


class _Eye:
    """A camera as pyrender asks one, with our projection."""

    znear, zfar = NEAR, _FAR

    def __init__(self, camera: Camera) -> None:
        self.camera = self
        # pyrender's window is the right way up, and turned over when it is read
        self._projection = np.diag([1.0, -1.0, 1.0, 1.0]) @ camera.opengl_clip(NEAR, _FAR)

    def get_projection_matrix(self, width: int, height: int) -> Array:
        return self._projection


class _Scene:
    """What pyrender's renderer asks of a scene. Its own has sets, which do not always draw in one order."""

    lights = light_nodes = frozenset[Any]()

    def __init__(self, nodes: Sequence[_Node], eye: _Eye, pose: Array, background: Array | None) -> None:
        self.mesh_nodes, self.main_camera_node, self.bg_color = nodes, eye, background
        self.meshes = {node.mesh for node in nodes}
        self._pose = pose

    def get_pose(self, node: object) -> Array:
        return self._pose if node is self.main_camera_node else np.eye(4)


def import_pyrender() -> tuple[Any, type[Exception]]:
    """Import pyrender without its viewer, on EGL.

    Returns:
        The module ``pyrender``, and the exception class of OpenGL errors.

    Raises:
        RenderError: pyrender or a library that it needs is missing, or PyOpenGL does not use EGL.
    """
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    # pyrender imports its viewer, and the viewer imports pyglet, which fails without the X11 libraries of a
    # desktop. Rendering needs no window: an empty module takes the place of the viewer during the import.
    viewer = ModuleType("pyrender.viewer")
    vars(viewer)["Viewer"] = None
    sys.modules.setdefault(viewer.__name__, viewer)
    try:
        import OpenGL.error
        import OpenGL.platform
        import pyrender
    except Exception as reason:  # not only ImportError: each library reports a missing one in its own way
        raise RenderError(
            f"pyrender cannot be imported ({str(reason).partition(chr(10))[0] or type(reason).__name__}). "
            "Install it: pip install pyrender==0.1.45, and on Debian or Ubuntu: "
            "sudo apt-get install -y libegl1 libgl1"
        ) from None
    finally:
        if sys.modules.get(viewer.__name__) is viewer:
            del sys.modules[viewer.__name__]
    if type(OpenGL.platform.PLATFORM).__name__ != "EGLPlatform":
        raise RenderError(
            "pyrender needs PyOpenGL on EGL: set PYOPENGL_PLATFORM=egl before OpenGL is imported"
        )
    _mend_pyopengl()
    return pyrender, OpenGL.error.Error


def _mend_pyopengl() -> None:
    """PyOpenGL 3.1.0, which pyrender asks for, knows what ctypes.byref makes by a name that it has no more
    since Python 3.12: tell it the type itself.
    """
    from OpenGL.arrays import arraydatatype
    from OpenGL.arrays.ctypesparameters import CtypesParameterHandler

    handler = CtypesParameterHandler()
    for kind in handler.HANDLED_TYPES:
        arraydatatype.GLOBAL_REGISTRY.setdefault(kind, handler)


def _light(lighting: Lighting, normals: Float32Array) -> Float32Array:
    """(V, 3) what vertices multiply their colour by: the formula of shaders/lit.frag."""
    if lighting.mode == "shadeless":
        return np.ones_like(normals)
    colours = lighting.ground_color, lighting.sky_color, lighting.sun_color
    ground, sky, sun = (np.array(lighting.brightness(colour)) for colour in colours)
    up = 0.5 + 0.5 * normals[:, 2:]
    facing = normals @ lighting.direction
    return np.asarray(np.sqrt((1 - up) * ground + up * sky + np.maximum(facing, 0)[:, None] * sun), "f4")


def _compact(triangles: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The vertices that triangles have, and the triangles' corners among those."""
    source, corners = np.unique(triangles, return_inverse=True)
    return source.astype(np.intp), corners.reshape(-1, 3).astype(np.intp)


def _sided(corners: NDArray[Any], sides: int, offset: int) -> NDArray[Any]:
    """Triangles, and for two sides also turned over, of vertices ``offset`` further on."""
    return corners if sides == 1 else np.concatenate([corners, corners[:, ::-1] + offset])


def _colour_of(number: int) -> Array:
    """A number as pyrender takes and gives back colours."""
    return np.array([number & 255, number >> 8 & 255, number >> 16 & 255])
