"""Simulation in one process: all of a frame has one stamp, and frames are reproducible."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from humansim_ros.scene import Frame, Scene, Simulation
from humansim_ros.scene.truth.camera_truth import VISIBLE

SCENE = """
rate: 30
humans:
  first: {motion: {file: walk, position: [0.0, -1.59], loop: continue}}
  second: {motion: {file: walk_straight, position: [0.4, 0.9], yaw_deg: 150, anchor: center, loop: repeat}}
cameras:
  left: {size: [200, 150], position: [3.0, 2.6, 2.0], look_at: [0, 0, 0.8]}
  right: {size: [160, 160], position: [-3.0, 2.6, 2.0], look_at: [0, 0, 0.8]}
"""


@pytest.fixture(scope="module")
def simulation(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Simulation]:
    path = tmp_path_factory.mktemp("scene") / "scene.yaml"
    path.write_text(SCENE)
    simulation = Simulation(Scene.load(path), start=5_000_000_000)
    yield simulation
    simulation.close()


def arrays(frame: Frame) -> list[np.ndarray]:
    views = [getattr(v, c) for v in frame.views.values() for c in ("rgb", "depth", "instance", "part")]
    return [*views, *(state.vertices for state in frame.humans.values())]


@pytest.mark.nightly
@pytest.mark.slow
def test_frames_follow_each_other_by_a_period_without_adding_up_errors(simulation: Simulation) -> None:
    frames = [frame for frame, _ in zip(simulation, range(3), strict=False)]
    assert [frame.stamp - 5_000_000_000 for frame in frames] == [0, 33_333_333, 66_666_667]
    assert simulation.scene.frame_time(3_000_000) == 100_000_000_000_000


@pytest.mark.nightly
@pytest.mark.slow
def test_the_same_scene_gives_the_same_bytes(simulation: Simulation, tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    again = Simulation(Scene.load(tmp_path / "scene.yaml"), start=5_000_000_000)
    for number in (0, 7):
        first, second = simulation.frame(number), again.frame(number)
        assert first.stamp == second.stamp
        for a, b in zip(arrays(first), arrays(second), strict=True):
            assert a.tobytes() == b.tobytes()
    again.close()


@pytest.mark.slow
def test_every_camera_sees_both_people_and_joints_lie_on_them(simulation: Simulation) -> None:
    frame = simulation.frame(11)
    for name, view in frame.views.items():
        assert set(np.unique(view.instance)) == {0, 1, 2}
        for label, human in enumerate(frame.humans, 1):
            seen = frame.joints[name][human]
            # the tips of fingers may lie beside their pixels, with nothing before them
            covered = (seen.visible == VISIBLE) & (seen.behind > 0)
            column, row = np.rint(seen.pixels[covered]).astype(int).T
            assert len(column) > 5
            assert (view.instance[row, column] == label).all()


@pytest.mark.slow
def test_only_what_is_asked_for_is_rendered(simulation: Simulation) -> None:
    quick = Simulation(simulation.scene, channels=("depth",), renderer=simulation.renderer)
    frame = quick.frame(0)
    assert all(view.channels == ("depth",) for view in frame.views.values())
