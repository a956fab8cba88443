"""Built-in furniture: meshes in metres with their own colours, to occlude people as real rooms do.

The origin is on the floor, in the middle of what stands there. The front is towards +x, z is up. Parts share
no vertices: their edges are sharp in shading. The colour of a scene replaces the main colour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from humansim_ros.mesh.mesh import Material, Mesh
from humansim_ros.types import Array, Color

_BOOKS: tuple[Color, ...] = (
    *((150, 60, 52), (58, 84, 120), (196, 176, 130)),
    *((70, 100, 76), (60, 56, 62), (206, 204, 196)),
)
_METAL: Color = (150, 152, 156)


@dataclass(frozen=True)
class _Part:
    """A box: its centre and size in metres, its colour (None for the main colour), and a turn about z."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    color: Color | None = None
    turn_deg: float = 0.0


@dataclass(frozen=True)
class Furniture:
    """One kind of furniture.

    Attributes:
        description: A line for people, with its size.
        color: Main colour, sRGB.
        roughness: Roughness of its surface, 0 to 1.
        parts: The boxes that it is made of.
    """

    description: str
    color: Color
    roughness: float
    parts: tuple[_Part, ...]

    def mesh(self, color: Color | None = None) -> Mesh:
        """Mesh in metres; ``color`` in place of the main colour."""
        main = self.color if color is None else color
        vertices = np.concatenate([_corners(part) for part in self.parts])
        faces = np.concatenate([_BOX_FACES + 24 * number for number in range(len(self.parts))])
        colors = np.repeat([main if part.color is None else part.color for part in self.parts], 24, axis=0)
        material = Material(roughness=self.roughness, double_sided=False)
        return Mesh(vertices, faces, colors=colors.astype(np.uint8), material=material)


_BOX_FACES = np.arange(24, dtype=np.int32).reshape(6, 4)
_SIDE = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2


def _corners(part: _Part) -> Array:
    """Corners (24, 3) of a box, four for each side, counter-clockwise as seen from outside."""
    sides = []
    for axis in range(3):
        for sign in (-0.5, 0.5):
            side = np.insert(_SIDE if sign > 0 else _SIDE[::-1], 0, sign, axis=1)
            sides.append(np.roll(side, axis, axis=1))
    angle = np.radians(part.turn_deg)
    turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return np.asarray(np.concatenate(sides) * part.size @ turn + part.center)


def _legs(depth: float, width: float, height: float, thickness: float) -> list[_Part]:
    x, y = (depth - thickness) / 2, (width - thickness) / 2
    size = (thickness, thickness, height)
    return [_Part((i * x, j * y, height / 2), size) for i in (-1, 1) for j in (-1, 1)]


def _table() -> list[_Part]:
    depth, width, height, top = 0.8, 1.6, 0.74, 0.03
    legs = _legs(depth - 0.06, width - 0.06, height - top, 0.06)
    rail = height - top - 0.045
    rails = [_Part((i * (depth / 2 - 0.06), 0, rail), (0.02, width - 0.18, 0.09)) for i in (-1, 1)]
    rails += [_Part((0, j * (width / 2 - 0.06), rail), (depth - 0.18, 0.02, 0.09)) for j in (-1, 1)]
    return [_Part((0, 0, height - top / 2), (depth, width, top)), *legs, *rails]


def _chair() -> list[_Part]:
    depth, width, seat, back, leg = 0.44, 0.43, 0.45, 0.9, 0.036
    x, y = (depth - leg) / 2, (width - leg) / 2
    front = [_Part((x, j * y, (seat - 0.02) / 2), (leg, leg, seat - 0.02)) for j in (-1, 1)]
    posts = [_Part((-x, j * y, back / 2), (leg, leg, back)) for j in (-1, 1)]
    slats = [_Part((-x, 0, z), (0.018, width - 2 * leg, 0.09)) for z in (0.6, 0.72, 0.84)]
    rails = [_Part((0, j * y, 0.2), (depth - 2 * leg, 0.02, 0.025)) for j in (-1, 1)]
    cushion = _Part((leg / 4, 0, seat - 0.02), (depth - leg / 2, width - 0.01, 0.04), (74, 98, 92))
    return [cushion, *front, *posts, *slats, *rails]


