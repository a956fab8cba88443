"""Draw the values of a scene of a recipe."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from humansim_ros.data.datasets.draws import ChoiceDraw, Keys, draw_at
from humansim_ros.data.datasets.recipe_config import RingConfig
from humansim_ros.errors import SceneError
from humansim_ros.files.yaml import Section, show_value, validated
from humansim_ros.scene.config import RoomConfig, Vector3
from humansim_ros.scene.core import RandomNumbers

#: Seeds of scenes are below this number: JSON can hold such whole numbers exactly, and two scenes hardly ever
#: get the same seed.
_SEEDS = 2**53
#: Smallest distance of the cameras of a ring from walls and ceiling, metres.
_FROM_WALLS = 0.3


class _Ring(Section):
    """Drawn values of all cameras of a ring."""

    count: int = Field(ge=1, le=100)
    scatter_deg: float = Field(ge=0, le=180)


class _Place(Section):
    """Drawn values of one camera of a ring."""

    radius: float = Field(gt=0, le=1000)
    height: float = Field(ge=-100, le=1000)
    look_at: Vector3


class SceneDraws:
    """Draws the values of one draw of a scene.

    Args:
        random: Random numbers for a key of the recipe. The same key has the same numbers.
        is_allowed: Whether a body may be in the scene.
        given: Values in place of drawn ones, by key.
    """

    def __init__(
        self,
        random: Callable[[Keys], RandomNumbers],
        is_allowed: Callable[[str], bool],
        given: Mapping[Keys, Any],
    ) -> None:
        self._random, self._is_allowed, self._given = random, is_allowed, given

    def seed(self, keys: Keys) -> int:
        """A random seed for a key ``seed`` that the recipe leaves out."""
        return int(_SEEDS * self._random(keys)())

    def value(self, value: Any, keys: Keys, purpose: Keys | None = None) -> Any:
        """Draw the distributions in a value.

        Args:
            value: The value, or the distribution in its place.
            keys: Key of the value in the recipe.
            purpose: Key that the random numbers depend on, if the same distribution is drawn more than once.
                If None, ``keys``.
        """
        purpose = purpose or keys
        if keys in self._given:
            return self.value(self._given[keys], (*keys, "given"), purpose)
        draw = draw_at(value)
        if isinstance(draw, ChoiceDraw) and keys[-1] == "body":
            draw = draw.among(lambda body: self._is_allowed(str(body))) or draw
        if draw is not None:
            return self.value(draw.value(self._random(purpose)), (*keys, "drawn"), (*purpose, "drawn"))
        if isinstance(value, dict):
            return {key: self.value(part, (*keys, key), (*purpose, key)) for key, part in value.items()}
        if isinstance(value, (list, tuple)):
            return [self.value(part, (*keys, n), (*purpose, n)) for n, part in enumerate(value)]
        return value

    def ring(self, ring: RingConfig, scene: Mapping[str, Any]) -> dict[str, Any]:
        """Cameras of a ring, by name. Raises SceneError, which names the key."""
        whole = {key: self.value(getattr(ring, key), ("ring", key)) for key in _Ring.model_fields}
        checked = _of_ring(_Ring, whole)
        shared = self.value(ring.camera, ("ring", "camera"))
        turn = 2 * math.pi * self._random(("ring", "turn"))()
        cameras = {}
        for index in range(checked.count):
            own = (f"camera {index}",)

            def drawn(key: str, own: tuple[str] = own) -> Any:
                return self.value(getattr(ring, key), ("ring", key), ("ring", key, *own))

            place = _of_ring(_Place, {key: drawn(key) for key in _Place.model_fields})
            scatter = math.radians(checked.scatter_deg) * (2 * self._random(("ring", "scatter", *own))() - 1)
            angle = turn + 2 * math.pi * index / checked.count + scatter
            x, y, _ = place.look_at
            point = (x + place.radius * math.cos(angle), y + place.radius * math.sin(angle), place.height)
            cameras[f"camera_{index + 1}"] = {
                "position": _inside_room(point, scene),
                "look_at": list(place.look_at),
                **as_mapping(shared, "ring.camera"),
                **as_mapping(drawn("each"), "ring.each"),
            }
        return cameras


def as_mapping(value: Any, key: str) -> dict[str, Any]:
    """Return a drawn value that must be a mapping. Raises SceneError, which names ``key``, if it is not."""
    if not isinstance(value, dict):
        raise SceneError(f"give a mapping of keys to values; found {show_value(value)}", key=key)
    return value


def _of_ring(model: type[Any], values: Mapping[str, Any]) -> Any:
    """Check the values of a ring. Returns them as an instance of ``model``."""
    try:
        return validated(model, values, SceneError)
    except SceneError as error:
        raise error.within("ring") from None


def _inside_room(point: Sequence[float], scene: Mapping[str, Any]) -> list[float]:
    """A point, moved away from walls and ceiling if the scene has a room. It is rounded to millimetres."""
    room = scene.get("room", {})
    if isinstance(room, dict):
        size = room.get("size", RoomConfig.model_fields["size"].default)
        try:
            most = np.array(size, dtype=float) / (2, 2, 1) - _FROM_WALLS
        except (TypeError, ValueError):
            return list(point)  # an error of the scene
        point = np.clip(point, (-most[0], -most[1], -np.inf), most).tolist()
    return [round(value, 3) for value in point]


def with_seeds(section: Section, keys: Keys, seed: Callable[[Keys], int]) -> Section:
    """Return a copy of a section, with a value of ``seed`` for each key ``seed`` that is left out."""
    changes: dict[str, Any] = {}
    for name in type(section).model_fields:
        value = getattr(section, name)
        if name == "seed" and name not in section.model_fields_set:
            changes[name] = seed((*keys, name))
        elif (changed := _seeded(value, (*keys, name), seed)) is not value:
            changes[name] = changed
    return section.model_copy(update=changes) if changes else section


def _seeded(value: Any, keys: Keys, seed: Callable[[Keys], int]) -> Any:
    if isinstance(value, Section):
        return with_seeds(value, keys, seed)
    if isinstance(value, dict):
        changed = {name: _seeded(part, (*keys, name), seed) for name, part in value.items()}
        return changed if any(changed[name] is not value[name] for name in value) else value
    return value
