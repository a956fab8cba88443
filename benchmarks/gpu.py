"""Camera-frames per second of the device that OpenGL finds, by cameras, pixels and people.

    python benchmarks/gpu.py [--device N] [--seconds 2] [--processes N]
        [--cases CAMERASxWIDTHxHEIGHTxPEOPLE ...]

Of each case: rgb, depth, instance and part with full read-back, rgb alone, the bare draw of ``core.py`` with
full read-back, and the same without read-back, whose images stay on the device. "CPU" is the share of the
elapsed time in which processes compute: near 100 % for each, the processor is the limit, otherwise the device
or the read-back. Poses change with every frame; motion and skinning are computed before. With several
processes, as of camera nodes or workers of a recording, each renders all cameras of a case at the same time;
frames and shares of all are added.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from benchmarks.core import bare_draw_of  # noqa: E402
from humansim_ros.cameras import Camera  # noqa: E402
from humansim_ros.render import CHANNELS, Body, GLRenderer, RenderRequest  # noqa: E402
from humansim_ros.scene import Scene  # noqa: E402

#: Cameras, width and height, people.
CASES = (
    *((count, 640, 480, 1) for count in (1, 4, 16)),
    (1, 1920, 1080, 1),
    (1, 3840, 2160, 1),
    *((4, 640, 480, people) for people in (10, 30, 100)),
)
#: Poses of the people, which are drawn again and again.
POSES = 8


def scene_of(cameras: int, width: int, height: int, people: int) -> Scene:
    """A room with people, and cameras around its middle that see all of it."""
    half = 2.0 * max(people / 6, 1) ** 0.5
    eyes = {
        f"camera_{number}": {
            "size": [width, height],
            "position": [1.6 * half * (-1) ** number, 1.6 * half * (-1) ** (number // 2), 2 + 0.02 * number],
            "look_at": [0, 0, 1],
            "fov_deg": 60,
        }
        for number in range(cameras)
    }
    variety = {"seed": 1, "count": people, "area": [-half, -half, half, half], "spacing": 0.8}
    room = {"size": [4 * half, 4 * half, 3]}
    return Scene.from_dict({"rate": 30, "room": room, "variety": variety, "cameras": eyes})


def works(
    renderer: GLRenderer, cameras: list[Camera], frames: list[list[Body]]
) -> dict[str, Callable[[int], object]]:
    """What is measured: functions of the frame number that draw all cameras."""
    bare = bare_draw_of(frames[0], cameras[0])

    def ours(number: int, *channels: str) -> None:
        bodies = [replace(body) for body in frames[number]]  # a new frame for the renderer, which caches them
        for camera in cameras:
            renderer.render_request(RenderRequest(bodies, camera, channels))

    return {
        "rgb, depth, instance, part": lambda number: ours(number, *CHANNELS),
        "rgb": lambda number: ours(number, "rgb"),
        "bare draw, read back": lambda number: bare(frames[number], cameras, True),
        "bare draw, on the device": lambda number: bare(frames[number], cameras, False),
    }


#: Waits until all processes are ready to measure.
_together: Callable[[], object] = int


def _start(together: Callable[[], object]) -> None:
    global _together
    _together = together


def measure(
    case: tuple[int, int, int, int], seconds: float, device: int | None
) -> dict[str, tuple[float, float]]:
    """Camera-frames per second and share of the processor, by work. All processes start each together."""
    scene = scene_of(*case)
    cameras = list(scene.cameras.values())
    actors = scene.actors.values()
    frames = [[actor.body(actor.at(1 + pose / 30).vertices) for actor in actors] for pose in range(POSES)]
    found = {}
    with GLRenderer(scene.static_meshes, device=device) as renderer:
        for name, work in works(renderer, cameras, frames).items():
            work(0)  # static scenes, programs and buffers
            _together()
            cpu, start = time.process_time(), time.perf_counter()
            elapsed = 0.0
            for number in itertools.count(1):
                work(number % POSES)
                elapsed = time.perf_counter() - start
                if elapsed > seconds:
                    break
            found[name] = number * len(cameras) / elapsed, (time.process_time() - cpu) / elapsed
    return found


def measure_together(processes: int, *case: object) -> dict[str, tuple[float, float]]:
    """Sums of what as many processes :func:`measure` at the same time."""
    if processes == 1:
        return measure(*case)  # type: ignore[arg-type]
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        processes, spawn, initializer=_start, initargs=(spawn.Barrier(processes).wait,)
    ) as pool:
        found = [task.result() for task in [pool.submit(measure, *case) for _ in range(processes)]]
    return {
        name: (sum(each[name][0] for each in found), sum(each[name][1] for each in found))
        for name in found[0]
    }


def _case(text: str) -> tuple[int, int, int, int]:
    cameras, width, height, people = (int(part) for part in text.split("x"))
    return cameras, width, height, people


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--device", type=int, help="number in the order of EGL, GPUs first")
    parser.add_argument("--seconds", type=float, default=2.0, help="for each row")
    parser.add_argument("--processes", type=int, default=1, help="that render at the same time")
    parser.add_argument("--cases", type=_case, nargs="+", default=CASES)
    options = parser.parse_args()
    with GLRenderer([], device=options.device) as renderer:
        print(f"on {renderer.device}")
    print(f"{'cameras':>7} {'pixels':>10} {'people':>6}  {'work':28} {'frames/s':>9} {'CPU':>5}")
    for case in options.cases:
        cameras, width, height, people = case
        found = measure_together(options.processes, case, options.seconds, options.device)
        for name, (rate, cpu) in found.items():
            print(f"{cameras:7} {f'{width}x{height}':>10} {people:6}  {name:28} {rate:9.1f} {cpu:5.0%}")


if __name__ == "__main__":
    main()
