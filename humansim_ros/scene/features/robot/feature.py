"""The robot of a scene: a moving object that carries cameras (docs/robots.md)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from humansim_ros.cameras.camera import Trajectory
from humansim_ros.errors import in_section
from humansim_ros.geometry import ObjectPose
from humansim_ros.scene.config.config import ObjectConfig, SceneConfig
from humansim_ros.scene.core.features import Draft, Feature
from humansim_ros.scene.core.objects import Robot, Route, SceneObject
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.robot import ROBOT, PathConfig


def read_robot(config: SceneConfig, source: SceneSource) -> Robot | None:
    """The robot of a scene, if it has one. Raises HumansimError, which names the key."""
    robot = config.robot
    if robot is None:
        return None
    if robot.path is not None:
        return Robot(robot, Route(path_trajectory(robot.path)))
    if robot.trajectory is None:
        return Robot(robot)
    with in_section(f"{ROBOT}.trajectory"):
        return Robot(robot, Route.read(robot.trajectory, source))


def path_trajectory(config: PathConfig) -> Trajectory:
    """Trajectory of ``base_link`` along the points of a path: lines, and turns on the spot before them."""
    points = list(config.points)
    if config.end == "loop" and points[0] != points[-1]:
        points.append(points[0])
    lines = np.diff(np.array(points), axis=0)
    headings = np.arctan2(lines[:, 1], lines[:, 0])
    if config.end == "loop":
        headings = np.append(headings, headings[0])
    time, rows = 0.0, [(0.0, *points[0], float(headings[0]))]
    for number, line in enumerate(lines):
        time += float(np.hypot(*line)) / config.speed
        yaw = rows[-1][3]
        rows.append((time, *points[number + 1], yaw))
        if number + 1 < len(headings):
            turn = math.remainder(headings[number + 1] - yaw, 2 * math.pi)
            # by halves: a turn by pi has two shortest arcs
            for share in (0.5, 1.0) if abs(turn) > 1e-9 else ():
                time += abs(turn) / 2 / math.radians(config.turn_deg)
                rows.append((time, *points[number + 1], yaw + share * turn))
    poses = [ObjectPose.on_floor(x, y, yaw) for _, x, y, yaw in rows]
    return Trajectory(
        np.array([row[0] for row in rows]),
        np.array([pose.position for pose in poses]),
        np.array([pose.rotation for pose in poses]),
        config.end,
    )


class RobotBody(Feature):
    """The section ``robot``."""

    def prepare(self, draft: Draft) -> None:
        """Add the robot, which may carry cameras and scanners."""
        draft.robot = robot = read_robot(draft.config, draft.source)
        assert robot is not None
        color = {} if robot.config.color is None else {"color": robot.config.color}
        section = ObjectConfig(mesh=robot.config.mesh, size=robot.config.size, **color)
        with in_section(ROBOT):
            item = SceneObject.build(ROBOT, section, draft.source, None, 0)
        start = item.placed(robot.body_at(0.0))
        draft.robot_body = replace(item, initial_pose=start, pose_at=robot.body_at, key=ROBOT)

    def furnish(self, draft: Draft) -> None:
        """Add the body of the robot."""
        assert draft.robot is not None and draft.robot_body is not None
        label = draft.next_label(draft.robot.config.label)
        draft.objects[ROBOT] = replace(draft.robot_body, instance=label)


FEATURE = RobotBody()
