"""Images of camera rigs for people: the cameras from above and from the side, and their coverage."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.camera.coverage import Coverage, coverage
from humansim_ros.camera.placement import common_point
from humansim_ros.drawing.canvas import (
    GRID,
    INK,
    PAPER,
    draw_disc,
    draw_line,
    draw_text,
    fill_polygon,
    hsv_colors,
    text_size,
    title_bar,
)
from humansim_ros.errors import CameraError
from humansim_ros.types import Array, Color, Image

#: Grid lines through the origin, and lines from cameras down to the floor.
_SHADE: Color = (168, 172, 180)
#: Colours of the x, y and z axis of map.
_AXES: tuple[Color, ...] = ((206, 52, 60), (46, 150, 70), (44, 96, 208))
#: Side of a panel, margin for the numbers along its axes, and height of the heading above it; pixels.
_SIDE, _MARGIN, _HEADING = 620, 44, 26
#: Direction from which the cameras are shown in space.
_AZIMUTH, _ELEVATION, _FOV = np.radians(-65.0), np.radians(28.0), np.radians(34.0)
#: Length of a drawn view, as a fraction of the rig's extent, and its opacity.
_REACH, _OPACITY = 0.16, 0.22
#: Points along each side of a distorted image.
_BORDER_POINTS = 16
#: Distance to the assumed target of cameras whose optical axes do not meet, metres.
_AHEAD = 4.0
#: Largest distance, metres; larger ones are a wrong unit.
_FARTHEST = 1e5
#: Pixels per position of a coverage.
_STEP = 2
#: Distance in pixels below which cameras share a label.
_SHARED_LABEL = 14
#: Most steps of a legend.
_LEVELS = 10


def rig_image(cameras: Mapping[str, Camera], points: Array | None = None) -> Image:
    """Draw cameras from above and from the side, with their names, their views and the floor in metres.

    ``points``: points (N, 3) in ``map`` that are drawn as crosses, such as floor points.

    Raises:
        CameraError: There is no camera, or one is farther away than 100 km.
    """
    rig = _Rig.of(cameras)
    count = len(cameras)
    title = f"{count} camera{'s' if count > 1 else ''}, metres in map"
    crosses = np.zeros((0, 3)) if points is None else points
    from_side, cell = _from_side(rig, crosses)
    headings = ("from above", f"from the side; a square of the floor is {cell:g} m")
    return _sheet(title, headings, [_from_above(rig, crosses), from_side])


def coverage_image(
    cameras: Mapping[str, Camera],
    chest: float = 1.2,
    stature: float = 1.8,
    area: tuple[float, float, float, float] | None = None,
) -> Image:
    """Draw the number of cameras that see the chest of a standing person, and all of the person.

    Args:
        cameras: Cameras by name.
        chest: Height of the chest above the floor, metres.
        stature: Height of the person, metres.
        area: x, y of two corners of the floor, metres in ``map``; the surroundings of the rig if absent.

    Raises:
        CameraError: There is no camera, one is farther away than 100 km, or the area is empty.
    """
    rig = _Rig.of(cameras)
    low, high = (rig.low[:2], rig.high[:2]) if area is None else _corners(area)
    plan = _Plan.fitting(low, high)
    x, y = plan.positions()
    if area is not None:
        x, y = x[(x > low[0]) & (x < high[0])], y[(y > low[1]) & (y < high[1])]
    headings = (f"a point {chest:g} m over the floor", f"all from the floor to {stature:g} m")
    panels = [
        _coverage_panel(rig, plan, coverage(cameras, x, y, chest)),
        _coverage_panel(rig, plan, coverage(cameras, x, y, 0.0, stature)),
    ]
    return _sheet("How many cameras see what is there, if nothing is in the way", headings, panels)


@dataclass(frozen=True)
class _Rig:
    """Cameras, the borders of their views (B, 3) in ``map``, their colours, and the bounds of the drawing."""

    cameras: Mapping[str, Camera]
    borders: list[Array]
    colors: list[Color]
    low: Array
    high: Array
    near_origin: bool

    @classmethod
    def of(cls, cameras: Mapping[str, Camera]) -> _Rig:
        if not cameras:
            raise CameraError("there are no cameras to draw")
        centers = np.array([camera.center for camera in cameras.values()])
        if np.abs(centers).max() > _FARTHEST:
            raise CameraError("a camera is more than 100 km away: is the calibration in metres?")
        focus = _focus(list(cameras.values()), centers)
        half = 0.5 * np.linalg.norm(centers - focus, axis=1).max(initial=1.0) * np.array([1, 1, 0])
        points = np.vstack([centers, focus - half, focus + half, [*centers[0, :2], 0]])
        extent = float(np.ptp(points, axis=0).max())
        reach = _REACH * extent * min(1.0, np.sqrt(12 / len(cameras)))
        borders = [_border(camera, reach) for camera in cameras.values()]
        points = np.vstack([points, *borders])
        near = bool((np.abs(focus) < 2 * extent).all())
        points = np.vstack([points, np.zeros(3)]) if near else points
        return cls(cameras, borders, _colors(len(cameras)), points.min(0), points.max(0), near)


@dataclass(frozen=True)
class _Plan:
    """Plan view, x to the right and y up. ``corner``: x, y of its top left corner in metres; ``scale``:
    pixels per metre.
    """

    corner: Array
    scale: float

    @classmethod
    def fitting(cls, low: Array, high: Array) -> _Plan:
        extent = float((high - low).max()) * 1.2
        middle = (low + high) / 2
        return cls(middle + extent / 2 * np.array([-1, 1]), (_SIDE - _MARGIN) / extent)

    def pixels(self, points: Array) -> Array:
        """Pixels (N, 2) of points (N, 2) or (N, 3)."""
        return (points[..., :2] - self.corner) * self.scale * [1, -1] + [_MARGIN, 0]

    def positions(self) -> tuple[Array, Array]:
        """x (W,) and y (H,) of positions every _STEP pixels of the panel."""
        steps = (np.arange((_SIDE - _MARGIN) // _STEP) + 0.5) * _STEP / self.scale
        return self.corner[0] + steps, self.corner[1] - steps

    def draw_axes(self, image: Image) -> None:
        """Draw grid lines, with metres along the left and the lower edge."""
        cell = _round_cell((_SIDE - _MARGIN) / self.scale)
        extent = (_SIDE - _MARGIN) / self.scale
        for axis, start in ((0, self.corner[0]), (1, self.corner[1] - extent)):
            for step in range(int(np.ceil(start / cell)), int(np.floor((start + extent) / cell)) + 1):
                ends = np.array([self.corner, self.corner + extent * np.array([1, -1])])
                ends[:, axis] = step * cell
                pixels = self.pixels(ends)
                draw_line(image, pixels, _SHADE if step == 0 else GRID)
                label = f"{step * cell:g}"
                position = pixels[1] + np.array([0, 16]) if axis == 0 else pixels[0] + np.array([-6, 4])
                _draw_label(image, label, position, 0.36, anchor="middle" if axis == 0 else "right")


def _from_above(rig: _Rig, points: Array) -> Image:
    image = _panel()
    plan = _Plan.fitting(rig.low[:2], rig.high[:2])
    plan.draw_axes(image)
    for border, color in zip(rig.borders, rig.colors, strict=True):
        fill_polygon(image, plan.pixels(border), color, _OPACITY)
    _draw_map_axes(image, plan, rig)
    _draw_crosses(image, plan.pixels(points))
    _draw_cameras_above(image, plan, rig, rig.colors)
    return image


def _draw_crosses(image: Image, pixels: Array) -> None:
    for pixel in pixels:
        for arm in ((5, 5), (5, -5)):
            draw_line(image, [pixel - arm, pixel + arm], INK, 2)


def _draw_cameras_above(image: Image, plan: _Plan, rig: _Rig, colors: Sequence[Color]) -> None:
    labels: list[tuple[Array, Array, list[str]]] = []
    for (name, camera), border, color in zip(rig.cameras.items(), rig.borders, colors, strict=True):
        center, pixels = plan.pixels(camera.center), plan.pixels(border)
        if not ((center >= [_MARGIN, 0]) & (center < [_SIDE, _SIDE - _MARGIN])).all():
            continue
        _draw_view(image, center, pixels, color)
        near = [names for other, _, names in labels if np.linalg.norm(other - center) < _SHARED_LABEL]
        if near:
            near[0].append(name)
        else:
            labels.append((center, center - pixels.mean(0), [name]))
    for center, backward, names in labels:
        # cameras above or close to each other share a label
        text = names[0] + (f" +{len(names) - 1}" if len(names) > 1 else "")
        _draw_name(image, text, center, backward)


def _draw_view(image: Image, center: Array, border: Array, color: Color) -> None:
    """Draw a camera at a pixel (2,) and the border of its view (B, 2)."""
    for corner in border[:: max(1, len(border) // 4)]:
        draw_line(image, [center, corner], color)
    draw_line(image, np.vstack([border, border[:1]]), color)
    draw_disc(image, center, 4, color)


def _draw_names(image: Image, names: Sequence[str], pixels: Array, depth: Array) -> None:
    """Draw names above pixels (N, 2) at depths (N,), without those that overlap a nearer one."""
    drawn: list[Array] = []
    for number in np.argsort(depth):
        width, height = text_size(names[number], 0.4)
        position = pixels[number] - np.array([0, 9])
        if all((np.abs(position - other) > (width, height + 2)).any() for other in drawn):
            drawn.append(position)
            _draw_label(image, names[number], position, 0.4, anchor="middle", boxed=True)


def _draw_name(image: Image, text: str, center: Array, backward: Array) -> None:
    """Draw a camera's name behind it (in direction ``backward``), or above it where there is no room."""
    width, _ = text_size(text, 0.4)
    x, y = backward / max(float(np.linalg.norm(backward)), 1e-9)
    position = center + 12 * np.array([x, y]) + np.array([0, 4 + 4 * np.sign(y) * (abs(x) <= 0.5)])
    side = 0.0 if abs(x) <= 0.5 else np.sign(x)
    left = position[0] + width * (side - 1) / 2
    if not _MARGIN < left < image.shape[1] - width - 2:
        position, left = center - np.array([0, 9]), center[0] - width / 2
    _draw_label(image, text, (max(left, _MARGIN + 2), position[1]), 0.4, boxed=True)


