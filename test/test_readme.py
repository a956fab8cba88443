"""The promises of the README: its code works as printed, its links lead somewhere, its topics exist."""

from __future__ import annotations

import ast
import json
import os
import re
import signal
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest
import yaml
from conftest import ROOT
from waiting import PATIENCE, wait_until

from humansim_ros.data.messages.camera_topics import MEASURED_DEPTH
from humansim_ros.render.interface.channels import CHANNEL_TABLE

README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)

#: Folders with pages besides docs/.
OTHER_PARTS = ("assets", "examples", "test/data", "benchmarks", "config")
#: The cameras that the README's tracker listens to, small.
SCENE = """
room: null
humans: {walker: {motion: {file: walk, position: [0, -1.59], loop: continue}}}
cameras:
  camera_1: {size: [64, 48], position: [3, 2.6, 2], look_at: [0, 0, 1]}
  camera_2: {size: [64, 48], position: [-3, 2.6, 2], look_at: [0, 0, 1]}
"""


def test_the_tracker_of_the_readme_hears_the_cameras(tmp_path: Path) -> None:
    from ros_support import write_scene

    tracker = tmp_path / "tracker.py"
    tracker.write_text(next(block for block in BLOCKS if "rclpy" in block))
    nodes = subprocess.Popen(
        [sys.executable, "-m", "humansim_ros.cli", "run", str(write_scene(tmp_path, SCENE))],
        stdout=subprocess.DEVNULL,
    )
    with (tmp_path / "heard").open("w") as output:
        listening = subprocess.Popen([sys.executable, "-u", str(tracker)], stdout=output, env={**os.environ})

        def heard() -> str:
            return (tmp_path / "heard").read_text()

        both = wait_until(lambda: "camera_1" in heard() and "camera_2" in heard())
        for process in (listening, nodes):
            process.send_signal(signal.SIGINT)
        assert nodes.wait(PATIENCE) == 0
        listening.wait(PATIENCE)
    assert both
    assert re.search(r"camera_1_optical_frame .*sec=\d+.* 64 48", heard()), heard()[:500]


def without_code(text: str) -> str:
    """A page without its blocks and spans of code, which may look like links."""
    return re.sub(r"```.*?```|`[^`\n]*`", "", text, flags=re.DOTALL)


def anchors(text: str) -> set[str]:
    """Anchors of the headings of a page, as GitHub makes them."""
    found: set[str] = set()
    for heading in re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.DOTALL), re.MULTILINE):
        words = re.sub(r"\[(.*?)\]\(.*?\)", r"\1", heading).lower()
        slug = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        again = [slug, *(f"{slug}-{number}" for number in range(1, 100))]
        found.add(next(name for name in again if name not in found))
    return found


