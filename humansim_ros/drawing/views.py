"""Views made for people: colours for depth and labels, joints drawn over images, contact sheets, videos."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.body.skeleton import side_of
from humansim_ros.truth.joints import OUTSIDE, VISIBLE
from humansim_ros.types import Image

_SEEN, _HIDDEN = (60, 230, 90), (255, 150, 40)
#: Colours of left, right and trunk.
_SIDES = {1: (80, 170, 255), -1: (255, 110, 150), 0: (250, 220, 90)}


def color_depth(depth: NDArray[np.float32]) -> Image:
    """(H, W, 3) of depth (H, W) in metres: near is red, far is blue, nothing is black."""
    finite = np.isfinite(depth)
    if not finite.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.percentile(depth[finite], (0.5, 99.5))
    scaled = np.clip((high - np.where(finite, depth, high)) / max(high - low, 1e-9), 0, 1)
    image = cv2.applyColorMap(np.rint(255 * scaled).astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.ascontiguousarray(image[..., ::-1] * finite[..., None], dtype=np.uint8)


def color_labels(labels: NDArray[np.integer]) -> Image:
    """(H, W, 3) of labels (H, W): every label its own colour (after 255 they come again), 0 black."""
    number = np.arange(256)
    hue = (number * 0.61803398875 % 1 * 180).astype(np.uint8)
    value = np.where(number % 2, 255, 200).astype(np.uint8)
    hsv = np.stack([hue, np.full(256, 190, np.uint8), value], axis=-1)[None]
    palette = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0]
    palette[0] = 0
    labels = labels.astype(np.intp)
    return np.asarray(palette[np.where(labels > 0, (labels - 1) % 255 + 1, 0)], dtype=np.uint8)


def draw_joints(
    image: Image,
    pixels: NDArray[np.floating],
    visible: NDArray[np.integer],
    names: Sequence[str],
    parents: Sequence[str | None],
) -> Image:
    """A copy of an image (H, W, 3) with joints (J, 2) drawn: filled where visible, rings where hidden.

    ``names``: (J,) joint names, whose ``l_`` and ``r_`` choose the colour; ``parents``: (J,) name of the
    joint that each one's line comes from.
    """
    out = image.copy()
    at = {name: pixel for name, pixel in zip(names, pixels, strict=True) if np.isfinite(pixel).all()}
    # in sixteenths of a pixel, OpenCV's finest; its pixel centres are integers, as ours
    fixed = {
        name: tuple(int(v) for v in np.rint(np.clip(pixel, -1e4, 1e4) * 16)) for name, pixel in at.items()
    }
    for name, parent in zip(names, parents, strict=True):
        if parent is not None and name in fixed and parent in fixed:
            cv2.line(out, fixed[parent], fixed[name], _SIDES[side_of(name)], 2, cv2.LINE_AA, 4)
    for name, state in zip(names, visible, strict=True):
        if name in fixed and state != OUTSIDE:
            if state == VISIBLE:
                cv2.circle(out, fixed[name], 3 * 16, _SEEN, -1, cv2.LINE_AA, 4)
            else:
                cv2.circle(out, fixed[name], 3 * 16, _HIDDEN, 1, cv2.LINE_AA, 4)
    return out


def contact_sheet(
    rows: Sequence[Sequence[Image]], titles: Sequence[str], labels: Sequence[str], width: int = 480
) -> Image:
    """Images in a grid, scaled to ``width``: a title above each column, a label in the corner of each row."""
    lines = [_strip([_fit(image, width) for image in row]) for row in rows]
    for line, label in zip(lines, labels, strict=True):
        cv2.putText(
            line, label, (12, line.shape[0] - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 4, cv2.LINE_AA
        )
        cv2.putText(
            line,
            label,
            (12, line.shape[0] - 14),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.6,
            (255, 255, 255),
            1,
            cv2.LINE_AA,
        )
    head = np.full((40, lines[0].shape[1], 3), 28, np.uint8)
    for column, title in enumerate(titles):
        cv2.putText(
            head,
            title,
            (column * (width + 4) + 12, 27),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.62,
            (235, 235, 235),
            1,
            cv2.LINE_AA,
        )
    gap = np.full((4, lines[0].shape[1], 3), 28, np.uint8)
    return np.concatenate([head, *[part for line in lines for part in (line, gap)]])


def _strip(images: Sequence[Image]) -> Image:
    gap = np.full((images[0].shape[0], 4, 3), 28, np.uint8)
    return np.concatenate([part for image in images for part in (image, gap)][:-1], axis=1)


def _fit(image: Image, width: int) -> Image:
    height = round(image.shape[0] * width / image.shape[1])
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
