"""Face of MakeHuman people: actions, teeth and tongue.

The 52 actions are targets (CC0) with the names of Apple's ARKit. Teeth and tongue are helper surfaces of the
base mesh, inside the head. A human file stores only their positions (``mouth``). Everything else is the same
for all people: faces, actions of the face, bones and colours.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, vstack

from humansim_ros.files.mesh import MATERIAL_LABELS
from humansim_ros.motion.body import ACTIONS, BONE, MOVES, Jaw, Shapes
from humansim_ros.people.humans.human import Human
from humansim_ros.people.makehuman.data import METRES, Base, MakeHumanData, VertexIndices, people_data
from humansim_ros.types import Array

#: Prefix of the names of actions that turn the eyes. Bones turn the eyeballs, so these shapes move only the
#: lids.
_LOOK = "eyeLook"


def face_offsets(source: MakeHumanData, rows: VertexIndices) -> Array:
    """Offsets (V, 3 S) in metres of the S actions at vertices ``rows`` (V,) of the base mesh, in the A pose.

    Raises MeshError if a target is missing.
    """
    groups = source.base.vertex_groups
    eyes = np.concatenate([groups["helper-l-eye"], groups["helper-r-eye"]])
    place = np.full(len(source.base.vertices), -1)
    place[rows] = np.arange(len(rows))
    offsets = np.zeros((len(rows), len(ACTIONS), 3))
    for number, name in enumerate(ACTIONS):
        moved, steps = source.face_action(name)
        used = place[moved] >= 0
        if name.startswith(_LOOK):
            used &= ~np.isin(moved, eyes)
        offsets[place[moved[used]], number] = METRES * steps[used]
    return offsets.reshape(len(rows), -1)


def unskin_offsets(offsets: Array, weights: Array, motion: Array) -> Array:
    """Convert offsets (V, 3 S) in the A pose, metres, to offsets (V, S, 3) in the T pose. ``weights``: (V,
    B). ``motion``: transforms (B, 4, 4) of the bones, as for ``skeleton.unskin``."""
    out = offsets.reshape(len(offsets), -1, 3).copy()
    rows = np.flatnonzero(out.any(axis=(1, 2)))
    back = np.einsum("nb,bij->nij", weights[rows], np.linalg.inv(motion)[:, :3, :3])
    out[rows] = np.swapaxes(np.linalg.solve(back, np.swapaxes(out[rows], 1, 2)), 1, 2)
    return out


#: Groups of the base mesh with bone and material, in the order of the positions in files. Each group is moved
#: upwards and forwards by its last two numbers, metres: the surfaces of both rows overlap by a centimetre,
#: and are so near behind the lips that the lips would not cover them.
_GROUPS: Mapping[str, tuple[str, str, tuple[float, float]]] = {
    "helper-upper-teeth": ("vt3", "teeth", (0.0005, -0.001)),
    "helper-lower-teeth": (BONE, "teeth", (-0.004, -0.002)),
    "helper-tongue": (BONE, "tongue", (-0.0035, -0.002)),
}
#: Width of the textures of all bodies. Unused texels in them: column and row of the corner, width and height;
#: and rows of its tiles.
_WIDTH = 1024
_TILE = (545, 400, 96, 128)
_ROWS = {"helper-upper-teeth": (2, 38), "helper-lower-teeth": (44, 80), "helper-tongue": (86, 126)}
_TOOTH, _GAP, _GUM = (np.array(c, float) for c in ((214, 204, 184), (120, 92, 78), (158, 82, 78)))
_TONGUE = np.array((168, 84, 84), float)
#: Action with offsets that show the size of a body.
_OPEN = "jawOpen"
#: Number of teeth in a row; and rows of vertices of a tooth: gum, root, edge, and behind.
_TEETH, _DEPTH = 16, 4


def mouth_places(base: Base) -> Array:
    """Positions (M, 3) of teeth and tongue of a base mesh, metres."""
    return np.concatenate(
        [base.vertices[_rows(base, group)] + [0.0, *shift] for group, (*_, shift) in _GROUPS.items()]
    )


def _rows(base: Base, group: str) -> VertexIndices:
    return np.unique(base.faces[base.face_groups == group])


def has_mouth(human: Human) -> bool:
    """Whether a human has teeth and a tongue that :func:`with_mouth` can show."""
    mesh = human.mesh
    return (
        _has_places(human)
        and mesh.texture is not None
        and mesh.texture.shape[0] >= mesh.texture.shape[1] == _WIDTH
        and mesh.faces.shape[1] == 4
        and mesh.shading is None
    )


def jaw_of(human: Human) -> Jaw | None:
    """Jaw of a human, which actions of the face move; None if its file has no teeth."""
    if not _has_places(human):
        return None
    assert human.mouth is not None and human.shapes is not None
    parts, group = _parts(), "helper-lower-teeth"
    some = parts.groups[group]
    teeth = human.mouth[some] - [0.0, *_GROUPS[group][2]]
    offsets = _size(human.shapes) * parts.offsets[some]
    return Jaw.of(human.skeleton, teeth, {name: offsets[:, ACTIONS.index(name)] for name in MOVES})


def _has_places(human: Human) -> bool:
    """Whether a human has positions of teeth and tongue, and the bones and actions that move them."""
    return (
        human.mouth is not None
        and human.shapes is not None
        and set(MOVES) <= set(human.shapes.names)
        and {"vt3", BONE} <= set(human.skeleton.names)
        and len(human.mouth) == len(_parts().bones)
    )


def _size(shapes: Shapes) -> float:
    """Size of a body relative to MakeHuman's base mesh, from the largest offset of ``jawOpen``."""
    return _largest(shapes, _OPEN) / _parts().largest


