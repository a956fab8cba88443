"""When a node process that has died is started again: at once, then later and later, then no more."""

from __future__ import annotations

#: Seconds before the first start of a row, the second, and so on. After the last one the node is given up.
_DELAYS = (0.0, 0.5, 1.0, 2.0, 4.0)
#: Seconds after which a death does not belong to the row of deaths before it.
_LONG_RUN = 30.0


class RestartPolicy:
    """Counts the deaths in a row of one node."""

    def __init__(self) -> None:
        self._deaths = 0

    def delay(self, ran: float) -> float | None:
        """Record a death, and return the seconds until the node is started again; None: it is given up.

        ``ran``: seconds from the start of the process to its death.
        """
        self._deaths = 1 if ran >= _LONG_RUN else self._deaths + 1
        return _DELAYS[self._deaths - 1] if self._deaths <= len(_DELAYS) else None
