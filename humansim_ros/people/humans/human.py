"""The Human class: mesh, skeleton, weights and outfits; and its file format (.npz)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from humansim_ros.errors import MeshError, unknown
from humansim_ros.files.mesh import LARGEST, MATERIALS, Mesh, normalise_weights
from humansim_ros.files.reading import BEST, decode_image, read_npz, write_npz
from humansim_ros.motion.body import (
    ACTIONS,
    LooseParts,
    Shapes,
    Skeleton,
    SkinningFunction,
    face_weights,
    loose_arrays,
    make_skinner,
    read_loose,
    read_shapes,
    shape_arrays,
    triangle_parts,
    without_details,
)
from humansim_ros.pictures import Pictured
from humansim_ros.types import Array

#: Name of the only outfit of a human.
DEFAULT_OUTFIT = "default"
#: Skinning method.
Skinning = Literal["linear", "dual_quaternion"]
_OUTFIT_PREFIX = "texture_"
#: Arrays of a human file with the weights of triangles in vertex normals, as sparse rows (CSR).
_SHADING = ("shading_values", "shading_triangles", "shading_starts")


@dataclass(frozen=True, repr=False)
class Human(Pictured):
    """Human in the rest pose, in body space (metres, y up, facing +z).

    ``weights``: (V, B), rows sum to one. ``looks``: outfits by name, each a PNG or JPEG texture as (N,) bytes
    or vertex colours (V, 3) uint8 sRGB. ``outfit``: name of the outfit of ``mesh``. ``notes``: ``license``
    and ``source``. ``shapes``: actions of the face (docs/faces.md); None for a stiff face. ``loose``: cloth
    and hair that swing, or None. ``mouth``: (M, 3) positions of teeth and tongue in the rest pose, or None.
    The mesh does not show them (``people/makehuman/face.py``).
    """

    name: str
    mesh: Mesh
    skeleton: Skeleton
    weights: csr_matrix
    looks: Mapping[str, NDArray[np.uint8]] = field(default_factory=dict)
    outfit: str = DEFAULT_OUTFIT
    skinning: Skinning = "linear"
    notes: Mapping[str, str] = field(default_factory=dict)
    shapes: Shapes | None = None
    loose: LooseParts | None = None
    mouth: Array | None = None

    def __repr__(self) -> str:
        counts = f"{len(self.mesh.vertices)} vertices, {len(self.skeleton)} bones"
        return f"Human({self.name!r}, {counts}, wears {self.outfit!r} of {list(self.outfits)})"

    @property
    def outfits(self) -> tuple[str, ...]:
        """Names of all outfits; the first is the default."""
        return tuple(self.looks) or (self.outfit,)

    @property
    def license(self) -> str:
        """Licence of the body, such as ``CC0-1.0``. Empty if unknown."""
        return self.notes.get("license", "").strip()

    def wearing(self, outfit: str) -> Human:
        """Return the human in another outfit. Raises MeshError for an unknown outfit."""
        if outfit == self.outfit and (self.mesh.texture is not None or self.mesh.colors is not None):
            return self
        if outfit not in self.looks:
            raise MeshError(unknown("outfit", outfit, self.outfits, self.name))
        look = self.looks[outfit]
        if look.ndim == 1:
            mesh = replace(self.mesh, texture=decode_image(look), colors=None)
        else:
            mesh = replace(self.mesh, texture=None, colors=look)
        return replace(self, mesh=mesh, outfit=outfit)

    def without_details(self) -> Human:
        """Return the human without bones of fingers, toes, jaw and eyes. The bones of hand, foot and head
        move their skin instead."""
        kept = np.flatnonzero(self.skeleton.wholes == np.arange(len(self.skeleton)))
        if len(kept) == len(self.skeleton):
            return self
        weights = csr_matrix(without_details(self.weights, self.skeleton)[:, kept])
        return replace(self, skeleton=self.skeleton.part(kept), weights=weights)

    @cached_property
    def triangle_parts(self) -> NDArray[np.uint8]:
        """Part labels (N,) of the triangles: 1 + the bone with the largest weight."""
        return triangle_parts(self.mesh.triangles, self.weights) + np.uint8(1)

    @cached_property
    def skinner(self) -> SkinningFunction:
        """Skinning function of the mesh, single precision."""
        return make_skinner(self.skinning, self.mesh.vertices, self.weights)

    @cached_property
    def _face_skinner(self) -> SkinningFunction:
        """Skinning function of the vertices that shapes of the face move."""
        assert self.shapes is not None
        moved = self.shapes.moved
        return make_skinner(self.skinning, self.mesh.vertices[moved], self.weights[moved])

    @cached_property
    def _loose_skinner(self) -> SkinningFunction:
        """Skinning function of the vertices of loose parts."""
        assert self.loose is not None
        rows = self.loose.rows
        return make_skinner(self.skinning, self.mesh.vertices[rows], self.weights[rows])

    @cached_property
    def _end_skinner(self) -> SkinningFunction:
        """Skinning function of the ends of loose parts: first all upper ends, then all lower ends."""
        assert self.loose is not None
        rows = self.loose.ends.T.ravel()
        return make_skinner(self.skinning, self.mesh.vertices[rows], self.weights[rows], np.float64)

    def loose_ends(self, posed: Array) -> tuple[Array, Array, Array]:
        """Upper ends, lower ends and outward directions (N, K, 3) of loose parts, as they are without swing.
        ``posed``: bone frames (N, B, 4, 4). The human must have loose parts."""
        assert self.loose is not None
        transforms, count = posed @ self.skeleton.rest_inverse, len(self.loose.kinds)
        ends = np.asarray(self._end_skinner(transforms), dtype=float)
        outwards = np.tile(self.loose.outwards, (2, 1))
        turned = np.asarray(self._end_skinner.directions(transforms, outwards), dtype=float)
        return ends[:, :count], ends[:, count:], turned[:, count:]

    def face_weights(self, face: Mapping[str, float]) -> Array:
        """Weights (S,) of the shapes from weights by name. Shapes without a name in ``face`` get 0. A human
        without shapes has no weights. Raises MotionError for a wrong name or weight."""
        if self.shapes is None:
            return np.zeros(0)
        return face_weights(face, self.shapes.names)

    @cached_property
    def _action_shapes(self) -> NDArray[np.intp]:
        """(S,) number of the action that moves each shape. For a shape without an action: the number of all
        actions, 52."""
        numbers = {name: number for number, name in enumerate(ACTIONS)}
        names = () if self.shapes is None else self.shapes.names
        return np.array([numbers.get(name, len(ACTIONS)) for name in names], dtype=np.intp)

    def of_actions(self, weights: Array) -> Array:
        """Weights (S,) of the shapes from weights (52,) of the actions of ARKit, in their order."""
        return np.append(weights, 0.0)[self._action_shapes]

    def pose(
        self, posed: Array, face: Mapping[str, float] | Array | None = None, swing: Array | None = None
    ) -> NDArray[np.float32]:
        """Pose the human: vertices (V, 3) float32, in the space of the posed bone frames (B, 4, 4).

        ``face``: weights of actions of the face, by name or (S,) in the order of ``shapes``. They move the
        skin in the rest pose, before the bones do. Eyeballs turn only with their bones. ``swing``: (K, 3)
        offsets of the lower ends of loose parts, in the space of the bone frames. Cloth around raised thighs
        is gathered.

        Raises MotionError for an unknown action, or a weight that is not from 0 to 1.

        Example:
            >>> import numpy as np
            >>> from humansim_ros import load_human
            >>> from humansim_ros.files.reading.assets import resource_path
            >>> child = load_human(resource_path("assets/humans/child.npz"))
            >>> rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(child.skeleton), 1))
            >>> vertices = child.pose(child.skeleton.pose(rotations))
            >>> np.allclose(vertices, child.mesh.vertices, atol=1e-5)
            True
        """
        transforms = posed @ self.skeleton.rest_inverse
        vertices = np.asarray(self.skinner(transforms), dtype=np.float32)
        if self.loose is not None:
            self._move_loose(vertices, transforms, swing)
        if face is None or self.shapes is None:
            return vertices
        weights = self.face_weights(face) if isinstance(face, Mapping) else face
        if np.any(weights):
            offsets = self._face_skinner.offsets(transforms, self.shapes.at(weights))
            vertices[..., self.shapes.moved, :] += offsets
        return vertices

    def _move_loose(self, vertices: NDArray[np.float32], transforms: Array, swing: Array | None) -> None:
        """Move the loose parts of posed vertices (..., V, 3) in place."""
        assert self.loose is not None
        rows, flat = self.loose.rows, vertices.reshape(-1, *vertices.shape[-2:])
        for one, bones in zip(flat, transforms.reshape(-1, *transforms.shape[-3:]), strict=True):
            gathered = self.loose.gathered(self.skeleton, bones)
            if gathered is not None:
                one[rows] += self._loose_skinner.offsets(bones, gathered)
            if swing is not None:
                one[rows] = self.loose.swung(one[rows], swing, self.skeleton, bones)


#: Most bones, since part labels have 8 bits and 0 is the background.
MAX_BONES = 255
_SKELETON = ("bone_names", "bone_parents", "bone_heads", "bone_tails", "bone_rolls")
_REQUIRED = ("vertices", "faces", *_SKELETON, "weight_bones", "weight_values")


def read_human(path: str | os.PathLike[str]) -> Human:
    """Read a human file (docs/humans.md lists the arrays). Raises MeshError, which names the file and the
    array."""
    arrays = read_npz(path, MeshError, "human")
    missing = [key for key in _REQUIRED if key not in arrays]
    if missing:
        raise MeshError("not a human file: an array is missing", path=path, key=missing[0])
    try:
        return human_from_arrays(arrays, Path(path).stem)
    except KeyError as reason:
        raise MeshError("not a human file: an array is missing", path=path, key=str(reason.args[0])) from None
    except (ValueError, TypeError, IndexError, OverflowError) as reason:
        raise MeshError(f"an array has the wrong shape or type: {reason}", path=path) from None
    except MeshError as error:
        raise MeshError(error.message, path=path, key=error.key) from None


def write_human(path: str | os.PathLike[str], human: Human, level: int = BEST) -> None:
    """Write a human file atomically. Equal humans give equal bytes. ``level``: level of compression, 1 to
    9."""
    write_npz(path, _arrays(human), level)


def as_written(human: Human) -> Human:
    """Return the human with the rounded numbers that :func:`read_human` would read from its file."""
    return human_from_arrays(_arrays(human), human.name)


def _arrays(human: Human) -> dict[str, NDArray[Any]]:
    """Make the arrays for the file of a human."""
    mesh, skeleton = human.mesh, human.skeleton
    counts = np.diff(human.weights.indptr)
    width = int(counts.max())
    bones = np.zeros((len(counts), width), dtype=np.int16)
    shares = np.zeros((len(counts), width))
    used = np.arange(width) < counts[:, None]
    bones[used], shares[used] = human.weights.indices, human.weights.data
    arrays: dict[str, NDArray[Any]] = {
        "vertices": mesh.vertices.astype(np.float32),
        "faces": mesh.faces.astype(np.int32),
        "bone_names": np.array(skeleton.names),
        "bone_parents": skeleton.parents.astype(np.int32),
        "bone_heads": skeleton.heads,
        "bone_tails": skeleton.tails,
        "bone_rolls": skeleton.rolls,
        "weight_bones": bones,
        "weight_values": shares.astype(np.float32),
    }
    if mesh.uv is not None and mesh.uv_faces is not None:
        arrays |= {"uv": mesh.uv.astype(np.float32), "uv_faces": mesh.uv_faces.astype(np.int32)}
    if human.looks:
        arrays["outfits"] = np.array(human.outfits)
        arrays |= {f"{_OUTFIT_PREFIX}{name}": np.asarray(look) for name, look in human.looks.items()}
    elif mesh.colors is not None:
        arrays["colors"] = mesh.colors
    for name in ("skin", "materials", "hair", "off_body"):
        if (values := getattr(mesh, name)) is not None:
            arrays[name] = values
    if mesh.shading is not None:
        parts = (mesh.shading.data, mesh.shading.indices, mesh.shading.indptr)
        arrays |= dict(zip(_SHADING, parts, strict=True))
    arrays |= {key: np.array(text) for key, text in {"name": human.name, **human.notes}.items()}
    if human.shapes is not None:
        arrays |= shape_arrays(human.shapes)
    if human.mouth is not None:
        arrays["mouth"] = human.mouth.astype(np.float32)
    if human.loose is not None:
        arrays |= loose_arrays(human.loose)
    if human.skinning != "linear":
        arrays["skinning"] = np.array(human.skinning)
    return arrays


def _shading(arrays: dict[str, NDArray[Any]], mesh: Mesh) -> csr_matrix | None:
    """Weights (V, N) of triangles in vertex normals. None if the file has no such weights."""
    if _SHADING[0] not in arrays:
        return None
    with np.errstate(over="ignore"):
        values = _numbers(arrays, _SHADING[0]).astype(np.float32)
    shape = (len(mesh.vertices), len(mesh.triangles))
    found = csr_matrix((values, *(_indices(arrays, name) for name in _SHADING[1:])), shape=shape)
    found.check_format(full_check=True)
    if not (np.isfinite(values) & (values >= 0)).all():
        raise MeshError("needs finite weights of at least 0", key=_SHADING[0])
    return found


def human_from_arrays(arrays: dict[str, NDArray[Any]], name: str) -> Human:
    """Make a human from the arrays of a file. Raises MeshError, KeyError or ValueError if they are wrong."""
    vertices = _numbers(arrays, "vertices")
    has_uv = "uv" in arrays
    mesh = Mesh(
        vertices=vertices,
        faces=_indices(arrays, "faces").astype(np.int32),
        uv=_numbers(arrays, "uv") if has_uv else None,
        uv_faces=_indices(arrays, "uv_faces").astype(np.int32) if has_uv else None,
        colors=arrays.get("colors"),
        skin=_texels(arrays, "skin"),
        materials=_materials(arrays),
        hair=_texels(arrays, "hair"),
        off_body=_of_faces(arrays, "off_body", np.bool_),
    )
    mesh = replace(mesh, shading=_shading(arrays, mesh))
    skeleton = Skeleton(
        names=tuple(str(n) for n in arrays["bone_names"]),
        parents=_indices(arrays, "bone_parents").astype(np.intp),
        heads=_numbers(arrays, "bone_heads"),
        tails=_numbers(arrays, "bone_tails"),
        rolls=_numbers(arrays, "bone_rolls"),
    )
    if len(skeleton) > MAX_BONES:
        raise MeshError(f"{len(skeleton)} bones; at most {MAX_BONES}", key="bone_names")
    bones, values = _indices(arrays, "weight_bones").astype(int), _numbers(arrays, "weight_values")
    fits = bones.ndim == 2 and bones.shape == values.shape and len(bones) == len(vertices)
    if not fits or bones.min() < 0 or bones.max() >= len(skeleton):
        raise MeshError("the weights do not fit the vertices and bones", key="weight_bones")
    used = values != 0
    starts = np.concatenate([[0], np.cumsum(used.sum(axis=1))])
    weights = csr_matrix((values[used], bones[used], starts), shape=(len(vertices), len(skeleton)))
    weights.sum_duplicates()
    looks = _looks(arrays, len(vertices))
    notes: dict[str, str] = {key: str(arrays[key]) for key in ("license", "source") if key in arrays}
    skinning = str(arrays.get("skinning", "linear"))
    if skinning not in (methods := get_args(Skinning)):
        raise MeshError(
            f"{skinning[:30]!r} is not a skinning method; use {' or '.join(methods)}", key="skinning"
        )
    human = Human(
        *(name, mesh, skeleton, normalise_weights(weights), looks),
        skinning=cast(Skinning, skinning),
        notes=notes,
        shapes=read_shapes(arrays, len(vertices)),
        loose=read_loose(arrays, len(vertices)),
        mouth=_mouth(arrays),
    )
    return human.wearing(human.outfits[0]) if looks else human


def _numbers(arrays: dict[str, NDArray[Any]], key: str) -> Array:
    """Array of numbers. Raises MeshError for texts."""
    array = arrays[key]
    if array.dtype.kind not in "iuf":
        raise MeshError(f"must be numbers, not {array.dtype}", key=key)
    with np.errstate(over="ignore"):  # longer numbers become infinite, and are refused where they are used
        return array.astype(float)


def _indices(arrays: dict[str, NDArray[Any]], key: str) -> NDArray[np.integer]:
    """Array of whole numbers of 32 bits. Raises MeshError for other arrays."""
    array = arrays[key]
    if array.dtype.kind not in "iu" or (array.size and not -(2**31) <= array.min() <= array.max() < 2**31):
        raise MeshError(f"must be whole numbers of at most 32 bits, not {array.dtype}", key=key)
    return array


def _mouth(arrays: dict[str, NDArray[Any]]) -> Array | None:
    """Positions (M, 3) of teeth and tongue. None if the file has no such positions."""
    if "mouth" not in arrays:
        return None
    places = _numbers(arrays, "mouth")
    if places.ndim != 2 or places.shape[1] != 3 or not (np.abs(places) <= LARGEST).all():
        raise MeshError(f"must be finite positions (M, 3), not {places.shape}", key="mouth")
    return places


def _texels(arrays: dict[str, NDArray[Any]], key: str) -> NDArray[np.uint8] | None:
    """Share (H, W) of skin or hair in each texel, 0 to 255. None if the file has no array ``key``."""
    share = arrays.get(key)
    if share is not None and (share.dtype != np.uint8 or share.ndim != 2 or not share.size):
        raise MeshError(f"must be (H, W) uint8, not {share.shape} {share.dtype}", key=key)
    return share


def _of_faces(arrays: dict[str, NDArray[Any]], key: str, dtype: type[Any]) -> NDArray[Any] | None:
    """Values (F,) of the faces. None if the file has no array ``key``."""
    values, name = arrays.get(key), np.dtype(dtype).name
    if values is not None and (values.dtype != dtype or values.shape != (len(arrays["faces"]),)):
        raise MeshError(f"must be (F,) {name}, not {values.shape} {values.dtype}", key=key)
    return values


def _materials(arrays: dict[str, NDArray[Any]]) -> NDArray[np.uint8] | None:
    """Material label (F,) of each face. None if the file has no labels."""
    labels = _of_faces(arrays, "materials", np.uint8)
    if labels is not None and len(labels) and not 1 <= labels.min() <= labels.max() <= len(MATERIALS):
        raise MeshError(f"labels are 1 to {len(MATERIALS)}", key="materials")
    return labels


def _looks(arrays: dict[str, NDArray[Any]], n_vertices: int) -> dict[str, NDArray[np.uint8]]:
    """Outfits of a file by name. Empty if the file has no outfits."""
    if "outfits" in arrays:
        looks = {str(name): arrays[f"{_OUTFIT_PREFIX}{name}"] for name in arrays["outfits"].ravel()}
    else:
        looks = {DEFAULT_OUTFIT: arrays["texture"]} if "texture" in arrays else {}
    for name, look in looks.items():
        if look.dtype != np.uint8 or (look.ndim != 1 and look.shape != (n_vertices, 3)):
            raise MeshError(
                f"an outfit is image bytes (N,) or colours (V, 3), uint8, not {look.shape} {look.dtype}",
                key=f"{_OUTFIT_PREFIX}{name}",
            )
        if look.ndim == 1 and "uv" not in arrays:
            raise MeshError("a texture needs texture coordinates", key="uv")
    return looks


def joint_surfaces(human: Human) -> NDArray[np.bool_]:
    """(J, 256) whether the skin around each joint has each part label: those of the bones that meet there."""
    skeleton = human.skeleton
    with_skin = set((human.triangle_parts - 1).tolist())
    bones_of_joints: list[set[int]] = []
    for joint, bone in enumerate(skeleton.joint_bones):
        is_end = joint >= len(skeleton)
        if skeleton.wholes[bone] != bone:
            bones_of_joints.append({bone} if is_end else {bone, int(skeleton.parents[bone])})
            continue
        meeting = {bone} if is_end else {bone, *_siblings(skeleton.parents, skeleton.heads, bone)}
        if not is_end and skeleton.parents[bone] >= 0:
            meeting.add(int(skeleton.parents[bone]))
        if skeleton.parents[bone] < 0:
            meeting |= set(np.flatnonzero(skeleton.parents == bone).tolist())
        # a connector bone has no skin, so the bones that it connects meet here
        for bare in meeting - with_skin:
            parent = int(skeleton.parents[bare])
            meeting |= {parent, *np.flatnonzero(skeleton.parents == bare).tolist()}
            # the pelvis lies next to the connectors of thighs
            if parent >= 0 and skeleton.parents[parent] < 0:
                meeting |= set(_siblings(skeleton.parents, skeleton.heads, bare))
        # hands count with their fingers, feet with their toes, the head with jaw and eyes
        bones_of_joints.append(set(np.flatnonzero(np.isin(skeleton.wholes, list(meeting))).tolist()))
    table = np.zeros((len(bones_of_joints), 256), dtype=bool)
    for joint, bones in enumerate(bones_of_joints):
        table[joint, [bone + 1 for bone in bones]] = True
    return table


def _siblings(parents: NDArray[np.intp], heads: Array, bone: int) -> list[int]:
    same = (parents == parents[bone]) & (np.linalg.norm(heads - heads[bone], axis=1) < 1e-6)
    return [int(b) for b in np.flatnonzero(same)]
