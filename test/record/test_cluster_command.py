"""``humansim record --ray``: the bag of one machine from any number of workers, and wrong input."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from commands import humansim
from record_support import write_scene

FRAMES = 8
RAY = ("--ray", "local")


def refused(*words: object) -> str:
    """Error of ``humansim record`` with exit code 2."""
    done = humansim("record", *words)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
    return done.stderr


def content(bag: Path) -> tuple[set[tuple[str, str]], list[tuple[str, int, bytes]]]:
    """Topics with their types, and messages of a bag as rosbags reads it."""
    from rosbags.rosbag2 import Reader

    with Reader(bag) as reader:
        topics = {(each.topic, each.msgtype) for each in reader.connections}
        return topics, [(each.topic, stamp, bytes(data)) for each, stamp, data in reader.messages()]


@pytest.mark.nightly
def test_workers_record_the_bag_of_one_machine(cluster: None, tmp_path: Path) -> None:
    scene, bags = write_scene(tmp_path), {name: tmp_path / name / "bag" for name in ("alone", "shards")}
    assert humansim("record", scene, "-o", bags["alone"], "--frames", FRAMES, "--jobs", 1).returncode == 0
    done = humansim("record", scene, "-o", bags["shards"], "--frames", FRAMES, *RAY, "--shard-frames", 3)
    assert done.returncode == 0, done.stderr
    assert f"wrote {bags['shards']}: {FRAMES} frames" in done.stdout
    files = [f"bag_{number}.mcap" for number in range(3)]
    assert sorted(path.name for path in bags["shards"].iterdir()) == [*files, "metadata.yaml"]
    assert content(bags["shards"]) == content(bags["alone"])


@pytest.mark.nightly
def test_several_scenes_get_a_bag_each(cluster: None, tmp_path: Path) -> None:
    first = write_scene(tmp_path)
    second = first.with_name("other.yaml")
    second.write_text(first.read_text().replace("walk", "wave"))
    output = tmp_path / "bags"
    words = [first, second, "-o", f"file://{output}", "--frames", FRAMES, *RAY]
    words += ["--topics", "*/joints"]
    done = humansim("record", *words)
    assert done.returncode == 0, done.stderr
    for name in ("scene", "other"):
        assert f"wrote file://{output}/{name}: {FRAMES} frames" in done.stdout
        files = sorted(path.name for path in (output / name).iterdir())
        assert files == ["metadata.yaml", f"{name}_0.mcap", f"{name}_1.mcap"]
    again = humansim("record", *words, "--resume").stdout
    assert again.count(f"all {FRAMES} frames are written already") == 2


@pytest.mark.nightly
def test_a_relative_output_is_in_the_folder_of_the_command(
    cluster: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers of Ray are in other folders."""
    scene = write_scene(tmp_path)
    monkeypatch.chdir(tmp_path)
    done = humansim("record", scene, "-o", "bag", "--frames", 2, *RAY, "--topics", "*/joints")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (tmp_path / "bag").iterdir()) == ["bag_0.mcap", "metadata.yaml"]


def test_wrong_options_are_refused(tmp_path: Path) -> None:
    scene, bag = write_scene(tmp_path), tmp_path / "bag"
    few = ("--frames", FRAMES)
    assert "need --ray" in refused(scene, scene, "-o", bag, *few)
    assert "need --ray" in refused(scene, "-o", "memory://bag", *few)
    assert "different file names" in refused(scene, scene, "-o", bag, *few, *RAY)
    for old in (("--shards", "cameras"), ("--merge",), ("--split",)):
        assert "has gone: --ray divides recordings by frames" in refused(scene, "-o", bag, *few, *RAY, *old)
    assert "--shard-frames" in refused(scene, "-o", bag, *few, *RAY, "--shard-frames", 0)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.yaml"]


def test_without_ray_or_its_cluster_nothing_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pytest.importorskip("ray"), "is_initialized", lambda: False)
    scene, bag = write_scene(tmp_path), tmp_path / "bag"
    unreachable = refused(scene, "-o", bag, "--frames", FRAMES, "--ray", "127.0.0.1:1")
    assert "--ray 127.0.0.1:1: Ray cannot be reached at this address" in unreachable
    monkeypatch.setitem(sys.modules, "ray", None)
    assert "pip install 'humansim_ros[ray]'" in refused(scene, "-o", bag, "--frames", FRAMES, *RAY)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.yaml"]
