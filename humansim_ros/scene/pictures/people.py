"""Images of people: a motion as a strip or a video, as stick figures or skinned; a human from all sides."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera import Camera
from humansim_ros.errors import HumansimError
from humansim_ros.geometry import WORLD_FROM_BODY, transform
from humansim_ros.motion.body import DETAIL_BONES, Motion, side_of
from humansim_ros.motion.matching import axis_vector
from humansim_ros.motion.pose import Retargeter, WorldMotion, floor_height, headings, mean_heading
from humansim_ros.people.humans import Human
from humansim_ros.render.frame import GLRenderer
from humansim_ros.render.interface import Body, Lighting
from humansim_ros.render.pictures import (
    GRID,
    PAPER,
    SIDE_COLORS,
    distinct_hues,
    draw_disc,
    draw_line,
    draw_text,
    hsv_colors,
    row,
    text_size,
    title_bar,
    titled_rows,
    write_gif,
    write_mp4,
    write_png,
)
from humansim_ros.types import Array, Color, Image, Indices

Viewpoint = Literal["side", "front", "three-quarter"]
#: Function that shows the progress of a video. It takes the frames and their number, and yields the same
#: frames as they are drawn.
Progress = Callable[[Iterable[Image], int], AbstractContextManager[Iterable[Image]]]
SUFFIXES = (".png", ".mp4", ".gif")
#: Azimuth of the camera, degrees from in front of the person towards its left.
_AZIMUTHS: dict[Viewpoint, float] = {"front": 0.0, "three-quarter": 40.0, "side": 90.0}
_SHADOW: Color = (196, 200, 206)
_FOV = np.radians(30.0)
#: Most samples of a motion for the path of the camera, and seconds over which the path is smoothed.
_PATH_SAMPLES, _SMOOTHING = 1000, 0.4
#: Largest height of the image, in heights of the figure. If movements are larger, the camera follows them.
_LARGEST_SPAN = 1.6
#: Number of samples of a motion that must fit into the image, and share of the image that they may fill.
_FIT_SAMPLES, _FIT_SHARE = 100, 0.94
#: Most frames per second of a GIF, since it has a resolution of 1/100 s and browsers show no more.
_GIF_RATE = 20.0


@dataclass(frozen=True)
class AnimatedFigure:
    """Points that move, z up. ``points``: function of times (N,) in seconds that returns (N, P, 3).
    ``height``: height of the standing figure. ``floor``: height of the floor. ``heading``: direction that the
    figure faces, radians from +x to +y. ``cell``: distance of the grid lines on the floor."""

    points: Callable[[Array], Array]
    seconds: float
    frame_time: float
    height: float
    floor: float = 0.0
    heading: float = 0.0
    cell: float = 0.5


class _TrackingCamera:
    """Camera that follows a figure at a constant distance and keeps all of it in the image."""

    def __init__(self, figure: AnimatedFigure, size: tuple[int, int], viewpoint: Viewpoint) -> None:
        self._figure, self._size = figure, size
        self._azimuth = figure.heading + np.radians(_AZIMUTHS[viewpoint])
        count = int(np.clip(figure.seconds / figure.frame_time + 1, 1, _PATH_SAMPLES))
        self._times: Array = np.linspace(0.0, figure.seconds, count, dtype=float)
        points = figure.points(self._times)
        step = max(figure.seconds / max(count - 1, 1), 1e-9)
        low, high = points.min(1), points.max(1)
        self._middle = _smoothed((low[:, :2] + high[:, :2]) / 2, _SMOOTHING / step)
        # the camera stays level for jumps and raised arms, but rises for stairs
        top = high[:, 2] - figure.floor
        reach = float(np.clip(np.percentile(top, 99.5), 1.05 * figure.height, 1.3 * figure.height))
        self._lift = _smoothed(np.maximum(top - reach, 0.0)[:, None], _SMOOTHING / step)[:, 0]
        self._span = 1.2 * reach
        largest = _LARGEST_SPAN * self._span
        samples = np.unique(np.linspace(0, count - 1, _FIT_SAMPLES).astype(int))
        for _ in range(3):
            extent = max(self._extent(points[i], self._times[i]) for i in samples)
            self._span = min(self._span * max(1.0, extent), largest)

    def _extent(self, points: Array, time: float) -> float:
        """Distance of the outermost point (P, 3) from the image centre, relative to the image: up to 1, all
        points are in the image."""
        pixels, depth = self.camera(time).project(points)
        half = (np.array(self._size) - 1) / 2
        distance = np.where(depth[:, None] > 0, np.abs(pixels / half - 1), 1.0)
        return float(distance.max()) / _FIT_SHARE

    def camera(self, time: float) -> Camera:
        x, y = (np.interp(time, self._times, path) for path in self._middle.T)
        lift = float(np.interp(time, self._times, self._lift))
        target = np.array([x, y, self._figure.floor + lift + 0.41 * self._span])
        distance = self._span / (2 * np.tan(_FOV / 2))
        eye = target + distance * np.array([np.cos(self._azimuth), np.sin(self._azimuth), 0.16])
        return _looking(eye, target, self._size, _FOV)

    def floor(self, camera: Camera, time: float) -> Image:
        """Draw the floor with grid lines that are fixed in the world."""
        image = np.full((self._size[1], self._size[0], 3), PAPER, np.uint8)
        cell = self._figure.cell
        reach = cell * np.ceil(1.05 * self._span / cell)
        middle = np.array([np.interp(time, self._times, path) for path in self._middle.T])
        middle = np.round(middle / cell) * cell
        for step in np.arange(-reach, reach + cell / 2, cell):
            for axis in (0, 1):
                ends = np.full((2, 3), self._figure.floor)
                ends[:, axis] = middle[axis] + step
                ends[:, 1 - axis] = middle[1 - axis] + np.array([-reach, reach])
                _draw_segment(image, camera, ends, GRID, 1)
        return image


def _looking(eye: Array, target: Array, size: tuple[int, int], fov: float) -> Camera:
    """Camera that looks at a target, with the vertical field of view ``fov``, radians."""
    width, height = size
    return Camera.look_at(
        tuple(eye), tuple(target), size, float(2 * np.arctan(np.tan(fov / 2) * width / height))
    )


def _smoothed(path: Array, sigma: float) -> Array:
    """Smooth a path (N, D) along N. Beyond its ends, it is continued by point reflection."""
    sigma = min(sigma, len(path))
    pad = min(len(path) - 1, int(np.ceil(3 * sigma)))
    if pad < 1:
        return path
    padded = np.pad(path, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
    return np.asarray(gaussian_filter1d(padded, sigma, axis=0)[pad:-pad])


def _draw_segment(image: Image, camera: Camera, ends: Array, color: Color, width: int) -> None:
    """Draw a line between two points (2, 3) if both are in front of the camera."""
    pixels, depth = camera.project(ends)
    if (depth > 0).all():
        draw_line(image, pixels, color, width)


class Artist(ABC):
    """Draws an animated figure, in images of ``size`` (width, height)."""

    def __init__(self, figure: AnimatedFigure, size: tuple[int, int], viewpoint: Viewpoint) -> None:
        self.figure = figure
        self._tracking = _TrackingCamera(figure, size, viewpoint)

    @abstractmethod
    def draw(self, time: float) -> Image:
        """Draw the figure at a time in seconds."""

    def close(self) -> None:  # noqa: B027
        """Release the renderer, if there is one."""


class StickFigureArtist(Artist):
    """Draws the joints of a motion and the links between joints: left blue, right red."""

    def __init__(
        self,
        figure: AnimatedFigure,
        parents: Indices,
        sides: Indices,
        size: tuple[int, int],
        viewpoint: Viewpoint,
    ) -> None:
        """Make an artist (:meth:`of_world` and :meth:`of_file` are simpler). ``parents``: parent of each
        joint, (J,); -1 for a root. ``sides``: side of each joint, (J,): 1 left, -1 right, 0 neither."""
        super().__init__(figure, size, viewpoint)
        self._parents, self._sides = parents, sides

    @classmethod
    def of_world(
        cls, world: WorldMotion, size: tuple[int, int], viewpoint: Viewpoint = "three-quarter"
    ) -> StickFigureArtist:
        """Make an artist for a person in the world, in images of ``size`` (width, height)."""
        figure = AnimatedFigure(
            lambda times: world.sample(times).positions,
            world.duration,
            world.motion.frame_time,
            1.05 * world.frame.stature,
            heading=_heading(world),
        )
        roles = {joint: role for role, joint in world.match.roles.items()}
        sides = _sides(world.names, world.motion.parents, roles)
        return cls(figure, world.motion.parents, sides, size, viewpoint)

    @classmethod
    def of_file(
        cls,
        motion: Motion,
        size: tuple[int, int],
        viewpoint: Viewpoint = "three-quarter",
        up: str | None = None,
    ) -> StickFigureArtist:
        """Make an artist for a motion in the unit and axes of its file. The motion need not be of a person.

        Args:
            motion: Motion as in its file.
            size: Width and height of the images in pixels.
            viewpoint: Direction that the figure is drawn from.
            up: Axis of the file that points up, such as ``-z``. If None, y as in most files, or z if the
                figure is much larger along z.

        Raises:
            HumansimError: All joints are at one position, or a position is not finite.
        """
        points = motion.world_positions()
        extent = np.ptp(points, axis=1).mean(0)
        upward = axis_vector(up or ("z" if extent[2] > 2 * extent[1] else "y"))
        rotation = np.stack([np.roll(np.abs(upward), 1), np.roll(upward, 2), upward])
        points = points @ rotation.T
        largest = float(np.ptp(points, axis=1).max())
        if not 0 < largest < np.inf:
            message = "there is nothing to draw: all joints are at one position, or one is not finite"
            raise HumansimError(message, path=motion.path)
        points = points / largest
        figure = AnimatedFigure(
            lambda times: points[np.rint(times / motion.frame_time).astype(int).clip(0, len(points) - 1)],
            motion.duration,
            motion.frame_time,
            1.05,
            floor_height(points[..., 2].min(1)),
            cell=0.25,
        )
        sides = _sides(motion.joint_names, motion.parents, {})
        return cls(figure, motion.parents, sides, size, viewpoint)

    def draw(self, time: float) -> Image:
        """Draw the stick figure at a time in seconds."""
        points = self.figure.points(np.array([time]))[0]
        camera = self._tracking.camera(time)
        image = self._tracking.floor(camera, time)
        links = [(joint, int(parent)) for joint, parent in enumerate(self._parents) if parent >= 0]
        shadow = points * (1, 1, 0) + (0, 0, self.figure.floor)
        for joint, parent in links:
            _draw_segment(image, camera, shadow[[parent, joint]], _SHADOW, 2)
        pixels, depth = camera.project(points)
        colors = [SIDE_COLORS[int(side)] for side in self._sides]
        for joint, parent in sorted(links, key=lambda link: -depth[link[0]]):
            _draw_segment(image, camera, points[[parent, joint]], colors[joint], 2)
        for joint in np.argsort(-depth):
            if depth[joint] > 0:
                draw_disc(image, pixels[joint], 2.5, colors[joint])
        return image


class SkinnedArtist(Artist):
    """Draws the human that a motion drives."""

    def __init__(
        self, human: Human, world: WorldMotion, size: tuple[int, int], viewpoint: Viewpoint = "three-quarter"
    ) -> None:
        self._human, self._world = human, world
        self._retargeter = Retargeter.fit(world, human.skeleton)
        skeleton = human.skeleton

        def points(times: Array) -> Array:
            posed = self._retargeter.pose(world.sample(times))
            tails = posed[..., :3, 3] + posed[..., :3, 1] * skeleton.lengths[:, None]
            return np.concatenate([posed[..., :3, 3], tails], axis=1)

        figure = AnimatedFigure(
            points,
            world.duration,
            world.motion.frame_time,
            1.05 * float(skeleton.tails[:, 1].max()),
            heading=_heading(world),
        )
        super().__init__(figure, size, viewpoint)
        # the sun is in front of the human for any heading
        sun = Rotation.from_euler("z", self.figure.heading).apply(Lighting.sun)
        self._renderer = GLRenderer([], Lighting(sun=tuple(sun), background=PAPER))

    def draw(self, time: float) -> Image:
        """Render the human at a time in seconds."""
        human, camera = self._human, self._tracking.camera(time)
        vertices = human.pose(self._retargeter.pose(self._world.sample(time))[0])
        body = Body(human.mesh, vertices, human.triangle_parts, 1)
        view = self._renderer.render([body], camera, ("rgb", "instance"))
        # the contact shadow and the blended edges of the body darken the paper: apply them to the floor
        floor = self._tracking.floor(camera, time)
        shaded = np.clip(np.rint(floor * (view.rgb / np.array(PAPER))), 0, 255).astype(np.uint8)
        return np.where(view.instance[..., None] > 0, view.rgb, shaded)

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()


def _heading(world: WorldMotion) -> float:
    """Mean heading of a person. If headings cancel each other, the first heading."""
    poses = world.sample(np.linspace(0.0, world.duration, 200))
    heading = mean_heading(world.match, poses)
    if heading is not None:
        return heading
    x, y = headings(world.match, poses)[0]
    return float(np.arctan2(y, x))


def _sides(names: Sequence[str], parents: Indices, roles: dict[int, str]) -> Indices:
    """Side of each joint (J,): 1 left, -1 right, 0 neither. The side follows from role or name of the joint,
    or else from its parent."""
    sides = np.zeros(len(names), np.intp)
    for joint, name in enumerate(names):
        word = roles.get(joint, name).lower()
        if "left" in word or word.startswith("l_") or word.endswith((".l", "_l")):
            sides[joint] = 1
        elif "right" in word or word.startswith("r_") or word.endswith((".r", "_r")):
            sides[joint] = -1
        elif parents[joint] >= 0 and joint not in roles:
            sides[joint] = sides[parents[joint]]
    return sides


def strip(artists: Sequence[Artist], phases: int, title: str) -> Image:
    """Draw frames of a motion side by side, including the first and the last. Each artist draws one row."""
    figure = artists[0].figure
    last = round(figure.seconds / figure.frame_time)
    frames = np.unique(np.rint(np.linspace(0, last, min(phases, last + 1))).astype(int)).tolist()
    rows = [[artist.draw(frame * figure.frame_time) for frame in frames] for artist in artists]
    for image, frame in zip(rows[0], frames, strict=True):
        _label(image, figure, frame)
    sheet = np.concatenate([np.concatenate(row, axis=1) for row in rows])
    width = sheet.shape[1]
    scale = min(0.55, (width - 20) / max(text_size(title, 1.0)[0], 1))
    return np.concatenate([title_bar(title, width, scale), sheet])


def video_frames(artists: Sequence[Artist], rate: float, longest: float) -> Iterator[Image]:
    """Draw the artists' images side by side in real time: ``rate`` frames per second, ``longest`` seconds."""
    figure = artists[0].figure
    for number in range(_frame_count(figure, rate, longest)):
        time = number / rate
        images = [artist.draw(time) for artist in artists]
        _label(images[0], figure, round(time / figure.frame_time))
        yield np.concatenate(images, axis=1)