def with_mouth(human: Human) -> Human:
    """Add teeth and tongue at the end of the human's mesh. A human without them is returned unchanged. The
    other vertices keep their numbers. The human has one outfit."""
    if not has_mouth(human):
        return human
    mesh, parts, shapes = human.mesh, _parts(), human.shapes
    assert human.mouth is not None and shapes is not None and mesh.texture is not None
    assert mesh.uv is not None and mesh.uv_faces is not None
    first, width = len(mesh.vertices), human.weights.shape[1]
    columns = [human.skeleton.bone(bone) for bone in parts.bones]
    weights = csr_matrix((np.ones(len(columns)), (np.arange(len(columns)), columns)), (len(columns), width))
    height = mesh.texture.shape[0]
    x, y, across, down = _TILE
    uv = np.array([x, y]) + parts.tile * [across, down]
    texture = mesh.texture.copy()
    texture[y : y + down, x : x + across] = _painted()
    added = replace(
        mesh,
        vertices=np.concatenate([mesh.vertices, human.mouth]),
        faces=_joined(mesh.faces, parts.faces + first),
        uv=np.concatenate([mesh.uv, np.c_[uv[:, 0] / _WIDTH, 1 - uv[:, 1] / height]]),
        uv_faces=_joined(mesh.uv_faces, parts.faces + len(mesh.uv)),
        texture=texture,
        materials=None if mesh.materials is None else np.concatenate([mesh.materials, parts.labels]),
        off_body=None if mesh.off_body is None else np.pad(mesh.off_body, (0, len(parts.faces))),
    )
    return replace(
        human,
        mesh=added,
        weights=csr_matrix(vstack([human.weights, weights])),
        looks={},
        shapes=_with_more(shapes, first, _size(shapes) * parts.offsets, ACTIONS),
    )


@dataclass(frozen=True, eq=False)
class _Parts:
    """Data of teeth and tongue that are the same for all people: M vertices, F faces, 52 actions.

    ``labels``: (F,) materials. ``bones``: M names. ``tile``: (M, 2) place in the tile of the texture, 0 to 1,
    from its upper left corner. ``groups``: vertices of each group. ``offsets``: (M, 52, 3) metres, of
    :data:`ACTIONS`. ``largest``: largest offset of ``jawOpen`` in the base mesh, metres.
    """

    faces: VertexIndices
    labels: NDArray[np.uint8]
    bones: tuple[str, ...]
    tile: Array
    groups: Mapping[str, VertexIndices]
    offsets: Array
    largest: float


@functools.cache
def _parts() -> _Parts:
    source = people_data()
    base = source.base
    rows = np.concatenate([_rows(base, group) for group in _GROUPS])
    place = np.full(len(base.vertices), -1)
    place[rows] = np.arange(len(rows))
    faces, labels, tile = [], [], np.zeros((len(base.vertices), 2))
    bones = np.empty(len(base.vertices), object)
    for group, (bone, material, _) in _GROUPS.items():
        own = base.faces[base.face_groups == group]
        used = _rows(base, group)
        bones[used] = bone
        if material == "teeth":
            grid = _grid(base.vertices, own)
            own = np.concatenate([own, _back(own, grid)])
            tile[grid] = _tile(group, np.moveaxis(np.indices(grid.shape), 0, 2) / [_TEETH, _DEPTH - 1])
        else:
            flat = base.vertices[used][:, [0, 2]]
            tile[used] = _tile(group, (flat - flat.min(axis=0)) / np.ptp(flat, axis=0))
        faces.append(place[own])
        labels.append(np.full(len(own), MATERIAL_LABELS[material], np.uint8))
    moved, steps = source.face_action(_OPEN)
    opening = METRES * steps[np.isin(moved, base.vertex_groups["body"])]
    return _Parts(
        np.concatenate(faces),
        np.concatenate(labels),
        tuple(bones[rows].tolist()),
        tile[rows],
        {group: place[_rows(base, group)] for group in _GROUPS},
        face_offsets(source, rows).reshape(len(rows), -1, 3),
        float(np.abs(opening).max()),
    )


