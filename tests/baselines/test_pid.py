"""The PID family against the printed controller, closed forms and continuous-time theory."""

import dataclasses
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal
from scipy.signal import lfilter

from cz_gym import Parameters, make_puller
from cz_gym.baselines.analysis import linear_form, loop_margins
from cz_gym.baselines.pid import CompensatedPID, Compensator, FilteredPID, SeriesPID, StandardPID, TemperatureLoop
from cz_gym.baselines.policy import DriveLimits
from cz_gym.baselines.tuned import TUNED
from cz_gym.baselines.tuned_controllers import PIDS, below_half_the_zero
from cz_gym.body.process import radius_model
from cz_gym.body.signals import Measured
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.evaluation.rollout import rollout
from cz_gym.process import PULL_SCALE
from cz_gym.spaces import HEATER_RANGE, MEASURED
from cz_gym.support.units import MM, MM_PER_MIN
from tests.observed import PLAIN, measured, pulls

SCALES = {channel.name: channel.scale for channel in MEASURED}


def test_the_filtered_pid_without_filter_is_the_printed_controller(rng):
    printed, filtered = CompensatedPID(), FilteredPID(T_f=0.0, T_track=np.inf, heater=TemperatureLoop(T_track=np.inf))
    states = [None, None]
    for k in range(200):
        row = measured()[0] + rng.normal(0.0, 1e-3, len(MEASURED)) * (k > 0)
        actions = []
        for i, policy in enumerate((printed, filtered)):
            action, states[i] = policy.predict(np.stack([row, -row]), states[i])
            actions.append(action)
        np.testing.assert_allclose(actions[0], actions[1], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
def test_filter_is_exact_and_linear(dt, rng):
    pid = SeriesPID(K_p=0.001, T_i=np.inf, T_d=0.0)
    policy = FilteredPID(control_interval=dt, pid=pid, compensator=None, T_f=40.0, T_track=np.inf)
    errors = rng.normal(0.0, 0.1 * MM, 80)
    pace = 1.0 - math.exp(-dt / 40.0)
    expected = 0.001 * lfilter([pace], [1.0, pace - 1.0], errors)
    found = pulls(policy, [measured(ring_error=error) for error in errors])
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("applied", [0.0, -0.2 * MM_PER_MIN])
def test_switching_on_moves_nothing(applied):
    policy = FilteredPID(T_start=200.0, compensator=None)
    start = measured(ring_error=0.3 * MM, v_p=applied, Q_H=700.0)
    action, memory = policy.predict(start)
    assert action[0, 0] * PULL_SCALE == pytest.approx(applied, abs=1e-12)
    assert action[0, 1] == pytest.approx(700.0 / SCALES["Q_H"], rel=1e-6)
    abrupt, _ = replace(policy, T_start=0.0).predict(start)
    assert abs(abrupt[0, 0] * PULL_SCALE - applied) > 0.05 * MM_PER_MIN
    np.testing.assert_allclose(memory.memory.start, 0.3 * MM * math.exp(-5.0 / 200.0))


def test_integrator_waits_where_the_drive_is_at_its_limit():
    """Back-calculation settles where T_i gains per sample what T_track takes: excess = K_p e T_track / T_i."""
    pid = SeriesPID(K_p=0.01, T_i=1000.0, T_d=0.0)
    policy = FilteredPID(
        pid=pid, compensator=None, T_f=0.0, T_track=50.0, limits=DriveLimits(pull_window=0.3 * MM_PER_MIN)
    )
    stuck = measured(ring_error=0.2 * MM, v_p=0.3 * MM_PER_MIN)
    state = None
    for _ in range(400):
        _, state = policy.predict(stuck, state)
    assert state.memory.command[0] - 0.3 * MM_PER_MIN == pytest.approx(0.01 * 0.2 * MM * 50.0 / 1000.0, rel=1e-6)
    wound = None
    for _ in range(400):
        _, wound = replace(policy, T_track=np.inf).predict(stuck, wound)
    wound_up = 0.01 * 0.2 * MM * (1.0 + 399.5 * 5.0 / 1000.0)
    assert wound.memory.command[0] - 0.3 * MM_PER_MIN == pytest.approx(wound_up, rel=1e-6)


def test_an_outlier_moves_the_filter_by_no_more_than_it_believes():
    policy = FilteredPID(compensator=None, T_f=40.0, jump=0.1 * MM)
    _, state = policy.predict(measured(ring_error=5.0 * MM))
    assert state.memory.filtered[0] == pytest.approx((1.0 - math.exp(-5.0 / 40.0)) * 0.1 * MM)


@pytest.mark.parametrize("sigma", [0.72, 0.8])
def test_feed_forward_is_the_inverse_of_its_own_plant(sigma):
    parameters, c = Parameters(sigma=sigma), 1e-8
    shown = {"r_ref_1min": 0.5 * c * 60.0**2, "r_ref_5min": 0.5 * c * 300.0**2}
    found = pulls(FilteredPID(K_ff=1.0, parameters=parameters), [measured(**shown)])
    assert found[0] == pytest.approx(c / radius_model(make_puller(parameters, lam=0.0)).numerator, rel=1e-5)


@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
def test_trim_rises_while_pull_is_fast_and_stops_at_its_limit(dt):
    loop = TemperatureLoop(K=100.0, T_i=np.inf, K_pull=6.0, T_pull=1200.0, T_mean=20.0, limit=4.0)
    fast = Measured(*np.zeros((len(MEASURED), 1)))._replace(v_p=np.array([0.1 * PULL_SCALE]))
    memory = loop.at_rest(fast)
    for _ in range(round(600.0 / dt)):
        before = memory
        _, memory = loop.step(fast, memory, dt, PULL_SCALE, HEATER_RANGE)
    assert memory.trim - before.trim == pytest.approx(6.0 * 0.1 * dt / 1200.0, rel=1e-9)
    assert memory.trim == pytest.approx(6.0 * 0.1 * (600.0 - 20.0) / 1200.0, rel=0.03)
    for _ in range(round(20000.0 / dt)):
        _, memory = loop.step(fast, memory, dt, PULL_SCALE, HEATER_RANGE)
    assert memory.trim == loop.limit


def test_conventional_loop_keeps_the_papers_rule():
    (conventional,) = (each for each in PIDS if each.name == "pid-conventional")
    for scenario in TUNED:
        assert below_half_the_zero(None, conventional.settings(scenario)) >= 0.0
    policy = conventional.settings(RANDOMIZED)
    assert policy.compensator is None
    assert math.isfinite(policy.T_track)
    assert policy.T_start > 0.0
    puller = make_puller()
    assert loop_margins(linear_form(policy).free, puller, 5.0).crossover < 0.5 * radius_model(puller).zero


# The printed controller

V_0 = 1.2e-3 / 60


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
        asked = None if state is None else state._replace(asked=np.array([[seen, 0.0]]))
        _, state = controller.predict(measured(v_p=seen), asked)
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


@pytest.mark.parametrize("pid", [SeriesPID(), SeriesPID(2e-3, 12_500.0, 560.0, 20.0), SeriesPID(0.004, 900.0, 0.0)])
def test_every_form_of_a_pid_converts_back_to_the_same_controller(pid):
    """The ISA, the parallel and PID_Compact's form have the series PID's response at every frequency."""
    form = StandardPID.of(pid)
    P, I, D = form.parallel()
    for back in (form.series(), StandardPID.from_parallel(P, I, D, form.filter_share * form.T_d).series()):
        assert [back.K_p, back.T_i, back.T_d] == pytest.approx([pid.K_p, pid.T_i, pid.T_d], rel=1e-9)
        assert pid.T_d / back.N == pytest.approx(pid.T_d / pid.N, rel=1e-9)
    s = 1j * np.geomspace(1e-5, 1.0, 50)
    series = pid.K_p * (1.0 + 1.0 / (pid.T_i * s)) * (pid.T_d * s + 1.0) / (pid.T_d / pid.N * s + 1.0)
    a, T_d = form.filter_share, form.T_d
    compact = form.gain * (1.0 + 1.0 / (form.T_i * s) + T_d * s / (a * T_d * s + 1.0))
    parallel = P + I / s + D * s / (a * T_d * s + 1.0)
    assert compact == pytest.approx(series, rel=1e-9)
    assert parallel == pytest.approx(series, rel=1e-9)
