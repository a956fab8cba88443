"""The 3D scene of the page: people, objects, cameras, floor, and drawings such as trails and labels."""

from __future__ import annotations

import itertools
import json
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera, Coverage
from humansim_ros.data.formats import GlbDocument
from humansim_ros.errors import CameraError
from humansim_ros.files.mesh import Mesh, SurfaceNormals, split_seams
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.people.humans import Human
from humansim_ros.scene.pictures import person_color
from humansim_ros.types import Array, Color, Image
from humansim_ros.view.server.server import PREFIX, PageServer
from humansim_ros.view.sources.source import JOINTS, ViewFrame, ViewSource, jpeg_of

#: Number of points of a trail, and number of frames between two points.
_TRAIL, _TRAIL_STEP = 60, 2
#: Joints that get trails. If a body has none of these joints, all its joints get trails.
_TRAILED = ("HumanoidRoot", "l_wrist", "r_wrist", "l_ankle", "r_ankle", "vt3_end")
#: Length of the frustum (pyramid) of a camera, metres.
_FRUSTUM = 0.45
#: Width of the images in frusta, pixels.
_FRUSTUM_IMAGE = 160
#: Cells of the coverage picture along its longer side, and its margin around the cameras, metres.
_CELLS, _MARGIN = 96, 1.0
_RED = (235, 80, 80)
#: Colour of scanned points that are not on a person, and size of scanned points, metres.
_SCAN, _SCAN_POINT = (70, 90, 110), 0.015
#: Folder under which the server serves the files of people.
_PEOPLE = "people/"
#: Opacity of bodies while their joints are shown.
_SEE_THROUGH = 0.4
#: If the size of a person changes by more than this, the body is built again.
_SIZE_STEP = 1e-3


@dataclass(frozen=True)
class Options:
    """Which things the 3D scene shows, in addition to people and moving objects."""

    cameras: bool = True
    images: bool = True
    names: bool = True
    axes: bool = True
    joints: bool = False
    joint_names: bool = False
    trails: bool = False
    boxes: bool = False
    coverage: bool = False
    scans: bool = True
    room: bool = True


