"""Summary of a motion file, and self-penetration: overlap of capsules that approximate parts of a body."""

from __future__ import annotations

import warnings
from collections import Counter
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import HumansimWarning, MeshError, MotionError
from humansim_ros.files.mesh import Mesh
from humansim_ros.geometry import quaternion_to_matrix, rotate
from humansim_ros.motion.body.kinematics import JointPoses, Motion
from humansim_ros.motion.body.skeleton import Skeleton, hanim_skeleton
from humansim_ros.motion.body.skinning import dominant_bones, without_details
from humansim_ros.motion.files.bvh import PositionChannels
from humansim_ros.motion.files.files import read_motion
from humansim_ros.motion.matching.file_frame import axis_vector
from humansim_ros.motion.matching.joint_tables import JointMatch
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.soles import find_stances, slide_distances
from humansim_ros.motion.pose.world_motion import (
    WorldMotion,
    floor_height,
    playing_warnings,
    posture_warnings,
    to_world,
)
from humansim_ros.types import Array, Indices

#: Bounds, floor and heading are measured in at most this number of frames, spread over the motion.
_MAX_SAMPLES = 2000
#: Feet, limits and penetration are checked in at most this number of frames, from the first on.
_MAX_CHECKED = 4000
#: Headings have a common direction if the length of their mean is at least this value.
_MIN_MEAN_HEADING = 0.3


@dataclass(frozen=True)
class MotionInfo:
    """Summary of a motion file. If ``unknown`` is set, the values from ``table`` on are None, and it is the
    reason.

    File: ``joints`` (without ``end_sites``); ``channel_layouts``: channels in their order, such as
    ``Zrotation Xrotation Yrotation`` -> number of joints; ``positions``: whether position channels replace
    the OFFSET or are added to it; ``position_joints``: joints that have position channels; ``bounds``: lowest
    and highest joint position in file units and axes.

    Person: ``table``, ``found_by``, ``roles`` (role -> joint) and ``missing_bones`` of the joint match;
    ``confidence``: of the joint match or of the up axis, the lower of the two; ``up``, ``facing``: file axes;
    ``rest``: rest pose from which the axes are detected; ``unit``, ``stature``: metres; ``floor``: height of
    the floor on the up axis, file units; ``root_scale``: scale of the root's movement onto the general
    skeleton; ``speed``: mean speed over the floor, m/s; ``travel``: x and y from the first frame to the last;
    ``heading_deg``: mean heading, None if there is no common heading. ``travel`` and ``heading_deg`` are
    relative to the rest pose facing +x, with y to its left.

    ``jumps``: frame to which the person jumps, and distance in metres. ``warnings``: warnings of the reader
    and of the checks.

    From the first ``checked_frames`` frames: ``stances``; ``slide``: mean slide of a standing foot, mm;
    ``limits``: violations of joint limits; ``penetration``: the deepest self-penetration.
    """

    path: str
    frames: int
    frame_time: float
    rate: float
    seconds: float
    joints: int
    end_sites: int
    roots: list[str]
    channels: int
    channel_layouts: dict[str, int]
    positions: str
    position_joints: list[str]
    bounds: list[list[float]]
    table: str | None = None
    found_by: str | None = None
    confidence: float | None = None
    missing_bones: list[str] | None = None
    roles: dict[str, str] | None = None
    up: str | None = None
    facing: str | None = None
    rest: str | None = None
    unit: float | None = None
    unit_name: str | None = None
    stature: float | None = None
    floor: float | None = None
    root_scale: float | None = None
    speed: float | None = None
    travel: list[float] | None = None
    heading_deg: float | None = None
    jumps: list[dict[str, Any]] | None = None
    checked_frames: int | None = None
    stances: int | None = None
    slide: float | None = None
    limits: list[dict[str, Any]] | None = None
    penetration: dict[str, Any] | None = None
    unknown: str | None = None
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The summary as JSON types."""
        return {**asdict(self), "warnings": list(self.warnings)}


@dataclass(frozen=True)
class LoadedMotion:
    """A motion and the warnings of its reader."""

    motion: Motion
    warnings: tuple[str, ...]


def read_with_warnings(path: Path, positions: PositionChannels = "auto") -> LoadedMotion:
    """Read a motion file and collect the warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read_motion(path, positions)
    texts = [str(w.message) for w in caught if issubclass(w.category, HumansimWarning)]
    return LoadedMotion(motion, tuple(texts))


