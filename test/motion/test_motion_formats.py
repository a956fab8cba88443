"""The table of motion formats, and motions in ZIP archives: how one is named, and what is refused."""

from __future__ import annotations

import io
import re
import warnings
import zipfile
from pathlib import Path

import pytest
from conftest import ROOT
from motion_files import stand_in, walk
from motion_formats import write_acclaim

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.motion import read_motion
from humansim_ros.motion.files import files
from humansim_ros.motion.files.files import find_motion
from humansim_ros.motion.files.motion_formats import (
    MOTION_FORMATS,
    MOTION_SUFFIXES,
    MOTION_TITLES,
    motion_format,
    split_motion_name,
)
from humansim_ros.scene import Scene

PERSON = stand_in("mixamo")
BVH = PERSON.text(walk(6))


def archive(path: Path, members: dict[str, str | bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as out:
        for name, content in members.items():
            out.writestr(name, content)
    return path


def test_the_only_motion_of_an_archive_is_played(tmp_path: Path) -> None:
    path = archive(
        tmp_path / "all.zip", {"readme.txt": "hello", "a/walk.bvh": BVH, "__MACOSX/._walk.bvh": b"\0"}
    )
    motion = read_motion(path)
    assert motion.n_frames == 6 and motion.path == f"{path}/a/walk.bvh"


@pytest.mark.parametrize("mark", ["/", "#"])
def test_a_motion_of_an_archive_is_named(tmp_path: Path, mark: str) -> None:
    short = PERSON.text(walk(3))
    path = archive(tmp_path / "all.zip", {"a/walk.bvh": BVH, "a/bow.bvh": short})
    assert read_motion(f"{path}{mark}a/bow.bvh").n_frames == 3
    assert find_motion(f"all.zip{mark}a/bow.bvh", tmp_path) == f"{path}#a/bow.bvh"


def test_a_folder_may_be_called_like_an_archive(tmp_path: Path) -> None:
    (tmp_path / "all.zip").mkdir()
    (tmp_path / "all.zip" / "walk.bvh").write_text(BVH)
    assert read_motion(tmp_path / "all.zip" / "walk.bvh").n_frames == 6


def test_a_scene_plays_a_motion_of_an_archive(tmp_path: Path) -> None:
    archive(tmp_path / "all.zip", {"walk.bvh": BVH})
    (tmp_path / "scene.yaml").write_text(
        "humans: {anna: {motion: all.zip/walk.bvh}}\n"
        "cameras: {c: {size: [64, 48], position: [3, 0, 1], look_at: [0, 0, 1], fov_deg: 60}}\n"
    )
    assert Scene.load(tmp_path / "scene.yaml").actors["anna"].at(0.1).vertices.shape[1] == 3


def test_a_skeleton_file_in_an_archive_is_found(tmp_path: Path) -> None:
    amc = write_acclaim(tmp_path, stand_in("cmu_asf"), walk(4))
    texts = {f"sub/walk{suffix}": amc.with_suffix(suffix).read_text() for suffix in (".amc", ".asf")}
    path = archive(tmp_path / "cmu.zip", {**texts, "other/walk.asf": "broken"})
    with pytest.warns(HumansimWarning, match=re.escape(f"{path}/sub/walk.amc: the file states no rate")):
        assert read_motion(path).n_frames == 4


def test_warnings_and_errors_name_the_file_in_the_archive(tmp_path: Path) -> None:
    path = archive(tmp_path / "all.zip", {"walk.bvh": BVH.replace("Frames: 6", "Frames: 7"), "bad.bvh": "no"})
    with pytest.warns(HumansimWarning, match=re.escape(f"{path}/walk.bvh: ")):
        read_motion(f"{path}/walk.bvh")
    with pytest.raises(MotionError) as caught:
        read_motion(f"{path}/bad.bvh")
    assert caught.value.path == f"{path}/bad.bvh" and caught.value.line == 1


def test_names_cannot_leave_the_archive(tmp_path: Path) -> None:
    (tmp_path / "secret.bvh").write_text(BVH)
    path = archive(tmp_path / "all.zip", {"../../secret.bvh": PERSON.text(walk(2)), "/etc/x.bvh": BVH})
    before = sorted(tmp_path.rglob("*"))
    assert read_motion(f"{path}#../../secret.bvh").n_frames == 2
    assert read_motion(f"{path}#/etc/x.bvh").n_frames == 6
    with pytest.raises(MotionError, match=r"the archive has no motion '\.\./secret\.bvh'"):
        read_motion(f"{path}/../secret.bvh")
    assert sorted(tmp_path.rglob("*")) == before


def damaged(path: Path) -> None:
    data = bytearray(archive(path, {"walk.bvh": BVH}).read_bytes())
    data[60:400] = bytes(340)
    path.write_bytes(data)


def encrypted(path: Path) -> None:
    data = bytearray(archive(path, {"walk.bvh": BVH}).read_bytes())
    for mark, place in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        data[data.index(mark) + place] |= 1
    path.write_bytes(data)


def truncated(path: Path) -> None:
    path.write_bytes(archive(path, {"walk.bvh": BVH}).read_bytes()[:-60])


BAD = {
    "empty": (lambda path: archive(path, {}), "no motion in the archive"),
    "no motion": (lambda path: archive(path, {"a.txt": "x"}), "it has 'a.txt'"),
    "skeleton only": (lambda path: archive(path, {"a.asf": "x"}), "no motion in the archive"),
    "two motions": (
        lambda path: archive(path, {"a.bvh": BVH, "b.bvh": BVH}),
        "the archive has 2 motions: name one, such as all.zip/a.bvh; they are a.bvh, b.bvh",
    ),
    "not an archive": (lambda path: path.write_text(BVH), "not a ZIP archive that can be read"),
    "damaged": (damaged, "not a ZIP archive that can be read"),
    "encrypted": (encrypted, "not a ZIP archive that can be read"),
    "truncated": (truncated, "not a ZIP archive that can be read"),
    "many files": (
        lambda path: archive(path, {f"{n}.txt": b"" for n in range(10_001)}, zipfile.ZIP_STORED),
        "10001 files are too many",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_archive_is_refused(tmp_path: Path, case: str) -> None:
    make, message = BAD[case]
    path = tmp_path / "all.zip"
    make(path)
    with pytest.raises(MotionError, match=re.escape(message)) as caught:
        read_motion(path)
    assert caught.value.path == str(path)


def test_a_bomb_is_refused_before_it_fills_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_MAX_MEMBER", 1 << 16)
    path = archive(tmp_path / "all.zip", {"walk.bvh": bytes(1 << 20)})
    with pytest.raises(MotionError, match=r"'walk\.bvh' unpacks to more than 64 kB"):
        read_motion(path)


def test_an_archive_in_an_archive_is_no_motion(tmp_path: Path) -> None:
    inner = io.BytesIO()
    with zipfile.ZipFile(inner, "w") as out:
        out.writestr("walk.bvh", BVH)
    path = archive(tmp_path / "all.zip", {"inner.zip": inner.getvalue()})
    with pytest.raises(MotionError, match="no motion in the archive"):
        read_motion(path)


@pytest.mark.parametrize(
    ("name", "parts"),
    [
        ("walk", ("walk", None)),
        ("a#b.bvh", ("a#b.bvh", None)),
        ("a.glb#Walk", ("a.glb", "Walk")),
        ("a.zip", ("a.zip", None)),
        ("x/a.ZIP/b/c.bvh", ("x/a.ZIP", "b/c.bvh")),
        ("a.zip#b.bvh", ("a.zip", "b.bvh")),
        ("a.zip/" + "b" * 5000, ("a.zip", "b" * 5000)),
    ],
)
def test_names_are_split_into_file_and_part(name: str, parts: tuple[str, str | None]) -> None:
    assert split_motion_name(name) == parts


def test_no_temporary_folder_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read_motion(archive(tmp_path / "all.zip", {"walk.bvh": BVH}))
    assert list(folder.iterdir()) == []


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
