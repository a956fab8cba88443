"""Laser scanners of a scene and their sweeps (docs/scanners.md)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Trajectory
from humansim_ros.cameras.scanner import (
    MODELS,
    SINGLE_STRONGEST,
    SUBRAYS,
    Hits,
    Layout,
    Measuring,
    MovingTriangles,
    Pattern,
    Poses,
    Rays,
    Returns,
    ScannerModel,
    Shot,
    StampOf,
    measure,
    raster,
    reflectivity,
    spinning,
)
from humansim_ros.cameras.sensor import generator
from humansim_ros.errors import SceneError, in_section
from humansim_ros.files.mesh import Mesh
from humansim_ros.geometry import ObjectPose, compose_poses, from_degrees
from humansim_ros.render.interface import Body, check_bodies
from humansim_ros.scene.core.features import Draft
from humansim_ros.scene.core.findings import CheckedFeature, Finding, SceneSamples, misplaced
from humansim_ros.scene.core.objects import Robot, Route, robot_of_mount
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.core.state import SceneState
from humansim_ros.scene.features.robot import ROBOT
from humansim_ros.scene.features.scanners import MAX_RAYS, MAX_RAYS_PER_SECOND, ScannerConfig
from humansim_ros.types import Array, Float32Array, FloatArray, Indices


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
    mount: Robot | None = None
    seed: int = 0

    @classmethod
    def build(
        cls, name: str, config: ScannerConfig, source: SceneSource, robot: Robot | None = None
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

    def scanning(self, scene: Scene) -> Scanning:
        """What makes its sweeps in a scene."""
        return Scanning(scene, self)

    @property
    def moves(self) -> bool:
        """Whether a trajectory or the robot moves it."""
        return self.mount is not None or len(self.route.path.times) > 1

    def poses(self, seconds: Array, robot: Poses | None = None) -> Poses:
        """Poses at scene times (N,) in seconds; one for all times if the scanner does not move. ``robot``:
        poses of the body of the robot at these times; if None, the robot computes them."""
        if self.mount is None:
            times = self.route.speed * (seconds[: None if self.moves else 1] + self.route.offset)
            return Poses(*self.route.path.in_map(times))
        if robot is None:
            robot = poses_of([self.mount.body_at(time) for time in seconds.tolist()])
        place = self.route.path
        return Poses(*compose_poses((robot.positions, robot.rotations), (place.positions, place.rotations)))

    def pose(self, seconds: float, robot: ObjectPose | None = None) -> ObjectPose:
        """Pose in ``map`` at a scene time in seconds. ``robot``: as in :meth:`poses`."""
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
    times = own.firing_us * 1e-6, own.channel_us * 1e-6

    def pattern(rate: float) -> Pattern:
        if own.kind == "raster":
            return raster(rate, own.elevations_deg, own.columns, [own.azimuth_deg])
        return spinning(rate, own.elevations_deg, own.columns, own.azimuth_deg, *times)

    return ScannerModel("pattern", "scene", config.rate, pattern, config.range, 0.0)


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


#: Speed in m/s above which a body has jumped, and the step of the vertices by which it is measured.
_FASTEST, _SAMPLED = 25.0, 64
#: Poses of a scanner at times (N,) in nanoseconds from the start of a sweep.
_PosesAt: TypeAlias = Callable[[NDArray[np.int64]], Poses]


@dataclass(frozen=True, eq=False)
class Sweep:
    """What a scanner measures in one sweep. Its P points are in the order in which they are fired.

    Each point is in the frame of the scanner at its own firing, as drivers publish it.

    Attributes:
        number: Number of the sweep, from 0.
        start: Stamp of its start, nanoseconds.
        end: Stamp of its end, at which the next one starts.
        stamp: Stamp of its message: one of the two.
        rays: All its rays.
        returns: Returns of rays that measure something.
        instances: (P,) uint16 instance labels; 0 for surfaces without.
        parts: (P,) uint8 part labels; 0 without a part.
        position: (3,) of the scanner in ``map`` at ``stamp``, metres.
        rotation: (4,) quaternion xyzw.
    """

    number: int
    start: int
    end: int
    stamp: int
    rays: Rays
    returns: Returns
    instances: NDArray[np.uint16]
    parts: NDArray[np.uint8]
    position: Array
    rotation: Array

    @property
    def points(self) -> Array:
        """(P, 3) measured points, metres."""
        return np.asarray(self.rays.directions[self.returns.rays] * self.returns.measured[:, None])

    @property
    def true_points(self) -> Array:
        """(P, 3) points of the surfaces, without noise."""
        return np.asarray(self.rays.directions[self.returns.rays] * self.returns.ranges[:, None])

    @property
    def times(self) -> NDArray[np.int64]:
        """(P,) nanoseconds from the start of the sweep to the firing of each point."""
        return self.rays.times[self.returns.rays]


class Scanning:
    """Makes the sweeps of one scanner from the states of a scene.

    Between the frames of the scene, vertices of humans and objects move in straight lines, and so does a
    robot. The scanner follows its trajectory, or the robot. What stands still is met once, and cached, if the
    scanner stands still, too.

    Args:
        scene: The scene.
        scanner: One of its scanners.
    """

    def __init__(self, scene: Scene, scanner: SceneScanner) -> None:
        self.scene, self.scanner = scene, scanner
        #: Rays of the last sweep and of its beams; what these meet that stands still, and the light of it.
        self._beams: tuple[Rays, Rays] | None = None
        self._static: tuple[Rays, Hits, Array] | None = None
        self._triangles: dict[int, tuple[Mesh, Indices]] = {}

    def due(self, after: int, until: int) -> range:
        """Numbers of the sweeps that end after one scene time, and not after another, nanoseconds."""
        pattern = self.scanner.pattern
        first = max(0, int(after / pattern.period) - 1)
        while pattern.start(first + 1) <= after:
            first += 1
        last = first
        while pattern.start(last + 1) <= until:
            last += 1
        return range(first, last)

    def sweep(self, number: int, states: Sequence[SceneState], origin: int) -> Sweep:
        """Make a sweep.

        Args:
            number: Number of the sweep.
            states: States of the scene in order, the first one at or before its start, the last at or after
                its end.
            origin: Stamp of the start of sweep 0, nanoseconds.

        Raises:
            RenderError: A vertex is not finite.
            SceneError: The scanner is within a mesh of many triangles.
        """
        for state in states:
            check_bodies(state.bodies)
        scanner, pattern = self.scanner, self.scanner.pattern
        start, end = origin + pattern.start(number), origin + pattern.start(number + 1)
        rays = pattern.rays(number)
        beams = self._spread(rays)
        stamps = np.array([state.stamp - start for state in states], dtype=float)
        seconds = np.array([state.scene_time for state in states]) * 1e-9

        robot = None if scanner.mount is None else _robot_path(states, stamps)

        def poses(times: NDArray[np.int64]) -> Poses:
            carrier = None if robot is None else Poses(*robot.in_map((times - stamps[0]) * 1e-9))
            return scanner.poses(np.interp(times, stamps, seconds), carrier)

        hits = self._meet(beams, poses, states, start)
        light = self._light(beams, hits, states[0])
        random = generator(scanner.seed, scanner.name, pattern.start(number))
        returns = measure(_echoes(hits, light), len(beams) // len(rays), scanner.measuring, random)
        instances, parts = _labels(returns, states[0])
        stamp = end if scanner.stamp == "end" else start
        here = poses(np.array([stamp - start]))
        return Sweep(
            *(number, start, end, stamp, rays, returns, instances, parts),
            here.positions[0],
            here.rotations[0],
        )

    def _spread(self, rays: Rays) -> Rays:
        """Rays of the beams of a sweep."""
        if not self.scanner.measuring.beams:
            return rays
        if self._beams is None or self._beams[0] is not rays:
            self._beams = rays, rays.spread(self.scanner.measuring.divergence)
        return self._beams[1]

    def _meet(self, rays: Rays, poses: _PosesAt, states: Sequence[SceneState], start: int) -> Hits:
        """Nearest surfaces of all rays."""
        moves = self.scanner.moves
        hits = Hits.none(len(rays)) if moves else self._static_hits(rays, poses, states[0])
        static = self._still(states[0]) if moves else []
        moving = len(states[0].bodies) - len(self.scene.static_bodies)
        for before, after in pairwise(states):
            ends = np.array([before.stamp - start, after.stamp - start])
            first, last = np.searchsorted(rays.times, ends).tolist()
            if first == last:
                continue
            chosen = slice(first, last)
            times = rays.times[chosen]
            shares = (times - ends[0]) / (ends[1] - ends[0])
            shot = Shot(rays.directions[chosen], shares, poses(times), rays.index(chosen))
            reach = _FASTEST * (after.stamp - before.stamp) * 1e-9
            bodies = [
                MovingTriangles(number, self._corners(a.mesh), a.vertices, _end_of(a, b, reach))
                for number, (a, b) in enumerate(zip(before.bodies[:moving], after.bodies, strict=False))
            ]
            shot.cast([*bodies, *static], hits.take(chosen))
        return hits

    def _still(self, state: SceneState) -> list[MovingTriangles]:
        """Surfaces that stand still."""
        still = self.scene.static_bodies
        first = len(state.bodies) - len(still)
        surfaces: list[tuple[Mesh, FloatArray]] = [
            *((body.mesh, body.vertices) for body in still),
            *((mesh, mesh.vertices) for mesh in self.scene.static_meshes),
        ]
        return [
            MovingTriangles(number, self._corners(mesh), vertices, vertices)
            for number, (mesh, vertices) in enumerate(surfaces, first)
        ]

    def _corners(self, mesh: Mesh) -> Indices:
        """Triangles of a mesh as indices of the machine, in which arrays are taken in half the time."""
        known = self._triangles.get(id(mesh))
        if known is None or known[0] is not mesh:
            known = self._triangles[id(mesh)] = mesh, mesh.triangles.astype(np.intp)
        return known[1]

    def _static_hits(self, rays: Rays, poses: _PosesAt, state: SceneState) -> Hits:
        """Hits of a static scanner on static surfaces, cached."""
        if self._static is None or self._static[0] is not rays:
            hits, here = Hits.none(len(rays)), poses(rays.times[:1])
            whole = slice(0, len(rays))
            shot = Shot(rays.directions, np.zeros(len(rays)), here, rays.index(whole))
            surfaces = self._still(state)
            if surfaces:
                joined, firsts = _joined(surfaces)
                shot.cast([joined], hits)
                of = np.searchsorted(firsts, hits.triangles, side="right") - 1
                met = hits.surfaces >= 0
                hits.surfaces[met] = of[met] + surfaces[0].number
                hits.triangles[met] -= firsts[of[met]].astype(np.int32)
            meshes = [*(body.mesh for body in state.bodies), *self.scene.static_meshes]
            self._static = rays, hits, _reflected(meshes, hits, np.arange(len(rays)))
        return self._static[1].copy()

    def _light(self, rays: Rays, hits: Hits, state: SceneState) -> Array:
        """Share of the light (N,) that the surfaces reflect back along the rays."""
        meshes = [*(body.mesh for body in state.bodies), *self.scene.static_meshes]
        if self._static is None or self._static[0] is not rays:
            return _reflected(meshes, hits, np.arange(len(rays)))
        _, static, light = self._static
        light = light.copy()
        changed = np.flatnonzero(hits.ranges != static.ranges)
        light[changed] = _reflected(meshes, hits, changed)
        return light


def _end_of(before: Body, after: Body, reach: float) -> Float32Array:
    """Vertices at the end of an interval. Those at its start if the body has jumped, such as to the start of
    its motion. ``reach``: metres that a body moves at most."""
    moved = np.abs(after.vertices[::_SAMPLED] - before.vertices[::_SAMPLED]).max()
    return after.vertices if moved <= reach else before.vertices


def _joined(surfaces: Sequence[MovingTriangles]) -> tuple[MovingTriangles, Indices]:
    """Surfaces that stand still as one, and the number of the first triangle of each."""
    vertices = np.cumsum([0, *(len(surface.start) for surface in surfaces)])
    triangles = np.concatenate([each.triangles + vertices[i] for i, each in enumerate(surfaces)])
    corners = np.concatenate([surface.start for surface in surfaces])
    firsts = np.cumsum([0, *(len(surface.triangles) for surface in surfaces)])
    return MovingTriangles(0, triangles, corners, corners), firsts[:-1]


def _robot_path(states: Sequence[SceneState], stamps: Array) -> Trajectory:
    """Path of the body of the robot between states; ``stamps``: (S,) nanoseconds from a start.

    As tf2 interpolates: positions linearly, rotations by slerp.
    """
    bodies = poses_of([state.objects[ROBOT] for state in states])
    return Trajectory(stamps * 1e-9, bodies.positions, bodies.rotations)


def _reflected(meshes: Sequence[Mesh], hits: Hits, rays: Indices) -> Array:
    """Share of the light that comes back along some rays; 0 for rays that meet nothing."""
    light = np.zeros(len(rays))
    order = np.argsort(hits.surfaces[rays], kind="stable")
    numbers, starts = np.unique(hits.surfaces[rays][order], return_index=True)
    for number, group in zip(numbers.tolist(), np.split(order, starts[1:]), strict=False):
        if number >= 0:
            found = hits.take(rays[group])
            light[group] = reflectivity(meshes[number], found.triangles, found.weights)
            light[group] *= found.cosines
    return light


def _echoes(hits: Hits, light: Array) -> Returns:
    """A return for each ray that meets a surface."""
    rays = np.flatnonzero(hits.surfaces >= 0)
    kinds = np.full(len(rays), SINGLE_STRONGEST, np.uint8)
    ranges = hits.ranges[rays]
    return Returns(rays, kinds, ranges, ranges, light[rays], hits.surfaces[rays], hits.triangles[rays])


class LiveScanning:
    """Makes the sweeps of a scanner while the states of a scene arrive.

    Sweeps are counted in stamps: sweep 0 starts with the scene. After a jump of the stamps it starts anew.

    Args:
        scene: The scene.
        scanner: One of its scanners.
    """

    def __init__(self, scene: Scene, scanner: SceneScanner) -> None:
        self._scanning = Scanning(scene, scanner)
        self._longest_gap = round(1e9 * max(1.0, 3 * scene.period))
        self._states: deque[SceneState] = deque()
        self._origin = 0

    def sweeps(self, state: SceneState, wanted: bool = True) -> Iterator[Sweep]:
        """Sweeps that have ended with a state, the newest one of the scene. ``wanted``: whether anybody needs
        them. They are not made otherwise."""
        last = self._states[-1] if self._states else None
        gap = 0 if last is None else state.stamp - last.stamp
        if last is not None and gap == 0:
            return  # the same frame again
        if last is None or not 0 < gap < self._longest_gap or last.is_preview != state.is_preview:
            self._states.clear()
            self._states.append(state)
            # the stamp of the start of the scene; live, speed and jumps of the scene do not change the turns
            self._origin = state.stamp - state.scene_time
            return
        self._states.append(state)
        pattern, origin = self._scanning.scanner.pattern, self._origin
        for number in self._scanning.due(last.stamp - origin, state.stamp - origin):
            start = origin + pattern.start(number)
            if self._states[0].stamp <= start and wanted:
                first = max(i for i, each in enumerate(self._states) if each.stamp <= start)
                yield self._scanning.sweep(number, list(self._states)[first:], origin)
        oldest = state.stamp - pattern.period
        while len(self._states) > 1 and self._states[1].stamp <= oldest:
            self._states.popleft()


def _labels(returns: Returns, state: SceneState) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Labels of the instance and of the part of each return."""
    instances = np.zeros(len(returns.rays), np.uint16)
    parts = np.zeros(len(returns.rays), np.uint8)
    for number, body in enumerate(state.bodies):
        chosen = returns.surfaces == number
        instances[chosen] = body.instance
        parts[chosen] = body.parts[returns.triangles[chosen]]
    return instances, parts


