"""Laser scanners of a scene: how they measure, and their poses (docs/scanners.md)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from humansim_ros.camera.trajectory import Trajectory
from humansim_ros.errors import SceneError, in_section
from humansim_ros.scanner.casting import Poses
from humansim_ros.scanner.models import MODELS, Layout, ScannerModel, StampOf
from humansim_ros.scanner.pattern import SUBRAYS, Pattern, raster, spinning
from humansim_ros.scanner.returns import Measuring
from humansim_ros.scene.config import SceneConfig
from humansim_ros.scene.scanner_config import MAX_RAYS, MAX_RAYS_PER_SECOND, ScannerConfig
from humansim_ros.scene.source import SceneSource
from humansim_ros.types import Array


@dataclass(frozen=True, eq=False)
class SceneScanner:
    """A laser scanner of a scene.

    Attributes:
        name: Name in the scene.
        pattern: Its rays.
        measuring: How it measures.
        layout: Fields of its points.
        stamp: Whether stamps are of the start or of the end of a sweep.
        path: Poses of its frame in ``map`` over time; a single one if it stands still.
        offset: Time that the path is ahead of the scene, seconds.
        speed: Seconds of the path per second.
        seed: Seed of noise and drop-outs.
    """

    name: str
    pattern: Pattern
    measuring: Measuring
    layout: Layout
    stamp: StampOf
    path: Trajectory
    offset: float = 0.0
    speed: float = 1.0
    seed: int = 0

    @classmethod
    def build(cls, name: str, config: ScannerConfig, source: SceneSource) -> SceneScanner:
        """Create a scanner from its section. Raises HumansimError; ``key`` is relative to ``scanners``."""
        with in_section(name):
            model = _model(config)
            rate = model.rate if config.rate is None else config.rate
            pattern = model.pattern(rate)
            _check(pattern, config)
            layout = config.layout or model.layout
            if layout == "scan" and _azimuths(pattern) is None:
                raise SceneError("a LaserScan is of one laser at elevation 0", key="layout")
            divergence = config.divergence_mrad or model.divergence_mrad
            measuring = Measuring(
                config.range or model.range,
                config.returns,
                divergence * 1e-3,
                model.noise if config.noise is None else config.noise,
                config.dropout,
                config.range_10,
                config.intensity,
            )
            path, offset, speed = _path(config, source)
        stamp = config.stamp or model.stamp
        return cls(name, pattern, measuring, layout, stamp, path, offset, speed, config.seed)

    @property
    def moves(self) -> bool:
        """Whether a trajectory moves it."""
        return len(self.path.times) > 1

    def poses(self, seconds: Array) -> Poses:
        """Poses at scene times (N,) in seconds; one for all if it does not move."""
        times = self.speed * (seconds[: None if self.moves else 1] + self.offset)
        return Poses(*self.path.in_map(times))


def _model(config: ScannerConfig) -> ScannerModel:
    """Model of a section; its own pattern as a model without noise."""
    if config.model is not None:
        return MODELS[config.model]
    own = config.pattern
    assert own is not None and config.rate is not None and config.range is not None
    rays = own.columns * len(own.elevations_deg)
    _check_count(rays, config.rate, "pattern.columns")
    if own.kind == "raster":
        return ScannerModel(
            "pattern",
            "scene",
            config.rate,
            lambda rate: raster(rate, own.elevations_deg, own.columns, own.azimuth_deg),
            config.range,
            0.0,
        )
    times = own.firing_us * 1e-6, own.channel_us * 1e-6
    return ScannerModel(
        "pattern",
        "scene",
        config.rate,
        lambda rate: spinning(rate, own.elevations_deg, own.columns, own.azimuth_deg, *times),
        config.range,
        0.0,
    )


def _check(pattern: Pattern, config: ScannerConfig) -> None:
    """Raise SceneError if a sweep has too many rays, or takes longer than the time to the next."""
    key = "rate" if config.pattern is None else "pattern.columns"
    subrays = SUBRAYS if config.returns != "single" else 1
    _check_count(pattern.count * subrays, 1e9 / pattern.period, key if subrays == 1 else "returns")
    if pattern.count == 0:
        raise SceneError("a sweep has no time for a ray: lower the rate", key="rate")
    if pattern.repeated is not None and pattern.repeated.times[-1] >= pattern.period:
        took, period = pattern.repeated.times[-1] * 1e-6, pattern.period * 1e-6
        raise SceneError(
            f"a sweep takes {took:.6g} ms, but the next one starts after {period:.6g} ms: use fewer columns, "
            "less time between them, or a lower rate",
            key=key,
        )


def _check_count(rays: int, rate: float, key: str) -> None:
    if rays > MAX_RAYS or rays * rate > MAX_RAYS_PER_SECOND:
        raise SceneError(
            f"{rays} rays a sweep and {rays * rate:.3g} a second are too many: at most {MAX_RAYS} and "
            f"{MAX_RAYS_PER_SECOND}",
            key=key,
        )


def _azimuths(pattern: Pattern) -> tuple[float, float] | None:
    return None if pattern.repeated is None else pattern.repeated.azimuths


def _path(config: ScannerConfig, source: SceneSource) -> tuple[Trajectory, float, float]:
    """Path of a scanner, and its offset and speed."""
    if config.trajectory is not None:
        with in_section("trajectory.file"):
            path = Trajectory.read(source.find_url(config.trajectory.file), config.trajectory.end)
        return path, config.trajectory.offset, config.trajectory.speed
    turn = scipy.spatial.transform.Rotation.from_euler("xyz", config.rotation_deg, degrees=True)
    return Trajectory(np.zeros(1), np.array([config.position]), turn.as_quat()[None]), 0.0, 1.0


def build_scanners(config: SceneConfig, source: SceneSource) -> dict[str, SceneScanner]:
    """Create the scanners of a scene by name. Raises HumansimError with the key."""
    with in_section("scanners"):
        for name in config.scanners:
            if name in config.cameras:
                raise SceneError("a camera has this name already", key=name)
        return {name: SceneScanner.build(name, section, source) for name, section in config.scanners.items()}
