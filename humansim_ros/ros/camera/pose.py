"""Pose of a camera node: static, from a trajectory, or from topic ``<camera>/pose``."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from geometry_msgs.msg import PoseStamped, TransformStamped

from humansim_ros import messages
from humansim_ros.errors import HumansimError, printable
from humansim_ros.messages.topics import CameraTopics
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA, LATCHED, NEWEST, offered_profile
from humansim_ros.scene.camera import CameraPose, SceneCamera
from humansim_ros.scene.capture import Exposure, SceneState

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # not on PyPI
    TFMessage = None

#: Received poses that are held: frames are a little older than the newest pose.
_MAX_POSES = 200
#: Nanoseconds from which a pose ahead of a frame has a stamp of another clock.
_MAX_AHEAD = 5_000_000_000
#: Nanoseconds after its last motion for which a camera counts as moving: poses may be rarer than frames.
_MOVING_FOR = 1_000_000_000


class CameraPosePublisher:
    """Publishes ``<camera>/extrinsics`` and ``projection``, both latched, and tf.

    A static camera has them once, a moving one with the stamp of every frame. ``<camera>/pose`` (optical
    frame in ``map``) moves any camera: poses are interpolated, and the camera stays at the last one. A pose
    far ahead of a frame has a stamp of another clock: it holds from that frame on. With a wrong calibration
    these are wrong, and ``<camera>/truth/extrinsics`` has the true pose.
    """

    def __init__(self, node: SceneNode, camera: SceneCamera, topics: CameraTopics) -> None:
        self._node = node
        self._topics = topics
        self._camera = camera
        self._poses: deque[tuple[int, CameraPose]] = deque(maxlen=_MAX_POSES)
        #: Pose before the first of _poses, and pose of the last frame.
        self._start = self._last = CameraPose.of(camera.camera)
        self._last_stamp = self._last_motion = 0
        self._extrinsics, self._projection = (
            node.create_publisher(topic.type, topic.name, offered_profile(topic))
            for topic in (topics.extrinsics, topics.projection)
        )
        self._true_extrinsics = topics.true_extrinsics
        if self._true_extrinsics is not None:
            topic = self._true_extrinsics
            self._true_publisher = node.create_publisher(topic.type, topic.name, offered_profile(topic))
            self._publish_true(CameraPose.of(camera.camera), node.now())
        self._tf = self._tf_static = None
        if TFMessage is not None:
            self._tf = node.create_publisher(TFMessage, "/tf", DATA)
        transform = self._publish(self._last, node.now())
        if not camera.moves:
            node.create_subscription(topics.pose.type, topics.pose.name, self._on_pose, NEWEST)
            if TFMessage is not None:
                self._tf_static = node.create_publisher(TFMessage, "/tf_static", LATCHED)
                self._tf_static.publish(TFMessage(transforms=[transform]))

    def exposure(self, state: SceneState) -> Exposure:
        """Exposure of the camera at a scene state; publishes the camera's pose at its stamp."""
        exposure, pose = state.exposure(self._camera), state.calibrated_pose(self._camera)
        if self._poses and state.stamp < self._last_stamp:
            self._follow_clock(self._last_stamp, state.stamp)
        self._last_stamp = state.stamp
        if self._poses:
            self._restamp_poses_ahead(state.stamp)
            if self._pose_at(state.stamp) is not self._last:  # a resting camera has the same object
                self._last_motion = state.stamp
            exposure = replace(
                exposure,
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
            if self._tf is not None:
                self._tf.publish(TFMessage(transforms=[transform]))
        if self._camera.moves or self._poses or self._camera.drifts:
            self._publish_true(exposure.pose_at(0.0), state.stamp)
        return exposure

    def _publish_true(self, pose: CameraPose, stamp: int) -> None:
        """Publish the pose that a camera with a wrong calibration really has."""
        if self._true_extrinsics is not None:
            self._true_publisher.publish(self._true_extrinsics.build(self._camera.camera_at(pose), stamp))

    def _restamp_poses_ahead(self, stamp: int) -> None:
        """Give the newest pose the stamp of a frame if its own is far ahead, and would never be reached."""
        newest, pose = self._poses[-1]
        if newest - stamp <= _MAX_AHEAD:
            return
        self._start = pose
        self._poses.clear()
        self._poses.append((stamp, pose))
        self._node.report_other_clock([f"{self._camera.name}/pose"], (newest - stamp) * 1e-9, "frames")

    def _follow_clock(self, before: int, after: int) -> None:
        """Keep the last pose when the clock is set back: poses of before would be in the future."""
        since = [item for item in self._poses if item[0] < (before + after) / 2]
        self._poses = deque(since or [(after, self._last)], maxlen=_MAX_POSES)

    def _pose_at(self, stamp: int) -> CameraPose:
        """Pose at a stamp from the received poses."""
        earlier_pose, earlier = self._start, 0
        for later, pose in self._poses:
            if later > stamp:
                span = later - earlier
                return earlier_pose.toward(pose, (stamp - earlier) / span) if earlier else earlier_pose
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
        if not self._poses and self._tf_static is not None:
            self._tf_static.publish(TFMessage())  # late joiners must not get the old pose
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
        self._projection.publish(self._topics.projection.build(camera, stamp))
        return transform
