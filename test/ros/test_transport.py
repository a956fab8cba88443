"""Transports: shared memory that fits into /dev/shm, and nodes that only this machine reaches."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import SimpleNamespace

import pytest
from conftest import ROOT
from ros_support import node_pids, write_scene
from waiting import PATIENCE, wait_until

from humansim_ros.ros.graph import transport
from humansim_ros.ros.graph import transport as shared_memory
from humansim_ros.ros.graph.transport import (
    FULL_SEGMENT,
    PROFILES,
    choose_transport,
    free_memory,
    segment_size,
)

MB = 1 << 20
SETTINGS = (
    *transport._DISCOVERY_SETTINGS,
    transport._SEGMENT_BYTES,
    transport._MEMORY_POLICY,
    "RMW_IMPLEMENTATION",
)
#: Publishes images of 640x480 as a camera does, and stops each time until a subscriber has had a second.
PUBLISHER = """
import sys, time
import rclpy
from humansim_ros.ros.graph.qos import DATA
from humansim_ros.ros.processes.runtime import prepare_transport
from humansim_ros.errors import show_warnings
from sensor_msgs.msg import Image
show_warnings()
prepare_transport(6)
rclpy.init()
node = rclpy.create_node("publisher")
publisher = node.create_publisher(Image, "/front/image_raw", DATA)
image = Image(height=480, width=640, step=1920, encoding="rgb8", data=bytes(921600))
while not publisher.get_subscription_count():
    time.sleep(0.05)
for number in range(20):
    image.header.stamp.sec = number
    publisher.publish(image)
    time.sleep(0.2)
"""
#: Sends messages of 30 MB to three topics.
FLOOD = """
import time
import rclpy
from rclpy.serialization import serialize_message
from std_msgs.msg import Header
from humansim_ros.ros.processes.runtime import prepare_transport
prepare_transport(2, network=False)
rclpy.init()
node = rclpy.create_node("flood")
publishers = [node.create_publisher(Header, f"/topic_{number}", 1) for number in range(3)]
while not all(publisher.get_subscription_count() for publisher in publishers):
    time.sleep(0.05)
for _ in range(8):
    for publisher in publishers:
        publisher.publish(serialize_message(Header()) + bytes(30_000_000))
        time.sleep(0.3)
"""
#: Prints megabytes of its own before and after messages, and the number of refused ones.
FLOODED = """
import subprocess, sys, time
from pathlib import Path
import rclpy
from std_msgs.msg import Header
from humansim_ros.ros.graph.guarded_node import GuardedNode
from humansim_ros.ros.graph.qos import NEWEST
from humansim_ros.ros.processes.runtime import make_executor, prepare_transport

def own():
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("RssAnon")).split()[1]) / 1024

prepare_transport(2, network=False)
rclpy.init()
node, executor = GuardedNode("flooded"), make_executor()
executor.add_node(node)
for number in range(3):
    node.create_subscription(Header, f"/topic_{number}", print, NEWEST)
executor.spin_once(0.1)
before = own()
with subprocess.Popen([sys.executable, "-c", sys.argv[1]]) as flood:
    while flood.poll() is None:
        executor.spin_once(0.1)
end = time.monotonic() + 1
while time.monotonic() < end:
    executor.spin_once(0.1)
