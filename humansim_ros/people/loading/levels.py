"""Levels of detail of the humans of the package: simplified meshes, read from files."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh import Simplification, split_seams
from humansim_ros.files.reading import read_npz, resource_root
from humansim_ros.people.humans.human import Human

#: Increase this number when the same human gets other levels, and run tools/assets/simplify_humans.py.
VERSION = 1
#: Folder of the levels of the humans of the package.
FOLDER = "assets/humans/levels"
#: Arrays of a file of levels, each with its type in memory and its type in the file.
ARRAYS: dict[str, tuple[type, type]] = {
    "parents": (np.intp, np.int32),
    "coordinate_parents": (np.intp, np.int32),
    "removed_at": (np.uint8, np.uint8),
    "errors": (float, float),
}


def levels_of(human: Human) -> Simplification | None:
    """Read the levels of detail of a human of the package. None for other humans."""
    path = path_of(human, resource_root() / FOLDER)
    return read_levels(path) if path.is_file() else None


def path_of(human: Human, folder: Path) -> Path:
    """File of the levels of a human in a folder. Its name is a digest of all that the levels depend on."""
    mesh, weights = human.mesh, human.weights
    digest = hashlib.sha256(f"{VERSION} {human.skinning}".encode())
    for values in (mesh.vertices, weights.data, human.skeleton.rest_inverse):
        digest.update(np.ascontiguousarray(values, dtype="<f4").tobytes())
    for values in (mesh.triangles, split_seams(mesh)[2], weights.indices, weights.indptr):
        digest.update(np.ascontiguousarray(values, dtype="<i4").tobytes())
    return folder / f"{digest.hexdigest()[:40]}.npz"


def read_levels(path: Path) -> Simplification:
    """Read levels. Raises MeshError for a file that has no levels."""
    arrays = read_npz(path, MeshError, "file of levels of detail")
    try:
        return Simplification(**{name: arrays[name].astype(kind) for name, (kind, _) in ARRAYS.items()})
    except KeyError as missing:
        raise MeshError("an array is missing", path=path, key=str(missing.args[0])) from None
