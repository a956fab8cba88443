"""The node of the tracker with MediaPipe as its detector, on the images of the cameras.

python -m venv mediapipe_env
mediapipe_env/bin/pip install -r examples/tracker/requirements-mediapipe.txt .
mediapipe_env/bin/python examples/tracker/mediapipe_detector.py
"""

from __future__ import annotations

import sys
from typing import Any, Protocol

import numpy as np
from detectors import Array, Faults
from sensor_msgs.msg import Image

from humansim_ros.people import keypoint_set

#: Least visibility, as MediaPipe says it, of a joint that counts as found.
MIN_VISIBILITY = 0.5


class PeopleFinder(Protocol):
    """As ``mediapipe_people.People``."""

    def find(self, camera: str, image: Any) -> list[list[list[float]]]:
        """Landmarks [u, v, visibility] of the people of an image (H, W, 3), RGB."""
        ...


class MediaPipeDetector:
    """Finds the 33 landmarks of MediaPipe of each person in ``<camera>/image_raw``."""

    message = Image
    topic = "{camera}/image_raw"
    joint_names = keypoint_set("mediapipe33").names

    def __init__(self, people: PeopleFinder) -> None:
        self._people = people

    def attach(self, node: Any, camera: str) -> None:
        """Nothing else of a camera is needed."""

    def detect(self, camera: str, message: Image, size: tuple[int, int]) -> Array:
        order = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0]}.get(message.encoding)
        if order is None:
            raise ValueError(f"images must be rgb8 or bgr8, not {message.encoding!r:.20}")
        rows = np.frombuffer(message.data, np.uint8)
        if message.step < 3 * message.width or len(rows) != message.height * message.step:
            raise ValueError("the image has not as many bytes as its size says")
        pixels = rows.reshape(message.height, message.step)[:, : 3 * message.width]
        image = pixels.reshape(message.height, message.width, 3)[..., order]
        people = np.array(self._people.find(camera, np.ascontiguousarray(image)))
        people = people.reshape(-1, len(self.joint_names), 3)
        return np.where(people[..., 2:] >= MIN_VISIBILITY, people[..., :2], np.nan)


def make_detector(_: Faults) -> MediaPipeDetector:
    """Make the detector; it has faults of its own."""
    from mediapipe_people import People

    return MediaPipeDetector(People())


if __name__ == "__main__":
    from node import main

    sys.exit(main(make_detector))
