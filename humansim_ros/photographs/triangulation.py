"""Triangulate keypoints from 2D points of calibrated views, even if some points are wrong."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import HumansimWarning, PhotographError, some_of
from humansim_ros.geometry import unit_vectors
from humansim_ros.people.keypoints import KeypointLocator, KeypointSet
from humansim_ros.people.loading import load_human
from humansim_ros.photographs.views import PhotoSet, exchanged_back
from humansim_ros.types import Array, Indices

#: Human with the mean proportions.
_HUMAN = "adult_man"
#: Least and greatest length of a bone of a person, as shares of the mean length.
_BONE = (0.65, 1.45)
#: If a joint lies between two keypoints, their greatest distance, as a share of the distance in the rest
#: pose.
_BENT = 1.6
#: Least and greatest size of people, as shares of the mean size.
_SIZES = (0.4, 1.3)
#: Most pairs of views that are tried for one keypoint. If there are more pairs, this number is drawn at
#: random.
_MAX_PAIRS = 100
#: Smallest squared sine of the angle between two lines that meet. Lines at less than 0.6 degrees count as
#: parallel.
_PARALLEL = 1e-4
#: Left and right of a view are exchanged only if this makes at least this number of points agree, and at
#: least this share of the paired points of the view.
_POINTS = 2.0
_SHARE = 0.2
#: The limits are divided by these numbers, because the noise is not known yet, and because left and right are
#: near each other when seen from the side.
_SCALES = (1, 2, 4)
#: Pairs of anatomical points. The first point of a pair is in front of the second on any person.
_IN_FRONT = (
    ("nose", "left_ear"),
    ("nose", "right_ear"),
    ("left_big_toe", "left_heel"),
    ("right_big_toe", "right_heel"),
    ("l_foot_ball", "l_ankle"),
    ("r_foot_ball", "r_ankle"),
    ("jugular_notch", "c7"),
    ("left_asis", "left_psis"),
    ("right_asis", "right_psis"),
    ("left_head_front", "left_head_back"),
)
_SHOULDERS = (("l_shoulder", "r_shoulder"), ("left_acromion", "right_acromion"))
_HIPS = (("l_hip", "r_hip"), ("left_asis", "right_asis"))
#: If the front of the body is at least this far in front of the back, metres, this decides about left and
#: right, against the majority of the views.
_CERTAIN = 0.1
#: Greatest plausible distance between the two points of such a pair, metres.
_FOOT = 0.4
#: A 2D point is wrong if its error is larger than this share of the size of the person in the image.
_FARTHEST = 0.3
#: A 2D point is wrong if its error is larger than this number of standard deviations of the noise.
_DEVIATIONS = 3.5
#: Limit of errors, pixels: least limit (for exact points), and limit if the person's size is unknown.
_LEAST_LIMIT, _ONLY_LIMIT = 1.0, 30.0
#: Median of the squared length of a vector of two standard normal numbers.
_MEDIAN_SQUARE = 2 * np.log(2)
#: Rounds of choosing inliers and least squares; and steps of least squares in each round.
_ROUNDS, _STEPS = 4, 8
#: Most names that a warning lists.
_LISTED = 6


@dataclass(frozen=True, eq=False)
class EdgeLengths:
    """Limits of the lengths of the E edges of a keypoint set, in metres, for a person of mean size.
    ``edges``: (E, 2) keypoints. ``lengths``: (E,) lengths in the rest pose. ``least``, ``greatest``: (E,)
    limits of the lengths in any pose."""

    edges: Indices
    lengths: Array
    least: Array
    greatest: Array

    def size(self, positions: Array, known: NDArray[np.bool_]) -> float:
        """Size of a person as a share of the mean size, from positions (K, 3). ``known``: (K,) whether each
        position is known."""
        rigid = (self.least > 0) & known[self.edges].all(axis=1)
        if not rigid.any():
            return 1.0
        first, second = positions[self.edges[rigid]].transpose(1, 0, 2)
        ratios = np.linalg.norm(first - second, axis=1) / self.lengths[rigid]
        return float(np.clip(np.median(ratios), *_SIZES))

    def neighbours(self, keypoint: int) -> Indices:
        """Keypoints that share an edge with a keypoint."""
        rows = self.edges[(self.edges == keypoint).any(axis=1)]
        return np.asarray(rows.sum(axis=1) - keypoint)

    def fits(
        self, keypoint: int, candidates: Array, positions: Array, known: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Whether places of a keypoint are at a possible distance from all known neighbours.

        Args:
            keypoint: Number of the keypoint.
            candidates: Places (P, 3).
            positions: Positions (K, 3).
            known: (K,) whether the position is certain.

        Returns:
            (P,) whether each place is possible. If no neighbour is known, all are true.
        """
        size = self.size(positions, known)
        fits = np.ones(len(candidates), bool)
        rows = np.flatnonzero((self.edges == keypoint).any(axis=1))
        for row, neighbour in zip(rows, self.neighbours(keypoint), strict=True):
            if known[neighbour]:
                distances = np.linalg.norm(candidates - positions[neighbour], axis=1) / size
                fits &= (self.least[row] <= distances) & (distances <= self.greatest[row])
        return fits


