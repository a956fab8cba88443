"""TRC and C3D files: units, axes, rates, times and missing points, read back by other programs' code."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from humansim_ros.data.formats.positions import MarkerPaths, c3d_bytes, trc_text
from humansim_ros.errors import ExportError
from humansim_ros.motion.files.marker_files import read_c3d_points

NAMES = ("nose", "left_wrist", "right_wrist")


def paths(frames: int = 12, first_frame: int = 30) -> MarkerPaths:
    positions = np.random.default_rng(3).uniform(-5, 5, (frames, len(NAMES), 3))
    positions[4, 1] = np.nan
    return MarkerPaths(NAMES, positions, 29.97, first_frame)


def test_a_trc_file_has_metres_with_y_up_and_times_of_the_scene() -> None:
    written = paths()
    lines = trc_text(written, "anna.trc").splitlines()
    assert lines[0].split("\t") == ["PathFileType", "4", "(X/Y/Z)", "anna.trc"]
    header = dict(zip(lines[1].split("\t"), lines[2].split("\t"), strict=True))
    assert header["Units"] == "m" and header["NumFrames"] == "12" and header["NumMarkers"] == "3"
    assert float(header["DataRate"]) == 29.97 and header["OrigDataStartFrame"] == "31"
    assert tuple(name for name in lines[3].split("\t")[2:] if name) == NAMES
    assert lines[4].split("\t")[2:] == [f"{axis}{point}" for point in (1, 2, 3) for axis in "XYZ"]
    rows = [line.split("\t") for line in lines[6:]]
    assert [len(row) for row in rows] == [2 + 9] * 12
    assert [int(row[0]) for row in rows] == list(range(31, 43))
    np.testing.assert_allclose([float(row[1]) for row in rows], np.arange(30, 42) / 29.97, atol=1e-6)
    y_up = np.array([[float(field or "nan") for field in row[2:]] for row in rows]).reshape(12, 3, 3)
    expected = written.positions[..., [1, 2, 0]]  # left, up, forward
    np.testing.assert_allclose(y_up, expected, atol=1e-6)
    assert rows[4][5:8] == ["", "", ""]


def test_ezc3d_reads_millimetres_with_z_up_and_missing_points(tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    written = paths()
    (tmp_path / "anna.c3d").write_bytes(c3d_bytes(written))
    read = ezc3d.c3d(str(tmp_path / "anna.c3d"))
    point = read["parameters"]["POINT"]
    assert tuple(point["LABELS"]["value"]) == NAMES and point["UNITS"]["value"] == ["mm"]
    assert point["RATE"]["value"][0] == pytest.approx(29.97)
    assert (point["X_SCREEN"]["value"], point["Y_SCREEN"]["value"]) == (["+X"], ["+Z"])
    assert (read["header"]["points"]["first_frame"], read["header"]["points"]["last_frame"]) == (30, 41)
    metres = read["data"]["points"][:3].transpose(2, 1, 0) / 1000
    np.testing.assert_allclose(metres, written.positions, atol=1e-6)
    residuals = read["data"]["meta_points"]["residuals"][0].T
    np.testing.assert_array_equal(residuals < 0, written.missing)


def many(count: int, length: int = 10) -> MarkerPaths:
    """Points with names of a length, each at a place of its own."""
    names = tuple(f"{point:05d}".ljust(length, "x") for point in range(count))
    return MarkerPaths(names, np.arange(3.0 * count).reshape(1, count, 3) / 1000, 30.0)


@pytest.mark.parametrize(("count", "length"), [(255, 10), (256, 10), (460, 127), (1000, 9)])
def test_a_c3d_file_has_more_than_255_points(tmp_path: Path, count: int, length: int) -> None:
    """Names continue in POINT:LABELS2 and so on, 255 in each, as ezc3d and Vicon read them."""
    ezc3d = pytest.importorskip("ezc3d")
    written = many(count, length)
    (tmp_path / "many.c3d").write_bytes(c3d_bytes(written))
    read = ezc3d.c3d(str(tmp_path / "many.c3d"))
    point = read["parameters"]["POINT"]
    parts = [f"LABELS{number}" for number in ("", *range(2, 9)) if f"LABELS{number}" in point]
    assert [len(point[part]["value"]) for part in parts[:-1]] == [255] * (len(parts) - 1)
    assert [name for part in parts for name in point[part]["value"]] == list(written.names)
    assert point["USED"]["value"][0] == count
    metres = read["data"]["points"][:3].transpose(2, 1, 0) / 1000
    np.testing.assert_allclose(metres, written.positions, atol=1e-6)
    own = read_c3d_points(tmp_path / "many.c3d", ExportError, 1 << 24)
    assert own.labels == written.names
    np.testing.assert_allclose(own.points, written.positions, atol=1e-6)
