"""What a product needs of a frame."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, fields
from typing import Protocol

from humansim_ros.render.interface import CHANNEL_TABLE, check_channels


class Product(Protocol):
    """Something that is made from frames, such as a topic or an export format."""

    @property
    def needs(self) -> Needs:
        """What it needs of a frame."""


@dataclass(frozen=True)
class Needs:
    """What products, such as topics or export formats, need of a frame.

    Any collection of names can be given. It is stored as a set.

    Attributes:
        channels: Names of the channels that the cameras render (docs/ground_truth.md).
        cameras: Names of the cameras. None: all cameras.
        scanners: Names of the laser scanners with sweeps that are computed. None: all scanners.
        rectified: Names of the cameras with depth without lens distortion.
    """

    channels: Collection[str] = frozenset()
    cameras: Collection[str] | None = None
    scanners: Collection[str] | None = frozenset()
    rectified: Collection[str] = frozenset()

    def __post_init__(self) -> None:
        for field in fields(self):
            names = getattr(self, field.name)
            if names is not None:
                object.__setattr__(self, field.name, frozenset([names] if isinstance(names, str) else names))
        check_channels(self.channels)

    @classmethod
    def of(cls, products: Iterable[Product]) -> Needs:
        """What some products, such as topics or export formats, need together. Without any product, no camera
        and no laser scanner."""
        listed = [product.needs for product in products]
        return cls(
            _united(each.channels for each in listed) or (),
            _united(each.cameras for each in listed),
            _united(each.scanners for each in listed),
            _united(each.rectified for each in listed) or (),
        )

    @property
    def ordered_channels(self) -> tuple[str, ...]:
        """The channels in the order of the table of channels."""
        return tuple(name for name in CHANNEL_TABLE if name in self.channels)


def _united(names: Iterable[Collection[str] | None]) -> Collection[str] | None:
    """The names of all collections. None, which stands for all names, if one is None."""
    listed = list(names)
    if None in listed:
        return None
    return frozenset(name for each in listed for name in each or ())
