"""Hostile calls of all services of a running scene: each is answered, and memory stays bounded."""

from __future__ import annotations

import importlib
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter
from rclpy.qos import qos_profile_parameters
from ros_support import rclpy, write_scene
from waiting import PATIENCE, children, end_process, wait_until

SCENE = """
rate: 10
room: null
humans:
  anna: {motion: {file: walk, loop: continue}}
  bob: {body: adult_woman, motion: live}
cameras:
  front: {size: [64, 48], position: [3.2, 0, 1.4], look_at: [0, 0, 1]}
  left: {size: [64, 48], position: [3.2, 1, 1.4], look_at: [0, 0, 1]}
scanners: {lidar: {pattern: {columns: 90}, rate: 10, range: [0.1, 20], position: [2, 0, 1]}}
"""
NODES = ("motion_player", "front", "left", "lidar", "skinner_anna", "skinner_bob")
#: Characters of long texts, and elements of long lists. Of megabytes, Fast DDS loses parts where the sender
#: has little shared memory, and sends them again every 3 s (docs/security.md).
LONG, MANY = 400_000, 200_000
TEXTS = {
    "long": LONG * "x",
    "deep": LONG // 2 * "[" + LONG // 2 * "]",
    "lines": LONG // 5 * "a: b\n",
    "urdf": 100_000 * "<robot>",
    "file": "file:///etc/shadow",
    "package": "package://humansim_ros/../../../etc/shadow",
    "control": "a\0b" + 1000 * "\u202e",
    "pattern": "((a{1,1000}){1,1000}){1,1000}(a*)*b",
}
PARAMETERS = ("motion", "anna.motion", "anna.hands", "anna.end", "speed", "seek", "loop", "marker_rate")
#: Megabytes by which the nodes together may have grown at the end, and seconds for an answer.
MOST_GROWTH, LIMIT = 150.0, 6.0


def filled(message: Any, text: str, number: float, whole: str, length: int) -> Any:
    """The message with all its fields set, also those of messages within it."""

    def value(kind: str) -> Any:
        if kind.startswith(("string", "wstring")):
            return text
        if "/" in kind:
            package, name = kind.split("/")
            inner = getattr(importlib.import_module(f"{package}.msg"), name)()
            return filled(inner, text, number, whole, min(length, 1))
        if kind in ("float", "double"):
            return number if kind == "double" or not math.isfinite(number) else math.copysign(3e38, number)
        if kind == "boolean":
            return whole == "most"
        if kind == "octet":
            return b"\xff"
        bits, unsigned = int(re.sub(r"\D", "", kind)), kind.startswith("u")
        most = 2**bits - 1 if unsigned else 2 ** (bits - 1) - 1
        return {"most": most, "least": 0 if unsigned else -most - 1, "one": 1}[whole]

    for name, kind in message.get_fields_and_field_types().items():
        if found := re.fullmatch(r"sequence<([^,>]+)(?:, (\d+))?>", kind):
            setattr(message, name, [value(found[1])] * min(length, int(found[2] or length)))
        elif found := re.fullmatch(r"(.+)\[(\d+)\]", kind):
            setattr(message, name, [value(found[1])] * int(found[2]))
        else:
            setattr(message, name, value(kind))
    return message


def requests(kind: Any) -> Iterator[tuple[str, Any]]:
    """Requests of a service, hostile in one way each."""
    if kind is SetParameters:
        for name, value in product(PARAMETERS, (*TEXTS.values(), "walk", "activity#7", math.nan, -1, 2**62)):
            yield (
                f"{name} {str(value)[:9]}",
                SetParameters.Request(parameters=[Parameter(name, value=value).to_parameter_msg()]),
            )
    yield "default", kind.Request()
    for name, text in TEXTS.items():
        yield name, filled(kind.Request(), text, 0.0, "one", 1)
    for number in (math.nan, math.inf, -1e308):
        yield str(number), filled(kind.Request(), "x", number, "one", 3)
    for whole in ("most", "least"):
        yield whole, filled(kind.Request(), "x", 1.0, whole, 1)
    for length in (1000, MANY):
        yield f"{length} elements", filled(kind.Request(), "x", 1.0, "one", length)


