"""The ``humansim camera`` commands show and convert."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_files import calibration_path
from conftest import if_shared
from numpy.testing import assert_allclose

from humansim_ros.cameras import Camera, read_calibration, write_calibration
from humansim_ros.cameras.formats.checks import check_camera, check_rig, field_of_view
from humansim_ros.cameras.formats.writing import FORMATS
from humansim_ros.cli.camera import describe_camera
from humansim_ros.cli.main import main


def humansim(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run the command in this process, which is faster than a child process."""
    out, err = io.StringIO(), io.StringIO()
    words = ["humansim", "camera", *map(str, arguments)]
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(out), redirect_stderr(err):
        patch.setattr(sys, "argv", words)
        patch.setattr(warnings, "showwarning", warnings.showwarning)  # main() puts its own there
        code = main()
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def shown(*arguments: str | Path) -> dict[str, Any]:
    result = humansim("show", *arguments, "--json")
    assert result.returncode == 0, result.stderr
    return dict(json.loads(result.stdout))


@pytest.mark.parametrize(
    "words", [["show", "{}"], ["convert", "{}", "-o", "a.yaml"], ["rig", "--ring", "3", "-o", "{}"]]
)
def test_invalid_file_names_are_refused(words: list[str]) -> None:
    result = humansim(*(word.format("x" * 300) for word in words))
    assert result.returncode == 2
    assert "File name too long" in result.stderr


@pytest.mark.parametrize(
    ("file", "name"),
    [("own_stereo.yaml", "left_camera"), *if_shared(("usb_cam_camera_info.yaml", "test_camera"))],
)
def test_show_prints_all_values_of_a_camera(file: str, name: str) -> None:
    path = calibration_path(file)
    facts = shown(path)
    (camera,) = facts["cameras"]
    assert (facts["form"], facts["unit"], facts["up"], facts["warnings"]) == ("camera_info", 1.0, "z", [])
    assert (camera["name"], camera["size"], camera["model"]) == (name, [640, 480], "plumb_bob")
    assert camera["distortion"] == [-0.361976, 0.11051, 0.001014, 0.000505, 0]
    assert camera["K"][0] == [438.783367, 0, 305.593336] and camera["rectified"][0][0] == 393.6538
    assert camera["center"] == [0, 0, 0] and camera["baseline"] == 0
    assert 87 < camera["fov_deg"]["horizontal"] < camera["fov_deg"]["diagonal"] < 105
    assert camera["warnings"] == []
    text = humansim("show", path).stdout
    for part in ("640x480", "438.783", "-0.361976", "87.5° across"):
        assert part in text


@pytest.mark.parametrize(
    ("file", "others"),
    [
        ("own_mislabelled_1640x1232.yaml", ("own_1280x720.yaml", "own_410x308.yaml")),
        *if_shared(
            (
                "raspicam_camerav2_1640x1232.yaml",
                ("raspicam_camerav1_1280x720.yaml", "raspicam_camerav2_410x308.yaml"),
            )
        ),
    ],
)
def test_show_names_the_size_that_k_belongs_to(file: str, others: tuple[str, ...]) -> None:
    path = calibration_path(file)
    (camera,) = shown(path)["cameras"]
    assert (
        "39% and 39% of a 1640x1232 image: this K belongs to an image of about 1280x960"
        in camera["warnings"][0]
    )
    assert shown(path, "--size", "1280x960")["cameras"][0]["warnings"] == []
    for name in others:
        assert shown(calibration_path(name))["cameras"][0]["warnings"] == []


