"""Meshes of glTF files: all primitives as one mesh, or as one mesh for each material."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_matrix, vstack

from humansim_ros.errors import MeshError, located, warn_about
from humansim_ros.files.mesh.gltf_document import Gltf
from humansim_ros.files.mesh.gltf_format import GltfMaterial, Primitive, TextureInfo
from humansim_ros.files.mesh.gltf_skeleton import GltfSkeleton
from humansim_ros.files.mesh.mesh import FaceIndices, Material, Mesh, SkinnedMesh, normalise_weights, padded
from humansim_ros.files.mesh.normals import PLAIN, atlas_mesh, plain_tile, shading_weights
from humansim_ros.files.reading.images import encode_srgb
from humansim_ros.geometry import unit_vectors
from humansim_ros.types import Array, Image

_REPEATED, _MIRRORED, _CLAMPED = 10497, 33648, 33071


def read_material(gltf: Gltf, number: int | None, has_uv: bool) -> Material:
    """Read a material. None stands for the default material. ``has_uv``: the mesh has texture coordinates.
    Raises MeshError if an image is wrong."""
    material = gltf.material(number)
    pbr, base = material.pbrMetallicRoughness, material.pbrMetallicRoughness.baseColorTexture
    maps = {
        "metal and roughness": pbr.metallicRoughnessTexture,
        "normal map": material.normalTexture,
        "emission": material.emissiveTexture,
    }
    used = {what: info for what, info in maps.items() if info is not None}
    leading = base or next(iter(used.values()), None)
    mapping = None if leading is None else (leading.texCoord, leading.extensions)
    ignored = _unsupported(gltf, material, leading)
    images: dict[str, Image] = {}
    for what, info in used.items():
        if not has_uv:
            ignored.append(f"the {what}, because the mesh has no texture coordinates")
        elif (info.texCoord, info.extensions) != mapping:
            ignored.append(f"the {what}, because the colour has other texture coordinates")
        else:
            image = _decoded(gltf, info, gltf.decoded_images.get)
            if image is not None:
                images[what] = image
    alpha_map = None
    if material.alphaMode != "OPAQUE" and base is not None and has_uv:
        alpha_map = _decoded(gltf, base, gltf.decoded_images.alpha)
    for part in ignored:
        warn_about(gltf.path, f"material {material.name or number!r}: ignored: {part}")
    wraps = (_REPEATED, _REPEATED) if leading is None else gltf.wraps(leading.index)
    strength = material.extensions.KHR_materials_emissive_strength.emissiveStrength
    red, green, blue = np.maximum(np.array(material.emissiveFactor) * strength, 0.0).tolist()
    if material.emissiveTexture is not None and "emission" not in images:
        red = green = blue = 0.0
    return Material(
        metallic=_clamp(pbr.metallicFactor),
        roughness=_clamp(pbr.roughnessFactor),
        metal_rough=images.get("metal and roughness"),
        normals=images.get("normal map"),
        normal_scale=1.0 if material.normalTexture is None else material.normalTexture.scale,
        emission=(red, green, blue),
        emissive_map=images.get("emission"),
        alpha={"MASK": "mask", "BLEND": "blend"}.get(material.alphaMode, "opaque"),  # type: ignore[arg-type]
        cutoff=material.alphaCutoff,
        opacity=_clamp(pbr.baseColorFactor[3]),
        alpha_map=alpha_map,
        double_sided=material.doubleSided,
        wrap=(wraps[0] != _CLAMPED, wraps[1] != _CLAMPED),
    )


def _decoded(
    gltf: Gltf, info: TextureInfo, decode: Callable[[int, Callable[[], bytes]], Image | None]
) -> Image | None:
    """Image of a texture, decoded by a method of :class:`DecodedImages`; None if there is none. A damaged
    image raises MeshError, which names the key."""
    source = gltf.texture_image(info.index)
    if source is None:
        return None
    with located(path=gltf.path, key=f"images.{source}"):
        return decode(source, lambda: gltf.image(source))


def _unsupported(gltf: Gltf, material: GltfMaterial, leading: TextureInfo | None) -> list[str]:
    """Names of the properties of a material that are ignored, for a warning."""
    parts = [f"extension {name!r}" for name in material.extensions.model_extra or ()]
    if material.occlusionTexture is not None:
        parts.append("the ambient occlusion map (ambient occlusion is computed)")
    if leading is not None:
        parts += [f"extension {name!r} of its texture" for name in leading.extensions.model_extra or ()]
        if _MIRRORED in gltf.wraps(leading.index):
            parts.append("mirrored repetition of the texture")
    return parts


def _clamp(value: float) -> float:
    return min(max(value, 0.0), 1.0)


_MAX_VERTICES = 5_000_000


@dataclass(frozen=True)
class _Piece:
    """A primitive in the common space. ``vertices``: (V, 3). ``triangles``: (N, 3). ``uv``: (V, 2), v down.
    ``colors``: (V, 3) linear. ``normals``: (V, 3), zero where the file has a normal without length."""

    vertices: Array
    triangles: NDArray[np.int64]
    uv: Array | None
    material: int | None
    weights: csr_matrix | None
    colors: Array | None
    normals: Array | None


def read_gltf(path: str | os.PathLike[str], data: bytes) -> Mesh | SkinnedMesh:
    """Read a glTF file as a skinned mesh at bind time. If nothing in it is skinned, read it as a mesh.
    ``data``: content of the file. A skinned mesh has the normals of the file. Raises MeshError if the file is
    wrong or has no triangles."""
    gltf = Gltf.parse(path, data)
    skeleton = GltfSkeleton.of(gltf)
    pieces = _all_pieces(gltf, skeleton)
    mesh = _one_mesh(gltf, pieces)
    if skeleton is None:
        return mesh
    weights = vstack([piece.weights for piece in pieces], format="csr")
    return SkinnedMesh(
        gltf.path.stem,
        replace(mesh, shading=_shading(pieces)),
        skeleton.names,
        skeleton.parents,
        skeleton.bind[:, :3, 3],
        weights,
    )


def read_gltf_scene(path: str | os.PathLike[str], data: bytes, *, shaded: bool = False) -> Mesh:
    """Read the scene of a glTF file with its content ``data`` as one mesh. Skinned meshes are posed by the
    nodes of the file. Raises MeshError if the file is wrong or has no triangles. ``shaded``: use the normals
    of the file. A mesh without normals looks flat, since each triangle gets its own vertices."""
    gltf = Gltf.parse(path, data)
    pieces = _all_pieces(gltf, None)
    if not shaded:
        return _one_mesh(gltf, pieces)
    pieces = _flat_without_normals(pieces)
    return replace(_one_mesh(gltf, pieces), shading=_shading(pieces))


def read_gltf_materials(path: str | os.PathLike[str], data: bytes) -> list[Mesh]:
    """Read the scene of a glTF file as one mesh for each material, with normals. Textures may repeat.
    ``data``: content of the file. Raises MeshError if the file is wrong or has no triangles."""
    gltf = Gltf.parse(path, data)
    pieces = _flat_without_normals(_all_pieces(gltf, None))
    groups: dict[tuple[int | None, bool], list[_Piece]] = {}
    for piece in pieces:
        groups.setdefault((piece.material, piece.uv is not None), []).append(piece)
    return [_material_mesh(gltf, group) for group in groups.values()]


def _all_pieces(gltf: Gltf, skeleton: GltfSkeleton | None) -> list[_Piece]:
    """Pieces (primitives) of all nodes or, if there is no skeleton, of the nodes in the scene."""
    pieces: list[_Piece] = []
    total = 0
    for number in gltf.order:
        for piece in _pieces(gltf, int(number), skeleton):
            total += len(piece.vertices)
            if total > _MAX_VERTICES:
                raise MeshError(f"more than {_MAX_VERTICES} vertices", path=gltf.path)
            pieces.append(piece)
    if not pieces:
        raise MeshError("the file has no triangles", path=gltf.path)
    return pieces


def _flat_without_normals(pieces: list[_Piece]) -> list[_Piece]:
    """Give triangles without normals their own vertices, so that they look flat [glTF 2.0]. If this made too
    many vertices, nothing is changed."""
    total = sum(len(p.vertices) if p.normals is not None else 3 * len(p.triangles) for p in pieces)
    if total > _MAX_VERTICES:
        return pieces
    out = []
    for piece in pieces:
        if piece.normals is None:
            corners = piece.triangles.ravel()
            uv, colors = (None if each is None else each[corners] for each in (piece.uv, piece.colors))
            own = np.arange(len(corners)).reshape(-1, 3)
            piece = replace(piece, vertices=piece.vertices[corners], triangles=own, uv=uv, colors=colors)
        out.append(piece)
    return out


def _shading(pieces: list[_Piece]) -> csr_matrix | None:
    """Weights (V, N) of all triangles in the vertex normals (see Mesh); None if no piece has normals."""
    if all(piece.normals is None for piece in pieces):
        return None
    unknown = (np.zeros_like(p.vertices) if p.normals is None else p.normals for p in pieces)
    blocks = [shading_weights(p.vertices, p.triangles, n) for p, n in zip(pieces, unknown, strict=True)]
    return csr_matrix(block_diag(blocks, format="csr"))


def _joined(pieces: list[_Piece]) -> tuple[Array, FaceIndices]:
    """Vertices (V, 3) and faces (F, 4) of all pieces."""
    starts = np.cumsum([0, *(len(p.vertices) for p in pieces)])
    triangles = np.concatenate([p.triangles + start for p, start in zip(pieces, starts, strict=False)])
    return np.concatenate([p.vertices for p in pieces]), padded(triangles)


def _material_mesh(gltf: Gltf, pieces: list[_Piece]) -> Mesh:
    """Join the pieces of one material."""
    vertices, faces = _joined(pieces)
    texture = _texture(gltf, pieces[0].material)
    coordinates = [piece.uv for piece in pieces if piece.uv is not None]
    material = read_material(gltf, pieces[0].material, has_uv=bool(coordinates))
    linear = _linear_colors(pieces)
    if not coordinates:  # a texture without texture coordinates: use its mean colour
        srgb = encode_srgb(linear) * texture.reshape(-1, 3).mean(axis=0)
        srgb_colors = np.rint(srgb).astype(np.uint8)
        return Mesh(vertices, faces, colors=srgb_colors, material=material, shading=_shading(pieces))
    uv = np.concatenate(coordinates) * [1, -1] + [0, 1]
    colors, shading = _srgb_colors(linear), _shading(pieces)
    return Mesh(vertices, faces, uv, faces, colors, texture, material=material, shading=shading)


def _linear_colors(pieces: list[_Piece]) -> Array:
    """Vertex colours (V, 3) of all pieces, linear. Pieces without colours are white."""
    return np.concatenate([np.ones_like(p.vertices) if p.colors is None else p.colors for p in pieces])


def _srgb_colors(linear: Array) -> NDArray[np.uint8] | None:
    """Vertex colours (V, 3) of a mesh; None if all are white."""
    return None if (linear == 1).all() else np.rint(255 * encode_srgb(linear)).astype(np.uint8)


@dataclass(frozen=True)
class _Attachment:
    """How the mesh of a node is placed, and which joints move it.

    ``to_common``: (4, 4) transform to the common space. ``joints``: number of each joint of the skin among
    all ``n_joints``. ``parent_joint``: joint that moves a mesh without skin. ``pose``: (J, 4, 4) transforms
    of the joints of the skin, which pose a mesh in a scene.
    """

    to_common: Array
    joints: NDArray[np.intp] | None = None
    parent_joint: int | None = None
    n_joints: int = 0
    pose: Array | None = None


def _pieces(gltf: Gltf, number: int, skeleton: GltfSkeleton | None) -> Iterator[_Piece]:
    """Pieces of the mesh of node ``number``: one for each primitive."""
    node = gltf.nodes[number]
    if node.mesh is None:
        return
    key = f"meshes.{node.mesh}"
    if skeleton is None:
        attachment: _Attachment | None = _attachment_in_scene(gltf, number)
    else:
        attachment = _attachment_to_skeleton(gltf, number, skeleton)
    if attachment is None:
        return
    for primitive in gltf.mesh(node.mesh).primitives:
        piece = _piece(gltf, primitive, key, attachment)
        if piece is not None:
            yield piece


def _attachment_in_scene(gltf: Gltf, number: int) -> _Attachment:
    skin = gltf.nodes[number].skin
    if skin is None:
        return _Attachment(gltf.at_rest[number])
    joints = np.array(gltf.skin(skin).joints)
    pose = gltf.at_rest[joints] @ np.linalg.inv(gltf.bind_matrices(skin))
    return _Attachment(gltf.at_rest[number], np.arange(len(joints)), n_joints=len(joints), pose=pose)


def _attachment_to_skeleton(gltf: Gltf, number: int, skeleton: GltfSkeleton) -> _Attachment | None:
    node, n_joints = gltf.nodes[number], len(skeleton.nodes)
    if node.skin is not None:
        joint_of_node = {int(n): joint for joint, n in enumerate(skeleton.nodes)}
        joints = np.array([joint_of_node[joint] for joint in gltf.skin(node.skin).joints])
        return _Attachment(skeleton.from_skin[node.skin], joints, n_joints=n_joints)
    parent_joint = skeleton.joint_of(gltf, number)
    if parent_joint is None:
        warn_about(gltf.path, f"{node.name or f'node {number}'!r} has no parent joint and is ignored")
        return None
    # a mesh without skin, such as a hat, moves with its joint
    world = gltf.at_rest
    to_joint = np.linalg.inv(world[skeleton.nodes[parent_joint]]) @ world[number]
    return _Attachment(skeleton.bind[parent_joint] @ to_joint, parent_joint=parent_joint, n_joints=n_joints)


def _piece(gltf: Gltf, primitive: Primitive, key: str, attachment: _Attachment) -> _Piece | None:
    if primitive.mode < 4 or "POSITION" not in primitive.attributes:
        return None  # points or lines
    points = gltf.attribute(primitive, "POSITION", ["VEC3"], "positions").astype(float)
    indices, mode = gltf.indices(primitive)
    corners = np.arange(len(points), dtype=np.int64) if indices is None else indices
    if not len(corners):
        return None
    if corners.max() >= len(points) or corners.min() < 0:
        raise MeshError(f"a face uses vertex {corners.max()} of {len(points)}", path=gltf.path, key=key)
    triangles = _triangles(corners, mode)
    if not len(triangles):
        return None
    weights: csr_matrix | None = None
    to_common = attachment.to_common
    vertices = points @ to_common[:3, :3].T + to_common[:3, 3]
    own_normals = _normals(gltf, primitive, key, len(points))
    normals = None if own_normals is None else own_normals @ np.linalg.pinv(to_common[:3, :3])
    mirrored = np.linalg.det(to_common[:3, :3]) < 0
    if attachment.joints is not None and (attachment.pose is None or "JOINTS_0" in primitive.attributes):
        weights = _weights(gltf, primitive, key, attachment.joints, len(points), attachment.n_joints)
        if attachment.pose is not None:
            vertices = _posed(points, weights, attachment.pose)
            if own_normals is not None:
                pose = attachment.pose.copy()
                pose[:, :3, :3] = np.swapaxes(np.linalg.pinv(pose[:, :3, :3]), 1, 2)
                pose[:, :3, 3] = 0.0
                normals = _posed(own_normals, weights, pose)
            mirrored, weights = np.median(np.linalg.det(attachment.pose[:, :3, :3])) < 0, None
    elif attachment.parent_joint is not None:
        ones = np.ones(len(points))
        columns = np.full(len(points), attachment.parent_joint)
        shape = (len(points), attachment.n_joints)
        weights = csr_matrix((ones, columns, np.arange(len(points) + 1)), shape=shape)
    if normals is not None:
        normals = unit_vectors(normals)
    if mirrored:
        triangles = triangles[:, ::-1]
    uv = _texture_coordinates(gltf, primitive, key, len(points))
    colors: Array | None = None
    if "COLOR_0" in primitive.attributes:
        colors = gltf.attribute(primitive, "COLOR_0", ["VEC3", "VEC4"], "colours").astype(float)
        _same_length(gltf, colors, len(points), key)
        if colors.shape[1] == 4 and (colors[:, 3] < 1).any():
            warn_about(gltf.path, f"{key}: the opacity of vertex colours is ignored")
        colors = np.clip(colors[:, :3], 0.0, 1.0)
    return _Piece(vertices, triangles, uv, primitive.material, weights, colors, normals)


def _normals(gltf: Gltf, primitive: Primitive, key: str, count: int) -> Array | None:
    """Normals (V, 3) in the space of the mesh; None if the file has no normals."""
    if "NORMAL" not in primitive.attributes:
        return None
    normals: Array = gltf.attribute(primitive, "NORMAL", ["VEC3"], "normals").astype(float)
    _same_length(gltf, normals, count, key)
    return normals


def _texture_coordinates(gltf: Gltf, primitive: Primitive, key: str, count: int) -> Array | None:
    """Texture coordinates (V, 2), v down, for the colour of a material; None if there are none."""
    info = gltf.material(primitive.material).pbrMetallicRoughness.baseColorTexture
    change = None if info is None else info.extensions.KHR_texture_transform
    number = 0 if info is None else info.texCoord
    if change is not None and change.texCoord is not None:
        number = change.texCoord
    name = f"TEXCOORD_{number}"
    if name not in primitive.attributes:
        return None
    uv: Array = gltf.attribute(primitive, name, ["VEC2"], "texture coordinates").astype(float)
    _same_length(gltf, uv, count, key)
    if change is None:
        return uv
    c, s = np.cos(change.rotation), np.sin(change.rotation)
    return uv * change.scale @ np.array([[c, -s], [s, c]]) + change.offset


def _posed(points: Array, weights: csr_matrix, pose: Array) -> Array:
    """Vertices (V, 3) of a skinned mesh in a pose (J, 4, 4) [glTF 2.0]."""
    homogeneous = np.c_[points, np.ones(len(points))]
    rows = [np.einsum("vi,vi->v", weights @ pose[:, axis], homogeneous) for axis in range(3)]
    return np.stack(rows, axis=1)


def _weights(
    gltf: Gltf, primitive: Primitive, key: str, joints: NDArray[np.intp], n_vertices: int, n_joints: int
) -> csr_matrix:
    """Weights (V, J) of a primitive, summed over its sets; rows sum to one. ``joints``: number in J of each
    joint of the skin."""
    total = csr_matrix((n_vertices, n_joints))
    count = 0
    while f"JOINTS_{count}" in primitive.attributes and f"WEIGHTS_{count}" in primitive.attributes:
        bones = gltf.attribute(primitive, f"JOINTS_{count}", ["VEC4"], "joints").astype(np.int64)
        values = gltf.attribute(primitive, f"WEIGHTS_{count}", ["VEC4"], "weights").astype(float)
        for array in (bones, values):
            _same_length(gltf, array, n_vertices, key)
        if bones.max() >= len(joints) and (values[bones >= len(joints)] > 0).any():
            raise MeshError(f"a weight is for joint {bones.max()} of {len(joints)}", path=gltf.path, key=key)
        columns = joints[np.minimum(bones, len(joints) - 1)]
        rows = np.repeat(np.arange(n_vertices), 4)
        total = total + csr_matrix((values.ravel(), (rows, columns.ravel())), shape=(n_vertices, n_joints))
        count += 1
    if not count:
        raise MeshError("a skinned mesh without joints and weights", path=gltf.path, key=key)
    with located(path=gltf.path, key=key):
        return normalise_weights(total)


def _same_length(gltf: Gltf, values: NDArray[np.generic], count: int, key: str) -> None:
    if len(values) != count:
        raise MeshError(f"{len(values)} values for {count} vertices", path=gltf.path, key=key)


def _triangles(corners: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """Triangles (N, 3) of a list, strip or fan of corners. Degenerate triangles are left out."""
    out: NDArray[np.int64]
    if mode == 4:
        out = corners[: len(corners) // 3 * 3].reshape(-1, 3)
    elif mode == 5:
        out = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
        out[1::2] = out[1::2, ::-1]
    else:
        middle = np.broadcast_to(corners[:1], max(len(corners) - 2, 0))
        out = np.stack([middle, corners[1:-1], corners[2:]], axis=1)
    a, b, c = out.T
    return out[(a != b) & (b != c) & (c != a)]


# --- one mesh with one texture


def _one_mesh(gltf: Gltf, pieces: list[_Piece]) -> Mesh:
    """Join all pieces to one mesh with a texture atlas of their materials."""
    vertices, faces = _joined(pieces)
    materials = [piece.material for piece in pieces]
    known = list(dict.fromkeys(materials))
    if known == [None]:
        return Mesh(vertices, faces, colors=_srgb_colors(_linear_colors(pieces)))
    uv = np.concatenate([np.zeros((len(p.vertices), 2)) if p.uv is None else p.uv for p in pieces])
    uv[:, 1] = 1 - uv[:, 1]
    counts = [len(piece.triangles) for piece in pieces]
    has_uv = np.repeat([piece.uv is not None for piece in pieces], counts)
    tiles = [_texture(gltf, number) for number in known]
    plain = np.array([tile.shape[0] == PLAIN for tile in tiles])
    material = np.repeat([known.index(number) for number in materials], counts)
    # a tile of one colour needs no texture coordinates
    uv_faces = np.where((has_uv & ~plain[material])[:, None], faces, -1).astype(np.int32)
    if len(tiles) == 1 and plain[0]:
        uv_faces = faces
    return atlas_mesh(vertices, faces, uv, uv_faces, material, tiles)


def _texture(gltf: Gltf, number: int | None) -> NDArray[np.uint8]:
    """Texture (H, W, 3) of a material times its colour. Without a texture, a small tile of the colour."""
    pbr = gltf.material(number).pbrMetallicRoughness
    factor = np.clip(np.array(pbr.baseColorFactor[:3]), 0.0, 1.0)
    srgb = encode_srgb(factor)
    image = None if (base := pbr.baseColorTexture) is None else _decoded(gltf, base, gltf.decoded_images.get)
    if base is None or image is None:
        return plain_tile(srgb)
    if (factor < 1).any():
        source = gltf.texture_image(base.index)
        image = gltf.decoded_images.tinted(source, image, srgb)
    return image
