"""Exports of bags: the same data sets as of the scene, and errors that name what a bag lacks."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import ros_support  # noqa: F401  # skips without ROS
import yaml
from commands import largest_file
from export_support import SCENE, ExportJob, content, index_of, job, small_scene

from humansim_ros import HumansimError, HumansimWarning, Scene
from humansim_ros.cli.main import main
from humansim_ros.data.bags.reader import BagReader
from humansim_ros.data.bags.writer import BagWriter
from humansim_ros.data.engine import run
from humansim_ros.data.formats.bag import BagSource, recorded_patterns
from humansim_ros.data.formats.exporting import Export
from humansim_ros.data.formats.formats import BODIES, EXPORT_FORMATS, chosen_formats
from humansim_ros.data.formats.plan import ExportPlan
from humansim_ros.data.recording import SceneRecording
from humansim_ros.errors import ExportError

FRAMES = 4
#: Formats that a bag can be exported to: all but those of bodies.
FORMATS = [row.name for row in EXPORT_FORMATS.values() if BODIES not in row.content]
_NUMBER = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")


def recorded(folder: Path, scene: Scene, patterns: list[str], **options: Any) -> Path:
    plan = SceneRecording.of(scene, FRAMES, patterns, **options)
    run(plan, folder)
    return folder


def bag_job(root: Path, bag: Path, formats: str, frames: range | None = None, **options: Any) -> ExportJob:
    source = BagSource.read(bag, chosen_formats(formats.split(",")))
    return ExportJob(Export(source, ExportPlan.of(source, frames, **options)), root)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag with the topics that errors ask for."""
    patterns = recorded_patterns([EXPORT_FORMATS[name] for name in FORMATS], "coco17")
    return recorded(tmp_path_factory.mktemp("recorded") / "bag", small_scene(), patterns)


@pytest.fixture(scope="module")
def exports(tmp_path_factory: pytest.TempPathFactory, bag: Path) -> tuple[Path, Path]:
    """All formats of the bag, and of its scene."""
    folder = tmp_path_factory.mktemp("exports")
    names = ",".join(FORMATS)
    bag_job(folder / "of_bag", bag, names).run()
    job(folder / "of_scene", names, frames=f"0:{FRAMES}").run()
    return folder / "of_bag", folder / "of_scene"


def numbers(text: str) -> np.ndarray:
    return np.array([float(word) for word in _NUMBER.findall(text)])


#: Formats with other tests: of one file in the root, or of binary files.
OTHERS = ("croissant", "huggingface", "statistics", "webdataset", "c3d")


@pytest.mark.parametrize("name", [name for name in FORMATS if name not in OTHERS])
def test_a_bag_gives_the_files_of_its_scene(name: str, exports: tuple[Path, Path]) -> None:
    """Images are the same; messages have pixels as float32."""
    files = [sorted(p.relative_to(root) for p in (root / name).rglob("*")) for root in exports]
    assert files[0] == files[1] and files[0]
    for file in files[0]:
        here, there = (root / file for root in exports)
        if here.is_dir() or here.read_bytes() == there.read_bytes():
            continue
        assert file.suffix in (".json", ".txt", ".toml", ".trc", ".yaml"), file
        texts = [path.read_text() for path in (here, there)]
        if name == "coco":  # a bag has the names of objects, not their kinds
            texts[1] = texts[1].replace('"name": "box"', '"name": "crate"')
        assert _NUMBER.sub("0", texts[0]) == _NUMBER.sub("0", texts[1]), file
        np.testing.assert_allclose(numbers(texts[0]), numbers(texts[1]), atol=0.0011, err_msg=str(file))


