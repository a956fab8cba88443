"""Cameras of scene files: calibration files, rigs, trajectories, lenses and sensors, through Simulation."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import ROOT
from keyframe_text import keyframes
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from waiting import PATIENCE

from humansim_ros.cameras import Camera
from humansim_ros.errors import HumansimError, HumansimWarning
from humansim_ros.render import View
from humansim_ros.scene import Frame, Scene, Simulation

INFO = """\
image_width: 320
image_height: 240
camera_name: usb
camera_matrix: {rows: 3, cols: 3, data: [210.5, 0, 150.25, 0, 212.5, 118.75, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [-0.33, 0.1, 0.001, 0.0005, 0]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
projection_matrix: {rows: 3, cols: 4, data: [170, 0, 155, 0, 0, 172, 121, 0, 0, 0, 1, 0]}
"""
PLACE = "position: [3, 0.5, 1.2], look_at: [0, 0, 1]"
WALK = "humans:\n  anna: {motion: {file: walk, position: [0.0, -0.5], loop: continue}}\n"
MOVES = keyframes(20, 10, board=((0, -1, 1), (0, 1, 1)))


def shelf(**moved: float) -> dict[str, Any]:
    """Two cameras in the format of the Shelf dataset: R and the center in millimetres; one has the name 0."""
    camera = {
        "k": [[-0.2], [0.05], [0.0]], "p": [[0.001], [0.0]],
        "R": [[-1, 0, 0], [0, 0, -1], [0, -1, 0]], "T": [[100.0], [2500.0], [1500.0]],
        "fx": 300.0, "fy": 305.0, "cx": 160.0, "cy": 118.0,
    }  # fmt: skip
    return {"0": camera, "back door": {**camera, "T": [[-400.0], [2600.0], [1000.0]]}}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "usb.yaml").write_text(INFO)
    (tmp_path / "shelf.json").write_text(json.dumps(shelf()))
    (tmp_path / "moves.xml").write_text(MOVES)
    return tmp_path


def load(folder: Path, text: str) -> Scene:
    (folder / "scene.yaml").write_text(text)
    return Scene.load(folder / "scene.yaml")


def film(folder: Path, text: str, *indices: int, start: int = 1) -> list[Frame]:
    simulation = Simulation(load(folder, text), start=start)
    frames = [simulation.frame(index) for index in indices]
    simulation.close()
    return frames


# --- calibration files


@pytest.mark.parametrize("url", [False, True])
def test_a_camera_has_the_lens_of_its_file_at_the_place_of_the_scene(folder: Path, url: bool) -> None:
    file = f"file://{folder}/usb.yaml" if url else "usb.yaml"
    camera = load(folder, f"cameras: {{left: {{calibration: '{file}', {PLACE}}}}}").cameras["left"]
    assert camera.size == (320, 240)
    assert camera.distortion == (-0.33, 0.1, 0.001, 0.0005, 0.0)
    np.testing.assert_array_equal(camera.K, [[210.5, 0, 150.25], [0, 212.5, 118.75], [0, 0, 1]])
    np.testing.assert_array_equal(
        camera.rectified_projection[:, :3], [[170, 0, 155], [0, 172, 121], [0, 0, 1]]
    )
    there = Camera.look_at((3, 0.5, 1.2), (0, 0, 1))
    np.testing.assert_allclose(camera.R, there.R, atol=1e-12)
    np.testing.assert_allclose(camera.center, (3, 0.5, 1.2), atol=1e-12)


def test_a_camera_has_the_pose_of_its_file(folder: Path) -> None:
    words = "calibration: shelf.json, size: [320, 240]"
    scene = load(folder, f"cameras: {{a: {{{words}, camera: 0}}, b: {{{words}, camera: back door}}}}")
    np.testing.assert_allclose(scene.cameras["a"].center, (0.1, 2.5, 1.5), atol=1e-12)
    np.testing.assert_allclose(scene.cameras["b"].center, (-0.4, 2.6, 1.0), atol=1e-12)
    # one that looks along -y, with y down, in a file whose unit is the centimetre
    scene = load(folder, f"cameras: {{a: {{{words}, camera: 0, unit: 0.01, up_axis: -y}}}}")
    camera = scene.cameras["a"]
    np.testing.assert_allclose(camera.center, (1, 15, -25), atol=1e-12)
    np.testing.assert_allclose(camera.R[2], (0, 0, 1), atol=1e-12)


def test_a_rig_is_all_cameras_of_a_file_or_some(folder: Path) -> None:
    rig = "rig: {file: shelf.json, size: [320, 240], binning: [2, 2], sensor: {encoding: mono8}%s}"
    scene = load(folder, rig % "" + f"\ncameras: {{left: {{{PLACE}}}}}")
    assert list(scene.cameras) == ["camera_0", "back_door", "left"]
    assert scene.cameras["back_door"].size == (160, 120)
    assert scene.scene_cameras["camera_0"].encoding == "mono8"
    np.testing.assert_allclose(scene.cameras["back_door"].center, (-0.4, 2.6, 1.0), atol=1e-12)
    assert list(load(folder, rig % ", cameras: [0]").cameras) == ["camera_0"]


def test_intrinsics_and_extrinsics_of_a_rig_may_be_in_two_files(folder: Path) -> None:
    k = [[300, 0, 160], [0, 305, 118], [0, 0, 1]]
    (folder / "lenses.json").write_text(json.dumps({"0": {"K": k}, "b": {"K": k}}))
    pose = {"rvec": [2.2, 0, 0], "tvec": [0, 1, 3]}
    (folder / "poses.json").write_text(json.dumps({"unit": "m", "0": pose, "b": pose}))
    files = "file: lenses.json, extrinsics: poses.json, size: [320, 240]"
    scene = load(folder, f"rig: {{{files}}}")
    assert list(scene.cameras) == ["camera_0", "b"]
    assert scene.cameras["b"].t.tolist() == [0, 1, 3]
    files = "calibration: lenses.json, extrinsics: poses.json, camera: b, size: [320, 240]"
    assert load(folder, f"cameras: {{one: {{{files}}}}}").cameras["one"].t.tolist() == [0, 1, 3]
    with pytest.raises(HumansimError, match=r"rig.extrinsics: .*no such file"):
        load(folder, "rig: {file: lenses.json, extrinsics: none.json}")


RIG = "rig: {file: shelf.json, size: [320, 240], background: %s}\nroom: null"


@pytest.mark.parametrize(
    ("background", "red"),
    [
        ("plate 0.png", {"camera_0": 40, "back_door": 40}),
        ("'plate {name}.png'", {"camera_0": 40, "back_door": 90}),
        ("{0: plate back door.png}", {"camera_0": 90, "back_door": 168}),  # the world's own for the other
    ],
)
def test_cameras_of_a_rig_have_photographs(folder: Path, background: str, red: dict[str, int]) -> None:
    for name, value in (("0", 40), ("back door", 90)):
        cv2.imwrite(str(folder / f"plate {name}.png"), np.full((24, 32, 3), value, np.uint8))
    (frame,) = film(folder, RIG % background, 0)
    assert {name: int(view.rgb[0, 0, 0]) for name, view in frame.views.items()} == red


@pytest.mark.nightly
@pytest.mark.slow
def test_running_a_scene_with_a_rig_tells_what_is_odd_once(folder: Path) -> None:
    pytest.importorskip("rclpy")
    scene = folder / "scene.yaml"
    scene.write_text("rig: shelf.json\nroom: null\n" + WALK)
    command = [sys.executable, "-m", "humansim_ros.cli", "run", scene, "--seconds", "4"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 0
    assert done.stderr.count("the image size is not in the file") == 1


@pytest.mark.parametrize(
    ("text", "key", "line", "message"),
    [
        (f"\ncameras: {{left: {{calibration: none.yaml, {PLACE}}}}}", "left.calibration", 2, "no such file"),
        ("cameras: {left: {calibration: 'http://x/a.yaml'}}", "left.calibration", 1, "only file://"),
        ("cameras: {left: {calibration: 'package://no_such/a.yaml'}}", "left.calibration", 1, "no package"),
        ("cameras:\n  left:\n    calibration: shelf.json\n    size: [320, 240]", "left.camera", 2, "0, back"),
        (
            "cameras:\n  left:\n    calibration: shelf.json\n    camera: 7\n    size: [320, 240]",
            "left.camera",
            4,
            "shelf.json has no camera '7'; there are 0, back door",
        ),
        (
            f"cameras: {{left: {{calibration: usb.yaml, size: [640, 480], {PLACE}}}}}",
            "left.size",
            1,
            "images of 320x240",
        ),
        ("cameras: {left: {trajectory: none.txt}}", "left.trajectory.file", 1, "no such file"),
        ("rate: 20\nrig: none.json", "rig.file", 2, "no such file"),
        ("rig: {file: usb.yaml, size: [64, 48]}", "rig.size", 1, "images of 320x240"),
        (
            "rig: {file: shelf.json, size: [320, 240], cameras: [1]}",
            "rig.cameras",
            1,
            "shelf.json has no camera '1'",
        ),
        ("rig: {file: twins.json, size: [320, 240]}", "rig.cameras", 1, "would be a_b in ROS"),
        ("\n" + RIG % "gone.png", "rig.background", 2, "no such file"),
        ("\n" + RIG % "'usb.{name}'", "rig.background", 2, "usb.0"),
        (
            "rig:\n  file: shelf.json\n  size: [320, 240]\n  background:\n    0: usb.yaml",
            "rig.background.0",
            5,
            "not a PNG or JPEG",
        ),
        (RIG % "{1: usb.yaml}", "rig.background.1", 1, "this rig has no camera '1'; there are 0, back door"),
        (
            f"rig: {{file: shelf.json, size: [320, 240]}}\ncameras: {{back_door: {{{PLACE}}}}}",
            "cameras.back_door",
            2,
            "this name already",
        ),
    ],
)
@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
def test_a_wrong_reference_to_a_file_is_named_with_its_key_and_line(
    folder: Path, text: str, key: str, line: int, message: str
) -> None:
    (folder / "twins.json").write_text(json.dumps(dict(zip(("a b", "a-b"), shelf().values(), strict=True))))
    with pytest.raises(HumansimError, match=message) as caught:
        load(folder, text)
    assert caught.value.path == str(folder / "scene.yaml")
    assert caught.value.key in (key, f"cameras.{key}")
    assert caught.value.line == line


def test_an_error_of_a_calibration_names_its_own_key_too(folder: Path) -> None:
    (folder / "usb.yaml").write_text(INFO.replace("-0.33, 0.1", "-0.33, .nan"))
    with pytest.raises(HumansimError, match="not finite") as caught:
        load(folder, f"cameras: {{left: {{calibration: usb.yaml, {PLACE}}}}}")
    assert caught.value.path == str(folder / "scene.yaml")
    assert (caught.value.key, caught.value.line) == ("cameras.left.calibration", 1)
    cause = caught.value.__cause__
    assert isinstance(cause, HumansimError)
    assert cause.path == str(folder / "usb.yaml")
    assert (cause.key, cause.line) == ("distortion_coefficients.data", 6)
    assert caught.value.message == str(cause)


def test_a_camera_without_a_pose_is_warned_of(folder: Path) -> None:
    with pytest.warns(HumansimWarning, match="scene.yaml:1: cameras.left.calibration: usb.yaml has no pose"):
        load(folder, "cameras: {left: {calibration: usb.yaml}}")


@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
def test_the_cameras_of_the_documents_are_those_they_say(folder: Path) -> None:
    text = (ROOT / "docs" / "scene.md").read_text()
    example = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)[1]
    (folder / "usb_cam.yaml").write_text(INFO.replace("320", "640").replace("240", "480"))
    trajectory(folder)
    cameras = load(folder, example).cameras
    assert list(cameras) == ["camera_0", "back_door", "usb", "half", "dolly"]
    assert [camera.size for camera in cameras.values()] == [(516, 388)] * 2 + [
        (640, 480),
        (640, 240),
        (640, 480),
    ]


# --- cameras that move


#: One metre per second towards a wall at x = -2, and to the left of it; turning by 0.3 rad on the way.
def trajectory(folder: Path) -> tuple[Camera, NDArray[np.float64]]:
    start = Camera.look_at((3, 0.2, 1), (-2, 0, 1.2), (64, 48))
    turned = Rotation.from_rotvec([0, 0, 0.3]) * Rotation.from_matrix(start.R.T)
    way = np.array([-1.0, 0.5, 0.1])
    lines = [
        [0.0, *start.center, *Rotation.from_matrix(start.R.T).as_quat()],
        [1.0, *(start.center + way), *turned.as_quat()],
    ]
    (folder / "way.txt").write_text("\n".join(" ".join(map(repr, map(float, line))) for line in lines))
    return start, way


WALL = "objects: {wall: {size: [0.1, 30, 30], position: [-2.05, 0, 0], color: [200, 120, 60]}}\n"


def test_a_camera_follows_its_trajectory_and_the_depth_of_a_wall_follows_it(folder: Path) -> None:
    start, way = trajectory(folder)
    see = "size: [64, 48], fov_deg: 60, distortion: [-0.2, 0.05, 0, 0]"
    text = f"rate: 10\nroom: null\n{WALL}cameras:\n  still: {{{see}, {PLACE}}}\n"
    text += f"  walker: {{{see}, trajectory: way.txt}}\n"
    text += f"  runner: {{{see}, trajectory: {{file: way.txt, speed: 2, offset: 0.1, end: ping_pong}}}}\n"
    frames = film(folder, text, 0, 3, 9, 12)
    assert list(frames[0].cameras) == ["still", "walker", "runner"]
    for frame in frames:
        seconds = frame.index / 10
        shares = {"walker": min(seconds, 1.0), "runner": 1 - abs(1 - 2 * (seconds + 0.1) % 2)}
        assert np.array_equal(frame.cameras["still"].R, frames[0].cameras["still"].R)
        for name, share in shares.items():
            camera = frame.cameras[name]
            np.testing.assert_allclose(camera.center, start.center + share * way, atol=1e-9)
            turn = Rotation.from_matrix(camera.R.T) * Rotation.from_matrix(start.R)
            np.testing.assert_allclose(turn.as_rotvec(), [0, 0, 0.3 * share], atol=1e-9)
            depth = frame.views[name].depth
            assert depth is not None
            # the wall's plane is x = -2: what every pixel's depth says it shows lies in it
            rows, columns = np.nonzero(np.isfinite(depth))
            assert len(rows) > 2000
            seen = camera.unproject(np.column_stack([columns, rows]), depth[rows, columns])
            np.testing.assert_allclose(seen[:, 0], -2.0, atol=2e-3)


@pytest.mark.nightly
@pytest.mark.slow
def test_a_moving_camera_renders_as_a_static_one_at_its_pose(folder: Path) -> None:
    trajectory(folder)
    see = "size: [64, 48], fov_deg: 60"
    (moving,) = film(folder, f"rate: 10\n{WALK}cameras: {{a: {{{see}, trajectory: way.txt}}}}", 4)
    camera = moving.cameras["a"]
    there = f"R: {camera.R.tolist()}, t: {camera.t.tolist()}"
    (still,) = film(folder, f"rate: 10\n{WALK}cameras: {{a: {{{see}, {there}}}}}", 4)
    for channel in ("depth", "instance", "part"):
        ours, theirs = getattr(moving.views["a"], channel), getattr(still.views["a"], channel)
        np.testing.assert_allclose(ours, theirs, atol=1e-4, err_msg=channel)
    # what stands still is drawn less fine for a camera that moves on
    assert np.abs(moving.views["a"].rgb.astype(float) - still.views["a"].rgb).mean() < 2


# --- lenses


def test_a_field_of_view_is_that_without_the_distortion(folder: Path) -> None:
    words = f"size: [320, 240], fov_deg: 80, {PLACE}"
    scene = load(
        folder,
        f"cameras:\n  ideal: {{{words}}}\n  bent: {{{words}, distortion: [-0.2, 0.04, 0, 0]}}\n"
        f"  fish: {{{words}, distortion: [0.01, 0, 0, 0], distortion_model: equidistant}}\n",
    )
    for name in ("bent", "fish"):
        np.testing.assert_array_equal(scene.cameras[name].K, scene.cameras["ideal"].K)
    assert scene.cameras["bent"].model == "plumb_bob"
    ideal = scene.cameras["ideal"]
    edge = np.degrees(np.arctan(160 / ideal.K[0, 0]))
    assert edge == pytest.approx(40)


RECTIFIED = (
    "rectification: [[0.99955, 0, 0.03], [0, 1, 0], [-0.03, 0, 0.99955]], "
    "rectified: [[170, 0, 150, -17], [0, 170, 121, 0], [0, 0, 1, 0]]"
)


@pytest.mark.daily("fisheye")
@pytest.mark.slow
@pytest.mark.parametrize("lens", ["plumb_bob", "rectified", "fisheye"])
def test_image_rect_is_the_image_of_the_ideal_camera_of_p(folder: Path, lens: str) -> None:
    """Balls all over the image are where a camera with this R and P renders them."""
    distortion = "[0.02, -0.01, 0.002, 0]" if lens == "fisheye" else "[-0.3, 0.08, 0.001, -0.001]"
    words = f"K: [[190, 3, 163], [0, 185, 117], [0, 0, 1]], distortion: {distortion}"
    words += f", {RECTIFIED}" if lens == "rectified" else ""
    words += ", distortion_model: equidistant" if lens == "fisheye" else ""
    cameras = f"cameras:\n  raw: {{size: [320, 240], {PLACE}, {words}}}\n"
    camera = load(folder, cameras).scene_cameras["raw"]
    k, turn = camera.whole.rectified_projection[:, :3], camera.whole.rectification_matrix
    ideal = Camera((320, 240), k, turn @ camera.whole.R, turn @ camera.whole.t)
    cameras += (
        f"  ideal: {{size: [320, 240], K: {k.tolist()}, R: {ideal.R.tolist()}, t: {ideal.t.tolist()}}}\n"
    )

    rng = np.random.default_rng(4)
    columns, rows = np.meshgrid(np.arange(30, 310, 52), np.arange(30, 220, 45))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]) + rng.uniform(-6, 6, (columns.size, 2))
    places = ideal.unproject(pixels, rng.uniform(2, 4, len(pixels)))
    look = "mesh: sphere, size: [0.12, 0.12, 0.12], color: [255, 255, 255]"
    balls = "".join(f"  ball_{i}: {{{look}, position: {p.tolist()}}}\n" for i, p in enumerate(places))
    (frame,) = film(folder, f"room: null\nobjects:\n{balls}{cameras}", 0)
    raw, direct = frame.views["raw"].rgb, frame.views["ideal"].rgb
    assert raw is not None and direct is not None
    rect = camera.rectify(raw)
    moved = centroids(rect, pixels) - centroids(direct, pixels)
    assert np.abs(moved).max() < 0.1
    assert np.abs(moved.mean(axis=0)).max() < 0.02
    assert difference(rect, direct) < 0.2 * difference(raw, direct)


def difference(image: NDArray[np.uint8], other: NDArray[np.uint8]) -> float:
    return float(np.abs(image.astype(float) - other).mean())


def centroids(image: NDArray[np.uint8], near: NDArray[np.float64]) -> NDArray[np.float64]:
    found = []
    background = np.median(image.reshape(-1, 3), axis=0)
    weights = np.abs(image - background).sum(axis=2)
    for x, y in near.round().astype(int):
        window = weights[y - 12 : y + 13, x - 12 : x + 13]
        rows, columns = np.mgrid[y - 12 : y + 13, x - 12 : x + 13]
        found.append([(columns * window).sum() / window.sum(), (rows * window).sum() / window.sum()])
    return np.array(found)


def test_straight_edges_are_straight_in_image_rect_and_bent_in_image_raw(folder: Path) -> None:
    lens = "fov_deg: 70, distortion: [-0.3, 0.08, 0, 0]"
    board = "board: {size: [0.02, 1.4, 6], position: [0, 2, 1], color: [250, 250, 250]}"
    text = f"room: null\nobjects: {{{board}}}\ncameras: {{raw: {{size: [320, 240], {lens}, {PLACE}}}}}"
    (frame,) = film(folder, text, 0)
    raw = frame.views["raw"].rgb
    assert raw is not None
    rect = load(folder, text).scene_cameras["raw"].rectify(raw)
    assert bend_of(rect) < 0.1
    assert bend_of(raw) > 1


def bend_of(image: NDArray[np.uint8]) -> float:
    """RMS distance in pixels of the left edge of the right object from its regression line."""
    rows = np.arange(20, 220)
    row = np.abs(image[rows].astype(float) - image[120, 20]).sum(axis=2)
    # how much of the right half is covered gives the edge to a fraction of a pixel
    share = row[:, 160:310] / row[:, 300:310].mean(axis=1, keepdims=True)
    edge = 310 - share.sum(axis=1)
    return float(np.std(edge - np.polyval(np.polyfit(rows, edge, 1), rows)))


# --- sensors

SENSORS = {
    "plain": "{}",
    "noisy": "{noise: {full_well: 2000}, exposure_time: 0.02, rolling_shutter: 0.0001, samples: 3, "
    "vignetting: {cos4: true}, jpeg: 80}",
    "mono": "{encoding: mono8, noise: {}}",
    "bayer": "{encoding: bayer_rggb8}",
}


@pytest.mark.slow
def test_truth_is_the_same_with_and_without_a_sensor(folder: Path) -> None:
    """Noise, blur and shutter change image_raw only."""
    trajectory(folder)
    text = f"rate: 20\n{WALK}cameras:\n"
    for name, sensor in SENSORS.items():
        lens = "size: [96, 72], fov_deg: 60, distortion: [-0.2, 0.04, 0, 0]"
        text += f"  {name}: {{{lens}, {PLACE}, sensor: {sensor}}}\n"
        text += f"  {name}_moving: {{{lens}, trajectory: way.txt, sensor: {sensor}}}\n"
    (frame,) = film(folder, text, 5)
    for moving in ("", "_moving"):
        plain = frame.views[f"plain{moving}"]
        for name in SENSORS:
            view = frame.views[name + moving]
            for channel in ("depth", "instance", "part"):
                assert getattr(view, channel).tobytes() == getattr(plain, channel).tobytes()
            joints = frame.joints[name + moving]["anna"]
            assert joints.pixels.tobytes() == frame.joints[f"plain{moving}"]["anna"].pixels.tobytes()
            assert view.rgb.shape == ((72, 96) if name in ("mono", "bayer") else (72, 96, 3))
            assert np.array_equal(view.rgb, plain.rgb) == (name == "plain")
        # the mosaic's pixels are the picture's, each of one colour
        bayer = frame.views[f"bayer{moving}"].rgb
        np.testing.assert_array_equal(bayer[::2, ::2], plain.rgb[::2, ::2, 0])
        np.testing.assert_array_equal(bayer[1::2, 1::2], plain.rgb[1::2, 1::2, 2])


@pytest.mark.nightly
def test_noise_is_that_of_the_scene_time(folder: Path) -> None:
    text = f"rate: 20\nroom: null\n{WALL}cameras: {{a: {{size: [64, 48], {PLACE}, sensor: {{noise: {{}}}}}}}}"
    first, again = film(folder, text, 2), film(folder, text, 2)
    later, restamped = film(folder, text, 3), film(folder, text, 2, start=2)
    pictures = [frame.views["a"].rgb for (frame,) in (first, again, later, restamped)]
    assert np.array_equal(pictures[0], pictures[1])
    assert not np.array_equal(pictures[0], pictures[2])
    assert restamped[0].stamp == first[0].stamp + 1
    assert np.array_equal(pictures[0], pictures[3])
    assert np.array_equal(first[0].views["a"].depth, later[0].views["a"].depth)


def test_a_moving_camera_blurs_static_objects(folder: Path) -> None:
    """A board at 3 m, a camera that moves 1 m/s to the right: the blur is the path of the edge."""
    start = Camera.look_at((3, 0, 1), (0, 0, 1), (320, 240))
    quaternion = Rotation.from_matrix(start.R.T).as_quat()
    (folder / "way.txt").write_text(
        "\n".join(" ".join(map(repr, map(float, (i, 3, i, 1, *quaternion)))) for i in (0, 1))
    )
    board = "board: {size: [0.02, 0.8, 1.2], position: [-0.01, 0.5, 1], color: [250, 250, 250]}"
    text = f"rate: 10\nroom: null\nobjects: {{{board}}}\ncameras:\n"
    for name, sensor in (("sharp", "{}"), ("smeared", "{exposure_time: 0.1, samples: 24}")):
        text += f"  {name}: {{size: [320, 240], fov_deg: 60, trajectory: way.txt, sensor: {sensor}}}\n"
    (frame,) = film(folder, text, 5)
    pixels = 0.1 * 320 / 2 / np.tan(np.radians(30)) / 3.0
    assert pixels > 8
    assert edge_width(frame.views["sharp"]) < 2.5
    assert edge_width(frame.views["smeared"]) == pytest.approx(pixels, abs=2)


def test_a_moving_object_is_blurred_for_a_static_camera(folder: Path) -> None:
    board = "board: {size: [0.02, 0.8, 1.2], color: [250, 250, 250], keyframes: moves.xml}"
    text = f"rate: 10\nroom: null\nobjects: {{{board}}}\ncameras:\n"
    words = "size: [320, 240], fov_deg: 60, position: [3, 0, 1], look_at: [0, 0, 1]"
    text += f"  smeared: {{{words}, sensor: {{exposure_time: 0.1, samples: 24}}}}\n"
    (frame,) = film(folder, text, 10)
    pixels = 0.1 * 320 / 2 / np.tan(np.radians(30)) / 2.99
    assert edge_width(frame.views["smeared"]) == pytest.approx(pixels, abs=2)


def test_what_begins_anew_smears_as_it_did_at_first(folder: Path) -> None:
    """A camera and a board that jump back to their start: the jump is not blurred."""
    trajectory(folder)
    (folder / "moves.xml").write_text(MOVES.replace("<animation", '<animation loop="repeat"'))
    words = "size: [160, 120], fov_deg: 60, sensor: {exposure_time: 0.05, samples: 12}"
    text = "rate: 10\nroom: null\n"
    text += "objects: {board: {size: [0.02, 0.8, 1.2], color: [250, 250, 250], keyframes: moves.xml}}\n"
    text += f"cameras:\n  stands: {{{words}, {PLACE}}}\n"
    text += f"  flies: {{{words}, trajectory: {{file: way.txt, end: loop}}}}\n"
    first, again = film(folder, text, 0, 20)
    for name in ("stands", "flies"):
        assert np.array_equal(first.views[name].rgb, again.views[name].rgb)
        assert len(np.unique(first.views[name].rgb)) > 8, "and it did smear"
    # one metre a second; in its second, the way moves by one of its metres
    np.testing.assert_allclose(again.objects["board"].velocity.linear, [0, 1, 0], atol=1e-9)
    pose = load(folder, text).scene_cameras["flies"].pose(3.0)
    np.testing.assert_allclose(pose.velocity.linear, [-1.0, 0.5, 0.1], atol=1e-9)
    np.testing.assert_allclose(pose.velocity.angular, [0, 0, 0.3], atol=1e-6)
    there = pose.moved(0.25)
    expected = load(folder, text).scene_cameras["flies"].pose(3.25)
    np.testing.assert_allclose(there.R, expected.R, atol=1e-6)
    np.testing.assert_allclose(there.t, expected.t, atol=1e-6)


def edge_width(view: View) -> int:
    """Number of pixels between background and board in the middle row, at the left edge of the board."""
    row = view.rgb[120].astype(float).sum(axis=1)
    background, board = row[0], row[(view.depth[120] < 4).nonzero()[0].mean().astype(int)]
    share = (row - background) / (board - background)
    first = int(np.argmax(share > 0.02))
    return int(np.argmax(share > 0.98)) - first


def test_another_motion_leaves_the_files_of_a_scene_where_they_are(tmp_path: Path) -> None:
    """``humansim run SCENE --motion``: the changed scene is in another folder."""
    from humansim_ros.cli.scene import SceneOptions

    home, other = tmp_path / "home", tmp_path / "other"
    home.mkdir()
    other.mkdir()
    (home / "way.txt").write_text("0 3 0 1 0.5 0.5 -0.5 -0.5\n1 3 1 1 0.5 0.5 -0.5 -0.5\n")
    (home / "P.txt").write_text("# front 64x48\n60 31.5 0 120\n0 23.5 -60 150\n0 1 0 4\n")
    cv2.imwrite(str(home / "front.png"), np.zeros((48, 64, 3), np.uint8))
    (home / "scene.yaml").write_text(
        "room: null\nhumans: {anna: {}}\ncameras:\n"
        "  moves: {size: [64, 48], trajectory: way.txt}\n  own: {calibration: P.txt}\n"
        "rig: {file: P.txt, background: '{name}.png'}\n"
    )
    changed = SceneOptions(motion="wave").write(home / "scene.yaml", other)
    scene = Scene.load(changed)
    assert scene.path.parent == other
    assert list(scene.moving_cameras) == ["moves"]
    assert scene.config.humans["anna"].motion.file == "wave"
