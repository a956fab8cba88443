"""Draw sheets of pictures: a snapshot of a scene, and what notebooks show of objects."""

from __future__ import annotations

import io
import math
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import singledispatch
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import ChannelError, HumansimError, HumansimWarning, MotionError, SceneError
from humansim_ros.motion.body import Motion, Skeleton
from humansim_ros.motion.pose import to_world
from humansim_ros.people.humans import Human
from humansim_ros.render.interface import CHANNEL_TABLE, View, check_channels
from humansim_ros.render.pictures import PAPER, TITLE_HEIGHT, draw_text, encode_png, text_size, title_bar
from humansim_ros.scene.core.camera import SceneCamera
from humansim_ros.scene.core.frame import Frame
from humansim_ros.scene.core.needs import Needs
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.core.simulation import Simulation
from humansim_ros.scene.pictures.people import HumanArtist, StickFigureArtist, strip
from humansim_ros.scene.pictures.rigs import camera_panel
from humansim_ros.scene.pictures.top_view import top_view
from humansim_ros.scene.pictures.views import channel_picture, color_channel, draw_joints, joint_colors
from humansim_ros.scene.truth.camera_truth import OCCLUDED, OUTSIDE, REQUIRED_CHANNELS, VISIBLE
from humansim_ros.types import Array, Image

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Skeleton, pixels (J, 2) and visibility (J,) of the joints of a human in an image.
SeenJoints = tuple[Skeleton, Array, NDArray[np.uint8]]

_BACKGROUND, _TITLE_COLOR = 28, (235, 235, 235)
#: Pixels between tiles, and height of the title of a sheet.
_GAP, _HEAD = 4, 36
#: Channels that may be interpolated between pixels.
_SMOOTH = {"rgb", "alpha", "shadow"}


@dataclass(frozen=True)
class Tile:
    """A picture of a sheet.

    Attributes:
        image: Image (H, W, 3) of any size.
        label: Text in the lower left corner.
        channel: Channel that the image shows. Labels and depth are not interpolated between pixels.
        joints: Joints that are drawn over the image.
    """

    image: Image
    label: str
    channel: str = "rgb"
    joints: Collection[SeenJoints] = ()

    def draw(self, size: tuple[int, int]) -> Image:
        """Draw the picture in the middle of a tile of a size (width, height), as large as possible."""
        rows, columns = self.image.shape[:2]
        scale = min(size[0] / columns, size[1] / rows)
        smaller = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        method = smaller if self.channel in _SMOOTH else cv2.INTER_NEAREST
        width, height = (max(1, round(scale * side)) for side in (columns, rows))
        image: Image = np.asarray(cv2.resize(self.image, (width, height), interpolation=method), np.uint8)
        radius = float(np.clip(min(width, height) / 120, 1, 4))
        for skeleton, pixels, visible in self.joints:
            names, parents = skeleton.joint_names, skeleton.joint_parents
            image = draw_joints(image, scale * (pixels + 0.5) - 0.5, visible, names, parents, radius)
        tile = np.full((size[1], size[0], 3), _BACKGROUND, np.uint8)
        top, left = (size[1] - height) // 2, (size[0] - width) // 2
        tile[top : top + height, left : left + width] = image
        self._write_label(tile)
        return tile

    def _write_label(self, tile: Image) -> None:
        height, width = tile.shape[:2]
        size, label = float(np.clip(width / 700, 0.3, 0.6)), self.label
        while label and text_size(label, size)[0] > width - 8:
            label = label[:-1]
        for color, stroke in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            draw_text(tile, label, (5, height - 7), size, color, stroke)


def arranged(tiles: Sequence[Image], columns: int) -> Image:
    """Put tiles of one size in rows of ``columns`` tiles, with gaps. A tile may be less high than others."""
    height, width = max(len(tile) for tile in tiles), tiles[0].shape[1]
    rows = math.ceil(len(tiles) / columns)
    shape = rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3
    sheet = np.full(shape, _BACKGROUND, np.uint8)
    for number, tile in enumerate(tiles):
        top, left = number // columns * (height + _GAP), number % columns * (width + _GAP)
        sheet[top : top + len(tile), left : left + width] = tile
    return sheet


def sheet(title: str, tiles: Sequence[Image], columns: int) -> Image:
    """Put tiles of one size, (H, W, 3), in rows of ``columns`` tiles, below a title."""
    body = arranged(tiles, columns)
    head = np.full((_HEAD, body.shape[1], 3), _BACKGROUND, np.uint8)
    scale = min(0.62, 0.62 * (head.shape[1] - 16) / text_size(title, 0.62)[0])
    draw_text(head, title, (8, 24), scale, _TITLE_COLOR)
    return np.concatenate([head, body])


