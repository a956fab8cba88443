"""Random humans: reproducible, at a distance from each other, in the configured number."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial import cKDTree

from humansim_ros.cli.human import built_in_humans
from humansim_ros.errors import HumansimWarning, SceneError
from humansim_ros.files import Mesh
from humansim_ros.people import make_person
from humansim_ros.people.makehuman.population import PeopleConfig, draw_people
from humansim_ros.ros.processes.node_processes import scene_processes
from humansim_ros.scene import Finding, Scene, Simulation, check_scene
from humansim_ros.scene.config.config import HumanConfig, load_config
from humansim_ros.scene.core.features import begin_draft
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.room.feature import fixtures, furnished_room
from humansim_ros.scene.features.variety.feature import FEATURE

CAMERA = {"eye": {"size": [160, 120], "position": [3.2, 2.9, 2.2], "look_at": [0, 0, 1]}}


def drawn(folder: Path, **variety: Any) -> dict[str, HumanConfig]:
    path = scene(folder, **variety)
    draft = begin_draft(load_config(path), SceneSource.of_file(path))
    FEATURE.expand(draft)
    return draft.config.humans


def scene(folder: Path, humans: Any = None, **variety: Any) -> Path:
    path = folder / "scene.yaml"
    room = {"room": variety.pop("room")} if "room" in variety else {}
    path.write_text(yaml.safe_dump({**room, "variety": variety, "cameras": CAMERA, "humans": humans or {}}))
    return path


def scene_of(count: int, seed: int, **settings: Any) -> Scene:
    choice = {key: settings.pop(key) for key in ("bodies", "motions") if key in settings}
    return Scene.from_dict(
        {"cameras": CAMERA, "variety": {"count": count, "seed": seed, **choice}, **settings}
    )


def people_findings(count: int, seed: int, **settings: Any) -> list[Finding]:
    found = check_scene(scene_of(count, seed, **settings))
    return [finding for finding in found if finding.key.startswith(("variety", "humans"))]


def paths_of(folder: Path, times: Any = None) -> dict[str, Any]:
    """Joints (N, 2) of everybody in the scene of a folder, seen from above."""
    times = np.arange(0, 15, 0.02) if times is None else times
    actors = Scene.load(folder / "scene.yaml").actors
    return {name: actor.joint_paths(times)[..., :2].reshape(-1, 2) for name, actor in actors.items()}


@pytest.mark.nightly
def test_a_seed_draws_the_same_people_and_another_seed_others(tmp_path: Path) -> None:
    first = drawn(tmp_path, count=4, seed=3)
    assert list(first) == ["person_1", "person_2", "person_3", "person_4"]
    assert drawn(tmp_path, count=4, seed=3) == first
    assert drawn(tmp_path, count=4, seed=4) != first


def test_what_a_seed_draws_is_the_same_on_every_machine(tmp_path: Path) -> None:
    """Nodes on other hosts, with other versions of Python and NumPy, must choose the same humans."""
    person = drawn(tmp_path, count=1, seed=5)["person_1"]
    assert (person.body, person.outfit, person.motion.file) == ("tall_heavy_man", "plain", "sit_stand")
    assert person.motion.position == (pytest.approx(-0.239), pytest.approx(0.502))


@pytest.mark.parametrize(
    ("people", "key", "message"),
    [
        ({"age": [1, 20]}, "age", "2"),
        ({"age": [30, 20]}, "age", "30, is above the second, 20"),
        ({"women": 1.5}, "women", "1"),
        ({"stature": [1.5, 3]}, "stature", "2.3"),
        ({"skin": [0, 10]}, "skin", "1"),
        ({"sex": "male"}, "sex", "women"),
    ],
)
def test_people_whom_nobody_can_draw(tmp_path: Path, people: Any, key: str, message: str) -> None:
    with pytest.raises(SceneError, match=rf"scene.yaml:\d+: variety.people.{key}.*{message}"):
        load_config(scene(tmp_path, count=2, people=people))
    with pytest.raises(SceneError, match="bodies to choose from, or people to draw, not both"):
        load_config(scene(tmp_path, count=2, people={}, bodies=["child"]))


@pytest.mark.slow
def test_people_are_drawn_instead_of_bodies(tmp_path: Path) -> None:
    """Their names hold all that a node needs to draw them, and each process builds the same mesh."""
    people = {"age": [20, 30], "women": 1, "uniform": True}
    humans = drawn(tmp_path, count=2, seed=3, people=people, motions=["wave"])
    names = [human.body for human in humans.values()]
    assert names == [f"person#3-{number},age=20..30,women=1,uniform" for number in range(2)]
    again = make_person(draw_people(3, 0, PeopleConfig(age=(20, 30), women=1, uniform=True)), "someone")
    first = scene(tmp_path, count=1, seed=3, people=people, motions=["wave"])
    loaded = Scene.load(first).actors["person_1"].human
    np.testing.assert_array_equal(loaded.mesh.vertices, again.mesh.vertices)
    np.testing.assert_array_equal(loaded.mesh.texture, again.mesh.texture)


def test_more_people_do_not_change_the_first(tmp_path: Path) -> None:
    few, many = drawn(tmp_path, count=2, seed=1), drawn(tmp_path, count=5, seed=1)
    assert list(many.values())[:2] == list(few.values())


@pytest.mark.nightly
@pytest.mark.slow
def test_people_differ_and_keep_apart(tmp_path: Path) -> None:
    people = drawn(tmp_path, count=12, seed=2, area=[-4, -4, 4, 4], spacing=1.2, room=None)
    assert {person.body for person in people.values()} == set(built_in_humans())
    assert len({(person.body, person.outfit) for person in people.values()}) > 6
    assert len({person.motion.file for person in people.values()}) > 3
    paths = paths_of(tmp_path)
    middles = [(path.min(axis=0) + path.max(axis=0)) / 2 for path in paths.values()]
    nearest = min(math.dist(a, b) for i, a in enumerate(middles) for b in middles[:i])
    assert nearest > 1.2 - 0.1  # of the paths, whose ends are sampled
    assert np.abs(middles).max() < 4 + 0.1


def test_only_configured_bodies_and_motions_are_chosen(tmp_path: Path) -> None:
    people = drawn(tmp_path, count=2, bodies=["child"], motions=["run"], name="kid").values()
    assert {(person.body, person.motion.file) for person in people} == {("child", "run")}


def test_everybody_gets_an_activity_of_its_own(tmp_path: Path) -> None:
    people = drawn(tmp_path, count=3, seed=2, bodies=["adult_man"], motions=["activity"]).values()
    files = [person.motion.file for person in people]
    assert all(file.startswith("activity#") for file in files)
    assert len(set(files)) == 3
    again = drawn(tmp_path, count=3, seed=2, bodies=["adult_man"], motions=["activity"]).values()
    assert [person.motion.file for person in again] == files


@pytest.mark.nightly
def test_random_people_walk_through_nothing() -> None:
    """A seed with runners."""
    assert people_findings(4, 6) == []


@pytest.mark.daily("10-0")
@pytest.mark.slow
@pytest.mark.parametrize(("count", "seed"), [(1, 10), (4, 11), (10, 0), (10, 6), (10, 12)])
def test_random_people_of_any_seed_walk_through_nothing(count: int, seed: int) -> None:
    """Seeds 0 to 29 have been tried with these counts."""
    assert people_findings(count, seed) == []


@pytest.mark.nightly
@pytest.mark.slow
def test_paths_of_any_time_stay_in_the_room_and_apart(tmp_path: Path) -> None:
    """Not only in the minute that the checks look at, and by distances that this test computes itself."""
    drawn(tmp_path, count=8, seed=6)
    loaded = Scene.load(tmp_path / "scene.yaml")
    assert loaded.environment.room is not None
    paths = paths_of(tmp_path, np.linspace(3600, 3620, 401))
    half = np.array(loaded.environment.room.size[:2]) / 2
    assert max(float((np.abs(path) - half).max()) for path in paths.values()) < -0.1
    trees = [cKDTree(path) for path in paths.values()]
    nearest = min(
        a.query(b.data, distance_upper_bound=2.0)[0].min() for i, a in enumerate(trees) for b in trees[:i]
    )
    assert nearest > 0.1


@pytest.mark.nightly
@pytest.mark.slow
def test_who_finds_no_place_for_a_motion_gets_one_that_stays_in_place(tmp_path: Path) -> None:
    """A run of five metres does not fit between a wall and its like; waving does."""
    people = drawn(tmp_path, count=6, bodies=["tall_heavy_man"], motions=["run", "wave"], seed=4).values()
    assert {person.motion.file for person in people} == {"run", "wave"}
    assert people_findings(6, 4, bodies=["tall_heavy_man"], motions=["run", "wave"]) == []


def test_people_who_find_no_place_are_named(tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match=r"scene.yaml:\d+: variety: no free place for .*person_6.*fewer"):
        people = drawn(tmp_path, count=6, bodies=["adult_man"], motions=["run"])
    assert len(people) == 6


@pytest.mark.nightly
@pytest.mark.slow
def test_random_people_keep_away_from_objects_and_the_scenes_own_humans(tmp_path: Path) -> None:
    """The pillar is taller than people and wider than they are: they must not stand in it."""
    own = {"anna": {"body": "adult_woman", "motion": {"file": "walk", "loop": "continue"}}}
    things = {
        "pillar": {"size": [1.2, 1.2, 2.7], "position": [0.9, -0.6, 1.35]},
        "table": {"mesh": "table", "position": [-1, -0.9, 0]},
    }
    mesh = Mesh(
        np.array([(-2.0, 0.8, 0), (-1.4, 0.8, 0), (-1.4, 1.4, 0), (-1.7, 1.1, 1.5)]),
        np.array([(0, 1, 2, -1), (0, 1, 3, -1), (1, 2, 3, -1), (2, 0, 3, -1)], dtype=np.int32),
    )
    world = {"meshes": [{"file": mesh}]}
    for seed in range(2):
        found = people_findings(2, seed, humans=own, objects=things, world=world)
        assert [finding.text for finding in found if "person" in finding.text] == []


@pytest.mark.nightly
@pytest.mark.slow
def test_an_object_around_everybody_is_a_room(tmp_path: Path) -> None:
    hall = {"hall": {"size": [7, 7, 4], "position": [0, 0, 2]}}
    for seed in range(2):
        scene = scene_of(4, seed, objects=hall, room=None)
        reach = [
            np.abs(actor.joint_paths(np.arange(0, 10, 0.1))[..., :2]).max() for actor in scene.actors.values()
        ]
        assert max(reach) < 3.5 - 0.1


def test_the_plan_of_the_furniture_is_that_of_the_room() -> None:
    size = (7.0, 6.4, 2.8)
    rectangles = [
        (np.array(c), np.array(s))
        for c, s in ((each.center, each.size) for each in fixtures(size[:2]).values())
    ]
    for mesh in furnished_room(size):
        points = np.asarray(mesh.vertices, dtype=float)
        near_wall = (np.abs(points[:, :2]) > np.array(size[:2]) / 2 - 0.02).any(axis=1)
        stands = points[~near_wall & (points[:, 2] > 0.1)][:, :2]
        inside = [(np.abs(stands - c) <= s / 2 + 1e-9).all(axis=1) for c, s in rectangles]
        assert np.any(inside, axis=0).all()


@pytest.mark.parametrize("seed", [1, 5])
def test_a_room_without_textures_has_the_same_shapes(seed: int) -> None:
    rooms = furnished_room(seed=seed), furnished_room(seed=seed, has_textures=False)
    for one, other in zip(*rooms, strict=True):
        np.testing.assert_array_equal(one.vertices, other.vertices)
        np.testing.assert_array_equal(one.faces, other.faces)


def test_they_come_beside_the_scenes_own_humans_and_every_process_knows_them(tmp_path: Path) -> None:
    path = scene(tmp_path, humans={"anna": {"body": "adult_woman"}}, count=2)
    loaded = Scene.load(path)
    assert list(loaded.actors) == ["anna", "person_1", "person_2"]
    assert [actor.instance for actor in loaded.actors.values()] == [1, 2, 3]
    skinners = [name for process in scene_processes(path, only="skinners") for name in process.visible_nodes]
    assert sorted(skinners) == ["skinner_anna", "skinner_person_1", "skinner_person_2"]


@pytest.mark.nightly
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
        ({"count": 1, "bodies": ["giant"]}, "variety.bodies", "no file 'giant'"),
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
