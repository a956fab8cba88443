"""Surface meshes and the Wavefront OBJ reader (thesis S1)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError
from humansim_ros.files import read_text
from humansim_ros.rotations import Array

Indices = NDArray[np.int32]


@dataclass(frozen=True)
class Mesh:
    """A surface of triangles and quads.

    ``vertices``: (V, 3). ``faces``: (F, 4) vertex indices, triangles padded with -1. ``uv``: (T, 2) texture
    coordinates, v up, or None; ``uv_faces``: (F, 4) indices into them. ``colors``: (V, 3) uint8 sRGB or None.
    ``texture``: (H, W, 3) uint8 sRGB, first row on top, or None. Raises MeshError where indices or numbers
    are impossible.
    """

    vertices: Array
    faces: Indices
    uv: Array | None = None
    uv_faces: Indices | None = None
    colors: NDArray[np.uint8] | None = None
    texture: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or len(self.vertices) == 0:
            raise MeshError(f"a mesh needs vertices of shape (V, 3), not {self.vertices.shape}")
        if self.faces.ndim != 2 or self.faces.shape[1] != 4 or len(self.faces) == 0:
            raise MeshError("the mesh has no faces")
        if not np.isfinite(self.vertices).all():
            raise MeshError("a vertex is not finite (NaN or infinity)")
        if self.faces[:, :3].min() < 0 or self.faces.min() < -1 or self.faces.max() >= len(self.vertices):
            raise MeshError(f"a face uses a vertex outside 0..{len(self.vertices) - 1}")
        if (self.uv is None) != (self.uv_faces is None):
            raise MeshError("texture coordinates and their faces must come together")
        if self.uv is not None and self.uv_faces is not None:
            used = self.uv_faces[self.faces >= 0]
            if self.uv_faces.shape != self.faces.shape or used.min() < 0 or used.max() >= len(self.uv):
                raise MeshError("a face uses a texture coordinate that does not exist")

    @cached_property
    def triangles(self) -> Indices:
        """(N, 3) vertex indices: each quad a b c d as a b c and a c d."""
        return self._split(self.faces)

    @cached_property
    def uv_triangles(self) -> Indices | None:
        """(N, 3) indices into ``uv`` of the same triangles."""
        return None if self.uv_faces is None else self._split(self.uv_faces)

    @cached_property
    def triangle_faces(self) -> Indices:
        """(N,) the face that each triangle is a part of."""
        quads = self.faces[:, 3] >= 0
        return np.repeat(np.arange(len(self.faces), dtype=np.int32), 1 + quads)

    @cached_property
    def closed(self) -> bool:
        """Whether the surface has an inside: every edge has two faces that run along it in opposite ways,
        facing out.

        Seen from outside, the back faces of a closed surface never show, and need not be drawn.
        """
        edges = self.triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        forth = edges[:, 0] * len(self.vertices) + edges[:, 1]
        back = edges[:, 1] * len(self.vertices) + edges[:, 0]
        if len(np.unique(forth)) < len(forth) or not np.array_equal(np.sort(forth), np.sort(back)):
            return False
        a, b, c = (self.vertices[self.triangles[:, i]] for i in range(3))
        return float(np.einsum("ij,ij->", a, np.cross(b, c))) > 0

    def _split(self, faces: Indices) -> Indices:
        both = faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 2, 3)
        keep = np.stack([np.ones(len(faces), dtype=bool), self.faces[:, 3] >= 0], axis=1)
        return np.ascontiguousarray(both[keep])


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh file (Wavefront OBJ). Units and axes stay as in the file. Raises MeshError with file and
    line.
    """
    text = read_text(path, MeshError, "mesh")
    try:
        return _read_obj(text, os.fspath(path))
    except MeshError as error:
        if error.path is None:
            raise MeshError(error.message, path=path) from None
        raise


def _read_obj(text: str, path: str) -> Mesh:
    vertices: list[list[str]] = []
    uv: list[list[str]] = []
    vertex_lines: list[int] = []
    uv_lines: list[int] = []
    faces: list[list[str]] = []
    face_lines: list[int] = []
    counts: list[tuple[int, int]] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        keyword = words[0]
        if keyword == "v":
            vertices.append(words[1:4])
            vertex_lines.append(number)
        elif keyword == "vt":
            uv.append(words[1:3])
            uv_lines.append(number)
        elif keyword == "f":
            faces.append(words[1:])
            face_lines.append(number)
            counts.append((len(vertices), len(uv)))
    if not vertices:
        raise MeshError("no vertices ('v' lines): not a Wavefront OBJ mesh, or an empty one", path=path)
    if not faces:
        raise MeshError("no faces ('f' lines): a cloud of points cannot be skinned or rendered", path=path)
    points = _numbers(vertices, vertex_lines, 3, "v", path)
    texture = _numbers(uv, uv_lines, 2, "vt", path) if uv else None
    corners, texture_corners = [], []
    for words, number, (n_vertices, n_uv) in zip(faces, face_lines, counts, strict=True):
        if len(words) < 3:
            raise MeshError(f"a face needs at least 3 corners, this has {len(words)}", path=path, line=number)
        corner, texture_corner = [], []
        for word in words:
            first, _, rest = word.partition("/")
            corner.append(_index(first, n_vertices, len(points), "vertex", path, number))
            second = rest.partition("/")[0]
            if second:
                total = 0 if texture is None else len(texture)
                texture_corner.append(_index(second, n_uv, total, "texture coordinate", path, number))
        with_uv = len(texture_corner) == len(corner)
        for piece in _quads(len(corner)):
            corners.append([corner[i] if i >= 0 else -1 for i in piece])
            texture_corners.append([texture_corner[i] if i >= 0 and with_uv else -1 for i in piece])
    corner_array = np.array(corners, dtype=np.int32)
    texture_array = np.array(texture_corners, dtype=np.int32)
    has_uv = texture is not None and bool((texture_array[:, :3] >= 0).all())
    return Mesh(points, corner_array, texture if has_uv else None, texture_array if has_uv else None)


def _numbers(rows: list[list[str]], lines: list[int], width: int, keyword: str, path: str) -> Array:
    try:
        values = np.array(rows, dtype=float)
    except ValueError:
        values = np.empty((0, width))
    if values.shape == (len(rows), width) and np.isfinite(values).all():
        return values
    for row, number in zip(rows, lines, strict=True):
        try:
            good = len(row) == width and bool(np.isfinite([float(word) for word in row]).all())
        except ValueError:
            good = False
        if not good:
            raise MeshError(
                f"'{keyword}' needs {width} finite numbers, not {' '.join(row)[:40]!r}",
                path=path,
                line=number,
            )
    raise MeshError(f"'{keyword}' lines cannot be read", path=path)


def _index(word: str, so_far: int, total: int, what: str, path: str, line: int) -> int:
    """0-based index from OBJ's 1-based one; negative ones count back from the last so far."""
    try:
        number = int(word)
    except ValueError:
        raise MeshError(f"{word[:20]!r} is not a {what} number", path=path, line=line) from None
    index = number - 1 if number > 0 else so_far + number
    if number == 0 or not 0 <= index < total:
        raise MeshError(f"{what} {number} does not exist: the file has {total}", path=path, line=line)
    return index


def _quads(corners: int) -> list[tuple[int, int, int, int]]:
    """A polygon as triangles and quads: itself up to four corners, a fan of triangles beyond."""
    if corners == 3:
        return [(0, 1, 2, -1)]
    if corners == 4:
        return [(0, 1, 2, 3)]
    return [(0, i, i + 1, -1) for i in range(1, corners - 1)]
