"""Placement of rigs whose world is anywhere, judged by the rigid motion that took them there."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from test_placement import moved_rig

from humansim_ros.cameras import Camera, read_calibration
from humansim_ros.cameras.camera.placement import (
    FloorPoint,
    FoundPlacement,
    place_by_board,
    place_by_floor,
    place_by_level,
    place_by_tilt,
    triangulate,
    turned,
)
from humansim_ros.cameras.camera.rigs import Optics, Rig
from humansim_ros.errors import CameraError

LENS = Optics(distortion=(-0.2, 0.06, 1e-3, -5e-4))
FLOOR = np.array([[1.0, 0.2, 0], [-0.8, 0.9, 0], [-0.5, -1.1, 0], [0.7, -0.6, 0], [0.1, 0.3, 0]])
SEEDS = range(4)


def a_rig(seed: int) -> dict[str, Camera]:
    """A rig in ``map`` that looks at a point above 0, 0."""
    rigs = [
        Rig((0, 0, 1.0), 3.0, 2.1, LENS).ring(6),
        Rig((0, 0, 1.0), 3.5, optics=LENS).dome(5),
        Rig((0, 0, 1.0), 2.5, 1.2, LENS, start=0.4).ring(3),
        Rig((0, 0, 1.0), 3.0, 1.5, LENS).grid(2, 3, 0.7),
    ]
    return rigs[seed % len(rigs)]


def assert_in_place(
    found: FoundPlacement,
    in_file: Mapping[str, Camera],
    rig: Mapping[str, Camera],
    degrees: float = 1e-6,
    metres: float = 1e-6,
) -> None:
    """Cameras are as high above the floor and look as far down as in truth; their target is above 0, 0."""
    for name, wanted in rig.items():
        camera = found.placement.camera(in_file[name])
        for axis in range(3):
            angle = abs(
                np.degrees(np.arcsin(camera.R[axis, 2]) - np.arcsin(np.clip(wanted.R[axis, 2], -1, 1)))
            )
            assert angle < degrees
        assert abs(camera.center[2] - wanted.center[2]) < metres
        assert abs(np.linalg.norm(camera.center[:2]) - np.linalg.norm(wanted.center[:2])) < metres


@pytest.mark.parametrize("seed", SEEDS)
def test_the_height_and_tilt_of_one_camera_place_a_rig(seed: int) -> None:
    rig = a_rig(seed)
    in_file, _ = moved_rig(seed, rig)
    name, camera = list(rig.items())[-1]
    tilt = float(np.arcsin(-camera.R[2, 2]))
    found = place_by_tilt(in_file, name, camera.center[2], tilt)
    assert_in_place(found, in_file, rig)
    assert found.residuals["roll_deg"] < 1e-4
    # an error of half a degree moves nothing by more than that
    off = place_by_tilt(in_file, name, camera.center[2], tilt + np.radians(0.5))
    assert_in_place(off, in_file, rig, degrees=0.51, metres=0.1)


def test_a_rolled_camera_places_a_rig_with_its_roll() -> None:
    rig = a_rig(0)
    upright = rig["camera_1"]
    roll = np.radians(20)
    # turned clockwise as seen from behind: up in the old image is left in the new one
    turn = Rotation.from_rotvec([0, 0, roll]).as_matrix().T
    rig["camera_1"] = Camera(upright.size, upright.K, turn @ upright.R, turn @ upright.t)
    in_file, _ = moved_rig(3, rig)
    found = place_by_tilt(in_file, "camera_1", 2.1, float(np.arcsin(-upright.R[2, 2])), roll)
    assert_in_place(found, in_file, rig)


@pytest.mark.daily("0.5-2")
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_floor_points_in_images_place_a_rig(seed: int, noise: float) -> None:
    rig = a_rig(seed)
    in_file, _ = moved_rig(seed, rig)
    rng = np.random.default_rng(seed)
    points = []
    for point in FLOOR:
        pixels = {}
        for name, camera in rig.items():
            pixel = camera.project(point[None])[0][0] + rng.normal(0, noise, 2)
            if np.isfinite(pixel).all() and ((pixel > 0) & (pixel < camera.size)).all():
                pixels[name] = tuple(pixel)
        if len(pixels) > 1:
            points.append(FloorPoint(pixels=pixels))
    assert len(points) >= 3
    found = place_by_floor(in_file, points)
    exact = noise == 0
    assert_in_place(found, in_file, rig, 1e-4 if exact else 1.0, 1e-6 if exact else 0.05)
    reprojection = found.residuals["reprojection_px"]
    assert reprojection < (1e-6 if exact else 2.0) and (exact or reprojection > 0.05)


@pytest.mark.parametrize("seed", SEEDS)
def test_floor_points_with_known_places_give_the_whole_pose(seed: int) -> None:
    in_file, pose = moved_rig(seed, a_rig(seed))
    xyz = (FLOOR - pose[:3, 3]) @ pose[:3, :3]
    points = [
        FloorPoint(xyz=tuple(p), map=tuple(place[:2]) if i in (1, 3) else None)
        for i, (p, place) in enumerate(zip(xyz, FLOOR, strict=True))
    ]
    found = place_by_floor(in_file, points)
    assert_allclose(found.placement.rotation, pose[:3, :3], atol=1e-9)
    assert_allclose(found.placement.position, pose[:3, 3], atol=1e-9)
    assert_allclose(found.points, FLOOR, atol=1e-9)
    # noise of 5 mm
    rng = np.random.default_rng(seed)
    noisy = [
        FloorPoint(xyz=tuple(p.xyz + rng.normal(0, 0.005, 3)), map=tuple(q[:2]))
        for p, q in zip(points, FLOOR, strict=True)
    ]
    found = place_by_floor(in_file, noisy)
    assert np.degrees(Rotation.from_matrix(found.placement.rotation @ pose[:3, :3].T).magnitude()) < 1
    assert 0.1 < found.residuals["map_mm"] < 12


@pytest.mark.daily("0-standing", "3-floor")
@pytest.mark.parametrize("side", ["floor", "z_up", "z_down", "standing"])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_board_places_a_rig(seed: int, side: str) -> None:
    rig = a_rig(seed)
    in_file, pose = moved_rig(seed, rig)
    yaw = Rotation.from_euler("z", seed).as_matrix()
    lying = {"floor": np.diag([1.0, -1, -1]), "z_up": np.eye(3), "z_down": np.diag([1.0, -1, -1])}
    # a printed board on a wall: x to the right, y down, z into the wall
    axes = lying.get(side, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    height = 0.9 if side == "standing" else 0.0
    in_map = np.eye(4)
    in_map[:3, :3], in_map[:3, 3] = yaw @ axes, [0.6, -0.3, height]
    board = np.linalg.inv(pose) @ in_map
    found = place_by_board(in_file, board, side, height)  # type: ignore[arg-type]
    # the board is at the origin of map, its x axis along x
    wanted = np.eye(4)
    wanted[:3, :3] = yaw.T
    wanted[:3, 3] = -yaw.T @ [0.6, -0.3, 0]
    wanted = wanted @ pose
    assert_allclose(found.placement.rotation, wanted[:3, :3], atol=1e-9)
    assert_allclose(found.placement.position, wanted[:3, 3], atol=1e-9)


@pytest.mark.parametrize("seed", SEEDS)
def test_levelling_places_a_rig_of_upright_cameras(seed: int) -> None:
    rig = a_rig(seed)
    in_file, _ = moved_rig(seed, rig)
    mean = float(np.mean([camera.center[2] for camera in rig.values()]))
    assert_in_place(place_by_level(in_file, mean), in_file, rig)
    # without a height, the point at which the cameras look is 1 m above the floor, as it is
    if seed != 3:  # the cameras of a wall look in almost one direction, at a point all the same
        assert_in_place(place_by_level(in_file), in_file, rig, metres=1e-5)


def test_levelling_tolerates_cameras_that_are_not_quite_upright() -> None:
    rig = a_rig(0)
    in_file, pose = moved_rig(7, rig)
    rng = np.random.default_rng(5)
    tilted = {}
    for name, camera in in_file.items():
        turn = Rotation.from_rotvec(np.radians(rng.normal(0, 1.5, 3))).as_matrix()
        tilted[name] = Camera(camera.size, camera.K, turn @ camera.R, turn @ camera.t)
    found = place_by_level(tilted, 2.1)
    up = found.placement.rotation @ pose[:3, :3].T @ [0, 0, 1]
    assert np.degrees(np.arccos(up[2])) < 2
    assert 0.3 < found.residuals["roll_deg"] < 4
    assert found.residuals["axes_mm"] > 5


@pytest.mark.parametrize(
    ("file", "only", "degrees"),
    [
        ("shelf_voxelpose.json", "", 2.5),
        ("campus_voxelpose.json", "", 1.5),
        ("human36m_camera-parameters.json", "S1_", 2.5),
        ("human36m_camera-parameters.json", "S9_", 2.5),
    ],
)
@pytest.mark.filterwarnings("ignore:.*image size is not in the file")
def test_levelling_finds_the_vertical_of_real_rigs(
    shared_data: Path, file: str, only: str, degrees: float
) -> None:
    read = read_calibration(shared_data / "calib" / file)
    in_file, pose = moved_rig(11, {name: camera for name, camera in read.items() if name.startswith(only)})
    up = place_by_level(in_file).placement.rotation @ pose[:3, :3].T @ [0, 0, 1]
    assert np.degrees(np.arccos(up[2])) < degrees


def test_a_stereo_pair_is_levelled_by_the_up_axes_of_its_images() -> None:
    pair = Rig((0, 0, 1.8), 3, 1.8, LENS).stereo(0.12)
    in_file, _ = moved_rig(1, pair)
    found = place_by_level(in_file)
    for name in pair:
        camera = found.placement.camera(in_file[name])
        assert_allclose(camera.R[1], [0, 0, -1], atol=1e-9)
        assert camera.center[2] == pytest.approx(1.8)


def test_a_placement_can_be_turned_and_moved() -> None:
    rig = a_rig(0)
    in_file, _ = moved_rig(2, rig)
    found = place_by_level(in_file, 2.1)
    moved = turned(found, np.radians(90), (3, 4))
    for camera in in_file.values():
        x, y, z = found.placement.camera(camera).center
        assert_allclose(moved.placement.camera(camera).center, [3 - y, 4 + x, z], atol=1e-9)


def test_triangulation_gives_the_point_of_its_pixels() -> None:
    rig = a_rig(0)
    point = np.array([0.3, -0.4, 0.2])
    pixels = {name: camera.project(point[None])[0][0] for name, camera in rig.items()}
    found, error = triangulate(rig, pixels)
    assert_allclose(found, point, atol=1e-7)
    assert error < 1e-5


def line(count: int) -> list[FloorPoint]:
    return [FloorPoint(xyz=(i, 2.0 * i, 0)) for i in range(count)]


def pixels(**names: tuple[float, float]) -> list[FloorPoint]:
    return [FloorPoint(pixels=names)] * 3


CASES: list[tuple[list[FloorPoint], str]] = [
    (line(2), "three points or more, not 2"),
    (line(4), "lie on a line"),
    (pixels(camera_1=(3, 4)), "floor point 1: needs pixels of two cameras"),
    (
        pixels(camera_1=(3, 4), camera_9=(3, 4)),
        "no camera 'camera_9'; did you mean 'camera_2'.? There are camera_1, camera_2",
    ),
    (pixels(camera_1=(0, 0), camera_2=(639, 0)), "do not meet in front"),
]


@pytest.mark.parametrize(("points", "said"), CASES)
def test_wrong_floor_points_are_explained(points: list[FloorPoint], said: str) -> None:
    facing_away = {
        "camera_1": Camera.look_at((1, 0, 1), (4, 0.5, 1)),
        "camera_2": Camera.look_at((-1, 0, 1), (-4, 0.5, 1)),
    }
    with pytest.raises(CameraError, match=said):
        place_by_floor(facing_away, points)


def test_cameras_without_a_common_up_direction_are_not_levelled() -> None:
    upright = Camera.look_at((3, 0, 1), (0, 0, 1))
    upside_down = Camera.look_at((0, 3, 1), (0, 0, 1), up=(0, 0, -1))
    with pytest.raises(CameraError, match="do not stand upright: place them by floor points"):
        place_by_level({"a": upright, "b": upside_down})
    with pytest.raises(CameraError, match="tilt: must be from -90 to 90"):
        place_by_tilt({"a": upright}, "a", 1.0, 2.0)
