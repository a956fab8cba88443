"""JSON and npz with K, R, t and lens in many layouts and spellings, compared with OpenCV."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from wanted_cameras import CAMERAS, FISHEYE, FLIP, SIZE, TOLERANCE, D, Wanted, assert_same, read

from humansim_ros.cameras import read_calibration
from humansim_ros.errors import CameraError, HumansimWarning

pytestmark = pytest.mark.filterwarnings(
    "ignore:.*(the unit is not in the file|taken as from the world|order of the quaternion)"
)


def rt(c: Wanted) -> list[Any]:
    return np.vstack([np.column_stack([c.R, c.t]), [0, 0, 0, 1]]).tolist()  # type: ignore[no-any-return]


def pose(c: Wanted) -> list[Any]:
    return np.linalg.inv(np.array(rt(c))).tolist()  # type: ignore[no-any-return]


def rvec(c: Wanted) -> list[float]:
    return cv2.Rodrigues(c.R)[0].ravel().tolist()  # type: ignore[no-any-return]


def wxyz(c: Wanted) -> list[float]:
    return np.roll(Rotation.from_matrix(c.R).as_quat(), 1).tolist()  # type: ignore[no-any-return]


def flat(c: Wanted) -> dict[str, Any]:
    return {"width": 640, "height": 480, "K": c.K.tolist(), "dist": D, "R": c.R.tolist(), "t": c.t.tolist()}


def of_each(make: Callable[[Wanted], Any]) -> dict[str, Any]:
    return {name: make(c) for name, c in CAMERAS.items()}


def focal(c: Wanted) -> dict[str, Any]:
    return {"fx": c.K[0, 0], "fy": c.K[1, 1], "cx": c.K[0, 2], "cy": c.K[1, 2]}


def sized(c: Wanted, **pose_of: Any) -> dict[str, Any]:
    """Intrinsics, and a pose under other keys."""
    return {"width": 640, "height": 480, "K": c.K.tolist(), "dist": D, **pose_of}


def without_dist(c: Wanted) -> dict[str, Any]:
    return {key: value for key, value in flat(c).items() if key != "dist"}


def xyzw(c: Wanted) -> dict[str, float]:
    return dict(zip("xyzw", Rotation.from_matrix(c.R).as_quat().tolist(), strict=True))


def center(c: Wanted) -> list[float]:
    return (-c.R.T @ c.t).tolist()  # type: ignore[no-any-return]


LAYOUTS: dict[str, Callable[[], Any]] = {
    "mappings of x, y, z, w": lambda: of_each(
        lambda c: sized(c, rotation=xyzw(c), translation=dict(zip("xyz", c.t.tolist(), strict=True)))
    ),
    "order of a quaternion in its key": lambda: of_each(
        lambda c: sized(c, quaternion_xyzw=list(xyzw(c).values()), t=c.t.tolist())
    ),
    "poses of 3D Gaussian Splatting": lambda: [
        {"img_name": name, **sized(c, rotation=c.R.T.tolist(), position=center(c))}
        for name, c in CAMERAS.items()
    ],
    "numbers as texts": lambda: of_each(
        lambda c: {**flat(c), "K": [[str(number) for number in row] for row in c.K.tolist()]}
    ),
    "numbers in the keys": lambda: (
        {
            f"{key}{number}": value
            for number, c in enumerate(CAMERAS.values())
            for key, value in sized(c, R=c.R.tolist(), t=c.t.tolist()).items()
            if key not in ("width", "height")
        }
        | {"names": list(CAMERAS), "image_size": SIZE}
    ),
    "directions in the keys": lambda: of_each(
        lambda c: sized(c, R_cam2world=c.R.T.tolist(), t_cam2world=center(c))
    ),
    "long directions": lambda: of_each(
        lambda c: sized(c, rotation_world_to_camera=c.R.tolist(), translation_world_to_camera=c.t.tolist())
    ),
    "T_w2c": lambda: of_each(lambda c: sized(c, T_w2c=rt(c))),
    "radial and tangential": lambda: of_each(
        lambda c: {**without_dist(c), "radial_distortion": [*D[:2], D[4]], "tangential_distortion": D[2:4]}
    ),
    "mapping of coefficients": lambda: of_each(
        lambda c: {**flat(c), "dist": dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))}
    ),
    "MATLAB": lambda: of_each(
        lambda c: {
            "IntrinsicMatrix": c.K.T.tolist(),
            "ImageSize": [480, 640],
            "RadialDistortion": [*D[:2], D[4]],
            "TangentialDistortion": D[2:4],
            "R": c.R.tolist(),
            "t": c.t.tolist(),
        }
    ),
    "E": lambda: of_each(lambda c: sized(c, E=rt(c))),
    "plurals": lambda: {
        "names": list(CAMERAS),
        "mtxs": [c.K.tolist() for c in CAMERAS.values()],
        "dists": [list(D) for _ in CAMERAS],
        "rvecs": [rvec(c) for c in CAMERAS.values()],
        "tvecs": [c.t.tolist() for c in CAMERAS.values()],
        "image_size": list(SIZE),
    },
    "mapping of cameras": lambda: of_each(flat),
    "list of cameras": lambda: [{"name": name, **flat(c)} for name, c in CAMERAS.items()],
    "cameras below a key": lambda: {"date": "today", "cameras": of_each(flat)},
    "list below a key": lambda: {"cameras": [{"id": name, **flat(c)} for name, c in CAMERAS.items()]},
    "sections of intrinsics and extrinsics": lambda: {
        "intrinsics": of_each(
            lambda c: {"camera_matrix": c.K.tolist(), "dist_coeffs": [list(D)], "image_size": SIZE}
        ),
        "extrinsics": of_each(lambda c: {"rvec": rvec(c), "tvec": c.t.tolist()}),
    },
    "lists of intrinsics and extrinsics": lambda: {
        "names": list(CAMERAS),
        "intrinsics": [{"K": c.K.tolist(), "D": D, "w": 640, "h": 480} for c in CAMERAS.values()],
        "extrinsics": [{"R": c.R.tolist(), "T": c.t[:, None].tolist()} for c in CAMERAS.values()],
    },
    "sections in each camera": lambda: of_each(
        lambda c: {
            "intrinsics": {**focal(c), "distortion": D, "width": 640, "height": 480},
            "extrinsics": {"rotation": c.R.tolist(), "translation": c.t.tolist()},
        }
    ),
    "matrices of extrinsics": lambda: of_each(
        lambda c: (
            {"intrinsic_matrix": c.K.tolist(), "distortions": D, "extrinsics_matrix": rt(c)[:3]}
            | {"image_size": SIZE}
        )
    ),
    "coefficients by name": lambda: of_each(
        lambda c: (
            focal(c)
            | {"k1": D[0], "k2": D[1], "p1": D[2], "p2": D[3], "k3": D[4], "image_width": 640}
            | {"image_height": 480, "world_to_camera": rt(c)}
        )
    ),
    "camera to world": lambda: of_each(
        lambda c: {"mtx": c.K.tolist(), "dist": D, "c2w": pose(c), "resolution": SIZE}
    ),
    "rotation and centre": lambda: of_each(
        lambda c: (
            {"K": c.K.tolist(), "dist": D, "R": c.R.tolist(), "position": c.center.tolist()}
            | {"imgSize": SIZE}
        )
    ),
    "quaternions": lambda: of_each(
        lambda c: (
            {"K": c.K.tolist(), "distCoeffs": D, "quaternion": wxyz(c), "translation": c.t.tolist()}
            | {"img_shape": [480, 640, 3]}
        )
    ),
    "keys with the names of cameras": lambda: (
        {
            f"{key}_{name}": value
            for name, c in CAMERAS.items()
            for key, value in {"mtx": c.K.tolist(), "dist": D, "rvec": rvec(c), "tvec": c.t.tolist()}.items()
        }
        | {"image_size": SIZE}
    ),
    "names before the keys": lambda: (
        {
            f"{name}_{key}": value
            for name, c in CAMERAS.items()
            for key, value in {"K": c.K.tolist(), "dist": D, "R": c.R.tolist(), "t": c.t.tolist()}.items()
        }
        | {"image_size": SIZE}
    ),
    "parameters above the cameras": lambda: {
        "K": of_each(lambda c: c.K.tolist()),
        "dist": of_each(lambda c: D),
        "R": of_each(lambda c: c.R.tolist()),
        "t": of_each(lambda c: c.t.tolist()),
        "size": SIZE,
    },
    "arrays of all cameras": lambda: arrays() | {"names": list(CAMERAS)},
    "flat numbers": lambda: of_each(
        lambda c: (
            {"K": c.K.ravel().tolist(), "D": D, "R": c.R.ravel().tolist(), "t": c.t.tolist()} | {"size": SIZE}
        )
    ),
}


def arrays() -> dict[str, Any]:
    every = list(CAMERAS.values())
    return {
        "K": [c.K.tolist() for c in every],
        "dist": [D for _ in every],
        "R": [c.R.tolist() for c in every],
        "t": [c.t.tolist() for c in every],
        "image_size": SIZE,
    }


@pytest.mark.parametrize("layout", LAYOUTS)
def test_json_of_each_layout_projects_as_opencv_does(tmp_path: Path, layout: str) -> None:
    assert_same(read(tmp_path, "c.json", LAYOUTS[layout]()))


@pytest.mark.parametrize(
    ("names", "shape"),
    [
        (("K", "dist", "R", "t"), (3,)),
        (("camera_matrix", "dist_coeffs", "rotation_matrix", "tvec"), (3, 1)),
        (("intrinsics", "distortion", "rvec", "translation"), (1, 3)),
    ],
)
def test_npz_with_arrays_of_all_cameras_projects_as_opencv_does(
    tmp_path: Path, names: tuple[str, ...], shape: tuple[int, ...]
) -> None:
    every = list(CAMERAS.values())
    rotations = [rvec(c) if names[2] == "rvec" else c.R for c in every]
    values = ([c.K for c in every], [D] * 3, rotations, [c.t.reshape(shape) for c in every])
    content = {name: np.array(value) for name, value in zip(names, values, strict=True)}
    np.savez(tmp_path / "c.npz", **content, size=np.array(SIZE), names=np.array(list(CAMERAS)))  # type: ignore[arg-type]
    assert_same(read_calibration(tmp_path / "c.npz"))


def test_npz_with_keys_of_each_camera_projects_as_opencv_does(tmp_path: Path) -> None:
    content: dict[str, Any] = {"image_size": SIZE}
    for name, c in CAMERAS.items():
        content |= {f"K_{name}": c.K, f"dist_{name}": D, f"RT_{name}": rt(c)[:3]}
    np.savez(tmp_path / "c.npz", **content)
    assert_same(read_calibration(tmp_path / "c.npz"))


def test_one_camera_needs_no_name(tmp_path: Path) -> None:
    wanted = CAMERAS["cam1"]
    np.savez(tmp_path / "left.npz", mtx=wanted.K, dist=[D], rvec=rvec(wanted), tvec=wanted.t, size=SIZE)
    ((name, camera),) = read_calibration(tmp_path / "left.npz").items()
    assert name == "left"
    assert_allclose(camera.project(wanted.points())[0], wanted.pixels(), atol=TOLERANCE)


def colmap(c: Wanted, model: str = "FULL_OPENCV", d: tuple[float, ...] = D) -> dict[str, Any]:
    """Intrinsics as pycolmap writes them: COLMAP's first pixel has its centre at (0.5, 0.5)."""
    middle = [c.K[0, 2] + 0.5, c.K[1, 2] + 0.5]
    focal = [c.K[0, 0]] if model.startswith(("SIMPLE_", "RADIAL")) else [c.K[0, 0], c.K[1, 1]]
    return {"model": model, "width": 640, "height": 480, "params": [*focal, *middle, *d]}


