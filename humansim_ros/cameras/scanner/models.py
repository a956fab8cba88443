"""Laser scanners: scan patterns, returns of their beams, and scanners by name.

The frame of a scanner is x forward, y left, z up (REP-103). Azimuth is measured from x to y, elevation from
the x-y plane to z.

``config/scanners.json`` has a row for each scanner, with figures of its manufacturer. The keys of a row are
fields of :class:`ScannerModel`. ``kind`` of a pattern names a function, and the other keys of the pattern are
arguments of this function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.scanner.casting import RayIndex
from humansim_ros.files.reading import read_table
from humansim_ros.types import Array, Indices

_SECOND = 1_000_000_000
#: Number of rays that sample a beam.
SUBRAYS = 7
#: Most parts of sweeps with a cached :class:`RayIndex`.
_MAX_INDICES = 32


@dataclass(frozen=True, eq=False)
class Rays:
    """The rays of a sweep in the order in which they are fired.

    Attributes:
        directions: (N, 3) unit vectors in the scanner's frame.
        times: (N,) int64 nanoseconds from the start of the sweep, ascending.
        rings: (N,) uint16 number of the laser, of the row or of the line, as the driver of the model counts
            them. In patterns without a driver, 0 is the lowest laser.
        grid: (rings, columns) if the rays form a table with this shape, column after column. Else None.
        azimuths: First azimuth and step in radians if all rays are in one plane. Else None.
    """

    directions: Array
    times: NDArray[np.int64]
    rings: NDArray[np.uint16]
    grid: tuple[int, int] | None = None
    azimuths: tuple[float, float] | None = None

    def __len__(self) -> int:
        return len(self.times)

    def from_top(self) -> Rays:
        """The same rays. If they form a table, ring 0 is the highest laser."""
        heights, rings = self.directions[:, 2], self.rings
        if self.grid is None or heights[rings.argmin()] >= heights[rings.argmax()]:
            return self
        return replace(self, rings=rings.max() - rings)

    @cached_property
    def _indices(self) -> dict[tuple[int, int], RayIndex]:
        return {}

    def index(self, chosen: slice) -> RayIndex:
        """Index that finds chosen rays by direction. It is cached, since the sweeps of a scanner are often
        cut at the same times."""
        key = int(chosen.start), int(chosen.stop)
        if key not in self._indices:
            if len(self._indices) >= _MAX_INDICES:
                self._indices.clear()
            self._indices[key] = RayIndex(self.directions[chosen])
        return self._indices[key]

    def spread(self, divergence: float) -> Rays:
        """Rays that sample the beams: for each beam one ray in the middle, and :data:`SUBRAYS` - 1 rays
        around it. ``divergence``: opening angle of a beam in radians. The outer rays are at 0.35 of this
        angle."""
        around = np.arange(SUBRAYS - 1) * (2 * np.pi / (SUBRAYS - 1))
        middle = self.directions
        sideways = np.stack([-middle[:, 1], middle[:, 0], np.zeros(len(middle))], axis=-1)
        length = np.linalg.norm(sideways, axis=1, keepdims=True)
        sideways = np.where(length > 1e-9, sideways / np.maximum(length, 1e-9), [0.0, 1.0, 0.0])
        upwards = np.cross(middle, sideways)
        offsets = np.cos(around)[:, None] * sideways[:, None] + np.sin(around)[:, None] * upwards[:, None]
        vectors = middle[:, None] + np.concatenate(
            [np.zeros((len(middle), 1, 3)), 0.35 * divergence * offsets], axis=1
        )
        vectors /= np.linalg.norm(vectors, axis=2, keepdims=True)
        return Rays(vectors.reshape(-1, 3), np.repeat(self.times, SUBRAYS), np.repeat(self.rings, SUBRAYS))


@dataclass(frozen=True, eq=False)
class Pattern:
    """Scan pattern: the rays of all sweeps of a scanner.

    ``period``: nanoseconds from the start of a sweep to the start of the next. ``count``: number of rays of a
    sweep. ``repeated``: rays of every sweep; None if no two sweeps are alike. In this case ``make``, which
    can be pickled, makes the rays of a sweep from its number.
    """

    period: float
    count: int
    repeated: Rays | None = None
    make: Callable[[int], Rays] | None = None

    def rays(self, number: int) -> Rays:
        """Rays of sweep ``number``, counted from 0."""
        if self.repeated is not None:
            return self.repeated
        assert self.make is not None
        return self.make(number)

    def start(self, number: int) -> int:
        """Nanoseconds from the start of the scene to the start of sweep ``number``."""
        return round(number * self.period)


def directions(azimuths: Array, elevations: Array) -> Array:
    """Unit vectors (N, 3) from angles (N,) in radians."""
    flat = np.cos(elevations)
    return np.stack([flat * np.cos(azimuths), flat * np.sin(azimuths), np.sin(elevations)], axis=-1)


def spinning(
    rate: float,
    elevations: Sequence[float],
    columns: int = 0,
    azimuth: tuple[float, float] = (180.0, -180.0),
    firing: float = 0.0,
    channel: float = 0.0,
    top_first: bool = False,
) -> Pattern:
    """Pattern of a scanner with lasers that turn about z.

    Args:
        rate: Turns per second.
        elevations: Degrees of each laser, in the order in which the lasers of a column fire.
        columns: Number of columns of a sweep. If 0, as many as are fired in a turn.
        azimuth: First and last azimuth in degrees. If they are less than a turn apart, the last one is that
            of the last column. Otherwise it is that of the first column of the next sweep.
        firing: Seconds from column to column. If 0, columns are spread evenly over the angle.
        channel: Seconds from laser to laser in a column. The scanner turns in this time.
        top_first: Whether ring 0 is the highest laser. If False, it is the lowest.
    """
    columns = columns or int(1 / rate / firing + 1e-6)
    first, last = np.radians(azimuth)
    turn = abs(last - first) >= 2 * np.pi - 1e-9
    step = (last - first) / (columns if turn else max(columns - 1, 1))
    period = _SECOND / rate
    between = firing * _SECOND if firing else period * abs(step) / (2 * np.pi)
    if firing:
        step = np.sign(last - first) * 2 * np.pi * between / period
    column, laser = (
        part.ravel() for part in np.divmod(np.arange(columns * len(elevations)), len(elevations))
    )
    after = column * between + laser * channel * _SECOND
    azimuths = first + step * after / between
    angles = np.radians(np.asarray(elevations, dtype=float))
    rays = Rays(
        directions(azimuths, angles[laser]),
        np.round(after).astype(np.int64),
        _from_lowest(angles)[laser],
        (len(angles), columns),
        (float(first), float(step)) if len(angles) == 1 and not angles.any() else None,
    )
    return Pattern(period, len(rays), rays.from_top() if top_first else rays)


def raster(
    rate: float, elevations: Sequence[float], columns: int, azimuths: Sequence[tuple[float, float]]
) -> Pattern:
    """Pattern of a solid-state scanner: a table of rays, fired row after row.

    Args:
        rate: Sweeps per second.
        elevations: Degrees of each row, in the order in which they are fired.
        columns: Rays of a row.
        azimuths: Azimuths in degrees of the first and of the last column. Each further pair is for another
            laser, which fires at the same time. With several lasers, the ring is the number of the laser.
    """
    rows, lasers = len(elevations), len(azimuths)
    first, last = np.array(azimuths).T
    turns = np.radians(np.linspace(first, last, columns))
    angles = np.radians(np.asarray(elevations, dtype=float))
    row, column, laser = (part.ravel() for part in np.indices((rows, columns, lasers)))
    period = _SECOND / rate
    times = np.round((row * columns + column) * (period / (rows * columns))).astype(np.int64)
    rings = _from_lowest(angles)[row] if lasers == 1 else laser.astype(np.uint16)
    rays = Rays(directions(turns[column, laser], angles[row]), times, rings)
    return Pattern(period, len(rays), rays)


def _from_lowest(angles: Array) -> NDArray[np.uint16]:
    """Ring of each laser or row. The lowest is ring 0."""
    return np.argsort(np.argsort(angles, kind="stable"), kind="stable").astype(np.uint16)


def rosette(rate: float, points: int, fov: float, turns: tuple[float, float]) -> Pattern:
    """Pattern of two prisms that turn at different speeds [Liu 2021]. No sweep repeats another.

    Args:
        rate: Sweeps per second.
        points: Rays per second.
        fov: Opening angle of the cone, degrees.
        turns: Turns per second of both prisms. Opposite signs mean opposite directions.
    """
    count = round(points / rate)
    return Pattern(_SECOND / rate, count, make=partial(_rosette_rays, count, points, fov, turns))


def _rosette_rays(count: int, points: int, fov: float, turns: tuple[float, float], number: int) -> Rays:
    after = (number * count + np.arange(count)) / points
    angles = np.radians(fov) / 4 * sum(np.exp(2j * np.pi * each * after) for each in turns)
    off, around = np.abs(angles), np.angle(angles)
    sideways = np.sin(off)
    vectors = np.stack([np.cos(off), sideways * np.cos(around), sideways * np.sin(around)], axis=-1)
    return Rays(vectors, _even_times(count, points), np.zeros(count, np.uint16))


def oscillating(
    rate: float, points: int, elevation: tuple[float, float], turns: float, swings: float, lines: int
) -> Pattern:
    """Pattern of a scanner that turns about z while its beam swings up and down. No sweep repeats another.

    Args:
        rate: Sweeps per second.
        points: Rays per second.
        elevation: Lowest and highest elevation, degrees.
        turns: Turns about z per second.
        swings: Swings per second.
        lines: Lasers that fire in turn, a degree apart in azimuth.
    """
    count = round(points / rate)
    speeds = turns, swings
    make = partial(_oscillating_rays, count, points, elevation, speeds, lines)
    return Pattern(_SECOND / rate, count, make=make)


def _oscillating_rays(
    count: int,
    points: int,
    elevation: tuple[float, float],
    speeds: tuple[float, float],
    lines: int,
    number: int,
) -> Rays:
    low, high = np.radians(elevation)
    after = (number * count + np.arange(count)) / points
    line = np.arange(count) % lines
    swing = np.abs(2 * np.mod(after * speeds[1], 1.0) - 1)
    azimuths = -2 * np.pi * np.mod(after * speeds[0], 1.0) + np.radians(line)
    vectors = directions(azimuths, low + (high - low) * swing)
    return Rays(vectors, _even_times(count, points), line.astype(np.uint16))


def _even_times(count: int, points: int) -> NDArray[np.int64]:
    return np.round(np.arange(count) * (_SECOND / points)).astype(np.int64)


# -- returns

#: Which returns of a beam are reported. ``single``: the beam has no width, so that only its middle counts.
ReturnMode = Literal["single", "strongest", "last", "dual"]
#: Whether the intensity is the reflectivity, or the received power.
IntensityMode = Literal["calibrated", "raw"]
#: Kinds of returns, as Autoware numbers them (``autoware_point_types``, ``ReturnType``).
SINGLE_STRONGEST, SINGLE_LAST = 1, 2
STRONGEST_FIRST, STRONGEST_LAST, WEAK_FIRST, WEAK_LAST, ONLY = 3, 4, 5, 6, 7
#: Two surfaces give two returns if they are farther apart than this, metres.
SEPARATION = 0.4
#: Distance in metres at which raw and calibrated intensity are the same.
_REFERENCE = 1.0


@dataclass(frozen=True)
class Measuring:
    """Properties of a scanner that decide which returns it reports.

    Attributes:
        range: Least and greatest distance in metres.
        returns: Which returns of a beam are reported.
        divergence: Opening angle of a beam, radians.
        noise: Standard deviation of distances, metres.
        dropout: Share of returns that are lost at random.
        range_10: Largest distance in metres at which a surface that reflects 10 % of the light is seen, at a
            right angle. Darker surfaces and surfaces at grazing angles are lost at shorter distances. If
            None, all surfaces are seen.
        intensity: Whether the intensity is the reflectivity, or the received power.
    """

    range: tuple[float, float]
    returns: ReturnMode = "single"
    divergence: float = 0.0
    noise: float = 0.0
    dropout: float = 0.0
    range_10: float | None = None
    intensity: IntensityMode = "calibrated"

    @property
    def beams(self) -> bool:
        """Whether beams have a width."""
        return self.returns != "single" and self.divergence > 0


@dataclass(frozen=True, eq=False)
class Returns:
    """Returns of the rays of a sweep, ordered by ray.

    ``rays``: (P,) numbers of the rays. ``kinds``: (P,) uint8, such as :data:`SINGLE_STRONGEST`. ``ranges``,
    ``measured``: (P,) true and measured distance, metres. ``surfaces``, ``triangles``: (P,) numbers of the
    surfaces, and indices of the triangles in them. ``intensities``: (P,) 0 to 1, reflected light as a share
    of that of a white surface at a right angle. Raw intensity is divided by the squared distance, and has no
    upper bound.
    """

    rays: Indices
    kinds: NDArray[np.uint8]
    ranges: Array
    measured: Array
    intensities: Array
    surfaces: NDArray[np.int32]
    triangles: NDArray[np.int32]

    def take(self, chosen: Any) -> Returns:
        """The chosen returns."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in self.__dataclass_fields__})


