"""Calibration files of motion capture, NeRF and depth camera programs, compared with formulas and OpenCV.

The files are written here from random cameras, each by the convention of its program; real files follow.
"""

from __future__ import annotations

import json
import re
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose
from wanted_cameras import CAMERAS, FISHEYE, FLIP, SIZE, TOLERANCE, D, Wanted, assert_same, read

from humansim_ros.cameras import Camera, read_calibration, write_calibration
from humansim_ros.cameras.formats.calibration import load_calibration
from humansim_ros.cameras.formats.syntax import tomllib
from humansim_ros.errors import CameraError, HumansimWarning
from humansim_ros.types import Array

# -- TOML of Anipose, FreeMoCap, Caliscope and Pose2Sim


def anipose(unit: float = 1.0, d: tuple[float, ...] = D, fisheye: str = "fisheye = false") -> str:
    tables = []
    for name, c in CAMERAS.items():
        tables.append(
            f'[cam_{len(tables)}]\nname = "{name}"\nsize = [ 640.0, 480,]\nmatrix = {c.K.tolist()}\n'
            f"distortions = [\n  {', '.join(map(str, d))},\n]\n"
            f"rotation = {cv2.Rodrigues(c.R)[0].ravel().tolist()}\n"
            f"translation = {(c.t / unit).tolist()}\n{fisheye}\n"
        )
    return "\n".join(tables) + "\n[metadata]\nadjusted = false\nerror = 0.5\n"


@pytest.mark.parametrize(("unit", "name", "other"), [(1.0, "m", "mm"), (0.001, "mm", "m")])
def test_the_unit_of_anipose_is_found_by_the_camera_distances_and_said(
    tmp_path: Path, unit: float, name: str, other: str
) -> None:
    with pytest.warns(
        HumansimWarning, match=rf"the unit is not in the file; {name} is assumed.*m with {other}\)"
    ):
        cameras = read(tmp_path, "c.toml", anipose(unit))
    assert_same(cameras)