def _door() -> list[_Part]:
    width, height, jamb, depth = 0.9, 2.0, 0.07, 0.12
    white: Color = (226, 222, 212)
    frame = [
        _Part((0, j * (width + jamb) / 2, (height + jamb) / 2), (depth, jamb, height + jamb), white)
        for j in (-1, 1)
    ]
    frame.append(_Part((0, 0, height + jamb / 2), (depth, width, jamb), white))
    leaf = _Part((0, 0, height / 2 + 0.003), (0.04, width - 0.006, height - 0.006))
    panels = [
        _Part((i * 0.021, 0, z), (0.008, 0.6, 0.72), (176, 146, 108)) for i in (-1, 1) for z in (0.55, 1.45)
    ]
    handles = [_Part((i * 0.05, 0.3, 1.05), (0.02, 0.13, 0.022), _METAL) for i in (-1, 1)]
    handles += [_Part((i * 0.03, 0.36, 1.05), (0.04, 0.025, 0.05), _METAL) for i in (-1, 1)]
    return [*frame, leaf, *panels, *handles]


def _screen() -> list[_Part]:
    width, height, thickness, turn = 0.6, 1.75, 0.03, 25.0
    cosine, sine = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    parts = []
    for number in (-1, 0, 1):
        # the outer panels turn forwards, about the edges of the middle one
        angle = number * turn
        x = abs(number) * sine * width / 2
        y = number * (width + cosine * width) / 2
        parts.append(_Part((x, y, height / 2 + 0.03), (thickness, width - 0.01, height - 0.06), None, angle))
        rim: Color = (96, 72, 54)
        along = np.array([-np.sin(np.radians(angle)), np.cos(np.radians(angle))])
        for side in (-1, 1):
            dx, dy = side * (width / 2 - 0.015) * along
            parts.append(_Part((x + dx, y + dy, height / 2), (thickness + 0.012, 0.03, height), rim, angle))
        for z in (0.05, height - 0.015):
            parts.append(_Part((x, y, z), (thickness + 0.012, width - 0.06, 0.03), rim, angle))
    return parts


def _shelf() -> list[_Part]:
    depth, width, height, board = 0.3, 0.9, 1.8, 0.02
    sides = [_Part((0, j * (width - board) / 2, height / 2), (depth, board, height)) for j in (-1, 1)]
    levels = np.linspace(0.06, height - board / 2, 6).tolist()
    boards = [_Part((0, 0, z), (depth, width - 2 * board, board)) for z in levels]
    back = _Part((-depth / 2 + 0.004, 0, height / 2), (0.008, width - 2 * board, height - 0.02))
    return [*sides, *boards, back, *_books(levels, width - 2 * board, board)]


def _books(levels: Sequence[float], width: float, board: float) -> list[_Part]:
    """Books on all boards but the top one, always the same."""
    rng = np.random.default_rng(7)
    books = []
    for level in levels[:-1]:
        left = -width / 2 + 0.02
        while left < width / 2 - 0.09:
            thick, tall = float(rng.uniform(0.02, 0.06)), float(rng.uniform(0.19, 0.29))
            if rng.random() < 0.85:
                center = (-0.02, left + thick / 2, level + board / 2 + tall / 2)
                books.append(_Part(center, (0.2, thick, tall), _BOOKS[int(rng.integers(len(_BOOKS)))]))
            left += thick + 0.003
    return books


#: Built-in furniture by name.
FURNITURE: dict[str, Furniture] = {
    "table": Furniture("table, 1.6 m wide, 0.8 m deep, 0.74 m high", (150, 112, 78), 0.5, tuple(_table())),
    "chair": Furniture("chair, seat 0.45 m high, back 0.9 m high", (92, 66, 48), 0.6, tuple(_chair())),
    "door": Furniture(
        "closed door in its frame, 1.04 m wide, 2.07 m high", (188, 160, 124), 0.6, tuple(_door())
    ),
    "screen": Furniture(
        "folding screen of three panels, 1.7 m wide, 1.75 m high", (206, 196, 174), 0.9, tuple(_screen())
    ),
    "shelf": Furniture(
        "shelf with books, 0.9 m wide, 0.3 m deep, 1.8 m high", (196, 172, 138), 0.6, tuple(_shelf())
    ),
}
