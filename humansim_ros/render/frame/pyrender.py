"""A second renderer, for comparison: pyrender 0.1.45.

Colour and labels are rendered in two passes. For colour, the light of the default renderer is computed at the
vertices. The image is rendered at twice the size and averaged, so that a pixel has sixteen samples. Labels
and depth have one sample at the pixel center. Amodal masks need one pass per body, without the other bodies.
pyrender cannot move vertices, so a body in a new pose is a new mesh. Nothing is cached per camera.
"""

from __future__ import annotations

import os
import sys
import warnings
import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import HumansimWarning, RenderError
from humansim_ros.files.mesh import Mesh
from humansim_ros.render.device.caches import WeakCache
from humansim_ros.render.device.context import OpenGLContext
from humansim_ros.render.device.lens_tessellation import NEAR
from humansim_ros.render.device.mesh_buffers import ExpandedMesh, PosedMesh, Topology
from humansim_ros.render.frame.static_scene import FLOOR_SLACK
from humansim_ros.render.interface.channels import CHANNEL_TABLE, CHANNELS, View
from humansim_ros.render.interface.lighting import Lighting
from humansim_ros.render.interface.renderer import Backdrop, Body, Renderer, RenderRequest
from humansim_ros.types import Array, Float32Array, Image

_FAR = 200.0
_TRIANGLES = 4
#: Supersampling factor of colour, and the largest image side with supersampling. Without supersampling, a
#: pixel has four samples, and the middle of small things is up to 0.08 pixels off; with supersampling, 0.03.
_SUPERSAMPLING, _MAX_SUPERSAMPLED_SIDE = 2, 2048


