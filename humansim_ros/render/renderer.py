"""What a renderer is given and what it gives back, whatever draws the pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.errors import RenderError
from humansim_ros.mesh.mesh import Mesh

#: What is rendered unless one says otherwise.
CHANNELS = ("rgb", "depth", "instance", "part")
#: Channels that follow from the triangle each pixel shows.
DETAILS = ("face", "normal", "uv")
#: Channels that need to know what stands where in the next frame, and in the one before.
FLOWS = {
    "flow": "next_frame",
    "flow_hidden": "next_frame",
    "flow_back": "previous_frame",
    "flow_back_hidden": "previous_frame",
}
_WHEN = {"next_frame": "after", "previous_frame": "before"}
#: Channels with one image for each labelled body.
PER_BODY = ("alpha", "amodal")
#: Every channel a renderer can be asked for; docs/ground_truth.md defines each.
ALL_CHANNELS = (*CHANNELS, *DETAILS, *FLOWS, *PER_BODY, "shadow")

#: What a body is.
Kind = Literal["human", "object"]


@dataclass(frozen=True)
class Body:
    """A moving surface as it stands in one frame.

    ``mesh``: its topology and looks (its own vertices are not used). ``vertices``: (V, 3) float32, ``map``,
    metres. ``parts``: (N,) uint8 part label of each of ``mesh.triangles``, 0 of those that have none.
    ``instance``: label of this body and of no other, 1 to 65535; or 0 for one that has no label, only colour,
    depth and shadow: those need a mesh of their own each. ``kind``: what it is, labelled or not. Make a new
    Body for a new frame: renderers keep what they worked out of one.
    """

    mesh: Mesh
    vertices: NDArray[np.float32]
    parts: NDArray[np.uint8]
    instance: int
    kind: Kind = "human"


@dataclass(frozen=True)
class AdjacentFrame:
    """What a camera has before it at another moment: the same bodies, in the same order."""

    bodies: Sequence[Body]
    camera: Camera


@dataclass(frozen=True)
class View:
    """What one camera sees: (H, W, ...) arrays on one pixel grid; None for a channel that was not asked for.

    ``rgb``: (H, W, 3) uint8 sRGB, anti-aliased, or what the camera's sensor makes of it. ``depth``: (H, W)
    float32 metres along z of the optical frame, +inf where nothing is. ``instance``: (H, W) uint16, ``part``:
    (H, W) uint8; 0 where no labelled body is.
    Labels and depth are those of the pixel's centre, never blended.

    ``face``: (H, W) int32, 1 + the triangle of the body's mesh, 0 where no labelled body is. ``normal``:
    (H, W, 3) float32, the outward unit normal of the body's triangle there in the optical frame, 0 where none
    is. ``uv``: (H, W, 2) float32 texture coordinates of the body, v up, NaN where none is. ``flow``,
    ``flow_back``: (H, W, 2) float32, pixels from here to where the point shown is in the next and the
    previous frame, NaN where nothing is; ``flow_hidden``, ``flow_back_hidden``: (H, W) uint8, 1 where that
    point cannot be seen there. ``alpha``: by instance, (H, W) uint8, how much of each pixel the body covers,
    255 all of it. ``amodal``: by instance, (H, W) bool, where the body would be if nothing hid it.

    ``shadow``: (H, W) uint8, how much of the direct light bodies take away, 255 all of it; 0 where nothing
    is, and where there would be none without them.
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


class Backdrop(Protocol):
    """What a camera sees where nothing is."""

    def picture(self, camera: Camera) -> NDArray[np.uint8]:
        """(H, W, 3) uint8 sRGB of the size of the camera's image."""
        ...


class Renderer(Protocol):
    """Draws bodies in a static scene as a camera sees them. ``channels``: those that it can be asked for."""

    @property
    def channels(self) -> Collection[str]: ...

    def render(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        channels: Collection[str] = CHANNELS,
        moving_camera: bool = False,
        next_frame: AdjacentFrame | None = None,
        previous_frame: AdjacentFrame | None = None,
        backdrop: Backdrop | None = None,
    ) -> View:
        """The asked channels of one view.

        ``moving_camera``: the static scene is redrawn, not cached. ``next_frame``, ``previous_frame``: for
        the channels of flow. ``backdrop``: the image behind everything; a plain colour if None.

        Raises RenderError if a channel is unknown, lacks what it needs, or vertices are not finite.
        """
        ...

    def close(self) -> None:
        """Free what the renderer holds."""
        ...


def check_request(bodies: Sequence[Body], channels: Collection[str]) -> None:
    """RenderError for a channel nobody draws or a body that cannot be drawn."""
    unknown = set(channels) - set(ALL_CHANNELS)
    if unknown:
        known = ", ".join(ALL_CHANNELS)
        raise RenderError(f"no such channel: {', '.join(sorted(unknown))}; there are {known}")
    labels = Counter(body.instance for body in bodies if body.instance)
    things = [id(body.mesh) for body in bodies if not body.instance]
    if len(set(things)) < len(things):
        raise RenderError("two bodies without a label cannot share a mesh")
    for body in bodies:
        if body.vertices.shape != body.mesh.vertices.shape:
            raise RenderError(
                f"vertices of shape {body.vertices.shape} do not fit a mesh of {len(body.mesh.vertices)}"
            )
        if not np.isfinite(body.vertices).all():
            raise RenderError(f"a vertex of body {body.instance} is not finite (NaN or infinity)")
        if not 0 <= body.instance < 65536:
            raise RenderError(f"an instance label must be 0 to 65535, not {body.instance}")
        if labels[body.instance] > 1:
            raise RenderError(f"two bodies cannot be told apart: instance label {body.instance} twice")
        if body.parts.shape != (len(body.mesh.triangles),):
            n = len(body.mesh.triangles)
            raise RenderError(f"part labels of shape {body.parts.shape} do not fit a mesh of {n} triangles")


def check_adjacent_frames(
    bodies: Sequence[Body], channels: Collection[str], moments: Mapping[str, AdjacentFrame | None]
) -> None:
    """RenderError where a channel of flow lacks the frame it needs, or that frame has other bodies."""
    for channel in set(channels) & set(FLOWS):
        which = FLOWS[channel]
        moment = moments[which]
        if moment is None:
            raise RenderError(f"{channel} needs the frame {_WHEN[which]} this one")
        if [body.vertices.shape for body in moment.bodies] != [body.vertices.shape for body in bodies]:
            raise RenderError(f"the frame {_WHEN[which]} this one has other bodies")
        check_request(moment.bodies, ())
