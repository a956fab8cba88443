"""Arrays in untrusted files: NumPy archives (.npz), and pickles.

A pickle is a program. Its opcodes are interpreted here. A name in a pickle can only select a function of this
module, which makes a plain value from bytes. The unpickler of Python is not used, since it imports what a
file names, and allocates as much memory as the file demands. Pickles of Python 2 and 3, .npy files of
objects, and files of joblib and PyTorch are read.
"""

from __future__ import annotations

import io
import os
import pickletools
import re
import warnings
import zipfile
import zlib
from collections.abc import Callable, Collection, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import HumansimError
from humansim_ros.files.reading.files import atomic_path, read_bytes

#: Largest file, and largest total size of its arrays, bytes.
MAX_BYTES = 1 << 30
#: Exceptions that a damaged, an encrypted or an unusual ZIP archive raises.
ARCHIVE_ERRORS = (ValueError, OSError, EOFError, KeyError, RuntimeError, zipfile.BadZipFile, zlib.error)
#: Kinds of arrays that are read: booleans, integers, floats and texts.
_KINDS = "biufUS"


def read_npz(
    path: str | os.PathLike[str],
    error: type[HumansimError],
    what: str,
    names: Collection[str] | None = None,
    most: int | None = None,
) -> dict[str, NDArray[Any]]:
    """Read the arrays of an archive.

    Args:
        path: File to read.
        error: Error class to raise.
        what: Kind of file for messages, such as ``human``.
        names: Arrays to read. If None, all. Other arrays are not unpacked.
        most: Largest size of the file, and of all its arrays together, in bytes. If None, MAX_BYTES.

    Returns:
        Arrays by name.

    Raises:
        HumansimError: ``error`` with file and array, if the file is not an archive, is damaged, has pickled
            objects, or is larger than ``most``.
    """
    most = MAX_BYTES if most is None else most
    data = read_bytes(path, error, what, most)
    if not data.startswith(b"PK"):
        raise error(f"not a {what} file: it is not an .npz archive", path=path)
    arrays: dict[str, NDArray[Any]] = {}
    room = most
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            for entry in archive.infolist():
                name = entry.filename.removesuffix(".npy")
                if name == entry.filename or (names is not None and name not in names):
                    continue
                if entry.file_size > room:
                    raise error(f"it unpacks to more than {most >> 20} MB", path=path, key=name)
                room -= entry.file_size
                with archive.open(entry) as member:
                    content = member.read(entry.file_size + 1)
                try:
                    arrays[name] = npy_array(content)
                except ValueError as reason:
                    raise error(str(reason), path=path, key=name) from None
    except ARCHIVE_ERRORS as reason:
        raise error(f"not a {what} file, or a damaged one: {reason}", path=path) from None
    return arrays


def archive_names(data: bytes) -> list[str]:
    """Names of the files of a ZIP archive. Empty for other content, and for a damaged archive."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            return archive.namelist()
    except ARCHIVE_ERRORS:
        return []


def npy_header(stream: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, order (whether columns come first) and type from the start of a .npy file. ValueError if the
    header is wrong."""
    version = np.lib.format.read_magic(stream)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"array file version {version} is not supported")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # a header of Python 2
            shape, fortran, dtype = readers[version](stream)
    except Exception as reason:  # the parsers raise all kinds of exceptions
        raise ValueError(f"a damaged header: {str(reason)[:60]}") from None
    return shape, fortran, dtype


def npy_array(content: bytes) -> NDArray[Any]:
    """Array of a .npy file. It contains no objects. Raises ValueError if the file is wrong or incomplete."""
    stream = io.BytesIO(content)
    shape, fortran, dtype = npy_header(stream)
    if dtype.hasobject:
        raise ValueError("a pickled object; pickled objects are not read, because they can run code")
    if dtype.kind not in _KINDS or dtype.subdtype is not None:
        raise ValueError(f"an array of {str(dtype)[:60]}; numbers and texts are read")
    count = 1
    for length in shape:
        count *= int(length)
    start = stream.tell()
    if dtype.itemsize == 0 or count < 0 or count * dtype.itemsize != len(content) - start:
        raise ValueError(f"the file does not have the {count} values of its header")
    values = np.frombuffer(content, dtype, count, start)
    return values.reshape(shape[::-1]).T if fortran else values.reshape(shape)


#: Highest level of compression.
BEST = 9


def write_npz(path: str | os.PathLike[str], arrays: Mapping[str, NDArray[Any]], level: int = BEST) -> None:
    """Write arrays atomically. Equal arrays give equal bytes. Encoded images are not compressed again.
    ``level``: level of compression, 1 to 9."""
    with atomic_path(Path(path)) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        _write(archive, arrays, level)


