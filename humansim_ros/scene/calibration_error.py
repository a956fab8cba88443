"""Error of a published calibration: a constant one, and the motion of a camera away from its calibration."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from humansim_ros.camera import Camera
from humansim_ros.rotations import rotation_vector_to_matrix
from humansim_ros.scene.fault_config import CalibrationFault
from humansim_ros.types import Array


@dataclass(frozen=True, eq=False)
class CalibrationError:
    """Error of the published calibration of a camera.

    Attributes:
        rotation: Rotation (3, 3) from the optical frame of the scene to the published one.
        translation: (3,) from the position of the scene to the published one, metres in ``map``.
        focal: Published focal lengths relative to those of the camera.
        turn: Motion of the true optical frame: rotation vector (3,), radians per second, in it.
        shift: Motion of the true position: (3,) metres per second in ``map``.
    """

    rotation: Array
    translation: Array
    focal: float
    turn: Array
    shift: Array

    @classmethod
    def drawn(cls, config: CalibrationFault, random: np.random.Generator) -> CalibrationError:
        """Draw the directions of an error."""
        directions = random.standard_normal((4, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        turned, moved, turn, shift = directions
        sign = 1 if random.random() < 0.5 else -1
        drift = config.drift
        return cls(
            rotation_vector_to_matrix(np.radians(config.rotation) * turned),
            config.translation * moved,
            1 + sign * config.focal,
            (0.0 if drift is None else np.radians(drift.rotation) / 60) * turn,
            (0.0 if drift is None else drift.translation / 60) * shift,
        )

    @property
    def drifts(self) -> bool:
        """Whether the camera moves away from its calibration."""
        return bool(self.turn.any() or self.shift.any())

    def moved(self, seconds: float) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,) of the true camera at a scene time in seconds."""
        return rotation_vector_to_matrix(seconds * self.turn), seconds * self.shift

    def published(self, camera: Camera) -> Camera:
        """Camera with the published focal lengths, at the same pose."""
        if self.focal == 1:
            return camera
        k, rectified = camera.K.copy(), camera.rectified
        k[:2, :2] *= self.focal
        if rectified is not None:
            rectified = rectified.copy()
            rectified[:2, [0, 1, 3]] *= self.focal
        return replace(camera, K=k, rectified=rectified)

    def size(self, seconds: float) -> dict[str, float]:
        """Difference of what is published from the true camera at a scene time in seconds.

        Returns:
            ``rotation``: degrees; ``translation``: metres; ``focal``: share of the true focal length.
        """
        turned, shifted = self.moved(seconds)
        # not from the trace, whose cosine has no digits left at small angles
        skew = self.rotation @ turned.T
        sine = np.linalg.norm([skew[2, 1] - skew[1, 2], skew[0, 2] - skew[2, 0], skew[1, 0] - skew[0, 1]]) / 2
        angle = np.arctan2(sine, (np.trace(skew) - 1) / 2)
        return {
            "rotation": float(np.degrees(angle)),
            "translation": float(np.linalg.norm(self.translation - shifted)),
            "focal": self.focal - 1,
        }
