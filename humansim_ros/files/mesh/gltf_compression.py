"""Compressed parts of glTF files: meshopt buffer views and Draco primitives."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from humansim_ros.errors import MeshError, in_section
from humansim_ros.files.mesh import meshopt
from humansim_ros.files.mesh.gltf_schema import Index, Part
from humansim_ros.files.yaml.schema_messages import validated

DRACO = "KHR_draco_mesh_compression"
#: Magic bytes, version, kind, method and flags.
_DRACO_START = "<5s4BH"
_MESHOPT = ("KHR_meshopt_compression", "EXT_meshopt_compression")
#: Largest size of all decoded buffer views in bytes, and most elements of a view with indices.
MAX_DECODED, _MAX_INDICES = 1 << 29, 30_000_000
#: Most triangles or points in the Draco data of a file, since a few hundred bytes can declare any number.
MAX_DRACO = 5_000_000


class MeshoptView(Part):
    """Extension of a buffer view: place and layout of the compressed data."""

    buffer: Index
    byteOffset: Index = 0
    byteLength: Annotated[int, Field(ge=1)]
    byteStride: Annotated[int, Field(ge=1, le=256)]
    count: Annotated[int, Field(ge=1)]
    mode: Literal["ATTRIBUTES", "TRIANGLES", "INDICES"]
    filter: Literal["NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", "COLOR"] = "NONE"


class DracoPrimitive(Part):
    """Extension of a primitive: the buffer view with the compressed mesh, and the ids of its attributes."""

    bufferView: Index
    attributes: dict[str, Index]


class DracoMesh:
    """Decoded Draco mesh: ``triangles`` (N, 3), and ``attributes`` (V, width) by id. Raises MeshError if
    DracoPy is missing or refuses the data, or if there are more than ``most`` triangles or points."""

    def __init__(self, data: bytes, most: int) -> None:
        try:
            import DracoPy
        except ImportError:
            raise MeshError(
                f"the mesh needs {DRACO}: install the decoder (pip install DracoPy), "
                "or export the file without compression"
            ) from None
        count = _DracoHeader(data).count()
        if count > most:
            raise MeshError(f"{count} triangles or points of Draco data; at most {MAX_DRACO} are read")
        try:
            decoded = DracoPy.decode(data)
            self.triangles: NDArray[np.int64] = np.asarray(decoded.faces).reshape(-1, 3).astype(np.int64)
            self.attributes: dict[int, NDArray[Any]] = {
                int(attribute["unique_id"]): np.asarray(attribute["data"]) for attribute in decoded.attributes
            }
        except Exception as reason:  # the C++ library raises errors that have no common class
            raise MeshError(f"the Draco data cannot be decoded: {str(reason)[:100]}") from None


class _DracoHeader:
    """Header of Draco data of version 2.2, which glTF files have [Draco bitstream]."""

    _METADATA = 0x8000

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._offset = struct.calcsize(_DRACO_START)

    def count(self) -> int:
        """Number of triangles or points, whichever is larger. Raises MeshError for other data."""
        try:
            magic, major, minor, kind, method, flags = struct.unpack_from(_DRACO_START, self._data)
            if (magic, major, minor, kind) != (b"DRACO", 2, 2, 1) or method > 1:
                raise MeshError("the Draco data are not a mesh of version 2.2: export it again")
            if flags & self._METADATA:
                for _ in range(self._number()):
                    self._number()
                    self._skip_metadata()
                self._skip_metadata()
            self._offset += method  # the kind of the traversal
            return max(self._number(), self._number())
        except (struct.error, IndexError, RecursionError):
            raise MeshError("the header of the Draco data is damaged") from None

    def _number(self) -> int:
        """Read a number that is stored with seven bits in each byte."""
        value = shift = 0
        while shift < 35:
            byte = self._data[self._offset]
            self._offset += 1
            value |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                break
        return value

    def _skip_metadata(self) -> None:
        for _ in range(self._number()):
            self._skip_name()
            length = self._number()
            self._offset += length
        for _ in range(self._number()):
            self._skip_name()
            self._skip_metadata()

    def _skip_name(self) -> None:
        self._offset += 1 + self._data[self._offset]


def meshopt_view(extensions: Mapping[str, Any]) -> MeshoptView | None:
    """Meshopt extension of a buffer view; None if the view has none. Raises MeshError, which names the wrong
    key."""
    name = next((name for name in _MESHOPT if name in extensions), None)
    return None if name is None else _validated(MeshoptView, extensions[name], name)


def draco_primitive(extensions: Mapping[str, Any]) -> DracoPrimitive | None:
    """Draco extension of a primitive; None if the primitive has none. Raises MeshError, which names the wrong
    key."""
    return _validated(DracoPrimitive, extensions[DRACO], DRACO) if DRACO in extensions else None


def decode_meshopt(view: MeshoptView, data: bytes) -> bytes:
    """Decode the data of a meshopt buffer view. Raises MeshError."""
    if view.mode != "ATTRIBUTES" and view.count > _MAX_INDICES:
        raise MeshError(f"{view.count} indices; at most {_MAX_INDICES} are read")
    try:
        return meshopt.decode(data, view.mode, view.filter, view.count, view.byteStride).tobytes()
    except ValueError as reason:
        raise MeshError(f"the meshopt data cannot be decoded: {reason}") from None


def _validated(model: type[Any], content: Any, name: str) -> Any:
    with in_section(name):
        return validated(model, content, MeshError)
