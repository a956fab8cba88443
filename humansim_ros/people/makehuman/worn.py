"""Off-body surfaces: hair that stands off, head wear, glasses, skirts, collars, bags.

Each is a closed surface over a grid, with a tile of the texture. Positions are in the T pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, grey_closing
from scipy.spatial import cKDTree

from humansim_ros.files.mesh import MATERIAL_LABELS, WornName
from humansim_ros.motion.body import CLOTH, LooseParts
from humansim_ros.motion.body import HAIR as HAIR_ENDS
from humansim_ros.people.makehuman.clothes import BodyRegions
from humansim_ros.people.makehuman.data import VertexIndices
from humansim_ros.people.makehuman.paint import line, weave
from humansim_ros.people.makehuman.shape import TOPS, WORN, MakeHumanConfig, Outfit
from humansim_ros.people.makehuman.surface import BodySurface, noise, ramp, vertex_normals
from humansim_ros.types import Array

#: Rows and columns of directions around the head.
ROWS, COLUMNS = 44, 72
#: Largest side of a tile, and width of the texture, texels.
_LARGEST, _WIDTH = 500, 1024
#: Margin around a tile with the colours of the tile, texels, so that smaller mip levels do not mix tiles.
_MARGIN = 4
PartMaterial = Literal["hair", "top", "bottom", "shoes", "soles"] | WornName


@dataclass(frozen=True)
class Hanging:
    """How a part of V vertices hangs. See :class:`~humansim_ros.motion.body.offsets.LooseParts`. ``ends`` (K,
    2) and ``outwards`` (K, 3) describe the ends. ``nodes`` (V, 2), ``shares`` (V, 2), ``gather`` (V, 3) and
    ``left`` (V,) describe all vertices."""

    kind: int
    ends: VertexIndices
    outwards: Array
    nodes: VertexIndices
    shares: Array
    gather: Array
    left: Array


@dataclass(frozen=True)
class WornPart:
    """A closed surface over a grid of ``points`` (R, C, 3), metres, with ``weights`` (R, C, B) of bones.

    The columns of each row form a ring. ``material`` decides the colours. ``ring``: whether the last row is
    joined to the first row. Otherwise, each of these two rows is closed by a point. ``hanging``: how the part
    swings. If None, the part only follows the bones.
    """

    points: Array
    weights: Array
    material: PartMaterial
    ring: bool = False
    hanging: Hanging | None = None

    @property
    def vertices(self) -> Array:
        """(V, 3) points of the grid, and one point for each end that is closed."""
        return self._with_ends(self.points)

    @property
    def vertex_weights(self) -> Array:
        """Weights (V, B) of :attr:`vertices`."""
        return self._with_ends(self.weights)

    def _with_ends(self, values: Array) -> Array:
        flat = values.reshape(-1, values.shape[-1])
        if self.ring:
            return flat
        return np.concatenate([flat, values[[0, -1]].mean(axis=1)])

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the tile, texels. They are the same for all bodies, since all share the texture
        layout."""
        rows, columns = self.points.shape[:2]
        return min(8 * rows, _LARGEST), min(10 * columns, _LARGEST)

    @cached_property
    def mesh(self) -> tuple[VertexIndices, Array, VertexIndices]:
        """Faces (F, 4), texture coordinates (T, 2) in the tile, v up, and texture faces (F, 4)."""
        rows, columns = self.points.shape[:2]
        down, wide = rows if self.ring else rows - 1, columns + 1
        r, c = (grid.ravel() for grid in np.mgrid[:down, :columns])
        here, below, across = r * columns, (r + 1) % rows * columns, (c + 1) % columns
        faces = np.stack([here + c, below + c, below + across, here + across], axis=1)
        uv_faces = np.stack([r * wide + c, (r + 1) * wide + c, (r + 1) * wide + c + 1, r * wide + c + 1], 1)
        v, u = np.mgrid[: down + 1, :wide]
        uv = np.stack([u / columns, 1 - v / down], axis=2).reshape(-1, 2)
        if not self.ring:
            k = np.arange(columns)
            after, last = (k + 1) % columns, (rows - 1) * columns
            ends = rows * columns
            tip = (rows - 1) * wide + k
            top, bottom = np.full(columns, ends), np.full(columns, ends + 1)
            faces = np.r_[faces, np.c_[top, k, after, after], np.c_[bottom, last + after, last + k, last + k]]
            uv_faces = np.r_[uv_faces, np.c_[k, k, k + 1, k + 1], np.c_[tip, tip + 1, tip, tip]]
        if _volume(self.vertices, faces) < 0:
            faces, uv_faces = _reversed(faces), _reversed(uv_faces)
        return faces, uv, uv_faces

    @property
    def labels(self) -> NDArray[np.uint8]:
        """(F,) material label of each face."""
        name = "shoes" if self.material == "soles" else self.material
        return np.full(len(self.mesh[0]), MATERIAL_LABELS[name], np.uint8)

    def texels(self) -> Array:
        """Positions (H, W, 3) on the surface that the texels of the tile show."""
        height, width = self.size
        closed = np.concatenate([self.points, self.points[:, :1]], axis=1)
        if self.ring:
            closed = np.concatenate([closed, closed[:1]])
        rows, columns = closed.shape[:2]
        y, x = np.mgrid[:height, :width].astype(np.float32)
        at = (x / max(width - 1, 1) * (columns - 1), y / max(height - 1, 1) * (rows - 1))
        return np.asarray(cv2.remap(closed.astype(np.float32), *at, cv2.INTER_LINEAR), float)


