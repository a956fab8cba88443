"""Estimate the joints of a person from the volume of its mesh: limb centres, groin, neck, armpits.

MakeHuman bodies are recognised by their topology. Their joints come from a table.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError, warn_about
from humansim_ros.files.mesh import Mesh
from humansim_ros.files.reading import read_table
from humansim_ros.types import Array

#: Most voxels of a grid. A person of 160 voxels' height needs a twentieth of them.
_MAX_VOXELS = 20_000_000
#: An inner voxel must have surface in at least this many of six directions.
_SIDES = 5


@dataclass(frozen=True)
class Volume:
    """Voxel grid of a solid.

    ``filled``: (X, Y, Z) whether a voxel is inside or contains surface. ``origin``: (3,) centre of voxel
    0 0 0. ``spacing``: edge length of a voxel.
    """

    filled: NDArray[np.bool_]
    origin: Array
    spacing: float

    def centres(self, voxels: NDArray[np.integer]) -> Array:
        """Centres (N, 3) of voxels (N, 3)."""
        return np.asarray(self.origin + self.spacing * voxels)

    def voxel_of(self, points: Array) -> NDArray[np.intp]:
        """Voxels (N, 3) that contain points (N, 3), or the nearest voxels of the grid."""
        voxels = np.rint((points - self.origin) / self.spacing).astype(np.intp)
        return np.clip(voxels, 0, np.array(self.filled.shape) - 1)


def solid(mesh: Mesh, spacing: float) -> Volume:
    """Fill a mesh with voxels of edge length ``spacing``.

    A voxel is inside under two conditions: in a slice across at least one axis, the surface encloses the
    voxel; and there is surface in at least five of the six axis directions. So the body stays filled in spite
    of holes (an open neck, an empty sleeve). Raises MeshError if there would be too many voxels.
    """
    points = surface_points(mesh, 0.7 * spacing)
    low = spacing * (np.floor(points.min(0) / spacing) - 2)  # same grid left and right
    shape = np.ceil((points.max(0) - low) / spacing).astype(np.int64) + 3
    if np.prod(shape.astype(float)) > _MAX_VOXELS:
        raise MeshError("the mesh is far wider or deeper than a person of its height")
    surface = np.zeros(tuple(shape), dtype=bool)
    surface[tuple(np.rint((points - low) / spacing).astype(np.intp).T)] = True
    sides, enclosed = np.zeros(surface.shape, dtype=np.uint8), np.zeros(surface.shape, dtype=bool)
    plane = scipy.ndimage.generate_binary_structure(2, 1)
    for axis in range(3):
        sides += np.logical_or.accumulate(surface, axis=axis)
        sides += np.flip(np.logical_or.accumulate(np.flip(surface, axis), axis=axis), axis)
        across = np.moveaxis(plane[np.newaxis], 0, axis)
        enclosed |= scipy.ndimage.binary_fill_holes(surface, across)
    return Volume(surface | (enclosed & (sides >= _SIDES)), low, spacing)


def surface_points(mesh: Mesh, spacing: float) -> Array:
    """Sample all faces with points (P, 3), at most ``spacing`` apart."""
    corners = mesh.vertices[mesh.triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.ceil(sides / spacing).astype(np.int64)
    if (parts.astype(float) ** 2 / 2).sum() > _MAX_VOXELS:
        raise MeshError("the mesh has faces far larger than a person's")
    points = [mesh.vertices[np.unique(mesh.triangles)]]
    for count in np.unique(parts[parts > 1]):
        i, j = np.indices((count + 1, count + 1)).reshape(2, -1)
        inside = i + j <= count
        shares = np.stack([i, j, count - i - j], axis=1)[inside] / count
        points.append(np.einsum("pk,nkd->npd", shares, corners[parts == count]).reshape(-1, 3))
    return np.concatenate(points)


#: Height of a person in voxels.
_VOXELS = 160
#: Separate parts: most parts that are joined; smallest part, as a share of the largest part; longest gap, and
#: largest distance between the middles of mirror images, as shares of the height.
_MOST_PARTS, _LEAST_PART, _LONGEST_GAP, _MIRRORED = 20, 2e-3, 0.12, 0.08
_NO_LIMB = "no limb where a T or A pose has one: the mesh must stand upright with the arms out or down"
#: Lengths are shares of the height. Search ranges of groin and neck; half width of the middle slice.
_GROIN, _NECK, _CORE = (0.3, 0.65), (0.72, 0.93), 0.03
#: Maximum distance of the legs from the middle.
_LEGS = 0.2
#: Width of bands of equal distance from the finger tip, and largest distance.
_BAND, _REACH = 0.01, 0.56
#: Distances from the finger tip: ranges of the wrist and of the forearm, and smallest for the armpit.
_WRIST, _FOREARM, _ARMPIT = (0.08, 0.17), (0.2, 0.3), 0.3
#: A section belongs to the trunk if it is larger than the section of the forearm by this factor.
_TRUNK_RATIO = 3.0
#: Plausible range of the groin, and largest width of the neck. Outside these, a skirt or hair hides them.
_PLAUSIBLE_GROIN, _PLAUSIBLE_NECK = (0.36, 0.56), 0.8


@dataclass(frozen=True)
class Arm:
    """Centre line of an arm.

    ``centres``: (K, 3) at ``distances`` (K,) from the finger tip. ``wrist``: distance of the narrowest
    section. ``armpit``: distance of the transition to the trunk. ``tip``: finger tip (3,).
    """

    distances: Array
    centres: Array
    wrist: float
    armpit: float
    tip: Array

    def at(self, distance: float) -> Array:
        """Centre (3,) of the arm at a distance from its tip."""
        return np.array([np.interp(distance, self.distances, self.centres[:, k]) for k in range(3)])

    def upper(self) -> tuple[Array, Array, float]:
        """Line through the upper arm: point (3,), direction (3,) to the trunk, distance of the point."""
        along = (self.distances > 0.29) & (self.distances < min(self.armpit - 0.03, 0.38))
        if along.sum() < 3:
            along = (self.distances > 0.25) & (self.distances < 0.34)
        points = self.centres[along]
        point = points.mean(axis=0)
        direction = np.linalg.svd(points - point)[2][0]
        direction *= 1.0 if direction @ (points[-1] - points[0]) > 0 else -1.0
        return point, direction, float(self.distances[along].mean())


@dataclass(frozen=True)
class Measures:
    """Measurements of a body of height 1, y up, facing +z, soles at height 0, middle at x = 0.

    ``groin``, ``neck``: heights. ``heights``: (Y,) heights of slices. ``front``, ``back``: (Y,) z of the
    trunk in each slice. ``legs``: (2, Y, 2) centres of the left and right leg, as distance from the middle
    and z; NaN where a slice is empty. ``arms``: left, right. ``crown``: (3,) middle of the top of the head.
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
        """Mean distance from the finger tip to the wrist."""
        return (self.arms[0].wrist + self.arms[1].wrist) / 2

    @property
    def armpit(self) -> float:
        """Mean distance from the finger tip to the armpit."""
        return (self.arms[0].armpit + self.arms[1].armpit) / 2

    def depth(self, height: float) -> tuple[float, float]:
        """z of the front and the back of the trunk at a height."""
        valid = np.isfinite(self.front)
        front, back = (
            np.interp(height, self.heights[valid], ends[valid]) for ends in (self.front, self.back)
        )
        return float(front), float(back)

    def leg(self, side: int, height: float) -> tuple[float, float]:
        """Centre of a leg (0 left, 1 right) at a height: distance from the middle, z."""
        section = self.legs[side]
        valid = np.isfinite(section[:, 0])
        if not valid.any():
            raise MeshError(_NO_LIMB)
        x, z = (np.interp(height, self.heights[valid], section[valid, k]) for k in range(2))
        return float(x), float(z)


