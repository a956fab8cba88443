"""Metrics of social navigation: how close a robot comes to the people of the truth, and how it drives.

The metrics are those of SEAN 2.0 [Tsoi 2022], SocNavBench [Biswas 2022], HuNavSim [Pérez-Higueras 2023] and
[Francis 2025]; docs/social_navigation.md defines each.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.evaluation.nearby import PeopleNearby
from humansim_ros.errors import EvaluationError, some_of, warn_about
from humansim_ros.types import Array

#: Outer radii of the spaces around a person, metres [Hall 1966]. The public space is outside of these.
SPACES = {"intimate": 0.45, "personal": 1.2, "social": 3.6}
#: A robot that keeps at least this distance does not disturb a person, metres [Francis 2025].
COMPLIANCE = 0.5
#: Radius of an unknown robot, and of a person for the time to collision, metres.
DEFAULT_RADIUS, PERSON_RADIUS = 0.3, 0.3


@dataclass(frozen=True)
class Gap:
    """A run of frames of the truth without a pose of the robot: first and last stamp (nanoseconds), and
    number of frames."""

    start: int
    end: int
    frames: int


@dataclass(frozen=True)
class NavigationFrames:
    """How many frames of the truth have a pose of the robot.

    Attributes:
        compared: Number of frames with a pose.
        without_pose: Number of frames without a pose.
        start, end: Stamps of the first and the last frame, nanoseconds.
        gaps: The runs of consecutive frames without a pose.
    """

    compared: int
    without_pose: int
    start: int
    end: int
    gaps: list[Gap]


@dataclass(frozen=True)
class DrivenPath:
    """The driven path: duration (s), length (m), mean speed (m/s), and turning beyond what the path needs
    (rad/m, None for a robot that stands)."""

    seconds: float
    length: float
    speed: float | None
    irregularity: float | None


@dataclass(frozen=True)
class Closeness:
    """How close a robot came to a person, or to the nearest of all people.

    Attributes:
        distance: Smallest distance on the floor between the middles of robot and person, metres.
        stamp: Stamp of the smallest distance, nanoseconds.
        clearance: Smallest distance on the floor between the robot's disc and the body, metres. Below 0 in
            contact. None if bodies are not known.
        collisions: Number of times that a contact begins. None if bodies are not known.
        contact: Seconds in contact. None if bodies are not known.
        time_to_collision: Smallest time to a collision if robot and person kept their velocities, seconds.
            None if they would never collide.
        spaces: Seconds in the intimate, personal, social and public space.
        compliance: Share of the time with a distance above 0.5 m.
    """

    distance: float | None
    stamp: int | None
    clearance: float | None
    collisions: int | None
    contact: float | None
    time_to_collision: float | None
    spaces: dict[str, float]
    compliance: float | None


@dataclass(frozen=True)
class NavigationEvaluation:
    """Result: the path of the robot, and how close the robot came to the nearest person and to each person.
    ``radius``: radius of the robot's disc, metres."""

    truth: str
    estimate: str
    radius: float
    frames: NavigationFrames
    path: DrivenPath
    nearest: Closeness
    by_person: dict[str, Closeness]


def evaluate_navigation(nearby: PeopleNearby, source: str, radius: float) -> NavigationEvaluation:
    """Compute all metrics.

    Args:
        nearby: People, and places of the robot, in the frames of the truth.
        source: Where the path comes from, for messages.
        radius: Radius of the robot, metres.

    Raises:
        EvaluationError: The robot has no pose in any frame of the truth.
    """
    known: NDArray[np.bool_] = np.asarray(np.isfinite(nearby.places).all(axis=1))
    if not known.any():
        raise EvaluationError(
            f"the robot has no pose at any of the {len(nearby.times)} frames of the truth; were both "
            "recorded together?",
            path=source,
        )
    gaps = _gaps(nearby.times, known)
    if gaps:
        spans = some_of(f"{gap.start * 1e-9:.3f} to {gap.end * 1e-9:.3f} s" for gap in gaps)
        warn_about(
            source,
            f"{int((~known).sum())} frames of the truth have no pose of the robot, and are left out: {spans}",
        )
    weights = _seconds(nearby.times, known)
    each = {name: _closeness(nearby, name, radius, weights) for name in nearby.people}
    return NavigationEvaluation(
        truth=nearby.source,
        estimate=source,
        radius=radius,
        frames=NavigationFrames(
            int(known.sum()), int((~known).sum()), int(nearby.times[0]), int(nearby.times[-1]), gaps
        ),
        path=_driven(nearby, known),
        nearest=_nearest(nearby, each, weights),
        by_person=each,
    )


def _gaps(times: NDArray[np.int64], known: NDArray[np.bool_]) -> list[Gap]:
    edges = np.flatnonzero(np.diff(np.concatenate([[True], known, [True]]).astype(int)))
    return [
        Gap(int(times[start]), int(times[end - 1]), int(end - start))
        for start, end in zip(edges[::2], edges[1::2], strict=True)
    ]


