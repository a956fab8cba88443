"""Images of humans for people: from all sides, in their outfits, with their bones and weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from humansim_ros.body.skeleton import side_of
from humansim_ros.camera import Camera
from humansim_ros.drawing.canvas import (
    PAPER,
    SIDE_COLORS,
    distinct_hues,
    draw_disc,
    draw_line,
    draw_text,
    hsv_colors,
    title_bar,
)
from humansim_ros.humans.human import Human
from humansim_ros.render import Body, GLRenderer, Lighting
from humansim_ros.rotations import WORLD_FROM_BODY, transform
from humansim_ros.types import Array, Image

_FOV = np.radians(24.0)


class HumanArtist:
    """Draws one human in its rest pose from any side, in images of ``size`` (width, height).

    ``shaded``: light the human; otherwise its texture is shown as it is.
    """

    def __init__(self, human: Human, size: tuple[int, int] = (260, 300), shaded: bool = True) -> None:
        self._size = size
        self._renderer = GLRenderer([], Lighting(background=PAPER, mode="lit" if shaded else "shadeless"))
        rest = human.skeleton.rest
        self._vertices = human.pose(transform(WORLD_FROM_BODY, np.zeros(3)) @ rest)
        low, high = self._vertices.min(0), self._vertices.max(0)
        self._middle = (low + high) / 2
        width, height = size
        reach = float(np.linalg.norm((high - low)[:2]))
        self._span = 1.12 * max(float(high[2] - low[2]), reach * height / width)

    def camera(self, azimuth: float) -> Camera:
        """Camera at an azimuth in degrees, from in front of the human towards its left."""
        distance = self._span / (2 * np.tan(_FOV / 2))
        angle = np.radians(azimuth)
        eye = self._middle + distance * np.array([np.cos(angle), np.sin(angle), 0.1])
        width, height = self._size
        fov = 2 * np.arctan(np.tan(_FOV / 2) * width / height)
        return Camera.look_at(tuple(eye), tuple(self._middle), self._size, float(fov))

    def draw(self, human: Human, azimuth: float) -> Image:
        """Render the human with its texture."""
        body = Body(human.mesh, self._vertices, human.triangle_parts, 1)
        view = self._renderer.render([body], self.camera(azimuth), ("rgb",))
        return view.rgb

    def draw_weights(self, human: Human, azimuth: float) -> Image:
        """Render each vertex in the colours of its bones, mixed by its weights."""
        colors = np.rint(human.weights @ bone_colors(len(human.skeleton))).astype(np.uint8)
        colored = replace(human, mesh=replace(human.mesh, texture=None, colors=colors), looks={})
        return self.draw(colored, azimuth)

    def draw_bones(self, human: Human, azimuth: float) -> Image:
        """Draw the bones over a pale body: left blue, right red."""
        image = np.asarray(255 - (255 - self.draw(human, azimuth)) * 0.35, dtype=np.uint8)
        camera, skeleton = self.camera(azimuth), human.skeleton
        heads, tails = (
            camera.project(points @ WORLD_FROM_BODY.T)[0] for points in (skeleton.heads, skeleton.tails)
        )
        for name, head, tail in zip(skeleton.names, heads, tails, strict=True):
            color = SIDE_COLORS[side_of(name)]
            draw_line(image, [head, tail], color, 2)
            draw_disc(image, head, 3, color)
        return image

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()


def bone_colors(count: int) -> Array:
    """A colour for each bone, (B, 3), 0 to 255."""
    number = np.arange(count)
    saturation, value = np.where(number % 2, 230, 150), np.where(number % 3, 240, 190)
    return hsv_colors(distinct_hues(count), saturation, value).astype(float)


def human_sheet(human: Human) -> Image:
    """Draw the human from eight sides, its bones and weights from four, and its outfits."""
    artist = HumanArtist(human)
    try:
        azimuths = range(0, 360, 45)
        turntable = [artist.draw(human, angle) for angle in azimuths]
        inside = [
            *(artist.draw_bones(human, angle) for angle in (0, 45, 90, 180)),
            *(artist.draw_weights(human, angle) for angle in (0, 45, 90, 180)),
        ]
        inside_labels = ["bones", "", "", "", "weights", "", "", ""]
        rows = [row(turntable, [f"{angle} degrees" for angle in azimuths]), row(inside, inside_labels)]
        outfits = list(human.outfits)
        for start in range(0, len(outfits) if len(outfits) > 1 else 0, 4):
            some = outfits[start : start + 4]
            images = [artist.draw(human.wearing(name), angle) for name in some for angle in (0, 180)]
            rows.append(row(images, [text for name in some for text in (name, "")]))
    finally:
        artist.close()
    stature = float(np.ptp(human.mesh.vertices[:, 1]))
    title = (
        f"{human.name}: {stature:.2f} m, {len(human.mesh.vertices)} vertices, {len(human.skeleton)} bones, "
        f"{human.skinning.replace('_', ' ')} skinning"
    )
    return titled_rows(title, rows)


def titled_rows(title: str, rows: Sequence[Image]) -> Image:
    """Rows of images below each other under a title; short ones end in the colour of paper."""
    width = max(each.shape[1] for each in rows)
    wide = [np.full((each.shape[0], width, 3), PAPER, np.uint8) for each in rows]
    for whole, each in zip(wide, rows, strict=True):
        whole[:, : each.shape[1]] = each
    return np.concatenate([title_bar(title, width), *wide])


def row(images: Sequence[Image], labels: Sequence[str]) -> Image:
    """Images side by side, each with a label in its corner."""
    for image, label in zip(images, labels, strict=True):
        draw_text(image, label, (8, 18), 0.42)
    return np.concatenate(list(images), axis=1)