print(before, own(), node._counts["errors"])
"""
SUBSCRIBER = """
import sys, time
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
rclpy.init()
node = rclpy.create_node("subscriber")
got = []
topic = sys.argv[1]
node.create_subscription(Image, topic, lambda m: got.append(m.header.stamp.sec), qos_profile_sensor_data)
end = time.monotonic() + float(sys.argv[3])
while len(got) < int(sys.argv[2]) and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.1)
print(len(got))
"""


@pytest.fixture
def unset(monkeypatch: pytest.MonkeyPatch) -> None:
    """The user has set none of the variables."""
    for name in SETTINGS:
        monkeypatch.delenv(name, raising=False)


def default_environment(**more: str) -> dict[str, str]:
    """Environment of a user who has set nothing, in the ROS domain of the test."""
    return {**{name: value for name, value in os.environ.items() if name not in SETTINGS}, **more}


def with_free_memory(monkeypatch: pytest.MonkeyPatch, size: float) -> None:
    blocks = SimpleNamespace(f_bavail=size // 4096, f_frsize=4096, f_blocks=1e9)
    monkeypatch.setattr(os, "statvfs", lambda _: blocks)


def test_segments_share_what_dev_shm_has(monkeypatch: pytest.MonkeyPatch) -> None:
    for size, participants in ((64 * MB, 6), (16 * MB, 6), (200 * MB, 20), (500 * MB, 7)):
        with_free_memory(monkeypatch, size)
        segment = segment_size(free_memory(), participants)
        # a segment takes a twentieth more; subscribers of the user have their share
        assert 0.7 * size < 1.05 * segment * participants < 0.9 * size
    for participants, expected in ((6, FULL_SEGMENT), (None, FULL_SEGMENT)):
        assert segment_size(24e9, participants) == expected
    assert segment_size(64 * MB) == 16 * MB  # a process alone leaves space for others
    for size in (0, 4096, 2 * MB):
        with_free_memory(monkeypatch, size)
        assert segment_size(free_memory(), 6) == 0


def test_without_a_writable_dev_shm_there_is_no_segment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared_memory, "_FOLDER", tmp_path / "nothing")
    assert free_memory() == 0
    monkeypatch.setattr(shared_memory, "_FOLDER", tmp_path)
    assert free_memory() > 0
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert free_memory() == 0


def test_a_small_dev_shm_is_named_with_the_remedy(unset: None, monkeypatch: pytest.MonkeyPatch) -> None:
    with_free_memory(monkeypatch, 24e9)
    assert choose_transport(6).warning == ""
    with_free_memory(monkeypatch, 64 * MB)
    chosen = choose_transport(6)
    assert "67 MB free" in chosen.warning and chosen.warning.endswith("In Docker: --shm-size=1g")
    assert "images above 4.5 MB" in chosen.warning and "\n" not in chosen.warning
    assert choose_transport(30).warning.endswith("--shm-size=3g")
    with_free_memory(monkeypatch, 0)
    chosen = choose_transport(6)
    assert "0 MB free, so images go over UDP" in chosen.warning and "--shm-size=1g" in chosen.warning


def test_settings_of_the_user_are_kept(unset: None, monkeypatch: pytest.MonkeyPatch) -> None:
    with_free_memory(monkeypatch, 0)
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "mine.xml")
    assert choose_transport(6, network=False).environment == {}
    assert "FASTRTPS_DEFAULT_PROFILES_FILE" in choose_transport(6, network=False).reach


@pytest.mark.parametrize("name", ["ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS", "ROS_LOCALHOST_ONLY"])
def test_the_user_decides_who_finds_the_nodes(
    unset: None, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    assert choose_transport(6, network=False).environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "SYSTEM_DEFAULT"
    assert "this machine only" in choose_transport(6, network=False).reach
    monkeypatch.setenv(name, "1")
    chosen = choose_transport(6, network=False)
    assert "ROS_AUTOMATIC_DISCOVERY_RANGE" not in chosen.environment
    profile = next(chosen.environment[key] for key in PROFILES if key in chosen.environment)
    assert profile.endswith("fastdds.xml")
    assert name in chosen.reach


def test_other_middleware_is_limited_by_the_variable_of_ros(
    unset: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_cyclonedds_cpp")
    assert choose_transport(6, network=False).environment == {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    assert choose_transport(6).environment == {}


@pytest.mark.parametrize(
    ("free", "network"),
    [(24e9, True), (24e9, False), (64 * MB, True), (64 * MB, False), (0, True), (0, False)],
)
def test_fast_dds_accepts_every_profile(
    unset: None, monkeypatch: pytest.MonkeyPatch, free: float, network: bool
) -> None:
    with_free_memory(monkeypatch, free)
    code = """
import os, rclpy
from humansim_ros.ros.graph.transport import owned_names
rclpy.init()
node = rclpy.create_node("node")
print(*(os.stat(f"/dev/shm/{name}").st_size for name in owned_names(os.getpid()) if "port" not in name))
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=default_environment(**choose_transport(6, network).environment),
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    assert done.stderr == ""
    sizes = [int(size) for size in done.stdout.split()]
    segment = segment_size(free, 6)
    assert sizes == ([pytest.approx(segment, rel=0.06)] if segment else [])


def may_mount() -> bool:
    """Whether this process may mount a /dev/shm of its own."""
    command = ["unshare", "-m", "mount", "-t", "tmpfs", "tmpfs", "/dev/shm"]
    return bool(shutil.which("unshare")) and not subprocess.run(command, capture_output=True).returncode


