"""Avoidance of collisions: the linear program against SciPy, and people who meet."""

from typing import Any

import numpy as np
import scipy.optimize

from humansim_ros.scene.features.crowd.walking import Walkers, nearest_allowed

NOWHERE = np.full((1, 1, 2), 1e6)


def test_velocity_is_the_nearest_one_within_half_planes_and_disc() -> None:
    rng = np.random.default_rng(2)
    solved = 0
    for _ in range(40):
        angles = rng.uniform(0, 2 * np.pi, 5)
        normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        offsets = rng.uniform(-1.2, 0.3, 5)
        goal = rng.uniform(-1.5, 1.5, 2)
        truth = scipy.optimize.minimize(
            lambda v, goal=goal: ((v - goal) ** 2).sum(),
            np.zeros(2),
            jac=lambda v, goal=goal: 2 * (v - goal),
            constraints=[
                {"type": "ineq", "fun": lambda v, n=normals, c=offsets: n @ v - c},
                {"type": "ineq", "fun": lambda v: 1.5**2 - v @ v},
            ],
            options={"ftol": 1e-14, "maxiter": 300},
        )
        if not truth.success or (normals @ truth.x - offsets).min() < -1e-6:
            continue  # no velocity keeps all of them
        found = nearest_allowed(goal[None], normals[None], offsets[None], np.array([1.5]), 0)[0]
        assert (normals @ found - offsets).min() > -1e-9
        assert found @ found < 1.5**2 + 1e-9
        assert abs(((found - goal) ** 2).sum() - truth.fun) < 1e-4
        solved += 1
    assert solved > 25


def walk(starts: Any, goals: Any, seconds: float, waiting: Any = None) -> Any:
    """Paths (K, N, 2) of people who walk to their goals, without anything in their way."""
    at = np.array(starts, dtype=float)
    count = len(at)
    velocity, path = np.zeros((count, 2)), [at]
    still = np.zeros(count, bool) if waiting is None else np.array(waiting)
    for _ in range(round(seconds / 0.1)):
        line = np.array(goals) - at
        wish = 1.3 * line / np.maximum(np.linalg.norm(line, axis=1, keepdims=True), 0.2)
        people = Walkers(at, velocity, np.full(count, 0.3), np.full(count, 1.5), still)
        velocity = people.avoiding(wish, np.repeat(NOWHERE, count, axis=0), 0.0, 2.0, 0.1)
        at = at + 0.1 * velocity
        path.append(at)
    return np.array(path)


def test_two_who_meet_pass_each_other_without_touching() -> None:
    path = walk([(-4, 0), (4, 0.05)], [(4, 0), (-4, 0)], 12)
    assert np.linalg.norm(path[:, 0] - path[:, 1], axis=1).min() > 0.6 - 1e-6
    assert np.allclose(path[-1], [(4, 0), (-4, 0)], atol=0.1)


def test_ten_on_a_circle_reach_the_opposite_side_without_touching() -> None:
    angles = np.arange(10) * (2 * np.pi / 10) + 0.03 * np.arange(10)
    starts = 4 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    path = walk(starts, -starts, 25)
    apart = np.linalg.norm(path[:, :, None] - path[:, None], axis=-1) + 9 * np.eye(10)
    # in the middle no velocity keeps all half-planes: some come a little nearer for a moment
    assert apart.min() > 0.6 - 0.12
    assert np.mean(apart.min(axis=(1, 2)) < 0.6 - 0.01) < 0.05
    assert np.allclose(path[-1], -starts, atol=0.2)


def test_one_who_waits_stays_and_the_other_goes_around() -> None:
    path = walk([(-3, 0.02), (0, 0)], [(3, 0), (0, 0)], 8, waiting=[False, True])
    assert (path[:, 1] == 0).all()
    assert np.linalg.norm(path[:, 0], axis=1).min() > 0.6 - 1e-6
    assert np.allclose(path[-1, 0], (3, 0), atol=0.1)


def test_nobody_walks_into_a_point_that_is_in_the_way() -> None:
    people = Walkers(np.zeros((1, 2)), np.zeros((1, 2)), np.array([0.3]), np.array([1.5]), np.array([False]))
    wall = np.stack([np.full(21, 1.0), np.linspace(-1, 1, 21)], axis=-1)[None]
    velocity = people.avoiding(np.array([[1.4, 0.3]]), wall, 0.05, 2.0, 0.1)[0]
    # at most the distance to the wall, 0.65 m, in the horizon of a second
    assert 0.5 < velocity[0] <= 0.65 + 1e-9
    assert velocity[1] > 0.2
