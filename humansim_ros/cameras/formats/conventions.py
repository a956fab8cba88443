"""Find what a file leaves open: what R and t mean, the model of a lens, and the unit.

A reading is one possible meaning of R and t. Each reading gives a rig. Two facts support a rig: its optical
axes meet in a point in front of all cameras, and its cameras are level or upright about one vertical. The
evidence of a reading is the logarithm of its likelihood. Misses and rolls are taken as normally distributed
with unknown deviation. Each measured number that the common point and the vertical do not use up is one
degree of freedom. A reading is sure if its evidence exceeds that of each other reading by :data:`_MARGIN`.
Otherwise the warning names both readings. ``benchmarks/conventions.py`` measures how many readings of random
rigs are wrong or doubtful.

``cv2.calibrateCamera`` returns five coefficients or more. Four coefficients are either those of
``cv2.fisheye`` (k1 to k4), or plumb_bob without k3, as other programs write it (k1, k2, and small p1, p2).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from humansim_ros.cameras.camera.lens import MODELS, Lens, fit_lens
from humansim_ros.cameras.formats.base import (
    FLIP,
    UNITS,
    CalibrationFile,
    Keys,
    RawCamera,
    is_number,
    metres_of,
    model_of,
)
from humansim_ros.cameras.formats.spellings import leaves_of, plain, shape_of
from humansim_ros.errors import CameraError, some_of, warn_about
from humansim_ros.types import Array

#: Cameras look at a common place if their axes miss it by at most this fraction of the distance to it.
_SURE = 0.35
#: A reading is sure if its evidence exceeds the next best by more than this: in total; and from the common
#: point.
_MARGIN, _CROSSING_MARGIN = 8.0, 2.0
#: Usual misses (fractions of the distance) and rolls (radians) of a real rig; the number of degrees of
#: freedom is limited to the last value.
_MISS, _ROLL, _MOST_FREEDOM = 0.008, 0.05, 9
#: Evidence against a camera that looks away from the common point, and against a rig that looks outwards.
_AWAY, _OUTWARD = 3.0, 3.0
#: The common point is known if the mean square of the sine between two optical axes is above this.
_PARALLEL = 3e-3
#: A camera has an up direction if at least this share of the vertical is in its image plane. The second
#: number is the roll (radians) that is assumed for a camera without an up direction.
_STEEP, _STEEP_ROLL = 0.3, 0.1


class _Reading(NamedTuple):
    """Convention of R and t. ``name``: value of the key ``convention`` that states it. ``apply``: function of
    (R, t) that returns R from world to camera, and the camera centre. ``rare``: evidence against a convention
    that is seldom used."""

    name: str
    text: str
    apply: Callable[[Array, Array], tuple[Array, Array]]
    rare: float = 0.0


_OPENGL = "from the camera to the world with the camera axes of OpenGL (y up, z backward)"
_CENTER = "a rotation from the world and a camera centre (x = R (X - t))"
_READINGS = (
    _Reading("world_to_camera", "from the world to the camera (x = R X + t)", lambda r, t: (r, -r.T @ t)),
    _Reading("camera_to_world", "from the camera to the world (X = R x + t)", lambda r, t: (r.T, t)),
    _Reading("camera_center", _CENTER, lambda r, t: (r, t), 3.0),
    _Reading("transposed", "transposed (x = R^T X + t), as in MATLAB", lambda r, t: (r.T, -r @ t), 3.0),
    _Reading("opengl", _OPENGL, lambda r, t: (FLIP @ r.T, t)),
)
_STATED = {reading.name: index for index, reading in enumerate(_READINGS)}
_STATED |= {"w2c": 0, "opencv": 0, "c2w": 1, "matlab": 3}
#: Numbers of the possible conventions for each kind of unclear keys. The first one needs no evidence.
_ALLOWED = {
    "world": (0, 1, 2, 3),
    "camera": (1, 4, 0),
    "center": (2, 1, 4),
    "placed": (1, 2, 4),
    "shelf": (2, 0, 1, 3),
}


def resolved(file: CalibrationFile, cameras: Mapping[str, RawCamera]) -> dict[str, RawCamera]:
    """Return the cameras with x = R X + t. The convention of unclear poses is found from the views."""
    reading = _reading(file, [camera for camera in cameras.values() if camera.R is not None])
    found = dict(cameras)
    for name, camera in cameras.items():
        convention = _ALLOWED[camera.kind][0] if camera.clear else reading
        if camera.R is not None and convention != 0:
            r, center = _READINGS[convention].apply(camera.R, camera.t)
            found[name] = replace(camera, R=r, center=center)
    return found


def _reading(file: CalibrationFile, posed: list[RawCamera]) -> int:
    """Index of the convention of the unclear poses of a file. A warning explains the choice."""
    unclear = [camera for camera in posed if not camera.clear]
    if not unclear:
        return 0
    stated = str(file.get("convention") or file.get(0, "convention") or "").strip().lower()
    if stated in _STATED:
        return _STATED[stated]
    if stated in _ALLOWED:  # "shelf" of a format: the views may contradict
        unclear = [replace(camera, kind=stated) for camera in unclear]
    kind = unclear[0].kind
    first = _ALLOWED[kind][0]
    found = {index: _evidence(unclear, index) for index in _ALLOWED[kind]}
    best, other = sorted(found, key=lambda index: -found[index].total)[:2]
    margins = found[best].total - found[other].total, found[best].crossing - found[other].crossing
    if found[best].miss > _SURE:
        best = first
        why = "as in OpenCV" if not first else "as the key says" if first == 1 else "as is usual"
        why = f"{why}; the file does not say it; {_how(first)}"
    elif margins[0] <= _MARGIN or margins[1] <= _CROSSING_MARGIN:
        misses = f"{found[best].miss:.1%} and {found[other].miss:.1%} of the distance"
        doubt = f"the views do not decide, because the optical axes then meet to {misses}"
        why = f"but perhaps they are {_READINGS[other].text}: {doubt}; {_how(best, other)}"
    elif best == first:
        why = f"because the cameras then look at a common place; the file does not say it; {_how(best)}"
    else:
        why = f"because only then do the cameras look at a common place; {_how(best)}"
    if kind != "shelf" or best != first:
        keys = dict.fromkeys(str(unclear[0].locations[part].key).split(".")[-1] for part in ("R", "t"))
        warn_about(file.path, f"{' and '.join(keys)}: taken as {_READINGS[best].text}, {why}")
    return best


def _how(*readings: int) -> str:
    names = " or ".join(f'"{_READINGS[reading].name}"' for reading in readings)
    return f'to state it, add "convention": {names} to the file'


class _Evidence(NamedTuple):
    """Evidence of a reading: from its common point alone, and in total. ``miss``: error of this point."""

    crossing: float
    total: float
    miss: float


def _evidence(poses: list[RawCamera], reading: int) -> _Evidence:
    """Evidence of a reading of poses. The miss is a fraction of the distance of the common point, or of the
    spread of the cameras if the spread is smaller. The miss is infinite for fewer than three cameras, and 1
    for parallel axes."""
    count = len(poses)
    if count < 3:
        return _Evidence(0.0, 0.0, np.inf)
    pairs = [_READINGS[reading].apply(pose.rotation, pose.t) for pose in poses]
    r, centers = np.array([r for r, _ in pairs]), np.array([center for _, center in pairs])
    miss, away = _crossing(r[:, 2], centers)
    # if OpenGL's camera axes are possible, a rig that looks outwards would be one that looks inwards with
    # them
    outward = np.inf if poses[0].kind in ("camera", "center", "placed") else _OUTWARD + _AWAY * (count - away)
    crossing = _log_likelihood(miss, _MISS, 2 * count - 3) - min(_AWAY * away, outward)
    roll = _log_likelihood(_roll(r), _ROLL, 2 * count - 4) / 2
    rare = 0.0 if reading == _ALLOWED[poses[0].kind][0] else _READINGS[reading].rare
    return _Evidence(crossing, crossing + roll - rare, miss)


def _log_likelihood(error: float, deviation: float, freedom: int) -> float:
    return float(-min(freedom, _MOST_FREEDOM) * np.log(np.hypot(error, deviation)))


def _crossing(forward: Array, centers: Array) -> tuple[float, int]:
    """Find the point nearest to all optical axes (N, 3). Returns how far the axes miss this point, and how
    many cameras look away from it."""
    across = np.eye(3) - forward[:, :, None] * forward[:, None, :]
    matrix = across.sum(axis=0)
    spread = float(np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if np.linalg.eigvalsh(matrix)[0] <= _PARALLEL * len(centers) or spread == 0:
        return 1.0, 0
    away = np.linalg.solve(matrix, np.einsum("nij,nj->i", across, centers)) - centers
    scale = min(spread, float(np.linalg.norm(away, axis=1).mean()))
    miss = np.sqrt((np.einsum("nij,nj->ni", across, away) ** 2).sum(axis=1).mean())
    return float(miss / max(scale, 1e-12)), int((np.einsum("ni,ni->n", away, forward) <= 0).sum())


def _roll(r: Array) -> float:
    """Root mean square of the rolls of cameras (N, 3, 3) about one vertical, radians. A camera may be upright
    or on its side. The share of cameras that are upside down is added. The roll of a camera that looks along
    the vertical is unknown."""
    rolls = []
    for side in (0, 1):
        vertical = np.linalg.eigh(r[:, side].T @ r[:, side])[1][:, 0]
        up = r[:, 1 - side] @ vertical
        up = up if up.mean() > 0 else -up
        roll = float(np.sqrt(((r[:, side] @ vertical) ** 2).mean()) + (up < -_STEEP).mean())
        rolls.append(max(roll, _STEEP_ROLL) if np.abs(up).mean() < _STEEP else roll)
    return min(rolls)


# -- lenses

#: Largest p1 and p2 of plumb_bob, and smallest k3 and k4 of a fisheye, as fractions of k1 and k2.
_TANGENTIAL, _RADIAL = 0.05, 0.1
#: An angle of view is wide for plumb_bob if its tangent at the corner of the image is above this.
_WIDE = 0.9
#: A lens with at least this evidence for a fisheye causes no warning.
_CERTAIN = 3
_MOST_VALUES = 20_000
#: Patterns of keys: for lists of numbers of a lens; for single numbers of a lens; for lens models that this
#: package does not have.
_LISTS = re.compile(r"dist(?!ance)\w*|disto\w*|coeff?s?|coefficients|radial\w*|tangential\w*|poly\w*|lens")
_NUMBERS = re.compile(
    r"(?:cam)?[kpd][0-9]|xi|alpha|beta|omega|kappa\w*|(?:radial|tangential)\w+|\w*distortion"
)
_NEVER = ("xi", "beta", "omega")
#: Patterns of keys that hold the name of a lens model, and of names of models with distortion.
_KIND = re.compile("type|model|lens|projection|camera")
_NAMED = re.compile(
    r"fish[-_]?eye\d*|equi(?:distant)?|kannala.*|kb[48]|omni.*|mei|ds|e?ucm|fov|ocam.*|scaramuzza|atan|double.*"
)


def model_of_four(
    file: CalibrationFile, keys: Keys, values: Array, k: Array, stated: bool | None = None
) -> str:
    """Model of four coefficients of OpenCV: equidistant or plumb_bob. Warns if this is not certain.

    These facts are evidence for a fisheye: the shape 4 x 1 that ``cv2.fisheye`` returns, a skew, ``DIM``,
    "fisheye" in the name of the file or of a key, and a third and fourth number too large for p1 and p2 of a
    wide lens.

    Args:
        file: File that is being read.
        keys: Key path of the coefficients.
        values: Coefficients (4,).
        k: K (3, 3).
        stated: Whether the file says that the camera is a fisheye; None if the file does not say so.
    """
    if stated is not None or not values.any():
        return "equidistant" if stated else "plumb_bob"
    stored = file.get(*keys[:-1], "rows") is not None  # as in a matrix of OpenCV
    shape = tuple(str(file.get(*keys[:-1], key)) for key in ("rows", "cols"))  # XML has numbers as texts
    shape = shape if stored else tuple(map(str, shape_of(file.get(*keys)) or ()))
    own = file.get(*keys[: -2 if stored else -1])
    named = re.search("fish[-_]?eye", " ".join(map(str, (*keys, Path(file.path).stem))), re.IGNORECASE)
    high, low = np.abs(values[2:]).max(), max(np.abs(values[:2]).max(), 1e-12)
    wide = np.hypot(k[0, 2], k[1, 2]) > _WIDE * k[0, 0]
    evidence = (
        2 * (shape == ("4", "1"))
        + (shape == ("1", "4"))
        + 2 * bool(k[0, 1])
        + 3 * (named is not None or (isinstance(own, Mapping) and "DIM" in own))
        + (-2 if 0 < high <= _TANGENTIAL * low else 1 if wide and high > _RADIAL * low else -1)
    )
    model = "equidistant" if evidence > 0 else "plumb_bob"
    if 0 <= evidence < _CERTAIN or (evidence < 0 and stored):
        other = "plumb_bob" if evidence > 0 else "equidistant (cv2.fisheye)"
        what = f"{'.'.join(map(str, keys)).removesuffix('.data')}: 4 coefficients are assumed to be {model}"
        warn_about(file.path, f"{what}; if they are {other}, add distortion_model: {other.split()[0]}")
    return model


def other_lens(file: CalibrationFile) -> str:
    """Sentence that names the unknown lens model of a document; empty if there is none."""
    named = (
        f" Its lens {shape[:40]!r} is not supported; known are {', '.join(MODELS)}."
        for keys, shape in islice(leaves_of(file), _MOST_VALUES)
        if isinstance(shape, str) and _KIND.search(str(keys[-1:]).lower())
        if _NAMED.fullmatch(shape.strip().lower()) and model_of(shape) is None
    )
    return next(named, "")


def check_unread(file: CalibrationFile, cameras: Mapping[str, RawCamera]) -> None:
    """Warn if a document has lens values that are not used, and a camera has no distortion. A parameter of a
    lens model that this package does not have, such as xi, is enough for a warning."""
    fisheyes = any(c.model == "equidistant" for c in cameras.values())
    straight = any(not any(c.distortion) and c.model != "equidistant" for c in cameras.values())
    read = {float(v) for c in cameras.values() for v in (0.0, *c.distortion, *c.K.ravel(), *(c.size or ()))}
    file, unread = plain(file), []
    for keys, shape in islice(leaves_of(file), _MOST_VALUES):
        key = next((key.lower() for key in reversed(keys) if isinstance(key, str) and key != "data"), "")
        words = [word for word in re.split(r"[\W_]+", key) if word]
        if isinstance(shape, str) and not is_number(shape):
            if straight and not fisheyes and _KIND.search(key) and _NAMED.fullmatch(shape.strip().lower()):
                unread.append(f"{'.'.join(map(str, keys))} {shape[:40]!r}")
        elif words and (straight or words[-1] in _NEVER):
            count = 1 if isinstance(shape, str) else int(np.prod(shape))
            single = _NUMBERS.fullmatch("".join(words)) or _NUMBERS.fullmatch(words[-1])
            if single if count == 1 else count <= 14 and any(map(_LISTS.fullmatch, words)):
                with suppress(CameraError):
                    unread += [".".join(map(str, keys))] * (not {*file.some_numbers(*keys)} <= read)
    if unread:
        state = "give the coefficients as dist or k1, k2, p1, p2, k3, and distortion_model"
        shown = "cameras are shown without distortion" if straight else "the lens is another one"
        warn_about(file.path, f"{some_of(unread, 4)}: looks like a lens and is not read, {shown}: {state}")


def fitted_lens(file: CalibrationFile, what: str, ideal: Array, distorted: Array, focal: float) -> Lens:
    """Approximate a lens model that this package does not have. A warning states the error of the fit.

    Args:
        file: File that is being read.
        what: Name of the lens model, for the warning.
        ideal: Points (N, 2) of the normalised image plane, over the image.
        distorted: The same points (N, 2) after distortion.
        focal: Focal length, pixels.
    """
    lens, error = fit_lens(ideal, distorted)
    what = f"{what} is written as {lens.model}, which differs by {error * focal:.2g} pixels (RMS)"
    warn_about(file.path, what)
    return lens


_NONE = ("", "none", "null", "no", "pinhole")


def find_model(
    file: CalibrationFile, name: Any, distortion: Array, name_keys: Keys, distortion_keys: Keys
) -> str | None:
    """Find the distortion model of a file, and check its number of coefficients.

    Args:
        file: File that is being read.
        name: Name of the model in the file, or None.
        distortion: Coefficients, (N,).
        name_keys: Key path of the name.
        distortion_keys: Key path of the coefficients.

    Returns:
        Name of the model in :data:`humansim_ros.cameras.camera.lens.MODELS`, or None for a lens without
        distortion. If the file has no name, the number of coefficients decides if it is unique.

    Raises:
        CameraError: The model is unknown, or its number of coefficients is wrong.
    """
    word, known = "" if name is None else str(name).strip().lower(), ", ".join(MODELS)
    if word not in _NONE:
        model = model_of(word)
        if model is None:
            raise file.error(f"unknown distortion model {name!r}; known are {known}", *name_keys)
        file.check_count(model, distortion, distortion_keys)
        return model
    if not distortion.any():
        return None
    if word:
        message = f"is {word!r}, but there are distortion coefficients: name one of {known}"
        raise file.error(message, *name_keys)
    count = len(distortion)
    model = {5: "plumb_bob", 8: "rational_polynomial"}.get(count)
    if model is None:
        message = f"is missing, and {count} coefficients do not determine it: add one of {known}"
        raise file.error(message, *name_keys)
    key = ".".join(map(str, name_keys))
    warn_about(file.path, f"{key} is missing; {count} coefficients are taken for {model}")
    return model


# -- units

#: Key paths of the unit.
_UNIT_KEYS = tuple(
    (*table, key)
    for table in ((), ("metadata",), ("info",), ("CameraParameters1",))
    for key in ("unit", "units", "WorldUnits", "world_units", "length_unit", "translation_unit")
)


#: If the extent of a rig exceeds this number of units, the unit is millimetres. The number lies between a
#: room of 30 m, in metres, and a rig of 10 cm, in millimetres.
_MILLIMETRES = 50.0


def stated_unit(file: CalibrationFile) -> float | None:
    """Metres per unit of a file with a key such as ``unit``; None if no key states it. Raises CameraError for
    an unknown unit."""
    for keys in _UNIT_KEYS:
        value = file.get(*keys)
        if value is not None:
            unit = metres_of(str(value))
            if unit is None:
                raise file.error(f"is {str(value)[:30]!r}: use {', '.join(UNITS)}", *keys)
            return unit
    return None


def find_unit(file: CalibrationFile, cameras: Mapping[str, RawCamera]) -> float:
    """Metres per unit of a file. The key ``unit`` decides, or else the extent of the rig: metres or
    millimetres. If the unit is guessed, a HumansimWarning says so. Raises CameraError for an unknown unit."""
    stated = stated_unit(file)
    if stated is not None:
        return stated
    positions = np.array([camera.position for camera in cameras.values() if camera.R is not None])
    if not len(positions):
        return 1.0
    # the origin counts too, since it is the first camera or the board
    extent = float(np.linalg.norm(np.ptp(np.vstack([positions, np.zeros(3)]), axis=0)))
    if extent == 0:
        return 1.0
    name = "mm" if extent > _MILLIMETRES else "m"
    others = ", ".join(f"{extent * m:.5g} m with {u}" for u, m in sorted(UNITS.items()) if u != name)
    why = f"because the cameras are then {extent * UNITS[name]:.3g} m apart ({others})"
    hint = f'to state it, set unit, or add unit = "{name}" to the file'
    warn_about(file.path, f"the unit is not in the file; {name} is assumed, {why}; {hint}")
    return UNITS[name]
