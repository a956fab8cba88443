"""Scanners by name: pattern, limits and noise as their manufacturers state them.

``config/scanners.json`` has a row for each scanner. The keys of a row are fields of :class:`ScannerModel`.
``kind`` of a pattern names a function below. The other keys of the pattern are arguments of this function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from humansim_ros.cameras.scanner.pattern import Pattern, oscillating, raster, rosette, spinning
from humansim_ros.files.reading import read_table

#: Fields of the points, with the names and the order of the driver. ``scan`` is a sensor_msgs/LaserScan.
Layout = Literal["velodyne", "ouster", "livox", "autoware", "xyzi", "scan"]
#: Whether the stamp of a message is the start or the end of the sweep.
StampOf = Literal["start", "end"]


@dataclass(frozen=True)
class ScannerModel:
    """One scanner.

    Attributes:
        title: Name of the product.
        source: Where the figures come from, then the file of the driver that numbers the rings.
        rate: Sweeps per second.
        pattern: Function that makes the scan pattern for a rate in sweeps per second.
        range: Least and greatest distance, metres.
        noise: Standard deviation of distances, metres.
        divergence_mrad: Opening angle of a beam.
        layout: Fields of the points that the driver publishes.
        stamp: What the stamp of the driver means.
    """

    title: str
    source: str
    rate: float
    pattern: Callable[[float], Pattern]
    range: tuple[float, float]
    noise: float
    divergence_mrad: float = 3.0
    layout: Layout = "xyzi"
    stamp: StampOf = "start"


def _firing(
    rate: float, elevations: Sequence[float], firing: float, channel: float, top_first: bool = False
) -> Pattern:
    """Lasers that fire one after the other, with the same interval at any rate. See :func:`spinning`."""
    columns = int(1 / rate / firing + 1e-6)
    return spinning(rate, elevations, columns, firing=firing, channel=channel, top_first=top_first)


def _even(rate: float, elevations: tuple[float, float], count: int, columns: int) -> Pattern:
    """Lasers that fire together, at even elevations from the highest on. Ring 0 is the highest."""
    return spinning(rate, np.linspace(*elevations, count).tolist(), columns, top_first=True)


def _plane(rate: float, azimuth: tuple[float, float], columns: int) -> Pattern:
    """One laser in the x-y plane, which turns to the left."""
    return spinning(rate, (0.0,), columns, azimuth)


def _rows(
    rate: float,
    elevations: tuple[float, float],
    count: int,
    columns: int,
    azimuths: Sequence[tuple[float, float]],
) -> Pattern:
    """Rows at even elevations. See :func:`raster`."""
    return raster(rate, np.linspace(*elevations, count).tolist(), columns, *azimuths)


_PATTERNS: dict[str, Callable[..., Pattern]] = {
    "firing": _firing,
    "even": _even,
    "plane": _plane,
    "rows": _rows,
    "rosette": rosette,
    "oscillating": oscillating,
}


def _model(row: dict[str, Any]) -> ScannerModel:
    settings = dict(row["pattern"])
    pattern = partial(_PATTERNS[settings.pop("kind")], **settings)
    return ScannerModel(**{**row, "pattern": pattern, "range": tuple(row["range"])})


#: All models by name.
MODELS = {name: _model(row) for name, row in read_table("scanners").items()}
