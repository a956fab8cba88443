"""Tables of joint limits (YAML): ranges of motion of the joints of a person, with their sources."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
from pydantic import ConfigDict, Field, model_validator

from humansim_ros.body.skeleton import hanim_skeleton, side_of
from humansim_ros.io.schema import Section
from humansim_ros.types import Array

#: Anatomical directions; ``out`` is away from the middle of the body, so that both sides share a range.
AnatomicalDirection = Literal["up", "down", "front", "back", "left", "right", "out", "in"]
#: In body space: +x is the person's left, y is up, +z is the front.
_DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "up": (0.0, 1.0, 0.0),
    "down": (0.0, -1.0, 0.0),
    "front": (0.0, 0.0, 1.0),
    "back": (0.0, 0.0, -1.0),
    "left": (1.0, 0.0, 0.0),
    "right": (-1.0, 0.0, 0.0),
}


def direction_vector(name: AnatomicalDirection, side: int) -> Array:
    """Unit vector (3,) of an anatomical direction, on the left (1) or right (-1) side."""
    if name in ("out", "in"):
        return np.array([float(side) if name == "out" else -float(side), 0.0, 0.0])
    return np.array(_DIRECTIONS[name])


class Limit(Section):
    """One end of a range: direction ``from`` (``start``) rotates ``towards`` another by at most ``degrees``.

    ``angle``: anatomical name. ``source``: key of the source.
    """

    model_config = ConfigDict(populate_by_name=True)

    angle: str
    start: AnatomicalDirection = Field(alias="from")
    towards: AnatomicalDirection
    degrees: float = Field(ge=0, le=180)
    source: str

    def axis(self, side: int) -> Array:
        """Rotation axis (3,) on the left (1) or right (-1) side."""
        axis = np.cross(direction_vector(self.start, side), direction_vector(self.towards, side))
        return np.asarray(axis, dtype=float)

    def end_direction(self, side: int, margin: float = 0.0) -> Array:
        """Direction ``from`` (3,) rotated to the limit and ``margin`` degrees beyond."""
        angle = np.radians(self.degrees + margin)
        start, towards = direction_vector(self.start, side), direction_vector(self.towards, side)
        return np.asarray(np.cos(angle) * start + np.sin(angle) * towards)


class ZeroDirection(Section):
    """Zero of the angles of a cone: degrees count from ``direction`` towards the direction of each angle."""

    direction: AnatomicalDirection
    angles: Mapping[str, AnatomicalDirection]


class JointRange(Section):
    """Ranges of ``bone`` (of both sides, for bones of the limbs) ``relative_to`` a bone above it.

    ``along``: direction of the bone at zero; without it the zero is the rest pose. Either ``swing``,
    directions on the border of a cone, with ``zero``; or ``first`` and ``second``, ranges about the axes
    before the ``twist``. ``twist_with``: bone whose twist is added.
    """

    bone: str
    relative_to: str
    along: AnatomicalDirection | None = None
    zero: ZeroDirection | None = None
    swing: tuple[Limit, ...] | None = None
    first: tuple[Limit, Limit] | None = None
    second: tuple[Limit, Limit] | None = None
    twist: tuple[Limit, Limit]
    twist_with: str | None = None

    @property
    def rows(self) -> tuple[Limit, ...]:
        """All limits."""
        return (*(self.swing or ()), *(self.first or ()), *(self.second or ()), *self.twist)

    @property
    def sides(self) -> dict[str, int]:
        """Bone name -> side, of the bones that have these ranges."""
        names = hanim_skeleton().names
        sides = {name: side_of(name) for name in (self.bone, f"l_{self.bone}", f"r_{self.bone}")}
        return {name: side for name, side in sides.items() if name in names}

    @model_validator(mode="after")
    def _check_geometry(self) -> JointRange:
        if not self.sides:
            raise ValueError(f"no bone {self.bone!r}; the bones are {', '.join(hanim_skeleton().names)}")
        allowed = {"up", "down", "front", "back"}
        allowed |= {"out", "in"} if any(self.sides.values()) else {"left", "right"}
        used = {direction for row in self.rows for direction in (row.start, row.towards)}
        used |= {self.along} if self.along else set()
        used |= {self.zero.direction, *self.zero.angles.values()} if self.zero else set()
        if not used <= allowed:
            raise ValueError(f"directions of {self.bone} are {', '.join(sorted(allowed))}")
        for row in self.rows:
            if not row.axis(1).any():
                raise ValueError(f"{row.angle}: nothing turns from {row.start} towards {row.towards}")
        if (self.swing is None) == (self.first is None) or (self.first is None) != (self.second is None):
            raise ValueError("give either 'swing' or both 'first' and 'second'")
        pairs = [pair for pair in (self.first, self.second, self.twist) if pair is not None]
        for one, other in pairs:
            if not np.allclose(one.axis(1), -other.axis(1)):
                raise ValueError(f"{one.angle} and {other.angle} are not opposite turns about one axis")
        axes = np.array([pair[0].axis(1) for pair in pairs])
        if not np.allclose(axes @ axes.T, np.eye(len(axes))):
            raise ValueError("its axes are not at right angles")
        if self.swing is not None:
            if self.along is None or self.zero is None or len(self.swing) < 3:
                raise ValueError("'swing' needs 'along', 'zero' and three directions or more")
            along = direction_vector(self.along, 1)
            if not np.allclose(np.abs(axes[0]), np.abs(along)):
                raise ValueError(f"{self.twist[0].angle} is no twist about {self.along}")
            for row in self.swing:
                if not np.linalg.norm(np.cross(along, row.end_direction(1))) > 1e-6:
                    raise ValueError(f"{row.angle} is at the middle of the cone, not on its border")
        return self


class LimitTable(Section):
    """A table of joint ranges; ``margin`` degrees are added to each limit."""

    name: str
    margin: float = Field(ge=0, le=90)
    sources: Mapping[str, str]
    joints: tuple[JointRange, ...]

    @model_validator(mode="after")
    def _check_references(self) -> LimitTable:
        for joint in self.joints:
            for row in joint.rows:
                if row.source not in self.sources:
                    raise ValueError(f"{joint.bone}, {row.angle}: no source {row.source!r} under 'sources'")
        bones = [joint.bone for joint in self.joints]
        for number, joint in enumerate(self.joints):
            if joint.bone in bones[:number]:
                raise ValueError(f"{joint.bone} is there twice")
            if joint.twist_with is not None and joint.twist_with not in bones[:number]:
                raise ValueError(f"{joint.bone}: 'twist_with' names no joint before it")
        return self
