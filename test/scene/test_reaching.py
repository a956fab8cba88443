"""Hands that reach for points, objects and others: they touch, and everything else stays as it was."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from humansim_ros.errors import HumansimError, SceneError, in_section
from humansim_ros.geometry import VELOCITY_STEP, ObjectPose, quaternion_to_matrix
from humansim_ros.motion.body.skeleton import sole_points
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.motion.pose.reaches import WITHOUT_REACH, Reach
from humansim_ros.scene import Scene, check_scene
from humansim_ros.scene.config.config import check_config
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.features import begin_draft
from humansim_ros.scene.core.live import LiveRetargeter
from humansim_ros.scene.core.objects import SHAPES
from humansim_ros.scene.core.playback import Playback
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.core.world import InHand
from humansim_ros.scene.features.reach.feature import PointGoal

ROOT = Path(__file__).resolve().parents[2]
CAMERAS = {"front": {"size": [160, 120], "position": [3, 2.6, 2], "look_at": [0, 0, 0.8]}}
#: Contact error that docs/motions.md promises, metres.
CONTACT = 0.005


def scene(reach: Any = (), objects: Any = None, others: Any = None, **human: Any) -> Scene:
    humans = {"anna": {"motion": "stand", "reach": reach, **human}, **(others or {})}
    data = {"humans": humans, "objects": objects or {}, "cameras": CAMERAS, "room": None}
    return Scene.from_dict(data, ROOT / "config" / "scenes")


def pair(one: str, other: str, apart: float = 0.9, hands: tuple[str, str] = ("right", "right")) -> Scene:
    own, others = ({"hand": hand, "start": 1, "end": 5} for hand in hands)
    ben = {
        "body": other,
        "motion": {"file": "stand", "position": [apart, 0.0], "yaw_deg": 180, "offset": 0.7},
        "reach": [{"to": "anna", **others}],
    }
    return scene([{"to": "ben", **own}], others={"ben": ben}, body=one)


def hand_axes(actor: Actor, side: str, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions (N, 3) of the fingers and of the thumb, and the skin's own side of the palm, from joints.

    They come from the joints of fingers alone, not from what the reach is computed with.
    """
    names = actor.human.skeleton.joint_names
    joints = actor.joints_at(times)[..., :3, 3]

    def at(part: str) -> np.ndarray:
        return np.asarray(joints[:, names.index(f"{side[0]}_{part}")])

    fingers = at("middle1") - at("wrist")
    thumb = at("index1") - at("pinky1")
    inwards = np.cross(fingers, thumb) * (1.0 if side == "left" else -1.0)
    unit = lambda v: v / np.linalg.norm(v, axis=1, keepdims=True)  # noqa: E731
    return unit(fingers), unit(thumb), unit(inwards)


HELD = np.linspace(1.8, 4.2, 25)


@pytest.mark.parametrize(
    ("one", "other", "apart"),
    [("adult_woman", "adult_man", 0.9), ("child", "tall_heavy_man", 0.7), ("slim_old_woman", "child", 0.6)],
)
def test_two_people_shake_hands(one: str, other: str, apart: float) -> None:
    made = pair(one, other, apart)
    anna, ben = made.actors["anna"], made.actors["ben"]
    palms = anna.palms_at("right", HELD)
    np.testing.assert_allclose(palms, ben.palms_at("right", HELD), atol=CONTACT)
    # they go up and down, then hold still but for the breath of both
    assert 0.03 < np.ptp(palms[:, 2]) < 0.08
    own, others = hand_axes(anna, "right", HELD), hand_axes(ben, "right", HELD)
    assert (own[1][:, 2] > 0.5).all() and (others[1][:, 2] > 0.5).all()  # thumbs are up
    assert ((own[0] * others[0]).sum(1) < -0.8).all()  # fingers point to each other
    assert ((own[2] * others[2]).sum(1) < -0.8).all()  # palms face each other
    # both are back where their motions have them
    for actor in (anna, ben):
        for time in (0.5, 5.5):
            plain = actor.joints_at(np.array([time]), WITHOUT_REACH)
            np.testing.assert_array_equal(actor.joints_at(np.array([time])), plain)


