"""Parts of glTF 2.0 files: schema of the JSON document, and a builder of binary files [glTF 2.0]."""

from __future__ import annotations

import json
import struct
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from humansim_ros.files.yaml.schema import Checked

Index = Annotated[int, Field(ge=0)]
Number = Annotated[float, Field(ge=-1e6, le=1e6)]
Pair = tuple[Number, Number]
Vector = tuple[float, float, float]


class Part(Checked):
    """Section of the document. Unlike a Section of files.yaml, it may have unknown keys, as files do."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Buffer(Part):
    """Binary data, in a file or in the document."""

    byteLength: Annotated[int, Field(ge=1)]
    uri: str | None = None


class MeshoptView(Part):
    """Compressed data of a buffer view [KHR_meshopt_compression]."""

    buffer: Index
    byteOffset: Index = 0
    byteLength: Annotated[int, Field(ge=1)]
    byteStride: Annotated[int, Field(ge=1, le=256)]
    count: Annotated[int, Field(ge=1)]
    mode: Literal["ATTRIBUTES", "TRIANGLES", "INDICES"]
    filter: Literal["NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", "COLOR"] = "NONE"


class ViewExtensions(Part):
    """Extensions of a buffer view: the same one under its two names."""

    KHR_meshopt_compression: MeshoptView | None = None
    EXT_meshopt_compression: MeshoptView | None = None


class BufferView(Part):
    """Range of bytes in a buffer."""

    buffer: Index
    byteOffset: Index = 0
    byteLength: Annotated[int, Field(ge=1)]
    byteStride: Annotated[int, Field(ge=4, le=252)] | None = None
    extensions: ViewExtensions = ViewExtensions()


class SparseValues(Part):
    """Values of a sparse accessor."""

    bufferView: Index
    byteOffset: Index = 0


class SparseIndices(SparseValues):
    """Where a sparse accessor stores the indices of the rows that it replaces, and their integer type."""

    componentType: Literal[5121, 5123, 5125]


class Sparse(Part):
    """Values that replace some rows of an accessor."""

    count: Annotated[int, Field(ge=1)]
    indices: SparseIndices
    values: SparseValues


class Accessor(Part):
    """Type and place of an array."""

    bufferView: Index | None = None
    byteOffset: Index = 0
    componentType: Literal[5120, 5121, 5122, 5123, 5125, 5126]
    normalized: bool = False
    count: Annotated[int, Field(ge=1)]
    type: Literal["SCALAR", "VEC2", "VEC3", "VEC4", "MAT2", "MAT3", "MAT4"]
    sparse: Sparse | None = None


class DracoPrimitive(Part):
    """Buffer view with a compressed mesh, and the ids of its attributes [KHR_draco_mesh_compression]."""

    bufferView: Index
    attributes: dict[str, Index]


class PrimitiveExtensions(Part):
    """Extensions of a primitive."""

    KHR_draco_mesh_compression: DracoPrimitive | None = None


class Primitive(Part):
    """Part of a mesh with one material. ``mode`` 4, 5 and 6 are triangles, strip and fan."""

    attributes: dict[str, Index]
    indices: Index | None = None
    material: Index | None = None
    mode: Annotated[int, Field(ge=0, le=6)] = 4
    targets: tuple[dict[str, Any], ...] = ()
    extensions: PrimitiveExtensions = PrimitiveExtensions()
    extras: Any = None


class GltfMesh(Part):
    """Primitives of a mesh. ``extras`` may have the names of its morph targets."""

    name: str = ""
    primitives: tuple[Primitive, ...]
    extras: Any = None


class Skin(Part):
    """Joints (node indices) and the accessor of their inverse bind matrices."""

    name: str = ""
    joints: Annotated[tuple[Index, ...], Field(min_length=1)]
    inverseBindMatrices: Index | None = None


class Node(Part):
    """Node of the tree, with its transform relative to its parent."""

    name: str = ""
    children: tuple[Index, ...] = ()
    mesh: Index | None = None
    skin: Index | None = None
    matrix: Annotated[tuple[float, ...], Field(min_length=16, max_length=16)] | None = None
    translation: Vector = (0.0, 0.0, 0.0)
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    scale: Vector = (1.0, 1.0, 1.0)


class TextureTransform(Part):
    """Texture coordinates: uv' = offset + rotation * scale * uv, with v down [KHR_texture_transform]."""

    offset: Pair = (0.0, 0.0)
    rotation: Number = 0.0
    scale: Pair = (1.0, 1.0)
    texCoord: Index | None = None


class TextureExtensions(Part):
    """Extensions of a texture. ``model_extra`` has those that are not read."""

    model_config = ConfigDict(extra="allow")

    KHR_texture_transform: TextureTransform | None = None


class TextureInfo(Part):
    """Reference to a texture, its set of texture coordinates, and ``scale`` of normal maps."""

    index: Index
    texCoord: Index = 0
    scale: float = 1.0
    extensions: TextureExtensions = TextureExtensions()


class Pbr(Part):
    """Metallic-roughness model of a material."""

    baseColorFactor: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    baseColorTexture: TextureInfo | None = None
    metallicFactor: float = 1.0
    roughnessFactor: float = 1.0
    metallicRoughnessTexture: TextureInfo | None = None


