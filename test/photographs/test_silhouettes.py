"""Refinement of a fitted person by masks: outlines meet, joints come nearer, bad masks are named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from conftest import SHARED_DATA, if_shared
from numpy.typing import NDArray
from photographs.studio import Studio, make_studio
from scipy.spatial import cKDTree

from humansim_ros.errors import HumansimWarning, PhotographError
from humansim_ros.people import keypoint_set, load_human
from humansim_ros.photographs import PhotoSet, read_views
from humansim_ros.photographs.fitting import fit_person
from humansim_ros.photographs.person_fit import PersonFit, shaped_human, with_proportions
from humansim_ros.photographs.pose_fitting import fitted_states
from humansim_ros.photographs.pose_model import Attachments, PoseModel
from humansim_ros.photographs.silhouettes import (
    MaskOutline,
    fit_silhouettes,
    intersection_over_union,
    own_parts,
    render_faces,
    silhouette_iou,
)


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Studio:
    folder = tmp_path_factory.mktemp("shelf")
    return make_studio(folder, cameras="shelf", noise=2.0, outliers=0.1, images=False)


@pytest.fixture(scope="module")
def photos(shelf: Studio) -> PhotoSet:
    return read_views(shelf.path)


@pytest.fixture(scope="module")
def rough(photos: PhotoSet) -> PersonFit:
    """Fitted to the keypoints only."""
    return fit_person(photos, silhouettes=False)


@pytest.fixture(scope="module")
def fine(rough: PersonFit, photos: PhotoSet) -> PersonFit:
    return fit_silhouettes(rough, photos)


def joint_errors(fit: PersonFit, studio: Studio) -> NDArray[np.float64]:
    """Millimetres."""
    return np.linalg.norm(fit.joints(0) - studio.body_joints[0], axis=1) * 1000


def mean_iou(fit: PersonFit, photos: PhotoSet) -> float:
    return float(np.mean(list(silhouette_iou(fit, photos).values())))


@pytest.mark.nightly
@pytest.mark.slow
def test_the_rendered_body_covers_the_silhouettes(
    rough: PersonFit, fine: PersonFit, photos: PhotoSet
) -> None:
    """Another body than the one that is fitted, in another pose, through the Shelf cameras."""
    before, after = (silhouette_iou(fit, photos) for fit in (rough, fine))
    assert list(after) == list(photos.names)
    assert np.mean(list(after.values())) > 0.94 > np.mean(list(before.values()))
    assert min(after.values()) > 0.93
    assert all(after[view] > before[view] for view in after)


@pytest.mark.slow
def test_joints_come_nearer_to_the_truth(rough: PersonFit, fine: PersonFit, shelf: Studio) -> None:
    before, after = joint_errors(rough, shelf), joint_errors(fine, shelf)
    assert after.mean() < 13 and after.mean() < 0.7 * before.mean()
    assert after.max() < 35 < before.max()


def face_errors(fit: PersonFit, studio: Studio) -> NDArray[np.float64]:
    """Mean distances (5,) over the views of nose, eyes and ears from their true pixels."""
    coco = keypoint_set("coco17")
    model = PoseModel(shaped_human(fit.human, fit.proportions), coco, fit.proportions)
    places = model.keypoints(fitted_states(model, fit)[0])[:5]
    views = zip(studio.cameras.values(), studio.points[0], strict=True)
    return np.mean(
        [np.linalg.norm(camera.project(places)[0] - true[:5, :2], axis=1) for camera, true in views], axis=0
    )


def check_face(before: NDArray[np.float64], after: NDArray[np.float64]) -> None:
    """Errors of face points (5,) do not grow by silhouettes, beyond the noise of the points of 2 pixels."""
    assert after.mean() < before.mean() + 0.5 and (after < np.maximum(before, 2) + 1).all(), (before, after)


@pytest.mark.nightly
@pytest.mark.slow
def test_face_points_do_not_move_away_from_the_truth(
    rough: PersonFit, fine: PersonFit, shelf: Studio
) -> None:
    check_face(face_errors(rough, shelf), face_errors(fine, shelf))


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("human", ["tall_heavy_man", *if_shared("rpm_6505ad3b.glb")])
def test_the_face_of_someone_who_stoops_stays_where_its_points_are(human: str, tmp_path: Path) -> None:
    """Outlines of hair and hood would turn and stretch the head of the figure: its eyes were 2 cm off."""
    body = str(SHARED_DATA / "mesh" / human) if human.endswith(".glb") else human
    studio = make_studio(tmp_path, body, "pick_up", 4, begin=30, noise=2.0, images=False)
    photos = read_views(studio.path)
    rough = fit_person(photos, silhouettes=False)
    check_face(face_errors(rough, studio), face_errors(fit_silhouettes(rough, photos), studio))


@pytest.mark.nightly
@pytest.mark.slow
def test_keypoints_still_agree(rough: PersonFit, fine: PersonFit) -> None:
    right = ~fine.outliers & np.isfinite(fine.residuals)
    assert np.median(fine.residuals[right]) < np.median(rough.residuals[right]) + 1.5
    np.testing.assert_array_equal(np.isfinite(fine.residuals), np.isfinite(rough.residuals))


@pytest.mark.nightly
@pytest.mark.slow
def test_the_residuals_are_those_of_the_refined_body(fine: PersonFit, photos: PhotoSet) -> None:
    model = PoseModel(shaped_human(fine.human, fine.proportions), keypoint_set("coco17"))
    state = model.state(fine.proportions, fine.root[0], fine.rotations[0], fine.body.skeleton)
    seen = photos.cameras[1].project(model.keypoints(state))[0]
    expected = np.linalg.norm(seen - photos.points[0, 1, :, :2], axis=1)
    np.testing.assert_allclose(fine.residuals[0, 1], expected, rtol=1e-6)


@pytest.mark.nightly
@pytest.mark.slow
def test_offsets_bring_the_surface_to_the_truth(fine: PersonFit, shelf: Studio, photos: PhotoSet) -> None:
    """Proportions of the man are not the shape of the woman: offsets of his surface say the rest."""
    plain = replace(fine, proportions=replace(fine.proportions, offsets=()))
    true = shelf.vertices[0]
    with_them, without = (cKDTree(fit.vertices(0)).query(true)[0].mean() for fit in (fine, plain))
    assert with_them < 0.9 * without, (with_them, without)
    assert mean_iou(fine, photos) > max(mean_iou(plain, photos), 0.97)


@pytest.mark.nightly
@pytest.mark.slow
def test_left_and_right_have_the_same_girths(fine: PersonFit) -> None:
    girths = fine.proportions.girths
    assert len(girths) > 15
    for name, girth in girths.items():
        if name.startswith("l_"):
            assert girths["r_" + name[2:]] == girth


@pytest.mark.nightly
@pytest.mark.slow
def test_masks_of_the_body_itself_bring_back_its_girths(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A man with thick legs and a thin waist, in the pose of the truth."""
    monkeypatch.setattr("humansim_ros.photographs.silhouettes._SURFACE_ROUNDS", 0)
    studio = make_studio(tmp_path, human="adult_man", cameras=4, images=False)
    photos = read_views(studio.path)
    fit = fit_person(photos, silhouettes=False)
    girths = dict.fromkeys(("l_hip", "r_hip", "l_knee", "r_knee"), 1.2) | {"sacroiliac": 0.85}
    truth = replace(fit, proportions=replace(fit.proportions, girths=girths))
    for photo, face in zip(photos.frames[0], render_faces(truth, photos), strict=True):
        assert cv2.imwrite(str(photo.mask_path), (face > 0).astype(np.uint8) * 255)
    found = fit_silhouettes(fit, photos).proportions.girths
    assert found["l_hip"] == pytest.approx(1.2, abs=0.05)
    assert found["l_knee"] == pytest.approx(1.2, abs=0.06)
    assert found["sacroiliac"] < 0.95
    assert found["l_elbow"] == pytest.approx(1.0, abs=0.08)


