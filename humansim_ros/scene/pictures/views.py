"""Make views visible: colours for depth and labels, and joints drawn over images."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.motion.body import DETAIL_BONES, side_of
from humansim_ros.render.pictures import BRIGHT_SIDE_COLORS, distinct_hues, draw_disc, draw_line, hsv_colors
from humansim_ros.scene.truth.camera_truth import OUTSIDE, VISIBLE
from humansim_ros.types import Color, Image

if TYPE_CHECKING:
    from humansim_ros.render.interface import View

_VISIBLE_COLOR: Color = (60, 230, 90)
_HIDDEN_COLOR: Color = (255, 150, 40)
#: Size of the discs of fingers, toes, jaw and eyes, relative to the discs of other joints.
_DETAIL_SIZE = 0.5


def color_depth(depth: NDArray[np.float32]) -> Image:
    """Colour a depth image (H, W) in metres. Near is red, far is blue. Pixels without depth are black."""
    finite = np.isfinite(depth)
    if not finite.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    low, high = np.percentile(depth[finite], (0.5, 99.5))
    scaled = np.clip((high - np.where(finite, depth, high)) / max(high - low, 1e-9), 0, 1)
    image = cv2.applyColorMap(np.rint(255 * scaled).astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.ascontiguousarray(image[..., ::-1] * finite[..., None], dtype=np.uint8)


def color_labels(labels: NDArray[np.integer]) -> Image:
    """Colour a label image (H, W). Colours repeat after 255 labels. The label 0 is black."""
    palette = hsv_colors(distinct_hues(256), 190, np.where(np.arange(256) % 2, 255, 200))
    palette[0] = 0
    labels = labels.astype(np.intp)
    return palette[np.where(labels > 0, (labels - 1) % 255 + 1, 0)]


def color_image(image: NDArray[np.uint8], encoding: str = "rgb8") -> Image:
    """Convert the output of a sensor (rgb8, bgr8, mono8 or bayer_rggb8) to an RGB image (H, W, 3)."""
    if encoding == "bgr8":
        return np.ascontiguousarray(image[..., ::-1])
    if encoding == "bayer_rggb8":
        # OpenCV names the pattern after its second row
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BayerBG2RGB), dtype=np.uint8)
    return np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image


def color_channel(name: str, values: Any) -> Image:
    """Image (H, W, 3) of a channel of a view, for people.

    Depth: near is red, far is blue. Labels: one colour per label. Normals: x, y, z as red, green, blue.
    Texture coordinates: u, v as red, green. Flow: direction as hue, length as brightness. Masks: a colour for
    each human or object. Shadow: white where the light is blocked.

    ``values``: the channel, as in :class:`~humansim_ros.render.View`.
    """
    return _PICTURES[name](values)


def channel_picture(view: View, channel: str, encoding: str) -> Image:
    """Image (H, W, 3) that shows a channel of a view. ``encoding``: ROS encoding of the channel ``rgb``."""
    values = getattr(view, channel)
    return color_image(values, encoding) if channel == "rgb" else color_channel(channel, values)


def _color_masks(masks: Mapping[int, NDArray[Any]]) -> Image:
    """Colour masks or coverage images (bool, or 0 to 255) by label. Where masks overlap, the larger value of
    each colour component is taken."""
    colors = color_labels(np.array([list(masks)], np.intp))[0].astype(float)
    shape = next(iter(masks.values()), np.zeros((1, 1))).shape
    out = np.zeros((*shape, 3))
    for mask, color in zip(masks.values(), colors, strict=True):
        share = mask.astype(float) if mask.dtype == bool else mask / 255
        out = np.maximum(out, share[..., None] * color)
    return np.rint(out).astype(np.uint8)


def _color_normals(normals: NDArray[np.float32]) -> Image:
    has = normals.any(axis=2, keepdims=True)
    return np.asarray(np.rint(127.5 * (normals + 1)) * has, dtype=np.uint8)


def _color_coordinates(uv: NDArray[np.float32]) -> Image:
    red_green = np.nan_to_num(np.mod(uv, 1.0))
    return np.rint(255 * np.dstack([red_green, np.zeros_like(red_green[..., :1])])).astype(np.uint8)


def _color_flow(flow: NDArray[np.float32]) -> Image:
    x, y = np.moveaxis(np.nan_to_num(flow), -1, 0)
    length = np.hypot(x, y)
    longest = max(float(np.percentile(length, 99.5)), 1e-3)
    hue = np.mod(np.degrees(np.arctan2(y, x)), 360) / 2
    value = 255 * np.clip(length / longest, 0, 1)
    return hsv_colors(hue.ravel(), 200, value.ravel()).reshape(*hue.shape, 3)


def _grey(values: NDArray[np.uint8]) -> Image:
    return np.repeat(values[..., None], 3, axis=2)


_PICTURES: dict[str, Callable[[Any], Image]] = {
    "rgb": color_image,
    "depth": color_depth,
    "instance": color_labels,
    "part": color_labels,
    "body_part": color_labels,
    "material": color_labels,
    "face": color_labels,
    "normal": _color_normals,
    "uv": _color_coordinates,
    "flow": _color_flow,
    "flow_back": _color_flow,
    "flow_hidden": lambda hidden: _grey(255 * hidden),
    "flow_back_hidden": lambda hidden: _grey(255 * hidden),
    "alpha": _color_masks,
    "amodal": _color_masks,
    "shadow": _grey,
}


def draw_joints(
    image: Image,
    pixels: NDArray[np.floating],
    visible: NDArray[np.integer],
    names: Sequence[str],
    parents: Sequence[str | None],
    radius: float = 3,
) -> Image:
    """Draw joints over a copy of an image. Visible joints are filled discs, hidden joints circles.

    Args:
        image: Image (H, W, 3).
        pixels: Pixels of the joints, (J, 2). NaN for a joint without a pixel.
        visible: State, (J,): visible, hidden or outside (:mod:`humansim_ros.scene.truth.camera_truth`).
        names: Names of the joints, (J,). The prefix ``l_`` or ``r_`` chooses the colour of the line.
        parents: Name of each joint's parent, (J,), to which a line is drawn; None for no line.
        radius: Radius of the discs in pixels.
    """
    out = image.copy()
    pixel_of = {name: pixel for name, pixel in zip(names, pixels, strict=True) if np.isfinite(pixel).all()}
    sizes = {
        name: radius * (_DETAIL_SIZE if name.removesuffix("_end") in DETAIL_BONES else 1.0) for name in names
    }
    for name, parent in zip(names, parents, strict=True):
        if parent is not None and name in pixel_of and parent in pixel_of:
            width = max(1, round(0.6 * sizes[name]))
            draw_line(out, [pixel_of[parent], pixel_of[name]], BRIGHT_SIDE_COLORS[side_of(name)], width)
    for name, state in zip(names, visible, strict=True):
        if name in pixel_of and state != OUTSIDE:
            color, width = (_VISIBLE_COLOR, -1) if state == VISIBLE else (_HIDDEN_COLOR, 1)
            draw_disc(out, pixel_of[name], sizes[name], color, width)
    return out


def person_color(number: int) -> Color:
    """Bright colour of a person. ``number``: number of the person, from 0; colours of neighbours differ."""
    red, green, blue = hsv_colors(distinct_hues(number + 1)[-1:], 170, 235)[0]
    return int(red), int(green), int(blue)


def joint_colors(names: Sequence[str]) -> tuple[list[Color], Color, Color]:
    """Colours: of the line from each joint (J,) to its parent, of visible joints, and of hidden joints."""
    return [BRIGHT_SIDE_COLORS[side_of(name)] for name in names], _VISIBLE_COLOR, _HIDDEN_COLOR
