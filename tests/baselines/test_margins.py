"""Margins of the three openings against closed forms, python-control, and the loops that the changes destabilise."""

import math

import control
import numpy as np
import pytest

from cz_gym import make_puller
from cz_gym.baselines.analysis import NO_LAGS, SEEN, Lags, close, linear_form, opened, response, sampled_plant
from cz_gym.baselines.margins import (
    NO_MARGIN,
    PLACES,
    MarginLimits,
    Openings,
    frequency_response,
    lags_of,
    loop_gains,
    margin_limits,
    margin_of,
    margin_quantiles,
    openings,
    worst_margins,
    worst_of,
)
from cz_gym.baselines.pid import CompensatedPID
from cz_gym.body.signals import Measured
from cz_gym.config import make_config
from cz_gym.process import StateSpace
from cz_gym.spaces import MEASURED
from cz_gym.support.errors import CzError
from cz_gym.tools.registry import make_controller
from tests.observed import PLAIN

RANDOMIZED, PULLER = (make_config(name, **PLAIN) for name in ("randomized", "puller"))
CASES = [(name, config) for config in (RANDOMIZED, PULLER) for name in ("paper-tuned", "lqg", "lqg-at-0.02")]


def form_of(name, config):
    return linear_form(make_controller(name, config), config.scenario.sensor)


def gains_of(form, puller, lags, points=400):
    """Frequencies and loop gains of a controller's loop."""
    omega = np.geomspace(1e-5, np.pi / form.dt, points)
    z = np.exp(1j * omega * form.dt)
    A, B, C, D = form.controller
    controller = frequency_response(StateSpace(A, B[:, SEEN], C, D[:, SEEN]), z)
    return omega, loop_gains(controller, sampled_plant(puller, form.dt, lags), z)


@pytest.mark.parametrize("damping", [0.1, 0.4, 0.7])
def test_a_second_order_loop_has_the_margins_of_the_textbook(damping):
    """L = 1 / (s (s + 2 d)): the closed loop is a second-order system of that damping."""
    omega = np.geomspace(1e-3, 1e3, 4000)
    s = 1j * omega
    found = margin_of(1.0 / (s * (s + 2.0 * damping)), omega)
    crossover = math.sqrt(math.sqrt(1.0 + 4.0 * damping**4) - 2.0 * damping**2)
    phase = math.atan2(2.0 * damping, crossover)
    assert (found.gain_up, found.gain_down) == (math.inf, 0.0)
    assert found.phase == pytest.approx(math.degrees(phase), rel=1e-4)
    assert found.delay == pytest.approx(phase / crossover, rel=1e-4)
    square = omega**2
    peak = np.sqrt((square**2 + 4 * damping**2 * square) / ((1 - square) ** 2 + 4 * damping**2 * square)).max()
    assert found.peak == pytest.approx(peak, rel=1e-9)


def test_a_loop_that_nothing_moves_has_every_margin():
    assert margin_of(np.zeros(9), np.arange(1.0, 10.0), 5.0) == (math.inf, 0.0, 180.0, math.inf, 1.0)


@pytest.mark.parametrize(("name", "config"), CASES)
@pytest.mark.parametrize("lam", [1.0, 0.0])
def test_margins_are_python_controls(name, config, lam):
    form, lags = form_of(name, config), lags_of(config)
    omega, gains = gains_of(form, make_puller(lam=lam), lags, 4000)
    (found,) = openings(form, [make_puller(lam=lam)], lags, 4000)
    for L, ours in zip(gains, found, strict=True):
        up, phase, _, _, crossing, _ = control.stability_margins(control.frd(L, omega), returnall=True)
        # A table of frequencies does not say that the loop's gain is real at its end, Nyquist's frequency.
        up = np.append(up, -1.0 / L[-1].real) if L[-1].real < 0.0 else up
        assert ours.gain_up == pytest.approx(min(up[up > 1.0], default=math.inf), rel=2e-3)
        assert ours.gain_down == pytest.approx(max(up[up < 1.0], default=0.0), rel=2e-3, abs=1e-3)
        assert ours.phase == pytest.approx(np.abs(phase).min(initial=180.0), abs=0.05)
        late = np.radians(np.mod(phase, 360.0)) / crossing
        assert ours.delay == pytest.approx(late.min(initial=math.inf), rel=2e-3)
        assert ours.peak == pytest.approx((1.0 / np.abs(1.0 + L)).max())


@pytest.mark.parametrize(("name", "config"), CASES)
def test_without_lags_ring_and_heater_are_opened_as_the_loop_in_state_space_is(name, config):
    form, puller = form_of(name, config), make_puller(lam=0.5)
    omega, gains = gains_of(form, puller, NO_LAGS)
    for at, L in (("camera", gains[2]), ("Q_H", gains[1])):
        np.testing.assert_allclose(response(opened(form.controller, puller, form.dt, at), form.dt, omega), L, rtol=1e-5)


