"""The robot of a scene: a moving object that carries cameras (docs/robots.md)."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from humansim_ros.cameras.camera import Trajectory
from humansim_ros.errors import in_section
from humansim_ros.geometry import (
    ObjectPose,
    Velocity,
    multiply_quaternions,
    quaternion_to_matrix,
    rotation_vector_to_quaternion,
)
from humansim_ros.scene.config.config import ObjectConfig, SceneConfig
from humansim_ros.scene.core.features import Draft, Feature
from humansim_ros.scene.core.looks import random_numbers
from humansim_ros.scene.core.objects import Route, SceneObject
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.robot import ROBOT, PathConfig, RobotConfig, VibrationConfig
from humansim_ros.types import Array

#: Sines of each axis of a vibration, and the share of its middle frequency by which theirs differ from it.
_SINES, _SPREAD = 4, 0.4
#: Commands that a drive remembers, for jumps back in time.
_MOST_COMMANDS = 20_000


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

    @classmethod
    def build(cls, config: RobotConfig, source: SceneSource) -> Robot:
        """Create a robot from its section. Raises HumansimError, which names the key, relative to the
        section."""
        if config.path is not None:
            return cls(config, Route(path_trajectory(config.path)))
        if config.trajectory is None:
            return cls(config)
        with in_section("trajectory"):
            return cls(config, Route.read(config.trajectory, source))

    @classmethod
    def of_scene(cls, config: SceneConfig, source: SceneSource) -> Robot | None:
        """The robot of a scene, if it has one. Raises HumansimError, which names the key."""
        if config.robot is None:
            return None
        with in_section(ROBOT):
            return cls.build(config.robot, source)

    @property
    def base_frame(self) -> str:
        """Name of the frame ``base_link`` in messages."""
        return self.config.base_frame

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


def robot_object(robot: Robot, source: SceneSource) -> SceneObject:
    """The robot as an object without label. Raises HumansimError, which names the key, relative to its
    section."""
    config = robot.config
    color = {} if config.color is None else {"color": config.color}
    section = ObjectConfig(mesh=config.mesh, size=config.size, **color)
    item = SceneObject.build(ROBOT, section, source, None, 0)
    start = replace(robot.body_at(0.0), size=item.initial_pose.size)
    return replace(item, initial_pose=start, pose_at=robot.body_at, key=ROBOT)


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


def path_trajectory(config: PathConfig) -> Trajectory:
    """Trajectory of ``base_link`` along the points of a path: lines, and turns on the spot before them."""
    points = list(config.points)
    if config.end == "loop" and points[0] != points[-1]:
        points.append(points[0])
    lines = np.diff(np.array(points), axis=0)
    headings = np.arctan2(lines[:, 1], lines[:, 0])
    if config.end == "loop":
        headings = np.append(headings, headings[0])
    time, rows = 0.0, [(0.0, *points[0], float(headings[0]))]
    for number, line in enumerate(lines):
        time += float(np.hypot(*line)) / config.speed
        yaw = rows[-1][3]
        rows.append((time, *points[number + 1], yaw))
        if number + 1 < len(headings):
            turn = math.remainder(headings[number + 1] - yaw, 2 * math.pi)
            # by halves: a turn by pi has two shortest arcs
            for share in (0.5, 1.0) if abs(turn) > 1e-9 else ():
                time += abs(turn) / 2 / math.radians(config.turn_deg)
                rows.append((time, *points[number + 1], yaw + share * turn))
    poses = [ObjectPose.on_floor(x, y, yaw) for _, x, y, yaw in rows]
    return Trajectory(
        np.array([row[0] for row in rows]),
        np.array([pose.position for pose in poses]),
        np.array([pose.rotation for pose in poses]),
        config.end,
    )


class RobotBody(Feature):
    """The section ``robot``."""

    def prepare(self, draft: Draft) -> None:
        """Add the robot, which may carry cameras and scanners."""
        draft.robot = Robot.of_scene(draft.config, draft.source)
        assert draft.robot is not None
        with in_section(ROBOT):
            draft.robot_body = robot_object(draft.robot, draft.source)

    def furnish(self, draft: Draft) -> None:
        """Add the body of the robot."""
        assert draft.robot is not None and draft.robot_body is not None
        label = draft.next_label(draft.robot.config.label)
        draft.objects[ROBOT] = replace(draft.robot_body, instance=label)


FEATURE = RobotBody()
