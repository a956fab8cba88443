"""Calibrations of motion capture and photogrammetry programs, by the formula of each program.

The files are written here from random cameras; no formula is of the package.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation
from wanted_cameras import CAMERAS, FISHEYE, FLIP, SIZE, D, Wanted, assert_same, read

from humansim_ros.cameras import read_calibration
from humansim_ros.errors import CameraError, HumansimWarning
from humansim_ros.types import Array

pytestmark = pytest.mark.filterwarnings("ignore:.*image size is not in the file")
W, H = SIZE


def joined(values: Any) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def attributes(**values: Any) -> str:
    return " ".join(f'{key}="{value}"' for key, value in values.items())


def radial(c: Wanted, d: tuple[float, ...]) -> Array:
    """Points (N, 2) of the normalised image plane, bent by k1, k2 and k3."""
    optical = c.points() @ c.R.T + c.t
    x = optical[:, :2] / optical[:, 2:]
    r2 = (x**2).sum(axis=1, keepdims=True)
    return np.asarray(x * (1 + d[0] * r2 + d[1] * r2**2 + d[2] * r2**3))


# -- Metashape


def metashape(rotation: Array, scale: float, shift: Array, component: bool) -> str:
    """Document whose chunk has a transform; P1 and P2 change places."""
    sensors, cameras = "", ""
    for i, (name, c) in enumerate(CAMERAS.items()):
        f, b1 = c.K[1, 1], c.K[0, 0] - c.K[1, 1]
        cx, cy = c.K[0, 2] + 0.5 - W / 2, c.K[1, 2] + 0.5 - H / 2
        values = {
            "f": f,
            "cx": cx,
            "cy": cy,
            "b1": b1,
            "k1": D[0],
            "k2": D[1],
            "k3": D[4],
            "p1": D[3],
            "p2": D[2],
        }
        lens = "".join(f"<{key}>{float(value)!r}</{key}>" for key, value in values.items())
        resolution = f'<resolution width="{W}" height="{H}"/>'
        old = f'<calibration type="frame" class="initial">{resolution}<f>9</f></calibration>'
        sensors += (
            f'<sensor id="{i}" type="frame">{resolution}{old}<calibration type="frame" class="adjusted">'
        )
        sensors += f"{resolution}{lens}</calibration></sensor>"
        pose = np.eye(4)  # in the chunk: world = scale * rotation * chunk + shift
        pose[:3, :3] = rotation.T @ c.R.T
        pose[:3, 3] = rotation.T @ (c.center - shift) / scale
        part = ' component_id="0"' if component else ""
        cameras += f'<camera id="{i}" sensor_id="{i}"{part} label="{name}.JPG">'
        cameras += f"<transform>{joined(pose)}</transform></camera>"
    move = f"<transform><rotation>{joined(rotation)}</rotation><translation>{joined(shift)}</translation>"
    move += f"<scale>{scale!r}</scale></transform>"
    inside = f'<components><component id="0">{move}</component></components>' if component else ""
    text = f'<document version="1.5.0"><chunk label="a"><sensors>{sensors}</sensors>{inside}'
    return text + f"<cameras>{cameras}</cameras>{'' if component else move}</chunk></document>"


@pytest.mark.parametrize("component", [False, True])
def test_metashape_documents_project_in_their_world(tmp_path: Path, component: bool) -> None:
    rotation = Rotation.from_euler("xyz", [0.3, -0.2, 1.0]).as_matrix()
    text = metashape(rotation, 2.5, np.array([1.0, 2.0, -0.5]), component)
    assert_same(read(tmp_path, "cameras.xml", text))


def test_metashape_calibrations_have_a_lens_and_no_pose(tmp_path: Path) -> None:
    lens = "<f>700</f><cx>1.5</cx><cy>-2</cy><k1>-0.1</k1><p1>0.002</p1><p2>0.001</p2>"
    size = f"<width>{W}</width><height>{H}</height>"
    text = f"<calibration><projection>frame</projection>{size}{lens}</calibration>"
    (camera,) = read(tmp_path, "left.xml", text).values()
    assert_allclose(camera.K, [[700, 0, 321], [0, 700, 237.5], [0, 0, 1]])
    assert camera.distortion == (-0.1, 0, 0.001, 0.002, 0)


def metashape_calibration(kind: str, **values: float) -> str:
    numbers = "".join(f"<{name}>{value!r}</{name}>" for name, value in {"f": 700.0, **values}.items())
    size = f"<width>{W}</width><height>{H}</height>"
    return f"<calibration><projection>{kind}</projection>{size}{numbers}</calibration>"


@pytest.mark.nightly
def test_a_lens_of_metashape_that_no_model_has_is_fitted_over_the_image(tmp_path: Path) -> None:
    k1, k2, k3, k4, p1, p2, p3, p4 = -0.21, 0.09, -0.02, 0.004, 1.5e-3, -8e-4, 0.3, -0.1
    text = metashape_calibration("frame", k1=k1, k2=k2, k3=k3, k4=k4, p1=p1, p2=p2, p3=p3, p4=p4, b2=1.0)
    with pytest.warns(HumansimWarning, match=r"lens with k4, p3 or p4 is written as \w+, which differs by"):
        (camera,) = read(tmp_path, "left.xml", text).values()
    x, y = np.random.default_rng(2).uniform([-0.4, -0.3], [0.4, 0.3], (200, 2)).T
    r2 = x**2 + y**2
    radial, more = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4, 1 + p3 * r2 + p4 * r2**2
    u = x * radial + (p1 * (r2 + 2 * x**2) + 2 * p2 * x * y) * more
    v = y * radial + (p2 * (r2 + 2 * y**2) + 2 * p1 * x * y) * more
    expected = np.stack([W / 2 + 700 * u + v - 0.5, H / 2 + 700 * v - 0.5], axis=1)
    found = camera.project(np.stack([x, y, np.ones_like(x)], axis=1))[0]
    assert np.abs(found - expected).max() < 0.02


def test_coefficients_of_a_lens_of_metashape_that_cannot_be_kept_are_told(tmp_path: Path) -> None:
    with pytest.warns(HumansimWarning, match="p1 and p2 of the fisheye are left out: no lens model has them"):
        read(tmp_path, "left.xml", metashape_calibration("fisheye", k1=0.01, p1=1e-3, p2=1e-3))
    with pytest.raises(CameraError, match=r"left\.xml.*calibration: a lens with these coefficients folds"):
        read(tmp_path, "left.xml", metashape_calibration("frame", k1=-90.0, k4=-900.0))


def test_real_reference_poses_of_metashape_look_along_the_way(shared_data: Path) -> None:
    with pytest.warns(HumansimWarning, match="their reference poses"):
        cameras = read_calibration(shared_data / "calib" / "hwiyoung_metashape_cameras.xml")
    left, right = cameras["018864_L"], cameras["018864_R"]
    # a stereo pair beside each other, upright, at the positions of the file
    across = (right.center - left.center) / np.linalg.norm(right.center - left.center)
    assert left.R[0] @ across > 0.99 and left.R[1, 2] < -0.99
    assert_allclose(left.center, [365.98370342, 354.49946406, 7.93546007])


# -- OpenMVG, Meshroom, Bundler, MVSNet


def square(c: Wanted) -> Wanted:
    """The same camera with square pixels."""
    other = Wanted(0)
    other.K, other.R, other.t = c.K.copy(), c.R, c.t
    other.K[1, 1] = c.K[0, 0]
    return other


@pytest.mark.parametrize("nested", [False, True])
def test_openmvg_projects_by_rotation_and_center(tmp_path: Path, nested: bool) -> None:
    views, lenses, poses = [], [], []
    d = (-0.2, 0.08, 0.03)
    for i, (name, c) in enumerate((n, square(c)) for n, c in CAMERAS.items()):
        ids = {"id_view": i, "id_intrinsic": i, "id_pose": i}
        view = {"filename": f"{name}.jpg", "width": W, "height": H, **ids}
        base = {"width": W, "height": H, "focal_length": c.K[0, 0], "principal_point": c.K[:2, 2].tolist()}
        data = {"value0": base, "disto_k3": d} if nested else {**base, "disto_k3": d}
        views.append({"key": i, "value": {"ptr_wrapper": {"data": view}}})
        lenses.append({"key": i, "value": {"polymorphic_id": 1, "ptr_wrapper": {"data": data}}})
        poses.append({"key": i, "value": {"rotation": c.R.tolist(), "center": c.center.tolist()}})
    document = {"sfm_data_version": "0.3", "views": views, "intrinsics": lenses, "extrinsics": poses}
    cameras = read(tmp_path, "sfm_data.json", document)
    for name, c in ((n, square(c)) for n, c in CAMERAS.items()):
        pixels = radial(c, d) * c.K[0, 0] + c.K[:2, 2]
        assert_allclose(cameras[name].project(c.points())[0], pixels, atol=1e-6)


@pytest.mark.parametrize("version", ["1.0.0", "1.2.2", "1.2.6"])
def test_meshroom_projects_by_its_version(tmp_path: Path, version: str) -> None:
    views, lenses, poses = [], [], []
    d = (-0.2, 0.08, 0.03)
    for i, (name, c) in enumerate(CAMERAS.items()):
        c = square(c) if version == "1.0.0" else c
        views.append({"viewId": str(i), "poseId": str(i), "intrinsicId": str(i), "path": f"/a/{name}.png"})
        lens: dict[str, Any] = {"intrinsicId": str(i), "width": str(W), "height": str(H), "type": "radial3"}
        point = c.K[:2, 2] - (0 if version == "1.0.0" else np.array(SIZE) / 2)
        lens |= {"principalPoint": [str(v) for v in point], "distortionParams": [str(v) for v in d]}
        if version == "1.0.0":
            lens["pxFocalLength"] = str(c.K[0, 0])
        else:
            ratio = c.K[1, 1] / c.K[0, 0] if version == "1.2.6" else c.K[0, 0] / c.K[1, 1]
            lens |= {"focalLength": str(c.K[0, 0] * 24 / W), "sensorWidth": "24", "pixelRatio": str(ratio)}
        lenses.append(lens)
        pose = {"rotation": [str(v) for v in c.R.T.ravel()], "center": [str(v) for v in c.center]}
        poses.append({"poseId": str(i), "pose": {"transform": pose}})
    document = {"version": version.split("."), "views": views, "intrinsics": lenses, "poses": poses}
    cameras = read(tmp_path, "cameras.sfm", document)
    for name, c in CAMERAS.items():
        c = square(c) if version == "1.0.0" else c
        pixels = radial(c, d) * [c.K[0, 0], c.K[1, 1]] + c.K[:2, 2]
        assert_allclose(cameras[name].project(c.points())[0], pixels, atol=1e-6)


def test_bundler_looks_along_minus_z(tmp_path: Path) -> None:
    text = "# Bundle file v0.3\n3 0\n"
    f, k1, k2 = 650.0, -0.1, 0.02
    for c in CAMERAS.values():
        text += f"{f} {k1} {k2}\n" + "".join(joined(r) + "\n" for r in FLIP @ c.R) + joined(FLIP @ c.t) + "\n"
    (tmp_path / "list.txt").write_text("".join(f"./{name}.jpg 0 650\n" for name in CAMERAS))
    cameras = read(tmp_path, "bundle.out", text, size=SIZE)
    for name, c in CAMERAS.items():
        p = c.points() @ (FLIP @ c.R).T + FLIP @ c.t
        p = -p[:, :2] / p[:, 2:]
        r2 = (p**2).sum(axis=1, keepdims=True)
        p = f * (1 + k1 * r2 + k2 * r2**2) * p  # from the centre, y up
        pixels = np.column_stack([(W - 1) / 2 + p[:, 0], (H - 1) / 2 - p[:, 1]])
        assert_allclose(cameras[name].project(c.points())[0], pixels, atol=1e-6)
    with pytest.raises(CameraError, match="missing: image size"):
        read(tmp_path, "bundle.out", text)


def test_mvsnet_has_a_matrix_from_the_world_and_k(tmp_path: Path) -> None:
    c = CAMERAS["cam1"]
    pose = np.vstack([np.column_stack([c.R, c.t]), [0, 0, 0, 1]])
    rows = ["extrinsic", *map(joined, pose), "", "intrinsic", *map(joined, c.K), "", "425.0 2.5"]
    cameras = read(tmp_path, "00000003_cam.txt", "\n".join(rows), size=SIZE)
    assert_allclose(cameras["00000003"].project(c.points())[0], c.pixels((0.0,) * 5), atol=1e-6)


# -- Vicon, Motive, Theia3D, DLT, Ego-Exo4D


def vicon(k: tuple[float, float, float], off: float = 0.0) -> str:
    text = '<?xml version="1.0" encoding="UTF-8" standalone="no" ?>\n<Cameras VERSION="1.0">'
    for name, c in ((n, square(c)) for n, c in CAMERAS.items()):
        point = joined(c.K[:2, 2])
        frame = attributes(
            FOCAL_LENGTH=c.K[0, 0],
            ORIENTATION=joined(Rotation.from_matrix(c.R).as_quat()),
            POSITION=joined(1000 * c.center),
            PRINCIPAL_POINT=point,
            VICON_RADIAL2=f"Vicon3Parameter {joined(c.K[:2, 2] + off)} {joined(k)}",
        )
        own = attributes(DEVICEID=name, SENSOR_SIZE=f"{W} {H}", PIXEL_ASPECT_RATIO=c.K[0, 0] / c.K[1, 1])
        text += f"<Camera {own}><KeyFrames><KeyFrame {frame}/></KeyFrames></Camera>"
    return text + '<Camera DEVICEID="new" SENSOR_SIZE="1 1"><KeyFrames/></Camera></Cameras>'


@pytest.mark.daily("k0-0.0")
@pytest.mark.parametrize(
    ("k", "off"), [((0.0, 0.0, 0.0), 0.0), ((4e-7, 2e-13, 0.0), 0.0), ((3e-7, 0.0, 0.0), 6.0)]
)
def test_vicon_corrects_pixels_about_a_centre(tmp_path: Path, k: tuple[float, ...], off: float) -> None:
    with pytest.warns(HumansimWarning, match="left out, because they are not calibrated: new"):
        cameras = read(tmp_path, "lab.xcp", vicon(k, off))  # type: ignore[arg-type]
    assert list(cameras) == list(CAMERAS)
    for name, c in ((n, square(c)) for n, c in CAMERAS.items()):
        center = c.K[:2, 2] + off
        ideal = radial(c, (0, 0, 0)) * [c.K[0, 0], c.K[1, 1]] + c.K[:2, 2]

        def corrected(p: Array, ideal: Array = ideal, center: Array = center) -> Array:
            r = p.reshape(-1, 2) - center
            r2 = (r**2).sum(axis=1, keepdims=True)
            return np.asarray((center + r * (1 + k[0] * r2 + k[1] * r2**2) - ideal).ravel())

        pixels = fsolve(corrected, ideal.ravel(), xtol=1e-12).reshape(-1, 2)
        assert_allclose(cameras[name].project(c.points())[0], pixels, atol=0.06 if off else 0.005)


def motive() -> str:
    text = '<?xml version="1.0" encoding="UTF-16LE"?>\n<calibrationProfile version="1"><Calibration><Cameras>'
    up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # z up to y up
    for name, c in CAMERAS.items():
        lens = attributes(
            HorizontalFocalLength=c.K[0, 0], VerticalFocalLength=c.K[1, 1], LensCenterX=c.K[0, 2]
        ) + attributes(LensCenterY=c.K[1, 2]).join("  ")
        lens += attributes(k1=D[0], k2=D[1], TangentialX=D[2], TangentialY=D[3], k3=D[4])
        axes = up @ (FLIP @ c.R).T
        matrix = attributes(**{f"OrientMatrix{i}": v for i, v in enumerate(axes.ravel())})
        place = attributes(**dict(zip("XYZ", up @ c.center, strict=True)))
        text += f'<Camera Serial="{name}"><Attributes ImagerPixelWidth="{W}" ImagerPixelHeight="{H}"/>'
        text += f"<IntrinsicStandardCameraModel {lens}/><Extrinsic {place} {matrix}/></Camera>"
    return text + "</Cameras></Calibration></calibrationProfile>"


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-8"])
def test_motive_has_camera_axes_of_opengl_and_y_up(tmp_path: Path, encoding: str) -> None:
    text = motive() if encoding != "utf-8" else motive().replace("UTF-16LE", "UTF-8")
    (tmp_path / "lab.mcal").write_bytes(text.encode(encoding))
    assert_same(read_calibration(tmp_path / "lab.mcal"))


@pytest.mark.parametrize("last", [0, 1])
def test_theia_counts_pixels_and_millimetres(tmp_path: Path, last: int) -> None:
    text = "<calibration><cameras>"
    for name, c in CAMERAS.items():
        turn = {f"r{i + 1}{j + 1}": c.R[i, j] for i in range(3) for j in range(3)}
        pose = attributes(**dict(zip("xyz", 1000 * c.t, strict=True)), **turn)
        lens = attributes(
            sensorMinU=0,
            sensorMaxU=W - last,
            sensorMinV=0,
            sensorMaxV=H - last,
            focalLengthU=c.K[0, 0],
            focalLengthV=c.K[1, 1],
            centerPointU=c.K[0, 2],
            centerPointV=c.K[1, 2],
            skew=0,
            radialDistortion1=D[0],
            radialDistortion2=D[1],
            radialDistortion3=D[4],
            tangentalDistortion1=D[2],
            tangentalDistortion2=D[3],
        )
        text += f'<camera active="1" serial="{name}"><transform {pose}/><intrinsic {lens}/></camera>'
    assert_same(read(tmp_path, "cal.txt", text + "</cameras></calibration>"))


def dlt(upward: bool) -> str:
    columns = []
    for c in CAMERAS.values():
        p = c.K @ np.column_stack([c.R, c.t])
        p = np.array([[1, 0, 0], [0, -1, H - 1], [0, 0, 1]]) @ p if upward else p
        columns.append((p / p[2, 3]).ravel()[:11])
    return "".join(",".join(map(repr, map(float, values))) + "\n" for values in np.array(columns).T)


@pytest.mark.parametrize("upward", [False, True])
def test_dlt_coefficients_project_by_their_fraction(tmp_path: Path, upward: bool) -> None:
    cameras = read(tmp_path, "dlt.csv", dlt(upward), size=SIZE)
    table = np.array([[float(v) for v in line.split(",")] for line in dlt(upward).splitlines()])
    for c, camera, values in zip(CAMERAS.values(), cameras.values(), table.T, strict=True):
        points = np.column_stack([c.points(), np.ones(40)])
        below = points @ np.append(values[8:], 1)
        pixels = np.column_stack([points @ values[:4] / below, points @ values[4:8] / below])
        if upward:
            pixels[:, 1] = H - 1 - pixels[:, 1]
        assert_allclose(camera.project(c.points())[0], pixels, atol=1e-6)


def ego() -> str:
    head = "cam_uid,graph_uid,tx_world_cam,ty_world_cam,tz_world_cam,qx_world_cam,qy_world_cam,qz_world_cam,"
    head += "qw_world_cam,image_width,image_height,intrinsics_type," + ",".join(
        f"intrinsics_{i}" for i in range(8)
    )
    rows = [head]
    for name, c in CAMERAS.items():
        pose = (*c.center, *Rotation.from_matrix(c.R.T).as_quat())
        lens = (c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2], *FISHEYE)
        words = [repr(float(v)) for v in pose]
        rows.append(
            ",".join([name, "x", *words, str(W), str(H), "KANNALABRANDTK3", *(repr(float(v)) for v in lens)])
        )
    return "\n".join(rows) + "\n"


def test_egoexo_cameras_are_fisheyes_with_poses_in_the_world(tmp_path: Path) -> None:
    assert_same(read(tmp_path, "gopro_calibs.csv", ego()), FISHEYE, fisheye=True)


# -- wrong files

XCP = vicon((0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        (
            "a.xcp",
            XCP.replace('SENSOR_SIZE="640 480"', 'SENSOR_SIZE="640"'),
            "SENSOR_SIZE: needs 2 numbers, not 1",
        ),
        (
            "a.xcp",
            XCP.replace('FOCAL_LENGTH="700.0"', 'FOCAL_LENGTH="nan"'),
            "FOCAL_LENGTH: a number is not finite",
        ),
        ("a.xcp", XCP.replace('FOCAL_LENGTH="700.0"', 'FOCAL_LENGTH="-7"'), "must be above zero"),
        ("a.xcp", XCP.replace('ORIENTATION="', 'ORIENTATION="9'), "the quaternion is not a rotation"),
        ("a.xcp", XCP.replace("Vicon3Parameter", "Vicon4Parameter"), "VICON_RADIAL2: needs Vicon3Parameter"),
        ("a.mcal", motive().replace("HorizontalFocalLength", "Focal"), "cameras.0.fx: is missing"),
        ("a.mcal", motive().replace("OrientMatrix4", "Other"), "cameras.0.t: needs a rotation"),
        ("a.csv", ego().replace("KANNALABRANDTK3", "FTHETA"), "'FTHETA' is not a supported lens"),
        ("a.csv", ego().replace("qw_world_cam", "qw"), "columns are missing: qw_world_cam"),
        ("a.csv", ego()[:-30] + "\n", "values as the header, not"),
        ("a.csv", dlt(upward=True), "missing: image size"),
        ("a.csv", dlt(upward=False).replace(",", "e999,", 1), "a number is not finite"),
        ("a_cam.txt", "extrinsic\n1 0 0 0\n", "needs 'extrinsic' with 4 x 4 numbers"),
        ("a.out", "# Bundle file v0.3\n2 0\n1 0 0\n", "camera 0 needs five lines"),
        ("a.out", "# Bundle file v0.3\n1e9 0\n", "needs the number of cameras"),
        ("a.xml", "<document><chunk><sensors/><cameras/></chunk></document>", "the document has no cameras"),
        (
            "a.xml",
            '<document><chunk><sensors/><cameras><camera id="0" sensor_id="9"/></cameras></chunk></document>',
            "there is no sensor '9'",
        ),
        (
            "a.xml",
            "<calibration><projection>spherical</projection></calibration>",
            "'spherical' is not a supported",
        ),
        (
            "a.json",
            json.dumps({"sfm_data_version": "0.3", "views": [{"value": {"ptr_wrapper": {"data": {}}}}]}),
            "there are no intrinsics None",
        ),
        ("a.sfm", json.dumps({"views": [{"viewId": "1"}], "intrinsics": []}), "there are no intrinsics None"),
        (
            "a.json",
            json.dumps({"sfm_data_version": "0.3", "views": [], "extrinsics": 0.5}),
            "extrinsics: needs a list",
        ),
    ],
)
def test_wrong_files_are_refused_with_their_place(tmp_path: Path, name: str, text: str, said: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(CameraError) as caught:
        read_calibration(tmp_path / name)
    assert str(caught.value).startswith(str(tmp_path / name)) and said in str(caught.value)
