"""Play a scene: its clock, its poses at any scene time, and motions that can be changed meanwhile.

The motion player and ``Simulation`` both use :class:`Playback`, so that they show the same frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

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
from humansim_ros.scene.core.human_state import standing_in
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
#: Nanoseconds by which a frame may be early; at most a tenth of a period.
_EARLY = 5_000_000


@dataclass(frozen=True)
class Tick:
    """One step of the playback clock.

    Attributes:
        stamp: Stamp of the frame, nanoseconds.
        elapsed: Scene time of the frame, nanoseconds.
        pace: Seconds of the scene per second; 0 while paused.
        dropped: Number of frames that were skipped before it.
        index: Number of the frame since the start of the clock, with those that were skipped.
    """

    stamp: int
    elapsed: int
    pace: float
    dropped: int = 0
    index: int = 0


class PlaybackClock:
    """Stamps of frames on a wall clock in nanoseconds, and the scene time of each.

    Frame k has the stamp start + round(k * period); :meth:`cut` sets a new start. Stamps increase, unless the
    wall clock is set (:meth:`shift`). The scene time follows the stamps at ``speed``, does not change while
    paused, and jumps only by :meth:`seek`.
    """

    def __init__(self, rate: float, speed: float = 1.0, seconds: float = 0.0) -> None:
        self.period = 1e9 / rate
        self.speed = speed
        self.paused = False
        self.elapsed = round(seconds * 1e9)
        self.last: int | None = None
        self._start = self._next = 0
        self._index = -1
        # stamp (None: of the next frame) and scene time from which the scene time is counted
        self._base: tuple[int | None, int] = (None, self.elapsed)
        self._steps = 0

    def due(self, now: int) -> Tick | None:
        """The newest frame that is due; None if there is none, as timers may be early."""
        if now <= 0:
            return None  # simulated time has not started: zero is never a stamp
        if self.last is None:
            return self.cut(now)
        frame = int((now - self._start + min(0.1 * self.period, _EARLY)) / self.period)
        if frame < self._next:
            return None
        dropped, self._next = frame - self._next, frame + 1
        return self._tick(self._start + round(frame * self.period), dropped)

    def next(self) -> Tick:
        """The next frame, whatever time it is; the first one has the stamp 1, as in ``Simulation``."""
        if self.last is None:
            return self.cut(1)
        self._next += 1
        return self._tick(self._start + round((self._next - 1) * self.period))

    def begin_at(self, stamp: int) -> int:
        """Let :meth:`next` begin with a later frame than the first one.

        Returns:
            Number of the first frame from stamp 1 on that is not before ``stamp``.
        """
        self._start, self._next = 1, max(0, math.ceil((stamp - 1) / self.period - 1e-6))
        self.last, self._base, self._index = 1, (1, self.elapsed), self._next - 1
        return self._next

    def cut(self, now: int) -> Tick:
        """A frame now; the next frames are counted from it."""
        stamp = now if self.last is None else max(now, self.last + 1)
        self._start, self._next = stamp, 1
        return self._tick(stamp)

    def shift(self, step: int) -> None:
        """Follow a wall clock that was set by ``step`` nanoseconds: stamps jump, scene time goes on."""
        since, elapsed = self._base
        self._start += step
        self._base = (None if since is None else since + step, elapsed)
        if self.last is not None:
            self.last += step

    def set_rate(self, rate: float) -> None:
        """Set the frames per second after the last frame."""
        self._rebase()
        self.period = 1e9 / rate
        if self.last is not None:
            self._start, self._next = self.last, 1

    def set_speed(self, speed: float) -> None:
        """Set the seconds of the scene per second after the last frame."""
        self._rebase()
        self.speed = speed

    def pause(self, paused: bool) -> None:
        """Pause at the scene time of the last frame, or continue from it."""
        self._rebase()
        self.paused = paused

    def step(self, now: int) -> Tick:
        """The next frame now, while paused."""
        self._steps += 1
        self.elapsed = self._base[1] + round(self._steps * self.period * (self.speed or 1.0))
        return self.cut(now)

    def seek(self, seconds: float) -> None:
        """Jump to a scene time with the next frame."""
        self.elapsed = round(seconds * 1e9)
        self._base, self._steps = (None, self.elapsed), 0

    def _rebase(self) -> None:
        self._base, self._steps = (self.last, self.elapsed), 0

    def _tick(self, stamp: int, dropped: int = 0) -> Tick:
        since, elapsed = self._base
        if since is None:
            self._base = (stamp, elapsed)
        elif not self.paused:
            self.elapsed = elapsed + round((stamp - since) * self.speed)
        self.last = stamp
        self._index += 1 + dropped
        return Tick(stamp, self.elapsed, 0.0 if self.paused else self.speed, dropped, self._index)


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

    def object_pose(self, name: str) -> ObjectPose:
        """Pose of an object, static or moving, at the scene time that was shown last."""
        return self._placed(name, self.elapsed * 1e-9)

    def human_pose(self, name: str) -> ObjectPose:
        """Pose of a human on the floor, at the scene time that was shown last."""
        actor = self.actors[name]
        return standing_in(actor.joint_poses(self.elapsed * 1e-9), actor.motion.match.roles["Hips"])

    def placement(self, name: str, position: Array, yaw: float) -> dict[str, Any]:
        """Settings of a motion for :meth:`prepare` that put a human somewhere else now.

        Args:
            name: Name of the human, without keyframes.
            position: (2,) where the hips are to be, metres in ``map``.
            yaw: Direction that they are to face, radians.
        """
        now, settings = self.human_pose(name), self.settings[name]
        turn = yaw - scipy.spatial.transform.Rotation.from_quat(now.rotation).as_euler("xyz")[2]
        cos, sin = np.cos(turn), np.sin(turn)
        anchor = position + np.array([[cos, -sin], [sin, cos]]) @ (settings.position - now.position[:2])
        return {"position": tuple(anchor.tolist()), "yaw_deg": settings.yaw_deg + float(np.degrees(turn))}

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


@dataclass(frozen=True)
class Entity:
    """A human, object or camera of a scene.

    Attributes:
        name: Unique name: the prefix of its topics, such as ``humans/walker``, ``objects/ball`` or ``left``.
        kind: Kind of entity.
        key: Name in its section of the scene file.
        moves: Whether the scene moves it: a motion, keyframes or a trajectory.
        description: Text for people.
    """

    name: str
    kind: Literal["human", "object", "camera"]
    key: str
    moves: bool
    description: str

    @property
    def tags(self) -> tuple[str, ...]:
        """Words by which it can be found."""
        return self.kind, "moving" if self.moves else "static"


def scene_entities(scene: Scene) -> dict[str, Entity]:
    """Entities of a scene by name."""
    entities = []
    for key, human in scene.actors.items():
        text = f"{scene.config.humans[key].body}, label {human.instance}"
        entities.append(Entity(f"humans/{key}", "human", key, True, text))
    for key, item in scene.objects.items():
        text = f"{item.shape}, label {item.instance}"
        entities.append(Entity(f"objects/{key}", "object", key, item.moves, text))
    for key, camera in scene.scene_cameras.items():
        text = "camera, {}x{} pixels".format(*camera.camera.size)
        entities.append(Entity(key, "camera", key, camera.moves, text))
    return {entity.name: entity for entity in entities}
