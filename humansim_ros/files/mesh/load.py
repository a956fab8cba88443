"""Read mesh files of any supported format."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Literal

import numpy as np

from humansim_ros.files.mesh.mesh import Mesh, MeshFormat, SkinnedMesh, read_format
from humansim_ros.files.mesh.obj import read_obj, read_obj_materials
from humansim_ros.files.mesh.trimesh_files import read_foreign
from humansim_ros.types import Array

#: Rotation to z up by up axis of a file. For y, Blender's rotation; for x, that of COLLADA.
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
        return read_obj(path, data, shaded=shaded), "z", 1.0
    foreign = read_foreign(path, kind, data)
    return foreign.mesh, foreign.up, foreign.unit


def _to_z_up(mesh: Mesh, up: str, unit: float = 1.0) -> Mesh:
    if up == "z" and unit == 1.0:
        return mesh
    rotation = _TO_Z_UP.get(up, np.eye(3))
    return replace(mesh, vertices=unit * mesh.vertices @ rotation.T)
