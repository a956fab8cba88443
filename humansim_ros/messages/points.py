"""Point clouds from structured arrays, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from humansim_ros.errors import RosError
from humansim_ros.messages.images import set_data
from humansim_ros.messages.types import Header, PointCloud2, PointField

#: Number types by datatype of sensor_msgs/PointField.
_DATATYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: Datatypes of the fields of our own clouds: unsigned integers and single floats.
_WRITTEN = (2, 4, 6, 7)
_NUMBERS = {np.dtype(f"<{kind}"): number for number, kind in _DATATYPES.items()}


def point_cloud(points: NDArray[Any], head: Header) -> PointCloud2:
    """Build a PointCloud2 with the fields of a structured array (N,)."""
    dtype = points.dtype
    assert dtype.fields is not None
    message = PointCloud2(header=head, height=1, width=len(points), is_bigendian=False, is_dense=True)
    message.fields = [
        PointField(name=name, offset=field[1], datatype=_NUMBERS[field[0]], count=1)
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
    missing = set(required) - {f.name for f in message.fields if f.count == 1 and f.datatype in _WRITTEN}
    if missing or message.is_bigendian:
        lacks = f"the fields {', '.join(sorted(missing))}" if missing else "little-endian numbers"
        raise RosError(f"a PointCloud2 lacks {lacks}")
    count = message.width * message.height
    if len(message.data) != count * message.point_step:
        raise RosError(f"{len(message.data)} bytes are not {count} points of {message.point_step}")
    try:
        return point_rows(message)
    except ValueError as reason:  # fields beyond the point, or two of one name
        raise RosError(f"the fields of a PointCloud2 are impossible: {reason}") from None


def point_rows(message: Any) -> NDArray[Any]:
    """Read the points of a cloud of any program as a structured array (N,), with the fields of one number.

    Raises:
        ValueError: The fields do not fit the data.
    """
    order = ">" if message.is_bigendian else "<"
    fields = [field for field in message.fields if field.count == 1 and field.datatype in _DATATYPES]
    dtype = np.dtype(
        {
            "names": [str(field.name) for field in fields],
            "formats": [f"{order}{_DATATYPES[field.datatype]}" for field in fields],
            "offsets": [field.offset for field in fields],
            "itemsize": message.point_step,
        }
    )
    return np.frombuffer(message.data, dtype, message.width * message.height)
