"""Choice of topics by names and patterns, for the recorder and the bag player."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

from humansim_ros.errors import RosError, did_you_mean

#: Topics of each node of ROS, which a pattern does not mean.
_OF_EVERY_NODE = ("/rosout", "/parameter_events")


@dataclass(frozen=True)
class TopicChoice:
    """Topics that are asked for.

    Attributes:
        patterns: Absolute names of topics, or patterns with ``*``, ``?`` and ``[…]``; none: all topics.
    """

    patterns: tuple[str, ...] = ()

    @classmethod
    def of(cls, names: Iterable[str], namespace: str = "/") -> TopicChoice:
        """Choice of names as users give them: without the first / they are below ``namespace``.

        Raises:
            RosError: A name is empty or has spaces.
        """
        patterns = []
        for name in (each.strip() for each in names):
            if not name.strip("/") or any(c.isspace() for c in name):
                raise RosError(f"{name!r} is no topic: give names such as /left/image_raw, or patterns")
            patterns.append(absolute(name, namespace))
        return cls(tuple(dict.fromkeys(patterns)))

    def has(self, topic: str) -> bool:
        """Whether a topic is chosen. Patterns do not mean hidden topics (``_``), nor those of every node."""
        if topic in self.patterns:
            return True
        if topic in _OF_EVERY_NODE or "/_" in topic:
            return False
        return not self.patterns or any(fnmatchcase(topic, pattern) for pattern in self.patterns)

    def unmatched(self, topics: Collection[str]) -> list[str]:
        """Names and patterns that match none of ``topics``."""
        return [
            each for each in self.patterns if not any(TopicChoice((each,)).has(topic) for topic in topics)
        ]


def absolute(name: str, namespace: str) -> str:
    """Absolute name of a topic; without the first / it is below ``namespace``."""
    return name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"


def similar(name: str, topics: Sequence[str]) -> str:
    """End of a message about a topic that does not exist: a name that resembles it, or nothing."""
    return "" if any(c in name for c in "*?[") else did_you_mean(name, topics)
