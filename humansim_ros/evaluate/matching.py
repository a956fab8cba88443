"""Match the people of an estimate to those of the truth in one frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from humansim_ros.types import Array


def pair_distances(truth: Sequence[Array], estimate: Sequence[Array]) -> Array:
    """Mean distances (T, E) of the joints that two people both have; inf if they have none in common.

    ``truth`` and ``estimate``: joints (C, 3) of each person, NaN where one is absent.
    """
    if not truth or not estimate:
        return np.zeros((len(truth), len(estimate)))
    errors = np.linalg.norm(np.stack(truth)[:, None] - np.stack(estimate)[None], axis=3)
    common = np.isfinite(errors)
    count = common.sum(axis=2)
    total = np.where(common, errors, 0.0).sum(axis=2)
    return np.divide(total, count, out=np.full(count.shape, np.inf), where=count > 0)


def match_people(distances: Array, gate: float) -> list[tuple[int, int]]:
    """Pairs (truth, estimate) with the least sum of distances, as many as are within a gate.

    Args:
        distances: (T, E) mean joint distances, metres.
        gate: Greatest distance of a pair, metres.
    """
    # a pair beyond the gate costs more than any number of pairs within it
    cost = np.where(distances <= gate, distances, (1.0 + gate) * (1 + min(distances.shape)))
    rows, columns = linear_sum_assignment(cost)
    return [(int(r), int(c)) for r, c in zip(rows, columns, strict=True) if distances[r, c] <= gate]
