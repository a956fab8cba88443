"""Entities of a scene, as ``simulation_interfaces`` calls humans, objects and cameras."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy

from humansim_ros.scene.core import Playback, Scene
from humansim_ros.types import Array


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
    entities = []
    for key, human in scene.actors.items():
        text = f"{scene.config.humans[key].body}, label {human.instance}"
        entities.append(Entity(f"humans/{key}", "human", key, True, text))
    for key, item in scene.objects.items():
        text = f"{item.shape}, label {item.instance}"
        entities.append(Entity(f"objects/{key}", "object", key, item.moves, text))
    for key, camera in scene.scene_cameras.items():
        text = "camera, {}x{} pixels".format(*camera.camera.size)
        entities.append(Entity(key, "camera", key, camera.moves, text))
    return {entity.name: entity for entity in entities}


def placement(playback: Playback, name: str, position: Array, yaw: float) -> dict[str, Any]:
    """Settings of a motion for :meth:`Playback.prepare` that put a human somewhere else now.

    Args:
        playback: The scene as it plays.
        name: Name of the human, without keyframes.
        position: (2,) where the hips are to be, metres in ``map``.
        yaw: Direction that they are to face, radians.
    """
    now, settings = playback.human_pose(name), playback.settings[name]
    turn = yaw - scipy.spatial.transform.Rotation.from_quat(now.rotation).as_euler("xyz")[2]
    cos, sin = np.cos(turn), np.sin(turn)
    anchor = position + np.array([[cos, -sin], [sin, cos]]) @ (settings.position - now.position[:2])
    return {"position": tuple(anchor.tolist()), "yaw_deg": settings.yaw_deg + float(np.degrees(turn))}
