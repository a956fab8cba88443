"""A mesh with the joints and weights of its file (glTF, SMPL): data only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.types import Array


@dataclass(frozen=True)
class SkinnedMesh:
    """Mesh, joints and weights at bind time, in the space of the file.

    ``joint_names``: J names. ``parents``: (J,), parents first, -1 for a root. ``joints``: (J, 3) positions.
    ``weights``: (V, J), rows sum to one.
    """

    name: str
    mesh: Mesh
    joint_names: tuple[str, ...]
    parents: NDArray[np.intp]
    joints: Array
    weights: csr_matrix


def normalise_weights(weights: csr_matrix) -> csr_matrix:
    """Scale weights (V, B) so that rows sum to one.

    Raises MeshError with the vertex if a weight is negative or not finite, or a row sums to zero.
    """
    scaled = csr_matrix(weights, dtype=np.float64, copy=True)
    counts = np.diff(scaled.indptr)
    rows = np.repeat(np.arange(len(counts)), counts)
    bad = ~np.isfinite(scaled.data) | (scaled.data < 0)
    if bad.any():
        first = int(np.argmax(bad))
        raise MeshError(
            f"a skinning weight of vertex {rows[first]} is negative or not finite: {scaled.data[first]}"
        )
    largest = np.zeros(len(counts))
    np.maximum.at(largest, rows, scaled.data)
    if (largest == 0).any():
        raise MeshError(f"vertex {int(np.argmin(largest))} follows no bone: its weights sum to zero")
    scaled.data /= largest[rows]  # whose sum cannot overflow
    scaled.data /= np.bincount(rows, scaled.data, len(counts))[rows]
    return scaled
