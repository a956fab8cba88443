"""People drawn by seed: age, sex, stature, weight, skin, hair, clothes, and MakeHuman sliders for them.

Stature and body mass index follow the National Health and Nutrition Examination Survey, August 2021 to August
2023 [Fryar 2025, tables 5, 7, 9, 10], by age and sex. Other traits are spread evenly, without a source.
"""

from __future__ import annotations

import colorsys
import random
from bisect import bisect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from statistics import NormalDist
from typing import Any, Literal

import numpy as np

from humansim_ros.errors import MeshError
from humansim_ros.files.reading import read_table
from humansim_ros.files.yaml import ByteColor, validated
from humansim_ros.people.makehuman.data import Base, MakeHumanData
from humansim_ros.people.makehuman.limits import PeopleConfig
from humansim_ros.people.makehuman.shape import (
    WORN,
    Attire,
    MakeHumanConfig,
    Outfit,
    Race,
    draw_clothes,
    draw_fabric,
    read_body,
    target_strengths,
    with_stature,
)
from humansim_ros.types import Array

Sex = Literal["female", "male"]
SEXES: tuple[Sex, ...] = ("female", "male")
#: Ages in years and body mass indices that people can have.
AGES, BMIS = (2.0, 90.0), (12.0, 42.0)
#: Most standard deviations of a stature from its mean.
_MOST_DEVIATIONS = 5
#: Density of a body, kilograms per cubic metre. People just float.
DENSITY = 985.0
_TABLE = read_table("population")
#: Middles of the age groups of the survey, years. From 20 on, a group has ten years; the last group begins at
#: 80.
_GROUPS = _TABLE["ages"]
#: Standard normal values of the 5th, 10th, 15th, 25th, 50th, 75th, 85th, 90th and 95th percentile.
_SCORES = _TABLE["scores"]
#: Mean, 10th and 90th percentile of the stature of each age group, centimetres, by sex.
_STATURE = _TABLE["stature"]
#: Percentiles of the body mass index of each age group. The survey leaves out the 5th of four groups. It
#: continues the line through the 10th and the 15th.
_BMI = _TABLE["bmi"]
#: The ten tones of the Monk Skin Tone scale [Monk 2023], sRGB.
MONK_TONES: Sequence[Sequence[int]] = _TABLE["tones"]
#: Number of dark colours of hair and eyes, which people with the tones 5 to 10 have; and the colour of grey
#: hair.
_DARK, _GREY = 2, (206, 204, 200)
#: First and last tone of the scale.
_TONES = (1.0, 10.0)
#: Colours of cloth in a street, estimated without a source: shares in percent for adults and for children,
#: and ranges of hue, saturation and value (HSV, 0 to 1). A hue above 1 lies beyond red.
_CLOTH = _TABLE["cloth"]
#: Suits, coats and jackets have only this many of the first kinds of colours. From this age on (years),
#: people wear the colours of adults.
_COATS, _GROWN = 5, 13
#: Shape targets of the face that are drawn at random: name without its end, and the two possible ends.
_FACE = _TABLE["face"]
#: All these targets by name.
FACE_TARGETS = tuple(f"{name}-{end}" for name, *ends in _FACE for end in ends)
#: Largest strength of a target of the face.
_FACE_STRENGTH = 0.6
_NORMAL = NormalDist()


@dataclass(frozen=True)
class Person:
    """A person before it is built.

    ``age``: years. ``stature``: metres, barefoot. ``weight``: kilograms, without clothes. ``tone``: number of
    the skin tone in the Monk scale, 1 to 10. ``muscle``: muscles compared with others, 0.3 to 0.7. ``race``:
    shares of MakeHuman's three races. ``face``: strengths of targets of the face.
    """

    age: float
    sex: Sex
    stature: float
    weight: float
    tone: int
    muscle: float
    race: dict[Race, float]
    face: dict[str, float]
    clothes: Attire
    outfit: Outfit

    @property
    def bmi(self) -> float:
        """Body mass index, kilograms per square metre."""
        return self.weight / self.stature**2


