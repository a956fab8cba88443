"""glTF 2.0 files (.gltf, .glb): nodes, meshes, skins, materials and animations as the file has them [glTF
2.0].

All content is checked before use: sizes against the data, indices against their arrays, the node tree for
cycles. Further files must be in the folder of the file or below it; nothing is fetched from a network.
"""

from __future__ import annotations

import base64
import binascii
import os
import struct
import urllib.parse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from humansim_ros.errors import MeshError, located, printable, some_of
from humansim_ros.files.mesh.gltf_compression import (
    DRACO,
    MAX_DECODED,
    MAX_DRACO,
    DracoMesh,
    decode_meshopt,
)
from humansim_ros.files.mesh.gltf_format import (
    Accessor,
    Animation,
    Document,
    GltfMaterial,
    GltfMesh,
    MeshoptView,
    Node,
    Primitive,
    Skin,
    SparseValues,
)
from humansim_ros.files.mesh.mesh import MAX_BYTES, read_format
from humansim_ros.files.reading.files import parse_json, read_bytes, resolve_inside
from humansim_ros.files.reading.images import MAX_IMAGE_BYTES, DecodedImages
from humansim_ros.files.yaml.schema import schema_errors
from humansim_ros.geometry import find_cycle, levels, quaternion_to_matrix
from humansim_ros.types import Array

#: Most values in an accessor, and in an accessor without data, which stands for zeros.
MAX_VALUES, _MAX_ZEROS = 100_000_000, 10_000_000
#: Most values in the JSON part. Each value needs some fifty bytes of memory.
_MAX_ITEMS = 10_000_000
#: Most nodes. A house with all its furniture has some thousands.
_MAX_NODES = 50_000
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}

Item = TypeVar("Item")


