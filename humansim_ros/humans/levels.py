"""Levels of detail of humans: of those of the package from its files, of others from the cache on disk.

Drawn people share them. The surface of a drawn person is a number of patches: between the hems of its
clothes, and of each thing that is worn. Each patch is simplified apart, once for all people who have it, and
the levels of a person are put together from those of its patches. The body is that of an average man: its
patches in the plainest clothes that are cut like those of the person, what is worn as the person wears it.
The error is measured on the average man in the clothes of the person.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimError, MeshError
from humansim_ros.humans.human import Human, human_from_arrays
from humansim_ros.humans.loading import content_key
from humansim_ros.humans.makehuman.packed import people_data
from humansim_ros.humans.makehuman.population import (
    Person,
    cut_model_of,
    is_person,
    model_of,
    person_config,
    read_person,
)
from humansim_ros.io.assets import resource_root
from humansim_ros.io.files import cache_folder
from humansim_ros.io.npz import read_npz, write_npz
from humansim_ros.mesh.mesh import split_seams
from humansim_ros.mesh.simplification import (
    Simplification,
    bounded_errors,
    patches,
    simplify,
    simplify_within,
)
from humansim_ros.types import Array, Indices

#: Raise it when the same human gets other levels, and run tools/assets/simplify_humans.py.
VERSION = 1
#: Number of triangles of each level, as a share of all.
SHARES = (0.5, 0.35, 0.25, 0.18, 0.12, 0.08)
#: Largest quadric error of each level of drawn people, metres: about the same numbers of triangles.
LIMITS = (0.0007, 0.0013, 0.0020, 0.0030, 0.0046, 0.0070)
#: Fewest triangles of a patch that is worth simplifying.
_FEWEST_OF_PATCH = 40
#: Fewest triangles of a mesh that is worth simplifying.
_FEWEST = 5000
#: Poses besides the rest pose, and the angle in radians by which each joint is turned about a random axis.
_POSES, _ANGLE = 3, 0.8
#: Folder of the levels of the humans of the package.
FOLDER = "assets/humans/levels"


def levels_of(human: Human) -> Simplification | None:
    """Levels of detail of a human, made once; None for a mesh of few triangles.

    Drawn people have the levels of all people with the same faces.
    """
    if len(human.mesh.triangles) < _FEWEST:
        return None
    if is_person(human.name):
        person = read_person(human.name)
        return _kept(_person_key(model_of(person)), lambda: levels_of_person(person))
    path = path_of(human, resource_root() / FOLDER)
    if path.is_file():
        with suppress(MeshError):
            return read_levels(path)
    return _kept(_key(human), lambda: make_levels(human))


def _kept(key: str, make: Callable[[], Simplification]) -> Simplification:
    """Levels from the cache on disk, or made and written there."""
    folder = cache_folder()
    path = None if folder is None else folder / "levels" / f"{key}.npz"
    if path is not None and path.is_file():
        with suppress(MeshError):
            return read_levels(path)
    made = make()
    if path is not None:
        with suppress(OSError, HumansimError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_levels(path, made)
    return made


def _person_key(model: Person) -> str:
    """Digest of what the levels of a model are made of."""
    parts = (f"levels {VERSION} {LIMITS}", repr(model), people_data().version)
    return content_key(part.encode() for part in parts)


def levels_of_person(person: Person) -> Simplification:
    """Put the levels of a drawn person together from those of its body and of what is worn."""
    model = _Model.of(model_of(person))
    cut_like = cut_model_of(person)

    def make_body() -> Simplification:
        other = _Model.of(cut_like)
        return other.levels(other.triangles.max(axis=1) < other.body_count)

    body = _kept(f"body-{_person_key(cut_like)}", make_body)
    worn = model.levels(model.triangles.min(axis=1) >= model.body_count)
    parents, removed_at = worn.parents.copy(), worn.removed_at.copy()
    count = model.body_count
    parents[:count], removed_at[:count] = body.parents[:count], body.removed_at[:count]
    return bounded_errors(
        Simplification(parents, _joined(body, worn, count), removed_at, worn.errors),
        model.poses,
        model.triangles,
        model.coordinates,
    )


class _Model:
    """An average man in some clothes."""

    def __init__(self, human: Human, body_count: int) -> None:
        self.body_count = body_count
        self.human, self.poses = human, _poses(human)
        self.triangles = human.mesh.triangles.astype(np.intp)
        self.coordinates = split_seams(human.mesh)[2].astype(np.intp)

    @classmethod
    def of(cls, person: Person) -> _Model:
        from humansim_ros.humans.makehuman.building import build_unpainted  # slow to import

        data = people_data()
        arrays, body_count = build_unpainted(data, person_config(data, person))
        return cls(human_from_arrays(arrays, "model"), body_count)

    def levels(self, chosen: NDArray[np.bool_]) -> Simplification:
        """Levels of the chosen triangles (N,), each patch apart; their errors are unknown."""
        count = self.poses.shape[1]
        parents: Indices = np.arange(count)
        coordinate_parents: Indices = np.arange(int(self.coordinates.max()) + 1)
        removed_at = np.full(count, 255, np.uint8)
        triangles, coordinates = self.triangles[chosen], self.coordinates[chosen]
        if len(triangles):
            patch = patches(triangles, coordinates)
            for number in np.flatnonzero(np.bincount(patch) >= _FEWEST_OF_PATCH):
                rows = patch == number
                vertices, own = _renumbered(triangles[rows])
                corners, own_corners = _renumbered(coordinates[rows])
                found = self._patch(vertices, own, own_corners)
                gone = found.removed_at < 255
                parents[vertices[gone]] = vertices[found.parents[gone]]
                removed_at[vertices[gone]] = found.removed_at[gone]
                moved = found.coordinate_parents != np.arange(len(corners))
                coordinate_parents[corners[moved]] = corners[found.coordinate_parents[moved]]
        return Simplification(parents, coordinate_parents, removed_at, np.array([0.0, *LIMITS]))

    def _patch(self, vertices: Indices, triangles: Indices, coordinates: Indices) -> Simplification:
        """Levels of a patch, from the cache if anybody has it."""
        poses = self.poses[:, vertices]
        key = _digest(f"patch {VERSION} {LIMITS}", (poses,), (triangles, coordinates))
        return _kept(f"patch-{key}", lambda: simplify_within(poses, triangles, coordinates, LIMITS))


def _renumbered(numbers: Indices) -> tuple[Indices, Indices]:
    """Numbers that occur in rows (N, 3), and the rows with their places among them."""
    found, inverse = np.unique(numbers, return_inverse=True)
    return found, inverse.reshape(-1, 3).astype(np.intp)


def _joined(body: Simplification, worn: Simplification, count: int) -> Indices:
    """Parents of texture coordinates of a body of some vertices and of what is worn.

    The first coordinate of each vertex has its number; the others come after all vertices.
    """
    total = len(worn.parents)
    parents = worn.coordinate_parents.copy()
    number = np.arange(len(body.coordinate_parents))
    within = (number < count) | (number >= len(body.parents))
    place = np.where(number < count, number, number - len(body.parents) + total)
    moved = np.flatnonzero(within & (body.coordinate_parents != number))
    parents[place[moved]] = place[body.coordinate_parents[moved]]
    return parents


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
    return _digest(
        f"{VERSION} {human.skinning}",
        (mesh.vertices, weights.data, human.skeleton.rest_inverse),
        (mesh.triangles, split_seams(mesh)[2], weights.indices, weights.indptr),
    )


def _digest(text: str, numbers: Sequence[NDArray[Any]], indices: Sequence[NDArray[Any]]) -> str:
    digest = hashlib.sha256(text.encode())
    for values, kind in ((numbers, "<f4"), (indices, "<i4")):
        for each in values:
            digest.update(np.ascontiguousarray(each, dtype=kind).tobytes())
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
