"""The bone of the jaw turns as the action jawOpen moves the lower teeth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from conftest import ROOT
from scipy.spatial.transform import Rotation
from test_makehuman import PEOPLE, needs_makehuman, person

from humansim_ros import Scene
from humansim_ros.body.face_actions import ACTIONS
from humansim_ros.body.jaw import BONE, Jaw
from humansim_ros.humans.description import ParametricHuman, read_description
from humansim_ros.humans.human import Human
from humansim_ros.humans.makehuman.data import METRES, find_data, read_base
from humansim_ros.humans.makehuman.shape import target_strengths, with_stature
from humansim_ros.scene.actor import Actor, HumanState
from humansim_ros.scene.live import LiveRetargeter
from humansim_ros.types import Array

OPEN = ACTIONS.index("jawOpen")


def jaw_of(human: Human) -> Jaw:
    jaw = Jaw.of(human.skeleton, human.mesh.vertices, human.weights, human.shapes)
    assert jaw is not None
    return jaw


@cache
def teeth(name: str) -> tuple[Array, Array]:
    """Lower teeth (K, 3) of a built-in human, which its file does not have, and offsets of jawOpen."""
    description = read_description(ROOT / "config" / "humans" / f"{name}.yaml")
    assert isinstance(description, ParametricHuman)
    source = find_data()
    config, scale = with_stature(source, description.makehuman)
    base = read_base(source, target_strengths(source, config))
    rows = base.vertex_groups["helper-lower-teeth"]
    moved, steps = source.face_action("jawOpen")
    offsets = np.zeros(base.vertices.shape)
    offsets[moved] = METRES * steps
    return scale * base.vertices[rows], scale * offsets[rows]


@needs_makehuman
@pytest.mark.parametrize("name", PEOPLE)
@pytest.mark.parametrize("weight", [0.3, 1.0])
def test_the_jaw_turns_as_the_lower_teeth_do(name: str, weight: float) -> None:
    human, (rest, offsets) = person(name), teeth(name)
    moved = rest + weight * offsets
    fitted, _ = Rotation.align_vectors(moved - moved.mean(axis=0), rest - rest.mean(axis=0))
    jaw = jaw_of(human)
    turn = Rotation.from_matrix(jaw.rest @ jaw.turns(np.array([weight]))[0] @ jaw.rest.T)
    assert np.degrees((turn * fitted.inv()).magnitude()) < 1.0
    assert np.degrees(turn.magnitude()) == pytest.approx(weight * 24.5, rel=0.25)
    assert turn.as_rotvec()[0] > 0.99 * turn.magnitude()  # the chin goes down


def actor_of(face: object, motion: str = "talk", body: str = "adult_woman") -> Actor:
    humans = {"anna": {"body": body, "motion": motion, "face": face}}
    cameras = {"front": {"position": [3, 0, 1.6], "look_at": [0, 0, 1.5]}}
    return Scene.from_dict({"room": None, "humans": humans, "cameras": cameras}).actors["anna"]


KEYS = [{"time": 0.5, "actions": {"jawOpen": 0.8}, "blend": 0.4}]


def turn_of(state: HumanState, other: HumanState) -> Rotation:
    number = state.joint_names.index(BONE)
    return Rotation.from_matrix(other.joints[number, :3, :3].T @ state.joints[number, :3, :3])


def test_joints_have_the_turn_and_vertices_move_once() -> None:
    actor, stiff = actor_of({"keys": KEYS}), actor_of({"keys": [{"actions": {"jawLeft": 0.8}}]})
    assert actor.at(0.3).joints.tobytes() == stiff.at(0.3).joints.tobytes()
    state, still = actor.at(1.0), stiff.at(1.0)
    turned = jaw_of(actor.human).turns(np.array([0.8]))[0]
    error = Rotation.from_matrix(turned).inv() * turn_of(state, still)
    assert error.magnitude() < 1e-6
    others = [n for n, name in enumerate(state.joint_names) if not name.startswith(BONE)]
    np.testing.assert_array_equal(state.joints[others], still.joints[others])
    number, chin = (state.joint_names.index(name) for name in (BONE, f"{BONE}_end"))
    np.testing.assert_array_equal(state.positions[number], still.positions[number])
    assert 0.02 < np.linalg.norm(state.positions[chin] - still.positions[chin]) < 0.05
    # the skin moves by its shape alone
    bones = still.joints[: len(actor.human.skeleton)]
    np.testing.assert_allclose(state.vertices, actor.human.pose(bones, {"jawOpen": 0.8}), atol=1e-6)
    np.testing.assert_allclose(still.vertices, actor.human.pose(bones, {"jawLeft": 0.8}), atol=1e-6)
    # and the joint of the chin with it: its nearest skin, which turns a little more
    near = np.linalg.norm(actor.human.pose(bones) - still.positions[chin], axis=1).argmin()
    skin, joint = (points[0] - points[1] for points in (
        (state.vertices[near], actor.human.pose(bones)[near]), (state.positions[chin], still.positions[chin])
    ))  # fmt: skip
    assert np.linalg.norm(skin - joint) < 0.4 * np.linalg.norm(skin)


@pytest.mark.parametrize("time", [0.6, 0.7])
def test_an_opening_jaw_has_its_velocity_and_moves_the_skin_around_the_stamp(time: float) -> None:
    actor, step = actor_of({"keys": KEYS}), 4e-3
    before, state, after = (actor.at(time + shift) for shift in (-step, 0.0, step))
    assert state.linear is not None and state.angular is not None and state.face is not None
    number = state.joint_names.index(BONE)
    first, last = (Rotation.from_matrix(each.joints[number, :3, :3]) for each in (before, after))
    rate = (last * first.inv()).as_rotvec() / (2 * step)
    assert np.linalg.norm(rate) > 0.3
    np.testing.assert_allclose(state.angular[number], rate, atol=0.02 * float(np.linalg.norm(rate)))
    jaw = actor.human.weights[:, [actor.human.skeleton.bone(BONE)]].toarray().ravel() > 0.1
    for sign, other in ((-1, before), (1, after)):
        got = actor.moved(state.joints, state.linear, state.angular, sign * step, state.face)
        assert np.abs(got - other.vertices)[jaw].max() < 5e-5
    still = actor.moved(state.joints, state.linear, state.angular, 0.0, state.face)
    np.testing.assert_allclose(still, state.vertices, atol=1e-5)


def test_a_live_jaw_is_the_jaw_of_the_simulation() -> None:
    actor = actor_of({"alive": True, "keys": [*KEYS, {"time": 1.2, "speak": 3}]})
    for time in (0.7, 1.7):
        own, live = actor.at(time), LiveRetargeter(actor).retarget(actor.joint_poses(time))
        assert own.joints.tobytes() == live.joints.tobytes()
        assert own.angular is not None and live.angular is not None
        assert own.angular.tobytes() == live.angular.tobytes()


def test_bodies_without_the_action_or_the_bone_have_no_jaw_that_opens() -> None:
    human = person("child")
    bare = human.without_details()
    for each in (replace(human, shapes=None), bare):
        assert Jaw.of(each.skeleton, each.mesh.vertices, each.weights, each.shapes) is None
