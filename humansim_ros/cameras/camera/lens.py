"""Lens distortion models: from points of the normalised image plane (x / z, y / z) to distorted points.

The models and their coefficients are as in CameraInfo of ROS (``distortion_model`` of REP-104) and of
OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.errors import CameraError
from humansim_ros.types import Array

#: Coefficients of each model, in the order of CameraInfo.
MODELS = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
#: Largest angle to the optical axis, radians. Beyond it, the depth along z is almost zero.
_MAX_ANGLE = np.radians(89.5)
#: Number of angles, and of directions, at which a lens is tested for folding back over itself.
_ANGLES, _DIRECTIONS = 1000, 24
#: Most Newton steps to invert a distortion, and tolerance of the result on the normalised image plane.
_STEPS, _TOLERANCE = 30, 1e-10


@dataclass(frozen=True)
class Lens:
    """Distortion model and its coefficients. ``model``: one of :data:`MODELS`.

    ``plumb_bob`` is the radial and tangential model of [Brown 1971]. ``rational_polynomial`` adds a
    denominator. ``equidistant`` is the fisheye model of [Kannala 2006]. Beyond :attr:`valid_radius` a model
    folds back over itself, so rays beyond it are not visible.
    """

    model: str
    coefficients: tuple[float, ...]

    @classmethod
    def of(cls, coefficients: ArrayLike, model: str | None = None) -> Lens:
        """Create a lens from coefficients with or without trailing zeros.

        If ``model`` is None, up to 5 coefficients are plumb_bob, and up to 8 are rational_polynomial.

        Raises:
            CameraError: The model is unknown, there are too many coefficients, or a number is not finite.
        """
        try:
            values = [float(d) for d in np.asarray(coefficients, dtype=float).ravel()]
        except (TypeError, ValueError):
            raise CameraError("the distortion coefficients must be numbers", key="distortion") from None
        if not np.isfinite(values).all():
            raise CameraError("a distortion coefficient is not finite (NaN or infinity)", key="distortion")
        used = 1 + max((i for i, value in enumerate(values) if value), default=-1)
        if model is None:
            model = "plumb_bob" if used <= 5 else "rational_polynomial"
        if model not in MODELS:
            message = f"unknown distortion model {model!r}; known are {', '.join(MODELS)}"
            raise CameraError(message, key="model")
        count = len(MODELS[model])
        if used > count:
            hint = "" if model == "equidistant" else "; thin prism and tilted sensor models are not supported"
            message = f"{model} has {count} coefficients ({' '.join(MODELS[model])}), not {used}{hint}"
            raise CameraError(message, key="distortion")
        return cls(model, tuple((values + [0.0] * count)[:count]))

    @property
    def ideal(self) -> bool:
        """Whether the lens has no distortion. A fisheye lens always has."""
        return self.model != "equidistant" and not any(self.coefficients)

    def distort(self, points: ArrayLike) -> Array:
        """Distort points (..., 2) of the normalised image plane. Beyond :attr:`valid_radius`, they become
        NaN."""
        n = np.asarray(points, dtype=float)
        if self.ideal:
            return n
        with np.errstate(all="ignore"):  # rays beyond the valid radius may overflow
            valid = np.einsum("...i,...i->...", n, n) <= self.valid_radius**2
            return np.where(valid[..., None], self._distort(n), np.nan)

    def undistort(self, points: ArrayLike) -> Array:
        """Invert :meth:`distort` for points (..., 2), with errors up to 1e-10. Points that no valid ray
        reaches become NaN."""
        d = np.asarray(points, dtype=float)
        if self.ideal:
            return d
        flat = d.reshape(-1, 2)
        result = np.full_like(flat, np.nan)
        active = np.flatnonzero(np.isfinite(flat).all(axis=1))
        n = self._first_guess(flat[active])
        for _ in range(_STEPS):
            if not len(active):
                break
            with np.errstate(all="ignore"):
                error = self._distort(n) - flat[active]
                size = np.maximum(np.abs(flat[active]).max(axis=1), 1.0)
                converged = np.abs(error).max(axis=1) < _TOLERANCE * size
                inside = np.einsum("ij,ij->i", n, n) <= self.valid_radius**2 * (1 + 1e-12)
                result[active[converged & inside]] = n[converged & inside]
                remaining = ~converged & np.isfinite(error).all(axis=1)
                n, active = n[remaining], active[remaining]
                n = self._within(n - _solve(self._jacobian(n), error[remaining]))
        return result.reshape(d.shape)

    @cached_property
    def valid_radius(self) -> float:
        """Tangent of the largest angle to the optical axis for which the distortion is one-to-one. At this
        angle, in some direction, the Jacobian of the distortion is singular or a denominator is zero. The
        angle is at most 89.5 degrees."""
        if self.ideal:
            return float(np.tan(_MAX_ANGLE))
        low, high = 0.0, _MAX_ANGLE
        for count in (_ANGLES, 100, 100, 100):
            angles = np.linspace(low, high, count + 1)[1:]
            valid = self._unfolded(angles)
            first = int(np.argmin(valid)) if not valid.all() else -1
            if first < 0:
                return float(np.tan(high))
            low, high = (angles[first - 1] if first else low), angles[first]
        return float(np.tan(low))

    def jacobian(self, points: ArrayLike) -> Array:
        """Derivative (..., 2, 2) of :meth:`distort` at (..., 2)."""
        n = np.asarray(points, dtype=float)
        return np.broadcast_to(np.eye(2), (*n.shape, 2)) if self.ideal else self._jacobian(n)

    def _unfolded(self, angles: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        directions = np.linspace(0, 2 * np.pi, _DIRECTIONS, endpoint=False)
        circle = np.column_stack([np.cos(directions), np.sin(directions)])
        n = np.tan(angles)[:, None, None] * circle
        with np.errstate(all="ignore"):
            # the limit is exactly zero, since a lens that maps the whole plane to a disc has tiny
            # determinants
            valid = np.linalg.det(self._jacobian(n)) > 0
            if self.model == "rational_polynomial":
                valid &= self._radial(np.einsum("...i,...i->...", n, n))[2] > 0
            return np.asarray(valid.all(axis=1))

    def _ratio(self, r2: Array) -> tuple[Array, Array | float]:
        """Numerator and denominator of the radial factor at squared radii ``r2``."""
        k1, k2, _, _, k3, *more = self.coefficients
        numerator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if not more:
            return numerator, 1.0
        k4, k5, k6 = more
        return numerator, 1 + r2 * (k4 + r2 * (k5 + r2 * k6))

    def _radial(self, r2: Array) -> tuple[Array, Array, Array]:
        """Factor of the radial part, its derivative with respect to r squared, and its denominator."""
        k1, k2, _, _, k3, *more = self.coefficients
        k4, k5, k6 = more or (0.0, 0.0, 0.0)
        numerator, denominator = self._ratio(r2)
        slope = k1 + r2 * (2 * k2 + r2 * 3 * k3), k4 + r2 * (2 * k5 + r2 * 3 * k6)
        return (
            numerator / denominator,
            (slope[0] * denominator - numerator * slope[1]) / denominator**2,
            denominator * np.ones_like(r2),
        )

    def _angle(self, r: Array) -> tuple[Array, Array]:
        """Distorted angle of rays at a radius in the equidistant model, and its derivative with respect to
        the radius."""
        k1, k2, k3, k4 = self.coefficients
        angle = np.arctan(r)
        a2 = angle * angle
        distorted = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        slope = 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))
        return distorted, slope / (1 + r * r)

    def _distort(self, n: Array) -> Array:
        x, y = n[..., 0], n[..., 1]
        r2 = x * x + y * y
        if self.model == "equidistant":
            r = np.sqrt(r2)
            factor = np.where(r > 1e-8, self._angle(r)[0] / np.where(r > 1e-8, r, 1.0), 1.0)
            return n * factor[..., None]
        p1, p2 = self.coefficients[2:4]
        numerator, denominator = self._ratio(r2)
        factor, xy = numerator / denominator, 2 * x * y
        distorted = np.empty_like(n)
        distorted[..., 0] = x * factor + (p1 * xy + p2 * (r2 + 2 * x * x))
        distorted[..., 1] = y * factor + (p1 * (r2 + 2 * y * y) + p2 * xy)
        return distorted

    def _jacobian(self, n: Array) -> Array:
        x, y = n[..., 0], n[..., 1]
        r2 = x * x + y * y
        if self.model == "equidistant":
            r = np.maximum(np.sqrt(r2), 1e-8)
            distorted, slope = self._angle(r)
            factor, bend = distorted / r, (slope - distorted / r) / (r * r)
            extra = np.zeros((*n.shape, 2))
        else:
            p1, p2 = self.coefficients[2:4]
            factor, bend, _ = self._radial(r2)
            bend = 2 * bend
            across = 2 * p1 * x + 2 * p2 * y
            extra = np.stack([2 * p1 * y + 6 * p2 * x, across, across, 6 * p1 * y + 2 * p2 * x], axis=-1)
            extra = extra.reshape(*n.shape, 2)
        outer = n[..., :, None] * n[..., None, :]
        return np.asarray(factor[..., None, None] * np.eye(2) + bend[..., None, None] * outer + extra)

    @cached_property
    def _radii(self) -> tuple[Array, Array]:
        """Sampled radii, and the same radii after the radial distortion. Both are ascending."""
        r = np.tan(np.linspace(0, np.arctan(self.valid_radius), 4 * _ANGLES))
        if self.model == "equidistant":
            return r, np.maximum.accumulate(self._angle(r)[0])
        return r, np.maximum.accumulate(r * self._radial(r * r)[0])

    def _first_guess(self, d: Array) -> Array:
        r, distorted = self._radii
        length = np.sqrt(np.einsum("ij,ij->i", d, d))
        factor = np.interp(length, distorted, r) / np.maximum(length, 1e-12)
        return np.asarray(d * np.where(length > 1e-12, factor, 1.0)[:, None], dtype=float)

    def _within(self, n: Array) -> Array:
        """Move the points (N, 2) that are beyond the valid radius onto this radius. Other points stay."""
        length = np.sqrt(np.einsum("ij,ij->i", n, n))
        return np.asarray(n * np.minimum(1.0, self.valid_radius / np.maximum(length, 1e-12))[:, None])


def _solve(matrices: Array, vectors: Array) -> Array:
    """Solve A x = b for 2x2 matrices (N, 2, 2)."""
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    u, v = vectors.T
    return np.asarray(np.stack([d * u - b * v, a * v - c * u], axis=1) / (a * d - b * c)[:, None])


def fit_lens(ideal: ArrayLike, distorted: ArrayLike) -> tuple[Lens, float]:
    """Fit a lens to points (N, 2) of the normalised image plane. ``distorted``: the same points after
    distortion.

    Returns:
        The lens, and the root mean square of its errors. The model of the lens is plumb_bob, or
        rational_polynomial if this model fits better.
    """
    import scipy  # imported here, since the import is slow

    points, places = np.asarray(ideal, dtype=float), np.asarray(distorted, dtype=float)

    def fitted(model: str, start: Array) -> tuple[Lens, float]:
        def errors(values: Array) -> Array:
            return np.asarray(Lens(model, tuple(values))._distort(points) - places).ravel()

        solution = scipy.optimize.least_squares(errors, start, method="lm", xtol=1e-15, ftol=1e-15)
        lens = Lens(model, tuple(float(v) for v in solution.x))
        return lens, float(np.sqrt((errors(solution.x) ** 2).sum() / len(points)))

    simple = fitted("plumb_bob", np.zeros(5))
    if simple[1] < 1e-6:
        return simple
    rational = fitted("rational_polynomial", np.array([*simple[0].coefficients, 0, 0, 0]))
    return rational if rational[1] < simple[1] / 2 else simple
