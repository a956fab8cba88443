"""Looks drawn at random: light, colours, patterns, clutter, and where exactly cameras are.

The same seed gives the same draw. Each kind is drawn by itself: switching one on does not change the others.
"""

from __future__ import annotations

import math
import random
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimWarning, SceneError
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.render.posed_mesh import PosedMesh, Topology
from humansim_ros.scene.config import LightConfig, ObjectConfig, RandomiseConfig, SceneConfig
from humansim_ros.scene.room import pattern
from humansim_ros.types import Array, Image

if TYPE_CHECKING:
    from humansim_ros.scene.actor import Actor
    from humansim_ros.scene.camera import SceneCamera
    from humansim_ros.scene.objects import SceneObject

#: Seconds from the start of the scene in which clutter keeps out of people's way, and between looks.
_AHEAD, _STEP = 60.0, 0.2
#: Metres from people's joints, from cameras, and from what stands there already, that clutter keeps.
_CLEAR, _CLEAR_OF_CAMERA, _APART = 0.35, 0.4, 0.05
#: Between these heights what stands there is in the way of clutter.
_LOW, _HIGH = 0.05, 1.8
#: Places tried for a thing: so many times, so many at once.
_TRIES, _AT_ONCE = 20, 20


def _drawn(seed: int, what: str) -> Callable[[], float]:
    # random.random() is the same for a seed in every Python; its other functions need not be
    return random.Random(f"{seed}/{what}").random


def random_light(light: LightConfig, randomise: RandomiseConfig) -> LightConfig:
    """A light with another sun, and other colours of sun, sky and ground; the rest is as it says."""
    drawn = _drawn(randomise.seed, "light")
    height, around = math.radians(25 + 50 * drawn()), 2 * math.pi * drawn()
    sun = (math.cos(height) * math.cos(around), math.cos(height) * math.sin(around), math.sin(height))
    colors = {}
    for name, low, high in (
        ("sun_color", 0.3, 1.0),
        ("sky_color", 0.45, 0.95),
        ("ground_color", 0.25, 0.6),
    ):
        amount, warmth, green = low + (high - low) * drawn(), 0.5 * drawn() - 0.25, 0.1 * drawn() - 0.05
        colors[name] = (amount * (1 + warmth), amount * (1 + green), amount * (1 - warmth))
    return light.model_copy(update={"sun": sun, **colors})


def restyled(meshes: Sequence[Mesh], randomise: RandomiseConfig) -> list[Mesh]:
    """Meshes in other colours and patterns, as is asked for; those that share a texture still do."""
    looks: dict[int, Image] = {}
    out = []
    for number, mesh in enumerate(meshes):
        if mesh.texture is None:
            colors = mesh.colors
            if randomise.colours and colors is not None:
                drawn = _drawn(randomise.seed, f"colour {number}")
                colors = _recoloured(colors[:, None], drawn)[:, 0]
            out.append(replace(mesh, colors=colors))
            continue
        key = id(mesh.texture)
        if key not in looks:
            looks[key] = _look(mesh.texture, len(looks), randomise)
        out.append(replace(mesh, texture=looks[key]))
    return out


def _look(texture: Image, number: int, randomise: RandomiseConfig) -> Image:
    if randomise.textures:
        drawn = _drawn(randomise.seed, f"texture {number}")
        color = tuple(int(40 + 200 * drawn()) for _ in range(3))
        if not randomise.colours:
            color = tuple(int(c) for c in texture.reshape(-1, 3).mean(axis=0))
        side = 512 if max(texture.shape) >= 256 else 64
        return pattern(int(drawn() * 1e9), color, side)
    return _recoloured(texture, _drawn(randomise.seed, f"colour {number}")) if randomise.colours else texture


def _recoloured(image: Image, drawn: Callable[[], float]) -> Image:
    """An image (H, W, 3) with another hue, saturation and brightness."""
    hsv = cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2HSV).astype(np.float32)
    hsv[..., 0] = np.mod(hsv[..., 0] + 180 * drawn(), 180)
    hsv[..., 1] *= 0.5 + drawn()
    hsv[..., 2] *= 0.6 + 0.6 * drawn()
    return np.asarray(cv2.cvtColor(np.clip(hsv, 0, 255).astype(np.uint8), cv2.COLOR_HSV2RGB), np.uint8)


def jittered(cameras: Mapping[str, SceneCamera], randomise: RandomiseConfig) -> dict[str, SceneCamera]:
    """Cameras moved and turned a little; those that a trajectory moves are as it says."""
    jitter = randomise.camera_jitter
    if not jitter.position and not jitter.rotation_deg:
        return dict(cameras)
    return {name: camera if camera.moves else _moved(camera, randomise) for name, camera in cameras.items()}


def _moved(camera: SceneCamera, randomise: RandomiseConfig) -> SceneCamera:
    jitter, drawn = randomise.camera_jitter, _drawn(randomise.seed, f"camera {camera.name}")
    shift = np.array([jitter.position * (2 * drawn() - 1) for _ in range(3)])
    turn = np.radians([jitter.rotation_deg * (2 * drawn() - 1) for _ in range(3)])
    r = Rotation.from_rotvec(turn).as_matrix() @ camera.whole.R
    return replace(camera, whole=replace(camera.whole, R=r, t=-r @ (camera.whole.center + shift)))


