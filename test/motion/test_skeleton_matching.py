"""Persons matched by the shape of their skeletons alone."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import if_shared
from motion_files import StandIn, stand_in, walk
from stand_ins import NO_PERSON, STAND_INS, motion_path

from humansim_ros.errors import HumansimWarning, MotionError
from humansim_ros.motion import Motion, read_bvh
from humansim_ros.motion.matching.by_shape import JointTree, match_motion, match_shape
from humansim_ros.motion.matching.joint_tables import load_table, table_text

#: Files of people, and the roles that shape gets otherwise than names: makehuman's twist bones and thumbs.
PEOPLE: dict[str, set[str]] = {
    "aitviewer_sample": set(),
    "animdraw_cmu1_jumping_jacks": set(),
    "animdraw_rokoko_jesse_dance": set(),
    "assimp_Boxing_Toes": set(),
    "bvhio_example": set(),
    "bvhtoolbox_walk01": set(),
    "makehuman_tpose": {"Shoulder", "Wrist"},
    "makehuman_walk1": {"Shoulder", "Wrist"},
    "mixamo_freebvh": set(),
    "mocapbank_bvhpython": set(),
    "pybvh_cmu_12_01_walk": {"Wrist"},
    "pybvh_test1": set(),
    "walk": set(),
    **{name: set() for name in STAND_INS},
}
LIMBS = [f"{side}{part}" for side in ("Left", "Right") for part in
         ("Hip", "Knee", "Ankle", "Shoulder", "Elbow", "Wrist")]  # fmt: skip


def read(stem: str) -> Motion:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", HumansimWarning)
        return read_bvh(motion_path(stem))


def nameless(motion: Motion) -> Motion:
    return replace(motion, joint_names=tuple(f"j{number}" for number in range(motion.n_joints)))


def shuffled(motion: Motion, seed: int) -> tuple[Motion, list[int]]:
    """A motion with its children in another order, and the old index of each new joint."""
    rng = np.random.default_rng(seed)
    children: dict[int, list[int]] = {}
    for joint, parent in enumerate(motion.parents):
        children.setdefault(int(parent), []).append(joint)
    order: list[int] = []
    stack = list(rng.permutation(children[-1]))
    while stack:
        joint = int(stack.pop())
        order.append(joint)
        stack += list(rng.permutation(children.get(joint, [])))
    columns = np.concatenate([motion._columns[j] + np.arange(len(motion.channels[j])) for j in order]).astype(
        int
    )
    new = {-1: -1, **{joint: number for number, joint in enumerate(order)}}
    return replace(
        motion,
        joint_names=tuple(motion.joint_names[j] for j in order),
        parents=np.array([new[int(motion.parents[j])] for j in order]),
        offsets=motion.offsets[order],
        channels=tuple(motion.channels[j] for j in order),
        values=motion.values[:, columns],
    ), order


@pytest.mark.parametrize(
    "stem", ["walk", *STAND_INS, *if_shared(*(stem for stem in PEOPLE if stem not in ("walk", *STAND_INS)))]
)
def test_a_person_without_names_has_the_same_limbs(stem: str) -> None:
    motion = read(stem)
    named = match_motion(motion)
    assert named.by == "names"
    mixed, order = shuffled(nameless(motion), 3)
    for found, back in ((match_shape(nameless(motion)), None), (match_shape(mixed), order)):
        assert found is not None
        assert found.by == "shape"
        assert 0.1 < found.confidence < 0.8
        for role in LIMBS:
            joint = found.roles[role] if back is None else back[found.roles[role]]
            if role.removeprefix("Left").removeprefix("Right") not in PEOPLE[stem]:
                # a joint of the same place, where some have no length between them
                way = np.abs(motion.world_positions(0)[joint] - motion.world_positions(0)[named.roles[role]])
                assert way.max() < 0.02 * np.ptp(motion.rest_positions()), role


def test_names_that_give_only_the_sides_are_used() -> None:
    motion = read("walk")
    words = [
        f"{'left' if 'Left' in name else 'right' if 'Right' in name else 'mid'}_{number}"
        for number, name in enumerate(motion.joint_names)
    ]
    crossed = [word.replace("left", "?").replace("right", "left").replace("?", "right") for word in words]
    sure = match_shape(replace(motion, joint_names=tuple(words)))
    other = match_shape(replace(motion, joint_names=tuple(crossed)))
    guess = match_shape(nameless(motion))
    assert sure is not None and other is not None and guess is not None
    assert sure.confidence > guess.confidence
    assert sure.roles["LeftKnee"] == other.roles["RightKnee"] == guess.roles["LeftKnee"]


@pytest.mark.parametrize(
    "stem", [*NO_PERSON, *if_shared("firepal_vr", "fairmotion_sinusoidal", "pybvh_rotation_first_root")]
)
def test_a_skeleton_that_is_not_a_person_has_no_match(stem: str) -> None:
    assert match_shape(read(stem)) is None
    with pytest.raises(MotionError, match="shape of a person"):
        match_motion(read(stem))


@pytest.mark.parametrize("seed", range(6))
def test_other_proportions_are_matched(seed: int) -> None:
    """Each link up to 6 % longer or shorter on both sides."""
    motion = read("walk")
    rng = np.random.default_rng(seed)
    factors = {
        name.replace("Left", "").replace("Right", ""): rng.uniform(0.94, 1.06) for name in motion.joint_names
    }
    scale = [factors[name.replace("Left", "").replace("Right", "")] for name in motion.joint_names]
    changed = nameless(replace(motion, offsets=motion.offsets * np.array(scale)[:, None]))
    found, named = match_shape(changed), match_motion(motion)
    assert found is not None
    assert {role: found.roles[role] for role in LIMBS} == {role: named.roles[role] for role in LIMBS}


def test_a_skeleton_of_unknown_names_is_matched_by_shape_saved_and_passed_back(tmp_path: Path) -> None:
    motion = nameless(read("walk"))
    match = match_motion(motion)
    assert match.by == "shape"
    (tmp_path / "mine.yaml").write_text(table_text(match, motion))
    again = match_motion(motion, tmp_path / "mine.yaml")
    assert again.by == "given"
    assert (again.parallel, again.difference, again.roles) == (match.parallel, match.difference, match.roles)
    assert "confidence" in (tmp_path / "mine.yaml").read_text().splitlines()[0]
    assert load_table(tmp_path / "mine.yaml").name == "shape"


def with_face_and_fingers() -> StandIn:
    """A person with a face, whose lips are farther from the neck than the eyes, and with fingers and toes."""
    person = stand_in("lafan1")
    names, roles, parents, offsets = (
        list(person.names), list(person.roles), list(person.parents), person.offsets.tolist()
    )  # fmt: skip

    def add(name: str, parent: int, offset: tuple[float, float, float]) -> int:
        names.append(name)
        roles.append(name)
        parents.append(parent)
        offsets.append(offset)
        return len(names) - 1

    head = person.joint("Head")
    lips = add("special04", add("jaw", head, (0, 2, 4)), (0, -3, 6))
    for side in (-1, 1):
        add("oris07", add(f"oris06{side}", lips, (2 * side, 2, 4)), (2 * side, 1, 2))
        add(f"eye{side}", head, (3 * side, 8, 8))
    for side, sign in (("Left", 1), ("Right", -1)):
        wrist = person.joint(f"{side}Wrist")
        for finger in range(5):
            joint = add(f"metacarpal{finger}", wrist, (sign * 3, 0, finger - 2.0))
            for part in range(3):
                joint = add(f"finger{finger}-{part}", joint, (sign * (6 - part), 0, 0))
        ankle = person.joint(f"{side}Ankle")
        for toe in range(4):
            add(f"toe{toe}", add(f"metatarsal{toe}", ankle, (toe - 1.5, -4, 6)), (0, -2, 6))
    unique = tuple(f"{name}.{number}" for number, name in enumerate(names))
    return StandIn(unique, tuple(roles), tuple(parents), np.array(offsets), {})


#: Names of no table for the joints of a person, with the words head, hand and foot.
WORDS = {"Head": "atama_head", "LeftWrist": "te_hand.L", "RightWrist": "te_hand.R", "LeftAnkle": "foot.L",
         "RightAnkle": "foot.R"}  # fmt: skip


@pytest.mark.parametrize("words", [{}, WORDS], ids=["without names", "with some names"])
def test_many_joints_of_face_and_fingers_do_not_hide_head_and_wrists(words: dict[str, str]) -> None:
    person = with_face_and_fingers()
    motion = person.motion(walk())
    role_of = dict(zip(person.names, person.roles, strict=True))
    roles = [role_of.get(name, "") for name in motion.joint_names]
    names = tuple(words.get(role, f"b{number}") for number, role in enumerate(roles))
    match = match_motion(replace(motion, joint_names=names))
    assert match.by == "shape"
    found = {role: roles[joint] for role, joint in match.roles.items()}
    assert found["Head"] == "Head"
    assert found["Neck"] == "Neck"
    for role in LIMBS:
        assert found[role] == role


def test_the_head_of_a_person_without_a_face_is_below_its_end_site() -> None:
    motion = stand_in("lafan1").motion(walk())
    match = match_motion(nameless(motion))
    assert motion.joint_names[match.roles["Head"]] == "Head"


def test_of_a_joint_with_thousands_of_branches_the_longest_are_compared() -> None:
    """All pairs of a hedgehog's spines would be millions."""
    count = 2000
    hedgehog = Motion(
        joint_names=tuple(f"j{number}" for number in range(count + 1)),
        parents=np.array([-1] + [0] * count),
        offsets=np.array([[0.0, 0, 0]] + [[0, 10 + number % 7, 0] for number in range(count)]),
        channels=((),) * (count + 1),
        values=np.zeros((1, 0)),
        frame_time=0.1,
    )
    pairs = JointTree(hedgehog).pairs()
    assert len(pairs) == 30 * 29 / 2
    assert {pair.length for pair in pairs} == {16.0}
    assert match_shape(hedgehog) is None
