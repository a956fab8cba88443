"""Read the path of a robot from a bag (odometry, tf, localisation, marker), or compute that of a scene."""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from humansim_ros.bags.reader import BagReader
from humansim_ros.errors import EvaluationError, did_you_mean, located, printable
from humansim_ros.evaluate.nearby import RobotPath
from humansim_ros.evaluate.readers.estimates import deserialised_message, is_bag, split_topic
from humansim_ros.evaluate.truth import FIRST_STAMP, MAX_TRUTH_FRAMES
from humansim_ros.messages.cameras import rigid_pose
from humansim_ros.messages.headers import WORLD_FRAME, to_nanoseconds
from humansim_ros.messages.transforms import TF
from humansim_ros.rotations import quaternion_to_matrix, transform
from humansim_ros.scene.scene import Scene
from humansim_ros.types import Array

#: Topic of transforms that hold for all times, and frame of the robot where the scene has no robot.
_STATIC, _BASE_FRAME = "/tf_static", "base_link"
_SCENE_SUFFIXES = (".yaml", ".yml")
#: Stamped transforms (4, 4) from a frame to its parent.
_Samples = list[tuple[int, Array]]
#: Parent frame, child frame ("": the robot's), pose and stamp in a message.
_Part = tuple[str, str, Any, Any]


def _odometry(message: Any) -> Iterator[_Part]:
    yield message.header.frame_id, message.child_frame_id, message.pose.pose, message.header.stamp


def _located(message: Any) -> Iterator[_Part]:
    yield message.header.frame_id, "", message.pose.pose, message.header.stamp


def _marked(message: Any) -> Iterator[_Part]:
    yield message.header.frame_id, "", message.pose, message.header.stamp


def _transforms(message: Any) -> Iterator[_Part]:
    for each in message.transforms:
        pose = SimpleNamespace(position=each.transform.translation, orientation=each.transform.rotation)
        yield each.header.frame_id, each.child_frame_id, pose, each.header.stamp


_READERS: dict[str, Callable[[Any], Iterator[_Part]]] = {
    "nav_msgs/msg/Odometry": _odometry,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _located,
    "visualization_msgs/msg/Marker": _marked,
    TF: _transforms,
}


def is_robot_path(text: str) -> bool:
    """Whether an estimate is the path of a robot: a topic of a bag with its poses, or of a scene file.

    Raises BagError if the bag cannot be read.
    """
    name, topic = split_topic(text)
    path = Path(name)
    if topic is None or not path.exists():
        return False
    if path.suffix.lower() in _SCENE_SUFFIXES:
        return True
    if not is_bag(path):
        return False
    with BagReader(path) as reader:
        return any(each.name == topic and each.type in _READERS for each in reader.topics)


def read_robot_path(text: str, scene: Scene | None) -> RobotPath:
    """Read the path of a robot.

    Args:
        text: ``BAG:TOPIC``, or ``SCENE:/odom`` for the robot of a scene file that has a path or trajectory.
        scene: The scene of the truth: it tells the frames of the robot, and where its odometry starts.

    Raises:
        HumansimError: A file cannot be read, stamps go back, a pose is no pose, or no transforms lead to map.
    """
    name, topic = split_topic(text)
    assert topic is not None
    if Path(name).suffix.lower() in _SCENE_SUFFIXES:
        return _scene_path(Scene.load(name), text)
    return _bag_path(Path(name), topic, scene)


def _scene_path(scene: Scene, text: str) -> RobotPath:
    robot = scene.robot
    if robot is None or robot.route is None:
        reason = "the scene has no robot" if robot is None else "its robot has no path or trajectory"
        raise EvaluationError(
            f"{reason}: record a bag, and give BAG:/odom", path=scene.path, key="--estimate"
        )
    count = min(int(robot.route.duration * scene.config.rate) + 1, MAX_TRUTH_FRAMES)
    times = np.array([scene.frame_time(index) for index in range(count)], np.int64)
    poses = [robot.base_at(time * 1e-9) for time in times.tolist()]
    matrices = [transform(quaternion_to_matrix(pose.rotation), pose.position) for pose in poses]
    return RobotPath.of(FIRST_STAMP + times, np.array(matrices), text)


