"""COCO: pycocotools loads the files, and a perfect detection scores 1."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from export_support import exported, job, small_scene

from humansim_ros import Frame, Scene, Simulation
from humansim_ros.errors import ExportError
from humansim_ros.people import keypoint_set
from humansim_ros.scene import OUTSIDE

CHANNELS = ("depth", "instance", "part", "amodal")
COCO17 = keypoint_set("coco17")

pytest.importorskip("pycocotools")
from pycocotools.coco import COCO  # noqa: E402
from pycocotools.cocoeval import COCOeval  # noqa: E402


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return exported(tmp_path_factory.mktemp("coco") / "out", "coco", frames="2:6")


@pytest.fixture(scope="module")
def frame() -> Frame:
    with Simulation(small_scene(), CHANNELS) as simulation:
        return simulation.frame(4)


def annotations(root: Path, name: str, camera: str, index: int) -> dict[str, dict[str, Any]]:
    """Annotations of an image by the name of the body."""
    coco = COCO(root / f"coco/{name}.json")
    (image,) = [row for row in coco.dataset["images"] if (row["camera"], row["frame"]) == (camera, index)]
    return {row["name"]: row for row in coco.loadAnns(coco.getAnnIds(imgIds=[image["id"]]))}


def scores(root: Path, name: str, kind: str, shift: float = 0.0) -> np.ndarray:
    """AP and its variants of the truth as a detection. ``shift``: pixels by which keypoints are wrong."""
    truth = COCO(root / f"coco/{name}.json")
    keys = {"keypoints": ("keypoints",), "bbox": ("bbox",), "segm": ("segmentation",)}[kind]
    found = []
    for row in truth.dataset["annotations"]:
        detection = {key: row[key] for key in keys}
        if shift:
            detection["keypoints"] = [
                value + shift * (number % 3 == 0) for number, value in enumerate(row["keypoints"])
            ]
        found.append(
            {"image_id": row["image_id"], "category_id": row["category_id"], "score": 1.0} | detection
        )
    evaluation = COCOeval(truth, truth.loadRes(found), kind)
    evaluation.evaluate()
    evaluation.accumulate()
    evaluation.summarize()
    return np.asarray(evaluation.stats)


@pytest.mark.daily("instances-bbox")
@pytest.mark.parametrize(
    ("name", "kind"), [("person_keypoints", "keypoints"), ("instances", "bbox"), ("instances", "segm")]
)
def test_a_perfect_detection_scores_1(root: Path, name: str, kind: str) -> None:
    # AP, and AP at an OKS or IoU of 0.5 and 0.75
    assert scores(root, name, kind)[:3] == pytest.approx([1.0, 1.0, 1.0])


def test_a_wrong_detection_scores_less(root: Path) -> None:
    assert scores(root, "person_keypoints", "keypoints", shift=4.0)[0] < 0.9


@pytest.mark.parametrize("camera", ["noisy", "bent"])
def test_masks_boxes_and_areas_are_those_of_the_visible_pixels(root: Path, frame: Frame, camera: str) -> None:
    found = annotations(root, "instances", camera, 4)
    assert set(found) == {"anna", "bert", "crate"}
    coco = COCO(root / "coco/instances.json")
    for name, row in found.items():
        mask = frame.views[camera].instance == frame.labels[name]
        np.testing.assert_array_equal(coco.annToMask(row), mask)
        assert row["area"] == mask.sum()
        assert row["bbox"] == list(cv2.boundingRect(mask.astype(np.uint8)))
        assert row["iscrowd"] == 0


@pytest.mark.parametrize("camera", ["noisy", "bent"])
def test_keypoints_are_those_of_the_frame(root: Path, frame: Frame, camera: str) -> None:
    found = annotations(root, "person_keypoints", camera, 4)
    assert set(found) == {"anna", "bert"}
    for name, row in found.items():
        view = frame.keypoints["coco17"][camera][name]
        values = np.reshape(row["keypoints"], (-1, 3))
        np.testing.assert_array_equal(values[:, 2], view.visible)
        inside = view.visible != OUTSIDE
        np.testing.assert_allclose(values[inside, :2], view.pixels[inside], atol=0.0006)
        assert row["num_keypoints"] == inside.sum() and (values[~inside] == 0).all()


@pytest.mark.nightly
def test_points_outside_of_the_image_are_not_labelled(tmp_path: Path) -> None:
    import yaml
    from export_support import SCENE

    from humansim_ros import Scene

    config = yaml.safe_load(SCENE)
    config["cameras"]["bent"]["look_at"] = [0, 0, 2.2]  # the legs are below the image
    found = annotations(
        exported(tmp_path / "out", "coco", Scene.from_dict(config)), "person_keypoints", "bent", 4
    )
    ankles = np.reshape(found["bert"]["keypoints"], (-1, 3))[15:]
    assert ankles.tolist() == [[0, 0, 0], [0, 0, 0]]
    assert 0 < found["bert"]["num_keypoints"] < 16


def test_data_sets_carry_the_licences_of_their_people(root: Path) -> None:
    index = json.loads((root / "index.json").read_text())
    assert index["licenses"] == dict.fromkeys(index["humans"], "CC0-1.0")
    address = "https://creativecommons.org/publicdomain/zero/1.0/"
    for file in ("person_keypoints.json", "instances.json"):
        document = json.loads((root / "coco" / file).read_text())
        assert document["licenses"] == [{"id": 1, "name": "CC0-1.0", "url": address}]


@pytest.mark.nightly
def test_the_licence_of_the_user_comes_first_and_is_the_licence_of_each_image(tmp_path: Path) -> None:
    root = exported(tmp_path / "out", "coco,croissant", license="CC-BY-4.0")
    index = json.loads((root / "index.json").read_text())
    assert index["license"] == "CC-BY-4.0" and set(index["licenses"].values()) == {"CC0-1.0"}
    links = [
        "https://creativecommons.org/licenses/by/4.0/",
        "https://creativecommons.org/publicdomain/zero/1.0/",
    ]
    for file in ("person_keypoints.json", "instances.json"):
        document = json.loads((root / "coco" / file).read_text())
        assert [row["name"] for row in document["licenses"]] == ["CC-BY-4.0", "CC0-1.0"]
        assert [row["url"] for row in document["licenses"]] == links
        assert {image["license"] for image in document["images"]} == {document["licenses"][0]["id"]}
    assert json.loads((root / "croissant.json").read_text())["license"] == links
    with pytest.raises(ExportError, match=r"license: CC-BY-4\.0 there, MIT now"):
        job(root, "coco,croissant", license="MIT").run(resume=True)


@pytest.mark.parametrize("license", ["two\nlines", "\u202eMIT", "x" * 201])
def test_a_licence_that_is_no_line_is_refused(tmp_path: Path, license: str) -> None:
    with pytest.raises(ExportError, match="a licence is one line of at most 200 characters"):
        job(tmp_path / "out", "coco", license=license)


def test_the_address_of_a_licence_is_its_link(tmp_path: Path) -> None:
    settings = job(tmp_path / "out", "coco", license="https://example.org/terms").export.settings
    assert settings.license_links["https://example.org/terms"] == "https://example.org/terms"
    assert not (tmp_path / "out").exists()


def test_categories_have_the_keypoints_and_the_kinds_of_objects(root: Path) -> None:
    keypoints = json.loads((root / "coco/person_keypoints.json").read_text())
    (person,) = keypoints["categories"]
    assert (person["id"], person["name"]) == (1, "person")
    assert person["keypoints"][0] == "nose" and len(person["keypoints"]) == 17
    assert min(map(min, person["skeleton"])) >= 1 and max(map(max, person["skeleton"])) <= 17
    instances = json.loads((root / "coco/instances.json").read_text())
    assert [row["name"] for row in instances["categories"]] == ["person", "box"]


def test_images_are_found_from_the_folder_of_images(root: Path, frame: Frame) -> None:
    coco = json.loads((root / "coco/instances.json").read_text())
    assert len(coco["images"]) == 8
    for image in coco["images"]:
        pixels = cv2.imread(str(root / "images" / image["file_name"]))
        assert pixels.shape == (image["height"], image["width"], 3)
    row = next(row for row in coco["images"] if (row["camera"], row["frame"]) == ("bent", 4))
    assert row["stamp"] == frame.stamp
    np.testing.assert_array_equal(row["K"], frame.cameras["bent"].K)


def test_whole_bodies_have_the_fields_of_coco_wholebody(tmp_path: Path) -> None:
    """Feet, face and hands beside the body, as the frame has them; the reader of pycocotools loads them."""
    root = exported(tmp_path / "out", "coco", frames="4:5", keypoints="wholebody133")
    with Simulation(small_scene(), CHANNELS) as simulation:
        frame = simulation.frame(4)
    view = frame.keypoints["wholebody133"]["bent"]["bert"]
    row = annotations(root, "person_keypoints", "bent", 4)["bert"]
    fields = ("keypoints", "foot_kpts", "face_kpts", "lefthand_kpts", "righthand_kpts")
    assert [len(row[key]) for key in fields] == [51, 18, 204, 63, 63]
    joined = np.reshape([value for key in fields for value in row[key]], (-1, 3))
    inside = view.visible != OUTSIDE
    np.testing.assert_allclose(joined[inside, :2], view.pixels[inside], atol=5e-4)
    np.testing.assert_array_equal(joined[:, 2], view.visible)
    assert row["num_keypoints"] == int(inside[:17].sum())
    for part, first, last in (("face", 23, 91), ("lefthand", 91, 112), ("righthand", 112, 133)):
        own = view.pixels[first:last][inside[first:last]]
        assert row[f"{part}_valid"] == bool(len(own))
        low = own.min(axis=0)
        np.testing.assert_allclose(row[f"{part}_box"], [*low, *(own.max(axis=0) - low)], atol=2e-3)
    assert row["foot_valid"]
    category = COCO(root / "coco/person_keypoints.json").loadCats([1])[0]
    assert category["keypoints"] == list(COCO17.names)
    assert np.max(category["skeleton"]) == 17
    assert scores(root, "person_keypoints", "keypoints")[0] == pytest.approx(1)


def test_a_part_outside_the_image_is_not_valid_and_has_no_box(tmp_path: Path) -> None:
    scene = small_scene().config.model_dump(exclude_unset=True)
    camera = {"size": [80, 64], "position": [0, 2.2, 0.3], "look_at": [0, 0, 0.2], "fov_deg": 30}
    scene = Scene.from_dict(scene | {"humans": {"bert": {"body": "adult_man"}}, "cameras": {"low": camera}})
    root = exported(tmp_path / "out", "coco", scene, frames="0:1", keypoints="wholebody133")
    row = annotations(root, "person_keypoints", "low", 0)["bert"]
    assert row["foot_valid"] and not row["face_valid"] and not row["lefthand_valid"]
    assert row["face_box"] == row["lefthand_box"] == [0, 0, 0, 0]
    assert not np.any(row["face_kpts"])
