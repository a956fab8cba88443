"""The same scene shows the same on every run, whenever it is played and by whatever."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from ros_support import whole_flow, write_scene

from humansim_ros.scene import Scene, Simulation

NOISY = """
rate: 20
humans: {anna: {motion: {file: walk, position: [0.0, -1.0]}}}
cameras: {left: {size: [80, 60], position: [3.0, 2.6, 2.0], look_at: [0, 0, 0.8], sensor: {noise: {}}}}
"""


def test_noise_is_that_of_the_scene_time_at_any_stamp(ros: None, tmp_path: Path) -> None:
    from sensor_msgs.msg import Image

    scene = write_scene(tmp_path, NOISY)
    stamps, runs = [], []
    for namespace in ("now", "later"):
        topic = f"/{namespace}/left/image_raw"
        with whole_flow(scene, namespace, {Image: [topic]}, frames=3) as client:
            images = [np.array(image.data) for _, image in sorted(client.received[topic].items())]
            stamps.append(sorted(client.received[topic]))
            runs.append(images)
    assert not set(stamps[0]) & set(stamps[1])
    np.testing.assert_array_equal(runs[0], runs[1])
    with Simulation(Scene.load(scene), ("rgb",)) as simulation:
        for image, frame in zip(runs[0], simulation.frames(3), strict=True):
            # the noise of another time would change every second pixel
            assert (image != frame.views["left"].rgb.ravel()).mean() < 0.01
