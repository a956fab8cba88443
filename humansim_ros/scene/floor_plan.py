"""What stands on the floor of a scene, seen from above: furniture, objects and mesh files."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import in_section
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.motion.keyframes import KeyframeTrack
from humansim_ros.render.posed_mesh import PosedMesh, Topology
from humansim_ros.scene.config import SceneConfig
from humansim_ros.scene.environment import mesh_files
from humansim_ros.scene.objects import SceneObject
from humansim_ros.scene.room import furniture_plan
from humansim_ros.scene.source import SceneSource
from humansim_ros.types import Array

#: Metres between points.
_CELL = 0.05
#: Heights in metres between which something is in the way of people.
_LOW, _HIGH = 0.1, 2.0
#: Times in seconds at which moving objects are in the way.
_TIMES = np.arange(0.0, 60.0, 0.5)
#: Triangles with a longer side, metres, get points between their corners, unless there are more than this.
_LONG, _MOST_LONG = 0.1, 3000


def things_on_floor(
    config: SceneConfig,
    source: SceneSource,
    tracks: Mapping[tuple[str, str], KeyframeTrack],
    area: Array,
) -> Array:
    """Points (M, 2), about 5 cm apart, where something stands or, in the first minute, passes.

    Args:
        config: The scene.
        source: Finds mesh files.
        tracks: Keyframes by section and name.
        area: Two corners (2, 2) of the area of people. A mesh around all of it is a room: only its walls
            count.

    Raises:
        HumansimError: With the key, if a mesh cannot be read.
    """
    points = [np.zeros((0, 2)), *_furniture(config), *_objects(config, source, tracks, area)]
    points += [_seen_from_above(_samples(mesh), area) for mesh in mesh_files(config, source)]
    return _CELL * np.unique(np.round(np.concatenate(points) / _CELL), axis=0)


def _furniture(config: SceneConfig) -> Iterator[Array]:
    """Points on the furniture of the room."""
    if config.room is None:
        return
    for center, size in furniture_plan(config.room.size[:2]).values():
        x, y = (
            np.linspace(c - s / 2, c + s / 2, 2 + int(s / _CELL)) for c, s in zip(center, size, strict=True)
        )
        yield np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _objects(
    config: SceneConfig,
    source: SceneSource,
    tracks: Mapping[tuple[str, str], KeyframeTrack],
    area: Array,
) -> Iterator[Array]:
    for name, section in config.objects.items():
        with in_section(f"objects.{name}"):
            item = SceneObject.build(name, section, source, tracks.get(("objects", name)), 0)
        if not item.moves:
            yield _seen_from_above(_samples(item.static_mesh()), area)
            continue
        points = _samples(item.mesh)
        points = points[:: 1 + len(points) // 1000]
        for time in _TIMES.tolist():
            yield _seen_from_above(item.at(time).apply(points), area)


def _samples(mesh: Mesh) -> Array:
    """Points (N, 3) on the surface."""
    vertices = np.asarray(mesh.vertices, dtype=np.float32)
    corners = vertices[mesh.triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)
    long = mesh.triangles[(sides > _LONG).any(axis=1)]
    if not 0 < len(long) <= _MOST_LONG:
        return vertices.astype(float)
    faces = np.pad(long, ((0, 0), (0, 1)), constant_values=-1)
    between = PosedMesh(Topology(Mesh(vertices.astype(float), faces)), vertices).samples[0].T
    return np.concatenate([vertices, between]).astype(float)


def _seen_from_above(points: Array, area: Array) -> Array:
    """Those of the surface points (N, 3) that are in the way, as (M, 2)."""
    height = points[:, 2]
    in_the_way: NDArray[np.bool_] = (height > _LOW) & (height < _HIGH)
    flat = points[:, :2]
    around = len(points) and bool(
        (flat.min(axis=0) <= area.min(axis=0)).all() and (flat.max(axis=0) >= area.max(axis=0)).all()
    )
    # the top of a tall thing stands for its inside
    return flat[(height > _LOW) if in_the_way.any() and not around else in_the_way]
