"""Build binary glTF files: a JSON document and its buffer [glTF 2.0]."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Component types by dtype, and types by the shape of a value.
_TYPES = {
    np.dtype(np.uint8): 5121,
    np.dtype(np.uint16): 5123,
    np.dtype(np.uint32): 5125,
    np.dtype(np.float32): 5126,
}
_SHAPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class GlbBuilder:
    """Lists of a glTF document, such as its nodes, and the buffer with its arrays."""

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
            accessor |= {
                "min": np.atleast_1d(values.min(0)).tolist(),
                "max": np.atleast_1d(values.max(0)).tolist(),
            }
        return self.add("accessors", accessor)

    def view(self, data: bytes, target: int | None = None) -> int:
        """Add bytes to the buffer. Returns the number of their view."""
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