def draw_people(seed: int, number: int, people: PeopleConfig) -> Person:
    """Draw a person within limits. Everything without a limit is drawn as in :func:`draw_person`. A person
    with a stature or body mass index outside the limits is drawn again. Raises MeshError if nobody has these
    traits together.

    Example:
        >>> 30 <= draw_people(7, 3, PeopleConfig(age=(30, 40))).age <= 40
        True
    """
    for attempt in range(_ATTEMPTS):
        person = _drawn(f"{seed}/person {number}{f'/{attempt}' if attempt else ''}", people)
        fits = people.stature[0] <= person.stature <= people.stature[1]
        if fits and people.bmi[0] <= round(person.bmi, 2) <= people.bmi[1]:
            break
    else:
        raise MeshError(
            f"of {_ATTEMPTS} people of {people.age[0]:g} to {people.age[1]:g} years nobody is "
            f"{people.stature[0]:g} to {people.stature[1]:g} m tall with a body mass index of "
            f"{people.bmi[0]:g} to {people.bmi[1]:g}: give wider ranges (stature, bmi) or other ages (age)"
        )
    if people.uniform:
        model = _drawn(f"{seed}/uniform", PeopleConfig(), sex="male")  # clothes of men, which women wear too
        clothes = {key: getattr(model.outfit, key) for key in _CLOTHES}
        outfit = person.outfit.model_copy(update=clothes)
        same = {key: getattr(model.clothes, key) for key in ("sleeves", "top", "bottom", "shoes")}
        person = replace(person, outfit=outfit, clothes=person.clothes.model_copy(update=same))
    return person


#: Number of draws after which the search for a person fails; and the clothes of all people in uniform.
_ATTEMPTS = 1000
_CLOTHES = (
    *("shirt", "shirt_fabric", "shirt_second", "trousers", "trousers_fabric", "trousers_second"),
    *("belt", "shoes", "soles"),
)
#: Prefix of the name of a drawn person, and the separator of ranges in the name.
_PERSON, _TO = "person#", ".."


def is_person(name: str) -> bool:
    """Whether the name of a human is the name of a drawn person, such as ``person#7-3,age=20..60``."""
    return name.startswith(_PERSON)


def person_name(seed: int, number: int, people: PeopleConfig) -> str:
    """Name from which :func:`read_person` draws the same person."""
    parts = [f"{_PERSON}{seed}-{number}"]
    for key, field in PeopleConfig.model_fields.items():
        value = getattr(people, key)
        if value != field.default:
            parts.append(key if value is True else f"{key}={_text(value)}")
    return ",".join(parts)


def _text(value: float | tuple[float, float]) -> str:
    parts = value if isinstance(value, tuple) else (value,)
    return _TO.join(repr(part).removesuffix(".0") for part in parts)


def read_person(name: str) -> Person:
    """Draw the person of a name: ``person#SEED-NUMBER``, with fields of :class:`PeopleConfig` if given.
    Raises MeshError if the name is wrong, or nobody has these traits.

    Example:
        >>> read_person("person#7-3,age=20..60,uniform").age > 20
        True
    """
    try:
        start, *parts = name.removeprefix(_PERSON).split(",")
        seed, number = (int(part) for part in start.split("-"))
        values: dict[str, Any] = {}
        for part in parts:
            key, _, text = part.partition("=")
            if key in values:
                raise MeshError(f"{key} is there twice", key=key)
            numbers = [float(word) for word in text.split(_TO)] if part != "uniform" else [True]
            values[key] = numbers if len(numbers) > 1 else numbers[0]
    except ValueError:
        raise MeshError(
            f"{name[:60]!r} is no drawn person: give a seed and a number, and if you like "
            f"{', '.join(PeopleConfig.model_fields)}, as in person#7-3,age=20..60,women=0.5"
        ) from None
    return draw_people(seed, number, validated(PeopleConfig, values, MeshError))


def draw_person(
    seed: int,
    number: int = 0,
    ages: tuple[float, float] = AGES,
    sex: Sex | None = None,
    stature: float | None = None,
    weight: float | None = None,
    tone: int | None = None,
    clothes: Mapping[str, Any] | None = None,
) -> Person:
    """Draw a person. The result depends only on the seed, the number and the given traits.

    Args:
        seed: Seed of a group of people.
        number: Number of the person in the group.
        ages: Youngest and oldest age, years. All ages between them are equally frequent.
        sex: Sex. If None, it is drawn, like all traits below.
        stature: Metres, barefoot.
        weight: Kilograms.
        tone: Skin tone of the Monk scale, 1 to 10.
        clothes: Names of hair, beard, sleeves, top, bottom, shoes and worn things. Those given are not drawn.

    Raises:
        MeshError: A trait is impossible.

    Example:
        >>> person = draw_person(4, sex="female", ages=(70, 70), stature=1.58)
        >>> person.age, person.sex, person.stature
        (70.0, 'female', 1.58)
    """
    limits = PeopleConfig.model_construct(age=ages)  # ages are checked with the other traits
    return _drawn(f"{seed}/person {number}", limits, sex, stature, weight, tone, clothes)


