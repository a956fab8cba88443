"""Labelled objects over the nodes: the same numbers and bytes as in Simulation."""

from __future__ import annotations

import json
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from keyframe_text import keyframes
from ros_support import write_scene

from humansim_ros.data import messages
from humansim_ros.data.messages.camera_truth import BODY_KINDS
from humansim_ros.motion.body.face import ACTIONS, FACE_AT_REST
from humansim_ros.people import KEYPOINT_SETS, keypoint_set
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.truth.camera_truth import OCCLUDED, VISIBLE
from humansim_ros.testing import SceneGraph

#: A box passes in front of a person in front of a crate; its position gives the scene time.
SCENE = """\
rate: 4
humans:
  anna:
    body: child
    motion: {file: wave, anchor: center, loop: repeat}
    face: {alive: true, keys: [{speak: 9}, {gaze: left}]}
objects:
  post: {mesh: cylinder, size: [0.1, 0.1, 1], position: [0.6, -0.5, 0.5]}
  box: {size: [0.1, 0.3, 0.9], position: [0, 0, 0.6], keyframes: moves.xml, label: true}
  crate: {size: [0.5, 1.0, 0.8], position: [-0.8, 0, 0.4], label: true}
randomise: {seed: 2, clutter: 2, clutter_label: true, colours: true}
cameras:
  left: {size: [160, 120], position: [3.2, 0.6, 1.4], look_at: [0, 0, 0.7], fov_deg: 60}
"""
MOVES = keyframes(400_000, 100, box=((1, 0, 0), (1, 400, 0)))
NUMBERS = {"anna": 1, "box": 2, "crate": 3, "clutter_1": 4, "clutter_2": 5}
IMAGES = {"image_raw": "rgb", "depth/image": "depth", "instance/image": "instance", "part/image": "part"}
IMAGES |= {"face/image": "face", "normal/image": "normal"}
CHANNELS = (*IMAGES.values(), "alpha", "amodal")


