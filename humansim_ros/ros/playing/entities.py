"""Entities (``simulation_interfaces`` calls humans, objects and cameras so), and filters of requests."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import scipy

from humansim_ros.errors import printable
from humansim_ros.scene.core import Playback, Scene
from humansim_ros.types import Array

#: Most characters of a pattern from the network, and most bytes of a compiled pattern.
_MAX_PATTERN, _MAX_PATTERN_BYTES = 256, 1 << 20
#: Most elements of a list in a filter.
MAX_FILTERS = 1000


class Refusal(Exception):
    """Raised to refuse a request with a message. ``code``: name of the constant for the result code."""

    def __init__(self, message: str, code: str = "RESULT_OPERATION_FAILED") -> None:
        super().__init__(message)
        self.code = code


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


def name_filter(pattern: str) -> Callable[[str], bool]:
    """Make a function that tests whether a POSIX extended pattern matches any part of a name. With RE2, its
    time is linear in the length of the name. Raises Refusal if the pattern is too long or wrong."""
    if not pattern:
        return lambda name: True
    if len(pattern) > _MAX_PATTERN:
        raise Refusal(f"a pattern of {len(pattern)} characters; at most {_MAX_PATTERN} are read")
    try:
        import re2
    except ImportError:
        problem = "filters by a pattern need the package google-re2: pip install google-re2"
        raise Refusal(problem, "RESULT_FEATURE_UNSUPPORTED") from None
    options = re2.Options()
    options.posix_syntax = options.one_line = True
    options.log_errors = False
    options.max_mem = _MAX_PATTERN_BYTES
    try:
        found = re2.compile(pattern, options)
    except re2.error as error:
        reason = error.args[0].decode(errors="replace") if error.args else ""
        raise Refusal(f"the filter is no POSIX extended pattern: {printable(reason, 80)}") from None
    return lambda name: found.search(name) is not None


def has_tags(tags: Any, own: Collection[str]) -> bool:
    """Whether a filter by tags (TagsFilter) accepts an entity with its own tags."""
    if len(tags.tags) > MAX_FILTERS:
        raise Refusal(f"more than {MAX_FILTERS} tags")
    found = [tag in own for tag in tags.tags]
    return not found or (all if tags.filter_mode == type(tags).FILTER_MODE_ALL else any)(found)
