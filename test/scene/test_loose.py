"""Loose cloth and hair: springs over the path of the body, in vertices, velocities, flow and messages."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loose_figures import loose_child
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from humansim_ros import Human, Scene, Simulation, load_human
from humansim_ros.data import messages
from humansim_ros.data.messages.humans import motion_message, rated_message, read_joints
from humansim_ros.errors import MeshError, MotionError, RosError
from humansim_ros.motion.body.offsets import CLOTH, HAIR, swing_at_rest
from humansim_ros.people.humans.human import human_from_arrays, write_human
from humansim_ros.people.makehuman.building import build
from humansim_ros.people.makehuman.data import people_data
from humansim_ros.people.makehuman.shape import MakeHumanConfig, Outfit
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.live import JointSource, LiveRetargeter
from humansim_ros.scene.features.cloth import layer as loose_swing
from humansim_ros.scene.features.cloth.layer import LooseSwing
from humansim_ros.types import Array


def scene(folder: Path, motion: Any = "run", camera: Any = None) -> Scene:
    write_human(folder / "anna.npz", loose_child(), 1)
    camera = {"position": [3, 0, 1], "look_at": [0, 0, 0.7], "size": [200, 150]} | (camera or {})
    humans = {"anna": {"body": str(folder / "anna.npz"), "motion": motion}}
    return Scene.from_dict({"room": None, "rate": 30, "humans": humans, "cameras": {"front": camera}})


@pytest.fixture
def anna(tmp_path: Path) -> Actor:
    return scene(tmp_path).actors["anna"]


def swing_of(path: Any, kinds: tuple[int, ...] = (CLOTH,), length: float = 1000.0) -> LooseSwing:
    """Swing of ends on a path (N,) -> (N, 3), which hang by ``length`` metres."""

    def ends_at(times: Array) -> tuple[Array, Array, Array]:
        lower = np.repeat(path(times)[:, None], len(kinds), axis=1)
        outwards = np.broadcast_to([0.0, 1.0, 0.0], lower.shape)
        return lower + np.array([0, 0, length]), lower, outwards

    return LooseSwing(kinds, ends_at)


@pytest.mark.parametrize(
    ("kind", "frequency", "damping"), [(CLOTH, 1.7, 0.45), (HAIR, 1.6, 0.42)], ids=("cloth", "hair")
)
def test_an_end_swings_like_a_damped_spring(
    kind: int, frequency: float, damping: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The differential equation without drag, integrated by SciPy, of a body that moves and stops."""
    springs = loose_swing._SPRINGS
    monkeypatch.setitem(springs, kind, replace(springs[kind], drag=0.0))
    times = np.arange(-3, 6, 0.01)
    x = 0.3 * np.sin(2 * np.pi * 0.9 * times) * np.exp(-((times / 1.2) ** 2))
    spline, omega = CubicSpline(times, x), 2 * np.pi * frequency

    def rates(time: float, state: Array) -> list[float]:
        u, v = state
        return [v, -spline(time, 2) - 2 * damping * omega * v - omega**2 * u]

    asked = np.arange(-1, 3, 0.07)
    exact = solve_ivp(rates, (-3, 6), [0.0, 0.0], t_eval=asked, max_step=0.01).y[0]
    swing = swing_of(lambda t: np.stack([spline(t), 0 * t, 0 * t], axis=1), (kind,))
    got = np.array([swing.at(time).values[0, 0] for time in asked])
    assert np.abs(exact).max() > 0.05
    # the path is cut after a second and sampled 30 times a second
    assert np.abs(got - exact).max() < 0.15 * np.abs(exact).max()


def test_an_end_lags_at_constant_speed_and_rests_when_nothing_moves() -> None:
    moving = swing_of(lambda t: np.stack([2.0 * t, 0 * t, 0 * t], axis=1), (CLOTH, HAIR))
    np.testing.assert_allclose(moving.at(3.217).values, [[-0.06, 0, 0], [-0.04, 0, 0]], atol=1e-5)
    still = swing_of(lambda t: np.ones((len(t), 3)))
    assert not still.at(3.2).values.any() and not still.at(3.2).rates.any()


def test_a_jump_swings_nothing() -> None:
    jump = swing_of(lambda t: np.stack([5.0 * (t > 1), 0 * t, 0 * t], axis=1))
    assert not any(jump.at(time).values.any() for time in np.arange(0.5, 2.5, 0.1))


