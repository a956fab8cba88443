"""Hair, garments and things worn: closed surfaces on every body, plausible shares, clear errors."""

from __future__ import annotations

from collections import Counter
from functools import cache
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

from humansim_ros import load_human
from humansim_ros.errors import HumansimError, MeshError
from humansim_ros.files.yaml.schema import validated
from humansim_ros.people import Human
from humansim_ros.people.makehuman.clothes import BodyRegions
from humansim_ros.people.makehuman.population import draw_person
from humansim_ros.people.makehuman.shape import (
    BOTTOMS,
    FOOTWEAR,
    HAIR,
    TOPS,
    WORN,
    Dress,
    MakeHumanConfig,
    Outfit,
    check_clothes,
)
from humansim_ros.people.makehuman.skeleton import Bones
from humansim_ros.people.makehuman.surface import BodySurface
from humansim_ros.people.makehuman.things import worn_parts
from humansim_ros.people.makehuman.worn import Wearer, WornPart, add_parts, strip_image


@cache
def child() -> Human:
    return load_human(ROOT / "assets" / "humans" / "child.npz")


def wearer(config: MakeHumanConfig) -> Wearer:
    """The built-in child, as a body to be dressed; it needs no data of MakeHuman."""
    human = child()
    skeleton, points = human.skeleton, human.mesh.vertices
    bones = Bones(
        tuple(skeleton.names),
        np.array(skeleton.parents),
        skeleton.heads,
        skeleton.tails,
        np.zeros((len(skeleton), 3)),
    )
    weights = human.weights.toarray()
    part = np.zeros(len(points), np.int64)
    for number, side in ((1, "l"), (2, "r")):
        part[weights[:, bones.index(f"{side}_eyeball_joint")] > 0.99] = number
    eye = points[part == 1]
    middle = (eye.min(axis=0) + eye.max(axis=0)) / 2
    near = np.abs(points[:, 1] - middle[1]) < 0.045
    is_ear = (near & (np.abs(points[:, 0]) > np.abs(points[near, 0]).max() - 0.014)).astype(float)
    ear = points[(is_ear > 0) & (points[:, 0] > 0)].mean(axis=0)
    radius = float(np.ptp(eye, axis=0).max() / 2)
    regions = BodyRegions(bones, middle, radius, ear, float(points[:, 1].max()), Dress.of(config))
    faces = np.where(human.mesh.faces < 0, human.mesh.faces[:, [2]], human.mesh.faces).astype(np.int64)
    none = np.zeros(len(points), np.int64)
    mesh = BodySurface(
        points,
        faces,
        np.zeros((len(points), 2)),
        faces,
        weights,
        points,
        points,
        part,
        none,
        np.zeros(len(faces), np.int64),
        np.arange(len(points)),
        np.zeros((len(points), 0)),
    )
    return Wearer(mesh, points, weights, is_ear, regions, regions)


def assert_closed(part: WornPart) -> None:
    """Each side of a face is a side of one other face, in the other direction; faces look outwards."""
    faces = part.mesh[0]
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    sides = Counter(map(tuple, ends[ends[:, 0] != ends[:, 1]].tolist()))
    assert all(count == 1 and sides[b, a] == 1 for (a, b), count in sides.items())
    a, b, c, d = (part.vertices[faces[:, corner]] for corner in range(4))
    assert np.einsum("ij,ij->", a, np.cross(b, c) + np.cross(c, d)) > 0


#: Together, all styles, garments and things with surfaces of their own.
WORN_TOGETHER: tuple[dict[str, Any], ...] = (
    {"hair": "side_part", "top": "hoodie", "wears": ("glasses", "backpack"), "shoes": "sandals"},
    {"hair": "fringe", "top": "jacket", "wears": ("sunglasses", "mask", "bag")},
    {"hair": "curly", "top": "suit", "wears": ("cap",)},
    {"hair": "afro", "top": "coat", "wears": ("beanie",)},
    {"hair": "mohawk", "top": "dress", "bottom": "none"},
    {"hair": "shoulder", "bottom": "skirt", "wears": ("hard_hat",)},
    {"hair": "straight", "bottom": "long_skirt", "wears": ("sun_hat",)},
    {"hair": "tail", "wears": ("turban",)},
    {"hair": "bun", "top": "hi_vis", "wears": ("hijab",)},
    {"hair": "top_knot"},
    {"hair": "plaits"},
    {"hair": "pigtails"},
)


