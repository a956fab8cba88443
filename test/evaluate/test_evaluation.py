"""evaluate_poses: perfect estimates, known damage, and everything that makes a comparison impossible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evaluate_support import NAMES, PERIOD, changed, pose, walking

from humansim_ros.data.evaluation.alignment import axes_matrix
from humansim_ros.data.evaluation.evaluation import evaluate_poses
from humansim_ros.data.evaluation.pose_sequence import PoseSequence, SequenceBuilder
from humansim_ros.errors import EvaluationError, HumansimWarning
from humansim_ros.types import Array


def test_a_perfect_estimate_has_no_errors() -> None:
    result = evaluate_poses(walking(), walking())
    assert result.position.mpjpe == result.position.worst == 0
    assert result.position.pa_mpjpe == pytest.approx(0, abs=1e-12)
    assert result.position.pck == result.position.auc == result.pcp.all == result.detection.mean_ap == 1
    assert result.motion.velocity == result.motion.acceleration == 0
    assert (result.people.missed, result.people.false, result.people.found) == (0, 0, 100)
    assert result.tracking is not None
    assert result.tracking.hota == result.tracking.mota == result.tracking.idf1 == pytest.approx(1)
    assert result.offset.measured == pytest.approx(0, abs=1e-3)


def test_errors_by_joint_and_by_person() -> None:
    """Anna's left wrist is 60 mm too high, bert is 20 mm too far along x."""

    def damage(frame: int, person: str, joints: Array) -> Array:
        moved = joints + np.array([0.02 * (person == "bert"), 0, 0])
        if person == "anna":
            moved[NAMES.index("l_wrist"), 2] += 0.06
        return moved

    result = evaluate_poses(walking(), changed(walking(), damage))
    assert result.by_person["anna"].mpjpe == pytest.approx(0.06 / len(NAMES))
    assert result.by_person["bert"].mpjpe == pytest.approx(0.02)
    assert result.by_person["bert"].pa_mpjpe == pytest.approx(0, abs=1e-9)
    assert result.by_joint["l_wrist"].mpjpe == pytest.approx(0.04)
    assert result.by_joint["l_wrist"].bias == pytest.approx((0.01, 0, 0.03))
    assert result.by_joint["r_hip"].mpjpe == pytest.approx(0.01)
    assert result.worst[0].person == "bert"
    assert result.worst[0].error == pytest.approx(0.02)


def test_missed_and_false_people() -> None:
    """Bert is missed in 10 of 50 frames; a ghost is there in 5."""

    def damage(frame: int, person: str, joints: Array) -> Array | None:
        return None if person == "bert" and frame < 10 else joints

    estimate = changed(walking(), damage)
    people = [
        each | ({"ghost": pose("anna", 0.0) + np.array([5, 5, 0])} if frame < 5 else {})
        for frame, each in enumerate(estimate.people)
    ]
    result = evaluate_poses(walking(), replace(estimate, people=people))
    assert (result.people.present, result.people.missed, result.people.false) == (100, 10, 5)
    assert result.people.recall == 0.9 and result.people.precision == 90 / 95
    assert result.position.pck == pytest.approx(0.9)
    assert result.pcp.by_person == {"anna": 1.0, "bert": 0.8}
    assert result.pcp.all == pytest.approx(0.9)
    assert result.detection.recall["25"] == 0.9
    assert result.by_person["bert"].found == 40
    assert result.tracking is not None
    assert result.tracking.mota == pytest.approx(1 - 15 / 100)
    assert result.found_by_frame[:11].tolist() == [[1, 1, 1]] * 5 + [[1, 1, 0]] * 5 + [[2, 0, 0]]


def test_swapped_identities_cost_identity_scores_only() -> None:
    truth = walking()
    people = [
        each if frame < 25 else {"anna": each["bert"], "bert": each["anna"]}
        for frame, each in enumerate(truth.people)
    ]
    result = evaluate_poses(truth, replace(truth, people=people))
    assert result.position.mpjpe == 0
    assert result.tracking is not None
    assert (result.tracking.switches, result.tracking.idf1) == (2, 0.5)
    assert result.tracking.deta == pytest.approx(1)
    assert result.tracking.assa == pytest.approx(1 / 3)  # 25 of 75 frames of each pair of identities
    assert result.motion.velocity == 0  # not measured across the swap
    unnamed = replace(truth, people=people, has_identities=False)
    assert evaluate_poses(truth, unnamed).tracking is None


