"""The plant's hash follows from its equations, not from their formatting, nor from a number bumped by hand (trap 5)."""

import runpy

import pytest

from cz_gym import HURLE, config
from cz_gym.body import plant
from cz_gym.config import make_config
from cz_gym.jit.code_hash import function_hash, hash_files
from cz_gym.jit.compile import jittable

SOURCE = '''
import math
import numpy as np
SLOPE = 2.0
def inner(x):
    return SLOPE * x
def outer(x, by=1.0):
    """Say."""
    # why
    return by * np.sqrt(inner(x)) + math.pi
'''


@pytest.mark.parametrize(
    ("before", "after", "same"),
    [
        ("    # why\n", "", True),
        ('"""Say."""', '"""Say something else."""', True),
        ("by * np.sqrt(inner(x))", "(by * np.sqrt(\n        inner(x)))", True),
        ("def outer(x, by=1.0):", "def outer(x: float, by: float = 1.0) -> float:", True),
        ("SLOPE = 2.0", "SLOPE = 2.0\nOTHER = 3.0", True),
        ("SLOPE = 2.0", "SLOPE = 2.000001", False),
        ("SLOPE * x", "SLOPE + x", False),
        ("by=1.0", "by=1.5", False),
        ("np.sqrt", "np.cbrt", False),
        ("math.pi", "math.e", False),
    ],
)
def test_hash_of_a_function_follows_from_what_it_computes(tmp_path, before, after, same):
    hashes = []
    for name, text in (("one.py", SOURCE), ("two.py", SOURCE.replace(before, after))):
        (tmp_path / name).write_text(text)
        hashes.append(function_hash(runpy.run_path(str(tmp_path / name))["outer"]))
    assert (hashes[0] == hashes[1]) is same


def test_a_changed_equation_is_another_plant(monkeypatch):
    def fourth_power(T):
        return T**4.01

    before = make_config().plant_hash
    monkeypatch.setattr(plant, "fourth_power", fourth_power)
    config._equations_hash.cache_clear()
    assert make_config().plant_hash != before
    monkeypatch.undo()
    config._equations_hash.cache_clear()
    assert make_config().plant_hash == before


def stretched(by):
    """Hurle's meniscus, its height stretched."""

    @jittable
    def height(r_c, theta, a):
        return by * HURLE.height(r_c, theta, a)

    return HURLE._replace(name="stretched", height=height)


def test_two_menisci_of_one_factory_are_two_plants():
    hashes = {make_config(meniscus=stretched(by)).plant_hash for by in (1.0, 1.01, 1.02)}
    assert len({*hashes, make_config().plant_hash}) == 4
    assert make_config(meniscus=stretched(1.01)).plant_hash in hashes
    assert make_config(meniscus=HURLE._replace(name="another name")).plant_hash == make_config().plant_hash
    lambdas = [HURLE._replace(height=f) for f in (lambda r, t, a: 1.0 * a, lambda r, t, a: 1.1 * a)]
    assert function_hash(*lambdas[0].functions) != function_hash(*lambdas[1].functions)


def test_the_hash_of_files_counts_code_and_not_text(tmp_path):
    module, hashes = tmp_path / "thing.py", []
    for text in ('"""A."""\nx = 1\n"""B."""\n', '"""C."""\n# why\nx = (\n    1\n)\n', "x = 2\n"):
        module.write_text(text)
        hashes.append(hash_files([module]))
    assert hashes[0] == hashes[1] != hashes[2]
    assert hash_files([module]) != hash_files([module.rename(tmp_path / "other.py")])
