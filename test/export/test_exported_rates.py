"""Recordings and exports of cameras with rates of their own: exact stamps, and valid sequences."""

from __future__ import annotations

import configparser
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import ros_support  # noqa: F401  # skips without ROS
import yaml
from export_support import SCENE, ExportJob, job

from humansim_ros import Scene
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.data.engine import run
from humansim_ros.data.evaluation.export_truth import SceneImages
from humansim_ros.data.formats.bag import BagSource, recorded_patterns
from humansim_ros.data.formats.exporting import Export
from humansim_ros.data.formats.formats import chosen_formats
from humansim_ros.data.formats.plan import ExportPlan
from humansim_ros.data.recording import SceneRecording
from humansim_ros.errors import ExportError, HumansimWarning
from humansim_ros.people import keypoint_set

rosbags_highlevel = pytest.importorskip("rosbags.highlevel")
FRAMES, PERIOD = 9, 50_000_000
#: Frames in which the cameras take pictures: at 10 and at 20 / 3 Hz, of a scene at 20 Hz.
PICTURES = {"noisy": range(0, FRAMES, 2), "bent": range(1, FRAMES, 3)}
FORMATS = "images,mot,coco,yolo,trc,webdataset,labels"


def timed_scene() -> Scene:
    scene = yaml.safe_load(SCENE)
    scene["cameras"]["noisy"]["rate"] = 10
    scene["cameras"]["bent"] |= {"rate": 6.667, "offset": 0.05}
    return Scene.from_dict(scene)


def stamps_of(camera: str) -> list[int]:
    return [1 + PERIOD * index for index in PICTURES[camera]]


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rows = chosen_formats(FORMATS.split(","))
    patterns = [*recorded_patterns(rows, "coco17"), "/humans/*/joints", "*/joints"]
    folder = tmp_path_factory.mktemp("recorded") / "bag"
    scene = timed_scene()
    run(SceneRecording.of(scene, FRAMES, patterns), folder)
    return folder


def bag_job(root: Path, bag: Path, formats: str = FORMATS) -> ExportJob:
    source = BagSource.read(bag, chosen_formats(formats.split(",")))
    return ExportJob(Export(source, ExportPlan.of(source, None)), root)


@pytest.mark.nightly
def test_a_bag_has_the_pictures_of_each_camera_and_the_world_of_each_frame(bag: Path) -> None:
    found: dict[str, list[int]] = {}
    with rosbags_highlevel.AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            if hasattr(message, "header"):
                stamp = message.header.stamp
                found.setdefault(connection.topic, []).append(stamp.sec * 10**9 + stamp.nanosec)
    whole = [1 + PERIOD * index for index in range(FRAMES)]
    assert found["/scene_time"] == found["/humans/anna/joints"] == whole
    for camera in PICTURES:
        for topic in ("image_raw", "camera_info", "boxes", "joints", "instance/image", "keypoints/coco17"):
            assert found[f"/{camera}/{topic}"] == stamps_of(camera)
        assert len(found[f"/{camera}/extrinsics"]) == 1


def test_a_recording_of_one_camera_has_a_message_for_each_frame_and_can_be_resumed(tmp_path: Path) -> None:
    plan = SceneRecording.of(timed_scene(), 7, ["/bent/camera_info"], shard_frames=2)
    assert plan.topics == ("/scene_time", "/bent/camera_info")
    run(plan, tmp_path / "whole")

    def stop(progress: Any) -> None:
        if progress.new == 4:  # after a frame without picture
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(plan, tmp_path / "bag", on_progress=stop)
    run(plan, tmp_path / "bag", resume=True)
    content = []
    for name in ("whole", "bag"):
        with BagReader(tmp_path / name) as reader:
            content.append([(m.topic, m.stamp, bytes(m.data)) for m in reader.messages()])
    assert content[0] == content[1] and len(content[0]) == 7 + 2