def channel_image(frame: Frame, camera: str, channel: str) -> Image:
    """Picture (H, W, 3) of a channel of one camera. Raises ChannelError if the frame lacks the channel."""
    return channel_picture(frame.views[camera], channel, frame.encodings.get(camera, "rgb8"))


def joints_of_camera(frame: Frame, camera: str) -> Iterator[SeenJoints]:
    """Yield the joints of each human in a camera's image. In a frame without the channels ``depth``,
    ``instance`` and ``part``, all joints count as outside."""
    try:
        seen = {name: (view.pixels, view.visible) for name, view in frame.truth[camera].joints.items()}
    except ChannelError:
        seen = {}
        for name, human in frame.humans.items():
            pixels = frame.cameras[camera].project(human.positions)[0]
            seen[name] = pixels, np.full(len(pixels), OUTSIDE, np.uint8)
    for name, (pixels, visible) in seen.items():
        yield frame.models[name].skeleton, pixels, visible


# --- a snapshot: the images of all cameras at one time, joints, and a plan

#: Longest side of a sheet in pixels. A larger sheet is scaled down.
MAX_SIDE = 8192
#: Least and greatest width that callers may ask for.
WIDTHS = (160, MAX_SIDE)
#: Images of cameras with fewer pixels than this are enlarged, so that joints are visible.
_SMALL = 320
#: Number of pixels that are rendered per pixel of the sheet, along each axis.
_OVERSAMPLING = 2


