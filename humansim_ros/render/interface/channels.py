"""The table of all channels (kinds of images): array formats, ROS topics, encodings, rendering passes.

To add a channel, add a row to :data:`CHANNEL_TABLE`, a field to :class:`View`, and to rendered_frame.py a
function that draws it. docs/ground_truth.md defines each channel.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import ChannelError, RenderError
from humansim_ros.pictures import Pictured

#: Name of an adjacent frame, as a keyword of :meth:`Renderer.render`.
AdjacentName = Literal["next_frame", "previous_frame"]
ADJACENT_NAMES: tuple[AdjacentName, ...] = ("next_frame", "previous_frame")
#: Extra rendering passes, in addition to depth and triangle ids: colour, outlines, each body without
#: occluders, and all bodies without off-body surfaces.
Pass = Literal["lit", "outlined", "alone", "uncovered"]


@dataclass(frozen=True)
class Channel:
    """One channel: a kind of image, such as ``depth``, that a renderer makes.

    Attributes:
        name: Name of the channel and of its field in :class:`View`.
        dtype: Element type of the array.
        topic: ROS topic under the name of the camera. ``{body}`` stands for the name of a human or object.
        encoding: ROS image encoding; empty if the sensor of the camera defines it.
        components: Shape of one pixel: () or (C,).
        empty: Value of pixels that show nothing.
        default: Whether the channel is rendered when the caller names no channels.
        passes: Rendering passes that the channel needs.
        adjacent_frame: The frame that the channel compares this frame with: the next or the previous one.
            None: it compares none.
        occlusion: Whether the adjacent frame must be rendered too, to find the surfaces that are hidden in
            that frame.
        per_body: Whether there is one image for each labelled body.
        labels_bodies: Whether the channel describes labelled bodies only. Its images of static bodies are
            cached.
        rectified_topic: ROS topic of the channel without lens distortion; empty if there is none.
    """

    name: str
    dtype: type[np.generic]
    topic: str
    encoding: str
    components: tuple[int, ...] = ()
    empty: float = 0
    default: bool = False
    passes: tuple[Pass, ...] = ()
    adjacent_frame: AdjacentName | None = None
    occlusion: bool = False
    per_body: bool = False
    labels_bodies: bool = False
    rectified_topic: str = ""

    def empty_image(self, shape: tuple[int, ...]) -> NDArray[Any]:
        """Create an array (H, W, ...) of pixels that show nothing. ``shape``: (H, W)."""
        whole = (*shape, *self.components)
        return np.full(whole, self.empty, self.dtype) if self.empty else np.zeros(whole, self.dtype)


_COLOUR: tuple[Pass, ...] = ("lit", "outlined")
_LABELS: dict[str, Any] = {"labels_bodies": True}
_PER_BODY: dict[str, Any] = {"labels_bodies": True, "per_body": True}
_NEXT: dict[str, Any] = {"adjacent_frame": "next_frame"}
_PREVIOUS: dict[str, Any] = {"adjacent_frame": "previous_frame"}
_HIDDEN: dict[str, Any] = {"empty": 1, "occlusion": True}
_RECTIFIED: dict[str, Any] = {"default": True, "rectified_topic": "image_rect"}
_RECTIFIED_DEPTH: dict[str, Any] = {"default": True, "rectified_topic": "depth/image_rect"}

#: All channels by name.
CHANNEL_TABLE: dict[str, Channel] = {
    channel.name: channel
    for channel in (
        Channel("rgb", np.uint8, "image_raw", "", (3,), passes=_COLOUR, **_RECTIFIED),
        Channel("depth", np.float32, "depth/image", "32FC1", empty=np.inf, **_RECTIFIED_DEPTH),
        Channel("instance", np.uint16, "instance/image", "mono16", default=True, **_LABELS),
        Channel("part", np.uint8, "part/image", "mono8", default=True, **_LABELS),
        Channel("body_part", np.uint8, "body_part/image", "mono8", passes=("uncovered",), **_LABELS),
        Channel("material", np.uint8, "material/image", "mono8", **_LABELS),
        Channel("face", np.int32, "face/image", "32SC1", **_LABELS),
        Channel("normal", np.float32, "normal/image", "32FC3", (3,), **_LABELS),
        Channel("uv", np.float32, "uv/image", "32FC2", (2,), empty=np.nan, **_LABELS),
        Channel("flow", np.float32, "flow/image", "32FC2", (2,), empty=np.nan, **_NEXT),
        Channel("flow_hidden", np.uint8, "flow/hidden", "mono8", **_HIDDEN, **_NEXT),
        Channel("flow_back", np.float32, "flow_back/image", "32FC2", (2,), empty=np.nan, **_PREVIOUS),
        Channel("flow_back_hidden", np.uint8, "flow_back/hidden", "mono8", **_HIDDEN, **_PREVIOUS),
        Channel("alpha", np.uint8, "alpha/{body}/image", "mono8", passes=("outlined",), **_PER_BODY),
        Channel("amodal", np.bool_, "amodal/{body}/image", "mono8", passes=("alone",), **_PER_BODY),
        Channel("shadow", np.uint8, "shadow/image", "mono8", passes=("lit",)),
    )
}
#: Names of all channels that a renderer may support.
ALL_CHANNELS = tuple(CHANNEL_TABLE)
#: Names of the channels that are rendered by default.
CHANNELS = tuple(name for name, channel in CHANNEL_TABLE.items() if channel.default)


def check_channels(channels: Collection[str]) -> None:
    """Raise RenderError for a name that is not a channel."""
    if unknown := sorted(set(channels) - set(CHANNEL_TABLE)):
        raise RenderError(f"no such channel: {', '.join(unknown)}; there are {', '.join(ALL_CHANNELS)}")


def passes_of(channels: Collection[str]) -> frozenset[Pass]:
    """Return the rendering passes that channels need."""
    return frozenset(name for channel in channels for name in CHANNEL_TABLE[channel].passes)


def comparing_with(frame: AdjacentName, channels: Collection[str] = ALL_CHANNELS) -> set[str]:
    """Return those channels that compare their frame with the next or the previous frame."""
    return {
        name for name in channels if name in CHANNEL_TABLE and CHANNEL_TABLE[name].adjacent_frame == frame
    }


class View(Pictured):
    """Channels of one camera at one stamp, on one pixel grid: arrays (H, W, ...).

    A view has only the channels that were requested; ``channels`` lists them. Access to another channel
    raises :class:`~humansim_ros.errors.ChannelError`, which says how to request it.

    Attributes:
        rgb: (H, W, 3) uint8 sRGB, anti-aliased; or the output of the camera's sensor.
        depth: (H, W) float32 metres along z of the optical frame, +inf where nothing is. Labels and depth are
            sampled at pixel centers, never blended.
        instance: (H, W) uint16 label of the human or labelled object; 0 where none is.
        part: (H, W) uint8 label of the body part; 0 where no labelled body is.
        body_part: Like ``part``, but without the off-body surfaces of humans (:attr:`Mesh.off_body`): skirts,
            hats, bags, long hair.
        material: (H, W) uint8 label of skin, eyes, hair, a garment or a worn thing
            (:data:`humansim_ros.files.mesh.mesh.MATERIALS`); 0 where no human is.
        face: (H, W) int32, 1 + index of the triangle in the body's mesh, 0 where no labelled body is.
        normal: (H, W, 3) float32, outward unit normal of the triangle in ``face``, in the optical frame; 0
            where no body is.
        uv: (H, W, 2) float32 texture coordinates of the body, v up, NaN where no body is.
        flow: (H, W, 2) float32, displacement in pixels of the visible point to the next frame, NaN where
            nothing is.
        flow_back: Like ``flow``, but to the previous frame.
        flow_hidden: (H, W) uint8, 1 where the point that ``flow`` follows is not visible in the next frame.
        flow_back_hidden: Like ``flow_hidden``, but in the previous frame.
        alpha: By instance, (H, W) uint8, coverage of each pixel by the body, 255 is full coverage.
        amodal: By instance, (H, W) bool, mask of the body as if nothing occluded it.
        shadow: (H, W) uint8, share of the direct light that bodies block, from 0 to 255. Also 0 where there
            is no surface, and where no direct light would arrive without bodies.
    """

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]
    instance: NDArray[np.uint16]
    part: NDArray[np.uint8]
    body_part: NDArray[np.uint8]
    material: NDArray[np.uint8]
    face: NDArray[np.int32]
    normal: NDArray[np.float32]
    uv: NDArray[np.float32]
    flow: NDArray[np.float32]
    flow_back: NDArray[np.float32]
    flow_hidden: NDArray[np.uint8]
    flow_back_hidden: NDArray[np.uint8]
    alpha: dict[int, NDArray[np.uint8]]
    amodal: dict[int, NDArray[np.bool_]]
    shadow: NDArray[np.uint8]

    def __init__(self, **channels: Any) -> None:
        """``channels``: arrays by name of the channel; None stands for a channel that was not requested."""
        if unknown := channels.keys() - CHANNEL_TABLE.keys():
            raise TypeError(
                f"no channel {', '.join(sorted(unknown))}; the channels are {', '.join(ALL_CHANNELS)}"
            )
        self.__dict__.update({name: value for name, value in channels.items() if value is not None})

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels that this view has."""
        return tuple(name for name in CHANNEL_TABLE if name in self.__dict__)

    def with_channels(self, **channels: Any) -> View:
        """Return a copy of the view with other arrays for some channels."""
        return View(**{**self.__dict__, **channels})

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError("a view cannot be changed; with_channels makes a changed copy")

    if not TYPE_CHECKING:  # type checkers know all attributes from the annotations

        def __getattr__(self, name: str) -> Any:
            if name in CHANNEL_TABLE:
                raise missing_channels(name, [name], self.channels)
            raise AttributeError(f"a view has no {name!r}; the channels are {', '.join(ALL_CHANNELS)}")

    def __repr__(self) -> str:
        images = (image for name in self.channels for image in _images(getattr(self, name)))
        size = next((f"{image.shape[1]}x{image.shape[0]}: " for image in images), "")
        return f"View({size}{', '.join(self.channels)})"


def missing_channels(what: str, needed: Collection[str], present: Collection[str]) -> ChannelError:
    """Create the error that channels were not requested. Its text names the arguments that request them.
    ``what``: what needs the channels, such as ``frame.joints``. ``needed``: names of the channels that it
    needs. ``present``: names of the channels that were requested."""
    absent = [name for name in needed if name not in present]
    wanted = tuple(name for name in CHANNEL_TABLE if name in {*present, *needed})
    text = ", ".join(f'"{name}"' for name in wanted) + "," * (len(wanted) == 1)
    listed = f"channel {absent[0]} was" if len(absent) == 1 else f"channels {', '.join(absent)} were"
    return ChannelError(f"the {listed} not requested: use Simulation(scene, channels=({text}))", key=what)


def _images(value: Any) -> Collection[NDArray[Any]]:
    """The images of one channel of a view: one image, or one for each body."""
    return value.values() if isinstance(value, dict) else (value,)