COLMAP_POSES: dict[str, Callable[[Wanted], dict[str, Any]]] = {
    "qvec, tvec": lambda c: {"qvec": wxyz(c), "tvec": c.t.tolist()},
    "R, t": lambda c: {"R": c.R.tolist(), "t": c.t.tolist()},
    "R, tvec": lambda c: {"R": c.R.tolist(), "tvec": c.t.tolist()},
    "cam_from_world": lambda c: {"cam_from_world": rt(c)},
}


@pytest.mark.parametrize("pose_of", COLMAP_POSES)
@pytest.mark.parametrize(
    ("model", "d", "expected"),
    [
        ("PINHOLE", (), (0.0,) * 5),
        ("OPENCV", D[:4], (*D[:4], 0.0)),
        ("FULL_OPENCV", (*D, 0.0, 0.0, 0.0), D),
        ("FULL_OPENCV", (*D, 0.01, -0.02, 0.003), (*D, 0.01, -0.02, 0.003)),
        ("OPENCV_FISHEYE", FISHEYE, FISHEYE),
    ],
)
def test_parameters_of_colmaps_models_project_as_opencv_does(
    tmp_path: Path, model: str, d: tuple[float, ...], expected: tuple[float, ...], pose_of: str
) -> None:
    document = of_each(lambda c: {**colmap(c, model, d), **COLMAP_POSES[pose_of](c)})
    assert_same(read(tmp_path, "cameras.json", document), expected, model.endswith("FISHEYE"))


