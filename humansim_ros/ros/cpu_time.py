"""CPU time of processes and of the whole machine (Linux)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class CpuTime:
    """Used CPU seconds: by process, and of the whole machine."""

    processes: dict[str, float]
    machine: float

    @classmethod
    def now(cls, pids: Mapping[str, int]) -> CpuTime:
        """CPU time until now. ``pids``: process ids by name."""
        tick = os.sysconf("SC_CLK_TCK")
        seconds = {}
        for name, pid in pids.items():
            fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
            seconds[name] = (int(fields[11]) + int(fields[12])) / tick
        machine = [int(n) for n in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
        used = sum(machine) - machine[3] - machine[4]  # without idle and waiting for a disk
        return cls(seconds, used / tick)

    def since(self, before: CpuTime) -> CpuTime:
        """CPU time since an earlier time, of the same processes."""
        used = {name: seconds - before.processes[name] for name, seconds in self.processes.items()}
        return CpuTime(used, self.machine - before.machine)

    @property
    def total(self) -> float:
        """CPU seconds of all processes."""
        return sum(self.processes.values())
