"""BVH files as strangers write them: comments, broken lines, encodings, people, missing arms and rates."""

from __future__ import annotations

import json
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from motion_files import stand_in, walk
from stand_ins import motion_path, no_person

from humansim_ros.cli.main import main
from humansim_ros.errors import MotionError
from humansim_ros.files.reading.assets import built_in_names
from humansim_ros.geometry import unit_vectors
from humansim_ros.motion import Motion, read_motion, to_world, write_bvh
from humansim_ros.motion.body.skeleton import hanim_skeleton
from humansim_ros.motion.matching.by_shape import match_motion
from humansim_ros.motion.pose.reports import describe_motion
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.motion.pose.world_motion import playing_warnings

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
    with pytest.raises(MotionError, match="the file has no root 'C_Hips'; did you mean 'B_Hips'"):
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


# Missing limbs

ARMS = ("LeftCollar", "RightCollar", "LeftShoulder", "RightShoulder")
#: Roles that a file lacks with all joints below them, and what is said.
LACKING = {
    "arms": (ARMS, "l_shoulder, l_elbow, r_shoulder, r_elbow: the arms hang down"),
    "the left arm": (ARMS[::2], "l_shoulder, l_elbow: the arms hang down"),
    "forearms": (("LeftElbow", "RightElbow"), "l_elbow, r_elbow: the arms hang down"),
    "arms and head": (
        (*ARMS, "Neck", "Head"),
        "l_shoulder, l_elbow, r_shoulder, r_elbow: the arms hang down",
    ),
    "all but legs": ((*ARMS, "Spine", "Chest", "Neck"), "trunk, head, l_shoulder"),
    "the head": (("Neck", "Head"), ""),
    "hands": (("LeftWrist", "RightWrist"), ""),
    "feet": (("LeftAnkle", "RightAnkle"), "a confidence of 45%"),
}


def without(motion: Motion, *roles: str) -> Motion:
    """A motion without the joints of roles, and without all joints below them."""
    of_role = match_motion(motion).roles
    gone = {of_role[role] for role in roles if role in of_role}
    for joint, parent in enumerate(motion.parents.tolist()):
        if parent in gone:
            gone.add(joint)
    return motion.only([joint for joint in range(motion.n_joints) if joint not in gone])


@pytest.mark.slow
@pytest.mark.parametrize("lacking", LACKING)
@pytest.mark.parametrize("stem", ["own_humanik", "own_cmu", "own_rokoko", "own_makehuman"])
def test_a_person_without_limbs_keeps_its_unit_and_its_way(stem: str, lacking: str) -> None:
    roles, said = LACKING[lacking]
    whole = read(motion_path(stem))[0]
    expected, found = (describe_motion(m) for m in (whole, without(whole, *roles)))
    assert (
        found["unknown"] is None
        and found["up"] == expected["up"]
        and found["unit_name"] == expected["unit_name"]
    )
    # the direction of the way counts from a rest pose, which is another frame where arms are missing
    ways = [[one["speed"], np.linalg.norm(one["travel"])] for one in (found, expected)]
    assert ways[0] == pytest.approx(ways[1])
    assert found["stature"] == pytest.approx(expected["stature"], rel=0.03)
    assert said in "".join(found["warnings"]) and (said or not found["warnings"])


@pytest.mark.parametrize("roles", [("LeftHip",), ("LeftHip", "RightHip"), ("Hips",)])
def test_a_person_needs_both_legs(roles: tuple[str, ...]) -> None:
    motion = without(read(motion_path("own_humanik"))[0], *roles)
    if not motion.n_joints:
        motion = read(no_person("no_end_sites"))[0]
    with pytest.raises(MotionError, match=r"finds nothing for .*l_hip, l_knee"):
        match_motion(motion)


def test_arms_with_unknown_names_are_not_held() -> None:
    """Arms of other names and lengths may be there: such a person is not read as one without arms."""
    motion = read(motion_path("own_humanik"))[0]
    names = [name.replace("ForeArm", "Foo").replace("Arm", "Bar") for name in motion.joint_names]
    offsets = motion.offsets.copy()
    offsets[motion.joint("RightForeArm")] *= 3  # no pair of arms by its shape
    with pytest.raises(MotionError, match="finds nothing for l_shoulder"):
        match_motion(replace(motion, joint_names=tuple(names), offsets=offsets))


