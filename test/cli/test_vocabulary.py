"""One vocabulary of all commands: a word means one thing, and an old spelling still works with a warning."""

from __future__ import annotations

import inspect
import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import pytest
import typer
from commands import humansim

from humansim_ros.cli.main import COMMANDS, GROUPS, HEADINGS, load_command
from humansim_ros.cli.options import RENAMED, new_names, split_commas

#: Kinds of values. A choice lists its words, such as png|jpg.
KINDS = {
    "A:B", "ADDRESS", "AXES", "AXIS", "BODY", "BYTES", "CHANNEL", "COMMAND", "DEGREES", "DIR", "FACTOR",
    "FILE", "FORMAT", "FRACTION", "HZ", "KG", "METRES", "MOTION", "N", "NAME", "NUMBERS", "PATH", "PIXELS",
    "POINT", "PORT", "ROWSxCOLUMNS", "SCORE", "SECONDS", "SET", "TABLE", "TEXT", "TONE", "TOPIC",
    "WIDTHxHEIGHT", "X Y", "X Y X Y", "X Y Z", "YEARS",
}  # fmt: skip
#: Words that have one kind of value in every command.
WORDS = {
    "--axes": "AXES", "--body": "BODY", "--camera": "NAME", "--facing": "AXIS", "--frame": "N",
    "--frames": "N",
    "--height": "METRES", "--jobs": "N", "--joint-names": "TABLE", "--json": "flag", "--keypoints": "SET",
    "--network": "flag", "--picture": "FILE", "--range": "A:B", "--ray": "ADDRESS", "--resume": "flag",
    "--scale": "METRES", "--seconds": "SECONDS", "--size": "WIDTHxHEIGHT", "--stature": "METRES",
    "--timeout": "SECONDS", "--topics": "TOPIC", "--unit": "METRES", "--up": "AXIS",
}  # fmt: skip
#: Words with several kinds, and why.
SEVERAL = {
    "--output": {"FILE", "DIR", "PATH"},
    "--estimate": {"TOPIC", "PATH"},  # evaluate reads bags and files
    "--fit": {"FILE", "focal|all|no_black"},  # a fit to photographs, and how an ideal image fits the real one
    "--images": {"png|jpg", "raw|jpeg|png"},
    "--rate": {"HZ", "FACTOR"},  # FACTOR as in ros2 bag play
}


@dataclass(frozen=True)
class Option:
    """An option of a command. ``kind``: its metavar; its words, if it is a choice; or flag."""

    command: str
    names: tuple[str, ...]
    kind: str
    is_list: bool
    help: str


def scalar(kind: Any) -> Any:
    """Type of the single value in an annotation such as list[str] | None."""
    if get_origin(kind) is Literal:
        return kind
    inner = [part for part in get_args(kind) if part not in (type(None), Ellipsis)]
    return scalar(inner[0]) if inner else kind


def options() -> list[Option]:
    """All options. An argument is one without a name: its kind is its metavariable."""
    found = []
    for command in COMMANDS:
        function = load_command(command)
        hints = get_type_hints(function, include_extras=True)
        for parameter in inspect.signature(function).parameters.values():
            annotated, info = get_args(hints[parameter.name])
            if isinstance(info, typer.models.ArgumentInfo):
                kind = (info.metavar or parameter.name.upper()).strip("[]")
                found.append(Option(command, (), kind, scalar(annotated) is not annotated, info.help or ""))
                continue
            given = [str(name) for name in (info.default, *(info.param_decls or ())) if str(name)[:1] == "-"]
            names = tuple(given or ["--" + parameter.name.replace("_", "-")])
            value = scalar(annotated)
            if value is bool:
                kind = "flag"
            elif get_origin(value) is Literal:
                kind = "|".join(get_args(value))
            elif hasattr(value, "__members__"):
                kind = "|".join(each.value for each in value)
            else:
                kind = str(info.metavar)
            is_list = kind.endswith(",...")
            multiple = any(
                get_origin(part) is list or part is list for part in (annotated, *get_args(annotated))
            )
            assert multiple == is_list or names == ("--floor-point",), (command, names)  # a point has commas
            assert not is_list or info.callback is split_commas, (command, names)
            found.append(Option(command, names, kind.removesuffix(",..."), is_list, info.help or ""))
    return found


ALL = options()
OPTIONS, ARGUMENTS = [each for each in ALL if each.names], [each for each in ALL if not each.names]
LONG = [(option, name) for option in OPTIONS for name in option.names if name.startswith("--")]


def test_every_option_has_a_help_and_a_known_kind_of_value() -> None:
    assert len(OPTIONS) > 200
    for option in OPTIONS:
        assert option.help.endswith((".", ")")), option
        assert option.kind in KINDS | {"flag", "[HZ]"} or "|" in option.kind, option


#: Kinds of arguments, and the beginning of their help in every command; FILE is a calibration.
ARGUMENT_KINDS = {
    "BAG": "Folder of a bag",
    "CONFIG": "Description (.yaml)",
    "EXTRINSICS": "File with the extrinsics",
    "FILE": "Calibration file",
    "FILES": "Calibration files",
    "HUMAN": "Built-in human",
    "IMAGES": "Images of the camera",
    "MESH": "Mesh in T or A pose",
    "MOTION": "Motion file",
    "PATH": "Scene, bag, motion, human, calibration or views file",
    "SCENE": "Scene file",
    "VIEWS": "Views file",
}