def measure(echoes: Returns, subrays: int, measuring: Measuring, random: np.random.Generator) -> Returns:
    """Compute the returns that a scanner reports.

    Args:
        echoes: A return for each ray that meets a surface, with its true distance, and the share of the light
            that the surface reflects back as intensity.
        subrays: Rays per beam. The number of a beam is the number of a ray divided by ``subrays``.
        measuring: How the scanner measures.
        random: Random numbers of the sweep.
    """
    low, high = measuring.range
    echoes = echoes.take((echoes.ranges >= low) & (echoes.ranges <= high))
    if subrays > 1:
        echoes = _chosen(_merged(echoes, subrays), measuring.returns)
    power = echoes.intensities / np.maximum(echoes.ranges, 1e-6) ** 2
    seen = random.random(len(power)) >= measuring.dropout
    if measuring.range_10 is not None:
        seen &= power >= 0.1 / measuring.range_10**2
    noise = measuring.noise * random.standard_normal(len(power))
    intensities = echoes.intensities if measuring.intensity == "calibrated" else power * _REFERENCE**2
    measured = np.clip(echoes.ranges + noise, low, high)
    return replace(echoes, measured=measured, intensities=intensities).take(seen)


def _merged(echoes: Returns, subrays: int) -> Returns:
    """Merge the rays of each beam: surfaces at about the same distance give one return. The distance of a
    return is the mean, weighted by received power. Its surface is the one with most power."""
    beam = echoes.rays // subrays
    order = np.lexsort((echoes.ranges, beam))
    echoes, beam = replace(echoes, rays=beam).take(order), beam[order]
    if not len(beam):
        return echoes
    first = np.ones(len(beam), dtype=bool)
    first[1:] = (beam[1:] != beam[:-1]) | (np.diff(echoes.ranges) > SEPARATION)
    starts = np.flatnonzero(first)
    power = np.maximum(echoes.intensities, 1e-9) / np.maximum(echoes.ranges, 1e-6) ** 2
    total = np.add.reduceat(power, starts)
    group = np.cumsum(first) - 1
    brightest = np.lexsort((-power, group))[starts]
    return replace(
        echoes.take(brightest),
        ranges=np.add.reduceat(power * echoes.ranges, starts) / total,
        intensities=np.add.reduceat(echoes.intensities, starts) / subrays,
    )


