"""Actions of the face in the names of Apple's ARKit, which MakeHuman's faces and face trackers share."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from humansim_ros.errors import MotionError, did_you_mean
from humansim_ros.types import Array

_SIDED = "{}Left", "{}Right"


def _both(*names: str) -> list[str]:
    return [side.format(name) for name in names for side in _SIDED]


#: Names of the 52 actions [Apple, ARFaceAnchor.BlendShapeLocation], sorted. Weights are from 0 to 1.
ACTIONS: tuple[str, ...] = tuple(
    sorted(
        [
            *_both("browDown", "browOuterUp", "cheekSquint", "eyeBlink", "eyeLookDown", "eyeLookIn"),
            *_both("eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide", "mouthDimple", "mouthFrown"),
            *_both("mouthLowerDown", "mouthPress", "mouthSmile", "mouthStretch", "mouthUpperUp", "noseSneer"),
            *("browInnerUp", "cheekPuff", "jawForward", "jawLeft", "jawOpen", "jawRight", "mouthClose"),
            *("mouthFunnel", "mouthLeft", "mouthPucker", "mouthRight", "mouthRollLower", "mouthRollUpper"),
            *("mouthShrugLower", "mouthShrugUpper", "tongueOut"),
        ]
    )
)
_NUMBERS = {name: number for number, name in enumerate(ACTIONS)}


def face_weights(weights: Mapping[str, float], names: Iterable[str] = ACTIONS) -> Array:
    """Weights (S,) in the order of ``names`` from weights by name; others are 0.

    Raises:
        MotionError: There is no such action, or a weight is not from 0 to 1.

    Example:
        >>> face_weights({"jawOpen": 0.5})[ACTIONS.index("jawOpen")]
        0.5
    """
    numbers = _NUMBERS if names is ACTIONS else {name: number for number, name in enumerate(names)}
    out = np.zeros(len(numbers))
    for name, weight in weights.items():
        if name not in numbers:
            hint = did_you_mean(name, numbers)
            raise MotionError(
                f"no action of the face {name[:40]!r}{hint}; the actions are the {len(numbers)} of ARKit, "
                "such as jawOpen, eyeBlinkLeft or mouthSmileRight (docs/faces.md)"
            )
        if not 0 <= weight <= 1:  # refuses NaN too
            raise MotionError(f"the weight of {name} must be from 0 to 1, not {weight!r}")
        out[numbers[name]] = weight
    return out
