"""K, R, t and lens of cameras in JSON and npz (also YAML and TOML), in any usual spelling.

``cameras/formats/spellings.py`` finds the parameters. Intrinsics and extrinsics may be in one file or in two.
Pixels are those of OpenCV. R and t mean x = R X + t, as in OpenCV, unless keys such as rvec, w2c, c2w and
center say something else. The keys R and t, rotation and translation, extrinsics, and pose are unclear. For
unclear keys, the views of three or more cameras decide between the usual conventions, and a warning says
which one is taken.

NeuS stores two values for each image in cameras_sphere.npz: ``world_mat_i``, which is P = K [R | t] in 4 x 4
numbers, and ``scale_mat_i``, which moves a unit sphere to the object and is not used here.
https://github.com/Totoro97/NeuS

``params`` together with a camera model of COLMAP are the parameters of this model, in COLMAP's pixels.
``images`` may refer to ``cameras`` by ``camera_id``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from humansim_ros.cameras.camera.camera import pinhole
from humansim_ros.cameras.camera.lens import MODELS
from humansim_ros.cameras.formats.base import (
    MAX_CAMERAS,
    CalibrationFile,
    RawCamera,
    SourceLocation,
    model_of,
    without_suffix,
)
from humansim_ros.cameras.formats.conventions import find_model, model_of_four, resolved
from humansim_ros.cameras.formats.spellings import (
    COLMAP_PARAMETERS,
    INTRINSIC,
    POSE,
    ROTATION,
    SIZE,
    TRANSLATION,
    Entry,
    Found,
    Identity,
    colmap_model,
    find_parameters,
    plain,
    role_of,
    size_of,
    words,
)
from humansim_ros.errors import CameraError, some_of, warn_about
from humansim_ros.geometry import quaternion_to_matrix
from humansim_ros.types import Array, ImageSize

#: Keys that do not state the direction of a transform.
_UNCLEAR = words(
    """r rot rotation rotationmatrix rotmatrix rmat rmatrix rotmat t translation translationvector trans tr
    extrinsic extrinsics extrinsicmatrix extrinsicsmatrix pose poses rt transform transformmatrix orientation
    quaternion quat q qvec rotationquaternion rotationvector"""
)
_CENTRED, _LARGEST_ALPHA = 0.5, 0.1
#: Shapes of the matrices of rectified images, by field of a camera.
_RECTIFIED = {"rectification": (3, 3), "rectified": (3, 4)}
#: Camera models with the coefficients of OpenCV.
_UNNAMED = words(
    "pinhole perspective opencv simple_pinhole brown none full_opencv simple_radial radial pinhole_full"
)


#: Keys of the position of a camera. Together with ``rotation``, they are its pose, as in 3D Gaussian
#: Splatting.
_PLACES = words("position pos cameraposition camposition campos location cameralocation")


def is_matrices(file: CalibrationFile) -> bool:
    """Whether a document has K, a focal length or P of a camera, in a known spelling."""
    return bool(find_parameters(plain(file)).having(INTRINSIC))


def _with_models(file: CalibrationFile) -> CalibrationFile:
    """Copy the parameters of the cameras to their images, if the file lists both, as COLMAP's models do."""
    cameras, images = (
        dict(enumerate(section)) if isinstance(section, list) else section
        for section in (file.get("cameras"), file.get("images"))
    )
    if not isinstance(cameras, Mapping) or not isinstance(images, Mapping):
        return file
    by_id = {
        str(camera.get("camera_id", camera.get("id", key))): camera
        for key, camera in cameras.items()
        if isinstance(camera, Mapping)
    }
    joined = {}
    for key, image in images.items():
        if not isinstance(image, Mapping) or "camera_id" not in image:
            return file
        number = str(image["camera_id"])
        if number not in by_id:
            raise file.error(f"there is no camera {number[:40]!r} in cameras", "images", key, "camera_id")
        name = without_suffix(str(image.get("name", key)))
        shared = {**by_id[number], **image}
        joined[key] = {k: v for k, v in shared.items() if k not in ("id", "camera_id", "image_id")}
        joined[key]["name"] = name
    rest = {key: value for key, value in file.document.items() if key != "cameras"}
    return replace(file, document={**rest, "images": joined})


