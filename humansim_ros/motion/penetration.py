"""Where limbs go through each other or the trunk: bones as capsules, the distance between their axes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.rigging import dominant_bones
from humansim_ros.body.skeleton import Skeleton
from humansim_ros.errors import MeshError
from humansim_ros.humans.human import Human
from humansim_ros.types import Array

#: Radius, and for the trunk half its width, by the height of the person: those of assets/humans/adult_man.
_RADII = {
    "HumanoidRoot": (0.066, 0.098),
    "sacroiliac": (0.072, 0.089),
    "vl5": (0.069, 0.090),
    "vt3": (0.048, 0.0),
    "shoulder": (0.032, 0.0),
    "elbow": (0.016, 0.0),
    "wrist": (0.018, 0.0),
    "hip": (0.042, 0.0),
    "knee": (0.035, 0.0),
    "ankle": (0.027, 0.0),
}
#: Bones that are wider than deep: two capsules side by side.
_TRUNK = ("HumanoidRoot", "sacroiliac", "vl5")
#: Share of a trunk bone's vertices on either side that are taken for details.
_DETAILS = 5.0
#: A bone with fewer vertices than this has no surface to measure.
_FEWEST = 8
#: Percentile of the distances of a limb's vertices from its bone that is its radius: with it, depths are
#: nearest to those between the convex hulls of the posed parts of assets/humans/adult_man (9 mm in the mean).
_TYPICAL = 40.0
#: Capsule pairs times frames worked on at once: their vectors stay in the processor's cache.
_AT_ONCE = 20_000


@dataclass(frozen=True)
class Capsules:
    """Capsules (C) fixed to bones of ``skeleton``: ``bones`` (C,) index, axes from ``starts`` to ``ends``
    (C, 3) in bone space, ``radii`` (C,), metres.
    """

    skeleton: Skeleton
    bones: NDArray[np.intp]
    starts: Array
    ends: Array
    radii: Array

    @cached_property
    def pairs(self) -> NDArray[np.intp]:
        """(P, 2) bones that are held against each other: not those that are joined (connectors and collars
        count as the trunk) and not those whose capsules touch at rest.
        """
        return self._paired[0]

    @property
    def pair_names(self) -> tuple[tuple[str, str], ...]:
        """The names of :attr:`pairs`."""
        names = self.skeleton.names
        return tuple((names[a], names[b]) for a, b in self.pairs)

    def axes(self, posed: Array) -> tuple[Array, Array]:
        """Starts and ends (N, C, 3) of the capsules' axes in the space of posed bones (N, B, 4, 4)."""
        frames = posed[:, self.bones]
        starts, ends = (
            (frames[..., :3, :3] @ points[..., None])[..., 0] + frames[..., :3, 3]
            for points in (self.starts, self.ends)
        )
        return starts, ends

    @cached_property
    def _paired(self) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
        """Pairs of bones (P, 2), their pairs of capsules (Q, 2) in that order, and where each begins (P,)."""
        joined = self._joined()
        first, second = np.triu_indices(len(self.bones), 1)
        low, high = np.sort(np.stack([self.bones[first], self.bones[second]]), axis=0)
        order = np.lexsort([high, low])
        capsules, bones = np.stack([first, second], 1)[order], np.stack([low, high], 1)[order]
        apart = ~joined[tuple(bones.T)]
        bones, begins, number = _grouped(bones[apart])
        capsules = capsules[apart]
        at_rest = _depths(*self.axes(self.skeleton.rest[None]), self.radii, capsules)
        touching = np.maximum.reduceat(at_rest[0], begins) > 0 if len(begins) else np.zeros(0, bool)
        kept = ~touching[number]
        bones, begins, _ = _grouped(bones[number][kept])
        return bones, capsules[kept], begins

    def _joined(self) -> NDArray[np.bool_]:
        """(B, B) which bones are the same, or joined but for bones without capsules between them."""
        size = len(self.skeleton)
        has = np.isin(np.arange(size), self.bones)
        joined = np.eye(size, dtype=bool)
        for bone, parent in enumerate(self.skeleton.parents):
            while parent >= 0 and not has[parent]:
                parent = self.skeleton.parents[parent]
            if parent >= 0:
                joined[bone, parent] = joined[parent, bone] = True
        return joined


