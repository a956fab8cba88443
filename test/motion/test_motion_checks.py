"""Signs of damaged files: knees that bend backwards, trunks that lie."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from motion_files import Array as Values
from motion_files import Rotations, StandIn, arms_down, bow, one_axis, stand_in, turns, walk

from humansim_ros.motion import Motion, read_motion
from humansim_ros.motion.pose.reports import describe_motion

PERSON = stand_in("lafan1")


def checks(motion: Motion, **options: str) -> str:
    """Warnings of the summary, one a line."""
    return "\n".join(describe_motion(motion, **options)["warnings"])


def backwards() -> dict[str, Rotations]:
    """A walk whose left knee bends the wrong way."""
    pose = walk(30)
    return {**pose, "LeftKnee": pose["LeftKnee"].inv()}


@pytest.mark.parametrize("axes", [None, one_axis])
@pytest.mark.parametrize("heading", [0.0, 130.0])
def test_a_knee_that_bends_backwards_is_reported(
    axes: Callable[[StandIn], Values] | None, heading: float
) -> None:
    joints = None if axes is None else axes(PERSON)
    turned = turns("y", np.full(30, heading))
    assert "knee bends backwards in" in checks(PERSON.motion({**backwards(), "Hips": turned}, axes=joints))
    assert checks(PERSON.motion(walk(30, heading), axes=joints)) == ""


def test_exchanged_sides_are_reported_as_knees() -> None:
    """Legs whose names are exchanged face backwards, so their knees do, too."""
    motion = PERSON.motion(walk(30))
    other = {"Left": "Right", "Right": "Left"}
    swapped = [
        re.sub("^(Left|Right)(?=.*(Leg|Foot|Toe))", lambda side: other[side[1]], name)
        for name in motion.joint_names
    ]
    assert "left and right are exchanged" in checks(replace(motion, joint_names=tuple(swapped)))


def test_a_trunk_that_lies_is_reported_with_the_up_axis() -> None:
    lies = PERSON.motion({**arms_down(30), "Hips": turns("x", np.full(30, 90.0))})
    assert "the trunk lies in 100% of the frames, with y up" in checks(lies, up="y")
    assert "the trunk lies in 100% of the frames, with z up" in checks(PERSON.motion(walk(30)), up="z")


def test_a_bow_in_less_than_half_of_the_frames_is_not_reported() -> None:
    assert checks(PERSON.motion(bow(80))) == ""


@pytest.mark.parametrize(
    "path", sorted((ROOT / "assets" / "motions").glob("*.bvh")), ids=lambda path: path.stem
)
def test_built_in_motions_have_no_warnings(path: Path) -> None:
    assert checks(read_motion(path)) == ""