def read_matrices(
    file: CalibrationFile, other: CalibrationFile | None = None, needs: Sequence[str] = ()
) -> dict[str, RawCamera]:
    """Read the cameras of a document.

    Args:
        file: File with intrinsics, or with all parameters.
        other: File with extrinsics. The cameras of both files have the same names, or the same number and
            order.
        needs: Keys that each camera must have, with | between keys that replace each other.

    Raises:
        CameraError: A value is wrong, or there are no intrinsics or no extrinsics where they are needed.
    """
    file, other = _with_models(plain(file)), None if other is None else plain(other)
    files = (file,) if other is None else (file, other)
    found = find_parameters(*files)
    for identity in _leaf_cameras(found, found.having(INTRINSIC | POSE)) if needs else ():
        _check_needed(found.entries_of(identity), needs)
    if not found.having(INTRINSIC):
        raise CameraError(missing_parts(found), path=file.path)
    if other is not None and not find_parameters(other).having(POSE):
        message = f"has no extrinsics: {missing_parts(find_parameters(other))}"
        raise CameraError(message, path=other.path)
    pairs = _pairs(file, found)
    cameras: dict[str, RawCamera] = {}
    for name, (entries, posed) in pairs.items():
        camera = _intrinsics(file, entries)
        file.add(cameras, name, camera if camera.R is not None else _posed(camera, posed))
    pose = {camera.locations.get("R") for camera in cameras.values()}
    if len(cameras) == 2 and len(pose) == 1 and None not in pose:
        left, right = cameras  # one pose for both: from the left camera to the right one
        cameras[right] = replace(cameras[right], kind="world", clear=True)
        cameras[left] = replace(cameras[left], R=np.eye(3), t=np.zeros(3), kind="world", clear=True)
    if any("rvec" in entries and entries["rvec"].key == "rxyz" for entries in found.cameras.values()):
        warn_about(file.path, "rx, ry, rz are taken as a rotation vector in radians, as in OpenCV")
    if found.views:
        warn_about(file.path, "rvecs and tvecs are poses of a calibration board, not of cameras: ignored")
    return resolved(files[-1], cameras)


def _check_needed(entries: Mapping[str, Entry], needs: Sequence[str]) -> None:
    """Raise CameraError if the parameters of a camera lack one of the keys ``needs``."""
    *_, last = entries.values()
    for keys in needs:
        key = keys.split("|")[0]
        if entries.keys().isdisjoint(map(role_of, keys.split("|"))):
            raise last.file.error("is missing", *last.keys[:-1], key)


def read_poses(file: CalibrationFile) -> dict[str, RawCamera]:
    """Read the cameras of a document that has extrinsics, with or without K."""
    file = plain(file)
    found = find_parameters(file)
    cameras = {
        _name(file, found, identity): _posed(RawCamera(np.eye(3)), found.entries_of(identity))
        for identity in _leaf_cameras(found, found.having(POSE))
    }
    return resolved(file, cameras)


def missing_parts(found: Found) -> str:
    """Sentence that says which values of a camera a file has, and which are missing."""
    has, lacks = _parts_found(found)
    named = [".".join(identity) for identity in found.cameras if identity]
    of = f" of {some_of(named, 4)}" if has and named else ""
    has_text = f"found {' and '.join(has)}{of}" if has else "nothing of a camera was found in it"
    hint = ""
    if has and lacks[:1] == ["K or focal length"]:
        hint = "; give the file with the intrinsics as well: humansim camera show INTRINSICS EXTRINSICS"
    return f"{has_text}; missing: {', '.join(lacks)}{hint}" if lacks else has_text


# -- names of cameras


def _leaf_cameras(found: Found, identities: list[Identity]) -> list[Identity]:
    """Names of the real cameras, without groups of parameters that several cameras share."""
    shared = {one[:length] for one in identities for length in range(len(one))}
    return [one for one in identities if one not in shared]


def _name(file: CalibrationFile, found: Found, identity: Identity) -> str:
    """Name of a camera: its value ``name``, its item in a list of names, or else its key path."""
    own = found.cameras.get(identity, {}).get("name")
    if own is not None and str(own.value).strip():
        return str(own.value).strip()
    if len(identity) == 1 and identity[0].isdecimal() and int(identity[0]) < len(found.names):
        return found.names[int(identity[0])]
    return "_".join(identity) or Path(file.path).stem


_Pairs = dict[str, tuple[dict[str, Entry], dict[str, Entry]]]


