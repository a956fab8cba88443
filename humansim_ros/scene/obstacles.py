"""Obstacles of a scene: furniture, mesh files and objects, in which no camera and no human should be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.mesh.mesh import Mesh
from humansim_ros.mesh.solids import closed_parts, points_inside, segments_crossing, volume
from humansim_ros.scene.objects import SceneObject
from humansim_ros.scene.scene import Scene
from humansim_ros.types import Array

#: A closed part of a mesh file that is larger than this may be a room or a building, cubic metres.
_FURNITURE = 6.0
#: A closed part of less volume is a sheet of two sides, cubic metres.
_SHEET = 1e-7
#: Triangles of a mesh of which closed parts are searched; larger meshes are scans.
_MOST_TRIANGLES = 300_000
#: Height below which surfaces of the room are its floor and carpet, metres.
_FLOOR = 0.03


@dataclass(frozen=True)
class Obstacle:
    """A surface, and the solids that it encloses.

    Attributes:
        key: Key of the scene.
        name: Name for messages, such as ``the object pillar``.
        corners: (T, 3, 3) triangles: in ``map``, or of the mesh of a moving object.
        largest: Largest volume that counts as solid, cubic metres.
        surface: Whether the surface counts too, beside the solids that it encloses.
        moving: The moving object; None for what stands still.
        solid_parts: Closed parts; searched in ``mesh`` if None.
    """

    key: str
    name: str
    mesh: Mesh
    largest: float = np.inf
    surface: bool = True
    moving: SceneObject | None = None

    @cached_property
    def solids(self) -> list[Array]:
        """Closed parts (T, 3, 3) with a volume."""
        if len(self.mesh.triangles) > _MOST_TRIANGLES:
            return []
        parts = closed_parts(np.asarray(self.mesh.vertices, dtype=float), self.mesh.triangles.astype(np.intp))
        return [part for part in parts if _SHEET < volume(part) < self.largest]

    @cached_property
    def corners(self) -> Array:
        """(T, 3, 3) triangles that bones must not cross."""
        if self.surface:
            return np.asarray(self.mesh.vertices[self.mesh.triangles], dtype=float)
        parts = [part for part in self.solids if part[..., 2].max() > _FLOOR]
        return np.concatenate(parts) if parts else np.zeros((0, 3, 3))

    @cached_property
    def _box(self) -> tuple[Array, Array]:
        vertices = np.asarray(self.mesh.vertices, dtype=float)
        return vertices.min(axis=0), vertices.max(axis=0)

    def contains(self, points: Array, times: Array) -> NDArray[np.bool_]:
        """Whether points (N, 3) at times (N,), or one point, are inside one of the solids."""
        if self.moving is not None:
            at = np.broadcast_to(points, (len(times), 3))
            return self._contains(self.moving.to_mesh(at[:, None], times)[:, 0])
        return self._contains(points)

    def crossed(self, starts: Array, ends: Array, times: Array) -> NDArray[np.bool_]:
        """Whether any of the segments (N, S, 3) of each time (N,) crosses the surface."""
        if self.moving is not None:
            starts, ends = self.moving.to_mesh(starts, times), self.moving.to_mesh(ends, times)
        low, high = self._box
        near = ((np.maximum(starts, ends) >= low) & (np.minimum(starts, ends) <= high)).all(axis=-1)
        crossed = np.zeros(len(starts), bool)
        if near.any():
            hits = segments_crossing(starts[near], ends[near], self.corners)
            crossed[np.nonzero(near)[0][hits]] = True
        return crossed

    def _contains(self, points: Array) -> NDArray[np.bool_]:
        low, high = self._box
        near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
        inside = np.zeros(len(points), bool)
        if len(near):
            for part in self.solids:
                inside[near] |= points_inside(points[near], part)
        return inside


def find_obstacles(scene: Scene, room: bool = True) -> list[Obstacle]:
    """Obstacles of a scene. ``room``: include the furniture of the room, which takes time to generate."""
    found = []
    environment = scene.environment
    if room and environment.room is not None:
        count = len(environment.meshes) - len(environment.mesh_files)
        found += [
            Obstacle("room", "furniture of the room", mesh, surface=False)
            for mesh in environment.meshes[:count]
        ]
    for number, mesh in enumerate(environment.mesh_files):
        key = f"world.meshes.{number}" if len(scene.config.world.meshes) > number else "world.meshes"
        found.append(Obstacle(key, "a mesh of world.meshes", mesh, _FURNITURE))
    for name, item in scene.objects.items():
        key = f"objects.{name}" if name in scene.config.objects else "randomise.clutter"
        largest = np.inf if item.shape in ("box", "sphere", "cylinder") else _FURNITURE
        mesh = item.mesh if item.moves else item.static_mesh()
        found.append(Obstacle(key, f"the object {name}", mesh, largest, moving=item if item.moves else None))
    return found


def without_enclosures(obstacles: Sequence[Obstacle], points: Array) -> list[Obstacle]:
    """Obstacles that do not contain all points (N, 3): one that does is used as a room."""
    now = np.zeros(len(points))
    return [item for item in obstacles if not len(points) or not item.contains(points, now).all()]
