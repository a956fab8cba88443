"""What the writer of an export format gets: settings of the export, and one frame after the other.

A writer works in two steps, so that frames can be written by several processes and an interrupted export can
go on: :meth:`FormatWriter.frame` writes the files of one frame, and returns what the files of the whole
export need of it. :meth:`FormatWriter.finish` gets this from all frames, in order, and writes those files.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from humansim_ros.export.folder import ExportFolder
from humansim_ros.export.scene import ExportScene
from humansim_ros.scene import Frame

#: What a frame leaves for the files of the whole export: values of JSON and NumPy arrays. Arrays come back as
#: lists.
Record = Any
#: Size of shards of samples, bytes.
SHARD_SIZE = 1_000_000_000


@dataclass(frozen=True)
class ExportSettings:
    """Settings of an export.

    Attributes:
        scene: What is known of the scene.
        frames: Numbers of the frames.
        keypoints: Name of the keypoint set (docs/keypoints.md).
        image_suffix: Suffix of colour images: ``.png`` or ``.jpg``.
        shard_size: Largest size of a shard of samples, bytes; a frame more if one is larger.
    """

    scene: ExportScene
    frames: range
    keypoints: str = "coco17"
    image_suffix: str = ".png"
    shard_size: int = SHARD_SIZE

    @property
    def rate(self) -> float:
        """Frames per second."""
        return self.scene.rate

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the cameras."""
        return list(self.scene.cameras)

    def image(self, camera: str, index: int) -> str:
        """Path of a colour image, relative to the folder of the export."""
        return f"images/{camera}/{frame_name(index)}{self.image_suffix}"


def frame_name(index: int) -> str:
    """Name of the files of a frame, without suffix: six digits."""
    return f"{index:06d}"


@dataclass(frozen=True)
class ExportFrame:
    """One frame, for the writers of all formats.

    Attributes:
        frame: Everything of the scene at its stamp. Views have the channels that the chosen formats need;
            there are none if no format needs channels.
        settings: Settings of the export.
    """

    frame: Frame
    settings: ExportSettings

    @property
    def index(self) -> int:
        """Number of the frame in the scene, from 0."""
        return self.frame.index

    @property
    def name(self) -> str:
        """Name of the files of the frame, without suffix."""
        return frame_name(self.frame.index)

    def image(self, camera: str) -> str:
        """Path of the colour image of a camera, relative to the folder of the export."""
        return self.settings.image(camera, self.frame.index)


class FormatWriter:
    """Writes one format. There is one in each process, so it keeps nothing of a frame.

    ``settings``: settings of the export.
    """

    def __init__(self, settings: ExportSettings) -> None:
        self.settings = settings

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the files of a frame; return what :meth:`finish` needs of it, or None.

        ``folder``: folder of the format.

        Raises:
            HumansimError: A file cannot be written, or the format cannot hold the frame.
        """

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the files of the whole export.

        Args:
            records: Number and result of :meth:`frame` for each frame, in order; it may be iterated again.
            folder: Folder of the format.

        Raises:
            HumansimError: A file cannot be written, or the format cannot hold the frames.
        """