def _pairs(file: CalibrationFile, found: Found) -> _Pairs:
    """Pairs of the intrinsics and the extrinsics of each camera, by name."""
    inner, outer = found.having(INTRINSIC), found.having(POSE)
    every = _leaf_cameras(found, list(dict.fromkeys((*inner, *outer))))
    if len(every) > MAX_CAMERAS:
        raise file.error(f"there are more than {MAX_CAMERAS} cameras")
    whole = [one for one in every if INTRINSIC & found.entries_of(one).keys()]
    if len(whole) < len(every):  # the extrinsics have other names
        inner = _leaf_cameras(found, inner)
        outer = [one for one in _leaf_cameras(found, outer) if one not in whole or one in outer]
        only = [one for one in outer if one not in whole]
        bare = [one for one in inner if not POSE & found.entries_of(one).keys()]
        if len(only) == len(bare):
            names = [_name(file, found, one) for one in bare]
            others = [_name(file, found, one) for one in only]
            if names != others:
                what = f"{some_of(others, 3)} of the extrinsics are taken for {some_of(names, 3)}"
                warn_about(file.path, f"{what} of the intrinsics, in their order")
            match = dict(zip(bare, only, strict=True))
        else:
            match = {}
            what = f"there are no intrinsics of them: {some_of('_'.join(o) for o in only)}"
            warn_about(file.path, f"left out, because {what}")
        every = [one for one in every if one in whole]
    else:
        match = {}
    pairs: _Pairs = {}
    for one in every:
        entries = found.entries_of(one)
        posed = {**entries, **found.entries_of(match[one])} if one in match else entries
        name = _name(file, found, one)
        if name in pairs:
            name = "_".join(one) or name
        if name in pairs:
            raise file.error(f"there are two cameras with the name {name!r}")
        pairs[name] = entries, posed
    return _short(pairs, dict(zip(pairs, every, strict=True)))


def _short(pairs: _Pairs, identities: Mapping[str, Identity]) -> _Pairs:
    """The same pairs by shorter names, without the first parts of key paths that all cameras share."""
    common = 0
    paths = list(identities.values())
    while len(paths) > 1 and all(len(path) > common + 1 for path in paths):
        if len({path[common] for path in paths}) > 1:
            break
        common += 1
    if not common:
        return pairs
    short = {
        "_".join(identities[name][common:]) if name == "_".join(identities[name]) else name: pair
        for name, pair in pairs.items()
    }
    return short if len(short) == len(pairs) else pairs


# -- intrinsics


def camera_of_model(model: str, values: Sequence[float], location: SourceLocation) -> RawCamera:
    """Camera without size and pose from the parameters of a camera model.

    Args:
        model: Name of the camera model, in upper case.
        values: Numbers after width and height in cameras.txt; ``params`` in other files.
        location: Location of the numbers, for errors.

    Raises:
        CameraError: The model is not known, or has another number of parameters.
    """
    names = COLMAP_PARAMETERS.get(model, "").split()
    message = f"unknown camera model {model[:40]!r}; known are {', '.join(COLMAP_PARAMETERS)}"
    if names:
        message = f"{model} needs {' '.join(names)} after width and height, not {len(values)} numbers"
    if not names or len(values) != len(names):
        raise CameraError(message, path=location.path, line=location.line, key=location.key)
    parameters = dict(zip(names, values, strict=True))
    fx, fy = parameters.get("fx", parameters.get("f", 0.0)), parameters.get("fy", parameters.get("f", 0.0))
    ros_model = "plumb_bob"
    if model.endswith("FISHEYE"):
        ros_model = "equidistant"
    elif any(parameters.get(name) for name in ("k4", "k5", "k6")):
        ros_model = "rational_polynomial"
    return RawCamera(
        pinhole(fx, fy, parameters["cx"] - 0.5, parameters["cy"] - 0.5),
        distortion=tuple(parameters.get(name, 0.0) for name in MODELS[ros_model]),
        model=ros_model,
        locations={"": location},
    )


def _scalar(entries: Mapping[str, Entry], role: str, otherwise: float | None = None) -> float | None:
    entry = entries.get(role)
    return otherwise if entry is None else float(entry.file.numbers((), *entry.keys))


