"""Each metric beside its published formula, written out here, or a case computed by hand."""

from __future__ import annotations

import numpy as np
import pytest
from evaluate_support import NAMES, STANDING
from scipy.spatial import procrustes
from scipy.spatial.transform import Rotation

from humansim_ros.data.evaluation.joint_names import limbs_of
from humansim_ros.data.evaluation.metrics import (
    Detections,
    acceleration_errors,
    auc,
    correct_parts,
    joint_errors,
    mean_error,
    pck,
    procrustes_aligned,
    runs,
    velocity_errors,
)
from humansim_ros.types import Array

RNG = np.random.default_rng(7)


def poses(count: int, spread: float = 0.1) -> tuple[Array, Array]:
    truth = STANDING + RNG.normal(0, 0.1, (count, *STANDING.shape))
    return truth, truth + RNG.normal(0, spread, truth.shape)


def test_mpjpe_is_the_mean_distance_of_all_joints_that_both_have() -> None:
    truth = np.zeros((1, 3, 3))
    estimate = np.array([[[0.03, 0.04, 0.0], [0.0, 0.0, 0.1], [np.nan] * 3]])
    errors = joint_errors(truth, estimate)
    np.testing.assert_allclose(errors[0, :2], [0.05, 0.1])
    assert mean_error(errors) == pytest.approx(0.075)
    assert mean_error(np.full((2, 3), np.nan)) is None


def test_procrustes_agrees_with_scipy() -> None:
    truth, estimate = poses(20)
    aligned = procrustes_aligned(truth, estimate)
    for own, given, moved in zip(truth, estimate, aligned, strict=True):
        # scipy scales both to unit size; its disparity is the sum of squares that is left
        _, _, disparity = procrustes(own, given)
        size = np.square(own - own.mean(axis=0)).sum()
        assert np.square(moved - own).sum() / size == pytest.approx(disparity, rel=1e-9)


def test_a_similarity_has_no_error_and_a_mirror_image_has() -> None:
    truth, _ = poses(3)
    turned = 0.3 * Rotation.from_euler("xyz", [1, 2, 3]).apply(truth.reshape(-1, 3)).reshape(truth.shape) + 5
    np.testing.assert_allclose(procrustes_aligned(truth, turned), truth, atol=1e-12)
    mirrored = turned * [-1, 1, 1]
    assert joint_errors(truth, procrustes_aligned(truth, mirrored)).mean() > 0.03


def test_procrustes_uses_the_joints_that_both_have() -> None:
    truth, _ = poses(1)
    turned = Rotation.from_euler("z", 1.0).apply(truth[0])[None] * 2 + 1
    turned[0, 3] = np.nan
    aligned = procrustes_aligned(truth, turned)
    kept = [index for index in range(len(NAMES)) if index != 3]
    np.testing.assert_allclose(aligned[0, kept], truth[0, kept], atol=1e-12)
    turned[0, 2:] = np.nan
    assert np.isnan(procrustes_aligned(truth, turned)).all()


def test_pck_counts_absent_joints_and_missed_people_as_wrong() -> None:
    errors = np.array([[0.1, 0.15, 0.2, np.inf, np.nan]])  # the truth lacks the last joint
    assert pck(errors, 0.15) == 2 / 4
    assert pck(errors, 0.15, missing=4) == 2 / 8
    assert pck(np.zeros((0, 5)), 0.15) is None


def test_auc_is_the_mean_of_pck_from_0_to_150_mm() -> None:
    """31 thresholds, as in MPI-INF-3DHP: an error of 50 mm is wrong for 0, 5 … 45 mm."""
    assert auc(np.array([[0.0501]])) == pytest.approx(20 / 31)
    errors = np.abs(RNG.normal(0, 0.1, (40, 14)))
    expected = np.mean([(errors <= mm / 1000).mean() for mm in range(0, 151, 5)])
    assert auc(errors) == pytest.approx(expected, abs=1e-3)


def pcp_of_voxelpose(truth: Array, estimate: Array) -> dict[str, float]:
    """Share of correct limbs by group, as VoxelPose scores Shelf and Campus."""
    pairs = {
        "head": [("vt3", "vt3_end")],
        "upper arms": [("l_shoulder", "l_elbow"), ("r_shoulder", "r_elbow")],
        "lower arms": [("l_elbow", "l_wrist"), ("r_elbow", "r_wrist")],
        "upper legs": [("l_hip", "l_knee"), ("r_hip", "r_knee")],
        "lower legs": [("l_knee", "l_ankle"), ("r_knee", "r_ankle")],
    }
    correct = dict.fromkeys([*pairs, "torso"], 0)
    for gt, pred in zip(truth, estimate, strict=True):
        limbs = [(group, gt[NAMES.index(a)], gt[NAMES.index(b)], pred[NAMES.index(a)], pred[NAMES.index(b)])
                 for group, ends in pairs.items() for a, b in ends]  # fmt: skip
        hips = [NAMES.index("l_hip"), NAMES.index("r_hip")]
        neck = NAMES.index("vt3")
        limbs.append(("torso", gt[hips].sum(axis=0) / 2, gt[neck], pred[hips].sum(axis=0) / 2, pred[neck]))
        for group, gt_s, gt_e, pred_s, pred_e in limbs:
            error_s = np.linalg.norm(pred_s - gt_s)
            error_e = np.linalg.norm(pred_e - gt_e)
            limb_length = np.linalg.norm(gt_s - gt_e)
            if (error_s + error_e) / 2.0 <= 0.5 * limb_length:
                correct[group] += 1
    return {group: count / len(truth) / len(pairs.get(group, "1")) for group, count in correct.items()}