class EmissiveStrength(Part):
    """Factor of the emitted light [KHR_materials_emissive_strength]."""

    emissiveStrength: Number = 1.0


class MaterialExtensions(Part):
    """Extensions of a material. ``model_extra`` has those that are not read."""

    model_config = ConfigDict(extra="allow")

    KHR_materials_emissive_strength: EmissiveStrength = EmissiveStrength()


class GltfMaterial(Part):
    """Material. Colours are linear factors."""

    name: str = ""
    pbrMetallicRoughness: Pbr = Pbr()
    normalTexture: TextureInfo | None = None
    occlusionTexture: TextureInfo | None = None
    emissiveTexture: TextureInfo | None = None
    emissiveFactor: Vector = (0.0, 0.0, 0.0)
    alphaMode: Literal["OPAQUE", "MASK", "BLEND"] = "OPAQUE"
    alphaCutoff: float = 0.5
    doubleSided: bool = False
    extensions: MaterialExtensions = MaterialExtensions()


class Wrap(Part):
    """Wrap modes of a texture."""

    wrapS: Literal[33071, 33648, 10497] = 10497
    wrapT: Literal[33071, 33648, 10497] = 10497


class Texture(Part):
    """Image and sampler."""

    source: Index | None = None
    sampler: Index | None = None


class ImageSource(Part):
    """Encoded image, in a file or a buffer view."""

    uri: str | None = None
    bufferView: Index | None = None


class Target(Part):
    """Animated property of a node."""

    node: Index | None = None
    path: str


class AnimationChannel(Part):
    """Sampler and target."""

    sampler: Index
    target: Target


class Sampler(Part):
    """Accessors of key times and values."""

    input: Index
    output: Index
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"] = "LINEAR"


class Animation(Part):
    """Animation. Each channel animates one property of one node with the values of a sampler."""

    name: str = ""
    channels: tuple[AnimationChannel, ...]
    samplers: tuple[Sampler, ...]


class Asset(Part):
    """Version of the format."""

    version: str


class Document(Part):
    """Content of a file."""

    asset: Asset
    extensionsRequired: tuple[str, ...] = ()
    buffers: tuple[Buffer, ...] = ()
    bufferViews: tuple[BufferView, ...] = ()
    accessors: tuple[Accessor, ...] = ()
    meshes: tuple[GltfMesh, ...] = ()
    skins: tuple[Skin, ...] = ()
    nodes: tuple[Node, ...] = ()
    materials: tuple[GltfMaterial, ...] = ()
    textures: tuple[Texture, ...] = ()
    samplers: tuple[Wrap, ...] = ()
    images: tuple[ImageSource, ...] = ()
    animations: tuple[Animation, ...] = ()
    extensions: dict[str, Any] = Field(default_factory=dict)


#: Numbers of component types by dtype, and names of accessor types by the shape of a value.
_TYPES = {np.dtype(code): number for code, number in (("u1", 5121), ("u2", 5123), ("u4", 5125), ("f4", 5126))}
_SHAPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class GlbBuilder:
    """Builder of a .glb file: the lists of its document, such as the nodes, and the buffer with its
    arrays."""

    def __init__(self) -> None:
        self.lists: dict[str, list[dict[str, Any]]] = {}
        self.binary = bytearray()

    def add(self, kind: str, item: dict[str, Any]) -> int:
        """Add an item to a list of the document. Returns its number."""
        items = self.lists.setdefault(kind, [])
        items.append(item)
        return len(items) - 1

    def accessor(self, values: NDArray[Any], target: int | None = None, bounds: bool = False) -> int:
        """Add an array (N, ...) of float32, uint8, uint16 or uint32. Returns the number of its accessor.
        ``bounds``: store the smallest and largest values, which glTF requires for positions and times."""
        accessor: dict[str, Any] = {
            "bufferView": self.view(values.tobytes(), target),
            "componentType": _TYPES[values.dtype],
            "count": len(values),
            "type": _SHAPES[values.shape[1:]],
        }
        if bounds:
            ends = {"min": values.min(0), "max": values.max(0)}
            accessor |= {name: np.atleast_1d(end).tolist() for name, end in ends.items()}
        return self.add("accessors", accessor)

    def view(self, data: bytes, target: int | None = None) -> int:
        """Add bytes to the buffer. Returns the number of the buffer view of these bytes."""
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        if target is not None:
            view["target"] = target
        self.binary += data + bytes(-len(data) % 4)
        return self.add("bufferViews", view)

    def image(self, encoded: bytes) -> int:
        """Add a JPEG or PNG file. Returns the number of its texture."""
        kind = "image/jpeg" if encoded[:2] == b"\xff\xd8" else "image/png"
        image = self.add("images", {"bufferView": self.view(encoded), "mimeType": kind})
        return self.add("textures", {"source": image})

    def packed(self, **document: Any) -> bytes:
        """Content of the .glb file: ``document`` with the lists, and the buffer."""
        if self.binary:
            document["buffers"] = [{"byteLength": len(self.binary)}]
        document = {**document, "asset": {"version": "2.0", **document.get("asset", {})}, **self.lists}
        text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        chunks = [(b"JSON", text + b" " * (-len(text) % 4)), (b"BIN\0", bytes(self.binary))]
        body = b"".join(struct.pack("<I4s", len(chunk), kind) + chunk for kind, chunk in chunks if chunk)
        return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body
