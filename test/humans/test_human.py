"""Humans: a built-in human, humans made from meshes, and wrong files."""

from __future__ import annotations

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT, if_shared
from mesh_files import MESHES, mesh_path
from scipy.spatial.transform import Rotation

from humansim_ros.errors import MeshError
from humansim_ros.motion import hanim_skeleton
from humansim_ros.motion.body.skeleton import DETAIL_BONES, FINGERS, finger_bones
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human

MAN = ROOT / "assets" / "humans" / "adult_man.npz"
#: Some vertices of the humans that had 22 bones, posed at random; metres.
VERTICES: dict[str, list[tuple[float, float, float]]] = {
    "adult_man": [
        (-0.21085, 1.60050, -0.24561),
        (-0.20350, 1.60300, -0.25057),
        (-0.97929, 1.13117, -0.36790),
        (-0.55418, 1.27448, -0.33649),
        (-0.16846, 0.91650, -0.12599),
        (-0.25728, 1.57898, -0.30498),
        (-0.82400, 0.64816, 0.20905),
        (-0.15572, 1.60495, -0.25772),
        (0.51955, 1.58533, 0.18068),
        (0.18239, 1.45063, -0.05441),
        (0.19169, 0.98334, 0.19530),
        (-0.11143, 1.53430, -0.32645),
        (0.15614, 0.84017, 0.11417),
        (-0.18507, 1.49827, -0.41462),
    ],
    "child": [
        (-0.15923, 1.15442, -0.16638),
        (-0.15178, 1.15667, -0.17189),
        (-0.67107, 0.79925, -0.28147),
        (-0.38557, 0.90460, -0.24639),
        (-0.14405, 0.65919, -0.06441),
        (-0.20599, 1.13307, -0.21482),
        (-0.63405, 0.46115, 0.06508),
        (-0.10937, 1.15932, -0.17737),
        (0.35680, 1.11371, 0.13255),
        (0.12884, 1.02431, -0.03135),
        (0.12822, 0.70963, 0.18595),
        (-0.06663, 1.09734, -0.23455),
        (0.11172, 0.59888, 0.13829),
        (-0.13290, 1.06469, -0.30748),
    ],
}


@pytest.fixture(scope="module")
def man() -> Human:
    return load_human(MAN)


@pytest.fixture(scope="module")
def arrays() -> dict[str, Any]:
    with np.load(MAN) as file:
        return {key: file[key] for key in file.files}


def test_the_man_has_the_bones_of_the_general_skeleton(man: Human) -> None:
    general = hanim_skeleton()
    assert man.skeleton.names[:22] == general.names
    np.testing.assert_array_equal(man.skeleton.parents[:22], general.parents)


def test_the_bones_of_fingers_toes_jaw_and_eyes_follow_those_of_the_general_skeleton(man: Human) -> None:
    skeleton = man.skeleton
    assert skeleton.names[22:] == tuple(DETAIL_BONES)
    parents = [skeleton.names[parent] for parent in skeleton.parents[22:]]
    assert parents == list(DETAIL_BONES.values())


def test_the_ends_of_the_general_skeleton_stay_joints_although_these_bones_have_children(man: Human) -> None:
    skeleton, general = man.skeleton, hanim_skeleton()
    assert skeleton.joint_names[57:62] == general.joint_names[22:]
    assert set(skeleton.joint_names[62:]) == {
        *(f"{side}_{finger}3_end" for side in "lr" for finger in FINGERS),
        *(f"{bone}_end" for bone in tuple(DETAIL_BONES)[-5:]),
    }
    joints = skeleton.joint_transforms(skeleton.rest)[:, :3, 3]
    for name, bone, place in zip(skeleton.joint_names, skeleton.joint_bones, joints, strict=True):
        end = skeleton.tails[bone] if name.endswith("_end") else skeleton.heads[bone]
        np.testing.assert_allclose(place, end, atol=1e-12)
    at = dict(zip(skeleton.joint_names, joints, strict=True))
    np.testing.assert_allclose(at["l_metatarsal_end"], at["l_ankle_end"], atol=1e-9)


