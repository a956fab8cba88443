"""Messages of one topic that a test has received."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, overload

from humansim_ros.errors import RosError
from humansim_ros.messages import to_nanoseconds


def stamp_of(message: Any) -> int | None:
    """Stamp of a message with a header, or of a header, in nanoseconds; None if it has neither."""
    stamp = getattr(getattr(message, "header", message), "stamp", None)
    return None if stamp is None else to_nanoseconds(stamp)


class ReceivedMessages(Sequence[Any]):
    """Messages of one topic in the order of their arrival, one for each stamp.

    A frame may be sent again, so that messages come again: the newest one of a stamp is kept.

    Attributes:
        topic: Full name of the topic.
        every_frame: Frames wait for a message of this topic.
        arrived: Number of messages that have arrived.
        newest: Newest stamp in nanoseconds; -1 before the first one.
    """

    def __init__(self, topic: str, every_frame: bool) -> None:
        self.topic, self.every_frame = topic, every_frame
        self.arrived = 0
        self.newest = -1
        #: By stamp, or by negative number for messages without a stamp.
        self._messages: dict[int, Any] = {}

    def add(self, message: Any) -> None:
        """Keep a message."""
        self.arrived += 1
        stamp = stamp_of(message)
        self._messages[-self.arrived if stamp is None else stamp] = message
        if stamp is not None:
            self.newest = max(self.newest, stamp)

    def at(self, moment: Any) -> Any:
        """The message of a stamp: nanoseconds, or another message with this stamp.

        Raises:
            RosError: There is none.
        """
        stamp = moment if isinstance(moment, int) else stamp_of(moment)
        if stamp is None or stamp not in self._messages:
            raise RosError(f"{self.topic}: no message with stamp {stamp} ns among {len(self)}")
        return self._messages[stamp]

    @property
    def stamps(self) -> list[int]:
        """Stamps in nanoseconds, in the order of their first arrival."""
        return [stamp for stamp in self._messages if stamp >= 0]

    def __len__(self) -> int:
        return len(self._messages)

    @overload
    def __getitem__(self, index: int) -> Any: ...
    @overload
    def __getitem__(self, index: slice) -> list[Any]: ...
    def __getitem__(self, index: int | slice) -> Any:
        return list(self._messages.values())[index]

    def __repr__(self) -> str:
        return f"ReceivedMessages({self.topic!r}, {len(self)} messages)"