@pytest.mark.parametrize(
    ("model", "d", "lens"),
    [
        ("SIMPLE_PINHOLE", (), ()),
        ("SIMPLE_RADIAL", (-0.2,), (-0.2, 0, 0, 0, 0)),
        ("RADIAL", (-0.2, 0.05), (-0.2, 0.05, 0, 0, 0)),
        ("SIMPLE_RADIAL_FISHEYE", (-0.02,), (-0.02, 0, 0, 0)),
        ("RADIAL_FISHEYE", (-0.02, 0.01), (-0.02, 0.01, 0, 0)),
    ],
)
def test_models_with_one_focal_length_have_it_for_x_and_y(
    tmp_path: Path, model: str, d: tuple[float, ...], lens: tuple[float, ...]
) -> None:
    wanted = CAMERAS["cam1"]
    (camera,) = read(
        tmp_path, "cameras.json", {**colmap(wanted, model, d), "qvec": wxyz(wanted), "tvec": [0, 0, 1]}
    ).values()
    f = wanted.K[0, 0]
    assert_allclose(camera.K, [[f, 0, 310.4], [0, f, 245.3], [0, 0, 1]])
    assert_allclose(camera.distortion[: len(lens)], lens)
    assert (camera.model == "equidistant") == model.endswith("FISHEYE")


