"""Wrong calibration files: every message has the file, and the key or line."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calibration_files import assert_refused, assert_refused_within, changed

from humansim_ros.cameras import Camera, read_calibration, write_calibration
from humansim_ros.cameras.formats.writing import FORMATS
from humansim_ros.errors import CameraError, HumansimWarning

pytestmark = pytest.mark.filterwarnings("ignore:.*image size is not in the file")

ROS = """image_width: 640
image_height: 480
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: [700, 0, 310, 0, 690, 245, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.3, 0.1, 0.001, 0.002, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [700, 0, 310, 0, 0, 690, 245, 0, 0, 0, 1, 0]
"""
#: Values of it that the tests replace.
K_TEXT, R_TEXT = "[700, 0, 310, 0, 690, 245, 0, 0, 1]", "[1, 0, 0, 0, 1, 0, 0, 0, 1]"
P_TEXT = "[700, 0, 310, 0, 0, 690, 245, 0, 0, 0, 1, 0]"
INI = """[image]
width
640
height
480
[left]
camera matrix
700 0 310
0 690 245
0 0 1
distortion
-0.3 0.1 0.001 0.002 0
rectification
1 0 0
0 1 0
0 0 1
projection
700 0 310 0
0 690 245 0
0 0 1 0
"""
P = "700 0 310 0\n0 690 245 0\n0 0 1 3\n"
KRTD = "700 0 310\n0 690 245\n0 0 1\n\n1 0 0\n0 1 0\n0 0 1\n\n0 0 3\n\n0\n"
PAR = "2\na.png 700 0 310 0 690 245 0 0 1 1 0 0 0 1 0 0 0 1 0 0 3\n"
PAR += PAR[2:].replace("a.png", "b.png")
KALIBR = """cam0:
  camera_model: pinhole
  intrinsics: [700, 690, 310, 245]
  distortion_model: radtan
  distortion_coeffs: [-0.2, 0.1, 0.001, 0.002]
  resolution: [640, 480]
cam1:
  T_cn_cnm1: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
  camera_model: pinhole
  intrinsics: [700, 690, 310, 245]
  distortion_model: radtan
  distortion_coeffs: [-0.2, 0.1, 0.001, 0.002]
  resolution: [640, 480]
"""
STORAGE = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 700., 0., 310., 0., 690., 245., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -0.3, 0.1, 0.001, 0.002, 0. ]
"""
XML = """<?xml version="1.0"?>
<opencv_storage>
<camera_matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>
<data>700. 0. 310. 0. 690. 245. 0. 0. 1.</data></camera_matrix>
</opencv_storage>
"""
CAMERAS = "# lenses\n1 PINHOLE 640 480 700 690 310 245\n"
IMAGES = "1 1 0 0 0 0 0 3 1 a.png\n\n2 1 0 0 0 1 0 3 1 b.png\n\n"
SCENE = """cameras:
  left:
    size: [640, 480]
    K: [[700, 0, 310], [0, 690, 245], [0, 0, 1]]
    R: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    t: [0, 0, 3]
"""
EYE = [[1.0, 0, 0], [0, 1, 0], [0, 0, 1]]
K = [[700.0, 0, 310], [0, 690, 245], [0, 0, 1]]
SHELF: dict[str, Any] = {
    "0": {
        "R": EYE,
        "T": [[0], [0], [0]],
        "fx": 700,
        "fy": 690,
        "cx": 515,
        "cy": 387,
        "k": [0] * 3,
        "p": [0] * 2,
    }
}
H36M: dict[str, Any] = {
    "intrinsics": {"5": {"calibration_matrix": K, "distortion": [0, 0, 0, 0, 0]}},
    "extrinsics": {"S1": {"5": {"R": EYE, "t": [[0], [0], [0]]}}},
}
PANOPTIC: dict[str, Any] = {
    "cameras": [
        {"name": "00_00", "resolution": [640, 480], "K": K, "distCoef": [0] * 5, "R": EYE, "t": [0, 0, 0]}
    ]
}


def test_the_files_are_valid_before_they_are_changed(tmp_path: Path) -> None:
    (tmp_path / "images.txt").write_text(IMAGES)
    texts = [ROS, INI, P, KRTD, PAR, KALIBR, STORAGE, XML, SCENE, *map(json.dumps, (SHELF, H36M, PANOPTIC))]
    for text in [*texts, CAMERAS]:
        path = tmp_path / ("cameras.txt" if text == CAMERAS else "calibration")
        path.write_text(text)
        for camera in read_calibration(path).values():
            assert camera.K[1, 1] == 690
            assert list(camera.K[:2, 2]) in ([310, 245], [515, 387], [309.5, 244.5])


@pytest.mark.parametrize(
    "header", ["%YAML:1.0\n", "%YAML:1.0\n---\n", "%YAML 1.1\n---\n", "\ufeff# a comment\n---\n"]
)
def test_headers_change_neither_cameras_nor_line_numbers(tmp_path: Path, header: str) -> None:
    path = tmp_path / "left.yaml"
    path.write_text(header + ROS, encoding="utf-8")
    assert list(read_calibration(path)) == ["left"]
    path.write_text(header + ROS.replace("plumb_bob", "omni"), encoding="utf-8")
    with pytest.raises(CameraError) as caught:
        read_calibration(path)
    assert caught.value.line == 8 + header.count("\n")


@pytest.mark.parametrize("ending", ["\r\n", "\r"])
def test_line_endings_of_all_systems_are_read(tmp_path: Path, ending: str) -> None:
    path = tmp_path / "calibration"
    for text in (ROS, INI, P, KRTD, PAR, KALIBR, STORAGE, XML, SCENE):
        path.write_bytes(text.encode())
        expected = {name: camera.P.tolist() for name, camera in read_calibration(path).items()}
        path.write_bytes(text.replace("\n", ending).encode())
        assert {name: camera.P.tolist() for name, camera in read_calibration(path).items()} == expected


def ros(old: str, new: str) -> str:
    assert old in ROS
    return ROS.replace(old, new)


@pytest.mark.daily(
    "text2-:1: image_width: the image size must be 1 to 8192",
    "text92-:7: cameras.left.calibration: a camera with a calibration file",
)
@pytest.mark.parametrize(
    ("text", "said"),
    [
        # ROS
        (ros("image_width: 640\n", "image_width: 0\n"), ":1: image_width: needs a whole number above zero"),
        (ros("image_width: 640\n", "image_width: 640.5\n"), ":1: image_width: needs a whole number"),
        (
            ros("image_width: 640\n", "image_width: 1000000\n"),
            ":1: image_width: the image size must be 1 to 8192",
        ),
        (ros("image_height: 480\n", ""), ": image_height: is missing"),
        (ros(K_TEXT, "[-700, 0, 310, 0, 690, 245, 0, 0, 1]"), ":7: camera_matrix.data: K is singular or"),
        (ros(K_TEXT, "[700, 0, 310, 0, 690, 245]"), ":7: camera_matrix.data: needs 3 x 3 numbers, not 6"),
        (ros(K_TEXT, "[0, 0, 0, 0, 0, 0, 0, 0, 0]"), "camera_matrix.data: is all zeros"),
        (ros(K_TEXT, "seven"), ":7: camera_matrix.data: 'seven' is not a number"),
        (
            ros(K_TEXT, "[700, 0, 310, 5, 690, 245, 0, 0, 1]"),
            "camera_matrix.data: K must be upper triangular",
        ),
        (ros("-0.3, 0.1", ".nan, 0.1"), ":12: distortion_coefficients.data: a number is not finite"),
        (ros("-0.3, 0.1", "1e999, 0.1"), ":12: distortion_coefficients.data: a number is not finite"),
        (ros("-0.3, 0.1", "true, 0.1"), ":12: distortion_coefficients.data: 'bool' is not a number"),
        (
            ros(", 0.002, 0]", ", 0.002, 0, 0.4, 0.5, 0.6]"),
            ":12: distortion_coefficients.data: plumb_bob has 4 or 5 coefficients, not 8",
        ),
        (
            ros("[-0.3, 0.1, 0.001, 0.002, 0]", "[-0.3]"),
            "distortion_coefficients.data: plumb_bob has 4 or 5 coefficients, not 1",
        ),
        (ros("plumb_bob", "rational_polynomial"), "rational_polynomial has 8 coefficients, not 5"),
        (
            ros("plumb_bob", "equidistant").replace("0.002, 0]", "0.002, 1]"),
            "equidistant has 4 coefficients, not 5",
        ),
        (
            ros("plumb_bob", "omni"),
            ":8: distortion_model: unknown distortion model 'omni'; known are plumb_bob",
        ),
        (
            ros("distortion_model: plumb_bob\n", "").replace(", 0.002, 0]", ", 0.002]"),
            "distortion_model: is missing, and 4 coefficients do not determine it: add one of plumb_bob",
        ),
        (ros("plumb_bob", "none"), ":8: distortion_model: is 'none', but there are distortion coefficients"),
        (
            ros(R_TEXT, "[1, 0, 0, 0, 1, 0, 0, 0, 1.1]"),
            ":16: rectification_matrix.data: rectification is not a rotation",
        ),
        (
            ros(R_TEXT, "[1, 0, 0, 0, 1, 0, 0, 0, -1]"),
            ":16: rectification_matrix.data: rectification is a reflection",
        ),
        (
            ros(P_TEXT, "[-1, 0, 310, 0, 0, 690, 245, 0, 0, 0, 1, 0]"),
            ":20: projection_matrix.data: the rectified P",
        ),
        (
            ros("camera_name: left\n", "camera_name: left\nimage_width: 650\n"),
            ":4: image_width: repeated key",
        ),
        (
            ros("camera_name: left", "camera_name: !!python/object/apply:os.system [touch /tmp/x]"),
            ":3: not valid YAML: could not determine a constructor",
        ),
        (ros("  data: [700, 0, 310, 0, 690, 245, 0, 0, 1]", "  data: [700, 0, 310, 0,"), "not valid YAML"),
        (ROS[: ROS.index("distortion_model")], "distortion_coefficients: is missing"),
        # INI
        (INI.replace("width\n640\n", "width\n0\n"), ":2: image.width: needs a whole number above zero"),
        (INI.replace("width\n640\n", ""), "image.width: is missing"),
        (
            INI.replace("0 0 1\ndistortion", "distortion"),
            ":7: left.camera_matrix: needs 3 x 3 numbers, not 6",
        ),
        (
            INI.replace("-0.3 0.1 0.001 0.002 0", "-0.3 0.1 0.001 0.002 0 1"),
            ":11: left.distortion: plumb_bob has 4 or 5 coefficients, not 6",
        ),
        (
            INI.replace("-0.3 0.1 0.001 0.002 0", "-0.3 nan 0.001 0.002 0"),
            ":11: left.distortion: '' is not a number",
        ),
        (INI.replace("rectification\n", "projection\n"), "left.rectification: is missing"),
        (INI[: INI.index("[left]")], "missing: K or focal length"),
        (INI.replace("[left]\ncamera matrix\n", "[left]\n"), "left.camera_matrix: is missing"),
        # plain text
        (P.replace("0 0 1 3", "0 0 0 0"), ":1: P: P is singular: its camera is at infinity"),
        (P.replace("0 0 1 3", "0 0 inf 3"), ":3: a number is not finite"),
        (P.replace("0 0 1 3", "0 0 1e300 3"), ":3: 1e+300 is too large"),
        (P.replace("0 0 1 3\n", ""), ":2: found 2 rows of 4 numbers, which are not matrices P of three rows"),
        (
            "1 0 0 2\n0 1 0 3\n0 0 1 4\n0 0 0 1\n",
            ":4: found one 4 x 4 matrix: rotation and translation; missing",
        ),
        (P + "1 2 3\n", ":4: rows of P have 4 numbers each"),
        (f"# a\n{P}# a\n{P}", ":6: there are two cameras with the name 'a'"),
        (KRTD[:30], ":5: needs K (3 x 3), R (3 x 3) and t (3)"),
        (KRTD.replace("1 0 0\n", "1.1 0 0\n"), ":5: R: R is not a rotation"),
        (KRTD.replace("1 0 0\n", "-1 0 0\n"), ":5: R: R is a reflection"),
        (KRTD + KRTD, "does the file hold more than one camera?"),
        (
            KRTD.replace("\n\n0\n", "\n\n-0.3 0.1 0 0 0 0 0 0 9\n"),
            ":11: distortion: rational_polynomial has 8",
        ),
        (PAR.replace("2\n", "3\n", 1), ":1: declares 3 cameras, but has 2: is the file complete?"),
        (
            PAR.replace(" 0 0 3\nb.png", " 0 0\nb.png"),
            ":2: needs an image name, K (9), R (9) and t (3): 21 numbers, not 20",
        ),
        (PAR.replace("b.png", "a.png"), ":3: there are two cameras with the name 'a'"),
        (PAR.replace("a.png 700", "a.png x700"), ":2: 'x700' is not a number"),
        ("C=1,2,3\nf=0\nR=0,0,0\nsize=640x480\n", ":2: f: must be above zero"),
        ("C=1,2,3\nf=1\nR=0,0,0\nsize=640x480\ncolour=red\n", ":5: colour: unknown key"),
        # JSON
        (changed(SHELF, "0.fx", -700), "0.fx: K is singular or has a focal length that is not positive"),
        (changed(SHELF, "0.fy", None), "0.fy: is missing"),
        (changed(SHELF, "0.T", [1, 2]), "0.T: needs 3 numbers, not 2"),
        (changed(SHELF, "0.R", [[float("nan"), 0, 0], [0, 1, 0], [0, 0, 1]]), "0.R: a number is not finite"),
        (
            changed(SHELF, "0.R", [[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
            "0.R: R is a reflection (its determinant is -1)",
        ),
        (changed(SHELF, "0.R", [[1, 0, 0.01], [0, 1, 0], [0, 0, 1]]), "0.R: R is not a rotation matrix"),
        (
            changed(H36M, "intrinsics.5.calibration_matrix", 3),
            "cameras.0.calibration_matrix: needs 4 or 9 or 16 numbers, not 1",
        ),
        (
            changed(H36M, "extrinsics.S1", {"6": {"R": EYE, "t": [0, 0, 0]}}),
            "extrinsics.S1.6: has no intrinsics",
        ),
        (changed(H36M, "intrinsics.5.distortion", [1] * 8), "cameras.0.distortion: plumb_bob has 4 or 5"),
        (changed(PANOPTIC, "cameras.0.K", None), "is not a known calibration format"),
        (changed(PANOPTIC, "cameras.0.resolution", [640]), "cameras.0.resolution: needs 2 numbers, not 1"),
        ('{"0": {"R": 1, "R": 2}}', "R: this key is duplicate"),
        ('{"0": [1, 2', ":1: not valid JSON"),
        ("{" * 100000, "not valid"),
        ('{"a":' * 100000, "not valid JSON"),
        ('{"a": ' + "9" * 5000 + "}", "not valid JSON"),
        (
            '{"a": 1}',
            "is not a known calibration format. Its keys are a. Nothing of a camera was found in it; missing",
        ),
        ('{"a": 1}', "K or focal length, image size, rotation, translation. Known in JSON: OpenMVG"),
        # Kalibr
        (
            KALIBR.replace("pinhole", "omni", 1),
            ":2: cam0.camera_model: 'omni' is not a supported camera model; only pinhole is",
        ),
        (KALIBR.replace("radtan", "fov", 1), ":4: cam0.distortion_model: unknown distortion model 'fov'"),
        (
            KALIBR.replace("  T_cn_cnm1: [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n", ""),
            ":7: cam1.T_cn_cnm1: is missing",
        ),
        (KALIBR.replace("[0, 0, 0, 1]]", "[0, 0, 1, 1]]"), "cam1.T_cn_cnm1: needs 0 0 0 1 as the last row"),
        (KALIBR.replace("0.001, 0.002]", "0.001]", 1), ":5: cam0.distortion_coeffs: needs 4 numbers, not 3"),
        # OpenCV
        (STORAGE.replace("245.", ".Nan"), ":9: camera_matrix.data: '.Nan' is not a number"),
        (
            STORAGE.replace("0.002, 0. ]", "0.002, 0., 0, 0, 0, 1 ]"),
            "distortion_coefficients.data: rational_polynomial has 8 coefficients, not 9",
        ),
        (STORAGE + "R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n", ":15: R: needs a translation"),
        (
            STORAGE.replace("!!opencv-matrix", "!!opencv-nd-matrix"),
            ":5: not valid YAML: could not determine a constructor",
        ),
        (
            STORAGE.replace("camera_matrix: !!opencv-matrix", "camera_matrix: !!opencv-matrix 5\nx:"),
            ":5: not valid YAML: an opencv-matrix needs rows",
        ),
        (XML.replace("690.", "x"), "camera_matrix.data: 'x' is not a number"),
        ("<svg width='640' height='480'/>", "is not a known calibration format. Its keys are svg"),
        (XML[:-20], ": not valid XML"),
        (
            XML.replace("<opencv_storage>", "<!DOCTYPE a [<!ENTITY b 'c'>]><opencv_storage>&b;"),
            "must not have document types or entities",
        ),
        ("<a>" * 3000 + "</a>" * 3000, "a: the elements are nested too deeply"),
        (
            "<opencv_storage>" + "<a>" * 3000 + "</a>" * 3000 + "</opencv_storage>",
            "a: the elements are nested too deeply",
        ),
        # COLMAP
        (CAMERAS.replace("PINHOLE", "FOV"), ":2: unknown camera model 'FOV'; known are SIMPLE_PINHOLE"),
        (CAMERAS.replace(" 245", ""), ":2: PINHOLE needs fx fy cx cy after width and height, not 3 numbers"),
        (CAMERAS.replace("640", "0"), ":2: width and height must be whole numbers above zero"),
        (CAMERAS + "1 PINHOLE 640 480 700 690 310 245\n", ":3: there are two cameras with the name '1'"),
        # scene
        (SCENE.replace("    t: [0, 0, 3]\n", ""), ":2: cameras.left.t: is missing"),
        (SCENE.replace("[1, 0, 0]", "[2, 0, 0]"), ":5: cameras.left.R: R is not a rotation"),
        (
            SCENE + "    calibration: a.yaml\n",
            ":7: cameras.left.calibration: a camera with a calibration file",
        ),
        # none of them
        ("hello world\n", "is not a known calibration format. Known in text: Bundler"),
        (
            "a: 1\nb: 2\n",
            "Its keys are a, b. Nothing of a camera was found in it; missing: K or focal length",
        ),
        ("a: 1\nb: 2\n", "Known in YAML: ROS camera_info YAML, Kalibr"),
        ("\x00\x01\x02\x03", "this is a binary file"),
        ("  \n", "the calibration file is empty"),
    ],
)
def test_errors_have_key_and_line(tmp_path: Path, text: str, said: str) -> None:
    assert_refused(tmp_path, text, said)


@pytest.mark.parametrize(
    ("cameras", "images", "said"),
    [
        (None, IMAGES, "cameras.txt: no such COLMAP cameras file"),
        (
            CAMERAS,
            IMAGES.replace("3 1 b.png", "3 2 b.png"),
            "images.txt:3: there is no camera 2 in cameras.txt",
        ),
        (
            CAMERAS,
            IMAGES.replace("1 1 0 0 0 0", "1 2 0 0 0 0"),
            "images.txt:1: the quaternion is not a rotation: its length is 2",
        ),
        (CAMERAS, IMAGES.replace("b.png", "a.png"), "images.txt:3: there are two cameras with the name 'a'"),
        (CAMERAS, IMAGES.replace(" 3 1 a.png", ""), "images.txt:1: needs an image id, a quaternion"),
        (CAMERAS, "# nothing\n", "images.txt: the file has no images"),
        (CAMERAS.replace("700", "-700"), IMAGES, "cameras.txt:2: a.K: K is singular or has a focal length"),
    ],
)
def test_errors_in_a_pair_of_colmap_files_have_the_file(
    tmp_path: Path, cameras: str | None, images: str, said: str
) -> None:
    if cameras is not None:
        (tmp_path / "cameras.txt").write_text(cameras)
    (tmp_path / "images.txt").write_text(images)
    with pytest.raises(CameraError) as caught:
        read_calibration(tmp_path / "images.txt")
    assert str(caught.value).startswith(f"{tmp_path / said}")


def test_missing_files_are_named(tmp_path: Path) -> None:
    for path, said in (
        (tmp_path / "a.yaml", "no such calibration file"),
        (tmp_path, "no calibration in this folder"),
    ):
        with pytest.raises(CameraError, match=said):
            read_calibration(path)


def test_wrong_arguments_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(ROS)
    for options, said in (
        ({"unit": -1.0}, "unit: "),
        ({"unit": float("nan")}, "unit: "),
        ({"up": "north"}, "up: 'north' is not an axis"),
        ({"size": (0, 480)}, "size: the image size must be 1 to 8192"),
        ({"image": tmp_path / "a.yaml"}, "this is not a PNG or JPEG"),
        ({"image": tmp_path / "no.png"}, "no such image"),
    ):
        with pytest.raises(CameraError, match=said):
            read_calibration(tmp_path / "a.yaml", **options)  # type: ignore[arg-type]


def test_yaml_tags_create_no_objects(tmp_path: Path) -> None:
    made = tmp_path / "made"
    for tag in ("python/object/apply:os.mkdir", "python/object/new:os.mkdir"):
        (tmp_path / "a.yaml").write_text(ROS + f"extra: !!{tag} [{made}]\n")
        with pytest.raises(CameraError, match="could not determine a constructor"):
            read_calibration(tmp_path / "a.yaml")
    assert not made.exists()


@pytest.mark.daily("nested")
@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        "a: &a [1, 2]\n"
        + "".join(f"{y}: &{y} [*{x}, *{x}]\n" for x, y in zip("abcdefghijklm", "bcdefghijklmn", strict=True))
        + ROS.replace(K_TEXT, "*n"),
        "K: &a [" + "1, " * 9 + "]\n" + "D: &b [*a, *a]\nM: [" + "*b, " * 5000 + "]\n",
        "- " * 50000,
        "[" * 50000,
        "1 " * 100_000,
        "P: 1\n" * 20_000,
        "1 2 3 4\n" * 100_000,
        "<opencv_storage>" + "<a>1</a>" * 50_000 + "</opencv_storage>",
        '{"cameras": [' + '{"K": 1},' * 50_000 + "{}]}",
    ],
    ids=["references", "more references", "nested", "brackets", "words", "keys", "rows", "elements", "items"],
)
def test_hostile_files_are_refused_quickly(tmp_path: Path, text: str) -> None:
    assert_refused_within(tmp_path, text, seconds=60)  # on a loaded machine


def test_large_files_are_refused_before_they_are_read(tmp_path: Path) -> None:
    with (tmp_path / "a").open("wb") as file:
        os.truncate(file.fileno(), 1 << 40)
    with pytest.raises(CameraError, match="file is too large: 1024 GB; at most 8 MB are read"):
        read_calibration(tmp_path / "a")
    (tmp_path / "b").write_text("# " + "x" * 2_000_000 + "\n" + ROS)
    with pytest.raises(CameraError, match="too large for a calibration in YAML: more than 512 kB"):
        read_calibration(tmp_path / "b")


# -- files that are usable with a warning


def test_a_missing_model_of_five_coefficients_is_plumb_bob(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(ros("distortion_model: plumb_bob\n", ""))
    with pytest.warns(
        HumansimWarning, match="distortion_model is missing; 5 coefficients are taken for plumb_bob"
    ):
        assert read_calibration(tmp_path / "a.yaml")["left"].model == "plumb_bob"


def test_a_rotation_with_a_small_error_is_corrected(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(changed(SHELF, "0.R", [[1, 5e-4, 0], [0, 1, 0], [0, 0, 1]]))
    with pytest.warns(HumansimWarning, match=r"a.json: 0: R is a rotation matrix only to 0.0005"):
        r = read_calibration(path)["0"].R
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-15)


@pytest.mark.daily("colmap", "opencv_xml")
@pytest.mark.filterwarnings("ignore:.*does not hold the image size")
@pytest.mark.parametrize("form", FORMATS, ids=lambda form: form.name)
def test_truncated_files_are_refused_or_read(tmp_path: Path, form: Any) -> None:
    k = np.array([[640.0, 0, 319.5], [0, 640, 239.5], [0, 0, 1]])
    lens = ((0.0,) * 4, "equidistant") if form.name == "egoexo4d" else ()
    camera = Camera((640, 480), k, np.eye(3), np.array([0, 0, 3.0]), *lens)
    cameras = {"color" if form.name == "k4a" else "out": camera}
    if form.name == "zed":
        left = Camera((672, 376), k, np.eye(3), np.zeros(3))
        cameras = {"left": left, "right": left}
    (path, *_) = write_calibration(tmp_path / f"out{form.suffix}", cameras, form.name)
    content, read = path.read_bytes(), 0
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        try:
            read += len(read_calibration(path))
        except CameraError as error:
            assert error.path is not None  # noqa: PT017
    assert read < len(content) / 14  # hardly any of these says all