@dataclass(frozen=True)
class PenetrationReport:
    """The deepest penetration: ``depth_mm``, between the two bones of ``pair``, in ``frame``; the ``share``
    of frames in which any pair is deeper than ``tolerance_mm``, and ``pairs``: those that are, the deepest
    first, as (bone, bone, deepest mm, share of frames). ``dataclasses.asdict`` is JSON.
    """

    depth_mm: float
    pair: tuple[str, str] | None
    frame: int | None
    share: float
    tolerance_mm: float
    pairs: tuple[tuple[str, str, float, float], ...]


def capsules(body: Human | Skeleton) -> Capsules:
    """Capsules of a body as thick as its mesh: around the limbs' bones, with the usual distance of their own
    vertices from them; at each bone of the trunk, which is no cylinder, two side by side. A skeleton alone
    gets those of an average man of its height.

    Connectors, collars and bones without vertices of their own get none. MeshError if no bone has any.
    """
    skeleton = body.skeleton if isinstance(body, Human) else body
    rows = _measured(body) if isinstance(body, Human) else _usual(body)
    if not rows:
        raise MeshError("no bone of this skeleton can be given a capsule")
    bones = np.array([bone for bone, *_ in rows], dtype=np.intp)
    inverse = skeleton.rest_inverse[bones]
    starts, ends = (
        (inverse[:, :3, :3] @ np.array([row[i] for row in rows])[..., None])[..., 0] + inverse[:, :3, 3]
        for i in (1, 2)
    )
    return Capsules(skeleton, bones, starts, ends, np.array([row[3] for row in rows]))


def self_penetration(posed: Array, capsules: Capsules) -> Array:
    """How deep the capsules of each pair of bones are in each other (N, P) in poses (N, B, 4, 4), metres;
    below zero is the gap between them. The pairs are ``capsules.pairs``.
    """
    bones, pairs, begins = capsules._paired
    out = np.empty((len(posed), len(bones)))
    if not len(bones):
        return out
    step = max(1, _AT_ONCE // len(pairs))
    for first in range(0, len(posed), step):
        axes = capsules.axes(posed[first : first + step])
        depths = _depths(*axes, capsules.radii, pairs)
        np.maximum.reduceat(depths, begins, axis=1, out=out[first : first + step])
    return out


def report_penetration(posed: Array, capsules: Capsules, tolerance: float = 0.03) -> PenetrationReport:
    """What :func:`self_penetration` finds in poses (N, B, 4, 4). ``tolerance``: metres that flesh and
    clothes give, and by which capsules are not the body.
    """
    depths = self_penetration(posed, capsules)
    if not depths.size:
        return PenetrationReport(0.0, None, None, 0.0, 1e3 * tolerance, ())
    beyond = depths > tolerance
    deepest = depths.max(0)
    pairs = tuple(
        (*capsules.pair_names[pair], 1e3 * float(deepest[pair]), float(beyond[:, pair].mean()))
        for pair in np.argsort(-deepest)
        if beyond[:, pair].any()
    )
    frame, pair = np.unravel_index(np.argmax(depths), depths.shape)
    share, depth = float(beyond.any(1).mean()), 1e3 * float(depths[frame, pair])
    if depth <= 0:
        return PenetrationReport(0.0, None, None, share, 1e3 * tolerance, pairs)
    return PenetrationReport(depth, capsules.pair_names[int(pair)], int(frame), share, 1e3 * tolerance, pairs)


def segment_distance(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Shortest distances (...) between segments from a to b and from c to d (..., 3).

    Closed form: Ericson, Real-Time Collision Detection (2005), 5.1.9. Segments may be points.
    """
    # components first: sums over three numbers are slow along the last axis
    ax, bx, cx, dx = (np.moveaxis(p, -1, 0) for p in np.broadcast_arrays(a, b, c, d))
    return _distance(bx - ax, dx - cx, ax - cx)


def _distance(u: Array, v: Array, w: Array) -> Array:
    """Distances (...) of segments with directions u, v (3, ...), whose starts are w = a - c apart."""
    uu, vv, uv, uw, vw = _dot(u, u), _dot(v, v), _dot(u, v), _dot(u, w), _dot(v, w)
    uu_safe, vv_safe = np.maximum(uu, 1e-18), np.maximum(vv, 1e-18)
    across = uu * vv - uv * uv
    # parallel axes: any point of the first does
    s = np.where(across > 1e-12 * uu * vv, (uv * vw - uw * vv) / np.maximum(across, 1e-30), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((uv * s + vw) / vv_safe, 0.0, 1.0)
    s = np.clip((uv * t - uw) / uu_safe, 0.0, 1.0)
    between = w + s * u - t * v
    return np.sqrt(_dot(between, between))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _depths(starts: Array, ends: Array, radii: Array, pairs: NDArray[np.intp]) -> Array:
    """Depths (N, Q) of pairs (Q, 2) of capsules with axes (N, C, 3)."""
    along = np.moveaxis(ends - starts, -1, 0)
    at = np.moveaxis(starts, -1, 0)
    first, second = pairs.T
    apart = at.take(first, axis=2) - at.take(second, axis=2)
    distance = _distance(along.take(first, axis=2), along.take(second, axis=2), apart)
    return np.asarray(radii[first] + radii[second] - distance)


def _grouped(
    rows: NDArray[np.intp],
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Different rows of sorted ones, where each begins, and the number of each row's group."""
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]).any(1)
    return rows[new], np.flatnonzero(new), np.cumsum(new) - 1


