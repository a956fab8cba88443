"""Fit poses and proportions of a body to 2D points: robust nonlinear least squares over all frames at once.

The unknowns are the numbers of :class:`~humansim_ros.photographs.pose_model.PoseModel`: pose numbers of each
frame, and one set of proportions. A prior of small accelerations couples neighbouring frames, so the normal
equations are a band matrix with a border for the proportions. Therefore the time of a Levenberg-Marquardt
step grows only linearly with the number of frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera import Camera
from humansim_ros.geometry import fit_similarity, from_y_axis, quaternion_to_matrix, unit_vectors
from humansim_ros.people.humans import Human
from humansim_ros.photographs.person_fit import PersonFit, with_proportions
from humansim_ros.photographs.pose_model import Attachments, BodyState, PoseModel, plain_name
from humansim_ros.types import Array, Indices

#: Points that are farther away than this number of standard deviations of their noise count less and less.
_ROBUST = 2.5
#: Least standard deviation of points, pixels.
LEAST_NOISE = 0.5
#: Standard deviation of rotations from the rest pose, radians, by bone name without side. For other bones,
#: _USUAL.
_STIFFNESS = {
    "HumanoidRoot_to_hip": 0.03,
    "sacroiliac": 0.15,
    "vl5": 0.3,
    "vl5_to_sternoclavicular": 0.1,
    "sternoclavicular": 0.15,
    "wrist": 0.3,
    "ankle": 0.3,
}
_USUAL = 1.5
#: Bones that turn slowly, by name without side.
_TRUNK = frozenset(_STIFFNESS) - {"wrist", "ankle"} | {"HumanoidRoot", "vt3"}
#: Standard deviation of the proportions: logarithms of stature and of lengths relative to it.
_STATURE_SPREAD, _LENGTH_SPREAD = 0.3, 0.1
#: Standard deviation of logarithms of girths. Only outlines determine girths.
_GIRTH_SPREAD = 0.2
#: Greatest logarithms of statures, lengths and girths of people, children and clothes included, relative to
#: the mean; and standard deviation of values beyond these limits.
STATURE_LIMIT, LENGTH_LIMIT, GIRTH_LIMIT, _BEYOND_SHAPE = 0.9, 0.35, 0.55, 0.02
#: Standard deviations for a bone that no point shows: logarithm of its length, and its rotation in radians.
_HELD_LENGTH, _HELD_TURN = 0.03, 0.3
#: Standard deviation of the angle of a joint beyond its limit, radians.
_BEYOND = 0.02
#: Standard deviations of accelerations: of the place, metres per second squared; of trunk and limbs, radians
#: per second squared.
_ACCELERATION, _TURN, _SWING = 3.0, 8.0, 30.0
#: Most steps of least squares, and most rounds in which joints beyond their limits are pulled back.
_STEPS, _LIMIT_ROUNDS = 40, 4
#: Longest step of one pose number, metres or radians, since a larger step can end in another minimum.
_LONGEST_STEP = 0.5
#: The standard deviations of accelerations are first multiplied by these factors, one solution after the
#: other. If the last solution is a wrong minimum, the next sequence of factors is tried. A minimum is wrong
#: if its cost is above this multiple of the cost of the frames at the start.
_SLACKS = ((30.0, 5.0), (300.0, 100.0, 30.0, 10.0, 3.0), ())
_WRONG = 5.0
#: Bones below a hinge joint (elbow, knee), each with the bone above; turns that are tried of the bone above;
#: and by how much, radians, a turn must bring joints closer to their limits.
_HINGES = tuple(
    (f"{s}_{upper}", f"{s}_{lower}")
    for s in "lr"
    for upper, lower in (("shoulder", "elbow"), ("hip", "knee"))
)
_TURNS, _BETTER = 24, 0.1
#: A joint is beyond its limit if the cosine of half the angle beyond it differs from 1 by more than this.
_SLIGHTLY = 1e-5


@dataclass(frozen=True, eq=False)
class Sight:
    """Points of one frame in V views.

    Attributes:
        cameras: V cameras.
        pixels: (V, K, 2) given points.
        weights: (V, K) confidence; 0 for points that do not count.
        places: (K, 3) triangulated positions in ``map``. NaN where there is none.
        edges: Points of the skin that should move to the outlines of masks. None without masks.
    """

    cameras: Sequence[Camera]
    pixels: Array
    weights: Array
    places: Array
    edges: EdgePoints | None = None


@dataclass(frozen=True, eq=False)
class EdgePoints:
    """Points of the skin, each with a line in an image that it should reach.

    Attributes:
        points: N points.
        views: (N,) number of the view of each point.
        normals: (N, 2) unit vectors across the lines.
        offsets: (N,) places of the lines: ``normals @ pixel``.
        noise: (N,) their standard deviation, pixels.
    """

    points: Attachments
    views: Indices
    normals: Array
    offsets: Array
    noise: Array


@dataclass(frozen=True)
class Settings:
    """Settings of a fit.

    Attributes:
        noise: Standard deviation of the points, pixels.
        free_shape: Whether the proportions are fitted as well.
        period: Seconds between frames. If 0, there is no prior of small accelerations.
        limited: Whether joints stay within their limits.
        tolerance: The steps end when the relative change of the cost is below this.
    """

    noise: float
    free_shape: bool = True
    period: float = 0.0
    steps: int = _STEPS
    limited: bool = True
    tolerance: float = 1e-5


def first_state(model: PoseModel, places: Array) -> BodyState:
    """Turn, move and scale the rest pose onto triangulated keypoints (K, 3) [Umeyama 1991]. The trunk counts
    most, because the limbs of the person are not in the rest pose. NaN stands for absent keypoints."""
    rest = model.keypoints(model.neutral())
    known = np.isfinite(places[:, 0])
    weights = np.where(model.on_trunk, 1.0, 0.05) * known
    if known.sum() < 3:
        return replace(model.neutral(), position=places[known].mean(axis=0) if known.any() else np.zeros(3))
    target = np.where(known[:, None], places, 0.0)
    scale = float(np.clip(relative_size(model, places), 0.4, 2.0))
    _, turn, shift = fit_similarity(rest, target, weights, scale)
    position = scale * turn @ model.skeleton.heads[0] + shift
    return replace(model.neutral(), root=turn, position=position, stature=float(np.log(scale)))


def relative_size(model: PoseModel, places: Array) -> float:
    """Size of a person with triangulated keypoints (K, 3) relative to the model. NaN if there are fewer than
    three keypoints. Lengths of the trunk count most, because they depend least on the pose of the limbs."""
    known = np.isfinite(places[:, 0])
    if known.sum() < 3:
        return float("nan")
    weights = np.where(model.on_trunk, 1.0, 0.05)[known]

    def spread(points: Array) -> float:
        return float(weights @ np.square(points - weights @ points / weights.sum()).sum(axis=1))

    return float(np.sqrt(spread(places[known]) / max(spread(model.keypoints(model.neutral())[known]), 1e-12)))


def fit_poses(
    model: PoseModel, states: Sequence[BodyState], sights: Sequence[Sight], settings: Settings
) -> list[BodyState]:
    """Fit the states of F frames to the points of their views. All frames share one set of proportions, which
    starts from the first state.

    Joints beyond their limits (:mod:`humansim_ros.motion.pose.limits`) are pulled back to them.

    Args:
        model: Model of the body.
        states: A first guess of each frame.
        sights: Points of each frame.
        settings: Settings of the fit.
    """
    if settings.period <= 0:
        return _fitted(model, states, sights, settings)
    problem, solutions = _Problem(model, sights, settings), []
    for slacks in _SLACKS:
        solutions.append(_fitted(model, states, sights, settings, slacks))
        if problem.cost(solutions[-1]) < _WRONG * problem.cost_of_frames(states):
            break
    return min(solutions, key=problem.cost)


def _fitted(
    model: PoseModel,
    states: Sequence[BodyState],
    sights: Sequence[Sight],
    settings: Settings,
    slacks: Sequence[float] = (),
) -> list[BodyState]:
    problem, found = _Problem(model, sights, settings), list(states)
    # frames next to each other may have the same pose, but different twists; align them in steps, with loose
    # limits of acceleration at first
    for problem.slack in slacks:
        found = problem.solve(found, 1e-3)
    problem.slack = 1.0
    found = problem.solve(found)
    for _ in range(_LIMIT_ROUNDS if settings.limited and model.limits is not None else 0):
        if not problem.hold_limits(found):
            break
        found = problem.solve(found)
    return found


def fit_places(model: PoseModel, state: BodyState, places: Array) -> BodyState:
    """Fit pose and proportions of one frame to triangulated keypoints, as a first guess. ``places``:
    positions (K, 3) of the keypoints, NaN where there is none."""
    sight = Sight((), np.zeros((0, len(places), 2)), np.zeros((0, len(places))), places)
    return fit_poses(model, [state], [sight], Settings(0.0, limited=False, tolerance=1e-2))[0]


class _Problem:
    """The least-squares problem of one fit: its cost, its equations, and its solution."""

    def __init__(self, model: PoseModel, sights: Sequence[Sight], settings: Settings) -> None:
        self.model, self.sights, self.settings = model, sights, settings
        self.slack = 1.0  # factor of the standard deviations of accelerations
        spreads = np.array([_STIFFNESS.get(plain_name(name), _USUAL) for name in model.skeleton.names])
        used = [np.isfinite(sight.places[:, 0]) | (sight.weights > 0).any(axis=0) for sight in sights]
        turned, lengthened = model.shown(np.any(used, axis=0))
        spreads = np.where(turned, spreads, np.minimum(spreads, _HELD_TURN))[1:]
        self._has_edges = any(sight.edges is not None for sight in sights)
        groups, girths = len(model.groups), len(model.girths)
        lengths = np.where(lengthened, _LENGTH_SPREAD, _HELD_LENGTH)
        self._shape_spreads = np.r_[_STATURE_SPREAD, lengths, np.full(girths, _GIRTH_SPREAD)]
        self._shape_limits = np.repeat([STATURE_LIMIT, LENGTH_LIMIT, GIRTH_LIMIT], [1, groups, girths])
        # the cost of the rotation vectors v of a frame and bone is v^T P v - 2 h^T v + c, with P, h, c:
        frames, bones = len(sights), len(spreads)
        self._pulls = np.tile(np.eye(3) / spreads[:, None, None] ** 2, (frames, 1, 1, 1))
        self._heads = np.zeros((frames, bones, 3))
        self._constants = np.zeros(frames)

    def hold_limits(self, states: Sequence[BodyState]) -> bool:
        """From now on, pull back all joints beyond their limits. Returns False if there is none."""
        assert self.model.limits is not None
        rotations = np.array([self.model.rotations(state) for state in states])
        clamped = self.model.limits.clamp(rotations)
        beyond = 1 - np.abs((clamped * rotations).sum(-1))[:, 1:] > _SLIGHTLY
        for frame, bone in zip(*np.nonzero(beyond), strict=True):
            own = states[frame].vectors[bone + 1]
            goal = _nearest(Rotation.from_quat(clamped[frame, bone + 1]).as_rotvec(), own)
            direction = unit_vectors(goal - own)
            at = float(direction @ goal)
            self._pulls[frame, bone] += np.outer(direction, direction) / _BEYOND**2
            self._heads[frame, bone] += at * direction / _BEYOND**2
            self._constants[frame] += at**2 / _BEYOND**2
        return bool(beyond.any())

    def solve(self, states: list[BodyState], tolerance: float | None = None) -> list[BodyState]:
        """Minimise the cost by Levenberg-Marquardt, starting from some states. Returns the new states. If
        ``tolerance`` is None, the tolerance of the settings is used."""
        tolerance = self.settings.tolerance if tolerance is None else tolerance
        cost, damping = self.cost(states), 1e-3
        for _ in range(self.settings.steps):
            equations = self._equations(states)
            for _ in range(8):
                try:
                    tried = self._moved(states, equations.solve(damping))
                    new = self.cost(tried)
                except np.linalg.LinAlgError:  # the damping is too small for the precision of numbers
                    new = np.inf
                if new < cost:
                    break
                damping = max(damping * 8, 1e-6)
            else:
                return states
            done = cost - new < tolerance * cost
            states, cost, damping = tried, new, damping / 4
            if done:
                return states
        return states

    def _moved(self, states: Sequence[BodyState], step: Array) -> list[BodyState]:
        size, count = self.model.pose_size, len(states)
        # no person is a tenth of another one, so steps are clipped, and a wild step cannot overflow
        steps = np.clip(step[: size * count].reshape(count, size), -_LONGEST_STEP, _LONGEST_STEP)
        shape = np.clip(step[size * count :], -0.3, 0.3)
        return [
            self.model.moved(state, np.concatenate([own, shape]))
            for state, own in zip(states, steps, strict=True)
        ]

    def _points(self, sight: Sight, positions: Array) -> tuple[Array, Array]:
        """Residuals (N, d) of the points of a frame in standard deviations, and their weights (N,)."""
        if not sight.cameras:
            known = np.isfinite(sight.places[:, 0])
            return (positions - sight.places)[known] / 0.02, np.ones(int(known.sum()))
        seen = np.stack([camera.project(positions)[0] for camera in sight.cameras])
        used = sight.weights > 0
        residuals = (seen - sight.pixels)[used] / max(self.settings.noise, LEAST_NOISE)
        # a point without an image counts as far away from its place
        return np.nan_to_num(residuals, nan=1e3), sight.weights[used]

    def _slopes(self, sight: Sight, positions: Array, slopes: Array) -> Array:
        """Derivatives (N, d, size) of the residuals of the points by the numbers. ``slopes``: derivatives (N,
        3, size) of the positions."""
        if not sight.cameras:
            return slopes[np.isfinite(sight.places[:, 0])] / 0.02
        used = sight.weights > 0
        noise = max(self.settings.noise, LEAST_NOISE)
        parts = []
        for camera, row in zip(sight.cameras, used, strict=True):
            if row.any():
                by_place = np.nan_to_num(camera.project_jacobian(positions[row])) / noise
                parts.append(by_place @ slopes[row])
        return np.concatenate(parts) if parts else np.zeros((0, 2, slopes.shape[-1]))

    def cost(self, states: Sequence[BodyState]) -> float:
        """Cost of some states."""
        smoothness = (self._accelerations(states) ** 2).sum() if self._smooth(states) else 0.0
        return self.cost_of_frames(states) + float(smoothness)

    def cost_of_frames(self, states: Sequence[BodyState]) -> float:
        """Cost of some states without their accelerations."""
        cost = 0.0
        for number, (state, sight) in enumerate(zip(states, self.sights, strict=True)):
            residuals, weights = self._points(sight, self.model.keypoints(state))
            squares = (residuals**2).sum(axis=1)
            cost += float(weights @ _robust_cost(squares))
            if sight.edges is not None:
                squares = self._edge_distances(sight, self.model.positions(state, sight.edges.points))[0] ** 2
                cost += float(_robust_cost(squares).sum())
            vectors = state.vectors[1:]
            cost += float(np.einsum("bi,bij,bj->", vectors, self._pulls[number], vectors))
            cost += float(self._constants[number] - 2 * (self._heads[number] * vectors).sum())
        shape = states[0].shape
        cost += float(((shape / self._shape_spreads) ** 2).sum())
        cost += float(((self._beyond_limits(shape) / _BEYOND_SHAPE) ** 2).sum())
        return cost

    def _beyond_limits(self, shape: Array) -> Array:
        """How far the numbers of the proportions are beyond their limits, with sign; 0 within the limits."""
        return np.asarray(shape - np.clip(shape, -self._shape_limits, self._shape_limits))

    @staticmethod
    def _edge_distances(sight: Sight, positions: Array) -> tuple[Array, Array]:
        """Distances (N,) of points from their lines in standard deviations, and derivatives (N, 3) of the
        distances by the positions. Both are 0 for points without an image."""
        edges = sight.edges
        assert edges is not None
        distances, slopes = np.zeros(len(positions)), np.zeros((len(positions), 3))
        for view, camera in enumerate(sight.cameras):
            own = edges.views == view
            seen = np.einsum("ni,ni->n", edges.normals[own], camera.project(positions[own])[0])
            distances[own] = seen - edges.offsets[own]
            by_place = camera.project_jacobian(positions[own])
            slopes[own] = np.einsum("ni,nij->nj", edges.normals[own], by_place)
        distances, slopes = distances / edges.noise, slopes / edges.noise[:, None]
        unseen = ~np.isfinite(distances)
        distances[unseen], slopes[unseen] = 0.0, 0.0
        return distances, slopes

    def _edge_equations(self, state: BodyState, sight: Sight) -> tuple[Array, Array]:
        """Normal equations (size, size), (size,) of the points that should reach outlines, in one frame."""
        assert sight.edges is not None
        positions, by_number = self.model.derivatives(state, sight.edges.points)
        distances, by_place = self._edge_distances(sight, positions)
        rows = np.einsum("nj,njs->ns", by_place, by_number)
        weighted = rows / np.sqrt(1 + distances**2 / _ROBUST**2)[:, None]
        return weighted.T @ rows, weighted.T @ distances

    def _smooth(self, states: Sequence[BodyState]) -> bool:
        return self.settings.period > 0 and len(states) > 2

    def _acceleration_spreads(self) -> Array:
        """Standard deviations (pose_size,) of second differences."""
        trunk = np.array([plain_name(name) in _TRUNK for name in self.model.skeleton.names])
        turns = np.repeat(np.where(trunk, _TURN, _SWING), 3)
        spread = np.r_[np.full(3, _ACCELERATION), turns]
        return np.asarray(spread * self.settings.period**2 * self.slack)

    def _accelerations(self, states: Sequence[BodyState]) -> Array:
        """Second differences (F - 2, pose_size) in standard deviations."""
        places = np.array([state.position for state in states])
        turns = Rotation.from_matrix([state.root for state in states])
        between = (turns[:-1].inv() * turns[1:]).as_rotvec()
        vectors = np.array([state.vectors[1:].ravel() for state in states])
        differences = np.hstack([np.diff(places, axis=0), between, np.diff(vectors, axis=0)])
        return np.asarray(np.diff(differences, axis=0) / self._acceleration_spreads())

    def _equations(self, states: Sequence[BodyState]) -> _Equations:
        """Normal equations at the states."""
        size, count = self.model.pose_size, len(states)
        extra = self.model.size - size
        groups = len(self.model.groups)
        free = np.full(extra, self.settings.free_shape)
        free[1 + groups :] &= self._has_edges
        equations = _Equations(count, size, free, self._smooth(states))
        for number, (state, sight) in enumerate(zip(states, self.sights, strict=True)):
            positions, slopes = self.model.derivatives(state)
            residuals, weights = self._points(sight, positions)
            by_number = self._slopes(sight, positions, slopes)
            robust = weights / np.sqrt(1 + (residuals**2).sum(axis=1) / _ROBUST**2)
            rows = by_number.reshape(-1, self.model.size)
            weighted = rows * np.repeat(robust, residuals.shape[1])[:, None]
            matrix, right = weighted.T @ rows, weighted.T @ residuals.ravel()
            if sight.edges is not None:
                own_matrix, own_right = self._edge_equations(state, sight)
                matrix, right = matrix + own_matrix, right + own_right
            pulls, vectors = self._pulls[number], state.vectors[1:]
            for bone, pull in enumerate(pulls):
                matrix[6 + 3 * bone : 9 + 3 * bone, 6 + 3 * bone : 9 + 3 * bone] += pull
            right[6:size] += (np.einsum("bij,bj->bi", pulls, vectors) - self._heads[number]).ravel()
            equations.add_frame(number, matrix, right)
        shape = states[0].shape
        beyond = self._beyond_limits(shape)
        prior = 1 / self._shape_spreads**2
        equations.add_shape(
            prior + (beyond != 0) / _BEYOND_SHAPE**2, prior * shape + beyond / _BEYOND_SHAPE**2
        )
        if self._smooth(states):
            spread = self._acceleration_spreads()
            equations.add_accelerations(self._accelerations(states) / spread, 1 / spread**2)
        return equations


def _robust_cost(squares: Array) -> Array:
    """Costs of squared residuals, which grow linearly with large residuals."""
    return np.asarray(2 * _ROBUST**2 * (np.sqrt(1 + squares / _ROBUST**2) - 1))


class _Equations:
    """Symmetric linear equations: a band of F blocks for the poses, and a border for the proportions."""

    def __init__(self, count: int, size: int, free: NDArray[np.bool_], coupled: bool) -> None:
        """Make empty equations. ``free``: (E,) whether each number of the proportions is an unknown."""
        self._count, self._size, self._free = count, size, free
        extra = len(free)
        width = 3 * size if coupled else size
        self._band = np.zeros((width, count * size))  # lower form of scipy: band[i - j, j] = a[i, j]
        self._border = np.zeros((count * size, extra))
        self._corner = np.zeros((extra, extra))
        self._right = np.zeros(count * size)
        self._right_shape = np.zeros(extra)

    def add_frame(self, number: int, matrix: NDArray[np.float64], right: NDArray[np.float64]) -> None:
        """Add the equations of one frame. The order of their unknowns is: pose numbers, then proportions."""
        size, start = self._size, number * self._size
        for diagonal in range(size):
            values = np.diagonal(matrix[:size, :size], -diagonal)
            self._band[diagonal, start : start + size - diagonal] += values
        self._border[start : start + size] += matrix[:size, size:]
        self._corner += matrix[size:, size:]
        self._right[start : start + size] += right[:size]
        self._right_shape += right[size:]

    def add_shape(self, prior: Array, right: Array) -> None:
        """Add a prior of the proportions."""
        self._corner[np.diag_indices_from(self._corner)] += prior
        self._right_shape += right

    def add_accelerations(self, slopes: Array, weights: Array) -> None:
        """Add the prior of second differences: ``slopes`` (F - 2, size), ``weights`` (size,)."""
        size = self._size
        coefficients = (1.0, -2.0, 1.0)
        for first in range(3):
            for second in range(first + 1):
                value = coefficients[first] * coefficients[second] * weights
                for number in range(self._count - 2):
                    start = (number + second) * size
                    self._band[(first - second) * size, start : start + size] += value
            self._right.reshape(-1, size)[first : first + self._count - 2] += coefficients[first] * slopes

    def solve(self, damping: float) -> Array:
        """Solve for the step of all numbers. ``damping``: share of the diagonal that is added to it."""
        band = self._band.copy()
        band[0] += damping * band[0] + 1e-9
        factor = cholesky_banded(band, lower=True)
        step = -cho_solve_banded((factor, True), self._right)
        shape = np.zeros(len(self._free))
        if not self._free.any():
            return np.r_[step, shape]
        border = self._border[:, self._free]
        columns = cho_solve_banded((factor, True), border)
        corner = self._corner[np.ix_(self._free, self._free)]
        corner = corner + damping * np.diag(np.diag(corner)) - border.T @ columns
        right = -self._right_shape[self._free] - border.T @ step
        shape[self._free] = cho_solve(cho_factor(corner + 1e-9 * np.eye(len(corner))), right)
        return np.r_[step - columns @ shape[self._free], shape]


def _nearest(vector: Array, other: Array) -> Array:
    """Among the rotation vectors (3,) of one rotation, the vector that is nearest to another vector."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-9:
        return vector
    turned = vector - 2 * np.pi * unit_vectors(vector)
    return turned if np.linalg.norm(turned - other) < np.linalg.norm(vector - other) else vector


