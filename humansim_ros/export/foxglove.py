"""A recording for Foxglove: MCAP with its schemas, as JSON.

Topics are ``/<camera>/image``, ``/<camera>/calibration``, ``/<camera>/annotations``, ``/people``, ``/tf`` and
``/<scanner>/points``. ROS programs need a bag instead (``humansim record``).
"""

from __future__ import annotations

import colorsys
import json
from base64 import b64encode
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from humansim_ros.bags.topics import BagTopic
from humansim_ros.camera import Camera
from humansim_ros.errors import ExportError
from humansim_ros.export.images import encoded_image
from humansim_ros.export.writer import ExportFolder, ExportFrame, FormatWriter, Record
from humansim_ros.io.files import ANY_SIZE, read_bytes
from humansim_ros.keypoints.sets import keypoint_set
from humansim_ros.rotations import matrix_to_quaternion
from humansim_ros.scene.sweeps import Sweep
from humansim_ros.truth import OUTSIDE
from humansim_ros.types import Array

_WORLD = "map"
_TEXT, _REAL, _WHOLE, _FLAG = ({"type": name} for name in ("string", "number", "integer", "boolean"))
_BYTES = {"type": "string", "contentEncoding": "base64"}


def _object(title: str = "", /, **properties: Any) -> dict[str, Any]:
    named = {"title": title} if title else {}
    return {**named, "type": "object", "properties": properties}


def _list(items: Any) -> dict[str, Any]:
    return {"type": "array", "items": items}


_TIME = _object("time", sec=_WHOLE, nsec=_WHOLE)
_DURATION = _object("duration", sec=_WHOLE, nsec=_WHOLE)
_XY, _XYZ = (_object(**dict.fromkeys(axes, _REAL)) for axes in ("xy", "xyz"))
_TURN, _COLOR = (_object(**dict.fromkeys(axes, _REAL)) for axes in ("xyzw", "rgba"))
_POSE = _object(position=_XYZ, orientation=_TURN)
_STAMPED = {"timestamp": _TIME, "frame_id": _TEXT}
_OTHERS = ("arrows", "spheres", "cylinders", "triangles", "models")  # primitives that are not used
_LINE = _object(
    type=_WHOLE,
    pose=_POSE,
    thickness=_REAL,
    scale_invariant=_FLAG,
    points=_list(_XYZ),
    color=_COLOR,
    colors=_list(_COLOR),
    indices=_list(_WHOLE),
)
_CUBE = _object(pose=_POSE, size=_XYZ, color=_COLOR)
_LABEL = _object(
    pose=_POSE, billboard=_FLAG, font_size=_REAL, scale_invariant=_FLAG, color=_COLOR, text=_TEXT
)
_ENTITY = _object(
    **_STAMPED,
    id=_TEXT,
    lifetime=_DURATION,
    frame_locked=_FLAG,
    metadata=_list(_object(key=_TEXT, value=_TEXT)),
    cubes=_list(_CUBE),
    lines=_list(_LINE),
    texts=_list(_LABEL),
    **dict.fromkeys(_OTHERS, _list(_object())),
)
_POINTS = _object(
    timestamp=_TIME,
    type=_WHOLE,
    points=_list(_XY),
    outline_color=_COLOR,
    outline_colors=_list(_COLOR),
    fill_color=_COLOR,
    thickness=_REAL,
)
_CAPTION = _object(
    timestamp=_TIME, position=_XY, text=_TEXT, font_size=_REAL, text_color=_COLOR, background_color=_COLOR
)
#: Schemas of the messages by name, in the keys of docs.foxglove.dev that are used here.
SCHEMAS: dict[str, dict[str, Any]] = {
    "foxglove.CompressedImage": _object(**_STAMPED, data=_BYTES, format=_TEXT),
    "foxglove.CameraCalibration": _object(
        **_STAMPED,
        width=_WHOLE,
        height=_WHOLE,
        distortion_model=_TEXT,
        **dict.fromkeys("DKRP", _list(_REAL)),
    ),
    "foxglove.ImageAnnotations": _object(
        circles=_list(_object()), points=_list(_POINTS), texts=_list(_CAPTION)
    ),
    "foxglove.SceneUpdate": _object(deletions=_list(_object()), entities=_list(_ENTITY)),
    "foxglove.FrameTransforms": _object(
        transforms=_list(
            _object(
                timestamp=_TIME,
                parent_frame_id=_TEXT,
                child_frame_id=_TEXT,
                translation=_XYZ,
                rotation=_TURN,
            )
        )
    ),
    "foxglove.PointCloud": _object(
        **_STAMPED,
        pose=_POSE,
        point_stride=_WHOLE,
        fields=_list(_object(name=_TEXT, offset=_WHOLE, type=_WHOLE)),
        data=_BYTES,
    ),
}
#: Fields of points: a name, and the NumPy and Foxglove types.
_FIELDS = (
    *((axis, "<f4", 7) for axis in ("x", "y", "z", "intensity")),
    ("instance", "<u2", 3),
    ("part", "u1", 1),
)
_POINT = np.dtype([(name, kind) for name, kind, _ in _FIELDS])
#: Types of lines: pairs of points in space; pairs of points and a loop in images; and dots.
_LINE_LIST, _IMAGE_LINES, _IMAGE_LOOP, _IMAGE_DOTS = 2, 4, 2, 1
_THIN, _FONT = 0.01, 0.12
#: Frames that the viewer interpolates nothing for: identity.
_HERE = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


