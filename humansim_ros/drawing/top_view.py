"""A scene from above: room, objects, cameras with their fields of view, people with their paths, coverage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import cv2
import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.camera.coverage import Coverage
from humansim_ros.drawing.canvas import (
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
from humansim_ros.drawing.plan import Plan, coverage_colors, draw_label, draw_name, draw_view, view_border
from humansim_ros.rotations import quaternion_to_matrix
from humansim_ros.scene import Scene
from humansim_ros.scene.actor import Actor
from humansim_ros.scene.room import furniture_plan
from humansim_ros.types import Array, Color, Image

#: Height at which places count as seen: the chest of an adult, metres.
CHEST = 1.2
#: Seconds of a person's path that are drawn, and between its points.
PATH_SECONDS, _PATH_STEP = 10.0, 0.1
#: A longer step is a jump of a motion that starts again, metres.
_JUMP = 0.6
#: Height of the legend below the plan and margin for the numbers along its axes, pixels.
_LEGEND, _MARGIN = 26, 34
#: Least side of the drawing in pixels; a smaller tile shows it reduced.
_LEAST = 320
#: Most positions of the coverage along one axis.
_POSITIONS = 240
#: Least extent of the plan and greatest distance of cameras that widen it, metres.
_SMALLEST, _FARTHEST = 3.0, 100.0
#: Length of a drawn field of view, as a fraction of the extent.
_REACH = 0.14
_FURNITURE: Color = (120, 126, 136)
_WHITE: Color = (255, 255, 255)


def top_view(
    scene: Scene, cameras: Mapping[str, Camera], seconds: float, size: tuple[int, int] = (620, 620)
) -> Image:
    """Draw a scene from above, (H, W, 3).

    The colours of the floor are the numbers of cameras that see a point 1.2 m above it, if nothing is in the
    way; they end at the walls of a room. People are discs with a line to where their hips face, and the paths
    of their next ten seconds. Cameras have the pyramids of their fields of view.

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
    """Hips (N, 2) of a person in the seconds from a scene time on; the first is where they are."""
    times = seconds + np.arange(0.0, PATH_SECONDS, _PATH_STEP)
    return actor.joint_paths(times)[:, 0, :2]


def _bounds(scene: Scene, cameras: Mapping[str, Camera], paths: Mapping[str, Array]) -> tuple[Array, Array]:
    """Least and greatest x and y (2,) of the room, the people and the cameras, metres."""
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
    """Color the floor by the number of cameras that see it; returns the steps of the legend, and colours."""
    step = max(2, -(-max(plan.size) // _POSITIONS))
    x, y = plan.positions(step)
    counts = Coverage.of(cameras, x, y, CHEST).counts
    levels, colors, of_count = coverage_colors(max(1, len(cameras)))
    # paler than the legend of a coverage image, for people and paths to stand out
    pale = np.rint(0.55 * of_count + 0.45 * 255).astype(np.uint8)
    shown = pale[counts]
    if scene.environment.room is not None:
        half = np.array(scene.environment.room.size[:2]) / 2
        inside = (np.abs(x)[None] <= half[0]) & (np.abs(y)[:, None] <= half[1])
        shown = np.where(inside[..., None], shown, np.array(PAPER, np.uint8))
    plan.draw_field(image, x, y, shown, step)
    return levels, [(int(r), int(g), int(b)) for r, g, b in 0.55 * np.array(colors) + 0.45 * 255]


def _outlines(scene: Scene, seconds: float) -> Iterator[Array]:
    """Outlines (N, 2) of furniture and objects."""
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) / 2
    if scene.environment.room is not None:
        for center, size in furniture_plan(scene.environment.room.size[:2]).values():
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
    names: list[tuple[str, Array, Array]] = []
    for name, camera in cameras.items():
        center, border = plan.pixels(camera.center), plan.pixels(view_border(camera, reach))
        if plan.has(center):
            fill_polygon(image, border, INK, 0.12)
            draw_view(image, center, border, INK)
            names.append((name, center, center - border.mean(axis=0)))
    for name, center, backward in names:
        draw_name(image, name, center, backward, plan.margin)


def _draw_people(image: Image, plan: Plan, scene: Scene, paths: Mapping[str, Array], seconds: float) -> None:
    """Draw people: their paths, where they are and face, and their names."""
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
    """Direction (2,) in which the hips of a person face, seen from above; zero if they face up or down."""
    hips = actor.motion.match.roles["Hips"]
    rotation = quaternion_to_matrix(actor.joint_poses(seconds).rotations[0, hips])
    heading = rotation[:2, 0]
    length = float(np.linalg.norm(heading))
    return np.asarray(heading / length) if length > 0.2 else np.zeros(2)


def _draw_legend(image: Image, levels: list[tuple[int, int]], colors: list[Color]) -> None:
    """Draw the colours of the numbers of cameras, as many as there is room for."""
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
