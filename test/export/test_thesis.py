"""Files of the thesis, read back: vertices, bones, cameras, images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from export_support import exported, small_scene

from humansim_ros import Camera, Frame, Scene, Simulation, idealize, read_calibration
from humansim_ros.data.formats.thesis import read_bones, read_verts
from humansim_ros.errors import ExportError


@pytest.fixture(scope="module")
def scene() -> Scene:
    return small_scene()


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory, scene: Scene) -> Path:
    return exported(tmp_path_factory.mktemp("thesis") / "out", "thesis", scene)


@pytest.fixture(scope="module")
def frame(scene: Scene) -> Frame:
    with Simulation(scene, ("rgb",)) as simulation:
        return simulation.frame(4)


@pytest.mark.daily("bert")
@pytest.mark.parametrize("human", ["anna", "bert"])
def test_vertices_are_read_back(root: Path, frame: Frame, human: str) -> None:
    path = root / f"thesis/{human}/000004.verts"
    assert path.read_text().splitlines()[0].endswith(";")
    np.testing.assert_allclose(read_verts(path), frame.humans[human].vertices, atol=1e-12)


@pytest.mark.parametrize("human", ["anna", "bert"])
def test_bones_are_read_back(root: Path, frame: Frame, scene: Scene, human: str) -> None:
    bones = read_bones(root / f"thesis/{human}/000004.bones")
    skeleton, state = scene.actors[human].human.skeleton, frame.humans[human]
    joints = dict(zip(state.joint_names, state.positions, strict=True))
    assert list(bones) == list(skeleton.names[:22])
    for name, (head, tail) in bones.items():
        np.testing.assert_allclose(head, joints[name], atol=1e-12)
        if f"{name}_end" in joints:
            np.testing.assert_allclose(tail, joints[f"{name}_end"], atol=1e-12)
    # where a bone begins at the end of another one, it does so in every pose
    np.testing.assert_allclose(bones["l_hip"][1], bones["l_knee"][0], atol=1e-9)


def test_bones_grow_with_their_person(tmp_path: Path) -> None:
    def bones(size: float) -> dict[str, np.ndarray]:
        (tmp_path / "size.xml").write_text(
            '<animation startframe="0" endframe="1"><object name="anna"><frame number="0">'
            f'<size x="{size}" y="{size}" z="{size}"/></frame></object></animation>'
        )
        anna = {"keyframes": "size.xml", "body": "child", "motion": "walk"}
        camera = {"size": [32, 24], "position": [3, 0, 1], "look_at": [0, 0, 1]}
        scene = Scene.build(humans={"anna": anna}, cameras={"c": camera}, room=None, folder=tmp_path)
        folder = exported(tmp_path / f"{size}", "thesis", scene, frames="0:1")
        return read_bones(folder / "thesis/anna/000000.bones")

    small, large = bones(1.0), bones(1.5)
    for name, (head, tail) in small.items():
        grown = np.linalg.norm(large[name][1] - large[name][0])
        assert grown == pytest.approx(1.5 * np.linalg.norm(tail - head), abs=1e-9)


@pytest.mark.parametrize("name", ["noisy", "bent"])
def test_cameras_are_read_back(root: Path, frame: Frame, name: str) -> None:
    """Both files give the pixels of the camera without its lens distortion."""
    real = frame.cameras[name]
    ideal = real if name == "noisy" else idealize(real).camera
    points = frame.humans["anna"].positions
    expected = ideal.project(points)[0]
    for suffix in (".cam", ".txt"):
        (camera,) = read_calibration(root / f"thesis/cameras/{name}{suffix}").values()
        np.testing.assert_allclose(camera.project(points)[0], expected, atol=1e-6)
        assert camera.size == real.size


def test_the_projection_matrix_is_k_r_t(root: Path, frame: Frame) -> None:
    """As in section 9.3, with x before y; up to the scale of the file."""
    matrix = np.loadtxt(root / "thesis/cameras/noisy.txt")
    np.testing.assert_allclose(matrix, frame.cameras["noisy"].P, atol=1e-9)


def test_images_are_links_where_the_camera_is_ideal(root: Path) -> None:
    link = root / "thesis/images/noisy"
    assert link.is_symlink() and link.resolve() == root / "images/noisy"
    assert sorted(path.name for path in link.iterdir()) == ["000003.png", "000004.png"]


def test_other_images_are_those_of_the_ideal_camera(root: Path, frame: Frame) -> None:
    image = cv2.imread(str(root / "thesis/images/bent/000004.png"))[..., ::-1]
    expected = idealize(frame.cameras["bent"]).to_ideal(frame.views["bent"].rgb)
    np.testing.assert_array_equal(image, expected)


def test_moving_cameras_have_files_for_each_frame(tmp_path: Path) -> None:
    (tmp_path / "way.txt").write_text("0 3 0 1 0.5 0.5 -0.5 -0.5\n5 3 2 1 0.5 0.5 -0.5 -0.5\n")
    camera = {"size": [32, 24], "trajectory": "way.txt"}
    scene = Scene.build(cameras={"c": camera}, room=None, folder=tmp_path, rate=1)
    root = exported(tmp_path / "out", "thesis", scene, frames="1:3")
    cameras: list[Camera] = []
    for name in ("000001", "000002"):
        cameras += read_calibration(root / f"thesis/cameras/c/{name}.cam").values()
    assert cameras[0].center == pytest.approx([3, 0.4, 1]) and cameras[1].center == pytest.approx([3, 0.8, 1])
    assert not (root / "thesis/cameras/c.cam").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("l_knee.head=[1, 2]", "1: needs three numbers with commas"),
        ("\nl_knee.head=[1, 2, nan]", "2: needs three numbers"),
        ("l_knee.top=[1, 2, 3]", "1: a line of a bone file is"),
        ("l_knee.head=[1, 2, 3]", "bone l_knee lacks its tail"),
    ],
)
def test_wrong_bone_files_name_the_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "wrong.bones"
    path.write_text(text)
    with pytest.raises(ExportError, match=f"wrong.bones:? ?{said}"):
        read_bones(path)


def test_wrong_vertex_files_name_the_line(tmp_path: Path) -> None:
    path = tmp_path / "wrong.verts"
    path.write_text("1, 2, 3;\n4, 5;\n")
    with pytest.raises(ExportError, match=r"wrong.verts:2: needs three numbers"):
        read_verts(path)
