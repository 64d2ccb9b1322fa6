"""Every kind of file, damaged at random: ``python -m tests.stress.fuzz --files 100000``.

Runs in bounded memory; prints what was read, what was refused, the slowest file and the largest memory. Exits with 1 at
the first file that is not refused in one line and not read either, and leaves it beside the message.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np

from .hostile_files import mutant, refused, targets

SPARE = 1_000_000_000
"""Memory beyond what importing takes [bytes]."""


def main() -> int:
    """Fuzz; 0 if every file was read or refused."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--files", type=int, default=20_000, help="of each kind (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="one kind")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        known = targets(Path(name))
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + SPARE, used + SPARE))
        for kind, target in known.items():
            if arguments.only not in (None, kind):
                continue
            rng = np.random.default_rng([arguments.seed, len(kind), target.seed[0]])
            count, slowest = 0, 0.0
            for _ in range(arguments.files):
                content = mutant(kind, target.seed, rng)
                began = time.perf_counter()
                try:
                    count += refused(target.read, content)
                except BaseException:
                    traceback.print_exc()
                    Path("hostile.bin").write_bytes(content)
                    print(f"{kind}: a file that breaks its reader is in hostile.bin", file=sys.stderr)
                    return 1
                slowest = max(slowest, time.perf_counter() - began)
            memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
            print(f"{kind}: {arguments.files} files, {count} refused, slowest {slowest:.3f} s, memory {memory} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
