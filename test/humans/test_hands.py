"""Hands at rest are relaxed: fingers half bent and closed, in the built-in humans and in the method."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT

from humansim_ros.humans.loading import load_human
from humansim_ros.humans.makehuman.building import relax_hands
from humansim_ros.io.assets import built_in_names
from humansim_ros.types import Array


@pytest.mark.parametrize("name", built_in_names("humans"))
@pytest.mark.parametrize("side", ["l", "r"])
def test_the_fingers_of_each_built_in_human_are_half_bent(name: str, side: str) -> None:
    """In T pose with the palm down. Straight fingers would reach the end of the bone."""
    human = load_human(ROOT / "assets" / "humans" / f"{name}.npz")
    bone = human.skeleton.bone(f"{side}_wrist")
    wrist, length = (
        human.skeleton.heads[bone],
        np.ptp([human.skeleton.heads[bone], human.skeleton.tails[bone]], 0).max(),
    )
    out = (human.mesh.vertices - wrist) * [1.0 if side == "l" else -1.0, 1.0, 1.0] / length
    hand = out[out[:, 0] > 0.2]
    assert 0.65 < hand[:, 0].max() < 0.9
    tips = hand[hand[:, 0] > 0.6]
    assert -0.6 < tips[:, 1].min() < -0.2  # below the palm, and no fist


def straight_hand() -> tuple[dict[str, Array], dict[str, list[tuple[int, float]]], Array]:
    """Landmarks, weights and vertices of two hands: palms down, a vertex at each joint and each tip."""
    points: dict[str, Array] = {}
    weights: dict[str, list[tuple[int, float]]] = {}
    vertices = [np.zeros(3)]
    for side, out in (("l", 1.0), ("r", -1.0)):
        points[f"joint-{side}-hand"] = np.array([0.6 * out, 1.4, 0.0])
        for finger in range(1, 6):
            base = (
                np.array([0.70, 1.4, 0.04 - 0.02 * (finger - 2)])
                if finger > 1
                else np.array([0.63, 1.39, 0.05])
            )
            along = (
                np.array([0.03, 0, 0.004 * (3 - finger)]) if finger > 1 else np.array([0.02, -0.005, 0.02])
            )
            for joint in range(4):
                place = (base + joint * along) * [out, 1, 1]
                points[f"joint-{side}-finger-{finger}-{joint + 1}"] = place
                vertices.append(place)
                if joint:
                    weights[f"finger{finger}-{joint}.{side.upper()}"] = [(len(vertices) - 1, 1.0)]
    return points, weights, np.array(vertices)


def test_fingers_bend_to_the_palm_by_the_angles_of_a_hand_at_rest() -> None:
    points, weights, vertices = straight_hand()
    moved = relax_hands(SimpleNamespace(weights=weights), vertices, points)  # type: ignore[arg-type]
    left, right = moved[1:21].reshape(5, 4, 3), moved[21:].reshape(5, 4, 3)
    np.testing.assert_allclose(right, left * [-1, 1, 1], atol=1e-9)
    before = vertices[1:21].reshape(5, 4, 3)
    np.testing.assert_allclose(left[:, 0], before[:, 0])  # the knuckles stay
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(left, axis=1), axis=2), np.linalg.norm(np.diff(before, axis=1), axis=2)
    )
    for finger in range(1, 5):
        steps = np.diff(left[finger], axis=0)
        drops = np.degrees(np.arcsin(-steps[:, 1] / np.linalg.norm(steps, axis=1)))
        assert 15 < drops[0] < 35
        assert (np.diff(drops) > 10).all()  # each joint bends further down
        assert 55 < drops[2] < 90
    assert (np.diff(left[1:, 3, 1]) < 0).all()  # the little finger is bent most
    # closed: fingertips are nearer to each other than the fingers were spread
    assert np.ptp(left[1:, 3, 2]) < np.ptp(before[1:, 3, 2])
