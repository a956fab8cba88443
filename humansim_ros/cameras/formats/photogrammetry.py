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
from humansim_ros.cameras.camera.lens import MODELS, Lens
from humansim_ros.cameras.formats.base import (
    FLIP,
    MAX_CAMERAS,
    CalibrationFile,
    Keys,
    RawCamera,
    SourceLocation,
    fitted_lens,
    image_names,
    number,
    row,
    without_suffix,
)
from humansim_ros.cameras.formats.checks import size_of_named_image
from humansim_ros.cameras.formats.table import Values, calibration_format
from humansim_ros.errors import CameraError, warn_about
from humansim_ros.files.reading import read_text
from humansim_ros.types import Array, ImageSize

# -- Metashape

_ROOTS = ("document", "chunk")
#: Steps for the inversion of a lens.
_INVERSION_STEPS = 200


def _chunk(file: CalibrationFile) -> Keys | None:
    """Key path of the first chunk with cameras."""
    for root in _ROOTS:
        for keys in ((root,), (root, "chunk", 0)):
            if file.get(*keys, "sensors") is not None and file.get(*keys, "cameras") is not None:
                return keys
    return None


def _is_metashape(file: CalibrationFile) -> bool:
    return _chunk(file) is not None or file.get("calibration", "projection", 0, "text") is not None


def _read_metashape(file: CalibrationFile) -> dict[str, RawCamera]:
    chunk = _chunk(file)
    if chunk is None:
        return {Path(file.path).stem: _metashape_lens(file, ("calibration",), None)}
    sensors = {}
    for group, _ in enumerate(file.items(*chunk, "sensors")):
        for index, sensor in enumerate(file.items(*chunk, "sensors", group, "sensor")):
            sensors[str(sensor.get("id"))] = (*chunk, "sensors", group, "sensor", index)
    components = _components(file, chunk)
    cameras: dict[str, RawCamera] = {}
    referenced, skipped = 0, 0
    lenses: dict[str, RawCamera] = {}
    for at in _metashape_cameras(file, chunk):
        sensor_id = str(file.get(*at, "sensor_id"))
        if sensor_id not in sensors:
            raise file.error(f"there is no sensor {sensor_id[:40]!r}", *at, "sensor_id")
        if sensor_id not in lenses:
            lenses[sensor_id] = _sensor_lens(file, sensors[sensor_id])
        lens = lenses[sensor_id]
        pose = _metashape_pose(file, at, components)
        if pose is None and file.get(*at, "reference") is not None:
            pose = _reference_pose(file, (*at, "reference", 0))
            referenced += pose is not None
        label = without_suffix(str(file.get(*at, "label") or len(cameras)))
        name = label if label not in cameras else f"{label}_{file.get(*at, 'id')}"
        if pose is None:
            skipped += 1
            file.add(cameras, name, lens, *at)
            continue
        locations = {**lens.locations, **dict.fromkeys(("", "R", "t"), file.location(*at))}
        file.add(cameras, name, replace(lens, R=pose[0], center=pose[1], locations=locations), *at)
    if not cameras:
        raise CameraError("the document has no cameras", path=file.path)
    if referenced:
        what = "their reference poses (x, y, z, yaw, pitch, roll) are taken"
        warn_about(file.path, f"{referenced} cameras are not aligned: {what}")
    return cameras


def _metashape_cameras(file: CalibrationFile, chunk: Keys) -> list[Keys]:
    found: list[Keys] = []
    for group, cameras in enumerate(file.items(*chunk, "cameras")):
        at = (*chunk, "cameras", group)
        found += [(*at, "camera", index) for index, _ in enumerate(cameras.get("camera") or ())]
        for outer, inner in enumerate(cameras.get("group") or ()):
            found += [(*at, "group", outer, "camera", i) for i, _ in enumerate(inner.get("camera") or ())]
    return found


