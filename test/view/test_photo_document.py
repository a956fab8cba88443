"""Editing of photographs without a browser: points, exchange of sides, undo and redo, files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("viser")

from photographs.studio import Studio, change_views, make_studio, write_json

from humansim_ros.errors import HumansimError, PhotographError
from humansim_ros.photographs.fitting import fit_person
from humansim_ros.photographs.person_fit import PersonFit, read_fit
from humansim_ros.photographs.views import read_views
from humansim_ros.view.edit.photo_document import PhotoDocument, outlines
from humansim_ros.view.sources.inputs import open_source
from humansim_ros.view.sources.photo_source import PhotoSource


@pytest.fixture(scope="module")
def studio(tmp_path_factory: pytest.TempPathFactory) -> Studio:
    return make_studio(tmp_path_factory.mktemp("studio"), frames=2, images=False, noise=1.0)


@pytest.fixture(scope="module")
def fit(studio: Studio) -> PersonFit:
    return fit_person(read_views(studio.path), silhouettes=False)


@pytest.fixture
def document(studio: Studio, fit: PersonFit) -> PhotoDocument:
    return PhotoDocument(read_views(studio.path), fit)


def content(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.nightly
def test_a_point_moves_and_comes_back(document: PhotoDocument) -> None:
    before = document.state.points
    column = document.keypoints.index("nose")
    document.set_point(1, "view_2", "nose", 100.5, 50.25)
    assert document.state.points[1][1, column].tolist() == [100.5, 50.25, 1.0]
    assert document.state.points[0] is before[0]
    assert document.edited.frames[1][1].points[column].tolist() == [100.5, 50.25, 1.0]
    assert document.undo_label == "Move nose in view_2" and document.changed
    document.undo()
    assert document.state.points is before and not document.changed
    assert document.redo_label == "Move nose in view_2"
    document.redo()
    assert document.state.points[1][1, column, 0] == 100.5


def test_an_edit_after_undo_leaves_nothing_to_do_again(document: PhotoDocument) -> None:
    document.remove_point(0, "view_1", "nose")
    document.undo()
    document.remove_point(0, "view_1", "left_knee")
    assert document.redo_label is None
    with pytest.raises(HumansimError, match="nothing to do again"):
        document.redo()
    document.undo()
    with pytest.raises(HumansimError, match="nothing to undo"):
        document.undo()


def test_a_removed_point_has_no_residual(document: PhotoDocument) -> None:
    column = document.keypoints.index("left_wrist")
    assert document.overlay(0).residuals[0, column] >= 0
    document.remove_point(0, "view_1", "left_wrist")
    assert np.isnan(document.overlay(0).residuals[0, column])
    with pytest.raises(HumansimError, match="no left_wrist to remove"):
        document.remove_point(0, "view_1", "left_wrist")
    document.set_point(0, "view_1", "left_wrist", 5, 5)
    assert document.undo_label == "Set left_wrist in view_1"


def test_sides_are_exchanged_in_one_photograph(document: PhotoDocument) -> None:
    before = document.state.points[0]
    left, right = (document.keypoints.index(f"{side}_hip") for side in ("left", "right"))
    residuals = document.overlay(0).residuals
    document.exchange_sides(0, "view_3")
    after = document.state.points[0]
    np.testing.assert_array_equal(after[2, left], before[2, right])
    np.testing.assert_array_equal(np.delete(after, 2, axis=0), np.delete(before, 2, axis=0))
    # the solution was made from the other sides, and still fits
    mirrored = list(document.keypoints.mirrored)
    np.testing.assert_allclose(document.overlay(0).residuals[2], residuals[2][mirrored])
    document.exchange_sides(0, "view_3")
    np.testing.assert_array_equal(document.state.points[0], before)


def test_residuals_and_outline_are_those_of_the_solution(document: PhotoDocument, studio: Studio) -> None:
    overlay = document.overlay(0)
    fit = document.state.fit
    assert fit is not None
    np.testing.assert_allclose(overlay.residuals, fit.residuals[0], atol=0.3)
    document.set_point(0, "view_1", "nose", 20, 30)
    nose = document.keypoints.index("nose")
    moved = document.overlay(0)
    distance = np.linalg.norm(moved.fitted[0, nose] - [20, 30])
    assert moved.residuals[0, nose] == pytest.approx(distance) and not moved.outliers[0, nose]
    for row in range(4):
        rows, columns = np.nonzero(studio.masks[0, row])
        drawn = np.concatenate(overlay.outlines[row])
        true = np.array([columns.min(), rows.min(), columns.max(), rows.max()])
        np.testing.assert_allclose([*drawn.min(0), *drawn.max(0)], true, atol=12)


def test_an_outline_goes_around_what_is_seen() -> None:
    corners = np.array([[10, 20], [60, 20], [60, 50], [10, 50], [np.nan, np.nan]], float)
    (line,) = outlines(corners, np.array([[0, 1, 2], [0, 2, 3], [0, 1, 4]]), (100, 80))
    np.testing.assert_allclose([line.min(0), line.max(0)], [[10, 20], [60, 50]], atol=1)


@pytest.mark.daily("0-view_1-nose-5-480")
@pytest.mark.parametrize(
    ("frame", "view", "point", "x", "y"),
    [
        (0, "view_1", "nose", float("nan"), 5),
        (0, "view_1", "nose", 5, float("inf")),
        (0, "view_1", "nose", -1, 5),
        (0, "view_1", "nose", 5, 480),
        (0, "view_9", "nose", 5, 5),
        (0, "../etc", "nose", 5, 5),
        (0, "view_1", "tail", 5, 5),
        (2, "view_1", "nose", 5, 5),
        (-1, "view_1", "nose", 5, 5),
    ],
)
def test_what_is_not_there_is_refused(
    document: PhotoDocument, frame: int, view: str, point: str, x: float, y: float
) -> None:
    state = document.state
    with pytest.raises(HumansimError):
        document.set_point(frame, view, point, x, y)
    with pytest.raises(HumansimError):
        document.remove_point(frame, view, point) if x == 5 and y == 5 else document.exchange_sides(9, view)
    assert document.state is state


@pytest.mark.nightly
def test_accept_writes_the_edited_points_and_the_fit_only(tmp_path: Path) -> None:
    made = make_studio(tmp_path, images=False, noise=1.0)
    document = PhotoDocument.load(made.path)
    before = content(tmp_path)
    document.set_point(0, "view_2", "left_ear", 301.25, 99)
    assert content(tmp_path) == before and document.pending == ["points/view_2.json"]
    assert document.accept() == ["wrote points/view_2.json"]
    after = content(tmp_path)
    assert {path for path in after if after[path] != before.get(path)} == {tmp_path / "points/view_2.json"}
    document.take_solution(fit_person(document.edited, silhouettes=False), document.state, "")
    assert document.accept() == ["wrote fit.yaml"]
    assert set(content(tmp_path)) - set(after) == {tmp_path / "fit.yaml"}
    again = PhotoDocument.load(made.path)
    ear = again.keypoints.index("left_ear")
    assert again.state.points[0][1, ear].tolist() == [301.25, 99.0, 1.0]
    assert again.state.fit is not None
    np.testing.assert_allclose(again.overlay(0).fitted, document.overlay(0).fitted, atol=0.01)
    # an edit after the solution is in the residuals of the file
    again.set_point(0, "view_1", "nose", 3, 3)
    again.accept()
    nose = again.keypoints.index("nose")
    assert read_fit(tmp_path / "fit.yaml").residuals[0, 0, nose] == pytest.approx(
        again.overlay(0).residuals[0, nose], abs=0.01
    )


def test_an_edit_during_the_solution_is_kept(document: PhotoDocument, fit: PersonFit) -> None:
    begun = document.state
    document.set_point(0, "view_1", "nose", 3, 3)
    document.take_solution(fit, begun, "humansim human fit")
    nose = document.keypoints.index("nose")
    assert document.state.points[0][0, nose, 0] == 3
    assert document.state.solved is begun.points and document.undo_label == "Solve"


def test_files_of_detectors_stay(tmp_path: Path) -> None:
    made = make_studio(tmp_path, images=False)
    people = [{"pose_keypoints_2d": [1.0, 2.0, 0.5] * 17}]
    write_json(tmp_path / "points" / "view_1.json", {"people": people})
    document = PhotoDocument.load(made.path)
    before = (tmp_path / "points" / "view_1.json").read_bytes()
    document.set_point(0, "view_1", "nose", 3, 4)
    (line,) = document.accept()
    assert "wrote views_points/view_1.json" in line and "points: views_points/view_1.json" in line
    assert (tmp_path / "points" / "view_1.json").read_bytes() == before
    written = json.loads((tmp_path / "views_points" / "view_1.json").read_text())
    assert written["frames"][0]["nose"] == [3.0, 4.0, 1.0]


def test_accept_does_not_write_over_the_work_of_another_program(tmp_path: Path) -> None:
    made = make_studio(tmp_path, images=False)
    document = PhotoDocument.load(made.path)
    document.set_point(0, "view_1", "nose", 3, 4)
    file = tmp_path / "points" / "view_1.json"
    file.write_text(file.read_text() + "\n\n")
    with pytest.raises(HumansimError, match="another program has changed"):
        document.accept()
    assert document.changed


def test_a_fit_of_other_views_is_not_written_over(tmp_path: Path, studio: Studio, fit: PersonFit) -> None:
    from humansim_ros.photographs.person_fit import write_fit

    made = make_studio(tmp_path, images=False)  # one frame
    write_fit(tmp_path / "fit.yaml", fit)
    with pytest.raises(PhotographError, match="fit of other photographs"):
        PhotoDocument.load(made.path)


def test_humansim_view_opens_views_files(studio: Studio, tmp_path: Path) -> None:
    opened = open_source(studio.path)
    try:
        assert isinstance(opened.source, PhotoSource)
        assert tuple(opened.source.cameras) == ("view_1", "view_2", "view_3", "view_4")
        assert opened.source.frames == 2 and not opened.source.people
    finally:
        opened.source.close()
    wrong = change_views(studio.path, human="adult_mann", keypoints="coco18")
    with pytest.raises(PhotographError, match="coco18"):
        open_source(wrong)