@pytest.mark.daily("side_part-*", "afro-*", "shoulder-*", "bun-*", "plaits")
@pytest.mark.parametrize("names", WORN_TOGETHER, ids=lambda names: "-".join(map(str, names.values())))
def test_all_parts_are_closed_near_the_body_and_bound_to_four_bones(names: dict[str, Any]) -> None:
    config = MakeHumanConfig(**names)
    body = wearer(config)
    parts = worn_parts(config, body)
    assert parts or HAIR[config.hair].base == "none" or "turban" in config.wears
    for part in parts:
        assert_closed(part)
        assert np.isfinite(part.vertices).all()
        distance = np.linalg.norm(part.vertices - body.points[body.nearest(part.vertices)], axis=1)
        assert distance.max() < 0.25
        weights = part.vertex_weights
        np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-9)
        assert (weights > 0).sum(axis=1).max() <= 4
    strip = strip_image(parts, config, Outfit())
    empty = {"vertices": body.points, "faces": body.mesh.faces, "uv_faces": body.mesh.faces}
    arrays = add_parts({**empty, "uv": body.mesh.uv, "weights": body.weights}, parts, 1024)
    added = arrays["uv"][len(body.mesh.uv) :]
    assert added.min() >= 0 and added[:, 1].max() <= len(strip) / (1024 + len(strip))
    assert len(arrays["vertices"]) == len(body.points) + sum(len(part.vertices) for part in parts)


def test_the_lists_are_as_long_as_a_street_needs() -> None:
    head_wear = [name for name, row in WORN.items() if row.place == "head"]
    assert len(HAIR) >= 14 and {"bald", "afro", "curly", "tail"} <= set(HAIR)
    assert {"hijab", "turban", "cap", "hard_hat"} <= set(head_wear)
    assert len(TOPS) >= 9 and len(BOTTOMS) >= 7 and set(FOOTWEAR) == {"shoes", "boots", "sandals", "bare"}


def test_drawn_clothes_fit_and_are_plausible() -> None:
    people = [draw_person(5, number) for number in range(1500)]
    assert all(check_clothes(person.clothes) is None for person in people)
    worn = [(person, name) for person in people for name in person.clothes.wears]
    assert all(person.sex == "female" for person, name in worn if name == "hijab")
    assert all(person.clothes.top == "hi_vis" for person, name in worn if name == "hard_hat")
    bearded = [person for person in people if person.clothes.beard != "none"]
    assert bearded and all(person.sex == "male" and person.age >= 18 for person in bearded)
    for key, most in (("hair", 17), ("top", 9), ("bottom", 7), ("shoes", 4)):
        assert len({getattr(person.clothes, key) for person in people}) == most, key
    glasses = [
        np.mean(["glasses" in p.clothes.wears for p in people if low <= p.age < low + 30]) for low in (2, 60)
    ]
    assert glasses[1] > glasses[0] + 0.15
    assert draw_person(5, 3) == people[3]


def test_a_wish_changes_nothing_else() -> None:
    drawn, wished = draw_person(5, 3), draw_person(5, 3, clothes={"hair": "bald"})
    assert wished.clothes.hair == "bald"
    assert (drawn.face, drawn.outfit, drawn.clothes.wears) == (
        wished.face,
        wished.outfit,
        wished.clothes.wears,
    )


@pytest.mark.parametrize(
    ("wishes", "message"),
    [
        ({"hair": "bum"}, "hair: no choice 'bum'; did you mean 'bun'"),
        ({"wears": ("helmet",)}, "wears: no choice 'helmet'.*there are glasses, sunglasses"),
        ({"wears": ("cap", "hijab")}, r"wears: cap and hijab are worn at the same place \(head\)"),
        ({"top": "dress", "bottom": "shorts"}, "bottom: shorts does not fit the top dress; none, tights"),
    ],
)
def test_what_nobody_wears(wishes: dict[str, Any], message: str) -> None:
    with pytest.raises(MeshError, match=message):
        draw_person(1, clothes=wishes)


def test_a_description_with_garments_that_do_not_fit_names_those_that_do() -> None:
    with pytest.raises(
        HumansimError, match="shorts does not fit the top dress; none, tights, leggings fit it"
    ):
        validated(MakeHumanConfig, {"top": "dress", "bottom": "shorts"}, MeshError, None, None)
