"""A scene of two people and two cameras, and estimates of a tracker, for tests of the page."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from humansim_ros import Scene, Simulation

LAB = """\
rate: {rate}
room: null
humans:
  anna: {{body: adult_woman, motion: {{file: walk, position: [0.6, 0.4]}}}}
  ben: {{body: adult_man, motion: {{file: wave, position: [-0.6, -0.2]}}}}
cameras:
"""


def lab(rate: int, cameras: Mapping[str, str]) -> str:
    """A scene: ``cameras`` are keys of each camera, as YAML without braces."""
    rows = "".join(f"  {name}: {{{keys}}}\n" for name, keys in cameras.items())
    return LAB.format(rate=rate) + rows


def write_estimate(scene: Path, path: Path, frames: int, shifts: Mapping[str, float]) -> None:
    """Joints of a tracker as CSV, computed without the page.

    Args:
        scene: Scene file.
        path: File to write.
        frames: Number of frames.
        shifts: Metres along x by which the joints of a person are wrong; others are not found.
    """
    with Simulation(Scene.load(scene)) as simulation, path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["stamp", "person", "joint", "x", "y", "z"])
        for frame in simulation.frames(frames):
            for name, shift in shifts.items():
                human = frame.humans[name]
                for joint, point in zip(human.joint_names, human.positions, strict=True):
                    writer.writerow([frame.stamp, f"p_{name}", joint, *np.add(point, [shift, 0, 0])])
