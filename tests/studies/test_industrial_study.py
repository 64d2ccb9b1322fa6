"""What logs report of the industrial law, on courses whose facts are known and on the plant."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from cz_gym.baselines.pid.settings import tuned
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from studies.industrial.__main__ import LOGGED, autocorrelation, facts, identified_gain


def test_logged_facts_from_courses_that_are_known(rng):
    keep, n = 0.95, 40000
    noise = rng.normal(0.0, 1.0, n)
    course = lfilter([1.0], [1.0, -keep], noise)
    found = autocorrelation(course, 40)
    assert found[0] == pytest.approx(1.0)
    np.testing.assert_allclose(found, keep ** np.arange(41), atol=0.06)
    pull = rng.normal(0.0, 1.0, (n, 1))
    diameter = lfilter([0.0, -0.3], [1.0, -0.9], pull, axis=0) + lfilter(
        [1.0], [1.0, -0.9], rng.normal(0, 0.05, (n, 1)), axis=0
    )
    assert identified_gain(diameter, pull, 1) == pytest.approx(-0.3, rel=0.02)


def test_plant_has_the_error_of_the_logs_and_their_wrong_sign():
    config = make_config("randomized")
    run = rollout(tuned("industrial", config), config, VALIDATION_SEEDS[:30])
    found = facts(run)
    assert found.diameter_error_mm == pytest.approx(LOGGED.diameter_error_mm, rel=0.35)
    assert found.pull_gain > 0.0
    with pytest.raises(ValueError, match="every episode failed"):
        facts(replace(run, failed=np.ones_like(run.failed)))
