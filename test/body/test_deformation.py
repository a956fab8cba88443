"""Measurements of deformation (tools/figures/deformation_figures.py) for known cases."""

from __future__ import annotations

import importlib.util
import sys
from functools import cache

import numpy as np
import pytest
import trimesh
from conftest import ROOT

from humansim_ros.motion.body.skinning import skin
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human

_SPEC = importlib.util.spec_from_file_location(
    "deformation", ROOT / "tools" / "figures" / "deformation_figures.py"
)
assert _SPEC is not None and _SPEC.loader is not None
figures = importlib.util.module_from_spec(_SPEC)
sys.modules["deformation"] = figures
_SPEC.loader.exec_module(figures)


PEOPLE = ("adult_man", "adult_woman", "child", "slim_old_woman", "tall_heavy_man")


@cache
def man() -> Human:
    return load_human(ROOT / "assets" / "humans" / "adult_man.npz")


@pytest.mark.parametrize("bone", ["l_elbow", "l_knee"])
def test_the_region_of_a_joint_is_closed_and_has_a_volume(bone: str) -> None:
    vertices, region = man().mesh.vertices, figures.joint_region(man(), bone)
    solid = trimesh.Trimesh(vertices, region, process=False)
    assert solid.is_watertight
    assert figures.volume(vertices, region) == pytest.approx(solid.volume, rel=1e-9)
    head = man().skeleton.heads[man().skeleton.bone(bone)]
    assert solid.contains([head]).all()


def test_dual_quaternions_lose_less_volume_than_linear_blending() -> None:
    for bend in figures.BENDS.values():
        linear, dual = (figures.volume_change(man(), *bend, method) for method in figures.SKINNERS)
        assert linear < dual < 0.05


def test_a_bent_elbow_brings_the_hand_forward_and_a_bent_knee_the_foot_back() -> None:
    skeleton = man().skeleton
    for bend, bone, ahead in (("elbow 90", "l_wrist", 1), ("knee 90", "l_ankle", -1)):
        transform = figures.bent(man(), *figures.BENDS[bend])[skeleton.bone(bone)]
        moved = transform[:3, :3] @ skeleton.heads[skeleton.bone(bone)] + transform[:3, 3]
        joint = skeleton.heads[skeleton.parents[skeleton.bone(bone)]]
        assert ahead * (moved - joint)[2] > 0.9 * np.linalg.norm(moved - joint)


def test_the_rest_pose_has_no_flips_and_a_mirrored_body_has_only_flips() -> None:
    still = np.tile(np.eye(4), (1, len(man().skeleton), 1, 1))
    whole = figures.deformation(man(), still, "linear")
    assert whole.flipped == 0
    np.testing.assert_allclose(whole.stretch, 1, rtol=1e-5)
    mirrored = figures.deformation(man(), np.diag([-3.0, 3, 3, 1]) @ still, "linear")
    assert mirrored.flipped == 1
    np.testing.assert_allclose(mirrored.stretch, 3, rtol=1e-5)


def test_a_stretched_edge_is_found() -> None:
    apart = np.tile(np.eye(4), (1, len(man().skeleton), 1, 1))
    apart[:, man().skeleton.bone("l_elbow") :, 0, 3] = 0.3
    found = figures.deformation(man(), apart, "linear")
    vertices = skin(man().mesh.vertices, man().weights, apart[0])
    worst = found.stretch[0].argmax()
    a, b = vertices[found.edges[worst]]
    assert np.linalg.norm(a - b) / found.lengths[worst] == pytest.approx(found.stretch[0, worst], rel=1e-3)
    assert found.stretch[0, worst] > 4


@pytest.mark.daily("adult_woman-*")
@pytest.mark.slow
@pytest.mark.parametrize("method", ["linear", "dual_quaternion"])
@pytest.mark.parametrize("name", PEOPLE)
def test_sitting_down_does_not_tear_or_fold_the_mesh(name: str, method: str) -> None:
    human = load_human(ROOT / "assets" / "humans" / f"{name}.npz")
    motion = ROOT / "assets" / "motions" / "sit_stand.bvh"
    found = figures.deformation(human, figures.motion_transforms(human, motion, 3.0), method)
    assert found.stretch.max() < 4
    assert np.max(found.flipped) < 0.01
