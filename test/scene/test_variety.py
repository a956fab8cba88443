"""Random humans: reproducible, at a distance from each other, in the configured number."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from humansim_ros.cli.human import built_in_humans
from humansim_ros.errors import SceneError
from humansim_ros.ros.processes import scene_processes
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.config import HumanConfig, load_config
from humansim_ros.scene.source import SceneSource
from humansim_ros.scene.variety import with_variety

CAMERA = {"eye": {"size": [160, 120], "position": [3.2, 2.9, 2.2], "look_at": [0, 0, 1]}}


def drawn(folder: Path, **variety: Any) -> dict[str, HumanConfig]:
    path = scene(folder, **variety)
    return with_variety(load_config(path), SceneSource.of_file(path)).humans


def scene(folder: Path, humans: Any = None, **variety: Any) -> Path:
    path = folder / "scene.yaml"
    path.write_text(yaml.safe_dump({"variety": variety, "cameras": CAMERA, "humans": humans or {}}))
    return path


def test_a_seed_draws_the_same_people_and_another_seed_others(tmp_path: Path) -> None:
    first = drawn(tmp_path, count=4, seed=3)
    assert list(first) == ["person_1", "person_2", "person_3", "person_4"]
    assert drawn(tmp_path, count=4, seed=3) == first
    assert drawn(tmp_path, count=4, seed=4) != first


def test_what_a_seed_draws_is_the_same_on_every_machine(tmp_path: Path) -> None:
    """Nodes on other hosts, with other versions of Python and NumPy, must choose the same humans."""
    person = drawn(tmp_path, count=1, seed=5)["person_1"]
    assert (person.body, person.outfit, person.motion.file) == ("tall_heavy_man", "plain", "sit_stand")
    assert person.motion.position == (pytest.approx(-1.8778), pytest.approx(0.9394))


def test_more_people_do_not_change_the_first(tmp_path: Path) -> None:
    few, many = drawn(tmp_path, count=2, seed=1), drawn(tmp_path, count=5, seed=1)
    assert list(many.values())[:2] == list(few.values())


def test_people_differ_and_keep_apart(tmp_path: Path) -> None:
    people = list(drawn(tmp_path, count=12, seed=2, area=[-4, -4, 4, 4], spacing=1.2).values())
    assert {person.body for person in people} == set(built_in_humans())
    assert len({(person.body, person.outfit) for person in people}) > 6
    assert len({person.motion.file for person in people}) > 3
    places = [person.motion.position for person in people]
    nearest = min(math.dist(a, b) for i, a in enumerate(places) for b in places[:i])
    assert nearest >= 1.2
    assert max(abs(x) for place in places for x in place) <= 4


def test_only_configured_bodies_and_motions_are_chosen(tmp_path: Path) -> None:
    people = drawn(tmp_path, count=6, bodies=["child"], motions=["run"], name="kid").values()
    assert {(person.body, person.motion.file) for person in people} == {("child", "run")}


def test_they_come_beside_the_scenes_own_humans_and_every_process_knows_them(tmp_path: Path) -> None:
    path = scene(tmp_path, humans={"anna": {"body": "adult_woman"}}, count=2)
    loaded = Scene.load(path)
    assert list(loaded.actors) == ["anna", "person_1", "person_2"]
    assert [actor.instance for actor in loaded.actors.values()] == [1, 2, 3]
    skinners = [p.parameters["human"] for p in scene_processes(path) if p.executable == "skinner"]
    assert skinners == ["anna", "person_1", "person_2"]


@pytest.mark.slow
def test_they_are_simulated(tmp_path: Path) -> None:
    simulation = Simulation(Scene.load(scene(tmp_path, count=3)), ("instance",))
    frame = simulation.frame(0)
    simulation.close()
    assert set(frame.humans) == {"person_1", "person_2", "person_3"}
    assert frame.views["eye"].instance.max() == 3


@pytest.mark.parametrize(
    ("variety", "key", "message"),
    [
        ({"count": 50, "area": [0, 0, 1, 1]}, "variety.count", "larger area"),
        ({"count": 1, "bodies": ["giant"]}, "variety.bodies", "no 'giant'"),
        ({"count": 1, "bodies": []}, "variety.bodies", "at least one"),
        ({"count": -1}, "variety.count", "from 0 to 1000 .*found -1"),
        ({"count": 10**9}, "variety.count", "from 0 to 1000"),
        ({"count": 1, "colour": 2}, "variety.colour", "unknown key; known here: count, seed"),
        ({}, "variety.count", "this key is missing: give a whole number"),
    ],
)
def test_a_wrong_variety_is_refused_with_its_key(
    tmp_path: Path, variety: dict[str, Any], key: str, message: str
) -> None:
    with pytest.raises(SceneError, match=message) as caught:
        Scene.load(scene(tmp_path, **variety))
    assert caught.value.key == key


def test_a_name_that_is_taken_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="person_1 already"):
        Scene.load(scene(tmp_path, humans={"person_1": {}}, count=1))