def _frame_count(figure: AnimatedFigure, rate: float, longest: float) -> int:
    """Number of frames of a video."""
    return max(1, int(min(figure.seconds, longest) * rate + 1e-6))


def _label(image: Image, figure: AnimatedFigure, frame: int) -> None:
    text = f"{frame * figure.frame_time:.2f} s, frame {frame}"
    draw_text(image, text, (8, 16), 0.38)


def write_motion_image(
    path: str | os.PathLike[str],
    artists: Sequence[Artist],
    title: str,
    phases: int = 8,
    rate: float | None = None,
    longest: float = 60.0,
    progress: Progress | None = None,
) -> None:
    """Write a strip of frames (.png) or a video (.mp4, .gif), atomically.

    Args:
        path: Output file. Its suffix chooses the format.
        artists: Artists that all draw the same motion. Their images are put together.
        title: Title of a strip.
        phases: Number of frames of a strip.
        rate: Frames per second of a video. If None, the rate of the motion, at most 60.
        longest: Longest video in seconds.
        progress: Shows the progress while a video is drawn.

    Raises:
        HumansimError: The suffix is unknown.
    """
    check_suffix(path)
    suffix, figure = Path(path).suffix.lower(), artists[0].figure
    if suffix == ".png":
        write_png(path, strip(artists, phases, title))
        return
    rate = float(np.clip(1 / figure.frame_time, 1.0, 60.0)) if rate is None else rate
    write, rate = (write_mp4, rate) if suffix == ".mp4" else (write_gif, min(rate, _GIF_RATE))
    frames = video_frames(artists, rate, longest)
    count = _frame_count(figure, rate, longest)
    with nullcontext(frames) if progress is None else progress(frames, count) as shown:
        write(path, shown, rate)


