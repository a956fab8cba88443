"""Outlines of bodies in photographs."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.types import Array

#: Largest width of the picture that outlines are found in, and bits behind the point of its coordinates.
_WIDTH, _BITS = 960, 4
#: Outlines with fewer pixels than this are left out; a line may be off by this number of pixels.
_LEAST, _TOLERANCE = 12, 0.6
#: Triangles that reach farther from the picture than this many times its size are left out.
_FAR = 4.0


def outlines(pixels: Array, triangles: NDArray[np.integer], size: tuple[int, int]) -> tuple[Array, ...]:
    """Closed lines (N, 2) around what triangles cover in an image.

    Args:
        pixels: (V, 2) vertices in the image; NaN for those that are not seen.
        triangles: (T, 3) numbers of vertices.
        size: Width and height of the image.
    """
    scale = min(1.0, _WIDTH / size[0])
    width, height = (max(1, round(side * scale)) for side in size)
    corners = (pixels[triangles] + 0.5) * scale - 0.5  # (T, 3, 2)
    reach = _FAR * max(width, height)
    with np.errstate(invalid="ignore"):
        seen = (np.abs(corners) < reach).all(axis=(1, 2))
    fixed = np.round(corners[seen] * (1 << _BITS)).astype(np.int32)
    mask = np.zeros((height, width), np.uint8)
    for triangle in fixed:
        cv2.fillConvexPoly(mask, triangle, (255,), cv2.LINE_8, _BITS)
    found, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return tuple(
        (cv2.approxPolyDP(line, _TOLERANCE, True)[:, 0].astype(float) + 0.5) / scale - 0.5
        for line in found
        if len(line) >= _LEAST
    )