def test_parts_of_a_hand_foot_and_head_are_told_from_it(man: Human) -> None:
    names = man.skeleton.names
    whole = {name: names[bone] for name, bone in zip(names, man.skeleton.wholes, strict=True)}
    assert all(whole[name] == name for name in hanim_skeleton().names)
    assert {whole[bone] for bone in finger_bones("r")} == {"r_wrist"}
    assert whole["l_metatarsal"] == "l_ankle" and whole["temporomandibular"] == "vt3"
    seen = {names[part - 1] for part in np.unique(man.triangle_parts)}
    assert set(DETAIL_BONES) < seen


def test_bones_of_the_general_skeleton_move_the_skin_as_when_they_were_the_only_ones() -> None:
    """Vertices of the files that had 22 bones, in a pose by chance."""
    for name, expected in VERTICES.items():
        human = load_human(ROOT / "assets" / "humans" / f"{name}.npz")
        rotations = np.tile([0.0, 0, 0, 1], (len(human.skeleton), 1))
        turns = np.random.default_rng(28).normal(0, 0.3, (22, 3))
        rotations[:22] = Rotation.from_rotvec(turns).as_quat()
        vertices = human.pose(human.skeleton.pose(rotations))
        rows = np.linspace(0, len(vertices) - 1, 14).astype(int)
        np.testing.assert_allclose(vertices[rows], expected, atol=2e-5)


def test_a_human_without_details_has_the_general_skeleton_and_the_same_skin(man: Human) -> None:
    plain = man.without_details()
    assert plain.skeleton.names == hanim_skeleton().names and plain.weights.shape[1] == 22
    assert plain.without_details() is plain
    turns = Rotation.from_rotvec(np.random.default_rng(3).normal(0, 0.3, (22, 3))).as_quat()
    rotations = np.tile([0.0, 0, 0, 1], (len(man.skeleton), 1))
    rotations[:22] = turns
    posed, general = man.skeleton.pose(rotations), plain.skeleton.pose(turns)
    np.testing.assert_allclose(posed[:22], general, atol=1e-12)
    np.testing.assert_allclose(man.pose(posed), plain.pose(general), atol=2e-6)


def test_an_eye_turns_about_its_centre_and_looks_down_with_a_positive_angle(man: Human) -> None:
    skeleton = man.skeleton
    for eye in ("l_eyeball_joint", "r_eyeball_joint"):
        bone = skeleton.bone(eye)
        skin = np.flatnonzero(man.weights[:, bone].toarray().ravel() > 0.99)
        rotations = np.tile([0.0, 0, 0, 1], (len(skeleton), 1))
        rotations[bone] = Rotation.from_euler("x", 30, degrees=True).as_quat()
        posed = skeleton.pose(rotations)
        moved = man.pose(posed)
        before = np.linalg.norm(man.mesh.vertices[skin] - skeleton.heads[bone], axis=1)
        assert len(skin) > 60 and np.ptp(before) < 0.002  # a ball
        np.testing.assert_allclose(
            np.linalg.norm(moved[skin] - skeleton.heads[bone], axis=1), before, atol=1e-6
        )
        np.testing.assert_allclose(posed[bone, :3, 1] @ skeleton.rest[bone, :3, 1], np.cos(np.radians(30)))
        assert posed[bone, 1, 1] < skeleton.rest[bone, 1, 1] - 0.4
        still = man.weights[:, bone].toarray().ravel() == 0
        assert np.abs(moved - man.mesh.vertices)[still].max() < 1e-6


def test_the_jaw_opens_with_a_positive_angle_and_moves_chin_and_lower_lip(man: Human) -> None:
    skeleton, rest = man.skeleton, man.mesh.vertices
    bone = skeleton.bone("temporomandibular")
    rotations = np.tile([0.0, 0, 0, 1], (len(skeleton), 1))
    rotations[bone] = Rotation.from_euler("x", 20, degrees=True).as_quat()
    moved = man.pose(skeleton.pose(rotations)) - rest
    lowered = rest[np.argmin(moved[:, 1])]
    assert moved[:, 1].min() < -0.02 and np.linalg.norm(lowered - skeleton.tails[bone]) < 0.05  # the chin
    assert np.abs(moved[rest[:, 1] > skeleton.heads[bone][1] + 0.03]).max() < 1e-6  # eyes and brow
    assert np.abs(moved[rest[:, 1] < skeleton.heads[bone][1] - 0.2]).max() < 1e-6


