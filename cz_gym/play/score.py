"""The score of a crystal pulled by hand, beside a controller's on the same crystal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.replay import Playback
from cz_gym.evaluation.rollout import rollout
from cz_gym.units import MINUTE


class Result(NamedTuple):
    """The result of one episode."""

    rmse_mm: float
    """RMSE of the true radius [mm], as the benchmark counts it."""
    reward: float
    """Return: the sum of rewards [-]."""
    failed: bool


class Score(NamedTuple):
    """The results of player and controller on the same crystal over the same time."""

    scenario: str
    seed: int
    minutes: float
    player: Result
    controller: Result

    def line(self) -> str:
        """The score in one line."""
        both = zip((self.player, self.controller), ("by hand", "by the paper's controller"), strict=True)
        errors = (f"{one.rmse_mm:.3f} mm {who}{' (failed)' if one.failed else ''}" for one, who in both)
        return (
            f"{self.scenario}, crystal {self.seed}, {self.minutes:.0f} min: "
            f"RMSE of the true radius {', '.join(errors)}; "
            f"return {self.player.reward:,.1f} and {self.controller.reward:,.1f}"
        )


def score(config: Config, seed: int, actions: Sequence[npt.NDArray[np.float32]], failed: bool, rival: Any) -> Score:
    """The score of a player's actions, each of shape (2,), and of a controller.

    A run that the player left early ends there for both. A failed one counts to the horizon, as in the benchmark.
    """
    if not failed:
        config = replace(config, horizon=len(actions) * config.control_interval)
    player, controller = (_result(policy, config, seed) for policy in (Playback(actions), rival))
    return Score(config.scenario.name, seed, config.horizon / MINUTE, player, controller)


def _result(policy: Any, config: Config, seed: int) -> Result:
    found = metrics(rollout(policy, config, [seed]))
    return Result(float(found.rmse_mm[0]), float(found.return_[0]), bool(found.failure_rate[0]))
