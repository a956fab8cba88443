"""The channel material: skin, eyes, hair, garments and worn things of each pixel."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from render_scenes import along_x, renderer_or_skip
from scipy.ndimage import binary_erosion

from humansim_ros import Camera, Human, load_human
from humansim_ros.errors import MeshError
from humansim_ros.files.mesh.mesh import MATERIAL_LABELS, MATERIALS
from humansim_ros.people.humans.human import human_from_arrays, read_human, write_human
from humansim_ros.people.makehuman.building import build
from humansim_ros.people.makehuman.data import people_data
from humansim_ros.people.makehuman.shape import WORN, MakeHumanConfig, Outfit
from humansim_ros.render import Body, View

CHILD = ROOT / "assets" / "humans" / "child.npz"
FRONT = Camera.look_at((2.6, 0.4, 1.2), (0.0, 0.0, 0.7), (300, 400), 0.7)


def seen(human: Human, camera: Camera = FRONT, channels: tuple[str, ...] = ("material",)) -> View:
    """The human at rest, as a camera in front of it sees it."""
    vertices = human.mesh.vertices[:, [2, 0, 1]].astype(np.float32)
    with renderer_or_skip() as renderer:
        return renderer.render([Body(human.mesh, vertices, human.triangle_parts, 1)], camera, channels)


def test_each_worn_thing_has_a_label() -> None:
    assert set(WORN) <= set(MATERIALS) and len(MATERIAL_LABELS) == len(MATERIALS) < 256


def test_a_pixel_has_the_label_of_its_face_and_skin_becomes_hair_by_texel() -> None:
    mesh = load_human(CHILD).mesh
    view = seen(load_human(CHILD), channels=("material", "face", "uv", "instance"))
    assert mesh.materials is not None and mesh.skin is not None
    np.testing.assert_array_equal(view.material > 0, view.instance > 0)
    there = view.face > 0
    faces = mesh.triangle_faces[view.face[there] - 1]
    of_face, height = mesh.materials[faces], len(mesh.skin)
    u, v = view.uv[there].T
    skin = mesh.skin[((1 - v) * height).astype(int), (u * height).astype(int)]
    expected = np.where((of_face == MATERIAL_LABELS["skin"]) & (skin < 128), MATERIAL_LABELS["hair"], of_face)
    np.testing.assert_array_equal(view.material[there], expected)
    assert {MATERIALS[n - 1] for n in np.unique(expected)} == {
        "skin",
        "eyes",
        "hair",
        "top",
        "bottom",
        "shoes",
    }


#: Colours that are far from each other, also in the shade.
COLORS = {
    "skin": (240, 240, 240),
    "hair": (12, 12, 12),
    "top": (220, 10, 10),
    "bottom": (10, 10, 220),
    "shoes": (10, 200, 10),
    "hijab": (220, 220, 10),
    "backpack": (220, 10, 220),
}


@pytest.mark.slow
@pytest.mark.parametrize("wears", [("backpack",), ("hijab",)], ids=lambda wears: wears[0])
def test_labels_are_those_of_the_paint(wears: tuple[str, ...]) -> None:
    """Each class is painted in its own colour: the colour of a pixel names its label."""
    garments = {"top": "coat", "bottom": "skirt", "shoes": "boots", "beard": "full", "hair": "curly"}
    config = MakeHumanConfig(gender=1.0, wears=wears, **garments)
    plain = {"shirt_fabric": "plain", "trousers_fabric": "plain", "lips": 0.0, "stubble": 0.0}
    colors = {"skin": "skin", "hair": "hair", "shirt": "top", "trousers": "bottom", "shoes": "shoes"}
    of_outfit = {key: COLORS[name] for key, name in colors.items()} | {"soles": COLORS["shoes"]}
    worn = {name: COLORS[name] for name in wears}
    outfit = Outfit(**plain, **of_outfit, worn=worn)
    human = human_from_arrays(build(people_data(), config, {"own": outfit}, fine=False), "someone")
    shown = 0
    for azimuth in (0.0, 2.5):
        eye = (3.2 * np.cos(azimuth), 3.2 * np.sin(azimuth), 1.3)
        view = seen(human, Camera.look_at(eye, (0, 0, 0.9), (480, 640), 0.7), ("rgb", "material"))
        names = list(COLORS)
        unit = np.array([np.array(COLORS[name]) / max(COLORS[name]) for name in names])
        rgb = view.rgb.astype(float)
        brightest = rgb.max(axis=2, keepdims=True)
        hue = rgb / np.maximum(brightest, 1)
        hue = np.where(brightest < 45, -1, hue)  # hair is dark
        unit[names.index("hair")] = -1
        nearest = np.linalg.norm(hue[:, :, None] - unit, axis=3).argmin(axis=2)
        for number, name in enumerate(names):
            label = view.material == MATERIAL_LABELS[name]
            inside = binary_erosion(label, iterations=2)  # edges are blended, and so are seams
            if inside.sum() > 80:
                shown |= 1 << number
                assert (nearest[inside] == number).mean() > 0.93, name
    assert shown & 0b11111 == 0b11111 or wears == ("hijab",)  # which hides the hair


def test_a_human_without_labels_is_unknown_and_an_object_has_none() -> None:
    human = load_human(CHILD)
    bare = replace(human.mesh, materials=None)
    assert set(np.unique(seen(replace(human, mesh=bare)).material)) == {0, MATERIAL_LABELS["unknown"]}
    vertices = human.mesh.vertices[:, [2, 0, 1]].astype(np.float32)
    thing = Body(human.mesh, vertices, human.triangle_parts, 1, "object")
    with renderer_or_skip() as renderer:
        view = renderer.render([thing], FRONT, ("material", "instance"))
    assert view.instance.any() and not view.material.any()


def test_one_in_front_of_another_has_its_own_labels() -> None:
    human = load_human(CHILD)
    near = human.mesh.vertices[:, [2, 0, 1]].astype(np.float32)
    unlabelled = replace(human.mesh, materials=None)
    bodies = [
        Body(human.mesh, near + np.array([1, 0.2, 0], np.float32), human.triangle_parts, 1),
        Body(unlabelled, near + np.array([2, -0.1, 0], np.float32), human.triangle_parts, 2),
    ]
    with renderer_or_skip() as renderer:
        view = renderer.render(bodies, along_x((200, 150), focal=150), ("material", "instance"))
    assert set(np.unique(view.material[view.instance == 2])) == {MATERIAL_LABELS["unknown"]}
    assert view.material[view.instance == 1].min() > MATERIAL_LABELS["unknown"]


def test_labels_are_kept_in_files(tmp_path: Path) -> None:
    human = load_human(CHILD)
    skin = human.mesh.skin
    assert skin is not None
    bearded = replace(human, mesh=replace(human.mesh, hair=255 - skin // 2))
    write_human(tmp_path / "again.npz", bearded)
    again = read_human(tmp_path / "again.npz")
    np.testing.assert_array_equal(again.mesh.materials, human.mesh.materials)
    np.testing.assert_array_equal(again.mesh.hair_texels, 255 - skin // 2)


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("materials", np.ones(7, np.uint8), r"must be \(F,\) uint8, not \(7,\) uint8"),
        ("materials", np.ones(14000, float), r"must be \(F,\) uint8"),
        ("materials", np.zeros(0, np.uint8), r"must be \(F,\) uint8"),
        ("materials", None, "labels are 1 to 20"),
        ("hair", np.ones((4, 4, 3), np.uint8), r"must be \(H, W\) uint8"),
        ("hair", np.ones((0, 4), np.uint8), r"must be \(H, W\) uint8"),
    ],
)
def test_wrong_labels_in_a_file_are_named(
    tmp_path: Path, key: str, value: np.ndarray | None, reason: str
) -> None:
    with np.load(CHILD) as file:
        arrays = dict(file)
    arrays[key] = np.full(len(arrays["faces"]), 99, np.uint8) if value is None else value
    np.savez(tmp_path / "wrong.npz", **arrays)
    with pytest.raises(MeshError, match=rf"wrong\.npz: {key}: {reason}"):
        load_human(tmp_path / "wrong.npz")
