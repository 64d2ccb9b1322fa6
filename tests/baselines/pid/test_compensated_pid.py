from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from scipy import signal

from cz_gym import CzEnv, CzVectorEnv
from cz_gym.baselines import CompensatedPID, Compensator, OpenLoop, Policy, SeriesPID
from cz_gym.observation import MEASURED

MM, V_0 = 1e-3, 1.2e-3 / 60
NAMES = [channel.name for channel in MEASURED]


def observe(n: int = 1, **channels: Any) -> np.ndarray:
    """Measured observations from channel values in SI units, zero where not given."""
    rows = np.zeros((n, len(MEASURED)))
    for name, values in channels.items():
        at = NAMES.index(name)
        rows[:, at] = np.asarray(values) / (V_0 if name == "v_p" else MEASURED[at].scale)
    return rows


def pulls(controller: CompensatedPID, errors: np.ndarray, speeds: np.ndarray | None = None) -> np.ndarray:
    """v_p - v_0 over a sequence of ring errors and applied pull speeds."""
    state, out = None, []
    for k, error in enumerate(errors):
        seen = observe(ring_error=error, v_p=0.0 if speeds is None else speeds[k])
        action, state = controller.predict(seen, state)
        out.append(float(action[0, 0]) * V_0)
    return np.array(out)


def test_settings_are_table_one() -> None:
    assert dataclasses.astuple(SeriesPID()) == (0.01, 5000.0, 650.0, 100.0)
    c = Compensator()
    assert c.gain == -0.22517
    assert c.fast + c.slow == pytest.approx(1.884e-3)
    assert c.fast * c.slow == pytest.approx(3.368e-7)
    with pytest.raises(dataclasses.FrozenInstanceError):
        c.gain = 0.0  # type: ignore[misc]


