"""ROS domains that no other process of this machine uses; imports no ROS."""

from __future__ import annotations

import fcntl
import functools
import os
import tempfile
from pathlib import Path
from typing import IO

#: Domains whose UDP ports lie below the ephemeral ports of Linux; 0 is that of everybody else.
_DOMAINS = range(1, 100)


def claim_domain() -> int:
    """A ROS domain that no other test or challenge of this machine uses, until this process ends."""
    return _claim(os.getpid())[0]


@functools.cache
def _claim(process: int) -> tuple[int, IO[str] | None]:
    """The domain of a process, and the file that is locked meanwhile."""
    first = process % len(_DOMAINS)
    for domain in (*_DOMAINS[first:], *_DOMAINS[:first]):
        path = Path(tempfile.gettempdir()) / f"humansim_test_domain_{domain}.lock"
        try:
            file = path.open("a")
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # locked, or of another user
            continue
        return domain, file
    return _DOMAINS[first], None


def domain_environment(domain: int) -> dict[str, str]:
    """Environment variables of a ROS domain that other hosts do not see."""
    return {"ROS_DOMAIN_ID": str(domain), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
