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

_HIPS = {"l_hip": 0.5, "r_hip": 0.5}
_SHOULDERS = {"l_shoulder": 0.5, "r_shoulder": 0.5}
#: Shares of joints in each point between joints.
MIXES: Mapping[str, Mapping[str, float]] = {
    "mid_hip": _HIPS,
    "mid_shoulder": _SHOULDERS,
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
