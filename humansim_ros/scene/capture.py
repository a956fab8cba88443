"""Capture a view: render what a camera sees during its exposure, and apply its sensor."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from humansim_ros.render import AdjacentFrame, Body, Renderer, View
from humansim_ros.scene.camera import CameraPose, SceneCamera


@dataclass(frozen=True)
class Exposure:
    """All there is to be seen around one instant. ``bodies_at``: as they stand so many seconds after it;
    ``pose_at``: where the camera is then. ``moving``: whether the camera may be elsewhere in the next frame.
    ``after``, ``before``: the next and the previous frame, where channels need them.
    """

    bodies_at: Callable[[float], Sequence[Body]]
    pose_at: Callable[[float], CameraPose]
    moving: bool = False
    next_frame: AdjacentFrame | None = None
    previous_frame: AdjacentFrame | None = None

    def neighbour(self, camera: SceneCamera) -> AdjacentFrame:
        """Its instant as one that another frame is compared with."""
        return AdjacentFrame(self.bodies_at(0.0), camera.at(self.pose_at(0.0)))


def capture(
    renderer: Renderer, camera: SceneCamera, shot: Exposure, channels: Collection[str], stamp: int
) -> View:
    """What a camera sees of a shot: the truth of its instant, the middle of the exposure, and the picture
    that the sensor makes. ``stamp``: nanoseconds; the sensor's noise depends on it.
    """
    times = camera.sensor.times() if "rgb" in channels else np.zeros(1)
    at_once = len(times) == 1
    here, bodies = camera.at(shot.pose_at(0.0)), shot.bodies_at(0.0)
    drawn = [channel for channel in channels if at_once or channel != "rgb"]
    view = View()
    if drawn:
        view = renderer.render(
            bodies, here, drawn, shot.moving, shot.next_frame, shot.previous_frame, camera.backdrop
        )
    if "rgb" not in channels or not camera.sensor.active:
        return view
    if at_once:
        assert view.rgb is not None
        return replace(view, rgb=camera.sensor.expose([view.rgb], stamp))

    def pictures() -> Iterator[NDArray[np.uint8]]:
        for time in times.tolist():
            there = camera.at(shot.pose_at(time))
            seen = renderer.render(
                shot.bodies_at(time), there, ("rgb",), moving_camera=shot.moving, backdrop=camera.backdrop
            )
            assert seen.rgb is not None
            yield seen.rgb

    return replace(view, rgb=camera.sensor.expose(pictures(), stamp))
