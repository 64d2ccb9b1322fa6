"""Privileged LQGs: bounds on the worth of a perfect model, and of a perfect view of the present.

Their method ``for_episodes``, which a rollout calls, tells them of the episodes what no controller can know.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_discrete_are

from cz_gym.config import Config
from cz_gym.physics.plant import hidden_load
from cz_gym.process import scales
from cz_gym.spaces import STATE, tag

from .clairvoyant import fluctuations_of, pullers_of
from .lqg import LQG, LQGDesign, LQGGains, solve_each
from .lqg_estimator import MultipleModelFilter, PlantFilter
from .lqg_filter import DRIFT, DRIFT_RATE, FAST, PLANT, SLOW, STATES, NoiseModel, load_per_drift
from .policy import Floats, batched, reset_rows, to_action

_LEAST_SD = 0.01
"""Least standard deviation of a fluctuation [K]: a filter that expects none cannot follow what its model leaves out."""
_TINY = 1e-9
"""Uncertainty of the sum of the fluctuations in Riccati's equation, as a share of its variance [-]."""


@dataclass(frozen=True)
class PrivilegedLQG(LQG):
    """The LQG with each slot's own puller as its model: a bound on the worth of the parameters.

    With ``knows_fluctuations`` its filter has the strength of each crystal's interface fluctuations too. Before
    ``for_episodes`` it is the LQG of the nominal puller.
    """

    gains_by_slot: LQGGains | None = None
    knows_fluctuations: bool = False

    @cached_property
    def gains(self) -> LQGGains:
        """Gains of the slots' own pullers."""
        return super().gains if self.gains_by_slot is None else self.gains_by_slot

    def estimator(self, n: int) -> PlantFilter | MultipleModelFilter:
        """The filter; ValueError for another number of slots than of known pullers."""
        known = n if self.gains_by_slot is None else len(self.gains_by_slot.filter.plant.A)
        if known != n:
            raise ValueError(f"{known} pullers are known, got {n} slots: one puller a slot is needed")
        return super().estimator(n)

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> Self:
        """Return the controller that knows those episodes, one a slot."""
        designs = [self.design] * len(seeds)
        if self.knows_fluctuations:
            sds = np.maximum(fluctuations_of(config, seeds), _LEAST_SD).tolist()
            noises = [replace(self.design.noise, fast_sd=fast, slow_sd=slow) for fast, slow in sds]
            designs = [replace(self.design, noise=noise) for noise in noises]
        solved = solve_each(designs, config.control_interval, pullers_of(config, seeds), config.meniscus)
        return replace(self, gains_by_slot=solved)


class ExactState(NamedTuple):
    """The true state in place of an estimate."""

    mean: Floats
    """State of the augmented plant, deviations in SI units, shape (n, 10)."""


class TrueStateFilter(NamedTuple):
    """A filter that sees the state and the present disturbances.

    It separates the two interface fluctuations, of which the sum is seen, by a noise-free Kalman filter.
    """

    models: PlantFilter

    def at_rest(self, n: int) -> ExactState:
        """The state before the first sample of n slots."""
        return ExactState(np.zeros((n, len(STATES))))

    def step(
        self, state: ExactState, applied: Floats, drift_moved: Floats, seen: Any, starts: npt.NDArray[np.bool_]
    ) -> ExactState:
        """The state at a sample, given the one before."""
        dt, before, mean = self.models.dt, state.mean, np.zeros(state.mean.shape)
        radius = seen.r_c_error + seen.r_ref + seen.ring_offset  # of no cost where the ring shows r_ref
        mean[:, :PLANT] = np.stack([radius, seen.h_c, seen.T_1, seen.T_2, seen.T_b], axis=-1)
        mean[:, [FAST, SLOW]] = _separated(before[:, [FAST, SLOW]], seen.dT_i, starts, self.models.noise, dt)
        mean[:, DRIFT] = _drift(seen.Q_d, self.models.puller)
        mean[:, DRIFT_RATE] = np.where(starts, 0.0, mean[:, DRIFT] - before[:, DRIFT]) / dt
        return ExactState(mean)


@dataclass(frozen=True)
class FullInformation(PrivilegedLQG):
    """The LQG's regulator on the true state and the present disturbances ("state" observations), without the future."""

    observation: ClassVar[str] = "state"

    def estimator(self, n: int) -> Any:
        """The true state of n slots."""
        super().estimator(n)
        return TrueStateFilter(self.gains.filter)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Return the action and the next memory; arguments as of :class:`cz_gym.baselines.policy.Policy`."""
        array, single = batched(observation)
        values = (array * scales(STATE, self.v_0, self.heater_range)).T
        seen: Any = SimpleNamespace(**dict(zip((channel.name for channel in STATE), values, strict=True)))
        pull, power, memory = self.step(seen, reset_rows(state, self.at_rest(seen), episode_start))
        return tag(to_action(pull / self.v_0, power / self.heater_range, single), self.made_for), memory


@lru_cache(maxsize=16)
def _separation(noise: NoiseModel, dt: float) -> tuple[Floats, Floats, Floats]:
    """Decay of the two fluctuations over dt [s], Kalman gain on their exactly seen sum, and gain at the start."""
    keep = np.array([math.exp(-dt / noise.fast_tau), math.exp(-dt / noise.slow_tau)])
    variance = np.array([noise.fast_sd, noise.slow_sd]) ** 2
    tiny = _TINY * variance.sum()
    P = solve_discrete_are(np.diag(keep), np.ones((2, 1)), np.diag((1.0 - keep**2) * variance), np.array([[tiny]]))
    return keep, P.sum(axis=1) / (P.sum() + tiny), variance / variance.sum()


def _separated(old: Floats, total: Floats, starts: npt.NDArray[np.bool_], noise: NoiseModel, dt: float) -> Floats:
    """The fast and the slow part of the fluctuation [K], shape (n, 2), from its ``total`` and the ``old`` parts."""
    keep, gain, first = _separation(noise, dt)
    predicted = old * keep
    parts: Floats = predicted + np.where(starts[:, None], first, gain) * (total - predicted.sum(axis=-1))[:, None]
    return parts


def _drift(Q_d: Floats, p: Any) -> Floats:
    """The drift [K] whose static load is Q_d [W], by Newton's method from the linearised one."""
    slope = load_per_drift(p)
    drift: Floats = Q_d / slope
    for _ in range(3):
        drift = drift - (hidden_load(drift, p) - Q_d) / slope
    return drift


def privileged(plain: LQG, knows_fluctuations: bool = True) -> PrivilegedLQG:
    """Bound: that LQG with each puller's parameters and, by default, the strength of each crystal's fluctuations."""
    known = {each.name: getattr(plain, each.name) for each in fields(plain) if each.name != "hypotheses"}
    return PrivilegedLQG(**known, knows_fluctuations=knows_fluctuations)


def full_information(design: LQGDesign, config: Config) -> FullInformation:
    """Bound: an LQG's regulator on the true state and the present disturbances."""
    exact = replace(design, noise=replace(design.noise, recipe_share=0.0), heater_slack=0.0)
    return FullInformation(design=exact).for_config(config)
