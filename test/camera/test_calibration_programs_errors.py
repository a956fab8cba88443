"""Wrong files of motion capture, NeRF and depth camera programs: messages have file and key."""

from __future__ import annotations

import json
import random
import warnings
from pathlib import Path
from typing import Any

import pytest
from calibration_files import assert_refused, assert_refused_within, changed

from humansim_ros.cameras import Camera, read_calibration, write_calibration
from humansim_ros.errors import CameraError

FORMATS = ("anipose", "4dassociation", "transforms", "qualisys", "realsense", "open3d", "kalibr", "shelf")
TOML = """[cam_0]
name = "A"
size = [640, 480]
matrix = [[700.0, 0.0, 310.0], [0.0, 690.0, 245.0], [0.0, 0.0, 1.0]]
distortions = [-0.2, 0.1, 0.0, 0.0, 0.0]
rotation = [0.0, 0.0, 0.0]
translation = [0.0, 0.0, 2.0]
fisheye = false
[metadata]
unit = "m"
"""
K = [700.0, 0, 310, 0, 690, 245, 0, 0, 1]
RT: dict[str, Any] = {
    "0": {"K": K, "RT": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 2], "imgSize": [640, 480], "distCoeff": [0.0] * 5}
}
NERF: dict[str, Any] = {
    "fl_x": 700,
    "fl_y": 690,
    "cx": 310,
    "cy": 245,
    "w": 640,
    "h": 480,
    "k1": 0.1,
    "frames": [
        {"file_path": "a.png", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]]}
    ],
}
REALSENSE: dict[str, Any] = {
    "width": 640,
    "height": 480,
    "fx": 700,
    "fy": 690,
    "ppx": 310,
    "ppy": 245,
    "model": "distortion.brown_conrady",
    "coeffs": [0.1, 0, 0, 0, 0],
}
OPEN3D: dict[str, Any] = {
    "parameters": [
        {
            "intrinsic": {
                "width": 640,
                "height": 480,
                "intrinsic_matrix": [700, 0, 0, 0, 690, 0, 310, 245, 1],
            },
            "extrinsic": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 2, 1],
        }
    ]
}
QCA = """<?xml version="1.0"?>
<calibration><cameras><camera serial="c1">
<fov_video left="0" top="0" right="639" bottom="479"/>
<transform x="0" y="0" z="2000" r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"/>
<intrinsic focalLengthU="44800" focalLengthV="44160" centerPointU="19840" centerPointV="15680"
 radialDistortion1="0.1" radialDistortion2="0" tangentalDistortion1="0" tangentalDistortion2="0"/>
</camera></cameras></calibration>
"""


def toml(old: str, new: str) -> str:
    assert old in TOML
    return TOML.replace(old, new)


def qca(old: str, new: str) -> str:
    assert old in QCA
    return QCA.replace(old, new)


def test_the_files_are_valid_before_they_are_changed(tmp_path: Path) -> None:
    for text in (TOML, QCA, *map(json.dumps, (RT, NERF, REALSENSE, OPEN3D))):
        (tmp_path / "c").write_text(text)
        (camera,) = read_calibration(tmp_path / "c").values()
        assert camera.size == (640, 480) and camera.K[1, 1] == 690


