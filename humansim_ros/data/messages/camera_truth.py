"""Messages of a camera's ground truth: joints, boxes and visible vertices as point clouds; and its faults."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.messages import parts
from humansim_ros.data.messages.headers import header
from humansim_ros.data.messages.points import point_cloud, read_points
from humansim_ros.data.messages.types import (
    DiagnosticArray,
    DiagnosticStatus,
    ImageMarker,
    KeyValue,
    Point,
    PointCloud2,
)
from humansim_ros.render.interface import Kind
from humansim_ros.scene.core import FrameFaults
from humansim_ros.scene.pictures import joint_colors
from humansim_ros.scene.truth import OUTSIDE, VISIBLE, BodyBox, JointView
from humansim_ros.types import Array

#: Fields of one point of ``<camera>/joints``, padded to a multiple of four bytes.
JOINT_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "u", "v", "visible", "occluder", "human", "joint", "by", "behind"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<f4", "u1", "u1", "<u2", "<u2", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 20, 21, 22, 24, 26, 28],
        "itemsize": 32,
    }
)
#: One point of ``<camera>/boxes``: left, top, right, bottom of two boxes (visible pixels, whole body).
BOX_POINT = np.dtype(
    [(name, "<f4") for name in ("left", "top", "right", "bottom")]
    + [(name, "<f4") for name in ("whole_left", "whole_top", "whole_right", "whole_bottom")]
    + [("truncation", "<f4"), ("visible_fraction", "<f4"), ("pixels", "<u4")]
    + [("instance", "<u2"), ("kind", "u1")],
    align=True,
)
#: Values of field ``kind`` of :data:`BOX_POINT`.
BODY_KINDS = {"human": 1, "object": 2}
#: One point of ``<camera>/visible_vertices``. ``vertex``: index into ``humans/<id>/vertices``.
VISIBLE_VERTEX = np.dtype([("vertex", "<u4"), ("instance", "<u2")], align=True)


def joint_view_message(views: Sequence[tuple[int, JointView]], stamp: int, frame: str) -> PointCloud2:
    """Build ``<camera>/joints``. ``views``: pairs of an instance label and the joints of that human."""
    points = np.zeros(sum(len(view.visible) for _, view in views), dtype=JOINT_POINT)
    start = 0
    for instance, view in views:
        part = points[start : start + len(view.visible)]
        for i, axis in enumerate("xyz"):
            part[axis] = view.optical[:, i]
        part["u"], part["v"] = view.pixels[:, 0], view.pixels[:, 1]
        part["visible"], part["human"], part["joint"] = view.visible, instance, np.arange(len(part))
        part["occluder"], part["by"], part["behind"] = view.occluder, view.by, view.behind
        start += len(part)
    message = point_cloud(points, header(stamp, frame))
    message.is_dense = bool(np.isfinite(points["u"]).all())
    return message


def read_joint_view(message: PointCloud2) -> NDArray[Any]:
    """Read a ``<camera>/joints`` message as a structured array (N,) of :data:`JOINT_POINT`. Recordings of
    earlier versions of the package lack some fields. Raises RosError for another layout."""
    return read_points(message, ("x", "y", "z", "u", "v", "visible", "human", "joint"))


def joint_places(points: NDArray[Any]) -> tuple[Array, Array]:
    """Pixels (N, 2), and positions (N, 3) in the optical frame, from points (N,) of type
    :data:`JOINT_POINT`."""
    with np.errstate(invalid="ignore"):  # signalling NaN
        pixels, optical = (
            np.stack([points[axis] for axis in axes], axis=1).astype(float) for axes in ("uv", "xyz")
        )
    return pixels, optical


def overlay_message(views: Sequence[JointView], radius: float, stamp: int, frame: str) -> ImageMarker:
    """Build ``<camera>/overlay``: points that viewers draw over the image, one for each joint inside the
    image. Hidden joints have another colour.

    Args:
        views: Joints of the humans.
        radius: Radius of the points in pixels.
        stamp: Nanoseconds.
        frame: Optical frame of the camera.
    """
    _, *colors = joint_colors(())
    shown, hidden = map(parts.color, colors)
    message = ImageMarker(header=header(stamp, frame), ns="joints", type=ImageMarker.POINTS)
    message.scale, message.outline_color = float(radius), shown
    for view in views:
        inside = view.visible != OUTSIDE
        message.points += [Point(x=x, y=y) for x, y in view.pixels[inside].tolist()]
        message.outline_colors += [
            shown if state == VISIBLE else hidden for state in view.visible[inside].tolist()
        ]
    return message


def boxes_message(boxes: Sequence[tuple[int, BodyBox]], stamp: int, frame: str) -> PointCloud2:
    """Build ``<camera>/boxes``. ``boxes``: pairs of an instance label and the box of that body."""
    points = np.zeros(len(boxes), dtype=BOX_POINT)
    for point, (instance, box) in zip(points, boxes, strict=True):
        shares = (box.truncation, box.visible_fraction, box.pixels)
        values = (*box.visible, *box.whole, *shares, instance, BODY_KINDS[box.kind])
        for name, value in zip(BOX_POINT.names or (), values, strict=True):
            point[name] = value
    message = point_cloud(points, header(stamp, frame))
    message.is_dense = all(bool(np.isfinite(points[name]).all()) for name in BOX_POINT.names or ())
    return message


def read_boxes(message: PointCloud2) -> NDArray[Any]:
    """Read a ``<camera>/boxes`` message as a structured array (N,) of :data:`BOX_POINT`. Raises RosError for
    another layout."""
    return read_points(message, BOX_POINT.names or ())


def body_box(point: Any) -> BodyBox:
    """Convert a point of type :data:`BOX_POINT` to a box."""
    with np.errstate(invalid="ignore"):  # signalling NaN
        visible, whole = (
            np.array([point[f"{part}{side}"] for side in ("left", "top", "right", "bottom")], dtype=float)
            for part in ("", "whole_")
        )
    shares = float(point["truncation"]), float(point["visible_fraction"])
    kind: Kind = "object" if point["kind"] == BODY_KINDS["object"] else "human"
    return BodyBox(visible, whole, *shares, int(point["pixels"]), kind)


def visible_vertices_message(
    masks: Sequence[tuple[int, NDArray[np.bool_]]], stamp: int, frame: str
) -> PointCloud2:
    """Build ``<camera>/visible_vertices``, with one point per visible vertex. ``masks``: pairs of an instance
    label and a mask (V,) that is true for the visible vertices of that body."""
    indices = [np.flatnonzero(mask) for _, mask in masks]
    points = np.zeros(sum(map(len, indices)), dtype=VISIBLE_VERTEX)
    if len(points):
        points["vertex"] = np.concatenate(indices)
        points["instance"] = np.repeat([instance for instance, _ in masks], [len(i) for i in indices])
    return point_cloud(points, header(stamp, frame))


def read_visible_vertices(message: PointCloud2) -> NDArray[Any]:
    """Read a ``<camera>/visible_vertices`` message as a structured array (N,) of :data:`VISIBLE_VERTEX`.
    Raises RosError for another layout."""
    return read_points(message, VISIBLE_VERTEX.names or ())


def faults_message(faults: FrameFaults, stamp: int, frame: str) -> DiagnosticArray:
    """Build ``<camera>/faults``: for each fault of a frame, a status with its values.

    Args:
        faults: Faults of the frame.
        stamp: Stamp of the frame, nanoseconds. The image may have a wrong stamp, if that is the fault.
        frame: Optical frame of the camera.
    """
    message = DiagnosticArray(header=header(stamp, frame))
    for kind, values in faults.kinds.items():
        status = DiagnosticStatus(level=DiagnosticStatus.WARN, name=kind, hardware_id=frame)
        status.values = [KeyValue(key=key, value=repr(value)) for key, value in values.items()]
        message.status.append(status)
    return message


def read_faults(message: DiagnosticArray) -> dict[str, dict[str, float]]:
    """Read ``<camera>/faults``. Returns the values of each fault by kind of fault."""
    return {
        status.name: {value.key: float(value.value) for value in status.values} for status in message.status
    }
