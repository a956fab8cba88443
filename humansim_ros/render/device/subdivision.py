"""Division of triangles. Each edge is divided into equal pieces, so that triangles with a common edge stay
connected."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from humansim_ros.types import Array, Indices

#: A number that is larger than any number of pieces.
_MANY = 1 << 10
#: A point of a pattern: its group and its number in the group.
_Point = tuple[int, int]


class TriangleEdges(NamedTuple):
    """Edges of triangles. ``ends``: (E, 2) vertices, the lower one first. ``sides``: (N, 3) edges of the
    sides ab, bc and ca of each triangle."""

    ends: Indices
    sides: Indices

    @classmethod
    def of(cls, corners: Indices, count: int) -> TriangleEdges:
        """Edges of triangles (N, 3) of ``count`` vertices."""
        following = np.roll(corners, -1, axis=1)
        keys = np.minimum(corners, following) * count + np.maximum(corners, following)
        distinct, sides = np.unique(keys, return_inverse=True)
        return cls(np.stack(np.divmod(distinct, max(count, 1)), axis=1), sides.reshape(-1, 3))


def divide_triangles(
    attributes: NDArray[Any], corners: Indices, edges: TriangleEdges, pieces: Indices
) -> tuple[NDArray[Any], Indices, Indices]:
    """Divide triangles.

    Args:
        attributes: (V, k) attributes of vertices.
        corners: (N, 3) triangles.
        edges: Edges of the triangles.
        pieces: (E,) number of pieces of each edge.

    Returns:
        Attributes of old and new vertices, (T, 3) new triangles, and (T,) the original triangle of each.
    """
    edge, number = _numbered(pieces - 1)
    starts, ends = (attributes[column[edge]] for column in edges.ends.T)
    on_edges = _between(starts, ends, pieces[edge], number + 1)
    # rotate so that bc has the fewest pieces: the rows of a pattern are parallel to bc
    order = (np.arange(3) + pieces[edges.sides].argmin(axis=1)[:, None] + 2) % 3
    corners, sides = (np.take_along_axis(one, order, axis=1) for one in (corners, edges.sides))
    distinct, kind = np.unique(pieces[sides] @ [_MANY * _MANY, _MANY, 1], return_inverse=True)
    patterns = [_pattern(key // _MANY**2, key // _MANY % _MANY, key % _MANY) for key in distinct.tolist()]
    inside, of_inside = _entries([len(pattern.weights) for pattern in patterns], kind)
    weights = np.concatenate([np.zeros((0, 3)), *(pattern.weights for pattern in patterns)])[of_inside]
    inner = np.zeros((len(inside), attributes.shape[1]), attributes.dtype)
    for weight, corner in zip(weights.astype(attributes.dtype).T, corners.T, strict=True):
        inner += weight[:, None] * attributes[corner[inside]]
    # the points of each triangle: its corners, points on its sides, inner points
    first, step = np.zeros((2, len(corners), 7), np.intp)
    first[:, :3] = corners
    forward = edges.ends[sides, 0] == corners
    of_edge = len(attributes) + np.cumsum(pieces - 1) - (pieces - 1)
    first[:, 3:6] = of_edge[sides] + np.where(forward, 0, pieces[sides] - 2)
    step[:, 3:6] = np.where(forward, 1, -1)
    first[:, 6] = len(attributes) + len(on_edges) + np.searchsorted(inside, np.arange(len(corners)))
    step[:, 6] = 1
    owner, of_points = _entries([pattern.points.shape[1] for pattern in patterns], kind)
    group, number = np.concatenate([np.zeros((2, 0), np.intp), *(one.points for one in patterns)], axis=1)[
        :, of_points
    ]
    group += 7 * owner
    points = first.ravel()[group] + step.ravel()[group] * number
    return np.concatenate([attributes, on_edges, inner]), points.reshape(-1, 3), owner[::3]


def _entries(counts: list[int], kind: Indices) -> tuple[Indices, Indices]:
    """Number the entries of N owners, kind by kind. ``counts``: entries of each owner. Returns the owner (P,)
    of each entry, and the number of the entry."""
    number_of = np.array(counts, np.intp)
    owner, number = _numbered(number_of[kind])
    return owner, (np.cumsum(number_of) - number_of)[kind[owner]] + number


def divide_edges(
    starts: NDArray[Any], ends: NDArray[Any], pieces: Indices
) -> tuple[NDArray[Any], NDArray[Any], Indices]:
    """Divide edges from ``starts`` to ``ends``, (E, k), into equal ``pieces`` (E,).

    Returns:
        Starts and ends (P, k) of the pieces, and (P,) the edge of each.
    """
    edge, number = _numbered(pieces)
    whole = starts[edge], ends[edge], pieces[edge]
    return _between(*whole, number), _between(*whole, number + 1), edge


def _numbered(counts: Indices) -> tuple[Indices, Indices]:
    """Owner and number (from 0) of each of the ``counts`` (E,) things of each owner, owner by owner."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - (np.cumsum(counts) - counts)[owner]


