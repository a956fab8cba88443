"""Images and videos for people: drawing primitives and writers."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from humansim_ros.errors import HumansimError
from humansim_ros.io.files import atomic_path
from humansim_ros.types import Image


def write_png(path: str | os.PathLike[str], image: Image) -> None:
    """Write an RGB image, whole or not at all."""
    # OpenCV 5's own choice is fast, and makes files of two to four times the size
    done, encoded = cv2.imencode(".png", image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 6])
    if not done:
        raise HumansimError("the picture cannot be encoded", path=path)
    with atomic_path(path) as temporary:
        temporary.write_bytes(encoded.tobytes())


def write_mp4(path: str | os.PathLike[str], frames: Iterable[Image], rate: float) -> None:
    """Write RGB frames of one size as an MP4 that browsers play (H.264), whole or not at all."""
    iterator = iter(frames)
    first = next(iterator, None)
    if first is None:
        raise HumansimError("there are no frames for a video", path=path)
    height, width = first.shape[0] // 2 * 2, first.shape[1] // 2 * 2
    with atomic_path(Path(path)) as temporary:
        writer = _video_writer(temporary, (width, height), rate)
        writer.send(None)
        try:
            for frame in (first, *iterator):
                writer.send(np.ascontiguousarray(frame[:height, :width]))
        finally:
            writer.close()


def _video_writer(path: Path, size: tuple[int, int], rate: float) -> Any:
    import imageio_ffmpeg

    return imageio_ffmpeg.write_frames(
        str(path), size, fps=rate, codec="libx264", quality=7, macro_block_size=2, ffmpeg_log_level="error"
    )
