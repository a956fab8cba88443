"""Objects in notebooks: small pictures by IPython's own formatter; failures leave the text."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Iterator

import cv2
import numpy as np
import pytest

from humansim_ros import (
    Camera,
    Frame,
    HumansimWarning,
    Motion,
    Scene,
    Simulation,
    View,
    load_human,
    read_motion,
)
from humansim_ros.errors import ChannelError, HumansimError, RenderError
from humansim_ros.pictures import Pictured
from humansim_ros.scene.pictures import sheets
from humansim_ros.scene.pictures.sheets import Tile, plot_frame
from humansim_ros.scene.pictures.views import joint_colors

formatters = pytest.importorskip("IPython.core.formatters")
pytest.importorskip("matplotlib")

CAMERA = {"size": [320, 240], "look_at": [0, 0, 0.8]}
SCENE = {
    "room": None,
    "humans": {
        "anna": {"body": "child", "motion": "walk"},
        "ben": {"motion": {"file": "wave", "position": [0, 1]}},
    },
    "cameras": {
        "front": {**CAMERA, "position": [3, 0, 1]},
        "left": {**CAMERA, "position": [0, -3.5, 1], "sensor": {"encoding": "bgr8"}},
        "tall": {**CAMERA, "size": [100, 200], "position": [-3, 2, 1.4]},
    },
}
GREEN = (60, 230, 90)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_dict(SCENE)


@pytest.fixture(scope="module")
def frame(scene: Scene) -> Iterator[Frame]:
    with Simulation(scene) as simulation:
        yield simulation.frame(10)


def shown(item: object) -> np.ndarray:
    """The picture that a notebook shows of an object, (H, W, 3)."""
    data, _ = formatters.DisplayFormatter().format(item)
    assert data["text/plain"] == repr(item)
    return cv2.imdecode(np.frombuffer(data["image/png"], np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def colors(image: np.ndarray) -> int:
    return len(np.unique(image.reshape(-1, 3), axis=0))


@pytest.mark.nightly
@pytest.mark.gl
def test_notebooks_show_a_small_picture_of_each_object(scene: Scene, frame: Frame) -> None:
    motion = read_motion("walk")
    horse = Motion(("a", "b"), np.array([-1, 0]), np.eye(3)[:2], ((), ()), np.zeros((4, 0)), 0.1)
    items = (
        scene,
        frame,
        frame.views["front"],
        load_human("child"),
        motion,
        horse,
        scene.cameras["tall"],
        View(),
    )
    pictures = [shown(item) for item in items]
    assert [picture.shape[1] <= 640 and picture.shape[0] < 700 for picture in pictures] == [True] * len(items)
    assert all(colors(picture) > 5 for picture in pictures)
    assert colors(pictures[0]) > 20 and colors(pictures[1]) > 1000 and colors(pictures[3]) > 1000
    # a title, which says what plain text would say
    assert len({picture[:34].tobytes() for picture in pictures}) == len(items)


@pytest.mark.gl
def test_a_frame_shows_each_camera_in_its_colours_with_the_joints(frame: Frame) -> None:
    picture = sheets.picture(frame)
    tile, scale = picture[:238, :318], 318 / 320
    expected = cv2.resize(frame.views["front"].rgb, (318, 238), interpolation=cv2.INTER_AREA)
    close = np.abs(tile.astype(int) - expected).max(axis=-1) < 30
    assert close.mean() > 0.9
    joints = frame.joints["front"]["anna"]
    pixels = np.rint(joints.pixels[joints.visible == 2] * scale).astype(int)
    green = [np.abs(tile[y, x].astype(int) - GREEN).max() < 80 for x, y in pixels]
    assert np.mean(green) > 0.6
    # the left camera's sensor has bgr8: the picture has the colours of the scene
    shown_left = picture[:238, 322:].astype(float)
    right = cv2.resize(frame.views["left"].rgb[..., ::-1], (318, 238), interpolation=cv2.INTER_AREA)
    wrong = right[..., ::-1]
    assert np.abs(shown_left - right).mean() < 4 and np.abs(wrong.astype(int) - right).max() > 60


def test_a_grid_of_many_images_shows_the_first_and_says_how_many_more() -> None:
    images = [np.full((30, 40, 3), 20 * number, np.uint8) for number in range(12)]
    tiles = [Tile(image, f"camera {number}") for number, image in enumerate(images)]
    sheet = sheets._grid(tiles)
    assert sheet.shape[1] <= 640
    middles = [(2 * part + 1) / 6 for part in range(3)]
    found = [sheet[int(y * sheet.shape[0]), int(x * sheet.shape[1]), 0] for y in middles for x in middles]
    assert found == [20 * number for number in range(9)]
    assert (sheets._grid(tiles[:9]) != sheet).any()


def test_an_object_without_picture_is_shown_as_text(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera.look_at((5e6, 0, 1), (0, 0, 1))
    with pytest.warns(
        HumansimWarning, match="Camera has no picture: CameraError: a camera is more than 100 km"
    ):
        data, _ = formatters.DisplayFormatter().format(camera)
    assert data == {"text/plain": repr(camera)}
    # whatever goes wrong: no OpenGL, no memory, a broken library
    monkeypatch.setitem(sys.modules, "humansim_ros.scene.pictures.sheets", None)
    with pytest.warns(HumansimWarning, match="no picture"):
        assert formatters.DisplayFormatter().format(read_motion("walk"))[0].keys() == {"text/plain"}


def test_a_new_class_without_a_picture_is_shown_as_text() -> None:
    class Other(Pictured):
        pass

    with pytest.warns(HumansimWarning, match="there is no picture of a Other"):
        assert Other()._repr_png_() is None


def test_pictures_load_the_drawing_only_when_they_are_shown() -> None:
    names = "h.Camera, h.Motion, h.View, h.Human"
    code = f"import sys, humansim_ros as h; {names}; print('humansim_ros.scene.pictures' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


@pytest.mark.nightly
@pytest.mark.gl
def test_a_plot_shows_images_and_joints_at_their_pixels(frame: Frame) -> None:
    figure = frame.plot()
    axes = figure.axes
    assert [one.get_title() for one in axes] == ["front", "left", "tall"]
    assert "frame 10, 0.33 s" in figure.get_suptitle()
    np.testing.assert_array_equal(axes[0].images[0].get_array(), frame.views["front"].rgb)
    np.testing.assert_array_equal(axes[1].images[0].get_array(), frame.views["left"].rgb[..., ::-1])
    # the centre of the first pixel is (0, 0)
    assert axes[2].images[0].get_extent() == [-0.5, 99.5, 199.5, -0.5]
    assert axes[2].get_xlim() == (-0.5, 99.5) and axes[2].get_ylim() == (199.5, -0.5)
    _, visible_color, hidden_color = joint_colors([])
    for one, joints in zip(axes, frame.joints.values(), strict=True):
        clouds = [np.asarray(cloud.get_offsets()) for cloud in one.collections]
        for number, view in enumerate(joints.values()):
            np.testing.assert_allclose(clouds[2 * number], view.pixels[view.visible == 2])
            np.testing.assert_allclose(clouds[2 * number + 1], view.pixels[view.visible == 1])
        face, edge = one.collections[0].get_facecolor(), one.collections[1].get_edgecolor()
        np.testing.assert_allclose(face[0][:3], np.array(visible_color) / 255)
        np.testing.assert_allclose(edge[0][:3], np.array(hidden_color) / 255)
        assert len(one.collections[1].get_facecolor()) == 0
    assert sum(view.visible.tolist().count(1) for joints in frame.joints.values() for view in joints.values())
    assert not frame.plot("depth", joints=False).axes[0].collections
    assert shown(figure).shape[1] > 600


@pytest.mark.gl
def test_a_plot_without_the_channels_of_joints_has_lines_only(scene: Scene) -> None:
    with Simulation(scene, channels=("rgb",)) as simulation:
        plain = simulation.frame(10)
    axes = plain.plot().axes[0]
    assert len(axes.lines) > 20 and all(not len(cloud.get_offsets()) for cloud in axes.collections)
    x, y = axes.lines[0].get_data()
    pixels = plain.cameras["front"].project(plain.humans["anna"].positions)[0]
    assert min(np.hypot(*(pixels - [x[0], y[0]]).T)) < 1e-9
    with pytest.raises(ChannelError, match="depth"):
        plain.plot("depth")
    with pytest.raises(RenderError, match="no such channel: colour"):
        plain.plot("colour")
    sheets.picture(plain)


def test_without_matplotlib_a_plot_says_which_line_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    view = View(rgb=np.zeros((4, 6, 3), np.uint8))
    frame = Frame(0, 0, {}, {"front": view})
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(HumansimError, match=r"pip install 'humansim_ros\[plot\]'"):
        plot_frame(frame, joints=False)
    with pytest.raises(HumansimError, match="no cameras"):
        Frame(0, 0, {}, {}).plot()


def test_warnings_of_the_object_are_not_told_again(scene: Scene) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert scene._repr_png_() is not None