class PyrenderRenderer(Renderer):
    """Renders bodies in a static scene with pyrender, in its own OpenGL context.

    Cameras may have skew but no distortion. A renderer belongs to the thread that makes it.

    Args:
        static_meshes: Meshes of the static scene, in ``map``, metres.
        lighting: Light. If None, the default light. There are no soft shadows and no tone mapping.
        device: Number of the GPU in the order of EGL. If None, the first one that works.
        static_bodies: Bodies that never move. They cast no contact shadow.

    Raises:
        RenderError: OpenGL, the device or pyrender is missing. The message says what to install.
    """

    channels = (*CHANNELS, "amodal")
    name = "pyrender"

    def __init__(
        self,
        static_meshes: Sequence[Mesh] = (),
        lighting: Lighting | None = None,
        device: int | None = None,
        static_bodies: Sequence[Body] = (),
    ) -> None:
        self._lighting = lighting or Lighting()
        if self._lighting.shadow == "soft" or self._lighting.tone_mapping != "none":
            text = "pyrender renders no soft shadows and no tone mapping: images will be without them"
            warnings.warn(text, HumansimWarning, stacklevel=2)
        self._library, self._gl_error = import_pyrender()
        self._context = OpenGLContext(device)
        # without this, __del__ would delete objects of the context that is current at that time
        quiet = type("QuietRenderer", (self._library.Renderer,), {"__del__": lambda self: None})
        self._colour_pass, self._id_pass = (quiet(1, 1) for _ in range(2))
        self._shapes: WeakCache[_Shape] = WeakCache()
        static = [
            Body(m, m.vertices.astype(np.float32), np.zeros(len(m.triangles), np.uint8), 0, "object")
            for m in static_meshes
        ]
        self._static = [_PosedShape(self._library, _Shape(self._library, body), body) for body in static]
        self._static_bodies = tuple(static_bodies)
        surfaces = [(body.vertices.astype(float), body.mesh.triangles) for body in static_bodies]
        surfaces += [(mesh.vertices, mesh.triangles) for mesh in static_meshes]
        self._has_floor = any((np.abs(v[t][..., 2]) < FLOOR_SLACK).all(axis=1).any() for v, t in surfaces)

    @property
    def device(self) -> str:
        """Name of the device, such as ``pyrender on llvmpipe (LLVM 15.0.6, 256 bits)``."""
        return f"pyrender on {self._context.device}"

    def close(self) -> None:
        self._context.close()

    def check_usable(self) -> None:
        self._context.check()

    def render_request(self, request: RenderRequest) -> View:
        camera, channels = request.camera, request.channels
        if camera.distorted:
            text = "pyrender renders no lens distortion: use the renderer moderngl, or an ideal camera"
            raise RenderError(text)
        moving = [self._posed(body) for body in request.bodies]
        shapes = [*self._static, *moving]
        view: dict[str, Any] = {}
        with self._context.current():
            if "rgb" in channels:
                static = {id(body) for body in self._static_bodies}
                pairs = zip(request.bodies, moving, strict=True)
                shadows = [shape for body, shape in pairs if id(body) not in static]
                view["rgb"] = self._colour(shapes, shadows, camera, request.backdrop)
            if labels := set(channels) - {"rgb", "amodal"}:
                view |= self._labels(shapes, camera, labels)
            if "amodal" in channels:
                labelled = [shape for shape in moving if shape.instance]
                view["amodal"] = {one.instance: self._segment([one], camera)[0] > 0 for one in labelled}
        return View(**view)

    def _posed(self, body: Body) -> _PosedShape:
        """Shape of a body in its pose, from the cache or made now."""
        shape = self._shapes.get(body.mesh)
        if shape is None or not np.array_equal(shape.parts, body.parts):
            shape = self._shapes.put(body.mesh, _Shape(self._library, body))
        posed = shape.posed.get(body.instance)
        if posed is None or posed.body() is not body:
            posed = shape.posed[body.instance] = _PosedShape(self._library, shape, body)
        return posed

    def _colour(
        self,
        shapes: Sequence[_PosedShape],
        shadows: Sequence[_PosedShape],
        camera: Camera,
        backdrop: Backdrop | None,
    ) -> Image:
        """Render (H, W, 3) sRGB. ``shadows``: bodies that cast contact shadows."""
        light = self._lighting
        surfaces = [shape.coloured(light, shape.sides(camera)) for shape in shapes]
        nodes = surfaces
        if light.shadow == "contact" and self._has_floor:
            nodes = [*surfaces, *(s.shadow(0.01 + 1e-4 * number) for number, s in enumerate(shadows))]
        if backdrop is None:
            background = np.append(np.array(light.background) / 255, 1.0)
            return self._supersampled(nodes, camera, ("FLAT",), background)
        rgb = self._supersampled(nodes, camera, ("FLAT",), np.zeros(4))
        alpha = self._supersampled(surfaces, camera, ("FLAT", "RGBA"), np.zeros(4))[..., 3:]
        return np.asarray(np.rint(rgb + (1 - alpha / 255) * backdrop.picture(camera)), dtype=np.uint8)

    def _supersampled(
        self, nodes: Sequence[_Node], camera: Camera, flags: Sequence[str], background: Array
    ) -> Image:
        """Render at a multiple of the camera's image size, and average."""
        factor = _SUPERSAMPLING if max(camera.size) <= _MAX_SUPERSAMPLED_SIDE else 1
        renderer = self._colour_pass
        renderer.viewport_width, renderer.viewport_height = (factor * side for side in camera.size)
        image = self._render(renderer, nodes, camera, flags, background)[0]
        return np.asarray(cv2.resize(image, camera.size, interpolation=cv2.INTER_AREA), dtype=np.uint8)

    def _labels(
        self, shapes: Sequence[_PosedShape], camera: Camera, channels: set[str]
    ) -> dict[str, NDArray[Any]]:
        ids, depth, table = self._segment(shapes, camera, "part" in channels)
        images = {"depth": np.where(ids > 0, depth, np.inf).astype(np.float32)}
        for column, name in enumerate(("instance", "part")):
            images[name] = table[:, column].astype(CHANNEL_TABLE[name].dtype)[ids]
        return {name: image for name, image in images.items() if name in channels}

    def _segment(
        self, shapes: Sequence[_PosedShape], camera: Camera, by_part: bool = False
    ) -> tuple[NDArray[np.uint32], Float32Array, NDArray[Any]]:
        """Render labels: (H, W) surface id at each pixel center, 0 for none; (H, W) depth; instance and part
        of each id."""
        parts = ((shape.instance, shape.labelled(shape.sides(camera), by_part)) for shape in shapes)
        surfaces = [(instance, *one) for instance, found in parts for one in found]
        # surfaces without a label only occlude
        table = np.array([(0, 0), *((instance, part * (instance > 0)) for instance, part, _ in surfaces)])
        colours = {node: _colour_of(number) for number, (*_, node) in enumerate(surfaces, 1)}
        renderer = self._id_pass
        renderer.viewport_width, renderer.viewport_height = camera.size
        colour, depth = self._render(renderer, list(colours), camera, ("SEG",), None, colours)
        return colour.astype(np.uint32) @ np.array([1, 256, 65536], np.uint32), depth, table

    def _render(
        self,
        renderer: Any,
        nodes: Sequence[_Node],
        camera: Camera,
        flags: Sequence[str],
        background: Array | None,
        colours: dict[_Node, Array] | None = None,
    ) -> tuple[NDArray[Any], NDArray[Any]]:
        """Render nodes. Returns image and depth. ``background``: RGBA, 0 to 1. ``colours``: if labels are
        rendered, the colour that encodes the label of each node."""
        names = self._library.RenderFlags
        scene = _Scene(nodes, _Eye(camera), camera.world_from_optical, background)
        try:
            flag = sum((getattr(names, name) for name in flags), names.OFFSCREEN)
            image, depth = renderer.render(scene, flag, colours)
        except self._gl_error as reason:
            raise RenderError(f"OpenGL failed in pyrender ({type(reason).__name__})") from None
        return image, depth


