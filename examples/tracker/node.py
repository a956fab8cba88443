"""ROS node: tracks the people of a running scene, in real time or in lockstep.

    python examples/tracker/node.py --ros-args -p pixel_noise:=2.0
    humansim run my_scene.yaml --lockstep --frames 300 --wait-for topic:/tracker/poses

Subscribes to ``<camera>/camera_info``, ``<camera>/extrinsics`` and the topic of its detector, of all cameras
or of those of parameter ``cameras``. Publishes ``/tracker/poses``, sensor_msgs/MultiDOFJointState: one
message a frame, with the stamp of the frame, in ``map``. Joints are named ``<identity>/<joint>``. A frame
without people has a message without joints. Nothing here knows of lockstep: a message with the stamp of a
frame finishes it.
"""

from __future__ import annotations

import sys
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import numpy as np
import rclpy
from cameras import LENS_MODELS, Camera
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
#: Frames of a camera whose extrinsics and detections are held.
_HELD = 100


class CameraInput:
    """What the node has received of a camera."""

    def __init__(self) -> None:
        self.info: CameraInfo | None = None
        self.extrinsics: deque[TransformStamped] = deque(maxlen=_HELD)
        #: Detections that wait for their calibration, by stamp.
        self.waiting: dict[int, Any] = {}

    def camera_at(self, stamp: int, moves: bool) -> tuple[Camera, tuple[int, int]] | None:
        """The camera and the size of its image at a stamp; None as long as they are not known.

        A camera that moves needs the extrinsics of the stamp, another one its last. Raises ValueError for a
        calibration that cannot be used.
        """
        if self.info is None or not self.extrinsics:
            return None
        exact = [each for each in self.extrinsics if nanoseconds(each.header.stamp) == stamp]
        if moves and not exact:
            return None
        return camera_of(self.info, (exact or self.extrinsics)[-1].transform), image_size(self.info)


