"""Agents at another control interval: their moves are stretched, not repeated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cz_gym import agents
from cz_gym.agents.policies.resampled import Resampled, at_interval
from cz_gym.config import make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.observation import HISTORY

AGENT = agents.OnnxPolicy.load(agents.shipped())
NAMES = [channel.name for channel in HISTORY]


def test_own_interval_changes_nothing() -> None:
    assert at_interval(AGENT, AGENT.contract.control_interval) is AGENT


@pytest.mark.parametrize(("interval", "share"), [(1.0, 0.2), (2.0, 0.4), (10.0, 1.5)])
def test_a_move_is_shortened_or_stretched_for_the_interval(interval: float, share: float) -> None:
    observation = np.random.default_rng(0).normal(0.0, 0.02, (5, len(HISTORY))).astype(np.float32)
    asked, _ = AGENT.predict(observation)
    applied = observation[:, [NAMES.index("v_p"), NAMES.index("Q_H")]]
    action, state = at_interval(AGENT, interval).predict(observation)
    assert state is None
    assert action.dtype == np.float32
    assert action == pytest.approx(np.clip(applied + share * (asked - applied), -1.0, 1.0), abs=1e-6)
    single, _ = at_interval(AGENT, interval).predict(observation[0])
    assert single == pytest.approx(action[0], abs=1e-6)


def test_moves_made_for_the_interval_hold_the_radius_better_than_whole_ones() -> None:
    seeds = VALIDATION_SEEDS[:6]

    def error(policy: object, interval: float) -> float:
        config = make_config("randomized", observation="history", control_interval=interval)
        return float(metrics(rollout(policy, config, seeds)).rmse_mm.mean())

    for interval in (2.0, 10.0):
        assert error(at_interval(AGENT, interval), interval) < error(AGENT, interval)


def test_an_agent_that_remembers_stays_at_its_interval() -> None:
    with pytest.raises(ValueError, match="an agent with a memory runs at its own 5 s alone"):
        at_interval(replace(AGENT, remembers=3), 2.0)
    assert isinstance(at_interval(AGENT, 2.0), Resampled)
