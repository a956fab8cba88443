"""The table of all channels: array formats, ROS topics and encodings, and what rendering them needs.

To add a channel: a row of :data:`CHANNEL_TABLE`, a field of :class:`View`, and a function that fills it in
rendered_frame.py. docs/ground_truth.md defines each channel.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

#: Name of an adjacent frame, as a keyword of :meth:`Renderer.render`.
AdjacentName = Literal["next_frame", "previous_frame"]
ADJACENT_NAMES: tuple[AdjacentName, ...] = ("next_frame", "previous_frame")
#: Rendering work besides depth and triangle ids: colour, outlines, each body without occluders.
Pass = Literal["lit", "outlined", "alone"]


@dataclass(frozen=True)
class Channel:
    """One channel.

    Attributes:
        name: Name of the channel and of its field in :class:`View`.
        dtype: Element type of the array.
        topic: ROS topic below the name of the camera; ``{body}`` stands for the name of a human or object.
        encoding: ROS image encoding; empty if the sensor of the camera defines it.
        components: Shape of one pixel: () or (C,).
        empty: Value of pixels that show nothing.
        default: The channel is rendered unless the caller names other channels.
        passes: Rendering passes that the channel needs.
        adjacent_frame: Frame that the channel compares with.
        occlusion: The adjacent frame has to be rendered too, to find what is hidden in it.
        per_body: There is one image for each labelled body.
        labels_bodies: The channel describes labelled bodies only. Those of static bodies are cached.
    """

    name: str
    dtype: type[np.generic]
    topic: str
    encoding: str
    components: tuple[int, ...] = ()
    empty: float = 0
    default: bool = False
    passes: frozenset[Pass] = frozenset()
    adjacent_frame: AdjacentName | None = None
    occlusion: bool = False
    per_body: bool = False
    labels_bodies: bool = False

    def empty_image(self, shape: tuple[int, ...]) -> NDArray[Any]:
        """Array (H, W, ...) of pixels that show nothing. ``shape``: (H, W)."""
        whole = (*shape, *self.components)
        return np.full(whole, self.empty, self.dtype) if self.empty else np.zeros(whole, self.dtype)


_LIT: frozenset[Pass] = frozenset({"lit"})
_OUTLINED: frozenset[Pass] = frozenset({"outlined"})
_ALONE: frozenset[Pass] = frozenset({"alone"})
_LABELS: dict[str, Any] = {"labels_bodies": True}
_PER_BODY: dict[str, Any] = {"labels_bodies": True, "per_body": True}
_NEXT: dict[str, Any] = {"adjacent_frame": "next_frame"}
_PREVIOUS: dict[str, Any] = {"adjacent_frame": "previous_frame"}
_HIDDEN: dict[str, Any] = {"empty": 1, "occlusion": True}

#: All channels by name.
CHANNEL_TABLE: dict[str, Channel] = {
    channel.name: channel
    for channel in (
        Channel("rgb", np.uint8, "image_raw", "", (3,), default=True, passes=_LIT | _OUTLINED),
        Channel("depth", np.float32, "depth/image", "32FC1", empty=np.inf, default=True),
        Channel("instance", np.uint16, "instance/image", "mono16", default=True, **_LABELS),
        Channel("part", np.uint8, "part/image", "mono8", default=True, **_LABELS),
        Channel("face", np.int32, "face/image", "32SC1", **_LABELS),
        Channel("normal", np.float32, "normal/image", "32FC3", (3,), **_LABELS),
        Channel("uv", np.float32, "uv/image", "32FC2", (2,), empty=np.nan, **_LABELS),
        Channel("flow", np.float32, "flow/image", "32FC2", (2,), empty=np.nan, **_NEXT),
        Channel("flow_hidden", np.uint8, "flow/hidden", "mono8", **_HIDDEN, **_NEXT),
        Channel("flow_back", np.float32, "flow_back/image", "32FC2", (2,), empty=np.nan, **_PREVIOUS),
        Channel("flow_back_hidden", np.uint8, "flow_back/hidden", "mono8", **_HIDDEN, **_PREVIOUS),
        Channel("alpha", np.uint8, "alpha/{body}/image", "mono8", passes=_OUTLINED, **_PER_BODY),
        Channel("amodal", np.bool_, "amodal/{body}/image", "mono8", passes=_ALONE, **_PER_BODY),
        Channel("shadow", np.uint8, "shadow/image", "mono8", passes=_LIT),
    )
}
#: Names of all channels that a renderer may support.
ALL_CHANNELS = tuple(CHANNEL_TABLE)
#: Names of the channels that are rendered by default.
CHANNELS = tuple(name for name, channel in CHANNEL_TABLE.items() if channel.default)


def comparing_with(frame: AdjacentName, channels: Collection[str] = ALL_CHANNELS) -> set[str]:
    """Return the channels that need the next or the previous frame."""
    compared = (name for name, channel in CHANNEL_TABLE.items() if channel.adjacent_frame == frame)
    return {name for name in compared if name in channels}


@dataclass(frozen=True, repr=False)
class View:
    """Channels of one camera at one stamp, on one pixel grid: (H, W, ...); None if not requested.

    ``rgb``: (H, W, 3) uint8 sRGB, anti-aliased; or the output of the camera's sensor. ``depth``: (H, W)
    float32 metres along z of the optical frame, +inf where nothing is. ``instance``: (H, W) uint16, ``part``:
    (H, W) uint8; 0 where no labelled body is. Labels and depth are sampled at pixel centers, never blended.

    ``face``: (H, W) int32, 1 + index of the triangle in the body's mesh, 0 where no labelled body is.
    ``normal``: (H, W, 3) float32, outward unit normal of that triangle in the optical frame, 0 where no body
    is. ``uv``: (H, W, 2) float32 texture coordinates of the body, v up, NaN where no body is.

    ``flow``, ``flow_back``: (H, W, 2) float32, displacement in pixels of the visible point to the next and
    the previous frame, NaN where nothing is. ``flow_hidden``, ``flow_back_hidden``: (H, W) uint8, 1 where
    that point is not visible there.

    ``alpha``: by instance, (H, W) uint8, coverage of each pixel by the body, 255 is full coverage.
    ``amodal``: by instance, (H, W) bool, mask of the body as if nothing occluded it. ``shadow``: (H, W)
    uint8, share of the direct light that bodies block, 255 is all of it; 0 where nothing is, and where no
    direct light would arrive without bodies.
    """

    rgb: NDArray[np.uint8] | None = None
    depth: NDArray[np.float32] | None = None
    instance: NDArray[np.uint16] | None = None
    part: NDArray[np.uint8] | None = None
    face: NDArray[np.int32] | None = None
    normal: NDArray[np.float32] | None = None
    uv: NDArray[np.float32] | None = None
    flow: NDArray[np.float32] | None = None
    flow_back: NDArray[np.float32] | None = None
    flow_hidden: NDArray[np.uint8] | None = None
    flow_back_hidden: NDArray[np.uint8] | None = None
    alpha: dict[int, NDArray[np.uint8]] | None = None
    amodal: dict[int, NDArray[np.bool_]] | None = None
    shadow: NDArray[np.uint8] | None = None

    def __repr__(self) -> str:
        channels = {name: value for name in CHANNEL_TABLE if (value := getattr(self, name)) is not None}
        images = (image for value in channels.values() for image in _images(value))
        size = next((f"{image.shape[1]}x{image.shape[0]}: " for image in images), "")
        return f"View({size}{', '.join(channels)})"


def _images(value: Any) -> Collection[NDArray[Any]]:
    """Images of a channel of a view."""
    return value.values() if isinstance(value, dict) else (value,)
