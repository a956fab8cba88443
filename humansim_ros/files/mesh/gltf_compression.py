"""Compressed parts of glTF files: meshopt buffer views and Draco primitives.

The bitstream of meshopt [EXT_meshopt_compression, KHR_meshopt_compression] is decoded here. Data are
untrusted, so each read is checked, and the size of the result is known before decoding.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import MeshError
from humansim_ros.files.mesh.gltf_format import MeshoptView

Bytes = NDArray[np.uint8]

_GROUP, _MAX_BLOCK = 16, 256
#: Bits of a delta by mode of its group: in version 0, and in version 1 by the control mode of the byte.
_MODE_BITS = ((0, 2, 4, 8), (0, 1, 2, 4), (1, 2, 4, 8))
#: Deltas in each of 256 packed bytes, by bits per delta. Deltas of one bit begin at the lowest bit.
_UNPACKED = {
    1: tuple(bytes((byte >> shift) & 1 for shift in range(8)) for byte in range(256)),
    2: tuple(bytes((byte >> shift) & 3 for shift in (6, 4, 2, 0)) for byte in range(256)),
    4: tuple(bytes((byte >> 4, byte & 15)) for byte in range(256)),
}


# --- attributes


def _attributes(data: bytes, count: int, stride: int) -> Bytes:
    """Decode elements (count, stride) that were compressed as vertex attributes."""
    version = {0xA0: 0, 0xA1: 1}.get(data[0])
    if version is None:
        raise ValueError(f"attributes with header {data[0]:#x}")
    tail = stride + (stride // 4 if version else 0)
    end = len(data) - max(tail, 24 if version else 32)
    start = len(data) - tail
    if end < 1:
        raise ValueError("the data end too early")
    last = np.frombuffer(data, np.uint8, stride, start)
    channels = data[start + stride :] if version else bytes(stride // 4)
    largest = min(8192 // stride & ~(_GROUP - 1), _MAX_BLOCK)
    out = np.empty((count, stride), np.uint8)
    at = 1
    for first in range(0, count, largest):
        size = min(largest, count - first)
        deltas, at = _block(data, at, end, version, size, stride)
        block = out[first : first + size]
        for channel, kind in enumerate(channels):
            columns = slice(4 * channel, 4 * channel + 4)
            block[:, columns] = _integrated(deltas[columns], last[columns], kind)
        last = block[-1]
    if at != end:
        raise ValueError(f"{end - at} bytes too many")
    return out


def _block(data: bytes, at: int, end: int, version: int, size: int, stride: int) -> tuple[Bytes, int]:
    """Deltas (stride, size) of a block at a position, and the position after the block. ``end``: position
    behind the last byte that the block may use. ``size``: number of vertices in the block."""
    groups = -(-size // _GROUP)
    deltas = np.zeros((stride, groups * _GROUP), np.uint8)
    controls = data[at : at + stride // 4] if version else b""
    at += len(controls)
    for byte in range(stride):
        control = controls[byte // 4] >> 2 * (byte % 4) & 3 if version else 0
        if control == 2:
            continue
        if control == 3:
            _check(at + size, end)
            deltas[byte, :size] = np.frombuffer(data, np.uint8, size, at)
            at += size
            continue
        modes = _MODE_BITS[control + 1 if version else 0]
        header, at = at, at + -(-groups // 4)
        _check(at, end)
        for group in range(groups):
            bits = modes[data[header + group // 4] >> 2 * (group % 4) & 3]
            if bits:
                values, at = _group(data, at, bits)
                _check(at, end)
                deltas[byte, group * _GROUP : (group + 1) * _GROUP] = values
    return deltas[:, :size], at


def _group(data: bytes, at: int, bits: int) -> tuple[Bytes, int]:
    """Read 16 deltas: first the packed ones, then the larger ones. Returns also the position after them."""
    packed = data[at : at + 2 * bits]
    at += 2 * bits
    if bits == 8:
        return _bytes(packed), at
    sentinel, table = (1 << bits) - 1, _UNPACKED[bits]
    values = bytearray().join(table[byte] for byte in packed)
    if sentinel in values:
        for number, value in enumerate(values):
            if value == sentinel:
                values[number] = data[at]
                at += 1
    return _bytes(values), at


def _bytes(values: bytes | bytearray) -> Bytes:
    if len(values) != _GROUP:
        raise ValueError("the data end too early")
    return np.frombuffer(values, np.uint8)


def _integrated(deltas: Bytes, last: Bytes, kind: int) -> Bytes:
    """Bytes (N, 4) of a channel: its deltas (4, N), accumulated from the previous bytes (4,)."""
    rotation, kind = kind >> 4, kind & 15
    if kind > 2 or (rotation and kind < 2):
        raise ValueError(f"channel mode {kind}")
    dtype = np.dtype(("<u1", "<u2", "<u4")[kind])
    steps = np.ascontiguousarray(deltas.T).view(dtype)
    before = np.ascontiguousarray(last).view(dtype)[None]
    if kind == 2:
        if rotation:
            steps = steps << dtype.type(rotation) | steps >> dtype.type(32 - rotation)
        values = np.bitwise_xor.accumulate(np.concatenate([before, steps]), axis=0)[1:]
    else:
        one = dtype.type(1)
        signed = steps >> one ^ (~(steps & one) + one)  # zigzag encoding
        values = np.cumsum(np.concatenate([before, signed]), axis=0, dtype=dtype)[1:]
    return np.ascontiguousarray(values.astype(dtype)).view(np.uint8)


def _check(at: int, end: int) -> None:
    if at > end:
        raise ValueError("the data end too early")


# --- indices


class _Reader:
    """Reads numbers of variable length, and indices that are stored as differences to the previous index."""

    def __init__(self, data: bytes, at: int) -> None:
        self.data, self.at, self.last = data, at, 0

    def number(self) -> int:
        """Unsigned LEB128 of at most five bytes."""
        value = 0
        for shift in range(0, 35, 7):
            byte = self.data[self.at]
            self.at += 1
            value |= (byte & 127) << shift
            if byte < 128:
                return value & 0xFFFFFFFF
        raise ValueError("a number of more than five bytes")

    def skip_name(self) -> None:
        """Skip a text. The byte in front of it is its length."""
        self.at += 1 + self.data[self.at]

    def index(self) -> int:
        """Read an index that is stored as the difference to the previous index of this kind."""
        value = self.number()
        self.last = (self.last + _signed(value)) & 0xFFFFFFFF
        return self.last


def _signed(value: int) -> int:
    return ~(value >> 1) if value & 1 else value >> 1


def _indices(data: bytes, count: int) -> list[int]:
    if data[0] != 0xD1:
        raise ValueError(f"indices with header {data[0]:#x}")
    reader, last, out = _Reader(data[: len(data) - 4], 1), [0, 0], []
    for _ in range(count):
        value = reader.number()
        last[value & 1] = (last[value & 1] + _signed(value >> 1)) & 0xFFFFFFFF
        out.append(last[value & 1])
    if reader.at != len(reader.data):
        raise ValueError(f"{len(reader.data) - reader.at} bytes too many")
    return out


def _triangles(data: bytes, count: int) -> list[int]:
    if data[0] != 0xE1:
        raise ValueError(f"triangles with header {data[0]:#x}")
    if count % 3 or len(data) < 17 + count // 3:
        raise ValueError(f"{len(data)} bytes for {count} indices")
    table, reader = data[-16:], _Reader(data[:-16], 1 + count // 3)
    # the last 16 edges and vertices, newest last; entries that were not written are 0
    edges: list[tuple[int, int]] = [(0, 0)] * 16
    recent: list[int] = [0] * 16
    out: list[int] = []
    following = 0
    for code in data[1 : 1 + count // 3]:
        high, low = code >> 4, code & 15
        if high < 15:
            a, b = edges[-1 - high]
            if low == 0:
                c, following = following, following + 1
            elif low < 13:
                c = recent[-1 - low]
            elif low < 15:
                c = reader.last = (reader.last + (1 if low == 14 else -1)) & 0xFFFFFFFF
            else:
                c = reader.index()
            new = [] if 0 < low < 13 else [c]
            edges = [*edges[2:], (c, b), (a, c)]
        else:
            pair = table[low] if low < 14 else reader.data[reader.at]
            reader.at += low >= 14
            if low >= 14 and pair == 0:
                following = 0
            codes = (15 if low == 15 else 0, pair >> 4, pair & 15)
            if low < 14 and 15 in codes:
                raise ValueError("a wrong table of triangle codes")
            corners, new = [], []
            for number in codes:
                if number == 0:
                    corner, following = following, following + 1
                elif number < 15:
                    corner = recent[-number]
                else:
                    corner = reader.index()
                corners.append(corner)
                if number in (0, 15):
                    new.append(corner)
            a, b, c = corners
            edges = [*edges[3:], (b, a), (c, b), (a, c)]
        if new:
            recent = recent[len(new) :] + new
        out += (a, b, c)
    if reader.at != len(reader.data):
        raise ValueError(f"{len(reader.data) - reader.at} bytes too many")
    return [value & 0xFFFFFFFF for value in out]


# --- filters


def _octahedral(elements: Bytes) -> Bytes:
    """Unit vectors (N, 4) from two coordinates on an octahedron."""
    values, largest = _components(elements, "OCTAHEDRAL")
    one = np.where(values[:, 2] == 0, 1.0, values[:, 2])
    x, y = values[:, 0] / one, values[:, 1] / one
    z = 1.0 - np.abs(x) - np.abs(y)
    fold = np.minimum(z, 0.0)
    x, y = x - np.copysign(fold, x), y - np.copysign(fold, y)
    unit = np.stack([x, y, z], axis=1)
    length = np.linalg.norm(unit, axis=1, keepdims=True)
    values[:, :3] = _rounded(unit / np.where(length == 0, 1.0, length) * largest)
    return _stored(values, f"<i{elements.shape[1] // 4}")


def _quaternion(elements: Bytes) -> Bytes:
    """Unit quaternions (N, 4) from three components and the number of the largest."""
    if elements.shape[1] != 8:
        raise ValueError("filter QUATERNION needs elements of 8 bytes")
    values: NDArray[np.int64] = np.ascontiguousarray(elements).view("<i2").astype(np.int64)
    xyz = values[:, :3] / (values[:, 3:] | 3) * np.sqrt(0.5)
    w = np.sqrt(np.maximum(0.0, 1.0 - (xyz**2).sum(axis=1)))
    places: NDArray[np.int64] = (values[:, 3:] + np.array([1, 2, 3, 0])) % 4
    out = np.empty(values.shape)
    np.put_along_axis(out, places, _rounded(np.c_[xyz, w] * 32767.0), axis=1)
    return _stored(out, "<i2")


def _exponential(elements: Bytes) -> Bytes:
    """Floats, each from an integer with an exponent (8 bits) and a mantissa (24 bits)."""
    values = np.ascontiguousarray(elements).view("<i4")
    with np.errstate(over="ignore"):  # infinities are refused later, where the floats are read
        floats = np.ldexp(((values << 8) >> 8).astype(np.float64), values >> 24).astype("<f4")
    return floats.view(np.uint8).reshape(-1)


def _color(elements: Bytes) -> Bytes:
    """Colours (N, 4) from luma, chroma and alpha. The highest bit of alpha gives the number of bits."""
    signed, _ = _components(elements, "COLOR")
    bits = 2 * elements.shape[1]
    unsigned: NDArray[np.int64] = np.where(signed < 0, signed + (1 << bits), signed).astype(np.int64)
    y, alpha = unsigned[:, 0], unsigned[:, 3]
    orange, green = signed[:, 1], signed[:, 2]
    # number of bits of alpha
    top: NDArray[np.int64] = np.frexp(np.maximum(alpha, 1).astype(float))[1].astype(np.int64)
    scale = (np.int64(1) << top) - 1
    alpha = alpha & (scale >> 1)
    alpha = alpha << 1 | alpha & 1
    colors = np.stack([y + orange - green, y + green, y - orange - green, alpha], axis=1)
    largest = (1 << bits) - 1
    out = _rounded(colors * (largest / scale)[:, None])
    return _stored(np.clip(out, 0, largest), f"<u{bits // 8}")


def _components(elements: Bytes, name: str) -> tuple[NDArray[np.float64], int]:
    """Convert signed integer components (N, 4) to floats. Returns also the largest possible component."""
    width = elements.shape[1] // 4
    if width not in (1, 2):
        raise ValueError(f"filter {name} needs elements of 4 or 8 bytes")
    values = np.ascontiguousarray(elements).view(f"<i{width}").astype(np.float64)
    return values, (1 << (8 * width - 1)) - 1


def _rounded(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Round to the nearest integer. Halves are rounded away from zero."""
    return np.asarray(np.copysign(np.floor(np.abs(values) + 0.5), values))


