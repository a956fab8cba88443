"""Humans from meshes of other programs: PLY and STL files, VRM avatars, and their heights."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import figures
import numpy as np
import pytest
import trimesh
from conftest import ROOT

from humansim_ros.errors import HumansimWarning, MeshError
from humansim_ros.motion import read_motion
from humansim_ros.people.humans.human import Human
from humansim_ros.people.loading.loading import load_human, make_human

pytestmark = pytest.mark.usefixtures("no_cache")


@pytest.fixture(scope="module")
def man() -> Human:
    return load_human(ROOT / "assets" / "humans" / "adult_man.npz")


@pytest.mark.daily("stl")
@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["ply", "stl", "off"])
def test_a_body_of_another_format_is_rigged_like_an_obj(tmp_path: Path, man: Human, suffix: str) -> None:
    """In centimetres, with z up."""
    points = 100 * man.mesh.vertices[:, [2, 0, 1]]
    model = trimesh.Trimesh(points, man.mesh.triangles, process=False)
    if suffix == "ply":
        model.visual.vertex_colors = np.tile([90, 20, 30, 255], (len(points), 1)).astype(np.uint8)
    paths = [tmp_path / f"person.{kind}" for kind in (suffix, "obj")]
    for path in paths:
        content = model.export(file_type=path.suffix[1:])
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    ours, like = (load_human(path) for path in paths)
    np.testing.assert_allclose(ours.skeleton.heads, like.skeleton.heads, atol=2e-3)
    for bone in ("l_shoulder", "r_hip", "l_wrist", "vt3"):
        number = man.skeleton.bone(bone)
        scale = np.ptp(man.mesh.vertices[:, 1]) / np.ptp(ours.mesh.vertices[:, 1])
        root = man.skeleton.bone("sacroiliac")
        here, there = ours.skeleton.heads, man.skeleton.heads
        off = scale * (here[number] - here[root]) - (there[number] - there[root])
        assert np.linalg.norm(off) < 0.07
    if suffix == "stl":  # its triangles share no vertices, a body needs shared ones
        assert len(ours.mesh.vertices) <= len(man.mesh.vertices)
    if suffix == "ply":
        assert ours.mesh.colors is not None
        assert (ours.mesh.colors == (90, 20, 30)).all()
    else:
        assert set(ours.outfits) == {"blue", "red", "green"}


def vrm(version: int, **changes: Any) -> tuple[dict[str, Any], bytes]:
    """The figure as a VRM avatar whose nodes have names without meaning, in an order without meaning."""
    document, binary = figures.gltf(**changes)
    bones = {
        "Hips": "hips",
        "Spine": "spine",
        "Spine2": "chest",
        "Neck": "neck",
        "Head": "head",
        **{
            side + ours: side.lower() + theirs
            for side in ("Left", "Right")
            for ours, theirs in (
                *(("Shoulder", "Shoulder"), ("Arm", "UpperArm"), ("ForeArm", "LowerArm"), ("Hand", "Hand")),
                *(("UpLeg", "UpperLeg"), ("Leg", "LowerLeg"), ("Foot", "Foot"), ("ToeBase", "Toes")),
            )
        },
    }
    places = {bones[name]: number for number, name in enumerate(figures.NAMES) if name in bones}
    for number, node in enumerate(document["nodes"][:-1]):
        # names of other joints, which a match by name would follow
        node["name"] = figures.NAMES[-1 - number]
    if version == 0:
        human = {"humanBones": [{"bone": bone, "node": node} for bone, node in places.items()]}
        document["extensions"] = {"VRM": {"humanoid": human}}
    else:
        human = {"humanBones": {bone: {"node": node} for bone, node in places.items()}}
        document["extensions"] = {"VRMC_vrm": {"specVersion": "1.0", "humanoid": human}}
    return document, binary


@pytest.mark.parametrize("version", [0, 1])
def test_the_bone_map_of_a_vrm_avatar_names_its_joints(tmp_path: Path, version: int) -> None:
    path = tmp_path / "avatar.vrm"
    path.write_bytes(figures.glb(*vrm(version)))
    human = load_human(path)
    plain = tmp_path / "figure.glb"
    plain.write_bytes(figures.glb(*figures.gltf()))
    expected = load_human(plain)
    for bone in ("l_hip", "r_knee", "l_ankle", "l_shoulder", "r_elbow", "r_wrist", "vt3", "sacroiliac"):
        np.testing.assert_allclose(
            human.skeleton.heads[human.skeleton.bone(bone)],
            expected.skeleton.heads[expected.skeleton.bone(bone)],
            atol=1e-6,
        )
    motion = read_motion(path)
    assert {"hips", "leftUpperArm", "rightFoot"} <= set(motion.joint_names)
    assert motion.n_frames == 61


@pytest.mark.parametrize(
    "extension",
    [
        {"VRM": 7},
        {"VRM": {"humanoid": {"humanBones": [{"bone": 3, "node": "x"}, 5]}}},
        {"VRMC_vrm": {"humanoid": {"humanBones": {"hips": {"node": 10**9}, "spine": []}}}},
    ],
)
def test_a_wrong_bone_map_is_ignored(tmp_path: Path, extension: dict[str, Any]) -> None:
    path = tmp_path / "avatar.vrm"
    path.write_bytes(figures.glb(*figures.gltf(extensions=extension)))
    assert "l_hip" in load_human(path).skeleton.names


def test_a_figure_of_impossible_height_is_scaled_with_a_word(tmp_path: Path) -> None:
    document, binary = figures.gltf()
    document["nodes"].append({"name": "armature", "scale": [1.9] * 3, "children": [0]})
    path = tmp_path / "figure.glb"
    path.write_bytes(figures.glb(document, binary))
    with pytest.warns(HumansimWarning, match=r"3.41 units tall: no unit gives .* 'stature' or 'unit'"):
        assert 1.5 < np.ptp(load_human(path).mesh.vertices[:, 1]) < 1.9


def test_a_figure_whose_joints_are_hardly_known_is_told(tmp_path: Path) -> None:
    document, binary = figures.gltf()
    for number, node in enumerate(document["nodes"]):
        node["name"] = f"node {number}"
    path = tmp_path / "nameless.glb"
    path.write_bytes(figures.glb(document, binary))
    with pytest.warns(HumansimWarning, match=r"nameless.*matched by shape with a confidence of \d\d%"):
        assert "l_hip" in load_human(path).skeleton.names


def test_a_mesh_that_cannot_be_rigged_is_named(tmp_path: Path) -> None:
    path = tmp_path / "leaf.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with pytest.raises(MeshError, match="flat, not a person") as caught:
        make_human(path)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize("size", [0.3, 1.35])
def test_a_figure_far_from_human_height_is_reported_with_the_key(tmp_path: Path, size: float) -> None:
    document, binary = figures.gltf()
    document["nodes"].append({"name": "armature", "scale": [size] * 3, "children": [0]})
    path = tmp_path / "figure.glb"
    path.write_bytes(figures.glb(document, binary))
    stature = size * float(np.ptp(figures.boxes()[0][:, 1]))
    with pytest.warns(HumansimWarning, match=rf"{stature:.3g} m tall.*'stature'"):
        human = load_human(path)
    assert np.ptp(human.mesh.vertices[:, 1]) == pytest.approx(stature, rel=1e-5)
    with pytest.warns(HumansimWarning, match="--stature"):
        make_human(path)
    described = tmp_path / "figure.yaml"
    described.write_text("mesh: figure.glb\nstature: 3.1\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.ptp(load_human(described).mesh.vertices[:, 1]) == pytest.approx(3.1)


def test_the_height_is_reported_again_when_the_human_comes_from_the_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HUMANSIM_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "figure.glb"
    document, binary = figures.gltf()
    document["nodes"].append({"name": "armature", "scale": [0.3] * 3, "children": [0]})
    path.write_bytes(figures.glb(document, binary))
    for _ in range(2):
        with pytest.warns(HumansimWarning, match="m tall"):
            load_human(path)


def test_the_built_in_humans_are_of_usual_height() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for path in sorted((ROOT / "assets" / "humans").glob("*.npz")):
            load_human(path)


def test_a_file_of_another_kind_is_no_human(tmp_path: Path) -> None:
    path = tmp_path / "notes.txt"
    path.write_text("hello\n")
    with pytest.raises(MeshError, match=r"a human is one of \.npz, .*\.stl.*not \.txt"):
        load_human(path)
