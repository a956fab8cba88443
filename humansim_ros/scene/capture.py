"""Capture of a view: render an exposure, and apply the sensor."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial

from humansim_ros.camera import Camera
from humansim_ros.render import Renderer, RenderRequest, View
from humansim_ros.render.pixel_geometry import pixel_rays
from humansim_ros.scene.camera import SceneCamera
from humansim_ros.scene.faults import NO_FAULTS, FrameFaults
from humansim_ros.scene.human_state import HumanState
from humansim_ros.scene.state import Exposure, SceneState
from humansim_ros.sensor import DepthSensor
from humansim_ros.sensor.depth import Millimetres, aligned, metres, points_of
from humansim_ros.truth import CameraTruth
from humansim_ros.types import Array, Float32Array, Image


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


def observe(
    state: SceneState,
    renderer: Renderer,
    camera: SceneCamera,
    exposure: Exposure,
    channels: Collection[str],
    faults: FrameFaults = NO_FAULTS,
    frozen: Image | None = None,
) -> CameraTruth:
    """Render a camera of a state. The result has the posed camera, its images, and their ground truth.

    Args:
        state: The scene at a stamp.
        renderer: Renderer of the scene.
        camera: The camera with its sensor.
        exposure: :meth:`SceneState.exposure` of the camera; with adjacent frames for channels that need them.
        channels: Names of the channels.
        faults: Faults of the picture.
        frozen: Colours of an earlier frame that the camera shows in place of its own.
    """
    scene = state.scene
    return CameraTruth(
        camera.camera_at(exposure.pose_at(0.0)),
        capture(renderer, camera, exposure, channels, state.scene_time, faults, frozen),
        state.bodies,
        labels=scene.labels,
        joint_surfaces=scene.joint_surfaces,
        # not the state: frames that are stored would hold the bodies of exposures
        joint_positions=partial(_joint_positions, state.humans),
        humans={name: actor.human for name, actor in state.actors.items()},
    )


def _joint_positions(humans: Mapping[str, HumanState], name: str) -> Array:
    return humans[name].positions