def _volume(vertices: Array, faces: VertexIndices) -> float:
    a, b, c, d = (vertices[faces[:, corner]] for corner in range(4))
    return float(np.einsum("ij,ij->", a, np.cross(b, c) + np.cross(c, d)))


def _reversed(faces: VertexIndices) -> VertexIndices:
    """Faces with the opposite orientation. Triangles keep their repeated last corner."""
    triangle = faces[:, 3] == faces[:, 2]
    turned = faces[:, ::-1].copy()
    turned[triangle] = faces[triangle][:, [1, 0, 2, 2]]
    return turned


@dataclass(frozen=True)
class Wearer:
    """A dressed body in the T pose, with its dressed vertices ``points`` (V, 3) and ``weights`` (V, B).

    ``is_ear``: (V,) above 0 at the ears. ``reference``, ``own``: regions of the reference body and of this
    body.
    """

    mesh: BodySurface
    points: Array
    weights: Array
    is_ear: Array
    reference: BodyRegions
    own: BodyRegions

    @cached_property
    def head_size(self) -> float:
        """Size of the head relative to the reference body."""
        own, reference = self.own, self.reference
        return (own.skull_top - own.eye[1]) / (reference.skull_top - reference.eye[1])

    @cached_property
    def size(self) -> float:
        """Width of the shoulders relative to the reference body."""
        return self.own.shoulder_x / self.reference.shoulder_x

    def on_head(self, points: Array, material: PartMaterial, ring: bool = False) -> WornPart:
        """Part with points (R, C, 3) that moves with the head."""
        return WornPart(points, self.rigid(points.shape[:2], vt3=1.0), material, ring)

    def rigid(self, shape: tuple[int, ...], **shares: float | Array) -> Array:
        """Weights (R, C, B) from shares of bones, by bone name. A share is a number or an array (R, C)."""
        weights = np.zeros((*shape, self.weights.shape[1]))
        for name, share in shares.items():
            weights[..., self.own.bones.index(name)] = share
        return weights

    @cached_property
    def _skin(self) -> tuple[VertexIndices, cKDTree]:
        rows = np.flatnonzero(self.mesh.part == 0)
        return rows, cKDTree(self.points[rows])

    def nearest(self, points: Array) -> VertexIndices:
        """Vertex (...) of the body nearest to points (..., 3)."""
        rows, tree = self._skin
        return np.asarray(rows[tree.query(points)[1]])

    def near_weights(self, points: Array) -> Array:
        """Weights (..., B) of the nearest vertices of points (..., 3)."""
        return self.weights[self.nearest(points)]

    @cached_property
    def head(self) -> Dome:
        """Directions around the head, with the distance of its surface (without ears) in each."""
        return Dome.of(self, self.is_ear < 0.01)

    @cached_property
    def head_with_ears(self) -> Dome:
        """Like :attr:`head`, with ears."""
        return Dome.of(self, np.ones(len(self.is_ear), bool))

    @cached_property
    def normals(self) -> Array:
        """(V, 3) normals of the dressed surface."""
        return vertex_normals(self.points, self.mesh.surface)

    @cached_property
    def trunk(self) -> NDArray[np.bool_]:
        """(V,) whether a vertex is on the trunk or the legs."""
        head = self.weights[:, self.own.bones.index("vt3")]
        return self.armless & (head < 0.5)

    @cached_property
    def armless(self) -> NDArray[np.bool_]:
        """(V,) whether a vertex is on the head, the trunk or the legs."""
        names = enumerate(self.own.bones.names)
        arms = [number for number, name in names if name[2:].startswith(("shoulder", "elbow", "wrist"))]
        return (self.weights[:, arms].sum(axis=1) < 0.5) & (self.mesh.part == 0)

    def surface_z(self, x: float, y: float, side: int) -> float:
        """z of the surface of head, trunk and legs at x and y. ``side``: 1 front, -1 back."""
        points = self.points[self.armless]
        near = points[np.hypot(points[:, 0] - x, points[:, 1] - y) < 0.03 * self.size]
        if not len(near):
            near = points[[np.hypot(points[:, 0] - x, points[:, 1] - y).argmin()]]
        return float(side * (side * near[:, 2]).max())


