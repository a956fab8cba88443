"""Export of the scenes of a recipe as one data set, with any number of processes or on a cluster.

Each scene is a separate export, in a folder below the folder of its split (such as ``train``). After the last
scene, the files about the whole data set are written: index, hashes, data card, datasheet and the page of
Hugging Face.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from humansim_ros import __version__
from humansim_ros.data.datasets.datasheet import DataSetSummary, datasheet, example_paths, readme
from humansim_ros.data.datasets.recipe import DrawnScene, Recipe
from humansim_ros.data.engine.frame_job import Costs, FrameProgress, FrameResult, FrameWorker
from humansim_ros.data.engine.ray_cluster import PART_FRAMES, ClusterPart, PartResult, connected, run_parts
from humansim_ros.data.engine.workers import run_frames
from humansim_ros.data.formats.croissant import CARD, data_set_card
from humansim_ros.data.formats.exporting import Export, export
from humansim_ros.data.formats.huggingface import METADATA
from humansim_ros.data.formats.plan import DATA_SET_KEY, INDEX, ExportPlan, read_index
from humansim_ros.data.formats.source import SimulatedSource, versions
from humansim_ros.data.formats.statistics import STATISTICS, Totals
from humansim_ros.data.formats.writer import SHARD_SIZE, ExportFolder, file_entry
from humansim_ros.errors import ExportError, HumansimError, RenderError, some_of
from humansim_ros.files.reading import ANY_SIZE, read_json
from humansim_ros.render.device import OpenGLContext
from humansim_ros.scene.config import map_files
from humansim_ros.scene.core import found_name

#: Version of the keys in the index file of a data set.
_LAYOUT = 1
#: Files of the whole data set: hashes for ``sha256sum -c``, page of Hugging Face, datasheet.
HASHES, README, DATASHEET = "SHA256SUMS", "README.md", "datasheet.html"
#: Name of the scene file in the folder of a scene.
SCENE_FILE = "scene.yaml"
#: Options of the export of one scene, with the key of a recipe that replaces each of them.
_RECIPE_KEYS = {
    "--format": "formats",
    "--frames": "frames",
    "--range": "frames",
    "--keypoints": "keypoints",
    "--images": "images",
    "--license": "about.license",
}
#: Default values of some options. All other options are empty by default.
_NOT_GIVEN = {
    "--keypoints": "coco17",
    "--images": "png",
    "--shard-size": SHARD_SIZE,
    "--shard-frames": PART_FRAMES,
}
#: Number of scenes that one task on a cluster writes.
_PART_SCENES = 10
#: Writing is given up if this number of first scenes all fail; or if, from the second number of failures on,
#: more than half of all scenes have failed.
_ALL_FAIL, _MOST_FAIL = 4, 10


@dataclass(frozen=True)
class SceneResult:
    """Result for one scene: it has been written, or it failed.

    Attributes:
        number: Number of the scene.
        size: Size of all files of the scene, bytes.
        failure: Why the scene could not be drawn or written. Empty if it was written.
    """

    number: int
    size: int = 0
    failure: str = ""


@dataclass(frozen=True)
class ScenesResult:
    """Results of the scenes that one task on a cluster has written."""

    scenes: tuple[SceneResult, ...]

    @property
    def size(self) -> int:
        """Size of the files of all these scenes, bytes."""
        return sum(each.size for each in self.scenes)


@dataclass(frozen=True)
class DataSet:
    """A data set that shall be written: a job for worker processes, to which it can be copied.

    Attributes:
        recipe: Recipe that the scenes are drawn from.
        root: Folder of the data set; an absolute path on a cluster.
        device: Device that renders. Each host must have this device, since others round differently.
    """

    recipe: Recipe
    root: Path
    device: str

    @classmethod
    def of(cls, recipe: Recipe, root: Path) -> DataSet:
        """A data set that is rendered on this machine. Raises RenderError if OpenGL is missing."""
        context = OpenGLContext()
        context.close()
        return cls(recipe, root, context.device)

    @property
    def plan(self) -> dict[str, Any]:
        """Recipe, seed, formats, device and version: everything that determines the files of a scene."""
        recipe = self.recipe
        return {
            "recipe": recipe.config.recipe,
            "hash": recipe.hash,
            "seed": recipe.config.seed,
            "formats": [row.name for row in recipe.formats],
            "device": self.device,
            "version": __version__,
        }

    @property
    def key(self) -> str:
        """Key that is equal for data sets with the same scenes in the same folder."""
        return f"{self.root} {self.plan}"

    def start(self) -> SceneWorker:
        """Return a worker that writes scenes. Raises RenderError if this machine has another device."""
        if DataSet.of(self.recipe, self.root).device != self.device:
            raise RenderError(f"this machine does not render on {self.device}: pixels would differ")
        return SceneWorker(self)

    def write_part(self, worker: FrameWorker, part: ClusterPart) -> PartResult:
        """Write the scenes of one task on a cluster. Raises ExportError without the shared folder."""
        if not (self.root / INDEX).exists():
            raise ExportError("all hosts must share this folder", path=self.root)
        return ScenesResult(tuple(worker.work(number).value for number in part.frames))

    def is_written(self, number: int) -> bool:
        """Whether all files of a scene have been written."""
        folder = self.root / self.recipe.name(number)
        return (folder / INDEX).is_file() and bool(read_index(folder)["finished"])


class SceneWorker:
    """Draws and exports scenes.

    Attributes:
        costs: Processor time of each step, seconds.
    """

    def __init__(self, data_set: DataSet) -> None:
        self._data_set = data_set
        self.costs = Costs()

    def work(self, number: int) -> FrameResult:
        """Write a scene. If it cannot be drawn or written, the result has the reason.

        Raises:
            RenderError: This machine cannot render.
        """
        data_set = self._data_set
        try:
            start = time.process_time()
            drawn = data_set.recipe.draw(number)
            start = self.costs.add("drawing", start)
            size = _export_scene(data_set, drawn)
            self.costs.add("writing", start)
            return FrameResult(SceneResult(number, size))
        except RenderError:
            raise
        except HumansimError as error:
            return FrameResult(SceneResult(number, failure=str(error)))

    def close(self) -> None:
        """Do nothing: each scene has its own renderer."""


def check_options(options: Mapping[str, Any]) -> None:
    """Raise ExportError for options that only an export of one scene has. A recipe has keys in place of them.
    ``options``: values by name, such as ``--format``."""
    for name, value in options.items():
        if not value or value == _NOT_GIVEN.get(name):
            continue
        if name in _RECIPE_KEYS:
            reason = f"the recipe has it: set its key {_RECIPE_KEYS[name]}"
        elif name == "--shard-frames":
            scenes = f"{_PART_SCENES} scenes of a recipe"
            reason = f"is for a scene or bag; a worker of Ray writes {scenes} at a time"
        else:
            reason = "a recipe has no such key"
        raise ExportError(reason, key=name)


def _export_scene(data_set: DataSet, drawn: DrawnScene) -> int:
    """Export a scene, or the rest of one that was begun. Returns the size of its files, bytes."""
    recipe, config = data_set.recipe, data_set.recipe.config
    name = recipe.name(drawn.number)
    folder = data_set.root / name
    if not (folder / INDEX).exists():
        _remove(folder)  # what is left of a process that was killed at its start
    source = SimulatedSource(drawn.scene, recipe.formats, config.keypoints, Path(name).name)
    license = config.about.license or ""
    plan = ExportPlan.of(
        source, range(config.frames), f".{config.images}", license=license, device=data_set.device
    )
    job = Export(source, plan, folder, {SCENE_FILE: _scene_text(data_set, drawn, folder)})
    try:
        return export(job, resume=True).size
    except ExportError as error:
        if error.key in _RECIPE_KEYS:
            raise recipe.error_at(_RECIPE_KEYS[error.key], f"scene {drawn.number}: {error.message}") from None
        raise


def _remove(folder: Path) -> None:
    """Remove the folder of a scene, if the folder exists. Raises ExportError if that fails."""
    try:
        shutil.rmtree(folder)
    except FileNotFoundError:
        pass
    except OSError as reason:
        raise ExportError(f"cannot be removed: {reason.strerror or reason}", path=folder) from None


def _scene_text(data_set: DataSet, drawn: DrawnScene, folder: Path) -> str:
    """Text of the scene file in ``folder``. File names in the text are relative to this folder."""
    recipe, place = data_set.recipe, folder.resolve()

    def renamed(name: str) -> str:
        found = found_name(recipe.path.parent, name)
        return os.path.relpath(found, place) if found != name else str(name)

    # the configuration without the people of variety and crowd, since they follow from the seeds
    config = recipe.scene(drawn.number, drawn.attempt)
    content = map_files(config.model_dump(exclude_unset=True), renamed)
    text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, allow_unicode=True)
    origin = f"scene {drawn.number} of the recipe {recipe.config.recipe} with seed {recipe.config.seed}"
    return f"# {origin}, draw {drawn.attempt + 1}\n{text}"


def write_data_set(
    data_set: DataSet,
    jobs: int = 1,
    resume: bool = False,
    on_progress: Callable[[FrameProgress], None] = lambda _: None,
    ray: str | None = None,
) -> FrameProgress:
    """Write a data set. Its files do not depend on ``jobs``, on the cluster, or on interruptions.

    If a scene cannot be drawn, the scene is left out, and the other scenes are written.

    Args:
        data_set: The data set. Its folder must not exist unless ``resume`` is set.
        jobs: Number of processes that render. If 1, this process renders.
        resume: Whether to continue a data set that was begun. The recipe may have more scenes than before.
        on_progress: Called from time to time with the number of finished scenes.
        ray: Address of a Ray cluster that renders. If None, this machine renders.

    Raises:
        ExportError: The folder exists, or has another data set; or some scenes failed (this is raised after
            all other scenes are written).
        WorkerDiedError: A worker process has died.
    """
    numbers = _unwritten(data_set, resume)
    progress = FrameProgress.of(data_set.recipe.config.scenes, len(numbers))
    failures: dict[int, str] = {}

    def take(_: int, result: FrameResult) -> int:
        each: SceneResult = result.value
        if each.failure:
            failures[each.number] = each.failure
            count, done = len(failures), progress.done + 1
            if count == done >= _ALL_FAIL or (count >= _MOST_FAIL and count > done / 2):
                raise ExportError(f"{_failed_text(failures, done)}, and the rest is given up")
        return each.size

    if numbers and ray is None:
        run_frames(
            data_set, numbers, jobs, progress, take, begin=lambda: _begin(data_set), on_progress=on_progress
        )
    elif numbers and ray is not None:
        failures |= _write_on_cluster(data_set, numbers, ray, jobs, progress, on_progress)
    _finish(data_set, failures)
    if failures:
        raise ExportError(_failed_text(failures, data_set.recipe.config.scenes))
    return progress


def _failed_text(failures: Mapping[int, str], count: int) -> str:
    """Error message about scenes that failed. ``count``: number of scenes that were tried."""
    listed = some_of(sorted(failures))
    others = "; the others are whole" if len(failures) < count else ""
    text = f"{len(failures)} of {count} scenes could not be written ({listed}){others}"
    return f"{failures[min(failures)]}\n{text}"


def _write_on_cluster(
    data_set: DataSet,
    numbers: Sequence[int],
    address: str,
    workers: int,
    progress: FrameProgress,
    on_progress: Callable[[FrameProgress], None],
) -> dict[int, str]:
    """Write scenes on a Ray cluster. Returns the reason of each failure, by number of the scene."""
    parts = []
    for start in range(0, len(numbers), _PART_SCENES):
        some = tuple(numbers[start : start + _PART_SCENES])
        text = f"scenes {some[0]} to {some[-1]}"
        parts.append(ClusterPart(text, text, some, len(some)))
    with connected(address, workers) as ray:
        _begin(data_set)
        results, reasons = run_parts(ray, [(data_set, parts)], progress, on_progress)
    failures: dict[int, str] = {}
    for part in parts:
        result = results.get(part)
        if isinstance(result, ScenesResult):
            failures |= {each.number: each.failure for each in result.scenes if each.failure}
        else:
            left = [number for number in part.frames if not data_set.is_written(number)]
            failures |= dict.fromkeys(left, some_of(reasons) or "its task did not run")
    return failures


def _unwritten(data_set: DataSet, resume: bool) -> Sequence[int]:
    """Numbers of the scenes that are not written yet. Raises ExportError if the folder must not be used."""
    root, numbers = data_set.root, range(data_set.recipe.config.scenes)
    if not (root.exists() or root.is_symlink()):
        return numbers
    if not resume:
        raise ExportError("this path exists; choose another one, or continue with --resume", path=root)
    index = read_data_set(root)
    before, plan = index.get("plan", {}), data_set.plan
    if differing := [key for key in plan if before.get(key) != plan[key]]:
        texts = (
            "the recipe has changed" if key == "hash" else f"{key}: {before.get(key)} there, {plan[key]} now"
            for key in differing
        )
        raise ExportError(f"this folder has another data set: {'; '.join(texts)}", path=root)
    there = sorted(folder.name for folder in root.glob("*/scene_*"))
    if there and there[-1] > f"scene_{numbers[-1]:06d}":
        raise ExportError(f"this folder has {there[-1]}, and {len(numbers)} scenes are fewer", path=root)
    return [number for number in numbers if not data_set.is_written(number)]


def read_data_set(root: Path) -> dict[str, Any]:
    """Content of the index of a data set. Raises ExportError if the folder has none."""
    index = read_json(root / INDEX, ExportError, "index", ANY_SIZE)
    if not isinstance(index, dict) or index.get(DATA_SET_KEY) != _LAYOUT:
        raise ExportError("this is not the index of a data set of this version", path=root / INDEX)
    return index


def _begin(data_set: DataSet) -> None:
    """Make the folder, with an index that has only the plan. Raises HumansimError if that fails."""
    if not data_set.root.exists():
        try:
            _write_index(data_set, ExportFolder(data_set.root), finished=False)
        except HumansimError:
            _remove(data_set.root)  # nobody could continue it
            raise


def _write_index(data_set: DataSet, folder: ExportFolder, **more: Any) -> None:
    folder.write(INDEX, json.dumps({DATA_SET_KEY: _LAYOUT, "plan": data_set.plan, **more}, indent=1) + "\n")


def _finish(data_set: DataSet, failures: Mapping[int, str]) -> None:
    """Write the files of the whole data set. The index and the hashes come last."""
    recipe, root = data_set.recipe, data_set.root
    for number in failures:  # images of a part of a scene would be read with the others
        _remove(root / recipe.name(number))
    folder, totals = ExportFolder(root), Totals()
    scenes: dict[str, dict[str, Any]] = {}
    parts = {split: Totals() for split in recipe.config.splits}
    own_licenses, licenses = set[str](), set[str]()
    split_of: dict[str, str] = {}
    with folder.path(HASHES) as path, path.open("w", encoding="utf-8") as hashes:
        for number in range(recipe.config.scenes):
            if number in failures:
                continue
            name, split = recipe.name(number), recipe.splits[number]
            index = read_index(root / name)
            statistics = read_json(root / name / STATISTICS, ExportError, "statistics", ANY_SIZE)
            files = {**index["files"], INDEX: file_entry(root / name / INDEX)}
            hashes.writelines(f"{entry['sha256']}  {name}/{file}\n" for file, entry in files.items())
            for each in (totals, parts[split]):
                each.add(statistics)
            for body in (person["body"] for person in statistics["people"].values()):
                if split_of.setdefault(body, split) != split:
                    raise ExportError(f"{body} is in {split_of[body]} and in {split} ({name})", path=root)
            own_licenses |= {index["license"]} if index.get("license") else set()
            licenses |= set(index["licenses"].values())
            scenes[name] = {
                "split": split,
                "people": {name: person["body"] for name, person in statistics["people"].items()},
                "cameras": list(index["cameras"]),
                "images": statistics["images"],
                "bytes": sum(entry["bytes"] for entry in files.values()),
                "index": files[INDEX]["sha256"],
            }
        if scenes:
            summary = _summary(data_set, totals, parts, (sorted(own_licenses), sorted(licenses)), scenes)
            _write_pages(summary, folder)
            files = {name: folder.written[name] for name in sorted(folder.written)}
            more = {"finished": True, "about": summary.card, "splits": _counts(parts)}
            _write_index(
                data_set,
                folder,
                **more,
                failed=_named(failures, data_set.recipe.path.parent),
                scenes=scenes,
                files=files,
            )
            entries = files | {INDEX: folder.written[INDEX]}
            hashes.writelines(f"{entry['sha256']}  {name}\n" for name, entry in entries.items())


def _summary(
    data_set: DataSet,
    totals: Totals,
    parts: Mapping[str, Totals],
    licenses: tuple[Sequence[str], Sequence[str]],
    scenes: Mapping[str, Mapping[str, Any]],
) -> DataSetSummary:
    config, suffix = data_set.recipe.config, f".{data_set.recipe.config.images}"
    cameras = {name: scene["cameras"] for name, scene in scenes.items()}
    examples = example_paths(data_set.root, cameras, config.frames, suffix)
    made_with = versions() | {"device": data_set.device}
    return DataSetSummary(config, totals, parts, *licenses, made_with, examples, suffix)


def _write_pages(summary: DataSetSummary, folder: ExportFolder) -> None:
    splits = [name for name, part in summary.parts.items() if part.images]
    card = data_set_card(summary.card, splits, summary.suffix, METADATA)
    folder.write(CARD, json.dumps(card, indent=1) + "\n")
    folder.write(DATASHEET, datasheet(summary))
    folder.write(README, readme(summary))


def _counts(parts: Mapping[str, Totals]) -> dict[str, dict[str, int]]:
    return {
        name: {"scenes": part.scenes, "images": part.images, "people": len(part.people)}
        for name, part in parts.items()
    }


def _named(failures: Mapping[int, str], folder: Path) -> dict[str, str]:
    """Reason of each failure, by name of the scene. Paths in the texts lose the folder of the recipe."""
    return {f"scene_{number:06d}": failures[number].replace(f"{folder}/", "") for number in sorted(failures)}
