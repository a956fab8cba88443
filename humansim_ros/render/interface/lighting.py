"""Light of a scene, background colour, and tone mapping."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from humansim_ros.types import Array, LinearColor

#: Name of a renderer in scene files.
RendererName = Literal["moderngl", "pyrender"]


@dataclass(frozen=True)
class Lighting:
    """Light of a scene. Colours are linear light, directions are in ``map``.

    Attributes:
        sun: Direction to the sun, (3,); any length.
        sun_color: Direct light that arrives on a surface that faces the sun.
        sky_color: Ambient light that arrives on a surface that faces up.
        ground_color: Ambient light that arrives on a surface that faces down.
        background: Colour where nothing is, sRGB, 0 to 255.
        mode: ``shadeless`` renders colours without light.
        strength: Factor of all light.
        shadows: ``contact``: a dark patch on the floor z = 0 under each body. ``soft``: shadows of the sun on
            all surfaces.
        sun_size_deg: Angular size of the sun: the larger it is, the softer the shadows.
        tone_mapping: With ``filmic``, bright colours fade to white.
        exposure: Number of stops. One stop doubles the brightness.
        materials: Whether humans have the reflectance of skin and cloth. If False, all surfaces are matt.
        ambient_occlusion: Whether surfaces nearby block ambient light.
        shadow_catcher: Whether shadows fall on the ground z = 0 even where the scene has no floor. There they
            darken the backdrop.

    Example:
        >>> Lighting(exposure=1.0).brightness((0.5, 0.25, 1.0))
        (1.0, 0.5, 2.0)
    """

    sun: LinearColor = (0.45, 0.3, 0.84)
    sun_color: LinearColor = (0.78, 0.74, 0.68)
    sky_color: LinearColor = (0.80, 0.82, 0.86)
    ground_color: LinearColor = (0.46, 0.43, 0.39)
    background: tuple[int, int, int] = (168, 176, 184)
    mode: Literal["lit", "shadeless"] = "lit"
    strength: float = 1.0
    shadows: Literal["contact", "soft", "none"] = "contact"
    sun_size_deg: float = 3.0
    tone_mapping: Literal["none", "filmic"] = "none"
    exposure: float = 0.0
    materials: bool = True
    ambient_occlusion: bool = True
    shadow_catcher: bool = False

    @property
    def shadow(self) -> Literal["contact", "soft", "none"]:
        """Kind of the rendered shadows. It is ``none`` in shadeless mode."""
        return "none" if self.mode == "shadeless" else self.shadows

    @property
    def direction(self) -> Array:
        """(3,) unit vector to the sun."""
        return np.array(self.sun) / np.linalg.norm(self.sun)

    def on_ground(self, visibility: NDArray[np.floating]) -> Array:
        """(..., 3) light on horizontal ground, relative to the light without shadow. ``visibility``: (...)
        visible share of the sun."""
        sun = np.array(self.sun_color) * max(float(self.direction[2]), 0.0)
        sky = np.array(self.sky_color)
        return np.asarray((sky + sun * np.asarray(visibility)[..., None]) / np.maximum(sky + sun, 1e-9))

    def brightness(self, color: LinearColor) -> LinearColor:
        """Multiply a colour (linear light) by strength and exposure."""
        factor = self.strength * 2.0**self.exposure
        return (color[0] * factor, color[1] * factor, color[2] * factor)


def tone_mapped(radiance: NDArray[np.floating], lighting: Lighting) -> NDArray[np.uint8]:
    """Convert linear light (..., 3) to uint8 sRGB as the shaders do. The steps are exposure, tone mapping,
    and a square root for the sRGB curve."""
    light = np.maximum(np.asarray(radiance, dtype=np.float32), 0) * np.float32(2.0**lighting.exposure)
    if lighting.tone_mapping == "filmic":
        light = filmic(light)
    return np.asarray(np.rint(255 * np.sqrt(np.clip(light, 0, 1))), dtype=np.uint8)


def filmic(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Apply a fit of the ACES film curve to linear light [Narkowicz 2015]."""
    x = np.minimum(light, np.float32(1e4))
    return np.asarray((x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14), dtype=np.float32)
