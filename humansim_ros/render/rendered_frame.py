"""A picture as it was drawn, and every channel that follows from it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from humansim_ros.camera import Camera
from humansim_ros.render.channels import CHANNEL_TABLE, View
from humansim_ros.render.edge_antialiasing import EdgeCrossings, blend
from humansim_ros.render.pixel_geometry import PixelGeometry, VisiblePixels, optical_flow
from humansim_ros.render.renderer import AdjacentFrame, Body
from humansim_ros.render.target import Rectangle, StaticLayer
from humansim_ros.types import Float32Array, Indices


class Passes(NamedTuple):
    """What a picture is drawn for besides depth and labels: colour, outlines, each body as if alone."""

    lit: bool
    outlined: bool
    alone: bool

    @classmethod
    def by(cls, channels: Collection[str]) -> Passes:
        """Passes that channels need."""
        needed = {name for channel in channels for name in CHANNEL_TABLE[channel].passes}
        return cls(*(name in needed for name in cls._fields))

    def covers(self, other: Passes) -> bool:
        """Whether what was drawn for this serves the other."""
        return all(has or not wants for has, wants in zip(self, other, strict=True))


class TriangleIds:
    """The triangles drawn of one picture's bodies: label 0 is no body, label n the n-th triangle drawn."""

    def __init__(self) -> None:
        self.count = 1
        self._drawn: list[tuple[Body, Indices]] = []

    def add(self, body: Body, drawn: Indices) -> None:
        """The triangles ``drawn`` (M,) of the next body."""
        self.count += len(drawn)
        self._drawn.append((body, drawn))

    def table(self, channel: str) -> NDArray[Any]:
        """What each label is in a channel, or as ``owner`` and ``triangle``."""
        make: dict[str, Callable[[int, Body, Indices], NDArray[Any]]] = {
            "instance": lambda _, body, drawn: np.full(len(drawn), body.instance, np.uint16),
            "part": lambda _, body, drawn: body.parts[drawn],
            "owner": lambda number, _, drawn: np.full(len(drawn), number, np.intp),
            "triangle": lambda _, __, drawn: drawn,
            "face": lambda _, body, drawn: ((drawn + 1) * (body.instance > 0)).astype(np.int32),
        }
        kind = CHANNEL_TABLE[channel].dtype if channel in CHANNEL_TABLE else np.intp
        found = (make[channel](number, *one) for number, one in enumerate(self._drawn))
        return np.concatenate([np.zeros(1, kind), *found])