def measure(mesh: Mesh) -> Measures:
    """Measure a mesh of height 1, y up, facing +z, soles at 0. Raises MeshError if it has no limbs. Limbs
    that do not touch the trunk are joined to it, with a warning. Other separate parts are ignored."""
    whole = solid(mesh, 1 / _VOXELS)
    volume, gaps = joined_parts(whole, pairs_only=True)
    try:
        measures = _measure(mesh, whole, volume)
    except MeshError:
        volume, gaps = joined_parts(whole, pairs_only=False)
        measures = _measure(mesh, whole, volume)
    if gaps:
        several = f"{len(gaps)} parts of the body are"
        parts = f"{several if len(gaps) > 1 else 'a part of the body is'} separate"
        gap = f"{max(gaps):.1%} of the height: joined to find the joints; look at the result"
        warn_about("mesh", f"{parts}, with gaps of up to {gap}")
    return measures


def joined_parts(volume: Volume, *, pairs_only: bool) -> tuple[Volume, list[float]]:
    """The largest part of a volume, joined by bridges to parts that belong to it and are near. Returns one
    connected volume, and the length of each bridge. ``volume``: a body of height 1 with its middle at x = 0.
    ``pairs_only``: join only parts in the middle or with a mirror image. Limbs have one, a sword has none."""
    label, count = scipy.ndimage.label(volume.filled, structure=np.ones((3, 3, 3)))
    if count < 2:
        return volume, []
    sizes = np.bincount(label.ravel())
    sizes[0] = 0
    body = label == sizes.argmax()
    order = np.argsort(-sizes)[1 : 1 + _MOST_PARTS]
    parts = [np.argwhere(label == n) for n in order if sizes[n] >= _LEAST_PART * sizes.max()]
    if pairs_only:
        parts = [part for part in parts if _belongs(volume.centres(part), map(volume.centres, parts))]
    gaps: list[float] = []
    while parts:
        tree = scipy.spatial.cKDTree(np.argwhere(body))
        found = [tree.query(part) for part in parts]
        nearest = int(np.argmin([distance.min() for distance, _ in found]))
        distance, place = found[nearest]
        gap = float(distance.min()) * volume.spacing
        if gap > _LONGEST_GAP:
            break
        part = parts.pop(nearest)
        start, end = part[distance.argmin()], tree.data[place[distance.argmin()]]
        steps = np.linspace(0.0, 1.0, int(np.ceil(distance.min())) + 1)[:, None]
        line = np.rint((1 - steps) * start + steps * end).astype(np.intp)
        body[tuple(part.T)] = True
        for offset in np.argwhere(np.ones((3, 3, 3))) - 1:
            body[tuple(np.clip(line + offset, 0, np.array(body.shape) - 1).T)] = True
        gaps.append(gap)
    return Volume(body, volume.origin, volume.spacing), gaps