def _intrinsics(file: CalibrationFile, entries: Mapping[str, Entry]) -> RawCamera:
    """K, size and lens of a camera. If they come from P, also its pose."""
    size = size_of(entries)
    roles = {"K": ("K", "fx", "focal"), "size": ("width", "size")}
    roles |= {part: (part,) for part in ("distortion", *_RECTIFIED)}
    locations = {
        part: entries[role].location for part, all_ in roles.items() for role in all_ if role in entries
    }
    if "params" in entries and not {"K", "fx", "focal"} & entries.keys():
        params = entries["params"]
        name = colmap_model(entries) or ""
        return replace(camera_of_model(name, params.numbers().tolist(), params.location), size=size)
    if "P" in entries and not {"K", "fx", "focal"} & entries.keys():
        entry = entries["P"]
        values = entry.numbers()
        if len(values) not in (12, 16):
            raise entry.error(f"needs 3 x 4 or 4 x 4 numbers, not {len(values)}")
        camera = entry.file.projection(values.reshape(-1, 4)[:3], entry.location)
        camera = replace(camera, locations=dict.fromkeys(("K", "R", "t"), entry.location))
    else:
        camera = RawCamera(_k(entries, size), locations=locations)
    distortion, model = _lens(file, entries, camera.K)
    if size is not None and "size" in entries and "K" in entries and _is_transposed(entries["K"].numbers()):
        size = size[1], size[0]  # MATLAB's size is (rows, columns)
    rectified: dict[str, Any] = {
        part: entries[part].numbers(*shape) for part, shape in _RECTIFIED.items() if part in entries
    }
    return replace(camera, size=size, distortion=distortion, model=model, **rectified)


def _k(entries: Mapping[str, Entry], size: ImageSize | None) -> Array:
    if "K" in entries:
        entry = entries["K"]
        values = entry.numbers()
        if len(values) == 4:
            return pinhole(*values)
        k = values.reshape(4, 4)[:3, :3] if len(values) == 16 else entry.numbers(3, 3)
        if _is_transposed(k.ravel()):
            why = "is transposed, as in MATLAB, whose pixels count from 1"
            here = "here they are taken to count from 0"
            warn_about(entry.file.path, f"{entry.location.key}: {why}; {here}")
            return k.T
        return k
    focal = entries["focal"].numbers().tolist() if "focal" in entries else []
    fx = _scalar(entries, "fx", *focal[:1])
    fy = _scalar(entries, "fy", *(focal[-1:] or [fx]))
    center = entries["principal"].numbers().tolist() if "principal" in entries else []
    if len(center) != 2:
        middle = (None, None) if size is None else tuple(side / 2 - _CENTRED for side in size)
        center = [_scalar(entries, role, side) for role, side in zip(("cx", "cy"), middle, strict=True)]
    if fx is None or fy is None or None in center:
        entry = entries.get("fx") or entries["focal"]
        raise entry.error("needs a principal point (cx, cy) or an image size as well")
    cx, cy = center
    k = pinhole(fx, fy, cx, cy)
    alpha = _scalar(entries, "alpha") or 0.0  # alpha of cv2.fisheye; a larger alpha belongs to another lens
    k[0, 1] = _scalar(entries, "skew") or fx * alpha * (abs(alpha) < _LARGEST_ALPHA)
    return k


def _is_transposed(k: Array) -> bool:
    """Whether 9 numbers are a K of MATLAB."""
    return len(k) == 9 and bool(k[6:8].any() and not k[[2, 5]].any())


