"""A recording for Foxglove: an MCAP file of JSON messages with the schemas of Foxglove.

``config/foxglove_schemas.json`` has those schemas of docs.foxglove.dev that are used here.

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

from humansim_ros.cameras.camera import Camera
from humansim_ros.data.bags.topics import BagMessage, BagTopic
from humansim_ros.data.formats.images import encoded_image
from humansim_ros.data.formats.writer import ExportFolder, ExportFrame, FormatWriter, Record
from humansim_ros.errors import ExportError
from humansim_ros.files.reading import ANY_SIZE, read_bytes, read_table
from humansim_ros.geometry import matrix_to_quaternion
from humansim_ros.people.keypoints import keypoint_set
from humansim_ros.scene.features import Sweep
from humansim_ros.scene.truth import OUTSIDE
from humansim_ros.types import Array

_WORLD = "map"
#: Fields of points: name, NumPy type, and number of the type in Foxglove.
_FIELDS = (
    *((axis, "<f4", 7) for axis in ("x", "y", "z", "intensity")),
    ("instance", "<u2", 3),
    ("part", "u1", 1),
)
_POINT = np.dtype([(name, kind) for name, kind, _ in _FIELDS])
#: Type numbers: in space, lines between pairs of points; in images, lines between pairs of points, a closed
#: line, and dots.
_LINE_LIST, _IMAGE_LINES, _IMAGE_LOOP, _IMAGE_DOTS = 2, 4, 2, 1
_THIN, _FONT = 0.01, 0.12
_UNTURNED = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
_HERE = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": _UNTURNED}


class FoxgloveWriter(FormatWriter):
    """Writes ``foxglove.mcap`` with the messages of all frames in order."""

    def frame(self, frame: ExportFrame, folder: ExportFolder) -> Record:
        """Write the messages of a frame to a temporary file. Returns stamp and topics of the frame."""
        lines, topics = [], {}
        for topic, schema, message in self._messages(frame):
            topics[topic] = f"foxglove.{schema}"
            lines.append(f"{topic}\t{json.dumps(message, allow_nan=False)}\n")
        folder.write_temporary(f"{frame.name}.txt", "".join(lines).encode())
        return {"stamp": frame.frame.stamp, "topics": topics}

    def finish(self, records: Iterable[tuple[int, Record]], folder: ExportFolder) -> None:
        """Join the messages of all frames to one file."""
        from humansim_ros.data.bags.writer import McapFile

        frames = dict(records)
        kinds = {name: kind for record in frames.values() for name, kind in record["topics"].items()}
        schemas = read_table("foxglove_schemas")
        topics = [
            BagTopic(name, kind, definition=json.dumps(schemas[kind]), serialization="json")
            for name, kind in kinds.items()
        ]
        numbers = {name: number for number, name in enumerate(kinds)}
        with folder.path("foxglove.mcap") as path, McapFile(path, topics, "zstd", profile="") as file:
            for index, record in frames.items():
                temporary = folder.temporary(f"{index:06d}.txt")
                content = read_bytes(temporary, ExportError, "message", ANY_SIZE)
                for line in content.splitlines():
                    topic, data = line.split(b"\t", 1)
                    file.write([BagMessage(numbers[topic.decode()], record["stamp"], data)])

    def _messages(self, frame: ExportFrame) -> Iterator[tuple[str, str, dict[str, Any]]]:
        """Yield all messages of a frame: topic, name of the schema, and content."""
        now = frame.frame
        transforms = []
        for name, camera in now.cameras.items():
            stamped = _stamped(now.stamp, child := f"{name}_optical_frame")
            encoding, suffix = self.settings.scene.cameras[name].encoding, self.settings.image_suffix
            image = encoded_image(now.views[name].rgb, encoding, suffix)
            kind = "png" if suffix == ".png" else "jpeg"
            yield f"/{name}/image", "CompressedImage", {**stamped, "data": _base64(image), "format": kind}
            yield f"/{name}/calibration", "CameraCalibration", {**stamped, **_calibration(camera)}
            yield f"/{name}/annotations", "ImageAnnotations", self._annotations(frame, name)
            transforms.append(_transform(now.stamp, child, camera.center, matrix_to_quaternion(camera.R.T)))
        for name, sweeps in now.sweeps.items():
            for sweep in sweeps:
                transforms.append(_transform(sweep.stamp, f"{name}_frame", sweep.position, sweep.rotation))
                yield (
                    f"/{name}/points",
                    "PointCloud",
                    {**_stamped(sweep.stamp, f"{name}_frame"), **_cloud(sweep)},
                )
        if now.robot is not None:
            transforms.append(_transform(now.stamp, "base_link", now.robot.position, now.robot.rotation))
        yield "/tf", "FrameTransforms", {"transforms": transforms}
        yield "/people", "SceneUpdate", {"deletions": [], "entities": list(self._people(frame))}

    def _people(self, frame: ExportFrame) -> Iterator[dict[str, Any]]:
        """Yield the drawings of the people: for each person box, keypoints with lines, and name."""
        chosen = keypoint_set(self.settings.keypoints)
        for name, state in frame.frame.humans.items():
            box, color = state.upright_box, _color(frame.frame.labels[name])
            points = frame.frame.keypoint_positions[chosen.name][name]
            ends = [number for edge in chosen.edges for number in edge]
            pose = {"position": _axes(box.center), "orientation": _axes(box.quaternion)}
            above = {
                "position": _axes(box.bottom + np.array([0, 0, box.size[2] + _FONT])),
                "orientation": _UNTURNED,
            }
            yield {
                **_stamped(frame.frame.stamp, _WORLD),
                "id": name,
                "lifetime": {"sec": 0, "nsec": 0},
                "frame_locked": False,
                "metadata": [{"key": "instance", "value": str(frame.frame.labels[name])}],
                "cubes": [{"pose": pose, "size": _axes(box.size), "color": {**color, "a": 0.25}}],
                "lines": [
                    {
                        "type": _LINE_LIST,
                        "pose": _HERE,
                        "thickness": _THIN,
                        "scale_invariant": False,
                        "points": [_axes(point) for point in points],
                        "color": color,
                        "colors": [],
                        "indices": ends,
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
                **{kind: [] for kind in ("arrows", "spheres", "cylinders", "triangles", "models")},
            }

    def _annotations(self, frame: ExportFrame, camera: str) -> dict[str, Any]:
        """Drawings over an image: boxes of visible pixels with names, and keypoints inside the image."""
        chosen = keypoint_set(self.settings.keypoints)
        views, stamp = frame.frame.keypoints[chosen.name][camera], _time(frame.frame.stamp)
        points, texts = [], []
        for name, view in views.items():
            color = _color(frame.frame.labels[name])
            shared = {"timestamp": stamp, "outline_color": color, "outline_colors": [], "thickness": 2.0}
            shared["fill_color"] = {**color, "a": 0.0}
            box = frame.frame.truth[camera].boxes[name]
            if box.pixels:
                left, top, right, bottom = box.visible.tolist()
                corners = [(left, top), (right, top), (right, bottom), (left, bottom)]
                points.append(
                    {**shared, "type": _IMAGE_LOOP, "points": [_axes(corner) for corner in corners]}
                )
                texts.append(
                    {
                        "timestamp": stamp,
                        "position": _axes((left, top)),
                        "text": name,
                        "font_size": 12.0,
                        "text_color": color,
                        "background_color": {"r": 0.0, "g": 0.0, "b": 0.0, "a": 0.5},
                    }
                )
            inside = view.visible != OUTSIDE
            dots = [_axes(pixel) for pixel in view.pixels[inside]]
            ends = [view.pixels[end] for edge in chosen.edges if inside[list(edge)].all() for end in edge]
            points.append({**shared, "type": _IMAGE_DOTS, "points": dots})
            points.append({**shared, "type": _IMAGE_LINES, "points": [_axes(end) for end in ends]})
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
    fields = [
        {"name": name, "offset": _POINT.fields[name][1], "type": number}  # type: ignore[index]
        for name, _, number in _FIELDS
    ]
    data = _base64(rows.tobytes())
    return {"pose": _HERE, "point_stride": _POINT.itemsize, "fields": fields, "data": data}


def _transform(stamp: int, child: str, position: Array, rotation: Array) -> dict[str, Any]:
    return {
        "timestamp": _time(stamp),
        "parent_frame_id": _WORLD,
        "child_frame_id": child,
        "translation": _axes(position),
        "rotation": _axes(rotation),
    }


def _base64(data: bytes) -> str:
    return b64encode(data).decode("ascii")


def _time(stamp: int) -> dict[str, int]:
    return {"sec": stamp // 1_000_000_000, "nsec": stamp % 1_000_000_000}


def _color(label: int) -> dict[str, float]:
    """Colour of an instance label. Successive labels differ in hue."""
    r, g, b = colorsys.hsv_to_rgb(label * 0.618 % 1, 0.75, 1.0)
    return {"r": r, "g": g, "b": b, "a": 1.0}


def _stamped(stamp: int, frame_id: str) -> dict[str, Any]:
    return {"timestamp": _time(stamp), "frame_id": frame_id}


def _axes(values: Any) -> dict[str, float]:
    """Convert a point (two or three numbers) or a quaternion to a mapping by axis: x, y, z, w."""
    return dict(zip("xyzw", map(float, values), strict=False))
