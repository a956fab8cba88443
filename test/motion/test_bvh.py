"""BVH files: variants of the format, meaning of the channels, errors of broken files."""

from __future__ import annotations

import contextlib
import io
import itertools
import re
import tracemalloc
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import if_shared
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from stand_ins import motion_path

from humansim_ros.errors import HumansimError, HumansimWarning, MotionError
from humansim_ros.motion import Motion, read_bvh, write_bvh
from humansim_ros.motion.body.kinematics import CHANNEL_NAMES
from humansim_ros.motion.files.bvh import Parser
from humansim_ros.types import Array

GOOD = """HIERARCHY
ROOT Hips
{
  OFFSET 1 2 3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT Chest
  {
    OFFSET 0 10 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    End Site
    {
      OFFSET 0 5 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.04
4 5 6 10 20 30 40 50 60
7 8 9 -10 -20 -30 -40 -50 -60
"""
VALUES = [[4, 5, 6, 10, 20, 30, 40, 50, 60], [7, 8, 9, -10, -20, -30, -40, -50, -60]]

ROW = "4 5 6 10 20 30 40 50 60"
#: The hierarchy, and everything after it.
REST = GOOD[: GOOD.index("MOTION")], GOOD[GOOD.index("MOTION") :]
FLAT = "\n".join(map(str.strip, GOOD.splitlines())) + "\n"


def read(tmp_path: Path, text: str | bytes) -> Motion:
    path = tmp_path / "motion.bvh"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_bvh(path)


def one_joint(channels: str, values: str, offset: str = "0 0 0") -> str:
    return (
        f"HIERARCHY\nROOT a\n{{\nOFFSET {offset}\nCHANNELS {len(channels.split())} {channels}\n"
        f"End Site\n{{\nOFFSET 1 2 3\n}}\n}}\nMOTION\nFrames: 1\nFrame Time: 0.1\n{values}\n"
    )


# Meaning of the channels


def test_skeleton_and_values_are_those_of_the_file(tmp_path: Path) -> None:
    motion = read(tmp_path, GOOD)
    assert motion.joint_names == ("Hips", "Chest", "Chest_end")
    assert motion.parents.tolist() == [-1, 0, 1]
    assert motion.offsets.tolist() == [[1, 2, 3], [0, 10, 0], [0, 5, 0]]
    assert motion.channels == (
        ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation"),
        ("Zrotation", "Xrotation", "Yrotation"),
        (),
    )
    assert motion.values.tolist() == VALUES
    assert motion.frame_time == 0.04
    assert motion.duration == 0.04


@pytest.mark.parametrize("order", ["".join(o) for o in itertools.permutations("XYZ")] + ["XZ", "Y", "ZX"])
def test_rotation_channels_compose_in_file_order(tmp_path: Path, order: str) -> None:
    """SciPy's upper-case sequences rotate about the moving axes: R_1 R_2 R_3 on column vectors."""
    degrees = [25.0, -130.0, 77.0][: len(order)]
    text = one_joint(" ".join(f"{axis}rotation" for axis in order), " ".join(map(str, degrees)))
    motion = read(tmp_path, text)
    expected = Rotation.from_euler(order, degrees, degrees=True).as_matrix()
    transforms = motion.world_transforms(0)
    np.testing.assert_allclose(transforms[0, :3, :3], np.squeeze(expected), atol=1e-12)
    np.testing.assert_allclose(transforms[1, :3, 3], np.squeeze(expected) @ [1, 2, 3], atol=1e-12)


def test_position_is_outermost_wherever_its_channels_stand(tmp_path: Path) -> None:
    first = read(tmp_path, one_joint("Xposition Yposition Zposition Zrotation Xrotation", "7 8 9 30 40"))
    last = read(tmp_path, one_joint("Zrotation Xrotation Xposition Yposition Zposition", "30 40 7 8 9"))
    mixed = read(tmp_path, one_joint("Zposition Zrotation Xposition Xrotation Yposition", "9 30 7 40 8"))
    expected = Rotation.from_euler("ZX", [30, 40], degrees=True).apply([1, 2, 3]) + np.array([7, 8, 9])
    for motion in (first, last, mixed):
        np.testing.assert_allclose(motion.world_positions(0)[0], [7, 8, 9], atol=1e-12)
        np.testing.assert_allclose(motion.world_positions(0)[1], expected, atol=1e-12)


def test_an_axis_without_position_channel_keeps_its_offset(tmp_path: Path) -> None:
    motion = read(tmp_path, one_joint("Yposition Zrotation", "50 0", offset="1 2 3"))
    np.testing.assert_allclose(motion.world_positions(0)[0], [1, 50, 3])


def test_two_roots_are_two_trees(tmp_path: Path) -> None:
    tree = (
        "ROOT {0}\n{{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\n"
        "JOINT {0}1\n{{\nOFFSET 1 0 0\nCHANNELS 0\n}}\n}}\n"
    )
    rows = "MOTION\nFrames: 1\nFrame Time: 1\n1 2 3 4 5 6"
    text = "HIERARCHY\n" + tree.format("a") + tree.format("b") + rows
    motion = read(tmp_path, text)
    assert motion.parents.tolist() == [-1, 0, -1, 2]
    np.testing.assert_allclose(motion.world_positions(0), [[1, 2, 3], [2, 2, 3], [4, 5, 6], [5, 5, 6]])


def test_frames_are_indexed_by_number_slice_or_list(tmp_path: Path) -> None:
    motion = read(tmp_path, GOOD)
    every = motion.world_positions()
    assert every.shape == (2, 3, 3)
    np.testing.assert_array_equal(motion.world_positions(1), every[1])
    np.testing.assert_array_equal(motion.world_positions(slice(1, 2)), every[1:])
    np.testing.assert_array_equal(motion.world_positions([1, 0, 1]), every[[1, 0, 1]])


def test_an_unknown_joint_is_an_error_that_lists_the_joints(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match=r"no joint 'Hisp'.*Hips, Chest, Chest_end"):
        read(tmp_path, GOOD).joint("Hisp")


# Variants of the format