def _drawn(
    seed: str,
    people: PeopleConfig,
    sex: Sex | None = None,
    stature: float | None = None,
    weight: float | None = None,
    tone: int | None = None,
    clothes: Mapping[str, Any] | None = None,
) -> Person:
    """Draw a person from its own seed, with the traits of :func:`draw_person`. Limits of stature and body
    mass index are ignored here."""
    ages = people.age
    for limit in ages:
        _check("age", limit, AGES, "years")
    if ages[0] > ages[1]:
        raise MeshError(f"the youngest age, {ages[0]:g}, is above the oldest, {ages[1]:g}", key="age")
    uniform = random.Random(seed).random
    age = round(ages[0] + (ages[1] - ages[0]) * uniform(), 2)
    drawn_sex = SEXES[uniform() < 1 - people.women]
    sex = sex or drawn_sex
    tall, heavy = _NORMAL.inv_cdf(0.002 + 0.996 * uniform()), _NORMAL.inv_cdf(0.002 + 0.996 * uniform())
    mean, deviation = stature_of(age, sex)
    drawn_stature = round((mean + deviation * tall) / 100, 3)
    stature = drawn_stature if stature is None else stature
    tallest, shortest = (round((mean + side * _MOST_DEVIATIONS * deviation) / 100, 2) for side in (1, -1))
    _check("height", stature, (shortest, tallest), f"metres at {age:g} years")
    bmi = bmi_of(age, sex, heavy)
    weight = round(bmi * stature**2, 1) if weight is None else weight
    _check("weight", weight, (round(BMIS[0] * stature**2, 1), round(BMIS[1] * stature**2, 1)), "kg")
    lightest, darkest = people.skin
    drawn_tone = lightest + int((darkest - lightest + 1) * uniform())
    tone = drawn_tone if tone is None else tone
    _check("skin", tone, _TONES, "of the Monk scale")
    muscle = round(0.3 + 0.4 * uniform(), 3)
    race, face = _race(tone, uniform), _face(uniform)
    uniform()  # drew the hair once: the numbers after it stay those of each seed
    sleeves: Literal["short", "long"] = "long" if uniform() < 0.5 else "short"
    outfit = _outfit(age, sex, tone, uniform)
    # numbers of their own, so that new garments leave faces and colours as they are
    others = random.Random(f"{seed}/clothes").random
    worn = draw_clothes(others, age, sex == "female", sleeves, clothes or {})
    outfit = _worn_colors(outfit, worn, age, others)
    return Person(age, sex, stature, weight, tone, muscle, race, face, worn, outfit)


def _check(name: str, value: float, limits: tuple[float, float], unit: str) -> None:
    """Raise MeshError for a value outside limits."""
    if not limits[0] <= value <= limits[1]:
        raise MeshError(f"{value:g} is impossible: give {limits[0]:g} to {limits[1]:g} {unit}", key=name)


def stature_of(age: float, sex: Sex) -> tuple[float, float]:
    """Mean and standard deviation of the stature at an age, centimetres.

    The deviation of a group follows from the distance of its 10th and 90th percentile, for a normal
    distribution. Mean and deviation are interpolated between the middles of age groups. The growth within a
    group is removed, since it is no part of the deviation at one age.
    """
    means, low, high = np.array(_STATURE[sex]).T
    group = (high - low) / (_SCORES[7] - _SCORES[1])
    growth = np.gradient(means, _GROUPS)
    width = np.where(np.array(_GROUPS) < 20, 2.0, 10.0)
    deviation = np.sqrt(np.maximum(group**2 - (growth * width) ** 2 / 12, (0.03 * means) ** 2))
    # children of two are younger than the middle of the first group
    before = growth[0] * min(age - _GROUPS[0], 0.0)
    return float(np.interp(age, _GROUPS, means) + before), float(np.interp(age, _GROUPS, deviation))


def bmi_of(age: float, sex: Sex, score: float) -> float:
    """Body mass index at an age for a standard normal score, within :data:`BMIS`. The index is interpolated
    between the percentiles of the survey, and continued by a straight line beyond them."""
    rows = np.array(_BMI[sex])
    scores = np.array(_SCORES)
    if score < scores[0]:
        values = rows[:, 0] + (rows[:, 1] - rows[:, 0]) / (scores[1] - scores[0]) * (score - scores[0])
    elif score > scores[-1]:
        values = rows[:, -1] + (rows[:, -1] - rows[:, -2]) / (scores[-1] - scores[-2]) * (score - scores[-1])
    else:
        values = np.array([np.interp(score, scores, row) for row in rows])
    return float(np.clip(np.interp(age, _GROUPS, values), *BMIS))