def test_the_skins_of_hands_that_shake_meet_and_do_not_cross() -> None:
    made = pair("adult_woman", "adult_man")
    anna, ben = made.actors["anna"], made.actors["ben"]
    time = 3.5
    place, own = anna.palms_at("right", np.array([time]))[0], hand_axes(anna, "right", np.array([time]))
    normal = own[2][0]
    depths = []
    for actor, sign in ((anna, 1.0), (ben, -1.0)):
        away = np.asarray(actor.at(time).vertices, dtype=float) - place
        across = np.linalg.norm(away - (away @ normal)[:, None] * normal, axis=1)
        depths.append(float((sign * (away @ normal))[across < 0.012].max()))
    # the skin of each palm is at the plane between them
    assert all(-0.009 < depth < 0.003 for depth in depths), depths


def test_the_meeting_does_not_depend_on_who_comes_first() -> None:
    made = pair("adult_woman", "adult_man")
    config = made.config.model_dump(exclude_unset=True)
    config["humans"] = dict(reversed(config["humans"].items()))
    other = Scene.from_dict(config)
    for name, actor in made.actors.items():
        np.testing.assert_array_equal(actor.at(2.5).vertices, other.actors[name].at(2.5).vertices)


def test_two_who_walk_side_by_side_hold_hands() -> None:
    walk = {"file": "walk_straight", "loop": "continue"}
    ben = {"motion": {**walk, "position": [0, 0.55]}, "reach": [{"hand": "right", "to": "anna", "blend": 0}]}
    made = scene([{"hand": "left", "to": "ben", "blend": 0}], others={"ben": ben}, motion=walk)
    times = np.linspace(0, 5, 41)
    one, other = made.actors["anna"].palms_at("left", times), made.actors["ben"].palms_at("right", times)
    np.testing.assert_allclose(one, other, atol=CONTACT)
    assert (one[:, 2] < 1.0).all() and np.ptp(one[:, 0]) > 5
    for name, side in (("anna", "left"), ("ben", "right")):
        assert (hand_axes(made.actors[name], side, times)[0][:, 2] < -0.6).all()  # fingers hang


@pytest.mark.daily("*-adult_man", "*-child")  # a drawn person takes seconds to build
@pytest.mark.parametrize("body", ["adult_man", "child", "person#3-1"])
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_hand_touches_a_point_with_the_palm_that_is_asked_for(body: str, side: str) -> None:
    point = scene(body=body).actors["anna"].joints_at(np.array([0.0]))[0]
    names = scene(body=body).actors["anna"].human.skeleton.joint_names
    shoulder = point[names.index(f"{side[0]}_shoulder"), :3, 3]
    goal = shoulder + 0.42 * shoulder[2] * np.array([0.55, 0.1 if side == "left" else -0.1, -0.35])
    reach = {"hand": side, "to": goal.tolist(), "blend": 0.5, "palm": [0, 0, -1], "fingers": [1, 0, 0]}
    actor = scene([reach], body=body).actors["anna"]
    times = np.linspace(0.5, 3, 6)
    np.testing.assert_allclose(actor.palms_at(side, times), np.broadcast_to(goal, (6, 3)), atol=CONTACT)
    fingers, _, inwards = hand_axes(actor, side, times)
    assert (fingers[:, 0] > 0.9).all() and (inwards[:, 2] < -0.8).all()


