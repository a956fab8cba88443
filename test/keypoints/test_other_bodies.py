"""Keypoints on bodies of other programs: carried over from a built-in human, and said to be less certain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import figures
import numpy as np
import pytest
from conftest import if_shared
from mesh_files import mesh_path

from humansim_ros import Human, load_human
from humansim_ros.people import KeypointLocator, keypoint_set
from humansim_ros.people.keypoints.locator import place_on_skin, skin_points
from humansim_ros.types import Array

NAMES = tuple(skin_points())
SETS = ("mediapipe33", "plug_in_gait")


def place(human: Human, corners: Array, weights: Array) -> Array:
    """Points (N, 3) on the skin at rest."""
    return np.asarray(np.einsum("nk,nkj->nj", weights, human.mesh.vertices[corners]))


@pytest.mark.parametrize("body", ["child", "slim_old_woman"])
def test_points_are_carried_over_to_within_centimetres(body: str) -> None:
    """The truth is a built-in human; without its source, nothing says that its layout is known."""
    human = load_human(body)
    exact, found = place_on_skin(human, NAMES), place_on_skin(replace(human, notes={}), NAMES)
    assert exact.certain.all()
    assert not found.certain.any()
    error = np.linalg.norm(
        place(human, exact.corners, exact.weights) - place(human, found.corners, found.weights), axis=1
    )
    assert np.median(error) < 0.015
    assert error.max() < 0.045
    face = [number for number, name in enumerate(NAMES) if "eye" in name or name == "nose"]
    assert error[face].max() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize(("name", "body"), [("own_male_T_dm.obj", "adult_man")])
def test_points_are_carried_over_to_bodies_with_a_fitted_skeleton(name: str, body: str) -> None:
    """The file has the vertices of the built-in human in their order."""
    truth, human = place_on_skin(load_human(body), NAMES), load_human(mesh_path(name))
    found = place_on_skin(human, NAMES)
    error = np.linalg.norm(
        place(human, truth.corners, truth.weights) - place(human, found.corners, found.weights), axis=1
    )
    assert np.median(error) < 0.02
    assert error.max() < 0.08


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", if_shared("human_male_T_uv_m.obj"))
def test_bare_makehuman_bodies_have_exact_points_but_for_the_eyes(name: str) -> None:
    human = load_human(mesh_path(name))
    found = place_on_skin(human, NAMES)
    assert {key for key, sure in zip(NAMES, found.certain, strict=True) if not sure} == {
        "left_eye",
        "right_eye",
    }
    at = dict(zip(NAMES, place(human, found.corners, found.weights), strict=True))
    face = human.mesh.vertices[np.abs(human.mesh.vertices[:, 1] - at["nose"][1]) < 0.02]
    assert at["nose"][2] == pytest.approx(face[:, 2].max(), abs=0.005)
    assert at["head_top"][1] == pytest.approx(human.mesh.vertices[:, 1].max(), abs=0.005)
    for left, right in ((key, key.replace("left", "right")) for key in NAMES if key.startswith("left_")):
        np.testing.assert_allclose(at[left] * [-1, 1, 1], at[right], atol=0.01, err_msg=left)


@pytest.mark.parametrize("kind", ["glTF", "SMPL"])
@pytest.mark.parametrize("name", SETS)
def test_every_skinned_figure_has_keypoints_on_the_right_side_and_in_order(
    kind: str, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HUMANSIM_CACHE", "off")
    if kind == "SMPL":
        path = tmp_path / "model.npz"
        np.savez(path, **figures.smpl(figures.SMPL_NAMES, figures.SMPL_PARENTS))
    else:
        path = tmp_path / "person.glb"
        path.write_bytes(figures.glb(*figures.gltf()))
    human, keypoints = load_human(path), keypoint_set(name)
    locator = KeypointLocator.of(human, keypoints)
    joints = human.skeleton.joint_transforms(human.skeleton.rest)[:, :3, 3]
    at = dict(zip(keypoints.points, locator.positions(joints, human.mesh.vertices), strict=True))
    assert (locator.certain == ~locator.on_surface).all()
    for point, position in at.items():
        side = 1 if point.startswith(("left_", "l_")) else -1 if point.startswith(("right_", "r_")) else 0
        # the head is a box, whose inner corners of the eyes nearly meet
        assert side * position[0] > -0.007, point
    ladder = {
        "mediapipe33": "left_heel l_knee l_hip l_shoulder nose",
        "plug_in_gait": "left_ankle_lateral left_knee_lateral left_asis xiphoid left_head_front",
    }[name].split()
    heights = [float(at[point][1]) for point in ladder]
    assert heights == sorted(heights), dict(zip(ladder, heights, strict=True))
