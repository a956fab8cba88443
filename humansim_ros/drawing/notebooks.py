"""Pictures of objects in notebooks: scenes, frames, views, humans, motions and cameras."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import singledispatch

import cv2
import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.drawing.canvas import PAPER, TITLE_HEIGHT, draw_text, encode_png, text_size, title_bar
from humansim_ros.drawing.frames import channel_image, joints_of_camera
from humansim_ros.drawing.humans import HumanArtist
from humansim_ros.drawing.motions import StickFigureArtist, strip
from humansim_ros.drawing.rigs import camera_panel
from humansim_ros.drawing.top_view import top_view
from humansim_ros.drawing.views import color_channel, draw_joints
from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.humans.human import Human
from humansim_ros.motion.info import to_world
from humansim_ros.motion.kinematics import Motion
from humansim_ros.render import View
from humansim_ros.scene import Frame, Scene
from humansim_ros.types import Image

#: Width of the pictures in pixels.
WIDTH = 640
#: Most tiles of a grid, and pixels between them.
_MOST, _GAP = 9, 2
_TITLE = 0.5
#: Frames of a motion, and views of a human, beside each other.
_PHASES, _AZIMUTHS = 5, (0, 45, 180)


def notebook_png(item: object) -> bytes:
    """PNG file of a picture with the text of the object as its title, at most WIDTH pixels wide."""
    with warnings.catch_warnings():
        # whoever made the object has been told what is odd about it
        warnings.simplefilter("ignore", HumansimWarning)
        image = picture(item)
    return encode_png(np.concatenate([_title(repr(item), image.shape[1]), image]))


@singledispatch
def picture(item: object) -> Image:
    """Draw an object, (H, W, 3), at most WIDTH pixels wide. Raises TypeError for other classes."""
    raise TypeError(f"there is no picture of a {type(item).__name__}")


@picture.register
def _(camera: Camera) -> Image:
    return camera_panel(camera)


@picture.register
def _(scene: Scene) -> Image:
    return top_view(scene, scene.cameras, 0.0, (WIDTH, 520))


@picture.register
def _(human: Human) -> Image:
    artist = HumanArtist(human, (WIDTH // (len(_AZIMUTHS) + 1), 200))
    try:
        images = [artist.draw(human, azimuth) for azimuth in _AZIMUTHS]
        images.append(artist.draw_bones(human, _AZIMUTHS[0]))
    finally:
        artist.close()
    return np.concatenate(images, axis=1)


@picture.register
def _(motion: Motion) -> Image:
    size = (WIDTH // _PHASES, 200)
    try:
        artist = StickFigureArtist.of_world(to_world(motion), size)
    except MotionError:  # not a person
        artist = StickFigureArtist.of_file(motion, size)
    return strip([artist], _PHASES, "")[TITLE_HEIGHT:]


@picture.register
def _(view: View) -> Image:
    return _grid([color_channel(name, getattr(view, name)) for name in view.channels], view.channels)


@picture.register
def _(frame: Frame) -> Image:
    images = []
    for name in list(frame.views)[:_MOST]:
        channels = frame.views[name].channels
        image = channel_image(frame, name, channels[0])
        for skeleton, pixels, visible in joints_of_camera(frame, name):
            radius = max(2.0, image.shape[1] / 160)
            image = draw_joints(image, pixels, visible, skeleton.joint_names, skeleton.joint_parents, radius)
        images.append(image)
    return _grid(images, list(frame.views))


def _title(text: str, width: int) -> Image:
    """Bar with a text that is made smaller, and cut off, until it fits."""
    scale = float(np.clip((width - 20) / text_size(text, 1.0)[0], 0.36, _TITLE))
    while text_size(text, scale)[0] > width - 14:
        text = f"{text[:-4]}..."
    return title_bar(text, width, scale)


def _grid(images: Sequence[Image], names: Sequence[str]) -> Image:
    """Put images into a grid, at most WIDTH wide, with their names; the first of them if there are many."""
    if not images:
        return np.full((40, WIDTH, 3), PAPER, np.uint8)
    shown = list(images)[:_MOST]
    columns = math.ceil(math.sqrt(len(shown)))
    width = (WIDTH + _GAP) // columns - _GAP
    width = min(width, max(160, *(image.shape[1] for image in shown)))
    # of most images; bars are beside taller ones, and above wider ones
    aspect = min(sorted(image.shape[0] / image.shape[1] for image in shown)[len(shown) // 2], 1.0)
    height = max(8, round(width * aspect))
    rows = math.ceil(len(shown) / columns)
    sheet = np.full((rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3), 28, np.uint8)
    for number, image in enumerate(shown):
        row, column = divmod(number, columns)
        tile = sheet[row * (height + _GAP) :, column * (width + _GAP) :][:height, :width]
        scale = min(width / image.shape[1], height / image.shape[0])
        size = tuple(max(1, round(scale * side)) for side in (image.shape[1], image.shape[0]))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
        top, left = (height - size[1]) // 2, (width - size[0]) // 2
        tile[top : top + size[1], left : left + size[0]] = small
        label = names[number]
        if number == _MOST - 1 and len(names) > _MOST:
            label += f" (and {len(names) - _MOST} more)"
        for color, stroke in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            _text(tile, label, color, stroke)
    return sheet


def _text(tile: Image, label: str, color: tuple[int, int, int], stroke: int) -> None:
    """Write a label into the lower left corner of a tile, which is a part of a larger image."""
    drawn = np.ascontiguousarray(tile)
    draw_text(drawn, label, (5, drawn.shape[0] - 7), 0.4, color, stroke)
    tile[:] = drawn
