"""The score of an episode that somebody stepped by hand, beside a controller's on the same crystal."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cz_gym.config import Config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.rollout import Rollout, Signals, rollout
from cz_gym.units import MINUTE


class Hand(NamedTuple):
    """How one of them did."""

    rmse_mm: float
    """RMSE of the true radius [mm], as the benchmark counts it."""
    reward: float
    """Return: the sum of rewards [-]."""
    failed: bool


class Outcome(NamedTuple):
    """Both on the same crystal over the same time."""

    scenario: str
    seed: int
    minutes: float
    mine: Hand
    rival: Hand

    def line(self) -> str:
        """The outcome for a terminal."""
        mine, rival = self.mine, self.rival
        return (
            f"{self.scenario}, crystal {self.seed}, {self.minutes:.0f} min: RMSE of the true radius "
            f"{mine.rmse_mm:.3f} mm by hand{_how(mine)}, {rival.rmse_mm:.3f} mm by the paper's controller"
            f"{_how(rival)}; return {mine.reward:,.1f} and {rival.reward:,.1f}"
        )


def _how(hand: Hand) -> str:
    return " (failed)" if hand.failed else ""


class Played:
    """What was logged of an episode."""

    def __init__(self, config: Config, seed: int, start: dict[str, Any]) -> None:
        self.config, self.seed = config, seed
        self._start = _row(start)
        self._rows: list[list[float]] = []
        self._rewards: list[float] = []
        self.failed = False

    @property
    def steps(self) -> int:
        """Steps taken."""
        return len(self._rows)

    def add(self, info: dict[str, Any], reward: float, terminated: bool) -> None:
        """Log a step."""
        self._rows.append(_row(info))
        self._rewards.append(reward)
        self.failed = self.failed or terminated

    def rollout(self) -> Rollout:
        """The episode as the metrics read it; one that was left early ends where it was left.

        A failed one goes on to the horizon, as everywhere: dying early never flatters.
        """
        config = self.config
        if not self.failed:
            config = replace(config, horizon=self.steps * config.control_interval)
        missing = config.steps - self.steps
        rows = np.array(self._rows + missing * [self._rows[-1]])
        reward = np.array(self._rewards + missing * [0.0])[:, None]
        alive = (np.arange(config.steps) < self.steps)[:, None]
        start = Signals(*np.array(self._start)[:, None, None])
        return Rollout(
            config, (self.seed,), Signals(*rows.T[:, :, None]), reward, alive, np.array([self.failed]), start, 0.0
        )

    def against(self, rival: Any) -> Outcome:
        """The score beside a controller's on the same crystal, over the same time."""
        mine = self.rollout()
        other = rollout(rival, mine.config, [self.seed])
        minutes = mine.config.horizon / MINUTE
        return Outcome(mine.config.scenario.name, self.seed, minutes, _hand(mine), _hand(other))


def _row(info: dict[str, Any]) -> list[float]:
    return [float(info[name]) for name in Signals._fields]


def _hand(run: Rollout) -> Hand:
    found = metrics(run)
    return Hand(float(found.rmse_mm[0]), float(found.return_[0]), bool(run.failed[0]))
