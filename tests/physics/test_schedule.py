"""Schedules of recipe, reference and disturbances; parameters that no puller can have."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cz_gym import SCENARIOS, Parameters, make_puller
from cz_gym.episodes.draw import Episode, episode_from_key, new_series
from cz_gym.physics.parameters import MACHINE, SIZES, check_parameters
from cz_gym.physics.plant import (
    bias_offset,
    disturbance,
    drift,
    hidden_load,
    pyrometer_drift,
    quintic,
    recipe,
    reference,
    ripple,
)

THREE_HOURS = 10800.0


def test_quintic_has_no_rate_and_no_curvature_at_its_ends():
    s = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    points = np.linspace(0, 1, 101)
    np.testing.assert_allclose(quintic(points), s(points), atol=1e-15)
    for ends in (s.deriv(1), s.deriv(2)):
        assert ends(np.array([0.0, 1.0])) == pytest.approx([0.0, 0.0], abs=1e-12)
    assert (quintic(0.0), quintic(1.0)) == (0.0, 1.0)


STEPS = Episode(
    recipe_start=600.0, recipe_duration=300.0, recipe_amount=2.0,
    drift_start=0.0, drift_duration=1000.0, drift_amount=-4.0, drift_rate=0.1 / 60,
    ring_offset=1e-4, bias_drift_start=1000.0, bias_drift_duration=1000.0, bias_drift_amount=-2e-4,
    ripple_amplitude=1e-4, ripple_omega=2 * np.pi / 6.0, ripple_phase=np.pi / 2, pyrometer_drift=2.0,
)  # fmt: skip


@pytest.mark.parametrize(
    ("schedule", "e", "times", "expected"),
    [
        (recipe, "paper-ramp", [0.0, 600.0, 660.0, 900.0, 1200.0, 5400.0], [0.0, 0.0, 0.5, 2.5, 5.0, 5.0]),
        (drift, "paper-ramp", [3600.0], [0.0]),
        (reference, "reference-a", [0.0, 600.0, 1500.0, 2400.0, 10200.0], [0.0, 0.0, -1.25e-3, -2.5e-3, -2.5e-3]),
        (reference, "reference-b", [0.0, 600.0, 1500.0, 2400.0, 10200.0], [0.0, 0.0, -0.25e-3, -0.5e-3, -0.5e-3]),
        (recipe, STEPS, [750.0], [1.0 - 3.0 + 1.25]),
        (drift, STEPS, [2000.0], [-4.0 + 0.1 / 60 * 2000]),
        (bias_offset, STEPS, [0.0, 1500.0, 9000.0], [1e-4, 0.0, -1e-4]),
        (ripple, STEPS, [0.0, 3.0, 6.0], [1e-4, -1e-4, 1e-4]),
        (pyrometer_drift, STEPS, [0.0, THREE_HOURS / 2, THREE_HOURS], [0.0, 1.0, 2.0]),
    ],
)
def test_schedules_have_their_values_at_times(schedule, e, times, expected):
    """The ramp rises 0.5 K/min for ten minutes, references fall over half an hour, a recipe is error and drift."""
    if isinstance(e, str):
        e = episode_from_key(SCENARIOS[e], (1, 2), new_series(10, 10))
    assert schedule(np.array(times), e) == pytest.approx(expected)


def test_disturbance_hides_the_drift_and_melts_the_charge_away():
    p = make_puller()
    e = Episode(drift_duration=100.0, drift_amount=3.0, melt_loss=0.1)
    d = disturbance(THREE_HOURS / 2, 0.7, e, p)
    assert d.Q_d == pytest.approx(hidden_load(3.0, p))
    assert d.dT_i == 0.7
    assert d.melt == pytest.approx(0.95)
    assert disturbance(2 * THREE_HOURS, 0.0, e, p).melt == pytest.approx(0.9)


REFUSED = [
    ({"alpha_0": 11.0}, r"did you mean 0.191986 \(11 deg\)"),
    ({"v_0": 1.2}, r"did you mean 2e-05 \(1.2 mm/min\)"),
    ({"sigma": 0.0}, "parameter sigma"),
    ({"sigma": 720.0}, r"did you mean 0.72 \(720 mN/m\)"),
    ({"rho_l": 2.57}, r"did you mean 2570 \(2.57 g/cm3\)"),
    ({"r_0": 150.0, "R_cr": 400.0}, r"r_0 = 150 m .* did you mean 0.15 \(150 mm\)"),
    ({"T_m": 1412.0}, "silicon's in degrees Celsius: did you mean 1685"),
    ({"dT_0": 0.001}, r"within 0.01 to 500$"),
    ({"eps": 2.0}, r"parameter eps = 2 must lie within 0.001 to 1: did you mean 0.02 \(2 %\)"),
    ({"T_e": 2000.0}, "must be below T_m = 1685 K"),
    *(({"lam": lam}, r"\[0, 1\]") for lam in (-0.1, 1.5, math.nan)),
]


@given(st.sampled_from(Parameters._fields), st.sampled_from([math.nan, math.inf, -math.inf, -1.0, "0.1", None]))
def test_what_is_not_a_number_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"^parameter {name} = .*\[") as refusal:
        check_parameters(Parameters()._replace(**{name: value}))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(("given", "message"), REFUSED)
def test_what_no_puller_can_be_made_of_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        make_puller(Parameters(**{name: given[name] for name in given if name != "lam"}), given.get("lam", 1.0))


def test_the_ends_of_ranges_are_allowed_and_every_key_ends_in_its_unit():
    assert check_parameters(Parameters(alpha_0=0.0, T_a=200.0, T_e=0.0))
    for quantity in MACHINE.values():
        assert quantity.shown in (quantity.unit, *SIZES[quantity.unit])
        assert all(quantity.holds(end * quantity.size) for end in (quantity.low, quantity.high))
    keys = [MACHINE[symbol].key for symbol in ("r_0", "eps", "kappa_12", "outlier_probability", "k_l", "sigma_SB")]
    assert keys == ["radius_mm", "eps", "kappa_12_W_per_K4", "outlier_probability_percent", "k_l_W_per_mK",
                    "sigma_SB_W_per_m2K4"]  # fmt: skip
