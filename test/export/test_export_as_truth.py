"""Exports and scenes as truth of ``humansim evaluate``: images and 3D poses, and input that is refused."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from export_support import SCENE, exported, small_scene

from humansim_ros.cli import main as cli

pytest.importorskip("pycocotools")
pytest.importorskip("c3d")

Run = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene, its export of frames 2 and 3, and results with all keypoints 2 pixels beside."""
    folder = tmp_path_factory.mktemp("truth")
    (folder / "scene.yaml").write_text(SCENE)
    exported(folder / "set", "coco,openpose,labels,trc,panoptic", small_scene(), frames="2:4")
    rows = []
    for row in json.loads((folder / "set/coco/instances.json").read_text())["annotations"]:
        result = {key: row[key] for key in ("image_id", "category_id", "bbox", "segmentation")}
        if "keypoints" in row:
            points = np.reshape(row["keypoints"], (-1, 3)) + np.array([2, 0, 0])
            result["keypoints"] = points.ravel().tolist()
        rows.append(result | {"score": 0.8})
    (folder / "results.json").write_text(json.dumps(rows))
    return folder


@pytest.fixture
def run(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Run:
    """Run ``humansim evaluate`` in the folder: exit code, JSON, and what it prints."""

    def evaluate(truth: str, *words: str) -> tuple[int, dict[str, Any], str]:
        output = tmp_path / "result.json"
        output.unlink(missing_ok=True)
        monkeypatch.chdir(root)
        given = ["--truth", truth, "--estimate", *words, "--output", str(output)]
        monkeypatch.setattr("sys.argv", ["humansim", "evaluate", *given])
        code = cli.main()
        text = capsys.readouterr()
        return code, json.loads(output.read_text()) if output.exists() else {}, text.out + text.err

    return evaluate


@pytest.mark.nightly
def test_results_of_an_export(run: Run, tmp_path: Path) -> None:
    page = tmp_path / "report.html"
    code, result, text = run("set", "results.json", "--report", str(page))
    assert code == 0, text
    assert result["version"] == 1 and result["images"] == 4 and "matches" not in result
    assert result["masks"]["all"]["precision"]["ap"] == pytest.approx(1)
    assert result["boxes"]["all"]["similarity"] == pytest.approx(1)
    assert set(result["boxes"]["by_name"]) == {"anna", "bert", "crate"}
    assert set(result["keypoints"]["by_camera"]) == {"noisy", "bent"}
    assert result["keypoints"]["by_keypoint"]["left_knee"]["bias"] == pytest.approx([2, 0])
    for word in ("keypoints", "AP at OKS 0.50", "mean IoU", "crate", "left_knee", "2.00, 0.00"):
        assert word in text
    content = page.read_text()
    kinds = [result[kind] for kind in ("keypoints", "boxes", "masks")]
    assert content.count("<img ") == sum(len(kind["worst"]) for kind in kinds) > 20
    assert not re.findall(r'(?:src|href)="(?!data:image/jpeg;base64,)|url\(|@import|<script', content)
    assert len(content) < 3 << 20


@pytest.mark.nightly
def test_a_rendered_scene_is_the_same_truth(run: Run, root: Path) -> None:
    """An export from frame 0 on has the numbers of images that a scene has."""
    exported(root / "from_0", "coco", small_scene(), frames="0:3")
    rows = json.loads((root / "results.json").read_text())
    numbers = {1: 5, 2: 6}  # of frame 2, the first one of the other export
    moved = [row | {"image_id": numbers[row["image_id"]]} for row in rows if row["image_id"] in numbers]
    (root / "moved.json").write_text(json.dumps(moved))
    code, rendered, text = run("scene.yaml", "moved.json")
    assert code == 0, text
    assert rendered["images"] == 2
    assert rendered["keypoints"]["by_keypoint"]["left_knee"]["bias"] == pytest.approx([2, 0])
    assert rendered["masks"]["all"]["precision"]["ap"] == pytest.approx(1)
    code, whole, text = run("from_0", "moved.json")
    assert code == 0, text
    for kind in ("keypoints", "boxes", "masks"):
        assert whole[kind]["by_keypoint"] == rendered[kind]["by_keypoint"]
        assert whole[kind]["all"]["found"] == rendered[kind]["all"]["found"]
    assert whole["images"] == 6


@pytest.mark.parametrize("estimate", ["set/openpose", "set/openpose/pose"])
def test_openpose_of_each_camera(run: Run, estimate: str) -> None:
    code, result, text = run("set", estimate)
    assert code == 0, text
    assert result["images"] == 4 and result["masks"] is None
    assert result["keypoints"]["all"]["precision"]["ap"] == pytest.approx(1)
    assert result["keypoints"]["all"]["error"]["mean"] < 0.001


def test_openpose_of_one_camera_is_compared_with_that_camera(run: Run) -> None:
    code, result, text = run("set", "set/openpose/pose/bent_json")
    assert code == 0, text
    assert result["images"] == 2 and set(result["keypoints"]["by_camera"]) == {"bent"}


def test_label_images(run: Run) -> None:
    code, result, text = run("set", "set/labels")
    assert code == 0, text
    assert result["images"] == 4 and result["keypoints"] is None
    assert result["masks"]["all"]["precision"]["ap"] == pytest.approx(1)
    assert result["masks"]["all"]["similarity"] == pytest.approx(1)


def test_keypoints_and_masks_may_be_two_files(run: Run) -> None:
    code, result, text = run("set", "set/openpose", "--estimate", "set/labels")
    assert code == 0, text
    assert result["keypoints"]["all"]["similarity"] == pytest.approx(1)
    assert result["masks"]["all"]["similarity"] == pytest.approx(1)


@pytest.mark.parametrize(("estimate", "people"), [("set/trc", 2), ("set/trc/anna.trc", 1)])
def test_poses_of_an_export(run: Run, tmp_path: Path, estimate: str, people: int) -> None:
    page = tmp_path / "report.html"
    code, result, text = run("set", estimate, "--report", str(page))
    assert code == 0, text
    assert page.read_text().count("<img ") == 2 * people
    assert result["frames"]["compared"] == 2 and result["people"]["found"] == 2 * people
    assert result["position"]["worst"] == 0 and len(result["by_joint"]) == 17


def test_an_export_is_the_truth_of_its_scene(run: Run) -> None:
    """Poses of the files of an export, and those that are computed from the scene, are the same."""
    code, result, text = run("scene.yaml", "set/trc")
    assert code == 0, text
    assert result["position"]["worst"] < 1e-6
    code, result, text = run("set", "set/panoptic", "--keypoints", "panoptic19")
    assert code == 0, text
    assert result["position"]["worst"] == 0 and len(result["by_joint"]) == 19


def test_wrong_exports(run: Run, root: Path) -> None:
    def broken(name: str, change: Callable[[Path], object]) -> str:
        shutil.copytree(root / "set", root / name)
        change(root / name)
        return name

    def without(*formats: str) -> Callable[[Path], object]:
        def change(folder: Path) -> None:
            index = json.loads((folder / "index.json").read_text())
            index["plan"]["formats"] = [name for name in index["plan"]["formats"] if name not in formats]
            index["files"] = {
                name: entry for name, entry in index["files"].items() if name.split("/")[0] not in formats
            }
            (folder / "index.json").write_text(json.dumps(index))

        return change

    def unfinished(folder: Path) -> None:
        text = (folder / "index.json").read_text()
        (folder / "index.json").write_text(text.replace('"finished": true', '"finished": false'))

    def damaged(folder: Path) -> None:
        index = json.loads((folder / "index.json").read_text())
        (folder / "index.json").write_text(json.dumps(index | {"rate": 0}))

    def changed(file: str) -> Callable[[Path], object]:
        return lambda folder: (folder / file).write_text((folder / file).read_text() + " ")

    for truth, estimate, message in [
        (broken("open", unfinished), "set/trc", "not finished: continue it with humansim export --resume"),
        (broken("rate", damaged), "set/trc", "index.json: the index is damaged"),
        (
            broken("json", lambda f: (f / "index.json").write_text("{")),
            "set/trc",
            "index.json:1: not valid JSON",
        ),
        (broken("trc", changed("trc/anna.trc")), "set/trc", "this file has changed since it was exported"),
        (broken("coco", changed("coco/instances.json")), "results.json", "this file has changed"),
        (broken("gone", lambda f: (f / "coco/instances.json").unlink()), "results.json", "no such exported"),
        (broken("no3d", without("trc", "panoptic")), "set/trc", "has no 3D poses; export them"),
        (broken("no2d", without("coco")), "results.json", "export it with --format coco"),
    ]:
        code, _, text = run(truth, estimate)
        assert code == 2 and message in text, text


def test_another_set_than_that_of_the_export_is_compared_by_its_names(run: Run, root: Path) -> None:
    code, result, text = run("set", "set/trc", "--keypoints", "body25")
    assert code == 0 and len(result["by_joint"]) == 17 and result["position"]["worst"] == 0, text
    code, result, text = run("set", "results.json", "--keypoints", "body25")
    assert code == 0 and result["keypoint_set"] == "coco17", text


def test_results_with_mistakes(run: Run, root: Path) -> None:
    rows = json.loads((root / "results.json").read_text())
    first = next(row for row in rows if "keypoints" in row)
    mask = first["segmentation"]
    for content, message in [
        ([4], "[0]: a detection must be a mapping"),
        ([first | {"image_id": 77}], "[0].image_id: the truth has no image 77"),
        (
            [first | {"image_id": "x"}],
            "[0].image_id: no camera of the truth (noisy, bent) is in the name 'x'",
        ),
        ([first | {"image_id": None}], "[0].image_id: a whole number is needed"),
        ([first | {"category_id": 9}], "category_id 9 is not in the truth, which has 1 person, 2 box"),
        ([first, first | {"score": float("nan")}], "[1].score: nan is no finite number"),
        ([first | {"keypoints": first["keypoints"][:-3]}], "48 numbers, but 51 are needed"),
        ([first | {"keypoints": [float("inf")] * 51}], "inf is no finite number"),
        ([first | {"bbox": [1, 2, -3, 4]}], "[0].bbox: x, y, width and height: one is negative"),
        ([first | {"bbox": [1, 2]}], "2 numbers, but 4 are needed"),
        ([first | {"segmentation": mask | {"size": [9, 9]}}], "the size is [9, 9], but the image has"),
        ([first | {"segmentation": mask | {"counts": mask["counts"][:-1]}}], "do not fill the image"),
        ([first | {"segmentation": mask | {"counts": "\u00e9\u00e9"}}], "do not fill the image"),
        ([first | {"segmentation": mask | {"counts": [1, 2]}}], "do not fill the image"),
        ([first | {"segmentation": [[1, 2, 3, 4]]}], "a polygon needs x and y of three points"),
        ([{key: first[key] for key in ("image_id", "category_id", "score")}], "none of keypoints, bbox"),
        ([first | {"bbox": [0, 0, 1e10, 1]}], "10000000000.0 is no coordinate in an image"),
        ([first | {"bbox": [10**400, 0, 1, 1]}], "not valid JSON: the number 1000000000… (401 characters)"),
        ([first | {"score": 10**4000}], "is too large"),
        ([first | {"image_id": 10**30}], "[0].image_id: a whole number is needed"),
        ([first | {"segmentation": [[1e10, 0, 1, 1, 2, 5]]}], "[0].segmentation[0]: "),
        ([first | {"segmentation": [[0, 0, 9e5, 9e5, 0, 9]]}], "longer than 1000000 pixels"),
        ([first | {"segmentation": mask | {"counts": [0.5] * 2}}], "do not fill the image"),
        ("[" + "9" * 5000 + "]", "not valid JSON"),
        ("[1, 2", "not valid JSON"),
    ]:
        (root / "wrong.json").write_text(content if isinstance(content, str) else json.dumps(content))
        code, _, text = run("set", "wrong.json")
        assert code == 2 and message in text, text
        assert "wrong.json" in text


def test_rows_of_a_file_may_have_different_keys(run: Run, root: Path) -> None:
    rows = json.loads((root / "results.json").read_text())
    rows = [row for row in rows if "keypoints" in row and "bbox" in row]
    with_box, without = rows[0], {key: value for key, value in rows[1].items() if key != "bbox"}
    (root / "mixed.json").write_text(json.dumps([with_box, without]))
    code, result, text = run("set", "mixed.json")
    assert code == 0, text
    found = {
        kind: result[kind]["all"]["found"] + result[kind]["all"]["false"]
        for kind in ("keypoints", "boxes", "masks")
    }
    assert found == {"keypoints": 2, "boxes": 1, "masks": 2}


def test_masks_as_polygons_and_as_run_lengths(run: Run, root: Path) -> None:
    height, width = 72, 96
    polygon = [[10.0, 2.0, 86.0, 2.0, 86.0, 70.0, 10.0, 70.0]]
    counts = [height * 10 + 2]
    for _ in range(76):
        counts += [68, height - 68]
    counts[-1] += height * width - sum(counts)
    image = {"image_id": 1, "category_id": 1, "score": 1.0}
    lengths = {"size": [height, width], "counts": counts}
    results = []
    for segmentation in (polygon, lengths):
        (root / "mask.json").write_text(json.dumps([image | {"segmentation": segmentation}]))
        code, result, text = run("set", "mask.json")
        assert code == 0, text
        results.append(result["masks"]["by_name"])
    assert results[0] == results[1] and max(each["similarity"] for each in results[0].values()) > 0.01


def test_openpose_and_labels_with_mistakes(run: Run, root: Path, tmp_path: Path) -> None:
    person = {"pose_keypoints_2d": [1.0] * 51, "pose_keypoints_3d": []}
    for folder, name, content, message in [
        ("noisy_json", "noisy_000000000009_keypoints.json", {"people": [person]}, "no frame 9 of noisy"),
        ("noisy_json", "noisy_keypoints.json", {"people": [person]}, "needs the number of its frame"),
        ("other_json", "other_2_keypoints.json", {"people": [person]}, "file of a camera: a folder for each"),
        ("noisy_json", "n_2_keypoints.json", {"people": [{"pose_keypoints_2d": [1.0] * 60}]}, "60 numbers"),
        ("noisy_json", "n_2_keypoints.json", {"people": [{"pose_keypoints_2d": "?"}]}, "people[0]: not as"),
        (
            "noisy_json",
            "n_2_keypoints.json",
            {"people": [{"pose_keypoints_2d": [float("nan")] * 51}]},
            "people[0].score: nan is no finite number",
        ),
    ]:
        path = tmp_path / "estimate" / folder / name
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(content))
        code, _, text = run("set", str(tmp_path / "estimate"))
        assert code == 2 and message in text, text
        shutil.rmtree(tmp_path / "estimate")
    image = np.zeros((72, 96), np.uint8)
    for pixels, message in [
        (image[:50], "its size is 96x50, but the image has 96x72"),
        (np.zeros((72, 96, 3), np.uint8), "it has colours; a label image has one channel"),
        (None, "this is no PNG image"),
    ]:
        path = tmp_path / "labels" / "noisy" / "000002.png"
        path.parent.mkdir(parents=True)
        path.write_bytes(b"text" if pixels is None else cv2.imencode(".png", pixels)[1].tobytes())
        code, _, text = run("set", str(tmp_path / "labels"))
        assert code == 2 and message in text, text
        shutil.rmtree(tmp_path / "labels")


def test_options_and_truths_that_do_not_fit(run: Run, root: Path) -> None:
    rows = json.loads((root / "results.json").read_text())
    (root / "far.json").write_text(json.dumps([rows[0], rows[0] | {"image_id": 10**9 + 1}]))
    for words, message in [
        (("set", "results.json", "--scale", "2"), "--scale: is for 3D poses"),
        (("set", "results.json", "--gate", "2"), "--gate: is for 3D poses"),
        (("set", "set/trc", "--min-score", "0.5"), "--min-score: is for detections in images"),
        (("set", "results.json", "--estimate", "set/trc"), "these are no detections in images"),
        (("scene.yaml", "far.json"), "more than 108000: do the numbers of the images come from an export"),
        (("set/coco", "results.json"), "--truth: neither a scene file nor a bag"),
    ]:
        code, _, text = run(*words)
        assert code == 2 and message in text, text
