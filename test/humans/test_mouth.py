"""Teeth and tongue of people: where MakeHuman has them, moved by the actions, seen in an open mouth."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from assets.pack_mouth import mouth_arrays
from conftest import ROOT
from scipy.spatial.transform import Rotation
from test_makehuman import PEOPLE, needs_makehuman, person
from test_shapes import ANNY, resting

from humansim_ros import Scene, Simulation
from humansim_ros.errors import HumansimWarning, MeshError
from humansim_ros.files.mesh.mesh import MATERIAL_LABELS
from humansim_ros.files.reading.arrays import read_npz, write_npz
from humansim_ros.motion.body.face import ACTIONS, BONE
from humansim_ros.people.humans.human import Human, read_human, write_human
from humansim_ros.people.loading.loading import ParametricHuman, load_human, read_description
from humansim_ros.people.makehuman.data import find_data, people_data, read_base
from humansim_ros.people.makehuman.face import has_mouth, with_mouth
from humansim_ros.people.makehuman.shape import target_strengths, with_stature
from humansim_ros.scene.core.live import LiveRetargeter
from humansim_ros.types import Array

UPPER, LOWER, TONGUE = slice(0, 68), slice(68, 136), slice(136, 362)
GROUPS = {"helper-upper-teeth": UPPER, "helper-lower-teeth": LOWER, "helper-tongue": TONGUE}


def test_the_file_of_the_package_is_what_its_tool_makes() -> None:
    packed = read_npz(ROOT / "assets" / "makehuman" / "mouth.npz", MeshError, "MakeHuman")
    made = mouth_arrays()
    assert list(packed) == list(made)
    for name, array in made.items():
        np.testing.assert_array_equal(packed[name], array)


@needs_makehuman
@pytest.mark.parametrize("name", PEOPLE)
def test_teeth_and_tongue_have_the_shapes_of_makehuman_in_the_head(name: str) -> None:
    description = read_description(ROOT / "config" / "humans" / f"{name}.yaml")
    assert isinstance(description, ParametricHuman)
    source, human = find_data(), person(name)
    config, scale = with_stature(source, description.makehuman)
    base = read_base(source, target_strengths(source, config))
    assert human.mouth is not None
    jaw = base.vertices[base.vertex_groups["joint-mouth"]].mean(axis=0) * [0, 1, 1] * scale
    for group, some in GROUPS.items():
        theirs = scale * base.vertices[base.vertex_groups[group]] - jaw
        own = human.mouth[some] - human.skeleton.heads[human.skeleton.bone(BONE)]
        shift = own - theirs
        np.testing.assert_allclose(shift - shift.mean(axis=0), 0, atol=1e-6)
        assert np.abs(shift).max() < 0.005


def test_actions_move_them_as_annys_forward_pass_does() -> None:
    human = person("adult_man")
    mouth = with_mouth(human)
    count, source = len(human.mesh.vertices), people_data()
    assert mouth.shapes is not None and human.shapes is not None
    anny = np.load(ANNY)
    every = np.concatenate([np.sort(source.base.vertex_groups[group]) for group in GROUPS])
    places = {int(vertex): count + number for number, vertex in enumerate(every)}
    known = [(n, places[int(row)]) for n, row in enumerate(anny["rows"]) if int(row) in places]
    assert len(known) > 10
    rest = mouth.pose(resting())
    for number, name in enumerate(ACTIONS):
        moved = mouth.pose(resting(), {name: 1.0}) - rest
        np.testing.assert_array_equal(moved[:count], human.pose(resting(), {name: 1.0}) - rest[:count])
        got = moved[[vertex for _, vertex in known]]
        np.testing.assert_allclose(got, anny["single"][number, [n for n, _ in known]], atol=1e-5)
        assert not moved[count:][UPPER].any() or name == "mouthFunnel"
    assert np.abs(mouth.pose(resting(), {"tongueOut": 1.0}) - rest)[count:][TONGUE].max() > 0.02


@pytest.mark.parametrize("name", PEOPLE)
def test_colours_are_in_texels_that_no_body_uses(name: str) -> None:
    human = person(name)
    mesh, changed = human.mesh, with_mouth(human).mesh
    assert changed.closed  # renderers leave out the inside of closed meshes
    assert mesh.texture is not None and changed.texture is not None
    assert mesh.uv is not None and mesh.uv_faces is not None and changed.uv is not None
    height, width = mesh.texture.shape[:2]
    body = np.zeros((height, width), np.uint8)
    pixels = np.c_[mesh.uv[:, 0] * width, (1 - mesh.uv[:, 1]) * height]
    for face in mesh.uv_faces:
        corners = np.round(16 * pixels[face[face >= 0]]).astype(np.int32)
        cv2.fillPoly(body, [corners], (1,), shift=4)
    painted = (changed.texture != mesh.texture).any(axis=2)
    assert painted.sum() > 5000 and not painted[cv2.dilate(body, np.ones((5, 5))) > 0].any()
    own = changed.uv[len(mesh.uv) :]
    column, row = (own[:, 0] * width).astype(int), ((1 - own[:, 1]) * height).astype(int)
    assert painted[row, column].mean() > 0.95


CAMERAS = {"front": {"position": [3, 0, 1.6], "look_at": [0, 0, 1.5]}}
FACE = {"jawOpen": 0.8, "mouthUpperUpLeft": 0.6, "mouthUpperUpRight": 0.6}


def scene(mouth: bool, actions: dict[str, float], body: str = "adult_woman") -> Scene:
    head = 1.53
    camera = {"size": [200, 200], "fov_deg": 7, "position": [0.9, 0, head], "look_at": [0, 0, head]}
    face = {"mouth": mouth, "keys": [{"actions": actions}]}
    humans = {"anna": {"body": body, "motion": "t_to_a_pose", "face": face}}
    return Scene.from_dict({"room": None, "humans": humans, "cameras": {"front": camera}})


def seen(mouth: bool, actions: dict[str, float]) -> tuple[int, int, Any]:
    """Pixels of teeth and tongue, and the colours of the teeth."""
    with Simulation(scene(mouth, actions), channels=("rgb", "material")) as simulation:
        (frame,) = simulation.frames(1)
    view = frame.views["front"]
    assert view.material is not None
    teeth = view.material == MATERIAL_LABELS["teeth"]
    return int(teeth.sum()), int((view.material == MATERIAL_LABELS["tongue"]).sum()), view.rgb[teeth]


def test_an_open_mouth_shows_teeth_and_tongue_and_a_closed_one_hides_them() -> None:
    teeth, tongue, colours = seen(True, FACE)
    assert teeth > 100 and tongue > 100
    red, green, blue = np.median(colours, axis=0)
    assert red > 90 and blue > 0.65 * red and green > 0.8 * red  # not red, as gums
    closed = seen(True, {})
    assert closed[0] < 0.05 * teeth and closed[1] < 0.1 * tongue
    assert seen(False, FACE)[:2] == (0, 0)


def test_the_jaw_takes_the_lower_teeth_along_and_live_agrees() -> None:
    still, plain = (scene(mouth, {}).actors["anna"].at(0.0) for mouth in (True, False))
    actor, without = (scene(mouth, FACE).actors["anna"] for mouth in (True, False))
    state, other = actor.at(0.0), without.at(0.0)
    assert state.joints.tobytes() == other.joints.tobytes()
    count = len(plain.vertices)
    np.testing.assert_array_equal(state.vertices[:count], other.vertices)
    assert len(state.vertices) == count + 362
    before, after = (each.vertices[count:][LOWER].astype(float) for each in (still, state))
    turn, _ = Rotation.align_vectors(after - after.mean(axis=0), before - before.mean(axis=0))
    number = state.joint_names.index(BONE)
    joint = Rotation.from_matrix(state.joints[number, :3, :3] @ still.joints[number, :3, :3].T)
    assert np.degrees((turn.inv() * joint).magnitude()) < 1.0 < np.degrees(turn.magnitude())
    upper = state.vertices[count:][UPPER] - still.vertices[count:][UPPER]
    assert np.abs(upper).max() < 1e-6
    live = LiveRetargeter(actor).retarget(actor.joint_poses(0.0))
    assert live.vertices.tobytes() == state.vertices.tobytes()


def test_a_body_without_teeth_is_said(tmp_path: Path) -> None:
    bare = replace(person("child"), mouth=None)
    assert not has_mouth(bare) and with_mouth(bare) is bare
    write_human(tmp_path / "bare.npz", bare)
    with pytest.warns(HumansimWarning, match=r"humans\.anna\.face\.mouth: the body has no teeth"):
        actor = scene(True, FACE, str(tmp_path / "bare.npz")).actors["anna"]
    assert len(actor.at(0.0).vertices) == len(bare.mesh.vertices)


def test_a_live_human_may_have_a_mouth() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", HumansimWarning)
        live = Scene.from_dict(
            {"cameras": CAMERAS, "humans": {"anna": {"motion": "live", "face": {"mouth": True}}}}
        )
    actor = live.actors["anna"]
    assert any(getattr(layer, "jaw", None) is not None for layer in actor.layers)
    assert MATERIAL_LABELS["tongue"] in actor.human.mesh.materials  # type: ignore[operator]


@pytest.mark.slow
def test_drawn_people_have_teeth_behind_their_lips() -> None:
    human = load_human("person#7-5")
    assert has_mouth(human) and human.mouth is not None and with_mouth(human).mesh.closed
    lips = human.mesh.vertices[human.shapes.rows[_of(human, "mouthPucker")]]  # type: ignore[union-attr]
    teeth = human.mouth[UPPER]
    assert lips[:, 1].min() < teeth[:, 1].min() and teeth[:, 1].max() < lips[:, 1].max()
    front = lips[np.abs(lips[:, 1] - teeth[:, 1].min()) < 0.01, 2].max()
    assert 0 < front - teeth[:, 2].max() < 0.03


def _of(human: Human, action: str) -> slice:
    """Entries of an action in the shapes of a human."""
    assert human.shapes is not None
    number = human.shapes.names.index(action)
    return slice(human.shapes.starts[number], human.shapes.starts[number + 1])


def test_places_survive_a_file_and_wrong_ones_are_told(tmp_path: Path) -> None:
    path, human = tmp_path / "child.npz", person("child")
    write_human(path, human)
    assert human.mouth is not None
    np.testing.assert_array_equal(read_human(path).mouth, human.mouth)
    arrays = read_npz(path, MeshError, "human")
    wrongs: list[Array] = [human.mouth[:, :2], human.mouth * np.nan, np.array(["a"])]  # type: ignore[list-item]
    for wrong in wrongs:
        write_npz(path, {**arrays, "mouth": wrong}, level=1)
        with pytest.raises(MeshError) as error:
            read_human(path)
        assert error.value.key == "mouth"
    write_npz(path, {**arrays, "mouth": human.mouth[:9]}, level=1)
    short: Human = read_human(path)
    assert not has_mouth(short)
    # a file whose actions move nothing
    nothing = {"shape_starts": 0 * arrays["shape_starts"], "shape_rows": arrays["shape_rows"][:0]}
    still = {**arrays, **nothing, "shape_offsets": arrays["shape_offsets"][:0], "mouth": human.mouth}
    write_npz(path, still, level=1)
    stiff, weights = with_mouth(read_human(path)), {"jawOpen": 1.0}
    np.testing.assert_array_equal(stiff.pose(resting("child"), weights), stiff.pose(resting("child")))
