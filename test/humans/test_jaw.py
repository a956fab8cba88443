"""The bone of the jaw moves as the actions of the face move the lower teeth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from keyframe_text import keyframes
from scipy.spatial.transform import Rotation
from test_makehuman import PEOPLE, needs_makehuman, person

from humansim_ros import Scene
from humansim_ros.geometry import transform
from humansim_ros.motion.body.face import BONE, face_weights
from humansim_ros.people.loading.loading import ParametricHuman, read_description
from humansim_ros.people.makehuman.data import METRES, find_data, read_base
from humansim_ros.people.makehuman.face import jaw_of
from humansim_ros.people.makehuman.shape import target_strengths, with_stature
from humansim_ros.scene.core.actor import Actor
from humansim_ros.scene.core.live import LiveRetargeter
from humansim_ros.types import Array


@cache
def fitted(name: str) -> tuple[Array, Array, float]:
    """Lower teeth (K, 3) of a built-in human by MakeHuman's data, its hinge of the jaw (3,), and scale."""
    description = read_description(ROOT / "config" / "humans" / f"{name}.yaml")
    assert isinstance(description, ParametricHuman)
    source = find_data()
    config, scale = with_stature(source, description.makehuman)
    vertices = scale * read_base(source, target_strengths(source, config)).vertices
    groups = source.base.vertex_groups
    return vertices[groups["helper-lower-teeth"]], vertices[groups["joint-mouth"]].mean(0) * [0, 1, 1], scale


def teeth_offsets(weights: dict[str, float]) -> Array:
    """Offsets (K, 3) of the lower teeth, as MakeHuman's files have them."""
    source = find_data()
    out = np.zeros(source.base.vertices.shape)
    for name, weight in weights.items():
        moved, steps = source.face_action(name)
        out[moved] += weight * METRES * steps
    return out[source.base.vertex_groups["helper-lower-teeth"]]


@needs_makehuman
@pytest.mark.parametrize("name", PEOPLE)
@pytest.mark.parametrize(
    "weights",
    [{"jawOpen": 0.3}, {"jawOpen": 1.0}, {"jawForward": 1.0}, {"jawOpen": 0.6, "jawLeft": 0.7}],
    ids=lambda weights: "-".join(weights),
)
def test_the_jaw_moves_as_the_lower_teeth_do(name: str, weights: dict[str, float]) -> None:
    rest, hinge, scale = fitted(name)
    moved = rest + scale * teeth_offsets(weights)
    turn, _ = Rotation.align_vectors(moved - moved.mean(axis=0), rest - rest.mean(axis=0))
    place = moved.mean(axis=0) + turn.apply(hinge - rest.mean(axis=0))  # of the hinge
    jaw = jaw_of(person(name))
    assert jaw is not None
    (own,), (shift,) = jaw.motions(face_weights(weights)[None])
    axes = jaw.rest[:3, :3]
    assert np.degrees((Rotation.from_matrix(axes @ own @ axes.T) * turn.inv()).magnitude()) < 0.02
    np.testing.assert_allclose(axes @ shift, place - hinge, atol=2e-5)
    if "jawOpen" not in weights:
        assert turn.magnitude() < 1e-6 and 0.006 < np.linalg.norm(shift) < 0.01
    elif weights["jawOpen"] == 1:
        assert 20 < np.degrees(turn.magnitude()) < 30 and turn.as_rotvec()[0] > 0  # the chin goes down


def actor_of(face: object, **more: object) -> Actor:
    humans = {"anna": {"body": "adult_woman", "motion": "talk", "face": face, **more}}
    cameras = {"front": {"position": [3, 0, 1.6], "look_at": [0, 0, 1.5]}}
    return Scene.from_dict({"room": None, "humans": humans, "cameras": cameras}).actors["anna"]


FACE = {"jawOpen": 0.8, "jawLeft": 0.5}
KEYS = [{"time": 0.5, "actions": FACE, "blend": 0.4}]


