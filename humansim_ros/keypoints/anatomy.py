"""Anatomical points of the body that are no joints of the skeleton: on the skin, and between joints.

Points of the skin are in ``config/body_landmarks.json``, which ``tools/assets/find_landmarks.py`` writes:
for each one its texture coordinates on the bodies that we make, and its triangle in MakeHuman's base mesh.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from dataclasses import dataclass

from humansim_ros.resources import resource_path


def _between(first: Mapping[str, float], second: Mapping[str, float], share: float) -> dict[str, float]:
    """Point between two points, ``share`` of the way to the second."""
    joints = dict.fromkeys((*first, *second), 0.0)
    for point, part in ((first, 1 - share), (second, share)):
        for joint, weight in point.items():
            joints[joint] += part * weight
    return joints


_HIPS: Mapping[str, float] = {"l_hip": 0.5, "r_hip": 0.5}
_SHOULDERS: Mapping[str, float] = {"l_shoulder": 0.5, "r_shoulder": 0.5}
_NECK: Mapping[str, float] = {"vt3": 1.0}
_CROWN: Mapping[str, float] = {"vt3_end": 1.0}
_NECK_BASE = _between(_SHOULDERS, _NECK, 0.5)


def _of_side(side: str) -> dict[str, Mapping[str, float]]:
    def joint(name: str) -> dict[str, float]:
        return {f"{side}_{name}": 1.0}

    return {
        f"{side}_collar": _between(joint("sternoclavicular"), joint("shoulder"), 0.35),
        f"{side}_palm": _between(joint("wrist"), joint("wrist_end"), 0.35),
        f"{side}_foot_ball": _between(joint("ankle"), joint("ankle_end"), 0.6),
    }


#: Shares of joints in each point between joints. Those of SMPL are the shares of its mean body between hips
#: and neck; the middle of the skull is that of the skeleton of Human3.6M.
MIXES: Mapping[str, Mapping[str, float]] = {
    "mid_hip": _HIPS,
    "mid_shoulder": _SHOULDERS,
    "neck_base": _NECK_BASE,
    "spine_middle": _between(_HIPS, _NECK_BASE, 0.5),
    "skull_middle": _between(_NECK, _CROWN, 0.5),
    "pelvis": _between(_HIPS, _NECK, 0.15),
    "spine_1": _between(_HIPS, _NECK, 0.33),
    "spine_2": _between(_HIPS, _NECK, 0.55),
    "spine_3": _between(_HIPS, _NECK, 0.64),
    "head_joint": _between(_NECK, _CROWN, 0.3),
    **_of_side("l"),
    **_of_side("r"),
}


@dataclass(frozen=True)
class SkinPoint:
    """A point of the skin.

    Attributes:
        uv: Texture coordinates (u, v), v up, on bodies that :mod:`humansim_ros.humans.makehuman` makes.
        vertices: Corners of its triangle in MakeHuman's base mesh; eyes are after the skin.
        weights: Barycentric weights of the corners.
    """

    uv: tuple[float, float]
    vertices: tuple[int, int, int]
    weights: tuple[float, float, float]


@functools.cache
def skin_points() -> Mapping[str, SkinPoint]:
    """All points of the skin by name."""
    rows = json.loads(resource_path("config/body_landmarks.json").read_text("utf-8"))
    return {
        name: SkinPoint(tuple(row["uv"]), tuple(row["vertices"]), tuple(row["weights"]))
        for name, row in rows.items()
    }
