"""Recipes: what is drawn depends on seed and number only, splits share nobody, and errors name their line."""

from __future__ import annotations

import copy
import math
import re
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
import yaml
from commands import humansim
from conftest import ROOT

from humansim_ros import Scene
from humansim_ros.data.datasets.draws import DRAWS, ChoiceDraw, draw_at
from humansim_ros.data.datasets.recipe import Recipe
from humansim_ros.errors import ExportError, SceneError
from humansim_ros.files.yaml.yaml import has_key

#: Two cameras around one or two people.
RECIPE: dict[str, Any] = yaml.safe_load("""
recipe: tiny
seed: 5
scenes: 6
frames: 2
splits: {train: 4, test: 2}
ring:
  count: 2
  radius: {uniform: [2.5, 3.5]}
  height: {uniform: [1, 2]}
  camera: {size: [48, 36], fov_deg: 70}
scene:
  rate: 2
  room: null
  variety: {count: {integer: [1, 2]}, motions: [walk, wave]}
""")


def changed(changes: dict[str, Any]) -> dict[str, Any]:
    """The recipe with some keys replaced; None removes one."""
    content = copy.deepcopy(RECIPE)
    for path, value in changes.items():
        *keys, last = path.split(".")
        at = content
        for key in keys:
            at = at.setdefault(key, {})
        if value is None:
            at.pop(last)
        else:
            at[last] = value
    return content


def recipe(folder: Path, **changes: Any) -> Recipe:
    return Recipe.load(written(folder, {key.replace("__", "."): value for key, value in changes.items()}))


def written(folder: Path, changes: dict[str, Any]) -> Path:
    path = folder / "recipe.yaml"
    path.write_text(yaml.safe_dump(changed(changes), sort_keys=False))
    return path


def numbers() -> Any:
    """Even numbers from 0 to 1."""
    return iter((k + 0.5) / 1000 for k in range(1000)).__next__


def test_draws_have_their_distributions() -> None:
    draws = {
        kind: draw_at({kind: value})
        for kind, value in {"uniform": [2, 4], "integer": [1, 3], "normal": [10, 2, 6, 14]}.items()
    }
    values = {}
    for kind, draw in draws.items():
        assert draw is not None
        uniform = numbers()
        values[kind] = [draw.value(uniform) for _ in range(1000)]
    assert values["uniform"] == pytest.approx([2 + 2 * (k + 0.5) / 1000 for k in range(1000)])
    counts = Counter(values["integer"])
    assert counts.keys() == {1, 2, 3} and all(abs(count - 1000 / 3) < 2 for count in counts.values())
    normal = values["normal"]
    assert min(normal) >= 6 and max(normal) <= 14 and sum(normal) / 1000 == pytest.approx(10, abs=1e-6)
    # variance of a normal distribution that is cut at two standard deviations: 1 - 4 phi(2) / (2 Phi(2) - 1)
    density = math.exp(-2) / math.sqrt(2 * math.pi)
    expected = 4 * (1 - 4 * density / math.erf(math.sqrt(2)))
    assert sum((value - 10) ** 2 for value in normal) / 1000 == pytest.approx(expected, rel=0.01)
    choice = ChoiceDraw(choice=("a", "b", "c"), weights=(3.0, 0.0, 1.0))
    uniform = numbers()
    assert Counter(choice.value(uniform) for _ in range(1000)) == {"a": 750, "c": 250}
    assert choice.likely == [(0, "a"), (2, "c")]
    assert draw_at({"uniform": True}) is None  # a key of people
    assert set(DRAWS) == {"uniform", "integer", "normal", "choice"}


def test_a_scene_depends_on_the_seed_and_its_number_only(tmp_path: Path) -> None:
    whole, fewer = recipe(tmp_path), recipe(tmp_path, scenes=3)
    assert [whole.scene(n, 0) for n in range(3)] == [fewer.scene(n, 0) for n in (0, 1, 2)]
    scenes = [whole.scene(n, 0) for n in range(6)]
    assert len({scene.model_dump_json() for scene in scenes}) == 6
    assert whole.scene(0, 1) != scenes[0]
    assert recipe(tmp_path, seed=6).scene(0, 0) != scenes[0]
    # another distribution of one value leaves the others
    other = recipe(tmp_path, ring__height={"uniform": [1, 3]}).scene(0, 0)
    before, after = (scene.cameras["camera_1"].position for scene in (scenes[0], other))
    assert before is not None and after is not None
    assert before[:2] == after[:2] and after[2] - 1 == pytest.approx(2 * (before[2] - 1), abs=2e-3)
    assert other.variety == scenes[0].variety
    # seeds that the recipe leaves out
    assert len({scene.variety.seed for scene in scenes if scene.variety}) == 6
    sensors = [camera.sensor.seed for scene in scenes for camera in scene.cameras.values()]
    assert len(set(sensors)) == 12


