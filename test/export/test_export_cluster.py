"""Exports on a local Ray: the files of one process, workers that die, resuming, and wrong input."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from commands import humansim
from export_support import SCENE, content, exported, index_of, job

from humansim_ros.data.engine.ray_cluster import ClusterPart, write_part
from humansim_ros.data.formats.exporting import Export, export_on_cluster
from humansim_ros.data.formats.plan import INDEX
from humansim_ros.data.formats.source import SimulatedSource
from humansim_ros.data.formats.writer import ExportFolder
from humansim_ros.errors import ExportError, HumansimError

FORMATS, FRAMES = "images,labels,webdataset", "2:7"


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The export of one process."""
    return exported(tmp_path_factory.mktemp("whole") / "out", FORMATS, frames=FRAMES)


def dying(root: Path, mark: Path) -> Export:
    """The same export, whose worker is killed once if ``mark`` exists."""
    from recipes import DyingSource

    made = job(root, FORMATS, frames=FRAMES)
    assert isinstance(made.source, SimulatedSource)
    source = DyingSource(made.source.simulated, made.source.formats, made.source.keypoints, mark=mark)
    return replace(made, source=source)


@pytest.mark.nightly
def test_workers_write_the_files_of_one_process_also_if_one_dies(
    workers: Path, tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(Path(__file__).parents[1] / "record")
    mark = tmp_path / "kill"
    mark.touch()
    done: list[int] = []
    state = export_on_cluster(
        dying(tmp_path / "out", mark),
        "local",
        shard_frames=2,
        on_progress=lambda progress: done.append(progress.done),
    )
    assert not mark.exists(), "no worker was killed"
    assert (state.done, state.new, sorted(done)[-1]) == (5, 5, 5)
    assert content(tmp_path / "out") == content(whole)


@pytest.mark.nightly
def test_frames_that_fail_are_named_and_resumed(cluster: None, tmp_path: Path, whole: Path) -> None:
    root = tmp_path / "out"
    made = job(root, FORMATS, frames=FRAMES)
    ExportFolder(root).write(INDEX, made.plan.index())
    block = root / "images/noisy/000004.png"
    block.mkdir(parents=True)  # no file can get this name
    with pytest.raises(ExportError) as caught:
        export_on_cluster(made, "local", shard_frames=1, resume=True)
    assert "frames 4 to 4: " in str(caught.value) and "cannot be written: Is a directory" in str(caught.value)
    assert "--resume writes them, and keeps the others" in str(caught.value)
    assert not index_of(root)["finished"]
    block.rmdir()
    with pytest.raises(ExportError, match="this path exists; choose another one, or continue with --resume"):
        export_on_cluster(made, "local")
    assert export_on_cluster(made, "local", resume=True).done == 5
    assert content(root) == content(whole)
    assert export_on_cluster(made, "local", resume=True).new == 0


def test_a_worker_without_the_folder_or_of_another_version_is_refused(tmp_path: Path) -> None:
    made = job(tmp_path / "out", "anipose")
    part = ClusterPart("frames 3 to 3", "frames 3 to 3", (3,), 1)
    with pytest.raises(ExportError, match="does not have this folder: export to one that all hosts share"):
        write_part(made, part)
    with pytest.raises(HumansimError, match=r"and the driver 0\.0\.1: install the same everywhere"):
        write_part(made, replace(part, version="0.0.1"))


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
    assert f"wrote {tmp_path / 'out'}: 5 frames" in humansim("export", *words, "--ray", "local").stdout
    of_ray, alone = content(tmp_path / "out"), content(whole)
    for files in (of_ray, alone):
        del files["index.json"]  # it has the name of the scene file
    assert of_ray == alone