def test_the_unit_of_anipose_can_be_stated(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    assert_same(read(tmp_path, "c.toml", anipose(0.01), unit=0.01))
    assert_same(read(tmp_path, "c.toml", anipose(0.01) + 'unit = "cm"\n'))  # in [metadata]
    assert_same(read(tmp_path, "c.toml", 'unit = "cm"\n' + anipose(0.01)))
    assert not recwarn
    with pytest.raises(CameraError, match=r"c.toml:1: unit: is 'feet': use m, cm, mm"):
        read(tmp_path, "c.toml", 'unit = "feet"\n' + anipose())


@pytest.mark.filterwarnings("ignore:.*the unit is not in the file")
def test_fisheye_cameras_of_anipose_are_equidistant(tmp_path: Path) -> None:
    assert_same(read(tmp_path, "c.toml", anipose(1, FISHEYE, "fisheye = true")), FISHEYE, True)


@pytest.mark.filterwarnings("ignore:.*the unit is not in the file")
@pytest.mark.parametrize(
    ("change", "d"),
    [
        (lambda text: text, D),
        (lambda text: text.replace("fisheye = false\n", ""), D),
        (
            lambda text: re.sub(r"name = .*\n", "", text).replace("cam_", "cam"),
            D,
        ),  # Caliscope: the table is the name
        (lambda text: text.replace("[cam_", "[cameras.cam_").replace("\n", "\r\n"), D),
        (lambda text: "# made by hand\n\n" + text, (*D, 0.0, 0.0, 0.0)),
        (lambda text: text, D[:4]),
    ],
)
def test_dialects_of_anipose(tmp_path: Path, change: Callable[[str], str], d: tuple[float, ...]) -> None:
    assert_same(read(tmp_path, "c.toml", change(anipose(d=d))), d)


@pytest.mark.filterwarnings("ignore:.*the unit is not in the file")
def test_rotations_of_anipose_may_be_matrices(tmp_path: Path) -> None:
    text = anipose()
    for c in CAMERAS.values():
        text = text.replace(str(cv2.Rodrigues(c.R)[0].ravel().tolist()), str(c.R.tolist()))
    assert_same(read(tmp_path, "c.toml", text))


def test_a_folder_with_a_toml_file_is_a_rig(tmp_path: Path) -> None:
    (tmp_path / "calibration.toml").write_text(anipose() + 'unit = "m"\n')
    assert_same(read_calibration(tmp_path))


# -- 4DAssociation


def association(key: str = "RT") -> dict[str, Any]:
    pose: Callable[[Wanted], dict[str, Any]] = {
        "RT": lambda c: {"RT": np.column_stack([c.R, c.t]).ravel().tolist()},
        "4x4": lambda c: {"RT": [*np.column_stack([c.R, c.t]).tolist(), [0, 0, 0, 1]]},
        "R, T": lambda c: {"R": c.R.ravel().tolist(), "T": c.t.tolist()},
        "rvec, T": lambda c: {"R": cv2.Rodrigues(c.R)[0].ravel().tolist(), "T": c.t.tolist()},
    }[key]
    return {
        name: {"K": c.K.ravel().tolist(), **pose(c), "imgSize": list(SIZE), "distCoeff": [list(D)]}
        for name, c in CAMERAS.items()
    }


@pytest.mark.parametrize("key", ["RT", "4x4", "R, T", "rvec, T"])
def test_k_and_rt_are_x_r_x_plus_t_in_metres(tmp_path: Path, key: str) -> None:
    assert_same(read(tmp_path, "c.json", association(key)))


def shelf() -> dict[str, Any]:
    """Cameras of VoxelPose: T is the centre in millimetres."""
    return {
        name: {
            "R": c.R.tolist(),
            "T": (c.center * 1000)[:, None].tolist(),
            "fx": c.K[0, 0],
            "fy": c.K[1, 1],
            "cx": c.K[0, 2],
            "cy": c.K[1, 2],
            "k": [[D[0]], [D[1]], [D[4]]],
            "p": [[D[2]], [D[3]]],
        }
        for name, c in CAMERAS.items()
    }


WRAPPINGS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "mapping": lambda cameras: cameras,
    "list with names": lambda cameras: [{"name": name, **camera} for name, camera in cameras.items()],
    "list with ids": lambda cameras: [{**camera, "id": name} for name, camera in cameras.items()],
    "below cameras": lambda cameras: {"cameras": cameras},
    "list below cameras": lambda cameras: {
        "version": 1,
        "cameras": [{"name": name, **camera} for name, camera in cameras.items()],
    },
    "two keys deep": lambda cameras: {"format": "x", "rig": {"date": "today", "sensors": cameras}},
}


@pytest.mark.filterwarnings("ignore:.*image size is not in the file")
@pytest.mark.parametrize("cameras", [shelf, association])
@pytest.mark.parametrize("wrapping", WRAPPINGS)
def test_lists_and_wrapping_keys_change_nothing(
    tmp_path: Path, wrapping: str, cameras: Callable[[], dict[str, Any]]
) -> None:
    assert_same(read(tmp_path, "c.json", WRAPPINGS[wrapping](cameras()), size=SIZE))


@pytest.mark.parametrize("cameras", [shelf, association])
def test_lists_may_be_indented(tmp_path: Path, cameras: Callable[[], dict[str, Any]]) -> None:
    text = json.dumps(WRAPPINGS["list with names"](cameras()), indent=2)
    assert_same(read(tmp_path, "c.json", text, size=SIZE))


def test_cameras_of_a_list_without_names_have_numbers(tmp_path: Path) -> None:
    assert list(read(tmp_path, "c.json", list(shelf().values()), size=SIZE)) == ["0", "1", "2"]


def test_focal_lengths_and_centres_of_voxelpose_may_be_arrays(tmp_path: Path) -> None:
    document = shelf()
    for camera in document.values():
        camera["f"] = [[camera.pop("fx")], [camera.pop("fy")]]
        camera["c"] = [[camera.pop("cx")], [camera.pop("cy")]]
    assert_same(read(tmp_path, "c.json", document, size=SIZE))


