"""Objects of a scene, built-in meshes, and what moves things: keyframes, trajectories, a robot.

Furniture has metres and its own colours, and occludes people as in real rooms. Its origin is on the floor, in
the middle of what stands there. The front is towards +x, z is up. Parts share no vertices: their edges are
sharp in shading. The colour of a scene replaces the main colour.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

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
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from humansim_ros.motion.files import KeyframeTrack
from humansim_ros.render.interface import Body
from humansim_ros.scene.config.camera_config import TrajectoryConfig
from humansim_ros.scene.config.config import ObjectConfig
from humansim_ros.scene.core.looks import random_numbers
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.robot import RobotConfig, VibrationConfig
from humansim_ros.types import Array, Color

#: Segments around a sphere or a cylinder.
_SEGMENTS = 48
#: Sines of each axis of a vibration, and the share of its middle frequency by which theirs differ from it.
_SINES, _SPREAD = 4, 0.4
#: Commands that a drive remembers, for jumps back in time.
_MOST_COMMANDS = 20_000


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


@dataclass(frozen=True, eq=False)
class Vibration:
    """Sum of sines along and about each axis of a robot.

    ``config``: its settings. Its phases and frequencies follow from the seed.
    """

    config: VibrationConfig

    @cached_property
    def _sines(self) -> Array:
        """Amplitude, angular frequency and phase (3, 6, 4) of the sines of each axis."""
        uniform = random_numbers(self.config.seed, "vibration")
        draws = np.array([uniform() for _ in range(2 * 6 * _SINES)]).reshape(2, 6, _SINES)
        middle = 2 * np.pi * self.config.frequency
        deviations = np.repeat([self.config.position, math.radians(self.config.rotation_deg)], 3)
        amplitude = np.repeat(deviations[:, None] * math.sqrt(2 / _SINES), _SINES, axis=1)
        return np.stack([amplitude, middle * (1 + _SPREAD * (2 * draws[0] - 1)), 2 * np.pi * draws[1]])

    def at(self, seconds: float) -> ObjectPose:
        """Pose and velocity in the axes of the robot at a scene time in seconds."""
        amplitude, frequency, phase = self._sines
        angle = frequency * seconds + phase
        offset = (amplitude * np.sin(angle)).sum(axis=1)
        rate = (amplitude * frequency * np.cos(angle)).sum(axis=1)
        turn, turn_rate = offset[3:], rate[3:]
        # angular velocity of a rotation vector, to the second order of its small angle
        angular = turn_rate + np.cross(turn, turn_rate) / 2
        velocity = Velocity(rate[:3], angular)
        return ObjectPose(offset[:3], rotation_vector_to_quaternion(turn), velocity=velocity)


@dataclass(frozen=True, eq=False)
class Robot:
    """What moves the robot of a scene.

    Attributes:
        config: Its settings.
        route: Its way, if it is the same in each run.
    """

    config: RobotConfig
    route: Route | None = None

    @property
    def takes_commands(self) -> bool:
        """Whether it follows ``cmd_vel``."""
        return self.route is None and self.config.odometry is None

    def drive(self) -> CommandedDrive | None:
        """What moves the robot by commands; None if another thing moves the robot."""
        return CommandedDrive(self) if self.takes_commands else None

    @cached_property
    def start(self) -> ObjectPose:
        """Pose of ``base_link`` at the start of the scene, where its odometry begins."""
        return self.base_at(0.0)

    def base_at(self, seconds: float) -> ObjectPose:
        """Pose and velocity of ``base_link`` at a scene time; of a robot without route at its start."""
        if self.route is not None:
            return self.route.at(seconds)
        return ObjectPose.on_floor(*self.config.position, math.radians(self.config.yaw_deg))

    def body_at(self, seconds: float, base: ObjectPose | None = None) -> ObjectPose:
        """Pose and velocity of its body at a scene time, with vibration. ``base``: where ``base_link`` is
        then; as :meth:`base_at` says if None."""
        base = self.base_at(seconds) if base is None else base
        return base if self._vibration is None else base.carry(self._vibration.at(seconds))

    def base_of(self, body: ObjectPose, seconds: float) -> ObjectPose:
        """Pose of ``base_link`` at a scene time from the pose of its body, without velocity."""
        if self._vibration is None:
            return replace(body, velocity=None)
        shaken = self._vibration.at(seconds)
        rotation = multiply_quaternions(body.rotation, shaken.rotation * (-1, -1, -1, 1))
        position = body.position - quaternion_to_matrix(rotation) @ shaken.position
        return ObjectPose(position, rotation)

    @cached_property
    def _vibration(self) -> Vibration | None:
        return None if self.config.vibration is None else Vibration(self.config.vibration)


class _Command(NamedTuple):
    """Place of a drive at a scene time in seconds, and its velocities from then on."""

    seconds: float
    x: float
    y: float
    yaw: float
    speed: float
    turn: float


class CommandedDrive:
    """Differential drive that follows commands; the same commands give the same way.

    Between two commands it drives an arc, which is computed exactly. Limits and timeout come from the
    settings of the robot.
    """

    def __init__(self, robot: Robot) -> None:
        self._config = robot.config
        self._commands: list[_Command] = []
        self.reset()

    def reset(self) -> None:
        """Forget all commands: it stands at its start."""
        x, y = self._config.position
        self._commands = [_Command(-math.inf, x, y, math.radians(self._config.yaw_deg), 0.0, 0.0)]

    def command(self, seconds: float, speed: float, turn: float) -> None:
        """Drive from a scene time on: metres per second, and radians per second to the left."""
        limit, turn_limit = self._config.max_speed, math.radians(self._config.max_turn_deg)
        speed, turn = min(max(speed, -limit), limit), min(max(turn, -turn_limit), turn_limit)
        self._add(_Command(seconds, *self._place(seconds), speed, turn))

    def place(self, seconds: float, x: float, y: float, yaw: float) -> None:
        """Stand somewhere else from a scene time on.

        Args:
            seconds: The scene time.
            x: Metres in ``map``.
            y: Metres in ``map``.
            yaw: Heading in radians from +x to the left.
        """
        self._add(_Command(seconds, x, y, yaw, 0.0, 0.0))

    def at(self, seconds: float) -> ObjectPose:
        """Pose and velocity of ``base_link`` at a scene time in seconds."""
        x, y, yaw = self._place(seconds)
        command = self._command_at(seconds)
        drives = seconds - command.seconds < self._config.timeout
        speed, turn = (command.speed, command.turn) if drives else (0.0, 0.0)
        linear = np.array([speed * math.cos(yaw), speed * math.sin(yaw), 0.0])
        return ObjectPose.on_floor(x, y, yaw, Velocity(linear, np.array([0.0, 0.0, turn])))

    def _add(self, command: _Command) -> None:
        later = bisect_right(self._commands, command.seconds, key=lambda each: each.seconds)
        self._commands[later:] = [command]
        if len(self._commands) > _MOST_COMMANDS:
            del self._commands[1 : _MOST_COMMANDS // 2]

    def _command_at(self, seconds: float) -> _Command:
        later = bisect_right(self._commands, seconds, key=lambda each: each.seconds)
        return self._commands[later - 1]

    def _place(self, seconds: float) -> tuple[float, float, float]:
        """Position x, y and heading."""
        command = self._command_at(seconds)
        time = min(seconds - command.seconds, self._config.timeout)
        half = command.turn * time / 2
        # chord of the arc
        chord = command.speed * time * (math.sin(half) / half if abs(half) > 1e-9 else 1.0)
        x = command.x + chord * math.cos(command.yaw + half)
        y = command.y + chord * math.sin(command.yaw + half)
        return x, y, command.yaw + 2 * half


def robot_of_mount(mount: str | None, robot: Robot | None) -> Robot | None:
    """The robot that carries a thing with a key ``mount``; None without the key. ``robot``: the robot of the
    scene. Raises SceneError of this key if it has none."""
    if mount is None:
        return None
    if robot is None:
        raise SceneError("the scene has no robot: give it a section 'robot'", key="mount")
    return robot