def describe_motion(
    loaded: LoadedMotion,
    table: str | None = None,
    unit: float | None = None,
    up: str | None = None,
    facing: str | None = None,
    min_confidence: float | None = None,
) -> MotionInfo:
    """Summarise a motion. If it has no person, only the file is described.

    Args:
        loaded: The motion and its warnings.
        table, unit, up, facing, min_confidence: The same as in :func:`to_world`.

    Raises:
        MotionError: A given value does not fit the motion.
    """
    for axis in (up, facing):
        if axis is not None:
            axis_vector(axis)
    try:
        world = to_world(loaded.motion, table, unit, up, facing, min_confidence)
    except MotionError as error:
        if table is not None or _is_person(loaded.motion):
            raise  # a given value is the cause
        return MotionInfo(**_file_summary(loaded), unknown=error.message)
    summary = _person_summary(world, hanim_skeleton())
    found = [f"{loaded.motion.path}: {text}" for text in summary.pop("warnings")]
    return MotionInfo(**{**_file_summary(loaded), "warnings": (*loaded.warnings, *found)}, **summary)


def headings(match: JointMatch, poses: JointPoses) -> Array:
    """Headings (N, 2) of the hips: x and y in ``map``. Their length is 1 for upright hips, and smaller for
    tilted hips."""
    hips = quaternion_to_matrix(poses.rotations[:, match.roles["Hips"]])
    return np.asarray(hips[:, :2, 0])


def mean_heading(match: JointMatch, poses: JointPoses) -> float | None:
    """Direction (radians in ``map``) of the mean of :func:`headings`. None if there is no common
    direction."""
    x, y = headings(match, poses).mean(0)
    return float(np.arctan2(y, x)) if np.hypot(x, y) > _MIN_MEAN_HEADING else None


def _is_person(motion: Motion) -> bool:
    try:
        to_world(motion)
    except MotionError:
        return False
    return True


def _sample_frames(frames: int) -> NDArray[np.intp]:
    """Frame numbers spread over a motion."""
    return np.unique(np.linspace(0, frames - 1, _MAX_SAMPLES).astype(np.intp))


def _file_summary(loaded: LoadedMotion) -> dict[str, Any]:
    motion = loaded.motion
    points = motion.world_positions(_sample_frames(motion.n_frames))
    ends = [
        j for j, name in enumerate(motion.joint_names) if name.endswith("_end") and not motion.channels[j]
    ]
    position_joints = [
        name
        for name, channels in zip(motion.joint_names, motion.channels, strict=True)
        if any(channel.endswith("position") for channel in channels)
    ]
    layouts = Counter(
        " ".join(channels) or "none" for j, channels in enumerate(motion.channels) if j not in ends
    )
    return {
        "path": motion.path,
        "frames": motion.n_frames,
        "frame_time": motion.frame_time,
        "rate": 1 / motion.frame_time,
        "seconds": motion.duration,
        "joints": motion.n_joints - len(ends),
        "end_sites": len(ends),
        "roots": [motion.joint_names[j] for j in np.flatnonzero(motion.parents < 0)],
        "channels": motion.values.shape[1],
        "channel_layouts": dict(layouts),
        "positions": motion.positions,
        "position_joints": position_joints,
        "bounds": [points.min((0, 1)).tolist(), points.max((0, 1)).tolist()],
        "warnings": loaded.warnings,
    }


