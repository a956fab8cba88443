"""Pictures that notebooks show of objects: scenes, frames, views, humans, motions and cameras."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Iterator, Sequence
from functools import singledispatch
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import ChannelError, HumansimError, HumansimWarning, MotionError
from humansim_ros.motion.body import Motion, Skeleton
from humansim_ros.motion.pose import to_world
from humansim_ros.people.humans import Human
from humansim_ros.render.interface import View, check_channels
from humansim_ros.render.pictures import PAPER, TITLE_HEIGHT, draw_text, encode_png, text_size, title_bar
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.core.simulation import Frame
from humansim_ros.scene.pictures.people import HumanArtist, StickFigureArtist, strip
from humansim_ros.scene.pictures.rigs import camera_panel
from humansim_ros.scene.pictures.top_view import top_view
from humansim_ros.scene.pictures.views import channel_picture, color_channel, draw_joints, joint_colors
from humansim_ros.scene.truth.camera_truth import OCCLUDED, OUTSIDE, VISIBLE
from humansim_ros.types import Array, Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Width of the pictures in pixels.
WIDTH = 640
#: Most tiles of a grid, and pixels between them.
_MOST, _GAP = 9, 2
_TITLE = 0.5
#: In a picture: number of frames of a motion, and azimuths of the views of a human, degrees.
_PHASES, _AZIMUTHS = 5, (0, 45, 180)


def notebook_png(item: object) -> bytes:
    """Draw an object. Returns a PNG file, at most WIDTH pixels wide, with the text of the object as title."""
    with warnings.catch_warnings():
        # the warnings were shown when the object was made
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
    """Draw a bar with a title. A title that is too long is made smaller or, as a last resort, cut off."""
    scale = float(np.clip((width - 20) / text_size(text, 1.0)[0], 0.36, _TITLE))
    while text_size(text, scale)[0] > width - 14:
        text = f"{text[:-4]}..."
    return title_bar(text, width, scale)


def _grid(images: Sequence[Image], names: Sequence[str]) -> Image:
    """Arrange images with their names in a grid, at most WIDTH wide. At most nine images are shown."""
    if not images:
        return np.full((40, WIDTH, 3), PAPER, np.uint8)
    shown = list(images)[:_MOST]
    columns = math.ceil(math.sqrt(len(shown)))
    width = (WIDTH + _GAP) // columns - _GAP
    width = min(width, max(160, *(image.shape[1] for image in shown)))
    # of most images; bars are next to taller ones, and above wider ones
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
    """Write a label into the lower left corner of a tile. The tile is a part of a larger image."""
    drawn = np.ascontiguousarray(tile)
    draw_text(drawn, label, (5, drawn.shape[0] - 7), 0.4, color, stroke)
    tile[:] = drawn


# --- frames of a simulation: pictures of a channel, joints, and a plot by matplotlib

#: Width of a camera in a plot, inches.
_INCHES = 4.0


def channel_image(frame: Frame, camera: str, channel: str) -> Image:
    """Picture (H, W, 3) of a channel of one camera. Raises ChannelError if the frame lacks the channel."""
    return channel_picture(frame.views[camera], channel, frame.encodings.get(camera, "rgb8"))


def joints_of_camera(frame: Frame, camera: str) -> Iterator[tuple[Skeleton, Array, NDArray[np.uint8]]]:
    """Yield skeleton, pixels (J, 2) and visibility (J,) of each human in a camera's image. In a frame without
    the channels ``depth``, ``instance`` and ``part``, all joints count as outside."""
    try:
        seen = {name: (view.pixels, view.visible) for name, view in frame.truth[camera].joints.items()}
    except ChannelError:
        seen = {}
        for name, human in frame.humans.items():
            pixels = frame.cameras[camera].project(human.positions)[0]
            seen[name] = pixels, np.full(len(pixels), OUTSIDE, np.uint8)
    for name, (pixels, visible) in seen.items():
        yield frame.models[name].skeleton, pixels, visible


def plot_frame(frame: Frame, channel: str = "rgb", joints: bool = True) -> Figure:
    """Plot a channel of all cameras with matplotlib. :meth:`Frame.plot` describes the parameters."""
    check_channels([channel])
    if not frame.views:
        raise HumansimError("the frame has no cameras to plot")
    pictures = {name: channel_image(frame, name, channel) for name in frame.views}
    figure_class = _figure_class()
    columns = math.ceil(math.sqrt(len(pictures)))
    rows = math.ceil(len(pictures) / columns)
    aspect = max(picture.shape[0] / picture.shape[1] for picture in pictures.values())
    size = (_INCHES * columns, (_INCHES * min(aspect, 2.0) + 0.3) * rows + 0.4)
    figure = figure_class(figsize=size, layout="constrained")
    figure.suptitle(f"frame {frame.index}, {frame.scene_time * 1e-9:.2f} s")
    for number, (name, picture) in enumerate(pictures.items(), 1):
        axes = figure.add_subplot(rows, columns, number, title=name)
        axes.imshow(picture)  # the centre of the top-left pixel is (0, 0), as everywhere here
        if joints:
            _plot_joints(axes, frame, name)
        height, width = picture.shape[:2]
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        axes.tick_params(labelsize="x-small")
    return figure


def _plot_joints(axes: Axes, frame: Frame, camera: str) -> None:
    """Plot the joints of all humans: lines to their parents, green if visible, orange circles if hidden."""
    for skeleton, pixels, visible in joints_of_camera(frame, camera):
        names, parents = skeleton.joint_names, skeleton.joint_parents
        number = {name: index for index, name in enumerate(names)}
        lines, shown, hidden = joint_colors(names)
        for name, parent, color in zip(names, parents, lines, strict=True):
            if parent is not None:
                x, y = pixels[[number[parent], number[name]]].T
                axes.plot(x, y, color=np.array(color) / 255, linewidth=1)
        inside = np.isfinite(pixels).all(axis=1)
        looks: tuple[dict[str, Any], ...] = (
            {"color": [np.array(shown) / 255]},
            {"facecolors": "none", "edgecolors": [np.array(hidden) / 255]},
        )
        for state, look in zip((VISIBLE, OCCLUDED), looks, strict=True):
            x, y = pixels[inside & (visible == state)].T
            axes.scatter(x, y, s=9, zorder=3, **look)


def _figure_class() -> type[Figure]:
    """Return a class of figures that notebooks show. Raises HumansimError if matplotlib is missing."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        text = "plots need matplotlib; install it with: pip install 'humansim_ros[plot]'"
        raise HumansimError(text) from None

    class FrameFigure(Figure):
        """Figure that notebooks show although it is made without pyplot, which would keep it in memory."""

        def _repr_png_(self) -> bytes:
            file = io.BytesIO()
            self.savefig(file, format="png")
            return file.getvalue()

    return FrameFigure
