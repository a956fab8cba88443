"""Findings of the checks of a scene, and the poses at which scenes are checked."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from humansim_ros.scene.config import LIVE
from humansim_ros.scene.scene import Scene
from humansim_ros.types import Array

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

    def located(self, scene: Scene) -> Finding:
        """The same finding with the file of the scene and the line of the key."""
        path = None if scene.path is None else str(scene.path)
        return replace(self, path=path, line=scene.source.line(self.key))

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
    """

    scene: Scene
    step: float
    poses: int
    humans: int = 10_000

    @property
    def duration(self) -> float:
        """Seconds that are checked: a minute, or a longer cycle of a motion or trajectory."""
        cycles = [actor.motion.duration for actor in self.scene.actors.values()]
        cycles += [
            camera.path.duration / camera.speed
            for camera in self.scene.scene_cameras.values()
            if camera.path is not None and camera.speed
        ]
        finite = [cycle for cycle in cycles if np.isfinite(cycle)]
        return float(np.clip(max(finite, default=0.0), _SHORTEST, _LONGEST))

    @cached_property
    def times(self) -> Array:
        """Scene times (N,) in seconds."""
        most = max(4, self.poses // max(1, min(len(self.scene.actors), self.humans)))
        return np.linspace(0, self.duration, min(most, 1 + round(self.duration / self.step)))

    @cached_property
    def joints(self) -> dict[str, Array]:
        """Joint positions (N, J, 3) in ``map`` by human, without those that another node moves."""
        humans = self.scene.config.humans
        names = [name for name in self.scene.actors if humans[name].motion.file != LIVE]
        return {name: self.scene.actors[name].joint_paths(self.times) for name in names[: self.humans]}

    @cached_property
    def camera_poses(self) -> dict[str, tuple[Array, Array]]:
        """Extrinsics R (N, 3, 3) and t (N, 3) by camera; N is 1 for a camera that does not move."""
        poses = {}
        for name, camera in self.scene.scene_cameras.items():
            if camera.path is None:
                poses[name] = camera.camera.R[None], camera.camera.t[None]
            else:
                pairs = [camera.path.pose(camera.speed * (t + camera.offset)) for t in self.times.tolist()]
                poses[name] = np.array([r for r, _ in pairs]), np.array([t for _, t in pairs])
        return poses

    def centers(self, name: str) -> Array:
        """Centres (N, 3) of a camera; N is 1 for a camera that does not move."""
        rotations, translations = self.camera_poses[name]
        return -np.einsum("nji,nj->ni", rotations, translations)

    @cached_property
    def middle(self) -> Array:
        """Middle (3,) of all humans at all times; one metre above the origin without humans."""
        if not self.joints:
            return np.array([0.0, 0.0, 1.0])
        return np.asarray(np.mean([joints.mean(axis=(0, 1)) for joints in self.joints.values()], axis=0))


def numbers(values: Iterable[float], digits: int = 2) -> str:
    """Numbers as a list in a scene file, such as ``[3.1, 0, 2.2]``."""
    return "[" + ", ".join(f"{round(float(value), digits) + 0.0:g}" for value in values) + "]"
