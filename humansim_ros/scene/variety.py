"""People drawn at random: bodies, outfits, motions and places; the same seed gives the same people."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

from humansim_ros.errors import SceneError
from humansim_ros.humans.loading import load_human
from humansim_ros.scene.config import (
    HumanConfig,
    MotionConfig,
    SceneConfig,
    VarietyConfig,
    built_in_names,
    find_human,
)
from humansim_ros.scene.names import variety_names

#: Motions of the package that look right when they begin again and again.
MOTIONS = ("walk", "run", "wave", "pick_up", "sit_stand", "turn_in_place")
#: Metres of a room that furniture and walls take on every side.
_FURNITURE = 1.4
#: Places tried for one person before the area counts as full.
_TRIES = 2000
Item = TypeVar("Item")


def with_variety(config: SceneConfig, scene: Path) -> SceneConfig:
    """A scene's configuration with the people that its ``variety`` section draws among its humans.

    Each person is drawn from the seed and its number alone, so that more people do not change the first, and
    places keep apart. Raises SceneError where there is no room for them.
    """
    variety = config.variety
    if variety is None:
        return config
    humans = dict(config.humans)
    area = _area(variety, config)
    taken = [human.motion.position for human in humans.values()]
    for name in variety_names(variety.name, variety.count):
        if name in humans:
            raise SceneError(f"there is a human {name} already", path=scene, key="variety.name")
        humans[name] = _person(name, variety, area, taken, scene)
        taken.append(humans[name].motion.position)
    return config.model_copy(update={"humans": humans, "variety": None})


def _person(
    name: str,
    variety: VarietyConfig,
    area: Sequence[float],
    taken: Sequence[tuple[float, float]],
    scene: Path,
) -> HumanConfig:
    # random.random() is the same for a seed in every Python; its other functions need not be
    drawn = random.Random(f"{variety.seed}/{name}").random
    body = _one_of(variety.bodies or built_in_names("humans", ".npz"), drawn())
    outfits = load_human(find_human(body, scene, "variety.bodies")).outfits
    outfit = _one_of(outfits, drawn())
    motion = _one_of(variety.motions or MOTIONS, drawn())
    yaw, ahead, mirror = 360 * drawn() - 180, 10 * drawn(), drawn() < 0.5
    low, high = variety.speed
    speed = low + (high - low) * drawn()
    for _ in range(_TRIES):
        x0, y0, x1, y1 = area
        place = (x0 + (x1 - x0) * drawn(), y0 + (y1 - y0) * drawn())
        if all(math.dist(place, other) >= variety.spacing for other in taken):
            break
    else:
        raise SceneError(
            f"{len(taken)} people stand here already, and {name} finds no place {variety.spacing:g} m from "
            "all of them: give a larger area, a smaller spacing, or fewer people",
            path=scene,
            key="variety.count",
        )
    return HumanConfig(
        body=body,
        outfit=outfit,
        motion=MotionConfig(
            file=motion,
            position=(round(place[0], 4), round(place[1], 4)),
            yaw_deg=round(yaw, 3),
            anchor="center",
            offset=round(ahead, 3),
            speed=round(speed, 4),
            mirror=mirror,
        ),
    )


def _area(variety: VarietyConfig, config: SceneConfig) -> tuple[float, float, float, float]:
    """Where people go: what is said, else the middle of the room."""
    if variety.area is not None:
        return variety.area
    size = (6.0, 6.0) if config.room is None else config.room.size[:2]
    x, y = (max(side / 2 - _FURNITURE, 0.3) for side in size)
    return -x, -y, x, y


def _one_of(items: Sequence[Item], share: float) -> Item:
    return items[min(int(share * len(items)), len(items) - 1)]
