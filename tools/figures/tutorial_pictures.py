"""Follow the tutorials (docs/tutorials) from top to bottom, and make their pictures (docs/images/tutorials).

python tools/figures/tutorial_pictures.py [NAME ...]

A block of a page that begins with ``# file.ext`` is that file; each ``humansim``, ``python``, ``pytest`` and
``git apply`` line runs in the order of the page, in a folder of its own. Lines that need a running graph, or
hours, are left out; pictures that come from them are not made here.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = ROOT / "docs" / "tutorials"
PICTURES = ROOT / "docs" / "images" / "tutorials"
#: Commands that need a running graph, a browser or hours, and what reads the bag that they write.
LIVE = ("run", "challenge", "play", "view", "bench", "demo")
#: Picture in the documents: its tutorial, the file that the tutorial makes, and its width.
MADE: dict[str, tuple[str, str, int]] = {
    "people.jpg": ("test_my_tracker", "sheet.png", 1000),
    "lab_plan.png": ("lab_calibration", "lab.png", 900),
    "lab_sheet.jpg": ("lab_calibration", "sheet.png", 1000),
    "own_body.jpg": ("own_motion_own_body", "person.png", 1000),
    "own_strip.jpg": ("own_motion_own_body", "strip.png", 1000),
    "own_scene.jpg": ("own_motion_own_body", "own.png", 700),
    "night.jpg": ("overnight_data_set", "trial.png", 800),
    "compare.png": ("compare_trackers", "compare.png", 800),
    "hot_pixels.jpg": ("sensor_effect", "hot.png", 900),
}
_BLOCK = re.compile(r"```(?:yaml|python|toml|diff)\n(# ([\w.]+)\n.*?)```", re.DOTALL)
_COMMAND = re.compile(r"^    ((?:humansim|python|pytest|git apply) .*)$", re.MULTILINE)


def files(text: str) -> dict[str, str]:
    """Content of the files that a page shows, by name."""
    return {name: content for content, name in _BLOCK.findall(text)}


def commands(text: str) -> Iterator[list[str]]:
    """Words of the commands of a page, in their order."""
    for line in _COMMAND.findall(text):
        yield shlex.split(line, comments=True)


def runs_here(words: list[str]) -> bool:
    """Whether a command needs neither a running graph nor hours."""
    needs_graph = words[0] == "humansim" and words[1] in LIVE
    return not needs_graph and "examples/tracker/node.py" not in words and "run:/tracker/poses" not in words


def prepare(text: str, folder: Path) -> None:
    """Write the files of a page, and a copy of the package if the page changes the package."""
    for name, content in files(text).items():
        (folder / name).write_text(content)
    if "```diff" in text:
        skip = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / "humansim_ros", folder / "humansim_ros", ignore=skip)
        (folder / "docs").mkdir()
        shutil.copy(ROOT / "docs" / "sensors.md", folder / "docs")
        for name in ("assets", "config", "launch", "package.xml"):
            (folder / name).symlink_to(ROOT / name)


def run(words: list[str], folder: Path, timeout: float | None = None) -> str:
    """Run a command of a page in its folder, and return what it prints.

    Raises:
        RuntimeError: It failed; with what it printed.
    """
    program = {
        "humansim": [sys.executable, "-m", "humansim_ros.cli"],
        "python": [sys.executable],
        "pytest": [sys.executable, "-m", "pytest"],
    }.get(words[0], [words[0]])
    package = folder if (folder / "humansim_ros").exists() else ROOT
    done = subprocess.run(
        [*program, *words[1:]],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(package), "GIT_CEILING_DIRECTORIES": str(folder.parent)},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=timeout,
    )
    if done.returncode:
        raise RuntimeError(f"{shlex.join(words)}: exit code {done.returncode}\n{done.stdout}")
    return done.stdout


def save(source: Path, target: Path, width: int) -> None:
    """Write a picture again, at most ``width`` pixels wide."""
    image = cv2.imread(str(source))
    if image is None:
        raise FileNotFoundError(source)
    if image.shape[1] > width:
        size = (width, round(image.shape[0] * width / image.shape[1]))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(target), image, [cv2.IMWRITE_JPEG_QUALITY, 82, cv2.IMWRITE_PNG_COMPRESSION, 9])


def main(names: list[str]) -> None:
    for page in sorted(TUTORIALS.glob("*.md")):
        pictures = {name: made for name, made in MADE.items() if made[0] == page.stem}
        if not pictures or (names and page.stem not in names):
            continue
        text = page.read_text()
        with tempfile.TemporaryDirectory() as folder:
            prepare(text, Path(folder))
            for words in commands(text):
                if runs_here(words):
                    print("$", shlex.join(words))
                    print(run(words, Path(folder)), end="")
            for name, (_, made, width) in pictures.items():
                save(Path(folder) / made, PICTURES / name, width)


if __name__ == "__main__":
    main(sys.argv[1:])
