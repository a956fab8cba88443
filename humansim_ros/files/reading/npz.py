"""NumPy archives (.npz): arrays only, never pickled objects, with a size limit."""

from __future__ import annotations

import io
import os
import warnings
import zipfile
import zlib
from collections.abc import Collection, Mapping
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
