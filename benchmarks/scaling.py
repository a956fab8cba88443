"""Cost of a frame by cameras, pixels and humans, and a formula for planning.

    python benchmarks/scaling.py [--rounds 8] [--plot FILE.png] [--json FILE.json]

The channels are rgb, depth, instance and part, in the room of the demo scene. Every case is rendered once per
round with new poses; the result is the median over the rounds. Milliseconds are CPU time of all threads,
which other work on the machine affects least: n cores have n * 1000 of them per second. Skinning, sensors and
ROS are not included (docs/performance.md).
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from humansim_ros.cameras import Camera
from humansim_ros.render import CHANNELS, Body, GLRenderer
from humansim_ros.render.pictures import write_png
from humansim_ros.scene import Scene

CAMERAS = (1, 2, 4, 8, 12, 16)
SIZES = ((320, 240), (640, 480), (960, 720), (1280, 960), (1920, 1080))
HUMANS = (1, 2, 3, 5, 7, 10)
DEFAULT_SIZE = (640, 480)
#: Cameras, size and humans of cases that vary two parameters, to test the formula.
MIXED = (
    (2, (320, 240), 5),
    (2, (960, 720), 3),
    (2, (1920, 1080), 2),
    (2, (1280, 960), 7),
    (4, DEFAULT_SIZE, 4),
    (8, DEFAULT_SIZE, 2),
)
_POSES = 8


@dataclass(frozen=True)
class Case:
    """Number and image size of cameras, and number of humans."""

    cameras: int
    size: tuple[int, int]
    humans: int


@dataclass
class Measurement:
    """CPU and wall-clock milliseconds per frame of a case.

    ``triangles``: thousands, of all humans. ``pixels``: millions, of all images. ``covered``: millions, of
    the bounding rectangles of humans in them.
    """

    case: Case
    cpu: float
    wall: float
    triangles: float
    pixels: float
    covered: float

    @property
    def terms(self) -> list[float]:
        """Values that the formula multiplies with its coefficients."""
        n = self.case.cameras
        return [n, self.pixels, self.covered, self.triangles, n * self.triangles]


TERMS = (
    ("each camera", 1.0),
    ("each million pixels of its image", 1.0),
    ("each million pixels that humans cover", 1.0),
    ("each 10,000 triangles, once for all cameras", 10.0),
    ("each 10,000 triangles, in each camera", 10.0),
)


def all_cases() -> list[Case]:
    lines = [
        *(Case(n, DEFAULT_SIZE, 1) for n in CAMERAS),
        *(Case(1, size, 1) for size in SIZES),
        *(Case(1, DEFAULT_SIZE, n) for n in HUMANS),
        *(Case(*other) for other in MIXED),
    ]
    return list(dict.fromkeys(lines))


class Stage:
    """The room with humans in a spiral and cameras around them."""

    def __init__(self) -> None:
        scene = Scene.load()
        self.renderer = GLRenderer(scene.static_meshes)
        self.triangles = 0
        actor = next(iter(scene.actors.values()))
        self._humans: list[list[Body]] = []
        for number in range(max(HUMANS)):
            angle = 2.4 * number
            position = 0.35 * np.sqrt(number) * np.array([np.cos(angle), np.sin(angle), 0.0])
            poses = []
            for step in range(_POSES):
                vertices = actor.at(0.15 * step + 0.37 * number).vertices
                center = np.array([*vertices[:, :2].mean(0), 0.0])
                moved = (vertices - center + position).astype(np.float32)
                poses.append(replace(actor.body(moved), instance=number + 1))
            self._humans.append(poses)
        self.triangles = len(self._humans[0][0].mesh.triangles)

    def camera(self, number: int, size: tuple[int, int]) -> Camera:
        angle = 2 * np.pi * number / max(CAMERAS) + 0.3
        return Camera.look_at(
            (3.0 * np.cos(angle), 2.7 * np.sin(angle), 1.9), (0, 0, 0.9), size, np.radians(65)
        )

    def render(self, case: Case, step: int) -> list[NDArray[np.uint16]]:
        # a new Body, as in a new frame
        bodies = [replace(poses[step % _POSES]) for poses in self._humans[: case.humans]]
        images = []
        for number in range(case.cameras):
            view = self.renderer.render(bodies, self.camera(number, case.size), CHANNELS)
            images.append(view.instance)
        return images


def measure(stage: Stage, cases: Sequence[Case], rounds: int) -> list[Measurement]:
    covered = [sum(map(rectangle, stage.render(case, 0))) for case in cases]  # and a warm-up
    cpu = np.zeros((rounds, len(cases)))
    wall = np.zeros_like(cpu)
    for step in range(rounds):
        for number, case in enumerate(cases):
            start = time.process_time(), time.perf_counter()
            stage.render(case, step)
            cpu[step, number], wall[step, number] = (
                time.process_time() - start[0],
                time.perf_counter() - start[1],
            )
    return [
        Measurement(
            case,
            float(np.median(cpu[:, number])) * 1e3,
            float(np.median(wall[:, number])) * 1e3,
            case.humans * stage.triangles / 1e3,
            case.cameras * case.size[0] * case.size[1] / 1e6,
            covered[number] / 1e6,
        )
        for number, case in enumerate(cases)
    ]


def rectangle(instance: NDArray[np.uint16]) -> int:
    """Pixels of the bounding rectangle of all humans."""
    rows, columns = (np.flatnonzero(instance.any(axis=axis)) for axis in (1, 0))
    return int((rows[-1] - rows[0] + 1) * (columns[-1] - columns[0] + 1)) if len(rows) else 0


def fit(measured: Sequence[Measurement]) -> NDArray[np.float64]:
    """Non-negative coefficients with the least squared relative error."""
    cpu = np.array([m.cpu for m in measured])
    terms = np.array([m.terms for m in measured])
    return np.asarray(nnls(terms / cpu[:, None], np.ones(len(cpu)))[0], dtype=float)


def plot(path: Path, measured: Sequence[Measurement], coefficients: NDArray[np.float64]) -> None:
    """Plot measurements and formula over cameras, pixels and humans."""
    one = {m.case: m for m in measured}
    panels = (
        ("cameras of 640x480, one human", [(n, one[Case(n, DEFAULT_SIZE, 1)]) for n in CAMERAS]),
        ("million pixels, one camera and human", [(w * h / 1e6, one[Case(1, (w, h), 1)]) for w, h in SIZES]),
        ("humans, one camera of 640x480", [(n, one[Case(1, DEFAULT_SIZE, n)]) for n in HUMANS]),
    )
    write_png(path, np.hstack([panel(title, points, coefficients) for title, points in panels]))


def panel(
    title: str, points: Sequence[tuple[float, Measurement]], coefficients: NDArray[np.float64]
) -> NDArray[np.uint8]:
    width, height, left, top, bottom = 460, 340, 60, 44, 46
    x = np.array([at for at, _ in points])
    measured = np.array([m.cpu for _, m in points])
    formula = np.array([float(np.dot(m.terms, coefficients)) for _, m in points])
    highest, farthest = 1.1 * max(measured.max(), formula.max()), 1.05 * x.max()
    image = np.full((height, width, 3), 255, np.uint8)

    def place(at: float, ms: float) -> tuple[int, int]:
        return (
            round(left + (width - left - 16) * at / farthest),
            round(height - bottom - (height - top - bottom) * ms / highest),
        )

    def write(text: str, at: tuple[int, int], ink: int = 60) -> None:
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (ink, ink, ink), 1, cv2.LINE_AA)

    for ms in ticks(highest):
        cv2.line(image, place(0, ms), place(farthest, ms), (228, 228, 228), 1)
        write(f"{ms:g}", (14, place(0, ms)[1] + 4))
    for at in ticks(farthest):
        write(f"{at:g}", (place(at, 0)[0] - 8, height - bottom + 18))
    cv2.line(image, place(0, 0), place(farthest, 0), (90, 90, 90), 1)
    line = np.array([place(at, ms) for at, ms in zip(x.tolist(), formula.tolist(), strict=True)])
    cv2.polylines(image, [line], False, (30, 110, 220), 2, cv2.LINE_AA)
    for at, ms in zip(x.tolist(), measured.tolist(), strict=True):
        cv2.circle(image, place(at, ms), 4, (220, 70, 40), -1, cv2.LINE_AA)
    write("CPU ms per frame: measured (dots), formula (line)", (14, 22), 20)
    write(title, (left, height - 10), 20)
    return image


def ticks(end: float) -> list[float]:
    """Round numbers up to an end."""
    step = 10.0 ** np.floor(np.log10(end))
    step *= next(part for part in (0.1, 0.2, 0.5, 1.0) if end / (part * step) <= 6.5 or part == 1.0)
    return [float(n * step) for n in range(int(end / step) + 1)]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=8, help="frames of each case (default: %(default)s)")
    parser.add_argument("--plot", type=Path, metavar="FILE", help="plot measurements and formula")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures as JSON")
    options = parser.parse_args()
    stage = Stage()
    print(f"{stage.renderer.device}, {os.cpu_count()} cores; {stage.triangles} triangles per human")
    measured = measure(stage, all_cases(), options.rounds)
    coefficients = fit(measured)
    print(f"\n{'cameras':>7} {'size':>10} {'humans':>6}", end="")
    print(f" {'CPU ms':>8} {'wall ms':>8} {'formula':>8} {'error':>6}")
    for m in measured:
        formula = float(np.dot(m.terms, coefficients))
        size = "x".join(map(str, m.case.size))
        print(
            f"{m.case.cameras:7} {size:>10} {m.case.humans:6} {m.cpu:8.1f} {m.wall:8.1f} "
            f"{formula:8.1f} {formula / m.cpu - 1:6.0%}"
        )
    error = np.array([abs(float(np.dot(m.terms, coefficients)) / m.cpu - 1) for m in measured])
    print("\nCPU ms per frame: the sum of")
    for (what, unit), value in zip(TERMS, coefficients.tolist(), strict=True):
        print(f"  {value * unit:7.2f} for {what}")
    print(f"error of the formula: {np.median(error):.0%} (median), {error.max():.0%} (maximum)")
    if options.plot:
        plot(options.plot, measured, coefficients)
    if options.json:
        rows = [{**vars(m), "case": vars(m.case)} for m in measured]
        figures = {"coefficients": coefficients.tolist(), "terms": [what for what, _ in TERMS], "cases": rows}
        options.json.write_text(json.dumps(figures, indent=2) + "\n")


if __name__ == "__main__":
    main()
