"""Play a scene: its poses at any scene time, and motions that can be changed meanwhile.

The motion player and ``Simulation`` both use :class:`Playback`, so that they show the same frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from humansim_ros.errors import MotionError, SceneError, in_section
from humansim_ros.files.yaml import validated
from humansim_ros.geometry import ObjectPose, Velocity, multiply_quaternions, normalised
from humansim_ros.motion.body import JointPoses
from humansim_ros.motion.pose import WorldMotion
from humansim_ros.scene.config.config import MotionConfig
from humansim_ros.scene.core.actor import Actor, joint_poses_of
from humansim_ros.scene.core.camera import CameraPose
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.core.state import SceneState
from humansim_ros.scene.core.world import World, followed
from humansim_ros.scene.features.robot import ROBOT
from humansim_ros.types import Array

#: Keys that describe the motion file; another file starts with their defaults.
_FILE_KEYS = ("joint_names", "min_confidence", "unit", "up", "facing", "positions", "start", "end")
#: A change of these keys restarts a motion. After other changes the motion continues.
_RESTART_KEYS = {"file", "start", "end", "offset"}
#: After a change of these keys a motion continues at the same time of its first round.
_ROUND_KEYS = {"loop", "blend"}


@dataclass(frozen=True)
class Change:
    """A prepared change of one human's motion, for :meth:`Playback.apply`.

    Attributes:
        name: Name of the human.
        settings: Section ``motion`` after the change.
        actor: The human with the new motion.
        restarts: Whether the motion restarts. It continues otherwise.
        first_round: Whether a motion that continues does so in its first round.
    """

    name: str
    settings: MotionConfig
    actor: Actor
    restarts: bool
    first_round: bool


class Playback:
    """Humans, objects and cameras of a scene at any scene time, with motions that can be changed meanwhile.

    Attributes:
        scene: The scene.
        settings: Section ``motion`` of each human as it is now.
        actors: Humans as they are now, by name.
        world: Humans, objects and cameras as they are now, by name.
        elapsed: Scene time that was shown last, nanoseconds. Changes apply from there.
        drive: Commands of the robot, if it takes any.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.world = World()
        self.actors = {name: replace(actor, others=self.world) for name, actor in scene.actors.items()}
        self.world.fill(self.actors, scene.scene_cameras, self._placed)
        self.settings: dict[str, MotionConfig] = {
            name: scene.config.humans[name].motion for name in scene.actors
        }
        self.elapsed = 0
        #: Rotation and translation of each object that was put somewhere else than its keyframes do.
        self._shifts: dict[str, tuple[scipy.spatial.transform.Rotation, Array]] = {}
        robot = scene.robot
        self.drive = None if robot is None else robot.drive()
        #: Moving objects by name. An object that a human takes along follows the present motion.
        self._moving = {name: followed(item, self.world) for name, item in scene.moving_objects.items()}

    @property
    def version(self) -> int:
        """Number that grows with each change of the scene. Poses that were computed with a smaller number are
        out of date."""
        return self.world.version

    def show(self, elapsed: int, pace: float = 1.0) -> SceneState:
        """Poses at ``elapsed`` nanoseconds of the scene, with velocities per second of the wall clock.
        ``pace``: seconds of the scene per second of the wall clock."""
        self.elapsed = elapsed
        seconds = elapsed * 1e-9
        poses = {name: _paced(each, pace) for name, each in joint_poses_of(self.actors, seconds).items()}
        objects = {name: self._object_at(name, seconds) for name in self.scene.moving_objects}
        objects = {name: replace(place, velocity=_velocity(place, pace)) for name, place in objects.items()}
        cameras = {
            name: camera.pose(seconds)
            for name, camera in self.scene.moving_cameras.items()
            if camera.mount is None
        }
        cameras = {name: replace(pose, velocity=_velocity(pose, pace)) for name, pose in cameras.items()}
        shown = SceneState(
            scene_time=elapsed,
            scene=self.scene,
            actors=self.actors,
            motions=poses,
            objects=objects,
            cameras=cameras,
        )
        robot = self.scene.robot
        if robot is None:
            return shown
        base = robot.base_at(seconds) if self.drive is None else self.drive.at(seconds)
        return self.with_robot(shown, base, pace)

    def with_robot(self, shown: SceneState, base: ObjectPose, pace: float = 1.0) -> SceneState:
        """Poses of the scene time that was shown last, with the robot and its cameras somewhere else.

        Args:
            shown: The other poses.
            base: Pose of ``base_link`` in ``map``, with its velocity per second of the scene.
            pace: Seconds of the scene per second of the wall clock.
        """
        robot = self.scene.robot
        assert robot is not None
        seconds = self.elapsed * 1e-9
        body = robot.body_at(seconds, base)
        carried = {
            name: camera.pose(seconds, body)
            for name, camera in self.scene.moving_cameras.items()
            if camera.mount is not None
        }
        carried = {name: replace(pose, velocity=_velocity(pose, pace)) for name, pose in carried.items()}
        body = replace(self.scene.objects[ROBOT].placed(body), velocity=_velocity(body, pace))
        return replace(
            shown,
            objects={**shown.objects, ROBOT: body},
            cameras={**shown.cameras, **carried},
            robot=replace(base, velocity=_velocity(base, pace)),
        )

    def command(self, speed: float, turn: float) -> None:
        """Let the robot drive from the scene time that was shown last.

        Args:
            speed: Metres per second of the scene, forwards.
            turn: Radians per second of the scene, leftwards.

        Raises:
            SceneError: The scene has no robot that takes commands.
        """
        if self.drive is None:
            raise SceneError("the scene has no robot that takes commands", key=ROBOT)
        self.world.version += 1
        self.drive.command(self.elapsed * 1e-9, speed, turn)

    def change(self, name: str, **settings: Any) -> None:
        """Change the motion of a human from the scene time that was shown last.

        ``settings``: keys of a section ``motion`` of a scene file. Raises HumansimError, and changes nothing,
        if the motion cannot be played.
        """
        self.apply(self.prepare(name, settings))

    def prepare(self, name: str, settings: Mapping[str, Any], source: SceneSource | None = None) -> Change:
        """Read the files for a change without changing anything yet.

        The motion file is read only if ``settings`` has ``file``. Keys that describe the old file (joint
        table, unit, start, end …) get their defaults for another file, and the values of the scene for the
        scene's own file.

        Args:
            name: Name of the human.
            settings: Keys of a section ``motion`` of a scene file.
            source: Finds the files; the source of the scene if None.

        Raises:
            HumansimError: The motion cannot be played. The error names the key.
        """
        with in_section(f"humans.{name}.motion"):
            return self._prepare(name, settings, source or self.scene.source)

    def _prepare(self, name: str, settings: Mapping[str, Any], source: SceneSource) -> Change:
        old, before = self.settings[name], self.actors[name]
        new = _with(old, settings, self.scene.config.humans[name].motion)
        different = {key for key in MotionConfig.model_fields if getattr(new, key) != getattr(old, key)}
        different |= {"file"} & set(settings)
        if different <= {"speed"}:
            actor = replace(before, motion=replace(before.motion, speed=new.speed))
        elif (changed := before.with_changed_keys(different, new)) is not None:
            actor = changed
        else:
            read_again = different & {"file", "positions"}
            actor = before.with_motion(new, source, None if read_again else before.motion.motion)
        actor.motion.sample(0.0)  # compute the shared values of all frames now
        return Change(name, new, actor, bool(different & _RESTART_KEYS), bool(different & _ROUND_KEYS))

    def apply(self, change: Change) -> None:
        """Start the motion of a prepared change."""
        self.world.version += 1
        old, actor = self.actors[change.name], change.actor
        seconds = self.elapsed * 1e-9
        at = 0.0
        if not change.restarts:
            at = float(old.motion.file_times(seconds + old.offset, old.ahead)[0])
            at = _in_round(old.motion, at) if change.first_round else at
        ahead = at - actor.motion.speed * (seconds + actor.offset)
        self.actors[change.name] = replace(actor, ahead=ahead)
        self.settings[change.name] = change.settings

    def _placed(self, name: str, seconds: float) -> ObjectPose:
        """Pose of an object, static or moving, at a scene time in seconds."""
        item = self.scene.objects[name]
        if name == ROBOT and self.drive is not None:
            return item.placed(self.drive.at(seconds))
        return self._object_at(name, seconds) if item.moves else item.initial_pose

    def _object_at(self, name: str, seconds: float) -> ObjectPose:
        pose = self._moving[name].at(seconds)
        if name not in self._shifts:
            return pose
        turn, offset = self._shifts[name]
        position = turn.apply(pose.position) + offset
        rotation = multiply_quaternions(turn.as_quat(), normalised(pose.rotation))
        velocity = pose.velocity
        if velocity is not None:
            velocity = Velocity(turn.apply(velocity.linear), turn.apply(velocity.angular))
        return replace(pose, position=position, rotation=rotation, velocity=velocity)

    def place_object(self, name: str, position: Array, rotation: Array) -> None:
        """Put a moving object somewhere else now. Its keyframes move it on from there. ``name``: name of the
        object. ``position``: (3,) in ``map``, metres. ``rotation``: (4,) quaternion xyzw."""
        if name == ROBOT and self.drive is not None:
            yaw = scipy.spatial.transform.Rotation.from_quat(rotation).as_euler("xyz")[2]
            self.drive.place(self.elapsed * 1e-9, float(position[0]), float(position[1]), float(yaw))
            self.world.version += 1
            return
        pose = self._moving[name].at(self.elapsed * 1e-9)
        rotate = scipy.spatial.transform.Rotation.from_quat
        turn = rotate(rotation) * rotate(pose.rotation).inv()
        self._shifts[name] = turn, position - turn.apply(pose.position)
        self.world.version += 1

    def reset_objects(self) -> None:
        """Put all moving objects where their keyframes do, and the robot at its start."""
        self._shifts = {}
        if self.drive is not None:
            self.drive.reset()
        self.world.version += 1

    def human_pose(self, name: str) -> ObjectPose:
        """Pose of a human on the floor, by its motion, at the scene time that was shown last."""
        actor = self.actors[name]
        poses, hips = actor.joint_poses(self.elapsed * 1e-9), actor.motion.match.roles["Hips"]
        x, y, _ = poses.positions[0, hips]
        ahead = scipy.spatial.transform.Rotation.from_quat(poses.rotations[0, hips]).apply([1.0, 0.0, 0.0])
        velocity = None
        if poses.linear is not None and poses.angular is not None:
            change = np.cross(poses.angular[0, hips], ahead)
            flat = max(float(ahead[:2] @ ahead[:2]), 1e-9)  # of somebody who lies on the back
            rate = (ahead[0] * change[1] - ahead[1] * change[0]) / flat
            velocity = Velocity(poses.linear[0, hips] * (1, 1, 0), np.array([0.0, 0.0, rate]))
        return ObjectPose.on_floor(x, y, float(np.arctan2(ahead[1], ahead[0])), velocity)

    def rewind(self) -> None:
        """Play all motions with their present settings from the start of the scene, without commands of the
        robot."""
        self.world.version += 1
        if self.drive is not None:
            self.drive.reset()
        for name, actor in self.actors.items():
            self.actors[name] = replace(actor, ahead=0.0)


