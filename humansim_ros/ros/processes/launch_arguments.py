"""Read options from the arguments of the launch file. The fields of a dataclass name the arguments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
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
