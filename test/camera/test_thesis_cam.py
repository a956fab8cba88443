"""Cameras of the thesis: its equations, .cam files, and pixels by Blender."""

from __future__ import annotations

import json
from dataclasses import astuple

import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera
from humansim_ros.cameras.camera.ideal import idealize
from humansim_ros.cameras.formats.thesis_cam import (
    CamFile,
    aspect_of,
    calibration_matrix,
    cam_of,
    camera_of,
    camera_rotation,
    compose_euler,
    decompose_euler,
    focal_of,
    format_cam,
    image_shift,
    parse_cam,
)
from humansim_ros.errors import CameraError
from humansim_ros.types import Array

BLENDER = json.loads((ROOT / "test" / "data" / "blender_cam.json").read_text())
#: 8.3's own example.
EXAMPLE = "C=3.0,0.0,0.0\nf=1\nR=80.0,0.0,80.0\nk=4:2\nsize=600x800\nformat=png\n"

angles = st.floats(-np.pi, np.pi)
cam_files = st.builds(
    CamFile,
    center=st.tuples(*[st.floats(-20, 20)] * 3),
    focal=st.floats(0.2, 10),
    euler_deg=st.tuples(
        st.floats(-180, 180), st.floats(-90, 90) | st.sampled_from([-90.0, 90.0]), st.floats(-180, 180)
    ),
    size=st.tuples(st.integers(2, 4000), st.integers(2, 4000)),
    aspect=st.tuples(st.floats(0.2, 5), st.floats(0.2, 5)),
)

#: From (row, column) from the image corner to (column, row) from the centre of the first pixel.
TO_ROS = np.array([[0.0, 1, -0.5], [1, 0, -0.5], [0, 0, 1]])


def projection_matrix(cam: CamFile) -> Array:
    """P = K [R | -R C], (3, 4), in (row, column) order (9.23), with (9.20) corrected."""
    k, r = calibration_matrix(cam.focal, cam.size, cam.aspect), camera_rotation(np.radians(cam.euler_deg))
    return k @ np.column_stack([r, -r @ np.array(cam.center)])


@given(angles, angles, angles)
def test_euler_angles_compose_as_scipys(a: float, b: float, c: float) -> None:
    np.testing.assert_allclose(
        compose_euler((a, b, c)), Rotation.from_euler("xyz", (a, b, c)).as_matrix(), atol=1e-15
    )


@settings(max_examples=300)
@given(
    angles,
    angles | st.sampled_from([np.pi / 2, -np.pi / 2]),
    st.floats(-1e-7, 1e-7) | st.floats(-1e-12, 1e-12),
    angles,
)
def test_rotations_come_back_from_their_angles_at_the_poles_and_beside_them_too(
    a: float, b: float, beside: float, c: float
) -> None:
    rotation = Rotation.from_euler("xyz", (a, b + beside, c)).as_matrix()
    np.testing.assert_allclose(compose_euler(decompose_euler(rotation)), rotation, atol=1e-15 * 4)


@given(angles, st.floats(-1.5, 1.5), angles)
def test_angles_come_back_as_they_were_written(a: float, b: float, c: float) -> None:
    np.testing.assert_allclose(
        np.exp(1j * decompose_euler(compose_euler((a, b, c)))), np.exp(1j * np.array((a, b, c))), atol=1e-12
    )


def test_a_lens_of_16_sees_90_degrees_of_the_longer_side() -> None:
    for size, longer in (((640, 480), 0), ((480, 640), 1)):
        camera = camera_of(CamFile((0, 0, 0), 1.0, (0, 0, 0), size))
        corners = camera.unproject([[-0.5, -0.5], np.subtract(size, 0.5)], [1, 1])
        assert np.ptp(corners[:, longer]) == pytest.approx(2.0)


def test_the_printed_code_of_the_thesis_gives_the_same_k() -> None:
    for (width, height), (ku, kv) in (((600, 800), (4, 2)), ((640, 480), (1, 1)), ((900, 300), (2, 3))):
        if width * kv > height * ku:
            mv = width / 2
            mu = mv * kv / ku
        else:
            mu = height / 2
            mv = mu * ku / kv
        expected = [[-mu * 1.5, 0, height / 2], [0, mv * 1.5, width / 2], [0, 0, 1]]
        np.testing.assert_allclose(calibration_matrix(1.5, (width, height), (ku, kv)), expected)