class _Shape:
    """Triangles of a body, all together and by body part, and its material. Holds no reference to the mesh.
    ``posed``: cached shapes in a pose, by instance."""

    def __init__(self, library: Any, body: Body) -> None:
        self.parts = body.parts
        self.posed: dict[int, _PosedShape] = {}
        self.topology = Topology(body.mesh)
        self.expanded = ExpandedMesh(body.mesh)
        triangles = body.mesh.triangles
        self.by_part = [(int(n), *_compact(triangles[body.parts == n])) for n in np.unique(body.parts)]
        self.whole = _compact(triangles)
        texture = body.mesh.texture
        if texture is not None:
            # rows of three bytes per pixel would need padding
            texture = library.Texture(source=texture, source_channels="RGBA")
        self.material = library.MetallicRoughnessMaterial(baseColorTexture=texture)


class _PosedShape:
    """A body in its pose, as meshes of pyrender that are created when needed. Holds no reference to the body.
    Methods take ``sides``: with 1, only front faces are rendered. With 2, triangles are doubled with their
    order reversed, since pyrender renders only counter-clockwise triangles."""

    def __init__(self, library: Any, shape: _Shape, body: Body) -> None:
        self.body, self.instance = weakref.ref(body), body.instance
        self._human, self._closed = body.kind == "human", body.mesh.closed
        self._shape, self._library = shape, library
        self._posed = PosedMesh(shape.topology, body.vertices)
        self._low, self._high = body.vertices.min(0) - 2 * NEAR, body.vertices.max(0) + 2 * NEAR
        self._nodes: dict[Any, _Node] = {}

    def sides(self, camera: Camera) -> int:
        """Number of visible sides of triangles: 1 for a closed surface with the camera outside, else 2."""
        inside = ((camera.center > self._low) & (camera.center < self._high)).all()
        return 2 if inside or not self._closed else 1

    def coloured(self, lighting: Lighting, sides: int) -> _Node:
        """Return the whole surface with colours and light."""
        if ("rgb", sides) not in self._nodes:
            expanded = self._shape.expanded
            normals = self._posed.normals.take(expanded.source, axis=0)
            uv, plain = expanded.uv_colors[:, :2], expanded.uv_colors[:, 2:]
            arrays = {
                "positions": self._posed.vertices.take(expanded.source, axis=0),
                "texcoord_0": uv,
                "color_0": plain * _light(lighting, normals),
            }
            if sides == 2:
                arrays = {name: np.concatenate([array, array]) for name, array in arrays.items()}
                arrays["color_0"][len(plain) :] = plain * _light(lighting, -normals)
            corners = _sided(expanded.corners, sides, len(plain))
            self._nodes["rgb", sides] = self._node(corners, self._shape.material, arrays)
        return self._nodes["rgb", sides]

    def labelled(self, sides: int, by_part: bool) -> Iterator[tuple[int, _Node]]:
        """Yield label and surface of each body part; or, without ``by_part``, 1 and the whole surface."""
        shape = self._shape
        for part, source, corners in shape.by_part if by_part else [(1, *shape.whole)]:
            key = (part, sides, by_part)
            if key not in self._nodes:
                positions = self._posed.vertices.take(source, axis=0)
                self._nodes[key] = self._node(_sided(corners, sides, 0), None, {"positions": positions})
            yield part, self._nodes[key]

    def shadow(self, height: float) -> _Node:
        """Return the contact shadow at a height above the floor."""
        key = "shadow", height
        if key not in self._nodes:
            caster = self._posed.human_caster if self._human else self._posed.object_caster
            corners, darkness = caster.corners, caster.shadow.darkness
            corners[:, 2] = height
            image = np.dstack([np.zeros((*darkness.shape, 3), np.uint8), darkness[::-1]])
            texture = self._library.Texture(source=image, source_channels="RGBA")
            material = self._library.MetallicRoughnessMaterial(
                baseColorTexture=texture, alphaMode="BLEND", doubleSided=True
            )
            uv = np.array([(0, 0), (1, 0), (0, 1), (1, 1)], np.float32)
            arrays = {"positions": corners, "texcoord_0": uv}
            self._nodes[key] = self._node(np.array([(0, 1, 2), (2, 1, 3)]), material, arrays)
        return self._nodes[key]

    def _node(self, corners: NDArray[Any], material: Any, arrays: dict[str, NDArray[Any]]) -> _Node:
        primitive = self._library.Primitive(indices=corners, material=material, mode=_TRIANGLES, **arrays)
        return _Node(self._library.Mesh([primitive]))


