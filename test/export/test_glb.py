"""GLB files: an evaluation after the specification of glTF 2.0 gives the vertices of the humans."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from keyframe_text import keyframes
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from humansim_ros import Scene, load_human, read_motion
from humansim_ros.data.formats.animation import AnimatedHuman, influences
from humansim_ros.data.formats.glb import glb_bytes
from humansim_ros.errors import HumansimWarning
from humansim_ros.files import Mesh
from humansim_ros.files.mesh.mesh import split_seams
from humansim_ros.geometry import WORLD_FROM_BODY
from humansim_ros.people import Human
from humansim_ros.scene.core.actor import HumanState

RATE, FRAMES = 30.0, 6
COMPONENTS = {5121: np.uint8, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    """Parts of a GLB file."""

    def __init__(self, data: bytes) -> None:
        magic, version, total = struct.unpack_from("<4sII", data)
        assert (magic, version, total) == (b"glTF", 2, len(data))
        length, kind = struct.unpack_from("<I4s", data, 12)
        assert kind == b"JSON" and length % 4 == 0
        self.json: dict[str, Any] = json.loads(data[20 : 20 + length])
        size, kind = struct.unpack_from("<I4s", data, 20 + length)
        assert kind == b"BIN\0" and size % 4 == 0
        self.binary = data[28 + length :]
        assert len(self.binary) == size == self.json["buffers"][0]["byteLength"]

    def view(self, number: int) -> bytes:
        view = self.json["bufferViews"][number]
        assert view["byteOffset"] % 4 == 0
        return self.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]

    def array(self, number: int) -> np.ndarray:
        accessor = self.json["accessors"][number]
        values = np.frombuffer(self.view(accessor["bufferView"]), COMPONENTS[accessor["componentType"]])
        values = values.reshape(accessor["count"], WIDTHS[accessor["type"]])
        if "min" in accessor:
            assert (values.min(0) == accessor["min"]).all() and (values.max(0) == accessor["max"]).all()
        return values

    def attributes(self, mesh: int) -> dict[str, np.ndarray]:
        primitive = self.json["meshes"][mesh]["primitives"][0]
        return {name: self.array(number) for name, number in primitive["attributes"].items()}

    def transforms(self, frame: int) -> dict[int, np.ndarray]:
        """Global transform of each node at a frame."""
        nodes = [dict(node) for node in self.json["nodes"]]
        (animation,) = self.json["animations"]
        for channel in animation["channels"]:
            sampler = animation["samplers"][channel["sampler"]]
            times = self.array(sampler["input"])[:, 0]
            np.testing.assert_allclose(times, np.arange(FRAMES) / RATE, atol=1e-6)
            nodes[channel["target"]["node"]][channel["target"]["path"]] = self.array(sampler["output"])[frame]
        out: dict[int, np.ndarray] = {}

        def visit(number: int, above: np.ndarray) -> None:
            node = nodes[number]
            local = np.eye(4)
            local[:3, :3] = Rotation.from_quat(node.get("rotation", [0, 0, 0, 1])).as_matrix()
            local[:3, :3] *= np.array(node.get("scale", [1, 1, 1]))
            local[:3, 3] = node.get("translation", [0, 0, 0])
            out[number] = above @ local
            for child in node.get("children", []):
                visit(child, out[number])

        for root in self.json["scenes"][0]["nodes"]:
            visit(root, np.eye(4))
        return out

    def vertices(self, person: str, frame: int) -> np.ndarray:
        """Skinned vertices (N, 3) of a person in ``map``."""
        node = next(node for node in self.json["nodes"] if node["name"] == f"{person}_mesh")
        skin, attributes = self.json["skins"][node["skin"]], self.attributes(node["mesh"])
        bind = self.array(skin["inverseBindMatrices"]).reshape(-1, 4, 4).swapaxes(1, 2).astype(float)
        joints = np.array([self.transforms(frame)[joint] for joint in skin["joints"]]) @ bind
        position = np.column_stack([attributes["POSITION"], np.ones(len(attributes["POSITION"]))])
        total = np.zeros((len(position), 3))
        for number in range(sum(name.startswith("JOINTS_") for name in attributes)):
            bones, weights = attributes[f"JOINTS_{number}"], attributes[f"WEIGHTS_{number}"].astype(float)
            for column in range(4):
                moved = np.einsum("nij,nj->ni", joints[bones[:, column], :3], position)
                total += weights[:, column, None] * moved
        return total @ WORLD_FROM_BODY.T


#: The second person shrinks while it turns and moves.
KEYFRAMES = keyframes(
    6,
    30,
    ben=(
        {"position": (0, 0, 0), "rotation": (0, 0, 0), "size": (1.2, 1.2, 1.2)},
        {"position": (1, 0, 0), "rotation": (0, 0, 90), "size": (0.9, 0.9, 0.9)},
    ),
)


@cache
def scene() -> Scene:
    with TemporaryDirectory() as folder:
        moves = Path(folder) / "moves.xml"
        moves.write_text(KEYFRAMES)
        wave = {"file": "wave", "position": [1, 2], "yaw_deg": 40}
        return Scene.from_dict(
            {
                "humans": {
                    "anna": {"body": "adult_woman", "motion": {"file": "walk"}},
                    "ben": {"body": "child", "motion": wave, "keyframes": str(moves)},
                },
                "cameras": {"front": {"position": [3, 0, 1.5], "look_at": [0, 0, 1]}},
            }
        )


@cache
def states() -> dict[str, list[HumanState]]:
    return {
        name: [actor.at(frame / RATE) for frame in range(FRAMES)] for name, actor in scene().actors.items()
    }


def animated(name: str) -> AnimatedHuman:
    human = scene().actors[name].human
    poses = states()[name]
    bones = np.array([state.joints[: len(human.skeleton)] for state in poses])
    return AnimatedHuman(human, bones, np.array([state.size for state in poses]))


@cache
def written() -> Glb:
    return Glb(glb_bytes({name: animated(name) for name in scene().actors}, RATE))


@pytest.mark.daily("ben")
@pytest.mark.parametrize("person", ["anna", "ben"])
def test_skinned_vertices_are_those_of_the_human_in_each_frame(person: str) -> None:
    human = scene().actors[person].human
    for frame in (0, 3, FRAMES - 1):
        found, expected = written().vertices(person, frame), states()[person][frame].vertices
        np.testing.assert_allclose(found[: len(expected)], expected, atol=5e-6)
        original = written().attributes(list(scene().actors).index(person))["_VERTEX"][:, 0].astype(int)
        np.testing.assert_array_equal(
            original[: len(human.mesh.vertices)], np.arange(len(human.mesh.vertices))
        )
        np.testing.assert_allclose(found, expected[original], atol=5e-6)


def test_the_second_person_changes_its_size() -> None:
    assert np.ptp(animated("ben").sizes) > 0.1


def test_bones_have_their_names_and_axes() -> None:
    glb = written()
    transforms = glb.transforms(3)
    for person, skin in zip(scene().actors, glb.json["skins"], strict=True):
        skeleton = scene().actors[person].human.skeleton
        assert tuple(glb.json["nodes"][joint]["name"] for joint in skin["joints"]) == skeleton.names
        frames = np.array([transforms[joint] for joint in skin["joints"]])
        expected = animated(person).bones[3]
        np.testing.assert_allclose(frames[:, :3, 3] @ WORLD_FROM_BODY.T, expected[:, :3, 3], atol=2e-6)
        axes = WORLD_FROM_BODY @ frames[:, :3, :3] / animated(person).sizes[3]
        np.testing.assert_allclose(axes, expected[:, :3, :3], atol=2e-6)


def test_triangles_texture_and_texture_coordinates_are_those_of_the_mesh() -> None:
    glb = written()
    human = scene().actors["anna"].human
    mesh = human.mesh
    attributes = glb.attributes(0)
    primitive = glb.json["meshes"][0]["primitives"][0]
    triangles = glb.array(primitive["indices"]).reshape(-1, 3)
    original = attributes["_VERTEX"][:, 0].astype(int)
    np.testing.assert_array_equal(original[triangles], mesh.triangles)
    assert mesh.uv is not None and mesh.uv_triangles is not None
    u_v = attributes["TEXCOORD_0"][triangles]
    np.testing.assert_allclose(u_v[..., 0], mesh.uv[mesh.uv_triangles][..., 0], atol=1e-6)
    np.testing.assert_allclose(1 - u_v[..., 1], mesh.uv[mesh.uv_triangles][..., 1], atol=1e-6)
    material = glb.json["materials"][primitive["material"]]
    image = glb.json["images"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]
    assert glb.view(image["bufferView"]) == human.looks[human.outfit].tobytes()
    assert image["mimeType"] in ("image/png", "image/jpeg")


def test_rotations_change_sign_nowhere() -> None:
    glb = written()
    (animation,) = glb.json["animations"]
    rotating = [channel for channel in animation["channels"] if channel["target"]["path"] == "rotation"]
    for channel in rotating:
        values = glb.array(animation["samplers"][channel["sampler"]]["output"])
        assert ((values[1:] * values[:-1]).sum(1) > 0.9).all()
    anna = animated("anna")
    turn = np.tile(np.eye(4), (9, 1, 1, 1))
    turn[:, 0, :3, :3] = Rotation.from_rotvec(np.linspace(0, 2 * np.pi, 9)[:, None] * [0, 0, 1]).as_matrix()
    whole = Glb(glb_bytes({"anna": replace(anna, bones=turn @ anna.bones[:1], sizes=np.ones(9))}, RATE))
    (animation,) = whole.json["animations"]
    root = next(c for c in animation["channels"] if c["target"]["path"] == "rotation")
    values = whole.array(animation["samplers"][root["sampler"]]["output"])
    assert ((values[1:] * values[:-1]).sum(1) > 0.5).all()


def test_people_with_one_body_share_its_mesh() -> None:
    anna = animated("anna")
    glb = Glb(glb_bytes({"anna": anna, "twin": anna}, RATE))
    assert len(glb.json["meshes"]) == len(glb.json["images"]) == 1 and len(glb.json["skins"]) == 2


@pytest.mark.nightly
def test_our_own_readers_take_the_file(tmp_path: Path) -> None:
    path = tmp_path / "people.glb"
    path.write_bytes(glb_bytes({"anna": animated("anna")}, RATE))
    human = load_human(path)
    assert len(human.mesh.vertices) == len(split_seams(scene().actors["anna"].human.mesh)[0])
    assert set(scene().actors["anna"].human.skeleton.names) <= set(human.skeleton.names)
    motion = read_motion(path)
    assert motion.duration == pytest.approx((FRAMES - 1) / RATE, abs=1e-5)


def tetrahedron(**options: Any) -> Human:
    child = load_human("child")
    mesh = Mesh(
        np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]]),
        np.array([[0, 2, 1, -1], [0, 1, 3, -1], [0, 3, 2, -1], [1, 2, 3, -1]], dtype=np.int32),
        **options,
    )
    weights = np.zeros((5, len(child.skeleton)))
    weights[:, 0] = 1.0
    weights[1, :6] = np.array([6, 5, 4, 3, 2, 1]) / 21
    return Human("tetrahedron", mesh, child.skeleton, csr_matrix(weights))


def still(human: Human) -> AnimatedHuman:
    return AnimatedHuman(human, human.skeleton.rest[None], np.ones(1))


def test_more_than_four_bones_of_a_vertex_are_in_a_second_set() -> None:
    bones, weights = influences(tetrahedron())
    np.testing.assert_array_equal(bones[1], [0, 1, 2, 3, 4, 5, 0, 0])
    np.testing.assert_allclose(weights[1], np.array([6, 5, 4, 3, 2, 1, 0, 0]) / 21, atol=1e-7)
    attributes = Glb(glb_bytes({"x": still(tetrahedron())}, RATE)).attributes(0)
    assert {"JOINTS_0", "JOINTS_1", "WEIGHTS_0", "WEIGHTS_1"} <= attributes.keys()


def test_vertex_colours_are_linear_and_normals_have_unit_length() -> None:
    colors = np.array([[0, 0, 0], [255, 255, 255], [188, 188, 188], [10, 10, 10], [5, 5, 5]], dtype=np.uint8)
    glb = Glb(glb_bytes({"x": still(tetrahedron(colors=colors))}, RATE))
    attributes = glb.attributes(0)
    np.testing.assert_allclose(attributes["COLOR_0"][:4, 0], [0, 1, 0.5029, 0.00304], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(attributes["NORMAL"], axis=1), 1, atol=1e-6)
    assert "images" not in glb.json and "animations" not in glb.json


def test_dual_quaternions_are_warned_of() -> None:
    human = replace(tetrahedron(), skinning="dual_quaternion")
    with pytest.warns(HumansimWarning, match="dual quaternion"):
        glb_bytes({"x": still(human)}, RATE)
