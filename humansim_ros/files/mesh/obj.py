"""Wavefront OBJ meshes [thesis S1] and their materials."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from humansim_ros.errors import MeshError, located, warn_about
from humansim_ros.files.mesh.mesh import (
    MAX_BYTES,
    FaceIndices,
    Material,
    Mesh,
    height_to_normal_map,
    without_maps,
)
from humansim_ros.files.mesh.normals import PLAIN, atlas_mesh, plain_tile, shading_weights
from humansim_ros.files.reading.files import (
    decode_text,
    exists,
    read_bytes,
    read_text,
    resolve_inside,
    size_text,
)
from humansim_ros.files.reading.images import MAX_IMAGE_BYTES, DecodedImages
from humansim_ros.geometry import unit_vectors
from humansim_ros.types import Array, Image

#: Statements of one material: by keyword, the line number and the words after the keyword. If a keyword comes
#: again, the last statement counts.
Statements = Mapping[str, tuple[int, list[str]]]
#: Specular reflectance (F0) for Ks = 1. Ks = 0.5 is glass and plastic (F0 0.04), as in Blender.
_SPECULAR = 0.08
#: Largest material file, bytes. It has room for thousands of materials.
_MAX_MTL_BYTES = 16 << 20
_NORMAL_MAPS = ("norm", "map_Bump", "map_bump", "bump")
_UNSUPPORTED = ("map_Ks", "map_Ns", "map_Pr", "map_Pm", "map_Ps", "disp", "refl", "decal")


@dataclass(frozen=True)
class _Mtl:
    """A material of a material file. ``images``: cache of the decoded images of the file."""

    path: Path
    name: str
    statements: Statements
    images: DecodedImages

    def texture(self) -> Image:
        """The texture (H, W, 3): ``map_Kd``, or else the plain colour ``Kd``."""
        image = self._map("map_Kd", "the colour Kd is used")
        return plain_tile(self._three("Kd", 0.8)) if image is None else image

    def finish(self) -> Material | None:
        """Material without its colour; None for a matt surface. Warns about unsupported statements."""
        statements = self.statements
        ignored = [keyword for keyword in _UNSUPPORTED if keyword in statements]
        maps = [key for key in ("map_Kd", "map_d", "map_Ke", *_NORMAL_MAPS) if key in statements]
        words = ((word, key) for key in maps for word in statements[key][1][:-1])
        ignored += [f"{word} of {key}" for word, key in words if word in ("-s", "-o", "-t")]
        for keyword in ignored:
            warn_about(self.path, f"material {self.name!r}: {keyword} is not supported and ignored")
        shiny = self._one("illum", 2.0) >= 2
        gloss = self._three("Ks", 0.0) * _SPECULAR if shiny else np.zeros(3)
        exponent = max(self._one("Ns", 0.0), 0.0)
        # roughness with a highlight as wide as that of the Blinn-Phong exponent
        roughness = self._one("Pr", (2 / (exponent + 2)) ** 0.25 if shiny else 1.0)
        metallic, emission = self._one("Pm", 0.0), self._three("Ke", 0.0)
        opacity = self._one("d", 1 - self._one("Tr", 0.0))
        normals, emissive, alpha = self._normals(), self._map("map_Ke"), self._alpha()
        if emissive is not None and not emission.any():
            emission = np.ones(3)
        plain = not gloss.any() and metallic == 0 and opacity >= 1 and not emission.any()
        if plain and normals is None and alpha is None:
            return None
        red, green, blue = np.clip(gloss, 0, 1).tolist()
        emitted_red, emitted_green, emitted_blue = np.clip(emission, 0, 1e4).tolist()
        return Material(
            metallic=min(max(metallic, 0.0), 1.0),
            roughness=min(max(roughness, 0.0), 1.0),
            specular=(red, green, blue),
            normals=normals,
            emission=(emitted_red, emitted_green, emitted_blue),
            emissive_map=emissive,
            alpha="blend" if opacity < 1 else "opaque" if alpha is None else "mask",
            opacity=min(max(opacity, 0.0), 1.0),
            alpha_map=alpha,
        )

    def _three(self, keyword: str, default: float) -> Array:
        line, words = self.statements.get(keyword, (0, 3 * [str(default)]))
        return np.asarray(_numbers([words[:3]], [line], 3, keyword, str(self.path))[0])

    def _one(self, keyword: str, default: float) -> float:
        line, words = self.statements.get(keyword, (0, [repr(default)]))
        return float(_numbers([words[-1:]], [line], 1, keyword, str(self.path))[0, 0])

    def _normals(self) -> Image | None:
        """Normal map. A grey image is a height map and is converted."""
        keyword = next((key for key in _NORMAL_MAPS if key in self.statements), None)
        image = None if keyword is None else self._map(keyword)
        if image is None or keyword is None or np.ptp(image.reshape(-1, 3), axis=1).max() > 8:
            return image
        line, words = self.statements[keyword]
        strength = words[words.index("-bm") + 1] if "-bm" in words[:-1] else "1"
        given = _numbers([[strength]], [line], 1, keyword, str(self.path))[0, 0]
        return height_to_normal_map(image[..., 0], 4 * float(given))

    def _alpha(self) -> Image | None:
        """Opacity (H, W) from the image ``map_d``: its alpha channel or, for an image without one, its grey
        values."""
        image = self._map("map_d", "the material is opaque")
        file = None if image is None else self._file("map_d")
        if image is None or file is None:
            return None
        alpha = self.images.alpha(file, lambda: _read(file))
        return image[..., 0] if alpha is None else alpha

    def _map(self, keyword: str, fallback: str = "it is ignored") -> Image | None:
        """Image that a statement names after its options. If the image is missing, warns and returns None.
        ``fallback``: words for the warning: how the material looks without the image."""
        if keyword not in self.statements:
            return None
        file = self._file(keyword)
        if file is None:
            name = self.statements[keyword][1][-1]
            warn_about(self.path, f"texture {name[:60]!r} not found beside the file: {fallback}")
            return None
        with located(path=file):
            return self.images.get(file, lambda: _read(file))

    def _file(self, keyword: str) -> Path | None:
        """Image file in the folder of the material file or below; None if the file is missing."""
        name = self.statements[keyword][1][-1]
        file = resolve_inside(self.path.parent, name.replace("\\", "/"))
        return file if file is not None and exists(file) else None


def _read(file: Path) -> bytes:
    return read_bytes(file, MeshError, "texture", MAX_IMAGE_BYTES)


def read_mtl(path: Path, images: DecodedImages) -> dict[str, _Mtl]:
    """Materials of a material file by name. ``images``: cache of decoded images."""
    materials: dict[str, dict[str, tuple[int, list[str]]]] = {}
    for number, line in enumerate(read_text(path, MeshError, "material", _MAX_MTL_BYTES).splitlines(), 1):
        words = line.partition("#")[0].split()
        if words and words[0] == "newmtl":
            materials[" ".join(words[1:])] = latest = {}
        elif words and materials and (len(words) > 1 or words[0] == "Kd"):
            latest[words[0]] = number, words[1:]
    return {name: _Mtl(path, name, statements, images) for name, statements in materials.items()}


def _numbers(rows: list[list[str]], lines: list[int], width: int, keyword: str, path: str) -> Array:
    """Convert rows of words to finite numbers (N, ``width``). ``lines``: line number of each row. Raises
    MeshError, which names the line of a wrong row, with the ``keyword`` of the lines."""
    try:
        values = np.array(rows, dtype=float)
    except ValueError:
        values = np.empty((0, width))
    if values.shape == (len(rows), width) and np.isfinite(values).all():
        return values
    for row, number in zip(rows, lines, strict=True):
        try:
            valid = len(row) == width and bool(np.isfinite([float(word) for word in row]).all())
        except ValueError:
            valid = False
        if not valid:
            message = f"'{keyword}' needs {width} finite numbers, not {' '.join(row)[:40]!r}"
            raise MeshError(message, path=path, line=number)
    raise MeshError(f"'{keyword}' lines cannot be read", path=path)


#: Colour of faces with a material that the material library does not have.
_GREY = (0.6, 0.6, 0.6)
#: Largest OBJ file, bytes. Parsing needs about ten times its size in memory.
_MAX_OBJ_BYTES = 1 << 28
#: Most corners of a polygon. It becomes a fan of triangles, which is correct only for convex polygons.
_MAX_CORNERS = 50_000
#: Largest length of a normal. A longer normal is treated as unknown.
_LARGEST_NORMAL = 1e30


def read_obj(path: str | os.PathLike[str], data: bytes, *, shaded: bool = False) -> Mesh:
    """Read a Wavefront OBJ file with its content ``data`` as one mesh, with the colours and textures of its
    materials in one texture. Raises MeshError, which names file and line.

    Units and axes stay those of the file. Without a material file the mesh has no colours. ``shaded``: use
    the normals of the file. Corners with different normals get their own vertices.
    """
    with located(path=path):
        return _one_mesh(_parse(path, data, shaded))


def read_obj_materials(path: str | os.PathLike[str], data: bytes) -> list[Mesh]:
    """Read a Wavefront OBJ file as one mesh for each material, with normals. Textures may repeat. ``data``:
    content of the file. Raises MeshError, which names file and line."""
    with located(path=path):
        return _by_material(_parse(path, data, shaded=True))


def material_files(path: str | os.PathLike[str]) -> list[Path]:
    """Material libraries and textures that a mesh file refers to."""
    files: list[Path] = []
    for library in _references(Path(path), "mtllib"):
        files += [library, *_references(library, "map_Kd")]
    return files


def _references(path: Path, keyword: str) -> list[Path]:
    """Existing files that lines with this keyword name."""
    lines = read_text(path, MeshError, "mesh", MAX_BYTES).splitlines()
    names = [line.split(None, 1)[1].strip() for line in lines if line.startswith(f"{keyword} ")]
    if keyword == "map_Kd":
        names = [name.split()[-1] for name in names if name]
    files = [resolve_inside(path.resolve().parent, name.replace("\\", "/")) for name in names]
    return [file for file in files if file is not None and file.is_file()]


@dataclass(frozen=True)
class _Obj:
    """Content of a file. ``face_materials``: name of the material of each face. ``normals``: (V, 3) unit
    normals, zero where unknown; None if the file has none."""

    points: Array
    faces: FaceIndices
    uv: Array | None
    uv_faces: FaceIndices
    face_materials: list[str]
    libraries: list[str]
    path: str
    normals: Array | None = None


def _by_material(obj: _Obj) -> list[Mesh]:
    """Make one mesh for each material. Faces with and without texture coordinates become two meshes."""
    materials = _read_libraries(obj)
    textures = {name: material.texture() for name, material in materials.items()}
    finishes = {name: material.finish() for name, material in materials.items()}
    has_uv = [bool(has) for has in obj.uv_faces[:, :3].min(axis=1) >= 0]
    numbers: dict[tuple[str, bool], int] = {}
    number = np.array(
        [numbers.setdefault(kind, len(numbers)) for kind in zip(obj.face_materials, has_uv, strict=True)]
    )
    meshes = []
    for (name, textured), kind in numbers.items():
        chosen = number == kind
        used, corners = np.unique(obj.faces[chosen], return_inverse=True)
        first = int(used[0] < 0)  # -1 pads triangles
        faces = (corners.reshape(-1, 4) - first).astype(np.int32)
        texture = textures.get(name, plain_tile(_GREY) if textures else plain_tile((1, 1, 1)))
        vertices = obj.points[used[first:]]
        if textured:
            uv, uv_faces = obj.uv, obj.uv_faces[chosen]
            mesh = Mesh(vertices, faces, uv, uv_faces, texture=texture, material=finishes.get(name))
        else:
            color = texture.reshape(-1, 3).mean(axis=0).round().astype(np.uint8)
            material = without_maps(finishes.get(name), obj.path, name)
            mesh = Mesh(vertices, faces, colors=np.tile(color, (len(vertices), 1)), material=material)
        meshes.append(mesh if obj.normals is None else _with_normals(mesh, obj.normals[used[first:]]))
    return meshes


def _one_mesh(obj: _Obj) -> Mesh:
    mesh = _colored(obj)
    if mesh is None:
        has_uv = obj.uv is not None and bool((obj.uv_faces[:, :3] >= 0).all())
        mesh = Mesh(obj.points, obj.faces, obj.uv if has_uv else None, obj.uv_faces if has_uv else None)
    return mesh if obj.normals is None else _with_normals(mesh, obj.normals)


def _with_normals(mesh: Mesh, normals: Array) -> Mesh:
    return replace(mesh, shading=shading_weights(mesh.vertices, mesh.triangles, normals))


def _split_by_normals(obj: _Obj, corners: FaceIndices, directions: Array) -> _Obj:
    """Give corners of faces their own vertices where their normals differ. ``corners``: (F, 4) indices into
    ``directions`` (N, 3), -1 where a corner has no normal."""
    # programs repeat equal normals
    known, number = np.unique(unit_vectors(directions).round(4), axis=0, return_inverse=True)
    number = np.where(directions.any(axis=1), number.reshape(-1) + 1, 0)
    known, number = np.vstack([np.zeros((1, 3)), known]), np.append(number, 0)
    keys = np.where(obj.faces < 0, -1, obj.faces.astype(np.int64) * len(known) + number[corners])
    used, places = np.unique(keys, return_inverse=True)
    first = int(used[0] < 0)  # -1 pads triangles
    vertices, chosen = np.divmod(used[first:], len(known))
    faces = (places.reshape(-1, 4) - first).astype(np.int32)
    return replace(obj, points=obj.points[vertices], faces=faces, normals=known[chosen])


def _directions(rows: list[list[str]], path: str) -> Array | None:
    """Normals (N, 3) of ``vn`` lines; zero where not finite. None if they cannot be read."""
    try:
        found = np.array(rows, dtype=float).reshape(-1, 3)
    except ValueError:
        warn_about(path, "its normals ('vn' lines) are not three numbers each: its surface is drawn smooth")
        return None
    return np.where(np.abs(found).max(axis=1, keepdims=True) < _LARGEST_NORMAL, found, 0.0)


def _parse(file: str | os.PathLike[str], data: bytes, shaded: bool) -> _Obj:
    if len(data) > _MAX_OBJ_BYTES:
        size, limit = size_text(len(data)), size_text(_MAX_OBJ_BYTES)
        message = f"an OBJ file of {size} is too large; at most {limit} are read: convert it to glTF"
        raise MeshError(message, path=file)
    path, text = os.fspath(file), decode_text(data, file, MeshError, "mesh")
    rows: dict[str, list[list[str]]] = {"v": [], "vt": [], "vn": [], "f": []}
    lines: dict[str, list[int]] = {"v": [], "vt": [], "vn": [], "f": []}
    vertices, uv, normals, faces = rows.values()
    widths = {"v": 3, "vt": 2, "vn": 3} if shaded else {"v": 3, "vt": 2}
    counts: list[tuple[int, int, int]] = []
    libraries: list[str] = []
    materials: list[str] = []
    material = ""
    for number, line in enumerate(text.splitlines(), 1):
        words = line.partition("#")[0].split(maxsplit=_MAX_CORNERS + 1)
        if not words:
            continue
        keyword = words[0]
        if len(words) > _MAX_CORNERS + 1:
            raise MeshError(f"more than {_MAX_CORNERS} corners or numbers on a line", path=path, line=number)
        if keyword == "mtllib":
            libraries.append(line.split(None, 1)[1].strip() if len(words) > 1 else "")
        elif keyword == "usemtl":
            material = " ".join(words[1:])
        elif keyword in widths:
            rows[keyword].append(words[1 : 1 + widths[keyword]])
            lines[keyword].append(number)
        elif keyword == "f":
            faces.append(words[1:])
            lines["f"].append(number)
            materials.append(material)
            counts.append((len(vertices), len(uv), len(normals)))
    if not vertices:
        raise MeshError("no vertices ('v' lines): not a Wavefront OBJ mesh, or an empty one", path=path)
    if not faces:
        raise MeshError("no faces ('f' lines): point clouds cannot be skinned or rendered", path=path)
    points = _numbers(vertices, lines["v"], 3, "v", path)
    texture = _numbers(uv, lines["vt"], 2, "vt", path) if uv else None
    directions = _directions(normals, path) if normals else None
    corners, texture_corners, normal_corners, face_materials = [], [], [], []
    for words, number, (n_vertices, n_uv, n_normals), name in zip(
        faces, lines["f"], counts, materials, strict=True
    ):
        if len(words) < 3:
            raise MeshError(f"a face needs at least 3 corners, this has {len(words)}", path=path, line=number)
        corner, texture_corner, normal_corner = [], [], []
        for word in words:
            first, _, rest = word.partition("/")
            corner.append(_index(first, n_vertices, len(points), "vertex", path, number))
            second, _, third = rest.partition("/")
            if second:
                total = 0 if texture is None else len(texture)
                texture_corner.append(_index(second, n_uv, total, "texture coordinate", path, number))
            if directions is not None:
                total = len(directions)
                own = _index(third, n_normals, total, "normal", path, number) if third else -1
                normal_corner.append(own)
        with_uv = len(texture_corner) == len(corner)
        for piece in _quads(len(corner)):
            corners.append([corner[i] if i >= 0 else -1 for i in piece])
            texture_corners.append([texture_corner[i] if i >= 0 and with_uv else -1 for i in piece])
            if directions is not None:
                normal_corners.append([normal_corner[i] if i >= 0 else -1 for i in piece])
            face_materials.append(name)
    corner_array = np.array(corners, dtype=np.int32)
    texture_array = np.array(texture_corners, dtype=np.int32)
    obj = _Obj(points, corner_array, texture, texture_array, face_materials, libraries, path)
    if directions is None:
        return obj
    return _split_by_normals(obj, np.array(normal_corners, dtype=np.int32), directions)


def _read_libraries(obj: _Obj) -> dict[str, _Mtl]:
    """Materials by name. Warns about a missing library."""
    known: dict[str, _Mtl] = {}
    images = DecodedImages()
    for library in obj.libraries:
        file = resolve_inside(Path(obj.path).resolve().parent, library)
        if file is None or not exists(file):
            text = f"material library {library[:60]!r} not found beside the file: no colours from it"
            warn_about(obj.path, text)
        else:
            known |= read_mtl(file, images)
    return known


def _colored(obj: _Obj) -> Mesh | None:
    """Mesh with the textures of its materials; None if there are no materials. Missing textures are grey."""
    materials = _read_libraries(obj)
    if not materials:
        return None
    known = {name: material.texture() for name, material in materials.items()}
    uv, uv_faces, faces = obj.uv, obj.uv_faces, obj.faces
    names = list(dict.fromkeys(obj.face_materials))
    tiles = [known.get(name, plain_tile(_GREY)) for name in names]
    number = {name: n for n, name in enumerate(names)}
    material = np.array([number[name] for name in obj.face_materials])
    coordinates = np.zeros((1, 2)) if uv is None else uv
    plain = np.array([tile.shape[0] == PLAIN for tile in tiles])
    if len(tiles) == 1 and plain[0]:
        coordinates, uv_faces = np.zeros((1, 2)), np.where(faces < 0, -1, 0).astype(np.int32)
    return atlas_mesh(obj.points, faces, coordinates, uv_faces, material, tiles)


def _index(word: str, so_far: int, total: int, what: str, path: str, line: int) -> int:
    """Convert a 1-based OBJ index to 0-based. A negative index counts back from the last element so far.
    ``so_far``, ``total``: number of elements above this line, and in the file."""
    try:
        number = int(word)
    except ValueError:
        raise MeshError(f"{word[:20]!r} is not a {what} number", path=path, line=line) from None
    index = number - 1 if number > 0 else so_far + number
    if number == 0 or not 0 <= index < total:
        raise MeshError(f"{what} {number} does not exist: the file has {total}", path=path, line=line)
    return index


def _quads(corners: int) -> list[tuple[int, int, int, int]]:
    """Split a polygon. Up to four corners stay one face; more corners become a fan of triangles."""
    if corners == 3:
        return [(0, 1, 2, -1)]
    if corners == 4:
        return [(0, 1, 2, 3)]
    return [(0, i, i + 1, -1) for i in range(1, corners - 1)]
