"""Rigs of cameras (ring, wall, dome, stereo pair), their coverage of a floor, and trajectories of cameras.

All cameras of a rig look at its target. Azimuths are radians from +x towards +y in ``map``.
"""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.cameras.camera.lens import Lens
from humansim_ros.errors import MAX_COORDINATE, CameraError, warn_about
from humansim_ros.files.reading import atomic_path, read_text
from humansim_ros.geometry import matrix_to_quaternion, quaternion_to_matrix, slerp
from humansim_ros.types import Array

#: Largest number of cameras of a rig.
MAX_CAMERAS = 1000
#: Angle between consecutive cameras of a dome, radians. It spreads them evenly.
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


@dataclass(frozen=True)
class Optics:
    """Image size and lens of all cameras of a rig, with square pixels and a centred principal point.
    ``size``: (width, height) pixels. ``fov``: horizontal field of view through the lens, radians.
    ``distortion``, ``model``: see :class:`Camera`."""

    size: tuple[int, int] = (640, 480)
    fov: float = math.radians(60)
    distortion: tuple[float, ...] = ()
    model: str | None = None

    def camera(self, position: ArrayLike, target: ArrayLike) -> Camera:
        """Camera at a position (3,) that looks at a target (3,).

        Raises:
            CameraError: The field of view of the lens is smaller than ``fov``.
        """
        ideal = Camera.look_at(position, target, self.size, self.fov)
        lens = Lens.of(self.distortion, self.model)
        edge = lens.distort([[np.tan(self.fov / 2), 0.0]])[0, 0]
        if not edge > 0:
            widest = np.degrees(2 * np.arctan(lens.valid_radius))
            raise CameraError(f"the field of view of this lens is at most {widest:.1f} degrees", key="fov")
        k = ideal.K.copy()
        k[[0, 1], [0, 1]] = self.size[0] / 2 / edge
        return replace(ideal, K=k, distortion=self.distortion, model=self.model)


@dataclass(frozen=True)
class Rig:
    """Placement of cameras around a target. Each method makes one kind of rig, and returns its cameras by
    name.

    Args:
        look_at: Target, (3,) metres in ``map``.
        radius: Distance of the cameras from the target, metres. For a dome it is the distance in space, for
            other rigs the distance along the floor.
        height: Height of the cameras, or of the centre of a wall, above the floor, metres. A dome ignores it.
        optics: Image size and lens of the cameras.
        start: Azimuth of the first camera, or of the centre of a wall or pair, radians.

    Raises:
        CameraError: A number is out of range, or (in a method) a camera does not see the target.
    """

    look_at: ArrayLike
    radius: float
    height: float = 0.0
    optics: Optics = field(default_factory=Optics)
    start: float = 0.0

    def __post_init__(self) -> None:
        _check_positive("radius", self.radius)
        target = np.asarray(self.look_at, dtype=float)
        if target.shape != (3,) or not np.isfinite(target).all():
            raise CameraError("must be three numbers, x y z", key="look_at")
        object.__setattr__(self, "look_at", target)

    def ring(self, count: int) -> dict[str, Camera]:
        """Cameras at equal distances on a circle, counterclockwise from ``start``."""
        azimuths = self.start + np.arange(_checked(count)) * 2 * np.pi / count
        circle = np.column_stack([np.cos(azimuths), np.sin(azimuths)])
        floor = np.asarray(self.look_at)[:2] + self.radius * circle
        return self._named(np.column_stack([floor, np.full(count, self.height)]))

    def grid(self, rows: int, columns: int, spacing: float) -> dict[str, Camera]:
        """Cameras on a wall, ``spacing`` metres apart, row by row. The first one is at the top left, as seen
        from the target."""
        _checked(rows * columns if min(rows, columns) > 0 else 0)
        _check_positive("spacing", spacing)
        out = np.array([np.cos(self.start), np.sin(self.start), 0.0])
        right = np.array([out[1], -out[0], 0.0])
        across = (np.arange(columns) - (columns - 1) / 2) * spacing
        up = ((rows - 1) / 2 - np.arange(rows)) * spacing
        positions = self._middle + (up[:, None, None] * [0.0, 0.0, 1.0]) + across[None, :, None] * right
        return self._named(positions.reshape(-1, 3))

    def dome(self, count: int) -> dict[str, Camera]:
        """Cameras on a spiral over the upper half of a sphere, from the lowest one. Each camera covers an
        equal share of the half sphere."""
        sine = (np.arange(_checked(count)) + 0.5) / count
        azimuths = self.start + np.arange(count) * _GOLDEN_ANGLE
        cosine = np.sqrt(1 - sine * sine)
        directions = np.column_stack([cosine * np.cos(azimuths), cosine * np.sin(azimuths), sine])
        return self._named(np.asarray(self.look_at) + self.radius * directions)

    def stereo(self, baseline: float) -> dict[str, Camera]:
        """Stereo pair, ``left`` and ``right``, with parallel axes and the conventions of ROS.

        Both cameras have the same K and D, and R is the identity. P differs only in P[0, 3], which is -fx
        baseline for the right camera. So P projects points of the *left* optical frame to pixels of the right
        rectified image.
        """
        _check_positive("baseline", baseline)
        center = self.optics.camera(self._middle, self.look_at)
        pair = {}
        for name, side in (("left", -0.5), ("right", 0.5)):
            rectified = center.rectified_projection.copy()
            if name == "right":
                rectified[0, 3] = -rectified[0, 0] * baseline
            t = center.t - np.array([side * baseline, 0.0, 0.0])
            pair[name] = replace(center, t=t, rectification=np.eye(3), rectified=rectified)
        return self._checked_cameras(pair)

    @property
    def _middle(self) -> Array:
        """Position (3,) of the first camera, or of the centre of a wall or pair."""
        out = np.array([np.cos(self.start), np.sin(self.start), 0.0])
        return np.array([*np.asarray(self.look_at)[:2], self.height]) + self.radius * out

    def _named(self, positions: Array) -> dict[str, Camera]:
        cameras = (self.optics.camera(position, self.look_at) for position in positions)
        return self._checked_cameras({f"camera_{n}": camera for n, camera in enumerate(cameras, 1)})

    def _checked_cameras(self, cameras: dict[str, Camera]) -> dict[str, Camera]:
        """The same cameras. Raises CameraError if one does not see the target."""
        for name, camera in cameras.items():
            pixel = camera.project(np.array([self.look_at]))[0][0]
            if not ((pixel >= -0.5) & (pixel < np.array(camera.size) - 0.5)).all():
                raise CameraError(f"{name} does not see its target")
        return cameras


