"""BVH files as strangers write them: comments, broken lines, encodings, people, missing arms and rates."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion_files import stand_in, walk

from humansim_ros.cli.main import main
from humansim_ros.errors import MotionError
from humansim_ros.motion import Motion, read_motion

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


def write(tmp_path: Path, text: str | bytes, name: str = "walk.bvh") -> Path:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def read(path: Path | str) -> tuple[Motion, str]:
    """A motion, and all warnings of it."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read_motion(path)
    return motion, "\n".join(str(warning.message) for warning in caught)


def info(capsys: pytest.CaptureFixture[str], path: Path | str) -> dict[str, Any]:
    """What ``humansim motion info PATH --json`` prints."""
    assert main(["motion", "info", str(path), "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out))


# Text

#: Spellings of one file that are read without a warning.
SPELLINGS: dict[str, str | bytes] = {
    "CHANNELS over two lines": GOOD.replace("Zposition Z", "Zposition\n    Z"),
    "a word of CHANNELS a line": GOOD.replace("3 Zrotation Xrotation Y", "3\nZrotation\nXrotation\nY"),
    "OFFSET over two lines": GOOD.replace("0 10 0", "0\n10 0"),
    "OFFSET before its numbers": GOOD.replace("OFFSET 0 10 0", "OFFSET\n0\n10\n0"),
    "the name in the next line": GOOD.replace("JOINT Chest", "JOINT\n  Chest"),
    "Site in the next line": GOOD.replace("End Site", "End\n    Site"),
    "MOTION and Frames in one line": GOOD.replace("MOTION\nF", "MOTION F"),
    "the header in one line": GOOD.replace("MOTION\nFrames: 2\nF", "MOTION Frames: 2 F"),
    "numbers of the header in lines of their own": GOOD.replace(": 2", ":\n2").replace(": 0", ":\n0"),
    "the header in the other order": GOOD.replace(
        "Frames: 2\nFrame Time: 0.04", "Frame Time: 0.04\nFrames: 2"
    ),
    "comments of scripts": "# by a script\n" + GOOD.replace("  JOINT", "  # the chest\n  JOINT"),
    "comments of C": "/* by\n * a script\n */\n" + GOOD.replace("  JOINT", "// the chest\n  JOINT"),
    "comments of Lisp": "; by a script\n" + GOOD.replace("Frames", "; the frames\nFrames"),
    "comments behind statements": GOOD.replace("0 5 0", "0 5 0  # tip").replace("Chest", "Chest // torso"),
    "comments behind the header": GOOD.replace(": 2", ": 2 # two").replace("0.04", "0.04 // 25 Hz"),
    "comments among rows": GOOD.replace("\n7", "\n# frame 1\n  // ...\n7") + "# the end\n",
    "a comment behind a row": GOOD.replace("60\n7", "60 # frame 0\n7"),
    "UTF-16 with a mark": GOOD.encode("utf-16"),
    "UTF-16 of Windows without a mark": GOOD.replace("\n", "\r\n").encode("utf-16-le"),
    "UTF-16 of other machines": GOOD.encode("utf-16-be"),
    "a byte order mark": b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode(),
    "two words HIERARCHY": GOOD.replace("MOTION", "HIERARCHY\nMOTION"),
}


@pytest.mark.parametrize("spelling", SPELLINGS)
def test_spellings_of_one_file_read_alike_without_a_word(tmp_path: Path, spelling: str) -> None:
    assert SPELLINGS[spelling] != GOOD
    (expected, _), (motion, said) = (read(write(tmp_path, text)) for text in (GOOD, SPELLINGS[spelling]))
    assert said == "" and motion.joint_names == expected.joint_names == ("Hips", "Chest", "Chest_end")
    assert motion.channels == expected.channels and motion.frame_time == 0.04
    for found, right in ((motion.offsets, expected.offsets), (motion.values, expected.values)):
        np.testing.assert_array_equal(found, right)


def test_errors_of_a_statement_that_does_not_go_on_name_its_own_line(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD.replace("OFFSET 0 10 0", "OFFSET 0 10"))
    with pytest.raises(MotionError, match="OFFSET needs three finite numbers") as caught:
        read(path)
    assert caught.value.line == 8


@pytest.mark.parametrize(
    ("encoding", "names"),
    [
        ("Shift-JIS", ["センター", "左足", "右ひざ", "上半身"]),
        ("GBK", ["骨盆", "左大腿", "右小臂", "头"]),
        ("EUC-KR", ["골반", "왼다리", "오른팔", "머리"]),
        ("Big5", ["骨盆", "左腳", "右臂", "頭"]),
        ("EUC-JP", ["腰", "左足", "右腕", "頭"]),
        ("UTF-16", ["腰", "Хребет", "Hüfte", "머리"]),
        ("UTF-8", ["腰", "Хребет", "Hüfte", "머리"]),
        ("Latin-1", ["Hüfte", "Rücken", "línea", "Schädel"]),
    ],
)
def test_names_are_read_in_the_encoding_of_their_script(
    tmp_path: Path, encoding: str, names: list[str]
) -> None:
    for hips, chest in zip(names, reversed(names), strict=True):
        text = GOOD.replace("Hips", hips).replace("Chest", chest)
        motion, said = read(write(tmp_path, text.encode(encoding)))
        assert motion.joint_names[:2] == (hips, chest)
        assert said == "" if encoding.startswith("UTF") else f"not UTF-8: read as {encoding}" in said


def test_scale_channels_are_left_out_with_their_range(tmp_path: Path) -> None:
    text = GOOD.replace(
        "3 Zrotation Xrotation Yrotation", "6 Zrotation Xrotation Yrotation Xscale Yscale Zscale"
    )
    motion, said = read(write(tmp_path, text.replace(" 60\n", " 60 1 1 1\n").replace("-60", "-60 1 1.5 1")))
    assert "the scale channels, which are from 1 to 1.5, are not used" in said
    np.testing.assert_array_equal(motion.values, read(write(tmp_path, GOOD))[0].values)


def test_a_frame_time_of_zero_is_that_of_30_frames_per_second(tmp_path: Path) -> None:
    motion, said = read(write(tmp_path, GOOD.replace("0.04", "0")))
    assert "walk.bvh:18: the Frame Time is 0: 30 frames per second are assumed" in said
    assert motion.frame_time == 1 / 30


# Several people


def two_people() -> str:
    """The walk twice: the second person, ``B_Hips``, is a metre to the left."""
    text = stand_in("mixamo").text(walk(12))
    hierarchy, rows = text.split("MOTION\n")
    head, *values = rows.strip().split("\n")
    second = hierarchy.replace("HIERARCHY\n", "")
    for word in ("ROOT ", "JOINT "):
        second = second.replace(word, f"{word}B_")
    both = []
    for row in values[1:]:
        x, rest = row.split(maxsplit=1)
        both.append(f"{row} {float(x) + 100} {rest}")
    return "\n".join([f"{hierarchy}{second}MOTION", head, values[0], *both]) + "\n"


def test_the_first_of_two_people_is_read_and_the_other_is_named(tmp_path: Path) -> None:
    path = write(tmp_path, two_people())
    alone, _ = read(write(tmp_path, stand_in("mixamo").text(walk(12)), "alone.bvh"))
    first, said = read(path)
    assert "2 people, with the roots Hips, B_Hips: the first is read" in said and "walk.bvh#B_Hips" in said
    second, said = read(f"{path}#B_Hips")
    assert said == "" and second.joint_names[0] == "B_Hips"
    np.testing.assert_array_equal(first.world_positions(), alone.world_positions())
    np.testing.assert_allclose(
        second.world_positions(), alone.world_positions() + np.array([100, 0, 0]), atol=1e-4
    )
    with pytest.raises(MotionError, match="no root 'C_Hips' in the file; did you mean 'B_Hips'"):
        read(f"{path}#C_Hips")


def test_a_second_root_that_is_no_person_is_read_without_a_word(tmp_path: Path) -> None:
    hierarchy, rows = stand_in("mixamo").text(walk(3)).split("MOTION\n")
    prop = "ROOT Ball\n{\nOFFSET 0 0 0\nCHANNELS 3 Xposition Yposition Zposition\n}\n"
    lines = rows.strip().split("\n")
    text = "\n".join([f"{hierarchy}{prop}MOTION", *lines[:2], *(f"{line} 1 2 3" for line in lines[2:])])
    motion, said = read(write(tmp_path, text))
    assert said == "" and "Ball" in motion.joint_names
    assert read(f"{tmp_path}/walk.bvh#Ball")[0].joint_names == ("Ball",)


def test_a_second_motion_behind_the_first_is_named(tmp_path: Path) -> None:
    _, said = read(write(tmp_path, GOOD + GOOD))
    assert (
        "'HIERARCHY' on is not part of the motion: left out; a second motion needs a file of its own" in said
    )
