"""Keypoints in space from 2D points of calibrated views, some of which are wrong."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera.camera import Camera
from humansim_ros.errors import HumansimWarning, PhotographError, some_of
from humansim_ros.keypoints.sets import KeypointSet
from humansim_ros.photographs.edge_lengths import EdgeLengths, edge_lengths
from humansim_ros.photographs.sides import find_exchanged
from humansim_ros.photographs.sightlines import Candidates, Sightlines
from humansim_ros.photographs.views import PhotoSet
from humansim_ros.types import Array

#: A point that is farther from its place than this share of the size of the person in the image is wrong.
_FARTHEST = 0.3
#: A point is wrong if it is farther than this number of standard deviations of the noise.
_DEVIATIONS = 3.5
#: Least and greatest limit in pixels, so that exact points and points without a person have one.
_LEAST_LIMIT, _ONLY_LIMIT = 1.0, 30.0
#: Median of the squared length of a vector of two standard normal numbers.
_MEDIAN_SQUARE = 2 * np.log(2)
#: Rounds of inliers and least squares, and steps of each.
_ROUNDS, _STEPS = 4, 8
#: Names that a warning lists.
_LISTED = 6


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Keypoints in space, and how the points of V views agree with them.

    Attributes:
        positions: (K, 3) metres in ``map``; NaN where fewer than two views agree.
        inliers: (V, K) the point agrees with the position.
        errors: (V, K) distance in pixels of the point from the image of the position; NaN where one of the
            two is absent, infinite where the position has no image.
        swapped: (V,) the left and the right of the view are exchanged.
        points: (V, K, 3) x, y and confidence as given, but with left and right as they should be.
    """

    positions: Array
    inliers: NDArray[np.bool_]
    errors: Array
    swapped: NDArray[np.bool_]
    points: Array


def triangulate(
    cameras: Sequence[Camera], points: Array, keypoints: KeypointSet, seed: int = 0
) -> Triangulation:
    """Triangulate the keypoints of one person.

    For each keypoint, the lines of sight of all pairs of views are intersected (RANSAC, but exhaustive for
    up to 15 views). The intersection with which most points agree is refined by least squares of distances
    in the images, through the lenses. The limit of agreement follows from the noise of all points.

    Args:
        cameras: V cameras; two or more.
        points: (V, K, 3) x, y in pixels and confidence, which is 0 where a point is absent.
        keypoints: Set of the points.
        seed: Seed of the choice among pairs of very many views.

    Raises:
        PhotographError: There are fewer than two views.

    Example:
        >>> from humansim_ros.camera import Camera
        >>> from humansim_ros.keypoints import keypoint_set
        >>> cameras = [Camera.look_at((3, y, 1), (0, 0, 1)) for y in (-1, 1)]
        >>> body = np.random.default_rng(0).uniform(-0.5, 0.5, (17, 3)) + (0, 0, 1)
        >>> points = np.array([np.column_stack([camera.project(body)[0], np.ones(17)]) for camera in cameras])
        >>> bool(np.allclose(triangulate(cameras, points, keypoint_set("coco17")).positions, body))
        True
    """
    if len(cameras) < 2:
        raise PhotographError(
            "one view only: the place of a point in space needs two views that see it; add a calibrated "
            "photograph from another side"
        )
    given = np.asarray(points, dtype=float)
    lines = Sightlines.of(cameras, given)
    farthest = np.nan_to_num(_FARTHEST * lines.radii, nan=_ONLY_LIMIT).clip(_LEAST_LIMIT)
    swapped = find_exchanged(lines, keypoints, farthest, seed)
    lines = lines.exchanged(swapped, keypoints.mirrored)
    order = np.where(swapped[:, None], keypoints.mirrored, np.arange(len(keypoints)))
    corrected = np.take_along_axis(given, order[..., None], axis=1)
    limits, found, lengths = farthest, lines.candidates(seed), edge_lengths(keypoints)
    for _ in range(_ROUNDS):
        costs = found.costs(limits)
        positions, inliers, errors = _refined(lines, found.best(costs), limits)
        costs = _plausible(costs, found, lengths, positions, inliers)
        positions, inliers, errors = _refined(lines, found.best(costs), limits)
        noise = _noise(errors, inliers)
        limits = np.minimum(farthest, max(_DEVIATIONS * noise, _LEAST_LIMIT))
    return Triangulation(positions, inliers, errors, swapped, corrected)


def triangulate_photos(photos: PhotoSet) -> tuple[Triangulation, ...]:
    """Triangulate the keypoints of all frames.

    A HumansimWarning names the views whose left and right are exchanged, and the keypoints that fewer than
    two views show in any frame.

    Raises:
        PhotographError: There is one view only, or no keypoint is seen by two views.
    """
    if len(photos.names) < 2:
        raise PhotographError(
            f"one view only ({photos.names[0]}): the place of a point in space needs two views that see it; "
            "add a calibrated photograph from another side",
            path=photos.path,
            key="views",
        )
    found = tuple(triangulate(photos.cameras, points, photos.keypoints) for points in photos.points)
    known = np.isfinite([each.positions[:, 0] for each in found])
    if not known.any():
        seen = (photos.points[..., 2] > 0).sum(axis=(0, 2))
        counts = ", ".join(f"{name} {count}" for name, count in zip(photos.names, seen, strict=True))
        raise PhotographError(
            "no keypoint is seen by two views that agree, so that the person has no place; numbers of "
            f"points: {counts}. Check the points, and that the calibration is that of these images",
            path=photos.path,
        )
    frames = defaultdict[str, list[int]](list)
    for number, each in enumerate(found):
        for view in np.flatnonzero(each.swapped):
            frames[photos.names[view]].append(number)
    for name, numbers in frames.items():
        _warn(
            photos,
            f"left and right of the person are exchanged in view {name}, {_frames(numbers, len(found))}: "
            "they are exchanged back",
        )
    if absent := [photos.keypoints.names[k] for k in np.flatnonzero(~known.any(axis=0))]:
        _warn(
            photos,
            f"fewer than two views agree about {', '.join(absent)}: this part of the person is not measured, "
            "and follows from the body and its joint limits",
        )
    if empty := [number for number, own in enumerate(known) if not own.any()]:
        _warn(photos, f"no keypoint has a place in {_frames(empty, len(found))}: the pose there is a guess")
    return found


