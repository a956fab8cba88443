"""The table of motion formats is what readers, documents and fuzzers know."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import ROOT

from humansim_ros.errors import MotionError
from humansim_ros.io.motion_formats import MOTION_FORMATS, MOTION_SUFFIXES, MOTION_TITLES, motion_format
from humansim_ros.motion import read_motion


def test_the_page_of_motions_has_a_row_for_each_format() -> None:
    page = (ROOT / "docs" / "motion.md").read_text()
    rows = {row.split("|")[1].strip(): row.split("|")[2] for row in page.splitlines() if row.count("|") >= 4}
    for known in MOTION_FORMATS:
        assert all(f"`{suffix}`" in rows[known.title] for suffix in known.suffixes)


def test_help_and_schema_name_all_formats() -> None:
    for page in ("docs/reference/commands.md", "docs/reference/scene_keys.md", "config/scene.schema.json"):
        assert MOTION_TITLES in (ROOT / page).read_text()


def test_suffixes_are_of_one_format_and_compared_without_case() -> None:
    assert len(set(MOTION_SUFFIXES)) == len(MOTION_SUFFIXES)
    found = motion_format("WALK.C3D")
    assert found is not None and found.name == "markers"


@pytest.mark.parametrize("suffix", MOTION_SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"\0" * 600, b"some words\n" * 50])
def test_a_file_of_another_content_is_refused_with_its_name(
    tmp_path: Path, suffix: str, content: bytes
) -> None:
    path = tmp_path / f"walk{suffix}"
    path.write_bytes(content)
    with pytest.raises(MotionError) as caught:
        read_motion(path)
    assert caught.value.path == str(path)


@pytest.mark.parametrize("suffix", MOTION_SUFFIXES)
def test_a_missing_file_is_said_to_be_missing(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(MotionError, match=r"no such .* file|without a motion"):
        read_motion(tmp_path / f"walk{suffix}")