def _stored(values: NDArray[Any], dtype: str) -> Bytes:
    info = np.iinfo(dtype)
    return np.clip(values, info.min, info.max).astype(dtype).view(np.uint8).reshape(-1)


_FILTERS: dict[str, Callable[[Bytes], Bytes]] = {
    "NONE": np.ravel,
    "OCTAHEDRAL": _octahedral,
    "QUATERNION": _quaternion,
    "EXPONENTIAL": _exponential,
    "COLOR": _color,
}


DRACO = "KHR_draco_mesh_compression"
#: Magic bytes, version, kind, method and flags.
_DRACO_START, _DRACO_METADATA = "<5s4BH", 0x8000
#: Largest size of all decoded buffer views in bytes, and most elements of a view with indices.
MAX_DECODED, _MAX_INDICES = 1 << 29, 30_000_000
#: Most triangles or points in the Draco data of a file, since a few hundred bytes can declare any number.
MAX_DRACO = 5_000_000


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
        count = _draco_count(data)
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


def _draco_count(data: bytes) -> int:
    """Number of triangles or points in Draco data, whichever is larger. Raises MeshError unless the data have
    version 2.2, which glTF files have [Draco bitstream]."""
    try:
        magic, major, minor, kind, method, flags = struct.unpack_from(_DRACO_START, data)
        if (magic, major, minor, kind) != (b"DRACO", 2, 2, 1) or method > 1:
            raise MeshError("the Draco data are not a mesh of version 2.2: export it again")
        reader = _Reader(data, struct.calcsize(_DRACO_START))
        if flags & _DRACO_METADATA:
            for _ in range(reader.number()):
                reader.number()
                _skip_metadata(reader)
            _skip_metadata(reader)
        reader.at += method  # the kind of the traversal
        return max(reader.number(), reader.number())
    except (struct.error, IndexError, RecursionError, ValueError):
        raise MeshError("the header of the Draco data is damaged") from None


