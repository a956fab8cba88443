"""Distortion models of calibration files: their names in files, and their numbers of coefficients."""

from __future__ import annotations

from typing import Any

import numpy as np

from humansim_ros.camera.formats.base import CalibrationFile, Key
from humansim_ros.camera.lens import MODELS
from humansim_ros.errors import warn_about
from humansim_ros.types import Array

COUNTS = {model: len(coefficients) for model, coefficients in MODELS.items()}
#: Numbers of coefficients of each model in files; more coefficients may follow if they are zero.
_FILE_COUNTS = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
_ALIASES = {
    **dict.fromkeys(("fisheye", "kannala_brandt", "kannala_brandt4", "equi"), "equidistant"),
    **dict.fromkeys(("radtan", "radial-tangential", "brown_conrady", "brown"), "plumb_bob"),
    "rational": "rational_polynomial",
}
_NONE = ("", "none", "null", "no", "pinhole")
_KNOWN = ", ".join(MODELS)


def find_model(
    file: CalibrationFile,
    name: Any,
    distortion: Array,
    name_keys: tuple[Key, ...],
    distortion_keys: tuple[Key, ...],
) -> str | None:
    """Find the distortion model of a file, and check its number of coefficients.

    Args:
        file: File that is being read.
        name: Name of the model in the file, or None.
        distortion: Coefficients, (N,).
        name_keys: Key path of the name.
        distortion_keys: Key path of the coefficients.

    Returns:
        Name of the model in :data:`humansim_ros.camera.lens.MODELS`, or None for a lens without distortion.
        Without a name, the number of coefficients decides where it can.

    Raises:
        CameraError: The model is unknown, or its number of coefficients is wrong.
    """
    word = "" if name is None else str(name).strip().lower()
    if word in _NONE:
        return _model_without_name(file, word, distortion, name_keys)
    model = _ALIASES.get(word, word)
    if model not in MODELS:
        raise file.error(f"unknown distortion model {name!r}; known are {_KNOWN}", *name_keys)
    check_count(file, model, distortion, distortion_keys)
    return model


def check_count(
    file: CalibrationFile, model: str, distortion: Array, distortion_keys: tuple[Key, ...]
) -> None:
    """Raise CameraError if the number of coefficients does not fit the model.

    Args:
        file: File that is being read.
        model: Name of the distortion model.
        distortion: Coefficients, (N,).
        distortion_keys: Key path of the coefficients.
    """
    counts = _FILE_COUNTS[model]
    used = len(np.trim_zeros(distortion, "b"))
    if used and (used > max(counts) or len(distortion) < min(counts)):
        count = " or ".join(map(str, counts))
        hint = "; thin prism and tilted sensor models are not supported" if len(distortion) > 8 else ""
        raise file.error(f"{model} has {count} coefficients, not {len(distortion)}{hint}", *distortion_keys)


def _model_without_name(
    file: CalibrationFile, word: str, distortion: Array, name_keys: tuple[Key, ...]
) -> str | None:
    if not distortion.any():
        return None
    if word:
        raise file.error(
            f"is {word!r}, but there are distortion coefficients: name one of {_KNOWN}", *name_keys
        )
    count = len(distortion)
    model = {5: "plumb_bob", 8: "rational_polynomial"}.get(count)
    if model is None:
        raise file.error(
            f"is missing, and {count} coefficients do not determine it: add one of {_KNOWN}",
            *name_keys,
        )
    key = ".".join(map(str, name_keys))
    warn_about(file.path, f"{key} is missing; {count} coefficients are taken for {model}")
    return model
