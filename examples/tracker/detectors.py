"""Detectors: they find the joints of people in an image, without identities.

:class:`Detector` is what the node needs of one. :func:`noisy_people` stands in for a detector: it takes the
2D joints of the truth, and adds the faults of a detector.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Detector(Protocol):
    """Finds people in the messages of cameras.

    Attributes:
        message: Type of the messages.
        topic: Their topic, with ``{camera}`` for the name of a camera.
    """

    message: type
    topic: str

    @property
    def joint_names(self) -> Sequence[str]:
        """Names of the J joints; empty as long as they are not known."""
        ...

    def attach(self, node: Any, camera: str) -> None:
        """Subscribe to what else the detector needs of a camera."""
        ...

    def detect(self, camera: str, message: Any, size: tuple[int, int]) -> Array:
        """Find the people in a message. Raises ValueError if it cannot be used.

        Args:
            camera: Name of the camera.
            message: The message.
            size: Width and height of the image, pixels.

        Returns:
            Pixels (P, J, 2) of their joints; NaN for joints that were not found.
        """
        ...


@dataclass(frozen=True)
class Faults:
    """Faults of a detector.

    Attributes:
        pixel_noise: Standard deviation of each coordinate, pixels.
        dropped_joints: Share of joints that are not found.
        false_joints: Share of joints that are found elsewhere on the person.
        dropped_people: Share of people that are not found in an image.
        false_people: Mean number of people in an image that are not there.
        seed: Seed of all of them.

    Raises:
        ValueError: A number is negative, or a share is above 1.
    """

    pixel_noise: float = 1.0
    dropped_joints: float = 0.05
    false_joints: float = 0.02
    dropped_people: float = 0.02
    false_people: float = 0.05
    seed: int = 0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            limit = 1.0 if name in ("dropped_joints", "false_joints", "dropped_people") else np.inf
            if not 0 <= value <= limit:
                raise ValueError(f"{name} must be between 0 and {limit:g}, not {value}")


NO_FAULTS = Faults(0.0, 0.0, 0.0, 0.0, 0.0)


def noisy_people(
    truth: Sequence[Array], size: tuple[int, int], faults: Faults, camera: str, stamp: int
) -> Array:
    """Detect people as a detector with faults does. The same frame has the same faults.

    Args:
        truth: Pixels (J, 2) of the joints of each person; NaN for joints that are not visible.
        size: Width and height of the image, pixels.
        faults: The faults.
        camera: Name of the camera.
        stamp: Stamp of the frame, nanoseconds.

    Returns:
        Pixels (P, J, 2) of the people in random order; NaN for joints that were not found.
    """
    random = np.random.default_rng([faults.seed, zlib.crc32(camera.encode()), stamp])
    joints = max((len(pixels) for pixels in truth), default=0)
    found = [
        pixels for pixels in truth if np.isfinite(pixels).any() and random.random() >= faults.dropped_people
    ]
    for _ in range(random.poisson(faults.false_people) if found else 0):
        # a person mirrored, and somewhere else
        person = found[random.integers(len(found))]
        shifted = (person - np.nanmean(person, axis=0)) * [-1, 1] + random.uniform((0, 0), size)
        found.append(shifted)
    people = np.array([_noisy_person(pixels, faults, random) for pixels in found]).reshape(
        len(found), joints, 2
    )
    return people[random.permutation(len(people))]


def _noisy_person(pixels: Array, faults: Faults, random: np.random.Generator) -> Array:
    result = pixels + faults.pixel_noise * random.standard_normal(pixels.shape)
    elsewhere = random.uniform(np.nanmin(pixels, axis=0), np.nanmax(pixels, axis=0), pixels.shape)
    false = (random.random(len(pixels)) < faults.false_joints) & np.isfinite(pixels[:, 0])
    result[false] = elsewhere[false]
    result[random.random(len(pixels)) < faults.dropped_joints] = np.nan
    return result
