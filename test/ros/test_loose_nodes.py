"""Loose cloth and hair, and materials, over the nodes: the same bytes as in Simulation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from loose_figures import loose_child
from ros_support import write_scene

from humansim_ros.data import messages
from humansim_ros.data.messages.types import Image
from humansim_ros.motion.body.offsets import swing_at_rest
from humansim_ros.people.humans.human import write_human
from humansim_ros.scene import Scene, Simulation
from humansim_ros.testing import SceneGraph

#: The shutter shows the body before and after the stamp, so that images need the velocity of the swing.
SCENE = """\
rate: 20
humans:
  anna: {body: anna.npz, motion: {file: run, position: [-0.6, 0]}}
cameras:
  left:
    size: [160, 120]
    position: [2.5, 0.9, 1.0]
    look_at: [0, 0, 0.7]
    sensor: {exposure_time: 0.02, samples: 3}
"""
IMAGES = {"image_raw": "rgb", "material/image": "material"}


def test_swing_and_images_equal_those_of_simulation(ros: None, tmp_path: Path) -> None:
    write_human(tmp_path / "anna.npz", loose_child(), 1)
    scene = Scene.load(write_scene(tmp_path, SCENE))
    topics = ("humans/anna/swing", "humans/anna/vertices", "scene_time", *(f"left/{name}" for name in IMAGES))
    with SceneGraph(scene, namespace="loose") as graph:
        received: dict[str, Any] = {topic: graph.subscribe(topic) for topic in topics}
        stamps = graph.play(3)
    with Simulation(scene, tuple(IMAGES.values())) as simulation:
        for stamp in stamps:
            index = messages.read_frame_number(received["scene_time"].at(stamp))
            assert index is not None
            frame = simulation.frame(index)
            human, view = frame.humans["anna"], frame.views["left"]
            assert human.swing is not None
            got = messages.read_rated(received["humans/anna/swing"].at(stamp), swing_at_rest(2))
            np.testing.assert_array_equal([got.values, got.rates], [human.swing.values, human.swing.rates])
            vertices = messages.read_vertices(received["humans/anna/vertices"].at(stamp))
            np.testing.assert_array_equal(vertices, human.vertices)
            for topic, channel in IMAGES.items():
                image: Image = received[f"left/{topic}"].at(stamp)
                assert bytes(image.data) == getattr(view, channel).tobytes(), topic
    assert human.swing is not None and np.abs(human.swing.rates).max() > 0.05
    assert len(np.unique(view.material)) > 3
