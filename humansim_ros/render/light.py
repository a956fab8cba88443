"""How a scene is lit, and what is behind everything: plain data that renderers are given."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render.detail import ray_grid
from humansim_ros.rotations import Array

Color = tuple[float, float, float]
#: Texels of the blend from one side of a panorama to the other, which are neighbours.
_WRAP = 2


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

    sun: Color = (0.45, 0.3, 0.84)
    sun_color: Color = (0.78, 0.74, 0.68)
    sky_color: Color = (0.80, 0.82, 0.86)
    ground_color: Color = (0.46, 0.43, 0.39)
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

    def brightness(self, color: Color) -> Color:
        """Linear light of that colour that reaches a picture."""
        factor = self.strength * 2.0**self.exposure
        return (color[0] * factor, color[1] * factor, color[2] * factor)


def developed(radiance: NDArray[np.floating], lighting: Lighting) -> NDArray[np.uint8]:
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


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph ``image`` (H, W, 3) uint8 behind the scene, as large as to cover the camera's image."""

    image: NDArray[np.uint8]

    def picture(self, camera: Camera) -> NDArray[np.uint8]:
        (width, height), (h, w) = camera.size, self.image.shape[:2]
        scale = max(width / w, height / h)
        # the part of the photograph that shows, in its middle
        part_w, part_h = min(w, max(1, round(width / scale))), min(h, max(1, round(height / scale)))
        x, y = (w - part_w) // 2, (h - part_h) // 2
        part = self.image[y : y + part_h, x : x + part_w]
        how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
        return np.asarray(cv2.resize(part, camera.size, interpolation=how), dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class Panorama:
    """Surroundings endlessly far away: ``image`` (H, W, 3) uint8 sRGB, equirectangular. Its middle is in
    direction +x of ``map``, turned to the left by ``yaw`` radians, its first row straight up.
    """

    image: NDArray[np.uint8]
    yaw: float = 0.0

    @cached_property
    def _wrapped(self) -> NDArray[np.uint8]:
        """The same with its sides repeated beside it, so that they are blended with each other."""
        return np.pad(self.image, ((0, 0), (_WRAP, _WRAP), (0, 0)), mode="wrap")

    def picture(self, camera: Camera) -> NDArray[np.uint8]:
        height, width = self.image.shape[:2]
        with np.errstate(invalid="ignore"):  # where the lens is dark
            x, y, z = np.moveaxis(ray_grid(camera) @ camera.R, -1, 0)
            left = np.arctan2(y, x) - self.yaw
            up = np.arctan2(z, np.hypot(x, y))
        column = np.mod(0.5 - left / (2 * np.pi), 1.0) * width - 0.5 + _WRAP
        row = np.clip((0.5 - up / np.pi) * height - 0.5, 0, height - 1)
        across, down = (np.nan_to_num(axis, nan=-10.0).astype(np.float32) for axis in (column, row))
        seen = cv2.remap(self._wrapped, across, down, interpolation=cv2.INTER_LINEAR)
        return np.asarray(seen, dtype=np.uint8)


def ambient(radiance: NDArray[np.float32]) -> tuple[Color, Color]:
    """Mean colours of the upper and of the lower half of a panorama (H, W, 3) of linear light: what lights
    level ground from above, and what lights it from below.
    """
    rows = len(radiance)
    up = np.pi * (0.5 - (np.arange(rows) + 0.5) / rows)
    # of a row: its share of the sphere, and how steeply its light falls
    weight = np.cos(up) * np.abs(np.sin(up))
    means = radiance.mean(axis=1, dtype=float)
    sky, ground = (
        np.average(means[half], axis=0, weights=weight[half]).tolist() for half in (up > 0, up < 0)
    )
    return tuple(sky), tuple(ground)
