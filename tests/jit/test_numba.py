"""What this package takes from numba's private parts: a numba that changes them is found here, by name."""

import hashlib
from importlib import import_module

import numpy as np
import pytest
from numba.core.errors import TypingError

from cz_gym.jit import compile as _compile
from cz_gym.jit.compile import kernel


@pytest.mark.parametrize(
    ("table", "digest"),
    [("ki_double", "5652957978259315"), ("wi_double", "33c6472209e1d09e"), ("fi_double", "acd898d9d87e212f")],
)
def test_the_ziggurats_tables_are_those_this_was_written_with(table: str, digest: str) -> None:
    """They are NumPy's own; a numba that moves or changes them needs a copy of them in :mod:`cz_gym.episodes.rng`."""
    found = getattr(import_module("numba.np.random._constants"), table)
    assert hashlib.sha256(found.tobytes()).hexdigest()[:16] == digest, f"this numba's {table} is another one"


def test_a_numba_with_other_private_parts_caches_nothing_and_fails_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Moved away, or made with other arguments."""
    double = kernel(lambda x: 2 * x)
    for other in (type("CachedCode", (), {}), lambda function: function._no_such_part):
        monkeypatch.setattr(_compile, "CachedCode", other)
        assert kernel(double.py_func)(3) == 6


def test_loops_compile_without_reference_counts() -> None:
    """A private option: without it everything runs, but the scalar step is several times slower."""
    assert _compile._NO_COUNTS in _compile.default_options.__dict__, "this numba calls its option otherwise"
    counting = kernel(lambda x: np.zeros(3)[0] + x, keep=False, allocates=False)
    with pytest.raises(TypingError, match="zeros"):
        counting(1.0)
