"""Camera-frames per second of the device that OpenGL finds, by cameras, pixels and people.

    python benchmarks/gpu.py [--device N] [--seconds 2] [--cases CAMERASxWIDTHxHEIGHTxPEOPLE ...]

Of each case: rgb, depth, instance and part with full read-back, rgb alone, the bare draw of ``core.py`` with
full read-back, and the same without read-back, whose images stay on the device. All take turns. "CPU" is the
share of the elapsed time in which this process computes: near 100 % or more, the processor is the limit,
otherwise the device or the read-back. Poses change with every frame; motion and skinning are computed before.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT))

from benchmarks.core import bare_draw_of  # noqa: E402
from humansim_ros.camera import Camera  # noqa: E402
from humansim_ros.render import CHANNELS, Body, GLRenderer  # noqa: E402
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
            renderer.render(bodies, camera, channels)

    return {
        "rgb, depth, instance, part": lambda number: ours(number, *CHANNELS),
        "rgb": lambda number: ours(number, "rgb"),
        "bare draw, read back": lambda number: bare(frames[number], cameras, True),
        "bare draw, on the device": lambda number: bare(frames[number], cameras, False),
    }


def measure(
    case: tuple[int, int, int, int], seconds: float, device: int | None
) -> dict[str, tuple[float, float]]:
    """Camera-frames per second and share of the processor, by work."""
    scene = scene_of(*case)
    cameras = list(scene.cameras.values())
    actors = scene.actors.values()
    frames = [[actor.body(actor.at(1 + pose / 30).vertices) for actor in actors] for pose in range(POSES)]
    with GLRenderer(scene.static_meshes, device=device) as renderer:
        doing = works(renderer, cameras, frames)
        spent = {name: [0, 0.0, 0.0] for name in doing}
        for work in doing.values():
            work(0)  # static scenes, programs and buffers
        end = time.perf_counter() + seconds * len(doing)
        for number in itertools.count():
            for name, work in doing.items():
                cpu, start = time.process_time(), time.perf_counter()
                work(number % POSES)
                sums = spent[name]
                sums[0] += len(cameras)
                sums[1] += time.perf_counter() - start
                sums[2] += time.process_time() - cpu
            if time.perf_counter() > end:
                break
    return {name: (count / elapsed, cpu / elapsed) for name, (count, elapsed, cpu) in spent.items()}


def _case(text: str) -> tuple[int, int, int, int]:
    cameras, width, height, people = (int(part) for part in text.split("x"))
    return cameras, width, height, people


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--device", type=int, help="number in the order of EGL, GPUs first")
    parser.add_argument("--seconds", type=float, default=2.0, help="for each row")
    parser.add_argument("--cases", type=_case, nargs="+", default=CASES)
    options = parser.parse_args()
    with GLRenderer([], device=options.device) as renderer:
        print(f"on {renderer.device}")
    print(f"{'cameras':>7} {'pixels':>10} {'people':>6}  {'work':28} {'frames/s':>9} {'CPU':>5}")
    for case in options.cases:
        cameras, width, height, people = case
        for name, (rate, cpu) in measure(case, options.seconds, options.device).items():
            print(f"{cameras:7} {f'{width}x{height}':>10} {people:6}  {name:28} {rate:9.1f} {cpu:5.0%}")


if __name__ == "__main__":
    main()
