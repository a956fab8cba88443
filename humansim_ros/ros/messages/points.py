"""Point clouds from structured arrays, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from humansim_ros.errors import RosError
from humansim_ros.ros.messages.images import set_data

_FIELD_TYPES = {
    np.dtype("<f4"): PointField.FLOAT32,
    np.dtype("u1"): PointField.UINT8,
    np.dtype("<u2"): PointField.UINT16,
    np.dtype("<u4"): PointField.UINT32,
}


def point_cloud(points: NDArray[Any], head: Header) -> PointCloud2:
    """Build a PointCloud2 with the fields of a structured array (N,)."""
    dtype = points.dtype
    assert dtype.fields is not None
    message = PointCloud2(header=head, height=1, width=len(points), is_bigendian=False, is_dense=True)
    message.fields = [
        PointField(name=name, offset=field[1], datatype=_FIELD_TYPES[field[0]], count=1)
        for name, field in dtype.fields.items()
    ]
    message.point_step = dtype.itemsize
    message.row_step = dtype.itemsize * len(points)
    set_data(message, points)
    return message


def read_points(message: PointCloud2, required: Sequence[str]) -> NDArray[Any]:
    """Read the points of a cloud as a structured array (N,).

    Raises:
        RosError: A required field is missing, or the fields do not fit the data.
    """
    types = {number: dtype for dtype, number in _FIELD_TYPES.items()}
    fields = [f for f in message.fields if f.datatype in types and f.count == 1]
    missing = set(required) - {f.name for f in fields}
    if missing or message.is_bigendian:
        lacks = f"the fields {', '.join(sorted(missing))}" if missing else "little-endian numbers"
        raise RosError(f"a PointCloud2 lacks {lacks}")
    data, count = np.frombuffer(message.data, dtype=np.uint8), message.width * message.height
    try:
        dtype = np.dtype(
            {
                "names": [f.name for f in fields],
                "formats": [types[f.datatype] for f in fields],
                "offsets": [f.offset for f in fields],
                "itemsize": message.point_step,
            }
        )
    except ValueError as reason:  # fields beyond the point, or two of one name
        raise RosError(f"the fields of a PointCloud2 are impossible: {reason}") from None
    if len(data) != count * dtype.itemsize:
        raise RosError(f"{len(data)} bytes are not {count} points of {dtype.itemsize}")
    return data.view(dtype)
