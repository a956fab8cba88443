"""The nodes of a scene on two hosts: two network namespaces, each with a /dev/shm of its own."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from conftest import ROOT
from ros_support import write_scene
from waiting import PATIENCE, wait_until

SCENE = """
rate: 10
room: null
humans: {anna: {motion: {file: walk, loop: continue}}}
cameras:
  left: {size: [160, 120], position: [3, 2.6, 2], look_at: [0, 0, 0.8]}
  right: {size: [160, 120], position: [-3, 2.6, 2], look_at: [0, 0, 0.8]}
"""
#: Prints the number of stamps that all topics share, as soon as there are as many as the first argument.
CLIENT = """
import sys, time, rclpy
from std_msgs.msg import Header
from sensor_msgs.msg import Image, MultiDOFJointState
from humansim_ros.ros.processes.runtime import prepare_transport
prepare_transport(network=sys.argv[3] == "network")
rclpy.init()
node = rclpy.create_node("client")
stamps = {}
def hear(kind, topic):
    stamps[topic] = set()
    def on_message(message):
        stamp = getattr(message, "header", message).stamp
        stamps[topic].add((stamp.sec, stamp.nanosec))
    node.create_subscription(kind, topic, on_message, 50)
hear(MultiDOFJointState, "/humans/anna/joints")
hear(Header, "/frame_done")
hear(Image, "/left/image_raw")
hear(Image, "/right/image_raw")
end = time.monotonic() + float(sys.argv[2])
while time.monotonic() < end and len(set.intersection(*stamps.values())) < int(sys.argv[1]):
    rclpy.spin_once(node, timeout_sec=0.1)
print(len(set.intersection(*stamps.values())), {topic: len(each) for topic, each in stamps.items()})
"""
#: A host ends with the input of its process.
_HOST = "mount -t tmpfs tmpfs /dev/shm && ip link set lo up && echo ready && exec cat"
_UNSHARE = ["unshare", "--net", "--mount", "sh", "-c", _HOST]


def may_make_hosts() -> bool:
    """Whether this process may make network namespaces and connect them."""
    if not (shutil.which("ip") and shutil.which("unshare") and shutil.which("nsenter")):
        return False
    script = f"ip link add humansim0 type veth peer name humansim1 && {_HOST}"
    done = subprocess.run([*_UNSHARE[:-1], script], stdin=subprocess.DEVNULL, capture_output=True)
    return done.returncode == 0


needs_hosts = pytest.mark.skipif(
    not may_make_hosts(), reason="network namespaces need root, and ip, unshare and nsenter"
)


@dataclass(frozen=True)
class Host:
    """A host: how to start a command on it, and the variables of its environment."""

    prefix: Sequence[str] = ()
    variables: Sequence[str] = ()

    @property
    def environment(self) -> dict[str, str]:
        """As that of a user: tests keep their nodes on this machine."""
        own = {key: value for key, value in os.environ.items() if key != "ROS_AUTOMATIC_DISCOVERY_RANGE"}
        return {**own, "PYTHONPATH": str(ROOT), **dict(each.split("=", 1) for each in self.variables)}

    def command(self, *arguments: str) -> list[str]:
        return [*self.prefix, *arguments]

    def call(self, line: str) -> None:
        subprocess.run(self.command("sh", "-c", line), check=True, timeout=PATIENCE)

    @contextmanager
    def run(self, scene: Path, *options: str) -> Iterator[Path]:
        """``humansim run`` on this host; yields the file with its output."""
        output = scene.with_name(f"{options[1]}.log")
        with output.open("w") as file:
            process = subprocess.Popen(
                self.command(sys.executable, "-m", "humansim_ros.cli", "run", str(scene), *options),
                stdout=file,
                stderr=file,
                env=self.environment,
            )
        try:
            yield output
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(PATIENCE) == 0, output.read_text()

    @contextmanager
    def client(self, network: str) -> Iterator[subprocess.Popen[str]]:
        command = self.command(sys.executable, "-c", CLIENT, "10", str(PATIENCE), network)
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=self.environment)
        try:
            yield process
        finally:
            process.kill()
            process.wait()


@contextmanager
def two_hosts(multicast: bool) -> Iterator[tuple[Host, Host]]:
    """Two hosts that a cable connects, with the variables that make their nodes find each other."""
    addresses = ("10.7.0.1", "10.7.0.2")
    with ExitStack() as stack:
        hosts, pids = [], []
        for other in reversed(addresses):
            process = stack.enter_context(
                subprocess.Popen(_UNSHARE, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
            )
            assert process.stdin is not None and process.stdout is not None
            stack.callback(process.stdin.close)
            assert process.stdout.readline() == "ready\n"
            prefix = ["nsenter", "-t", str(process.pid), "--net", "--mount", f"--wd={Path.cwd()}"]
            hosts.append(Host(prefix, () if multicast else (f"ROS_STATIC_PEERS={other}",)))
            pids.append(process.pid)
        hosts[0].call(f"ip link add cable type veth peer name cable netns {pids[1]}")
        for host, address in zip(hosts, addresses, strict=True):
            host.call(f"ip addr add {address}/24 dev cable && ip link set cable up")
            host.call("ip route add default dev cable")
            if not multicast:
                host.call("ip link set cable multicast off")
        yield hosts[0], hosts[1]


def check_suite(scene: Path, first: Host, second: Host, network: str) -> None:
    """Player and skinners on one host, cameras on another: clients of both get whole frames."""
    options = ["--network"] if network else []
    with ExitStack() as stack:
        of_player = stack.enter_context(first.run(scene, "--only", "player,skinners", *options))
        output = stack.enter_context(second.run(scene, "--only", "cameras", *options))
        clients = [stack.enter_context(host.client(network)) for host in (first, second)]
        for client in clients:
            answer = client.communicate(timeout=2 * PATIENCE)[0]
            assert int(answer.split()[0]) >= 10, answer
        assert wait_until(lambda: "all 2 cameras deliver" in output.read_text())
        assert "starting left, right; Ctrl-C stops" in output.read_text()
    assert "Traceback" not in output.read_text()
    # the report of first images would draw them over the network
    assert "deliver" not in of_player.read_text()


@pytest.mark.slow
@pytest.mark.nightly
@needs_hosts
@pytest.mark.parametrize("multicast", [True, False], ids=["multicast", "static_peers"])
def test_player_and_cameras_find_each_other_over_hosts(tmp_path: Path, multicast: bool) -> None:
    with two_hosts(multicast) as (first, second):
        check_suite(write_scene(tmp_path, SCENE), first, second, "network")


@pytest.mark.slow
@pytest.mark.nightly
def test_player_and_cameras_of_one_machine_may_be_two_runs(tmp_path: Path) -> None:
    check_suite(write_scene(tmp_path, SCENE), Host(), Host(), "")


@pytest.mark.slow
@pytest.mark.nightly
def test_a_name_of_no_node_is_refused(tmp_path: Path) -> None:
    scene = write_scene(tmp_path, SCENE)
    command = [sys.executable, "-m", "humansim_ros.cli", "run", str(scene), "--only", "camera_1"]
    done = subprocess.run(command, env=Host().environment, capture_output=True, text=True, timeout=PATIENCE)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "no node to start 'camera_1'" in done.stderr and "left, right" in done.stderr
