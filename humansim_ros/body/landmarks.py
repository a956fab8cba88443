"""Joint centres of a person, told from the inside of its mesh: the middle of limbs, the groin, the neck, the
armpits, the silhouette.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from humansim_ros.body.volume import Volume, solid
from humansim_ros.errors import MeshError, warn_about
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.resources import resource_path
from humansim_ros.types import Array

#: Cubes that a person is tall.
_CUBES = 160
_NO_LIMB = "no limb where a person in a T or A pose has one: stand the mesh upright, arms out or down"
#: All that follows in shares of the height. Where to look for the groin, the neck; what is near the middle.
_GROIN, _NECK, _CORE = (0.3, 0.65), (0.72, 0.93), 0.03
#: Legs are no farther from the middle.
_LEGS = 0.2
#: Bands of equal distance from the finger tip, as wide as this; how far along the arm they go.
_BAND, _REACH = 0.01, 0.56
#: Of these distances from the finger tip: the wrist is within, the forearm is within, no armpit is before.
_WRIST, _FOREARM, _ARMPIT = (0.08, 0.17), (0.2, 0.3), 0.3
#: The arm has become trunk where its section is so many times the forearm's.
_OPENS = 3.0
#: Where a groin and a neck can be; what is outside is hidden under skirts or hair.
_PLAUSIBLE_GROIN, _PLAUSIBLE_NECK = (0.36, 0.56), 0.8


@dataclass(frozen=True)
class Arm:
    """The middle of an arm (K, 3) at ``places`` (K,), distances along it from the finger tip.

    ``wrist``: where it is narrowest; ``armpit``: where it opens into the trunk. ``tip``: (3,).
    """

    places: Array
    middle: Array
    wrist: float
    armpit: float
    tip: Array

    def at(self, place: float) -> Array:
        """The middle (3,) of the arm, ``place`` from its tip."""
        return np.array([np.interp(place, self.places, self.middle[:, k]) for k in range(3)])

    def upper(self) -> tuple[Array, Array, float]:
        """The line through the upper arm: point (3,), direction (3,) to the trunk, place of the point."""
        along = (self.places > 0.29) & (self.places < min(self.armpit - 0.03, 0.38))
        if along.sum() < 3:
            along = (self.places > 0.25) & (self.places < 0.34)
        points = self.middle[along]
        point = points.mean(axis=0)
        direction = np.linalg.svd(points - point)[2][0]
        direction *= 1.0 if direction @ (points[-1] - points[0]) > 0 else -1.0
        return point, direction, float(self.places[along].mean())


@dataclass(frozen=True)
class Measures:
    """What is measured in a body of height 1, y up, facing +z, soles at height 0, its middle at x = 0.

    ``groin``, ``neck``: heights. ``heights`` (Y,) of slices; of each: ``front``, ``back`` (Y,) of the middle;
    ``legs`` (2, Y, 2) x away from the middle, z of the middle of the left and right half. NaN where there is
    nothing. ``arms``: left, right. ``crown``: (3,) middle of the top of the head.
    """

    groin: float
    neck: float
    heights: Array
    front: Array
    back: Array
    legs: Array
    toes: Array
    arms: tuple[Arm, Arm]
    crown: Array

    @property
    def wrist(self) -> float:
        """From the finger tips to where the arms are narrowest."""
        return (self.arms[0].wrist + self.arms[1].wrist) / 2

    @property
    def armpit(self) -> float:
        """From the finger tips to where the arms open into the trunk."""
        return (self.arms[0].armpit + self.arms[1].armpit) / 2

    def depth(self, height: float) -> tuple[float, float]:
        """Front and back of the body's middle at a height."""
        seen = np.isfinite(self.front)
        front, back = (np.interp(height, self.heights[seen], ends[seen]) for ends in (self.front, self.back))
        return float(front), float(back)

    def leg(self, side: int, height: float) -> tuple[float, float]:
        """Middle of a leg (0 left, 1 right) at a height: x away from the middle, z."""
        section = self.legs[side]
        seen = np.isfinite(section[:, 0])
        if not seen.any():
            raise MeshError(_NO_LIMB)
        x, z = (np.interp(height, self.heights[seen], section[seen, k]) for k in range(2))
        return float(x), float(z)


