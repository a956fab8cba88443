"""Skinning weights as such: how many bones a vertex may follow."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

#: Bones that a vertex follows at most, as in every game engine.
MAX_BONES_PER_VERTEX = 4


def limit_bones(weights: csr_matrix, most: int = MAX_BONES_PER_VERTEX) -> csr_matrix:
    """Weights (V, B) with the largest ``most`` of each row, rows summing to what they summed to."""
    weights = csr_matrix(weights, copy=True)
    weights.sum_duplicates()
    counts = np.diff(weights.indptr)
    rows = np.repeat(np.arange(len(counts)), counts)
    order = np.lexsort((weights.indices, -weights.data, rows))
    rank = np.arange(len(order)) - np.repeat(weights.indptr[:-1], counts)
    before = np.asarray(weights.sum(axis=1)).ravel()
    weights.data[order[rank >= most]] = 0.0
    weights.eliminate_zeros()
    after = np.asarray(weights.sum(axis=1)).ravel()
    weights.data *= np.repeat(before / np.where(after > 0, after, 1.0), np.diff(weights.indptr))
    return weights
