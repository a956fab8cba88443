"""Words that shells complete: names of built-in motions and humans, and channels."""

from __future__ import annotations

from collections.abc import Iterable

from humansim_ros.resources import resource_path


def motions(incomplete: str) -> list[str]:
    """Built-in motions."""
    return _beginning(incomplete, (path.stem for path in resource_path("assets/motions").glob("*.bvh")))


def humans(incomplete: str) -> list[str]:
    """Built-in humans."""
    return _beginning(incomplete, (path.stem for path in resource_path("assets/humans").glob("*.npz")))


def channels(incomplete: str) -> list[str]:
    """Channels, the last of several with commas between them."""
    from humansim_ros.render.channels import ALL_CHANNELS

    return _last_of_list(incomplete, ALL_CHANNELS)


def _last_of_list(incomplete: str, words: Iterable[str]) -> list[str]:
    before, comma, last = incomplete.rpartition(",")
    return [f"{before}{comma}{word}" for word in _beginning(last, words)]


def _beginning(incomplete: str, words: Iterable[str]) -> list[str]:
    return sorted(word for word in words if word.startswith(incomplete))
