"""Lenses that a file does not name: four coefficients of OpenCV; and a warning for keys of a lens that are
not read.

``cv2.calibrateCamera`` returns five coefficients or more. Four coefficients are either those of
``cv2.fisheye`` (k1 to k4), or plumb_bob without k3, as other programs write it (k1, k2, and small p1, p2).
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path

import numpy as np

from humansim_ros.cameras.camera.lens import MODELS
from humansim_ros.cameras.formats.base import CalibrationFile, Keys, RawCamera, is_number, model_of
from humansim_ros.cameras.formats.spellings import leaves_of, plain, shape_of
from humansim_ros.errors import CameraError, some_of, warn_about
from humansim_ros.types import Array

#: Largest p1 and p2 of plumb_bob, and smallest k3 and k4 of a fisheye, as fractions of k1 and k2.
_TANGENTIAL, _RADIAL = 0.05, 0.1
#: An angle of view is wide for plumb_bob if its tangent at the corner of the image is above this.
_WIDE = 0.9
#: A lens with at least this evidence for a fisheye causes no warning.
_CERTAIN = 3
_MOST_VALUES = 20_000
#: Words of keys for lists of numbers of a lens; keys of its single numbers; keys of lenses that cameras do
#: not have.
_LISTS = re.compile(r"dist(?!ance)\w*|disto\w*|coeff?s?|coefficients|radial\w*|tangential\w*|poly\w*|lens")
_NUMBERS = re.compile(
    r"(?:cam)?[kpd][0-9]|xi|alpha|beta|omega|kappa\w*|(?:radial|tangential)\w+|\w*distortion"
)
_NEVER = ("xi", "beta", "omega")
#: Pattern of keys that name a lens, and names that a camera without distortion does not have.
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
    """Sentence that names a lens which cameras do not have, if a document has one; else empty."""
    named = (
        f" Its lens {shape[:40]!r} is not supported; known are {', '.join(MODELS)}."
        for keys, shape in islice(leaves_of(file), _MOST_VALUES)
        if isinstance(shape, str) and _KIND.search(str(keys[-1:]).lower())
        if _NAMED.fullmatch(shape.strip().lower()) and model_of(shape) is None
    )
    return next(named, "")


def check_unread(file: CalibrationFile, cameras: Mapping[str, RawCamera]) -> None:
    """Warn if a document has lens values that are not used, and a camera has no distortion. A parameter of a
    lens that no camera can have, such as xi, is enough for a warning."""
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
