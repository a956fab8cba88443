"""A scene in one process, without ROS: states of its frames, rendering, and ground truth."""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from itertools import count
from typing import Any, TypeVar

from humansim_ros.errors import SceneError, unknown
from humansim_ros.render.interface import (
    ADJACENT_NAMES,
    CHANNELS,
    AdjacentName,
    Renderer,
    comparing_with,
)
from humansim_ros.scene.config.timing import frame_at
from humansim_ros.scene.core.camera import SceneCamera
from humansim_ros.scene.core.faults import NO_FAULTS
from humansim_ros.scene.core.frame import Frame
from humansim_ros.scene.core.needs import Needs
from humansim_ros.scene.core.playback import Playback
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.core.state import SceneState
from humansim_ros.types import Image

T = TypeVar("T")

#: Pictures of a camera from the present one to each of the adjacent ones.
_DIRECTIONS = dict(zip(ADJACENT_NAMES, (1, -1), strict=True))


class SceneStates:
    """States of a scene, each computed once while frames follow each other.

    Args:
        scene: The scene.
        start: Stamp of frame 0, nanoseconds.

    Attributes:
        playback: Clock and motions, at the state that was asked for last.
    """

    def __init__(self, scene: Scene, start: int = 1) -> None:
        self.playback = Playback(scene)
        self._scene, self._start = scene, start
        #: Adjacent frames that cameras compared the last frame with.
        self._directions: dict[AdjacentName, int] = {}
        #: Makers of sweeps by scanner.
        self._scanning = {name: scanner.scanning(scene) for name, scanner in scene.scanners.items()}
        longest = max((scanner.pattern.period for scanner in scene.scanners.values()), default=0.0)
        #: Frames before the present one that sweeps need.
        self._sweep_frames = 1 + math.ceil(longest * 1e-9 / scene.period)
        #: States that are needed again, by scene time and version of the motions.
        self._kept: dict[tuple[int, int], SceneState] = {}

    def at(self, index: int) -> SceneState:
        """State of the scene at a frame. A frame that is still in the cache returns the same bodies, so that
        renderers can reuse what they computed from them."""
        elapsed = self._scene.frame_time(index)
        key = elapsed, self.playback.version
        if key in self._kept:
            self.playback.elapsed = elapsed
            return self._kept[key]
        state = self.playback.show(elapsed)
        humans = {name: actor.state(state.motions[name]) for name, actor in state.actors.items()}
        state = replace(state, stamp=self._start + elapsed, index=index, humans=humans)
        if self._scanning or self._directions:
            self._kept[key] = state
        return state

    def adjacent(
        self, index: int, steps: Collection[int], compared: Collection[AdjacentName]
    ) -> dict[int, Mapping[AdjacentName, SceneState]]:
        """States some frames after and before a frame, by step.

        Args:
            index: Number of the frame.
            steps: Numbers of frames between two pictures of a camera.
            compared: Which adjacent frames cameras compare the frame with.
        """
        self._directions = {name: _DIRECTIONS[name] for name in compared}
        self._forget(index)
        return {
            step: {name: self.at(index + sign * step) for name, sign in self._directions.items()}
            for step in steps
        }

    def sweeps(self, scanner: str, index: int) -> list[Any]:
        """Sweeps of a scanner that end after the frame before, and not after frame ``index``."""
        if index == 0:
            return []
        self._forget(index)
        scanning, frame_time = self._scanning[scanner], self._scene.frame_time
        sweeps = []
        for number in scanning.due(frame_time(index - 1), frame_time(index)):
            begin = scanning.scanner.pattern.start(number)
            first = frame_at(begin, self._scene.config.rate)
            first -= frame_time(first) > begin
            states = [self.at(each) for each in range(first, index + 1)]
            sweeps.append(scanning.sweep(number, states, self._start))
        return sweeps

    def _forget(self, index: int) -> None:
        """Forget the states that frames from frame ``index`` on do not need, if they follow each other."""
        if not self._kept:
            return
        frames = set(range(index - self._sweep_frames, index + 1)) if self._scanning else set()
        for timing in {camera.timing for camera in self._scene.scene_cameras.values()}:
            number = timing.number(index)
            frames |= {timing.frame(number + each) for each in (0, *self._directions.values())}
        needed = {(self._scene.frame_time(frame), self.playback.version) for frame in frames}
        self._kept = {key: state for key, state in self._kept.items() if key in needed}


