"""Faults of a camera: their schedule, the error of a published calibration, and dirt on the lens.

The schedule is a pure function of the settings, the name of the camera and the number of the frame. Random
numbers are counted by frame, so that each frame can be computed alone: nodes, ``Simulation`` and the
processes of a recording find the same faults.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import ceil
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.geometry import rotation_vector_to_matrix
from humansim_ros.scene.config.camera_config import (
    MAX_DELAY,
    MAX_TRIGGER_DELAY,
    CalibrationFault,
    DirtFault,
    FaultsConfig,
    FreezeFault,
    OutageFault,
)
from humansim_ros.scene.config.timing import CameraTiming, frame_at
from humansim_ros.types import Array, Float32Array

#: Nanoseconds between two messages that follow each other.
FOLLOWING = 1
#: Frames with exposures that are looked at together for the last step.
_BLOCK = 4096


@dataclass(frozen=True)
class FrameFaults:
    """Faults of one frame of a camera.

    Attributes:
        sent: Nanoseconds after the stamp of the frame at which its image is sent; empty: it is lost.
        stamp_error: Nanoseconds that the stamp of its image is ahead of the stamp of the frame.
        picture: How many frames old the picture is. 0 is new.
        trigger_delay: Seconds by which that picture was exposed after the stamp of its own frame.
        stops: Exposure of the picture, in stops above the exposure of the sensor.
        kinds: What is wrong, by key of the scene, with its values.
    """

    sent: tuple[int, ...] = (0,)
    stamp_error: int = 0
    picture: int = 0
    trigger_delay: float = 0.0
    stops: float = 0.0
    kinds: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def follows(self) -> bool:
        """Whether its image is sent right after another message."""
        return bool({"out_of_order", "duplicate"} & self.kinds.keys())

    def stamp(self, stamp: int) -> int:
        """Stamp of the image, nanoseconds, at least 1. ``stamp``: of the frame."""
        return max(1, stamp + self.stamp_error)


#: A frame without faults.
NO_FAULTS: FrameFaults = FrameFaults()


class FaultSchedule:
    """Faults of each frame of a camera.

    The frames that faults count are the pictures of the camera, which may have a rate of its own.

    Args:
        config: Settings.
        camera: Name of the camera: cameras with the same settings have faults at different times.
        timing: Frames of the scene in which it takes a picture; or the rate of a scene: in each.

    Example:
        >>> from humansim_ros.scene.config.camera_config import ClockFault, FaultsConfig
        >>> schedule = FaultSchedule(FaultsConfig(clock=ClockFault(offset=0.02)), "left", 30.0)
        >>> schedule.at(7).stamp_error
        20000000
    """

    def __init__(self, config: FaultsConfig, camera: str, timing: CameraTiming | float) -> None:
        self.config = config
        self._camera = camera
        self._timing = timing if isinstance(timing, CameraTiming) else CameraTiming(timing)
        self._rate = self._timing.rate
        self._last: tuple[int, FrameFaults] = (-1, NO_FAULTS)
        #: Dirt of the last image size, by size.
        self._transmissions: dict[tuple[int, int], Float32Array] = {}

    def at_time(self, scene_time: int) -> FrameFaults:
        """Faults of the newest picture up to a scene time in nanoseconds."""
        return self.at(frame_at(scene_time, self._timing.scene_rate))

    def at(self, index: int) -> FrameFaults:
        """Faults of the newest picture up to frame ``index`` of the scene."""
        number = max(0, self._timing.number(index))
        if self._last[0] != number:
            self._last = number, self._faults(number)
        return self._last[1]

    def pictured(self, index: int) -> int:
        """Frame of the scene in which the picture was taken that the camera shows in frame ``index``."""
        return self._timing.frame(max(0, self._timing.number(index)) - self.at(index).picture)

    def _seconds(self, number: NDArray[Any] | int) -> Any:
        """Scene times in seconds of the pictures of some numbers."""
        return (self._timing.first + number * self._timing.step) / self._timing.scene_rate

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
        seconds = self._seconds(index)
        if self.calibration is not None:
            kinds["calibration"] = self.calibration.size(seconds)
        pictured = index - (frozen or 0)
        delay, stops = self._trigger_delay(pictured), self._stops(pictured)
        if self.config.trigger_delay is not None:
            kinds["trigger_delay"] = {"seconds": delay}
        if self.config.flicker is not None:
            kinds["flicker"] = {"light": float(self.lamp(np.array([self._seconds(pictured) + delay]))[0])}
        if self.config.exposure_steps is not None:
            kinds["exposure_steps"] = {"stops": stops}
        if self.config.dirt is not None:
            kinds["dirt"] = {}
        return FrameFaults(sent, stamp_error, frozen or 0, delay, stops, kinds)

    @cached_property
    def calibration(self) -> CalibrationError | None:
        """Error of the published calibration; None for an exact one."""
        config = self.config.calibration
        if config is None:
            return None
        return CalibrationError.drawn(config, self._generator("calibration"))

    def lamp(self, times: Array, exposure: float = 0.0) -> Array:
        """Light (N,) of a flickering lamp, relative to its mean, at scene times (N,) in seconds; equal for
        cameras with one seed. ``exposure``: seconds around each time over which light is averaged."""
        flicker = self.config.flicker
        if flicker is None:
            return np.ones(len(times))
        phase = 2 * np.pi * _generator(self.config.seed, "flicker", "").random()
        depth = flicker.depth * np.sinc(flicker.frequency * exposure)
        return np.asarray(1 + depth * np.cos(2 * np.pi * flicker.frequency * times + phase), dtype=float)

    def transmission(self, size: tuple[int, int]) -> Float32Array | None:
        """Share (H, W) of the light that passes the dirt on the lens; None for a clean lens. ``size``: width
        and height of the images, pixels."""
        if self.config.dirt is None:
            return None
        if size not in self._transmissions:
            self._transmissions = {size: transmission(self.config.dirt, size, self._generator("dirt"))}
        return self._transmissions[size]

    def _trigger_delay(self, index: int) -> float:
        trigger = self.config.trigger_delay
        if trigger is None:
            return 0.0
        delay = trigger.delay
        if trigger.jitter:
            delay += trigger.jitter * self._normal("trigger_delay", index)
        return float(np.clip(delay, -MAX_TRIGGER_DELAY, MAX_TRIGGER_DELAY))

    def _stops(self, index: int) -> float:
        """Exposure in stops since its last step; 0 before the first one."""
        steps = self.config.exposure_steps
        if steps is None or not steps.probability:
            return 0.0
        for last in range(index, -1, -_BLOCK):
            draws = self._draws("exposure_steps", max(0, last - _BLOCK + 1), last)
            (stepped,) = np.nonzero(draws[:, 0] < steps.probability)
            if len(stepped):
                low, high = steps.stops
                return float(low + (high - low) * draws[stepped[-1], 1])
        return 0.0

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
        """Frames since the begin of the present event, the latest of several; None without an event."""
        if event is None:
            return None
        time, before = self._seconds(index), self._timing.first / self._timing.step
        begun = [
            max(0, ceil(start * self._rate - before - 1e-6))
            for start, end in event.at
            if start - 1e-9 <= time < end
        ]
        if event.probability:
            low, high = event.duration
            first = max(0, index - ceil(high * self._rate))
            draws = self._draws(kind, first, index)
            indices = np.arange(first, index + 1)
            ends = self._seconds(indices) + low + (high - low) * draws[:, 1]
            begun += indices[(draws[:, 0] < event.probability) & (time < ends)].tolist()
        return index - max(begun) if begun else None

    def _sent(self, index: int, kinds: dict[str, Mapping[str, float]]) -> tuple[int, ...]:
        config, sent = self.config, self._delay(index)
        if sent:
            kinds["late"] = {"seconds": sent * 1e-9}
        order = config.out_of_order
        if order is not None and self._draws("out_of_order", index, index)[0, 0] < order.probability:
            later = index + order.frames
            between = self._timing.time(later) - self._timing.time(index)
            sent = between + self._delay(later) + FOLLOWING
            kinds["out_of_order"] = {"seconds": sent * 1e-9}
        twice = config.duplicate
        if twice is not None and self._draws("duplicate", index, index)[0, 0] < twice.probability:
            kinds["duplicate"] = {}
            return sent, sent + FOLLOWING
        return (sent,)

    def _delay(self, index: int) -> int:
        """Nanoseconds by which an image is late: an image also waits for the images before it."""
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
        error = clock.offset + 1e-6 * clock.drift_ppm * self._seconds(index)
        if clock.jitter:
            error += clock.jitter * self._normal("clock", index)
        return round(1e9 * error)

    def _normal(self, kind: str, index: int) -> float:
        """Standard normal number of a frame."""
        return NormalDist().inv_cdf(float(self._draws(kind, index, index)[0, 0]))

    def _generator(self, kind: str) -> np.random.Generator:
        """Random numbers that are the same in all frames."""
        return _generator(self.config.seed, kind, self._camera)

    def _draws(self, kind: str, first: int, last: int) -> Array:
        """Uniform numbers (N, 4) in (0, 1) of the frames from ``first`` to ``last``."""
        random = _generator(self.config.seed, kind, self._camera, first)
        return np.maximum(random.random((last - first + 1, 4)), 2**-54)


def _generator(seed: int, kind: str, camera: str, counter: int = 0) -> np.random.Generator:
    digest = hashlib.sha256(f"{seed} {kind} {camera}".encode()).digest()
    key = int.from_bytes(digest[:16], "little")
    return np.random.Generator(np.random.Philox(counter=counter, key=key))


@dataclass(frozen=True, eq=False)
class CalibrationError:
    """Error of the published calibration of a camera.

    Attributes:
        rotation: Rotation (3, 3) from the optical frame of the scene to the published one.
        translation: (3,) from the position of the scene to the published one, metres in ``map``.
        focal: Published focal lengths relative to the focal lengths of the camera.
        turn: Motion of the true optical frame: rotation vector (3,), radians per second, in it.
        shift: Motion of the true position: (3,) metres per second in ``map``.
    """

    rotation: Array
    translation: Array
    focal: float
    turn: Array
    shift: Array

    @classmethod
    def drawn(cls, config: CalibrationFault, random: np.random.Generator) -> CalibrationError:
        """Draw the directions of an error."""
        directions = random.standard_normal((4, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        turned, moved, turn, shift = directions
        sign = 1 if random.random() < 0.5 else -1
        drift = config.drift
        return cls(
            rotation_vector_to_matrix(np.radians(config.rotation) * turned),
            config.translation * moved,
            1 + sign * config.focal,
            (0.0 if drift is None else np.radians(drift.rotation) / 60) * turn,
            (0.0 if drift is None else drift.translation / 60) * shift,
        )

    @property
    def drifts(self) -> bool:
        """Whether the camera moves away from its calibration."""
        return bool(self.turn.any() or self.shift.any())

    def moved(self, seconds: float) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,) of the true camera at a scene time in seconds."""
        return rotation_vector_to_matrix(seconds * self.turn), seconds * self.shift

    def published(self, camera: Camera) -> Camera:
        """Camera with the published focal lengths, at the same pose."""
        if self.focal == 1:
            return camera
        k, rectified = camera.K.copy(), camera.rectified
        k[:2, :2] *= self.focal
        if rectified is not None:
            rectified = rectified.copy()
            rectified[:2, [0, 1, 3]] *= self.focal
        return replace(camera, K=k, rectified=rectified)

    def size(self, seconds: float) -> dict[str, float]:
        """Difference of the published camera from the true camera at a scene time in seconds.

        Returns:
            ``rotation``: degrees; ``translation``: metres; ``focal``: share of the true focal length.
        """
        turned, shifted = self.moved(seconds)
        # the cosine alone, from the trace, has no digits left at small angles
        skew = self.rotation @ turned.T
        sine = np.linalg.norm([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]) / 2
        angle = np.arctan2(sine, (np.trace(skew) - 1) / 2)
        return {
            "rotation": float(np.degrees(angle)),
            "translation": float(np.linalg.norm(self.translation - shifted)),
            "focal": self.focal - 1,
        }


#: Share of the radius of a spot over which it fades.
_EDGE = 0.6


def transmission(dirt: DirtFault, size: tuple[int, int], random: np.random.Generator) -> Float32Array:
    """Share (H, W) of the light that passes the spots. ``dirt``: settings. ``size``: width and height of the
    image, pixels. The spots are the same in images of any size. ``random``: draws places and sizes."""
    width, height = size
    share = np.ones((height, width), np.float32)
    low, high = dirt.size
    for across, down, part in random.random((dirt.spots, 3)).tolist():
        radius = (low + (high - low) * part) * width / 2
        # the centre of the top-left pixel is (0, 0)
        x, y = across * width - 0.5, down * height - 0.5
        left, right = (int(np.clip(np.ceil(x + side * radius), 0, width)) for side in (-1, 1))
        top, bottom = (int(np.clip(np.ceil(y + side * radius), 0, height)) for side in (-1, 1))
        distance = np.hypot(np.arange(left, right) - x, np.arange(top, bottom)[:, None] - y)
        inside = np.clip((1 - distance / radius) / _EDGE, 0, 1)
        cover = dirt.opacity * inside**2 * (3 - 2 * inside)
        share[top:bottom, left:right] *= (1 - cover).astype(np.float32)
    return share
