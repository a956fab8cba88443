"""Detections in images: AP as pycocotools computes it, errors in pixels, IoU of masks, by camera and name."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from humansim_ros.errors import EvaluationError, HumansimWarning
from humansim_ros.people import keypoint_set

pytest.importorskip("pycocotools")
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from humansim_ros.data.evaluation.images import (
    _KEYPOINT_SCORES,
    Detections2D,
    ImageTruth,
    PartScore,
    evaluate_images,
)
from humansim_ros.data.evaluation.readers.detections import encoded_mask
from humansim_ros.data.formats.coco import divided_keypoints, joined_keypoints

SIZE = (80, 60)
COCO17 = keypoint_set("coco17")
Record = dict[str, Any]


def annotation(
    number: int, image: int, name: str, box: tuple[int, int, int, int], category: int = 1
) -> Record:
    """A person or object that fills its box; the keypoints of people are on its diagonal."""
    x, y, width, height = box
    mask = np.zeros(SIZE[::-1], bool)
    mask[y : y + height, x : x + width] = True
    row: Record = {
        "id": number,
        "image_id": image,
        "category_id": category,
        "name": name,
        "bbox": list(box),
        "area": width * height,
        "iscrowd": 0,
        "segmentation": encoded_mask(mask),
    }
    if category == 1:
        steps = np.linspace(0, 1, len(COCO17))
        points = np.column_stack([x + steps * (width - 1), y + steps * (height - 1), np.full(17, 2)])
        points[0] = 0  # the nose is out of the image
        points[1, 2] = 1  # the left eye is occluded
        row |= {"keypoints": points.ravel().tolist(), "num_keypoints": 16}
    return row


@pytest.fixture
def truth() -> ImageTruth:
    """Two people and a box, seen by two cameras in two frames; bert is not in the last image."""
    images = [
        {"id": 10 + n, "camera": "ab"[n % 2], "frame": n // 2, "stamp": 1 + n // 2, "width": 80, "height": 60}
        for n in range(4)
    ]
    rows = []
    for image in images:
        rows.append(annotation(len(rows) + 1, image["id"], "anna", (5, 5, 20, 50)))
        if image["id"] != 13:
            rows.append(annotation(len(rows) + 1, image["id"], "bert", (30, 4, 24, 54)))
        rows.append(annotation(len(rows) + 1, image["id"], "crate", (60, 40, 10, 10), 2))
    categories = [{"id": 1, "name": "person", "keypoints": list(COCO17.names)}, {"id": 2, "name": "box"}]
    return ImageTruth(images, rows, categories, COCO17, "truth")


def found(truth: ImageTruth, change: Callable[[Record], Record | None] = lambda row: row) -> Detections2D:
    """The truth as a result, with a change of each detection; None leaves it out."""
    results = []
    for row in truth.annotations:
        keys = ("image_id", "category_id", "keypoints", "bbox", "segmentation")
        result = change({key: row[key] for key in keys if key in row} | {"score": 0.9, "name": row["name"]})
        if result is not None:
            results.append({key: value for key, value in result.items() if key != "name"})
    return Detections2D(results, None, "estimate")


def moved(pixels: tuple[float, float], name: str | None = None) -> Callable[[Record], Record]:
    """Change of detections: keypoints and boxes moved, of a person or of all."""

    def change(row: Record) -> Record:
        if name not in (None, row["name"]):
            return row
        shift = np.array(pixels)
        if "keypoints" in row:
            points = np.reshape(row["keypoints"], (-1, 3)) + np.array([*pixels, 0])
            row = row | {"keypoints": points.ravel().tolist()}
        return row | {"bbox": [*(np.array(row["bbox"][:2]) + shift).tolist(), *row["bbox"][2:]]}

    return change


def test_the_truth_has_no_error(truth: ImageTruth) -> None:
    result = evaluate_images(truth, found(truth))
    assert set(result.kinds) == {"keypoints", "boxes", "masks"}
    for kind, scores in result.kinds.items():
        for own in (scores.all, *scores.by_camera.values()):
            assert own.precision["ap"] == pytest.approx(1) and own.false == 0
            assert own.found == own.present and own.similarity == pytest.approx(1)
        assert set(scores.by_camera) == {"a", "b"}
        assert scores.all.present == (7 if kind == "keypoints" else 11)
    assert result.keypoints is not None and result.keypoints.all.error is not None
    assert result.keypoints.all.error.mean == 0
    assert result.images == 4


def test_keypoints_moved_by_known_pixels(truth: ImageTruth) -> None:
    result = evaluate_images(truth, found(truth, moved((3, 4), "anna"))).keypoints
    assert result is not None and result.all.error is not None
    # OKS of anna: the mean over 16 labelled points of exp(-d² / (2 · area · (2 sigma)²))
    sigmas = np.array(COCO17.sigmas)[1:]
    oks = np.exp(-25 / (2 * 20 * 50 * (2 * sigmas) ** 2)).mean()
    assert result.by_name["anna"].similarity == pytest.approx(oks, abs=1e-9)
    assert result.by_name["bert"].similarity == pytest.approx(1)
    assert result.all.similarity == pytest.approx((4 * oks + 3) / 7)
    assert (oks >= 0.5) == (result.by_name["anna"].found == 4)
    assert result.worst[0].name == "anna" and result.worst[0].error == pytest.approx(5)


def test_errors_of_keypoints_are_pixels(truth: ImageTruth) -> None:
    def change(row: Record) -> Record:
        row = moved((0.3, -0.4))(row)
        if "keypoints" in row:
            row["keypoints"][3 * 1] += 3  # the left eye, which is occluded
            row["keypoints"][3 * 16 : 3 * 17] = [0, 0, 0]  # the right ankle was not found
        return row

    result = evaluate_images(truth, found(truth, change)).keypoints
    assert result is not None and result.all.error is not None
    far = float(np.hypot(3.3, 0.4))
    assert result.all.error.visible == pytest.approx(0.5)
    assert result.all.error.occluded == pytest.approx(far)
    assert result.all.error.mean == pytest.approx((14 * 0.5 + far) / 15)
    assert result.all.error.median == pytest.approx(0.5)
    assert result.by_keypoint["left_eye"].bias == pytest.approx((3.3, -0.4))
    assert result.by_keypoint["left_knee"].error == pytest.approx(0.5)
    assert result.by_keypoint["nose"].error is None and result.by_keypoint["right_ankle"].bias is None


def test_boxes_moved_by_known_pixels(truth: ImageTruth) -> None:
    result = evaluate_images(truth, found(truth, moved((5, 0), "anna"))).boxes
    assert result is not None
    assert result.by_name["anna"].similarity == pytest.approx(15 / 25)  # widths: 15 in common of 25
    assert result.all.similarity == pytest.approx((4 * 0.6 + 7) / 11)
    worse = evaluate_images(truth, found(truth, moved((10, 0), "anna"))).boxes
    assert worse is not None and worse.by_name["anna"].similarity == pytest.approx(1 / 3)
    assert worse.by_name["anna"].found == 0 and worse.all.false == 4


def test_masks_with_known_pixels(truth: ImageTruth) -> None:
    half = np.zeros(SIZE[::-1], bool)
    half[5:30, 5:25] = True  # of anna: 25 of 50 lines

    def change(row: Record) -> Record | None:
        if row["image_id"] == 10 and row["name"] == "bert":
            return None
        return row | ({"segmentation": encoded_mask(half)} if row["name"] == "anna" else {})

    result = evaluate_images(truth, found(truth, change)).masks
    assert result is not None
    assert result.by_name["anna"].similarity == pytest.approx(0.5)
    assert result.by_name["bert"].similarity == pytest.approx(2 / 3)  # missed in one of three images
    assert result.by_name["crate"].similarity == pytest.approx(1)
    assert result.by_camera["a"].similarity == pytest.approx((2 * 0.5 + 1 + 2) / 6)
    assert result.worst[0].name == "bert" and result.worst[0].similarity == 0


def test_labels_without_categories_are_compared_with_everything(truth: ImageTruth) -> None:
    def change(row: Record) -> Record:
        return {key: row[key] for key in ("image_id", "segmentation", "score", "name")}

    result = evaluate_images(truth, found(truth, change))
    assert set(result.kinds) == {"masks"} and result.masks is not None
    assert result.masks.all.precision["ap"] == pytest.approx(1)
    assert result.masks.all.found == 11 and result.masks.all.false == 0


@pytest.mark.parametrize("kind", ["keypoints", "boxes", "masks"])
def test_scores_are_those_of_pycocotools(truth: ImageTruth, kind: str) -> None:
    random = np.random.default_rng(3)

    def change(row: Record) -> Record | None:
        if random.random() < 0.15:
            return None
        shift = random.normal(0, 2, 2)
        row = moved((float(shift[0]), float(shift[1])))(row)
        mask = np.zeros(SIZE[::-1], bool)
        x, y, width, height = (max(0, round(value)) for value in row["bbox"])
        mask[y : y + height, x : x + width] = True
        return row | {"score": float(random.random()), "segmentation": encoded_mask(mask)}

    estimate = found(truth, change)
    scores = evaluate_images(truth, estimate).kinds[kind]
    key, name = {
        "keypoints": ("keypoints", "keypoints"),
        "boxes": ("bbox", "bbox"),
        "masks": ("segmentation", "segm"),
    }[kind]
    for camera in (None, "a", "b"):
        with contextlib.redirect_stdout(io.StringIO()):
            coco = COCO()
            categories = [row for row in truth.categories if kind != "keypoints" or row["id"] == 1]
            ids = {row["id"] for row in categories}
            coco.dataset = {
                "images": list(truth.images),
                "annotations": [dict(row) for row in truth.annotations if row["category_id"] in ids],
                "categories": categories,
            }
            coco.createIndex()
            own = [dict(row) for row in estimate.results if key in row]
            judge = COCOeval(coco, coco.loadRes(own), name)
            if camera is not None:
                judge.params.imgIds = [row["id"] for row in truth.images if row["camera"] == camera]
            judge.evaluate()
            judge.accumulate()
            judge.summarize()
        mine = (scores.all if camera is None else scores.by_camera[camera]).precision
        expected = [None if value < 0 else value for value in judge.stats.tolist()]
        assert list(mine.values()) == expected
        assert 0.1 < mine["ap"] < 0.95


def test_false_people_and_low_scores(truth: ImageTruth) -> None:
    estimate = found(truth)
    ghost = {"image_id": 11, "category_id": 1, "bbox": [0, 0, 4, 4], "score": 0.2}
    with_ghost = Detections2D([*estimate.results, ghost], None, "estimate")
    result = evaluate_images(truth, with_ghost).boxes
    assert result is not None and result.all.false == 1 and result.by_camera["b"].false == 1
    result = evaluate_images(truth, with_ghost, min_score=0.5).boxes
    assert result is not None and result.all.false == 0


def test_images_that_were_not_searched_do_not_count(truth: ImageTruth) -> None:
    rows = [row for row in found(truth).results if row["image_id"] == 10]
    assert evaluate_images(truth, Detections2D(rows, {10, 11}, "")).images == 2
    result = evaluate_images(truth, Detections2D(rows, {10}, "")).boxes
    assert result is not None and result.all.found == result.all.present == 3


def test_what_cannot_be_compared(truth: ImageTruth) -> None:
    def category(number: int) -> Callable[[Record], Record]:
        return lambda row: row | {"category_id": number}

    with pytest.raises(EvaluationError, match="category_id 7 is not in the truth, which has 1 person, 2 box"):
        evaluate_images(truth, found(truth, category(7)))
    with pytest.warns(HumansimWarning, match="category_id 7 .* 7 detections of others are left out"):
        evaluate_images(
            truth, found(truth, lambda row: row | {"category_id": 7} if row["category_id"] == 1 else row)
        )
    with pytest.raises(EvaluationError, match="none of its images"):
        evaluate_images(truth, Detections2D(found(truth).results, {99}, ""))
    hand = replace(found(truth), keypoints=keypoint_set("left_hand21").subset(range(1, 21)))
    with pytest.raises(EvaluationError, match="no keypoint with an OKS constant is in both left_hand21 and"):
        evaluate_images(truth, hand)


@pytest.mark.parametrize("kinds", [("keypoints",), ("boxes", "masks")])
def test_nobody_is_found_and_all_are_missed(truth: ImageTruth, kinds: tuple[str, ...]) -> None:
    with pytest.warns(HumansimWarning, match="nobody is in the estimate: everybody is missed"):
        result = evaluate_images(truth, Detections2D([], {10, 13}, "", kinds=kinds))
    assert result.images == 2 and tuple(result.kinds) == kinds
    for kind, scores in result.kinds.items():
        people = scores.by_name["anna"], scores.by_name["bert"]
        assert [each.present for each in people] == [2, 1] and not any(each.found for each in people)
        assert scores.all.present == (3 if kind == "keypoints" else 5) and scores.all.false == 0
        assert scores.all.precision["ap"] == scores.all.similarity == 0


#: Sets without published OKS constants, and number of the points that coco17 has, too.
@pytest.mark.parametrize(
    ("name", "common"), [("body25", 17), ("h36m17", 12), ("mediapipe33", 17), ("smpl24", 12)]
)
@pytest.mark.parametrize("is_truth", [False, True])
def test_other_sets_are_compared_by_the_points_of_coco17(
    truth: ImageTruth, name: str, common: int, is_truth: bool
) -> None:
    """OKS by the formula of COCO over the common points; those of the estimate are 3 pixels beside."""
    points = keypoint_set(name)
    places = [points.points.index(point) if point in points.points else -1 for point in COCO17.points]
    kept = [number for number, place in enumerate(places) if place >= 0]
    assert len(kept) == common

    def other(row: Record, shift: float) -> Record:
        if "keypoints" not in row:
            return row
        own = np.reshape(row["keypoints"], (-1, 3))
        table = np.full((len(points), 3), 7.0)  # what coco17 has not
        table[[places[number] for number in kept]] = own[kept] + np.array([shift, 0, 0]) * (own[kept, 2:] > 0)
        return row | {"keypoints": table.ravel().tolist(), "num_keypoints": len(points)}

    if is_truth:
        own = replace(truth, annotations=[other(row, 0) for row in truth.annotations], keypoints=points)
        estimate = found(truth, moved((3, 0)))
        estimate = replace(estimate, keypoints=COCO17)
    else:
        own, estimate = truth, found(truth)
        estimate = replace(estimate, results=[other(row, 3) for row in estimate.results], keypoints=points)
    scores = evaluate_images(own, estimate).keypoints
    assert scores is not None and scores.all.error is not None
    assert scores.all.found == 7 and scores.all.error.mean == pytest.approx(3)
    similarity = []
    for row in truth.annotations:
        if "keypoints" in row:
            shown = [n for n in kept if row["keypoints"][3 * n + 2] > 0]
            sigmas = np.array(COCO17.sigmas)[shown]
            similarity.append(np.exp(-9 / (2 * row["area"] * (2 * sigmas) ** 2)).mean())
    assert scores.all.similarity == pytest.approx(np.mean(similarity), rel=1e-9)
    assert len(scores.by_keypoint) == common


WHOLE_BODY = keypoint_set("wholebody133")


def whole_body_truth() -> ImageTruth:
    """A person whose 133 keypoints are at known places: the face is 40 pixels wide, hands are 20 x 10."""
    points = np.full((133, 3), 2.0)
    points[:, :2] = np.linspace((10, 10), (60, 50), 133)
    points[23:91, :2] = np.column_stack([np.linspace(20, 60, 68), np.full(68, 15.0)])
    for corner, x in ((36, 30.0), (45, 50.0)):  # outer corners of the eyes, 20 pixels apart
        points[23 + corner, :2] = x, 14
    for first in (91, 112):
        points[first : first + 21, :2] = np.column_stack([np.linspace(5, 25, 21), np.linspace(30, 40, 21)])
    row = annotation(1, 10, "anna", (5, 5, 60, 50)) | divided_keypoints(
        {"keypoints": points.ravel().tolist(), "num_keypoints": 133}, "wholebody133"
    )
    image = {"id": 10, "camera": "a", "frame": 0, "stamp": 1, "width": 80, "height": 60}
    categories = [{"id": 1, "name": "person", "keypoints": list(COCO17.names)}]
    return ImageTruth([image], [row], categories, WHOLE_BODY, "truth")


def test_hands_have_epe_and_pck_and_faces_nme() -> None:
    truth = whole_body_truth()
    points = np.reshape(joined_keypoints(truth.annotations[0], "wholebody133")["keypoints"], (-1, 3))
    points[23:91, :2] += (0.6, -0.8)  # 1 pixel
    points[91:112, :2] += (1.8, 2.4)  # 3 pixels, under 0.2 * 20
    points[112:117, :2] += (0, 5)  # five points of the right hand are too far
    points[117] = 0  # and one is missing
    flat = {"image_id": 10, "category_id": 1, "score": 1.0, "keypoints": points.ravel().tolist()}
    scores = evaluate_images(truth, Detections2D([flat])).keypoints
    assert scores is not None
    face, left, right = (scores.by_part[part] for part in ("face", "left_hand", "right_hand"))
    assert face.epe == pytest.approx(1) and face.nme == pytest.approx(1 / 20) and face.pck is None
    assert left.epe == pytest.approx(3) and left.pck == 1 and left.nme is None
    assert right.epe == pytest.approx(5 * 5 / 20) and right.pck == pytest.approx(15 / 21)
    sigmas = np.array(WHOLE_BODY.sigmas)
    distance = np.linalg.norm(points[:, :2] - np.reshape(whole(truth), (-1, 3))[:, :2], axis=1)
    oks = np.exp(-(distance**2) / (2 * 60 * 50 * (2 * sigmas) ** 2)).mean()
    assert scores.all.similarity == pytest.approx(oks, abs=1e-9)


def whole(truth: ImageTruth) -> list[float]:
    found: list[float] = joined_keypoints(truth.annotations[0], "wholebody133")["keypoints"]
    return found


def test_faces_from_the_side_have_no_nme_and_other_sets_no_parts(truth: ImageTruth) -> None:
    side = whole_body_truth()
    side.annotations[0]["face_kpts"][3 * 36 + 2] = 1  # an eye is hidden
    flat = {"image_id": 10, "category_id": 1, "score": 1.0, "keypoints": whole(side)}
    scores = evaluate_images(side, Detections2D([flat])).keypoints
    assert scores is not None and scores.by_part["face"] == PartScore(0.0, None, None)
    assert evaluate_images(truth, found(truth)).kinds["keypoints"].by_part == {}


@pytest.mark.nightly
def test_whole_bodies_are_judged_as_by_the_tools_of_coco_wholebody() -> None:
    """OKS of each pair, AP and AR of xtcocotools, of all 133 keypoints of noisy detections."""
    judge = pytest.importorskip("xtcocotools.cocoeval")
    coco_class = pytest.importorskip("xtcocotools.coco").COCO
    random, rows, results = np.random.default_rng(5), [], []
    first = whole_body_truth()
    images = [first.images[0] | {"id": number, "frame": number} for number in range(10, 40)]
    for number in range(90):
        image = 10 + number // 3
        visible = random.integers(0, 3, 133)
        points = np.column_stack([random.uniform(5, 60, 133), random.uniform(5, 50, 133), visible])
        points[visible == 0] = 0
        row = annotation(number + 1, image, f"p{number}", (5, 5, 55, 45))
        flat = {"keypoints": points.ravel().tolist(), "num_keypoints": 133}
        rows.append(row | divided_keypoints(flat, "wholebody133"))
        points[:, :2] += random.normal(0, random.uniform(0, 2), (133, 2))
        points[:, 2] = 1
        one = {"image_id": image, "category_id": 1, "score": float(random.random())}
        if number % 7:
            results.append(one | divided_keypoints({"keypoints": points.ravel().tolist()}, "wholebody133"))
    truth = replace(first, images=images, annotations=rows)
    scores = evaluate_images(
        truth, Detections2D([joined_keypoints(row, "wholebody133") for row in results])
    ).keypoints
    assert scores is not None
    with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no score of the whole body: the score is used
        coco = coco_class()
        coco.dataset = {"images": images, "annotations": rows, "categories": list(truth.categories)}
        coco.createIndex()
        theirs = judge.COCOeval(
            coco, coco.loadRes(results), "keypoints_wholebody", np.array(WHOLE_BODY.sigmas), use_area=True
        )
        theirs.evaluate()
        theirs.accumulate()
        theirs.summarize()
    expected = dict(zip(_KEYPOINT_SCORES, theirs.stats, strict=True))
    for name in ("ap", "ap50", "ap75", "ar", "ar50", "ar75"):
        assert scores.all.precision[name] == pytest.approx(expected[name], abs=1e-9), name
    assert 0.1 < expected["ap"] < 0.9
    # similarity of people is the best OKS of each, 0 without one
    total = sum(table[linear_sum_assignment(-np.asarray(table))].sum() for table in theirs.ious.values())
    assert scores.all.similarity == pytest.approx(total / 90, abs=1e-9)