class TrackerNode(Node):
    """Tracks people in all cameras.

    Args:
        make_detector: Makes the detector, from the parameters of its faults.
        options: Options of rclpy's Node.

    Raises:
        ValueError: A parameter is out of range.
    """

    def __init__(self, make_detector: Callable[[Faults], Detector], **options: Any) -> None:
        super().__init__("tracker", **options)
        chosen = [name for name in self.declare_parameter("cameras", [""]).value if name]
        patience = float(self.declare_parameter("patience", 0.5).value)
        faults = {name: self.declare_parameter(name, value).value for name, value in asdict(Faults()).items()}
        self.detector = make_detector(Faults(**faults))
        self.tracker = Tracker()
        self.frames = 0
        self._frames: FrameBuffer[tuple[Camera, tuple[int, int], Any]] = FrameBuffer(patience)
        self._cameras: dict[str, CameraInput] = {}
        self._last: MultiDOFJointState | None = None
        self._poses = self.create_publisher(MultiDOFJointState, "~/poses", 10)
        steady = Clock(clock_type=ClockType.STEADY_TIME)  # simulated time stands while a frame is in flight
        self.create_timer(0.02, self._on_timer, clock=steady)
        for camera in chosen:
            self._add_camera(camera)
        if not chosen:
            self.create_timer(0.5, self._find_cameras, clock=steady)

    def _find_cameras(self) -> None:
        """Add cameras that have come."""
        namespace = self.get_namespace().rstrip("/") + "/"
        before, after = self.detector.topic.split("{camera}")
        kind = f"{self.detector.message.__module__.split('.')[0]}/msg/{self.detector.message.__name__}"
        for topic, kinds in self.get_topic_names_and_types():
            name = topic.removeprefix(namespace)
            camera = name.removeprefix(before).removesuffix(after)
            if name == before + camera + after and "/" not in camera and kind in kinds:
                self._add_camera(camera)

    def _add_camera(self, camera: str) -> None:
        if camera in self._cameras:
            return
        self._cameras[camera] = CameraInput()
        self._frames.add_camera(camera)
        self.detector.attach(self, camera)

        def subscribe(kind: type, topic: str, callback: Callable[[str, Any], None], qos: Any) -> None:
            self.create_subscription(kind, topic, partial(callback, camera), qos)

        subscribe(TransformStamped, f"{camera}/extrinsics", self._on_extrinsics, LATCHED)
        subscribe(CameraInfo, f"{camera}/camera_info", self._on_info, 10)
        subscribe(self.detector.message, self.detector.topic.format(camera=camera), self._on_message, 10)

    def _on_extrinsics(self, camera: str, message: TransformStamped) -> None:
        self._cameras[camera].extrinsics.append(message)
        self._use_waiting(camera)

    def _on_info(self, camera: str, message: CameraInfo) -> None:
        self._cameras[camera].info = message
        self._use_waiting(camera)

    def _on_message(self, camera: str, message: Any) -> None:
        """Take a message for the detector."""
        stamp = nanoseconds(message.header.stamp)
        if self._frames.begins_new_run(stamp):
            self.get_logger().info("stamps have gone back: a new run begins")
            self.tracker = Tracker()
            self._frames.restart()
            for each in self._cameras.values():
                each.waiting.clear()
        if self._frames.is_last(stamp) and self._last is not None:
            self._poses.publish(
                self._last
            )  # a frame is sent again if somebody does not know that it is finished
            return
        waiting = self._cameras[camera].waiting
        waiting[stamp] = message
        for old in sorted(waiting)[:-_HELD]:
            del waiting[old]
        self._use_waiting(camera)

    def _on_timer(self) -> None:
        """Release frames that have waited long enough, although no camera sends anything."""
        for camera in self._cameras:
            self._use_waiting(camera)
        self._track_frames()

    def _use_waiting(self, camera: str) -> None:
        """Use the messages of a camera whose calibration is known now."""
        held = self._cameras[camera]
        if not held.waiting or not self.detector.joint_names:
            return
        moves = self.count_publishers(f"{camera}/pose") > 0
        for stamp in sorted(held.waiting):
            try:
                calibrated = held.camera_at(stamp, moves)
            except ValueError as reason:
                self._warn(f"calibration of {camera}: {reason}")
                continue
            if calibrated is not None:
                self._frames.add(camera, stamp, (*calibrated, held.waiting.pop(stamp)), time.monotonic())
        self._track_frames()

    def _track_frames(self) -> None:
        while frame := self._frames.next_frame(time.monotonic()):
            stamp, content = frame
            detections = {}
            for camera, (calibrated, size, message) in content.items():
                try:
                    people = self.detector.detect(camera, message, size)
                except ValueError as reason:
                    self._warn(f"{camera}: {reason}")
                    continue
                detections[camera] = Detections(calibrated, people)
            *_, any_message = next(iter(content.values()))
            tracked = self.tracker.update(stamp, detections)
            self._last = poses_message(tracked, self.detector.joint_names, any_message.header)
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
    """Camera of the images of a CameraInfo, at the pose of its optical frame in ``map``.

    Raises:
        ValueError: They are not those of a camera, or the lens is of another model.
    """
    matrix = np.reshape(info.k, (3, 3)).astype(float)
    # K is that of the whole sensor
    matrix[0] = (matrix[0] - info.roi.x_offset * matrix[2]) / max(info.binning_x, 1)
    matrix[1] = (matrix[1] - info.roi.y_offset * matrix[2]) / max(info.binning_y, 1)
    q, t = transform.rotation, transform.translation
    quaternion, center = np.array([q.x, q.y, q.z, q.w]), np.array([t.x, t.y, t.z])
    model = {"": "plumb_bob", "fisheye": "equidistant"}.get(info.distortion_model, info.distortion_model)
    if model not in LENS_MODELS:
        raise ValueError(f"the lens model is {model!r:.40}; known are {', '.join(LENS_MODELS)}")
    numbers = [*matrix.ravel(), *quaternion, *center, *info.d]
    if not (np.isfinite(numbers).all() and (np.diag(matrix) > 0).all()):
        raise ValueError("a number is not finite, or a focal length is not positive")
    rotation = Rotation.from_quat(quaternion).as_matrix().T
    return Camera(matrix, rotation, center, model, tuple(info.d))


def poses_message(people: Sequence[Person], names: Sequence[str], header: Header) -> MultiDOFJointState:
    """Message of ``/tracker/poses``: the known joints of all people."""
    message = MultiDOFJointState(header=Header(stamp=header.stamp, frame_id="map"))
    for person in people:
        for joint in np.flatnonzero(np.isfinite(person.positions[:, 0])).tolist():
            message.joint_names.append(f"{person.identity}/{names[joint]}")
            position, velocity = _vector(person.positions[joint]), _vector(person.velocities[joint])
            message.transforms.append(Transform(translation=position, rotation=Quaternion(w=1.0)))
            message.twist.append(Twist(linear=velocity))
    return message


def _vector(values: Any) -> Vector3:
    x, y, z = (float(value) for value in values)
    return Vector3(x=x, y=y, z=z)


def main(make_detector: Callable[[Faults], Detector]) -> int:
    """Run the node; returns its exit code."""
    rclpy.init()
    try:
        node = TrackerNode(make_detector)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        noise = node.tracker.noise.deviation
        print(f"{node.frames} frames; the noise of the detections was {noise:.2f} px")
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    from truth_detector import TruthDetector

    sys.exit(main(TruthDetector))