def test_cameras_of_a_ring_are_around_the_point_and_inside_the_room(tmp_path: Path) -> None:
    config = recipe(tmp_path, ring__count=8, ring__look_at=[1, 0, 1]).scene(0, 0)
    places = [camera.position for camera in config.cameras.values()]
    angles = [math.degrees(math.atan2(place[1], place[0] - 1)) for place in places if place]
    assert len(angles) == 8
    for number, angle in enumerate(angles):
        assert (angle - angles[0] - 45 * number + 180) % 360 - 180 == pytest.approx(0, abs=0.1)
    assert all(2.5 <= math.hypot(place[0] - 1, place[1]) <= 3.5 + 2e-3 for place in places if place)
    room = recipe(tmp_path, ring__count=8, ring__radius=9, ring__height=5, scene__room={"size": [6, 5, 3]})
    for camera in room.scene(0, 0).cameras.values():
        x, y, z = camera.position or (0, 0, 0)
        assert abs(x) <= 2.7 and abs(y) <= 2.2 and z == 2.7


def test_the_first_scenes_have_the_shares_of_the_splits(tmp_path: Path) -> None:
    shares = {"train": 0.7, "val": 0.2, "test": 0.1}
    people = {"count": 1, "people": {}}
    splits = recipe(tmp_path, scenes=1000, splits=shares, scene__variety=people).splits
    for count in (10, 37, 100, 1000):
        counts = Counter(splits[:count])
        assert all(abs(counts[name] - share * count) <= 1 for name, share in shares.items())


def test_no_body_is_in_two_splits(tmp_path: Path) -> None:
    for changes in (
        {"scene__variety": {"count": 3}},  # the built-in humans
        {"scene__variety": {"count": 3, "bodies": ["child", "adult_man", "adult_woman"]}},
        {"scene__humans": {"anna": {"body": {"choice": ["child", "adult_man", "adult_woman"]}}}},
        {"scene__variety": {"count": 2, "people": {"age": [20, 30]}}, "pool": 9},
    ):
        loaded = recipe(tmp_path, scenes=40, **changes)
        bodies: dict[str, set[str]] = {"train": set(), "test": set()}
        for number in range(40):
            config = loaded.scene(number, 0)
            assert config.variety is not None
            found = set(config.variety.bodies or ()) | {human.body for human in config.humans.values()}
            assert found
            bodies[loaded.splits[number]] |= {str(body) for body in found}
        assert all(bodies.values()) and not bodies["train"] & bodies["test"]
    assert len(bodies["train"]) == 6 and len(bodies["test"]) == 3


