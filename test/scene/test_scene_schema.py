"""The JSON schema of scene files, for editors."""

from __future__ import annotations

import json
import re
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import yaml
from conftest import ROOT

from humansim_ros import HumansimError
from humansim_ros.scene.config.config import SceneConfig, check_config, schema_text

jsonschema = pytest.importorskip("jsonschema")
SCENES = sorted((ROOT / "config" / "scenes").glob("*.yaml"))
CAMERA = {"position": [3, 0, 2], "look_at": [0, 0, 1]}


@cache
def validator() -> Any:
    return jsonschema.Draft202012Validator(json.loads(schema_text()))


def test_the_committed_schema_is_that_of_the_code() -> None:
    """Write it again with: humansim schema -o config/scene.schema.json"""
    assert (ROOT / "config" / "scene.schema.json").read_text(encoding="utf-8") == schema_text()


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_built_in_scenes_fit_and_name_the_schema(path: Path) -> None:
    text = path.read_text()
    assert list(validator().iter_errors(yaml.safe_load(text))) == []
    line = text.splitlines()[0]
    name = line.removeprefix("# yaml-language-server: $schema=")
    assert (path.parent / name).resolve() == ROOT / "config" / "scene.schema.json"


def example_scenes() -> list[Any]:
    """Scenes of the documents."""
    found = []
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]:
        for number, block in enumerate(re.findall(r"```yaml\n(.*?)```", page.read_text(), re.DOTALL)):
            scene = yaml.safe_load(block)
            if not (isinstance(scene, dict) and set(scene) <= set(SceneConfig.model_fields)):
                continue
            with suppress(HumansimError):  # a tutorial adds a key of its own
                check_config({"cameras": {"c": CAMERA}} | scene)
                found.append(pytest.param(scene, id=f"{page.stem}-{number}"))
    return found


@pytest.mark.daily("README-0", "scene-*", "faults-0", "rigs-3")
@pytest.mark.parametrize("scene", example_scenes())
def test_scenes_of_the_documents_fit(scene: dict[str, Any]) -> None:
    assert list(validator().iter_errors(scene)) == []


@pytest.mark.parametrize(
    "scene",
    [
        {"humans": {"anna": {"body": "child", "motion": "walk"}}, "cameras": {"c": CAMERA}},
        {"humans": {"anna": "child"}, "cameras": {"c": CAMERA | {"faults": {"drop": 0.05, "clock": 0.01}}}},
        {"rig": {"file": "cams.json", "cameras": [54138969, "left"]}},
        {"cameras": {"c": {"calibration": "cams.json", "camera": 0}}},
        *(
            {"humans": {"anna": {"motion": {"hands": hands}}}, "cameras": {"c": CAMERA}}
            for hands in (
                "grip",
                {"pose": "fist", "side": "left"},
                ["grip", {"pose": "flat", "time": 1}],
                [],
                None,
            )
        ),
        *(
            {"humans": {"anna": {"face": face}}, "cameras": {"c": CAMERA}}
            for face in (
                "happiness",
                {"keys": "happiness"},
                {"keys": {"expression": "happiness", "time": 1}},
                {"keys": ["happiness", {"gaze": [1, 0, 1.5], "time": 2}]},
                {"keys": []},
            )
        ),
        {
            "humans": {"anna": {"reach": [{"to": [1, 0, 1]}, {"to": "ball", "at": [0, 0, 1], "start": 9}]}},
            "objects": {"ball": "sphere", "box": {"mesh": "box", "held_by": "anna"}},
            "cameras": {"c": CAMERA},
        },
        {"humans": {"anna": {"motion": "walk", "keyframes": "a.xml"}}, "cameras": {"c": CAMERA}},
    ],
)
def test_short_forms_and_numbers_as_names_fit(scene: dict[str, Any]) -> None:
    check_config(scene)
    assert list(validator().iter_errors(scene)) == []


@pytest.mark.daily("scene0")
@pytest.mark.parametrize(
    "scene",
    [
        {"rate": "fast", "cameras": {"c": CAMERA}},
        {"humen": {}, "cameras": {"c": CAMERA}},
        {"humans": {"anna": {"bodyy": "child"}}, "cameras": {"c": CAMERA}},
        {"humans": {"anna": {"motion": {"speed": -1}}}, "cameras": {"c": CAMERA}},
        {"cameras": {"c": CAMERA | {"size": [640]}}},
        {"cameras": {"c": CAMERA | {"faults": {"drop": 1.5}}}},
        {"cameras": {"c": CAMERA | {"faults": {"drop": "often"}}}},
        {"cameras": {"c": CAMERA}, "renderer": "blender"},
        {"humans": {"anna": {"motion": {"hands": 3}}}, "cameras": {"c": CAMERA}},
        {"humans": {"anna": {"motion": {"hands": [["grip"]]}}}, "cameras": {"c": CAMERA}},
        {"humans": {"anna": {"face": {"keys": {"emotion": "happiness"}}}}, "cameras": {"c": CAMERA}},
    ],
)
def test_mistakes_do_not_fit(scene: dict[str, Any]) -> None:
    assert list(validator().iter_errors(scene))
