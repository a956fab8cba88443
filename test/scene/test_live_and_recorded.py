"""Messages of a frame that nodes put together from messages are those that a recording has.

No message goes through the network here. ``test/ros/test_same_on_every_run.py`` compares what nodes send.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest
from everything import everything

from humansim_ros import Frame, Scene, Simulation
from humansim_ros.data.messages import (
    CAMERA_INPUTS,
    AdapterTopic,
    CameraTopics,
    Topic,
    deserialised,
    received_frame,
    received_state,
    scene_inputs,
    scene_topics,
)
from humansim_ros.data.messages.cdr import serialised
from humansim_ros.render.interface import Renderer
from humansim_ros.scene import Needs
from humansim_ros.scene.core import NO_FAULTS, SceneState

pytestmark = pytest.mark.slow

#: Channels that compare frames. The camera node sends them a frame later.
FLOW = ("flow", "flow_hidden", "flow_back", "flow_back_hidden")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    config = everything(tmp_path_factory.mktemp("everything"))
    del config["crowd"]  # its people have the topics of the others, and take long
    return Scene.from_dict(config)


@pytest.fixture(scope="module")
def simulation(scene: Scene) -> Iterator[Simulation]:
    with Simulation(scene) as simulation:
        yield simulation


@pytest.fixture(scope="module")
def table(scene: Scene) -> dict[str, Topic[Any]]:
    return {topic.name: topic for topic in scene_topics(scene) if not topic.channels & {*FLOW}}


@pytest.fixture(scope="module")
def frame(scene: Scene, simulation: Simulation, table: dict[str, Topic[Any]]) -> Frame:
    """A recorded frame, in which no camera is frozen at an earlier one."""
    schedules = [camera.faults for camera in scene.scene_cameras.values() if camera.faults is not None]
    index = next(index for index in range(4, 40) if not any(each.at(index).picture for each in schedules))
    return simulation.frame(index, Needs.of(table.values()))


def through_cdr(topic: Topic[Any], frame: Frame) -> bytes:
    return bytes(serialised(topic.message(frame), topic.type_name))


@pytest.fixture(scope="module")
def state(scene: Scene, frame: Frame, table: dict[str, Topic[Any]]) -> SceneState:
    """The state of the scene that nodes make of the messages of the frame."""
    contents = {}
    for name, each in scene_inputs(scene, scene.moving_cameras).items():
        data = through_cdr(table[name], frame)
        contents[name] = each.read(data if each.raw else deserialised(data, each.type, each.max_bytes))
    stamps = frame.stamp, frame.scene_time, frame.index
    return received_state(scene, contents, *stamps, moving_cameras=scene.moving_cameras)


def sent(topic: Topic[Any], frame: Frame) -> list[tuple[int, bytes]]:
    """Times and bytes of the messages of a frame."""
    return [(at, bytes(serialised(message, topic.type_name))) for at, message in topic.sent(frame)]


def live(state: SceneState, camera: str, topics: Sequence[Topic[Any]], renderer: Renderer) -> Frame:
    """The frame that the node of a camera makes for some topics."""
    own, needs = state.scene.scene_cameras[camera], Needs.of(topics)
    faults = NO_FAULTS if own.faults is None else own.faults.at_time(state.scene_time)
    shot = replace(state.shot(own), channels=needs.ordered_channels, faults=faults)
    return Frame.captured(state, {camera: shot}, needs, renderer)


def test_all_topics_of_cameras_are_the_same(
    scene: Scene, simulation: Simulation, frame: Frame, state: SceneState, table: dict[str, Topic[Any]]
) -> None:
    compared = set()
    for name, camera in scene.scene_cameras.items():
        if frame.index not in camera.timing:
            continue
        own = [topic for topic in CameraTopics(scene, camera) if topic.name in table and topic.per_frame]
        ours = live(state, name, own, simulation.renderer)
        for topic in own:
            assert sent(topic, ours) == sent(table[topic.name], frame), topic.name
        compared |= {topic.name for topic in own}
    assert {"front/image_raw", "front/depth_sensor/points", "front/boxes", "front/image_rect"} <= compared


def test_a_few_topics_alone_are_the_same(
    simulation: Simulation, frame: Frame, state: SceneState, table: dict[str, Topic[Any]]
) -> None:
    """What a subscriber of one topic gets does not depend on other subscribers."""
    for name in ("front/camera_info", "front/joints", "front/image_raw/compressed", "front/points"):
        ours = live(state, "front", [table[name]], simulation.renderer)
        assert sent(table[name], ours) == sent(table[name], frame), name


def test_all_topics_of_other_people_stacks_are_the_same(
    scene: Scene, frame: Frame, state: SceneState, table: dict[str, Topic[Any]]
) -> None:
    adapters = [topic for topic in table.values() if isinstance(topic, AdapterTopic) and topic.per_frame]
    assert {topic.row for topic in adapters} >= {"detections_2d", "detections_3d", "people", "hri"}
    for topic in adapters:
        inputs = {
            each: CAMERA_INPUTS[each].read(table[f"{topic.camera}/{each}"].message(frame), scene)
            for each in topic.inputs
        }
        ours = received_frame(
            frame.stamp, state if topic.people else None, {topic.camera: inputs} if inputs else {}, scene
        )
        messages = [bytes(serialised(each, topic.type_name)) for each in topic.messages(ours, frame.stamp)]
        assert messages == [data for _, data in sent(topic, frame)], topic.name
