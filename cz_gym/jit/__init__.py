"""Compilation: marks for functions that compile into the loops, and where compiled code is kept."""

import os

# Intel's vector mathematics, where numba finds it, rounds otherwise than libm: results would depend on the machine.
# numba reads this when it is first imported.
os.environ.setdefault("NUMBA_DISABLE_INTEL_SVML", "1")