def test_a_late_estimate_is_measured_and_corrected_only_on_request() -> None:
    truth = walking(100)
    late = replace(walking(100), times=truth.times + 73_000_000)
    result = evaluate_poses(truth, late)
    assert result.offset.measured == pytest.approx(0.073, abs=2e-4)
    assert result.offset.applied == 0
    assert result.position.mpjpe is not None and result.position.mpjpe > 0.05
    corrected = evaluate_poses(truth, late, offset=None)
    assert corrected.offset.applied == corrected.offset.measured
    assert corrected.position.mpjpe == pytest.approx(0, abs=1e-9)
    given = evaluate_poses(truth, late, offset=0.073)
    assert given.offset.measured == pytest.approx(0.073, abs=2e-4)
    assert given.position.mpjpe == 0


def test_the_offset_of_people_who_stand_still_is_unknown() -> None:
    still = [{"anna": pose("anna", 0.0)}] * 50
    truth = replace(walking(), people=still)
    assert evaluate_poses(truth, truth).offset.measured is None


def test_frames_without_an_estimate_are_missed_people() -> None:
    truth = walking()
    kept = [frame for frame in range(50) if not 20 <= frame < 30]
    estimate = replace(truth, times=truth.times[kept], people=[truth.people[k] for k in kept])
    result = evaluate_poses(truth, estimate)
    assert (result.frames.compared, result.frames.without_estimate) == (50, 10)
    assert result.people.missed == 20


def test_a_slower_estimate_is_compared_at_its_own_rate() -> None:
    truth = walking()
    kept = list(range(3, 50, 5))
    estimate = replace(truth, times=truth.times[kept] + 5_000_000, people=[truth.people[k] for k in kept])
    result = evaluate_poses(truth, estimate)
    assert (result.frames.compared, result.frames.without_estimate, result.people.missed) == (10, 0, 0)
    gap = [k for k in kept if k not in (13, 18)]
    estimate = replace(truth, times=truth.times[gap], people=[truth.people[k] for k in gap])
    result = evaluate_poses(truth, estimate)
    assert (result.frames.compared, result.frames.without_estimate, result.people.missed) == (10, 2, 4)


