"""The table of all export formats, ``config/export_formats.json``.

To add a format: a :class:`~humansim_ros.data.formats.writer.FormatWriter` in a module of its family, a row of
the table, a row of docs/export.md, and a test that reads the files with a library of the format's users.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any

from humansim_ros.data.formats.writer import FormatWriter
from humansim_ros.errors import ExportError, unknown
from humansim_ros.files.reading import read_table
from humansim_ros.render.interface import CHANNEL_TABLE
from humansim_ros.scene.core import Needs
from humansim_ros.scene.truth import REQUIRED_CHANNELS

#: Name of the format that writes the tree of colour images. Formats that name images need this format, too.
IMAGES = "images"
#: Data of a frame that formats may need in addition to image channels: boxes of bodies, 2D keypoints, 3D
#: keypoints in ``map``, bodies with vertices and bones, sweeps of laser scanners; and sweeps if the scene has
#: scanners.
BOXES, KEYPOINTS, POSITIONS, BODIES, SWEEPS = "boxes", "keypoints", "positions", "bodies", "sweeps"
ANY_SWEEPS = "any sweeps"
#: Image channels that must be rendered to compute these data.
_CHANNELS_OF = {BOXES: REQUIRED_CHANNELS["boxes"], KEYPOINTS: REQUIRED_CHANNELS["joints"]}


@dataclass(frozen=True)
class ExportFormat:
    """An export format, a row of the table.

    Attributes:
        name: Name on the command line, and name of the folder of the files.
        title: Description in one line.
        writer_name: Module and class of its writer.
        content: Data of a frame that the format needs: image channels of all cameras, and some of
            :data:`BOXES`, :data:`KEYPOINTS`, :data:`POSITIONS`, :data:`BODIES`, :data:`SWEEPS` and
            :data:`ANY_SWEEPS`.
        keypoints: Keypoint set that the format always has. Empty if there is a choice.
        images: Whether the files name colour images, so that the tree of images is written, too.
        modules: Python modules that the format needs and that the package does not install by default. extra:
            Name of the extra of the package that installs these modules.
    """

    name: str
    title: str
    writer_name: str
    content: frozenset[str] = frozenset()
    keypoints: str = ""
    images: bool = False
    modules: tuple[str, ...] = ()
    extra: str = "export"

    @property
    def writer(self) -> type[FormatWriter]:
        """Class of the writer. The module of the class is imported only now."""
        module, _, name = self.writer_name.partition(".")
        kind: type[FormatWriter] = getattr(import_module(f"humansim_ros.data.formats.{module}"), name)
        return kind

    @property
    def channels(self) -> frozenset[str]:
        """Image channels that all cameras render for the format. If empty, nothing is rendered."""
        derived = (channel for name in self.content for channel in _CHANNELS_OF.get(name, ()))
        return frozenset(derived) | (self.content & CHANNEL_TABLE.keys())

    @property
    def needs(self) -> Needs:
        """What the format needs of a frame: channels of all cameras, and sweeps of all laser scanners."""
        swept = self.content & {SWEEPS, ANY_SWEEPS}
        return Needs(self.channels, None if self.channels else (), None if swept else ())


def _read(name: str, row: Mapping[str, Any]) -> ExportFormat:
    content, modules = frozenset(row.get("content", ())), tuple(row.get("modules", ()))
    return ExportFormat(name, **{**row, "content": content, "modules": modules})


#: All formats by name, in the order in which they are written.
EXPORT_FORMATS: dict[str, ExportFormat] = {
    name: _read(name, row) for name, row in read_table("export_formats").items()
}


def chosen_formats(names: Sequence[str]) -> list[ExportFormat]:
    """Formats by names, in the order of the table, without repetitions. Format ``images`` is added if needed.

    Raises:
        ExportError: A name is unknown, there is no name, or a format needs a library that is not installed.
    """
    wanted = set(names)
    for name in names:
        if name not in EXPORT_FORMATS:
            raise ExportError(unknown("export format", name, EXPORT_FORMATS), key="--format")
    if not wanted:
        raise ExportError("give a format, such as coco; humansim export --list shows all", key="--format")
    if any(EXPORT_FORMATS[name].images for name in wanted):
        wanted.add(IMAGES)
    rows = [row for row in EXPORT_FORMATS.values() if row.name in wanted]
    for row in rows:
        if missing := [module for module in row.modules if find_spec(module) is None]:
            raise ExportError(
                f"the format {row.name} needs {', '.join(missing)}; "
                f"install it: pip install 'humansim_ros[{row.extra}]'",
                key="--format",
            )
    return rows


def needed_channels(formats: Collection[ExportFormat]) -> list[str]:
    """Image channels that a set of formats needs, in a fixed order."""
    return sorted(frozenset[str]().union(*(row.channels for row in formats)))
