"""Motions of points in TRC and C3D files: their joints, gaps, and what is refused."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from motion_files import Array, raise_arms, stand_in, walk
from motion_formats import plug_in_gait, write_c3d, write_trc
from scipy.spatial.transform import Rotation

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.motion import Motion, read_motion, to_world
from humansim_ros.motion.body.skeleton import Skeleton
from humansim_ros.motion.pose.reports import describe_motion, read_with_warnings
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.people import keypoint_set
from humansim_ros.people.keypoints.locator import KeypointLocator
from humansim_ros.people.loading.loading import load_human

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


#: Names that sets of markers have for Plug-in Gait's, without the side; ``-`` stands for it within a name.
FAMILIES = {
    "CMU": "ASI FWT, PSI BWT, HEE HEL",
    "ISB": "ASI IAS, PSI IPS, KNE FLE, ANK FAL, HEE FCC, TOE FM2, SHO SAE, ELB HLE, WRA RSP, WRB USP",
    "OpenSim": "KNE LFC, ANK LMAL, HEE CAL, SHO ACR, ELB LEL, WRA FAradius, WRB FAulna",
    "Qualisys": "ASI Waist-Front, PSI Waist-Back, KNE KneeOut, ANK AnkleOut, HEE HeelBack, TOE ToeTip, "
    "SHO ShoulderTop, ELB ElbowOut, WRA WristIn, WRB WristOut, FIN HandOut",
    "Motive": "ASI Waist-Front, PSI Waist-Back, KNE KneeOut, ANK AnkleOut, HEE Heel, TOE ToeIn, "
    "SHO ShoulderTop, ELB ElbowOut, WRA WristIn, WRB WristOut, FIN HandOut",
}
PREFIXES = ("", "Anna:", "Skeleton 001:", "Skeleton 001_", "Q_")


def renamed(family: str, markers: dict[str, Array], prefix: str = "") -> dict[str, Array]:
    """Plug-in Gait's markers with the names of another set."""
    words = dict(pair.split() for pair in FAMILIES[family].split(", "))

    def name(marker: str) -> str:
        word = words.get(marker[1:], marker[1:])
        return word.replace("-", marker[0]) if "-" in word else marker[0] + word

    trunk = {"C7": "SpineTop", "CLAV": "Chest"} if family == "Qualisys" else {"C7": "C7", "CLAV": "CLAV"}
    return {prefix + trunk.get(marker, name(marker)): place for marker, place in markers.items()}


@pytest.mark.parametrize(("family", "prefix"), list(zip(FAMILIES, PREFIXES, strict=True)))
def test_marker_sets_of_programs_are_the_same_motion(tmp_path: Path, family: str, prefix: str) -> None:
    markers = plug_in_gait(PERSON, TURNS, ROOT)
    expected = read_motion(write_c3d(tmp_path / "a.c3d", *table(markers)))
    found = read_motion(write_c3d(tmp_path / "b.c3d", *table(renamed(family, markers, prefix))))
    assert found.joint_names == expected.joint_names
    np.testing.assert_allclose(found.world_positions(), expected.world_positions(), atol=1e-6)


def upright(motion: Motion) -> None:
    """Check that trunk and arms are upright over moving hips, z up."""
    places = {name: motion.world_positions()[:, motion.joint(name)] for name in motion.joint_names}
    up = np.array([0.0, 0.0, 1.0])
    trunk = places["Neck"] - places["Hips"]
    np.testing.assert_allclose(
        trunk / np.linalg.norm(trunk, axis=1, keepdims=True), np.tile(up, (40, 1)), atol=1e-6
    )
    across = places["LeftShoulder"] - places["RightShoulder"]
    hips = (places["LeftHip"] - places["RightHip"]) * [1, 1, 0]
    assert (
        (across * hips).sum(1) / np.linalg.norm(across, axis=1) / np.linalg.norm(hips, axis=1)
    ).min() > 0.999
    for side in ("Left", "Right"):
        assert ((places[f"{side}Shoulder"] - places[f"{side}Wrist"])[:, 2] > 0.3).all()