def check_suffix(path: str | os.PathLike[str]) -> None:
    """Raise HumansimError unless a file name has one of :data:`SUFFIXES`."""
    if Path(path).suffix.lower() not in SUFFIXES:
        text = "a motion is drawn as .png, .mp4 or .gif: give the file one of these names"
        raise HumansimError(text, path=path)


# --- humans at rest: from all sides, in their outfits, with their bones and weights

_REST_FOV = np.radians(24.0)


class HumanArtist:
    """Draws one human in its rest pose from any side, in images of ``size`` (width, height). ``shaded``:
    whether the human is lit. If False, its texture is shown unchanged."""

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
        distance = self._span / (2 * np.tan(_REST_FOV / 2))
        angle = np.radians(azimuth)
        eye = self._middle + distance * np.array([np.cos(angle), np.sin(angle), 0.1])
        return _looking(eye, self._middle, self._size, _REST_FOV)

    def draw(self, human: Human, azimuth: float) -> Image:
        """Render the human with its texture."""
        body = Body(human.mesh, self._vertices, human.triangle_parts, 1)
        return self._renderer.render([body], self.camera(azimuth), ("rgb",)).rgb

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
            color, (width, radius) = SIDE_COLORS[side_of(name)], (1, 1) if name in DETAIL_BONES else (2, 3)
            draw_line(image, [head, tail], color, width)
            draw_disc(image, head, radius, color)
        return image

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()


def bone_colors(count: int) -> Array:
    """Colours (B, 3) for the bones, 0 to 255."""
    number = np.arange(count)
    saturation, value = np.where(number % 2, 230, 150), np.where(number % 3, 240, 190)
    return hsv_colors(distinct_hues(count), saturation, value).astype(float)


def human_sheet(human: Human) -> Image:
    """Draw the human from eight sides, its bones and weights from four, and its outfits."""
    artist = HumanArtist(human)
    try:
        azimuths = range(0, 360, 45)
        turntable = [artist.draw(human, angle) for angle in azimuths]
        draws = artist.draw_bones, artist.draw_weights
        inside = [draw(human, angle) for draw in draws for angle in (0, 45, 90, 180)]
        labels = ["bones", "", "", "", "weights", "", "", ""]
        rows = [row(turntable, [f"{angle} degrees" for angle in azimuths]), row(inside, labels)]
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
