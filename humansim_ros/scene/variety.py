"""Random humans: bodies, outfits, motions and positions; the same seed gives the same humans."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar

from humansim_ros.errors import SceneError, in_section
from humansim_ros.io.assets import built_in_names
from humansim_ros.scene.config import (
    HumanConfig,
    MotionConfig,
    SceneConfig,
    VarietyConfig,
)
from humansim_ros.scene.names import variety_names
from humansim_ros.scene.randomise import random_numbers
from humansim_ros.scene.source import SceneSource

#: Built-in motions that can be repeated without a visible jump.
MOTIONS = ("walk", "run", "wave", "pick_up", "sit_stand", "turn_in_place")
#: Metres on each side of a room where furniture may be.
_FURNITURE = 1.4
#: Positions tried for one human before the area counts as full.
_TRIES = 2000
Item = TypeVar("Item")


def with_variety(config: SceneConfig, source: SceneSource) -> SceneConfig:
    """Configuration with the random humans of its ``variety`` section among its humans.

    A human depends on the seed and its number only: more humans do not change the first ones. Raises
    SceneError with the key if there is no space for them.
    """
    variety = config.variety
    if variety is None:
        return config
    humans = dict(config.humans)
    area = _area(variety, config)
    taken = [human.motion.position for human in humans.values()]
    for name in variety_names(variety.name, variety.count):
        if name in humans:
            raise SceneError(f"there is a human {name} already", key="variety.name")
        humans[name] = _random_human(name, variety, area, taken, source)
        taken.append(humans[name].motion.position)
    return config.model_copy(update={"humans": humans, "variety": None})


def _random_human(
    name: str,
    variety: VarietyConfig,
    area: Sequence[float],
    taken: Sequence[tuple[float, float]],
    source: SceneSource,
) -> HumanConfig:
    uniform = random_numbers(variety.seed, name)
    body = _one_of(variety.bodies or built_in_names("humans"), uniform())
    with in_section("variety"):
        outfits = source.human(body, key="bodies").outfits
    outfit = _one_of(outfits, uniform())
    motion = _one_of(variety.motions or MOTIONS, uniform())
    yaw, ahead, mirror = 360 * uniform() - 180, 10 * uniform(), uniform() < 0.5
    low, high = variety.speed
    speed = low + (high - low) * uniform()
    for _ in range(_TRIES):
        x0, y0, x1, y1 = area
        position = (x0 + (x1 - x0) * uniform(), y0 + (y1 - y0) * uniform())
        if all(math.dist(position, other) >= variety.spacing for other in taken):
            break
    else:
        raise SceneError(
            f"the area has {len(taken)} humans already, and {name} finds no position {variety.spacing:g} m "
            "from all of them: give a larger area, a smaller spacing, or fewer humans",
            key="variety.count",
        )
    return HumanConfig(
        body=body,
        outfit=outfit,
        motion=MotionConfig(
            file=motion,
            position=(round(position[0], 4), round(position[1], 4)),
            yaw_deg=round(yaw, 3),
            anchor="center",
            offset=round(ahead, 3),
            speed=round(speed, 4),
            mirror=mirror,
        ),
    )


def _area(variety: VarietyConfig, config: SceneConfig) -> tuple[float, float, float, float]:
    """Area of the positions: as configured, else the middle of the room."""
    if variety.area is not None:
        return variety.area
    size = (6.0, 6.0) if config.room is None else config.room.size[:2]
    x, y = (max(side / 2 - _FURNITURE, 0.3) for side in size)
    return -x, -y, x, y


def _one_of(items: Sequence[Item], share: float) -> Item:
    return items[min(int(share * len(items)), len(items) - 1)]