@pytest.mark.parametrize(
    ("human36m", "shelf"),
    [
        ("own_human36m.json", "own_shelf.json"),
        *if_shared(("human36m_camera-parameters.json", "shelf_voxelpose.json")),
    ],
)
def test_show_takes_sizes_units_axes_and_names(human36m: str, shelf: str) -> None:
    facts = shown(calibration_path(human36m), "--camera", "S9_*")
    assert [camera["name"] for camera in facts["cameras"]] == [
        f"S9_{n}" for n in (54138969, 55011271, 58860488, 60457274)
    ]
    assert facts["unit"] == 0.001
    path = calibration_path(shelf)
    facts = shown(path, "--size", "1032x776", "--unit", "1", "--up", "-z", "--camera", "0")
    center = np.ravel(json.loads(path.read_text())["0"]["T"])  # millimetres
    assert_allclose(facts["cameras"][0]["center"], center * [1, -1, -1])
    said = humansim("show", path, "--camera", "9")
    assert said.returncode == 2 and "no camera is named 9; the names are 0, 1, 2" in said.stderr
    said = humansim("show", path, "--size", "large")
    assert said.returncode == 2 and "--size: needs width and height" in said.stderr


@pytest.mark.parametrize("shelf", ["own_shelf.json", *if_shared("shelf_voxelpose.json")])
def test_convert_from_format_to_format(tmp_path: Path, shelf: str) -> None:
    path = calibration_path(shelf)
    steps = [
        ("colmap", tmp_path / "model"),
        ("kalibr", tmp_path / "chain.yaml"),
        ("opencv", tmp_path / "rig.yml"),
        ("scene", tmp_path / "rig.yaml"),
        ("panoptic", tmp_path / "rig.json"),
        ("p", tmp_path / "rig.txt"),
    ]
    source, size = path, ["--size", "1032x776"]
    for form, target in steps:
        result = humansim("convert", source, "-o", target, "--to", form, *size)
        assert result.returncode == 0, result.stderr
        assert f"wrote {target}" in result.stdout
        source, size = target, []
    first, last = read_calibration(path, size=(1032, 776)), read_calibration(source)
    for camera, other in zip(first.values(), last.values(), strict=True):
        assert camera.size == other.size
        assert_allclose(other.P, camera.P, rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("stem", ["own_", *if_shared("image_common_calib")])
def test_convert_joins_files_and_splits_rigs(tmp_path: Path, stem: str) -> None:
    files = [calibration_path(f"{stem}{n}.ini") for n in (5, 8)]
    result = humansim("convert", *files, "-o", tmp_path / "both.xml", "--to", "opencv_xml")
    assert result.returncode == 0 and "several cameras mono_left" in result.stderr
    result = humansim("convert", tmp_path / "both.xml", "-o", tmp_path / "rig", "--to", "camera_info")
    assert sorted(f.name for f in (tmp_path / "rig").iterdir()) == [f"{file.stem}.yaml" for file in files]
    for file in files:
        (camera,) = read_calibration(file).values()
        (other,) = read_calibration(tmp_path / "rig" / f"{file.stem}.yaml").values()
        assert (other.distortion, other.model) == (camera.distortion, camera.model)
        assert np.array_equal(other.rectified_projection, camera.rectified_projection)


@pytest.mark.parametrize(
    ("shelf", "bent"),
    [("own_shelf.json", "own_stereo.yaml"), *if_shared(("shelf_voxelpose.json", "usb_cam_camera_info.yaml"))],
)
def test_convert_warns_about_lost_values_or_refuses(tmp_path: Path, shelf: str, bent: str) -> None:
    result = humansim("convert", calibration_path(shelf), "-o", tmp_path / "rig", "--to", "camera_info")
    assert result.returncode == 0 and "R and t of 0, 1, 2, 3 and 1 more are left out" in result.stderr
    result = humansim("convert", calibration_path(bent), "-o", tmp_path / "p.txt")
    assert result.returncode == 2 and "cannot store plumb_bob distortion: idealize" in result.stderr
    assert not (tmp_path / "p.txt").exists()


def test_an_unknown_format_prints_all_formats(tmp_path: Path) -> None:
    path = calibration_path("own_stereo.yaml")
    result = humansim("convert", path, "-o", tmp_path / "a.yaml", "--to", "nonsense")
    assert result.returncode == 2
    assert result.stderr.strip().endswith(f"there are {', '.join(form.name for form in FORMATS)}")


# -- plausibility checks

K = np.array([[600.0, 0, 319.5], [0, 600, 239.5], [0, 0, 1]])
GOOD = Camera.look_at((3, 2, 1.5), (0, 0, 1))


def camera(**parts: Any) -> Camera:
    given = {"size": (640, 480), "K": K, "R": GOOD.R, "t": GOOD.t, **parts}
    return Camera(**given)


def ring(scale: float = 1.0, up: tuple[float, float, float] = (0, 0, 1)) -> dict[str, Camera]:
    basis = {(0, 0, 1): np.eye(3), (0, -1, 0): np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])}[up]
    places = [(3, 0, 1), (0, 3, 1), (-3, 0, 1)]
    return {
        str(i): Camera.look_at(basis @ np.array(place) * scale, basis @ np.array([0, 0, scale]), up=up)
        for i, place in enumerate(places)
    }


