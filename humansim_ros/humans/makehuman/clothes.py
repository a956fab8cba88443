"""Clothes, shoes and hair as shapes: cut out of the body's own surface and hung over it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import factorized
from scipy.spatial import ConvexHull

from humansim_ros.humans.makehuman.data import VertexIndices
from humansim_ros.humans.makehuman.hang import hang
from humansim_ros.humans.makehuman.outline import (
    Outline,
    around,
    averaging,
    drawn_taut,
    neighbours,
    pushed_out,
)
from humansim_ros.humans.makehuman.skeleton import Bones, limit_weights
from humansim_ros.humans.makehuman.surface import (
    NONE,
    SHIRT,
    SHOES,
    TROUSERS,
    BodySurface,
    noise,
    outline,
    ramp,
    smooth,
    vertex_normals,
)
from humansim_ros.types import Array

SHOE_MARGIN = 0.007  # metres, as all lengths here
SOLE_THICKNESS = 0.014
CLOTH_SMOOTHING = 0.022
TROUSER_LEG = 0.060  # radius at the hem


@dataclass(frozen=True)
class Tailor:
    """Where clothes and hair are, on the naked body in the T pose (metres, bare soles at y = 0).

    Each method gives a signed distance-like value (N,) of points (N, 3), positive inside.
    """

    bones: Bones
    eye: Array
    eye_radius: float
    ear: Array
    skull_top: float
    hair_style: Literal["short", "long"] = "short"
    sleeves: Literal["short", "long"] = "short"

    def _head(self, name: str) -> Array:
        return self.bones.heads[self.bones.index(name)]

    @property
    def belt_height(self) -> float:
        return 0.6 * self._head("sacroiliac")[1] + 0.4 * self._head("vl5")[1]

    @property
    def hem_height(self) -> float:
        return self._head("l_ankle")[1] - 0.005

    @property
    def sleeve_end(self) -> float:
        if self.sleeves == "long":
            return float(self._head("l_wrist")[0] - 0.012)
        return float(0.45 * self._head("l_shoulder")[0] + 0.55 * self._head("l_elbow")[0])

    @property
    def shoulder_x(self) -> float:
        return float(self._head("l_shoulder")[0])

    @property
    def shoulder_y(self) -> float:
        return float(self._head("l_shoulder")[1])

    @property
    def foot(self) -> tuple[Array, Array]:
        """The left ankle and the tip of the toes."""
        ankle = self.bones.index("l_ankle")
        return self.bones.heads[ankle], self.bones.tails[ankle]

    @property
    def foot_length(self) -> float:
        """From the ankle to the tip of the toes."""
        ankle, toe = self.foot
        return float(np.linalg.norm(toe - ankle))

    @property
    def hip_y(self) -> float:
        return float(self._head("l_hip")[1])

    @property
    def knee_y(self) -> float:
        return float(self._head("l_knee")[1])

    def _leg(self, p: Array, axis: int) -> Array:
        joints = np.array([self._head(f"l_{part}") for part in ("ankle", "knee", "hip")])
        return np.interp(p[:, 1], joints[:, 1], joints[:, axis])

    def leg_x(self, p: Array) -> Array:
        """|x| (N,) of the middle of the leg at the height of each point."""
        return self._leg(p, 0)

    def leg_z(self, p: Array) -> Array:
        return self._leg(p, 2)

    def above_belt(self, p: Array) -> Array:
        return p[:, 1] - 0.12 * p[:, 2] - self.belt_height + 0.012

    def above_neckline(self, p: Array) -> Array:
        nape = self._head("vt3")
        line = nape[1] - 0.022 - 0.42 * (p[:, 2] - nape[2] + 0.05) + 0.60 * (np.hypot(p[:, 0], 0.06) - 0.06)
        return p[:, 1] - line

    def below_sleeve_end(self, p: Array) -> Array:
        return np.abs(p[:, 0]) - self.sleeve_end

    def above_hem(self, p: Array) -> Array:
        return p[:, 1] - self.hem_height

    @property
    def borders(self) -> tuple[Callable[[Array], Array], ...]:
        """The fields whose zero lines are the edges of clothes."""
        return self.above_belt, self.above_neckline, self.below_sleeve_end, self.above_hem

    @staticmethod
    def garment(fields: Array) -> VertexIndices:
        """Which garment is worn (N,) where the borders have these values (N, 4)."""
        belt, neck, sleeve, hem = fields.T
        bare = (neck > 0) | (sleeve > 0)
        return np.select([hem < 0, belt < 0, ~bare], [SHOES, TROUSERS, SHIRT], NONE)

    def hair(self, p: Array) -> Array:
        """Above a hairline that runs from the forehead over the temples and around the ears to the nape."""
        eye, ear = self.eye, self.ear
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
        if self.hair_style == "short":
            return p[:, 1] - np.interp(p[:, 2], *knots.T)
        knots[5:, 1] -= 0.010  # a fringe
        cap = p[:, 1] - np.interp(p[:, 2], *knots.T)
        # over the ears, down to the chin
        edge = ear[2] + 0.030 - 0.10 * (ear[1] - p[:, 1]).clip(0)
        outside = np.hypot(p[:, 0], p[:, 2] - ear[2] - 0.010) - 0.042  # not in the mouth
        return np.maximum(cap, np.minimum.reduce([edge - p[:, 2], p[:, 1] - self.hair_end, outside]))

    @property
    def hair_end(self) -> float:
        """How far down long hair falls."""
        return float(self.ear[1] - 0.065)


def bridge_hollows(mesh: BodySurface, tailor: Tailor) -> Array:
    """Steps (V, 3) that take hollows of the trunk out to where cloth would span them, slice by slice."""
    p = mesh.naked
    trunk = [tailor.bones.index(name) for name in ("HumanoidRoot", "sacroiliac", "vl5", "l_hip", "r_hip")]
    on_trunk = (mesh.weights[:, trunk].sum(axis=1) > 0.9) & (mesh.part == 0)
    bottom, top = tailor.hip_y - 0.06, tailor.shoulder_y - 0.06
    amount = ramp(p[:, 1], bottom, tailor.hip_y) * ramp(p[:, 1], top, top - 0.08)
    step = np.zeros_like(p)
    for y in np.arange(bottom, top, 0.01):
        near = on_trunk & (np.abs(p[:, 1] - y) < 0.015)
        rows = np.flatnonzero(on_trunk & (np.abs(p[:, 1] - y) <= 0.005))
        edges = ConvexHull(p[near][:, [0, 2]]).equations
        depth = -(p[rows][:, [0, 2]] @ edges[:, :2].T + edges[:, 2])
        nearest = depth.argmin(axis=1)
        out = depth[np.arange(len(rows)), nearest].clip(0)
        out *= 0.85 * amount[rows] * ramp(out, 0.05, 0.03)  # what lies deep is between the legs
        step[rows] = np.insert(edges[nearest, :2] * out[:, None], 1, 0.0, axis=1)
    return step


def drape(mesh: BodySurface, tailor: Tailor, own: Tailor) -> Array:
    """Vertices (V, 3) of the naked body without what would not show through clothes.

    One implicit step of diffusion over CLOTH_SMOOTHING metres, so that a dense spot is smoothed as far as a
    coarse one; applied once more to what it took away, so that limbs do not get thin.
    """
    _, neck, sleeve, hem = (border(mesh.canonical) for border in tailor.borders)
    amount = np.where(mesh.part == 0, ramp(np.minimum.reduce([-neck, -sleeve, hem]), 0.0, 0.03), 0.0)
    bridged = bridge_hollows(mesh, own)
    x = mesh.vertices + bridged + hang(mesh, own, mesh.naked + bridged)
    edges = np.concatenate([mesh.faces[:, [k, (k + 1) % 4]] for k in range(4)])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(len(x),) * 2).tocsr()
    graph = ((graph + graph.T) > 0).astype(float)
    a, b, c, d = (mesh.vertices[mesh.faces[:, k]] for k in range(4))
    quad_area = np.linalg.norm(np.cross(c - a, d - b), axis=1) / 2
    area = np.zeros(len(x))
    np.add.at(area, mesh.faces, quad_area[:, None] / 4)
    solve = factorized((sparse.diags(area) + CLOTH_SMOOTHING**2 * csgraph.laplacian(graph)).tocsc())

    def diffuse(values: Array) -> Array:
        return np.stack([solve(area * column) for column in values.T], axis=1)

    once = diffuse(x)
    return mesh.vertices + amount[:, None] * (once + diffuse(x - once) - mesh.vertices)


def snap(mesh: BodySurface, fields: Array, column: int) -> tuple[BodySurface, Array]:
    """Slide vertices along edges onto the zero line of one field, so that no edge crosses it any more.

    fields (V, K) are values at the vertices. Returns the mesh and the fields after the move.
    """
    corners = [0, 1, 2, 3]
    pairs = [
        (mesh.faces[:, i], mesh.faces[:, j], mesh.uv_faces[:, i], mesh.uv_faces[:, j])
        for i in corners
        for j in ((i + 1) % 4, (i + 3) % 4)
    ]
    v, u, tv, tu = (np.concatenate(x) for x in zip(*pairs, strict=True))
    value = fields[:, column]
    crossing = (value[v] * value[u] < 0) & (np.abs(value[v]) <= np.abs(value[u])) & (mesh.part[v] == 0)
    copies: dict[int, set[int]] = {}
    for vertex, texture in zip(v[np.isin(v, v[crossing])], tv[np.isin(v, v[crossing])], strict=True):
        copies.setdefault(int(vertex), set()).add(int(texture))
    best: dict[int, tuple[float, int, float]] = {}
    targets: dict[tuple[int, int], dict[int, int]] = {}
    for row in np.flatnonzero(crossing):
        a, b = int(v[row]), int(u[row])
        step = float(value[a] / (value[a] - value[b]))
        targets.setdefault((a, b), {})[int(tv[row])] = int(tu[row])
        if len(targets[a, b]) == len(copies[a]):  # on a seam of the texture only along the seam
            length = step * float(np.linalg.norm(mesh.canonical[b] - mesh.canonical[a]))
            best[a] = min(best.get(a, (np.inf, 0, 0.0)), (length, b, step))
    vertices, canonical, naked = mesh.vertices.copy(), mesh.canonical.copy(), mesh.naked.copy()
    weights, uv, new_fields = mesh.weights.copy(), mesh.uv.copy(), fields.copy()
    for a, (_, b, step) in best.items():
        for new, old in (
            (vertices, mesh.vertices),
            (canonical, mesh.canonical),
            (naked, mesh.naked),
            (weights, mesh.weights),
            (new_fields, fields),
        ):
            new[a] = (1 - step) * old[a] + step * old[b]
        new_fields[a, column] = 0.0
        for ta, tb in targets[a, b].items():
            uv[ta] = (1 - step) * mesh.uv[ta] + step * mesh.uv[tb]
    return replace(
        mesh, vertices=vertices, canonical=canonical, naked=naked, weights=weights, uv=uv
    ), new_fields


def split_along(
    faces: VertexIndices, uv_faces: VertexIndices, value: Array
) -> tuple[VertexIndices, VertexIndices]:
    """Cut in two the quads whose diagonal is the zero line of `value` (V,)."""
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


def cut_clothes(mesh: BodySurface, tailor: Tailor) -> BodySurface:
    """Part the mesh along the borders of the garments and join the edges by hems: cloth hangs free."""
    fields = np.stack([border(mesh.canonical) for border in tailor.borders], axis=1)
    for column in range(fields.shape[1]):
        mesh, fields = snap(mesh, fields, column)
    faces, uv_faces = mesh.faces, mesh.uv_faces
    for column in range(fields.shape[1]):
        faces, uv_faces = split_along(faces, uv_faces, fields[:, column])
    worn = np.where(mesh.part[faces[:, 0]] == 0, tailor.garment(fields[faces].mean(axis=1)), NONE)

    # One copy of a vertex for each garment that its faces belong to.
    copies, inverse = np.unique(np.c_[faces.ravel(), np.repeat(worn, 4)], axis=0, return_inverse=True)
    old, garment = copies.T
    faces_cut = inverse.reshape(-1, 4)

    # directed edge of the uncut mesh -> its place in the faces
    ends = zip(faces.ravel().tolist(), np.roll(faces, -1, axis=1).ravel().tolist(), strict=True)
    sides = {edge: place for place, edge in enumerate(ends) if edge[0] != edge[1]}
    uv, hems, uv_hems, hem_garment = list(mesh.uv), [], [], []
    for (a, b), place in sides.items():
        other = sides.get((b, a))
        f, k = divmod(place, 4)
        if other is None or worn[f] <= worn[other // 4]:
            continue
        g, m = divmod(other, 4)
        to_b = next(i % 4 for i in range(k + 1, k + 4) if faces[f, i % 4] == b)
        to_a = next(i % 4 for i in range(m + 1, m + 4) if faces[g, i % 4] == a)
        hems.append([faces_cut[f, to_b], faces_cut[f, k], faces_cut[g, to_a], faces_cut[g, m]])
        # A little inside the garment in the texture, so that a hem has the garment's colour.
        middle = mesh.uv[uv_faces[f]].mean(axis=0)
        uv += [0.75 * mesh.uv[uv_faces[f, i]] + 0.25 * middle for i in (to_b, k)]
        uv_hems.append([len(uv) - 2, len(uv) - 1, len(uv) - 1, len(uv) - 2])
        hem_garment.append(worn[f])
    return BodySurface(
        vertices=mesh.vertices[old],
        faces=np.concatenate([faces_cut, hems]),
        uv=np.array(uv),
        uv_faces=np.concatenate([uv_faces, uv_hems]),
        weights=limit_weights(mesh.weights[old]),
        canonical=mesh.canonical[old],
        naked=mesh.naked[old],
        part=mesh.part[old],
        garment=garment,
        face_garment=np.concatenate([worn, hem_garment]),
        weld=old,
        hems=len(hems),
    )


def put_on_shoe(
    vertices: Array,
    faces: VertexIndices,
    naked: Array,
    foot: VertexIndices,
    ball: Array,
    amount: Array,
    size: float,
) -> Array:
    """Vertices (V, 3) with one foot wrapped in a convex shoe.

    `foot` are the rows of the naked foot below the ankle, `ball` (3,) the joint of the big toe, `amount` (V,)
    how much of the shoe a vertex takes, `size` how long the foot is by that of the adult man. The toes are
    first drawn flat like a skin over a drum, then blown up onto the shoe, so that the many small faces
    between them spread over it without folds.
    """
    skin = naked[foot]
    floor, tip = skin[:, 1].min(), skin[:, 2].max()
    low = outline(skin[skin[:, 1] < floor + 0.05 * size][:, [0, 2]], SHOE_MARGIN * size)
    low[:, 1] += 0.007 * size * ramp(low[:, 1], tip - 0.06 * size, tip)  # room before the toes
    levels = [np.insert(low, 1, floor + size * y, axis=1) for y in (-SOLE_THICKNESS, 0.012)]
    # The toe box is as high as the big toe right to the front.
    box = low[low[:, 1] > ball[2]]
    box = np.insert((box - box.mean(axis=0)) * 0.86 + box.mean(axis=0), 1, floor + 0.034 * size, axis=1)
    shoe = ConvexHull(
        np.concatenate([skin + 0.004 * size * np.sign(skin - skin.mean(axis=0)) * [1, 0, 0], *levels, box])
    )
    normals, offsets = shoe.equations[:, :3], -shoe.equations[:, 3]

    heel = skin[:, 2].min() + 0.045 * size
    middle = np.array([low[:, 0].mean(), floor + 0.03 * size, ball[2] - 0.035 * size])

    def project(points: Array) -> Array:
        centre = np.tile(middle, (len(points), 1))
        centre[:, 2] = np.clip(points[:, 2], heel, middle[2])
        ray = points - centre
        reach = ray @ normals.T
        room = offsets - centre @ normals.T
        stretch = np.where(reach > 1e-9, room / np.maximum(reach, 1e-9), np.inf).min(axis=1)
        return centre + ray * stretch[:, None]

    free = np.zeros(len(vertices))
    free[foot] = naked[foot, 2] > ball[2] - 0.012 * size
    wrapped = smooth(naked, faces, free, 300)
    rows = foot[amount[foot] > 0.9]
    free[rows] = 1.0
    for _ in range(60):
        wrapped[rows] = project(wrapped[rows])
        wrapped = smooth(wrapped, faces, 0.5 * free, 2)
    wrapped[foot] = project(wrapped[foot])
    return vertices + amount[:, None] * (wrapped - vertices)


def let_fall(
    mesh: BodySurface, tailor: Tailor, own: Tailor, worn: Array, covered: Array, is_ear: Array, lumps: Array
) -> Array:
    """`worn` (V, 3) with long hair, which falls straight from where the head is widest, over the ears.

    `covered` (V,) is how far inside the hairline a vertex is, `is_ear` (V,) above 0 at the ears.
    """
    p, q = mesh.canonical, mesh.naked
    size = (own.skull_top - own.eye[1]) / (tailor.skull_top - tailor.eye[1])
    loose = np.where(p[:, 1] < tailor.ear[1] + 0.08, ramp(covered, 0.0, 0.004), 0.0)
    head = (mesh.part == 0) & (p[:, 1] > tailor.ear[1] - 0.02) & (is_ear < 0.01)
    faces = mesh.surface
    axis = float(own.ear[2] - 0.015 * size)
    falling = Outline.of(q, faces[head[faces].all(axis=1)], axis).falling()
    taut = drawn_taut(q, averaging(neighbours(faces, len(q))), loose, falling, 200)
    inwards = 1 - 0.10 * ramp(p[:, 1], tailor.hair_end + 0.05, tailor.hair_end)
    thickness = size * (0.004 + 0.008 * lumps * ramp(covered, 0.0, 0.015))
    reach = around(q, axis)[1]
    reach += ramp(covered, 0.0, 0.012) * (inwards * falling.at(taut) + thickness - reach)
    hair = pushed_out(taut, reach, axis)
    amount = ramp(p[:, 1], tailor.ear[1] + 0.075, tailor.ear[1] + 0.04) * ramp(covered, 0.0, 0.004)
    return worn + amount[:, None] * (hair - q + mesh.vertices - worn)


def dress(mesh: BodySurface, tailor: Tailor, own: Tailor, is_ear: Array, balls: tuple[Array, Array]) -> Array:
    """Vertices (V, 3) of the A pose with cloth, shoes and hair. `tailor` knows the adult man, `own` this
    body; `balls` are the joints of the big toes.
    """
    p, body = mesh.canonical, mesh.part == 0
    size = own.foot_length / tailor.foot_length
    shirt, trousers = mesh.garment == SHIRT, mesh.garment == TROUSERS
    belt, neck, sleeve, hem = (border(p) for border in tailor.borders)
    vertices = mesh.vertices
    joined = mesh.weld[mesh.surface]  # hems take one direction on both sides
    welded, cloth = np.zeros_like(vertices), np.zeros(len(vertices))
    welded[mesh.weld] = vertices
    cloth[mesh.weld[shirt | trousers]] = 1.0
    normals = smooth(vertex_normals(welded, joined), joined, 0.5 * cloth, 12)[mesh.weld]
    # A trouser leg is a tube about the shin.
    q = mesh.naked
    shin = q * [1, 0, 1] - np.stack([np.sign(q[:, 0]) * own.leg_x(q), 0 * hem, own.leg_z(q)], axis=1)
    radius = np.linalg.norm(shin, axis=1)
    tube = trousers * ramp(p[:, 1], 0.40, 0.20)
    normals = normals + tube[:, None] * (shin / np.maximum(radius, 1e-3)[:, None] - normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    cuff = ramp(sleeve, -0.14, 0.0)
    waist = ramp(belt, 0.30, 0.10) * ramp(belt, -0.02, 0.05)
    shirt_thickness = 0.005 + 0.005 * cuff + 0.005 * ramp(neck, -0.03, -0.10) + 0.010 * waist
    trouser_thickness = 0.006 + 0.003 * ramp(belt, 0.0, -0.1)
    trouser_thickness += 0.005 * np.exp(-(((p[:, 1] - tailor.knee_y) / 0.12) ** 2))
    trouser_thickness += tube * np.maximum(0.75 * (TROUSER_LEG * size - radius), 0.0)
    top = ramp(p[:, 1], tailor.eye[1], tailor.skull_top)
    lumps = 1 + 0.25 * noise(p, 0.035, 1)
    covered = tailor.hair(p)
    hair = ramp(covered, -0.004, 0.02) * (1 - is_ear) * (0.005 + 0.011 * top) * lumps
    thickness = np.select([shirt, trousers, body], [shirt_thickness, trouser_thickness, hair], 0.0)
    worn = vertices + thickness[:, None] * normals
    if tailor.hair_style == "long":
        falls = np.where(body & (mesh.garment == NONE), covered, 0.0)
        worn = let_fall(mesh, tailor, own, worn, falls, is_ear, lumps)
    in_shoe = np.where(mesh.garment == SHOES, ramp(hem, 0.0, -0.015), 0.0)
    for side, ball in zip((1, -1), balls, strict=True):
        foot = np.flatnonzero(body & (p[:, 0] * side > 0) & (hem < 0.015))
        mine = in_shoe * (p[:, 0] * side > 0)
        worn = put_on_shoe(worn, mesh.surface, mesh.vertices, foot, ball, mine, size)
    return worn