@pytest.mark.nightly
def test_exports_of_the_scene_and_of_its_bag_have_the_pictures_of_each_camera(
    tmp_path: Path, bag: Path
) -> None:
    job(tmp_path / "scene", FORMATS, timed_scene(), frames=f"0:{FRAMES}").run()
    bag_job(tmp_path / "bag", bag).run()
    for root in (tmp_path / "scene", tmp_path / "bag"):
        for camera, pictures in PICTURES.items():
            names = [path.name for path in sorted((root / "images" / camera).iterdir())]
            assert names == [f"{index:06d}.png" for index in pictures]
            _check_mot(root / "mot" / camera, root, camera)
        images = json.loads((root / "coco/instances.json").read_text())["images"]
        expected = [(i, c) for i in range(FRAMES) for c in PICTURES if i in PICTURES[c]]
        assert [(image["frame"], image["camera"]) for image in images] == expected
        assert [image["stamp"] for image in images] == [1 + PERIOD * frame for frame, _ in expected]
        assert len((root / "yolo/train.txt").read_text().split()) == len(expected)
        header = (root / "trc/anna.trc").read_text().splitlines()[2].split()
        assert [float(header[0]), int(header[2])] == [20, FRAMES]  # the world has the rate of the scene
    for path in (tmp_path / "scene" / "images").rglob("*.png"):
        assert path.read_bytes() == (tmp_path / "bag" / path.relative_to(tmp_path / "scene")).read_bytes()
    numbers = SceneImages(timed_scene(), keypoint_set("coco17"))
    for image in json.loads((tmp_path / "scene/coco/instances.json").read_text())["images"]:
        assert numbers.number(image["camera"], image["frame"]) == image["id"]
        assert numbers.size(image["id"]) == (image["width"], image["height"])
    assert numbers.number("bent", 0) is None
    assert len(numbers.images([3, 5]).images) == 3  # of frames 2 to 4


def _check_mot(folder: Path, root: Path, camera: str) -> None:
    info = configparser.ConfigParser()
    info.read(folder / "seqinfo.ini")
    count = len(PICTURES[camera])
    assert info.getint("Sequence", "seqLength") == count
    assert info.getfloat("Sequence", "frameRate") == pytest.approx(20 / PICTURES[camera].step, rel=1e-4)
    links = sorted((folder / "img1").iterdir())
    assert [path.name for path in links] == [f"{number:06d}.png" for number in range(1, count + 1)]
    assert links[1].resolve() == (root / f"images/{camera}/{PICTURES[camera][1]:06d}.png").resolve()
    rows = np.loadtxt(folder / "gt/gt.txt", delimiter=",", ndmin=2)
    assert set(rows[:, 0]) <= {*range(1, count + 1)}


def test_a_picture_that_a_bag_has_lost_takes_its_frame_and_no_other(tmp_path: Path, bag: Path) -> None:
    lost = stamps_of("noisy")[1]
    with BagReader(bag) as reader, BagWriter(tmp_path / "bag", list(reader.topics)) as writer:
        for message in reader.messages():
            topic = reader.topics[message.topic].name
            if (topic, message.stamp) != ("/noisy/instance/image", lost):
                writer.write([message])
    with pytest.warns(HumansimWarning, match="1 of 7 frames lack a message on /noisy/instance/image"):
        source = BagSource.read(tmp_path / "bag", chosen_formats(["labels"]))
    assert [place.stamp for place in source.frames] == [s for s in _stamps() if s != lost]


def _stamps() -> list[int]:
    return sorted({*stamps_of("noisy"), *stamps_of("bent")})


def test_a_project_of_pose2sim_needs_every_camera_in_each_frame(tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="camera noisy has images at 10 Hz only"):
        job(tmp_path / "out", "openpose", timed_scene()).run()


@pytest.mark.nightly
def test_a_video_has_the_rate_of_its_camera(tmp_path: Path) -> None:
    job(tmp_path / "out", "mp4", timed_scene(), frames=f"0:{FRAMES}").run()
    for camera, pictures in PICTURES.items():
        video = cv2.VideoCapture(str(tmp_path / f"out/mp4/{camera}.mp4"))
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == len(pictures)
        assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(20 / pictures.step, rel=1e-3)
