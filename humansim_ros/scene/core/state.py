"""A scene at one stamp, and what its cameras capture of it.

During an exposure, joints, objects and cameras move at the velocities that they have at the stamp. Earlier
frames are not used: the scene time may have jumped since.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.cameras.sensor import DepthSensor, Millimetres, aligned, metres, points_of
from humansim_ros.geometry import ObjectPose
from humansim_ros.motion.body import JointPoses
from humansim_ros.render.device import pixel_rays
from humansim_ros.render.interface import AdjacentFrame, Body, Renderer, RenderRequest, View
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.camera import CameraPose, SceneCamera
from humansim_ros.scene.core.faults import NO_FAULTS, FrameFaults
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.truth.camera_truth import CameraTruth
from humansim_ros.scene.truth.human_state import HumanState
from humansim_ros.types import Array, Float32Array, Image

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
        is_preview: Whether it is shown while no frame arrives. It is no frame: no flow leads to it.
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

    def shot(self, camera: SceneCamera, channels: Collection[str] = ()) -> CameraShot:
        """What a camera is to take at the stamp: the named channels, without faults."""
        moving = camera.moves or camera.drifts
        return CameraShot(self, camera, partial(self._pose_at, camera), moving, channels)

    def calibrated_pose(self, camera: SceneCamera) -> CameraPose:
        """Pose at the stamp that the scene gives a camera. A camera that drifts has another pose."""
        return self.cameras.get(camera.name, CameraPose.of(camera.camera))

    def bodies_at(self, seconds: float) -> Sequence[Body]:
        """Bodies ``seconds`` after the stamp, cached for cameras with the same exposure."""
        if seconds == 0:
            return self.bodies
        if seconds not in self._moved:
            bodies = [
                actor.body(actor.moved(self.humans[name], seconds)) for name, actor in self.actors.items()
            ]
            for name, item in self.scene.moving_objects.items():
                bodies.append(item.body(self.objects[name].moved(seconds)))
            self._moved[seconds] = bodies + self.scene.static_bodies
        return self._moved[seconds]

    def _pose_at(self, camera: SceneCamera, seconds: float) -> CameraPose:
        pose = self.calibrated_pose(camera).moved(seconds)
        return camera.true_pose(pose, self.scene_time * 1e-9 + seconds)


@dataclass(frozen=True, eq=False)
class DepthCapture:
    """What the depth sensor of a camera sees and measures at a stamp.

    Attributes:
        camera: Camera of the depth image at its true pose.
        exact: (h, w) metres, as the channel ``depth`` of that camera; inf where nothing is.
        measured: (h, w) millimetres; 0 where nothing is measured.
        color: Camera of ``image_raw``.
    """

    camera: Camera
    exact: Float32Array
    measured: Millimetres
    color: Camera

    @property
    def depth(self) -> Float32Array:
        """Measured depth (h, w) in metres; NaN where nothing is measured."""
        return metres(self.measured)

    @property
    def points(self) -> Float32Array:
        """Measured points (h, w, 3) in the optical frame of the sensor, metres; NaN without depth."""
        return points_of(self.depth, pixel_rays(self.camera))

    @cached_property
    def aligned(self) -> Millimetres:
        """Measured depth (H, W) in the pixels of ``image_raw``, millimetres along its axis; 0 without."""
        return aligned(self.measured, pixel_rays(self.camera), self.camera, self.color)

    @property
    def color_points(self) -> Float32Array:
        """Points (H, W, 3) of the pixels of ``image_raw`` in its optical frame, metres; NaN without depth."""
        return points_of(metres(self.aligned), pixel_rays(self.color))


@dataclass(frozen=True, eq=False)
class CameraShot:
    """What a camera is to take at a stamp, which is the middle of the exposure time.

    Attributes:
        state: The scene at the stamp.
        camera: The camera with its sensor.
        pose_at: Returns the camera pose at a time in seconds after the stamp.
        moving: Whether the camera may have another pose in the next frame.
        channels: Names of the channels. All but rgb show the scene at the stamp.
        faults: Faults of the picture. Channels other than rgb have none.
        frozen: Colours of an earlier frame that the camera shows in place of its own.
        next_frame: The next frame, if a channel needs it.
        previous_frame: The previous frame, if a channel needs it.
    """

    state: SceneState
    camera: SceneCamera
    pose_at: Callable[[float], CameraPose]
    moving: bool
    channels: Collection[str] = ()
    faults: FrameFaults = NO_FAULTS
    frozen: Image | None = None
    next_frame: AdjacentFrame | None = None
    previous_frame: AdjacentFrame | None = None

    @cached_property
    def posed(self) -> Camera:
        """The camera at its pose at the stamp."""
        return self.camera.camera_at(self.pose_at(0.0))

    @property
    def adjacent_frame(self) -> AdjacentFrame:
        """Bodies and camera at the stamp, for use as the next or previous frame of another shot."""
        return AdjacentFrame(self.state.bodies, self.posed)

    def take(self, renderer: Renderer) -> View:
        """Render what the camera sees during its exposure, and apply its sensor to rgb. ``renderer``:
        renderer of the scene."""
        coloured = self.frozen is None and not self._times.any()
        view, rendered = View(), [channel for channel in self.channels if coloured or channel != "rgb"]
        if rendered:
            around = self.next_frame, self.previous_frame
            backdrop = self.camera.backdrop
            view = renderer.render(
                RenderRequest(self.state.bodies, self.posed, rendered, self.moving, *around, backdrop)
            )
        if self.frozen is not None:
            return view.with_channels(rgb=self.frozen)
        if "rgb" not in self.channels:
            return view
        camera, times, scene_time = self.camera, self._times, self.state.scene_time
        light = None if self.faults is NO_FAULTS else camera.light(scene_time, self.faults)
        if not times.any() and not camera.sensor.active and light is None:
            return view
        images = self._colours(renderer, times.tolist()) if times.any() else [view.rgb]
        return view.with_channels(rgb=camera.sensor.expose(images, scene_time, light))

    @cached_property
    def _times(self) -> Array:
        """Times (N,) of the images that rgb is the mean of, seconds after the stamp."""
        return self.camera.sensor.times() + self.faults.trigger_delay

    def _colours(self, renderer: Renderer, times: Sequence[float]) -> Iterator[Image]:
        camera = self.camera
        for time in times:
            posed = camera.camera_at(self.pose_at(time))
            bodies, backdrop = self.state.bodies_at(time), camera.backdrop
            yield renderer.render(RenderRequest(bodies, posed, ("rgb",), self.moving, backdrop=backdrop)).rgb

    def truth(self, renderer: Renderer) -> CameraTruth:
        """Render the camera. The result has the posed camera, its images, and their ground truth.
        ``renderer``: renderer of the scene."""
        state, scene = self.state, self.state.scene
        return CameraTruth(
            self.posed,
            self.take(renderer),
            state.bodies,
            labels=scene.labels,
            joint_surfaces=scene.joint_surfaces,
            # not the state: frames that are stored would hold the bodies of exposures
            joint_positions=partial(_joint_positions, state.humans),
            humans={name: actor.human for name, actor in state.actors.items()},
        )

    def rectified_depth(self, renderer: Renderer) -> Float32Array:
        """Depth (H, W) in metres along the axis of ``image_rect`` at the stamp; NaN where ``image_raw`` has
        no pixel. It is rendered, since interpolated depth would be wrong at edges."""
        camera = self.camera
        seen = camera.rectified_at(self.pose_at(0.0))
        depth = renderer.render(self.state.bodies, seen, ("depth",), self.moving).depth
        return depth if camera.rectified is None else camera.rectified.without_border(depth)

    def measured_depth(self, renderer: Renderer, sensor: DepthSensor) -> DepthCapture:
        """Render what a depth sensor of the camera sees at the stamp, and measure it."""
        bodies, pose = self.state.bodies, self.pose_at(0.0)
        own = sensor.camera_at(pose.R, pose.t)
        channels = ("rgb", "depth") if sensor.needs_light else ("depth",)
        view = renderer.render(bodies, own, channels, self.moving)
        other = sensor.second_camera(own)
        second = None if other is None else renderer.render(bodies, other, ("depth",), self.moving).depth
        colours = view.rgb if sensor.needs_light else None
        measured = sensor.measure(view.depth, self.state.scene_time, second, colours)
        return DepthCapture(own, view.depth, measured, self.posed)


def _joint_positions(humans: Mapping[str, HumanState], name: str) -> Array:
    return humans[name].positions
