"""Messages of vision_msgs, people_msgs and spencer_tracking_msgs, built from the ground truth of a frame."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from humansim_ros.data.messages.headers import header
from humansim_ros.data.messages.stacks.adapter import PEOPLE_MSGS, SPENCER_MSGS, VISION_MSGS, Placed
from humansim_ros.data.messages.types import (
    Duration,
    Point,
    Pose,
    PoseWithCovariance,
    Quaternion,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from humansim_ros.scene.core import Frame
from humansim_ros.scene.truth import (
    BodyBox,
    standing,
)
from humansim_ros.types import Array

#: Class of all detections: its name, and its number in the LabelInfo message.
PERSON, PERSON_CLASS = "person", 0
#: Variance of an unknown number: in spencer_tracking_msgs, a variance above 99999 means unknown.
UNSET = 100_000.0
#: Indices of the variances, on the diagonal of a covariance.
_DIAGONAL = tuple(range(0, 36, 7))


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