def test_lines_and_counts_of_a_bag_are_those_of_its_scene(exports: tuple[Path, Path]) -> None:
    """But for the names of bodies, and the counts of poses, which no topic has."""
    of_bag, of_scene = (
        [json.loads(line) for line in (root / "metadata.jsonl").read_text().splitlines()] for root in exports
    )
    assert len(of_bag) == len(of_scene) > FRAMES
    for here, there in zip(of_bag, of_scene, strict=True):
        assert (here.pop("scene"), there.pop("scene")) == ("bag", "scene")
        assert not any(here["objects"].pop("body")) and all(there["objects"].pop("body"))
        texts = [json.dumps(line) for line in (here, there)]
        assert _NUMBER.sub("0", texts[0]) == _NUMBER.sub("0", texts[1])
        np.testing.assert_allclose(numbers(texts[0]), numbers(texts[1]), atol=0.0011)
    counts = [json.loads((root / "statistics.json").read_text()) for root in exports]
    assert counts[0]["people"] == {} and len(counts[1]["people"]) == 2
    for key in ("images", "sizes", "lenses"):
        assert counts[0][key] == counts[1][key]
    for name in ("people", "brightness", "cameras", "fov", "camera_height"):
        assert counts[0]["histograms"][name] == counts[1]["histograms"][name]


def test_a_laser_scanner_is_no_camera(tmp_path: Path) -> None:
    """It has extrinsics and legends, as cameras have."""
    scanner = {"model": "sick_tim571", "position": [0, 2, 1]}
    camera = {"size": [16, 12], "position": [3, 0, 1], "look_at": [0, 0, 1]}
    scene = Scene.from_dict({"cameras": {"c": camera}, "scanners": {"laser": scanner}, "room": None})
    plan = SceneRecording.of(scene, 1, ["**"])
    run(plan, tmp_path / "bag")
    source = BagSource.read(tmp_path / "bag", chosen_formats(["images"]))
    assert list(source.scene.cameras) == ["c"]


def test_keypoints_of_a_bag_score_as_those_of_the_scene(exports: tuple[Path, Path]) -> None:
    """pycocotools takes the annotations of the bag as a detection of the scene."""
    coco = pytest.importorskip("pycocotools.coco")
    evaluation = pytest.importorskip("pycocotools.cocoeval")
    of_bag, of_scene = (json.loads((r / "coco/person_keypoints.json").read_text()) for r in exports)
    truth = coco.COCO()
    truth.dataset = of_scene
    truth.createIndex()
    found = truth.loadRes([{**each, "score": 1.0} for each in of_bag["annotations"]])
    for kind in ("keypoints", "bbox", "segm"):
        judge = evaluation.COCOeval(truth, found, kind)
        judge.evaluate()
        judge.accumulate()
        judge.summarize()
        assert judge.stats[0] == pytest.approx(1.0)


def test_the_index_names_the_bag_and_its_stamps(exports: tuple[Path, Path], bag: Path) -> None:
    of_bag, of_scene = map(index_of, exports)
    assert of_bag["finished"] and of_bag["rate"] == of_scene["rate"] == 20
    assert of_bag["humans"] == ["anna", "bert"] and of_bag["objects"] == ["crate"]
    assert of_bag["provenance"]["bag"] == "bag"
    assert of_bag["provenance"]["stamps"] == [1 + 50_000_000 * index for index in range(FRAMES)]
    assert of_bag["provenance"]["recording"]["humansim_recording"]["frames"] == FRAMES
    assert set(of_bag["files"]) == set(of_scene["files"])


class _InterruptionError(Exception):
    pass


@pytest.mark.nightly
@pytest.mark.slow
def test_interruptions_and_processes_do_not_change_the_files(tmp_path: Path, bag: Path) -> None:
    formats = "images,labels,webdataset"
    whole = bag_job(tmp_path / "whole", bag, formats, shard_size=60_000)
    whole.run()
    assert len(list((tmp_path / "whole/webdataset").iterdir())) > 1
    root = tmp_path / "out"
    made = bag_job(root, bag, formats, shard_size=60_000)
    made = ExportJob(replace(made.export, shard_frames=1), root)

    def stop(progress: Any) -> None:
        if progress.new == 3:
            raise _InterruptionError

    with pytest.raises(_InterruptionError):
        made.run(on_progress=stop)
    assert not (root / "index.json").exists()
    state = made.run(workers=2, resume=True)
    assert (state.first, state.new) == (2, 2)
    assert content(root) == content(tmp_path / "whole")


