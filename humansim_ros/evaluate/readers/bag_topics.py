"""Poses on the topics of a bag."""

from __future__ import annotations

import math
import os
import re
from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from humansim_ros.bags.reader import BagReader
from humansim_ros.bags.topics import BagTopic, message_types
from humansim_ros.errors import EvaluationError, did_you_mean
from humansim_ros.evaluate.readers.options import ReadOptions
from humansim_ros.evaluate.tracks import PoseSequence, SequenceBuilder
from humansim_ros.types import Array

#: visualization_msgs/Marker: types with a list of points, a single one, and actions that add nothing.
_LISTS, _SPHERE, _DELETE = (7, 8), 2, (2, 3)
#: sensor_msgs/PointField datatypes.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: Fields of a point cloud that number the person, and those that give a confidence.
_PERSON_FIELDS, _SCORE_FIELDS = ("person", "id", "instance", "label"), ("score", "confidence")


class Pose(NamedTuple):
    """A person of a message; ``person`` is None if it has no name there."""

    stamp: int
    person: str | None
    names: tuple[str, ...]
    positions: Array
    score: float | None = None


def read_bag_topic(path: str | os.PathLike[str], topic: str, options: ReadOptions) -> PoseSequence:
    """Read the people on a topic.

    ``*`` in the name of the topic stands for the name of a person, or any other part without ``/``. Several
    messages with one stamp on one topic are several people without names.

    Raises:
        EvaluationError: No topic matches, its type holds no poses, or its messages cannot be read.
        BagError: The bag cannot be read.
    """
    pattern = re.compile("([^/]+)".join(re.escape(part) for part in topic.split("*")))
    with BagReader(path) as reader:
        people = {
            index: "/".join(match.groups()) or None
            for index, each in enumerate(reader.topics)
            if (match := pattern.fullmatch(each.name))
        }
        names = [each.name for each in reader.topics]
        if not people:
            listed = did_you_mean(topic, names) or f"; it has {_poses_of(reader.topics)}"
            raise EvaluationError(f"the bag has no topic {topic}{listed}", path=path)
        builder = SequenceBuilder(f"{os.fspath(path)}:{topic}")
        readers = {index: _reader_of(reader.topics[index], path) for index in people}
        stamps: dict[tuple[int, int], int] = defaultdict(int)
        for message in reader.messages([reader.topics[index].name for index in people]):
            kind = reader.topics[message.topic]
            try:
                content = message_types().deserialize_cdr(bytes(message.data), kind.type)
                poses = list(readers[message.topic](content, options))
            except EvaluationError as error:
                raise EvaluationError(error.message, path=path, key=kind.name) from None
            except Exception as reason:  # rosbags documents no exceptions for damaged messages
                raise EvaluationError(
                    f"a message cannot be read: {type(reason).__name__}: {reason}", path=path, key=kind.name
                ) from None
            if (stamp := _stamp(content)) is not None:
                builder.add_frame(stamp)
            for pose in poses:
                person = people[message.topic]
                if pose.person is not None:
                    person = pose.person if person is None else f"{person}/{pose.person}"
                if person is None and len(poses) == 1:
                    # one person a message: the first of a stamp is always the same
                    stamps[message.topic, pose.stamp] += 1
                    person = "1" if stamps[message.topic, pose.stamp] == 1 else None
                builder.add(pose.stamp, person, *pose[2:])
        return builder.build()


def _poses_of(topics: Any) -> str:
    names = [topic.name for topic in topics if topic.type in _READERS]
    return f"poses on {', '.join(names[:5])}" if names else "no topic with poses"


def _reader_of(topic: BagTopic, path: str | os.PathLike[str]) -> Callable[[Any, ReadOptions], Iterator[Pose]]:
    if topic.type not in _READERS:
        raise EvaluationError(
            f"{topic.type} holds no poses of people; known are {', '.join(_READERS)}",
            path=path,
            key=topic.name,
        )
    return _READERS[topic.type]


def _stamp(message: Any) -> int | None:
    header = getattr(message, "header", None)
    return None if header is None else header.stamp.sec * 1_000_000_000 + header.stamp.nanosec


def _multi_dof(message: Any, _: ReadOptions) -> Iterator[Pose]:
    names = [str(name) for name in message.joint_names]
    if len(names) != len(message.transforms):
        raise EvaluationError(f"{len(names)} joint names but {len(message.transforms)} transforms")
    positions = np.array(
        [(t.translation.x, t.translation.y, t.translation.z) for t in message.transforms]
    ).reshape(-1, 3)
    people: dict[str | None, list[int]] = {}
    for index, name in enumerate(names):
        people.setdefault(name.rpartition("/")[0] or None, []).append(index)
    stamp = _stamp(message) or 0
    for person, indices in people.items():
        joints = tuple(names[index].rpartition("/")[2] for index in indices)
        yield Pose(stamp, person, joints, positions[indices])