def test_a_swing_is_limited_keeps_the_length_and_stays_outside() -> None:
    swing = swing_of(lambda t: np.stack([0 * t, -np.abs(4 * t), 0 * t], axis=1), length=0.5)
    reached = []
    for time in np.arange(-0.5, 1.5, 1 / 30):
        offset = swing.at(round(time * 30) / 30).values[0]
        assert np.linalg.norm(offset - np.array([0, 0, 0.5])) == pytest.approx(0.5, abs=1e-6)
        reached.append(offset[1])
    assert min(reached) > -0.0101 and 0.05 < max(reached) < 0.5 * 0.3 + 0.001


def test_rates_are_the_velocities_of_the_offsets(anna: Actor) -> None:
    for time in (0.31, 0.4, 0.55):
        before, now, after = (anna.at(time + step).swing for step in (-1e-4, 0, 1e-4))
        assert before is not None and now is not None and after is not None
        measured = (after.values - before.values) / 2e-4
        assert np.abs(measured).max() > 0.05
        np.testing.assert_allclose(now.rates, measured, atol=0.02 * np.abs(measured).max() + 1e-3)


def test_who_stands_still_has_the_vertices_of_the_bones_alone(tmp_path: Path) -> None:
    standing = scene(tmp_path, "t_to_a_pose").actors["anna"]
    stiff = replace(standing, human=replace(standing.human, loose=None))
    last = standing.motion.duration + 2.0  # it has been at rest for a while
    still = scene(tmp_path, {"file": "t_to_a_pose", "loop": "none"}).actors["anna"]
    np.testing.assert_array_equal(
        still.at(last).vertices, replace(still, human=stiff.human).at(last).vertices
    )
    assert stiff.at(0.5).swing is None
    assert not any("loose" in name for name in stiff.joint_poses(0.5).names)


def test_a_frame_does_not_depend_on_those_before(tmp_path: Path, anna: Actor) -> None:
    times = [0.7, 0.1, 12.3, 0.7333]
    forwards = {time: anna.at(time) for time in times}
    backwards = {time: scene(tmp_path).actors["anna"].at(time) for time in reversed(times)}
    for time in times:
        np.testing.assert_array_equal(forwards[time].vertices, backwards[time].vertices)
    moved = forwards[0.7].swing
    assert moved is not None and np.abs(moved.values).max() > 0.005


def test_a_message_of_the_player_carries_the_swing(anna: Actor) -> None:
    own, poses = anna.at(0.63), anna.joint_poses(0.63)
    sent = read_joints(motion_message(poses, 5))
    got = LiveRetargeter(anna).retarget(sent)
    assert own.swing is not None and got.swing is not None
    assert np.array_equal(got.vertices, own.vertices) and np.array_equal(got.joints, own.joints)
    assert np.array_equal([got.swing.values, got.swing.rates], [own.swing.values, own.swing.rates])
    assert not any("loose" in name for name in JointSource.of_actor(anna).names)
    assert set(poses.split(lambda name: name.startswith("loose/"))[0].names) == set(anna.motion.names)
    # who sends joints alone moves the body without a swing
    bare = LiveRetargeter(anna).retarget(poses.split(lambda name: name.startswith("loose/"))[0])
    assert bare.swing is None and np.array_equal(bare.joints, own.joints)
    assert np.abs(bare.vertices - own.vertices).max() > 0.003


def test_wrong_joints_of_a_swing_are_refused(anna: Actor) -> None:
    poses, live = anna.joint_poses(0.63), LiveRetargeter(anna)
    with pytest.raises(MotionError, match=r"2 joints of loose .* needs loose/origin and loose/0 to loose/1"):
        live.retarget(poses.first(len(poses.names) - 1))
    far = poses.positions.copy()
    far[0, -1] += 3
    with pytest.raises(MotionError, match="more than 2 m away"):
        live.retarget(replace(poses, positions=far))
    stiff = anna.with_layer("cloth", settings=())
    with pytest.raises(MotionError, match="this body needs none"):
        LiveRetargeter(stiff).retarget(poses)


