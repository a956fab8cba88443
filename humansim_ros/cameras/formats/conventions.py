"""Find what R and t of a file mean, if its keys do not say it. The views of the cameras decide.

Each reading of the poses gives a rig. Two facts support a rig: its optical axes meet in a point in front of
all cameras, and its cameras are level or upright about one vertical. The evidence of a reading is the
logarithm of its likelihood. Misses and rolls are taken as normally distributed with unknown deviation. Each
measured number that the common point and the vertical do not use up is one degree of freedom. A reading is
sure if its evidence exceeds that of each other reading by :data:`_MARGIN`. Otherwise the warning names both
readings. ``benchmarks/conventions.py`` measures how many readings of random rigs are wrong or doubtful.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from humansim_ros.cameras.formats.base import FLIP, CalibrationFile, RawCamera, SourceLocation
from humansim_ros.errors import warn_about
from humansim_ros.types import Array

#: The cameras of a rig look at a common place if they miss it by at most this fraction of their distance.
_SURE = 0.35
#: A reading is sure if its evidence is larger by at least this: in total, and by the common point alone.
_MARGIN, _CROSSING_MARGIN = 8.0, 2.0
#: Usual misses (fractions of the distance) and rolls (radians) of a real rig, and most degrees of freedom
#: that count.
_MISS, _ROLL, _MOST_FREEDOM = 0.008, 0.05, 9
#: Evidence against a camera that looks away from the common point, and against a rig that looks outwards.
_AWAY, _OUTWARD = 3.0, 3.0
#: The common point is known if the mean square of the sine between two optical axes is above this.
_PARALLEL = 3e-3
#: A camera has an up direction if at least this share of the vertical is in its image plane. Roll that is
#: assumed for a camera without one.
_STEEP, _STEEP_ROLL = 0.3, 0.1


@dataclass(frozen=True)
class FilePose:
    """Rotation and translation as they are in a file.

    ``kind``: ``world`` (x = R X + t), ``camera`` (X = R x + t), ``center`` (x = R (X - t)), ``placed`` (a
    rotation with a position: ``camera`` is more likely than ``center``) or ``shelf`` (like ``center``, with a
    warning only if the views contradict). ``clear``: whether the keys state the kind.
    """

    R: Array
    t: Array
    kind: str
    clear: bool
    locations: Mapping[str, SourceLocation]


class _Reading(NamedTuple):
    """Convention of R and t. ``name``: value of the key ``convention`` that states it. ``apply``: function of
    (R, t) that returns R from world to camera, and the camera centre. ``rare``: evidence against a convention
    that is seldom used."""

    name: str
    text: str
    apply: Callable[[Array, Array], tuple[Array, Array]]
    rare: float = 0.0


_OPENGL = "from the camera to the world with the camera axes of OpenGL (y up, z backward)"
_CENTER = "a rotation from the world and a camera centre (x = R (X - t))"
_READINGS = (
    _Reading("world_to_camera", "from the world to the camera (x = R X + t)", lambda r, t: (r, -r.T @ t)),
    _Reading("camera_to_world", "from the camera to the world (X = R x + t)", lambda r, t: (r.T, t)),
    _Reading("camera_center", _CENTER, lambda r, t: (r, t), 3.0),
    _Reading("transposed", "transposed (x = R^T X + t), as in MATLAB", lambda r, t: (r.T, -r @ t), 3.0),
    _Reading("opengl", _OPENGL, lambda r, t: (FLIP @ r.T, t)),
)
_STATED = {reading.name: index for index, reading in enumerate(_READINGS)}
_STATED |= {"w2c": 0, "opencv": 0, "c2w": 1, "matlab": 3}
#: Conventions that are possible for each kind of unclear keys. Without evidence, the first one is taken.
_ALLOWED = {
    "world": (0, 1, 2, 3),
    "camera": (1, 4, 0),
    "center": (2, 1, 4),
    "placed": (1, 2, 4),
    "shelf": (2, 0, 1, 3),
}


def resolved(
    file: CalibrationFile, cameras: Mapping[str, RawCamera], poses: Mapping[str, FilePose]
) -> dict[str, RawCamera]:
    """Return cameras with R and t. The convention of unclear poses is found from the views."""
    if not poses:
        return {}
    reading, said = _reading(file, list(poses.values()))
    if said:
        warn_about(file.path, said)
    posed = {}
    for name, pose in poses.items():
        convention = reading if not pose.clear else _ALLOWED[pose.kind][0]
        r, center = _READINGS[convention].apply(pose.R, pose.t)
        locations = {**cameras[name].locations, **pose.locations}
        camera = replace(cameras[name], R=r, locations=locations)
        posed[name] = (
            replace(camera, t=pose.t, center=None) if convention == 0 else replace(camera, center=center)
        )
    return posed


def _reading(file: CalibrationFile, poses: list[FilePose]) -> tuple[int, str]:
    """Index of the convention of the unclear poses of a file, and a sentence about it."""
    unclear = [pose for pose in poses if not pose.clear]
    if not unclear:
        return 0, ""
    kind = unclear[0].kind
    first = _ALLOWED[kind][0]
    stated = str(file.get("convention") or file.get(0, "convention") or "").strip().lower()
    if stated in _STATED:
        return _STATED[stated], ""
    keys = " and ".join(
        dict.fromkeys(str(pose_at.key).split(".")[-1] for pose_at in unclear[0].locations.values())
    )
    found = {index: _evidence(unclear, index) for index in _ALLOWED[kind]}
    best, other = sorted(found, key=lambda index: -found[index].total)[:2]
    if found[best].miss > _SURE:
        why = "as in OpenCV" if not first else "as the key says" if first == 1 else "as is usual"
        said = f"taken as {_READINGS[first].text}, {why}; the file does not say it; {_how(first)}"
        return first, "" if kind == "shelf" else f"{keys}: {said}"
    said = f"{keys}: taken as {_READINGS[best].text}, "
    if kind == "shelf" and best == first:
        return first, ""
    margins = found[best].total - found[other].total, found[best].crossing - found[other].crossing
    if margins[0] <= _MARGIN or margins[1] <= _CROSSING_MARGIN:
        misses = f"{found[best].miss:.1%} and {found[other].miss:.1%} of the distance"
        doubt = f"the views do not decide, because the optical axes then meet to {misses}"
        return best, f"{said}but perhaps they are {_READINGS[other].text}: {doubt}; {_how(best, other)}"
    why = "because only then do the cameras look at a common place"
    if best == first:
        why = "because the cameras then look at a common place; the file does not say it"
    return best, f"{said}{why}; {_how(best)}"


def _how(*readings: int) -> str:
    names = " or ".join(f'"{_READINGS[reading].name}"' for reading in readings)
    return f'to state it, add "convention": {names} to the file'


class _Evidence(NamedTuple):
    """Evidence of a reading: by its common point, and in total; and how far the axes miss this point."""

    crossing: float
    total: float
    miss: float


def _evidence(poses: list[FilePose], reading: int) -> _Evidence:
    """Evidence of a reading of poses. The miss is a fraction of the distance of the common point, or of the
    spread of the cameras if the spread is smaller. The miss is infinite for fewer than three cameras, and 1
    for parallel axes."""
    count = len(poses)
    if count < 3:
        return _Evidence(0.0, 0.0, np.inf)
    pairs = [_READINGS[reading].apply(pose.R, pose.t) for pose in poses]
    r, centers = np.array([r for r, _ in pairs]), np.array([center for _, center in pairs])
    miss, away = _crossing(r[:, 2], centers)
    # if OpenGL's camera axes are possible, a rig that looks outwards would be one that looks inwards with
    # them
    outward = np.inf if poses[0].kind in ("camera", "center", "placed") else _OUTWARD + _AWAY * (count - away)
    crossing = _log_likelihood(miss, _MISS, 2 * count - 3) - min(_AWAY * away, outward)
    roll = _log_likelihood(_roll(r), _ROLL, 2 * count - 4) / 2
    rare = 0.0 if reading == _ALLOWED[poses[0].kind][0] else _READINGS[reading].rare
    return _Evidence(crossing, crossing + roll - rare, miss)


def _log_likelihood(error: float, deviation: float, freedom: int) -> float:
    return float(-min(freedom, _MOST_FREEDOM) * np.log(np.hypot(error, deviation)))


def _crossing(forward: Array, centers: Array) -> tuple[float, int]:
    """Find the point nearest to all optical axes (N, 3). Returns the miss, and how many cameras look away
    from the point."""
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    matrix = across.sum(axis=0)
    spread = float(np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if np.linalg.eigvalsh(matrix)[0] <= _PARALLEL * len(centers) or spread == 0:
        return 1.0, 0
    away = np.linalg.solve(matrix, np.einsum("nij,nj->i", across, centers)) - centers
    scale = min(spread, float(np.linalg.norm(away, axis=1).mean()))
    miss = np.sqrt((np.einsum("nij,nj->ni", across, away) ** 2).sum(axis=1).mean())
    return float(miss / max(scale, 1e-12)), int((np.einsum("ni,ni->n", away, forward) <= 0).sum())


def _roll(r: Array) -> float:
    """Root mean square of the rolls of cameras (N, 3, 3) about one vertical, radians. A camera may be upright
    or on its side. The share of cameras that are upside down is added. The roll of a camera that looks along
    the vertical is unknown."""
    rolls = []
    for side in (0, 1):
        vertical = np.linalg.eigh(r[:, side].T @ r[:, side])[1][:, 0]
        up = r[:, 1 - side] @ vertical
        up = up if up.mean() > 0 else -up
        roll = float(np.sqrt(((r[:, side] @ vertical) ** 2).mean()) + (up < -_STEEP).mean())
        rolls.append(max(roll, _STEEP_ROLL) if np.abs(up).mean() < _STEEP else roll)
    return min(rolls)
