"""Point clouds from structured arrays, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.data.messages.headers import header
from humansim_ros.data.messages.images import set_data
from humansim_ros.data.messages.types import Header, PointCloud2, PointField
from humansim_ros.errors import RosError

#: Number types by ``datatype`` of sensor_msgs/PointField.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: One point in the layout of depth_image_proc: 16 bytes, since PCL reads x, y, z in such blocks.
XYZ_POINT = np.dtype({"names": ["x", "y", "z"], "formats": ["<f4"] * 3, "offsets": [0, 4, 8], "itemsize": 16})
XYZRGB_POINT = np.dtype(
    {"names": ["x", "y", "z", "rgb"], "formats": ["<f4"] * 4, "offsets": [0, 4, 8, 16], "itemsize": 32}
)
#: Values of ``datatype`` in the clouds that this package writes: unsigned integers and float32.
_WRITTEN = (2, 4, 6, 7)
_NUMBERS = {np.dtype(f"<{kind}"): number for number, kind in _DATATYPES.items()}


def point_cloud(points: NDArray[Any], head: Header) -> PointCloud2:
    """Build a PointCloud2 with the fields of a structured array (N,) or (H, W). Only an (H, W) array may
    contain NaN."""
    dtype, organized = points.dtype, points.ndim == 2
    assert dtype.fields is not None
    height, width = points.shape if organized else (1, len(points))
    message = PointCloud2(header=head, height=height, width=width, is_bigendian=False, is_dense=not organized)
    message.fields = [
        PointField(name=name, offset=field[1], datatype=_NUMBERS[field[0]], count=1)
        for name, field in dtype.fields.items()
    ]
    message.point_step = dtype.itemsize
    message.row_step = dtype.itemsize * width
    set_data(message, points)
    return message


def image_points_message(
    points: NDArray[np.float32], colors: NDArray[np.uint8] | None, stamp: int, frame: str
) -> PointCloud2:
    """Build a cloud with a point for each pixel of an image, in the layout of depth_image_proc.

    Args:
        points: (H, W, 3) metres in the optical frame. NaN where there is no point.
        colors: (H, W, 3) rgb8. If None, the message has no field ``rgb``.
        stamp: Nanoseconds.
        frame: Optical frame.
    """
    dtype = XYZ_POINT if colors is None else XYZRGB_POINT
    rows = np.zeros((*points.shape[:2], dtype.itemsize // 4), np.float32)
    rows[..., :3] = points
    if colors is not None:
        red, green, blue = (colors[..., channel].astype(np.uint32) for channel in range(3))
        rows.view(np.uint32)[..., 4] = red << 16 | green << 8 | blue
    return point_cloud(rows.view(dtype)[..., 0], header(stamp, frame))


def read_points(message: PointCloud2, required: Sequence[str]) -> NDArray[Any]:
    """Read the points of a cloud as a structured array (N,).

    Raises:
        RosError: A required field is missing, or the fields do not fit the data.
    """
    missing = set(required) - {f.name for f in message.fields if f.count == 1 and f.datatype in _WRITTEN}
    if missing or message.is_bigendian:
        lacks = f"the fields {', '.join(sorted(missing))}" if missing else "little-endian numbers"
        raise RosError(f"a PointCloud2 lacks {lacks}")
    count = message.width * message.height
    if len(message.data) != count * message.point_step:
        raise RosError(f"{len(message.data)} bytes are not {count} points of {message.point_step}")
    try:
        return point_rows(message)
    except ValueError as reason:  # fields beyond the end of the point, or two with one name
        raise RosError(f"the fields of a PointCloud2 are impossible: {reason}") from None


def point_rows(message: Any) -> NDArray[Any]:
    """Read the points of a cloud from any program as a structured array (N,). Fields of arrays are left out.

    Raises:
        ValueError: The fields do not fit the data.
    """
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.count == 1 and field.datatype in _DATATYPES]
    for field in fields:  # NumPy takes huge offsets for negative ones, and would read outside the data
        if field.offset + np.dtype(_DATATYPES[field.datatype]).itemsize > message.point_step:
            raise ValueError(f"field {field.name} ends after byte {message.point_step} of a point")
    dtype = np.dtype(
        {
            "names": [str(field.name) for field in fields],
            "formats": [f"{order}{_DATATYPES[field.datatype]}" for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": message.point_step,
        }
    )
    return np.frombuffer(message.data, dtype, message.width * message.height)
