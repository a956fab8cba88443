"""Boxes of people: 3D IoU beside the volume of a polytope, result files, and an export scored by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError
from scipy.spatial.transform import Rotation

from humansim_ros.data.evaluation.boxes import BoxTracks, evaluate_boxes
from humansim_ros.data.evaluation.readers.box_files import read_box_file
from humansim_ros.data.evaluation.tracking import box_overlap
from humansim_ros.errors import EvaluationError, HumansimWarning
from humansim_ros.types import Array


def sides(box: Array) -> Array:
    """Halfspaces (6, 4) of a box: a x + b <= 0."""
    axes = Rotation.from_euler("z", box[6]).as_matrix().T
    normals = np.concatenate([axes, -axes])
    return np.column_stack([normals, -normals @ box[:3] - np.tile(box[3:6] / 2, 2)])


def polytope_overlap(a: Array, b: Array) -> float:
    """3D IoU from the convex hull of the intersection of twelve halfspaces."""
    spaces = np.concatenate([sides(a), sides(b)])
    # a point well inside: the one with the largest distance to all sides

    reached = np.column_stack([spaces[:, :3], np.ones(12)])
    found = linprog([0, 0, 0, -1], A_ub=reached, b_ub=-spaces[:, 3], bounds=[(None, None)] * 4)
    if found.x[3] <= 1e-9:
        return 0.0
    try:
        common = ConvexHull(HalfspaceIntersection(spaces, found.x[:3]).intersections).volume
    except QhullError:
        return 0.0
    return float(common / (np.prod(a[3:6]) + np.prod(b[3:6]) - common))


def random_boxes(seed: int, count: int) -> Array:
    rng = np.random.default_rng(seed)
    parts = rng.normal(0, 0.3, (count, 3)), rng.uniform(0.2, 1.5, (count, 3)), rng.uniform(-7, 7, count)
    return np.column_stack(parts)


def test_overlap_is_the_volume_that_two_boxes_have_in_common() -> None:
    truth, estimate = random_boxes(0, 9), random_boxes(1, 9)
    expected = np.array([[polytope_overlap(a, b) for b in estimate] for a in truth])
    assert (expected > 0.01).sum() > 30
    np.testing.assert_allclose(box_overlap(truth, estimate), expected, atol=1e-9)


def test_overlap_where_sides_or_corners_touch() -> None:
    box = np.array([[1.0, 2.0, 0.9, 0.4, 0.6, 1.8, 0.3]])
    ahead = np.array([np.cos(0.3), np.sin(0.3), 0, 0, 0, 0, 0])
    for other, expected in (
        (box, 1.0),
        (box + np.array([0, 0, 0, 0, 0, 0, np.pi]), 1.0),
        (box + 0.4 * ahead, 0.0),  # side by side
        (box + 0.2 * ahead, 1 / 3),
        (box + np.array([0, 0, 0.9, 0, 0, 0, 0]), 1 / 3),
        (box + np.array([0, 0, 1.8, 0, 0, 0, 0]), 0.0),
        (box * [1, 1, 1, 0.5, 0.5, 0.5, 1], 1 / 8),  # inside
        (box + np.array([0, 0, 0, 0, 0, 0, np.pi / 2]), 0.16 / 0.32),
    ):
        assert box_overlap(box, other)[0, 0] == pytest.approx(expected, abs=1e-12)
    assert box_overlap(box, np.zeros((0, 7))).shape == (1, 0)


GOOD = "0 0 1 0 1.0 2.0 0.9 0.4 0.6 1.8 0.1\n"


@pytest.mark.parametrize(
    ("line", "key", "words"),
    [
        ("0 0 1 1 1.0 2.0 0.9 0.4 0.6 1.8", None, "10 columns"),
        ("0 0 1 1 nan 2.0 0.9 0.4 0.6 1.8 0.1", "x", "no finite number"),
        ("0 0 1 1 1.0 2.0 inf 0.4 0.6 1.8 0.1", "z", "no finite number"),
        ("0 0 1 1 1.0 2.0 0.9 0.4 0.6 tall 0.1", "height", "no finite number"),
        ("0 0 1 1 1.0 2.0 0.9 0.4 -0.6 1.8 0.1", "width length height", "sizes above 0"),
        ("0 7 1 1 1.0 2.0 0.9 0.4 0.6 1.8 0.1", "class_id", "the classes are 0 Person, 1 Forklift"),
        ("0 0 one 1 1.0 2.0 0.9 0.4 0.6 1.8 0.1", "object_id", "no whole number from 0 to 2147483647"),
        ("0 0 1 -1 1.0 2.0 0.9 0.4 0.6 1.8 0.1", "frame_id", "no whole number from 0 to 2147483647"),
        ("0 0 1 99999999999 1.0 2.0 0.9 0.4 0.6 1.8 0.1", "frame_id", "no whole number from 0 to 2147483647"),
        ("0 0 1 0 1.5 2.0 0.9 0.4 0.6 1.8 0.1", "object_id", "has a box in frame 0 already"),
        ("3 0 1 1 1.0 2.0 0.9 0.4 0.6 1.8 0.1", "scene_id", "scene 3 after scene 0"),
    ],
)
def test_a_wrong_line_is_named(tmp_path: Path, line: str, key: str | None, words: str) -> None:
    path = tmp_path / "track1.txt"
    path.write_text(GOOD + "\n" + line + "\n")
    with pytest.raises(EvaluationError, match=words) as caught:
        read_box_file(path)
    assert (caught.value.path, caught.value.line, caught.value.key) == (str(path), 3, key)


def test_other_classes_are_left_out_and_a_file_may_have_no_people(tmp_path: Path) -> None:
    path = tmp_path / "track1.txt"
    path.write_text(GOOD + "0 1 1 0 5 5 1 1 2 2 0\n")
    with pytest.warns(HumansimWarning, match="1 boxes of other classes than Person"):
        identities, boxes = read_box_file(path).at(0)
    assert identities.tolist() == [1] and boxes.tolist() == [[1.0, 2.0, 0.9, 0.4, 0.6, 1.8, 0.1]]
    for text in ("0 1 1 0 5 5 1 1 2 2 0\n", "", "\n"):
        path.write_text(text)
        with pytest.warns(HumansimWarning, match="nobody is in the estimate: everybody is missed"):
            assert not read_box_file(path).frames


def tracks(*frames: dict[int, tuple[float, float]]) -> BoxTracks:
    """People of the size 0.5 x 0.5 x 2 m, by identity and position in each frame."""
    tables = {
        index: (
            np.array(list(people), np.intp),
            np.array([[x, y, 1, 0.5, 0.5, 2, 0] for x, y in people.values()]).reshape(-1, 7),
        )
        for index, people in enumerate(frames)
    }
    return BoxTracks(tables, "boxes.txt", lines=dict.fromkeys(tables, 7))


def test_errors_and_scores_of_boxes_with_known_answers() -> None:
    truth = tracks(*({1: (0.0, 0.0), 2: (5.0, 0.0)} for _ in range(4)))
    result = evaluate_boxes(truth, truth)
    for scores in result.tracking.values():
        assert (scores.hota, scores.mota, scores.idf1) == pytest.approx((1, 1, 1))
    # 0.25 m beside both: a third of the volume, and 7/8 of the similarity of 2024; nobody in the last frame
    result = evaluate_boxes(truth, tracks(*({8: (0.25, 0.0), 9: (5.25, 0.0)} for _ in range(3))))
    assert (result.people.found, result.people.missed, result.people.false) == (6, 2, 0)
    assert result.errors.center == pytest.approx(0.25) and result.errors.overlap == pytest.approx(1 / 3)
    # 3 of 4 frames at 17 of 19 thresholds: DetA = AssA = 3/4
    assert result.tracking["distance"].hota == pytest.approx(17 / 19 * 3 / 4)
    assert result.tracking["iou"].hota == pytest.approx(6 / 19 * 3 / 4)
    assert result.by_person["1"].found == 3


def test_a_frame_that_the_truth_lacks_is_named() -> None:
    with pytest.raises(EvaluationError, match="no frame 1; it has frames 0 to 0") as caught:
        evaluate_boxes(tracks({1: (0, 0)}), tracks({}, {1: (0, 0)}))
    assert (caught.value.line, caught.value.key) == (7, "frame_id")
