"""Exports on a local Ray: the files of one process, workers that die, resuming, and wrong input."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from export_support import SCENE, exported, index_of, job

from humansim_ros.cli.main import main
from humansim_ros.errors import ExportError, HumansimError
from humansim_ros.export.cluster import _Frames, export_on_cluster, write_frames
from humansim_ros.export.export import Export
from humansim_ros.export.source import SimulatedSource

FORMATS, FRAMES = "images,labels,webdataset", "2:7"


def content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The export of one process."""
    return exported(tmp_path_factory.mktemp("whole") / "out", FORMATS, frames=FRAMES)


def dying(root: Path, mark: Path) -> Export:
    """The same export, whose worker is killed once if ``mark`` exists."""
    from recipes import DyingSource

    made = job(root, FORMATS, frames=FRAMES)
    assert isinstance(made.source, SimulatedSource)
    source = DyingSource(made.source.simulated, made.source.formats, made.source.keypoints, mark)
    return replace(made, source=source)


@pytest.mark.slow
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


@pytest.mark.slow
def test_frames_that_fail_are_named_and_resumed(workers: Path, tmp_path: Path, whole: Path) -> None:
    root = tmp_path / "out"
    made = job(root, FORMATS, frames=FRAMES)
    made.begin()
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
    with pytest.raises(ExportError, match="does not have this folder: export to one that all hosts share"):
        write_frames(made, _Frames((3,)))
    with pytest.raises(HumansimError, match=r"and the driver 0\.0\.1: install the same everywhere"):
        write_frames(made, _Frames((3,), "0.0.1"))


def test_wrong_options_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    words = ["--format", "anipose", "--frames", "3"]

    def refused(*more: Any) -> str:
        with monkeypatch.context() as patch:
            given = ["humansim", "export", str(tmp_path / "scene.yaml"), *words, *more]
            patch.setattr(sys, "argv", given)
            assert main() == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1
        return error

    output = str(tmp_path / "out")
    assert "--output: an export needs a folder; with --ray" in refused("-o", "memory://out", "--ray", "local")
    assert "--shard-frames" in refused("-o", output, "--ray", "local", "--shard-frames", "0")
    monkeypatch.setattr(pytest.importorskip("ray"), "is_initialized", lambda: False)
    unreachable = refused("-o", output, "--ray", "127.0.0.1:1")
    assert "--ray 127.0.0.1:1: Ray cannot be reached at this address" in unreachable
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "pip install 'humansim_ros[ray]'" in refused("-o", output, "--ray", "local")
    assert not Path(output).exists()


@pytest.mark.slow
def test_the_command_exports_on_ray(
    workers: Path,
    tmp_path: Path,
    whole: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    words = ["scene.yaml", "--format", FORMATS, "--range", FRAMES, "-o", "out", "--shard-frames", "3"]
    monkeypatch.setattr(sys, "argv", ["humansim", "export", *words, "--ray", "local"])
    assert main() == 0
    assert f"wrote {tmp_path / 'out'}: 5 frames" in capsys.readouterr().out
    of_ray, alone = content(tmp_path / "out"), content(whole)
    for files in (of_ray, alone):
        del files["index.json"]  # it has the name of the scene file
    assert of_ray == alone
