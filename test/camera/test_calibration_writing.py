"""Cameras written in all formats and read again; values that a format does not store."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from humansim_ros.cameras import Camera, read_calibration, write_calibration
from humansim_ros.cameras.formats.table import CalibrationFormat
from humansim_ros.cameras.formats.writing import FORMATS
from humansim_ros.errors import CameraError, HumansimWarning

LENSES = {
    "plumb_bob": (-0.31, 0.12, 1.5e-3, -2.25e-5, 0.07),
    "rational_polynomial": (0.41, -0.22, 1e-3, -2e-4, 0.03, 0.71, -0.01, 0.02),
    "equidistant": (-0.02, 0.01, 3e-3, -1e-5),
}
BY_NAME = {form.name: form for form in FORMATS}
K = np.array([[711.25, 0, 1 / 3 + 310], [0, 690.1, 245.7], [0, 0, 1]])
#: Formats with computed numbers, which may change in the last digit.
COMPUTED = ("p", "colmap", "cam", "kalibr", "anipose", "transforms", "dlt", "vicon", "metashape", "openmvg")
COMPUTED += ("blender", "meshroom", "bundler", "motive", "egoexo4d")
#: Formats without an image size need it for reading.
SIZE = (640, 480)


def a_camera(seed: int, form: CalibrationFormat, model: str | None) -> Camera:
    """A camera with all values that a format stores."""
    rng = np.random.default_rng(seed)
    k = K + np.diag([seed, seed, 0])
    k[0, 1] = 0.7 if form.holds_skew else 0
    if form.name == "cam":
        k = np.array([[600.0 + seed, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
    if form.name in ("bundler", "openmvg"):  # square pixels; Bundler has no principal point
        k = np.array([[600.0 + seed, 0, 319.5], [0, 600.0 + seed, 239.5], [0, 0, 1]])
    r, t = Rotation.random(None, rng).as_matrix(), rng.uniform(-5, 5, 3)
    t[2] = abs(t[2]) if form.name == "dlt" else t[2]
    count = form.lenses.get(model, 0) if model else 0
    camera = Camera(SIZE, k, r if form.holds_pose else np.eye(3), t if form.holds_pose else np.zeros(3))
    if model:
        camera = replace(camera, model=model, distortion=LENSES[model][:count])
    if form.holds_rectified:
        p = np.array([[650.0, 0, 320.2, -65.3], [0, 650, 240, 0], [0, 0, 1, 0]])
        camera = replace(camera, rectification=Rotation.random(None, rng).as_matrix(), rectified=p)
    return camera


def all_lenses() -> list[tuple[str, str | None]]:
    # cameras of devices have fixed names and sizes: test_calibration_devices.py
    general = [form for form in FORMATS if form.name not in ("zed", "k4a")]
    pairs = [(form.name, model) for form in general for model in (None, *form.lenses)]
    return [pair for pair in pairs if pair != ("egoexo4d", None)]  # only fisheyes


def test_all_lenses_of_all_formats_are_tested() -> None:
    assert len(all_lenses()) > 35


@pytest.mark.daily("transforms-plumb_bob", "mvsnet-None")
@pytest.mark.filterwarnings("ignore:.*does not hold the image size")
@pytest.mark.parametrize(("name", "model"), all_lenses())
def test_written_files_read_back_the_same_cameras(tmp_path: Path, name: str, model: str | None) -> None:
    form = BY_NAME[name]
    names = [f"camera_{i}" for i in (1, 2, 3)] if name == "dlt" else ["cam0", "cam1", "cam2"]
    cameras = {n: a_camera(i, form, model) for i, n in enumerate(names)}
    target = tmp_path / (f"rig{form.suffix}" if form.multiple else "rig")
    files = write_calibration(target, cameras, name)
    again = read_calibration(target, size=None if form.holds_size else SIZE)
    assert list(again) == names
    for camera, other in zip(cameras.values(), again.values(), strict=True):
        assert other.size == camera.size
        assert (other.model if other.distorted else None) == model
        assert_allclose(other.distortion, camera.distortion, rtol=1e-15)
        assert_allclose(other.K, camera.K, rtol=1e-12, atol=1e-12)
        assert_allclose(other.R, camera.R, atol=1e-14 if name not in ("cam", "dlt") else 1e-12)
        assert_allclose(other.t, camera.t, rtol=1e-14, atol=1e-12)
        if form.holds_rectified:
            assert_allclose(other.rectified_projection, camera.rectified_projection, rtol=1e-15)
            assert_allclose(other.rectification_matrix, camera.rectification_matrix, rtol=1e-15)
    # writing the cameras that were read gives the same file
    contents = [file.read_bytes() for file in files]
    write_calibration(target, again, name)
    if form.unit == 1 and name not in COMPUTED:
        assert [file.read_bytes() for file in files] == contents


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_opencv_reads_its_written_files(tmp_path: Path, suffix: str) -> None:
    form = next(form for form in FORMATS if form.name.startswith("opencv") and form.suffix == suffix)
    cameras = {name: a_camera(i, form, "plumb_bob") for i, name in enumerate(("left", "right"))}
    for path, keys in (
        (tmp_path / f"one{suffix}", ("camera_matrix", "distortion_coefficients", "T")),
        (tmp_path / f"two{suffix}", ("K_left", "dist_left", "T_left")),
    ):
        one = "one" in path.name
        write_calibration(path, {"left": cameras["left"]} if one else cameras, form.name)
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        for key, value in zip(
            keys, (cameras["left"].K, [LENSES["plumb_bob"]], cameras["left"].t[:, None]), strict=True
        ):
            assert np.array_equal(storage.getNode(key).mat(), value)
        if one:
            assert storage.getNode("image_width").real() == 640
            assert storage.getNode("distortion_model").string() == "plumb_bob"
        else:
            rotation = cv2.Rodrigues(storage.getNode("R_right").mat())[0]
            assert_allclose(rotation, cameras["right"].R, atol=1e-12)
            assert storage.getNode("names").at(1).string() == "right"


def test_camera_info_has_the_layout_of_ros(tmp_path: Path) -> None:
    camera = a_camera(1, BY_NAME["camera_info"], "rational_polynomial")
    write_calibration(tmp_path / "left.yaml", {"left": camera})
    data = yaml.safe_load((tmp_path / "left.yaml").read_text())
    assert (data["image_width"], data["image_height"], data["camera_name"]) == (640, 480, "left")
    assert data["distortion_model"] == "rational_polynomial"
    assert data["distortion_coefficients"] == {
        "rows": 1,
        "cols": 8,
        "data": list(LENSES["rational_polynomial"]),
    }
    assert data["camera_matrix"] == {"rows": 3, "cols": 3, "data": camera.K.ravel().tolist()}
    assert data["projection_matrix"]["cols"] == 4


def test_a_colmap_folder_has_three_files_and_keeps_existing_points(tmp_path: Path) -> None:
    cameras = {"a": a_camera(1, BY_NAME["colmap"], None)}
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "points3D.txt").write_text("1 0 0 0\n")
    write_calibration(tmp_path / "model", cameras, "colmap")
    assert sorted(f.name for f in (tmp_path / "model").iterdir()) == [
        "cameras.txt",
        "images.txt",
        "points3D.txt",
    ]
    assert (tmp_path / "model" / "points3D.txt").read_text() == "1 0 0 0\n"
    line = (tmp_path / "model" / "cameras.txt").read_text().splitlines()[1].split()
    assert line[:4] == ["1", "PINHOLE", "640", "480"]
    assert float(line[6]) == cameras["a"].K[0, 2] + 0.5


def test_camera_info_stores_the_baseline_of_a_stereo_pair(tmp_path: Path) -> None:
    p = np.array([[650.0, 0, 320, -65], [0, 650, 240, 0], [0, 0, 1, 0]])
    right = Camera(SIZE, K, np.eye(3), np.zeros(3), rectified=p)
    files = write_calibration(
        tmp_path / "rig", {"left": replace(right, rectified=None), "right": right}, "camera_info"
    )
    assert [file.name for file in files] == ["left.yaml", "right.yaml"]
    again = read_calibration(tmp_path / "rig")
    assert again["right"].rectified_projection[0, 3] == -65
    assert again["left"].rectified_projection[0, 3] == 0


# -- values that are not stored


@pytest.mark.parametrize(
    ("form", "said"),
    [
        ("camera_info", "camera poses"),
        ("ini", "camera poses"),
        ("krtd", "the image size: give 640x480"),
        ("shelf", "the image size: give 640x480"),
        ("kalibr", "R and P of rectified"),
    ],
)
def test_values_that_a_format_does_not_store_cause_a_warning(tmp_path: Path, form: str, said: str) -> None:
    camera = a_camera(1, BY_NAME["scene"], None)
    camera = replace(camera, K=K, rectified=np.column_stack([K, np.zeros(3)]))
    with pytest.warns(HumansimWarning) as caught:
        write_calibration(tmp_path / "out", {"a": camera}, form)
    assert any(said in str(warning.message) for warning in caught)


@pytest.mark.parametrize(
    ("form", "model", "what"),
    [
        ("middlebury", "plumb_bob", "plumb_bob distortion"),
        ("p", "equidistant", "equidistant distortion"),
        ("cam", "plumb_bob", "distortion"),
        ("shelf", "equidistant", "equidistant distortion"),
        ("human36m", "rational_polynomial", "rational_polynomial distortion"),
        ("kalibr", "rational_polynomial", "rational_polynomial distortion"),
        ("kalibr", "plumb_bob", "more than 4 coefficients"),
        ("ini", "equidistant", "equidistant distortion"),
        ("shelf", None, "skew"),
        ("colmap", None, "skew"),
        ("kalibr", None, "skew"),
        ("cam", None, "skew"),
    ],
)
def test_cameras_that_a_format_would_change_are_refused(
    tmp_path: Path, form: str, model: str | None, what: str
) -> None:
    camera = a_camera(1, BY_NAME["scene"], None)
    if model:
        k = camera.K * [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
        camera = replace(camera, K=k, model=model, distortion=LENSES[model])
    with pytest.raises(CameraError, match=what) as caught:
        write_calibration(tmp_path / "out", {"left": camera}, form)
    assert "left" in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_rational_lens_without_denominator_is_written_as_plumb_bob(tmp_path: Path) -> None:
    camera = replace(a_camera(1, BY_NAME["panoptic"], None), distortion=(*LENSES["plumb_bob"], 0, 0, 0))
    camera = replace(camera, model="rational_polynomial")
    write_calibration(tmp_path / "c.json", {"a": camera}, "panoptic")
    again = read_calibration(tmp_path / "c.json")["a"]
    assert (again.model, again.distortion) == ("plumb_bob", LENSES["plumb_bob"])


@pytest.mark.parametrize(
    ("target", "form", "names", "reason"),
    [
        ("a.yaml", None, ("a", "b"), "choose the format"),
        ("a.json", None, ("a",), "choose the format"),
        ("a", None, ("a",), "choose the format"),
        ("a.yaml", "nonsense", ("a",), "no calibration format 'nonsense'; there are"),
        ("a.yaml", "camera_info", ("a", "b"), "give a folder"),
        ("a.yaml", "camera_info", (), "no camera"),
        ("nowhere/a.yaml", "camera_info", ("a",), "No such file"),
        ("rig", "ini", ("a/b", "a_b"), "two cameras would be written to a_b.ini"),
        ("par.txt", "middlebury", ("a b",), "needs a name without blanks"),
        ("a.ini", "ini", ("image",), "cannot store a camera of this name"),
        ("a.yml", "opencv", ("a", "b c"), "letters, digits"),
        ("a.yml", "opencv", ("a", "coeffs"), "cannot store a camera of this name"),  # dist_coeffs
        ("here.txt", "colmap", ("a",), "needs a folder, and this is a file"),
    ],
)
def test_failed_writing_is_explained_and_keeps_existing_files(
    tmp_path: Path, target: str, form: str | None, names: tuple[str, ...], reason: str
) -> None:
    (tmp_path / "here.txt").write_text("kept")
    camera = replace(a_camera(1, BY_NAME["kalibr"], None), R=np.eye(3), t=np.zeros(3))
    with pytest.raises(CameraError, match=reason):
        write_calibration(tmp_path / target, dict.fromkeys(names, camera), form)
    assert [f.name for f in tmp_path.iterdir()] == ["here.txt"]
    assert (tmp_path / "here.txt").read_text() == "kept"


def test_an_error_while_writing_changes_no_file(tmp_path: Path) -> None:
    camera = Camera(SIZE, K, np.eye(3), np.zeros(3))
    write_calibration(tmp_path / "rig", {"a": camera, "b": camera}, "camera_info")
    before = {f.name: f.read_text() for f in (tmp_path / "rig").iterdir()}
    (tmp_path / "rig" / "c.yaml").mkdir()  # in the way
    other = replace(camera, K=camera.K + np.diag([1, 1, 0]))
    with pytest.raises(CameraError, match="cannot be written"):
        write_calibration(tmp_path / "rig", {"c": other, "a": other, "b": other}, "camera_info")
    (tmp_path / "rig" / "c.yaml").rmdir()
    assert {f.name: f.read_text() for f in (tmp_path / "rig").iterdir()} == before