@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
def test_pid_is_the_papers_discretised_by_tustin(dt: float, rng: np.random.Generator) -> None:
    p = SeriesPID()
    numerator = p.K_p * np.polymul([p.T_i, 1.0], [p.T_d, 1.0])
    denominator = np.polymul([p.T_i, 0.0], [p.T_d / p.N, 1.0])
    errors = np.cumsum(rng.normal(0, 1e-7, 300))
    filtered = signal.lfilter(*signal.bilinear(numerator, denominator, 1 / dt), errors)
    assert np.abs(filtered).max() < V_0, "the oracle knows no saturation"
    actual = pulls(CompensatedPID(dt, compensator=None), errors)
    np.testing.assert_allclose(actual, filtered, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("dt", [2.0, 5.0, 10.0])
def test_compensator_is_the_papers_driven_by_the_applied_pull(dt: float, rng: np.random.Generator) -> None:
    """Exact response to the held pull speed; the speed seen at t_k was applied until t_k."""
    applied = np.cumsum(rng.normal(0, 1e-6, 200))
    t = dt * np.arange(201)
    held = np.append(applied, 0.0)
    _, exact, _ = signal.lsim(([-0.22517, 0.0], [1.0, 1.884e-3, 3.368e-7]), held, t, interp=False)
    state, y = None, []
    controller = CompensatedPID(dt)
    for seen in [0.0, *applied]:
        _, state = controller.predict(observe(v_p=seen), state)
        y.append(state.compensator[0] @ [0.0, -0.22517])
    np.testing.assert_allclose(y, exact, rtol=1e-9, atol=1e-12)


def test_pull_answers_the_compensated_ring() -> None:
    """A radius too large is pulled faster, and a pull raised before counts as a smaller radius to come."""
    controller = CompensatedPID()
    assert pulls(controller, np.array([1e-6]))[0] > 0
    errors = np.zeros(2)
    assert pulls(controller, errors, np.array([0.0, 1e-6]))[1] < 0


def test_heater_is_a_pi_loop_by_forward_euler(rng: np.random.Generator) -> None:
    controller, state = CompensatedPID(), None
    errors = np.concatenate([rng.normal(0, 2, 50), np.full(40, 12.0), rng.normal(0, 2, 50)])
    integral, saturated = 0.0, 0
    for error in errors:
        action, state = controller.predict(observe(T_1_ref=error + 3.0, T_1=3.0), state)
        power = 1000.0 * (error + integral)
        assert float(action[0, 1]) * 10e3 == pytest.approx(np.clip(power, -10e3, 10e3), rel=1e-5, abs=1e-3)
        if abs(power) <= 10e3:
            integral += 5.0 / 300.0 * error
        else:
            saturated += 1
    assert 40 <= saturated < 60


def test_a_batch_is_its_slots_and_memory_travels(rng: np.random.Generator) -> None:
    controller = CompensatedPID()
    assert isinstance(controller, Policy)
    sequence = rng.normal(0, 0.05, (30, 4, 11))
    state: Any = None
    alone: list[Any] = [None] * 4
    for rows in sequence:
        together, state = controller.predict(rows, state)
        assert (together.shape, together.dtype) == ((4, 2), np.float32)
        for i in range(4):
            single, alone[i] = controller.predict(rows[i], alone[i])
            assert single.shape == (2,)
            np.testing.assert_array_equal(single, together[i])


def test_a_new_episode_starts_at_rest_in_its_slot_only(rng: np.random.Generator) -> None:
    controller = CompensatedPID()
    sequence = rng.normal(0, 0.05, (20, 2, 11))
    state = None
    for rows in sequence:
        _, state = controller.predict(rows, state)
    rows = sequence[0]
    mixed, _ = controller.predict(rows, state, episode_start=np.array([True, False]))
    on, _ = controller.predict(rows, state, episode_start=np.array([False, False]))
    new, _ = controller.predict(rows)
    np.testing.assert_array_equal(mixed, [new[0], on[1]])
    assert not np.array_equal(new, on)


def test_memory_is_never_written(rng: np.random.Generator) -> None:
    controller, state = CompensatedPID(), None
    for rows in rng.normal(0, 0.05, (5, 2, 11)):
        before = state
        copies = None if before is None else [array.copy() for array in before]
        _, state = controller.predict(rows, state, episode_start=np.array([True, False]))
        if before is not None and copies is not None:
            for array, copy in zip(before, copies, strict=True):
                np.testing.assert_array_equal(array, copy)


def test_history_is_read_like_measured(rng: np.random.Generator) -> None:
    row = rng.normal(0, 0.05, 72)
    np.testing.assert_array_equal(CompensatedPID().predict(row)[0], CompensatedPID().predict(row[:11])[0])


def test_open_loop_does_nothing() -> None:
    assert OpenLoop().predict(np.ones((3, 11)))[0].tolist() == [[0.0, 0.0]] * 3
    assert OpenLoop().predict(np.ones(72))[0].tolist() == [0.0, 0.0]


def episode(controller: Policy, scenario: str, model: str, **more: Any) -> tuple[np.ndarray, np.ndarray, bool]:
    """True error [m] and observed ring error [m] of each step, and whether the crystal was lost."""
    env = CzEnv(scenario, model=model, **more)
    observation, _ = env.reset(seed=0)
    state, true, seen = None, [], []
    while True:
        action, state = controller.predict(observation, state)
        observation, _, terminated, truncated, info = env.step(action)
        true.append(info["r_c"] - info["r_ref"])
        compensator = state.compensator[0, 1] * -0.22517 if state is not None else 0.0
        seen.append(float(observation[0]) * MM + compensator)
        if terminated or truncated:
            return np.array(true), np.array(seen), terminated


@pytest.mark.parametrize(("model", "peak_mm"), [("I", 1.48), ("II", 1.54)])
def test_papers_ramp_peaks_where_the_printed_controller_puts_it(model: str, peak_mm: float) -> None:
    true, compensated, lost = episode(CompensatedPID(), "paper-ramp", model)
    assert not lost
    assert np.abs(true).max() / MM == pytest.approx(peak_mm, rel=0.03)
    assert np.abs(compensated).max() < 0.5 * np.abs(true).max(), "the compensated ring shows less than half of it"


def test_published_loop_is_stable_with_the_compensator_and_unstable_without() -> None:
    """Roots of 1 = K (G + G_pc) with Part II's printed functions for Model I."""
    p = SeriesPID()
    K = p.K_p * np.polymul([p.T_i, 1.0], [p.T_d, 1.0]), np.polymul([p.T_i, 0.0], [p.T_d / p.N, 1.0])
    G = -0.0047626 * np.array([-47.1864, 1.0041]), np.polymul([1.0, -8.78e-6], [1.0, 1.684e-3])
    G_pc = np.array([-0.22517, 0.0]), np.array([1.0, 1.884e-3, 3.368e-7])
    both = np.polyadd(np.polymul(G[0], G_pc[1]), np.polymul(G_pc[0], G[1])), np.polymul(G[1], G_pc[1])
    roots = [np.roots(np.polysub(np.polymul(K[1], g[1]), np.polymul(K[0], g[0]))) for g in (G, both)]
    assert roots[0].real.max() > 1e-3
    assert roots[1].real.max() < 0


def test_the_same_pid_without_the_compensator_diverges() -> None:
    """It loses the crystal of Model II; that of Model I it swings from stop to stop for good."""
    *_, lost = episode(CompensatedPID(compensator=None), "paper-ramp", "II")
    assert lost
    env, controller, state = CzEnv("paper-ramp", model="I"), CompensatedPID(compensator=None), None
    observation, _ = env.reset(seed=0)
    pull = []
    for _ in range(2160):
        action, state = controller.predict(observation, state)
        observation, *_ = env.step(action)
        pull.append(action[0])
    assert (min(pull[-120:]), max(pull[-120:])) == (-1.0, 1.0)


@pytest.mark.parametrize("interval", [2.0, 10.0])
def test_ramp_depends_little_on_the_control_interval(interval: float) -> None:
    true, _, lost = episode(CompensatedPID(interval), "paper-ramp", "I", control_interval=interval)
    assert not lost
    assert np.abs(true).max() / MM == pytest.approx(1.48, rel=0.05)


def test_error_on_randomized_is_the_published_controllers() -> None:
    """The first 200 test seeds; mean over episodes of the true radius' root mean square error."""
    n, controller, state = 200, CompensatedPID(), None
    env = CzVectorEnv(n)
    observation, _ = env.reset(seed=2_000_000)
    squares = np.zeros(n)
    for _ in range(env.config.steps):
        action, state = controller.predict(observation, state)
        observation, _, terminated, _, info = env.step(action)
        assert not terminated.any()
        squares += (info["r_c"] - info["r_ref"]) ** 2
    rmse = np.sqrt(squares / env.config.steps).mean() / MM
    assert 0.41 < rmse < 0.51
