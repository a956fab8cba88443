"""Completion of the humansim command in shells."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from conftest import ROOT
from waiting import PATIENCE

HEAVY = ("cv2", "moderngl", "scipy")


def completed(line: str) -> list[str]:
    """What bash is offered for the last word of a line."""
    words = line.split(" ")
    variables = {
        "_HUMANSIM_COMPLETE": "complete_bash",
        "COMP_WORDS": line,
        "COMP_CWORD": str(len(words) - 1),
        "PYTHONPATH": str(ROOT),
    }
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
        env=os.environ | variables,
    )
    assert done.stderr.strip().splitlines()[-1] == "[]", "completion loads what takes a second to load"
    return done.stdout.split()


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("humansim vi", ["view"]),
        ("humansim camera pl", ["plot", "place"]),
        ("humansim run --motion wav", ["wave"]),
        ("humansim run --mesh chi", ["child"]),
        ("humansim snapshot --channels rgb,dep", ["rgb,depth"]),
        ("humansim snapshot --wid", ["--width"]),
    ],
)
def test_words_are_completed(line: str, expected: list[str]) -> None:
    assert completed(line) == expected


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_each_shell_is_printed(shell: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "humansim_ros"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=os.environ | {"PYTHONPATH": str(ROOT), "_HUMANSIM_COMPLETE": f"source_{shell}"},
    )
    assert done.returncode == 0 and "_HUMANSIM_COMPLETE" in done.stdout