LOWER = {
    "markers": [
        *["LASI", "RASI", "LPSI", "RPSI", "LKNE", "RKNE", "LANK", "RANK", "LHEE", "RHEE", "LTOE", "RTOE"]
    ],
    "joints": [f"{side}{part}" for side in "LR" for part in ("Hip", "Knee", "Ankle", "BigToe")],
}


@pytest.mark.parametrize("kind", LOWER)
@pytest.mark.parametrize("suffix", WRITERS)
def test_legs_alone_move_under_a_trunk_that_is_held_upright(tmp_path: Path, kind: str, suffix: str) -> None:
    points = plug_in_gait(PERSON, TURNS, ROOT) if kind == "markers" else _SETS["BODY_25"]
    path = WRITERS[suffix](tmp_path / f"legs{suffix}", *table({name: points[name] for name in LOWER[kind]}))
    with pytest.warns(HumansimWarning, match="there are no points of trunk, head and arms: held at rest"):
        motion = read_motion(path)
    upright(motion)
    limit = 0.02 if kind == "markers" else 1e-4
    for role in ("LeftHip", "RightKnee", "LeftAnkle"):
        assert joint_errors(motion, role).max() < limit
    world = to_world(motion)
    assert world.frame.up == "z" and world.match.confidence > 0.8 and 1.4 < world.frame.stature < 2.0


def test_markers_without_arms_keep_the_trunk_and_hang_the_arms(tmp_path: Path) -> None:
    arms = ("ELB", "WRA", "WRB", "FIN")
    points = {n: p for n, p in plug_in_gait(PERSON, TURNS, ROOT).items() if n[1:] not in arms}
    with pytest.warns(HumansimWarning, match="there are no points of the arms: held at rest"):
        motion = read_motion(write_c3d(tmp_path / "walk.c3d", *table(points)))
    assert joint_errors(motion, "Neck").max() < 0.001 and joint_errors(motion, "LeftShoulder").max() < 0.02
    elbow, shoulder = (
        motion.world_positions()[:, motion.joint(f"Left{part}")] for part in ("Elbow", "Shoulder")
    )
    assert ((shoulder - elbow)[:, 2] > 0.2).all()


def test_legs_that_do_not_show_where_up_is_are_refused(tmp_path: Path) -> None:
    turn = Rotation.from_euler("x", 45, degrees=True).as_matrix()
    labels, points = table({name: _SETS["BODY_25"][name] for name in LOWER["joints"]})
    with pytest.raises(MotionError, match=r"legs do not show where up is: they lean by 4. degrees"):
        read_motion(write_trc(tmp_path / "bike.trc", labels, points @ turn.T))


#: Anatomical points of the skin at the places of Plug-in Gait's markers, and those of joints in the truth.
SKIN = keypoint_set("plug_in_gait")
BONES = {
    "Hip": "hip",
    "Knee": "knee",
    "Ankle": "ankle",
    "Shoulder": "shoulder",
    "Elbow": "elbow",
    "Wrist": "wrist",
}


def on_skin(motion: str, frames: int = 12) -> tuple[dict[str, Array], dict[str, Array], Array, Skeleton]:
    """Markers on a built-in man, his joints, his posed bones, and his skeleton."""
    human, world = load_human("adult_man"), to_world(read_motion(motion))
    posed = Retargeter.fit(world, human.skeleton).pose(world.sample(np.linspace(0, 2, frames)))
    locator = KeypointLocator.of(human, SKIN)
    joints = np.zeros((len(human.skeleton.joint_names), 3))
    places = np.stack([locator.positions(joints, human.pose(one)) for one in posed])
    truth = {
        side + role: posed[:, human.skeleton.bone(f"{side[0].lower()}_{bone}"), :3, 3]
        for side in ("Left", "Right")
        for role, bone in BONES.items()
    }
    return dict(zip(SKIN.names, np.moveaxis(places, 1, 0), strict=True)), truth, posed, human.skeleton