@dataclass(frozen=True)
class Dome:
    """Directions (R, C, 3) around the centre of the head, and distances (R, C) of its surface. Also its
    positions (R, C, 3) on the reference body. The first row is near the crown, the first column behind."""

    centre: Array
    ray: Array
    reach: Array
    canonical: Array

    @classmethod
    def of(cls, wearer: Wearer, chosen: NDArray[np.bool_]) -> Dome:
        """Dome over the chosen vertices (V,) of the head of a body."""
        own, mesh = wearer.own, wearer.mesh
        size = wearer.head_size
        centre = np.array([0.0, own.ear[1] + 0.035 * size, own.ear[2] + 0.012 * size])
        head = [own.bones.index(name) for name in ("vt3", "temporomandibular")]
        chosen = chosen & (mesh.part == 0) & (wearer.weights[:, head].sum(axis=1) > 0.4)
        faces = mesh.surface[chosen[mesh.surface].all(axis=1)]
        corners = wearer.points[faces]
        samples = [corners[:, k] * (1 - t) + corners[:, k - 1] * t for k in range(4) for t in (0, 0.33, 0.67)]
        points = np.concatenate([*samples, corners.mean(axis=1)]) - centre
        distance = np.linalg.norm(points, axis=1)
        rise = np.arccos(np.clip(points[:, 1] / distance, -1, 1))
        turn = np.arctan2(-points[:, 0], -points[:, 2]) % (2 * np.pi)
        grid = np.zeros((ROWS, COLUMNS))
        row = np.minimum((rise / np.pi * ROWS).astype(int), ROWS - 1)
        np.maximum.at(grid, (row, (turn / (2 * np.pi) * COLUMNS).astype(int) % COLUMNS), distance)
        padded = np.pad(np.pad(grid, ((4, 4), (0, 0)), "edge"), ((0, 0), (4, 4)), "wrap")
        reach = gaussian_filter(grey_closing(padded, (5, 5)), 0.5)[4:-4, 4:-4].clip(0.05 * size, 0.19 * size)
        rise = (np.arange(ROWS) + 0.5) / ROWS * np.pi
        turn = (np.arange(COLUMNS) + 0.5) / COLUMNS * 2 * np.pi
        ring = np.sin(rise)[:, None]
        up = np.repeat(np.cos(rise)[:, None], COLUMNS, axis=1)
        ray = np.stack([-ring * np.sin(turn), up, -ring * np.cos(turn)], axis=2)
        tree_rows = np.flatnonzero(chosen)
        tree = cKDTree(wearer.points[tree_rows])
        found = tree_rows[tree.query(centre + reach[..., None] * ray, k=4)[1]]
        return cls(centre, ray, reach, mesh.canonical[found].mean(axis=2))

    def points(self, thickness: Array, reach: Array | None = None) -> Array:
        """Points (R, C, 3) at a thickness (R, C) above the surface."""
        distance = (self.reach if reach is None else reach) + thickness
        return self.centre + np.maximum(distance, 0.01)[..., None] * self.ray

    def smooth(self, cells: float) -> Array:
        """Distances (R, C) of a smooth surface outside the head, without features smaller than some cells."""
        wrapped = np.pad(np.pad(self.reach, ((8, 8), (0, 0)), "edge"), ((0, 0), (8, 8)), "wrap")
        blurred = gaussian_filter(wrapped, cells)[8:-8, 8:-8]
        return np.maximum(blurred, self.reach)


