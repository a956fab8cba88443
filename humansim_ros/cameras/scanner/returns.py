"""Turn the surfaces that beams meet into what a scanner reports: returns, intensity, noise and drop-outs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from humansim_ros.types import Array, Indices

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
    """How a scanner measures.

    Attributes:
        range: Least and greatest distance in metres.
        returns: Which returns are reported.
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

    Attributes:
        rays: (P,) numbers of the rays.
        kinds: (P,) uint8 kind of each return, such as :data:`SINGLE_STRONGEST`.
        ranges: (P,) true distance, metres.
        measured: (P,) measured distance, metres.
        intensities: (P,) 0 to 1: reflected light as a share of that of a white surface at a right angle. Raw
            intensity is divided by the squared distance, and has no upper bound.
        surfaces: (P,) numbers of the surfaces.
        triangles: (P,) indices of the triangles in their surfaces.
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
        subrays: Rays per beam. Numbers of rays are divided by it to get numbers of beams.
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