def ring() -> dict[str, Wanted]:
    """Four cameras around a person, in VoxelPose's keys below."""
    cameras = {}
    for number in range(4):
        camera = Wanted(number)
        angle = np.pi / 2 * number + 0.3
        placed = Camera.look_at((4 * np.cos(angle), 3 * np.sin(angle), 1.5 + 0.2 * number), (0, 0, 1))
        camera.R, camera.t = placed.R, placed.t
        cameras[str(number)] = camera
    return cameras


#: R and T in metres of each convention, and the warning about them.
SHELF_POSES: dict[str, tuple[Callable[[Wanted], tuple[Any, Any]], str]] = {
    "VoxelPose": (lambda c: (c.R, c.center), ""),
    "world to camera": (lambda c: (c.R, c.t), r"R and T: taken as from the world to the camera"),
    "camera to world": (lambda c: (c.R.T, c.center), r"R and T: taken as from the camera to the world"),
}


def own_arrays(c: Wanted, convention: str, unit: float) -> dict[str, Any]:
    r, t = SHELF_POSES[convention][0](c)
    return {
        "f": [c.K[0, 0], c.K[1, 1]],
        "c": c.K[:2, 2].tolist(),
        "k": [D[0], D[1], D[4]],
        "p": D[2:4],
        "R": r.tolist(),
        "T": (t / unit).tolist(),
        "imgSize": list(SIZE),
    }


@pytest.mark.parametrize("convention", SHELF_POSES)
@pytest.mark.parametrize("stated", [None, "m", "millimeters", "cm"])
def test_views_and_keys_decide_what_r_and_t_of_voxelpose_are(
    tmp_path: Path, convention: str, stated: str | None
) -> None:
    unit = {None: 0.001, "m": 1.0, "millimeters": 0.001, "cm": 0.01}[stated]
    document: dict[str, Any] = {name: own_arrays(c, convention, unit) for name, c in ring().items()}
    if stated is not None:
        document["unit"] = stated
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cameras = read(tmp_path, "c.json", document)
    said = [str(warning.message) for warning in caught]
    expected = SHELF_POSES[convention][1]
    assert not said if not expected else re.search(expected, said[0]) and len(said) == 1
    for name, c in ring().items():
        assert_allclose(cameras[name].R, c.R, atol=1e-9)
        assert_allclose(cameras[name].center, c.center, atol=1e-9)


def test_a_stated_convention_of_voxelposes_keys_needs_no_views(tmp_path: Path) -> None:
    camera = CAMERAS["cam0"]
    for stated, convention in (("world_to_camera", "world to camera"), ("c2w", "camera to world")):
        document = {"convention": stated, "cam0": own_arrays(camera, convention, 0.001)}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            (found,) = read(tmp_path, "c.json", document).values()
        assert_allclose(found.R, camera.R, atol=1e-9)
        assert_allclose(found.t, camera.t, atol=1e-9)


# -- Kalibr with the inverse extrinsics of the IMU


def test_t_imu_cam_is_the_inverse_of_t_cam_imu(tmp_path: Path) -> None:
    def text(key: str) -> str:
        chain = {}
        for index, c in enumerate(CAMERAS.values()):
            pose = np.vstack([np.column_stack([c.R, c.t]), [0, 0, 0, 1]])
            chain[f"cam{index}"] = {
                key: (np.linalg.inv(pose) if key == "T_imu_cam" else pose).tolist(),
                "camera_model": "pinhole",
                "distortion_coeffs": list(D[:4]),
                "distortion_model": "radtan",
                "intrinsics": [float(c.K[0, 0]), float(c.K[1, 1]), *c.K[:2, 2].tolist()],
                "resolution": list(SIZE),
            }
        return "%YAML:1.0\n\n" + yaml.safe_dump(chain)

    for key in ("T_cam_imu", "T_imu_cam"):
        assert_same(read(tmp_path, "c.yaml", text(key)), D[:4])


# -- transforms.json


