"""Processes that render the images of a page."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from waiting import wait_until

from humansim_ros import Scene, Simulation
from humansim_ros.errors import HumansimError
from humansim_ros.view.sources.scene_source import ImageWorkers, Request, SceneViewSource
from humansim_ros.view.sources.source import JOINTS, FrameRequest

pytestmark = pytest.mark.process


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene.from_dict(
        {
            "room": None,
            "humans": {"anna": {"body": "child", "motion": "walk"}},
            "cameras": {"front": {"position": [3, 0, 1.2], "look_at": [0, 0, 0.6], "size": [160, 120]}},
        }
    )


@pytest.fixture(scope="module")
def workers(scene: Scene) -> Iterator[ImageWorkers]:
    """Processes of all tests, which come in this order: the last one kills them."""
    made = ImageWorkers(scene, 2)
    yield made
    made.close()


#: Makes workers that are copies of its process, prints their ids and a rendered image, and waits.
COPIES = """
import sys, time
from humansim_ros import Scene
from humansim_ros.view.sources.scene_source import ImageWorkers, Request, SceneViewSource
workers = ImageWorkers(Scene.load(sys.argv[1]), 2, copies=True)
image = workers.exact(Request(7, ("front", "side"), ("rgb",), 160)).images["side"]["rgb"]
print(*(process.pid for process in workers._workers.processes), image.tobytes().hex(), flush=True)
time.sleep(600)
"""


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_copies_of_a_process_render_the_same_and_end_with_it(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(
        "room: null\nhumans: {anna: {body: child, motion: walk}}\ncameras:\n"
        "  front: {position: [3, 0, 1.2], look_at: [0, 0, 0.6], size: [160, 120]}\n"
        "  side: {position: [0, 3, 1.2], look_at: [0, 0, 0.6], size: [160, 120]}\n"
    )
    process = subprocess.Popen([sys.executable, "-c", COPIES, path], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        *pids, image = process.stdout.readline().split()
    finally:
        process.kill()  # they are not told
        process.wait()
    assert len(set(pids)) == 2
    assert wait_until(lambda: not any(is_running(int(pid)) for pid in pids))
    with Simulation(Scene.load(path), channels=("rgb",)) as simulation:
        assert bytes.fromhex(image) == simulation.frame(7).views["side"].rgb.tobytes()


def request(index: int, *channels: str) -> Request:
    return Request(index, ("front",), channels or ("rgb",), 160)


def test_images_are_those_of_the_simulation(workers: ImageWorkers, scene: Scene) -> None:
    images = workers.exact(request(7, "rgb", "depth", JOINTS)).images["front"]
    with Simulation(scene, channels=("rgb",)) as simulation:
        np.testing.assert_array_equal(images["rgb"], simulation.frame(7).views["front"].rgb)
    assert images["depth"].shape == images[JOINTS].shape == (120, 160, 3)
    assert (images[JOINTS] != images["rgb"]).any()


def test_steps_back_give_their_images(workers: ImageWorkers) -> None:
    """Also while images of later frames are on their way."""
    for index in range(4, 9):
        workers.latest(request(index))
    assert wait_until(lambda: workers.latest(request(9)) is not None)
    for index in (8, 7, 6, 7, 2):
        assert workers.exact(request(index)).request.index == index


def test_while_it_plays_images_never_go_back(workers: ImageWorkers) -> None:
    shown: list[int] = []
    index = 100  # after the frames of other tests

    def play() -> bool:
        nonlocal index
        index += 1
        images = workers.latest(request(index))
        if images is not None and images.request.index > 100:
            shown.append(images.request.index)
        return len(set(shown)) >= 6

    assert wait_until(play)
    assert shown == sorted(shown)


def test_another_scene_is_rendered_by_the_same_processes(workers: ImageWorkers, scene: Scene) -> None:
    other = Scene.from_dict(
        {
            "room": None,
            "humans": {"ben": {"body": "adult_man", "motion": "wave"}},
            "cameras": {"front": {"position": [3, 0, 1.2], "look_at": [0, 0, 1.0], "size": [160, 120]}},
        }
    )
    before = workers.exact(request(3))
    for index in (10, 11):  # answers of the old scene that are on their way
        workers.latest(request(index))
    started = workers._workers.processes
    workers.use(other)
    after = workers.exact(request(3))
    with Simulation(other, channels=("rgb",)) as simulation:
        expected = simulation.frame(3).views["front"].rgb
    np.testing.assert_array_equal(after.images["front"]["rgb"], expected)
    assert (after.images["front"]["rgb"] != before.images["front"]["rgb"]).any()
    for index in range(12, 18):
        workers.exact(request(index))
    assert workers._workers.processes == started and all(process.is_alive() for process in started)


def test_a_process_that_dies_is_told(workers: ImageWorkers) -> None:
    workers.exact(request(1))
    for process in workers._workers.processes:
        process.kill()
        process.join()
    with pytest.raises(HumansimError, match="died"):
        workers.exact(request(2))


def test_the_page_shows_cameras_with_rates_of_their_own_in_every_frame(scene: Scene) -> None:
    slow = scene.config.model_dump()
    slow["cameras"]["front"] |= {"rate": 5.0, "offset": 0.1}
    source = SceneViewSource(Scene.from_dict(slow), workers=1)
    try:
        shown = source.frame(4, FrameRequest(("front",), ("rgb",), wait=True)).images["front"]["rgb"]
    finally:
        source.close()
    with Simulation(scene, ("rgb",)) as simulation:
        np.testing.assert_array_equal(shown, simulation.frame(4).views["front"].rgb)
