"""Hand poses: angles within limits, no finger through the palm, keys over time, and what the arm does."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from test_fingers import fingered

from humansim_ros import Scene
from humansim_ros.errors import HumansimError, HumansimWarning
from humansim_ros.files.reading.assets import built_in_names
from humansim_ros.motion.pose.hand_poses import (
    BUILT_IN_HANDS,
    FINGER_BONES,
    HAND_POSES,
    HandAnatomy,
    hand_angles,
)
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.people import Human, load_human
from humansim_ros.scene.core.actor import HumanState
from humansim_ros.scene.core.live import JointSource, LiveRetargeter
from humansim_ros.types import Array

#: Depth of a finger in the palm that soft skin allows, metres.
_SOFT = 0.004


def posed(human: Human, angles: Array) -> Array:
    """Vertices (V, 3) of the body at rest with fingers at angles (30, 3) radians."""
    anatomy = HandAnatomy.of(human.skeleton)
    assert anatomy is not None
    rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(human.skeleton), 1))
    rotations[anatomy.bones] = anatomy.rotations(angles)
    return human.pose(human.skeleton.pose(rotations))


class Palm:
    """The skin of a right hand to the first bones of the fingers, and the skin of the fingers beyond them."""

    def __init__(self, human: Human) -> None:
        skeleton, weights = human.skeleton, human.weights.toarray()
        inner = [skeleton.bone(name) for name in ("r_wrist", *FINGER_BONES) if _is_inner(name)]
        outer = [skeleton.bone(name) for name in FINGER_BONES if name[0] == "r" and not _is_inner(name)]
        self.fingers = np.flatnonzero(weights[:, outer].sum(1) > 0.95)[::3]
        self.triangles = human.mesh.triangles[np.isin(human.triangle_parts - 1, inner)]

    def depth(self, vertices: Array) -> float:
        """How deep a finger is in the palm, metres: at vertices whose winding number is near 1."""
        distance, _ = cKDTree(vertices[np.unique(self.triangles)]).query(vertices[self.fingers])
        near = distance < 0.012
        points = vertices[self.fingers][near].astype(float)
        a, b, c = np.moveaxis(vertices[self.triangles].astype(float)[:, :, None] - points, 1, 0)
        la, lb, lc = (np.linalg.norm(each, axis=-1) for each in (a, b, c))
        volume = (a * np.cross(b, c)).sum(-1)
        rest = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
        inside = np.arctan2(volume, rest).sum(0) / (2 * np.pi) > 0.6  # [van Oosterom, Strackee 1983]
        return float(distance[near][inside].max(initial=0.0))


def _is_inner(name: str) -> bool:
    return name[0] == "r" and (name[-1] == "1" or name == "r_thumb2" or not name[-1].isdigit())


@pytest.mark.parametrize("body", built_in_names("humans"))
def test_no_finger_goes_through_the_palm(body: str) -> None:
    human = load_human(body)
    palm, poses = Palm(human), angles_of(human)
    for name, angles in poses.items():
        assert palm.depth(posed(human, angles)) < _SOFT, name
    too_far = np.array(poses["fist"])
    too_far[:, 0] *= 1.4
    assert palm.depth(posed(human, too_far)) > _SOFT  # the measure finds a finger in the palm


@pytest.mark.daily("adult_woman")
@pytest.mark.parametrize("body", built_in_names("humans"))
def test_no_finger_goes_through_the_palm_between_two_poses(body: str) -> None:
    human = load_human(body)
    palm, poses = Palm(human), angles_of(human)
    for (name, a), (other, b) in itertools.combinations(poses.items(), 2):
        assert palm.depth(posed(human, (a + b) / 2)) < _SOFT, (name, other)


def angles_of(human: Human) -> dict[str, Array]:
    """Angles (30, 3) of both hands, by pose."""
    anatomy = HandAnatomy.of(human.skeleton)
    assert anatomy is not None
    return {name: np.tile(hand_angles(name, anatomy), (2, 1)) for name in HAND_POSES}


def test_a_relaxed_hand_is_the_rest_pose_and_a_straight_one_is_straight() -> None:
    human = load_human("adult_man")
    skeleton, poses = human.skeleton, angles_of(human)
    at_rest = human.pose(skeleton.rest)
    assert np.abs(posed(human, poses["relaxed"]) - at_rest).max() < 1e-6
    anatomy = HandAnatomy.of(skeleton)
    assert anatomy is not None
    for degrees in (0.0, 40.0, 90.0):
        angles = np.zeros((30, 3))
        angles[:, 0] = np.radians(degrees)
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(skeleton), 1))
        rotations[anatomy.bones] = anatomy.rotations(angles)
        frames = skeleton.pose(rotations)
        for side in "lr":
            for finger in ("index", "middle", "ring", "pinky"):
                for number in (2, 3):
                    bone = skeleton.bone(f"{side}_{finger}{number}")
                    above = frames[skeleton.parents[bone], :3, 1]
                    in_bone = frames[bone, :3, :3].T @ above
                    assert np.degrees(np.arctan2(-in_bone[2], in_bone[1])) == pytest.approx(degrees, abs=1e-6)
                assert frames[skeleton.bone(f"{side}_{finger}2"), 1, 1] <= (0.3 if degrees == 0 else 0), (
                    "down"
                )


@pytest.mark.parametrize("body", built_in_names("humans"))
def test_poses_are_within_the_joint_limits(body: str) -> None:
    human = load_human(body)
    limits, anatomy = load_limits(skeleton=human.skeleton), HandAnatomy.of(human.skeleton)
    assert anatomy is not None
    for name, angles in angles_of(human).items():
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (1, len(human.skeleton), 1))
        rotations[:, anatomy.bones] = anatomy.rotations(angles)
        beyond = [each for each in limits.report(rotations) if each.bone in FINGER_BONES]
        assert not beyond, (name, beyond)


def test_clamping_keeps_fingers_of_a_file_within_the_limits(tmp_path: Path) -> None:
    file = tmp_path / "bent.bvh"
    turn = Rotation.from_rotvec([[0, 0, -3.0]])  # the finger bends through the palm
    file.write_text(fingered().text({"LeftHandIndex1": turn, "LeftHandIndex2": turn}))
    actor = scene({"file": str(file), "clamp": True}).actors["anna"]
    assert 90 < fingers(actor.at(0.0), "l")["index2"] < 125


def test_the_hands_mirror_each_other() -> None:
    human = load_human("adult_woman")
    for name, angles in angles_of(human).items():
        anatomy = HandAnatomy.of(human.skeleton)
        assert anatomy is not None
        rotations = np.tile([0.0, 0.0, 0.0, 1.0], (len(human.skeleton), 1))
        rotations[anatomy.bones] = anatomy.rotations(angles)
        heads = human.skeleton.joint_transforms(human.skeleton.pose(rotations))[:, :3, 3]
        names = human.skeleton.joint_names
        for number, joint in enumerate(names):
            if joint.startswith("l_") and (joint[2:-1].removesuffix("_en") in joint):
                other = heads[names.index(f"r_{joint[2:]}")] * [-1, 1, 1]
                assert np.linalg.norm(heads[number] - other) < 1e-3, (name, joint)


def scene(motion: object) -> Scene:
    camera = {"position": [3, 0, 2], "look_at": [0, 0, 1]}
    humans = {"anna": {"body": "adult_man", "motion": motion}}
    return Scene.from_dict({"humans": humans, "cameras": {"camera_1": camera}})


def fingers(state: HumanState, side: str) -> dict[str, float]:
    """Flexion of each finger bone relative to the bone above, degrees, by name."""
    names = state.joint_names
    out = {}
    for bone in FINGER_BONES:
        if bone[0] == side and bone[-1] != "1":
            above = state.joints[names.index(f"{bone[:-1]}{int(bone[-1]) - 1}"), :3, 1]
            in_bone = state.joints[names.index(bone), :3, :3].T @ above
            out[bone[2:]] = float(np.degrees(np.arctan2(-in_bone[2], in_bone[1])))
    return out


KEYS = [
    {"pose": "fist", "time": 0.5, "side": "left", "blend": 0.5},
    {"pose": "flat", "time": 1.5, "side": "left", "blend": 0},
]


def test_keys_pose_one_hand_over_time_and_the_other_stays_relaxed() -> None:
    actor = scene({"file": "walk", "loop": "none", "hands": KEYS}).actors["anna"]
    relaxed = np.degrees(HandAnatomy.of(actor.human.skeleton).rest[4])  # type: ignore[union-attr]
    expected = {0.2: relaxed, 0.75: (relaxed + 90.0) / 2, 1.2: 90.0, 1.6: 3.0, 9.0: 3.0}
    for time, angle in expected.items():
        assert fingers(actor.at(time), "l")["index2"] == pytest.approx(angle, abs=0.01), time
        assert fingers(actor.at(time), "r")["index2"] == pytest.approx(relaxed, abs=0.01), time


def test_keys_of_a_motion_that_loops_hold_over_its_start() -> None:
    actor = scene({"file": "walk", "hands": KEYS}).actors["anna"]
    for time in (0.2, 2.2, 4.2):
        assert fingers(actor.at(time), "l")["index2"] == pytest.approx(3.0, abs=0.01), time
    assert fingers(scene({"file": "walk", "hands": "fist"}).actors["anna"].at(1.0), "r")["index2"] > 85


def test_a_blend_has_the_velocity_of_its_change() -> None:
    actor = scene({"file": "t_to_a_pose", "hands": KEYS}).actors["anna"]
    state, names = actor.at(0.75), actor.human.skeleton.joint_names
    bone, step = names.index("l_index2"), 1e-3
    before, after = (actor.at(0.75 + sign * step).joints[bone, :3, :3] for sign in (-1, 1))
    measured = Rotation.from_matrix(after @ before.T).as_rotvec() / (2 * step)
    assert state.angular is not None
    assert np.linalg.norm(measured) > 1.0
    assert np.abs(state.angular[bone] - measured).max() < 0.01


def test_a_message_of_the_player_carries_the_hands() -> None:
    actor = scene({"file": "walk", "hands": KEYS}).actors["anna"]
    poses = actor.joint_poses(0.7)
    got = LiveRetargeter(actor).retarget(poses)
    assert np.array_equal(got.vertices, actor.at(0.7).vertices)
    legend = JointSource.from_dict(JointSource.of_actor(actor).to_dict(), actor)
    assert not any("hand_pose" in name for name in legend.names)


def test_without_keys_hands_are_relaxed_and_a_raised_hand_opens() -> None:
    walk, wave = (scene(motion).actors["anna"] for motion in ("walk", "wave"))
    assert walk.settings("hands") is wave.settings("hands") is None
    assert not any(name.startswith("hand_pose") for name in wave.joint_poses(0.0).names)
    assert fingers(walk.at(0.5), "r")["index2"] > 30
    raised = min(fingers(wave.at(time), "r")["index2"] for time in np.linspace(0.5, 3.5, 7))
    assert raised < 10
    assert fingers(wave.at(2.0), "l")["index2"] > 30


def test_a_built_in_motion_that_picks_something_up_grips_it() -> None:
    actor = scene("pick_up").actors["anna"]
    assert [key.pose for key in BUILT_IN_HANDS["pick_up"]] == ["relaxed", "grip", "relaxed"]
    grip = np.degrees(hand_angles("grip", HandAnatomy.of(actor.human.skeleton))[4, 0])  # type: ignore[arg-type]
    assert fingers(actor.at(4.0), "r")["index2"] == pytest.approx(grip, abs=0.01)
    assert fingers(actor.at(0.5), "r")["index2"] < grip - 10


@pytest.mark.parametrize("motion", BUILT_IN_HANDS)
def test_keys_of_built_in_motions_fit_them(motion: str) -> None:
    assert scene(motion).actors["anna"].settings("hands") is not None


def test_keys_leave_fingers_that_the_motion_moves_unless_a_key_says_so(tmp_path: Path) -> None:
    file = tmp_path / "bent.bvh"
    file.write_text(fingered().text({}))
    with pytest.warns(HumansimWarning, match="'hands' moves nothing"):
        free = scene({"file": str(file), "hands": "fist"}).actors["anna"]
    forced = scene({"file": str(file), "hands": {"pose": "fist", "over_motion": True}}).actors["anna"]
    assert free.settings("hands") is None
    assert abs(fingers(free.at(0.0), "l")["index2"]) < 0.1
    assert fingers(forced.at(0.0), "l")["index2"] == pytest.approx(90.0, abs=0.01)


@pytest.mark.parametrize(
    ("hands", "message"),
    [
        ("fists", r"hands.*(fist|relaxed)"),
        ({"pose": "fist", "side": "top"}, r"side.*left.*right.*both"),
        ({"pose": "fist", "time": float("nan")}, "time"),
        ({"pose": "fist", "time": -1}, "time"),
        ({"pose": "fist", "blend": -0.1}, "blend"),
        ({"pose": "fist", "time": 77}, r"77 s is outside the part of the motion that plays, 0 to 2 s"),
        ({"pose": "fist", "tempo": 1}, "tempo"),
        (3, "hands"),
    ],
)
def test_wrong_keys_are_refused_with_what_is_known(hands: object, message: str) -> None:
    with pytest.raises(HumansimError, match=rf"(?s)hands.*{message}|{message}.*hands|{message}"):
        scene({"file": "walk", "hands": hands})