def measure(mesh: Mesh) -> Measures:
    """Measures of a mesh of height 1, y up, facing +z, soles at 0. MeshError where it has no limbs."""
    volume = solid(mesh, 1 / _CUBES)
    filled, size = volume.filled, volume.spacing
    xs, heights, zs = (volume.origin[k] + size * np.arange(filled.shape[k]) for k in range(3))
    groin = _groin(filled.sum(axis=2), xs, heights, size)
    neck, front, back = _trunk(filled, xs, heights, zs, size)
    if not _PLAUSIBLE_GROIN[0] <= groin <= _PLAUSIBLE_GROIN[1]:
        warn_about("mesh", "no groin is seen (a skirt?): hips and spine are at a person's usual heights")
        groin = places()["groin"][0]
    if np.isnan(neck):
        neck = combined("neck", groin)
    return Measures(
        groin,
        neck,
        heights,
        front,
        back,
        np.stack([_legs(filled, sign * xs, heights, zs) for sign in (1.0, -1.0)]),
        np.stack([_toes(mesh.vertices, sign) for sign in (1.0, -1.0)]),
        (_arm(volume, 1.0), _arm(volume, -1.0)),
        mesh.vertices[mesh.vertices[:, 1] > 0.95].mean(axis=0),
    )


def joint_places(measures: Measures) -> dict[str, Array]:
    """Joints (3,) of a body of height 1, by the bone whose head they are, and ``<bone>_end`` of the leaves.

    What the surface shows is measured, what it does not show follows from it as in MakeHuman's people
    (config/body_joints.json): by linear combinations, with the errors that docs/rigging.md lists.
    """
    m = measures
    joints: dict[str, Array] = {}

    def inside(what: str, height: float) -> Array:
        return np.array([0.0, height, combined(f"{what} z", *m.depth(height))])

    for bone in ("sacroiliac", "vl5", "vt3"):
        joints[bone] = inside(bone, combined(f"{bone} y", m.groin, m.neck))
    pelvis = float(joints["sacroiliac"][1])
    root = combined("HumanoidRoot y", pelvis), combined("HumanoidRoot z", *m.depth(pelvis))
    joints["HumanoidRoot"] = np.array([0.0, *root])
    joints["vt3_end"] = np.array([0.0, 1.0, m.crown[2]])
    for side, letter in enumerate("lr"):
        out = np.array([1.0 - 2 * side, 1.0, 1.0])
        hip = combined("hip y", m.groin, m.neck)
        thigh, _ = m.leg(side, m.groin - 0.03)
        knee, ankle = combined("knee y", m.groin), combined("ankle y")
        joints[f"{letter}_hip"] = out * [combined("hip x", thigh), hip, combined("hip z", *m.depth(hip))]
        for bone, height in (("knee", knee), ("ankle", ankle)):
            x, z = m.leg(side, height)
            joints[f"{letter}_{bone}"] = out * [x + combined(f"{bone} x"), height, z + combined(f"{bone} z")]
        joints[f"{letter}_ankle_end"] = m.toes[side]
        arm = m.arms[side]
        wrist = combined("wrist", m.wrist, m.groin, m.neck)
        reach = combined("shoulder", m.armpit)
        elbow = combined("elbow", wrist, reach)
        point, direction, place = arm.upper()
        shoulder = point + (reach - place) * direction + [0.0, *places()["shoulder off"]]
        joints[f"{letter}_shoulder"] = shoulder
        joints[f"{letter}_elbow"] = arm.at(elbow) + np.array([0.0, *places()["elbow off"]])
        joints[f"{letter}_wrist"] = arm.at(wrist)
        joints[f"{letter}_wrist_end"] = arm.tip
        collar = [
            combined(f"collar {axis}", joints["vt3"][k], shoulder[k]) for k, axis in ((1, "y"), (2, "z"))
        ]
        joints[f"{letter}_sternoclavicular"] = out * [combined("collar x"), *collar]
    return joints


