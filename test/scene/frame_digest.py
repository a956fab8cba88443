"""Digests of frames. As a program: a line of JSON for each file with a pickled frame or scene."""

from __future__ import annotations

import hashlib
import json
import pickle
import sys
from pathlib import Path

from humansim_ros import Scene, Simulation
from humansim_ros.data.messages.cdr import serialised
from humansim_ros.data.messages.topics import scene_topics
from humansim_ros.render.interface.channels import ALL_CHANNELS
from humansim_ros.scene.core import Frame, Needs

#: Frame that is compared: sweeps of all scanners have ended with it.
INDEX = 6


def simulated(scene: Scene) -> Frame:
    """A frame of a scene with all channels."""
    with Simulation(scene) as simulation:
        rectified = [name for name, each in scene.scene_cameras.items() if each.rectified]
        frame = simulation.frame(INDEX, Needs(ALL_CHANNELS, scanners=None, rectified=rectified))
        for name in frame.depth_sensors:
            frame.depth_sensors[name].aligned  # noqa: B018  # rendered on access
        return frame


def digest(scene: Scene, frame: Frame) -> dict[str, str]:
    """Hash of all messages of a frame, by topic: images, truth, sweeps, people."""
    hashes = {}
    for topic in scene_topics(scene, png_labels=True):
        parts = hashlib.sha256()
        for time, message in topic.sent(frame):
            parts.update(f"{time} ".encode() + bytes(serialised(message, topic.type_name)))
        hashes[f"{topic.name} {topic.type_name}"] = parts.hexdigest()
    return hashes


def main() -> None:
    for path in map(Path, sys.argv[1:]):
        kind, scene, frame = pickle.loads(path.read_bytes())  # written by the test
        print(json.dumps(digest(scene, simulated(scene) if kind == "scene" else frame)))


if __name__ == "__main__":
    main()