def _draw_map_axes(image: Image, plan: _Plan, rig: _Rig) -> None:
    if not rig.near_origin:
        return
    size = _round_cell(float((rig.high - rig.low)[:2].max()))
    for axis in (0, 1):
        ends = np.zeros((2, 2))
        ends[1, axis] = size
        pixels = plan.pixels(ends)
        draw_line(image, pixels, _AXES[axis], 2)
        _draw_label(image, "xy"[axis], pixels[1] + np.array([5, -5]), 0.45, _AXES[axis])


def _from_side(rig: _Rig, points: Array) -> tuple[Image, float]:
    """Draw the cameras from the side; also returns the size of a square of the floor in metres."""
    image = _panel()
    cell = _round_cell(float((rig.high - rig.low)[:2].max()))
    start, stop = np.floor(rig.low[:2] / cell), np.ceil(rig.high[:2] / cell)
    centers = np.array([camera.center for camera in rig.cameras.values()])
    floor = np.array([[x * cell, y * cell, 0.0] for x in (start[0], stop[0]) for y in (start[1], stop[1])])
    eye = _eye(np.vstack([centers, floor, *rig.borders]))
    for axis in (0, 1):
        for step in np.arange(start[axis], stop[axis] + 1):
            ends = np.zeros((2, 3))
            ends[:, axis] = step * cell
            ends[:, 1 - axis] = start[1 - axis] * cell, stop[1 - axis] * cell
            draw_line(image, eye.project(ends)[0], _SHADE if step == 0 else GRID)
    for axis, color in enumerate(_AXES if rig.near_origin else ()):
        ends = np.zeros((2, 3))
        ends[1, axis] = cell
        pixels = eye.project(ends)[0]
        draw_line(image, pixels, color, 2)
        _draw_label(image, "xyz"[axis], pixels[1] + np.array([5, -5]), 0.45, color)
    _draw_crosses(image, eye.project(points)[0])
    names = list(rig.cameras)
    for number in np.argsort(-eye.project(centers)[1]):
        color, center = rig.colors[number], centers[number]
        border = eye.project(rig.borders[number])[0]
        pixel = eye.project(center[None])[0][0]
        foot = eye.project(np.array([[center[0], center[1], 0.0]]))[0][0]
        draw_line(image, [foot, pixel], _SHADE)
        draw_disc(image, foot, 2, _SHADE)
        fill_polygon(image, border, color, _OPACITY)
        _draw_view(image, pixel, border, color)
    _draw_names(image, names, *eye.project(centers))
    return image, cell


