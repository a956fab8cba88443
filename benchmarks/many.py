"""Cost of a frame by number of humans, and time to load a human.

    python benchmarks/many.py [--frames 30] [--counts 1 2 5 10 30]

1, 2, 5, 10 and 30 random humans are simulated in one process for one 640x480 camera: motion, skinning, and
the channels rgb, depth, instance and part, beside a bare draw of the same humans and, if
HUMANSIM_BENCH_BLENDER names a Python with bpy, Blender's Workbench. All take turns frame by frame. Times are
medians over frames; other work on the machine affects processor time little, and ratios least.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from benchmarks.core import bare_draw_of, workbench  # noqa: E402
from humansim_ros.cli.human import built_in_humans  # noqa: E402
from humansim_ros.files.reading.assets import resource_path  # noqa: E402
from humansim_ros.people.loading.loading import load_human  # noqa: E402
from humansim_ros.scene import Scene, Simulation  # noqa: E402

CAMERA = {"size": [640, 480], "position": [5.5, 5.0, 2.4], "look_at": [0, 0, 0.8], "fov_deg": 60}
#: Half the side of the square of ten people, in metres; more people have as much room each.
HALF_SIDE = 2.5
SCENE: dict[str, Any] = {"rate": 30, "room": {"size": [12, 12, 2.8]}, "cameras": {"eye": CAMERA}}
COUNTS = (1, 2, 5, 10, 30)
BARE = "bare draw"


def measure(count: int, frames: int, blender: str) -> dict[str, tuple[float, float]]:
    """CPU and elapsed milliseconds of each work for a frame, all works in turn: medians over frames."""
    half = HALF_SIDE * max(count / 10, 1) ** 0.5
    variety = {"seed": 1, "area": [-half, -half, half, half], "spacing": 1.0, "count": count}
    scene = Scene.from_dict(SCENE | {"variety": variety})
    simulation = Simulation(scene)
    camera = scene.cameras["eye"]
    states = {name: actor.at(1.0) for name, actor in scene.actors.items()}
    bodies = [actor.body(states[name].vertices) for name, actor in scene.actors.items()]
    bare = bare_draw_of(bodies, camera)

    def render(*channels: str) -> object:
        new = [replace(body) for body in bodies]  # a new frame for the renderer, which caches them
        return simulation.renderer.render(new, camera, channels)

    works: dict[str, Callable[[int], object]] = {
        BARE: lambda _: bare(bodies, [camera], True),
        "motion, skinning": lambda frame: [actor.at(frame / 30) for actor in scene.actors.values()],
        "rgb": lambda _: render("rgb"),
        "the four": lambda _: render(*simulation.channels),
        "whole frame": simulation.frame,
    }
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in works}
    with workbench(blender, scene, [camera] * (frames + 1)) as (title, draw):
        for frame in range(frames + 1):
            for name, work in works.items():
                cpu, elapsed = time.process_time(), time.perf_counter()
                work(frame)
                times[name].append((time.process_time() - cpu, time.perf_counter() - elapsed))
            if title:  # the processor time of another process is not at hand
                times.setdefault("Workbench", []).append((float("nan"), draw(frame) / 1000))
    simulation.close()
    return {name: tuple(1000 * np.median(rows[1:], axis=0)) for name, rows in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS)
    options = parser.parse_args()
    blender = os.environ.get("HUMANSIM_BENCH_BLENDER", sys.executable)
    print(f"{'humans':>6} {'work':16} {'CPU ms':>8} {'times bare':>11} {'elapsed ms':>11} {'times bare':>11}")
    for count in options.counts:
        parts = measure(count, options.frames, blender)
        bare = parts[BARE]
        for name, (cpu, elapsed) in parts.items():
            ratios = cpu / bare[0], elapsed / bare[1]
            print(f"{count:6} {name:16} {cpu:8.1f} {ratios[0]:11.2f} {elapsed:11.1f} {ratios[1]:11.2f}")
    print()
    for name in built_in_humans():
        path, times = resource_path(f"assets/humans/{name}.npz"), []
        for _ in range(15):
            start = time.process_time()
            load_human(path)
            times.append(time.process_time() - start)
        print(f"{name:16} loads in {1000 * np.median(times):5.1f} ms of CPU")


if __name__ == "__main__":
    main()