def test_plausible_cameras_pass_all_checks() -> None:
    assert check_camera(GOOD) == check_camera(camera(distortion=(-0.3, 0.1, 0, 0))) == check_rig(ring()) == []


@pytest.mark.parametrize(
    ("odd", "said"),
    [
        (camera(K=[[600, 0, 320], [0, 1200, 240], [0, 0, 1]]), "the pixels are not square: fx / fy is 0.500"),
        (camera(K=[[600, 30, 320], [0, 600, 240], [0, 0, 1]]), "a skew of 30, 5.0% of the focal length"),
        (camera(K=[[0.9, 0, 320], [0, 0.9, 240], [0, 0, 1]]), "is K in pixels?"),
        (camera(distortion=(-0.9, 0, 0, 0)), "of the image sees nothing: this lens model folds"),
        (
            camera(rectified=[[2400, 0, 320, 0], [0, 2400, 240, 0], [0, 0, 1, 0]]),
            "4 and 4 times K",
        ),
        (camera(rectified=[[600, 0, -20, 0], [0, 600, 240, 0], [0, 0, 1, 0]]), "is outside the image"),
        (camera(rectified=[[600, 0, 320, -72000], [0, 600, 240, 0], [0, 0, 1, 0]]), "a baseline of 120 m"),
        (Camera.look_at((0, 0, 1), (0.1, 0, 5)), "looks straight up"),
        (Camera.look_at((3, 2, 1.5), (0, 0, 1), up=(0, 0, -1)), "is upside down"),
        (Camera.look_at((3, 2, -1.5), (0, 0, 1)), "is below the floor, at z = -1.50 m"),
        (Camera.look_at((3000, 2000, 1500), (0, 0, 1)), "3.91e+03 m from the origin"),
    ],
)
def test_implausible_cameras_are_reported(odd: Camera, said: str) -> None:
    (message,) = check_camera(odd)
    assert said in message


#: Principal points of VGA cameras as in CMU Panoptic: off the centre in any direction.
OFF_CENTRE = [(374.3, 226.2), (388.1, 270.4), (366.0, 252.9), (399.2, 233.7), (260.3, 209.8), (345.6, 281.1)]


def test_principal_points_off_the_centre_are_one_note(tmp_path: Path) -> None:
    cameras = {
        f"00_0{i}": camera(K=[[745, 0, x], [0, 745, y], [0, 0, 1]]) for i, (x, y) in enumerate(OFF_CENTRE)
    }
    assert [message for one in cameras.values() for message in check_camera(one)] == []
    write_calibration(tmp_path / "c.json", cameras, "panoptic")
    facts = shown(tmp_path / "c.json")
    assert [one["warnings"] for one in facts["cameras"]] == [[]] * len(cameras)
    (note,) = facts["warnings"]
    assert note.startswith(
        "note: the principal point of 00_03, (399.2, 233.7), is 12% of a side from the centre"
    )
    assert "and 4 more are above 7.5%" in note
    read_calibration(tmp_path / "c.json")  # says nothing: no warning is an error here