@pytest.mark.parametrize("listed", [False, True])
def test_images_refer_to_their_cameras(tmp_path: Path, listed: bool) -> None:
    """Two images of one camera, and one of another, in another order than the cameras."""
    first, second = CAMERAS["cam0"], CAMERAS["cam2"]
    cameras: Any = {"7": colmap(second, "OPENCV", D[:4]), "3": colmap(first, "OPENCV", D[:4])}
    ids = {"left": "3", "right": "7", "middle": "3"}
    poses = dict(zip(ids, CAMERAS.values(), strict=True))
    images: Any = {
        str(number): {
            "id": number,
            "name": f"{name}.jpg",
            "camera_id": int(ids[name]),
            **COLMAP_POSES["qvec, tvec"](c),
        }
        for number, (name, c) in enumerate(poses.items(), 11)
    }
    if listed:
        cameras = [{"camera_id": int(key), **camera} for key, camera in cameras.items()]
        images = list(images.values())
    document = {"cameras": cameras, "images": images}
    read_cameras = read(tmp_path, "model.json", document)
    assert list(read_cameras) == ["left", "right", "middle"]
    for name, c in poses.items():
        assert read_cameras[name].K[0, 0] == {"3": first, "7": second}[ids[name]].K[0, 0]
        assert_allclose(read_cameras[name].R, c.R, atol=1e-9)
        assert_allclose(read_cameras[name].t, c.t, atol=1e-9)