@pytest.mark.parametrize("seen", BLENDER, ids=[str(camera["size"]) + str(camera["k"]) for camera in BLENDER])
def test_points_are_where_blender_sees_them(seen: dict) -> None:
    cam = CamFile(tuple(seen["C"]), seen["f"], tuple(seen["R"]), tuple(seen["size"]), tuple(seen["k"]))
    world = np.array([point["world"] for point in seen["points"]])
    pixels = np.array([point["pixel"] for point in seen["points"]])
    np.testing.assert_allclose(camera_of(cam).project(world)[0], pixels, atol=2e-3)  # it works in float32
    image = TO_ROS @ projection_matrix(cam) @ np.column_stack([world, np.ones(len(world))]).T
    np.testing.assert_allclose((image[:2] / image[2]).T, pixels, atol=2e-3)


@settings(deadline=None, max_examples=60)
@given(cam_files)
def test_a_camera_comes_back_from_its_projection_matrix(cam: CamFile) -> None:
    """Camera -> P -> camera (9.68)-(9.73)."""
    p = projection_matrix(cam)
    np.testing.assert_allclose(camera_of(cam).P, TO_ROS @ p, atol=1e-8)
    back = cam_of(Camera.from_projection_matrix(-3 * TO_ROS @ p, cam.size))
    assert back.focal == pytest.approx(cam.focal)
    assert back.size == cam.size
    assert back.aspect[0] / back.aspect[1] == pytest.approx(cam.aspect[0] / cam.aspect[1])
    np.testing.assert_allclose(back.center, cam.center, atol=1e-8)
    np.testing.assert_allclose(projection_matrix(back), p, rtol=1e-8, atol=1e-6)


@settings(deadline=None, max_examples=60)
@given(cam_files)
def test_every_number_comes_back_from_a_file(cam: CamFile) -> None:
    assert parse_cam(format_cam(cam)) == cam


def test_the_example_of_the_thesis_is_read() -> None:
    cam = parse_cam(EXAMPLE.replace("\n", "\r\n") + "\n # a comment\n")
    assert astuple(cam) == ((3, 0, 0), 1, (80, 0, 80), (600, 800), (4, 2), "png")
    assert parse_cam("size = 64x48\nR=0,0,0\nf=1\nC=0,0,1").aspect == (1, 1)


def test_values_of_k_are_found_back_in_it() -> None:
    k = np.array([[500.0, 0, 300], [0, 250, 260], [0, 0, 1]])
    assert aspect_of(k) == 2
    assert focal_of(k, (640, 480)) == pytest.approx(
        2 * 500 / 960
    )  # the height, in widths of pixels, is longer
    assert focal_of(np.diag([500.0, 500, 1]), (640, 480)) == pytest.approx(2 * 500 / 640)
    np.testing.assert_allclose(image_shift(k, (640, 480)), [19.5, -20.5])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"K": [[500, 1, 319.5], [0, 500, 239.5], [0, 0, 1]]}, "skew"),
        ({"K": [[500, 0, 319.5], [0, 500, 230], [0, 0, 1]]}, "9.5 pixels off"),
        ({"distortion": (0.1, 0, 0, 0)}, "lens distortion"),
    ],
)
def test_what_a_cam_file_cannot_hold_is_refused_and_idealised(change: dict, said: str) -> None:
    k = np.array([[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
    camera = Camera(**({"size": (640, 480), "K": k, "R": np.eye(3), "t": np.zeros(3)} | change))
    with pytest.raises(CameraError, match=rf"{said}.*idealize"):
        cam_of(camera)
    ideal = idealize(camera).camera
    np.testing.assert_allclose(camera_of(cam_of(ideal)).P, ideal.P, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "line", "key"),
    [
        ("f=1", "f=one", 2, "f"),
        ("f=1", "f=nan", 2, "f"),
        ("f=1", "f=-1", 2, "f"),
        ("f=1", "f=1e400", 2, "f"),
        ("f=1", "f=1e-300", 2, "f"),
        ("f=1", "C=1,2,3", 2, "C"),
        ("f=1", "focus=1", 2, "focus"),
        ("f=1", "nonsense", 2, None),
        ("f=1", "", None, "f"),
        ("C=3.0,0.0,0.0", "C=3.0,0.0", 1, "C"),
        ("R=80.0,0.0,80.0", "R=80.0,inf,80.0", 3, "R"),
        ("k=4:2", "k=4", 4, "k"),
        ("k=4:2", "k=4:0", 4, "k"),
        ("size=600x800", "size=600", 5, "size"),
        ("size=600x800", "size=600x800.5", 5, "size"),
        ("size=600x800", "size=600x-800", 5, "size"),
        ("size=600x800", "size=600x80000000", 5, "size"),
    ],
)
def test_wrong_files_are_refused_with_line_and_key(
    old: str, new: str, line: int | None, key: str | None
) -> None:
    with pytest.raises(CameraError) as caught:
        parse_cam(EXAMPLE.replace(old, new), "a.cam")
    assert (caught.value.path, caught.value.line, caught.value.key) == ("a.cam", line, key)
