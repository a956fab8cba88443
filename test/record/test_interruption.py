"""A recording that is stopped, killed or out of space: a readable bag, which --resume makes whole."""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import warnings
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import ros_support  # noqa: F401  # skips without ROS
import yaml
from record_support import SCENE, hashes, run, start, workers_of, write_scene
from waiting import PATIENCE, existing, wait_until

from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.recording import PLAN
from humansim_ros.errors import HumansimWarning

pytest.importorskip("rosbags")
FRAMES = 30
#: Files that are split, so that both the middle of a file and its end are hit.
OPTIONS = ("--frames", FRAMES, "--max-bag-size", 1_000_000, "--compression", "lz4")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene"))


@pytest.fixture(scope="module")
def whole(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Hashes of the files of a recording that was not interrupted."""
    bag = tmp_path_factory.mktemp("whole") / "bag"
    code, _, err = run(scene, bag, *OPTIONS, "--jobs", 1)
    assert code == 0, err
    return hashes(bag)


def messages_of(bag: Path) -> int:
    """Number of messages that rosbags reads, each deserialised."""
    from rosbags.highlevel import AnyReader

    with AnyReader([bag]) as reader:
        return sum(1 for c, _, data in reader.messages() if reader.deserialize(data, c.msgtype))


def written(bag: Path) -> int:
    return sum(path.stat().st_size for path in bag.glob("*.mcap")) if bag.is_dir() else 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))])
def test_a_killed_recording_is_readable_and_is_completed(
    scene: Path, whole: dict[str, str], tmp_path: Path, seed: int
) -> None:
    generator = random.Random(seed)
    bag = tmp_path / "bag"
    process = start(scene, bag, *OPTIONS, "--jobs", 2, start_new_session=True)
    limit = generator.randrange(50_000, 3_000_000)
    assert wait_until(lambda: written(bag) > limit or process.poll() is not None)
    workers = workers_of(process)
    process.kill()
    process.communicate(timeout=PATIENCE)
    assert wait_until(lambda: not existing(workers))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)  # the last file was not finished
        with BagReader(bag) as reader:
            assert len(list(reader.messages())) > 0
    code, out, err = run(scene, bag, *OPTIONS, "--jobs", generator.choice((1, 2)), "--resume")
    assert code == 0, err
    assert "wrote" in out or "already" in out
    assert hashes(bag) == whole


@pytest.mark.slow
def test_ctrl_c_finishes_the_bag_and_says_how_to_go_on(
    scene: Path, whole: dict[str, str], tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    process = start(scene, bag, *OPTIONS, "--jobs", 2, start_new_session=True)
    # more than a file: a frame is 400,000 bytes, and the first chunk may end within it
    assert wait_until(lambda: written(bag) > 1_500_000 or process.poll() is not None)
    workers = workers_of(process)
    os.killpg(process.pid, signal.SIGINT)  # as the terminal does
    out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "Traceback" not in err
    assert f"of {FRAMES} frames are in the bag; the same command with --resume continues" in out
    assert not existing(workers)
    assert messages_of(bag) > 0
    code, _, err = run(scene, bag, *OPTIONS, "--resume")
    assert code == 0, err
    assert hashes(bag) == whole
    code, out, _ = run(scene, bag, *OPTIONS, "--resume")
    assert code == 0
    assert f"all {FRAMES} frames are in the bag already" in out
    assert hashes(bag) == whole


@pytest.mark.slow
@pytest.mark.nightly
def test_the_death_of_a_worker_ends_the_recording_with_whole_frames(
    scene: Path, whole: dict[str, str], tmp_path: Path
) -> None:
    bag = tmp_path / "bag"
    process = start(scene, bag, *OPTIONS, "--jobs", 2)
    assert wait_until(lambda: written(bag) > 200_000 or process.poll() is not None)
    workers = workers_of(process)
    os.kill(workers[1], signal.SIGKILL)
    _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert "Traceback" not in err
    assert "was killed by SIGKILL while it encoded frame" in err
    assert f"of {FRAMES} frames are in the bag; the same command with --resume continues" in err
    assert not existing(workers)
    assert messages_of(bag) > 0
    code, _, err = run(scene, bag, *OPTIONS, "--resume", "--jobs", 2)
    assert code == 0, err
    assert hashes(bag) == whole


@pytest.mark.nightly
@pytest.mark.slow
def test_a_full_disk_ends_the_recording_with_whole_frames(scene: Path, tmp_path: Path) -> None:
    options = ("--frames", 20, "--jobs", 1)
    code, _, err = run(scene, tmp_path / "whole", *options)
    assert code == 0, err
    bag = tmp_path / "bag"

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2_000_000, 2_000_000))

    process = start(scene, bag, *options, preexec_fn=limit)
    _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2
    assert str(bag) in err and "cannot be written: File too large; the bag ends after" in err
    assert messages_of(bag) > 0
    code, _, err = run(scene, bag, *options, "--resume")
    assert code == 0, err
    assert hashes(bag) == hashes(tmp_path / "whole")


def changed(text: str, folder: Path) -> Path:
    folder.mkdir()
    return write_scene(folder, text)


@pytest.mark.nightly
@pytest.mark.slow
def test_another_recording_is_not_continued(scene: Path, tmp_path: Path) -> None:
    bag = tmp_path / "bag"
    code, _, err = run(scene, bag, "--frames", 3, "--jobs", 1)
    assert code == 0, err
    before = hashes(bag)
    other = changed(SCENE.replace("[0, 3, 1.2]", "[0, 3, 1.3]"), tmp_path / "other")
    attempts: list[tuple[Path, tuple[Any, ...], str]] = [
        (other, ("--frames", 3), "the scene or a file of it has changed"),
        (scene, ("--frames", 4), "frames: 3 in the bag, 4 now"),
        (scene, ("--frames", 3, "--topics", "/bent/part/image"), "topics: /scene_time, "),
        (scene, ("--frames", 3, "--images", "png"), "images: raw in the bag, png now"),
        (scene, ("--frames", 3, "--compression", "zstd"), "compression: none in the bag, zstd now"),
        (scene, ("--frames", 3, "--max-bag-duration", 1), "max duration: 0.0 in the bag, 1.0 now"),
    ]
    for path, options, difference in attempts:
        code, _, err = run(path, bag, *options, "--resume", "--jobs", 1)
        assert code == 2
        assert "this bag is another recording" in err and difference in err
    metadata = yaml.safe_load((bag / "metadata.yaml").read_text())
    custom = metadata["rosbag2_bagfile_information"]["custom_data"]
    plan = json.loads(custom[PLAN])
    custom[PLAN] = json.dumps({**plan, "version": "0.1.0"})
    (bag / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    code, _, err = run(scene, bag, "--frames", 3, "--resume", "--jobs", 1)
    assert code == 2
    assert "version: 0.1.0 in the bag, " in err
    assert hashes(bag)["_0.mcap"] == before["_0.mcap"]


@pytest.mark.nightly
def test_nothing_of_the_memory_of_workers_has_a_name(scene: Path, tmp_path: Path) -> None:
    before = {path.name for path in Path("/dev/shm").iterdir()}
    process = start(scene, tmp_path / "bag", "--frames", 100_000, "--jobs", 2)
    try:
        assert wait_until(lambda: written(tmp_path / "bag") > 100_000 or process.poll() is not None)
        new = {path.name for path in Path("/dev/shm").iterdir()} - before
        assert not any("humansim" in name or "psm" in name for name in new)
    finally:
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=PATIENCE)
    assert process.returncode == 128 + signal.SIGTERM
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has just ended
            assert str(tmp_path / "bag").encode() not in line.read_bytes()
