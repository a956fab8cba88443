"""Shards of WebDataset: webdataset reads all samples; the shards depend on the frames only."""

from __future__ import annotations

import hashlib
import json
import tarfile
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from export_support import exported, index_of, small_scene

from humansim_ros import Scene, Simulation
from humansim_ros.data.formats.webdataset import shards

FRAMES = "3:6"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return small_scene()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, scene: Scene) -> Path:
    return exported(tmp_path_factory.mktemp("whole") / "out", "webdataset", scene, frames=FRAMES)


def samples(root: Path) -> dict[str, dict[str, bytes]]:
    """Files of each sample by its key, as WebDataset divides names: the key ends at the first dot."""
    found: dict[str, dict[str, bytes]] = {}
    last = ""
    for path in sorted((root / "webdataset").iterdir()):
        with tarfile.open(path) as tar:
            for entry in tar:
                folder, _, name = entry.name.rpartition("/")
                key, _, kind = name.partition(".")
                key = f"{folder}/{key}"
                assert key == last or key not in found, "the files of a sample are apart"
                last = key
                file = tar.extractfile(entry)
                assert file is not None and kind not in found.get(key, {})
                found.setdefault(key, {})[kind] = file.read()
    return found


@pytest.mark.nightly
def test_a_sample_has_the_truth_of_its_image(whole: Path, scene: Scene) -> None:
    found = samples(whole)
    assert list(found) == [f"{camera}/00000{n}" for n in (3, 4, 5) for camera in ("noisy", "bent")]
    with Simulation(scene, ("rgb", "depth", "instance", "part", "amodal")) as simulation:
        frame = simulation.frame(4)
    for camera in ("noisy", "bent"):
        sample, view, truth = found[f"{camera}/000004"], frame.views[camera], frame.truth[camera]
        image = cv2.imdecode(np.frombuffer(sample["png"], np.uint8), cv2.IMREAD_COLOR)
        np.testing.assert_array_equal(image[..., ::-1], view.rgb)
        with np.load(BytesIO(sample["labels.npz"])) as labels:
            np.testing.assert_array_equal(labels["instance"], view.instance)
            np.testing.assert_array_equal(labels["part"], view.part)
        entry = json.loads(sample["camera.json"])
        assert (entry["camera"], entry["frame"], entry["stamp"]) == (camera, 4, frame.stamp)
        np.testing.assert_allclose(entry["K"], frame.cameras[camera].K)
        content = json.loads(sample["people.json"])
        assert content["keypoint_names"][0] == "nose"
        for person in content["people"]:
            keypoints = np.array(person["keypoints"]).reshape(-1, 3)
            view_of = frame.keypoints["coco17"][camera][person["name"]]
            np.testing.assert_array_equal(keypoints[:, 2], view_of.visible)
            seen = view_of.visible > 0
            np.testing.assert_allclose(keypoints[seen, :2], view_of.pixels[seen], atol=1e-3)
            left, top, width, height = person["bbox"]
            box = truth.boxes[person["name"]].visible
            np.testing.assert_allclose([left, top, left + width, top + height], box + 0.5)
        assert [each["name"] for each in json.loads(sample["objects.json"])] == ["crate"]


def test_webdataset_reads_all_samples(whole: Path, scene: Scene) -> None:
    """With its own decoders, which choose by the end of a name."""
    wds = pytest.importorskip("webdataset")
    paths = [str(path) for path in sorted((whole / "webdataset").iterdir())]
    read = list(wds.WebDataset(paths, shardshuffle=False).decode("rgb8"))
    found = samples(whole)
    assert [sample["__key__"] for sample in read] == list(found)
    for sample in read:
        expected = found[sample["__key__"]]
        assert set(expected) == {key for key in sample if not key.startswith("__")}
        assert sample["people.json"] == json.loads(expected["people.json"])
        assert sample["png"].shape[2] == 3 and sample["labels.npz"]["instance"].dtype == np.uint16


@pytest.mark.nightly
def test_shards_depend_on_the_frames_only(whole: Path, scene: Scene, tmp_path: Path) -> None:
    """Small shards have one frame each; joined they are the large one. No temporary file is left."""
    small = exported(tmp_path / "out", "webdataset", scene, frames=FRAMES, shard_size=1)
    names = [f"webdataset/shard-00000{number}.tar" for number in range(3)]
    assert [name for name in index_of(small)["files"] if name.startswith("webdataset")] == names
    end = bytes(1024)
    joined = b"".join((small / name).read_bytes().removesuffix(end) for name in names) + end
    assert joined == (whole / "webdataset/shard-000000.tar").read_bytes()
    for root in (small, whole):
        files = {str(p.relative_to(root)) for p in root.rglob("*") if p.is_file()} - {"index.json"}
        assert files == set(index_of(root)["files"])
        for name, entry in index_of(root)["files"].items():
            assert hashlib.sha256((root / name).read_bytes()).hexdigest() == entry["sha256"]


def test_a_shard_is_not_larger_than_its_limit() -> None:
    sizes: list[tuple[int, Any]] = [(4, 1000), (5, 1000), (6, 5000), (7, 500), (8, 500)]
    assert list(shards(sizes, 3024)) == [
        ["000004.tar", "000005.tar"],
        ["000006.tar"],
        ["000007.tar", "000008.tar"],
    ]
    assert list(shards([], 3024)) == []
