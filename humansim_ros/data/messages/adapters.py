"""Adapters: they send ground truth as messages of other people stacks (docs/people_messages.md).

The table :data:`ADAPTERS` has a row for each adapter. The row states what the adapter needs, which topics the
adapter has, and how messages are built from a frame. A simulation makes such frames. Node ``bridge`` puts
frames together from the topics of the other nodes. The messages are the same in both cases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.messages.camera_truth import (
    BODY_KINDS,
    body_box,
    joint_places,
    read_boxes,
    read_joint_view,
)
from humansim_ros.data.messages.headers import TF_TOPIC, WORLD_FRAME, header, optical_frame
from humansim_ros.data.messages.hri import (
    HRI_KEYPOINTS,
    HRI_MESSAGES,
    TF_MESSAGES,
    HriFrame,
    HriTopic,
    check_ids,
    hri_person,
    hri_topics,
)
from humansim_ros.data.messages.images import read_image
from humansim_ros.data.messages.people import DETECTIONS_2D, MESSAGE_TYPES
from humansim_ros.data.messages.ros4hri import HriLinks
from humansim_ros.data.messages.scanners import scanner_frame
from humansim_ros.data.messages.topic import Topic
from humansim_ros.data.messages.types import (
    MESSAGE_PACKAGES,
    Duration,
    Image,
    MessagePackage,
    Point,
    PointCloud2,
    Pose,
    PoseWithCovariance,
    Quaternion,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from humansim_ros.errors import KeypointError, RosError, SceneError, some_of, unknown, within_bounds
from humansim_ros.files.yaml import Section
from humansim_ros.geometry import invert_rigid, multiply_quaternions, quaternion_to_matrix, transform
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.render.interface import CHANNEL_TABLE, Kind, View
from humansim_ros.scene.config import BoxesConfig, FramedConfig, HriConfig, TrackedConfig
from humansim_ros.scene.core import CameraPose, Frame, Scene, SceneState
from humansim_ros.scene.features import ROBOT
from humansim_ros.scene.truth import (
    OUTSIDE,
    REQUIRED_CHANNELS,
    VISIBLE,
    BodyBox,
    CameraTruth,
    JointView,
    standing,
)
from humansim_ros.types import Array

#: Class of all detections: its name, and its number in the LabelInfo message.
PERSON, PERSON_CLASS = "person", 0
#: Variance of an unknown number: in spencer_tracking_msgs, a variance above 99999 means unknown.
UNSET = 100_000.0
#: Indices of the variances, on the diagonal of a covariance.
_DIAGONAL = tuple(range(0, 36, 7))

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


# --- builders


def _hypothesis(pose: Pose | None = None) -> Any:
    """Message with the only hypothesis of a detection: the object is a person, with score 1."""
    certain = VISION_MSGS.message("ObjectHypothesis")(class_id=PERSON, score=1.0)
    found = VISION_MSGS.message("ObjectHypothesisWithPose")(hypothesis=certain)
    found.pose.pose = Pose(orientation=Quaternion(w=1.0)) if pose is None else pose
    return found


def detections_2d_message(boxes: Mapping[str, BodyBox], whole: bool, stamp: int, frame_id: str) -> Any:
    """Build a vision_msgs/Detection2DArray.

    A person without visible pixels is left out; with whole boxes, a person outside the image. Numbers are
    rounded to float32, so that they equal those of ``<camera>/boxes``.

    Args:
        boxes: Boxes by person.
        whole: If true, a box encloses the whole body. If false, only the visible pixels.
        stamp: Nanoseconds.
        frame_id: Optical frame of the camera.
    """
    message = VISION_MSGS.message("Detection2DArray")(header=header(stamp, frame_id))
    for name, box in boxes.items():
        if box.truncation >= 1 if whole else not box.pixels:
            continue
        left, top, right, bottom = np.float32(box.whole if whole else box.visible).astype(float).tolist()
        bounds = VISION_MSGS.message("BoundingBox2D")(size_x=right - left, size_y=bottom - top)
        bounds.center.position.x, bounds.center.position.y = (left + right) / 2, (top + bottom) / 2
        found = VISION_MSGS.message("Detection2D")(header=message.header, bbox=bounds, id=name)
        found.results = [_hypothesis()]
        message.detections.append(found)
    return message


def detections_3d_message(frame: Frame, placed: Placed, stamp: int) -> Any:
    """Build a vision_msgs/Detection3DArray: the upright box of each body.

    Args:
        frame: Frame of the scene.
        placed: Frame of the coordinates.
        stamp: Nanoseconds.
    """
    message = VISION_MSGS.message("Detection3DArray")(header=header(stamp, placed.frame_id))
    axes = placed.at(frame)
    for name, state in frame.humans.items():
        upright = state.upright_box
        pose = axes.pose(upright.center, upright.quaternion)
        length, width, height = upright.size.tolist()
        box = VISION_MSGS.message("BoundingBox3D")(center=pose, size=Vector3(x=length, y=width, z=height))
        found = VISION_MSGS.message("Detection3D")(header=message.header, bbox=box, id=name)
        found.results = [_hypothesis(pose)]
        message.detections.append(found)
    return message


def label_info_message(frame_id: str) -> Any:
    """Build a vision_msgs/LabelInfo, which lists the classes of detections: only ``person``."""
    person = VISION_MSGS.message("VisionClass")(class_id=PERSON_CLASS, class_name=PERSON)
    return VISION_MSGS.message("LabelInfo")(header=header(0, frame_id), class_map=[person])


def people_message(frame: Frame, placed: Placed, labels: Mapping[str, int], stamp: int) -> Any:
    """Build a people_msgs/People: the point on the floor below the hips of each person.

    An unknown velocity is 0, and the tag ``velocity`` of the person says that it is unknown.

    Args:
        frame: Frame of the scene.
        placed: Frame of the coordinates.
        labels: Instance label of each person, which becomes a tag in the message.
        stamp: Nanoseconds.
    """
    message = PEOPLE_MSGS.message("People")(header=header(stamp, placed.frame_id))
    axes = placed.at(frame)
    for name, state in frame.humans.items():
        place = standing(state)
        tags = {"instance": str(labels[name])} | ({"velocity": "unknown"} if place.velocity is None else {})
        person = PEOPLE_MSGS.message("Person")(
            name=name, position=axes.point(place.position), reliability=1.0
        )
        speed = axes.vector(np.zeros(3) if place.velocity is None else place.velocity.linear)
        person.velocity = Point(x=speed.x, y=speed.y, z=speed.z)
        person.tagnames, person.tags = list(tags), list(tags.values())
        message.people.append(person)
    return message


def tracked_persons_message(
    frame: Frame, placed: Placed, labels: Mapping[str, int], camera: str | None, stamp: int
) -> Any:
    """Build a spencer_tracking_msgs/TrackedPersons: true positions on the floor, headings and velocities.

    Args:
        frame: Frame of the scene.
        placed: Frame of the coordinates.
        labels: Instance label of each person, which becomes the id of the track.
        camera: Camera that sees the people. A person without visible pixels in its image is marked as
            occluded. If None, nobody is.
        stamp: Nanoseconds.
    """
    message = SPENCER_MSGS.message("TrackedPersons")(header=header(stamp, placed.frame_id))
    axes, age = placed.at(frame), divmod(frame.scene_time, 1_000_000_000)
    for name, state in frame.humans.items():
        place = standing(state)
        seen = camera is None or frame.truth[camera].boxes[name].pixels > 0
        track = SPENCER_MSGS.message("TrackedPerson")(track_id=labels[name], is_occluded=not seen)
        track.is_matched, track.detection_id = seen, labels[name] if seen else 0
        track.age = Duration(sec=age[0], nanosec=age[1])
        track.pose = PoseWithCovariance(pose=axes.pose(place.position, place.rotation))
        track.twist = TwistWithCovariance()
        if place.velocity is None:
            track.twist.covariance = _variances(UNSET)
        else:
            linear, angular = (axes.vector(each) for each in (place.velocity.linear, place.velocity.angular))
            track.twist.twist = Twist(linear=linear, angular=angular)
        message.tracks.append(track)
    return message


def _variances(variance: float) -> Array:
    covariance = np.zeros(36)
    covariance[list(_DIAGONAL)] = variance
    return covariance


# --- frames from messages


@dataclass(frozen=True)
class ReceivedTruth:
    """Ground truth of a camera, received from topics. It can replace
    :class:`~humansim_ros.scene.CameraTruth`. ``boxes``: boxes by human or labelled object. ``openpose``:
    keypoints of the set :data:`HRI_KEYPOINTS` by human. ``image``: pixels and encoding of the colour
    image."""

    boxes: Mapping[str, BodyBox] = field(default_factory=dict)
    openpose: Mapping[str, JointView] = field(default_factory=dict)
    image: tuple[NDArray[Any], str] | None = None

    def keypoints(self, set_name: str) -> Mapping[str, JointView]:
        """Keypoints by human. Raises KeypointError if the set is not :data:`HRI_KEYPOINTS`."""
        if set_name != HRI_KEYPOINTS:
            raise KeypointError(f"the keypoints of {set_name} are not received")
        return self.openpose


class CameraInput(NamedTuple):
    """A topic of a camera that node ``bridge`` receives.

    Attributes:
        type: Message class.
        read: Function that returns the content of a message. RosError if it does not fit the scene.
        field: Name of the attribute of :class:`ReceivedTruth` that holds the content.
    """

    type: Any
    read: Callable[[Any, Scene], Any]
    field: str


def _read_body_boxes(message: PointCloud2, scene: Scene) -> dict[str, BodyBox]:
    """Boxes of ``<camera>/boxes`` by human or object. Raises RosError unless each label has one box."""
    names = {label: name for name, label in scene.labels.items()}
    kinds = {number: kind for kind, number in BODY_KINDS.items()}
    boxes: dict[str, BodyBox] = {}
    for row in read_boxes(message):
        name, kind = names.get(int(row["instance"])), kinds.get(int(row["kind"]))
        if name is None or kind is None or name in boxes:
            raise RosError(f"a box has label {row['instance']} and kind {row['kind']}, or two have one label")
        box = boxes[name] = body_box(row, cast(Kind, kind))
        shown = [*(box.visible if box.pixels else ()), *(box.whole if not box.truncation >= 1 else ())]
        if not within_bounds(shown):
            raise RosError(f"the box of {name} is not finite")
    if missing := [name for name in names.values() if name not in boxes]:
        raise RosError(f"no box of {some_of(missing)}")
    return boxes


def _read_openpose(message: PointCloud2, scene: Scene) -> dict[str, JointView]:
    """Keypoints of ``<camera>/keypoints/openpose137`` by human. Raises RosError unless each human has each
    point once."""
    rows = read_joint_view(message)
    count, out = len(keypoint_set(HRI_KEYPOINTS)), {}
    for name, actor in scene.actors.items():
        own = rows[rows["human"] == actor.instance]
        if not np.array_equal(own["joint"], np.arange(count)):
            raise RosError(f"{len(own)} keypoints of {name}, which are not the {count} of {HRI_KEYPOINTS}")
        pixels, optical = joint_places(own)
        if not (within_bounds(np.nan_to_num(pixels)) and within_bounds(np.nan_to_num(optical))):
            raise RosError(f"a keypoint of {name} is far away")
        if (own["visible"] > VISIBLE).any() or not np.isfinite(pixels[own["visible"] > OUTSIDE]).all():
            raise RosError(f"a keypoint of {name} is visible, but not in the image")
        nothing = np.zeros(count)
        out[name] = JointView(
            optical,
            pixels,
            own["visible"].astype(np.uint8),
            nothing.astype(np.uint8),
            nothing.astype(np.uint16),
            nothing.astype(np.float32),
        )
    if len(rows) != count * len(out):
        raise RosError(f"{len(rows)} keypoints; {len(out)} people have {count * len(out)}")
    return out


def _read_colours(message: Image, _: Scene) -> tuple[NDArray[Any], str]:
    """Pixels and encoding of ``<camera>/image_raw``. Raises RosError if this is no colour image."""
    pixels = read_image(message)
    if pixels.dtype != np.uint8:
        raise RosError(f"images of encoding {message.encoding!r} have no colours")
    return pixels, message.encoding


#: #: Topics of a camera that node ``bridge`` receives, by name below the camera.
CAMERA_INPUTS: dict[str, CameraInput] = {
    "boxes": CameraInput(PointCloud2, _read_body_boxes, "boxes"),
    f"keypoints/{HRI_KEYPOINTS}": CameraInput(PointCloud2, _read_openpose, "openpose"),
    CHANNEL_TABLE["rgb"].topic: CameraInput(Image, _read_colours, "image"),
}


def received_frame(
    stamp: int, state: SceneState | None, cameras: Mapping[str, Mapping[str, Any]], scene: Scene
) -> Frame:
    """Make a frame from received messages, with only the data that adapters need.

    Args:
        stamp: Nanoseconds.
        state: Bodies and objects of the scene. None if no topic needs bodies or objects.
        cameras: Contents of :data:`CAMERA_INPUTS` by camera and topic.
        scene: The scene.

    Raises:
        RosError: The joints of a human do not fit its body.
    """
    received = {
        name: ReceivedTruth(**{CAMERA_INPUTS[topic].field: content for topic, content in each.items()})
        for name, each in cameras.items()
    }
    truth = cast("dict[str, CameraTruth]", received)
    images = {name: each.image for name, each in received.items() if each.image is not None}
    views = {name: View(rgb=image) for name, (image, _) in images.items()}
    encodings = {name: encoding for name, (_, encoding) in images.items()}
    if state is None:
        return Frame(0, stamp, {}, views, truth, labels=scene.labels, encodings=encodings)
    return Frame(
        state.index,
        stamp,
        dict(state.humans),
        views,
        truth,
        dict(state.objects),
        encodings=encodings,
        labels=scene.labels,
        scene_time=state.scene_time,
        camera_poses=state.cameras,
    )


# --- table


@dataclass(frozen=True)
class Adapter:
    """An adapter: sends ground truth as messages of another people stack.

    Attributes:
        name: Name of the adapter, a key in section ``adapters`` of a scene file.
        package: Package of the messages.
        message: Name of the message in the package.
        topic: Name of the topic if the scene sets no other. ``<camera>`` stands for the name of a camera.
        needs: What the messages are made from, in words for the documentation.
        topics: Function that returns the topics of the adapter in a scene.
    """

    name: str
    package: MessagePackage
    message: str
    topic: str
    needs: str
    topics: Callable[[AdapterScene, Any, str], Iterator[AdapterTopic]]

    @property
    def type(self) -> str:
        """Name of the message type, such as ``people_msgs/msg/People``."""
        return f"{self.package.name}/msg/{self.message}"

    @property
    def is_read(self) -> bool:
        """Whether the evaluation can read these messages from trackers."""
        return self.type in (*MESSAGE_TYPES, DETECTIONS_2D)


def _name(config: FramedConfig, usual: str) -> str:
    """Name of a topic without leading slash: the one in the settings, or else ``usual``."""
    return usual if config.topic is None else config.topic.lstrip("/")


def _detections_2d(scene: AdapterScene, config: BoxesConfig, usual: str) -> Iterator[AdapterTopic]:
    whole, people = config.box == "whole", list(scene.scene.actors)
    if config.cameras is None:
        cameras: Sequence[str] = list(scene.scene.scene_cameras)
    else:
        cameras = [scene.camera(name, "cameras") for name in dict.fromkeys(config.cameras)]
    for camera in cameras:
        frame_id = scene.optical(camera)
        name = usual.replace("<camera>", camera)
        if config.topic is not None:
            name = f"{camera}/{config.topic.lstrip('/')}"

        def build(frame: Frame, stamp: int, camera: str = camera, frame_id: str = frame_id) -> Any:
            boxes = frame.truth[camera].boxes
            return detections_2d_message({each: boxes[each] for each in people}, whole, stamp, frame_id)

        needed = frozenset(REQUIRED_CHANNELS["boxes"])
        yield AdapterTopic.of(
            VISION_MSGS,
            "Detection2DArray",
            name,
            build,
            camera=camera,
            channels=needed,
            people=False,
            inputs=("boxes",),
        )
        yield _label_info(name, frame_id, camera)


def _detections_3d(scene: AdapterScene, config: FramedConfig, usual: str) -> Iterator[AdapterTopic]:
    placed, name = scene.placed(config.frame), _name(config, usual)

    def build(frame: Frame, stamp: int) -> Any:
        return detections_3d_message(frame, placed, stamp)

    yield AdapterTopic.of(VISION_MSGS, "Detection3DArray", name, build, posed=placed.camera)
    yield _label_info(name, placed.frame_id)


def _label_info(topic: str, frame_id: str, camera: str = "") -> AdapterTopic:
    return AdapterTopic.of(
        VISION_MSGS,
        "LabelInfo",
        f"{topic}/label_info",
        lambda *_: label_info_message(frame_id),
        camera=camera,
        latched=True,
        per_frame=False,
        people=False,
    )


def _people(scene: AdapterScene, config: FramedConfig, usual: str) -> Iterator[AdapterTopic]:
    placed, labels = scene.placed(config.frame), scene.scene.labels

    def build(frame: Frame, stamp: int) -> Any:
        return people_message(frame, placed, labels, stamp)

    yield AdapterTopic.of(PEOPLE_MSGS, "People", _name(config, usual), build, posed=placed.camera)


def _tracked_persons(scene: AdapterScene, config: TrackedConfig, usual: str) -> Iterator[AdapterTopic]:
    placed, labels = scene.placed(config.frame), scene.scene.labels
    camera = None if config.camera is None else scene.camera(config.camera, "camera")

    def build(frame: Frame, stamp: int) -> Any:
        return tracked_persons_message(frame, placed, labels, camera, stamp)

    topic = AdapterTopic.of(SPENCER_MSGS, "TrackedPersons", _name(config, usual), build, posed=placed.camera)
    if camera is not None:
        needed = frozenset(REQUIRED_CHANNELS["boxes"])
        topic = replace(topic, camera=camera, channels=needed, inputs=("boxes",))
    yield topic


def _hri(scene: AdapterScene, config: HriConfig, _: str) -> Iterator[AdapterTopic]:
    camera, actors = scene.camera(config.camera, "camera"), scene.scene.actors
    placed, size = scene.placed(optical_frame(camera)), scene.scene.scene_cameras[camera].camera.size
    check_ids(list(actors))
    links = {name: HriLinks.of(actor.human.skeleton) for name, actor in actors.items()}
    newest: list[tuple[Frame, HriFrame]] = []

    def described(frame: Frame) -> HriFrame:
        """Describe the people of a frame. The last result is cached, since all topics use it."""
        if not newest or newest[0][0] is not frame:
            axes = placed.at(frame)
            to_camera = invert_rigid(transform(quaternion_to_matrix(axes.rotation), axes.position))
            truth = frame.truth[camera]
            keypoints = truth.keypoints(HRI_KEYPOINTS)
            people = {
                name: hri_person(
                    name,
                    links[name],
                    frame.humans[name],
                    truth.boxes[name].visible,
                    keypoints[name],
                    to_camera,
                    size,
                )
                for name in actors
            }
            newest[:] = [
                (
                    frame,
                    HriFrame(people, to_camera, lambda: (frame.views[camera].rgb, frame.encodings[camera])),
                )
            ]
        return newest[0][1]

    channels = frozenset((*REQUIRED_CHANNELS["boxes"], *REQUIRED_CHANNELS["joints"]))
    inputs = ("boxes", f"keypoints/{HRI_KEYPOINTS}")
    for topic in hri_topics(list(actors), placed.frame_id, size):
        image = topic.has_image

        def build(frame: Frame, stamp: int, topic: HriTopic = topic) -> list[Any]:
            return topic.build(described(frame), stamp)

        yield AdapterTopic(
            topic.name,
            topic.type,
            build,
            lambda frame: frame,
            latched=topic.latched,
            shown=not image,
            camera=camera,
            channels=channels | {"rgb"} if image else channels,
            optional=image,
            package=TF_MESSAGES if topic.name == TF_TOPIC else HRI_MESSAGES,
            inputs=(*inputs, CHANNEL_TABLE["rgb"].topic) if image else inputs,
            posed=camera,
            absolute=True,
            repeated=topic.repeated,
            on_demand=image,
            sparse=topic.sparse,
        )


#: The table of all adapters by name.
ADAPTERS = {
    row.name: row
    for row in (
        Adapter(
            "detections_2d",
            VISION_MSGS,
            "Detection2DArray",
            "<camera>/detections_2d",
            "boxes of the camera",
            _detections_2d,
        ),
        Adapter("detections_3d", VISION_MSGS, "Detection3DArray", "detections_3d", "bodies", _detections_3d),
        Adapter("people", PEOPLE_MSGS, "People", "people", "hips", _people),
        Adapter(
            "tracked_persons",
            SPENCER_MSGS,
            "TrackedPersons",
            "spencer/perception/tracked_persons",
            "hips; with a camera, its boxes",
            _tracked_persons,
        ),
        Adapter(
            "hri",
            HRI_MESSAGES,
            "IdsList",
            "humans/bodies/tracked",
            "joints; boxes, keypoints and image of a camera",
            _hri,
        ),
    )
}


def adapter_topics(
    scene: Scene,
    frame_prefix: str = "",
    adapters: Mapping[str, Section] | None = None,
    installed: bool = False,
) -> list[AdapterTopic]:
    """Create the topics of the adapters of a scene.

    Args:
        scene: The scene.
        frame_prefix: Text before the names of the frames of cameras and scanners.
        adapters: Settings of the adapters by name. If None, those of the scene.
        installed: Whether it is an error if a message package is not installed. Nodes need them installed.

    Raises:
        SceneError: A setting names no camera or frame of the scene. The error names file, line and key.
        RosError: A message package is neither installed nor defined, or has another version.
    """
    topics: list[AdapterTopic] = []
    settings = scene.config.adapter_settings if adapters is None else adapters
    for name, row in ADAPTERS.items():
        if (config := settings.get(name)) is not None:
            row.package.check(installed)
            with scene.source.locating_errors():
                own = row.topics(AdapterScene(scene, name, frame_prefix), config, row.topic)
                topics += [replace(topic, row=name) for topic in own]
    for package in {topic.package.name: topic.package for topic in topics}.values():
        package.check(installed)
    return topics
