"""The 3D part of the page, without a browser."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("viser")

from humansim_ros import Scene
from humansim_ros.view.scene_source import SceneViewSource
from humansim_ros.view.stage import PageBody, pose_message


def test_four_bones_pose_the_skin_of_the_page_as_all_bones_do() -> None:
    """Chromium shows the same with three.js in test_page.py."""
    scene = Scene.load()
    (name, actor), index = next(iter(scene.actors.items())), 23
    body = PageBody(actor.human)
    bones = SceneViewSource(scene).frame(index).joints[name][: len(body.rest)]
    moves = bones @ np.linalg.inv(body.rest)
    assert ((body.weights > 0).sum(axis=1) <= 4).all()
    rest = np.column_stack([body.vertices, np.ones(len(body.vertices))])
    posed = np.einsum("vb,bij,vj->vi", body.weights, moves[:, :3], rest, optimize=True)
    expected = actor.at(scene.frame_time(index) * 1e-9).vertices
    distances = np.linalg.norm(posed[: len(expected)] - expected, axis=1)
    assert np.median(distances) < 1e-4 and distances.max() < 5e-3


def test_a_message_has_bones_and_end_points_of_each_person_and_the_cameras() -> None:
    bones = np.tile(np.eye(4), (2, 1, 1))
    bones[:, :3, 3] = [[1, 2, 3], [4, 5, 6]]
    ends, centers = np.array([[7, 8, 9]]), {"left": np.array([0.5, -2.0, 1.25])}
    data = pose_message(7, [((1, 2, 3), bones, ends)], centers)
    assert np.frombuffer(data[:20], np.uint32).tolist() == [7, 1, 0x010203, 2, 1]
    assert np.frombuffer(data[76:88], np.float32).tolist() == [7, 8, 9]
    assert json.loads(data[88:]) == {"left": [0.5, -2.0, 1.25]}
    assert np.frombuffer(data[20:76], np.float32).reshape(2, 7).tolist() == [
        [0, 0, 0, 1, 1, 2, 3],
        [0, 0, 0, 1, 4, 5, 6],
    ]
