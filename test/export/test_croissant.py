"""The data card: hashes of the files, and patterns that find the images. tools/check_export.py reads them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from export_support import exported, index_of


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
    assert card["license"] == ["https://creativecommons.org/publicdomain/zero/1.0/"]
    assert card["conformsTo"] == "http://mlcommons.org/croissant/1.0"
