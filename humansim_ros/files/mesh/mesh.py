"""Surface mesh: vertices, faces, texture coordinates, colours, materials, and joints with weights."""

from __future__ import annotations

import os
import re
import struct
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError, warn_about
from humansim_ros.files.reading.arrays import archive_names
from humansim_ros.files.reading.files import read_bytes
from humansim_ros.files.reading.programs import converted_fbx, is_collada, is_fbx
from humansim_ros.types import Array, Image, Indices

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

#: Things that people wear in addition to clothes.
WornName = Literal[
    "glasses",
    "sunglasses",
    "mask",
    "cap",
    "beanie",
    "hard_hat",
    "sun_hat",
    "turban",
    "hijab",
    "backpack",
    "bag",
]
#: Names of the labels of surfaces. The first name has label 1; label 0 is no human. Labels never change: new
#: names come last, also names of worn things.
MATERIALS = (
    "unknown",
    "skin",
    "eyes",
    "hair",
    "top",
    "bottom",
    "shoes",
    *get_args(WornName),
    "teeth",
    "tongue",
)
#: Label by name.
MATERIAL_LABELS = {name: label for label, name in enumerate(MATERIALS, 1)}
#: Label of a human's surface if its mesh has no labels.
UNKNOWN = MATERIAL_LABELS["unknown"]
#: Labels of skin and of hair. The texels of a texture decide between these labels.
SKIN, HAIR = MATERIAL_LABELS["skin"], MATERIAL_LABELS["hair"]