def _checked(count: int) -> int:
    if not 0 < count <= MAX_CAMERAS:
        raise CameraError(f"a rig has 1 to {MAX_CAMERAS} cameras, not {count}")
    return count


def _check_positive(key: str, value: float) -> None:
    if not 0 < value < np.inf:
        raise CameraError(f"must be above zero, not {value:g}", key=key)


#: What happens after the last pose: the camera stays there, starts again, or goes back.
End = Literal["clamp", "loop", "ping_pong"]

#: Largest trajectory file, bytes. It has room for a million poses.
_MAX_BYTES = 1 << 26
_COLUMNS = "timestamp tx ty tz qx qy qz qw"
#: A quaternion is taken as rounded if its length differs from 1 by at most this.
_ROUNDING = 1e-2
#: Shortest and longest quaternion that is accepted.
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
            message = "positions must be within 1000 km, and rotations must be quaternions of length 1"
            raise CameraError(message)
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
            what = "quaternions do not have length 1 and are normalised: is the order of the columns correct?"
            warn_about(path, what)
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
        _check_positive("radius", radius)
        _check_positive("period", period)
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
        """Extrinsics R (3, 3) and t (3,), world to optical frame, ``seconds`` after the first pose. See
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
        """Times one step before and after ``seconds``, for finite differences. Both stay in the same round of
        a loop, since the pose jumps at its end."""
        before, after = seconds - step, seconds + step
        if self.end != "loop":
            return before, after
        start = seconds - float(self._time_in_trajectory(seconds))
        return max(before, start), min(after, start + self.duration * (1 - 1e-9))

    def _time_in_trajectory(self, seconds: float | Array) -> Array:
        """Convert times to times between the first and the last pose, seconds after the first pose (see
        ``end``)."""
        seconds = np.asarray(seconds, dtype=float)
        if self.end == "clamp" or self.duration == 0:
            return np.asarray(np.clip(seconds, 0.0, self.duration))
        if self.end == "loop":
            return np.asarray(np.mod(seconds, self.duration))
        back = np.mod(seconds, 2 * self.duration)
        return np.asarray(np.minimum(back, 2 * self.duration - back))


#: Number of heights at which an upright line is tested.
_HEIGHTS = 7


@dataclass(frozen=True)
class Coverage:
    """Number of cameras that see each position of a grid on the floor.

    ``x`` (W,), ``y`` (H,): positions in ``map``, metres. ``counts``: (H, W) cameras.
    """

    x: Array
    y: Array
    counts: NDArray[np.intp]

    def area(self, least: int, most: int) -> float:
        """Area in square metres that ``least`` to ``most`` cameras see."""
        cell = abs((self.x[1] - self.x[0]) * (self.y[1] - self.y[0]))
        return float(((self.counts >= least) & (self.counts <= most)).sum() * cell)

    @classmethod
    def of(
        cls, cameras: Mapping[str, Camera], x: ArrayLike, y: ArrayLike, low: float, high: float | None = None
    ) -> Coverage:
        """Count the cameras that see each position of a grid. Occlusion is ignored.

        Args:
            cameras: Cameras by name.
            x: Positions along x in ``map``, (W,) metres, at least two in even steps.
            y: Positions along y in ``map``, (H,) metres, at least two in even steps.
            low: Height of the point that must be visible, metres.
            high: If given, the whole upright line from ``low`` to ``high`` must be visible, as for a standing
                person.

        Raises:
            CameraError: There are fewer than two positions along x or y.
        """
        x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
        if min(x.size, y.size) < 2:
            raise CameraError("a coverage needs at least two positions along x and y")
        heights = [low] if high is None else np.linspace(low, high, _HEIGHTS)
        counts = np.zeros((len(y), len(x)), np.intp)
        for camera in cameras.values():
            visible = np.ones(counts.shape, bool)
            for height in heights:
                points = np.stack(np.broadcast_arrays(x[None, :], y[:, None], height), axis=-1)
                pixels, _ = camera.project(points.reshape(-1, 3))
                inside = (pixels >= -0.5) & (pixels < np.array(camera.size) - 0.5)
                visible &= inside.all(axis=1).reshape(counts.shape)
            counts += visible
        return cls(x, y, counts)


def coverage(
    cameras: Mapping[str, Camera], x: ArrayLike, y: ArrayLike, low: float, high: float | None = None
) -> Coverage:
    """Old name of :meth:`Coverage.of`.

    Args:
        cameras: Cameras by name.
        x: Positions along x.
        y: Positions along y.
        low: Lowest height.
        high: Greatest height.
    """
    warnings.warn(
        "use humansim_ros.cameras.Coverage.of; 0.4.0 removes coverage", DeprecationWarning, stacklevel=2
    )
    return Coverage.of(cameras, x, y, low, high)