@dataclass(frozen=True, eq=False)
class RenderedFrame:
    """Bodies as they were drawn before a camera, within the rectangle that they can touch.

    ``labels``: (h, w), see :class:`TriangleIds`. ``depth``: (h, w) metres, 0 where no body is. ``rgba``:
    (h, w, 4), alpha is the share of light that bodies leave. ``outline``: where outlines cross pixels.
    ``alone``: by instance, (H, W) mask of the body without occluders. Each is None unless it is in ``asked``.
    ``standing``: the labelled part of the static scene of ``layer``.
    """

    asked: Passes
    bodies: Sequence[Body]
    camera: Camera
    layer: StaticLayer
    rectangle: Rectangle
    seen: TriangleIds
    labels: NDArray[np.uint32]
    depth: Float32Array
    rgba: NDArray[np.uint8] | None
    outline: EdgeCrossings | None
    alone: Mapping[int, NDArray[np.bool_]] | None
    standing: RenderedFrame | None = None

    @cached_property
    def whole_depth(self) -> Float32Array:
        """(H, W) metres, of what is still as well; infinite where nothing is; not to be changed."""
        whole: Float32Array = self.layer.view(("depth",))["depth"]
        np.copyto(whole[self.rectangle.slices], self.depth, where=self.depth > 0)
        return whole

    @property
    def nbytes(self) -> int:
        """About how much memory it takes."""
        pixels = self.camera.size[0] * self.camera.size[1]
        known = {"whole_depth": 4 * pixels, "_detail": 64 * self.labels.size}
        masks = 0 if self.alone is None else pixels * len(self.alone)
        return 12 * self.labels.size + masks + sum(size for name, size in known.items() if name in vars(self))

    @cached_property
    def _detail(self) -> PixelGeometry:
        there = np.flatnonzero(self.labels > 0)
        label = self.labels.ravel().take(there)
        row, column = np.divmod(there, max(self.rectangle.shape[1], 1))
        pixels = (row + self.rectangle.y0) * self.camera.size[0] + column + self.rectangle.x0
        owner, triangle = (self.seen.table(name).take(label) for name in ("owner", "triangle"))
        return PixelGeometry(self.camera, self.bodies, VisiblePixels(pixels, owner, triangle))

    def view(
        self, channels: Collection[str], others: Mapping[str, tuple[AdjacentFrame, RenderedFrame | None]]
    ) -> View:
        """The channels of the whole image. ``others``: the frames after and before that flow needs, and their
        pictures, which what is hidden needs.
        """
        view = self._still({*channels, "depth"} if self.outline is not None else channels)
        within = self.rectangle.slices
        if "depth" in view:
            np.copyto(view["depth"][within], self.depth, where=self.depth > 0)
        for name in {"instance", "part", "face"} & set(channels):
            labels = self.seen.table(name).take(self.labels)
            if self.standing is None:
                view[name][within] = labels
            else:
                np.copyto(view[name][within], labels, where=self.labels > 0)
        if self.rgba is not None and "rgb" in view:
            # (many times faster than to assign the first three of four)
            view["rgb"][within] = cv2.cvtColor(self.rgba, cv2.COLOR_RGBA2RGB) if self.rgba.size else 0
        if self.rgba is not None and "shadow" in view:
            view["shadow"][within] = 255 - self.rgba[..., 3]
        if "alpha" in channels:
            still = view.get("alpha", {})
            for alpha in still.values():
                alpha[within][self.labels > 0] = 0
            view["alpha"] = self._covered(view.get("instance")) | still
        blended = [*([view["rgb"]] if "rgb" in view else []), *view.get("alpha", {}).values()]
        if self.outline is not None and blended:
            blend(blended, view["depth"], self.outline)
        if "normal" in view:
            view["normal"].reshape(-1, 3)[self._detail.shown.pixels] = self._detail.normals()
        if "uv" in view:
            view["uv"].reshape(-1, 2)[self._detail.shown.pixels] = self._detail.texture_coordinates()
        for which, (moment, other) in others.items():
            depth, touched = (None, within) if other is None else (other.whole_depth, other.rectangle.slices)
            flow = optical_flow(self.camera, self._detail, self.whole_depth, moment, depth, touched)
            name = "flow" if which == "next_frame" else "flow_back"
            view[name], view[f"{name}_hidden"] = flow.flow, flow.hidden
        if "amodal" in channels and self.alone is not None:
            alone = {instance: mask.copy() for instance, mask in self.alone.items()}
            view["amodal"] = alone | view.get("amodal", {})
        return View(**{name: view[name] for name in channels})

    def _still(self, channels: Collection[str]) -> dict[str, Any]:
        """The channels of the whole image without bodies."""
        view: dict[str, Any] = self.layer.view(channels)
        return view if self.standing is None else view | self.standing._labels(channels)

    def _labels(self, channels: Collection[str]) -> dict[str, Any]:
        """Those of the channels that say what bodies are where; worked out once, to be drawn into."""
        asked = {name for name in channels if CHANNEL_TABLE[name].labels_bodies}
        for name in asked - self._kept.keys():
            self._kept[name] = getattr(self.view((name,), {}), name)
        return {name: deepcopy(self._kept[name]) for name in asked}

    @cached_property
    def _kept(self) -> dict[str, Any]:
        return {}

    def _covered(self, instances: NDArray[np.uint16] | None) -> dict[int, NDArray[np.uint8]]:
        """By instance, (H, W) 255 where the centre of a pixel shows it."""
        if instances is None:
            instances = self.layer.view(("instance",))["instance"]
            instances[self.rectangle.slices] = self.seen.table("instance").take(self.labels)
        return {
            b.instance: (instances == b.instance).view(np.uint8) * np.uint8(255)
            for b in self.bodies
            if b.instance
        }
