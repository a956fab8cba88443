"""C3D and TRC files as strangers write them: layouts, units, names, lost points, axes, and what is up."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import ezc3d
import numpy as np
import pytest
from c3d_files import DEC, MIPS, Array, C3dWriter, texts
from conftest import if_shared
from motion_files import raise_arms, stand_in, walk
from motion_formats import plug_in_gait, write_trc
from scipy.spatial.transform import Rotation

from humansim_ros.cli.main import main
from humansim_ros.errors import MotionError
from humansim_ros.motion import Motion, read_motion, to_world
from humansim_ros.motion.files.marker_files import read_c3d_points

PERSON = stand_in("biovision")
TURNS, ROOT = walk(40, heading=30), np.linspace([0, 0, 0], [200, 2, 90], 40)
#: File axes with z up: x' = z, y' = x, z' = y.
Z_UP = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
TRUTH = {
    role: place @ Z_UP.T * 0.01
    for role, place in zip(PERSON.roles, np.moveaxis(PERSON.positions(TURNS, ROOT), 1, 0), strict=False)
}
MARKERS = {name: place @ Z_UP.T for name, place in plug_in_gait(PERSON, TURNS, ROOT).items()}
LABELS, POINTS = list(MARKERS), np.stack([*MARKERS.values()], axis=1)
EXACT = 1e-6


def read_quietly(path: Path | str) -> tuple[Motion, list[str]]:
    """A motion, and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read_motion(path)
    return motion, [str(warning.message) for warning in caught]


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> Motion:
    """The motion of the markers, from a plain file."""
    return read_motion(write_trc(tmp_path_factory.mktemp("plain") / "walk.trc", LABELS, POINTS))


def same(motion: Motion, expected: Motion, tolerance: float = EXACT) -> None:
    """Check that two motions have the same joints at the same places."""
    assert motion.joint_names == expected.joint_names
    np.testing.assert_allclose(motion.world_positions(), expected.world_positions(), atol=tolerance)


def near(motion: Motion, limit: float = 0.02) -> None:
    """Check that limbs are at the truth, metres."""
    for role in ("LeftHip", "RightKnee", "LeftAnkle", "LeftShoulder", "RightElbow", "LeftWrist"):
        place = motion.world_positions()[:, motion.joint(role)]
        assert np.linalg.norm(place - TRUTH[role], axis=1).max() < limit, role


# Files of others

#: Files of others: frames, rate, up, speed of the path of the hips, its tolerance, a word of the warnings.
FOURTH: dict[str, tuple[int, float, str, float, float, str]] = {
    "units_nul_motive.c3d": (60, 50, "z", 0.46, 0.05, ""),
    "units_missing.c3d": (60, 50, "z", 0.46, 0.05, "POINT:UNITS states no unit: mm"),
    "units_per_point.c3d": (60, 50, "z", 0.46, 0.05, ""),
    "ezc3d_rewritten_scale.c3d": (60, 50, "z", 0.46, 0.05, ""),
    "analog_used_differs.c3d": (60, 50, "z", 0.46, 0.05, ""),
    "qualisys_saj.c3d": (60, 200, "z", 1.50, 0.03, ""),
    "vsac.c3d": (41, 50, "z", 1.48, 0.03, "frames 39 to 79 of 80 are used"),
    "vicon_stairs_down.c3d": (108, 40, "z", 0.51, 0.03, ""),
    "theia_rotations_only.c3d": (60, 85, "z", 0.22, 0.03, ""),
    "unnamed_after_named.trc": (60, 100, "y", 1.28, 0.03, "3 of 44 points have no name"),
    "knee_often_lost.trc": (60, 100, "y", 1.28, 0.03, "the longest has 35 frames (10 to 44 of R.Knee)"),
    "up_along_x.trc": (60, 100, "x", 1.28, 0.03, "x is taken as up"),
    "opensim_header_two_tabs.trc": (60, 100, "y", 1.28, 0.03, ""),
}


