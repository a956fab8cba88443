"""The data card: hashes of the files, and patterns that find the images. tools/check_export.py reads them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from export_support import SCENE, exported, index_of

from humansim_ros import Scene
from humansim_ros.data.formats.croissant import card_header
from humansim_ros.data.formats.writer import ExportScene


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("card") / "out", "croissant,yolo")


@pytest.mark.nightly
def test_files_have_the_hashes_of_the_index(root: Path) -> None:
    card = json.loads((root / "croissant.json").read_text())
    files = {row["contentUrl"]: row for row in card["distribution"] if row["@type"] == "cr:FileObject"}
    assert {"yolo/dataset.yaml", "yolo/train.txt", "calibration.yaml"} <= set(files)
    index = index_of(root)["files"]
    for name, row in files.items():
        assert row["sha256"] == index[name]["sha256"]
        assert row["contentSize"] == f"{index[name]['bytes']} B"
    assert "croissant.json" in index


def test_patterns_find_the_images_of_each_camera(root: Path) -> None:
    card = json.loads((root / "croissant.json").read_text())
    sets = {row["@id"]: row for row in card["distribution"] if row["@type"] == "cr:FileSet"}
    for camera in ("noisy", "bent"):
        found = sorted(path.name for path in root.glob(sets[f"images-{camera}"]["includes"]))
        assert found == ["000003.png", "000004.png"]
        (records,) = [row for row in card["recordSet"] if row["@id"] == f"frames-{camera}"]
        assert all(field["source"]["fileSet"]["@id"] in sets for field in records["field"])
    assert card["citeAs"] == "humansim_ros: scene, 1.0.0" and "datePublished" not in card
    assert card["license"] == ["https://creativecommons.org/publicdomain/zero/1.0/"]
    assert card["conformsTo"] == "http://mlcommons.org/croissant/1.0"


def test_a_card_has_what_the_scene_says_of_it() -> None:
    about = {
        "title": "Two people",
        "description": "For tests.",
        "creators": ["Ann Other"],
        "citation": "@misc{two}",
        "date": "2026-11-28",
        "url": "https://example.org/two",
    }
    known = ExportScene.of(Scene.from_dict({**yaml.safe_load(SCENE), "about": about}))
    card = card_header(known.about, "scene", "Made.", {"MIT": "", "CC0-1.0": "https://example.org/cc0"})
    assert card == {
        "name": "scene",
        "description": "For tests. Made.",
        "citeAs": "@misc{two}",
        "version": "1.0.0",
        "license": ["MIT", "https://example.org/cc0"],
        "creator": [{"@type": "sc:Person", "name": "Ann Other"}],
        "datePublished": "2026-11-28",
        "url": "https://example.org/two",
    }
    cited = ExportScene.of(Scene.from_dict({**yaml.safe_load(SCENE), "about": {"title": "Two people"}}))
    assert card_header(cited.about, "scene", "", {})["citeAs"] == "humansim_ros: Two people, 1.0.0"
