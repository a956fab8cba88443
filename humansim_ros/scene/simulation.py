"""The whole flow in one process, without ROS: motion, skinning, rendering, ground truth."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from humansim_ros.render import CHANNELS, GLRenderer, Renderer, View
from humansim_ros.scene.objects import ObjectPose
from humansim_ros.scene.playback import Playback
from humansim_ros.scene.scene import HumanState, Scene
from humansim_ros.truth.joints import JointView, joint_surfaces, view_joints


@dataclass(frozen=True)
class Frame:
    """One instant of a scene. ``stamp``: nanoseconds. ``humans``: by name. ``views``: by camera name.

    ``joints``: by camera name and human name; empty unless instance and part are among the channels.
    ``objects``: where the objects that move are, by name.
    """

    index: int
    stamp: int
    humans: dict[str, HumanState]
    views: dict[str, View]
    joints: dict[str, dict[str, JointView]]
    objects: dict[str, ObjectPose] = field(default_factory=dict)


class Simulation:
    """Iterate over a scene's frames without end, or call :meth:`frame` for any of them.

    ``channels``: what the cameras render. ``start``: stamp of frame 0 in nanoseconds. The same scene gives
    the same frames. ``playback``: what plays; ``simulation.playback.change("anna", speed=0.5)`` changes
    it from the frame shown last on, as the parameters of the motion player do.
    """

    def __init__(
        self,
        scene: Scene,
        channels: Collection[str] = CHANNELS,
        start: int = 1,
        renderer: Renderer | None = None,
    ) -> None:
        self.scene = scene
        self.playback = Playback(scene)
        self.channels = tuple(channels)
        self.start = start
        self.renderer: Renderer = renderer or GLRenderer(scene.static_meshes)

    def __iter__(self) -> Iterator[Frame]:
        index = 0
        while True:
            yield self.frame(index)
            index += 1

    def frame(self, index: int) -> Frame:
        """Frame ``index``, at ``start + round(index * period)``."""
        elapsed = self.scene.frame_time(index)
        moment = self.playback.show(elapsed)
        actors, things, objects = self.playback.actors, self.scene.moving_objects, moment.objects
        humans = {name: actor.state(moment.poses[name]) for name, actor in actors.items()}
        bodies = [actor.body(humans[name].vertices) for name, actor in actors.items()]
        bodies += [thing.body(objects[name]) for name, thing in things.items()]
        views = {
            name: self.renderer.render(bodies, camera, self.channels)
            for name, camera in self.scene.cameras.items()
        }
        joints: dict[str, dict[str, JointView]] = {}
        if {"instance", "part"} <= set(self.channels):
            joints = {name: self._joints(name, humans, view) for name, view in views.items()}
        return Frame(index, self.start + elapsed, humans, views, joints, objects)

    def close(self) -> None:
        """Free the renderer."""
        self.renderer.close()

    @cached_property
    def _surfaces(self) -> dict[str, NDArray[np.bool_]]:
        return {name: joint_surfaces(actor.human) for name, actor in self.scene.actors.items()}

    def _joints(self, camera: str, humans: dict[str, HumanState], view: View) -> dict[str, JointView]:
        return {
            name: view_joints(
                self.scene.cameras[camera],
                state.positions,
                view,
                self.scene.actors[name].instance,
                self._surfaces[name],
            )
            for name, state in humans.items()
        }