class Stage:
    """The 3D scene of a page. Each source gets a new stage. The files of its people have the number of the
    stage in their names, so that no page mixes files of two stages.

    Args:
        server: The server.
        source: Source of people, objects and cameras.
        on_click: Function that is called when a person is clicked, with the name and the ray of the click:
            origin (3,) and direction (3,).
    """

    _numbers_of_stages = itertools.count()

    def __init__(
        self,
        server: PageServer,
        source: ViewSource,
        on_click: Callable[[str, Array, Array], None],
    ) -> None:
        self._server, self._scene = server, server.viser.scene
        self._source, self._on_click = source, on_click
        self.options = Options()
        self._bodies: dict[str, tuple[PageBody, Any]] = {}
        self._numbers: dict[str, int] = {name: number for number, name in enumerate(source.people)}
        self._extras: dict[str, Any] = {}
        self._trails: dict[str, deque[Array]] = {name: deque(maxlen=_TRAIL) for name in source.people}
        self._last_index = -1
        self._hidden: str | None = None
        self._images: object = None
        self.frame: ViewFrame | None = None
        with server.viser.atomic():
            self._scene.reset()
            self._scene.set_up_direction("+z")
            self._floor = self._add_floor()
            self._room = self._add_static()
            self._objects: dict[str, Any] = {
                name: self._scene.add_glb(f"/objects/{name}", glb_of([mesh]))
                for name, mesh in source.objects.items()
            }
            # viser's own lights shine from one side, so the other side of people would be black
            self._scene.add_light_ambient("/light", intensity=1.2)
            self._axes = self._scene.add_frame("/map", axes_length=0.5, axes_radius=0.008)
            self._frusta = {name: self._add_camera(name, camera) for name, camera in source.cameras.items()}
            for name in source.people:
                self._bodies[name] = self._add_body(name, 1.0)
        self._serve_bodies()
        self.set_options(self.options)

    def show(self, frame: ViewFrame) -> None:
        """Move people, objects and cameras to a frame, and show its images and drawings."""
        self.frame = frame
        if abs(frame.index - self._last_index) > 2 * _TRAIL_STEP:
            for trail in self._trails.values():
                trail.clear()
        self._last_index = frame.index
        for name in frame.joints.keys() & self._bodies.keys():
            if abs(frame.sizes.get(name, 1.0) - self._bodies[name][0].size) > _SIZE_STEP:
                self._bodies[name][1].remove()
                self._bodies[name] = self._add_body(name, frame.sizes[name])
        with self._server.viser.atomic():
            self._pose_bodies(frame)
            for name, matrix in frame.objects.items():
                self._pose_object(name, matrix)
            for name in frame.cameras.keys() & self._frusta.keys():
                self._place_camera(self._frusta[name][0], frame.cameras[name])
            if self.options.images and self.options.cameras:
                self._show_images(frame)
            self._show_extras(frame)
        self._server.viser.flush()

    def set_options(self, options: Options) -> None:
        """Choose what is drawn. Drawings that depend on the frame appear with the next frame."""
        self.options = options
        self._room.visible = options.room
        self._floor.visible = not options.room or not self._source.static
        self._axes.visible = options.axes
        for _, handle in self._bodies.values():
            handle.opacity = _SEE_THROUGH if options.joints or options.joint_names else None
        for name, (handle, label) in self._frusta.items():
            handle.visible = options.cameras and name != self._hidden
            label.visible = handle.visible and options.names
            if not options.images:
                handle.image = None
        self._drop("coverage")
        if options.coverage:
            self._add_coverage()
        for key in list(self._extras):
            if key != "coverage":
                self._drop(key)

    def hide_camera(self, name: str | None) -> None:
        """Do not draw a camera that the user looks through, because its own image would cover the view."""
        self._hidden = name
        self.set_options(self.options)

    # --- people ------------------------------------------------------------------------------------------

    def _add_body(self, name: str, size: float) -> tuple[PageBody, Any]:
        body = PageBody(self._source.people[name], size)
        rest = body.rest
        handle = self._scene.add_mesh_skinned(
            f"/people/{name}",
            body.vertices,
            body.faces,
            bone_wxyzs=_wxyz(rest[:, :3, :3]),
            bone_positions=rest[:, :3, 3],
            skin_weights=body.weights,
            color=keyed_color(body.color, self._numbers[name]),
            opacity=_SEE_THROUGH if self.options.joints or self.options.joint_names else None,
        )
        handle.on_click(lambda event: self._clicked(name, event))
        return body, handle

    def _clicked(self, name: str, event: Any) -> None:
        if event.ray_origin is not None and event.ray_direction is not None:
            self._on_click(name, np.array(event.ray_origin), np.array(event.ray_direction))

    def _serve_bodies(self) -> None:
        """Serve textures and normals of the bodies; the page finds them by the colours of the bodies.

        The files do not depend on the sizes of the bodies.
        """
        stage = next(self._numbers_of_stages)
        table: dict[str, dict[str, Any]] = {}
        files: dict[str, tuple[str, bytes]] = {}
        for name, (body, _) in self._bodies.items():
            number = self._numbers[name]
            key = "{:02x}{:02x}{:02x}".format(*keyed_color(body.color, number))
            person = f"{stage}-{number}"
            files[f"{person}.surface"] = "application/octet-stream", body.surface
            shapes = body.shapes
            if shapes is not None:
                files[f"{person}.shapes"] = "application/octet-stream", shapes
            texture = body.texture
            if texture is not None:
                files[f"{person}.jpg"] = "image/jpeg", texture
            table[key] = {
                "name": name,
                "joints": body.human.skeleton.joint_names,
                "vertices": len(body.vertices),
                "surface": f"{PREFIX}{_PEOPLE}{person}.surface",
                "shapes": None if shapes is None else f"{PREFIX}{_PEOPLE}{person}.shapes",
                "texture": None if texture is None else f"{PREFIX}{_PEOPLE}{person}.jpg",
            }
        self._server.replace_files(_PEOPLE, files)
        self._server.add_json("people.json", table)

    def _pose_bodies(self, frame: ViewFrame) -> None:
        """Send the poses of the bones to the script of the page (page/page.js), which poses the bodies."""
        people = []
        for name, (body, handle) in self._bodies.items():
            joints = frame.joints.get(name)
            if handle.visible != (joints is not None):
                handle.visible = joints is not None
            if joints is not None:
                count = len(body.human.skeleton)
                color = keyed_color(body.color, self._numbers[name])
                face = frame.faces.get(name, np.zeros(0)) * frame.sizes.get(name, 1.0)
                people.append((color, joints[:count], joints[count:, :3, 3], face))
        cameras = {
            name: camera.center
            for name, camera in frame.cameras.items()
            if name in self._frusta and self._frusta[name][0].visible
        }
        self._server.stream(pose_message(frame.index, people, cameras), "poses")

    # --- objects and room --------------------------------------------------------------------------------

    def _add_static(self) -> Any:
        if not self._source.static:
            return self._scene.add_frame("/room", show_axes=False)
        return self._scene.add_glb("/room", glb_of(self._source.static.values()), cast_shadow=False)

    def _pose_object(self, name: str, matrix: Array) -> None:
        handle = self._objects.get(name)
        if handle is None:
            return
        sizes = np.linalg.norm(matrix[:3, :3], axis=0)
        handle.wxyz = _wxyz(matrix[None, :3, :3] / sizes)[0]
        handle.position = matrix[:3, 3]
        if not np.allclose(handle.scale, sizes, rtol=1e-4):
            handle.scale = tuple(map(float, sizes))

    def _add_floor(self) -> Any:
        return self._scene.add_grid(
            "/floor",
            width=12,
            height=12,
            cell_size=0.5,
            section_size=1.0,
            plane="xy",
            position=(0, 0, -0.002),
        )

    # --- cameras -----------------------------------------------------------------------------------------

    def _add_camera(self, name: str, camera: Camera) -> tuple[Any, Any]:
        width, height = camera.size
        fov = 2 * math.atan2(height / 2, camera.K[1, 1])
        handle = self._scene.add_camera_frustum(
            f"/cameras/{name}",
            fov=fov,
            aspect=width / height,
            scale=_FRUSTUM * math.tan(min(fov, 2.0) / 2),
            color=(40, 110, 220),
            thickness=0.008,
            cast_shadow=False,
            receive_shadow=False,
        )
        label = self._scene.add_label(f"/cameras/{name}/name", name, position=(0.0, -0.12, 0.0))
        self._place_camera(handle, camera)
        return handle, label

    @staticmethod
    def _place_camera(handle: Any, camera: Camera) -> None:
        handle.wxyz = _wxyz(camera.R.T[None])[0]
        handle.position = camera.center

    def _show_images(self, frame: ViewFrame) -> None:
        if frame.images is self._images:
            return
        self._images = frame.images
        for name, images in frame.images.items():
            if name in self._frusta and images:
                image = images.get("rgb", images.get(JOINTS, next(iter(images.values()))))
                scale = _FRUSTUM_IMAGE / max(image.shape[:2])
                small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
                self._frusta[name][0].image = np.asarray(small)

    # --- drawn next to them -------------------------------------------------------------------------------

    def _show_extras(self, frame: ViewFrame) -> None:
        for name, joints in frame.joints.items():
            color = person_color(self._numbers.get(name, 0))
            positions = joints[:, :3, 3]
            if self.options.names:
                self._label(
                    f"name of {name}", name, positions[:, :2].mean(axis=0), positions[:, 2].max() + 0.2
                )
            if self.options.joints or self.options.joint_names:
                self._skeleton(name, positions, color)
            if self.options.trails and frame.index % _TRAIL_STEP == 0:
                self._trail(name, positions, color)
            if self.options.boxes:
                self._box(name, joints, color)
        self._show_scans(frame)
        for name, points in frame.estimate.items():
            points = points[np.isfinite(points).all(axis=1)]
            if len(points):
                self._points(f"estimate {name}", points, _RED)
                error = frame.estimate_errors.get(name)
                text = name if error is None else f"{name}: {error:.0f} mm"
                # below the feet: the name of the person stands above the head
                self._label(f"error {name}", text, points[:, :2].mean(axis=0), points[:, 2].min() - 0.1)
        for key in [key for key in self._extras if key.startswith(("estimate ", "error "))]:
            if key.split(" ", 1)[1] not in frame.estimate:
                self._drop(key)

    def _show_scans(self, frame: ViewFrame) -> None:
        clouds = {
            f"scan {scanner} {person}": (points, self._color_of(person))
            for scanner, people in frame.scans.items()
            for person, points in people.items()
        }
        for key, (points, color) in clouds.items():
            self._points(key, points, color, _SCAN_POINT)
        for key in [key for key in self._extras if key.startswith("scan ") and key not in clouds]:
            self._drop(key)

    def _color_of(self, person: str) -> Color:
        return person_color(self._numbers[person]) if person in self._numbers else _SCAN

    def _label(self, key: str, text: str, over: Array, height: float) -> None:
        position = (float(over[0]), float(over[1]), float(height))
        label = self._extras.get(key)
        if label is None:
            self._extras[key] = self._scene.add_label(f"/beside/{key}", text, position=position)
        else:
            label.position = position
            if label.text != text:
                label.text = text

    def _skeleton(self, name: str, positions: Array, color: Color) -> None:
        skeleton = self._source.people[name].skeleton
        numbers = {joint: number for number, joint in enumerate(skeleton.joint_names)}
        pairs = [
            (number, numbers[parent])
            for number, parent in enumerate(skeleton.joint_parents)
            if parent is not None
        ]
        self._lines(f"joints {name}", positions[np.array(pairs, dtype=int).reshape(-1, 2)], color)
        if self.options.joint_names:
            for joint, number in numbers.items():
                point = positions[number]
                self._label(f"joint {name} {joint}", joint, point[:2], float(point[2]))

    def _trail(self, name: str, positions: Array, color: Color) -> None:
        names = self._source.people[name].skeleton.joint_names
        chosen = [names.index(joint) for joint in _TRAILED if joint in names] or list(range(len(names)))
        trail = self._trails[name]
        trail.append(positions[chosen])
        if len(trail) > 1:
            points = np.stack(trail)
            self._lines(f"trail {name}", np.stack([points[:-1], points[1:]], axis=2).reshape(-1, 2, 3), color)

    def _box(self, name: str, joints: Array, color: Color) -> None:
        human = self._source.people[name]
        vertices = human.pose(joints[: len(human.skeleton)])
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        pairs = [(a, b) for a in range(8) for b in range(a) if np.abs(corners[a] - corners[b]).sum() == 1]
        self._lines(f"box {name}", (low + corners * (high - low))[np.array(pairs)], color)

    def _lines(self, key: str, points: Array, color: Color) -> None:
        """Draw line segments (N, 2, 3)."""
        points = np.asarray(points, dtype=np.float32)
        handle = self._extras.get(key)
        if handle is None:
            self._extras[key] = self._scene.add_line_segments(
                f"/beside/{key}", points, np.array(color, np.uint8), thickness=2.5, thickness_units="screen"
            )
        else:
            handle.points = points

    def _points(self, key: str, points: Array, color: Color, size: float = 0.03) -> None:
        points = np.asarray(points, dtype=np.float32)
        handle = self._extras.get(key)
        if handle is not None and len(handle.points) == len(points):
            handle.points = points
            return
        self._drop(key)
        self._extras[key] = self._scene.add_point_cloud(
            f"/beside/{key}", points, np.array(color, np.uint8), point_size=size, point_shape="circle"
        )

    def mark(self, point: Array | None) -> None:
        """Mark a point (3,) in ``map`` with a sphere. None removes the mark."""
        self._drop("mark")
        if point is not None:
            self._extras["mark"] = self._scene.add_icosphere(
                "/beside/mark", radius=0.015, color=(255, 220, 0), position=np.asarray(point)
            )

    def _drop(self, key: str) -> None:
        handle = self._extras.pop(key, None)
        if handle is not None:
            handle.remove()

    def _add_coverage(self) -> None:
        cameras = self._source.cameras if self.frame is None else self.frame.cameras
        if not cameras:
            return
        try:
            image, low, high = coverage_picture(cameras)
        except CameraError:
            return
        size = high - low
        self._extras["coverage"] = self._scene.add_image(
            "/beside/coverage",
            image,
            render_width=float(size[0]),
            render_height=float(size[1]),
            format="png",
            wxyz=(0.0, 1.0, 0.0, 0.0),  # images face -z: the first row is at the largest y
            position=(float(low[0] + size[0] / 2), float(low[1] + size[1] / 2), 0.004),
        )


