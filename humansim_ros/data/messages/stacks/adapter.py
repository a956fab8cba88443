"""Topics of other people stacks, and the frames of tf that their messages may be in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from humansim_ros.data.messages import parts
from humansim_ros.data.messages.headers import WORLD_FRAME, optical_frame
from humansim_ros.data.messages.scanners import scanner_frame
from humansim_ros.data.messages.topic import Topic
from humansim_ros.data.messages.types import Point, Pose, Vector3
from humansim_ros.errors import SceneError, unknown
from humansim_ros.geometry import ObjectPose, multiply_quaternions, quaternion_to_matrix
from humansim_ros.scene.core import CameraPose, Frame, Robot, Scene, SceneCamera
from humansim_ros.scene.features import ROBOT, SceneScanner
from humansim_ros.types import Array

_ORIGIN = ObjectPose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


@dataclass(frozen=True)
class AdapterTopic(Topic[Frame]):
    """Topic of an adapter: messages of another people stack, built from the ground truth of a frame.

    Attributes:
        people: Whether the topic needs joints and vertices of the humans.
        inputs: Other topics of the same camera that this topic is built from: keys of :data:`CAMERA_INPUTS`.
            If the topic is ``optional``, they are received only while it has subscribers.
        posed: Name of the camera with the pose that the topic needs. Empty if the topic needs no pose.
        repeated: Whether messages are sent again while there are no frames, since subscribers are volatile.
        row: Name of the adapter, a key of :data:`ADAPTERS`.
    """

    content: Callable[[Frame], Frame] = field(default=lambda frame: frame)
    shown: bool = True
    people: bool = True
    inputs: tuple[str, ...] = ()
    posed: str = ""
    repeated: bool = False
    row: str = ""

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
        pose: Pose of the frame in ``map`` at a frame of the scene.
        camera: Name of the camera if this frame is an optical frame. Empty for other frames.
    """

    frame_id: str
    pose: Callable[[Frame], ObjectPose | CameraPose]
    camera: str = ""

    def at(self, frame: Frame) -> FrameAxes:
        """Pose of this tf frame at the time of a frame of the scene."""
        pose = self.pose(frame)
        return FrameAxes(pose.position, pose.rotation)


@dataclass(frozen=True)
class FrameAxes:
    """Pose of a tf frame in ``map``: position (3,) and quaternion (4,) xyzw. The methods convert from ``map``
    to the tf frame. Velocities stay relative to the ground and are only rotated: the motion of the tf frame
    is not subtracted, since receivers only rotate velocities, too (docs/people_messages.md)."""

    position: Array
    rotation: Array

    def point(self, point: Array) -> Point:
        """Convert a point (3,) of ``map`` to a message in this frame."""
        return parts.point(self._back @ (point - self.position))

    def vector(self, vector: Array) -> Vector3:
        """Convert a vector (3,) in the axes of ``map`` to a message in the axes of this frame."""
        return parts.vector(self._back @ vector)

    def pose(self, position: Array, rotation: Array) -> Pose:
        """Convert a pose in ``map`` (position (3,), quaternion (4,) xyzw) to a message in this frame."""
        turned = multiply_quaternions(self.rotation * (-1, -1, -1, 1), rotation)
        return Pose(position=self.point(position), orientation=parts.quaternion(turned))

    @property
    def _back(self) -> Array:
        """Rotation (3, 3) from ``map`` to the frame."""
        return np.asarray(quaternion_to_matrix(self.rotation).T)


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
        """Find a frame of tf by its name in scene files, which is without prefix. Raises SceneError if the
        scene has no such frame."""
        scene, prefix = self.scene, self._prefix
        frames = {WORLD_FRAME: Placed(WORLD_FRAME, lambda _: _ORIGIN)}
        if (robot := scene.robot) is not None:
            start, odom, base = robot.start, robot.config.odom_frame, robot.config.base_frame
            frames[odom] = Placed(odom, lambda _: start)
            frames[base] = Placed(base, partial(_base_pose, robot))
        for name, camera in scene.scene_cameras.items():
            own = optical_frame(name)
            frames[own] = Placed(f"{prefix}{own}", partial(_camera_pose, camera), name)
        for name, scanner in scene.scanners.items():
            own = scanner_frame(name)
            frames[own] = Placed(f"{prefix}{own}", partial(_scanner_pose, scanner))
        if frame_id not in frames:
            raise self.error(unknown("frame", frame_id, frames, "the scene"), "frame")
        return frames[frame_id]


def _base_pose(robot: Robot, frame: Frame) -> ObjectPose:
    """Pose of ``base_link`` in ``map``: unlike the body of the robot, ``base_link`` does not vibrate."""
    seconds = frame.scene_time * 1e-9
    return robot.base_of(frame.objects.get(ROBOT) or robot.body_at(seconds), seconds)


def _camera_pose(camera: SceneCamera, frame: Frame) -> CameraPose:
    """True pose of the optical frame of a camera in ``map``, even if the calibration states a wrong pose."""
    calibrated = frame.camera_poses.get(camera.name) or CameraPose.of(camera.camera)
    return camera.true_pose(calibrated, frame.scene_time * 1e-9)


def _scanner_pose(scanner: SceneScanner, frame: Frame) -> ObjectPose:
    return scanner.pose(frame.scene_time * 1e-9, frame.objects.get(ROBOT))