def test_wrong_parameters_of_a_model_have_their_key(tmp_path: Path) -> None:
    document = {**colmap(CAMERAS["cam0"], "OPENCV", D[:4])}
    said = refused(tmp_path, {**document, "params": document["params"][:-3]})
    assert "params: OPENCV needs fx fy cx cy k1 k2 p1 p2 after width and height, not 5 numbers" in said
    assert "params: unknown camera model 'FOV'" in refused(tmp_path, {**document, "model": "FOV"})
    document = {
        "cameras": {"1": document},
        "images": [{"camera_id": 2, "qvec": [1, 0, 0, 0], "tvec": [0, 0, 0]}],
    }
    assert "images.0.camera_id: there is no camera '2' in cameras" in refused(tmp_path, document)


def test_other_parameters_are_no_camera_of_colmap(tmp_path: Path) -> None:
    assert "is not a known calibration format" in refused(
        tmp_path, {"model": "resnet", "params": [1, 2, 3, 4]}
    )


def test_fisheyes_are_read_with_their_model(tmp_path: Path) -> None:
    def fisheye(c: Wanted) -> dict[str, Any]:
        return {**flat(c), "dist": FISHEYE, "distortion_model": "fisheye"}

    assert_same(read(tmp_path, "c.json", of_each(fisheye)), FISHEYE, fisheye=True)


def test_neus_archives_are_projection_matrices(tmp_path: Path) -> None:
    content = {}
    for index, c in enumerate(CAMERAS.values()):
        p = np.eye(4)
        p[:3] = c.K @ np.array(rt(c))[:3]
        content |= {f"world_mat_{index}": p, f"scale_mat_{index}": np.diag([2.0, 2, 2, 1])}
    np.savez(tmp_path / "cameras_sphere.npz", **content)
    cameras = read_calibration(tmp_path / "cameras_sphere.npz", size=SIZE)
    assert_same(dict(zip(CAMERAS, cameras.values(), strict=True)), (0.0,) * 5)
    assert list(cameras) == ["0", "1", "2"]


# -- two files


def halves(tmp_path: Path, inner: Any, outer: Any) -> tuple[Path, Path]:
    paths = tmp_path / "lenses.json", tmp_path / "poses.json"
    for path, content in zip(paths, (inner, outer), strict=True):
        path.write_text(json.dumps(content))
    return paths


INNER = of_each(lambda c: {"K": c.K.tolist(), "distortion": D, "width": 640, "height": 480})
OUTER = of_each(lambda c: {"R": c.R.tolist(), "T": c.t.tolist()})


@pytest.mark.parametrize("swapped", [False, True])
def test_intrinsics_and_extrinsics_of_two_files_are_joined(tmp_path: Path, swapped: bool) -> None:
    paths = halves(tmp_path, INNER, OUTER)
    inner, outer = reversed(paths) if swapped else paths
    assert_same(read_calibration(inner, extrinsics=outer))


def test_cameras_of_lists_in_two_files_are_joined_in_their_order(tmp_path: Path) -> None:
    inner, outer = halves(tmp_path, INNER, list(OUTER.values()))
    with pytest.warns(HumansimWarning, match="0, 1, 2 of the extrinsics are taken for cam0, cam1, cam2"):
        assert_same(read_calibration(inner, extrinsics=outer))


def test_extrinsics_go_with_intrinsics_of_another_format(tmp_path: Path) -> None:
    rows = "".join(
        f"[cam_{i}]\nname = '{name}'\nsize = [640, 480]\nmatrix = {c.K.tolist()}\ndistortions = {list(D)}\n"
        for i, (name, c) in enumerate(CAMERAS.items())
    )
    (tmp_path / "lenses.toml").write_text(rows)
    (tmp_path / "poses.json").write_text(json.dumps(OUTER))
    assert_same(read_calibration(tmp_path / "lenses.toml", extrinsics=tmp_path / "poses.json"))


def test_the_other_half_is_found_beside_a_file(tmp_path: Path) -> None:
    (tmp_path / "lab_intrinsics.json").write_text(json.dumps(INNER))
    (tmp_path / "lab_extrinsics.json").write_text(json.dumps(OUTER))
    for half, other in (("intrinsics", "extrinsics"), ("extrinsics", "intrinsics")):
        with pytest.warns(HumansimWarning, match=f"read together with lab_{other}"):
            assert_same(read_calibration(tmp_path / f"lab_{half}.json"))


