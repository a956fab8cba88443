"""Limit the number of bones per vertex in skinning weights."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_matrix

#: Usual limit of game engines.
MAX_BONES_PER_VERTEX = 4


def limit_bones(weights: csr_matrix, most: int = MAX_BONES_PER_VERTEX) -> csr_matrix:
    """Keep the ``most`` largest weights of each row of (V, B), and scale them to the previous row sum."""
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