def _person_summary(world: WorldMotion, skeleton: Skeleton) -> dict[str, Any]:
    motion, match, frame = world.motion, world.match, world.frame
    retargeter = Retargeter.fit(world, skeleton)
    samples = _sample_frames(motion.n_frames)
    poses = world.sample(samples * motion.frame_time)
    hips = poses.positions[:, match.roles["Hips"], :2]
    steps = np.linalg.norm(np.diff(hips, axis=0), axis=-1)
    # leave out steps between samples that contain a jump
    steps[np.searchsorted(samples, [jump.frame for jump in world.jumps]) - 1] = 0.0
    distance = steps.sum()
    first, last = np.searchsorted(samples, world.steady_frames[[0, -1]])
    heading = mean_heading(match, poses)
    return {
        "table": match.table,
        "found_by": match.by,
        "confidence": min(match.confidence, frame.confidence),
        "missing_bones": list(match.missing),
        "roles": {role: motion.joint_names[joint] for role, joint in match.roles.items()},
        "up": frame.up,
        "facing": frame.facing,
        "rest": "OFFSETs" if frame.offsets_stand else "straightest frame",
        "unit": frame.unit,
        "unit_name": frame.unit_name,
        "stature": frame.stature,
        "floor": _floor(world),
        "root_scale": retargeter.scale,
        "speed": float(distance / motion.duration) if motion.duration > 0 else 0.0,
        "travel": (hips[last] - hips[first]).tolist(),
        "heading_deg": None if heading is None else float(np.degrees(heading)),
        "jumps": [asdict(jump) for jump in world.jumps],
        "warnings": [*playing_warnings(world), *posture_warnings(world, poses)],
        **_check_summary(world, retargeter),
    }


def _floor(world: WorldMotion) -> float:
    """Height of the floor on the up axis of the file, file units."""
    upward = axis_vector(world.frame.up)
    steady = world.steady_frames
    points = world.motion.world_positions(steady[_sample_frames(len(steady))])
    return floor_height((points @ upward).min(-1)) * float(upward.sum())


def _check_summary(world: WorldMotion, retargeter: Retargeter) -> dict[str, Any]:
    """Check feet, joint limits and penetration on a skeleton."""
    times = world.frame_times[:_MAX_CHECKED]
    poses = world.sample(times)
    posed = retargeter.pose(poses)
    rotations, _ = retargeter.apply(poses)
    skeleton = retargeter.skeleton
    stances = find_stances(skeleton, posed, times)
    return {
        "checked_frames": len(times),
        "stances": len(stances),
        "slide": float(slide_distances(skeleton, posed, stances).mean() * 1e3) if stances else 0.0,
        "limits": [asdict(violation) for violation in load_limits().report(rotations)],
        "penetration": asdict(report_penetration(posed, fit_capsules(skeleton))),
    }


#: Radius as a share of the stature. For the trunk, also half its width. Measured on assets/humans/adult_man.
_RADII = {
    "HumanoidRoot": (0.066, 0.098),
    "sacroiliac": (0.072, 0.089),
    "vl5": (0.069, 0.090),
    "vt3": (0.048, 0.0),
    "shoulder": (0.032, 0.0),
    "elbow": (0.016, 0.0),
    "wrist": (0.018, 0.0),
    "hip": (0.042, 0.0),
    "knee": (0.035, 0.0),
    "ankle": (0.027, 0.0),
}
#: These bones are wider than deep, so they get two capsules side by side.
_TRUNK = ("HumanoidRoot", "sacroiliac", "vl5")
#: This percentage of the vertices of a trunk bone, on either side, are details that do not count as its
#: width.
_DETAIL_PERCENTILE = 5.0
#: A bone with fewer vertices gets no capsule.
_MIN_VERTICES = 8
#: The radius of the capsule of a limb is this percentile of the distances of its vertices from the bone. It
#: was chosen so that depths are nearest to those between convex hulls of the posed parts of
#: assets/humans/adult_man (mean difference 9 mm).
_RADIUS_PERCENTILE = 40.0
#: Capsule pairs times frames that are computed at once. Their vectors fit into the cache of the processor.
_BATCH = 20_000


