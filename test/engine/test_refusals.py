"""Folders that must not be continued: each refusal says why, and changes no file."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import version_02
from commands import Done
from interruptions import differences, is_sentence, tree
from products import EXPORT, PRODUCTS, RECIPE, RECORD, Product
from stop_hook import Stop
from workshop import Workshop

REFUSED = 2
RESUME = ("--jobs", 1, "--resume")
#: Another software renderer of Mesa, whose pixels differ.
OTHER_DEVICE = {"GALLIUM_DRIVER": "softpipe"}
MORE_FRAMES = ("--frames", 13)
#: Product in the folder, product of the command that shall continue it, and words of the error.
OTHERS: dict[str, tuple[Product, Product, str]] = {
    "scene": (RECORD, RECORD.changed("[3, 0.4, 1.4]", "[3, 0.4, 1.5]"), "the scene"),
    "exported scene": (EXPORT, EXPORT.changed("[3, 0.4, 1.4]", "[3, 0.4, 1.5]"), "the scene"),
    "seed": (RECIPE, RECIPE.changed("seed: 5", "seed: 6"), "the recipe has changed"),
    "recipe": (RECIPE, RECIPE.changed("radius: 3", "radius: 3.1"), "the recipe has changed"),
    "format of images": (RECORD, replace(RECORD, options=(*RECORD.options, "--images", "png")), "images"),
    "formats": (EXPORT, replace(EXPORT, options=("--frames", 12, "--format", "coco")), "formats"),
    "formats of a recipe": (RECIPE, RECIPE.changed("[trc]", "[trc, bvh]"), "the recipe has changed"),
    "frames": (RECORD, replace(RECORD, options=MORE_FRAMES), "frames"),
    "frames of an export": (EXPORT, replace(EXPORT, options=(*EXPORT.options, *MORE_FRAMES)), "13"),
    "an export": (EXPORT, RECORD, "out"),
    "a recording": (RECORD, EXPORT, "out"),
    "a data set": (RECIPE, EXPORT, "out"),
}


def is_refused(done: Done, out: Path) -> bool:
    return done.returncode == REFUSED and is_sentence(done) and str(out) in done.stderr


@pytest.mark.slow
@pytest.mark.daily("begun-scene", "begun-recipe", "begun-formats")
@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("state", ["begun", "whole"])
def test_another_product_is_not_continued(workshop: Workshop, name: str, state: str, tmp_path: Path) -> None:
    there, other, words = OTHERS[name]
    if state == "begun":
        workshop.begun(there, tmp_path)
    else:
        assert workshop.make(there, tmp_path, "--jobs", 1).returncode == 0
    before = tree(tmp_path)
    done = workshop.make(other, tmp_path, *RESUME)
    assert is_refused(done, tmp_path / "out") and words in done.stderr, done
    assert tree(tmp_path) == before


@pytest.mark.slow
@pytest.mark.daily("export")
@pytest.mark.parametrize("name", PRODUCTS)
def test_another_device_is_refused(workshop: Workshop, name: str, tmp_path: Path) -> None:
    product = PRODUCTS[name]
    workshop.begun(product, tmp_path)
    before = tree(tmp_path)
    done = workshop.make(product, tmp_path, *RESUME, **OTHER_DEVICE)
    assert is_refused(done, tmp_path / "out"), done
    assert "device" in done.stderr and "softpipe" in done.stderr
    assert tree(tmp_path) == before


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", [name for name in PRODUCTS if "one-file" not in name])
def test_a_worker_with_another_device_is_refused(workshop: Workshop, name: str, tmp_path: Path) -> None:
    """A single shard is written by the command itself, without a worker."""
    product = PRODUCTS[name]
    stop = Stop(worker_environment=OTHER_DEVICE)
    done = workshop.make(product, tmp_path, "--jobs", 2, stop=stop)
    assert done.returncode == REFUSED and is_sentence(done), done
    assert "renders on softpipe" in done.stderr and "pixels would differ" in done.stderr
    wrong = workshop.resumed(product, tmp_path, "--jobs", 1)
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("name", PRODUCTS)
def test_another_number_of_workers_is_allowed(workshop: Workshop, name: str, tmp_path: Path) -> None:
    workshop.begun(PRODUCTS[name], tmp_path)
    wrong = workshop.resumed(PRODUCTS[name], tmp_path, "--jobs", 2)
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
@pytest.mark.daily("notes.txt-recipe", ".work/notes.txt-record")
@pytest.mark.parametrize("product", [RECORD, RECIPE], ids=["record", "recipe"])
@pytest.mark.parametrize("file", ["notes.txt", "index.json", ".work/notes.txt", "metadata.yaml"])
def test_a_folder_of_somebody_else_stays(
    workshop: Workshop, product: Product, file: str, tmp_path: Path
) -> None:
    path = tmp_path / "out" / file
    path.parent.mkdir(parents=True)
    path.write_text("my own words")
    before = tree(tmp_path)
    for options in (("--jobs", 1), RESUME):
        done = workshop.make(product, tmp_path, *options)
        assert is_refused(done, tmp_path / "out"), done
        assert tree(tmp_path) == before


@pytest.mark.slow
@pytest.mark.daily("export", "record")
@pytest.mark.parametrize("name", version_02.FOLDERS)
def test_a_folder_of_version_02_stays(workshop: Workshop, name: str, tmp_path: Path) -> None:
    version_02.write_folder(name, tmp_path / "out")
    product = PRODUCTS.get(name, RECORD)
    before = tree(tmp_path)
    for options in (("--jobs", 1), RESUME):
        done = workshop.make(product, tmp_path, *options)
        assert is_refused(done, tmp_path / "out"), done
        assert tree(tmp_path) == before


def link_to_a_folder(out: Path) -> None:
    target = out.with_name("elsewhere")
    target.mkdir()
    (target / "notes.txt").write_text("my own words")
    out.symlink_to(target)


PLACES: dict[str, Callable[[Path], object]] = {
    "file": lambda out: out.write_text("my own words"),
    "empty file": lambda out: out.touch(),
    "pipe": lambda out: os.mkfifo(out),
    "broken link": lambda out: out.symlink_to(out.with_name("nowhere")),
    "link to a folder": link_to_a_folder,
}


@pytest.mark.slow
@pytest.mark.daily("record-pipe", "recipe-link to a folder")
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("product", [RECORD, RECIPE], ids=["record", "recipe"])
def test_what_is_no_folder_is_refused(
    workshop: Workshop, product: Product, place: str, tmp_path: Path
) -> None:
    PLACES[place](tmp_path / "out")
    before = tree(tmp_path)
    for options in (("--jobs", 1), RESUME):
        done = workshop.make(product, tmp_path, *options)
        assert is_refused(done, tmp_path / "out"), done
        assert tree(tmp_path) == before


@pytest.mark.slow
@pytest.mark.daily("export")
@pytest.mark.parametrize("name", ["record", "export", "recipe"])
def test_a_folder_that_cannot_be_made_is_named(workshop: Workshop, name: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for case in (tmp_path / "file", Path("/proc/humansim")):
        done = workshop.make(PRODUCTS[name], case, "--jobs", 1)
        assert done.returncode == REFUSED and is_sentence(done) and str(case) in done.stderr, done


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_finished_product_stays(workshop: Workshop, name: str, tmp_path: Path) -> None:
    product = PRODUCTS[name]
    assert workshop.make(product, tmp_path, "--jobs", 1).returncode == 0
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    again = workshop.make(product, tmp_path, "--jobs", 1)
    assert is_refused(again, tmp_path / "out"), again
    wrong = workshop.resumed(product, tmp_path, "--jobs", 1)
    assert not wrong, "\n".join(wrong)
    after = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    changed = [path for path in times if times[path] != after.get(path) and path.is_file()]
    assert not changed
    assert not differences(workshop.whole(product).tree, tree(tmp_path))
