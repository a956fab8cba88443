"""Camera trajectories compared with Slerp of SciPy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from humansim_ros.cameras import Camera
from humansim_ros.cameras.camera.rigs import Trajectory
from humansim_ros.errors import CameraError, HumansimWarning

RNG = np.random.default_rng(7)
TIMES = 1305031102.0 + np.cumsum(RNG.uniform(0.02, 0.5, 20))
POSITIONS = RNG.uniform(-3, 3, (20, 3))
TURNS = Rotation.random(20, 8)
LINES = [
    " ".join(map(repr, map(float, (time, *position, *turn))))
    for time, position, turn in zip(TIMES, POSITIONS, TURNS.as_quat(), strict=True)
]
#: Start of the files of the benchmark.
HEAD = "# ground truth trajectory\n# timestamp tx ty tz qx qy qz qw\n"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "way.txt"
    path.write_text(HEAD + "\n".join(LINES) + "\n\n")
    return path


def test_positions_are_interpolated_linearly_and_rotations_as_by_scipy_slerp(file: Path) -> None:
    trajectory = Trajectory.read(file)
    turns = Slerp(TIMES, TURNS)
    for seconds in (*(TIMES - TIMES[0]), *RNG.uniform(0, trajectory.duration, 50)):
        rotation, t = trajectory.pose(seconds)
        time = np.clip(TIMES[0] + seconds, TIMES[0], TIMES[-1])
        np.testing.assert_allclose(rotation, turns(time).as_matrix().T, atol=1e-6)
        where = [np.interp(time, TIMES, axis) for axis in POSITIONS.T]
        np.testing.assert_allclose(-rotation.T @ t, where, atol=1e-6)
        camera = Camera((640, 480), np.diag([500.0, 500, 1]), rotation, t)
        np.testing.assert_allclose(camera.center, where, atol=1e-6)


def place(trajectory: Trajectory, seconds: float) -> np.ndarray:
    rotation, t = trajectory.pose(seconds)
    return -rotation.T @ t


def test_end_decides_what_follows_the_last_pose(file: Path) -> None:
    inner = Trajectory.read(file)
    clamp, loop, back = (Trajectory.read(file, end) for end in ("clamp", "loop", "ping_pong"))
    length = inner.duration
    for seconds in RNG.uniform(0.01, length - 0.01, 10):
        np.testing.assert_allclose(place(clamp, length + seconds), POSITIONS[-1])
        np.testing.assert_allclose(place(clamp, -seconds), POSITIONS[0])
        np.testing.assert_allclose(place(loop, 3 * length + seconds), place(inner, seconds), atol=1e-6)
        np.testing.assert_allclose(place(loop, seconds - length), place(inner, seconds), atol=1e-6)
        np.testing.assert_allclose(place(back, length + seconds), place(inner, length - seconds), atol=1e-6)
        np.testing.assert_allclose(place(back, 2 * length + seconds), place(inner, seconds), atol=1e-6)


@pytest.mark.parametrize("end", ["clamp", "loop", "ping_pong"])
def test_a_trajectory_of_one_pose_is_static(end: str, tmp_path: Path) -> None:
    (tmp_path / "one.txt").write_text(LINES[0])
    trajectory = Trajectory.read(tmp_path / "one.txt", end)  # type: ignore[arg-type]
    for seconds in (-1.0, 0.0, 5.0):
        np.testing.assert_allclose(place(trajectory, seconds), POSITIONS[0])


def test_an_orbit_looks_at_its_target_and_can_be_written(tmp_path: Path) -> None:
    orbit = Trajectory.orbit((0.5, -1, 0.9), radius=4, height=1.8, period=10, start=np.pi / 2)
    np.testing.assert_allclose(place(orbit, 0), [0.5, 3, 1.8], atol=1e-9)
    np.testing.assert_allclose(place(orbit, 2.5), [-3.5, -1, 1.8], atol=1e-9)  # to the left
    for seconds in np.linspace(0, 25, 77):
        rotation, t = orbit.pose(seconds)
        middle = rotation @ [0.5, -1, 0.9] + t
        assert np.hypot(*middle[:2]) < 1e-4
        assert middle[2] == pytest.approx(np.hypot(4, 0.9), abs=1e-4)
        assert rotation[0, 2] == pytest.approx(0, abs=1e-6)  # level
    orbit.write(tmp_path / "orbit.txt")
    again = Trajectory.read(tmp_path / "orbit.txt", "loop")
    for seconds in (0.3, 17.7):
        for ours, theirs in zip(again.pose(seconds), orbit.pose(seconds), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-14)
    for wrong in ({"radius": 0}, {"period": -1}, {"period": np.nan}):
        with pytest.raises(CameraError) as caught:
            Trajectory.orbit(**({"look_at": (0, 0, 1), "radius": 1, "height": 2, "period": 3} | wrong))
        assert caught.value.key == next(iter(wrong))


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("1 2 3", "8 numbers"),
        ("1 2 3 4 5 6 7 8 9", "8 numbers"),
        ("1 2 3 x 0 0 0 1", "8 numbers"),
        ("1 2 3 nan 0 0 0 1", "not finite"),
        ("inf 2 3 4 0 0 0 1", "not finite"),
        ("9e9 2 3 4 0 0 0 0", "length 1"),
        ("9e9 2 3 4 1e300 1e300 0 0", "length 1"),
        ("9e9 2e30 3 4 0 0 0 1", "1000 km"),
        (LINES[1], "not later"),
        ("5 0 0 0 0 0 0 1", "not later"),
    ],
)
def test_wrong_lines_are_named(tmp_path: Path, line: str, said: str) -> None:
    path = tmp_path / "way.txt"
    path.write_text(HEAD + "\n".join([*LINES[:2], line]))
    with pytest.raises(CameraError, match=said) as caught:
        Trajectory.read(path)
    assert (caught.value.path, caught.value.line) == (str(path), 5)


def test_files_without_a_pose_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty.txt").write_text(HEAD)
    with pytest.raises(CameraError, match="no pose"):
        Trajectory.read(tmp_path / "empty.txt")
    with pytest.raises(CameraError, match="no such"):
        Trajectory.read(tmp_path / "other.txt")


def test_quaternions_of_other_lengths_are_normalised_with_a_warning(tmp_path: Path) -> None:
    (tmp_path / "way.txt").write_text("0 1 2 3 0 0 0 2\n1 1 2 3 0 0 0 1")
    with pytest.warns(HumansimWarning, match="length 1"):
        trajectory = Trajectory.read(tmp_path / "way.txt")
    np.testing.assert_allclose(trajectory.pose(0.0)[0], np.eye(3))


@pytest.mark.parametrize(
    "parts",
    [
        ([], np.zeros((0, 3)), np.zeros((0, 4))),
        ([0, 1], np.zeros((2, 2)), np.ones((2, 4))),
        ([0, 0], np.zeros((2, 3)), np.ones((2, 4))),
        ([0, np.nan], np.zeros((2, 3)), np.ones((2, 4))),
        ([0], np.zeros((1, 3)), np.zeros((1, 4))),
        ([0], np.zeros((1, 3)), np.ones((1, 4)), "stop"),
    ],
)
def test_wrong_arrays_of_a_trajectory_are_refused(parts: tuple) -> None:
    with pytest.raises(CameraError):
        Trajectory(*parts)