@pytest.mark.parametrize(
    ("changes", "key", "text"),
    [
        ({"scenez": 3}, "scenez", "did you mean `scene`?"),
        ({"seed": "abc"}, "seed", "found 'abc'"),
        ({"scenes": 10**9}, "scenes", "found 1000000000"),
        ({"frames": 10**9}, "frames", "found 1000000000"),
        ({"splits": {"train": 0, "test": 0}}, "splits", "sum to 0"),
        ({"splits": {}}, "splits", "at least one"),
        ({"formats": ["cocco"]}, "formats", "did you mean 'coco'?"),
        ({"keypoints": "coco18"}, "keypoints", "did you mean 'coco17'?"),
        ({"about.date": "yesterday"}, "about.date", "such as 2026-11-28"),
        ({"about.date": "2026-13-40"}, "about.date", "month must be in 1..12"),
        ({"scene": "other.yaml"}, "scene", "give a mapping of names to values"),
        ({"about.version": 1.0}, "about.version", "such as 1.0.0"),
        ({"require.visible": 3}, "require.visible", "from 0 to 1"),
        ({"ring.count": {"integer": [5, 2]}}, "ring.count", "the first number, 5, is above the second, 2"),
        ({"ring.count": {"integer": [0, 2]}}, "ring.count", "with 0: give a whole number from 1 to 100"),
        ({"ring.radius": {"uniform": [3]}}, "ring.radius.uniform.1", "give two numbers"),
        ({"ring.radius": {"unifrom": [3, 4]}}, "ring.radius", "did you mean 'uniform'?"),
        ({"ring.radus": 3}, "ring.radus", "did you mean `radius`?"),
        ({"ring.camera": {"fov_deg": {"uniform": [9, 200]}}}, "ring.camera.fov_deg", "with 200"),
        ({"ring.height": {"choice": []}}, "ring.height", "an empty choice"),
        ({"ring.height": {"choice": [1, 2], "weights": [0, 0]}}, "ring.height", "the weights sum to 0"),
        ({"ring.height": {"choice": [1, 2], "weights": [1]}}, "ring.height", "2 values need as many weights"),
        ({"ring.height": {"choice": [1], "weigths": [1]}}, "ring.height.weigths", "did you mean `weights`?"),
        ({"scene.variety.count": {"integer": [1, 5000]}}, "scene.variety.count", "with 5000"),
        ({"scene.variety.motions": ["wvae"]}, "scene.variety.motions.0", "did you mean 'wave'?"),
        ({"scene.variety.motions": {"choice": [["walk"], ["x.bvh"]]}}, "scene.variety.motions", "'x.bvh'"),
        ({"scene.variety.bodies": ["child"]}, "scene.variety.bodies", "2 splits need as many bodies"),
        ({"scene.humans": {"anna": "child"}}, "scene.humans.anna", "2 splits need as many bodies"),
        (
            {"ring.height": {"choice": [1, {"uniform": [1, 1001]}]}},
            *("ring.height.choice.1", "with 1001.0: give a number from -100 to 1000"),
        ),
        (
            {"scene.light": {"choice": [{}, {"strength": {"choice": [1, {"normal": [1, 1, -3, 2]}]}}]}},
            *("scene.light.choice.1.strength.choice.1", "with -3"),
        ),
        (
            {"scene.light": {"choice": [{}, {"strength": {"uniform": [1, 2]}, "sun_size_deg": -3}]}},
            *("scene.light", "sun_size_deg: give a number"),
        ),
        (
            {"scene.room": {"choice": [None, {"size": [6, {"uniform": [4, 6]}, 3]}]}},
            *("scene.room.choice.1.size.1", "with 4"),
        ),
        ({"scene.lihgt": {}}, "scene.lihgt", "did you mean `light`?"),
        ({"scene.light": {"strength": {"normal": [1, 0.1, 9, 9.5]}}}, "scene.light.strength", "nearly no"),
        ({"scene.light": {"strength": {"normal": [1, 0, 0, 2]}}}, "scene.light.strength.normal.1", "above 0"),
        ({"scene.world": {"meshes": ["hall.obj"]}}, "scene.world.meshes.0", "no such file"),
        ({"pool": 1, "scene.variety.people": {}}, "pool", "nobody is left for the split test"),
        ({"pool": 9}, "pool", "give scene.variety.people"),
        ({"ring": None}, "scene", "at least one camera"),
    ],
)
def test_wrong_recipes_are_errors_with_file_line_and_key(
    tmp_path: Path, changes: dict[str, Any], key: str, text: str
) -> None:
    path = written(tmp_path, changes)
    with pytest.raises(ExportError) as caught:
        Recipe.load(path)
    error = caught.value
    assert error.key == key and text in error.message
    assert error.path is not None and Path(error.path).name == path.name
    # the line of the key, or of the one above it that the file has
    assert error.line is not None
    line = path.read_text().splitlines()[error.line - 1]
    assert any(word in line for word in key.split(".")) or key.endswith((".0", ".1"))


