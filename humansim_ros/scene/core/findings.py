"""Findings of the checks of a scene, the poses at which it is checked, and its obstacles.

Obstacles are furniture, mesh files and objects, in which no camera and no human should be.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from humansim_ros.files.mesh import Mesh
from humansim_ros.geometry import segments_crossing
from humansim_ros.motion.body import body_joints
from humansim_ros.scene.config.config import LIVE
from humansim_ros.scene.core.features import Feature
from humansim_ros.scene.core.objects import SceneObject
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.types import Array, Indices

#: Vertices closer than this share of the size of a mesh are one vertex.
_SAME_VERTEX = 1e-6
#: Point-triangle pairs that are computed at once.
_BATCH = 200_000


def closed_parts(vertices: Array, triangles: Indices) -> list[Array]:
    """Connected parts of a mesh that are closed: each edge joins two triangles, in opposite directions.

    Args:
        vertices: (V, 3). Vertices at the same place count as one.
        triangles: (T, 3) vertex indices.

    Returns:
        Corners (T_part, 3, 3) of the triangles of each closed part.
    """
    if not len(triangles):
        return []
    scale = max(float(np.ptp(vertices, axis=0).max()), 1e-12) * _SAME_VERTEX
    _, merged = np.unique(np.round(vertices / scale).astype(np.int64), axis=0, return_inverse=True)
    merged = merged.ravel()[triangles]
    keep = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    merged, corners = merged[keep], vertices[triangles[keep]]
    if not len(merged):
        return []
    count = int(merged.max()) + 1
    starts, ends = merged.ravel(), np.roll(merged, -1, axis=1).ravel()
    edges = coo_matrix((np.ones(len(starts)), (starts, ends)), shape=(count, count)).tocsr()
    _, part_of_vertex = connected_components(edges, directed=False)
    difference = (edges - edges.T).tocoo()
    open_parts = np.unique(part_of_vertex[difference.row[difference.data != 0]])
    part = part_of_vertex[merged[:, 0]]
    order = np.argsort(part, kind="stable")
    numbers, first = np.unique(part[order], return_index=True)
    groups = np.split(order, first[1:])
    return [corners[group] for number, group in zip(numbers, groups, strict=True) if number not in open_parts]


def volume(corners: Array) -> float:
    """Volume of a closed part (T, 3, 3), without sign."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return abs(float(np.einsum("ij,ij->", a - corners[0, 0], np.cross(b - a, c - a)))) / 6


