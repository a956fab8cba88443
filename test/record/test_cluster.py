"""Recording on a local Ray: workers that die or have no space, the index, resuming, wrong input."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from recipes import CAMERAS, TOPICS, Numbers, group

from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.data.engine.output import OutputFolder
from humansim_ros.data.engine.ray_cluster import write_part
from humansim_ros.data.recording_cluster import ClusterRecording, record_on_cluster
from humansim_ros.errors import BagError

FRAMES, SHARD_FRAMES = 12, 4


def recording(folder: Path, seed: int = 1) -> ClusterRecording:
    return ClusterRecording(Numbers(folder, seed, FRAMES), OutputFolder(str(folder / "bag")), SHARD_FRAMES)


def files(folder: Path) -> dict[str, bytes]:
    """Files of a bag, without hidden ones."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if not path.name.startswith(".")}


def messages(folder: Path) -> list[tuple[str, int, bytes]]:
    """Messages of a bag as rosbags reads it."""
    from rosbags.rosbag2 import Reader

    with Reader(folder) as reader:
        return [(connection.topic, stamp, bytes(data)) for connection, stamp, data in reader.messages()]


def chunks_of(folder: Path) -> dict[str, bytes]:
    """Files with messages of a bag."""
    return {name: content for name, content in files(folder).items() if name.endswith(".mcap")}


def bag_of_one_process(folder: Path) -> Path:
    with BagWriter(folder, TOPICS, compression="zstd") as writer:
        for index in range(FRAMES):
            chunks = group(index)
            for chunk in chunks:
                writer.append(chunk, ends_group=chunk is chunks[-1])
    return folder


def attempts(folder: Path) -> list[int]:
    """Number of attempts of the shards that have been begun."""
    firsts = [folder / f"pids_{first:02}" for first in range(0, FRAMES, SHARD_FRAMES)]
    return [len(path.read_text().split()) for path in firsts if path.exists()]


@pytest.mark.nightly
def test_shards_of_frames_are_the_files_of_one_bag(workers: Path, tmp_path: Path) -> None:
    done: list[int] = []
    progress = record_on_cluster(
        [recording(tmp_path)], "local", on_progress=lambda state: done.append(state.done)
    )
    assert set(files(tmp_path / "bag")) == {"bag_0.mcap", "bag_1.mcap", "bag_2.mcap", "metadata.yaml"}
    one = bag_of_one_process(tmp_path / "one")
    assert messages(tmp_path / "bag") == messages(one)
    assert len(messages(one)) == FRAMES * (1 + len(CAMERAS))
    assert done == [SHARD_FRAMES * 3, SHARD_FRAMES * 6, FRAMES * 3] and progress.frames == FRAMES * 3
    assert progress.size == sum(len(content) for content in chunks_of(tmp_path / "bag").values())
    workers_of_frames = {path.read_text() for path in tmp_path.glob("pids_*")}
    made = (tmp_path / "workers").read_text().split()
    assert len(made) == len(set(made)) == len(workers_of_frames), "a worker started twice"


@pytest.mark.nightly
def test_a_worker_that_is_killed_and_one_without_space_change_nothing(workers: Path, tmp_path: Path) -> None:
    for name in ("calm", "rough"):
        (tmp_path / name).mkdir()
    (tmp_path / "rough" / "kill_6").touch()
    (tmp_path / "rough" / "full_10").touch()
    record_on_cluster([recording(tmp_path / "calm")], "local")
    record_on_cluster([recording(tmp_path / "rough")], "local")
    assert attempts(tmp_path / "calm") == [1, 1, 1]
    assert attempts(tmp_path / "rough") == [1, 2, 2]
    assert chunks_of(tmp_path / "calm" / "bag") == chunks_of(tmp_path / "rough" / "bag")
    assert messages(tmp_path / "calm" / "bag") == messages(tmp_path / "rough" / "bag")


