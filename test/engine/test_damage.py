"""Damaged state of interrupted work: ``--resume`` makes the right files of it, or refuses with a sentence."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest
from interruptions import differences, is_sentence, tree
from products import PRODUCTS
from workshop import Workshop

REFUSED = 2
#: Content of damaged files, by content and name before.
DAMAGES: dict[str, Callable[[bytes, str], bytes]] = {
    "empty": lambda data, _: b"",
    "cut": lambda data, _: data[: len(data) // 2],
    "no JSON": lambda data, _: b"\xff\xfe{",
    "a list": lambda data, _: b"[]",
    "a null": lambda data, _: b"null",
    "only a number": lambda data, name: b'{"number": %d}' % number_of(name),
    "wrong files": lambda data, name: b'{"number": %d, "files": [3], "rows": []}' % number_of(name),
    "deep": lambda data, _: b"[" * 100_000,
}


def number_of(name: str) -> int:
    """Number of the shard that a file such as ``000012.json`` is about; 0 for other files."""
    stem = name.partition(".")[0]
    return int(stem) if stem.isdecimal() else 0


def kinds(out: Path) -> Iterator[Path]:
    """One file of each kind of an interrupted product, relative to its folder: state, and finished files."""
    seen = set()
    for path in sorted(path for path in out.rglob("*") if path.is_file()):
        relative = path.relative_to(out)
        digits = "".join("0" if each.isdigit() else each for each in relative.as_posix())
        kind = digits if ".work" in relative.parts else (relative.parts[0], path.suffix)
        if kind not in seen:
            seen.add(kind)
            yield relative


def finished(files: Mapping[str, str]) -> dict[str, str]:
    """A tree of files without those of shards that are not finished."""
    return {path: text for path, text in files.items() if "/.work/staging-" not in path}


def check(workshop: Workshop, name: str, case: Path, what: object) -> str:
    """Continue damaged work. Returns what is wrong.

    What a killed command has left of a shard that is not finished may be gone, also if the work is refused.
    """
    before = tree(case)
    done = workshop.make(PRODUCTS[name], case, "--jobs", 1, "--resume")
    if done.returncode == 0:
        expected = {**workshop.whole(PRODUCTS[name]).tree}
        own = {path: text for path, text in before.items() if not path.startswith("out")}
        wrong = differences(expected | own, tree(case))
    elif done.returncode == REFUSED and is_sentence(done) and str(case / "out") in done.stderr:
        wrong = differences(finished(before), finished(tree(case)))
    else:
        wrong = [f"exit code {done.returncode}: {done.stderr[-300:]}"]
    return f"{what}: " + "\n    ".join(wrong) if wrong else ""


@pytest.mark.slow
@pytest.mark.daily("record-cut", "recipe-no JSON")
@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_damaged_file_is_made_again_or_refused(
    workshop: Workshop, name: str, damage: str, tmp_path: Path
) -> None:
    texts = []
    paths = list(kinds(workshop.begun(PRODUCTS[name], tmp_path / "kinds")))
    for number, relative in enumerate(paths):
        case = tmp_path / str(number)
        path = workshop.begun(PRODUCTS[name], case) / relative
        path.write_bytes(DAMAGES[damage](path.read_bytes(), path.name))
        texts.append(check(workshop, name, case, relative))
    assert paths and not any(texts), "\n".join(texts)


def linked(path: Path) -> None:
    """Put the file into another folder, and a link in its place."""
    other = next(parent for parent in path.parents if parent.name == "out").with_name("elsewhere")
    other.mkdir()
    shutil.move(path, other / path.name)
    path.symlink_to(other / path.name)


def broken_link(path: Path) -> None:
    path.unlink()
    path.symlink_to("nowhere")


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


@pytest.mark.slow
@pytest.mark.daily("record-pipe", "recipe-linked")
@pytest.mark.parametrize("change", [linked, broken_link, pipe, folder])
@pytest.mark.parametrize("name", PRODUCTS)
def test_links_and_pipes_in_place_of_files_do_no_harm(
    workshop: Workshop, name: str, change: Callable[[Path], None], tmp_path: Path
) -> None:
    """What a link names stays as it is."""
    texts = []
    paths = list(kinds(workshop.begun(PRODUCTS[name], tmp_path / "kinds")))
    for number, relative in enumerate(paths):
        case = tmp_path / str(number)
        change(workshop.begun(PRODUCTS[name], case) / relative)
        texts.append(check(workshop, name, case, relative))
    assert paths and not any(texts), "\n".join(texts)


@pytest.mark.slow
@pytest.mark.daily("record")
@pytest.mark.parametrize("name", PRODUCTS)
def test_a_link_in_place_of_the_folder_of_the_work_does_no_harm(
    workshop: Workshop, name: str, tmp_path: Path
) -> None:
    linked(workshop.begun(PRODUCTS[name], tmp_path) / ".work")
    assert not (text := check(workshop, name, tmp_path, ".work")), text
