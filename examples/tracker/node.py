"""ROS node: tracks the people of a running scene, in real time or in lockstep.

    humansim run my_scene.yaml --lockstep --frames 300 --wait-for topic:/tracker/poses
    python examples/tracker/node.py --ros-args -p pixel_noise:=2.0

Subscribes to ``<camera>/camera_info``, ``<camera>/extrinsics`` and the topic of its detector, of all cameras or of
those of parameter ``cameras``. Publishes ``/tracker/poses``, sensor_msgs/MultiDOFJointState: one message a frame,
with the stamp of the frame, in ``map``. Joints are named ``<identity>/<joint>``. A frame without people has a
message without joints. Nothing here knows of lockstep: a message with the stamp of a frame finishes it.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any

import numpy as np
import rclpy
from cameras import Camera
from detectors import Detector, Faults
from frame_buffer import FrameBuffer
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Twist, Vector3
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import CameraInfo, MultiDOFJointState
from std_msgs.msg import Header
from tracking import Detections, Person, Tracker

LATCHED = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
#: Frames whose extrinsics and detections are held.
_HELD = 100


class CameraInput:
    """What the node has received of a camera."""

    def __init__(self) -> None:
        self.info: CameraInfo | None = None
        self.extrinsics: deque[TransformStamped] = deque(maxlen=_HELD)
        #: Detections that wait for their calibration, by stamp.
        self.waiting: dict[int, Any] = {}

    def camera_at(self, stamp: int, moves: bool) -> Camera | None:
        """The camera at a stamp. None until it is known: a camera that moves needs the pose of the stamp."""
        if self.info is None or not self.extrinsics:
            return None
        exact = [each for each in self.extrinsics if nanoseconds(each.header.stamp) == stamp]
        if moves and not exact:
            return None
        return camera_of(self.info, (exact or self.extrinsics)[-1].transform)


class TrackerNode(Node):
    """Tracks people in all cameras.

    Args:
        make_detector: Makes the detector, from the parameters of its faults.
        options: Options of rclpy's Node.
    """

    def __init__(self, make_detector: Callable[[Faults], Detector], **options: Any) -> None:
        super().__init__("tracker", **options)
        chosen = list(self.declare_parameter("cameras", [""]).value)
        #: In lockstep nothing is lost by patience: cameras may be slow, but send every frame.
        patience = float(self.declare_parameter("patience", 0.5).value)
        faults = {
            field.name: type(field.default)(self.declare_parameter(field.name, field.default).value)
            for field in fields(Faults)
        }
        self.detector = make_detector(Faults(**faults))
        self.tracker = Tracker()
        self.frames = 0
        self._frames: FrameBuffer[tuple[Camera, Any, tuple[int, int]]] = FrameBuffer(patience)
        self._cameras: dict[str, CameraInput] = {}
        self._last: MultiDOFJointState | None = None
        self._poses = self.create_publisher(MultiDOFJointState, "~/poses", 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # simulated time stands while a frame is in flight
        self.create_timer(0.02, self._track_frames, clock=steady)
        if any(chosen):
            for camera in filter(None, chosen):
                self._add_camera(camera)
        else:
            self.create_timer(0.5, self._find_cameras, clock=steady)

    def _find_cameras(self) -> None:
        """Add cameras that have come."""
        before, after = self.detector.topic.split("{camera}")
        kind = f"{self.detector.message.__module__.split('.')[0]}/msg/{self.detector.message.__name__}"
        for topic, kinds in self.get_topic_names_and_types():
            name = topic.lstrip("/")
            camera = name.removeprefix(before).removesuffix(after)
            if name == before + camera + after and "/" not in camera and kind in kinds:
                self._add_camera(camera)

    def _add_camera(self, camera: str) -> None:
        if camera in self._cameras:
            return
        self._cameras[camera] = CameraInput()
        self._frames.add_camera(camera)
        self.detector.attach(self, camera)
        self._subscribe(TransformStamped, f"{camera}/extrinsics", camera, self._on_extrinsics, LATCHED)
        self._subscribe(CameraInfo, f"{camera}/camera_info", camera, self._on_info, 10)
        topic = self.detector.topic.format(camera=camera)
        self._subscribe(self.detector.message, topic, camera, self._on_detections, 10)

    def _subscribe(
        self, kind: type, topic: str, camera: str, callback: Callable[..., None], qos: Any
    ) -> None:
        self.create_subscription(kind, topic, partial(callback, camera), qos)

    def _on_extrinsics(self, camera: str, message: TransformStamped) -> None:
        self._cameras[camera].extrinsics.append(message)
        self._use_waiting(camera)

    def _on_info(self, camera: str, message: CameraInfo) -> None:
        self._cameras[camera].info = message
        self._use_waiting(camera)

    def _on_detections(self, camera: str, message: Any) -> None:
        stamp = nanoseconds(message.header.stamp)
        if self._frames.begins_new_run(stamp):
            self.get_logger().info("stamps have gone back: a new run begins")
            self.tracker = Tracker()
            self._frames.restart()
        if self._frames.is_repeated(stamp) and self._last is not None:
            self._poses.publish(self._last)  # the frame is sent again, because somebody has not seen its end
            return
        waiting = self._cameras[camera].waiting
        waiting[stamp] = message
        for old in sorted(waiting)[:-_HELD]:
            del waiting[old]
        self._use_waiting(camera)

    def _use_waiting(self, camera: str) -> None:
        """Use detections of a camera whose calibration is known now."""
        held = self._cameras[camera]
        moves = self.count_publishers(f"{camera}/pose") > 0
        for stamp in sorted(held.waiting):
            try:
                calibrated = held.camera_at(stamp, moves)
            except (ValueError, np.linalg.LinAlgError) as reason:
                self._warn(f"calibration of {camera}: {reason}")
                continue
            if calibrated is not None and held.info is not None and self.detector.joint_names:
                content = (calibrated, held.waiting.pop(stamp), image_size(held.info))
                self._frames.add(camera, stamp, content, time.monotonic())
        self._track_frames()

    def _track_frames(self) -> None:
        while frame := self._frames.next_frame(time.monotonic()):
            stamp, content = frame
            detections = {}
            for camera, (calibrated, message, size) in content.items():
                try:
                    people = self.detector.detect(camera, message, size)
                except ValueError as reason:
                    self._warn(f"{camera}: {reason}")
                    continue
                detections[camera] = Detections(calibrated, people)
            people = self.tracker.update(stamp, detections)
            header = next(message.header for _, message, _ in content.values())
            self._last = poses_message(people, self.detector.joint_names, header)
            self._poses.publish(self._last)
            self.frames += 1

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text[:300], throttle_duration_sec=1.0)


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def image_size(info: CameraInfo) -> tuple[int, int]:
    """Width and height of the image, pixels: of the region of interest, after binning."""
    width, height = info.roi.width or info.width, info.roi.height or info.height
    return width // max(info.binning_x, 1), height // max(info.binning_y, 1)


def camera_of(info: CameraInfo, transform: Transform) -> Camera:
    """Camera of the images of a CameraInfo, at the pose of its optical frame in ``map``."""
    matrix = np.reshape(info.k, (3, 3)).astype(float)
    # K is that of the whole sensor
    for axis, (offset, binning) in enumerate(
        [(info.roi.x_offset, info.binning_x), (info.roi.y_offset, info.binning_y)]
    ):
        matrix[axis] = (matrix[axis] - offset * matrix[2]) / max(binning, 1)
    q, t = transform.rotation, transform.translation
    return Camera(
        matrix,
        Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix().T,
        np.array([t.x, t.y, t.z]),
        {"": "plumb_bob", "fisheye": "equidistant"}.get(info.distortion_model, info.distortion_model),
        tuple(info.d),
    )


def poses_message(people: list[Person], names: Any, header: Header) -> MultiDOFJointState:
    """Message of ``/tracker/poses``: the known joints of all people."""
    message = MultiDOFJointState(header=Header(stamp=header.stamp, frame_id="map"))
    for person in people:
        for name, position, velocity in zip(names, person.positions, person.velocities, strict=True):
            if np.isfinite(position).all():
                message.joint_names.append(f"{person.identity}/{name}")
                message.transforms.append(Transform(translation=vector(position), rotation=Quaternion(w=1.0)))
                message.twist.append(Twist(linear=vector(velocity)))
    return message


def vector(values: Any) -> Vector3:
    x, y, z = (float(value) for value in values)
    return Vector3(x=x, y=y, z=z)


def main() -> None:
    from truth_detector import TruthDetector

    rclpy.init()
    node = TrackerNode(TruthDetector)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.get_logger().info(
            f"{node.frames} frames; noise of the detections {node.tracker.noise.deviation:.2f} px"
        )
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
