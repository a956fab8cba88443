"""States of a scene at its frames, and what laser scanners measure of them: all that needs no renderer."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from humansim_ros.render.interface import ADJACENT_NAMES, AdjacentName
from humansim_ros.scene.config.config import frame_at
from humansim_ros.scene.core.features import Feature, features_of
from humansim_ros.scene.core.playback import Playback
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.core.state import SceneState

#: Pictures of a camera from the present one to each of the adjacent ones.
_DIRECTIONS = dict(zip(ADJACENT_NAMES, (1, -1), strict=True))


class SweepMaker(Protocol):
    """What measures a scene in sweeps, which begin at times of their own: a laser scanner."""

    @property
    def period(self) -> float:
        """Nanoseconds from the begin of a sweep to the next."""

    def begin(self, number: int) -> int:
        """Scene time at which a sweep begins, nanoseconds."""

    def due(self, after: int, until: int) -> range:
        """Numbers of the sweeps that end after one scene time, and not after another, nanoseconds."""

    def sweep(self, number: int, states: Sequence[SceneState], origin: int) -> Any:
        """Make a sweep from the states around it. ``origin``: stamp of the begin of sweep 0."""


class MeasuringFeature(Feature):
    """A feature with devices that measure the scene."""

    def scanning(self, scene: Scene) -> Mapping[str, SweepMaker]:
        """What measures a scene, by name."""
        return {}


class SceneStates:
    """States of a scene, each computed once while frames follow each other.

    Args:
        scene: The scene.
        start: Stamp of frame 0, nanoseconds.
        compared: Names of the adjacent frames that cameras compare a frame with.

    Attributes:
        playback: Clock and motions, at the state that was asked for last.
    """

    def __init__(self, scene: Scene, start: int = 1, compared: Collection[AdjacentName] = ()) -> None:
        self.playback = Playback(scene)
        self._scene, self._start = scene, start
        self._directions = {name: _DIRECTIONS[name] for name in compared}
        #: What measures at times of its own, by name.
        self.scanning: Mapping[str, SweepMaker] = {
            name: scanning
            for feature in features_of(scene.config)
            if isinstance(feature, MeasuringFeature)
            for name, scanning in feature.scanning(scene).items()
        }
        longest = max((scanning.period for scanning in self.scanning.values()), default=0.0)
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
        state = replace(state, stamp=self._start + elapsed, humans=humans)
        if self.scanning or self._directions:
            self._kept[key] = state
        return state

    def adjacent(self, index: int, steps: Collection[int]) -> dict[int, Mapping[AdjacentName, SceneState]]:
        """States some frames after and before a frame, as far as cameras compare with them.

        ``steps``: numbers of frames between two pictures of a camera. The result is by step.
        """
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
        scanning, frame_time = self.scanning[scanner], self._scene.frame_time
        sweeps = []
        for number in scanning.due(frame_time(index - 1), frame_time(index)):
            begin = scanning.begin(number)
            first = frame_at(begin, self._scene.config.rate)
            first -= frame_time(first) > begin
            states = [self.at(each) for each in range(first, index + 1)]
            sweeps.append(scanning.sweep(number, states, self._start))
        return sweeps

    def _forget(self, index: int) -> None:
        """Forget the states that frames from frame ``index`` on do not need, if they follow each other."""
        if not self._kept:
            return
        frames = set(range(index - self._sweep_frames, index + 1)) if self.scanning else set()
        for timing in {camera.timing for camera in self._scene.scene_cameras.values()}:
            number = timing.number(index)
            frames |= {timing.frame(number + each) for each in (0, *self._directions.values())}
        needed = {(self._scene.frame_time(frame), self.playback.version) for frame in frames}
        self._kept = {key: state for key, state in self._kept.items() if key in needed}
