"""Options that several commands share, lists and numbers as values, and old names of options."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from humansim_ros.errors import CameraError, HumansimError, SceneError
from humansim_ros.io.assets import built_in_names, resource_path
from humansim_ros.io.files import exists, read_bytes


def split_commas(values: list[str] | None) -> list[str]:
    """Values of an option that is a list: it may be repeated, and has commas between its words.

    The name of a file that exists may have a comma.

    Example:
        >>> split_commas(["left,right", "top"])
        ['left', 'right', 'top']
    """
    words = (word for text in values or () for word in ([text] if exists(Path(text)) else text.split(",")))
    return [word.strip() for word in words if word.strip()]


def list_option(
    name: str, metavar: str, help: str, complete: Callable[[str], list[str]] | None = None
) -> Any:
    """An option that is a list, by repetition or commas.

    Args:
        name: Name of the option.
        metavar: What one word of the list is.
        help: Help text.
        complete: Words that a shell offers.
    """
    return typer.Option(
        name, metavar=f"{metavar},...", help=help, callback=split_commas, autocompletion=complete
    )


def output_option(metavar: str, help: str) -> Any:
    """Option ``--output``, ``-o``: a file or folder to write."""
    return typer.Option("--output", "-o", metavar=metavar, help=help)


# -- words that shells complete

#: Export formats: their own table loads OpenCV and moderngl, for which a shell would wait.
EXPORT_FORMATS = (
    *("images", "depth-png", "depth-exr", "depth-npy", "labels", "body-parts", "materials", "flow-flo"),
    *("flow-kitti", "coco", "yolo", "mot", "thesis", "kitti", "nuscenes", "aicity", "foxglove", "rerun"),
    *("mp4", "openpose", "anipose", "trc", "c3d", "panoptic", "human36m", "bvh", "glb", "webdataset"),
    "croissant",
)


def built_in_motions(incomplete: str) -> list[str]:
    """Built-in motions."""
    return _beginning(incomplete, built_in_names("motions"))


def built_in_humans(incomplete: str) -> list[str]:
    """Built-in humans."""
    return _beginning(incomplete, built_in_names("humans"))


def joint_tables(incomplete: str) -> list[str]:
    """Built-in joint tables."""
    return _beginning(incomplete, (path.stem for path in resource_path("config/joint_names").glob("*.yaml")))


def built_in_channels(incomplete: str) -> list[str]:
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


def existing_scenes(given: Any) -> Any:
    """Refuse scenes that are missing, before the libraries of the core are imported."""
    for path in given if isinstance(given, (list, tuple)) else [given]:
        if path is not None and not exists(path):
            read_bytes(path, SceneError, "scene", 0)
    return given


def _existing_calibrations(given: Any) -> Any:
    """The same for calibrations; an URL may have any form."""
    for name in [given] if isinstance(given, str) else given or ():
        if not any(mark in name for mark in ("://", "#", "{")) and not exists(Path(name)):
            read_bytes(Path(name), CameraError, "calibration", 0)
    return given


# -- options that several commands share

JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
SceneArgument = Annotated[
    Path | None,
    typer.Argument(help="Scene file (YAML); the demo scene if absent.", callback=existing_scenes),
]
CalibrationArgument = Annotated[
    str,
    typer.Argument(
        help="Calibration file of any format, folder of such files, or URL.", callback=_existing_calibrations
    ),
]
CalibrationsArgument = Annotated[
    list[str],
    typer.Argument(
        help="Calibration files of any format, folders of such files, or URLs.",
        callback=_existing_calibrations,
    ),
]
OutputFolderOption = Annotated[Path, output_option("DIR", "Output folder; it is created if it is missing.")]
OutputImageOption = Annotated[Path, output_option("FILE", "Output image (.png).")]
PictureOption = Annotated[
    Path | None, typer.Option("--picture", metavar="FILE", help="Also draw the result (.png).")
]
JobsOption = Annotated[
    int | None,
    typer.Option(
        "--jobs", metavar="N", help="Number of worker processes; one per core if absent.", min=1, max=1024
    ),
]
TopicsOption = Annotated[
    list[str] | None,
    list_option("--topics", "TOPIC", "Topics, or patterns such as '/left/*'."),
]
NetworkOption = Annotated[
    bool,
    typer.Option(
        "--network", help="Let other hosts find the nodes, receive their messages and control them."
    ),
]
ResumeOption = Annotated[
    bool,
    typer.Option("--resume", help="Continue what was interrupted, or start it; give the same options."),
]
RayOption = Annotated[
    str | None,
    typer.Option(
        "--ray",
        metavar="ADDRESS",
        help="Work on a Ray cluster: auto, HOST:PORT or ray://HOST:PORT; local starts Ray here with --jobs "
        "workers.",
    ),
]
BodyOption = Annotated[
    str | None,
    typer.Option(
        "--body",
        metavar="BODY",
        help="Body: built-in (`humansim human list`), or a file (.npz, .yaml, .obj, .glb …).",
        autocompletion=built_in_humans,
    ),
]

# estimates of a tracker
EstimateTopicOption = Annotated[
    str | None,
    typer.Option(
        "--estimate",
        metavar="TOPIC",
        help="Topic of the tracker's poses, such as /tracker/poses; * stands for the name of a person.",
    ),
]
KeypointsOption = Annotated[
    str | None,
    typer.Option(
        "--keypoints",
        metavar="SET",
        help="Keypoint set of the estimate, such as coco17; by the names of its joints if absent.",
    ),
]
NamesOption = Annotated[
    Path | None,
    typer.Option(
        "--names",
        metavar="FILE",
        help="YAML file with the name in the truth of each joint of the estimate; for points "
        "without names, a list.",
    ),
]
ScaleOption = Annotated[
    float,
    typer.Option(
        "--scale", metavar="METRES", help="Metres of a unit of the estimate; 0.001 for millimetres.", min=1e-9
    ),
]
AxesOption = Annotated[
    str | None,
    typer.Option(
        "--axes",
        metavar="AXES",
        help="Axes of the estimate: z-up, y-up, y-down, or its axes along x, y and z of map, such as x,-z,y.",
    ),
]

# calibrations
SizeOption = Annotated[
    str | None,
    typer.Option(
        "--size", metavar="WIDTHxHEIGHT", help="Image size, as 640x480; overrides the size in the file."
    ),
]
ImageOption = Annotated[
    Path | None,
    typer.Option("--image", metavar="FILE", help="Image (.png, .jpg) that has the image size."),
]
UnitOption = Annotated[
    float | None,
    typer.Option(
        "--unit",
        metavar="METRES",
        help="Metres per unit of the file; by the format or content if absent.",
    ),
]
UpOption = Annotated[
    str | None,
    typer.Option(
        "--up",
        metavar="AXIS",
        help="Axis of the file that points up, such as y or -z; by the format or content if absent.",
    ),
]
CameraOption = Annotated[
    list[str] | None,
    list_option("--camera", "NAME", "Use only cameras with this name or pattern, such as left or 'S9_*'."),
]

# motions
JointTableOption = Annotated[
    str | None,
    typer.Option(
        "--joint-names",
        metavar="TABLE",
        help="Joint table: built-in name or YAML file; detected if absent.",
        autocompletion=joint_tables,
    ),
]
FacingOption = Annotated[
    str | None,
    typer.Option(
        "--facing",
        metavar="AXIS",
        help="Axis of the file that the person faces at rest; detected if absent.",
    ),
]


# -- the command line before it is parsed


@dataclass(frozen=True)
class Renamed:
    """An option with another name now.

    Attributes:
        old: Old name.
        new: New name.
        value: Pattern of the values that make it the old option, if the old name has another meaning now.
    """

    old: str
    new: str
    value: str = ""


#: Version that removes the old names.
REMOVED_IN = "0.4.0"
#: Renamed options of each command.
RENAMED = {
    "run": (
        Renamed("--duration", "--seconds"),
        Renamed("--processes", "--jobs"),
        Renamed("--mesh", "--body"),
        Renamed("--record-topics", "--topics"),
        Renamed("--record-compression", "--compression"),
        Renamed("--evaluate", "--estimate"),
        Renamed("--evaluate-keypoints", "--keypoints"),
        Renamed("--evaluate-output", "--output"),
    ),
    "demo": (Renamed("--duration", "--seconds"),),
    "bench": (Renamed("--processes", "--jobs"),),
    "export": (Renamed("--frames", "--range", ".*:.*"),),
    "evaluate": (Renamed("--json", "--output", "[^-].*"),),
    "challenge": (Renamed("--estimate-topic", "--estimate"),),
    "camera plot": (Renamed("--at", "--height"),),
    "camera place": (
        Renamed("--plot", "--picture"),
        Renamed("--tilt", "--tilt-deg"),
        Renamed("--roll", "--roll-deg"),
    ),
    "human build": (Renamed("--preview", "--picture"),),
    "human rig": (Renamed("--preview", "--picture"),),
    "human fit": (Renamed("--human", "--body"), Renamed("--report", "--picture")),
    "human texture": (Renamed("--report", "--picture"), Renamed("--size", "--texture-size")),
    "motion render": (Renamed("--phases", "--frames"),),
}

#: Options that have gone from a command, and why.
GONE = {
    "record": dict.fromkeys(
        ("--shards", "--merge", "--split"),
        "--ray divides recordings by frames, and each shard is a file of one bag (--shard-frames)",
    )
}


def new_names(arguments: Sequence[str], warn: Callable[[str], object]) -> list[str]:
    """The command line with the new names of renamed options; ``warn`` gets a line about each old one.

    Raises:
        HumansimError: An option has gone.

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
