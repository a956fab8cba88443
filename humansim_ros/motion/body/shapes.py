"""Shapes of a mesh (morph targets): offsets of some vertices in the rest pose. Weights from 0 to 1 add
them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError
from humansim_ros.types import Array

#: Unit of offsets in the file of a body that is not scaled, metres. Targets of MakeHuman are multiples of 80
#: units. The largest offset is 0.0343 m, and 16 bits hold 0.041 m.
FILE_UNIT = 1.25e-6
#: Largest plausible offset of a shape, metres.
_MAX_OFFSET = 10.0
#: Most shapes of a human.
MAX_SHAPES = 1024
_ARRAYS = ("shape_names", "shape_starts", "shape_rows", "shape_offsets", "shape_unit")


@dataclass(frozen=True)
class Shapes:
    """S shapes; shape s moves the vertices ``rows[starts[s] : starts[s + 1]]`` by those rows of ``offsets``.

    Attributes:
        names: S names.
        starts: (S + 1,).
        rows: (K,) vertices, each once in a shape.
        offsets: (K, 3) metres in the space of the mesh at rest.
    """

    names: tuple[str, ...]
    starts: NDArray[np.integer]
    rows: NDArray[np.integer]
    offsets: NDArray[np.floating]

    @classmethod
    def of_offsets(cls, names: tuple[str, ...], offsets: Array) -> Shapes:
        """Shapes of dense offsets (V, S, 3)."""
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
        """Sum of the weighted offsets (M, 3) of the vertices ``moved``. Shapes with weight 0 cost no time."""
        out = np.zeros((len(self.moved), 3), dtype=np.float32)
        for number in np.flatnonzero(weights):
            some = slice(self.starts[number], self.starts[number + 1])
            out[self._places[some]] += np.float32(weights[number]) * self.offsets[some].astype(np.float32)
        return out


def shape_arrays(shapes: Shapes, scale: float = 1.0) -> dict[str, NDArray[Any]]:
    """Arrays of a human file with shapes. The rounding error of offsets is at most half of the unit, 0.6
    micrometres. ``scale``: factor of a scaled body. If offsets are too large for 16 bits, the unit is
    larger."""
    largest = float(np.abs(shapes.offsets).max(initial=0.0))
    unit = FILE_UNIT * scale
    if largest > 32767 * unit:
        unit = largest / 32767
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
    names, starts, rows, offsets, unit = (arrays[key] for key in _ARRAYS)
    texts = tuple(str(name) for name in names.ravel())
    if len(set(texts)) < len(texts) or len(texts) > MAX_SHAPES:
        raise MeshError(f"needs at most {MAX_SHAPES} names, each once", key="shape_names")
    for key, array, kinds in (
        ("shape_starts", starts, "iu"),
        ("shape_rows", rows, "iu"),
        ("shape_offsets", offsets, "iuf"),
        ("shape_unit", unit, "iuf"),
    ):
        if array.dtype.kind not in kinds:
            raise MeshError(f"must be numbers, not {array.dtype}", key=key)
    if starts.shape != (len(texts) + 1,) or starts[0] != 0 or starts[-1] != len(rows):
        raise MeshError(f"must be {len(texts) + 1} numbers from 0 to {len(rows)}", key="shape_starts")
    first = starts.astype(np.intp)
    counts = first[1:] - first[:-1]
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
