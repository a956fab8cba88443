"""Clutter: random objects on the floor, away from humans, cameras and other objects."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from humansim_ros.errors import SceneError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.mesh_buffers import PosedMesh, Topology
from humansim_ros.scene.actor import Actor
from humansim_ros.scene.camera import SceneCamera
from humansim_ros.scene.config import ObjectConfig, SceneConfig
from humansim_ros.scene.objects import SceneObject
from humansim_ros.scene.randomise import RandomNumbers, random_numbers
from humansim_ros.scene.source import SceneSource
from humansim_ros.types import Array

#: Seconds from the start of the scene in which humans do not touch clutter, and the step between two checks.
_DURATION, _STEP = 60.0, 0.2
#: Least distances in metres of clutter from joints of humans, from cameras, and from other objects.
_FROM_HUMANS, _FROM_CAMERAS, _FROM_OBJECTS = 0.35, 0.4, 0.05
#: Heights between which static meshes are obstacles.
_LOW, _HIGH = 0.05, 1.8
#: Positions tried for an object: _TRIES times _BATCH at once.
_TRIES, _BATCH = 20, 20


@dataclass(frozen=True)
class Obstacles:
    """Points (N, 2) seen from above that clutter keeps away from: joints, cameras, and objects.

    Humans and moving objects count as they are in the first minute of the scene.
    """

    humans: Array
    cameras: Array
    objects: Array

    @classmethod
    def of_scene(
        cls,
        actors: Iterable[Actor],
        cameras: Mapping[str, SceneCamera],
        objects: Mapping[str, SceneObject],
        static_meshes: Sequence[Mesh],
    ) -> Obstacles:
        """Find the obstacles of a scene.

        Args:
            actors: Humans of the scene.
            cameras: Cameras by name.
            objects: Objects by name; only the moving ones are used.
            static_meshes: Environment and static objects in ``map``.
        """
        times = np.arange(0.0, _DURATION, _STEP)
        humans: list[Array] = [np.zeros((0, 2))]
        for actor in actors:
            if actor.keyframes is None:
                joints = [actor.motion.sample(times + actor.offset).positions]
            else:
                joints = [actor.joint_poses(float(time)).positions for time in times[::5]]
            humans += [positions[..., :2].reshape(-1, 2) for positions in joints]
        centers = [camera.whole.center[None, :2] for camera in cameras.values()]
        points: list[Array] = [np.zeros((0, 2))]
        for mesh in static_meshes:
            samples = PosedMesh(Topology(mesh), mesh.vertices.astype(np.float32)).samples[0]
            points.append(samples[:2, (samples[2] > _LOW) & (samples[2] < _HIGH)].T.astype(float))
        for item in objects.values():
            if item.moves:
                poses = [item.at(float(time)).apply(item.mesh.vertices) for time in times[::5]]
                points += [vertices[:, :2] for vertices in poses]
        return cls(*(np.concatenate(part) for part in (humans, centers, points)))


def clutter(config: SceneConfig, source: SceneSource, obstacles: Obstacles) -> dict[str, ObjectConfig]:
    """Random boxes, cylinders and spheres on the floor, by name.

    A HumansimWarning says how many find no position. Raises SceneError if the scene uses one of their names.
    """
    randomise = config.randomise
    placed: dict[str, ObjectConfig] = {}
    if randomise is None or not randomise.clutter:
        return placed
    area = _area(config, obstacles.humans)
    trees = [
        (scipy.spatial.cKDTree(points), distance)
        for points, distance in (
            (obstacles.humans, _FROM_HUMANS),
            (obstacles.cameras, _FROM_CAMERAS),
            (obstacles.objects, _FROM_OBJECTS),
        )
        if len(points)
    ]
    circles: list[tuple[Array, float]] = []
    for number in range(1, randomise.clutter + 1):
        name, uniform = f"clutter_{number}", random_numbers(randomise.seed, f"clutter {number}")
        if name in config.objects:
            raise SceneError(f"there is an object {name} already", key="randomise.clutter")
        item, radius = _random_object(uniform)
        for _ in range(_TRIES):
            shares = np.array([(uniform(), uniform()) for _ in range(_BATCH)])
            positions = area[0] + radius + (np.ptp(area, axis=0) - 2 * radius) * shares
            free = np.all([tree.query(positions)[0] > radius + distance for tree, distance in trees], axis=0)
            for center, other in circles:
                free &= np.linalg.norm(positions - center, axis=1) > radius + other + _FROM_OBJECTS
            if free.any():
                circles.append((positions[np.argmax(free)], radius))
                x, y = (round(float(value), 4) for value in circles[-1][0])
                placed[name] = item.model_copy(
                    update={"position": (x, y, item.size[2] / 2), "label": randomise.clutter_label}
                )
                break
    if len(placed) < randomise.clutter:
        source.warn(
            "randomise.clutter",
            f"only {len(placed)} of {randomise.clutter} objects find a position on the floor where nobody "
            "walks",
        )
    return placed


def _random_object(uniform: RandomNumbers) -> tuple[ObjectConfig, float]:
    """Object of random shape, size and colour, and its radius seen from above."""
    kind = ("box", "cylinder", "sphere")[min(int(3 * uniform()), 2)]
    width, depth, height = (
        round(low + more * uniform(), 3) for low, more in ((0.2, 0.5), (0.2, 0.5), (0.3, 1.3))
    )
    sizes = {"box": (width, depth, height), "cylinder": (width, width, height), "sphere": (width,) * 3}
    size = sizes[kind]
    color = (int(256 * uniform()), int(256 * uniform()), int(256 * uniform()))
    yaw = round(360 * uniform(), 2) if kind == "box" else 0.0
    item = ObjectConfig(mesh=kind, size=size, color=color, rotation_deg=(0.0, 0.0, yaw))
    return item, math.hypot(size[0], size[1]) / 2 if kind == "box" else size[0] / 2


def _area(config: SceneConfig, humans: Array) -> Array:
    """(2, 2) low and high corner of the floor: of the room, or of the humans' area and two metres around."""
    if config.room is not None:
        half = np.array(config.room.size[:2]) / 2
        return np.array([-half, half])
    if not len(humans):
        return np.array([[-3.0, -3.0], [3.0, 3.0]])
    return np.array([humans.min(axis=0) - 2, humans.max(axis=0) + 2])
