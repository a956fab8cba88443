"""Topics of other people stacks, and the frames of tf that their messages may be in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from humansim_ros.data.messages.headers import WORLD_FRAME, optical_frame
from humansim_ros.data.messages.scanners import scanner_frame
from humansim_ros.data.messages.topic import Topic
from humansim_ros.data.messages.types import (
    MESSAGE_PACKAGES,
    MessagePackage,
    Point,
    Pose,
    Quaternion,
    Vector3,
)
from humansim_ros.errors import SceneError, unknown
from humansim_ros.geometry import multiply_quaternions, quaternion_to_matrix
from humansim_ros.scene.core import CameraPose, Frame, Scene
from humansim_ros.scene.features import ROBOT
from humansim_ros.types import Array

VISION_MSGS, PEOPLE_MSGS, SPENCER_MSGS = (
    MESSAGE_PACKAGES[name] for name in ("vision_msgs", "people_msgs", "spencer_tracking_msgs")
)


@dataclass(frozen=True)
class AdapterTopic(Topic[Frame]):
    """Topic of an adapter: messages of another people stack, built from the ground truth of a frame.

    Attributes:
        package: Package of the messages.
        people: Whether the topic needs joints and vertices of the humans.
        inputs: Other topics of the same camera that this topic is built from: keys of :data:`CAMERA_INPUTS`.
        posed: Name of the camera with the pose that the topic needs. Empty if the topic needs no pose.
        repeated: Whether messages are sent again while there are no frames, since subscribers are volatile.
        on_demand: Whether ``inputs`` are received only while this topic has subscribers.
        row: Name of the adapter, a key of :data:`ADAPTERS`.
    """

    package: MessagePackage = VISION_MSGS
    people: bool = True
    inputs: tuple[str, ...] = ()
    posed: str = ""
    repeated: bool = False
    on_demand: bool = False
    row: str = ""

    @classmethod
    def of(
        cls,
        package: MessagePackage,
        message: str,
        name: str,
        build: Callable[[Frame, int], Any],
        **settings: Any,
    ) -> AdapterTopic:
        """Create a topic.

        Args:
            package: Package of the messages.
            message: Name of the message in the package.
            name: Relative name.
            build: Builds the message from a frame and a stamp in nanoseconds.
            settings: Other attributes of the topic.

        Raises:
            RosError: See :meth:`MessagePackage.message`.
        """
        kind = package.message(message)
        return cls(name, kind, build, lambda frame: frame, package=package, shown=True, **settings)

    def messages(self, frame: Frame, stamp: int) -> list[Any]:
        """Build the messages of a frame. Most topics have one message per frame; some have any number."""
        built = self.build(frame, stamp)
        return built if isinstance(built, list) else [built]

    def sent(self, frame: Frame) -> list[tuple[int, Any]]:
        """Messages of a frame of a simulation, each with the time in nanoseconds when it is sent."""
        if self.per_frame and self.camera and self.camera not in frame.views:
            return []
        return [(frame.stamp, message) for message in self.messages(frame, frame.stamp)]


@dataclass(frozen=True)
class Placed:
    """A frame of tf.

    Attributes:
        frame_id: Name of the frame.
        pose: Position (3,) and quaternion (4,) xyzw in ``map`` at a frame of the scene; None for ``map``.
        camera: Name of the camera if this frame is an optical frame. Empty for other frames.
    """

    frame_id: str
    pose: Callable[[Frame], tuple[Array, Array]] | None = None
    camera: str = ""

    def at(self, frame: Frame) -> FrameAxes:
        """Pose of this tf frame at the time of a frame of the scene."""
        return FrameAxes() if self.pose is None else FrameAxes(*self.pose(frame))


@dataclass(frozen=True)
class FrameAxes:
    """Pose of a tf frame in ``map``. The methods convert from ``map`` to the tf frame. Velocities stay
    relative to the ground and are only rotated: the motion of the tf frame is not subtracted, since receivers
    only rotate velocities, too (docs/people_messages.md)."""

    position: Array = field(default_factory=lambda: np.zeros(3))
    rotation: Array = field(default_factory=lambda: np.array([0.0, 0.0, 0.0, 1.0]))

    def point(self, point: Array) -> Point:
        """Convert a point (3,) of ``map`` to a message in this frame."""
        x, y, z = (quaternion_to_matrix(self.rotation).T @ (point - self.position)).tolist()
        return Point(x=x, y=y, z=z)

    def vector(self, vector: Array) -> Vector3:
        """Convert a vector (3,) in the axes of ``map`` to a message in the axes of this frame."""
        x, y, z = (quaternion_to_matrix(self.rotation).T @ vector).tolist()
        return Vector3(x=x, y=y, z=z)

    def pose(self, position: Array, rotation: Array) -> Pose:
        """Convert a pose in ``map`` (position (3,), quaternion (4,) xyzw) to a message in this frame."""
        turned = multiply_quaternions(self.rotation * (-1, -1, -1, 1), rotation)
        x, y, z, w = turned.tolist()
        return Pose(position=self.point(position), orientation=Quaternion(x=x, y=y, z=z, w=w))


def section_of(adapter: str) -> str:
    """Section of a scene file with the settings of an adapter; ROS4HRI has its own section."""
    return adapter if adapter == "hri" else f"adapters.{adapter}"


class AdapterScene:
    """Looks up cameras and tf frames of a scene for an adapter. An unknown name is an error.

    Args:
        scene: The scene.
        adapter: Name of the adapter.
        frame_prefix: Text before the names of the frames of cameras and scanners.
    """

    def __init__(self, scene: Scene, adapter: str, frame_prefix: str = "") -> None:
        self.scene, self._prefix, self._key = scene, frame_prefix, section_of(adapter)

    def error(self, text: str, key: str) -> SceneError:
        """Make an error about a key in the settings of the adapter."""
        return SceneError(text, key=f"{self._key}.{key}")

    def camera(self, name: str, key: str) -> str:
        """Return the name of a camera if the scene has this camera. Otherwise raises SceneError, which names
        ``key``."""
        if name not in self.scene.scene_cameras:
            raise self.error(unknown("camera", name, self.scene.scene_cameras, "the scene"), key)
        return name

    def optical(self, camera: str) -> str:
        """Name of the optical frame of a camera."""
        return f"{self._prefix}{optical_frame(camera)}"

    def placed(self, frame_id: str) -> Placed:
        """Find a frame of tf. Raises SceneError if the scene has no such frame."""
        frames = self._frames()
        if frame_id not in frames:
            raise self.error(unknown("frame", frame_id, frames, "the scene"), "frame")
        return frames[frame_id]

    def _frames(self) -> dict[str, Placed]:
        """All tf frames of the scene by their name in scene files, which is without prefix."""
        scene, prefix = self.scene, self._prefix
        frames = {WORLD_FRAME: Placed(WORLD_FRAME)}
        if (robot := scene.robot) is not None:
            start = robot.start.position, robot.start.rotation
            odom, base = robot.config.odom_frame, robot.config.base_frame
            frames[odom] = Placed(odom, lambda _: start)
            frames[base] = Placed(base, partial(_base_pose, scene))
        for name in scene.scene_cameras:
            frames[optical_frame(name)] = Placed(
                f"{prefix}{optical_frame(name)}", partial(_camera_pose, scene, name), name
            )
        for name in scene.scanners:
            frames[scanner_frame(name)] = Placed(
                f"{prefix}{scanner_frame(name)}", partial(_scanner_pose, scene, name)
            )
        return frames


def _base_pose(scene: Scene, frame: Frame) -> tuple[Array, Array]:
    """Pose of ``base_link`` in ``map``: unlike the body of the robot, ``base_link`` does not vibrate."""
    robot, seconds = scene.robot, frame.scene_time * 1e-9
    assert robot is not None
    base = robot.base_of(frame.objects.get(ROBOT) or robot.body_at(seconds), seconds)
    return base.position, base.rotation


def _camera_pose(scene: Scene, name: str, frame: Frame) -> tuple[Array, Array]:
    """True pose of the optical frame of a camera in ``map``, even if the calibration states a wrong pose."""
    camera = scene.scene_cameras[name]
    calibrated = frame.camera_poses.get(name) or CameraPose.of(camera.camera)
    pose = camera.true_pose(calibrated, frame.scene_time * 1e-9)
    return pose.position, pose.rotation


def _scanner_pose(scene: Scene, name: str, frame: Frame) -> tuple[Array, Array]:
    pose = scene.scanners[name].pose(frame.scene_time * 1e-9, frame.objects.get(ROBOT))
    return pose.position, pose.rotation