@pytest.mark.parametrize(
    ("size", "of"),
    [
        ((1640, 1232), (1280, 960)),
        ((1920, 1080), (1280, 720)),
        ((640, 480), (1280, 960)),
        ((700, 525), (1400, 1050)),
    ],
)
def test_a_k_of_another_image_size_is_told(size: tuple[int, int], of: tuple[int, int]) -> None:
    middle = np.array(of) / 2 * [1.004, 0.993] - 0.5
    wrong = camera(size=size, K=[[of[0], 0, middle[0]], [0, of[0], middle[1]], [0, 0, 1]])
    (message,) = check_camera(wrong)
    assert f"of a {size[0]}x{size[1]} image: this K belongs to an image of about {of[0] // 100}" in message


def test_rigs_in_other_units_or_axes_are_reported() -> None:
    for scale in (1000, 0.001):
        (message,) = check_rig(ring(scale))
        assert "is the unit of the file correct?" in message
    (message,) = check_rig(ring(up=(0, -1, 0)))
    assert "for most of the cameras -y is up, not z" in message


def test_the_field_of_view_is_that_of_the_lens() -> None:
    ideal = field_of_view(camera())
    assert ideal.horizontal == pytest.approx(2 * np.arctan(320 / 600))
    assert ideal.vertical == pytest.approx(2 * np.arctan(240 / 600))
    assert ideal.diagonal == pytest.approx(2 * np.arctan(400 / 600))
    fisheye = camera(model="equidistant")  # an angle of r / f at r pixels from the middle
    assert field_of_view(fisheye).diagonal == pytest.approx(2 * 400 / 600)
    # pincushion sees less, barrel more
    assert field_of_view(camera(distortion=(0.2,))).diagonal < ideal.diagonal
    assert field_of_view(camera(distortion=(-0.2,))).diagonal > ideal.diagonal
    assert describe_camera("a", camera(distortion=(-0.9,)))["fov_deg"]["diagonal"] is None


def test_a_mirrored_rig_is_refused(tmp_path: Path) -> None:
    write_calibration(tmp_path / "rig.yaml", {"a": GOOD}, "scene")
    text = (tmp_path / "rig.yaml").read_text()
    flipped = GOOD.R * [[-1], [1], [1]]
    rows = ", ".join(str(values) for values in flipped.tolist())
    start = text.index("    R:")
    (tmp_path / "rig.yaml").write_text(text[:start] + f"    R: [{rows}]\n" + text[text.index("    t: ") :])
    result = humansim("show", tmp_path / "rig.yaml")
    assert (
        result.returncode == 2 and "cameras.a.R: R is a reflection (its determinant is -1)" in result.stderr
    )


def halves(folder: Path) -> tuple[Path, Path]:
    """A file with intrinsics and one with extrinsics of two cameras."""
    inner, outer = folder / "lenses.json", folder / "poses.json"
    k = [[700, 0, 319.5], [0, 700, 239.5], [0, 0, 1]]
    inner.write_text(json.dumps({name: {"K": k, "size": [640, 480]} for name in "ab"}))
    poses = {name: {"rvec": [2.2, 0, 0], "tvec": [index, 1, 3]} for index, name in enumerate("ab")}
    outer.write_text(json.dumps({"unit": "m", **poses}))
    return inner, outer


def test_show_joins_a_file_of_intrinsics_and_one_of_extrinsics(tmp_path: Path) -> None:
    facts = shown(*halves(tmp_path))
    assert [(camera["name"], camera["t"]) for camera in facts["cameras"]] == [
        ("a", [0, 1, 3]),
        ("b", [1, 1, 3]),
    ]


def test_convert_joins_a_file_of_intrinsics_and_one_of_extrinsics(tmp_path: Path) -> None:
    for files in (halves(tmp_path), halves(tmp_path)[::-1]):
        result = humansim("convert", *files, "-o", tmp_path / "rig.toml")
        assert result.returncode == 0, result.stderr
        assert read_calibration(tmp_path / "rig.toml")["b"].t.tolist() == [1, 1, 3]


def test_a_file_of_extrinsics_alone_says_what_is_missing(tmp_path: Path) -> None:
    _, outer = halves(tmp_path)
    result = humansim("show", outer)
    assert result.returncode == 2
    assert "Found rotation and translation of a, b; missing: K or focal length, image size" in result.stderr
