"""Data sets of many scenes: one index, hashes and pages, the same files however they are written."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from commands import largest_file
from conftest import ROOT
from test_recipe import written

import humansim_ros
from humansim_ros import Scene, Simulation
from humansim_ros.cli.__main__ import main
from humansim_ros.data.datasets.data_set import DataSet, SceneWorker
from humansim_ros.data.datasets.recipe import Recipe
from humansim_ros.data.engine import PartialError, WorkProgress, Written, run
from humansim_ros.data.formats.exporting import Export
from humansim_ros.data.formats.formats import chosen_formats
from humansim_ros.data.formats.plan import ExportPlan, read_index
from humansim_ros.data.formats.source import SimulatedSource
from humansim_ros.data.formats.statistics import HISTOGRAMS, Totals
from humansim_ros.data.formats.writer import LICENSES
from humansim_ros.errors import ExportError

CHANGES: dict[str, Any] = {
    "scenes": 3,
    "splits": {"train": 2, "test": 1},
    "formats": ["trc"],
    "scene.variety.count": 1,
    "about": {
        "title": "Tiny <set>",
        "license": "CC-BY-4.0",
        "creators": ["Ann Other"],
        "date": "2026-11-28",
        "url": "https://example.org",
    },
}


def content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def data_set(folder: Path, root: Path, **changes: Any) -> DataSet:
    return DataSet.of(Recipe.load(written(folder, CHANGES | changes)), root)


def write_data_set(made: DataSet, **options: Any) -> WorkProgress:
    return run(made, made.root, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    write_data_set(data_set(folder, folder / "out"))
    return folder / "out"


def test_the_index_has_all_scenes_people_and_splits(whole: Path) -> None:
    index = json.loads((whole / "index.json").read_text())
    assert index["finished"] and not index["failed"]
    assert list(index["scenes"]) == ["train/scene_000000", "test/scene_000001", "train/scene_000002"]
    people: dict[str, set[str]] = {"train": set(), "test": set()}
    for name, scene in index["scenes"].items():
        assert name.startswith(f"{scene['split']}/")
        people[scene["split"]] |= set(scene["people"].values())
        assert hashlib.sha256((whole / name / "index.json").read_bytes()).hexdigest() == scene["index"]
        assert len(list((whole / name / "images").rglob("*.png"))) == scene["images"] == 4
    assert all(people.values()) and not people["train"] & people["test"]
    assert index["splits"]["train"] == {"scenes": 2, "images": 8, "people": len(people["train"])}


def test_hashes_are_those_of_all_files(whole: Path) -> None:
    done = subprocess.run(["sha256sum", "-c", "--strict", "SHA256SUMS"], cwd=whole, capture_output=True)
    assert done.returncode == 0, done.stderr
    listed = {line.split("  ", 1)[1] for line in (whole / "SHA256SUMS").read_text().splitlines()}
    assert listed == content(whole).keys() - {"SHA256SUMS"}


def test_a_scene_is_a_scene_file_that_gives_the_same_images(whole: Path, tmp_path: Path) -> None:
    folder = whole / "test/scene_000001"
    scene = Scene.load(folder / "scene.yaml")
    source = SimulatedSource(scene, tuple(chosen_formats(["images"])))
    run(Export(source, ExportPlan.of(source, range(2))), tmp_path / "again")
    again = content(tmp_path / "again" / "images")
    assert again == content(folder / "images") and len(again) == 4


def test_metadata_has_a_line_for_each_image(whole: Path) -> None:
    folder = whole / "train/scene_000000"
    lines = [json.loads(line) for line in (folder / "metadata.jsonl").read_text().splitlines()]
    assert {line["file_name"] for line in lines} == {
        str(path.relative_to(folder)) for path in (folder / "images").rglob("*.png")
    }
    scene = Scene.load(folder / "scene.yaml")
    simulation = Simulation(scene, ["instance"])
    (name,) = scene.actors
    for line in lines:
        view = simulation.frame(line["frame"]).views[line["camera"]]
        rows, columns = np.nonzero(view.instance == scene.labels[name])
        assert line["objects"]["name"] == ([name] if len(rows) else [])
        for left, top, width, height in line["objects"]["bbox"]:
            assert (left, top) == (columns.min(), rows.min())
            assert (left + width, top + height) == (columns.max() + 1, rows.max() + 1)
    simulation.close()


def test_the_page_of_hugging_face_names_the_files_of_each_split(whole: Path) -> None:
    text = (whole / "README.md").read_text()
    header = yaml.safe_load(text.split("---\n")[1])
    assert header["license"] == "cc-by-4.0" and header["size_categories"] == ["n<1K"]
    files = {row["split"]: row["path"] for row in header["configs"][0]["data_files"]}
    found = {name: sum(len(list(whole.glob(path))) for path in paths) for name, paths in files.items()}
    assert found == {"train": 8 + 2, "test": 4 + 1}


@pytest.mark.parametrize(
    ("given", "stated", "header"),
    [
        ({}, "MIT", {"license": "mit"}),
        ({"license": "CC0-1.0"}, "MIT", {"license": "cc0-1.0"}),
        ({}, {"choice": ["MIT", "CC0-1.0"]}, {"license": ["cc0-1.0", "mit"]}),
        ({}, "of my own", {"license": "other", "license_name": "of my own"}),
    ],
)
def test_pages_and_card_have_the_licence_of_the_recipe_or_of_its_scenes(
    given: dict[str, str], stated: Any, header: dict[str, Any], tmp_path: Path
) -> None:
    changes = {"scene.license": stated, "about": given, "scenes": 5, "frames": 1, "splits": {"train": 1}}
    root = tmp_path / "out"
    write_data_set(data_set(tmp_path, root, **changes, formats=[], **{"ring.count": 1}))
    text = (root / "README.md").read_text()
    front = yaml.safe_load(text.split("---\n")[1])
    assert {key: front[key] for key in front if key.startswith("license")} == header
    card = json.loads((root / "croissant.json").read_text())["license"]
    scenes = {json.loads(path.read_text())["license"] for path in root.glob("*/*/index.json")}
    assert card[: len(scenes)] == [LICENSES.get(name, name) for name in sorted(scenes)]
    for name in scenes:
        assert name in text and name in (root / "datasheet.html").read_text()


def test_the_card_describes_splits_creators_and_date(whole: Path) -> None:
    card = json.loads((whole / "croissant.json").read_text())
    assert card["creator"] == [{"@type": "sc:Person", "name": "Ann Other"}]
    assert card["datePublished"] == "2026-11-28" and card["version"] == "1.0.0"
    assert card["license"][0] == "https://creativecommons.org/licenses/by/4.0/"
    assert card["citeAs"] == "Ann Other: Tiny <set>, 1.0.0"
    sets = {row["@id"]: len(list(whole.glob(row["includes"]))) for row in card["distribution"]}
    assert sets == {"images-files": 12, "metadata-files": 3}
    records = {row["@id"]: row for row in card["recordSet"]}
    assert [row["splits/name"] for row in records["splits"]["data"]] == ["train", "test"]
    identifiers = [row["@id"] for row in [*card["distribution"], *card["recordSet"]]]
    assert len(identifiers) == len(set(identifiers))


def test_the_datasheet_is_one_page_with_escaped_texts(whole: Path) -> None:
    text = (whole / "datasheet.html").read_text()
    tags = Counter[str]()

    class Parser(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            tags[tag] += 1
            values = dict(attrs)
            assert (values.get("src") or "data:").startswith("data:") and "href" not in values

    Parser().feed(text)
    assert "Tiny &lt;set&gt;" in text and "<set>" not in text
    assert tags["img"] == 8 and tags["svg"] >= 15 and tags["h2"] >= 9 and not tags["script"]


def test_statistics_are_those_of_the_scenes(whole: Path) -> None:
    totals = Totals()
    found: dict[str, list[float]] = {"distance": [], "elevation": [], "brightness": [], "knee.flexion": []}
    visible = 0
    for folder in sorted(whole.glob("*/scene_*")):
        totals.add(json.loads((folder / "statistics.json").read_text()))
        scene = Scene.load(folder / "scene.yaml")
        with_boxes = Simulation(scene, ["rgb", "instance", "amodal"])
        for frame in with_boxes.frames(2):
            for state in frame.humans.values():
                joints = dict(zip(state.joint_names, state.positions, strict=True))
                for side in "lr":
                    hip, knee, ankle = (joints[f"{side}_{name}"] for name in ("hip", "knee", "ankle"))
                    thigh, shank = knee - hip, ankle - knee
                    cosine = thigh @ shank / np.linalg.norm(thigh) / np.linalg.norm(shank)
                    found["knee.flexion"].append(float(np.degrees(np.arccos(cosine))))
            for name, view in frame.views.items():
                path = folder / "images" / name / f"{frame.index:06d}.png"
                found["brightness"].append(float(np.asarray(cv2.imread(str(path))).mean()) / 255)
                for person, state in frame.humans.items():
                    if not (view.instance == scene.labels[person]).any():
                        continue
                    visible += 1
                    joints = dict(zip(state.joint_names, state.positions, strict=True))
                    line = frame.cameras[name].center - (joints["l_hip"] + joints["r_hip"]) / 2
                    found["distance"].append(float(np.linalg.norm(line)))
                    across = float(np.hypot(*line[:2]))
                    found["elevation"].append(float(np.degrees(np.arctan2(line[2], across))))
        with_boxes.close()
    assert totals.scenes == 3 and totals.images == 12 and totals.appearances == 3
    assert sum(totals.histograms["visible"].values()) == visible > 0
    for name in ("distance", "elevation", "brightness"):
        row = HISTOGRAMS[name]
        bins = Counter(int((value - row.low) // row.width) for value in found[name])
        assert totals.histograms[name] == bins
    # flexion is about one axis, the angle of the links about any
    flexion = [totals.quantile("knee.flexion", share) for share in (0.1, 0.5, 0.9)]
    assert flexion == pytest.approx(np.quantile(found["knee.flexion"], (0.1, 0.5, 0.9)), abs=10)


def test_more_scenes_are_added_and_others_stay(whole: Path, tmp_path: Path) -> None:
    root = tmp_path / "out"
    shutil.copytree(whole, root)
    before = content(root)
    state = write_data_set(data_set(tmp_path, root, scenes=4), resume=True)
    assert (state.first, state.done) == (3, 4)
    after = content(root)
    scenes = [name for name in before if "/" in name]
    assert len(scenes) == 30 and all(after[name] == before[name] for name in scenes)
    assert len(json.loads(after["index.json"])["scenes"]) == 4
    # fewer would leave scenes that the pages name, but the index does not
    with pytest.raises(ExportError, match="this folder has scene_000003, and 2 scenes are fewer"):
        write_data_set(data_set(tmp_path, root, scenes=2), resume=True)
    assert content(root) == after


def test_an_interrupted_data_set_continues_with_the_same_files(whole: Path, tmp_path: Path) -> None:
    root = tmp_path / "out"
    shutil.copytree(whole, root)
    # as if it had been killed in the second scene
    for name in ("SHA256SUMS", "README.md", "datasheet.html", "croissant.json"):
        (root / name).unlink()
    shutil.rmtree(root / "train/scene_000002")
    partial = root / "test/scene_000001"
    index = json.loads((partial / "index.json").read_text())
    kept = {"humansim_export": index["humansim_export"], "finished": False, "plan": index["plan"]}
    (partial / "index.json").write_text(json.dumps(kept))
    (partial / "scene.yaml").unlink()
    write_data_set(data_set(tmp_path, root), resume=True)
    assert content(root) == content(whole)


def test_a_full_disk_loses_nothing(whole: Path, tmp_path: Path) -> None:
    made = data_set(tmp_path, tmp_path / "out")
    for size in (100, 1500, 20_000):  # the plan, images, and pages
        with largest_file(size), pytest.raises(PartialError, match="File too large; finished shards stay"):
            write_data_set(made, resume=True)
        assert not (made.root / "index.json").exists()
        # parts of scenes would be read with the others
        folders = list(made.root.glob("*/scene_*"))
        assert all(json.loads((folder / "index.json").read_text())["finished"] for folder in folders)
    assert len(folders) == 3
    write_data_set(made, resume=True)
    assert content(made.root) == content(whole)


def test_the_function_writes_the_same_files_as_the_class(whole: Path, tmp_path: Path) -> None:
    path, done = written(tmp_path, CHANGES | {"scenes": 9}), []
    root = humansim_ros.export(
        path, tmp_path / "out", scenes=3, jobs=1, on_progress=lambda *counts: done.append(counts)
    )
    assert content(root) == content(whole) and done == [(1, 3), (2, 3), (3, 3), (3, 3)]
    for options, text in (
        ({"formats": ["coco"]}, "--format: the recipe has it: set its key formats"),
        ({"frames": 3}, "--frames: the recipe has it"),
        ({"shard_size": 5}, "--shard-size: a recipe has no such key"),
    ):
        with pytest.raises(ExportError, match=text):
            humansim_ros.export(path, tmp_path / "other", **options)
    with pytest.raises(ExportError, match="--scenes: is for recipes"):
        humansim_ros.export(None, tmp_path / "other", scenes=2)
    assert not (tmp_path / "other").exists()


def test_a_scene_that_fails_does_not_lose_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: Path
) -> None:
    root = tmp_path / "out"
    shutil.copytree(whole, root)
    shutil.rmtree(root / "train/scene_000002")
    work = SceneWorker.write

    def fail(self: SceneWorker, *words: Any) -> Written:
        work(self, *words)
        return Written(failure="recipe.yaml:3: it cannot be drawn")

    monkeypatch.setattr(SceneWorker, "write", fail)
    with pytest.raises(ExportError, match=r"1 of 3 scenes could not be written \(2\); the others are whole"):
        write_data_set(data_set(tmp_path, root), resume=True)
    assert not (root / "train/scene_000002").exists()
    index = json.loads((root / "index.json").read_text())
    assert index["failed"] == {"scene_000002": "recipe.yaml:3: it cannot be drawn"}
    assert list(index["scenes"]) == ["train/scene_000000", "test/scene_000001"]
    assert "1 of 3 scenes could not be drawn" in (root / "README.md").read_text()


def test_a_format_that_a_scene_cannot_have_names_the_key_of_the_recipe(tmp_path: Path) -> None:
    lasers = data_set(tmp_path, tmp_path / "out", scenes=1, splits={"train": 1}, formats=["kitti"])
    with pytest.raises(ExportError, match=r"recipe.yaml:\d+: formats: scene 0: kitti needs a laser scanner"):
        write_data_set(lasers)


def test_a_recipe_that_no_scene_fulfils_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(self: Recipe, number: int) -> Any:
        raise ExportError(f"scene {number} cannot be drawn", path="recipe.yaml", line=3)

    monkeypatch.setattr(Recipe, "draw", fail)
    with pytest.raises(ExportError, match=r"scene 0 cannot be drawn\n4 of 4 scenes .* given up"):
        write_data_set(data_set(tmp_path, tmp_path / "out", scenes=100_000))


def test_folders_of_others_are_refused(whole: Path, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match="this path exists"):
        write_data_set(data_set(tmp_path, whole))
    with pytest.raises(ExportError, match=r"a data set of many scenes: .* such as train/scene_000000"):
        read_index(whole)
    for changes, text in (
        ({"seed": 6}, "the recipe has changed; seed: 5 there, 6 now"),
        ({"frames": 3}, "recipe"),
    ):
        with pytest.raises(ExportError, match=text):
            write_data_set(data_set(tmp_path, whole, **changes), resume=True)
    (tmp_path / "other").mkdir()
    (tmp_path / "other/precious").touch()
    with pytest.raises(ExportError, match="no data set that can be continued has begun here"):
        write_data_set(data_set(tmp_path, tmp_path / "other"), resume=True)


def humansim(*words: str | Path) -> subprocess.CompletedProcess[str]:
    program = "import sys; from humansim_ros.cli.__main__ import main; sys.exit(main())"
    return subprocess.run(
        [sys.executable, "-c", program, *map(str, words)], capture_output=True, text=True, timeout=300
    )


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--frames", "3"], "error: --frames: the recipe has it: set its key frames\n"),
        (["--license", "MIT"], "error: --license: the recipe has it: set its key about.license\n"),
        (["--shard-size", "5000"], "error: --shard-size: a recipe has no such key\n"),
        (["--shard-frames", "3", "--ray", "local"], "error: --shard-frames: is for a scene or bag; a worker"),
        (["--scenes", "0"], "--scenes"),
    ],
)
def test_options_that_a_recipe_has_are_refused(
    words: list[str],
    text: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path, root = written(tmp_path, CHANGES), tmp_path / "out"
    monkeypatch.setattr(sys, "argv", ["humansim", "export", str(path), "-o", str(root), *words])
    assert main() == 2
    assert text in capsys.readouterr().err and not root.exists()


@pytest.mark.nightly
@pytest.mark.parametrize("judge", ["datasets", "mlcroissant"])
def test_the_programs_of_their_fields_read_it_without_warnings(judge: str, whole: Path) -> None:
    pytest.importorskip(judge, reason=f"{judge} is not installed")
    tool = "tools/exports/with_huggingface.py" if judge == "datasets" else "tools/check_export.py"
    done = subprocess.run([sys.executable, ROOT / tool, whole], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    if judge == "datasets":
        assert lines[:2] == ["train: 8 images with 8 people", "test: 4 images with 4 people"]
    else:
        assert lines == ["splits: 2 records", "images: 12 records", "metadata: 12 records", "no warnings"]


@pytest.mark.nightly
def test_processes_and_clusters_write_the_same_files(whole: Path, tmp_path: Path) -> None:
    path = written(tmp_path, CHANGES)
    assert humansim("export", path, "-o", tmp_path / "two", "--jobs", "2").returncode == 0
    assert content(tmp_path / "two") == content(whole)
    pytest.importorskip("ray", reason="Ray is not installed")
    done = humansim("export", path, "-o", tmp_path / "ray", "--jobs", "2", "--ray", "local")
    assert done.returncode == 0, done.stderr
    assert content(tmp_path / "ray") == content(whole)


@pytest.mark.nightly
def test_the_recipe_of_the_package_works(tmp_path: Path) -> None:
    from humansim_ros.files.reading.assets import resource_path

    done = humansim(
        *("export", resource_path("config/recipes/people.yaml"), "-o", tmp_path / "out", "--scenes", "2")
    )
    assert done.returncode == 0, done.stderr
    assert len(json.loads((tmp_path / "out/index.json").read_text())["scenes"]) == 2
