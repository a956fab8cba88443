"""A scene at one stamp.

During an exposure, joints, objects and cameras move at the velocities that they have at the stamp. Earlier
frames are not used: the scene time may have jumped since.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from humansim_ros.geometry import ObjectPose
from humansim_ros.motion.body import JointPoses
from humansim_ros.render.interface import AdjacentFrame, Body
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.camera import CameraPose, SceneCamera
from humansim_ros.scene.core.human_state import HumanState
from humansim_ros.scene.core.scene import Scene

Content = TypeVar("Content")


class OnAccess(Mapping[str, Content]):
    """Values by name, each computed on first access. ``values``: those that are known."""

    def __init__(
        self, compute: Mapping[str, Callable[[], Content]], values: dict[str, Content] | None = None
    ) -> None:
        self._compute = compute
        self._values = {} if values is None else values

    def __getitem__(self, name: str) -> Content:
        if name not in self._values:
            self._values[name] = self._compute[name]()
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._compute)

    def __len__(self) -> int:
        return len(self._compute)


@dataclass(frozen=True)
class Exposure:
    """Bodies and camera pose around one stamp.

    Attributes:
        bodies_at: Returns the bodies at a time in seconds after the stamp.
        pose_at: Returns the camera pose at that time.
        moving: Whether the camera may have another pose in the next frame.
        next_frame: The next frame, if a channel needs it.
        previous_frame: The previous frame, if a channel needs it.
    """

    bodies_at: Callable[[float], Sequence[Body]]
    pose_at: Callable[[float], CameraPose]
    moving: bool = False
    next_frame: AdjacentFrame | None = None
    previous_frame: AdjacentFrame | None = None

    def adjacent_frame(self, camera: SceneCamera) -> AdjacentFrame:
        """Bodies and camera of this exposure, for use as the next or previous frame of another rendering."""
        return AdjacentFrame(self.bodies_at(0.0), camera.camera_at(self.pose_at(0.0)))


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneState:
    """All bodies, objects and cameras of a scene at one stamp.

    Attributes:
        stamp: Nanoseconds; 0 if the scene is not at a frame.
        scene_time: Nanoseconds from the start of the scene; the noise of sensors depends on it.
        scene: The scene.
        actors: Humans by name.
        humans: Bodies by name; empty in the motion player, which computes none.
        motions: Joints of the motions (N = 1) by human; empty in nodes that receive bodies.
        vertices: (V, 3) float32 in ``map`` by human, if they are known before the other values of ``humans``.
        objects: Poses of moving objects by name.
        cameras: Poses of moving cameras by name.
        robot: Pose of the robot's ``base_link``, without vibration; None without a robot.
        index: Number of the frame, by which cameras with a rate of their own take their pictures.
        is_preview: It is shown while no frame arrives, and is no frame itself: no flow leads to it.
    """

    stamp: int = 0
    scene_time: int
    scene: Scene
    actors: Mapping[str, Actor]
    humans: Mapping[str, HumanState] = field(default_factory=dict)
    motions: Mapping[str, JointPoses] = field(default_factory=dict)
    vertices: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    objects: Mapping[str, ObjectPose] = field(default_factory=dict)
    cameras: Mapping[str, CameraPose] = field(default_factory=dict)
    robot: ObjectPose | None = None
    index: int = 0
    is_preview: bool = False
    _moved: dict[float, Sequence[Body]] = field(init=False, default_factory=dict)

    @property
    def poses(self) -> Mapping[str, JointPoses]:
        """Former name of ``motions``."""
        warnings.warn("poses is deprecated: use motions", DeprecationWarning, stacklevel=2)
        return self.motions

    @cached_property
    def bodies(self) -> Sequence[Body]:
        """Humans, moving objects, then static bodies."""
        bodies = [
            actor.body(self.vertices[name] if name in self.vertices else self.humans[name].vertices)
            for name, actor in self.actors.items()
        ]
        bodies += [item.body(self.objects[name]) for name, item in self.scene.moving_objects.items()]
        return bodies + self.scene.static_bodies

    def exposure(self, camera: SceneCamera) -> Exposure:
        """Bodies and camera pose around the stamp."""
        moving = camera.moves or camera.drifts
        return Exposure(self._bodies_at, lambda seconds: self._pose_at(camera, seconds), moving)

    def calibrated_pose(self, camera: SceneCamera) -> CameraPose:
        """Pose at the stamp that the scene gives a camera; a camera that drifts has another."""
        return self.cameras.get(camera.name, CameraPose.of(camera.camera))

    def _bodies_at(self, seconds: float) -> Sequence[Body]:
        """Bodies ``seconds`` after the stamp, cached for cameras with the same exposure."""
        if seconds == 0:
            return self.bodies
        if seconds not in self._moved:
            self._moved[seconds] = self._bodies_moved(seconds)
        return self._moved[seconds]

    def _bodies_moved(self, seconds: float) -> Sequence[Body]:
        bodies = [actor.body(actor.moved(self.humans[name], seconds)) for name, actor in self.actors.items()]
        for name, item in self.scene.moving_objects.items():
            bodies.append(item.body(self.objects[name].moved(seconds)))
        return bodies + self.scene.static_bodies

    def _pose_at(self, camera: SceneCamera, seconds: float) -> CameraPose:
        pose = self.calibrated_pose(camera).moved(seconds)
        return camera.true_pose(pose, self.scene_time * 1e-9 + seconds)
