"""Humans as people look at them: turned round, in their outfits, their bones, their weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.skeleton import side_of
from humansim_ros.camera import Camera
from humansim_ros.humans.human import Human
from humansim_ros.render import Body, GLRenderer, Lighting
from humansim_ros.rotations import WORLD_FROM_BODY, transform
from humansim_ros.types import Array, Image

_PAPER, _INK = (238, 240, 243), (60, 64, 72)
_FOV = np.radians(24.0)
_BONE_COLORS = {1: (38, 116, 200), -1: (206, 62, 92), 0: (60, 64, 72)}
#: Golden angle of hues: neighbours in the list of bones look different.
_HUE_STEP = 0.61803398875


class HumanArtist:
    """Draws one human at rest from any side, in pictures of ``size`` (width, height)."""

    def __init__(self, human: Human, size: tuple[int, int] = (260, 300)) -> None:
        self._size = size
        self._renderer = GLRenderer([], Lighting(background=_PAPER))
        rest = human.skeleton.rest
        self._vertices = human.pose(transform(WORLD_FROM_BODY, np.zeros(3)) @ rest)
        low, high = self._vertices.min(0), self._vertices.max(0)
        self._middle = (low + high) / 2
        width, height = size
        reach = float(np.linalg.norm((high - low)[:2]))
        self._span = 1.12 * max(float(high[2] - low[2]), reach * height / width)

    def camera(self, around: float) -> Camera:
        """The camera ``around`` degrees to the person's left of straight ahead."""
        away = self._span / (2 * np.tan(_FOV / 2))
        angle = np.radians(around)
        eye = self._middle + away * np.array([np.cos(angle), np.sin(angle), 0.1])
        width, height = self._size
        fov = 2 * np.arctan(np.tan(_FOV / 2) * width / height)
        return Camera.look_at(tuple(eye), tuple(self._middle), self._size, float(fov))

    def draw(self, human: Human, around: float) -> Image:
        """The human, textured."""
        body = Body(human.mesh, self._vertices, human.triangle_parts, 1)
        view = self._renderer.render([body], self.camera(around), ("rgb",))
        assert view.rgb is not None
        return view.rgb

    def draw_weights(self, human: Human, around: float) -> Image:
        """Every vertex in the colours of the bones that it follows, mixed as its weights are."""
        colors = np.rint(human.weights @ bone_colors(len(human.skeleton))).astype(np.uint8)
        painted = replace(human, mesh=replace(human.mesh, texture=None, colors=colors), looks={})
        return self.draw(painted, around)

    def draw_bones(self, human: Human, around: float) -> Image:
        """The bones over a pale body; left blue, right red."""
        image = np.asarray(255 - (255 - self.draw(human, around)) * 0.35, dtype=np.uint8)
        camera, skeleton = self.camera(around), human.skeleton
        heads, tails = (
            _fixed(camera.project(points @ WORLD_FROM_BODY.T)[0])
            for points in (skeleton.heads, skeleton.tails)
        )
        for name, head, tail in zip(skeleton.names, heads, tails, strict=True):
            color = _BONE_COLORS[side_of(name)]
            cv2.line(image, head, tail, color, 2, cv2.LINE_AA, 4)
            cv2.circle(image, head, 3 * 16, color, -1, cv2.LINE_AA, 4)
        return image

    def close(self) -> None:
        self._renderer.close()


def bone_colors(count: int) -> NDArray[np.float64]:
    """(B, 3) a colour for each bone, 0 to 255."""
    hsv = np.zeros((1, count, 3), np.uint8)
    number = np.arange(count)
    hsv[0, :, 0] = (number * _HUE_STEP % 1 * 180).astype(np.uint8)
    hsv[0, :, 1] = np.where(number % 2, 230, 150)
    hsv[0, :, 2] = np.where(number % 3, 240, 190)
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0], dtype=float)


def human_sheet(human: Human) -> Image:
    """The human from eight sides, its bones and weights from the front and the left, its outfits."""
    artist = HumanArtist(human)
    try:
        around = [artist.draw(human, angle) for angle in range(0, 360, 45)]
        inside = [
            *(artist.draw_bones(human, angle) for angle in (0, 45, 90, 180)),
            *(artist.draw_weights(human, angle) for angle in (0, 45, 90, 180)),
        ]
        labels = [f"{angle} degrees" for angle in range(0, 360, 45)]
        inside_labels = ["bones", "", "", "", "weights", "", "", ""]
        rows = [_row(around, labels), _row(inside, inside_labels)]
        looks = list(human.outfits)
        for start in range(0, len(looks) if len(looks) > 1 else 0, 4):
            some = looks[start : start + 4]
            drawn = [artist.draw(human.wearing(name), angle) for name in some for angle in (0, 180)]
            rows.append(_row(drawn, [text for name in some for text in (name, "")]))
    finally:
        artist.close()
    width = max(row.shape[1] for row in rows)
    for number, row in enumerate(rows):
        rows[number] = np.full((row.shape[0], width, 3), _PAPER, np.uint8)
        rows[number][:, : row.shape[1]] = row
    stature = float(np.ptp(human.mesh.vertices[:, 1]))
    title = (
        f"{human.name}: {stature:.2f} m, {len(human.mesh.vertices)} vertices, {len(human.skeleton)} bones, "
        f"{human.skinning.replace('_', ' ')} skinning"
    )
    head = np.full((34, width, 3), 255, np.uint8)
    cv2.putText(head, title, (10, 23), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _INK, 1, cv2.LINE_AA)
    return np.concatenate([head, *rows])


def _row(images: Sequence[Image], labels: Sequence[str]) -> Image:
    for image, label in zip(images, labels, strict=True):
        cv2.putText(image, label, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
    return np.concatenate(list(images), axis=1)


def _fixed(pixels: Array) -> list[tuple[int, int]]:
    """In sixteenths of a pixel, OpenCV's finest."""
    return [(int(x), int(y)) for x, y in np.rint(np.clip(pixels, -1e4, 1e4) * 16)]
