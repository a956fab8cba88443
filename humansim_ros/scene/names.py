"""Names of the humans of a scene; imports no other library."""

from __future__ import annotations


def variety_names(prefix: str, count: int) -> list[str]:
    """Names of the random humans of a ``variety`` section: person_1, person_2 …"""
    return [f"{prefix}_{number}" for number in range(1, count + 1)]