@dataclass(frozen=True)
class _Layout:
    """Blocks of ``columns`` cameras, each with a row of tiles for every channel. ``columns``: cameras in a
    block. ``tile``: width and height of a tile in pixels."""

    columns: int
    tile: tuple[int, int]

    @classmethod
    def of(cls, sizes: Sequence[tuple[int, int]], channels: int, width: int) -> _Layout:
        """Layout of cameras with image sizes (width, height) on a sheet of at most ``width`` pixels."""
        columns = min(len(sizes), math.ceil(math.sqrt(len(sizes) * channels)))
        aspect = min(max(height / width for width, height in sizes), 1.5)
        largest = max(_SMALL, *(width for width, _ in sizes))
        rows = math.ceil(len(sizes) / columns) * channels
        across = min((width + _GAP) // columns - _GAP, largest)
        tallest = (MAX_SIDE - _HEAD) / rows - _GAP
        across = max(8, min(across, int(tallest / aspect)))
        return cls(columns, (across, max(8, round(across * aspect))))


def snapshot(
    scene: Scene,
    seconds: float = 0.0,
    channels: Collection[str] = ("rgb",),
    width: int = 1600,
    joints: bool = True,
    above: bool = True,
) -> Image:
    """Draw what all cameras of a scene see at one time, and the scene from above, as one sheet (H, W, 3).

    Cameras are rendered one after the other, with at most twice the pixels of their tile along each axis. So
    time and memory do not grow with the size of their images.

    Args:
        scene: The scene.
        seconds: Scene time of the picture. The nearest frame is drawn.
        channels: Channels to draw (docs/ground_truth.md). Each channel is a row.
        width: Greatest width of the sheet in pixels, 160 to 8192. The height follows, up to 8192.
        joints: Whether joints are drawn over rgb. Green discs are visible joints, orange circles hidden
            joints.
        above: Whether the last tile shows the scene from above: cameras with their views, people and their
            paths.

    Raises:
        HumansimError: A channel does not exist, or the time or the width is out of range.
    """
    check_channels(channels)
    channels = [name for name in CHANNEL_TABLE if name in channels]
    if not channels:
        raise SceneError("a snapshot needs a channel, such as rgb")
    if not WIDTHS[0] <= width <= WIDTHS[1]:
        raise SceneError(f"a snapshot is {WIDTHS[0]} to {WIDTHS[1]} pixels wide, not {width}")
    if not 0 <= seconds <= 1e6:
        raise SceneError(f"the time of a snapshot is 0 to 1000000 seconds, not {seconds:g}")
    overlay = joints and "rgb" in channels and bool(scene.actors)
    rendered = {*channels, *(REQUIRED_CHANNELS["joints"] if overlay else ())}
    index = round(seconds * scene.config.rate)
    sizes = [camera.camera.size for camera in scene.scene_cameras.values()]
    layout = _Layout.of(sizes + [_middle(sizes)] * above, len(channels), width)
    cameras = {name: _reduced(camera, layout.tile) for name, camera in scene.scene_cameras.items()}
    scene = replace(scene, scene_cameras=cameras).at_full_rate()
    columns = []
    posed: dict[str, Camera] = {}
    seconds = index / scene.config.rate
    with Simulation(scene) as simulation:
        for name in cameras:
            frame = simulation.frame(index, Needs(rendered, [name]))
            posed |= frame.cameras
            columns.append(arranged(_channel_tiles(frame, name, channels, layout.tile, overlay), 1))
    if above:
        across = layout.tile[0]
        high = min(len(channels) * (layout.tile[1] + _GAP) - _GAP, round(1.2 * across))
        columns.append(top_view(scene, posed, seconds, (across, high)))
    origin = "scene" if scene.path is None else scene.path.name
    counts = f"{_count(cameras, 'camera')}, {_count(scene.actors, 'human')}"
    return sheet(f"{origin} at {seconds:.2f} s: {counts}", columns, layout.columns)


def _middle(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Size (width, height) of the camera with the median aspect ratio."""
    return sorted(sizes, key=lambda size: size[1] / size[0])[len(sizes) // 2]


def _reduced(camera: SceneCamera, tile: tuple[int, int]) -> SceneCamera:
    """Return the camera with a smaller image: twice the pixels of its tile along each axis. A camera with an
    image that is not larger is returned unchanged."""
    width, height = camera.camera.size
    scale = _OVERSAMPLING * min(tile[0] / width, tile[1] / height)
    if scale >= 1:
        return camera
    return camera.smaller((max(1, round(scale * width)), max(1, round(scale * height))))


def _count(things: Mapping[str, object], word: str) -> str:
    return f"{len(things)} {word}{'' if len(things) == 1 else 's'}"


def _channel_tiles(
    frame: Frame, name: str, channels: Sequence[str], size: tuple[int, int], overlay: bool
) -> list[Image]:
    """Draw the channels of one camera as tiles of a size. ``overlay``: draw the joints over rgb."""
    tiles = []
    for channel in channels:
        label = f"{name}  {channel}" if len(channels) > 1 else name
        joints = list(joints_of_camera(frame, name)) if channel == "rgb" and overlay else []
        tiles.append(Tile(channel_image(frame, name, channel), label, channel, joints).draw(size))
    return tiles


# --- pictures that notebooks show of objects: scenes, frames, views, humans, motions and cameras

#: Width of the pictures in pixels.
WIDTH = 640
#: Most tiles of a grid.
_MOST = 9
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
    return _grid([Tile(color_channel(name, getattr(view, name)), name, name) for name in view.channels])


@picture.register
def _(frame: Frame) -> Image:
    tiles = []
    for name, view in frame.views.items():
        channel = view.channels[0]
        joints = list(joints_of_camera(frame, name))
        tiles.append(Tile(channel_image(frame, name, channel), name, channel, joints))
    return _grid(tiles)


def _title(text: str, width: int) -> Image:
    """Draw a bar with a title. A title that is too long is made smaller or, as a last resort, cut off."""
    scale = float(np.clip((width - 20) / text_size(text, 1.0)[0], 0.36, _TITLE))
    while text_size(text, scale)[0] > width - 14:
        text = f"{text[:-4]}..."
    return title_bar(text, width, scale)


def _grid(tiles: Sequence[Tile]) -> Image:
    """Arrange tiles in a grid, at most WIDTH wide. At most nine tiles are shown."""
    if not tiles:
        return np.full((40, WIDTH, 3), PAPER, np.uint8)
    shown = list(tiles[:_MOST])
    if len(tiles) > _MOST:
        shown[-1] = replace(shown[-1], label=f"{shown[-1].label} (and {len(tiles) - _MOST} more)")
    columns = math.ceil(math.sqrt(len(shown)))
    width = (WIDTH + _GAP) // columns - _GAP
    width = min(width, max(160, *(tile.image.shape[1] for tile in shown)))
    # of most images; bars are next to taller ones, and above wider ones
    aspects = sorted(tile.image.shape[0] / tile.image.shape[1] for tile in shown)
    height = max(8, round(width * min(aspects[len(shown) // 2], 1.0)))
    return arranged([tile.draw((width, height)) for tile in shown], columns)


# --- a plot of a frame by matplotlib

#: Width of a camera in a plot, inches.
_INCHES = 4.0


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