def transforms(per_frame: bool = False, fisheye: bool = False) -> dict[str, Any]:
    """Poses of cameras with the axes of OpenGL; pixels are measured from the image corner."""
    frames = []
    for name, c in CAMERAS.items():
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = c.R.T @ FLIP, c.center
        own = {"fl_x": c.K[0, 0], "fl_y": c.K[1, 1], "cx": c.K[0, 2] + 0.5, "cy": c.K[1, 2] + 0.5}
        frames.append({"file_path": f"./images/{name}.png", "transform_matrix": pose.tolist(), **own})
    size = {"w": SIZE[0], "h": SIZE[1]}
    lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))
    if fisheye:
        lens = {"is_fisheye": True, **dict(zip(("k1", "k2", "k3", "k4"), FISHEYE, strict=True))}
    if per_frame:
        return {"frames": [{**frame, **lens, **size} for frame in frames]}
    return {"camera_angle_x": 0.5, "aabb_scale": 16, **lens, **size, "frames": frames}


def test_transform_matrices_may_have_three_rows(tmp_path: Path) -> None:
    document = transforms()
    for frame in document["frames"]:
        del frame["transform_matrix"][3]
    assert_same(read(tmp_path, "transforms.json", document))


@pytest.mark.parametrize("per_frame", [False, True])
def test_transforms_have_the_axes_of_opengl_and_pixels_from_the_corner(
    tmp_path: Path, per_frame: bool
) -> None:
    assert_same(read(tmp_path, "transforms.json", transforms(per_frame)))
    assert_same(read(tmp_path, "transforms.json", transforms(per_frame, fisheye=True)), FISHEYE, True)


def test_focal_lengths_of_nerf_follow_from_the_angle_and_the_width(tmp_path: Path) -> None:
    pose = np.eye(4)  # at the origin, looks along -z
    document = {
        "camera_angle_x": 0.8,
        "frames": [{"file_path": "./train/r_0", "transform_matrix": pose.tolist()}],
    }
    with pytest.warns(HumansimWarning, match="w and h are missing; 800x800 is assumed"):
        (camera,) = read(tmp_path, "transforms_train.json", document).values()
    for given, (width, height) in ((camera, (800, 800)), (None, (400, 300))):
        if given is None:
            given = read(tmp_path, "transforms_train.json", document, size=(width, height))["train/r_0"]
        # the left and right edges of the image are at half the angle
        edges, _ = given.project([[np.tan(0.4), 0, -1], [-np.tan(0.4), 0, -1], [0, 0, -1]])
        assert_allclose(
            edges,
            [[width - 0.5, height / 2 - 0.5], [-0.5, height / 2 - 0.5], [width / 2 - 0.5, height / 2 - 0.5]],
            atol=1e-9,
        )
    cv2.imwrite(str(tmp_path / "r_0.png"), np.zeros((100, 200), np.uint8))
    document["frames"][0]["file_path"] = "r_0"  # type: ignore[index]
    assert read(tmp_path, "transforms_train.json", document)["r_0"].size == (200, 100)


# -- Qualisys


def qualisys() -> str:
    """As Pose2Sim converts them: R_cam = Rx(180°) r, x = R (X - center); 1/64 pixel, millimetres."""
    cameras = []
    for name, c in CAMERAS.items():
        r, (x, y, z), k = FLIP @ c.R, c.center * 1000, c.K * 64
        rotation = " ".join(
            f'r{i + 1}{j + 1}="{r[i, j]!r}"'.replace("np.float64(", "").replace(")", "")
            for i in range(3)
            for j in range(3)
        )
        cameras.append(
            f'<camera active="1" serial="{name}" model="Miqus Video">'
            f'<fov_video left="8" top="4" right="{8 + SIZE[0] - 1}" bottom="{4 + SIZE[1] - 1}"/>'
            f'<transform x="{float(x)!r}" y="{float(y)!r}" z="{float(z)!r}" {rotation}/>'
            f'<intrinsic focalLengthU="{k[0, 0]}" focalLengthV="{k[1, 1]}" centerPointU="{k[0, 2] + 8 * 64}"'
            f' centerPointV="{k[1, 2] + 4 * 64}" skew="0" radialDistortion1="{D[0]}"'
            f' radialDistortion2="{D[1]}" radialDistortion3="{D[4]}" tangentalDistortion1="{D[2]}"'
            f' tangentalDistortion2="{D[3]}"/></camera>'
        )
    header = "<?xml version='1.0' encoding='ASCII'?>"
    return f"{header}\n<calibration><cameras>{''.join(cameras)}</cameras></calibration>"


