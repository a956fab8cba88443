"""Draw plans: a scene from above, with room, objects, people, paths, fields of view and coverage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera, Coverage
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.render.pictures import (
    GRID,
    INK,
    PAPER,
    distinct_hues,
    draw_disc,
    draw_line,
    draw_text,
    fill_polygon,
    hsv_colors,
    text_size,
)
from humansim_ros.types import Array, Color, Image

if TYPE_CHECKING:
    from humansim_ros.scene.core.actor import Actor
    from humansim_ros.scene.core.scene import Scene


#: Coverage is tested at this height, metres: the chest of an adult.
CHEST = 1.2
#: Duration of the path that is drawn of a person, and time between two points of the path, seconds.
PATH_SECONDS, _PATH_STEP = 10.0, 0.1
#: A step longer than this, metres, is a jump: the motion starts again.
_JUMP = 0.6
#: Height of the legend below the plan and margin for the numbers along its axes, pixels.
_LEGEND, _MARGIN = 26, 34
#: Least side of the drawing in pixels. For a smaller tile it is scaled down.
_LEAST = 320
#: Most positions of the coverage along one axis.
_POSITIONS = 240
#: Least extent of the plan, metres; cameras farther away than this distance, metres, do not enlarge the plan.
_SMALLEST, _FARTHEST = 3.0, 100.0
#: Length of a drawn field of view, as a fraction of the extent.
_REACH = 0.14
_FURNITURE: Color = (120, 126, 136)
_WHITE: Color = (255, 255, 255)


def top_view(
    scene: Scene, cameras: Mapping[str, Camera], seconds: float, size: tuple[int, int] = (620, 620)
) -> Image:
    """Draw a scene from above, (H, W, 3).

    The floor is coloured by the number of cameras that see a point 1.2 m above it; occlusion is ignored. The
    colours end at the walls of a room. A person is a disc with a line in the direction of the hips, and the
    path of the next ten seconds. Cameras have the pyramids of their fields of view.

    Args:
        scene: The scene.
        cameras: Its cameras at their poses, by name.
        seconds: Scene time.
        size: Width and height of the image in pixels.
    """
    factor = max(1.0, _LEAST / min(size))
    width, height = (round(factor * side) for side in size)
    paths = {name: _path(actor, seconds) for name, actor in scene.actors.items()}
    low, high = _bounds(scene, cameras, paths)
    plan = Plan.fitting(low, high, (width, height - _LEGEND), _MARGIN)
    image = np.full((height, width, 3), PAPER, np.uint8)
    above = image[: height - _LEGEND]
    levels, colors = _draw_coverage(above, plan, scene, cameras)
    plan.draw_axes(above)
    _draw_things(above, plan, scene, seconds)
    _draw_cameras(above, plan, cameras)
    _draw_people(above, plan, scene, paths, seconds)
    _draw_legend(image[height - _LEGEND :], levels, colors)
    if factor > 1:
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return image


def _path(actor: Actor, seconds: float) -> Array:
    """Path of the hips (N, 2) of a person from a scene time on. It begins at the place at that time."""
    times = seconds + np.arange(0.0, PATH_SECONDS, _PATH_STEP)
    return actor.joint_paths(times)[:, 0, :2]


def _bounds(scene: Scene, cameras: Mapping[str, Camera], paths: Mapping[str, Array]) -> tuple[Array, Array]:
    """Least and greatest x and y, (2,) each, of room, people and cameras, metres."""
    points = [path for path in paths.values() if np.abs(path).max() < _FARTHEST]
    if scene.environment.room is not None:
        half = np.array(scene.environment.room.size[:2]) / 2
        points.append(np.array([-half, half]))
    centers = np.array([camera.center[:2] for camera in cameras.values()]).reshape(-1, 2)
    near = centers[np.abs(centers).max(axis=1) < _FARTHEST] if points else centers
    corners = np.concatenate([*points, near]) if points or len(near) else np.zeros((1, 2))
    low, high = corners.min(axis=0), corners.max(axis=0)
    middle, half = (low + high) / 2, np.maximum((high - low) / 2, _SMALLEST / 2)
    return middle - half, middle + half


def _draw_coverage(
    image: Image, plan: Plan, scene: Scene, cameras: Mapping[str, Camera]
) -> tuple[list[tuple[int, int]], list[Color]]:
    """Colour the floor by the number of cameras that see it. Returns the steps of the legend, and their
    colours."""
    step = max(2, -(-max(plan.size) // _POSITIONS))
    x, y = plan.positions(step)
    counts = Coverage.of(cameras, x, y, CHEST).counts
    levels, colors, of_count = coverage_colors(max(1, len(cameras)))
    # paler than the legend of a coverage image, so that people and paths stand out
    pale = np.rint(0.55 * of_count + 0.45 * 255).astype(np.uint8)
    shown = pale[counts]
    if scene.environment.room is not None:
        half = np.array(scene.environment.room.size[:2]) / 2
        inside = (np.abs(x)[None] <= half[0]) & (np.abs(y)[:, None] <= half[1])
        shown = np.where(inside[..., None], shown, np.array(PAPER, np.uint8))
    plan.draw_field(image, x, y, shown, step)
    return levels, [(int(r), int(g), int(b)) for r, g, b in 0.55 * np.array(colors) + 0.45 * 255]


def _outlines(scene: Scene, seconds: float) -> Iterator[Array]:
    """Yield outlines (N, 2) of furniture and objects, seen from above."""
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    if scene.environment.room is not None:
        for each in scene.environment.furnishing.fixtures.values():
            center, size = each.center, each.size
            yield center + square * size
    meshes = [mesh.vertices for mesh in scene.environment.mesh_files]
    meshes += [item.at(seconds).apply(item.mesh.vertices) for item in scene.objects.values()]
    for vertices in meshes:
        flat = np.ascontiguousarray(vertices[:, :2], dtype=np.float32)
        yield cv2.convexHull(flat)[:, 0].astype(float)


def _draw_things(image: Image, plan: Plan, scene: Scene, seconds: float) -> None:
    """Draw the walls of the room, and the outlines of furniture and objects."""
    for outline in _outlines(scene, seconds):
        pixels = plan.pixels(outline)
        fill_polygon(image, pixels, _FURNITURE, 0.25)
        draw_line(image, np.vstack([pixels, pixels[:1]]), _FURNITURE)
    if scene.environment.room is not None:
        half = np.array(scene.environment.room.size[:2]) / 2
        corners = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
        draw_line(image, plan.pixels(corners), INK, 2)


def _draw_cameras(image: Image, plan: Plan, cameras: Mapping[str, Camera]) -> None:
    """Draw the cameras with their fields of view and their names."""
    reach = _REACH * float(plan.extent.max()) * min(1.0, float(np.sqrt(12 / max(1, len(cameras)))))
    borders = [view_border(camera, reach) for camera in cameras.values()]
    for border in borders:
        fill_polygon(image, plan.pixels(border), INK, 0.12)
    plan.draw_cameras(image, cameras, borders, [INK] * len(borders))


def _draw_people(image: Image, plan: Plan, scene: Scene, paths: Mapping[str, Array], seconds: float) -> None:
    """Draw people: path, place, direction that they face, and name."""
    palette = hsv_colors(distinct_hues(len(paths)), 230, 200)
    radius = float(np.clip(0.2 * plan.scale, 4, 14))
    for (name, path), color in zip(paths.items(), palette.tolist(), strict=True):
        jumps = np.flatnonzero(np.linalg.norm(np.diff(path, axis=0), axis=1) > _JUMP) + 1
        for part in np.split(plan.pixels(path), jumps):
            draw_line(image, part, color, 2)
        center = plan.pixels(path[0])
        facing = center + 2 * radius * _facing(scene.actors[name], seconds) * [1, -1]
        draw_line(image, [center, facing], color, 2)
        draw_disc(image, center, radius, color)
        draw_disc(image, center, radius, _WHITE, 1)
        if len(paths) <= 12:
            draw_label(image, name, center - [0, radius + 5], 0.42, anchor="middle", boxed=True)


def _facing(actor: Actor, seconds: float) -> Array:
    """Direction (2,) that the hips of a person face, seen from above. Zero if they face up or down."""
    hips = actor.motion.match.roles["Hips"]
    rotation = quaternion_to_matrix(actor.joint_poses(seconds).rotations[0, hips])
    heading = rotation[:2, 0]
    length = float(np.linalg.norm(heading))
    return np.asarray(heading / length) if length > 0.2 else np.zeros(2)


def _draw_legend(image: Image, levels: list[tuple[int, int]], colors: list[Color]) -> None:
    """Draw the colours with their numbers of cameras, as many as fit."""
    x = 10
    for text in ("cameras that see 1.2 m above the floor", "cameras at 1.2 m", ""):
        if x + text_size(text, 0.38)[0] + 36 * len(levels) < image.shape[1]:
            break
    draw_text(image, text, (x, 17), 0.38)
    x += text_size(text, 0.38)[0] + 10
    for (least, last), color in zip(levels, colors, strict=True):
        label = f"{least}" if least == last else f"{least}-{last}"
        wide = 20 + text_size(label, 0.38)[0] + 8
        if x + wide > image.shape[1]:
            break
        cv2.rectangle(image, (x, 7), (x + 13, 20), color, -1)
        draw_text(image, label, (x + 18, 18), 0.38)
        x += wide


#: Colour of grid lines through the origin, and of lines from cameras down to the floor.
SHADE: Color = (168, 172, 180)
#: Colour of places that no camera sees.
_UNSEEN: Color = (214, 216, 220)
#: Most steps of a legend.
_LEVELS = 10
#: Points along each side of a distorted image.
_BORDER_POINTS = 16
#: Distance in pixels below which cameras share a label.
_SHARED_LABEL = 14


@dataclass(frozen=True)
class Plan:
    """A plan: maps x, y of ``map`` to pixels, with x to the right and y up.

    Attributes:
        corner: x, y of the top left corner of the plan in ``map``, metres.
        scale: Pixels per metre.
        size: Width and height of the image in pixels.
        margin: Pixels at the left and the lower edge, for the numbers along the axes.
    """

    corner: Array
    scale: float
    size: tuple[int, int]
    margin: int

    @classmethod
    def fitting(cls, low: Array, high: Array, size: tuple[int, int], margin: int) -> Plan:
        """Create a plan of an area with a border around the area.

        Args:
            low: Least x and y of the area, (2,) metres.
            high: Greatest x and y, (2,) metres.
            size: Width and height of the image in pixels.
            margin: Pixels at the left and the lower edge.
        """
        room = np.array(size, dtype=float) - margin
        scale = float((room / np.maximum((high - low) * 1.2, 1e-9)).min())
        return cls((low + high) / 2 + room / scale / 2 * np.array([-1, 1]), scale, size, margin)

    @property
    def extent(self) -> Array:
        """Width and height (2,) of the area that the plan shows, metres."""
        return np.asarray((np.array(self.size, dtype=float) - self.margin) / self.scale)

    def pixels(self, points: Array) -> Array:
        """Convert points (N, 2) or (N, 3) in ``map`` to pixels (N, 2)."""
        return np.asarray((points[..., :2] - self.corner) * self.scale * [1, -1] + [self.margin, 0])

    def has(self, pixel: Array) -> bool:
        """Whether a pixel (2,) is inside the margins."""
        width, height = self.size
        return bool(((pixel >= [self.margin, 0]) & (pixel < [width, height - self.margin])).all())

    def positions(self, step: int) -> tuple[Array, Array]:
        """x (W,) and y (H,) of positions every ``step`` pixels."""
        width, height = ((np.arange((n - self.margin) // step) + 0.5) * step / self.scale for n in self.size)
        return self.corner[0] + width, self.corner[1] - height

    def draw_field(self, image: Image, x: Array, y: Array, colors: NDArray[np.uint8], step: int) -> None:
        """Draw a square for each position.

        Args:
            image: Image that is drawn on.
            x: Positions along x, (W,), from :meth:`positions`.
            y: Positions along y, (H,).
            colors: Colours of the squares, (H, W, 3).
            step: Side of a square in pixels.
        """
        field = np.repeat(np.repeat(colors, step, axis=0), step, axis=1)
        left, top = np.rint(self.pixels(np.array([x[0], y[0]])) - step / 2).astype(int)
        image[top : top + field.shape[0], left : left + field.shape[1]] = field

    def draw_axes(self, image: Image) -> None:
        """Draw grid lines, with metres along the left and the lower edge."""
        cell = round_cell(float(self.extent.max()))
        last = self.corner + self.extent * [1, -1]
        for axis, start, stop in ((0, self.corner[0], last[0]), (1, last[1], self.corner[1])):
            for step in range(int(np.ceil(start / cell)), int(np.floor(stop / cell)) + 1):
                ends = np.array([self.corner, last])
                ends[:, axis] = step * cell
                pixels = self.pixels(ends)
                draw_line(image, pixels, SHADE if step == 0 else GRID)
                label = f"{step * cell:g}"
                position = pixels[1] + np.array([0, 16]) if axis == 0 else pixels[0] + np.array([-6, 4])
                draw_label(image, label, position, 0.36, anchor="middle" if axis == 0 else "right")

    def draw_cameras(
        self, image: Image, cameras: Mapping[str, Camera], borders: Sequence[Array], colors: Sequence[Color]
    ) -> None:
        """Draw the cameras on the plan, with their names. Cameras above or close to each other share a label.

        Args:
            image: Image that is drawn on.
            cameras: Cameras by name.
            borders: Border (B, 3) of the view of each camera.
            colors: Colour of each camera.
        """
        labels: list[tuple[Array, Array, list[str]]] = []
        for (name, camera), border, color in zip(cameras.items(), borders, colors, strict=True):
            center, pixels = self.pixels(camera.center), self.pixels(border)
            if not self.has(center):
                continue
            draw_view(image, center, pixels, color)
            near = [names for other, _, names in labels if np.linalg.norm(other - center) < _SHARED_LABEL]
            if near:
                near[0].append(name)
            else:
                labels.append((center, center - pixels.mean(0), [name]))
        for center, backward, names in labels:
            text = names[0] + (f" +{len(names) - 1}" if len(names) > 1 else "")
            _draw_name(image, text, center, backward, self.margin)


def draw_view(image: Image, center: Array, border: Array, color: Color) -> None:
    """Draw a camera and its field of view.

    Args:
        image: Image that is drawn on.
        center: Pixel of the camera, (2,).
        border: Pixels of the border of its view, (B, 2).
        color: Colour of the lines.
    """
    for corner in border[:: max(1, len(border) // 4)]:
        draw_line(image, [center, corner], color)
    draw_line(image, np.vstack([border, border[:1]]), color)
    draw_disc(image, center, 4, color)


def _draw_name(image: Image, text: str, center: Array, backward: Array, margin: int) -> None:
    """Draw a camera's name behind the camera, or above the camera if there is no room behind.

    Args:
        image: Image that is drawn on.
        text: The name.
        center: Pixel of the camera, (2,).
        backward: Direction from the view of the camera to its back, (2,) pixels.
        margin: Pixels at the left edge that stay free.
    """
    width, _ = text_size(text, 0.4)
    x, y = backward / max(float(np.linalg.norm(backward)), 1e-9)
    position = center + 12 * np.array([x, y]) + np.array([0, 4 + 4 * np.sign(y) * (abs(x) <= 0.5)])
    side = 0.0 if abs(x) <= 0.5 else np.sign(x)
    left = position[0] + width * (side - 1) / 2
    if not margin < left < image.shape[1] - width - 2:
        position, left = center - np.array([0, 9]), center[0] - width / 2
    draw_label(image, text, (max(left, margin + 2), position[1]), 0.4, boxed=True)


def draw_label(
    image: Image,
    text: str,
    position: Sequence[float] | Array,
    scale: float,
    color: Color = INK,
    anchor: Literal["left", "middle", "right"] = "left",
    boxed: bool = False,
) -> None:
    """Draw text inside the image.

    Args:
        image: Image that is drawn on.
        text: The text.
        position: x, y of a point of the lower edge of the text, in pixels.
        scale: Size of the font, as in :func:`~humansim_ros.render.pictures.draw_text`.
        color: Colour of the text.
        anchor: Which point of the lower edge is at ``position``.
        boxed: Whether the text is drawn on a translucent box.
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


