"""Simulations in worker processes, as the data loaders of PyTorch have them, and in threads."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from render_scenes import renderer_or_skip
from waiting import PATIENCE

from humansim_ros import Scene, Simulation
from humansim_ros.errors import RenderError

PROGRAM = Path(__file__).with_name("worker_program.py")
SCENE = {
    "room": None,
    "humans": {"anna": {"motion": "walk"}},
    "cameras": {"camera_1": {"size": [160, 120], "position": [3, 0, 1.6], "look_at": [0, 0, 0.9]}},
}


@pytest.mark.slow
@pytest.mark.parametrize("threads", ["2", pytest.param("0", marks=pytest.mark.nightly)])
def test_a_simulation_in_a_forked_process_works_or_says_why_not(threads: str) -> None:
    """It works if the driver has no threads, which fork does not copy."""
    renderer_or_skip().close()
    run = subprocess.run(
        [sys.executable, str(PROGRAM), str(PATIENCE / 10)],
        env={**os.environ, "LP_NUM_THREADS": threads},
        capture_output=True,
        text=True,
        check=False,
        timeout=2 * PATIENCE,
    )
    assert run.returncode == 0, run.stderr
    said = dict(line.split(": ", 1) for line in run.stdout.splitlines())
    image = said["here"]
    same = {"fork before OpenGL", "here again", "spawn"}
    refused = {"fork, used", "fork, new", "fork after close"}
    if threads == "0" and said["device"].startswith("llvmpipe"):
        same, refused = same | refused, set()
    assert {name: said[name] for name in same} == dict.fromkeys(same, image)
    assert said["fork, dropped"] == said["fork, closed"] == "done"
    for name in refused:
        assert 'Start worker processes with "spawn"' in said[name] and "LP_NUM_THREADS=0" in said[name]
    assert "cannot be copied to another process: make one in each" in said["spawn with a simulation"]


#: Uses the data set of docs/scene.md as a data loader does: a worker gets a copy of it.
LOADER = f"""
import multiprocessing
from frames import Frames, Scene, Simulation

if __name__ == "__main__":
    scene = Scene.from_dict({SCENE!r})
    with Simulation(scene, channels=("rgb", "depth")) as simulation:
        expected = [frame.views["camera_1"] for frame in simulation.frames(3)]
    frames = Frames(scene, len(expected))
    with multiprocessing.get_context("spawn").Pool(2) as workers:
        for view, (rgb, depth) in zip(expected, workers.map(frames.__getitem__, range(len(frames)))):
            print((rgb == view.rgb).all(), (depth == view.depth).all(), rgb.flags.writeable)
"""


@pytest.mark.nightly
@pytest.mark.slow
def test_the_data_set_of_the_documents_works_in_spawned_workers(tmp_path: Path) -> None:
    renderer_or_skip().close()
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "scene.md").read_text(), re.DOTALL)
    (tmp_path / "frames.py").write_text(next(block for block in blocks if "class Frames" in block))
    (tmp_path / "loader.py").write_text(LOADER)
    run = subprocess.run(
        [sys.executable, "loader.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE,
    )
    assert run.stdout == 3 * "True True True\n", run.stderr


def test_a_simulation_in_another_thread_is_refused_before_its_playback_moves() -> None:
    renderer_or_skip().close()
    with Simulation(Scene.from_dict(SCENE)) as simulation, ThreadPoolExecutor(1) as other:
        simulation.frame(3)
        elapsed = simulation.playback.elapsed
        with pytest.raises(RenderError, match="belong to the thread that made them: make one per thread"):
            other.submit(simulation.frame, 5).result()
        assert simulation.playback.elapsed == elapsed


def test_threads_simulate_a_scene_at_once_with_a_simulation_each() -> None:
    renderer_or_skip().close()
    scene = Scene.from_dict(SCENE)

    def images(_: int = 0) -> list[np.ndarray]:
        with Simulation(scene, channels=("rgb", "depth", "flow")) as simulation:
            return [frame.views["camera_1"].rgb for frame in simulation.frames(5)]

    expected = images()
    with ThreadPoolExecutor(2) as pool:
        for result in pool.map(images, range(2)):
            assert np.array_equal(result, expected)