def _seconds(times: NDArray[np.int64], known: NDArray[np.bool_]) -> Array:
    """Seconds (F,) that each known frame stands for: half of the time to the known frame before and after."""
    steps = np.where(known[1:] & known[:-1], np.diff(times) * 1e-9, 0.0)
    return np.asarray((np.append(steps, 0.0) + np.append(0.0, steps)) / 2)


def _driven(nearby: PeopleNearby, known: NDArray[np.bool_]) -> DrivenPath:
    steps = np.diff(nearby.places, axis=0)[known[1:] & known[:-1]]
    seconds = float(_seconds(nearby.times, known).sum())
    length = float(np.hypot(steps[:, 0], steps[:, 1]).sum())
    turned = float(np.abs(steps[:, 2]).sum() - abs(steps[:, 2].sum()))
    return DrivenPath(
        seconds, length, length / seconds if seconds else None, turned / length if length > 1e-6 else None
    )


def _closeness(nearby: PeopleNearby, name: str, radius: float, weights: Array) -> Closeness:
    place = nearby.people[name]
    nearest = None if nearby.nearest is None else nearby.nearest.get(name)
    distances = np.linalg.norm(nearby.places[:, :2] - place, axis=1)
    seen = np.isfinite(distances)
    if not seen.any():
        return Closeness(None, None, None, None, None, None, _times_in_spaces(distances, weights), None)
    best = int(np.nanargmin(distances))
    clearance = None if nearest is None else np.where(seen, nearest - radius, np.inf)
    touching = None if clearance is None else clearance <= 0
    return Closeness(
        distance=float(distances[best]),
        stamp=int(nearby.times[best]),
        clearance=None if clearance is None or np.isinf(clearance).all() else float(clearance.min()),
        collisions=None if touching is None else int((np.diff(np.append(0, touching)) > 0).sum()),
        contact=None if touching is None else float(weights[touching].sum()),
        time_to_collision=_time_to_collision(nearby, place, radius + PERSON_RADIUS),
        spaces=_times_in_spaces(distances, weights),
        compliance=_compliance(distances, weights),
    )


def _nearest(nearby: PeopleNearby, each: Mapping[str, Closeness], weights: Array) -> Closeness:
    """Closeness to the person who is nearest in each frame. Collisions and contacts with all people count."""
    found = [closeness for closeness in each.values() if closeness.distance is not None]
    tables = [np.linalg.norm(nearby.places[:, :2] - place, axis=1) for place in nearby.people.values()]
    distances = np.fmin.reduce([*tables, np.full(len(weights), np.nan)])
    best = min(found, key=lambda closeness: closeness.distance or 0.0, default=None)
    known = nearby.nearest is not None and all(c.collisions is not None for c in found)
    times = [each.time_to_collision for each in found if each.time_to_collision is not None]
    return Closeness(
        distance=best.distance if best is not None else None,
        stamp=best.stamp if best is not None else None,
        clearance=min((c.clearance for c in found if c.clearance is not None), default=None),
        collisions=sum(c.collisions or 0 for c in found) if known else None,
        contact=sum(c.contact or 0.0 for c in found) if known else None,
        time_to_collision=min(times, default=None),
        spaces=_times_in_spaces(distances, weights),
        compliance=_compliance(distances, weights),
    )


def _times_in_spaces(distances: Array, weights: Array) -> dict[str, float]:
    """Time that the robot is in each space around a person, seconds. Frames without the person do not
    count."""
    numbers = np.searchsorted(list(SPACES.values()), distances, side="right")
    seen = np.isfinite(distances)
    return {
        name: float(weights[seen & (numbers == number)].sum())
        for number, name in enumerate((*SPACES, "public"))
    }


def _compliance(distances: Array, weights: Array) -> float | None:
    seen = np.isfinite(distances)
    total = float(weights[seen].sum())
    return float(weights[seen & (distances > COMPLIANCE)].sum()) / total if total else None


def _time_to_collision(nearby: PeopleNearby, place: Array, reach: float) -> float | None:
    """Smallest time until robot and person would touch. Both are discs; ``reach`` is the sum of their
    radii."""
    relative = place - nearby.places[:, :2]
    seconds = nearby.times * 1e-9
    finite = np.asarray(np.isfinite(relative).all(axis=1))
    least = np.inf
    for run in np.split(np.arange(len(relative)), np.flatnonzero(np.diff(finite)) + 1):
        if not finite[run[0]]:
            continue
        p = relative[run]
        v = np.gradient(p, seconds[run], axis=0) if len(run) > 1 else np.zeros_like(p)
        # |p + v t| = reach
        a, b = (v * v).sum(axis=1), (p * v).sum(axis=1)
        c = (p * p).sum(axis=1) - reach**2
        root = b * b - a * c
        meets = (b < 0) & (root >= 0) & (a > 1e-12)
        with np.errstate(divide="ignore", invalid="ignore"):
            times = np.where(c <= 0, 0.0, np.where(meets, c / (np.sqrt(np.maximum(root, 0)) - b), np.inf))
        least = min(least, float(times.min()))
    return least if np.isfinite(least) else None
