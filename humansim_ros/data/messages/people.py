"""Read the poses of people from messages of any tracker, which may come from a bag or running nodes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from humansim_ros.data.messages.parts import xyz
from humansim_ros.data.messages.points import point_rows
from humansim_ros.errors import MAX_COORDINATE, EvaluationError, printable, within_bounds
from humansim_ros.types import Array

#: Numbers of visualization_msgs/Marker: types with a list of points, the type of a single point (a sphere),
#: and actions that add no marker.
_LISTS, _SPHERE, _DELETE = (7, 8), 2, (2, 3)
#: Fields of a point cloud with the number of the person, and fields with a confidence.
_PERSON_FIELDS, _SCORE_FIELDS = ("person", "id", "instance", "label"), ("score", "confidence")
#: Most people of a message. More people are no plausible estimate of a room.
MAX_PEOPLE = 1000
#: Greatest coordinate that is accepted. The unit may be millimetres, so it is 1000 times that of metres.
MAX_POSITION = MAX_COORDINATE * 1000

#: Name of the only point of people without joints. The true point is on the floor below the hips.
GROUND = "ground"
#: Classes of detections that are people, in lower case: names, and "0" in YOLO's models.
PERSON_CLASSES = frozenset({"person", "people", "pedestrian", "human", "0"})
#: Type of the messages with boxes in images.
DETECTIONS_2D = "vision_msgs/msg/Detection2DArray"
#: In spencer_tracking_msgs, a variance above this means that a number is unknown.
_UNSET = 99_999

#: Names of points in their order; None if no names are known.
PointNames = tuple[str, ...] | None


class Pose(NamedTuple):
    """The pose of one person in a message. ``person``: name in the message; None if there is none. ``names``:
    K names of points. ``positions``: (K, 3)."""

    person: str | None
    names: tuple[str, ...]
    positions: Array
    score: float | None = None


@dataclass(frozen=True)
class PoseFrame:
    """The people of a message.

    Attributes:
        stamp: Nanoseconds. None if the message has no header and no people.
        frame_id: Coordinate frame of the positions, as the message names it.
        people: All people of the message.
    """

    stamp: int | None
    frame_id: str
    people: Sequence[Pose]

    def moved(self, matrix: Array, frame_id: str) -> PoseFrame:
        """Convert the people to another coordinate frame.

        Args:
            matrix: (4, 4) pose of the present frame in the other frame.
            frame_id: Name of the other frame.
        """
        turn, shift = matrix[:3, :3], matrix[:3, 3]
        people = [pose._replace(positions=pose.positions @ turn.T + shift) for pose in self.people]
        return PoseFrame(self.stamp, frame_id, people)


def read_people(kind: str, message: Any, names: PointNames) -> PoseFrame:
    """Read the people of a message.

    Args:
        kind: Type of the message, one of :data:`MESSAGE_TYPES`.
        message: Message object of rclpy, or of another library that has the same attributes.
        names: Names for points that have no names in the message, in their order.

    Raises:
        EvaluationError: The message contradicts itself or ``names``, or has numbers that are too large.
    """
    try:
        people = list(islice(_READERS[kind](message, names), MAX_PEOPLE + 1))
    except EvaluationError:
        raise
    except AttributeError as reason:
        text = printable(str(reason))
        raise EvaluationError(f"{kind} is of a version that is not known here: {text}") from None
    except Exception as reason:  # contents come from other programs: offsets of a point cloud, types of names
        text = printable(f"{type(reason).__name__}: {reason}")
        raise EvaluationError(f"a message cannot be read: {text}") from None
    if len(people) > MAX_PEOPLE:
        raise EvaluationError(f"a message has more than {MAX_PEOPLE} people")
    named = [pose.person for pose in people if pose.person is not None]
    if len(set(named)) < len(named):
        twice = next(name for name in named if named.count(name) > 1)
        raise EvaluationError(
            f"person '{printable(twice, 80)}' has two poses in a message; give each person a name of its own"
        )
    for pose in people:
        if (np.abs(pose.positions[np.isfinite(pose.positions)]) > MAX_POSITION).any():
            raise EvaluationError("a position is more than 1000 km away")
    headers = [marker.header for marker in message.markers] if kind == _MARKERS else [message.header]
    if not headers:
        return PoseFrame(None, "", people)
    # markers that delete other markers may have no stamp
    newest = max(headers, key=_nanoseconds)
    stamp = _nanoseconds(newest)
    if not 0 <= stamp < 1 << 62:
        raise EvaluationError(f"a stamp of {newest.stamp.sec} s is not valid")
    if stamp == 0 and kind == _MARKERS and not people:
        return PoseFrame(None, "", people)
    return PoseFrame(stamp, str(newest.frame_id), people)


def _nanoseconds(header: Any) -> int:
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def _multi_dof(message: Any, _: PointNames) -> Iterator[Pose]:
    names = [str(name) for name in message.joint_names]
    if len(names) != len(message.transforms):
        raise EvaluationError(f"{len(names)} joint names but {len(message.transforms)} transforms")
    positions = np.array([xyz(each.translation) for each in message.transforms]).reshape(-1, 3)
    people: dict[str | None, list[int]] = {}
    for index, name in enumerate(names):
        people.setdefault(name.rpartition("/")[0] or None, []).append(index)
    for person, indices in people.items():
        joints = tuple(names[index].rpartition("/")[2] for index in indices)
        yield Pose(person, joints, positions[indices])


def _of_points(points: Array, names: PointNames) -> Iterator[Pose]:
    """Divide points (N, 3) into people. The points of a person follow each other, in the order of
    ``names``."""
    if not len(points):
        return
    names = _required(names)
    if len(points) % len(names):
        raise EvaluationError(
            f"{len(points)} points are not a multiple of the {len(names)} joints {names[0]} to {names[-1]}"
        )
    for pose in points.reshape(-1, len(names), 3):
        yield Pose(None, names, pose)


def _required(names: PointNames) -> tuple[str, ...]:
    if names is None:
        raise EvaluationError(
            "these points have no names: choose their keypoint set with --keypoints, or give a list of names "
            "with --names (of the node: parameters keypoints and names)"
        )
    return names


def _pose_array(message: Any, names: PointNames) -> Iterator[Pose]:
    points = [xyz(pose.position) for pose in message.poses]
    yield from _of_points(np.array(points).reshape(-1, 3), names)


def _markers(message: Any, names: PointNames) -> Iterator[Pose]:
    single: dict[str, dict[str, tuple[float, float, float]]] = {}
    for marker in message.markers:
        if marker.action in _DELETE:
            continue
        names = _required(names)
        if marker.type in _LISTS:
            points = np.array([xyz(point) for point in marker.points]).reshape(-1, 3)
            if len(points) != len(names):
                raise EvaluationError(f"a marker has {len(points)} points, but there are {len(names)} joints")
            yield Pose(_marker_person(marker), names, points)
        elif marker.type == _SPHERE and 0 <= marker.id < len(names):
            single.setdefault(str(marker.ns), {})[names[marker.id]] = xyz(marker.pose.position)
    for person, joints in single.items():
        yield Pose(person or None, tuple(joints), np.array(list(joints.values())))


def _marker_person(marker: Any) -> str:
    """Name of the person that a marker belongs to: the first part of its namespace, or its id."""
    return str(marker.ns).partition("/")[0] or str(marker.id)


def _point_cloud(message: Any, names: PointNames) -> Iterator[Pose]:
    if not message.width * message.height:  # such a cloud may have no fields
        return
    names = _required(names)
    points = point_rows(message)
    fields = points.dtype.names or ()
    if not {"x", "y", "z"} <= set(fields):
        raise EvaluationError(f"the point cloud has no fields x, y and z, but {', '.join(fields)}")
    positions = np.stack([points[axis].astype(float) for axis in "xyz"], axis=1)
    person = next((name for name in _PERSON_FIELDS if name in fields), None)
    joint = next((name for name in ("joint", "keypoint") if name in fields), None)
    score = next((name for name in _SCORE_FIELDS if name in fields), None)
    if person is None:
        yield from _of_points(positions, names)
        return
    numbers = np.unique(points[person][np.isfinite(points[person])])
    for number in numbers[: MAX_PEOPLE + 1]:  # each look-up goes through all points
        rows = np.flatnonzero(points[person] == number)
        order = points[joint][rows].astype(int) if joint else np.arange(len(rows))
        if len(rows) > len(names) or (order >= len(names)).any() or (order < 0).any():
            raise EvaluationError(
                f"person {number} has {len(rows)} points, but there are {len(names)} joints"
            )
        confidence = float(np.mean(points[score][rows])) if score else None
        yield Pose(
            f"{number:g}",
            tuple(names[index] for index in order),
            positions[rows],
            confidence if confidence is not None and math.isfinite(confidence) else None,
        )


def _point(person: object, point: Any, score: float | None = None) -> Pose:
    """Make the pose of a person that has a single point."""
    positions = np.array([xyz(point)], dtype=float)
    known = score is not None and math.isfinite(score)
    return Pose(str(person) if person != "" else None, (GROUND,), positions, score if known else None)


def _people(message: Any, _: PointNames) -> Iterator[Pose]:
    for person in message.people:
        yield _point(person.name, person.position, float(person.reliability))


def _tracked_persons(message: Any, _: PointNames) -> Iterator[Pose]:
    for track in message.tracks:
        pose = _point(track.track_id, track.pose.pose.position)
        if any(track.pose.covariance[place] > _UNSET for place in (0, 7)):  # either variance may be NaN
            pose.positions[:] = np.nan
        yield pose


def _detected_people(message: Any) -> Iterator[tuple[Any, float | None]]:
    """Yield the detections of people in a message of vision_msgs, each with its score. The score is None for
    a detection without hypothesis."""
    for found in message.detections:
        best = max((each.hypothesis for each in found.results), key=lambda each: each.score, default=None)
        if best is None or str(best.class_id).lower() in PERSON_CLASSES:
            yield found, None if best is None else float(best.score)


def _detections_3d(message: Any, _: PointNames) -> Iterator[Pose]:
    for found, score in _detected_people(message):
        yield _point(found.id, found.bbox.center.position, score)


def read_boxes_2d(message: Any) -> list[tuple[float, float, float, float, float]]:
    """Read the boxes of people of a vision_msgs/Detection2DArray: left, top, right, bottom, and score.

    The centre of the first pixel is (0, 0). A box without a score gets the score 1.

    Raises:
        EvaluationError: The message has another version, a box is rotated, or a number is not finite.
    """
    boxes: list[tuple[float, float, float, float, float]] = []
    try:
        for found, score in _detected_people(message):
            if len(boxes) == MAX_PEOPLE:
                raise EvaluationError(f"a message has more than {MAX_PEOPLE} people")
            box, place = found.bbox, found.bbox.center.position
            width, height = float(box.size_x) / 2, float(box.size_y) / 2
            row = (place.x - width, place.y - height, place.x + width, place.y + height)
            boxes.append((*row, 1.0 if score is None else score))
            if not within_bounds(boxes[-1]) or min(width, height) < 0:
                raise EvaluationError("a box is not finite, or has a negative size")
            if box.center.theta:
                raise EvaluationError("a box is rotated: only boxes along the axes of the image are read")
    except AttributeError as reason:
        text = printable(str(reason))
        raise EvaluationError(f"{DETECTIONS_2D} is of a version that is not known here: {text}") from None
    return boxes


_MARKERS = "visualization_msgs/msg/MarkerArray"
_READERS: dict[str, Callable[[Any, PointNames], Iterator[Pose]]] = {
    "sensor_msgs/msg/MultiDOFJointState": _multi_dof,
    "geometry_msgs/msg/PoseArray": _pose_array,
    _MARKERS: _markers,
    "sensor_msgs/msg/PointCloud2": _point_cloud,
    "vision_msgs/msg/Detection3DArray": _detections_3d,
    "people_msgs/msg/People": _people,
    "spencer_tracking_msgs/msg/TrackedPersons": _tracked_persons,
}
#: Types of messages that :func:`read_people` reads.
MESSAGE_TYPES = tuple(_READERS)


def has_one_point(kind: str) -> bool:
    """Whether messages of a type have a single point for each person, and no joints."""
    return _READERS[kind] in (_detections_3d, _people, _tracked_persons)