def test_lags_turn_the_plant_as_their_transfer_functions_do():
    omega, dt, puller = np.geomspace(1e-5, 1e-2, 20), 5.0, make_puller()
    z, s = np.exp(1j * omega * dt), 1j * omega
    plain = frequency_response(sampled_plant(puller, dt), z)
    found = frequency_response(sampled_plant(puller, dt, Lags(7.0, 45.0, 12.0, 20.0)), z) / plain
    ring, warmth, heat = np.exp(-7.0 * s), 1.0 / (1.0 + 20.0 * s), np.exp(-12.0 * s) / (1.0 + 45.0 * s)
    for row, column, expected in ((0, 0, ring), (0, 1, ring * heat), (1, 0, warmth), (1, 1, warmth * heat)):
        np.testing.assert_allclose(found[:, row, column], expected, rtol=5e-3)


def driven(controller, drive, factor):
    """The controller with a drive of that many times the effect, which it does not know."""
    A, B, C, D = (part.copy() for part in controller)
    effect, shown = np.ones((2, 1)), np.ones(len(MEASURED))
    effect[drive], shown[Measured._fields.index(("v_p", "Q_H")[drive])] = factor, 1.0 / factor
    return StateSpace(A, B * shown, effect * C, effect * D * shown)


@pytest.mark.parametrize(("name", "config"), CASES)
@pytest.mark.parametrize("drive", [0, 1])
def test_the_loop_turns_unstable_where_a_drive_has_more_or_less_effect_than_the_margin(name, config, drive):
    form, puller, lags = form_of(name, config), make_puller(lam=0.0), lags_of(config)
    (found,) = openings(form, [puller], lags)
    for factor, inward in ((found[drive].gain_up, 0.98), (found[drive].gain_down, 1.02)):
        if 0.0 < factor < math.inf:
            assert close(driven(form.controller, drive, inward * factor), puller, form.dt, lags=lags).stable
            assert not close(driven(form.controller, drive, factor / inward), puller, form.dt, lags=lags).stable


@pytest.mark.parametrize(("name", "config"), CASES)
def test_the_loop_turns_unstable_where_the_ring_is_later_than_the_margin(name, config):
    form, puller, lags = form_of(name, config), make_puller(lam=0.0), lags_of(config)
    (found,) = openings(form, [puller], lags)
    for factor, stable in ((0.97, True), (1.03, False)):
        late = lags._replace(latency=lags.latency + factor * found.ring.delay)
        assert close(form.controller, puller, form.dt, lags=late).stable == stable


def test_an_unstable_loop_has_no_margin():
    plain = CompensatedPID(compensator=None)
    assert worst_margins(plain, RANDOMIZED) == Openings(*[NO_MARGIN] * 3)
    assert MarginLimits().slacks(worst_margins(plain, RANDOMIZED)) == (-2.0, -2.0, -2.0)


def test_nineteen_of_twenty_drawn_pullers_have_the_margins_of_the_quantile():
    """And the worst draw has no more than any share allows."""
    lqg = make_controller("lqg-at-0.02", RANDOMIZED)
    worst, found = (margin_quantiles(lqg, RANDOMIZED, 20, share) for share in (0.0, 0.05))
    for nominal, place in zip(worst_margins(lqg, RANDOMIZED), range(len(PLACES)), strict=True):
        assert worst_of((worst[place], found[place])) == worst[place]
        assert found[place].gain == pytest.approx(nominal.gain, rel=0.15)


@pytest.mark.parametrize(
    ("text", "limits"), [("2,30,2", MarginLimits()), ("2.5,45,1.7", (2.5, 45.0, 1.7)), ("off", None)]
)
def test_limits_are_read(text, limits):
    assert margin_limits(text) == limits


@pytest.mark.parametrize("text", ["", "2", "2,30,2,1", "a,b,c", "0.5,30,2", "2,30,1", "nan,30,2"])
def test_limits_that_cannot_be_meant_are_refused(text):
    with pytest.raises(CzError, match="--margins"):
        margin_limits(text)


def test_slacks_are_those_of_the_worst_opening():
    lqg = worst_margins(make_controller("lqg", PULLER), PULLER)
    gain, phase, peak = MarginLimits(*(2.0, 30.0, 2.0)).slacks(lqg)
    assert gain == pytest.approx(math.log(min(each.gain for each in lqg) / 2.0))
    assert phase == pytest.approx(min(each.phase for each in lqg) / 30.0 - 1.0)
    assert peak == pytest.approx(math.log(2.0 / max(each.peak for each in lqg)))