@pytest.mark.nightly
@pytest.mark.slow
def test_another_frame_takes_over_the_proportions_and_keeps_its_pose(tmp_path: Path) -> None:
    studio = make_studio(tmp_path, cameras=4, frames=2, rate=4, images=False)
    photos = read_views(studio.path)
    rough = fit_person(photos, silhouettes=False)
    fine = fit_silhouettes(rough, photos, frames=[1])
    np.testing.assert_allclose(fine.rotations[0], rough.rotations[0], atol=1e-9)
    assert np.abs(fine.rotations[1] - rough.rotations[1]).max() > 1e-3
    hips = fine.body.skeleton.bone("l_hip"), fine.body.skeleton.bone("r_hip")
    np.testing.assert_allclose(fine.joints(0)[list(hips)], rough.joints(0)[list(hips)], atol=0.03)
    assert silhouette_iou(fine, photos, 1)["view_1"] > silhouette_iou(rough, photos, 1)["view_1"]


def test_without_masks_nothing_changes(rough: PersonFit, photos: PhotoSet) -> None:
    frames = tuple(tuple(replace(photo, mask_path=None) for photo in frame) for frame in photos.frames)
    bare = replace(photos, frames=frames)
    assert fit_silhouettes(rough, bare) is rough
    assert silhouette_iou(rough, bare) == {}


