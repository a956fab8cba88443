"""Things of a scene that are no people: they stand or move, show in rgb and depth, hide what is behind them,
and have labels if they are asked to. And the keyframes that move people and things.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimWarning, MotionError, SceneError
from humansim_ros.io.files import resolve_relative
from humansim_ros.mesh.load import read_mesh_z_up
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.motion.joint_poses import Velocity
from humansim_ros.motion.keyframe_tracks import KeyframeTrack
from humansim_ros.motion.keyframes import Keyframes, read_keyframes
from humansim_ros.render import Body
from humansim_ros.rotations import quaternion_to_matrix
from humansim_ros.scene.config import KeyframesConfig, ObjectConfig, SceneConfig
from humansim_ros.types import Array

#: Segments around a sphere or a cylinder.
_ROUND = 48


@dataclass(frozen=True)
class ObjectPose:
    """``position`` (3,) in ``map``, metres; ``rotation`` (4,) xyzw; ``size`` (3,) along the own axes:
    factors of the mesh, which are metres for the built-in ones. A point x of the mesh is at
    ``position + rotation (size * x)``. ``velocity``: how it moves; None if that is not known.
    """

    position: Array
    rotation: Array
    size: Array
    velocity: Velocity | None = None

    def moved(self, seconds: float) -> ObjectPose:
        """Where it is some time later, or before, as it moves now."""
        if self.velocity is None or seconds == 0:
            return self
        turn = Rotation.from_rotvec(seconds * self.velocity.angular)
        position = self.position + seconds * self.velocity.linear
        return replace(self, position=position, rotation=(turn * Rotation.from_quat(self.rotation)).as_quat())

    def apply(self, points: Array) -> Array:
        """Where points (..., 3) of the mesh are in ``map``."""
        turned = (points * self.size) @ quaternion_to_matrix(self.rotation).T
        return np.asarray(turned + self.position)


@dataclass(frozen=True)
class SceneObject:
    """A thing: its ``mesh`` at size 1 about its own origin, where it ``stands``, and the keys that move it.

    ``shape``: box, sphere, cylinder, or the path of the mesh's file. ``instance``: the label it is drawn
    with, 0 if it has none.
    """

    name: str
    shape: str
    color: tuple[int, int, int]
    mesh: Mesh
    stands: ObjectPose
    keyframes: KeyframeTrack | None = None
    instance: int = 0

    @classmethod
    def build(
        cls, name: str, config: ObjectConfig, scene: Path, keyframes: KeyframeTrack | None, instance: int
    ) -> SceneObject:
        """A thing of a scene file. Raises SceneError or MeshError naming what is wrong with it."""
        if config.mesh in SHAPES:
            shape, mesh = config.mesh, SHAPES[config.mesh]()
        else:
            key = f"objects.{name}.mesh"
            known = f"the built-in meshes are {', '.join(SHAPES)}"
            path = _existing(config.mesh, scene, key, known)
            shape = str(path.resolve())
            mesh = read_mesh_z_up(path)
        plain = mesh.texture is None or "color" in config.model_fields_set
        colors = np.tile(np.array(config.color, np.uint8), (len(mesh.vertices), 1)) if plain else None
        turn = Rotation.from_euler("xyz", config.rotation_deg, degrees=True).as_quat()
        stands = ObjectPose(np.array(config.position), turn, np.array(config.size))
        return cls(name, shape, config.color, replace(mesh, colors=colors), stands, keyframes, instance)

    @property
    def moves(self) -> bool:
        return self.keyframes is not None

    def at(self, seconds: float) -> ObjectPose:
        """Where it is at a time since the start of the scene, and how it moves: its place, moved as the
        keyframes say.
        """
        if self.keyframes is None:
            return self.stands
        times, key = self.keyframes.around(seconds)
        turn = Rotation.from_quat(key.quaternion)
        position = key.position + turn.apply(key.size * self.stands.position)
        rotation = (turn * Rotation.from_quat(self.stands.rotation)).as_quat()
        velocity = Velocity.between(position[::2], rotation[::2], times[2] - times[0])
        return ObjectPose(position[1], rotation[1], key.size[1] * self.stands.size, velocity)

    def body(self, pose: ObjectPose) -> Body:
        """What a renderer needs to draw it; it has no parts."""
        return self._body(self.mesh, pose.apply(self.mesh.vertices))

    def standing(self) -> Mesh:
        """Its mesh in ``map`` where it stands."""
        return replace(self.mesh, vertices=self.stands.apply(self.mesh.vertices))

    def standing_body(self, standing: Mesh) -> Body:
        """The same as a renderer draws it frame by frame, with the looks of :meth:`standing` or others."""
        return self._body(replace(standing, vertices=self.mesh.vertices), standing.vertices)

    def _body(self, mesh: Mesh, vertices: Array) -> Body:
        return Body(mesh, vertices.astype(np.float32), self._parts, self.instance, "object")

    @cached_property
    def _parts(self) -> NDArray[np.uint8]:
        return np.zeros(len(self.mesh.triangles), np.uint8)


def load_tracks(config: SceneConfig, scene: Path) -> dict[tuple[str, str], KeyframeTrack]:
    """The keyframes of a scene's people and things, by section ("humans", "objects") and name.

    Every file is read once. A HumansimWarning names what a file moves that is not in the scene. Raises
    SceneError where a file is not there, MotionError where it is wrong, moves no such object, or sizes a
    person differently along x, y and z.
    """
    files: dict[Path, Keyframes] = {}
    used: set[tuple[Path, str]] = set()
    tracks = {}
    sections: dict[str, dict[str, Any]] = {"humans": config.humans, "objects": config.objects}
    for section, things in sections.items():
        for name, thing in things.items():
            keyframes: KeyframesConfig | None = thing.keyframes
            if keyframes is None:
                continue
            path = _existing(keyframes.file, scene, f"{section}.{name}.keyframes")
            if path not in files:
                files[path] = read_keyframes(path)
            wanted = keyframes.object or name
            track = files[path].track(wanted)
            used.add((path, wanted))
            if section == "humans" and np.ptp(track.sizes, axis=1).any():
                frame = int(track.frames[np.argmax(np.ptp(track.sizes, axis=1) > 0)])
                raise MotionError(
                    f"{wanted!r} moves a person: its size must be the same along x, y and z (frame {frame})",
                    path=path,
                )
            tracks[section, name] = track
    for path, content in files.items():
        idle = [name for name in content.tracks if (path, name) not in used]
        if idle:
            warnings.warn(
                f"{path}: nothing in {scene} is moved by {', '.join(idle[:20])}",
                HumansimWarning,
                stacklevel=3,
            )
    return tracks


def _existing(name: str, scene: Path, key: str, known: str = "") -> Path:
    path, there = resolve_relative(scene, name)
    if not there:
        raise SceneError(f"no such file {str(path)!r}" + (f"; {known}" if known else ""), path=scene, key=key)
    return path


def _box() -> Mesh:
    """A cube with sides of 1, centred. Its sides share no vertices, so that edges are sharp when lit."""
    side = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    vertices = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            corners = np.insert(side if sign > 0 else side[::-1], 0, sign, axis=1)
            vertices.append(np.roll(corners, axis, axis=1))
    faces = np.arange(24, dtype=np.int32).reshape(6, 4)
    return Mesh(np.concatenate(vertices), faces)


def _sphere() -> Mesh:
    """A ball of diameter 1, centred."""
    rings = _ROUND // 2
    polar = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    around = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)
    flat = np.sin(polar)
    grid = np.stack(
        [flat * np.cos(around), flat * np.sin(around), np.broadcast_to(np.cos(polar), (rings - 1, _ROUND))],
        -1,
    ).reshape(-1, 3)
    vertices = np.concatenate([grid, [[0, 0, 1], [0, 0, -1]]]) / 2
    i, j = np.arange(_ROUND), (np.arange(_ROUND) + 1) % _ROUND
    none = np.full(_ROUND, -1)
    top, bottom, last = len(grid), len(grid) + 1, len(grid) - _ROUND
    faces = [np.column_stack([i, j, np.full(_ROUND, top), none])]
    faces += [
        np.column_stack([i + low, j + low, j + low - _ROUND, i + low - _ROUND])
        for low in range(_ROUND, len(grid), _ROUND)
    ]
    faces += [np.column_stack([j + last, i + last, np.full(_ROUND, bottom), none])]
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))


def _cylinder() -> Mesh:
    """A cylinder of diameter and height 1 along z, centred; its caps share no vertices with its side."""
    around = np.linspace(0, 2 * np.pi, _ROUND, endpoint=False)
    ring = np.column_stack([np.cos(around), np.sin(around), np.zeros(_ROUND)]) / 2
    half = np.array([0, 0, 0.5])
    low, high = ring - half, ring + half
    vertices = np.concatenate([low, high, low, high, [[0, 0, -0.5], [0, 0, 0.5]]])
    i, j = np.arange(_ROUND), (np.arange(_ROUND) + 1) % _ROUND
    none, n = np.full(_ROUND, -1), _ROUND
    faces = [
        np.column_stack([i, j, j + n, i + n]),
        np.column_stack([j + 2 * n, i + 2 * n, np.full(n, 4 * n), none]),
        np.column_stack([i + 3 * n, j + 3 * n, np.full(n, 4 * n + 1), none]),
    ]
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))


#: Built-in meshes, of 1 m, centred.
SHAPES = {"box": _box, "sphere": _sphere, "cylinder": _cylinder}