NAN = float("nan")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        # TOML
        (toml("690.0", "nan"), ":4: cam_0.matrix: a number is not finite"),
        (toml("690.0", "1e300"), ":4: cam_0.matrix: 1e+300 is too large"),
        (toml("690.0", "0.0"), ":4: cam_0.matrix: K is singular"),
        (toml("690.0, 245.0", "690.0"), ":4: cam_0.matrix: needs 3 x 3 numbers, not 8"),
        (toml("690.0", '"wide"'), ":4: cam_0.matrix: 'wide' is not a number"),
        (toml("690.0", "1979-05-27"), ":4: cam_0.matrix: 'date' is not a number"),
        (toml("[640, 480]", "[640]"), ":3: cam_0.size: needs 2 numbers, not 1"),
        (toml("[640, 480]", "[640.5, 480]"), ":3: cam_0.size: needs width and height, whole numbers"),
        (toml("[640, 480]", "[640, 100000]"), ":3: cam_0.size: the image size must be 1 to 8192"),
        (
            toml("rotation = [0.0, 0.0, 0.0]\n", ""),
            ":6: cam_0.translation: needs a rotation (such as R) as well",
        ),
        (
            toml("translation = [0.0, 0.0, 2.0]\n", ""),
            ":6: cam_0.rotation: needs a translation (such as t) as well",
        ),
        (
            toml("rotation = [0.0, 0.0, 0.0]", "rotation = [0.0, 0.0]"),
            ":6: cam_0.rotation: needs 3 or 9 numbers, not 2",
        ),
        (
            toml("rotation = [0.0, 0.0, 0.0]", "rotation = [[1,0,0],[0,2,0],[0,0,1]]"),
            ":6: cam_0.rotation: R is not a",
        ),
        (
            toml("0.0, 0.0]\nrotation", "0.0, 0.0, 1, 1, 1, 1]\nrotation"),
            ":5: cam_0.distortions: rational_polynomial has 8",
        ),
        (toml('unit = "m"', "unit = 5"), ":10: metadata.unit: is '5': use m, cm, mm"),
        (toml('unit = "m"', 'unit = ["m"]'), ":10: metadata.unit: is \"['m']\": use m, cm, mm"),
        (toml('name = "A"', 'name = "A'), ":2: not valid TOML"),
        (toml('name = "A"', 'name = "A"\nname = "B"'), ":3: not valid TOML: Cannot overwrite"),
        ("[a]\nb = 1\n", "is not a known calibration format. Its keys are a. Nothing of a camera was found"),
        ("[a]\nb = " + "[" * 100000, "not valid TOML"),
        ("[a]\n" + "a." * 2000 + "a = 1\n", ":2: this line is too long"),
        ("[a]\nb = " + "9" * 5000 + "\n", "not valid TOML"),
        # 4DAssociation
        (changed(RT, "0.K", K[:8]), "0.K: needs 4 or 9 or 16 numbers, not 8"),
        (changed(RT, "0.K", [0] * 9), "0.K: K is singular"),
        (changed(RT, "0.K", [NAN] * 9), "0.K: a number is not finite"),
        (changed(RT, "0.RT", [1] * 11), "0.RT: needs 12 or 16 numbers, not 11"),
        (changed(RT, "0.RT", [1] * 12), "0.RT: R is not a rotation"),
        (
            changed(RT, "0.RT", [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 2, 0, 0, 1, 1]),
            "0.RT: needs 0 0 0 1 as the last",
        ),
        (changed(RT, "0.RT", [1, 0, 0, 1e300, 0, 1, 0, 0, 0, 0, 1, 2]), "0.RT: 1e+300 is too large"),
        (changed(RT, "0.imgSize", [640]), "0.imgSize: needs 2 numbers, not 1"),
        (changed(RT, "0.R", [1, 0, 0]).replace('"RT"', '"other"'), "0.R: needs a translation"),
        # transforms.json
        (changed(NERF, "fl_x", -700), "fl_x: K is singular or has a focal length that is not positive"),
        (changed(NERF, "fl_x", "long"), "fl_x: 'long' is not a number"),
        (changed(NERF, "h", None), "h: is missing"),
        (changed(NERF, "w", 0), "w: needs a whole number above zero"),
        (changed(NERF, "k3", NAN), "k3: a number is not finite"),
        (changed(NERF, "k4", 0.1), "frames.0.k1: plumb_bob has 4 or 5 coefficients, not 8"),
        (
            changed(NERF, "camera_model", "EQUIRECTANGULAR"),
            "camera_model: unknown camera model 'EQUIRECTANGULAR'",
        ),
        (
            changed(NERF, "frames.0.transform_matrix", [[1] * 4] * 4),
            "frames.0.transform_matrix: needs 0 0 0 1",
        ),
        (
            changed(NERF, "frames.0.transform_matrix", [1] * 15),
            "frames.0.transform_matrix: needs 12 or 16 numbers, not 15",
        ),
        (changed(NERF, "frames", NERF["frames"] * 2), "frames.1: there are two cameras with the name 'a'"),
        (changed(NERF, "frames", [*NERF["frames"], 5]), "frames.1: needs keys and values"),
        (json.dumps({"frames": NERF["frames"]}), "fl_x: is missing: give fl_x, or camera_angle_x"),
        (
            json.dumps({"camera_angle_x": 4, "frames": NERF["frames"]}),
            "camera_angle_x: must be an angle between",
        ),
        # Qualisys
        (
            qca("44800", "nan"),
            "calibration.cameras.0.camera.0.intrinsic.0.focalLengthU: a number is not finite",
        ),
        (qca("44800", "-44800"), "cameras.0.K: K is singular or has a focal length"),
        (qca('focalLengthU="44800"', ""), "intrinsic.0.focalLengthU: is missing"),
        (qca('r22="1"', 'r22="2"'), "cameras.0.r: R is not a rotation"),
        (qca('r22="1"', 'r22="-1"'), "cameras.0.r: R is a reflection"),
        (qca('z="2000"', ""), "cameras.0.r: needs a translation"),
        (qca('right="639"', 'right="-5"'), "fov_video.0: needs whole numbers"),
        (qca('right="639"', 'right="99999"'), "the image size must be 1 to 8192"),
        (QCA[:-30], "not valid XML"),
        (
            "<calibration><cameras><camera/>" + "<a>" * 3000 + "</a>" * 3000 + "</cameras></calibration>",
            "nested too deeply",
        ),
        # RealSense
        (changed(REALSENSE, "fx", 0), "fx: K is singular"),
        (changed(REALSENSE, "fx", NAN), "fx: a number is not finite"),
        (changed(REALSENSE, "width", 0), "width: needs a whole number above zero"),
        (changed(REALSENSE, "model", "none"), "model: is 'none', but there are distortion coefficients"),
        (changed(REALSENSE, "coeffs", [0.1]), "coeffs: plumb_bob has 4 or 5 coefficients, not 1"),
        (changed(REALSENSE, "coeffs", "many"), "coeffs: 'many' is not a number"),
        # Open3D
        (
            changed(OPEN3D, "parameters.0.extrinsic", [1] * 16),
            "parameters.0.extrinsic: needs 0 0 0 1 as the last row",
        ),
        (changed(OPEN3D, "parameters.0.intrinsic.height", None), "parameters.0.height: is missing"),
    ],
)
def test_errors_have_key_and_line(tmp_path: Path, text: str, said: str) -> None:
    assert_refused(tmp_path, text, said)