@pytest.mark.parametrize("keys", [{"retarget": "thesis"}, {"clamp": True}, {"mirror": True}])
@pytest.mark.parametrize("motion", ["dance", "talk"])
def test_a_hand_touches_however_the_motion_is_retargeted(motion: str, keys: Any) -> None:
    reach = {"to": [0.42, -0.2, 1.15], "palm": [0, 0, -1], "fingers": [1, 0, 0], "blend": 0.1}
    actor = scene([reach], motion={"file": motion, **keys}).actors["anna"]
    times = np.linspace(0.1, 1.0, 4)
    assert np.linalg.norm(actor.palms_at("right", times) - reach["to"], axis=1).max() < CONTACT
    if "clamp" in keys:
        poses = actor.settings("reach").apply(actor.motion.sample(times), times, actor.others)
        rotations, _ = actor.retargeter.apply(poses)
        assert not load_limits().for_skeleton(actor.human.skeleton).report(rotations)


def test_a_hand_without_direction_follows_its_forearm() -> None:
    actor = scene([{"to": [0.45, -0.2, 1.15], "blend": 0.5}]).actors["anna"]
    times = np.array([0.0, 2.0])
    np.testing.assert_allclose(actor.palms_at("right", times[1:]), [[0.45, -0.2, 1.15]], atol=CONTACT)
    skeleton = actor.human.skeleton
    lower, hand = (
        actor.joints_at(times)[:, skeleton.bone(f"r_{part}"), :3, :3] for part in ("elbow", "wrist")
    )
    bent = np.swapaxes(lower, -1, -2) @ hand
    np.testing.assert_allclose(bent[0], bent[1], atol=0.05)


def test_a_hand_on_the_shoulder_of_another() -> None:
    ben = {"motion": {"file": "stand", "position": [0.5, 0.0], "yaw_deg": 180}}
    reach = {"to": "ben", "at": "l_shoulder", "palm": [0, 0, -1], "blend": 0.3}
    made = scene([reach], others={"ben": ben})
    times = np.linspace(0.5, 2, 4)
    ben_joints = made.actors["ben"].joints_at(times)[..., :3, 3]
    shoulder = ben_joints[:, made.actors["ben"].human.skeleton.bone("l_shoulder")]
    apart = made.actors["anna"].palms_at("right", times) - shoulder
    np.testing.assert_allclose(apart, np.broadcast_to([0, 0, 0.055], apart.shape), atol=CONTACT)


@pytest.mark.parametrize(
    "motion", ["wave", "talk", "walk_slow", {"file": "stand", "mirror": True, "speed": 1.5}]
)
@pytest.mark.parametrize("clamp", [False, True])
def test_the_rest_of_the_body_stays_as_it_was(motion: Any, clamp: bool) -> None:
    motion = {**({"file": motion} if isinstance(motion, str) else motion), "clamp": clamp}
    made = scene([{"hand": "left", "to": [0.5, 0.3, 1.1], "blend": 0.4}], motion=motion)
    actor, times = made.actors["anna"], np.linspace(0, 3, 31)
    moved, plain = actor.joints_at(times), actor.joints_at(times, WITHOUT_REACH)
    names = actor.human.skeleton.joint_names
    arm = {"l_shoulder", "l_elbow", "l_wrist"}
    ends = {
        name
        for name in names
        if name.startswith("l_")
        and any(part in name for part in ("thumb", "index", "middle", "ring", "pinky", "wrist"))
    }
    rest = [n for n, name in enumerate(names) if name not in arm | ends]
    np.testing.assert_allclose(moved[:, rest], plain[:, rest], atol=1e-9)
    assert np.abs(moved - plain).max() > 0.1


def test_velocities_are_those_of_the_poses() -> None:
    actor = pair("adult_woman", "adult_man").actors["ben"]
    for time in (1.3, 2.1, 4.6):  # on the way there, while they shake, on the way back
        state = actor.at(time)
        step = 5 * VELOCITY_STEP
        before, after = (actor.at(time + sign * step) for sign in (-1, 1))
        measured = (after.positions - before.positions) / (2 * step)
        np.testing.assert_allclose(state.linear, measured, atol=0.02)
        moved = actor.moved(state, step)
        assert np.abs(moved - after.vertices).max() < 1e-3


