"""Archives of arrays whose headers are damaged, or whose arrays are of other kinds."""

from __future__ import annotations

import struct
import tracemalloc
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from humansim_ros.errors import MeshError
from humansim_ros.files.reading.arrays import MAX_BYTES, read_npz


def archive(path: Path, header: bytes) -> Path:
    """Archive with one array of this header and eight bytes."""
    data = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + bytes(8)
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("numbers.npy", data)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(MeshError) as caught:
        read_npz(path, MeshError, "human")
    assert (caught.value.path, caught.value.key) == (str(path), "numbers")
    return caught.value.message


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "header",
    [
        *(
            b"{'descr': '<f8', 'fortran_order': False, 'shape': (1L,",
            b"'",
            b"{",
            b"(" * 3000,
            b"\xff\xfe",
            b"",
        ),
        *(b"{'descr': '<f8', 'fortran_order': 1, 'shape': (1,)}", b"[1]", b"{[]: 1}", b"{'descr': '<f8'}"),
        b"{'descr': ['<f8'], 'fortran_order': False, 'shape': (1,)}",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1L,)}",
    ],
)
def test_a_damaged_header_is_an_error_with_the_array(tmp_path: Path, header: bytes) -> None:
    """Also if the parser of headers raises a TokenError, a SyntaxError or a RecursionError."""
    assert refusal(archive(tmp_path / "damaged.npz", header))


@pytest.mark.parametrize(
    "array",
    [
        np.zeros(3, complex),
        np.zeros(3, [("x", "f8"), ("y", "i4")]),
        np.zeros(3, "M8[s]"),
        np.zeros(3, "m8[s]"),
        np.zeros(3, "V16"),
    ],
    ids=lambda array: str(array.dtype),
)
def test_arrays_that_are_neither_numbers_nor_texts_are_refused(
    tmp_path: Path, array: NDArray[np.generic]
) -> None:
    np.savez(tmp_path / "kinds.npz", numbers=array)
    assert "numbers and texts are read" in refusal(tmp_path / "kinds.npz")


def test_an_archive_that_unpacks_to_more_than_the_limit_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file, file.open("numbers.npy", "w") as member:
        member.write(bytes(1 << 20))
    data = path.read_bytes().replace(struct.pack("<I", 1 << 20), struct.pack("<I", MAX_BYTES + 1))
    path.write_bytes(data)
    tracemalloc.start()
    assert refusal(path) == "it unpacks to more than 1024 MB"
    used = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert used < 1 << 20