def _lens(
    file: CalibrationFile, entries: Mapping[str, Entry], k: Array
) -> tuple[tuple[float, ...], str | None]:
    """Coefficients and model of a camera with K (3, 3)."""
    word = entries["model"].word if "model" in entries else ""
    fisheye = entries["fisheye"].word if "fisheye" in entries else ""
    bent = fisheye in ("true", "1", "yes") or "fisheye" in word
    if "distortion" in entries:
        entry = entries["distortion"]
        coefficients = entry.numbers()
        keys = entry.keys
    elif "radial" in entries:
        keys = entries["radial"].keys
        radial = [*entries["radial"].numbers(), 0.0, 0.0, 0.0, 0.0][:6]
        tangential = entries["tangential"].numbers() if "tangential" in entries else np.zeros(2)
        coefficients = np.array([*radial[:2], *tangential, *radial[2:]])
    else:
        first = [_scalar(entries, role) or 0.0 for role in ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")]
        k1, k2, k3, k4, k5, k6, p1, p2 = first
        unnamed = (not word or word in _UNNAMED) and not fisheye
        bent = bent or (unnamed and "k4" in entries and not {"p1", "p2", "k5", "k6"} & entries.keys())
        equidistant = bent or model_of(word) == "equidistant"
        if equidistant and not {"k3", "k4"} & entries.keys():
            k3, k4 = p1, p2  # third and fourth number, from a program with one list for all lenses
        coefficients = np.array([k1, k2, k3, k4] if equidistant else [k1, k2, p1, p2, k3, k4, k5, k6])
        keys = next((entries[role].keys for role in ("k1", "k2", "k3") if role in entries), ())
    if bent:
        file.check_count("equidistant", coefficients, keys)
        return tuple(coefficients), "equidistant"
    if not word or word in _UNNAMED:
        if not coefficients.any():
            return (), None
        four = len(coefficients) == 4 and "distortion" in entries
        if not four and len(np.trim_zeros(coefficients, "b")) < 4:
            coefficients = np.resize([*coefficients, 0.0, 0.0, 0.0, 0.0, 0.0], 5)
        stated = False if fisheye else None
        if four:
            model = model_of_four(entries["distortion"].file, keys, coefficients, k, stated)
        else:
            model = "plumb_bob" if not coefficients[5:].any() else "rational_polynomial"
        file.check_count(model, coefficients, keys)
        return tuple(coefficients), model
    known = find_model(file, word, coefficients, entries["model"].keys, keys)
    return tuple(coefficients), known


# -- extrinsics


def _posed(camera: RawCamera, entries: Mapping[str, Entry]) -> RawCamera:
    """The camera with its rotation and translation; unchanged if both are missing."""
    roles = ("pose", "inverse", "R", "rvec", "quaternion", "Rinverse")
    rotation = next((entries[role] for role in roles if role in entries), None)
    shift = next((entries[role] for role in ("pose", "inverse", "t", "center") if role in entries), None)
    kind, clear = "world", True
    if rotation is None:
        if shift is None or "P" in entries:
            return camera
        raise shift.error("needs a rotation (such as R) as well")
    if shift is None:
        raise rotation.error("needs a translation (such as t) as well")
    if rotation is shift:
        r, t = _pose_matrix(rotation)
        kind, clear = "world" if "pose" in entries else "camera", rotation.key not in _UNCLEAR
    else:
        r, t = _rotation(rotation), shift.numbers(3)
        if rotation is entries.get("Rinverse"):
            r = r.T if shift is entries.get("center") else r
            kind = "center" if "center" in entries else "camera"
        elif shift is entries.get("center"):
            placed = shift.key in _PLACES and rotation.key not in ("r", "rmat", "rvec")
            kind = "placed" if placed else "center"
            clear = rotation.key not in _UNCLEAR and rotation is not entries.get("quaternion")
        else:
            clear = rotation.key not in _UNCLEAR or shift.key not in _UNCLEAR
    locations = {**camera.locations, "R": rotation.location, "t": shift.location}
    return replace(camera, R=r, t=t, kind=kind, clear=clear, locations=locations)


def _pose_matrix(entry: Entry) -> tuple[Array, Array]:
    """Rotation (3, 3) and translation (3,) of a matrix."""
    rows = 4 if len(entry.numbers()) == 16 else 3
    values = entry.numbers(rows, 4)
    if rows == 4 and not values[:3, 3].any() and values[3, :3].any():
        values = values.T  # the values are in column order
    if rows == 4 and not np.allclose(values[3], [0, 0, 0, 1], atol=1e-6):
        raise entry.error("needs 0 0 0 1 as the last row of its 4 x 4 numbers")
    return values[:3, :3], values[:3, 3]


def _rotation(entry: Entry) -> Array:
    values = entry.numbers()
    if entry.key.startswith("q") or len(values) == 4:
        length = float(np.linalg.norm(values))
        if len(values) != 4 or abs(length - 1) > 1e-2:
            raise entry.error("is not a quaternion of length 1")
        order = "x, y, z, w" if entry.key.endswith(("orientation", "xyzw")) else "w, x, y, z"
        if not entry.key.endswith(("xyzw", "wxyz", "qvec")):
            where = f"{entry.location.key}: the order of the quaternion"
            warn_about(entry.file.path, f"{where} is taken as {order}")
        return quaternion_to_matrix((values if order[0] == "x" else np.roll(values, -1)) / length)
    if entry.key == "rxyz" and np.linalg.norm(values) > 2 * np.pi:
        raise entry.error("is no rotation vector in radians: give a matrix, not angles")
    if len(values) == 3:
        return np.asarray(Rotation.from_rotvec(values).as_matrix(), dtype=float)
    return entry.numbers(3, 3)


def _parts_found(found: Found) -> tuple[list[str], list[str]]:
    """Which of intrinsics, image size, rotation and translation a file has, and which ones are missing: two
    lists of words for messages."""
    needed = {
        "K or focal length": INTRINSIC,
        "image size": SIZE,
        "rotation": ROTATION,
        "translation": TRANSLATION,
    }
    has = [name for name, words in needed.items() if words & found.roles]
    return has, [name for name in needed if name not in has]