def _bag_path(path: Path, topic: str, scene: Scene | None) -> RobotPath:
    """Path of a robot on a topic; transforms of ``/tf`` and ``/tf_static`` lead from its frame to map."""
    robot = scene.robot.config if scene is not None and scene.robot is not None else None
    base = robot.base_frame if robot is not None else _BASE_FRAME
    samples: dict[str, _Samples] = defaultdict(list)
    parents: dict[str, str] = {}
    second: dict[str, str] = {}  # other parents of frames
    static = set[str]()
    with BagReader(path) as reader:
        kinds = {each.name: each.type for each in reader.topics}
        if topic not in kinds:
            raise EvaluationError(f"the bag has no topic {topic}{did_you_mean(topic, kinds)}", path=path)
        others = [
            name for name, kind in kinds.items() if kind == TF and (name == _STATIC or kinds[topic] != TF)
        ]
        for message in reader.messages({topic, *others}):
            source = reader.topics[message.topic]
            with located(EvaluationError, path, key=source.name):
                content = deserialised_message(message.data, source)
                for parent, child, pose, stamp in _READERS[source.type](content):
                    parent, child = parent.strip("/"), child.strip("/")
                    if source.type != TF:
                        child = base
                    elif child == base and kinds[topic] != TF:
                        continue  # the topic has it
                    position, rotation = rigid_pose(pose, f"a pose of {printable(child, 80)}")
                    matrix = transform(quaternion_to_matrix(rotation), position)
                    if parents.setdefault(child, parent) != parent:
                        second[child] = parent
                    samples[child].append((to_nanoseconds(stamp), matrix))
                    if source.name == _STATIC:
                        static.add(child)
    if not samples[base]:
        raise EvaluationError(f"there is no pose of {base} on it", path=path, key=topic)
    chain, start = [base], np.eye(4)
    while (frame := parents[chain[-1]]) != WORLD_FRAME:
        if frame in chain or frame not in parents:
            if scene is None or scene.robot is None or frame != scene.robot.config.odom_frame:
                raise EvaluationError(
                    f"no transforms lead from {printable(frame, 80)!r} to {WORLD_FRAME}: record /tf and "
                    "/tf_static, too, or give the scene of the robot as --truth",
                    path=path,
                    key=topic,
                )
            begin = scene.robot.start
            start = transform(quaternion_to_matrix(begin.rotation), begin.position)
            break
        chain.append(frame)
    for frame in chain:
        if frame in second:
            both = " and ".join(repr(printable(each, 80)) for each in (parents[frame], second[frame]))
            name = repr(printable(frame, 80))
            raise EvaluationError(f"the frame {name} has two parents, {both}", path=path, key=topic)
    # the first one that moves gives the times
    moving = next((frame for frame in chain if frame not in static), base)
    _check_order(samples[moving], path, topic)
    times = [time for time, _ in samples[moving]]
    matrices = np.tile(np.eye(4), (len(times), 1, 1))
    for frame in chain:
        matrices = _at(samples[frame], times, frame in static) @ matrices
    return RobotPath.of(np.array(times, np.int64), start @ matrices, f"{path}:{topic}")


def _check_order(samples: _Samples, path: Path, topic: str) -> None:
    """Raise EvaluationError if the clock of a robot went back."""
    for number, ((before, _), (time, _)) in enumerate(pairwise(samples), 2):
        if time < before:
            raise EvaluationError(
                f"the robot's clock goes back from {before * 1e-9:.3f} s to {time * 1e-9:.3f} s at pose "
                f"{number}: give a bag of one run",
                path=path,
                key=topic,
            )


def _at(samples: _Samples, times: list[int], fixed: bool) -> Array:
    """Newest transform (P, 4, 4) at each time, or the first one before it. ``fixed``: the last for all."""
    if fixed:
        return np.array([samples[-1][1]] * len(times))
    ordered = sorted(samples, key=lambda sample: sample[0])
    stamps = [stamp for stamp, _ in ordered]
    return np.array([ordered[max(0, bisect_right(stamps, time) - 1)][1] for time in times])