def test_the_skinner_poses_the_same_body_from_the_message() -> None:
    made = pair("adult_woman", "adult_man")
    for name, actor in Playback(made).actors.items():
        skinner = LiveRetargeter(made.actors[name])
        for time in (0.0, 1.4, 2.6, 4.8):
            from_message, here = skinner.retarget(actor.joint_poses(time)), actor.at(time)
            np.testing.assert_array_equal(from_message.vertices, here.vertices)
        assert skinner.source_number == 0


def test_a_hand_follows_an_object_that_is_put_somewhere_else_while_it_plays() -> None:
    reach = {"to": "door", "at": [-0.05, 0.745, 1.061], "blend": 0}
    anna = {"motion": {"file": "stand", "position": [2.88, 1.84], "yaw_deg": 90}}
    made = scene([reach], {"door": {"mesh": "door_leaf", "keyframes": "contact.xml"}}, **anna)
    playback = Playback(made)
    playback.show(0)
    pose = playback.world.object_pose("door", playback.elapsed * 1e-9)
    moved = pose.position + np.array([0.03, -0.02, 0.04])
    playback.place_object("door", moved, pose.rotation)
    handle = playback.world.object_pose("door", playback.elapsed * 1e-9).apply(
        np.array([-0.05, 0.745, 1.061])
    )
    assert not np.allclose(handle, pose.apply(np.array([-0.05, 0.745, 1.061])))
    palm = playback.actors["anna"].palms_at("right", np.zeros(1))[0]
    np.testing.assert_allclose(palm, handle, atol=CONTACT)


def test_a_hand_of_a_smaller_body_that_keyframes_move_reaches_too(tmp_path: Path) -> None:
    (tmp_path / "lift.xml").write_text(
        '<animation startframe="0" endframe="60"><object name="anna"><frame number="0">'
        '<position x="0.5" y="1" z="0"/><rotation x="0" y="0" z="90"/><size x="0.8" y="0.8" z="0.8"/></frame>'
        '<frame number="60"><position x="0.6" y="1.1" z="0.1"/></frame></object></animation>'
    )
    human = {"motion": "stand", "keyframes": str(tmp_path / "lift.xml")}
    actor = scene([{"to": [0.75, 1.45, 0.95], "blend": 0.2}], **human).actors["anna"]
    times = np.linspace(0.3, 2, 5)
    np.testing.assert_allclose(actor.palms_at("right", times), [[0.75, 1.45, 0.95]] * 5, atol=CONTACT)
    np.testing.assert_allclose(actor.at(1.0).positions, actor.joint_paths(np.array([1.0]))[0], atol=1e-6)


# --- the example


@pytest.fixture(scope="module")
def example() -> Scene:
    return Scene.load(ROOT / "config" / "scenes" / "contact.yaml")


def test_hands_of_the_example_hold_what_they_reach_for(example: Scene) -> None:
    reached = 0
    for actor in example.actors.values():
        for reach in actor.settings("reach").reaches:
            times = reach.holds(np.linspace(0, 16, 161))
            error = np.linalg.norm(
                actor.palms_at(reach.side, times) - reach.goal(times, actor.others).place, axis=1
            )
            assert error.max() < CONTACT
            reached += len(times) > 20
    assert reached == 5
    assert check_scene(example) == []


def test_joints_of_the_example_stay_within_their_limits(example: Scene) -> None:
    times = np.linspace(0, 8, 161)
    for actor in example.actors.values():
        poses = actor.settings("reach").apply(actor.motion.sample(times + actor.offset), times, actor.others)
        rotations, _ = actor.retargeter.apply(poses)
        assert not load_limits().for_skeleton(actor.human.skeleton).report(rotations)


