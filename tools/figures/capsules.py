"""Self-penetration of a body: overlap of capsules that approximate its parts.

depths = self_penetration(posed, fit_capsules(human.skeleton, human.mesh, human.weights))
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh.mesh import Mesh
from humansim_ros.geometry import rotate
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.motion.body.skinning import dominant_bones, without_details
from humansim_ros.types import Array, Indices

#: Radii of capsules as shares of the stature; for the trunk, half widths, too. From assets/humans/adult_man.
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
#: These bones are wider than deep, so they get two capsules side by side.
_TRUNK = ("HumanoidRoot", "sacroiliac", "vl5")
#: This percentage of the vertices of a trunk bone, on either side, are details that do not count as its
#: width.
_DETAIL_PERCENTILE = 5.0
#: A bone with fewer vertices gets no capsule.
_MIN_VERTICES = 8
#: The radius of the capsule of a limb is this percentile of the distances of its vertices from the bone. It
#: was chosen so that depths are nearest to those between convex hulls of the posed parts of
#: assets/humans/adult_man (mean difference 9 mm).
_RADIUS_PERCENTILE = 40.0
#: Capsule pairs times frames that are computed at once. Their vectors fit into the cache of the processor.
_BATCH = 20_000


@dataclass(frozen=True)
class Capsules:
    """C capsules fixed to bones of a skeleton.

    Attributes:
        skeleton: The skeleton.
        bones: (C,) bone index.
        starts: (C, 3) starts of the axes in bone space, metres.
        ends: (C, 3) ends of the axes in bone space, metres.
        radii: (C,) metres.
    """

    skeleton: Skeleton
    bones: Indices
    starts: Array
    ends: Array
    radii: Array

    @property
    def pairs(self) -> Indices:
        """(P, 2) pairs of bones that are compared. Bones that are joined are left out (connectors and collars
        count as the trunk here), and bones with capsules that touch at rest."""
        return self._pair_table[0]

    @property
    def pair_names(self) -> tuple[tuple[str, str], ...]:
        """Names of :attr:`pairs`."""
        names = self.skeleton.names
        return tuple((names[a], names[b]) for a, b in self.pairs)

    def axes(self, posed: Array) -> tuple[Array, Array]:
        """Starts and ends (N, C, 3) of the axes, in the space of the posed bones (N, B, 4, 4)."""
        frames = posed[:, self.bones]
        starts, ends = (
            rotate(frames[..., :3, :3], points) + frames[..., :3, 3] for points in (self.starts, self.ends)
        )
        return starts, ends

    def depths(self, posed: Array, pairs: Indices) -> Array:
        """Depths (N, Q) in metres of pairs (Q, 2) of capsules. Negative if the capsules do not touch."""
        starts, ends = self.axes(posed)
        first, second = pairs.T
        distance = segment_distance(starts[:, first], ends[:, first], starts[:, second], ends[:, second])
        return np.asarray(self.radii[first] + self.radii[second] - distance)

    @cached_property
    def _pair_table(self) -> tuple[Indices, Indices, Indices]:
        """Return three arrays: pairs of bones (P, 2); pairs of capsules (Q, 2), sorted by their pair of
        bones; and the index (P,) of the first pair of capsules of each pair of bones."""
        capsules = np.stack(np.triu_indices(len(self.bones), 1), axis=1)
        bones = np.sort(self.bones[capsules], axis=1)
        order = np.lexsort(bones.T[::-1])
        order = order[~self._adjacent()[tuple(bones[order].T)]]
        capsules, bones = capsules[order], bones[order]
        pairs, number = np.unique(bones, axis=0, return_inverse=True)
        at_rest = np.full(len(pairs), -np.inf)
        np.maximum.at(at_rest, number.ravel(), self.depths(self.skeleton.rest[None], capsules)[0])
        compared = at_rest[number.ravel()] <= 0
        pairs, begins = np.unique(bones[compared], axis=0, return_index=True)
        return pairs, capsules[compared], begins

    def _adjacent(self) -> NDArray[np.bool_]:
        """(B, B) whether two bones are the same, or are joined directly or through bones without capsules."""
        size = len(self.skeleton)
        joined = np.eye(size, dtype=bool)
        for bone, parent in enumerate(self.skeleton.parents):
            while parent >= 0 and parent not in self.bones:
                parent = self.skeleton.parents[parent]
            if parent >= 0:
                joined[bone, parent] = joined[parent, bone] = True
        return joined


@dataclass(frozen=True)
class PenetrationReport:
    """Penetration of the bones of a body over some frames.

    Attributes:
        depth_mm: Deepest penetration.
        pair: The two bones of the deepest penetration.
        frame: Frame of the deepest penetration.
        share: Share of the frames in which any pair is deeper than the tolerance.
        tolerance_mm: Depth that is tolerated.
        pairs: Pairs deeper than the tolerance, deepest first, as (bone, bone, deepest mm, share of frames).
    """

    depth_mm: float
    pair: tuple[str, str] | None
    frame: int | None
    share: float
    tolerance_mm: float
    pairs: tuple[tuple[str, str, float, float], ...]


def fit_capsules(skeleton: Skeleton, mesh: Mesh | None = None, weights: csr_matrix | None = None) -> Capsules:
    """Fit capsules to a skeleton and the mesh around it.

    A limb gets one capsule. Its radius is a typical distance of the vertices from their bone. A bone of the
    trunk is not like a cylinder, so it gets two capsules side by side. If there is no ``mesh`` with
    ``weights`` (V, B), the capsules have the radii of an average man of the same stature. Connectors, collars
    and bones without vertices get no capsule.

    Raises:
        MeshError: No bone gets a capsule.
    """
    kinds = [name[2:] if name[:2] in ("l_", "r_") else name for name in skeleton.names]
    owners = None if mesh is None or weights is None else dominant_bones(without_details(weights, skeleton))
    trunk = [bone for bone, kind in enumerate(kinds) if kind in (*_TRUNK, "hip")]
    stature = skeleton.tails[:, 1].max() - min(0.0, skeleton.tails[:, 1].min())
    rows: list[tuple[int, Array, Array, float]] = []
    for bone, kind in enumerate(kinds):
        if kind not in _RADII:
            continue
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        radius, width = (stature * share for share in _RADII[kind])
        middle, half = (head + tail) / 2, np.array([width, skeleton.lengths[bone] / 2, radius])
        if mesh is not None and owners is not None:
            points = mesh.vertices[np.isin(owners, trunk if kind in _TRUNK else bone)]
            if kind in _TRUNK:
                low, high = np.sort([head[1], tail[1]])
                points = points[(points[:, 1] >= low) & (points[:, 1] <= high)]
            if len(points) < _MIN_VERTICES:
                continue
            if kind in _TRUNK:
                sides = np.percentile(points, [_DETAIL_PERCENTILE, 100 - _DETAIL_PERCENTILE], axis=0)
                sides[:, 1] = low, high
                middle, half = sides.mean(axis=0), np.ptp(sides, axis=0) / 2
            else:
                radius = np.percentile(segment_distance(points, points, head, tail), _RADIUS_PERCENTILE)
        if kind in _TRUNK:
            away, up, _ = np.diag(np.maximum(half - half[2], 0.0))
            rows += [(bone, middle + side - up, middle + side + up, half[2]) for side in (away, -away)]
            continue
        # a limb without a limb below ends with its cap; the capsule of the head does not reach into the neck
        inset = (tail - head) * min(0.5, radius / skeleton.lengths[bone])
        start = head + inset if kind == "vt3" else head
        rows.append((bone, start, tail - inset if bone in skeleton.ends else tail, radius))
    if not rows:
        raise MeshError("no bone of this skeleton can have a capsule: none is a limb or part of the trunk")
    bones, starts, ends, radii = (np.array(column) for column in zip(*rows, strict=True))
    inverse = skeleton.rest_inverse[bones]
    starts, ends = (rotate(inverse[:, :3, :3], points) + inverse[:, :3, 3] for points in (starts, ends))
    return Capsules(skeleton, bones, starts, ends, radii)


def self_penetration(posed: Array, capsules: Capsules) -> Array:
    """Depth (N, P) in metres by which the bones of each pair penetrate each other, in poses (N, B, 4, 4). The
    pairs are ``capsules.pairs``. A negative depth is the gap between the two bones."""
    bones, pairs, begins = capsules._pair_table
    out = np.empty((len(posed), len(bones)))
    if not len(bones):
        return out
    step = max(1, _BATCH // len(pairs))
    for first in range(0, len(posed), step):
        depths = capsules.depths(posed[first : first + step], pairs)
        np.maximum.reduceat(depths, begins, axis=1, out=out[first : first + step])
    return out


def report_penetration(posed: Array, capsules: Capsules, tolerance: float = 0.03) -> PenetrationReport:
    """Summarise :func:`self_penetration` over poses (N, B, 4, 4).

    ``tolerance``: metres. Flesh and clothes yield, and capsules only approximate the body.
    """
    depths = self_penetration(posed, capsules)
    beyond, deepest = depths > tolerance, depths.max(0, initial=0.0)
    pairs = tuple(
        (*capsules.pair_names[pair], 1e3 * float(deepest[pair]), float(beyond[:, pair].mean()))
        for pair in np.argsort(-deepest)
        if beyond[:, pair].any()
    )
    depth, share = float(deepest.max(initial=0.0)), float(beyond.any(1).mean()) if depths.size else 0.0
    where: tuple[tuple[str, str] | None, int | None] = None, None
    if depth > 0:
        frame, pair = np.unravel_index(np.argmax(depths), depths.shape)
        where = capsules.pair_names[int(pair)], int(frame)
    return PenetrationReport(1e3 * depth, *where, share, 1e3 * tolerance, pairs)


def segment_distance(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Shortest distances (...) between segments [Ericson 2005, 5.1.9]. A segment may be a point.

    Args:
        a: Starts (..., 3) of the first segments.
        b: Ends (..., 3) of the first segments.
        c: Starts (..., 3) of the second segments.
        d: Ends (..., 3) of the second segments.
    """
    # components go first, since sums of three numbers along the last axis are slow
    a, b, c, d = (np.moveaxis(points, -1, 0) for points in np.broadcast_arrays(a, b, c, d))
    u, v, w = b - a, d - c, a - c
    uu, vv, uv, uw, vw = ((p * q).sum(axis=0) for p, q in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    uu_safe, vv_safe = np.maximum(uu, 1e-18), np.maximum(vv, 1e-18)
    determinant = uu * vv - uv * uv
    # if segments are parallel, any point of the first one is good
    s = np.where(determinant > 1e-12 * uu * vv, (uv * vw - uw * vv) / np.maximum(determinant, 1e-30), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((uv * s + vw) / vv_safe, 0.0, 1.0)
    s = np.clip((uv * t - uw) / uu_safe, 0.0, 1.0)
    between = w + s * u - t * v
    return np.asarray(np.sqrt((between * between).sum(axis=0)))
