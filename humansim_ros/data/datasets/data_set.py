"""Export of the scenes of a recipe as one data set: the plan for the engine, and the worker.

Each scene is a separate export, in a folder below the folder of its split (such as ``train``). After the last
scene, the files about the whole data set are written: index, hashes, data card, datasheet and the page of
Hugging Face.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from humansim_ros.data.datasets.datasheet import DataSetSummary, datasheet, example_paths, readme
from humansim_ros.data.datasets.recipe import DrawnScene, Recipe
from humansim_ros.data.engine import (
    Costs,
    Done,
    OutputFolder,
    PartialError,
    WorkPlan,
    WorkShard,
    Written,
    run,
)
from humansim_ros.data.formats.croissant import CARD, data_set_card
from humansim_ros.data.formats.exporting import Export
from humansim_ros.data.formats.huggingface import METADATA
from humansim_ros.data.formats.plan import DATA_SET_KEY, INDEX, ExportPlan, read_index
from humansim_ros.data.formats.source import SimulatedSource, versions
from humansim_ros.data.formats.statistics import STATISTICS, Totals
from humansim_ros.data.formats.writer import SHARD_SIZE, ExportFolder, file_entry
from humansim_ros.errors import ExportError, HumansimError, RenderError, some_of
from humansim_ros.files.reading import ANY_SIZE, package_version, read_json
from humansim_ros.render.device import rendering_device
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
_NOT_GIVEN = {"--keypoints": "coco17", "--images": "png", "--shard-size": SHARD_SIZE}
#: Writing is given up if this number of first scenes all fail; or if, from the second number of failures on,
#: more than half of all scenes have failed.
_ALL_FAIL, _MOST_FAIL = 4, 10


@dataclass(frozen=True)
class DataSet(WorkPlan):
    """Plan of a data set. It can be copied to other processes.

    Attributes:
        recipe: Recipe that the scenes are drawn from.
        root: Folder of the data set.
        device: Device that renders. Each host must have this device, since others round differently.
    """

    recipe: Recipe
    root: Path
    device: str
    what = "data set"
    items = "scenes"
    error = ExportError

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.recipe, self.root, self.device)

    @classmethod
    def of(cls, recipe: Recipe, root: Path) -> DataSet:
        """A data set that is rendered on this machine. Raises RenderError if OpenGL is missing."""
        return cls(recipe, root, rendering_device())

    @property
    def key(self) -> Mapping[str, Any]:
        """Recipe, seed, formats, device and version: everything that determines the files of a scene."""
        recipe = self.recipe
        return {
            "recipe": recipe.config.recipe,
            "hash": recipe.hash,
            "seed": recipe.config.seed,
            "formats": [row.name for row in recipe.formats],
            "device": self.device,
            "version": package_version(),
        }

    @cached_property
    def shards(self) -> Sequence[WorkShard]:
        """The scenes."""
        return [WorkShard(number, range(number, number + 1)) for number in range(self.recipe.config.scenes)]

    def open(self) -> SceneWorker:
        """Return a worker that writes scenes. Raises RenderError if OpenGL is missing."""
        return SceneWorker(self)

    def finished(self, folder: OutputFolder) -> tuple[Mapping[str, Any], Collection[int]] | None:
        """Key, and numbers of the scenes that are written. The recipe may have more scenes than before.

        Raises:
            ExportError: The folder has no data set, or one of more scenes.
        """
        assert folder.local is not None
        if folder.size(INDEX) is None:
            return None
        index = read_data_set(folder.local)
        if not index.get("finished"):
            text = "this data set was begun by an older version: it cannot be continued"
            raise ExportError(text, path=folder.url)
        self._check_number(folder.local)
        written = (shard.number for shard in self.shards if self._is_written(folder.local, shard.number))
        return index["plan"], list(written)

    def _is_written(self, root: Path, number: int) -> bool:
        folder = root / self.recipe.name(number)
        return (folder / INDEX).is_file() and bool(read_index(folder)["finished"])

    def _check_number(self, root: Path) -> None:
        """Raise ExportError if the folder has more scenes than the recipe."""
        count = len(self.shards)
        there = sorted(folder.name for folder in root.glob("*/scene_*"))
        if there and there[-1] > f"scene_{count - 1:06d}":
            raise ExportError(f"this folder has {there[-1]}, and {count} scenes are fewer", path=root)

    def finish(self, done: Collection[Done], folder: OutputFolder) -> None:
        """Write the files of the whole data set. Raises ExportError if no scene is written."""
        failures = {each.number: each.failure for each in done if each.failure}
        if len(failures) == len(self.shards):
            raise ExportError(_failed_text(failures, len(failures)))
        assert folder.local is not None
        self._check_number(folder.local)
        _finish(replace(self, root=folder.local), failures)

    def failure(self, done: Collection[Done]) -> str:
        """Why scenes failed. While scenes are written, too many failures end the work."""
        failures = {each.number: each.failure for each in done if each.failure}
        count, tried = len(failures), len(done)
        is_last = tried == len(self.shards)
        gives_up = count == tried >= _ALL_FAIL or (count >= _MOST_FAIL and count > tried / 2)
        return _failed_text(failures, tried) if failures and (is_last or gives_up) else ""


class SceneWorker:
    """Draws and exports scenes.

    Attributes:
        device: Device that renders.
        costs: Processor time of each step, seconds.
    """

    def __init__(self, data_set: DataSet) -> None:
        self._data_set = data_set
        self.device = rendering_device()
        self.costs = Costs()

    def write(self, shard: WorkShard, folder: Path, tick: Callable[[], None]) -> Written:
        """Write a scene. If it cannot be drawn or written, the result has the reason.

        Raises:
            RenderError: This machine cannot render.
            PartialError: The disk is full.
        """
        try:
            start = time.process_time()
            drawn = self._data_set.recipe.draw(shard.number)
            start = self.costs.add("drawing", start)
            _export_scene(self._data_set, drawn, folder)
            self.costs.add("writing", start)
            tick()
            return Written()
        except (RenderError, PartialError):
            raise
        except HumansimError as error:
            return Written(failure=str(error))

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
            reason = "is for a scene or bag; a worker writes a whole scene of a recipe"
        else:
            reason = "a recipe has no such key"
        raise ExportError(reason, key=name)


def _export_scene(data_set: DataSet, drawn: DrawnScene, staging: Path) -> None:
    """Export a scene to its folder in ``staging``."""
    recipe, config = data_set.recipe, data_set.recipe.config
    name = recipe.name(drawn.number)
    source = SimulatedSource(drawn.scene, recipe.formats, config.keypoints, Path(name).name)
    license = config.about.license or ""
    plan = ExportPlan.of(
        source, range(config.frames), f".{config.images}", license=license, device=data_set.device
    )
    export = Export(source, plan, {SCENE_FILE: _scene_text(data_set, drawn, data_set.root / name)})
    try:
        run(export, staging / name)
    except ExportError as error:
        if error.key in _RECIPE_KEYS:
            raise recipe.error_at(_RECIPE_KEYS[error.key], f"scene {drawn.number}: {error.message}") from None
        raise


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


def _failed_text(failures: Mapping[int, str], count: int) -> str:
    """Error message about scenes that failed. ``count``: number of scenes that were tried."""
    listed = some_of(sorted(failures))
    others = "; the others are whole" if len(failures) < count else ""
    text = f"{len(failures)} of {count} scenes could not be written ({listed}){others}"
    return f"{failures[min(failures)]}\n{text}"


def read_data_set(root: Path) -> dict[str, Any]:
    """Content of the index of a data set. Raises ExportError if the folder has none."""
    index = read_json(root / INDEX, ExportError, "index", ANY_SIZE)
    if not isinstance(index, dict) or index.get(DATA_SET_KEY) != _LAYOUT:
        raise ExportError("this is not the index of a data set of this version", path=root / INDEX)
    return index


def _finish(data_set: DataSet, failures: Mapping[int, str]) -> None:
    """Write the files of the whole data set. The index and the hashes come last."""
    recipe, root = data_set.recipe, data_set.root
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
        summary = _summary(data_set, totals, parts, (sorted(own_licenses), sorted(licenses)), scenes)
        _write_pages(summary, folder)
        files = {name: folder.written[name] for name in sorted(folder.written)}
        content = {
            DATA_SET_KEY: _LAYOUT,
            "plan": dict(data_set.key),
            "finished": True,
            "about": summary.card,
            "splits": _counts(parts),
            "failed": _named(failures, data_set.recipe.path.parent),
            "scenes": scenes,
            "files": files,
        }
        folder.write(INDEX, json.dumps(content, indent=1) + "\n")
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
