"""Export from a bag: the frames are read from the topics of the bag. Nothing is rendered or computed again.

A stamp is a frame if all topics that the formats need have a message with this stamp. Frames are numbered
from 0 in the order of their stamps.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.data import messages
from humansim_ros.data.formats.formats import BODIES, BOXES, KEYPOINTS, POSITIONS, ExportFormat
from humansim_ros.data.formats.source import versions
from humansim_ros.data.formats.writer import ExportCamera, ExportScene
from humansim_ros.data.messages.camera_topics import COMPRESSED
from humansim_ros.data.messages.camera_truth import JOINT_POINT, body_box, joint_places
from humansim_ros.data.messages.cdr import deserialised
from humansim_ros.data.messages.frames import Frames
from humansim_ros.data.messages.types import (
    CameraInfo,
    CompressedImage,
    Image,
    MultiDOFJointState,
    PointCloud2,
    String,
    TimeReference,
    TransformStamped,
)
from humansim_ros.data.recorded import BagFrame, BagTruth, Place, RecordedMessages
from humansim_ros.errors import ExportError, located, printable, some_of, warn_about
from humansim_ros.files.reading import parse_json
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.render.interface import CHANNEL_TABLE, View
from humansim_ros.scene.config import MAX_LICENSE
from humansim_ros.scene.core import CameraPose
from humansim_ros.scene.truth import BodyBox, KeypointView
from humansim_ros.types import Array

#: Largest message that is read, bytes.
_MAX_MESSAGE = 1 << 31
#: Channels about parts of bodies. They need the names of the parts.
_PARTS = {"part", "body_part"}
_LABELLED = {"instance", *_PARTS, BOXES, KEYPOINTS}
_SCENE_TIME = "/scene_time"
#: Topics that every format needs.
_ALWAYS = ("/scene_time", "*/camera_info", "*/extrinsics", "*/joints/legend", "*/part/legend")
#: Most topics that a warning or error lists.
_MAX_LISTED = 4


class _FramePlaces(NamedTuple):
    """Where a frame is in the bag: stamp in nanoseconds, and the place of the message by topic."""

    stamp: int
    places: Mapping[str, Place]


@dataclass(frozen=True)
class _Needed:
    """Names of the topics that must have a message in each complete frame, by kind of content.

    Attributes:
        channels: Topics of images by camera and channel.
        boxes: Topics of boxes by camera.
        keypoints: Topics of 2D keypoints by camera.
        positions: Topics of 3D keypoints by set of keypoints and person.
        extrinsics: Topics of poses by camera, for moving cameras.
    """

    channels: Mapping[tuple[str, str], str]
    boxes: Mapping[str, str]
    keypoints: Mapping[str, str]
    positions: Mapping[tuple[str, str], str]
    extrinsics: Mapping[str, str]

    @property
    def topics(self) -> list[str]:
        """Names of all topics, without repetitions."""
        return list(dict.fromkeys([*self.positions.values(), *self.cameras]))

    @property
    def cameras(self) -> dict[str, str]:
        """Name of the camera by topic, for the topics that belong to a camera."""
        owned = {topic: camera for (camera, _), topic in self.channels.items()}
        for topics in (self.boxes, self.keypoints, self.extrinsics):
            owned |= {topic: camera for camera, topic in topics.items()}
        return owned


@dataclass(frozen=True)
class BagSource:
    """A bag that is read for some formats.

    Attributes:
        path: The bag.
        formats: The formats to be exported.
        keypoints: Name of the keypoint set.
        scene: Description of the scene for the writers of formats.
        hash: Hash of the topics, sizes and times of the bag.
        custom: Texts in ``custom_data`` of the bag.
        needed: Topics that are read.
        frames: Stamp and messages of each complete frame.
    """

    path: Path
    formats: tuple[ExportFormat, ...]
    keypoints: str
    scene: ExportScene
    hash: str
    custom: Mapping[str, str]
    needed: _Needed
    frames: tuple[_FramePlaces, ...]
    step = "reading"

    @classmethod
    def read(cls, path: Path, formats: Sequence[ExportFormat], keypoints: str = "coco17") -> BagSource:
        """Find out what a bag contains. All messages are read once, to find the complete frames.

        Args:
            path: The bag.
            formats: The formats to be exported.
            keypoints: Name of the keypoint set.

        Raises:
            ExportError: The bag lacks a topic that a format needs, or no frame is complete.
            BagError: The bag cannot be read.
        """
        with RecordedMessages(path) as recorded:
            return _Survey(recorded, tuple(formats), keypoints).source()

    @property
    def count(self) -> int:
        """Number of frames."""
        return len(self.frames)

    def device(self) -> str:
        """Name of the device that renders: empty, since nothing is rendered."""
        return ""

    def open(self) -> BagFrames:
        """Open the bag and return a reader of its frames."""
        return BagFrames(self)

    def provenance(self, frames: range) -> dict[str, Any]:
        """Describe the origin of the data: bag, plan of the recording, and stamps of the frames."""
        return {
            "bag": self.path.name,
            "bag_hash": self.hash,
            "recording": {name: _parsed(text) for name, text in self.custom.items()},
            "stamps": [self.frames[index].stamp for index in frames],
            "versions": versions(),
        }


def _rate(stamps: Sequence[int]) -> float:
    """Estimate the frames per second from stamps in nanoseconds. The result is 1 for a single stamp."""
    steps = np.diff(stamps)
    return round(1e9 / float(np.median(steps)), 4) if len(steps) else 1.0


def _parsed(text: str) -> Any:
    try:
        return parse_json(text, ExportError)
    except ExportError:
        return text


class _Survey:
    """Finds out what a bag contains for some formats. The arguments are those of :meth:`BagSource.read`."""

    def __init__(self, recorded: RecordedMessages, formats: tuple[ExportFormat, ...], keypoints: str) -> None:
        self._recorded, self._formats, self._keypoints = recorded, formats, keypoints
        # in the order of the bag, which is the order of the scene if humansim has recorded it
        self._topics = recorded.topics
        self._content = frozenset[str]().union(*(row.content for row in formats))

    def source(self) -> BagSource:
        """Build the source of the export."""
        for row in self._formats:
            if BODIES in row.content:
                self._refuse(row, "needs bodies with their skeleton, which no topic has: export the scene")
        cameras = self._camera_names()
        needed = self._needed(cameras)
        frames, pictured = self._frames(needed, cameras)
        labels, objects, licenses, license = self._labels(cameras)
        parts = self._parts(cameras)
        scene = ExportScene(
            title=self._recorded.path.stem,
            rate=_rate([place.stamp for place in frames]),
            cameras={
                name: self._camera(name, name in needed.extrinsics, needed, frames, pictured[name])
                for name in cameras
            },
            labels=labels,
            objects=objects,
            parts={name: parts for name in labels if name not in objects},
            licenses=licenses,
            license=license,
        )
        path, custom = self._recorded.path, self._recorded.reader.info.custom
        return BagSource(
            path, self._formats, self._keypoints, scene, self._hash(), dict(custom), needed, tuple(frames)
        )

    def _refuse(self, row: ExportFormat, text: str) -> None:
        raise ExportError(f"the format {row.name} {text}", path=self._recorded.path, key="--format")

    def _camera_names(self) -> list[str]:
        """Names of the cameras, found by topics that only cameras have, not scanners."""
        ends = ("camera_info", "image_raw", "joints/legend", "boxes")
        split = (topic.removeprefix("/").partition("/") for topic in self._topics)
        names = dict.fromkeys(name for name, _, rest in split if rest.startswith(ends))
        cameras = [name for name in names if name not in ("humans", "objects")]
        if all(row.content == {POSITIONS} and not row.keypoints for row in self._formats):
            # only paths of points are written: cameras with unknown parts are left out
            known = [
                {f"/{name}/camera_info", f"/{name}/extrinsics"} <= self._topics.keys() for name in cameras
            ]
            cameras = list(compress(cameras, known))
        return cameras

    def _people(self) -> list[str]:
        """Names of the people that have topics."""
        parts = (topic.split("/") for topic in self._topics)
        return list(dict.fromkeys(each[2] for each in parts if each[1] == "humans" and len(each) > 3))

    def _needed(self, cameras: Sequence[str]) -> _Needed:
        """Topics that each frame needs. Raises ExportError if the bag lacks one."""
        channels: dict[tuple[str, str], str] = {}
        boxes, keypoints, extrinsics = {}, {}, {}
        positions: dict[tuple[str, str], str] = {}
        for row in self._formats:
            for camera in cameras:
                self._require(row, f"/{camera}/camera_info")
                self._require(row, f"/{camera}/extrinsics")
                if row.content & _LABELLED:
                    self._require(row, f"/{camera}/joints/legend")
                if row.content & _PARTS:
                    self._require(row, f"/{camera}/part/legend")
                for channel in sorted(row.content & CHANNEL_TABLE.keys()):
                    own = f"/{camera}/{CHANNEL_TABLE[channel].topic}"
                    other = f"{own}/{COMPRESSED.get(channel, '')}"
                    channels[camera, channel] = other if other in self._topics else self._require(row, own)
                if BOXES in row.content:
                    boxes[camera] = self._require(row, f"/{camera}/boxes")
                if KEYPOINTS in row.content:
                    keypoints[camera] = self._require(row, f"/{camera}/keypoints/{self._keypoints}")
            if POSITIONS in row.content:
                chosen = row.keypoints or self._keypoints
                for person in self._people() or ["<id>"]:
                    topic = self._require(row, f"/humans/{person}/keypoints/{chosen}")
                    positions[chosen, person] = topic
            if not cameras and (row.content != {POSITIONS} or row.keypoints):
                self._require(row, "/<camera>/camera_info")
        for camera in cameras:
            topic = f"/{camera}/extrinsics"
            if len({_pose_key(each) for each in self._messages(topic, TransformStamped)}) > 1:
                extrinsics[camera] = topic
        return _Needed(channels, boxes, keypoints, positions, extrinsics)

    def _require(self, row: ExportFormat, topic: str) -> str:
        """Return ``topic`` if the bag has this topic. Otherwise raises ExportError, which names the command
        that records all topics."""
        if topic not in self._topics:
            self._refuse(
                row,
                f"needs the topic {topic}, which the bag does not have; record one with "
                f"humansim record … --topics '{','.join(recorded_patterns(self._formats, self._keypoints))}'",
            )
        return topic

    def _messages(self, topic: str, kind: type[Any]) -> Iterator[Any]:
        for _, _, message in self._recorded.each([topic], lambda data, _: _message(data, kind), ExportError):
            yield message

    def _first(self, topic: str, kind: type[Any]) -> Any:
        return next(self._messages(topic, kind))

    def _labels(self, cameras: Sequence[str]) -> tuple[dict[str, int], dict[str, str], dict[str, str], str]:
        """Read from the legend of a camera: instance labels by name, kinds of objects, licences of people,
        licence of data sets. Without a legend, the labels are those of people with topics."""
        for camera in cameras:
            topic = f"/{camera}/joints/legend"
            if topic in self._topics:
                legend = self._legend(topic)
                people, objects = legend.get("human", {}), legend.get("object", {})
                labels = {str(name): int(label) for each in (people, objects) for label, name in each.items()}
                stated = legend.get("license")
                known = stated.items() if isinstance(stated, dict) else ()
                licenses = {str(name): str(text)[:MAX_LICENSE] for name, text in known if name in labels}
                stated = printable(str(legend.get("data_license", "")), MAX_LICENSE)
                return labels, {str(name): str(name) for name in objects.values()}, licenses, stated
        return {name: number for number, name in enumerate(self._people(), 1)}, {}, {}, ""

    def _parts(self, cameras: Sequence[str]) -> tuple[str, ...]:
        """Names of the body parts with label 1, 2 and so on. They must be the same for all people."""
        for camera in cameras:
            topic = f"/{camera}/part/legend"
            if topic in self._topics:
                legend = self._legend(topic)
                return tuple(str(legend[key]) for key in sorted(legend, key=int) if key != "0")
        return ()

    def _legend(self, topic: str) -> dict[str, Any]:
        with _reading(self._recorded.path, topic):
            return messages.read_legend(self._first(topic, String))

    def _camera(
        self, name: str, moves: bool, needed: _Needed, frames: Sequence[_FramePlaces], pictured: Sequence[int]
    ) -> ExportCamera:
        """Calibration of the images of a camera, at its first pose. ``pictured``: numbers of the frames with
        images of this camera."""
        topic = f"/{name}/camera_info"
        with _reading(self._recorded.path, topic):
            info = self._first(topic, CameraInfo)
            camera = messages.read_region(info).of(messages.read_camera_info(info))
        topic = f"/{name}/extrinsics"
        with _reading(self._recorded.path, topic):
            pose = messages.read_extrinsics(self._first(topic, TransformStamped))
        encoding = "rgb8"
        image = needed.channels.get((name, "rgb"))
        if image is not None:
            with _reading(self._recorded.path, image):
                encoding = messages.read_pixels(self._first(image, _image_type(image)))[1]
        rate = _rate([frames[index].stamp for index in pictured])
        return ExportCamera(
            _simple(replace(camera, R=pose.R, t=pose.t)), moves, encoding, rate, frozenset(pictured)
        )

    def _frames(
        self, needed: _Needed, cameras: Sequence[str]
    ) -> tuple[list[_FramePlaces], dict[str, list[int]]]:
        """Find the complete frames: stamps at which every topic that is due has a message. Cameras may have
        their own rates. Returns the frames, and the numbers of the frames of each camera. Warns of incomplete
        stamps."""
        topics = needed.topics or [f"/{cameras[0]}/camera_info"]
        found: Frames[Place] = Frames(topics)
        scene_times: dict[int, Place] = {}
        read = [*topics, _SCENE_TIME] if _SCENE_TIME in self._topics else topics
        for name, place, data in self._recorded.places(read):
            with _reading(self._recorded.path, name):
                stamp = messages.serialised_stamp(data[:12])
            if name == _SCENE_TIME:
                scene_times.setdefault(stamp, place)
            elif name not in found.frame(stamp):
                found.add(name, stamp, place)
        due = {}
        for camera in cameras:
            own = [topic for topic, owner in needed.cameras.items() if owner == camera]
            due[camera] = found.require_when_due(own) if own else set(found.stamps())
        whole = found.whole()
        if len(whole) < len(found):
            text = f"{len(found) - len(whole)} of {len(found)} frames lack a message on "
            text += some_of(found.lacking(), _MAX_LISTED)
            if not whole:
                raise ExportError(f"no frame is whole: {text}", path=self._recorded.path)
            warn_about(self._recorded.path, f"{text}: they are left out")
        places = []
        for stamp in whole:
            scene_time = {_SCENE_TIME: scene_times[stamp]} if stamp in scene_times else {}
            places.append(_FramePlaces(stamp, {**found.frame(stamp), **scene_time}))
        numbers = {
            camera: [index for index, stamp in enumerate(whole) if stamp in stamps]
            for camera, stamps in due.items()
        }
        return places, numbers

    def _hash(self) -> str:
        """Hash of the bag: topics, numbers of messages, sizes and times."""
        reader = self._recorded.reader
        info = reader.info
        topics = sorted(
            (topic.name, topic.type, info.counts.get(n, 0)) for n, topic in enumerate(reader.topics)
        )
        content = [topics, [path.stat().st_size for path in info.files], info.start, info.end]
        return hashlib.sha256(json.dumps([*content, dict(info.custom)]).encode()).hexdigest()


def recorded_patterns(formats: Iterable[ExportFormat], keypoints: str) -> list[str]:
    """Topics that some formats need, as arguments of ``humansim record --topics``."""
    patterns = dict.fromkeys(_ALWAYS)
    for row in formats:
        for name in sorted(row.content):
            if name in CHANNEL_TABLE:
                patterns[f"*/{CHANNEL_TABLE[name].topic}"] = None
            elif name == BOXES:
                patterns["*/boxes"] = None
            else:
                patterns[f"*/keypoints/{row.keypoints or keypoints}"] = None
    return list(patterns)


class BagFrames:
    """Reads frames of a bag in any order. ``source``: the bag, which is opened."""

    device = ""

    def __init__(self, source: BagSource) -> None:
        self._source = source
        self._recorded = RecordedMessages(source.path)

    def close(self) -> None:
        """Close the bag."""
        self._recorded.close()

    def frame(self, index: int) -> BagFrame:
        """Read a frame, with the data that the formats need.

        Raises:
            ExportError: A message of the frame is damaged.
        """
        source, place = self._source, self._source.frames[index]
        needed, scene = source.needed, source.scene
        data = self._data(place)

        def read(topic: str, kind: type[Any], reader: Callable[[Any], Any]) -> Any:
            with _reading(source.path, topic):
                return reader(_message(data[topic], kind))

        cameras = {name: known.camera for name, known in scene.cameras.items() if index in known.frames}
        for name, topic in needed.extrinsics.items():
            if name in cameras:
                pose: CameraPose = read(topic, TransformStamped, messages.read_extrinsics)
                cameras[name] = replace(cameras[name], R=pose.R, t=pose.t)
        images: dict[str, dict[str, NDArray[Any]]] = {}
        for (camera, channel), topic in needed.channels.items():
            if camera in cameras:
                pixels = read(topic, _image_type(topic), _reader_of(channel))
                images.setdefault(camera, {})[channel] = pixels
        views = {camera: View(**channels) for camera, channels in images.items()}
        boxes = {
            camera: self._boxes(read(topic, PointCloud2, messages.read_boxes))
            for camera, topic in needed.boxes.items()
            if camera in cameras
        }
        keypoints = {
            camera: self._keypoints(read(topic, PointCloud2, _read_points), cameras[camera])
            for camera, topic in needed.keypoints.items()
            if camera in cameras
        }
        positions: dict[str, dict[str, Array]] = {}
        for (chosen, person), topic in needed.positions.items():
            poses = read(topic, MultiDOFJointState, messages.read_joints)
            if poses.names != keypoint_set(chosen).names:
                raise ExportError(f"the points are not the points of {chosen}", path=source.path, key=topic)
            positions.setdefault(chosen, {})[person] = poses.positions[0]
        scene_time = place.stamp - source.frames[0].stamp
        if _SCENE_TIME in data:
            scene_time = read(_SCENE_TIME, TimeReference, messages.read_scene_time)
        return BagFrame(
            index=index,
            stamp=place.stamp,
            humans={},
            views=views,
            truth={
                name: BagTruth.of(camera, views.get(name, View()), scene.labels, boxes.get(name, {}))
                for name, camera in cameras.items()
            },
            cameras=cameras,
            labels=scene.labels,
            scene_time=scene_time,
            recorded_keypoints={source.keypoints: keypoints},
            recorded_positions=positions,
        )

    def _data(self, frame: _FramePlaces) -> dict[str, bytes]:
        """Read the messages of a frame by topic."""
        found = self._recorded.read(frame.places)
        if lost := [topic for topic in frame.places if topic not in found]:
            raise ExportError("the bag has changed, or is damaged", path=self._source.path, key=lost[0])
        return found

    def _boxes(self, points: NDArray[Any]) -> dict[str, BodyBox]:
        """Boxes by name of a human or object."""
        by_label = {int(point["instance"]): point for point in points}
        return {
            name: body_box(point)
            for name, label in self._source.scene.labels.items()
            if (point := by_label.get(label)) is not None
        }

    def _keypoints(self, points: NDArray[Any], camera: Camera) -> dict[str, KeypointView]:
        """Keypoints in an image by person."""
        scene, found = self._source.scene, {}
        count = len(keypoint_set(self._source.keypoints))
        for name in scene.people:
            rows = points[points["human"] == scene.labels[name]]
            rows = rows[np.argsort(rows["joint"], kind="stable")]
            if rows["joint"].tolist() != list(range(count)):
                raise ExportError(
                    f"{len(rows)} points of {name} are not the points of {self._source.keypoints}",
                    path=self._source.path,
                )
            pixels, optical = joint_places(rows)
            found[name] = KeypointView(
                optical=optical,
                pixels=pixels,
                visible=rows["visible"],
                occluder=rows["occluder"],
                by=rows["by"],
                behind=rows["behind"],
                positions=(optical - camera.t) @ camera.R,
                certain=np.zeros(count, dtype=bool),  # no topic says it
            )
        return found


def _reading(path: Path, topic: str) -> AbstractContextManager[None]:
    """Name the bag and the topic in errors about a message."""
    return located(ExportError, path, key=topic)


def _message(data: bytes, kind: type[Any]) -> Any:
    return deserialised(data, kind, _MAX_MESSAGE)


def _read_points(message: PointCloud2) -> NDArray[Any]:
    return messages.read_points(message, JOINT_POINT.names or ())


def _reader_of(channel: str) -> Callable[[Any], NDArray[Any]]:
    """Function that reads the images of a channel from messages. ExportError for lossy labels."""
    row = CHANNEL_TABLE[channel]

    def pixels(message: Any) -> NDArray[Any]:
        read, encoding = messages.read_pixels(message)
        form = getattr(message, "format", "")
        if row.encoding.startswith("mono") and (read.dtype != row.dtype or read.ndim != 2 or "jpeg" in form):
            found = printable(form or encoding, 60)
            raise ExportError(f"{channel} as {found!r} is not exact; {row.encoding}, raw or PNG, is")
        return read

    return pixels


def _image_type(topic: str) -> type[Any]:
    return CompressedImage if topic.endswith(tuple(COMPRESSED.values())) else Image


def _simple(camera: Camera) -> Camera:
    """Remove the rectification of a camera if its matrices follow from the other values."""
    simple = replace(camera, rectification=None, rectified=None)
    same = np.allclose(simple.rectification_matrix, camera.rectification_matrix, atol=1e-12)
    same &= np.allclose(simple.rectified_projection, camera.rectified_projection, atol=1e-9)
    return simple if same else camera


def _pose_key(message: TransformStamped) -> tuple[float, ...]:
    p, q = message.transform.translation, message.transform.rotation
    return (p.x, p.y, p.z, q.x, q.y, q.z, q.w)