def hanging_hair(points: Array, out: Array) -> Hanging:
    """Hair (R, C, 3) with a lower end that swings. ``out``: direction (3,) away from the head."""
    rows, columns = points.shape[:2]
    count = rows * columns + 2  # the points that close both ends come last
    share = (np.linspace(0, 1, rows) / 0.85 - 0.15 / 0.85).clip(0) ** 1.3
    shares = np.zeros((count, 2))
    shares[:, 0] = [*np.repeat(share, columns), 0.0, 1.0]
    outwards = out / np.linalg.norm(out)
    nothing = np.zeros((count, 3))
    ends = np.array([[count - 2, count - 1]])
    return Hanging(HAIR_ENDS, ends, outwards[None], np.zeros((count, 2), int), shares, nothing, nothing[:, 0])


#: Number of ends around a skirt that swing.
_ENDS = 8


def hanging_cloth(wearer: Wearer, points: Array, out: Array, room: float) -> Hanging:
    """Cloth around both legs. Its hem swings, and it lies on the thighs when the wearer sits.

    Args:
        wearer: The wearer.
        points: (2 R, C, 3) outer rows from the waist to the hem, then inner rows from the hem to the waist.
        out: Directions (C, 3) away from the body at the hem.
        room: Metres between leg and outer surface of gathered cloth.
    """
    count, columns = len(points) // 2, points.shape[1]
    step = columns // _ENDS
    around, share = np.divmod(np.arange(columns), step)
    share = ramp(share / step, 0.0, 1.0)
    down = (np.linspace(0, 1, count) / 0.85 - 0.15 / 0.85).clip(0) ** 1.5
    down = np.concatenate([down, down[::-1]])[:, None]
    nodes = np.stack([around, (around + 1) % _ENDS], axis=1)
    shares = np.stack([down * (1 - share), down * share], axis=2).reshape(-1, 2)
    at = step * np.arange(_ENDS)
    ends = np.stack([at, (count - 1) * columns + at], axis=1)
    layer = np.repeat([0.0, 0.005 * wearer.size], count * columns)
    flat = points.reshape(-1, 3)
    over_knees = wearer.size * (room + 0.014 * np.repeat(down, columns)) - layer
    half = 0.5 * wearer.own.leg_x(flat)
    gather, left = _gathered(wearer, flat, over_knees), ramp(flat[:, 0], -half, half)
    return Hanging(CLOTH, ends, out[at], np.tile(nodes, (len(points), 1)), shares, gather, left)


