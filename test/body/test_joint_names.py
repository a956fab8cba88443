"""The table of joint names is complete, and agrees with the sets that it names, the page and the command."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml
from conftest import ROOT

from humansim_ros import load_human
from humansim_ros.cli.human import joints as print_joints
from humansim_ros.files.reading import read_table
from humansim_ros.motion import hanim_skeleton
from humansim_ros.motion.body.skeleton import (
    DETAIL_BONES,
    FINGERS,
    JOINT_NAMES,
    SETS,
    SMPL,
    SMPL_MODELS,
    side_of,
)

COCO, BODY_25 = (tuple(read_table("joints")[name]) for name in ("coco", "body_25"))
BY_NAME = {row.name: row for row in JOINT_NAMES}


def test_every_joint_of_the_general_skeleton_is_listed_once() -> None:
    assert sorted(row.name for row in JOINT_NAMES[:27]) == sorted(hanim_skeleton().joint_names)
    assert len(BY_NAME) == len(JOINT_NAMES) == 77
    assert all(row.place for row in JOINT_NAMES)
    assert all(bool(row.bone) != row.name.endswith("_end") for row in JOINT_NAMES)


def test_fingers_toes_jaw_and_eyes_are_listed_once_with_their_ends_after_the_general_skeleton() -> None:
    heads = [row.name for row in JOINT_NAMES[27:] if row.bone]
    ends = [row.name for row in JOINT_NAMES[27:] if not row.bone]
    assert heads == list(DETAIL_BONES)
    assert ends == [f"{bone}_end" for bone in DETAIL_BONES if bone not in DETAIL_BONES.values()]


def test_fingers_follow_each_other_from_the_wrist() -> None:
    chains = [[f"{side}_{name}{k}" for k in (1, 2, 3)] for side in "lr" for name in FINGERS]
    assert list(DETAIL_BONES)[:30] == [bone for chain in chains for bone in chain]
    for first, second, third in chains:
        parents = [DETAIL_BONES[bone] for bone in (first, second, third)]
        assert parents == [f"{first[0]}_wrist", first, second]
    others = {bone: parent for bone, parent in DETAIL_BONES.items() if bone[-1] not in "123"}
    assert others == {
        "l_metatarsal": "l_ankle",
        "r_metatarsal": "r_ankle",
        **dict.fromkeys(("temporomandibular", "l_eyeball_joint", "r_eyeball_joint"), "vt3"),
    }


@pytest.mark.parametrize(
    ("column", "names"),
    [("coco", COCO), ("body_25", BODY_25), ("smpl", (*SMPL, *SMPL_MODELS[55][22:]))],
)
def test_each_joint_of_a_set_has_one_joint_or_none(column: str, names: tuple[str, ...]) -> None:
    used = [name for row in JOINT_NAMES if (name := getattr(row, column)) is not None]
    assert len(set(used)) == len(used) and set(used) <= set(names)


def test_sets_have_their_sizes_and_the_numbers_of_their_definitions() -> None:
    assert [len(names) for names in (COCO, BODY_25, SMPL)] == [17, 25, 24]
    assert (COCO[5], COCO[16]) == ("left_shoulder", "right_ankle")
    assert (BODY_25[1], BODY_25[8], BODY_25[14], BODY_25[24]) == ("Neck", "MidHip", "LAnkle", "RHeel")
    assert (SMPL[0], SMPL[12], SMPL[15], SMPL[23]) == ("pelvis", "neck", "head", "right_hand")


def test_left_is_left_in_every_set() -> None:
    skeleton = hanim_skeleton()
    x_of = dict(zip(skeleton.names, skeleton.heads[:, 0], strict=True))
    for row in JOINT_NAMES:
        side = side_of(row.name)
        assert side * x_of.get(row.name, side) >= 0
        word = {1: ("l_", "left_", "L"), -1: ("r_", "right_", "R"), 0: ("", "", "")}[side]
        for column, prefix in (
            ("hanim2", word[0]),
            ("smpl", word[1]),
            ("coco", word[1]),
            ("body_25", word[2]),
        ):
            name = getattr(row, column)
            assert name is None or name.startswith(prefix), row


def test_the_same_joints_of_smpl_play_the_same_role_in_motion_files() -> None:
    """config/joint_names/smpl.yaml tells the roles of SMPL's joints in motions, independently."""
    roles = yaml.safe_load((ROOT / "config" / "joint_names" / "smpl.yaml").read_text())["joints"]
    for row in JOINT_NAMES:
        # the table of roles has the left side only
        is_detail = row.name.removesuffix("_end") in DETAIL_BONES
        if row.smpl and "smpl" not in row.near and side_of(row.name) > 0 and not is_detail:
            assert row.smpl in roles["Left" + row.smpl.removeprefix("left_").title()]


def test_joints_of_a_person_are_at_the_places_that_the_table_says() -> None:

    human = load_human("adult_woman")
    skeleton, surface = human.skeleton, human.mesh.vertices
    ends = [skeleton.tails[bone] for bone in skeleton.ends]
    at = dict(zip(skeleton.joint_names, [*skeleton.heads, *ends], strict=True))
    assert surface[:, 1].max() - at["vt3_end"][1] < 0.05  # the top of the head, below the hair
    hips = (at["l_hip"] + at["r_hip"]) / 2
    assert hips[1] - 0.12 < at["HumanoidRoot"][1] < hips[1]
    assert abs(at["sacroiliac"][1] - hips[1]) < 0.05
    for connection, place in (("HumanoidRoot_to_l_hip", "sacroiliac"), ("vl5_to_l_sternoclavicular", "vt3")):
        assert BY_NAME[connection].place == f"as {place}" and np.allclose(at[connection], at[place])
    # the neck is the narrowest slice between shoulders and head: its base is a little lower
    levels = np.arange(at["l_shoulder"][1], at["vt3_end"][1] - 0.1, 0.01)
    near = [surface[(abs(surface[:, 1] - y) < 0.01) & (abs(surface[:, 0]) < 0.25), 0] for y in levels]
    narrowest = levels[np.argmin([np.ptp(x) for x in near])]
    assert at["l_shoulder"][1] < at["vt3"][1] < narrowest < at["vt3"][1] + 0.08
    assert at["sacroiliac"][1] < at["vl5"][1] < (at["sacroiliac"][1] + at["vt3"][1]) / 2


def test_the_page_of_joints_has_the_table_of_today() -> None:
    import sys

    sys.path.insert(0, str(ROOT / "tools"))
    try:
        import doc_pages
    finally:
        sys.path.pop(0)
    page = (ROOT / "docs" / "joints.md").read_text()
    assert page == doc_pages.with_joint_names(page), "run python tools/doc_pages.py"
    assert page.count("\n| `") == len(JOINT_NAMES)


def test_the_command_prints_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    print_joints()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split()[:2] == ["joint", "place"] and all(title in lines[0] for title in SETS.values())
    neck = next(line for line in lines if line.startswith("vt3 "))
    assert "base of the neck" in neck and "~neck" in neck and "~Neck" in neck
    print_joints(as_json=True)
    rows = json.loads(capsys.readouterr().out)
    assert rows[0]["name"] == "HumanoidRoot" and rows[3]["near"] == ["smpl", "body_25"]
