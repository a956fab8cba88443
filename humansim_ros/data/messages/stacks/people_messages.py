"""Messages of vision_msgs, people_msgs and spencer_tracking_msgs, built from the ground truth of a frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from humansim_ros.data.messages import parts
from humansim_ros.data.messages.headers import header
from humansim_ros.data.messages.stacks.adapter import AdapterScene, AdapterTopic, Placed
from humansim_ros.data.messages.types import (
    MESSAGE_PACKAGES,
    Duration,
    Point,
    Pose,
    PoseWithCovariance,
    Quaternion,
    Twist,
    TwistWithCovariance,
)
from humansim_ros.scene.config import BoxesConfig, FramedConfig, TrackedConfig
from humansim_ros.scene.core import Frame
from humansim_ros.scene.truth import REQUIRED_CHANNELS, standing

VISION_MSGS, PEOPLE_MSGS, SPENCER_MSGS = (
    MESSAGE_PACKAGES[name] for name in ("vision_msgs", "people_msgs", "spencer_tracking_msgs")
)
#: Class of all detections: its name, and its number in the LabelInfo message.
PERSON, PERSON_CLASS = "person", 0
#: Variance of an unknown number: in spencer_tracking_msgs, a variance above 99999 means unknown.
UNSET = 100_000.0


def _hypothesis(pose: Pose | None = None) -> Any:
    """Message with the only hypothesis of a detection: the object is a person, with score 1."""
    certain = VISION_MSGS.message("ObjectHypothesis")(class_id=PERSON, score=1.0)
    found = VISION_MSGS.message("ObjectHypothesisWithPose")(hypothesis=certain)
    found.pose.pose = Pose(orientation=Quaternion(w=1.0)) if pose is None else pose
    return found


def detections_2d_topics(scene: AdapterScene, config: BoxesConfig, usual: str) -> Iterator[AdapterTopic]:
    """Create the topics of boxes in images. ``usual``: name of a topic if the scene sets no other."""
    cameras: Sequence[str] = list(scene.scene.scene_cameras)
    if config.cameras is not None:
        cameras = [scene.camera(name, "cameras") for name in dict.fromkeys(config.cameras)]
    kind = VISION_MSGS.message("Detection2DArray")
    for camera in cameras:
        frame_id, name = scene.optical(camera), usual.replace("<camera>", camera)
        if config.topic is not None:
            name = f"{camera}/{config.topic.lstrip('/')}"
        build = partial(
            _detections_2d, camera=camera, frame_id=frame_id, people=list(scene.scene.actors), box=config.box
        )
        yield AdapterTopic(name, kind, build, people=False, **_of_boxes(camera))
        yield _label_info(name, frame_id, camera)


def _of_boxes(camera: str) -> dict[str, Any]:
    """Attributes of a topic that is made from the boxes of a camera."""
    channels = frozenset(REQUIRED_CHANNELS["boxes"])
    return {"camera": camera, "channels": channels, "inputs": ("boxes",)}


def _detections_2d(
    frame: Frame, stamp: int, camera: str, frame_id: str, people: Sequence[str], box: str
) -> Any:
    """Build a vision_msgs/Detection2DArray.

    A person without visible pixels is left out; with whole boxes, a person outside the image. Numbers are
    rounded to float32, so that they equal those of ``<camera>/boxes``.

    Args:
        frame: Frame of the scene.
        stamp: Nanoseconds.
        camera: Name of the camera.
        frame_id: Optical frame of the camera.
        people: Names of the people.
        box: ``whole`` for boxes that enclose whole bodies, ``visible`` for only the visible pixels.
    """
    message, whole = VISION_MSGS.message("Detection2DArray")(header=header(stamp, frame_id)), box == "whole"
    for name in people:
        own = frame.truth[camera].boxes[name]
        if own.truncation >= 1 if whole else not own.pixels:
            continue
        left, top, right, bottom = np.float32(own.whole if whole else own.visible).astype(float).tolist()
        bounds = VISION_MSGS.message("BoundingBox2D")(size_x=right - left, size_y=bottom - top)
        bounds.center.position.x, bounds.center.position.y = (left + right) / 2, (top + bottom) / 2
        found = VISION_MSGS.message("Detection2D")(header=message.header, bbox=bounds, id=name)
        found.results = [_hypothesis()]
        message.detections.append(found)
    return message


def detections_3d_topics(scene: AdapterScene, config: FramedConfig, usual: str) -> Iterator[AdapterTopic]:
    """Create the topic of upright boxes. ``usual``: name of the topic if the scene sets no other."""
    placed, name = scene.placed(config.frame), _name(config, usual)
    kind = VISION_MSGS.message("Detection3DArray")
    yield AdapterTopic(name, kind, partial(_detections_3d, placed=placed), posed=placed.camera)
    yield _label_info(name, placed.frame_id)


def _detections_3d(frame: Frame, stamp: int, placed: Placed) -> Any:
    """Build a vision_msgs/Detection3DArray: the upright box of each body. ``placed``: frame of the
    coordinates."""
    message = VISION_MSGS.message("Detection3DArray")(header=header(stamp, placed.frame_id))
    axes = placed.at(frame)
    for name, state in frame.humans.items():
        upright = state.upright_box
        pose = axes.pose(upright.center, upright.quaternion)
        box = VISION_MSGS.message("BoundingBox3D")(center=pose, size=parts.vector(upright.size))
        found = VISION_MSGS.message("Detection3D")(header=message.header, bbox=box, id=name)
        found.results = [_hypothesis(pose)]
        message.detections.append(found)
    return message


def _name(config: FramedConfig, usual: str) -> str:
    """Name of a topic without leading slash: the one in the settings, or else ``usual``."""
    return usual if config.topic is None else config.topic.lstrip("/")


def _label_info(topic: str, frame_id: str, camera: str = "") -> AdapterTopic:
    """Create a topic of vision_msgs/LabelInfo, which lists the classes of detections: only ``person``."""
    person = VISION_MSGS.message("VisionClass")(class_id=PERSON_CLASS, class_name=PERSON)
    kind = VISION_MSGS.message("LabelInfo")
    return AdapterTopic(
        f"{topic}/label_info",
        kind,
        lambda *_: kind(header=header(0, frame_id), class_map=[person]),
        camera=camera,
        latched=True,
        per_frame=False,
        people=False,
    )


def people_topics(scene: AdapterScene, config: FramedConfig, usual: str) -> Iterator[AdapterTopic]:
    """Create the topic of people_msgs. ``usual``: name of the topic if the scene sets no other."""
    placed = scene.placed(config.frame)
    build = partial(_people, placed=placed, labels=scene.scene.labels)
    yield AdapterTopic(_name(config, usual), PEOPLE_MSGS.message("People"), build, posed=placed.camera)


def _people(frame: Frame, stamp: int, placed: Placed, labels: Mapping[str, int]) -> Any:
    """Build a people_msgs/People: the point on the floor below the hips of each person.

    An unknown velocity is 0, and the tag ``velocity`` of the person says that it is unknown.

    Args:
        frame: Frame of the scene.
        stamp: Nanoseconds.
        placed: Frame of the coordinates.
        labels: Instance label of each person, which becomes a tag in the message.
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