SPELLINGS = {
    "windows line ends": GOOD.replace("\n", "\r\n"),
    "old Mac line ends": GOOD.replace("\n", "\r"),
    "tabs": GOOD.replace("  ", "\t").replace(" ", "\t"),
    "blank lines": GOOD.replace("\n", "\n\n \t\n"),
    "no final newline": GOOD.rstrip(),
    "many final newlines": GOOD + "\n\n   \n",
    "scientific notation": GOOD.replace("4 5 6 10", "4e0 5.0E+00 +600e-2 1.0e+001"),
    "braces on the joint's line": GOOD.replace("\n{", " {").replace("\n  {", " {").replace("\n    {", "{"),
    "lower case keywords": GOOD.replace("HIERARCHY", "hierarchy")
    .replace("ROOT", "root")
    .replace("JOINT", "joint")
    .replace("CHANNELS", "channels")
    .replace("Xrotation", "XROTATION")
    .replace("OFFSET", "Offset")
    .replace("MOTION", "Motion")
    .replace("End Site", "END SITE"),
    "byte order mark": b"\xef\xbb\xbf" + GOOD.encode(),
    "tabs after the colon": GOOD.replace("Frames: ", "Frames:\t").replace("Time: ", "Time:\t"),
    "no space after the colon": GOOD.replace("Frames: ", "Frames:").replace("Time: ", "Time:"),
    "space before the colon": GOOD.replace("Frames:", "Frames :").replace("Time:", "Time  :"),
    "FrameTime": GOOD.replace("Frame Time", "FrameTime").replace("Frames", "FRAMES"),
    "End Site with a name": GOOD.replace("End Site", "End Site HeadTop"),
    "braces on the last line": GOOD.replace("}\n  }\n}\nMOTION", "} } }\nMOTION"),
    "tabs, form feeds and double spaces between values": GOOD.replace("4 5 6 10", " 4\t5\f6  10"),
    "numbers glued to a minus": GOOD.replace("-10 -20 -30 -40", "-10-20-30-40"),
    "no leading zero": GOOD.replace("0.04", ".04").replace(" 5 0\n", " 5. .0\n"),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_spellings_of_one_file_read_alike(tmp_path: Path, spelling: str) -> None:
    assert SPELLINGS[spelling] != GOOD
    expected, motion = read(tmp_path, GOOD), read(tmp_path, SPELLINGS[spelling])
    assert motion.joint_names == expected.joint_names
    assert motion.channels == expected.channels
    assert motion.offsets.tolist() == expected.offsets.tolist()
    assert motion.values.tolist() == VALUES
    assert motion.frame_time == 0.04


def test_exponents_are_not_split_into_two_numbers(tmp_path: Path) -> None:
    motion = read(tmp_path, GOOD.replace("4 5 6 10", "4e-1-5e-2 6 10"))
    assert motion.values[0, :4].tolist() == [0.4, -0.05, 6, 10]


NAMES = ["mixamorig:Hips", "l.hip-01", "Left  Hip 2", '"hip"', "hip's", "腰", "MOTION", "End", "OFFSET 1"]


@pytest.mark.parametrize("name", NAMES)
def test_names_are_kept_as_they_are(tmp_path: Path, name: str) -> None:
    motion = read(tmp_path, GOOD.replace("Chest", name))
    assert motion.joint_names == ("Hips", name, f"{name}_end")
    write_bvh(tmp_path / "out.bvh", motion)
    assert_same(read_bvh(tmp_path / "out.bvh"), motion)


def test_names_that_are_not_utf8_are_read_with_a_warning(tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match=r"motion.bvh:2: not UTF-8"):
        motion = read(tmp_path, GOOD.replace("Hips", "Hüfte").encode("latin-1"))
    assert motion.joint_names[0] == "Hüfte"


BROKEN_ROWS = {
    "two lines a frame": GOOD.replace("20 30", "20\n30").replace("-20 -30", "-20\n\n-30"),
    "frames on one line": GOOD.replace("60\n7", "60 7"),
    "each value on its line": GOOD[: GOOD.index("4 5")] + GOOD[GOOD.index("4 5") :].replace(" ", "\n"),
    "one frame broken": GOOD.replace("-20 -30", "-20\n-30"),
}


@pytest.mark.parametrize("layout", BROKEN_ROWS)
def test_frames_broken_over_lines_are_read_if_their_number_fits(tmp_path: Path, layout: str) -> None:
    with pytest.warns(HumansimWarning, match=r"motion\.bvh:\d+: not one frame on a line"):
        assert read(tmp_path, BROKEN_ROWS[layout]).values.tolist() == VALUES
    with pytest.raises(MotionError, match="a frame needs 9 values"):
        read(tmp_path, BROKEN_ROWS[layout].replace("Frames: 2", "Frames: 3"))


def test_lines_longer_than_a_block_are_read(tmp_path: Path) -> None:
    """Rows are read in blocks of characters that end anywhere on a line."""
    values = np.arange(100_000 * 9.0).reshape(2, -1)
    text = GOOD[: GOOD.index(ROW)].replace("Frames: 2", "Frames: 100000")
    lines = [" ".join(map(str, row)) for row in values]
    with pytest.warns(HumansimWarning, match="not one frame on a line"):
        motion = read(tmp_path, text + "\n".join(lines))
    np.testing.assert_array_equal(motion.values.ravel(), values.ravel())


@settings(deadline=None, max_examples=300)
@given(words=st.lists(st.text("0123456789+-.eE,x_", min_size=1, max_size=6), min_size=1, max_size=3))
def test_no_text_is_read_as_a_different_number(
    tmp_path_factory: pytest.TempPathFactory, words: list[str]
) -> None:
    """Any text in a row gives the numbers that Python reads one by one, or an error.

    Commas are points or white space in the whole file. Lines that are no numbers end the values.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)
        try:
            motion = read(tmp_path_factory.getbasetemp(), one_joint("Xrotation", "\n".join(words)))
        except MotionError:
            return
    assert motion.values.ravel().tolist() in [
        _numbers_before_text([word.replace(",", mark) for word in words]) for mark in (".", " ", ",")
    ]


def _numbers_before_text(lines: list[str]) -> list[float]:
    numbers: list[float] = []
    for line in lines:
        parts = [part for part in re.findall(r"-?[^-eE ]*(?:[eE]-?[^- ]*)?", line) if part]
        try:
            numbers += [float(part) for part in parts]
        except ValueError:
            # a damaged number is not the end of the rows
            return [np.nan] if re.match(r"[+-]?[.,]?\d", line) else numbers
    return numbers


def test_a_joint_without_channels_stays_at_its_offset(tmp_path: Path) -> None:
    text = GOOD.replace("CHANNELS 3 Zrotation Xrotation Yrotation", "CHANNELS 0").replace(" 40 50 60", "")
    motion = read(tmp_path, text.replace(" -40 -50 -60", ""))
    turn = Rotation.from_euler("ZXY", [10, 20, 30], degrees=True)
    np.testing.assert_allclose(
        motion.world_positions(0)[1], turn.apply([0, 10, 0]) + np.array([4, 5, 6]), atol=1e-12
    )


@pytest.mark.parametrize("stem", ["rootless", *if_shared("firepal_vr")])
def test_a_root_without_channels_can_be_read(stem: str) -> None:
    motion = read_bvh(motion_path(stem))
    assert motion.channels[0] == ()
    assert motion.n_frames > 1


@pytest.mark.parametrize("stem", ["rotation_first", *if_shared("pybvh_rotation_first_root")])
def test_rotation_before_position_at_the_root(stem: str) -> None:
    motion = read_bvh(motion_path(stem))
    assert [name[1:] for name in motion.channels[0]] == ["rotation"] * 3 + ["position"] * 3
    x, y, z = (motion.channels[0].index(f"{axis}position") for axis in "XYZ")
    np.testing.assert_array_equal(motion.world_positions()[:, 0], motion.values[:, [x, y, z]])


def test_more_rows_than_the_header_says_are_read_with_a_warning(tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match=r"motion.bvh: says 1 frames but has 2"):
        motion = read(tmp_path, GOOD.replace("Frames: 2", "Frames: 1"))
    assert motion.n_frames == 2


@pytest.mark.parametrize("count", ["0", "4", "9" * 5000])
def test_channel_names_decide_not_their_count(tmp_path: Path, count: str) -> None:
    with pytest.warns(HumansimWarning, match=rf"motion.bvh:9: CHANNELS says {count[:20]} but names 3"):
        motion = read(tmp_path, GOOD.replace("CHANNELS 3", f"CHANNELS {count}"))
    assert motion.values.tolist() == VALUES


def test_a_header_with_a_billion_frames_allocates_nothing(tmp_path: Path) -> None:
    tracemalloc.start()
    with pytest.warns(HumansimWarning, match="says 1e\\+09 frames but has 2"):
        read(tmp_path, GOOD.replace("Frames: 2", "Frames: 1000000000"))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 5e6


def test_a_file_without_motion_is_a_static_pose(tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match="no MOTION section"):
        motion = read(tmp_path, GOOD[: GOOD.index("MOTION")])
    assert motion.n_frames == 1


def test_more_joints_than_any_person_has_are_refused_with_the_line(tmp_path: Path) -> None:
    joint = "JOINT a\n{\nOFFSET 0 1 0\nCHANNELS 0\n}\n"
    text = "HIERARCHY\nROOT r\n{\nOFFSET 0 0 0\nCHANNELS 0\n" + joint * 21_000 + "}\n"
    with pytest.raises(MotionError, match="more than 20000 joints and end sites") as caught:
        read(tmp_path, text)
    assert caught.value.line == 5 + 5 * 19_999 + 1


def test_a_chain_of_ten_thousand_joints_is_read_and_posed(tmp_path: Path) -> None:
    depth = 10_000
    lines = ["HIERARCHY"]
    for joint in range(depth):
        lines += [f"{'JOINT' if joint else 'ROOT'} j{joint}", "{", "OFFSET 0 1 0", "CHANNELS 1 Zrotation"]
    lines += ["}"] * depth + ["MOTION", "Frames: 1", "Frame Time: 1", " ".join(["90"] + ["0"] * (depth - 1))]
    motion = read(tmp_path, "\n".join(lines))
    assert motion.n_joints == depth
    np.testing.assert_allclose(motion.world_positions(0)[-1], [-(depth - 1), 1, 0], atol=1e-6)


# Faults with a clear meaning: (fault, file, line of the warning, part of the message)

LENIENT: list[tuple[str, str | bytes, int, str]] = [
    ("End with a name", GOOD.replace("End Site", "End head_End"), 10, "'End head_End' is read as 'End Site'"),
    ("End without a name", GOOD.replace("End Site", "End"), 10, "'End' is read as"),
    ("EndSite", GOOD.replace("End Site", "EndSite"), 10, "is read as 'End Site'"),
    ("no HIERARCHY", GOOD.replace("HIERARCHY\n", ""), 1, "HIERARCHY is missing"),
    ("no MOTION", GOOD.replace("MOTION\n", ""), 16, "MOTION is missing"),
    ("no Frames", GOOD.replace("Frames: 2\n", ""), 18, "'Frames:' is missing before this line"),
    ("no Frame Time first", GOOD.replace("Frames: 2\nFrame Time: 0.04", "Frame Time: 0.04"), 18, "'Frames:'"),
    ("Frames without a colon", GOOD.replace("Frames:", "Frames"), 17, "'Frames' without a colon"),
    ("Frame Time without a colon", GOOD.replace("Time:", "Time"), 18, "'Frame Time' without a colon"),
    ("text after the rows", GOOD + "end of file\n", 21, "'end' on is not part of the motion"),
    ("a brace after the rows", GOOD + "}\n", 21, "'}' on is not part"),
    ("the end of file of old systems", GOOD + "\x1a", 21, "is not part of the motion"),
    ("zero bytes after the rows", GOOD.encode() + b"\0" * 512, 21, "is not part of the motion"),
    ("a second motion after the rows", GOOD + GOOD, 21, "'HIERARCHY' on is not part"),
    ("text after rows that nothing counts", GOOD.replace("Frames: 2\n", "") + "the end\n", 20, "'the' on is"),
    ("decimal commas in rows", GOOD.replace("20 30 40", "20,0 30 40,00"), 19, "commas are read as decimal"),
    ("decimal commas in OFFSETs", GOOD.replace("OFFSET 0 10 0", "OFFSET 0,0 10,0 0,0"), 8, "as decimal"),
    ("a decimal comma in the frame time", GOOD.replace("0.04", "0,04"), 18, "as decimal points"),
    ("commas between numbers", GOOD.replace(ROW, ROW.replace(" ", ",")), 19, "as white space"),
    ("commas and spaces", GOOD.replace(ROW, ROW.replace(" ", ", ")), 19, "as white space"),
    ("commas and points", GOOD.replace(ROW, ROW.replace(" ", ".0,")), 19, "as white space"),
    ("commas in OFFSETs", GOOD.replace("OFFSET 0 10 0", "OFFSET 0.0,10.0, 0.0"), 8, "as white space"),
    ("a rotation in OFFSETs", GOOD.replace("OFFSET 0 10 0", "OFFSET 0 10 0 9 0 -9e-1"), 8, "are not used"),
    ("commas in CHANNELS", GOOD.replace("3 Zrotation X", "3, Zrotation, X"), 9, "after CHANNELS"),
    ("last brace missing", GOOD.replace("}\nMOTION", "MOTION"), 15, "1 '}' missing at the end"),
    ("last braces missing", GOOD.replace("  }\n}\nMOTION", "MOTION"), 14, "2 '}' missing at the end"),
    ("one brace too many", GOOD.replace("}\nMOTION", "}\n}\nMOTION"), 16, "without a matching '{'"),
    ("a byte order mark and a name in Latin-1", b"\xef\xbb\xbf" + GOOD.replace("End Site", "End \xe9").encode(
        "latin-1"), 10, "not UTF-8"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "line", "message"), [x[1:] for x in LENIENT], ids=[x[0] for x in LENIENT])
def test_a_fault_with_a_clear_meaning_is_read_with_file_and_line(
    tmp_path: Path, text: str | bytes, line: int, message: str
) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read(tmp_path, text)
    assert all(issubclass(w.category, HumansimWarning) for w in caught)
    start = f"{tmp_path / 'motion.bvh'}:{line}: "
    assert any(str(w.message).startswith(start) and message in str(w.message) for w in caught), caught
    assert motion.joint_names == ("Hips", "Chest", "Chest_end")
    assert motion.parents.tolist() == [-1, 0, 1]
    assert motion.offsets.tolist() == [[1, 2, 3], [0, 10, 0], [0, 5, 0]]
    assert motion.values.tolist() == VALUES
    assert motion.frame_time == 0.04


def test_a_frame_time_that_is_missing_is_that_of_30_frames_per_second(tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match=r"motion\.bvh:18: 'Frame Time:' is missing"):
        assert read(tmp_path, GOOD.replace("Frame Time: 0.04\n", "")).frame_time == 1 / 30
    with pytest.warns(HumansimWarning, match=r"motion\.bvh:16: 'Frames:' is missing"):
        assert read(tmp_path, REST[0] + "\n".join(GOOD.splitlines()[-2:])).values.tolist() == VALUES


def test_words_are_missing_in_a_real_file(shared_data: Path) -> None:
    with pytest.warns(HumansimWarning, match="adakri_run.bvh:185: the word MOTION is missing"):
        assert read_bvh(shared_data / "bvh" / "adakri_run.bvh").n_frames == 59
    with pytest.warns(HumansimWarning, match="walkSit.bvh:26: 'End l_toes_End_dup' is read"):
        assert read_bvh(shared_data / "bvh" / "tomboudard_walkSit.bvh").n_frames == 122


@pytest.mark.parametrize("mark", [".", ","])
def test_commas_in_many_blocks_are_read_as_one_kind(tmp_path: Path, mark: str) -> None:
    rows = np.random.default_rng(3).normal(scale=90, size=(3000, 9)).round(4)
    between = "," if mark == "." else "\t"
    lines = [between.join(repr(value).replace(".", mark) for value in row) for row in rows.tolist()]
    with pytest.warns(HumansimWarning, match=r"motion\.bvh:19: commas are read as") as caught:
        motion = read(tmp_path, GOOD[: GOOD.index(ROW)].replace(" 2\n", " 3000\n") + "\n".join(lines))
    assert len(caught) == 1
    np.testing.assert_array_equal(motion.values, rows)


# Bad input: (fault, file, line of the error, part of the message)

#: A root with two joints.
TWO = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 3 Xrotation Yrotation Zrotation
  JOINT A
  {
    OFFSET 0 1 0
  }
  JOINT B
  {
    OFFSET 0 2 0
    JOINT C
    {
      OFFSET 0 3 0
    }
    JOINT D
    {
      OFFSET 0 4 0
    }
  }
}
MOTION
Frames: 1
Frame Time: 1
1 2 3
"""
BROKEN: list[tuple[str, str | bytes, int | None, str]] = [
    ("empty", "", None, "empty"),
    ("only blanks", " \n\t\n", None, "empty"),
    ("only a byte order mark", b"\xef\xbb\xbf", None, "empty"),
    ("binary", b"\x7fELF\0\0\1\2", None, "binary"),
    ("another format", "# Wavefront\nv 1 2 3\n", 2, "HIERARCHY"),
    ("truncated after HIERARCHY", "HIERARCHY\n", 1, "no joints"),
    ("truncated after a joint's name", GOOD[: GOOD.index("{")], 2, "truncated"),
    ("truncated in the hierarchy", GOOD[: GOOD.index("    End Site")], 9, "truncated"),
    ("truncated in an OFFSET", GOOD[: GOOD.index(" 2 3")], 4, "OFFSET"),
    ("truncated in CHANNELS", GOOD[: GOOD.index("otation")], 5, "CHANNELS needs"),
    ("truncated after MOTION", GOOD[: GOOD.index("Frames")], 16, "truncated"),
    ("truncated after Frames", GOOD[: GOOD.index("Frame Time")], 17, "truncated"),
    ("truncated before the rows", GOOD[: GOOD.index(ROW)], 18, "truncated"),
    ("truncated in a row", GOOD.rstrip()[:-8], 20, "truncated"),
    ("brace without a joint", GOOD.replace("ROOT Hips\n{", "{"), 2, "without a joint"),
    ("joint without a brace", GOOD.replace("Hips\n{", "Hips"), 3, "cannot understand"),
    ("text after a name", GOOD.replace("JOINT Chest", "JOINT Chest\nfoo"), 6, "understand 'foo' after"),
    ("joint without a name", GOOD.replace("JOINT Chest", "JOINT"), 6, "without a name"),
    ("endless name", GOOD.replace("Chest", "C" * 1001), 6, "more than 1000 characters"),
    ("JOINT outside a ROOT", GOOD.replace("ROOT", "JOINT"), 2, "does not belong"),
    ("joint without an OFFSET", GOOD.replace("    OFFSET 0 10 0\n", ""), 13, "'Chest' has no OFFSET"),
    ("OFFSET of two numbers", GOOD.replace("OFFSET 0 10 0", "OFFSET 0 10"), 8, "three"),
    ("OFFSET that is no number", GOOD.replace("OFFSET 0 10 0", "OFFSET 0 ten 0"), 8, "0 ten 0"),
    ("OFFSET that is NaN", GOOD.replace("OFFSET 0 10 0", "OFFSET 0 nan 0"), 8, "finite"),
    ("unknown channel", GOOD.replace("3 Zrotation", "3 Wrotation"), 9, "Wrotation"),
    ("channel count in a superscript", GOOD.replace("CHANNELS 3", "CHANNELS ³"), 9, "CHANNELS needs"),
    ("a number as only Python has it", GOOD.replace("20 30", "2_0 30"), 19, "'2_0'"),
    ("same channel twice", GOOD.replace("3 Zrotation", "3 Xrotation"), 9, "CHANNELS needs"),
    ("negative frame time", GOOD.replace("0.04", "-0.04"), 18, "above zero"),
    ("endless frame time", GOOD.replace("0.04", "1e300"), 18, "below a million"),
    ("frame time that is no number", GOOD.replace("0.04", "fast"), 18, "'fast'"),
    ("frame time that is NaN", GOOD.replace("0.04", "nan"), 18, "number"),
    ("Frames that is no number", GOOD.replace("Frames: 2", "Frames: two"), 17, "'two'"),
    ("a value too few", GOOD.replace(ROW, ROW[:-3]), 19, "needs 9 values, this has 8"),
    ("a value too many", GOOD.replace(ROW, ROW + " 1"), 19, "needs 9 values, this has 10"),
    (
        "one row's value in the next",
        GOOD.replace("50 60\n7", "50\n60 7"),
        19,
        "needs 9 values, this has 8",
    ),
    ("a word", GOOD.replace("20 30 40", "20 thirty 40"), 19, "'thirty'"),
    ("a comma beside points", GOOD.replace("20 30 40", "20,5 3.5 40"), 19, "needs 9 values, this has 10"),
    ("commas of both kinds", GOOD.replace("20 30 40", "2,5 30,5 4,0,0"), 19, "needs 9 values, this has 13"),
    ("comma without a digit", GOOD.replace("20 30 40", "20 ,5 40"), 19, "',5' is not a number; decimals"),
    ("commas of both kinds in an OFFSET", GOOD.replace("OFFSET 0 10 0", "OFFSET 0,1,5 0"), 8, "three finite"),
    ("thousands in the frame time", GOOD.replace("0.04", "1,234.5"), 18, "'1,234.5'"),
    ("missing brace in the middle", TWO.replace("  }\n  JOINT", "  JOINT"), 22, "'}' is missing"),
    ("surplus brace in the middle", TWO.replace("0 3 0\n", "0 3 0\n    }\n"), 23, "without a matching"),
    ("missing brace without indents", FLAT.replace("}\nMOTION", "MOTION"), 15, "'}' is missing"),
    ("one brace too many without indents", FLAT.replace("}\nMOTION", "}\n}\nMOTION"), 16, "without a match"),
    ("a row that is no row", GOOD.replace("7 8", "seven 8"), 20, "'seven' is not a number"),
    ("rows after text", GOOD.replace("\n7 8", "\ntext\n7 8"), 20, "'text' is not a number"),
    ("text without rows", GOOD[: GOOD.index(ROW)] + "nothing here", 19, "'nothing' is not a number"),
    ("text after a part of a row", GOOD.replace(ROW, "4 5 6\nend"), 19, "needs 9 values, this has 3"),
    ("rows without MOTION of other width", REST[0] + "4 5 6\n", 16, "needs 9 values, this has 3"),
    ("a second OFFSET", GOOD.replace("OFFSET 0 10 0", "OFFSET 0 10 0\nOFFSET 0 1 0"), 9, "second OFFSET"),
    ("a second CHANNELS", GOOD.replace("CHANNELS 3", "CHANNELS 0\nCHANNELS 3"), 10, "second CHANNELS"),
    (
        "joints in an End Site",
        GOOD.replace("0 5 0", "0 5 0\nJOINT a\n{\nOFFSET 0 0 0\n}"),
        13,
        "inside an End",
    ),
    (
        "a value without channels",
        "HIERARCHY\nROOT a\n{\nOFFSET 0 0 0\n}\nMOTION\nFrames: 1\nFrame Time: 1\n2",
        9,
        "no joint has channels",
    ),
    ("two points in a number", GOOD.replace("10 20 30", "10 20.5.5"), 19, "'20.5.5'"),
    ("NaN", GOOD.replace("20 30 40", "20 nan 40"), 19, "not finite"),
    ("infinity", GOOD.replace("20 30 40", "20 -inf 40"), 19, "not finite"),
    ("a number like no measure", GOOD.replace("20 30 40", "20 1e200 40"), 19, "beyond 1e+15"),
    ("overflow", GOOD.replace("20 30 40", "20 1e999 40"), 19, "not finite"),
]


@pytest.mark.parametrize(("text", "line", "message"), [b[1:] for b in BROKEN], ids=[b[0] for b in BROKEN])
def test_broken_file_is_an_error_with_file_and_line(
    tmp_path: Path, text: str | bytes, line: int | None, message: str
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", HumansimWarning)
        with pytest.raises(MotionError) as caught:
            read(tmp_path, text)
    assert caught.value.path == str(tmp_path / "motion.bvh")
    assert caught.value.line == line
    assert message in caught.value.message
    where = str(tmp_path / "motion.bvh") + (f":{line}" if line else "")
    assert str(caught.value).startswith(f"{where}: ")


def test_missing_file_and_folder_are_errors(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match=r"nowhere\.bvh: no such BVH motion file"):
        read_bvh(tmp_path / "nowhere.bvh")
    with pytest.raises(MotionError, match="folder"):
        read_bvh(tmp_path)


@settings(deadline=None, max_examples=150)
@given(cut=st.integers(0, len(GOOD)), junk=st.binary(max_size=8))
def test_any_damage_gives_a_motion_or_a_motion_error(
    tmp_path_factory: pytest.TempPathFactory, cut: int, junk: bytes
) -> None:
    folder = tmp_path_factory.getbasetemp()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)
        for text in (GOOD[:cut].encode() + junk, GOOD[:cut].encode() + junk + GOOD[cut:].encode()):
            with contextlib.suppress(MotionError):
                assert np.isfinite(read(folder, text).world_positions()).all()


# Writing

numbers = st.floats(-1e4, 1e4).map(lambda x: round(x, 6))


@st.composite
def motions(draw: st.DrawFn) -> Motion:
    """Trees in the order in which a file lists them, with any channels."""
    names, parents, channels = ["j0"], [-1], [draw(st.permutations(CHANNEL_NAMES))[: draw(st.integers(1, 6))]]
    open_joints = [0]
    for joint in range(1, draw(st.integers(1, 7))):
        del open_joints[draw(st.integers(1, len(open_joints))) :]
        parent = open_joints[-1]
        is_end = f"{names[parent]}_end" not in names and draw(st.booleans())
        names.append(f"{names[parent]}_end" if is_end else f"j{joint}")
        parents.append(parent)
        channels.append([] if is_end else draw(st.permutations(CHANNEL_NAMES))[: draw(st.integers(0, 6))])
        if not is_end:
            open_joints.append(joint)
    width = sum(map(len, channels))
    offsets = draw(
        st.lists(st.lists(numbers, min_size=3, max_size=3), min_size=len(names), max_size=len(names))
    )
    rows = draw(st.lists(st.lists(numbers, min_size=width, max_size=width), min_size=1, max_size=3))
    return Motion(
        joint_names=tuple(names),
        parents=np.array(parents),
        offsets=np.array(offsets),
        channels=tuple(map(tuple, channels)),
        values=np.array(rows),
        frame_time=draw(st.floats(1e-4, 1.0)),
    )


def assert_same(ours: Motion, expected: Motion) -> None:
    assert ours.joint_names == expected.joint_names
    assert ours.channels == expected.channels
    assert ours.parents.tolist() == expected.parents.tolist()
    np.testing.assert_array_equal(ours.offsets, expected.offsets)
    np.testing.assert_array_equal(ours.values, expected.values)
    assert ours.frame_time == expected.frame_time


@pytest.mark.filterwarnings("ignore:.*read it with positions='replace'")
@settings(deadline=None, max_examples=60)
@given(motion=motions())
def test_a_written_motion_reads_back_the_same(
    tmp_path_factory: pytest.TempPathFactory, motion: Motion
) -> None:
    path = tmp_path_factory.getbasetemp() / "written.bvh"
    write_bvh(path, motion)
    assert_same(read_bvh(path, "replace"), motion)
    # added positions are written as their sums with the OFFSETs
    write_bvh(path, replace(motion, positions="add"))
    again = read_bvh(path, "replace")
    np.testing.assert_allclose(
        again.world_positions(), replace(motion, positions="add").world_positions(), atol=1e-9
    )


@pytest.mark.parametrize(
    "stem",
    [
        *("own_mixamo", "own_z_up", "own_humanik", "own_all_channels", "rootless"),
        *if_shared("mixamo_freebvh", "pybvh_test1", "firepal_vr", "bvhtoolbox_walk01"),
    ],
)
def test_a_motion_of_another_program_written_and_read_is_the_same(tmp_path: Path, stem: str) -> None:
    motion = read_bvh(motion_path(stem))
    write_bvh(tmp_path / "out.bvh", motion)
    assert_same(read_bvh(tmp_path / "out.bvh"), motion)


@settings(deadline=None, max_examples=30)
@given(motion=motions(), data=st.data())
def test_the_order_of_rotation_channels_changes_numbers_only(motion: Motion, data: st.DataObject) -> None:
    """The same local rotations in other Euler orders, by SciPy: the same world positions."""
    channels, columns = [], []
    start = 0
    for names in motion.channels:
        values = motion.values[:, start : start + len(names)]
        start += len(names)
        order = [n[0] for n in names if n.endswith("rotation")]
        positions = [n for n in names if n.endswith("position")]
        kept = values[:, [names.index(n) for n in positions]]
        if len(order) < 3:
            channels.append((*positions, *(n for n in names if n.endswith("rotation"))))
            turns = values[:, [i for i, n in enumerate(names) if n.endswith("rotation")]]
        else:
            degrees = values[:, [i for i, n in enumerate(names) if n.endswith("rotation")]]
            other = data.draw(st.permutations("XYZ"))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # at a pole one of the angles is free
                turns = Rotation.from_euler("".join(order), degrees, degrees=True).as_euler(
                    "".join(other), degrees=True
                )
            channels.append((*positions, *(f"{axis}rotation" for axis in other)))
        columns += [kept, turns]
    changed = replace(motion, channels=tuple(channels), values=np.concatenate(columns, axis=1))
    scale = 1 + np.abs(motion.world_positions()).max()
    np.testing.assert_allclose(changed.world_positions(), motion.world_positions(), atol=1e-6 * scale)


def test_joints_of_one_name_are_numbered_with_a_warning(tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match=r"motion\.bvh:6: a second joint is named 'Hips'"):
        motion = read(tmp_path, GOOD.replace("Chest", "Hips"))
    assert motion.joint_names == ("Hips", "Hips.001", "Hips.001_end")
    with pytest.warns(HumansimWarning, match="is called 'Chest_end.001'"):
        assert read(tmp_path, GOOD.replace("Hips", "Chest_end")).joint_names[2] == "Chest_end.001"


def test_a_file_of_no_frames_is_a_static_pose(tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match="static pose"):
        motion = read(tmp_path, GOOD[: GOOD.index(ROW)].replace("Frames: 2", "Frames: 0"))
    np.testing.assert_array_equal(motion.world_positions(0), motion.rest_positions())


def test_a_chain_of_ten_thousand_joints_is_written_small(tmp_path: Path) -> None:
    depth = 10_000
    chain = Motion(
        tuple(f"j{n}" for n in range(depth)),
        np.arange(depth) - 1,
        np.tile([0.0, 1.0, 0.0], (depth, 1)),
        (("Zrotation",),) * depth,
        np.zeros((1, depth)),
        0.1,
    )
    write_bvh(tmp_path / "chain.bvh", chain)
    assert (tmp_path / "chain.bvh").stat().st_size < 3_000_000
    assert_same(read_bvh(tmp_path / "chain.bvh"), chain)


@pytest.mark.daily("1200")
@pytest.mark.slow
@pytest.mark.parametrize("n_frames", [120, 1_200, 12_000])
def test_reading_takes_less_than_three_times_the_memory_of_the_values(tmp_path: Path, n_frames: int) -> None:
    """Peak of Python's and NumPy's allocations while a file is read, 18 MB of text for 9 MB of values."""
    rows = np.random.default_rng(1).normal(scale=90, size=(n_frames, 90))
    joint = "JOINT j{}\n{{\nOFFSET 0 1 0\nCHANNELS 3 Xrotation Yrotation Zrotation\n}}\n"
    head = GOOD[: GOOD.rindex("}")] + "".join(joint.format(n) for n in range(27))
    body = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    path = tmp_path / "big.bvh"
    path.write_text(f"{head}}}\nMOTION\nFrames: {n_frames}\nFrame Time: 0.01\n{body}\n")
    del body
    tracemalloc.start()
    motion = read_bvh(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_array_equal(motion.values, rows)
    assert peak < 3 * rows.nbytes


WALK = """HIERARCHY
ROOT Hips
{
  OFFSET 173.4 91.9 -518.3
  CHANNELS 6 Xposition Yposition Zposition Zrotation Yrotation Xrotation
  JOINT Leg
  {
    OFFSET 0 -90 0
    CHANNELS 3 Zrotation Xrotation Yrotation
  }
}
MOTION
Frames: 200
Frame Time: 0.04
"""


def test_a_walk_across_the_origin_has_no_added_positions(tmp_path: Path) -> None:
    """The OFFSET of LaFAN1's roots is the start of the motion, far away on the floor."""
    time = np.linspace(0, 1, 200)
    way = np.stack([-300 * time + 173.4, 90 + np.sin(40 * time), 1000 * time - 518.3], axis=-1)
    for shift, expected in ((0.0, "replace"), (-91.9, "add")):
        rows = np.concatenate([way + np.array([0, shift, 0]), np.zeros((200, 6))], axis=1)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", HumansimWarning)
            motion = read(tmp_path, WALK + "\n".join(" ".join(map(str, row)) for row in rows))
        assert motion.positions == expected


@pytest.mark.daily("0.97")
@pytest.mark.parametrize("where", [0.1, 0.97])
def test_a_fault_far_down_a_big_file_names_its_line(tmp_path: Path, where: float) -> None:
    """Rows are read in blocks of bytes: lines must be counted over all of them."""
    line = int(where * 200_000)
    rows = [ROW] * 200_000
    rows[line] = ROW.replace("30", "3O")
    with pytest.warns(HumansimWarning, match=f"bvh:{19 + line}: '3O' is not a number: a frame is put in its"):
        motion = read(tmp_path, GOOD[: GOOD.index(ROW)] + "\n".join(rows))
    assert (motion.values == VALUES[0]).all()
    assert motion.n_frames == 200_000


# Bad rows

MANY = 300


def many_rows(frames: int = MANY) -> list[str]:
    """Rows that change steadily; angles pass 180 degrees."""
    return [
        " ".join(f"{(value + 170) % 360 - 180:g}" if channel > 2 else f"{value:g}" for channel in range(9))
        for value in range(frames)
    ]


def with_rows(rows: list[str], frames: int | None = None) -> str:
    return (
        GOOD[: GOOD.index(ROW)].replace("Frames: 2", f"Frames: {frames or len(rows)}")
        + "\n".join(rows)
        + "\n"
    )


#: What becomes of a row.
BAD_ROWS: dict[str, tuple[Callable[[str], str], str]] = {
    "a value too few": (lambda row: row.rsplit(" ", 1)[0], "a frame needs 9 values, this has 8"),
    "a value too many": (lambda row: row + " 7", "a frame needs 9 values, this has 10"),
    "all but one value lost": (lambda row: row[:1], "a frame needs 9 values, this has 1"),
    "a stray letter": (lambda row: row.replace(" ", " x", 1), "'x1[45]0' is not a number"),
    "a letter of its own": (lambda row: row + " x", "'x' is not a number"),
    "not a number": (lambda row: row.rsplit(" ", 1)[0] + " nan", "'nan' is not finite"),
    "a huge number": (lambda row: row.rsplit(" ", 1)[0] + " 1e99", "'1e99' is not finite, or beyond 1e[+]15"),
    "a line of junk": (lambda _: "@@ lost marker @@", "'@@' is not a number"),
    "a decimal comma": (lambda row: row + ",5.5", "a frame needs 9 values, this has 10"),
}


@pytest.mark.parametrize("fault", BAD_ROWS)
def test_a_bad_row_becomes_the_frame_between_its_neighbours(tmp_path: Path, fault: str) -> None:
    damage, reason = BAD_ROWS[fault]
    good = read(tmp_path, with_rows(many_rows())).values
    rows = many_rows()
    for line in (140, 150):  # angles jump from 179 to -180 there
        rows[line] = damage(rows[line])
    with pytest.warns(
        HumansimWarning, match=rf"bvh:159: {reason}.*: a frame is put.*so in line 169"
    ) as caught:
        values = read(tmp_path, with_rows(rows)).values
    assert sum("a frame is put" in str(each.message) for each in caught) == 1
    assert len(values) == MANY
    np.testing.assert_allclose((values - good + 180) % 360 - 180, 0, atol=1e-9)


def test_two_bad_rows_in_succession_are_both_filled(tmp_path: Path) -> None:
    rows = many_rows()
    rows[40] = rows[41] = "1 2 3"
    with pytest.warns(HumansimWarning, match="so in line 60"):
        values = read(tmp_path, with_rows(rows)).values
    np.testing.assert_allclose(values[39:43, 0], [39, 40, 41, 42])


def test_a_value_that_slid_into_the_next_line_costs_two_frames(tmp_path: Path) -> None:
    rows = many_rows()
    rows[40], last = rows[40].rsplit(" ", 1)
    rows[41] = f"{last} {rows[41]}"
    with pytest.warns(HumansimWarning, match="bvh:59: a frame needs 9 values, this has 8"):
        values = read(tmp_path, with_rows(rows)).values
    np.testing.assert_allclose(values[:, 0], np.arange(MANY))


def test_where_the_angles_jump_a_pose_is_held(tmp_path: Path) -> None:
    """Between two descriptions of a rotation, means are no pose."""
    rows = [ROW] * 100 + [ROW.replace("10 20 30", "-170 160 -150")] * 100
    rows[100] = "1 2"
    with pytest.warns(HumansimWarning, match="this has 2"):
        values = read(tmp_path, with_rows(rows)).values
    assert values[100].tolist() in (values[99].tolist(), values[101].tolist())


def test_the_first_row_is_held_and_the_last_left_out(tmp_path: Path) -> None:
    rows = many_rows()
    rows[0] = rows[-1] = "1 2 3"
    with pytest.warns(HumansimWarning) as caught:
        values = read(tmp_path, with_rows(rows)).values
    texts = " ".join(str(each.message) for each in caught)
    assert "bvh:19: a frame needs 9 values, this has 3: a frame is put" in texts
    assert "bvh:318: a frame needs 9 values, this has 3: the line is left out" in texts
    np.testing.assert_array_equal(values[0], values[1])
    assert values[-1, 0] == MANY - 2


@pytest.mark.parametrize("n_texts", [1, 3])
def test_text_between_the_rows_is_no_frame(tmp_path: Path, n_texts: int) -> None:
    rows = many_rows()
    rows[100:100] = ["take 2"] * n_texts
    with pytest.warns(HumansimWarning, match="bvh:119: 'take' is not a number: the line is left out"):
        values = read(tmp_path, with_rows(rows, MANY)).values
    np.testing.assert_allclose(values[:, 0], np.arange(MANY))


def test_the_number_of_frames_tells_how_many_frames_a_text_hides(tmp_path: Path) -> None:
    rows = many_rows()
    rows[100:103] = ["lost"] * 3
    with pytest.warns(HumansimWarning, match="bvh:119: 'lost' is not a number: a frame is put in its place"):
        values = read(tmp_path, with_rows(rows)).values
    np.testing.assert_allclose(values[:, 0], np.arange(MANY))


@pytest.mark.parametrize(("n_bad", "fits"), [(3, True), (4, False)])
def test_more_than_one_percent_of_bad_rows_are_refused(tmp_path: Path, n_bad: int, fits: bool) -> None:
    rows = many_rows()
    for line in range(20, 20 + 7 * n_bad, 7):
        rows[line] += " x"
    text = with_rows(rows)
    if fits:
        with pytest.warns(HumansimWarning, match="bvh:39: 'x' is not a number"):
            read(tmp_path, text)
        return
    with pytest.raises(MotionError, match="4 of 300 rows are bad, more than 1%") as caught:
        read(tmp_path, text)
    assert caught.value.line == 39


def test_nothing_but_bad_rows_is_refused_early(tmp_path: Path) -> None:
    """The claimed number of frames does not let the reader go on for long."""
    read_lines = []

    class Counted(io.StringIO):
        def read(self, size: int | None = -1) -> str:
            read_lines.append(size)
            return super().read(size)

    for row in ("1 2 x 4 5 6 7 8 9\n", "1 2 3 4\n"):
        read_lines.clear()
        header = GOOD[: GOOD.index(ROW)].replace("Frames: 2", "Frames: 1e12")
        with pytest.raises(MotionError, match=r"needs 9 values|is not a number"):
            Parser("motion.bvh", Counted(header + row * 400_000)).parse()
        assert len(read_lines) < 100


def test_a_motion_that_cannot_be_read_back_is_not_written(tmp_path: Path) -> None:
    motion = read(tmp_path, GOOD)
    for name in ("", " a", "a{", "a\nb", "a\0", "\udcff"):
        with pytest.raises(MotionError, match="cannot have a joint named"):
            write_bvh(tmp_path / "out.bvh", replace(motion, joint_names=(name, *motion.joint_names[1:])))
    with pytest.raises(MotionError, match="two joints"):
        write_bvh(tmp_path / "out.bvh", replace(motion, joint_names=("Chest", *motion.joint_names[1:])))
    with pytest.raises(MotionError, match="not finite"):
        write_bvh(tmp_path / "out.bvh", replace(motion, values=motion.values * np.nan))
    with pytest.raises(MotionError, match="frame time"):
        write_bvh(tmp_path / "out.bvh", replace(motion, frame_time=0.0))
    with pytest.warns(HumansimWarning, match="read it with positions='replace'"):
        write_bvh(tmp_path / "out.bvh", replace(motion, values=motion.values * 0))


@pytest.mark.parametrize(
    ("parents", "message"),
    [((1, 0), "the joints Hips, Chest are their own ancestors"), ((-1, 1), "Chest are their own ancestors")],
)
def test_a_motion_is_a_tree(tmp_path: Path, parents: tuple[int, int], message: str) -> None:
    motion = read(tmp_path, GOOD)
    changed = np.array([*parents, *motion.parents[2:]])
    with pytest.raises(MotionError, match=message):
        replace(motion, parents=changed)


def test_a_motion_has_parents_before_their_children(tmp_path: Path) -> None:
    motion = read(tmp_path, GOOD)
    with pytest.raises(MotionError, match="joint 'Hips' is before its parent 'Chest'"):
        replace(motion, parents=np.array([1, -1, *motion.parents[2:]]))


def test_bvhio_reads_written_files(tmp_path: Path) -> None:
    bvhio = pytest.importorskip("bvhio")
    write_bvh(tmp_path / "out.bvh", read(tmp_path, GOOD))
    root = bvhio.readAsHierarchy(str(tmp_path / "out.bvh"))
    root.loadPose(1)
    theirs: dict[str, Array] = {j.Name: np.array(j.PositionWorld) for j, _, _ in root.layout()}
    ours = read(tmp_path, GOOD).world_positions(1)
    np.testing.assert_allclose(theirs["Chest"], ours[1], atol=1e-5)


def test_a_write_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    motion = read(tmp_path, GOOD)
    (tmp_path / "folder").mkdir()
    with pytest.raises(HumansimError, match="cannot be written"):
        write_bvh(tmp_path / "folder", motion)  # a folder of that name is in the way
    assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "motion.bvh"]
