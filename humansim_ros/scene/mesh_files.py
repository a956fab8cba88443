"""Mesh files that stand in scenes: OBJ and glTF with their materials, turned as ``map`` is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from humansim_ros.mesh.mesh import Mesh
from humansim_ros.mesh.obj import read_mesh, read_surfaces
from humansim_ros.types import Array

#: From y up, as glTF has it and as Blender reads and writes it: (x, y, z) is (x, -z, y) in map.
_Y_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_thing(path: Path) -> Mesh:
    """A mesh file as one mesh, its z up. Raises MeshError."""
    if not _is_gltf(path):
        return read_mesh(path)
    from humansim_ros.mesh.gltf_mesh import read_gltf_mesh

    read = read_gltf_mesh(path)
    return turned(read if isinstance(read, Mesh) else read.mesh, _Y_UP)


def read_world_mesh(path: Path, up_axis: Literal["y", "z"] | None) -> list[Mesh]:
    """A mesh file as one mesh for each of its materials, its z up. Raises MeshError."""
    read: Callable[[Path], list[Mesh]] = read_surfaces
    if _is_gltf(path):
        from humansim_ros.mesh.gltf_mesh import read_gltf_surfaces

        read = read_gltf_surfaces
    up = up_axis or ("y" if _is_gltf(path) else "z")
    return [turned(mesh, _Y_UP) if up == "y" else mesh for mesh in read(path)]


def turned(mesh: Mesh, matrix: Array) -> Mesh:
    """A mesh whose vertices a matrix (3, 3) has moved."""
    return replace(mesh, vertices=mesh.vertices @ matrix.T)


def _is_gltf(path: Path) -> bool:
    return path.suffix.lower() in (".gltf", ".glb")
