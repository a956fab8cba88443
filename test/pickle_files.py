"""Write pickles as joblib, NumPy and PyTorch write them, by the layouts of their files."""

from __future__ import annotations

import io
import pickle
import struct
import sys
import zipfile
from collections import OrderedDict
from typing import Any

import numpy as np


class NumpyArrayWrapper:
    """As joblib's: its state comes before the bytes of the array."""

    def __init__(self, array: np.ndarray, alignment: int | None) -> None:
        self.subclass, self.shape, self.dtype, self.order = np.ndarray, array.shape, array.dtype, "C"
        self.allow_mmap, self.numpy_array_alignment_bytes = True, alignment


NumpyArrayWrapper.__module__ = "joblib.numpy_pickle"


def joblib_bytes(tree: Any, protocol: int = 4, alignment: int | None = 16) -> bytes:
    """As ``joblib.dump`` writes it: arrays are behind their wrappers in the stream."""

    class Pickler(pickle._Pickler):  # type: ignore[name-defined]
        def save(self, value: Any, save_persistent_id: bool = True) -> None:
            if not isinstance(value, np.ndarray):
                return super().save(value, save_persistent_id)
            super().save(NumpyArrayWrapper(value, alignment))
            self.framer.commit_frame(force=True)
            if alignment is not None:
                padding = alignment - (out.tell() + 1) % alignment
                out.write(bytes([padding]) + b"\xff" * padding)
            out.write(np.ascontiguousarray(value).tobytes())
            return None

    out = io.BytesIO()
    sys.modules["joblib"] = sys.modules["joblib.numpy_pickle"] = sys.modules[__name__]
    try:
        Pickler(out, protocol).dump(tree)
    finally:
        del sys.modules["joblib"], sys.modules["joblib.numpy_pickle"]
    return out.getvalue()


class Call:
    """What a pickle calls with arguments when it is loaded."""

    def __init__(self, name: str, *arguments: Any) -> None:
        self.name, self.arguments = name, arguments


class FloatStorage:
    """Numbers of a tensor."""

    def __init__(self, data: np.ndarray) -> None:
        self.data = np.ascontiguousarray(data, dtype="<f4")


class Objects:
    """A NumPy array without axes, of one object."""

    def __init__(self, item: Any) -> None:
        self.item = item


def torch_pickle(tree: Any, storages: dict[str, np.ndarray], nested: bool = False) -> bytes:
    """Pickle of a tree of arrays as PyTorch writes tensors; ``nested``: as ``numpy.save`` writes them."""

    class Pickler(pickle._Pickler):  # type: ignore[name-defined]
        def persistent_id(self, value: Any) -> Any:
            if not isinstance(value, FloatStorage) or nested:
                return None
            key = str(len(storages))
            storages[key] = value.data
            return ("storage", Call("torch.FloatStorage"), key, "cpu", value.data.size)

        def save(self, value: Any, save_persistent_id: bool = True) -> None:
            if isinstance(value, Call):
                module, _, name = value.name.rpartition(".")
                self.write(pickle.GLOBAL + f"{module}\n{name}\n".encode())
                if value.arguments:
                    self.save(value.arguments)
                    self.write(pickle.REDUCE)
            elif isinstance(value, FloatStorage) and nested:
                self.save(Call("torch.storage._load_from_bytes", old_torch(value)))
            elif isinstance(value, Objects):
                self.save(Call("numpy.core.multiarray._reconstruct", np.ndarray, (0,), b"b"))
                self.save((1, (), np.dtype("O"), False, [value.item]))
                self.write(pickle.BUILD)
            elif isinstance(value, np.ndarray):
                steps = tuple(np.array(value.strides) // value.itemsize)
                base = value if value.flags["C_CONTIGUOUS"] else value.base
                offset = (value.ctypes.data - base.ctypes.data) // value.itemsize
                parts = (
                    FloatStorage(base.ravel()),
                    offset,
                    value.shape,
                    tuple(map(int, steps)),
                    False,
                    OrderedDict(),
                )
                self.save(Call("torch._utils._rebuild_tensor_v2", *parts))
            else:
                super().save(value, save_persistent_id)

    out = io.BytesIO()
    Pickler(out, 2).dump(tree)
    return out.getvalue()


def old_torch(tree: Any) -> bytes:
    """As PyTorch before 1.6: five pickles, and then the numbers of the storages."""
    storages: dict[str, np.ndarray] = {}
    body = torch_pickle(tree, storages)
    head = [pickle.dumps(part, 2) for part in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True})]
    keys = pickle.dumps(list(storages), 2)
    data = b"".join(struct.pack("<q", part.size) + part.tobytes() for part in storages.values())
    return b"".join(head) + body + keys + data


def torch_archive(tree: Any) -> bytes:
    """As ``torch.save``."""
    storages: dict[str, np.ndarray] = {}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        archive.writestr("hmr4d_results/data.pkl", torch_pickle(tree, storages))
        archive.writestr("hmr4d_results/byteorder", "little")
        for key, data in storages.items():
            archive.writestr(f"hmr4d_results/data/{key}", data.tobytes())
        archive.writestr("hmr4d_results/version", "3\n")
    return out.getvalue()


def objects_npy(tree: bytes) -> bytes:
    """As ``numpy.save`` of a dictionary: the header of an array of objects, and a pickle of a list."""
    out = io.BytesIO()
    np.lib.format.write_array_header_1_0(out, {"descr": "|O", "fortran_order": False, "shape": ()})
    return out.getvalue() + tree


def zipfile_of(members: dict[str, bytes]) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return out.getvalue()