@pytest.mark.nightly
def test_a_shard_that_always_fails_is_named_and_resumed(workers: Path, tmp_path: Path) -> None:
    (tmp_path / "broken_6").touch()
    with pytest.raises(BagError) as caught:
        record_on_cluster([recording(tmp_path)], "local")
    assert "shards are missing (bag_1.mcap" in str(caught.value)
    assert "(frames 4 to 7 of left, right, top): ZeroDivisionError: no such number" in str(caught.value)
    assert "--resume" in str(caught.value)
    left = files(tmp_path / "bag")
    assert "metadata.yaml" not in left and "bag_1.mcap" not in left
    before = {path.name: path.read_text() for path in tmp_path.glob("pids_*")}
    (tmp_path / "broken_6").unlink()
    with pytest.raises(BagError, match="a recording has begun here; --resume completes it"):
        record_on_cluster([recording(tmp_path)], "local")
    with pytest.raises(BagError, match="another recording has begun here"):
        record_on_cluster([recording(tmp_path, seed=2)], "local", resume=True)
    record_on_cluster([recording(tmp_path)], "local", resume=True)
    for number in range(3):  # only what was missing
        if f"bag_{number}.mcap" in left:
            name = f"pids_{SHARD_FRAMES * number:02}"
            assert (tmp_path / name).read_text() == before[name]
    (tmp_path / "calm").mkdir()
    record_on_cluster([recording(tmp_path / "calm")], "local")
    assert messages(tmp_path / "bag") == messages(tmp_path / "calm" / "bag")
    whole = files(tmp_path / "bag")
    record_on_cluster([recording(tmp_path)], "local", resume=True)  # nothing is missing
    assert files(tmp_path / "bag") == whole


@pytest.fixture
def small_disk(workers: Path) -> Iterator[Path]:
    """The folder for temporary files of the workers has little space."""
    mount = ["mount", "-t", "tmpfs", "-o", "size=4k", "tmpfs", str(workers)]
    if not shutil.which("mount") or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("a small disk needs the right to mount (root)")
    yield workers
    subprocess.run(["umount", str(workers)], check=True)


@pytest.mark.nightly
def test_workers_without_space_leave_nothing_that_looks_whole(small_disk: Path, tmp_path: Path) -> None:
    with pytest.raises(BagError) as caught:
        record_on_cluster([recording(tmp_path)], "local")
    assert f"No space left on device on host {socket.gethostname()}; TMPDIR" in str(caught.value)
    assert "3 shards are missing (bag_0.mcap, bag_1.mcap, bag_2.mcap), after 4 attempts" in str(caught.value)
    assert set(files(tmp_path / "bag")) == {"recording.json"}
    assert list(small_disk.iterdir()) == []


@pytest.mark.nightly
def test_a_worker_of_another_version_is_refused(workers: Path, tmp_path: Path) -> None:
    ray = pytest.importorskip("ray")
    job = recording(tmp_path)
    part = replace(job.shards[0], version="0.0.1")
    with pytest.raises(Exception, match=r"and the driver 0\.0\.1: install the same everywhere"):
        ray.get(ray.remote(write_part).remote(job, part))
    assert list(tmp_path.iterdir()) == []


def test_an_output_that_exists_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bag").mkdir()
    with pytest.raises(BagError, match="bag: this path exists"):
        record_on_cluster([recording(tmp_path)], "local")
    with pytest.raises(BagError, match="there is no recording to resume here"):
        record_on_cluster([recording(tmp_path)], "local", resume=True)


def test_without_ray_its_installation_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(BagError, match=r"--ray needs Ray .*pip install 'humansim_ros\[ray\]'"):
        record_on_cluster([recording(tmp_path)], "local")
    assert list(tmp_path.iterdir()) == []


def unused_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


ADDRESSES = {
    "refused": ("127.0.0.1:{}", "Connection refused"),
    "client_refused": ("ray://127.0.0.1:{}", "Connection refused"),
    "silent": ("10.255.255.1:6379", "timed out"),
    "no_port": ("127.0.0.1", "HOST:PORT"),
    "wrong_port": ("127.0.0.1:x", "HOST:PORT"),
    "web": ("http://127.0.0.1:{}", "HOST:PORT"),
    "none_here": ("auto", "find any running Ray"),
}


@pytest.mark.parametrize("name", ADDRESSES)
def test_an_address_that_does_not_answer_is_named(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray = pytest.importorskip("ray")
    monkeypatch.setattr(ray, "is_initialized", lambda: False)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)

    def raising(error: OSError) -> Callable[..., None]:
        def function(*_: object, **__: object) -> None:
            raise error

        return function

    if name == "silent":  # some networks answer for every address
        monkeypatch.setattr(socket, "create_connection", raising(TimeoutError("timed out")))
    if name == "none_here":
        monkeypatch.setattr(ray, "init", raising(ConnectionError("Could not find any running Ray")))
    address, words = ADDRESSES[name][0].format(unused_port()), ADDRESSES[name][1]
    with pytest.raises(BagError, match=f"--ray {address}: .*({words})"):
        record_on_cluster([recording(tmp_path)], address)
    assert list(tmp_path.iterdir()) == []