def test_toes_bend_at_the_ball_of_the_foot_without_tearing_the_shoe(man: Human) -> None:
    skeleton, rest = man.skeleton, man.mesh.vertices
    edges = np.concatenate([man.mesh.triangles[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])
    length = np.linalg.norm(rest[edges[:, 0]] - rest[edges[:, 1]], axis=1)
    for degrees in (-45, 30):  # up, as on tiptoe, and down
        rotations = np.tile([0.0, 0, 0, 1], (len(skeleton), 1))
        for side in "lr":
            turn = Rotation.from_euler("x", degrees, degrees=True).as_quat()
            rotations[skeleton.bone(f"{side}_metatarsal")] = turn
        moved = man.pose(skeleton.pose(rotations))
        longer = np.linalg.norm(moved[edges[:, 0]] - moved[edges[:, 1]], axis=1) - length
        assert (longer - length).max() < 0.003
        for side in "lr":
            ball = skeleton.heads[skeleton.bone(f"{side}_metatarsal")]
            own = (rest[:, 0] * ball[0] > 0) & (rest[:, 1] < 0.12)
            heel, tip = own & (rest[:, 2] < ball[2] - 0.05), own & (rest[:, 2] > ball[2] + 0.05)
            assert np.abs(moved - rest)[heel].max() < 1e-6
            rise = (moved - rest)[tip, 1].mean() * np.sign(-degrees)
            assert rise > 0.02


def test_the_man_is_as_tall_as_a_man_and_stands_on_the_floor(man: Human) -> None:
    low, high = man.mesh.vertices.min(0), man.mesh.vertices.max(0)
    assert 1.7 < high[1] - low[1] < 1.8
    assert low[1] == pytest.approx(0, abs=1e-3)


def test_the_man_faces_forward_with_his_left_hand_to_the_left(man: Human) -> None:
    skeleton = man.skeleton
    assert skeleton.tails[skeleton.bone("l_ankle")][2] > skeleton.heads[skeleton.bone("l_ankle")][2] + 0.1
    assert skeleton.heads[skeleton.bone("l_wrist")][0] > 0.4
    assert skeleton.heads[skeleton.bone("r_wrist")][0] < -0.4


def test_the_mans_joints_lie_inside_him(man: Human) -> None:
    import trimesh

    body = trimesh.Trimesh(man.mesh.vertices, man.mesh.triangles, process=False)
    limbs = [
        man.skeleton.bone(f"{side}_{part}")
        for side in "lr"
        for part in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
    ]
    # counted along a ray, so that an odd count is inside
    origins = man.skeleton.heads[limbs]
    assert body.ray.contains_points(origins).all()


def test_the_mans_weights_sum_to_one_and_every_limb_has_skin(man: Human) -> None:
    sums = np.asarray(man.weights.sum(1)).ravel()
    np.testing.assert_allclose(sums, 1, atol=1e-12)
    assert man.weights.min() >= 0
    skinned = {man.skeleton.names[part - 1] for part in np.unique(man.triangle_parts)}
    assert {
        f"{s}_{p}" for s in "lr" for p in ("hip", "knee", "ankle", "shoulder", "elbow", "wrist")
    } <= skinned


def test_the_mans_texture_is_used_by_every_face(man: Human) -> None:
    assert man.mesh.texture is not None
    assert man.mesh.texture.dtype == np.uint8
    assert man.mesh.texture.std() > 10
    assert man.mesh.uv_triangles is not None
    assert man.mesh.uv is not None
    assert man.mesh.uv.min() >= 0
    assert man.mesh.uv.max() <= 1
    assert len(man.mesh.uv_triangles) == len(man.mesh.triangles) == len(man.triangle_parts)


def test_the_rest_pose_gives_the_stored_vertices(man: Human) -> None:
    posed = man.pose(man.skeleton.rest)
    assert posed.dtype == np.float32
    np.testing.assert_allclose(posed, man.mesh.vertices, atol=1e-6)


@pytest.mark.daily("own_female_A_dm.obj-14855")
@pytest.mark.slow
@pytest.mark.parametrize(
    ("figure", "vertices"),
    [
        *((name, len(MESHES[name].vertices)) for name in ("own_male_T_dm.obj", "own_female_A_dm.obj")),
        *if_shared(("mh2007_male_T_dm.obj", 13380), ("mh2007_female_A_dm.obj", 13380)),
    ],
)
def test_a_plain_mesh_becomes_a_dressed_human(figure: str, vertices: int) -> None:
    human = load_human(mesh_path(figure))
    assert human.name == figure.removesuffix(".obj")
    assert np.ptp(human.mesh.vertices[:, 1]) == pytest.approx(1.7504, abs=1e-6)
    assert human.mesh.colors is not None
    assert human.mesh.colors.shape == (vertices, 3)
    assert len(np.unique(human.mesh.colors, axis=0)) >= 5  # skin, hair, shirt, trousers, shoes
    np.testing.assert_allclose(human.pose(human.skeleton.rest), human.mesh.vertices, atol=1e-6)


# Bad input


def saved(tmp_path: Path, arrays: dict[str, Any], **changes: Any) -> Path:
    path = tmp_path / "someone.npz"
    np.savez(path, **{key: value for key, value in (arrays | changes).items() if value is not None})
    return path


def test_a_copy_equals_the_original(tmp_path: Path, arrays: dict[str, Any], man: Human) -> None:
    copy = load_human(saved(tmp_path, arrays))
    np.testing.assert_array_equal(copy.mesh.vertices, man.mesh.vertices)
    assert (copy.weights != man.weights).nnz == 0


@pytest.mark.parametrize(
    "key",
    [
        "vertices",
        "faces",
        "bone_names",
        "bone_parents",
        "bone_heads",
        "bone_tails",
        "bone_rolls",
        "weight_bones",
        "weight_values",
        "uv_faces",
    ],
)
def test_a_missing_array_is_named(tmp_path: Path, arrays: dict[str, Any], key: str) -> None:
    path = saved(tmp_path, arrays, **{key: None})
    with pytest.raises(MeshError, match="an array is missing") as caught:
        load_human(path)
    assert (caught.value.path, caught.value.key) == (str(path), key)


def shading(count: int, triangle: int = 0, value: float = 1.0) -> dict[str, Any]:
    """Weights of one triangle in the normals of some vertices."""
    return {
        "shading_values": np.full(count, value, np.float32),
        "shading_triangles": np.full(count, triangle, np.int32),
        "shading_starts": np.arange(count + 1, dtype=np.int32),
    }


def broken_arrays(arrays: dict[str, Any]) -> dict[str, dict[str, Any]]:
    nan = arrays["vertices"].copy()
    nan[7] = np.nan
    far = arrays["faces"].copy()
    far[0, 0] = 1_000_000
    return {
        "vertices with NaN": {"vertices": nan},
        "vertices of the wrong shape": {"vertices": arrays["vertices"][:, :2]},
        "vertices of words": {"vertices": np.array(["a", "b", "c"])},
        "vertices of numbers as words": {"vertices": arrays["vertices"].astype("U30")},
        "complex vertices": {"vertices": arrays["vertices"].astype(complex)},
        "vertices that are very far away": {"vertices": 1e300 * arrays["vertices"].astype(float)},
        "faces of fractions": {"faces": arrays["faces"] + 0.5},
        "faces beyond 32 bits": {"faces": arrays["faces"].astype(np.int64) + 2**32},
        "heads that are very far away": {"bone_heads": np.full(arrays["bone_heads"].shape, 1e300)},
        "texture coordinates with NaN": {"uv": np.full(arrays["uv"].shape, np.nan)},
        "fewer vertices than weights": {"vertices": np.vstack([arrays["vertices"], [[0, 0, 0]]])},
        "a face out of range": {"faces": far},
        "faces of the wrong shape": {"faces": arrays["faces"].ravel()},
        "a parent after its child": {"bone_parents": arrays["bone_parents"][::-1]},
        "weights of a bone that is not there": {"weight_bones": arrays["weight_bones"] + 57},
        "weights below zero": {"weight_values": -arrays["weight_values"]},
        "weights of zero": {"weight_values": 0 * arrays["weight_values"]},
        "weights of one axis": {
            "weight_bones": arrays["weight_bones"][:, 0],
            "weight_values": arrays["weight_values"][:, 0],
        },
        "no weights": {
            "weight_bones": arrays["weight_bones"][:, :0],
            "weight_values": arrays["weight_values"][:, :0],
        },
        "a texture that is none": {"texture_red": np.arange(100, dtype=np.uint8)},
        "an empty texture": {"texture_red": np.zeros(0, np.uint8)},
        "an outfit without a look": {"outfits": np.array(["red", "none"])},
        "an outfit of floats": {"texture_red": np.zeros((len(nan), 3))},
        "normals of triangles that are not there": shading(len(nan), triangle=10**6),
        "normals of other vertices": shading(len(nan) + 1),
        "normals of weights below zero": shading(len(nan), value=-1.0),
        "normals of weights that are not finite": shading(len(nan), value=np.nan),
        "skinning of no known way": {"skinning": np.array("magic")},
        "names of no axis": {"bone_names": np.array(5)},
    }


@pytest.mark.daily("heads that are very far away", "faces of the wrong shape")
@pytest.mark.filterwarnings("error::RuntimeWarning")
@pytest.mark.parametrize(
    "what",
    [
        "vertices with NaN",
        "vertices of numbers as words",
        "complex vertices",
        "vertices that are very far away",
        "faces of fractions",
        "faces beyond 32 bits",
        "heads that are very far away",
        "texture coordinates with NaN",
        "vertices of the wrong shape",
        "vertices of words",
        "fewer vertices than weights",
        "a face out of range",
        "faces of the wrong shape",
        "a parent after its child",
        "weights of a bone that is not there",
        "weights below zero",
        "weights of zero",
        "weights of one axis",
        "no weights",
        "a texture that is none",
        "an empty texture",
        "an outfit without a look",
        "an outfit of floats",
        "skinning of no known way",
        "names of no axis",
    ],
)
def test_broken_arrays_are_errors_with_the_file(tmp_path: Path, arrays: dict[str, Any], what: str) -> None:
    path = saved(tmp_path, arrays, **broken_arrays(arrays)[what])
    with pytest.raises(MeshError) as caught:
        load_human(path)
    assert caught.value.path == str(path)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.9999])
