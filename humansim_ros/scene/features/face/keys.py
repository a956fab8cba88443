"""Keys of faces. The module imports neither meshes nor motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from humansim_ros.motion.body import ExpressionName

#: Gaze without a target: the eyes look ahead.
AHEAD = "ahead"


@dataclass(frozen=True)
class FaceKey:
    """What a face does from a time on. Everything that the key does not name goes on as before.

    Attributes:
        time: Seconds of the scene.
        expression: Name of an expression, and its ``strength`` from 0 to 1.
        actions: Weights by action, in addition to the expression.
        gaze: Point (3,) in ``map``, name of a human or a camera, or :data:`AHEAD`.
        speak: Seconds for which the face speaks.
        blend: Seconds over which expression and actions change from those of the key before.
    """

    time: float = 0.0
    expression: ExpressionName | None = None
    strength: float = 1.0
    actions: Mapping[str, float] | None = None
    gaze: str | tuple[float, float, float] | None = None
    speak: float | None = None
    blend: float = 0.3
