"""MakeHuman data of the package: what people by seed are made of, in one small file.

The targets of age, sex, ancestry, build and height are linear combinations of about a hundred components.
Their values are rounded to 40 micrometres, and stored as differences: on the left half of the body from the
mean of the neighbours before, on the right half from the mirrored vertex. They are decoded by operations that
give the same bits on every machine.
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

from humansim_ros.errors import MeshError
from humansim_ros.humans.makehuman.data import INSTALL, Base, MakeHumanData, VertexIndices, VertexMask
from humansim_ros.io.assets import resource_path
from humansim_ros.io.files import read_blocks
from humansim_ros.io.npz import read_npz
from humansim_ros.types import Array

#: Steps in a decimetre of vertices, sparse targets and components, and in the width of the texture.
VERTEX_STEPS, SPARSE_STEPS, COMPONENT_STEPS, UV_STEPS = 10_000, 1000, 2500, 1_000_000
MASKS = ("ears", "lips", "fingernails", "inside-mouth")
#: Start of the names of actions of the face among the sparse targets.
ACTION = "faceunits/"


@functools.lru_cache(maxsize=1)
def people_data() -> MakeHumanData:
    """The data of the package: people by seed are made of them on every machine, whatever is installed."""
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
        """Whether MakeHuman has a target; not each of them is in the file."""
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
    """Differences (R, 3, V) of components (R, 3, V) from what :func:`undone` expects."""
    out = components.copy()
    for vertex, before in _left(base):
        out[:, :, vertex] -= _expected(components, before)
    left, right = _mirrored(base)
    out[:, :, right] -= components[:, :, left] * _MIRROR[:, None]
    return out


def undone(steps: NDArray[np.int32], base: Base) -> NDArray[np.int32]:
    """Components (R, 3, V) from their :func:`differences`."""
    out = np.ascontiguousarray(steps.transpose(2, 0, 1))
    for vertex, before in _left(base):
        if before:
            out[vertex] += _rounded(out[before].sum(axis=0), len(before))
    left, right = _mirrored(base)
    out[right] += out[left] * _MIRROR
    return np.ascontiguousarray(out.transpose(1, 2, 0))


_MIRROR = np.array([-1, 1, 1], np.int32)


def _expected(components: NDArray[np.int32], before: list[int]) -> Any:
    return _rounded(components[:, :, before].sum(axis=2), len(before)) if before else 0


def _rounded(total: NDArray[np.integer], count: int) -> NDArray[np.integer]:
    return (2 * total + count) // (2 * count)


def _mirrored(base: Base) -> tuple[VertexIndices, VertexIndices]:
    """Vertices of the left half, and their mirror images on the right."""
    places = np.rint(base.vertices * VERTEX_STEPS).astype(np.int64)
    number = {tuple(place): vertex for vertex, place in enumerate(places.tolist())}
    right = np.flatnonzero(places[:, 0] < 0)
    left = np.array([number.get((-x, y, z), -1) for x, y, z in places[right].tolist()], np.int64)
    return left[left >= 0], right[left >= 0]


def _left(base: Base) -> list[tuple[int, list[int]]]:
    """Vertices that are no mirror images, and their neighbours among those before."""
    _, right = _mirrored(base)
    mirrored = np.zeros(len(base.vertices), bool)
    mirrored[right] = True
    around: list[set[int]] = [set() for _ in mirrored]
    for quad in base.faces.tolist():
        for k in range(4):
            a, b = quad[k - 1], quad[k]
            around[max(a, b)].add(min(a, b))
    return [
        (vertex, sorted(other for other in around[vertex] if not mirrored[other] and other != vertex))
        for vertex in np.flatnonzero(~mirrored).tolist()
    ]
