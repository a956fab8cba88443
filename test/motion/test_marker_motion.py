"""Motions of points in TRC and C3D files: their joints, gaps, and what is refused."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from motion_files import Array, raise_arms, stand_in, walk
from motion_formats import plug_in_gait, write_c3d, write_trc

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.motion import Motion, read_motion, to_world
from humansim_ros.motion.info import describe_motion, read_with_warnings

PERSON = stand_in("biovision")
TURNS, ROOT = walk(40, heading=30), np.linspace([0, 0, 0], [5, 2, 90], 40)
TRUTH = dict(zip(PERSON.roles, np.moveaxis(PERSON.positions(TURNS, ROOT), 1, 0) * 0.01, strict=False))
LIMBS = ("Hip", "Knee", "Ankle", "Shoulder", "Elbow", "Wrist")
#: File axes with z up: x' = z, y' = x, z' = y.
Z_UP = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
Writer = Callable[..., Path]
WRITERS = {".trc": write_trc, ".c3d": write_c3d}


def joints_as(left: str, right: str, words: dict[str, str], **trunk: str) -> dict[str, Array]:
    """Points of the truth with the names of a set."""
    sides = {
        mark.format(word): TRUTH[side + role]
        for role, word in words.items()
        for side, mark in (("Left", left), ("Right", right))
    }
    middle = (TRUTH["LeftHip"] + TRUTH["RightHip"]) / 2
    return {**{name: middle if role == "Hips" else TRUTH[role] for role, name in trunk.items()}, **sides}


_LONG = {role: role for role in LIMBS}
_SETS = {
    "BODY_25": joints_as("L{}", "R{}", {**_LONG, "Toe": "BigToe"}, Neck="Neck", Hips="MidHip"),
    "COCO": joints_as("left_{}", "right_{}", {role: role.lower() for role in LIMBS}, Head="nose"),
    "H36M": joints_as("L{}", "R{}", {**_LONG, "Ankle": "Foot"}, Hips="Hip", Neck="Thorax", Head="Head"),
    "ours": joints_as("l_{}", "r_{}", {role: role.lower() for role in LIMBS}, Hips="HumanoidRoot"),
    "centres": joints_as("L{}JC", "R{}JC", {role: role[0] for role in LIMBS}),
}


def table(points: dict[str, Array]) -> tuple[list[str], Array]:
    return list(points), np.stack(list(points.values()), axis=1) @ Z_UP.T


def joint_errors(motion: Motion, role: str) -> Array:
    """Distances (F,) from the truth, metres."""
    found = motion.world_positions()[:, motion.joint(role)]
    return np.asarray(np.linalg.norm(found - TRUTH[role] @ Z_UP.T, axis=1))


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("name", _SETS)
def test_joints_stay_where_the_file_has_them(tmp_path: Path, name: str, suffix: str) -> None:
    motion = read_motion(WRITERS[suffix](tmp_path / f"walk{suffix}", *table(_SETS[name])))
    assert motion.n_frames == 40 and motion.frame_time == pytest.approx(0.02)
    for limb in LIMBS:
        for side in ("Left", "Right"):
            assert joint_errors(motion, side + limb).max() < 1e-4
    world = to_world(motion)
    assert world.match.confidence > 0.8 and world.frame.up == "z" and world.frame.unit == 1.0


def test_markers_become_joints_within_two_centimetres(tmp_path: Path) -> None:
    motion = read_motion(write_c3d(tmp_path / "walk.c3d", *table(plug_in_gait(PERSON, TURNS, ROOT))))
    limits = {"Hip": 0.001, "Knee": 0.02, "Ankle": 0.02, "Shoulder": 0.02, "Elbow": 0.02, "Wrist": 0.001}
    for limb, limit in limits.items():
        for side in ("Left", "Right"):
            assert joint_errors(motion, side + limb).max() < limit, limb
    assert joint_errors(motion, "Neck").max() < 0.001 and joint_errors(motion, "Head").max() < 0.001
    world = to_world(motion)
    assert world.frame.up == "z" and 1.4 < world.frame.stature < 1.9


def test_markers_on_both_sides_of_a_joint_have_it_between_them(tmp_path: Path) -> None:
    markers = plug_in_gait(PERSON, TURNS, ROOT)
    for side, mark in (("Left", "L"), ("Right", "R")):
        for lateral, medial, role in (
            ("KNE", "KNEM", "Knee"),
            ("ANK", "MED", "Ankle"),
            ("ELB", "ELBM", "Elbow"),
        ):
            markers[mark + medial] = 2 * TRUTH[side + role] - markers[mark + lateral]
    motion = read_motion(write_trc(tmp_path / "walk.trc", *table(markers)))
    for role in ("LeftKnee", "RightAnkle", "LeftElbow"):
        assert joint_errors(motion, role).max() < 1e-4


def test_other_names_of_the_same_markers_are_the_same_motion(tmp_path: Path) -> None:
    markers = plug_in_gait(PERSON, TURNS, ROOT)
    names = {"ASI": "ASIS", "PSI": "PSIS", "KNE": "Knee.Lat", "ANK": "Ankle.Lat", "HEE": "Heel", "TOE": "Toe"}
    names |= {"SHO": "Acromium", "ELB": "Elbow", "WRA": "Wrist"}
    helen_hayes = {f"{name[0]}.{new}": markers[name] for name in markers if (new := names.get(name[1:]))}
    sacrum = (helen_hayes.pop("L.PSIS") + helen_hayes.pop("R.PSIS")) / 2
    motion = read_motion(write_trc(tmp_path / "walk.trc", *table({**helen_hayes, "V.Sacral": sacrum})))
    assert joint_errors(motion, "LeftHip").max() < 0.001
    assert joint_errors(motion, "RightKnee").max() < 0.02


def test_raised_arms_and_the_trunk_are_posed_as_in_the_file(tmp_path: Path) -> None:
    turns = raise_arms(20, collar=0)
    truth = np.moveaxis(PERSON.positions(turns), 1, 0) * 0.01
    points = {role: truth[n] for n, role in enumerate(PERSON.roles) if role[-5:] not in ("ollar",)}
    motion = read_motion(write_trc(tmp_path / "arms.trc", list(points), np.stack(list(points.values()), 1)))
    facts = describe_motion(read_with_warnings(tmp_path / "arms.trc"))
    assert facts.up == "y" and facts.facing == "z" and facts.unknown is None
    found = motion.world_positions()[:, motion.joint("LeftWrist")]
    np.testing.assert_allclose(found, truth[PERSON.joint("LeftWrist")], atol=1e-5)


def test_a_file_with_commas_is_read(tmp_path: Path) -> None:
    path = write_trc(tmp_path / "walk.trc", *table(_SETS["BODY_25"]))
    path.write_text(path.read_text().replace("\t", ","))
    assert joint_errors(read_motion(path), "LeftKnee").max() < 1e-4


@pytest.mark.parametrize("suffix", WRITERS)
def test_gaps_are_filled_with_a_warning(tmp_path: Path, suffix: str) -> None:
    labels, points = table(_SETS["BODY_25"])
    points[10:13, labels.index("LKnee")] = np.nan
    path = WRITERS[suffix](tmp_path / f"walk{suffix}", labels, points)
    with pytest.warns(HumansimWarning, match="gaps of LKnee are filled; the longest has 3 frames"):
        motion = read_motion(path)
    assert motion.n_frames == 40 and joint_errors(motion, "LeftKnee").max() < 0.05
    assert np.isfinite(motion.values).all()


def test_zeros_are_gaps_too(tmp_path: Path) -> None:
    labels, points = table(_SETS["BODY_25"])
    points[20, labels.index("RElbow")] = 0
    with pytest.warns(HumansimWarning, match="gaps of RElbow are filled"):
        assert (
            joint_errors(read_motion(write_trc(tmp_path / "w.trc", labels, points)), "RightElbow").max()
            < 0.05
        )


def test_frames_without_all_points_at_the_ends_are_left_out(tmp_path: Path) -> None:
    labels, points = table(_SETS["BODY_25"])
    points[:5, labels.index("LKnee")] = np.nan
    points[38:, labels.index("MidHip")] = np.nan
    with pytest.warns(HumansimWarning, match="frames 5 to 37 of 40 are used"):
        assert read_motion(write_trc(tmp_path / "w.trc", labels, points)).n_frames == 33


def test_a_point_that_is_seldom_seen_is_not_used(tmp_path: Path) -> None:
    labels, points = table(_SETS["BODY_25"])
    points[15:, labels.index("LBigToe")] = np.nan
    with pytest.warns(HumansimWarning, match="LBigToe: seen in less than 50% of the frames, not used"):
        assert "LeftToe" not in read_motion(write_trc(tmp_path / "w.trc", labels, points)).joint_names


def test_one_of_several_people_is_named(tmp_path: Path) -> None:
    labels, points = table(_SETS["BODY_25"])
    both = [f"{name}:{label}" for name in ("anna", "ben") for label in labels]
    path = write_trc(tmp_path / "two.trc", both, np.concatenate([points, points + 1], axis=1))
    with pytest.raises(MotionError, match=r"2 people: name one, such as two\.trc#anna; they are anna, ben"):
        read_motion(path)
    ben = read_motion(f"{path}#ben").world_positions() - 1
    np.testing.assert_allclose(ben, read_motion(f"{path}#anna").world_positions(), atol=1e-5)
    with pytest.raises(MotionError, match="no person 'eve'; there are anna, ben"):
        read_motion(f"{path}#eve")


def edited(before: str, after: str) -> Callable[[Path], Path]:
    def make(path: Path) -> Path:
        write_trc(path, *table(_SETS["BODY_25"]))
        text = re.sub(before, after, path.read_text(), count=1)
        path.write_text(text)
        return path

    return make


def without(*names: str) -> Callable[[Path], Path]:
    points = {name: place for name, place in _SETS["BODY_25"].items() if name not in names}
    return lambda path: write_trc(path, *table(points))


def lower_body(path: Path) -> Path:
    markers = plug_in_gait(PERSON, TURNS)
    return write_trc(
        path, *table({n: p for n, p in markers.items() if n[1:] in ("ASI", "PSI", "KNE", "ANK")})
    )


BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "not a TRC file": (lambda path: (path.write_text("x\n" * 9), path)[1], "it must begin with PathFileType"),
    "cut header": (lambda path: (path.write_text("PathFileType\n"), path)[1], "not a TRC file"),
    "unknown unit": (edited(r"\tmm\n", "\tfurlong\n"), "unknown unit 'furlong'; known are m, dm, cm, mm"),
    "no unit": (edited(r"\tmm\n", "\t\n"), "unknown unit ''"),
    "no frames": (edited(r"(?s)(X1.*?\n).*", r"\1\n\n"), "no frames"),
    "a word": (edited(r"(\n2\t0.020000\t)\S+", r"\1word"), "'word' is not a number"),
    "too many numbers": (edited(r"(\n3\t.*)", r"\1\t1\t2\t3"), "numbers, but"),
    "a marker is missing": (without("LKnee"), "as joints, LeftKnee are missing"),
    "no arms": (without("LElbow", "RElbow"), "LeftElbow, RightElbow are missing"),
    "legs alone": (lower_body, "as markers, LeftAcromion, RightAcromion, LeftElbowLateral"),
    "no labels": (edited(r"Frame#\tTime.*", "Frame#\tTime"), "no marker names"),
    "other labels": (
        lambda path: write_trc(path, ["a", "b"], np.zeros((3, 2, 3))),
        "the points are not a person's: found a, b; as joints, LeftHip",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_a_wrong_file_is_refused_with_what_is_missing(tmp_path: Path, case: str) -> None:
    make, message = BAD[case]
    with pytest.raises(MotionError, match=re.escape(message)) as caught:
        read_motion(make(tmp_path / "walk.trc"))
    assert caught.value.path == str(tmp_path / "walk.trc")


def test_a_needed_point_that_is_seldom_seen_is_an_error(tmp_path: Path) -> None:
    labels, points = table(_SETS["BODY_25"])
    points[10:, labels.index("LKnee")] = np.nan
    with pytest.raises(MotionError, match="'LKnee' is seen in less than 50% of the frames"):
        read_motion(write_trc(tmp_path / "w.trc", labels, points))


def test_a_file_without_rate_and_times_is_refused(tmp_path: Path) -> None:
    path = write_trc(tmp_path / "w.trc", *table(_SETS["BODY_25"]))
    path.write_text(re.sub(r"(?m)^(\d+)\t[\d.]+", r"\1\t0", path.read_text()).replace("50.0\t50.0", "0\t0"))
    with pytest.raises(MotionError, match="neither times that increase evenly nor a rate"):
        read_motion(path)


@pytest.mark.parametrize("kept", [1, 600, -3000])
def test_a_cut_c3d_file_is_refused_or_ends_early(tmp_path: Path, kept: int) -> None:
    path = write_c3d(tmp_path / "walk.c3d", *table(_SETS["BODY_25"]))
    path.write_bytes(path.read_bytes()[:kept])
    if kept > 0:
        with pytest.raises(MotionError, match=r"walk\.c3d: "):
            read_motion(path)
        return
    with pytest.warns(HumansimWarning, match="the file ends after"):
        assert 0 < read_motion(path).n_frames < 40


@pytest.mark.parametrize("name", ["pyomeca.c3d", "pyomeca_markers.trc"])
def test_markers_of_one_arm_are_no_person(shared_data: Path, name: str) -> None:
    with pytest.raises(MotionError, match=r"found ASIS.*as markers, LeftKneeLateral, .* are missing"):
        read_motion(shared_data / "other" / name)