def _belongs(part: Array, parts: Iterable[Array]) -> bool:
    """Whether points (N, 3) of a part are in the middle of the body, or mirror another part."""
    low, high = part[:, 0].min(), part[:, 0].max()
    if low < 0 < high:
        return True
    mirrored = part.mean(axis=0) * [-1.0, 1.0, 1.0]
    return any(
        np.linalg.norm(other.mean(axis=0) - mirrored) < _MIRRORED and 0.7 < len(other) / len(part) < 1.4
        for other in parts
    )


def _measure(mesh: Mesh, whole: Volume, volume: Volume) -> Measures:
    """Measure a mesh of height 1. Raises MeshError if it has no limbs.

    ``whole``: volume of the mesh. ``volume``: its parts that belong to the body, with bridges between them.
    """
    filled, size = whole.filled & volume.filled, volume.spacing  # slices are measured without the bridges
    xs, heights, zs = (volume.origin[k] + size * np.arange(filled.shape[k]) for k in range(3))
    slices = _Slices(filled, xs, heights, zs, size)
    groin = slices.groin()
    neck, front, back = slices.trunk()
    if not _PLAUSIBLE_GROIN[0] <= groin <= _PLAUSIBLE_GROIN[1]:
        warn_about("mesh", "no groin detected (a skirt?): hips and spine are set to average heights")
        groin = coefficients()["groin"][0]
    if np.isnan(neck):
        neck = predict("neck", groin)
    legs, toes = np.stack([slices.leg(1.0), slices.leg(-1.0)]), [_toes(mesh.vertices, s) for s in (1.0, -1.0)]
    crown = mesh.vertices[mesh.vertices[:, 1] > 0.95].mean(axis=0)
    arms = _arm(volume, 1.0), _arm(volume, -1.0)
    return Measures(groin, neck, heights, front, back, legs, np.stack(toes), arms, crown)