def test_real_halves_project_as_opencv_does(shared_data: Path) -> None:
    inner = shared_data / "calib" / "schmah_intrinsics.json"
    outer = shared_data / "calib" / "schmah_extrinsics.json"
    cameras = read_calibration(inner, extrinsics=outer)
    lenses, poses = json.loads(inner.read_text()), json.loads(outer.read_text())
    assert list(cameras) == list(lenses)
    points = np.random.default_rng(1).uniform(-1, 1, (20, 3))
    for name, camera in cameras.items():
        r, t = np.array(poses[name]["R"]), np.array(poses[name]["T"])
        k, d = np.array(lenses[name]["K"]), np.array(lenses[name]["distortion"])
        pixels = cv2.projectPoints(points, cv2.Rodrigues(r)[0], t, k, d)[0][:, 0]
        assert_allclose(camera.project(points)[0], pixels, atol=1e-4)


# -- conventions that the file does not say


def ring(count: int = 5) -> dict[str, Wanted]:
    """Cameras around the origin, 1.5 m above it, as a capture room has."""
    cameras = {}
    for index in range(count):
        camera = Wanted(index)
        angle = 2 * math.pi * index / count
        center = np.array([3 * math.cos(angle), 3 * math.sin(angle), 1.5])
        z = (np.array([0, 0, 1.0]) - center) / np.linalg.norm(np.array([0, 0, 1.0]) - center)
        x = np.cross(z, [0, 0, 1.0])
        x /= np.linalg.norm(x)
        camera.R = np.stack([x, np.cross(z, x), z])
        camera.t = -camera.R @ center
        cameras[f"c{index}"] = camera
    return cameras


CONVENTIONS: dict[str, tuple[Callable[[Wanted], tuple[Any, Any]], str]] = {
    "world to camera": (lambda c: (c.R, c.t), r"from the world to the camera \(x = R X \+ t\)"),
    "camera to world": (lambda c: (c.R.T, c.center), r"from the camera to the world \(X = R x \+ t\)"),
    "centre": (lambda c: (c.R, c.center), r"a rotation from the world and a camera centre"),
    "matlab": (lambda c: (c.R.T, c.t), "transposed"),
}


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("matrix", [False, True])
def test_the_views_decide_what_r_and_t_are(tmp_path: Path, convention: str, matrix: bool) -> None:
    make, said = CONVENTIONS[convention]
    document = {}
    for name, c in ring().items():
        r, t = make(c)
        own = (
            {"extrinsics": np.column_stack([r, t]).tolist()} if matrix else {"R": r.tolist(), "t": t.tolist()}
        )
        document[name] = {"K": c.K.tolist(), "size": SIZE, **own}
    with pytest.warns(HumansimWarning, match=said):
        cameras = read(tmp_path, "c.json", document)
    for name, c in ring().items():
        assert_allclose(cameras[name].R, c.R, atol=1e-9)
        assert_allclose(cameras[name].center, c.center, atol=1e-9)


@pytest.mark.parametrize("opengl", [False, True])
def test_the_views_decide_the_camera_axes_of_poses(tmp_path: Path, opengl: bool) -> None:
    document = {}
    for name, c in ring().items():
        r = c.R.T @ FLIP if opengl else c.R.T
        document[name] = {"K": c.K.tolist(), "size": SIZE, "pose": np.column_stack([r, c.center]).tolist()}
    with pytest.warns(HumansimWarning, match="OpenGL" if opengl else "from the camera to the world"):
        cameras = read(tmp_path, "c.json", document)
    for name, c in ring().items():
        assert_allclose(cameras[name].R, c.R, atol=1e-9)
        assert_allclose(cameras[name].center, c.center, atol=1e-9)