def with_hair(
    labels: NDArray[np.uint8], uv: NDArray[np.floating], hair: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Change labels (N,) of the triangles at points from skin to hair, for points on a texel of hair. ``uv``:
    (N, 2) texture coordinates of the points, v up. ``hair``: (H, W) share of hair in each texel of the skin,
    0 to 255."""
    height, width = hair.shape
    column = np.clip((uv[:, 0] * width).astype(np.intp), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(np.intp), 0, height - 1)
    return np.where((labels == SKIN) & (hair[row, column] >= 128), np.uint8(HAIR), labels)


@dataclass(frozen=True, eq=False)
class Material:
    """A glTF 2.0 metallic-roughness material. Its images use the texture coordinates of the mesh.

    ``metallic``, ``roughness``: 0 to 1, multiplied by the blue and green channels of ``metal_rough`` (H, W,
    3). ``specular``: (3,) linear reflectance at normal incidence (F0) of non-metals. ``normals``: (H, W, 3)
    normal map, +y up in the image; ``normal_scale`` multiplies its x and y. ``emission``: (3,) emitted linear
    light, multiplied by ``emissive_map`` (H, W, 3), sRGB. ``alpha``: ``mask`` discards pixels that are less
    opaque than ``cutoff``. ``opacity``: multiplied by ``alpha_map`` (H, W). ``double_sided``: back faces are
    visible. ``wrap``: whether images repeat along u and v.
    """

    metallic: float = 0.0
    roughness: float = 1.0
    metal_rough: Image | None = None
    specular: tuple[float, float, float] = (0.04, 0.04, 0.04)
    normals: Image | None = None
    normal_scale: float = 1.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emissive_map: Image | None = None
    alpha: Literal["opaque", "mask", "blend"] = "opaque"
    cutoff: float = 0.5
    opacity: float = 1.0
    alpha_map: Image | None = None
    double_sided: bool = True
    wrap: tuple[bool, bool] = (True, True)


def height_to_normal_map(heights: Image, strength: float) -> Image:
    """Make a normal map (H, W, 3) from a height map (H, W) that repeats. ``strength``: height that the value
    255 stands for, in texels."""
    height = heights.astype(np.float32) * (strength / 255)
    x = (np.roll(height, 1, axis=1) - np.roll(height, -1, axis=1)) / 2
    y = (np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)) / 2
    normal = np.stack([x, y, np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.asarray(np.rint(127.5 * (normal + 1)), dtype=np.uint8)


def without_maps(material: Material | None, path: str, name: str) -> Material | None:
    """Return a material without its images, and warn that the mesh has no texture coordinates for them."""
    if material is None:
        return None
    images = {"metal_rough": "metal and roughness", "normals": "normal map", "emissive_map": "emission"}
    for key, what in (*images.items(), ("alpha_map", "alpha map")):
        if getattr(material, key) is not None:
            text = f"material {name!r}: the {what} is ignored: the mesh has no texture coordinates"
            warn_about(path, text)
    dark = material if material.emissive_map is None else replace(material, emission=(0.0, 0.0, 0.0))
    return replace(dark, metal_rough=None, normals=None, emissive_map=None, alpha_map=None)


FaceIndices = NDArray[np.int32]
#: Larger coordinates are mistakes in any unit, and their squares may be infinite.
LARGEST = 1e9


@dataclass(frozen=True, repr=False)
class Mesh:
    """A surface of triangles and quads.

    ``vertices``: (V, 3). ``faces``: (F, 4) vertex indices, triangles padded with -1. ``uv``: (T, 2) texture
    coordinates, v up, or None; ``uv_faces``: (F, 4) indices into them. ``colors``: (V, 3) uint8 sRGB or None.
    ``texture``: (H, W, 3) uint8 sRGB, first row on top, or None. ``skin``: (H, W) uint8, share of skin in
    each texel (the rest is cloth and hair), or None. ``materials``: (F,) uint8, label of each face of a human
    (:data:`humansim_ros.files.mesh.mesh.MATERIALS`), or None. ``hair``: (H, W) uint8, share of hair in
    each texel of skin; if None, everything that is not ``skin``. ``off_body``: (F,) bool, whether each face
    belongs to an off-body surface: one away from the body, such as a skirt, a hat or long hair. None if no
    face does. ``material``: reflection of static meshes; if None, matt. ``shading``: (V, N) weights of the
    area vectors of the N triangles in the vertex normals; if None, all are 1
    (:func:`humansim_ros.files.mesh.normals.shading_weights`).

    Raises:
        MeshError: An index is out of range, a vertex is not finite, or shapes do not match.

    Example:
        >>> import numpy as np
        >>> mesh = Mesh(np.eye(3), np.array([[0, 1, 2, -1]], dtype=np.int32))
        >>> mesh.triangles
        array([[0, 1, 2]], dtype=int32)
    """

    vertices: Array
    faces: FaceIndices
    uv: Array | None = None
    uv_faces: FaceIndices | None = None
    colors: NDArray[np.uint8] | None = None
    texture: NDArray[np.uint8] | None = None
    skin: NDArray[np.uint8] | None = None
    materials: NDArray[np.uint8] | None = None
    hair: NDArray[np.uint8] | None = None
    off_body: NDArray[np.bool_] | None = None
    material: Material | None = None
    shading: csr_matrix | None = None

    def __post_init__(self) -> None:
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or len(self.vertices) == 0:
            raise MeshError(f"a mesh needs vertices of shape (V, 3), not {self.vertices.shape}")
        if self.faces.ndim != 2 or self.faces.shape[1] != 4 or len(self.faces) == 0:
            raise MeshError("the mesh has no faces")
        for values, what in ((self.vertices, "a vertex"), (self.uv, "a texture coordinate")):
            if values is not None and not (np.abs(values) <= LARGEST).all():
                raise MeshError(f"{what} is not finite (NaN or infinity), or beyond {LARGEST:g}")
        if self.faces[:, :3].min() < 0 or self.faces.min() < -1 or self.faces.max() >= len(self.vertices):
            raise MeshError(f"a face uses a vertex outside 0..{len(self.vertices) - 1}")
        if (self.uv is None) != (self.uv_faces is None):
            raise MeshError("uv and uv_faces must be given together")
        if self.uv is not None and self.uv_faces is not None:
            used = self.uv_faces[self.faces >= 0]
            if self.uv_faces.shape != self.faces.shape or used.min() < 0 or used.max() >= len(self.uv):
                raise MeshError("a face uses a texture coordinate that does not exist")
        if self.texture is not None and self.skin is not None and self.skin.shape != self.texture.shape[:2]:
            raise MeshError(f"skin of {self.skin.shape} does not fit a texture of {self.texture.shape[:2]}")
        if self.materials is not None and self.materials.shape != (len(self.faces),):
            raise MeshError(f"materials of {self.materials.shape} do not fit {len(self.faces)} faces")
        if self.off_body is not None and self.off_body.shape != (len(self.faces),):
            raise MeshError(f"off_body of {self.off_body.shape} does not fit {len(self.faces)} faces")

    def __repr__(self) -> str:
        appearance = ""
        if self.texture is not None:
            appearance = f", texture {self.texture.shape[1]}x{self.texture.shape[0]}"
        elif self.colors is not None:
            appearance = ", vertex colours"
        size = " x ".join(f"{side:.3g}" for side in np.ptp(self.vertices, axis=0))
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces, size {size}{appearance})"

    @cached_property
    def triangles(self) -> FaceIndices:
        """(N, 3) vertex indices of the triangles. A quad a b c d becomes a b c and a c d."""
        return self._split(self.faces)

    @cached_property
    def uv_triangles(self) -> FaceIndices | None:
        """(N, 3) indices into ``uv`` of the same triangles."""
        return None if self.uv_faces is None else self._split(self.uv_faces)

    @cached_property
    def triangle_faces(self) -> FaceIndices:
        """(N,) index of the face that each triangle belongs to."""
        quads = self.faces[:, 3] >= 0
        return np.repeat(np.arange(len(self.faces), dtype=np.int32), 1 + quads)

    @cached_property
    def triangle_materials(self) -> NDArray[np.uint8]:
        """(N,) label of each triangle of a human."""
        if self.materials is None:
            return np.full(len(self.triangles), UNKNOWN, np.uint8)
        return self.materials[self.triangle_faces]

    @cached_property
    def triangles_off_body(self) -> NDArray[np.bool_]:
        """(N,) whether each triangle of a human belongs to an off-body surface."""
        if self.off_body is None:
            return np.zeros(len(self.triangles), bool)
        return self.off_body[self.triangle_faces]

    @cached_property
    def hair_texels(self) -> NDArray[np.uint8] | None:
        """(H, W) share of hair in each texel of skin, 0 to 255; None if there are no labels or no texture."""
        if self.materials is None or self.hair is not None:
            return self.hair
        return None if self.skin is None else 255 - self.skin

    @cached_property
    def closed(self) -> bool:
        """Whether the surface is closed and faces outwards: each edge has two faces with opposite directions.
        The back faces of a closed surface are never visible from outside, and need not be drawn."""
        owner = np.zeros(len(self.triangles), np.intp)
        return bool(closed_surfaces(self.vertices[self.triangles], self.triangles, owner)[0])

    def _split(self, faces: FaceIndices) -> FaceIndices:
        both = faces[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 2, 3)
        keep = np.stack([np.ones(len(faces), dtype=bool), self.faces[:, 3] >= 0], axis=1)
        return np.ascontiguousarray(both[keep])


def closed_surfaces(
    points: Array, triangles: NDArray[np.integer], owner: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """(M,) whether each of several surfaces is closed and faces outwards (see :attr:`Mesh.closed`).
    ``points``: (N, 3, 3) corners of all triangles. ``triangles``: (N, 3) vertices; no vertex belongs to two
    surfaces. ``owner``: (N,) surface of each triangle."""
    start, end = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64).T
    count, owners = int(triangles.max(initial=0)) + 1, np.repeat(owner, 3)
    forward, backward = start * count + end, end * count + start
    order = np.argsort(forward)
    forward = forward[order]
    twice = np.flatnonzero(forward[1:] == forward[:-1])
    found = forward.take(np.searchsorted(forward, backward), mode="clip")
    closed = np.bincount(owner, np.linalg.det(points)) > 0
    closed[owners[order[twice]]] = False
    closed[owners[found != backward]] = False
    return np.asarray(closed)


def padded(triangles: NDArray[np.integer]) -> FaceIndices:
    """Make faces (N, 4) for a :class:`Mesh` from triangles (N, 3), padded with -1."""
    return np.pad(triangles.astype(np.int32), ((0, 0), (0, 1)), constant_values=-1)


@dataclass(frozen=True)
class SkinnedMesh:
    """A mesh with joints and weights at bind time, in the space of the file. ``joint_names``: J names.
    ``parents``: (J,), parents first, -1 for a root. ``joints``: (J, 3) positions. ``weights``: (V, J), rows
    sum to one."""

    name: str
    mesh: Mesh
    joint_names: tuple[str, ...]
    parents: NDArray[np.intp]
    joints: Array
    weights: csr_matrix


def normalise_weights(weights: csr_matrix) -> csr_matrix:
    """Scale weights (V, B) so that rows sum to one. Raises MeshError, which names the vertex, if a weight is
    negative or not finite, or a row sums to zero."""
    from scipy.sparse import csr_matrix  # imported here, since light modules import this one

    scaled = csr_matrix(weights, dtype=np.float64, copy=True)
    counts = np.diff(scaled.indptr)
    rows = np.repeat(np.arange(len(counts)), counts)
    bad = ~np.isfinite(scaled.data) | (scaled.data < 0)
    if bad.any():
        first = int(np.argmax(bad))
        raise MeshError(
            f"a skinning weight of vertex {rows[first]} is negative or not finite: {scaled.data[first]}"
        )
    largest = np.zeros(len(counts))
    np.maximum.at(largest, rows, scaled.data)
    if (largest == 0).any():
        raise MeshError(f"vertex {int(np.argmin(largest))} follows no bone: its weights sum to zero")
    scaled.data /= largest[rows]  # now the sum cannot overflow
    scaled.data /= np.bincount(rows, scaled.data, len(counts))[rows]
    return scaled


MeshFormat = Literal["obj", "gltf", "ply", "stl", "off", "3mf"]
#: Formats by suffix. VRM avatars are glTF files. FBX and COLLADA files are converted to glTF.
MESH_SUFFIXES: dict[str, MeshFormat] = {
    ".obj": "obj",
    ".gltf": "gltf",
    ".glb": "gltf",
    ".vrm": "gltf",
    ".fbx": "gltf",
    ".ply": "ply",
    ".stl": "stl",
    ".off": "off",
    ".dae": "gltf",
    ".3mf": "3mf",
}
#: Largest mesh file.
MAX_BYTES = 1 << 29


def read_format(path: str | os.PathLike[str], what: str = "mesh") -> tuple[MeshFormat, bytes]:
    """Format and content of a mesh file. FBX and COLLADA files are converted to glTF. Raises MeshError if the
    file is missing, empty or too large, or cannot be converted. ``what``: kind of file for messages."""
    data = read_bytes(path, MeshError, what, MAX_BYTES)
    kind, suffix = _format_of(data), Path(path).suffix.lower()
    if is_fbx(data) or (kind is None and suffix == ".fbx"):
        return "gltf", converted_fbx(path, MeshError, data)
    if is_collada(data) or (kind is None and suffix == ".dae"):
        from humansim_ros.files.mesh.collada import converted_collada

        return "gltf", converted_collada(path, data)
    return kind or MESH_SUFFIXES.get(suffix, "obj"), data


def has_signature(data: bytes) -> bool:
    """Whether the first bytes of a file identify it as a mesh file."""
    return is_fbx(data) or is_collada(data) or _format_of(data) is not None


def _format_of(data: bytes) -> MeshFormat | None:
    """Format of a file with a signature; None for OBJ and unknown files."""
    start = data[:4096].lstrip(b"\xef\xbb\xbf \t\r\n")
    if start.startswith((b"glTF", b"{")):
        return "gltf"
    if re.match(rb"ply\s", start):
        return "ply"
    if re.match(rb"(ST)?(C)?(N)?(4)?OFF\s", start):
        return "off"
    if start.startswith(b"PK\3\4"):
        return "3mf" if any(name.lower().endswith("3dmodel.model") for name in archive_names(data)) else None
    if len(data) >= 84 and len(data) == 84 + 50 * struct.unpack_from("<I", data, 80)[0]:
        return "stl"
    if re.match(rb"solid\b[^\n]*\n\s*(facet|endsolid)\b", start):
        return "stl"
    return None


def split_seams(mesh: Mesh) -> tuple[NDArray[np.int64], Array | None, NDArray[np.uint32]]:
    """Copy vertices with several texture coordinates, since glTF and viewers have one per vertex. Returns the
    original vertex (N,) of each vertex, with 0 to V - 1 first; texture coordinates (N, 2), v up, or None; and
    triangles (T, 3) of the N vertices."""
    count = len(mesh.vertices)
    if mesh.uv is None or mesh.uv_triangles is None:
        return np.arange(count), None, mesh.triangles.astype(np.uint32)
    vertex, coordinate = mesh.triangles.ravel().astype(np.int64), mesh.uv_triangles.ravel()
    pairs, pair_of_corner = np.unique(vertex * len(mesh.uv) + coordinate, return_inverse=True)
    vertex_of_pair = pairs // len(mesh.uv)
    _, first_pair = np.unique(vertex_of_pair, return_index=True)
    number = np.zeros(len(pairs), dtype=np.int64)
    is_first = np.zeros(len(pairs), dtype=bool)
    is_first[first_pair] = True
    number[is_first] = vertex_of_pair[is_first]
    number[~is_first] = count + np.arange(int((~is_first).sum()))
    original = np.concatenate([np.arange(count), vertex_of_pair[~is_first]])
    uv = np.zeros((len(original), 2))
    uv[number] = mesh.uv[pairs % len(mesh.uv)]
    return original, uv, number[pair_of_corner.ravel()].reshape(-1, 3).astype(np.uint32)


@dataclass(frozen=True)
class Simplification:
    """Simpler versions of a mesh, made by ``tools/assets/simplify_humans.py``. Level 0 is the mesh itself.

    Edges have collapsed into one of their vertices, so that the vertices of a level are a subset.

    ``parents``: (V,) vertex that each vertex collapses into. A vertex that stays at all levels has its own
    number. ``coordinate_parents``: (T,) the same for texture coordinates. ``removed_at``: (V,) first level
    without the vertex, 255 if the vertex stays. ``errors``: (K + 1,) metres, one per level. 95 % of the
    vertices are nearer to the surface of the level than this, in all poses.
    """

    parents: Indices
    coordinate_parents: Indices
    removed_at: NDArray[np.uint8]
    errors: Array

    @cached_property
    def counts(self) -> Indices:
        """(K + 1,) number of vertices of each level, of the mesh itself first."""
        return np.array([int((self.removed_at > number).sum()) for number in range(len(self.errors))])

    def level(
        self, number: int, triangles: NDArray[np.integer], coordinates: NDArray[np.integer]
    ) -> tuple[Indices, Indices]:
        """Triangles (N, 3) of a level, and their texture coordinates (N, 3), as indices into the arrays of
        the mesh."""
        vertices = self.vertices_of(number)
        stays = self.removed_at > number
        owner = np.zeros(len(self.coordinate_parents), np.intp)
        owner[coordinates] = triangles
        found = followed(self.coordinate_parents, stays[owner])
        return without_degenerate(vertices[triangles], found[coordinates])

    def vertices_of(self, number: int) -> Indices:
        """(V,) vertex of a level that stands for each vertex."""
        return followed(self.parents, self.removed_at > number)


def without_degenerate(triangles: Indices, coordinates: Indices) -> tuple[Indices, Indices]:
    """Triangles (N, 3) with three different vertices, and their texture coordinates (N, 3)."""
    a, b, c = triangles.T
    keep = (a != b) & (b != c) & (c != a)
    return triangles[keep], coordinates[keep]


def followed(parents: Indices, stays: NDArray[np.bool_]) -> Indices:
    """(V,) vertex that each vertex collapses into in the end: its first ancestor that stays."""
    found = np.where(stays, np.arange(len(parents)), parents)
    while not stays[found].all() and not np.array_equal(
        further := np.where(stays[found], found, parents[found]), found
    ):
        found = further
    return found


def compact(triangles: Indices) -> tuple[Indices, NDArray[np.int32]]:
    """Vertices (v,) that triangles use, and the triangles (N, 3) as indices into these vertices."""
    kept, inverse = np.unique(triangles, return_inverse=True)
    return kept, inverse.reshape(-1, 3).astype(np.int32)