def with_mask(photos: PhotoSet, view: int, mask: NDArray[np.bool_], folder: Path) -> PhotoSet:
    path = folder / "other.png"
    assert cv2.imwrite(str(path), mask.astype(np.uint8) * 255)
    frame = list(photos.frames[0])
    frame[view] = replace(frame[view], mask_path=path)
    return replace(photos, frames=(tuple(frame),))


@pytest.mark.nightly
@pytest.mark.slow
def test_an_empty_silhouette_is_named_and_the_others_are_used(
    rough: PersonFit, photos: PhotoSet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("humansim_ros.photographs.silhouettes._SURFACE_ROUNDS", 0)
    empty = with_mask(photos, 2, np.zeros(photos.cameras[2].size[::-1], bool), tmp_path)
    with pytest.warns(HumansimWarning, match=rf"other\.png.*empty.*view {photos.names[2]}, frame 0"):
        fine = fit_silhouettes(rough, empty)
    assert mean_iou(fine, photos) > 0.93


def test_a_mask_of_another_size_is_refused(rough: PersonFit, photos: PhotoSet, tmp_path: Path) -> None:
    small = with_mask(photos, 0, np.ones((48, 64), bool), tmp_path)
    with pytest.raises(PhotographError, match=r"other\.png.*64x48"):
        fit_silhouettes(rough, small)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_wrong_mask_of_one_view_does_not_spoil_the_fit(
    rough: PersonFit, photos: PhotoSet, shelf: Studio, tmp_path: Path
) -> None:
    """One mask has the shadow on the floor, as large as half of the person."""
    mask = photos.frames[0][0].mask()
    assert mask is not None
    rows, columns = np.nonzero(mask)
    shadow = mask.astype(np.uint8)
    foot = (int(columns[rows.argmax()]), int(rows.max()))
    cv2.ellipse(shadow, foot, (int(np.ptp(rows) / 3), int(np.ptp(rows) / 12)), 10, 0, 360, 1, -1)
    assert shadow.sum() > 1.1 * mask.sum()
    fine = fit_silhouettes(rough, with_mask(photos, 0, shadow.astype(bool), tmp_path))
    assert joint_errors(fine, shelf).mean() < 16
    assert mean_iou(fine, photos) > 0.92


@pytest.mark.nightly
@pytest.mark.slow
def test_another_person_in_a_mask_does_not_attract_the_body(
    rough: PersonFit, fine: PersonFit, photos: PhotoSet, tmp_path: Path
) -> None:
    mask = photos.frames[0][1].mask()
    assert mask is not None
    shift = 350 if np.nonzero(mask)[1].mean() < mask.shape[1] / 2 else -350
    both = mask | np.roll(mask, shift, axis=1)
    with_other = fit_silhouettes(rough, with_mask(photos, 1, both, tmp_path))
    np.testing.assert_allclose(with_other.joints(0), fine.joints(0), atol=1e-3)


def test_parts_of_a_mask_that_the_body_does_not_touch_belong_to_others() -> None:
    mask, body = np.zeros((2, 40, 60), bool)
    mask[5:35, 5:20], mask[8:20, 40:55] = True, True
    body[10:30, 15:25] = True
    own = own_parts(mask, body)
    np.testing.assert_array_equal(own[:, :30], mask[:, :30])
    assert not own[:, 30:].any()
    np.testing.assert_array_equal(own_parts(mask, np.zeros_like(body)), mask)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_person_who_is_cut_off_by_the_image_is_fitted(tmp_path: Path) -> None:
    """The border of the image is no outline: legs that are outside of all images keep their girth."""
    studio = make_studio(tmp_path, cameras=4, images=False, position=(1.2, 0.0))
    photos = read_views(studio.path)
    cut = [mask[[0, -1]].any() or mask[:, [0, -1]].any() for mask in studio.masks[0]]
    assert any(cut)
    rough = fit_person(photos, silhouettes=False)
    fine = fit_silhouettes(rough, photos)
    assert joint_errors(fine, studio).mean() < joint_errors(rough, studio).mean()
    assert mean_iou(fine, photos) > 0.92


def test_derivatives_of_vertices_are_slopes_of_their_positions() -> None:
    human, rng = load_human("adult_man"), np.random.default_rng(0)
    model = PoseModel(human, keypoint_set("coco17"))
    state = model.moved(model.neutral(), rng.normal(0, 0.2, model.size))
    vertices = rng.integers(0, len(human.mesh.vertices), 40)
    points = Attachments.of_vertices(human, vertices)
    positions, slopes = model.derivatives(state, points)
    step = 1e-6
    numeric = [
        model.positions(model.moved(state, step * unit), points)
        - model.positions(model.moved(state, -step * unit), points)
        for unit in np.eye(model.size)
    ]
    np.testing.assert_allclose(slopes, np.stack(numeric, axis=-1) / (2 * step), atol=1e-7)
    body = with_proportions(human, model.proportions(state))
    posed = body.pose(body.skeleton.pose(model.rotations(state), model.root(state, body.skeleton)))
    np.testing.assert_allclose(positions, posed[vertices], atol=3e-3)


def test_distances_of_an_outline_are_those_of_a_disc() -> None:
    y, x = np.mgrid[:120, :160]
    radius = np.hypot(x - 70.3, y - 55.8)
    outline = MaskOutline(radius < 30)
    near = np.abs(radius - 30) < 20
    np.testing.assert_allclose(outline.distances[near], (radius - 30)[near], atol=0.8)
    away = np.stack([x - 70.3, y - 55.8], axis=-1)[near] / radius[near, None]
    assert ((outline.slopes[near] * away).sum(axis=1) > 0.9).all()
    assert len(outline.pixels()) >= 100
    np.testing.assert_allclose(np.hypot(*(outline.pixels() - (70.3, 55.8)).T), 29.5, atol=0.8)


def test_the_border_of_the_image_is_no_outline() -> None:
    mask = np.zeros((60, 80), bool)
    mask[20:, 30:50] = True
    outline = MaskOutline(mask)
    assert outline.pixels()[:, 1].max() < 58
    assert outline.distances[59, 40] < -9  # to the sides, not to the border


def test_intersection_over_union_of_two_rectangles() -> None:
    first, second = np.zeros((2, 10, 10), bool)
    first[:4, :5], second[2:4, :10] = True, True
    assert intersection_over_union(first, second) == pytest.approx(10 / 30)
    assert intersection_over_union(first & False, second & False) == 0
