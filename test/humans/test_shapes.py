"""Shapes of the face in human files, and faces that they pose."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from test_makehuman import PEOPLE, needs_makehuman, person

from humansim_ros.errors import MeshError, MotionError
from humansim_ros.files.reading.arrays import read_npz, write_npz
from humansim_ros.geometry import rotation_vector_to_quaternion
from humansim_ros.motion.body.face import ACTIONS, EXPRESSIONS, expression, face_weights
from humansim_ros.motion.body.offsets import Shapes, read_shapes, shape_arrays
from humansim_ros.people.humans.human import read_human, write_human
from humansim_ros.people.makehuman.data import find_data
from humansim_ros.people.makehuman.face import face_offsets
from humansim_ros.types import Array

#: Vertices of the forward pass of anny 0.6.2 (test/data/README.md).
ANNY = ROOT / "test" / "data" / "anny_faces.npz"


def resting(name: str = "adult_man") -> Array:
    skeleton = person(name).skeleton
    return skeleton.pose(np.tile([0.0, 0.0, 0.0, 1.0], (len(skeleton), 1)))


@needs_makehuman
def test_actions_move_vertices_as_annys_forward_pass_does() -> None:
    anny, source = np.load(ANNY), find_data()
    assert tuple(anny["names"]) == ACTIONS
    every = np.arange(len(source.base.vertices))
    offsets = face_offsets(source, every).reshape(len(every), len(ACTIONS), 3)
    groups = source.base.vertex_groups
    eyes = np.concatenate([groups["helper-l-eye"], groups["helper-r-eye"]])
    rows = anny["rows"]
    skin = ~np.isin(rows, eyes)  # bones turn the eyeballs
    assert skin.sum() > 450
    own = np.swapaxes(offsets[rows[skin]], 0, 1)
    np.testing.assert_allclose(own, anny["single"][:, skin], atol=1e-8)
    mixed = np.einsum("ns,svi->nvi", anny["weights"], own)
    np.testing.assert_allclose(mixed, anny["mixed"][:, skin], atol=1e-12)
    assert np.abs(anny["mixed"]).max() > 0.02

    # and through the rounding of files
    every = np.concatenate([groups["body"], *(groups[f"helper-{side}-eye"] for side in "lr")])
    made = Shapes.of_offsets(ACTIONS, face_offsets(source, every).reshape(len(every), -1, 3))
    read = read_shapes(shape_arrays(made), len(every))
    assert read is not None
    np.testing.assert_allclose(read.offsets, made.offsets, atol=1e-6)


@pytest.mark.parametrize("name", PEOPLE)
def test_each_human_has_the_actions_of_arkit_in_less_than_3_mb(name: str) -> None:
    human = person(name)
    assert human.shapes is not None and human.shapes.names == ACTIONS
    assert (ROOT / "assets" / "humans" / f"{name}.npz").stat().st_size < 3_000_000
    # the head only, by a few centimetres
    head = human.skeleton.heads[human.skeleton.bone("vt3")]
    assert human.mesh.vertices[human.shapes.moved, 1].min() > head[1] - 0.15
    assert 0.02 < np.abs(human.shapes.offsets).max() < 0.05
    lids = np.linalg.norm(
        human.pose(resting(name), {"eyeBlinkLeft": 1.0}) - human.pose(resting(name)), axis=1
    )
    assert lids.max() > 0.008
    # of the person's left; the target of the artists lifts the nostril, too
    assert np.median(human.mesh.vertices[lids > 0.6 * lids.max(), 0]) > 0.02


@pytest.mark.parametrize("skinning", ["linear", "dual_quaternion"])
def test_offsets_are_added_before_bones_move_the_skin(skinning: Any) -> None:
    human = replace(person("adult_man"), skinning=skinning)
    assert human.shapes is not None
    turns = np.random.default_rng(3).normal(size=(len(human.skeleton), 3)) * 0.3
    posed = human.skeleton.pose(rotation_vector_to_quaternion(turns))
    posed = posed @ np.diag([1.3, 1.3, 1.3, 1.0])
    weights = np.random.default_rng(4).uniform(0, 1, len(ACTIONS))
    rest = human.mesh.vertices.copy()
    for number, weight in enumerate(weights):
        some = slice(human.shapes.starts[number], human.shapes.starts[number + 1])
        rest[human.shapes.rows[some]] += weight * human.shapes.offsets[some]
    moved = replace(human, mesh=replace(human.mesh, vertices=rest))
    expected = moved.pose(posed)
    assert np.abs(expected - human.pose(posed)).max() > 0.02
    np.testing.assert_allclose(human.pose(posed, weights), expected, atol=2e-6)
    np.testing.assert_allclose(human.pose(posed[None], weights)[0], expected, atol=2e-6)
    by_name = human.pose(posed, dict(zip(ACTIONS, weights.tolist(), strict=True)))
    np.testing.assert_array_equal(by_name, human.pose(posed, weights))


def test_a_face_at_rest_changes_nothing() -> None:
    human = person("adult_man")
    np.testing.assert_array_equal(human.pose(resting(), np.zeros(52)), human.pose(resting()))
    np.testing.assert_array_equal(human.pose(resting(), {"jawOpen": 0.0}), human.pose(resting()))
    stiff = replace(human, shapes=None)
    np.testing.assert_array_equal(stiff.pose(resting(), {"jawOpen": 1.0}), stiff.pose(resting()))


@pytest.mark.parametrize(
    ("face", "reason"),
    [
        ({"jawopen": 0.5}, "no action of the face 'jawopen'; did you mean 'jawOpen'"),
        ({"smile": 0.5}, "no action of the face 'smile'"),
        ({"jawOpen": 1.2}, "the weight of jawOpen must be from 0 to 1, not 1.2"),
        ({"jawOpen": -0.1}, "from 0 to 1"),
        ({"jawOpen": float("nan")}, "from 0 to 1, not nan"),
    ],
)
def test_wrong_weights_are_told(face: dict[str, float], reason: str) -> None:
    with pytest.raises(MotionError, match=reason.replace("(", r"\(")):
        face_weights(face)
    with pytest.raises(MotionError):
        person("adult_man").pose(resting(), face)


def test_expressions_are_valid_faces_that_differ() -> None:
    human = person("adult_woman")
    neutral = human.pose(resting("adult_woman"))
    assert not expression("neutral")
    faces = [
        human.pose(resting("adult_woman"), expression(name)) for name in EXPRESSIONS if name != "neutral"
    ]
    assert len(faces) == 6
    for number, face in enumerate(faces):
        others = [neutral, *faces[:number]]
        assert min(np.abs(face - other).max() for other in others) > 0.002
    smile = face_weights(expression("happiness"))
    assert smile[ACTIONS.index("mouthSmileLeft")] == smile[ACTIONS.index("mouthSmileRight")] == 0.8
    assert expression("sadness")["browInnerUp"] == 0.9
    with pytest.raises(MotionError, match=r"no expression 'happy'.*happiness"):
        expression("happy")


def test_shapes_survive_a_file(tmp_path: Path) -> None:
    human = person("child")
    assert human.shapes is not None
    write_human(tmp_path / "child.npz", human)
    read = read_human(tmp_path / "child.npz").shapes
    assert read is not None and read.names == human.shapes.names
    np.testing.assert_array_equal(read.rows, human.shapes.rows)
    np.testing.assert_allclose(read.offsets, human.shapes.offsets, atol=1e-6)


@pytest.mark.parametrize(
    ("key", "change", "reason"),
    [
        ("shape_rows", lambda a: a + 10**6, "vertices below"),
        ("shape_rows", lambda a: -a - 1, "vertices below"),
        ("shape_rows", lambda a: a.astype(float), "numbers"),
        ("shape_rows", lambda a: np.full_like(a, 5), "twice"),
        ("shape_starts", lambda a: a[:-1], "53 numbers"),
        ("shape_starts", lambda a: a[[0, 2, 1, *range(3, len(a))]], "must rise"),
        ("shape_offsets", lambda a: a[:-1], "must be"),
        ("shape_offsets", lambda a: a.astype(float) * np.nan, "finite"),
        ("shape_unit", lambda _: np.array(1e30), "finite and at most 10 m"),
        ("shape_names", lambda a: np.repeat(a[:1], len(a)), "each once"),
    ],
)
def test_wrong_arrays_of_shapes_are_told(tmp_path: Path, key: str, change: Any, reason: str) -> None:
    arrays = read_npz(ROOT / "assets" / "humans" / "child.npz", MeshError, "human")
    arrays[key] = change(arrays[key])
    write_npz(tmp_path / "wrong.npz", arrays, level=1)
    with pytest.raises(MeshError, match=reason) as error:
        read_human(tmp_path / "wrong.npz")
    assert error.value.key == ("shape_offsets" if key == "shape_unit" else key)
