"""Keyframes through the nodes: humans and objects of a frame are those of one frame of Simulation."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from keyframe_text import keyframes
from ros_support import write_scene

from humansim_ros.data import messages
from humansim_ros.data.messages.cameras import object_message
from humansim_ros.data.messages.humans import MarkerBuilder
from humansim_ros.errors import RosError
from humansim_ros.scene import Scene, Simulation
from humansim_ros.testing import SceneGraph

#: A person is moved, rotated and scaled, and reaches for the box that passes in front; its position gives the
#: scene time.
SCENE = """\
rate: 20
room: null
humans:
  anna:
    motion: {file: walk, position: [0.0, -1], loop: continue}
    keyframes: moves.xml
    reach: [{to: box, blend: 0.1}]
objects:
  box: {size: [0.1, 0.4, 1.8], position: [0, 0, 0.9], keyframes: moves.xml}
  post: {mesh: cylinder, position: [-1, 1, 0.5]}
cameras:
  left: {size: [160, 120], position: [5, 0, 1.5], look_at: [0, 0, 1]}
"""
MOVES = keyframes(
    1000,
    10,
    anna=(
        {"position": (-1, 0, 0.1), "size": (0.9, 0.9, 0.9)},
        {"position": (19, 0, 0.1), "rotation": (0, 0, 4000), "size": (10.9, 10.9, 10.9)},
    ),
    box=((2, -1, 0), (2, 99, 0)),
)
TOPICS = ("/lift/humans/anna/motion", "/lift/humans/anna/joints", "/lift/humans/anna/vertices")
IMAGES = {
    "image_raw": np.uint8,
    "depth/image": np.float32,
    "instance/image": np.uint16,
    "part/image": np.uint8,
}


@pytest.fixture(scope="module")
def flow(ros: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    folder = tmp_path_factory.mktemp("lift")
    (folder / "moves.xml").write_text(MOVES)
    scene = Scene.load(write_scene(folder, SCENE))
    of_box = ("/lift/objects/box/marker", "/lift/objects/box/twist")
    topics = (*TOPICS, *of_box, "/lift/left/joints", *(f"/lift/left/{kind}" for kind in IMAGES))
    with SceneGraph(scene, namespace="lift") as graph, Simulation(scene) as simulation:
        received = {topic: graph.subscribe(topic) for topic in topics}
        yield SimpleNamespace(received=received, stamps=graph.play(8), simulation=simulation)


def frame_of(flow: Any, stamp: int) -> Any:
    """The same frame of Simulation; the position of the box gives its index."""
    pose = messages.read_object(flow.received["/lift/objects/box/marker"].at(stamp))
    index = (pose.position[1] + 1) * 20
    assert index == pytest.approx(round(index), abs=1e-4)
    return flow.simulation.frame(round(index))


def test_humans_and_objects_of_a_frame_have_the_same_stamp(flow: Any) -> None:
    for topic, received in flow.received.items():
        assert received.stamps == flow.stamps, topic


def test_twists_are_the_velocities_of_objects(flow: Any) -> None:
    for stamp in flow.stamps:
        published = messages.read_twist(flow.received["/lift/objects/box/twist"].at(stamp))
        frame = frame_of(flow, stamp)
        truth = frame.objects["box"].velocity
        np.testing.assert_allclose(
            [published.linear, published.angular], [truth.linear, truth.angular], atol=1e-9
        )
        if frame.index > 0:  # before, it rested
            np.testing.assert_allclose(published.linear, [0, 1, 0], atol=1e-9)


def test_the_live_body_is_that_of_the_simulation(flow: Any) -> None:
    for stamp in flow.stamps:
        frame = frame_of(flow, stamp)
        state = frame.humans["anna"]
        assert state.size == pytest.approx(0.9 + 0.1 * frame.index / 20)
        live = messages.read_joints(flow.received[TOPICS[1]].at(stamp))
        np.testing.assert_allclose(live.positions[0], state.positions, atol=1e-9)
        assert live.linear is not None
        np.testing.assert_allclose(live.linear[0], state.linear, atol=1e-6)
        np.testing.assert_allclose(
            messages.read_vertices(flow.received[TOPICS[2]].at(stamp)), state.vertices, atol=2e-6
        )


def test_live_images_are_those_of_the_simulation(flow: Any) -> None:
    for stamp in flow.stamps:
        view = frame_of(flow, stamp).views["left"]
        for kind, expected in zip(IMAGES, (view.rgb, view.depth, view.instance, view.part), strict=True):
            message = flow.received[f"/lift/left/{kind}"].at(stamp)
            image = np.frombuffer(message.data, IMAGES[kind]).reshape(expected.shape)
            # vertices may differ in their last bit, and with them a pixel on an edge
            same = np.isclose(image, expected, atol=1e-5) if kind == "depth/image" else image == expected
            assert same.mean() > 0.9995, kind


def test_joints_behind_the_passing_object_are_occluded_live(flow: Any) -> None:
    for stamp in flow.stamps:
        truth = frame_of(flow, stamp).joints["left"]["anna"]
        live = messages.read_joint_view(flow.received["/lift/left/joints"].at(stamp))
        assert (live["visible"] == truth.visible).mean() > 0.95


def test_the_marker_of_a_mesh_object_names_its_file(flow: Any, tmp_path: Path) -> None:
    from visualization_msgs.msg import Marker

    (tmp_path / "a b.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (tmp_path / "moves.xml").write_text(MOVES)
    (tmp_path / "scene.yaml").write_text(
        SCENE.replace("box: {", "box: {mesh: a b.obj, color: [255, 0, 51], ")
    )
    thing = Scene.load(tmp_path / "scene.yaml").objects["box"]
    marker = object_message(thing, thing.at(3.0), 5)
    assert (marker.type, marker.header.frame_id) == (Marker.MESH_RESOURCE, "map")
    assert marker.mesh_resource == (tmp_path / "a b.obj").as_uri()
    assert (marker.color.r, marker.color.g, marker.color.b) == (1.0, 0.0, pytest.approx(0.2))
    for wrong in ("scale", "orientation", "position"):
        broken = object_message(thing, thing.at(3.0), 5)
        part = broken.scale if wrong == "scale" else getattr(broken.pose, wrong)
        part.x = float("nan")
        with pytest.raises(RosError, match="not finite"):
            messages.read_object(broken)


def test_bones_of_markers_have_the_size_of_the_person(flow: Any) -> None:
    actor = flow.simulation.scene.actors["anna"]
    state = actor.at(50.0)
    lines = MarkerBuilder(actor.human).build("anna", 1, state, 0).markers[0].points
    knee = lines[2 * actor.human.skeleton.bone("l_hip") + 1]
    position = state.positions[actor.human.skeleton.bone("l_knee")]
    assert state.size == pytest.approx(5.9)
    np.testing.assert_allclose([knee.x, knee.y, knee.z], position, atol=1e-6)
