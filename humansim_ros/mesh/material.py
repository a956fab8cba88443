"""What surfaces do with light besides their colour, as glTF 2.0 says it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import warn_of

Image = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Finish:
    """How a mesh answers light. Images lie on it as its texture does, first row on top, of any size.

    ``metallic``, ``roughness``: 0 to 1, times green (roughness) and blue (metallic) of ``metal_rough``
    (H, W, 3). ``mirrors``: (3,) what a surface that is no metal throws back straight on, linear. ``normals``:
    (H, W, 3) normal map, +y up in the image, its x and y times ``bump``. ``emission``: linear light of its
    own, times ``glow`` (H, W, 3), sRGB. ``alpha``: opaque; mask, which leaves out what is less opaque than
    ``cutoff``; blend. How opaque it is: ``opacity``, times ``cut`` (H, W). ``both_sides``: its back is seen.
    ``repeats``: whether images go on to the right and left, and up and down.
    """

    metallic: float = 0.0
    roughness: float = 1.0
    metal_rough: Image | None = None
    mirrors: tuple[float, float, float] = (0.04, 0.04, 0.04)
    normals: Image | None = None
    bump: float = 1.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    glow: Image | None = None
    alpha: Literal["opaque", "mask", "blend"] = "opaque"
    cutoff: float = 0.5
    opacity: float = 1.0
    cut: Image | None = None
    both_sides: bool = True
    repeats: tuple[bool, bool] = (True, True)


def normals_of_heights(heights: Image, strength: float) -> Image:
    """A normal map (H, W, 3) of a map of heights (H, W), ``strength`` texels high at 255; it repeats."""
    height = heights.astype(np.float32) * (strength / 255)
    x = (np.roll(height, 1, axis=1) - np.roll(height, -1, axis=1)) / 2
    y = (np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)) / 2
    normal = np.stack([x, y, np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.asarray(np.rint(127.5 * (normal + 1)), dtype=np.uint8)


def without_maps(finish: Finish | None, path: str, name: str) -> Finish | None:
    """What is left of a finish where nothing says how its images lie; what is not is told."""
    if finish is None:
        return None
    images = {
        "metal_rough": "metal and roughness",
        "normals": "normal map",
        "glow": "emission",
        "cut": "cut-out",
    }
    lost = [what for key, what in images.items() if getattr(finish, key) is not None]
    for what in lost:
        warn_of(path, f"material {name!r}: its {what} has no texture coordinates to lie on: it is not shown")
    dark = (0.0, 0.0, 0.0) if finish.glow is not None else finish.emission
    return replace(finish, metal_rough=None, normals=None, glow=None, cut=None, emission=dark)
