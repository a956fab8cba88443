"""Lenses, units and poses of calibrations that were once read wrong without a word, judged by OpenCV."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from wanted_cameras import CAMERAS, FISHEYE, SIZE, TOLERANCE, D, Wanted, assert_same, read

from humansim_ros.cameras import Camera, read_calibration
from humansim_ros.errors import CameraError, HumansimWarning

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*(the unit is not in the file|taken as|order of the quaternion|no extrinsics|image size is not)"
)
W, H = SIZE
#: K of a wide lens, as fisheyes have it.
WIDE = np.array([[221.5, 0, 318.4], [0, 222.25, 241.3], [0, 0, 1]])


def flat(k: Any, *names: str) -> dict[str, float]:
    """fx, fy, cx and cy of K under other names."""
    return dict(zip(names or ("fx", "fy", "cx", "cy"), (k[0][0], k[1][1], k[0][2], k[1][2]), strict=True))


def said_by(path: Path) -> tuple[dict[str, Camera], str]:
    """Cameras of a file, and its warnings."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cameras = read_calibration(path, size=SIZE)
    return cameras, " ".join(str(warning.message) for warning in caught)


def only(tmp_path: Path, name: str, content: Any) -> Camera:
    (camera,) = read(tmp_path, name, content).values()
    return camera


