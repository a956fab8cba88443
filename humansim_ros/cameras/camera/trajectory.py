"""Camera trajectories: poses of the optical frame over time, from a file or generated."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.errors import MAX_COORDINATE, CameraError, warn_about
from humansim_ros.files.reading import atomic_path, read_text
from humansim_ros.geometry import matrix_to_quaternion, quaternion_to_matrix, slerp
from humansim_ros.types import Array

#: Behaviour after the last pose: stay there, start again, or go back.
End = Literal["clamp", "loop", "ping_pong"]

#: Largest file: more than a million poses.
_MAX_BYTES = 1 << 26
_COLUMNS = "timestamp tx ty tz qx qy qz qw"
#: Rounding explains errors of the length of a quaternion up to this.
_ROUNDING = 1e-2
#: Limits of the length of a quaternion.
_SHORTEST, _LONGEST = 1e-2, 1e2
#: Number of poses of an orbit. The line between two poses differs from the circle by less than 1e-5 of its
#: radius.
_ORBIT_POSES = 720


@dataclass(frozen=True)
class Trajectory:
    """Poses of a camera's optical frame (z forward, x right, y down) in ``map`` over time.

    Args:
        times: Times, (N,) seconds, ascending.
        positions: Positions, (N, 3) metres.
        rotations: Unit quaternions, (N, 4) xyzw.
        end: Behaviour after the last pose: ``clamp`` stays there, ``loop`` starts again, ``ping_pong`` goes
            back.

    Raises:
        CameraError: The shapes do not fit, times do not ascend, or a number is not finite or out of range.
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
        if np.abs(positions).max() > MAX_COORDINATE or np.abs(rotations).max() > _LONGEST:
            raise CameraError(
                "positions must be within 1000 km, and rotations must be quaternions of length 1"
            )
        length = np.linalg.norm(rotations, axis=1, keepdims=True)
        if (np.diff(times) <= 0).any() or (length < _SHORTEST).any():
            raise CameraError("the times must ascend, and rotations must be quaternions of length 1")
        if self.end not in get_args(End):
            raise CameraError(f"a trajectory ends with one of {', '.join(get_args(End))}", key="end")
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "positions", positions)
        object.__setattr__(self, "rotations", rotations / length)

    @classmethod
    def read(cls, path: str | os.PathLike[str], end: End = "clamp") -> Trajectory:
        """Read a text file in the format of the TUM RGB-D benchmark [Sturm 2012].

        Each line is ``timestamp tx ty tz qx qy qz qw``: seconds, metres, and the orientation of the optical
        frame in ``map``. ``#`` begins a comment.

        Raises:
            CameraError: The file cannot be read, or a line is wrong. The error names the path and the line.
        """
        text = read_text(path, CameraError, "trajectory", _MAX_BYTES)
        rows: list[list[float]] = []
        not_unit = False
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
            errors = {
                "a number is not finite (NaN or infinity)": not np.isfinite(row).all(),
                "the quaternion qx qy qz qw is far from length 1": not _SHORTEST < length < _LONGEST,
                "a position is more than 1000 km away": max(map(abs, row[1:4])) > MAX_COORDINATE,
                "the time is not later than the time of the line before": bool(rows)
                and row[0] <= rows[-1][0],
            }
            for message, wrong in errors.items():
                if wrong:
                    raise CameraError(message, path=path, line=number)
            not_unit |= abs(length - 1) > _ROUNDING
            rows.append(row)
        if not rows:
            raise CameraError(f"the file has no pose; a line is {_COLUMNS}", path=path)
        if not_unit:
            warn_about(
                path,
                "quaternions do not have length 1 and are normalised: is the order of the columns correct?",
            )
        table = np.array(rows)
        return cls(table[:, 0], table[:, 1:4], table[:, 4:], end)

    @classmethod
    def orbit(
        cls, look_at: ArrayLike, radius: float, height: float, period: float, start: float = 0.0
    ) -> Trajectory:
        """Create an endless circular trajectory around a target, counterclockwise as seen from above.

        Args:
            look_at: Target, (3,) metres in ``map``.
            radius: Radius of the circle, metres.
            height: Height of the circle above the floor, metres.
            period: Seconds per round.
            start: Azimuth of the first pose, radians from +x.

        Raises:
            CameraError: ``radius`` or ``period`` is not above zero.
        """
        for key, value in (("radius", radius), ("period", period)):
            if not 0 < value < np.inf:
                raise CameraError(f"must be above zero, not {value:g}", key=key)
        x, y, _ = np.asarray(look_at, dtype=float)
        angles = start + np.linspace(0, 2 * np.pi, _ORBIT_POSES + 1)
        circle: Array = np.column_stack(
            [x + radius * np.cos(angles), y + radius * np.sin(angles), np.full(len(angles), height)]
        )
        rotations = np.stack([Camera.look_at(position, look_at).R.T for position in circle])
        times: Array = np.linspace(0, period, len(angles), dtype=float)
        return cls(times, circle, matrix_to_quaternion(rotations), "loop")

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a file for :meth:`read`. The file does not store ``end``."""
        rows = np.column_stack([self.times, self.positions, self.rotations]).tolist()
        lines = [f"# {_COLUMNS}", *(" ".join(map(repr, row)) for row in rows)]
        with atomic_path(path) as temporary:
            temporary.write_text("\n".join(lines) + "\n")

    @property
    def duration(self) -> float:
        """Seconds from the first pose to the last."""
        return float(self.times[-1] - self.times[0])

    def pose(self, seconds: float) -> tuple[Array, Array]:
        """Extrinsics R (3, 3) and t (3,), world to optical frame. ``seconds``: time after the first pose. See
        :meth:`in_map`."""
        position, quaternion = self.in_map(seconds)
        rotation = quaternion_to_matrix(quaternion).T
        return rotation, -rotation @ position

    def in_map(self, seconds: float | Array) -> tuple[Array, Array]:
        """Positions (..., 3) and quaternions (..., 4) xyzw of the optical frame.

        ``seconds``: times (...) after the first pose.

        Positions are interpolated linearly, rotations by slerp. Before the first pose, ``clamp`` returns the
        first pose. ``loop`` and ``ping_pong`` continue backwards.
        """
        time = self.times[0] + self._time_in_trajectory(seconds)
        if len(self.times) == 1:
            after = np.zeros(time.shape, dtype=int)
            return self.positions[after], self.rotations[after]
        after = np.clip(np.searchsorted(self.times, time, side="right"), 1, len(self.times) - 1)
        start, end = self.times[after - 1], self.times[after]
        part = np.asarray(np.clip((time - start) / (end - start), 0.0, 1.0))
        along = part[..., None]
        position = (1 - along) * self.positions[after - 1] + along * self.positions[after]
        return position, slerp(self.rotations[after - 1], self.rotations[after], part)

    def difference_times(self, seconds: float, step: float) -> tuple[float, float]:
        """Times one step before and after a time, for finite differences. They do not pass the ends of a
        loop."""
        before, after = seconds - step, seconds + step
        if self.end != "loop":
            return before, after
        start = seconds - float(self._time_in_trajectory(seconds))
        return max(before, start), min(after, start + self.duration * (1 - 1e-9))

    def _time_in_trajectory(self, seconds: float | Array) -> Array:
        """Times within the trajectory, seconds since the first pose."""
        seconds = np.asarray(seconds, dtype=float)
        if self.end == "clamp" or self.duration == 0:
            return np.asarray(np.clip(seconds, 0.0, self.duration))
        if self.end == "loop":
            return np.asarray(np.mod(seconds, self.duration))
        back = np.mod(seconds, 2 * self.duration)
        return np.asarray(np.minimum(back, 2 * self.duration - back))