def test_joints_have_the_motion_and_vertices_move_once() -> None:
    actor, stiff = actor_of({"keys": KEYS}), actor_of({"keys": [{"actions": {"mouthFunnel": 0.8}}]})
    assert actor.at(0.3).joints.tobytes() == stiff.at(0.3).joints.tobytes()
    state, still = actor.at(1.0), stiff.at(1.0)
    number, chin = (state.joint_names.index(name) for name in (BONE, f"{BONE}_end"))
    jaw = jaw_of(actor.human)
    assert jaw is not None and state.face is not None
    (turn,), (shift,) = jaw.motions(state.face.values[None])
    own = np.linalg.inv(still.joints[number]) @ state.joints[number]
    np.testing.assert_allclose(own, transform(turn, shift), atol=1e-9)
    others = [n for n, name in enumerate(state.joint_names) if not name.startswith(BONE)]
    np.testing.assert_array_equal(state.joints[others], still.joints[others])
    length = float(actor.human.skeleton.lengths[jaw.bone])
    expected = state.joints[number] @ [0, length, 0, 1]
    np.testing.assert_allclose(state.positions[chin], expected[:3], atol=1e-9)
    # the skin moves by its shape alone
    bones = still.joints[: len(actor.human.skeleton)]
    np.testing.assert_allclose(state.vertices, actor.human.pose(bones, FACE), atol=1e-6)
    np.testing.assert_allclose(still.vertices, actor.human.pose(bones, {"mouthFunnel": 0.8}), atol=1e-6)
    # and the joint at the chin with the skin there
    rest = actor.human.pose(bones)
    near = np.linalg.norm(rest - still.positions[chin], axis=1).argsort()[:20]
    skin = np.mean(state.vertices[near] - rest[near], axis=0)
    assert np.linalg.norm(skin - (state.positions[chin] - still.positions[chin])) < 0.2 * np.linalg.norm(skin)


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
        got = actor.moved(state, sign * step)
        assert np.abs(got - other.vertices)[jaw].max() < 5e-5
    still = actor.moved(state, 0.0)
    np.testing.assert_allclose(still, state.vertices, atol=1e-5)


def test_a_live_jaw_is_the_jaw_of_the_simulation() -> None:
    actor = actor_of({"alive": True, "keys": [*KEYS, {"time": 1.2, "speak": 3}]})
    for time in (0.7, 1.7):
        own, live = actor.at(time), LiveRetargeter(actor).retarget(actor.joint_poses(time))
        assert own.joints.tobytes() == live.joints.tobytes()
        assert own.angular is not None and live.angular is not None
        assert own.angular.tobytes() == live.angular.tobytes()


def test_bodies_without_teeth_have_no_jaw_that_moves() -> None:
    human = person("child")
    for each in (replace(human, shapes=None), replace(human, mouth=None), human.without_details()):
        assert jaw_of(each) is None


def test_a_scaled_body_has_the_motion_in_its_size(tmp_path: Path) -> None:
    key = {"position": (0, 0, 0), "rotation": (0, 0, 0), "size": (0.5, 0.5, 0.5)}
    (tmp_path / "half.xml").write_text(keyframes(30, 30, anna=(key, key)))
    actor = actor_of({"keys": KEYS})
    small = actor_of({"keys": KEYS}, keyframes=str(tmp_path / "half.xml"))
    state, half = actor.at(1.0), small.at(1.0)
    number, head = (state.joint_names.index(name) for name in (BONE, "vt3"))
    whole, shrunk = (each.positions[number] - each.positions[head] for each in (state, half))
    np.testing.assert_allclose(shrunk, 0.5 * whole, atol=1e-9)
    assert half.linear is not None and half.angular is not None
    still = small.moved(half, 0.0)
    np.testing.assert_allclose(still, half.vertices, atol=1e-5)
