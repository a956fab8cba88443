"""Entities of a scene: humans, objects and cameras, each with a name, a pose and a velocity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from humansim_ros.motion.kinematics import JointPoses, Velocity
from humansim_ros.rotations import matrix_to_quaternion
from humansim_ros.scene.camera import CameraPose
from humansim_ros.scene.objects import ObjectPose
from humansim_ros.scene.scene import Scene
from humansim_ros.types import Array


@dataclass(frozen=True)
class EntityPose:
    """Pose of an entity in ``map``: position (3,) in metres, rotation (4,) as quaternion xyzw.

    ``velocity``: None if it is unknown.
    """

    position: Array
    rotation: Array
    velocity: Velocity | None = None

    @classmethod
    def of_object(cls, pose: ObjectPose) -> EntityPose:
        """Pose of an object: the origin of its mesh."""
        return cls(pose.position, pose.rotation, pose.velocity)

    @classmethod
    def of_camera(cls, pose: CameraPose) -> EntityPose:
        """Pose of a camera: its optical frame."""
        return cls(-pose.R.T @ pose.t, matrix_to_quaternion(pose.R.T), pose.velocity)

    @classmethod
    def of_human(cls, poses: JointPoses, hips: int) -> EntityPose:
        """Pose of a human: the point of the floor below the hips, x in the direction that the hips face.

        ``poses``: joints at one time (N = 1). ``hips``: number of the joint of the hips.
        """
        x, y, _ = poses.positions[0, hips]
        heading = scipy.spatial.transform.Rotation.from_quat(poses.rotations[0, hips]).apply([1.0, 0.0, 0.0])
        yaw = np.arctan2(heading[1], heading[0])
        velocity = None
        if poses.linear is not None and poses.angular is not None:
            change = np.cross(poses.angular[0, hips], heading)
            flat = max(float(heading[:2] @ heading[:2]), 1e-9)  # of somebody who lies on the back
            rate = (heading[0] * change[1] - heading[1] * change[0]) / flat
            velocity = Velocity(poses.linear[0, hips] * (1, 1, 0), np.array([0.0, 0.0, rate]))
        rotation = np.array([0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)])
        return cls(np.array([x, y, 0.0]), rotation, velocity)


@dataclass(frozen=True)
class Entity:
    """A human, object or camera of a scene.

    Attributes:
        name: Unique name: the prefix of its topics, such as ``humans/walker``, ``objects/ball`` or ``left``.
        kind: Kind of entity.
        key: Name in its section of the scene file.
        moves: Whether the scene moves it: a motion, keyframes or a trajectory.
        description: Text for people.
    """

    name: str
    kind: Literal["human", "object", "camera"]
    key: str
    moves: bool
    description: str

    @property
    def tags(self) -> tuple[str, ...]:
        """Words by which it can be found."""
        return self.kind, "moving" if self.moves else "static"


def scene_entities(scene: Scene) -> dict[str, Entity]:
    """Entities of a scene by name."""
    entities = [
        *(
            Entity(
                f"humans/{key}", "human", key, True, f"{scene.config.humans[key].body}, label {each.instance}"
            )
            for key, each in scene.actors.items()
        ),
        *(
            Entity(f"objects/{key}", "object", key, each.moves, f"{each.shape}, label {each.instance}")
            for key, each in scene.objects.items()
        ),
        *(
            Entity(
                key, "camera", key, each.moves, f"camera, {each.camera.size[0]}x{each.camera.size[1]} pixels"
            )
            for key, each in scene.scene_cameras.items()
        ),
    ]
    return {entity.name: entity for entity in entities}
