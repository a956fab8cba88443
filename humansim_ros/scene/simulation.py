"""The whole flow in one process, without ROS: motion, skinning, rendering, ground truth."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render import CHANNELS, Body, Renderer, View
from humansim_ros.render.channels import ADJACENT_NAMES, AdjacentName, comparing_with
from humansim_ros.scene.actor import Actor, HumanState
from humansim_ros.scene.camera import SceneCamera
from humansim_ros.scene.capture import capture
from humansim_ros.scene.objects import ObjectPose
from humansim_ros.scene.playback import Playback, ScenePoses
from humansim_ros.scene.scene import Scene
from humansim_ros.scene.state import JointMotion, SceneState
from humansim_ros.truth import BodyBox, CameraTruth, JointView

#: What there is at one time of the scene.
_Found = tuple[ScenePoses, dict[str, HumanState], SceneState]


@dataclass(frozen=True)
class Frame:
    """One instant of a scene. ``stamp``: nanoseconds. ``humans``: by name. ``views``: by camera name.

    ``truth``: by camera name; its numbers are computed on first access. ``objects``: poses of the moving
    objects by name. ``cameras``: cameras with their poses by name. ``bodies``: all bodies, humans first.
    ``labels``: instance labels by name.
    """

    index: int
    stamp: int
    humans: dict[str, HumanState]
    views: dict[str, View]
    truth: dict[str, CameraTruth] = field(default_factory=dict)
    objects: dict[str, ObjectPose] = field(default_factory=dict)
    cameras: dict[str, Camera] = field(default_factory=dict)
    bodies: Sequence[Body] = ()
    labels: Mapping[str, int] = field(default_factory=dict)

    @property
    def joints(self) -> dict[str, dict[str, JointView]]:
        """Joints by camera and human; empty unless the channels have depth, instance and part."""
        return {name: truth.joints for name, truth in self.truth.items() if truth.has("joints")}

    @property
    def boxes(self) -> dict[str, dict[str, BodyBox]]:
        """Boxes by camera, then human or labelled object; empty unless the channels have instance and
        amodal.
        """
        return {
            camera: {name: truth.boxes[name] for name in self.labels}
            for camera, truth in self.truth.items()
            if truth.has("boxes")
        }

    def visible_vertices(self, camera: str) -> dict[str, NDArray[np.bool_]]:
        """Masks (V,) of the vertices that a camera sees, by human or labelled object; the channels must have
        depth and instance.
        """
        masks = self.truth[camera].visible_vertices
        return {name: masks[name] for name in self.labels}


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
        self._recent: deque[tuple[int, tuple[Actor, ...], _Found]] = deque(maxlen=3)
        self.renderer: Renderer = renderer or scene.make_renderer()

    def __iter__(self) -> Iterator[Frame]:
        index = 0
        while True:
            yield self.frame(index)
            index += 1

    def frame(self, index: int) -> Frame:
        """Frame ``index``, at ``start + round(index * period)``."""
        elapsed = self.scene.frame_time(index)
        asked = [frame for frame in ADJACENT_NAMES if comparing_with(frame, self.channels)]
        beside = {
            which: self._at(self.scene.frame_time(index + step))[2]
            for which, step in (("next_frame", 1), ("previous_frame", -1))
            if which in asked
        }
        moment, humans, instant = self._at(elapsed)
        cameras = {
            name: camera.at(moment.cameras[name]) if camera.moves else camera.camera
            for name, camera in self.scene.scene_cameras.items()
        }
        views = {
            name: self._view(camera, instant, beside) for name, camera in self.scene.scene_cameras.items()
        }
        truth = {name: instant.camera_truth(cameras[name], view) for name, view in views.items()}
        return Frame(
            index,
            instant.stamp,
            humans,
            views,
            truth,
            moment.objects,
            cameras,
            instant.bodies,
            self.scene.labels,
        )

    def _view(
        self, camera: SceneCamera, instant: SceneState, beside: Mapping[AdjacentName, SceneState]
    ) -> View:
        """What a camera sees. ``beside``: the frames after and before, where channels need them."""
        after, before = (
            other.shot(camera).neighbour(camera) if (other := beside.get(which)) else None
            for which in ADJACENT_NAMES
        )
        shot = replace(instant.shot(camera), next_frame=after, previous_frame=before)
        return capture(self.renderer, camera, shot, self.channels, instant.stamp)

    def _at(self, elapsed: int) -> _Found:
        """All there is at a time of the scene in nanoseconds. The last few are kept: with flow, frames are
        neighbours of others, and what renderers worked out of their bodies serves again.
        """
        actors = tuple(self.playback.actors.values())
        for known, then, found in self._recent:
            if known == elapsed and all(a is b for a, b in zip(actors, then, strict=True)):
                self.playback.elapsed = elapsed
                return found
        moment = self.playback.show(elapsed)
        humans = {name: actor.state(moment.poses[name]) for name, actor in self.playback.actors.items()}
        found = moment, humans, self._instant(elapsed, humans, moment)
        if any(comparing_with(frame, self.channels) for frame in ADJACENT_NAMES):
            self._recent.append((elapsed, actors, found))
        return found

    def _instant(self, elapsed: int, humans: dict[str, HumanState], moment: ScenePoses) -> SceneState:
        def joints_of(name: str) -> JointMotion:
            return JointMotion(humans[name].joints, humans[name].linear, humans[name].angular)

        vertices = {name: state.vertices for name, state in humans.items()}
        stamp, actors = self.start + elapsed, self.playback.actors
        return SceneState(stamp, self.scene, actors, vertices, joints_of, moment.objects, moment.cameras)

    def close(self) -> None:
        """Free the renderer."""
        self.renderer.close()
