"""Crowds: nobody touches another one, a wall or a thing; goals, groups and queues; feet that do not slide."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh

from humansim_ros.errors import HumansimError, HumansimWarning, SceneError
from humansim_ros.motion.pose.contacts import find_stances, slide_distances
from humansim_ros.motion.pose.path_motion import PathMotion, WalkPath
from humansim_ros.scene import Scene, Simulation
from humansim_ros.scene.config.config import check_config
from humansim_ros.scene.core.actor import joint_poses_of
from humansim_ros.scene.core.features import begin_draft
from humansim_ros.scene.core.playback import Playback
from humansim_ros.scene.core.source import SceneSource
from humansim_ros.scene.features.crowd.feature import FEATURE
from humansim_ros.scene.features.crowd.walking import WalkGrid
from humansim_ros.scene.features.room.feature import fixtures

CAMERA = {"eye": {"size": [160, 120], "position": [3.2, 2.9, 2.2], "look_at": [0, 0, 1]}}
ROOM = (12.0, 10.0, 2.8)
FLOWS = [
    {"start": [-5, -2, -3, 2], "goal": [3, -2, 5, 2]},
    {"start": [-2, 2, 2, 4], "goal": [-2, -4, 2, -2]},
]
QUEUE: dict[str, Any] = {"position": [4.0, -3.5], "direction_deg": 180, "count": 4, "service": 3}


def paths(room: Any = ROOM, objects: Any = None, robot: Any = None, **crowd: Any) -> dict[str, WalkPath]:
    content = {"cameras": CAMERA, "room": room and {"size": list(room)}, "crowd": {"seed": 5, **crowd}}
    content["robot"] = robot
    draft = begin_draft(check_config(content | {"objects": objects or {}}), SceneSource())
    FEATURE.expand(draft)
    motions = {name: actor.motion for name, actor in draft.actors.items()}
    return {name: motion.path for name, motion in motions.items() if isinstance(motion, PathMotion)}


@cache
def busy() -> dict[str, WalkPath]:
    """Two flows that meet, groups and a queue."""
    return paths(count=14, flows=tuple(FLOWS), groups=0.4, queues=(QUEUE,), duration=45)


def sampled(found: dict[str, WalkPath], step: float = 0.05) -> Any:
    """Positions (K, N, 2) in a round."""
    times = np.arange(0, next(iter(found.values())).duration, step)
    return np.stack([path.positions(times) for path in found.values()], axis=1)


def test_nobody_touches_another_one() -> None:
    points = sampled(busy())
    apart = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1) + 9 * np.eye(points.shape[1])
    assert apart.min() > 0.6 - 0.06  # two radii; the path rounds off the corners of the plan
    assert np.mean(apart.min(axis=(1, 2)) < 0.6 - 0.03) < 0.02


def test_nobody_walks_into_walls_or_furniture() -> None:
    points = sampled(busy()).reshape(-1, 2)
    half = np.array(ROOM[:2]) / 2
    assert (np.abs(points) < half - 0.3 + 0.03).all()
    for each in fixtures(ROOM[:2]).values():
        middle, size = each.center, each.size
        outside = np.maximum(np.abs(points - middle) - np.array(size) / 2, 0)
        assert np.linalg.norm(outside, axis=1).min() > 0.3 - 0.06


@pytest.mark.nightly
def test_nobody_walks_where_the_robot_drives() -> None:
    """Flows that cross it: people pass at every time, so that they keep away from its whole way."""
    robot = {"path": {"points": [[-1, -0.6], [1, -0.6], [1, 0.6]], "speed": 0.5}}
    way = np.array([(-1, -0.6), (0, -0.6), (1, -0.6), (1, 0), (1, 0.6)])

    def nearest(**changes: Any) -> float:
        points = sampled(paths(count=6, flows=tuple(FLOWS), duration=30, **changes)).reshape(-1, 1, 2)
        return float(np.linalg.norm(points - way, axis=-1).min())

    assert nearest() < 0.3 < 0.45 < nearest(robot=robot)  # radius, and half of the robot


def test_everybody_gets_to_the_goal_and_back() -> None:
    for path in list(busy().values())[4:]:
        points = path.positions(np.arange(0, path.duration, 0.1))
        reached = [
            [
                bool(
                    (np.abs(points - (x0 + x1, y0 + y1) / np.array(2.0)) < (x1 - x0 + 0.5, y1 - y0 + 0.5))
                    .all(1)
                    .any()
                )
                for x0, y0, x1, y1 in (flow["start"], flow["goal"])
            ]
            for flow in FLOWS
        ]
        assert any(all(ends) for ends in reached)
        assert np.linalg.norm(path.positions(np.array([path.duration - 1e-6])) - points[0]) < 0.05


def test_queue_moves_up_until_everybody_has_been_first() -> None:
    points = sampled(
        {name: path for name, path in busy().items() if name in {f"walker_{n}" for n in range(1, 5)}}
    )
    at_first = np.linalg.norm(points - QUEUE["position"], axis=-1) < 0.1
    assert at_first.any(axis=0).all()
    first = at_first.argmax(axis=0)
    assert (np.diff(first) > QUEUE["service"] / 0.05).all()
    assert at_first.sum(axis=1).max() == 1


def test_group_walks_side_by_side() -> None:
    pair = paths(count=2, groups=1.0, flows=({"start": [-5, -1, -4, 1], "goal": [4, -1, 5, 1]},), room=None)
    first, second = np.moveaxis(sampled(pair), 1, 0)
    velocity = np.gradient(first, 0.05, axis=0)
    straight = np.linalg.norm(velocity, axis=1) > 0.8
    line = (second - first)[straight]
    along = np.abs((line * velocity[straight]).sum(1)) / np.linalg.norm(velocity[straight], axis=1)
    assert np.median(np.linalg.norm(line, axis=1)) < 1.0
    assert np.median(along) < 0.35


def test_seed_decides() -> None:
    same, again, other = (paths(count=3, seed=seed, duration=10, area=[-3, -3, 3, 3]) for seed in (1, 1, 2))
    assert all((same[name].points == again[name].points).all() for name in same)
    assert any(not np.array_equal(same[name].points, other[name].points) for name in same)


def test_way_around_a_wall_is_short_and_free() -> None:
    wall = np.stack([np.zeros(161), np.linspace(-5, 3, 161)], axis=-1)
    plan = WalkGrid.of(np.array([[-5.0, -5.0], [5.0, 5.0]]), wall, 0.3)
    start, end = np.array([-3.0, 0.0]), np.array([3.0, 0.0])
    way = plan.way(start, end)
    assert way is not None
    line = np.array([start, *way])
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    corner = 2 * np.hypot(3.0, 3.35)  # around the end of the wall, at the distance of the radius
    assert corner - 0.1 < length < 1.06 * corner
    for a, b in pairwise(line):
        points = a + np.linspace(0, 1, 200)[:, None] * (b - a)
        assert np.linalg.norm(points[:, None] - wall, axis=-1).min() > 0.3 - 0.06
    high = np.stack([np.zeros(201), np.linspace(-5, 5, 201)], axis=-1)
    closed = WalkGrid.of(np.array([[-5.0, -5.0], [5.0, 5.0]]), high, 0.3)
    assert closed.way(start, end) is None


def test_more_people_than_room_is_an_error_with_the_number_that_fits() -> None:
    with pytest.raises(SceneError, match=r"has room for \d+ people, not for 90") as caught:
        paths(count=90, area=[-2, -2, 2, 2])
    assert caught.value.key == "crowd.count"
    fits = int(str(caught.value).split("room for ")[1].split()[0])
    # discs of a diameter of 0.7 m at random cover about half of the floor
    assert 0.4 * 16 / 0.385 < fits < 0.85 * 16 / 0.385


@pytest.mark.parametrize(
    ("crowd", "key"),
    [
        ({"count": 3, "flows": [{"start": [20, 20, 21, 21], "goal": [0, 0, 1, 1]}]}, "crowd.flows.0.start"),
        ({"count": 3, "queues": [{**QUEUE, "count": 5}]}, "crowd.queues.0.count"),
        ({"count": 9, "queues": [{**QUEUE, "position": [8, 0]}]}, "crowd.queues.0.position"),
        ({"count": 9, "queues": [{**QUEUE, "spacing": 0.5}]}, "crowd"),
        ({"count": 3, "area": [30, 30, 31, 31]}, "crowd.area"),
        ({"count": 3, "motions": ["wave"]}, "crowd.motions"),
    ],
)
def test_bad_crowd_is_an_error_with_the_key(crowd: Any, key: str) -> None:
    with pytest.raises(HumansimError) as caught:
        Scene.from_dict({"cameras": CAMERA, "room": {"size": list(ROOM)}, "crowd": crowd})
    assert caught.value.key == key


def test_crowd_that_cannot_get_back_warns_and_plays() -> None:
    walls = {"a": (-1, 0, 0.1, 4), "b": (1, 0, 0.1, 4), "c": (0, -2, 2, 0.1), "d": (0, 2, 2, 0.1)}
    cell = {
        name: {"mesh": "box", "size": [sx, sy, 2], "position": [x, y, 1]}
        for name, (x, y, sx, sy) in walls.items()
    }
    flows = [{"start": [-4, -1, -3, 1], "goal": [-0.5, -1, 0.5, 1]}]
    with pytest.warns(HumansimWarning, match="no way"):
        found = paths(count=3, flows=flows, duration=10, objects=cell)
    assert len(found) == 3


def test_simulation_shows_the_plan_at_any_time() -> None:
    content = {
        "cameras": CAMERA,
        "room": {"size": list(ROOM)},
        "crowd": {"count": 3, "seed": 4, "duration": 10},
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = Scene.from_dict(content)
    with Simulation(scene, channels=("instance",)) as simulation:
        late = simulation.frame(97)
        early = simulation.frame(4)
        again = simulation.frame(97)
    for name, actor in scene.actors.items():
        seconds = scene.frame_time(97) * 1e-9
        hips = late.humans[name].positions[list(late.humans[name].joint_names).index("sacroiliac"), :2]
        assert np.linalg.norm(hips - actor.motion.path.positions(np.array([seconds]))[0]) < 0.15  # type: ignore[attr-defined]
        assert (late.humans[name].vertices == again.humans[name].vertices).all()
        assert (late.humans[name].vertices != early.humans[name].vertices).any()


def test_people_are_sampled_together_to_the_same_bits_as_alone() -> None:
    crowd = {"count": 4, "seed": 2, "duration": 20}
    scene = Scene.from_dict({"cameras": CAMERA, "room": {"size": list(ROOM)}, "crowd": crowd})
    actors = dict(scene.actors)
    slow = replace(actors["walker_2"], offset=0.3, ahead=0.2)
    actors["walker_2"] = replace(slow, motion=replace(slow.motion, speed=0.5))
    for seconds in (0.0, 3.37, 19.99, 25.0):
        for name, poses in joint_poses_of(actors, seconds).items():
            alone = actors[name].joint_poses(seconds)
            assert alone.names == poses.names
            for field in ("positions", "rotations", "linear", "angular"):
                assert np.array_equal(getattr(alone, field), getattr(poses, field)), (name, field)


def test_person_with_another_speed_stays_on_the_path_and_with_another_motion_starts_where_it_began() -> None:
    scene = Scene.from_dict(
        {"cameras": CAMERA, "room": {"size": list(ROOM)}, "crowd": {"count": 2, "seed": 4, "duration": 10}}
    )
    playback = Playback(scene)
    playback.show(3 * 10**9)
    playback.change("walker_1", speed=0.5)
    slower = playback.show(5 * 10**9).motions["walker_1"].positions
    assert np.allclose(slower, scene.actors["walker_1"].joint_poses(4.0).positions, atol=1e-9)
    playback.change("walker_1", file="wave")
    hips = playback.show(5 * 10**9).motions["walker_1"].positions[0, 0, :2]
    home = scene.actors["walker_1"].motion.path.points[0]  # type: ignore[attr-defined]
    assert np.linalg.norm(hips - home) < 0.1


def test_feet_do_not_slide() -> None:
    scene = Scene.from_dict(
        {"cameras": CAMERA, "room": {"size": list(ROOM)}, "crowd": {"count": 3, "seed": 4, "duration": 15}}
    )
    times = np.arange(0, 15, 1 / 60)
    slid = stood = 0.0
    for actor in scene.actors.values():
        posed = actor.retargeter.pose(actor.motion.sample(times))
        stances = find_stances(actor.human.skeleton, posed, times)
        slid += slide_distances(actor.human.skeleton, posed, stances).sum()
        stood += sum(times[one.last] - times[one.first] for one in stances)
    assert slid / stood < 0.05  # m/s


def test_grid_knows_the_free_floor() -> None:
    box = trimesh.creation.box((1.0, 2.0, 1.0))
    points = trimesh.sample.sample_surface_even(box, 4000, seed=1)[0][:, :2]
    plan = WalkGrid.of(np.array([[-3.0, -3.0], [3.0, 3.0]]), points, 0.3)
    rng = np.random.default_rng(0)
    places = rng.uniform(-3.2, 3.2, (500, 2))
    outside = np.maximum(np.abs(places) - (0.5, 1.0), 0)
    distance = np.minimum(np.linalg.norm(outside, axis=1), 3 - np.abs(places).max(axis=1))
    free = plan.free(places)
    assert free[distance > 0.5].all()
    assert not free[distance < 0.25].any()
