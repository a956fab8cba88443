"""How a scene is lit, and what is behind everything: plain data that renderers are given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from humansim_ros.types import Array, LinearColor


@dataclass(frozen=True)
class Lighting:
    """Linear-light colours and the direction to the sun, ``map`` frame.

    ``mode``: shadeless shows colours as they are. ``strength``: times all light. ``shadows``: contact is a
    soft dark patch on the floor z = 0 under each body; soft is the shadow that the sun casts on everything,
    the blurrier the larger the sun appears, ``sun_size_deg``. ``tone_mapping``: filmic lets bright colours
    fade to white. ``exposure``: in stops, one is twice as bright. ``materials``: skin and cloth of people
    answer light as such; all is matt otherwise. ``ambient_occlusion``: light from around does not reach where
    something stands before it. ``shadow_catcher``: the ground z = 0 takes shadows where nothing is, as if
    the picture behind it showed it. ``background``: sRGB, where nothing is.
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
        """The shadows that are drawn: none where nothing is lit."""
        return "none" if self.mode == "shadeless" else self.shadows

    @property
    def direction(self) -> Array:
        """(3,) unit vector to the sun."""
        return np.array(self.sun) / np.linalg.norm(self.sun)

    def on_ground(self, left: NDArray[np.floating]) -> Array:
        """(..., 3) light of level ground that ``left`` (...) of the sun reaches, as a share of all of it."""
        sun = np.array(self.sun_color) * max(float(self.direction[2]), 0.0)
        sky = np.array(self.sky_color)
        return np.asarray((sky + sun * np.asarray(left)[..., None]) / np.maximum(sky + sun, 1e-9))

    def brightness(self, color: LinearColor) -> LinearColor:
        """Linear light of that colour that reaches a picture."""
        factor = self.strength * 2.0**self.exposure
        return (color[0] * factor, color[1] * factor, color[2] * factor)


def tone_mapped(radiance: NDArray[np.floating], lighting: Lighting) -> NDArray[np.uint8]:
    """(..., 3) uint8 sRGB of linear light as the shader makes it: exposure, tone mapping, and a square root
    for the sRGB curve.
    """
    light = np.maximum(np.asarray(radiance, dtype=np.float32), 0) * np.float32(2.0**lighting.exposure)
    if lighting.tone_mapping == "filmic":
        light = filmic(light)
    return np.asarray(np.rint(255 * np.sqrt(np.clip(light, 0, 1))), dtype=np.uint8)


def filmic(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """The ACES film curve as fitted by K. Narkowicz (2015), for linear light."""
    x = np.minimum(light, np.float32(1e4))
    return np.asarray((x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14), dtype=np.float32)
