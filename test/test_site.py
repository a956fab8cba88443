"""The site of the documentation: mkdocs builds it without a warning, and each page has its place in it."""

from __future__ import annotations

import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from conftest import ROOT
from waiting import PATIENCE

DOCS = ROOT / "docs"


class Loader(yaml.SafeLoader):
    """Reads mkdocs.yml, which names a Python function."""


Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda *_: None)


def config() -> dict[str, object]:
    return yaml.load((ROOT / "mkdocs.yml").read_text(), Loader)


def pages_of(nav: object) -> list[str]:
    """Pages of a part of the navigation."""
    if isinstance(nav, str):
        return [nav]
    parts = nav.values() if isinstance(nav, dict) else nav
    return [page for part in parts for page in pages_of(part)]


class Addresses(HTMLParser):
    """Collects the addresses that a page fetches when it is shown."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag in ("script", "img", "iframe", "source", "video"):
            self.fetched.append(values.get("src") or "")
        if tag == "link" and values.get("rel") in ("stylesheet", "icon", "preload"):
            self.fetched.append(values.get("href") or "")


def test_each_page_is_once_in_the_navigation() -> None:
    named = pages_of(config()["nav"])
    assert len(named) == len(set(named))
    existing = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    assert {page for page in named if not page.startswith("api/")} == existing


@pytest.fixture
def reference_pages(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "tools")
    return import_module("reference_pages")


@pytest.mark.parametrize("name", ["scene_keys.md", "commands.md"])
def test_the_reference_is_made_of_todays_code(reference_pages: ModuleType, name: str) -> None:
    text = (DOCS / "reference" / name).read_text()
    assert text == reference_pages.PAGES[name](), "run tools/doc_pages.py"


def test_the_page_of_topics_is_made_of_todays_topics(reference_pages: ModuleType) -> None:
    pytest.importorskip("rclpy")
    text = (DOCS / "reference" / "topics.md").read_text()
    assert text == reference_pages.topics_page(), "run tools/doc_pages.py"


def test_the_page_of_scene_keys_has_every_section_of_the_schema(reference_pages: ModuleType) -> None:
    from humansim_ros.scene.config.config import SceneConfig

    text = (DOCS / "reference" / "scene_keys.md").read_text()
    schema = SceneConfig.model_json_schema()
    for section in (schema, *schema["$defs"].values()):
        # a section that a text may stand for has the alternatives "text" and "section"
        section = next((part for part in section.get("anyOf", ()) if "properties" in part), section)
        for key in section["properties"]:
            assert f"\n| `{key}` | " in text, key
    assert "### cameras.*.sensor\n" in text and "#### cameras.*.faults.drop\n" in text


@pytest.mark.slow
@pytest.mark.nightly
def test_the_site_builds_without_a_warning_and_fetches_nothing_from_elsewhere(tmp_path: Path) -> None:
    for module in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(module, reason=f"{module} is not installed: pip install '.[docs]'")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        env={"NO_MKDOCS_2_WARNING": "1", "PATH": ""},
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
    )
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr
    for page in tmp_path.rglob("*.html"):
        parser = Addresses()
        parser.feed(page.read_text())
        elsewhere = [address for address in parser.fetched if re.match(r"(\w+:)?//", address)]
        assert not elsewhere, f"{page.relative_to(tmp_path)} fetches {elsewhere}"
    camera = (tmp_path / "api" / "cameras.html").read_text()
    assert 'id="humansim_ros.cameras.camera.camera.Camera.project"' in camera
    assert ":meth:" not in camera
    assert (tmp_path / "source" / "examples" / "live_mocap.py.html").is_file()
