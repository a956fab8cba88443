"""Values of a human that change over time but are no joints, such as the weights of a face, with their
rates."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace

import numpy as np

from humansim_ros.types import Array


@dataclass(frozen=True, eq=False)
class Rated:
    """Values at one stamp, and how fast they change.

    Attributes:
        labels: Names of all values, in the order of ``values.ravel()``.
        values: Values of any shape.
        rates: Change of each value per second.
        limits: Smallest and largest value.
    """

    labels: tuple[str, ...]
    values: Array
    rates: Array
    limits: tuple[float, float] = (-math.inf, math.inf)

    @classmethod
    def at_rest(
        cls,
        labels: tuple[str, ...],
        shape: tuple[int, ...],
        limits: tuple[float, float] = (-math.inf, math.inf),
    ) -> Rated:
        """Values of zero that do not change."""
        return cls(labels, np.zeros(shape), np.zeros(shape), limits)

    def moving(self, values: Array, seconds: float) -> Rated:
        """Values with these labels at the middle of three times. ``values``: at all three. ``seconds``: from
        the first to the last."""
        return replace(self, values=values[1], rates=(values[2] - values[0]) / seconds)

    def after(self, seconds: float) -> Array:
        """Values after some time, if the rates stay constant."""
        return np.clip(self.values + seconds * self.rates, *self.limits)

    def stopped(self) -> Rated:
        """The same values with rates of zero."""
        return replace(self, rates=np.zeros_like(self.rates))

    @property
    def weights(self) -> Array:
        """Former name of the ``values`` of a face."""
        return self._renamed("weights")

    @property
    def offsets(self) -> Array:
        """Former name of the ``values`` of a swing."""
        return self._renamed("offsets")

    def _renamed(self, name: str) -> Array:
        warnings.warn(f"{name} is deprecated: use values", DeprecationWarning, stacklevel=3)
        return self.values
