"""``humansim record --ray``: the bag of one machine from any number of workers, and wrong input."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from record_support import hashes, run, write_scene

from humansim_ros.cli.main import main

FRAMES = 8
RAY = ("--ray", "local")

Command = Callable[..., str]


@pytest.fixture
def refused(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run ``humansim record`` in this process; returns the error of exit code 2."""

    def command(*words: object) -> str:
        assert record_here(monkeypatch, *words) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1
        return error

    return command


def record_here(monkeypatch: pytest.MonkeyPatch, *words: object) -> int:
    """Run ``humansim record`` in this process, with the Ray of the tests."""
    with monkeypatch.context() as patch:
        patch.setattr(sys, "argv", ["humansim", "record", *map(str, words)])
        return main()


@pytest.mark.slow
def test_one_worker_and_three_record_the_bag_of_one_machine(
    workers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = write_scene(tmp_path)
    bags = {name: tmp_path / name / "bag" for name in ("alone", "one", "three")}
    alone = run(scene, bags["alone"], "--frames", FRAMES, "--jobs", 1)
    one = run(scene, bags["one"], "--frames", FRAMES, *RAY, "--jobs", 1, "--shard-frames", 3, "--merge")
    assert (alone[0], one[0]) == (0, 0), alone[2] + one[2]
    assert f"wrote {bags['one']}: {2 * FRAMES} camera-frames" in one[1]
    options = ["--frames", FRAMES, *RAY, "--shards", "cameras", "--merge"]
    assert record_here(monkeypatch, scene, "-o", bags["three"], *options) == 0
    assert hashes(bags["one"]) == hashes(bags["three"]) == hashes(bags["alone"])
    for bag in bags.values():
        assert [path.name for path in bag.parent.iterdir()] == ["bag"]


@pytest.mark.slow
def test_several_scenes_get_a_bag_each(
    workers: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    first = write_scene(tmp_path)
    second = first.with_name("other.yaml")
    second.write_text(first.read_text().replace("walk", "wave"))
    output = tmp_path / "bags"
    words = [first, second, "-o", f"file://{output}", "--frames", FRAMES, *RAY, "--shards", "scenes"]
    words += ["--topics", "*/joints"]
    assert record_here(monkeypatch, *words) == 0
    assert f"wrote 2 bags in file://{output}: {4 * FRAMES} camera-frames" in capsys.readouterr().out
    for name in ("scene", "other"):
        files = sorted(path.name for path in (output / name).iterdir())
        assert files == ["metadata.yaml", f"{name}_0.mcap"]
    assert record_here(monkeypatch, *words, "--resume") == 0
    assert "nothing is missing" in capsys.readouterr().out


def test_wrong_options_are_refused(refused: Command, tmp_path: Path) -> None:
    scene, bag = write_scene(tmp_path), tmp_path / "bag"
    few = ("--frames", FRAMES)
    assert "need --ray" in refused(scene, scene, "-o", bag, *few)
    assert "need --ray" in refused(scene, "-o", "memory://bag", *few)
    assert "different file names" in refused(scene, scene, "-o", bag, *few, *RAY)
    assert "--storage: shards are MCAP files" in refused(scene, "-o", bag, *few, *RAY, "--storage", "sqlite3")
    assert "--max-bag-size: each shard is a file" in refused(
        scene, "-o", bag, *few, *RAY, "--max-bag-size", 10000
    )
    assert "--shards" in refused(scene, "-o", bag, *few, *RAY, "--shards", "people")
    assert "--shard-frames" in refused(scene, "-o", bag, *few, *RAY, "--shard-frames", 0)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.yaml"]


def test_without_ray_or_its_cluster_nothing_is_written(
    refused: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pytest.importorskip("ray"), "is_initialized", lambda: False)
    scene, bag = write_scene(tmp_path), tmp_path / "bag"
    unreachable = refused(scene, "-o", bag, "--frames", FRAMES, "--ray", "127.0.0.1:1")
    assert "--ray 127.0.0.1:1: Ray cannot be reached at this address" in unreachable
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "pip install 'humansim_ros[ray]'" in refused(scene, "-o", bag, "--frames", FRAMES, *RAY)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.yaml"]