def test_qualisys_is_as_pose2sim_converts_it(tmp_path: Path) -> None:
    assert_same(read(tmp_path, "c.qca.txt", qualisys()))


# -- depth cameras


def test_realsense_intrinsics_are_those_of_opencv(tmp_path: Path) -> None:
    def dump(c: Wanted, model: Any, coefficients: tuple[float, ...]) -> dict[str, Any]:
        k = {"fx": c.K[0, 0], "fy": c.K[1, 1], "ppx": c.K[0, 2], "ppy": c.K[1, 2]}
        return {"width": 640, "height": 480, **k, "model": model, "coeffs": [*coefficients, 0.0][:5]}

    wanted = Wanted(1)
    optical = wanted.points() @ wanted.R.T + wanted.t
    for name in ("distortion.brown_conrady", "Brown Conrady", "RS2_DISTORTION_BROWN_CONRADY", 4):
        cameras = read(tmp_path, "c.json", dump(wanted, name, D))
        assert_allclose(cameras["c"].project(optical)[0], wanted.pixels(), atol=TOLERANCE)
    cameras = read(
        tmp_path, "c.json", {"color": dump(wanted, "distortion.kannala_brandt4", FISHEYE), "device": "D455"}
    )
    assert_allclose(cameras["color"].project(optical)[0], wanted.pixels(FISHEYE, True), atol=TOLERANCE)
    # without coefficients, the model does not matter
    (camera,) = read(
        tmp_path, "c.json", dump(wanted, "distortion.inverse_brown_conrady", (0.0,) * 5)
    ).values()
    assert not camera.distorted
    with pytest.warns(HumansimWarning, match="inverse brown conrady is taken for plumb_bob"):
        read(tmp_path, "c.json", dump(wanted, "distortion.inverse_brown_conrady", D))
    with pytest.raises(CameraError, match=r"model: 'distortion.ftheta' is not a supported lens model"):
        read(tmp_path, "c.json", dump(wanted, "distortion.ftheta", D))


def test_streams_of_several_devices_have_the_names_of_both(tmp_path: Path) -> None:
    def dump(fx: float) -> dict[str, Any]:
        return {"width": 640, "height": 480, "fx": fx, "fy": 690, "ppx": 310, "ppy": 245}

    devices = {"7": {"color": dump(700), "depth": dump(701)}, "9": {"color": dump(702), "depth": dump(703)}}
    with pytest.warns(HumansimWarning, match="no extrinsics"):
        cameras = read(tmp_path, "c.json", {"date": "today", "devices": devices})
    found = {name: camera.K[0, 0] for name, camera in cameras.items()}
    assert found == {"7_color": 700, "7_depth": 701, "9_color": 702, "9_depth": 703}


def test_matrices_of_open3d_are_in_column_order(tmp_path: Path) -> None:
    def parameters(c: Wanted) -> dict[str, Any]:
        pose = np.vstack([np.column_stack([c.R, c.t]), [0, 0, 0, 1]])
        intrinsic = {"width": 640, "height": 480, "intrinsic_matrix": c.K.T.ravel().tolist()}
        return {
            "class_name": "PinholeCameraParameters",
            "extrinsic": pose.T.ravel().tolist(),
            "intrinsic": intrinsic,
        }

    document = {
        "class_name": "PinholeCameraTrajectory",
        "parameters": [parameters(c) for c in CAMERAS.values()],
    }
    cameras = read(tmp_path, "c.json", document)
    assert_same(dict(zip(CAMERAS, cameras.values(), strict=True)), (0.0,) * 5)
    (camera,) = read(tmp_path, "one.json", parameters(CAMERAS["cam1"])).values()
    assert_allclose(
        camera.project(CAMERAS["cam1"].points())[0], CAMERAS["cam1"].pixels((0.0,) * 5), atol=TOLERANCE
    )
    (camera,) = read(tmp_path, "two.json", parameters(CAMERAS["cam1"])["intrinsic"]).values()
    assert_allclose(camera.K, CAMERAS["cam1"].K)


