"""The adaptive LQG: with one hypothesis it is the LQG; with many it finds out how strong fluctuations are."""

from dataclasses import replace

import numpy as np
import pytest

from cz_gym.baselines.lqg.controller import LQG
from cz_gym.baselines.lqg.designs import FACTORS, adaptive, lqg
from cz_gym.baselines.lqg.filter_bank import Hypotheses
from cz_gym.baselines.registry import find_controller
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Interface
from cz_gym.evaluation.equal_activity import ratios
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.units import HOUR


class Watched(LQG):
    """Keeps the last state of its bank."""

    def step(self, seen, memory):
        pull, heater, memory = super().step(seen, memory)
        object.__setattr__(self, "last", memory.filter)
        return pull, heater, memory


def test_with_one_hypothesis_it_is_the_lqg():
    config = make_config("sensor-fault", horizon=1800.0)
    plain = lqg("lqg-at-0.02", config)
    noise = plain.design.noise
    one = replace(plain, hypotheses=Hypotheses((noise.fast_sd,), (noise.slow_sd,)))
    ours, theirs = (rollout(each, config, range(4)) for each in (one, plain))
    np.testing.assert_allclose(ours.signals.v_p, theirs.signals.v_p, rtol=1e-6)


@pytest.mark.parametrize(("strength", "factor"), [(0.05, 0.2), (0.5, 1.8)])
def test_it_finds_how_strong_the_fluctuations_are(strength, factor):
    """After an hour, nine of ten crystals are most likely at the end of the hypotheses that is nearest."""
    config = make_config("randomized", horizon=HOUR)
    config = config.with_scenario(replace(config.scenario, name="one", interface=Interface(sd=(strength, strength))))
    controller = adaptive(lqg("lqg-at-0.02", config))
    watched = Watched(design=controller.design, hypotheses=controller.hypotheses)
    rollout(watched, config, range(20))
    expected = watched.last.probability @ np.repeat(FACTORS, len(FACTORS))
    assert (np.abs(expected - factor) < 0.4).mean() >= 0.9


def test_knowing_this_gains_radius_error_at_equal_activity():
    config, family = make_config("randomized", horizon=2.0 * HOUR), ("lqg-at-0.013", "lqg-at-0.02", "lqg-at-0.03")
    points = {}
    for name in (*family, "lqg-at-0.02-adaptive"):
        found = metrics(rollout(find_controller(name).make(config), config, range(30)))
        points[name] = float(found.pull_step_rms_mm_per_min.mean()), float(found.rmse_mm.mean())
    assert ratios(points, family)["lqg-at-0.02-adaptive"] < 0.985