def test_the_swing_has_a_topic(anna: Actor) -> None:
    state = anna.at(0.63)
    read = messages.read_rated(rated_message(state.swing, 7), swing_at_rest(2))
    assert state.swing is not None
    np.testing.assert_array_equal(read.values, state.swing.values)
    np.testing.assert_array_equal(read.rates, state.swing.rates)
    with pytest.raises(RosError, match="6 names; needed are the 9 from 0/x to 2/z"):
        messages.read_rated(rated_message(state.swing, 7), swing_at_rest(3))
    wrong = rated_message(state.swing, 7)
    wrong.position[0] = float("nan")
    with pytest.raises(RosError, match="not finite"):
        messages.read_rated(wrong, swing_at_rest(2))


def test_vertices_around_the_stamp_move_with_the_swing(anna: Actor) -> None:
    state, step = anna.at(0.55), 3e-3
    assert state.linear is not None and state.angular is not None and state.swing is not None
    loose = anna.human.loose
    assert loose is not None
    before, after = (anna.moved(state, sign * step) for sign in (-1, 1))
    measured = (anna.at(0.55 + step).vertices - anna.at(0.55 - step).vertices)[loose.rows]
    assert np.abs((after - before)[loose.rows] - measured).max() < 0.03 * np.abs(measured).max()


def test_flow_leads_to_where_the_swinging_point_is_in_the_next_frame(tmp_path: Path) -> None:
    """Points of loose triangles at the depth of their pixel, carried to the next frame by barycentrics."""
    with Simulation(scene(tmp_path), ("depth", "face", "flow")) as simulation:
        now, after = simulation.frame(16), simulation.frame(17)
    view, camera = now.views["front"], now.cameras["front"]
    human = loose_child()
    assert human.loose is not None
    triangles = human.mesh.triangles
    loose = np.isin(triangles, human.loose.rows).all(axis=1)
    rows, columns = np.nonzero((view.face > 0) & loose[view.face - 1])
    assert len(rows) > 50
    pixels = np.stack([columns, rows], axis=1).astype(float)
    points = camera.unproject(pixels, view.depth[rows, columns].astype(float))
    corners = triangles[view.face[rows, columns] - 1]
    a, b, c = np.moveaxis(now.humans["anna"].vertices.astype(float)[corners], 1, 0)
    basis = np.stack([b - a, c - a, np.cross(b - a, c - a)], axis=2)
    s, t, _ = np.linalg.solve(basis, (points - a)[..., None])[..., 0].T
    a, b, c = np.moveaxis(after.humans["anna"].vertices.astype(float)[corners], 1, 0)
    there = a + s[:, None] * (b - a) + t[:, None] * (c - a)
    moved = camera.project(there)[0] - pixels
    error = np.abs(view.flow[rows, columns] - moved).max(axis=1)
    assert np.quantile(error, 0.95) < 0.02 and np.abs(moved).max() > 1


@cache
def dressed(bottom: str, top: str = "shirt") -> Human:
    config = MakeHumanConfig(gender=0.0, top=top, bottom=bottom, hair="tail")  # type: ignore[arg-type]
    arrays = build(people_data(), config, {"own": Outfit()}, fine=False)
    return human_from_arrays(arrays, bottom)


def distance_to_legs(state: Any, points: Array) -> Array:
    """Distance (N,) of points from the axes of thighs and calves."""
    nearest = []
    for side in "lr":
        joints = [
            state.positions[state.joint_names.index(f"{side}_{name}")] for name in ("hip", "knee", "ankle")
        ]
        for start, end in pairwise(joints):
            along = end - start
            share = np.clip((points - start) @ along / (along @ along), 0, 1)
            nearest.append(np.linalg.norm(points - start - share[:, None] * along, axis=1))
    return np.min(nearest, axis=0)


def playing(human: Human, motion: str) -> Actor:
    small = {"position": [3, 0, 1], "look_at": [0, 0, 1]}
    config = {"humans": {"a": {"body": "child", "motion": motion}}, "cameras": {"c": small}}
    actor = Scene.from_dict(config).actors["a"]
    section = Scene.from_dict(config).config.humans["a"].motion
    return Actor.build("a", 1, human, section, Scene.from_dict(config).source, actor.motion.motion)


