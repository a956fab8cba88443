"""Materials: how a surface reflects light, as in glTF 2.0."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from humansim_ros.errors import warn_about
from humansim_ros.types import Image


@dataclass(frozen=True, eq=False)
class Material:
    """A glTF 2.0 metallic-roughness material. Its images use the texture coordinates of the mesh.

    ``metallic``, ``roughness``: 0 to 1; multiplied by the blue and green channels of ``metal_rough``
    (H, W, 3). ``specular``: (3,) linear reflectance at normal incidence (F0) of non-metals. ``normals``:
    (H, W, 3) normal map, +y up in the image; its x and y are multiplied by ``normal_scale``. ``emission``:
    (3,) emitted linear light, multiplied by ``emissive_map`` (H, W, 3), sRGB. ``alpha``: ``mask`` discards
    pixels less opaque than ``cutoff``. ``opacity`` is multiplied by ``alpha_map`` (H, W). ``double_sided``:
    back faces are visible. ``wrap``: whether images repeat along u and v.
    """

    metallic: float = 0.0
    roughness: float = 1.0
    metal_rough: Image | None = None
    specular: tuple[float, float, float] = (0.04, 0.04, 0.04)
    normals: Image | None = None
    normal_scale: float = 1.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    emissive_map: Image | None = None
    alpha: Literal["opaque", "mask", "blend"] = "opaque"
    cutoff: float = 0.5
    opacity: float = 1.0
    alpha_map: Image | None = None
    double_sided: bool = True
    wrap: tuple[bool, bool] = (True, True)


def height_to_normal_map(heights: Image, strength: float) -> Image:
    """Make a normal map (H, W, 3) from a height map (H, W), which repeats.

    ``strength``: height of value 255 in texels.
    """
    height = heights.astype(np.float32) * (strength / 255)
    x = (np.roll(height, 1, axis=1) - np.roll(height, -1, axis=1)) / 2
    y = (np.roll(height, -1, axis=0) - np.roll(height, 1, axis=0)) / 2
    normal = np.stack([x, y, np.ones_like(x)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.asarray(np.rint(127.5 * (normal + 1)), dtype=np.uint8)


def without_maps(material: Material | None, path: str, name: str) -> Material | None:
    """Remove the images of a material, with a warning: its mesh has no texture coordinates."""
    if material is None:
        return None
    images = {
        "metal_rough": "metal and roughness",
        "normals": "normal map",
        "emissive_map": "emission",
        "alpha_map": "alpha map",
    }
    for what in (what for key, what in images.items() if getattr(material, key) is not None):
        warn_about(path, f"material {name!r}: the {what} is ignored: the mesh has no texture coordinates")
    emission = (0.0, 0.0, 0.0) if material.emissive_map is not None else material.emission
    return replace(
        material, metal_rough=None, normals=None, emissive_map=None, alpha_map=None, emission=emission
    )
