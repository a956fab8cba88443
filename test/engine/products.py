"""Small products of the commands, which the tests of the engine interrupt."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

#: A child and two small cameras.
SCENE = """
rate: 20
room: null
humans:
  anna: {body: child, motion: walk}
cameras:
  left: {size: [64, 48], position: [3, 0.4, 1.4], look_at: [0, 0, 1]}
  right: {size: [64, 48], position: [0, 3, 1.2], look_at: [0, 0, 0.8]}
"""
#: Three scenes of a person and two cameras.
RECIPE_TEXT = """
recipe: tiny
seed: 5
scenes: 3
frames: 2
splits: {train: 2, test: 1}
formats: [trc]
ring:
  count: 2
  radius: 3
  height: 1.5
  camera: {size: [48, 36], fov_deg: 70}
scene:
  rate: 2
  room: null
  variety: {count: 1, motions: [walk]}
"""
FRAMES = 12


@dataclass(frozen=True)
class Product:
    """What a command makes, in a folder.

    Attributes:
        command: Name of the command.
        source: Text of the scene or recipe.
        options: Options of the command.
    """

    command: str
    source: str
    options: tuple[object, ...] = ()

    def write_source(self, folder: Path) -> Path:
        """Write the scene or recipe to a folder. Returns its path."""
        path = folder / ("recipe.yaml" if self.source.startswith("\nrecipe") else "scene.yaml")
        path.write_text(self.source)
        return path

    def words(self, source: Path, output: Path, *options: object) -> Sequence[object]:
        """Words of the command after ``humansim``."""
        return [self.command, source, "-o", output, *self.options, *options]

    def changed(self, old: str, new: str) -> Product:
        """The product of another scene or recipe."""
        assert old in self.source
        return replace(self, source=self.source.replace(old, new))


RECORD = Product("record", SCENE, ("--frames", FRAMES))
EXPORT = Product("export", SCENE, ("--frames", FRAMES, "--format", "coco,depth-png,webdataset"))
RECIPE = Product("export", RECIPE_TEXT)
PRODUCTS = {
    "record": RECORD,
    "record-one-file": replace(RECORD, options=("--frames", FRAMES, "--one-file")),
    "export": EXPORT,
    "recipe": RECIPE,
}
#: Products of several shards, which several workers write.
PARALLEL = [name for name in PRODUCTS if name != "record-one-file"]
