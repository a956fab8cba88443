"""Draw a snapshot of a scene: one sheet with the images of all cameras at one time, joints, and a plan."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import SceneError
from humansim_ros.render.interface import CHANNEL_TABLE, check_channels
from humansim_ros.render.pictures import draw_text, text_size
from humansim_ros.scene.core.camera import SceneCamera
from humansim_ros.scene.core.scene import Scene
from humansim_ros.scene.core.simulation import Frame, Simulation
from humansim_ros.scene.pictures.top_view import top_view
from humansim_ros.scene.pictures.views import channel_picture, draw_joints
from humansim_ros.types import Image

#: Longest side of a sheet in pixels. A larger sheet is scaled down.
MAX_SIDE = 8192
#: Least and greatest width that callers may ask for.
WIDTHS = (160, MAX_SIDE)
#: Images of cameras with fewer pixels than this are enlarged, so that joints are visible.
_SMALL = 320
_BACKGROUND, _TITLE_COLOR = 28, (235, 235, 235)
_GAP, _HEAD = 4, 36
#: Number of pixels that are rendered per pixel of the sheet, along each axis.
_OVERSAMPLING = 2
#: Channels that may be interpolated between pixels.
_SMOOTH = {"rgb", "alpha", "shadow"}
_JOINT_CHANNELS = ("depth", "instance", "part")


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
    rendered = [*channels, *(name for name in _JOINT_CHANNELS if overlay and name not in channels)]
    index = round(seconds * scene.config.rate)
    sizes = [camera.camera.size for camera in scene.scene_cameras.values()]
    layout = _Layout.of(sizes + [_middle(sizes)] * above, len(channels), width)
    cameras = {name: _reduced(camera, layout.tile) for name, camera in scene.scene_cameras.items()}
    scene = replace(scene, scene_cameras=cameras).at_full_rate()
    tiles = []
    posed: dict[str, Camera] = {}
    seconds = index / scene.config.rate
    with Simulation(scene, channels=rendered) as simulation:
        for name in cameras:
            frame = simulation.frame(index, cameras=[name])
            posed |= frame.cameras
            tiles.append(_tiles(scene, frame, name, channels, layout.tile, overlay))
    if above:
        tiles.append(_from_above(scene, posed, seconds, layout.tile, len(channels)))
    origin = "scene" if scene.path is None else scene.path.name
    counts = f"{_count(cameras, 'camera')}, {_count(scene.actors, 'human')}"
    return _sheet(tiles, layout, f"{origin} at {seconds:.2f} s: {counts}")


def _middle(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Size (width, height) of the camera with the median aspect ratio."""
    return sorted(sizes, key=lambda size: size[1] / size[0])[len(sizes) // 2]


def _from_above(
    scene: Scene, cameras: Mapping[str, Camera], seconds: float, tile: tuple[int, int], rows: int
) -> list[Image]:
    """Draw the scene from above, as a column of tiles. ``cameras``: cameras of the scene at their poses.
    ``tile``: width and height of a tile. ``rows``: number of tiles."""
    width, height = tile
    whole = rows * (height + _GAP) - _GAP
    column = np.full((rows * (height + _GAP), width, 3), _BACKGROUND, np.uint8)
    used = min(whole, round(1.2 * width))
    column[:used] = top_view(scene, cameras, seconds, (width, used))
    return [
        column[row * (height + _GAP) :][: height + (_GAP if row < rows - 1 else 0)] for row in range(rows)
    ]


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


def _tiles(
    scene: Scene, frame: Frame, name: str, channels: Sequence[str], size: tuple[int, int], overlay: bool
) -> list[Image]:
    """Pictures of the channels of one camera. ``channels``: channels to draw. ``size``: width and height of a
    tile. ``overlay``: draw the joints over rgb."""
    view, camera = frame.views[name], scene.scene_cameras[name]
    out = []
    for channel in channels:
        picture = channel_picture(view, channel, camera.sensor.config.encoding)
        tile, scale = _fitted(picture, size, channel in _SMOOTH)
        if channel == "rgb" and overlay:
            radius = float(np.clip(min(tile.shape[:2]) / 120, 1, 4))
            for human, seen in frame.truth[name].joints.items():
                skeleton, pixels = scene.actors[human].human.skeleton, scale * (seen.pixels + 0.5) - 0.5
                joints = seen.visible, skeleton.joint_names, skeleton.joint_parents
                tile = draw_joints(tile, pixels, *joints, radius)
        out.append(_on_tile(tile, size, name, channel if len(channels) > 1 else ""))
    return out


def _fitted(image: Image, size: tuple[int, int], smooth: bool) -> tuple[Image, float]:
    """Scale an image so that it fits into a size. Returns the image and the scale."""
    scale = min(size[0] / image.shape[1], size[1] / image.shape[0])
    inner = tuple(max(1, round(scale * side)) for side in (image.shape[1], image.shape[0]))
    method = cv2.INTER_NEAREST if not smooth else cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(image, inner, interpolation=method), dtype=np.uint8), scale


def _on_tile(image: Image, size: tuple[int, int], name: str, channel: str) -> Image:
    """Put an image into the middle of a tile, with the names of its camera and channel."""
    tile = np.full((size[1], size[0], 3), _BACKGROUND, np.uint8)
    top, left = (size[1] - image.shape[0]) // 2, (size[0] - image.shape[1]) // 2
    tile[top : top + image.shape[0], left : left + image.shape[1]] = image
    scale = float(np.clip(size[0] / 700, 0.3, 0.6))
    label = f"{name}  {channel}".rstrip()
    while label and text_size(label, scale)[0] > size[0] - 8:
        label = label[:-1]
    for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        draw_text(tile, label, (5, size[1] - 7), scale, color, thickness)
    return tile


def _sheet(tiles: Sequence[Sequence[Image]], layout: _Layout, title: str) -> Image:
    """Arrange the tiles (cameras, channels) in blocks of cameras, below a title."""
    (width, height), columns = layout.tile, layout.columns
    count = len(tiles[0])
    rows = math.ceil(len(tiles) / columns) * count
    shape = (_HEAD + rows * (height + _GAP) - _GAP, columns * (width + _GAP) - _GAP, 3)
    sheet = np.full(shape, _BACKGROUND, np.uint8)
    for camera, pictures in enumerate(tiles):
        block, column = divmod(camera, columns)
        for channel, picture in enumerate(pictures):
            top = _HEAD + (block * count + channel) * (height + _GAP)
            left = column * (width + _GAP)
            sheet[top : top + len(picture), left : left + width] = picture
    scale = min(0.62, 0.62 * (shape[1] - 16) / text_size(title, 0.62)[0])
    draw_text(sheet, title, (8, 24), scale, _TITLE_COLOR)
    return sheet