@functools.cache
def joint_file() -> Mapping[str, Any]:
    """config/body_joints.json, which tools/assets/fit_joint_places.py makes."""
    loaded: Mapping[str, Any] = json.loads(resource_path("config/body_joints.json").read_text("utf-8"))
    return loaded


def places() -> Mapping[str, list[float]]:
    """Constants and factors of the measures, by what they give."""
    found: Mapping[str, list[float]] = joint_file()["surface"]
    return found


def combined(what: str, *measures: float) -> float:
    """The constant of ``what`` and its factors times the measures."""
    constant, *factors = places()[what]
    return constant + float(np.dot(factors, measures))


def _groin(depth: NDArray[np.integer], xs: Array, heights: Array, size: float) -> float:
    """Height under which the middle is empty: legs may touch, so a dent in depth (X, Y) will do."""
    middle = depth[np.abs(xs) < 1.2 * size].min(axis=0)
    thick = depth[np.abs(xs) < _LEGS].max(axis=0)
    low, row = np.searchsorted(heights, _GROIN)
    while row > low and middle[row] > 0.5 * thick[row]:
        row -= 1
    return float(heights[row] + size / 2)


def _trunk(
    filled: NDArray[np.bool_], xs: Array, heights: Array, zs: Array, size: float
) -> tuple[float, Array, Array]:
    """Height of the neck (NaN if hair hides it), and front and back of the middle (Y,)."""
    front, back, width = (np.full(len(heights), np.nan) for _ in range(3))
    middle, core = np.abs(xs) < 1.2 * size, np.abs(xs) < _CORE
    for row in range(len(heights)):
        number, _ = ndimage.label(filled[:, row])
        own = number[middle]
        own = own[own > 0]
        if not len(own):
            continue
        piece = number == np.bincount(own).argmax()
        across = np.flatnonzero(piece.any(axis=1))
        along = np.flatnonzero(piece[core].any(axis=0))
        width[row] = xs[across[-1]] - xs[across[0]] + size
        back[row], front[row] = zs[along[0]] - size / 2, zs[along[-1]] + size / 2
    if np.isfinite(front).sum() < 0.3 * _CUBES:
        raise MeshError("nothing is where the trunk of a person should be: it must be one body, with a trunk")
    low, high = np.searchsorted(heights, _NECK)
    if np.isnan(width[low:high]).all():
        raise MeshError("the mesh has no head on its trunk")
    row = low + int(np.nanargmin(width[low:high]))
    hidden = width[row] > _PLAUSIBLE_NECK * np.nanmax(width[row:])
    return (np.nan if hidden else float(heights[row])), front, back


def _legs(filled: NDArray[np.bool_], aside: Array, heights: Array, zs: Array) -> Array:
    """Middle (Y, 2) of the filled cubes of one half below the hips: x away from the middle, z."""
    half = filled[(aside > 0) & (aside < _LEGS)]
    count = half.sum(axis=(0, 2)).astype(float)
    count[(count == 0) | (heights > _GROIN[1])] = np.nan
    x = np.einsum("xyz,x->y", half, aside[(aside > 0) & (aside < _LEGS)])
    return np.stack([x / count, np.einsum("xyz,z->y", half, zs) / count], axis=1)


def _toes(vertices: Array, sign: float) -> Array:
    """The foremost point (3,) of a foot, half way up."""
    foot = vertices[(vertices[:, 1] < 0.05) & (vertices[:, 0] * sign > 0)]
    if not len(foot):
        raise MeshError(_NO_LIMB)
    ahead = foot[foot[:, 2] >= foot[:, 2].max() - 0.15 * np.ptp(foot[:, 2])]
    return np.array([ahead[:, 0].mean(), ahead[:, 1].mean(), foot[:, 2].max()])