def _of_points(stamp: int, points: Array, options: ReadOptions) -> Iterator[Pose]:
    """People of a list of points (N, 3) in the order of the joints, one person after the other."""
    names = _names(options)
    if len(points) % len(names):
        raise EvaluationError(
            f"{len(points)} points are not a multiple of the {len(names)} joints {names[0]} to {names[-1]}"
        )
    for pose in points.reshape(-1, len(names), 3):
        yield Pose(stamp, None, names, pose)


def _names(options: ReadOptions) -> tuple[str, ...]:
    if options.names is None:
        raise EvaluationError(
            "these points have no names: choose their keypoint set with --keypoints, or give a list of names "
            "with --names"
        )
    return options.names


def _pose_array(message: Any, options: ReadOptions) -> Iterator[Pose]:
    points = np.array([(p.position.x, p.position.y, p.position.z) for p in message.poses]).reshape(-1, 3)
    yield from _of_points(_stamp(message) or 0, points, options)


def _markers(message: Any, options: ReadOptions) -> Iterator[Pose]:
    names = _names(options)
    single: dict[tuple[int, str], dict[str, tuple[float, float, float]]] = {}
    for marker in message.markers:
        stamp = _stamp(marker) or 0
        if marker.action in _DELETE:
            continue
        if marker.type in _LISTS:
            points = np.array([(p.x, p.y, p.z) for p in marker.points]).reshape(-1, 3)
            if len(points) != len(names):
                raise EvaluationError(f"a marker has {len(points)} points, but there are {len(names)} joints")
            yield Pose(stamp, _marker_person(marker), names, points)
        elif marker.type == _SPHERE and 0 <= marker.id < len(names):
            place = marker.pose.position
            single.setdefault((stamp, str(marker.ns)), {})[names[marker.id]] = (place.x, place.y, place.z)
    for (stamp, person), joints in single.items():
        yield Pose(stamp, person or None, tuple(joints), np.array(list(joints.values())))


def _marker_person(marker: Any) -> str:
    """Name of the person of a list of points: the first part of the namespace, or its id."""
    return str(marker.ns).partition("/")[0] or str(marker.id)


def _point_cloud(message: Any, options: ReadOptions) -> Iterator[Pose]:
    names = _names(options)
    points = _cloud_rows(message)
    fields = points.dtype.names or ()
    if not {"x", "y", "z"} <= set(fields):
        raise EvaluationError(f"the point cloud has no fields x, y and z, but {', '.join(fields)}")
    positions = np.stack([points[axis].astype(float) for axis in "xyz"], axis=1)
    stamp = _stamp(message) or 0
    person = next((name for name in _PERSON_FIELDS if name in fields), None)
    joint = next((name for name in ("joint", "keypoint") if name in fields), None)
    score = next((name for name in _SCORE_FIELDS if name in fields), None)
    if person is None:
        yield from _of_points(stamp, positions, options)
        return
    for number in np.unique(points[person]):
        rows = np.flatnonzero(points[person] == number)
        order = points[joint][rows].astype(int) if joint else np.arange(len(rows))
        if len(rows) > len(names) or (order >= len(names)).any() or (order < 0).any():
            raise EvaluationError(
                f"person {number} has {len(rows)} points, but there are {len(names)} joints"
            )
        confidence = float(np.mean(points[score][rows])) if score else None
        yield Pose(
            stamp,
            f"{number:g}",
            tuple(names[index] for index in order),
            positions[rows],
            confidence if confidence is not None and math.isfinite(confidence) else None,
        )


def _cloud_rows(message: Any) -> Any:
    """Points of a PointCloud2 as a structured array."""
    byte_order = ">" if message.is_bigendian else "<"
    kinds = [
        (str(f.name), f"{byte_order}{_DATATYPES[f.datatype]}", f.offset)
        for f in message.fields
        if f.count == 1
    ]
    layout = np.dtype(
        {
            "names": [name for name, _, _ in kinds],
            "formats": [kind for _, kind, _ in kinds],
            "offsets": [offset for *_, offset in kinds],
            "itemsize": message.point_step,
        }
    )
    count = message.width * message.height
    return np.frombuffer(bytes(message.data), dtype=layout, count=count)


_READERS: dict[str, Callable[[Any, ReadOptions], Iterator[Pose]]] = {
    "sensor_msgs/msg/MultiDOFJointState": _multi_dof,
    "geometry_msgs/msg/PoseArray": _pose_array,
    "visualization_msgs/msg/MarkerArray": _markers,
    "sensor_msgs/msg/PointCloud2": _point_cloud,
}
