"""Privileged LQGs: bounds on what a perfect model, and a perfect view of the present, would be worth.

They know what no controller can know, and stand in tables as bounds, never as contenders. They get their knowledge
through ``for_episodes``, which a rollout calls with the episodes that it is about to run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.lqg import kalman
from cz_gym.baselines.lqg.controller import LQG, Gains, LQGSettings, Memory, optimal_inputs, solve_each
from cz_gym.baselines.lqg.model import DRIFT, FAST, PLANT, SLOW, STATES, NoiseModel, load_per_drift
from cz_gym.baselines.lqg.preview import look_ahead, samples_ahead
from cz_gym.baselines.lqg.settings import settings_of
from cz_gym.baselines.policy import Floats, batched, fresh, to_action
from cz_gym.config import Config
from cz_gym.errors import CzError
from cz_gym.observation import HEATER_SCALE, STATE, Measured, scales
from cz_gym.physics.plant import hidden_load

from .future import fluctuations_of, pullers_of

_LEAST_SD = 0.01
"""Least standard deviation of a fluctuation [K]: a filter that expects none would not see what its model leaves out."""
_TINY = 1e-9
"""Share of the fluctuations' variance by which their sum is taken to be uncertain, for Riccati's equation."""


@dataclass(frozen=True)
class PrivilegedLQG(LQG):
    """The LQG with each slot's own puller as its model: what knowing the parameters is worth.

    With ``knows_fluctuations`` its filter also has each crystal's own strength of the interface fluctuations, where
    other LQGs assume the average. Before ``for_episodes`` it is the LQG with the nominal puller.
    """

    gains_by_slot: Gains | None = None
    knows_fluctuations: bool = False

    @property
    def gains(self) -> Gains:
        """Gains of the slots' own pullers."""
        return super().gains if self.gains_by_slot is None else self.gains_by_slot

    def at_rest(self, seen: Measured) -> Memory:
        """The filter at its initial covariance; ValueError for another number of slots than of known pullers."""
        self.check_slots(len(seen.v_p))
        return super().at_rest(seen)

    def check_slots(self, slots: int) -> None:
        """ValueError for another number of slots than of known pullers."""
        known = slots if self.gains_by_slot is None else len(self.gains_by_slot.filter.plant.A)
        if known != slots:
            raise CzError(f"{known} pullers are known, got {slots} slots: one puller a slot is needed")

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> PrivilegedLQG:
        """The same controller for those episodes, one a slot."""
        settings = [self.settings] * len(seeds)
        if self.knows_fluctuations:
            settings = [_with_fluctuations(self.settings, *each) for each in fluctuations_of(config, seeds)]
        solved = solve_each(settings, config.control_interval, pullers_of(config, seeds), config.meniscus)
        return replace(self, gains_by_slot=solved)


def _with_fluctuations(settings: LQGSettings, fast: float, slow: float) -> LQGSettings:
    """The settings for fluctuations of those standard deviations [K]."""
    noise = replace(settings.noise, fast_sd=max(fast, _LEAST_SD), slow_sd=max(slow, _LEAST_SD))
    return replace(settings, noise=noise)


class FullMemory(NamedTuple):
    """What the full-information regulator remembers."""

    fluctuation: Floats
    """The fast and the slow part of the interface fluctuation [K], shape (n, 2)."""
    drift: Floats
    """Drift of the hot zone at the last sample [K], shape (n,)."""
    plan: Floats
    """Recipe ahead, shape (n, 2, samples + 1)."""
    started: Floats
    """1 once the slot has seen a sample, shape (n,)."""


