"""Read mesh files of any supported format. trimesh reads PLY, STL and OFF files.

Files are untrusted. Sizes and counts are checked before a file is parsed, and no further file is opened. A
3MF file can refer to its own parts again and again, so there are limits for what is made of them.
"""

from __future__ import annotations

import io
import logging
import os
import re
import zipfile
from dataclasses import replace
from functools import cache
from typing import Any, Literal
from xml.etree.ElementTree import Element, ParseError

import numpy as np
from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import fromstring
from numpy.typing import NDArray

from humansim_ros.errors import MeshError, located, printable
from humansim_ros.files.mesh.mesh import Mesh, MeshFormat, SkinnedMesh, padded, read_format
from humansim_ros.files.reading.arrays import ARCHIVE_ERRORS
from humansim_ros.types import Array

#: Rotation from y up to z up, as in Blender.
_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh file as one mesh with one texture: OBJ, glTF, VRM, FBX, PLY, STL, OFF, COLLADA or 3MF.

    The content of the file decides its format. Units and axes stay those of the file, but COLLADA and 3MF,
    which state them, are in metres, and COLLADA is y up. The textures of all materials become one image.
    Materials and textures are searched in the folder of the file and below it. Skinned meshes of a glTF file
    are posed by its nodes.

    Raises:
        MeshError: The file is missing or wrong. The error names the file, and the line or key.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile("w", suffix=".obj") as file:
        ...     _ = file.write("v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3\\n")
        ...     file.flush()
        ...     mesh = read_mesh(file.name)
        >>> mesh.vertices.shape
        (3, 3)
    """
    return _read(path, *read_format(path))


def read_mesh_or_figure(path: str | os.PathLike[str]) -> Mesh | SkinnedMesh:
    """Like :func:`read_mesh`, but read a glTF file at bind time, with joints and weights. Raises
    MeshError."""
    kind, data = read_format(path)
    if kind != "gltf":
        return _read(path, kind, data)
    from humansim_ros.files.mesh.gltf_mesh import read_gltf

    return read_gltf(path, data)


def read_mesh_z_up(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh file as one mesh, with z up and the normals of a glTF or OBJ file. The mesh is in metres if
    the file states its unit. Raises MeshError."""
    kind, data = read_format(path)
    return _to_z_up(_read(path, kind, data, shaded=True), "y" if kind == "gltf" else "z")


def read_materials_z_up(path: str | os.PathLike[str], up: Literal["y", "z"] | None = None) -> list[Mesh]:
    """Read a mesh file as one mesh for each material, with z up. Textures may repeat. ``up``: up axis of the
    file. If None, y for glTF, z for other formats. COLLADA files state their axis, so ``up`` does not change
    them. Meshes of COLLADA and 3MF are in metres, since these files state their unit. Raises MeshError."""
    kind, data = read_format(path)
    if kind == "gltf":
        from humansim_ros.files.mesh.gltf_mesh import read_gltf_materials

        stated = os.fspath(path).lower().endswith(".dae")
        return [_to_z_up(mesh, "y" if stated else up or "y") for mesh in read_gltf_materials(path, data)]
    if kind == "obj":
        from humansim_ros.files.mesh.obj import read_obj_materials

        return [_to_z_up(mesh, up or "z") for mesh in read_obj_materials(path, data)]
    mesh = read_foreign(path, kind, data)
    if mesh.colors is None:
        mesh = replace(mesh, colors=np.full((len(mesh.vertices), 3), 255, np.uint8))
    return [_to_z_up(mesh, up or "z")]


def _read(path: str | os.PathLike[str], kind: MeshFormat, data: bytes, *, shaded: bool = False) -> Mesh:
    """Mesh of a file with a known format. ``shaded``: use the normals of a glTF or OBJ file."""
    if kind == "gltf":
        from humansim_ros.files.mesh.gltf_mesh import read_gltf_scene

        return read_gltf_scene(path, data, shaded=shaded)
    if kind == "obj":
        from humansim_ros.files.mesh.obj import read_obj

        return read_obj(path, data, shaded=shaded)
    return read_foreign(path, kind, data)


