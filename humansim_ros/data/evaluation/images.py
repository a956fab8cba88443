"""Compare detections in images with the truth: keypoints, boxes and masks of each camera.

pycocotools computes average precision [Lin 2014]. For all other scores, people and objects are matched by the
Hungarian method with the similarities of pycocotools (OKS or IoU).
"""

from __future__ import annotations

import contextlib
import io
from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from humansim_ros.data.evaluation.metrics import mean_error
from humansim_ros.data.formats.coco import joined_keypoints
from humansim_ros.errors import EvaluationError, warn_about
from humansim_ros.people.keypoints import KeypointSet, keypoint_set
from humansim_ros.types import Array

#: Smallest OKS or IoU of a match that counts as found.
MATCH = 0.5
#: Number of worst matches that are listed.
WORST = 10
#: Key in annotations of COCO, by kind of detection.
KEYS = {"keypoints": "keypoints", "boxes": "bbox", "masks": "segmentation"}
#: Names of the kinds in pycocotools.
_TYPES = {"keypoints": "keypoints", "boxes": "bbox", "masks": "segm"}
#: Names of the scores of boxes and masks, in the order of pycocotools.
_REGION_SCORES = (
    *("ap", "ap50", "ap75", "ap_small", "ap_medium", "ap_large"),
    *("ar1", "ar10", "ar100", "ar_small", "ar_medium", "ar_large"),
)
_KEYPOINT_SCORES = (
    *("ap", "ap50", "ap75", "ap_medium", "ap_large"),
    *("ar", "ar50", "ar75", "ar_medium", "ar_large"),
)
#: Values of COCO for the visibility of keypoints.
_OCCLUDED, _VISIBLE = 1, 2
#: Outer corners of the eyes among the 68 points of a face. Their distance is the unit of the NME [300-W].
_EYE_CORNERS = (45, 36)
#: Largest error of a correct keypoint of a hand in PCK, as a share of the longer side of the hand's box.
_HAND_SHARE = 0.2

_Record = dict[str, Any]


@dataclass(frozen=True, repr=False)
class ImageTruth:
    """Ground truth of images, in the form of COCO.

    Attributes:
        images: ``id``, ``camera``, ``frame``, ``stamp``, ``width``, ``height`` of each image.
        annotations: Annotations of COCO, with the ``name`` of the person or object.
        categories: Categories of COCO.
        keypoints: Set of the keypoints.
        source: Where the truth comes from, for messages.
    """

    images: Sequence[_Record]
    annotations: Sequence[_Record]
    categories: Sequence[_Record]
    keypoints: KeypointSet
    source: str = ""

    @classmethod
    def of(cls, document: Mapping[str, Any], keypoints: KeypointSet, source: str) -> ImageTruth:
        """Truth with the content of a COCO file."""
        images, annotations, categories = (document[k] for k in ("images", "annotations", "categories"))
        return cls(images, annotations, categories, keypoints, source)


@dataclass(frozen=True, repr=False)
class Detections2D:
    """Detections in images, in the form of COCO results.

    Attributes:
        results: ``image_id``, ``score``, ``category_id`` (absent in label images), and ``keypoints``,
            ``bbox`` or ``segmentation`` (compressed RLE).
        images: Numbers of the images in which the detector searched. If None, all images.
        source: Where the detections come from, for messages.
        keypoints: Set of the keypoints. If None, the set of the truth.
        kinds: Kinds that are scored even if there is no detection of the kind.
        cameras: Cameras with images in which the detector searched. If None, all cameras.
    """

    results: Sequence[_Record]
    images: Collection[int] | None = None
    source: str = ""
    keypoints: KeypointSet | None = None
    kinds: Sequence[str] = tuple(KEYS)
    cameras: Collection[str] | None = None


@dataclass(frozen=True)
class PixelErrors:
    """Mean errors of the keypoints of found people, pixels: of all, visible and occluded keypoints."""

    mean: float | None
    median: float | None
    visible: float | None
    occluded: float | None


@dataclass(frozen=True)
class ImageScores:
    """Scores for one kind of detection, in all images or in the images of one camera.

    Attributes:
        precision: Average precision and recall of pycocotools. None where pycocotools has no value.
        present: Number of true people and objects, added up over the images.
        found: Number of true people and objects with a detection of an OKS or IoU of at least 0.5.
        false: Number of detections that match no person or object.
        similarity: Mean OKS or IoU. A person or object without a detection counts as 0.
        error: Errors of keypoints. None for boxes and masks.
    """

    precision: dict[str, float | None]
    present: int
    found: int
    false: int
    similarity: float | None
    error: PixelErrors | None