@dataclass(frozen=True)
class FullInformation:
    """The LQG's regulator on the true state and the present disturbances ("state" observations); no future.

    It knows each slot's puller too. The interface fluctuation is seen as a sum: a noise-free Kalman filter of two
    states separates fast and slow. The drift is the one whose static load is seen, its rate the last change.
    """

    lqg: PrivilegedLQG = field(default_factory=PrivilegedLQG)

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> FullInformation:
        """The same regulator for those episodes, one a slot."""
        return FullInformation(self.lqg.for_episodes(config, seeds))

    def predict(
        self, observation: Any, state: FullMemory | None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], FullMemory]:
        """The action and what to remember."""
        array, single = batched(observation)
        n = len(array)
        self.lqg.check_slots(n)
        gains, v_0 = self.lqg.gains, self.lqg.v_0
        p, dt = gains.filter.puller, gains.filter.dt
        seen = dict(zip((channel.name for channel in STATE), (array * scales(STATE, v_0)).T, strict=True))
        rest = FullMemory(np.zeros((n, 2)), np.zeros(n), np.zeros((n, 2, samples_ahead(dt) + 1)), np.zeros(n))
        memory = fresh(state, rest, episode_start)
        starts = memory.started == 0.0
        fluctuation = _separated(memory.fluctuation, seen["dT_i"], starts, gains.filter.noise, dt)
        drift = _drift(seen["Q_d"], p)
        plan = look_ahead(memory.plan, _recipe(seen), starts, dt)
        x = np.zeros((n, len(STATES)))
        x[:, :PLANT] = np.stack([seen[name] for name in ("r_c_error", "h_c", "T_1", "T_2", "T_b")], axis=-1)
        x[:, 0] += seen["r_ref"]
        x[:, [FAST, SLOW]] = fluctuation
        x[:, DRIFT] = drift
        x[:, DRIFT + 1] = np.where(starts, 0.0, drift - memory.drift) / dt
        applied = np.stack([seen["v_p"], seen["Q_H"]], axis=-1)
        inputs = optimal_inputs(x, plan, applied, gains.regulator, 0.0, v_0)
        action = to_action(inputs[:, 0] / v_0, inputs[:, 1] / HEATER_SCALE, single)
        return action, FullMemory(fluctuation, drift, plan, np.ones(n))


@lru_cache(maxsize=16)
def _separation(noise: NoiseModel, dt: float) -> tuple[Floats, Floats, Floats]:
    """Decay of the two fluctuations over dt [s], Kalman gain on their exactly seen sum, and gain at the start."""
    keep = np.array([math.exp(-dt / noise.fast_tau), math.exp(-dt / noise.slow_tau)])
    variance = np.array([noise.fast_sd, noise.slow_sd]) ** 2
    tiny = _TINY * variance.sum()
    P = kalman.steady_state(np.diag(keep), np.ones((1, 2)), np.diag((1.0 - keep**2) * variance), np.array([[tiny]]))
    return keep, P.sum(axis=1) / (P.sum() + tiny), variance / variance.sum()


def _separated(old: Floats, total: Floats, starts: npt.NDArray[np.bool_], noise: NoiseModel, dt: float) -> Floats:
    """The fluctuation [K] as fast and slow part, shape (n, 2)."""
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


def _recipe(seen: dict[str, Floats]) -> Measured:
    """The recipe's channels as a "measured" observation has them; what is not the recipe is zero."""
    zero = np.zeros_like(seen["r_ref"])
    return Measured(*(seen[name] if "_ref" in name else zero for name in Measured._fields))


def privileged(lqg: LQG) -> PrivilegedLQG:
    """Bound: that LQG, knowing each puller's parameters and each crystal's fluctuations."""
    return PrivilegedLQG(lqg.settings, lqg.control_interval, lqg.parameters, lqg.meniscus, knows_fluctuations=True)


def lqg_true(config: Config) -> PrivilegedLQG:
    """Bound: the LQG, knowing each puller's parameters."""
    settings = settings_of("lqg", config.scenario.name)
    return PrivilegedLQG(settings, config.control_interval, config.parameters, config.meniscus)


def full_information(config: Config) -> FullInformation:
    """Bound: the LQG's regulator on the true state and the present disturbances."""
    return FullInformation(lqg_true(config))
