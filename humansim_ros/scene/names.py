"""Names that more than one part of the package must make in the same way, without the libraries they use."""

from __future__ import annotations


def variety_names(prefix: str, count: int) -> list[str]:
    """The humans of a scene's ``variety`` section: person_1, person_2 and so on."""
    return [f"{prefix}_{number}" for number in range(1, count + 1)]