def _sensor_lens(file: CalibrationFile, at: Keys) -> RawCamera:
    """Lens of a sensor: the adjusted calibration, or the initial one, or focal length and pixel size."""
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
        raise file.error(
            f"{str(kind)[:40]!r} is not a supported camera type; known are frame and fisheye", *at
        )
    size = _metashape_size(file, at)
    size = _metashape_size(file, sensor) if size is None and sensor is not None else size
    if size is None:
        raise file.error("has no resolution", *at)
    names = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4")
    if file.get(*at, "f", 0) is None and file.get(*at, "fx", 0) is None:
        raise file.error("has no focal length f", *at)
    value = {name: file.number(*at, name, 0, "text", otherwise=0.0) for name in names}
    if file.get(*at, "f", 0) is None:  # older versions have fx, fy and absolute cx, cy
        fx, fy = (file.number(*at, key, 0, "text") for key in ("fx", "fy"))
        k = pinhole(fx, fy, value["cx"] - 0.5, value["cy"] - 0.5)
        k[0, 1] = file.number(*at, "skew", 0, "text", otherwise=0.0)
    else:
        f = value["f"]
        k = pinhole(f + value["b1"], f, size[0] / 2 + value["cx"] - 0.5, size[1] / 2 + value["cy"] - 0.5)
        k[0, 1] = value["b2"]
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
    rotation, shift, scale = np.eye(3), np.zeros(3), 1.0
    if file.get(*at, "rotation", 0) is not None:
        rotation = file.words(9, *at, "rotation", 0, "text").reshape(3, 3)
    if file.get(*at, "translation", 0) is not None:
        shift = file.words(3, *at, "translation", 0, "text")
    if file.get(*at, "scale", 0) is not None:
        scale = float(file.words(1, *at, "scale", 0, "text")[0])
    return rotation, shift, scale


def _components(file: CalibrationFile, chunk: Keys) -> dict[str, tuple[Array, Array, float]]:
    """Transforms to the world by id of the component. "" is the chunk."""
    found = {}
    own = _similarity(file, (*chunk, "transform", 0))
    if own is not None:
        found[""] = own
    for group, components in enumerate(file.items(*chunk, "components")):
        for index, component in enumerate(components.get("component") or ()):
            inner = _similarity(file, (*chunk, "components", group, "component", index, "transform", 0))
            if inner is not None:
                found[str(component.get("id"))] = inner
    return found


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
    if any(file.get(*at, key) is None for key in ("x", "y", "z", "yaw", "pitch", "roll")):
        return None
    center = np.array([file.number(*at, key) for key in "xyz"])
    yaw, pitch, roll = (file.number(*at, key) for key in ("yaw", "pitch", "roll"))
    pose = Rotation.from_euler("ZXY", [-yaw, pitch, roll], degrees=True).as_matrix() @ FLIP
    return pose.T, center


def _metashape_values(own: Values, camera: Camera) -> Values:
    middle = camera.K[:2, 2] + 0.5 - np.array(camera.size) / 2
    kind = "fisheye" if camera.model == "equidistant" else "frame"
    return {"cx_middle": middle[0], "cy_middle": middle[1], "b1": own["fx"] - own["fy"], "kind": kind}


METASHAPE = calibration_format("metashape", _is_metashape, _read_metashape, values=_metashape_values)


# -- OpenMVG

#: By key of the lens: coefficients in the order of OpenMVG, and the model.
_OPENMVG = {
    "disto_k1": (("k1",), "plumb_bob"),
    "disto_k3": (("k1", "k2", "k3"), "plumb_bob"),
    "disto_t2": (("k1", "k2", "k3", "p1", "p2"), "plumb_bob"),
    "fisheye": (("k1", "k2", "k3", "k4"), "equidistant"),
}


def _is_openmvg(file: CalibrationFile) -> bool:
    return file.get("sfm_data_version") is not None and isinstance(file.get("views"), list)


