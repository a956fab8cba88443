"""Support of the tests of recordings: a small scene, the command, and what a bag holds."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from commands import humansim

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