def _warn(photos: PhotoSet, message: str) -> None:
    warnings.warn(f"{photos.path}: {message}", HumansimWarning, stacklevel=3)


def _frames(numbers: Sequence[int], count: int) -> str:
    """Frames in words: ``frame 3``, ``frames 1, 2, 5``, ``all 7 frames``."""
    if len(numbers) == count > 1:
        return f"all {count} frames"
    return f"frame{'s' if len(numbers) > 1 else ''} {some_of(numbers, _LISTED)}"


def _plausible(
    costs: Array, found: Candidates, lengths: EdgeLengths, positions: Array, inliers: NDArray[np.bool_]
) -> Array:
    """Costs (P, K), infinite where a place is impossible beside its neighbours.

    Two wrong points often agree; three seldom do. Therefore keypoints of three points or more are taken as
    known, and places of the others are checked, from the trunk outwards.

    Args:
        costs: Costs of the candidates, (P, K).
        found: Candidates.
        lengths: Possible lengths of edges.
        positions: Positions (K, 3) of least cost.
        inliers: (V, K) points that agree with them.
    """
    costs, positions = costs.copy(), positions.copy()
    known = inliers.sum(axis=0) >= 3
    waiting = set(np.flatnonzero(~known).tolist()) if known.any() else set()
    while waiting:
        ready = [k for k in sorted(waiting) if known[lengths.neighbours(k)].any()]
        if not ready:
            break
        for keypoint in ready:
            places = found.positions[:, keypoint]
            fits = lengths.fits(keypoint, places, positions, known)
            costs[~fits, keypoint] = np.inf
        best = found.best(costs)
        for keypoint in ready:
            waiting.remove(keypoint)
            positions[keypoint] = best[keypoint]
            known[keypoint] = np.isfinite(best[keypoint]).all()
    return costs


def _refined(lines: Sightlines, start: Array, limits: Array) -> tuple[Array, NDArray[np.bool_], Array]:
    """Least squares of the points within the limits (V,): positions (K, 3), inliers and errors (V, K)."""
    positions = start
    errors = lines.errors(positions)
    inliers = np.zeros(errors.shape, bool)
    for _ in range(_ROUNDS):
        near = np.asarray(np.nan_to_num(errors, nan=np.inf) <= limits[:, None])
        now = near & (near.sum(axis=0) >= 2)
        if np.array_equal(now, inliers):
            break
        inliers = now
        positions = _least_squares(lines, positions, np.where(inliers, lines.weights, 0.0))
        errors = lines.errors(positions)
    measured = np.asarray(inliers.any(axis=0))
    positions = np.where(measured[:, None], positions, np.nan)
    return positions, inliers, np.where(measured, errors, np.nan)


def _least_squares(lines: Sightlines, start: Array, weights: Array) -> Array:
    """Positions (K, 3) with the least sums of squared distances in the images, by Levenberg-Marquardt for
    all keypoints at once. ``weights``: (V, K) of the points; a keypoint without any keeps its position.
    """
    positions = np.array(start)
    damping = np.full(len(positions), 1e-6)
    used = weights > 0

    def residuals(at: Array) -> Array:
        seen = np.stack([camera.project(at)[0] for camera in lines.cameras])
        return np.where(used[..., None], seen - lines.pixels, 0.0)

    errors = residuals(positions)
    costs = np.einsum("vki,vki,vk->k", errors, errors, weights)
    for _ in range(_STEPS):
        slopes = np.stack([camera.project_jacobian(positions) for camera in lines.cameras])
        slopes = np.where(used[..., None, None], slopes, 0.0)
        normal = np.einsum("vkij,vkil,vk->kjl", slopes, slopes, weights)
        right = np.einsum("vkij,vki,vk->kj", slopes, errors, weights)
        scale = np.einsum("kii->k", normal) / 3
        normal += ((damping + 1e-12) * scale + (scale == 0))[:, None, None] * np.eye(3)
        tried = positions - np.linalg.solve(normal, right[..., None])[..., 0]
        errors_tried = residuals(tried)
        costs_tried = np.einsum("vki,vki,vk->k", errors_tried, errors_tried, weights)
        better = costs_tried <= costs  # false where a step has lost the image
        positions = np.where(better[:, None], tried, positions)
        errors = np.where(better[None, :, None], errors_tried, errors)
        costs = np.where(better, costs_tried, costs)
        damping = np.where(better, damping / 10, damping * 100)
    return positions


def _noise(errors: Array, inliers: NDArray[np.bool_]) -> float:
    """Standard deviation of the coordinates of the points in pixels, by the median of the errors.

    n points determine a position, which takes up three of 2 n differences.
    """
    count = inliers.sum(axis=0)
    free = np.where(count >= 2, (2 * count - 3) / np.maximum(2 * count, 1), np.inf)
    squares = (np.square(errors, where=inliers, out=np.zeros_like(errors)) / free)[inliers]
    return float(np.sqrt(np.median(squares) / _MEDIAN_SQUARE)) if len(squares) else 0.0
