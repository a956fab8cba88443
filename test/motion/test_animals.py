"""Animals on four legs are refused; persons who crawl, lie, sit or have a tail are not."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT, SHARED_DATA, shared_motions
from motion_files import (
    Array,
    Rotations,
    StandIn,
    arms_down,
    one_axis,
    phases,
    random_axes,
    stand_in,
    turns,
    walk,
)

from humansim_ros.cli import main as cli
from humansim_ros.errors import HumansimError, HumansimWarning, MotionError
from humansim_ros.motion import Motion, match_motion, read_bvh
from humansim_ros.motion.matching.by_shape import animal_signs
from humansim_ros.motion.matching.joint_tables import LOW_CONFIDENCE, MIN_CONFIDENCE
from humansim_ros.scene import Scene

#: Name, role, parent and OFFSET (centimetres, y up, facing +z) of a dog that stands; left side.
_DOG = (
    ("Hips", "Hips", "", (0.0, 50.0, 0.0)),
    ("Spine", "Spine", "Hips", (0.0, 0.0, 19.0)),
    ("Spine1", "Chest", "Spine", (0.0, 1.0, 20.0)),
    ("Neck", "Neck", "Spine1", (0.0, 8.0, 8.0)),
    ("Head", "Head", "Neck", (0.0, 8.0, 12.0)),
    ("LeftShoulder", "LeftCollar", "Spine1", (4.0, 0.0, 2.0)),
    ("LeftArm", "LeftShoulder", "LeftShoulder", (2.0, -7.0, 2.0)),
    ("LeftForeArm", "LeftElbow", "LeftArm", (0.0, -15.0, -2.0)),
    ("LeftHand", "LeftWrist", "LeftForeArm", (0.0, -18.0, 2.0)),
    ("LeftUpLeg", "LeftHip", "Hips", (5.0, -6.0, -2.0)),
    ("LeftLeg", "LeftKnee", "LeftUpLeg", (0.0, -16.0, 4.0)),
    ("LeftFoot", "LeftAnkle", "LeftLeg", (0.0, -17.0, -6.0)),
)
_TAIL = (("Tail", "Tail", "Hips", (0.0, 0.0, -8.0)), ("Tail1", "Tail1", "Tail", (0.0, 0.0, -12.0)))


def quadruped(tail: bool = True, arms: float = 1.0) -> StandIn:
    """A dog with the joint names of HumanIK, with or without a tail; forelegs scaled by ``arms``."""
    rows = []
    for name, role, parent, offset in (*_DOG, *(_TAIL if tail else ())):
        scale = arms if role in ("LeftElbow", "LeftWrist") else 1.0
        rows.append((name, role, parent, np.array(offset) * scale))
        if role.startswith("Left"):
            mirrored = (part.replace("Left", "Right") for part in (name, role, parent))
            rows.append((*mirrored, rows[-1][3] * (-1, 1, 1)))
    names = [row[0] for row in rows]
    order = []

    def add(name: str) -> None:
        order.append(names.index(name))
        for row in rows:
            if row[2] == name:
                add(row[0])

    add("Hips")
    chosen = [rows[number] for number in order]
    places = [row[0] for row in chosen]
    return StandIn(
        tuple(places),
        tuple(row[1] for row in chosen),
        tuple(places.index(row[2]) if row[2] else -1 for row in chosen),
        np.array([row[3] for row in chosen]),
        {places.index("Head"): (0.0, 0.0, 15.0), places.index("LeftHand"): (0.0, 0.0, 6.0)},
    )


def trot(frames: int = 60) -> dict[str, Rotations]:
    swing = np.sin(phases(frames, 3))
    return {
        "LeftHip": turns("x", 25 * swing),
        "RightHip": turns("x", -25 * swing),
        "LeftShoulder": turns("x", -25 * swing),
        "RightShoulder": turns("x", 25 * swing),
        "Head": turns("y", 20 * swing),
    }


def dog_sits(frames: int = 30) -> dict[str, Rotations]:
    """Trunk up by 50 degrees, forelegs vertical, hind legs forward."""
    still = np.ones(frames)
    return {
        "Hips": turns("x", -50 * still),
        "LeftShoulder": turns("x", 50 * still),
        "RightShoulder": turns("x", 50 * still),
        "LeftHip": turns("x", -30 * still),
        "RightHip": turns("x", -30 * still),
    }


ANIMALS: dict[str, Callable[[], Motion]] = {
    "a dog": lambda: quadruped().motion(trot()),
    "a dog with OFFSETs along one axis": lambda: quadruped().motion(trot(), axes=one_axis(quadruped())),
    "a dog with OFFSETs that are no pose": lambda: quadruped().motion(trot(), axes=random_axes(quadruped())),
    "a dog that sits": lambda: quadruped().motion(dog_sits()),
    "an animal without a tail": lambda: quadruped(tail=False).motion(trot()),
    "an animal with short forelegs and a tail": lambda: quadruped(arms=0.7).motion(trot()),
}


@pytest.mark.parametrize("animal", ANIMALS)
def test_an_animal_is_refused_and_played_if_asked_for(animal: str) -> None:
    motion = ANIMALS[animal]()
    with pytest.raises(MotionError, match=r"rather an animal.*below 12%.*--min-confidence 0") as caught:
        match_motion(motion)
    assert ("tail" in caught.value.message) == ("Tail" in motion.joint_names)
    match = match_motion(motion, min_confidence=0)
    assert match.confidence < MIN_CONFIDENCE
    assert match.reasons


def nameless(motion: Motion) -> Motion:
    return replace(motion, joint_names=tuple(f"b{number}" for number in range(motion.n_joints)))


def test_an_animal_without_names_is_no_person() -> None:
    with pytest.raises(MotionError, match=r"no joint table fits|rather an animal"):
        match_motion(nameless(quadruped().motion(trot())))


def crawl(frames: int = 60) -> dict[str, Rotations]:
    """On hands and knees: trunk horizontal, thighs and arms vertical, shins on the floor."""
    still, swing = np.ones(frames), np.sin(phases(frames, 2))
    return {
        "Hips": turns("x", 90 * still),
        "LeftHip": turns("x", -90 * still + 15 * swing),
        "RightHip": turns("x", -90 * still - 15 * swing),
        "LeftKnee": turns("x", 90 * still),
        "RightKnee": turns("x", 90 * still),
        "LeftShoulder": turns("x", 15 * swing) * turns("y", -90 * still),
        "RightShoulder": turns("x", -15 * swing) * turns("y", 90 * still),
    }


def bear_crawl(frames: int = 60) -> dict[str, Rotations]:
    """On hands and feet, with the hips above the shoulders."""
    pose = crawl(frames)
    return {**pose, "Hips": turns("x", np.full(frames, 110.0)), "LeftKnee": turns("x", np.full(frames, 20.0)),
            "RightKnee": turns("x", np.full(frames, 20.0))}  # fmt: skip


def lie(degrees: float) -> Callable[[], dict[str, Rotations]]:
    return lambda: {**arms_down(30), "Hips": turns("x", np.full(30, degrees))}


def sit(frames: int = 30) -> dict[str, Rotations]:
    """On a chair, hands on the knees."""
    still = np.ones(frames)
    down = {"LeftShoulder": turns("y", -50 * still) * turns("z", -50 * still)}
    down["RightShoulder"] = turns("y", 50 * still) * turns("z", 50 * still)
    bent = {f"{side}{part}": turns("x", degrees * still)
            for side in ("Left", "Right") for part, degrees in (("Hip", -90), ("Knee", 90))}  # fmt: skip
    return {**down, **bent}


PERSONS = {"crawls": crawl, "crawls on hands and feet": bear_crawl, "lies on the belly": lie(90),
           "lies on the back": lie(-90), "sits": sit, "walks": walk}  # fmt: skip


def tailed(family: str = "lafan1") -> StandIn:
    """A person with a tail."""
    person = stand_in(family)
    return StandIn(
        (*person.names, "Tail", "Tail_1"),
        (*person.roles, "Tail", "Tail_1"),
        (*person.parents, 0, len(person.names)),
        np.vstack([person.offsets, [[0, 0, -10], [0, -20, -10]]]),
        person.ends,
    )


@pytest.mark.parametrize("pose", PERSONS)
@pytest.mark.parametrize("axes", [None, one_axis, random_axes])
def test_a_person_in_any_pose_is_not_refused(pose: str, axes: Callable[[StandIn], Array] | None) -> None:
    for family in ("lafan1", "biovision"):
        person = stand_in(family)
        motion = person.motion(PERSONS[pose](), axes=None if axes is None else axes(person))
        match = match_motion(motion)
        assert match.confidence >= (0.5 if "crawls" in pose and axes is not None else 1.0)


@pytest.mark.parametrize("pose", PERSONS)
def test_a_person_with_a_tail_whose_offsets_stand_is_not_refused(pose: str) -> None:
    assert match_motion(tailed().motion(PERSONS[pose]())).confidence == 1


def test_hair_and_coats_are_no_tails() -> None:
    person = stand_in("lafan1").with_joint_above("Head", "Ponytail")
    motion = person.motion(bear_crawl(), axes=one_axis(person))
    factor, reasons = animal_signs(motion, match_motion(motion).roles)
    assert factor == 0.5 and "tail" not in " ".join(reasons)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "assets" / "motions").glob("*.bvh")), ids=lambda path: path.stem
)
def test_every_built_in_motion_is_a_person(path: Path) -> None:
    assert match_motion(read_bvh(path)).confidence == 1


def test_short_legs_alone_lower_the_confidence_and_refuse_nobody() -> None:
    person = stand_in("lafan1")
    for part, offset in (("LeftKnee", (0, -20, 0)), ("LeftAnkle", (0, -18, 0))):
        person = person.moved(part, offset)
    match = match_motion(person.motion(walk()))
    assert match.confidence == pytest.approx(0.5)
    assert any("legs are" in reason for reason in match.reasons)
    assert match.warning is not None and "50%" in match.warning


def test_scenes_refuse_an_animal_and_state_a_low_confidence(tmp_path: Path) -> None:
    (tmp_path / "dog.bvh").write_text(quadruped().text(trot()))
    human = {"motion": {"file": str(tmp_path / "dog.bvh")}}
    scene = {"humans": {"rex": human}, "cameras": {"eye": {"size": [64, 48], "position": [3, 0, 1],
             "look_at": [0, 0, 1]}}}  # fmt: skip
    with pytest.raises(
        HumansimError, match=r"humans\.rex\.motion\.file: .*dog\.bvh: .*set min_confidence to 0"
    ):
        Scene.from_dict(scene)
    human["motion"]["min_confidence"] = 0  # type: ignore[assignment]
    with pytest.warns(HumansimWarning, match=r"dog\.bvh: .* a confidence of 5%; the body is on all fours"):
        Scene.from_dict(scene)
    named = stand_in("lafan1").motion(walk())
    (tmp_path / "odd.bvh").write_text(re.sub(r"(JOINT|ROOT) \w+", lambda m: f"{m[1]} b{m.start()}",
                                             stand_in("lafan1").text(walk())))  # fmt: skip
    assert match_motion(named).warning is None
    human["motion"] = {"file": str(tmp_path / "odd.bvh")}
    with pytest.warns(HumansimWarning, match=r"odd\.bvh: .* matched by shape with a confidence of \d\d%"):
        Scene.from_dict(scene)
    assert LOW_CONFIDENCE > MIN_CONFIDENCE


def test_commands_play_an_animal_only_if_asked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "dog.bvh").write_text(quadruped().text(trot(4)))

    def humansim(*words: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["humansim", "motion", *words])
        code = cli.main()
        out, err = capsys.readouterr()
        return code, out, err

    file = str(tmp_path / "dog.bvh")
    code, out, _ = humansim("info", file)
    assert code == 0 and "no person: this is not a person but rather an animal" in out
    for command in (["table", file], ["retarget", file], ["retarget", file, "--json"]):
        code, out, err = humansim(*command)
        assert (code, out) == (2, "")
        assert len(err.splitlines()) == 1 and "--min-confidence 0" in err
        code, out, _ = humansim(*command, "--min-confidence", "0")
        assert code == 0 and out
    facts = json.loads(humansim("info", file, "--min-confidence", "0", "--json")[1])
    assert facts["confidence"] == pytest.approx(0.05)
    assert any("on all fours" in text for text in facts["warnings"])


def test_a_real_dog_is_refused(shared_data: Path) -> None:
    motion = read_bvh(shared_data / "bvh" / "dog_D1_010.bvh")
    with pytest.raises(MotionError, match="rather an animal"):
        match_motion(motion)


@pytest.mark.filterwarnings("ignore::humansim_ros.errors.HumansimWarning")
@pytest.mark.parametrize(
    "stem",
    shared_motions(
        "dog_D1_010",
        "fairmotion_sinusoidal",
        "firepal_vr",
        "pybvh_rotation_first_root",
    ),
)
def test_no_real_person_is_taken_for_an_animal(stem: str) -> None:
    motion = read_bvh(SHARED_DATA / "bvh" / f"{stem}.bvh")
    factor, _ = animal_signs(motion, match_motion(motion).roles)
    assert factor >= 0.5
