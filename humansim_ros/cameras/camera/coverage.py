"""Coverage of a floor by cameras: how many cameras see each position."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from humansim_ros.cameras.camera.camera import Camera
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

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
        cls,
        cameras: Mapping[str, Camera],
        x: ArrayLike,
        y: ArrayLike,
        low: float,
        high: float | None = None,
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
        "use humansim_ros.cameras.Coverage.of; 0.4.0 removes coverage",
        DeprecationWarning,
        stacklevel=2,
    )
    return Coverage.of(cameras, x, y, low, high)