@dataclass(frozen=True)
class Capsules:
    """C capsules fixed to bones of a skeleton.

    Attributes:
        skeleton: The skeleton.
        bones: (C,) bone index.
        starts: (C, 3) starts of the axes in bone space, metres.
        ends: (C, 3) ends of the axes in bone space, metres.
        radii: (C,) metres.
    """

    skeleton: Skeleton
    bones: Indices
    starts: Array
    ends: Array
    radii: Array

    @cached_property
    def pairs(self) -> Indices:
        """(P, 2) bones that are compared. Bones that are joined are not compared. Here, connectors and
        collars count as the trunk. Bones with capsules that touch at rest are not compared either."""
        return self._pair_table[0]

    @property
    def pair_names(self) -> tuple[tuple[str, str], ...]:
        """Names of :attr:`pairs`."""
        names = self.skeleton.names
        return tuple((names[a], names[b]) for a, b in self.pairs)

    def axes(self, posed: Array) -> tuple[Array, Array]:
        """Starts and ends (N, C, 3) of the axes, in the space of the posed bones (N, B, 4, 4)."""
        frames = posed[:, self.bones]
        starts, ends = (
            rotate(frames[..., :3, :3], points) + frames[..., :3, 3] for points in (self.starts, self.ends)
        )
        return starts, ends

    @cached_property
    def _pair_table(self) -> tuple[Indices, Indices, Indices]:
        """Pairs of bones (P, 2), pairs of capsules (Q, 2) sorted by pair of bones, and the first pair of
        capsules for each (P,)."""
        joined = self._adjacent()
        first, second = np.triu_indices(len(self.bones), 1)
        low, high = np.sort(np.stack([self.bones[first], self.bones[second]]), axis=0)
        order = np.lexsort([high, low])
        capsules, bones = np.stack([first, second], 1)[order], np.stack([low, high], 1)[order]
        apart = ~joined[tuple(bones.T)]
        bones, begins, number = _group_rows(bones[apart])
        capsules = capsules[apart]
        at_rest = _depths(*self.axes(self.skeleton.rest[None]), self.radii, capsules)
        touching = np.maximum.reduceat(at_rest[0], begins) > 0 if len(begins) else np.zeros(0, bool)
        compared = ~touching[number]
        bones, begins, _ = _group_rows(bones[number][compared])
        return bones, capsules[compared], begins

    def _adjacent(self) -> NDArray[np.bool_]:
        """(B, B) whether two bones are the same or joined. Bones without capsules between them are
        skipped."""
        size = len(self.skeleton)
        has = np.isin(np.arange(size), self.bones)
        joined = np.eye(size, dtype=bool)
        for bone, parent in enumerate(self.skeleton.parents):
            while parent >= 0 and not has[parent]:
                parent = self.skeleton.parents[parent]
            if parent >= 0:
                joined[bone, parent] = joined[parent, bone] = True
        return joined


@dataclass(frozen=True)
class PenetrationReport:
    """Penetration of the bones of a body over some frames. ``dataclasses.asdict`` makes JSON types of it.

    Attributes:
        depth_mm: Deepest penetration.
        pair: The two bones of the deepest penetration.
        frame: Frame of the deepest penetration.
        share: Share of the frames in which any pair is deeper than the tolerance.
        tolerance_mm: Depth that is tolerated.
        pairs: Pairs deeper than the tolerance, deepest first, as (bone, bone, deepest mm, share of frames).
    """

    depth_mm: float
    pair: tuple[str, str] | None
    frame: int | None
    share: float
    tolerance_mm: float
    pairs: tuple[tuple[str, str, float, float], ...]


def fit_capsules(skeleton: Skeleton, mesh: Mesh | None = None, weights: csr_matrix | None = None) -> Capsules:
    """Fit capsules to a skeleton and the mesh around it.

    A limb gets one capsule. Its radius is a typical distance of the vertices from their bone. A bone of the
    trunk is not like a cylinder, so it gets two capsules side by side. If there is no ``mesh`` with
    ``weights`` (V, B), the capsules have the radii of an average man of the same stature. Connectors, collars
    and bones without vertices get no capsule.

    Raises:
        MeshError: No bone gets a capsule.
    """
    if mesh is None or weights is None:
        rows = _average_capsules(skeleton)
    else:
        rows = _measured_capsules(skeleton, mesh.vertices, dominant_bones(without_details(weights, skeleton)))
    if not rows:
        raise MeshError("no bone of this skeleton can have a capsule: none is a limb or part of the trunk")
    bones = np.array([bone for bone, *_ in rows], dtype=np.intp)
    inverse = skeleton.rest_inverse[bones]
    starts, ends = (
        rotate(inverse[:, :3, :3], np.array([row[i] for row in rows])) + inverse[:, :3, 3] for i in (1, 2)
    )
    return Capsules(skeleton, bones, starts, ends, np.array([row[3] for row in rows]))