#: bone, start and end of the axis in body space, radius
_Row = tuple[int, Array, Array, float]


def _measured(human: Human) -> list[_Row]:
    skeleton, owner = human.skeleton, dominant_bones(human.weights)
    vertices = human.mesh.vertices
    middle_bones = [b for b, name in enumerate(skeleton.names) if name in _TRUNK or _plain(name) == "hip"]
    of_middle = vertices[np.isin(owner, middle_bones)]
    rows: list[_Row] = []
    for bone, name in enumerate(skeleton.names):
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        if name in _TRUNK:
            height = np.sort([head[1], tail[1]])
            points = of_middle[(of_middle[:, 1] >= height[0]) & (of_middle[:, 1] <= height[1])]
            if len(points) >= _FEWEST:
                low, high = np.percentile(points, [_DETAILS, 100 - _DETAILS], axis=0)
                low[1], high[1] = height
                half, middle = (high - low) / 2, (high + low) / 2
                rows += _side_by_side(bone, middle, half[1], half[2], half[0])
        elif _plain(name) in _RADII:
            points = vertices[owner == bone]
            if len(points) >= _FEWEST:
                distances = segment_distance(points, points, head, tail)
                radius = float(np.percentile(distances, _TYPICAL))
                rows.append(_limb(skeleton, bone, radius))
    return rows


def _usual(skeleton: Skeleton) -> list[_Row]:
    height = skeleton.tails[:, 1].max() - min(0.0, skeleton.tails[:, 1].min())
    rows: list[_Row] = []
    for bone, name in enumerate(skeleton.names):
        if _plain(name) not in _RADII:
            continue
        radius, width = (height * share for share in _RADII[_plain(name)])
        if name in _TRUNK:
            middle = (skeleton.heads[bone] + skeleton.tails[bone]) / 2
            rows += _side_by_side(bone, middle, skeleton.lengths[bone] / 2, radius, width)
        else:
            rows.append(_limb(skeleton, bone, radius))
    return rows


def _side_by_side(bone: int, middle: Array, height: float, radius: float, width: float) -> list[_Row]:
    """Two upright capsules as wide and deep, and if they can as high, as half ``width``, ``radius`` and
    ``height`` say.
    """
    up = np.array([0.0, max(height - radius, 0.0), 0.0])
    aside = np.array([max(width - radius, 0.0), 0.0, 0.0])
    return [(bone, middle + side - up, middle + side + up, radius) for side in (aside, -aside)]


def _limb(skeleton: Skeleton, bone: int, radius: float) -> _Row:
    """A capsule from joint to joint. At the end of a limb its cap ends where the bone does, and the head's
    does not reach down into the neck.
    """
    head, tail = skeleton.heads[bone], skeleton.tails[bone]
    inset = (tail - head) * min(0.5, radius / skeleton.lengths[bone])
    if skeleton.names[bone] == "vt3":
        head = head + inset
    if bone in skeleton.leaves:
        tail = tail - inset
    return bone, head, tail, radius


def _plain(name: str) -> str:
    return name[2:] if name[:2] in ("l_", "r_") else name
