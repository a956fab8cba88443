"""Several people in an image by MediaPipe (https://github.com/google-ai-edge/mediapipe).

MediaPipe's Pose solution finds one person in an image. Its two networks do more, and this module runs their
graphs alone: the detector on the image and on overlapping parts of it, and the landmarks in the region of
each person. Regions come from the detector, and from the landmarks of the camera's last image. Only the
models of MediaPipe's wheel are used.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mediapipe
import numpy as np
from mediapipe.framework.formats.rect_pb2 import NormalizedRect
from mediapipe.python import packet_creator, packet_getter
from mediapipe.python._framework_bindings import resource_util
from mediapipe.python._framework_bindings.calculator_graph import CalculatorGraph
from mediapipe.python._framework_bindings.image_frame import ImageFormat

DETECTOR = """
input_stream: "image"
output_stream: "detections"
node { calculator: "PoseDetectionCpu" input_stream: "IMAGE:image" output_stream: "DETECTIONS:detections" }
"""
LANDMARKS = """
input_stream: "image"
input_stream: "region"
output_stream: "landmarks"
output_stream: "around"
node { calculator: "PoseLandmarkByRoiCpu" input_stream: "IMAGE:image" input_stream: "ROI:region"
       output_stream: "LANDMARKS:landmarks" output_stream: "AUXILIARY_LANDMARKS:around" }
"""
#: Side and step of the parts of an image that are searched, shares of the shorter side of the image.
PART, STEP = 0.6, 0.3
#: Side of the region of a person, in multiples of the distance that the networks give for it: as MediaPipe.
MARGIN = 1.25
#: Two regions whose middles are closer than this share of their side are of one person.
SAME = 0.2


@dataclass(frozen=True)
class Region:
    """A square around a person, turned so that the person is upright: pixels and radians."""

    center: tuple[float, float]
    side: float
    angle: float

    @classmethod
    def around(cls, hips: Any, end: Any) -> Region:
        """Region from the middle of the hips and a point of the circle around the person."""
        across, down = float(end[0] - hips[0]), float(end[1] - hips[1])
        side = 2 * MARGIN * float(np.hypot(across, down))
        return cls((float(hips[0]), float(hips[1])), side, float(np.arctan2(across, -down)))

    def is_same(self, other: Region) -> bool:
        distance = np.hypot(self.center[0] - other.center[0], self.center[1] - other.center[1])
        return bool(distance < SAME * max(self.side, other.side))


class _Graph:
    """One graph of MediaPipe, that gives the last packet of each output."""

    def __init__(self, config: str, outputs: dict[str, Any]) -> None:
        self._found: dict[str, Any] = {}
        self._graph = CalculatorGraph(graph_config=config)
        self._stamp = 0
        for name, read in outputs.items():
            self._graph.observe_output_stream(
                name, lambda stream, packet, read=read: self._found.__setitem__(stream, read(packet))
            )
        self._graph.start_run()

    def run(self, **packets: Any) -> dict[str, Any]:
        self._found.clear()
        self._stamp += 1
        for name, packet in packets.items():
            self._graph.add_packet_to_input_stream(name, packet.at(self._stamp))
        self._graph.wait_until_idle()
        return dict(self._found)


class People:
    """Finds the people of images, camera by camera."""

    def __init__(self) -> None:
        resource_util.set_resource_dir(str(Path(mediapipe.__file__).parents[1]))
        self._detector = _Graph(DETECTOR, {"detections": packet_getter.get_proto_list})
        self._landmarks = _Graph(
            LANDMARKS, {"landmarks": packet_getter.get_proto, "around": packet_getter.get_proto}
        )
        self._last: dict[str, list[Region]] = {}

    def find(self, camera: str, image: Any) -> list[list[list[float]]]:
        """Landmarks [u, v, visibility] of the people of an image (H, W, 3) of a camera."""
        height, width = image.shape[:2]
        packet = _packet(image)
        people, used, following = [], [], []
        for region in [*self._last.get(camera, ()), *self._search(image)]:
            if any(region.is_same(each) for each in used):
                continue
            found = self._landmarks.run(image=packet, region=_rectangle(region, width, height))
            if "landmarks" not in found:
                continue
            middle, end = (np.array([p.x * width, p.y * height]) for p in found["around"].landmark[:2])
            after = Region.around(middle, end)
            if any(after.is_same(each) for each in following):
                continue
            used.append(region)
            following.append(after)
            people.append(
                # MediaPipe counts from the corner of the image, and ROS from the middle of its first pixel
                [[p.x * width - 0.5, p.y * height - 0.5, p.visibility] for p in found["landmarks"].landmark]
            )
        self._last[camera] = following
        return people

    def _search(self, image: Any) -> list[Region]:
        """Regions of people in the image and in parts of it, the surest first."""
        height, width = image.shape[:2]
        found = []
        for left, top, right, bottom in parts(width, height):
            part = np.ascontiguousarray(image[top:bottom, left:right])
            for detection in self._detector.run(image=_packet(part)).get("detections", ()):
                points = np.array([[p.x, p.y] for p in detection.location_data.relative_keypoints])
                points = points * (right - left, bottom - top) + (left, top)
                found.append((detection.score[0], Region.around(points[0], points[1])))
        return [region for _, region in sorted(found, key=lambda each: -each[0])]


def parts(width: int, height: int) -> list[tuple[int, int, int, int]]:
    """The image, and overlapping squares that cover it: left, top, right, bottom."""
    side, step = (round(share * min(width, height)) for share in (PART, STEP))

    def starts(length: int) -> list[int]:
        count = -(-(length - side) // step) + 1
        return [round(start) for start in np.linspace(0, length - side, count)]

    squares = [(x, y, x + side, y + side) for y in starts(height) for x in starts(width)]
    return [(0, 0, width, height), *squares]


def _packet(image: Any) -> Any:
    return packet_creator.create_image_frame(data=image, image_format=ImageFormat.SRGB)


def _rectangle(region: Region, width: int, height: int) -> Any:
    return packet_creator.create_proto(
        NormalizedRect(
            x_center=region.center[0] / width,
            y_center=region.center[1] / height,
            width=region.side / width,
            height=region.side / height,
            rotation=region.angle,
        )
    )