@cache
def edge_lengths(keypoints: KeypointSet) -> EdgeLengths:
    """Limits of the lengths of the edges of a keypoint set. An edge along a bone is rigid; other edges change
    when joints bend."""
    human = load_human(_HUMAN)
    skeleton = human.skeleton
    joints = skeleton.joint_transforms(skeleton.rest)[:, :3, 3]
    at_rest = KeypointLocator.of(human, keypoints).positions(joints, human.mesh.vertices)
    edges = np.array(keypoints.edges, np.intp).reshape(-1, 2)
    lengths = np.linalg.norm(at_rest[edges[:, 0]] - at_rest[edges[:, 1]], axis=1)
    parent_of = dict(zip(skeleton.joint_names, skeleton.joint_parents, strict=True))
    ends = [(keypoints.points[a], keypoints.points[b]) for a, b in edges]
    rigid = np.array([a == parent_of.get(b) or b == parent_of.get(a) for a, b in ends], bool)
    least = np.where(rigid, _BONE[0] * lengths, 0.0)
    return EdgeLengths(edges, lengths, least, np.where(rigid, _BONE[1], _BENT) * lengths)


@dataclass(frozen=True, eq=False)
class Sightlines:
    """Lines from V cameras through the 2D points of K keypoints.

    Attributes:
        cameras: V cameras.
        pixels: (V, K, 2); NaN where a point is absent, or no ray of the lens reaches it.
        weights: (V, K) confidence of the points. 0 where a point is absent.
        directions: (V, K, 3) unit vectors in ``map``.
        radii: (V,) median distance of the points of a view from their middle, in pixels: the size of the
            person in the image. NaN without points.
    """

    cameras: tuple[Camera, ...]
    pixels: Array
    weights: Array
    directions: Array
    radii: Array

    @classmethod
    def of(cls, cameras: Sequence[Camera], points: Array) -> Sightlines:
        """Lines through points (V, K, 3): x, y and confidence, which is 0 where a point is absent."""
        present = (points[..., 2] > 0) & np.isfinite(points[..., :2]).all(axis=-1)
        pixels = np.where(present[..., None], points[..., :2], np.nan)
        rays = np.array([camera.rays(own) @ camera.R for camera, own in zip(cameras, pixels, strict=True)])
        directions = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        reached = np.isfinite(directions).all(axis=-1)
        radii = np.full(len(cameras), np.nan)
        for view in np.flatnonzero(reached.any(axis=1)):
            own = pixels[view, reached[view]]
            radii[view] = np.median(np.linalg.norm(own - np.median(own, axis=0), axis=1))
        pixels, weights = np.where(reached[..., None], pixels, np.nan), np.where(reached, points[..., 2], 0.0)
        return cls(tuple(cameras), pixels, weights, directions, radii)

    def exchanged(self, views: NDArray[np.bool_], partners: Sequence[int]) -> Sightlines:
        """The lines with left and right exchanged in some views. ``views``: (V,). ``partners``: (K,), as
        :attr:`KeypointSet.mirrored`."""
        order = np.where(views[:, None], np.asarray(partners), np.arange(len(partners)))
        pixels, weights, directions = (
            np.take_along_axis(each, order.reshape(*order.shape, *(1,) * (each.ndim - 2)), axis=1)
            for each in (self.pixels, self.weights, self.directions)
        )
        return Sightlines(self.cameras, pixels, weights, directions, self.radii)

    def pairs(self) -> tuple[Indices, Indices]:
        """Numbers of the first and of the second views (P, K) of pairs of views that see a keypoint. Unused
        rows are filled up with 0. If there are many pairs, some are drawn, the same in each call."""
        rng = np.random.default_rng(0)
        found = []
        for seen in (self.weights > 0).T:
            own = np.array(list(combinations(np.flatnonzero(seen), 2)), np.intp).reshape(-1, 2)
            if len(own) > _MAX_PAIRS:
                own = own[np.sort(rng.choice(len(own), _MAX_PAIRS, replace=False))]
            found.append(own)
        pairs = np.zeros((max(map(len, found), default=0), len(found), 2), np.intp)
        for keypoint, own in enumerate(found):
            pairs[: len(own), keypoint] = own
        return pairs[..., 0], pairs[..., 1]

    def meet(self, first: Indices, second: Indices) -> Array:
        """Intersect the lines of pairs of views (P, K). Returns the points (P, K, 3) halfway between the
        lines where these are nearest. A point is NaN if the lines are parallel, or nearest behind a
        camera."""
        centers = np.array([camera.center for camera in self.cameras])
        keypoint = np.arange(self.weights.shape[1])
        a, b = self.directions[first, keypoint], self.directions[second, keypoint]
        offset = centers[second] - centers[first]
        along_a, along_b, cosine = (
            np.einsum("pki,pki->pk", left, right) for left, right in ((offset, a), (offset, b), (a, b))
        )
        with np.errstate(all="ignore"):
            square = 1 - cosine**2
            far_a, far_b = (along_a - cosine * along_b) / square, (cosine * along_a - along_b) / square
            meet = (square > _PARALLEL) & (far_a > 0) & (far_b > 0)
        points = centers[first] + far_a[..., None] * a + centers[second] + far_b[..., None] * b
        return np.where(meet[..., None], points / 2, np.nan)

    def errors(self, positions: Array) -> Array:
        """Distances (..., V, K) in pixels between the points and the images of positions (..., K, 3). A
        distance is infinite if the point is present but the position has no pixel. It is NaN if the point is
        absent."""
        flat = positions.reshape(-1, 3)
        shape = positions.shape[:-1]
        seen = np.stack([camera.project(flat)[0].reshape(*shape, 2) for camera in self.cameras], axis=-3)
        distances = np.linalg.norm(seen - self.pixels, axis=-1)
        return np.where(self.weights > 0, np.where(np.isfinite(distances), distances, np.inf), np.nan)

    def candidates(self) -> Candidates:
        """Intersect the lines of all pairs of views."""
        positions = self.meet(*self.pairs())
        return Candidates(positions, self.errors(positions), self.weights)


