"""MakeHuman data of the package, in one small file. People by seed are made from it.

The targets of age, sex, ancestry, build and height are linear combinations of about a hundred components.
Their values are rounded to 40 micrometres and stored as differences. On the left half of the body, these are
differences to the mean of neighbours that were decoded before; on the right half, to the mirrored vertex.
Decoding gives the same bits on every machine.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.files.reading import read_blocks, read_npz, resource_path
from humansim_ros.people.makehuman.data import INSTALL, Base, MakeHumanData, VertexIndices, VertexMask
from humansim_ros.types import Array

#: Number of steps in a decimetre (of vertices, sparse targets and components), and in the width of the
#: texture.
VERTEX_STEPS, SPARSE_STEPS, COMPONENT_STEPS, UV_STEPS = 10_000, 1000, 2500, 1_000_000
MASKS = ("ears", "lips", "fingernails", "inside-mouth")
#: Prefix of the names of actions of the face among the sparse targets.
ACTION = "faceunits/"


@functools.lru_cache(maxsize=1)
def people_data() -> MakeHumanData:
    """The data of the package. People by seed are made from them on every machine, whatever is installed."""
    return PackedData(resource_path("assets/makehuman/base.npz"))


class PackedData(MakeHumanData):
    """MakeHuman data from a file of :func:`pack`."""

    def __init__(self, path: Path) -> None:
        self.folder = path

    @functools.cached_property
    def _arrays(self) -> Mapping[str, NDArray[Any]]:
        return read_npz(self.folder, MeshError, "MakeHuman")

    @functools.cached_property
    def version(self) -> str:
        """Digest of the file."""
        digest = hashlib.sha256()
        for block in read_blocks(self.folder, MeshError, "MakeHuman"):
            digest.update(block)
        return digest.hexdigest()

    @functools.cached_property
    def weights(self) -> dict[str, list[tuple[int, float]]]:
        """Pairs of vertex and weight for each bone."""
        arrays, out = self._arrays, {}
        for number, name in enumerate(arrays["bones"].tolist()):
            some = slice(arrays["bone_starts"][number], arrays["bone_starts"][number + 1])
            pairs = zip(
                arrays["bone_rows"][some].tolist(), arrays["bone_weights"][some].tolist(), strict=True
            )
            out[str(name)] = list(pairs)
        return out

    def mask(self, name: str) -> VertexMask:
        """Painted UV mask (2048, 2048), 0 to 1."""
        if name not in self._masks:
            image = cv2.imdecode(self._arrays[f"mask_{name}"], cv2.IMREAD_GRAYSCALE)
            self._masks[name] = np.asarray(image, np.float32) / np.float32(255)
        return self._masks[name]

    @functools.cached_property
    def base(self) -> Base:
        """Base mesh without targets, in decimetres."""
        arrays = self._arrays
        groups = arrays["groups"][arrays["face_groups"]]
        spans: Mapping[str, Any] = json.loads(arrays["vertex_groups"].tobytes())
        return Base(
            arrays["vertices"] / VERTEX_STEPS,
            arrays["uv"] / UV_STEPS,
            arrays["faces"].astype(np.int64),
            arrays["uv_faces"].astype(np.int64),
            groups,
            {name: np.concatenate([np.arange(*span) for span in each]) for name, each in spans.items()},
        )

    def has_target(self, name: str) -> bool:
        """Whether MakeHuman has a target. The file does not have all targets."""
        return name in self._known

    @functools.cached_property
    def _known(self) -> frozenset[str]:
        return frozenset(self._arrays["known"].tolist())

    @functools.cached_property
    def _sparse(self) -> dict[str, int]:
        return {name: number for number, name in enumerate(self._arrays["sparse_names"].tolist())}

    @functools.cached_property
    def _dense(self) -> dict[str, int]:
        return {name: number for number, name in enumerate(self._arrays["target_names"].tolist())}

    @functools.cached_property
    def _components(self) -> NDArray[np.int32]:
        """(R, 3, V) values in steps."""
        arrays = self._arrays
        folded = arrays["low"].astype(np.int32) | arrays["high"].astype(np.int32) << 8
        return undone(np.where(folded & 1, -(folded + 1) // 2, folded // 2), self.base)

    def target(self, name: str) -> tuple[VertexIndices, Array]:
        """Vertices (K,) that a target moves, and their offsets (K, 3) in decimetres. Raises MeshError."""
        if name in self._sparse:
            return self._offsets(name)
        if name not in self._dense:
            raise MeshError(f"the package does not contain MakeHuman's target {name}: {INSTALL}")
        if name not in self._targets:
            steps = np.zeros((3, len(self.base.vertices)))
            for share, component in zip(
                self._arrays["mixing"][self._dense[name]].tolist(), self._components, strict=True
            ):
                steps += (share / COMPONENT_STEPS) * component
            self._targets[name] = (np.arange(len(self.base.vertices)), np.ascontiguousarray(steps.T))
        return self._targets[name]

    def face_action(self, name: str) -> tuple[VertexIndices, Array]:
        """Vertices (K,) that an action of the face moves, and their offsets (K, 3) in decimetres."""
        return self._offsets(f"{ACTION}{name}")

    def _offsets(self, path: str) -> tuple[VertexIndices, Array]:
        arrays, number = self._arrays, self._sparse[path]
        some = slice(arrays["sparse_starts"][number], arrays["sparse_starts"][number + 1])
        return arrays["sparse_rows"][some].astype(np.int64), arrays["sparse_steps"][some] / SPARSE_STEPS


def differences(components: NDArray[np.int32], base: Base) -> NDArray[np.int32]:
    """Differences (R, 3, V) between components (R, 3, V) and the values that :func:`undone` predicts."""
    steps = _by_vertex(components)
    out = steps.copy()
    left, right = _mirrored(base)
    for rows, sums, counts in _rounds(base, right):
        out[rows] -= _rounded(sums @ steps, counts)
    out[right] -= steps[left] * _mirror(len(components))
    return _by_component(out)


def undone(steps: NDArray[np.int32], base: Base) -> NDArray[np.int32]:
    """Restore components (R, 3, V) from their :func:`differences`."""
    out = _by_vertex(steps)
    left, right = _mirrored(base)
    for rows, sums, counts in _rounds(base, right):
        out[rows] += _rounded(sums @ out, counts)
    out[right] += out[left] * _mirror(len(steps))
    return _by_component(out)


def _by_vertex(components: NDArray[np.int32]) -> NDArray[np.int32]:
    """Rows (V, 3 R) of components (R, 3, V)."""
    return np.ascontiguousarray(components.reshape(-1, components.shape[2]).T)


def _by_component(rows: NDArray[np.int32]) -> NDArray[np.int32]:
    """Components (R, 3, V) of rows (V, 3 R)."""
    return np.ascontiguousarray(rows.T).reshape(-1, 3, len(rows))


def _mirror(count: int) -> NDArray[np.int32]:
    """Factors (3 R,) of rows of ``count`` components on the other half of the body."""
    return np.tile(np.array([-1, 1, 1], np.int32), count)


def _rounded(total: NDArray[np.int32], count: NDArray[np.int32]) -> NDArray[np.int32]:
    return (2 * total + count) // (2 * count)


def _mirrored(base: Base) -> tuple[VertexIndices, VertexIndices]:
    """Vertices of the left half, and their mirror images on the right."""
    places = np.rint(base.vertices * VERTEX_STEPS).astype(np.int64)
    number = {tuple(place): vertex for vertex, place in enumerate(places.tolist())}
    right = np.flatnonzero(places[:, 0] < 0)
    left = np.array([number.get((-x, y, z), -1) for x, y, z in places[right].tolist()], np.int64)
    return left[left >= 0], right[left >= 0]


def _rounds(base: Base, mirrored: VertexIndices) -> list[tuple[VertexIndices, csr_matrix, NDArray[np.int32]]]:
    """Rounds of decoding: the vertices of a round are predicted from neighbours in earlier rounds.

    Args:
        base: Base mesh.
        mirrored: Vertices (K,) that are mirror images. No round has them.

    Returns:
        For each round: vertices (M,), the matrix (M, V) that sums the values of their earlier neighbours, and
        the number (M, 1) of these neighbours.
    """
    count = len(base.vertices)
    left = np.ones(count, bool)
    left[mirrored] = False
    before, after = np.sort(np.concatenate([base.faces[:, [k - 1, k]] for k in range(4)]), axis=1).T
    chosen = left[before] & left[after] & (before != after)
    before, after = before[chosen], after[chosen]
    sums = csr_matrix((np.ones(len(after), np.int32), (after, before)), shape=(count, count))
    sums.data[:] = 1  # sides of two faces
    number = np.diff(sums.indptr).astype(np.int32)[:, None]
    depth, deeper = np.full(count, -1), np.zeros(count, np.int64)
    while (depth != deeper).any():
        depth = deeper.copy()
        np.maximum.at(deeper, after, depth[before] + 1)
    rounds = [np.flatnonzero(depth == level) for level in range(1, int(depth.max()) + 1)]
    return [(rows, sums[rows], number[rows]) for rows in rounds]
