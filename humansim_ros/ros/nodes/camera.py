"""Node ``camera``: renders one camera of a scene.

In a running scene the node has the name of its camera.

Subscribes to ``humans/<id>/vertices`` and ``joints`` of every human, ``objects/<name>/marker`` and ``twist``
of every moving object, and the camera's own ``pose`` and ``twist`` if it has a trajectory, and synchronizes
them by exact stamp. Publishes images and ground truth with that stamp. Only subscribed topics are rendered.
Like camera drivers, the node has ``camera_info``, ``set_camera_info`` and ``camera_info_url``
(docs/lenses.md).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, TransformStamped

from humansim_ros.data import messages
from humansim_ros.data.messages import CameraTopics, PublishedCalibration, Topic, read_lens
from humansim_ros.errors import HumansimError, RosError, SceneError, located, printable, unknown
from humansim_ros.geometry import matrix_to_quaternion, quaternion_to_matrix, slerp
from humansim_ros.render.interface import comparing_with
from humansim_ros.ros.graph.qos import NEWEST
from humansim_ros.ros.nodes.frame_synchronizer import FrameSynchronizer
from humansim_ros.ros.nodes.publishers import CalibrationService, CameraDriver, CameraPublishers
from humansim_ros.ros.playing.clock import PictureTimer
from humansim_ros.ros.processes.node import SceneNode
from humansim_ros.ros.processes.transforms import TransformSender
from humansim_ros.scene.core import CameraPose, CameraShot, Frame, Needs, Scene, SceneCamera, SceneState
from humansim_ros.types import Image

#: Most received poses that are stored, since frames are a little older than the newest pose.
_MAX_POSES = 200
#: A pose that is ahead of a frame by this time, nanoseconds, has a stamp of another clock.
_MAX_AHEAD = 5_000_000_000
#: A camera counts as moving for this time after its last motion, nanoseconds, since poses may come less often
#: than frames.
_MOVING_FOR = 1_000_000_000


class CameraPosePublisher:
    """Publishes ``<camera>/extrinsics`` and ``projection``, both latched, and tf.

    A static camera publishes once, a moving camera with the stamp of every frame. A camera on a robot
    publishes one transform in tf, relative to ``base_link``. Messages on ``<camera>/pose`` (optical frame in
    ``map``) move any other camera. Poses are interpolated, and the camera stays at the last pose. A pose with
    a stamp far ahead comes from another clock, and holds from the present frame on. If the calibration is
    wrong, these topics are wrong, too, and ``<camera>/truth/extrinsics`` has the true pose.
    """

    def __init__(self, node: SceneNode, camera: SceneCamera, topics: CameraTopics) -> None:
        self._node = node
        self._topics = topics
        self._camera = camera
        self._poses: deque[tuple[int, CameraPose]] = deque(maxlen=_MAX_POSES)
        #: Pose before the first of _poses, and pose of the last frame.
        self._start = self._last = CameraPose.of(camera.camera)
        self._last_stamp = self._last_motion = 0
        self._newest_projection: Any = None
        self._extrinsics, self._projection = map(node.topic_publisher, (topics.extrinsics, topics.projection))
        for topic in topics.depth_extrinsics:
            node.publish_latched(topic.message(Frame(0, node.now(), {}, {})), topic.name)
        self._true_extrinsics = topics.true_extrinsics
        if self._true_extrinsics is not None:
            self._true_publisher = node.topic_publisher(self._true_extrinsics)
            self._publish_true(CameraPose.of(camera.camera), node.now())
        stamp = node.now()
        self._publish(self._last, stamp)
        self._transforms = TransformSender(node, topics.transforms, stamp)
        if not camera.moves:
            node.create_subscription(topics.pose.type, topics.pose.name, self._on_pose, NEWEST)

    def shot(self, state: SceneState) -> CameraShot:
        """Shot of the camera at a scene state, without channels. Publishes the camera's pose with the stamp
        of the state."""
        shot, pose = state.shot(self._camera), state.calibrated_pose(self._camera)
        if self._poses and state.stamp < self._last_stamp:
            self._follow_clock(self._last_stamp, state.stamp)
        self._last_stamp = state.stamp
        if self._poses:
            self._restamp_poses_ahead(state.stamp)
            if self._pose_at(state.stamp) is not self._last:  # a resting camera has the same object
                self._last_motion = state.stamp
            shot = replace(
                shot,
                pose_at=lambda seconds: self._camera.true_pose(
                    self._pose_at(state.stamp + round(1e9 * seconds)), state.scene_time * 1e-9 + seconds
                ),
                moving=self._camera.drifts or abs(state.stamp - self._last_motion) < _MOVING_FOR,
            )
            pose = self._pose_at(state.stamp)
        self._last = pose
        if self._camera.moves or self._poses:
            # a lookup in tf at the stamp of a frame needs a transform with that stamp
            transform = self._publish(pose, state.stamp)
            if self._topics.extrinsics in self._topics.transforms:
                self._transforms.send(transform)
        if self._camera.moves or self._poses or self._camera.drifts:
            self._publish_true(shot.pose_at(0.0), state.stamp)
        return shot

    def _publish_true(self, pose: CameraPose, stamp: int) -> None:
        """Publish the true pose of a camera with a wrong calibration."""
        if self._true_extrinsics is not None:
            self._true_publisher.publish(self._true_extrinsics.build(self._camera.camera_at(pose), stamp))

    def _restamp_poses_ahead(self, stamp: int) -> None:
        """If the stamp of the newest pose is far ahead of a frame, replace it by the stamp of the frame,
        since frames would never reach it."""
        newest, pose = self._poses[-1]
        if newest - stamp <= _MAX_AHEAD:
            return
        self._start = pose
        self._poses.clear()
        self._poses.append((stamp, pose))
        self._node.report_other_clock([f"{self._camera.name}/pose"], (newest - stamp) * 1e-9, "frames")

    def _follow_clock(self, before: int, after: int) -> None:
        """When the clock is set back, forget the poses from before it, since their stamps would be in the
        future. If none is left, keep the last one."""
        since = [item for item in self._poses if item[0] < (before + after) / 2]
        self._poses = deque(since or [(after, self._last)], maxlen=_MAX_POSES)

    def _pose_at(self, stamp: int) -> CameraPose:
        """Pose at a stamp from the received poses."""
        earlier_pose, earlier = self._start, 0
        for later, pose in self._poses:
            if later > stamp:
                span = later - earlier
                return _between(earlier_pose, pose, (stamp - earlier) / span) if earlier else earlier_pose
            earlier, earlier_pose = later, pose
        return earlier_pose

    def _on_pose(self, message: PoseStamped) -> None:
        try:
            pose = messages.read_pose(message)
        except HumansimError as error:
            self._node.get_logger().error(
                f"pose not used: {printable(str(error))}", throttle_duration_sec=1.0
            )
            return
        stamp = messages.to_nanoseconds(message.header.stamp) or self._node.now()
        if not self._poses:
            # nodes that join later must not get the old pose
            fixed = [part for part in self._topics.transforms if part is not self._topics.extrinsics]
            self._transforms.send_static(fixed, self._node.now())
        if self._poses and stamp <= self._poses[-1][0]:
            self._start = self._last
            self._poses.clear()  # the clock was set back
        elif len(self._poses) == _MAX_POSES:
            self._start = self._poses[0][1]
        self._poses.append((stamp, pose))

    def _publish(self, pose: CameraPose, stamp: int) -> TransformStamped:
        camera = self._camera.published_at(pose)
        transform: TransformStamped = self._topics.extrinsics.build(camera, stamp)
        self._extrinsics.publish(transform)
        projection = self._topics.projection.build(camera, stamp)
        if projection != self._newest_projection:  # it has no stamp
            self._newest_projection = projection
            self._projection.publish(projection)
        return transform


def _between(pose: CameraPose, other: CameraPose, share: float) -> CameraPose:
    """Pose between two poses: 0 is the first one, 1 the other; linear position, slerp rotation."""
    if share == 0 or (np.array_equal(pose.R, other.R) and np.array_equal(pose.t, other.t)):
        return pose
    start, end = matrix_to_quaternion(pose.R.T), matrix_to_quaternion(other.R.T)
    turned = quaternion_to_matrix(slerp(start, end, np.asarray(share)))
    centre = (1 - share) * (-pose.R.T @ pose.t) + share * (-other.R.T @ other.t)
    return CameraPose(turned.T, -turned.T @ centre)


#: Image channels that compare a frame with the next frame, and with the previous frame.
_FORWARD, _BACKWARD = comparing_with("next_frame"), comparing_with("previous_frame")


class CameraNode(SceneNode):
    """One camera with its ground truth. If several cameras share a process, node ``camera_rig`` passes
    ``name``, ``scene`` and ``renderer``, and calls :meth:`publish_frame`."""

    def __init__(
        self, name: str = "", scene: Scene | None = None, renderer: Any = None, **options: Any
    ) -> None:
        super().__init__(name or "camera", scene, **options)
        self._camera = self._select_camera(name)
        name = self._camera.name
        frame = self._optical_frame(name)
        self._in_rig = renderer is not None
        self._renderer = renderer if self._in_rig else self.make_renderer()
        _ = self.scene.joint_surfaces  # computed now: later it would delay a frame
        calibration = PublishedCalibration(self._camera)
        topics = CameraTopics(self.scene, self._camera, frame, self._renderer.channels, calibration)
        self._driver = CameraDriver(self)
        self._senders = CameraPublishers(self, topics, self._driver)
        self._timer = PictureTimer(self._camera.timing)
        #: Shots of the last two frames, if flow has subscribers.
        self._last: CameraShot | None = None
        self._previous: CameraShot | None = None
        schedule = self._camera.faults
        self._freezes = schedule is not None and schedule.config.freeze is not None
        #: Colour image of the last frame before the camera froze, if faults can freeze this camera.
        self._last_colours: Image | None = None
        CalibrationService(self, calibration)
        if url := self.text_parameter(
            "published_info_url",
            "",
            "Calibration file to publish as camera_info in place of the rendered lens; empty: the truth",
        ):
            calibration.replace(read_lens(url, name), url)
        self._pose = CameraPosePublisher(self, self._camera, topics)
        for legend in topics.legends:
            self.publish_latched(legend.build(None, 0), legend.name)
        if not self._in_rig:
            moving = [name] if self._camera.moves else []
            self._synchronizer = FrameSynchronizer(self, self.publish_frame, [self], moving)
        width, height = self._camera.camera.size
        self.get_logger().info(f"{name}: {width}x{height} on {self._renderer.device}")

    def _select_camera(self, name: str) -> SceneCamera:
        """Camera ``name``, or the camera of parameter ``camera``, with the lens of ``camera_info_url``."""
        name = name or self.text_parameter("camera", "", "Camera of the scene; empty: the first")
        url = self.text_parameter(
            "camera_info_url", "", "Calibration file of the lens to render; empty: the lens of the scene"
        )
        name = name or next(iter(self.scene.cameras))
        if name not in self.scene.cameras:
            text = unknown("camera", name, self.scene.cameras, "the scene")
            raise SceneError(text, path=self.scene.path, key="cameras")
        camera = self.scene.scene_cameras[name]
        if not url:
            return camera
        with located(path=url):
            return camera.with_calibration(read_lens(url, name))

    def _optical_frame(self, name: str) -> str:
        """Name of the optical frame of a camera in messages and tf. Raises RosError if tf2 refuses this."""
        frame = self.text_parameter(
            "frame_id", "", "Optical frame of the camera; empty: <camera>_optical_frame"
        )
        prefix = self.text_parameter("frame_prefix", "", "Text before the optical frame, such as lab/")
        frame = prefix + (frame or messages.optical_frame(name))
        if frame.startswith("/"):
            parameter = "frame_prefix" if prefix else "frame_id"
            raise RosError(f"parameter {parameter}: frames do not begin with /, as in {frame}")
        return frame

    def complete(self) -> None:
        """Send the images that simulated faults have delayed."""
        self._driver.send_held()

    def close(self) -> None:
        """Free the renderer, unless it belongs to a rig."""
        if not self._in_rig:
            self._renderer.close()

    def publish_frame(self, state: SceneState) -> None:
        """Render and publish the subscribed channels, and the forward flow of the previous frame. Nothing
        happens in frames that the camera does not capture because of its own rate."""
        if not self._timer.takes(state.index):
            return
        start = time.monotonic()
        self._publish_frame(state)
        self.report_time(1e3 * (time.monotonic() - start), "render")

    def _publish_frame(self, state: SceneState) -> None:
        shot, topics = self._pose.shot(state), self._senders.subscribed()
        forward = [topic for topic in topics if topic.channels & _FORWARD]
        backward = [topic for topic in topics if topic.channels & _BACKWARD]
        previous = self._previous_shot(shot, bool(forward or backward))
        topics = [topic for topic in topics if topic not in forward]
        if previous is None:
            self._publish_shot(shot, [topic for topic in topics if topic not in backward])
            return
        self._publish_shot(replace(shot, previous_frame=previous.adjacent_frame), topics)
        if forward:
            complete = replace(previous, next_frame=shot.adjacent_frame)
            self._senders.publish(forward, self._captured(complete, Needs.of(forward)))

    def _previous_shot(self, shot: CameraShot, has_flow: bool) -> CameraShot | None:
        """Shot of the frame before, and remember this one. None if no topic compares frames, or there is no
        such frame."""
        if self._last is not None and self._last.state.is_preview != shot.state.is_preview:
            self._last = self._previous = None  # flow does not lead from one to the other
        if self._last is not None and self._last.state.stamp != shot.state.stamp:  # else the same frame again
            self._previous = self._last
        previous = self._previous
        self._last = shot if has_flow else None
        if self._last is None:
            self._previous = None
        return previous

    def _publish_shot(self, shot: CameraShot, topics: Sequence[Topic[Any]]) -> None:
        state, schedule = shot.state, self._camera.faults
        if schedule is not None and not state.is_preview:
            shot = replace(shot, faults=schedule.at_time(state.scene_time))
        for kind in shot.faults.kinds:
            self.count(f"fault_{kind}")
        with self._driver.frame(state.stamp, shot.faults):
            if topics:
                self._senders.publish(topics, self._captured(shot, Needs.of(topics)))
                self.count("frames")
                self.report_lateness(state.stamp)

    def _captured(self, shot: CameraShot, needs: Needs) -> Frame:
        """Frame with a shot. While the camera is frozen, the colours are those of an earlier frame."""
        name, colours = self._camera.name, "rgb" in needs.channels
        frozen = self._last_colours if shot.faults.picture and colours else None
        shot = replace(shot, channels=needs.ordered_channels, frozen=frozen)
        frame = Frame.captured(shot.state, {name: shot}, needs, self._renderer)
        if self._freezes and colours:
            self._last_colours = frame.views[name].rgb
        return frame
