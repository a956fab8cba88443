"""The frame loop of exports: processes, interruptions, full disks, the index, and wrong input."""

from __future__ import annotations

import hashlib
import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from export_support import SCENE, ExportJob, content, exported, index_of, job, small_scene
from waiting import PATIENCE

from humansim_ros import HumansimError, Scene
from humansim_ros.cameras import load_calibration
from humansim_ros.cli.main import main
from humansim_ros.data.engine import WorkProgress
from humansim_ros.data.formats.formats import EXPORT_FORMATS
from humansim_ros.data.formats.plan import parse_range
from humansim_ros.errors import ExportError, RenderError

FORMATS = "images,depth-png,labels"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return small_scene()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, scene: Scene) -> Path:
    return exported(tmp_path_factory.mktemp("whole") / "out", FORMATS, scene, frames="2:6")


def test_motions_are_exported_without_opengl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(_: Scene) -> None:
        raise RenderError("no OpenGL")

    monkeypatch.setattr(Scene, "make_renderer", missing)
    files = content(exported(tmp_path / "motions", "bvh,panoptic", frames="0:2"))
    assert {"bvh/anna.bvh", "bvh/bert.bvh"} <= files.keys()
    with pytest.raises(RenderError, match=r"^no OpenGL$"):
        exported(tmp_path / "images", "bvh,coco", frames="0:2")


@pytest.mark.nightly
def test_the_index_has_the_hash_of_every_file(whole: Path) -> None:
    index = index_of(whole)
    files = content(whole)
    assert index["finished"] and set(index["files"]) == set(files) - {"index.json"}
    for name, entry in index["files"].items():
        assert entry == {"sha256": hashlib.sha256(files[name]).hexdigest(), "bytes": len(files[name])}
    assert len([name for name in files if name.startswith("images/")]) == 2 * 4


def test_the_index_says_where_the_files_come_from(whole: Path) -> None:
    index = index_of(whole)
    assert (index["plan"]["first"], index["plan"]["end"], index["rate"]) == (2, 6, 20)
    assert index["provenance"]["scene"]["humans"]["bert"]["motion"]["position"] == [0.8, 0.3]
    assert index["provenance"]["seeds"]["cameras.noisy.sensor.seed"] == 0
    assert set(index["provenance"]["versions"]) == {"humansim_ros", "python", "numpy", "opencv"}


def test_the_index_tells_the_faults_of_each_frame_and_calibrations_stay_true(tmp_path: Path) -> None:
    faults = {"drop": 0.5, "trigger_delay": 0.01, "calibration": {"translation": 0.1, "focal": 0.05}}
    camera = {"size": [32, 24], "position": [3, 0, 1.5], "look_at": [0, 0, 1]}
    cameras = {"left": {**camera, "faults": faults}, "right": camera}
    made = Scene.from_dict({"room": None, "humans": {"anna": "child"}, "cameras": cameras})
    root = exported(tmp_path / "out", "images", made, frames="3:13")
    told = index_of(root)["provenance"]["faults"]
    schedule = made.scene_cameras["left"].faults
    assert schedule is not None and set(told) == {"left"}
    assert told["left"]["frames"] == {str(index): schedule.at(index).kinds for index in range(3, 13)}
    assert told["left"]["lost"] == [index for index in range(3, 13) if not schedule.at(index).sent]
    assert 0 < len(told["left"]["lost"]) < 10
    true = load_calibration(root / "calibration.yaml").cameras["left"]
    np.testing.assert_allclose(true.P, made.cameras["left"].P)
    published = told["left"]["published_calibration"]
    centre = -np.array(published["R"]).T @ published["t"]
    assert np.linalg.norm(centre - true.center) == pytest.approx(0.1, abs=1e-9)
    assert abs(published["K"][0][0] / true.K[0, 0] - 1) == pytest.approx(0.05, abs=1e-9)


class _InterruptionError(Exception):
    pass


def stop_after(frames: int) -> Callable[[WorkProgress], None]:
    def check(progress: WorkProgress) -> None:
        if progress.new == frames:
            raise _InterruptionError

    return check


def shards(root: Path, scene: Scene) -> ExportJob:
    """The export of ``whole``, with a shard for each frame."""
    made = job(root, FORMATS, scene, frames="2:6")
    return ExportJob(replace(made.export, shard_frames=1), root)


def test_an_interrupted_export_continues_to_the_same_files(tmp_path: Path, scene: Scene, whole: Path) -> None:
    """A shard of which a file is missing is written again; finished ones are not."""
    root = tmp_path / "out"
    made = shards(root, scene)
    with pytest.raises(_InterruptionError):
        made.run(on_progress=stop_after(4))
    assert not (root / "index.json").exists()
    (root / "labels/part/bent/000002.png").unlink()
    written = (root / "images/noisy/000003.png").stat().st_mtime_ns
    state = made.run(resume=True)
    assert (state.first, state.done, state.new) == (2, 4, 2)
    assert (root / "images/noisy/000003.png").stat().st_mtime_ns == written
    assert content(root) == content(whole)
    assert made.run(resume=True).new == 0