def npz_bytes(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Content of an archive of arrays. Equal arrays give equal bytes."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        _write(archive, arrays)
    return content.getvalue()


def _write(archive: zipfile.ZipFile, arrays: Mapping[str, NDArray[Any]], level: int = BEST) -> None:
    for name, array in arrays.items():
        data = io.BytesIO()
        np.lib.format.write_array(data, np.asarray(array), allow_pickle=False)
        entry = zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0))
        compressed = array.dtype == np.uint8 and array.ndim == 1
        entry.compress_type = zipfile.ZIP_STORED if compressed else zipfile.ZIP_DEFLATED
        archive.writestr(entry, data.getvalue(), compresslevel=None if compressed else level)


#: Most bytes that the values of a file may need in addition to the file itself; bytes that each opcode counts
#: as; most nested levels.
_ROOM, _COST, _MAX_DEPTH = 1 << 29, 80, 30
#: First number of a file that PyTorch wrote before it used archives.
_OLD_TORCH = 0x1950A86A20F9469CFC6C
#: Types of the numbers of PyTorch.
_TYPES = "Half:<f2 Float:<f4 Double:<f8 Char:i1 Short:<i2 Int:<i4 Long:<i8 Byte:u1 Bool:?"
_STORAGES = {f"torch.{name}Storage": np.dtype(code) for name, code in (t.split(":") for t in _TYPES.split())}
_BUILTIN_MODULES = ("builtins", "__builtin__")
_BUILTINS: tuple[tuple[str, Callable[..., Any]], ...] = (
    *((kind, lambda items=(): items) for kind in ("list", "set", "frozenset")),
    ("dict", lambda *_: {}),
    ("bytes", lambda *_: b""),
)


class _RefusedError(Exception):
    """A pickle asks for something that is not supported."""


class _Made:
    """A value that gets its content later: by ``build``, or by ``finish`` when the file has been read."""

    def __init__(self, build: Callable[[Any], Any], finish: Callable[[], Any] | None = None) -> None:
        self.value: Any = None
        self._build, self.finish = build, finish

    def build(self, state: Any) -> _Made:
        self.value = self._build(state)
        return self


class _DType(_Made):
    """Type of an array: NumPy's code, such as ``f8``, and byte order."""

    def __init__(self, code: Any, *_: Any) -> None:
        super().__init__(lambda state: state[1].replace("|", "=") if state[2:5] == [None] * 3 else "records")
        self.code, self.value = code, "="

    def array(self, data: bytes, shape: Any, order: str = "C") -> NDArray[Any]:
        if not re.fullmatch(r"[<>=][biufSU]\d{1,4}", f"{self.value}{self.code}"):
            raise _RefusedError("the pickle has an array of objects or records")
        values = np.frombuffer(data, np.dtype(self.value + self.code))
        return values.reshape(shape, order="F" if order == "F" else "C")


