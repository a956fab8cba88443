"""Latched messages in recordings: once, and again only when they change."""

from __future__ import annotations

from collections import defaultdict
from contextlib import suppress
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros_support  # noqa: F401  # skips without ROS
from record_support import hashes

from humansim_ros import Scene
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.engine import WorkProgress, run
from humansim_ros.data.recording import SceneRecording
from humansim_ros.scene.core.simulation import Simulation

pytest.importorskip("rosbags")
FRAMES = 24
TOPICS = (
    "/humans/bodies/*/urdf",
    "/humans/persons/*",
    "/front/*",
    "/still/*",
    "/lidar/*",
    "/tf*",
    "/people*",
)
#: Stands, turns away for a moment, and stands again.
PATH = [
    [0, 3, 0, 1.5, 0.5, 0.5, -0.5, -0.5],
    [1, 3, 0, 1.5, 0.5, 0.5, -0.5, -0.5],
    [2.4, 3, 2, 1.5, 0.5, 0.5, -0.5, -0.5],
]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Somebody who walks out of the image and back, before a camera that stands for a second, then moves."""
    folder = tmp_path_factory.mktemp("scene")
    np.savetxt(folder / "path.tum", PATH)
    moving = {"file": str(folder / "path.tum")}
    return Scene.from_dict(
        {
            "rate": 10,
            "room": None,
            "humans": {
                "anna": {"motion": {"file": "walk", "position": [0, -1.6]}},
                "ben": {"motion": {"file": "walk", "position": [0.5, -2.6], "yaw_deg": 90}},
            },
            "cameras": {
                "still": {"size": [64, 48], "position": [3, 0, 1.5], "look_at": [0, 0, 1], "fov_deg": 40},
                "front": {"size": [32, 24], "trajectory": moving},
            },
            "scanners": {
                "lidar": {"pattern": {"columns": 30}, "rate": 5, "range": [0.1, 9], "trajectory": moving}
            },
            "adapters": {"people": {}},
            "hri": {"camera": "still"},
        }
    )


def bag(scene: Scene, folder: Path, size: int | None = None, jobs: int = 1, **options: Any) -> Path:
    run(SceneRecording.of(scene, FRAMES, TOPICS, max_size=size), folder, workers=jobs, **options)
    return folder


@pytest.fixture(scope="module")
def whole(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One file. In a bag of several files, each file begins with the present messages."""
    return bag(scene, tmp_path_factory.mktemp("whole") / "bag", 0)


def test_a_latched_message_is_recorded_again_only_when_it_changes(scene: Scene, whole: Path) -> None:
    found: dict[str, list[tuple[int, bytes]]] = defaultdict(list)
    with BagReader(whole) as reader:
        latched = {topic.name for topic in reader.topics if any(q.transient_local for q in topic.qos)}
        for message in reader.messages(latched):
            found[reader.topics[message.topic].name].append((message.stamp, bytes(message.data)))
    table = {f"/{topic.name}": topic for topic in SceneRecording.of(scene, FRAMES, TOPICS).table}
    assert {"/humans/persons/ben/body_id", "/humans/bodies/b_ben/urdf", "/front/projection"} <= latched
    expected: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    with Simulation(scene, ("instance", "depth", "part", "amodal", "rgb")) as simulation:
        for index in range(FRAMES):
            frame = simulation.frame(index)
            for name in latched:
                if table[name].per_frame or index == 0:
                    expected[name] += table[name].sent(frame)
    for name in latched:
        values = [
            (each[0][0], each[0][1])
            for _, group in groupby(expected[name], lambda e: e[1])
            if (each := list(group))
        ]
        assert [stamp for stamp, _ in found[name]] == [stamp for stamp, _ in values], name
        contents = [data for _, data in found[name]]
        assert all(a != b for a, b in pairwise(contents)), name
    assert len(found["/humans/bodies/b_ben/urdf"]) == len(found["/humans/persons/anna/anonymous"]) == 1
    assert len(found["/humans/persons/ben/body_id"]) > 1
    assert 1 < len(found["/front/projection"]) < FRAMES == len(found["/front/extrinsics"])


def test_each_file_of_a_bag_begins_with_the_latched_messages(
    scene: Scene, whole: Path, tmp_path: Path
) -> None:
    """So that each file can be understood alone, as far as topics with a message per frame are concerned."""
    shards = bag(scene, tmp_path / "bag")
    first: dict[str, set[int]] = defaultdict(set)
    values: dict[str, dict[int, bytes]] = defaultdict(dict)
    with BagReader(whole) as reader:
        names = [topic.name for topic in reader.topics]
        latched = [topic.name for topic in reader.topics if any(q.transient_local for q in topic.qos)]
        for message in reader.messages(latched):
            values[names[message.topic]][message.stamp] = bytes(message.data)
    with BagReader(shards) as reader:
        for message in reader.messages(latched):
            name = names[message.topic]
            first[name].add(message.stamp)
            newest = max(stamp for stamp in values[name] if stamp <= message.stamp)
            assert bytes(message.data) == values[name][newest]
    for name in latched:
        assert first[name] >= values[name].keys(), name
    assert len(first["/front/projection"]) > len(values["/front/projection"])


@pytest.mark.slow
@pytest.mark.process
def test_neither_jobs_nor_interruptions_change_what_is_latched(scene: Scene, tmp_path: Path) -> None:
    def stop(progress: WorkProgress) -> None:
        if progress.done == FRAMES // 2:
            raise KeyboardInterrupt

    folders = {name: tmp_path / name / "bag" for name in ("whole", "two", "stopped")}
    for folder in folders.values():
        folder.parent.mkdir()
    whole = hashes(bag(scene, folders["whole"]))
    assert hashes(bag(scene, folders["two"], jobs=2)) == whole
    with suppress(KeyboardInterrupt):
        bag(scene, folders["stopped"], on_progress=stop)
    assert not (folders["stopped"] / "metadata.yaml").exists()
    assert hashes(bag(scene, folders["stopped"], resume=True)) == whole


def test_a_recording_of_rare_messages_has_the_time_of_each_frame(scene: Scene, tmp_path: Path) -> None:
    """By which it is continued at the right frame."""
    for topic in ("/humans/persons/*/face_id", "/lidar/points"):
        recording = SceneRecording.of(scene, 4, [topic])
        assert "/scene_time" in recording.topics
