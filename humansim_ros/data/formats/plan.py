"""Plan of an export: everything that determines its files. An export is continued only with the same plan."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from humansim_ros.data.formats.source import ExportSource
from humansim_ros.data.formats.writer import SHARD_SIZE
from humansim_ros.errors import MAX_FRAMES, ExportError
from humansim_ros.files.reading import ANY_SIZE, package_version, read_json
from humansim_ros.scene.config import checked_license

#: Name of the index: the file of an export with its plan. In a complete export the index also lists all files
#: with their hashes.
INDEX = "index.json"
_KEY = "humansim_export"
#: Key in the index of a data set of many scenes (``data_set.py``).
DATA_SET_KEY = "humansim_data_set"
#: Version of the layout of the index.
_LAYOUT = 1


@dataclass(frozen=True)
class ExportPlan:
    """Everything that determines the files of an export.

    Attributes:
        scene: Hash of the source: of the scene and of the files that it names, or of the bag.
        first: Number of the first frame.
        end: Number of the last frame plus one.
        formats: Names of the formats, with ``images`` if other formats need it.
        image_suffix: Suffix of colour images, ``.png`` or ``.jpg``.
        keypoints: Name of the keypoint set.
        shard_size: Size of shards of samples, bytes.
        device: Device that renders. Other devices round differently. Empty if nothing is rendered.
        version: Version of this package.
        license: Licence of the data set. Empty if unknown.
    """

    scene: str
    first: int
    end: int
    formats: tuple[str, ...]
    image_suffix: str
    keypoints: str
    shard_size: int
    device: str
    version: str = field(default_factory=package_version)
    license: str = ""

    @classmethod
    def of(
        cls,
        source: ExportSource,
        frames: range | None = None,
        image_suffix: str = ".png",
        shard_size: int = SHARD_SIZE,
        license: str = "",
        device: str | None = None,
    ) -> ExportPlan:
        """Plan the export of a scene or bag on this machine.

        Args:
            source: The scene or bag, with the formats.
            frames: Range of frame numbers, with step 1. If None, all frames of a bag.
            image_suffix: Suffix of colour images, ``.png`` or ``.jpg``.
            shard_size: Size of shards of samples, bytes.
            license: Licence of the data set, such as ``CC-BY-4.0``, or the address of its text. If empty, the
                licence of the scene.
            device: Name of the device that renders here. If None, it is found out.

        Raises:
            ExportError: There are no such frames, or the licence is no line of text.
            RenderError: OpenGL is missing.
        """
        frames = _checked_frames(frames, source.count)
        try:
            license = checked_license(license) or source.scene.license
        except ValueError as error:
            raise ExportError(str(error), key="--license") from None
        return cls(
            scene=source.hash,
            first=frames.start,
            end=frames.stop,
            formats=tuple(row.name for row in source.formats),
            image_suffix=image_suffix,
            keypoints=source.keypoints,
            shard_size=shard_size,
            device=source.device() if device is None else device,
            license=license,
        )

    @property
    def frames(self) -> range:
        """Numbers of the frames."""
        return range(self.first, self.end)

    def index(self, **more: Any) -> str:
        """Text of the index. ``more``: further entries for a complete export."""
        content = {_KEY: _LAYOUT, "finished": False, "plan": asdict(self), **more}
        return json.dumps(content, indent=1) + "\n"


def read_index(folder: Path) -> dict[str, Any]:
    """Content of the index of an export. Raises ExportError if the folder or its index is missing."""
    path = folder / INDEX
    if not path.exists():
        raise ExportError("there is no export here", path=path)
    index = read_json(path, ExportError, "index", ANY_SIZE)
    if isinstance(index, dict) and DATA_SET_KEY in index:
        scenes = ", such as " + next(iter(index["scenes"])) if index.get("scenes") else ""
        raise ExportError(f"this is a data set of many scenes: give the folder of one{scenes}", path=folder)
    if not isinstance(index, dict) or index.get(_KEY) != _LAYOUT:
        raise ExportError("this is not the index of an export of this version", path=path)
    return index


def _checked_frames(frames: range | None, count: int | None) -> range:
    """Check that frames exist, and return them; if None, all. ``count``: existing frames; None for no end."""
    if frames is None:
        if count is None:
            raise ExportError("a scene has no end: give a number of frames, such as 300", key="--frames")
        return range(count)
    if count is not None and frames.stop > count:
        raise ExportError(f"the bag has {count} frames, so that the last one is {count - 1}", key="--frames")
    return frames


def parse_range(text: str) -> range:
    """Parse a range of frames ``A:B``: from A up to, but not including, B. ``:B`` begins with 0.

    Raises:
        ExportError: The text has another form, or the range is empty.
    """
    first, colon, end = text.strip().rpartition(":")
    words = (first or "0", end)
    if colon and all(word.isascii() and word.isdecimal() and len(word) < 10 for word in words):
        frames = range(int(words[0]), int(words[1]))
        if len(frames) and frames.stop <= MAX_FRAMES:
            return frames
    raise ExportError(
        f"a range is A:B, from A up to, but not including, B, such as 0:300; not {text!r}", key="--range"
    )
