"""Lens distortion: where a ray through the normalised image plane (x / z, y / z) really falls.

The models and their coefficients are those of ROS's CameraInfo (REP-104's ``distortion_model``) and OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from humansim_ros.errors import CameraError
from humansim_ros.types import Array

#: Coefficients of each model, in CameraInfo's order.
MODELS = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}
#: Rays farther from the axis than this are not seen: their depth along z is next to nothing.
_WIDEST = np.radians(89.5)
#: Angles and directions at which a lens is looked at to find where it begins to fold.
_ANGLES, _DIRECTIONS = 1000, 24
#: Newton steps to undo a distortion, and how near it must come (normalised image plane).
_STEPS, _NEAR_ENOUGH = 30, 1e-10


@dataclass(frozen=True)
class Lens:
    """A lens of one of :data:`MODELS`. ``coefficients``: as many as the model has.

    ``plumb_bob`` is Brown's radial and tangential model, ``rational_polynomial`` adds a denominator,
    ``equidistant`` is the fisheye of Kannala and Brandt (2006). Points farther out than
    :attr:`valid_radius`, where the model folds back over itself, are not seen.
    """

    model: str
    coefficients: tuple[float, ...]

    @classmethod
    def of(cls, coefficients: ArrayLike, model: str | None = None) -> Lens:
        """A lens of coefficients as they stand in files: zeros at the end may be left out or added.

        Without ``model``, up to 5 coefficients are plumb_bob and up to 8 are rational_polynomial. Raises
        CameraError for a model that is not known, too many coefficients, or numbers that are not finite.
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
            raise CameraError(f"no distortion model {model!r}; there are {', '.join(MODELS)}", key="model")
        count = len(MODELS[model])
        if used > count:
            hint = "" if model == "equidistant" else "; thin prisms and tilted sensors are not rendered"
            raise CameraError(
                f"{model} has {count} coefficients ({' '.join(MODELS[model])}), not {used}{hint}",
                key="distortion",
            )
        return cls(model, tuple((values + [0.0] * count)[:count]))

    @property
    def ideal(self) -> bool:
        """Whether it distorts nothing. A fisheye always does."""
        return self.model != "equidistant" and not any(self.coefficients)

    def distort(self, points: ArrayLike) -> Array:
        """Where rays through (..., 2) of the normalised image plane fall on it behind the lens, (..., 2).

        Rays beyond :attr:`valid_radius` give NaN.
        """
        n = np.asarray(points, dtype=float)
        if self.ideal:
            return n
        with np.errstate(all="ignore"):  # what is not seen may be anything
            seen = np.einsum("...i,...i->...", n, n) <= self.valid_radius**2
            return np.where(seen[..., None], self._distort(n), np.nan)

    def undistort(self, points: ArrayLike) -> Array:
        """The inverse of :meth:`distort`, (..., 2), to 1e-10; NaN where no ray that is seen falls."""
        d = np.asarray(points, dtype=float)
        if self.ideal:
            return d
        flat = d.reshape(-1, 2)
        result = np.full_like(flat, np.nan)
        todo = np.flatnonzero(np.isfinite(flat).all(axis=1))
        n = self._first_guess(flat[todo])
        for _ in range(_STEPS):
            if not len(todo):
                break
            with np.errstate(all="ignore"):
                error = self._distort(n) - flat[todo]
                size = np.maximum(np.abs(flat[todo]).max(axis=1), 1.0)
                done = np.abs(error).max(axis=1) < _NEAR_ENOUGH * size
                inside = np.einsum("ij,ij->i", n, n) <= self.valid_radius**2 * (1 + 1e-12)
                result[todo[done & inside]] = n[done & inside]
                keep = ~done & np.isfinite(error).all(axis=1)
                n, todo = n[keep], todo[keep]
                n = self._within(n - _solve(self._jacobian(n), error[keep]))
        return result.reshape(d.shape)

    @cached_property
    def valid_radius(self) -> float:
        """Tangent of the angle to the axis up to which the lens maps every ray to a place of its own.

        The first angle at which, in any direction, the distortion's Jacobian is singular or a denominator
        is zero; at most that of 89.5 degrees.
        """
        if self.ideal:
            return float(np.tan(_WIDEST))
        low, high = 0.0, _WIDEST
        for count in (_ANGLES, 100, 100, 100):
            angles = np.linspace(low, high, count + 1)[1:]
            good = self._unfolded(angles)
            first = int(np.argmin(good)) if not good.all() else -1
            if first < 0:
                return float(np.tan(high))
            low, high = (angles[first - 1] if first else low), angles[first]
        return float(np.tan(low))

    def jacobian(self, points: ArrayLike) -> Array:
        """Derivative (..., 2, 2) of :meth:`distort` at (..., 2)."""
        n = np.asarray(points, dtype=float)
        return np.broadcast_to(np.eye(2), (*n.shape, 2)) if self.ideal else self._jacobian(n)

    def _unfolded(self, angles: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        turn = np.linspace(0, 2 * np.pi, _DIRECTIONS, endpoint=False)
        around = np.column_stack([np.cos(turn), np.sin(turn)])
        n = np.tan(angles)[:, None, None] * around
        with np.errstate(all="ignore"):
            # small numbers make no fold of a lens that maps the whole plane to a disc
            good = np.linalg.det(self._jacobian(n)) > 0
            if self.model == "rational_polynomial":
                good &= self._radial(np.einsum("...i,...i->...", n, n))[2] > 0
            return np.asarray(good.all(axis=1))

    def _ratio(self, r2: Array) -> tuple[Array, Array | float]:
        """Numerator and denominator of the radial part."""
        k1, k2, _, _, k3, *more = self.coefficients
        above = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if not more:
            return above, 1.0
        k4, k5, k6 = more
        return above, 1 + r2 * (k4 + r2 * (k5 + r2 * k6))

    def _radial(self, r2: Array) -> tuple[Array, Array, Array]:
        """Factor of the radial part, its derivative by r squared, and its denominator."""
        k1, k2, _, _, k3, *more = self.coefficients
        k4, k5, k6 = more or (0.0, 0.0, 0.0)
        above, below = self._ratio(r2)
        slope = k1 + r2 * (2 * k2 + r2 * 3 * k3), k4 + r2 * (2 * k5 + r2 * 3 * k6)
        return above / below, (slope[0] * below - above * slope[1]) / below**2, below * np.ones_like(r2)

    def _angle(self, r: Array) -> tuple[Array, Array]:
        """The equidistant model's distorted angle of rays at a radius, and its derivative by that radius."""
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
        above, below = self._ratio(r2)
        factor, xy = above / below, 2 * x * y
        fallen = np.empty_like(n)
        fallen[..., 0] = x * factor + (p1 * xy + p2 * (r2 + 2 * x * x))
        fallen[..., 1] = y * factor + (p1 * (r2 + 2 * y * y) + p2 * xy)
        return fallen

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
        """Radii, and how far from the middle they fall (without the tangential part), rising."""
        r = np.tan(np.linspace(0, np.arctan(self.valid_radius), 4 * _ANGLES))
        if self.model == "equidistant":
            return r, np.maximum.accumulate(self._angle(r)[0])
        return r, np.maximum.accumulate(r * self._radial(r * r)[0])

    def _first_guess(self, d: Array) -> Array:
        r, fallen = self._radii
        length = np.sqrt(np.einsum("ij,ij->i", d, d))
        factor = np.interp(length, fallen, r) / np.maximum(length, 1e-12)
        return np.asarray(d * np.where(length > 1e-12, factor, 1.0)[:, None], dtype=float)

    def _within(self, n: Array) -> Array:
        """Points beyond the valid radius drawn back to it."""
        length = np.sqrt(np.einsum("ij,ij->i", n, n))
        return np.asarray(n * np.minimum(1.0, self.valid_radius / np.maximum(length, 1e-12))[:, None])


def _solve(matrices: Array, vectors: Array) -> Array:
    """x of A x = b for 2x2 matrices (N, 2, 2)."""
    (a, b), (c, d) = matrices[:, 0].T, matrices[:, 1].T
    u, v = vectors.T
    return np.asarray(np.stack([d * u - b * v, a * v - c * u], axis=1) / (a * d - b * c)[:, None])
