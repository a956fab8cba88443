"""Bodies of fits stay near people, whatever points and masks say."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from photographs.studio import change_views, make_studio

from humansim_ros.errors import HumansimWarning, PhotographError
from humansim_ros.people import keypoint_set, load_human
from humansim_ros.photographs import read_views
from humansim_ros.photographs.fitting import find_doubts, fit_person
from humansim_ros.photographs.pose_fitting import Settings, Sight, fit_poses
from humansim_ros.photographs.pose_model import BodyState, PoseModel
from humansim_ros.photographs.views import read_points, write_points

COCO = keypoint_set("coco17")
FACE = 5  # the first points of COCO


@pytest.fixture(scope="module")
def model() -> PoseModel:
    return PoseModel(load_human("adult_man").without_details(), COCO)


def fitted(model: PoseModel, truth: BodyState, known: slice = slice(None)) -> BodyState:
    """Fit of the places of the known keypoints of a body, from the body at rest."""
    places = np.full((len(COCO), 3), np.nan)
    places[known] = model.keypoints(truth)[known]
    sight = Sight((), np.zeros((0, len(COCO), 2)), np.zeros((0, len(COCO))), places)
    return fit_poses(model, [model.neutral()], [sight], Settings(0.0))[0]


def lengths_of(model: PoseModel, **factors: float) -> np.ndarray:
    """Logarithms (G,) of lengths by name of the group."""
    return np.array([np.log(factors.get(group, 1.0)) for group in model.groups])


def test_a_body_that_no_person_has_is_fitted_by_the_nearest_plausible_one(model: PoseModel) -> None:
    """A tenth of a forearm, at exact places."""
    truth = replace(model.neutral(), lengths=lengths_of(model, elbow=0.1))
    factors = np.exp(fitted(model, truth).lengths)
    assert factors.min() > 0.65 and factors.max() < 1.5


def test_proportions_of_a_child_are_not_beyond_the_limits(model: PoseModel) -> None:
    truth = replace(model.neutral(), stature=np.log(0.7), lengths=lengths_of(model, vt3=1.3, hip=0.85))
    found = model.keypoints(fitted(model, truth))
    np.testing.assert_allclose(found, model.keypoints(truth), atol=0.02)


def test_a_head_without_points_keeps_its_proportion_and_its_direction(model: PoseModel) -> None:
    truth = replace(model.neutral(), stature=np.log(0.8))
    found = fitted(model, truth, slice(FACE, None))
    neck = model.groups.index("vt3")
    assert np.exp(found.lengths[neck]) == pytest.approx(1, abs=0.01)
    assert np.exp(found.stature) == pytest.approx(0.8, abs=0.04)
    assert np.linalg.norm(found.vectors[model.skeleton.bone("vt3")]) < 0.05


def test_points_show_the_bones_between_them_and_the_root(model: PoseModel) -> None:
    turned, lengthened = model.shown(np.arange(len(COCO)) >= FACE)
    hidden = {name for name, shown in zip(model.skeleton.names, turned, strict=True) if not shown}
    assert hidden == {"vt3", "l_wrist", "r_wrist", "l_ankle", "r_ankle"}
    assert {g for g, shown in zip(model.groups, lengthened, strict=True) if not shown} == {
        "vt3",
        "wrist",
        "ankle",
    }


@pytest.mark.nightly
def test_a_stature_that_no_point_shows_and_an_implausible_body_are_told(tmp_path: Path) -> None:
    studio = make_studio(tmp_path, cameras=4, images=False)
    for file in (tmp_path / "points").glob("*.json"):
        (points,) = read_points(file, COCO)
        points[:FACE] = 0
        write_points(file, COCO, [points])
    photos = read_views(studio.path)
    with pytest.warns(HumansimWarning) as said:
        fit = fit_person(photos, silhouettes=False)
    assert any("views.yaml: the stature of" in str(each.message) for each in said)
    assert not any("is a guess" in text for text in find_doubts(fit, photos))  # masks show it
    squat = replace(fit, proportions=replace(fit.proportions, girths={"l_hip": 1.9}))
    (told,) = find_doubts(squat, photos)
    assert told.startswith("the girth of l_hip (1.90) is at the limit for people") and "check points" in told
    (told,) = find_doubts(replace(fit, residuals=fit.residuals + 40), photos)
    assert "pixels or more from the fitted body: check the points" in told
    (told,) = find_doubts(replace(fit, proportions=replace(fit.proportions, stature=1.5)), photos)
    assert "m tall: check the unit of the calibration (key unit)" in told


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_studio(tmp_path_factory.mktemp("views"), cameras=4, images=False).path


@pytest.mark.daily("10.0")
@pytest.mark.parametrize("unit", [0.001, 10.0])
def test_a_calibration_in_another_unit_is_refused_with_its_key(views: Path, unit: float) -> None:
    other = change_views(views, unit=unit)
    with pytest.raises(PhotographError, match=r"a person of .* m: check the unit of the calibration") as said:
        fit_person(read_views(other), silhouettes=False)
    assert said.value.path == str(other) and said.value.key == "unit"


def test_points_at_one_place_are_refused(views: Path, tmp_path: Path) -> None:
    shutil.copytree(views.parent, tmp_path, dirs_exist_ok=True)
    for file in (tmp_path / "points").glob("*.json"):
        write_points(file, COCO, [np.tile([320.0, 240.0, 1.0], (len(COCO), 1))])
    with pytest.raises(PhotographError, match=r"views\.yaml.*unit.*a person of"):
        fit_person(read_views(tmp_path / views.name), silhouettes=False)
