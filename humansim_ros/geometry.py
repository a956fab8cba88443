"""Rotations, poses, vectors and levels of joint trees, as arrays with leading batch axes, for inner loops.

Quaternions are ``xyzw`` (ROS, SciPy); matrices act on column vectors.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from humansim_ros.types import Array, FloatArray, Indices

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


def levels(parents: Indices) -> tuple[Indices, ...]:
    """Nodes of a tree by depth, roots first. ``parents``: (N,), each parent before its children; -1 for a
    root."""
    depth = np.zeros(len(parents), dtype=np.intp)
    for node, parent in enumerate(parents):
        depth[node] = 0 if parent < 0 else depth[parent] + 1
    order = np.argsort(depth, kind="stable")
    return tuple(np.split(order, np.flatnonzero(np.diff(depth[order])) + 1))


def find_cycle(parents: Indices) -> list[int]:
    """Find a cycle in a tree. Returns its nodes, each followed by its parent; empty if there is no cycle.

    ``parents``: (N,), in any order, negative for a root.
    """
    seen: set[int] = set()
    for start in range(len(parents)):
        path: list[int] = []
        node = start
        while node >= 0 and node not in seen:
            seen.add(node)
            path.append(node)
            node = int(parents[node])
        if node in path:
            return path[path.index(node) :]
    return []


#: Body space (metres, y up, faces +z, +x is the person's left) to the world (REP-103: x forward, y left, z
#: up).
WORLD_FROM_BODY: Array = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
#: Largest error of the length of a unit quaternion that is taken as rounding.
_ROUNDING = 1e-12


def _components(vectors: Array) -> Array:
    """View (N, ...) of vectors (..., N) with the components first, like ``numpy.moveaxis`` but faster."""
    return vectors.transpose(-1, *range(vectors.ndim - 1))


def quaternion_to_matrix(quaternion: NDArray[Any]) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4) xyzw."""
    q = np.asarray(quaternion, dtype=float)
    x, y, z, w = _components(q)
    out = np.empty((*q.shape[:-1], 3, 3))
    out[..., 0, 0] = 1 - 2 * (y * y + z * z)
    out[..., 0, 1] = 2 * (x * y - z * w)
    out[..., 0, 2] = 2 * (x * z + y * w)
    out[..., 1, 0] = 2 * (x * y + z * w)
    out[..., 1, 1] = 1 - 2 * (x * x + z * z)
    out[..., 1, 2] = 2 * (y * z - x * w)
    out[..., 2, 0] = 2 * (x * z - y * w)
    out[..., 2, 1] = 2 * (y * z + x * w)
    out[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return out


def rotation_vector_to_matrix(vector: NDArray[Any]) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3): axis times angle in radians (Rodrigues'
    formula).
    """
    x, y, z = _components(np.asarray(vector, dtype=float))
    angle = np.sqrt(x * x + y * y + z * z)
    cross = np.zeros((*angle.shape, 3, 3))
    cross[..., 2, 1], cross[..., 0, 2], cross[..., 1, 0] = x, y, z
    cross -= np.swapaxes(cross, -1, -2)
    # sin(a) / a and (1 - cos(a)) / a^2; NumPy's sinc(x) is sin(pi x) / (pi x), 1 at 0
    first = np.sinc(angle / np.pi)[..., None, None]
    second = 0.5 * np.sinc(angle / (2 * np.pi))[..., None, None] ** 2
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross, dtype=float)


def moved(poses: NDArray[Any], linear: NDArray[Any], angular: NDArray[Any], seconds: float) -> Array:
    """Extrapolate poses at constant velocity.

    Args:
        poses: Poses (..., 4, 4).
        linear: Linear velocities (..., 3) in the frame of the poses, m/s.
        angular: Angular velocities (..., 3) in the frame of the poses, rad/s.
        seconds: Seconds from the given poses to the returned ones; negative for the past.

    Returns:
        Poses (..., 4, 4).
    """
    out = np.array(poses, dtype=float)
    out[..., :3, :3] = rotation_vector_to_matrix(np.asarray(angular) * seconds) @ out[..., :3, :3]
    out[..., :3, 3] += np.asarray(linear, dtype=float) * seconds
    return out


def rotation_vector_to_quaternion(vector: NDArray[Any]) -> Array:
    """Unit quaternions (..., 4) xyzw of rotation vectors (..., 3): axis times angle in radians."""
    v = np.asarray(vector, dtype=float)
    angle = np.sqrt(v[..., 0] ** 2 + v[..., 1] ** 2 + v[..., 2] ** 2)
    squared, small = angle * angle, angle <= 1e-3
    scale = np.where(
        small, 0.5 - squared / 48 + squared * squared / 3840, np.sin(angle / 2) / np.where(small, 1.0, angle)
    )
    return np.concatenate([scale[..., None] * v, np.cos(angle / 2)[..., None]], axis=-1)


def quaternion_to_rotation_vector(quaternion: NDArray[Any]) -> Array:
    """Rotation vectors (..., 3) of unit quaternions (..., 4) xyzw; at most pi long."""
    q = np.where(quaternion[..., 3:] < 0, -quaternion, quaternion)
    angle = 2 * np.arctan2(np.sqrt(q[..., 0] ** 2 + q[..., 1] ** 2 + q[..., 2] ** 2), q[..., 3])
    squared, small = angle * angle, angle <= 1e-3
    scale = np.where(
        small,
        2 + squared / 12 + 7 * squared * squared / 2880,
        angle / np.sin(np.where(small, 1.0, angle) / 2),
    )
    return np.asarray(scale[..., None] * q[..., :3])


def multiply_quaternions(a: NDArray[Any], b: NDArray[Any]) -> Array:
    """Unit quaternions (..., 4) xyzw of rotation ``b`` followed by rotation ``a``."""
    (ax, ay, az, aw), (bx, by, bz, bw) = (_components(np.asarray(q)) for q in (a, b))
    product = (
        aw * bx + bw * ax + (ay * bz - az * by),
        aw * by + bw * ay + (az * bx - ax * bz),
        aw * bz + bw * az + (ax * by - ay * bx),
        aw * bw - ax * bx - ay * by - az * bz,
    )
    return normalised(np.stack(product, axis=-1))


def normalised(quaternion: NDArray[Any]) -> Array:
    """Quaternions (..., 4) divided by their length, even if the length is 1 up to rounding."""
    x, y, z, w = _components(np.asarray(quaternion, dtype=float))
    return np.asarray(quaternion / np.sqrt(x * x + y * y + z * z + w * w)[..., None], dtype=float)


def matrix_to_quaternion(matrix: NDArray[Any]) -> Array:
    """Unit quaternions (..., 4) xyzw with w >= 0 of rotation matrices (..., 3, 3) (Shepperd's method)."""
    m = np.asarray(matrix, dtype=float)
    diagonal = np.diagonal(m, axis1=-2, axis2=-1)
    trace = diagonal.sum(-1)
    # row k is the quaternion times four times its k-th element; the row of the largest is well conditioned
    table = np.empty((*m.shape[:-2], 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        table[..., i, i] = 1 + 2 * diagonal[..., i] - trace
        table[..., i, j] = table[..., j, i] = m[..., j, i] + m[..., i, j]
        table[..., i, 3] = table[..., 3, i] = m[..., k, j] - m[..., j, k]
    table[..., 3, 3] = 1 + trace
    best = np.argmax(np.diagonal(table, axis1=-2, axis2=-1), axis=-1)
    q: Array = np.take_along_axis(table, best[..., None, None], axis=-2)[..., 0, :]
    q = q / lengths_of(q)[..., None]
    return np.where(q[..., 3:] < 0, -q, q)


def unit_quaternions(quaternions: NDArray[Any]) -> Array:
    """Quaternions (..., 4) divided by their length, which is not zero.

    A quaternion with length 1 up to rounding is returned unchanged.
    """
    q = np.asarray(quaternions, dtype=float)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(np.abs(length - 1) <= _ROUNDING, q, q / length)


def from_degrees(angles: ArrayLike) -> Rotation:
    """Rotation by angles (..., 3) about the fixed x axis, then y, then z, in degrees [thesis §9.2]."""
    return scipy.spatial.transform.Rotation.from_euler("xyz", angles, degrees=True)


def turn_about_z(yaw: float) -> Array:
    """Quaternion (4,) xyzw of a turn about the z axis, in radians."""
    return np.array([0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])


def heading_of_hips(across: Array) -> float:
    """Direction to the front of the hips, radians from x to y. ``across``: (3,) from right hip to left
    hip."""
    return float(np.arctan2(-across[0], across[1]))


def slerp(start: Array, end: Array, fraction: Array) -> Array:
    """Spherical interpolation between unit quaternions (..., 4) on the shorter arc; ``fraction`` (...,) 0 to
    1.
    """
    cosine = np.sum(start * end, axis=-1, keepdims=True)
    end = np.where(cosine < 0, -end, end)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    t = np.asarray(fraction, dtype=float)[..., None]
    sine = np.sin(angle)
    near = sine < 1e-6
    safe = np.where(near, 1.0, sine)
    first = np.where(near, 1 - t, np.sin((1 - t) * angle) / safe)
    second = np.where(near, t, np.sin(t * angle) / safe)
    out = first * start + second * end
    result: Array = out / np.linalg.norm(out, axis=-1, keepdims=True)
    return result


def are_rotations(matrices: Array) -> bool:
    """Whether all matrices (..., 3, 3) are rotations, with errors up to 0.001."""
    if not (np.abs(matrices) < 2).all():  # False for NaN, too
        return False
    products = matrices @ np.swapaxes(matrices, -1, -2)
    return bool((np.abs(products - np.eye(3)) < 1e-3).all() and (np.linalg.det(matrices) > 0).all())


def nearest_rotations(matrices: Array) -> Array:
    """Rotations (..., 3, 3) nearest to matrices (..., 3, 3); a mirrored matrix stays mirrored."""
    u, _, vt = np.linalg.svd(matrices)
    return np.asarray(u @ vt, dtype=float)


def from_y_axis(direction: Array) -> Array:
    """Shortest rotations (..., 4) xyzw that turn the y axis onto unit vectors (..., 3).

    [thesis (9.43)-(9.48)] with normalised n = u x v; v = -u is a half turn about x.
    """
    v = np.asarray(direction, dtype=float)
    out = np.zeros((*v.shape[:-1], 4))
    out[..., 0] = v[..., 2]
    out[..., 2] = -v[..., 0]
    out[..., 3] = 1 + v[..., 1]
    length = np.linalg.norm(out, axis=-1, keepdims=True)
    opposite = length < 1e-7
    return np.where(opposite, np.array([1.0, 0.0, 0.0, 0.0]), out / np.where(opposite, 1.0, length))


def shortest_rotations(starts: Array, ends: Array) -> Array:
    """Shortest rotations (..., 3, 3) from unit vectors to unit vectors (..., 3) that are not opposite."""
    axes = cross_products(starts, ends)
    skew = np.zeros((*axes.shape, 3))
    skew[..., [2, 0, 1], [1, 2, 0]] = axes
    skew[..., [1, 2, 0], [2, 0, 1]] = -axes
    factors = 1 / np.maximum(1 + (starts * ends).sum(axis=-1), 1e-9)
    return np.asarray(np.eye(3) + skew + skew @ skew * factors[..., None, None])


def transform(rotation: NDArray[Any], translation: NDArray[Any]) -> Array:
    """Homogeneous matrices (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    rotation, translation = np.asarray(rotation, dtype=float), np.asarray(translation, dtype=float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    out = np.zeros((*shape, 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def invert_rigid(matrix: Array) -> Array:
    """Inverses of rigid transforms (..., 4, 4)."""
    rotation = np.swapaxes(matrix[..., :3, :3], -1, -2)
    return transform(rotation, -np.einsum("...ij,...j->...i", rotation, matrix[..., :3, 3]))


def fit_similarity(
    source: Array, target: Array, weights: NDArray[Any] | None = None, scale: float | None = None
) -> tuple[Array, Array, Array]:
    """Fit ``target = scale * rotation @ source + translation`` by least squares, without reflections.

    [Umeyama 1991]

    Args:
        source: Points (..., N, 3).
        target: Points (..., N, 3).
        weights: Weight of each pair of points, (..., N); 1 if None.
        scale: Fixed scale. If None, the scale is fitted, too. A fitted scale is 0 if all source points are
            the same.

    Returns:
        Scale (...), rotation (..., 3, 3) and translation (..., 3).
    """
    weight = np.ones(source.shape[:-1]) if weights is None else np.asarray(weights, dtype=float)
    share = (weight / weight.sum(axis=-1, keepdims=True))[..., None]
    middle, goal = (np.sum(share * points, axis=-2, keepdims=True) for points in (source, target))
    away = share * (source - middle)
    u, spread, vt = np.linalg.svd(np.swapaxes(target - goal, -1, -2) @ away)
    spread[..., 2] *= (sign := np.sign(np.linalg.det(u @ vt)))
    u[..., 2] *= sign[..., None]
    rotation: Array = u @ vt
    size = np.sum(away * (source - middle), axis=(-2, -1))
    fitted = np.divide(spread.sum(axis=-1), size, out=np.zeros_like(size), where=size > 0)
    factor = fitted if scale is None else np.full_like(size, scale)
    return factor, rotation, goal[..., 0, :] - factor[..., None] * rotate(rotation, middle[..., 0, :])


def nearest_axis(direction: Array) -> Array:
    """Signed unit axis (3,) nearest to a direction (3,)."""
    axis = int(np.argmax(np.abs(direction)))
    return np.eye(3)[axis] * (1.0 if direction[axis] > 0 else -1.0)


def angle_between(a: Array, b: Array) -> Array:
    """Angle (...,) between vectors (..., 3), radians; pi / 2 where a vector is zero."""
    dot = np.einsum("...i,...i->...", a, b)
    scale = np.sqrt(np.einsum("...i,...i->...", a, a) * np.einsum("...i,...i->...", b, b))
    return np.arccos(np.clip(dot / np.maximum(scale, 1e-30), -1.0, 1.0))


def rotate(matrices: NDArray[Any], vectors: NDArray[Any]) -> Array:
    """Vectors (..., 3) multiplied by matrices (..., 3, 3)."""
    return np.asarray((matrices @ vectors[..., None])[..., 0])


def compose_poses(
    outer: tuple[NDArray[Any], NDArray[Any]], inner: tuple[NDArray[Any], NDArray[Any]]
) -> tuple[Array, Array]:
    """Poses in the world, from poses that are relative to other poses.

    Args:
        outer: Positions (..., 3) and quaternions (..., 4) xyzw in the world of the other poses.
        inner: Positions (..., 3) and quaternions (..., 4) xyzw of the things relative to ``outer``.
    """
    (positions, rotations), (offsets, turns) = outer, inner
    arms = rotate(quaternion_to_matrix(rotations), offsets)
    return positions + arms, multiply_quaternions(normalised(rotations), normalised(turns))


def smooth_step(share: Array) -> Array:
    """Smooth step: 0 for a ``share`` (...) up to 0, 1 for a share from 1 on, and a smooth change between."""
    share = np.clip(share, 0.0, 1.0)
    return np.asarray(share * share * (3 - 2 * share))


def unit_vectors(vectors: NDArray[Any]) -> Array:
    """Vectors (..., 3) divided by their length; a zero vector stays zero."""
    return np.asarray(vectors / np.maximum(lengths_of(vectors)[..., None], 1e-12))


def lengths_of(vectors: NDArray[Any]) -> Array:
    """Lengths (...) of vectors (..., N): exactly equal to ``numpy.linalg.norm``, but faster."""
    return np.asarray(np.sqrt(np.add.reduce(vectors * vectors, axis=-1)))


def perpendicular(vectors: Array, directions: Array) -> Array:
    """Vectors (..., 3) without their part along unit vectors (..., 3)."""
    return np.asarray(vectors - (vectors * directions).sum(axis=-1, keepdims=True) * directions)


def cross_products(a: Array, b: Array) -> Array:
    """Cross products (..., 3) of vectors (..., 3): exactly equal to ``numpy.cross``, but faster."""
    return np.asarray(
        a.take(_NEXT, axis=-1) * b.take(_LAST, axis=-1) - a.take(_LAST, axis=-1) * b.take(_NEXT, axis=-1)
    )


#: Next and previous axis of each axis, in cyclic order.
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products (3, ...) of vectors with components on the first axis (faster than ``numpy.cross``)."""
    out = np.empty_like(b)
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        np.multiply(a[j], b[k], out=out[i])
        out[i] -= a[k] * b[j]
    return out


#: Segment-triangle pairs that are computed at once.
_BATCH = 200_000


def segments_crossing(starts: Array, ends: Array, corners: Array) -> NDArray[np.bool_]:
    """(N,) whether segments from ``starts`` to ``ends`` (N, 3) cross a triangle (T, 3, 3) [Moller 1997]."""
    crossing = np.zeros(len(starts), bool)
    if not len(corners) or not len(starts):
        return crossing
    low, high = np.minimum(starts, ends), np.maximum(starts, ends)
    t_low, t_high = corners.min(axis=1), corners.max(axis=1)
    near = ((t_high >= low.min(axis=0)) & (t_low <= high.max(axis=0))).all(axis=1)
    corners, t_low, t_high = corners[near], t_low[near], t_high[near]
    if not len(corners):
        return crossing
    candidates = np.flatnonzero(((high >= t_low.min(axis=0)) & (low <= t_high.max(axis=0))).all(axis=1))
    for chunk in np.array_split(candidates, max(1, len(candidates) * len(corners) // _BATCH)):
        boxes = ((high[chunk, None] >= t_low) & (low[chunk, None] <= t_high)).all(axis=-1)
        segment, triangle = np.nonzero(boxes)
        segment = chunk[segment]
        hits = _crosses(starts[segment], ends[segment] - starts[segment], corners[triangle])
        crossing[segment[hits]] = True
    return crossing


def _crosses(origin: Array, direction: Array, corners: Array) -> NDArray[np.bool_]:
    """Whether each segment (N, 3) crosses its triangle (N, 3, 3)."""
    side_1, side_2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(direction, side_2)
    determinant = np.einsum("ij,ij->i", side_1, across)
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = origin - corners[:, 0]
        u = np.einsum("ij,ij->i", offset, across) / determinant
        other = np.cross(offset, side_1)
        v = np.einsum("ij,ij->i", direction, other) / determinant
        t = np.einsum("ij,ij->i", side_2, other) / determinant
        return np.asarray((u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0) & (t <= 1))


#: Half the time span of the central differences that give velocities, seconds; times of a central difference.
VELOCITY_STEP = 1e-3
AROUND: Array = VELOCITY_STEP * np.array([-1.0, 0.0, 1.0])


def central_difference(
    positions: Array, rotations: Array, seconds: float | Array = 2 * VELOCITY_STEP
) -> tuple[Array, Array]:
    """Linear and angular velocities, (..., 3) each, from the first to the last of K poses.

    ``positions``: (K, ..., 3). ``rotations``: quaternions (K, ..., 4) xyzw. ``seconds``: time between them.
    """
    before, after = normalised(rotations[0]), normalised(rotations[-1])
    turn = quaternion_to_rotation_vector(multiply_quaternions(after, before * (-1, -1, -1, 1)))
    return (positions[-1] - positions[0]) / seconds, turn / seconds


@dataclass(frozen=True, eq=False)
class Velocity:
    """Velocity of a pose: ``linear`` (3,) m/s and ``angular`` (3,) rad/s, in the axes of ``map``."""

    linear: Array
    angular: Array

    @classmethod
    def between(cls, positions: Array, rotations: Array, seconds: float) -> Velocity:
        """Velocity from the first to the last of K poses: positions (K, 3), rotations (K, 4), ``seconds``
        apart."""
        return cls(*central_difference(positions, rotations, max(seconds, 1e-12)))

    def scaled(self, factor: float) -> Velocity:
        """Both velocities times a factor."""
        return self if factor == 1 else Velocity(self.linear * factor, self.angular * factor)

    def of_point(self, arm: Array) -> Velocity:
        """Velocity of a point that is fixed to the pose. ``arm``: (3,) from pose to point, in ``map``."""
        return Velocity(self.linear + np.cross(self.angular, arm), self.angular)


@dataclass(frozen=True)
class ObjectPose:
    """Pose and size of an object: a point x of its mesh is at ``position + rotation (size * x)``.

    Attributes:
        position: (3,) in ``map``, metres.
        rotation: (4,) quaternion xyzw.
        size: (3,) factors along the axes of the mesh; metres for a built-in mesh.
        velocity: Velocity at this time; None if unknown.
    """

    position: Array
    rotation: Array
    size: Array = field(default_factory=lambda: np.ones(3))
    velocity: Velocity | None = None

    @classmethod
    def on_floor(cls, x: float, y: float, yaw: float, velocity: Velocity | None = None) -> ObjectPose:
        """Pose on the floor.

        Args:
            x: Metres in ``map``.
            y: Metres in ``map``.
            yaw: Heading in radians from +x to the left.
            velocity: Velocity; None for a zero or unknown velocity.
        """
        return cls(np.array([x, y, 0.0]), turn_about_z(yaw), velocity=velocity)

    def moved(self, seconds: float) -> ObjectPose:
        """Pose ``seconds`` later at constant velocity."""
        if self.velocity is None or seconds == 0:
            return self
        turn = rotation_vector_to_quaternion(seconds * self.velocity.angular)
        position = self.position + seconds * self.velocity.linear
        return replace(
            self, position=position, rotation=multiply_quaternions(turn, normalised(self.rotation))
        )

    def carry(self, pose: ObjectPose) -> ObjectPose:
        """Pose in ``map`` of a thing that this object carries. The size of this object has no effect.

        ``pose``: pose and velocity of the thing relative to this object. A thing without velocity is fixed to
        this object.
        """
        position, rotation = compose_poses((self.position, self.rotation), (pose.position, pose.rotation))
        velocity = self.velocity
        if velocity is not None:
            velocity = velocity.of_point(position - self.position)
            if pose.velocity is not None:
                turn = quaternion_to_matrix(self.rotation)
                linear, angular = turn @ pose.velocity.linear, turn @ pose.velocity.angular
                velocity = Velocity(velocity.linear + linear, velocity.angular + angular)
        return ObjectPose(position, rotation, pose.size, velocity)

    @property
    def matrix(self) -> Array:
        """(4, 4) transform of points of the mesh to ``map``."""
        return transform(quaternion_to_matrix(self.rotation) * self.size, self.position)

    def apply(self, points: Array) -> Array:
        """Transform points (..., 3) of the mesh to ``map``."""
        turned = (points * self.size) @ quaternion_to_matrix(self.rotation).T
        return np.asarray(turned + self.position)