@dataclass(frozen=True)
class Around:
    """What clutter keeps away from, seen from above: (N, 2) points of people's joints, of cameras, and of
    things.
    """

    people: Array
    cameras: Array
    things: Array

    @classmethod
    def of(
        cls,
        actors: Iterable[Actor],
        cameras: Mapping[str, SceneCamera],
        objects: Mapping[str, SceneObject],
        still: Sequence[Mesh],
    ) -> Around:
        """All that is known of the first minute of a scene."""
        times = np.arange(0.0, _AHEAD, _STEP)
        people: list[Array] = [np.zeros((0, 2))]
        for actor in actors:
            if actor.keyframes is None:
                places = [actor.motion.sample(times + actor.offset).positions]
            else:
                places = [actor.joint_poses(float(time)).positions for time in times[::5]]
            people += [place[..., :2].reshape(-1, 2) for place in places]
        eyes = [camera.whole.center[None, :2] for camera in cameras.values()]
        things: list[Array] = [np.zeros((0, 2))]
        for mesh in still:
            samples = PosedMesh(Topology(mesh), mesh.vertices.astype(np.float32)).samples[0]
            things.append(samples[:2, (samples[2] > _LOW) & (samples[2] < _HIGH)].T.astype(float))
        for thing in objects.values():
            if thing.moves:
                stand = [thing.at(float(time)).apply(thing.mesh.vertices) for time in times[::5]]
                things += [points[:, :2] for points in stand]
        return cls(*(np.concatenate(points) for points in (people, eyes, things)))


def clutter(config: SceneConfig, scene: Path, around: Around) -> dict[str, ObjectConfig]:
    """Boxes, cylinders and balls that stand on the floor, clear of people, cameras and things. A
    HumansimWarning tells of those that find no place.
    """
    randomise = config.randomise
    found: dict[str, ObjectConfig] = {}
    if randomise is None or not randomise.clutter:
        return found
    area = _area(config, around.people)
    trees = [
        (cKDTree(points), clear)
        for points, clear in zip(
            (around.people, around.cameras, around.things), (_CLEAR, _CLEAR_OF_CAMERA, _APART), strict=True
        )
        if len(points)
    ]
    placed: list[tuple[Array, float]] = []
    for number in range(1, randomise.clutter + 1):
        name, drawn = f"clutter_{number}", _drawn(randomise.seed, f"clutter {number}")
        if name in config.objects:
            raise SceneError(f"there is an object {name} already", path=scene, key="randomise.clutter")
        thing, radius = _thing(drawn)
        for _ in range(_TRIES):
            shares = np.array([(drawn(), drawn()) for _ in range(_AT_ONCE)])
            places = area[0] + radius + (np.ptp(area, axis=0) - 2 * radius) * shares
            free = np.all([tree.query(places)[0] > radius + clear for tree, clear in trees], axis=0)
            for other, reach in placed:
                free &= np.linalg.norm(places - other, axis=1) > radius + reach + _APART
            if free.any():
                placed.append((places[np.argmax(free)], radius))
                x, y = (round(float(value), 4) for value in placed[-1][0])
                found[name] = thing.model_copy(
                    update={"position": (x, y, thing.size[2] / 2), "label": randomise.clutter_label}
                )
                break
    if len(found) < randomise.clutter:
        warnings.warn(
            f"{scene}: randomise.clutter: only {len(found)} of {randomise.clutter} things find a place on "
            "the floor where nobody walks",
            HumansimWarning,
            stacklevel=2,
        )
    return found


def _thing(drawn: Callable[[], float]) -> tuple[ObjectConfig, float]:
    """A thing of any size and colour, and how far it reaches from its middle, seen from above."""
    kind = ("box", "cylinder", "sphere")[min(int(3 * drawn()), 2)]
    wide, deep, high = (round(low + more * drawn(), 3) for low, more in ((0.2, 0.5), (0.2, 0.5), (0.3, 1.3)))
    size = {"box": (wide, deep, high), "cylinder": (wide, wide, high), "sphere": (wide, wide, wide)}[kind]
    color = (int(256 * drawn()), int(256 * drawn()), int(256 * drawn()))
    yaw = round(360 * drawn(), 2) if kind == "box" else 0.0
    thing = ObjectConfig(mesh=kind, size=size, color=color, rotation_deg=(0.0, 0.0, yaw))
    return thing, math.hypot(size[0], size[1]) / 2 if kind == "box" else size[0] / 2


def _area(config: SceneConfig, people: Array) -> Array:
    """(2, 2) low and high corner of the floor: that of the room, or two metres around people."""
    if config.room is not None:
        half = np.array(config.room.size[:2]) / 2
        return np.array([-half, half])
    if not len(people):
        return np.array([[-3.0, -3.0], [3.0, 3.0]])
    return np.array([people.min(axis=0) - 2, people.max(axis=0) + 2])