@pytest.mark.nightly
@pytest.mark.slow
def test_several_processes_write_the_same_files(tmp_path: Path, scene: Scene, whole: Path) -> None:
    root = tmp_path / "out"
    state = job(root, FORMATS, scene, frames="2:6").run(workers=2)
    assert state.new == 4 and state.size > 0
    assert content(root) == content(whole)


def test_another_export_is_not_continued(scene: Scene, whole: Path) -> None:
    with pytest.raises(
        ExportError, match=r"another export: end: 6 there, 7 now; formats: depth-png, labels only there"
    ):
        job(whole, "images", scene, frames="2:7").run(resume=True)
    changed = Scene.build(cameras={"c": {"position": [3, 0, 1], "look_at": [0, 0, 1]}}, room=None)
    with pytest.raises(ExportError, match="the scene, a file of it, or the bag has changed"):
        job(whole, FORMATS, changed, frames="2:6").run(resume=True)
    with pytest.raises(ExportError, match="this path exists; choose another one, or continue with --resume"):
        job(whole, FORMATS, scene, frames="2:6").run()


def test_resume_starts_an_export_that_has_not_begun(tmp_path: Path, scene: Scene, whole: Path) -> None:
    """A script gives the same command always."""
    assert job(tmp_path / "out", FORMATS, scene, frames="2:6").run(resume=True).new == 4
    assert content(tmp_path / "out") == content(whole)


def test_a_folder_without_an_export_is_not_continued(tmp_path: Path, scene: Scene) -> None:
    (tmp_path / "precious").touch()
    with pytest.raises(ExportError, match="no export that can be continued has begun here"):
        job(tmp_path, FORMATS, scene).run(resume=True)
    (tmp_path / "index.json").write_text("[]")
    with pytest.raises(ExportError, match="not the index of an export"):
        job(tmp_path, FORMATS, scene).run(resume=True)
    index = {"humansim_export": 1, "finished": False, "plan": {}}
    (tmp_path / "index.json").write_text(json.dumps(index))
    with pytest.raises(ExportError, match="begun by an older version: it cannot be continued"):
        job(tmp_path, FORMATS, scene).run(resume=True)


@pytest.mark.nightly
def test_a_file_that_cannot_be_written_leaves_whole_frames(tmp_path: Path, scene: Scene, whole: Path) -> None:
    root = tmp_path / "out"
    made = shards(root, scene)

    def block(progress: WorkProgress) -> None:
        if progress.new == 1:
            (root / "images/noisy/000003.png").mkdir(parents=True)  # no file can get this name

    with pytest.raises(HumansimError, match=r"images/noisy/000003.png: cannot be written: Is a directory"):
        made.run(on_progress=block)
    (root / "images/noisy/000003.png").rmdir()
    assert made.run(resume=True).new == 3
    assert content(root) == content(whole)


@pytest.mark.slow
def test_a_full_disk_ends_the_command_with_one_line(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    words = ["export", "scene.yaml", "--frames", "4", "-o", "out", "--format", "depth-npy", "--jobs", "1"]
    done = subprocess.run(
        [sys.executable, "-m", "humansim_ros.cli", *words],
        cwd=tmp_path,
        # Python would cut the bytecode of its modules
        env={**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (25_000, 25_000)),
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
        check=False,
    )
    assert done.returncode == 4
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    assert "cannot be written: File too large; finished shards stay, and the same command" in done.stderr
    assert not (tmp_path / "out").exists()


def command(patch: pytest.MonkeyPatch, *words: str) -> int:
    patch.setattr(sys, "argv", ["humansim", "export", *words])
    return main()


def test_the_formats_are_listed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    assert command(monkeypatch, "--list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(EXPORT_FORMATS)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--format", "imags"], "--format: no export format 'imags'; did you mean 'images'? There are "),
        (["--format", "coco", "--keypoints", "coco_17"], "no keypoint set 'coco_17'; did you mean "),
        (["--format", ","], "--format: give a format, such as coco; humansim export --list shows all"),
        (["--format", "images", "--range", "5:5"], "--range: a range is A:B, from A up to"),
    ],
)
def test_wrong_words_are_one_line_and_exit_code_2(
    words: list[str],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    output = str(tmp_path / "out")
    frames = [] if "--range" in words else ["--frames", "3"]
    given = [str(tmp_path / "scene.yaml"), *frames, "-o", output, *words]
    assert command(monkeypatch, *given) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {said}") and error.count("\n") == 1
    assert not Path(output).exists()


def test_frames_are_from_a_up_to_but_not_including_b() -> None:
    assert parse_range("3:5") == range(3, 5)
    assert parse_range(":5") == range(5)
    for text in ("", "5", ":", "5:", "5:3", "-1:3", "1:2:3", "a:b", "0:1.5", "0:999999999", "٣:٥"):
        with pytest.raises(ExportError, match="--range: a range is A:B"):
            parse_range(text)


def test_a_format_without_its_library_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, scene: Scene
) -> None:
    monkeypatch.setattr("humansim_ros.data.formats.formats.find_spec", lambda name: None)
    with pytest.raises(
        ExportError, match=r"depth-exr needs OpenEXR; .* pip install 'humansim_ros\[export\]'"
    ):
        job(tmp_path / "out", "depth-exr", scene)