def test_files_of_a_recipe_are_told_from_others(tmp_path: Path) -> None:
    path = written(tmp_path, {})
    assert has_key(path, "recipe")
    with pytest.raises(SceneError, match=r":1: recipe: this is a recipe of many scenes: `humansim export`"):
        Scene.load(path)
    scene = tmp_path / "scene.yaml"
    scene.write_text("rate: 5\ncameras: {}\n")
    assert not any(has_key(other, "recipe") for other in (scene, tmp_path / "no.yaml", tmp_path))
    for words in (
        ["check"],
        ["run"],
        ["record", "-o", tmp_path / "bag", "--frames", 1],
        ["view", "--no-browser"],
    ):
        done = humansim(*words, path)
        assert done.returncode == 2 and not done.stdout
        assert done.stderr == (
            f"error: {path}:1: recipe: this is a recipe of many scenes: `humansim export` draws them, and "
            "each has a scene.yaml\n"
        )


def test_a_recipe_that_cannot_be_met_names_the_line_to_blame(tmp_path: Path) -> None:
    path = written(tmp_path, {"attempts": 3, "require": {"cameras": 2, "pixels": 300}})
    with pytest.raises(ExportError) as caught:
        Recipe.load(path).draw(1)
    error = caught.value
    assert error.key == "require.pixels" and "scene 1 (test) cannot be drawn: 3 of 3 draws" in error.message
    assert error.line and "pixels" in path.read_text().splitlines()[error.line - 1]
    for require, blamed, text in (
        ({"cameras": 3}, "require.cameras", "it has 2 cameras, not 3"),
        ({"cameras": 1, "pixels": 37}, "require.pixels", "0 of its 2 images are 37 pixels high"),
    ):
        with pytest.raises(ExportError, match=text) as caught:
            recipe(tmp_path, attempts=2, require=require).draw(0)
        assert caught.value.key == blamed
    # more people than there is room for
    crowded = {"count": 4, "motions": ["wave"], "area": [0, 0, 0.1, 0.1]}
    with pytest.raises(ExportError, match="2 of 2 draws") as caught:
        recipe(tmp_path, attempts=2, scene__variety=crowded).draw(0)
    assert caught.value.key == "scene.variety.count"


def test_a_drawn_scene_fulfils_the_recipe(tmp_path: Path) -> None:
    drawn = recipe(tmp_path, require={"cameras": 1, "visible": 0.2, "pixels": 3}).draw(2)
    assert (
        drawn.split == "train" and drawn.scene.actors and set(drawn.scene.cameras) == {"camera_1", "camera_2"}
    )


def test_findings_and_warnings_are_no_clean_scene(tmp_path: Path) -> None:
    # three who walk cross each other in a square metre, which is a warning
    crossing = {"count": 3, "motions": ["walk"], "area": [0, 0, 1, 1], "spacing": 0.1}
    unclean = recipe(tmp_path, attempts=1, scene__variety=crossing, splits={"train": 1})
    assert len(unclean.draw(0).scene.actors) == 3
    clean = recipe(
        tmp_path, attempts=1, scene__variety=crossing, splits={"train": 1}, require={"clean": True}
    )
    with pytest.raises(ExportError, match="variety") as caught:
        clean.draw(0)
    assert caught.value.key == "require.clean"
    # a camera that sees nobody is a finding
    away = {"attempts": 1, "ring.look_at": [90, 0, 1], "require": {"clean": True}}
    with pytest.raises(ExportError, match="sees") as caught:
        Recipe.load(written(tmp_path, away)).draw(0)
    assert caught.value.key == "require.clean"


@pytest.mark.nightly
def test_nobody_of_a_pool_is_twice_in_a_scene(tmp_path: Path) -> None:
    people = {"count": 2, "people": {"age": [20, 40]}, "motions": ["wave"]}
    few = recipe(tmp_path, pool=2, scene__variety=people, attempts=2)
    with pytest.raises(ExportError, match="is there twice") as caught:
        few.draw(0)
    assert caught.value.key == "pool"
    names = {
        str(h.body)
        for h in recipe(tmp_path, pool=9, scene__variety=people).draw(0).scene.config.humans.values()
    }
    assert len(names) == 2


def test_the_recipe_of_the_page_is_valid(tmp_path: Path) -> None:
    (block,) = re.findall(r"```yaml\n(.*?)```", (ROOT / "docs/datasets.md").read_text(), re.DOTALL)
    path = tmp_path / "recipe.yaml"
    path.write_text(block)
    page = Recipe.load(path, 30)
    assert [page.scene(number, 0).rate for number in range(30)] == 30 * [2]
