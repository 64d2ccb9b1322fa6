"""What stands between the batch and a learner: the weighted, scaled reward, and held actions."""

from typing import Any

import numpy as np
import pytest
from cz_gym.agents.training.wrappers import ActionRepeat, TrainingReward
from gymnasium.vector import AutoresetMode

from cz_gym import CzVectorEnv
from cz_gym.sb3 import CzVecEnv


def slots(**settings: Any) -> CzVecEnv:
    made = CzVecEnv(CzVectorEnv(2, observation="history", autoreset_mode=AutoresetMode.SAME_STEP, **settings))
    made.seed(5)
    return made


def test_a_failure_costs_the_worst_for_ever() -> None:
    env = TrainingReward(slots(), 0.9)
    env.reset()
    for _ in range(2000):
        _, gained, done, infos = env.step(np.array([[1.0, 1.0], [0.0, 0.0]], np.float32))
        if done[0]:
            break
    assert not infos[0]["TimeLimit.truncated"]
    assert gained[0] == pytest.approx(-10.0)


def test_without_costs_of_failure_every_step_earns_and_the_last_nothing() -> None:
    env = TrainingReward(slots(), 0.9, failure_costs=False)
    env.reset()
    least = np.inf
    for _ in range(2000):
        _, gained, done, _ = env.step(np.array([[1.0, 1.0], [0.0, 0.0]], np.float32))
        if done[0]:
            break
        least = min(least, gained.min())
    assert gained[0] == pytest.approx(0.0)
    assert 0.0 < least < 0.1 * 11.0


@pytest.mark.parametrize("steps", [50, 6])
def test_a_held_action_is_as_many_steps_and_ends_with_an_episode(steps: int) -> None:
    """Beside the same steps one by one; episodes of 6 steps end in the middle of the second action."""
    held, plain = ActionRepeat(slots(horizon=5.0 * steps), 4), slots(horizon=5.0 * steps)
    held.reset()
    plain.reset()
    random = np.random.default_rng(0)
    for _ in range(3):
        action = random.normal(0.0, 0.1, (2, 2)).astype(np.float32)
        seen, earned, done, infos = held.step(action)
        singly = [plain.step(action) for _ in range(4)]
        over = [bool(each[2].all()) for each in singly]
        ends, counted = any(over), singly[: over.index(True) + 1 if any(over) else 4]
        np.testing.assert_array_equal(seen, singly[-1][0])
        np.testing.assert_allclose(earned, np.sum([each[1] for each in counted], axis=0) / 4, rtol=1e-6)
        assert done.all() == ends
        if ends:
            np.testing.assert_array_equal(infos[0]["terminal_observation"], counted[-1][3][0]["terminal_observation"])
