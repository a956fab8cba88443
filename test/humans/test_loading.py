"""Load humans: SMPL models, descriptions, materials and malicious archives."""

from __future__ import annotations

import io
import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import cv2
import figures
import numpy as np
import pytest
from conftest import ROOT

from humansim_ros.errors import HumansimWarning, MeshError
from humansim_ros.files.mesh.load import read_mesh
from humansim_ros.files.reading.arrays import read_npz
from humansim_ros.people.humans.human import read_human, write_human
from humansim_ros.people.loading.figure import read_smpl
from humansim_ros.people.loading.loading import load_human

pytestmark = pytest.mark.usefixtures("cache")


@pytest.fixture
def model() -> dict[str, Any]:
    return figures.smpl(figures.SMPL_NAMES, figures.SMPL_PARENTS)


def saved(folder: Path, arrays: dict[str, Any], **changes: Any) -> Path:
    path = folder / "model.npz"
    np.savez(path, **{key: value for key, value in (arrays | changes).items() if value is not None})
    return path


# SMPL


def test_a_model_in_the_layout_of_smpl_is_a_human(tmp_path: Path, model: dict[str, Any]) -> None:
    human = load_human(saved(tmp_path, model))
    skeleton = human.skeleton
    shift = human.mesh.vertices[0] - model["v_template"][0]
    for ours, theirs in (("l_knee", "LeftLeg"), ("r_shoulder", "RightArm"), ("vl5", "Spine2")):
        place = figures.PLACES[figures.NAMES.index(theirs)] + shift
        np.testing.assert_allclose(skeleton.heads[skeleton.bone(ours)], place, atol=1e-4)
    np.testing.assert_allclose(human.pose(skeleton.rest), human.mesh.vertices, atol=1e-6)
    assert len(human.outfits) >= 3


def test_betas_shape_the_body_and_its_joints(tmp_path: Path, model: dict[str, Any]) -> None:
    path = saved(tmp_path, model)
    plain, tall = read_smpl(path), read_smpl(path, [2.0])  # the first direction makes all 10 % larger
    np.testing.assert_allclose(tall.mesh.vertices, 1.2 * plain.mesh.vertices, atol=1e-9)
    np.testing.assert_allclose(tall.joints, 1.2 * plain.joints, atol=1e-3)
    with pytest.raises(MeshError, match="3 betas, the model has 2"):
        read_smpl(path, [1.0, 2.0, 3.0])


def test_other_objects_of_a_model_are_never_unpickled(tmp_path: Path, model: dict[str, Any]) -> None:
    """SMPL-X files contain pickled dictionaries; unpickling can run any code."""
    trap = np.array([Trap(tmp_path / "run")], dtype=object)
    assert load_human(saved(tmp_path, model, part2num=trap)).name == "model"
    with pytest.raises(MeshError, match="pickled objects are not read") as caught:
        load_human(saved(tmp_path, model, weights=trap))
    assert caught.value.key == "weights"
    assert not (tmp_path / "run").exists()


class Trap:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.path),)


def test_unpickling_the_test_file_would_run_code(tmp_path: Path) -> None:
    pickle.loads(pickle.dumps(Trap(tmp_path / "run")))
    assert (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("f", None, "an array is missing"),
        ("f", np.array([[0, 1, 99999]]), "outside"),
        ("v_template", np.full((184, 3), np.nan), "not finite"),
        ("v_template", np.zeros((5, 2)), "must be numbers"),
        ("weights", np.zeros((184, 24)), "sum to zero"),
        ("weights", np.ones((184, 23)), "must be numbers"),
        ("kintree_table", np.array([[1] * 24, range(24)]), "come before"),
    ],
)
def test_a_broken_model_is_refused(
    tmp_path: Path, model: dict[str, Any], key: str, value: Any, message: str
) -> None:
    with pytest.raises(MeshError, match=message) as caught:
        load_human(saved(tmp_path, model, **{key: value}))
    assert caught.value.path is not None


# archives