def tracked_persons_topics(scene: AdapterScene, config: TrackedConfig, usual: str) -> Iterator[AdapterTopic]:
    """Create the topic of spencer_tracking_msgs. ``usual``: name of the topic if the scene sets no other."""
    placed = scene.placed(config.frame)
    camera = None if config.camera is None else scene.camera(config.camera, "camera")
    kind = SPENCER_MSGS.message("TrackedPersons")
    build = partial(_tracked_persons, placed=placed, labels=scene.scene.labels, camera=camera)
    settings = {} if camera is None else _of_boxes(camera)
    yield AdapterTopic(_name(config, usual), kind, build, posed=placed.camera, **settings)


def _tracked_persons(
    frame: Frame, stamp: int, placed: Placed, labels: Mapping[str, int], camera: str | None
) -> Any:
    """Build a spencer_tracking_msgs/TrackedPersons: true positions on the floor, headings and velocities.

    Args:
        frame: Frame of the scene.
        stamp: Nanoseconds.
        placed: Frame of the coordinates.
        labels: Instance label of each person, which becomes the id of the track.
        camera: Camera that sees the people. A person without visible pixels in its image is marked as
            occluded. If None, nobody is.
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
            track.twist.covariance = (UNSET * np.eye(6)).ravel()
        else:
            linear, angular = (axes.vector(each) for each in (place.velocity.linear, place.velocity.angular))
            track.twist.twist = Twist(linear=linear, angular=angular)
        message.tracks.append(track)
    return message