def _tile(group: str, shares: Array) -> Array:
    """Texture coordinates (..., 2) in the tile that teeth and tongue share, 0 to 1 across and down.
    ``shares``: (..., 2) coordinates in the part of the tile that a group has, 0 to 1 across and down."""
    across, down = _TILE[2:]
    top, bottom = _ROWS[group]
    return (np.array([1, top]) + shares * [across - 2, bottom - top]) / [across, down]


def _grid(vertices: Array, faces: VertexIndices) -> VertexIndices:
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
    while len(columns) <= _TEETH:
        column = [next(iter(around[vertex] - seen)) for vertex in column]
        columns.append(column)
        seen.update(column)
    return np.array(columns)


def _back(faces: VertexIndices, grid: VertexIndices) -> VertexIndices:
    """Faces (18, 4) that close the back of a row of teeth, so that renderers need not draw its inside."""
    behind = np.stack([grid[:-1, 0], grid[1:, 0], grid[1:, -1], grid[:-1, -1]], axis=1)
    quads = np.concatenate([behind, [grid[0, ::-1], grid[-1]]])
    (first,) = np.flatnonzero(np.isin(faces, grid[:2, 0]).sum(axis=1) == 2)
    corners = faces[first].tolist()
    ahead = corners[(corners.index(grid[0, 0]) + 1) % 4] == grid[1, 0]
    return quads[:, ::-1] if ahead else quads


@functools.cache
def _painted() -> NDArray[np.uint8]:
    """Colours (H, W, 3) of the tile."""
    across, down = _TILE[2:]
    image = np.tile(_GUM, (down, across, 1))
    column = (np.arange(across) - 0.5).clip(0, across - 2) / (across - 2)
    back = np.abs(2 * column - 1)[:, None] ** 1.5
    for group in ("helper-upper-teeth", "helper-lower-teeth"):
        top, bottom = _ROWS[group]
        depth = (np.arange(bottom - top) + 0.5) / (bottom - top) * (_DEPTH - 1)
        along = column * _TEETH % 1
        arch = 0.85 - 0.35 * np.sin(np.pi * along) ** 0.7  # the gum is lower between teeth
        crown = ((depth[:, None] - arch) / 0.12).clip(0, 1) * ((2.7 - depth[:, None]) / 0.3).clip(0, 1)
        between = np.exp(-((np.minimum(along, 1 - along) / 0.09) ** 2)) * 0.7
        tooth = _TOOTH + between[:, None] * (_GAP - _TOOTH)
        image[top:bottom] = _GUM + crown[..., None] * (tooth - _GUM)
        image[top:bottom] *= 1 - 0.5 * back
        image[top:bottom] *= (1 - 0.3 * (depth - 2).clip(0, 1))[:, None, None]
    top, bottom = _ROWS["helper-tongue"]
    front = (np.arange(bottom - top) / (bottom - top))[:, None, None]
    groove = 1 - 0.1 * np.exp(-(((column - 0.5) / 0.06) ** 2))
    image[top:bottom] = _TONGUE * (0.2 + 0.8 * ((front - 0.4) / 0.6).clip(0) ** 1.5) * groove[:, None]
    return image.round().clip(0, 255).astype(np.uint8)


def _joined(faces: NDArray[np.integer], more: VertexIndices) -> NDArray[np.int32]:
    """Join faces (F, K) and quads into one array."""
    padded = np.full((len(more), faces.shape[1]), -1)
    padded[:, :4] = more
    return np.concatenate([faces, padded]).astype(np.int32)


def _largest(shapes: Shapes, name: str) -> float:
    number = shapes.names.index(name)
    return float(np.abs(shapes.offsets[shapes.starts[number] : shapes.starts[number + 1]]).max(initial=0.0))


def _with_more(shapes: Shapes, first: int, offsets: Array, names: tuple[str, ...]) -> Shapes:
    """Shapes that also move new vertices, numbered from ``first``, by offsets (M, S, 3) of actions."""
    rows, steps = [], []
    for number, name in enumerate(shapes.names):
        some = slice(shapes.starts[number], shapes.starts[number + 1])
        own = offsets[:, names.index(name)] if name in names else offsets[:0, 0]
        moved = np.flatnonzero(own.any(axis=1))
        rows.append(np.concatenate([shapes.rows[some], first + moved]))
        steps.append(np.concatenate([shapes.offsets[some], own[moved]]).astype(shapes.offsets.dtype))
    starts = np.concatenate([[0], np.cumsum([len(each) for each in rows])])
    return Shapes(shapes.names, starts, np.concatenate(rows), np.concatenate(steps))
