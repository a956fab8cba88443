"""Program of test_worker_processes.py: renders here and in worker processes, and prints a line for each."""

from __future__ import annotations

import gc
import hashlib
import multiprocessing
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from humansim_ros import HumansimError, Scene, Simulation

SCENE = {
    "room": None,
    "humans": {"anna": {"motion": "walk"}},
    "cameras": {"front": {"size": [160, 120], "position": [3, 0, 1.6], "look_at": [0, 0, 0.9]}},
}


class Frames:
    """Frames of a scene as a map-style data set of PyTorch, see docs/scene.md."""

    def __init__(self) -> None:
        self.scene = Scene.from_dict(SCENE)
        self.simulation: Simulation | None = None

    def __getitem__(self, index: int) -> str:
        if self.simulation is None:  # made by the process that uses it
            self.simulation = Simulation(self.scene, channels=("rgb", "depth"))
        return hashlib.sha256(self.simulation.frame(index).views["front"].rgb).hexdigest()[:8]

    def close(self) -> None:
        if self.simulation is not None:
            self.simulation.close()


def new(_: Frames) -> str:
    return Frames()[1]


def used(frames: Frames) -> str:
    return frames[1]


def dropped(frames: Frames) -> str:
    frames.simulation = None
    gc.collect()
    return "done"


def closed(frames: Frames) -> str:
    frames.close()
    return "done"


def work(task: Callable[[Frames], str], frames: Frames, results: Connection) -> None:
    try:
        results.send(task(frames))
    except HumansimError as error:
        results.send(str(error))


def in_worker(method: str, task: Callable[[Frames], str], frames: Frames, limit: float) -> str:
    """Result of a task in a worker process, or ``hangs``."""
    context: Any = multiprocessing.get_context(method)
    results, end = context.Pipe(duplex=False)
    process = context.Process(target=work, args=(task, frames, end), daemon=True)
    process.start()
    end.close()
    try:
        return str(results.recv()) if results.poll(limit) else "hangs"
    except EOFError:
        return "died"
    finally:
        process.kill()
        process.join()


def main(limit: float) -> None:
    frames, unused = Frames(), Frames()
    print("fork before OpenGL:", in_worker("fork", used, frames, limit))
    print("here:", frames[1])
    simulation = frames.simulation
    assert simulation is not None
    print("device:", simulation.renderer.device)
    for task in (used, new, dropped, closed):
        print(f"fork, {task.__name__}:", in_worker("fork", task, frames, limit))
    print("here again:", frames[1])
    print("spawn:", in_worker("spawn", used, unused, limit))
    try:
        in_worker("spawn", used, frames, limit)
    except HumansimError as error:
        print("spawn with a simulation:", error)
    frames.close()
    print("fork after close:", in_worker("fork", new, frames, limit))


if __name__ == "__main__":
    main(float(sys.argv[1]))