@dataclass(frozen=True)
class NamedScore:
    """Scores of one person or object: number of images, number of images with a match, mean OKS or IoU."""

    present: int
    found: int
    similarity: float


@dataclass(frozen=True)
class KeypointScore:
    """Errors of one keypoint: mean distance and mean difference (x, y) in pixels; None if never detected."""

    error: float | None
    bias: tuple[float, float] | None


@dataclass(frozen=True)
class PartScore:
    """Errors of the hands or faces of people who were found, over all keypoints inside the images.

    Attributes:
        epe: Mean distance in pixels (end-point error). None if the part was never found.
        pck: Share of the keypoints of a hand with an error below 0.2 of the longer side of the hand's box.
            Missing keypoints count as wrong. None for faces.
        nme: Mean distance as a share of the distance between the outer corners of the eyes, over all faces
            that show both corners. None for hands, and if there is no such face.
    """

    epe: float | None
    pck: float | None
    nme: float | None


@dataclass(frozen=True)
class WorstImage:
    """One of the people or objects with the smallest OKS or IoU. ``stamp``: nanoseconds. ``error``: mean
    distance, pixels; None for boxes and masks."""

    image: int
    camera: str
    frame: int
    stamp: int
    name: str
    similarity: float
    error: float | None


@dataclass(frozen=True)
class KindScores:
    """All scores for one kind of detection. ``by_keypoint`` is empty for boxes and masks. ``by_part`` (face,
    left_hand, right_hand) is empty for keypoint sets without face and hands."""

    all: ImageScores
    by_camera: dict[str, ImageScores]
    by_name: dict[str, NamedScore]
    by_keypoint: dict[str, KeypointScore]
    by_part: dict[str, PartScore]
    worst: list[WorstImage]


@dataclass(frozen=True)
class ImageEvaluation:
    """Result of a comparison in images. Kinds of detections that the estimate lacks are None. ``matches``
    (for pictures, not in JSON) has annotation and detection (None if missed), by kind, image and name."""

    truth: str
    estimate: str
    images: int
    keypoint_set: str
    min_score: float
    keypoints: KindScores | None
    boxes: KindScores | None
    masks: KindScores | None
    matches: dict[tuple[str, int, str], tuple[_Record, _Record | None]] = field(repr=False)

    @property
    def kinds(self) -> dict[str, KindScores]:
        """Scores by kind: ``keypoints``, ``boxes``, ``masks``, as far as the estimate has them."""
        found = {kind: getattr(self, kind) for kind in KEYS}
        return {kind: scores for kind, scores in found.items() if scores is not None}


def evaluate_images(truth: ImageTruth, estimate: Detections2D, min_score: float = 0.0) -> ImageEvaluation:
    """Compare detections with the truth. pycocotools must be installed.

    ``min_score``: detections with a lower score are ignored, except for average precision.

    Raises:
        EvaluationError: The detections belong to no image or category of the truth, or truth and estimate
            have no common keypoint with a published OKS constant.
    """
    images = [
        row
        for row in truth.images
        if (estimate.images is None or row["id"] in estimate.images)
        and (estimate.cameras is None or row["camera"] in estimate.cameras)
    ]
    known = {row["id"] for row in images}
    results = [row for row in estimate.results if row["image_id"] in known]
    if not known or (estimate.results and not results):
        raise EvaluationError("none of its images is an image of the truth", path=estimate.source)
    results = _of_known_categories(truth, results, estimate.source)
    whole = [joined_keypoints(row, truth.keypoints.name) for row in truth.annotations]
    truth = replace(truth, annotations=whole)
    kinds = [kind for kind, key in KEYS.items() if any(key in row for row in results)] or estimate.kinds
    if not results:
        warn_about(estimate.source, "nobody is in the estimate: everybody is missed")
    if "keypoints" in kinds:
        truth, results = _with_common_keypoints(truth, results, estimate)
    matches: dict[tuple[str, int, str], tuple[_Record, _Record | None]] = {}
    scores: dict[str, KindScores] = {}
    for kind in kinds:
        comparison = _Comparison(truth, images, results, kind, min_score)
        scores[kind] = comparison.scores()
        matches |= {(kind, image, name): pair for (image, name), pair in comparison.pairs.items()}
    return ImageEvaluation(
        truth=truth.source,
        estimate=estimate.source,
        images=len(images),
        keypoint_set=truth.keypoints.name,
        min_score=min_score,
        keypoints=scores.get("keypoints"),
        boxes=scores.get("boxes"),
        masks=scores.get("masks"),
        matches=matches,
    )


