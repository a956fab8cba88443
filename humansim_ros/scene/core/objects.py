"""Objects of a scene, built-in meshes, and what moves things: keyframes, trajectories, a robot.

Furniture has metres and its own colours, and occludes people as in real rooms. Its origin is on the floor, in
the middle of what stands there. The front is towards +x, z is up. Parts share no vertices: their edges are
sharp in shading. The colour of a scene replaces the main colour.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Trajectory
from humansim_ros.errors import SceneError, did_you_mean, in_section
from humansim_ros.files.mesh import Material, Mesh, read_mesh_z_up
from humansim_ros.files.reading import read_table
from humansim_ros.geometry import (
    VELOCITY_STEP,
    ObjectPose,
    Velocity,
    from_degrees,
    multiply_quaternions,
    normalised,
)
from humansim_ros.motion.files import KeyframeTrack
from humansim_ros.render.interface import Body
from humansim_ros.scene.config.camera_config import TrajectoryConfig
from humansim_ros.scene.config.config import ObjectConfig
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.robot import RobotConfig
from humansim_ros.types import Array, Color

#: Segments around a sphere or a cylinder.
_SEGMENTS = 48


@dataclass(frozen=True)
class SceneObject:
    """An object of a scene.

    Attributes:
        name: Name in the scene.
        shape: Name of a built-in mesh, or the path of the mesh file.
        color: Red, green, blue, sRGB; of furniture the main colour.
        mesh: Mesh at size 1 about its own origin.
        initial_pose: Pose without keyframes.
        keyframes: Keyframes that move the object, if any.
        instance: Instance label; 0 for none.
        pose_at: If a human or a robot moves the object: pose and velocity at a scene time in seconds.
        held_by: Name of the human who holds the object in both hands, if any.
        key: Key of the scene file that makes it.
    """

    name: str
    shape: str
    color: tuple[int, int, int]
    mesh: Mesh
    initial_pose: ObjectPose
    keyframes: KeyframeTrack | None = None
    instance: int = 0
    pose_at: Callable[[float], ObjectPose] | None = None
    held_by: str | None = None
    key: str = ""

    @classmethod
    def build(
        cls,
        name: str,
        config: ObjectConfig,
        source: SceneSource,
        keyframes: KeyframeTrack | None,
        instance: int,
    ) -> SceneObject:
        """Create an object.

        Args:
            name: Name in the scene.
            config: Section of a scene file.
            source: Finds the mesh file.
            keyframes: Keyframes that move the object, if any.
            instance: Instance label; 0 for none.

        Raises:
            HumansimError: The mesh cannot be read; ``key`` is relative to the section.
        """
        colored = "color" in config.model_fields_set
        with in_section("mesh"):
            in_memory = source.mesh(config.mesh)
            if in_memory is not None:
                shape, mesh = config.mesh, in_memory
            elif config.mesh in SHAPES:
                shape, mesh = config.mesh, SHAPES[config.mesh]()
            elif config.mesh in FURNITURE:
                shape, mesh = config.mesh, FURNITURE[config.mesh].mesh(config.color if colored else None)
            else:
                known = ", ".join(BUILT_IN_MESHES) + did_you_mean(config.mesh, BUILT_IN_MESHES)
                path = source.find(config.mesh, f"the built-in meshes are {known}")
                shape, mesh = str(path.resolve()), read_mesh_z_up(path)
        color = config.color
        if shape in FURNITURE:
            color = config.color if colored else FURNITURE[shape].color
        elif colored or (mesh.colors is None and mesh.texture is None):
            mesh = replace(mesh, colors=np.tile(np.array(color, np.uint8), (len(mesh.vertices), 1)))
        turn = from_degrees(config.rotation_deg).as_quat()
        pose = ObjectPose(np.array(config.position), turn, np.array(config.size))
        return cls(name, shape, color, mesh, pose, keyframes, instance, key=f"objects.{name}")

    @property
    def moves(self) -> bool:
        """Whether keyframes, a human or a robot move the object."""
        return self.keyframes is not None or self.pose_at is not None

    def at(self, seconds: float) -> ObjectPose:
        """Pose and velocity at a time since the start of the scene."""
        if self.pose_at is not None:
            return self.placed(self.pose_at(seconds))
        if self.keyframes is None:
            return self.initial_pose
        times, key = self.keyframes.around(seconds)
        turn = scipy.spatial.transform.Rotation.from_quat(key.quaternion)
        position = key.position + turn.apply(key.size * self.initial_pose.position)
        rotation = multiply_quaternions(normalised(key.quaternion), normalised(self.initial_pose.rotation))
        velocity = Velocity.between(position, rotation, times[2] - times[0])
        return ObjectPose(position[1], rotation[1], key.size[1] * self.initial_pose.size, velocity)

    def placed(self, pose: ObjectPose) -> ObjectPose:
        """A pose with the size of the object."""
        return replace(pose, size=self.initial_pose.size)

    def to_mesh(self, points: Array, times: Array) -> Array:
        """Transform points (N, P, 3) in ``map`` at scene times (N,) to the mesh at size 1."""
        pose, rotations = self.initial_pose, scipy.spatial.transform.Rotation.from_quat
        position, size = np.tile(pose.position, (len(times), 1)), np.tile(pose.size, (len(times), 1))
        turn = rotations(np.tile(pose.rotation, (len(times), 1)))
        if self.pose_at is not None:
            poses = [self.pose_at(time) for time in times.tolist()]
            position = np.array([each.position for each in poses])
            turn = rotations(np.array([each.rotation for each in poses]))
        elif self.keyframes is not None:
            key = self.keyframes.at(times)
            moved = rotations(key.quaternion)
            position = key.position + moved.apply(key.size * position)
            turn, size = moved * turn, key.size * size
        turned = np.einsum("nji,npj->npi", turn.as_matrix(), points - position[:, None])
        return np.asarray(turned / size[:, None])

    def body(self, pose: ObjectPose) -> Body:
        """Body for renderers, without parts."""
        return self._body(self.mesh, pose.apply(self.mesh.vertices))

    def static_mesh(self) -> Mesh:
        """Mesh in ``map`` at the initial pose."""
        return replace(self.mesh, vertices=self.initial_pose.apply(self.mesh.vertices))

    def static_body(self, mesh: Mesh) -> Body:
        """Body of :meth:`static_mesh`, perhaps with other colours and another texture."""
        return self._body(replace(mesh, vertices=self.mesh.vertices), mesh.vertices)

    def _body(self, mesh: Mesh, vertices: Array) -> Body:
        return Body(mesh, vertices.astype(np.float32), self._parts, self.instance, "object")

    @cached_property
    def _parts(self) -> NDArray[np.uint8]:
        return np.zeros(len(self.mesh.triangles), np.uint8)


def _box() -> Mesh:
    """Cube with sides of 1, centred. Its sides share no vertices: its edges are sharp in shading."""
    return Mesh(_cube_corners(), _BOX_FACES)


def _cube_corners() -> Array:
    """Corners (24, 3) of a cube, four for each side, counter-clockwise as seen from outside."""
    side = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    corners = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            one = np.insert(side if sign > 0 else side[::-1], 0, sign, axis=1)
            corners.append(np.roll(one, axis, axis=1))
    return np.concatenate(corners)


def _sphere() -> Mesh:
    """Sphere of diameter 1, centred."""
    rings = _SEGMENTS // 2
    polar = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    azimuth = np.linspace(0, 2 * np.pi, _SEGMENTS, endpoint=False)
    flat, height = np.sin(polar), np.broadcast_to(np.cos(polar), (rings - 1, _SEGMENTS))
    grid = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), height], -1).reshape(-1, 3)
    vertices = np.concatenate([grid, [[0, 0, 1], [0, 0, -1]]]) / 2
    i, j = np.arange(_SEGMENTS), (np.arange(_SEGMENTS) + 1) % _SEGMENTS
    none = np.full(_SEGMENTS, -1)
    top, bottom, last = len(grid), len(grid) + 1, len(grid) - _SEGMENTS
    faces = [np.column_stack([i, j, np.full(_SEGMENTS, top), none])]
    faces += [
        np.column_stack([i + low, j + low, j + low - _SEGMENTS, i + low - _SEGMENTS])
        for low in range(_SEGMENTS, len(grid), _SEGMENTS)
    ]
    faces += [np.column_stack([j + last, i + last, np.full(_SEGMENTS, bottom), none])]
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))


def _cylinder() -> Mesh:
    """Cylinder of diameter and height 1 along z, centred. Its caps share no vertices with its side."""
    azimuth = np.linspace(0, 2 * np.pi, _SEGMENTS, endpoint=False)
    ring = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros(_SEGMENTS)]) / 2
    half = np.array([0, 0, 0.5])
    low, high = ring - half, ring + half
    vertices = np.concatenate([low, high, low, high, [[0, 0, -0.5], [0, 0, 0.5]]])
    i, j = np.arange(_SEGMENTS), (np.arange(_SEGMENTS) + 1) % _SEGMENTS
    none, n = np.full(_SEGMENTS, -1), _SEGMENTS
    faces = [
        np.column_stack([i, j, j + n, i + n]),
        np.column_stack([j + 2 * n, i + 2 * n, np.full(n, 4 * n), none]),
        np.column_stack([i + 3 * n, j + 3 * n, np.full(n, 4 * n + 1), none]),
    ]
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))


#: Built-in meshes of 1 m, centred.
SHAPES = {"box": _box, "sphere": _sphere, "cylinder": _cylinder}
#: Colours of books.
BOOKS: tuple[Color, ...] = (
    *((150, 60, 52), (58, 84, 120), (196, 176, 130)),
    *((70, 100, 76), (60, 56, 62), (206, 204, 196)),
)


@dataclass(frozen=True)
class _Part:
    """A box: its centre and size in metres, its colour (None for the main colour), and a turn about z."""

    center: Sequence[float]
    size: Sequence[float]
    color: Sequence[int] | None = None
    turn_deg: float = 0.0


@dataclass(frozen=True)
class Furniture:
    """One kind of furniture: a row of config/furniture.json.

    Attributes:
        description: A line for people, with its size.
        color: Main colour, sRGB.
        roughness: Roughness of its surface, 0 to 1.
        parts: The boxes that it is made of.
    """

    description: str
    color: Color
    roughness: float
    parts: Sequence[_Part]

    def mesh(self, color: Color | None = None) -> Mesh:
        """Mesh in metres; ``color`` in place of the main colour."""
        main = self.color if color is None else color
        vertices = np.concatenate([_corners(part) for part in self.parts])
        faces = np.concatenate([_BOX_FACES + 24 * number for number in range(len(self.parts))])
        colors = np.repeat([main if part.color is None else part.color for part in self.parts], 24, axis=0)
        material = Material(roughness=self.roughness, double_sided=False)
        return Mesh(vertices, faces, colors=colors.astype(np.uint8), material=material)


_BOX_FACES = np.arange(24, dtype=np.int32).reshape(6, 4)


def _corners(part: _Part) -> Array:
    """Corners (24, 3) of a box, the same as in :func:`_cube_corners`."""
    angle = np.radians(part.turn_deg)
    turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return np.asarray(_cube_corners() * part.size @ turn + part.center)


#: Built-in furniture by name.
FURNITURE: dict[str, Furniture] = {
    name: Furniture(**row | {"color": tuple(row["color"]), "parts": [_Part(**part) for part in row["parts"]]})
    for name, row in read_table("furniture").items()
}
#: Descriptions of all built-in meshes by name.
BUILT_IN_MESHES: dict[str, str] = {
    "box": "box, 1 m along each axis, centred",
    "sphere": "sphere of diameter 1 m, centred",
    "cylinder": "cylinder of diameter and height 1 m along z, centred",
    **{name: f"{furniture.description}; on the floor" for name, furniture in FURNITURE.items()},
}


@dataclass(frozen=True, eq=False)
class Route:
    """A trajectory that something follows.

    Attributes:
        path: The trajectory.
        offset: Time that it is ahead of the scene, seconds.
        speed: Seconds of the trajectory per second.
    """

    path: Trajectory
    offset: float = 0.0
    speed: float = 1.0

    @classmethod
    def read(cls, config: TrajectoryConfig, source: SceneSource) -> Route:
        """Read the file of a section. Raises HumansimError, which names the key, relative to the section."""
        with in_section("file"):
            path = Trajectory.read(source.find_url(config.file), config.end)
        return cls(path, config.offset, config.speed)

    @property
    def duration(self) -> float:
        """Seconds until its end; 0 if it stands."""
        return self.path.duration / self.speed if self.speed else 0.0

    def at(self, seconds: float) -> ObjectPose:
        """Pose and velocity at a scene time in seconds."""
        time = self.speed * (seconds + self.offset)
        early, late = self.path.difference_times(time, VELOCITY_STEP * max(self.speed, 1e-6))
        positions, rotations = zip(self.path.in_map(early), self.path.in_map(late), strict=True)
        velocity = Velocity.between(np.array(positions), np.array(rotations), late - early)
        return ObjectPose(*self.path.in_map(time), velocity=velocity.scaled(self.speed))


class Drive(Protocol):
    """What moves a carrier that follows commands. The same commands give the same way."""

    def at(self, seconds: float) -> ObjectPose:
        """Pose and velocity of ``base_link`` at a scene time in seconds."""

    def command(self, seconds: float, speed: float, turn: float) -> None:
        """Drive from a scene time on: metres per second, and radians per second to the left."""

    def place(self, seconds: float, x: float, y: float, yaw: float) -> None:
        """Stand somewhere else from a scene time on.

        Args:
            seconds: The scene time.
            x: Metres in ``map``.
            y: Metres in ``map``.
            yaw: Heading in radians from +x to the left.
        """

    def reset(self) -> None:
        """Forget all commands: it stands at its start."""


class Carrier(Protocol):
    """A thing that carries cameras and scanners: the robot."""

    @property
    def config(self) -> RobotConfig:
        """Its settings."""

    @property
    def route(self) -> Route | None:
        """Its way, if the way is the same in each run."""

    @property
    def base_frame(self) -> str:
        """Name of the frame ``base_link`` in messages."""

    @property
    def takes_commands(self) -> bool:
        """Whether it follows ``cmd_vel``."""

    @property
    def start(self) -> ObjectPose:
        """Pose of ``base_link`` at the start of the scene."""

    def base_at(self, seconds: float) -> ObjectPose:
        """Pose and velocity of ``base_link`` at a scene time."""

    def body_at(self, seconds: float, base: ObjectPose | None = None) -> ObjectPose:
        """Pose and velocity of its body at a scene time. ``base``: where ``base_link`` is, if it is known."""

    def base_of(self, body: ObjectPose, seconds: float) -> ObjectPose:
        """Pose of ``base_link`` at a scene time from the pose of its body, without velocity."""

    def drive(self) -> Drive | None:
        """What moves the robot by commands; None if another thing moves the robot."""


def robot_of_mount(mount: str | None, robot: Carrier | None) -> Carrier | None:
    """The robot that carries a thing with a key ``mount``; None without the key. ``robot``: the robot of the
    scene. Raises SceneError of this key if it has none."""
    if mount is None:
        return None
    if robot is None:
        raise SceneError("the scene has no robot: give it a section 'robot'", key="mount")
    return robot
