"""People of the truth around the path of a robot, from a scene or a bag."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.bags import BagTopic
from humansim_ros.data.evaluation.readers.estimates import deserialised_message, topic_pattern, topic_person
from humansim_ros.data.evaluation.truth import RecordedTruth, check_motions, frames_of
from humansim_ros.data.messages.headers import to_nanoseconds
from humansim_ros.data.messages.humans import read_vertices
from humansim_ros.data.recorded import RecordedMessages
from humansim_ros.errors import EvaluationError
from humansim_ros.scene.config import FIRST_STAMP
from humansim_ros.scene.core import Scene, SceneStates
from humansim_ros.scene.features import ROBOT
from humansim_ros.scene.truth import HIPS
from humansim_ros.types import Array

#: If more time than this (nanoseconds) is between two poses of a robot, its place in between is unknown.
MAX_GAP = 500_000_000
_VERTICES = "/humans/*/vertices"
_CLOUD = "sensor_msgs/msg/PointCloud2"


@dataclass(frozen=True, repr=False)
class RobotPath:
    """Path of a robot. ``times``: (P,) int64 nanoseconds, increasing. ``places``: (P, 3) x, y and yaw in
    ``map``. The yaw is continuous: it does not jump by 360°."""

    times: NDArray[np.int64]
    places: Array
    source: str

    @classmethod
    def of(cls, times: NDArray[np.int64], matrices: Array, source: str) -> RobotPath:
        """Make a path from poses (P, 4, 4) in ``map``. If several poses have the same stamp, the last one
        counts."""
        last = np.append(np.diff(times) > 0, True)
        yaw = np.unwrap(np.arctan2(matrices[last, 1, 0], matrices[last, 0, 0]))
        return cls(times[last], np.column_stack([matrices[last, :2, 3], yaw]), source)

    def at(self, times: NDArray[np.int64]) -> Array:
        """Places (F, 3) at ``times``, interpolated between two poses. NaN where these poses are too far apart
        in time."""
        after = np.clip(np.searchsorted(self.times, times), 1, max(len(self.times) - 1, 1))
        after = np.minimum(after, len(self.times) - 1)
        before = np.maximum(after - 1, 0)
        span = self.times[after] - self.times[before]
        share = (times - self.times[before]) / np.maximum(span, 1)
        places = self.places[before] + share[:, None] * (self.places[after] - self.places[before])
        known = (span <= MAX_GAP) & (share >= 0) & (share <= 1)
        exact = np.isin(times, self.times)
        places[exact] = self.places[np.searchsorted(self.times, times[exact])]
        places[~(known | exact)] = np.nan
        return np.asarray(places)


@dataclass(frozen=True, repr=False)
class PeopleNearby:
    """People of the truth around a robot.

    Attributes:
        times: (F,) int64 stamps, nanoseconds, increasing.
        places: Places of the robot (F, 3): x, y, yaw. NaN where unknown.
        people: By person: middle of the hips on the floor (F, 2). NaN in frames without the person.
        nearest: For each person with a known body: distance (F,) on the floor from the middle of the robot to
            the nearest body vertex that is not above the robot. None if the bag has no bodies.
        source: Where the people come from, for messages.
    """

    times: NDArray[np.int64]
    places: Array
    people: Mapping[str, Array]
    nearest: Mapping[str, Array] | None
    source: str


def robot_size(scene: Scene) -> tuple[float, float] | None:
    """Radius of the disc around ``base_link`` that contains the robot of a scene, and height of the robot,
    metres. Returns None if the scene has no robot."""
    if scene.robot is None:
        return None
    item = scene.objects[ROBOT]
    vertices = item.mesh.vertices * item.initial_pose.size
    return float(np.hypot(vertices[:, 0], vertices[:, 1]).max()), float(vertices[:, 2].max())


def scene_nearby(scene: Scene, path: RobotPath) -> PeopleNearby:
    """Compute the people of a scene for the time in which a robot drives. Nothing is rendered.

    Raises:
        EvaluationError: The scene has no people, a live human, or no frame in this time.
    """
    check_motions(scene)
    size = robot_size(scene)
    height = np.inf if size is None else size[1]
    first, last = frames_of(scene, (int(path.times[0]), int(path.times[-1])), 0.0)
    stamps = FIRST_STAMP + np.array([scene.frame_time(index) for index in range(first, last + 1)], np.int64)
    inside = np.flatnonzero((stamps >= path.times[0]) & (stamps <= path.times[-1]))
    if not len(inside):
        raise EvaluationError("the frames of the truth are at other times than the robot", path=scene.path)
    places, states = path.at(stamps[inside]), SceneStates(scene)
    people: dict[str, list[Array]] = {name: [] for name in scene.actors}
    nearest: dict[str, list[float]] = {name: [] for name in scene.actors}
    for index, place in zip((first + inside).tolist(), places, strict=True):
        for name, state in states.at(index).humans.items():
            people[name].append(_ground(state.joint_names, state.positions))
            nearest[name].append(_nearest_vertex(state.vertices, place, height))
    return PeopleNearby(
        stamps[inside],
        places,
        {name: np.array(rows).reshape(-1, 2) for name, rows in people.items()},
        {name: np.array(rows) for name, rows in nearest.items()},
        str(scene.path or "the scene"),
    )


def bag_nearby(source: RecordedTruth, path: RobotPath) -> PeopleNearby:
    """Read the people of a bag for the time in which a robot drives; with bodies, if the bag has vertices.

    Raises:
        EvaluationError: The robot drives at another time, or a message cannot be read.
    """
    bag, joints = source.path, source.joints
    inside = (joints.times >= path.times[0]) & (joints.times <= path.times[-1])
    times = joints.times[inside]
    if not len(times):
        raise EvaluationError("the people of the truth are at other times than the robot", path=bag)
    places = path.at(times)
    frames = [joints.people[index] for index in np.flatnonzero(inside).tolist()]
    names = list(dict.fromkeys(name for frame in joints.people for name in frame))
    absent = np.full((len(joints.names), 3), np.nan)
    people = {
        name: np.array([_ground(joints.names, frame.get(name, absent)) for frame in frames]) for name in names
    }
    return PeopleNearby(times, places, people, _bag_bodies(bag, times, places, names), str(bag))


def _bag_bodies(
    bag: Path, times: NDArray[np.int64], places: Array, people: Sequence[str]
) -> dict[str, Array] | None:
    """For each person with a topic of vertices: distances (F,) of the nearest vertex, inf for frames without
    a message. None if there are no such topics."""
    rows = {time: row for row, time in enumerate(times.tolist())}
    pattern = topic_pattern(_VERTICES)
    nearest: dict[str, Array] = defaultdict(lambda: np.full(len(times), np.inf))

    def read(data: bytes, topic: BagTopic) -> tuple[int, NDArray[np.floating]]:
        content = deserialised_message(data, topic)
        return to_nanoseconds(content.header.stamp), read_vertices(content)

    with RecordedMessages(bag) as recorded:
        found = {name: pattern.fullmatch(name) for name in recorded.topics}
        names = [name for name, match in found.items() if match and recorded.topics[name].type == _CLOUD]
        for topic, _, (stamp, vertices) in recorded.each(names, read, EvaluationError):
            row, match = rows.get(stamp), found[topic.name]
            if row is not None and match is not None:
                nearest[topic_person(match) or ""][row] = _nearest_vertex(vertices, places[row], np.inf)
    return {name: nearest[name] for name in people if name in nearest} if names else None


def _ground(names: Sequence[str], positions: Array) -> Array:
    """Middle (2,) of the hips on the floor. If there are no hips, middle of all joints."""
    rows = [names.index(name) for name in HIPS if name in names]
    chosen = positions[rows] if rows else positions[np.isfinite(positions).all(axis=1)]
    return np.asarray(chosen[:, :2].mean(axis=0)) if len(chosen) else np.full(2, np.nan)


def _nearest_vertex(vertices: NDArray[np.floating], place: Array, height: float) -> float:
    """Distance on the floor from a place to the nearest vertex below ``height``. inf without such a
    vertex."""
    own = vertices[vertices[:, 2] <= height]
    return float(np.hypot(*(own[:, :2] - place[:2]).T).min()) if len(own) else np.inf
