"""The robot as an object of its scene."""

from __future__ import annotations

from dataclasses import replace

from humansim_ros.errors import in_section
from humansim_ros.scene.core.draft import Draft
from humansim_ros.scene.core.features import Feature
from humansim_ros.scene.features.robot.keys import ROBOT
from humansim_ros.scene.features.robot.robot import Robot, robot_object


class RobotBody(Feature):
    """The section ``robot``."""

    def prepare(self, draft: Draft) -> None:
        """Add the robot, which may carry cameras and scanners."""
        draft.robot = Robot.of_scene(draft.config, draft.source)
        assert draft.robot is not None
        with in_section(ROBOT):
            draft.robot_body = robot_object(draft.robot, draft.source)

    def furnish(self, draft: Draft) -> None:
        """Add the body of the robot."""
        assert draft.robot is not None and draft.robot_body is not None
        label = draft.next_label(draft.robot.config.label)
        draft.objects[ROBOT] = replace(draft.robot_body, instance=label)


FEATURE = RobotBody()
