"""Projects of photogrammetry programs: Metashape, OpenMVG, Meshroom, Bundler.

- Metashape (document, calibration XML): u = w/2 + cx + x f + x B1 + y B2, v = h/2 + cy + y f; the centre of
  the first pixel is (0.5, 0.5); tangential coefficients are in the other order than in OpenCV; the pose of a
  camera is in its chunk, and the transform of the chunk leads to the world (Metashape manual 1.5, appendices
  C and D).
- OpenMVG: x = R (X - C). https://openmvg.readthedocs.io/en/latest/software/SfM/SfM_OutputFormat/
- Meshroom (AliceVision): R in column order, x = R (X - C), focal length in mm, principal point from the image
  centre (from version 1.2.1). https://github.com/alicevision/AliceVision (sfmDataIO/jsonIO.cpp)
- Bundler: x = R X + t, the camera looks along -z with y up, pixels from the image centre.
  https://www.cs.cornell.edu/~snavely/bundler/bundler-v0.4-manual.html
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera.camera import Camera, pinhole
from humansim_ros.cameras.camera.lens import Lens
from humansim_ros.cameras.formats.base import (
    FLIP,
    MAX_CAMERAS,
    CalibrationFile,
    Keys,
    RawCamera,
    SourceLocation,
    without_suffix,
)
from humansim_ros.cameras.formats.checks import size_of_named_image
from humansim_ros.cameras.formats.conventions import fitted_lens
from humansim_ros.cameras.formats.table import (
    Cameras,
    Values,
    calibration_format,
    image_names,
    nested,
    number,
    row,
)
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.files.reading import read_text
from humansim_ros.types import Array, ImageSize

# -- Metashape

_ROOTS = ("document", "chunk")
#: Number of fixed-point steps to invert a lens model.
_INVERSION_STEPS = 200


def _chunk(file: CalibrationFile) -> Keys | None:
    """Key path of the first chunk with cameras."""
    for root in _ROOTS:
        for keys in ((root,), (root, "chunk", 0)):
            if file.get(*keys, "sensors") is not None and file.get(*keys, "cameras") is not None:
                return keys
    return None


def _read_metashape(file: CalibrationFile) -> dict[str, RawCamera]:
    chunk = _chunk(file)
    if chunk is None:
        return {Path(file.path).stem: _metashape_lens(file, ("calibration",), None)}
    sensors = {str(file.get(*at, "id")): at for at in file.elements(chunk, "sensors", "sensor")}
    components = _components(file, chunk)
    cameras: dict[str, RawCamera] = {}
    referenced = 0
    lenses: dict[str, RawCamera] = {}
    for group in file.elements(chunk, "cameras"):
        for at in [*file.elements(group, "camera"), *file.elements(group, "group", "camera")]:
            sensor = str(file.get(*at, "sensor_id"))
            if sensor not in sensors:
                raise file.error(f"there is no sensor {sensor[:40]!r}", *at, "sensor_id")
            if sensor not in lenses:
                lenses[sensor] = _sensor_lens(file, sensors[sensor])
            pose = _metashape_pose(file, at, components)
            if pose is None and file.has(*at, "reference"):
                pose = _reference_pose(file, (*at, "reference", 0))
                referenced += pose is not None
            label = without_suffix(str(file.get(*at, "label") or len(cameras)))
            name = label if label not in cameras else f"{label}_{file.get(*at, 'id')}"
            camera = lenses[sensor]
            if pose is not None:
                locations = {**camera.locations, **dict.fromkeys(("", "R", "t"), file.location(*at))}
                camera = replace(camera, R=pose[0], center=pose[1], locations=locations)
            file.add(cameras, name, camera, *at)
    if not cameras:
        raise file.error("the document has no cameras")
    if referenced:
        what = "their reference poses (x, y, z, yaw, pitch, roll) are taken"
        warn_about(file.path, f"{referenced} cameras are not aligned: {what}")
    return cameras


def _sensor_lens(file: CalibrationFile, at: Keys) -> RawCamera:
    """Intrinsics of a sensor: of the adjusted calibration, the initial one, or focal length and pixel
    size."""
    calibrations = file.items(*at, "calibration")
    order = sorted(range(len(calibrations)), key=lambda i: calibrations[i].get("class") != "adjusted")
    if order:
        return _metashape_lens(file, (*at, "calibration", order[0]), at)
    values = {p.get("name"): p.get("value") for p in file.items(*at, "property")}
    try:
        focal = float(values["focal_length"]) / float(values["pixel_width"])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        raise file.error("has no calibration, and no focal_length and pixel_width", *at) from None
    size = _metashape_size(file, at)
    if size is None or not 0 < focal < np.inf:
        raise file.error("has no calibration, and no resolution", *at)
    k = pinhole(focal, focal, size[0] / 2 - 0.5, size[1] / 2 - 0.5)
    warn_about(file.path, f"sensor {file.get(*at, 'label')}: no calibration; K is of its focal length in mm")
    return RawCamera(k, size=size, locations={"": file.location(*at)})


def _metashape_size(file: CalibrationFile, at: Keys) -> ImageSize | None:
    if file.get(*at, "resolution", 0) is not None:
        return file.size((*at, "resolution", 0, "width"), (*at, "resolution", 0, "height"))
    if file.get(*at, "width", 0) is not None:
        return file.size((*at, "width", 0, "text"), (*at, "height", 0, "text"))
    return None


def _metashape_lens(file: CalibrationFile, at: Keys, sensor: Keys | None) -> RawCamera:
    kind = file.get(*at, "type") or file.get(*at, "projection", 0, "text") or "frame"
    if kind not in ("frame", "fisheye"):
        message = f"{str(kind)[:40]!r} is not a supported camera type; known are frame and fisheye"
        raise file.error(message, *at)
    size = _metashape_size(file, at) or (None if sensor is None else _metashape_size(file, sensor))
    if size is None:
        raise file.error("has no resolution", *at)
    if not file.has(*at, "f", 0) and not file.has(*at, "fx", 0):
        raise file.error("has no focal length f", *at)
    names = ["f", "cx", "cy", "b1", "b2", "skew", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4"]
    value = {name: file.number(*at, name, 0, "text", otherwise=0.0) for name in names}
    if file.has(*at, "f", 0):
        fx, fy, skew = value["f"] + value["b1"], value["f"], value["b2"]
        cx, cy = size[0] / 2 + value["cx"], size[1] / 2 + value["cy"]
    else:  # older versions have fx, fy and absolute cx, cy
        fx, fy = (file.number(*at, key, 0, "text") for key in ("fx", "fy"))
        cx, cy, skew = value["cx"], value["cy"], value["skew"]
    k = pinhole(fx, fy, cx - 0.5, cy - 0.5)
    k[0, 1] = skew
    location = file.location(*at)
    if kind == "fisheye":
        lens, model = tuple(value[name] for name in ("k1", "k2", "k3", "k4")), "equidistant"
        if unknown := [name for name in ("p1", "p2", "p3", "p4") if value[name]]:
            text = f"{' and '.join(unknown)} of the fisheye are left out: no lens model has them"
            warn_about(file.path, text)
    else:
        lens, model = tuple(value[name] for name in ("k1", "k2", "p2", "p1", "k3")), "plumb_bob"
        if value["k4"] or ((value["p3"] or value["p4"]) and (value["p1"] or value["p2"])):
            label = "calibration" if sensor is None else f"sensor {file.get(*sensor, 'label')}"
            fitted = _fitted_frame(file, at, f"{label}: the lens with k4, p3 or p4", value, k, size)
            lens, model = fitted.coefficients, fitted.model
    return RawCamera(k, size=size, distortion=lens, model=model, locations={"": location, "K": location})


def _fitted_frame(
    file: CalibrationFile, at: Keys, what: str, value: Mapping[str, float], k: Array, size: ImageSize
) -> Lens:
    """Fit a lens, over the image, to a frame camera with coefficients that no lens model has."""

    def distort(points: Array) -> Array:
        r2 = (points**2).sum(axis=1, keepdims=True)
        radial = 1 + r2 * (value["k1"] + r2 * (value["k2"] + r2 * (value["k3"] + r2 * value["k4"])))
        p = np.array([value["p1"], value["p2"]])
        tangential = p * (r2 + 2 * points**2) + 2 * p[::-1] * points.prod(axis=1, keepdims=True)
        return np.asarray(points * radial + tangential * (1 + r2 * (value["p3"] + r2 * value["p4"])))

    columns, rows = np.meshgrid(np.linspace(0, size[0] - 1, 25), np.linspace(0, size[1] - 1, 19))
    pixels = np.column_stack([columns.ravel(), rows.ravel(), np.ones(columns.size)])
    places = (pixels @ np.linalg.inv(k).T)[:, :2]
    ideal = places.copy()
    with np.errstate(all="ignore"):  # the lens model may fold within the image
        for _ in range(_INVERSION_STEPS):
            ideal += places - distort(ideal)
        known = np.abs(distort(ideal) - places).max(axis=1) < 1e-9
    if known.mean() < 0.5:
        raise file.error("a lens with these coefficients folds over itself in the image", *at)
    return fitted_lens(file, what, ideal[known], places[known], float(k[0, 0]))


def _similarity(file: CalibrationFile, at: Keys) -> tuple[Array, Array, float] | None:
    """Rotation, translation and scale of an element ``transform``; None if the element is missing."""
    if file.get(*at) is None:
        return None
    if file.get(*at, "rotation", 0) is None and file.get(*at, "text"):
        values = file.words(16, *at, "text").reshape(4, 4)
        scale = float(np.cbrt(max(np.linalg.det(values[:3, :3]), 1e-300)))
        return values[:3, :3] / scale, values[:3, 3], scale
    parts = (("rotation", 9, np.eye(3)), ("translation", 3, np.zeros(3)), ("scale", 1, np.ones(1)))
    rotation, shift, factor = (
        file.words(count, *at, part, 0, "text") if file.has(*at, part, 0) else usual
        for part, count, usual in parts
    )
    return rotation.reshape(3, 3), shift, float(factor[0])


def _components(file: CalibrationFile, chunk: Keys) -> dict[str, tuple[Array, Array, float]]:
    """Transforms to the world by id of the component. "" is the chunk."""
    paths = {str(file.get(*at, "id")): at for at in file.elements(chunk, "components", "component")}
    found = {name: _similarity(file, (*at, "transform", 0)) for name, at in {"": chunk, **paths}.items()}
    return {name: one for name, one in found.items() if one is not None}


def _metashape_pose(
    file: CalibrationFile, at: Keys, components: Mapping[str, tuple[Array, Array, float]]
) -> tuple[Array, Array] | None:
    """R from the world to the camera, and its centre; None for a camera that was not aligned."""
    if file.get(*at, "transform", 0, "text") is None:
        return None
    pose = file.words(16, *at, "transform", 0, "text").reshape(4, 4)
    component = str(file.get(*at, "component_id") or "")
    rotation, shift, scale = components.get(component, components.get("", (np.eye(3), np.zeros(3), 1.0)))
    return (rotation @ pose[:3, :3]).T, scale * rotation @ pose[:3, 3] + shift


def _reference_pose(file: CalibrationFile, at: Keys) -> tuple[Array, Array] | None:
    """Pose of an element ``reference`` in a local coordinate system; None if one of the six numbers is
    missing. Yaw is clockwise from north (y). Pitch is 0 for a camera that looks down, 90 degrees for a camera
    that looks at the horizon. Roll is about the line of sight."""
    keys = ("x", "y", "z", "yaw", "pitch", "roll")
    if not all(file.has(*at, key) for key in keys):
        return None
    *center, yaw, pitch, roll = (file.number(*at, key) for key in keys)
    pose = Rotation.from_euler("ZXY", [-yaw, pitch, roll], degrees=True).as_matrix() @ FLIP
    return pose.T, np.array(center)


def _metashape_values(own: Values, camera: Camera) -> Values:
    middle = camera.K[:2, 2] + 0.5 - np.array(camera.size) / 2
    kind = "fisheye" if camera.model == "equidistant" else "frame"
    return {"cx_middle": middle[0], "cy_middle": middle[1], "b1": own["fx"] - own["fy"], "kind": kind}


METASHAPE = calibration_format(
    "metashape",
    lambda file: _chunk(file) is not None or file.get("calibration", "projection", 0, "text") is not None,
    _read_metashape,
    values=_metashape_values,
)


# -- OpenMVG and Meshroom: views with a lens and a pose

#: Names of the coefficients of a lens, in the order of the file, and its model.
_Coefficients = tuple[tuple[str, ...], str | None]
_RADIAL: _Coefficients = (("k1", "k2", "k3"), "plumb_bob")
_BROWN: _Coefficients = (("k1", "k2", "k3", "p1", "p2"), "plumb_bob")
_FISHEYE: _Coefficients = (("k1", "k2", "k3", "k4"), "equidistant")
#: Coefficients and models by the key of a lens in OpenMVG.
_OPENMVG: Mapping[str, _Coefficients] = {
    "disto_k1": (("k1",), "plumb_bob"),
    "disto_k3": _RADIAL,
    "disto_t2": _BROWN,
    "fisheye": _FISHEYE,
}
#: Coefficients and models by the type of a lens in AliceVision.
_ALICE: Mapping[str, _Coefficients] = {
    **dict.fromkeys(("none", "pinhole"), ((), None)),
    **dict.fromkeys(("radial1", "radialk1"), (("k1",), "plumb_bob")),
    **dict.fromkeys(("radial3", "radialk3"), _RADIAL),
    "brown": _BROWN,
    "fisheye4": _FISHEYE,
}


def _coefficients(file: CalibrationFile, keys: Keys, lens: _Coefficients) -> dict[str, Any]:
    """Coefficients by name, and model. In the file, they are in the order of ``lens``."""
    names, model = lens
    return {**dict(zip(names, file.numbers((len(names),), *keys).tolist(), strict=True)), "model": model}


def _by_id(file: CalibrationFile, section: str, key: str, *below: str) -> dict[str, Keys]:
    """Key paths of the items of a section, extended by ``below``, by the value of ``key`` in each item."""
    return {str(file.get(*at, key)): (*at, *below) for at in file.paths(section)}


def _lens_of(file: CalibrationFile, at: Keys, key: str, lenses: Mapping[str, Keys]) -> Keys:
    """Key path of the lens of a view. ``key``: key of the lens in the view."""
    lens = str(file.get(*at, key))
    if lens not in lenses:
        raise file.error(f"there are no intrinsics {lens[:40]}", *at, key)
    return lenses[lens]


def _pose_of(file: CalibrationFile, at: Keys | None, turned: bool = False) -> dict[str, Any]:
    """R and C with x = R (X - C); R may be ``turned`` (in column order). Empty without a key path."""
    if at is None:
        return {}
    r, center = file.numbers((3, 3), *at, "rotation"), file.numbers((3,), *at, "center")
    return {"R_w2c": nested(r.T if turned else r), "center": nested(center)}


def _openmvg(file: CalibrationFile) -> Cameras:
    below = ("value", "ptr_wrapper", "data")
    lenses, poses = _by_id(file, "intrinsics", "key", *below), _by_id(file, "extrinsics", "key", "value")
    cameras = []
    for index, path in enumerate(file.paths("views")):
        at = (*path, *below)
        view = file.mapping(*at)
        name = without_suffix(str(view.get("filename") or view.get("id_view") or index))
        lens = _openmvg_lens(file, _lens_of(file, at, "id_intrinsic", lenses))
        cameras.append({"name": name, **lens, **_pose_of(file, poses.get(str(view.get("id_pose"))))})
    if not cameras:
        raise file.error("the file has no views", "views")
    return cameras


def _openmvg_lens(file: CalibrationFile, at: Keys) -> dict[str, Any]:
    data = file.mapping(*at)
    inner = (*at, "value0") if isinstance(data.get("value0"), Mapping) else at
    focal = file.number(*inner, "focal_length")
    cx, cy = file.numbers((2,), *inner, "principal_point").tolist()
    camera = {"K": [focal, focal, cx, cy], "size": file.size((*inner, "width"), (*inner, "height"))}
    for key, lens in _OPENMVG.items():
        if data.get(key) is not None:
            camera |= _coefficients(file, (*at, key), lens)
    return camera


def _check_square(name: str, camera: Camera) -> None:
    if abs(camera.K[0, 0] / camera.K[1, 1] - 1) > 1e-9:
        raise CameraError("this format needs square pixels: idealize the camera with --square", key=name)


def _openmvg_values(own: Values, camera: Camera) -> Values:
    _check_square(own["name"], camera)
    lens, key = ("fisheye", "fisheye") if camera.model == "equidistant" else ("pinhole_brown_t2", "disto_t2")
    return {"lens": lens, key: [own[name] for name in _OPENMVG[key][0]]}


OPENMVG = calibration_format("openmvg", arrange=_openmvg, values=_openmvg_values)


def _meshroom(file: CalibrationFile) -> Cameras:
    lenses = _by_id(file, "intrinsics", "intrinsicId")
    poses = _by_id(file, "poses", "poseId", "pose", "transform")
    cameras: dict[str, dict[str, Any]] = {}
    for index, at in enumerate(file.paths("views")):
        view = file.mapping(*at)
        number = view.get("viewId")
        path = str(view.get("path") or number or index).replace("\\", "/")
        name = without_suffix(path.rsplit("/", 1)[-1])
        lens = _meshroom_lens(file, _lens_of(file, at, "intrinsicId", lenses))
        pose = _pose_of(file, poses.get(str(view.get("poseId", number))), turned=True)
        file.add(cameras, name if name not in cameras else f"{name}_{number}", {**lens, **pose}, *at)
    return [{"name": name, **camera} for name, camera in cameras.items()]


def _meshroom_lens(file: CalibrationFile, at: Keys) -> dict[str, Any]:
    version = tuple(int(v) for v in file.optional_numbers("version")) or (1, 2, 6)
    width, height = file.size((*at, "width"), (*at, "height"))
    if file.get(*at, "pxFocalLength") is not None:
        pixels = file.some_numbers(*at, "pxFocalLength")
        fx, fy = float(pixels[0]), float(pixels[-1])
    else:
        sensor = file.number(*at, "sensorWidth", otherwise=36.0)
        if sensor <= 0:
            raise file.error("needs a width above zero", *at, "sensorWidth")
        fx = file.number(*at, "focalLength") / sensor * width
        ratio = file.number(*at, "pixelRatio", otherwise=1.0)
        if ratio <= 0:
            raise file.error("needs a ratio above zero", *at, "pixelRatio")
        fy = fx * ratio if version >= (1, 2, 5) else fx / ratio
    point = file.numbers((2,), *at, "principalPoint")
    if version >= (1, 2, 1):
        point = point + np.array([width, height]) / 2
    kind = str(file.get(*at, "distortionType") or file.get(*at, "type") or "pinhole").lower()
    if kind not in _ALICE:
        known = ", ".join(_ALICE)
        raise file.error(f"{kind[:40]!r} is not a supported lens; known are {known}", *at, "distortionType")
    lens = _ALICE[kind]
    key = next(
        (k for k in ("distortionParams", "distortionParameters") if file.get(*at, k)), "distortionParams"
    )
    camera = {"K": [fx, fy, *point.tolist()], "size": (width, height)}
    given = lens[1] is not None and len(file.optional_numbers(*at, key))
    return {**camera, **_coefficients(file, (*at, key), lens)} if given else camera


def _meshroom_values(own: Values, camera: Camera) -> Values:
    kind = "fisheye4" if camera.model == "equidistant" else "brown"
    lists = {
        "principal": camera.K[:2, 2] - np.array(camera.size) / 2,
        "coefficients": [own[name] for name in _ALICE[kind][0]],
        "R_columns": own["R_columns"],
        "center": own["center"],
    }
    texts = {key: [number(value) for value in values] for key, values in lists.items()}
    return {"lens": kind, "focal": own["fx"] / own["width"] * 36.0, "ratio": own["fy"] / own["fx"], **texts}


MESHROOM = calibration_format("meshroom", arrange=_meshroom, values=_meshroom_values)


# -- Bundler


def _read_bundler(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = ((line, text.split()) for line, text in file.lines())
    first, head = next(lines, (1, []))
    counts = file.row(head, first)
    if len(counts) != 2 or counts[0] != int(counts[0]) or not 0 < counts[0] <= MAX_CAMERAS:
        raise file.error("needs the number of cameras and of points", line=first)
    names = _list_of_images(file)
    folder = Path(file.path).parent
    cameras: dict[str, RawCamera] = {}
    for index in range(int(counts[0])):
        rows = list(islice(lines, 5))
        values = [file.row(words, line) for line, words in rows]
        if [len(v) for v in values] != [3] * 5:
            message = f"camera {index} needs five lines of three numbers: f k1 k2, R (3 x 3), t"
            raise file.error(message, line=rows[-1][0] if rows else first)
        focal, k1, k2 = values[0]
        if focal == 0:
            continue  # the camera was not reconstructed
        image = names[index] if index < len(names) else str(index)
        size = file.given_size or size_of_named_image(folder, image)
        if size is None:
            message = f"missing: image size; pixels count from the image centre, and {image[:60]} is not here"
            raise file.error(f"{message}: give the size", "size")
        r, t = FLIP @ np.array(values[1:4]), FLIP @ np.array(values[4])
        where = SourceLocation(None, rows[0][0])
        k = pinhole(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)
        camera = RawCamera(
            k, r, t, size=size, distortion=(k1, k2, 0, 0, 0), model="plumb_bob", locations={"": where}
        )
        file.add(cameras, without_suffix(image.rsplit("/", 1)[-1]), camera, line=rows[0][0])
    if not cameras:
        raise file.error("no camera was reconstructed: all focal lengths are 0")
    return cameras


def _list_of_images(file: CalibrationFile) -> list[str]:
    """Images of list.txt in the folder of the file or one folder above. Empty if list.txt is missing."""
    for folder in (Path(file.path).parent, Path(file.path).parent.parent):
        path = folder / "list.txt"
        if path.is_file() and path.stat().st_size < 1 << 20:
            lines = read_text(path, CameraError, "list of images", 1 << 20).splitlines()
            return [line.split()[0].removeprefix("./") for line in lines if line.strip()]
    return []


def _write_bundler(cameras: Mapping[str, Camera]) -> dict[str, str | bytes]:
    images = image_names(cameras)
    lines = ["# Bundle file v0.3", f"{len(cameras)} 0"]
    for name, camera in cameras.items():
        _check_square(name, camera)
        middle = (np.array(camera.size) - 1) / 2
        if np.abs(camera.K[:2, 2] - middle).max() > 1e-6:
            message = "this format needs a principal point at the image centre: idealize first"
            raise CameraError(message, key=name)
        k1, k2 = camera.distortion[:2]
        lines.append(row((camera.K[0, 0], k1, k2)))
        lines += [row(values) for values in (*(FLIP @ camera.R), FLIP @ camera.t)]
    return {"bundle.out": "\n".join(lines) + "\n", "list.txt": "\n".join(images.values()) + "\n"}


BUNDLER = calibration_format(
    "bundler",
    lambda file: file.text.lstrip()[:14].lower().startswith("# bundle file"),
    _read_bundler,
    _write_bundler,
)

FORMATS = (BUNDLER, MESHROOM, METASHAPE, OPENMVG)
