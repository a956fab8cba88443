"""Random boxes, cylinders and spheres on the floor: ``randomise.clutter`` of a scene file."""

from __future__ import annotations

import math

import numpy as np

from humansim_ros.errors import SceneError
from humansim_ros.render.device import PosedMesh, Topology
from humansim_ros.scene.config.config import ObjectConfig
from humansim_ros.scene.core.features import Draft, Feature
from humansim_ros.scene.core.floor import DURATION, Floor, floor_corners
from humansim_ros.scene.core.looks import RandomNumbers, random_numbers
from humansim_ros.types import Array

#: Seconds between two times of the first minute at which humans are not touched.
_STEP = 0.2
#: Least distances in metres of clutter from joints of humans, from cameras, and from other objects.
_FROM_HUMANS, _FROM_CAMERAS, _FROM_OBJECTS = 0.35, 0.4, 0.05
#: Heights between which static meshes are obstacles.
_LOW, _HIGH = 0.05, 1.8
#: Positions tried for an object: _TRIES times _BATCH at once.
_TRIES, _BATCH = 20, 20
#: Without a room, clutter is this far around humans, or around the origin if there are no humans, metres.
_AROUND_HUMANS, _AROUND_ORIGIN = 2.0, 3.0


class Clutter(Feature):
    """Random objects where nobody walks."""

    def furnish(self, draft: Draft) -> None:
        """Add the objects. A HumansimWarning says how many find no position. Raises SceneError if the scene
        uses one of their names."""
        randomise = draft.config.randomise
        assert randomise is not None
        humans = _joints(draft)
        floor, area = _floor(draft, humans), _area(draft, humans)
        placed: dict[str, ObjectConfig] = {}
        centers, radii = np.zeros((0, 2)), np.zeros(0)
        for number in range(1, randomise.clutter + 1):
            name, uniform = f"clutter_{number}", random_numbers(randomise.seed, f"clutter {number}")
            if name in draft.config.objects:
                raise SceneError(f"there is an object {name} already", key="randomise.clutter")
            item, radius = _random_object(uniform)
            for _ in range(_TRIES):
                shares = np.array([(uniform(), uniform()) for _ in range(_BATCH)])
                positions = area[0] + radius + (np.ptp(area, axis=0) - 2 * radius) * shares
                free = floor.clear(np.zeros((1, 2)), positions, radius)
                apart = np.linalg.norm(positions[:, None] - centers, axis=-1)
                free &= (apart > radius + radii + _FROM_OBJECTS).all(axis=1)
                if free.any():
                    center = positions[np.argmax(free)]
                    centers, radii = np.vstack([centers, center]), np.append(radii, radius)
                    x, y = (round(float(value), 4) for value in center)
                    place = {"position": (x, y, item.size[2] / 2), "label": randomise.clutter_label}
                    placed[name] = item.model_copy(update=place)
                    break
        if len(placed) < randomise.clutter:
            found = f"only {len(placed)} of {randomise.clutter} objects find a position"
            draft.source.warn("randomise.clutter", f"{found} on the floor where nobody walks")
        draft.add_objects(placed, "randomise.clutter")


def _joints(draft: Draft) -> Array:
    """Points (N, 2) where joints of the motions of humans come in the first minute."""
    times = np.arange(0.0, DURATION, _STEP)
    points: list[Array] = [np.zeros((0, 2))]
    for actor in draft.actors.values():
        if actor.keyframes is None:
            joints = [actor.motion.sample(times + actor.offset).positions]
        else:
            joints = [actor.joint_poses(float(time)).positions for time in times[::5]]
        points += [positions[..., :2].reshape(-1, 2) for positions in joints]
    return np.concatenate(points)


def _floor(draft: Draft, humans: Array) -> Floor:
    """Floor with humans, cameras and all that stands or moves on it."""
    floor, objects = Floor(), draft.objects.values()
    floor.take("humans", humans, _FROM_HUMANS)
    for camera in draft.cameras.values():
        floor.take("cameras", camera.whole.center[None, :2], _FROM_CAMERAS)
    static = (item.static_mesh() for item in objects if not item.moves)
    for mesh in (*draft.environment.meshes, *static):
        samples = PosedMesh(Topology(mesh), mesh.vertices.astype(np.float32)).samples[0]
        seen = samples[:2, (samples[2] > _LOW) & (samples[2] < _HIGH)].T
        floor.take("objects", seen.astype(float), _FROM_OBJECTS)
    for item in objects:
        if item.moves:
            for time in np.arange(0.0, DURATION, _STEP)[::5].tolist():
                floor.take("objects", item.at(time).apply(item.mesh.vertices)[:, :2], _FROM_OBJECTS)
    return floor


def _random_object(uniform: RandomNumbers) -> tuple[ObjectConfig, float]:
    """Object of random shape, size and colour, and its radius seen from above."""
    kind = ("box", "cylinder", "sphere")[min(int(3 * uniform()), 2)]
    ranges = ((0.2, 0.5), (0.2, 0.5), (0.3, 1.3))
    width, depth, height = (round(low + more * uniform(), 3) for low, more in ranges)
    size = {"box": (width, depth, height), "cylinder": (width, width, height), "sphere": (width,) * 3}[kind]
    color = (int(256 * uniform()), int(256 * uniform()), int(256 * uniform()))
    yaw = round(360 * uniform(), 2) if kind == "box" else 0.0
    item = ObjectConfig(mesh=kind, size=size, color=color, rotation_deg=(0.0, 0.0, yaw))
    return item, math.hypot(size[0], size[1]) / 2 if kind == "box" else size[0] / 2


def _area(draft: Draft, humans: Array) -> Array:
    """Low and high corner (2, 2) of the floor of the room. Without a room, around the humans."""
    if draft.config.room is None and len(humans):
        return np.array([humans.min(axis=0) - _AROUND_HUMANS, humans.max(axis=0) + _AROUND_HUMANS])
    return floor_corners(draft.config, 2 * _AROUND_ORIGIN)


FEATURE = Clutter()
