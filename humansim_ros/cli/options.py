"""Options of the command line: shared options, options with lists or numbers, and renamed options."""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from functools import update_wrapper
from inspect import Parameter, Signature, signature
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer

from humansim_ros.cli.output import print_text
from humansim_ros.errors import MAX_FRAMES, CameraError, HumansimError, SceneError
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


#: Rows by section and name: names of the option on the command line, help text, limits.
_ROWS: Mapping[str, Mapping[str, Any]] = read_table("command_line")
#: Section of the rows that several commands share.
_SHARED = "shared"


def with_options(command: str, function: Callable[..., None]) -> Callable[..., None]:
    """Make the function of a command as typer takes it, with an option or argument for each parameter.

    Names, help texts and limits are in config/command_line.json, in the section of the command or in
    ``shared``, in the row with the name of the parameter. A row that is a text is the name of a shared row.

    A parameter with the type of a dataclass stands for an option for each field that has a row. If its type
    allows None as well, it is None unless the fields without a default are given. The parameter ``**options``
    with the type ``Annotated[Any, FUNCTION]`` stands for an option for each parameter of this function that
    has a row. A parameter that is annotated with typer's own options stays as it is.

    Args:
        command: Name of the command, such as ``camera show``.
        function: Its function.
    """
    shown: list[Parameter] = []
    groups: dict[str, _Group] = {}
    lists: list[str] = []
    hints = get_type_hints(function, include_extras=True)
    for name, parameter in signature(function).parameters.items():
        if parameter.kind is Parameter.VAR_KEYWORD:
            others = _parameters_of(hints[name], command, {each.name for each in shown})
            lists = [each.name for each in others if each.default == ()]
            shown += [_with_option(command, each.name, each.annotation, each.default) for each in others]
            continue
        kind = next((each for each in (hints[name], *get_args(hints[name])) if is_dataclass(each)), None)
        if kind is None:
            shown.append(_with_option(command, name, hints[name], parameter.default))
            continue
        groups[name] = _Group(kind, kind is not hints[name], command)
        shown += groups[name].parameters

    def call(**given: Any) -> None:
        objects = {name: group.take(given) for name, group in groups.items()}
        # typer gives None or an empty list for a list that is not given
        function(**given | {name: given[name] or () for name in lists}, **objects)

    update_wrapper(call, function)
    call.__annotations__ = {parameter.name: parameter.annotation for parameter in shown}
    call.__signature__ = Signature(shown)  # type: ignore[attr-defined]
    return call


def _parameters_of(hint: Any, command: str, known: Collection[str]) -> list[Parameter]:
    """Parameters of a public function that have a row for a command, but those in ``known``. ``hint``:
    ``Annotated[Any, FUNCTION]``."""
    function = get_args(hint)[1]
    given = signature(function).parameters.values()
    found = [each for each in given if each.name not in known and _row(command, each.name)]
    # only of these: others have types that are not imported before the function is called
    named = SimpleNamespace(__annotations__={each.name: each.annotation for each in found})
    hints = get_type_hints(named, function.__globals__)
    return [each.replace(annotation=hints[each.name]) for each in found]


@dataclass(frozen=True)
class _Group:
    """Options of a command that are fields of a dataclass.

    Attributes:
        kind: The dataclass.
        may_be_absent: Whether there is no object unless the fields without a default are given.
        command: Name of the command.
    """

    kind: Any
    may_be_absent: bool
    command: str

    @property
    def fields(self) -> list[Field[Any]]:
        """Fields that are options."""
        return [each for each in fields(self.kind) if _row(self.command, each.name)]

    @property
    def parameters(self) -> list[Parameter]:
        """Parameters for typer."""
        hints, shown = get_type_hints(self.kind), []
        for each in self.fields:
            hint, default = hints[each.name], each.default
            if default is MISSING:
                hint, default = (hint | None, None) if self.may_be_absent else (hint, Parameter.empty)
            shown.append(_with_option(self.command, each.name, hint, default))
        return shown

    def take(self, given: dict[str, Any]) -> Any:
        """Make the object, and remove its values from those of the command line. Raises HumansimError for an
        option that goes with an absent one."""
        values = {each.name: given.pop(each.name) for each in self.fields}
        # typer gives None or an empty list for a list that is not given
        lists = [each.name for each in self.fields if each.default == () and not values[each.name]]
        values |= dict.fromkeys(lists, ())
        absent = [each for each in self.fields if each.default is MISSING and values[each.name] is None]
        if not absent:
            return self.kind(**values)
        for each in self.fields:
            if values[each.name] not in (None, each.default):
                names = (_long_name(self.command, name) for name in (each.name, absent[0].name))
                raise HumansimError("{} goes with {} only".format(*names))
        return None


