"""State of a scene at one stamp: all bodies, objects and cameras, extrapolated during an exposure.

During an exposure, joints, objects and cameras move at the velocities that they have at the stamp. Earlier
frames are not used: the scene time may have jumped since.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render import Body, View
from humansim_ros.scene.actor import Actor
from humansim_ros.scene.camera import CameraPose, SceneCamera
from humansim_ros.scene.capture import Exposure
from humansim_ros.scene.objects import ObjectPose
from humansim_ros.scene.scene import Scene
from humansim_ros.truth import CameraTruth
from humansim_ros.types import Array


@dataclass(frozen=True)
class JointMotion:
    """Joints of a human in ``map``: poses (J, 4, 4), velocities (J, 3) in m/s and rad/s or None."""

    joints: Array
    linear: Array | None
    angular: Array | None

    @property
    def positions(self) -> Array:
        """(J, 3) metres."""
        return self.joints[:, :3, 3]


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneState:
    """All bodies, objects and cameras of a scene at one stamp.

    Attributes:
        stamp: Nanoseconds.
        scene_time: Nanoseconds from the start of the scene; the noise of sensors depends on it.
        scene: The scene.
        actors: Humans by name.
        vertices: (V, 3) float32 in ``map`` by human.
        joints_of: Returns the joints of a human by name; called only if they are needed.
        objects: Poses of moving objects by name.
        cameras: Poses of moving cameras by name.
        is_preview: It is shown while no frame arrives, and is no frame itself: no flow leads to it.
    """

    stamp: int
    scene_time: int
    scene: Scene
    actors: Mapping[str, Actor]
    vertices: Mapping[str, NDArray[np.float32]]
    joints_of: Callable[[str], JointMotion]
    objects: Mapping[str, ObjectPose]
    cameras: Mapping[str, CameraPose] = field(default_factory=dict)
    is_preview: bool = False
    _moved: dict[float, Sequence[Body]] = field(init=False, default_factory=dict)

    @cached_property
    def bodies(self) -> Sequence[Body]:
        """Humans, moving objects, then static bodies."""
        bodies = [actor.body(self.vertices[name]) for name, actor in self.actors.items()]
        bodies += [item.body(self.objects[name]) for name, item in self.scene.moving_objects.items()]
        return bodies + self.scene.static_bodies

    def exposure(self, camera: SceneCamera) -> Exposure:
        """Bodies and camera pose around the stamp."""
        moving = camera.moves or camera.drifts
        return Exposure(self._bodies_at, lambda seconds: self._pose_at(camera, seconds), moving)

    def calibrated_pose(self, camera: SceneCamera) -> CameraPose:
        """Pose at the stamp that the scene gives a camera; a camera that drifts has another."""
        return self.cameras.get(camera.name, CameraPose.of(camera.camera))

    def camera_truth(self, camera: Camera, view: View) -> CameraTruth:
        """Ground truth of a view of this state. ``camera``: with its pose at the stamp."""
        joints_of = self.joints_of  # not self: frames that are stored would hold the bodies of exposures
        return CameraTruth(
            camera,
            view,
            self.bodies,
            labels=self.scene.labels,
            joint_surfaces=self.scene.joint_surfaces,
            joint_positions=lambda name: joints_of(name).positions,
            humans={name: actor.human for name, actor in self.actors.items()},
        )

    def _bodies_at(self, seconds: float) -> Sequence[Body]:
        """Bodies ``seconds`` after the stamp, cached for cameras with the same exposure."""
        if seconds == 0:
            return self.bodies
        if seconds not in self._moved:
            self._moved[seconds] = self._bodies_moved(seconds)
        return self._moved[seconds]

    def _bodies_moved(self, seconds: float) -> Sequence[Body]:
        bodies = [actor.body(self._vertices_at(name, seconds)) for name, actor in self.actors.items()]
        for name, item in self.scene.moving_objects.items():
            bodies.append(item.body(self.objects[name].moved(seconds)))
        return bodies + self.scene.static_bodies

    def _vertices_at(self, name: str, seconds: float) -> NDArray[np.float32]:
        motion = self.joints_of(name)
        if motion.linear is None or motion.angular is None:
            return self.vertices[name]
        return self.actors[name].moved(motion.joints, motion.linear, motion.angular, seconds)

    def _pose_at(self, camera: SceneCamera, seconds: float) -> CameraPose:
        pose = self.calibrated_pose(camera).moved(seconds)
        return camera.true_pose(pose, self.scene_time * 1e-9 + seconds)
