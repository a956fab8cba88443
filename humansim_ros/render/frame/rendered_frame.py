"""Rendered images of the static scene and of frames, and the channels computed from these images."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import moderngl
import numpy as np
from numpy.typing import NDArray

from humansim_ros.cameras.camera import Camera
from humansim_ros.files.mesh import SKIN, Mesh, with_hair
from humansim_ros.render.device.pixel_geometry import PixelGeometry, VisiblePixels, optical_flow
from humansim_ros.render.device.target import Rectangle, RenderTarget
from humansim_ros.render.frame.edge_antialiasing import EdgeCrossings, blend
from humansim_ros.render.frame.shadows import ShadowInputs
from humansim_ros.render.interface.channels import CHANNEL_TABLE, AdjacentName, Pass, View
from humansim_ros.render.interface.renderer import AdjacentFrame, Backdrop, Body
from humansim_ros.types import Float32Array, Indices

#: Adjacent frames by name, each with its rendered images, which channels of occlusion need.
AdjacentFrames = Mapping[AdjacentName, tuple[AdjacentFrame, "RenderedFrame | None"]]


class _Drawn(NamedTuple):
    """Drawn triangles (M,) of one body of the frame. ``mesh``: mesh of a human; None for an object."""

    number: int
    instance: int
    parts: NDArray[np.uint8]
    mesh: Mesh | None
    triangles: Indices

    def full(self, value: int) -> NDArray[Any]:
        """(M,) the same value for all triangles."""
        return np.full(len(self.triangles), value)

    def materials(self) -> NDArray[Any]:
        """(M,) label of the material of each triangle. 0 for objects."""
        if self.mesh is None or not self.instance:
            return self.full(0)
        return self.mesh.triangle_materials[self.triangles]

    def off_body(self) -> NDArray[Any]:
        """(M,) whether each triangle belongs to an off-body surface of a human."""
        if self.mesh is None or self.mesh.off_body is None:
            return self.full(0)
        return self.mesh.triangles_off_body[self.triangles]


#: Values that are looked up by triangle id, by name of the channel: type, and function that returns the
#: values (M,) of drawn triangles. Not channels: ``owner``, the index of the body; ``triangle``, the index in
#: the mesh; ``off_body``, whether the triangle belongs to an off-body surface.
_TABLES: dict[str, tuple[type[np.generic], Callable[[_Drawn], NDArray[Any]]]] = {
    "instance": (np.uint16, lambda drawn: drawn.full(drawn.instance)),
    "part": (np.uint8, lambda drawn: drawn.parts[drawn.triangles]),
    "body_part": (np.uint8, lambda drawn: drawn.parts[drawn.triangles]),
    "material": (np.uint8, _Drawn.materials),
    "off_body": (np.bool_, _Drawn.off_body),
    "owner": (np.intp, lambda drawn: drawn.full(drawn.number)),
    "triangle": (np.intp, lambda drawn: drawn.triangles),
    "face": (np.int32, lambda drawn: (drawn.triangles + 1) * (drawn.instance > 0)),
}


class TriangleIds:
    """Triangles that the ids of one image stand for. Id 0 is no body; id n is the n-th drawn triangle."""

    def __init__(self) -> None:
        self.count = 1
        self._bodies: list[_Drawn] = []

    def add(self, number: int, body: Body, triangles: Indices) -> None:
        """Append the drawn triangles (M,) of a body. ``number``: index of the body in the frame."""
        self.count += len(triangles)
        mesh = body.mesh if body.kind == "human" else None
        self._bodies.append(_Drawn(number, body.instance, body.parts, mesh, triangles))

    def table(self, name: str) -> NDArray[Any]:
        """Return the values of a channel by triangle id, see ``_TABLES``."""
        kind, values = _TABLES[name]
        return np.concatenate([np.zeros(1, kind), *(values(drawn).astype(kind) for drawn in self._bodies)])


class StaticLayer:
    """Image of the static scene from one camera. It is a copy, so that the target is free afterwards.
    ``rgba``: (H, W, 4). If None, the layer has depths only."""

    def __init__(
        self,
        target: RenderTarget,
        rgba: NDArray[np.uint8] | None,
        backdrop: Backdrop | None = None,
        shadow_inputs: ShadowInputs | None = None,
    ) -> None:
        self.rgba, self.shadow_inputs = rgba, shadow_inputs
        self._backdrop = backdrop  # a reference is kept, since caches use the id of the backdrop as its key
        #: labels of the static bodies, once a frame has needed them
        self.labels: StaticLabels | None = None
        depth = target.read("depth", lit=True)
        self.depth_buffer = target.read_depth_buffer()
        #: copies of both images on the device, which frames start from
        self.kept: moderngl.Framebuffer | None = None
        #: (H, W) metres, +inf where nothing is
        self.depth = np.where(depth > 0, depth, np.float32(np.inf))

    def images(self, channels: Collection[str]) -> dict[str, NDArray[Any]]:
        """Return new arrays of the channels of an image without bodies."""
        made: dict[str, NDArray[Any]] = {}
        for channel in (CHANNEL_TABLE[name] for name in channels):
            if channel.name == "depth":
                made["depth"] = self.depth.copy()
            elif channel.name == "rgb" and self.rgba is not None:
                made["rgb"] = cv2.cvtColor(self.rgba, cv2.COLOR_RGBA2RGB)
            elif not (channel.per_body or channel.adjacent_frame):
                made[channel.name] = channel.empty_image(self.depth.shape)
        return made


@dataclass(eq=False)
class RenderedFrame:
    """Images of the bodies that one camera sees. They cover ``rectangle``, the part of the image that bodies
    may touch.

    It holds no reference to the bodies. ``rgba``, ``outline``, ``alone`` and ``body_part`` are None if their
    rendering pass was not requested. ``triangle_ids``: (h, w), see :class:`TriangleIds`. ``depth``: (h, w)
    metres, 0 where no body is. ``rgba``: (h, w, 4), within ``coloured``, which includes shadows; alpha is the
    share of direct light that bodies let through. ``outline``: crossings of outlines with pixels. ``alone``:
    by instance, (H, W) mask of the body without occluders. ``static_labels``: labels of the static bodies.
    ``body_part``: (H, W) part labels without off-body surfaces such as skirts, hats and long hair; None if no
    pixel shows such a surface.
    """

    passes: frozenset[Pass]
    instances: tuple[int, ...]
    camera: Camera
    layer: StaticLayer
    rectangle: Rectangle
    coloured: Rectangle
    ids: TriangleIds
    triangle_ids: NDArray[np.uint32]
    depth: Float32Array
    rgba: NDArray[np.uint8] | None
    outline: EdgeCrossings | None
    alone: Mapping[int, NDArray[np.bool_]] | None
    static_labels: StaticLabels | None = None
    body_part: NDArray[np.uint8] | None = None
    _geometry: PixelGeometry | None = field(default=None, init=False)

    @cached_property
    def whole_depth(self) -> Float32Array:
        """(H, W) depth of bodies and static scene, metres, read-only. It is +inf where nothing is."""
        whole: Float32Array = self.layer.images(("depth",))["depth"]
        np.copyto(whole[self.rectangle.slices], self.depth, where=self.depth > 0)
        whole.setflags(write=False)
        return whole

    def _depth_at(self, pixels: Indices) -> Float32Array:
        """Depth (N,) of some pixels of the whole image, without a copy of the whole image."""
        depth = self.layer.depth.take(pixels)
        row = pixels // self.camera.size[0]  # divmod takes several times as long
        column = pixels - row * self.camera.size[0] - self.rectangle.x0
        row -= self.rectangle.y0
        height, width = self.rectangle.shape
        within = np.flatnonzero((row >= 0) & (row < height) & (column >= 0) & (column < width))
        own = self.depth.take(row[within] * width + column[within])
        covered = np.flatnonzero(own > 0)
        depth[within[covered]] = own[covered]
        return depth

    @property
    def nbytes(self) -> int:
        """Approximate memory of the images, bytes."""
        pixels, own = self.camera.size[0] * self.camera.size[1], self.triangle_ids.size
        images = sum(image.nbytes for image in (self.rgba, self.body_part) if image is not None)
        masks, depth = pixels * len(self.alone or ()), 4 * pixels * ("whole_depth" in vars(self))
        return images + masks + depth + own * (8 if self._geometry is None else 72)

    def geometry(self, bodies: Sequence[Body]) -> PixelGeometry:
        """Return the surface points that the pixels show. ``bodies``: the bodies that were rendered."""
        if self._geometry is None:
            pixels = np.flatnonzero(self.triangle_ids > 0)
            ids = self.triangle_ids.ravel().take(pixels)
            row, column = np.divmod(pixels, max(self.rectangle.shape[1], 1))
            pixels = (row + self.rectangle.y0) * self.camera.size[0] + column + self.rectangle.x0
            owner, triangle = (self.ids.table(name).take(ids) for name in ("owner", "triangle"))
            self._geometry = PixelGeometry(self.camera, bodies, VisiblePixels(pixels, owner, triangle))
        return self._geometry

    def view(self, bodies: Sequence[Body], channels: Collection[str], adjacent: AdjacentFrames) -> View:
        """Return channels of the whole image. ``adjacent``: adjacent frames that the channels need."""
        images: dict[str, Any] = self.layer.images(channels)
        if self.static_labels is not None:
            images |= self.static_labels.images(channels)
        for name, fill in _FILL.items():
            if name in channels or name in images:
                fill(self, name, images, bodies)
        blended = [*([images["rgb"]] if "rgb" in images else []), *images.get("alpha", {}).values()]
        if self.outline is not None and blended:
            here, beside = self._depth_at(self.outline.pixel), self._depth_at(self.outline.neighbour)
            blend(blended, here, beside, self.outline)
        for which, (frame, other) in adjacent.items():
            depth, touched = None, self.rectangle.slices
            if other is not None:
                depth, touched = other.whole_depth, other.rectangle.slices
            geometry = self.geometry(bodies)
            flow = optical_flow(self.camera, geometry, self.whole_depth, frame, depth, touched)
            name = "flow" if which == "next_frame" else "flow_back"
            images[name], images[f"{name}_hidden"] = flow.flow, flow.hidden
        return View(**{name: images[name] for name in channels})


class StaticLabels:
    """Label images of the static bodies from one camera. Each channel is computed once and cached."""

    def __init__(self, frame: RenderedFrame, bodies: Sequence[Body]) -> None:
        self.passes = frame.passes
        self._frame, self._bodies = frame, bodies
        self._images: dict[str, Any] = {}

    def images(self, channels: Collection[str]) -> dict[str, Any]:
        """Return copies of the images of those channels that describe labelled bodies."""
        names = {name for name in channels if CHANNEL_TABLE[name].labels_bodies}
        for name in names - self._images.keys():
            self._images[name] = getattr(self._frame.view(self._bodies, (name,), {}), name)
        return {name: deepcopy(self._images[name]) for name in names}


_Fill = Callable[[RenderedFrame, str, dict[str, Any], Sequence[Body]], None]


def _fill_depth(frame: RenderedFrame, name: str, images: dict[str, Any], _: Sequence[Body]) -> None:
    np.copyto(images[name][frame.rectangle.slices], frame.depth, where=frame.depth > 0)


def _fill_from_ids(frame: RenderedFrame, name: str, images: dict[str, Any], _: Sequence[Body]) -> None:
    within, values = frame.rectangle.slices, frame.ids.table(name).take(frame.triangle_ids)
    if frame.static_labels is None:
        images[name][within] = values
    else:
        np.copyto(images[name][within], values, where=frame.triangle_ids > 0)


def _fill_body_part(frame: RenderedFrame, name: str, images: dict[str, Any], bodies: Sequence[Body]) -> None:
    if frame.body_part is None:
        _fill_from_ids(frame, name, images, bodies)
    else:
        images[name] = frame.body_part.copy()


def _fill_rgb(frame: RenderedFrame, name: str, images: dict[str, Any], _: Sequence[Body]) -> None:
    if frame.rgba is not None and frame.rgba.size:
        # many times faster than an assignment of three channels out of four
        images[name][frame.coloured.slices] = cv2.cvtColor(frame.rgba, cv2.COLOR_RGBA2RGB)


def _fill_shadow(frame: RenderedFrame, name: str, images: dict[str, Any], _: Sequence[Body]) -> None:
    if frame.rgba is not None:
        images[name][frame.coloured.slices] = 255 - frame.rgba[..., 3]


def _fill_alpha(frame: RenderedFrame, name: str, images: dict[str, Any], _: Sequence[Body]) -> None:
    """Fill in the coverage of each body without anti-aliasing: 255 where the pixel center shows the body."""
    within, instances = frame.rectangle.slices, images.get("instance")
    static = images.get(name, {})
    for alpha in static.values():
        alpha[within][frame.triangle_ids > 0] = 0
    if instances is None:
        instances = frame.layer.images(("instance",))["instance"]
        instances[within] = frame.ids.table("instance").take(frame.triangle_ids)
    labels = (instance for instance in frame.instances if instance)
    images[name] = {label: (instances == label).view(np.uint8) * np.uint8(255) for label in labels} | static


def _fill_from_points(
    frame: RenderedFrame, name: str, images: dict[str, Any], bodies: Sequence[Body]
) -> None:
    geometry = frame.geometry(bodies)
    values = geometry.normals() if name == "normal" else geometry.texture_coordinates()
    images[name].reshape(-1, values.shape[1])[geometry.visible.pixels] = values


def _fill_material(frame: RenderedFrame, name: str, images: dict[str, Any], bodies: Sequence[Body]) -> None:
    _fill_from_ids(frame, name, images, bodies)
    geometry = frame.geometry(bodies)
    labels, visible = images[name].reshape(-1), geometry.visible
    if not (labels[visible.pixels] == SKIN).any():
        return
    uv = geometry.texture_coordinates()
    for number, body in enumerate(bodies):
        if body.kind == "human" and body.mesh.hair_texels is not None:
            own = np.flatnonzero(visible.owner == number)
            pixels = visible.pixels[own]
            labels[pixels] = with_hair(labels[pixels], uv[own], body.mesh.hair_texels)


def _fill_amodal(frame: RenderedFrame, name: str, images: dict[str, Any], _: Sequence[Body]) -> None:
    if frame.alone is not None:
        moving = {instance: mask.copy() for instance, mask in frame.alone.items()}
        images[name] = moving | images.get(name, {})


#: Functions that draw the bodies into the image of each channel, except optical flow. Labels come first,
#: since alpha needs them.
_FILL: dict[str, _Fill] = {
    "depth": _fill_depth,
    "instance": _fill_from_ids,
    "part": _fill_from_ids,
    "body_part": _fill_body_part,
    "material": _fill_material,
    "face": _fill_from_ids,
    "rgb": _fill_rgb,
    "shadow": _fill_shadow,
    "alpha": _fill_alpha,
    "normal": _fill_from_points,
    "uv": _fill_from_points,
    "amodal": _fill_amodal,
}
