"""Read the path of a robot from a bag (odometry, tf, localisation, marker), or compute that of a scene's
robot."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from humansim_ros.data.bags import is_bag
from humansim_ros.data.bags.topics import BagTopic
from humansim_ros.data.evaluation.nearby import RobotPath
from humansim_ros.data.evaluation.readers.estimates import (
    bag_transforms,
    deserialised_message,
    has_topic,
    split_topic,
)
from humansim_ros.data.evaluation.truth import MAX_TRUTH_FRAMES
from humansim_ros.data.messages.cameras import rigid_pose
from humansim_ros.data.messages.headers import WORLD_FRAME, to_nanoseconds
from humansim_ros.data.messages.transforms import TF, read_links
from humansim_ros.data.recorded import RecordedMessages
from humansim_ros.errors import EvaluationError, printable, unknown
from humansim_ros.geometry import quaternion_to_matrix, transform
from humansim_ros.scene.config import FIRST_STAMP
from humansim_ros.scene.core import Scene
from humansim_ros.types import Array

#: Frame of the robot, if the scene has no robot.
_BASE_FRAME = "base_link"
#: Topic in ``SCENE:TOPIC`` that stands for the robot of a scene file.
_ODOMETRY = "/odom"
_SCENE_SUFFIXES = (".yaml", ".yml")
#: By message type: function that returns the pose in a message. Poses are also read from tf.
_POSES: dict[str, Callable[[Any], Any]] = {
    "nav_msgs/msg/Odometry": lambda message: message.pose.pose,
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda message: message.pose.pose,
    "visualization_msgs/msg/Marker": lambda message: message.pose,
}
#: Stamp, frame, and pose (4, 4) of the robot in this frame.
_Sample = tuple[int, str, Array]


def is_robot_path(text: str) -> bool:
    """Whether an estimate is the path of a robot: a topic with poses of a robot in a bag, or the robot of a
    scene file. Raises BagError if the bag cannot be read."""
    name, topic = split_topic(text)
    path = Path(name)
    if topic is None or not path.exists():
        return False
    if path.suffix.lower() in _SCENE_SUFFIXES:
        return True
    return is_bag(path) and has_topic(path, topic, [*_POSES, TF])


def read_robot_path(text: str, scene: Scene | None) -> RobotPath:
    """Read the path of a robot.

    Args:
        text: ``BAG:TOPIC``, or ``SCENE:/odom`` for the robot of a scene file that has a path or trajectory.
        scene: The scene of the truth. It defines the frames of the robot, and where its odometry starts.

    Raises:
        HumansimError: A file cannot be read, stamps go back, a pose is not valid, or a transform to map is
            missing.
    """
    name, topic = split_topic(text)
    assert topic is not None
    if Path(name).suffix.lower() in _SCENE_SUFFIXES:
        if topic != _ODOMETRY:
            raise EvaluationError(f"a scene file has the topic {_ODOMETRY} only", path=name, key="--estimate")
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
    """Read the path of a robot from a topic, and convert it to ``map`` with the transforms of the bag."""
    robot = scene.robot if scene is not None else None
    base = robot.config.base_frame if robot is not None else _BASE_FRAME
    samples: list[_Sample] = []
    with RecordedMessages(path) as recorded:
        kinds = {each.name: each.type for each in recorded.reader.topics}
        if topic not in kinds:
            raise EvaluationError(unknown("topic", topic, kinds, "the bag", 8), path=path)
        is_tf = kinds[topic] == TF
        transforms = bag_transforms(path, [base] if is_tf else [])
        moving = transforms.moving(base)  # its times are those of the path

        def read(data: bytes, kind: BagTopic) -> list[_Sample]:
            if not is_tf:
                return [_sample(data, kind)]
            return [(stamp, base, np.eye(4)) for _, child, stamp, _ in read_links(data) if child == moving]

        for _, _, found in recorded.each([topic], read, EvaluationError):
            samples += found
    if not samples:
        raise EvaluationError(f"there is no pose of {base} on it", path=path, key=topic)
    times = np.array([time for time, *_ in samples], np.int64)
    for number in np.flatnonzero(np.diff(times) < 0).tolist():
        before, after = (times[number : number + 2] * 1e-9).tolist()
        text = f"the robot's clock goes back from {before:.3f} s to {after:.3f} s at pose {number + 2}"
        raise EvaluationError(f"{text}: give a bag of one run", path=path, key=topic)
    if not is_tf:
        transforms = bag_transforms(path, {frame for _, frame, _ in samples})
    for child, parents in transforms.ambiguous():
        name, *both = (repr(printable(each, 80)) for each in (child, *parents))
        raise EvaluationError(f"the frame {name} has two parents, {' and '.join(both)}", path=path, key=topic)
    matrices = []
    for time, frame, pose in samples:
        matrix, top = transforms.pose(frame, time) or (np.eye(4), frame)
        if top != WORLD_FRAME:
            if robot is None or top != robot.config.odom_frame:
                raise EvaluationError(
                    f"no transforms lead from {printable(top, 80)!r} to {WORLD_FRAME}: record /tf and "
                    "/tf_static, too, or give the scene of the robot as --truth",
                    path=path,
                    key=topic,
                )
            start = robot.start
            matrix = transform(quaternion_to_matrix(start.rotation), start.position) @ matrix
        matrices.append(matrix @ pose)
    return RobotPath.of(times, np.array(matrices), f"{path}:{topic}")


def _sample(data: Any, topic: BagTopic) -> _Sample:
    message = deserialised_message(data, topic)
    position, rotation = rigid_pose(_POSES[topic.type](message), "a pose of the robot")
    pose = transform(quaternion_to_matrix(rotation), position)
    return to_nanoseconds(message.header.stamp), message.header.frame_id.strip("/"), pose