@dataclass(frozen=True)
class Gltf:
    """Content of a glTF file. Wrong content raises MeshError. ``decoded_images``: cache of the images that
    have been decoded, by number."""

    path: Path
    document: Document
    embedded: bytes | None
    decoded_images: DecodedImages = field(default_factory=DecodedImages, compare=False)
    _draco_meshes: dict[int, DracoMesh] = field(default_factory=dict, compare=False)
    #: Cache of the decoded content of buffer views with meshopt data, and of buffers, by number.
    _decoded: dict[int, bytes] = field(default_factory=dict, compare=False)
    _buffers: dict[int, bytes] = field(default_factory=dict, compare=False)

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Gltf:
        """Read a .gltf or .glb file, or an FBX or COLLADA file, which is converted."""
        return cls.parse(path, read_format(path, "glTF")[1])

    @classmethod
    def parse(cls, path: str | os.PathLike[str], data: bytes) -> Gltf:
        """Parse the content of a .gltf or .glb file. The first bytes decide which format it has."""
        text, embedded = _glb_chunks(data, path) if data[:4] == b"glTF" else (data, None)
        if b"\0" in text:
            raise MeshError("not a glTF file: its JSON part is not text", path=path)
        try:
            decoded = text.decode("utf-8-sig")
        except ValueError as reason:
            raise MeshError(f"not a glTF file: {reason}", path=path) from None
        content = parse_json(decoded, MeshError, path, kind="a glTF file", most=_MAX_ITEMS)
        nodes = content.get("nodes") if isinstance(content, dict) else None
        if isinstance(nodes, list) and len(nodes) > _MAX_NODES:
            message = f"{len(nodes)} nodes; at most {_MAX_NODES} are read: join its meshes"
            raise MeshError(message, path=path, key="nodes")
        try:
            document = Document.model_validate(content)
        except ValidationError as reason:
            fault = schema_errors(reason, Document, MeshError)[0]
            raise MeshError(f"not a glTF 2 file: {fault.message}", path=path, key=fault.key) from None
        if not (version := document.asset.version).startswith("2."):
            message = f"glTF {version[:20]!r} is not 2.0: export it again"
            raise MeshError(message, path=path, key="asset.version")
        if "KHR_texture_basisu" in document.extensionsRequired:
            raise MeshError("its textures are KTX2 files: export them as PNG or JPEG", path=path)
        gltf = cls(Path(path), document, embedded)
        _ = gltf.parents  # this checks the tree
        return gltf

    # --- the tree of nodes

    @property
    def nodes(self) -> tuple[Node, ...]:
        """Nodes of the file."""
        return self.document.nodes

    @cached_property
    def parents(self) -> NDArray[np.intp]:
        """(N,) parent of each node, -1 for none."""
        parents = np.full(len(self.nodes), -1, dtype=np.intp)
        for number, node in enumerate(self.nodes):
            for child in node.children:
                self._item(self.nodes, child, f"nodes.{number}.children")
                if parents[child] >= 0:
                    raise self._error(f"node {child} has two parents", f"nodes.{number}.children")
                parents[child] = number
        if cycle := find_cycle(parents):
            names = some_of(printable(self.nodes[node].name or f"node {node}", 40) for node in cycle)
            message = f"the nodes {names} are their own ancestors: the tree has a cycle"
            raise self._error(message, f"nodes.{cycle[0]}.children")
        return parents

    def local(self, properties: dict[tuple[int, str], Array] | None = None) -> Array:
        """Transforms (..., N, 4, 4) of the nodes relative to their parents. ``properties``: values that
        replace properties of the file, such as ``(3, "rotation"): (..., 4)`` for node 3."""
        properties = properties or {}
        shape = next((value.shape[:-1] for value in properties.values()), ())
        out = np.broadcast_to(np.eye(4), (*shape, len(self.nodes), 4, 4)).copy()
        for number, node in enumerate(self.nodes):
            if node.matrix is not None:
                out[..., number, :, :] = np.reshape(node.matrix, (4, 4)).T
                continue
            t, r, s = (
                properties.get((number, name), np.array(getattr(node, name)))
                for name in ("translation", "rotation", "scale")
            )
            size = np.linalg.norm(r, axis=-1, keepdims=True)
            if (size < 1e-6).any():
                raise self._error("a rotation is no unit quaternion", f"nodes.{number}.rotation")
            out[..., number, :3, :3] = quaternion_to_matrix(r / size) * s[..., None, :]
            out[..., number, :3, 3] = t
        return out

    def world(self, local: Array | None = None) -> Array:
        """Transforms (..., N, 4, 4) of the nodes to the scene, from :meth:`local` transforms."""
        local = self.local() if local is None else local
        out = np.array(local)
        order = self.order
        rank = np.argsort(order)
        in_order = np.where(self.parents[order] < 0, -1, rank[self.parents[order]])
        for bones in levels(in_order)[1:]:
            nodes = order[bones]
            out[..., nodes, :, :] = out[..., self.parents[nodes], :, :] @ local[..., nodes, :, :]
        return out

    @cached_property
    def at_rest(self) -> Array:
        """Transforms (N, 4, 4) of the nodes to the scene, without animation."""
        return self.world()

    @cached_property
    def order(self) -> NDArray[np.intp]:
        """(N,) nodes in the order of the file, but with parents before children."""
        order: list[int] = []
        pending = [int(root) for root in np.flatnonzero(self.parents < 0)[::-1]]
        while pending:
            number = pending.pop()
            order.append(number)
            pending += reversed(self.nodes[number].children)
        return np.array(order, dtype=np.intp)

    # --- the data

    def accessor(self, number: int, kinds: Sequence[str], what: str) -> NDArray[Any]:
        """Values (count,) or (count, width) of an accessor; matrices (count, n, n). Normalised integers
        become floats. ``kinds``: valid types of the accessor for ``what``."""
        key = f"accessors.{number}"
        accessor = self._item(self.document.accessors, number, key)
        if accessor.type not in kinds:
            raise self._error(f"{what} must be {' or '.join(kinds)}, not {accessor.type}", key)
        width = _WIDTHS[accessor.type]
        if accessor.count * width > (MAX_VALUES if accessor.bufferView is not None else _MAX_ZEROS):
            raise self._error(f"{accessor.count} values are too many", key)
        dtype = np.dtype(_TYPES[accessor.componentType])
        if accessor.bufferView is None:
            values = np.zeros((accessor.count, width), dtype)
        else:
            values = self._read(accessor, accessor.count, width, dtype, key)
        if accessor.sparse is not None:
            sparse, n = accessor.sparse, accessor.sparse.count
            if n > accessor.count:
                raise self._error("more sparse values than values", key)
            rows = self._read(sparse.indices, n, 1, np.dtype(_TYPES[sparse.indices.componentType]), key)[:, 0]
            if rows.max() >= accessor.count:
                raise self._error(f"sparse value {int(rows.max())} does not exist", key)
            values = values.copy()
            values[rows] = self._read(sparse.values, n, width, dtype, key)
        if accessor.normalized:
            values = _normalised(values, dtype)
        if dtype.kind == "f" and not np.isfinite(values).all():
            raise self._error(f"{what}: a number is not finite (NaN or infinity)", key)
        if accessor.type.startswith("MAT"):
            n = int(np.sqrt(width))
            return np.swapaxes(values.reshape(-1, n, n), -1, -2)  # the file stores columns
        return values[:, 0] if width == 1 else values

    def attribute(self, primitive: Primitive, name: str, kinds: Sequence[str], what: str) -> NDArray[Any]:
        """Values of a vertex attribute of a primitive, which may be a Draco mesh.

        Args:
            primitive: Primitive that has the attribute.
            name: Name of the attribute, such as ``POSITION``.
            kinds: Valid types.
            what: Word for messages.

        Raises:
            MeshError: The accessor or the Draco data are wrong.
        """
        number = primitive.attributes[name]
        mesh, ids = self._draco_mesh(primitive)
        if mesh is None or name not in ids:
            return self.accessor(number, kinds, what)
        key = f"accessors.{number}"
        accessor = self._item(self.document.accessors, number, key)
        values = mesh.attributes.get(ids[name])
        shape = (accessor.count, _WIDTHS[accessor.type])
        if accessor.type not in kinds or values is None or values.reshape(len(values), -1).shape != shape:
            raise self._error(f"the Draco data do not have these {what}", key)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise self._error(f"{what}: a number is not finite (NaN or infinity)", key)
        return _normalised(values, values.dtype) if accessor.normalized else values

    def indices(self, primitive: Primitive) -> tuple[NDArray[np.int64] | None, int]:
        """Vertex indices of a primitive (None if absent), and its mode (:class:`Primitive`)."""
        mesh, _ = self._draco_mesh(primitive)
        if mesh is not None:
            return mesh.triangles.ravel(), 4
        if primitive.indices is None:
            return None, primitive.mode
        return self.accessor(primitive.indices, ["SCALAR"], "indices").astype(np.int64), primitive.mode

    def _draco_mesh(self, primitive: Primitive) -> tuple[DracoMesh | None, dict[str, int]]:
        """Decoded Draco mesh of a primitive (None for no Draco mesh), and the ids of its attributes."""
        packed = primitive.extensions.KHR_draco_mesh_compression
        positions = self._item(self.document.accessors, primitive.attributes["POSITION"], "accessors")
        if packed is None or positions.bufferView is not None:  # the file has the same mesh uncompressed
            return None, {}
        if packed.bufferView not in self._draco_meshes:
            view = self._view(packed.bufferView, f"bufferViews.{packed.bufferView}")
            used = sum(len(mesh.triangles) for mesh in self._draco_meshes.values())
            with located(path=self.path, key=DRACO):
                self._draco_meshes[packed.bufferView] = DracoMesh(bytes(view), MAX_DRACO - used)
        return self._draco_meshes[packed.bufferView], packed.attributes

    def image(self, number: int) -> bytes:
        """Encoded content of image ``number``: a PNG or JPEG file."""
        image = self._item(self.document.images, number, f"images.{number}")
        if image.bufferView is not None:
            return bytes(self._view(image.bufferView, f"images.{number}.bufferView"))
        if image.uri is None:
            raise self._error("the image has no data", f"images.{number}")
        return self._fetch(image.uri, f"images.{number}.uri", MAX_IMAGE_BYTES)

    def texture_image(self, number: int) -> int | None:
        """Index of the image of a texture; None if the texture has no image."""
        return self._item(self.document.textures, number, f"textures.{number}").source

    def wraps(self, number: int) -> tuple[int, int]:
        """Wrap modes of a texture along u and v: 10497 repeat, 33071 clamp to edge, 33648 mirrored repeat."""
        sampler = self._item(self.document.textures, number, f"textures.{number}").sampler
        if sampler is None:
            return 10497, 10497
        wrap = self._item(self.document.samplers, sampler, f"samplers.{sampler}")
        return wrap.wrapS, wrap.wrapT

    def material(self, number: int | None) -> GltfMaterial:
        """Material with an index. None stands for the default material."""
        if number is None:
            return GltfMaterial()
        return self._item(self.document.materials, number, f"materials.{number}")

    def mesh(self, number: int) -> GltfMesh:
        """Mesh with an index."""
        return self._item(self.document.meshes, number, f"meshes.{number}")

    def skin(self, number: int) -> Skin:
        """Skin with an index. Its joints must be different nodes."""
        key = f"skins.{number}.joints"
        skin = self._item(self.document.skins, number, key)
        for joint in skin.joints:
            self._item(self.nodes, joint, key)
        if len(set(skin.joints)) < len(skin.joints):
            raise self._error("a joint occurs twice", key)
        return skin

    def bind_matrices(self, number: int) -> Array:
        """Poses (J, 4, 4) of the joints of a skin at bind time, in the space of the skinned mesh."""
        skin = self.skin(number)
        if skin.inverseBindMatrices is None:
            return np.broadcast_to(np.eye(4), (len(skin.joints), 4, 4)).copy()
        key = f"accessors.{skin.inverseBindMatrices}"
        inverse = self.accessor(skin.inverseBindMatrices, ["MAT4"], "inverse bind matrices").astype(float)
        if len(inverse) < len(skin.joints):
            raise self._error(f"{len(inverse)} matrices for {len(skin.joints)} joints", key)
        inverse = inverse[: len(skin.joints)]
        inverse[:, 3] = [0.0, 0.0, 0.0, 1.0]
        size = np.linalg.svd(inverse[:, :3, :3], compute_uv=False)
        if size.min() < 1e-9 or np.abs(inverse).max() > 1e9:
            raise self._error("an inverse bind matrix has no inverse", key)
        return np.asarray(np.linalg.inv(inverse))

    def keys(self, animation: Animation, channel: int, targets: int = 0) -> tuple[Array, Array, str]:
        """Times (K,) and values (K, width) of a channel, and the interpolation. Cubic splines have values (K,
        3, width). ``targets``: number of morph targets; for a channel of their weights, this is the width."""
        sampler = self._item(animation.samplers, animation.channels[channel].sampler, "animations.samplers")
        times = self.accessor(sampler.input, ["SCALAR"], "times").astype(float)
        kinds = ["SCALAR"] if targets else ["SCALAR", "VEC3", "VEC4"]
        values = self.accessor(sampler.output, kinds, "animated values").astype(float)
        if (np.diff(times) <= 0).any() or times[0] < 0:
            raise self._error("key times must increase and not be negative", f"accessors.{sampler.input}")
        per_key = 3 if sampler.interpolation == "CUBICSPLINE" else 1
        if len(values) != per_key * len(times) * max(targets, 1):
            message = f"{len(values)} values for {len(times)} keys"
            message += f" of {targets} weights" if targets else ""
            raise self._error(message, f"accessors.{sampler.output}")
        if targets:
            values = values.reshape(-1, targets)
        if per_key == 3:
            values = values.reshape(len(times), 3, -1)
        return times, values, sampler.interpolation

    def _read(
        self, place: Accessor | SparseValues, count: int, width: int, dtype: np.dtype[Any], key: str
    ) -> NDArray[Any]:
        """Read values (``count``, ``width``) from the buffer view of an accessor, or of sparse values."""
        assert place.bufferView is not None
        data, offset = self._view(place.bufferView, key), place.byteOffset
        size = width * dtype.itemsize
        stride = self.document.bufferViews[place.bufferView].byteStride or size
        last = offset + stride * (count - 1) + size
        if stride < size or last > len(data):
            raise self._error(f"the buffer view is too short for {count} values", key)
        raw = np.frombuffer(data[offset:last], np.uint8)
        rows = np.lib.stride_tricks.as_strided(raw, (count, size), (stride, 1))
        return np.ascontiguousarray(rows).view(dtype)

    def _view(self, number: int, key: str) -> memoryview:
        view = self._item(self.document.bufferViews, number, key)
        key = f"bufferViews.{number}"
        if number in self._decoded:
            return memoryview(self._decoded[number])
        packed = view.extensions.KHR_meshopt_compression or view.extensions.EXT_meshopt_compression
        if packed is not None:
            return self._decode(number, packed, view.byteLength)
        data = self._buffer(view.buffer, key)
        if view.byteOffset + view.byteLength > len(data):
            raise self._error("the buffer view goes beyond its buffer", key)
        return memoryview(data)[view.byteOffset : view.byteOffset + view.byteLength]

    def _decode(self, number: int, packed: MeshoptView, size: int) -> memoryview:
        """Decode a meshopt buffer view to ``size`` bytes. The result is cached."""
        key = f"bufferViews.{number}"
        if packed.count * packed.byteStride != size:
            raise self._error(f"{packed.count} elements of {packed.byteStride} bytes are not {size}", key)
        if size + sum(len(data) for data in self._decoded.values()) > MAX_DECODED:
            raise self._error(f"more than {MAX_DECODED >> 20} MB of meshopt data", key)
        data, end = self._buffer(packed.buffer, key), packed.byteOffset + packed.byteLength
        if end > len(data):
            raise self._error("the meshopt data go beyond their buffer", key)
        with located(path=self.path, key=key):
            self._decoded[number] = decode_meshopt(packed, data[packed.byteOffset : end])
        return memoryview(self._decoded[number])

    def _buffer(self, number: int, key: str) -> bytes:
        self._item(self.document.buffers, number, key)
        if number not in self._buffers:
            buffer, key = self.document.buffers[number], f"buffers.{number}"
            if buffer.uri is None:
                if self.embedded is None or number:
                    raise self._error("the buffer has no data", key)
                data = self.embedded
            else:
                rest = MAX_BYTES - sum(len(other) for other in self._buffers.values())
                data = self._fetch(buffer.uri, f"{key}.uri", rest)
            if len(data) < buffer.byteLength:
                raise self._error(f"the buffer has {len(data)} bytes, not {buffer.byteLength}", key)
            self._buffers[number] = data
        return self._buffers[number]

    def _fetch(self, uri: str, key: str, most: int) -> bytes:
        """Content of a data URI, or of a file in the folder of this file or below. Other URIs are errors.
        ``most``: maximum size of a file in bytes."""
        if uri.startswith("data:"):
            head, comma, body = uri.partition(",")
            if not comma or not head.endswith(";base64"):
                raise self._error("embedded data must be base64", key)
            try:
                return base64.b64decode(body, validate=True)
            except (binascii.Error, ValueError) as reason:
                raise self._error(f"embedded data cannot be decoded: {reason}", key) from None
        if ":" in uri:
            raise self._error(f"{uri[:60]!r} is not in the folder of the file (no downloads)", key)
        name = urllib.parse.unquote(uri)
        target = resolve_inside(self.path.parent, name)
        if target is None:
            raise self._error(f"{uri[:60]!r} is outside the folder of the file", key)
        try:
            return read_bytes(target, MeshError, "glTF", most)
        except MeshError as error:
            raise self._error(f"{uri[:60]!r}: {error.message}", key) from None

    def external_data(self) -> Iterator[bytes]:
        """Contents of the files that this file refers to, one at a time."""
        uris = {f"buffers.{n}.uri": buffer.uri for n, buffer in enumerate(self.document.buffers)}
        uris |= {f"images.{n}.uri": image.uri for n, image in enumerate(self.document.images)}
        for key, uri in uris.items():
            if uri is not None and not uri.startswith("data:"):
                yield self._fetch(uri, key, MAX_BYTES)

    def _item(self, items: Sequence[Item], number: int, key: str) -> Item:
        if not 0 <= number < len(items):
            raise self._error(f"number {number} does not exist: there are {len(items)}", key)
        return items[number]

    def _error(self, message: str, key: str) -> MeshError:
        return MeshError(message, path=self.path, key=key)


def _normalised(values: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """Convert normalised integers to floats from 0 to 1, or from -1 to 1."""
    return np.maximum(values / np.iinfo(dtype).max, -1.0) if dtype.kind in "iu" else values


def _glb_chunks(data: bytes, path: str | os.PathLike[str]) -> tuple[bytes, bytes | None]:
    """The JSON text and the binary data of a .glb file; None for no binary data."""
    text: bytes | None = None
    embedded: bytes | None = None
    if len(data) >= 12 and struct.unpack_from("<I", data, 4)[0] != 2:
        raise MeshError("the .glb file is not version 2: export it again", path=path)
    offset = 12
    while offset + 8 <= len(data):
        length, kind = struct.unpack_from("<I4s", data, offset)
        chunk = data[offset + 8 : offset + 8 + length]
        if len(chunk) < length:
            raise MeshError(f"the .glb file ends {length - len(chunk)} bytes too early", path=path)
        if kind == b"JSON" and text is None:
            text = chunk
        elif kind == b"BIN\0" and embedded is None:
            embedded = chunk
        offset += 8 + length
    if text is None:
        raise MeshError("the .glb file has no JSON part", path=path)
    return text, embedded