@pytest.mark.parametrize("motion", ["walk", pytest.param("pick_up", marks=pytest.mark.nightly)])
def test_markers_on_the_skin_of_a_body_pose_it_as_it_was(tmp_path: Path, motion: str) -> None:
    markers, truth, posed, skeleton = on_skin(motion)
    path = write_c3d(tmp_path / "skin.c3d", list(markers), np.stack(list(markers.values()), axis=1))
    read = read_motion(path)
    # joints of the body are not those of anatomy: its hips are 5 cm behind the regression
    limits = {"Hip": 0.06, "Knee": 0.03, "Ankle": 0.03, "Shoulder": 0.045, "Elbow": 0.045, "Wrist": 0.02}
    for role, place in truth.items():
        found = read.world_positions()[:, read.joint(role)]
        assert (
            np.linalg.norm(found - place, axis=1).max()
            < limits[role.removeprefix("Left").removeprefix("Right")]
        )
    world = to_world(read)
    again = Retargeter.fit(world, skeleton).pose(world.sample(world.frame_times))
    for bone in ("HumanoidRoot", "vl5", "vt3", "l_hip", "r_knee", "l_shoulder", "r_elbow"):
        rise, expected = (np.arcsin(each[:, skeleton.bone(bone), 2, 1]) for each in (again, posed))
        assert np.degrees(np.abs(rise - expected)).max() < 12, bone


def test_raised_arms_and_the_trunk_are_posed_as_in_the_file(tmp_path: Path) -> None:
    turns = raise_arms(20, collar=0)
    truth = np.moveaxis(PERSON.positions(turns), 1, 0) * 0.01
    points = {role: truth[n] for n, role in enumerate(PERSON.roles) if role[-5:] not in ("ollar",)}
    motion = read_motion(write_trc(tmp_path / "arms.trc", list(points), np.stack(list(points.values()), 1)))
    facts = describe_motion(*read_with_warnings(tmp_path / "arms.trc"))
    assert facts["up"] == "y" and facts["facing"] == "z" and facts["unknown"] is None
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


#: Markers beside segments, which are no joints.
SEGMENTS = {
    f"{side[0]}{name}": side + joint
    for side in ("Left", "Right")
    for name, joint in (("Thigh", "Hip"), ("Shin", "Knee"), ("Foot", "Ankle"))
}


BAD: dict[str, tuple[Callable[[Path], Path], str]] = {
    "not a TRC file": (lambda path: (path.write_text("x\n" * 9), path)[1], "it must begin with PathFileType"),
    "cut header": (lambda path: (path.write_text("PathFileType\n"), path)[1], "not a TRC file"),
    "unknown unit": (edited(r"\tmm\n", "\tfurlong\n"), "unknown unit 'furlong'; known are m, dm, cm, mm"),
    "no unit": (edited(r"\tmm\n", "\t\n"), "unknown unit ''"),
    "no frames": (edited(r"(?s)(X1.*?\n).*", r"\1\n\n"), "no frames"),
    "a word": (edited(r"(\n2\t0.020000\t)\S+", r"\1word"), "'word' is not a number"),
    "too many numbers": (edited(r"(\n3\t.*)", r"\1\t1\t2\t3"), "numbers, but"),
    "a marker is missing": (without("LKnee"), "a person: LeftKnee are missing for a set of joints"),
    "one arm is missing": (without("RElbow"), "a person: RightElbow are missing for a set of joints"),
    "no arms and no ankles": (without("LElbow", "RElbow", "LAnkle"), "LeftElbow, RightElbow are missing"),
    "thigh and shin markers alone": (
        lambda path: write_trc(path, *table({n: TRUTH[j] for n, j in SEGMENTS.items()})),
        "a person: LeftShoulder",
    ),
    "no labels": (edited(r"Frame#\tTime.*", "Frame#\tTime"), "no marker names"),
    "other labels": (
        lambda path: write_trc(path, ["a", "b"], np.zeros((3, 2, 3))),
        "the points do not make up a person: LeftHip",
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
    with pytest.raises(
        MotionError, match=r"LeftKneeLateral, .* are missing for a set of markers; found ASIS"
    ):
        read_motion(shared_data / "other" / name)
