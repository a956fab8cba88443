"""Where a camera is: at its place in the scene, on a trajectory, or where ``<camera>/pose`` puts it."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

from geometry_msgs.msg import PoseStamped, TransformStamped
from std_msgs.msg import Float64MultiArray

from humansim_ros.errors import HumansimError
from humansim_ros.ros import messages
from humansim_ros.ros.node import SceneNode
from humansim_ros.ros.qos import DATA, LATCHED, NEWEST
from humansim_ros.scene.camera import CameraPose, SceneCamera
from humansim_ros.scene.capture import Exposure
from humansim_ros.scene.state import SceneState

try:
    from tf2_msgs.msg import TFMessage
except ImportError:  # not on PyPI
    TFMessage = None

#: Poses that are remembered: frames are a little older than the newest pose.
_REMEMBERED = 200
#: Nanoseconds after its last move that a camera is taken to move on: poses may be rarer than frames.
_RESTLESS = 1_000_000_000


class CameraPosePublisher:
    """Publishes ``<camera>/extrinsics`` and ``projection``, latched, and tf: once of a camera that nothing
    moves, with every frame's stamp of others.

    ``<camera>/pose`` (``map``, the optical frame) moves any camera: between two poses it is interpolated,
    after the last it stays.
    """

    def __init__(self, node: SceneNode, camera: SceneCamera) -> None:
        self._node = node
        self._camera = camera
        self._poses: deque[tuple[int, CameraPose]] = deque(maxlen=_REMEMBERED)
        self._start = self._last = CameraPose.of(camera.camera)
        self._moved = 0
        self._extrinsics = node.create_publisher(TransformStamped, f"{camera.name}/extrinsics", LATCHED)
        self._projection = node.create_publisher(Float64MultiArray, f"{camera.name}/projection", LATCHED)
        self._tf = self._tf_static = None
        if TFMessage is not None:
            self._tf = node.create_publisher(TFMessage, "/tf", DATA)
        transform = self._say(self._last, node.now())
        if not camera.moves:
            node.create_subscription(PoseStamped, f"{camera.name}/pose", self._on_pose, NEWEST)
            if TFMessage is not None:
                self._tf_static = node.create_publisher(TFMessage, "/tf_static", LATCHED)
                self._tf_static.publish(TFMessage(transforms=[transform]))

    def shot(self, instant: SceneState) -> Exposure:
        """What there is to be seen of an instant from where the camera is then. Says where that is."""
        shot = instant.shot(self._camera)
        if self._poses:
            if self._place(instant.stamp) is not self._last:  # where it stays, it stays the same object
                self._moved = instant.stamp
            shot = replace(
                shot,
                pose_at=lambda seconds: self._place(instant.stamp + round(1e9 * seconds)),
                moving=abs(instant.stamp - self._moved) < _RESTLESS,
            )
        self._last = shot.pose_at(0.0)
        if shot.moving or self._poses:
            # those who ask tf where a camera is at a frame's stamp need one at that stamp
            transform = self._say(self._last, instant.stamp)
            if self._tf is not None:
                self._tf.publish(TFMessage(transforms=[transform]))
        return shot

    def _place(self, stamp: int) -> CameraPose:
        """Where ``pose`` puts the camera at a stamp."""
        before, earlier = self._start, 0
        for later, pose in self._poses:
            if later > stamp:
                span = later - earlier
                return before.toward(pose, (stamp - earlier) / span) if earlier else before
            earlier, before = later, pose
        return before

    def _on_pose(self, message: PoseStamped) -> None:
        try:
            pose = messages.read_pose(message)
        except HumansimError as error:
            self._node.get_logger().error(f"pose not used: {error}", throttle_duration_sec=1.0)
            return
        stamp = messages.to_nanoseconds(message.header.stamp) or self._node.now()
        if not self._poses and self._tf_static is not None:
            self._tf_static.publish(TFMessage())  # late joiners do not get where it was
        if self._poses and stamp <= self._poses[-1][0]:
            self._start = self._last
            self._poses.clear()  # the clock was set anew
        elif len(self._poses) == _REMEMBERED:
            self._start = self._poses[0][1]
        self._poses.append((stamp, pose))

    def _say(self, pose: CameraPose, stamp: int) -> TransformStamped:
        transform = self._transform(pose, stamp)
        self._extrinsics.publish(transform)
        self._projection.publish(messages.projection_message(self._camera.at(pose)))
        return transform

    def _transform(self, pose: CameraPose, stamp: int) -> TransformStamped:
        return messages.extrinsics_message(self._camera.name, self._camera.at(pose), stamp)
