"""Draw camera rigs: the cameras from above and from the side, and how many cameras see each place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from humansim_ros.cameras.camera import Camera, Coverage, common_point
from humansim_ros.errors import CameraError
from humansim_ros.render.pictures import (
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
from humansim_ros.scene.pictures.top_view import (
    SHADE,
    Plan,
    coverage_colors,
    draw_label,
    draw_view,
    round_cell,
    view_border,
)
from humansim_ros.types import Array, Color, Image

#: Colours of the x, y and z axis of ``map``.
_AXES: tuple[Color, ...] = ((206, 52, 60), (46, 150, 70), (44, 96, 208))
#: Side of a panel, margin for the numbers along its axes, and height of the heading above it; pixels.
_SIDE, _MARGIN, _HEADING = 620, 44, 26
#: Direction that the cameras are seen from in the drawing from the side, and its field of view.
_AZIMUTH, _ELEVATION, _FOV = np.radians(-65.0), np.radians(28.0), np.radians(34.0)
#: Length of the drawn pyramid of a view, as a fraction of the size of the rig, and opacity of the pyramid.
_REACH, _OPACITY = 0.16, 0.22
#: Distance to the assumed target of cameras with optical axes that do not meet, metres.
_AHEAD = 4.0
#: A larger distance than this, metres, means a wrong unit.
_FARTHEST = 1e5
#: Pixels between two tested positions of a coverage image.
_STEP = 2


def rig_image(cameras: Mapping[str, Camera], points: Array | None = None) -> Image:
    """Draw cameras from above and from the side, with their names, their views and the floor in metres.

    ``points``: points (N, 3) in ``map`` that are drawn as crosses, such as floor points.

    Raises:
        CameraError: There is no camera, or one is farther away than 100 km.
    """
    rig = _Rig.of(cameras)
    title = f"{len(cameras)} camera{'s' if len(cameras) > 1 else ''}, metres in map"
    crosses = np.zeros((0, 3)) if points is None else points
    from_side, cell = _from_side(rig, crosses)
    headings = ("from above", f"from the side; a square of the floor is {cell:g} m")
    return _sheet(title, headings, [_from_above(rig, crosses), from_side])


def camera_panel(camera: Camera) -> Image:
    """Draw one camera from the side, (620, 620, 3). Raises CameraError in the cases of :func:`rig_image`."""
    image, _ = _from_side(_Rig.of({"camera": camera}), np.zeros((0, 3)))
    return image


def coverage_image(
    cameras: Mapping[str, Camera],
    chest: float = 1.2,
    stature: float = 1.8,
    area: tuple[float, float, float, float] | None = None,
) -> Image:
    """Draw the number of cameras that see the chest of a standing person, and the number that see all of the
    person.

    Args:
        cameras: Cameras by name.
        chest: Height of the chest above the floor, metres.
        stature: Height of the person, metres.
        area: x, y of two corners of the floor, metres in ``map``. If None, the surroundings of the rig.

    Raises:
        CameraError: There is no camera, one is farther away than 100 km, or the area is empty.
    """
    rig = _Rig.of(cameras)
    low, high = (rig.low[:2], rig.high[:2]) if area is None else _corners(area)
    plan = Plan.fitting(low, high, (_SIDE, _SIDE), _MARGIN)
    x, y = plan.positions(_STEP)
    if area is not None:
        x, y = x[(x > low[0]) & (x < high[0])], y[(y > low[1]) & (y < high[1])]
    headings = (f"a point {chest:g} m over the floor", f"all from the floor to {stature:g} m")
    panels = [
        _coverage_panel(rig, plan, Coverage.of(cameras, x, y, chest)),
        _coverage_panel(rig, plan, Coverage.of(cameras, x, y, 0.0, stature)),
    ]
    return _sheet("How many cameras see what is there, if nothing is in the way", headings, panels)


@dataclass(frozen=True)
class _Rig:
    """What is drawn of cameras: borders (B, 3) of their views in ``map``, colours, and bounds of the
    drawing."""

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
        borders = [view_border(camera, reach) for camera in cameras.values()]
        points = np.vstack([points, *borders])
        near = bool((np.abs(focus) < 2 * extent).all())
        points = np.vstack([points, np.zeros(3)]) if near else points
        return cls(cameras, borders, _colors(len(cameras)), points.min(0), points.max(0), near)


def _from_above(rig: _Rig, points: Array) -> Image:
    image = np.full((_SIDE, _SIDE, 3), PAPER, np.uint8)
    plan = Plan.fitting(rig.low[:2], rig.high[:2], (_SIDE, _SIDE), _MARGIN)
    plan.draw_axes(image)
    for border, color in zip(rig.borders, rig.colors, strict=True):
        fill_polygon(image, plan.pixels(border), color, _OPACITY)
    _draw_map_axes(image, rig, "xy", plan.pixels)
    _draw_crosses(image, plan.pixels(points))
    plan.draw_cameras(image, rig.cameras, rig.borders, rig.colors)
    return image


def _draw_crosses(image: Image, pixels: Array) -> None:
    for pixel in pixels:
        for arm in ((5, 5), (5, -5)):
            draw_line(image, [pixel - arm, pixel + arm], INK, 2)


def _draw_names(image: Image, names: Sequence[str], pixels: Array, depth: Array) -> None:
    """Draw names above pixels (N, 2) at depths (N,). A name that overlaps a nearer name is left out."""
    drawn: list[Array] = []
    for number in np.argsort(depth):
        width, height = text_size(names[number], 0.4)
        position = pixels[number] - np.array([0, 9])
        if all((np.abs(position - other) > (width, height + 2)).any() for other in drawn):
            drawn.append(position)
            draw_label(image, names[number], position, 0.4, anchor="middle", boxed=True)


def _draw_map_axes(image: Image, rig: _Rig, axes: str, project: Callable[[Array], Array]) -> None:
    """Draw axes of ``map``, such as ``xy``. ``project``: function of points (2, 3) that returns pixels."""
    size = round_cell(float((rig.high - rig.low)[:2].max()))
    for axis, name in enumerate(axes if rig.near_origin else ""):
        ends = np.zeros((2, 3))
        ends[1, axis] = size
        pixels = project(ends)
        draw_line(image, pixels, _AXES[axis], 2)
        draw_label(image, name, pixels[1] + np.array([5, -5]), 0.45, _AXES[axis])


def _from_side(rig: _Rig, points: Array) -> tuple[Image, float]:
    """Draw the cameras from the side. Returns the image, and the size of a square of the floor in metres."""
    image = np.full((_SIDE, _SIDE, 3), PAPER, np.uint8)
    cell = round_cell(float((rig.high - rig.low)[:2].max()))
    start, stop = np.floor(rig.low[:2] / cell), np.ceil(rig.high[:2] / cell)
    centers = np.array([camera.center for camera in rig.cameras.values()])
    floor = np.array([[x * cell, y * cell, 0.0] for x in (start[0], stop[0]) for y in (start[1], stop[1])])
    eye = _eye(np.vstack([centers, floor, *rig.borders]))
    for axis in (0, 1):
        for step in np.arange(start[axis], stop[axis] + 1):
            ends = np.zeros((2, 3))
            ends[:, axis] = step * cell
            ends[:, 1 - axis] = start[1 - axis] * cell, stop[1 - axis] * cell
            draw_line(image, eye.project(ends)[0], SHADE if step == 0 else GRID)
    _draw_map_axes(image, rig, "xyz", lambda ends: eye.project(ends)[0])
    _draw_crosses(image, eye.project(points)[0])
    names = list(rig.cameras)
    for number in np.argsort(-eye.project(centers)[1]):
        color, center = rig.colors[number], centers[number]
        border = eye.project(rig.borders[number])[0]
        pixel, foot = eye.project(np.array([center, [center[0], center[1], 0.0]]))[0]
        draw_line(image, [foot, pixel], SHADE)
        draw_disc(image, foot, 2, SHADE)
        fill_polygon(image, border, color, _OPACITY)
        draw_view(image, pixel, border, color)
    _draw_names(image, names, *eye.project(centers))
    return image, cell


def _coverage_panel(rig: _Rig, plan: Plan, covered: Coverage) -> Image:
    image = np.full((_SIDE, _SIDE, 3), PAPER, np.uint8)
    most = max(1, int(covered.counts.max()))
    levels, colors, color_of_count = coverage_colors(most)
    plan.draw_field(image, covered.x, covered.y, color_of_count[covered.counts], _STEP)
    plan.draw_axes(image)
    plan.draw_cameras(image, rig.cameras, rig.borders, [INK] * len(rig.colors))
    legend = np.full((_SIDE, 150, 3), PAPER, np.uint8)
    draw_text(legend, "cameras", (14, 20), 0.42)
    draw_label(legend, "m2", (138, 20), 0.42, anchor="right")
    for number, ((least, last), color) in enumerate(zip(levels, colors, strict=True)):
        y = 34 + 22 * number
        cv2.rectangle(legend, (14, y), (34, y + 16), color, -1)
        label = f"{least}" if least == last else f"{least}-{last}"
        draw_text(legend, label, (42, y + 13), 0.42)
        draw_label(legend, f"{covered.area(least, last):.1f}", (138, y + 13), 0.42, anchor="right")
    return np.concatenate([image, legend], axis=1)


def _focus(cameras: Sequence[Camera], centers: Array) -> Array:
    """Point (3,) nearest to all optical axes. If the axes do not meet, a point in front of the cameras."""
    point = common_point(cameras)
    extent = max(float(np.ptp(centers, axis=0).max()), 1.0)
    if point is not None and (np.abs(point - centers.mean(0)) < 3 * extent).all():
        return point
    axes = np.array([camera.R[2] for camera in cameras])
    return np.asarray(centers.mean(0) + _AHEAD * axes.mean(0), dtype=float)


def _eye(points: Array) -> Camera:
    """Place the camera of the drawing obliquely above, as near as possible with all points (N, 3) in view."""
    middle = (points.min(0) + points.max(0)) / 2
    ahead = np.array([np.cos(_AZIMUTH), np.sin(_AZIMUTH)]) * np.cos(_ELEVATION)
    toward = np.array([*ahead, np.sin(_ELEVATION)])
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


def _colors(count: int) -> list[Color]:
    number = np.arange(count)
    colors = hsv_colors(number * 180 // max(count, 6), 190, np.where(number % 2, 150, 195))
    return [(int(r), int(g), int(b)) for r, g, b in colors]


def _sheet(title: str, headings: Sequence[str], panels: Sequence[Image]) -> Image:
    """Join panels side by side, with a heading above each and a title above all."""
    columns = []
    for text, panel in zip(headings, panels, strict=True):
        heading = np.full((_HEADING, panel.shape[1], 3), PAPER, np.uint8)
        draw_text(heading, text, (_MARGIN, 19), 0.45)
        columns.append(np.concatenate([heading, panel]))
    body = np.concatenate(columns, axis=1)
    return np.concatenate([title_bar(title, body.shape[1]), body])