def _skip_metadata(reader: _Reader) -> None:
    """Skip entries with a name and a value, then groups of further entries with a name."""
    for _ in range(reader.number()):
        reader.skip_name()
        length = reader.number()
        reader.at += length
    for _ in range(reader.number()):
        reader.skip_name()
        _skip_metadata(reader)


def decode_meshopt(view: MeshoptView, data: bytes) -> bytes:
    """Decode the data of a meshopt buffer view. Raises MeshError if the data do not fit the format."""
    stride, is_index = view.byteStride, view.mode != "ATTRIBUTES"
    if is_index and view.count > _MAX_INDICES:
        raise MeshError(f"{view.count} indices; at most {_MAX_INDICES} are read")
    try:
        if not is_index:
            if stride % 4:
                raise ValueError(f"elements of {stride} bytes")
            return _FILTERS[view.filter](_attributes(data, view.count, stride)).tobytes()
        if stride not in (2, 4) or view.filter != "NONE":
            raise ValueError(f"indices of {stride} bytes with filter {view.filter}")
        decoder = _triangles if view.mode == "TRIANGLES" else _indices
        return np.array(decoder(data, view.count), np.uint32).astype(f"<u{stride}").tobytes()
    except IndexError:
        raise MeshError("the meshopt data end too early") from None
    except ValueError as reason:
        raise MeshError(f"the meshopt data cannot be decoded: {reason}") from None