def _chosen(echoes: Returns, mode: ReturnMode) -> Returns:
    """Choose the returns that a mode reports. ``dual``: the strongest and the last return. If these are the
    same, the two strongest, as in Velodyne's manuals."""
    power = echoes.intensities / np.maximum(echoes.ranges, 1e-6) ** 2
    if not len(power):
        return echoes
    by_power = np.lexsort((-power, echoes.rays))
    first = np.ones(len(power), dtype=bool)
    first[1:] = echoes.rays[1:] != echoes.rays[:-1]
    starts = np.flatnonzero(first)
    strongest, last = by_power[starts], np.append(starts[1:], len(power)) - 1
    kinds = np.full(len(power), SINGLE_STRONGEST if mode == "strongest" else SINGLE_LAST, np.uint8)
    if mode != "dual":
        return replace(echoes, kinds=kinds).take(strongest if mode == "strongest" else last)
    several = np.flatnonzero(last > starts)
    other = np.where(strongest == last, by_power[np.minimum(starts + 1, len(power) - 1)], last)[several]
    kinds[:] = ONLY
    ends = strongest[several] == last[several]
    kinds[strongest[several]] = np.where(ends, STRONGEST_LAST, STRONGEST_FIRST)
    kinds[other] = np.where(ends, WEAK_FIRST, WEAK_LAST)
    chosen = np.concatenate([strongest, other])
    return replace(echoes, kinds=kinds).take(chosen[np.argsort(echoes.rays[chosen], kind="stable")])


