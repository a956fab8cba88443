"""Options of the command line: shared options, options with lists or numbers, and renamed options."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from humansim_ros.errors import CameraError, HumansimError, SceneError
from humansim_ros.files.reading import built_in_names, exists, read_bytes, read_table, resource_path


def split_commas(values: list[str] | None) -> list[str]:
    """Split the values of a list option. The option may be repeated, and each value may be a list with
    commas.

    A value that is the name of an existing file is not split.

    Example:
        >>> split_commas(["left,right", "top"])
        ['left', 'right', 'top']
    """
    words = (word for text in values or () for word in ([text] if exists(Path(text)) else text.split(",")))
    return [word.strip() for word in words if word.strip()]


_ROWS: Mapping[str, Mapping[str, Mapping[str, Any]]] = read_table("command_line")


def option(row: str, **more: Any) -> Any:
    """Make an option of a command.

    Args:
        row: Name of a row of config/command_line.json: command and option, such as ``camera rig.height``.
        **more: Values that a table cannot contain, such as the words for completion by a shell.
    """
    return _made(typer.Option, row, more)


def argument(row: str, **more: Any) -> Any:
    """Make an argument of a command. The parameters are those of :func:`option`."""
    return _made(typer.Argument, row, more)


def list_option(row: str, complete: Callable[[str], list[str]] | None = None, **more: Any) -> Any:
    """Make an option that is a list: it may be repeated, or have commas. ``row``, ``more``: as for
    :func:`option`. ``complete``: returns the words for completion by a shell."""
    made = _made(typer.Option, row, {"callback": split_commas, "autocompletion": complete, **more})
    made.metavar += ",..."
    return made


def _made(make: Callable[..., Any], row: str, more: Mapping[str, Any]) -> Any:
    """Make an option or argument from a row of the table and further values."""
    command, _, name = row.rpartition(".")
    values = {**_ROWS[command][name], **more}
    return make(*values.pop("names", ()), **values)


# -- completion of words by shells


#: Names of export formats. They are read from a table, since importing the formats loads OpenCV and moderngl,
#: which takes too long for completion by a shell.
EXPORT_FORMATS = tuple(read_table("export_formats"))


def built_in_motions(incomplete: str) -> list[str]:
    """Complete the name of a built-in motion."""
    return _beginning(incomplete, built_in_names("motions"))


def built_in_humans(incomplete: str) -> list[str]:
    """Complete the name of a built-in human."""
    return _beginning(incomplete, built_in_names("humans"))


def joint_tables(incomplete: str) -> list[str]:
    """Complete the name of a built-in joint table."""
    return _beginning(incomplete, (path.stem for path in resource_path("config/joint_names").glob("*.yaml")))


def built_in_channels(incomplete: str) -> list[str]:
    """Complete the last channel of a list with commas."""
    from humansim_ros.render.interface import ALL_CHANNELS

    return _last_of_list(incomplete, ALL_CHANNELS)


def export_formats(incomplete: str) -> list[str]:
    """Complete the last export format of a list with commas."""
    return _last_of_list(incomplete, EXPORT_FORMATS)


def _last_of_list(incomplete: str, words: Iterable[str]) -> list[str]:
    before, comma, last = incomplete.rpartition(",")
    return [f"{before}{comma}{word}" for word in _beginning(last, words)]


def _beginning(incomplete: str, words: Iterable[str]) -> list[str]:
    return sorted(word for word in words if word.startswith(incomplete))


def existing_scenes(given: Any) -> Any:
    """Raise an error for missing scene files early, before slow imports."""
    for path in given if isinstance(given, (list, tuple)) else [given]:
        if path is not None and not exists(path):
            read_bytes(path, SceneError, "scene", 0)
    return given


def _existing_calibrations(given: Any) -> Any:
    """Raise an error for missing calibration files early. URLs are not checked."""
    for name in [given] if isinstance(given, str) else given or ():
        if not any(mark in name for mark in ("://", "#", "{")) and not exists(Path(name)):
            read_bytes(Path(name), CameraError, "calibration", 0)
    return given


# -- options that several commands share

JsonOption = Annotated[bool, option("shared.json")]
SceneArgument = Annotated[Path | None, argument("shared.scene", callback=existing_scenes)]
CalibrationArgument = Annotated[str, argument("shared.calibration", callback=_existing_calibrations)]
CalibrationsArgument = Annotated[list[str], argument("shared.calibrations", callback=_existing_calibrations)]
OutputFolderOption = Annotated[Path, option("shared.output_folder")]
OutputImageOption = Annotated[Path, option("shared.output_image")]
PictureOption = Annotated[Path | None, option("shared.picture")]
JobsOption = Annotated[int | None, option("shared.jobs")]
TopicsOption = Annotated[list[str] | None, list_option("shared.topics")]
NetworkOption = Annotated[bool, option("shared.network")]
ResumeOption = Annotated[bool, option("shared.resume")]
RayOption = Annotated[str | None, option("shared.ray")]
BodyOption = Annotated[str | None, option("shared.body", autocompletion=built_in_humans)]

# estimates of a tracker
EstimateTopicOption = Annotated[str | None, option("shared.estimate_topic")]
KeypointsOption = Annotated[str | None, option("shared.keypoints")]
NamesOption = Annotated[Path | None, option("shared.names")]
ScaleOption = Annotated[float, option("shared.scale")]
AxesOption = Annotated[str | None, option("shared.axes")]

# calibrations
SizeOption = Annotated[str | None, option("shared.size")]
ImageOption = Annotated[Path | None, option("shared.image")]
UnitOption = Annotated[float | None, option("shared.unit")]
UpOption = Annotated[str | None, option("shared.up")]
CameraOption = Annotated[list[str] | None, list_option("shared.camera")]

# motions
JointTableOption = Annotated[str | None, option("shared.joint_table", autocompletion=joint_tables)]
FacingOption = Annotated[str | None, option("shared.facing")]


# -- the command line before it is parsed


@dataclass(frozen=True)
class Renamed:
    """An option that was renamed.

    Attributes:
        old: Old name.
        new: New name.
        value: If the old name has a new meaning now: regular expression of values that have the old meaning.
    """

    old: str
    new: str
    value: str = ""


#: Version that removes the old names.
REMOVED_IN = "0.4.0"
#: Renamed options of each command.
RENAMED = {
    command: tuple(Renamed(**row) for row in rows) for command, rows in read_table("renamed_options").items()
}

#: Options that were removed from a command, and why.
GONE = {
    "record": dict.fromkeys(
        ("--shards", "--merge", "--split"),
        "--ray divides recordings by frames, and each shard is a file of one bag (--shard-frames)",
    )
}


def new_names(arguments: Sequence[str], warn: Callable[[str], object]) -> list[str]:
    """Replace renamed options of a command line. ``warn``: called with a line of text about each old name.

    Raises:
        HumansimError: An option was removed.

    Example:
        >>> new_names(["run", "--duration", "5"], print)
        --duration is now --seconds; version 0.4.0 removes the old name
        ['run', '--seconds', '5']
    """
    words = [word for word in arguments if not word.startswith("-")]
    renamed = {each.old: each for n in (1, 2) for each in RENAMED.get(" ".join(words[:n]), ())}
    gone = GONE.get(next(iter(words), ""), {})
    changed = list(arguments)
    end = changed.index("--") if "--" in changed else len(changed)
    for place, word in enumerate(changed[:end]):
        name, equals, value = word.partition("=")
        if name in gone:
            raise HumansimError(f"{name} has gone: {gone[name]}")
        found = renamed.get(name)
        following = value if equals else next(iter(changed[place + 1 : end]), "")
        if found is not None and (not found.value or re.fullmatch(found.value, following)):
            changed[place] = f"{found.new}{equals}{value}"
            warn(f"{found.old} is now {found.new}; version {REMOVED_IN} removes the old name")
    return changed


_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
#: Options with several numbers: the text that joins the numbers, and the largest count of numbers.
_SEVERAL = {"--size": ("x", 2), "--distortion": (" ", 14)}
#: Options with a number that may be left out, and the default number.
_DEFAULT_NUMBERS = {"--clock": "100"}


def join_numbers(arguments: Sequence[str]) -> list[str]:
    """Join the numbers after an option into one text: ``--size 640 480`` becomes ``--size 640x480``.

    If an optional number is left out, it is added: ``--clock`` becomes ``--clock 100``.

    Example:
        >>> join_numbers(["rig", "--size", "640", "480", "--distortion", "-0.3", "1e-2", "-o", "cams"])
        ['rig', '--size', '640x480', '--distortion', '-0.3 1e-2', '-o', 'cams']
    """
    joined: list[str] = []
    pending = list(arguments)
    while pending:
        joined.append(pending.pop(0))
        separator, most = _SEVERAL.get(joined[-1], ("", 0))
        numbers: list[str] = []
        while pending and len(numbers) < most and _NUMBER.fullmatch(pending[0]):
            numbers.append(pending.pop(0))
        if numbers:
            joined.append(separator.join(numbers))
        elif joined[-1] in _DEFAULT_NUMBERS and not (pending and _NUMBER.fullmatch(pending[0])):
            joined.append(_DEFAULT_NUMBERS[joined[-1]])
    return joined


def parse_size(text: str) -> tuple[int, int]:
    """Parse width and height from a text such as 640x480. Raises HumansimError if this fails."""
    matched = re.fullmatch(r"([0-9]{1,6})\s*[xX×,*\s]\s*([0-9]{1,6})", text.strip(), re.ASCII)
    if matched is None:
        raise HumansimError(f"--size: needs width and height, such as 640x480, not {text!r}")
    return int(matched[1]), int(matched[2])
