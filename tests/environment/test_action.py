"""Smooth actions: first-order lags of the drives, the same at every control interval and in the batch."""

import math
from copy import deepcopy

import numpy as np
import pytest

from cz_gym import CzEnv, make_puller
from cz_gym.body.signals import Logged

P = make_puller()


@pytest.mark.parametrize("interval", [2.0, 5.0, 10.0])
def test_a_held_action_is_approached_with_one_time_constant(interval):
    """v_p -> v_0 (1 + a) and Q_H -> Q_H0 + 5 kW a, whatever the control interval."""
    env = CzEnv("nominal", action="smooth", control_interval=interval, horizon=600.0, info="all")
    env.reset(seed=0)
    for k in range(round(100.0 / interval)):
        *_, info = env.step(np.array([0.4, -0.5], np.float32))
        reached = 1.0 - math.exp(-(k + 1) * interval / 50.0)
        assert info["v_p"] / P.v_0 - 1.0 == pytest.approx(0.4 * reached, rel=1e-5)
        assert info["Q_H"] - P.Q_H_0 == pytest.approx(5e3 * -0.5 * reached, rel=1e-5)
    for _ in range(round(100.0 / interval)):
        *_, info = env.step(np.zeros(2, np.float32))
    assert info["v_p"] / P.v_0 - 1.0 == pytest.approx(0.4 * (math.exp(-2.0) - math.exp(-4.0)), rel=1e-5)


@pytest.mark.parametrize("interval", [2.0, 10.0])
def test_rates_add_up_within_the_range_of_the_drives(interval):
    """An action of 1 moves the pull speed by v_0 and the heater by 5 kW every 50 s; left alone they stay."""
    env = CzEnv("nominal", action="rate", control_interval=interval, horizon=600.0, info="all")
    env.reset(seed=0)
    steps = round(20.0 / interval)
    for action, pull, power in (
        (-0.5, -0.2, -1e3),
        (0.0, -0.2, -1e3),
        (-1.0, -0.6, -3e3),
        (-1.0, -1.0, -5e3),
        (-1.0, -1.0, -7e3),
    ):
        for _ in range(steps):
            _, _, over, _, info = env.step(np.full(2, action, np.float32))
        assert info["v_p"] / P.v_0 - 1.0 == pytest.approx(pull, abs=1e-5)
        assert info["Q_H"] - P.Q_H_0 == pytest.approx(power, rel=1e-5)
    assert not over


def test_info_is_lean_unless_all_is_asked_for():
    for env, keys in (
        (CzEnv(), {"r_c", "r_ref", "cost"}),
        (CzEnv(info="all"), {*Logged._fields, "state"}),
        (CzEnv(info="all", observation="measured"), set(Logged._fields)),
    ):
        _, info = env.reset(seed=0)
        assert set(info) == keys
        *_, info = env.step(np.array([0.5, 0.5], np.float32))
        assert set(info) == keys
        *_, info = env.step(np.array([1.5, 0.5], np.float32))
        assert set(info) == keys | {"action_clipped"}
        assert info["action_clipped"] is True


def test_a_deep_copy_of_info_shares_nothing():
    for env in CzEnv(), CzEnv(observation="measured"), CzEnv(info="all"):
        _, info = env.reset(seed=0)
        info["of a wrapper"] = {"inside": [1.0]}
        before, copy = deepcopy(dict(info)), deepcopy(info)
        info["r_c"] = 0.0
        info["of a wrapper"]["inside"].append(2.0)
        if "state" in info:
            info["state"][:] = 0.0
        assert repr(copy) == repr(before)