def _gathered(wearer: Wearer, points: Array, room: Array) -> Array:
    """Offsets (N, 3) that draw cloth inwards until it is ``room`` (N,) away from the hull of both legs."""
    own, legs = wearer.own, wearer.points[wearer.trunk & (wearer.points[:, 1] < wearer.own.hip_y)]
    across = np.abs(legs[:, 0]) - own.leg_x(legs)
    radius = np.hypot(across, legs[:, 2] - own.leg_z(legs))
    heights = np.linspace(0.2 * own.hip_y, 0.95 * own.hip_y, 40)
    near = np.argpartition(np.abs(legs[:, 1] - heights[:, None]), 100, axis=1)[:, :100]
    thick = np.quantile(radius[near], 0.97, axis=1)
    thick = np.interp(points[:, 1], heights, gaussian_filter(thick, 1.5, mode="nearest")) + room
    # the hull of two circles, seen from the middle between them
    x, z = points[:, 0], points[:, 2] - own.leg_z(points)
    reach = np.maximum(np.hypot(x, z), 1e-6)
    sine, cosine = np.abs(x) / reach, np.abs(z) / reach
    apart = own.leg_x(points)
    flat = thick / np.maximum(cosine, 1e-6)
    bend = apart * sine + np.sqrt(np.maximum(thick**2 - (apart * cosine) ** 2, 0.0))
    hull = np.where(flat * sine <= apart, flat, bend)
    low = ramp(points[:, 1], own.hip_y, own.hip_y - 0.3 * (own.hip_y - own.knee_y))
    inwards = low * np.minimum(hull / reach - 1, 0.0)
    return np.stack([inwards * x, 0 * x, inwards * z], axis=1)


def loose_parts(parts: Sequence[WornPart], first: int) -> LooseParts | None:
    """Join the parts that swing; None if no part swings. ``first``: number of the first vertex of the
    parts."""
    found: list[tuple[NDArray[Any], ...]] = []
    count = 0
    for part in parts:
        if (hanging := part.hanging) is not None:
            moved = np.flatnonzero((hanging.shares > 0).any(axis=1) | hanging.gather.any(axis=1))
            found.append(
                (
                    np.full(len(hanging.ends), hanging.kind),
                    hanging.ends + first,
                    hanging.outwards,
                    moved + first,
                    hanging.nodes[moved] + count,
                    *(values[moved] for values in (hanging.shares, hanging.gather, hanging.left)),
                )
            )
            count += len(hanging.ends)
        first += len(part.vertices)
    if not found:
        return None
    kinds, ends, outwards, rows, nodes, *rest = (np.concatenate(each) for each in zip(*found, strict=True))
    return LooseParts(
        kinds.astype(np.uint8),
        *(ends.astype(np.int32), outwards.astype(np.float32), rows.astype(np.int32), nodes.astype(np.int32)),
        *(values.astype(np.float32) for values in rest),
    )


def part_color(part: WornPart, config: MakeHumanConfig, outfit: Outfit) -> NDArray[np.uint8]:
    """Tile (H, W, 3) of a part."""
    texels = part.texels()
    height, width = texels.shape[:2]
    p = texels.reshape(-1, 3)
    down = np.repeat(np.linspace(0, 1, height), width)
    if part.material == "hair":
        across = np.tile(np.arange(width) / width, height)
        around = np.stack([np.cos(2 * np.pi * across), np.sin(2 * np.pi * across), 0.5 * down], axis=1)
        strands = 0.55 * noise(around, 0.05, 9) + 0.45 * noise(around, 0.02, 10) + 0.3 * noise(p, 0.012, 11)
        color = np.array(outfit.hair) * (1 + 0.34 * strands)[:, None]
    elif part.material in ("top", "bottom"):
        top = part.material == "top"
        girth = max(round(float(np.ptp(p[:, 0])) * 2.6 / 0.036), 1) * 0.036
        turn = girth * np.arctan2(p[:, 0], p[:, 2] - float(np.median(p[:, 2]))) / (2 * np.pi)
        shirt = outfit.shirt_fabric, outfit.shirt, outfit.shirt_second, 12
        trousers = outfit.trousers_fabric, outfit.trousers, outfit.trousers_second, 15
        color = weave(p, p[:, 1], turn, *(shirt if top else trousers))
        if part.ring:  # hems, and the front of a coat
            color *= (1 - 0.25 * line(p[:, 1] - float(p[:, 1].min()) - 0.025, 0.003))[:, None]
            color *= (1 + 0.08 * noise(p * [1, 0.15, 1], 0.05, 51))[:, None]
            if top and TOPS[config.top].front == "buttons":
                color *= (1 - 0.5 * line(p[:, 0] + 0.02, 0.004) * (p[:, 2] > np.median(p[:, 2])))[:, None]
    elif part.material in ("shoes", "soles"):
        plain = outfit.shoes if part.material == "shoes" else outfit.soles
        color = np.array(plain) * (1 + 0.08 * noise(p, 0.006, 52))[:, None]
    else:
        name = cast(WornName, part.material)
        worn = WORN[name]
        main = outfit.worn.get(name, worn.color)
        color = weave(p, p[:, 1], p[:, 0] + p[:, 2], worn.fabric, main, main, 53)
        if worn.shape in ("scarf", "wrap"):
            color *= (1 + 0.10 * noise(p * [1, 2.0, 1], 0.02, 54))[:, None]
        if worn.place == "back":  # the pocket and its zip
            color *= (1 - 0.5 * line(p[:, 1] - float(np.quantile(p[:, 1], 0.45)), 0.006))[:, None]
    return np.clip(np.rint(color), 0, 255).astype(np.uint8).reshape(height, width, 3)


