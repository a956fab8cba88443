"""Read mesh files of any supported format. trimesh reads PLY, STL, OFF, COLLADA and 3MF files.

Files are untrusted. Sizes and counts are checked before trimesh sees them, and no further file is opened. XML
can refer to its own parts again and again, so another process with limits reads COLLADA and 3MF.
"""

from __future__ import annotations

import importlib.util
import io
import logging
import os
import re
import subprocess
import sys
import zipfile
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError, located, warn_about
from humansim_ros.files.mesh.mesh import Mesh, MeshFormat, SkinnedMesh, padded, read_format
from humansim_ros.files.reading.arrays import ARCHIVE_ERRORS
from humansim_ros.files.reading.programs import run_limited
from humansim_ros.types import Array

#: Rotation to z up, by the up axis of a file. For y it is the rotation of Blender, for x that of COLLADA.
_TO_Z_UP: dict[str, Array] = {
    "x": np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
}


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh file as one mesh with one texture: OBJ, glTF, VRM, FBX, PLY, STL, OFF, COLLADA or 3MF.

    The content of the file decides its format. Units and axes stay those of the file. The textures of all
    materials become one image. Materials and textures are searched in the folder of the file and below it.
    Skinned meshes of a glTF file are posed by its nodes.

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
    return _read(path, *read_format(path))[0]


def read_mesh_or_figure(path: str | os.PathLike[str]) -> Mesh | SkinnedMesh:
    """Like :func:`read_mesh`, but read a glTF file at bind time, with joints and weights. Raises
    MeshError."""
    kind, data = read_format(path)
    if kind != "gltf":
        return _read(path, kind, data)[0]
    from humansim_ros.files.mesh.gltf_mesh import read_gltf

    return read_gltf(path, data)


