"""Skinning: vertices follow their bones, linearly (thesis S13, section 9.6) or by dual quaternions.

Both ways are called alike, see :class:`SkinningFunction`; docs/skinning.md compares them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.mesh.skinned import normalise_weights
from humansim_ros.rotations import cross, matrix_to_quaternion
from humansim_ros.types import Array, FloatArray

#: Frames that one sparse product takes: more gain nothing and need memory.
_FRAMES_AT_ONCE = 16
#: How far a rotation may be from one, as R^T R - 1.
_RIGID = 1e-4


class SkinningFunction(Protocol):
    """The skin of one body."""

    def __call__(self, transforms: FloatArray) -> FloatArray:
        """Posed vertices (..., V, 3) from rest-to-posed transforms (..., B, 4, 4), as precise as the skinner.

        Raises MeshError on transforms of another shape, that are not finite, or that cannot be blended.
        """

    def directions(self, transforms: FloatArray, rest: FloatArray) -> FloatArray:
        """Unit directions (..., V, 3) at the vertices, carried along by the bones from ``rest`` (V, 3).

        Normals and tangents, quickly: those of the bent surface differ somewhat near joints
        (docs/skinning.md); :class:`humansim_ros.mesh.normals.SurfaceNormals` works them out anew.
        """


def make_skinner(
    method: str, vertices: FloatArray, weights: csr_matrix, dtype: type[np.floating] = np.float32
) -> SkinningFunction:
    """The skin of a body: ``method`` "linear" or "dual_quaternion", vertices (V, 3), weights (V, B).

    Raises MeshError on another method, and on shapes and weights that cannot be.
    """
    if method not in SKINNERS:
        raise MeshError(f"{method[:30]!r} is no way of skinning; there are {', '.join(SKINNERS)}")
    return SKINNERS[method](vertices, weights, dtype)


def skin(vertices: FloatArray, weights: csr_matrix, transforms: FloatArray, method: str = "linear") -> Array:
    """Posed vertices (..., V, 3) in double precision, by a :class:`SkinningFunction` for once.

    ``vertices``: (V, 3) at rest. ``weights``: (V, B) sparse. ``transforms``: (..., B, 4, 4) from rest to
    posed, that is ``pose[b] rest[b]^-1``. Raises MeshError as :func:`make_skinner` and the skinner do.
    """
    vertices, transforms = np.asarray(vertices), np.asarray(transforms)
    bones = transforms.shape[-3] if transforms.ndim >= 3 else 0
    if weights.shape != (len(vertices), bones):
        raise MeshError(
            f"weights of shape {weights.shape} do not fit {len(vertices)} vertices and {bones} bones"
        )
    return np.asarray(make_skinner(method, vertices, weights, np.float64)(transforms))


@dataclass(frozen=True, init=False)
class LinearBlend:
    """Linear blend skinning: ``v' = sum_b w_b T_b v`` (Blender's armature modifier).

    Every vertex is a fixed linear function of the bones' matrices: ``v'_i = sum_b T_b[:3] (w_ib [v_i, 1])``,
    so that frames are one product of a sparse (V, 4 B) matrix, made once, with the bones' stacked (4 B, 3)
    matrices. T may be any affine transforms.
    """

    matrix: csr_matrix
    weights: csr_matrix

    def __init__(
        self, vertices: FloatArray, weights: csr_matrix, dtype: type[np.floating] = np.float32
    ) -> None:
        vertices, normalised = _checked_body(vertices, weights)
        rows = np.repeat(np.arange(len(vertices)), np.diff(normalised.indptr))
        homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
        data = (normalised.data[:, None] * homogeneous[rows]).astype(dtype)
        columns = (normalised.indices[:, None] * 4 + np.arange(4)).astype(np.int32)
        shape = (len(vertices), 4 * normalised.shape[1])
        matrix = csr_matrix((data.ravel(), columns.ravel(), normalised.indptr * 4), shape=shape)
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "weights", normalised.astype(dtype))

    def __call__(self, transforms: FloatArray) -> FloatArray:
        """Posed vertices (..., V, 3) from rest-to-posed transforms (..., B, 4, 4)."""
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

    def directions(self, transforms: FloatArray, rest: FloatArray) -> FloatArray:
        """Unit directions (..., V, 3) at the vertices, carried along by the blended matrices."""
        batch, shape = _checked_transforms(transforms, self.weights.shape[1])
        x, y, z = _checked_directions(rest, self.weights)
        out = np.empty((len(batch), len(x), 3), dtype=self.weights.dtype)
        for frame, one in zip(out, batch.astype(out.dtype), strict=True):
            # columns of the matrices first: coordinates that lie together in memory are quick to work on
            m = np.ascontiguousarray((self.weights @ one[:, :3, :3].reshape(-1, 9)).T)
            carried = [m[3 * i] * x + m[3 * i + 1] * y + m[3 * i + 2] * z for i in range(3)]
            length = np.sqrt(carried[0] ** 2 + carried[1] ** 2 + carried[2] ** 2)
            scale = 1 / np.maximum(length, np.finfo(out.dtype).tiny)
            for i in range(3):
                np.multiply(carried[i], scale, out=frame[:, i])
        return out.reshape(*shape, *out.shape[1:])


@dataclass(frozen=True, init=False)
class DualQuaternion:
    """Dual quaternion linear blending (Kavan et al., Geometric skinning with approximate dual quaternion
    blending, 2008): every vertex moves rigidly, so that bent and twisted limbs keep their thickness.

    T must be rigid motions, but for one size that all bones share in a frame. Of the two quaternions of each
    bone, a vertex takes the one on the side of its heaviest bone (the first of equals).
    """

    vertices: FloatArray
    weights: csr_matrix
    used: NDArray[np.intp]
    bones: int
    pairs: NDArray[np.intp]

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
        kept = csr_matrix(
            (normalised.data.astype(dtype), columns.astype(np.int32), normalised.indptr),
            shape=(len(vertices), len(used)),
        )
        object.__setattr__(self, "vertices", np.ascontiguousarray(vertices.T, dtype=dtype))
        object.__setattr__(self, "weights", kept)
        object.__setattr__(self, "used", used)
        object.__setattr__(self, "bones", normalised.shape[1])
        object.__setattr__(self, "pairs", pivots[rows] * len(used) + columns)

    def __call__(self, transforms: FloatArray) -> FloatArray:
        """Posed vertices (..., V, 3) from rest-to-posed transforms (..., B, 4, 4)."""
        batch, shape = _checked_transforms(transforms, self.bones)
        out = np.empty((len(batch), self.vertices.shape[1], 3), dtype=self.vertices.dtype)
        quaternions, translations, sizes = self._rigid(batch)
        # what all bones move by is added last: small numbers are precise numbers
        middle = translations.mean(axis=1)
        duals = _dual_parts(quaternions, translations - middle[:, None])
        for frame, q, dual, size, way in zip(out, quaternions, duals, sizes, middle, strict=True):
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
                np.add(moved[i], way[i], out=frame[:, i], casting="same_kind")
        return out.reshape(*shape, *out.shape[1:])

    def directions(self, transforms: FloatArray, rest: FloatArray) -> FloatArray:
        """Unit directions (..., V, 3) at the vertices, turned by the blended quaternions."""
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
        """Weighted sums (Q, V) of what (B, Q) begins with the bones' quaternions, their signs made alike."""
        q = quaternions[:, :4]
        signs = np.where(q @ q.T < 0, -1, 1).astype(self.weights.dtype)
        weights = self.weights
        if (signs < 0).any():
            data = weights.data * signs.ravel().take(self.pairs)
            weights = csr_matrix((data, weights.indices, weights.indptr), shape=weights.shape)
        blended: FloatArray = np.ascontiguousarray((weights @ quaternions.astype(weights.dtype)).T)
        return blended

    def _rigid(self, batch: Array) -> tuple[Array, Array, Array]:
        """Quaternions (F, B, 4), translations (F, B, 3) and sizes (F,) of the bones in use."""
        linear = batch[:, self.used, :3, :3]
        sizes = np.cbrt(np.linalg.det(linear))
        size = sizes[:, :1]
        with np.errstate(divide="ignore", invalid="ignore"):
            rotations = linear / size[..., None, None]
            off = np.abs(np.swapaxes(rotations, -1, -2) @ rotations - np.eye(3)).max(axis=(-1, -2))
        rigid = (off < _RIGID) & (sizes > 0)
        if not rigid.all():
            frame, bone = np.argwhere(~rigid)[0]
            what = "mirrors" if sizes[frame, bone] < 0 else "stretches, shears or is of another size"
            raise MeshError(
                f"the transform of bone {self.used[bone]} {what}: dual quaternions blend rigid motions "
                "and one size of the whole body; use linear skinning"
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
    """The transforms as (F, B, 4, 4), and the shape that the F frames had."""
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
    """Coordinates (3, V), each together in memory."""
    rest = np.asarray(rest)
    if rest.shape != (weights.shape[0], 3):
        raise MeshError(f"directions of shape {rest.shape} do not fit {weights.shape[0]} vertices")
    return np.ascontiguousarray(rest.T, dtype=weights.dtype)


def _points(array: FloatArray) -> NDArray[Any]:
    """(...,) of an array (..., 3), each point one item: copied three times as fast."""
    return array.view(f"V{3 * array.itemsize}")[..., 0]


def _dual_parts(quaternions: Array, translations: Array) -> Array:
    """(..., 4) xyzw: half the product of translations (..., 3) and quaternions (..., 4)."""
    vector, scalar = quaternions[..., :3], quaternions[..., 3:]
    out = np.empty_like(quaternions)
    out[..., :3] = scalar * translations + np.cross(translations, vector)
    out[..., 3] = -np.einsum("...i,...i->...", translations, vector)
    return out / 2
