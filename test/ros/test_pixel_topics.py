"""Topics of all channels and of the ground truth have the content of Simulation at the same stamp."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from keyframe_text import keyframes
from ros_support import write_scene

from humansim_ros.data import messages
from humansim_ros.data.messages.camera_truth import BODY_KINDS
from humansim_ros.render import ALL_CHANNELS, CHANNELS
from humansim_ros.render.interface.channels import CHANNEL_TABLE, comparing_with
from humansim_ros.scene import Scene, Simulation
from humansim_ros.testing import SceneGraph

SCENE = """
rate: 4
humans:
  anna: {body: child, motion: {file: walk, position: [0.0, -1], loop: continue}}
objects:
  box: {size: [0.3, 0.3, 0.3], position: [0, 0, 0.2], keyframes: moves.xml}
cameras:
  left: {size: [120, 90], position: [3.2, 0.6, 1.4], look_at: [0, 0, 0.8], fov_deg: 70}
"""
MOVES = keyframes(4000, 10, box=((1, -1, 0), (1, 399, 0)))
DTYPES = {"32SC1": np.int32, "32FC1": np.float32, "32FC2": np.float32, "32FC3": np.float32, "mono8": np.uint8}
#: Channels that are not rendered by default.
DETAILS = [c for c in ALL_CHANNELS if c not in CHANNELS]

#: Topics of ground truth.
CLOUDS = ("joints", "boxes", "visible_vertices")


@pytest.fixture(scope="module")
def flow(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("detail")
    (folder / "moves.xml").write_text(MOVES)
    scene = Scene.load(write_scene(folder, SCENE))
    topics = {c: f"/detail/left/{CHANNEL_TABLE[c].topic.format(body='anna')}" for c in DETAILS}
    others = ("/detail/objects/box/marker", *(f"/detail/left/{kind}" for kind in (*CLOUDS, "overlay")))
    # the first and the last frame lack them, or have them later
    compared = {topics[c] for which in ("next_frame", "previous_frame") for c in comparing_with(which)}
    with SceneGraph(scene, namespace="detail") as graph, Simulation(scene, ALL_CHANNELS) as simulation:
        received = {
            topic: graph.subscribe(topic, every_frame=topic not in compared)
            for topic in (*topics.values(), *others)
        }
        stamps = graph.play(6)[1:-1]
        graph.spin_until(lambda: all(set(stamps) <= set(each.stamps) for each in received.values()))
        yield SimpleNamespace(received=received, stamps=stamps, topics=topics, simulation=simulation)


def index_of(flow: Any, stamp: int) -> float:
    """Index of the frame with a stamp: the box moves a metre a second."""
    marker = flow.received["/detail/objects/box/marker"].at(stamp)
    return float((messages.read_object(marker).position[1] + 1) * 4)


@pytest.mark.parametrize("channel", DETAILS)
def test_a_topic_has_the_channel_of_simulation(flow: Any, channel: str) -> None:
    for stamp in flow.stamps:
        index = index_of(flow, stamp)
        assert index == pytest.approx(round(index), abs=1e-4)
        frame = flow.simulation.frame(round(index))
        truth = getattr(frame.views["left"], channel)
        if isinstance(truth, dict):
            (truth,) = truth.values()
            truth = truth if truth.dtype == np.uint8 else truth * np.uint8(255)
        message = flow.received[flow.topics[channel]].at(stamp)
        assert message.encoding == CHANNEL_TABLE[channel].encoding
        assert message.step == message.width * truth.itemsize * (truth.shape[2] if truth.ndim == 3 else 1)
        image = np.frombuffer(message.data, DTYPES[message.encoding]).reshape(truth.shape)
        # vertices may differ in their last bit, and with them a pixel on an edge
        same = np.isclose(image, truth, atol=2e-3, equal_nan=True)
        assert same.mean() > 0.995
        assert len(np.unique(np.nan_to_num(truth))) > 1, "the image is empty"


def test_joints_boxes_and_vertices_are_those_of_simulation(flow: Any) -> None:
    for stamp in flow.stamps:
        frame = flow.simulation.frame(round(index_of(flow, stamp)))
        joints, boxes, vertices = (flow.received[f"/detail/left/{kind}"].at(stamp) for kind in CLOUDS)
        published, truth = messages.read_joint_view(joints), frame.joints["left"]["anna"]
        assert (
            np.mean((published["visible"] == truth.visible) & (published["occluder"] == truth.occluder)) > 0.9
        )
        assert np.median(np.abs(published["behind"] - truth.behind)) < 1e-4
        (box,) = messages.read_boxes(boxes)
        truth = frame.boxes["left"]["anna"]
        assert (box["instance"], box["kind"]) == (1, BODY_KINDS["human"])
        whole = [box[f"whole_{side}"] for side in ("left", "top", "right", "bottom")]
        np.testing.assert_allclose(whole, truth.whole, atol=1e-3)
        assert box["pixels"] == pytest.approx(truth.pixels, rel=0.01)
        assert box["visible_fraction"] == pytest.approx(truth.visible_fraction, abs=0.01)
        visible = np.zeros(len(frame.humans["anna"].vertices), bool)
        visible[messages.read_visible_vertices(vertices)["vertex"]] = True
        assert np.mean(visible == frame.visible_vertices("left")["anna"]) > 0.99
        assert visible.any()


def test_the_overlay_shows_the_joints_of_the_same_frame(flow: Any) -> None:
    states = set()
    for stamp in flow.stamps:
        joints = messages.read_joint_view(flow.received["/detail/left/joints"].at(stamp))
        overlay = flow.received["/detail/left/overlay"].at(stamp)
        inside = joints[joints["visible"] > 0]
        drawn = [(point.x, point.y) for point in overlay.points]
        np.testing.assert_allclose(drawn, np.column_stack([inside["u"], inside["v"]]), atol=1e-4)
        green = [color.g > color.r for color in overlay.outline_colors]
        assert green == [state == 2 for state in inside["visible"]]
        states |= set(green)
    assert states == {True, False}
