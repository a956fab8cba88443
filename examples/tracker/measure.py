"""Measure the tracker on scenes of people on crossing paths, without ROS.

python examples/tracker/measure.py [--frames 150] [--seed 0]

Prints the tables of README.md: the mean error of joints (MPJPE) by pixel noise, number of cameras and number
of people, with hidden, dropped and false joints; missed and false people, identity switches, and speed.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from cameras import Camera
from detectors import NO_FAULTS, Faults, noisy_people
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from tracking import Detections, Person, Settings, Tracker

from humansim_ros import Scene, Simulation
from humansim_ros.scene import VISIBLE, Needs

Array = NDArray[np.float64]

#: A tracked person farther away from everybody (mean of the joints) is a false one, metres.
GATE = 0.5
BODIES = ("adult_man", "adult_woman", "tall_heavy_man", "slim_old_woman", "child")
#: Centres of the circles on which people walk, metres, and their directions: paths cross in the middle.
STARTS = (((0.0, -1.59), 0), ((0.0, 1.59), 180), ((1.2, 0.6), 90), ((-1.2, -0.4), -90), ((0.6, -1.0), 40),
          ((-0.4, 0.9), 220))  # fmt: skip


@dataclass(frozen=True)
class TruthFrame:
    """Truth of a frame.

    Attributes:
        stamp: Nanoseconds.
        cameras: Cameras at the stamp by name.
        sizes: Width and height of their images.
        pixels: Pixels (J, 2) of the joints by camera and person; NaN for joints that are not visible.
        joints: Positions (J, 3) in ``map`` by person, metres.
    """

    stamp: int
    cameras: dict[str, Camera]
    sizes: dict[str, tuple[int, int]]
    pixels: dict[str, dict[str, Array]]
    joints: dict[str, Array]


@dataclass
class Score:
    """Errors of a tracker, frame by frame."""

    errors: list[Array] = field(default_factory=list)
    people: int = 0
    missed: int = 0
    false: int = 0
    switches: int = 0
    joints: int = 0
    seconds: float = 0.0
    frames: int = 0
    last: dict[str, int] = field(default_factory=dict)

    @property
    def mpjpe(self) -> float:
        """Mean error of the reported joints, millimetres."""
        return 1e3 * float(np.mean(np.concatenate(self.errors))) if self.errors else float("nan")

    @property
    def recall(self) -> float:
        """Share of the joints of all people that were reported."""
        return sum(map(len, self.errors)) / self.joints

    def add(self, truth: dict[str, Array], people: Sequence[Person]) -> None:
        """Match people to the truth (Hungarian algorithm on the mean distance of joints), and count."""
        names = list(truth)
        distances = np.full((len(names), len(people)), 10 * GATE)
        for row, name in enumerate(names):
            for column, person in enumerate(people):
                difference = np.linalg.norm(person.positions - truth[name], axis=1)
                distances[row, column] = min(np.nanmean(difference), 10 * GATE)
        matched = 0
        for row, column in zip(*linear_sum_assignment(distances), strict=True):
            if distances[row, column] > GATE:
                continue
            matched += 1
            name, person = names[row], people[column]
            difference = np.linalg.norm(person.positions - truth[name], axis=1)
            self.errors.append(difference[np.isfinite(difference)])
            self.switches += self.last.get(name, person.identity) != person.identity
            self.last[name] = person.identity
        self.people += len(names)
        self.joints += sum(map(len, truth.values()))
        self.missed += len(names) - matched
        self.false += len(people) - matched
        self.frames += 1


def crossing_scene(people: int, cameras: int) -> dict[str, Any]:
    """Scene of people who walk on circles that cross, and of cameras around them."""
    step = 90 if cameras == 2 else 360 / cameras
    angles = np.radians(45 + step * np.arange(cameras))
    return {
        "rate": 30,
        "room": None,  # the walls of the default room would hide people from some cameras
        "humans": {
            f"person_{index}": {
                "body": BODIES[index % len(BODIES)],
                "motion": {
                    "file": "walk",
                    "position": list(position),
                    "yaw_deg": yaw,
                    "loop": "continue",
                },
            }
            for index, (position, yaw) in enumerate(STARTS[:people])
        },
        "cameras": {
            f"camera_{index}": {
                "size": [640, 480],
                "position": [float(4.2 * np.cos(angle)), float(4.2 * np.sin(angle)), 2.3],
                "look_at": [0, 0, 0.85],
                "fov_deg": 70,
            }
            for index, angle in enumerate(angles)
        },
    }


def truth_frames(config: dict[str, Any], count: int, rendered: bool = True) -> Iterator[TruthFrame]:
    """Truth of the first frames of a scene.

    ``rendered``: joints that are hidden are missing. Otherwise all joints inside of the image are visible,
    and nothing is rendered, which is quicker.
    """
    scene = Scene.from_dict(config)
    with Simulation(scene, channels=("depth", "instance", "part")) as simulation:
        for index in range(count):
            frame = simulation.frame(index, None if rendered else Needs())
            joints = {name: human.positions for name, human in frame.humans.items()}
            scene_cameras = {
                name: camera.camera_at(frame.camera_poses[name]) if camera.moves else camera.camera
                for name, camera in scene.scene_cameras.items()
            }
            pixels: dict[str, dict[str, Array]] = {}
            for name, camera in scene_cameras.items():
                pixels[name] = {}
                for human, positions in joints.items():
                    if rendered:
                        view = frame.joints[name][human]
                        uv, visible = view.pixels, view.visible == VISIBLE
                    else:
                        uv = camera.project(positions)[0]
                        visible = ((uv > -0.5) & (uv < np.array(camera.size) - 0.5)).all(axis=1)
                    pixels[name][human] = np.where(visible[:, None], uv, np.nan)
            yield TruthFrame(
                frame.stamp,
                {
                    name: Camera(each.K, each.R, each.center, each.model or "", each.distortion)
                    for name, each in scene_cameras.items()
                },
                {name: each.size for name, each in scene_cameras.items()},
                pixels,
                joints,
            )


def measure(frames: Sequence[TruthFrame], faults: Faults, settings: Settings | None = None) -> Score:
    """Track the people of some frames, as a detector with faults sees them."""
    tracker, score = Tracker(settings), Score()
    for frame in frames:
        detections = {
            name: Detections(
                camera,
                noisy_people(list(frame.pixels[name].values()), frame.sizes[name], faults, name, frame.stamp),
            )
            for name, camera in frame.cameras.items()
        }
        start = time.perf_counter()
        people = tracker.update(frame.stamp, detections)
        score.seconds += time.perf_counter() - start
        score.add(frame.joints, people)
    return score


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    print(
        "| people | cameras | noise, px | MPJPE, mm | joints found | missed | false | switches | frames/s |"
    )
    print("|---|---|---|---|---|---|---|---|---|")

    def add_row(people: int, cameras: int, frames: Sequence[TruthFrame], noise: float) -> None:
        faults = Faults(pixel_noise=noise, seed=options.seed) if noise else NO_FAULTS
        score = measure(frames, faults)
        print(
            f"| {people} | {cameras} | {noise:g} | {score.mpjpe:.1f} | {100 * score.recall:.1f} % "
            f"| {100 * score.missed / score.people:.1f} % | {score.false} | {score.switches} "
            f"| {score.frames / score.seconds:.0f} |",
            flush=True,
        )

    for people, cameras in [(3, 2), (3, 3), (3, 4), (3, 6), (1, 4), (2, 4), (4, 4), (6, 4), (6, 6)]:
        frames = list(truth_frames(crossing_scene(people, cameras), options.frames))
        for noise in (0, 1, 2, 4):
            add_row(people, cameras, frames, noise)


if __name__ == "__main__":
    main()