@pytest.mark.daily("100000-webdataset/shard-000000.tar")
@pytest.mark.parametrize(
    ("limit", "file"), [(4_000, "images/noisy/000000.png"), (100_000, "webdataset/shard-000000.tar")]
)
def test_a_full_disk_leaves_whole_files_of_a_bag(limit: int, file: str, tmp_path: Path, bag: Path) -> None:
    """While frames are written, and while their samples are joined to a shard."""
    formats = "images,webdataset"
    bag_job(tmp_path / "whole", bag, formats).run()
    root = tmp_path / "out"
    made = bag_job(root, bag, formats)
    message = f"{file}: cannot be written: File too large"
    with largest_file(limit), pytest.raises(HumansimError, match=message):
        made.run()
    assert not (root / file).exists()
    made.run(resume=True)
    assert content(root) == content(tmp_path / "whole")


def test_another_bag_does_not_continue_an_export(tmp_path: Path, bag: Path) -> None:
    bag_job(tmp_path / "out", bag, "anipose").run()
    other = recorded(tmp_path / "other", small_scene(), ["*/camera_info", "*/extrinsics"])
    with pytest.raises(ExportError, match="the scene, a file of it, or the bag has changed"):
        bag_job(tmp_path / "out", other, "anipose").run(resume=True)


@pytest.mark.daily("options1")
@pytest.mark.parametrize("options", [{"images": "png", "depth": "png"}, {"storage": "sqlite3"}])
def test_compressed_images_and_other_storages_are_read(
    options: dict[str, str], tmp_path: Path, exports: tuple[Path, Path]
) -> None:
    patterns = ["*/image_raw", "*/camera_info", "*/extrinsics", "*/depth/image"]
    other = recorded(tmp_path / "bag", small_scene(), patterns, **options)
    bag_job(tmp_path / "out", other, "images,depth-npy").run()
    for file in (exports[1] / "images").rglob("*.png"):
        assert (tmp_path / "out" / file.relative_to(exports[1])).read_bytes() == file.read_bytes()
    for file in (exports[1] / "depth-npy").rglob("*.npy"):
        found, truth = np.load(tmp_path / "out" / file.relative_to(exports[1])), np.load(file)
        if "depth" in options:  # 16 bits of inverse depth up to 10 m (docs of compressed_depth_message)
            assert np.isinf(found[truth >= 10]).all()
            near = truth < 10
            limit = truth[near] ** 2 / (2 * 100 * 101) + 1e-4
            assert (np.abs(found[near] - truth[near]) <= limit).all()
        else:
            np.testing.assert_array_equal(found, truth)


@pytest.mark.nightly
def test_labels_as_png_give_the_files_of_the_scene(tmp_path: Path, exports: tuple[Path, Path]) -> None:
    patterns = recorded_patterns([EXPORT_FORMATS["coco"], EXPORT_FORMATS["labels"]], "coco17")
    other = recorded(tmp_path / "bag", small_scene(), patterns, labels="png")
    with BagReader(other) as reader:
        names = {topic.name for topic in reader.topics}
    assert "/bent/instance/image/compressed" in names and "/bent/instance/image" not in names
    bag_job(tmp_path / "out", other, "labels").run()
    files = [file for file in (exports[1] / "labels").rglob("*") if file.suffix in (".png", ".npz")]
    assert files
    for file in files:
        assert (tmp_path / "out" / file.relative_to(exports[1])).read_bytes() == file.read_bytes()


@pytest.mark.parametrize(
    ("name", "form", "message"),
    [
        (
            "part",
            "mono8; jpeg compressed ",
            "part as 'mono8; jpeg compressed ' is not exact; mono8, raw or PNG",
        ),
        ("instance", "mono8; png compressed ", "instance as .* is not exact; mono16, raw or PNG, is"),
    ],
)
def test_labels_that_are_not_exact_are_refused(name: str, form: str, message: str) -> None:
    from humansim_ros.data.formats.bag import _reader_of
    from humansim_ros.data.messages.types import CompressedImage

    suffix = ".jpg" if "jpeg" in form else ".png"
    data = cv2.imencode(suffix, np.full((8, 8), 3, np.uint8))[1]
    with pytest.raises(ExportError, match=message):
        _reader_of(name)(CompressedImage(format=form, data=data.tobytes()))


