"""The same bits everywhere, and golden trajectories that notice any change of physics."""

import hashlib
import json

import numpy as np
import pytest

from cz_gym import SCENARIOS, CzVectorEnv, Parameters
from tests.conftest import ROOT, python
from tests.golden.digest import digest
from tests.golden.trajectories import FILE, SIGNALS, trajectories, trajectory
from tests.observed import PLAIN

GOLDEN = json.loads(FILE.read_text())


def test_trajectories_are_those_of_the_golden_file():
    found = trajectories()
    assert found.keys() == GOLDEN.keys()
    assert len(found) == 2 * len(SCENARIOS)
    for name, rows in found.items():
        np.testing.assert_allclose(rows, GOLDEN[name], rtol=1e-9, atol=0.0, err_msg=name)


@pytest.mark.parametrize("name", Parameters._fields)
def test_goldens_notice_a_change_of_any_parameter(name):
    """By a millionth, a boundary layer by 1e-10 m2 K/W: of what the plant is made of, whatever the scenario."""
    value = getattr(Parameters(), name)
    changed = Parameters()._replace(**{name: value * (1.0 + 1e-6) if value else 1e-10})
    rows = np.array(trajectory("randomized", "I", changed))
    assert rows.shape == (2, len(SIGNALS) + 1)
    assert not np.allclose(rows, GOLDEN["randomized, I"], rtol=1e-9, atol=0.0)


@pytest.mark.slow
def test_the_same_bits_in_another_process():
    """And from an installed wheel: ``tests/project/test_packaging.py``."""
    assert python("-m", "tests.golden.digest").split() == [digest(), str(ROOT / "cz_gym" / "__init__.py")]


def test_thread_counts_do_not_change_bits():
    digests = set()
    for threads in (1, 2, 3):
        env = CzVectorEnv(780, "puller", horizon=50.0, threads=threads, info="all", **PLAIN)
        assert env._batch._parts == threads
        found, rng = hashlib.sha256(env.reset(seed=3)[0].tobytes()), np.random.default_rng(1)
        for _ in range(14):
            observation, reward, _, _, infos = env.step(rng.uniform(-1, 1, (780, 2)))
            found.update(observation.tobytes() + reward.tobytes() + infos["r_c"].tobytes() + infos["T_b"].tobytes())
        env.close()
        digests.add(found.hexdigest())
    assert len(digests) == 1