@pytest.mark.parametrize(("top", "bottom"), [("dress", "tights"), ("coat", "trousers"), ("shirt", "skirt")])
def test_no_slit_opens_at_the_waist_of_who_bends(top: str, bottom: str) -> None:
    human = dressed(bottom, top)
    assert human.loose is not None and human.mesh.off_body is not None
    waist = human.loose.ends[human.loose.kinds == CLOTH, 0]
    body = np.unique(human.mesh.faces[~human.mesh.off_body])[1:]  # -1 pads triangles
    rest = human.mesh.vertices.astype(float)
    below = body[np.linalg.norm(rest[waist, None] - rest[body], axis=2).argmin(axis=1)]
    before = np.linalg.norm(rest[waist] - rest[below], axis=1)
    assert before.max() < 0.022  # to the nearest vertex
    actor = playing(human, "pick_up")
    for time in (1.0, 1.5):
        points = actor.at(time).vertices
        after = np.linalg.norm(points[waist] - points[below], axis=1)
        assert (after < before + 0.006).all(), (after, before)


@pytest.mark.slow
@pytest.mark.daily("walk-skirt", "run-long_skirt")
@pytest.mark.parametrize(("motion", "bottom"), [("walk", "skirt"), ("run", "skirt"), ("run", "long_skirt")])
def test_hems_swing_and_stay_outside_the_legs(motion: str, bottom: str) -> None:
    actor = playing(dressed(bottom), motion)
    loose = actor.human.loose
    assert loose is not None and (loose.kinds == CLOTH).sum() == 8 and (loose.kinds == HAIR).sum() == 1
    cloth = np.isin(loose.nodes, np.flatnonzero(loose.kinds == CLOTH)).all(axis=1)
    rows = loose.rows[cloth & (loose.shares.sum(axis=1) > 0.5)]
    stiff = replace(actor, human=replace(actor.human, loose=replace(loose, shares=0 * loose.shares)))
    largest = 0.0
    for time in np.arange(1.0, 2.0, 0.13):
        swung, bones = actor.at(time), stiff.at(time).vertices[rows].astype(float)
        points = swung.vertices[rows].astype(float)
        largest = max(largest, float(np.abs(points - bones).max()))
        before, after = (distance_to_legs(swung, each) for each in (bones, points))
        # a thigh has a radius of 0.08 m; held off one bone, cloth may come a little nearer to another
        assert (after > np.minimum(before, 0.11) - 0.008).all(), time
    assert 0.05 < largest < 0.3


@pytest.mark.slow
def test_cloth_of_who_sits_lies_on_the_thighs() -> None:
    actor = playing(dressed("skirt"), "sit")
    stiff = replace(actor, human=replace(actor.human, loose=None))
    loose = actor.human.loose
    assert loose is not None
    rows = loose.rows[np.abs(loose.gather).max(axis=1) > 0.01]
    sitting, before = actor.at(1.0), stiff.at(1.0)
    lowest, sagging = sitting.vertices[rows, 2].min(), before.vertices[rows, 2].min()
    assert lowest > sagging + 0.05
    assert distance_to_legs(sitting, sitting.vertices[rows].astype(float)).max() < 0.2
    assert distance_to_legs(sitting, before.vertices[rows].astype(float)).max() > 0.2


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("kinds", np.array([0, 2], np.uint8), "must be from 0 to 1"),
        ("kinds", np.zeros(0, np.uint8), "needs 1 to 64 ends, not 0"),
        ("kinds", np.zeros(65, np.uint8), "needs 1 to 64 ends, not 65"),
        ("ends", np.full((2, 2), 10**6, np.int32), "must be from 0 to"),
        ("ends", np.zeros((2, 2)), r"must be \(2, 2\) int32"),
        ("outwards", np.full((2, 3), np.nan, np.float32), "must be finite and at most 1"),
        ("nodes", -1, "must be from 0 to 1"),
        ("shares", 9, "must be finite and at most 1"),
        ("gather", np.zeros((1, 3), np.float32), "must be"),
        ("rows", 5, "a vertex is there twice"),
    ],
)
def test_wrong_loose_parts_in_a_file_are_named(tmp_path: Path, key: str, value: Any, reason: str) -> None:
    write_human(tmp_path / "wrong.npz", loose_child(), 1)
    with np.load(tmp_path / "wrong.npz") as file:
        arrays = dict(file)
    name = f"loose_{key}"
    arrays[name] = np.full_like(arrays[name], value) if isinstance(value, int) else value
    np.savez(tmp_path / "wrong.npz", **arrays)
    with pytest.raises(MeshError, match=rf"wrong\.npz: {name}: .*{reason}"):
        load_human(tmp_path / "wrong.npz")
