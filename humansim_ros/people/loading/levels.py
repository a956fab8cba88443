"""Levels of detail of humans: simplified meshes. For humans of the package, they come from files; for all
other humans, from a cache on disk.

Drawn people (made by a seed) share levels. The surface of a drawn person consists of patches: the body
between the hems of its clothes, and each thing that is worn. Each patch is simplified separately, once for
all people who have it. The levels of a person are joined from the levels of its patches. For this, a patch is
taken from an average man in plain clothes of the same cut, with the same worn things. The error is measured
on the average man in the clothes of the person.
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
from humansim_ros.files.mesh import (
    Simplification,
    bounded_errors,
    patches,
    simplify,
    simplify_within,
    split_seams,
)
from humansim_ros.files.reading import cache_folder, read_npz, resource_root, write_npz
from humansim_ros.people.humans.human import Human, human_from_arrays
from humansim_ros.people.loading.loading import content_key
from humansim_ros.people.makehuman.data import people_data
from humansim_ros.people.makehuman.population import (
    Person,
    cut_model_of,
    is_person,
    model_of,
    person_config,
    read_person,
)
from humansim_ros.types import Array, Indices

#: Increase this number when the same human gets other levels, and run tools/assets/simplify_humans.py.
VERSION = 1
#: Number of triangles of each level, as a share of all triangles.
SHARES = (0.5, 0.35, 0.25, 0.18, 0.12, 0.08)
#: Largest quadric error of each level of drawn people, metres. The numbers of triangles are about those of
#: SHARES.
LIMITS = (0.0007, 0.0013, 0.0020, 0.0030, 0.0046, 0.0070)
#: Fewest triangles of a patch that is worth simplifying.
_FEWEST_OF_PATCH = 40
#: Fewest triangles of a mesh that is worth simplifying.
_FEWEST = 5000
#: Number of poses in addition to the rest pose, and the angle (radians) by which each joint turns about a
#: random axis.
_POSES, _ANGLE = 3, 0.8
#: Folder of the levels of the humans of the package.
FOLDER = "assets/humans/levels"
#: Arrays of a file of levels, each with its type in memory and its type in the file.
_ARRAYS: dict[str, tuple[type, type]] = {
    "parents": (np.intp, np.int32),
    "coordinate_parents": (np.intp, np.int32),
    "removed_at": (np.uint8, np.uint8),
    "errors": (float, float),
}


def levels_of(human: Human) -> Simplification | None:
    """Return the levels of detail of a human, made at the first call. None for a mesh with few triangles.
    Drawn people share the levels of all people with the same faces."""
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
    """Read levels from the cache on disk. If the cache lacks them, make and write them."""
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
    """Digest of everything on which the levels of a model depend."""
    parts = (f"levels {VERSION} {LIMITS}", repr(model), people_data().version)
    return content_key(part.encode() for part in parts)


def levels_of_person(person: Person) -> Simplification:
    """Join the levels of a drawn person from the levels of its body and of the worn things."""
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
    joined = Simplification(parents, _joined(body, worn, count), removed_at, worn.errors)
    return bounded_errors(joined, model.poses, model.triangles, model.coordinates)


class _Model:
    """An average man in some clothes."""

    def __init__(self, human: Human, body_count: int) -> None:
        self.body_count = body_count
        self.human, self.poses = human, _poses(human)
        self.triangles = human.mesh.triangles.astype(np.intp)
        self.coordinates = split_seams(human.mesh)[2].astype(np.intp)

    @classmethod
    def of(cls, person: Person) -> _Model:
        # imported here, since the import is slow
        from humansim_ros.people.makehuman.building import build_unpainted

        data = people_data()
        arrays, body_count = build_unpainted(data, person_config(data, person))
        return cls(human_from_arrays(arrays, "model"), body_count)

    def levels(self, chosen: NDArray[np.bool_]) -> Simplification:
        """Levels of the chosen triangles (N,), simplified patch by patch. Their errors are not known."""
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
        """Levels of a patch. They come from the cache if any person had this patch."""
        poses = self.poses[:, vertices]
        key = _digest(f"patch {VERSION} {LIMITS}", (poses,), (triangles, coordinates))
        return _kept(f"patch-{key}", lambda: simplify_within(poses, triangles, coordinates, LIMITS))


def _renumbered(numbers: Indices) -> tuple[Indices, Indices]:
    """Numbers that occur in rows (N, 3), and the rows with indices into these numbers."""
    found, inverse = np.unique(numbers, return_inverse=True)
    return found, inverse.reshape(-1, 3).astype(np.intp)


def _joined(body: Simplification, worn: Simplification, count: int) -> Indices:
    """Join the parents of texture coordinates of a body and of worn things. ``count``: number of vertices of
    the body. The first coordinate of each vertex has the number of the vertex. The others come after all
    vertices."""
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
    """(P, V, 3) vertices in the rest pose, and with all joints turned at random."""
    bones = len(human.skeleton)
    axes = np.random.default_rng(0).normal(size=(_POSES, bones, 3))
    axes *= _ANGLE / np.linalg.norm(axes, axis=-1, keepdims=True)
    turns = Rotation.from_rotvec(axes.reshape(-1, 3)).as_quat().reshape(_POSES, bones, 4)
    bent = [human.pose(human.skeleton.pose(turn)) for turn in turns]
    return np.stack([human.mesh.vertices, *bent]).astype(float)


def _key(human: Human) -> str:
    """Digest of everything on which the levels of a human depend."""
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
    """Read levels. Raises MeshError for a file that has no levels."""
    arrays = read_npz(path, MeshError, "file of levels of detail")
    try:
        return Simplification(**{name: arrays[name].astype(kind) for name, (kind, _) in _ARRAYS.items()})
    except KeyError as missing:
        raise MeshError("an array is missing", path=path, key=str(missing.args[0])) from None


def write_levels(path: Path, levels: Simplification) -> None:
    """Write levels atomically."""
    write_npz(path, {name: getattr(levels, name).astype(kind) for name, (_, kind) in _ARRAYS.items()})