class _Machine:
    """Interpreter of the pickles in a stream, one after another. ``room``: list with one number, the bytes
    that values may still need. ``load``: function that returns the bytes of an array of PyTorch (a storage)
    in an archive."""

    def __init__(self, data: bytes, room: list[int], load: Callable[[str], bytes] | None = None) -> None:
        self.stream, self.room, self.load = io.BytesIO(data), room, load
        self.storages: dict[str, _Made] = {}
        #: Functions by their names in pickles. A name with None cannot be called.
        self.makers: Mapping[str, Callable[..., Any] | None] = {
            "numpy.ndarray": None,
            "numpy.dtype": _DType,
            "numpy.core.multiarray._reconstruct": lambda *_: _Made(self._array),
            "numpy.core.multiarray.scalar": lambda dtype, data: dtype.array(self._bytes(data), ()).item(),
            "numpy.core.numeric._frombuffer": lambda data, dtype, *shape: dtype.array(data, *shape),
            "joblib.numpy_pickle.NumpyArrayWrapper": lambda: _Made(self._array_in_stream),
            "torch._utils._rebuild_tensor": lambda *parts: _Made(tuple, lambda: self._tensor(*parts[:4])),
            "torch._utils._rebuild_tensor_v2": lambda *parts: _Made(tuple, lambda: self._tensor(*parts[:4])),
            "torch.storage._load_from_bytes": lambda data: _Machine(self._bytes(data), room).all(),
            "torch.Size": lambda items: items,
            "_codecs.encode": lambda text, _: self._bytes(text),
            "collections.OrderedDict": lambda pairs=(): self._put({}, [*chain.from_iterable(pairs)]),
            "collections.defaultdict": lambda *_: {},
            **{f"{module}.{kind}": make for module in _BUILTIN_MODULES for kind, make in _BUILTINS},
            **dict.fromkeys(_STORAGES),
        }
        #: Functions by opcode. Each takes what the opcode pops from the stack, and returns what the opcode
        #: pushes. Opcodes that are not listed push their argument.
        self.steps: Mapping[str, Callable[..., Any]] = {
            "NEWTRUE": lambda: True,
            "NEWFALSE": lambda: False,
            **{name: lambda *items: [*items] for name in ("EMPTY_LIST", "EMPTY_SET", "EMPTY_TUPLE")},
            **{f"TUPLE{size}": lambda *items: [*items] for size in (1, 2, 3)},
            **{name: lambda items: items for name in ("TUPLE", "LIST", "FROZENSET")},
            **{name: lambda items=(): self._put({}, items) for name in ("EMPTY_DICT", "DICT")},
            **{name: lambda known, items: list.__iadd__(known, items) for name in ("APPENDS", "ADDITEMS")},
            "APPEND": lambda known, item: list.__iadd__(known, [item]),
            "SETITEM": lambda known, key, value: self._put(known, [key, value]),
            "SETITEMS": self._put,
            "GLOBAL": self._named,
            "INST": self._named,
            "STACK_GLOBAL": self._named,
            "REDUCE": self._called,
            "NEWOBJ": self._called,
            # the state of an OrderedDict of PyTorch is ignored
            "BUILD": lambda made, state: made if isinstance(made, dict) else made.build(state),
            "BINPERSID": self._storage,
        }

    def take(self, size: int) -> None:
        """Count ``size`` bytes of memory. Raises ValueError if the values of the file need too many."""
        self.room[0] -= size
        if self.room[0] < 0:
            raise ValueError

    def all(self) -> Any:
        """Content of the stream: its first pickle, or the object of an old file of PyTorch."""
        if (found := self.next()) == _OLD_TORCH:
            _, _, found, names = (self.next() for _ in range(4))
            for storage in (self.storages[name] for name in names):
                size = int.from_bytes(self.stream.read(8), "little") * storage.value.itemsize
                self.take(min(size, len(self.stream.getbuffer())))
                storage.value = np.frombuffer(self.stream.read(size), storage.value)
        return found

    def next(self) -> Any:
        """Value that the next pickle of the stream makes."""
        stack: list[Any] = []
        outer: list[list[Any]] = []
        memo: dict[Any, Any] = {}
        for count, (opcode, argument, _) in enumerate(pickletools.genops(self.stream)):
            if not count % 100:
                self.take(100 * _COST)
            name = opcode.name
            popped: list[Any] = []
            for kind in reversed(opcode.stack_before):
                if kind is pickletools.stackslice:
                    popped, stack = [stack, *popped], outer.pop()
                elif kind is not pickletools.markobject:
                    popped.insert(0, stack.pop())
            if (step := self.steps.get(name)) is not None:
                is_text = name in ("GLOBAL", "INST")
                stack.append(step(*(str(argument).split(" ", 1) if is_text else popped)))
            elif name == "STOP":
                return popped[0]
            elif name == "MARK":
                outer.append(stack)
                stack = []
            elif name == "MEMOIZE" or name.endswith("PUT"):
                stack += popped
                memo[len(memo) if argument is None else argument] = stack[-1]
            elif opcode.stack_after:
                stack.append(memo[argument] if name.endswith("GET") else argument)
        raise ValueError

    def plain(self, value: Any, depth: int = 0) -> Any:
        """Convert a value to arrays, numbers, texts, lists and dictionaries. Other values become None."""
        self.take(5 * _COST)
        if depth > _MAX_DEPTH:
            raise ValueError
        if isinstance(value, _Made):
            value = value.value if value.finish is None else value.finish()
        if isinstance(value, dict):
            return {key: self.plain(part, depth + 1) for key, part in value.items()}
        if isinstance(value, list):
            return [self.plain(part, depth + 1) for part in value]
        return value if isinstance(value, (np.ndarray, int, float, str, bytes)) else None

    def _bytes(self, data: Any) -> Any:
        if not isinstance(data, str):
            return data
        self.take(len(data))
        return data.encode("latin-1")  # bytes of Python 2

    def _put(self, target: Any, items: Any) -> Any:
        self.take(_COST * len(items))
        for key, value in zip(items[::2], items[1::2], strict=True):
            # other keys may be slow to compare
            if not isinstance(key, (str, bytes)) and not abs(key) < 1 << 31:
                raise ValueError
            dict.__setitem__(target, key.decode("latin-1") if isinstance(key, bytes) else key, value)
        return target

    def _named(self, module: Any, attribute: Any) -> tuple[str]:
        name = f"{module}.{attribute}".replace("numpy._core.", "numpy.core.")
        if name not in self.makers:
            shown = repr(name) if re.fullmatch(r"[\w.]{1,100}", name) else "something"
            raise _RefusedError(f"the pickle asks for {shown}")
        return (name,)  # only a name is a tuple

    def _called(self, name: Any, arguments: Any) -> Any:
        maker = self.makers[name[0]] if isinstance(name, tuple) else None
        if maker is None:
            raise _RefusedError("the pickle calls what makes no array")
        return maker(*arguments)

    def _array(self, state: Any) -> Any:
        shape, dtype, is_fortran, data = state[-4:]
        if isinstance(data, list) and str(dtype.code).startswith("O"):
            return data
        return dtype.array(self._bytes(data), shape, "CF"[bool(is_fortran)])

    def _array_in_stream(self, state: Any) -> NDArray[Any]:
        if state.get("numpy_array_alignment_bytes") is not None:
            self.stream.read(self.stream.read(1)[0])
        dtype, shape = state["dtype"], state["shape"]
        size = int(np.prod(shape, dtype=float)) * dtype.array(b"", (0,)).itemsize
        return np.asarray(dtype.array(self.stream.read(size), shape, state["order"]))

    def _storage(self, identity: Any) -> _Made:
        _, (numbers,), name, *_ = identity
        if name not in self.storages:
            storage = self.storages[name] = _Made(tuple)
            storage.value = _STORAGES[numbers]
            if self.load is not None:
                storage.value = np.frombuffer(self.load(str(name)), storage.value)
        return self.storages[name]

    def _tensor(self, storage: _Made, start: int, shape: list[int], steps: list[int]) -> NDArray[Any]:
        data, count = storage.value, int(np.prod(shape, dtype=float))
        self.take(8 * count)
        last = start + sum((size - 1) * step for size, step in zip(shape, steps, strict=True))
        if min(start, *shape, *steps, 0) < 0 or (count and last >= len(data)):
            raise ValueError
        steps = [step * data.itemsize for step in steps]
        return np.lib.stride_tricks.as_strided(data[start:], shape, steps, writeable=False)


