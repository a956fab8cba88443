"""Suites of the challenge: the one of the package, those of users, and mistakes in them."""

from __future__ import annotations

from pathlib import Path

import pytest
from challenge_support import SUITE, small_suite

from humansim_ros.errors import ChallengeError
from humansim_ros.ros.challenge.suite import load_suite, overlaid
from humansim_ros.scene.config.camera_config import FaultsConfig

DIFFICULTIES = """people occluders crossing look_alike fast unusual cameras resolution blur noise low_light
    lens"""


def test_the_standard_suite_has_every_difficulty_and_every_fault_at_three_strengths() -> None:
    suite = load_suite()
    assert set(DIFFICULTIES.split()) <= set(suite.axes)
    assert {name for name in FaultsConfig.model_fields if name != "seed"} <= set(suite.axes)
    assert len(suite.cases) == 1 + 3 * len(suite.axes)
    assert [len(axis.strengths) for axis in suite.axes.values()] == [3] * len(suite.axes)
    people = {len(case.scene.humans) for case in suite.cases}
    assert max(people) == 6


def test_each_case_of_the_standard_suite_differs_from_the_baseline_and_from_the_others() -> None:
    scenes = [case.scene.model_dump_json() for case in load_suite().cases]
    assert len(set(scenes)) == len(scenes)


def test_a_fault_axis_sets_its_own_fault() -> None:
    for case in load_suite().cases:
        faults = [each.faults for each in case.scene.cameras.values() if each.faults is not None]
        if case.axis in FaultsConfig.model_fields:
            assert any(getattr(each, case.axis) is not None for each in faults), case.name


def test_quick_has_fewer_cases_and_frames() -> None:
    full, quick = load_suite(), load_suite(quick=True)
    assert len(quick.cases) < len(full.cases) / 2
    assert quick.cases[0].frames < full.cases[0].frames


def test_only_chooses_axes_and_keeps_the_baseline(tmp_path: Path) -> None:
    assert {case.axis for case in load_suite(only=["noise"]).cases} == {"baseline", "noise"}
    with pytest.raises(
        ChallengeError, match=r"--only: the suite .* has no axis 'nois'; did you mean 'noise'"
    ):
        load_suite(only=["nois"])


def test_overlays_merge_remove_and_reach_all_names() -> None:
    scene = {"room": {"seed": 1}, "cameras": {"a": {"size": [1, 2], "fov_deg": 60}, "b": {}}}
    overlay = {"room": None, "cameras": {"b": None, "c": {"fov_deg": 5}, "*": {"size": [3, 4]}}}
    assert overlaid(scene, overlay) == {
        "room": None,
        "cameras": {"a": {"size": [3, 4], "fov_deg": 60}, "c": {"fov_deg": 5, "size": [3, 4]}},
    }
    assert scene["cameras"] == {"a": {"size": [1, 2], "fov_deg": 60}, "b": {}}


def test_a_suite_extends_another_one(tmp_path: Path) -> None:
    own = """
extends: standard
name: mine
version: "1"
scene: {rate: 10}
axes:
  noise: null
  jpeg:
    title: Compression
    strengths:
      - {label: "50", scene: {cameras: {"*": {sensor: {jpeg: 50}}}}}
      - {label: "20", scene: {cameras: {"*": {sensor: {jpeg: 20}}}}}
      - {label: "5", scene: {cameras: {"*": {sensor: {jpeg: 5}}}}}
"""
    suite = small_suite(tmp_path, own)
    assert (suite.name, "jpeg" in suite.axes, "noise" in suite.axes) == ("mine", True, False)
    assert {case.scene.rate for case in suite.cases} == {10}
    # a file that the inherited suite names is found
    lying = next(case for case in suite.cases if case.name == "unusual_3")
    keyframes = lying.scene.humans["ben"].keyframes
    assert keyframes is not None and Path(keyframes.file).is_file()


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('version: "1"\n', "", "version.*missing"),
        ("title: Small images", "titel: Small images", "suite.yaml:13: axes.size.title: this key is missing"),
        ("size: [32, 24]", "sizes: [32, 24]", "suite.yaml:18: axes.size.strengths.0.scene.*sizes"),
        ("  size:\n    title", "  Größe:\n    title", "suite.yaml:13.*lower-case"),
        ('      - {label: tiny, scene: {cameras: {"*": {size: [8, 6]}}}}\n', "", "strengths"),
        ("name: small", "name: [small", "not valid YAML"),
        ("name: small", "extends: suite.yaml\nname: small", "extend each other in a circle"),
        ("name: small", "extends: none.yaml\nname: small", "none.yaml.*no such suite file"),
    ],
)
def test_a_broken_suite_names_the_place(tmp_path: Path, old: str, new: str, reason: str) -> None:
    assert old in SUITE
    with pytest.raises(ChallengeError, match=reason):
        small_suite(tmp_path, SUITE.replace(old, new))


@pytest.mark.parametrize("text", ["[1, 2]", "extends: {}", "extends: standard\naxes: 5", "scene: 3"])
def test_a_suite_of_another_shape_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(ChallengeError):
        small_suite(tmp_path, text)
