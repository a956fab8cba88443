"""Motions as people look at them: phases side by side, or a video, as stick figures and as skinned people."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from humansim_ros.camera import Camera
from humansim_ros.drawing.canvas import write_mp4, write_png
from humansim_ros.errors import HumansimError
from humansim_ros.humans.human import Human
from humansim_ros.io.files import atomic_path
from humansim_ros.motion.bvh import Motion
from humansim_ros.motion.info import headings, mean_heading
from humansim_ros.motion.retarget import Retargeter
from humansim_ros.motion.world_motion import WorldMotion, axis_vector, floor_height
from humansim_ros.render import Body, GLRenderer, Lighting
from humansim_ros.types import Array, Image

Seen = Literal["side", "front", "three-quarter"]
#: Shows how far a video is: (frames, how many) -> the frames, while it is drawn.
Watched = Callable[[Iterable[Image], int], AbstractContextManager[Iterable[Image]]]
SUFFIXES = (".png", ".mp4", ".gif")
#: Where the camera stands around the person, degrees from ahead to the left.
_AROUND = {"front": 0.0, "three-quarter": 40.0, "side": 90.0}
_PAPER, _INK, _GRID, _SHADE = (238, 240, 243), (60, 64, 72), (205, 209, 215), (196, 200, 206)
_LEFT, _RIGHT, _MIDDLE = (38, 116, 200), (206, 62, 92), (60, 64, 72)
_FOV = np.radians(30.0)
#: How many instants of a motion the camera's way is made of, and over how many seconds it is smoothed.
_INSTANTS, _SMOOTH = 1000, 0.4
#: What fits into a picture at most, by the height of the figure; the camera follows what goes beyond.
_WIDEST = 1.6
#: Instants that are looked at for what fits, and how much of a picture is to be used.
_FITTED, _INSIDE = 100, 0.94
#: A GIF counts in hundredths of a second, and browsers show no more frames than this per second.
_GIF_RATE = 20.0


@dataclass(frozen=True)
class StickFigure:
    """Something that moves, z up: ``points`` gives (N, P, 3) at N instants (seconds).

    ``height``: of it standing; ``floor``: the height it stands on; ``heading``: where it faces (radians, from
    +x to +y); ``cell``: from line to line on the floor.
    """

    points: Callable[[Array], Array]
    seconds: float
    frame_time: float
    height: float
    floor: float = 0.0
    heading: float = 0.0
    cell: float = 0.5


class Artist(Protocol):
    """Draws a figure as it is at an instant, seconds."""

    @property
    def figure(self) -> StickFigure: ...

    def draw(self, time: float) -> Image: ...

    def close(self) -> None: ...


class _Shot:
    """A camera that goes along with a figure, the same distance from it all the time, so that all of it is
    seen.
    """

    def __init__(self, figure: StickFigure, size: tuple[int, int], seen: Seen) -> None:
        self._figure, self._size = figure, size
        self._around = figure.heading + np.radians(_AROUND[seen])
        count = int(np.clip(figure.seconds / figure.frame_time + 1, 1, _INSTANTS))
        self._times: Array = np.linspace(0.0, figure.seconds, count, dtype=float)
        points = figure.points(self._times)
        step = max(figure.seconds / max(count - 1, 1), 1e-9)
        low, high = points.min(1), points.max(1)
        self._middle = _smoothed((low[:, :2] + high[:, :2]) / 2, _SMOOTH / step)
        tall = figure.height
        # jumps and raised arms are seen with the camera at rest; stairs are climbed by it
        top = high[:, 2] - figure.floor
        reach = float(np.clip(np.percentile(top, 99.5), 1.05 * tall, 1.3 * tall))
        self._lift = _smoothed(np.maximum(top - reach, 0.0)[:, None], _SMOOTH / step)[:, 0]
        self._span = 1.2 * reach
        widest = _WIDEST * self._span
        some = np.unique(np.linspace(0, count - 1, _FITTED).astype(int))
        for _ in range(3):
            outside = max(self._outside(points[i], self._times[i]) for i in some)
            self._span = min(self._span * max(1.0, outside), widest)

    def _outside(self, points: Array, time: float) -> float:
        """How far out the outermost of some points (P, 3) is in the picture; within 1 it is seen."""
        pixels, depth = self.camera(time).project(points)
        half = (np.array(self._size) - 1) / 2
        out = np.where(depth[:, None] > 0, np.abs(pixels / half - 1), 1.0)
        return float(out.max()) / _INSIDE

    def camera(self, time: float) -> Camera:
        x, y = (np.interp(time, self._times, way) for way in self._middle.T)
        lift = float(np.interp(time, self._times, self._lift))
        target = np.array([x, y, self._figure.floor + lift + 0.41 * self._span])
        away = self._span / (2 * np.tan(_FOV / 2))
        eye = target + away * np.array([np.cos(self._around), np.sin(self._around), 0.16])
        # the field of view is that of the height
        width, height = self._size
        fov = 2 * np.arctan(np.tan(_FOV / 2) * width / height)
        return Camera.look_at(tuple(eye), tuple(target), self._size, float(fov))

    def floor(self, camera: Camera, time: float) -> Image:
        """A floor of lines that stand still in the world."""
        image = np.full((self._size[1], self._size[0], 3), _PAPER, np.uint8)
        cell = self._figure.cell
        reach = cell * np.ceil(1.05 * self._span / cell)
        middle = np.array([np.interp(time, self._times, way) for way in self._middle.T])
        middle = np.round(middle / cell) * cell
        for step in np.arange(-reach, reach + cell / 2, cell):
            for axis in (0, 1):
                ends = np.full((2, 3), self._figure.floor)
                ends[:, axis] = middle[axis] + step
                ends[:, 1 - axis] = middle[1 - axis] + np.array([-reach, reach])
                _line(image, camera, ends, _GRID, 1)
        return image


def _smoothed(way: Array, sigma: float) -> Array:
    """A way (N, D) smoothed along N; at the ends it goes on as it went."""
    sigma = min(sigma, len(way))
    pad = min(len(way) - 1, int(np.ceil(3 * sigma)))
    if pad < 1:
        return way
    padded = np.pad(way, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
    return np.asarray(gaussian_filter1d(padded, sigma, axis=0)[pad:-pad])


def _line(image: Image, camera: Camera, ends: Array, color: tuple[int, int, int], width: int) -> None:
    """A line between two points (2, 3), unless some of it is behind the camera."""
    pixels, depth = camera.project(ends)
    if (depth > 0).all():
        start, end = _fixed(pixels)
        cv2.line(image, start, end, color, width, cv2.LINE_AA, 4)


def _fixed(pixels: Array) -> list[list[int]]:
    """Pixels in sixteenths, OpenCV's finest."""
    fixed: list[list[int]] = np.rint(np.clip(pixels, -1e4, 1e4) * 16).astype(int).tolist()
    return fixed