def joint_positions(measures: Measures) -> dict[str, Array]:
    """Joint positions (3,) of a body of height 1. The key is the bone that begins at the joint, or
    ``<bone>_end`` at a leaf. The positions are linear functions of the measurements, fitted to MakeHuman
    bodies (config/body_joints.json). docs/rigging.md lists the errors."""
    m = measures
    joints: dict[str, Array] = {}

    def in_trunk(what: str, height: float) -> Array:
        return np.array([0.0, height, predict(f"{what} z", *m.depth(height))])

    for bone in ("sacroiliac", "vl5", "vt3"):
        joints[bone] = in_trunk(bone, predict(f"{bone} y", m.groin, m.neck))
    pelvis = float(joints["sacroiliac"][1])
    root = predict("HumanoidRoot y", pelvis), predict("HumanoidRoot z", *m.depth(pelvis))
    joints["HumanoidRoot"] = np.array([0.0, *root])
    joints["vt3_end"] = np.array([0.0, 1.0, m.crown[2]])
    for side, letter in enumerate("lr"):
        out = np.array([1.0 - 2 * side, 1.0, 1.0])
        hip = predict("hip y", m.groin, m.neck)
        thigh, _ = m.leg(side, m.groin - 0.03)
        knee, ankle = predict("knee y", m.groin), predict("ankle y")
        joints[f"{letter}_hip"] = out * [predict("hip x", thigh), hip, predict("hip z", *m.depth(hip))]
        for bone, height in (("knee", knee), ("ankle", ankle)):
            x, z = m.leg(side, height)
            joints[f"{letter}_{bone}"] = out * [x + predict(f"{bone} x"), height, z + predict(f"{bone} z")]
        joints[f"{letter}_ankle_end"] = m.toes[side]
        arm = m.arms[side]
        wrist = predict("wrist", m.wrist, m.groin, m.neck)
        reach = predict("shoulder", m.armpit)
        elbow = predict("elbow", wrist, reach)
        point, direction, distance = arm.upper()
        shoulder = point + (reach - distance) * direction + [0.0, *coefficients()["shoulder off"]]
        joints[f"{letter}_shoulder"] = shoulder
        joints[f"{letter}_elbow"] = arm.at(elbow) + np.array([0.0, *coefficients()["elbow off"]])
        joints[f"{letter}_wrist"] = arm.at(wrist)
        joints[f"{letter}_wrist_end"] = arm.tip
        collar = [predict(f"collar {a}", joints["vt3"][k], shoulder[k]) for k, a in ((1, "y"), (2, "z"))]
        joints[f"{letter}_sternoclavicular"] = out * [predict("collar x"), *collar]
    return joints


def joint_file() -> Mapping[str, Any]:
    """Content of config/body_joints.json, written by tools/assets/fit_joint_places.py."""
    table: Mapping[str, Any] = read_table("body_joints")
    return table


def coefficients() -> Mapping[str, list[float]]:
    """Constant and factors of each predicted quantity."""
    table: Mapping[str, list[float]] = joint_file()["surface"]
    return table


def predict(what: str, *measurements: float) -> float:
    """Linear prediction: constant of a quantity plus its factors times the measurements."""
    constant, *factors = coefficients()[what]
    return constant + float(np.dot(factors, measurements))


