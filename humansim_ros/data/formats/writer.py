"""Base class of the writers of export formats, and what a writer gets: scene, folder, settings and frames.

A writer works in two steps, so that frames can be written by several processes and an interrupted export can
go on: :meth:`FormatWriter.frame` writes the files of one frame, and returns a record for the files of the
whole export. :meth:`FormatWriter.finish` gets the records of all frames, in order, and writes these files.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypedDict
from uuid import uuid4

import numpy as np

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.engine import TEMPORARY, WORK
from humansim_ros.errors import ExportError, warn_about
from humansim_ros.files.reading import read_blocks
from humansim_ros.people.humans import Human
from humansim_ros.scene.config import AboutConfig, CameraTiming, HumanConfig
from humansim_ros.scene.core import Frame, Scene
from humansim_ros.types import Array

#: Addresses of the texts of licences by their SPDX identifier.
LICENSES = {
    "CC0-1.0": "https://creativecommons.org/publicdomain/zero/1.0/",
    "CC-BY-4.0": "https://creativecommons.org/licenses/by/4.0/",
    "CC-BY-SA-4.0": "https://creativecommons.org/licenses/by-sa/4.0/",
    "CC-BY-NC-4.0": "https://creativecommons.org/licenses/by-nc/4.0/",
    "MIT": "https://opensource.org/license/mit",
    "Apache-2.0": "https://www.apache.org/licenses/LICENSE-2.0",
}
#: Pattern for the beginning of an address (URL) of the text of a licence.
_ADDRESS = re.compile("https?://")


class FileEntry(TypedDict):
    """A file of an export, as listed in the index: hash, and size in bytes."""

    sha256: str
    bytes: int


class ExportFolder:
    """Writes files to a folder of an export. All methods raise HumansimError, which names the path, if a file
    cannot be written.

    Names are relative to the folder, with ``/``. Missing folders are created.

    Args:
        root: Folder of the whole export.
        prefix: Path of this folder relative to the root. "" is the root itself.

    Attributes:
        written: Files that were written here and in :meth:`subfolder`, by path relative to the root.
    """

    def __init__(self, root: Path, prefix: str = "") -> None:
        self.root = root
        self._prefix = f"{prefix}/" if prefix else ""
        self.written: dict[str, FileEntry] = {}

    def subfolder(self, name: str) -> ExportFolder:
        """Return a folder inside this folder. Both share :attr:`written`."""
        return self._folder(self._prefix + name)

    def root_folder(self) -> ExportFolder:
        """Return the root folder of the export. Both folders share :attr:`written`."""
        return self._folder("")

    def _folder(self, prefix: str) -> ExportFolder:
        folder = ExportFolder(self.root, prefix)
        folder.written = self.written
        return folder

    def write(self, name: str, content: bytes | str) -> None:
        """Write a file atomically. Text is UTF-8."""
        with self.path(name) as path:
            path.write_bytes(content.encode() if isinstance(content, str) else content)

    def write_temporary(self, name: str, content: bytes) -> None:
        """Write a file that exists until the export is complete. :meth:`temporary` returns its path."""
        self._folder(TEMPORARY).write(self._prefix + name, content)

    def temporary(self, name: str) -> Path:
        """Path of a file that :meth:`write_temporary` has written."""
        return self.root / TEMPORARY / f"{self._prefix}{name}"

    @contextmanager
    def path(self, name: str) -> Iterator[Path]:
        """Give a temporary path to write a file to. After the ``with`` block, the file gets its name."""
        relative = self._prefix + name
        target = self.root / relative
        # in the folder of the work, so that nothing else is left after a kill
        temporary = self.root / WORK / f".partial-{uuid4().hex}{target.suffix}"
        for folder in (target.parent, temporary.parent):
            self._make_folder(folder)
        try:
            yield temporary
            self.written[relative] = file_entry(temporary)
            temporary.replace(target)
        except OSError as reason:
            raise ExportError(f"cannot be written: {reason.strerror or reason}", path=target) from reason
        finally:
            temporary.unlink(missing_ok=True)

    def link(self, name: str, target: str) -> None:
        """Make a symbolic link to a file or folder of the export, so that no image is written twice.

        ``target``: path relative to the root of the export.
        """
        link = self.root / self._prefix / name
        self._make_folder(link.parent)
        text = os.path.relpath(self.root / target, link.parent)
        try:
            if link.is_symlink():
                link.unlink()
            link.symlink_to(text)
        except OSError as reason:
            raise ExportError(f"no link can be made: {reason.strerror or reason}", path=link) from None

    @staticmethod
    def _make_folder(folder: Path) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as reason:
            text = f"this folder cannot be made: {reason.strerror or reason}"
            raise ExportError(text, path=folder) from None


def file_entry(path: Path) -> FileEntry:
    """Hash and size of a file. Raises ExportError if it cannot be read."""
    digest, size = hashlib.sha256(), 0
    for block in read_blocks(path, ExportError, "export"):
        digest.update(block)
        size += len(block)
    return {"sha256": digest.hexdigest(), "bytes": size}


_EVERY_FRAME = CameraTiming(1.0)


@dataclass(frozen=True)
class ExportCamera:
    """A camera of an export.

    Attributes:
        camera: Calibration of the images, and pose. If the camera moves, this is the pose in the first frame.
        moves: Whether its pose changes from frame to frame.
        encoding: ROS encoding of its images, such as ``rgb8``.
        rate: Images per second. If None, the rate of the scene.
        frames: Numbers of the frames with an image of this camera.
    """

    camera: Camera
    moves: bool = False
    encoding: str = "rgb8"
    rate: float | None = None
    frames: Container[int] = _EVERY_FRAME


@dataclass(frozen=True)
class ExportScene:
    """Description of a scene for the writers of formats.

    Attributes:
        title: Name of the scene or bag.
        rate: Frames per second.
        cameras: Cameras by name.
        labels: Instance labels of people, then of labelled objects, by name.
        objects: Kind of each labelled object by name, such as ``box``.
        parts: By person: names of the body parts with label 1, 2 and so on.
        humans: Bodies without pose, by name. A bag has none.
        licenses: Licence of the body by person, for people with a known licence.
        license: Licence of data sets of the scene. Empty if the scene states none.
        simulated: The scene. None if the source is a bag.
    """

    title: str
    rate: float
    cameras: Mapping[str, ExportCamera]
    labels: Mapping[str, int]
    objects: Mapping[str, str] = field(default_factory=dict)
    parts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    humans: Mapping[str, Human] = field(default_factory=dict)
    licenses: Mapping[str, str] = field(default_factory=dict)
    license: str = ""
    simulated: Scene | None = None

    @classmethod
    def of(cls, scene: Scene) -> ExportScene:
        """Describe a scene."""
        return cls(
            title=scene.path.stem if scene.path else "scene",
            rate=scene.config.rate,
            cameras={
                name: ExportCamera(
                    *(own.camera, own.moves or own.drifts, own.encoding, own.timing.rate, own.timing)
                )
                for name, own in scene.scene_cameras.items()
            },
            labels=scene.labels,
            objects={name: Path(scene.objects[name].shape).stem for name in scene.object_labels},
            parts={name: actor.human.skeleton.names for name, actor in scene.actors.items()},
            humans={name: actor.human for name, actor in scene.actors.items()},
            licenses={name: text for name, actor in scene.actors.items() if (text := actor.human.license)},
            license=scene.config.license or "",
            simulated=scene,
        )

    @property
    def configs(self) -> Mapping[str, HumanConfig]:
        """Body, motion and outfit of each person, from the scene file. Empty for a bag."""
        return {} if self.simulated is None else self.simulated.config.humans

    @property
    def about(self) -> AboutConfig:
        """What the scene file says about its data sets. Empty for a bag."""
        return AboutConfig() if self.simulated is None else self.simulated.config.about

    @property
    def people(self) -> list[str]:
        """Names of the people."""
        return [name for name in self.labels if name not in self.objects]


#: Added to pixels of this package (centre of the first pixel at 0), gives pixels with its border at 0.
FROM_CORNER = 0.5


def corner_matrix(camera: Camera) -> Array:
    """Camera matrix (3, 3) for pixels that are measured from the corner of the image."""
    return np.array([[1, 0, FROM_CORNER], [0, 1, FROM_CORNER], [0, 0, 1]]) @ camera.K


def warn_of_lenses(program: str, cameras: Mapping[str, Camera], has_skew: bool = False) -> None:
    """Warn (HumansimWarning) of lens distortion, since a program does not support it.

    Args:
        program: Name of the program.
        cameras: Cameras by name.
        has_skew: Whether the program supports skew. If not, skew causes a warning, too.
    """
    for name, camera in cameras.items():
        lost = {"lens distortion": camera.distorted, "skew": not has_skew and camera.K[0, 1] != 0}
        for what in (key for key, is_lost in lost.items() if is_lost):
            warn_about(f"{program} camera {name}", f"{what} has no place there; calibration.yaml has it")


#: Data of a frame for :meth:`FormatWriter.finish`: JSON values and NumPy arrays. Arrays come back as lists.
Record = Any
#: Default size of shards of samples, bytes.
SHARD_SIZE = 1_000_000_000


@dataclass(frozen=True)
class ExportSettings:
    """Settings of an export.

    Attributes:
        scene: Description of the scene.
        frames: Numbers of the frames.
        keypoints: Name of the keypoint set (docs/keypoints.md).
        image_suffix: Suffix of colour images: ``.png`` or ``.jpg``.
        shard_size: Largest size of a shard of samples, bytes. A single frame may be larger.
        license: Licence of the data set, such as ``CC-BY-4.0``, or the address of its text. Empty if unknown.
    """

    scene: ExportScene
    frames: range
    keypoints: str = "coco17"
    image_suffix: str = ".png"
    shard_size: int = SHARD_SIZE
    license: str = ""

    @property
    def license_links(self) -> dict[str, str]:
        """Licence of the data set, then other licences of its people, each with the address of its text. An
        unknown address is empty."""
        people = sorted(set(self.scene.licenses.values()))
        names = dict.fromkeys([self.license, *people] if self.license else people)
        return {name: LICENSES.get(name, name if _ADDRESS.match(name) else "") for name in names}

    @property
    def rate(self) -> float:
        """Frames per second."""
        return self.scene.rate

    @property
    def cameras(self) -> Sequence[str]:
        """Names of the cameras."""
        return list(self.scene.cameras)

    def frames_of(self, camera: str) -> Sequence[int]:
        """Numbers of the frames that have an image of a camera."""
        return [index for index in self.frames if index in self.scene.cameras[camera].frames]

    def rate_of(self, camera: str) -> float:
        """Images per second of a camera."""
        return self.scene.cameras[camera].rate or self.rate

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
        frame: State of the scene at the stamp of the frame. Views have the channels that the formats need. If
            no format needs channels, there are no views.
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
    """Writes one format. Each process has its own writer, so a writer must keep no data of a frame.
    ``settings``: settings of the export."""

    def __init__(self, settings: ExportSettings) -> None:
        self.settings = settings

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the files of a frame. Returns the record that :meth:`finish` needs, or None.

        ``folder``: folder of the format.

        Raises:
            HumansimError: A file cannot be written, or the format cannot hold the frame.
        """

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Write the files of the whole export.

        Args:
            records: Number and result of :meth:`frame` for each frame, in order. It is possible to iterate
                several times.
            folder: Folder of the format.

        Raises:
            HumansimError: A file cannot be written, or the format cannot hold the frames.
        """