def test_the_index_of_a_bag_has_the_licences_of_its_people(exports: tuple[Path, Path]) -> None:
    here, there = (index_of(root) for root in exports)
    assert here["licenses"] == there["licenses"] == dict.fromkeys(here["humans"], "CC0-1.0")


@pytest.mark.nightly
def test_the_licence_of_a_scene_is_that_of_its_data_sets(tmp_path: Path) -> None:
    scene = Scene.from_dict({**yaml.safe_load(SCENE), "license": " CC-BY-4.0 "})
    rows = chosen_formats(["coco"])
    bag = recorded(tmp_path / "bag", scene, recorded_patterns(rows, "coco17"))
    bag_job(tmp_path / "of_bag", bag, "coco").run()
    job(tmp_path / "of_scene", "coco", scene, frames=f"0:{FRAMES}").run()
    for name in ("of_bag", "of_scene"):
        assert index_of(tmp_path / name)["license"] == "CC-BY-4.0"
        coco = json.loads((tmp_path / name / "coco/person_keypoints.json").read_text())
        assert coco["licenses"][0]["name"] == "CC-BY-4.0"
    assert job(tmp_path / "other", "coco", scene, license="MIT").export.plan.license == "MIT"


@pytest.mark.nightly
def test_jpeg_images_are_those_of_the_bag(tmp_path: Path, exports: tuple[Path, Path]) -> None:
    other = recorded(
        tmp_path / "bag", small_scene(), ["*/image_raw", "*/camera_info", "*/extrinsics"], images="jpeg"
    )
    bag_job(tmp_path / "out", other, "images").run()
    for file in (exports[1] / "images").rglob("*.png"):
        found = cv2.imread(str(tmp_path / "out" / file.relative_to(exports[1]))).astype(int)
        assert np.abs(found - cv2.imread(str(file)).astype(int)).mean() < 4  # colours are not swapped


@pytest.mark.nightly
def test_each_frame_of_a_moving_camera_has_its_pose(tmp_path: Path) -> None:
    (tmp_path / "flight.txt").write_text("0 3 0 1.5 0.5 0.5 -0.5 -0.5\n1 4 0 1.5 0.5 0.5 -0.5 -0.5\n")
    text = yaml.safe_load(SCENE)
    text["cameras"]["noisy"] = {"size": [96, 72], "trajectory": {"file": str(tmp_path / "flight.txt")}}
    scene = Scene.from_dict(text)
    rows = chosen_formats(["coco"])
    other = recorded(tmp_path / "bag", scene, recorded_patterns(rows, "coco17"))
    bag_job(tmp_path / "out", other, "coco").run()
    job(tmp_path / "truth", "coco", scene, frames=f"0:{FRAMES}").run()
    found, truth = (
        json.loads((tmp_path / name / "coco/person_keypoints.json").read_text())["images"]
        for name in ("out", "truth")
    )
    poses = {tuple(map(float, image["t"])) for image in found if image["camera"] == "noisy"}
    assert len(poses) == FRAMES
    by_file = {image["file_name"]: image for image in truth}
    for image in found:
        for part in ("K", "R", "t"):
            np.testing.assert_allclose(image[part], by_file[image["file_name"]][part], atol=1e-9)


def copy_without(bag: Path, to: Path, left_out: Callable[[str, int], bool]) -> Path:
    """A copy of a bag. ``left_out``: whether a message of a topic and log time is left out."""
    with BagReader(bag) as reader, BagWriter(to, list(reader.topics)) as writer:
        for message in reader.messages():
            if not left_out(reader.topics[message.topic].name, message.stamp):
                writer.write([message])
    return to


