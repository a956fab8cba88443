"""Options of a run as dataclasses, and the arguments of the launch file that set their fields."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, TypeVar, get_args, get_type_hints

from humansim_ros.errors import RosError
from humansim_ros.files.reading import read_table

_Options = TypeVar("_Options")


def run_row(name: str) -> Mapping[str, Any]:
    """Names, help text and limits of an option of ``humansim run``. Empty if there is no such option."""
    table = read_table("command_line")
    row = table["run"].get(name, name)
    found: Mapping[str, Any] = table["shared"].get(row, {}) if isinstance(row, str) else row
    return found


def launch_arguments(kind: type) -> dict[str, str]:
    """Names of the launch arguments for a dataclass, with their descriptions. All are empty by default."""
    return {
        name: f"As {_option(each.name)} of humansim run: {row['help']}" for name, each, row in _launched(kind)
    }


def _option(field: str) -> str:
    """Option of ``humansim run`` for a field, such as ``--wait-for``."""
    names = run_row(field).get("names") or [f"--{field.replace('_', '-')}"]
    return str(names[0])


def launch_options(kind: type[_Options], arguments: Mapping[str, str]) -> _Options | None:
    """Make options from launch arguments. An empty argument stands for the default of its field.

    Returns:
        None if all arguments are empty, and a field must be given.

    Raises:
        RosError: An argument is wrong, or the argument of a field that must be given is empty.
    """
    given = {name: text.strip() for name, text in arguments.items() if text.strip()}
    hints, values = get_type_hints(kind), {}
    for name, each, _ in _launched(kind):
        if name in given:
            values[each.name] = _value(name, given[name], hints[each.name])
        elif each.default is MISSING and given:
            raise RosError(f"launch argument {next(iter(given))} goes with {name} only")
        elif each.default is MISSING:
            return None
    return kind(**values)


def _launched(kind: Any) -> Iterator[tuple[str, Field[Any], Mapping[str, Any]]]:
    """Launch argument, field and row of each field of a dataclass that is an option of ``humansim run``. The
    field that must be given has the name of the group."""
    group = getattr(kind, "launch_group", "")
    for each in fields(kind):
        if row := run_row(each.name):
            joined = f"{group}_{each.name}" if group else each.name
            yield group if each.default is MISSING else joined, each, row


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


# Help texts, limits and units of all fields are in config/command_line.json, in the rows of these names.


@dataclass(frozen=True)
class RecordOptions:
    """What is recorded of a run (docs/recording.md): options of ``humansim run`` with ``--record``.

    Without topics, the latched topics of the scene, and those that ``humansim demo`` shows.
    """

    launch_group: ClassVar[str] = "record"
    folder: Path
    topics: Sequence[str] = ()
    compression: str = "none"


@dataclass(frozen=True)
class EvaluateOptions:
    """An estimate that is evaluated in a run (docs/evaluation.md): options of ``humansim run`` with
    ``--estimate``."""

    launch_group: ClassVar[str] = "evaluate"
    topic: str
    keypoints: str = ""
    scale: float = 1.0
    axes: str = ""
    output: Path | None = None


@dataclass(frozen=True)
class PlayOptions:
    """How a bag is played: options of ``humansim play``. Without topics, all are played."""

    clock: float = 0.0
    rate: float = 1.0
    loop: bool = False
    start_offset: float = 0.0
    topics: Sequence[str] = ()