def view_border(camera: Camera, reach: float) -> Array:
    """Border (B, 3) of a camera's view at a distance of ``reach`` metres. Pixels without a ray are left
    out."""
    width, height = (n - 0.5 for n in camera.size)
    along = np.linspace(0, 1, _BORDER_POINTS if camera.distorted else 1, endpoint=False)
    corners = np.array([[-0.5, -0.5], [width, -0.5], [width, height], [-0.5, height]])
    following = np.roll(corners, -1, axis=0)
    pixels = corners[:, None] + along[:, None] * (following - corners)[:, None]
    rays = camera.rays(pixels.reshape(-1, 2))
    rays = rays[np.isfinite(rays).all(axis=1)]
    if len(rays) < 3:  # a fisheye with an image that is a disc
        angles = np.linspace(0, 2 * np.pi, 4 * _BORDER_POINTS, endpoint=False)
        rim = camera.lens.valid_radius * np.column_stack([np.cos(angles), np.sin(angles)])
        rays = np.column_stack([rim, np.ones(len(rim))])
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return np.asarray(camera.center + reach * rays @ camera.R, dtype=float)


def round_cell(extent: float) -> float:
    """Size of a grid cell in metres: 1, 2 or 5 times a power of ten, so that 5 to 12 cells fit into the
    extent."""
    power = 10.0 ** np.floor(np.log10(extent / 5))
    return float(power * max(step for step in (1, 2, 5) if step * power <= extent / 5 * (1 + 1e-9)))


def coverage_colors(most: int) -> tuple[list[tuple[int, int]], list[Color], NDArray[np.uint8]]:
    """Colours that show how many cameras see a place.

    ``most``: the greatest number, at least 1.

    Returns:
        Least and greatest number of each step of the legend, the colour of each step, and the colour of each
        number (most + 1, 3).
    """
    step = -(-most // _LEVELS)
    levels = [(0, 0), *((least, min(least + step - 1, most)) for least in range(1, most + 1, step))]
    colors = [_UNSEEN, *_ramp(len(levels) - 1)]
    of_count = np.zeros((most + 1, 3), np.uint8)
    for (least, last), color in zip(levels, colors, strict=True):
        of_count[least : last + 1] = color
    return levels, colors, of_count


def _ramp(count: int) -> list[Color]:
    """Colours from dark blue to yellow."""
    values = np.rint(np.linspace(40, 255, count) if count > 1 else np.array([255.0])).astype(np.uint8)
    mapped = cv2.applyColorMap(values[None], cv2.COLORMAP_VIRIDIS)[0]
    return [(int(r), int(g), int(b)) for b, g, r in mapped]