# -- scanners by name

#: Fields of the points, with the names and the order of the driver. ``scan`` is a sensor_msgs/LaserScan.
Layout = Literal["velodyne", "ouster", "livox", "autoware", "xyzi", "scan"]
#: Whether the stamp of a message is the start or the end of the sweep.
StampOf = Literal["start", "end"]


@dataclass(frozen=True)
class ScannerModel:
    """One scanner, with the figures of its manufacturer.

    ``source``: where the figures come from, then the file of the driver that numbers the rings. ``rate``:
    sweeps per second. ``pattern``: function that makes the scan pattern for a rate. ``range``: least and
    greatest distance, metres. ``noise``: standard deviation of distances, metres. ``divergence_mrad``:
    opening angle of a beam. ``layout``, ``stamp``: what the driver publishes.
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


_PATTERNS: dict[str, Callable[..., Pattern]] = {
    function.__name__: function for function in (spinning, raster, rosette, oscillating)
}


def _model(row: dict[str, Any]) -> ScannerModel:
    settings = dict(row["pattern"])
    make = _PATTERNS[settings.pop("kind")]
    if "count" in settings:
        low, high = settings["elevations"]
        settings["elevations"] = np.linspace(low, high, settings.pop("count")).tolist()
    return ScannerModel(**{**row, "pattern": partial(make, **settings), "range": tuple(row["range"])})


#: All models by name.
MODELS = {name: _model(row) for name, row in read_table("scanners").items()}