# -- cameras without extrinsics


def easymocap(tmp_path: Path, posed: tuple[str, ...]) -> Path:
    for half in ("intri", "extri"):
        storage = cv2.FileStorage(str(tmp_path / f"{half}.yml"), cv2.FILE_STORAGE_WRITE)
        for name, c in CAMERAS.items():
            if half == "intri":
                storage.write(f"K_{name}", c.K)
                storage.write(f"dist_{name}", np.array([D]))
            elif name in posed:
                storage.write(f"R_{name}", cv2.Rodrigues(c.R)[0])
                storage.write(f"T_{name}", c.t[:, None])
        storage.release()
    return tmp_path / "intri.yml"


def test_cameras_that_extri_does_not_have_are_left_out(tmp_path: Path) -> None:
    path = easymocap(tmp_path, ("cam0", "cam2"))
    with pytest.warns(HumansimWarning, match=r"left out, because the file has no extrinsics of them: cam1"):
        cameras = read_calibration(path, size=SIZE)
    assert list(cameras) == ["cam0", "cam2"]
    assert_allclose(cameras["cam2"].center, CAMERAS["cam2"].center, atol=1e-9)


def test_a_calibration_without_any_extrinsics_says_so(tmp_path: Path) -> None:
    path = easymocap(tmp_path, ())
    (tmp_path / "extri.yml").unlink()
    with pytest.warns(HumansimWarning, match="the file has no extrinsics: all cameras are at the origin"):
        calibration = load_calibration(path, size=SIZE)
    assert list(calibration.cameras) == list(CAMERAS) and not calibration.posed


@pytest.mark.filterwarnings("ignore:.*the unit is not in the file")
@pytest.mark.parametrize("kind", ["anipose", "4dassociation", "shelf", "panoptic"])
def test_cameras_without_extrinsics_are_left_out_of_every_format(tmp_path: Path, kind: str) -> None:
    content: Any
    if kind == "anipose":
        content = re.sub(r"(?s)(\[cam_1\].*?)rotation = .*?\ntranslation = .*?\n", r"\1", anipose())
    elif kind == "panoptic":
        content = {
            "cameras": [
                {
                    "name": name,
                    "resolution": SIZE,
                    "K": c.K.tolist(),
                    "distCoef": D,
                    "R": c.R.tolist(),
                    "t": c.t.tolist(),
                }
                for name, c in CAMERAS.items()
            ]
        }
        del content["cameras"][1]["R"], content["cameras"][1]["t"]
    else:
        content = association() if kind == "4dassociation" else shelf()
        for key in ("RT", "R", "T"):
            content["cam1"].pop(key, None)
    with pytest.warns(HumansimWarning, match=r"left out, because the file has no extrinsics of them: cam1"):
        assert list(read(tmp_path, "c", content, size=SIZE)) == ["cam0", "cam2"]


# -- real files


def assert_projects(camera: Camera, k: Any, r: Array, t: Any, d: Any, unit: float = 1.0) -> None:
    """Compare with OpenCV. t in the unit of the file."""
    k, t = np.reshape(k, (3, 3)), np.ravel(t) * unit
    width, height = camera.size
    pixels = np.random.default_rng(0).uniform([0, 0], [width, height], (60, 2))
    optical = (
        np.column_stack([(pixels - k[:2, 2]) / k[[0, 1], [0, 1]], np.ones(60)])
        * np.linspace(1, 4, 60)[:, None]
    )
    points = (optical - t) @ r
    theirs = cv2.projectPoints(points, cv2.Rodrigues(r)[0], t, k, np.array(d, dtype=float))[0][:, 0]
    assert_allclose(camera.project(points)[0], theirs, atol=TOLERANCE)


