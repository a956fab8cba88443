"""Wavefront OBJ meshes (thesis S1), as MakeHuman and everybody else export them, and their materials."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from humansim_ros.errors import MeshError, warn_about
from humansim_ros.io.files import read_text, resolve_inside
from humansim_ros.mesh.atlas import PLAIN, plain_tile, textured
from humansim_ros.mesh.material import without_maps
from humansim_ros.mesh.mesh import FaceIndices, Mesh
from humansim_ros.mesh.mtl import Statements, material_of, numbers, read_mtl, tile_of
from humansim_ros.types import Array


def read_obj(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh file (Wavefront OBJ) with its materials: their colours and textures, side by side in one.

    Units and axes stay as in the file. Materials and textures are looked for in the folder of the file and
    below; without them the mesh has none. Raises MeshError with file and line.
    """
    text = read_text(path, MeshError, "mesh")
    try:
        return _read_obj(text, os.fspath(path))
    except MeshError as error:
        if error.path is None:
            raise MeshError(error.message, path=path) from None
        raise


def read_obj_materials(path: str | os.PathLike[str]) -> list[Mesh]:
    """The same as one mesh for each material, whose textures may repeat."""
    text = read_text(path, MeshError, "mesh")
    try:
        return _parse(text, os.fspath(path)).surfaces()
    except MeshError as error:
        if error.path is None:
            raise MeshError(error.message, path=path) from None
        raise


def material_files(path: str | os.PathLike[str]) -> list[Path]:
    """The materials and textures that a mesh is coloured with."""
    files: list[Path] = []
    for library in _named(Path(path), "mtllib"):
        files += [library, *_named(library, "map_Kd")]
    return files


def _named(path: Path, keyword: str) -> list[Path]:
    """The files beside one that its lines with a keyword name."""
    lines = read_text(path, MeshError, "mesh").splitlines()
    names = [line.split(None, 1)[1].strip() for line in lines if line.startswith(f"{keyword} ")]
    if keyword == "map_Kd":
        names = [name.split()[-1] for name in names if name]
    found = [resolve_inside(path.resolve().parent, name.replace("\\", "/")) for name in names]
    return [file for file in found if file is not None and file.is_file()]


@dataclass(frozen=True)
class _Obj:
    """What a file says. ``worn``: the material of each face."""

    points: Array
    faces: FaceIndices
    uv: Array | None
    uv_faces: FaceIndices
    worn: list[str]
    libraries: list[str]
    path: str

    def surfaces(self) -> list[Mesh]:
        materials = _known_materials(self.libraries, self.path)
        tiles = {name: tile_of(*material) for name, material in materials.items()}
        finishes = {name: material_of(*material) for name, material in materials.items()}
        laid = [bool(has) for has in self.uv_faces[:, :3].min(axis=1) >= 0]
        numbers: dict[tuple[str, bool], int] = {}
        number = np.array(
            [numbers.setdefault(kind, len(numbers)) for kind in zip(self.worn, laid, strict=True)]
        )
        made = []
        for (name, has), kind in numbers.items():
            chosen = number == kind
            used, corners = np.unique(self.faces[chosen], return_inverse=True)
            first = int(used[0] < 0)  # -1, that pads triangles
            faces = (corners.reshape(-1, 4) - first).astype(np.int32)
            tile = tiles.get(name, plain_tile((0.6, 0.6, 0.6)) if tiles else plain_tile((1, 1, 1)))
            vertices = self.points[used[first:]]
            if has:
                laid_on = self.uv, self.uv_faces[chosen]
                made.append(Mesh(vertices, faces, *laid_on, texture=tile, material=finishes.get(name)))
                continue
            color = tile.reshape(-1, 3).mean(axis=0).round().astype(np.uint8)
            finish = without_maps(finishes.get(name), self.path, name)
            made.append(Mesh(vertices, faces, colors=np.tile(color, (len(vertices), 1)), material=finish))
        return made


def _read_obj(text: str, path: str) -> Mesh:
    obj = _parse(text, path)
    colored = _colored(obj)
    if colored is not None:
        return colored
    has_uv = obj.uv is not None and bool((obj.uv_faces[:, :3] >= 0).all())
    return Mesh(obj.points, obj.faces, obj.uv if has_uv else None, obj.uv_faces if has_uv else None)


def _parse(text: str, path: str) -> _Obj:
    vertices: list[list[str]] = []
    uv: list[list[str]] = []
    vertex_lines: list[int] = []
    uv_lines: list[int] = []
    faces: list[list[str]] = []
    face_lines: list[int] = []
    counts: list[tuple[int, int]] = []
    libraries: list[str] = []
    materials: list[str] = []
    material = ""
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        keyword = words[0]
        if keyword == "mtllib":
            libraries.append(line.split(None, 1)[1].strip() if len(words) > 1 else "")
        elif keyword == "usemtl":
            material = " ".join(words[1:])
        elif keyword == "v":
            vertices.append(words[1:4])
            vertex_lines.append(number)
        elif keyword == "vt":
            uv.append(words[1:3])
            uv_lines.append(number)
        elif keyword == "f":
            faces.append(words[1:])
            face_lines.append(number)
            materials.append(material)
            counts.append((len(vertices), len(uv)))
    if not vertices:
        raise MeshError("no vertices ('v' lines): not a Wavefront OBJ mesh, or an empty one", path=path)
    if not faces:
        raise MeshError("no faces ('f' lines): a cloud of points cannot be skinned or rendered", path=path)
    points = numbers(vertices, vertex_lines, 3, "v", path)
    texture = numbers(uv, uv_lines, 2, "vt", path) if uv else None
    corners, texture_corners, worn = [], [], []
    for words, number, (n_vertices, n_uv), name in zip(faces, face_lines, counts, materials, strict=True):
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
            worn.append(name)
    corner_array = np.array(corners, dtype=np.int32)
    texture_array = np.array(texture_corners, dtype=np.int32)
    return _Obj(points, corner_array, texture, texture_array, worn, libraries, path)


def _known_materials(libraries: list[str], path: str) -> dict[str, tuple[Path, str, Statements]]:
    """By the names of materials, their file, name and what it says; a library that is missing is told."""
    known: dict[str, tuple[Path, str, Statements]] = {}
    for library in libraries:
        file = resolve_inside(Path(path).resolve().parent, library)
        if file is None or not file.is_file():
            warn_about(
                path, f"its materials {library[:60]!r} are not beside it: it has none of their colours"
            )
        else:
            known |= {name: (file, name, said) for name, said in read_mtl(file).items()}
    return known


def _colored(obj: _Obj) -> Mesh | None:
    """The mesh with its materials, None if it has none; those that are missing are left grey."""
    materials = _known_materials(obj.libraries, obj.path)
    if not materials:
        return None
    known = {name: tile_of(*material) for name, material in materials.items()}
    uv, uv_faces, worn, faces = obj.uv, obj.uv_faces, obj.worn, obj.faces
    names = list(dict.fromkeys(worn))
    tiles = [known.get(name, plain_tile((0.6, 0.6, 0.6))) for name in names]
    number = {name: n for n, name in enumerate(names)}
    material = np.array([number[name] for name in worn])
    coordinates = np.zeros((1, 2)) if uv is None else uv
    plain = np.array([tile.shape[0] == PLAIN for tile in tiles])
    if len(tiles) == 1 and plain[0]:
        coordinates, uv_faces = np.zeros((1, 2)), np.where(faces < 0, -1, 0).astype(np.int32)
    return textured(obj.points, faces, coordinates, uv_faces, material, tiles)


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
