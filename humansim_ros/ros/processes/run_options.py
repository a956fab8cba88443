"""Options of a run as dataclasses, and the arguments of the launch file that set their fields."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any, TypeVar, get_args, get_type_hints

from humansim_ros.errors import RosError

_Options = TypeVar("_Options")


def launched(argument: str, description: str) -> dict[str, Any]:
    """Metadata of a field of a dataclass that a launch argument sets."""
    return {"argument": argument, "description": description}


def launch_arguments(kind: type) -> dict[str, str]:
    """Names of the launch arguments for a dataclass, with their descriptions. All are empty by default."""
    return {each.metadata["argument"]: each.metadata["description"] for each in _launched(kind)}


def launch_options(kind: type[_Options], arguments: Mapping[str, str]) -> _Options | None:
    """Make options from launch arguments. An empty argument stands for the default of its field.

    Returns:
        None if all arguments are empty, and a field must be given.

    Raises:
        RosError: An argument is wrong, or the argument of a field that must be given is empty.
    """
    given = {name: text.strip() for name, text in arguments.items() if text.strip()}
    hints, values = get_type_hints(kind), {}
    for each in _launched(kind):
        name = each.metadata["argument"]
        if name in given:
            values[each.name] = _value(name, given[name], hints[each.name])
        elif each.default is MISSING and given:
            raise RosError(f"launch argument {next(iter(given))} goes with {name} only")
        elif each.default is MISSING:
            return None
    return kind(**values)


def _launched(kind: Any) -> list[Any]:
    return [each for each in fields(kind) if each.metadata]


def _value(name: str, text: str, hint: Any) -> Any:
    """Value of a launch argument for a field with a type. Raises RosError."""
    kinds = {hint, *get_args(hint)}
    if bool in kinds:
        return true_or_false(name, text)
    if int in kinds:
        return whole_number(name, text)
    if Sequence[str] in kinds:
        return [word.strip() for word in text.split(",") if word.strip()]
    if Path in kinds:
        return Path(text)
    if float not in kinds:
        return text
    try:
        return float(text)
    except ValueError:
        raise RosError(f"launch argument {name} must be a number, not {text!r}") from None


def whole_number(name: str, text: str) -> int | None:
    """Read a launch argument that is a whole number from 1, or empty. RosError names a wrong argument."""
    if not text.strip():
        return None
    if not text.strip().isdecimal() or int(text) < 1:
        raise RosError(f"launch argument {name} must be a whole number from 1, or empty, not {text!r}")
    return int(text)


def true_or_false(name: str, text: str) -> bool:
    """Read a launch argument that is true or false. RosError names a wrong argument."""
    word = text.strip().lower()
    if word not in ("true", "false"):
        raise RosError(f"launch argument {name} must be true or false, not {text!r}")
    return word == "true"


@dataclass(frozen=True)
class RecordOptions:
    """What is recorded of a run (docs/recording.md).

    Attributes:
        folder: Folder of the bag. It must not exist.
        topics: Names and patterns of topics. If empty, the latched topics of the scene, and those that
            ``humansim demo`` shows.
        compression: ``none``, ``zstd`` or ``lz4``.
    """

    folder: Path = field(
        metadata=launched("record", "Folder of a new bag for the topics of the scene; empty: none")
    )
    topics: Sequence[str] = field(
        default=(),
        metadata=launched("record_topics", "Topics to record, names or patterns, separated by commas"),
    )
    compression: str = field(
        default="none", metadata=launched("record_compression", "Compression of the bag: none, zstd or lz4")
    )


@dataclass(frozen=True)
class EvaluateOptions:
    """An estimate that is evaluated in a run (docs/evaluation.md).

    Attributes:
        topic: Topic of the estimate. ``*`` stands for the name of a person.
        keypoints: Keypoint set of the estimate. If empty, joints of the skeleton.
        scale: Length of a unit of the estimate, metres.
        axes: Axes of the estimate. If empty, the axes of ``map``.
        output: JSON file for the result. If None, no file is written.
    """

    topic: str = field(
        metadata=launched("evaluate", "Topic of an estimate to evaluate, such as /tracker/poses; empty: none")
    )
    keypoints: str = field(
        default="", metadata=launched("evaluate_keypoints", "Keypoint set of the estimate, such as coco17")
    )
    scale: float = 1.0
    axes: str = ""
    output: Path | None = field(
        default=None, metadata=launched("evaluate_output", "JSON file for the result")
    )