def test_frames_of_an_estimate_without_truth_are_counted() -> None:
    """Twice as many frames as the truth: every second one is between two of the truth."""
    truth = walking(25)
    times = np.arange(50, dtype=np.int64) * (PERIOD // 2) + 1
    estimate = replace(
        truth, times=times, people=[{"anna": pose("anna", (int(t) - 1) * 1e-9)} for t in times]
    )
    result = evaluate_poses(truth, estimate)
    assert (result.frames.compared, result.frames.without_truth) == (25, 25)
    assert result.position.mpjpe == pytest.approx(0, abs=1e-9)


def test_names_of_other_sets_are_understood() -> None:
    coco = tuple(
        {"l": "left", "r": "right"}[name[0]] + name[1:] if name[1] == "_" else name for name in NAMES[:12]
    )
    estimate = replace(
        walking(), names=coco, people=[{k: v[:12] for k, v in p.items()} for p in walking().people]
    )
    result = evaluate_poses(walking(), estimate)
    assert result.joints == NAMES[:12] and result.position.mpjpe == 0


def test_a_table_of_names() -> None:
    estimate = replace(walking(), names=tuple(f"point {index}" for index in range(len(NAMES))))
    with pytest.raises(EvaluationError, match=r"no joint is common.*--keypoints.*--names"):
        evaluate_poses(walking(), estimate)
    result = evaluate_poses(walking(), estimate, names={"point 4": "l_wrist", "point 0": "l_shoulder"})
    assert result.joints == ("l_shoulder", "l_wrist") and result.position.mpjpe == 0
    with pytest.raises(EvaluationError, match=r"--names: the truth has no joint 'l_wrst'; did you mean"):
        evaluate_poses(walking(), estimate, names={"point 4": "l_wrst"})
    with pytest.raises(EvaluationError, match=r"--names: the estimate has no joint 'point 99'"):
        evaluate_poses(walking(), estimate, names={"point 99": "l_wrist"})


@pytest.mark.parametrize(("factor", "option"), [(1000.0, "0.001"), (0.01, "100"), (3.28084, "0.305")])
def test_another_unit_is_named_with_the_option_that_repairs_it(factor: float, option: str) -> None:
    scaled = changed(walking(), lambda frame, person, joints: joints * factor)
    with pytest.raises(EvaluationError, match=rf"another unit\? Give --scale {option}$"):
        evaluate_poses(walking(), scaled)


@pytest.mark.parametrize("axes", ["y-up", "y-down", "y,-x,z"])
def test_swapped_axes_are_named_with_the_option_that_repairs_them(axes: str) -> None:
    matrix = axes_matrix(axes)
    swapped = changed(walking(), lambda frame, person, joints: (joints + np.array([0, 1.5, 0])) @ matrix)
    truth = changed(walking(), lambda frame, person, joints: joints + np.array([0, 1.5, 0]))
    with pytest.raises(EvaluationError, match=rf"swap of axes: give --axes {axes}$"):
        evaluate_poses(truth, swapped)
    assert evaluate_poses(truth, swapped.mapped(matrix)).position.mpjpe == pytest.approx(0, abs=1e-9)


def test_unknown_axes() -> None:
    for text in ("sideways", "x,x,z", "x,y"):
        with pytest.raises(EvaluationError, match=r"^--axes: .*neither one of z-up, y-up, y-down nor"):
            axes_matrix(text)


def test_no_overlap_in_time_names_the_offset_that_would_align_the_starts() -> None:
    truth = walking()
    with pytest.raises(EvaluationError, match=r"do not overlap in time: .*give --offset 1000\b"):
        evaluate_poses(truth, truth.delayed(1_000_000_000_000))
    with pytest.raises(EvaluationError, match="wall clock"):
        evaluate_poses(truth, truth.delayed(1_700_000_000_000_000_000))
    assert evaluate_poses(truth, truth.delayed(10**12), offset=1000).position.mpjpe == 0


def test_an_estimate_elsewhere_is_warned_about_and_all_people_are_missed() -> None:
    away = changed(walking(), lambda frame, person, joints: joints + np.array([50, 80, 0]))
    with pytest.warns(HumansimWarning, match="no person of the estimate is within 0.5 m"):
        result = evaluate_poses(walking(), away)
    assert (result.people.found, result.people.missed, result.people.false) == (0, 100, 100)
    assert result.position.mpjpe is None and result.position.pck == 0 and result.pcp.all == 0
    assert result.tracking is not None and result.tracking.hota == 0


def test_nan_joints_are_absent() -> None:
    def blind(frame: int, person: str, joints: Array) -> Array:
        damaged = joints.copy()
        damaged[NAMES.index("l_knee")] = np.nan
        return damaged

    result = evaluate_poses(walking(), changed(walking(), blind))
    assert result.by_joint["l_knee"].mpjpe is None and result.by_joint["l_knee"].pck == 0
    assert result.position.mpjpe == 0 and result.position.pck == pytest.approx(13 / 14)


def test_nobody_is_an_estimate_and_no_truth() -> None:
    builder = SequenceBuilder("file.csv")
    builder.add(1, "anna", NAMES, np.full((len(NAMES), 3), np.nan))
    blank = builder.build()
    builder = SequenceBuilder("file.csv")
    assert blank.count == builder.build().count == 0
    for nobody, compared in ((blank, 1), (builder.build(), 50)):
        with pytest.warns(HumansimWarning, match="nobody is in the estimate: everybody is missed"):
            result = evaluate_poses(walking(), nobody, offset=None)
        assert result.frames.compared == compared and result.people.missed == 2 * compared
        assert result.people.recall == result.position.pck == result.detection.mean_ap == 0
        assert result.tracking is None and result.joints == NAMES
        with pytest.raises(EvaluationError, match=r"file\.csv: there are no poses in it"):
            evaluate_poses(nobody, walking())
    builder.add(1, "anna", NAMES, np.full((len(NAMES), 3), np.inf))
    with pytest.raises(EvaluationError, match=r"file\.csv: no position in it is finite"):
        builder.build()


def test_a_sequence_of_one_frame() -> None:
    result = evaluate_poses(walking(1), walking(1))
    assert result.position.mpjpe == 0 and result.motion.velocity is None
    assert result.offset.measured is None
    assert PoseSequence(NAMES, walking(1).times, walking(1).people).period == 0
