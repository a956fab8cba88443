"""Errors about missing libraries that bags need."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from humansim_ros.errors import BagError


@contextmanager
def needs_libraries() -> Iterator[None]:
    """Convert the ImportError of a missing library to an error with the command that installs it.

    Raises:
        BagError: A library cannot be imported.
    """
    try:
        yield
    except ImportError as reason:
        raise BagError(
            f"recording and reading bags needs the libraries mcap and rosbags ({reason}); "
            "install them with: pip install 'humansim_ros[record]'"
        ) from None