@pytest.mark.parametrize("name", if_shared(*FOURTH))
def test_files_of_others_have_their_figures(
    shared_data: Path, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    path = shared_data / "fourth" / "motion" / name
    assert main(["motion", "info", str(path), "--json"]) == 0
    facts: dict[str, Any] = json.loads(capsys.readouterr().out)
    frames, rate, up, speed, tolerance, warning = FOURTH[name]
    assert facts["frames"] == frames and facts["rate"] == pytest.approx(rate) and facts["up"] == up
    motion = to_world(read_quietly(path)[0])
    hips = motion.sample(motion.frame_times).positions[:, motion.match.roles["Hips"]]
    # the path of the pelvis, up and down as well
    length = np.linalg.norm(np.diff(hips, axis=0), axis=1).sum()
    assert min(abs(length / motion.duration - speed), abs(facts["speed"] - speed)) < tolerance
    assert facts["unit"] == 1 and facts["unknown"] is None
    others = [text for text in facts["warnings"] if "gaps of RSHO" not in text]
    assert len(others) == bool(warning) and all(warning in text for text in others)


@pytest.mark.parametrize("command", ["table", "joints"])
@pytest.mark.parametrize("name", if_shared("vicon_stairs_down.c3d", "theia_rotations_only.c3d"))
def test_files_of_others_serve_all_commands(shared_data: Path, command: str, name: str) -> None:
    assert main(["motion", command, str(shared_data / "fourth" / "motion" / name)]) == 0


@pytest.mark.parametrize("name", if_shared("vicon_stairs_down.c3d"))
def test_a_person_who_walks_down_stairs_stands(shared_data: Path, name: str) -> None:
    motion = read_motion(shared_data / "fourth" / "motion" / name)
    hips = motion.world_positions()[:, motion.joint("Hips")]
    assert hips[0, 2] == pytest.approx(1.64, abs=0.1) and hips[-1, 2] == pytest.approx(0.68, abs=0.1)
    assert hips[-1, 0] - hips[0, 0] == pytest.approx(-1.32, abs=0.02)
    frame = to_world(motion).frame
    assert (frame.up, frame.facing, frame.confidence, frame.warning) == ("z", "-x", 1.0, None)


@pytest.mark.parametrize("name", if_shared("theia_rotations_only.c3d"))
def test_segments_of_theia_are_a_person(shared_data: Path, name: str) -> None:
    path = shared_data / "fourth" / "motion" / name
    motion = read_motion(path)
    places = {name: motion.world_positions()[:, motion.joint(name)] for name in motion.joint_names}
    assert places["Hips"][0, 2] == pytest.approx(0.903, abs=1e-3)
    assert places["Head"][0, 2] == pytest.approx(1.608, abs=1e-3)
    assert places["LeftHip"][0, 0] == pytest.approx(-0.40, abs=0.01)
    assert places["RightHip"][0, 0] == pytest.approx(-0.21, abs=0.01)
    assert places["LeftAnkle"][[0, -1], 1] == pytest.approx([0.33, 0.94], abs=0.01)
    assert to_world(motion).frame.facing == "y"
    turns = ezc3d.c3d(str(path))["data"]["rotations"][:3, 3].transpose(2, 1, 0) / 1000
    np.testing.assert_allclose(read_c3d_points(path, MotionError, 1 << 24).points, turns, atol=1e-9)


# Layouts of C3D

PLAIN = C3dWriter()
words, floats = PLAIN.words, PLAIN.floats


def without(*names: str, **changes: Any) -> C3dWriter:
    return replace(PLAIN, parameters={f"POINT:{name}": None for name in names}, **changes)


def having(header: dict[int, int] | None = None, **parameters: Any) -> C3dWriter:
    return replace(
        PLAIN,
        header=header or {},
        parameters={name.replace("__", ":"): one for name, one in parameters.items()},
    )


LAYOUTS = {
    "DEC": replace(PLAIN, processor=DEC),
    "DEC, integers": replace(PLAIN, processor=DEC, scale=0.1),
    "SGI": replace(PLAIN, processor=MIPS),
    "SGI, integers": replace(PLAIN, processor=MIPS, scale=0.1),
    "integers": replace(PLAIN, scale=0.1),
    "scales of floats differ": having(POINT__SCALE=(4, (), floats(-0.01))),
    "no scale": without("SCALE"),
    "USED of analog differs": replace(
        having({9: 10}, ANALOG__USED=(2, (), words(4)), ANALOG__RATE=(4, (), floats(500))), analog=30
    ),
    "analog count of the header differs": replace(
        having({2: 0, 9: 10}, ANALOG__USED=(2, (), words(3)), ANALOG__RATE=(4, (), floats(500))), analog=30
    ),
    "analog group is damaged": replace(
        having(ANALOG__USED=(2, (0,), b""), ANALOG__RATE=(4, (0,), b""), ANALOG__SCALE=(4, (9,), b"?")),
        analog=30,
    ),
    "no rate": without("RATE"),
    "rate of the header is 0": having({10: 0, 11: 0}),
    "no number of points": without("USED"),
    "points of the header are 0": having({1: 0}),
    "no start of the data": without("DATA_START"),
    "start of the header is 0": having({8: 0}),
    "header from 0": having({3: 0, 4: 39}),
    "header without frames": having({3: 0, 4: 0}),
    "frames of TRIAL": having(
        {4: 65535},
        TRIAL__ACTUAL_START_FIELD=(2, (2,), words(1, 0)),
        TRIAL__ACTUAL_END_FIELD=(2, (2,), words(40, 0)),
        POINT__FRAMES=(2, (), words(65535)),
    ),
    "frames of TRIAL, behind 65535": having(
        {3: 65535, 4: 65535},
        TRIAL__ACTUAL_START_FIELD=(2, (2,), words(4464, 1)),
        TRIAL__ACTUAL_END_FIELD=(2, (2,), words(4503, 1)),
    ),
    "LONG_FRAMES": having(
        {4: 65535}, POINT__FRAMES=(2, (), words(65535)), POINT__LONG_FRAMES=(4, (), floats(40))
    ),
    "other data at the end": replace(PLAIN, end=b"?" * 3000),
    "unit with zero bytes": having(POINT__UNITS=(-1, (4,), b"mm\0\0")),
    "unit of each point": having(POINT__UNITS=texts(["mm"] * len(LABELS))),
    "unit in one word for all points": having(POINT__UNITS=(-1, (56,), b"mm" * 28)),
    "other spelling of the unit": having(POINT__UNITS=texts(["[Millimetres]"])),
    "metres": replace(having(POINT__UNITS=texts(["METERS"])), unit=1.0),
}  # fmt: skip


@pytest.mark.parametrize("layout", LAYOUTS)
def test_layouts_of_c3d_are_one_motion_without_a_warning(
    tmp_path: Path, layout: str, expected: Motion
) -> None:
    writer = LAYOUTS[layout]
    motion, said = read_quietly(writer.write(tmp_path / "walk.c3d", LABELS, POINTS))
    assert said == [] and motion.frame_time == pytest.approx(0.02)
    same(motion, expected, 5e-4 if writer.scale > 0 else EXACT)


@pytest.mark.parametrize("layout", ["DEC", "DEC, integers", "integers", "scales of floats differ", "metres"])
def test_the_stand_ins_are_what_ezc3d_reads(tmp_path: Path, layout: str) -> None:
    writer = LAYOUTS[layout]
    read = ezc3d.c3d(str(writer.write(tmp_path / "walk.c3d", LABELS, POINTS)))["data"]["points"][:3]
    np.testing.assert_allclose(read.transpose(2, 1, 0) / writer.unit, POINTS, atol=1e-4)


WARNED = {
    "no unit": (without("UNITS"), "POINT:UNITS states no unit: mm, by the size of the person"),
    "blank unit": (having(POINT__UNITS=texts(["    "])), "POINT:UNITS states no unit: mm"),
    "no unit, centimetres": (without("UNITS", unit=100.0), "POINT:UNITS states no unit: cm"),
    "no unit, metres": (without("UNITS", unit=1.0), "POINT:UNITS states no unit: m, by"),
    "wrong unit": (having(POINT__UNITS=texts(["cm"])), "lengths are multiplied by 0.1"),
    "rates differ": (
        having({10: 0, 11: 17096}),
        "rate 100 in the header, but 50 in POINT:RATE, which is used",
    ),
}


@pytest.mark.parametrize("case", WARNED)
def test_what_the_person_tells_is_said(tmp_path: Path, case: str, expected: Motion) -> None:
    writer, message = WARNED[case]
    motion, said = read_quietly(writer.write(tmp_path / "walk.c3d", LABELS, POINTS))
    assert len(said) == 1 and message in said[0]
    same(motion, expected, 1e-5)


def test_points_that_are_no_lengths_are_left_out(tmp_path: Path, expected: Motion) -> None:
    units = texts(["mm"] * len(LABELS) + ["deg"])
    points = np.concatenate([POINTS, np.full((40, 1, 3), 90.0)], axis=1)
    path = having(POINT__UNITS=units).write(tmp_path / "walk.c3d", [*LABELS, "LKneeAngles"], points)
    same(read_quietly(path)[0], expected)


@pytest.mark.parametrize("last", [65535, 66000 - 65536], ids=["at its end", "over its end"])
def test_more_frames_than_the_header_can_count(tmp_path: Path, last: int) -> None:
    points = np.random.default_rng(1).normal(size=(66000, 2, 3))
    writer = having({4: last}, POINT__FRAMES=(2, (), words(last)), POINT__LONG_FRAMES=(4, (), floats(66000)))
    found = read_c3d_points(writer.write(tmp_path / "long.c3d", ["a", "b"], points), MotionError, 1 << 24)
    np.testing.assert_allclose(found.points, points, atol=1e-6)


def test_names_after_the_255th_are_read(tmp_path: Path) -> None:
    labels = [f"P{n}" for n in range(600)]
    path = PLAIN.write(tmp_path / "many.c3d", labels, np.ones((2, 600, 3)))
    assert read_c3d_points(path, MotionError, 1 << 24).labels == tuple(labels)


REFUSED = {
    "no header": (lambda data: b"hello" * 200, "not a C3D file that can be read"),
    "unknown processor": (lambda data: data[:515] + b"\7" + data[516:], "not a C3D file that can be read"),
    "no points": (lambda data: data.replace(b"LABELS", b"LOBELS"), "no names of the points (POINT:LABELS)"),
    "unknown unit": (
        lambda data: data.replace(b"\1mm", b"\1ly"),
        "unknown unit 'ly'; known are m, dm, cm, mm",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_points_is_refused(tmp_path: Path, case: str) -> None:
    damage, message = REFUSED[case]
    path = PLAIN.write(tmp_path / "walk.c3d", LABELS, POINTS)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(MotionError) as caught:
        read_quietly(path)
    assert message in str(caught.value) and caught.value.path == str(path)


# Segments

SEGMENTS = {
    "pelvis": (TRUTH["LeftHip"] + TRUTH["RightHip"]) / 2,
    "torso": TRUTH["Neck"],
    "head": TRUTH["Head"],
    **{
        f"{side[0].lower()}_{name}": TRUTH[side + role]
        for side in ("Left", "Right")
        for role, name in {
            "Hip": "thigh", "Knee": "shank", "Ankle": "foot", "Toe": "toes",
            "Shoulder": "uarm", "Elbow": "larm", "Wrist": "hand",
        }.items()
    },
}  # fmt: skip
OTHERS = (["Ball", "Wand"], np.ones((40, 2, 3)))


@pytest.mark.parametrize("points", [([], np.zeros((40, 0, 3))), OTHERS, (LABELS, POINTS)])
def test_segments_are_a_person_where_points_are_none(
    tmp_path: Path, points: tuple[list[str], Array], expected: Motion
) -> None:
    names = [f"{name}_4X4" for name in SEGMENTS]
    writer = replace(PLAIN, segments=(names, np.stack([*SEGMENTS.values()], axis=1)))
    motion, said = read_quietly(writer.write(tmp_path / "walk.c3d", *points))
    assert said == []
    if points[0] == LABELS:
        same(motion, expected)
    else:
        near(motion, 1e-5)
    assert to_world(motion).frame.up == "z"


def test_a_file_of_neither_points_nor_segments_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match="the file has no points"):
        read_motion(PLAIN.write(tmp_path / "none.c3d", [], np.zeros((40, 0, 3))))


# Names

#: Names of sets for Plug-in Gait's: ``-`` and ``+`` stand for the side, ``=`` for a marker in the middle.
SETS = {
    "Cleveland Clinic": "ASI -ASI, SAC =VSAC, KNE -KNE, ANK -ANK, HEE -HEE, SHO -SHO, ELB -ELB, WRA -WRI",
    "Helen Hayes": "ASI -.ASIS, SAC =V.Sacral, KNE -.Knee, ANK -.Ankle, SHO -.Shoulder, ELB -.Elbow, "
    "WRA -.Wrist",
    "IOR": "ASI -ASIS, PSI -PSIS, KNE -LE, KNM -ME, ANK -LM, ANM -MM, HEE -CA, TOE -SM, SHO -A, ELB -EL, "
    "ELM -EM",
    "CAST": "ASI -_IAS, PSI -_IPS, KNE -_FLE, KNM -_FME, ANK -_FAL, ANM -_TAM, HEE -_FCC, SHO -_SAJ, "
    "ELB -_HLE, ELM -_HME",
    "PAF": "ASI -_ASIS, SAC =SACR, KNE -_LFE, KNM -_MFE, ANK -_LMAL, ANM -_MMAL, SHO -_ACR, ELB -_LHE, "
    "ELM -_MHE",
    "Motive, biomechanics": "ASI -IAS, PSI -IPS, KNE -FLE, KNM -FME, ANK -FAL, ANM -TAM, SHO -CAJ, ELB -HLE, "
    "ELM -HME",
    "Xsens": "ASI p+ASI, SAC =pSacrum, KNE p+KneeLatEpicondyle, KNM p+KneeMedEpicondyle, "
    "ANK p+LatMalleolus, ANM p+MedMalleolus, SHO p+Acromion, ELB p+ArmLatEpicondyle, "
    "ELM p+ArmMedEpicondyle, C7 =pC7SpinalProcess",
    "Visual3D": "ASI -ASIS, PSI -PSIS, KNE -LK, KNM -MK, ANK -LA, ANM -MA, SHO -SHLD, ELB -LE, ELM -ME",
    "OpenCap": "ASI -.ASIS_study, PSI -.PSIS_study, KNE -_knee_study, KNM -_mknee_study, "
    "ANK -_ankle_study, ANM -_mankle_study, SHO -_shoulder_study, ELB -_lelbow_study, ELM -_melbow_study, "
    "C7 =C7_study",
    "sacrum S2": "ASI -ASI, SAC =S2, KNE -KNE, ANK -ANK, SHO -SHO, ELB -ELB, WRA -WRA",
    "acromion AC": "ASI -ASI, PSI -PSI, KNE -KNE, ANK -ANK, SHO -AC, ELB -ELB, WRA -WRA",
}
BOTH_SIDES = dict(MARKERS)
for side, letter in (("Left", "L"), ("Right", "R")):
    for lateral, medial, joint in (("KNE", "KNM", "Knee"), ("ANK", "ANM", "Ankle"), ("ELB", "ELM", "Elbow")):
        BOTH_SIDES[letter + medial] = 2 * TRUTH[side + joint] - BOTH_SIDES[letter + lateral]
BOTH_SIDES["SAC"] = (BOTH_SIDES["LPSI"] + BOTH_SIDES["RPSI"]) / 2


def renamed(family: str) -> dict[str, Array]:
    """Markers with the names of a set."""
    out = {}
    for marker, name in (pair.split() for pair in SETS[family].split(", ")):
        if name.startswith("="):
            out[name[1:]] = BOTH_SIDES[marker]
            continue
        for word, letter in (("Left", "L"), ("Right", "R")):
            out[name.replace("-", letter).replace("+", word)] = BOTH_SIDES[letter + marker]
    return out


@pytest.mark.parametrize("family", SETS)
def test_sets_of_markers_are_a_person(tmp_path: Path, family: str) -> None:
    points = renamed(family)
    motion, said = read_quietly(
        PLAIN.write(tmp_path / "walk.c3d", list(points), np.stack([*points.values()], 1))
    )
    assert said == []
    for role in ("LeftHip", "RightKnee", "LeftAnkle", "LeftShoulder", "RightElbow"):
        place = motion.world_positions()[:, motion.joint(role)]
        assert np.linalg.norm(place - TRUTH[role], axis=1).max() < 0.02, role
    # the sides are not exchanged, and the axes are those of the file
    assert (to_world(motion).frame.up, to_world(motion).frame.facing) == ("z", "x")


@pytest.mark.parametrize(("place", "fits"), [("SHO", True), ("HEE", False), ("PSI", False), ("ELB", False)])
def test_a_short_name_of_the_acromion_needs_its_place(tmp_path: Path, place: str, fits: bool) -> None:
    points = {**renamed("acromion AC"), **{f"{side}AC": MARKERS[side + place] for side in "LR"}}
    path = PLAIN.write(tmp_path / "walk.c3d", list(points), np.stack([*points.values()], 1))
    if fits:
        assert "LeftShoulder" in read_motion(path).joint_names
        return
    with pytest.raises(MotionError, match="LeftAcromion, RightAcromion are missing for a set of markers"):
        read_motion(path)


def test_a_marker_that_no_frame_has_is_named(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[:, LABELS.index("RKNE")] = np.nan
    with pytest.raises(MotionError, match=r"RightKneeLateral are missing for .*\. No frame has RKNE"):
        read_motion(PLAIN.write(tmp_path / "walk.c3d", LABELS, points))


# Columns of TRC

Trc = Callable[[str], str]


def lines(change: Callable[[list[list[str]]], None]) -> Trc:
    """A change of the fields of all lines."""

    def changed(text: str) -> str:
        rows = [line.split("\t") for line in text.splitlines()]
        change(rows)
        return "\n".join("\t".join(row) for row in rows) + "\n"

    return changed


def add_columns(at: int, seen: bool, declared: bool = True) -> Trc:
    """Add a point without a name before point ``at``."""

    def change(rows: list[list[str]]) -> None:
        start = 2 + 3 * at
        rows[3] += [""] * (2 + 3 * len(LABELS) - len(rows[3]))
        rows[3][start:start] = ["", "", ""]
        for row in rows[5:]:
            row[start:start] = ["1", "2", "3"] if seen else ["", "", ""]
        if declared:
            rows[2][3] = str(len(LABELS) + 1)
            rows[4] += ["X99", "Y99", "Z99"]

    return lines(change)


def header(fields: str) -> Trc:
    return lines(lambda rows: rows[2].__setitem__(slice(None), fields.split(",")))


COLUMNS: dict[str, tuple[Trc, str]] = {
    "nameless at the end": (add_columns(len(LABELS), True), "1 of 29 points have no name, and are left out"),
    "nameless at the end, not declared": (
        add_columns(len(LABELS), True, False),
        "1 of 29 points have no name",
    ),
    "nameless in the middle": (add_columns(9, True), "1 of 29 points have no name"),
    "nameless at the start": (add_columns(0, True), "1 of 29 points have no name"),
    "nameless and blank": (add_columns(9, False), ""),
    "names without blank columns": (lines(lambda rows: rows[3].__setitem__(slice(2, None), LABELS)), ""),
    "two tabs in the header": (header(" 50.0,, 50.0,,   40,,  28,, mm"), ""),
    "two tabs in the names, too": (
        lambda text: header(" 50.0,, 50.0,,   40,,  28,, mm")(text).replace("\tCamera", "\t\tCamera"),
        "",
    ),
    "spelt unit": (header("50.0,50.0,40,28,Millimeters"), ""),
    "wrong unit": (header("50.0,50.0,40,28,m"), "lengths are multiplied by 0.001"),
    "untrue number of points": (header("50.0,50.0,40,99999,mm"), ""),
    "first line without tabs": (lambda text: text.replace("\t4\t(X/Y/Z)\t", " 4 (X/Y/Z) ", 1), ""),
    "tabs at the ends": (lambda text: text.replace("\n", "\t\t\t\t\n"), ""),
}


@pytest.mark.parametrize("case", COLUMNS)
def test_columns_of_trc_are_the_same_motion(tmp_path: Path, case: str, expected: Motion) -> None:
    change, message = COLUMNS[case]
    path = write_trc(tmp_path / "walk.trc", LABELS, POINTS)
    text = change(path.read_text())
    assert text != path.read_text()
    path.write_text(text)
    motion, said = read_quietly(path)
    assert len(said) == bool(message) and all(message in one for one in said)
    same(motion, expected, 1e-5)


# Lost points

LOST: dict[str, tuple[Callable[[Array], None], slice, str]] = {
    "late": (lambda p: p[:25].fill(np.nan), slice(25, 40), "frames 25 to 39 of 40 are used"),
    "early": (lambda p: p[15:].fill(np.nan), slice(0, 15), "frames 0 to 14 of 40 are used"),
    "zeros": (lambda p: p[15:].fill(0), slice(0, 15), "frames 0 to 14 of 40 are used"),
}


@pytest.mark.parametrize("case", LOST)
def test_frames_without_the_person_are_left_out(tmp_path: Path, case: str, expected: Motion) -> None:
    change, kept, message = LOST[case]
    points = POINTS.copy()
    change(points)
    motion, said = read_quietly(PLAIN.write(tmp_path / "walk.c3d", LABELS, points))
    assert len(said) == 1 and message in said[0]
    assert motion.n_frames == kept.stop - kept.start
    found, whole = (each.world_positions()[:, each.joint("LeftKnee")] for each in (motion, expected))
    np.testing.assert_allclose(found, whole[kept], atol=EXACT)


def test_of_two_stays_the_longer_one_is_used(tmp_path: Path) -> None:
    nobody = np.full((60, len(LABELS), 3), np.nan)
    points = np.concatenate([POINTS[:30], nobody, POINTS + np.array([5.0, 0, 0]), nobody])
    motion, said = read_quietly(PLAIN.write(tmp_path / "walk.c3d", LABELS, points))
    assert motion.n_frames == 40 and "frames 90 to 129 of 190 are used" in said[0]
    assert motion.world_positions()[0, motion.joint("Hips"), 0] == pytest.approx(
        TRUTH["Hips"][0, 0] + 5, abs=0.1
    )


def test_a_long_gap_of_a_needed_point_is_filled_and_named(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[8:32, LABELS.index("RKNE")] = np.nan
    motion, said = read_quietly(PLAIN.write(tmp_path / "walk.c3d", LABELS, points))
    assert motion.n_frames == 40 and len(said) == 1
    assert "gaps of RKNE are filled; the longest has 24 frames (8 to 31 of RKNE)" in said[0]
    path = motion.world_positions()[8:32, motion.joint("RightHip")]
    np.testing.assert_allclose(path, TRUTH["RightHip"][8:32], atol=0.02)


def test_a_needed_point_that_is_lost_names_the_frames_that_have_it(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[np.r_[3:20, 23:40], LABELS.index("RKNE")] = np.nan
    with pytest.raises(
        MotionError, match=r"'RKNE' is seen in .*: in frames 0 to 2, 20 to 22\. Fill its gaps"
    ):
        read_motion(PLAIN.write(tmp_path / "walk.c3d", LABELS, points))


# Mirrored people

MIRRORED = {
    "x": np.diag([-1.0, 1, 1]),
    "y": np.diag([1.0, -1, 1]),
    "y and z exchanged": np.eye(3)[[0, 2, 1]],
}


@pytest.mark.parametrize("kind", ["markers", "joints"])
@pytest.mark.parametrize("axes", MIRRORED)
def test_a_mirrored_person_is_mirrored_back_with_a_warning(
    tmp_path: Path, axes: str, kind: str, expected: Motion
) -> None:
    labels, points = (
        (LABELS, POINTS) if kind == "markers" else (list(SEGMENTS), np.stack([*SEGMENTS.values()], 1))
    )
    motion, said = read_quietly(write_trc(tmp_path / "walk.trc", labels, points @ MIRRORED[axes].T))
    assert len(said) == 1 and "the person is mirrored" in said[0]
    world = to_world(motion)
    assert world.frame.up == ("y" if axes == "y and z exchanged" else "z")
    # left is left: the knee of the raised leg is where the path of a right person has it
    knees = [to_world(one).sample(np.arange(40) * 0.02).positions for one in (motion, expected)]
    for role in ("LeftKnee", "RightKnee", "LeftAnkle"):
        heights = [place[:, one.joint(role), 2] for place, one in zip(knees, (motion, expected), strict=True)]
        np.testing.assert_allclose(*heights, atol=0.04)


def test_a_person_with_exchanged_names_is_said(tmp_path: Path) -> None:
    labels = [
        {"L": "R", "R": "L"}.get(name[0], name[0]) + name[1:] if name[:2] != "C7" else name for name in LABELS
    ]
    labels = ["CLAV" if name == "CLAV" or name.endswith("CLAV") else name for name in labels]
    assert any("mirrored" in text for text in read_quietly(write_trc(tmp_path / "w.trc", labels, POINTS))[1])


# Up

#: Axes of the file with an axis up.
UP = {
    "z": np.eye(3),
    "y": Rotation.from_euler("x", -90, degrees=True).as_matrix(),
    "x": Rotation.from_euler("y", 90, degrees=True).as_matrix(),
}
LYING = Rotation.from_euler("y", -90, degrees=True).as_matrix()


def file_of(path: Path, points: Array, screen: str = "") -> Path:
    screens = {"POINT:X_SCREEN": texts(["+X"]), "POINT:Y_SCREEN": texts([screen])} if screen else {}
    return replace(PLAIN, parameters=screens).write(path, LABELS, points)


def still(height: float) -> Array:
    """A person who stands at the origin of the file, above a floor at ``height``."""
    points = np.repeat(
        np.stack([*plug_in_gait(PERSON, raise_arms(1, collar=0)).values()], axis=1), 40, axis=0
    )
    return points @ Z_UP.T - [0, 0, np.nanmin(points[..., 1]) - 0.04] + [0.6, 0.9, height]


@pytest.mark.parametrize("up", UP)
@pytest.mark.parametrize("height", [0.0, 0.7, -0.5])
def test_a_person_who_walks_stands(tmp_path: Path, up: str, height: float) -> None:
    path = file_of(tmp_path / "walk.c3d", (POINTS + np.array([0, 0, height])) @ UP[up].T)
    frame = to_world(read_quietly(path)[0]).frame
    assert frame.up == up and (frame.warning is None) == (up != "x")


@pytest.mark.parametrize("up", UP)
@pytest.mark.parametrize("height", [0.0, 0.7])
def test_a_static_trial_stands_without_a_warning(tmp_path: Path, up: str, height: float) -> None:
    frame = to_world(read_quietly(file_of(tmp_path / "static.c3d", still(height) @ UP[up].T))[0]).frame
    assert frame.up == up and (frame.warning is None) == (up != "x")


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("yaw", [0, 90, 200])
def test_a_person_who_lies_on_the_floor_lies(tmp_path: Path, up: str, yaw: int) -> None:
    turn = Rotation.from_euler("z", yaw, degrees=True).as_matrix() @ LYING
    points = still(0.0) @ turn.T
    points += [2.5, 2.7, 0.03 - points[..., 2].min()]
    motion, _ = read_quietly(file_of(tmp_path / "lie.c3d", points @ UP[up].T))
    frame = to_world(motion).frame
    assert frame.up == up and frame.warning is not None and f"{up} is taken as up" in frame.warning


@pytest.mark.parametrize(("screen", "up"), [("+Z", "z"), ("-Z", "z"), ("", "-x")])
def test_the_screen_of_a_program_says_that_a_person_lies_on_a_bed(
    tmp_path: Path, screen: str, up: str
) -> None:
    points = still(0.0) @ LYING.T
    points += [2.5, 2.7, 0.8 - points[..., 2].min()]
    frame = to_world(read_quietly(file_of(tmp_path / "bed.c3d", points, screen))[0]).frame
    assert frame.up == up


def test_the_screen_does_not_make_a_walk_lie(tmp_path: Path) -> None:
    path = file_of(tmp_path / "walk.c3d", (POINTS + np.array([0, 0, 0.7])) @ UP["y"].T, "+Z")
    assert to_world(read_quietly(path)[0]).frame.up == "y"