#: Flesh around joints, metres, and degrees of azimuth that rays may be apart.
_FLESH, _APART = 0.15, 5.0


class Scanners(CheckedFeature):
    """The section ``scanners``."""

    def furnish(self, draft: Draft) -> None:
        """Add the scanners."""
        with in_section("scanners"):
            draft.scanners = {
                name: SceneScanner.build(name, section, draft.source, draft.robot)
                for name, section in draft.config.scanners.items()
            }

    def check(self, samples: SceneSamples) -> Iterator[Finding]:
        """Find scanners that are in something, or that never meet anybody."""
        for name, scanner in samples.scene.scanners.items():
            poses = scanner.poses(samples.times)
            is_driven = samples.scene.config.scanners[name].trajectory is not None
            key = f"scanners.{name}.{'trajectory.file' if is_driven else 'position'}"
            if found := misplaced(f"scanner {name}", poses.positions, samples, samples.obstacles):
                yield Finding("error", key, found)
                continue
            if len(samples.joints) < max(1, len(samples.scene.actors)):
                continue  # another node may move somebody to the scanner
            if not any(_meets(scanner, poses, joints) for joints in samples.joints.values()):
                low, high = scanner.measuring.range
                text = (
                    f"scanner {name} never meets anybody in the first {samples.duration:.0f} s, by its "
                    f"angles and {low:g} to {high:g} m: turn or move it"
                )
                yield Finding("error", key, text)