def test_an_argument_has_one_meaning_in_all_commands() -> None:
    assert {each.kind for each in ARGUMENTS} == ARGUMENT_KINDS.keys()
    for argument in ARGUMENTS:
        assert argument.help.startswith(ARGUMENT_KINDS[argument.kind]), argument
        assert argument.help.endswith((".", "…")), argument


def test_the_reference_shows_the_words_of_each_choice() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "commands.md").read_text()
    choices = [option for option in OPTIONS if "|" in option.kind]
    assert len(choices) > 10
    for option in choices:
        names = ", ".join(f"`{name}`" for name in sorted(option.names, key=len))
        assert f"| {names} {option.kind.replace('|', chr(92) + '|')} |" in page, option


def test_a_word_has_one_kind_of_value_in_all_commands() -> None:
    kinds = defaultdict(set)
    for option, name in LONG:
        for word in name.split("/"):
            kinds[word].add(option.kind)
    assert {word: kinds[word] for word in WORDS} == {word: {kind} for word, kind in WORDS.items()}
    different = {word: found for word, found in kinds.items() if len(found) > 1}
    assert all(found <= SEVERAL.get(word, set()) for word, found in different.items()), different


def test_angles_durations_and_short_names_follow_one_rule() -> None:
    for option, name in LONG:
        assert (option.kind == "DEGREES") == name.endswith("-deg"), option
        assert (name == "--output") == ("-o" in option.names), option
        assert name == name.lower() and re.fullmatch(r"--[a-z-]+(/--[a-z-]+)?", name), option


def test_json_is_the_same_flag_everywhere() -> None:
    found = [option for option, name in LONG if name == "--json"]
    assert len(found) > 10 and len({option.help for option in found}) == 1


def test_no_command_has_an_old_spelling() -> None:
    old = {each.old for rows in RENAMED.values() for each in rows if not each.value}
    kept = {"--report", "--at", "--size", "--evaluate"}  # an HTML page, a place x y, the size of images
    assert {name for _, name in LONG} & old <= kept
    pictures = {(option.command, name) for option, name in LONG if "(.png)" in option.help}
    assert {name for _, name in pictures} <= {"--output", "--picture", "--image"}


OLD = [(command, each) for command, rows in RENAMED.items() for each in rows]


@pytest.mark.parametrize(("command", "renamed"), OLD, ids=[f"{c} {each.old}" for c, each in OLD])
def test_an_old_spelling_works_and_warns(command: str, renamed: Any) -> None:
    assert renamed.new in {name for option, name in LONG if option.command == command}
    value = {"--frames": "0:3", "--json": "result.json"}.get(renamed.old, "7")
    said: list[str] = []
    words = [*command.split(), "scene.yaml"]
    assert new_names([*words, renamed.old, value], said.append) == [*words, renamed.new, value]
    assert new_names([*words, f"{renamed.old}={value}"], said.append) == [*words, f"{renamed.new}={value}"]
    assert said == [f"{renamed.old} is now {renamed.new}; version 0.4.0 removes the old name"] * 2
    done = humansim(*command.split(), renamed.old, value, "--no-such-option")
    assert done.returncode == 2 and f"warning: {said[0]}\n" in done.stderr


def test_new_meanings_of_old_names_and_other_commands_do_not_warn() -> None:
    for words in (
        ["export", "--frames", "3"],
        ["evaluate", "--json", "--truth", "x"],
        ["evaluate", "--json"],
        ["camera", "show", "--size", "640x480"],
        ["run", "--", "--duration"],
        ["evaluate", "--report", "x.html"],
    ):
        assert new_names(words, pytest.fail) == words


def test_a_command_with_an_old_spelling_does_its_work(tmp_path: Path) -> None:
    rig = ("camera", "rig", "--ring", 4, "-o", tmp_path)
    assert humansim(*rig).returncode == 0
    place = ("camera", "place", tmp_path / "scene.yaml", "--height", 2)
    done = humansim(*place, "--tilt=10", "--plot", tmp_path / "rig.png")
    assert done.returncode == 0 and (tmp_path / "rig.png").stat().st_size
    assert done.stderr.startswith("warning: --tilt is now --tilt-deg; version 0.4.0 removes the old name\n")
    assert done.stderr.count("removes the old name") == 2


def test_lists_are_repeated_or_have_commas(tmp_path: Path) -> None:
    assert split_commas(["a,b", " c "]) == ["a", "b", "c"] and split_commas(None) == []
    file = tmp_path / "left,right.csv"
    assert split_commas([str(file)]) == [f"{tmp_path}/left", "right.csv"]
    file.touch()
    assert split_commas([str(file)]) == [str(file)]
    assert humansim("camera", "rig", "--ring", 4, "-o", tmp_path).returncode == 0
    for words in (("--camera", "camera_1,camera_3"), ("--camera", "camera_1", "--camera", "camera_3")):
        text = humansim("camera", "show", tmp_path / "scene.yaml", *words).stdout
        assert re.findall(r"^camera_\d$", text, re.MULTILINE) == ["camera_1", "camera_3"]


def test_each_command_and_group_is_below_one_heading_of_the_help() -> None:
    listed = [name for names in HEADINGS.values() for name in names]
    known = {name.split()[0] for name in COMMANDS}
    assert sorted(listed) == sorted(known) and GROUPS.keys() <= known
    text = humansim("--help").stdout
    places = [text.index(f"\n{heading}:\n") for heading in HEADINGS]
    assert places == sorted(places)
    for name in listed:
        assert re.search(rf"^  {name} +[A-Z]", text, re.MULTILINE), name
