"""States of a scene: each is computed once, and only those that are needed again are kept."""

from __future__ import annotations

from typing import Any

import pytest

from humansim_ros import Scene, Simulation
from humansim_ros.render.interface.channels import ADJACENT_NAMES
from humansim_ros.scene.core.playback import Playback
from humansim_ros.scene.core.simulation import SceneStates

RATE = 30
#: Rates, and offsets in frames of the scene.
TIMINGS = {
    "one rate": [(30, 0)],
    "several rates": [(30, 0), (15, 1), (3, 0)],
    "in turns": [(10, 0), (10, 1), (10, 2)],
}


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Scene times whose poses were computed, in this order."""
    times: list[int] = []
    show = Playback.show

    def counted(playback: Playback, elapsed: int, *arguments: Any) -> Any:
        times.append(elapsed)
        return show(playback, elapsed, *arguments)

    monkeypatch.setattr(Playback, "show", counted)
    return times


def scene_of(timings: list[tuple[int, int]], **sections: Any) -> Scene:
    place = {"size": [32, 24], "position": [3, 0.4, 1.4], "look_at": [0, 0, 1]}
    cameras = {
        f"camera_{number}": {**place, "rate": rate, "offset": first / RATE}
        for number, (rate, first) in enumerate(timings)
    }
    return Scene.from_dict({"rate": RATE, "room": None, "cameras": cameras, **sections})


@pytest.mark.parametrize("compared", [ADJACENT_NAMES, ADJACENT_NAMES[:1], ADJACENT_NAMES[1:]])
@pytest.mark.parametrize("timings", TIMINGS.values(), ids=TIMINGS)
def test_states_of_adjacent_frames_are_computed_once(
    computed: list[int], timings: list[tuple[int, int]], compared: Any
) -> None:
    scene = scene_of(timings)
    states = SceneStates(scene)
    most = 0
    for index in range(60):
        steps = {each.timing.step for each in scene.scene_cameras.values() if index in each.timing}
        adjacent = states.adjacent(index, steps, compared)
        states.at(index)
        for step in steps:
            for name, sign in zip(ADJACENT_NAMES, (1, -1), strict=True):
                if name in compared:
                    assert adjacent[step][name].scene_time == scene.frame_time(index + sign * step)
        assert len(computed) == len(set(computed))
        most = max(most, len(states._kept))
    assert most <= 1 + 3 * len(timings)


def test_each_frame_of_a_simulation_with_flow_both_ways_is_one_state_more(computed: list[int]) -> None:
    with Simulation(scene_of([(30, 0)]), channels=("flow", "flow_back")) as simulation:
        for frame in simulation.frames(6):
            assert simulation.playback.elapsed == frame.scene_time
    assert sorted(computed) == [simulation.scene.frame_time(index) for index in range(-1, 7)]


def test_states_of_sweeps_are_computed_once(computed: list[int]) -> None:
    lidar = {
        "pattern": {"elevations_deg": [0], "columns": 8},
        "rate": 8,
        "range": [0.1, 20],
        "position": [0, 0, 1],
    }
    states = SceneStates(scene_of([(30, 0)], scanners={"lidar": lidar}))
    sweeps = [sweep.number for index in range(40) for sweep in states.sweeps("lidar", index)]
    assert sweeps == list(range(10))
    assert len(computed) == len(set(computed))
    assert len(states._kept) <= 7
