"""The metrics of whole crystals: energy against the recipe's balance, ways to lose a crystal, shares of its length."""

import pickle

import numpy as np
import pytest

from cz_gym.baselines.policy import OpenLoop
from cz_gym.config import make_config
from cz_gym.crystal import recipe
from cz_gym.crystal.process import CRYSTAL, nominal_recipe
from cz_gym.crystal.recipe import FAILURE_MODES, relative_margin
from cz_gym.evaluation.metrics import KWH, crystal_metrics
from cz_gym.evaluation.protocol import TEST_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.physics.meniscus import HURLE
from cz_gym.support.units import MM

LIMIT = 8 * MM


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["crown", "tail", "whole"])
def test_energy_and_time_are_those_of_the_recipe(stage):
    """In open loop without disturbances: the power's integral over the time of the recipe, by the mass grown."""
    config = make_config("nominal", observation="measured", action="direct", process=CRYSTAL, stage=stage)
    run = rollout(OpenLoop(), config, [0])
    m = crystal_metrics(run)
    p, table = nominal_recipe(config.parameters._replace(**dict.fromkeys(CRYSTAL.apart, 0.0)), HURLE)
    lengths = run.start.L[0, 0], run.signals.L[run.alive[:, 0], 0][-1]
    t, M_s = ([recipe.look_up(table, *recipe.place(L, p), at) for L in lengths] for at in (recipe._t, recipe._M_s))
    times = np.linspace(*t, 20_000)
    power = np.interp(times, table[:, recipe._t], table[:, recipe._Q_H])
    energy = np.trapezoid(power, times) / KWH
    assert m.completed[0] == 1.0
    assert m.hours[0] == pytest.approx((t[1] - t[0]) / 3600.0, rel=2e-3)
    assert m.kwh_per_kg[0] == pytest.approx(energy / (M_s[1] - M_s[0]), rel=2e-3)


@pytest.mark.parametrize(
    ("changes", "way"),
    [
        ({"h_c": 0.7 * MM}, "frozen"),
        ({"h_c": 9.3 * MM}, "detached"),
        ({"r_c": 87.5 * MM + 7.9 * MM}, "off"),
        ({"r_c": 2.1 * MM, "r_ref": 9.0 * MM, "L": 0.001}, "off"),
        ({"T_b": 1685.01}, "cold"),
    ],
)
def test_the_nearest_limit_says_how_a_crystal_was_lost(changes, way):
    at = CRYSTAL.Logged(*[np.nan] * len(CRYSTAL.Logged._fields))._replace(
        **{"r_c": 87.5 * MM, "r_ref": 87.5 * MM, "h_c": 6.6 * MM, "L": 0.5, "T_b": 1690.0} | changes
    )
    assert FAILURE_MODES[int(np.argmin(relative_margin(at, LIMIT, make_config(process=CRYSTAL).parameters)))] == way


def test_a_frozen_crown_counts_once_and_with_the_largest_allowed_error():
    """With a pull speed that is much too low a crown freezes within minutes."""

    class Stops:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.tile(np.array([-1.0, 0.0], np.float32), (len(observation), 1)), state

    config = make_config("randomized", observation="measured", action="direct", process=CRYSTAL, stage=0.05)
    run = rollout(Stops(), config, TEST_SEEDS[:3])
    m = crystal_metrics(run)
    for name, value in (("lost_in_crown", 1), ("frozen", 1), ("failure_rate", 1), ("completed", 0), ("detached", 0)):
        np.testing.assert_array_equal(getattr(m, name), value)
    np.testing.assert_array_equal(m.crown_max_mm, 12.0)
    assert np.isnan([m.body_within_half, m.tail_max_mm, m.dopant_spread]).all()
    assert (m.hours < 0.3).all()


def test_a_crystal_is_known_after_its_settings_went_to_another_process():
    settings = make_config("nominal", None, "measured", action="direct", process=CRYSTAL, stage="tail")
    config = pickle.loads(pickle.dumps(settings))
    run = rollout(OpenLoop(), config, [1])
    assert run.config.process == CRYSTAL
    assert (crystal_metrics(run).lost_in_crown == 0.0).all()