class Simulation:
    """Play a scene: iterate over its frames without end, or get :meth:`frames` or one :meth:`frame`.

    The same scene gives the same frames. Use it in a ``with`` statement, or call :meth:`close`, to free the
    renderer; else it is freed some time after the last reference to it. A simulation belongs to the thread
    that makes it (docs/scene.md, "Threads and worker processes").

    Args:
        scene: The scene.
        channels: Names of the channels that the cameras render (docs/ground_truth.md). Joints need ``depth``,
            ``instance`` and ``part``; boxes need ``instance`` and ``amodal``.
        start: Stamp of frame 0, nanoseconds.
        renderer: Renderer to use; a new one (moderngl needs EGL) if None.

    Attributes:
        channels: Names of the channels.
        playback: Clock and motions. ``simulation.playback.change("anna", speed=0.5)`` changes a motion after
            the frame that was shown last, as the parameters of the motion player do.

    Example:
        >>> with Simulation(Scene.load(), channels=("rgb", "depth")) as simulation:  # doctest: +SKIP
        ...     for frame in simulation.frames(2):
        ...         print(frame.stamp, frame.views["camera_1"])
        1 View(640x480: rgb, depth)
        33333334 View(640x480: rgb, depth)
    """

    def __init__(
        self,
        scene: Scene,
        channels: Collection[str] = CHANNELS,
        start: int = 1,
        renderer: Renderer | None = None,
    ) -> None:
        self.scene = scene
        self.channels: tuple[str, ...] = (channels,) if isinstance(channels, str) else tuple(channels)
        self._needs = Needs(self.channels, scanners=None)
        self.start = start
        self._states = SceneStates(scene, start)
        self.playback = self._states.playback
        self.renderer: Renderer = renderer or scene.make_renderer()

    def __repr__(self) -> str:
        return f"Simulation({self.scene!r}, channels={self.channels})"

    def __iter__(self) -> Iterator[Frame]:
        return (self.frame(index) for index in count())

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def frames(self, count: int) -> Iterator[Frame]:
        """The first ``count`` frames, one after the other."""
        return (self.frame(index) for index in range(count))

    def frame(self, index: int, needs: Needs | None = None, **former: Any) -> Frame:
        """Frame ``index``. Its stamp is ``start + round(index * period)``.

        Args:
            index: Number of the frame, from 0.
            needs: What the frame must have. If None, the channels of the simulation for all cameras, and all
                laser scanners. Cameras with a rate of their own are rendered only in their frames.
            former: Deprecated arguments ``cameras``, ``rectified_depth`` and ``scanners``.

        Raises:
            SceneError: There is no camera or scanner of a name.
            RenderError: The simulation belongs to another thread, or to the process that this one was forked
                from, or has been closed; or OpenGL failed.
        """
        self.renderer.check_usable()  # before playback is set to the frame, which another thread may be using
        if needs is None and not former:
            needs = self._needs
        elif not isinstance(needs, Needs):
            needs = self._former_needs(**{"cameras": needs, **former})
        channels = needs.ordered_channels
        asked = _chosen("camera", self.scene.scene_cameras, needs.cameras)
        chosen = {name: camera for name, camera in asked.items() if index in camera.timing}
        steps = {camera.timing.step for camera in chosen.values()}
        compared = [name for name in ADJACENT_NAMES if comparing_with(name, channels)]
        adjacent = self._states.adjacent(index, steps, compared)
        faults = {name: camera.faults.at(index) for name, camera in chosen.items() if camera.faults}
        frozen = {
            name: self._frozen(camera, camera.faults.pictured(index))
            for name, camera in chosen.items()
            if camera.faults and faults[name].picture and "rgb" in channels
        }
        swept = _chosen("scanner", self.scene.scanners, needs.scanners)
        sweeps = {name: self._states.sweeps(name, index) for name in swept}
        state = self._states.at(index)
        shots = {}
        for name, camera in chosen.items():
            others = adjacent[camera.timing.step].items()
            around = {frame: other.shot(camera).adjacent_frame for frame, other in others}
            shots[name] = replace(
                state.shot(camera, channels),
                faults=faults.get(name, NO_FAULTS),
                frozen=frozen.get(name),
                next_frame=around.get("next_frame"),
                previous_frame=around.get("previous_frame"),
            )
        frame = Frame.captured(state, shots, needs, self.renderer)
        published = {
            name: camera.published_at(state.calibrated_pose(camera)) for name, camera in asked.items()
        }
        return replace(frame, published_cameras=published, sweeps=sweeps)

    def _former_needs(
        self, cameras: Any = None, rectified_depth: Collection[str] = (), scanners: Any = None
    ) -> Needs:
        """Needs of deprecated arguments."""
        text = "cameras, rectified_depth and scanners of Simulation.frame are deprecated: give Needs"
        warnings.warn(f"{text}; 0.4.0 removes them", DeprecationWarning, stacklevel=3)
        return Needs(self.channels, cameras, scanners, rectified_depth)

    def close(self) -> None:
        """Free the renderer."""
        self.renderer.close()

    def _frozen(self, camera: SceneCamera, index: int) -> Image:
        """Image of an earlier frame, at which a camera has frozen."""
        state = self._states.at(index)
        faults = NO_FAULTS if camera.faults is None else camera.faults.at(index)
        return replace(state.shot(camera, ("rgb",)), faults=faults).take(self.renderer).rgb


def _chosen(kind: str, known: Mapping[str, T], names: Collection[str] | None) -> dict[str, T]:
    """Cameras or scanners of some names, all if None. Raises SceneError for a name that is not known."""
    if missing := set(names or ()) - known.keys():
        raise SceneError(unknown(kind, min(missing), known))
    return {name: each for name, each in known.items() if names is None or name in names}
