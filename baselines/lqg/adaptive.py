"""The LQG that estimates how strong each crystal's interface fluctuations are: what can be known of that without a
sensor for it.

Its regulator is that of another LQG. In place of one Kalman filter it has a bank of them
(:mod:`cz_gym.baselines.lqg.filter_bank`), which assume fluctuations weaker and stronger than that LQG does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from cz_gym.baselines.policy import Floats
from cz_gym.observation import Measured

from .controller import LQG, Memory, memory_at_rest
from .filter_bank import Hypotheses

FACTORS = 0.2, 0.6, 1.0, 1.4, 1.8
"""Standard deviations that are held possible, in units of those that the LQG assumes [-]. Where an LQG assumes the root
mean square of what is drawn between none and the most, they span the range; the shipped ones assume what their search
chose, which is near that on ``randomized``, less on ``hard`` and more on ``puller``."""


@dataclass(frozen=True)
class AdaptiveLQG(LQG):
    """An LQG with a bank of filters, each pair of whose standard deviations is equally likely at first."""

    factors: tuple[float, ...] = FACTORS

    @cached_property
    def hypotheses(self) -> Hypotheses:
        """The standard deviations [K]."""
        noise = self.settings.noise
        fast, slow = ([factor * sd for factor in self.factors] for sd in (noise.fast_sd, noise.slow_sd))
        return Hypotheses(tuple(fast), tuple(slow))

    def at_rest(self, seen: Measured) -> Memory:
        """The filters at their initial covariance."""
        n = len(seen.v_p)
        return memory_at_rest(n, self.bank(self.hypotheses, n), self.control_interval)

    def step(self, seen: Measured, memory: Memory) -> tuple[Floats, Floats, Memory]:
        """Pull speed and heater power above nominal, and the new memory."""
        return self.step_with(self.bank(self.hypotheses, len(seen.v_p)), self.law, seen, memory)


def adaptive(lqg: LQG) -> AdaptiveLQG:
    """That LQG with a bank of filters."""
    return AdaptiveLQG(lqg.settings, lqg.control_interval, lqg.parameters, lqg.meniscus)