def test_a_truncated_file_is_refused(tmp_path: Path, share: float) -> None:
    path = tmp_path / "cut.npz"
    content = MAN.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(MeshError, match=r"cut\.npz"):
        load_human(path)


def test_a_file_damaged_inside_is_refused(tmp_path: Path) -> None:
    """The archive directory is valid; the compressed data of the first array is damaged."""
    content = bytearray(MAN.read_bytes())
    with zipfile.ZipFile(MAN) as archive:
        first = archive.infolist()[0]
    start = first.header_offset + 30 + len(first.filename) + 20
    content[start : start + 400] = b"\xff" * 400
    path = tmp_path / "damaged.npz"
    path.write_bytes(content)
    with pytest.raises(MeshError, match=r"damaged\.npz"):
        load_human(path)


def test_a_single_array_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "plain.npz"
    with path.open("wb") as file:
        np.save(file, np.zeros(3))
    with pytest.raises(MeshError, match=r"not an \.npz archive"):
        load_human(path)


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)

    def __reduce__(self) -> tuple[Any, ...]:
        return (os.mkdir, (self.path,))


def test_a_pickled_object_is_never_loaded(tmp_path: Path, arrays: dict[str, Any]) -> None:
    sprung = tmp_path / "sprung"
    boxed = np.empty(1, dtype=object)
    boxed[0] = Trap(sprung)
    path = tmp_path / "trap.npz"
    np.savez(path, **(arrays | {"name": boxed}))
    with pytest.raises(MeshError, match=r"trap\.npz"):
        load_human(path)
    path.write_bytes(pickle.dumps(Trap(sprung)))
    with pytest.raises(MeshError, match=r"trap\.npz"):
        load_human(path)
    assert not sprung.exists()


def test_missing_and_empty_files_are_refused(tmp_path: Path) -> None:
    for suffix in ("npz", "obj"):
        with pytest.raises(MeshError, match="no such"):
            load_human(tmp_path / f"nobody.{suffix}")
        (tmp_path / f"empty.{suffix}").touch()
        with pytest.raises(MeshError, match="is empty"):
            load_human(tmp_path / f"empty.{suffix}")


def test_a_mesh_that_is_not_a_person_is_an_error_with_the_file(tmp_path: Path) -> None:
    (tmp_path / "tri.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0.5\nf 1 2 3\n")
    with pytest.raises(MeshError, match=r"tri\.obj"):
        load_human(tmp_path / "tri.obj")