def _read_openmvg(file: CalibrationFile) -> dict[str, RawCamera]:
    lenses, poses = {}, {}
    for index, item in enumerate(file.items("intrinsics")):
        lenses[str(_of(item, "key"))] = _openmvg_lens(
            file, ("intrinsics", index, "value", "ptr_wrapper", "data")
        )
    for index, item in enumerate(file.items("extrinsics")):
        poses[str(_of(item, "key"))] = ("extrinsics", index, "value")
    cameras: dict[str, RawCamera] = {}
    for index, _ in enumerate(file.items("views")):
        at: Keys = ("views", index, "value", "ptr_wrapper", "data")
        view = file.mapping(*at)
        lens = lenses.get(str(view.get("id_intrinsic")))
        if lens is None:
            raise file.error(
                f"there are no intrinsics {str(view.get('id_intrinsic'))[:40]}", *at, "id_intrinsic"
            )
        pose = poses.get(str(view.get("id_pose")))
        name = without_suffix(str(view.get("filename") or view.get("id_view") or index))
        file.add(cameras, name, _posed(file, lens, pose), *at)
    if not cameras:
        raise file.error("the file has no views", "views")
    return cameras


def _of(item: Any, key: str) -> Any:
    return item.get(key) if isinstance(item, Mapping) else None


def _posed(file: CalibrationFile, lens: RawCamera, pose: Keys | None, columns: bool = False) -> RawCamera:
    """Camera with a lens and a pose x = R (X - C). If ``pose`` is None, the camera has no pose."""
    if pose is None:
        return lens
    r = file.numbers((3, 3), *pose, "rotation")
    locations = {**lens.locations, **file.locations(pose, R="rotation", t="center")}
    return replace(
        lens, R=r.T if columns else r, center=file.numbers((3,), *pose, "center"), locations=locations
    )


def _openmvg_lens(file: CalibrationFile, at: Keys) -> RawCamera:
    data = file.mapping(*at)
    base: Keys = (*at, "value0") if isinstance(data.get("value0"), Mapping) else at
    size = file.size((*base, "width"), (*base, "height"))
    focal = file.number(*base, "focal_length")
    cx, cy = file.numbers((2,), *base, "principal_point")
    distortion, model = (), None
    for key, (names, kind) in _OPENMVG.items():
        if data.get(key) is not None:
            values = dict(zip(names, file.numbers((len(names),), *at, key), strict=True))
            distortion, model = tuple(values.get(name, 0.0) for name in MODELS[kind]), kind
    return RawCamera(
        pinhole(focal, focal, cx, cy),
        size=size,
        distortion=distortion,
        model=model,
        locations={"": file.location(*at), "K": file.location(*base, "focal_length")},
    )


def _check_square(name: str, camera: Camera) -> None:
    if abs(camera.K[0, 0] / camera.K[1, 1] - 1) > 1e-9:
        raise CameraError("this format needs square pixels: idealize the camera with --square", key=name)


def _openmvg_values(own: Values, camera: Camera) -> Values:
    _check_square(own["name"], camera)
    lens, key = ("fisheye", "fisheye") if camera.model == "equidistant" else ("pinhole_brown_t2", "disto_t2")
    return {"lens": lens, key: [own[name] for name in _OPENMVG[key][0]]}


OPENMVG = calibration_format("openmvg", _is_openmvg, _read_openmvg, values=_openmvg_values)


# -- Meshroom

#: By lens type of AliceVision: coefficients in its order, and the model.
_ALICE = {
    "none": ((), None),
    "pinhole": ((), None),
    "radial1": (("k1",), "plumb_bob"),
    "radialk1": (("k1",), "plumb_bob"),
    "radial3": (("k1", "k2", "k3"), "plumb_bob"),
    "radialk3": (("k1", "k2", "k3"), "plumb_bob"),
    "brown": (("k1", "k2", "k3", "p1", "p2"), "plumb_bob"),
    "fisheye4": (("k1", "k2", "k3", "k4"), "equidistant"),
}


def _is_meshroom(file: CalibrationFile) -> bool:
    views, lenses = file.get("views"), file.get("intrinsics")
    named = isinstance(views, list) and any(isinstance(view, dict) and "viewId" in view for view in views)
    return named and isinstance(lenses, list)