@pytest.fixture(scope="module")
def flow(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("labels")
    (folder / "moves.xml").write_text(MOVES)
    scene = Scene.load(write_scene(folder, SCENE))
    of_left = [*IMAGES, *(f"{kind}/{name}/image" for kind in ("alpha", "amodal") for name in NUMBERS)]
    of_left += ["joints", "boxes", "visible_vertices", "keypoints/halpe26"]
    others = ("objects/box/marker", "humans/anna/keypoints/halpe26", "humans/anna/face")
    with SceneGraph(scene, namespace="labels") as graph, Simulation(scene, CHANNELS) as simulation:
        received = {
            topic: graph.subscribe(topic) for topic in (*others, *(f"left/{name}" for name in of_left))
        }
        stamps = graph.play(3)
        yield SimpleNamespace(graph=graph, received=received, stamps=stamps, simulation=simulation)


def message_at(flow: Any, topic: str, stamp: int) -> Any:
    return flow.received[topic].at(stamp)


def frame_of(flow: Any, stamp: int) -> Any:
    """The same frame of Simulation: the box moves 10 cm a second."""
    index = 40 * messages.read_object(message_at(flow, "objects/box/marker", stamp)).position[1]
    assert index == pytest.approx(round(index), abs=1e-6)
    return flow.simulation.frame(round(index))


def test_images_of_objects_equal_those_of_simulation_to_the_byte(flow: Any) -> None:
    for stamp in flow.stamps:
        view = frame_of(flow, stamp).views["left"]
        for topic, channel in IMAGES.items():
            assert bytes(message_at(flow, f"left/{topic}", stamp).data) == getattr(view, channel).tobytes(), (
                topic
            )
        for name, number in NUMBERS.items():
            assert (
                bytes(message_at(flow, f"left/alpha/{name}/image", stamp).data)
                == view.alpha[number].tobytes()
            )
            mask = view.amodal[number] * np.uint8(255)
            assert bytes(message_at(flow, f"left/amodal/{name}/image", stamp).data) == mask.tobytes()
            assert mask.any() or name.startswith("clutter")


def test_boxes_vertices_and_joints_equal_those_of_simulation(flow: Any) -> None:
    hidden: set[int] = set()
    for stamp in flow.stamps:
        frame = frame_of(flow, stamp)
        boxes = messages.read_boxes(message_at(flow, "left/boxes", stamp))
        numbers = {number: name for name, number in NUMBERS.items()}
        assert sorted(boxes["instance"].tolist()) == list(numbers)
        for point in boxes:
            name = numbers[point["instance"]]
            truth = frame.boxes["left"][name]
            assert point["kind"] == BODY_KINDS["human" if name == "anna" else "object"]
            assert (point["pixels"], np.float32(truth.truncation)) == (truth.pixels, point["truncation"])
            whole = [point[f"whole_{side}"] for side in ("left", "top", "right", "bottom")]
            np.testing.assert_array_equal(whole, np.float32(truth.whole))
        seen = messages.read_visible_vertices(message_at(flow, "left/visible_vertices", stamp))
        for name, mask in frame.visible_vertices("left").items():
            own = seen["vertex"][seen["instance"] == NUMBERS[name]]
            assert own.tolist() == np.flatnonzero(mask).tolist()
        joints = messages.read_joint_view(message_at(flow, "left/joints", stamp))
        truth = frame.joints["left"]["anna"]
        assert joints["by"].tolist() == truth.by.tolist()
        assert joints["occluder"].tolist() == truth.occluder.tolist()
        hidden |= set(truth.by[truth.visible == OCCLUDED].tolist())
    assert hidden >= {NUMBERS["box"]}


def test_the_face_equals_that_of_simulation(flow: Any) -> None:
    for stamp in flow.stamps:
        truth = frame_of(flow, stamp).humans["anna"].face
        face = messages.read_rated(message_at(flow, "humans/anna/face", stamp), FACE_AT_REST)
        np.testing.assert_array_equal([face.values, face.rates], [truth.values, truth.rates])
        assert face.values[ACTIONS.index("jawOpen")] > 0 or stamp == flow.stamps[0]


def test_keypoints_equal_those_of_simulation(flow: Any) -> None:
    """The messages came over the network, so they have been written and read as CDR."""
    seen: set[int] = set()
    for stamp in flow.stamps:
        frame = frame_of(flow, stamp)
        truth = frame.keypoints["halpe26"]["left"]["anna"]
        points = messages.read_joint_view(message_at(flow, "left/keypoints/halpe26", stamp))
        assert points["joint"].tolist() == list(range(26))
        for field in ("visible", "occluder", "by"):
            assert points[field].tolist() == getattr(truth, field).tolist()
        np.testing.assert_array_equal(np.stack([points["u"], points["v"]], axis=1), np.float32(truth.pixels))
        message = message_at(flow, "humans/anna/keypoints/halpe26", stamp)
        assert message.joint_names == list(keypoint_set("halpe26").names)
        poses = messages.read_joints(message)
        np.testing.assert_allclose(
            poses.positions[0], frame.keypoint_positions["halpe26"]["anna"], atol=1e-12
        )
        seen |= set(truth.visible.tolist())
    assert seen == {OCCLUDED, VISIBLE}


def test_legends_name_the_labels_of_humans_and_objects(flow: Any) -> None:
    topics = [f"left/{kind}/legend" for kind in ("instance", "joints", "keypoints")]
    instance, joints, keypoints = (json.loads(flow.graph.wait_for(topic).data) for topic in topics)
    assert instance == {"0": "background"} | {str(number): name for name, number in NUMBERS.items()}
    assert joints["human"] == keypoints["human"] == {"1": "anna"}
    assert keypoints["joint"]["halpe26"] == list(keypoint_set("halpe26").names)
    assert keypoints["joint"].keys() == KEYPOINT_SETS.keys()
    assert keypoints["skin"] == {"anna": "exact"}
    assert joints["object"] == {str(number): name for name, number in list(NUMBERS.items())[1:]}
