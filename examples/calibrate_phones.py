"""Calibrate phones with a chessboard: lenses from pictures of it, poses from one of it on the floor.

The pictures of each phone are in a folder with its name:

    phones/anna/board/*.jpg     the board held before the phone: 12 pictures or more, leant to all sides
    phones/anna/floor.jpg       the board on the floor; it lies at the same place for all phones

    python calibrate_phones.py phones --columns 12 --rows 9 --square 0.06 -o calibration.toml

Columns and rows count squares; the one is even and the other odd, so that the board has a top. The origin of
the world is the corner between the first four squares, on the floor; z points up.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np

from humansim_ros import Camera, write_calibration

#: Least number of pictures in which the board is found.
LEAST = 8
#: Suffixes of pictures.
PICTURES = (".jpg", ".jpeg", ".png")


def find_corners(path: Path, columns: int, rows: int) -> tuple[np.ndarray | None, tuple[int, int]]:
    """Inner corners (N, 2) row by row, None without a board; and the size of the picture."""
    gray = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if gray is None:
        sys.exit(f"{path}: this is not a picture")
    size = (gray.shape[1], gray.shape[0])
    found, corners = cv2.findChessboardCornersSB(gray, (columns - 1, rows - 1))
    if not found:
        return None, size
    corners = corners.reshape(rows - 1, columns - 1, 2)
    # the square before the first corner is black: otherwise the list begins at the other end
    first = corners[0, 0] - (corners[1, 1] - corners[0, 0]) / 2
    last = corners[-1, -1] + (corners[-1, -1] - corners[-2, -2]) / 2
    brightness = [cv2.getRectSubPix(gray, (5, 5), tuple(map(float, place))).mean() for place in (first, last)]
    if brightness[0] > brightness[1]:
        corners = corners[::-1, ::-1]
    return np.ascontiguousarray(corners.reshape(-1, 2), dtype=np.float32), size


def calibrate(folder: Path, columns: int, rows: int, square: float) -> Camera:
    """Camera of one phone, with its lens, and its pose by the board on the floor."""
    y, x = np.mgrid[: rows - 1, : columns - 1]
    # y points up in the print, so that z points up on the floor
    board = np.column_stack([x.ravel(), -y.ravel(), np.zeros(x.size)]).astype(np.float32) * square
    seen, size = [], None
    for path in sorted(path for path in (folder / "board").iterdir() if path.suffix.lower() in PICTURES):
        corners, own = find_corners(path, columns, rows)
        if size not in (None, own):
            sys.exit(f"{path}: another size than the pictures before; do not turn or zoom the phone")
        size = own
        if corners is not None:
            seen.append(corners)
    if len(seen) < LEAST:
        sys.exit(f"{folder / 'board'}: the board is found in {len(seen)} pictures; {LEAST} are needed")
    error, matrix, lens, _, _ = cv2.calibrateCamera(
        [board] * len(seen), seen, size, None, None, flags=cv2.CALIB_FIX_K3
    )
    corners, own = find_corners(folder / "floor.jpg", columns, rows)
    if corners is None or own != size:
        sys.exit(f"{folder / 'floor.jpg'}: the board is not found, or the picture has another size")
    _, turn, place = cv2.solvePnP(board, corners, matrix, lens)
    rotation = cv2.Rodrigues(turn)[0]
    height = float(-(rotation.T @ place)[2, 0])
    print(f"{folder.name}: {len(seen)} pictures, error {error:.2f} px, {height:.2f} m above the floor")
    return Camera(size, matrix, rotation, place.ravel(), tuple(map(float, lens.ravel()[:5])))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("phones", type=Path, help="folder with a folder for each phone")
    parser.add_argument("--columns", type=int, default=12, help="squares of a row of the board")
    parser.add_argument("--rows", type=int, default=9, help="squares of a column of the board")
    parser.add_argument("--square", type=float, required=True, help="side of a square, metres")
    parser.add_argument("-o", "--output", type=Path, default=Path("calibration.toml"))
    given = parser.parse_args()
    if (given.columns - given.rows) % 2 == 0:
        sys.exit("of --columns and --rows, one has to be even and the other odd")
    if not given.phones.is_dir():
        sys.exit(f"{given.phones}: no such folder")
    folders = sorted(path for path in given.phones.iterdir() if (path / "board").is_dir())
    if not folders:
        sys.exit(f"{given.phones}: no folder of a phone with a folder 'board' in it")
    cameras = {path.name: calibrate(path, given.columns, given.rows, given.square) for path in folders}
    write_calibration(given.output, cameras)
    print(f"wrote {given.output}")


if __name__ == "__main__":
    main()