def _race(tone: int, uniform: Callable[[], float]) -> dict[Race, float]:
    """Shares of MakeHuman's races: more African for darker skin; the remaining share is divided at random."""
    african = min(max((tone - 5) / 4 + 0.4 * (uniform() - 0.5), 0.0), 1.0)
    asian = uniform()
    rest = 1 - african
    shares: dict[Race, float] = {"african": african, "asian": rest * asian, "caucasian": rest * (1 - asian)}
    return {race: round(share, 3) for race, share in shares.items()}


def _face(uniform: Callable[[], float]) -> dict[str, float]:
    strengths = {}
    for name, low, high in _FACE:
        strength = _FACE_STRENGTH * (2 * uniform() - 1)
        strengths[f"{name}-{low if strength < 0 else high}"] = round(abs(strength), 3)
    return strengths


def _outfit(age: float, sex: Sex, tone: int, uniform: Callable[[], float]) -> Outfit:
    """Colours of skin, hair, eyes and clothes, and signs of age such as grey hair."""

    def one(kind: str, count: int | None = None) -> tuple[int, int, int]:
        options = _TABLE[kind]
        red, green, blue = options[int((count or len(options)) * uniform())]
        return red, green, blue

    few = _DARK if tone >= 5 else None
    hair, iris = one("hair", few), one("iris", few)
    grey = min(max((age - 35) / 45 + 0.5 * (uniform() - 0.5), 0.0), 1.0)
    red, green, blue = (round((1 - grey) * own + grey * goal) for own, goal in zip(hair, _GREY, strict=True))
    grown = age >= 16
    return Outfit(
        skin=skin_color(tone),
        hair=(red, green, blue),
        iris=iris,
        shirt=_cloth_color(age, uniform),
        shirt_fabric=draw_fabric(uniform(), age, sex == "female"),
        shirt_second=_cloth_color(age, uniform),
        trousers=one("trousers"),
        trousers_fabric=("denim", "twill", "plain")[int(3 * uniform())],
        shoes=one("shoes"),
        stubble=round(max(0.0, 1.6 * uniform() - 0.8), 2) * (sex == "male" and grown),
        lips=round(max(0.0, uniform() - 0.4), 2) * (sex == "female" and grown),
        wrinkles=round(min(max((age - 40) / 40, 0.0), 1.0), 2),
    )


def _cloth_color(age: float, uniform: Callable[[], float], count: int | None = None) -> ByteColor:
    """Colour of a garment from three random numbers. If ``count`` is given, only the first kinds of
    :data:`_CLOTH`."""
    kinds = _CLOTH[:count]
    shares = [kind["children" if age < _GROWN else "grown"] for kind in kinds]
    # the first number selects the kind, and its place within the share of the kind is the hue
    ends = list(accumulate(shares))
    place = ends[-1] * uniform()
    kind = bisect(ends, place)
    parts = (1 - (ends[kind] - place) / shares[kind], uniform(), uniform())
    ranges = zip((kinds[kind][name] for name in ("hue", "saturation", "value")), parts, strict=True)
    hue, saturation, value = (low + (high - low) * part for (low, high), part in ranges)
    red, green, blue = (round(255 * part) for part in colorsys.hsv_to_rgb(hue % 1.0, saturation, value))
    return red, green, blue


def _worn_colors(outfit: Outfit, clothes: Attire, age: float, uniform: Callable[[], float]) -> Outfit:
    """Colours of garments that have their own colours, and of worn things."""
    cloth, bright = _cloth_color(age, uniform, _COATS), uniform() < 0.7
    worn = {name: _cloth_color(age, uniform) for name in WORN if WORN[name].place in ("head", "back", "side")}
    own = {name: worn[name] for name in clothes.wears if name in worn and name != "hard_hat"}
    changes: dict[str, Any] = {"worn": own}
    if clothes.top == "suit":
        changes |= {"shirt": cloth, "trousers": cloth, "shirt_fabric": "twill", "trousers_fabric": "twill"}
    elif clothes.top in ("coat", "jacket"):
        changes |= {"shirt": cloth, "shirt_fabric": "twill"}
    elif clothes.top == "hi_vis":
        changes |= {"shirt": (222, 236, 64) if bright else (242, 120, 40), "shirt_fabric": "plain"}
    if clothes.bottom in ("leggings", "tights", "none"):
        changes |= {"trousers": (34, 34, 40), "trousers_fabric": "plain"}
    return outfit.model_copy(update=changes)