def _meets(scanner: SceneScanner, poses: Poses, joints: Array) -> bool:
    """Whether rays point at the space around joints (N, J, 3) at any of the times of the poses."""
    offsets = joints - poses.positions[:, None]
    flat = offsets.reshape(-1, 3)
    seen = Poses(*(np.repeat(part, joints.shape[1], axis=0) for part in (poses.positions, poses.rotations)))
    x, y, z = np.moveaxis((poses if poses.still else seen).to_scanner(flat).reshape(offsets.shape), -1, 0)
    distance = np.hypot(x, y)
    low, high = scanner.measuring.range
    near = (distance + _FLESH >= low) & (distance - _FLESH <= high)
    rays = scanner.pattern.rays(0).directions
    beams = np.unique(np.rint(np.degrees(np.arctan2(rays[:, 1], rays[:, 0])) / _APART))
    near &= np.isin(np.rint(np.degrees(np.arctan2(y, x)) / _APART), beams)
    slopes = rays[:, 2] / np.maximum(np.hypot(rays[:, 0], rays[:, 1]), 1e-9)
    # the lowest and the highest ray at the distance of the person, who fills the height between its joints
    lowest, highest = slopes.min() * distance - _FLESH, slopes.max() * distance + _FLESH
    meets = (z.min(axis=1)[:, None] <= highest) & (z.max(axis=1)[:, None] >= lowest)
    return bool((near & meets).any())


FEATURE = Scanners()
