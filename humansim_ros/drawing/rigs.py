"""Rigs as people look at them: the cameras from above and in space, and what they see between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from humansim_ros.camera import Camera
from humansim_ros.errors import CameraError
from humansim_ros.types import Array, Color, Image

_PAPER, _INK, _GRID, _SHADE = (238, 240, 243), (60, 64, 72), (205, 209, 215), (168, 172, 180)
#: x, y and z of map.
_AXES: tuple[Color, ...] = ((206, 52, 60), (46, 150, 70), (44, 96, 208))
_TEXT = cv2.FONT_HERSHEY_SIMPLEX
#: Pixels of a panel's side, of the title and of the margin for numbers along the axes.
_SIDE, _HEAD, _MARGIN = 620, 34, 44
#: Pixels of the line above each panel.
_ABOVE = 26
#: Where the picture in space is seen from: azimuth and elevation.
_AZIMUTH, _ELEVATION, _FOV = np.radians(-65.0), np.radians(28.0), np.radians(34.0)
#: Length of a drawn view, as a fraction of the rig's extent.
_REACH = 0.16
#: Points along the border of a distorted image.
_BORDER = 16
#: Metres in front of cameras that look in parallel where the people are taken to be.
_AHEAD = 4.0
#: Metres; what is farther apart is not in metres.
_FARTHEST = 1e5
#: Pixels per point of a coverage, and the heights of a standing person at which it is looked for.
_STEP, _HEIGHTS = 2, 7
#: Pixels from one camera to another that share a name.
_TOGETHER = 14
#: Most steps of a legend.
_LEVELS = 10


@dataclass(frozen=True)
class Coverage:
    """How many cameras see each place of a floor.

    ``x`` (W,), ``y`` (H,): places, metres in ``map``. ``counts``: (H, W) cameras.
    """

    x: Array
    y: Array
    counts: NDArray[np.intp]

    def area(self, least: int, most: int) -> float:
        """Square metres seen by ``least`` to ``most`` cameras."""
        cell = abs((self.x[1] - self.x[0]) * (self.y[1] - self.y[0]))
        return float(((self.counts >= least) & (self.counts <= most)).sum() * cell)


def coverage(
    cameras: Mapping[str, Camera], x: ArrayLike, y: ArrayLike, low: float, high: float | None = None
) -> Coverage:
    """How many cameras see the points at height ``low``; or, with ``high``, all of the upright line from
    ``low`` to ``high``: a person who stands there, from head to foot.

    ``x`` (W,), ``y`` (H,): even steps, two at least, metres in ``map``. Nothing is in the way of anything.
    """
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    if min(x.size, y.size) < 2:
        raise CameraError("a coverage needs at least two places along x and y")
    heights = [low] if high is None else np.linspace(low, high, _HEIGHTS)
    counts = np.zeros((len(y), len(x)), np.intp)
    for camera in cameras.values():
        seen = np.ones(counts.shape, bool)
        for height in heights:
            points = np.stack(np.broadcast_arrays(x[None, :], y[:, None], height), axis=-1)
            pixels, _ = camera.project(points.reshape(-1, 3))
            inside = (pixels >= -0.5) & (pixels < np.array(camera.size) - 0.5)
            seen &= inside.all(axis=1).reshape(counts.shape)
        counts += seen
    return Coverage(x, y, counts)


def rig_picture(cameras: Mapping[str, Camera]) -> Image:
    """The cameras from above and in space: what each looks at, its name, and the floor in metres.

    Raises CameraError where there is nothing to draw.
    """
    rig = _Rig.of(cameras)
    count = len(cameras)
    title = f"{count} camera{'s' if count > 1 else ''}, metres in map"
    in_space, cell = _in_space(rig)
    heads = ("from above", f"from the side; a square of the floor is {cell:g} m")
    return _sheet(title, heads, [_from_above(rig), in_space])


def coverage_picture(
    cameras: Mapping[str, Camera],
    chest: float = 1.2,
    stature: float = 1.8,
    area: tuple[float, float, float, float] | None = None,
) -> Image:
    """How many cameras see a standing person's chest (metres over the floor), and how many see all of it.

    ``area``: x, y of two corners; around the rig if absent. Raises CameraError where there is none.
    """
    rig = _Rig.of(cameras)
    low, high = (rig.low[:2], rig.high[:2]) if area is None else _corners(area)
    plan = _Plan.fitting(low, high)
    x, y = plan.places()
    if area is not None:
        x, y = x[(x > low[0]) & (x < high[0])], y[(y > low[1]) & (y < high[1])]
    heads = (f"a point {chest:g} m over the floor", f"all from the floor to {stature:g} m")
    panels = [
        _covered(rig, plan, coverage(cameras, x, y, chest)),
        _covered(rig, plan, coverage(cameras, x, y, 0.0, stature)),
    ]
    return _sheet("How many cameras see what is there, if nothing is in the way", heads, panels)


@dataclass(frozen=True)
class _Rig:
    """Cameras with what is drawn of them: (B, 3) borders of their views in the world, and the extent."""

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
        around = 0.5 * np.linalg.norm(centers - focus, axis=1).max(initial=1.0) * np.array([1, 1, 0])
        points = np.vstack([centers, focus - around, focus + around, [*centers[0, :2], 0]])
        extent = float(np.ptp(points, axis=0).max())
        reach = _REACH * extent * min(1.0, np.sqrt(12 / len(cameras)))
        borders = [_border(camera, reach) for camera in cameras.values()]
        points = np.vstack([points, *borders])
        near = bool((np.abs(focus) < 2 * extent).all())
        points = np.vstack([points, np.zeros(3)]) if near else points
        return cls(cameras, borders, _colors(len(cameras)), points.min(0), points.max(0), near)


@dataclass(frozen=True)
class _Plan:
    """A map seen from above, x to the right and y up: ``corner`` is the metres of its top left, ``scale``
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
        """(N, 2) in the panel, of points (N, 2) or (N, 3)."""
        return (points[..., :2] - self.corner) * self.scale * [1, -1] + [_MARGIN, 0]

    def places(self) -> tuple[Array, Array]:
        """x (W,) and y (H,) of the points whose squares of _STEP pixels fill the panel."""
        steps = (np.arange((_SIDE - _MARGIN) // _STEP) + 0.5) * _STEP / self.scale
        return self.corner[0] + steps, self.corner[1] - steps

    def draw_axes(self, image: Image) -> None:
        """Lines of a grid, with their metres along the left and lower edge."""
        cell = _round_cell((_SIDE - _MARGIN) / self.scale)
        extent = (_SIDE - _MARGIN) / self.scale
        for axis, start in ((0, self.corner[0]), (1, self.corner[1] - extent)):
            for step in range(int(np.ceil(start / cell)), int(np.floor((start + extent) / cell)) + 1):
                at = np.array([self.corner, self.corner + extent * np.array([1, -1])])
                at[:, axis] = step * cell
                pixels = self.pixels(at)
                _line(image, pixels, _SHADE if step == 0 else _GRID, 1)
                label = f"{step * cell:g}"
                place = pixels[1] + np.array([0, 16]) if axis == 0 else pixels[0] + np.array([-6, 4])
                _write(image, label, place, 0.36, _INK, right=axis == 1, middle=axis == 0)


def _from_above(rig: _Rig) -> Image:
    image = _panel()
    plan = _Plan.fitting(rig.low[:2], rig.high[:2])
    plan.draw_axes(image)
    for border, color in zip(rig.borders, rig.colors, strict=True):
        _fill(image, plan.pixels(border), color)
    _draw_axes_of_map(image, plan, rig)
    _draw_cameras_above(image, plan, rig, rig.colors)
    return image


def _draw_cameras_above(image: Image, plan: _Plan, rig: _Rig, colors: Sequence[Color]) -> None:
    shown: list[tuple[Array, Array, list[str]]] = []
    for (name, camera), border, color in zip(rig.cameras.items(), rig.borders, colors, strict=True):
        center, pixels = plan.pixels(camera.center), plan.pixels(border)
        if not ((center >= [_MARGIN, 0]) & (center < [_SIDE, _SIDE - _MARGIN])).all():
            continue
        _draw_view(image, center, pixels, color)
        near = [names for other, _, names in shown if np.linalg.norm(other - center) < _TOGETHER]
        if near:
            near[0].append(name)
        else:
            shown.append((center, center - pixels.mean(0), [name]))
    for center, away, names in shown:
        # cameras above or close to each other have one name
        text = names[0] + (f" +{len(names) - 1}" if len(names) > 1 else "")
        _write_beside(image, text, center, away)


def _draw_view(image: Image, center: Array, border: Array, color: Color) -> None:
    """A camera at a pixel (2,), and the border of its view (B, 2)."""
    for corner in border[:: max(1, len(border) // 4)]:
        _line(image, np.array([center, corner]), color, 1)
    _line(image, np.vstack([border, border[:1]]), color, 1)
    cv2.circle(image, _fixed(center), 4 * 16, color, -1, cv2.LINE_AA, 4)


def _write_apart(image: Image, names: Sequence[str], seen: tuple[Array, Array]) -> None:
    """Names above pixels (N, 2) at depths (N,), but for those that would hide one that is nearer."""
    written: list[Array] = []
    for number in np.argsort(seen[1]):
        (wide, tall), _ = cv2.getTextSize(names[number], _TEXT, 0.4, 1)
        place = seen[0][number] - np.array([0, 9])
        reach = np.array([wide, tall + 2])
        if all((np.abs(place - other) > reach).any() for other in written):
            written.append(place)
            _write(image, names[number], place, 0.4, _INK, middle=True, boxed=True)


def _write_beside(image: Image, text: str, center: Array, away: Array) -> None:
    """A camera's name behind it (``away`` from its view), or above it where there is no room."""
    (wide, _), _ = cv2.getTextSize(text, _TEXT, 0.4, 1)
    x, y = away / max(float(np.linalg.norm(away)), 1e-9)
    place = center + 12 * np.array([x, y]) + np.array([0, 4 + 4 * np.sign(y) * (abs(x) <= 0.5)])
    side = 0.0 if abs(x) <= 0.5 else np.sign(x)
    left = place[0] + wide * (side - 1) / 2
    if not _MARGIN < left < image.shape[1] - wide - 2:
        place, left = center - np.array([0, 9]), center[0] - wide / 2
    _write(image, text, (max(left, _MARGIN + 2), place[1]), 0.4, _INK, boxed=True)


def _draw_axes_of_map(image: Image, plan: _Plan, rig: _Rig) -> None:
    if not rig.near_origin:
        return
    size = _round_cell(float((rig.high - rig.low)[:2].max()))
    for axis in (0, 1):
        ends = np.zeros((2, 2))
        ends[1, axis] = size
        pixels = plan.pixels(ends)
        _line(image, pixels, _AXES[axis], 2)
        _write(image, "xy"[axis], pixels[1] + np.array([5, -5]), 0.45, _AXES[axis])


def _in_space(rig: _Rig) -> tuple[Image, float]:
    """The cameras from the side, and the metres of a square of the floor."""
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
            _line(image, eye.project(ends)[0], _SHADE if step == 0 else _GRID, 1)
    for axis, color in enumerate(_AXES if rig.near_origin else ()):
        ends = np.zeros((2, 3))
        ends[1, axis] = cell
        pixels = eye.project(ends)[0]
        _line(image, pixels, color, 2)
        _write(image, "xyz"[axis], pixels[1] + np.array([5, -5]), 0.45, color)
    names = list(rig.cameras)
    for number in np.argsort(-eye.project(centers)[1]):
        color, center = rig.colors[number], centers[number]
        border = eye.project(rig.borders[number])[0]
        pixel = eye.project(center[None])[0][0]
        foot = eye.project(np.array([[center[0], center[1], 0.0]]))[0][0]
        _line(image, np.array([foot, pixel]), _SHADE, 1)
        cv2.circle(image, _fixed(foot), 2 * 16, _SHADE, -1, cv2.LINE_AA, 4)
        _fill(image, border, color)
        _draw_view(image, pixel, border, color)
    _write_apart(image, names, eye.project(centers))
    return image, cell


def _covered(rig: _Rig, plan: _Plan, covered: Coverage) -> Image:
    image = _panel()
    most = max(1, int(covered.counts.max()))
    step = -(-most // _LEVELS)
    levels = [(0, 0), *((least, min(least + step - 1, most)) for least in range(1, most + 1, step))]
    colors = [(214, 216, 220), *_ramp(len(levels) - 1)]
    of_count = np.zeros((most + 1, 3), np.uint8)
    for (least, last), color in zip(levels, colors, strict=True):
        of_count[least : last + 1] = color
    field = np.repeat(np.repeat(of_count[covered.counts], _STEP, axis=0), _STEP, axis=1)
    left, top = np.rint(plan.pixels(np.array([covered.x[0], covered.y[0]])) - _STEP / 2).astype(int)
    image[top : top + field.shape[0], left : left + field.shape[1]] = field
    plan.draw_axes(image)
    _draw_cameras_above(image, plan, rig, [_INK] * len(rig.colors))
    legend = np.full((_SIDE, 150, 3), _PAPER, np.uint8)
    _write(legend, "cameras", (14, 20), 0.42, _INK)
    _write(legend, "m2", (138, 20), 0.42, _INK, right=True)
    for number, ((least, last), color) in enumerate(zip(levels, colors, strict=True)):
        y = 34 + 22 * number
        cv2.rectangle(legend, (14, y), (34, y + 16), color, -1)
        label = f"{least}" if least == last else f"{least}-{last}"
        _write(legend, label, (42, y + 13), 0.42, _INK)
        _write(legend, f"{covered.area(least, last):.1f}", (138, y + 13), 0.42, _INK, right=True)
    return np.concatenate([image, legend], axis=1)


def _focus(cameras: Sequence[Camera], centers: Array) -> Array:
    """(3,) the point nearest to all optical axes, if they meet; else a place ahead of the cameras."""
    axes = np.array([camera.R[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    total = across.sum(0)
    extent = max(float(np.ptp(centers, axis=0).max()), 1.0)
    if np.linalg.cond(total) < 1e3:
        point = np.linalg.solve(total, np.einsum("nij,nj->i", across, centers))
        if (np.abs(point - centers.mean(0)) < 3 * extent).all():
            return np.asarray(point, dtype=float)
    return np.asarray(centers.mean(0) + _AHEAD * axes.mean(0), dtype=float)


def _border(camera: Camera, reach: float) -> Array:
    """(B, 3) the border of what a camera sees, ``reach`` metres out; without what its lens leaves dark."""
    width, height = (n - 0.5 for n in camera.size)
    along = np.linspace(0, 1, _BORDER if camera.distorted else 1, endpoint=False)
    corners = np.array([[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]])
    following = np.roll(corners, -1, axis=0)
    pixels = corners[:, None] + along[:, None] * (following - corners)[:, None]
    rays = camera.rays(pixels.reshape(-1, 2))
    rays = rays[np.isfinite(rays).all(axis=1)]
    if len(rays) < 3:  # a fisheye whose picture is a disc
        turn = np.linspace(0, 2 * np.pi, 4 * _BORDER, endpoint=False)
        rim = camera.lens.valid_radius * np.column_stack([np.cos(turn), np.sin(turn)])
        rays = np.column_stack([rim, np.ones(len(rim))])
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(camera.center + reach * rays @ camera.R, dtype=float)


def _eye(points: Array) -> Camera:
    """The camera that sees points (N, 3) from the side and above, as near as it can be."""
    middle = (points.min(0) + points.max(0)) / 2
    toward = np.array(
        [
            np.cos(_AZIMUTH) * np.cos(_ELEVATION),
            np.sin(_AZIMUTH) * np.cos(_ELEVATION),
            np.sin(_ELEVATION),
        ]
    )
    away = 2 * float(np.linalg.norm(np.ptp(points, axis=0)))

    def camera() -> Camera:
        return Camera.look_at(middle + away * toward, middle, (_SIDE, _SIDE), float(_FOV))

    for _ in range(6):
        pixels = camera().project(points)[0]
        box = (pixels.min(0) + pixels.max(0)) / 2
        middle = camera().unproject(box[None], np.array([away]))[0]
        away *= float(np.abs(pixels - box).max()) / (0.46 * _SIDE)
    return camera()


def _corners(area: tuple[float, float, float, float]) -> tuple[Array, Array]:
    ends = np.array(area, dtype=float).reshape(2, 2)
    low, high = ends.min(0), ends.max(0)
    if not np.isfinite(ends).all() or (high - low).min() <= 0 or np.abs(ends).max() > _FARTHEST:
        raise CameraError("the area needs x, y of two corners, metres, apart in both", key="area")
    return low, high


def _round_cell(extent: float) -> float:
    """A round number of metres of which 5 to 12 are in an extent."""
    power = 10.0 ** np.floor(np.log10(extent / 5))
    return float(power * max(step for step in (1, 2, 5) if step * power <= extent / 5 * (1 + 1e-9)))


def _colors(count: int) -> list[Color]:
    hsv = np.zeros((1, count, 3), np.uint8)
    number = np.arange(count)
    hsv[0, :, 0] = (number * 180 // max(count, 6)).astype(np.uint8)
    hsv[0, :, 1] = 190
    hsv[0, :, 2] = np.where(number % 2, 150, 195)
    return [(int(r), int(g), int(b)) for r, g, b in cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0]]


def _ramp(count: int) -> list[Color]:
    """From few (dark blue) to many (yellow)."""
    values = np.rint(np.linspace(40, 255, count) if count > 1 else np.array([255.0])).astype(np.uint8)
    mapped = cv2.applyColorMap(values[None], cv2.COLORMAP_VIRIDIS)[0]
    return [(int(r), int(g), int(b)) for b, g, r in mapped]


def _panel() -> Image:
    return np.full((_SIDE, _SIDE, 3), _PAPER, np.uint8)


def _sheet(title: str, heads: Sequence[str], panels: Sequence[Image]) -> Image:
    """Panels side by side, a line above each."""
    columns = []
    for text, panel in zip(heads, panels, strict=True):
        strip = np.full((_ABOVE, panel.shape[1], 3), _PAPER, np.uint8)
        _write(strip, text, (_MARGIN, 19), 0.45, _INK)
        columns.append(np.concatenate([strip, panel]))
    body = np.concatenate(columns, axis=1)
    head = np.full((_HEAD, body.shape[1], 3), 255, np.uint8)
    _write(head, title, (10, 23), 0.55, _INK)
    return np.concatenate([head, body])


def _fixed(pixel: Array) -> tuple[int, int]:
    """In sixteenths of a pixel, OpenCV's finest."""
    x, y = np.rint(np.clip(np.nan_to_num(pixel, nan=-1e4), -1e4, 1e4) * 16)
    return int(x), int(y)


def _line(image: Image, pixels: Array, color: Color, width: int) -> None:
    """Lines from point to point (N, 2)."""
    points = np.array([_fixed(pixel) for pixel in pixels], np.int32)
    cv2.polylines(image, [points], False, color, width, cv2.LINE_AA, 4)


def _fill(image: Image, pixels: Array, color: Color) -> None:
    """A polygon (N, 2) that what is below shines through."""
    points = np.array([_fixed(pixel) for pixel in pixels], np.int32)
    over = image.copy()
    cv2.fillPoly(over, [points], color, cv2.LINE_AA, 4)
    cv2.addWeighted(over, 0.22, image, 0.78, 0, dst=image)


def _write(
    image: Image,
    text: str,
    place: Sequence[float] | Array,
    scale: float,
    color: Color,
    right: bool = False,
    middle: bool = False,
    boxed: bool = False,
) -> None:
    """Text whose lower left corner, or lower right, or the middle of its foot, is at a pixel; ``boxed`` on
    paper of its own that what is below shines through.
    """
    (wide, _), _ = cv2.getTextSize(text, _TEXT, scale, 1)
    x, y = place
    x -= wide / 2 if middle else wide if right else 0
    x = min(max(x, 2), image.shape[1] - wide - 2)
    at = (round(float(x)), round(float(np.clip(y, 12, image.shape[0] - 4))))
    if boxed:
        box = image[at[1] - 10 : at[1] + 4, max(at[0] - 2, 0) : at[0] + wide + 2]
        box[:] = np.rint(0.35 * box + 0.65 * np.array(_PAPER))
    cv2.putText(image, text, at, _TEXT, scale, color, 1, cv2.LINE_AA)