class Sticks:
    """Draws a motion's joints and their links: left blue, right red."""

    def __init__(
        self,
        figure: StickFigure,
        parents: NDArray[np.intp],
        sides: NDArray[np.intp],
        size: tuple[int, int],
        seen: Seen,
    ) -> None:
        self.figure = figure
        self._parents, self._sides = parents, sides
        self._shot = _Shot(figure, size, seen)

    @classmethod
    def of_world(cls, world: WorldMotion, size: tuple[int, int], seen: Seen = "three-quarter") -> Sticks:
        """A person in the world."""
        figure = StickFigure(
            lambda times: world.sample(times).positions,
            world.duration,
            world.motion.frame_time,
            1.05 * world.frame.stature,
            heading=_heading(world),
        )
        roles = {joint: role for role, joint in world.match.roles.items()}
        sides = _sides(world.names, world.motion.parents, roles)
        return cls(figure, world.motion.parents, sides, size, seen)

    @classmethod
    def of_file(
        cls, motion: Motion, size: tuple[int, int], seen: Seen = "three-quarter", up: str | None = None
    ) -> Sticks:
        """Something that is no person, in the file's own axes turned so that ``up`` is up; MotionError if it
        has no size. Up is y, as in most files, unless it is much longer along z.
        """
        points = motion.world_positions()
        extent = np.ptp(points, axis=1).mean(0)
        upward = axis_vector(up or ("z" if extent[2] > 2 * extent[1] else "y"))
        turn = np.stack([np.roll(np.abs(upward), 1), np.roll(upward, 2), upward])
        points = points @ turn.T
        size_ = float(np.ptp(points, axis=1).max())
        if not 0 < size_ < np.inf:
            raise HumansimError(
                "there is nothing to draw: all joints are at one place, or at none", path=motion.path
            )
        points = points / size_
        figure = StickFigure(
            lambda times: points[np.rint(times / motion.frame_time).astype(int).clip(0, len(points) - 1)],
            motion.duration,
            motion.frame_time,
            1.05,
            floor_height(points[..., 2].min(1)),
            cell=0.25,
        )
        sides = _sides(motion.joint_names, motion.parents, {})
        return cls(figure, motion.parents, sides, size, seen)

    def draw(self, time: float) -> Image:
        points = self.figure.points(np.array([time]))[0]
        camera = self._shot.camera(time)
        image = self._shot.floor(camera, time)
        linked = [(joint, int(parent)) for joint, parent in enumerate(self._parents) if parent >= 0]
        shadow = points * (1, 1, 0) + (0, 0, self.figure.floor)
        for joint, parent in linked:
            _line(image, camera, shadow[[parent, joint]], _SHADE, 2)
        pixels, depth = camera.project(points)
        colors = {1: _LEFT, -1: _RIGHT, 0: _MIDDLE}
        for joint, parent in sorted(linked, key=lambda link: -depth[link[0]]):
            _line(image, camera, points[[parent, joint]], colors[int(self._sides[joint])], 2)
        for joint in np.argsort(-depth):
            if depth[joint] > 0:
                color = colors[int(self._sides[joint])]
                cv2.circle(image, _fixed(pixels)[joint], 2 * 16 + 8, color, -1, cv2.LINE_AA, 4)
        return image

    def close(self) -> None:
        pass