def test_the_cart_goes_ahead_of_who_pushes_it_and_stands_on_the_floor(example: Scene) -> None:
    cart, pusher = example.objects["cart"], example.actors["pusher"]
    for time in np.arange(0.0, 8.0, 0.5):
        pose = cart.at(time)
        assert pose.position[2] == 0 and pose.velocity is not None
        hips = pusher.joint_paths(np.array([time]))[0, 0, :2]
        assert np.linalg.norm(pose.position[:2] - hips) == pytest.approx(0.86, abs=0.06)
        x, y, z, w = pose.rotation
        ahead = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 0])
        # it rolls: its rear does not go sideways by more than the turn of the walk
        assert pose.velocity.linear @ ahead > 0.9
        assert abs(pose.velocity.angular[2]) == pytest.approx(np.pi / 4, abs=0.12)  # a quarter circle in 2 s


def test_feet_of_the_example_stand_as_their_motions_do(example: Scene) -> None:
    times = np.linspace(0, 6, 91)
    for actor in example.actors.values():
        poses = actor.motion.sample(times + actor.offset)
        moved = actor.settings("reach").apply(poses, times, actor.others)
        skeleton, pose = actor.human.skeleton, actor.retargeter.pose
        np.testing.assert_allclose(
            sole_points(skeleton, pose(moved)), sole_points(skeleton, pose(poses)), atol=1e-9
        )


# --- wrong input


@pytest.mark.parametrize(
    ("reach", "problem"),
    [
        (
            {"to": "bem"},
            r"reach\.0\.to: no human and no object 'bem'; did you mean 'ben'.* There are .*ben.*crate",
        ),
        ({"to": "anna"}, r"reach\.0\.to: nobody reaches for the own hand"),
        ({"to": "ben"}, r"reach\.0\.to: ben does not reach for anna from 0 s on"),
        ({"to": "ben", "at": "l_sholder"}, r"reach\.0\.at: ben has no joint 'l_sholder'.*l_shoulder"),
        ({"to": "ben", "at": [0, 0, 1]}, r"reach\.0\.at: ben is a human: give the name of a joint"),
        ({"to": "crate", "at": "l_wrist"}, r"reach\.0\.at: crate is an object: give a point of it"),
        ({"to": [1, 0, 1], "at": [0, 0, 0]}, r"reach\.0\.at: a point needs no place on it"),
        ({"to": [float("nan"), 0, 1]}, r"reach\.0\.to"),
        ({"to": [1, 0, 1], "start": float("nan")}, r"reach\.0\.start"),
        ({"to": [1, 0, 1], "start": 3, "end": 2}, r"end \(2 s\) must come after start \(3 s\)"),
        (
            {"to": [1, 0, 1], "end": 1},
            r"from 0 to 1 s there is no time for the way there and back, of 0\.8 s",
        ),
        ({"to": [1, 0, 1], "palm": [0, 0, 0]}, r"palm is a direction"),
        ({"to": [1, 0, 1], "palm": [0, 0, 2], "fingers": [0, 0, -1]}, r"must not be parallel"),
        ({"to": [1, 0, 1], "end": 5, "repeat": 4}, r"cannot begin again after 4 s"),
        ({"to": [1, 0, 1], "repeat": 4}, r"cannot begin again after 4 s"),
        ({"to": [1, 0, 1], "foot": "left"}, r"reach\.0\.foot: unknown key"),
        ({"hand": "left"}, r"reach\.0\.to"),
        ({"to": "robot_hand", "hand": "both"}, r"reach\.0\.hand"),
    ],
)
def test_a_wrong_reach_is_refused_with_its_key(reach: Any, problem: str) -> None:
    ben = {"motion": {"file": "stand", "position": [1, 0]}}
    with pytest.raises(SceneError, match=problem):
        scene([reach], {"crate": {"mesh": "box"}}, {"ben": ben})


