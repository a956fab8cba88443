"""Linear blend skinning (thesis S13, section 9.6): vertices follow their bones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.rotations import Array


def skin(
    vertices: NDArray[np.floating], weights: csr_matrix, transforms: NDArray[np.floating]
) -> NDArray[np.floating]:
    """Posed vertices ``v' = sum_b w_b T_b v / sum_b w_b`` (thesis 9.6, Blender's armature modifier).

    ``vertices``: (V, 3) at rest. ``weights``: (V, B) sparse. ``transforms``: (..., B, 4, 4) from rest to
    posed, that is
    ``pose[b] rest[b]^-1``. Returns (..., V, 3). Raises MeshError on shapes that do not fit and on weights
    that are negative or sum to zero.
    """
    vertices, transforms = np.asarray(vertices), np.asarray(transforms)
    if weights.shape != (len(vertices), transforms.shape[-3]):
        raise MeshError(
            f"weights of shape {weights.shape} do not fit {len(vertices)} vertices "
            f"and {transforms.shape[-3]} bones"
        )
    skinner = LinearBlend(vertices, weights, dtype=np.float64)
    batch = transforms.reshape(-1, *transforms.shape[-3:])
    return np.stack([skinner(one) for one in batch]).reshape(*transforms.shape[:-3], *vertices.shape)


@dataclass(frozen=True, init=False)
class LinearBlend:
    """Skinning of one body, frame after frame.

    Every vertex is a fixed linear function of the bones' matrices: ``v'_i = sum_b T_b[:3] (w_ib [v_i, 1])``,
    so that a frame is one product of a sparse (V, 4 B) matrix, made once, with the bones' stacked (4 B, 3)
    matrices.
    """

    matrix: csr_matrix

    def __init__(self, vertices: NDArray[np.floating], weights: csr_matrix, dtype: type = np.float32) -> None:
        normalised = normalise_weights(weights)
        rows = np.repeat(np.arange(len(vertices)), np.diff(normalised.indptr))
        homogeneous = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
        data = (normalised.data[:, None] * homogeneous[rows]).astype(dtype)
        columns = (normalised.indices[:, None] * 4 + np.arange(4)).astype(np.int32)
        matrix = csr_matrix(
            (data.ravel(), columns.ravel(), normalised.indptr * 4),
            shape=(len(vertices), 4 * weights.shape[1]),
        )
        object.__setattr__(self, "matrix", matrix)

    def __call__(self, transforms: NDArray[np.floating]) -> NDArray[np.floating]:
        """Posed vertices (V, 3) from rest-to-posed transforms (B, 4, 4)."""
        stacked = np.swapaxes(transforms[:, :3, :], 1, 2).reshape(-1, 3)
        result: NDArray[np.floating] = self.matrix @ stacked.astype(self.matrix.dtype)
        return result


def normalise_weights(weights: csr_matrix) -> csr_matrix:
    """Weights (V, B) whose rows sum to one. MeshError where a weight is negative or not finite, or a row sums
    to zero.
    """
    weights = csr_matrix(weights, dtype=np.float64)
    if not np.isfinite(weights.data).all() or (weights.data < 0).any():
        raise MeshError("a skinning weight is negative or not finite")
    total: Array = np.asarray(weights.sum(axis=1)).ravel()
    if (total <= 0).any():
        raise MeshError(f"vertex {int(np.argmin(total))} follows no bone: its weights sum to zero")
    scaled = weights.copy()
    scaled.data /= np.repeat(total, np.diff(weights.indptr))
    return scaled