@pytest.mark.parametrize("lacking", ["arms", "all but legs"])
def test_arms_without_joints_hang_beside_the_body(lacking: str) -> None:
    world = to_world(without(read(motion_path("own_humanik"))[0], *LACKING[lacking][0]))
    skeleton = hanim_skeleton()
    posed = Retargeter.fit(world, skeleton).pose(world.sample(world.frame_times[::10]))[..., :3, 3]
    for side in "lr":
        shoulder, elbow, wrist, hip = (
            posed[:, skeleton.bone(f"{side}_{part}")] for part in ("shoulder", "elbow", "wrist", "hip")
        )
        arm = wrist - shoulder
        assert (arm[:, 2] < -0.88 * np.linalg.norm(arm, axis=1)).all() and (elbow[:, 2] > wrist[:, 2]).all()
        assert (np.linalg.norm((wrist - hip)[:, :2], axis=1) > 0.05).all()


def test_a_walk_without_arms_is_a_walk(shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = shared_data / "fourth" / "motion" / "no_arms.bvh"
    found = info(capsys, path)
    assert (found["up"], found["unit"], found["travel"][0]) == ("y", 0.01, pytest.approx(2.69, abs=0.01))
    assert found["speed"] == pytest.approx(0.91, abs=0.03) and "arms hang down" in found["warnings"][0]
    world, skeleton = to_world(read(path)[0]), hanim_skeleton()
    posed = Retargeter.fit(world, skeleton).pose(world.sample(world.frame_times))[..., :3, 3]
    hip, knee, ankle = (posed[:, skeleton.bone(f"l_{part}")] for part in ("hip", "knee", "ankle"))
    thigh, shin = (unit_vectors(vector) for vector in (knee - hip, ankle - knee))
    flexion = np.degrees(np.arccos((thigh * shin).sum(-1)))
    assert flexion.argmax() == 39 and flexion.max() == pytest.approx(75.9, abs=0.1)


@pytest.mark.parametrize("name", ["broken_channels", "comment_lines", "two_roots"])
def test_walks_of_strangers_are_the_walk(
    shared_data: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    found = info(capsys, shared_data / "fourth" / "motion" / f"{name}.bvh")
    assert (found["frames"], found["table"], found["joints"]) == (90, "cmu", 31)
    assert found["speed"] == pytest.approx(0.91, abs=0.01) and found["travel"] == pytest.approx(
        [2.69, 0.07], abs=0.01
    )
    assert ["B_Hips" in text for text in found["warnings"]] == [True] * (name == "two_roots")


# Frame rates


def at_rate(motion: Motion, factor: float) -> list[str]:
    """Warnings of a motion whose frame time is another by a factor, of those that concern the rate."""
    faster = replace(motion, frame_time=motion.frame_time * factor)
    return [text for text in playing_warnings(to_world(faster)) if "hardly right" in text]


def likely(text: str) -> float:
    return float(re.search(r"([\d.]+) are likely", text)[1])  # type: ignore[index]


EVERYDAY = built_in_names("motions")
WALKS = [name for name in EVERYDAY if re.fullmatch("walk(_brisk|_slow|_straight)?|limp", name)]


@pytest.mark.parametrize("name", [*EVERYDAY, "activity#4", "own_cmu", "own_makehuman", "own_rokoko"])
def test_no_built_in_motion_and_none_of_half_or_double_speed_has_an_unlikely_rate(name: str) -> None:
    motion = read(motion_path(name) if name.startswith("own_") else name)[0]
    for factor in (1, 0.5, 2):
        assert at_rate(motion, factor) == []


@pytest.mark.parametrize("name", WALKS)
def test_a_walk_at_24_times_its_rate_or_a_24th_of_it_is_told_with_a_likely_rate(name: str) -> None:
    motion = read(name)[0]
    for factor in (1 / 24, 24):
        (text,) = at_rate(motion, factor)
        assert likely(text) == pytest.approx(1 / motion.frame_time, rel=0.01)


@pytest.mark.parametrize("name", [name for name in EVERYDAY if name != "stand"])
def test_a_rate_or_milliseconds_in_place_of_the_time_are_told(name: str) -> None:
    motion = read(name)[0]
    for factor in (1000, 1 / motion.frame_time**2):
        (text,) = at_rate(motion, factor)
        assert likely(text) == pytest.approx(1 / motion.frame_time, rel=0.01) and "too slow" in text


def test_the_speed_of_the_warning_plays_the_motion_at_the_likely_rate() -> None:
    motion = read("walk")[0]
    fast = replace(motion, frame_time=motion.frame_time / 24)
    (text,) = at_rate(motion, 1 / 24)
    speed = float(re.search(r"speed: ([\d.]+)\)", text)[1])  # type: ignore[index]
    assert speed == pytest.approx(1 / 24, rel=1e-3) and not playing_warnings(to_world(fast, speed=speed))


def test_glitches_of_single_frames_do_not_make_a_rate_unlikely() -> None:
    motion = read("walk")[0]
    values = motion.values.copy()
    values[10::40, 3:] += 40
    assert at_rate(replace(motion, values=values), 1) == []


@pytest.mark.parametrize("time", ["0.0013889", "30", "33.3333"])
def test_a_wrong_frame_time_of_a_file_is_told_with_its_speed(
    shared_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], time: str
) -> None:
    text = (shared_data / "fourth" / "motion" / "frame_time_24x_fast.bvh").read_text()
    found = info(capsys, write(tmp_path, text.replace("0.0013889", time)))
    (said,) = found["warnings"]
    expected = 0.91 / 30 / float(time)
    assert float(re.search(r"moves at ([\d.e-]+) m/s", said)[1]) == pytest.approx(expected, rel=0.05)  # type: ignore[index]
    assert 24 <= likely(said) <= 40 and f"{1 / float(time):.5g}"[:5] in said


# Links


def stretched(share: float, name: str) -> Motion:
    """The walk with position channels in all joints, and one link that changes its length by a share."""
    motion = read(motion_path("own_all_channels"))[0]
    joint = next(n for n in motion.joint_names if n == name)
    values = motion.values.copy()
    for number, _, column in motion.position_columns:
        if motion.joint_names[number] == joint:
            values[:, column] *= 1 + share * np.sin(np.arange(len(values)) / 9) / 2
    return replace(motion, values=values)


@pytest.mark.parametrize(("share", "is_told"), [(0.0, False), (0.01, False), (0.03, True), (0.3, True)])
def test_a_link_that_changes_its_length_is_told_with_its_lengths(
    tmp_path: Path, share: float, is_told: bool
) -> None:
    motion = stretched(share, "LoLeg_R")
    write_bvh(tmp_path / "walk.bvh", motion)
    found, said = read(tmp_path / "walk.bvh")
    lengths = np.linalg.norm(found.local_translations()[:, found.joint("LoLeg_R")], axis=-1)
    text = f"UpLeg_R to LoLeg_R from {lengths.min():.2f} to {lengths.max():.2f} (OFFSET 42.96)"
    assert said == "" if not is_told else said.endswith(f"by their position channels: {text}")
    assert to_world(found).match.confidence == 1


def test_a_shin_of_a_stranger_changes_its_length(
    shared_data: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = info(capsys, shared_data / "fourth" / "motion" / "links_change_length.bvh")
    assert "RightLeg to RightFoot from 43.18 to 44.32 (OFFSET 41.87)" in found["warnings"][0]
    assert found["frames"] == 60 and found["unknown"] is None


# Other formats


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        (".mot", "this is OpenSim (.mot), which is not read as a motion: play its markers (.trc)"),
        (".CSV", "this is a table of numbers (.csv)"),
        (".tsv", "this is a table of numbers (.tsv)"),
        (".mvnx", "this is Xsens MVN (.mvnx), which is not read as a motion: export .bvh, .fbx or .c3d"),
        (".usda", "this is USD or Alembic (.usda)"),
        (".blend", "this is a scene of an editor (.blend)"),
        (".mp4", "this is a video (.mp4)"),
        (".tak", "this is a recording of a capture system (.tak)"),
    ],
)
@pytest.mark.parametrize("content", ["Coordinates\nnRows=3\n", "\0\1\2"])
def test_a_format_that_is_not_read_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], suffix: str, text: str, content: str
) -> None:
    path = write(tmp_path, content, f"walk{suffix}")
    assert main(["motion", "info", str(path)]) == 2
    assert f"{path}: {text}" in capsys.readouterr().err


def test_bvh_with_another_suffix_is_bvh(tmp_path: Path) -> None:
    assert read(write(tmp_path, GOOD, "walk.csv"))[0].n_frames == 2
    with pytest.raises(MotionError, match="no such BVH motion file"):
        read(tmp_path / "other.csv")
    with pytest.raises(MotionError, match="it should start with HIERARCHY"):
        read(write(tmp_path, "hello", "walk.other"))