def test_an_archive_with_too_large_content_is_refused_before_unpacking(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("humansim_ros.files.reading.arrays.MAX_BYTES", 10 << 20)
    path = tmp_path / "bomb.npz"
    np.savez_compressed(path, a=np.zeros(9 << 20, np.uint8), b=np.zeros(2 << 20, np.uint8))
    assert path.stat().st_size < 1 << 20
    assert len(read_npz(path, MeshError, "human", ["b"])) == 1
    with pytest.raises(MeshError, match="unpacks to more than 10 MB"):
        read_npz(path, MeshError, "human")


def test_an_array_larger_than_its_data_is_an_error(tmp_path: Path) -> None:
    data = io.BytesIO()
    np.lib.format.write_array_header_1_0(data, {"shape": (10**12,), "fortran_order": False, "descr": "<f8"})
    path = tmp_path / "promise.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("vertices.npy", data.getvalue() + bytes(64))
    with pytest.raises(MeshError, match="does not have the"):
        read_npz(path, MeshError, "human")


# human files


def test_a_human_is_written_and_read_without_change(tmp_path: Path, figure: Path) -> None:
    human = load_human(figure)
    write_human(tmp_path / "a.npz", human)
    write_human(tmp_path / "b.npz", human)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    copy = read_human(tmp_path / "a.npz")
    np.testing.assert_allclose(copy.mesh.vertices, human.mesh.vertices, atol=1e-7)
    np.testing.assert_array_equal(copy.mesh.faces, human.mesh.faces)
    assert abs(copy.weights - human.weights).max() < 1e-6
    assert copy.skeleton.names == human.skeleton.names
    assert copy.outfits == human.outfits


def test_a_human_changes_its_outfit(tmp_path: Path) -> None:
    man = load_human(ROOT / "assets" / "humans" / "adult_man.npz")
    assert len(man.outfits) >= 3
    other = man.wearing(man.outfits[1])
    assert other.mesh.texture is not None
    assert man.mesh.texture is not None
    assert (other.mesh.texture != man.mesh.texture).mean() > 0.3
    assert other.mesh.vertices is man.mesh.vertices
    with pytest.raises(MeshError, match="no outfit 'armour'; there are red"):
        man.wearing("armour")


# descriptions


def described(folder: Path, text: str) -> Path:
    path = folder / "someone.yaml"
    path.write_text(text)
    return path


def test_a_description_sets_size_and_outfits_of_a_mesh(tmp_path: Path, figure: Path) -> None:
    path = described(
        tmp_path,
        f"mesh: {figure.name}\nstature: 1.2\nskinning: dual_quaternion\n"
        "outfits:\n  plain: {shirt: [1, 2, 3]}\n  other: {}\n",
    )
    human = load_human(path)
    assert human.name == "someone"
    assert np.ptp(human.mesh.vertices[:, 1]) == pytest.approx(1.2, abs=1e-6)
    assert human.outfits == ("plain", "other")
    assert human.skinning == "dual_quaternion"
    assert human.mesh.colors is not None
    assert (human.mesh.colors == (1, 2, 3)).all(1).any()


@pytest.mark.parametrize(
    ("text", "key", "message"),
    [
        ("mesh: nobody.obj", "mesh", "no such file"),
        ("mesh: figure.max", "mesh", ".obj, .gltf, .glb"),
        ("rigging: heat", None, "exactly one of the keys 'mesh' and 'makehuman'"),
        ("mesh: figure.glb\nstature: -1", "stature", "from 0.2 to 5"),
        ("mesh: figure.glb\nstature: 1\nunit: 1", None, "not both"),
        ("mesh: figure.glb\ncolour: red", "colour", "unknown key; known here: mesh"),
        ("mesh: figure.glb\nmesh: figure.glb", "mesh", "repeated key"),
        ("mesh: figure.glb\nup: w", "up", "give an axis"),
        ("mesh: figure.glb\noutfits: {a: {texture: none.png}}", None, "no such texture file"),
        ("mesh: figure.glb\noutfits: {a: {shirt: [300, 0, 0]}}", "outfits.a.shirt.0", "255"),
        ("makehuman: {gender: 2}\noutfits: {a: {}}", "makehuman.gender", "from 0 to 1"),
        ("makehuman: {age: 200}\noutfits: {a: {}}", "makehuman.age", "from 1 to 90"),
        ("makehuman: {}\noutfits: {}", "outfits", "at least one"),
        ("makehuman: {}\noutfits: {a: {shirt_fabric: silk}}", "outfits.a.shirt_fabric", "plain, knit, twill"),
        ("mesh: [", None, "not valid YAML"),
        ("mesh: !!python/object/apply:os.mkdir [run]", None, "not valid YAML"),
    ],
)
def test_a_wrong_description_is_refused_with_its_key(
    tmp_path: Path, figure: Path, text: str, key: str | None, message: str
) -> None:
    with pytest.raises(MeshError, match=message) as caught:
        load_human(described(tmp_path, text))
    assert caught.value.key == key
    assert not (tmp_path / "run").exists()


# materials of OBJ files

OBJ = """mtllib colours.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl photo
f 1/1 2/2 3/3
usemtl red
f 1 3 4
"""


def test_materials_become_one_texture(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(OBJ)
    (tmp_path / "colours.mtl").write_text("newmtl photo\nmap_Kd photo.png\nnewmtl red\nKd 1 0 0\n")
    photo = np.zeros((32, 32, 3), np.uint8)
    photo[:16, 16:] = (0, 200, 0)  # at the top right
    cv2.imwrite(str(tmp_path / "photo.png"), photo)
    mesh = read_mesh(tmp_path / "m.obj")
    assert mesh.texture is not None
    assert mesh.uv is not None
    assert mesh.uv_triangles is not None
    size = np.array(mesh.texture.shape[1::-1])

    def color(triangle: int, *shares: float) -> list[int]:
        assert mesh.uv is not None
        assert mesh.uv_triangles is not None
        assert mesh.texture is not None
        u, v = np.array(shares) @ mesh.uv[mesh.uv_triangles[triangle]]
        return [int(c) for c in mesh.texture[int((1 - v) * size[1]), int(u * size[0])]]

    assert color(0, 0.1, 0.1, 0.8) == [0, 200, 0]
    assert color(0, 0.8, 0.1, 0.1) == [0, 0, 0]
    assert color(1, 0.3, 0.3, 0.4) == [255, 0, 0]


@pytest.mark.parametrize("name", ["../colours.mtl", "/etc/passwd", "none.mtl"])
def test_materials_outside_the_folder_are_ignored_with_a_warning(tmp_path: Path, name: str) -> None:
    (tmp_path / "colours.mtl").write_text("newmtl red\nKd 1 0 0\n")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "m.obj").write_text(OBJ.replace("colours.mtl", name))
    with pytest.warns(HumansimWarning, match="not found beside the file"):
        assert read_mesh(folder / "m.obj").texture is None
