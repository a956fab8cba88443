"""Which lens a file means: names of distortion models, and how many coefficients go with them."""

from __future__ import annotations

from typing import Any

import numpy as np

from humansim_ros.camera.formats.base import CalibrationSource, Key
from humansim_ros.camera.lens import MODELS
from humansim_ros.errors import warn_about
from humansim_ros.types import Array

COUNTS = {model: len(coefficients) for model, coefficients in MODELS.items()}
#: How many coefficients each model comes with in files; more may follow where they are zero.
_IN_FILES = {"plumb_bob": (4, 5), "rational_polynomial": (8,), "equidistant": (4,)}
_ALIASES = {
    **dict.fromkeys(("fisheye", "kannala_brandt", "kannala_brandt4", "equi"), "equidistant"),
    **dict.fromkeys(("radtan", "radial-tangential", "brown_conrady", "brown"), "plumb_bob"),
    "rational": "rational_polynomial",
}
_NONE = ("", "none", "null", "no", "pinhole")
_THERE = ", ".join(MODELS)


def lens_of(
    source: CalibrationSource,
    named: Any,
    distortion: Array,
    named_at: tuple[Key, ...],
    given_at: tuple[Key, ...],
) -> str | None:
    """Our name of the distortion model that a file names, if its coefficients (N,) go with it.

    ``named_at``, ``given_at``: where they are said. Without a name, it is told by the number of coefficients
    where that is possible; None is a lens without distortion.
    """
    word = "" if named is None else str(named).strip().lower()
    if word in _NONE:
        return _unnamed(source, word, distortion, named_at)
    model = _ALIASES.get(word, word)
    if model not in MODELS:
        raise source.error(f"no distortion model {named!r} is known here; there are {_THERE}", *named_at)
    check_count(source, model, distortion, given_at)
    return model


def check_count(source: CalibrationSource, model: str, distortion: Array, given_at: tuple[Key, ...]) -> None:
    """That there are as many coefficients as the model has."""
    counts = _IN_FILES[model]
    used = len(np.trim_zeros(distortion, "b"))
    if used and (used > max(counts) or len(distortion) < min(counts)):
        count = " or ".join(map(str, counts))
        hint = "; thin prisms and tilted sensors are not known here" if len(distortion) > 8 else ""
        raise source.error(f"{model} has {count} coefficients, not {len(distortion)}{hint}", *given_at)


def _unnamed(
    source: CalibrationSource, word: str, distortion: Array, named_at: tuple[Key, ...]
) -> str | None:
    if not distortion.any():
        return None
    if word:
        raise source.error(
            f"says {word!r}, but there are distortion coefficients: say one of {_THERE}", *named_at
        )
    count = len(distortion)
    model = {5: "plumb_bob", 8: "rational_polynomial"}.get(count)
    if model is None:
        raise source.error(
            f"is missing, and {count} coefficients do not tell which it is: add one of {_THERE}", *named_at
        )
    key = ".".join(map(str, named_at))
    warn_about(source.path, f"{key} is missing; {count} coefficients are taken for {model}")
    return model