def test_keys_that_say_the_convention_need_no_views(tmp_path: Path) -> None:
    document = {"K": np.eye(3).tolist(), "size": [2, 2]} | {"w2c": rt(CAMERAS["cam0"])}
    document["K"] = CAMERAS["cam0"].K.tolist()
    document["size"] = SIZE
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*the unit is not in the file")
        (camera,) = read(tmp_path, "c.json", document).values()
    assert_allclose(camera.t, CAMERAS["cam0"].t)


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "m"), (1000.0, "mm")])
def test_the_unit_follows_from_the_distances_of_the_cameras(tmp_path: Path, scale: float, unit: str) -> None:
    document = of_each(lambda c: {**flat(c), "t": (c.t * scale).tolist()})
    with pytest.warns(HumansimWarning, match=f"the unit is not in the file; {unit} is assumed"):
        assert_same(read(tmp_path, "c.json", document))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"hello": [1, 2, 3]}, "Numbers under unknown keys: hello (3)"),
        ({"a": {"K": [[1, 2], [3, 4]]}}, "Numbers under unknown keys: a.K (2 x 2)"),
    ],
)
def test_a_file_that_is_not_understood_says_which_numbers_it_has(
    tmp_path: Path, content: Any, said: str
) -> None:
    with pytest.raises(CameraError, match="missing: K or focal length, image size, rotation") as caught:
        read(tmp_path, "c.json", content)
    assert said in str(caught.value)


def test_euler_angles_are_no_rotation_vector(tmp_path: Path) -> None:
    content = of_each(lambda c: sized(c, rotation_euler=[10, 20, 30], translation=c.t.tolist()))
    with pytest.raises(CameraError, match="needs a rotation"):
        read(tmp_path, "c.json", content)


def test_extrinsics_under_unknown_keys_are_named(tmp_path: Path) -> None:
    content = of_each(lambda c: sized(c, placement=rt(c)))
    with pytest.warns(HumansimWarning, match=r"no extrinsics under known keys \(there are .*placement"):
        read(tmp_path, "c.json", content)


def test_views_of_a_board_are_no_extrinsics(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    views = {"rvecs": rng.normal(size=(9, 3, 1)), "tvecs": rng.normal(size=(9, 3, 1))}
    np.savez(tmp_path / "left.npz", mtx=CAMERAS["cam0"].K, dist=[D], size=SIZE, **views)  # type: ignore[arg-type]
    with pytest.warns(HumansimWarning, match="rvecs and tvecs are poses of a calibration board"):
        ((_, camera),) = read_calibration(tmp_path / "left.npz").items()
    assert_allclose(camera.K, CAMERAS["cam0"].K)
    assert not camera.t.any()


# -- wrong files


def refused(tmp_path: Path, content: Any) -> str:
    path = tmp_path / "c.json"
    path.write_text(json.dumps(content))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(CameraError) as caught:
            read_calibration(path)
    assert str(caught.value).startswith(str(path))
    return str(caught.value)


NAN = float("nan")
ONE = flat(CAMERAS["cam0"])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (
            OUTER,
            "Found rotation and translation of cam0, cam1, cam2; missing: K or focal length, image size; ",
        ),
        (OUTER, "humansim camera show INTRINSICS EXTRINSICS"),
        ({"size": [640, 480]}, "Found image size; missing: K or focal length, rotation, translation"),
        ({"a": {**ONE, "K": [[NAN, 0, 1], [0, 1, 1], [0, 0, 1]]}}, "a.K: a number is not finite"),
        ({"a": {**ONE, "K": [[10**400, 0, 1], [0, 1, 1], [0, 0, 1]]}}, "too large"),
        ({"a": {**ONE, "t": [0, 0, 1e200]}}, "a.t: 1e+200 is too large"),
        ({"a": {**ONE, "R": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}}, "a.R: R is not a rotation"),
        ({"a": {**ONE, "R": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}}, "a.R: R is a reflection"),
        ({"a": {**ONE, "K": [[-9, 0, 1], [0, 9, 1], [0, 0, 1]]}}, "a.K: K is singular or has a focal length"),
        ({"a": {**ONE, "width": 0}}, "a.width: needs a whole number above zero"),
        ({"a": {**ONE, "dist": [0.1] * 12}}, "a.dist: rational_polynomial has 8 coefficients, not 12"),
        (
            {"a": {**ONE, "distortion_model": "ftheta"}},
            "a.distortion_model: unknown distortion model 'ftheta'",
        ),
        ({"a": {k: v for k, v in ONE.items() if k != "t"}}, "a.R: needs a translation (such as t) as well"),
        ({"a": {k: v for k, v in ONE.items() if k != "R"}}, "a.t: needs a rotation (such as R) as well"),
        (
            {"a": {"fx": 700, "R": ONE["R"], "t": ONE["t"]}},
            "a.fx: needs a principal point (cx, cy) or an image size",
        ),
        (
            {"a": {**ONE, "quaternion": [2, 0, 0, 0], "R": "?"}},
            "a.quaternion: is not a quaternion of length 1",
        ),
        (
            {"a": {"K": ONE["K"], "size": SIZE, "w2c": [[1, 2, 3, 4]] * 4}},
            "a.w2c: needs 0 0 0 1 as the last row",
        ),
        ({"unit": "furlong", "a": {**ONE}}, "unit: is 'furlong': use m, cm, mm"),
        ({"a": {"P": [[0, 0, 0, 0]] * 3, "size": SIZE}}, "c.json: a.P: P is singular"),
    ],
)
def test_wrong_values_have_their_key(tmp_path: Path, content: Any, said: str) -> None:
    assert said in refused(tmp_path, content)