@dataclass(frozen=True, eq=False)
class _Node:
    mesh: Any


class _Eye:
    """A camera for pyrender, with the projection matrix of this package."""

    znear, zfar = NEAR, _FAR

    def __init__(self, camera: Camera) -> None:
        self.camera = self
        # pyrender renders bottom row first and flips the image when it reads it
        self._projection = np.diag([1.0, -1.0, 1.0, 1.0]) @ camera.opengl_clip(NEAR, _FAR)

    def get_projection_matrix(self, width: int, height: int) -> Array:
        return self._projection


class _Scene:
    """A scene for pyrender's renderer, with a fixed draw order. pyrender's own scene keeps nodes in sets, so
    that its draw order varies."""

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
    # The viewer of pyrender imports pyglet, which fails without the X11 libraries of a desktop. Rendering
    # needs no window, so an empty module replaces the viewer during the import.
    viewer = ModuleType("pyrender.viewer")
    vars(viewer)["Viewer"] = None
    sys.modules.setdefault(viewer.__name__, viewer)
    try:
        import OpenGL.error
        import OpenGL.platform
        import pyrender
    # not only ImportError, since each library reports a missing library in its own way
    except Exception as reason:
        raise RenderError(
            f"pyrender cannot be imported ({str(reason).partition(chr(10))[0] or type(reason).__name__}). "
            "Install it: pip install pyrender==0.1.45, and on Debian or Ubuntu: "
            "sudo apt-get install -y libegl1 libgl1"
        ) from None
    finally:
        if sys.modules.get(viewer.__name__) is viewer:
            del sys.modules[viewer.__name__]
    if type(OpenGL.platform.PLATFORM).__name__ != "EGLPlatform":
        text = "pyrender needs PyOpenGL on EGL: set PYOPENGL_PLATFORM=egl before OpenGL is imported"
        raise RenderError(text)
    _mend_pyopengl()
    return pyrender, OpenGL.error.Error


def _mend_pyopengl() -> None:
    """Register the type of ctypes.byref in PyOpenGL 3.1.0, since pyrender needs it. PyOpenGL knows the type
    by its old name, which Python 3.12 has changed."""
    from OpenGL.arrays import arraydatatype
    from OpenGL.arrays.ctypesparameters import CtypesParameterHandler

    handler = CtypesParameterHandler()
    for kind in handler.HANDLED_TYPES:
        arraydatatype.GLOBAL_REGISTRY.setdefault(kind, handler)


def _light(lighting: Lighting, normals: Float32Array) -> Float32Array:
    """Light at vertices: (V, 3) factors of the vertex colours, by the formula of shaders/lit.frag."""
    if lighting.mode == "shadeless":
        return np.ones_like(normals)
    colours = lighting.ground_color, lighting.sky_color, lighting.sun_color
    ground, sky, sun = (np.array(lighting.brightness(colour)) for colour in colours)
    up = 0.5 + 0.5 * normals[:, 2:]
    facing = normals @ lighting.direction
    return np.asarray(np.sqrt((1 - up) * ground + up * sky + np.maximum(facing, 0)[:, None] * sun), "f4")


def _compact(triangles: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the vertices that triangles use, and the triangles as indices into these vertices."""
    source, corners = np.unique(triangles, return_inverse=True)
    return source.astype(np.intp), corners.reshape(-1, 3).astype(np.intp)


def _sided(corners: NDArray[Any], sides: int, offset: int) -> NDArray[Any]:
    """Return the triangles. For two sides, add the flipped triangles with vertex indices raised by
    ``offset``."""
    return corners if sides == 1 else np.concatenate([corners, corners[:, ::-1] + offset])


def _colour_of(number: int) -> Array:
    """Encode a number as a colour that pyrender renders and reads back."""
    return np.array([number & 255, number >> 8 & 255, number >> 16 & 255])