def _row(command: str, name: str) -> Mapping[str, Any] | None:
    """Row of the table for a parameter of a command, with what is not in the table; None
    if the parameter has no row."""
    own = _ROWS.get(command, {}).get(name, name)
    found = _ROWS[_SHARED].get(own) if isinstance(own, str) else own
    key = own if isinstance(own, str) else f"{command}.{name}"
    return None if found is None else {**found, **_MORE.get(key, {})}


def _long_name(command: str, name: str) -> str:
    """Name of an option on the command line, such as ``--fit-unit``."""
    names = (_row(command, name) or {}).get("names")
    return str(names[0]) if names else f"--{name.replace('_', '-')}"


def _with_option(command: str, name: str, kind: Any, default: Any) -> Parameter:
    """Make a parameter for typer. ``name``, ``kind``, ``default``: name, type and default of a parameter of
    the command."""
    if get_origin(kind) is not Annotated:
        row = dict(_row(command, name) or {})
        names = row.pop("names", ())
        is_argument, commas = row.pop("argument", False), row.pop("commas", True)
        kinds = {get_origin(each) for each in (kind, *get_args(kind))}
        if Sequence in kinds:
            kind, default = list[str] | None, default or None
        if not is_argument and commas and kinds & {list, Sequence}:
            row = {"callback": split_commas, **row, "metavar": f"{row['metavar']},..."}
        kind = Annotated[kind, (typer.Argument if is_argument else typer.Option)(*names, **row)]
    return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=kind)


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


def _check_exists(error: type[HumansimError], what: str) -> Callable[[Any], Any]:
    """Function that raises an error for missing files early, before slow imports. URLs are not checked."""

    def check(given: Any) -> Any:
        for path in given if isinstance(given, (list, tuple)) else [given]:
            is_file = path is not None and not any(mark in str(path) for mark in ("://", "#", "{"))
            if is_file and not exists(Path(path)):
                read_bytes(Path(path), error, what, 0)
        return given

    return check


def _print_formats(wanted: bool) -> None:
    """Print the export formats, and end the command."""
    if wanted:
        from humansim_ros.data.formats import EXPORT_FORMATS

        width = max(map(len, EXPORT_FORMATS))
        print_text("\n".join(f"{row.name:<{width}}  {row.title}" for row in EXPORT_FORMATS.values()))
        raise typer.Exit


#: By row: what the table cannot contain, the completion by a shell and a check of a value.
_MORE: Mapping[str, Mapping[str, Any]] = {
    "scene": {"callback": _check_exists(SceneError, "scene")},
    "file": {"callback": _check_exists(CameraError, "calibration")},
    "files": {"callback": _check_exists(CameraError, "calibration")},
    "body": {"autocompletion": built_in_humans},
    "human": {"autocompletion": built_in_humans},
    "joint_names": {"autocompletion": joint_tables},
    **{key: {"max": MAX_FRAMES} for key in ("run.frames", "record.frames", "export.frames")},
    "run.motion": {"autocompletion": built_in_motions},
    "view.body": {"autocompletion": built_in_humans},
    "bench.channels": {"autocompletion": built_in_channels},
    "snapshot.channels": {"autocompletion": built_in_channels},
    "export.formats": {"autocompletion": export_formats},
    "export.show_list": {"callback": _print_formats},
}


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