@dataclass(frozen=True)
class _Slices:
    """Horizontal slices of a body of height 1. ``filled``: (X, Y, Z) voxels inside. ``xs``, ``heights``,
    ``zs``: positions of the voxels from right to left (X,), upwards (Y,), from back to front (Z,). ``size``:
    edge of a voxel."""

    filled: NDArray[np.bool_]
    xs: Array
    heights: Array
    zs: Array
    size: float

    def groin(self) -> float:
        """Height below which the middle is empty, or thinner than the legs at its sides (since legs may
        touch)."""
        depth = self.filled.sum(axis=2)
        middle = depth[np.abs(self.xs) < 1.2 * self.size].min(axis=0)
        thick = depth[np.abs(self.xs) < _LEGS].max(axis=0)
        low, row = np.searchsorted(self.heights, _GROIN)
        while row > low and middle[row] > 0.5 * thick[row]:
            row -= 1
        return float(self.heights[row] + self.size / 2)

    def trunk(self) -> tuple[float, Array, Array]:
        """Height of the neck (NaN if hair hides it), and front and back (Y,) of the trunk."""
        xs, zs, size = self.xs, self.zs, self.size
        front, back, width = (np.full(len(self.heights), np.nan) for _ in range(3))
        middle, core = np.abs(xs) < 1.2 * size, np.abs(xs) < _CORE
        for row in range(len(self.heights)):
            number, _ = scipy.ndimage.label(self.filled[:, row])
            labels = number[middle]
            labels = labels[labels > 0]
            if not len(labels):
                continue
            piece = number == np.bincount(labels).argmax()
            across = np.flatnonzero(piece.any(axis=1))
            along = np.flatnonzero(piece[core].any(axis=0))
            width[row] = xs[across[-1]] - xs[across[0]] + size
            back[row], front[row] = zs[along[0]] - size / 2, zs[along[-1]] + size / 2
        if np.isfinite(front).sum() < 0.3 * _VOXELS:
            raise MeshError("no trunk detected: the mesh must be one body with a trunk")
        low, high = np.searchsorted(self.heights, _NECK)
        if np.isnan(width[low:high]).all():
            raise MeshError("no head detected on the trunk")
        row = low + int(np.nanargmin(width[low:high]))
        hidden = width[row] > _PLAUSIBLE_NECK * np.nanmax(width[row:])
        return (np.nan if hidden else float(self.heights[row])), front, back

    def leg(self, sign: float) -> Array:
        """Centres (Y, 2) of the filled voxels of one half below the hips: distance from the middle, z."""
        aside = sign * self.xs
        chosen = (aside > 0) & (aside < _LEGS)
        half = self.filled[chosen]
        count = half.sum(axis=(0, 2)).astype(float)
        count[(count == 0) | (self.heights > _GROIN[1])] = np.nan
        sums = np.einsum("xyz,x->y", half, aside[chosen]), np.einsum("xyz,z->y", half, self.zs)
        return np.stack(sums, axis=1) / count[:, None]


def _toes(vertices: Array, sign: float) -> Array:
    """Foremost point (3,) of a foot, at half its height."""
    foot = vertices[(vertices[:, 1] < 0.05) & (vertices[:, 0] * sign > 0)]
    if not len(foot):
        raise MeshError(_NO_LIMB)
    ahead = foot[foot[:, 2] >= foot[:, 2].max() - 0.15 * np.ptp(foot[:, 2])]
    return np.array([ahead[:, 0].mean(), ahead[:, 1].mean(), foot[:, 2].max()])


def _arm(volume: Volume, sign: float) -> Arm:
    """Measure an arm in any direction, in bands of equal distance through the body from the finger tip. A
    band contains only the arm. A plane across the arm would cut the trunk too."""
    voxels, graph = _half(volume, sign)
    points = volume.centres(voxels)
    if not len(points):
        raise MeshError(_NO_LIMB)

    def distances(start: int) -> Array:
        limit = (_REACH + 0.05) / volume.spacing
        lengths = scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=start, limit=limit)
        return np.asarray(lengths * volume.spacing)

    tip = int(np.argmax(points[:, 0] * sign))
    distance = distances(tip)
    hand, forearm = distance < 0.08, np.abs(distance - 0.2) < 0.03
    if not forearm.any():
        raise MeshError("an arm is too short, or not connected to the trunk")
    axis = points[hand].mean(axis=0) - points[forearm].mean(axis=0)
    near = np.flatnonzero(distance < 0.1)
    tip = int(near[np.argmax(points[near] @ axis)])
    distance = distances(tip)
    band = np.minimum(distance / _BAND, _REACH / _BAND).astype(np.intp)
    bands = round(_REACH / _BAND)
    reached = band < bands
    count = np.bincount(band[reached], minlength=bands)[:bands]
    if not count.all():
        raise MeshError("an arm is not connected to the trunk")
    sums = [np.bincount(band[reached], points[reached, k], minlength=bands)[:bands] for k in range(3)]
    centres = np.stack(sums, axis=1) / count[:, None]
    along = (np.arange(bands) + 0.5) * _BAND
    hands = (along > _WRIST[0]) & (along < _WRIST[1])
    wrist = float(along[hands][count[hands].argmin()])
    section = np.median(count[(along > _FOREARM[0]) & (along < _FOREARM[1])])
    opening = np.flatnonzero((along > _ARMPIT) & (count > _TRUNK_RATIO * section))
    # an arm is elongated, about 0.4 of the height long
    if not len(opening) or np.ptp(centres[: round(0.36 / _BAND)], axis=0).max() < 0.2:
        raise MeshError(_NO_LIMB)
    first = int(opening[0])
    share = (_TRUNK_RATIO * section - count[first - 1]) / (count[first] - count[first - 1])
    armpit = float(along[first] - (1 - np.clip(share, 0, 1)) * _BAND)
    return Arm(np.asarray(along), centres, wrist, armpit, points[tip])


