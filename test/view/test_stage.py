"""The 3D part of the page, without a browser."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial import KDTree

pytest.importorskip("viser")

from humansim_ros import Scene, load_human
from humansim_ros.view.panels.stage import PageBody, pose_message
from humansim_ros.view.sources.scene_source import SceneViewSource
from humansim_ros.view.sources.source import FrameRequest


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
    data = pose_message(7, [((1, 2, 3), bones, ends, np.array([0.5, 0.25]))], centers)
    assert np.frombuffer(data[:24], np.uint32).tolist() == [7, 1, 0x010203, 2, 1, 2]
    assert np.frombuffer(data[80:92], np.float32).tolist() == [7, 8, 9]
    assert np.frombuffer(data[92:100], np.float32).tolist() == [0.5, 0.25]
    assert json.loads(data[100:]) == {"left": [0.5, -2.0, 1.25]}
    assert np.frombuffer(data[24:80], np.float32).reshape(2, 7).tolist() == [
        [0, 0, 0, 1, 1, 2, 3],
        [0, 0, 0, 1, 4, 5, 6],
    ]


def test_a_face_moves_the_vertices_of_the_page_and_hands_and_eyes_turn() -> None:
    face = {"keys": [{"expression": "happiness", "actions": {"jawOpen": 0.5}}, {"gaze": "front"}]}
    scene = Scene.from_dict(
        {
            "room": None,
            "humans": {
                "anna": {"body": "adult_woman", "motion": {"file": "stand", "hands": "fist"}, "face": face}
            },
            "cameras": {"front": {"position": [3, 1, 1.6], "look_at": [0, 0, 1.5]}},
        }
    )
    actor, frame = scene.actors["anna"], SceneViewSource(scene).frame(0)
    state, body = actor.at(0.0), PageBody(scene.actors["anna"].human)
    # with hands and eyes; shapes open the jaw of the page, not its bone
    same = [
        number for number, name in enumerate(state.joint_names) if not name.startswith("temporomandibular")
    ]
    np.testing.assert_allclose(frame.joints["anna"][same], state.joints[same], atol=1e-12)
    data = body.shapes
    assert data is not None
    count, rows = np.frombuffer(data, np.uint32, 2).tolist()
    starts = np.frombuffer(data, np.uint32, count + 1, 8)
    vertices = np.frombuffer(data, np.uint32, rows, 12 + 4 * count)
    offsets = np.frombuffer(data, np.float32, 3 * rows, 12 + 4 * (count + rows)).reshape(-1, 3)
    moved = body.vertices.copy()
    np.add.at(moved, vertices, np.repeat(frame.faces["anna"], np.diff(starts))[:, None] * offsets)
    human = actor.human
    expected = human.pose(human.skeleton.rest, frame.faces["anna"])
    np.testing.assert_allclose(moved[: len(expected)], expected, atol=1e-5)
    assert np.abs(moved[: len(expected)] - human.mesh.vertices).max() > 0.01
    copies = {tuple(each) for each in moved.round(5).tolist()}  # at seams of the texture
    assert copies <= {tuple(each) for each in moved[: len(expected)].round(5).tolist()}
    assert (
        PageBody(load_human("adult_man")).shapes is not None
        and not SceneViewSource(Scene.load()).frame(0).faces
    )


def test_scans_lie_on_the_people_and_things_of_their_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Scene, "make_renderer", None)  # rays need none
    scene = Scene.from_dict(
        {
            "rate": 30,
            "room": None,
            "objects": {"wall": {"size": [0.1, 6, 3], "position": [2.4, 0, 1.5]}},
            "humans": {"anna": {"body": "adult_woman", "motion": {"file": "walk", "position": [1, 0]}}},
            "cameras": {"eye": {"position": [2, 2, 1.5], "look_at": [0, 0, 1], "size": [64, 48]}},
            "scanners": {"lidar": {"model": "velodyne_vlp16", "position": [-1.5, 0.5, 1]}},
        }
    )
    source = SceneViewSource(scene)
    wanted = FrameRequest(scans=True)
    assert source.frame(2, wanted).scans == {}  # the first sweep ends after 0.1 s
    last, same = (source.frame(index, wanted).scans["lidar"] for index in (3, 5))
    assert same["anna"] is last["anna"]  # the next one ends at frame 6
    body = scene.actors["anna"].at(scene.frame_time(3) * 1e-9).vertices
    distance, _ = KDTree(body).query(last["anna"])
    assert len(distance) > 100
    assert np.median(distance) < 0.05 and distance.max() < 0.25  # people move during a sweep
    assert len(last[""]) > 1000
    assert np.percentile(np.abs(last[""][:, 0] - 2.35), 95) < 0.1  # the range has noise
    source.close()