def _read_meshroom(file: CalibrationFile) -> dict[str, RawCamera]:
    lenses = {
        str(_of(item, "intrinsicId")): _meshroom_lens(file, ("intrinsics", index))
        for index, item in enumerate(file.items("intrinsics"))
    }
    poses: dict[str, Keys] = {
        str(_of(item, "poseId")): ("poses", index, "pose", "transform")
        for index, item in enumerate(file.items("poses"))
    }
    cameras: dict[str, RawCamera] = {}
    for index, _ in enumerate(file.items("views")):
        at: Keys = ("views", index)
        view = file.mapping(*at)
        lens = lenses.get(str(view.get("intrinsicId")))
        if lens is None:
            raise file.error(
                f"there are no intrinsics {str(view.get('intrinsicId'))[:40]}", *at, "intrinsicId"
            )
        path = str(view.get("path") or view.get("viewId") or index).replace("\\", "/")
        name = without_suffix(path.rsplit("/", 1)[-1])
        name = name if name not in cameras else f"{name}_{view.get('viewId')}"
        pose = poses.get(str(view.get("poseId", view.get("viewId"))))
        file.add(cameras, name, _posed(file, lens, pose, columns=True), *at)
    return cameras


def _meshroom_lens(file: CalibrationFile, at: Keys) -> RawCamera:
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
    names, model = _ALICE[kind]
    key = next(
        (k for k in ("distortionParams", "distortionParameters") if file.get(*at, k)), "distortionParams"
    )
    values = file.optional_numbers(*at, key)
    distortion: tuple[float, ...] = ()
    if model is not None and len(values):
        given = dict(zip(names, file.numbers((len(names),), *at, key), strict=True))
        distortion = tuple(given.get(name, 0.0) for name in MODELS[model])
    return RawCamera(
        pinhole(fx, fy, point[0], point[1]),
        size=(width, height),
        distortion=distortion,
        model=model if distortion else None,
        locations=file.locations(at, K="focalLength", distortion=key, size="width"),
    )


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


MESHROOM = calibration_format("meshroom", _is_meshroom, _read_meshroom, values=_meshroom_values)


# -- Bundler


def _is_bundler(file: CalibrationFile) -> bool:
    return file.text.lstrip()[:14].lower().startswith("# bundle file")


def _read_bundler(file: CalibrationFile) -> dict[str, RawCamera]:
    lines = ((line, text.split()) for line, text in file.lines())
    first, head = next(lines, (1, []))
    counts = file.row(head, first)
    if len(counts) != 2 or counts[0] != int(counts[0]) or not 0 < counts[0] <= MAX_CAMERAS:
        raise CameraError("needs the number of cameras and of points", path=file.path, line=first)
    names = _list_of_images(file)
    folder = Path(file.path).parent
    cameras: dict[str, RawCamera] = {}
    for index in range(int(counts[0])):
        rows = list(islice(lines, 5))
        values = [file.row(words, line) for line, words in rows]
        if [len(v) for v in values] != [3] * 5:
            message = f"camera {index} needs five lines of three numbers: f k1 k2, R (3 x 3), t"
            raise CameraError(message, path=file.path, line=rows[-1][0] if rows else first)
        focal, k1, k2 = values[0]
        if focal == 0:
            continue  # the camera was not reconstructed
        image = names[index] if index < len(names) else str(index)
        size = file.given_size or size_of_named_image(folder, image)
        if size is None:
            message = f"missing: image size; pixels count from the image centre, and {image[:60]} is not here"
            raise CameraError(f"{message}: give the size", path=file.path, key="size")
        r, t = FLIP @ np.array(values[1:4]), FLIP @ np.array(values[4])
        where = SourceLocation(None, rows[0][0])
        k = pinhole(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)
        camera = RawCamera(
            k, r, t, size=size, distortion=(k1, k2, 0, 0, 0), model="plumb_bob", locations={"": where}
        )
        file.add(cameras, without_suffix(image.rsplit("/", 1)[-1]), camera, line=rows[0][0])
    if not cameras:
        raise CameraError("no camera was reconstructed: all focal lengths are 0", path=file.path)
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
            raise CameraError(
                "this format needs a principal point at the image centre: idealize first", key=name
            )
        k1, k2 = camera.distortion[:2]
        lines.append(row((camera.K[0, 0], k1, k2)))
        lines += [row(values) for values in (*(FLIP @ camera.R), FLIP @ camera.t)]
    return {"bundle.out": "\n".join(lines) + "\n", "list.txt": "\n".join(images.values()) + "\n"}


BUNDLER = calibration_format("bundler", _is_bundler, _read_bundler, _write_bundler)
