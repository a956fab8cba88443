"""Exported poses have no error: what one command writes, the other reads."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from humansim_ros.cli import main as cli

SCENE = """\
room: null
rate: 25
humans:
  anna: {motion: walk}
  bert: {body: adult_woman, motion: {file: wave, position: [1, 1.5]}}
cameras:
  front: {size: [64, 48], position: [4, 0, 1.5], look_at: [0, 0, 1]}
"""


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exported")
    (folder / "scene.yaml").write_text(SCENE)
    with pytest.MonkeyPatch.context() as patch:
        words = ["--frames", "3", "-o", "set", "--format", "panoptic,trc,c3d"]
        patch.chdir(folder)
        patch.setattr("sys.argv", ["humansim", "export", "scene.yaml", *words])
        assert cli.main() == 0
    return folder


@pytest.mark.parametrize(
    ("estimates", "people"), [(["set/panoptic"], 2), (["set/trc"], 2), (["set/c3d/bert.c3d"], 1)]
)
def test_exported_poses_are_the_truth(
    exported: Path, monkeypatch: pytest.MonkeyPatch, estimates: list[str], people: int
) -> None:
    words = ["--truth", "scene.yaml", "--estimate", *estimates, "--output", "result.json"]
    monkeypatch.chdir(exported)
    monkeypatch.setattr("sys.argv", ["humansim", "evaluate", *words])
    assert cli.main() == 0
    result = json.loads((exported / "result.json").read_text())
    assert result["frames"]["compared"] == 3
    assert result["people"]["found"] == 3 * people and result["people"]["false"] == 0
    assert result["position"]["worst"] < 1e-6