@pytest.mark.daily("long key")
@pytest.mark.parametrize(
    "content",
    [
        {"K": [[1] * 1000] * 1000},
        {"intrinsics": [{"K": ONE["K"]}] * 12_000},
        {"a": [[[[[[[[[[[[[[1]]]]]]]]]]]]]]},
        {f"K_{i}": 1 for i in range(20_000)},
        {"_".join("abcdefghij" * 10): [1] * 9},
    ],
    ids=["numbers", "cameras", "nesting", "keys", "long key"],
)
def test_hostile_documents_are_refused(tmp_path: Path, content: Any) -> None:
    refused(tmp_path, content)


def test_hostile_archives_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.npz"
    for content, said in (
        ({"K": np.array([object()])}, "pickled object"),
        ({"K": np.zeros((1000, 1000))}, "too large for a calibration"),
        ({"zeros": np.zeros(3 << 20)}, "unpacks to more than 16 MB"),
        ({"K": np.full((3, 3), np.nan)}, "K: a number is not finite"),
        ({"K": np.zeros((3, 3), complex)}, "an array of complex128"),
        ({"a": np.zeros(3)}, "missing: K or focal length, image size, rotation, translation"),
    ):
        np.savez_compressed(path, **content)  # type: ignore[arg-type]
        with pytest.raises(CameraError, match=said):
            read_calibration(path, size=SIZE)
    path.write_bytes(b"PK\x03\x04 and more")
    with pytest.raises(CameraError, match="damaged"):
        read_calibration(path)


def test_the_second_file_must_have_extrinsics_of_the_same_cameras(tmp_path: Path) -> None:
    inner, outer = halves(tmp_path, INNER, {"x": OUTER["cam0"], "y": OUTER["cam1"]})
    with pytest.warns(HumansimWarning, match="left out, because there are no intrinsics of them: x, y"):
        read_calibration(inner, extrinsics=outer)
    outer.write_text(json.dumps(INNER))
    with pytest.raises(CameraError, match=r"poses\.json: has no extrinsics"):
        read_calibration(inner, extrinsics=outer)
    with pytest.raises(CameraError, match="no such"):
        read_calibration(inner, extrinsics=tmp_path / "missing.json")


def test_xml_of_any_program_is_read_by_its_keys(tmp_path: Path) -> None:
    text = "<rig><left><K>700 0 310 0 690 245 0 0 1</K><width>640</width><height>480</height></left></rig>"
    (tmp_path / "rig.xml").write_text(text)
    (camera,) = read_calibration(tmp_path / "rig.xml").values()
    assert camera.size == (640, 480)
    assert camera.K.tolist() == [[700, 0, 310], [0, 690, 245], [0, 0, 1]]
