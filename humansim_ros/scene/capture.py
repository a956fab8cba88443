"""State of a scene at one stamp, and the capture of a view: render an exposure, and apply the sensor.

During an exposure, joints, objects and cameras move at the velocities that they have at the stamp. Earlier
frames are not used: the scene time may have jumped since.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.face_actions import FaceState
from humansim_ros.body.loose import SwingState
from humansim_ros.camera import Camera
from humansim_ros.geometry import ObjectPose
from humansim_ros.render import AdjacentFrame, Body, Renderer, RenderRequest, View
from humansim_ros.render.pixel_geometry import pixel_rays
from humansim_ros.scene.actor import Actor
from humansim_ros.scene.camera import CameraPose, SceneCamera
from humansim_ros.scene.faults import NO_FAULTS, FrameFaults
from humansim_ros.scene.scene import Scene
from humansim_ros.sensor import DepthSensor
from humansim_ros.sensor.depth import Millimetres, aligned, metres, points_of
from humansim_ros.truth import CameraTruth
from humansim_ros.types import Array, Float32Array, Image


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
        """Bodies and camera at the stamp, as the adjacent frame of another frame."""
        return AdjacentFrame(self.bodies_at(0.0), camera.camera_at(self.pose_at(0.0)))


def capture(
    renderer: Renderer,
    camera: SceneCamera,
    exposure: Exposure,
    channels: Collection[str],
    scene_time: int,
    faults: FrameFaults = NO_FAULTS,
    frozen: Image | None = None,
) -> View:
    """Render what a camera sees during its exposure, and apply its sensor to rgb.

    Args:
        renderer: Renderer of the scene.
        camera: The camera with its sensor.
        exposure: Bodies and camera pose around the stamp, which is the middle of the exposure time.
        channels: Names of the channels. All but rgb show the scene at the stamp.
        scene_time: Nanoseconds; the sensor's noise depends on it.
        faults: Faults of the picture. Channels other than rgb have none.
        frozen: Colours of an earlier frame that the camera shows in place of its own.
    """
    request = request_at_stamp(camera, exposure, channels, faults, frozen)
    view = View()
    if request is not None:
        view = renderer.render(
            request.bodies,
            request.camera,
            request.channels,
            request.moving_camera,
            request.next_frame,
            request.previous_frame,
            request.backdrop,
        )
    if frozen is not None:
        return view.with_channels(rgb=frozen)
    if "rgb" not in channels:
        return view
    times = _samples(camera, faults)
    single = not times.any()
    light = None if faults is NO_FAULTS else camera.light(scene_time, faults)
    if single and not camera.sensor.active and light is None:
        return view
    if single:
        return view.with_channels(rgb=camera.sensor.expose([view.rgb], scene_time, light))

    def images() -> Iterator[Image]:
        for time in times.tolist():
            sample = renderer.render(
                exposure.bodies_at(time),
                camera.camera_at(exposure.pose_at(time)),
                ("rgb",),
                moving_camera=exposure.moving,
                backdrop=camera.backdrop,
            )
            yield sample.rgb

    return view.with_channels(rgb=camera.sensor.expose(images(), scene_time, light))


def request_at_stamp(
    camera: SceneCamera,
    exposure: Exposure,
    channels: Collection[str],
    faults: FrameFaults = NO_FAULTS,
    frozen: Image | None = None,
) -> RenderRequest | None:
    """What :func:`capture` renders first: the bodies at the stamp; None if it renders only others.

    Args:
        camera: The camera with its sensor.
        exposure: Bodies and camera pose around the stamp.
        channels: Names of the channels.
        faults: Faults of the picture.
        frozen: Colours of an earlier frame that the camera shows in place of its own.
    """
    coloured = frozen is None and not _samples(camera, faults).any()
    rendered = [channel for channel in channels if coloured or channel != "rgb"]
    if not rendered:
        return None
    return RenderRequest(
        exposure.bodies_at(0.0),
        camera.camera_at(exposure.pose_at(0.0)),
        rendered,
        exposure.moving,
        exposure.next_frame,
        exposure.previous_frame,
        camera.backdrop,
    )


def _samples(camera: SceneCamera, faults: FrameFaults) -> Array:
    """Times (N,) of the images whose mean is rgb, seconds after the stamp."""
    return camera.sensor.times() + faults.trigger_delay


def capture_rectified_depth(renderer: Renderer, camera: SceneCamera, exposure: Exposure) -> Float32Array:
    """Depth (H, W) in metres along the axis of the camera of ``image_rect``, at the stamp.

    It is rendered with that camera: depth that is interpolated from another image is wrong at edges, and the
    depth of the nearest pixel on surfaces that are seen at an angle. NaN where ``image_raw`` has no pixel.
    """
    pose = exposure.pose_at(0.0)
    seen = camera.rectified_at(pose)
    depth = renderer.render(exposure.bodies_at(0.0), seen, ("depth",), exposure.moving).depth
    return depth if camera.rectified is None else camera.rectified.without_border(depth)


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


def capture_depth(
    renderer: Renderer, camera: SceneCamera, sensor: DepthSensor, exposure: Exposure, scene_time: int
) -> DepthCapture:
    """Render what the depth sensor of a camera sees at the stamp, and measure it.

    Args:
        renderer: Renderer of the scene.
        camera: The camera.
        sensor: Its depth sensor.
        exposure: Bodies and camera pose around the stamp.
        scene_time: Nanoseconds; the errors depend on it.
    """
    bodies, pose = exposure.bodies_at(0.0), exposure.pose_at(0.0)
    own = sensor.camera_at(pose.R, pose.t)
    channels = ("rgb", "depth") if sensor.needs_light else ("depth",)
    view = renderer.render(bodies, own, channels, exposure.moving)
    other = sensor.second_camera(own)
    second = None if other is None else renderer.render(bodies, other, ("depth",), exposure.moving).depth
    colours = view.rgb if sensor.needs_light else None
    measured = sensor.measure(view.depth, scene_time, second, colours)
    return DepthCapture(own, view.depth, measured, camera.camera_at(pose))


@dataclass(frozen=True)
class JointMotion:
    """Joints of a human in ``map``: poses (J, 4, 4), velocities (J, 3) in m/s and rad/s or None.

    ``face``: its face, if it moves. ``swing``: swing of its loose cloth and hair, if it has any.
    """

    joints: Array
    linear: Array | None
    angular: Array | None
    face: FaceState | None = None
    swing: SwingState | None = None

    @property
    def positions(self) -> Array:
        """(J, 3) metres."""
        return self.joints[:, :3, 3]


@dataclass(frozen=True)
class CameraFrame:
    """A camera at a stamp: the camera at its true pose, its images, and their ground truth."""

    camera: Camera
    view: View
    truth: CameraTruth


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
        index: Number of the frame, by which cameras with a rate of their own take their pictures.
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
    index: int = 0
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

    def camera_frame(
        self,
        renderer: Renderer,
        camera: SceneCamera,
        exposure: Exposure,
        channels: Collection[str],
        faults: FrameFaults = NO_FAULTS,
        frozen: Image | None = None,
    ) -> CameraFrame:
        """Render a camera, and put the ground truth beside its images.

        Args:
            renderer: Renderer of the scene.
            camera: The camera with its sensor.
            exposure: See :meth:`exposure`; with adjacent frames for channels that need them.
            channels: Names of the channels.
            faults: Faults of the picture.
            frozen: Colours of an earlier frame that the camera shows in place of its own.
        """
        view = capture(renderer, camera, exposure, channels, self.scene_time, faults, frozen)
        posed = camera.camera_at(exposure.pose_at(0.0))
        return CameraFrame(posed, view, self._camera_truth(posed, view))

    def _camera_truth(self, camera: Camera, view: View) -> CameraTruth:
        """Ground truth of a view of this state. ``camera``: with its pose at the stamp."""
        return CameraTruth(
            camera,
            view,
            self.bodies,
            labels=self.scene.labels,
            joint_surfaces=self.scene.joint_surfaces,
            # not a method of self: frames that are stored would hold the bodies of exposures
            joint_positions=partial(_joint_positions, self.joints_of),
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
        return self.actors[name].moved(
            *(motion.joints, motion.linear, motion.angular, seconds, motion.face, motion.swing)
        )

    def _pose_at(self, camera: SceneCamera, seconds: float) -> CameraPose:
        pose = self.calibrated_pose(camera).moved(seconds)
        return camera.true_pose(pose, self.scene_time * 1e-9 + seconds)


def _joint_positions(joints_of: Callable[[str], JointMotion], name: str) -> Array:
    return joints_of(name).positions