def pose_message(
    index: int, people: Sequence[tuple[Color, Array, Array, Array]], cameras: Mapping[str, Array]
) -> bytes:
    """Encode the poses of a frame for the page's script (page/page.js); all positions are in ``map``, metres.

    Args:
        index: Number of the frame.
        people: For each person: colour, poses of the bones (B, 4, 4), end points (E, 3), and weights (S,) of
            the shapes of the face, times the scale of the body (S is 0 for a stiff face).
        cameras: Centers (3,) of the cameras that are drawn, by name.
    """
    parts = [np.array([index, len(people)], np.uint32).tobytes()]
    for (red, green, blue), bones, ends, face in people:
        key = red << 16 | green << 8 | blue
        parts.append(np.array([key, len(bones), len(ends), len(face)], np.uint32).tobytes())
        quaternions = matrix_to_quaternion(np.ascontiguousarray(bones[:, :3, :3]))
        parts.append(np.concatenate([quaternions, bones[:, :3, 3]], axis=1).astype(np.float32).tobytes())
        parts += [np.asarray(values, np.float32).tobytes() for values in (ends, face)]
    centers = {name: np.round(center, 6).tolist() for name, center in cameras.items()}
    return b"".join([*parts, json.dumps(centers).encode()])


def coverage_picture(cameras: Mapping[str, Camera]) -> tuple[Image, Array, Array]:
    """Picture of the floor, coloured by the share of cameras that see a standing person (0.1 to 1.7 m) there.

    Returns:
        RGBA image (first row at the largest y); smallest and largest x and y (2,) in ``map``, metres.
    """
    centers = np.array([camera.center[:2] for camera in cameras.values()])
    low, high = centers.min(axis=0) - _MARGIN, centers.max(axis=0) + _MARGIN
    middle = (low + high) / 2
    half = np.maximum((high - low) / 2, 3.0)
    low, high = middle - half, middle + half
    cell = float((high - low).max()) / _CELLS
    x = np.arange(low[0] + cell / 2, high[0], cell)
    y = np.arange(low[1] + cell / 2, high[1], cell)
    counts = Coverage.of(cameras, x, y, 0.1, 1.7).counts[::-1]
    share = counts / max(len(cameras), 1)
    red, green = np.clip(2 - 2 * share, 0, 1), np.clip(2 * share, 0, 1)
    colors = 50 + 180 * np.dstack([red, green, np.zeros_like(share)])
    alpha = np.where(counts > 0, 150, 0)
    return np.dstack([np.rint(colors), alpha]).astype(np.uint8), low, high