def _to_z_up(mesh: Mesh, up: str) -> Mesh:
    return mesh if up == "z" else replace(mesh, vertices=mesh.vertices @ _TO_Z_UP.T)


_MAX_VERTICES = 5_000_000


def read_foreign(path: str | os.PathLike[str], kind: MeshFormat, data: bytes) -> Mesh:
    """Read a PLY, STL, OFF or 3MF file with its content ``data`` as one mesh, with vertex colours if the file
    has colours. 3MF is in metres. Raises MeshError if the file is wrong."""
    with located(path=path):
        vertices, faces, colors = _three_mf(data) if kind == "3mf" else _parse(kind, data)
        return Mesh(vertices, padded(faces), colors=colors)


_Parts = tuple[Array, NDArray[np.int64], NDArray[np.uint8] | None]


def _parse(kind: str, data: bytes) -> _Parts:
    """Vertices, triangles and vertex colours (V, 3) of a PLY, STL or OFF file. Raises MeshError, also for any
    exception of the parsers of trimesh."""
    import trimesh

    _check_counts(kind, data)
    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        with np.errstate(all="ignore"):
            loaded = trimesh.load(io.BytesIO(data), file_type=kind, process=False, resolver=None)
            if isinstance(loaded, trimesh.Scene):  # an STL file of several solids
                loaded = trimesh.util.concatenate(loaded.dump())
            if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
                raise MeshError("no faces: point clouds and lines cannot be skinned or rendered")
            vertices, faces, colors = _part(loaded)
    except MeshError:
        raise
    except MemoryError:
        raise MeshError("the file needs too much memory") from None
    except Exception as reason:
        text = " ".join(str(reason).split())[:100] or type(reason).__name__
        raise MeshError(f"not a {kind.upper()} file that can be read: {text}") from None
    if len(vertices) > _MAX_VERTICES:
        raise MeshError(f"more than {_MAX_VERTICES} vertices: simplify the mesh first")
    return (*_welded(vertices, faces), colors) if kind == "stl" else (vertices, faces, colors)


def _part(part: Any) -> _Parts:
    """Vertices, triangles and vertex colours (V, 3) of a part. If faces have colours, each has its own
    vertices."""
    points, corners = np.asarray(part.vertices, float), np.asarray(part.faces, np.int64)
    visual = part.visual
    if visual.kind == "face":
        points = points[corners].reshape(-1, 3)
        color = np.repeat(np.asarray(visual.face_colors)[:, :3], 3, axis=0).astype(np.uint8)
        return points, np.arange(len(points)).reshape(-1, 3), color
    if visual.kind == "vertex":
        return points, corners, np.asarray(visual.vertex_colors)[:, :3].astype(np.uint8)
    if visual.kind == "texture" and getattr(visual, "material", None) is not None:
        color = np.asarray(visual.material.main_color)[:3].astype(np.uint8)
        return points, corners, np.tile(color, (len(points), 1))
    return points, corners, None


