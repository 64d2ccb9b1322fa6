import dataclasses

import numpy as np
import pytest
from scipy import signal

from cz_gym import make_puller
from cz_gym.baselines import CompensatedPID, Compensator, SeriesPID
from cz_gym.config import make_config
from cz_gym.evaluation.rollout import rollout
from tests.observed import PLAIN, measured, pulls

MM, V_0 = 1e-3, 1.2e-3 / 60


def test_settings_are_table_one():
    assert dataclasses.astuple(SeriesPID()) == (0.01, 5000.0, 650.0, 100.0)
    c = Compensator()
    assert c.gain == -0.22517
    assert c.fast + c.slow == pytest.approx(1.884e-3)
    assert c.fast * c.slow == pytest.approx(3.368e-7)


@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
def test_pid_is_the_papers_discretised_by_tustin(dt, rng):
    p = SeriesPID()
    numerator = p.K_p * np.polymul([p.T_i, 1.0], [p.T_d, 1.0])
    denominator = np.polymul([p.T_i, 0.0], [p.T_d / p.N, 1.0])
    errors = np.cumsum(rng.normal(0, 1e-7, 300))
    filtered = signal.lfilter(*signal.bilinear(numerator, denominator, 1 / dt), errors)
    assert np.abs(filtered).max() < V_0, "the oracle knows no saturation"
    actual = pulls(CompensatedPID(dt, compensator=None), [measured(ring_error=error) for error in errors])
    np.testing.assert_allclose(actual, filtered, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
def test_compensator_is_the_papers_driven_by_the_applied_pull(dt, rng):
    """Exact response to the held pull speed; the speed seen at t_k was applied until t_k."""
    applied = np.cumsum(rng.normal(0, 1e-6, 200))
    t = dt * np.arange(201)
    held = np.append(applied, 0.0)
    _, exact, _ = signal.lsim(([-0.22517, 0.0], [1.0, 1.884e-3, 3.368e-7]), held, t, interp=False)
    state, y = None, []
    controller = CompensatedPID(dt)
    for seen in [0.0, *applied]:
        _, state = controller.predict(measured(v_p=seen), state)
        y.append(state.memory.compensator[0] @ [0.0, -0.22517])
    np.testing.assert_allclose(y, exact, rtol=1e-9, atol=1e-12)


def test_heater_is_a_pi_loop_by_forward_euler(rng):
    controller, state = CompensatedPID(), None
    errors = np.concatenate([rng.normal(0, 2, 50), np.full(40, 12.0), rng.normal(0, 2, 50)])
    integral, saturated = 0.0, 0
    for error in errors:
        action, state = controller.predict(measured(T_1_ref=error + 3.0, T_1=3.0), state)
        power = 1000.0 * (error + integral)
        assert float(action[0, 1]) * 10e3 == pytest.approx(np.clip(power, -10e3, 10e3), rel=1e-5, abs=1e-3)
        if abs(power) <= 10e3:
            integral += 5.0 / 300.0 * error
        else:
            saturated += 1
    assert 40 <= saturated < 60


@pytest.mark.parametrize(
    ("model", "dt", "peak_mm"), [("I", 5, 0.740), ("II", 5, 0.745), ("I", 2, 0.740), ("I", 10, 0.740)]
)
def test_papers_ramp_peaks_where_the_printed_controller_puts_it(model, dt, peak_mm):
    run = rollout(CompensatedPID(dt), make_config("paper-ramp", model, control_interval=dt, **PLAIN), [0])
    true, ring = ((signal - run.signals.r_ref)[:, 0] for signal in (run.signals.r_c, run.signals.r_br))
    assert not run.failed.any()
    assert np.abs(true).max() / MM == pytest.approx(peak_mm, rel=0.03)
    compensated = ring - make_puller().ring_bias + Compensator().respond(run.signals.v_p[:, 0] - V_0, dt)
    assert np.abs(compensated).max() < 0.5 * np.abs(true).max(), "the compensated ring shows less than half of it"
