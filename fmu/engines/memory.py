"""Read the total and free memory of this machine."""

from __future__ import annotations

import math
import os
from contextlib import suppress
from pathlib import Path


def free_memory() -> int | None:
    """Return the number of bytes of memory that this process can still allocate, or None if it is not known."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        free = next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        return None
    group = Path("/sys/fs/cgroup")  # a container may be allowed less
    try:
        limit, used = (
            int((group / name).read_text(encoding="ascii")) for name in ("memory.max", "memory.current")
        )
    except (OSError, ValueError):
        return free
    return min(free, max(limit - used, 0))


def total_memory() -> float:
    """Return the memory of this machine or container in bytes, or infinity if the system does not report it."""
    total = math.inf
    with suppress(AttributeError, OSError, ValueError):
        total = float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
        total = min(total, float(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii")))
    return total
