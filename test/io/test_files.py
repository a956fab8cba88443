"""Files that cannot be read (missing, folders, empty, binary …), and the names that were meant."""

from __future__ import annotations

import os
import warnings
from pathlib import Path

import numpy as np
import pytest

from humansim_ros.errors import (
    HumansimError,
    MeshError,
    MotionError,
    did_you_mean,
    located,
    show_warnings,
    warn_about,
)
from humansim_ros.files.reading.assets import find_asset
from humansim_ros.files.reading.files import (
    missing_file,
    parse_json,
    read_blocks,
    read_bytes,
    read_json,
    read_text,
)


def message(path: Path) -> str:
    with pytest.raises(HumansimError) as caught:
        read_text(path, HumansimError, "scene", 1 << 20)
    assert caught.value.path == str(path)
    return caught.value.message


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scene.yaml").write_text("rate: 3\n")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "Walk_01.bvh").write_text("x")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "meant"),
    [("scen.yaml", "scene.yaml"), ("Scene.yml", "scene.yaml"), ("data/walk_1.bvh", "Walk_01.bvh")],
)
def test_a_missing_file_names_the_one_that_was_meant(folder: Path, name: str, meant: str) -> None:
    assert message(folder / name) == f"no such scene file; did you mean {meant!r}?"
    assert missing_file(folder / name) == f"no such file {str(folder / name)!r}; did you mean {meant!r}?"


def test_a_missing_file_without_a_resemblance_names_none(folder: Path) -> None:
    assert message(folder / "q.yaml") == "no such scene file; check the path"
    assert missing_file(folder / "q.yaml", "give another") == f"no such file '{folder}/q.yaml'; give another"


def test_a_missing_folder_is_named(folder: Path) -> None:
    assert message(folder / "dta" / "sub" / "a.yaml") == (
        f"no such scene file; '{folder}' has no folder 'dta'; did you mean 'data'?"
    )
    assert (
        message(folder / "scene.yaml" / "a.yaml")
        == f"no such scene file; '{folder}/scene.yaml' is not a folder"
    )


def test_a_broken_link_is_named(folder: Path) -> None:
    (folder / "link.yaml").symlink_to(folder / "gone.yaml")
    assert message(folder / "link.yaml") == "no such scene file; it is a link to a file that is missing"


def test_a_folder_is_not_a_missing_file(folder: Path) -> None:
    expected = "cannot read the scene file: this is a folder, not a regular file"
    assert message(folder / "data") == expected


def test_a_file_without_permission_is_not_a_missing_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "open", refuse)  # root may read all files
    assert message(folder / "scene.yaml") == "cannot read the scene file: Permission denied"


@pytest.mark.parametrize("content", [b"", b" \n\t\n"])
def test_an_empty_file_is_named(folder: Path, content: bytes) -> None:
    (folder / "empty.yaml").write_bytes(content)
    assert message(folder / "empty.yaml") == "the scene file is empty"


def test_a_binary_file_is_not_a_text(folder: Path) -> None:
    (folder / "image.yaml").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR")
    assert message(folder / "image.yaml") == "this is a binary file, not a scene text file"


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "~nobody_of_this_name/x"])
def test_impossible_names_are_errors_too(folder: Path, name: str) -> None:
    assert missing_file(folder / name).startswith("no such file ")
    with pytest.raises(HumansimError):
        read_bytes(folder / name, HumansimError, "scene", 1 << 20)


@pytest.mark.parametrize(
    ("name", "kind", "meant"),
    [
        ("wlak", "motions", "walk"),
        ("adult_mann", "humans", "adult_man"),
        ("Adult-Man", "humans", "adult_man"),
    ],
)
def test_a_misspelt_built_in_is_recognised(name: str, kind: str, meant: str) -> None:
    with pytest.raises(
        HumansimError, match=rf"no built-in .* and no file '{name}'; did you mean '{meant}'\? There are"
    ):
        find_asset(name, kind)  # type: ignore[arg-type]


def test_an_unknown_word_that_resembles_nothing_gets_no_suggestion() -> None:
    assert did_you_mean("zzz", ["walk", "run"]) == ""


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("[1, -2.5, null]", [1, -2.5, None]),
        (str(2**63 - 1), 2**63 - 1),
        (str(-(2**63)), -(2**63)),
        (str(2**63), 2.0**63),
        ("1" + 300 * "0", 1e300),
        ("[" * 99 + "]" * 99, None),
    ],
)
def test_json_is_read_as_it_is_and_great_integers_as_floats(text: str, value: object) -> None:
    found = parse_json(text, HumansimError)
    assert value is None or (found == value and type(found) is type(value))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"a":\n 1,}', r"a\.json:2: not valid JSON: "),
        ("[" * 100_000 + "]" * 100_000, "more than 100 nested levels"),
        ("[" * 200 + "]" * 200, "more than 100 nested levels"),
        ('{"a":' * 200 + "1" + "}" * 200, "more than 100 nested levels"),
        ("9" * 400, r"the number 9999999999… \(400 characters\) is too large"),
        ("-" + "9" * 5000, "is too large"),
        ("1e400", "the number 1e400 is too large"),
        ("[NaN]", "NaN is no number of JSON"),
        ("-Infinity", "-Infinity is no number of JSON"),
        ("[" + "1," * 11 + "1]", "more than 10 values"),
    ],
)
def test_json_beyond_the_limits_is_refused(text: str, said: str) -> None:
    with pytest.raises(HumansimError, match=said):
        parse_json(text, HumansimError, "a.json", most=10 if "1,1" in text else 1_000_000)


def test_json_with_nan_is_read_where_numbers_are_checked(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"a": [NaN, Infinity]}')
    found = read_json(tmp_path / "a.json", HumansimError, "points", 100, nan=True)
    assert np.isnan(found["a"][0]) and found["a"][1] == np.inf
    with pytest.raises(HumansimError, match="too large"):
        read_json(tmp_path / "a.json", HumansimError, "points", 4)


def test_control_characters_are_escaped_in_every_part_of_a_message(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    error = HumansimError("is \x1b[31m\nred", path="a\u202eb.yaml", line=3, key="k\x07")
    assert str(error) == "a\\u202eb.yaml:3: k\\x07: is \\x1b[31m\nred"
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
        show_warnings()
        warn_about("a\u202eb.bvh", "odd")
    assert capsys.readouterr().err == "warning: a\\u202eb.bvh: odd\n"


def test_a_file_of_any_size_is_read_part_by_part(tmp_path: Path) -> None:
    """Empty ones, too; a pipe is refused, and not waited for."""
    path = tmp_path / "large.bin"
    content = bytes(range(256)) * (5 << 12)
    path.write_bytes(content)
    blocks = list(read_blocks(path, HumansimError, "export"))
    assert b"".join(blocks) == content and max(map(len, blocks)) <= 1 << 20
    path.write_bytes(b"")
    assert list(read_blocks(path, HumansimError, "export")) == []
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(HumansimError, match="this is a named pipe, not a regular file"):
        list(read_blocks(tmp_path / "pipe", HumansimError, "export"))


def test_located_gives_errors_a_place_only_where_they_have_none() -> None:
    with pytest.raises(MotionError) as found, located(MotionError, "b.bvh", line=3, key="rate"):
        raise MeshError("wrong", path="a.obj", line=0)
    assert (found.value.path, found.value.line, found.value.key) == ("a.obj", 0, "rate")
    with pytest.raises(MeshError) as kept, located(path="b.bvh"):
        raise MeshError("wrong", key="faces")
    assert str(kept.value) == "b.bvh: faces: wrong"
