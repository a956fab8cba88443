"""Skinning: linear blending [thesis §9.6] and dual quaternions [Kavan 2008].

Both methods are a :class:`SkinningFunction`; docs/skinning.md compares them.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh import normalise_weights
from humansim_ros.geometry import cross, matrix_to_quaternion
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.types import Array, FloatArray

#: Most bones that move a vertex: the usual limit in game engines.
_MOST_BONES = 4
#: Number of rows of weights that are made dense at once.
_ROWS = 16_384


def limit_bones(weights: csr_matrix) -> csr_matrix:
    """Keep the four largest weights of each row of (V, B), scaled to the previous sum of the row."""
    weights = csr_matrix(weights, copy=True)
    weights.sum_duplicates()
    counts = np.diff(weights.indptr)
    rows = np.repeat(np.arange(len(counts)), counts)
    order = np.lexsort((weights.indices, -weights.data, rows))
    rank = np.arange(len(order)) - np.repeat(weights.indptr[:-1], counts)
    before = np.asarray(weights.sum(axis=1)).ravel()
    weights.data[order[rank >= _MOST_BONES]] = 0.0
    weights.eliminate_zeros()
    after = np.asarray(weights.sum(axis=1)).ravel()
    weights.data *= np.repeat(before / np.where(after > 0, after, 1.0), np.diff(weights.indptr))
    return weights


def dominant_bones(weights: csr_matrix) -> NDArray[np.intp]:
    """Bone (V,) with the largest weight of each vertex."""
    return _largest(weights).astype(np.intp)


def without_details(weights: csr_matrix, skeleton: Skeleton) -> csr_matrix:
    """Add the weights of fingers, toes, jaw and eyes to the weights of hand, foot and head that carry them.
    Returns weights (V, B)."""
    bones = len(skeleton)
    sums = csr_matrix((np.ones(bones), (np.arange(bones), skeleton.wholes)), shape=(bones, bones))
    return csr_matrix(weights @ sums)


def triangle_parts(triangles: NDArray[np.integer], weights: csr_matrix) -> NDArray[np.uint8]:
    """Bone (N,) with the largest weight in each triangle, summed over its corners. Part labels in images are
    these numbers plus one."""
    total = weights[triangles[:, 0]] + weights[triangles[:, 1]] + weights[triangles[:, 2]]
    return _largest(total).astype(np.uint8)


def _largest(values: csr_matrix) -> NDArray[np.intp]:
    """Column (N,) of the largest value of each row, the first of equal values. ``argmax`` of sparse matrices
    takes a hundred times longer, since it visits the rows one by one."""
    blocks = range(0, values.shape[0], _ROWS)
    columns = [values[start : start + _ROWS].toarray().argmax(axis=1) for start in blocks]
    return np.concatenate([np.zeros(0, np.intp), *columns])


#: Number of frames in one sparse product. More frames need more memory and are not faster.
_FRAMES_AT_ONCE = 16
#: Tolerance of R^T R - 1 for rotations.
_RIGID = 1e-4


class SkinningFunction(Protocol):
    """A function that moves the vertices of one mesh with its bones."""

    def __call__(self, transforms: FloatArray) -> FloatArray:
        """Posed vertices (..., V, 3) from rest-to-posed transforms (..., B, 4, 4), in the precision of the
        function. Raises MeshError for transforms that have a wrong shape, are not finite, or cannot be
        blended."""

    def directions(self, transforms: FloatArray, rest: FloatArray) -> FloatArray:
        """Unit directions (..., V, 3) at the vertices, rotated with the bones from ``rest`` (V, 3).

        A fast approximation of normals and tangents; near joints it differs from the deformed surface
        (docs/skinning.md). :class:`humansim_ros.files.mesh.normals.SurfaceNormals` computes exact normals.
        """

    def offsets(self, transforms: FloatArray, rest: FloatArray) -> FloatArray:
        """Displacements (..., V, 3) of posed vertices when the vertices in the rest pose move by ``rest`` (V,
        3)."""


def make_skinner(
    method: str, vertices: FloatArray, weights: csr_matrix, dtype: type[np.floating] = np.float32
) -> SkinningFunction:
    """Create the skinning function of a mesh: ``linear`` or ``dual_quaternion``.

    Args:
        method: The method.
        vertices: Vertices at rest, (V, 3).
        weights: Sparse weights (V, B). Each row is scaled to a sum of one.
        dtype: Precision of the results.

    Raises:
        MeshError: Unknown method, or wrong shapes or weights.
    """
    if method not in SKINNERS:
        raise MeshError(f"{method[:30]!r} is not a skinning method; methods are {', '.join(SKINNERS)}")
    return SKINNERS[method](vertices, weights, dtype)


def skin(vertices: FloatArray, weights: csr_matrix, transforms: FloatArray, method: str = "linear") -> Array:
    """Skin a mesh once, in double precision. :func:`make_skinner` is faster for many calls.

    Args:
        vertices: Vertices at rest, (V, 3).
        weights: Sparse weights (V, B).
        transforms: Rest-to-posed transforms of the bones, (..., B, 4, 4): ``pose[b] rest[b]^-1``.
        method: ``linear`` or ``dual_quaternion``.

    Returns:
        Posed vertices, (..., V, 3).

    Raises:
        MeshError: Wrong shapes, weights or transforms, or an unknown method.

    Example:
        >>> import numpy as np
        >>> from scipy.sparse import csr_matrix
        >>> up = np.eye(4)
        >>> up[1, 3] = 2.0
        >>> weights = csr_matrix([[0.5, 0.5]])
        >>> skin(np.zeros((1, 3)), weights, np.stack([np.eye(4), up])).tolist()
        [[0.0, 1.0, 0.0]]
    """
    vertices, transforms = np.asarray(vertices), np.asarray(transforms)
    bones = transforms.shape[-3] if transforms.ndim >= 3 else 0
    if weights.shape != (len(vertices), bones):
        raise MeshError(
            f"weights of shape {weights.shape} do not fit {len(vertices)} vertices and {bones} bones"
        )
    return np.asarray(make_skinner(method, vertices, weights, np.float64)(transforms))


class LinearBlend(SkinningFunction):
    """Linear blend skinning: ``v' = sum_b w_b T_b v`` (Blender's armature modifier).

    Each vertex is a linear function of the bone matrices: ``v'_i = sum_b T_b[:3] (w_ib [v_i, 1])``. So frames
    are one product of a sparse (V, 4 B) matrix, computed once, with the stacked bone matrices (4 B, 3). T may
    be any affine transform.
    """

    def __init__(
        self, vertices: FloatArray, weights: csr_matrix, dtype: type[np.floating] = np.float32
    ) -> None:
        vertices, normalised = _checked_body(vertices, weights)
        rows = np.repeat(np.arange(len(vertices)), np.diff(normalised.indptr))
        homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
        data = (normalised.data[:, None] * homogeneous[rows]).astype(dtype)
        columns = (normalised.indices[:, None] * 4 + np.arange(4)).astype(np.int32)
        shape = (len(vertices), 4 * normalised.shape[1])
        self.matrix = csr_matrix((data.ravel(), columns.ravel(), normalised.indptr * 4), shape=shape)
        self.weights = normalised.astype(dtype)

    def __call__(self, transforms: FloatArray) -> FloatArray:
        batch, shape = _checked_transforms(transforms, self.weights.shape[1])
        vertices = np.empty((len(batch), self.matrix.shape[0], 3), dtype=self.matrix.dtype)
        for start in range(0, len(batch), _FRAMES_AT_ONCE):
            some = batch[start : start + _FRAMES_AT_ONCE]
            stacked = np.moveaxis(some[:, :, :3], (1, 3, 0, 2), (0, 1, 2, 3)).astype(
                vertices.dtype, order="C"
            )
            blended = self.matrix @ stacked.reshape(self.matrix.shape[1], -1)
            _points(vertices[start : start + len(some)])[:] = _points(blended.reshape(-1, len(some), 3)).T
        return vertices.reshape(*shape, *vertices.shape[1:])

    def offsets(self, transforms: FloatArray, rest: FloatArray) -> FloatArray:
        return self._carried(transforms, rest, unit=False)

    def directions(self, transforms: FloatArray, rest: FloatArray) -> FloatArray:
        return self._carried(transforms, rest, unit=True)

    def _carried(self, transforms: FloatArray, rest: FloatArray, unit: bool) -> FloatArray:
        """Transform vectors ``rest`` (V, 3) by the blended matrices of their vertices. If ``unit`` is set,
        the results are divided by their lengths."""
        batch, shape = _checked_transforms(transforms, self.weights.shape[1])
        x, y, z = _checked_directions(rest, self.weights)
        out = np.empty((len(batch), len(x), 3), dtype=self.weights.dtype)
        for frame, one in zip(out, batch.astype(out.dtype), strict=True):
            # matrix components first: contiguous components are faster
            m = np.ascontiguousarray((self.weights @ one[:, :3, :3].reshape(-1, 9)).T)
            carried = [m[3 * i] * x + m[3 * i + 1] * y + m[3 * i + 2] * z for i in range(3)]
            scale = out.dtype.type(1)
            if unit:
                length = np.sqrt(carried[0] ** 2 + carried[1] ** 2 + carried[2] ** 2)
                scale = 1 / np.maximum(length, np.finfo(out.dtype).tiny)
            for i in range(3):
                np.multiply(carried[i], scale, out=frame[:, i])
        return out.reshape(*shape, *out.shape[1:])


class DualQuaternion(SkinningFunction):
    """Dual quaternion linear blending [Kavan 2008]: bent and twisted limbs keep their thickness.

    T must be rigid, up to one scale that all bones of a frame share. The rotation of a bone has two
    quaternions, q and -q. A vertex takes the quaternion that is nearer to the quaternion of its main bone:
    the bone with its largest weight (the first bone, if weights are equal).
    """

    def __init__(
        self, vertices: FloatArray, weights: csr_matrix, dtype: type[np.floating] = np.float32
    ) -> None:
        vertices, normalised = _checked_body(vertices, weights)
        normalised.eliminate_zeros()
        used = np.unique(normalised.indices)
        columns = np.searchsorted(used, normalised.indices)
        counts = np.diff(normalised.indptr)
        rows = np.repeat(np.arange(len(counts)), counts)
        heaviest_first = np.lexsort((normalised.indices, -normalised.data, rows))
        pivots = columns[heaviest_first[normalised.indptr[:-1]]]
        entries = (normalised.data.astype(dtype), columns.astype(np.int32), normalised.indptr)
        self.vertices: FloatArray = np.ascontiguousarray(vertices.T, dtype=dtype)
        self.weights = csr_matrix(entries, shape=(len(vertices), len(used)))
        self.used = used
        self.bones: int = normalised.shape[1]
        self.pairs = pivots[rows] * len(used) + columns

    def __call__(self, transforms: FloatArray) -> FloatArray:
        batch, shape = _checked_transforms(transforms, self.bones)
        out = np.empty((len(batch), self.vertices.shape[1], 3), dtype=self.vertices.dtype)
        quaternions, translations, sizes = self._rigid(batch)
        # the mean translation is added last, for precision in single floats
        middle = translations.mean(axis=1)
        duals = _dual_parts(quaternions, translations - middle[:, None])
        for frame, q, dual, size, shift in zip(out, quaternions, duals, sizes, middle, strict=True):
            blend = self._blend(np.concatenate([q, dual], axis=1))
            d, w, e, f = blend[:3], blend[3], blend[4:7], blend[7]
            v = self.vertices if size == 1 else self.vertices * self.vertices.dtype.type(size)
            # v + 2 d x (d x v + w v) + 2 (w e - f d + d x e), for |d, w| = 1
            moved = cross(d, cross(d, v) + w * v + e)
            moved += w * e
            moved -= f * d
            moved *= 2 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + w * w)
            moved += v
            for i in range(3):
                np.add(moved[i], shift[i], out=frame[:, i], casting="same_kind")
        return out.reshape(*shape, *out.shape[1:])

    def offsets(self, transforms: FloatArray, rest: FloatArray) -> FloatArray:
        batch, shape = _checked_transforms(transforms, self.bones)
        sizes = self._rigid(batch)[2].reshape(*shape, 1, 1)
        lengths = sizes * np.linalg.norm(rest, axis=1, keepdims=True)
        return (self.directions(transforms, rest) * lengths).astype(self.weights.dtype)

    def directions(self, transforms: FloatArray, rest: FloatArray) -> FloatArray:
        batch, shape = _checked_transforms(transforms, self.bones)
        n = _checked_directions(rest, self.weights)
        n = n / np.maximum(np.sqrt((n * n).sum(axis=0)), np.finfo(n.dtype).tiny)
        out = np.empty((len(batch), n.shape[1], 3), dtype=n.dtype)
        for frame, q in zip(out, self._rigid(batch)[0], strict=True):
            blend = self._blend(q)
            d, w = blend[:3], blend[3]
            turned = cross(d, cross(d, n) + w * n)
            turned *= 2 / (d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + w * w)
            turned += n
            frame[:] = turned.T
        return out.reshape(*shape, *out.shape[1:])

    def _blend(self, quaternions: Array) -> FloatArray:
        """Sum values (B, Q) of bones with the weights of each vertex: (Q, V). The first four are quaternions.
        Their signs are made consistent with the bone that has the largest weight."""
        q = quaternions[:, :4]
        signs = np.where(q @ q.T < 0, -1, 1).astype(self.weights.dtype)
        weights = self.weights
        if (signs < 0).any():
            data = weights.data * signs.ravel().take(self.pairs)
            weights = csr_matrix((data, weights.indices, weights.indptr), shape=weights.shape)
        blended: FloatArray = np.ascontiguousarray((weights @ quaternions.astype(weights.dtype)).T)
        return blended

    def _rigid(self, batch: Array) -> tuple[Array, Array, Array]:
        """Quaternions (F, B, 4), translations (F, B, 3) and scales (F,) of the bones in use."""
        linear = batch[:, self.used, :3, :3]
        sizes = np.cbrt(np.linalg.det(linear))
        size = sizes[:, :1]
        with np.errstate(divide="ignore", invalid="ignore"):
            rotations = linear / size[..., None, None]
            off = np.abs(np.swapaxes(rotations, -1, -2) @ rotations - np.eye(3)).max(axis=(-1, -2))
        rigid = (off < _RIGID) & (sizes > 0)
        if not rigid.all():
            frame, bone = np.argwhere(~rigid)[0]
            what = "mirrors" if sizes[frame, bone] < 0 else "stretches, shears or has another scale"
            raise MeshError(
                f"the transform of bone {self.used[bone]} {what}: dual quaternions blend rigid motions "
                "with one scale for all bones; use linear skinning"
            )
        one = np.where(np.abs(size - 1) < 1e-9, 1.0, size)
        return matrix_to_quaternion(rotations), batch[:, self.used][..., :3, 3], one[:, 0]


SKINNERS: dict[str, type[LinearBlend] | type[DualQuaternion]] = {
    "linear": LinearBlend,
    "dual_quaternion": DualQuaternion,
}


def _checked_body(vertices: FloatArray, weights: csr_matrix) -> tuple[Array, csr_matrix]:
    points: Array = np.asarray(vertices, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"vertices to skin are (V, 3), not {points.shape}")
    if weights.shape[0] != len(points):
        raise MeshError(f"weights of shape {weights.shape} do not fit {len(points)} vertices")
    normalised = normalise_weights(weights)
    normalised.sum_duplicates()
    return points, normalised


def _checked_transforms(transforms: FloatArray, bones: int) -> tuple[Array, tuple[int, ...]]:
    """Reshape transforms to (F, B, 4, 4). Also returns their original shape without the last three axes."""
    given: Array = np.asarray(transforms, dtype=float)
    if given.ndim < 3 or given.shape[-3:] != (bones, 4, 4):
        raise MeshError(f"transforms of shape {given.shape} do not fit {bones} bones: (..., {bones}, 4, 4)")
    shape = given.shape[:-3]
    batch = given.reshape(int(np.prod(shape)), bones, 4, 4)
    if not np.isfinite(batch).all():
        bone = np.argwhere(~np.isfinite(batch))[0, 1]
        raise MeshError(f"the transform of bone {bone} is not finite (NaN or infinity)")
    if (np.abs(batch[..., 3, :] - (0, 0, 0, 1)) > _RIGID).any():
        raise MeshError("the last row of a bone's transform is not 0 0 0 1")
    return batch, shape


def _checked_directions(rest: FloatArray, weights: csr_matrix) -> FloatArray:
    """Check directions (V, 3), and return them as contiguous components (3, V)."""
    rest = np.asarray(rest)
    if rest.shape != (weights.shape[0], 3):
        raise MeshError(f"directions of shape {rest.shape} do not fit {weights.shape[0]} vertices")
    return np.ascontiguousarray(rest.T, dtype=weights.dtype)


def _points(array: FloatArray) -> NDArray[Any]:
    """View of an array (..., 3) with one item per point, which copies three times as fast."""
    return array.view(f"V{3 * array.itemsize}")[..., 0]


def _dual_parts(quaternions: Array, translations: Array) -> Array:
    """Dual parts (..., 4) xyzw: half the product of translations (..., 3) and quaternions (..., 4)."""
    vector, scalar = quaternions[..., :3], quaternions[..., 3:]
    out = np.empty_like(quaternions)
    out[..., :3] = scalar * translations + np.cross(translations, vector)
    out[..., 3] = -np.einsum("...i,...i->...", translations, vector)
    return out / 2
