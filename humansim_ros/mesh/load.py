"""Read mesh files of any supported format: Wavefront OBJ and glTF 2.0."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from humansim_ros.errors import MeshError
from humansim_ros.io.files import read_bytes
from humansim_ros.mesh.gltf_mesh import read_gltf_materials, read_gltf_scene
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.mesh.obj import read_obj, read_obj_materials
from humansim_ros.types import Array

#: Suffixes of glTF files; VRM avatars are glTF files.
GLTF_SUFFIXES = (".gltf", ".glb", ".vrm")
#: (x, y, z) of a file with y up is (x, -z, y) with z up, as in Blender.
_Z_UP_FROM_Y_UP: Array = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh file (.obj, .gltf or .glb) as one mesh with one texture.

    Units and axes stay as in the file. A file with another suffix is glTF if its content says so, else OBJ.
    The textures of all materials become one image. Materials and textures are searched in the folder of the
    file and below it. Skinned meshes of a glTF file have the pose of its nodes.

    Raises:
        MeshError: The file is missing or wrong; the error has the file and the line or key.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile("w", suffix=".obj") as file:
        ...     _ = file.write("v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3\\n")
        ...     file.flush()
        ...     mesh = read_mesh(file.name)
        >>> mesh.vertices.shape
        (3, 3)
    """
    return read_gltf_scene(path) if is_gltf(path) else read_obj(path)


def read_mesh_z_up(path: str | os.PathLike[str]) -> Mesh:
    """Read a mesh file as one mesh, and turn glTF (y up) to z up. Raises MeshError."""
    return _to_z_up(read_mesh(path), "y" if is_gltf(path) else "z")


def read_materials_z_up(path: str | os.PathLike[str], up: Literal["y", "z"] | None = None) -> list[Mesh]:
    """Read a mesh file as one mesh for each material, with z up. Textures may repeat.

    ``up``: up axis of the file; None is y for glTF, z for OBJ. Raises MeshError.
    """
    gltf = is_gltf(path)
    read = read_gltf_materials if gltf else read_obj_materials
    return [_to_z_up(mesh, up or ("y" if gltf else "z")) for mesh in read(path)]


def is_gltf(path: str | os.PathLike[str]) -> bool:
    """Whether a mesh file is glTF: by its suffix, or by its first bytes if the suffix is unknown."""
    suffix = Path(path).suffix.lower()
    if suffix in (".obj", *GLTF_SUFFIXES):
        return suffix != ".obj"
    return read_bytes(path, MeshError, "mesh").lstrip()[:4].startswith((b"glTF", b"{"))


def _to_z_up(mesh: Mesh, up: Literal["y", "z"]) -> Mesh:
    return mesh if up == "z" else replace(mesh, vertices=mesh.vertices @ _Z_UP_FROM_Y_UP.T)