def fitted_states(model: PoseModel, fit: PersonFit) -> list[BodyState]:
    """States of all frames of a fit of the human of the model."""
    skeleton = fit.body.skeleton
    return [
        model.state(fit.proportions, root, rotations, skeleton)
        for root, rotations in zip(fit.root, fit.rotations, strict=True)
    ]


def _point_errors(model: PoseModel, state: BodyState, cameras: Sequence[Camera], points: Array) -> Array:
    """Distances (V, K) in pixels between given points (V, K, 3) and the keypoints of a body. NaN where no
    point is given, and very large where the keypoint has no image."""
    positions = model.keypoints(state)
    seen = np.stack([camera.project(positions)[0] for camera in cameras])
    errors = np.nan_to_num(np.linalg.norm(seen - points[..., :2], axis=-1), nan=1e4)
    return np.where(points[..., 2] > 0, errors, np.nan)


def fields_of_states(
    model: PoseModel,
    human: Human,
    states: Sequence[BodyState],
    cameras: Sequence[Camera],
    points: Sequence[Array],
) -> dict[str, Any]:
    """Compute the fields of a :class:`PersonFit` that follow from the states of its frames.

    Args:
        model, human: The body before its proportions are applied.
        states: State of each frame.
        cameras: V cameras.
        points: (V, K, 3) x, y and confidence of each frame.
    """
    proportions = model.proportions(states[0])
    skeleton = with_proportions(human, proportions).skeleton
    frames = zip(states, points, strict=True)
    return {
        "proportions": proportions,
        "root": np.array([model.root(state, skeleton) for state in states]),
        "rotations": np.array([model.rotations(state) for state in states]),
        "residuals": np.array([_point_errors(model, state, cameras, own) for state, own in frames]),
    }


