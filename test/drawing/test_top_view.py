"""A scene from above: cameras, people, paths and coverage at their places; scenes that are hard to draw.

And images of rigs.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from humansim_ros import Scene
from humansim_ros.cameras.camera.rigs import Optics, Rig
from humansim_ros.errors import CameraError
from humansim_ros.render.pictures import INK, distinct_hues, hsv_colors
from humansim_ros.scene.pictures.rigs import coverage_image, rig_image
from humansim_ros.scene.pictures.top_view import CHEST, coverage_colors, top_view

CAMERAS = {
    "south": {"position": [0.5, -3, 2], "look_at": [0, 0, 0.8], "fov_deg": 50},
    "east": {"position": [4, 0.5, 2], "look_at": [0, 0, 0.8], "fov_deg": 50},
    "north": {"position": [-1, 3.5, 2], "look_at": [0, 0, 0.8], "fov_deg": 50},
}


def scene(**sections: Any) -> Scene:
    return Scene.from_dict({"room": None, "cameras": CAMERAS, **sections})


def to_pixels(image: np.ndarray, cameras: dict[str, Any]) -> np.ndarray:
    """Pixel of a point (x, y, 1) of the floor, (2, 3), by the discs of three cameras."""
    dark = (np.abs(image.astype(int) - INK).max(axis=-1) < 12).astype(np.uint8)
    count, _, _, discs = cv2.connectedComponentsWithStats(cv2.erode(dark, np.ones((4, 4), np.uint8)))
    assert count == 1 + len(cameras)
    centers = np.array([camera.center[:2] for camera in cameras.values()])
    # one scale, y up
    scale = np.ptp(discs[1:], axis=0) / np.ptp(centers, axis=0)
    assert scale[0] == pytest.approx(scale[1], rel=0.02)
    matrix = np.array([[scale[0], 0, 0], [0, -scale[1], 0]])
    matrix[:, 2] = discs[1:].min(axis=0) - (centers * [1, -1] * scale).min(axis=0)
    for disc in discs[1:]:
        assert np.linalg.norm(at(matrix, centers) - disc, axis=1).min() < 1.5
    return matrix


def at(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    return points @ matrix[:, :2].T + matrix[:, 2]


def color_at(image: np.ndarray, pixel: np.ndarray) -> np.ndarray:
    x, y = np.rint(pixel).astype(int)
    return image[y, x].astype(int)


def test_people_are_where_they_are_and_their_paths_are_where_they_go() -> None:
    walk = {"file": "walk", "loop": "continue"}
    humans = {
        "anna": {"motion": {**walk, "position": [-1.5, -1.0]}},
        "ben": {"motion": {**walk, "position": [1.0, 1.2], "yaw_deg": 90}},
    }
    world = scene(humans=humans)
    image = top_view(world, world.cameras, 2.0, (800, 800))
    matrix = to_pixels(image, world.cameras)
    for actor, color in zip(world.actors.values(), hsv_colors(distinct_hues(2), 230, 200), strict=True):
        hips = actor.at(2.0).positions[0, :2]
        np.testing.assert_allclose(color_at(image, at(matrix, hips)), color, atol=4)
        line = [at(matrix, actor.at(2.0 + later).positions[0, :2]) for later in (3.0, 6.0, 9.8)]
        near = [
            color_at(image, pixel + np.array([x, y]))
            for pixel in line
            for x in (-1, 0, 1)
            for y in (-1, 0, 1)
        ]
        close = np.abs(np.array(near) - color).max(axis=1).reshape(3, 9).min(axis=1) < 60
        assert close.all()


def test_a_motion_that_jumps_to_its_start_leaves_no_line_across() -> None:
    world = scene(humans={"anna": {"motion": {"file": "walk", "loop": "repeat", "position": [-1, 0]}}})
    path = world.actors["anna"].joint_paths(np.arange(0, 10, 0.1))[:, 0, :2]
    jump = int(np.linalg.norm(np.diff(path, axis=0), axis=1).argmax())
    gap = path[jump : jump + 2]
    assert np.linalg.norm(np.diff(gap, axis=0)) > 1
    image = top_view(world, world.cameras, 0.0, (800, 800))
    matrix = to_pixels(image, world.cameras)
    color = hsv_colors(distinct_hues(1), 230, 200)[0].astype(int)
    middle = gap.mean(axis=0)
    # the walk bends: its path keeps away from the straight line between its ends
    assert np.linalg.norm(path - middle, axis=1).min() > 0.05
    assert np.abs(color_at(image, at(matrix, middle)) - color).max() > 60


def test_the_floor_has_the_colour_of_the_number_of_cameras_that_see_it() -> None:
    world = scene()
    image = top_view(world, world.cameras, 0.0, (800, 800))
    matrix = to_pixels(image, world.cameras)
    _, _, colors = coverage_colors(3)
    pale = 0.55 * colors.astype(float) + 0.45 * 255
    rng, right, counts = np.random.default_rng(2), 0, set()
    points = rng.uniform([-2.5, -2.2], [3.2, 2.8], (300, 2))
    for point in points:
        count = 0
        for camera in world.cameras.values():
            pixel = camera.project(np.array([[*point, CHEST]]))[0][0]
            count += bool((pixel > -0.5).all() and (pixel < np.array(camera.size) - 0.5).all())
        counts.add(count)
        right += bool(np.abs(color_at(image, at(matrix, point)) - pale[count]).max() < 3)
    # the rest is on grid lines, cameras, names and borders between the colours
    assert counts == {0, 1, 2, 3} and right > 0.8 * len(points)


def test_a_room_ends_the_coverage_and_furniture_and_objects_are_drawn() -> None:
    cameras = {"eye": {"position": [-2, -2, 2], "look_at": [3, 3, 1], "fov_deg": 100}}
    bare = Scene.from_dict({"room": None, "cameras": cameras})
    room = Scene.from_dict({"room": {"size": [6, 6, 2.8]}, "cameras": cameras})
    more = Scene.from_dict(
        {
            "room": {"size": [6, 6, 2.8]},
            "cameras": cameras,
            "objects": {"box": {"mesh": "box", "position": [0, 0, 0.5], "size": [1, 2, 1]}},
        }
    )
    outside, inside, with_box = (top_view(one, one.cameras, 0.0, (600, 600)) for one in (bare, room, more))
    _, colors, _ = coverage_colors(1)
    seen = np.rint(0.55 * np.array(colors[1]) + 0.45 * 255)

    def colored(image: np.ndarray) -> np.ndarray:
        return np.argwhere((np.abs(image[:570].astype(int) - seen) < 2).all(axis=-1))

    # the field of view goes on to the edge of a plan without walls
    assert colored(outside).max(axis=0)[1] > 590 > colored(inside).max(axis=0)[1] + 20
    changed = np.argwhere((inside != with_box).any(axis=-1))
    height, width = np.ptp(changed, axis=0) + 1
    assert height / width == pytest.approx(2, rel=0.06)


@pytest.mark.daily("size1-alone and straight down")
@pytest.mark.parametrize(
    "cameras",
    [
        {"far": {"position": [5000, 0, 2], "look_at": [0, 0, 1]}},
        {"down": {"position": [0, 0, 3], "look_at": [0, 0, 0], "up": [1, 0, 0]}},
        {f"eye_{n}": {"position": [n, 1, 2], "look_at": [0, 0, 1]} for n in range(1, 40)},
    ],
    ids=["far away", "alone and straight down", "many"],
)
@pytest.mark.parametrize("size", [(8, 8), (30, 200), (640, 480)])
def test_scenes_that_are_hard_to_draw_have_a_plan(cameras: dict[str, Any], size: tuple[int, int]) -> None:
    world = Scene.from_dict({"room": None, "cameras": cameras, "humans": {"anna": {"motion": "walk"}}})
    image = top_view(world, world.cameras, 0.0, size)
    assert image.shape == (size[1], size[0], 3) and np.ptp(image) > 30


TARGET = np.array([0.5, -1.0, 1.1])
OPTICS = Optics((640, 480), np.radians(50))
FISHEYE = Optics((640, 480), np.radians(170), (0.02, -0.005, 0.001, 0.0), "equidistant")


def test_cameras_are_drawn_at_their_positions() -> None:
    cameras = Rig(TARGET, 3, 2.2, OPTICS).ring(5) | {"inner": OPTICS.camera((1, 0, 1), (0, 0, 1))}
    above = rig_image(cameras)[60:, 44:620].astype(int)
    colored = (np.ptp(above, axis=-1) > 50).astype(np.uint8)
    count, _, _, dots = cv2.connectedComponentsWithStats(cv2.erode(colored, np.ones((5, 5), np.uint8)))
    assert count == 1 + 6
    places = np.array([camera.center for camera in cameras.values()])[:, :2] * [1, -1]
    # one scale and one shift take all cameras to their dots
    scale = np.ptp(dots[1:], axis=0) / np.ptp(places, axis=0)
    assert scale[0] == pytest.approx(scale[1], rel=0.01)
    drawn = (places - places.min(0)) * scale + dots[1:].min(0)
    for place in drawn:
        assert np.linalg.norm(dots[1:] - place, axis=1).min() < 1


def test_one_camera_many_cameras_and_distant_cameras_are_drawn() -> None:
    far = OPTICS.camera((500, -300, 2), (499, -300, 1))
    for cameras in (
        {"far": far},
        {"far": far, "near": OPTICS.camera((1, 0, 1), (0, 0, 1))},
        Rig(TARGET, 4, optics=FISHEYE).dome(40),
    ):
        assert np.ptp(rig_image(cameras)[60:, :1200]) > 100
    assert coverage_image({"far": far}).shape[1] == 2 * 770
    with pytest.raises(CameraError, match="no cameras"):
        rig_image({})
    with pytest.raises(CameraError, match="in metres"):
        rig_image({"lost": OPTICS.camera((5e6, 0, 0), (0, 0, 0))})
    for area in ((0, 0, 0, 1), (0, 0, np.nan, 1), (0, 0, 1e9, 1)):
        with pytest.raises(CameraError) as caught:
            coverage_image({"far": far}, area=area)
        assert caught.value.key == "area"
