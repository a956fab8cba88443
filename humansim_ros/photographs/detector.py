"""Run an external detector on photographs: a command that writes the 2D points of one image."""

from __future__ import annotations

import os
import shlex
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np

from humansim_ros.errors import PhotographError, printable
from humansim_ros.files.reading import temporary_folder
from humansim_ros.photographs.views import PhotoSet, default_points, read_points, read_views, write_points
from humansim_ros.types import Array

#: Placeholders in the command, which are replaced by paths of files.
IMAGE, POINTS = "{image}", "{points}"
#: Most seconds for one image.
TIMEOUT = 300.0
_KEY = "--detector"


def detect_points(
    photos: PhotoSet, command: str, report: Callable[[int, int], None] = lambda done, count: None
) -> PhotoSet:
    """Find the 2D points of all images with a command, and keep them in ``<name>_points`` next to the views.

    The command runs once for each image. ``{image}`` stands for the image, ``{points}`` for the JSON file
    that it has to write, in the form of COCO, of OpenPose or of this package. If the views file names the
    points of a view, the view keeps these points.

    ``command``: command line. It does not go through a shell. ``report``: function that is called with the
    number of finished images and the number of all images.

    Returns:
        The photographs with the points found. If the file of an image has no person, the image has no points.

    Raises:
        PhotographError: The command is wrong, fails, takes too long, or writes something else.
    """
    words = _words(command)
    chosen = [name for name in photos.names if photos.points_files[name] == default_points(photos.path, name)]
    images = {
        name: [frame[photos.names.index(name)].image_path for frame in photos.frames] for name in chosen
    }
    if not chosen:
        raise PhotographError(
            "all views name their points: remove the key points from those that the detector is for", key=_KEY
        )
    count, done = sum(len(files) for files in images.values()), 0
    for name, files in images.items():
        found: list[Array] = []
        for image in files:
            found.append(
                np.zeros((len(photos.keypoints), 3)) if image is None else _run(words, image, photos)
            )
            done += 1
            report(done, count)
        write_points(photos.points_files[name], photos.keypoints, found)
    return read_views(photos.path)


def _words(command: str) -> list[str]:
    try:
        words = shlex.split(command)
    except ValueError as reason:
        raise PhotographError(f"not a command line: {reason}", key=_KEY) from None
    if not any(IMAGE in word for word in words) or not any(POINTS in word for word in words):
        raise PhotographError(
            f"the command needs {IMAGE} and {POINTS}, such as 'python detect.py {IMAGE} {POINTS}'", key=_KEY
        )
    return words


def _run(words: list[str], image: Path, photos: PhotoSet) -> Array:
    """Points (K, 3) of one image."""
    with temporary_folder() as folder:
        output = folder / "points.json"
        line = [
            word.replace(IMAGE, os.fspath(image.absolute())).replace(POINTS, os.fspath(output))
            for word in words
        ]
        try:
            result = subprocess.run(
                line,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                timeout=TIMEOUT,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise PhotographError(f"the detector took longer than {TIMEOUT:.0f} s", path=image) from None
        except OSError as reason:
            said = f"{printable(line[0], 100)} cannot be started: {reason.strerror}"
            raise PhotographError(said, key=_KEY) from None
        if result.returncode:
            lines = [text.strip() for text in result.stderr.decode(errors="replace").splitlines()]
            last = printable(next((text for text in reversed(lines) if text), ""))
            raise PhotographError(
                f"the detector ended with exit code {result.returncode}{f': {last}' if last else ''}",
                path=image,
            )
        if not output.is_file():
            raise PhotographError(f"the detector wrote no file {POINTS}", path=image)
        return read_points(output, photos.keypoints)[0]
