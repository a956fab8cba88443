"""Proportions of a person, and files of fits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from humansim_ros.errors import MeshError, PhotographError
from humansim_ros.geometry import matrix_to_quaternion, rotation_vector_to_matrix, transform
from humansim_ros.people import Human, load_human
from humansim_ros.photographs.person_fit import (
    MOST_CONTROLS,
    PersonFit,
    Proportions,
    read_fit,
    shaped_human,
    surface_offsets,
    with_proportions,
    write_fit,
)

LEGS = {"l_knee": 1.2, "r_knee": 1.2}


@pytest.fixture(scope="module")
def man() -> Human:
    return load_human("adult_man").without_details()


def test_equal_proportions_change_nothing(man: Human) -> None:
    same = with_proportions(man, Proportions())
    np.testing.assert_allclose(same.mesh.vertices, man.mesh.vertices, atol=1e-12)
    np.testing.assert_allclose(same.skeleton.tails, man.skeleton.tails, atol=1e-12)


def test_stature_scales_the_whole_body(man: Human) -> None:
    tall = with_proportions(man, Proportions(stature=1.1))
    np.testing.assert_allclose(tall.skeleton.lengths, 1.1 * man.skeleton.lengths)
    np.testing.assert_allclose(np.ptp(tall.mesh.vertices, axis=0), 1.1 * np.ptp(man.mesh.vertices, axis=0))
    assert tall.mesh.vertices[:, 1].min() == pytest.approx(man.mesh.vertices[:, 1].min())


def test_a_longer_shin_lifts_the_body_and_keeps_the_foot(man: Human) -> None:
    changed = with_proportions(man, Proportions(lengths=LEGS))
    knee, hip = man.skeleton.bone("l_knee"), man.skeleton.bone("l_hip")
    assert changed.skeleton.lengths[knee] == pytest.approx(1.2 * man.skeleton.lengths[knee])
    assert changed.skeleton.lengths[hip] == pytest.approx(man.skeleton.lengths[hip])
    grown = np.ptp(changed.mesh.vertices[:, 1]) - np.ptp(man.mesh.vertices[:, 1])
    assert grown == pytest.approx(0.2 * man.skeleton.lengths[knee], rel=0.1)
    # the foot is moved, not stretched
    foot = man.weights[:, man.skeleton.bone("l_ankle")].toarray().ravel() > 0.999
    shape = [human.mesh.vertices[foot] - human.mesh.vertices[foot][0] for human in (man, changed)]
    np.testing.assert_allclose(*shape, atol=1e-3)


def test_girth_thickens_and_does_not_lengthen(man: Human) -> None:
    changed = with_proportions(man, Proportions(girths={"l_hip": 1.3}))
    np.testing.assert_allclose(changed.skeleton.lengths, man.skeleton.lengths)
    bone = man.skeleton.bone("l_hip")
    own = man.weights[:, bone].toarray().ravel() > 0.999
    axis = np.linalg.inv(man.skeleton.rest[bone])

    def radii(human: Human) -> Any:
        local = human.mesh.vertices[own] - human.skeleton.heads[bone]
        return np.linalg.norm((local @ axis[:3, :3].T)[:, [0, 2]], axis=1)

    np.testing.assert_allclose(radii(changed), 1.3 * radii(man), rtol=1e-6)


@pytest.mark.parametrize(
    ("proportions", "said"),
    [
        (Proportions(lengths={"tail": 1.0}), "no bone 'tail'"),
        (Proportions(stature=0.0), "not between"),
        (Proportions(girths={"l_hip": float("nan")}), "not between"),
    ],
)
def test_impossible_proportions_are_refused(man: Human, proportions: Proportions, said: str) -> None:
    with pytest.raises(MeshError, match=said):
        with_proportions(man, proportions)


def some_fit(man: Human, frames: int = 2) -> PersonFit:
    rng = np.random.default_rng(0)
    vectors = rng.normal(0, 0.3, (frames, len(man.skeleton), 3))
    vectors[:, 0] = 0
    residuals = rng.uniform(0, 5, (frames, 2, 17)).round(3)
    residuals[0, 0, 3] = np.nan
    outliers = residuals > 4
    swapped = np.zeros((frames, 2), bool)
    swapped[-1, 1] = True
    return PersonFit(
        "adult_man",
        Proportions(1.05, {"l_hip": 1.1}, {"vl5": 0.9}, offsets=(-0.00345, *[0.0] * (MOST_CONTROLS - 1))),
        man.skeleton.names,
        transform(rotation_vector_to_matrix(rng.normal(size=(frames, 3))), rng.normal(size=(frames, 3))),
        matrix_to_quaternion(rotation_vector_to_matrix(vectors)),
        33_333_333,
        "coco17",
        ("left", "right"),
        residuals,
        outliers,
        swapped,
    )


@pytest.mark.nightly
def test_a_fit_is_written_and_read_back(man: Human, tmp_path: Path) -> None:
    fit = some_fit(man)
    write_fit(tmp_path / "fit.yaml", fit)
    again = read_fit(tmp_path / "fit.yaml")
    for name in ("human", "proportions", "bones", "period", "keypoints", "views"):
        assert getattr(again, name) == getattr(fit, name), name
    for name in ("residuals", "outliers", "swapped"):
        np.testing.assert_array_equal(getattr(again, name), getattr(fit, name))
    for frame in range(2):
        np.testing.assert_allclose(again.joints(frame), fit.joints(frame), atol=2e-6)
        np.testing.assert_allclose(again.vertices(frame), fit.vertices(frame), atol=5e-6)
    text = (tmp_path / "fit.yaml").read_text()
    assert "secret" not in text and len(text.splitlines()) < 200


@pytest.mark.daily("changes6-frames", "changes4-frames")
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"human": None}, "human"),
        ({"keypoints": "coco18"}, "no keypoint set"),
        ({"bones": ["a", "a"]}, "a bone is repeated"),
        ({"bones": ["vl5"]}, r"frames.0.bones: '\w+' is not one of vl5"),
        ({"frames": []}, "frames"),
        ({"frames": [{"position": [0, 0, 0], "rotation": [0, 0, 0, 2]}]}, r"frames.0.rotation: .*length 1"),
        ({"frames": [{"position": [0, 0], "rotation": [0, 0, 0, 1]}]}, r"frames"),
        ({"views": ["right"]}, r"'left' is not one of right"),
        ({"proportions": {"stature": 0}}, r"stature"),
        ({"poportions": {}}, r"did you mean|proportions"),
    ],
)
def test_wrong_fits_are_refused(man: Human, tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    path = tmp_path / "fit.yaml"
    write_fit(path, some_fit(man))
    content = {**yaml.safe_load(path.read_text()), **changes}
    path.write_text(yaml.safe_dump({key: value for key, value in content.items() if value is not None}))
    with pytest.raises(PhotographError, match=said) as caught:
        read_fit(path)
    assert caught.value.path == str(path)


def test_something_else_is_no_fit(tmp_path: Path) -> None:
    (tmp_path / "fit.yaml").write_text("- 1\n")
    with pytest.raises(PhotographError, match="a fit is a mapping"):
        read_fit(tmp_path / "fit.yaml")


@pytest.mark.nightly
def test_an_offset_moves_the_surface_out_near_its_control_alone(man: Human) -> None:
    field = surface_offsets("adult_man")
    vertices = man.mesh.vertices
    own = vertices[field.controls]
    front = field.controls[np.argmax(own[:, 2] * (abs(own[:, 1] - 1.1) < 0.1) * (abs(own[:, 0]) < 0.1))]
    offsets = np.where(field.controls == front, 0.01, 0.0)
    moves = shaped_human("adult_man", Proportions(offsets=tuple(offsets))).mesh.vertices - vertices
    lengths = np.linalg.norm(moves, axis=1)
    assert moves[front, 2] > 0.006
    assert lengths[front] == pytest.approx(0.01, rel=0.1) and lengths.max() < 0.015
    far = np.linalg.norm(vertices - vertices[front], axis=1) > 0.3
    assert lengths[far].max() < 1e-4
    assert lengths[vertices[:, 2] < vertices[front, 2] - 0.15].max() < 1e-3, "the back stays"


def test_offsets_of_another_human_are_refused() -> None:
    with pytest.raises(MeshError, match=r"2 offsets of the surface do not fit .*controls"):
        shaped_human("adult_man", Proportions(offsets=(0.01, 0.01)))


@pytest.mark.parametrize("offset", [".nan", "0.5", "[1]"])
def test_an_impossible_offset_of_a_file_is_refused_with_its_key(
    man: Human, tmp_path: Path, offset: str
) -> None:
    path = tmp_path / "fit.yaml"
    write_fit(path, some_fit(man))
    path.write_text(path.read_text().replace("-0.00345", offset))
    with pytest.raises(PhotographError, match=r"fit\.yaml.*offsets"):
        read_fit(path)