def self_penetration(posed: Array, capsules: Capsules) -> Array:
    """Depth (N, P) in metres by which the bones of each pair penetrate each other, in poses (N, B, 4, 4). The
    pairs are ``capsules.pairs``. A negative depth is the gap between the two bones."""
    bones, pairs, begins = capsules._pair_table
    out = np.empty((len(posed), len(bones)))
    if not len(bones):
        return out
    step = max(1, _BATCH // len(pairs))
    for first in range(0, len(posed), step):
        axes = capsules.axes(posed[first : first + step])
        depths = _depths(*axes, capsules.radii, pairs)
        np.maximum.reduceat(depths, begins, axis=1, out=out[first : first + step])
    return out


def report_penetration(posed: Array, capsules: Capsules, tolerance: float = 0.03) -> PenetrationReport:
    """Summarise :func:`self_penetration` over poses (N, B, 4, 4).

    ``tolerance``: metres. Flesh and clothes yield, and capsules only approximate the body.
    """
    depths = self_penetration(posed, capsules)
    if not depths.size:
        return PenetrationReport(0.0, None, None, 0.0, 1e3 * tolerance, ())
    beyond = depths > tolerance
    deepest = depths.max(0)
    pairs = tuple(
        (*capsules.pair_names[pair], 1e3 * float(deepest[pair]), float(beyond[:, pair].mean()))
        for pair in np.argsort(-deepest)
        if beyond[:, pair].any()
    )
    frame, pair = np.unravel_index(np.argmax(depths), depths.shape)
    share, depth = float(beyond.any(1).mean()), 1e3 * float(depths[frame, pair])
    if depth <= 0:
        return PenetrationReport(0.0, None, None, share, 1e3 * tolerance, pairs)
    return PenetrationReport(depth, capsules.pair_names[int(pair)], int(frame), share, 1e3 * tolerance, pairs)


def segment_distance(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Shortest distances (...) between segments [Ericson 2005, 5.1.9]. A segment may be a point.

    Args:
        a: Starts (..., 3) of the first segments.
        b: Ends (..., 3) of the first segments.
        c: Starts (..., 3) of the second segments.
        d: Ends (..., 3) of the second segments.
    """
    # components go first, since sums of three numbers along the last axis are slow
    ax, bx, cx, dx = (np.moveaxis(p, -1, 0) for p in np.broadcast_arrays(a, b, c, d))
    return _distance(bx - ax, dx - cx, ax - cx)


def _distance(u: Array, v: Array, w: Array) -> Array:
    """Distances (...) of segments with directions u and v. w = a - c is the difference of their starts. All
    are (3, ...)."""
    uu, vv, uv, uw, vw = _dot(u, u), _dot(v, v), _dot(u, v), _dot(u, w), _dot(v, w)
    uu_safe, vv_safe = np.maximum(uu, 1e-18), np.maximum(vv, 1e-18)
    determinant = uu * vv - uv * uv
    # if segments are parallel, any point of the first one is good
    s = np.where(determinant > 1e-12 * uu * vv, (uv * vw - uw * vv) / np.maximum(determinant, 1e-30), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((uv * s + vw) / vv_safe, 0.0, 1.0)
    s = np.clip((uv * t - uw) / uu_safe, 0.0, 1.0)
    between = w + s * u - t * v
    return np.sqrt(_dot(between, between))


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def _depths(starts: Array, ends: Array, radii: Array, pairs: Indices) -> Array:
    """Depths (N, Q) in metres of pairs of capsules. A depth is negative if the capsules do not touch.

    Args:
        starts: Starts of the axes of the capsules, (N, C, 3) metres.
        ends: Ends of the axes, (N, C, 3) metres.
        radii: Radii of the capsules, (C,) metres.
        pairs: Capsules of each pair, (Q, 2).
    """
    along = np.moveaxis(ends - starts, -1, 0)
    start = np.moveaxis(starts, -1, 0)
    first, second = pairs.T
    apart = start.take(first, axis=2) - start.take(second, axis=2)
    distance = _distance(along.take(first, axis=2), along.take(second, axis=2), apart)
    return np.asarray(radii[first] + radii[second] - distance)


def _group_rows(rows: Indices) -> tuple[Indices, Indices, Indices]:
    """Return the distinct rows of sorted rows, the first index of each, and the number of the group of each
    row."""
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (rows[1:] != rows[:-1]).any(1)
    return rows[new], np.flatnonzero(new), np.cumsum(new) - 1


#: A capsule: bone, start and end of the axis in body space, radius.
_CapsuleRow = tuple[int, Array, Array, float]


def _measured_capsules(
    skeleton: Skeleton, vertices: NDArray[np.floating], dominant: Indices
) -> list[_CapsuleRow]:
    trunk_bones = [
        b for b, name in enumerate(skeleton.names) if name in _TRUNK or _without_side(name) == "hip"
    ]
    trunk = vertices[np.isin(dominant, trunk_bones)]
    rows: list[_CapsuleRow] = []
    for bone, name in enumerate(skeleton.names):
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        if name in _TRUNK:
            height = np.sort([head[1], tail[1]])
            points = trunk[(trunk[:, 1] >= height[0]) & (trunk[:, 1] <= height[1])]
            if len(points) >= _MIN_VERTICES:
                low, high = np.percentile(points, [_DETAIL_PERCENTILE, 100 - _DETAIL_PERCENTILE], axis=0)
                low[1], high[1] = height
                half, middle = (high - low) / 2, (high + low) / 2
                rows += _trunk_capsules(bone, middle, half[1], half[2], half[0])
        elif _without_side(name) in _RADII:
            points = vertices[dominant == bone]
            if len(points) >= _MIN_VERTICES:
                distances = segment_distance(points, points, head, tail)
                radius = float(np.percentile(distances, _RADIUS_PERCENTILE))
                rows.append(_limb_capsule(skeleton, bone, radius))
    return rows


def _average_capsules(skeleton: Skeleton) -> list[_CapsuleRow]:
    height = skeleton.tails[:, 1].max() - min(0.0, skeleton.tails[:, 1].min())
    rows: list[_CapsuleRow] = []
    for bone, name in enumerate(skeleton.names):
        if _without_side(name) not in _RADII:
            continue
        radius, width = (height * share for share in _RADII[_without_side(name)])
        if name in _TRUNK:
            middle = (skeleton.heads[bone] + skeleton.tails[bone]) / 2
            rows += _trunk_capsules(bone, middle, skeleton.lengths[bone] / 2, radius, width)
        else:
            rows.append(_limb_capsule(skeleton, bone, radius))
    return rows


def _trunk_capsules(
    bone: int, middle: Array, height: float, radius: float, width: float
) -> list[_CapsuleRow]:
    """Two upright capsules side by side about a middle (3,). ``height`` and ``width`` are half sizes,
    metres."""
    up = np.array([0.0, max(height - radius, 0.0), 0.0])
    offset = np.array([max(width - radius, 0.0), 0.0, 0.0])
    return [(bone, middle + side - up, middle + side + up, radius) for side in (offset, -offset)]


def _limb_capsule(skeleton: Skeleton, bone: int, radius: float) -> _CapsuleRow:
    """A capsule from joint to joint.

    The cap at the end of a limb ends with the bone, and the capsule of the head does not reach into the neck.
    """
    head, tail = skeleton.heads[bone], skeleton.tails[bone]
    inset = (tail - head) * min(0.5, radius / skeleton.lengths[bone])
    if skeleton.names[bone] == "vt3":
        head = head + inset
    if bone in skeleton.ends:
        tail = tail - inset
    return bone, head, tail, radius


def _without_side(name: str) -> str:
    return name[2:] if name[:2] in ("l_", "r_") else name
