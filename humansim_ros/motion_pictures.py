"""Motions as people look at them: phases side by side, or a video, as stick figures and as skinned people."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.body import Human
from humansim_ros.camera import Camera
from humansim_ros.errors import HumansimError
from humansim_ros.files import atomic_path
from humansim_ros.motion.bvh import Motion
from humansim_ros.motion.retarget import Retargeter
from humansim_ros.motion.world import WorldMotion
from humansim_ros.pictures import Image, write_mp4, write_png
from humansim_ros.render import Body, GLRenderer
from humansim_ros.rotations import Array

Seen = Literal["side", "front", "three-quarter"]
#: Where the camera stands around the person, degrees from ahead to the left.
_AROUND = {"front": 0.0, "three-quarter": 40.0, "side": 90.0}
_PAPER, _INK, _GRID = (238, 240, 243), (60, 64, 72), (205, 209, 215)
_LEFT, _RIGHT, _MIDDLE = (38, 116, 200), (206, 62, 92), (60, 64, 72)
_FOV = np.radians(30.0)
#: Metres between the lines of the floor.
_CELL = 0.5


@dataclass(frozen=True)
class Figure:
    """A motion as lines: joint positions at any time (seconds) in a space with z up, and how tall it is."""

    names: Sequence[str]
    parents: NDArray[np.intp]
    sides: NDArray[np.intp]
    positions: Callable[[float], Array]
    seconds: float
    height: float
    floor: float

    @classmethod
    def of_world(cls, world: WorldMotion) -> Figure:
        """A person in the world."""
        sides = _sides(world.names, {joint: role for role, joint in world.match.roles.items()})
        return cls(
            world.names,
            world.motion.parents,
            sides,
            lambda time: world.sample(time).positions[0],
            float(world.duration),
            1.1 * world.frame.stature,
            0.0,
        )

    @classmethod
    def of_file(cls, motion: Motion) -> Figure:
        """Something that is no person, y up: as most files have it."""
        turn = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
        points = motion.world_positions() @ turn.T
        size = float(np.ptp(points, axis=1).max()) or 1.0

        def at(time: float) -> Array:
            return np.asarray(points[min(round(time / motion.frame_time), len(points) - 1)] / size)

        floor = float(points[..., 2].min()) / size
        return cls(
            motion.joint_names,
            motion.parents,
            _sides(motion.joint_names, {}),
            at,
            motion.duration,
            1.1,
            floor,
        )


def _sides(names: Sequence[str], roles: dict[int, str]) -> NDArray[np.intp]:
    """1 left, -1 right, 0 neither (J,), by role or by name."""

    def side(number: int, name: str) -> int:
        said = roles.get(number, name).lower()
        if "left" in said or said.startswith("l_") or said.endswith((".l", "_l")):
            return 1
        return -1 if "right" in said or said.startswith("r_") or said.endswith((".r", "_r")) else 0

    return np.array([side(number, name) for number, name in enumerate(names)])


class Painter:
    """Draws a motion at any time, as a stick figure or skinned, from a camera that goes along."""

    def __init__(
        self,
        figure: Figure,
        size: tuple[int, int],
        seen: Seen,
        skin: tuple[Human, WorldMotion, Retargeter] | None = None,
    ) -> None:
        self.figure = figure
        self.size = size
        self._seen = np.radians(_AROUND[seen])
        self._skin = skin
        self._renderer = None if skin is None else GLRenderer([])

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()

    def sticks(self, time: float) -> Image:
        """The joints and their links."""
        points = self.figure.positions(time)
        camera = self._camera(points, self.figure.height)
        image = self._floor(camera, points)
        pixels, depth = camera.project(points)
        fixed = np.rint(np.clip(pixels, -1e4, 1e4) * 16).astype(int)
        order = np.argsort(-depth)
        colors = {1: _LEFT, -1: _RIGHT, 0: _MIDDLE}
        for joint in order:
            parent = int(self.figure.parents[joint])
            if parent >= 0 and depth[joint] > 0 and depth[parent] > 0:
                color = colors[int(self.figure.sides[joint])]
                cv2.line(image, fixed[parent].tolist(), fixed[joint].tolist(), color, 2, cv2.LINE_AA, 4)
        for joint in order:
            if depth[joint] > 0:
                color = colors[int(self.figure.sides[joint])]
                cv2.circle(image, fixed[joint].tolist(), 2 * 16 + 8, color, -1, cv2.LINE_AA, 4)
        return image

    def skinned(self, time: float) -> Image:
        """The body that the motion drives."""
        assert self._skin is not None
        assert self._renderer is not None
        human, world, retargeter = self._skin
        poses = world.sample(time)
        posed = retargeter.pose(poses)[0]
        camera = self._camera(posed[:, :3, 3], 1.1 * float(human.skeleton.tails[:, 1].max()))
        body = Body(human.mesh, human.pose(posed), human.triangle_parts, 1)
        view = self._renderer.render([body], camera, ("rgb", "instance"))
        assert view.rgb is not None
        assert view.instance is not None
        floor = self._floor(camera, posed[:, :3, 3])
        # the edge pixels of the body are blended with the background they were drawn on: take a margin of it
        mask = cv2.dilate((view.instance > 0).astype(np.uint8), np.ones((3, 3), np.uint8))[..., None] > 0
        return np.where(mask, view.rgb, floor)

    def _camera(self, points: Array, height: float) -> Camera:
        """Looks at where a figure of some height is on the floor."""
        center = (points.min(0) + points.max(0)) / 2
        away = height / (2 * np.tan(_FOV / 2)) * 1.25
        target = np.array([center[0], center[1], self.figure.floor + 0.48 * height])
        eye = target + away * np.array([np.cos(self._seen), np.sin(self._seen), 0.16])
        width, tall = self.size
        # the field of view is that of the height
        fov = 2 * np.arctan(np.tan(_FOV / 2) * width / tall)
        return Camera.look_at(tuple(eye), tuple(target), self.size, float(fov))

    def _floor(self, camera: Camera, points: Array) -> Image:
        """A floor of lines half a metre apart that stand still in the world."""
        image = np.full((self.size[1], self.size[0], 3), _PAPER, np.uint8)
        cell = _CELL * self.figure.height / 1.87
        middle = np.round(points[:, :2].mean(0) / cell) * cell
        reach = 4 * cell
        for step in np.arange(-reach, reach + cell / 2, cell):
            for axis in (0, 1):
                ends = np.full((2, 3), self.figure.floor)
                ends[:, axis] = middle[axis] + step
                ends[:, 1 - axis] = middle[1 - axis] + np.array([-reach, reach])
                pixels, depth = camera.project(ends)
                if (depth > 0).all():
                    fixed = np.rint(np.clip(pixels, -1e4, 1e4) * 16).astype(int).tolist()
                    cv2.line(image, fixed[0], fixed[1], _GRID, 1, cv2.LINE_AA, 4)
        return image


def painter_of(
    motion: Motion,
    world: WorldMotion | None,
    human: Human | None,
    size: tuple[int, int],
    seen: Seen = "three-quarter",
) -> Painter:
    """Draws a person (``world``) as sticks and, with a ``human``, skinned; or what is no person as sticks."""
    if world is None:
        return Painter(Figure.of_file(motion), size, seen)
    skin = None if human is None else (human, world, Retargeter.fit(world, human.skeleton))
    return Painter(Figure.of_world(world), size, seen, skin)


def strip(painter: Painter, phases: int, title: str) -> Image:
    """Phases of a motion side by side: stick figures above, skinned below."""
    times = np.linspace(0.0, painter.figure.seconds, phases) if painter.figure.seconds > 0 else np.zeros(1)
    rows = [[_labelled(painter.sticks(time), f"{time:.2f} s") for time in times]]
    if painter._skin is not None:
        rows.append([painter.skinned(time) for time in times])
    sheet = np.concatenate([np.concatenate(row, axis=1) for row in rows])
    head = np.full((34, sheet.shape[1], 3), 255, np.uint8)
    cv2.putText(head, title, (10, 23), cv2.FONT_HERSHEY_SIMPLEX, 0.55, _INK, 1, cv2.LINE_AA)
    return np.concatenate([head, sheet])


def video_frames(painter: Painter, rate: float, longest: float) -> Iterator[Image]:
    """Sticks and skin side by side, at a rate."""
    seconds = min(painter.figure.seconds, longest)
    for number in range(max(1, int(seconds * rate))):
        time = number / rate
        parts = [_labelled(painter.sticks(time), f"{time:.2f} s")]
        if painter._skin is not None:
            parts.append(painter.skinned(time))
        yield np.concatenate(parts, axis=1)


def _labelled(image: Image, text: str) -> Image:
    cv2.putText(image, text, (8, image.shape[0] - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.42, _INK, 1, cv2.LINE_AA)
    return image


def write_motion_picture(
    path: str | os.PathLike[str],
    painter: Painter,
    title: str,
    phases: int = 8,
    rate: float = 30.0,
    longest: float = 60.0,
    watched: Callable[[Iterable[Image], int], AbstractContextManager[Iterable[Image]]] | None = None,
) -> None:
    """A strip (.png) or a video (.mp4, .gif), whole or not at all. ``watched``: shows how far a video is."""
    suffix = Path(path).suffix.lower()
    if suffix == ".png":
        write_png(path, strip(painter, phases, title))
        return
    if suffix not in (".mp4", ".gif"):
        raise HumansimError(
            "a motion is drawn as .png, .mp4 or .gif: give the file one of these names", path=path
        )
    rate = rate if suffix == ".mp4" else min(rate, 15.0)
    frames: Iterable[Image] = video_frames(painter, rate, longest)
    count = max(1, int(min(painter.figure.seconds, longest) * rate))
    if watched is None:
        _write_video(path, frames, rate)
    else:
        with watched(frames, count) as counted:
            _write_video(path, counted, rate)


def _write_video(path: str | os.PathLike[str], frames: Iterable[Image], rate: float) -> None:
    if Path(path).suffix.lower() == ".mp4":
        write_mp4(path, frames, rate)
        return
    import imageio_ffmpeg

    iterator = iter(frames)
    first = next(iterator)
    with atomic_path(Path(path)) as temporary:
        writer = imageio_ffmpeg.write_frames(
            str(temporary),
            (first.shape[1], first.shape[0]),
            fps=rate,
            codec="gif",
            pix_fmt_out="rgb8",
            macro_block_size=1,
            quality=None,
            ffmpeg_log_level="error",
        )
        writer.send(None)
        try:
            for frame in (first, *iterator):
                writer.send(np.ascontiguousarray(frame))
        finally:
            writer.close()