def _with_common_keypoints(
    truth: ImageTruth, results: list[_Record], estimate: Detections2D
) -> tuple[ImageTruth, list[_Record]]:
    """Reduce truth and results to the anatomical points that both keypoint sets have and that have an OKS
    constant. The constants come from the set of the truth or, if this set has none, from coco17."""
    own, found = truth.keypoints, estimate.keypoints or truth.keypoints
    if found == own and own.sigmas is not None:
        return truth, results
    judge = own if own.sigmas is not None else keypoint_set("coco17")
    sigmas = dict(zip(judge.points[::-1], (judge.sigmas or ())[::-1], strict=True))
    places = {point: number for number, point in reversed([*enumerate(found.points)]) if point in sigmas}
    pairs = [(number, places.pop(point)) for number, point in enumerate(own.points) if point in places]
    if not pairs:
        text = (
            f"no keypoint with an OKS constant is in both {found.name} and {own.name}, the set of the truth"
        )
        raise EvaluationError(text, path=estimate.source, key="--keypoints")

    def chosen(row: _Record, numbers: Sequence[int]) -> _Record:
        if "keypoints" not in row:
            return row
        points = np.reshape(row["keypoints"], (-1, 3))[list(numbers)]
        return row | {"keypoints": points.ravel().tolist(), "num_keypoints": int((points[:, 2] > 0).sum())}

    kept, taken = zip(*pairs, strict=True)
    common = own.subset(kept, tuple(sigmas[own.points[number]] for number in kept))
    rows = [chosen(row, kept) for row in truth.annotations]
    return replace(truth, annotations=rows, keypoints=common), [chosen(row, taken) for row in results]


def _of_known_categories(truth: ImageTruth, results: list[_Record], source: str) -> list[_Record]:
    names = {row["id"]: row["name"] for row in truth.categories}
    kept = [row for row in results if row.get("category_id", next(iter(names))) in names]
    if len(kept) < len(results):
        other = next(row["category_id"] for row in results if row.get("category_id", 0) not in names)
        listed = ", ".join(f"{number} {name}" for number, name in names.items())
        message = f"category_id {other} is not in the truth, which has {listed}"
        if not kept:
            raise EvaluationError(message, path=source, key="category_id")
        warn_about(source, f"{message}: {len(results) - len(kept)} detections of others are left out")
    return kept


@dataclass
class _Group:
    """Counts and sums over all images, or over the images of one camera."""

    similarities: list[float] = field(default_factory=list)
    found: int = 0
    false: int = 0
    distances: list[Array] = field(default_factory=list)


