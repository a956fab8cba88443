"""Plan of an export: everything that determines its files, by which a continued export recognises itself."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from humansim_ros import __version__
from humansim_ros.bounds import MAX_FRAMES
from humansim_ros.errors import ExportError
from humansim_ros.export.formats import chosen_formats, needed_channels
from humansim_ros.io.files import ANY_SIZE, read_text
from humansim_ros.keypoints.sets import keypoint_set
from humansim_ros.render.context import OpenGLContext
from humansim_ros.scene import Scene
from humansim_ros.scene.scene_hash import scene_hash

#: File of an export with its plan; when the export is complete, also with all files and their hashes.
INDEX = "index.json"
_KEY = "humansim_export"
#: Version of the layout of the index.
_LAYOUT = 1


@dataclass(frozen=True)
class ExportPlan:
    """Everything that determines the files of an export.

    Attributes:
        scene: Hash of the scene and of the files that it names.
        first: Number of the first frame.
        end: Number after that of the last frame.
        formats: Names of the formats, images included if others need them.
        image_suffix: Suffix of colour images, ``.png`` or ``.jpg``.
        keypoints: Name of the keypoint set.
        device: Device that renders: others round differently. Empty if nothing is rendered.
        version: Version of this package.
    """

    scene: str
    first: int
    end: int
    formats: tuple[str, ...]
    image_suffix: str
    keypoints: str
    device: str
    version: str = __version__

    @classmethod
    def of(
        cls, scene: Scene, frames: range, formats: Sequence[str], image_suffix: str, keypoints: str
    ) -> ExportPlan:
        """Plan the export of a scene on this machine.

        Args:
            scene: The scene.
            frames: Numbers of the frames, without steps.
            formats: Names of formats.
            image_suffix: Suffix of colour images, ``.png`` or ``.jpg``.
            keypoints: Name of the keypoint set.

        Raises:
            ExportError: A format is unknown, or needs a library that is not installed.
            KeypointError: There is no such keypoint set.
            RenderError: OpenGL is missing.
        """
        rows = chosen_formats(formats)
        keypoint_set(keypoints)
        device = ""
        if needed_channels(rows):
            context = OpenGLContext()
            device = context.device
            context.close()
        names = tuple(row.name for row in rows)
        return cls(scene_hash(scene), frames.start, frames.stop, names, image_suffix, keypoints, device)

    @property
    def frames(self) -> range:
        """Numbers of the frames."""
        return range(self.first, self.end)

    def index(self, **more: Any) -> str:
        """Text of the index. ``more``: other entries, when the export is complete."""
        content = {_KEY: _LAYOUT, "finished": False, "plan": asdict(self), **more}
        return json.dumps(content, indent=1) + "\n"

    def check_continues(self, folder: Path) -> bool:
        """Check that a folder has this export, and return whether it is complete.

        Raises:
            ExportError: The folder has none, or another one.
        """
        index = read_index(folder)
        try:
            values = index["plan"]
            there = ExportPlan(**{**values, "formats": tuple(values["formats"])})
        except (KeyError, TypeError):
            raise ExportError("this index has no plan: the export cannot be continued", path=folder) from None
        texts = [
            self._difference(name, there)
            for name in (field.name for field in fields(self))
            if getattr(self, name) != getattr(there, name)
        ]
        if texts:
            raise ExportError(f"this folder has another export: {'; '.join(texts)}", path=folder)
        return bool(index["finished"])

    def _difference(self, name: str, there: ExportPlan) -> str:
        """What differs in a field from the plan of a folder, in words."""
        if name == "scene":
            return "the scene or a file of it has changed"
        before, now = _text(getattr(there, name)), _text(getattr(self, name))
        return f"{name.replace('_', ' ')}: {before} there, {now} now"


def read_index(folder: Path) -> dict[str, Any]:
    """Content of the index of an export. Raises ExportError without a folder, or without an index in it."""
    path = folder / INDEX
    if not path.exists():
        raise ExportError("there is no export here", path=path)
    try:
        index = json.loads(read_text(path, ExportError, "index", ANY_SIZE))
    except ValueError:
        index = None
    if not isinstance(index, dict) or index.get(_KEY) != _LAYOUT:
        raise ExportError("this is not the index of an export of this version", path=path)
    return index


def parse_frames(text: str) -> range:
    """Numbers of frames of ``A:B``: from A up to, but not including, B. ``:B`` and ``B`` begin with 0.

    Raises:
        ExportError: The text has another form, or there is no frame between.
    """
    first, _, end = text.strip().rpartition(":")
    words = (first or "0", end)
    if all(word.isascii() and word.isdecimal() and len(word) < 10 for word in words):
        frames = range(int(words[0]), int(words[1]))
        if len(frames) and frames.stop <= MAX_FRAMES:
            return frames
    raise ExportError(
        f"frames are A:B, from A up to, but not including, B, such as 0:300; not {text!r}", key="--frames"
    )


def _text(value: Any) -> str:
    return ", ".join(value) if isinstance(value, tuple) else str(value)
