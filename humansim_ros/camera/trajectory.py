"""How a camera moves: poses of its optical frame over time, read from a file or made."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.camera.camera import Camera
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.io.files import atomic_path, read_text
from humansim_ros.rotations import matrix_to_quaternion, quaternion_to_matrix, slerp
from humansim_ros.types import Array

#: What follows the last pose: it stays, the first comes again, or the way goes back.
End = Literal["clamp", "loop", "ping_pong"]

#: More than a million poses.
_MAX_BYTES = 1 << 26
_COLUMNS = "timestamp tx ty tz qx qy qz qw"
#: Metres; what is farther is a mistake.
_FARTHEST = 1e6
#: How far the length of a quaternion may be from 1 by rounding.
_ROUNDING = 1e-2
#: Beyond these it is none.
_SHORTEST, _LONGEST = 1e-2, 1e2
#: Poses of an orbit: a straight line between two is off the circle by less than 1e-5 of its radius.
_ORBIT_POSES = 720


@dataclass(frozen=True)
class Trajectory:
    """A way of a camera's optical frame through ``map``.

    ``times``: (N,) seconds, rising. ``positions``: (N, 3) metres. ``rotations``: (N, 4) xyzw, unit length:
    the optical frame (z forward, x right, y down) in ``map``. ``end``: what follows the last pose.
    Raises CameraError where these are none of a trajectory.
    """

    times: Array
    positions: Array
    rotations: Array
    end: End = "clamp"

    def __post_init__(self) -> None:
        times, positions, rotations = (
            np.asarray(part, dtype=float) for part in (self.times, self.positions, self.rotations)
        )
        count = len(times) if times.ndim == 1 else 0
        if not count or positions.shape != (count, 3) or rotations.shape != (count, 4):
            raise CameraError("a trajectory needs at least one time, and a position and rotation for each")
        if not all(np.isfinite(part).all() for part in (times, positions, rotations)):
            raise CameraError("a number of the trajectory is not finite (NaN or infinity)")
        if np.abs(positions).max() > _FARTHEST or np.abs(rotations).max() > _LONGEST:
            raise CameraError("places must be within 1000 km, and rotations be quaternions of length 1")
        length = np.linalg.norm(rotations, axis=1, keepdims=True)
        if (np.diff(times) <= 0).any() or (length < _SHORTEST).any():
            raise CameraError("the times must rise, and rotations be quaternions of length 1")
        if self.end not in get_args(End):
            raise CameraError(f"a trajectory ends with one of {', '.join(get_args(End))}", key="end")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "rotations", rotations / length)

    @classmethod
    def read(cls, path: str | os.PathLike[str], end: End = "clamp") -> Trajectory:
        """The trajectory of a text file in the form of the TUM RGB-D benchmark.

        Each line is ``timestamp tx ty tz qx qy qz qw``: seconds, metres, the optical frame in ``map``; ``#``
        begins a comment. Raises CameraError with path and line.
        """
        text = read_text(path, CameraError, "trajectory", _MAX_BYTES)
        rows: list[list[float]] = []
        careless = False
        for number, line in enumerate(text.splitlines(), 1):
            words = line.split("#")[0].replace(",", " ").split()
            if not words:
                continue
            try:
                row = [float(word) for word in words]
            except ValueError:
                row = []
            if len(row) != 8:
                raise CameraError(f"a line needs 8 numbers: {_COLUMNS}", path=path, line=number)
            length = math.hypot(*row[4:])
            wrong = {
                "a number is not finite (NaN or infinity)": not np.isfinite(row).all(),
                "the quaternion qx qy qz qw is far from length 1": not _SHORTEST < length < _LONGEST,
                "a position is more than 1000 km away": max(map(abs, row[1:4])) > _FARTHEST,
                "the time is not later than that of the line before": bool(rows) and row[0] <= rows[-1][0],
            }
            for message, is_so in wrong.items():
                if is_so:
                    raise CameraError(message, path=path, line=number)
            careless |= abs(length - 1) > _ROUNDING
            rows.append(row)
        if not rows:
            raise CameraError(f"there is no pose in this file; a line is {_COLUMNS}", path=path)
        if careless:
            warn_about(path, "quaternions are not of length 1: they are made so; are the columns in order?")
        table = np.array(rows)
        return cls(table[:, 0], table[:, 1:4], table[:, 4:], end)

    @classmethod
    def orbit(
        cls, look_at: ArrayLike, radius: float, height: float, period: float, start: float = 0.0
    ) -> Trajectory:
        """Round and round a point (3,), to the left (from above: against the clock), looking at it.

        ``radius``: of the circle about it, metres; ``height``: of the circle over the floor; ``period``:
        seconds per round; ``start``: where it begins, radians from +x. Raises CameraError for a radius or
        period that is not above zero.
        """
        for key, value in (("radius", radius), ("period", period)):
            if not 0 < value < np.inf:
                raise CameraError(f"must be above zero, not {value:g}", key=key)
        x, y, _ = np.asarray(look_at, dtype=float)
        angles = start + np.linspace(0, 2 * np.pi, _ORBIT_POSES + 1)
        circle: Array = np.column_stack(
            [x + radius * np.cos(angles), y + radius * np.sin(angles), np.full(len(angles), height)]
        )
        turns = np.stack([Camera.look_at(place, look_at).R.T for place in circle])
        times: Array = np.linspace(0, period, len(angles), dtype=float)
        return cls(times, circle, matrix_to_quaternion(turns), "loop")

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a file that :meth:`read` gives back; what follows its end is not in it."""
        rows = np.column_stack([self.times, self.positions, self.rotations]).tolist()
        lines = [f"# {_COLUMNS}", *(" ".join(map(repr, row)) for row in rows)]
        with atomic_path(path) as temporary:
            temporary.write_text("\n".join(lines) + "\n")

    @property
    def duration(self) -> float:
        """Seconds from the first pose to the last."""
        return float(self.times[-1] - self.times[0])

    def pose(self, seconds: float) -> tuple[Array, Array]:
        """R (3, 3) and t (3,), world to optical frame, so many seconds after the first pose.

        Positions are interpolated linearly, rotations along the shortest turn (slerp). Before the first pose
        ``clamp`` stays there, ``loop`` and ``ping_pong`` go on backwards.
        """
        time = self.times[0] + self._wrapped(seconds)
        after = int(np.clip(np.searchsorted(self.times, time, side="right"), 1, max(len(self.times) - 1, 1)))
        if len(self.times) == 1:
            position, quaternion = self.positions[0], self.rotations[0]
        else:
            start, end = self.times[after - 1], self.times[after]
            part = np.clip((time - start) / (end - start), 0.0, 1.0)
            position = (1 - part) * self.positions[after - 1] + part * self.positions[after]
            quaternion = slerp(self.rotations[after - 1], self.rotations[after], np.asarray(part))
        rotation = quaternion_to_matrix(quaternion).T
        return rotation, -rotation @ position

    def around(self, seconds: float, step: float) -> tuple[float, float]:
        """A time a step before and one a step after, which reach no farther than where a loop begins anew."""
        early, late = seconds - step, seconds + step
        if self.end != "loop":
            return early, late
        start = seconds - self._wrapped(seconds)
        return max(early, start), min(late, start + self.duration * (1 - 1e-9))

    def _wrapped(self, seconds: float) -> float:
        """Seconds since the first pose that are within the trajectory."""
        if self.end == "clamp" or self.duration == 0:
            return float(np.clip(seconds, 0.0, self.duration))
        if self.end == "loop":
            return float(seconds % self.duration)
        back = seconds % (2 * self.duration)
        return float(min(back, 2 * self.duration - back))