class _Comparison:
    """Detections of one kind, and their matches."""

    def __init__(
        self,
        truth: ImageTruth,
        images: Sequence[_Record],
        results: Sequence[_Record],
        kind: str,
        min_score: float,
    ) -> None:
        self.truth, self.kind, self.min_score = truth, kind, min_score
        self.images = {row["id"]: row for row in images}
        own = [dict(row) for row in results if KEYS[kind] in row]
        # pycocotools takes the keys of the first row to be in all rows
        partial = {key for key in KEYS.values() if any(key not in row for row in own)}
        own = [{key: value for key, value in row.items() if key not in partial} for row in own]
        self._coarse = any("category_id" not in row for row in own)
        first = truth.categories[0]["id"]
        for row in own:
            row.setdefault("category_id", first)
        self._judge = _Judge(truth, own, kind, self._coarse)
        self.pairs: dict[tuple[int, str], tuple[_Record, _Record | None]] = {}
        self._of_all = _Group()
        self._of_camera: dict[str, _Group] = defaultdict(_Group)
        self._of_name: dict[str, _Group] = defaultdict(_Group)
        #: True keypoints (K, 3) of people who were found: x, y, visibility.
        self._found: list[Array] = []
        self._worst: list[WorstImage] = []
        self._precision = self._judge.precision(list(self.images))
        for (image, _), table in self._judge.similarities().items():
            self._match(int(image), *table)  # pycocotools makes it a NumPy number

    def _match(
        self, image: int, annotations: list[_Record], detections: list[_Record], similarities: Array
    ) -> None:
        """Match the detections of an image."""
        kept = [index for index, row in enumerate(detections) if row["score"] >= self.min_score]
        detections, similarities = [detections[index] for index in kept], similarities[kept]
        rows, columns = linear_sum_assignment(-similarities)
        match = {
            column: row
            for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
            if similarities[row, column] > 0
        }
        camera = self.images[image]["camera"]
        groups = (self._of_all, self._of_camera[camera])
        used = {row for column, row in match.items() if similarities[row, column] >= MATCH}
        for group in groups:
            group.false += len(detections) - len(used)
        for column, annotation in enumerate(annotations):
            if annotation.get("ignore"):
                continue
            name = annotation["name"]
            detection = detections[match[column]] if column in match else None
            similarity = float(similarities[match[column], column]) if detection is not None else 0.0
            difference = (
                self._difference(annotation, detection)
                if detection is not None and similarity >= MATCH
                else None
            )
            for group in (*groups, self._of_name[name]):
                group.similarities.append(similarity)
                group.found += similarity >= MATCH
                if difference is not None:
                    group.distances.append(difference)
            if difference is not None and self.kind == "keypoints":
                self._found.append(np.reshape(np.asarray(annotation["keypoints"], float), (-1, 3)))
            error = None
            if self.kind == "keypoints" and detection is not None:
                error = mean_error(np.linalg.norm(self._difference(annotation, detection)[:, :2], axis=1))
            self.pairs[image, name] = annotation, detection
            row = self.images[image]
            self._worst.append(WorstImage(image, camera, row["frame"], row["stamp"], name, similarity, error))

    def _difference(self, annotation: _Record, detection: _Record) -> Array:
        """Difference (x, y) and visibility (K, 3) of keypoints; NaN where one is absent."""
        if self.kind != "keypoints":
            return np.zeros((0, 3))
        truth = np.reshape(np.asarray(annotation["keypoints"], float), (-1, 3))
        points = np.reshape(np.asarray(detection["keypoints"], float), (-1, 3))
        difference = np.column_stack([points[:, :2] - truth[:, :2], truth[:, 2]])
        difference[(truth[:, 2] == 0) | ~points.any(axis=1)] = np.nan
        return difference

    def scores(self) -> KindScores:
        """All scores of the kind."""
        by_camera = {}
        for camera in dict.fromkeys(row["camera"] for row in self.images.values()):
            ids = [number for number, row in self.images.items() if row["camera"] == camera]
            by_camera[camera] = self._scores(self._of_camera[camera], self._judge.precision(ids))
        by_name = {
            name: NamedScore(
                len(group.similarities), group.found, float(np.mean(np.array(group.similarities)))
            )
            for name, group in sorted(self._of_name.items())
        }
        self._worst.sort(key=lambda each: (each.similarity, -(each.error or 0.0)))
        by_keypoint: dict[str, KeypointScore] = {}
        by_part: dict[str, PartScore] = {}
        if self.kind == "keypoints":
            shape = -1, len(self.truth.keypoints), 3
            differences = np.array(self._of_all.distances, float).reshape(shape)[..., :2]
            found = np.array(self._found, float).reshape(shape)
            by_keypoint = _keypoint_scores(self.truth.keypoints, differences)
            by_part = _part_scores(self.truth.keypoints, np.linalg.norm(differences, axis=-1), found)
        return KindScores(
            all=self._scores(self._of_all, self._precision),
            by_camera=by_camera,
            by_name=by_name,
            by_keypoint=by_keypoint,
            by_part=by_part,
            worst=self._worst[:WORST],
        )

    def _scores(self, group: _Group, precision: dict[str, float | None]) -> ImageScores:
        values = np.array(group.similarities, float)
        return ImageScores(
            precision=precision,
            present=len(values),
            found=group.found,
            false=group.false,
            similarity=mean_error(values),
            error=_pixel_errors(group.distances) if self.kind == "keypoints" else None,
        )


def _keypoint_scores(keypoints: KeypointSet, differences: Array) -> dict[str, KeypointScore]:
    """Scores by keypoint. ``differences``: (N, K, 2) differences from the truth, pixels; NaN if absent."""
    scores = {}
    for index, name in enumerate(keypoints.names):
        own = differences[np.isfinite(differences[:, index]).all(axis=1), index]
        x, y = own.mean(axis=0).tolist() if len(own) else (0.0, 0.0)
        scores[name] = KeypointScore(mean_error(np.linalg.norm(own, axis=1)), (x, y) if len(own) else None)
    return scores


def _part_scores(keypoints: KeypointSet, distances: Array, truth: Array) -> dict[str, PartScore]:
    """Scores of face and hands. ``distances``: (N, K) of found people from the truth, pixels. ``truth``:
    (N, K, 3) x, y, visibility."""
    parts = {part: list(numbers) for part, numbers in keypoints.parts.items()}
    return {part: _part_score(part, distances[:, own], truth[:, own]) for part, own in parts.items()}