@pytest.mark.parametrize(
    ("reaches", "problem"),
    [
        ([(1, 4, None), (3, 6, None)], r"two reaches of the right hand overlap, 0 \(1 to 4 s\) and 1"),
        ([(1, None, None), (5, 8, None)], r"two reaches of the right hand overlap, 0 \(1 s on\) and 1"),
        ([(5, 8, None), (1, None, None)], r"two reaches of the right hand overlap"),
        ([(1, 4, 8), (11, 14, 8)], r"two reaches of the right hand overlap"),
        ([(1, 4, 8), (6, 10, 8)], r"two reaches of the right hand overlap"),
        ([(1, 4, 8), (5, 7, 9)], r"reach\.1\.repeat: reaches of the right hand must have the same repeat"),
        ([(1, 4, 8), (4, 9, 8)], None),
        ([(4, 9, None), (1, 4, None)], None),
    ],
)
def test_reaches_of_one_hand_do_not_overlap(reaches: Any, problem: str | None) -> None:
    keys = ("start", "end", "repeat")
    given = [{"to": [0.4, -0.2, 1.1], **dict(zip(keys, each, strict=True))} for each in reaches]
    if problem is None:
        assert scene(given).actors["anna"].settings("reach") is not None
        return
    with pytest.raises(SceneError, match=problem):
        scene(given)


def test_two_who_reach_for_joints_of_each_other_are_refused() -> None:
    ben = {"motion": "stand", "reach": [{"to": "anna", "at": "l_wrist"}]}
    with pytest.raises(SceneError, match=r"humans\.anna\.reach: anna reaches for a joint of somebody who"):
        scene([{"to": "ben", "at": "l_shoulder"}], others={"ben": ben})


def test_two_who_come_at_other_times_are_refused() -> None:
    ben = {"motion": "stand", "reach": [{"to": "anna", "start": 3.5, "end": 7}]}
    with pytest.raises(SceneError, match=r"anna \(0 to 4 s\) and ben \(3\.5 to 7 s\) are not there together"):
        scene([{"to": "ben", "end": 4}], others={"ben": ben})


def test_hands_that_hold_a_box_reach_for_nothing_else() -> None:
    with pytest.raises(SceneError, match="anna holds crate in both hands: they reach for nothing else"):
        scene([{"to": [0.4, 0, 1]}], {"crate": {"mesh": "box", "held_by": "anna"}}, motion="carry")


def test_the_hands_of_who_another_node_moves_are_not_ours() -> None:
    with pytest.raises(SceneError, match="another node moves anna, and its hands"):
        scene([{"to": [0.4, 0, 1]}], motion="live")
    with pytest.raises(SceneError, match="another node moves ben, so that its place is not known"):
        scene([{"to": "ben", "at": "l_wrist"}], others={"ben": {"motion": "live"}})


def test_an_arm_without_wrist_is_an_error(tmp_path: Path) -> None:
    text = (ROOT / "assets" / "motions" / "stand.bvh").read_text()
    (tmp_path / "armless.bvh").write_text(text.replace("RightWrist", "Unknown"))
    with pytest.raises(HumansimError, match="hands cannot reach: the joint table knows no wrists"):
        scene([{"to": [0.4, 0, 1]}], motion=str(tmp_path / "armless.bvh"))


@pytest.mark.parametrize(
    ("reach", "severity", "problem"),
    [
        ({"to": [3, 0, 1]}, "error", r"does not reach \[3, 0, 1\] at any time: it lacks 2\.\d* m at"),
        ({"to": "crate", "at": [0, 0, 0.2]}, "error", r"the right hand of anna does not reach crate at any"),
        ({"to": [0.45, -0.2, 1.1]}, None, ""),
    ],
)
def test_check_names_a_hand_that_does_not_reach(reach: Any, severity: str | None, problem: str) -> None:
    made = scene([reach], {"crate": {"mesh": "box", "size": [0.3, 0.3, 0.3], "position": [2, 0, 0.15]}})
    found = [each for each in check_scene(made) if each.key.startswith("humans.anna.reach")]
    assert [each.severity for each in found] == ([severity] if severity else [])
    if severity:
        assert found[0].key == "humans.anna.reach.0.to" and re.search(problem, found[0].text)


