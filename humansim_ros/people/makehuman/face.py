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

from humansim_ros.errors import MeshError
from humansim_ros.files.reading import read_npz, resource_path
from humansim_ros.motion.body import ACTIONS, BONE, MOVES, Jaw, Shapes
from humansim_ros.people.humans.human import Human
from humansim_ros.people.makehuman.data import METRES, Base, MakeHumanData, VertexIndices
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
GROUPS: Mapping[str, tuple[str, str, tuple[float, float]]] = {
    "helper-upper-teeth": ("vt3", "teeth", (0.0005, -0.001)),
    "helper-lower-teeth": (BONE, "teeth", (-0.004, -0.002)),
    "helper-tongue": (BONE, "tongue", (-0.0035, -0.002)),
}
#: Width of the textures of all bodies. Unused texels in them: column and row of the corner, width and height.
_WIDTH = 1024
TILE = (545, 400, 96, 128)
#: Action with offsets that show the size of a body.
OPEN = "jawOpen"


def mouth_places(base: Base) -> Array:
    """Positions (M, 3) of teeth and tongue of a base mesh, metres."""
    return np.concatenate(
        [base.vertices[group_rows(base, group)] + [0.0, *shift] for group, (*_, shift) in GROUPS.items()]
    )


def group_rows(base: Base, group: str) -> VertexIndices:
    """Vertices (K,) of a group of the base mesh."""
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
    parts, (_, _, shift) = _parts(), GROUPS["helper-lower-teeth"]
    teeth = human.mouth[parts.lower_teeth] - [0.0, *shift]
    offsets = _size(human.shapes) * parts.offsets[parts.lower_teeth]
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
    return _largest(shapes, OPEN) / float(_parts().largest)


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
    x, y, across, down = TILE
    uv = np.array([x, y]) + parts.tile * [across, down]
    texture = mesh.texture.copy()
    texture[y : y + down, x : x + across] = parts.image
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
    from its upper left corner. ``lower_teeth``: vertices of the lower teeth. ``offsets``: (M, 52, 3) metres,
    of :data:`ACTIONS`. ``largest``: largest offset of ``jawOpen`` in the base mesh, metres. ``image``: (H, W,
    3) colours of the tile.
    """

    faces: VertexIndices
    labels: NDArray[np.uint8]
    bones: NDArray[np.str_]
    tile: Array
    lower_teeth: VertexIndices
    offsets: Array
    largest: Array
    image: NDArray[np.uint8]


@functools.cache
def _parts() -> _Parts:
    """Read the file that ``tools/assets/pack_mouth.py`` makes from the base mesh."""
    return _Parts(**read_npz(resource_path("assets/makehuman/mouth.npz"), MeshError, "MakeHuman"))


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
