"""Options and arguments that several commands share."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated

import typer

from humansim_ros.errors import HumansimError
from humansim_ros.io.assets import built_in_names
from humansim_ros.resources import resource_path

JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]

CalibrationArgument = Annotated[
    str, typer.Argument(help="Calibration file of any format, folder of such files, or URL.")
]
CalibrationsArgument = Annotated[
    list[str], typer.Argument(help="Calibration files of any format, folders of such files, or URLs.")
]
SizeOption = Annotated[
    str | None, typer.Option(help="Image size, as 640x480 or 640 480; overrides the size in the file.")
]
ImageOption = Annotated[Path | None, typer.Option(help="Image (.png, .jpg) that has the image size.")]
UnitOption = Annotated[
    float | None, typer.Option(help="Metres per unit of the file; that of its format if absent.")
]
UpOption = Annotated[
    str | None,
    typer.Option(help="Axis of the file that points up, such as y or -z; that of its format if absent."),
]
CameraOption = Annotated[
    list[str] | None,
    typer.Option("--camera", help="Use only cameras with this name or pattern, such as left or 'S9_*'."),
]
OutputFolderOption = Annotated[
    Path, typer.Option("--output", "-o", help="Output folder; it is created if it is missing.")
]

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", re.ASCII)
#: Options with several numbers: how their values are joined, and the most that there may be.
_SEVERAL = {"--size": ("x", 2), "--distortion": (" ", 14)}
#: Options whose number may be left out, and the number that they have then.
_DEFAULT_NUMBERS = {"--clock": "100"}


def join_numbers(arguments: Sequence[str]) -> list[str]:
    """Join the numbers after options that take them as one text: ``--size 640 480`` is ``--size 640x480``.

    Options whose number may be left out get one: ``--clock`` is ``--clock 100``.

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
    """Width and height of text such as 640x480. Raises HumansimError."""
    matched = re.fullmatch(r"([0-9]{1,6})\s*[xX×,*\s]\s*([0-9]{1,6})", text.strip(), re.ASCII)
    if matched is None:
        raise HumansimError(f"--size: needs width and height, such as 640x480, not {text!r}")
    return int(matched[1]), int(matched[2])


# -- words that shells complete

#: Export formats: their own table loads OpenCV and moderngl, for which a shell would wait.
EXPORT_FORMATS = (
    *("images", "depth-png", "depth-exr", "depth-npy", "labels", "flow-flo", "flow-kitti", "coco", "yolo"),
    *("mot", "thesis", "mp4", "openpose", "anipose", "trc", "c3d", "panoptic", "human36m", "bvh", "glb"),
    *("webdataset", "croissant"),
)


def motions(incomplete: str) -> list[str]:
    """Built-in motions."""
    return _beginning(incomplete, built_in_names("motions"))


def humans(incomplete: str) -> list[str]:
    """Built-in humans."""
    return _beginning(incomplete, built_in_names("humans"))


def joint_tables(incomplete: str) -> list[str]:
    """Built-in joint tables."""
    return _beginning(incomplete, (path.stem for path in resource_path("config/joint_names").glob("*.yaml")))


def channels(incomplete: str) -> list[str]:
    """Channels, the last of several with commas between them."""
    from humansim_ros.render.channels import ALL_CHANNELS

    return _last_of_list(incomplete, ALL_CHANNELS)


def export_formats(incomplete: str) -> list[str]:
    """Export formats, the last of several with commas between them."""
    return _last_of_list(incomplete, EXPORT_FORMATS)


def _last_of_list(incomplete: str, words: Iterable[str]) -> list[str]:
    before, comma, last = incomplete.rpartition(",")
    return [f"{before}{comma}{word}" for word in _beginning(last, words)]


def _beginning(incomplete: str, words: Iterable[str]) -> list[str]:
    return sorted(word for word in words if word.startswith(incomplete))