@dataclass(frozen=True, eq=False)
class Candidates:
    """Possible positions of K keypoints, from P pairs of views. ``positions``: (P, K, 3), NaN where lines do
    not meet. ``errors``: (P, V, K) pixels. ``weights``: (V, K)."""

    positions: Array
    errors: Array
    weights: Array

    def costs(self, limits: Array) -> Array:
        """Costs (P, K) of the positions. Each 2D point adds its confidence times min(1, (error / limit of its
        view)^2). ``limits``: (V,) pixels."""
        shares = np.minimum(np.nan_to_num(self.errors, nan=0.0, posinf=1e9) / limits[:, None], 1.0) ** 2
        return np.asarray(np.einsum("pvk,vk->pk", shares, self.weights))

    def best(self, costs: Array) -> Array:
        """Positions (K, 3) with the least cost (P, K). A position is NaN if no two lines meet, or all costs
        are infinite."""
        if not len(costs):
            return np.full((self.weights.shape[1], 3), np.nan)
        chosen, keypoint = np.argmin(costs, axis=0), np.arange(costs.shape[1])
        possible = np.isfinite(costs[chosen, keypoint])
        return np.where(possible[:, None], self.positions[chosen, keypoint], np.nan)

    def supported(self, costs: Array, limits: Array) -> Array:
        """Positions (K, 3) of :meth:`best`; NaN unless at least three 2D points agree with the position. If
        there are at most three views, two points are enough."""
        if not len(costs):
            return self.best(costs)
        chosen, keypoint = np.argmin(costs, axis=0), np.arange(costs.shape[1])
        errors = self.errors[chosen, :, keypoint]
        agree = (np.nan_to_num(errors, nan=np.inf) <= limits).sum(axis=1)
        enough = agree >= min(3, max(2, len(limits) - 1))
        return np.where(enough[:, None], self.best(costs), np.nan)


