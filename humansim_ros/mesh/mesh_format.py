"""Format of a mesh file: by its content, else by its suffix."""

from __future__ import annotations

import io
import os
import re
import struct
import zipfile
from pathlib import Path
from typing import Literal

from humansim_ros.errors import MeshError
from humansim_ros.io.files import read_bytes

MeshFormat = Literal["obj", "gltf", "ply", "stl", "off", "dae", "3mf"]
#: Formats by suffix. VRM avatars are glTF files.
MESH_SUFFIXES: dict[str, MeshFormat] = {
    ".obj": "obj",
    ".gltf": "gltf",
    ".glb": "gltf",
    ".vrm": "gltf",
    ".ply": "ply",
    ".stl": "stl",
    ".off": "off",
    ".dae": "dae",
    ".3mf": "3mf",
}
#: Largest mesh file.
MAX_BYTES = 1 << 29


def read_format(path: str | os.PathLike[str]) -> tuple[MeshFormat, bytes]:
    """Format and content of a mesh file. Raises MeshError if it is missing, empty or too large."""
    data = read_bytes(path, MeshError, "mesh", MAX_BYTES)
    return format_of(data) or MESH_SUFFIXES.get(Path(path).suffix.lower(), "obj"), data


def format_of(data: bytes) -> MeshFormat | None:
    """Format of a file with a signature; None for OBJ and unknown files."""
    start = data[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith((b"glTF", b"{")):
        return "gltf"
    if re.match(rb"ply\s", start):
        return "ply"
    if re.match(rb"(ST)?(C)?(N)?(4)?OFF\s", start):
        return "off"
    if re.match(rb"<(\?xml|!--|COLLADA)", start) and b"<COLLADA" in data[:65536]:
        return "dae"
    if start.startswith(b"PK\3\4"):
        return "3mf" if any(name.lower().endswith("3dmodel.model") for name in _names(data)) else None
    if len(data) >= 84 and len(data) == 84 + 50 * struct.unpack_from("<I", data, 80)[0]:
        return "stl"
    if re.match(rb"solid\b[^\n]*\n\s*(facet|endsolid)\b", start):
        return "stl"
    return None


def _names(data: bytes) -> list[str]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return archive.namelist()
    except (zipfile.BadZipFile, ValueError, OSError, NotImplementedError, RuntimeError):
        return []
