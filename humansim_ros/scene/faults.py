"""Schedule of the faults of a camera: a pure function of its settings, its name and the number of the frame.

Random numbers are counted by frame, so that each frame can be computed alone: nodes, ``Simulation`` and the
processes of a recording find the same faults.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil
from statistics import NormalDist

import numpy as np

from humansim_ros.scene.fault_config import MAX_DELAY, FaultsConfig, FreezeFault, OutageFault
from humansim_ros.scene.times import frame_at, frame_time
from humansim_ros.types import Array

#: Nanoseconds between messages of which one follows the other.
FOLLOWING = 1


@dataclass(frozen=True)
class FrameFaults:
    """Faults of one frame of a camera.

    Attributes:
        sent: Nanoseconds after the stamp of the frame at which its image is sent; empty: it is lost.
        stamp_error: Nanoseconds that the stamp of its image is ahead of that of the frame.
        picture: Number of frames since the one whose picture it shows; 0: its own.
        kinds: What is wrong, by key of the scene, with its values.
    """

    sent: tuple[int, ...] = (0,)
    stamp_error: int = 0
    picture: int = 0
    kinds: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def follows(self) -> bool:
        """Whether its image is sent right after another message, whenever that is sent."""
        return bool({"out_of_order", "duplicate"} & self.kinds.keys())

    def stamp(self, stamp: int) -> int:
        """Stamp of the image, nanoseconds, at least 1, of a frame with another."""
        return max(1, stamp + self.stamp_error)


#: A frame without faults.
NO_FAULTS = FrameFaults()


class FaultSchedule:
    """Faults of each frame of a camera.

    Args:
        config: Settings.
        camera: Name of the camera: cameras with the same settings have faults at different times.
        rate: Frames per second of the scene.

    Example:
        >>> from humansim_ros.scene.fault_config import ClockFault, FaultsConfig
        >>> schedule = FaultSchedule(FaultsConfig(clock=ClockFault(offset=0.02)), "left", 30.0)
        >>> schedule.at(7).stamp_error
        20000000
    """

    def __init__(self, config: FaultsConfig, camera: str, rate: float) -> None:
        self.config = config
        self._camera = camera
        self._rate = rate
        self._last: tuple[int, FrameFaults] = (-1, NO_FAULTS)

    def at_time(self, scene_time: int) -> FrameFaults:
        """Faults of the frame at a scene time in nanoseconds."""
        return self.at(frame_at(scene_time, self._rate))

    def at(self, index: int) -> FrameFaults:
        """Faults of a frame."""
        if self._last[0] != index:
            self._last = index, self._faults(index)
        return self._last[1]

    def _faults(self, index: int) -> FrameFaults:
        kinds: dict[str, Mapping[str, float]] = {}
        if self._is_dropped(index):
            kinds["drop"] = {}
        outage = self._since(index, "outage", self.config.outage)
        if outage is not None:
            kinds["outage"] = {"frames": float(outage)}
        sent = () if kinds else self._sent(index, kinds)
        frozen = self._since(index, "freeze", self.config.freeze)
        if frozen:  # the first frozen picture is its own
            kinds["freeze"] = {"frames": float(frozen)}
        stamp_error = self._stamp_error(index)
        if self.config.clock is not None:
            kinds["clock"] = {"seconds": stamp_error * 1e-9}
        return FrameFaults(sent, stamp_error, frozen or 0, kinds)

    def _is_dropped(self, index: int) -> bool:
        drop = self.config.drop
        if drop is None:
            return False
        low, high = drop.frames
        first = max(0, index - high + 1)
        begins, length = self._draws("drop", first, index)[:, :2].T
        frames = low + np.floor((high - low + 1) * length)
        return bool(np.any((begins < drop.probability) & (index - np.arange(first, index + 1) < frames)))

    def _since(self, index: int, kind: str, event: FreezeFault | OutageFault | None) -> int | None:
        """Number of frames since an event began that lasts; of several, the last one. None without any."""
        if event is None:
            return None
        time = index / self._rate
        begun = [ceil(start * self._rate - 1e-6) for start, end in event.at if start - 1e-9 <= time < end]
        if event.probability:
            low, high = event.duration
            first = max(0, index - ceil(high * self._rate))
            draws = self._draws(kind, first, index)
            indices = np.arange(first, index + 1)
            ends = indices / self._rate + low + (high - low) * draws[:, 1]
            begun += indices[(draws[:, 0] < event.probability) & (time < ends)].tolist()
        return index - max(begun) if begun else None

    def _sent(self, index: int, kinds: dict[str, Mapping[str, float]]) -> tuple[int, ...]:
        config, sent = self.config, self._delay(index)
        if sent:
            kinds["late"] = {"seconds": sent * 1e-9}
        order = config.out_of_order
        if order is not None and self._draws("out_of_order", index, index)[0, 0] < order.probability:
            later = index + order.frames
            between = frame_time(later, self._rate) - frame_time(index, self._rate)
            sent = between + self._delay(later) + FOLLOWING
            kinds["out_of_order"] = {"seconds": sent * 1e-9}
        twice = config.duplicate
        if twice is not None and self._draws("duplicate", index, index)[0, 0] < twice.probability:
            kinds["duplicate"] = {}
            return sent, sent + FOLLOWING
        return (sent,)

    def _delay(self, index: int) -> int:
        """Nanoseconds by which an image is late: it also waits for those before it."""
        late = self.config.late
        if late is None:
            return 0
        first = max(0, index - ceil(MAX_DELAY * self._rate))
        draws = self._draws("late", first, index)
        low, high = late.delay
        delays = np.where(draws[:, 0] < late.probability, low + (high - low) * draws[:, 1], 0.0)
        waited = delays - (index - np.arange(first, index + 1)) / self._rate
        return round(1e9 * max(0.0, float(waited.max())))

    def _stamp_error(self, index: int) -> int:
        clock = self.config.clock
        if clock is None:
            return 0
        error = clock.offset + 1e-6 * clock.drift_ppm * index / self._rate
        if clock.jitter:
            error += clock.jitter * NormalDist().inv_cdf(float(self._draws("clock", index, index)[0, 0]))
        return round(1e9 * error)

    def _draws(self, kind: str, first: int, last: int) -> Array:
        """Uniform numbers (N, 4) in (0, 1) of the frames from ``first`` to ``last``."""
        digest = hashlib.sha256(f"{self.config.seed} {kind} {self._camera}".encode()).digest()
        key = int.from_bytes(digest[:16], "little")
        random = np.random.Generator(np.random.Philox(counter=first, key=key))
        return np.maximum(random.random((last - first + 1, 4)), 2**-54)