def _between(starts: NDArray[Any], ends: NDArray[Any], pieces: Indices, number: Indices) -> NDArray[Any]:
    """Points (P, k) after the first ``number`` (P,) of equal pieces. The bits are the same from both ends."""
    before, after = ((n / pieces).astype(starts.dtype)[:, None] for n in (number, pieces - number))
    return np.asarray(starts * after + ends * before)


class _Pattern(NamedTuple):
    """A divided triangle a b c. ``points``: (2, 3 T) group and number of the corners of the new triangles.
    The groups are a, b, c, the points within ab, bc and ca, and inner points with barycentric ``weights`` (I,
    3)."""

    points: Indices
    weights: Array


@lru_cache(maxsize=4096)
def _pattern(ab: int, bc: int, ca: int) -> _Pattern:
    """Pattern for the numbers of pieces of the three sides. Strips lie between rows that run from ab to ca
    and end at bc. The triangle is drawn with sides as long as these numbers, so that all pieces of its sides
    are equally long."""
    rows = max(ab, ca)
    x = (ab * ab - bc * bc + ca * ca) / (2 * ab)
    b, c = complex(ab), complex(x, np.sqrt(max(ca * ca - x * x, 0.25)))
    on_ab = [(0, 0), *((3, number) for number in range(ab - 1)), (1, 0)]
    on_bc = [(1, 0), *((4, number) for number in range(bc - 1)), (2, 0)]
    on_ac = [(0, 0), *((5, number) for number in reversed(range(ca - 1))), (2, 0)]
    places = {point: b * number / ab for number, point in enumerate(on_ab)}
    places |= {point: b + (c - b) * number / bc for number, point in enumerate(on_bc)}
    places |= {point: c * number / ca for number, point in enumerate(on_ac)}
    points: list[tuple[int, int]] = []
    weights: list[tuple[float, float, float]] = []
    above = [(0, 0)]
    for row in range(1, rows + 1):
        below = on_bc
        if row < rows:
            left, right = -(-row * ab // rows), -(-row * ca // rows)
            low, high = places[on_ab[left]], places[on_ac[right]]
            pieces = min(bc, max(1, int(np.ceil(abs(high - low) - 0.01))))
            below = [on_ab[left]]
            for share in (number / pieces for number in range(1, pieces)):
                below.append((6, len(weights)))
                places[below[-1]] = low + (high - low) * share
                of_b, of_c = (1 - share) * left / ab, share * right / ca
                weights.append((1 - of_b - of_c, of_b, of_c))
            below.append(on_ac[right])
        for triangle in _strip(above, below, places):
            points += triangle
        above = below
    return _Pattern(np.array(points, np.intp).T, np.array(weights, float).reshape(-1, 3))


def _strip(
    above: list[_Point], below: list[_Point], places: dict[_Point, complex]
) -> list[tuple[_Point, _Point, _Point]]:
    """Triangles between two rows of points. Of two diagonals the shorter one is used."""
    triangles, i, j = [], 0, 0
    while i + 1 < len(above) or j + 1 < len(below):
        lower = i + 1 == len(above)
        if not lower and j + 1 < len(below):
            diagonals = (places[above[i]] - places[below[j + 1]], places[above[i + 1]] - places[below[j]])
            lower = abs(diagonals[0]) <= abs(diagonals[1])
        if lower:
            triangles.append((above[i], below[j], below[j + 1]))
            j += 1
        else:
            triangles.append((above[i], below[j], above[i + 1]))
            i += 1
    return [triangle for triangle in triangles if len(set(triangle)) == 3]
