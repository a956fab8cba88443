"""Laser scanners of a scene: how they measure, and their poses (docs/scanners.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from humansim_ros.cameras.camera import Trajectory
from humansim_ros.cameras.scanner import (
    MODELS,
    SUBRAYS,
    Layout,
    Measuring,
    Pattern,
    Poses,
    ScannerModel,
    StampOf,
    raster,
    spinning,
)
from humansim_ros.errors import SceneError, in_section
from humansim_ros.geometry import ObjectPose, compose_poses, from_degrees
from humansim_ros.scene.config.config import SceneConfig
from humansim_ros.scene.core.carriers import Carrier, Route, robot_of_mount
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.scanners.keys import MAX_RAYS, MAX_RAYS_PER_SECOND, ScannerConfig
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
        route: Poses of its frame in ``map`` over time; a single one if it stands still or is on a robot.
        mount: The robot that carries it; the pose of ``route`` is then in ``base_link``.
        seed: Seed of noise and drop-outs.
    """

    name: str
    pattern: Pattern
    measuring: Measuring
    layout: Layout
    stamp: StampOf
    route: Route
    mount: Carrier | None = None
    seed: int = 0

    @classmethod
    def build(
        cls, name: str, config: ScannerConfig, source: SceneSource, robot: Carrier | None = None
    ) -> SceneScanner:
        """Create a scanner from its section.

        Args:
            name: Name in the scene.
            config: Section of a scene file.
            source: Finds its trajectory.
            robot: The robot of the scene, if it has one.

        Raises:
            HumansimError: ``key`` is relative to ``scanners``.
        """
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
            route = _route(config, source)
            mount = robot_of_mount(config.mount, robot)
        stamp = config.stamp or model.stamp
        return cls(name, pattern, measuring, layout, stamp, route, mount, config.seed)

    @property
    def moves(self) -> bool:
        """Whether a trajectory or the robot moves it."""
        return self.mount is not None or len(self.route.path.times) > 1

    def poses(self, seconds: Array, robot: Poses | None = None) -> Poses:
        """Poses at scene times (N,) in seconds; one for all if it does not move.

        ``robot``: poses of the body of the robot then; as its settings say if None.
        """
        if self.mount is None:
            times = self.route.speed * (seconds[: None if self.moves else 1] + self.route.offset)
            return Poses(*self.route.path.in_map(times))
        if robot is None:
            robot = poses_of([self.mount.body_at(time) for time in seconds.tolist()])
        place = self.route.path
        return Poses(*compose_poses((robot.positions, robot.rotations), (place.positions, place.rotations)))

    def pose(self, seconds: float, robot: ObjectPose | None = None) -> ObjectPose:
        """Pose in ``map`` at a scene time in seconds.

        ``robot``: pose of the body of the robot then; as its settings say if None.
        """
        here = self.poses(np.array([seconds]), None if robot is None else poses_of([robot]))
        return ObjectPose(here.positions[0], here.rotations[0])


def poses_of(objects: Sequence[ObjectPose]) -> Poses:
    """Poses (N,) of objects, without their sizes."""
    return Poses(np.array([each.position for each in objects]), np.array([each.rotation for each in objects]))


def _model(config: ScannerConfig) -> ScannerModel:
    """Model of a section. Its own pattern as a model without noise."""
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
            lambda rate: raster(rate, own.elevations_deg, own.columns, [own.azimuth_deg]),
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


def _route(config: ScannerConfig, source: SceneSource) -> Route:
    if config.trajectory is not None:
        with in_section("trajectory"):
            return Route.read(config.trajectory, source)
    turn = from_degrees(config.rotation_deg)
    return Route(Trajectory(np.zeros(1), np.array([config.position]), turn.as_quat()[None]))


def build_scanners(
    config: SceneConfig, source: SceneSource, robot: Carrier | None = None
) -> dict[str, SceneScanner]:
    """Create the scanners of a scene by name. Raises HumansimError, which names the key. ``robot``: carries
    the scanners that are mounted on it."""
    with in_section("scanners"):
        for name in config.scanners:
            if name in config.cameras:
                raise SceneError("a camera has this name already", key=name)
        return {
            name: SceneScanner.build(name, section, source, robot)
            for name, section in config.scanners.items()
        }
