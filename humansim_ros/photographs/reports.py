"""Draw pictures that show a fit, or a texture from photographs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.files.mesh import Mesh, padded
from humansim_ros.motion.body import side_of
from humansim_ros.people.humans import Human
from humansim_ros.photographs.person_fit import PersonFit
from humansim_ros.photographs.silhouettes import Faces, intersection_over_union, render_faces
from humansim_ros.photographs.surface import TexturedPerson
from humansim_ros.photographs.views import Photo, PhotoSet, exchanged_back
from humansim_ros.render.pictures import (
    BRIGHT_SIDE_COLORS,
    GRID,
    INK,
    PAPER,
    distinct_hues,
    draw_disc,
    draw_line,
    draw_text,
    hsv_colors,
    row,
    text_size,
    title_bar,
    titled_rows,
)
from humansim_ros.types import Array, Color, Image

#: Colours of the body before and after a step of the fit, of given points, and of points that are left out.
_BEFORE: Color = (255, 150, 40)
_AFTER: Color = (0, 225, 255)
_POINT: Color = (255, 255, 255)
_WRONG: Color = (235, 40, 50)
#: Colours of the bars, on a light background.
_BAR_BEFORE: Color = (240, 170, 90)
_BAR_AFTER: Color = (30, 130, 185)
#: Width and height of a photograph in the picture, pixels; distance between them.
_TILE, _GAP = (318, 470), 8
#: Most photographs in a row, and most frames of a sequence that are drawn.
_COLUMNS, _FRAMES = 5, 3
#: Margin around the person, as a share of its size.
_MARGIN = 0.08
#: How much of the colour and of the brightness of a photograph remains below the drawing.
_COLOUR, _BRIGHTNESS = 0.5, 0.8
#: Height of the row of a keypoint, pixels; and number of rows in one column.
_ROW, _ROWS = 21, 13
_CAPTION = 28
#: If keypoints are worse than before by more than this, pixels, the picture says why.
_WORSE = 0.2
#: Least width of the picture, pixels, so that titles and two columns of bars have room.
_LEAST_WIDTH = 1080
_AZIMUTHS = range(0, 360, 45)
#: Pixels in the sheet: height of the texture, height of a line of text, and side of a patch of colour.
_TEXTURE, _LINE, _PATCH = 420, 26, 16
#: Side of the tile of one colour in the texture, texels.
_PANEL = 4


def draw_report(fit: PersonFit, photos: PhotoSet, before: PersonFit | None = None) -> Image:
    """Draw a fit over its photographs, and the distances between given and fitted keypoints. ``photos``: the
    photographs. A view without an image has a grey background. ``before``: the same person before a step of
    the fit, to compare with.

    Returns:
        Image (H, W, 3): rows of views, then bars. For a sequence, the rows show the first, middle and last
        frame.

    Raises:
        PhotographError: An image or mask cannot be read, or has another size than its camera's images.
    """
    count = len(photos.frames)
    frames = sorted({0, (count - 1) // 2, count - 1})[:_FRAMES]
    overlaps = list[tuple[float, float]]()
    rows = []
    for frame in frames:
        tiles, own = _frame_tiles(fit, photos, before, frame)
        overlaps += own
        columns = -(-len(tiles) // -(-len(tiles) // _COLUMNS))
        rows += [_join(tiles[first : first + columns], columns) for first in range(0, len(tiles), columns)]
    width = max(rows[0].shape[1], _LEAST_WIDTH)
    bars = _residual_bars(fit, before, photos, width)
    parts = [title_bar(_title(fit, overlaps, before is not None), width), _legend(width, before is not None)]
    parts += [_bar(text, width, (12, 19), 0.5, _WRONG, (255, 255, 255)) for text in _notes(fit, before)]
    parts += [
        *rows,
        title_bar("Distance of the given from the fitted keypoints, pixels (median)", width),
        bars,
    ]
    wide = (((0, 0), (0, max(width - part.shape[1], 0)), (0, 0)) for part in parts)
    return np.concatenate(
        [np.pad(part, more, constant_values=PAPER[0]) for part, more in zip(parts, wide, strict=True)]
    )


@dataclass(frozen=True, eq=False)
class _Tile:
    """The part of a photograph around the person, scaled for the picture."""

    image: Image
    corner: Array
    scale: float

    def pixels(self, points: NDArray[np.floating]) -> Array:
        """Convert pixels (N, 2) of the photograph to pixels (N, 2) of the tile."""
        return np.asarray((points - self.corner + 0.5) * self.scale - 0.5)


def _frame_tiles(
    fit: PersonFit, photos: PhotoSet, before: PersonFit | None, frame: int
) -> tuple[list[Image], list[tuple[float, float]]]:
    """Draw the views of a frame. Returns the tiles, and for each view with a mask the IoU of mask and body
    before and after the step."""
    after_faces = render_faces(fit, photos, frame)
    before_faces = None if before is None else render_faces(before, photos, frame)
    tiles, overlaps = [], []
    corrected = exchanged_back(photos.points[frame], fit.swapped[frame], photos.keypoints)
    for view, photo in enumerate(photos.frames[frame]):
        faces = [after_faces[view]] if before_faces is None else [before_faces[view], after_faces[view]]
        points = corrected[view]
        tile = _cut(photo, faces, points[(points[:, 2] > 0) & ~fit.outliers[frame, view], :2])
        if before is not None and before_faces is not None:
            _draw_body(tile, before, frame, photo, before_faces[view], first=True)
        _draw_body(tile, fit, frame, photo, after_faces[view], first=False)
        _draw_points(tile, points, fit.outliers[frame, view])
        caption = photo.name if len(photos.frames) == 1 else f"{photo.name}, frame {frame}"
        used = fit.residuals[frame, view, ~fit.outliers[frame, view]]
        if np.isfinite(used).any():
            caption += f"   {np.nanmedian(used):.1f} px"
        mask = None if photo.mask_path is None else photo.mask()
        if mask is not None:
            own = [intersection_over_union(mask, face > 0) for face in faces]
            overlaps.append((own[0], own[-1]))
            caption += "   IoU " + " -> ".join(f"{value:.2f}" for value in own)
        tiles.append(np.concatenate([_bar(caption, _TILE[0], (8, 19), 0.48), tile.image]))
    return tiles, overlaps


def _cut(photo: Photo, faces: list[Faces], points: Array) -> _Tile:
    """Cut a tile around the body and its points. The colours are made pale, so that lines are easy to see."""
    width, height = photo.camera.size
    image = np.full((height, width, 3), 128, np.uint8) if photo.image_path is None else photo.image()
    found = [np.argwhere(face > 0)[:, ::-1] for face in faces]
    around = np.concatenate([*found, points])
    around = around[((around >= 0) & (around < (width, height))).all(axis=1)]
    if not len(around):
        around = np.array([[0, 0], [width - 1, height - 1]])
    low, high = around.min(axis=0).astype(float), around.max(axis=0).astype(float)
    margin = _MARGIN * (high - low).max() + 4
    size = np.array(_TILE, dtype=float)
    scale = float((size / (high - low + 2 * margin)).min())
    corner = (low + high) / 2 - size / scale / 2
    matrix = np.array([[scale, 0, -scale * corner[0]], [0, scale, -scale * corner[1]]])
    grey = image.mean(axis=2, keepdims=True)
    dull = _BRIGHTNESS * (_COLOUR * image + (1 - _COLOUR) * grey)
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    cut = cv2.warpAffine(dull.astype(np.uint8), matrix, _TILE, flags=method, borderValue=(70, 70, 70))
    return _Tile(np.ascontiguousarray(cut, dtype=np.uint8), corner, scale)


def _draw_body(tile: _Tile, fit: PersonFit, frame: int, photo: Photo, face: Faces, first: bool) -> None:
    """Draw outline and joints of a body. The body before the step has one colour, the body after it the
    colours of the sides."""
    outlines, _ = cv2.findContours((face > 0).astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    skeleton = fit.body.skeleton
    pixels = tile.pixels(photo.camera.project(fit.joints(frame))[0])
    seen = dict(zip(skeleton.joint_names, pixels, strict=True))
    for outline in outlines:
        closed = tile.pixels(np.concatenate([outline[:, 0], outline[:1, 0]]))
        draw_line(tile.image, closed, _BEFORE if first else _AFTER, 2)
    for name, parent in zip(skeleton.joint_names, skeleton.joint_parents, strict=True):
        color = BRIGHT_SIDE_COLORS[side_of(name)]
        ends = [seen[name]] if parent is None else [seen[parent], seen[name]]
        if np.isfinite(ends).all():
            draw_line(tile.image, ends, _BEFORE if first else color, 1 if first else 2)
            if not first:
                draw_disc(tile.image, seen[name], 3, color)


def _draw_points(tile: _Tile, points: Array, wrong: NDArray[np.bool_]) -> None:
    """Draw given points as white crosses. Points that are left out are red."""
    for place, bad in zip(tile.pixels(points[:, :2])[points[:, 2] > 0], wrong[points[:, 2] > 0], strict=True):
        for turn in ((4, 4), (4, -4)) if bad else ((5, 0), (0, 5)):
            ends = [place - turn, place + turn]
            draw_line(tile.image, ends, INK, 3)
            draw_line(tile.image, ends, _WRONG if bad else _POINT, 2 if bad else 1)


def _title(fit: PersonFit, overlaps: list[tuple[float, float]], compared: bool) -> str:
    stature = float(np.ptp(fit.body.mesh.vertices[:, 1]))
    used = _used(fit)
    given = int(np.isfinite(fit.residuals).sum())
    frames = f", {len(fit.root)} frames" if len(fit.root) > 1 else ""
    title = f"{stature:.2f} m tall   {len(fit.views)} views{frames}"
    if len(used):
        title += f"   keypoints {np.median(used):.1f} px, {int(fit.outliers.sum())} of {given} left out"
    if overlaps:
        first, last = np.mean(overlaps, axis=0)
        title += "   silhouettes IoU " + (f"{first:.3f} -> {last:.3f}" if compared else f"{last:.3f}")
    return title


def _used(fit: PersonFit) -> Array:
    """Distances (N,) between given and fitted points, without the points that were left out."""
    return np.asarray(fit.residuals[~fit.outliers & np.isfinite(fit.residuals)])


def _notes(fit: PersonFit, before: PersonFit | None) -> list[str]:
    """Sentences about the fit that the user must know."""
    notes = []
    if before is not None and len(_used(before)) and len(_used(fit)):
        earlier, now = np.median(_used(before)), np.median(_used(fit))
        if now > earlier + _WORSE:
            notes.append(
                f"keypoints are {now - earlier:.1f} px farther than before the silhouettes: where both "
                "disagree, the body meets between them (clothes, hair, rough masks)"
            )
    if fit.swapped.any():
        names = [fit.views[view] for view in np.flatnonzero(fit.swapped.any(axis=0))]
        notes.append("left and right of the points were exchanged in " + ", ".join(names))
    if lost := int((~np.isfinite(fit.residuals)).all(axis=(0, 1)).sum()):
        notes.append(f"{lost} keypoints are seen by no view: these parts follow from the body")
    return notes


def _legend(width: int, compared: bool) -> Image:
    """Draw the colours and their meaning."""
    bar = np.full((_CAPTION, width, 3), 255, np.uint8)
    entries: list[tuple[Color, str]] = [(_AFTER, "body"), (GRID, "given point (white)"), (_WRONG, "left out")]
    if compared:
        entries[:1] = [(_BEFORE, "before"), (_AFTER, "after")]
    x = 12
    for color, text in entries:
        draw_line(bar, [(x, 13), (x + 26, 13)], color, 4)
        draw_text(bar, text, (x + 34, 18), 0.48)
        x += 34 + text_size(text, 0.48)[0] + 28
    return bar


def _bar(
    text: str,
    width: int,
    position: tuple[int, int],
    scale: float,
    color: Color = INK,
    background: Color = PAPER,
    height: int = _CAPTION,
) -> Image:
    """Draw a bar with one line of text."""
    bar = np.full((height, width, 3), background, np.uint8)
    draw_text(bar, text, position, scale, color)
    return bar


def _join(tiles: list[Image], columns: int) -> Image:
    """Join tiles to a row with gaps. Missing tiles are left empty."""
    height = tiles[0].shape[0]
    gap = np.full((height, _GAP, 3), PAPER, np.uint8)
    empty = np.full((height, _TILE[0], 3), PAPER, np.uint8)
    parts = [tiles[0]]
    for number in range(1, columns):
        parts += [gap, tiles[number] if number < len(tiles) else empty]
    below = np.full((_GAP, sum(part.shape[1] for part in parts), 3), PAPER, np.uint8)
    return np.concatenate([np.concatenate(parts, axis=1), below])


def _residual_bars(fit: PersonFit, before: PersonFit | None, photos: PhotoSet, width: int) -> Image:
    """Draw a bar for each keypoint: its median distance over views and frames, without points that are left
    out."""
    names = photos.keypoints.names
    after = _medians(fit)
    earlier = None if before is None else _medians(before)
    known = np.concatenate([after, *([] if earlier is None else [earlier])])
    longest = float(np.nanmax(known, initial=1.0))
    blocks = -(-len(names) // _ROWS)
    rows = -(-len(names) // blocks)
    column = width // max(blocks, 2)
    image = np.full((rows * _ROW + 16, width, 3), PAPER, np.uint8)
    given, wrong = np.isfinite(fit.residuals).sum(axis=(0, 1)), fit.outliers.sum(axis=(0, 1))
    texts = [name.replace("_", " ") for name in names]
    room_for_name = max(text_size(text, 0.46)[0] for text in texts) + 24
    room = column - room_for_name - (120 if earlier is None else 210)
    for number, text in enumerate(texts):
        left, top = number // rows * column, 8 + number % rows * _ROW
        draw_text(image, text, (left + room_for_name - 8 - text_size(text, 0.46)[0], top + 14), 0.46)
        start = left + room_for_name
        if not np.isfinite(after[number]):
            reason = "all left out" if given[number] else "no view sees it"
            draw_text(image, reason, (start + 4, top + 14), 0.46, _WRONG)
            continue
        end = round(start + room * after[number] / longest)
        image[top + 3 : top + 13, start : max(end, start + 1)] = _BAR_AFTER
        label = f"{after[number]:.1f}"
        if earlier is not None and np.isfinite(earlier[number]):
            stop = round(start + room * earlier[number] / longest)
            image[top + 14 : top + 18, start : max(stop, start + 1)] = _BAR_BEFORE
            label, end = f"{label} (before {earlier[number]:.1f})", max(end, stop)
        draw_text(image, label, (end + 6, top + 14), 0.44)
        if wrong[number]:
            x = end + 14 + text_size(label, 0.44)[0]
            draw_text(image, f"{wrong[number]} of {given[number]} out", (x, top + 14), 0.44, _WRONG)
    return image


def _medians(fit: PersonFit) -> Array:
    """Median distance (K,) of each keypoint, without points that were left out. NaN if no point remains."""
    used = np.where(fit.outliers, np.nan, fit.residuals).reshape(-1, fit.residuals.shape[2]).T
    return np.array([np.nanmedian(own) if np.isfinite(own).any() else np.nan for own in used])


def draw_sheet(person: TexturedPerson, draw: Callable[[Human, float], Image]) -> Image:
    """Draw a textured person from eight sides, the view that colours each triangle, the texture and the
    gains. Triangles that no view has seen are darker.

    ``draw``: function that draws a human, unlit, from an azimuth in degrees. All its images have one size.
    """
    human, chosen = person.human, _view_colors(person)
    textured = [draw(human, angle) for angle in _AZIMUTHS]
    views = [draw(chosen, angle) for angle in _AZIMUTHS]
    rows = [
        row(textured, [f"{angle} degrees" for angle in _AZIMUTHS]),
        row(views, ["view of each triangle", *[""] * (len(_AZIMUTHS) - 1)]),
    ]
    width = rows[0].shape[1]
    texture = np.zeros((1, 1, 3), np.uint8) if human.mesh.texture is None else human.mesh.texture
    factor = min(_TEXTURE / texture.shape[0], 0.6 * width / texture.shape[1])
    size = max(1, round(texture.shape[1] * factor)), max(1, round(texture.shape[0] * factor))
    small = np.asarray(cv2.resize(texture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    sides = small, _view_legend(person, width - size[0])
    height = max(side.shape[0] for side in sides)
    rows.append(np.full((height, sum(side.shape[1] for side in sides), 3), PAPER, np.uint8))
    rows[-1][: size[1], : size[0]], rows[-1][: sides[1].shape[0], size[0] :] = sides
    seen = float(person.seen.mean())
    title = f"{human.name}: {seen:.0%} of {len(person.seen)} triangles are seen by a camera"
    rows += [_bar(text, width, (12, 18), 0.45, height=_LINE) for text in person.notes.values()]
    return titled_rows(title, rows)


def _view_colors(person: TexturedPerson) -> Human:
    """Colour each triangle of the human by the view that it takes its colour from."""
    mesh, count = person.human.mesh, _count(person)
    # the texture has a tile for each colour, and texture coordinates point at the middle of a tile
    palette = np.repeat(np.repeat(_palette(count)[None], _PANEL, axis=0), _PANEL, axis=1)
    number = np.where(person.cameras < 0, 2 * count, person.cameras + count * ~person.seen)
    uv: Array = np.stack([(np.arange(2 * count + 1) + 0.5) / (2 * count + 1), np.full(2 * count + 1, 0.5)], 1)
    faces, uv_faces = padded(mesh.triangles), padded(np.repeat(number[:, None], 3, axis=1))
    return replace(person.human, mesh=Mesh(mesh.vertices, faces, uv, uv_faces, texture=palette), looks={})


def _palette(count: int) -> Image:
    """Colours (2 C + 1, 3): one for each view, one for the unseen triangles of each view, and one for
    triangles without a view."""
    hues = distinct_hues(count)
    return np.concatenate([hsv_colors(hues, 150, 235), hsv_colors(hues, 120, 120), [[60, 60, 60]]]).astype(
        np.uint8
    )


def _count(person: TexturedPerson) -> int:
    return max(len(person.views), int(person.cameras.max()) + 1, 1)


def _view_legend(person: TexturedPerson, width: int) -> Image:
    """Draw the names of the views with their colours, shares of the triangles, and gains."""
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
