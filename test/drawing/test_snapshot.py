"""The snapshot of a scene: every camera once, joints at their pixels, any number of cameras, bounded size."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from humansim_ros import Scene, Simulation
from humansim_ros.cli.main import main
from humansim_ros.errors import HumansimError, RenderError, SceneError
from humansim_ros.render import ALL_CHANNELS
from humansim_ros.render.interface import CHANNEL_TABLE
from humansim_ros.render.pictures import write_png
from humansim_ros.scene import Needs
from humansim_ros.scene.pictures.sheets import MAX_SIDE, _Layout, snapshot
from humansim_ros.scene.pictures.top_view import top_view
from humansim_ros.scene.pictures.views import color_channel, color_image

HUMANS = {"anna": {"body": "child", "motion": "walk"}}
_HEAD, _GAP = 36, 4


def scene(count: int, size: tuple[int, int] = (48, 36), **camera: object) -> Scene:
    angles = 2 * np.pi * np.arange(count) / count
    cameras = {
        f"eye_{number}": {
            "size": list(size),
            "position": [2.5 * np.cos(angle), 2.5 * np.sin(angle), 1.2],
            "look_at": [0, 0, 0.6],
            **camera,
        }
        for number, angle in enumerate(angles.tolist())
    }
    return Scene.from_dict({"room": None, "humans": HUMANS, "cameras": cameras})


def tile(sheet: np.ndarray, layout: _Layout, camera: int, channels: int = 1, channel: int = 0) -> np.ndarray:
    """The tile of a camera, by the layout that the documents describe."""
    (width, height), (block, column) = layout.tile, divmod(camera, layout.columns)
    top = _HEAD + (block * channels + channel) * (height + _GAP)
    left = column * (width + _GAP)
    return sheet[top : top + height, left : left + width]


@pytest.mark.daily("5-3")
@pytest.mark.gl
@pytest.mark.slow
@pytest.mark.parametrize(("count", "columns"), [(1, 1), (2, 2), (5, 3), (64, 8)])
def test_the_sheet_has_a_picture_of_every_camera(count: int, columns: int) -> None:
    world = scene(count)
    sheet = snapshot(world, width=640, joints=False, above=False)
    layout = _Layout.of([(48, 36)] * count, 1, 640)
    assert layout.columns == columns and sheet.shape[1] <= 640
    with Simulation(world, channels=("rgb",)) as simulation:
        frame = simulation.frame(0)
    for number in {0, count // 2, count - 1}:
        expected = cv2.resize(frame.views[f"eye_{number}"].rgb, layout.tile, interpolation=cv2.INTER_LINEAR)
        shown = tile(sheet, layout, number)
        top = 3 * layout.tile[1] // 4  # below is the name of the camera
        assert np.abs(shown[:top].astype(int) - expected[:top]).mean() < 3


@pytest.mark.gl
def test_joints_are_drawn_where_they_are() -> None:
    world = scene(1, (320, 240))
    sheet = snapshot(world, seconds=0.5, width=1600, above=False)
    layout = _Layout.of([(320, 240)], 1, 1600)
    assert layout.tile == (320, 240)
    shown = tile(sheet, layout, 0)
    with Simulation(world) as simulation:
        frame = simulation.frame(15)
    joints = frame.joints["eye_0"]["anna"]
    knee = frame.humans["anna"].joint_names.index("l_knee")
    visible = np.flatnonzero(joints.visible == 2)
    assert len(visible) > 8
    drawn = [shown[round(y), round(x)] for x, y in joints.pixels[visible]]
    assert np.median(np.abs(np.array(drawn, int) - (60, 230, 90)).max(axis=1)) < 40
    pixel = frame.cameras["eye_0"].project(frame.humans["anna"].positions[knee][None])[0]
    np.testing.assert_allclose(joints.pixels[knee], pixel[0], atol=1e-9)


@pytest.mark.gl
def test_every_channel_has_a_row() -> None:
    world = scene(2)
    sheet = snapshot(world, channels=ALL_CHANNELS, width=400)
    layout = _Layout.of([(48, 36)] * 3, len(ALL_CHANNELS), 400)  # two cameras and the plan
    rows = len(ALL_CHANNELS)
    assert sheet.shape[0] == _HEAD + rows * (layout.tile[1] + _GAP) - _GAP
    drawn = {name: tile(sheet, layout, 1, rows, row) for row, name in enumerate(ALL_CHANNELS)}
    assert all(picture.max() > 100 for picture in drawn.values())
    assert len({picture[: layout.tile[1] // 2].tobytes() for picture in drawn.values()}) > 9


@pytest.mark.daily("1-channels0")
@pytest.mark.gl
@pytest.mark.parametrize(("count", "channels"), [(1, ("rgb",)), (3, ("rgb", "depth")), (4, ("rgb",))])
def test_the_last_tile_is_the_scene_from_above(count: int, channels: tuple[str, ...]) -> None:
    world = scene(count, (320, 240))
    sheet = snapshot(world, 0.5, channels, 800)
    rows = len(channels)
    layout = _Layout.of([(320, 240)] * (count + 1), rows, 800)
    (width, height), (block, column) = layout.tile, divmod(count, layout.columns)
    top, left = _HEAD + block * rows * (height + _GAP), column * (width + _GAP)
    whole = min(rows * (height + _GAP) - _GAP, round(1.2 * width))
    with Simulation(world) as simulation:
        cameras = simulation.frame(15).cameras
    expected = top_view(world, cameras, 0.5, (width, whole))
    np.testing.assert_array_equal(sheet[top : top + whole, left : left + width], expected)
    without = snapshot(world, 0.5, channels, 800, above=False)
    assert not any((without[row] == expected[0, 0]).all() for row in range(_HEAD, len(without)))


def test_layouts_fit_any_number_of_cameras_of_any_size() -> None:
    for count in range(1, 65):
        for channels in (1, 3, 14):
            for size in ((64, 48), (8192, 16), (16, 8192), (1920, 1080)):
                layout = _Layout.of([size] * count, channels, 1600)
                width = layout.columns * (layout.tile[0] + _GAP) - _GAP
                rows = -(-count // layout.columns) * channels
                assert width <= 1600 and _HEAD + rows * (layout.tile[1] + _GAP) <= MAX_SIDE + rows
                assert layout.columns * rows >= count * channels and min(layout.tile) >= 8


@pytest.mark.gl
def test_cameras_of_different_sizes_are_not_stretched() -> None:
    config = {"size": [80, 40], "position": [3, 0, 1], "look_at": [0, 0, 0.6]}
    cameras = {"wide": config, "tall": {**config, "size": [40, 80]}}
    sheet = snapshot(Scene.from_dict({"room": None, "cameras": cameras}), width=640, above=False)
    layout = _Layout.of([(80, 40), (40, 80)], 1, 640)
    wide, tall = (tile(sheet, layout, number)[: layout.tile[1] // 2] for number in (0, 1))
    assert (wide[0] == 28).all() and not (tall[0] == 28).all()  # bars above the wide, beside the tall one
    assert (tall[:, 0] == 28).all() and not (tall[:, layout.tile[0] // 2] == 28).any()


def test_a_smaller_camera_sees_the_same() -> None:
    camera = Scene.from_dict(
        {
            "room": None,
            "cameras": {
                "eye": {
                    "size": [800, 600],
                    "position": [3, 1, 1],
                    "look_at": [0, 0, 0.6],
                    "fov_deg": 90,
                    "distortion": [-0.2, 0.03],
                    "binning": [2, 1],
                    "roi": {"x": 100, "width": 600, "height": 500},
                    "sensor": {"chromatic_aberration": {"red": 100.0}},
                }
            },
        }
    ).scene_cameras["eye"]
    smaller = camera.smaller((75, 125))
    assert camera.camera.size == (300, 500) and smaller.camera.size == (75, 125)
    points = np.random.default_rng(1).uniform(-0.5, 0.5, (20, 3))
    whole, reduced = (one.camera.project(points)[0] for one in (camera, smaller))
    np.testing.assert_allclose(reduced + 0.5, (whole + 0.5) / 4, atol=1e-9)


@pytest.mark.gl
def test_a_large_camera_is_reduced_to_its_tile() -> None:
    config = {"size": [1280, 960], "position": [3, 0, 1], "look_at": [0, 0, 0.6]}
    world = Scene.from_dict({"room": None, "humans": HUMANS, "cameras": {"eye": config}})
    sheet = snapshot(world, width=320, joints=False, above=False)
    with Simulation(world, channels=("rgb",)) as simulation:
        whole = simulation.frame(0).views["eye"].rgb
    expected = cv2.resize(whole, (320, 240), interpolation=cv2.INTER_AREA)
    shown = tile(sheet, _Layout.of([(1280, 960)], 1, 320), 0)
    assert shown.shape == (240, 320, 3)
    assert np.abs(shown[:200].astype(int) - expected[:200]).mean() < 1


@pytest.fixture(scope="module")
def simulation() -> Iterator[Simulation]:
    with Simulation(scene(3)) as one:
        yield one


def test_a_frame_has_the_cameras_that_are_asked_for(simulation: Simulation) -> None:
    whole, one = simulation.frame(3), simulation.frame(3, Needs(("rgb",), ["eye_1"]))
    assert list(one.views) == list(one.truth) == list(one.cameras) == ["eye_1"]
    assert (one.views["eye_1"].rgb == whole.views["eye_1"].rgb).all()
    with pytest.raises(
        SceneError, match=r"no camera .eye_9.; did you mean .eye_\d.\? There are eye_0, eye_1, eye_2"
    ):
        simulation.frame(0, Needs(cameras=["eye_9"]))


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono8", "bayer_rggb8"])
def test_the_output_of_every_sensor_is_shown_in_its_colours(encoding: str) -> None:
    color = np.array([200, 120, 40], np.uint8)
    image = np.tile(color, (8, 8, 1))
    if encoding == "bgr8":
        image = image[..., ::-1]
    elif encoding == "mono8":
        image = image[..., 0]
    elif encoding == "bayer_rggb8":
        image = np.array([[200, 120], [120, 40]], np.uint8)[np.arange(8)[:, None] % 2, np.arange(8) % 2]
    expected = [200] * 3 if encoding == "mono8" else color
    assert (color_image(image, encoding)[2:-2, 2:-2] == expected).all()


def test_people_can_look_at_each_channel() -> None:
    for channel in CHANNEL_TABLE.values():
        empty = channel.empty_image((4, 6))
        picture = color_channel(channel.name, {1: empty} if channel.per_body else empty)
        assert picture.shape == (4, 6, 3) and picture.dtype == np.uint8


def test_flow_is_coloured_by_its_direction() -> None:
    flow = np.full((4, 4, 2), np.nan, np.float32)
    flow[0], flow[1], flow[2] = (3, 0), (-3, 0), (0, 0)
    right, left, still, nothing = color_channel("flow", flow)[:, 0].astype(int)
    assert right[0] > right[2] and left[2] > left[0]  # red, cyan
    assert still.max() == nothing.max() == 0


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"channels": ("rgb", "dept")}, RenderError, "no such channel: dept; there are rgb, depth"),
        ({"channels": ()}, SceneError, "needs a channel"),
        ({"width": 100}, SceneError, "160 to 8192 pixels wide, not 100"),
        ({"seconds": -1.0}, SceneError, "time of a snapshot"),
        ({"seconds": float("nan")}, SceneError, "time of a snapshot"),
    ],
)
def test_wrong_options_are_explained(
    options: dict[str, object], error: type[HumansimError], message: str
) -> None:
    with pytest.raises(error, match=message):
        snapshot(scene(1), **options)


@pytest.mark.gl
def test_the_command_writes_the_sheet_and_refuses_other_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config = {"room": None, "humans": HUMANS, "cameras": {"eye": {"size": [64, 48], "position": [3, 0, 1]}}}
    config["cameras"]["eye"]["look_at"] = [0, 0, 0.6]
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(config))
    command = ["humansim", "snapshot", str(tmp_path / "scene.yaml"), "--time", "0.5", "-o"]
    monkeypatch.setattr(sys, "argv", [*command, str(tmp_path / "sheet.png"), "--channels", "rgb, depth"])
    assert main() == 0
    written = cv2.imread(str(tmp_path / "sheet.png"))[..., ::-1]
    expected = snapshot(Scene.load(tmp_path / "scene.yaml"), 0.5, ("rgb", "depth"))
    assert (written == expected).all()
    write_png(tmp_path / "again.png", expected)
    assert (tmp_path / "again.png").read_bytes() == (tmp_path / "sheet.png").read_bytes()
    for name in ("sheet.jpg", "missing/sheet.png"):
        monkeypatch.setattr(sys, "argv", [*command, str(tmp_path / name)])
        assert main() == 2
        assert "error:" in capsys.readouterr().err