def test_pcp_agrees_with_the_evaluation_of_shelf_and_campus() -> None:
    groups, limbs = limbs_of(NAMES)
    assert len(limbs) == 10
    truth, estimate = poses(50, 0.1)
    correct = correct_parts(truth, estimate, limbs)
    expected = pcp_of_voxelpose(truth, estimate)
    assert 0.1 < min(expected.values()) < max(expected.values()) < 1.01
    for group, share in expected.items():
        columns = [index for index, name in enumerate(groups) if name == group]
        assert (correct[:, columns] == 1).mean() == pytest.approx(share), group


def test_a_limb_without_truth_does_not_count_and_one_without_estimate_is_wrong() -> None:
    _, limbs = limbs_of(NAMES)
    truth = STANDING[None].copy()
    estimate = truth.copy()
    truth[0, NAMES.index("l_wrist")] = np.nan
    estimate[0, NAMES.index("r_hip")] = np.nan
    correct = correct_parts(truth, estimate, limbs)[0]
    by_limb = {(NAMES[a[0]], NAMES[b[0]]): each for (a, b), each in zip(limbs, correct, strict=True)}
    assert by_limb["l_elbow", "l_wrist"] == -1
    assert by_limb["r_hip", "r_knee"] == by_limb["l_hip", "vt3"] == 0
    assert by_limb["l_hip", "l_knee"] == 1


def test_limbs_need_their_joints() -> None:
    groups, limbs = limbs_of(["RHip", "RKnee", "RAnkle", "nose"])
    assert groups == ("upper legs", "lower legs") and limbs == [((0,), (1,)), ((1,), (2,))]
    assert correct_parts(STANDING[None], STANDING[None], []).shape == (1, 0)


def ap_of_voxelpose(evals: list[dict[str, float]], total: int, threshold: float) -> tuple[float, float]:
    """Average precision and recall of the evaluation on Panoptic of VoxelPose, step by step."""
    evals = sorted(evals, key=lambda item: -item["score"])
    tp, fp, seen = np.zeros(len(evals)), np.zeros(len(evals)), []
    for i, item in enumerate(evals):
        if item["mpjpe"] < threshold and item["gt_id"] not in seen:
            tp[i] = 1
            seen.append(item["gt_id"])
        else:
            fp[i] = 1
    tp, fp = np.cumsum(tp), np.cumsum(fp)
    recall, precise = tp / total, tp / (tp + fp)
    for n in range(len(evals) - 2, -1, -1):
        precise[n] = max(precise[n], precise[n + 1])
    precise = np.concatenate(([0], precise, [0]))
    recall = np.concatenate(([0], recall, [1]))
    index = np.where(recall[1:] != recall[:-1])[0]
    ap = np.sum((recall[index + 1] - recall[index]) * precise[index + 1])
    return float(ap), len(np.unique([e["gt_id"] for e in evals if e["mpjpe"] < threshold])) / total


@pytest.mark.parametrize("threshold", [0.025, 0.05, 0.1, 0.15, 0.5])
def test_ap_and_recall_agree_with_the_evaluation_of_panoptic(threshold: float) -> None:
    count, total = 300, 200
    scores, distances = RNG.random(count), np.abs(RNG.normal(0, 0.1, count))
    nearest = RNG.integers(0, total, count)
    found = Detections(scores, distances, nearest, total)
    evals = [{"score": s, "mpjpe": d, "gt_id": n} for s, d, n in zip(scores, distances, nearest, strict=True)]
    ap, recall = ap_of_voxelpose(evals, total, threshold)
    assert found.average_precision(threshold) == pytest.approx(ap)
    assert found.recall(threshold) == pytest.approx(recall)


def test_ap_without_people_or_estimates() -> None:
    none = np.zeros(0)
    assert Detections(none, none, none.astype(np.intp), 0).average_precision(0.1) is None
    assert Detections(none, none, none.astype(np.intp), 3).average_precision(0.1) == 0
    assert Detections(none, none, none.astype(np.intp), 3).recall(0.1) == 0


def test_velocity_and_acceleration_of_a_known_error() -> None:
    """The error grows as 0.5 · 3 m/s² · t², so its acceleration is 3 and its velocity 3 t."""
    times = np.arange(5) * 0.1
    truth = np.zeros((5, 2, 3))
    estimate = truth + (1.5 * times**2)[:, None, None] * [1.0, 0.0, 0.0]
    np.testing.assert_allclose(velocity_errors(times, truth, estimate)[:, 0], 3 * (times[1:] - 0.05))
    np.testing.assert_allclose(acceleration_errors(times, truth, estimate), 3.0)
    assert acceleration_errors(times[:2], truth[:2], estimate[:2]).shape == (0, 2)


def test_acceleration_is_that_of_vibe() -> None:
    """‖(x₊ − 2x + x₋)/Δt²‖ of the difference, at a constant rate."""
    truth, estimate = poses(6)
    times = np.arange(6) / 25
    accel = [(x[:-2] - 2 * x[1:-1] + x[2:]) * 25**2 for x in (truth, estimate)]
    np.testing.assert_allclose(
        acceleration_errors(times, truth, estimate), np.linalg.norm(accel[1] - accel[0], axis=2)
    )


def test_runs_end_at_gaps() -> None:
    assert runs(np.array([0, 40, 80, 200, 240]), 60) == [slice(0, 3), slice(3, 5)]