def _content(data: bytes) -> Any:
    load, is_scalar = None, False
    if data[:1] in (b"\x1f", b"\x78"):  # joblib compresses
        unpacker = zlib.decompressobj(47)
        data = unpacker.decompress(data, MAX_BYTES)
        if not unpacker.eof:
            raise ValueError
    if data.startswith(b"\x93NUMPY"):
        stream = io.BytesIO(data)
        shape, _, dtype = npy_header(stream)
        is_scalar = not shape
        if not dtype.hasobject:
            return npy_array(data)
        data = stream.read()
    if data.startswith(b"PK"):
        archive = zipfile.ZipFile(io.BytesIO(data))
        (main,) = (name for name in archive.namelist() if name.endswith("/data.pkl"))
        if sum(entry.file_size for entry in archive.infolist()) > MAX_BYTES:
            raise ValueError
        data, load = archive.read(main), lambda name: archive.read(f"{main.removesuffix('.pkl')}/{name}")
    machine = _Machine(data, [_ROOM], load)
    found = machine.plain(machine.all())
    return found[0] if is_scalar else found


def read_pickle(path: str | os.PathLike[str], error: type[HumansimError], what: str) -> Any:
    """Read a pickle of Python, NumPy, joblib or PyTorch as arrays, numbers, texts, lists and dictionaries.
    ``what``: kind of file for messages. Raises ``error`` if the file is no pickle, is damaged or too large,
    or has other values. The message has the name of such a value."""
    data = read_bytes(path, error, what, MAX_BYTES)
    try:
        return _content(data)
    except _RefusedError as reason:
        hint = (
            "Pickles can run code, so only arrays, numbers, texts and containers are read: write the arrays"
        )
        how = "to an archive instead, with numpy.savez('motion.npz', poses=..., trans=...)"
        raise error(f"{reason}. {hint} {how}", path=path) from None
    # damaged opcodes raise all kinds of exceptions; their messages would show content of the file
    except Exception:
        raise error(f"not a {what} that can be read: no pickle, or a damaged one", path=path) from None