def _part_score(part: str, distances: Array, truth: Array) -> PartScore:
    """Score of one part of the body (face or a hand) over N people."""
    epe = mean_error(distances)
    shown = truth[..., 2] > 0
    if part == "face":
        left, right = (truth[:, corner] for corner in _EYE_CORNERS)
        both = (left[:, 2] == _VISIBLE) & (right[:, 2] == _VISIBLE) & np.isfinite(distances).any(axis=1)
        apart = np.linalg.norm(left[both, :2] - right[both, :2], axis=1)
        nme = mean_error(np.nanmean(distances[both], axis=1) / apart) if both.any() else None
        return PartScore(epe, None, nme)
    high = np.where(shown[..., None], truth[..., :2], -np.inf).max(axis=1)
    low = np.where(shown[..., None], truth[..., :2], np.inf).min(axis=1)
    side = (high - low).max(axis=1)  # minus infinity if no point is in the image
    correct = (distances <= _HAND_SHARE * side[:, None]) & shown
    return PartScore(epe, float(correct.sum() / shown.sum()) if shown.any() else None, None)


def _pixel_errors(differences: Sequence[Array]) -> PixelErrors:
    rows = np.concatenate([np.zeros((0, 3)), *differences])
    distances = np.linalg.norm(rows[:, :2], axis=1)
    known = distances[np.isfinite(distances)]
    return PixelErrors(
        mean=mean_error(distances),
        median=float(np.median(known)) if len(known) else None,
        visible=mean_error(distances[rows[:, 2] == _VISIBLE]),
        occluded=mean_error(distances[rows[:, 2] == _OCCLUDED]),
    )


class _Judge:
    """Calls pycocotools for one kind of detection. ``coarse``: whether categories are ignored."""

    def __init__(self, truth: ImageTruth, results: list[_Record], kind: str, coarse: bool) -> None:
        try:
            from pycocotools.coco import COCO
            from pycocotools.cocoeval import COCOeval
        except ImportError:
            raise EvaluationError(
                "detections in images need pycocotools; install it with: pip install 'humansim_ros[evaluate]'"
            ) from None
        self._truth, self._kind, self._coarse, self._evaluation_class = truth, kind, coarse, COCOeval
        with contextlib.redirect_stdout(io.StringIO()):
            self._coco = COCO()
            self._coco.dataset = {
                "images": list(truth.images),
                "annotations": [dict(row) for row in truth.annotations],
                "categories": list(truth.categories),
            }
            self._coco.createIndex()
            self._results = self._coco.loadRes(results) if results else COCO()
        self._first: Any = None

    def precision(self, images: list[int]) -> dict[str, float | None]:
        """Average precision and recall in some images."""
        evaluation = self._evaluation_class(self._coco, self._results, _TYPES[self._kind])
        evaluation.params.imgIds = images
        evaluation.params.useCats = int(not self._coarse)
        names: tuple[str, ...] = _REGION_SCORES
        if self._kind == "keypoints":
            names = _KEYPOINT_SCORES
            evaluation.params.kpt_oks_sigmas = np.array(self._truth.keypoints.sigmas)
            evaluation.params.catIds = [row["id"] for row in self._truth.categories if row.get("keypoints")]
        with contextlib.redirect_stdout(io.StringIO()):
            evaluation.evaluate()
            evaluation.accumulate()
            evaluation.summarize()
        self._first = self._first or evaluation
        values = (float(value) for value in evaluation.stats)
        return {name: value if value >= 0 else None for name, value in zip(names, values, strict=True)}

    def similarities(self) -> dict[tuple[int, int], tuple[list[_Record], list[_Record], Array]]:
        """By image and category: annotations (G), detections (D, best first), and their OKS or IoU (D, G).
        They cover the images of the first call of :meth:`precision`, which must come before."""
        evaluation, found = self._first, {}
        for (image, category), values in evaluation.ious.items():
            keys = [(image, category)]
            if self._coarse:
                keys = [(image, row["id"]) for row in self._truth.categories]
            annotations = [row for key in keys for row in evaluation._gts[key]]
            detections = [row for key in keys for row in evaluation._dts[key]]
            order = np.argsort([-row["score"] for row in detections], kind="mergesort")
            detections = [detections[index] for index in order[: evaluation.params.maxDets[-1]]]
            table = np.zeros((len(detections), len(annotations)))
            if len(values):
                table[:] = values
            found[image, category] = annotations, detections, table
        return found
