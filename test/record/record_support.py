"""Support of the tests of recordings: a small scene, the command, and what a bag holds."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from commands import humansim
from conftest import ROOT
from waiting import children

#: A child, a moving box and two small cameras; one has noise, one a distorted lens.
SCENE = """
rate: 20
room: null
humans:
  anna: {body: child, motion: walk}
cameras:
  noisy: {size: [96, 72], position: [3, 0.4, 1.4], look_at: [0, 0, 1], sensor: {noise: {read_noise: 4}}}
  bent:
    size: [80, 64]
    distortion: [-0.2, 0.05, 0, 0, 0]
    position: [0, 3, 1.2]
    look_at: [0, 0, 0.8]
"""


def write_scene(folder: Path, text: str = SCENE) -> Path:
    path = folder / "scene.yaml"
    path.write_text(text)
    return path


def start(scene: Path, output: Path, *options: Any, **popen: Any) -> subprocess.Popen[str]:
    """``humansim record`` as a process."""
    words = [scene, "-o", output, *options]
    return subprocess.Popen(
        [sys.executable, "-m", "humansim_ros.cli", "record", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        **popen,
    )


def run(scene: Path, output: Path, *options: Any) -> tuple[int, str, str]:
    """Exit code, standard output and standard error of ``humansim record``, run in this process."""
    done = humansim("record", scene, "-o", output, *options)
    assert "Traceback" not in done.stderr, done.stderr
    return done.returncode, done.stdout, done.stderr


def hashes(bag: Path) -> dict[str, str]:
    """Hash of each file of a bag by its end, such as ``_0.mcap``, without the name of the bag."""
    return {
        path.name.removeprefix(bag.name): hashlib.sha256(
            path.read_bytes().replace(f"{bag.name}_".encode(), b"bag_")
        ).hexdigest()
        for path in sorted(bag.iterdir())
    }


def workers_of(process: subprocess.Popen[str]) -> list[int]:
    """Processes that a recording has started to encode frames."""
    return [pid for pid, line in children(process.pid).items() if "humansim_ros.data.engine.workers" in line]
