"""ASF/AMC motions: where their joints are, how the skeleton is found, and what is refused."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from motion_files import stand_in, walk
from motion_formats import CMU_UNIT, write_acclaim

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.motion import WorldMotion, read_motion, to_world

PERSON = stand_in("cmu_asf")


def world_of(path: Path | str) -> WorldMotion:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)
        return to_world(read_motion(path))


@pytest.mark.parametrize("order", ["xyz", "zyx", "yxz"])
@pytest.mark.parametrize(("units", "length", "unit"), [("deg", 0.45, CMU_UNIT), ("rad", 1.0, 0.01)])
def test_joints_are_where_forward_kinematics_puts_them(
    tmp_path: Path, units: str, length: float, unit: float, order: str
) -> None:
    turns, root = walk(12, heading=30), np.linspace([0, 0, 0], [5, 2, 90], 12)
    path = write_acclaim(tmp_path, PERSON, turns, root, units=units, length=length, unit=unit, order=order)
    with pytest.warns(HumansimWarning, match="states no rate: 120 frames per second"):
        motion = read_motion(path)
    expected = PERSON.positions(turns, root) * 0.01
    found = motion.world_positions() * unit
    joints = [motion.joint(name) for name in ("root", *PERSON.names[1:])]
    np.testing.assert_allclose(found[:, joints], expected[:, : len(joints)], atol=1e-6)
    ends = [motion.joint(f"{PERSON.names[joint]}_end") for joint in PERSON.ends]
    np.testing.assert_allclose(found[:, ends], expected[:, len(joints) :], atol=1e-6)
    assert motion.frame_time == pytest.approx(1 / 120)


def test_a_walk_is_matched_by_names_and_has_the_unit_of_cmu(tmp_path: Path) -> None:
    world = world_of(write_acclaim(tmp_path, PERSON, walk(30)))
    assert (world.match.table, world.match.by, world.match.confidence) == ("cmu_asf", "names", 1.0)
    assert world.frame.up == "y" and world.frame.facing == "z"
    assert world.frame.unit == pytest.approx(CMU_UNIT) and 1.5 < world.frame.stature < 1.9


def test_translations_of_a_bone_move_it_in_its_axes(tmp_path: Path) -> None:
    path = write_acclaim(tmp_path, PERSON, {})
    asf, amc = path.with_suffix(".asf"), path
    head = PERSON.names[PERSON.joint("Head")]
    found = re.search(rf"name {head}\n(.*\n)*?  end", asf.read_text())
    assert found is not None
    before = found[0]
    changed = re.sub(r"axis .*", "axis 0 0 90 XYZ", before).replace("dof rx ry rz", "dof ty rx ry rz")
    asf.write_text(asf.read_text().replace(before, changed))
    amc.write_text(re.sub(rf"(?m)^{head} .*", f"{head} 2 0 0 0", amc.read_text()))
    with pytest.warns(HumansimWarning):
        motion = read_motion(path)
    joint = motion.joint(head)
    # 2 units along the y axis of the bone, which is -x of the file
    expected = PERSON.positions({})[0, PERSON.joint("Head")] * 0.01 / CMU_UNIT + (-2, 0, 0)
    np.testing.assert_allclose(motion.world_positions(0)[joint], expected, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "skeletons", "found"),
    [
        ("walk.amc", ["walk", "other"], "walk"),
        ("07_01.amc", ["07", "08"], "07"),
        ("07_01.amc", ["12"], "12"),
        ("07_01.amc#sub/12.asf", ["07", "sub/12"], "sub/12"),
    ],
)
def test_the_skeleton_of_the_motion_is_found(
    tmp_path: Path, name: str, skeletons: list[str], found: str
) -> None:
    path = write_acclaim(tmp_path, PERSON, walk(2))
    text = path.with_suffix(".asf").read_text()
    path.with_suffix(".asf").unlink()
    (tmp_path / "sub").mkdir()
    for skeleton in skeletons:
        moved = "position 3 0 0" if skeleton == found else "position 0 0 0"
        (tmp_path / f"{skeleton}.asf").write_text(text.replace("position 0 0 0", moved))
    path.rename(tmp_path / name.partition("#")[0])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        motion = read_motion(tmp_path / name)
    assert motion.offsets[0].tolist() == [3, 0, 0]
    assert any("only .asf file" in str(w.message) for w in caught) == (found == "12")


@pytest.mark.parametrize(
    ("part", "others", "message"),
    [
        ("", [], "its skeleton is missing: put walk.asf beside it, or name the file: walk.amc#NAME.asf"),
        ("", ["a", "b"], "there are a.asf, b.asf"),
        ("#gone.asf", [], "no such ASF skeleton file"),
        ("#../out.asf", [], "is not in the folder of the motion"),
    ],
)
def test_a_missing_skeleton_is_asked_for(tmp_path: Path, part: str, others: list[str], message: str) -> None:
    path = write_acclaim(tmp_path, PERSON, walk(2))
    asf = path.with_suffix(".asf")
    for other in others:
        (tmp_path / f"{other}.asf").write_text(asf.read_text())
    asf.unlink()
    with pytest.raises(MotionError, match=re.escape(message)):
        read_motion(f"{path}{part}")


def test_a_skeleton_alone_is_no_motion(tmp_path: Path) -> None:
    path = write_acclaim(tmp_path, PERSON, walk(2)).with_suffix(".asf")
    with pytest.raises(MotionError, match=r"walk\.asf: this is a skeleton without a motion: give the \.amc"):
        read_motion(path)


def test_a_stated_rate_counts(tmp_path: Path) -> None:
    path = write_acclaim(tmp_path, PERSON, walk(3))
    path.write_text(path.read_text().replace(":DEGREES", ":DEGREES\n:SAMPLES-PER-SECOND 60"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert read_motion(path).frame_time == pytest.approx(1 / 60)


def test_a_file_that_ends_within_a_frame_has_the_frames_before(tmp_path: Path) -> None:
    path = write_acclaim(tmp_path, PERSON, walk(5))
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-4]))
    with pytest.warns(HumansimWarning, match="ends within frame 5: this frame is left out"):
        assert read_motion(path).n_frames == 4


HEAD = r"(?m)^head .*"
BAD_MOTIONS = {
    "a bone that the skeleton lacks": (r"(?m)^head", "skull", "bone 'skull' does not exist in walk.asf"),
    "too few values": (HEAD, "head 1 2", "bone 'head' has the 3 values rx ry rz in walk.asf, not '1 2'"),
    "not a number": (HEAD, "head 1 x 3", "bone 'head' has the 3 values"),
    "infinite": (HEAD, "head 1 inf 3", "bone 'head' has the 3 values"),
    "nan": (HEAD, "head 1 nan 3", "bone 'head' has the 3 values"),
    "twice": (HEAD, "head 1 2 3\nhead 1 2 3", "bone 'head' is given twice"),
    "missing in a frame": (HEAD + r"\n", "", r"this frame has no values of head"),
    "no frame number": (r"(?m)^1\n", "", "a line before the number of the first frame"),
    "impossible rate": (":DEGREES", ":SAMPLES-PER-SECOND 0", "0 frames per second are not possible"),
    "no frames": (r"(?s)\n1\n.*", "\n", "it has no frames"),
}


@pytest.mark.parametrize("case", BAD_MOTIONS)
def test_a_wrong_motion_is_refused_with_its_line(tmp_path: Path, case: str) -> None:
    before, after, message = BAD_MOTIONS[case]
    path = write_acclaim(tmp_path, PERSON, walk(3))
    path.write_text(re.sub(before, after, path.read_text(), count=1))
    with pytest.raises(MotionError, match=re.escape(message)) as caught:
        read_motion(path)
    assert caught.value.path == str(path)
    assert (caught.value.line is None) == (case == "no frames")


BAD_SKELETONS = {
    "no bones": (r"(?s):bonedata.*:hierarchy", ":hierarchy", "it has no section :bonedata"),
    "no hierarchy": (r"(?s):hierarchy.*", "", "it has no section :hierarchy"),
    "empty hierarchy": (r"(?s):hierarchy.*", ":hierarchy\n  begin\n  end\n", "no bone below the root"),
    "unknown angles": ("angle deg", "angle gon", "unknown unit of angles 'gon': deg or rad"),
    "unknown scale": ("length 0.45", "length inch", "length needs 1 finite numbers, not 'inch'"),
    "negative scale": ("length 0.45", "length -1", "must be above 0"),
    "cut off": (r"(?s)(.*direction).*", r"\1 0 1 0\n:hierarchy\nbegin\nend\n", "a bone without 'end'"),
    "unknown bone": (":hierarchy\n  begin", ":hierarchy\n  begin\n  root ghost", "no bone 'ghost'"),
    "two parents": (":hierarchy\n  begin", ":hierarchy\n  begin\n  root head", "bone 'head' has two parents"),
    "a cycle": ("lowerback thorax\n", "lowerneck thorax\n", "thorax, lowerneck, thorax_to_lowerneck are"),
    "a name twice": ("name head", "name thorax", "a bone needs a name of its own"),
    "unknown dof": ("dof rx ry rz", "dof rx ry rw", "degrees of freedom are tx, ty, tz, rx, ry, rz"),
    "bad axis": (r"XYZ\n     dof", "XXZ\n     dof", "an order of axes is XYZ"),
    "huge": (r"direction .*", "direction 1e300 0 0", "direction needs 3 finite numbers"),
    "outside": (r"begin\n     id 1\n", "", "'name' outside 'begin' and 'end'"),
}


@pytest.mark.parametrize("case", BAD_SKELETONS)
def test_a_wrong_skeleton_is_refused_with_its_file(tmp_path: Path, case: str) -> None:
    before, after, message = BAD_SKELETONS[case]
    path = write_acclaim(tmp_path, PERSON, walk(3))
    asf = path.with_suffix(".asf")
    asf.write_text(re.sub(before, after, asf.read_text(), count=1))
    with pytest.raises(MotionError, match=re.escape(message)) as caught:
        read_motion(path)
    assert caught.value.path == str(asf)


def test_a_skeleton_of_too_many_bones_is_refused(tmp_path: Path) -> None:
    path = write_acclaim(tmp_path, PERSON, walk(2))
    bones = "\n".join(f"begin\nname b{n}\nend" for n in range(2000))
    asf = path.with_suffix(".asf")
    asf.write_text(asf.read_text().replace(":bonedata", f":bonedata\n{bones}"))
    with pytest.raises(MotionError, match="more than 1000 bones"):
        read_motion(path)


def test_files_of_cmu_are_a_person(shared_data: Path, tmp_path: Path) -> None:
    for name in ("07_01.amc", "12.asf"):
        (tmp_path / name).write_bytes((shared_data / "other" / name).read_bytes())
    world = world_of(tmp_path / "07_01.amc")
    assert world.match.table == "cmu_asf" and world.match.confidence == 1
    assert 1.4 < world.frame.stature < 1.9 and world.frame.up == "y"
    assert world.motion.n_frames == 316
