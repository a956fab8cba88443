"""Capture a view: render what a camera sees during its exposure, and apply its sensor."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from humansim_ros.render import AdjacentFrame, Body, Renderer, View
from humansim_ros.scene.camera import CameraPose, SceneCamera
from humansim_ros.scene.faults import NO_FAULTS, FrameFaults
from humansim_ros.types import Float32Array, Image


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
) -> View:
    """Render what a camera sees during its exposure, and apply its sensor to rgb.

    Args:
        renderer: Renderer of the scene.
        camera: The camera with its sensor.
        exposure: Bodies and camera pose around the stamp, which is the middle of the exposure time.
        channels: Names of the channels. All but rgb show the scene at the stamp.
        scene_time: Nanoseconds; the sensor's noise depends on it.
        faults: Faults of the picture. Channels other than rgb have none.
    """
    times = camera.sensor.times() + faults.trigger_delay if "rgb" in channels else np.zeros(1)
    single = not times.any()
    rendered = [channel for channel in channels if single or channel != "rgb"]
    view = View()
    if rendered:
        view = renderer.render(
            exposure.bodies_at(0.0),
            camera.camera_at(exposure.pose_at(0.0)),
            rendered,
            exposure.moving,
            exposure.next_frame,
            exposure.previous_frame,
            camera.backdrop,
        )
    if "rgb" not in channels:
        return view
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


def capture_rectified_depth(renderer: Renderer, camera: SceneCamera, exposure: Exposure) -> Float32Array:
    """Depth (H, W) in metres along the axis of the camera of ``image_rect``, at the stamp.

    It is rendered with that camera: depth that is interpolated from another image is wrong at edges, and the
    depth of the nearest pixel on surfaces that are seen at an angle. NaN where ``image_raw`` has no pixel.
    """
    pose = exposure.pose_at(0.0)
    seen = camera.rectified_at(pose)
    depth = renderer.render(exposure.bodies_at(0.0), seen, ("depth",), exposure.moving).depth
    return depth if camera.rectified is None else camera.rectified.without_border(depth)