def _with(old: MotionConfig, changes: Mapping[str, Any], of_scene: MotionConfig) -> MotionConfig:
    """Settings with changes. Raises MotionError with the wrong key."""
    values = old.model_dump()
    file = changes.get("file", old.file)
    if file != old.file:
        base = of_scene if file == of_scene.file else MotionConfig()
        values.update({key: getattr(base, key) for key in _FILE_KEYS})
        # times of hand keys are of the old file; a pose that holds all the time is of any
        if old.hands is None or any(key.time > 0 for key in old.hands):
            values["hands"] = base.hands
    return validated(MotionConfig, {**values, **changes}, MotionError)


def _in_round(motion: WorldMotion, played: float) -> float:
    """Seconds since the start of the current round of a motion."""
    length = motion.cycle_length
    if motion.loop == "none" or length <= 0:
        return float(np.clip(played, 0.0, length))
    return float(played % length)


def _velocity(pose: ObjectPose | CameraPose, pace: float) -> Velocity | None:
    return None if pose.velocity is None else pose.velocity.scaled(pace)


def _paced(poses: JointPoses, pace: float) -> JointPoses:
    if pace == 1 or poses.linear is None or poses.angular is None:
        return poses
    return replace(poses, linear=poses.linear * pace, angular=poses.angular * pace)