def unwound(state: BodyState) -> BodyState:
    """Return the same pose with rotation vectors of at most half a turn."""
    matrices = quaternion_to_matrix(Rotation.from_rotvec(state.vectors).as_quat())
    return replace(state, vectors=Rotation.from_matrix(matrices).as_rotvec())


def with_possible_hinges(model: PoseModel, state: BodyState) -> BodyState:
    """Turn upper arms and thighs about their own axes, so that elbows and knees bend in possible directions.
    The directions of the limbs stay the same. Points do not show this turn if the arm or leg is nearly
    straight, and least squares does not find it if an elbow would have to bend backwards on the way."""
    if model.limits is None:
        return state
    for upper, lower in _HINGES:
        if upper not in model.skeleton.names or lower not in model.skeleton.names:
            continue
        bones = [model.skeleton.bone(name) for name in (upper, lower)]
        turns = Rotation.from_rotvec(
            np.linspace(0, 2 * np.pi, _TURNS, endpoint=False)[:, None] * [0.0, 1.0, 0.0]
        )
        above, below = (Rotation.from_rotvec(state.vectors[bone]) for bone in bones)
        rest = Rotation.from_matrix(model.skeleton.rest_in_parent[bones[1], :3, :3])
        # the limb below keeps its direction: the y axis of its bone
        direction = (rest.inv() * turns.inv() * rest * below).apply([0.0, 1.0, 0.0])
        rotations = np.tile(model.rotations(state), (_TURNS, 1, 1))
        rotations[:, bones[0]] = (above * turns).as_quat()
        rotations[1:, bones[1]] = from_y_axis(direction[1:])
        clamped = model.limits.clamp(rotations)
        cosine = np.abs((clamped * rotations).sum(-1))[:, bones].clip(0, 1)
        beyond = 2 * np.arccos(cosine).sum(axis=1)
        best = int(np.argmin(beyond + np.where(np.arange(_TURNS) > 0, _BETTER, 0.0)))
        if best:
            vectors = state.vectors.copy()
            vectors[bones] = Rotation.from_quat(rotations[best, bones]).as_rotvec()
            state = replace(state, vectors=vectors)
    return state