def skin_color(tone: int) -> tuple[int, int, int]:
    """Colour (sRGB) of the skin texture for a tone of the Monk scale.

    The scale shows how skin looks next to white. Skin reflects less light than its swatch, and reddens the
    light that it scatters; the factors were chosen from rendered faces. The darkest swatches of the scale are
    grey, but the darkest skin is brown, since red light is scattered deepest.
    """
    swatch = np.array(MONK_TONES[tone - 1]) / 255
    albedo = np.array([0.045, 0.022, 0.014]) + 0.66 * np.array([1.0, 0.84, 0.75]) * swatch**2.2
    red, green, blue = np.rint(255 * albedo ** (1 / 2.2)).astype(int).tolist()
    return red, green, blue


def person_config(source: MakeHumanData, person: Person) -> MakeHumanConfig:
    """MakeHuman sliders of a person. The stature is exact, the weight correct to 0.2 %.

    From thin to heavy, first the fat increases, then the muscles decrease, then the target of the heaviest
    body counts more than once. The weight follows from the volume of the naked body. Raises MeshError if no
    slider setting gives the stature, or the weight together with it.
    """

    def shape(fatness: float, height: float) -> MakeHumanConfig:
        config = MakeHumanConfig(
            gender=float(person.sex == "male"),
            age=person.age,
            height=height,
            weight=min(max(fatness, 0.0), 1.0),
            muscle=person.muscle * min(max(1 + fatness, 0.0), max(2 - fatness, 0.0), 1.0),
            race=person.race,
            targets=person.face,
            cup_size=0.5,
            **dict(person.clothes),
        )
        if fatness <= 2:
            return config
        heaviest = {
            name: round((fatness - 2) * strength, 4)
            for name, strength in target_strengths(source, config).items()
            if name.startswith("macrodetails/universal-")
        }
        return config.model_copy(update={"targets": {**person.face, **heaviest}})

    def weight(config: MakeHumanConfig, scale: float) -> float:
        return DENSITY * scale**3 * volume(source.base, read_body(source, target_strengths(source, config)))

    def excess(fatness: float) -> float:
        return weight(shape(fatness, height), scale) / person.weight - 1

    height, bracket = 0.5, _FATNESS
    fatness = 0.5
    for _ in range(3):
        sized = shape(fatness, height).model_copy(update={"stature": person.stature})
        try:
            sized, scale = with_stature(source, sized)
        except MeshError as reason:
            raise MeshError(reason.message, key="height") from None
        before, height = height, sized.height
        fatness = _root(excess, bracket)
        if abs(height - before) < _SETTLED:
            break
        bracket = (max(fatness - _NEAR, _FATNESS[0]), min(fatness + _NEAR, _FATNESS[1]))
    config = shape(fatness, height)
    reached = weight(config, scale)
    if abs(reached / person.weight - 1) > _WEIGHT_TOLERANCE:
        most = f"{'at most' if reached < person.weight else 'at least'} {reached:.1f} kg"
        message = f"{person.weight:g} kg is impossible for {person.stature:g} m: sex and age give {most}"
        raise MeshError(message, key="weight")
    return config.model_copy(update={"stature": person.stature})


#: Range of the fatness, largest relative error of the weight, and the range that later rounds search first.
_FATNESS, _WEIGHT_TOLERANCE, _NEAR = (-1.0, 3.5), 0.002, 0.1
#: A change of the height slider below this changes the weight by less than a thousandth.
_SETTLED = 0.002


def _root(excess: Callable[[float], float], bracket: tuple[float, float]) -> float:
    """Fatness at which a rising excess is zero, to five digits. If it is nowhere zero, the nearest end of the
    range."""
    low, high = bracket
    from scipy.optimize import brentq  # imported here, since the import is slow

    below, above = excess(low), excess(high)
    if below < 0 < above:
        return round(float(brentq(excess, low, high, xtol=1e-5)), 5)
    end = low if below >= 0 else high
    if end in _FATNESS or below * above == 0:
        return end
    return _root(excess, (_FATNESS[0], end) if below > 0 else (end, _FATNESS[1]))


def volume(base: Base, body: Array) -> float:
    """Volume of a naked body (V, 3), cubic metres: the sum of tetrahedra from the origin."""
    faces = base.faces[base.face_groups == "body"]
    a, b, c, d = (body[faces[:, corner]] for corner in range(4))
    return float(np.einsum("ij,ij->", a, np.cross(b, c) + np.cross(c, d))) / 6