class Skinned:
    """Draws the body that a motion drives."""

    def __init__(
        self, human: Human, world: WorldMotion, size: tuple[int, int], seen: Seen = "three-quarter"
    ) -> None:
        self._human, self._world = human, world
        self._retargeter = Retargeter.fit(world, human.skeleton)
        skeleton = human.skeleton

        def points(times: Array) -> Array:
            posed = self._retargeter.pose(world.sample(times))
            tails = posed[..., :3, 3] + posed[..., :3, 1] * skeleton.lengths[:, None]
            return np.concatenate([posed[..., :3, 3], tails], axis=1)

        self.figure = StickFigure(
            points,
            world.duration,
            world.motion.frame_time,
            1.05 * float(skeleton.tails[:, 1].max()),
            heading=_heading(world),
        )
        self._shot = _Shot(self.figure, size, seen)
        # the light comes from ahead wherever that is
        ahead = Rotation.from_euler("z", self.figure.heading).apply(Lighting.sun)
        self._renderer = GLRenderer([], Lighting(sun=tuple(ahead), background=_PAPER))

    def draw(self, time: float) -> Image:
        human = self._human
        camera = self._shot.camera(time)
        vertices = human.pose(self._retargeter.pose(self._world.sample(time))[0])
        view = self._renderer.render(
            [Body(human.mesh, vertices, human.triangle_parts, 1)], camera, ("rgb", "instance")
        )
        assert view.rgb is not None
        assert view.instance is not None
        # shadow, and the body's own edge, darken the paper: let them darken the floor
        floor = self._shot.floor(camera, time)
        shaded = np.clip(np.rint(floor * (view.rgb / np.array(_PAPER))), 0, 255).astype(np.uint8)
        return np.where(view.instance[..., None] > 0, view.rgb, shaded)

    def close(self) -> None:
        self._renderer.close()


def _heading(world: WorldMotion) -> float:
    """Where a person faces on average; if that is all ways, where it faces first."""
    poses = world.sample(np.linspace(0.0, world.duration, 200))
    heading = mean_heading(world.match, poses)
    if heading is not None:
        return heading
    x, y = headings(world.match, poses)[0]
    return float(np.arctan2(y, x))


def _sides(names: Sequence[str], parents: NDArray[np.intp], roles: dict[int, str]) -> NDArray[np.intp]:
    """1 left, -1 right, 0 neither (J,), by role or by name; what says nothing is as its parent."""
    sides = np.zeros(len(names), np.intp)
    for joint, name in enumerate(names):
        said = roles.get(joint, name).lower()
        if "left" in said or said.startswith("l_") or said.endswith((".l", "_l")):
            sides[joint] = 1
        elif "right" in said or said.startswith("r_") or said.endswith((".r", "_r")):
            sides[joint] = -1
        elif parents[joint] >= 0 and joint not in roles:
            sides[joint] = sides[parents[joint]]
    return sides