@pytest.mark.daily("realsense")
@pytest.mark.slow
@pytest.mark.parametrize("form", FORMATS)
def test_damaged_files_are_refused_or_read(tmp_path: Path, form: str) -> None:
    """Random damage of values and text gives a CameraError with the file, or a camera: nothing else."""
    rng = random.Random(form)
    cameras = {name: Camera.look_at((x, 3, 2), (0, 0, 1)) for name, x in (("cam0", 1.0), ("cam1", 2.0))}
    path = tmp_path / f"c.{form}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write_calibration(path, cameras, form)
        text = path.read_text()
        refused = 0
        for _ in range(150):
            damaged = damage(text, rng)
            path.write_text(damaged, encoding="utf-8")
            try:
                read_calibration(path)
            except CameraError as error:
                refused += 1
                assert error.path is not None  # noqa: PT017
    assert refused > 30


def damage(text: str, rng: random.Random) -> str:
    """The text with one value, character or line changed."""
    place = rng.randrange(len(text))
    kind = rng.randrange(5)
    if kind == 0:
        return text[:place] + rng.choice("[]{}<>\"'=:,0e-\0\n") + text[place + 1 :]
    if kind == 1:
        return text[:place] + text[place + rng.randrange(1, 40) :]
    words = [w for w in text.replace(",", " ").split() if any(c.isdigit() for c in w)]
    word = rng.choice(words).strip("[]{}\"'/>")
    if kind == 2:
        return text.replace(
            word, rng.choice(["nan", "1e999", "-0", "null", "true", "[]", "{}", "9" * 400, '""']), 1
        )
    lines = text.splitlines(keepends=True)
    line = rng.randrange(len(lines))
    if kind == 3:
        del lines[line]
    else:
        lines.insert(line, lines[rng.randrange(len(lines))])
    return "".join(lines)


@pytest.mark.daily("nested")
@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        "[a]\n" + "x = 1.5\n" * 100_000,
        "[a]\n" + "".join(f"[a.b{i}]\nmatrix = 1\n" for i in range(8_000)),
        "[a]\n" + ("a." * 120 + "x{} = 1\n") * 900,
        "<calibration><cameras>" + "<camera/>" * 100_000 + "</cameras></calibration>",
        '{"frames": [' + '{"transform_matrix": 1},' * 100_000 + "{}]}",
        '{"a": ' * 900 + "1" + "}" * 900,
        '{"cameras": {' + ",".join(f'"{i}": {{"K": 1, "RT": 2}}' for i in range(50_000)) + "}}",
        '{"cameras": ['
        + '{"fx": 1, "fy": 1, "ppx": 1, "ppy": 1, "width": 0, "height": 0},' * 50_000
        + "{}]}",
    ],
    ids=["keys", "tables", "dots", "elements", "frames", "nested", "mapping", "list"],
)
def test_hostile_files_are_refused_quickly(tmp_path: Path, text: str) -> None:
    assert_refused_within(tmp_path, text, seconds=5)
