"""Kalman filter of the joints of one person: constant velocity, driven by white noise of the acceleration.

It is an information filter: a measurement is a system A x = b of :mod:`triangulation`, which may be singular.
Joints are independent of each other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Standard deviations of joints that have not been measured: from the middle of the person, metres, and m/s.
_UNKNOWN_POSITION, _UNKNOWN_VELOCITY = 2.0, 3.0


class KalmanFilter:
    """Positions and velocities of J joints.

    Args:
        joints: Number of joints.
        middle: Middle of the person, (3,) metres in ``map``.
        acceleration: Spectral density of the acceleration noise, m/s² per root of a hertz. A larger one
            follows quick motions, a smaller one smooths more.

    Attributes:
        mean: (J, 6) positions in metres and velocities in m/s, in ``map``.
        covariance: (J, 6, 6).
    """

    def __init__(self, joints: int, middle: Array, acceleration: float) -> None:
        self.mean = np.tile([*middle, 0.0, 0.0, 0.0], (joints, 1))
        variances = np.repeat([_UNKNOWN_POSITION**2, _UNKNOWN_VELOCITY**2], 3)
        self.covariance = np.tile(np.diag(variances), (joints, 1, 1))
        self._density = acceleration**2

    @property
    def positions(self) -> Array:
        """(J, 3) metres."""
        return self.mean[:, :3]

    @property
    def velocities(self) -> Array:
        """(J, 3) m/s."""
        return self.mean[:, 3:]

    @property
    def deviations(self) -> Array:
        """Standard deviations (J,) of the positions along their worst axis, metres."""
        return np.sqrt(np.linalg.eigvalsh(self.covariance[:, :3, :3])[:, -1])

    def predict(self, seconds: float) -> None:
        """Move the state on by a time."""
        eye, dt = np.eye(3), seconds
        transition = np.block([[eye, dt * eye], [0 * eye, eye]])
        noise = np.block([[dt**3 / 3 * eye, dt**2 / 2 * eye], [dt**2 / 2 * eye, dt * eye]])
        self.mean = self.mean @ transition.T
        self.covariance = transition @ self.covariance @ transition.T + self._density * noise

    def update(self, a: Array, b: Array, noise: float) -> None:
        """Take in measurements.

        Args:
            a: A of the rays of each joint, (J, 3, 3) pixels² per metre²; zero for joints without rays.
            b: b of them, (J, 3).
            noise: Standard deviation of the detections, pixels.
        """
        information = np.linalg.inv(self.covariance)
        information[:, :3, :3] += a / noise**2
        covariance = np.linalg.inv(information)
        self.covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
        innovation = (b - np.einsum("jab,jb->ja", a, self.positions)) / noise**2
        self.mean = self.mean + np.einsum("jab,jb->ja", self.covariance[:, :, :3], innovation)
