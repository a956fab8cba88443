"""Estimates as other programs write them: each layout gives the figures that are known from the truth."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import estimate_layouts as made
import numpy as np
import pytest

from humansim_ros.cli import main as cli

pytest.importorskip("pycocotools")

Run = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return made.write_truth(tmp_path_factory.mktemp("truth"))


@pytest.fixture
def run(
    truth: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Run:
    """Run ``humansim evaluate``: exit code, JSON, and messages."""

    def evaluate(estimate: Path | str, *words: str, of: Path = truth) -> tuple[int, dict[str, Any], str]:
        given = ["--truth", str(of), "--estimate", str(estimate), "--json", *words]
        monkeypatch.setattr("sys.argv", ["humansim", "evaluate", *given])
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            code = cli.main()
        out, err = capsys.readouterr()
        return code, json.loads(out) if code == 0 else {}, err

    return evaluate


@pytest.mark.slow
@pytest.mark.parametrize(
    ("write", "options"),
    [
        (made.coco_by_name, ()),
        (made.alphapose, ()),
        (made.yolo_predictions, ()),
        (made.alphapose_cmu, ()),
        (partial(made.alphapose_cmu, open_form=True), ()),
        (made.openpose, ()),
        (made.openpose, ("--keypoints", "body25")),
        (made.mmpose_images, ()),
        (partial(made.mmpose_images, name="predictions/{camera}/{frame:06d}.json"), ()),
        (made.mmpose_image_demo, ()),
        (made.mmpose_video, ()),
        (made.mmpose_demo, ()),
        (made.yolo, ()),
        (partial(made.yolo, more=" 0.8"), ()),
        (partial(made.yolo, more=" 0.8 17"), ()),
        (partial(made.yolo, more=" 17"), ()),
        (partial(made.yolo, name="{camera}_{frame}"), ()),
        (lambda folder: made.yolo(folder).parent, ()),
        (made.yolo_json, ()),
        (made.yolo_results, ()),
        (made.deeplabcut, ()),
        (made.coco_data_set, ()),
    ],
)
def test_keypoints_in_images(write: made.Writer, options: tuple[str, ...], run: Run, tmp_path: Path) -> None:
    code, result, text = run(write(tmp_path), *options)
    assert code == 0 and not text, text
    own = result["keypoints"]["all"]
    assert result["images"] == 24 and result["keypoint_set"] == "coco17"
    assert (own["present"], own["found"], own["false"]) == (48, 48, 0)
    assert own["precision"]["ap"] == pytest.approx(1) and own["similarity"] == pytest.approx(1)
    assert own["error"]["mean"] < 1e-5 and len(result["keypoints"]["by_keypoint"]) == 17
    if result["boxes"] is not None:
        assert result["boxes"]["all"]["found"] == 48 and result["boxes"]["all"]["precision"]["ap"] > 0.999


@pytest.mark.parametrize(
    "write",
    [
        made.yolo_boxes,
        made.mot,
        partial(made.mot, first=0),
        partial(made.mot, end=",1,1,0.8"),
        partial(made.mot, end=",-1,-1,-1,-1"),
        partial(made.mot, name="{camera}/det/det.txt"),
        made.aicity_2d,
    ],
)
def test_boxes_in_images(write: made.Writer, run: Run, tmp_path: Path) -> None:
    code, result, text = run(write(tmp_path))
    assert code == 0 and not text, text
    own = result["boxes"]["all"]
    assert result["keypoints"] is None and (own["present"], own["found"], own["false"]) == (48, 48, 0)
    assert own["precision"]["ap"] == pytest.approx(1) and own["similarity"] > 0.9999


@pytest.mark.parametrize(
    ("write", "kind", "images", "found"),
    [
        (lambda folder: made.mot(folder) / "camera_2.txt", "boxes", 12, 24),
        (lambda folder: made.mot(folder, name="{camera}/det/det.txt") / "camera_1", "boxes", 12, 24),
        (partial(made.mot, seen_by=("camera_2",)), "boxes", 24, 24),
        (lambda folder: made.openpose(folder) / "camera_1_json", "keypoints", 12, 24),
        (partial(made.deeplabcut, people=("anna",)), "keypoints", 24, 24),
        (lambda folder: next(made.deeplabcut(folder).glob("camera_2*")), "keypoints", 12, 24),
        (made.deeplabcut_labels, "keypoints", 24, 24),
    ],
)
def test_some_of_the_people_or_cameras(
    write: made.Writer, kind: str, images: int, found: int, run: Run, tmp_path: Path
) -> None:
    code, result, text = run(write(tmp_path))
    assert code == 0 and not text, text
    own = result[kind]["all"]
    assert result["images"] == images
    assert (own["present"], own["found"], own["false"]) == (2 * images, found, 0)
    recalls = found / (2 * images) >= np.linspace(0, 1, 101)  # as COCO asks, with precision 1
    assert own["precision"]["ap"] == pytest.approx(np.mean(recalls), abs=1e-6)


def test_frames_of_a_video_of_ultralytics_count_from_one(run: Run, tmp_path: Path) -> None:
    code, result, text = run(made.yolo(tmp_path, name="{camera}_{frame}", first=1))
    assert code == 0 and text.count("warning: ") == 1 and "count from 1, as ultralytics" in text, text
    assert result["keypoints"]["all"]["found"] == 48 and result["boxes"]["all"]["similarity"] > 0.9999


def test_seventeen_keypoints_without_names_may_be_of_two_sets(run: Run, tmp_path: Path) -> None:
    other = made.write_truth(tmp_path / "truth", keypoints="h36m17")
    estimate = made.mmpose_images(tmp_path / "estimate")
    code, _, text = run(estimate, of=other)
    assert code == 0 and "taken as h36m17, the set of the truth" in text and "--keypoints coco17" in text
    code, result, text = run(estimate, "--keypoints", "coco17", of=other)
    assert code == 0 and not text and len(result["keypoints"]["by_keypoint"]) < 17, text


@pytest.mark.parametrize(
    ("write", "options", "people"),
    [
        (made.easymocap, (), 2),
        (made.easymocap, ("--keypoints", "coco17"), 2),
        (partial(made.easymocap, body25=True), (), 2),
        (made.panoptic, (), 2),
        (made.anipose, ("--scale", "0.001"), 2),
        (made.anipose, (), 2),
        (partial(made.anipose, scale=1.0), (), 2),
        (made.freemocap_wide, (), 1),
        (made.freemocap_wide, ("--scale", "0.001"), 1),
        (partial(made.freemocap_wide, before="body_", times=True), (), 1),
        (made.freemocap_long, (), 1),
        (made.freemocap_array, (), 1),
        (partial(made.freemocap_array, points=33), (), 1),
    ],
)
def test_poses(write: made.Writer, options: tuple[str, ...], people: int, run: Run, tmp_path: Path) -> None:
    code, result, text = run(write(tmp_path), *options)
    assert code == 0 and not text, text
    found = result["people"]
    assert result["frames"]["compared"] == 12 and result["frames"]["without_estimate"] == 0
    assert (found["present"], found["found"], found["false"]) == (24, 12 * people, 0)
    assert result["position"]["mpjpe"] < 1e-6 and len(result["by_joint"]) == 17
    assert result["tracking"]["switches"] == 0


def test_an_empty_row_of_freemocap_is_a_frame(run: Run, tmp_path: Path) -> None:
    path = made.freemocap_wide(tmp_path)
    lines = path.read_text().splitlines()
    lines[4] = "," * lines[0].count(",")
    path.write_text("\n".join(lines))
    code, result, text = run(path)
    assert code == 0 and not text, text
    assert result["frames"]["compared"] == 12 and result["people"]["found"] == 11
    assert result["position"]["mpjpe"] < 1e-6


def written(name: str, content: str | bytes) -> made.Writer:
    """Writes one file."""

    def write(folder: Path) -> Path:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
        return folder / name

    return write


def openpose_3d(folder: Path) -> Path:
    for frame in range(made.FRAMES):
        made.write_json(folder / f"{frame:012d}_keypoints.json", {"people": []})
    return folder


def no_markers(folder: Path) -> Path:
    ezc3d = pytest.importorskip("ezc3d")
    file = ezc3d.c3d()
    for group in ("POINT", "ANALOG"):
        file["parameters"][group]["RATE"]["value"] = [30.0]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ["force"]
    file["data"]["points"], file["data"]["analogs"] = np.zeros((4, 0, 12)), np.zeros((1, 1, 12))
    file.write(str(folder / "nobody.c3d"))
    return folder / "nobody.c3d"


TRC = (
    "PathFileType\t4\t(X/Y/Z)\tx.trc\nDataRate\tNumMarkers\tUnits\n30\t1\tm\n"
    "Frame#\tTime\tnose\n\t\tX1\tY1\tZ1\n"
)


@pytest.mark.parametrize(
    "write",
    [
        written("header.csv", "time,person,nose_x,nose_y,nose_z\n"),
        written("long.csv", "frame,joint,x,y,z"),
        written("blank.csv", "frame,nose_x,nose_y,nose_z\n" + "".join(f"{n},,nan,\n" for n in range(12))),
        written("frames.trc", TRC),
        written("blank.trc", TRC + "".join(f"{n + 1}\t{n / 30}\t\t\t\n" for n in range(12))),
        no_markers,
        openpose_3d,
        partial(made.panoptic, people=()),
        partial(made.easymocap, people=()),
        written("mediapipe_body_3d_xyz.csv", ",".join(f"nose_{axis}" for axis in "xyz") + "\n" + ",,\n" * 12),
    ],
)
def test_poses_of_nobody_are_scored(write: made.Writer, run: Run, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    code, result, text = run(write(tmp_path), "--report", str(page), "--offset", "auto")
    assert code == 0 and "nobody is in the estimate: everybody is missed" in text, text
    assert result["frames"]["compared"] == 12
    people = {"present": 24, "found": 0, "missed": 24, "false": 0, "recall": 0.0, "precision": None}
    assert (
        result["people"] == people and result["detection"]["mean_ap"] == 0 and result["position"]["pck"] == 0
    )
    assert page.stat().st_size > 1000


def no_labels(folder: Path) -> Path:
    for camera, frame in made.views():
        written(f"labels/{camera}_{frame:06d}.txt", "")(folder)
    return folder / "labels"


@pytest.mark.parametrize(
    "write",
    [
        written("results.json", "[]"),
        written("results.json", '{"images": [], "annotations": []}'),
        written("alphapose-results.json", "{}"),
        partial(made.openpose, people=()),
        partial(made.mmpose_images, people=()),
        partial(made.deeplabcut, people=("anna",), seen=False),
        written("camera_1DLC_a.csv", "scorer,a,a,a\nbodyparts,nose,nose,nose\ncoords,x,y,likelihood\n"),
        written("results_camera_1.json", '{"meta_info": {}, "instance_info": []}'),
        partial(made.mot, people=()),
        no_labels,
        written("camera_1/labels/000003.txt", "56 0.5 0.5 0.1 0.1\n"),
    ],
)
def test_images_without_people_are_scored(write: made.Writer, run: Run, tmp_path: Path) -> None:
    code, result, text = run(write(tmp_path))
    assert code == 0 and "nobody is in the estimate: everybody is missed" in text, text
    own = result["keypoints"]["all"]
    cameras = 1 if result["images"] == 12 else 2  # a file of one camera is compared with that camera
    assert result["images"] == 12 * cameras
    assert (own["present"], own["found"], own["false"], own["precision"]["ap"]) == (24 * cameras, 0, 0, 0.0)


def test_result_files_of_nobody_are_scored(run: Run, truth: Path, tmp_path: Path) -> None:
    """An empty file is one of boxes in map, if the truth has them, else one of MOTChallenge."""
    path = written("track1.txt", "")(tmp_path)
    code, result, text = run(path)
    assert code == 0 and "nobody is in the estimate" in text, text
    assert result["frames"] == 12 and result["people"]["missed"] == 24 and result["people"]["recall"] == 0
    assert result["tracking"]["iou"]["hota"] == 0
    other = made.write_truth(tmp_path / "truth", formats=("coco", "trc"))
    code, result, text = run(path, of=other)
    assert code == 0 and result["boxes"]["all"]["present"] == 48, text


def test_a_scene_is_compared_at_its_begin_without_frames_of_the_estimate(run: Run, tmp_path: Path) -> None:
    camera = "a: {size: [64, 48], position: [3, 0, 1], look_at: [0, 0, 1]}"
    scene = tmp_path / "scene.yaml"
    scene.write_text(f"room: null\nhumans: {{anna: {{body: child}}}}\ncameras: {{{camera}}}\n")
    code, result, text = run(written("header.csv", "time,nose_x,nose_y,nose_z\n")(tmp_path), of=scene)
    assert code == 0 and result["people"]["found"] == 0 and result["people"]["missed"] > 0, text
    code, result, text = run(written("track1.txt", "")(tmp_path), of=scene)
    assert code == 0 and result["people"]["recall"] == 0, text


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (written("e.csv", ""), "file is empty"),
        (written("e.json", ""), "file is empty"),
        (written("e.npy", ""), "the NumPy file is empty"),
        (lambda folder: folder / "missing", "no such file"),
    ],
)
def test_files_of_zero_bytes_are_damaged(write: made.Writer, message: str, run: Run, tmp_path: Path) -> None:
    code, _, text = run(write(tmp_path))
    assert code == 2 and message in text, text


COCO_ROW = {"image_id": "camera_1_000000.png", "category_id": 1, "score": 1, "keypoints": [1.0] * 51}
MMPOSE_ROW = {"keypoints": [[1.0, 2.0]] * 17, "keypoint_scores": [1.0] * 17}
DLC = "scorer,a,a,a\nbodyparts,nose,nose,nose\ncoords,x,y,likelihood\n"
YOLO = "0 0.5 0.5 0.1 0.1 "


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", [COCO_ROW | {"image_id": "camera_9_000000.png"}], "[0].image_id: no camera of the truth"),
        (
            "a.json",
            [COCO_ROW, COCO_ROW | {"image_id": "camera_1_000099.png"}],
            "[1].image_id: the truth has no",
        ),
        ("a.json", [COCO_ROW | {"image_id": "camera_1.png"}], "needs the number of its frame"),
        ("a.json", [COCO_ROW | {"keypoints": [1.0] * 48}], "[0].keypoints: 48 numbers, but 51 are needed"),
        ("a.json", [COCO_ROW, COCO_ROW | {"keypoints": [1.0] * 75}], "[1].keypoints: 75 numbers, but 51"),
        (
            "a.json",
            {"camera_1_000000.png": {"bodies": [{"joints": [1.0] * 53}]}},
            "bodies[0]: not as OpenPose",
        ),
        ("a.json", {"camera_8_000000.png": {"people": []}}, "no camera of the truth"),
        ("camera_1_000000.json", [{}], "[0]: not as OpenPose, AlphaPose, MMPose or ultralytics writes it"),
        ("camera_1_000000.json", [MMPOSE_ROW | {"keypoint_scores": [1.0] * 16}], "[0]: not as OpenPose"),
        (
            "camera_1_000000.json",
            [MMPOSE_ROW | {"keypoints": [[1.0, 2.0, 3.0]] * 17}],
            "[0]: not as OpenPose",
        ),
        (
            "camera_1_000000.json",
            [MMPOSE_ROW | {"bbox": [[1, 2, float("nan"), 4]]}],
            "nan is no finite number",
        ),
        (
            "camera_1_000000.json",
            [MMPOSE_ROW | {"keypoints": [[1e12, 2.0]] * 17}],
            "is no coordinate in an image",
        ),
        (
            "camera_1.json",
            [{"frame_id": 0, "instances": []}, {"frame_id": 77, "instances": []}],
            "no frame 77",
        ),
        ("camera_1.json", [{"frame_id": 0.5, "instances": []}], "not as OpenPose"),
        ("camera_1.json", [{"frame_id": 0, "instances": []}, 7], "not as OpenPose"),
        ("video.json", [{"frame_id": 0, "instances": []}], "no camera of the truth (camera_1, camera_2)"),
        ("cut.json", '[{"image_id": "camera_1_0', "cut.json:1: not valid JSON"),
        (
            "labels/camera_1_000000.txt",
            YOLO + "0.5 " * 49,
            "labels/camera_1_000000.txt: is not as these write",
        ),
        ("labels/camera_1_000000.txt", YOLO + "0.5 " * 51 + "\n" + YOLO + "0.5 " * 20, ":2: 25 numbers"),
        ("labels/camera_1_000000.txt", YOLO + "0.5 " * 50 + "half", ":1: column 56: 'half' is not a number"),
        ("labels/camera_1_000000.txt", YOLO + "nan " * 51, ":1: score: nan is no finite number"),
        ("camera_1_000099.txt", YOLO, "the truth has no frame 99 of camera_1"),
        (
            "camera_1.txt",
            "1,1,10,20,30,40,1,-1,-1,-1\n50,1,10,20,30,40,1,-1,-1,-1",
            ":2: the truth has no frame 49",
        ),
        ("camera_1.txt", "1,1,10,20,-30,40,1,-1,-1,-1", ":1: bbox: x, y, width and height: one is negative"),
        ("camera_1.txt", "1,1,10,20,30,inf,1,-1,-1,-1", ":1: bbox: inf is no finite number"),
        ("camera_1.txt", "inf,1,10,20,30,40,1,-1,-1,-1", ":1: not as MOTChallenge writes it"),
        ("camera_1.txt", "1,1,10,20,30,40,1,-1,-1,-1\n2,1,10", ":2: "),
        ("seq.txt", "1,1,10,20,30,40,1,-1,-1,-1", ":1: no camera of the truth (camera_1, camera_2)"),
        ("track1.txt", "7 1 0 10 20 30 40 1.5 2.5", ":1: no camera of the truth"),
        ("camera_1DLC_a.csv", DLC + "0,1,2,high", ":4: nose: 'high' is not a number"),
        ("camera_1DLC_a.csv", DLC + "0,1,2", ":4: not as DeepLabCut writes it"),
        ("camera_1DLC_a.csv", DLC + "40,1,2,0.9", ":4: the truth has no frame 40 of camera_1"),
        ("camera_1DLC_a.csv", DLC.replace("likelihood", "z") + "0,1,2,0.9", "not as DeepLabCut writes it"),
        ("camera_1DLC_a.csv", "scorer,a,a\n", "not as DeepLabCut writes it"),
        ("video.csv", DLC + "0,1,2,0.9", ":4: no camera of the truth (camera_1, camera_2)"),
        ("camera_1DLC_a.csv", DLC.replace("nose", "tail") + "0,1,2,0.9", "no keypoint with an OKS constant"),
        ("000000.json", [{"id": 0, "keypoints3d": [[1, 2, 3]] * 17}], "groups of 4"),
        ("000000.json", [{"id": 0, "keypoints3d": [[1, 2, 3, 1]] * 16}], "16 keypoints without names"),
        ("000000.json", [{"id": 0, "keypoints3d": [["a", 2, 3, 1]] * 17}], "not a list of numbers"),
        ("000000.json", [{"id": 0, "keypoints3d": [[1e12, 2, 3, 1]] * 17}], "more than 1000 km away"),
        ("a.csv", "nose_x,nose_y,nose_z,fnum\n1,2,3,0\n1,2,x,1\n", ":3: nose_z: 'x' is not a number"),
        ("a.csv", "nose_x,nose_y,nose_z,fnum\n1,2,3,0\n1,2\n", ":3: 2 fields, but 4 column names"),
        ("a.csv", "nose_x,nose_y,nose_z,lap\n1,2,3,0\n", ":1: the first line must name the columns"),
        ("a.npy", b"\x93NUMPY\x01\x00v\x00{'descr'", "no poses of FreeMoCap: "),
        ("a.npy", b"no array", "no poses of FreeMoCap: "),
    ],
)
def test_damaged_estimates(name: str, content: Any, message: str, run: Run, tmp_path: Path) -> None:
    text = content if isinstance(content, (str, bytes)) else json.dumps(content)
    path = written(name, text)(tmp_path)
    code, _, text = run(path.parent if "/" in name else path)
    assert code == 2 and text.startswith("error: ") and message in text and text.count("\n") == 1, text
    assert Path(name).name in text


@pytest.mark.parametrize("array", [np.zeros((2, 33)), np.zeros((2, 20, 3)), np.full((2, 33, 3), None)])
def test_arrays_that_are_no_poses(array: Any, run: Run, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", array)
    code, _, text = run(tmp_path / "a.npy")
    assert code == 2 and "a.npy: " in text, text
    assert "needed are numbers" in text or "20 keypoints without names" in text or "pickled objects" in text
