"""Files of Fast DDS in /dev/shm: those of killed processes are removed, and no others."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from ros_support import Client, write_scene
from waiting import wait_until

from humansim_ros.ros.graph import transport as shared_memory
from humansim_ros.ros.graph.transport import owned_names, remove_dead_files
from humansim_ros.ros.processes.node_processes import scene_processes
from humansim_ros.ros.processes.supervisor import Supervisor

SHM = Path("/dev/shm")
SEGMENT, PORT = "fastrtps_0123456789abcdef", "fastrtps_port22411"
COMPLETE, BEGUN = b"\2\0\0\0" + bytes(60), b"\1\0\0\0" + bytes(60)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder in place of /dev/shm, with files of a process that has ended long ago."""
    monkeypatch.setattr(shared_memory, "_FOLDER", tmp_path)
    for name, content in (
        (SEGMENT, COMPLETE),
        (f"{SEGMENT}_el", b""),
        (PORT, COMPLETE),
        (f"{PORT}_el", b""),
        (f"sem.{PORT}_mutex", b""),
        ("fastrtps_port22413", b""),
        ("fastrtps_port22415", BEGUN),
        ("fastrtps_of_the_user", b""),
        ("psm_0123", b""),
    ):
        (tmp_path / name).write_bytes(content)
        set_age(tmp_path / name, 60)
    return tmp_path


def set_age(path: Path, seconds: float) -> None:
    os.utime(path, (time.time() - seconds,) * 2)


@pytest.fixture
def locked(folder: Path) -> Iterator[None]:
    """The segment belongs to a process that lives."""
    with (folder / f"{SEGMENT}_el").open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_segments_of_dead_processes_and_unfinished_ports_are_removed(folder: Path) -> None:
    before = names(folder)
    remove_dead_files()
    unfinished = {"fastrtps_port22413", "fastrtps_port22415"}
    assert before - names(folder) == {SEGMENT, f"{SEGMENT}_el", *unfinished}


def test_a_segment_of_a_living_process_stays(folder: Path, locked: None) -> None:
    remove_dead_files()
    assert {SEGMENT, f"{SEGMENT}_el"} <= names(folder)


def test_files_that_a_process_may_be_making_stay(folder: Path) -> None:
    for name in (SEGMENT, f"{SEGMENT}_el", "fastrtps_port22413", "fastrtps_port22415"):
        set_age(folder / name, 1)
    before = names(folder)
    remove_dead_files()
    assert names(folder) == before


def test_files_of_other_users_stay(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = names(folder)
    other = os.geteuid() + 1
    monkeypatch.setattr(os, "geteuid", lambda: other)
    remove_dead_files()
    assert names(folder) == before


def test_without_shared_memory_nothing_is_removed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_memory, "_FOLDER", folder / "nothing")
    remove_dead_files()


def test_a_process_owns_the_segment_and_the_port_of_its_participant(ros: None) -> None:
    client = Client("owner")
    assert client.spin_until(lambda: [name for name in owned_names(os.getpid()) if "port" in name])
    own = owned_names(os.getpid())
    mapped = Path("/proc/self/maps").read_text()
    assert all(f"/dev/shm/{name}\n" in mapped for name in own)
    assert any("port" not in name for name in own), "a segment for its messages"
    client.close()


def test_an_unfinished_port_does_not_stop_the_next_node(ros: None, tmp_path: Path) -> None:
    """A node that was killed while it made its port: Fast DDS waits for ever for the other half."""
    client = Client("occupant")
    assert client.spin_until(lambda: owned_names(os.getpid()))
    ports = [name.partition("_port") for name in owned_names(os.getpid()) if "port" in name]
    prefix, number = ports[0][0], max(int(number) for _, _, number in ports)
    unfinished = [SHM / f"{prefix}_port{number + 2 * i}" for i in range(1, 9)]
    made = [path for path in unfinished if not path.exists()]
    for path in made:
        path.touch()
        set_age(path, 60)
    try:
        with Supervisor(scene_processes(write_scene(tmp_path), 1)) as nodes:
            answering = client.spin_until(
                lambda: nodes.dead() or len(client.node.get_node_names()) >= len(nodes.pids), 60
            )
            assert answering and not nodes.dead()
    finally:
        client.close()
        for path in made:
            path.unlink(missing_ok=True)


def test_killed_nodes_leave_nothing_in_shared_memory(ros: None, tmp_path: Path) -> None:
    client = Client("watcher")

    def complete(pid: int) -> bool:
        own = owned_names(pid)
        return {"port" in name for name in own} == {True, False} and all(
            (SHM / name).exists() for name in own
        )

    with Supervisor(scene_processes(write_scene(tmp_path), 1)) as nodes:
        pids = list(nodes.pids.values())
        assert client.spin_until(lambda: nodes.dead() or all(complete(pid) for pid in pids))
        own = set().union(*(owned_names(pid) for pid in pids))
        size = sum((SHM / name).stat().st_size for name in own)
        assert size > 60_000_000 * len(pids)
        for pid in pids:
            nodes._shared_memory.note([pid], now=True)
            os.kill(pid, signal.SIGKILL)
        assert wait_until(lambda: nodes.dead())
        assert any((SHM / name).exists() for name in own)
    # a test that runs beside this one may use a port again as soon as it is free
    others = [int(path.name) for path in Path("/proc").iterdir() if path.name.isdecimal()]
    own -= set().union(*(owned_names(pid) for pid in others))
    left = [path.name for path in SHM.iterdir() if any(name in path.name for name in own)]
    assert left == []
    client.close()


def test_the_next_start_removes_segments_of_killed_processes(ros: None, tmp_path: Path) -> None:
    script = (
        "import rclpy, time; rclpy.init(); node = rclpy.create_node('victim'); "
        "print('ready', flush=True); time.sleep(999)"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as victim:
        assert victim.stdout is not None and victim.stdout.readline() == "ready\n"
        segments = [name for name in owned_names(victim.pid) if "port" not in name]
        victim.kill()
    assert segments
    for name in segments:
        for path in (SHM / name, SHM / f"{name}_el"):
            set_age(path, 60)
    remove_dead_files()
    assert not [name for name in segments if (SHM / name).exists()]