def test_check_names_a_hand_that_loses_what_it_holds() -> None:
    walk = {"file": "walk_straight", "loop": "continue"}
    made = scene([{"to": [0.5, -0.3, 1.1], "end": 6, "blend": 0.1}], motion=walk)
    (found,) = [each for each in check_scene(made) if "reach" in each.key]
    assert found.severity == "warning" and "it lacks" in found.text


def test_somebody_who_does_not_reach_yet_is_as_without_the_key() -> None:
    later = scene([{"to": [0.45, -0.2, 1.1], "start": 2}]).actors["anna"]
    plain = scene().actors["anna"]
    for time in (0.0, 0.7, 1.9):
        np.testing.assert_array_equal(later.at(time).vertices, plain.at(time).vertices)
        np.testing.assert_array_equal(later.at(time).linear, plain.at(time).linear)
    assert np.abs(later.at(3.0).vertices - plain.at(3.0).vertices).max() > 0.2


@pytest.fixture(scope="module")
def doorway() -> Scene:
    return Scene.load(ROOT / "config" / "scenes" / "door.yaml")


def test_a_man_opens_a_door_wide_with_his_hand_on_the_handle(doorway: Scene) -> None:
    actor, door = doorway.actors["visitor"], doorway.objects["door"]
    (reach,) = actor.settings("reach").reaches
    times = reach.holds(np.linspace(0, 25.6, 513))
    turns = np.array([2 * np.degrees(np.arctan2(*door.at(time).rotation[2:])) for time in times])
    assert np.ptp(turns) > 80
    error = np.linalg.norm(actor.palms_at(reach.side, times) - reach.goal(times, actor.others).place, axis=1)
    assert error.max() < CONTACT
    assert check_scene(doorway) == []
    poses = actor.settings("reach").apply(actor.motion.sample(times), times, actor.others)
    rotations, _ = actor.retargeter.apply(poses)
    assert not load_limits().for_skeleton(actor.human.skeleton).report(rotations)


def test_the_door_passes_by_the_man_who_opens_it(doorway: Scene) -> None:
    """No skin is in the leaf, nor behind it, while he goes through; he is between the posts of its frame."""
    actor, door = doorway.actors["visitor"], doorway.objects["door"]
    passed = 0
    for time in np.arange(2.0, 12.8, 0.15):
        pose, skin = door.at(time), actor.at(time).vertices
        own = (skin - pose.position) @ quaternion_to_matrix(pose.rotation)
        beside = (own[:, 1] > 0) & (own[:, 1] < 0.897) & (own[:, 2] < 2)
        assert not (beside & (np.abs(own[:, 0]) < 0.02)).any(), time
        in_frame = skin[np.abs(skin[:, 1] + 0.23) < 0.05] if time < 6 else skin[:0]
        assert not len(in_frame) or 1.16 < in_frame[:, 0].min() <= in_frame[:, 0].max() < 2.06, time
        passed += len(in_frame) > 0
    assert passed > 5


# --- poses of the hands that reach


def finger_bend(actor: Actor, side: str, seconds: float) -> float:
    """Degrees between the first and the last bone of the index finger."""
    state = actor.at(seconds)
    names = state.joint_names
    points = [state.positions[names.index(f"{side}_index{n}")] for n in (1, 2, 3)]
    points.append(state.positions[names.index(f"{side}_index3_end")])
    first, last = points[1] - points[0], points[3] - points[2]
    return float(np.degrees(np.arccos(first @ last / np.linalg.norm(first) / np.linalg.norm(last))))