def placed(parts: Sequence[WornPart]) -> tuple[list[tuple[int, int]], int]:
    """Row and column of the tile of each part in a strip of the texture, and the height of the strip."""
    x = y = tall = 0
    places = [(0, 0)] * len(parts)
    for number in sorted(range(len(parts)), key=lambda n: -parts[n].size[0]):
        height, width = (side + 2 * _MARGIN for side in parts[number].size)
        if x + width > _WIDTH:
            x, y, tall = 0, y + tall, 0
        places[number] = (y + _MARGIN, x + _MARGIN)
        x, tall = x + width, max(tall, height)
    return places, -(-(y + tall) // 64) * 64


def strip_image(parts: Sequence[WornPart], config: MakeHumanConfig, outfit: Outfit) -> NDArray[np.uint8]:
    """Strip (H, 1024, 3) of the texture with the tiles of all parts."""
    places, height = placed(parts)
    strip = np.zeros((height, _WIDTH, 3), np.uint8)
    for part, (y, x) in zip(parts, places, strict=True):
        tile = part_color(part, config, outfit)
        framed = np.pad(tile, ((_MARGIN, _MARGIN), (_MARGIN, _MARGIN), (0, 0)), "edge")
        strip[y - _MARGIN :, x - _MARGIN :][: framed.shape[0], : framed.shape[1]] = framed
    return strip


def add_parts(
    arrays: dict[str, NDArray[Any]], parts: Sequence[WornPart], texture: int
) -> dict[str, NDArray[Any]]:
    """Add vertices, faces, uv, uv_faces and weights of parts to the arrays of a body. ``texture``: number of
    rows of the body's texture, below which the strip of the parts is added."""
    if not parts:
        return arrays
    places, strip = placed(parts)
    total = texture + strip
    uv = arrays["uv"].copy()
    uv[:, 1] = (uv[:, 1] * texture + strip) / total
    columns: dict[str, list[NDArray[Any]]] = {
        name: [arrays[name]] for name in ("vertices", "faces", "uv_faces", "weights")
    }
    uvs = [uv]
    for part, (y, x) in zip(parts, places, strict=True):
        faces, own_uv, uv_faces = part.mesh
        height, width = part.size
        first, first_uv = sum(map(len, columns["vertices"])), sum(map(len, uvs))
        across = (x + 0.5 + own_uv[:, 0] * (width - 1)) / _WIDTH
        row = texture + y + 0.5 + (1 - own_uv[:, 1]) * (height - 1)
        uvs.append(np.stack([across, 1 - row / total], axis=1))
        columns["vertices"].append(part.vertices)
        columns["faces"].append(faces + first)
        columns["uv_faces"].append(uv_faces + first_uv)
        columns["weights"].append(part.vertex_weights)
    return {**arrays, "uv": np.concatenate(uvs), **{name: np.concatenate(v) for name, v in columns.items()}}