def _arm(volume: Volume, sign: float) -> Arm:
    """An arm that points anywhere: bands of equal distance through the body from the finger tip go round the
    arm alone, where planes across it would cut the trunk as well.
    """
    cubes, ways = _half(volume, sign)
    points = volume.centres(cubes)
    if not len(points):
        raise MeshError(_NO_LIMB)

    def distances(start: int) -> Array:
        limit = (_REACH + 0.05) / volume.spacing
        found = dijkstra(ways, directed=False, indices=start, limit=limit)
        return np.asarray(found * volume.spacing)

    tip = int(np.argmax(points[:, 0] * sign))
    distance = distances(tip)
    hand, forearm = distance < 0.08, np.abs(distance - 0.2) < 0.03
    if not forearm.any():
        raise MeshError("an arm is not joined to the trunk, or too short: the mesh is in pieces, far apart")
    axis = points[hand].mean(axis=0) - points[forearm].mean(axis=0)
    near = np.flatnonzero(distance < 0.1)
    tip = int(near[np.argmax(points[near] @ axis)])
    distance = distances(tip)
    band = np.minimum(distance / _BAND, _REACH / _BAND).astype(np.intp)
    bands = round(_REACH / _BAND)
    reached = band < bands
    count = np.bincount(band[reached], minlength=bands)[:bands]
    if not count.all():
        raise MeshError("an arm is not joined to the trunk: the mesh is in pieces, far apart")
    middle = np.stack(
        [np.bincount(band[reached], points[reached, k], minlength=bands)[:bands] / count for k in range(3)],
        axis=1,
    )
    place = (np.arange(bands) + 0.5) * _BAND
    hands = (place > _WRIST[0]) & (place < _WRIST[1])
    narrow = float(place[hands][count[hands].argmin()])
    usual = np.median(count[(place > _FOREARM[0]) & (place < _FOREARM[1])])
    opening = np.flatnonzero((place > _ARMPIT) & (count > _OPENS * usual))
    # an arm is about 0.4 of the height long, and no ball
    if not len(opening) or np.ptp(middle[: round(0.36 / _BAND)], axis=0).max() < 0.2:
        raise MeshError(_NO_LIMB)
    first = int(opening[0])
    into = (_OPENS * usual - count[first - 1]) / (count[first] - count[first - 1])
    armpit = float(place[first] - (1 - np.clip(into, 0, 1)) * _BAND)
    return Arm(np.asarray(place), middle, narrow, armpit, points[tip])


def _half(volume: Volume, sign: float) -> tuple[NDArray[np.intp], csr_matrix]:
    """Filled cubes (N, 3) of one half above the knees, and how far they are from their neighbours (N, N)."""
    aside = sign * (volume.origin[0] + volume.spacing * np.arange(volume.filled.shape[0]))
    heights = volume.origin[1] + volume.spacing * np.arange(volume.filled.shape[1])
    half = volume.filled & (aside > -volume.spacing / 2)[:, None, None] & (heights > 0.2)[None, :, None]
    cubes = np.argwhere(half)
    number = np.full(half.shape, -1, dtype=np.int32)
    number[half] = np.arange(len(cubes))
    rows, columns, lengths = [], [], []
    for step in np.ndindex(3, 3, 3):
        way = tuple(k - 1 for k in step)
        if way <= (0, 0, 0):
            continue
        here = number[tuple(slice(max(0, -k), n - max(0, k)) for k, n in zip(way, half.shape, strict=True))]
        there = number[tuple(slice(max(0, k), n + min(0, k)) for k, n in zip(way, half.shape, strict=True))]
        both = (here >= 0) & (there >= 0)
        rows.append(here[both])
        columns.append(there[both])
        lengths.append(np.full(int(both.sum()), np.sqrt(np.abs(way).sum())))
    entries = np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))
    return cubes, csr_matrix(entries, shape=(len(cubes), len(cubes)))
