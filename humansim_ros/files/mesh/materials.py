"""Labels of the materials of a human's surface: skin, eyes, hair, garments and things that are worn."""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

#: Things that people wear in addition to clothes.
WornName = Literal[
    "glasses",
    "sunglasses",
    "mask",
    "cap",
    "beanie",
    "hard_hat",
    "sun_hat",
    "turban",
    "hijab",
    "backpack",
    "bag",
]
#: Names of the labels, counted from 1. 0 is no human. Numbers never change: new names come last, also those
#: of worn things.
MATERIALS = (
    "unknown",
    "skin",
    "eyes",
    "hair",
    "top",
    "bottom",
    "shoes",
    *get_args(WornName),
    "teeth",
    "tongue",
)
#: Label by name.
MATERIAL_LABELS = {name: label for label, name in enumerate(MATERIALS, 1)}
#: Label of a human's surface if its mesh has no labels.
UNKNOWN = MATERIAL_LABELS["unknown"]
#: Labels of skin and of hair. The texels decide between them.
SKIN, HAIR = MATERIAL_LABELS["skin"], MATERIAL_LABELS["hair"]


def with_hair(
    labels: NDArray[np.uint8], uv: NDArray[np.floating], hair: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """Change the label of points on a texel of hair from skin to hair.

    Args:
        labels: Labels (N,) of the triangles at the points.
        uv: (N, 2) texture coordinates of the points, v up.
        hair: (H, W) share of hair in each texel of the skin, 255 is all of it.
    """
    height, width = hair.shape
    column = np.clip((uv[:, 0] * width).astype(np.intp), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(np.intp), 0, height - 1)
    return np.where((labels == SKIN) & (hair[row, column] >= 128), np.uint8(HAIR), labels)