class FoxgloveWriter(FormatWriter):
    """``foxglove.mcap``, with the messages of all frames in their order."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the messages of a frame, until they are put into the file; return stamp and topics."""
        lines, topics = [], {}
        for topic, schema, message in self._messages(frame):
            topics[topic] = f"foxglove.{schema}"
            lines.append(f"{topic}\t{json.dumps(message, allow_nan=False)}\n")
        folder.write_temporary(f"{frame.name}.txt", "".join(lines).encode())
        return {"stamp": frame.frame.stamp, "topics": topics}

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Join the messages to a file."""
        from humansim_ros.bags.chunks import BagMessage, encode_chunk
        from humansim_ros.bags.mcap_file import McapFile

        frames = dict(records)
        kinds = {name: kind for record in frames.values() for name, kind in record["topics"].items()}
        topics = [
            BagTopic(
                name, kind, definition=json.dumps({"title": kind, **SCHEMAS[kind]}), serialization="json"
            )
            for name, kind in kinds.items()
        ]
        numbers = {name: number for number, name in enumerate(kinds)}
        with folder.path("foxglove.mcap") as path:
            file = McapFile.create(path, topics, profile="")
            try:
                for number, (index, record) in enumerate(frames.items()):
                    temporary = folder.temporary(f"{index:06d}.txt")
                    content = read_bytes(temporary, ExportError, "message", ANY_SIZE)
                    rows = (line.split(b"\t", 1) for line in content.splitlines())
                    messages = [
                        BagMessage(numbers[topic.decode()], record["stamp"], data) for topic, data in rows
                    ]
                    file.append(encode_chunk(messages, "zstd"), number, True)
                file.finish()
            finally:
                file.close()

    def _messages(self, frame: ExportFrame) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """Topic, name of the schema and content of all messages of a frame."""
        now = frame.frame
        transforms = []
        for name, camera in now.cameras.items():
            child = f"{name}_optical_frame"
            stamped = {"timestamp": _time(now.stamp), "frame_id": child}
            encoding, suffix = self.settings.scene.cameras[name].encoding, self.settings.image_suffix
            image = encoded_image(now.views[name].rgb, encoding, suffix)
            kind = "png" if suffix == ".png" else "jpeg"
            yield f"/{name}/image", "CompressedImage", {**stamped, "data": _base64(image), "format": kind}
            yield f"/{name}/calibration", "CameraCalibration", {**stamped, **_calibration(camera)}
            yield f"/{name}/annotations", "ImageAnnotations", self._annotations(frame, name)
            transforms.append(_transform(now.stamp, child, camera.center, matrix_to_quaternion(camera.R.T)))
        for name, sweeps in now.sweeps.items():
            for sweep in sweeps:
                child = f"{name}_frame"
                stamped = {"timestamp": _time(sweep.stamp), "frame_id": child}
                transforms.append(_transform(sweep.stamp, child, sweep.position, sweep.rotation))
                yield f"/{name}/points", "PointCloud", {**stamped, **_cloud(sweep)}
        if now.robot is not None:
            transforms.append(_transform(now.stamp, "base_link", now.robot.position, now.robot.rotation))
        yield "/tf", "FrameTransforms", {"transforms": transforms}
        yield "/people", "SceneUpdate", {"deletions": [], "entities": list(self._people(frame))}

    def _people(self, frame: ExportFrame) -> Iterator[dict[str, Any]]:
        """Box, keypoints with their lines, and name of each person."""
        chosen = keypoint_set(self.settings.keypoints)
        for name, state in frame.frame.humans.items():
            box, color = state.upright_box, _color(frame.frame.labels[name])
            points = frame.frame.keypoint_positions[chosen.name][name]
            x, y, z = box.bottom.tolist()
            above = {"position": _xyz((x, y, z + box.size[2] + _FONT)), "orientation": _HERE["orientation"]}
            yield {
                "timestamp": _time(frame.frame.stamp),
                "frame_id": _WORLD,
                "id": name,
                "lifetime": {"sec": 0, "nsec": 0},
                "frame_locked": False,
                "metadata": [{"key": "instance", "value": str(frame.frame.labels[name])}],
                "cubes": [
                    {
                        "pose": {"position": _xyz(box.center), "orientation": _xyzw(box.quaternion)},
                        "size": _xyz(box.size),
                        "color": {**color, "a": 0.25},
                    }
                ],
                "lines": [
                    {
                        "type": _LINE_LIST,
                        "pose": _HERE,
                        "thickness": _THIN,
                        "scale_invariant": False,
                        "points": [_xyz(point) for point in points],
                        "color": color,
                        "colors": [],
                        "indices": [number for edge in chosen.edges for number in edge],
                    }
                ],
                "texts": [
                    {
                        "pose": above,
                        "billboard": True,
                        "font_size": _FONT,
                        "scale_invariant": False,
                        "color": color,
                        "text": name,
                    }
                ],
                **{kind: [] for kind in _OTHERS},
            }

    def _annotations(self, frame: ExportFrame, camera: str) -> dict[str, Any]:
        """Boxes of the visible pixels with names, and keypoints that are in the image."""
        chosen = keypoint_set(self.settings.keypoints)
        views, stamp = frame.frame.keypoints[chosen.name][camera], _time(frame.frame.stamp)
        points, texts = [], []
        for name, view in views.items():
            color = _color(frame.frame.labels[name])
            shared = {"timestamp": stamp, "outline_color": color, "outline_colors": [], "thickness": 2.0}
            clear = {"fill_color": {**color, "a": 0.0}}
            box = frame.frame.truth[camera].boxes[name]
            if box.pixels:
                left, top, right, bottom = box.visible.tolist()
                corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
                points.append({**shared, **clear, "type": _IMAGE_LOOP, "points": [_xy(c) for c in corners]})
                texts.append(
                    {
                        "timestamp": stamp,
                        "position": _xy((left, top)),
                        "text": name,
                        "font_size": 12.0,
                        "text_color": color,
                        "background_color": {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.5},
                    }
                )
            inside = view.visible != OUTSIDE
            dots = [_xy(pixel) for pixel in view.pixels[inside]]
            ends = [view.pixels[end] for edge in chosen.edges if inside[list(edge)].all() for end in edge]
            points.append({**shared, **clear, "type": _IMAGE_DOTS, "points": dots})
            points.append({**shared, **clear, "type": _IMAGE_LINES, "points": [_xy(end) for end in ends]})
        return {"circles": [], "points": points, "texts": texts}


def _calibration(camera: Camera) -> dict[str, Any]:
    return {
        "width": camera.size[0],
        "height": camera.size[1],
        "distortion_model": camera.model,
        "D": list(camera.distortion),
        "K": camera.K.ravel().tolist(),
        "R": camera.rectification_matrix.ravel().tolist(),
        "P": camera.rectified_projection.ravel().tolist(),
    }


def _cloud(sweep: Sweep) -> dict[str, Any]:
    rows = np.zeros(len(sweep.instances), _POINT)
    for number, axis in enumerate("xyz"):
        rows[axis] = sweep.points[:, number]
    rows["intensity"], rows["instance"] = sweep.returns.intensities, sweep.instances
    rows["part"] = sweep.parts
    offsets = [_POINT.fields[name][1] for name, _, _ in _FIELDS]  # type: ignore[index]
    return {
        "pose": _HERE,
        "point_stride": _POINT.itemsize,
        "fields": [
            {"name": name, "offset": offset, "type": number}
            for (name, _, number), offset in zip(_FIELDS, offsets, strict=True)
        ],
        "data": _base64(rows.tobytes()),
    }


def _transform(stamp: int, child: str, position: Array, rotation: Array) -> dict[str, Any]:
    return {
        "timestamp": _time(stamp),
        "parent_frame_id": _WORLD,
        "child_frame_id": child,
        "translation": _xyz(position),
        "rotation": _xyzw(rotation),
    }


def _base64(data: bytes) -> str:
    return b64encode(data).decode("ascii")


def _time(stamp: int) -> dict[str, int]:
    return {"sec": stamp // 1_000_000_000, "nsec": stamp % 1_000_000_000}


def _color(label: int) -> dict[str, float]:
    """Colour of an instance label: neighbours differ in hue."""
    r, g, b = colorsys.hsv_to_rgb(label * 0.618 % 1, 0.75, 1.0)
    return {"r": r, "g": g, "b": b, "a": 1.0}


def _xy(point: Any) -> dict[str, float]:
    return dict(zip("xy", map(float, point), strict=True))


def _xyz(point: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, point), strict=True))


def _xyzw(rotation: Any) -> dict[str, float]:
    return dict(zip("xyzw", map(float, rotation), strict=True))
