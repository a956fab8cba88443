"""Make the file of teeth and tongue of MakeHuman people: ``python tools/assets/pack_mouth.py``.

Writes assets/makehuman/mouth.npz from assets/makehuman/base.npz. The file has everything of teeth and tongue
that is the same for all people: faces, labels, bones, offsets of the actions of the face, and the colours of
their tile in the texture.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from humansim_ros.files.mesh import MATERIAL_LABELS  # noqa: E402
from humansim_ros.files.reading import write_npz  # noqa: E402
from humansim_ros.people.makehuman.data import METRES, VertexIndices, people_data  # noqa: E402
from humansim_ros.people.makehuman.face import GROUPS, OPEN, TILE, face_offsets, group_rows  # noqa: E402
from humansim_ros.types import Array  # noqa: E402

OUT = ROOT / "assets" / "makehuman" / "mouth.npz"
#: Rows of the tile by group.
ROWS = {"helper-upper-teeth": (2, 38), "helper-lower-teeth": (44, 80), "helper-tongue": (86, 126)}
TOOTH, GAP, GUM = (np.array(c, float) for c in ((214, 204, 184), (120, 92, 78), (158, 82, 78)))
TONGUE = np.array((168, 84, 84), float)
#: Number of teeth in a row; and rows of vertices of a tooth: gum, root, edge, and behind.
TEETH, DEPTH = 16, 4


def mouth_arrays() -> dict[str, NDArray[Any]]:
    """Arrays of the file: the fields of ``_Parts`` in humansim_ros/people/makehuman/face.py."""
    source = people_data()
    base = source.base
    rows = np.concatenate([group_rows(base, group) for group in GROUPS])
    place = np.full(len(base.vertices), -1)
    place[rows] = np.arange(len(rows))
    faces, labels, tile = [], [], np.zeros((len(base.vertices), 2))
    bones = np.empty(len(base.vertices), object)
    for group, (bone, material, _) in GROUPS.items():
        own = base.faces[base.face_groups == group]
        used = group_rows(base, group)
        bones[used] = bone
        if material == "teeth":
            grid = teeth_grid(base.vertices, own)
            own = np.concatenate([own, back_of(own, grid)])
            tile[grid] = tile_places(group, np.moveaxis(np.indices(grid.shape), 0, 2) / [TEETH, DEPTH - 1])
        else:
            flat = base.vertices[used][:, [0, 2]]
            tile[used] = tile_places(group, (flat - flat.min(axis=0)) / np.ptp(flat, axis=0))
        faces.append(place[own])
        labels.append(np.full(len(own), MATERIAL_LABELS[material], np.uint8))
    moved, steps = source.face_action(OPEN)
    opening = METRES * steps[np.isin(moved, base.vertex_groups["body"])]
    return {
        "faces": np.concatenate(faces),
        "labels": np.concatenate(labels),
        "bones": bones[rows].astype(str),
        "tile": tile[rows],
        "lower_teeth": place[group_rows(base, "helper-lower-teeth")],
        "offsets": face_offsets(source, rows).reshape(len(rows), -1, 3),
        "largest": np.abs(opening).max(),
        "image": painted(),
    }


def tile_places(group: str, shares: Array) -> Array:
    """Texture coordinates (..., 2) in the tile that teeth and tongue share, 0 to 1 across and down.
    ``shares``: (..., 2) coordinates in the part of the tile that a group has, 0 to 1 across and down."""
    across, down = TILE[2:]
    top, bottom = ROWS[group]
    return (np.array([1, top]) + shares * [across - 2, bottom - top]) / [across, down]


def teeth_grid(vertices: Array, faces: VertexIndices) -> VertexIndices:
    """Vertices (17, 4) of a row of teeth: from right to left, and from the gum over the edge to the back."""
    around: dict[int, set[int]] = {}
    for quad in faces.tolist():
        for k in range(4):
            around.setdefault(quad[k], set()).add(quad[k - 1])
            around.setdefault(quad[k - 1], set()).add(quad[k])
    corners = [vertex for vertex, near in around.items() if len(near) == 2 and vertices[vertex, 0] < 0]
    start, end = sorted(corners, key=lambda vertex: vertices[vertex, 0])  # the gum is outside
    pairs = ((a, b) for a in around[start] for b in around[a] & around[end] if len(around[a]) == 3)
    column = [start, *next(pairs), end]
    columns = [column]
    seen = set(column)
    while len(columns) <= TEETH:
        column = [next(iter(around[vertex] - seen)) for vertex in column]
        columns.append(column)
        seen.update(column)
    return np.array(columns)


def back_of(faces: VertexIndices, grid: VertexIndices) -> VertexIndices:
    """Faces (18, 4) that close the back of a row of teeth, so that renderers need not draw its inside."""
    behind = np.stack([grid[:-1, 0], grid[1:, 0], grid[1:, -1], grid[:-1, -1]], axis=1)
    quads = np.concatenate([behind, [grid[0, ::-1], grid[-1]]])
    (first,) = np.flatnonzero(np.isin(faces, grid[:2, 0]).sum(axis=1) == 2)
    corners = faces[first].tolist()
    ahead = corners[(corners.index(grid[0, 0]) + 1) % 4] == grid[1, 0]
    return quads[:, ::-1] if ahead else quads


def painted() -> NDArray[np.uint8]:
    """Colours (H, W, 3) of the tile."""
    across, down = TILE[2:]
    image = np.tile(GUM, (down, across, 1))
    column = (np.arange(across) - 0.5).clip(0, across - 2) / (across - 2)
    back = np.abs(2 * column - 1)[:, None] ** 1.5
    for group in ("helper-upper-teeth", "helper-lower-teeth"):
        top, bottom = ROWS[group]
        depth = (np.arange(bottom - top) + 0.5) / (bottom - top) * (DEPTH - 1)
        along = column * TEETH % 1
        arch = 0.85 - 0.35 * np.sin(np.pi * along) ** 0.7  # the gum is lower between teeth
        crown = ((depth[:, None] - arch) / 0.12).clip(0, 1) * ((2.7 - depth[:, None]) / 0.3).clip(0, 1)
        between = np.exp(-((np.minimum(along, 1 - along) / 0.09) ** 2)) * 0.7
        tooth = TOOTH + between[:, None] * (GAP - TOOTH)
        image[top:bottom] = GUM + crown[..., None] * (tooth - GUM)
        image[top:bottom] *= 1 - 0.5 * back
        image[top:bottom] *= (1 - 0.3 * (depth - 2).clip(0, 1))[:, None, None]
    top, bottom = ROWS["helper-tongue"]
    front = (np.arange(bottom - top) / (bottom - top))[:, None, None]
    groove = 1 - 0.1 * np.exp(-(((column - 0.5) / 0.06) ** 2))
    image[top:bottom] = TONGUE * (0.2 + 0.8 * ((front - 0.4) / 0.6).clip(0) ** 1.5) * groove[:, None]
    return image.round().clip(0, 255).astype(np.uint8)


if __name__ == "__main__":
    write_npz(OUT, mouth_arrays())
    print(f"{OUT}: {OUT.stat().st_size / 1e3:.0f} kB")
