"""The command as a whole: help, version, speed of its start, and numbers as values of options."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import ROOT

from humansim_ros import HumansimError, Scene, __version__, load_human
from humansim_ros.cli.human import BUILT_IN_FACTS, built_in_humans, describe_human
from humansim_ros.cli.main import COMMANDS, GROUPS, main
from humansim_ros.cli.options import join_numbers, parse_size
from humansim_ros.cli.run import _describe, _print_ways_to_see


def humansim(*arguments: str, capsys: pytest.CaptureFixture[str], patch: pytest.MonkeyPatch) -> str:
    """Run a command in this process; returns its output after checking that it succeeds."""
    patch.setattr(sys, "argv", ["humansim", *arguments])
    assert main() == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("scene", [None, "my scene.yaml"])
def test_a_run_says_which_commands_show_the_scene(
    scene: str | None, capsys: pytest.CaptureFixture[str]
) -> None:
    _print_ways_to_see(None if scene is None else Path(scene))
    found = re.findall(r"humansim [^,(]+", capsys.readouterr().out)
    words = [shlex.split(command) for command in found]
    assert [line[1] for line in words] == ["view", "snapshot"] and set(COMMANDS) >= {"view", "snapshot"}
    assert all(
        line[2:3] == ([] if scene is None and line[1] == "view" else [scene or "-o"]) for line in words
    )


@pytest.mark.parametrize("command", [(), *map(str.split, (*COMMANDS, *GROUPS))], ids=" ".join)
def test_every_command_explains_itself_with_h(
    command: tuple[str, ...], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text = humansim(*command, "-h", capsys=capsys, patch=monkeypatch)
    assert text.startswith(f"Usage: {' '.join(('humansim', *command))} ") and "-h, --help" in text


@pytest.mark.parametrize("command", [[], ["human"]])
def test_without_a_command_the_help_is_shown(
    command: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["humansim", *command])
    assert main() == 2
    assert capsys.readouterr().err.startswith("Usage: humansim")


def test_an_unknown_command_names_the_help(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for arguments, group in ((["foo"], ""), (["human", "foo"], " human")):
        monkeypatch.setattr(sys, "argv", ["humansim", *arguments])
        assert main() == 2
        assert capsys.readouterr().err == f"error: No such command 'foo'; see `humansim{group} --help`\n"


def test_the_package_runs_as_a_module() -> None:
    for module in ("humansim_ros", "humansim_ros.cli"):
        done = subprocess.run(
            [sys.executable, "-m", module, "--version"], cwd=ROOT, capture_output=True, text=True, check=True
        )
        assert done.stdout == f"{__version__}\n"


def test_help_lists_and_refusals_start_without_the_libraries_of_the_core() -> None:
    """The start of the command takes as long as its imports."""
    heavy = {"numpy", "scipy", "cv2", "moderngl", "rclpy", "rich"}
    shown = [["--help"], ["human", "list"], ["motion", "list"]]
    shown += [[*name.split(), "-h"] for name in COMMANDS]
    refused = [["no_such_command"], ["run", "--no-such-option"], ["human", "list", "--jsn"]]
    refused += [
        [*name.split(), "no_such_file.yaml"] for name in ("check", "run", "snapshot -o x.png", "camera show")
    ]
    code = (
        "import sys; from humansim_ros.cli.main import main\n"
        f"for words in {shown}: assert main(words) == 0, words\n"
        f"for words in {refused}: assert main(words) == 2, words\n"
        f"print(*sorted({heavy} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "", done.stdout.splitlines()[-1]
    assert done.stderr.count("error: ") == len(refused)


@pytest.mark.slow
def test_the_listed_facts_are_those_of_the_built_in_humans() -> None:
    listed = json.loads((ROOT / BUILT_IN_FACTS).read_text())
    computed = [describe_human(load_human(name)) for name in built_in_humans()]
    assert listed == json.loads(json.dumps(computed)), "run tools/assets/list_humans.py"


@pytest.mark.parametrize("size", ["320x240", "320×240", "320 240", "320,240", " 320 x 240 "])
def test_sizes_are_written_in_many_ways(size: str) -> None:
    assert parse_size(size) == (320, 240)


@pytest.mark.parametrize("size", ["320", "x240", "320x", "-320x240", "320x240x3", "a 2", "1e3x10"])
def test_other_sizes_are_errors_that_show_the_form(size: str) -> None:
    with pytest.raises(HumansimError, match="--size: needs width and height, such as 640x480"):
        parse_size(size)


@pytest.mark.parametrize(
    ("given", "joined"),
    [
        ("camera show a.yaml --size 640 480", "camera show a.yaml --size 640x480"),
        ("camera show --size 640x480 a.yaml", "camera show --size 640x480 a.yaml"),
        ("x --size 640 480 12", "x --size 640x480 12"),
        ("x --size", "x --size"),
        ("x --look-at -1 2 0.5 --up -z", "x --look-at -1 2 0.5 --up -z"),
    ],
)
def test_numbers_after_size_are_joined(given: str, joined: str) -> None:
    assert join_numbers(given.split()) == joined.split()


@pytest.mark.parametrize("size", [["--size", "320", "240"], ["--size", "320x240"], ["--size", "320×240"]])
def test_negative_numbers_and_sizes_need_no_quotes(
    tmp_path: Path, size: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import yaml

    rig = [
        "camera",
        "rig",
        "--ring",
        "2",
        "--look-at",
        "-1",
        "-.5",
        "0.5",
        "--distortion",
        "-0.3",
        "0.1",
        "0",
        "0",
    ]
    humansim(*rig, *size, "--start-deg", "-20", "-o", str(tmp_path), capsys=capsys, patch=monkeypatch)
    scene = yaml.safe_load((tmp_path / "scene.yaml").read_text())
    camera = scene["cameras"]["camera_1"]
    assert camera["size"] == [320, 240] and camera["distortion"][:4] == [-0.3, 0.1, 0, 0]


def test_run_says_how_sure_the_joints_are(capsys: pytest.CaptureFixture[str]) -> None:
    _describe(Scene.load(), "")
    assert "walk.bvh (biovision joints, matched by names, confidence 100%, y up, " in capsys.readouterr().out
