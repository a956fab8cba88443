"""The tutorials run from top to bottom as printed, and their pictures are those that they make."""

from __future__ import annotations

import importlib.util
import re
import shutil
from pathlib import Path
from types import ModuleType

import cv2
import pytest
from conftest import ROOT
from test_documented_commands import TUTORIALS, run_as_printed
from waiting import PATIENCE

PAGES = [page for page in TUTORIALS if page.stem != "index"]


def tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "tutorial_pictures", ROOT / "tools" / "figures" / "tutorial_pictures.py"
    )
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TOOL = tool()


@pytest.mark.daily("test_my_tracker", "sensor_effect")
@pytest.mark.gl
@pytest.mark.process
@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_tutorial_runs_from_top_to_bottom(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = page.read_text()
    TOOL.prepare(text, tmp_path)
    monkeypatch.chdir(tmp_path)
    steps = list(TOOL.commands(text))
    assert steps
    for words in steps:
        if words[0] == "git" and shutil.which("git") is None:
            pytest.skip("needs git")
        if TOOL.runs_here(words):
            TOOL.run(words, tmp_path, timeout=2 * PATIENCE)
        elif words[0] == "humansim":  # its options are parsed, and its scene loaded
            run_as_printed(words[1:], tmp_path, monkeypatch)
    for _, made, _ in (each for each in TOOL.MADE.values() if each[0] == page.stem):
        assert cv2.imread(str(tmp_path / made)) is not None, made


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_each_file_and_program_of_a_tutorial_is_used(page: Path) -> None:
    text = page.read_text()
    used = " ".join(" ".join(words) for words in TOOL.commands(text))
    programs = " ".join(content for name, content in TOOL.files(text).items() if name.endswith(".py"))
    assert {name for name in TOOL.files(text) if name not in used and name not in programs} == set()
    fenced = re.findall(r"```(?:yaml|python|toml|diff)\n", text)
    assert len(fenced) == len(TOOL.files(text)), "a block has no file name, so nothing runs it"


def test_the_pictures_of_tutorials_are_small_and_made_by_them() -> None:
    shown = {
        Path(target).name
        for page in PAGES
        for target in re.findall(r"!\[.+?\]\((.+?)\)", page.read_text(), re.DOTALL)
    }
    existing = {path.name: path for path in TOOL.PICTURES.iterdir()}
    assert shown == set(existing) == set(TOOL.MADE)
    for name, path in existing.items():
        image = cv2.imread(str(path))
        assert path.stat().st_size < 120_000, name
        assert image.shape[1] <= TOOL.MADE[name][2], name


def test_a_failed_command_of_a_tutorial_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "fails.py").write_text("raise SystemExit(3)")
    with pytest.raises(RuntimeError, match="exit code 3"):
        TOOL.run(["python", "fails.py"], tmp_path)
