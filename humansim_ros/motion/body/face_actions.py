"""Actions of the face, with the names of Apple's ARKit. MakeHuman's faces and face trackers share these
names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Literal, get_args

import numpy as np

from humansim_ros.errors import MotionError, unknown
from humansim_ros.files.reading import read_table
from humansim_ros.motion.body.rated import Rated
from humansim_ros.types import Array

_SIDED = "{}Left", "{}Right"


def _both(*names: str) -> list[str]:
    return [side.format(name) for name in names for side in _SIDED]


_TABLE = read_table("faces")
#: Names of the 52 actions [Apple, ARFaceAnchor.BlendShapeLocation], sorted. Weights are from 0 to 1.
ACTIONS: tuple[str, ...] = tuple(_TABLE["actions"])
_NUMBERS = {name: number for number, name in enumerate(ACTIONS)}


def both_sides(weights: Mapping[str, float]) -> dict[str, float]:
    """Weights by action. Names without a side stand for both sides.

    Example:
        >>> both_sides({"mouthSmile": 0.5, "jawOpen": 0.2})
        {'mouthSmileLeft': 0.5, 'mouthSmileRight': 0.5, 'jawOpen': 0.2}
    """
    return {
        each: weight
        for name, weight in weights.items()
        for each in ((name,) if name in _NUMBERS else _both(name))
    }


def face_weights(weights: Mapping[str, float], names: Iterable[str] = ACTIONS) -> Array:
    """Weights (S,) in the order of ``names``, from weights by name. Actions without a weight get 0.

    Raises:
        MotionError: There is no such action, or a weight is not from 0 to 1.

    Example:
        >>> float(face_weights({"jawOpen": 0.5})[ACTIONS.index("jawOpen")])
        0.5
    """
    numbers = _NUMBERS if names is ACTIONS else {name: number for number, name in enumerate(names)}
    out = np.zeros(len(numbers))
    for name, weight in weights.items():
        if name not in numbers:
            message = unknown("action of the face", name, numbers, most=5)
            raise MotionError(f"{message} (docs/faces.md)")
        if not 0 <= weight <= 1:  # refuses NaN too
            raise MotionError(f"the weight of {name} must be from 0 to 1, not {weight!r}")
        out[numbers[name]] = weight
    return out


#: Actions for each action unit of FACS [Ekman 1978], without their sides.
_UNITS: dict[int, str] = {int(unit): action for unit, action in _TABLE["units"].items()}
ExpressionName = Literal["neutral", "happiness", "sadness", "surprise", "fear", "anger", "disgust"]
#: Action units of the six basic emotions [Friesen 1983]. The weights look natural on the built-in humans.
EXPRESSIONS: dict[str, dict[int, float]] = {
    name: {int(unit): weight for unit, weight in units.items()}
    for name, units in _TABLE["expressions"].items()
}
assert tuple(EXPRESSIONS) == get_args(ExpressionName)


def expression(name: str) -> Mapping[str, float]:
    """Weights by action for an expression at full strength: ``neutral`` or one of the six basic emotions.

    Raises:
        MotionError: There is no such expression.

    Example:
        >>> expression("surprise")["jawOpen"]
        0.4
    """
    if name not in EXPRESSIONS:
        raise MotionError(unknown("expression", name, EXPRESSIONS))
    return both_sides({_UNITS[unit]: weight for unit, weight in EXPRESSIONS[name].items()})


#: Weights of a face at rest.
FACE_AT_REST = Rated.at_rest(ACTIONS, (len(ACTIONS),), (0.0, 1.0))
