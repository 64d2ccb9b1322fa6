"""The number of processors that a process may use."""

import os
from typing import Any


def processors() -> int:
    """Return how many processors this process may use; taskset or a container may allow fewer than the machine has."""
    counts: Any = os  # Python 3.13 has the one, Linux the other
    if hasattr(counts, "process_cpu_count"):
        return counts.process_cpu_count() or 1
    return len(counts.sched_getaffinity(0)) if hasattr(counts, "sched_getaffinity") else os.cpu_count() or 1
