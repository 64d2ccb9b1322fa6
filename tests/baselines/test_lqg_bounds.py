"""The privileged LQGs: what they know is what the environment brings, and is worth something."""

from dataclasses import replace

import numpy as np
import pytest

from cz_gym import CzVectorEnv, make_puller
from cz_gym.baselines import lqg_bounds
from cz_gym.baselines.clairvoyant import fluctuations_of, pullers_of
from cz_gym.baselines.lqg import LQG, LQGDesign
from cz_gym.baselines.lqg_filter import plant_model
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.units import HOUR
from cz_gym.tools.registry import find_controller
from tests.observed import PLAIN, observations

PULLER = make_puller(lam=0.5)


def test_the_bounds_know_the_pullers_and_fluctuations_that_the_environment_draws():
    config, seeds = make_config("randomized", horizon=600.0, **PLAIN), (5, 9, 2_000_000)
    env = CzVectorEnv(3, horizon=600.0, **PLAIN)
    env.reset(seed=list(seeds))
    slots = env._batch.memory.slots
    for drawn, puller in zip(slots["puller"], pullers_of(config, seeds), strict=True):
        np.testing.assert_allclose([drawn[name] for name in puller._fields], puller, rtol=1e-12)
    drawn = np.stack([slots["episode"]["sd_fast"], slots["episode"]["sd_slow"]], axis=1)
    np.testing.assert_array_equal(fluctuations_of(config, seeds), drawn)
    assert len(np.unique(drawn)) == 6


def test_each_filter_has_the_noise_of_its_own_crystal():
    config = make_config("only-interface", horizon=900.0, **PLAIN)
    bound = lqg_bounds.PrivilegedLQG(design=LQGDesign(lam=1.0), knows_fluctuations=True)
    known = bound.for_episodes(config, np.arange(3)).gains.filter.plant.Q
    for slot, (fast, slow) in enumerate(fluctuations_of(config, [0, 1, 2])):
        noise = replace(LQGDesign().noise, fast_sd=fast, slow_sd=slow)
        puller = pullers_of(config, [slot])[0]
        np.testing.assert_allclose(known[slot], plant_model(puller, noise, config.control_interval).Q, rtol=1e-12)


@pytest.mark.parametrize("names", [("lqg-at-0.02", "lqg-at-0.02-privileged"), ("lqg", "full-information")])
def test_knowing_more_lowers_error_and_activity_on_the_same_episodes(names):
    """The puller and its fluctuations, or the whole state."""
    found = []
    for entry in map(find_controller, names):
        config = make_config("randomized", observation=entry.observation, action="direct", horizon=2.0 * HOUR)
        found.append(metrics(rollout(entry.make(config), config, range(20))))
    plain, privileged = found
    assert privileged.rmse_mm.mean() < plain.rmse_mm.mean()
    assert privileged.pull_step_rms_mm_per_min.mean() < plain.pull_step_rms_mm_per_min.mean()


@pytest.mark.parametrize("error_pull", [None, 2e-7])
def test_the_privileged_lqg_of_a_nominal_puller_is_the_lqg(error_pull):
    """Also where a share of a narrow drive is left to the meniscus, which bounds on such pullers could not run with."""
    design, config = LQGDesign(lam=1.0, error_pull=error_pull), make_config("only-interface", horizon=900.0, **PLAIN)
    privileged, plain = (rollout(kind(design=design), config, [0, 1, 2]) for kind in (lqg_bounds.PrivilegedLQG, LQG))
    np.testing.assert_allclose(privileged.signals.v_p, plain.signals.v_p, rtol=1e-5)


def test_other_slots_than_the_known_ones_are_refused():
    privileged = lqg_bounds.PrivilegedLQG().for_episodes(make_config("randomized", **PLAIN), [1, 2])
    with pytest.raises(ValueError, match="2 pullers are known, got 3 slots"):
        privileged.predict(next(observations()))
