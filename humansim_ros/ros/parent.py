"""Processes that end with their parent, however it ends (Linux)."""

from __future__ import annotations

import ctypes
import os
import signal

#: Environment variable with the process id of the parent.
PARENT_PID = "HUMANSIM_PARENT_PID"
_PR_SET_PDEATHSIG = 1


def end_with_parent() -> None:
    """Request SIGTERM for the death of the process that ``PARENT_PID`` names; end now if it is dead already.

    The kernel sends the signal when the parent's thread ends that has started this process.
    """
    parent = os.environ.get(PARENT_PID)
    if parent is None:
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGTERM))
    if os.getppid() != int(parent):  # it died before the request
        os._exit(0)