def strip(artists: Sequence[Artist], phases: int, title: str) -> Image:
    """Frames of a motion side by side, first and last among them, a row for each artist."""
    figure = artists[0].figure
    last = round(figure.seconds / figure.frame_time)
    frames = np.unique(np.rint(np.linspace(0, last, min(phases, last + 1))).astype(int)).tolist()
    rows = [[artist.draw(frame * figure.frame_time) for frame in frames] for artist in artists]
    for image, frame in zip(rows[0], frames, strict=True):
        _label(image, figure, frame)
    sheet = np.concatenate([np.concatenate(row, axis=1) for row in rows])
    head = np.full((34, sheet.shape[1], 3), 255, np.uint8)
    (wide, _), _ = cv2.getTextSize(title, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 1)
    scale = min(0.55, (sheet.shape[1] - 20) / max(wide, 1))
    cv2.putText(head, title, (10, 23), cv2.FONT_HERSHEY_SIMPLEX, scale, _INK, 1, cv2.LINE_AA)
    return np.concatenate([head, sheet])


def video_frames(artists: Sequence[Artist], rate: float, longest: float) -> Iterator[Image]:
    """The artists' pictures side by side, at a rate, as fast as the motion is."""
    figure = artists[0].figure
    for number in range(frame_count(figure, rate, longest)):
        time = number / rate
        images = [artist.draw(time) for artist in artists]
        _label(images[0], figure, round(time / figure.frame_time))
        yield np.concatenate(images, axis=1)


def frame_count(figure: StickFigure, rate: float, longest: float) -> int:
    """How many frames a video has."""
    return max(1, int(min(figure.seconds, longest) * rate + 1e-6))


def _label(image: Image, figure: StickFigure, frame: int) -> None:
    text = f"{frame * figure.frame_time:.2f} s, frame {frame}"
    cv2.putText(image, text, (8, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)


def write_motion_picture(
    path: str | os.PathLike[str],
    artists: Sequence[Artist],
    title: str,
    phases: int = 8,
    rate: float | None = None,
    longest: float = 60.0,
    watched: Watched | None = None,
) -> None:
    """A strip (.png) or a video (.mp4, .gif), whole or not at all. ``rate``: frames per second of a video;
    the motion's own if None, up to 60. ``watched``: shows how far a video is.
    """
    check_suffix(path)
    suffix = Path(path).suffix.lower()
    if suffix == ".png":
        write_png(path, strip(artists, phases, title))
        return
    figure = artists[0].figure
    rate = float(np.clip(1 / figure.frame_time, 1.0, 60.0)) if rate is None else rate
    rate = rate if suffix == ".mp4" else min(rate, _GIF_RATE)
    write = write_mp4 if suffix == ".mp4" else _write_gif
    frames = video_frames(artists, rate, longest)
    if watched is None:
        write(path, frames, rate)
        return
    with watched(frames, frame_count(figure, rate, longest)) as counted:
        write(path, counted, rate)


def check_suffix(path: str | os.PathLike[str]) -> None:
    """HumansimError for a file of a kind that no motion is drawn as."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise HumansimError(
            "a motion is drawn as .png, .mp4 or .gif: give the file one of these names", path=path
        )


def _write_gif(path: str | os.PathLike[str], frames: Iterable[Image], rate: float) -> None:
    """Write RGB frames of one size as a GIF with colours of its own for each frame, whole or not at all."""
    import imageio_ffmpeg

    iterator = iter(frames)
    first = next(iterator)
    palette = "split[a][b];[a]palettegen=stats_mode=single[p];[b][p]paletteuse=new=1:dither=none"
    with atomic_path(Path(path)) as temporary:
        writer = imageio_ffmpeg.write_frames(
            str(temporary),
            (first.shape[1], first.shape[0]),
            fps=rate,
            codec="gif",
            pix_fmt_out="pal8",
            macro_block_size=1,
            quality=None,
            output_params=["-filter_complex", palette],
            ffmpeg_log_level="error",
        )
        writer.send(None)
        try:
            for frame in (first, *iterator):
                writer.send(np.ascontiguousarray(frame))
        finally:
            writer.close()
