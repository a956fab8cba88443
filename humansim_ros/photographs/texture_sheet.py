"""A picture of a textured person: from all sides, the view of each triangle, texture, and gains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from humansim_ros.drawing.canvas import PAPER, distinct_hues, draw_text, hsv_colors
from humansim_ros.drawing.humans import HumanArtist, row, titled_rows
from humansim_ros.humans.human import Human
from humansim_ros.mesh.mesh import Mesh
from humansim_ros.photographs.texture_view import TexturedPerson
from humansim_ros.types import Array, Image

_AZIMUTHS = range(0, 360, 45)
#: Height of the texture in the sheet, height of a line of text, and side of a patch of colour, pixels.
_TEXTURE, _LINE, _PATCH = 420, 26, 16
#: Texels of a colour.
_TILE = 4


def draw_sheet(person: TexturedPerson) -> Image:
    """Draw a textured person from eight sides, the view of each triangle, the texture and the gains.

    Triangles that no view has seen are darker.
    """
    human = person.human
    artist = HumanArtist(human, shaded=False)
    try:
        textured = [artist.draw(human, angle) for angle in _AZIMUTHS]
        chosen = _view_colors(person)
        views = [artist.draw(chosen, angle) for angle in _AZIMUTHS]
    finally:
        artist.close()
    rows = [
        row(textured, [f"{angle} degrees" for angle in _AZIMUTHS]),
        row(views, ["view of each triangle", *[""] * (len(_AZIMUTHS) - 1)]),
    ]
    width = rows[0].shape[1]
    texture = np.zeros((1, 1, 3), np.uint8) if human.mesh.texture is None else human.mesh.texture
    factor = min(_TEXTURE / texture.shape[0], 0.6 * width / texture.shape[1])
    size = max(1, round(texture.shape[1] * factor)), max(1, round(texture.shape[0] * factor))
    small = np.asarray(cv2.resize(texture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    rows.append(_side_by_side(small, _legend(person, width - size[0])))
    seen = float(person.seen.mean())
    title = f"{human.name}: {seen:.0%} of {len(person.seen)} triangles are seen by a camera"
    rows.extend(_text_line(text, width) for text in person.notes.values())
    return titled_rows(title, rows)


def _view_colors(person: TexturedPerson) -> Human:
    """The human in the colours of the views that its triangles take."""
    mesh, count = person.human.mesh, _count(person)
    # a texture with a tile for each colour: texture coordinates are those of the middle of a tile
    palette = np.repeat(np.repeat(_palette(count)[None], _TILE, axis=0), _TILE, axis=1)
    number = np.where(person.cameras < 0, 2 * count, person.cameras + count * ~person.seen)
    uv: Array = np.stack([(np.arange(2 * count + 1) + 0.5) / (2 * count + 1), np.full(2 * count + 1, 0.5)], 1)
    padding = np.full((len(number), 1), -1)
    faces = np.hstack([mesh.triangles, padding]).astype(np.int32)
    uv_faces = np.hstack([np.repeat(number[:, None], 3, axis=1), padding]).astype(np.int32)
    return replace(person.human, mesh=Mesh(mesh.vertices, faces, uv, uv_faces, texture=palette), looks={})


def _palette(count: int) -> Image:
    """Colours (2 C + 1, 3): of each view, of its unseen triangles, and of triangles without a view."""
    hues = distinct_hues(count)
    return np.concatenate([hsv_colors(hues, 150, 235), hsv_colors(hues, 120, 120), [[60, 60, 60]]]).astype(
        np.uint8
    )


def _count(person: TexturedPerson) -> int:
    """Number of views."""
    return max(len(person.views), int(person.cameras.max()) + 1, 1)


def _legend(person: TexturedPerson, width: int) -> Image:
    """Names, colours, shares and gains of the views."""
    count = _count(person)
    names = person.views or tuple(f"view {number + 1}" for number in range(count))
    heading = "view: share of the triangles" + ("" if person.gains is None else "; gains of red, green, blue")
    legend = np.full(((count + 1) * _LINE, width, 3), PAPER, np.uint8)
    draw_text(legend, heading, (12, 18), 0.45)
    for number, (name, color) in enumerate(zip(names, _palette(count), strict=False)):
        top = (number + 1) * _LINE
        legend[top + 4 : top + 4 + _PATCH, 12 : 12 + _PATCH] = color
        text = f"{name}: {(person.cameras == number).mean():.0%}"
        if person.gains is not None:
            text += "; " + ", ".join(f"{gain:.2f}" for gain in person.gains[number])
        draw_text(legend, text, (12 + _PATCH + 8, top + 17), 0.45)
    return legend


def _side_by_side(left: Image, right: Image) -> Image:
    """Two images beside each other, aligned at the top."""
    height = max(left.shape[0], right.shape[0])
    images: Sequence[Image] = (left, right)
    padded = [np.full((height, image.shape[1], 3), PAPER, np.uint8) for image in images]
    for whole, image in zip(padded, images, strict=True):
        whole[: image.shape[0]] = image
    return np.concatenate(padded, axis=1)


def _text_line(text: str, width: int) -> Image:
    line = np.full((_LINE, width, 3), PAPER, np.uint8)
    draw_text(line, text, (12, 18), 0.45)
    return line
