"""Finds the topics of any program that a page can show, by name and type; and the tree of tf."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

from humansim_ros.data.evaluation import topic_pattern, topic_person
from humansim_ros.data.messages import (
    CHANNEL_OF_TOPIC,
    COMPRESSED,
    MEASURED_DEPTH,
    MESSAGE_TYPES,
    TF,
    TF_STATIC_TOPIC,
    TF_TOPIC,
)
from humansim_ros.people.keypoints import KeypointSet

CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_JOINTS, _CLOUD = "sensor_msgs/msg/MultiDOFJointState", "sensor_msgs/msg/PointCloud2"
_MESH, _MARKER, _TEXT = "shape_msgs/msg/Mesh", "visualization_msgs/msg/Marker", "std_msgs/msg/String"
_POSES = {"extrinsics": "geometry_msgs/msg/TransformStamped", "pose": "geometry_msgs/msg/PoseStamped"}
_TIME = "sensor_msgs/msg/TimeReference"
#: Suffixes of the names of compressed image topics.
_COMPRESSED = tuple(dict.fromkeys(f"/{end}" for end in COMPRESSED.values()))
#: Namespaces below a camera in which its ``camera_info`` is published again.
_BELOW = frozenset(topic.rpartition("/")[0] for topic in CHANNEL_OF_TOPIC) - {""} | {*MEASURED_DEPTH}
#: Topics (of other programs) that serve as the image of a camera without ``image_raw``, the best first.
_PICTURES = ("image_color", "image", "image_rect_color", "image_rect", "image_mono", "image_rect_raw")
_HUMAN = re.compile(r"/(?:(?P<space>.+)/)?humans/(?P<name>[^/]+)/(?P<kind>joints|mesh|vertices)")
_OBJECT = re.compile(r"/(?:(?P<space>.+)/)?objects/(?P<name>[^/]+)/marker")
_KINDS = {"joints": _JOINTS, "mesh": _MESH, "vertices": _CLOUD}
#: Topics of tf.
TF_TOPICS = (f"/{TF_STATIC_TOPIC}", f"/{TF_TOPIC}")
#: Most cameras, people, objects and topics of an estimate that are shown, since programs may publish more.
MAX_CAMERAS, MAX_PEOPLE, MAX_OBJECTS, MAX_ESTIMATES = 64, 64, 256, 100


@dataclass(frozen=True)
class SeenCamera:
    """Topics of a camera.

    Attributes:
        info: Topic ``camera_info`` of the camera.
        images: Topic by channel.
        poses: Topics with the pose of the camera, the best first.
        joints: Topic of the joints in the image; empty if there is none.
        legends: Topics of the legends (names of labels) by kind: ``joints``, ``instance``, ``part``.
        space: Namespace of the simulation that the camera belongs to.
    """

    info: str
    images: Mapping[str, str] = field(default_factory=dict)
    poses: Sequence[str] = ()
    joints: str = ""
    legends: Mapping[str, str] = field(default_factory=dict)
    space: str = ""


@dataclass(frozen=True)
class SeenTopics:
    """Topics of a graph or bag, sorted by what they show.

    Attributes:
        cameras: Topics of each camera, by name.
        people: Topics of each person, by name: ``joints``; ``mesh``, ``vertices``, ``points`` (keypoints) if
            they exist.
        objects: Topic of the marker of each object, by name.
        scene_time: Topic of the scene time; empty if there is none.
        transforms: Topics of tf.
        estimate: Topics of the estimate, with the name of the person; None if the messages name the people.
        others: Topics of images that cannot be shown, because no ``camera_info`` belongs to them.
        types: Message type of each topic.
    """

    cameras: Mapping[str, SeenCamera] = field(default_factory=dict)
    people: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    objects: Mapping[str, str] = field(default_factory=dict)
    scene_time: str = ""
    transforms: Sequence[str] = ()
    estimate: Mapping[str, str | None] = field(default_factory=dict)
    others: Sequence[str] = ()
    types: Mapping[str, str] = field(default_factory=dict)

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of all cameras, in the order of the table of channels."""
        found = {channel for camera in self.cameras.values() for channel in camera.images}
        return tuple(name for name in CHANNEL_OF_TOPIC.values() if name in found)

    @property
    def on_demand(self) -> set[str]:
        """Large topics, which are read only when they are needed: images, joints in them, and vertices."""
        found = {topics["vertices"] for topics in self.people.values() if "vertices" in topics}
        for camera in self.cameras.values():
            found |= {*camera.images.values(), camera.joints}
        return found

    @property
    def light(self) -> SeenTopics:
        """Small topics: poses of people and cameras, joints in images, and the estimate."""
        people = {
            name: {kind: topic for kind, topic in topics.items() if kind in ("joints", "points")}
            for name, topics in self.people.items()
        }
        cameras = {
            name: replace(
                camera, images={}, legends={k: v for k, v in camera.legends.items() if k == "joints"}
            )
            for name, camera in self.cameras.items()
        }
        return SeenTopics(cameras=cameras, people=people, estimate=self.estimate, types=self.types)

    @property
    def lasting(self) -> set[str]:
        """Topics with messages that stay valid until the next message, such as calibrations and poses."""
        found = {topics["mesh"] for topics in self.people.values() if "mesh" in topics}
        for camera in self.cameras.values():
            found |= {camera.info, *camera.poses, *camera.legends.values()}
        return found

    @property
    def topics(self) -> list[str]:
        """All topics that the page uses."""
        found = [self.scene_time, *self.transforms, *self.estimate, *self.objects.values()]
        for topics in self.people.values():
            found += topics.values()
        for camera in self.cameras.values():
            found += [camera.info, *camera.images.values(), *camera.poses, camera.joints]
            found += camera.legends.values()
        return [topic for topic in dict.fromkeys(found) if topic]


