"""Draw images that people look at: lines, text, palettes; and write PNG and video files.

Images are (H, W, 3) sRGB. Pixels are (x, y); the centre of the top-left pixel is (0, 0), as in OpenCV.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from humansim_ros.errors import HumansimError
from humansim_ros.files.reading import atomic_path, write_file
from humansim_ros.types import Array, Color, Image

#: Background, text and grid lines.
PAPER: Color = (238, 240, 243)
INK: Color = (60, 64, 72)
GRID: Color = (205, 209, 215)
#: Colours of the left side (1), the right side (-1) and the middle (0) of a body, on a light background.
SIDE_COLORS: dict[int, Color] = {1: (38, 116, 200), -1: (206, 62, 92), 0: INK}
#: Bright colours of left, right and middle, for photographs.
BRIGHT_SIDE_COLORS: dict[int, Color] = {1: (80, 170, 255), -1: (255, 110, 150), 0: (250, 220, 90)}
#: Height in pixels of a title bar.
TITLE_HEIGHT = 34
_FONT = cv2.FONT_HERSHEY_SIMPLEX
#: Number of fractional bits of OpenCV's pixel coordinates: drawing is exact to 1 / 2^4 pixel.
_SHIFT = 4
#: Coordinates are clipped at this distance, pixels, so that they fit OpenCV's integers.
_FARTHEST = 1e4
#: Step from one hue to the next in a list of colours: the golden ratio, so that neighbours differ much.
_HUE_STEP = 0.61803398875


def draw_line(image: Image, pixels: ArrayLike, color: Color, width: int = 1) -> None:
    """Draw a polyline.

    Args:
        image: Image that is drawn on.
        pixels: Points of the polyline, (N, 2).
        color, width: Colour of the line, and its width in pixels.
    """
    cv2.polylines(image, [_fixed_point(pixels)], False, color, width, cv2.LINE_AA, _SHIFT)


def draw_disc(image: Image, pixel: ArrayLike, radius: float, color: Color, width: int = -1) -> None:
    """Draw a disc or a circle.

    Args:
        image: Image that is drawn on.
        pixel, radius: Centre, (2,), and radius in pixels.
        color: Colour of the disc or circle.
        width: Width of the circle in pixels. -1 draws a disc.
    """
    x, y = _fixed_point(pixel).tolist()
    cv2.circle(image, (x, y), round(radius * 2**_SHIFT), color, width, cv2.LINE_AA, _SHIFT)


def fill_polygon(image: Image, pixels: ArrayLike, color: Color, opacity: float) -> None:
    """Fill a polygon.

    Args:
        image: Image that is drawn on.
        pixels: Corners of the polygon, (N, 2).
        color, opacity: Colour of the polygon, and its opacity between 0 and 1.
    """
    over = image.copy()
    cv2.fillPoly(over, [_fixed_point(pixels)], color, cv2.LINE_AA, _SHIFT)
    cv2.addWeighted(over, opacity, image, 1 - opacity, 0, dst=image)


def draw_text(
    image: Image, text: str, position: tuple[int, int], scale: float, color: Color = INK, width: int = 1
) -> None:
    """Draw text. Its lower left corner is at a pixel.

    Args:
        image: Image that is drawn on.
        text: One line of text.
        position: (x, y) of the lower left corner in pixels.
        scale: Font scale of OpenCV. 0.5 is about 11 pixels high.
        color: Colour of the text.
        width: Width of the strokes in pixels.
    """
    cv2.putText(image, text, position, _FONT, scale, color, width, cv2.LINE_AA)


def text_size(text: str, scale: float) -> tuple[int, int]:
    """Width and height of a line of text in pixels."""
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, 1)
    return width, height


def title_bar(text: str, width: int, scale: float = 0.55) -> Image:
    """White bar with a title, (TITLE_HEIGHT, width, 3)."""
    bar = np.full((TITLE_HEIGHT, width, 3), 255, np.uint8)
    draw_text(bar, text, (10, 23), scale)
    return bar


def titled_rows(title: str, rows: Sequence[Image]) -> Image:
    """Put rows of images below each other, under a title. Gaps have the background colour."""
    width = max(each.shape[1] for each in rows)
    wide = [np.full((each.shape[0], width, 3), PAPER, np.uint8) for each in rows]
    for whole, each in zip(wide, rows, strict=True):
        whole[:, : each.shape[1]] = each
    return np.concatenate([title_bar(title, width), *wide])


def row(images: Sequence[Image], labels: Sequence[str]) -> Image:
    """Put images side by side, each with a label in its corner."""
    for image, label in zip(images, labels, strict=True):
        draw_text(image, label, (8, 18), 0.42)
    return np.concatenate(list(images), axis=1)


def hsv_colors(hue: ArrayLike, saturation: ArrayLike, value: ArrayLike) -> NDArray[np.uint8]:
    """RGB colours (N, 3) of hues (N,) from 0 to 180, saturations and values from 0 to 255."""
    hsv = np.stack(np.broadcast_arrays(hue, saturation, value), axis=-1).astype(np.uint8)
    if not len(hsv):  # OpenCV takes no empty image
        return hsv
    return np.asarray(cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0], dtype=np.uint8)


def distinct_hues(count: int) -> Array:
    """Hues (N,) from 0 to 180. Neighbouring hues differ much."""
    return np.asarray(np.arange(count) * _HUE_STEP % 1 * 180)


def write_png(path: str | os.PathLike[str], image: Image) -> None:
    """Write an RGB image as a PNG file, atomically."""
    write_file(path, encode_png(image))


def encode_png(image: Image) -> bytes:
    """Return the bytes of a PNG file of an RGB image. Raises HumansimError if the image cannot be encoded."""
    # the default compression of OpenCV 5 is fast, and makes files two to four times as large
    done, encoded = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not done:
        raise HumansimError("the image cannot be encoded")
    return bytes(encoded.tobytes())


def write_mp4(path: str | os.PathLike[str], frames: Iterable[Image], rate: float) -> None:
    """Write RGB frames of one size atomically, as H.264 in MP4, which browsers play."""
    _write_video(path, frames, rate, even=True, codec="libx264", quality=7, macro_block_size=2)


def write_gif(path: str | os.PathLike[str], frames: Iterable[Image], rate: float) -> None:
    """Write RGB frames of one size atomically, as a GIF with a palette per frame."""
    palette = "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1:dither=none"
    form: dict[str, Any] = {"codec": "gif", "pix_fmt_out": "pal8", "macro_block_size": 1, "quality": None}
    _write_video(path, frames, rate, output_params=["-filter_complex", palette], **form)


def _write_video(
    path: str | os.PathLike[str], frames: Iterable[Image], rate: float, even: bool = False, **options: Any
) -> None:
    """Write RGB frames. ``even``: crop the frames to even sides, as H.264 needs."""
    import imageio_ffmpeg

    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise HumansimError("there are no frames for a video", path=path)
    height, width = (side // 2 * 2 if even else side for side in first.shape[:2])
    with atomic_path(Path(path)) as temporary:
        writer = imageio_ffmpeg.write_frames(
            str(temporary), (width, height), fps=rate, ffmpeg_log_level="error", **options
        )
        writer.send(None)
        count = 0
        try:
            for frame in (first, *iterator):
                pixels, count = np.ascontiguousarray(frame[:height, :width]), count + 1
                try:
                    writer.send(pixels)
                except OSError:  # ffmpeg has ended
                    raise _video_error(path) from None
        finally:
            writer.close()
        try:
            # the exit code of ffmpeg is lost; on a full disk it leaves an incomplete file
            written, _ = imageio_ffmpeg.count_frames_and_secs(str(temporary))
        except RuntimeError:
            written = 0
        if written != count:
            raise _video_error(path)


def _video_error(path: str | os.PathLike[str]) -> HumansimError:
    return HumansimError("ffmpeg cannot write the video; is the disk full?", path=path)


def _fixed_point(pixels: ArrayLike) -> NDArray[np.int32]:
    """Convert pixels to the fixed-point integers that OpenCV draws with."""
    finite = np.nan_to_num(np.asarray(pixels, dtype=float), nan=-_FARTHEST)
    return np.rint(np.clip(finite, -_FARTHEST, _FARTHEST) * 2**_SHIFT).astype(np.int32)