@pytest.mark.filterwarnings("ignore:.*the unit is not in the file")
@pytest.mark.parametrize(("file", "unit"), [("anipose_uwupose.toml", 0.001), ("pose2sim_calib.toml", 1.0)])
def test_real_toml_files_project_as_opencv_does(shared_data: Path, file: str, unit: float) -> None:
    path = shared_data / "calib" / file
    tables = [t for t in tomllib.loads(path.read_text()).values() if "matrix" in t]
    cameras = read_calibration(path)
    assert len(tables) == len(cameras)
    for table in tables:
        r = cv2.Rodrigues(np.array(table["rotation"], dtype=float))[0]
        camera = cameras[table["name"]]
        assert_projects(camera, table["matrix"], r, table["translation"], table["distortions"], unit)


def test_shelf_of_4dassociation_is_the_shelf_of_voxelpose(shared_data: Path) -> None:
    path = shared_data / "calib" / "shelf_4dassociation.json"
    cameras = read_calibration(path)
    others = read_calibration(shared_data / "calib" / "shelf_voxelpose.json", size=(1032, 776))
    for name, c in json.loads(path.read_text()).items():
        rt = np.reshape(c["RT"], (3, 4))
        u, _, v = np.linalg.svd(rt[:, :3])  # rounded in the file
        assert_projects(cameras[name], c["K"], u @ v, rt[:, 3], [0.0] * 4)
        assert_allclose(cameras[name].center * [1, 1, 1], others[name].center, atol=0.01)


def test_extrinsics_of_openvins_are_inverted(shared_data: Path) -> None:
    path = shared_data / "calib" / "openvins_euroc_radtan_kalibr.yaml"
    data = yaml.safe_load(path.read_text().replace("%YAML:1.0", ""))
    for name, camera in read_calibration(path).items():
        pose = np.linalg.inv(np.array(data[name]["T_imu_cam"]))
        fx, fy, cx, cy = data[name]["intrinsics"]
        k = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        assert_projects(camera, k, pose[:3, :3], pose[:3, 3], data[name]["distortion_coeffs"])


def test_the_real_file_of_qualisys_has_k_and_poses_of_pose2sim(shared_data: Path) -> None:
    path = shared_data / "calib" / "qualisys_pose2sim.qca.txt"
    cameras = read_calibration(path)
    for element in ElementTree.parse(path).getroot().iter("camera"):
        inner, outer = element.find("intrinsic").attrib, element.find("transform").attrib  # type: ignore[union-attr]
        # Pose2Sim: columns to rows, the inverse, then half a turn about x
        rows = np.array([[float(outer[f"r{i}{j}"]) for j in (1, 2, 3)] for i in (1, 2, 3)])
        r, t = rows.T.T, -rows.T.T @ [float(outer[axis]) / 1000 for axis in "xyz"]
        r, t = FLIP @ r, FLIP @ t
        k = np.diag([float(inner["focalLengthU"]) / 64, float(inner["focalLengthV"]) / 64, 1])
        k[:2, 2] = float(inner["centerPointU"]) / 64, float(inner["centerPointV"]) / 64
        keys = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
        assert_projects(cameras[element.attrib["serial"]], k, r, t, [float(inner[key]) for key in keys])
    centers = np.array([camera.center for camera in cameras.values()])
    assert (centers[:, 2] > 1.5).all() and (centers[:, 2] < 2.5).all()  # on stands, z up
    assert all(camera.R[1, 2] < -0.5 for camera in cameras.values())  # upright


@pytest.mark.parametrize("form", ["4dassociation", "shelf", "human36m", "transforms", "blender", "realsense"])
def test_cameras_may_have_names_that_are_words_of_groups(tmp_path: Path, form: str) -> None:
    cameras = {name: Camera.look_at((x, 3, 2), (0, 0, 1)) for name, x in (("color", 1.0), ("camera", 2.0))}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write_calibration(tmp_path / "c.json", cameras, form)
        assert list(read_calibration(tmp_path / "c.json", size=(640, 480))) == ["color", "camera"]
