"""What readers of detections in images need to know of the truth, and files of cameras."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from humansim_ros.errors import EvaluationError
from humansim_ros.keypoints import KeypointSet


class ImageNumbers(Protocol):
    """Images of a truth: their cameras, numbers and sizes, and the set of its keypoints."""

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the cameras."""

    @property
    def keypoints(self) -> KeypointSet:
        """Set of the keypoints."""

    def number(self, camera: str, frame: int) -> int | None:
        """Number of the image of a camera in a frame; None if there is none."""

    def size(self, number: int) -> tuple[int, int] | None:
        """Width and height of an image; None if there is none with this number."""


def camera_folders(path: Path, suffix: str, images: ImageNumbers) -> dict[str, list[Path]]:
    """Files by camera.

    A folder for each camera has its name, with or without ``_json`` at the end; below ``pose`` as in a
    project of Pose2Sim, below ``instance`` as in an export.
    With one camera, the files may be in the folder itself.

    Args:
        path: The folder.
        suffix: Suffix of the files, such as ``.json``.
        images: Images of the truth.

    Raises:
        EvaluationError: There is no file of a camera of the truth.
    """
    found: dict[str, list[Path]] = {}
    for root in (path, path / "pose", path / "instance"):
        for camera in images.cameras:
            for folder in (root / f"{camera}_json", root / camera):
                if files := sorted(folder.glob(f"*{suffix}")):
                    found.setdefault(camera, files)
    if not found and (path.name.removesuffix("_json") in images.cameras or len(images.cameras) == 1):
        name = path.name.removesuffix("_json")
        camera = name if name in images.cameras else images.cameras[0]
        if files := sorted(path.glob(f"*{suffix}")):
            found[camera] = files
    if not found:
        raise EvaluationError(
            f"no {suffix} file of a camera: a folder for each is needed, with its name "
            f"({', '.join(list(images.cameras)[:6])})",
            path=path,
        )
    return found


def image_of(path: Path, camera: str, images: ImageNumbers) -> int:
    """Number of the image whose frame is the last number in the name of a file. Raises EvaluationError."""
    found = re.findall(r"\d+", path.stem.replace("_keypoints", ""))
    if not found:
        raise EvaluationError("the name of the file needs the number of its frame at the end", path=path)
    number = images.number(camera, int(found[-1]))
    if number is None:
        raise EvaluationError(f"the truth has no frame {int(found[-1])} of {camera}", path=path)
    return number