def _welded(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Join vertices at the same position, in the order of first use. Faces without area are removed."""
    _, first, same = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.argsort(order)
    corners = rank[same.reshape(-1)][faces]
    a, b, c = corners.T
    return vertices[first[order]], corners[(a != b) & (b != c) & (c != a)]


def _check_counts(kind: str, data: bytes) -> None:
    """Raise MeshError if a header promises more than the file can contain."""
    if kind == "ply":
        header = data[: max(data.find(b"end_header"), 0) or 65536]
        counts = re.findall(rb"^\s*element\s+\w+\s+(\d+)", header, re.MULTILINE)
    elif kind == "off":
        found = re.search(rb"OFF\s+(?:#[^\n]*\n\s*)*(\d+)\s+(\d+)", data[:65536])
        counts = list(found.groups()) if found else []
    else:
        counts = []
    if any(len(count) > 12 or int(count) > len(data) for count in counts):
        raise MeshError(f"its {kind.upper()} header promises more than its {len(data)} bytes hold")


# --- 3MF

#: Largest decompressed 3MF file, bytes (parsing needs about ten times as much memory); most entries of its
#: archive; most objects and most elements in them, with all repetitions.
_MAX_XML, _MAX_ENTRIES, _MAX_OBJECTS, _MAX_PARTS = 1 << 27, 10_000, 100_000, 15_000_000
#: Attribute with the file of an object that is in another file of the archive.
_PATH = "{http://schemas.microsoft.com/3dmanufacturing/production/2015/06}path"
#: Metres per unit.
_UNITS = {
    "micron": 1e-6,
    "millimeter": 1e-3,
    "centimeter": 1e-2,
    "inch": 0.0254,
    "foot": 0.3048,
    "meter": 1.0,
}


def _three_mf(data: bytes) -> _Parts:
    """Vertices in metres and triangles of all items that a 3MF file builds [3MF]. Raises MeshError."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            total = sum(entry.file_size for entry in entries)
            if total > _MAX_XML or len(entries) > _MAX_ENTRIES:
                raise MeshError(f"its archive holds {total >> 20} MB, more than {_MAX_XML >> 20} MB")
            return _built(archive)
    except DefusedXmlException:
        raise MeshError("its XML has a document type, which mesh files do not need: remove it") from None
    except (*ARCHIVE_ERRORS, ParseError, TypeError, ArithmeticError) as reason:
        raise MeshError(f"not a 3MF file that can be read: {str(reason)[:60]}") from None


def _built(archive: zipfile.ZipFile) -> _Parts:
    """Put the objects of an archive where its items and their components place them."""

    @cache
    def model(file: str) -> tuple[Element, dict[str | None, Element]]:
        """Root element of a file, and its objects."""
        root = fromstring(archive.read(file), forbid_dtd=True)
        return root, {each.get("id"): each for each in root.iterfind("{*}resources/{*}object")}

    first = next((name for name in archive.namelist() if name.lower().endswith("3dmodel.model")), "")
    root, _ = model(first)
    pending = [(first, item, np.eye(4)) for item in reversed(root.findall("{*}build/{*}item"))]
    vertices: list[Array] = []
    faces: list[NDArray[np.int64]] = []
    objects = elements = count = 0
    while pending:
        file, reference, above = pending.pop()
        file, transform = reference.get(_PATH, file).lstrip("/"), np.eye(4)
        if stated := reference.get("transform"):  # of rows x y z 1
            transform[:, :3] = np.array(stated.split(), float).reshape(4, 3)
        transform = transform @ above
        own = model(file)[1][reference.get("objectid")]
        objects, elements = objects + 1, elements + sum(1 for _ in own.iter())
        if objects + len(pending) > _MAX_OBJECTS or elements > _MAX_PARTS:
            raise MeshError(f"more than {_MAX_OBJECTS} objects, or {_MAX_PARTS} elements: simplify the mesh")
        points = _table(own, "{*}mesh/{*}vertices/{*}vertex", "x y z", float)
        corners = _table(own, "{*}mesh/{*}triangles/{*}triangle", "v1 v2 v3", np.int64)
        parts = own.findall("{*}components/{*}component")
        pending += [(file, part, transform) for part in reversed(parts)]
        if len(corners) and not 0 <= corners.min() <= corners.max() < len(points):
            raise MeshError(f"a triangle of object {printable(own.get('id', ''), 40)} has no such vertex")
        mirrored = np.linalg.det(transform[:3, :3]) < 0
        faces.append((corners[:, ::-1] if mirrored else corners) + count)
        vertices.append(points @ transform[:3, :3] + transform[3, :3])
        count += len(points)
    if not any(map(len, faces)):
        raise MeshError("no faces: nothing is built")
    return _UNITS[root.get("unit", "millimeter")] * np.concatenate(vertices), np.concatenate(faces), None


def _table(element: Element, path: str, names: str, kind: type[Any]) -> NDArray[Any]:
    """Attributes (N, 3) of the elements at a path."""
    rows = [[each.attrib[name] for name in names.split()] for each in element.iterfind(path)]
    return np.array(rows, kind).reshape(-1, 3)