def _wxyz(rotations: Array) -> Array:
    """Convert rotations (N, 3, 3) to quaternions (N, 4) wxyz, the order of viser."""
    return matrix_to_quaternion(np.ascontiguousarray(rotations))[:, [3, 0, 1, 2]]


# --- models: people as skinned meshes, objects and room as glTF files

#: Most bones per vertex on the page. Only the largest weights are kept.
_INFLUENCES = 4
#: Longest side of a texture of a person, pixels.
_BODY_TEXTURE = 1024
_GREY: Color = (186, 160, 145)


@dataclass(frozen=True)
class PageBody:
    """A human as a mesh of N vertices for the page. Vertices at seams of the texture are duplicated.

    Attributes:
        human: The human in the rest pose, in body space.
        size: Scale of the body.
    """

    human: Human
    size: float = 1.0

    @cached_property
    def _split(self) -> tuple[NDArray[np.int64], Array | None, NDArray[np.uint32]]:
        return split_seams(self.human.mesh)

    @property
    def vertices(self) -> NDArray[np.float32]:
        """Vertices (N, 3) in the rest pose, scaled, metres."""
        return np.asarray(self.size * self.human.mesh.vertices[self._split[0]], dtype=np.float32)

    @property
    def faces(self) -> NDArray[np.uint32]:
        """Triangles (T, 3) of vertex numbers."""
        return self._split[2]

    @property
    def rest(self) -> Array:
        """Bone frames (B, 4, 4) in the rest pose, scaled."""
        rest = self.human.skeleton.rest.copy()
        rest[:, :3, 3] *= self.size
        return rest

    @property
    def weights(self) -> NDArray[np.float32]:
        """Skinning weights (N, B); only those of the strongest bones are not 0. Rows sum to one."""
        weights = self.human.weights.toarray()
        if weights.shape[1] > _INFLUENCES:
            least = np.partition(weights, -_INFLUENCES, axis=1)[:, -_INFLUENCES, None]
            weights = np.where(weights >= least, weights, 0.0)
        weights /= weights.sum(axis=1, keepdims=True)
        return np.asarray(weights[self._split[0]], dtype=np.float32)

    @property
    def surface(self) -> bytes:
        """Binary file: uint32 N; then, in float32, normals (N, 3) and texture coordinates (N, 2), v down."""
        original, uv, _ = self._split
        mesh = self.human.mesh
        normals = SurfaceNormals(mesh.triangles, len(mesh.vertices))(mesh.vertices)[original]
        flipped = np.zeros((len(original), 2)) if uv is None else uv
        return b"".join(
            [
                np.uint32(len(original)).tobytes(),
                np.asarray(normals, dtype=np.float32).tobytes(),
                np.asarray(flipped, dtype=np.float32).tobytes(),
            ]
        )

    @property
    def shapes(self) -> bytes | None:
        """Binary file of the shapes of the face; None without shapes. In this order, uint32: number S of
        shapes; number K of offsets; first offset of each shape (S + 1,); vertex of each offset (K,). Then
        float32: offsets (K, 3) for a body of size 1.
        """
        shapes = self.human.shapes
        if shapes is None:
            return None
        original = self._split[0]
        order = np.argsort(original, kind="stable")
        first, last = (np.searchsorted(original[order], shapes.rows, side) for side in ("left", "right"))
        copies = last - first
        which = np.repeat(np.arange(len(shapes.rows)), copies)
        within = np.arange(len(which)) - np.repeat(np.cumsum(copies) - copies, copies)
        starts = np.concatenate([[0], np.cumsum(copies)])[shapes.starts]
        numbers = np.concatenate([[len(shapes.names), len(which)], starts, order[first[which] + within]])
        return numbers.astype(np.uint32).tobytes() + shapes.offsets[which].astype(np.float32).tobytes()

    @property
    def texture(self) -> bytes | None:
        """JPEG file of the texture; None if the body has no texture."""
        image = self.human.mesh.texture
        return None if image is None else jpeg_of(image, _BODY_TEXTURE)

    @property
    def color(self) -> Color:
        """Median colour of the body, which pages show until they have the texture."""
        mesh = self.human.mesh
        if mesh.texture is not None:
            used = mesh.texture[::8, ::8].reshape(-1, 3)
        elif mesh.colors is not None:
            used = mesh.colors
        else:
            return _GREY
        red, green, blue = np.median(used, axis=0).astype(int)
        return int(red), int(green), int(blue)