def documents() -> list[Path]:
    pages = [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    return sorted([*pages, *(page for part in OTHER_PARTS for page in (ROOT / part).rglob("*.md"))])


@pytest.mark.parametrize("document", documents(), ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_of_a_document_leads_to_a_file_and_to_a_heading(document: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(document.read_text())):
        if re.match(r"\w+:", target):
            continue
        name, _, anchor = target.partition("#")
        path = document.parent / name if name else document
        assert path.exists(), f"{document.name} links to {target}"
        if anchor:
            assert anchor in anchors(path.read_text()), f"{document.name} links to {target}"


def test_anchors_are_those_of_github() -> None:
    text = "# A `code`: b/c\n## Same\n## Same\n```\n# no heading\n```\n## humans.*.motion_x\n"
    assert anchors(text) == {"a-code-bc", "same", "same-1", "humansmotion_x"}


PARSERS: dict[str, Callable[[str], object]] = {
    "json": json.loads,
    "python": ast.parse,
    "xml": ElementTree.fromstring,
    "yaml": yaml.safe_load,
}
#: Blocks that no parser checks: output and shell sessions.
PLAIN = {"diff", "toml", "text", "bash", "console"}


@pytest.mark.parametrize("document", documents(), ids=lambda path: str(path.relative_to(ROOT)))
def test_every_block_of_a_document_names_its_language_and_parses(document: Path) -> None:
    for language, block in re.findall(
        r"^```(.*?)\n(.*?)^```", document.read_text(), re.DOTALL | re.MULTILINE
    ):
        assert language in PARSERS or language in PLAIN, f"{document.name}: a block of {language!r}"
        PARSERS.get(language, str)(block)


def test_the_page_of_topics_lists_topics_that_the_nodes_have() -> None:
    page = (ROOT / "docs" / "topics.md").read_text()
    source = "".join(path.read_text() for path in (ROOT / "humansim_ros").rglob("*.py"))
    topics = [channel.topic.format(body="<name>") for channel in CHANNEL_TABLE.values()]
    topics += [channel.rectified_topic for channel in CHANNEL_TABLE.values()]
    topics += [f"{space}/image_raw" for space in MEASURED_DEPTH]
    source += " ".join([*topics, *(f"{topic.rpartition('/')[0]}/camera_info" for topic in topics)])
    for topic in re.findall(r"`/<camera>/([a-z_/]+)`", page):
        assert topic in source, topic
    for topic in re.findall(r"`/humans/<id>/([a-z_/]+)`", page):
        assert f"/{topic}" in source or f'"{topic}"' in source, topic


def test_the_scene_of_the_documents_loads_and_every_key_is_described(tmp_path: Path) -> None:
    from humansim_ros.scene import Scene
    from humansim_ros.scene.config import camera_config, config

    text = (ROOT / "docs" / "scene.md").read_text()
    example = re.search(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert example
    scene = tmp_path / "scene.yaml"
    scene.write_text(example.group(1))
    assert len(Scene.load(scene).cameras) == 2
    sections = (config.HumanConfig, config.MotionConfig, config.ObjectConfig, camera_config.CameraConfig)
    cameras = (camera_config.RigConfig, camera_config.TrajectoryConfig, camera_config.RegionConfig)
    for section in (*sections, *cameras, config.RoomConfig, config.TimeConfig):
        for key in section.model_fields:
            assert f"`{key}`" in text or f".{key}`" in text, key


#: Words for defaults that stand for no value, or for one that another key or file gives.
NO_DEFAULT = re.compile(
    r"–|\d+, |(none|all|detected|computed|as of|as in|the first|by|its only|built-in|middle|see"
    r"|without|ideal|as fast)\b"
)


def test_the_defaults_of_the_page_of_scenes_are_those_of_the_schema() -> None:
    from humansim_ros.scene.config.config import SceneConfig

    compared, section = 0, ""
    for row in re.findall(r"^\|(.*)\|$", (ROOT / "docs" / "scene.md").read_text(), re.MULTILINE):
        first, keys, default, *_ = [*(cell.strip() for cell in row.split("|")), "", ""]
        if name := re.match(r"`(….)?([\w.<>]+)`", first):
            section = f"{section.partition('.<name>')[0]}.{name[2]}" if name[1] else name[2]
        model: Any = SceneConfig
        for part in section.replace(".<name>", "").split(".") if section else ():
            model = section_of(model.model_fields[part].annotation)
        for key in re.findall(r"`(\w+)`", keys):
            field = model.model_fields.get(key)
            value = None if field is None else field.get_default(call_default_factory=True)
            if value is None or not default or NO_DEFAULT.match(default):
                continue  # a section, or a default that depends on something else
            shown = yaml.safe_load(default)
            compared += 1
            assert shown in (value, list(value) if isinstance(value, tuple) else value), (section, key)
    assert compared > 40


def section_of(annotation: Any) -> Any:
    """The model in the annotation of a key."""
    if hasattr(annotation, "model_fields"):
        return annotation
    return next((found for part in get_args(annotation) if (found := section_of(part))), None)
