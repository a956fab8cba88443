"""Compare upright 3D boxes of people in ``map`` with the truth, as in track 1 of the AI City Challenge."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from humansim_ros.data.evaluation.alignment import match_people
from humansim_ros.data.evaluation.evaluation import PeopleCounts
from humansim_ros.data.evaluation.tracking import (
    TrackedFrame,
    TrackingScores,
    box_overlap,
    similarity,
    tracking_scores,
)
from humansim_ros.data.evaluation.truth import MAX_TRUTH_FRAMES, check_motions
from humansim_ros.errors import EvaluationError
from humansim_ros.scene.core import Scene, SceneStates
from humansim_ros.types import Array, Indices

#: Largest distance on the floor of a found person, metres. At twice this distance, similarity is 0.
DEFAULT_GATE = 1.0


@dataclass(frozen=True, repr=False)
class BoxTracks:
    """Boxes of people by frame.

    Attributes:
        frames: By frame number: identities (N,) and boxes (N, 7). A box is its centre in ``map``, its sizes
            along its own axes (metres), and the yaw of its x axis (radians).
        source: Where the boxes come from, for messages.
        names: Name of a person by identity. A person without a name is shown by the identity number.
        lines: By frame number: the first line about the frame in the file.
    """

    frames: Mapping[int, tuple[Indices, Array]]
    source: str
    names: Mapping[int, str] = field(default_factory=dict)
    lines: Mapping[int, int] = field(default_factory=dict)

    @property
    def span(self) -> range:
        """All frames from the first to the last one; frame 0 if there is none."""
        return range(min(self.frames, default=0), max(self.frames, default=0) + 1)

    def at(self, frame: int) -> tuple[Indices, Array]:
        """Identities (N,) and boxes (N, 7) of a frame. Both are empty if the frame is missing."""
        return self.frames.get(frame, (np.zeros(0, np.intp), np.zeros((0, 7))))


@dataclass(frozen=True)
class BoxErrors:
    """Mean errors of the boxes of people who were found: of the centre and of the sizes (length, width,
    height) in metres, and of the yaw in degrees. Also the mean 3D IoU."""

    center: float | None
    size: tuple[float, float, float] | None
    yaw_deg: float | None
    overlap: float | None


@dataclass(frozen=True)
class PersonBoxes:
    """Scores of one person: number of frames in the truth, number of frames where the person was found, mean
    error of the centre in metres."""

    present: int
    found: int
    center: float | None


@dataclass(frozen=True)
class BoxEvaluation:
    """Result of a comparison of boxes. A person is found if the centres on the floor are within ``gate``
    metres.

    ``tracking`` has the tracking scores by the similarity that they use. ``iou`` is the 3D IoU, as in the
    challenge of 2025. ``distance`` is 1 - d / (2 gate), where d is the distance of the centres on the floor,
    as in 2024 with a gate of 1 m.
    """

    truth: str
    estimate: str
    frames: int
    gate: float
    people: PeopleCounts
    errors: BoxErrors
    tracking: dict[str, TrackingScores]
    by_person: dict[str, PersonBoxes]


def evaluate_boxes(truth: BoxTracks, estimate: BoxTracks, gate: float = DEFAULT_GATE) -> BoxEvaluation:
    """Compare boxes in all frames of the truth.

    Args:
        truth: True boxes.
        estimate: The boxes to judge. The truth must have all their frames.
        gate: Greatest distance of the centres on the floor of a person who counts as found, metres.

    Raises:
        EvaluationError: The truth lacks a frame of the estimate, or the truth has no people.
    """
    for frame in estimate.frames:
        if frame not in truth.frames:
            known = f"frames {min(truth.frames)} to {max(truth.frames)}" if truth.frames else "no frames"
            raise EvaluationError(
                f"the truth has no frame {frame}; it has {known}",
                path=estimate.source,
                line=estimate.lines.get(frame),
                key="frame_id",
            )
    if not any(len(identities) for identities, _ in truth.frames.values()):
        raise EvaluationError("there is nobody in it", path=truth.source)
    numbers: tuple[dict[int, int], dict[int, int]] = ({}, {})
    tracked: dict[str, list[TrackedFrame]] = {"iou": [], "distance": []}
    pairs: list[Array] = []
    present, found = defaultdict[int, int](int), defaultdict[int, list[float]](list)
    false = 0
    for frame in sorted(truth.frames):
        (people, boxes), (own, guesses) = truth.at(frame), estimate.at(frame)
        distances = np.linalg.norm(boxes[:, None, :2] - guesses[None, :, :2], axis=2)
        overlaps = box_overlap(boxes, guesses)
        rows, columns = (
            np.array([table.setdefault(each, len(table)) for each in identities.tolist()], np.intp)
            for table, identities in zip(numbers, (people, own), strict=True)
        )
        tracked["iou"].append(TrackedFrame(rows, columns, overlaps))
        tracked["distance"].append(TrackedFrame(rows, columns, similarity(distances, gate)))
        matches = match_people(distances, gate)
        false += len(own) - len(matches)
        for person in people.tolist():
            present[person] += 1
        for row, column in matches:
            pair = _errors(boxes[row], guesses[column], float(overlaps[row, column]))
            found[int(people[row])].append(float(pair[0]))
            pairs.append(pair)
    return BoxEvaluation(
        truth=truth.source,
        estimate=estimate.source,
        frames=len(truth.frames),
        gate=gate,
        people=PeopleCounts.of(sum(present.values()), len(pairs), false),
        errors=_mean_errors(pairs),
        tracking={name: tracking_scores(frames) for name, frames in tracked.items()},
        by_person={
            truth.names.get(person, str(person)): PersonBoxes(
                count,
                len(found[person]),
                float(np.mean(found[person])) if found[person] else None,
            )
            for person, count in sorted(present.items())
        },
    )


def _errors(box: Array, guess: Array, overlap: float) -> Array:
    """Errors (6,) of an estimated box: centre, three sizes (metres), yaw (radians); and the 3D IoU."""
    yaw = abs(np.mod(guess[6] - box[6] + np.pi, 2 * np.pi) - np.pi)
    return np.array([np.linalg.norm(guess[:3] - box[:3]), *np.abs(guess[3:6] - box[3:6]), yaw, overlap])


def _mean_errors(pairs: list[Array]) -> BoxErrors:
    if not pairs:
        return BoxErrors(None, None, None, None)
    center, length, width, height, yaw, overlap = np.mean(pairs, axis=0).tolist()
    return BoxErrors(center, (length, width, height), float(np.degrees(yaw)), overlap)


def scene_boxes(scene: Scene, frames: range) -> BoxTracks:
    """Boxes of all people of a scene, computed without rendering.

    Raises:
        EvaluationError: The scene has no people or a live human, or there are too many frames.
    """
    check_motions(scene)
    if len(frames) > MAX_TRUTH_FRAMES:
        raise EvaluationError(
            f"the estimate has frames {frames[0]} to {frames[-1]}, more than {MAX_TRUTH_FRAMES}",
            path=scene.path,
            key="--truth",
        )
    states, tables = SceneStates(scene), {}
    for index in frames:
        humans = states.at(index).humans
        boxes = [state.upright_box for state in humans.values()]
        tables[index] = (
            np.array([scene.labels[name] for name in humans], np.intp),
            np.array([[*box.center, *box.size, box.yaw] for box in boxes]),
        )
    names = {scene.labels[name]: name for name in scene.actors}
    return BoxTracks(tables, str(scene.path or "the scene"), names)