def test_a_hand_has_its_pose_while_it_reaches() -> None:
    reach = {"to": [0.5, -0.2, 1.1], "start": 1, "end": 5, "blend": 0.5, "repeat": 6, "pose": "flat"}
    actor = scene([reach], motion={"file": "stand", "offset": 0.7}).actors["anna"]
    plain = scene([{**reach, "pose": None}], motion={"file": "stand", "offset": 0.7}).actors["anna"]
    for seconds, flat in ((0.5, False), (2.0, True), (4.4, True), (5.5, False), (8.0, True)):
        bends = [finger_bend(each, "r", seconds) for each in (actor, plain)]
        assert (bends[0] < 10) == flat, seconds
        assert bends[1] > 30
        assert finger_bend(actor, "l", seconds) == pytest.approx(finger_bend(plain, "l", seconds), abs=1e-6)
    half = finger_bend(actor, "r", 1.25)  # on the way there
    assert 10 < half < 45
    assert (palms := actor.palms_at("right", np.array([2.0])))[0] == pytest.approx(
        [0.5, -0.2, 1.1], abs=CONTACT
    )
    assert palms.shape == (1, 3)


def test_a_pose_goes_on_where_hands_and_motions_are_changed_while_they_play() -> None:
    made = scene([{"to": [0.5, -0.2, 1.1], "pose": "flat"}], motion={"file": "stand", "hands": "fist"})
    playback = Playback(made)
    for change in ({"hands": ["point"]}, {"hands": None}, {"file": "talk"}, {"speed": 0.5}):
        playback.show(3 * 10**9)
        playback.change("anna", **change)
        assert finger_bend(playback.actors["anna"], "r", 3.0) < 10
        assert finger_bend(playback.actors["anna"], "l", 3.0) > 2
    assert finger_bend(made.actors["anna"], "l", 3.0) > 90


def test_a_wrong_pose_is_refused_with_its_key() -> None:
    with pytest.raises(SceneError, match=r"humans\.anna\.reach\.0\.pose: give relaxed, fist"):
        scene([{"to": [0.5, -0.2, 1.1], "pose": "gripp"}])


def test_two_features_do_not_use_one_hand_at_one_time() -> None:
    content = {"humans": {"anna": {"reach": [{"to": [0.4, -0.2, 1.1], "start": 1, "end": 4}]}}}
    draft = begin_draft(check_config({**content, "cameras": CAMERAS, "room": None}), SceneSource())
    goal = PointGoal((0.4, -0.2, 1.1), None, None)
    draft.reach("anna", [Reach("right", 1, 4, 0.5, goal, key="reach.0.to")])
    draft.reach("anna", [Reach("right", 4, 9, 0.5, goal), Reach("left", 1, 4, 0.5, goal)])
    for start, end, repeat in ((-np.inf, np.inf, np.inf), (3, 5, np.inf), (0, 0.5, 7)):
        with pytest.raises(
            HumansimError, match=r"the right hand of anna is taken: see humans\.anna\.reach\.0"
        ):
            draft.reach("anna", [Reach("right", start, end, 0.0, goal, repeat, "umbrella")])


def test_a_feature_adds_an_object_once_and_errors_name_its_key() -> None:
    content = {"humans": {"anna": "adult_woman"}, "cameras": CAMERAS, "room": None}
    draft = begin_draft(check_config(content), SceneSource())
    hand = InHand(draft.world, "anna", ObjectPose.on_floor(0.0, 0.0, 0.0), "left")
    with in_section("humans.anna.umbrella"):
        draft.add_object("cane", SHAPES["box"](), (9, 9, 9), hand, "humans.anna.umbrella")
    assert draft.objects["cane"].instance == 2 and draft.objects["cane"].moves
    for name in ("cane", "anna"):
        with pytest.raises(SceneError) as caught, in_section("humans.anna.umbrella"):
            draft.add_object(name, SHAPES["box"](), (9, 9, 9), hand, "humans.anna.umbrella")
        assert caught.value.key == "humans.anna.umbrella"
