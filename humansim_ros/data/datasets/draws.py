"""Random distributions that can replace values in a recipe."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from statistics import NormalDist
from typing import Annotated, Any, TypeAlias

from pydantic import Field, model_validator

from humansim_ros.errors import ExportError
from humansim_ros.files.yaml import Expected, Section, validated
from humansim_ros.scene.core import RandomNumbers

#: Most options of a choice; and most of them that are checked when a recipe is read.
MAX_OPTIONS, _TRIED = 10_000, 50


def _rising(values: tuple[float, ...]) -> None:
    if values[0] > values[1]:
        raise ValueError(f"the first number, {values[0]:g}, is above the second, {values[1]:g}")


class UniformDraw(Section):
    """A number between two numbers. All numbers are equally likely."""

    uniform: tuple[float, float]

    @model_validator(mode="after")
    def _rises(self) -> UniformDraw:
        _rising(self.uniform)
        return self

    @property
    def ends(self) -> Sequence[Any]:
        """Values at the limits."""
        return self.uniform

    def value(self, uniform: RandomNumbers) -> Any:
        """A value, rounded to a millionth."""
        low, high = self.uniform
        return round(low + (high - low) * uniform(), 6)


class IntegerDraw(Section):
    """A whole number from the first to the second, both included."""

    integer: tuple[int, int]

    @model_validator(mode="after")
    def _rises(self) -> IntegerDraw:
        _rising(self.integer)
        return self

    @property
    def ends(self) -> Sequence[Any]:
        """Values at the limits."""
        return self.integer

    def value(self, uniform: RandomNumbers) -> Any:
        """A value."""
        low, high = self.integer
        return min(low + int((high - low + 1) * uniform()), high)


class NormalDraw(Section):
    """A number from a normal distribution: mean, standard deviation, and smallest and largest value."""

    normal: Annotated[
        tuple[float, Annotated[float, Field(gt=0)], float, float],
        Expected("mean, standard deviation above 0, least and greatest value"),
    ]

    @model_validator(mode="after")
    def _rises(self) -> NormalDraw:
        _rising(self.normal[2:])
        distribution = NormalDist(*self.normal[:2])
        low, high = (distribution.cdf(end) for end in self.normal[2:])
        if not high - low > 1e-9:
            raise ValueError("nearly no value of this distribution is between the least and the greatest")
        return self

    @property
    def ends(self) -> Sequence[Any]:
        """Values at the limits."""
        return self.normal[2:]

    def value(self, uniform: RandomNumbers) -> Any:
        """A value within the limits, rounded to a millionth."""
        mean, deviation, least, most = self.normal
        distribution = NormalDist(mean, deviation)
        low, high = distribution.cdf(least), distribution.cdf(most)
        share = min(max(low + (high - low) * uniform(), 1e-12), 1 - 1e-12)
        return round(min(max(distribution.inv_cdf(share), least), most), 6)


class ChoiceDraw(Section):
    """One of several values, which may be distributions themselves. ``weights``: how likely each value is."""

    choice: tuple[Any, ...] = Field(max_length=MAX_OPTIONS)
    weights: tuple[Annotated[float, Field(ge=0, le=1e9)], ...] | None = None

    @model_validator(mode="after")
    def _has_weights(self) -> ChoiceDraw:
        if not self.choice:
            raise ValueError("an empty choice: nothing can be drawn")
        if self.weights is not None and len(self.weights) != len(self.choice):
            raise ValueError(f"{len(self.choice)} values need as many weights, not {len(self.weights)}")
        if self.weights is not None and not sum(self.weights) > 0:
            raise ValueError("the weights sum to 0: nothing can be drawn")
        return self

    @property
    def likely(self) -> Sequence[tuple[int, Any]]:
        """Numbers and values of the options with a weight above 0; at most the first 50."""
        pairs = enumerate(self._weighted())
        return [(number, value) for number, (value, weight) in pairs if weight > 0][:_TRIED]

    def among(self, is_allowed: Callable[[Any], bool]) -> ChoiceDraw | None:
        """The same choice with only the values for which ``is_allowed`` is true; None if no value is left."""
        kept = [(value, weight) for value, weight in self._weighted() if is_allowed(value)]
        if not sum(weight for _, weight in kept) > 0:
            return None
        values, weights = zip(*kept, strict=True)
        return ChoiceDraw(choice=values, weights=weights)

    def value(self, uniform: RandomNumbers) -> Any:
        """A value."""
        pairs = list(self._weighted())
        left = uniform() * sum(weight for _, weight in pairs)
        for value, weight in pairs:
            left -= weight
            if left < 0:
                return value
        return next(value for value, weight in reversed(pairs) if weight > 0)

    def _weighted(self) -> Iterator[tuple[Any, float]]:
        return zip(self.choice, self.weights or (1.0,) * len(self.choice), strict=True)


#: Path of a key in a file.
Keys: TypeAlias = tuple[str | int, ...]
Draw: TypeAlias = UniformDraw | IntegerDraw | NormalDraw | ChoiceDraw
#: Distributions, by the key that replaces a value.
DRAWS: dict[str, type[Draw]] = {
    "uniform": UniformDraw,
    "integer": IntegerDraw,
    "normal": NormalDraw,
    "choice": ChoiceDraw,
}


def values_at_ends(value: Any, keys: Keys = ()) -> Iterator[tuple[Keys, Any, Any]]:
    """Copies of a value; in each copy, one distribution is replaced by its smallest or largest value.

    Args:
        value: A value of a recipe, which may be or contain distributions.
        keys: Path of keys to the value.

    Yields:
        Path of keys to the replaced distribution, the value in its place, and the copy.

    Raises:
        ExportError: A distribution is wrong.

    Example:
        >>> [end for _, end, _ in values_at_ends({"choice": [1, {"uniform": [2, 3]}]})]
        [1, 2.0, 3.0]
    """
    draw = draw_at(value)
    if isinstance(draw, ChoiceDraw):
        for number, option in draw.likely:
            inner = list(values_at_ends(option, (*keys, "choice", number)))
            yield from inner or [(keys, option, option)]
    elif draw is not None:
        yield from ((keys, end, end) for end in draw.ends)
    elif isinstance(value, (dict, list, tuple)):
        parts = list(value.items() if isinstance(value, dict) else enumerate(value))
        for place, part in parts:
            for inner_keys, end, changed in values_at_ends(part, (*keys, place)):
                whole = {key: changed if key == place else other for key, other in parts}
                yield inner_keys, end, whole if isinstance(value, dict) else list(whole.values())


def draw_at(value: Any) -> Draw | None:
    """The distribution that a value of a recipe stands for; None for a plain value.

    Raises:
        ExportError: The distribution is wrong.

    Example:
        >>> draw_at({"uniform": [1, 2]})
        UniformDraw(uniform=(1.0, 2.0))
        >>> draw_at({"uniform": True})  # a key of people
    """
    if not isinstance(value, dict):
        return None
    kind = next((DRAWS[key] for key in value if key in DRAWS and isinstance(value[key], list)), None)
    return None if kind is None else validated(kind, value, ExportError)