def points_inside(points: Array, corners: Array) -> NDArray[np.bool_]:
    """Whether points (N, 3) are inside a closed part (T, 3, 3). The winding number is the sum of the solid
    angles of the triangles [Van Oosterom 1983]."""
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    inside = ((points > low) & (points < high)).all(axis=1)
    candidates = np.flatnonzero(inside)
    for chunk in np.array_split(candidates, max(1, len(candidates) * len(corners) // _BATCH)):
        inside[chunk] = np.abs(_winding_numbers(points[chunk], corners)) > 0.5
    return inside


def _winding_numbers(points: Array, corners: Array) -> Array:
    a, b, c = (corners[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=-1) for side in (a, b, c))
    triple = np.einsum("nti,nti->nt", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("nti,nti->nt", u, v) for u, v in ((a, b), (b, c), (c, a)))
    angles = 2 * np.arctan2(triple, la * lb * lc + ab * lc + bc * la + ca * lb)
    return np.asarray(angles.sum(axis=1) / (4 * np.pi))


Severity = Literal["error", "warning"]

#: Shortest and longest time that is checked, seconds.
_SHORTEST, _LONGEST = 60.0, 600.0


@dataclass(frozen=True)
class Finding:
    """Something in a scene that is probably a mistake.

    Attributes:
        severity: ``error``: the scene does not show what it should; ``warning``: it is doubtful.
        key: Key of the scene, such as ``cameras.left.position``.
        text: The problem and the remedy.
        path: The scene file; None for a scene that is made in memory.
        line: Line of the key.
    """

    severity: Severity
    key: str
    text: str
    path: str | None = None
    line: int | None = None

    def __str__(self) -> str:
        where = f"{self.path or 'scene'}{'' if self.line is None else f':{self.line}'}"
        return f"{where}: {self.key}: {self.text}"

    def located(self, source: SceneSource) -> Finding:
        """The same finding with the file of the scene and the line of the key."""
        path = None if source.path is None else str(source.path)
        return replace(self, path=path, line=source.line(self.key))

    def to_dict(self) -> dict[str, Any]:
        """Fields for ``humansim check --json``."""
        return {name: getattr(self, name) for name in ("severity", "path", "line", "key", "text")}


@dataclass(frozen=True)
class SceneSamples:
    """Joints and cameras of a scene at N times.

    Attributes:
        scene: The scene.
        step: Seconds between two times, at least.
        poses: Poses of humans to compute, at most.
        humans: Humans to check, at most.
        room: Whether the furniture of the room is an obstacle, which takes time to generate.
    """

    scene: Scene
    step: float
    poses: int
    humans: int = 10_000
    room: bool = True

    @property
    def duration(self) -> float:
        """Seconds that are checked: a minute, or a longer cycle of a motion or trajectory."""
        cycles = [actor.motion.duration for actor in self.scene.actors.values()]
        routes = [camera.route for camera in self.scene.scene_cameras.values()]
        if self.scene.robot is not None:
            routes.append(self.scene.robot.route)
        cycles += [route.duration for route in routes if route is not None]
        finite = [cycle for cycle in cycles if np.isfinite(cycle)]
        return float(np.clip(max(finite, default=0.0), _SHORTEST, _LONGEST))

    @cached_property
    def times(self) -> Array:
        """Scene times (N,) in seconds."""
        most = max(4, self.poses // max(1, min(len(self.scene.actors), self.humans)))
        return np.linspace(0, self.duration, min(most, 1 + round(self.duration / self.step)))

    @cached_property
    def joints(self) -> dict[str, Array]:
        """Positions (N, J, 3) in ``map`` of the joints of :meth:`joint_names`, by human, without humans that
        another node moves."""
        humans = self.scene.config.humans
        names = [name for name in self.scene.actors if humans[name].motion.file != LIVE]
        paths = {name: self.scene.actors[name].joint_paths(self.times) for name in names[: self.humans]}
        return {name: path[:, self._body(name)] for name, path in paths.items()}

    @cached_property
    def side_by_side(self) -> tuple[Array, Indices]:
        """Joints (N, P, 3) of all humans of :attr:`joints`, and the first of each."""
        counts = [0, *(path.shape[1] for path in self.joints.values())]
        return np.concatenate(list(self.joints.values()), axis=1), np.cumsum(counts)[:-1]

    def joint_names(self, name: str) -> list[str]:
        """Names of the joints of a human, without those of fingers, toes, jaw and eyes."""
        names = self.scene.actors[name].human.skeleton.joint_names
        return [names[joint] for joint in self._body(name)]

    def _body(self, name: str) -> list[int]:
        return body_joints(self.scene.actors[name].human.skeleton.joint_names)

    @cached_property
    def camera_poses(self) -> dict[str, tuple[Array, Array]]:
        """Extrinsics R (N, 3, 3) and t (N, 3) by camera; N is 1 for a camera that does not move."""
        poses = {}
        for name, camera in self.scene.scene_cameras.items():
            times = self.times.tolist() if camera.moves else [0.0]
            moments = [camera.pose(time) for time in times]
            poses[name] = np.array([each.R for each in moments]), np.array([each.t for each in moments])
        return poses

    def centers(self, name: str) -> Array:
        """Centres (N, 3) of a camera; N is 1 for a camera that does not move."""
        rotations, translations = self.camera_poses[name]
        return -np.einsum("nji,nj->ni", rotations, translations)

    @cached_property
    def obstacles(self) -> list[Obstacle]:
        """Obstacles, without those that are used as a room: all humans and cameras are inside them."""
        people = [joints[0].mean(axis=0) for joints in self.joints.values()]
        centers = [self.centers(name)[0] for name in self.scene.scene_cameras]
        everybody = np.array([*people, *centers]) if people else np.zeros((0, 3))
        return without_enclosures(find_obstacles(self.scene, self.room), everybody)

    @cached_property
    def middle(self) -> Array:
        """Middle (3,) of all humans at all times; one metre above the origin without humans."""
        if not self.joints:
            return np.array([0.0, 0.0, 1.0])
        return np.asarray(np.mean([joints.mean(axis=(0, 1)) for joints in self.joints.values()], axis=0))


class CheckedFeature(Feature):
    """A feature that finds mistakes in a scene that is made."""

    def check(self, samples: SceneSamples) -> Iterator[Finding]:
        """Find probable mistakes."""
        yield from ()


def motion_key(samples: SceneSamples, name: str) -> str:
    """Key that places a human."""
    if name in samples.scene.random_humans:
        return "variety"
    return f"humans.{name}.motion.position"


def numbers(values: Iterable[float], digits: int = 2) -> str:
    """Numbers as a list in a scene file, such as ``[3.1, 0, 2.2]``."""
    return "[" + ", ".join(f"{round(float(value), digits) + 0.0:g}" for value in values) + "]"


#: A sensor this near to a wall is in it, metres.
_IN_WALL = 0.02
#: Lowest plausible height of a sensor, metres.
LOWEST = -0.05


def misplaced(who: str, centers: Array, samples: SceneSamples, obstacles: Sequence[Obstacle]) -> str | None:
    """Finding about a sensor outside the room, in a wall, below the floor, or inside something.

    Args:
        who: The sensor, such as ``camera left``.
        centers: Its places in ``map``: (N, 3) at the times of the samples, or (1, 3).
        samples: Times and room.
        obstacles: What it must not be inside of.
    """
    room = samples.scene.environment.room
    moments = [f" at {time:.1f} s" for time in samples.times] if len(centers) > 1 else [""]
    if room is not None:
        outside = _outside(centers, np.array(room.size))
        if outside is not None:
            index, text = outside
            return f"{who} is at {numbers(centers[index])}{moments[index]}, {text}"
    elif centers[:, 2].min() < LOWEST:
        index = int(np.argmax(centers[:, 2] < LOWEST))
        return f"{who} is below the floor{moments[index]}, at z = {centers[index, 2]:.2f} m: is z up?"
    low, high = centers.min(axis=0).tolist(), centers.max(axis=0).tolist()
    for obstacle in obstacles:
        if obstacle.is_beside(low, high):
            continue
        inside = obstacle.contains(centers, samples.times)
        if inside.any():
            index = int(np.argmax(inside))
            moment = f" at {samples.times[index]:.1f} s" if len(inside) > 1 else ""
            where = f"{numbers(centers[index % len(centers)])}{moment}"
            return f"{who} is inside {obstacle.name}, at {where}: move one of them"
        if len(centers) > 1:
            # a thin wall may lie between two samples
            ways = obstacle.crossed(centers[:-1, None], centers[1:, None], samples.times[:-1])
            if ways.any():
                index = int(np.argmax(ways))
                where = f"{numbers(centers[index])}{moments[index]}"
                return f"{who} goes through {obstacle.name} after {where}: move one of them"
    return None


def _outside(centers: Array, size: Array) -> tuple[int, str] | None:
    """First of the centres (N, 3) that is outside a room of a size (3,) or in a wall, and the text."""
    half = size / 2
    beyond = np.abs(centers - (0, 0, half[2])) - half
    worst = beyond.max(axis=1)
    index = int(np.argmax(worst > -_IN_WALL))
    if worst[index] <= -_IN_WALL:
        return None
    axis = int(np.argmax(beyond[index]))
    wall = "wall" if axis < 2 else "floor" if centers[index, 2] < half[2] else "ceiling"
    x, y, z = half[0], half[1], size[2]
    space = f"x {-x:g} to {x:g}, y {-y:g} to {y:g}, z 0 to {z:g}"
    if worst[index] <= _IN_WALL:
        return index, f"in the {wall} of the room: move it into {space}"
    how_far = f"{worst[index]:.3g} m outside the room of {size[0]:g} x {size[1]:g} x {z:g} m"
    return index, f"{how_far}: move it into {space}, enlarge the room (room.size), or set room: null"


#: A closed part of a mesh file that is larger than this may be a room or a building, cubic metres.
_FURNITURE = 6.0
#: A closed part of less volume is a sheet of two sides, cubic metres.
_SHEET = 1e-7
#: Most triangles of a mesh with closed parts that are searched; larger meshes are scans.
_MOST_TRIANGLES = 300_000
#: Height below which surfaces of the room are its floor and carpet, metres.
_FLOOR = 0.03


@dataclass(frozen=True)
class Obstacle:
    """A surface, and the solids that it encloses.

    Attributes:
        key: Key of the scene.
        name: Name for messages, such as ``the object pillar``.
        mesh: Its mesh: in ``map``, or of a moving object.
        largest: Largest volume that counts as solid, cubic metres.
        surface: Whether the surface counts too, next to the solids that it encloses.
        moving: The moving object; None for what stands still.
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

    def is_beside(self, low: Sequence[float], high: Sequence[float]) -> bool:
        """Whether a box from ``low`` (3,) to ``high`` (3,) in ``map`` does not touch the box of the obstacle;
        False for a moving obstacle."""
        if self.moving is not None:
            return False
        (left, front, bottom), (right, back, top) = self._sides
        outside = low[0] > right or high[0] < left or low[1] > back or high[1] < front
        return outside or low[2] > top or high[2] < bottom

    @cached_property
    def _sides(self) -> tuple[list[float], list[float]]:
        low, high = self._box
        return low.tolist(), high.tolist()

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
        for mesh in environment.room_shapes:
            found.append(Obstacle("room", "furniture of the room", mesh, surface=False))
    for number, mesh in enumerate(environment.mesh_files):
        key = f"world.meshes.{number}" if len(scene.config.world.meshes) > number else "world.meshes"
        found.append(Obstacle(key, "a mesh of world.meshes", mesh, _FURNITURE))
    for name, item in scene.objects.items():
        largest = np.inf if item.shape in ("box", "sphere", "cylinder") else _FURNITURE
        mesh = item.mesh if item.moves else item.static_mesh()
        moving = item if item.moves else None
        found.append(Obstacle(item.key, f"the object {name}", mesh, largest, moving=moving))
    return found


def without_enclosures(obstacles: Sequence[Obstacle], points: Array) -> list[Obstacle]:
    """Obstacles that do not contain all points (N, 3): one that does is used as a room."""
    now = np.zeros(len(points))
    return [item for item in obstacles if not len(points) or not item.contains(points, now).all()]