def keyed_color(color: Color, number: int) -> Color:
    """Colour near ``color``, with the number of a body (below 512) in the 3 lowest bits of each channel."""
    red, green, blue = (channel & ~7 for channel in color)
    return red | number & 7, green | number >> 3 & 7, blue | number >> 6 & 7


#: Longest side of the textures of room and objects, pixels.
_ROOM_TEXTURE = 512


#: A texture with a standard deviation (of values up to 255) below this is drawn as its mean colour.
_PLAIN = 4.0


def glb_of(meshes: Iterable[Mesh]) -> bytes:
    """Encode meshes with their textures or colours as a binary glTF file (GLB).

    Meshes with the same texture are joined to one mesh, since each mesh and texture costs a browser time. So
    are all meshes without a texture, or with a texture of nearly one colour.
    """
    groups: dict[int, list[Mesh]] = {}
    plain: list[tuple[Mesh, NDArray[np.uint8]]] = []
    for mesh in meshes:
        color = _plain_color(mesh)
        if color is None:
            groups.setdefault(id(mesh.texture), []).append(mesh)
        else:
            plain.append((mesh, color))
    document = GlbDocument()
    for group in groups.values():
        _add_textured(document, group)
    if plain:
        document.add_mesh(
            np.concatenate([mesh.vertices for mesh, _ in plain]),
            _joined([(mesh.triangles, len(mesh.vertices)) for mesh, _ in plain]),
            colors=np.concatenate([np.broadcast_to(c, (len(m.vertices), 3)) for m, c in plain]),
        )
    return document.encoded()


