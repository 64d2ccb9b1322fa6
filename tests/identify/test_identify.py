"""Identification: exact derivatives, exact predictions without noise, and what a log can and cannot tell."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cz_gym import CzEnv, Parameters
from cz_gym.baselines.policy import OpenLoop
from cz_gym.baselines.registry import find_controller
from cz_gym.errors import CzError
from cz_gym.identify import Excited, Identified, identify, read_log, record_log
from cz_gym.identify.estimate import HEATER, LAM, PULL, whiteness
from cz_gym.identify.excitation import CHIPS, SEQUENCE
from cz_gym.identify.model import Model, Noise, predict, sensitivities
from cz_gym.observation import decode
from cz_gym.physics.meniscus import HURLE
from cz_gym.task import HEATER_RANGE
from tests.identify.puller import TRUTH, puller_env

ALL = Model((*HEATER, *PULL, *Noise._fields), Parameters(), Noise(), LAM)


@pytest.fixture(scope="module")
def found(logs: tuple[Path, Path]) -> Identified:
    return identify(read_log(logs[0]))


def test_without_noise_the_filter_of_the_true_puller_predicts_every_reading(tmp_path: Path) -> None:
    env = CzEnv("nominal", 0.5, "measured", horizon=3600.0, parameters=TRUTH, action="direct", info="all")
    record_log(env, Excited(OpenLoop(), heater=0.01), tmp_path / "log.csv", seed=0)
    log, q = read_log(tmp_path / "log.csv"), Model(("C_1",), TRUTH, Noise(), 0.5)
    assert np.ptp(log.ring) > 2e-4
    assert np.ptp(log.T_1) > 1.0
    out = predict(log, q, np.zeros(1))
    assert np.abs(out.error[1:]).max(axis=0) == pytest.approx([0.0, 0.0], abs=1e-5)
    wrong = predict(log, q, np.array([0.05]))
    assert np.abs(wrong.error[:, 0]).max() > 0.02


def test_derivatives_are_those_of_the_filter(logs: tuple[Path, Path]) -> None:
    log = read_log(logs[0])
    theta = ALL.mean + 0.05
    out, errors, variances = sensitivities(log, ALL, theta)
    for j in range(len(theta)):
        up, down = (predict(log, ALL, theta + sign * 1e-5 * np.eye(len(theta))[j]) for sign in (1.0, -1.0))
        for exact, part in ((errors[j], 0), (variances[j], 1)):
            differences = (up[part] - down[part]).real / 2e-5
            scale = np.abs(differences).max(axis=0) + 1e-4 * np.sqrt(out.variance).max(axis=0)
            assert np.abs((exact - differences) / scale).max() < 1e-3, ALL.names[j]


def test_a_log_with_excitation_tells_the_hot_zone(found: Identified) -> None:
    informed = [e for e in found.estimates if e.informed]
    assert found.settled
    assert {"C_1", "C_2", "kappa_12", "G_1a", "G_2b", "eps"} <= {e.name for e in informed}
    inside = [e.low < getattr(TRUTH, e.name, LAM * TRUTH.dT_0) < e.high for e in informed]
    assert np.mean(inside) >= 0.85
    learned, true = found.puller.parameters, TRUTH
    np.testing.assert_allclose([learned.C_1, learned.C_2], [true.C_1, true.C_2], rtol=0.05)
    assert min(found.excitation) > 5.0
    assert min(found.whiteness) > 0.01


def test_what_a_log_does_not_tell_keeps_its_value(found: Identified, logs: tuple[Path, Path]) -> None:
    start = Parameters()
    assert [
        e.name
        for e in found.estimates
        if not e.informed and getattr(found.puller.parameters, e.name, 0.0) != getattr(start, e.name, 0.0)
    ] == []
    passive = identify(read_log(logs[1]))
    assert max(passive.excitation) < 0.5
    assert not any(e.informed for e in passive.estimates)
    assert passive.puller.parameters == start
    assert not any(e.excited for e in passive.estimates)


def test_a_narrow_prior_leaves_less_to_learn(logs: tuple[Path, Path]) -> None:
    sure = identify(read_log(logs[0]), prior_sd={"sigma": 0.02})
    assert not next(e for e in sure.estimates if e.name == "sigma").informed
    with pytest.raises(CzError, match="did you mean 'sigma'"):
        identify(read_log(logs[0]), prior_sd={"sigm": 0.1})


def test_another_interval_is_the_same_puller(tmp_path: Path) -> None:
    given = {"observation": "measured", "action": "direct", "info": "all"}
    env = CzEnv("nominal", 0.5, control_interval=10.0, horizon=3600.0, parameters=TRUTH, **given)
    record_log(
        env,
        Excited(replace(find_controller("pid-conventional").make(env.config), T_start=0.0)),
        tmp_path / "log.csv",
        0,
    )
    out = predict(read_log(tmp_path / "log.csv"), Model(("C_1",), TRUTH, Noise(), 0.5, HURLE), np.zeros(1))
    assert np.abs(out.error[1:]).max(axis=0) == pytest.approx([0.0, 0.0], abs=1e-4)


def test_the_sequence_is_of_maximal_length() -> None:
    assert len(SEQUENCE) == CHIPS == 127
    assert sum(SEQUENCE) == 1.0
    assert {float(SEQUENCE @ np.roll(SEQUENCE, lag)) for lag in range(1, CHIPS)} == {-1.0}


@pytest.mark.parametrize("action", ["direct", "smooth", "rate"])
def test_the_drives_follow_the_sequence_whatever_the_action_means(action: str) -> None:
    class Rest(OpenLoop):
        """Holds the drives that it sees, which are the nominal ones."""

        action = ""

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            seen = decode(observation)
            assert abs(seen.v_p) < 1e-10
            assert abs(seen.Q_H) < 1e-2
            return super().predict(observation, state, episode_start, deterministic)

    policy = Rest()
    type(policy).action = action
    env = CzEnv("nominal", 0.5, "measured", action=action, info="all")
    observation, info = env.reset(seed=0)
    amplitude = 0.003  # moves that a smooth drive makes in one step
    start, state, excited = info, None, Excited(policy, pull=amplitude, heater=amplitude)
    for k in range(60):
        chosen, state = excited.predict(observation, state)
        observation, _, _, _, info = env.step(chosen)
        assert info["v_p"] / start["v_p"] - 1.0 == pytest.approx(amplitude * SEQUENCE[k // 12], abs=1e-6)
        half = SEQUENCE[k // 12 + CHIPS // 2]
        assert info["Q_H"] - start["Q_H"] == pytest.approx(amplitude * half * start["Q_H"], abs=2e-6 * HEATER_RANGE)


def test_excitation_stops_for_good_beyond_a_radius_error() -> None:
    env, excited = puller_env(), Excited(OpenLoop(), limit=1.5e-3)
    near, far = np.zeros((2, 1, 11), np.float32)
    near[:, 1] = far[:, 1] = 1.0
    far[:, 0] = 1.6
    action, state = excited.predict(near)
    assert np.abs(action).min() > 0.02
    for seen, begins, moves in ((far, False, False), (near, False, False), (near, True, True)):
        action, state = excited.predict(seen, state, np.array([begins]))
        assert bool(np.abs(action).any()) is moves
    assert env.config.control_interval == excited.interval
    with pytest.raises(CzError, match="amplitudes"):
        Excited(OpenLoop(), pull=0.5)


def test_whiteness_tells_white_from_coloured() -> None:
    white = np.random.default_rng(1).standard_normal(2000)
    white[100:150] = np.nan
    assert whiteness(white) > 0.01
    assert whiteness(white[1:] + 0.3 * white[:-1]) < 1e-6