def test_frames_that_lack_a_message_are_left_out_and_named(tmp_path: Path, bag: Path) -> None:
    second = 50_000_001
    part = copy_without(
        bag, tmp_path / "bag", lambda topic, stamp: topic == "/bent/image_raw" and stamp == second
    )
    with pytest.warns(
        HumansimWarning, match=r"1 of 4 frames lack a message on /bent/image_raw: they are left"
    ):
        made = bag_job(tmp_path / "out", part, "images")
    made.run()
    assert index_of(tmp_path / "out")["provenance"]["stamps"] == [1, 100_000_001, 150_000_001]
    assert len(list((tmp_path / "out/images/noisy").iterdir())) == 3
    apart = {"/bent/image_raw": {1}, "/noisy/image_raw": {second}}
    alone = copy_without(
        bag, tmp_path / "alone", lambda topic, stamp: topic in apart and stamp not in apart[topic]
    )
    with pytest.raises(ExportError, match="no frame is whole: 2 of 2 frames lack a message on /"):
        bag_job(tmp_path / "none", alone, "images")


@pytest.fixture(scope="module")
def poor_bag(tmp_path_factory: pytest.TempPathFactory, bag: Path) -> Path:
    """A bag without the pose of a camera and the keypoints of a person."""
    missing = ("/bent/extrinsics", "/humans/bert/keypoints/coco17")
    return copy_without(bag, tmp_path_factory.mktemp("poor") / "bag", lambda topic, _: topic in missing)


@pytest.mark.daily("labels", "coco")
@pytest.mark.parametrize("format", FORMATS)
def test_a_topic_that_is_missing_is_named_with_the_command_that_records_it(
    format: str, poor_bag: Path
) -> None:
    """The topics of the command are those of the bag of the other tests, which can be exported."""
    missing = "/humans/bert/keypoints/coco17" if format in ("trc", "c3d") else "/bent/extrinsics"
    patterns = ",".join(recorded_patterns([EXPORT_FORMATS[format]], "coco17"))
    said = f"{missing}, which the bag does not have; record one with humansim record … --topics '{patterns}'"
    with pytest.raises(ExportError) as caught:
        BagSource.read(poor_bag, [EXPORT_FORMATS[format]])
    assert f"the format {format} needs the topic {said}" in str(caught.value)


@pytest.mark.parametrize("format", ["thesis", "bvh", "glb", "usd", "mujoco", "gazebo"])
def test_formats_of_bodies_need_the_scene(format: str, tmp_path: Path, bag: Path) -> None:
    with pytest.raises(ExportError, match=f"the format {format} needs bodies .*: export the scene"):
        bag_job(tmp_path / "out", bag, format)


def command(patch: pytest.MonkeyPatch, *words: Any) -> int:
    patch.setattr(sys, "argv", ["humansim", "export", *map(str, words)])
    return main()


@pytest.mark.nightly
def test_the_command_exports_all_frames_of_a_bag(
    tmp_path: Path, bag: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [bag, "--format", "trc,anipose", "--jobs", "1"]
    assert command(monkeypatch, *words, "-o", tmp_path / "out") == 0
    assert index_of(tmp_path / "out")["plan"]["end"] == FRAMES
    assert command(monkeypatch, *words, "-o", tmp_path / "part", "--range", "1:3") == 0
    assert "NumFrames" in (tmp_path / "part/trc/anna.trc").read_text()
    capsys.readouterr()
    assert command(monkeypatch, *words, "-o", tmp_path / "more", "--frames", "9") == 2
    assert "--frames: the bag has 4 frames, so that the last one is 3" in capsys.readouterr().err
    scene = tmp_path / "scene.yaml"
    scene.write_text(SCENE)
    assert command(monkeypatch, scene, "--format", "trc", "-o", tmp_path / "more") == 2
    assert "--frames: a scene has no end: give a number of frames, such as 300" in capsys.readouterr().err


def test_a_damaged_message_is_named(tmp_path: Path, bag: Path) -> None:
    """Its stamp can be read, but its image is cut."""
    with BagReader(bag) as reader, BagWriter(tmp_path / "bag", list(reader.topics)) as writer:
        for message in reader.messages():
            name = reader.topics[message.topic].name
            cut = name == "/bent/depth/image" and message.stamp == 1
            data = bytes(message.data)[:200] if cut else message.data
            writer.write([message._replace(data=data)])
    with pytest.raises(ExportError, match=r"bag: /bent/depth/image: 200 bytes that are no Image"):
        bag_job(tmp_path / "out", tmp_path / "bag", "depth-png").run()
