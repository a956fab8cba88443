"""Levels of detail of humans: of those of the package from its files, of others from the cache on disk."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimError, MeshError
from humansim_ros.humans.human import Human
from humansim_ros.humans.loading import make_person
from humansim_ros.humans.makehuman.population import is_person, model_of, read_person
from humansim_ros.io.assets import resource_root
from humansim_ros.io.files import cache_folder
from humansim_ros.io.npz import read_npz, write_npz
from humansim_ros.mesh.mesh import split_seams
from humansim_ros.mesh.simplification import Simplification, simplify
from humansim_ros.types import Array

#: Raise it when the same human gets other levels, and run tools/assets/simplify_humans.py.
VERSION = 1
#: Number of triangles of each level, as a share of all.
SHARES = (0.5, 0.35, 0.25, 0.18, 0.12, 0.08)
#: Fewest triangles of a mesh that is worth simplifying.
_FEWEST = 5000
#: Poses besides the rest pose, and the angle in radians by which each joint is turned about a random axis.
_POSES, _ANGLE = 3, 0.8
#: Folder of the levels of the humans of the package.
FOLDER = "assets/humans/levels"


def levels_of(human: Human) -> Simplification | None:
    """Levels of detail of a human, made once; None for a mesh of few triangles.

    Drawn people have the levels of one of them with the same faces.
    """
    if len(human.mesh.triangles) < _FEWEST:
        return None
    if is_person(human.name):
        human = make_person(model_of(read_person(human.name)), "model")
    cache = cache_folder()
    own = None if cache is None else path_of(human, cache / "levels")
    for path in (path_of(human, resource_root() / FOLDER), own):
        if path is not None and path.is_file():
            with suppress(MeshError):
                return read_levels(path)
    made = make_levels(human)
    if own is not None:
        with suppress(OSError, HumansimError):
            own.parent.mkdir(parents=True, exist_ok=True)
            write_levels(own, made)
    return made


def make_levels(human: Human) -> Simplification:
    """Simplify a human, without the cache; takes seconds."""
    return simplify(_poses(human), human.mesh.triangles, split_seams(human.mesh)[2], SHARES)


def _poses(human: Human) -> Array:
    """(P, V, 3) vertices at rest, and with all joints turned at random."""
    bones = len(human.skeleton)
    axes = np.random.default_rng(0).normal(size=(_POSES, bones, 3))
    axes *= _ANGLE / np.linalg.norm(axes, axis=-1, keepdims=True)
    turns = Rotation.from_rotvec(axes.reshape(-1, 3)).as_quat().reshape(_POSES, bones, 4)
    bent = [human.pose(human.skeleton.pose(turn)) for turn in turns]
    return np.stack([human.mesh.vertices, *bent]).astype(float)


def _key(human: Human) -> str:
    """Digest of what levels are made of."""
    mesh, weights = human.mesh, human.weights
    digest = hashlib.sha256(f"{VERSION} {human.skinning}".encode())
    for values in (mesh.vertices, weights.data, human.skeleton.rest_inverse):
        digest.update(np.ascontiguousarray(values, dtype="<f4").tobytes())
    for indices in (mesh.triangles, split_seams(mesh)[2], weights.indices, weights.indptr):
        digest.update(np.ascontiguousarray(indices, dtype="<i4").tobytes())
    return digest.hexdigest()[:40]


def path_of(human: Human, folder: Path) -> Path:
    """File of the levels of a human in a folder."""
    return folder / f"{_key(human)}.npz"


def read_levels(path: Path) -> Simplification:
    """Read levels. Raises MeshError for a file that is not one of levels."""
    arrays = read_npz(path, MeshError, "file of levels of detail")
    try:
        return Simplification(
            arrays["parents"].astype(np.intp),
            arrays["coordinate_parents"].astype(np.intp),
            arrays["removed_at"].astype(np.uint8),
            arrays["errors"].astype(float),
        )
    except KeyError as missing:
        raise MeshError("an array is missing", path=path, key=str(missing.args[0])) from None


def write_levels(path: Path, levels: Simplification) -> None:
    """Write levels atomically."""
    kind = np.int32
    write_npz(
        path,
        {
            "parents": levels.parents.astype(kind),
            "coordinate_parents": levels.coordinate_parents.astype(kind),
            "removed_at": levels.removed_at,
            "errors": levels.errors,
        },
    )
