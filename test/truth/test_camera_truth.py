"""CameraTruth: the values of the functions of this folder by name, computed once and only on access."""

from __future__ import annotations

import numpy as np
import pytest
from render_scenes import body, box

from humansim_ros.camera import Camera
from humansim_ros.render import View
from humansim_ros.truth import CameraTruth, view_boxes, view_joints, visible_vertices
from humansim_ros.types import Array

CAMERA = Camera((8, 6), np.array([[4.0, 0, 3.5], [0, 4, 2.5], [0, 0, 1]]), np.eye(3), np.zeros(3))
BODIES = [body(box((0, 0, 3), 0.5), instance=2), body(box((0, 0, 2), 0.5), instance=1)]
LABELS = {"anna": 1, "crate": 2}
JOINTS: Array = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, 4.0]])
SURFACES = np.ones((2, 256), dtype=bool)


def view() -> View:
    """A view that shows anna everywhere, one metre and a half away."""
    return View(
        depth=np.full((6, 8), 1.5, np.float32),
        instance=np.full((6, 8), 1, np.uint16),
        part=np.full((6, 8), 5, np.uint8),
        amodal={1: np.ones((6, 8), bool), 2: np.ones((6, 8), bool)},
    )


def truth_of(shown: View) -> CameraTruth:
    return CameraTruth(CAMERA, shown, BODIES, LABELS, {"anna": SURFACES}, lambda name: JOINTS)


def test_values_are_those_of_the_functions_by_name() -> None:
    truth, shown = truth_of(view()), view()
    joints = view_joints(CAMERA, JOINTS, shown, 1, SURFACES, [2])
    np.testing.assert_array_equal(truth.joints["anna"].visible, joints.visible)
    np.testing.assert_array_equal(truth.joints["anna"].occluder, joints.occluder)
    assert list(truth.joints) == ["anna"]
    boxes = view_boxes(CAMERA, BODIES, shown)
    masks = visible_vertices(CAMERA, BODIES, shown)
    assert set(truth.boxes) == set(truth.visible_vertices) == set(LABELS)
    for name, label in LABELS.items():
        assert truth.boxes[name].pixels == boxes[label].pixels
        np.testing.assert_array_equal(truth.boxes[name].whole, boxes[label].whole)
        np.testing.assert_array_equal(truth.visible_vertices[name], masks[label])


def test_joints_are_requested_on_first_access_only() -> None:
    requested: list[str] = []

    def positions(name: str) -> Array:
        requested.append(name)
        return JOINTS

    truth = CameraTruth(CAMERA, view(), BODIES, LABELS, {"anna": SURFACES}, positions)
    assert truth.boxes is truth.boxes
    assert requested == []
    assert truth.joints is truth.joints
    assert requested == ["anna"]


@pytest.mark.parametrize(
    ("absent", "kinds"),
    [
        ("part", {"boxes", "visible_vertices"}),
        ("amodal", {"joints", "visible_vertices"}),
        ("depth", {"boxes"}),
    ],
)
def test_it_has_what_the_channels_of_the_view_allow(absent: str, kinds: set[str]) -> None:
    channels = {name: channel for name, channel in vars(view()).items() if name != absent}
    truth = truth_of(View(**channels))
    assert {kind for kind in ("joints", "boxes", "visible_vertices") if truth.has(kind)} == kinds
