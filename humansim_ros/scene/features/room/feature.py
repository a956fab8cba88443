"""A procedural furnished room: textured floor, walls and furniture.

Furniture is along the walls; the middle is free. Coordinates are in ``map``: metres, z up, floor at z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache, partial

import cv2
import numpy as np

from humansim_ros.files.mesh import Mesh
from humansim_ros.scene.core.environment import Fixture, Furnishing
from humansim_ros.scene.core.features import Draft, Feature
from humansim_ros.scene.core.looks import BlankNumbers, Rng, noise, planks, plaster, poster, shaded, weave
from humansim_ros.scene.core.objects import BOOKS
from humansim_ros.types import Array, Image

#: x and y.
_Point = tuple[float, float]


def furnished_room(
    size: tuple[float, float, float] = (7.0, 6.4, 2.8), seed: int = 1, has_textures: bool = True
) -> list[Mesh]:
    """Meshes of a room around the origin; the same seed gives the same room.

    Args:
        size: Size (x, y, z), metres.
        seed: Seed of colours, patterns and books.
        has_textures: Whether the textures are needed. If not, they may be blank.
    """
    rng = (np.random.Generator if has_textures else BlankNumbers)(np.random.PCG64(seed))
    length, width, height = size
    plan = {name: (each.center, each.size) for name, each in fixtures((length, width)).items()}
    x, y = length / 2, width / 2
    wood, pale, dark = planks(rng, (150, 112, 78)), planks(rng, (196, 172, 138)), planks(rng, (92, 66, 48))
    cloth = weave(rng, (74, 98, 92))
    meshes = [
        _floor(length, width, planks(rng, (168, 138, 104), rows=12)),
        *_walls(x, y, height, rng),
        _quad(
            [(-1.9, -1.35, 0.004), (1.9, -1.35, 0.004), (1.9, 1.35, 0.004), (-1.9, 1.35, 0.004)], _rug(rng)
        ),
        *_table(*plan["table"], _TOPS["table"], wood),
        *_sofa(*plan["sofa"], cloth),
        *_shelf(*plan["shelf"], 1.9, pale, rng),
        _standing(*plan["cabinet"], _TOPS["cabinet"], dark),
        _standing(*plan["carton"], _TOPS["carton"], _cardboard(rng)),
        _box((0.42, -y + 0.27, 0.6), (0.42, 0.36, 0.32), _cardboard(rng)),
        _standing(*plan["small carton"], _TOPS["small carton"], _cardboard(rng)),
        _standing(*plan["door"], 2.04, _door(rng)),
    ]
    for center, along, picture_size in (
        ((2.2, y - 0.015, 1.6), (-1, 0, 0), (0.9, 0.65)),
        ((1.6, -y + 0.015, 1.65), (1, 0, 0), (0.75, 1.0)),
        ((x - 0.015, 1.3, 1.6), (0, -1, 0), (1.2, 0.8)),
        ((x - 0.015, -1.6, 1.7), (0, -1, 0), (0.6, 0.8)),
        ((-x + 0.015, -1.5, 1.6), (0, 1, 0), (1.0, 0.75)),
        ((-x + 0.015, 0.5, 1.75), (0, 1, 0), (1.3, 0.6)),
    ):
        meshes.append(_picture(center, along, picture_size, rng))
    return meshes


def fixtures(size: tuple[float, float]) -> dict[str, Fixture]:
    """What stands on the floor of a room of ``size`` (x, y), by name; metres."""
    x, y = size[0] / 2, size[1] / 2
    plan = {
        "table": ((x - 0.62, -0.5), (0.9, 1.7)),
        "sofa": ((-x + 0.52, 0.4), (0.95, 2.0)),
        "shelf": ((-0.7, y - 0.19), (1.5, 0.34)),
        "cabinet": ((1.25, y - 0.24), (0.5, 0.42)),
        "carton": ((0.4, -y + 0.28), (0.6, 0.5)),
        "small carton": ((1.1, -y + 0.26), (0.45, 0.45)),
        "door": ((-1.3, -y + 0.03), (0.92, 0.05)),
    }
    return {name: Fixture(*place, _TOPS.get(name)) for name, place in plan.items()}


#: Heights of furniture with a free surface, and of the seat of the sofa, metres.
_TOPS = {"table": 0.74, "sofa": 0.40, "cabinet": 0.9, "carton": 0.44, "small carton": 0.34}


def _floor(length: float, width: float, image: Image) -> Mesh:
    x, y = length / 2, width / 2
    corners = [(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)]
    return _quad(corners, image, repeat=(length / 2.0, width / 2.0))


def _walls(x: float, y: float, height: float, rng: Rng) -> list[Mesh]:
    plain = plaster(rng, (214, 208, 196))
    accent = plaster(rng, (156, 172, 176))
    trim = plaster(rng, (236, 234, 228))
    corners = [(x, y), (-x, y), (-x, -y), (x, -y)]
    meshes: list[Mesh] = [_quad([(-x, -y, height), (-x, y, height), (x, y, height), (x, -y, height)], trim)]
    for i, image in enumerate((plain, accent, plain, plain)):
        (ax, ay), (bx, by) = corners[i], corners[(i + 1) % 4]
        span = float(np.hypot(bx - ax, by - ay))
        wall = [(ax, ay, 0), (bx, by, 0), (bx, by, height), (ax, ay, height)]
        meshes.append(_turned(_quad(wall, image, (span / 2, height / 2))))
        middle = ((ax + bx) / 2, (ay + by) / 2, 0.05)
        meshes.append(_box(middle, (abs(bx - ax) + 0.03, abs(by - ay) + 0.03, 0.1), trim))
    return meshes


def _table(at: _Point, size: _Point, h: float, image: Image) -> list[Mesh]:
    (x, y), (w, d) = at, size
    legs = [(x + sx * (w / 2 - 0.06), y + sy * (d / 2 - 0.06)) for sx in (-1, 1) for sy in (-1, 1)]
    return [
        _box((x, y, h - 0.02), (w, d, 0.04), image),
        *(_box((a, b, h / 2), (0.06, 0.06, h - 0.04), image) for a, b in legs),
    ]


def _sofa(at: _Point, size: _Point, image: Image) -> list[Mesh]:
    (x, y), (w, d) = at, size
    return [
        _box((x, y, 0.22), (w, d, 0.36), image),
        _box((x - w / 2 + 0.13, y, 0.55), (0.26, d, 0.5), image),
        _box((x, y - d / 2 + 0.1, 0.42), (w, 0.2, 0.4), image),
        _box((x, y + d / 2 - 0.1, 0.42), (w, 0.2, 0.4), image),
    ]


def _shelf(at: _Point, size: _Point, h: float, image: Image, rng: Rng) -> list[Mesh]:
    (x, y), (w, d) = at, size
    meshes = [_box((x + s * (w / 2 - 0.015), y, h / 2), (0.03, d, h), image) for s in (-1, 1)]
    levels = np.linspace(0.04, h - 0.015, 6)
    meshes += [_box((x, y, float(z)), (w, d, 0.03), image) for z in levels]
    for z in levels[:-1]:
        left = -w / 2 + 0.05
        while left < w / 2 - 0.12:
            book = float(rng.uniform(0.025, 0.07))
            tall = float(rng.uniform(0.2, 0.31))
            if rng.random() < 0.82:
                color = BOOKS[int(rng.integers(len(BOOKS)))]
                center = (x + left + book / 2, y - 0.03, float(z) + 0.015 + tall / 2)
                meshes.append(_box(center, (book, 0.22, tall), plaster(rng, color, 64)))
            left += book + 0.004
    return meshes


def _picture(at: Sequence[float], along: Sequence[float], size: tuple[float, float], rng: Rng) -> Mesh:
    centre, right, up = np.array(at), np.array(along, dtype=float), np.array([0.0, 0.0, 1.0])
    w, h = right * size[0] / 2, up * size[1] / 2
    corners = [centre - w - h, centre + w - h, centre + w + h, centre - w + h]
    picture = _quad(corners, poster(rng, (int(360 * size[1]), int(360 * size[0]))))
    inwards = np.cross(right, up) @ centre < 0
    return picture if inwards else _turned(picture)


def _quad(
    corners: Sequence[Sequence[float] | Array], image: Image, repeat: tuple[float, float] = (1.0, 1.0)
) -> Mesh:
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * np.array(repeat)
    face = np.array([[0, 1, 2, 3]], dtype=np.int32)
    return Mesh(np.array(corners, dtype=float), face, uv, face, texture=image)


def _turned(mesh: Mesh) -> Mesh:
    """Quad with its front on the other side."""
    faces = np.ascontiguousarray(mesh.faces[:, [0, 3, 2, 1]])
    return replace(mesh, faces=faces, uv_faces=faces)


def _standing(at: _Point, size: _Point, height: float, image: Image) -> Mesh:
    """Box on the floor."""
    return _box((*at, height / 2), (*size, height), image)


def _box(centre: Sequence[float], size: Sequence[float], image: Image) -> Mesh:
    """Box with textures of one metre; sides share no vertices: edges are sharp in shading."""
    half = np.array(size) / 2
    vertices, uv = [], []
    for axis in range(3):
        u, v = (1, 2) if axis == 0 else (0, 2) if axis == 1 else (0, 1)
        for sign in (-1, 1):
            for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                point = np.zeros(3)
                point[axis], point[u], point[v] = sign * half[axis], a * half[u], b * half[v]
                vertices.append(point + np.array(centre))
                uv.append((a * half[u] + half[u], b * half[v] + half[v]))
    faces = np.arange(24, dtype=np.int32).reshape(6, 4)
    # corners of every face run counter-clockwise seen from outside
    for number, (axis, sign) in enumerate((a, s) for a in range(3) for s in (-1, 1)):
        if (sign > 0) == (axis == 1):
            faces[number] = faces[number, ::-1]
    return Mesh(np.array(vertices), faces, np.array(uv), faces, texture=image)


def _rug(rng: Rng) -> Image:
    h, w = shape = 720, 1024
    image = np.full((h, w, 3), (172, 160, 140), np.uint8)
    for inset, color in (
        (0, (96, 62, 58)),
        (26, (196, 184, 160)),
        (38, (70, 84, 104)),
        (70, (196, 184, 160)),
        (80, (124, 74, 66)),
    ):
        cv2.rectangle(image, (inset, inset), (w - 1 - inset, h - 1 - inset), color, -1)
    for i in range(7):
        for j in range(4):
            centre = np.array([150 + i * 121, 135 + j * 150])
            for radius, color in ((46, (196, 176, 140)), (34, (70, 84, 104)), (18, (206, 196, 176))):
                diamond = centre + radius * np.array([[1, 0], [0, 1.15], [-1, 0], [0, -1.15]])
                cv2.fillPoly(image, [np.rint(diamond).astype(np.int32)], color, cv2.LINE_AA)
    light = 1 + 0.06 * noise(rng, shape, 1.5) + 0.03 * noise(rng, shape, 20)
    return np.clip(image * light[..., None], 0, 255).astype(np.uint8)


def _cardboard(rng: Rng) -> Image:
    image = shaded((176, 138, 96), 0.03 * noise(rng, (256, 256), 3) + 0.03 * noise(rng, (256, 256), 30))
    image[:, 56:76] = (image[:, 56:76] * 0.4 + np.array([214, 198, 160]) * 0.6).astype(np.uint8)
    return image


def _door(rng: Rng) -> Image:
    image = cv2.resize(planks(rng, (188, 164, 132), rows=1), (512, 1024))
    for top in (80, 560):
        cv2.rectangle(image, (80, top), (400, top + 380), (150, 128, 100), 6)
    return np.asarray(image, dtype=np.uint8)


class Room(Feature):
    """The section ``room``."""

    def prepare(self, draft: Draft) -> None:
        """Add the room and its furniture."""
        room = draft.config.room
        assert room is not None
        draft.furnishing = Furnishing(fixtures(room.size[:2]), partial(_furnished, room.size, room.seed))


@lru_cache(maxsize=4)
def _furnished(size: tuple[float, float, float], seed: int, has_textures: bool) -> tuple[Mesh, ...]:
    """Meshes of a room, cached for editors, which make a scene again after each edit."""
    return tuple(furnished_room(size, seed, has_textures))


FEATURE = Room()
