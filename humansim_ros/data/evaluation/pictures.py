"""Draw truth and estimate over images, for reports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.render.pictures import draw_disc, draw_line
from humansim_ros.scene.config import FIRST_STAMP
from humansim_ros.scene.core import Frame, Needs, Scene, Simulation
from humansim_ros.types import Array, Image

#: Colours of truth and estimate, as in the plots.
TRUTH_COLOR, ESTIMATE_COLOR = (0, 114, 178), (213, 94, 0)
#: Longest side of a drawn image in pixels. Ten such images have at most about 1 MB.
SIDE = 480
#: Margin of a cut-out around a person, as a share of the person's size; and smallest side of a cut-out,
#: pixels.
_MARGIN, _LEAST = 0.35, 48
_WHITE = (255, 255, 255)


class Pictures(Protocol):
    """Images of the cameras of a truth."""

    def cameras(self, stamp: int) -> Mapping[str, Camera]:
        """Cameras that have an image at a stamp in nanoseconds, by name."""

    def image(self, stamp: int, camera: str) -> Image | None:
        """Image (H, W, 3) RGB or (H, W) of a camera at a stamp; None if there is no image.

        Raises HumansimError if it cannot be rendered or read.
        """

    def close(self) -> None:
        """Free files and renderer."""


class ScenePictures(Pictures):
    """Images of a scene, rendered on demand."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._simulation: Simulation | None = None

    def cameras(self, stamp: int) -> dict[str, Camera]:
        frame = self._frame(stamp, ())
        return {
            name: camera.camera_at(frame.camera_poses[name]) if camera.moves else camera.camera
            for name, camera in self._scene.scene_cameras.items()
            if frame.index in camera.timing
        }

    def image(self, stamp: int, camera: str) -> Image | None:
        view = self._frame(stamp, (camera,)).views.get(camera)
        return None if view is None else view.rgb

    def close(self) -> None:
        if self._simulation is not None:
            self._simulation.close()
            self._simulation = None

    def _frame(self, stamp: int, cameras: Sequence[str]) -> Frame:
        if self._simulation is None:
            self._simulation = Simulation(self._scene, start=FIRST_STAMP)
        index = round((stamp - FIRST_STAMP) * 1e-9 * self._scene.config.rate)
        return self._simulation.frame(index, Needs(("rgb",), cameras))


@dataclass(frozen=True)
class Shape:
    """Points, lines, a box and a mask that are drawn in one colour.

    Attributes:
        color: RGB.
        points: (K, 2) pixels; NaN where a point is absent.
        edges: Pairs of points to connect.
        box: (4,) x, y of the upper left corner, width, height, pixels; or None.
        mask: (H, W) mask with the size of the image, or None. Only the outline is drawn.
    """

    color: tuple[int, int, int]
    points: Array = field(default_factory=lambda: np.zeros((0, 2)))
    edges: Sequence[tuple[int, int]] = ()
    box: Array | None = None
    mask: NDArray[np.bool_] | None = None

    def extent(self) -> Array:
        """Corners (N, 2) in pixels of everything that is drawn."""
        corners = [self.points[np.isfinite(self.points).all(axis=1)]]
        if self.box is not None:
            corners.append(np.array([self.box[:2], self.box[:2] + self.box[2:]]) - 0.5)
        if self.mask is not None and self.mask.any():
            rows, columns = np.nonzero(self.mask)
            corners.append(np.array([[columns.min(), rows.min()], [columns.max(), rows.max()]], float))
        return np.concatenate(corners)


def draw_over(image: Image, shapes: Sequence[Shape]) -> NDArray[np.uint8]:
    """Draw shapes over an image. Returns a cut-out around the shapes, (H, W, 3) RGB.

    The cut-out contains all shapes, as far as they are within the image.

    Args:
        image: (H, W, 3) RGB or (H, W) grey.
        shapes: What to draw, in this order.
    """
    height, width = image.shape[:2]
    extent = np.concatenate([np.zeros((0, 2)), *(shape.extent() for shape in shapes)])
    inside = extent[((extent >= -0.5) & (extent < [width, height])).all(axis=1)]
    left, top, right, bottom = _section(inside, width, height)
    section = np.ascontiguousarray(image[top:bottom, left:right])
    scale = SIDE / max(section.shape[:2])
    size = (max(1, round(section.shape[1] * scale)), max(1, round(section.shape[0] * scale)))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    canvas = np.asarray(cv2.resize(section, size, interpolation=method), np.uint8)
    canvas = np.repeat(canvas[..., None], 3, axis=2) if canvas.ndim == 2 else np.ascontiguousarray(canvas)
    for shape in shapes:
        if shape.mask is not None:
            mask = cv2.resize(
                shape.mask[top:bottom, left:right].astype(np.uint8), size, interpolation=cv2.INTER_NEAREST
            )
            outlines, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            cv2.drawContours(canvas, outlines, -1, _WHITE, 4, cv2.LINE_AA)
            cv2.drawContours(canvas, outlines, -1, shape.color, 2, cv2.LINE_AA)
    for shape in shapes:
        _draw(canvas, shape, np.array([left, top], float), scale)
    return canvas


def _section(points: Array, width: int, height: int) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the cut-out that shows some points. Without points, the whole image."""
    if not len(points):
        return 0, 0, width, height
    low, high = points.min(axis=0), points.max(axis=0)
    half = np.maximum((high - low) / 2 + _MARGIN * float((high - low).max()), _LEAST / 2)
    middle = (low + high) / 2
    left, top = np.maximum(np.floor(middle - half), 0).astype(int).tolist()
    right, bottom = np.minimum(np.ceil(middle + half) + 1, [width, height]).astype(int).tolist()
    return left, top, right, bottom


def _draw(canvas: NDArray[np.uint8], shape: Shape, corner: Array, scale: float) -> None:
    """Draw points, lines and a box of a shape. Each has a white edge, so that it is visible on any image."""

    def place(points: Array) -> Array:
        return (points - corner + 0.5) * scale - 0.5

    points = place(shape.points)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
    lines = [points[list(edge)] for edge in shape.edges if known[list(edge)].all()]
    if shape.box is not None:
        (left, top), (right, bottom) = place(np.array([shape.box[:2], shape.box[:2] + shape.box[2:]]) - 0.5)
        lines.append(np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]]))
    for color, wider in ((_WHITE, 2), (shape.color, 0)):
        for line in lines:
            draw_line(canvas, line, color, 2 + wider)
        for point in points[known]:
            draw_disc(canvas, point, 4 + wider / 2, color)
