"""Faces in scenes: keys, life, speech and gaze over time, in vertices, velocities and messages."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial.transform import Rotation

from humansim_ros import Scene
from humansim_ros.errors import HumansimError, HumansimWarning, MotionError
from humansim_ros.motion.body.face import ACTIONS, FACE_AT_REST, LIMITS, LOOKS, NECK_LIMITS, expression
from humansim_ros.motion.body.kinematics import JointPoses
from humansim_ros.motion.pose.limits import load_limits
from humansim_ros.scene import HumanState
from humansim_ros.scene.checks.checks import check_scene
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.live import JointSource, LiveRetargeter
from humansim_ros.scene.core.looks import random_numbers
from humansim_ros.scene.core.playback import Playback
from humansim_ros.scene.features.face.files import read_face_file
from humansim_ros.scene.features.face.layer import LIFE_SECONDS, blinks, glances, saccade_seconds, speech
from humansim_ros.types import Array

SMILE, JAW = ACTIONS.index("mouthSmileLeft"), ACTIONS.index("jawOpen")
BLINK = ACTIONS.index("eyeBlinkLeft")


def scene(face: object, **others: object) -> Scene:
    humans = {"anna": {"body": "adult_woman", "motion": "t_to_a_pose", "face": face}, **others}
    cameras = {"front": {"position": [3, 0, 1.6], "look_at": [0, 0, 1.5]}}
    return Scene.from_dict({"room": None, "humans": humans, "cameras": cameras})


def anna(face: object, **others: object) -> Actor:
    return scene(face, **others).actors["anna"]


def weights(state: HumanState) -> Array:
    assert state.face is not None
    return state.face.values


def off_target(state: HumanState, point: Array) -> float:
    """Largest angle between an eye and a point, degrees."""
    angles = []
    for eye in ("l_eyeball_joint", "r_eyeball_joint"):
        centre, pupil = (
            state.positions[state.joint_names.index(name)].astype(float) for name in (eye, f"{eye}_end")
        )
        lines = [line / np.linalg.norm(line) for line in (pupil - centre, point - centre)]
        angles.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(*lines)), np.dot(*lines))))
    return max(angles)


KEYS = [
    {"time": 0.5, "expression": "happiness", "strength": 0.5, "blend": 0.4},
    {"time": 1.0, "actions": {"jawOpen": 0.4}, "blend": 0},
    {"time": 1.5, "expression": "neutral", "blend": 0.2},
]


def test_keys_change_expression_and_actions_which_are_added() -> None:
    actor = anna({"keys": KEYS})
    smile = 0.5 * expression("happiness")["mouthSmileLeft"]
    for time, (of_smile, of_jaw) in {
        0.4: (0, 0), 0.7: (smile / 2, 0), 1.2: (smile, 0.4), 1.8: (0, 0.4), 500.0: (0, 0.4)
    }.items():  # fmt: skip
        got = weights(actor.at(time))
        assert (got[SMILE], got[JAW]) == pytest.approx((of_smile, of_jaw), abs=1e-6), time
    state = actor.at(1.2)
    expected = {**{name: 0.5 * each for name, each in expression("happiness").items()}, "jawOpen": 0.4}
    bones = anna({}).at(1.2).joints[: len(actor.human.skeleton)]
    np.testing.assert_allclose(state.vertices, actor.human.pose(bones, expected), atol=1e-6)
    assert weights(anna("happiness").at(0.0))[SMILE] == pytest.approx(2 * smile)  # a key at 0 holds at once


def test_a_scene_without_faces_has_none() -> None:
    stiff = anna(None)
    assert stiff.settings("face") is None and stiff.at(0.5).face is None
    assert not any(name.startswith("face/") for name in stiff.joint_poses(0.5).names)
    resting = anna({})
    np.testing.assert_array_equal(stiff.at(0.5).vertices, resting.at(0.5).vertices)


def test_a_message_of_the_player_carries_the_face() -> None:
    keys = [*KEYS, {"time": 0.6, "gaze": "front"}, {"speak": 2}]
    actor = anna({"alive": True, "keys": keys})
    poses = actor.joint_poses(0.63)
    got, own = LiveRetargeter(actor).retarget(poses), actor.at(0.63)
    assert own.face is not None and got.face is not None
    assert np.array_equal(got.vertices, own.vertices)
    assert np.array_equal([got.face.values, got.face.rates], [own.face.values, own.face.rates])
    assert not any("face" in name for name in JointSource.of_actor(actor).names)
    assert set(poses.split(lambda name: name.startswith("face/"))[0].names) == set(actor.motion.names)


def test_vertices_move_with_the_rates_of_the_face() -> None:
    actor = anna({"keys": KEYS})
    state, step = actor.at(0.7), 4e-3
    assert state.face is not None and state.linear is not None and state.angular is not None
    assert state.face.rates[SMILE] > 1
    lips = np.flatnonzero(np.linalg.norm(actor.at(0.9).vertices - actor.at(0.4).vertices, axis=1) > 0.004)
    before, after = (actor.moved(state, sign * step) for sign in (-1, 1))
    measured = (actor.at(0.7 + step).vertices - actor.at(0.7 - step).vertices)[lips]
    assert np.abs((after - before)[lips] - measured).max() < 0.05 * np.abs(measured).max()
    still = actor.moved(state, 0.0)
    np.testing.assert_allclose(still, state.vertices, atol=1e-5)
    assert np.abs(replace(FACE_AT_REST, values=np.ones(52), rates=np.ones(52)).after(0.1) - 1).max() == 0


def test_eyes_look_at_points_people_and_cameras() -> None:
    keys = [
        {"gaze": [2, 0.5, 1]},
        {"time": 1, "gaze": "front"},
        {"time": 1.5, "gaze": "ben"},
        {"time": 3, "gaze": "ahead"},
    ]
    ben = {"body": "child", "motion": {"file": "jumping_jacks", "position": [1.5, 0.3]}}
    both = scene({"keys": keys}, ben=ben)
    actor = both.actors["anna"]
    assert off_target(actor.at(0.0), np.array([2, 0.5, 1])) < 1e-3
    assert off_target(actor.at(1.4), both.cameras["front"].center) < 1e-3
    for time in (1.8, 2.4):  # ben jumps
        state = both.actors["ben"].at(time)
        eyes = [state.positions[state.joint_names.index(f"{side}_eyeball_joint")] for side in "lr"]
        assert off_target(actor.at(time), np.mean(eyes, axis=0)) < 1e-3
    np.testing.assert_array_equal(actor.at(3.5).vertices, anna({}).at(3.5).vertices)
    playback = Playback(both)
    playback.elapsed = 0
    playback.change("ben", position=(1.5, -0.5))
    eyes = playback.world.eyes("ben", np.array([1.8]), turned=True)[0]
    assert off_target(playback.actors["anna"].at(1.8), eyes) < 1e-3


def test_check_finds_what_eyes_do_not_reach() -> None:
    keys = [{"gaze": "front"}, {"time": 5, "gaze": [-2, 0, 1.5]}]
    found = [each for each in check_scene(scene({"keys": keys}), quick=True) if "gaze" in each.key]
    assert [each.key for each in found] == ["humans.anna.face.keys.1.gaze"]
    assert check_scene(scene({"alive": True}), quick=True) == []
    assert "reach [-2, 0, 1.5] in 0% of the time" in found[0].text


def test_a_saccade_takes_the_time_of_its_angle_and_lids_follow() -> None:
    left, right = np.array([3.0, 1.0, 1.57]), np.array([3.0, -1.0, 1.57])
    actor = anna({"keys": [{"gaze": left.tolist()}, {"time": 0.5, "gaze": right.tolist()}]})
    angle = off_target(actor.at(0.4), right)
    assert 33 < angle < 42
    lasts = 0.021 + 0.0022 * angle  # [Carpenter 1988]
    assert saccade_seconds(angle) == pytest.approx(lasts)
    assert off_target(actor.at(0.5), left) < 0.01 and off_target(actor.at(0.51 + lasts), right) < 0.01
    assert off_target(actor.at(0.5 + lasts / 2), right) == pytest.approx(angle / 2, abs=1.0)
    state = actor.at(0.5 + lasts / 2)
    assert state.angular is not None
    eye = state.joint_names.index("l_eyeball_joint")
    assert np.linalg.norm(state.angular[eye]) == pytest.approx(1.5 * np.radians(angle) / lasts, rel=0.05)
    down = anna({"keys": [{"gaze": [1.0, 0.0, 0.9]}]}).at(0.0)
    assert weights(down)[ACTIONS.index("eyeLookDownLeft")] > 0.4
    up = anna({"keys": [{"gaze": [0.5, 0.0, 9.0]}]}).at(0.0)  # beyond the limit
    assert weights(up)[ACTIONS.index("eyeLookUpRight")] == 1


def test_actions_of_the_eyes_turn_them_to_the_limits_of_the_joints() -> None:
    state = anna({"keys": [{"actions": {"eyeLookInLeft": 0.5, "eyeLookDownRight": 1.0}}]}).at(0.0)
    rest = anna({}).at(0.0)
    for eye, limit in (("l", 22.5), ("r", 47.0)):
        number = state.joint_names.index(f"{eye}_eyeball_joint")
        turn = state.joints[number, :3, 1] @ rest.joints[number, :3, 1]
        assert np.degrees(np.arccos(turn)) == pytest.approx(limit, abs=0.2)
    text = ROOT / "config/joint_limits/normal.yaml"
    block = text.read_text().partition("- bone: eyeball_joint")[2].partition("twist")[0]
    named = dict(
        zip(("depression", "elevation", "abduction", "adduction"), block.split("degrees: ")[1:], strict=True)
    )
    degrees = {name: float(rest.partition(",")[0]) for name, rest in named.items()}
    order = [
        [["abduction", "adduction"], ["elevation", "depression"]],
        [["adduction", "abduction"], ["elevation", "depression"]],
    ]
    np.testing.assert_allclose(np.degrees(LIMITS), np.vectorize(degrees.get)(np.array(order)))
    assert ACTIONS[LOOKS[1, 0, 0]] == "eyeLookInRight"


def test_life_blinks_as_often_as_people_do_and_differs_by_name() -> None:
    counts, closed = [], []
    for seed in range(4):
        track = blinks(random_numbers(seed, "face"))
        times = np.arange(0, LIFE_SECONDS, 0.01)
        lid = track.at(times)[:, 0]
        starts = np.flatnonzero((lid[1:] > 0.5) & (lid[:-1] <= 0.5))
        counts.append(len(starts) / LIFE_SECONDS * 60)
        closed.append((lid > 0.5).mean() / len(starts) * LIFE_SECONDS)
        assert lid.max() == pytest.approx(1, abs=0.05) and lid[0] == lid[-1] == 0
        np.testing.assert_array_equal(
            track.at(times[:50] + LIFE_SECONDS).round(9), track.at(times[:50]).round(9)
        )
    assert np.mean(counts) == pytest.approx(17, rel=0.15)  # [Bentivoglio 1997]
    assert 0.1 < np.mean(closed) < 0.25
    eyes = glances(random_numbers(1, "face")).at(np.arange(0, LIFE_SECONDS, 0.02))
    assert 0 < eyes.max() * 44 < 13
    two = scene({"alive": True}, ben={"face": {"alive": True}})
    seen = {
        name: [weights(actor.at(t))[BLINK] for t in np.arange(0, 9, 0.15)]
        for name, actor in two.actors.items()
    }
    assert seen["anna"] != seen["ben"] and max(seen["anna"]) > 0.3


def test_random_people_are_alive_on_request() -> None:
    variety = {"count": 1, "bodies": ["adult_woman"], "motions": ["stand"], "area": [-1, -1, 1, 1]}
    camera = {"position": [3, 0, 1.6], "look_at": [0, 0, 1.5]}
    stiff, alive = (
        Scene.from_dict({"room": None, "variety": {**variety, "alive": each}, "cameras": {"front": camera}})
        for each in (False, True)
    )
    one, other = (each.config.humans["person_1"] for each in (stiff, alive))
    assert one.face is None and other.face is not None and one == other.model_copy(update={"face": None})
    assert "face/eyeBlinkLeft" in alive.actors["person_1"].joint_poses(0.0).names


def test_a_mouth_speaks_for_its_time_in_the_rhythm_of_syllables() -> None:
    times = np.arange(-1, 12, 0.01)
    track = speech(0.0, 10.0, random_numbers(1, "speech"))
    mouth = track.at(times)
    jaw = mouth[:, track.actions.index(JAW)]
    assert not mouth[times < -0.01].any() and not mouth[times > 10.15].any()
    assert mouth.min() >= 0 and 0.3 < jaw.max() <= 0.6
    changes = np.flatnonzero((np.diff(jaw[:-1]) > 0) & (np.diff(jaw[1:]) <= 0))
    assert 20 < len(changes) < 70  # 2 to 7 a second [Chandrasekaran 2009]
    assert not np.array_equal(
        mouth, speech(0.0, 10.0, random_numbers(2, "speech")).at(times)[:, : mouth.shape[1]]
    )


def test_live_joints_of_a_face_move_it_and_wrong_ones_are_refused() -> None:
    actor = anna({})

    def poses(name: str, rotation: tuple[float, float, float, float]) -> JointPoses:
        given = actor.joint_poses(0.0)
        return given.with_joints([name], np.array([rotation]), np.zeros((1, 3)))

    half = (np.sin(0.25), 0.0, 0.0, np.cos(0.25))
    assert weights(LiveRetargeter(actor).retarget(poses("face/jawOpen", half)))[JAW] == pytest.approx(0.5)
    for name, rotation, message in (
        ("face/jawOpened", half, "did you mean 'jawOpen'"),
        ("face/jawOpen", (np.sin(0.9), 0.0, 0.0, np.cos(0.9)), "from 0 to 1, not 1.8"),
        ("face/jawOpen", (-half[0], 0.0, 0.0, half[3]), "from 0 to 1, not -0.5"),
        ("face/jawOpen", (0.0, half[0], 0.0, half[3]), "about x"),
    ):
        with pytest.raises(MotionError, match=message):
            LiveRetargeter(actor).retarget(poses(name, rotation))
    stiff = scene(None).actors["anna"]
    with pytest.raises(MotionError, match="no face: add the key face"):
        LiveRetargeter(stiff).retarget(poses("face/jawOpen", half))


@pytest.mark.parametrize(
    ("face", "message"),
    [
        ("happines", r"humans\.anna\.face\.keys\.0.*happiness"),
        ({"keys": [{"actions": {"jawOpn": 0.5}}]}, r"no action of the face 'jawOpn'; did you mean 'jawOpen'"),
        ({"keys": [{"actions": {"jawOpen": 1.5}}]}, r"jawOpen must be from 0 to 1, not 1.5"),
        ({"keys": [{"strength": 2, "expression": "fear"}]}, "strength"),
        ({"keys": [{"speak": 0}]}, "speak"),
        ({"keys": [{"time": -1}]}, "time"),
        ({"keys": [{"gaze": "frnt"}]}, r"keys\.0\.gaze: no human .*'frnt'; did you mean 'front'.*ahead ends"),
        ({"keys": [{"gaze": "anna"}]}, "own face"),
        ({"keys": [{"gaze": [1, 2]}]}, "gaze"),
        ({"keys": [{"look_at": "front"}]}, "gaze"),
        ({"alive": 3}, "alive"),
        ({"file": "take.csv"}, r"face\.file: .*take.csv"),
    ],
)  # fmt: skip
def test_wrong_faces_are_refused_with_what_is_known(face: Any, message: str) -> None:
    with pytest.raises(HumansimError, match=rf"(?s){message}"):
        scene(face)


def test_a_body_without_actions_and_a_live_human_are_said() -> None:
    with pytest.warns(HumansimWarning, match="another node moves this human"):
        scene({"alive": True}, ben={"motion": "live", "face": {"alive": True}})
    with pytest.raises(HumansimError, match="place is not known: give a point"):
        scene({"keys": [{"gaze": "ben"}]}, ben={"motion": "live"})


_TITLES = [name[0].upper() + name[1:] for name in reversed(ACTIONS)]
HEAD = ",".join(["Timecode", "BlendShapeCount", *_TITLES, "HeadYaw", "LeftEyePitch"])


def take(tmp_path: Path, *rows: str, head: str = HEAD) -> Path:
    path = tmp_path / "take.csv"
    path.write_text("\r\n".join((head, *rows)) + "\r\n")
    return path


def row(code: str, **values: float) -> str:
    numbers = [f"{values.get(name, 0.0):.6f}" for name in reversed(ACTIONS)]
    return ",".join((code, "61", *numbers, "0.1", "-0.2"))


def test_a_recording_of_live_link_face_plays_from_the_start_of_the_scene(tmp_path: Path) -> None:
    path = take(
        tmp_path,
        row("23:59:59:50.500", jawOpen=0.2),
        "23:59:59:55,0",  # no face was seen
        row("00:00:00:20.500", jawOpen=0.6, mouthSmileLeft=1.0),
    )
    track = read_face_file(path)
    seconds = 0.5  # 60 frames a second, over midnight
    got = np.zeros((4, 52))
    got[:, track.actions] = track.at(np.array([0.0, seconds / 4, seconds, 9.0]))
    np.testing.assert_allclose(got[:, JAW], [0.2, 0.3, 0.6, 0.6])
    np.testing.assert_allclose(got[:, SMILE], [0, 0.25, 1, 1])
    assert weights(anna({"file": str(path)}).at(seconds / 4))[JAW] == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("head", "rows", "message"),
    [
        (HEAD, [], "0 frames"),
        ("a,b", [], "line 1|:1"),
        ("Timecode,BlendShapeCount,JawOpn", ["00:00:00:01,1,0"], "did you mean 'jawOpen'"),
        ("Timecode,JawOpen", ["00:00:00:01,nan"], r":2.*jawopen must be from 0 to 1, not 'nan'"),
        ("Timecode,JawOpen", ["00:00:00:01,0.5", "1 s,0.5"], r":3.*no time code"),
        ("Timecode,JawOpen", ["00:00:02:01,0", "00:00:01:01,0"], r":3.*goes back"),
        ("Timecode,JawOpen,JawOpen", ["00:00:00:01,0,0"], "there twice"),
    ],
)  # fmt: skip
def test_a_damaged_recording_names_line_and_column(
    tmp_path: Path, head: str, rows: list[str], message: str
) -> None:
    with pytest.raises(MotionError, match=message):
        read_face_file(take(tmp_path, *rows, head=head))


def around(degrees: float, height: float = 1.55) -> list[float]:
    """Point two metres from anna, to her left by an angle."""
    angle = np.radians(degrees)
    return [2 * float(np.cos(angle)), 2 * float(np.sin(angle)), height]


def bone(state: HumanState, name: str = "vt3") -> Array:
    return state.joints[state.joint_names.index(name)]


def test_the_head_turns_by_a_share_of_a_gaze_and_eyes_reach_what_they_did_not() -> None:
    for degrees, height in ((60, 1.6), (100, 1.55), (-120, 1.7), (40, 0.3), (-30, 3.0)):
        point = around(degrees, height)
        stiff, turned = (anna({"head": head, "keys": [{"gaze": point}]}).at(0.0) for head in (0, 1))
        assert off_target(turned, np.array(point)) < 1e-3
        assert off_target(stiff, np.array(point)) > (0.5 if degrees != 40 else -1)
        turn = bone(turned)[:3, :3] @ bone(stiff)[:3, :3].T
        angle = np.degrees(np.arccos((np.trace(turn) - 1) / 2))
        eyes, ahead = anna({}).eye_rays(np.zeros(1))
        line = np.array(point) - eyes[0]
        away = np.degrees(np.arccos(ahead[0] @ line / np.linalg.norm(line)))
        assert angle == pytest.approx(0.77 * (away - 18), abs=4)  # [Stahl 1999]
        np.testing.assert_array_equal(bone(turned)[:3, 3], bone(stiff)[:3, 3])
        still = np.array([part == turned.joint_names.index("l_hip") for part in range(len(turned.joints))])
        np.testing.assert_array_equal(turned.joints[still], stiff.joints[still])
    near = {"head": 1, "keys": [{"gaze": around(5)}]}
    np.testing.assert_allclose(bone(anna(near).at(0.0)), bone(anna({}).at(0.0)), atol=1e-12)  # eyes alone


def test_a_head_that_does_not_turn_leaves_all_as_it_was() -> None:
    keys = [{"gaze": around(50)}, {"time": 1, "gaze": "front"}]
    one, other = anna({"keys": keys}), anna({"keys": keys, "head": 0})
    assert one.joint_poses(1.01).names == other.joint_poses(1.01).names
    assert "face/head" not in one.joint_poses(1.01).names
    np.testing.assert_array_equal(one.at(1.01).vertices, other.at(1.01).vertices)


TURN = {
    "head": 0.8,
    "keys": [{"gaze": around(70)}, {"time": 0.5, "gaze": around(-50, 1.0)}, {"time": 2, "gaze": "ahead"}],
}


@pytest.mark.parametrize("time", [0.3, 0.6, 0.71, 2.1])
def test_a_turning_head_has_its_velocities_and_travels_in_messages(time: float) -> None:
    actor = anna(TURN)
    state, step = actor.at(time), 1e-3
    before, after = actor.at(time - step), actor.at(time + step)
    assert state.linear is not None and state.angular is not None
    measured = (after.positions - before.positions) / (2 * step)
    moving = np.linalg.norm(measured - state.linear, axis=1)
    assert moving.max() < 0.02, state.joint_names[int(moving.argmax())]
    crown = state.joint_names.index("vt3_end")
    assert (np.linalg.norm(state.linear[crown]) > 0.03) == (time > 0.5)
    got = LiveRetargeter(actor).retarget(actor.joint_poses(time))
    assert np.array_equal(got.vertices, state.vertices) and np.array_equal(got.joints, state.joints)
    body = [name.startswith(("vt3", "vl5", "l_hip")) for name in state.joint_names]
    paths = actor.joint_paths(np.array([2.5, time]))  # of the evaluation
    np.testing.assert_allclose(paths[1, body], state.positions[body], atol=1e-9)


def test_a_turn_begins_with_the_gaze_and_takes_longer() -> None:
    actor = anna(TURN)
    angles = []
    for time in np.arange(0.5, 1.6, 0.05):
        turn = bone(actor.at(time))[:3, :3] @ bone(actor.at(0.4))[:3, :3].T
        angles.append(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    change = 70 + 50 + 10  # about, in degrees
    lasts = 0.25 + 0.004 * change
    half = int(lasts / 2 / 0.05)
    assert angles[0] < 1.5 and 0.25 < angles[half] / angles[-1] < 0.75
    assert np.ptp(angles[int(lasts / 0.05) + 2 :]) < 3  # the arms of the motion move the trunk a little


def test_two_heads_turn_to_each_other_and_eyes_meet() -> None:
    ben = {
        "body": "child",
        "motion": {"file": "stand", "position": [0.6, 1.2]},
        "face": {"head": 1, "keys": [{"gaze": "anna"}]},
    }
    both = scene({"head": 1, "keys": [{"gaze": "ben"}]}, ben=ben)
    states = {name: actor.at(0.4) for name, actor in both.actors.items()}
    middles = {
        name: np.mean([bone(state, f"{side}_eyeball_joint")[:3, 3] for side in "lr"], axis=0)
        for name, state in states.items()
    }
    assert off_target(states["anna"], middles["ben"]) < 1e-3
    alone = scene({}, ben={**ben, "face": {}}).actors
    turned = np.linalg.norm(middles["ben"] - alone["ben"].eye_rays(np.array([0.4]))[0][0])
    assert turned > 0.02
    assert off_target(states["ben"], middles["anna"]) < 1e-3


def test_a_human_is_pickled_without_those_that_it_looks_at() -> None:
    ben = {"body": "child", "motion": {"file": "stand", "position": [0.6, 1.2]}}
    both = scene({"head": 1, "keys": [{"gaze": "ben"}]}, ben=ben)
    again = pickle.loads(pickle.dumps(both)).actors["anna"]
    np.testing.assert_array_equal(again.at(0.4).vertices, both.actors["anna"].at(0.4).vertices)
    alone = pickle.dumps(both.actors["anna"])
    assert len(alone) < 1.1 * len(pickle.dumps(both.actors["anna"].with_layer("face", settings=None)))
    with pytest.raises(HumansimError, match="does not know where ben is"):
        pickle.loads(alone).at(0.4)


def test_former_names_of_settings_warn() -> None:
    human = anna({"head": 1})
    with pytest.warns(DeprecationWarning, match=r"use settings\('face'\)"):
        assert human.face is human.settings("face")
    with pytest.raises(AttributeError, match="'faces'"):
        _ = human.faces


def test_the_neck_stays_within_its_limits_and_never_jumps() -> None:
    actor = anna({"head": 1, "keys": [{"gaze": [1, 0, 1]}]})
    assert actor.settings("face") is not None and actor._eyes is not None
    skeleton, eyes = actor.human.skeleton, actor._eyes
    limits = load_limits(skeleton=skeleton)
    joints = actor.joints_at(np.zeros(1))
    middle = eyes.rays(joints)[0][0]
    grid = np.meshgrid(np.radians(np.arange(0, 361, 2)), np.radians([-80, -40, 0, 30, 70, 85]))
    yaw, pitch = (each.ravel() for each in grid)
    directions = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=1)
    turned = np.repeat(joints, len(yaw), axis=0)
    eyes.turn_head(turned, middle + 3 * directions, np.ones(len(yaw)))
    bones = turned[:, : len(skeleton), :3, :3]
    parents = skeleton.parents
    local = skeleton.rest_in_parent[:, :3, :3]
    in_bone = local.swapaxes(-1, -2) @ bones[:, parents].swapaxes(-1, -2) @ bones
    rotations = Rotation.from_matrix(in_bone.reshape(-1, 3, 3)).as_quat().reshape(*in_bone.shape[:2], 4)
    angles = {name: each for name, each in limits.angles(rotations).items() if name.startswith("vt3.")}
    assert np.ptp(angles["vt3.rotation left"]) > 120
    assert not [each for each in limits.report(rotations) if each.bone == "vt3"]
    ring = bones[:, eyes.head].reshape(6, -1, 3, 3)
    steps = np.linalg.norm(np.diff(ring, axis=1), axis=(2, 3)) / np.sqrt(2)
    assert np.degrees(steps.max()) < 12  # for two degrees of the point, where it passes behind
    text = (ROOT / "config/joint_limits/normal.yaml").read_text()
    block = text.partition("- bone: vt3\n")[2].partition("- bone:")[0].split("degrees: ")[1:]
    flexion, extension, _, _, left, right = (float(each.partition(",")[0]) for each in block)
    np.testing.assert_allclose(np.degrees(NECK_LIMITS), [[-right, -flexion], [left, extension]])


def test_check_knows_how_far_the_head_turns() -> None:
    keys = [{"gaze": around(80)}, {"time": 5, "gaze": [-2, 0, 1.5]}]
    for head, wrong, text in ((0, [0, 1], "head: 1"), (1, [1], "even with the head")):
        found = [
            each
            for each in check_scene(scene({"head": head, "keys": keys}), quick=True)
            if "gaze" in each.key
        ]
        assert [each.key for each in found] == [f"humans.anna.face.keys.{number}.gaze" for number in wrong]
        assert text in found[-1].text
    with pytest.raises(HumansimError, match=r"humans\.anna\.face\.head"):
        scene({"head": 1.5})
