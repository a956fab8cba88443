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
from humansim_ros.motion.pose.contacts import find_stances, slide_distances
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.motion.pose.retarget import Retargeter
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
#: Keys of a summary that are None if the file has no person.
_OF_PERSON = (
    *("table", "found_by", "confidence", "missing_bones", "roles", "up", "facing", "rest", "unit"),
    *("unit_name", "stature", "floor", "root_scale", "speed", "travel", "heading_deg", "jumps"),
    *("checked_frames", "stances", "slide", "limits", "penetration"),
)


def read_with_warnings(path: Path, positions: PositionChannels = "auto") -> tuple[Motion, tuple[str, ...]]:
    """Read a motion file. Returns the motion and the warnings of its reader."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read_motion(path, positions)
    return motion, tuple(str(w.message) for w in caught if issubclass(w.category, HumansimWarning))


def describe_motion(
    motion: Motion,
    reader_warnings: tuple[str, ...] = (),
    table: str | None = None,
    unit: float | None = None,
    up: str | None = None,
    facing: str | None = None,
    min_confidence: float | None = None,
) -> dict[str, Any]:
    """Summarise a motion as JSON types. If it has no person, only the file is described.

    Keys of the file: ``joints`` (without ``end_sites``); ``channel_layouts``: channels in their order, such
    as ``Zrotation Xrotation Yrotation`` -> number of joints; ``positions``: whether position channels replace
    the OFFSET or are added to it; ``position_joints``: joints that have position channels; ``bounds``: lowest
    and highest joint position in file units and axes; ``warnings`` of the reader and of the checks.

    Keys of the person, None if ``unknown`` has the reason why there is none: ``confidence``: of the joint
    match or of the up axis, the lower of the two; ``up``, ``facing``: file axes; ``rest``: rest pose from
    which the axes are detected; ``unit``, ``stature``: metres; ``floor``: height of the floor on the up axis,
    file units; ``root_scale``: scale of the root's movement onto the general skeleton; ``speed``: mean speed
    over the floor, m/s; ``travel``: x and y from the first frame to the last; ``heading_deg``: mean heading,
    None if there is no common heading. ``travel`` and ``heading_deg`` are relative to the rest pose facing
    +x, with y to its left. ``jumps``: frame to which the person jumps, and distance in metres. From the first
    ``checked_frames`` frames: ``stances``; ``slide``: mean slide of a standing foot, mm; ``limits``:
    violations of joint limits; ``penetration``: the deepest self-penetration.

    Args:
        motion: The motion.
        reader_warnings: Warnings of its reader.
        table, unit, up, facing, min_confidence: The same as in :func:`to_world`.

    Raises:
        MotionError: A given value does not fit the motion.
    """
    for axis in (up, facing):
        if axis is not None:
            axis_vector(axis)
    summary, found = dict.fromkeys(_OF_PERSON), list(reader_warnings)
    unknown = None
    try:
        world = to_world(motion, table, unit, up, facing, min_confidence)
    except MotionError as error:
        if table is not None or _is_person(motion):
            raise  # a given value is the cause
        unknown = error.message
    else:
        summary, checks = _person_summary(world, hanim_skeleton())
        found += [f"{motion.path}: {text}" for text in checks]
    return {**_file_summary(motion), **summary, "unknown": unknown, "warnings": found}


def headings(match: JointMatch, poses: JointPoses) -> Array:
    """Headings (N, 2) of the hips: x and y in ``map``. Their length is 1 for upright hips, and smaller for
    tilted hips."""
    hips = quaternion_to_matrix(poses.rotations[:, match.roles["Hips"]])
    return np.asarray(hips[:, :2, 0])


def mean_heading(match: JointMatch, poses: JointPoses) -> float | None:
    """Direction of the mean of :func:`headings`, radians in ``map``. None without a common direction."""
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


def _file_summary(motion: Motion) -> dict[str, Any]:
    points = motion.world_positions(_sample_frames(motion.n_frames))
    joints = list(zip(motion.joint_names, motion.channels, strict=True))
    layouts = [" ".join(channels) for name, channels in joints if channels or not name.endswith("_end")]
    return {
        "path": motion.path,
        "frames": motion.n_frames,
        "frame_time": motion.frame_time,
        "rate": 1 / motion.frame_time,
        "seconds": motion.duration,
        "joints": len(layouts),
        "end_sites": motion.n_joints - len(layouts),
        "roots": [motion.joint_names[j] for j in np.flatnonzero(motion.parents < 0)],
        "channels": motion.values.shape[1],
        "channel_layouts": dict(Counter(layout or "none" for layout in layouts)),
        "positions": motion.positions,
        "position_joints": [name for name, channels in joints if "position" in " ".join(channels)],
        "bounds": [points.min((0, 1)).tolist(), points.max((0, 1)).tolist()],
    }


def _person_summary(world: WorldMotion, skeleton: Skeleton) -> tuple[dict[str, Any], list[str]]:
    """Return the keys of a summary about the person, and warnings."""
    motion, match, frame = world.motion, world.match, world.frame
    retargeter = Retargeter.fit(world, skeleton)
    samples = _sample_frames(motion.n_frames)
    poses = world.sample(samples * motion.frame_time)
    hips = poses.positions[:, match.roles["Hips"], :2]
    steps = np.linalg.norm(np.diff(hips, axis=0), axis=-1)
    # leave out steps between samples that contain a jump
    steps[np.searchsorted(samples, [jump.frame for jump in world.jumps]) - 1] = 0.0
    first, last = np.searchsorted(samples, world.steady_frames[[0, -1]])
    heading = mean_heading(match, poses)
    # feet, joint limits and penetration
    times = world.frame_times[:_MAX_CHECKED]
    checked = world.sample(times)
    posed = retargeter.pose(checked)
    stances = find_stances(skeleton, posed, times)
    summary = {
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
        "speed": float(steps.sum() / motion.duration) if motion.duration > 0 else 0.0,
        "travel": (hips[last] - hips[first]).tolist(),
        "heading_deg": None if heading is None else float(np.degrees(heading)),
        "jumps": [asdict(jump) for jump in world.jumps],
        "checked_frames": len(times),
        "stances": len(stances),
        "slide": float(slide_distances(skeleton, posed, stances).mean() * 1e3) if stances else 0.0,
        "limits": [asdict(violation) for violation in load_limits().report(retargeter.apply(checked)[0])],
        "penetration": asdict(report_penetration(posed, fit_capsules(skeleton))),
    }
    return summary, [*playing_warnings(world), *posture_warnings(world, poses)]


def _floor(world: WorldMotion) -> float:
    """Height of the floor on the up axis of the file, file units."""
    upward = axis_vector(world.frame.up)
    steady = world.steady_frames
    points = world.motion.world_positions(steady[_sample_frames(len(steady))])
    return floor_height((points @ upward).min(-1)) * float(upward.sum())


#: Radii of capsules as shares of the stature; for the trunk, half widths, too. From assets/humans/adult_man.
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

    @property
    def pairs(self) -> Indices:
        """(P, 2) pairs of bones that are compared. Bones that are joined are left out (connectors and collars
        count as the trunk here), and bones with capsules that touch at rest."""
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

    def depths(self, posed: Array, pairs: Indices) -> Array:
        """Depths (N, Q) in metres of pairs (Q, 2) of capsules. Negative if the capsules do not touch."""
        starts, ends = self.axes(posed)
        first, second = pairs.T
        distance = segment_distance(starts[:, first], ends[:, first], starts[:, second], ends[:, second])
        return np.asarray(self.radii[first] + self.radii[second] - distance)

    @cached_property
    def _pair_table(self) -> tuple[Indices, Indices, Indices]:
        """Return three arrays: pairs of bones (P, 2); pairs of capsules (Q, 2), sorted by their pair of
        bones; and the index (P,) of the first pair of capsules of each pair of bones."""
        capsules = np.stack(np.triu_indices(len(self.bones), 1), axis=1)
        bones = np.sort(self.bones[capsules], axis=1)
        order = np.lexsort(bones.T[::-1])
        order = order[~self._adjacent()[tuple(bones[order].T)]]
        capsules, bones = capsules[order], bones[order]
        pairs, number = np.unique(bones, axis=0, return_inverse=True)
        at_rest = np.full(len(pairs), -np.inf)
        np.maximum.at(at_rest, number.ravel(), self.depths(self.skeleton.rest[None], capsules)[0])
        compared = at_rest[number.ravel()] <= 0
        pairs, begins = np.unique(bones[compared], axis=0, return_index=True)
        return pairs, capsules[compared], begins

    def _adjacent(self) -> NDArray[np.bool_]:
        """(B, B) whether two bones are the same, or are joined directly or through bones without capsules."""
        size = len(self.skeleton)
        joined = np.eye(size, dtype=bool)
        for bone, parent in enumerate(self.skeleton.parents):
            while parent >= 0 and parent not in self.bones:
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
    kinds = [name[2:] if name[:2] in ("l_", "r_") else name for name in skeleton.names]
    owners = None if mesh is None or weights is None else dominant_bones(without_details(weights, skeleton))
    trunk = [bone for bone, kind in enumerate(kinds) if kind in (*_TRUNK, "hip")]
    stature = skeleton.tails[:, 1].max() - min(0.0, skeleton.tails[:, 1].min())
    rows: list[tuple[int, Array, Array, float]] = []
    for bone, kind in enumerate(kinds):
        if kind not in _RADII:
            continue
        head, tail = skeleton.heads[bone], skeleton.tails[bone]
        radius, width = (stature * share for share in _RADII[kind])
        middle, half = (head + tail) / 2, np.array([width, skeleton.lengths[bone] / 2, radius])
        if mesh is not None and owners is not None:
            points = mesh.vertices[np.isin(owners, trunk if kind in _TRUNK else bone)]
            if kind in _TRUNK:
                low, high = np.sort([head[1], tail[1]])
                points = points[(points[:, 1] >= low) & (points[:, 1] <= high)]
            if len(points) < _MIN_VERTICES:
                continue
            if kind in _TRUNK:
                sides = np.percentile(points, [_DETAIL_PERCENTILE, 100 - _DETAIL_PERCENTILE], axis=0)
                sides[:, 1] = low, high
                middle, half = sides.mean(axis=0), np.ptp(sides, axis=0) / 2
            else:
                radius = np.percentile(segment_distance(points, points, head, tail), _RADIUS_PERCENTILE)
        if kind in _TRUNK:
            away, up, _ = np.diag(np.maximum(half - half[2], 0.0))
            rows += [(bone, middle + side - up, middle + side + up, half[2]) for side in (away, -away)]
            continue
        # a limb without a limb below ends with its cap; the capsule of the head does not reach into the neck
        inset = (tail - head) * min(0.5, radius / skeleton.lengths[bone])
        start = head + inset if kind == "vt3" else head
        rows.append((bone, start, tail - inset if bone in skeleton.ends else tail, radius))
    if not rows:
        raise MeshError("no bone of this skeleton can have a capsule: none is a limb or part of the trunk")
    bones, starts, ends, radii = (np.array(column) for column in zip(*rows, strict=True))
    inverse = skeleton.rest_inverse[bones]
    starts, ends = (rotate(inverse[:, :3, :3], points) + inverse[:, :3, 3] for points in (starts, ends))
    return Capsules(skeleton, bones, starts, ends, radii)


def self_penetration(posed: Array, capsules: Capsules) -> Array:
    """Depth (N, P) in metres by which the bones of each pair penetrate each other, in poses (N, B, 4, 4). The
    pairs are ``capsules.pairs``. A negative depth is the gap between the two bones."""
    bones, pairs, begins = capsules._pair_table
    out = np.empty((len(posed), len(bones)))
    if not len(bones):
        return out
    step = max(1, _BATCH // len(pairs))
    for first in range(0, len(posed), step):
        depths = capsules.depths(posed[first : first + step], pairs)
        np.maximum.reduceat(depths, begins, axis=1, out=out[first : first + step])
    return out


def report_penetration(posed: Array, capsules: Capsules, tolerance: float = 0.03) -> PenetrationReport:
    """Summarise :func:`self_penetration` over poses (N, B, 4, 4).

    ``tolerance``: metres. Flesh and clothes yield, and capsules only approximate the body.
    """
    depths = self_penetration(posed, capsules)
    beyond, deepest = depths > tolerance, depths.max(0, initial=0.0)
    pairs = tuple(
        (*capsules.pair_names[pair], 1e3 * float(deepest[pair]), float(beyond[:, pair].mean()))
        for pair in np.argsort(-deepest)
        if beyond[:, pair].any()
    )
    depth, share = float(deepest.max(initial=0.0)), float(beyond.any(1).mean()) if depths.size else 0.0
    where: tuple[tuple[str, str] | None, int | None] = None, None
    if depth > 0:
        frame, pair = np.unravel_index(np.argmax(depths), depths.shape)
        where = capsules.pair_names[int(pair)], int(frame)
    return PenetrationReport(1e3 * depth, *where, share, 1e3 * tolerance, pairs)


def segment_distance(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Shortest distances (...) between segments [Ericson 2005, 5.1.9]. A segment may be a point.

    Args:
        a: Starts (..., 3) of the first segments.
        b: Ends (..., 3) of the first segments.
        c: Starts (..., 3) of the second segments.
        d: Ends (..., 3) of the second segments.
    """
    # components go first, since sums of three numbers along the last axis are slow
    a, b, c, d = (np.moveaxis(points, -1, 0) for points in np.broadcast_arrays(a, b, c, d))
    u, v, w = b - a, d - c, a - c
    uu, vv, uv, uw, vw = ((p * q).sum(axis=0) for p, q in ((u, u), (v, v), (u, v), (u, w), (v, w)))
    uu_safe, vv_safe = np.maximum(uu, 1e-18), np.maximum(vv, 1e-18)
    determinant = uu * vv - uv * uv
    # if segments are parallel, any point of the first one is good
    s = np.where(determinant > 1e-12 * uu * vv, (uv * vw - uw * vv) / np.maximum(determinant, 1e-30), 0.0)
    s = np.clip(s, 0.0, 1.0)
    t = np.clip((uv * s + vw) / vv_safe, 0.0, 1.0)
    s = np.clip((uv * t - uw) / uu_safe, 0.0, 1.0)
    between = w + s * u - t * v
    return np.asarray(np.sqrt((between * between).sum(axis=0)))