@pytest.mark.skipif(not may_mount(), reason="a /dev/shm of its own needs the right to mount (root)")
@pytest.mark.parametrize("size", ["64m", "16m"])
@pytest.mark.nightly
def test_no_image_is_lost_with_a_small_dev_shm(tmp_path: Path, size: str) -> None:
    """Docker gives 64 MB; with segments of 67 MB, the transport has none and loses most images."""
    (tmp_path / "publisher.py").write_text(PUBLISHER)
    (tmp_path / "subscriber.py").write_text(SUBSCRIBER)
    script = f"""
mount -t tmpfs -o size={size} tmpfs /dev/shm
{sys.executable} {tmp_path}/publisher.py 2>{tmp_path}/errors &
{sys.executable} {tmp_path}/subscriber.py /front/image_raw 20 60
wait
"""
    for _ in range(
        3
    ):  # a loaded machine may lose an image once; without a fitting segment most are lost, always
        done = subprocess.run(
            ["unshare", "-m", "sh", "-c", script],
            env=default_environment(PYTHONPATH=str(ROOT)),
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=True,
        )
        if done.stdout == "20\n":
            break
    assert done.stdout == "20\n", done.stderr
    (warning,) = (tmp_path / "errors").read_text().splitlines()
    assert warning.startswith("warning: /dev/shm has ") and "--shm-size=1g" in warning


def udp_addresses(pid: int) -> set[str]:
    """IPv4 addresses to which the UDP sockets of a process are bound."""
    sockets = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        try:
            sockets.add(str(descriptor.readlink()))
        except FileNotFoundError:
            continue
    addresses = set()
    for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
        words = line.split()
        if f"socket:[{words[9]}]" in sockets:
            number = int(words[1].partition(":")[0], 16)
            addresses.add(socket.inet_ntoa(number.to_bytes(4, "little")))
    return addresses


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Mapping[str, subprocess.Popen[str]]]:
    """Runs of a scene by their options, started when they are asked for."""

    class Runs(dict[str, subprocess.Popen[str]]):
        def __missing__(self, options: str) -> subprocess.Popen[str]:
            scene = str(write_scene(tmp_path))
            with (tmp_path / "output").open("w") as output:
                self[options] = subprocess.Popen(
                    [
                        sys.executable,
                        "-m",
                        "humansim_ros.cli",
                        "run",
                        scene,
                        "--jobs",
                        "1",
                        *options.split(),
                    ],
                    env=default_environment(),
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    text=True,
                )
            return self[options]

    runs = Runs()
    yield runs
    for process in runs.values():
        process.send_signal(signal.SIGINT)
        process.wait(PATIENCE)


@pytest.mark.nightly
def test_a_run_is_found_on_this_machine_and_reached_from_no_other(
    run: Mapping[str, subprocess.Popen[str]], tmp_path: Path
) -> None:
    parent = run[""]
    heard = subprocess.run(
        [sys.executable, "-c", SUBSCRIBER, "/left/image_raw", "3", str(PATIENCE)],
        env=default_environment(),
        capture_output=True,
        text=True,
        check=True,
    )
    assert heard.stdout == "3\n"
    assert len(node_pids(parent.pid)) == 4
    for pid in node_pids(parent.pid):
        # Fast DDS joins its multicast group on the loopback interface
        assert {"127.0.0.1"} <= udp_addresses(pid) <= {"127.0.0.1", "239.255.0.1"}
    text = (tmp_path / "output").read_text()
    assert "visible on this machine only; --network opens it\n" in text


@pytest.mark.nightly
def test_the_network_is_opened_by_an_option(run: Mapping[str, subprocess.Popen[str]], tmp_path: Path) -> None:
    parent = run["--network"]
    assert wait_until(
        lambda: "0.0.0.0" in set().union(*(udp_addresses(pid) for pid in node_pids(parent.pid)))
    )
    assert "every host on the network" in (tmp_path / "output").read_text()


@pytest.mark.slow
@pytest.mark.nightly
def test_long_messages_that_are_refused_hold_no_memory(ros: None) -> None:
    """Buffers of Fast DDS and of the C library would hold several messages of 30 MB for each topic."""
    done = subprocess.run(
        [sys.executable, "-c", FLOODED, FLOOD],
        env={**default_environment(ROS_DOMAIN_ID=os.environ["ROS_DOMAIN_ID"]), "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
        timeout=PATIENCE,
    )
    before, after, refused = map(float, done.stdout.split()[-3:])
    assert refused >= 9
    assert after - before < 2 * 30
