"""Offsets of vertices in addition to skinning: shapes (morph targets); loose skirts, coats and hair.

Weights from 0 to 1 add shapes in the rest pose. Loose parts follow the bones, like all skin. Their swing is
added in ``map``. Cloth around the thighs is drawn together (gathered) when its wearer sits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError
from humansim_ros.geometry import smooth_step
from humansim_ros.motion.body.kinematics import Rated
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.types import Array

#: Unit of offsets in the file of a body that is not scaled, metres. Targets of MakeHuman are multiples of 80
#: units. The largest offset is 0.0343 m, and 16 bits hold 0.041 m.
FILE_UNIT = 1.25e-6
#: Largest plausible offset of a shape, metres.
_MAX_OFFSET = 10.0
#: Most shapes of a human.
MAX_SHAPES = 1024
_SHAPE_ARRAYS = ("shape_names", "shape_starts", "shape_rows", "shape_offsets", "shape_unit")


@dataclass(frozen=True)
class Shapes:
    """S shapes. Shape s moves vertices ``rows[starts[s] : starts[s + 1]]`` by the same rows of ``offsets``.

    Attributes:
        names: S names.
        starts: (S + 1,) index of the first row of each shape, then K.
        rows: (K,) numbers of the vertices. A vertex occurs at most once in a shape.
        offsets: (K, 3) metres in the space of the mesh at rest.
    """

    names: tuple[str, ...]
    starts: NDArray[np.integer]
    rows: NDArray[np.integer]
    offsets: NDArray[np.floating]

    @classmethod
    def of_offsets(cls, names: tuple[str, ...], offsets: Array) -> Shapes:
        """Create shapes from the offsets (V, S, 3) of all vertices."""
        shape, rows = np.nonzero(offsets.any(axis=2).T)
        starts = np.searchsorted(shape, np.arange(len(names) + 1))
        return cls(names, starts, rows, offsets[rows, shape])

    @cached_property
    def moved(self) -> NDArray[np.intp]:
        """(M,) vertices that any shape moves, sorted."""
        return np.unique(self.rows)

    @cached_property
    def _places(self) -> NDArray[np.intp]:
        """(K,) index in ``moved`` of each row."""
        return np.searchsorted(self.moved, self.rows)

    def at(self, weights: Array) -> NDArray[np.float32]:
        """Sum the weighted offsets (M, 3) of the vertices :attr:`moved`, skipping shapes with weight 0."""
        out = np.zeros((len(self.moved), 3), dtype=np.float32)
        for number in np.flatnonzero(weights):
            some = slice(self.starts[number], self.starts[number + 1])
            out[self._places[some]] += np.float32(weights[number]) * self.offsets[some].astype(np.float32)
        return out


def shape_arrays(shapes: Shapes, scale: float = 1.0) -> dict[str, NDArray[Any]]:
    """Make the arrays that store shapes in a human file. The rounding error of offsets is at most 0.6
    micrometres, or more if offsets are too large for 16 bits. ``scale``: factor of a scaled body."""
    unit = max(FILE_UNIT * scale, float(np.abs(shapes.offsets).max(initial=0.0)) / 32767)
    return {
        "shape_names": np.array(shapes.names),
        "shape_starts": shapes.starts.astype(np.int32),
        "shape_rows": shapes.rows.astype(np.int32),
        "shape_offsets": np.rint(shapes.offsets / unit).astype(np.int16),
        "shape_unit": np.array(unit),
    }


def read_shapes(arrays: Mapping[str, NDArray[Any]], vertices: int) -> Shapes | None:
    """Shapes from the arrays of a human file; None if the file has none. ``vertices``: number of vertices of
    the mesh. Raises MeshError, or KeyError for a missing array."""
    if "shape_names" not in arrays:
        return None
    names, *numbers = (arrays[key] for key in _SHAPE_ARRAYS)
    texts = tuple(str(name) for name in names.ravel())
    if len(set(texts)) < len(texts) or len(texts) > MAX_SHAPES:
        raise MeshError(f"needs at most {MAX_SHAPES} names, each once", key="shape_names")
    for key, array, kinds in zip(_SHAPE_ARRAYS[1:], numbers, ("iu", "iu", "iuf", "iuf"), strict=True):
        if array.dtype.kind not in kinds:
            raise MeshError(f"must be numbers, not {array.dtype}", key=key)
    starts, rows, offsets, unit = numbers
    if starts.shape != (len(texts) + 1,) or starts[0] != 0 or starts[-1] != len(rows):
        raise MeshError(f"must be {len(texts) + 1} numbers from 0 to {len(rows)}", key="shape_starts")
    counts = starts[1:].astype(np.intp) - starts[:-1].astype(np.intp)
    if (counts < 0).any():
        raise MeshError("must rise", key="shape_starts")
    if rows.ndim != 1 or (len(rows) and not 0 <= rows.min() <= rows.max() < vertices):
        raise MeshError(f"must be vertices below {vertices}", key="shape_rows")
    shape = np.repeat(np.arange(len(texts)), counts)
    if len(np.unique(shape * vertices + rows.astype(np.int64))) < len(rows):
        raise MeshError("a shape moves a vertex twice", key="shape_rows")
    if offsets.shape != (len(rows), 3) or unit.shape != ():
        raise MeshError(f"must be ({len(rows)}, 3), not {offsets.shape}", key="shape_offsets")
    with np.errstate(over="ignore", invalid="ignore"):
        metres = (offsets.astype(float) * float(unit)).astype(np.float32)
    if not (np.abs(metres) <= _MAX_OFFSET).all():
        raise MeshError(f"must be finite and at most {_MAX_OFFSET:g} m", key="shape_offsets")
    return Shapes(texts, starts.astype(np.intp), rows.astype(np.intp), metres)


#: Kinds of loose parts. The numbers are used in files.
CLOTH, HAIR = range(2)
#: Most ends of loose parts of a human. The limit exists because each end is a joint of the human's motion.
MAX_ENDS = 64
#: Angles of a raised thigh at which cloth begins to gather, and at which it is fully gathered, radians.
_GATHERED = (np.radians(50.0), np.radians(85.0))
_LEGS = ("l_hip", "r_hip")
_SHINS = ("l_knee", "r_knee")
#: Cloth hangs free of a leg if it is farther from the bone than this share of the length of the thigh.
_FREE = 0.3
#: Cloth that is held off one bone may come nearer to another bone of a leg by at most this, metres.
_NEARER = 0.01
_LOOSE_ARRAYS = ("kinds", "ends", "outwards", "rows", "nodes", "shares", "gather", "left")


@dataclass(frozen=True, eq=False)
class LooseParts:
    """Loose parts (skirts, coats, hair): K ends that swing, and M vertices that follow the ends.

    Attributes:
        kinds: (K,) :data:`CLOTH` or :data:`HAIR`.
        ends: (K, 2) vertices: where a part hangs from, and its lower end.
        outwards: (K, 3) unit direction away from the body at each end, at rest.
        rows: (M,) vertices that follow, each once.
        nodes: (M, 2) the two ends that each vertex follows.
        shares: (M, 2) shares of the swings of these two ends that each vertex takes.
        gather: (M, 3) offsets of gathered cloth in the rest pose, metres: the cloth of a wearer who sits.
        left: (M,) share of ``gather`` that follows the left leg. The right leg takes the remaining share.
    """

    kinds: NDArray[np.uint8]
    ends: NDArray[np.int32]
    outwards: NDArray[np.float32]
    rows: NDArray[np.int32]
    nodes: NDArray[np.int32]
    shares: NDArray[np.float32]
    gather: NDArray[np.float32]
    left: NDArray[np.float32]

    @cached_property
    def _cloth(self) -> NDArray[np.intp]:
        """Indices, among the M vertices, of cloth that swings."""
        return np.flatnonzero((self.kinds[self.nodes[:, 0]] == CLOTH) & (self.shares > 0).any(axis=1))

    def swung(
        self, points: NDArray[np.float32], swing: Array, skeleton: Skeleton, transforms: Array
    ) -> NDArray[np.float32]:
        """Move vertices (M, 3) by a swing. The swing brings cloth no nearer to the bones of the legs.

        Args:
            points, swing: Vertices (M, 3) without swing, and offsets (K, 3) of the ends.
            skeleton, transforms: Skeleton, and rest-to-posed transforms (B, 4, 4) of its bones.
        """
        ends = swing.astype(np.float32)
        first, second = self.shares.T[..., None]
        moved = points + (first * ends[self.nodes[:, 0]] + second * ends[self.nodes[:, 1]])
        if not len(self._cloth) or not set(_LEGS) <= set(skeleton.names):
            return np.asarray(moved)
        legs, cloth = tuple(_legs(skeleton, transforms)), moved[self._cloth]
        near = [_to_segment(cloth, *leg)[0] < room for leg, room in legs]
        rows = self._cloth[np.logical_or.reduce(near)]
        still, cloth = points[rows], moved[rows]
        least = [(leg, np.minimum(_to_segment(still, *leg)[0], room)) for leg, room in legs]
        for leg, before in least:
            distance, nearest = _to_segment(cloth, *leg)
            factor = before / np.maximum(distance, 1e-6)
            held = np.flatnonzero(factor > 1)
            cloth[held] = nearest[held] + factor[held, None] * (cloth[held] - nearest[held])
        # where cloth pushed off one bone nears another, cancel the swing
        nearer = [before - _to_segment(cloth, *leg)[0] for leg, before in least]
        back = np.clip(np.maximum.reduce(nearer) / _NEARER, 0.0, 1.0)[:, None]
        moved[rows] = cloth + back * (still - cloth)
        return np.asarray(moved)

    def gathered(self, skeleton: Skeleton, transforms: Array) -> NDArray[np.float32] | None:
        """Return offsets (M, 3) in the rest pose that lay cloth on the thighs. None if no thigh is raised.
        ``transforms``: rest-to-posed transforms (B, 4, 4) of the bones."""
        if not set(_LEGS) <= set(skeleton.names):
            return None
        low, high = _GATHERED
        pelvis = transforms[0, :3, :3]
        shares = []
        for name in _LEGS:
            _, up, ahead = pelvis.T @ transforms[skeleton.bone(name), :3, :3] @ (0.0, -1.0, 0.0)
            shares.append(np.float32(smooth_step((np.arctan2(ahead, -up) - low) / (high - low))))
        if not any(shares):
            return None
        left, right = shares
        return np.asarray((self.left * left + (1 - self.left) * right)[:, None] * self.gather)


def _legs(skeleton: Skeleton, transforms: Array) -> Iterator[tuple[tuple[Array, Array], float]]:
    """For each bone of both legs: its ends (3,) and (3,), and the distance that cloth keeps from the bone."""
    for name in (*_LEGS, *_SHINS):
        bone = skeleton.bone(name)
        turn, shift = transforms[bone, :3, :3], transforms[bone, :3, 3]
        start, end = (turn @ point + shift for point in (skeleton.heads[bone], skeleton.tails[bone]))
        room = _FREE * float(np.linalg.norm(end - start))
        yield (start.astype(np.float32), end.astype(np.float32)), room


def _to_segment(
    points: NDArray[np.float32], start: Array, end: Array
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """For points (N, 3): the distances (N,) from a segment, and the nearest points (N, 3) of the segment."""
    along = end - start
    share = np.clip((points - start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
    nearest = start + share[:, None] * along
    off = points - nearest
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", off, off))), np.asarray(nearest)


def swing_at_rest(count: int) -> Rated:
    """Create the swing of K loose ends that hang still: offsets (K, 3) of zero, metres in ``map``."""
    return Rated.at_rest(tuple(f"{number}/{axis}" for number in range(count) for axis in "xyz"), (count, 3))


def loose_arrays(parts: LooseParts) -> dict[str, NDArray[Any]]:
    """Return the arrays that store loose parts in a human file."""
    return {f"loose_{name}": getattr(parts, name) for name in _LOOSE_ARRAYS}


def read_loose(arrays: Mapping[str, NDArray[Any]], vertices: int) -> LooseParts | None:
    """Read loose parts in the same way as :func:`read_shapes`. None if the file has no loose parts."""
    if "loose_kinds" not in arrays:
        return None
    count, rows = len(arrays["loose_kinds"].ravel()), len(arrays["loose_rows"].ravel())
    if not 1 <= count <= MAX_ENDS:
        raise MeshError(f"needs 1 to {MAX_ENDS} ends, not {count}", key="loose_kinds")
    # dtype, shape, and the number that whole numbers must be below
    layout: dict[str, tuple[str, tuple[int, ...], int]] = {
        "kinds": ("uint8", (count,), HAIR + 1),
        "ends": ("int32", (count, 2), vertices),
        "outwards": ("float32", (count, 3), 0),
        "rows": ("int32", (rows,), vertices),
        "nodes": ("int32", (rows, 2), count),
        "shares": ("float32", (rows, 2), 0),
        "gather": ("float32", (rows, 3), 0),
        "left": ("float32", (rows,), 0),
    }
    found = {}
    for name, (kind, shape, limit) in layout.items():
        array, key = arrays[f"loose_{name}"], f"loose_{name}"
        if array.dtype != kind or array.shape != shape:
            raise MeshError(f"must be {shape} {kind}, not {array.shape} {array.dtype}", key=key)
        if limit and array.size and not 0 <= array.min() <= array.max() < limit:
            raise MeshError(f"must be from 0 to {limit - 1}", key=key)
        if not limit and not (np.abs(array) <= 1.0).all():
            raise MeshError("must be finite and at most 1", key=key)
        found[name] = array
    if len(np.unique(found["rows"])) < rows:
        raise MeshError("a vertex is there twice", key="loose_rows")
    return LooseParts(**found)