def find_exchanged(lines: Sightlines, keypoints: KeypointSet, limits: Array) -> NDArray[np.bool_]:
    """Find the views in which left and right are exchanged. Returns a mask (V,).

    Left and right of a view are exchanged if more points then agree with the other views. If the views do not
    show which of them are right, or if all views agree, the front of the body decides: the nose is in front
    of the ears, and the toes are in front of the heels.

    Args:
        lines: Lines of sight of all views.
        keypoints: Keypoint set of the points.
        limits: Largest errors (V,) in pixels of correct points, by view.
    """
    partners = keypoints.mirrored

    def cost(views: NDArray[np.bool_]) -> tuple[Array, float]:
        found = lines.exchanged(views, partners).candidates()
        costs = np.mean([found.costs(limits / scale) for scale in _SCALES], axis=0)
        return found.supported(costs, limits / 2), float(costs.min(axis=0, initial=len(limits)).sum())

    exchanged = np.zeros(len(lines.cameras), bool)
    # leave out points with an absent partner, since an exchange must not change which views see a keypoint
    lines = replace(lines, weights=np.where(lines.weights[:, list(partners)] > 0, lines.weights, 0.0))
    paired = np.asarray(partners) != np.arange(len(partners))
    weights = lines.weights[:, paired].sum(axis=1)
    candidates = np.flatnonzero(weights > 0)
    if not len(candidates):
        return exchanged
    positions, present = cost(exchanged)
    while present > _POINTS:
        trials = [exchanged ^ (np.arange(len(exchanged)) == view) for view in candidates]
        results = [cost(trial) for trial in trials]
        best = int(np.argmin([total for _, total in results]))
        if present - results[best][1] < max(_POINTS, _SHARE * weights[candidates[best]]):
            break
        exchanged, (positions, present) = trials[best], results[best]
    side = np.sign(len(candidates) / 2 - exchanged[candidates].sum())
    ahead = front_distance(positions, keypoints)
    if side == 0 or abs(ahead) > _CERTAIN:
        side = np.sign(ahead)
    if side < 0:
        exchanged[candidates] ^= True
    return exchanged


def front_distance(positions: Array, keypoints: KeypointSet) -> float:
    """Metres by which the front of the body is in front of its back, if left and right are as named.
    ``positions``: (K, 3), NaN where unknown. Returns the sum of all distances. It is negative if left and
    right are exchanged, and 0 if the points do not show it, or contradict each other."""
    pairs = zip(keypoints.points, positions, strict=True)
    by_point = {point: position for point, position in pairs if np.isfinite(position).all()}
    shoulders, hips = (
        next(((by_point[a], by_point[b]) for a, b in options if a in by_point and b in by_point), None)
        for options in (_SHOULDERS, _HIPS)
    )
    steps = [by_point[a] - by_point[b] for a, b in _IN_FRONT if a in by_point and b in by_point]
    if shoulders is None or hips is None:
        return 0.0
    left = shoulders[0] - shoulders[1] + hips[0] - hips[1]
    up = shoulders[0] + shoulders[1] - hips[0] - hips[1]
    front = unit_vectors(np.cross(left, up))
    ahead = [float(step @ front) for step in steps if np.linalg.norm(step) < _FOOT]
    return sum(ahead) if min(ahead, default=0) * max(ahead, default=0) > 0 else 0.0


@dataclass(frozen=True, eq=False)
class Triangulation:
    """Keypoints in space, and how the points of V views agree with them.

    Attributes:
        positions: (K, 3) metres in ``map``; NaN where fewer than two views agree.
        inliers: (V, K) whether each point agrees with the position.
        errors: (V, K) distance in pixels between the point and the projected position. NaN if the point or
            the position is absent. Infinite if the position has no projection.
        swapped: (V,) whether left and right of each view are exchanged.
        points: (V, K, 3) x, y and confidence as given, but with left and right exchanged back.
    """

    positions: Array
    inliers: NDArray[np.bool_]
    errors: Array
    swapped: NDArray[np.bool_]
    points: Array


