"""Frames for the page, made from ROS messages of a bag or of a running graph."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.data import messages
from humansim_ros.data.evaluation import LiveOptions
from humansim_ros.data.messages import (
    WORLD_FRAME,
    CameraInfo,
    CompressedImage,
    Image,
    Marker,
    MultiDOFJointState,
    PointCloud2,
    Pose,
    PoseStamped,
    String,
    TimeReference,
    Transforms,
    TransformStamped,
    deserialised,
    read_people,
    readable_type,
)
from humansim_ros.errors import HumansimError, RosError, printable
from humansim_ros.files.mesh import Mesh
from humansim_ros.motion.body import JointPoses, body_joints
from humansim_ros.people.humans import Human
from humansim_ros.scene.core import SHAPES
from humansim_ros.scene.pictures import color_channel, color_depth, color_image, draw_joints
from humansim_ros.scene.truth import OUTSIDE, VISIBLE
from humansim_ros.types import Array, Float32Array
from humansim_ros.types import Image as Picture
from humansim_ros.view.sources.picking import PIXEL_CHANNELS, JointsInImage, near_joint_values, surface_values
from humansim_ros.view.sources.seen_topics import IMAGE, SeenCamera, SeenTopics, spaced
from humansim_ros.view.sources.source import (
    IMAGE_WIDTH,
    JOINTS,
    POSES,
    FrameRequest,
    PixelInfo,
    ViewFrame,
    ViewSource,
    fitted,
)
from humansim_ros.view.sources.topic_people import (
    TruePoints,
    beside_truth,
    bone_figure,
    fitted_skin,
    known_body,
    people_of,
    posed_joints,
)

Value = TypeVar("Value")

#: Longest messages that are read, bytes: of images, and of estimates (except point clouds).
_MAX_IMAGE, _MAX_POSES = 256 << 20, 256 << 10
#: Largest number of messages for the user.
_MAX_MESSAGES = 20
#: Encodings of colour images, and encodings of depth in millimetres.
_COLORS, _MILLIMETRES = ("rgb8", "bgr8", "mono8", "8UC1", "bayer_rggb8"), ("16UC1", "mono16")
#: Names of the meshes for the types of markers.
_MARKERS = {Marker.CUBE: "box", Marker.SPHERE: "sphere", Marker.CYLINDER: "cylinder"}
_MAX_POINTS = 30_000


@dataclass
class _Person:
    """A person whose body was found from topics.

    Attributes:
        human: The body.
        mesh: Serialised mesh message that the body was made from; None if there was none.
        names: Names of the joints that the body was made from.
        surface: Surface of the person while the body is a figure of bones, because its weights are unknown;
            else None.
    """

    human: Human
    mesh: bytes | None
    names: tuple[str, ...]
    surface: Mesh | None = None


@dataclass(frozen=True)
class TopicFrame:
    """Messages that belong to one frame.

    Attributes:
        index: Number of the frame.
        stamp: Nanoseconds.
        start: Stamp of the first frame, nanoseconds.
        data: Serialised messages of the frame, by topic.
    """

    index: int
    stamp: int
    start: int
    data: Mapping[str, bytes] = field(default_factory=dict)


class TopicFrames:
    """Finds people, cameras and objects in the messages of topics, and makes frames for the page from them.

    Messages that cannot be read are ignored, and ``messages`` tells the user so.

    Args:
        humans: Humans whose bodies the people may have, in addition to the built-in humans.
        options: How an estimate is read and compared.
        width: Width to which wider images are scaled down, pixels.

    Attributes:
        people: Bodies in the rest pose, by name of the person.
        cameras: Cameras by name, at their last known poses.
        objects: Meshes of objects by name.
        transforms: Transforms of tf.
    """

    def __init__(
        self,
        humans: Sequence[Human] = (),
        options: LiveOptions | None = None,
        width: int = IMAGE_WIDTH,
    ) -> None:
        self.people: dict[str, Human] = {}
        self.cameras: dict[str, Camera] = {}
        self.objects: dict[str, Mesh] = {}
        self.transforms = Transforms()
        self.topics = SeenTopics()
        self._humans, self._options, self._width = tuple(humans), options or LiveOptions(), width
        self._known: dict[str, _Person] = {}
        self._markers: dict[str, bytes] = {}
        #: Cache by topic and reader: the message that was read last, and its value.
        self._read_last: dict[tuple[str, Any], tuple[bytes, Any]] = {}
        self._messages: dict[str, None] = {}
        self._has_changed = False

    @property
    def messages(self) -> list[str]:
        """Messages for the user, each once."""
        return list(self._messages)

    def note(self, text: str) -> None:
        """Add a message for the user, unless the same text was added before."""
        if len(self._messages) < _MAX_MESSAGES:
            self._messages.setdefault(printable(text, 400))

    @property
    def is_lacking(self) -> bool:
        """Whether a person or object with topics was not found yet, or the joints of a person have
        changed."""
        topics = self.topics
        return self._has_changed or not (topics.people.keys() | topics.objects.keys()) <= (
            self.people.keys() | self.objects.keys()
        )

    # --- people, cameras and objects

    def see(self, topics: SeenTopics, data: Mapping[str, bytes]) -> None:
        """Find bodies, cameras and objects in messages, and forget those that have no topics any more.

        Args:
            topics: The present topics.
            data: Newest serialised message by topic.
        """
        self.topics, self._has_changed = topics, False
        known: tuple[tuple[dict[str, Any], Collection[str]], ...] = (
            (self.people, topics.people),
            (self._known, topics.people),
            (self.cameras, topics.cameras),
            (self.objects, topics.objects),
        )
        for found, names in known:
            for name in found.keys() - set(names):
                del found[name]
        for name, of_person in topics.people.items():
            self._see_person(name, of_person, data)
        for name in topics.cameras:
            self._camera(name, data, 0)
        for name, topic in topics.objects.items():
            pose = self._read(topic, data, Marker, _read_marker)
            if pose is not None and name not in self.objects:
                self.objects[name] = pose
        for topic in topics.others[:3]:
            self.note(f"{topic} is not shown: there is no camera_info beside it")

    def _see_person(self, name: str, topics: Mapping[str, str], data: Mapping[str, bytes]) -> None:
        poses = self._read(topics["joints"], data, MultiDOFJointState, messages.read_joints)
        if poses is None:
            return
        topic, known = topics.get("mesh", ""), self._known.get(name)
        mesh = data.get(topic)
        if known is not None and known.mesh == mesh and known.names == poses.names:
            return
        human = surface = None
        if mesh is not None:
            surface = self._guarded(topic, lambda: messages.read_mesh(mesh))
            human = known_body(surface, poses.names, self._humans) if surface is not None else None
            if human is None:
                self.note(
                    f"{name} has a body that is not built in: give its file with --body for its clothes"
                )
            else:
                surface = None
        human = human or bone_figure(name, poses)
        if human is None:
            self.note(f"{name} is not shown: {len(poses.names)} joints are no body")
            return
        self._known[name] = _Person(human, mesh, poses.names, surface)
        self.people[name] = human

    @property
    def skinless(self) -> list[str]:
        """Names of people with a surface but unknown skinning weights. :meth:`add_skin` finds the weights."""
        people = self.topics.people
        return [name for name, person in self._known.items() if person.surface and "vertices" in people[name]]

    def add_skin(self, name: str, samples: Sequence[tuple[bytes, bytes]]) -> None:
        """Find skinning weights for a person's surface. If none fit, the person stays a figure of bones.

        Args:
            name: Name of the person.
            samples: Serialised joints and vertices of some frames in which the pose differs.
        """
        person, topics = self._known[name], self.topics.people[name]
        surface, person.surface = person.surface, None
        assert surface is not None
        joints, vertices = [], []
        for of_joints, of_vertices in samples:
            poses = self._guarded(topics["joints"], partial(_joints, of_joints))
            points = self._guarded(topics["vertices"], partial(_vertices, of_vertices))
            if poses is not None and points is not None and poses.names == person.names:
                joints.append(posed_joints(person.human, poses)[: len(person.human.skeleton)])
                vertices.append(points.astype(float))
        if any(points.shape != surface.vertices.shape for points in vertices) or not joints:
            self.note(f"{topics['vertices']} does not have the vertices of {topics['mesh']}")
            return
        human = self._guarded(
            topics["vertices"],
            lambda: fitted_skin(person.human, surface, np.array(joints), np.array(vertices)),
        )
        if human is not None:
            person.human = self.people[name] = human

    def _camera(self, name: str, data: Mapping[str, bytes], stamp: int) -> Camera | None:
        """A camera at its pose at a stamp. Without a calibration message, the camera as last known, or
        None."""
        topics = self.topics.cameras[name]
        found = self._read(topics.info, data, CameraInfo, _read_calibration)
        if found is None:
            return self.cameras.get(name)
        camera, frame = found
        if camera is None:
            self.note(f"{name} has no calibration on {topics.info}: a lens of 53 degrees is assumed")
            camera = frame[1]
        pose = self._pose(name, topics, data, frame[0], stamp)
        if pose is not None:
            camera = replace(camera, R=pose[:3, :3].T, t=-pose[:3, :3].T @ pose[:3, 3])
        self.cameras[name] = camera
        return camera

    def _pose(
        self, name: str, topics: SeenCamera, data: Mapping[str, bytes], frame: str, stamp: int
    ) -> Array | None:
        """Pose (4, 4) of a camera in ``map``; None if no message has the pose."""
        for topic in topics.poses:
            kind = TransformStamped if topic.endswith("/extrinsics") else PoseStamped
            reader = messages.read_extrinsics if kind is TransformStamped else messages.read_pose
            pose = self._read(topic, data, kind, reader)
            if pose is not None:
                matrix = np.eye(4)
                matrix[:3, :3], matrix[:3, 3] = pose.R.T, pose.position
                return matrix
        found = self.transforms.pose(frame, stamp)
        if found is None:
            self.note(
                f"{name} has no pose, neither on {name}/extrinsics nor on tf: it is shown at the origin"
            )
            return None
        if found[1] != WORLD_FRAME:
            self.note(f"tf has no frame {WORLD_FRAME}: {found[1]} is taken for it")
        return found[0]

    # --- frames

    def frame(self, messages_of: TopicFrame, wanted: FrameRequest = POSES) -> ViewFrame:
        """Make a frame from its messages, with the wanted images."""
        data, stamp = messages_of.data, messages_of.stamp
        scene_time = stamp - messages_of.start
        if self.topics.scene_time in data:
            scene_time = (
                self._read(self.topics.scene_time, data, TimeReference, messages.read_scene_time) or 0
            )
        poses = {
            name: self._read(topics["joints"], data, MultiDOFJointState, messages.read_joints)
            for name, topics in self.topics.people.items()
        }
        joints: dict[str, Array] = {}
        sizes: dict[str, float] = {}
        for name, found in poses.items():
            person = self._known.get(name)
            if found is None or person is None:
                continue
            if person.names != found.names:
                self._has_changed = True
                continue
            skeleton = person.human.skeleton
            joints[name] = posed_joints(person.human, found)
            sizes[name] = skeleton.size_of(joints[name][: len(skeleton), :3, 3])
        posed = {name: self._camera(name, data, stamp) for name in self.topics.cameras}
        estimate, errors = self._estimate(data, poses)
        images = {
            name: self._images(
                name, camera, data, joints, wanted.channels, None if name in wanted.full else self._width
            )
            for name, camera in posed.items()
            if name in wanted.cameras and camera is not None
        }
        placed = {
            name: self._read(topic, data, Marker, messages.read_object)
            for name, topic in self.topics.objects.items()
            if name in self.objects
        }
        return ViewFrame(
            index=messages_of.index,
            stamp=stamp,
            scene_time=scene_time,
            joints=joints,
            sizes=sizes,
            objects={name: pose.matrix for name, pose in placed.items() if pose is not None},
            cameras={name: camera for name, camera in posed.items() if camera is not None},
            images=images,
            image_index=messages_of.index if any(images.values()) else None,
            estimate=estimate,
            estimate_errors=errors,
        )

    def _estimate(
        self, data: Mapping[str, bytes], poses: Mapping[str, JointPoses | None]
    ) -> tuple[dict[str, Array], dict[str, float]]:
        people = [pose for _, found in self.estimated(data) for pose in found]
        return self.beside(people, data, poses) if people else ({}, {})

    def beside(
        self,
        people: Sequence[Pose],
        data: Mapping[str, bytes],
        poses: Mapping[str, JointPoses | None] | None = None,
    ) -> tuple[dict[str, Array], dict[str, float]]:
        """Points and errors of an estimate by person, as :func:`beside_truth` returns them; empty if it
        fails.

        Args:
            people: People of the estimate, in ``map``, metres.
            data: Serialised message by topic.
            poses: True joints by person, if they have been read. If None, this method reads them.
        """
        truth, topic = self.truth(data, poses), next(iter(self.topics.estimate), "the estimate")
        return self._guarded(topic, lambda: beside_truth(people, truth, self._options)) or ({}, {})

    def estimated(self, data: Mapping[str, bytes]) -> list[tuple[str, list[Pose]]]:
        """People of the estimate in a frame, by topic, in ``map``, metres."""
        return [
            (topic, self._guarded(topic, partial(self._people, topic, person, data[topic])) or [])
            for topic, person in self.topics.estimate.items()
            if topic in data
        ]

    def truth(
        self, data: Mapping[str, bytes], poses: Mapping[str, JointPoses | None] | None = None
    ) -> dict[str, TruePoints]:
        """True joints or keypoints with which an estimate is compared, by person.

        Args:
            data: Serialised message by topic.
            poses: True joints by person, if they have been read. If None, this method reads them.
        """
        truth: dict[str, TruePoints] = {}
        for name, topics in self.topics.people.items():
            topic = topics.get("points", topics["joints"])
            known = poses is not None and "points" not in topics
            points = (
                poses.get(name)
                if known and poses is not None
                else self._read(topic, data, MultiDOFJointState, messages.read_joints)
            )
            if points is not None:
                truth[name] = points.names, points.positions[0]
        return truth

    def _people(self, topic: str, person: str | None, data: bytes) -> list[Pose]:
        """Read the people from a message of the estimate."""
        kind = self.topics.types[topic]
        message = deserialised(
            data, readable_type(kind), None if kind.endswith("PointCloud2") else _MAX_POSES
        )
        return people_of(read_people(kind, message, self._options.names), person, self._options)

    def _images(
        self,
        name: str,
        camera: Camera,
        data: Mapping[str, bytes],
        joints: Mapping[str, Array],
        channels: Collection[str],
        width: int | None,
    ) -> dict[str, Picture]:
        """Pictures of a camera, by channel, as far as the frame has them. ``width``: largest width, or
        None."""
        topics, images = self.topics.cameras[name], {}
        for channel in channels:
            own = "rgb" if channel == JOINTS else channel
            pixels = self._pixels(topics.images[own], data) if own in topics.images else None
            if pixels is not None:
                picture = self._guarded(topics.images[own], partial(_picture, own, *pixels))
                if picture is not None and channel == JOINTS:
                    picture = self._with_joints(picture, name, camera, data, joints)
                if picture is not None:
                    images[channel] = fitted(picture, width, channel)
        return images

    def _pixels(self, topic: str, data: Mapping[str, bytes]) -> tuple[NDArray[Any], str] | None:
        kind = Image if self.topics.types[topic] == IMAGE else CompressedImage
        return self._read(topic, data, kind, messages.read_pixels, _MAX_IMAGE)

    def _with_joints(
        self,
        picture: Picture,
        name: str,
        camera: Camera,
        data: Mapping[str, bytes],
        joints: Mapping[str, Array],
    ) -> Picture:
        """Draw the joints over a picture, as the camera's topic has them, or projected without such a
        topic."""
        for seen in self._joints_in_image(name, camera, data, joints):
            skeleton = self.people[seen.person].skeleton if seen.person in self.people else None
            tree = zip(skeleton.joint_names, skeleton.joint_parents, strict=True) if skeleton else ()
            above = dict(tree)
            parents = [above.get(joint) for joint in seen.names]
            picture = draw_joints(picture, seen.pixels, seen.visible, seen.names, parents)
        return picture

    def visibility(
        self, messages_of: TopicFrame, projected: Collection[str] = ()
    ) -> Iterator[tuple[str, str, NDArray[np.uint8]]]:
        """Yield person, camera and states (J,) of the joints, such as visible or occluded
        (:mod:`humansim_ros.scene`). Fingers, toes, jaw and eyes are left out. For cameras without a topic of
        joints, and for those in ``projected``, the joints are projected; then no joint counts as occluded."""
        found = self.frame(messages_of)
        for name, camera in found.cameras.items():
            topic = self.topics.cameras[name].joints
            if topic and topic not in messages_of.data and name not in projected:
                continue
            for seen in self._joints_in_image(name, camera, messages_of.data, found.joints):
                within = (seen.pixels >= -0.5) & (seen.pixels < np.array(camera.size) - 0.5)
                states = np.where(within.all(axis=1), seen.visible, OUTSIDE).astype(np.uint8)
                yield seen.person, name, states[body_joints(seen.names)]

    def _joints_in_image(
        self, name: str, camera: Camera, data: Mapping[str, bytes], joints: Mapping[str, Array]
    ) -> Iterator[JointsInImage]:
        """Yield the joints in the image of a camera, from its topic; without one, projected and not
        occluded."""
        topics = self.topics.cameras[name]
        points = self._read(topics.joints, data, PointCloud2, messages.read_joint_view)
        legend = self._legend(topics, "joints", data)
        if points is None or not legend:
            for person, poses in joints.items():
                positions = poses[:, :3, 3]
                pixels, depth = camera.project(positions)
                inside = (depth > 0) & np.isfinite(pixels).all(axis=1)
                visible = np.where(inside, VISIBLE, OUTSIDE).astype(np.uint8)
                known = self.people[person].skeleton.joint_names
                yield JointsInImage(person, known, pixels, visible, positions)
            return
        for label, person in _labels(legend.get("human")).items():
            rows = points[points["human"] == label]
            listed = legend.get("joint", {})
            names = [str(joint) for joint in listed.get(person, ())] if isinstance(listed, dict) else []
            rows = rows[rows["joint"] < len(names)]
            pixels = np.stack([rows["u"], rows["v"]], axis=1).astype(float)
            shown = [names[joint] for joint in rows["joint"]]
            name_here = spaced(topics.space, person)
            positions = self._positions(name_here, shown, joints)
            yield JointsInImage(name_here, shown, pixels, rows["visible"], positions)

    # --- pixels

    def describe(self, messages_of: TopicFrame, camera: str, x: int, y: int) -> PixelInfo:
        """Read the values of a pixel from the messages of a frame.

        Args:
            messages_of: Messages of the frame, including the channels :data:`PIXEL_CHANNELS`.
            camera: Name of the camera.
            x: Column, from 0 at the left.
            y: Row, from 0 at the top.

        Raises:
            RosError: There is no such camera, or the pixel is not in the image.
        """
        if camera not in self.topics.cameras or camera not in self.cameras:
            raise RosError(f"there is no camera '{printable(camera, 80)}'")
        data, topics = messages_of.data, self.topics.cameras[camera]
        seen_by = self._camera(camera, data, messages_of.stamp)
        assert seen_by is not None
        found: dict[str, Any] = {}
        for channel in PIXEL_CHANNELS:
            pixels = self._pixels(topics.images[channel], data) if channel in topics.images else None
            if pixels is not None:
                height, width = pixels[0].shape[:2]
                if not (0 <= x < width and 0 <= y < height):
                    raise RosError(
                        f"{camera} has no pixel ({x}, {y}): its images have {width}x{height} pixels"
                    )
                picked = pixels[0]
                if channel == "rgb" and pixels[1] in _COLORS:
                    picked = color_image(picked, pixels[1])
                elif pixels[1] in _MILLIMETRES and channel in ("rgb", "depth"):
                    channel, picked = "depth", _metres(picked)
                found[channel] = picked[y, x]
        values, world = surface_values(camera, (x, y), seen_by, found)
        if "depth" not in found:
            values["depth"] = "there is no topic with the depth"
        labels = _labels(self._legend(topics, "instance", data))
        labels = labels or _labels((self._legend(topics, "joints", data) or {}).get("human"))
        if label := int(found.get("instance", 0)):
            values["instance"] = f"{label} ({labels[label]})" if label in labels else str(label)
        if part := int(found.get("part", 0)):
            parts = _labels(self._legend(topics, "part", data))
            values["part"] = f"{part} ({parts[part]})" if part in parts else str(part)
        if face := int(found.get("face", 0)):
            values["face"] = str(face)
        posed = self.frame(messages_of).joints
        values |= near_joint_values(
            self._joints_in_image(camera, seen_by, data, posed), (x, y), seen_by.size[0]
        )
        return PixelInfo(values, world)

    def _positions(self, person: str, names: Sequence[str], joints: Mapping[str, Array]) -> Array:
        """Positions (J, 3) of joints in ``map``; NaN where they are not known."""
        known = {}
        if person in joints:
            known = dict(zip(self.people[person].skeleton.joint_names, joints[person][:, :3, 3], strict=True))
        return np.array([known.get(name, np.full(3, np.nan)) for name in names]).reshape(-1, 3)

    # --- reading

    def _legend(self, topics: SeenCamera, kind: str, data: Mapping[str, bytes]) -> dict[str, Any]:
        if kind not in topics.legends:
            return {}
        return self._read(topics.legends[kind], data, String, messages.read_legend) or {}

    def _read(
        self,
        topic: str,
        data: Mapping[str, bytes],
        kind: Any,
        reader: Callable[[Any], Value],
        limit: int | None = None,
    ) -> Value | None:
        """Read the message of a topic (cached); None if there is no message, or it cannot be read."""
        content = data.get(topic)
        if content is None:
            return None
        last = self._read_last.get((topic, reader))
        if last is None or last[0] is not content:
            value = self._guarded(topic, lambda: reader(deserialised(content, kind, limit)))
            last = self._read_last[topic, reader] = content, value
        value_again: Value | None = last[1]
        return value_again

    def _guarded(self, topic: str, read: Callable[[], Value]) -> Value | None:
        """Call ``read`` and return its result. If it fails, tell the user, and return None."""
        try:
            return read()
        except HumansimError as error:
            self.note(f"{topic}: {error.message}")
        except Exception as reason:  # contents come from other programs
            self.note(f"{topic}: a message cannot be read: {type(reason).__name__}: {reason}")
        return None


def _joints(data: bytes) -> JointPoses:
    return messages.read_joints(deserialised(data, MultiDOFJointState))


def _vertices(data: bytes) -> Float32Array:
    return messages.read_vertices(deserialised(data, PointCloud2))


def _read_calibration(message: CameraInfo) -> tuple[Camera | None, tuple[str, Camera]]:
    """Read a camera, at the origin; None if uncalibrated. Also returns its tf frame and a camera to
    assume."""
    frame = str(message.header.frame_id)[:256]
    width, height = max(1, message.width), max(1, message.height)
    K = np.array([[width, 0, (width - 1) / 2], [0, width, (height - 1) / 2], [0, 0, 1]], float)
    assumed = Camera((width, height), K, np.eye(3), np.zeros(3))
    if not any(message.k):
        return None, (frame, assumed)
    return messages.read_region(message).of(messages.read_camera_info(message)), (frame, assumed)


def _read_marker(message: Marker) -> Mesh:
    """Mesh of a marker in its own frame. Files that a marker names are not read, because any program can send
    markers."""
    messages.read_object(message)
    color = np.array([message.color.r, message.color.g, message.color.b])
    color = np.rint(255 * np.clip(np.nan_to_num(color), 0, 1)).astype(np.uint8)
    if message.type == Marker.TRIANGLE_LIST and len(message.points) >= 3:
        points = np.array([(p.x, p.y, p.z) for p in message.points[:_MAX_POINTS]])
        corners = np.arange(len(points) // 3 * 3, dtype=np.int32).reshape(-1, 3)
        mesh = Mesh(points, np.concatenate([corners, np.full_like(corners[:, :1], -1)], axis=1))
    else:
        mesh = SHAPES[_MARKERS.get(message.type, "box")]()
    return replace(mesh, colors=np.tile(color, (len(mesh.vertices), 1)))


def _picture(channel: str, pixels: NDArray[Any], encoding: str) -> Picture:
    """Make a viewable picture of an image of a channel. Raises RosError if the encoding does not fit."""
    if channel == "rgb" and encoding in _COLORS:
        return color_image(pixels, encoding)
    if channel in ("rgb", "depth") and encoding in _MILLIMETRES:
        return color_depth(_metres(pixels))
    if channel in ("rgb", "depth") and encoding == "32FC1":
        return color_depth(pixels)
    if channel in ("rgb", "depth") or not messages.fits_channel(pixels, channel):
        raise RosError(f"an image of encoding {encoding} is no image of {channel}")
    return color_channel(channel, pixels)


def _metres(millimetres: NDArray[Any]) -> NDArray[np.float32]:
    """Convert depth to metres; 0 (no measurement) becomes infinite."""
    return np.where(millimetres > 0, millimetres / 1000.0, np.inf).astype(np.float32)


def _labels(legend: object) -> dict[int, str]:
    """Names by label in a legend, without label 0, the background."""
    if not isinstance(legend, dict):
        return {}
    return {int(key): str(name) for key, name in legend.items() if str(key).isdecimal() and int(key) > 0}


#: Period that is assumed for a source with a single frame, nanoseconds.
PERIOD = 33_333_333
#: Number of frames from which the skinning weights of an unknown body are computed.
SAMPLES = 4


class TopicSource(ViewSource):
    """Source of a page that shows topics. ``shown``: makes frames from messages."""

    def __init__(self, shown: TopicFrames) -> None:
        self._shown, self._topics = shown, SeenTopics()

    @property
    def topics(self) -> SeenTopics:
        """The topics that the page shows."""
        return self._topics

    @property
    def people(self) -> Mapping[str, Human]:
        return self._shown.people

    @property
    def objects(self) -> Mapping[str, Mesh]:
        return self._shown.objects

    @property
    def static(self) -> Mapping[str, Mesh]:
        """Empty, since no topic has the room."""
        return {}

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """Cameras by name, at their last known poses."""
        return self._shown.cameras

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels that the topics have, and ``joints`` (drawn over the image) if there are people."""
        names = list(self.topics.channels)
        if "rgb" in names and self.topics.people:
            names.insert(names.index("rgb") + 1, JOINTS)
        return tuple(names)

    @property
    def messages(self) -> Sequence[str]:
        return self._shown.messages
