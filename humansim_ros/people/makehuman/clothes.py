"""Geometry of clothes, shoes and hair: parts of the body surface, cut along borders and offset."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import splu
from scipy.spatial import ConvexHull

from humansim_ros.people.makehuman.data import VertexIndices
from humansim_ros.people.makehuman.shape import BEARDS, Beard, Cut, Dress
from humansim_ros.people.makehuman.skeleton import Bones, limit_weights
from humansim_ros.people.makehuman.surface import (
    NONE,
    SHIRT,
    SHOES,
    TROUSERS,
    BodySurface,
    Outline,
    around,
    mean_matrix,
    neighbours,
    noise,
    outline,
    push_outwards,
    ramp,
    shrink_onto,
    smooth_rows,
    smooth_towards,
    vertex_normals,
)
from humansim_ros.types import Array

_ROUNDS = 400
#: Cloth follows hollows up to the first depth, and spans hollows from the second depth on, metres.
_FOLLOWS, _SPANS = 0.022, 0.040


def taut_shirt(mesh: BodySurface, trunk: BodyRegions, vertices: Array) -> Array:
    """Offsets (V, 3) from ``vertices`` (V, 3), this body in the T pose, to a taut shirt. Zero for bodies
    without hollows deeper than ``_FOLLOWS``."""
    bones = [trunk.bones.index(name) for name in ("HumanoidRoot", "sacroiliac", "vl5")]
    on_trunk = (mesh.weights[:, bones].sum(axis=1) > 0.9) & (mesh.part == 0)
    top = trunk.shoulder_y - 0.025
    loose = ramp(trunk.above_belt(vertices), 0.0, 0.06) * ramp(vertices[:, 1], top, top - 0.06)
    loose = np.where(on_trunk, loose, 0.0)
    rows = np.flatnonzero(loose > 0)
    faces = mesh.faces[on_trunk[mesh.faces].all(axis=1)]
    axis = float((vertices[rows, 2].min() + vertices[rows, 2].max()) / 2)
    outline = Outline.of(vertices, faces, axis)
    graph = neighbours(faces, len(vertices))
    mean = mean_matrix(graph)
    cloth = shrink_onto(vertices, mean, loose, outline, _ROUNDS)

    below, above = around(vertices[rows], axis)[1], around(cloth[rows], axis)[1]
    hollow: Array = np.zeros(len(vertices))
    hollow[rows] = np.maximum(above - outline.at(cloth[rows]), outline.at(vertices[rows]) - below)
    # remove hollows of one vertex
    hollow = _neighbour_maximum(graph, -_neighbour_maximum(graph, -hollow))
    share = ramp(hollow, _FOLLOWS, _SPANS)
    for _ in range(6):  # extend the region to neighbours
        share = np.maximum(share, 0.97 * _neighbour_maximum(graph, share))
    for _ in range(8):
        share[rows] = 0.5 * share[rows] + 0.5 * (mean @ share)[rows]
    return np.where(loose > 0, share, 0.0)[:, None] * (cloth - vertices)


def _neighbour_maximum(graph: sparse.csr_matrix, values: Array) -> Array:
    """Largest value (V,) among each vertex and its neighbours."""
    largest = values.copy()
    np.maximum.at(largest, np.repeat(np.arange(len(values)), np.diff(graph.indptr)), values[graph.indices])
    return largest


SHOE_MARGIN = 0.007  # metres, as all lengths here
SOLE_THICKNESS = 0.014
CLOTH_SMOOTHING = 0.022
TROUSER_LEG = 0.060  # radius at the hem


@dataclass(frozen=True)
class BodyRegions:
    """Regions of clothes and hair on the naked body in the T pose (metres, bare soles at y = 0). Each region
    is a method from points (N, 3) to signed values (N,), similar to distances and positive inside."""

    bones: Bones
    eye: Array
    eye_radius: float
    ear: Array
    skull_top: float
    cut: Cut = field(default_factory=Cut)
    dress: Dress = field(default_factory=Dress)

    def _head(self, name: str) -> Array:
        return self.bones.heads[self.bones.index(name)]

    @property
    def belt_height(self) -> float:
        """Height of the belt."""
        return 0.6 * self._head("sacroiliac")[1] + 0.4 * self._head("vl5")[1]

    @property
    def ankle_height(self) -> float:
        """Height of the upper edge of shoes."""
        return self._head("l_ankle")[1] - 0.005

    @property
    def hem_height(self) -> float:
        """Height of the trouser hem."""
        return float(np.interp(self.cut.hem, (0, 1, 2), (self.ankle_height, self.knee_y, self.hip_y)))

    @property
    def sleeve_end(self) -> float:
        """x of the end of the left sleeve."""
        if self.cut.sleeves == "long":
            return float(self._head("l_wrist")[0] - 0.012)
        if self.cut.sleeves == "none":
            return float(self.shoulder_x + 0.008)
        return float(0.45 * self._head("l_shoulder")[0] + 0.55 * self._head("l_elbow")[0])

    @property
    def shoulder_x(self) -> float:
        """x of the left shoulder joint."""
        return float(self._head("l_shoulder")[0])

    @property
    def shoulder_y(self) -> float:
        """Height of the shoulder joints."""
        return float(self._head("l_shoulder")[1])

    @property
    def foot(self) -> tuple[Array, Array]:
        """Left ankle and tip of the toes."""
        ankle = self.bones.index("l_ankle")
        return self.bones.heads[ankle], self.bones.tails[ankle]

    @property
    def foot_length(self) -> float:
        """Distance from the ankle to the tip of the toes."""
        ankle, toe = self.foot
        return float(np.linalg.norm(toe - ankle))

    @property
    def hip_y(self) -> float:
        """Height of the hip joints."""
        return float(self._head("l_hip")[1])

    @property
    def knee_y(self) -> float:
        """Height of the knee joints."""
        return float(self._head("l_knee")[1])

    def _leg(self, p: Array, axis: int) -> Array:
        joints = np.array([self._head(f"l_{part}") for part in ("ankle", "knee", "hip")])
        return np.interp(p[:, 1], joints[:, 1], joints[:, axis])

    def leg_x(self, p: Array) -> Array:
        """|x| (N,) of the centre of the leg at the height of each point."""
        return self._leg(p, 0)

    def leg_z(self, p: Array) -> Array:
        """z (N,) of the centre of the leg at the height of each point."""
        return self._leg(p, 2)

    def above_belt(self, p: Array) -> Array:
        """Region above the belt."""
        return p[:, 1] - 0.12 * p[:, 2] - self.belt_height + 0.012

    def above_edge(self, p: Array) -> Array:
        """Region above the lower edge of the garment of the upper body."""
        return self.above_belt(p) + self.cut.drop

    def above_neckline(self, p: Array) -> Array:
        """Region above the neckline."""
        nape = self._head("vt3")
        line = nape[1] - 0.022 - 0.42 * (p[:, 2] - nape[2] + 0.05) + 0.60 * (np.hypot(p[:, 0], 0.06) - 0.06)
        return p[:, 1] - line

    def below_sleeve_end(self, p: Array) -> Array:
        """Region of the arms beyond the sleeves."""
        return np.abs(p[:, 0]) - self.sleeve_end

    def above_hem(self, p: Array) -> Array:
        """Region above the trouser hems."""
        return p[:, 1] - self.hem_height

    def above_shoes(self, p: Array) -> Array:
        """Region above footwear that covers the feet."""
        return p[:, 1] - self.ankle_height - self.cut.shaft

    @property
    def borders(self) -> tuple[Callable[[Array], Array], ...]:
        """Regions that have an edge of clothes as their border, where their value is zero."""
        edges = self.above_edge, self.above_neckline, self.below_sleeve_end, self.above_hem
        apart = self.cut.covers and (self.cut.hem > 0 or self.cut.shaft > 0)
        return (*edges, self.above_shoes) if apart else edges

    def garment(self, fields: Array) -> VertexIndices:
        """Garment (N,) at points, such as SHIRT. ``fields``: values (N, K) of the borders at the points."""
        edge, neck, sleeve, hem = fields.T[:4]
        shoes = fields[:, -1] < 0 if self.cut.covers else np.zeros(len(fields), bool)
        bare = (neck > 0) | (sleeve > 0)
        return np.select([shoes, hem < 0, edge < 0, ~bare], [SHOES, NONE, TROUSERS, SHIRT], NONE)

    def hair(self, p: Array) -> Array:
        """Region above the hairline: forehead, temples, around the ears, nape."""
        eye, ear = self.eye, self.ear
        if self.cut.hair == "none":
            return np.full(len(p), -1.0)
        knots = np.array(
            [
                [ear[2] - 0.13, ear[1] - 0.045],  # nape
                [ear[2] - 0.035, ear[1] - 0.035],
                [ear[2] + 0.012, ear[1] - 0.015],  # sideburn
                [ear[2] + 0.03, ear[1] + 0.012],
                [ear[2] + 0.045, eye[1] + 0.035],  # temple
                [ear[2] + 0.075, eye[1] + 0.066],
                [eye[2] + 0.05, eye[1] + 0.062],  # forehead
            ]
        )
        if not self.long_hair:
            return p[:, 1] - np.interp(p[:, 2], *knots.T)
        knots[5:, 1] -= 0.010  # a fringe
        cap = p[:, 1] - np.interp(p[:, 2], *knots.T)
        # over the ears, down to the chin
        edge = ear[2] + 0.030 - 0.10 * (ear[1] - p[:, 1]).clip(0)
        outside = np.hypot(p[:, 0], p[:, 2] - ear[2] - 0.010) - 0.042  # not in the mouth
        return np.maximum(cap, np.minimum.reduce([edge - p[:, 2], p[:, 1] - self.hair_end, outside]))

    @property
    def long_hair(self) -> bool:
        """Whether hair is draped over the ears."""
        return self.cut.hair == "long"

    def beard(self, p: Array, beard: Beard) -> Array:
        """Thickness (N,) of a beard."""
        eye = self.eye
        side, up = np.abs(p[:, 0]), p[:, 1] - eye[1]
        front = ramp(p[:, 2], self.ear[2] + 0.005, self.ear[2] + 0.03)
        low = ramp(up, -0.155, -0.135)
        lip = np.hypot(side / 0.029, (up + 0.0665) / 0.0125)  # the mouth stays free
        free = ramp(lip, 0.95, 1.35)
        above = ramp(up, -0.047, -0.052) * ramp(up, -0.070, -0.062) * ramp(side, 0.034, 0.026)
        chin = ramp(up, -0.076, -0.084) * ramp(side, 0.034, 0.024)
        jaw = ramp(up + 0.35 * (side - 0.03), -0.050, -0.075)
        thickness = np.maximum.reduce([beard.moustache * above, beard.chin * chin, beard.jaw * jaw])
        return thickness * front * low * free

    @property
    def hair_end(self) -> float:
        """Height of the lower end of long hair."""
        return float(self.ear[1] - 0.065)


def bridge_hollows(mesh: BodySurface, reference: BodyRegions) -> Array:
    """Offsets (V, 3) that move hollows of the trunk towards the convex hull of each slice."""
    p = mesh.naked
    trunk = [reference.bones.index(name) for name in ("HumanoidRoot", "sacroiliac", "vl5", "l_hip", "r_hip")]
    on_trunk = (mesh.weights[:, trunk].sum(axis=1) > 0.9) & (mesh.part == 0)
    bottom, top = reference.hip_y - 0.06, reference.shoulder_y - 0.06
    amount = ramp(p[:, 1], bottom, reference.hip_y) * ramp(p[:, 1], top, top - 0.08)
    step = np.zeros_like(p)
    for y in np.arange(bottom, top, 0.01):
        near = on_trunk & (np.abs(p[:, 1] - y) < 0.015)
        rows = np.flatnonzero(on_trunk & (np.abs(p[:, 1] - y) <= 0.005))
        edges = ConvexHull(p[near][:, [0, 2]]).equations
        depth = -(p[rows][:, [0, 2]] @ edges[:, :2].T + edges[:, 2])
        nearest = depth.argmin(axis=1)
        out = depth[np.arange(len(rows)), nearest].clip(0)
        out *= 0.85 * amount[rows] * ramp(out, 0.05, 0.03)  # deep hollows are between the legs
        step[rows] = np.insert(edges[nearest, :2] * out[:, None], 1, 0.0, axis=1)
    return step


def smooth_under_clothes(mesh: BodySurface, reference: BodyRegions, own: BodyRegions) -> Array:
    """Smooth the naked body under clothes. Returns vertices (V, 3). One implicit diffusion step over
    CLOTH_SMOOTHING metres does not depend on the vertex density. A second step adds back part of the
    difference, so that limbs keep their thickness."""
    _, neck, sleeve, hem = (border(mesh.canonical) for border in reference.borders[:4])
    amount = np.where(mesh.part == 0, ramp(np.minimum.reduce([-neck, -sleeve, hem]), 0.0, 0.03), 0.0)
    bridged = bridge_hollows(mesh, own)
    x = mesh.vertices + bridged + taut_shirt(mesh, own, mesh.naked + bridged)
    graph = neighbours(mesh.faces, len(x))
    a, b, c, d = (mesh.vertices[mesh.faces[:, k]] for k in range(4))
    quad_area = np.linalg.norm(np.cross(c - a, d - b), axis=1) / 2
    area = np.zeros(len(x))
    np.add.at(area, mesh.faces, quad_area[:, None] / 4)
    matrix = (sparse.diags(area) + CLOTH_SMOOTHING**2 * csgraph.laplacian(graph)).tocsc()
    # the ordering and the pivots of symmetric, positive matrices are five times as fast
    factors = splu(matrix, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def diffuse(values: Array) -> Array:
        return np.asarray(factors.solve(area[:, None] * values))

    once = diffuse(x)
    return mesh.vertices + amount[:, None] * (once + diffuse(x - once) - mesh.vertices)


def snap_to_border(
    mesh: BodySurface, fields: Array, column: int
) -> tuple[BodySurface, Array, sparse.csr_matrix]:
    """Move vertices along edges onto the zero line of the field ``column``, so that no edge crosses this
    line. ``fields``: (V, K) values at the vertices. Returns the mesh, its new fields, and the matrix (V, V)
    that moves the vertices."""
    i, j = np.array([(i, (i + step) % 4) for i in range(4) for step in (1, 3)]).T
    v, u, tv, tu = (faces[:, k].T.ravel() for faces in (mesh.faces, mesh.uv_faces) for k in (i, j))
    value = fields[:, column]
    crossing = (value[v] * value[u] < 0) & (np.abs(value[v]) <= np.abs(value[u])) & (mesh.part[v] == 0)
    copies: dict[int, set[int]] = {}
    ends = np.isin(v, v[crossing])
    for vertex, texture in zip(v[ends].tolist(), tv[ends].tolist(), strict=True):
        copies.setdefault(vertex, set()).add(texture)
    best: dict[int, tuple[float, int, float]] = {}
    targets: dict[tuple[int, int], dict[int, int]] = {}
    for row in np.flatnonzero(crossing):
        a, b = int(v[row]), int(u[row])
        step = float(value[a] / (value[a] - value[b]))
        targets.setdefault((a, b), {})[int(tv[row])] = int(tu[row])
        if len(targets[a, b]) == len(copies[a]):  # vertices on a texture seam only move along the seam
            length = step * float(np.linalg.norm(mesh.canonical[b] - mesh.canonical[a]))
            best[a] = min(best.get(a, (np.inf, 0, 0.0)), (length, b, step))
    uv = mesh.uv.copy()
    for a, (_, b, step) in best.items():
        for ta, tb in targets[a, b].items():
            uv[ta] = (1 - step) * mesh.uv[ta] + step * mesh.uv[tb]
    moved = np.array(list(best), np.int64)
    goals = np.array([b for _, b, _ in best.values()], np.int64)
    steps = np.zeros(len(mesh.vertices))
    steps[moved] = [step for _, _, step in best.values()]
    every = np.arange(len(mesh.vertices))
    carry = sparse.csr_matrix(
        (np.r_[1 - steps, steps[moved]], (np.r_[every, moved], np.r_[every, goals])), shape=2 * every.shape
    )
    new_fields = carry @ fields
    new_fields[moved, column] = 0.0
    values = {
        name: carry @ getattr(mesh, name) for name in ("vertices", "canonical", "naked", "weights", "shapes")
    }
    return replace(mesh, **values, uv=uv), new_fields, carry


def split_along(
    faces: VertexIndices, uv_faces: VertexIndices, value: Array
) -> tuple[VertexIndices, VertexIndices]:
    """Split quads along their diagonal where the diagonal is the zero line of ``value`` (V,)."""
    at = value[faces]
    mixed = (at.max(axis=1) > 0) & (at.min(axis=1) < 0)
    pieces, uv_pieces = [faces], [uv_faces]
    keep = np.ones(len(faces), bool)
    for diagonal, halves in (((0, 2), ([0, 1, 2, 2], [0, 2, 3, 3])), ((1, 3), ([1, 2, 3, 3], [1, 3, 0, 0]))):
        cut = mixed & (at[:, diagonal] == 0).all(axis=1) & keep
        keep &= ~cut
        pieces += [faces[cut][:, half] for half in halves]
        uv_pieces += [uv_faces[cut][:, half] for half in halves]
    pieces[0], uv_pieces[0] = faces[keep], uv_faces[keep]
    return np.concatenate(pieces), np.concatenate(uv_pieces)


def cut_clothes(mesh: BodySurface, reference: BodyRegions) -> tuple[BodySurface, sparse.csr_matrix]:
    """Cut the mesh along the borders of garments, and connect the edges by hems. Returns the mesh, and the
    matrix (V', V) from the old vertices to the new ones."""
    fields = np.stack([border(mesh.canonical) for border in reference.borders], axis=1)
    carry = sparse.identity(len(mesh.vertices), format="csr")
    for column in range(fields.shape[1]):
        mesh, fields, moved = snap_to_border(mesh, fields, column)
        carry = moved @ carry
    faces, uv_faces = mesh.faces, mesh.uv_faces
    for column in range(fields.shape[1]):
        faces, uv_faces = split_along(faces, uv_faces, fields[:, column])
    face_garment = np.where(mesh.part[faces[:, 0]] == 0, reference.garment(fields[faces].mean(axis=1)), NONE)

    # one copy of a vertex for each garment of its faces
    copies, inverse = np.unique(np.c_[faces.ravel(), np.repeat(face_garment, 4)], axis=0, return_inverse=True)
    old, garment = copies.T
    faces_cut = inverse.reshape(-1, 4)

    # sides (N,) of faces, and the numbers of the same sides in the other direction
    count, start, end = len(mesh.vertices), faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    key = np.where(start != end, start * count + end, -1)
    order = np.argsort(key, kind="stable")
    reverse = end * count + start
    others = order[np.searchsorted(key, reverse, sorter=order).clip(max=len(key) - 1)]
    on_border = face_garment[np.arange(len(key)) // 4] > face_garment[others // 4]
    uv, hems, uv_hems, hem_garment = list(mesh.uv), [], [], []
    for index in np.flatnonzero(on_border & (key >= 0) & (key[others] == reverse)).tolist():
        a, b = int(start[index]), int(end[index])
        f, k = divmod(index, 4)
        g, m = divmod(int(others[index]), 4)
        to_b = next(i % 4 for i in range(k + 1, k + 4) if faces[f, i % 4] == b)
        to_a = next(i % 4 for i in range(m + 1, m + 4) if faces[g, i % 4] == a)
        hems.append([faces_cut[f, to_b], faces_cut[f, k], faces_cut[g, to_a], faces_cut[g, m]])
        # inside the garment in the texture, so that hems have its colour
        middle = mesh.uv[uv_faces[f]].mean(axis=0)
        uv += [0.75 * mesh.uv[uv_faces[f, i]] + 0.25 * middle for i in (to_b, k)]
        uv_hems.append([len(uv) - 2, len(uv) - 1, len(uv) - 1, len(uv) - 2])
        hem_garment.append(face_garment[f])
    cut = BodySurface(
        vertices=mesh.vertices[old],
        faces=np.concatenate([faces_cut, hems]),
        uv=np.array(uv),
        uv_faces=np.concatenate([uv_faces, uv_hems]),
        weights=limit_weights(mesh.weights[old]),
        canonical=mesh.canonical[old],
        naked=mesh.naked[old],
        part=mesh.part[old],
        garment=garment,
        face_garment=np.concatenate([face_garment, hem_garment]),
        weld=old,
        shapes=np.where((garment == NONE)[:, None], mesh.shapes[old], 0.0),
        hems=len(hems),
    )
    return cut, carry[old]


def _wrap_in_shoe(
    vertices: Array, mesh: BodySurface, foot: VertexIndices, ball: Array, amount: Array, size: float
) -> Array:
    """Wrap one foot in a convex shoe: vertices (V, 3) of the body with the shoe.

    The toes are first smoothed flat, then projected onto the shoe, so that the small faces between them do
    not fold. ``foot``: vertices below the ankle. ``ball``: joint of the big toe, (3,). ``amount``: blend
    factor (V,) between body and shoe. ``size``: length of the foot relative to the reference body.
    """
    naked = mesh.vertices
    skin = naked[foot]
    floor, tip = skin[:, 1].min(), skin[:, 2].max()
    low = outline(skin[skin[:, 1] < floor + 0.05 * size][:, [0, 2]], SHOE_MARGIN * size)
    low[:, 1] += 0.007 * size * ramp(low[:, 1], tip - 0.06 * size, tip)  # space in front of the toes
    levels = [np.insert(low, 1, floor + size * y, axis=1) for y in (-SOLE_THICKNESS, 0.012)]
    # the toe box has the height of the big toe up to the front
    box = low[low[:, 1] > ball[2]]
    box = np.insert((box - box.mean(axis=0)) * 0.86 + box.mean(axis=0), 1, floor + 0.034 * size, axis=1)
    shoe = ConvexHull(
        np.concatenate([skin + 0.004 * size * np.sign(skin - skin.mean(axis=0)) * [1, 0, 0], *levels, box])
    )
    # micrometres are enough; triangles of one plane have equal equations
    sides = np.unique((shoe.equations * [1, 1, 1, -1]).astype(np.float32), axis=0)

    heel = skin[:, 2].min() + 0.045 * size
    middle = np.array([low[:, 0].mean(), floor + 0.03 * size, ball[2] - 0.035 * size])

    def project(points: Array) -> Array:
        centre = np.tile(middle, (len(points), 1))
        centre[:, 2] = np.clip(points[:, 2], heel, middle[2])
        ray = points - centre
        room = sides[:, 3] - centre.astype(np.float32) @ sides[:, :3].T
        near = ray.astype(np.float32) @ sides[:, :3].T
        near /= np.maximum(room, np.float32(1e-9))
        return centre + ray / near.max(axis=1)[:, None]

    free = np.zeros(len(vertices))
    free[foot] = naked[foot, 2] > ball[2] - 0.012 * size
    mean = mean_matrix(neighbours(mesh.surface, len(vertices)))
    wrapped = smooth_towards(mean, naked, free, 300)
    rows = foot[amount[foot] > 0.9]
    free[rows] = 1.0
    loose = np.flatnonzero(free)
    near, half = mean[loose], 0.5 * free[loose, None]
    for _ in range(60):
        wrapped[rows] = project(wrapped[rows])
        smooth_rows(near, wrapped, loose, half, 2)
    wrapped[foot] = project(wrapped[foot])
    return vertices + amount[:, None] * (wrapped - vertices)


def _drape_long_hair(
    mesh: BodySurface,
    reference: BodyRegions,
    own: BodyRegions,
    dressed: Array,
    covered: Array,
    is_ear: Array,
    lumps: Array,
) -> Array:
    """Drape long hair over the head and ears, straight down from the widest part of the head. ``covered``:
    distance (V,) inside the hairline. ``lumps``: factor (V,) of the thickness. Returns vertices (V, 3)."""
    p, q = mesh.canonical, mesh.naked
    size = (own.skull_top - own.eye[1]) / (reference.skull_top - reference.eye[1])
    free = np.where(p[:, 1] < reference.ear[1] + 0.08, ramp(covered, 0.0, 0.004), 0.0)
    head = (mesh.part == 0) & (p[:, 1] > reference.ear[1] - 0.02) & (is_ear < 0.01)
    faces = mesh.surface
    axis = float(own.ear[2] - 0.015 * size)
    hanging = Outline.of(q, faces[head[faces].all(axis=1)], axis).hanging()
    taut = shrink_onto(q, mean_matrix(neighbours(faces, len(q))), free, hanging, 200)
    inwards = 1 - 0.10 * ramp(p[:, 1], reference.hair_end + 0.05, reference.hair_end)
    thickness = size * (0.004 + 0.008 * lumps * ramp(covered, 0.0, 0.015))
    reach = around(q, axis)[1]
    reach += ramp(covered, 0.0, 0.012) * (inwards * hanging.at(taut) + thickness - reach)
    hair = push_outwards(taut, reach, axis)
    amount = ramp(p[:, 1], reference.ear[1] + 0.075, reference.ear[1] + 0.04) * ramp(covered, 0.0, 0.004)
    return dressed + amount[:, None] * (hair - q + mesh.vertices - dressed)


def dress(
    mesh: BodySurface, reference: BodyRegions, own: BodyRegions, is_ear: Array, balls: tuple[Array, Array]
) -> Array:
    """Add clothes, shoes and hair to the body. Returns vertices (V, 3) in the A pose.

    Args:
        mesh: Surface of the body, cut along the borders of clothes.
        reference, own: Regions of the reference body and of this body.
        is_ear: Above 0 at the ears, (V,).
        balls: Joints of the left and right big toe, (3,) each.
    """
    p, body = mesh.canonical, mesh.part == 0
    size = own.foot_length / reference.foot_length
    shirt, trousers = mesh.garment == SHIRT, mesh.garment == TROUSERS
    belt, neck, sleeve, hem = (border(p) for border in reference.borders[:4])
    worn, ankle = own.dress, p[:, 1] - reference.ankle_height
    vertices = mesh.vertices
    joined = mesh.weld[mesh.surface]  # hems have one normal on both sides
    welded, cloth = np.zeros_like(vertices), np.zeros(len(vertices))
    welded[mesh.weld] = vertices
    cloth[mesh.weld[shirt | trousers]] = 1.0
    mean = mean_matrix(neighbours(joined, len(vertices)))
    normals = smooth_towards(mean, vertex_normals(welded, joined), 0.5 * cloth, 12)[mesh.weld]
    # trouser legs are tubes around the shins
    q = mesh.naked
    shin = q * [1, 0, 1] - np.stack([np.sign(q[:, 0]) * own.leg_x(q), 0 * hem, own.leg_z(q)], axis=1)
    radius = np.linalg.norm(shin, axis=1)
    tube = trousers * ramp(p[:, 1], 0.40, 0.20) * worn.bottom.loose
    normals = normals + tube[:, None] * (shin / np.maximum(radius, 1e-3)[:, None] - normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    cuff = ramp(sleeve, -0.14, 0.0)
    waist = ramp(belt, 0.30, 0.10) * ramp(belt, -0.02, 0.05)
    shirt_thickness = 0.005 + 0.005 * cuff + 0.005 * ramp(neck, -0.03, -0.10) + 0.010 * waist
    shirt_thickness += worn.top.ease
    trouser_thickness = 0.006 + 0.003 * ramp(belt, 0.0, -0.1)
    trouser_thickness += 0.005 * np.exp(-(((p[:, 1] - reference.knee_y) / 0.12) ** 2))
    trouser_thickness += tube * np.maximum(0.75 * (TROUSER_LEG * size - radius), 0.0)
    if not worn.bottom.loose:
        trouser_thickness = np.full(len(p), 0.002)
    elif worn.bottom.hem > 0:
        trouser_thickness += 0.012 * ramp(hem, 0.18, 0.0)
    top = ramp(p[:, 1], reference.eye[1], reference.skull_top)
    lumps = 1 + 0.25 * noise(p, 0.035, 1)
    covered = reference.hair(p)
    hair = ramp(covered, -0.004, 0.02) * (1 - is_ear) * (0.005 + 0.011 * top) * lumps
    if worn.hair.thickness != 1 or worn.beard != BEARDS["none"]:
        hair = hair * worn.hair.thickness + reference.beard(p, worn.beard) * (1 + 0.3 * noise(p, 0.012, 42))
    if worn.footwear.shaft:
        hair = np.where(mesh.garment == SHOES, 0.010 * ramp(ankle, -0.01, 0.02), hair)
    thickness = np.select([shirt, trousers, body], [shirt_thickness, trouser_thickness, hair], 0.0)
    dressed = vertices + thickness[:, None] * normals
    if reference.long_hair:
        inside = np.where(body & (mesh.garment == NONE), covered, 0.0)
        dressed = _drape_long_hair(mesh, reference, own, dressed, inside, is_ear, lumps)
    in_shoe = np.where(mesh.garment == SHOES, ramp(ankle, 0.0, -0.015), 0.0)
    if not worn.footwear.covers:
        return dressed
    for side, ball in zip((1, -1), balls, strict=True):
        foot = np.flatnonzero(body & (p[:, 0] * side > 0) & (ankle < 0.015))
        this_shoe = in_shoe * (p[:, 0] * side > 0)
        dressed = _wrap_in_shoe(dressed, mesh, foot, ball, this_shoe, size)
    return dressed