def triangulate(cameras: Sequence[Camera], points: Array, keypoints: KeypointSet) -> Triangulation:
    """Triangulate the keypoints of one person.

    For each keypoint, the lines of sight of all pairs of views are intersected (RANSAC, but exhaustive for up
    to 15 views). The intersection with which most points agree is refined by least squares of distances in
    the images, through the lenses. Points agree within a limit that follows from the noise of all points.

    Args:
        cameras: V cameras; two or more.
        points: (V, K, 3) x, y in pixels and confidence, which is 0 where a point is absent.
        keypoints: Set of the points.

    Raises:
        PhotographError: There are fewer than two views.

    Example:
        >>> from humansim_ros.cameras import Camera
        >>> from humansim_ros.people import keypoint_set
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
    swapped = find_exchanged(lines, keypoints, farthest)
    lines = lines.exchanged(swapped, keypoints.mirrored)
    limits, found, lengths = farthest, lines.candidates(), edge_lengths(keypoints)
    for _ in range(_ROUNDS):
        costs = found.costs(limits)
        positions, inliers, errors = _refined(lines, found.best(costs), limits)
        costs = _plausible(costs, found, lengths, positions, inliers)
        positions, inliers, errors = _refined(lines, found.best(costs), limits)
        noise = noise_of(errors, inliers)
        limits = np.minimum(farthest, max(_DEVIATIONS * noise, _LEAST_LIMIT))
    return Triangulation(positions, inliers, errors, swapped, exchanged_back(given, swapped, keypoints))


def triangulate_photos(photos: PhotoSet) -> tuple[Triangulation, ...]:
    """Triangulate the keypoints of all frames.

    A HumansimWarning names the views in which left and right are exchanged, and the keypoints that fewer than
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
            f"points: {counts}. Check the points, and that the calibration belongs to these images",
            path=photos.path,
        )
    frames = defaultdict[str, list[int]](list)
    for number, each in enumerate(found):
        for view in np.flatnonzero(each.swapped):
            frames[photos.names[view]].append(number)
    for name, numbers in frames.items():
        shown = _frames(numbers, len(found))
        text = f"left and right of the person are exchanged in view {name}, {shown}: they are exchanged back"
        _warn(photos, text)
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
    """Return the costs (P, K), but infinity for positions at an impossible distance from their neighbours.

    Two wrong points often agree, but three seldom do. Therefore a keypoint with three or more points counts
    as known. The positions of the other keypoints are checked, from the trunk outwards.

    ``lengths``: possible lengths of edges. ``positions``: positions (K, 3) of least cost. ``inliers``: (V, K)
    points that agree with them.
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
    """Refine positions by least squares of the points within the limits (V,). Returns positions (K, 3),
    inliers and errors (V, K)."""
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
    """Positions (K, 3) with the least sums of squared distances in the images, by Levenberg-Marquardt for all
    keypoints at once. ``weights``: (V, K) weights of the points. A keypoint without a weight keeps its
    position."""
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
        better = costs_tried <= costs  # False if the step moves a keypoint out of the image
        positions = np.where(better[:, None], tried, positions)
        errors = np.where(better[None, :, None], errors_tried, errors)
        costs = np.where(better, costs_tried, costs)
        damping = np.where(better, damping / 10, damping * 100)
    return positions


def noise_of(errors: Array, inliers: NDArray[np.bool_]) -> float:
    """Standard deviation of the coordinates of the 2D points, pixels, from the median of the errors. It is
    corrected, since n points have 2 n coordinates, and a position is fitted to them with 3 numbers."""
    count = inliers.sum(axis=0)
    free = np.where(count >= 2, (2 * count - 3) / np.maximum(2 * count, 1), np.inf)
    squares = (np.square(errors, where=inliers, out=np.zeros_like(errors)) / free)[inliers]
    return float(np.sqrt(np.median(squares) / _MEDIAN_SQUARE)) if len(squares) else 0.0