def _half(volume: Volume, sign: float) -> tuple[NDArray[np.intp], csr_matrix]:
    """Filled voxels (N, 3) of one half above the knees, and the distances (N, N) of neighbours, in voxels."""
    aside = sign * (volume.origin[0] + volume.spacing * np.arange(volume.filled.shape[0]))
    heights = volume.origin[1] + volume.spacing * np.arange(volume.filled.shape[1])
    half = volume.filled & (aside > -volume.spacing / 2)[:, None, None] & (heights > 0.2)[None, :, None]
    voxels = np.argwhere(half)
    number = np.full(half.shape, -1, dtype=np.int32)
    number[half] = np.arange(len(voxels))
    rows, columns, lengths = [], [], []
    for step in np.ndindex(3, 3, 3):
        offset = tuple(k - 1 for k in step)
        if offset <= (0, 0, 0):
            continue
        sizes = list(zip(offset, half.shape, strict=True))
        first = number[tuple(slice(max(0, -k), n - max(0, k)) for k, n in sizes)]
        second = number[tuple(slice(max(0, k), n + min(0, k)) for k, n in sizes)]
        both = (first >= 0) & (second >= 0)
        rows.append(first[both])
        columns.append(second[both])
        lengths.append(np.full(int(both.sum()), np.sqrt(np.abs(offset).sum())))
    entries = np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))
    return voxels, csr_matrix(entries, shape=(len(voxels), len(voxels)))


#: Number of vertices of the skin of MakeHuman's base mesh. Eyes, clothes and helpers come after them.
SKIN_VERTICES = 13380


def known_joints(mesh: Mesh) -> dict[str, Array] | None:
    """Joint centres (3,) in the space of the mesh; None if the mesh is no MakeHuman body.

    The key of a joint is the name of the bone that begins there, or ``<bone>_end`` for the end of a leaf. A
    mesh is a MakeHuman body if its first 13380 vertices have the faces of MakeHuman (eyes, clothes and
    helpers may follow). Each joint is a weighted mean of skin vertices around it, valid for every shape and
    every pose of the limbs (tools/assets/fit_joint_places.py).
    """
    if not is_makehuman(mesh):
        return None
    table: dict[str, Any] = joint_file()["makehuman"]
    return {
        name: np.asarray(ring["shares"]) @ mesh.vertices[ring["vertices"]] / sum(ring["shares"])
        for name, ring in table["joints"].items()
    }


def is_makehuman(mesh: Mesh) -> bool:
    """Whether the first vertices and their faces are MakeHuman's skin."""
    table: dict[str, Any] = joint_file()["makehuman"]
    if len(mesh.vertices) < SKIN_VERTICES:
        return False
    body = mesh.faces[(mesh.faces < SKIN_VERTICES).all(axis=1)]
    return bool(len(body) == table["quads"] and body.min() >= 0 and topology(body) == table["faces"])


def topology(faces: NDArray[np.integer]) -> str:
    """Digest of quads (F, 4), whatever the order of the quads, and whichever corner is the first."""
    start = np.argmin(faces, axis=1)
    order = (start[:, None] + np.arange(4)) % 4
    turned = np.take_along_axis(faces, order, axis=1).astype("<i4")
    turned = turned[np.lexsort(turned.T[::-1])]
    return hashlib.sha256(np.ascontiguousarray(turned).tobytes()).hexdigest()
