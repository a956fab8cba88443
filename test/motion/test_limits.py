"""Joint limits: angles of known poses, properties of clamping, real motions."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from conftest import ROOT, if_shared
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from stand_ins import STAND_INS
from test_retarget import at_frames, in_world, read, some_frames

from humansim_ros.errors import MotionError
from humansim_ros.motion import Skeleton, hanim_skeleton
from humansim_ros.motion.body.skeleton import FINGERS, side_of
from humansim_ros.motion.pose.limits import JointLimits, Limit, load_limits
from humansim_ros.motion.pose.retarget import Retargeter
from humansim_ros.people.loading.loading import load_human
from humansim_ros.types import Array

TABLE = ROOT / "config" / "joint_limits" / "normal.yaml"
GENERAL = hanim_skeleton()


def standing(arm_angle: float = 0.0, leg_angle: float = 0.0, seed: int = 0) -> Skeleton:
    """A person with straight limbs, arms below a T pose and legs apart (degrees), and random rolls."""
    heads, tails = GENERAL.heads.copy(), GENERAL.tails.copy()
    c, s = np.cos(np.radians([arm_angle, leg_angle])), np.sin(np.radians([arm_angle, leg_angle]))
    for side, x in (("l", 1), ("r", -1)):
        for names, way in (
            (("sternoclavicular", "shoulder", "elbow", "wrist"), [x * c[0], -s[0], 0]),
            (("hip", "knee"), [x * s[1], -c[1], 0]),
        ):
            for name in names:
                bone = GENERAL.bone(f"{side}_{name}")
                if name in ("elbow", "wrist", "knee"):
                    heads[bone] = tails[GENERAL.parents[bone]]
                along = [x, 0, 0] if name == "sternoclavicular" else way
                tails[bone] = heads[bone] + GENERAL.lengths[bone] * np.array(along)
                if name == "sternoclavicular":
                    heads[GENERAL.bone(f"{side}_shoulder")] = tails[bone]
        foot = GENERAL.bone(f"{side}_ankle")
        tails[foot] += tails[GENERAL.bone(f"{side}_knee")] - heads[foot]
        heads[foot] = tails[GENERAL.bone(f"{side}_knee")]
    rolls = np.random.default_rng(seed).uniform(-3, 3, len(GENERAL))
    return replace(GENERAL, heads=heads, tails=tails, rolls=rolls)


T_POSE = standing()
LIMITS = load_limits().for_skeleton(T_POSE)
NAMES = [(bone, row) for row in LIMITS.table.joints for bone in row.sides]


def rotations(skeleton: Skeleton, turns: dict[str, Rotation]) -> Array:
    """Bone rotations (1, B, 4) of bones rotated in body axes relative to their parents."""
    out = np.tile([0.0, 0, 0, 1], (1, len(skeleton), 1))
    for name, turn in turns.items():
        bone = skeleton.bone(name)
        rest = Rotation.from_matrix(skeleton.rest[bone, :3, :3])
        out[0, bone] = (rest.inv() * turn * rest).as_quat()
    return out


def about(axes: str, *degrees: float) -> Rotation:
    """Rotations about body axes (x left, y up, z front), one after the other about the moving axes."""
    return Rotation.from_euler(axes.upper(), degrees, degrees=True)


@pytest.mark.parametrize(
    ("turns", "expected"),
    [
        ({}, {}),
        ({"l_elbow": about("y", -90)}, {"l_elbow.flexion": 90}),
        ({"r_elbow": about("y", 90)}, {"r_elbow.flexion": 90}),
        ({"l_elbow": about("y", 8)}, {"l_elbow.flexion": -8}),
        ({"l_elbow": about("x", 60)}, {"l_elbow.pronation": 60, "l_wrist.pronation": 60}),
        (
            {"r_elbow": about("x", 30), "r_wrist": about("x", 25)},
            {"r_elbow.pronation": 30, "r_wrist.pronation": 55},
        ),
        ({"l_wrist": about("z", -70)}, {"l_wrist.flexion": 70}),
        ({"r_wrist": about("y", 15)}, {"r_wrist.radial deviation": 15}),
        ({"l_knee": about("x", 60)}, {"l_knee.flexion": 60}),
        ({"l_knee": about("xy", 90, -25)}, {"l_knee.flexion": 90, "l_knee.internal rotation": 25}),
        ({"r_hip": about("x", -45)}, {"r_hip.flexion": 45}),
        ({"r_hip": about("z", -30)}, {"r_hip.abduction": 30}),
        ({"l_hip": about("xy", -90, -40)}, {"l_hip.flexion": 90, "l_hip.internal rotation": 40}),
        (
            {"l_hip": about("x", 20), "l_ankle": about("x", -10)},
            {"l_hip.flexion": -20, "l_ankle.dorsiflexion": 10},
        ),
        ({"l_ankle": about("z", -25)}, {"l_ankle.inversion": 25}),
        # the arm hanging, lifted from there to the front, and crossed in front of the chest
        ({"l_shoulder": about("z", -90)}, {"l_shoulder.abduction": 0}),
        ({"l_shoulder": about("z", -80)}, {"l_shoulder.abduction": 10}),
        ({"r_shoulder": about("xz", -60, 90)}, {"r_shoulder.flexion": 60, "r_shoulder.abduction": 0}),
        ({"l_shoulder": about("x", 50)}, {"l_shoulder.abduction": 90, "l_shoulder.internal rotation": 50}),
        (
            {"r_sternoclavicular": about("z", -20)},
            {"r_sternoclavicular.elevation": 20, "r_shoulder.abduction": 110},
        ),
        ({"vt3": about("y", 70)}, {"vt3.rotation left": 70}),
        ({"vt3": about("x", 40)}, {"vt3.flexion": 40}),
        ({"vl5": about("z", 20)}, {"vl5.bending left": -20}),
        (
            {"sacroiliac": about("x", 30), "vl5": about("x", 25)},
            {"sacroiliac.flexion": 30, "vl5.flexion": 55},
        ),
        # bones that move with the hips are not bent
        ({"HumanoidRoot": about("xyz", 40, 50, 60)}, {}),
    ],
)
def test_poses_have_the_angles_a_goniometer_shows(
    turns: dict[str, Rotation], expected: dict[str, float]
) -> None:
    expected = {"l_shoulder.abduction": 90, "r_shoulder.abduction": 90, **expected}
    for name, value in LIMITS.angles(rotations(T_POSE, turns)).items():
        if name == "r_shoulder.internal rotation" and "r_shoulder" in turns:
            continue  # an arm hanging by flexion has another zero of rotation than one by abduction
        assert value[0] == pytest.approx(expected.get(name, 0), abs=1e-6), name


@pytest.mark.parametrize(
    ("turns", "bone", "angle", "worst"),
    [
        ({"l_elbow": about("y", 25)}, "l_elbow", "extension", 25),
        ({"r_knee": about("x", 170)}, "r_knee", "flexion", 170),
        ({"l_hip": about("x", -140)}, "l_hip", "flexion", 140),
        ({"r_hip": about("x", 50)}, "r_hip", "extension", 50),
        ({"l_hip": about("z", 65)}, "l_hip", "abduction", 65),
        ({"vt3": about("y", -100)}, "vt3", "rotation right", 100),
        # the border falls from 90 degrees off the side at 70 of extension to 55 straight back
        ({"l_shoulder": about("xz", 72, -90)}, "l_shoulder", "extension", 70 + 35 * 2 / 20),
        ({"r_shoulder": about("y", -70)}, "r_shoulder", "horizontal abduction", 70),
        ({"l_shoulder": about("y", -155)}, "l_shoulder", "horizontal adduction", 155),
        ({"l_shoulder": about("z", 115)}, "l_shoulder", "elevation", 205),
        ({"l_elbow": about("x", 60), "l_wrist": about("x", 60)}, "l_wrist", "pronation", 120),
    ],
)
def test_violations_are_reported_with_their_degrees(
    turns: dict[str, Rotation], bone: str, angle: str, worst: float
) -> None:
    still, wrong = rotations(T_POSE, {}), rotations(T_POSE, turns)
    found = LIMITS.report(np.concatenate([still, still, wrong, still]))
    named = [v for v in found if (v.bone, v.angle) == (bone, angle)]
    assert len(named) == 1, found
    assert (named[0].frame, named[0].share) == (2, 0.25)
    assert named[0].worst == pytest.approx(worst, abs=1e-6)
    row = next(r for name, joint in NAMES if name == bone for r in joint.rows if r.angle == angle)
    assert named[0].limit == pytest.approx(row.degrees + LIMITS.table.margin)
    assert {v.bone for v in found} == {bone}
    json.dumps([asdict(v) for v in found], allow_nan=False)


def test_standing_sitting_and_reaching_up_are_within_the_limits() -> None:
    poses = [
        {},
        {f"{s}_hip": about("x", -90) for s in "lr"} | {f"{s}_knee": about("x", 90) for s in "lr"},
        # arms up with the palms to each other, down, forward, hands on hips
        {
            "l_shoulder": about("zy", 90, -0) * about("x", -90),
            "r_shoulder": about("z", -90) * about("x", -90),
        },
        {"l_shoulder": about("z", -90), "r_shoulder": about("z", 90)},
        {"l_shoulder": about("y", -90), "r_shoulder": about("y", 90)},
        {"l_shoulder": about("z", -50) * about("x", 60), "l_elbow": about("y", -100)},
        {"vl5": about("x", 60), "vt3": about("y", 75)},
    ]
    for number, pose in enumerate(poses):
        assert LIMITS.report(rotations(T_POSE, pose)) == [], number
    assert load_limits().report(rotations(GENERAL, {})) == []


quaternions = st.integers(0, 2**32 - 1).map(np.random.default_rng)


def anything(rng: np.random.Generator, n: int, most: float = 180.0) -> Array:
    """Bone rotations (n, B, 4) by up to ``most`` degrees about random axes."""
    axes = rng.normal(size=(n, len(T_POSE), 3))
    axes *= np.radians(rng.uniform(0, most, (n, len(T_POSE), 1))) / np.linalg.norm(
        axes, axis=-1, keepdims=True
    )
    return Rotation.from_rotvec(axes.reshape(-1, 3)).as_quat().reshape(n, len(T_POSE), 4)


def degrees_between(a: Array, b: Array) -> Array:
    difference = Rotation.from_quat(a.reshape(-1, 4)).inv() * Rotation.from_quat(b.reshape(-1, 4))
    return np.degrees(difference.magnitude()).reshape(a.shape[:-1])


@settings(max_examples=25, deadline=None)
@given(rng=quaternions)
def test_clamped_poses_are_within_the_limits_and_do_not_change_again(rng: np.random.Generator) -> None:
    clamped = LIMITS.clamp(anything(rng, 20))
    assert LIMITS.report(clamped) == []  # to 1e-6 degrees
    assert degrees_between(LIMITS.clamp(clamped), clamped).max() < 1e-5


@pytest.mark.nightly
@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(rng=quaternions)
def test_poses_within_the_limits_stay_the_same_to_the_bit(rng: np.random.Generator) -> None:
    poses = anything(rng, 40, 25)
    inside = np.array([not LIMITS.report(pose[None]) for pose in poses])
    np.testing.assert_array_equal(LIMITS.clamp(poses)[inside], poses[inside])


@settings(max_examples=25, deadline=None)
@given(rng=quaternions)
def test_clamping_changes_only_angles_beyond_the_limit(rng: np.random.Generator) -> None:
    pose = anything(rng, 1, 70)
    before, after = LIMITS.angles(pose), LIMITS.angles(LIMITS.clamp(pose))
    for bone in ("sacroiliac", "vt3", "l_sternoclavicular", "r_elbow", "l_knee", "r_ankle"):
        joint = dict(NAMES)[bone]
        assert joint.first is not None and joint.second is not None
        for one, other in (joint.first, joint.second, joint.twist):
            name = f"{bone}.{one.angle}"
            low, high = -other.degrees - LIMITS.table.margin, one.degrees + LIMITS.table.margin
            assert after[name][0] == pytest.approx(np.clip(before[name][0], low, high), abs=1e-6)


@settings(max_examples=25, deadline=None)
@given(rng=quaternions)
def test_clamping_a_cone_keeps_the_azimuth_of_the_bone(rng: np.random.Generator) -> None:
    """The clamped bone is on the great circle from the middle of its cone."""
    bone = T_POSE.bone("r_hip")
    turn = about("y", rng.uniform(0, 360)) * about("x", rng.uniform(0, 170))
    pose = rotations(T_POSE, {"r_hip": turn})
    before, after = (T_POSE.pose(p)[0, bone, :3, 1] for p in (pose, LIMITS.clamp(pose)))
    down = np.array([0.0, -1, 0])
    assert np.cross(down, before) @ after == pytest.approx(0, abs=1e-9)
    assert np.cross(down, before) @ np.cross(down, after) >= 0
    assert after @ down >= before @ down - 1e-12


@pytest.mark.nightly
@settings(max_examples=40, deadline=None)
@given(rng=quaternions)
def test_clamping_is_continuous(rng: np.random.Generator) -> None:
    """Except where it cannot be: a hinge at a right angle to its plane, an arm through the trunk."""
    pose = anything(rng, 30, 70)
    kept = [
        T_POSE.bone(name)
        for name in ("HumanoidRoot", "sacroiliac", "l_sternoclavicular", "r_sternoclavicular")
    ]
    pose[:, kept] = [0, 0, 0, 1]
    step = Rotation.from_rotvec(rng.normal(size=(pose[..., 0].size, 3)) * 1e-7)
    moved = (Rotation.from_quat(pose.reshape(-1, 4)) * step).as_quat().reshape(pose.shape)
    moved *= np.sign(np.sum(moved * pose, axis=-1, keepdims=True))
    before, after = LIMITS.clamp(pose), LIMITS.clamp(moved)
    assert np.abs(before - after).max() < 30 * np.abs(pose - moved).max()


@settings(max_examples=20, deadline=None)
@given(rng=quaternions)
def test_a_mirrored_pose_has_the_angles_of_the_other_side(rng: np.random.Generator) -> None:
    turns = {name: Rotation.random(random_state=rng.integers(1 << 30)) for name in T_POSE.names}
    mirror = np.diag([-1.0, 1, 1])
    swapped = {
        ("r" + n[1:] if side_of(n) > 0 and n[0] == "l" else "l" + n[1:]) if n[:2] in ("l_", "r_") else n: n
        for n in T_POSE.names
    }
    other = {
        name: Rotation.from_matrix(mirror @ turns[twin].as_matrix() @ mirror)
        for name, twin in swapped.items()
    }
    for name in ("HumanoidRoot_to_l_hip", "HumanoidRoot_to_r_hip"):
        turns[name] = other[name] = Rotation.identity()
    for name in ("vl5_to_l_sternoclavicular", "vl5_to_r_sternoclavicular"):
        turns[name] = other[name] = Rotation.identity()
    ours, theirs = (LIMITS.angles(rotations(T_POSE, t)) for t in (turns, other))
    for name, value in ours.items():
        bone, angle = name.split(".")
        sign = -1 if angle.endswith(" left") else 1
        np.testing.assert_allclose(theirs[f"{swapped[bone]}.{angle}"], sign * value, atol=1e-6, err_msg=name)


def test_angles_do_not_depend_on_the_pose_the_skeleton_was_made_in() -> None:
    """The same person at rest in a T pose, and with lowered arms and legs, in the same poses."""
    other = standing(40.0, 8.0, seed=1)
    lowered = {
        f"{side}_{name}": about("z", sign * angle)
        for side, sign in (("l", 1), ("r", -1))
        for name, angle in (("shoulder", -40), ("hip", 8))
    }
    in_rest = T_POSE.pose(rotations(T_POSE, lowered))[0] @ T_POSE.rest_inverse
    # the feet stay level
    for name in ("l_ankle", "r_ankle"):
        in_rest[T_POSE.bone(name), :3, :3] = np.eye(3)
    poses = anything(np.random.default_rng(5), 30, 100)
    turned = (T_POSE.pose(poses) @ T_POSE.rest_inverse)[..., :3, :3] @ np.swapaxes(in_rest, -1, -2)[
        ..., :3, :3
    ]
    own = np.empty((30, len(other), 4))
    for bone, parent in enumerate(other.parents):
        above = turned[:, parent] if parent >= 0 else np.eye(3)
        local = (
            other.rest[bone, :3, :3].T
            @ np.swapaxes(above, -1, -2)
            @ turned[:, bone]
            @ other.rest[bone, :3, :3]
        )
        own[:, bone] = Rotation.from_matrix(local).as_quat()
    ours, theirs = LIMITS.angles(poses), LIMITS.for_skeleton(other).angles(own)
    for name, value in ours.items():
        np.testing.assert_allclose(theirs[name], value, atol=1e-6, err_msg=name)


@pytest.mark.daily("own_biovision", "own_rokoko")
@pytest.mark.parametrize(
    "stem",
    [
        *("walk", *STAND_INS),
        *if_shared("pybvh_cmu_12_01_walk", "bvhtoolbox_walk01", "mixamo_freebvh", "pybvh_test1"),
    ],
)
def test_ordinary_motions_stay_within_the_limits(stem: str) -> None:
    motion = read(stem)
    world = in_world(motion)
    turned, _ = Retargeter.fit(world, GENERAL).apply(at_frames(world, some_frames(motion, 300)))
    found = load_limits().report(turned)
    assert found == []


@pytest.fixture(scope="module")
def people() -> JointLimits:
    """Limits of a built-in human."""
    return load_limits(skeleton=load_human("adult_man").skeleton)


@pytest.mark.parametrize("side", ["l", "r"])
@pytest.mark.parametrize(
    ("bone", "angle", "sign"),
    [
        ("index1", "flexion", 1),
        ("index1", "extension", -1),
        ("middle2", "flexion", 1),
        ("pinky3", "flexion", 1),
        ("thumb1", "flexion", 1),
        ("thumb3", "flexion", 1),
        ("metatarsal", "flexion", 1),
        ("metatarsal", "extension", -1),
        ("eyeball_joint", "depression", 1),
        ("eyeball_joint", "elevation", -1),
    ],
)
def test_fingers_toes_and_eyes_are_limited_where_their_bones_bend(
    people: JointLimits, side: str, bone: str, angle: str, sign: int
) -> None:
    """Up to the limit nothing is reported; 5 degrees beyond it, this angle of this bone alone."""
    name = f"{side}_{bone}"
    row = next(row for row in people.table.joints if row.bone == bone)
    limit = next(one.degrees for one in row.rows if one.angle == angle) + people.table.margin
    still = np.tile([0.0, 0, 0, 1], (1, len(people.skeleton), 1))
    first = people.angles(still)[f"{name}.{row.rows[0].angle}"][0]

    def bent(degrees: float) -> Array:
        turns = np.array(still)
        turn = Rotation.from_euler("x", sign * degrees - first, degrees=True)
        turns[0, people.skeleton.bone(name)] = turn.as_quat()
        return turns

    assert people.report(bent(limit - 1)) == []
    (violation,) = people.report(bent(limit + 5))
    assert (violation.bone, violation.angle) == (name, angle)
    assert violation.worst == pytest.approx(limit + 5, abs=0.2)
    assert people.report(people.clamp(bent(limit + 5))) == []


def test_the_jaw_opens_and_does_not_close_beyond_the_teeth(people: JointLimits) -> None:
    still = np.tile([0.0, 0, 0, 1], (1, len(people.skeleton), 1))
    for degrees, expected in ((30, []), (45, ["opening"]), (-15, ["closing"])):
        turns = np.array(still)
        bone = people.skeleton.bone("temporomandibular")
        turns[0, bone] = Rotation.from_euler("x", degrees, degrees=True).as_quat()
        assert [violation.angle for violation in people.report(turns)] == expected


def test_relaxed_hands_are_half_bent_and_within_the_limits(people: JointLimits) -> None:
    still = np.tile([0.0, 0, 0, 1], (1, len(people.skeleton), 1))
    assert people.report(still) == []
    angles = people.angles(still)
    for finger in FINGERS[1:]:
        knuckle, middle = (angles[f"l_{finger}{joint}.flexion"][0] for joint in (1, 2))
        assert 15 < knuckle < 45 and 30 < middle < 50
        assert abs(angles[f"l_{finger}1.radial deviation"][0]) < 1e-6


def test_bones_that_a_skeleton_lacks_are_left_out() -> None:
    names = ("HumanoidRoot", "sacroiliac", "vl5")
    first = np.arange(3)
    trunk = Skeleton(names, np.array([-1, 0, 1]), GENERAL.heads[first], GENERAL.tails[first], np.zeros(3))
    still = np.tile([0.0, 0, 0, 1], (2, 3, 1))
    assert {name.split(".")[0] for name in load_limits(skeleton=trunk).angles(still)} == {"sacroiliac", "vl5"}
    with pytest.raises(MotionError, match="no bone of this skeleton"):
        LIMITS.for_skeleton(replace(trunk, names=("a", "b", "c")))
    with pytest.raises(MotionError, match=r"rotations of shape \(2, 3, 4\)"):
        LIMITS.report(still)


BUILT_IN = yaml.safe_load(TABLE.read_text())
PAIR = BUILT_IN["joints"][1]["first"]


def broken(changes: dict[str, object]) -> str:
    """The built-in table with changes in its second joint row."""
    first, second, *others = BUILT_IN["joints"]
    return yaml.safe_dump(BUILT_IN | {"joints": [first, second | changes, *others]})


@pytest.mark.daily("text13-nothing turns from up towards down", "text8-not at right angles")
@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[1, 2", "not valid YAML"),
        ("name: x", "margin: this key is missing: give a number from 0 to 90"),
        ("- 1", "give a mapping with the keys name, margin"),
        ("[" * 5000, "YAML"),
        ({"bone": "tail"}, r"joints.1: no bone 'tail'"),
        ({"colour": "red"}, r"joints.1.colour: unknown key"),
        ({"first": None}, "either 'swing' or both"),
        ({"first": [PAIR[0], PAIR[0]]}, "not opposite turns"),
        ({"second": PAIR}, "not at right angles"),
        ({"first": [{**PAIR[0], "from": "out"}, PAIR[1]]}, "directions of vl5 are"),
        ({"along": "out"}, "directions of vl5 are back, down"),
        ({"first": [{**PAIR[0], "degrees": 200}, PAIR[1]]}, "joints.1.first.0.degrees"),
        ({"first": [{**PAIR[0], "source": "hearsay"}, PAIR[1]]}, "no source 'hearsay'"),
        ({"first": [{**PAIR[0], "towards": "down"}, PAIR[1]]}, "nothing turns from up towards down"),
        ({"bone": "sacroiliac"}, "there twice"),
        ({"twist_with": "elbow"}, "names no joint before it"),
        ({"first": None, "second": None, "swing": [PAIR[0]]}, "needs 'along'"),
    ],
)
def test_a_wrong_table_is_an_error_with_its_key(
    text: str | dict[str, object], message: str, tmp_path: Path
) -> None:
    path = tmp_path / "limits.yaml"
    path.write_text(text if isinstance(text, str) else broken(text))
    with pytest.raises(MotionError, match=message) as error:
        load_limits(path)
    assert error.value.path == str(path)


def test_a_missing_table_is_named(tmp_path: Path) -> None:
    with pytest.raises(MotionError, match="no such joint limits file"):
        load_limits(tmp_path / "none.yaml")


def test_the_table_in_the_documentation_is_the_one_that_is_used() -> None:
    def cell(row: Limit) -> str:
        return f"| {row.angle} | {row.start} towards {row.towards} | {row.degrees:g} | {row.source} |"

    rows = [
        f"| {joint.bone} | {joint.relative_to} {cell(row)}"
        for joint in LIMITS.table.joints
        for row in joint.rows
    ]
    text = (ROOT / "docs" / "limits.md").read_text()
    written = [
        line
        for line in text.splitlines()
        if line.count("|") == 7 and line.rsplit("|", 2)[1].strip() in LIMITS.table.sources
    ]
    assert written == rows, "\n" + "\n".join(rows)
    for key, source in LIMITS.table.sources.items():
        assert f"- {key}: {source}" in text.replace("\n  ", " ")
    assert f"margin of {LIMITS.table.margin:g} degrees" in text
