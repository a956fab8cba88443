"""A short run of tools/fuzz_nodes.py: hostile messages, requests and parameters do no harm to any node."""

from __future__ import annotations

import math
import random
import sys
import time
from collections.abc import Iterator
from typing import Any

import pytest
from conftest import ROOT, importable

sys.path.append(str(ROOT / "tools"))

import fuzz_nodes
import message_mutations

NODES = (
    "motion_player",
    "skinner",
    "live_skinner",
    "camera",
    "camera_rig",
    "static_camera",
    "scanner",
    "bridge",
)


@pytest.fixture(scope="module")
def stage(ros: None) -> Iterator[Any]:
    with pytest.MonkeyPatch.context() as patch, importable(*fuzz_nodes.PACKAGES):
        patch.setenv("ROS_HOME", "")  # the fuzzer sets it
        with fuzz_nodes.running_stage() as made:
            yield made


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "count"),
    [(name, 100) for name in NODES],
)
@pytest.mark.nightly
def test_hostile_messages_do_no_harm(
    stage: Any, name: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # processor time, too, grows on a loaded machine
    monkeypatch.setattr(fuzz_nodes, "LIMIT_MS", 10 * fuzz_nodes.LIMIT_MS)
    fuzzer = fuzz_nodes.Fuzzer(stage, random.Random(f"{name}7"))
    endpoints = fuzzer.run(name, count)
    assert fuzzer.findings == []
    assert sum(endpoint.messages for endpoint in endpoints) >= 0.9 * count
    # the damage is neither always harmless nor always noticed
    assert 0 < sum(endpoint.refused for endpoint in endpoints) < 0.9 * count


@pytest.mark.nightly
def test_every_node_and_all_its_subscriptions_and_services_are_fuzzed(stage: Any) -> None:
    assert set(stage.nodes) == {*NODES}
    topics = {endpoint.topic for name in NODES for endpoint in stage.endpoints(name)}
    assert {
        *("/frame_done", "/humans/anna/motion", "/humans/anna/motion/legend", "/humans/bob/frame"),
        *("/humans/anna/vertices", "/humans/anna/joints", "/objects/box/marker", "/objects/box/twist"),
        *("/moving/pose", "/moving/twist", "/left/pose", "/scene_time", "/left/set_camera_info"),
        *("/motion_player/pause", "/motion_player/set_parameters", "/alone/set_parameters_atomically"),
    } <= topics


class Careless:
    """Callbacks with the faults that the fuzzer is for."""

    def __init__(self, stage: Any) -> None:
        self.stage = stage

    def fail(self, data: bytes) -> None:
        raise ZeroDivisionError

    def stall(self, data: bytes) -> None:
        end = time.thread_time() + 0.15
        while time.thread_time() < end:
            pass

    def pass_on(self, data: bytes) -> None:
        from geometry_msgs.msg import PoseStamped

        message = PoseStamped()
        message.pose.position.x = math.nan
        (player,) = (
            publisher for publisher in self.stage.player.publishers if "moving/pose" in publisher.topic
        )
        player.publish(message)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("fault", "what"),
    [("fail", "ZeroDivisionError"), ("stall", "took 1"), ("pass_on", "not finite: /moving/pose")],
)
def test_the_fuzzer_finds_faults(stage: Any, fault: str, what: str) -> None:
    (endpoint,) = (each for each in stage.endpoints("motion_player") if each.topic == "/frame_done")
    endpoint.call = getattr(Careless(stage), fault)
    fuzzer = fuzz_nodes.Fuzzer(stage, random.Random(1))
    fuzzer._one("motion_player", endpoint)
    assert any(what in finding.what for finding in fuzzer.findings)


@pytest.mark.nightly
def test_mutated_messages_are_the_same_for_a_seed_and_differ_from_valid_ones(stage: Any) -> None:
    motion = stage.valid("/humans/anna/motion")

    def some(seed: int) -> list[str]:
        source = random.Random(seed)
        return [str(message_mutations.mutated(motion, source)) for _ in range(20)]

    assert some(3) == some(3) != some(4)
    assert sum(text != str(motion) for text in some(3)) > 10
