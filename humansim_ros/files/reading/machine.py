"""Processor cores of this machine, and how processes share them."""

from __future__ import annotations

import os


def cores() -> int:
    """Number of CPU cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def thread_limits(rendering: int) -> dict[str, str]:
    """Environment variables that divide the cores among ``rendering`` processes that render.

    By default Mesa without a GPU, and OpenCV, start one thread per core in each process. Variables that the
    user has set are left out.
    """
    share = max(1, cores() // max(1, rendering))
    threads = {
        # 0: render in the calling thread. Waiting for a single other thread costs a tenth more
        "LP_NUM_THREADS": str(share if share > 1 else 0),
        # a thread without a core of its own delays the others
        "OPENCV_FOR_THREADS_NUM": str(share),
    }
    return {name: number for name, number in threads.items() if name not in os.environ}
