"""Which detections of different cameras show the same person: by the epipolar distance.

The centres of two cameras and a ray of the first span a plane, the epipolar plane. If a ray of the second
camera shows the same point, it lies in this plane. The angle between ray and plane is the epipolar distance.
In an image it is the distance from the epipolar line, in which the plane meets the image; as an angle it is
also right for fisheyes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Fewer joints in common do not decide.
MIN_JOINTS = 4


def epipolar_distances(center_a: Array, rays_a: Array, center_b: Array, rays_b: Array) -> Array:
    """Epipolar distances between the people of two cameras: the median over their joints.

    Args:
        center_a: Centre of camera A, (3,) metres in ``map``.
        rays_a: Unit rays (P, J, 3) of its P people; NaN where a joint is missing.
        center_b: Centre of camera B, (3,).
        rays_b: Unit rays (Q, J, 3) of its Q people.

    Returns:
        Distances (P, Q) in radians; inf for people with fewer than ``MIN_JOINTS`` joints in common.
    """
    baseline = center_b - center_a
    normals_a, normals_b = (_unit(np.cross(baseline, rays)) for rays in (rays_a, rays_b))
    from_a = np.abs(np.einsum("pji,qji->pqj", normals_a, rays_b))
    from_b = np.abs(np.einsum("pji,qji->pqj", rays_a, normals_b))
    return median_of_joints(np.maximum(from_a, from_b))


def median_of_joints(values: Array) -> Array:
    """Median over the last axis without NaN; inf where fewer than ``MIN_JOINTS`` numbers are."""
    enough = np.isfinite(values).sum(axis=-1) >= MIN_JOINTS
    return np.where(enough, np.nanmedian(np.where(enough[..., None], values, 0.0), axis=-1), np.inf)


def group_people(centers: Sequence[Array], rays: Sequence[Array], limit: float) -> list[dict[int, int]]:
    """Group the detections of all cameras into people.

    Each detection begins as a group. Then the two groups with the smallest mean distance are joined, again
    and again, as long as it is below the limit. Groups with a camera in common are not joined.

    Args:
        centers: Centre (3,) of each camera, metres in ``map``.
        rays: Unit rays (P, J, 3) of the people of each camera.
        limit: Largest mean epipolar distance in a group, radians.

    Returns:
        People that at least two cameras show: by index of the camera, the index of the detection.
    """
    detections = [(view, person) for view, people in enumerate(rays) for person in range(len(people))]
    views = np.array([view for view, _ in detections])
    cost = np.full((len(detections), len(detections)), np.inf)
    for a in range(len(rays)):
        for b in range(a + 1, len(rays)):
            of_a, of_b = np.flatnonzero(views == a), np.flatnonzero(views == b)
            if len(of_a) and len(of_b):
                pair = epipolar_distances(centers[a], rays[a], centers[b], rays[b])
                cost[np.ix_(of_a, of_b)] = pair
                cost[np.ix_(of_b, of_a)] = pair.T
    groups = [[index] for index in range(len(detections))]
    while best := _closest(groups, views, cost, limit):
        first, second = best
        groups[first] += groups.pop(second)
    return [dict(detections[index] for index in group) for group in groups if len(group) > 1]


def _closest(
    groups: Sequence[Sequence[int]], views: NDArray[np.intp], cost: Array, limit: float
) -> tuple[int, int] | None:
    """The two groups to join next; None if there are none."""
    found, lowest = None, limit
    for first, group in enumerate(groups):
        for second in range(first + 1, len(groups)):
            other = groups[second]
            if not set(views[group]) & set(views[other]):
                mean = float(cost[np.ix_(group, other)].mean())
                if mean < lowest:
                    found, lowest = (first, second), mean
    return found


def _unit(vectors: Array) -> Array:
    """Unit vectors; NaN for vectors without length: a ray through the other camera has no epipolar plane."""
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.where(lengths > 1e-9, lengths, np.nan)