def storage(path: Path, **values: Any) -> Path:
    """File that OpenCV writes."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        file.write(key, value)
    file.release()
    return path


def archive(path: Path, **values: Any) -> Path:
    np.savez(path, **values)
    return path


def document(path: Path, **values: Any) -> Path:
    path.write_text(json.dumps(values, default=lambda value: np.asarray(value).tolist()))
    return path


# -- cv2.fisheye

COLUMN, ROW = np.reshape(FISHEYE, (4, 1)), np.reshape(FISHEYE, (1, 4))
SKEWED = np.array([[221.5, -0.17, 318.4], *WIDE[1:]])
#: Files of a fisheye: whether the model is only likely, and a function that writes the file.
FISHEYES: dict[str, tuple[bool, Callable[[Path], Path]]] = {
    "json, DIM": (False, lambda p: document(p / "c.json", DIM=SIZE, K=WIDE, D=COLUMN)),
    "json, DIM, flat": (False, lambda p: document(p / "c.json", DIM=SIZE, K=WIDE, D=FISHEYE)),
    "json, 4 x 1": (False, lambda p: document(p / "c.json", K=WIDE, D=COLUMN)),
    "json, 1 x 4": (True, lambda p: document(p / "c.json", K=WIDE, D=ROW)),
    "json, flat": (True, lambda p: document(p / "c.json", K=WIDE, D=FISHEYE)),
    "json, skew": (False, lambda p: document(p / "c.json", K=SKEWED, D=FISHEYE)),
    "json, name": (False, lambda p: document(p / "fisheye_left.json", K=WIDE, D=FISHEYE)),
    "json, key": (False, lambda p: document(p / "c.json", fisheye_left={"K": WIDE, "D": FISHEYE})),
    "npz, 4 x 1": (False, lambda p: archive(p / "c.npz", K=WIDE, D=COLUMN)),
    "npz, 1 x 4": (True, lambda p: archive(p / "c.npz", K=WIDE, D=ROW)),
    "npz, DIM": (False, lambda p: archive(p / "c.npz", DIM=SIZE, K=WIDE, D=ROW)),
    "xml, 4 x 1": (False, lambda p: storage(p / "c.xml", K=WIDE, D=COLUMN)),
    "xml, skew": (False, lambda p: storage(p / "c.xml", camera_matrix=SKEWED, distortion_coefficients=ROW)),
    "yaml, 4 x 1": (False, lambda p: storage(p / "c.yml", camera_matrix=WIDE, dist_coeffs=COLUMN)),
    "yaml, 1 x 4": (True, lambda p: storage(p / "c.yml", camera_matrix=WIDE, dist_coeffs=ROW)),
    "yaml, name": (False, lambda p: storage(p / "fisheye.yml", camera_matrix=WIDE, dist_coeffs=ROW)),
    "json of OpenCV": (False, lambda p: storage(p / "c.json", K=WIDE, D=COLUMN)),
    "k1 to k4": (
        False,
        lambda p: document(
            p / "c.json", **flat(WIDE), **dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))
        ),
    ),
    "k1 to k4 of RealSense": (
        False,
        lambda p: document(
            p / "c.json",
            **flat(WIDE, "fx", "fy", "ppx", "ppy"),
            width=W,
            height=H,
            **dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True)),
        ),
    ),
}


@pytest.mark.parametrize("case", FISHEYES)
def test_four_coefficients_of_a_fisheye_are_equidistant(tmp_path: Path, case: str) -> None:
    likely, write = FISHEYES[case]
    cameras, said = said_by(write(tmp_path))
    (camera,) = cameras.values()
    assert camera.model == "equidistant"
    assert_allclose(camera.distortion, FISHEYE)
    ray = np.array([[[1.0, 0.3, 1.0]]])
    alpha = camera.K[0, 1] / camera.K[0, 0]
    lens = np.array(FISHEYE)
    pixel = cv2.fisheye.projectPoints(ray, np.zeros(3), np.zeros(3), camera.K, lens, alpha=alpha)[0]
    assert_allclose(camera.project(ray[0])[0], pixel[0], atol=TOLERANCE)
    assert ("assumed to be equidistant; if they are plumb_bob, add distortion_model" in said) == likely


def test_alpha_of_a_fisheye_is_its_skew(tmp_path: Path) -> None:
    camera = only(tmp_path, "c.json", {**flat(WIDE), "alpha": -8e-4, "size": SIZE, "D": COLUMN.tolist()})
    assert_allclose(camera.K[0, 1], -8e-4 * WIDE[0, 0])
    assert camera.model == "equidistant"


@pytest.mark.parametrize("shape", [(4,), (1, 4), (4, 1)])
def test_four_coefficients_with_small_tangential_ones_are_plumb_bob(
    tmp_path: Path, shape: tuple[int, ...]
) -> None:
    lens = np.reshape(D[:4], shape)
    cameras, said = said_by(document(tmp_path / "c.json", K=WIDE, D=lens))
    assert cameras["c"].model == "plumb_bob" and cameras["c"].distortion[:4] == D[:4]
    assert ("assumed to be plumb_bob" in said) == (shape == (4, 1))


def test_an_archive_of_a_stereo_fisheye_has_both_cameras(tmp_path: Path) -> None:
    r = Rotation.from_rotvec([0.01, -0.03, 0.002]).as_matrix()
    t = np.array([[-0.12], [0.001], [0.002]])
    path = archive(tmp_path / "s.npz", K1=WIDE, D1=COLUMN, K2=WIDE, D2=COLUMN, R=r, T=t, DIM=SIZE)
    first, second = read_calibration(path).values()
    assert_allclose(first.R, np.eye(3))
    assert_allclose(second.R, r)
    assert_allclose(second.t, t[:, 0])
    assert {first.model, second.model} == {"equidistant"}


# -- lenses under other keys


def yaml(value: Any) -> str:
    """YAML of OpenCV; matrices are mappings of rows, cols, dt and data."""
    rows = (f"{key}: {json.dumps(item)}" for key, item in value.items())
    return "%YAML:1.0\n---\n" + "\n".join(rows) + "\n"


def matrix(value: Any) -> dict[str, Any]:
    rows, cols = np.shape(value)
    return {"rows": rows, "cols": cols, "dt": "d", "data": np.ravel(value).tolist()}


def c2w(c: Wanted) -> list[Any]:
    """Pose from the camera to the world, 4 x 4."""
    pose = np.vstack([np.column_stack([c.R.T, c.center]), [0, 0, 0, 1]])
    return pose.tolist()  # type: ignore[no-any-return]


FIRST = CAMERAS["cam0"]
K4 = dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))
D4 = dict(zip(("k1", "k2", "p1", "p2"), D[:4], strict=True))
RATIONAL = (*D, 0.01, -0.02, 0.003)
R8 = dict(zip(("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), RATIONAL, strict=True))
BROWN = (*D[:4], 0.0)
SIDES = {"width": W, "height": H}


def vins(kind: str, projection: dict[str, Any], **parts: Any) -> str:
    head = {"model_type": kind, "camera_name": "front", "image_width": W, "image_height": H}
    rest = {"F_threshold": 1.0, "max_cnt": 150, "min_dist": 30}
    return yaml({**head, **rest, **parts, "projection_parameters": projection})


def ncamera(kind: str, numbers: Any) -> str:
    lens = {"type": kind, "parameters": matrix([numbers])}
    inner = {"type": "pinhole", "intrinsics": matrix([[*flat(FIRST.K).values()]]), "distortion": lens}
    camera = {"label": "front", "id": "1a", "image_height": H, "image_width": W, **inner}
    return yaml({"label": "rig", "cameras": [{"camera": camera, "T_B_C": matrix(c2w(FIRST))}]})


def basalt(kind: str, **lens: float) -> dict[str, Any]:
    numbers = *FIRST.center, *Rotation.from_matrix(FIRST.R.T).as_quat()
    pose = dict(zip(("px", "py", "pz", "qx", "qy", "qz", "qw"), numbers, strict=True))
    camera = {"camera_type": kind, "intrinsics": {**flat(FIRST.K), **lens}}
    rest = {"vignette": [{"value0": 0, "value1": 50000000000, "value2": [[0.9]]}], "cam_time_offset_ns": 0}
    return {"value0": {"T_imu_cam": [pose], "intrinsics": [camera], "resolution": [SIZE], **rest}}


def svo(kind: str, **lens: float) -> str:
    return yaml({"cam_model": kind, **{f"cam_{k}": v for k, v in {**flat(FIRST.K), **SIDES, **lens}.items()}})


def pjlab(numbers: Any) -> dict[str, Any]:
    def of(value: Any) -> dict[str, Any]:
        data = np.asarray(value).tolist()
        return {"rows": len(value), "cols": 4, "type": 6, "continuous": True, "data": data}

    param = {"img_dist_w": W, "img_dist_h": H, "cam_K": of(FIRST.K), "cam_dist": of([numbers])}
    return {"front-intrinsic": {"sensor_name": "front", "param_type": "intrinsic", "param": param}}


def orbslam(kind: str, name: str, **lens: float) -> str:
    keys = {f"{name}.{key}": value for key, value in {**flat(FIRST.K), **lens}.items()}
    return yaml({"Camera.type": kind, "Camera.width": W, "Camera.height": H, **keys})


KB = {**dict(zip(("k2", "k3", "k4", "k5"), FISHEYE, strict=True)), **flat(FIRST.K, "mu", "mv", "u0", "v0")}
PPX = {**flat(FIRST.K, "fx", "fy", "ppx", "ppy"), **SIDES, **D4, "model": "Brown Conrady"}
#: Content of a file of one camera, coefficients and model; texts are YAML, others JSON.
LENSES: dict[str, tuple[Any, tuple[float, ...], str]] = {
    "VINS": (vins("PINHOLE", flat(FIRST.K), distortion_parameters=D4), BROWN, "plumb_bob"),
    "VINS, full": (
        vins("PINHOLE_FULL", flat(FIRST.K), distortion_parameters=R8),
        RATIONAL,
        "rational_polynomial",
    ),
    "VINS, fisheye": (vins("KANNALA_BRANDT", KB), FISHEYE, "equidistant"),
    "SVO": (svo("Pinhole", d0=D[0], d1=D[1], d2=D[2], d3=D[3]), BROWN, "plumb_bob"),
    "NCamera": (ncamera("radial-tangential", D[:4]), BROWN, "plumb_bob"),
    "NCamera, fisheye": (ncamera("equidistant", FISHEYE), FISHEYE, "equidistant"),
    "Basalt": (basalt("pinhole-radtan8", **R8, rpmax=2.0), RATIONAL, "rational_polynomial"),
    "Basalt, fisheye": (basalt("kb4", **K4), FISHEYE, "equidistant"),
    "PJLab": (pjlab(D), D, "plumb_bob"),
    "RealSense": ({**flat(FIRST.K), **SIDES, **D4, "k3": D[4]}, D, "plumb_bob"),
    "RealSense, ppx": (PPX, BROWN, "plumb_bob"),
    "ORB-SLAM3": (orbslam("PinHole", "Camera1", **D4), BROWN, "plumb_bob"),
    "ORB-SLAM3, fisheye": (orbslam("KannalaBrandt8", "Camera", **K4), FISHEYE, "equidistant"),
}


@pytest.mark.parametrize("case", LENSES)
def test_lenses_under_the_keys_of_programs_are_read(tmp_path: Path, case: str) -> None:
    content, lens, model = LENSES[case]
    camera = only(tmp_path, "c.yaml" if isinstance(content, str) else "c.json", content)
    assert camera.size == SIZE
    assert camera.model == model
    assert_allclose(camera.K, FIRST.K)
    assert_allclose(camera.distortion, lens)
    if case.startswith(("NCamera", "Basalt")):
        assert_allclose(camera.R, FIRST.R, atol=1e-9)
        assert_allclose(camera.center, FIRST.center, atol=1e-9)


#: Content of a file with a lens that cameras do not have, and its name.
REFUSED: dict[str, tuple[Any, str]] = {
    "VINS, MEI": (
        vins("MEI", flat(FIRST.K, "gamma1", "gamma2", "u0", "v0"), mirror_parameters={"xi": 2}),
        "mei",
    ),
    "SVO, ATAN": (svo("ATAN", d0=0.93), "atan"),
    "NCamera, FOV": (ncamera("fisheye", [0.92]), "fov"),
    "Basalt, ds": (basalt("ds", xi=-0.2, alpha=0.56), "ds"),
    "Basalt, eucm": (basalt("eucm", alpha=0.6, beta=1.1), "eucm"),
    "Basalt, fov": (basalt("fov", w=0.9), "fov"),
    "OpenSfM, dual": ({"a": {"projection_type": "dual", **SIDES}}, "dual"),
    "OpenSfM, sphere": ({"a": {"projection_type": "spherical", **SIDES}}, "spherical"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_lens_that_cameras_do_not_have_is_refused_by_its_name(tmp_path: Path, case: str) -> None:
    content, lens = REFUSED[case]
    with pytest.raises(CameraError, match=f"'{lens}'.*known are"):
        read(tmp_path, "c.yaml" if isinstance(content, str) else "c.json", content)


@pytest.mark.parametrize(
    ("extra", "key"),
    [
        ({"undist_coefs": [-0.3, 0.1, 0, 0]}, "undist_coefs"),
        ({"distortion_poly": [-0.3, 0.1]}, "distortion_poly"),
        ({"xi": -0.2, "alpha": 0.56}, "xi"),
        ({"kappa1": -0.3}, "kappa1"),
        ({"cam_d0": -0.3}, "cam_d0"),
        ({"omega": 0.92}, "omega"),
        ({"camera_type": "eucm"}, "camera_type 'eucm'"),
        ({"distortion": [0, 0, 0, 0, 0], "distance": [1.0, 2.0], "camera_type": "pinhole"}, None),
        ({"lens_dist": [-0.3, 0.1, 0, 0]}, "lens_dist"),
        ({"dist_coeff": [-0.3, 0.1, 0, 0]}, None),
    ],
)
def test_a_lens_key_that_is_not_read_is_named(tmp_path: Path, extra: Any, key: str | None) -> None:
    cameras, said = said_by(document(tmp_path / "c.json", left={"K": FIRST.K, "size": SIZE, **extra}))
    assert ("looks like a lens and is not read" in said) == (key is not None)
    assert key is None or key in said
    assert any(camera.distorted for camera in cameras.values()) == ("dist_coeff" in extra)


# -- units


def posed(c: Wanted, key: str, scale: float) -> dict[str, Any]:
    rvec = cv2.Rodrigues(c.R)[0].ravel().tolist()
    return {"K": c.K.tolist(), "size": SIZE, "dist": D, "rvec": rvec, key: (c.t * scale).tolist()}


@pytest.mark.parametrize(
    ("key", "scale"), [("translation_mm", 1000), ("T_cm", 100), ("tvec_m", 1), ("t (mm)", 1000)]
)
def test_the_unit_may_be_in_the_key(tmp_path: Path, key: str, scale: float) -> None:
    cameras = {name: posed(c, key, scale) for name, c in CAMERAS.items()}
    assert_same(read(tmp_path, "c.json", cameras))
    assert_same(read(tmp_path, "d.json", {"cameras": [{"name": n, **c} for n, c in cameras.items()]}))


@pytest.mark.parametrize(
    "stated", [{"translation_unit": "cm"}, {"metadata": {"units": "centimeters"}}, {"unit": "cm"}]
)
def test_centimetres_are_a_unit(tmp_path: Path, stated: Any) -> None:
    cameras = {name: posed(c, "tvec", 100) for name, c in CAMERAS.items()}
    assert_same(read(tmp_path, "c.json", {**stated, "cameras": cameras}))


def test_two_units_in_the_keys_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="has several units: t_cm, t_mm; give one"):
        read(tmp_path, "c.json", {"a": posed(FIRST, "t_mm", 1), "b": posed(FIRST, "t_cm", 1)})


# -- poses of other programs

CENTRED = np.array([[700, 0, 319.5], [0, 700, 239.5], [0, 0, 1]])


def opensfm(kind: str, **lens: float) -> list[dict[str, Any]]:
    """Shots with one camera of 640 x 480 pixels."""
    focal = {"focal": 700 / W}
    if kind not in ("perspective", "fisheye"):
        focal = {"focal_x": 700 / W, "focal_y": 690 / W, "c_x": -9.1 / W, "c_y": 5.8 / W}
    shots = {
        name: {
            "rotation": cv2.Rodrigues(c.R)[0].ravel().tolist(),
            "translation": c.t.tolist(),
            "camera": "v2 x",
        }
        for name, c in zip(("a.jpg", "b.JPG", "c"), CAMERAS.values(), strict=True)
    }
    camera = {"projection_type": kind, **SIDES, **focal, **lens}
    return [{"cameras": {"v2 x": camera}, "shots": shots, "points": {}}]


@pytest.mark.parametrize(
    ("kind", "lens", "d"),
    [
        ("perspective", {"k1": -0.2, "k2": 0.05}, (-0.2, 0.05, 0, 0, 0)),
        ("brown", {**D4, "k3": D[4]}, D),
        ("simple_radial", {"k1": -0.2}, (-0.2, 0, 0, 0, 0)),
        ("fisheye", {"k1": 0.02, "k2": -0.01}, (0.02, -0.01, 0, 0)),
        ("fisheye_opencv", K4, FISHEYE),
    ],
)
def test_shots_of_opensfm_project_as_opencv_does(
    tmp_path: Path, kind: str, lens: dict[str, float], d: tuple[float, ...]
) -> None:
    cameras = read(tmp_path, "reconstruction.json", opensfm(kind, **lens))
    assert list(cameras) == ["a", "b", "c"]
    for camera, c in zip(cameras.values(), CAMERAS.values(), strict=True):
        seen = Wanted(0)
        seen.R, seen.t = c.R, c.t
        seen.K = CENTRED if kind in ("perspective", "fisheye") else CAMERAS["cam0"].K
        assert camera.size == SIZE
        pixels = seen.pixels(d, kind.startswith("fisheye"))
        assert_allclose(camera.project(seen.points())[0], pixels, atol=TOLERANCE)


def test_cameras_of_opensfm_alone_have_no_poses(tmp_path: Path) -> None:
    camera = only(tmp_path, "camera_models.json", opensfm("brown", **D4)[0]["cameras"])
    assert_allclose(camera.K, FIRST.K)
    assert camera.distortion[:4] == D[:4]


@pytest.mark.parametrize("key", ["Q", "rotation"])
def test_cameras_of_pymvg_project_as_opencv_does(tmp_path: Path, key: str) -> None:
    """The pose of the second camera is that of the camera that R rectifies."""
    turns = [np.eye(3), Rotation.from_rotvec([0.1, -0.2, 0.05]).as_matrix(), np.eye(3)]
    system = [
        {
            "name": name,
            **SIDES,
            "K": c.K.tolist(),
            "D": D,
            "R": turn.tolist(),
            "P": np.column_stack([c.K, np.zeros(3)]).tolist(),
            key: (turn @ c.R).tolist(),
            "translation": (turn @ c.t).tolist(),
        }
        for (name, c), turn in zip(CAMERAS.items(), turns, strict=True)
    ]
    assert_same(read(tmp_path, "c.json", {"__pymvg_file_version__": "1.0", "camera_system": system}))


def matlab(c: Wanted, new: bool = False) -> dict[str, Any]:
    """What toStruct of cameraParameters gives: the first pixel is (1, 1)."""
    k = c.K + np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]])
    lens = {"RadialDistortion": [D[0], D[1], D[4]], "TangentialDistortion": D[2:4], "ImageSize": [H, W]}
    rest = {"WorldUnits": "millimeters", "EstimateSkew": False, "NumRadialDistortionCoefficients": 3}
    views = {"RotationVectors": [[0.1, 0.2, 0.3]] * 4, "TranslationVectors": [[1.0, 2.0, 3.0]] * 4}
    return {**lens, **rest, **views, **({"K": k.tolist()} if new else {"IntrinsicMatrix": k.T.tolist()})}


@pytest.mark.parametrize("new", [False, True])
def test_parameters_of_matlab_have_the_pixels_of_opencv(tmp_path: Path, new: bool) -> None:
    camera = only(tmp_path, "c.json", matlab(FIRST, new))
    assert camera.size == SIZE
    assert_allclose(camera.K, FIRST.K)
    assert_allclose(camera.distortion, D)


def test_intrinsics_of_matlab_may_be_focal_lengths(tmp_path: Path) -> None:
    own = {"FocalLength": [FIRST.K[0, 0], FIRST.K[1, 1]], "PrincipalPoint": [311.4, 246.3], "Skew": 0.5}
    lens = {"RadialDistortion": [D[0], D[1]], "TangentialDistortion": D[2:4], "ImageSize": [H, W]}
    camera = only(tmp_path, "c.json", {**own, **lens})
    assert_allclose(camera.K, FIRST.K + np.array([[0, 0.5, 0], [0, 0, 0], [0, 0, 0]]))
    assert_allclose(camera.distortion, BROWN)


@pytest.mark.parametrize("pose", ["A", "R", "rows"])
def test_a_stereo_pair_of_matlab_has_the_pose_of_its_second_camera(tmp_path: Path, pose: str) -> None:
    second = CAMERAS["cam1"]
    t = (second.t * 1000).tolist()
    a = np.vstack([np.column_stack([second.R, t]), [0, 0, 0, 1]]).tolist()
    poses: dict[str, dict[str, Any]] = {
        "A": {"PoseCamera2": {"Dimensionality": 3, "Translation": t, "R": second.R.tolist(), "A": a}},
        "R": {"PoseCamera2": {"Dimensionality": 3, "Translation": t, "R": second.R.tolist()}},
        "rows": {"RotationOfCamera2": second.R.T.tolist(), "TranslationOfCamera2": t},
    }
    pair = {"CameraParameters1": matlab(FIRST), "CameraParameters2": matlab(second), **poses[pose]}
    left, right = read(tmp_path, "c.json", pair).values()
    assert_allclose(left.R, np.eye(3))
    assert_allclose(left.t, np.zeros(3))
    assert_allclose(right.project(second.points())[0], second.pixels(), atol=TOLERANCE)


OWN = {"k1": -0.17, "k2": 0.03, "p1": 0.001, "p2": 0.0005, "k3": 0.01}


def zed(own: dict[str, float], disto: dict[str, float]) -> str:
    """SN….conf with a lens of each mode, and one for all modes."""
    sections = {
        **{f"{side}_CAM_HD": {**flat(FIRST.K), **own} for side in ("LEFT", "RIGHT")},
        **{f"{side}_DISTO": disto for side in ("LEFT", "RIGHT")},
        "STEREO": {"Baseline": 120, "RX_HD": 0, "CV_HD": 0, "RZ_HD": 0},
    }
    return "\n".join(
        f"[{name}]\n" + "\n".join(f"{key}={value}" for key, value in section.items())
        for name, section in sections.items()
    )


@pytest.mark.parametrize(
    ("own", "disto", "model", "d"),
    [
        (OWN, R8, "rational_polynomial", RATIONAL),
        ({}, R8, "rational_polynomial", RATIONAL),
        ({}, {**K4, "k5": 0, "k6": 0, "p1": 0, "p2": 0}, "equidistant", FISHEYE),
        (OWN, {**R8, "s1": 0.0, "s2": 0.0}, "rational_polynomial", RATIONAL),
        (OWN, {**R8, "s1": 0.01}, "plumb_bob", (-0.17, 0.03, 0.001, 0.0005, 0.01)),
    ],
)
def test_the_newer_lens_of_a_zed_is_read(
    tmp_path: Path, own: dict[str, float], disto: dict[str, float], model: str, d: tuple[float, ...]
) -> None:
    (tmp_path / "SN1.conf").write_text(zed(own, disto))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cameras = read_calibration(tmp_path / "SN1.conf")
    for camera in cameras.values():
        assert camera.model == model
        assert_allclose(camera.distortion, d)
    assert any("thin prism" in str(warning.message) for warning in caught) == (disto.get("s1", 0) != 0)


def test_a_thin_prism_of_a_zed_is_refused_without_another_lens(tmp_path: Path) -> None:
    (tmp_path / "SN1.conf").write_text(zed({}, {**R8, "s2": 0.01}))
    with pytest.raises(CameraError, match=r"LEFT_DISTO\.s2: thin prism models are not supported"):
        read_calibration(tmp_path / "SN1.conf")


@pytest.mark.parametrize("key", ["Stereo.T_c1_c2", "Tlr", "Stereo.b"])
def test_the_second_camera_of_orbslam3_has_its_pose(tmp_path: Path, key: str) -> None:
    second, name = CAMERAS["cam1"], "Camera" if key == "Tlr" else "Camera1"
    rectified = key == "Stereo.b"
    pose: Any = 0.12 if rectified else matrix(c2w(second)[: 3 if key == "Tlr" else 4])
    text = orbslam("Rectified" if rectified else "KannalaBrandt8", name, **({} if rectified else K4))
    if not rectified:
        text += "".join(f"Camera2.{key}: {value}\n" for key, value in {**flat(second.K), **K4}.items())
    text += f"Camera.fps: 20\nThDepth: 40.0\nCamera.bf: 19.3\n{key}: {json.dumps(pose)}\n"
    cameras = read(tmp_path, "c.yaml", text)
    left, right = cameras.values()
    assert list(cameras) == [name, "Camera2"]
    assert_allclose(left.center, np.zeros(3))
    assert_allclose(right.center, [0.12, 0, 0] if rectified else second.center, atol=1e-9)
    assert_allclose(right.R, np.eye(3) if rectified else second.R, atol=1e-9)
    assert_allclose(right.K, FIRST.K if rectified else second.K)
    assert (right.model == "equidistant") == (not rectified)


# -- numbers that are no K


def test_words_that_begin_like_a_focal_length_are_none(tmp_path: Path) -> None:
    own = {"K": FIRST.K.tolist(), "size": SIZE, "dist": D}
    assert list(read(tmp_path, "c.json", {"F_threshold": 1.0, "f_blur": 3, "left": own})) == ["left"]
    with pytest.raises(CameraError, match="is not a known calibration format"):
        read(tmp_path, "d.json", {"F_threshold": 1.0, "max_cnt": 150, "size": SIZE})


@pytest.mark.parametrize("fx", [0.87, 4.2])
def test_a_focal_length_that_is_not_in_pixels_is_told(tmp_path: Path, fx: float) -> None:
    with pytest.warns(HumansimWarning, match=rf"the focal length is {fx} pixels .* K in pixels\?"):
        read(tmp_path, "c.json", {"fx": fx, "fy": fx, "cx": 320, "cy": 240, **SIDES})