def megabytes(pids: list[int]) -> float:
    """Memory of processes; memory that several of them share, as segments of Fast DDS are, counts once."""
    found = (re.search(r"Pss:\s+(\d+)", Path(f"/proc/{pid}/smaps_rollup").read_text()) for pid in pids)
    return sum(int(each[1]) for each in found if each) / 1000


class Caller:
    """Calls services, and remembers which calls had no answer in time."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("hostile")
        self.executor = rclpy.executors.SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.calls, self.late = 0, list[str]()

    def services(self) -> list[tuple[str, Any]]:
        """Name and type of each service of the scene."""
        found = []
        for name, (kind, *_) in self.node.get_service_names_and_types():
            package, folder, service = kind.split("/")
            if folder == "srv" and name.split("/")[1] in NODES:
                found.append((name, getattr(importlib.import_module(f"{package}.srv"), service)))
        return sorted(found, key=lambda each: each[0])

    def call(self, name: str, kind: Any, hostile: list[tuple[str, Any]]) -> None:
        """Call a service with some requests at once."""
        # the queue for answers is the caller's own: the default one of ten loses answers that come at once
        client = self.node.create_client(kind, name, qos_profile=qos_profile_parameters)
        assert client.wait_for_service(PATIENCE)
        # a client needs seconds to serialise the longest requests
        futures = [(label, client.call_async(request)) for label, request in hostile]
        start = time.monotonic()
        self.calls += len(futures)
        allowed = LIMIT * PATIENCE / 180
        while time.monotonic() - start < allowed and not all(future.done() for _, future in futures):
            self.executor.spin_once(timeout_sec=0.05)
        self.late += [f"{name}: {label}" for label, future in futures if not future.done()]
        self.node.destroy_client(client)


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("at_once", [1, 50])
def test_each_hostile_call_is_answered_in_bounded_memory(
    ros: None, interfaces: Path, tmp_path: Path, at_once: int
) -> None:
    paths = os.pathsep.join([str(ROOT), str(interfaces), os.environ.get("PYTHONPATH", "")])
    with (tmp_path / "output").open("w") as output:
        run = subprocess.Popen(
            [sys.executable, "-m", "humansim_ros", "run", str(write_scene(tmp_path, SCENE))],
            env={**os.environ, "PYTHONPATH": paths},
            stdout=output,
            stderr=subprocess.STDOUT,
        )
    try:
        caller = Caller()
        wanted = {f"/{node}/set_parameters" for node in NODES} | {"/motion_player/step_simulation"}
        assert wait_until(
            lambda: wanted <= {name for name, _ in caller.services()}, step=lambda: time.sleep(0.5)
        ), (tmp_path / "output").read_text()
        starters = [pid for pid, line in children(run.pid).items() if "node_starter" in line]
        pids = [pid for starter in starters for pid in (starter, *children(starter))]
        assert len(pids) > len(NODES)
        before = megabytes(pids)
        for name, kind in caller.services():
            if at_once > 1 and ("get_type_description" in name or "/_action/" in name):
                continue  # ROS makes them, with a queue of ten requests
            hostile = list(requests(kind)) if at_once == 1 else at_once * [("default", kind.Request())]
            for first in range(0, len(hostile), at_once):
                caller.call(name, kind, hostile[first : first + at_once])
            assert run.poll() is None, (tmp_path / "output").read_text()
        assert caller.late == []
        assert caller.calls > 500
        # a node gives back the memory of a refused request in its next turn, after the answer
        assert wait_until(
            lambda: megabytes(pids) - before < MOST_GROWTH, 30.0, step=lambda: time.sleep(0.5)
        ), f"{megabytes(pids) - before:.0f} MB more than before the calls"
    finally:
        end_process(run)
