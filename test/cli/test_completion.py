"""Completion of the humansim command in shells."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from commands import humansim
from conftest import ROOT
from waiting import PATIENCE

from humansim_ros.cli import options as completion
from humansim_ros.data.formats.formats import EXPORT_FORMATS

HEAVY = ("cv2", "moderngl", "scipy")


def completed(line: str) -> list[str]:
    """What bash is offered for the last word of a line."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in variables_of(line).items():
            patch.setenv(name, value)
        return humansim().stdout.split()


def variables_of(line: str) -> dict[str, str]:
    count = str(len(line.split(" ")) - 1)
    return {"_HUMANSIM_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": count}


def test_completion_does_not_load_what_takes_a_second_to_load() -> None:
    code = (
        "import atexit, sys\n"
        f"atexit.register(lambda: print([m for m in {HEAVY} if m in sys.modules], file=sys.stderr))\n"
        "from humansim_ros.cli.main import main\n"
        "sys.argv = ['humansim']\n"
        "sys.exit(main())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=os.environ | {"PYTHONPATH": str(ROOT)} | variables_of("humansim snapshot --channels rgb,dep"),
    )
    assert done.stderr.strip().splitlines()[-1] == "[]" and done.stdout.split() == ["rgb,depth"]


@pytest.mark.daily("humansim run --motion wav-expected2", "humansim run --joint-names laf-expected9")
@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("humansim vi", ["view"]),
        ("humansim camera pl", ["plot", "place"]),
        ("humansim run --motion wav", ["wave"]),
        ("humansim run --body chi", ["child"]),
        ("humansim snapshot --channels rgb,dep", ["rgb,depth"]),
        ("humansim snapshot --wid", ["--width"]),
        ("humansim export --format coco,web", ["coco,webdataset"]),
        ("humansim human info chi", ["child"]),
        ("humansim motion info wav", ["wave"]),
        ("humansim run --joint-names laf", ["lafan1"]),
    ],
)
def test_words_are_completed(line: str, expected: list[str]) -> None:
    assert completed(line) == expected


def test_export_formats_are_those_of_the_table() -> None:
    assert tuple(EXPORT_FORMATS) == completion.EXPORT_FORMATS


@pytest.mark.parametrize(
    ("shell", "words"),
    [
        ("bash", "complete -o default -F"),
        ("zsh", "#compdef humansim"),
        ("fish", "complete --command humansim"),
    ],
)
def test_the_script_of_each_shell_is_printed(shell: str, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # without the variable, the option is for the shell that has started Python, whatever is named here
    monkeypatch.setenv("_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION", "1")
    done = humansim("--show-completion", shell)
    assert done.returncode == 0 and "_HUMANSIM_COMPLETE" in done.stdout and words in done.stdout