def read_mesh_z_up(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh file as one mesh, with z up and the normals of a glTF or OBJ file. The mesh is in metres if
    the file states its unit. Raises MeshError."""
    mesh, up, unit = _read(path, *read_format(path), shaded=True)
    return _to_z_up(mesh, up, unit)


def read_materials_z_up(path: str | os.PathLike[str], up: Literal["y", "z"] | None = None) -> list[Mesh]:
    """Read a mesh file as one mesh for each material, with z up. Textures may repeat. ``up``: up axis of the
    file. If None, y for glTF, the stated axis for COLLADA, z for other formats. Meshes of COLLADA and 3MF are
    in metres, since these files state their unit. Raises MeshError."""
    kind, data = read_format(path)
    if kind == "gltf":
        from humansim_ros.files.mesh.gltf_mesh import read_gltf_materials

        return [_to_z_up(mesh, up or "y") for mesh in read_gltf_materials(path, data)]
    if kind == "obj":
        from humansim_ros.files.mesh.obj import read_obj_materials

        return [_to_z_up(mesh, up or "z") for mesh in read_obj_materials(path, data)]
    foreign = read_foreign(path, kind, data)
    mesh = foreign.mesh
    if mesh.colors is None:
        mesh = replace(mesh, colors=np.full((len(mesh.vertices), 3), 255, np.uint8))
    return [_to_z_up(mesh, up or foreign.up, foreign.unit)]


def _read(
    path: str | os.PathLike[str], kind: MeshFormat, data: bytes, *, shaded: bool = False
) -> tuple[Mesh, str, float]:
    """Mesh of a file with a known format, with its up axis, and metres per unit. ``shaded``: use the normals
    of a glTF or OBJ file."""
    if kind == "gltf":
        from humansim_ros.files.mesh.gltf_mesh import read_gltf_scene

        return read_gltf_scene(path, data, shaded=shaded), "y", 1.0
    if kind == "obj":
        from humansim_ros.files.mesh.obj import read_obj

        return read_obj(path, data, shaded=shaded), "z", 1.0
    foreign = read_foreign(path, kind, data)
    return foreign.mesh, foreign.up, foreign.unit


def _to_z_up(mesh: Mesh, up: str, unit: float = 1.0) -> Mesh:
    if up == "z" and unit == 1.0:
        return mesh
    rotation = _TO_Z_UP.get(up, np.eye(3))
    return replace(mesh, vertices=unit * mesh.vertices @ rotation.T)


_MAX_VERTICES = 5_000_000
#: Largest COLLADA file and largest decompressed 3MF file, bytes; most entries of a 3MF archive.
_MAX_XML, _MAX_ENTRIES = 1 << 28, 10_000
_MEMORY, _CPU_SECONDS, _SECONDS = 4 << 30, 60, 300
#: Metres per unit of 3MF files.
_UNITS = {
    "micron": 1e-6,
    "millimeter": 1e-3,
    "centimeter": 1e-2,
    "inch": 0.0254,
    "foot": 0.3048,
    "meter": 1.0,
    "millimeters": 1e-3,
    "meters": 1.0,
}
#: Packages of PyPI that formats need, and the names of their modules.
_PACKAGES = {"dae": "pycollada lxml", "3mf": "lxml networkx"}
_MODULES = {"dae": ("collada",), "3mf": ("lxml", "networkx")}
#: Encodings of XML that keep ASCII characters, so that a search finds a document type.
_ENCODINGS = (b"utf-8", b"us-ascii", b"ascii", b"iso-8859-1")


@dataclass(frozen=True)
class ForeignMesh:
    """Mesh in the units and axes of its file. ``up``: x, y or z. ``unit``: metres per unit; 1 if the file
    states no unit."""

    mesh: Mesh
    up: str = "z"
    unit: float = 1.0


def read_foreign(path: str | os.PathLike[str], kind: MeshFormat, data: bytes) -> ForeignMesh:
    """Read a PLY, STL, OFF, COLLADA or 3MF file with its content ``data`` as one mesh, with vertex colours if
    the file has colours. Raises MeshError if the file is wrong, or a package that it needs is missing."""
    with located(path=path):
        if kind in _PACKAGES:
            _check_xml(kind, data)
            arrays = _parse_in_process(kind, data)
        else:
            _check_counts(kind, data)
            arrays = parse(kind, data)
        if arrays.get("textured"):
            warn_about(path, "its textures are not read: convert it to glTF or OBJ to keep them")
        mesh = Mesh(arrays["vertices"].astype(float), padded(arrays["faces"]), colors=arrays.get("colors"))
    return ForeignMesh(mesh, str(arrays["up"]), float(arrays["unit"]))


def parse(kind: str, data: bytes) -> dict[str, Any]:
    """Arrays of a file: ``vertices``, ``faces`` (N, 3), ``colors``, ``up``, ``unit``, ``textured``. Raises
    MeshError, also for each of the many exceptions that the parsers of trimesh raise."""
    import trimesh

    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    try:
        with np.errstate(all="ignore"):
            loaded = trimesh.load(io.BytesIO(data), file_type=kind, process=False, resolver=None)
            return _arrays(kind, data, loaded)
    except MeshError:
        raise
    except ImportError as reason:
        packages = _PACKAGES.get(kind, reason.name or "trimesh")
        raise MeshError(f"{kind.upper()} files need more packages: pip install {packages}") from None
    except RecursionError:
        raise MeshError(f"not a {kind.upper()} file: it is nested too deeply") from None
    except MemoryError:
        raise MeshError("the file needs too much memory") from None
    except Exception as reason:
        if any(importlib.util.find_spec(name) is None for name in _MODULES.get(kind, ())):
            raise MeshError(
                f"{kind.upper()} files need more packages: pip install {_PACKAGES[kind]}"
            ) from None
        text = " ".join(str(reason).split())[:100] or type(reason).__name__
        raise MeshError(f"not a {kind.upper()} file that can be read: {text}") from None


def _arrays(kind: str, data: bytes, loaded: Any) -> dict[str, Any]:
    """Join all parts of a file to one mesh. Each part is moved to its place."""
    import trimesh

    parts: list[tuple[Any, Array]] = []
    unit: object = None
    if isinstance(loaded, trimesh.Scene):
        total = 0
        for node in loaded.graph.nodes_geometry:
            transform, name = loaded.graph[node]
            part = loaded.geometry[name]
            if isinstance(part, trimesh.Trimesh):
                total += len(part.vertices)
                if total > _MAX_VERTICES:
                    break
                parts.append((part, transform))
                unit = part.metadata.get("units", unit)
    elif isinstance(loaded, trimesh.Trimesh):
        parts.append((loaded, np.eye(4)))
    if not any(len(part.faces) for part, _ in parts):
        raise MeshError("no faces: point clouds and lines cannot be skinned or rendered")
    if sum(len(part.vertices) for part, _ in parts) > _MAX_VERTICES:
        raise MeshError(f"more than {_MAX_VERTICES} vertices: simplify the mesh first")
    vertices: list[Array] = []
    faces, colors = [], []
    for part, transform in parts:
        points, corners, color = _part(part)
        if np.linalg.det(transform[:3, :3]) < 0:
            corners = corners[:, ::-1]
        faces.append(corners + sum(map(len, vertices)))
        vertices.append(points @ transform[:3, :3].T + transform[:3, 3])
        colors.append(color)
    out: dict[str, Any] = {"vertices": np.concatenate(vertices), "faces": np.concatenate(faces)}
    if any(color is not None for color in colors):
        grey = (np.full((len(points), 3), 153, np.uint8) for points in vertices)
        out["colors"] = np.concatenate([g if c is None else c for c, g in zip(colors, grey, strict=True)])
    if kind == "stl":
        out["vertices"], out["faces"] = _welded(out["vertices"], out["faces"])
    out["up"] = _collada_up(data) if kind == "dae" else "z"
    out["unit"] = _metres(str(unit)) if kind in _PACKAGES else 1.0
    out["textured"] = any(_has_texture(part) for part, _ in parts) or (
        kind == "dae" and re.search(rb"<(\w+:)?texture\s", data) is not None
    )
    return out


def _part(part: Any) -> tuple[Array, NDArray[np.int64], NDArray[np.uint8] | None]:
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


def _has_texture(part: Any) -> bool:
    material = getattr(part.visual, "material", None)
    return any(getattr(material, name, None) is not None for name in ("image", "baseColorTexture"))


def _welded(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Join vertices at the same position, in the order of first use. Faces without area are removed."""
    _, first, same = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.argsort(order)
    corners = rank[same.reshape(-1)][faces]
    a, b, c = corners.T
    return vertices[first[order]], corners[(a != b) & (b != c) & (c != a)]


def _collada_up(data: bytes) -> str:
    found = re.search(rb"<(?:\w+:)?up_axis>\s*([XYZ])_UP", data)
    return found.group(1).decode().lower() if found else "y"


def _metres(unit: str) -> float:
    """Metres per unit, by the name of the unit in trimesh."""
    if unit in _UNITS:
        return _UNITS[unit]
    found = re.fullmatch(r"([0-9.eE+-]+) \* meters", unit)
    try:
        value = float(found.group(1)) if found else 1.0
    except ValueError:
        value = 1.0
    return value if 1e-9 < value < 1e9 else 1.0


# --- checks before reading


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


def _check_xml(kind: str, data: bytes) -> None:
    """Raise MeshError for archives that become too large, and for XML with a document type."""
    texts = [data]
    if kind == "3mf":
        try:
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                entries = archive.infolist()
                total = sum(entry.file_size for entry in entries)
                if total > _MAX_XML or len(entries) > _MAX_ENTRIES:
                    raise MeshError(f"its archive holds {total >> 20} MB, more than {_MAX_XML >> 20} MB")
                models = [entry for entry in entries if entry.filename.lower().endswith((".model", ".rels"))]
                texts = [archive.read(entry) for entry in models]
        except ARCHIVE_ERRORS as reason:
            raise MeshError(f"not a 3MF file: its archive is damaged ({str(reason)[:60]})") from None
    for text in texts:
        if len(text) > _MAX_XML:
            raise MeshError(f"{len(text) >> 20} MB are too large; at most {_MAX_XML >> 20} MB are read")
        encoding = re.match(rb"\s*<\?xml[^>]*encoding\s*=\s*[\"']([\w.-]+)", text.lstrip(b"\xef\xbb\xbf"))
        plain = encoding is None or encoding.group(1).lower() in _ENCODINGS
        if not plain or b"\0" in text[:4096]:
            raise MeshError("its XML is not UTF-8: export it again")
        if b"<!DOCTYPE" in text or b"<!ENTITY" in text:
            raise MeshError("its XML has a document type, which mesh files do not need: remove it")


# --- another process


def _parse_in_process(kind: str, data: bytes) -> dict[str, Any]:
    """Run :func:`parse` in a process with limited memory and time."""
    path = os.pathsep.join(entry for entry in sys.path if entry)
    environment = {**os.environ, "PYTHONPATH": path, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-m", "humansim_ros.files.mesh.load", kind]
    try:
        done = run_limited(
            *(command, data),
            memory=_MEMORY,
            cpu_seconds=_CPU_SECONDS,
            seconds=_SECONDS,
            environment=environment,
        )
    except subprocess.TimeoutExpired:
        raise MeshError(f"it takes more than {_SECONDS} s to read: simplify it") from None
    if done.returncode == 0:
        with np.load(io.BytesIO(done.stdout), allow_pickle=False) as arrays:
            return {name: arrays[name] for name in arrays.files}
    lines = done.stderr.decode(errors="replace").strip().splitlines()
    if done.returncode == _REFUSED and lines:
        raise MeshError(lines[-1][:300])
    needed = f"{_MEMORY >> 30} GB of memory or {_CPU_SECONDS} s"
    raise MeshError(f"it needs more than {needed} to read: simplify it")


#: Exit code of the separate process for a file that cannot be read.
_REFUSED = 3


def main() -> None:
    """Read a file from stdin and write its arrays to stdout (.npz)."""
    try:
        arrays = parse(sys.argv[1], sys.stdin.buffer.read())
    except MeshError as error:
        print(error.message, file=sys.stderr)
        raise SystemExit(_REFUSED) from None
    out = io.BytesIO()
    np.savez(out, **arrays)
    sys.stdout.buffer.write(out.getvalue())


if __name__ == "__main__":
    main()
