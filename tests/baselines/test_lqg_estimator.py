"""The adaptive LQG: with one hypothesis it is the LQG; with many it finds out how strong fluctuations are."""

from dataclasses import replace

import numpy as np
import pytest

from cz_gym.baselines.analysis import close, linear_form
from cz_gym.baselines.clairvoyant import pullers_of
from cz_gym.baselines.lqg import LQG, LQGDesign
from cz_gym.baselines.lqg_estimator import Hypotheses, multiple_model_filter
from cz_gym.baselines.tuned_controllers import FACTORS, adaptive
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Interface
from cz_gym.evaluation.rollout import rollout
from cz_gym.spaces import decode
from cz_gym.support.errors import map_arrays
from cz_gym.support.units import HOUR, MM
from cz_gym.tools.registry import make_controller
from tests.observed import PLAIN, Watched, measured
from tests.samples import NOMINAL_LQG


@pytest.mark.parametrize("scenario", ["sensor-fault", "puller"])
def test_the_adaptive_lqg_with_one_hypothesis_is_the_lqg(scenario):
    config = make_config(scenario, horizon=1800.0, **PLAIN)
    plain = make_controller("lqg-at-0.02", config)
    noise = plain.design.noise
    one = replace(plain, hypotheses=Hypotheses((noise.fast_sd,), (noise.slow_sd,)))
    ours, theirs = (rollout(each, config, range(4)) for each in (one, plain))
    np.testing.assert_allclose(ours.signals.v_p, theirs.signals.v_p, rtol=1e-6)


def test_the_bank_weights_its_filters_by_bayes_rule():
    single, hypotheses = LQG(design=LQGDesign(nonlinear=False)).gains.filter, Hypotheses((0.05, 0.5), (0.3,))
    bank = multiple_model_filter(single, hypotheses, 1)
    state, evidence, row = bank.at_rest(1), np.zeros(2), single.plant.H[0]
    random = np.random.default_rng(3)
    for _ in range(5):
        rows = bank.rows.predict(map_arrays(lambda part: part[0], state.filters), np.zeros((2, 2)), np.zeros(2))
        seen = decode(measured(ring_error=random.normal() * 0.02 * MM))
        for j in range(2):
            variance = row @ rows.covariance[j] @ row + rows.camera_variance[j]
            innovation = seen.ring_error[0] - row @ rows.mean[j]
            evidence[j] += -0.5 * innovation**2 / variance - 0.5 * np.log(variance)
        state = bank.step(state, np.zeros((1, 2)), np.zeros(1), seen, np.zeros(1, bool))
    weight = np.exp(evidence - evidence.max())
    assert state.probability[0] == pytest.approx(weight / weight.sum(), rel=1e-9)
    assert state.mean[0] == pytest.approx(state.probability[0] @ state.filters.mean[0])


@pytest.mark.parametrize(("strength", "factor"), [(0.05, 0.2), (0.5, 1.0)])
def test_the_adaptive_lqg_estimates_how_strong_the_fluctuations_are(strength, factor):
    """After an hour nine of ten crystals are at the nearest hypothesis; the design is that for known hot zones."""
    config = make_config("randomized", horizon=HOUR, **PLAIN)
    config = config.with_scenario(replace(config.scenario, name="one", interface=Interface(sd=(strength, strength))))
    watched = Watched(adaptive(NOMINAL_LQG.for_config(config)), 1)
    rollout(watched, config, range(20))
    expected = watched.states[-1].memory.filter.probability @ np.repeat(FACTORS, len(FACTORS))
    assert (np.abs(expected - factor) < 0.4).mean() >= 0.9


def test_the_adaptive_lqg_holds_the_slowest_hot_zones():
    """Two of 500 validation crystals, on which a filter that expects stronger slow fluctuations is unstable."""
    config = make_config("hot-zone", **PLAIN)
    plain, seeds = make_controller("lqg-at-0.02", config), (1_000_102, 1_000_275)
    assert not rollout(adaptive(plain).for_config(config), config, seeds).failed.any()
    noise = replace(plain.design.noise, slow_sd=2.0 * plain.design.noise.slow_sd)
    form = linear_form(replace(plain, design=replace(plain.design, noise=noise)))
    assert not any(close(form.controller, puller, form.dt).stable for puller in pullers_of(config, seeds))
