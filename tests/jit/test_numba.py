"""The private parts of numba that this package uses: a numba that changes them fails here, by name."""

import hashlib
from importlib import import_module

import numpy as np
import pytest
from numba.core.errors import TypingError

from cz_gym.jit.compile import kernel


@pytest.mark.parametrize(
    ("table", "digest"),
    [("ki_double", "5652957978259315"), ("wi_double", "33c6472209e1d09e"), ("fi_double", "acd898d9d87e212f")],
)
def test_the_ziggurats_tables_are_those_this_was_written_with(table: str, digest: str) -> None:
    """They are NumPy's own; a numba that moves or changes them needs a copy of them in :mod:`cz_gym.episodes.rng`."""
    found = getattr(import_module("numba.np.random._constants"), table)
    assert hashlib.sha256(found.tobytes()).hexdigest()[:16] == digest, f"this numba's {table} is another one"


def test_loops_compile_without_reference_counts() -> None:
    """A private option of numba's."""
    counting = kernel(lambda x: np.zeros(3)[0] + x, keep=False, allocates=False)
    with pytest.raises(TypingError, match="zeros"):
        counting(1.0)
