"""Bags of rosbag2 (MCAP, sqlite3): written in chunks, read, and continued after interruptions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from humansim_ros import lazy_exports
from humansim_ros.errors import BagError

if TYPE_CHECKING:
    from humansim_ros.bags.chunks import BagMessage as BagMessage
    from humansim_ros.bags.chunks import encode_chunk as encode_chunk
    from humansim_ros.bags.reader import BagReader as BagReader
    from humansim_ros.bags.topics import BagTopic as BagTopic
    from humansim_ros.bags.topics import Qos as Qos
    from humansim_ros.bags.writer import BagWriter as BagWriter

__getattr__, __dir__, __all__ = lazy_exports(
    __name__,
    {
        "BagMessage": "chunks",
        "BagReader": "reader",
        "BagTopic": "topics",
        "BagWriter": "writer",
        "Qos": "topics",
        "encode_chunk": "chunks",
    },
)


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
