"""Visibility and occluders of joints, on synthetic label images."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import ROOT
from numpy.typing import NDArray

from humansim_ros.cameras import Camera
from humansim_ros.motion.body.skeleton import finger_bones
from humansim_ros.people.humans.human import Human, joint_surfaces
from humansim_ros.people.loading.loading import load_human
from humansim_ros.render import View
from humansim_ros.scene.truth.camera_truth import (
    NOTHING,
    OCCLUDED,
    OUTSIDE,
    PERSON,
    SELF,
    THING,
    VISIBLE,
    JointView,
    view_joints,
)
from humansim_ros.types import Array

#: 8 x 6 pixels, at the origin, looking along world z: a point (x, y, 1) projects to pixel (x, y).
CAMERA = Camera((8, 6), np.eye(3), np.eye(3), np.zeros(3))


def labels(instance: int, part: int, depth: float = 0.9) -> View:
    """A view that shows one instance and part everywhere, at one depth."""
    return View(
        depth=np.full((6, 8), depth, np.float32),
        instance=np.full((6, 8), instance, np.uint16),
        part=np.full((6, 8), part, np.uint8),
    )


def skin_of(*parts: int) -> NDArray[np.bool_]:
    """Table of the part labels that are skin around one joint."""
    table = np.zeros((1, 256), dtype=bool)
    table[0, list(parts)] = True
    return table


def look(pixel: tuple[float, float], view: View, parts: tuple[int, ...] = (5,)) -> JointView:
    """View of a joint of human 3, one metre away."""
    seen = view_joints(CAMERA, np.array([[*pixel, 1.0]]), view, 3, skin_of(*parts))
    kinds = (seen.visible.dtype, seen.occluder.dtype, seen.by.dtype, seen.behind.dtype)
    assert kinds == (np.uint8, np.uint8, np.uint16, np.float32)
    return seen


def see(pixel: tuple[float, float], view: View, parts: tuple[int, ...] = (5,)) -> int:
    return int(look(pixel, view, parts).visible[0])


def test_a_joint_under_its_own_skin_is_visible() -> None:
    assert see((4, 2), labels(3, 5)) == VISIBLE
    assert see((4, 2), labels(3, 6), parts=(5, 6)) == VISIBLE


def test_a_joint_behind_another_human_is_occluded() -> None:
    assert see((4, 2), labels(2, 5)) == OCCLUDED


def test_a_joint_behind_another_part_of_the_same_human_is_occluded() -> None:
    assert see((4, 2), labels(3, 9)) == OCCLUDED


def test_a_joint_behind_the_scene_is_occluded() -> None:
    assert see((4, 2), labels(0, 0)) == OCCLUDED


@pytest.mark.parametrize(
    ("view", "visible", "occluder", "by"),
    [
        (labels(3, 5), VISIBLE, NOTHING, 0),
        (labels(3, 9), OCCLUDED, SELF, 3),
        (labels(2, 5), OCCLUDED, PERSON, 2),
        (labels(0, 0), OCCLUDED, THING, 0),
    ],
    ids=["skin", "self", "person", "thing"],
)
def test_the_occluder_of_a_joint(view: View, visible: int, occluder: int, by: int) -> None:
    seen = look((4, 2), view)
    assert (seen.visible[0], seen.occluder[0], seen.by[0]) == (visible, occluder, by)
    assert seen.behind[0] == pytest.approx(0.1, abs=1e-6)


@pytest.mark.parametrize("instance", [0, 2, 3])
def test_nothing_hides_a_joint_in_front_of_the_first_surface(instance: int) -> None:
    for depth, behind in ((1.25, -0.25), (np.inf, -np.inf)):
        seen = look((4, 2), labels(instance, 9, depth))
        assert (seen.visible[0], seen.occluder[0], seen.by[0]) == (VISIBLE, NOTHING, 0)
        assert seen.behind[0] == behind


@pytest.mark.parametrize("point", [(9.0, 2.0, 1.0), (4.0, 2.0, -1.0), (np.nan, 0.0, 1.0)])
def test_a_joint_outside_has_no_occluder_and_no_depth_difference(point: tuple[float, float, float]) -> None:
    seen = view_joints(CAMERA, np.array([point]), labels(2, 5), 3, skin_of(5))
    assert (seen.visible[0], seen.occluder[0], seen.by[0]) == (OUTSIDE, NOTHING, 0)
    assert np.isnan(seen.behind[0])


@pytest.mark.parametrize(
    ("pixel", "inside"),
    [
        ((-0.49, 3), True),
        ((-0.51, 3), False),
        ((7.49, 3), True),
        ((7.51, 3), False),
        ((3, -0.49), True),
        ((3, -0.51), False),
        ((3, 5.49), True),
        ((3, 5.51), False),
        ((1e12, 3), False),
        ((3, -1e12), False),
    ],
)
def test_the_image_ends_half_a_pixel_beyond_its_outer_centres(
    pixel: tuple[float, float], inside: bool
) -> None:
    assert see(pixel, labels(3, 5)) == (VISIBLE if inside else OUTSIDE)


def test_a_joint_behind_the_camera_is_outside_and_has_no_pixel() -> None:
    seen = view_joints(CAMERA, np.array([[4.0, 2.0, -1.0]]), labels(3, 5), 3, skin_of(5))
    assert seen.visible[0] == OUTSIDE
    assert np.isnan(seen.pixels).all()
    np.testing.assert_array_equal(seen.optical, [[4, 2, -1]])


@pytest.mark.parametrize("column", range(8))
@pytest.mark.parametrize("row", [0, 5])
def test_a_joint_uses_the_pixel_with_the_nearest_centre(column: int, row: int) -> None:
    """Only one pixel of the image shows skin: columns and rows must not be swapped."""
    view = labels(0, 0)
    view.instance[row, column], view.part[row, column] = 3, 5
    for dx, dy in ((0, 0), (0.4, -0.4), (-0.4, 0.4)):
        assert see((column + dx, row + dy), view) == VISIBLE
    for dx in (-0.6, 0.6):
        assert see((column + dx, row), view) in (OCCLUDED, OUTSIDE)


def test_positions_and_pixels_are_those_of_the_camera() -> None:
    camera = Camera.look_at((2, 1, 1.5), (0, 0, 1), (64, 48))
    points: Array = np.random.default_rng(0).normal(size=(20, 3))
    zeros = [np.zeros((48, 64), kind) for kind in (np.float32, np.uint16, np.uint8)]
    view = View(**dict(zip(("depth", "instance", "part"), zeros, strict=True)))
    seen = view_joints(camera, points, view, 1, np.zeros((20, 256), dtype=bool))
    np.testing.assert_allclose(seen.optical, points @ camera.R.T + camera.t, atol=1e-12)
    np.testing.assert_array_equal(seen.pixels, camera.project(points)[0])


# Parts that are skin around a joint


@pytest.fixture(scope="module")
def man() -> Human:
    return load_human(ROOT / "assets" / "humans" / "adult_man.npz")


def around(man: Human, joint: str) -> set[str]:
    row = joint_surfaces(man)[man.skeleton.joint_names.index(joint)]
    return {man.skeleton.names[label - 1] for label in np.flatnonzero(row)}


def test_the_skin_of_a_joint_belongs_to_the_bones_that_meet_there(man: Human) -> None:
    assert around(man, "l_knee") == {"l_hip", "l_knee"}
    assert around(man, "r_elbow") == {"r_shoulder", "r_elbow"}
    assert around(man, "l_wrist_end") == {"l_wrist", *finger_bones("l")}
    assert around(man, "vt3_end") == {"vt3", "temporomandibular", "l_eyeball_joint", "r_eyeball_joint"}
    assert around(man, "r_index2") == {"r_index1", "r_index2"}
    assert around(man, "r_index3_end") == {"r_index3"}
    assert around(man, "l_thumb1") == {"l_wrist", "l_thumb1"}
    assert around(man, "l_eyeball_joint") == {"vt3", "l_eyeball_joint"}
    assert around(man, "l_ankle") == {"l_knee", "l_ankle", "l_metatarsal"}


def test_the_background_is_skin_of_no_joint(man: Human) -> None:
    assert not joint_surfaces(man)[:, 0].any()


def test_every_joint_has_skin_with_triangles(man: Human) -> None:
    with_triangles = np.zeros(256, dtype=bool)
    with_triangles[np.unique(man.triangle_parts)] = True
    bare = [
        name
        for name, row in zip(man.skeleton.joint_names, joint_surfaces(man), strict=True)
        if not (row & with_triangles).any()
    ]
    assert bare == []


def test_the_skin_nearest_to_a_limb_joint_is_in_its_table(man: Human) -> None:
    table = joint_surfaces(man)
    centres = man.mesh.vertices[man.mesh.triangles].mean(1)
    for side in "lr":
        for part in ("knee", "ankle", "elbow", "wrist", "hip", "shoulder"):
            joint = man.skeleton.joint_names.index(f"{side}_{part}")
            position = man.skeleton.heads[man.skeleton.bone(f"{side}_{part}")]
            nearest = np.argsort(np.linalg.norm(centres - position, axis=1))[:20]
            assert table[joint, man.triangle_parts[nearest]].mean() > 0.9, (side, part)
