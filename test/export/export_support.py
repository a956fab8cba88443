"""Support of the tests of exports: a small scene, and the export of a few frames of it in this process."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from humansim_ros import Scene
from humansim_ros.data.engine import WorkProgress, run
from humansim_ros.data.formats.exporting import Export
from humansim_ros.data.formats.formats import chosen_formats
from humansim_ros.data.formats.plan import ExportPlan, parse_range
from humansim_ros.data.formats.source import SimulatedSource

#: Two people, a labelled box, a camera with noise and one with a distorted lens.
SCENE = """
rate: 20
room: null
humans:
  anna: {body: child, motion: walk}
  bert: {body: adult_man, motion: {file: walk, position: [0.8, 0.3]}}
objects:
  crate: {mesh: box, size: [0.4, 0.4, 0.4], position: [0.2, -0.8, 0.2], label: true}
cameras:
  noisy: {size: [96, 72], position: [3, 0.4, 1.4], look_at: [0, 0, 1], sensor: {noise: {read_noise: 4}}}
  bent: {size: [80, 64], distortion: [-0.2, 0.05, 0, 0, 0], position: [0, 3, 1.2], look_at: [0, 0, 0.8]}
"""
FRAMES = "3:5"


def small_scene() -> Scene:
    return Scene.from_dict(yaml.safe_load(SCENE))


@dataclass(frozen=True)
class ExportJob:
    """An export and its folder."""

    export: Export
    root: Path

    def run(self, **options: Any) -> WorkProgress:
        return run(self.export, self.root, **options)


def job(
    root: Path,
    formats: str,
    scene: Scene | None = None,
    frames: str = FRAMES,
    keypoints: str = "coco17",
    **options: Any,
) -> ExportJob:
    rows = tuple(chosen_formats(formats.split(",")))
    source = SimulatedSource(scene or small_scene(), rows, keypoints)
    return ExportJob(Export(source, ExportPlan.of(source, parse_range(frames), **options)), root)


def exported(root: Path, formats: str, scene: Scene | None = None, **options: Any) -> Path:
    """Export frames in this process; returns the folder."""
    job(root, formats, scene, **options).run()
    return root


def index_of(root: Path) -> dict[str, Any]:
    index: dict[str, Any] = json.loads((root / "index.json").read_text())
    return index


def content(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}
