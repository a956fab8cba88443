"""Cost of a frame by number of humans, and time to load a human.

    python benchmarks/many.py [--frames 30]

1, 2, 5 and 10 random humans are simulated in one process for one 640x480 camera: motion, skinning, and the
channels rgb, depth, instance and part, beside a bare draw of the same humans. Times are CPU milliseconds of
this process, medians over frames, which other work on the machine affects little. The last column is the cost
of one more human, relative to one.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from benchmarks.core import BareDraw, Shot  # noqa: E402
from humansim_ros.cli.human import built_in_humans  # noqa: E402
from humansim_ros.humans.loading import load_human  # noqa: E402
from humansim_ros.io.assets import resource_path  # noqa: E402
from humansim_ros.scene import HumanState, Scene, Simulation  # noqa: E402

CAMERA = {"size": [640, 480], "position": [5.5, 5.0, 2.4], "look_at": [0, 0, 0.8], "fov_deg": 60}
VARIETY = {"seed": 1, "area": [-2.5, -2.5, 2.5, 2.5], "spacing": 1.0}
SCENE: dict[str, Any] = {"rate": 30, "room": {"size": [12, 12, 2.8]}, "cameras": {"eye": CAMERA}}
COUNTS = (1, 2, 5, 10)


def median_ms(work: Callable[[int], object], frames: int) -> float:
    """Median CPU milliseconds of a function of the frame number."""
    work(0)
    times = []
    for frame in range(1, frames + 1):
        start = time.process_time()
        work(frame)
        times.append(time.process_time() - start)
    return 1000 * float(np.median(times))


def bare_draw(scene: Scene, states: Mapping[str, HumanState]) -> Callable[[int], None]:
    """Function that draws all humans without anything else, see ``benchmarks/core.py``."""
    camera = scene.cameras["eye"]
    bodies = [actor.body(states[name].vertices) for name, actor in scene.actors.items()]
    draws: list[BareDraw] = []
    for body in bodies:
        draws.append(BareDraw(Shot(0, [body], camera), draws[0] if draws else None))

    def draw(_: int) -> None:
        with draws[0].context.current():
            draws[0].begin(camera)
            for one, body in zip(draws, bodies, strict=True):
                one.add(body)
            draws[0].read()

    return draw


def measure(count: int, frames: int) -> list[float]:
    """CPU milliseconds per frame: bare draw, skinning, rgb, all channels, and the whole frame."""
    scene = Scene.from_dict(SCENE | {"variety": {**VARIETY, "count": count}})
    simulation = Simulation(scene)
    camera = scene.cameras["eye"]
    states = {name: actor.at(1.0) for name, actor in scene.actors.items()}

    def render(*channels: str) -> object:
        bodies = [actor.body(states[name].vertices) for name, actor in scene.actors.items()]
        return simulation.renderer.render(bodies, camera, channels)

    parts = [
        median_ms(bare_draw(scene, states), frames),
        median_ms(lambda frame: [actor.at(frame / 30) for actor in scene.actors.values()], frames),
        median_ms(lambda _: render("rgb"), frames),
        median_ms(lambda _: render(*simulation.channels), frames),
        median_ms(simulation.frame, frames),
    ]
    simulation.close()
    return parts


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=30)
    frames = parser.parse_args().frames
    print(
        f"{'humans':>6} {'bare':>7} {'skinning':>9} {'rgb':>7} {'all':>7} {'frame':>7}   CPU ms; 1 more human"
    )
    first: float | None = None
    for count in COUNTS:
        parts = measure(count, frames)
        more = "" if first is None else f"{(parts[-1] - first) / (count - 1):6.1f}"
        first = parts[-1] if first is None else first
        print(
            f"{count:6} {parts[0]:7.1f} {parts[1]:9.1f} "
            + " ".join(f"{ms:7.1f}" for ms in parts[2:])
            + f"   {more}"
        )
    print()
    for name in built_in_humans():
        path = resource_path(f"assets/humans/{name}.npz")
        ms = median_ms(lambda _, path=path: load_human(path), 15)
        print(f"{name:16} loads in {ms:5.1f} ms of CPU")


if __name__ == "__main__":
    main()
