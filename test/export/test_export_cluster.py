"""Exports on a local Ray: the files of one process, and wrong input."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from commands import humansim
from export_support import SCENE, content, exported

FORMATS, FRAMES = "images,labels,webdataset", "2:7"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The export of one process."""
    return exported(tmp_path_factory.mktemp("whole") / "out", FORMATS, frames=FRAMES)


@pytest.mark.nightly
def test_wrong_options_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)

    def refused(*more: Any) -> str:
        done = humansim("export", tmp_path / "scene.yaml", "--format", "anipose", "--frames", "3", *more)
        assert done.returncode == 2
        assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
        return done.stderr

    output = str(tmp_path / "out")
    assert "--output: an export needs a folder; with --ray" in refused("-o", "memory://out", "--ray", "local")
    assert "--shard-frames" in refused("-o", output, "--ray", "local", "--shard-frames", "0")
    monkeypatch.setattr(pytest.importorskip("ray"), "is_initialized", lambda: False)
    unreachable = refused("-o", output, "--ray", "127.0.0.1:1")
    assert "--ray 127.0.0.1:1: Ray cannot be reached at this address" in unreachable
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "pip install 'humansim_ros[ray]'" in refused("-o", output, "--ray", "local")
    assert not Path(output).exists()


@pytest.mark.nightly
def test_the_command_exports_on_ray(
    cluster: None, tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    words = ["scene.yaml", "--format", FORMATS, "--range", FRAMES, "-o", "out", "--shard-frames", "3"]
    assert "wrote out: 5 frames" in humansim("export", *words, "--ray", "local").stdout
    of_ray, alone = content(tmp_path / "out"), content(whole)
    for files in (of_ray, alone):
        del files["index.json"]  # it has the name of the scene file
    assert of_ray == alone