def _joined(parts: Sequence[tuple[NDArray[np.integer], int]]) -> NDArray[np.integer]:
    """Join triangles of meshes to (F, 3). ``parts``: triangles and number of vertices of each mesh."""
    firsts = np.cumsum([0, *(count for _, count in parts)])
    return np.concatenate([faces + first for (faces, _), first in zip(parts, firsts, strict=False)])


def _plain_color(mesh: Mesh) -> NDArray[np.uint8] | None:
    """Colours (V, 3) or one colour (3,) to draw a mesh without its texture; None to draw the texture."""
    if mesh.texture is None or mesh.uv is None:
        return np.full(3, 170, np.uint8) if mesh.colors is None else np.asarray(mesh.colors, np.uint8)
    mean, deviation = cv2.meanStdDev(mesh.texture)
    return np.rint(mean[:3, 0]).astype(np.uint8) if deviation.max() < _PLAIN else None


def _add_textured(document: GlbDocument, meshes: list[Mesh]) -> None:
    """Add meshes that share a texture to the document, as one mesh."""
    texture = meshes[0].texture
    assert texture is not None
    split = [split_seams(mesh) for mesh in meshes]
    uvs = [uv for _, uv, _ in split if uv is not None]
    document.add_mesh(
        np.concatenate([mesh.vertices[each[0]] for mesh, each in zip(meshes, split, strict=True)]),
        _joined([(triangles, len(original)) for original, _, triangles in split]),
        uv=np.concatenate(uvs),
        texture=jpeg_of(texture, _ROOM_TEXTURE),
    )
