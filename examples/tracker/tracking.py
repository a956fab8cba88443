"""The tracker: from 2D detections without identities to people in 3D with identities, frame by frame.

Each frame:

1. The Kalman filter of each person predicts its joints.
2. In each camera, detections are assigned to the predicted people (Hungarian algorithm).
3. Each person takes in its detections: RANSAC finds false joints, the filter is updated by the others.
4. Detections that are left are grouped by epipolar distance; groups become new people.
5. People that nobody has seen for a while are forgotten.

The noise of the detections is not set: it follows from the residuals of triangulation. Detections without
noise are therefore hardly smoothed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from association import MIN_JOINTS, group_people, median_of_joints
from cameras import Camera
from kalman import KalmanFilter
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from triangulation import Rays, ransac

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Settings:
    """Settings of a tracker.

    Attributes:
        epipolar_limit: Largest epipolar distance of detections of one person, radians.
        assignment_limit: Largest distance of a detection's rays from predicted joints (median), metres.
        acceleration: Noise of the acceleration in the Kalman filter, m/s² per root of a hertz.
        max_deviation: Joints with a larger standard deviation are not reported, metres.
        frames_to_confirm: Frames with detections until a person is reported. False people rarely last.
        seconds_to_forget: Time without detections after which a person is forgotten.
        same_person: Two people closer than this (median of the joints) are one person, metres.
    """

    epipolar_limit: float = 0.02
    assignment_limit: float = 0.3
    acceleration: float = 1.5
    max_deviation: float = 0.05
    frames_to_confirm: int = 3
    seconds_to_forget: float = 1.0
    same_person: float = 0.12


@dataclass(frozen=True)
class Detections:
    """People that a detector found in an image.

    Attributes:
        camera: The camera at the time of the image.
        people: Pixels (P, J, 2) of the joints of P people; NaN for joints that were not found.
    """

    camera: Camera
    people: Array


@dataclass(frozen=True)
class Person:
    """A person at a stamp.

    Attributes:
        identity: Number of the person, from 1. Numbers are not used again.
        positions: (J, 3) metres in ``map``; NaN where a joint is not known well enough.
        velocities: (J, 3) m/s; NaN as positions.
    """

    identity: int
    positions: Array
    velocities: Array


class PixelNoise:
    """Standard deviation of detections, pixels, from the residuals of triangulated joints.

    V rays of a joint are 2 V numbers, and its point has 3: the variance is Σ residual² / Σ (2 V - 3).
    """

    #: Known at the start, and at most remembered: degrees of freedom. The least noise, pixels.
    _START, _MEMORY, _LEAST = 1.0, 300.0, 0.02

    def __init__(self, deviation: float = 2.0) -> None:
        self._freedom = self._START
        self._squares = self._START * deviation**2

    @property
    def deviation(self) -> float:
        """Pixels."""
        return max(float(np.sqrt(self._squares / self._freedom)), self._LEAST)

    @property
    def threshold(self) -> float:
        """Residual from which a detection is false, pixels."""
        return float(np.clip(4 * self.deviation, 3.0, 30.0))

    def add(self, residuals: Array, inliers: NDArray[np.bool_]) -> None:
        """Add residuals (V, J) of triangulated joints; those that are not ``inliers`` (V, J) do not count."""
        views = inliers.sum(axis=0)
        counted = inliers & (views >= 2)
        keep = min(1.0, self._MEMORY / self._freedom)
        self._squares = keep * self._squares + float((residuals[counted] ** 2).sum())
        self._freedom = keep * self._freedom + float((2 * views - 3)[views >= 2].sum())


class _Track:
    """A person that is being tracked."""

    def __init__(self, identity: int, state: KalmanFilter, stamp: int) -> None:
        self.identity, self.state = identity, state
        self.seen, self.frames = stamp, 0

    def take(self, rays: Rays, noise: PixelNoise, stamp: int) -> NDArray[np.bool_]:
        """Take in the rays of a frame. Returns the rays (V, J) that are not false."""
        predicted = np.where(self.state.deviations[:, None] < 0.5, self.state.positions, np.nan)
        points, inliers = ransac(rays, noise.threshold, predicted)
        noise.add(rays.residuals(points), inliers & np.isfinite(points[:, 0]))
        around = np.where(np.isfinite(points), points, self.state.positions)
        self.state.update(*rays.equations(around, inliers), noise.deviation)
        if inliers.any():
            self.seen, self.frames = stamp, self.frames + 1
        return inliers

    def report(self, max_deviation: float) -> Person:
        unknown = (self.state.deviations > max_deviation)[:, None]
        positions, velocities = self.state.positions, self.state.velocities
        return Person(
            self.identity, np.where(unknown, np.nan, positions), np.where(unknown, np.nan, velocities)
        )


class Tracker:
    """Tracks several people in several cameras.

    Example:
        >>> tracker = Tracker()
        >>> tracker.update(0, {})
        []
    """

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or Settings()
        self.noise = PixelNoise()
        self._tracks: list[_Track] = []
        self._stamp: int | None = None
        self._created = 0

    def update(self, stamp: int, cameras: Mapping[str, Detections]) -> list[Person]:
        """Track people to the frame of a stamp.

        Args:
            stamp: Nanoseconds, later than that of the frame before.
            cameras: Detections by camera. Cameras may come and go, move, and have other lenses.

        Returns:
            The people of the frame with at least one joint.

        Raises:
            ValueError: The stamp is not later than the last one.
        """
        if self._stamp is not None and stamp <= self._stamp:
            raise ValueError(f"the stamp {stamp} is not later than the last one, {self._stamp}")
        seconds = 0.0 if self._stamp is None else (stamp - self._stamp) * 1e-9
        self._stamp = stamp
        for track in self._tracks:
            track.state.predict(seconds)
        views = [_View(detections) for detections in cameras.values()]
        for track, chosen in zip(self._tracks, self._assign(views), strict=True):
            self._take(track, views, chosen)
        self._create(views)
        self._forget()
        people = [
            track.report(self.settings.max_deviation)
            for track in self._tracks
            if track.frames >= self.settings.frames_to_confirm
        ]
        return [person for person in people if np.isfinite(person.positions).any()]

    def _assign(self, views: Sequence[_View]) -> list[dict[int, int]]:
        """For each track, by index of the view, the index of its detection."""
        chosen: list[dict[int, int]] = [{} for _ in self._tracks]
        for index, view in enumerate(views):
            if not len(view.rays) or not self._tracks:
                continue
            distances = np.array(
                [median_of_joints(view.distances(track.state.positions)) for track in self._tracks]
            )
            limit = self.settings.assignment_limit
            rows, columns = linear_sum_assignment(np.minimum(distances, 2 * limit))
            for row, column in zip(rows, columns, strict=True):
                if distances[row, column] < limit:
                    chosen[row][index] = int(column)
        return chosen

    def _take(self, track: _Track, views: Sequence[_View], chosen: dict[int, int]) -> None:
        """Let a track take in the detections ``chosen``; those that fit it stay with it."""
        if not chosen:
            return
        rays = _rays_of(views, chosen)
        inliers = track.take(rays, self.noise, self._stamp or 0)
        for (view, person), present, used in zip(chosen.items(), rays.present, inliers, strict=True):
            # a detection of somebody else at the same place: it is free for another person
            if 2 * used.sum() >= present.sum():
                views[view].free[person] = False

    def _create(self, views: Sequence[_View]) -> None:
        """Create tracks of the detections that are left."""
        left = [np.flatnonzero(view.free) for view in views]
        centers = [view.center for view in views]
        rays = [view.rays[free] for view, free in zip(views, left, strict=True)]
        for group in group_people(centers, rays, self.settings.epipolar_limit):
            chosen = {view: int(left[view][person]) for view, person in group.items()}
            rays_of_person = _rays_of(views, chosen)
            points, _ = ransac(rays_of_person, self.noise.threshold)
            if np.isfinite(points[:, 0]).sum() < MIN_JOINTS:
                continue
            if any(self._same(points, track) for track in self._tracks):
                continue
            self._created += 1
            state = KalmanFilter(len(points), np.nanmedian(points, axis=0), self.settings.acceleration)
            track = _Track(self._created, state, self._stamp or 0)
            self._tracks.append(track)
            self._take(track, views, chosen)

    def _same(self, points: Array, track: _Track) -> bool:
        distances = np.linalg.norm(points - track.state.positions, axis=-1)
        return bool(median_of_joints(distances) < self.settings.same_person)

    def _forget(self) -> None:
        """Forget tracks that were not seen, and the younger of two tracks of one person."""
        now = self._stamp or 0
        kept: list[_Track] = []
        for track in self._tracks:
            unseen = (now - track.seen) * 1e-9
            confirmed = track.frames >= self.settings.frames_to_confirm
            lost = unseen > self.settings.seconds_to_forget if confirmed else unseen > 0
            if not lost and not any(self._same(track.state.positions, other) for other in kept):
                kept.append(track)
        self._tracks = kept


class _View:
    """The detections of one camera as rays."""

    def __init__(self, detections: Detections) -> None:
        camera = detections.camera
        self.center, self.focal_length = camera.center, camera.focal_length
        self.rays = camera.rays(detections.people)
        self.free = np.ones(len(self.rays), dtype=bool)

    def distances(self, points: Array) -> Array:
        """Distances (P, J) of points (J, 3) from the rays of each person, metres."""
        return np.linalg.norm(np.cross(points - self.center, self.rays), axis=-1)


def _rays_of(views: Sequence[_View], chosen: Mapping[int, int]) -> Rays:
    return Rays(
        np.array([views[view].center for view in chosen]),
        np.array([views[view].rays[person] for view, person in chosen.items()]),
        np.array([views[view].focal_length for view in chosen]),
    )