def seen_topics(
    types: Mapping[str, str], estimate: str | None = None, keypoints: KeypointSet | None = None
) -> SeenTopics:
    """Find the topics of a graph or a bag that the page can show.

    Args:
        types: Message type by absolute name of each topic.
        estimate: Topic of a tracker's estimate; ``*`` stands for the name of a person. None: there is none.
        keypoints: Keypoint set of the estimate. If None, the estimate has joints.
    """
    cameras = _cameras(types)
    images = {name for name, kind in types.items() if kind in (IMAGE, COMPRESSED_IMAGE)}
    # crops of ROS4HRI belong to bodies and faces
    shown = ["/humans/", *(f"{camera.info.rpartition('/')[0]}/" for camera in cameras.values())]
    pattern = topic_pattern(estimate) if estimate else None
    poses = [name for name, kind in types.items() if kind in MESSAGE_TYPES] if pattern is not None else []
    found = {name: match for name in poses if pattern is not None and (match := pattern.fullmatch(name))}
    return SeenTopics(
        cameras=cameras,
        people=_people(types, keypoints),
        objects=_objects(types),
        scene_time=next(
            (name for name, kind in types.items() if name.endswith("/scene_time") and kind == _TIME), ""
        ),
        transforms=[name for name in TF_TOPICS if types.get(name) == TF],
        estimate={name: topic_person(match) for name, match in list(found.items())[:MAX_ESTIMATES]},
        others=sorted(name for name in images if not name.startswith(tuple(shown))),
        types=dict(types),
    )


def _cameras(types: Mapping[str, str]) -> dict[str, SeenCamera]:
    spaces = [
        name.removesuffix("/camera_info")
        for name, kind in types.items()
        if kind == CAMERA_INFO and name.endswith("/camera_info")
    ]
    own = [space for space in spaces if not _is_below(space, spaces)]
    return {space.strip("/"): _camera(space, types, own) for space in own[:MAX_CAMERAS]}


def _is_below(space: str, spaces: Collection[str]) -> bool:
    """Whether a namespace, such as ``/left/depth``, is another image of the camera ``/left``, not a
    camera."""
    above, _, last = space.rpartition("/")
    return last in _BELOW and above in spaces


def _camera(space: str, types: Mapping[str, str], spaces: Collection[str]) -> SeenCamera:
    below = f"{space}/"
    inner = tuple(f"{other}/" for other in spaces if other != space and other.startswith(below))
    own = {
        name.removeprefix(below): kind
        for name, kind in types.items()
        if name.startswith(below) and not (inner and name.startswith(inner))
    }
    images: dict[str, str] = {}
    for relative, kind in own.items():
        plain = relative
        if kind == COMPRESSED_IMAGE:
            plain = next((relative.removesuffix(end) for end in _COMPRESSED if relative.endswith(end)), "")
        elif kind != IMAGE:
            continue
        channel = CHANNEL_OF_TOPIC.get(plain)
        if channel is not None and (kind == IMAGE or channel not in images):
            images[channel] = below + relative
    if "rgb" not in images:
        candidates = (f"{name}{end}" for name in _PICTURES for end in ("", *_COMPRESSED[:1]))
        other = next((name for name in candidates if own.get(name) in (IMAGE, COMPRESSED_IMAGE)), None)
        if other is not None:
            images["rgb"] = below + other
    return SeenCamera(
        info=f"{below}camera_info",
        images=images,
        poses=[below + name for name, kind in _POSES.items() if own.get(name) == kind],
        joints=f"{below}joints" if own.get("joints") == _CLOUD else "",
        legends={
            kind: f"{below}{kind}/legend"
            for kind in ("joints", "instance", "part")
            if own.get(f"{kind}/legend") == _TEXT
        },
        space=space.strip("/").rpartition("/")[0],
    )


def _people(types: Mapping[str, str], keypoints: KeypointSet | None) -> dict[str, dict[str, str]]:
    people: dict[str, dict[str, str]] = {}
    for topic, kind in types.items():
        match = _HUMAN.fullmatch(topic)
        if match and kind == _KINDS[match["kind"]]:
            name = spaced(match["space"] or "", match["name"])
            if name in people or len(people) < MAX_PEOPLE:
                people.setdefault(name, {})[match["kind"]] = topic
    people = {name: topics for name, topics in people.items() if "joints" in topics}
    for topics in people.values():
        points = f"{topics['joints'].removesuffix('/joints')}/keypoints/{keypoints and keypoints.name}"
        if types.get(points) == _JOINTS:
            topics["points"] = points
    return people


def _objects(types: Mapping[str, str]) -> dict[str, str]:
    found = {
        spaced(match["space"] or "", match["name"]): topic
        for topic, kind in types.items()
        if kind == _MARKER and (match := _OBJECT.fullmatch(topic))
    }
    return dict(list(found.items())[:MAX_OBJECTS])


def spaced(space: str, name: str) -> str:
    """Name of a person or object, preceded by the namespace of its simulation."""
    return f"{space}/{name}" if space else name