def _coverage_panel(rig: _Rig, plan: _Plan, covered: Coverage) -> Image:
    image = _panel()
    most = max(1, int(covered.counts.max()))
    step = -(-most // _LEVELS)
    levels = [(0, 0), *((least, min(least + step - 1, most)) for least in range(1, most + 1, step))]
    colors = [(214, 216, 220), *_ramp(len(levels) - 1)]
    color_of_count = np.zeros((most + 1, 3), np.uint8)
    for (least, last), color in zip(levels, colors, strict=True):
        color_of_count[least : last + 1] = color
    field = np.repeat(np.repeat(color_of_count[covered.counts], _STEP, axis=0), _STEP, axis=1)
    left, top = np.rint(plan.pixels(np.array([covered.x[0], covered.y[0]])) - _STEP / 2).astype(int)
    image[top : top + field.shape[0], left : left + field.shape[1]] = field
    plan.draw_axes(image)
    _draw_cameras_above(image, plan, rig, [INK] * len(rig.colors))
    legend = np.full((_SIDE, 150, 3), PAPER, np.uint8)
    draw_text(legend, "cameras", (14, 20), 0.42)
    _draw_label(legend, "m2", (138, 20), 0.42, anchor="right")
    for number, ((least, last), color) in enumerate(zip(levels, colors, strict=True)):
        y = 34 + 22 * number
        cv2.rectangle(legend, (14, y), (34, y + 16), color, -1)
        label = f"{least}" if least == last else f"{least}-{last}"
        draw_text(legend, label, (42, y + 13), 0.42)
        _draw_label(legend, f"{covered.area(least, last):.1f}", (138, y + 13), 0.42, anchor="right")
    return np.concatenate([image, legend], axis=1)


def _focus(cameras: Sequence[Camera], centers: Array) -> Array:
    """Point (3,) nearest to all optical axes where they meet, else a point in front of the cameras."""
    point = common_point(cameras)
    extent = max(float(np.ptp(centers, axis=0).max()), 1.0)
    if point is not None and (np.abs(point - centers.mean(0)) < 3 * extent).all():
        return point
    axes = np.array([camera.R[2] for camera in cameras])
    return np.asarray(centers.mean(0) + _AHEAD * axes.mean(0), dtype=float)


def _border(camera: Camera, reach: float) -> Array:
    """Border (B, 3) of a camera's view at a distance of ``reach`` metres, without pixels that see no ray."""
    width, height = (n - 0.5 for n in camera.size)
    along = np.linspace(0, 1, _BORDER_POINTS if camera.distorted else 1, endpoint=False)
    corners = np.array([[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]])
    following = np.roll(corners, -1, axis=0)
    pixels = corners[:, None] + along[:, None] * (following - corners)[:, None]
    rays = camera.rays(pixels.reshape(-1, 2))
    rays = rays[np.isfinite(rays).all(axis=1)]
    if len(rays) < 3:  # a fisheye whose image is a disc
        angles = np.linspace(0, 2 * np.pi, 4 * _BORDER_POINTS, endpoint=False)
        rim = camera.lens.valid_radius * np.column_stack([np.cos(angles), np.sin(angles)])
        rays = np.column_stack([rim, np.ones(len(rim))])
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(camera.center + reach * rays @ camera.R, dtype=float)


def _eye(points: Array) -> Camera:
    """Nearest camera that sees all points (N, 3) obliquely from above."""
    middle = (points.min(0) + points.max(0)) / 2
    toward = np.array(
        [
            np.cos(_AZIMUTH) * np.cos(_ELEVATION),
            np.sin(_AZIMUTH) * np.cos(_ELEVATION),
            np.sin(_ELEVATION),
        ]
    )
    distance = 2 * float(np.linalg.norm(np.ptp(points, axis=0)))

    def camera() -> Camera:
        return Camera.look_at(middle + distance * toward, middle, (_SIDE, _SIDE), float(_FOV))

    for _ in range(6):
        pixels = camera().project(points)[0]
        box = (pixels.min(0) + pixels.max(0)) / 2
        middle = camera().unproject(box[None], np.array([distance]))[0]
        distance *= float(np.abs(pixels - box).max()) / (0.46 * _SIDE)
    return camera()


def _corners(area: tuple[float, float, float, float]) -> tuple[Array, Array]:
    ends = np.array(area, dtype=float).reshape(2, 2)
    low, high = ends.min(0), ends.max(0)
    if not np.isfinite(ends).all() or (high - low).min() <= 0 or np.abs(ends).max() > _FARTHEST:
        raise CameraError("the area needs x, y of two corners, metres, apart in both", key="area")
    return low, high


def _round_cell(extent: float) -> float:
    """Size of a grid cell in metres, 1, 2 or 5 times a power of ten: 5 to 12 cells fit into the extent."""
    power = 10.0 ** np.floor(np.log10(extent / 5))
    return float(power * max(step for step in (1, 2, 5) if step * power <= extent / 5 * (1 + 1e-9)))


def _colors(count: int) -> list[Color]:
    number = np.arange(count)
    colors = hsv_colors(number * 180 // max(count, 6), 190, np.where(number % 2, 150, 195))
    return [(int(r), int(g), int(b)) for r, g, b in colors]


def _ramp(count: int) -> list[Color]:
    """Colours from dark blue to yellow."""
    values = np.rint(np.linspace(40, 255, count) if count > 1 else np.array([255.0])).astype(np.uint8)
    mapped = cv2.applyColorMap(values[None], cv2.COLORMAP_VIRIDIS)[0]
    return [(int(r), int(g), int(b)) for b, g, r in mapped]


def _panel() -> Image:
    return np.full((_SIDE, _SIDE, 3), PAPER, np.uint8)


def _sheet(title: str, headings: Sequence[str], panels: Sequence[Image]) -> Image:
    """Join panels side by side, with a heading above each and a title above all."""
    columns = []
    for text, panel in zip(headings, panels, strict=True):
        heading = np.full((_HEADING, panel.shape[1], 3), PAPER, np.uint8)
        draw_text(heading, text, (_MARGIN, 19), 0.45)
        columns.append(np.concatenate([heading, panel]))
    body = np.concatenate(columns, axis=1)
    return np.concatenate([title_bar(title, body.shape[1]), body])


def _draw_label(
    image: Image,
    text: str,
    position: Sequence[float] | Array,
    scale: float,
    color: Color = INK,
    anchor: Literal["left", "middle", "right"] = "left",
    boxed: bool = False,
) -> None:
    """Draw text inside the image. ``anchor``: the part of its lower edge that is at ``position``; ``boxed``:
    on a translucent box.
    """
    width, _ = text_size(text, scale)
    x, y = position
    x -= width * {"left": 0, "middle": 1 / 2, "right": 1}[anchor]
    x = min(max(x, 2), image.shape[1] - width - 2)
    left, bottom = round(float(x)), round(float(np.clip(y, 12, image.shape[0] - 4)))
    if boxed:
        box = image[bottom - 10 : bottom + 4, max(left - 2, 0) : left + width + 2]
        box[:] = np.rint(0.35 * box + 0.65 * np.array(PAPER))
    draw_text(image, text, (left, bottom), scale, color)
