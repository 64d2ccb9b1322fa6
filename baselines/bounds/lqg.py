"""Bounds made of the LQG's parts: what a perfect model, and what a perfect view of the present, would be worth.

They are told what no controller knows and stand in tables as bounds, never as contenders. What they are told comes
through ``for_episodes``, which a rollout calls with the episodes it is about to run.
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
from cz_gym.baselines.lqg.controller import LQG, Gains, LQGSettings, act, solve_each
from cz_gym.baselines.lqg.model import DRIFT, FAST, PLANT, SLOW, STATES, NoiseModel, load_per_drift
from cz_gym.baselines.lqg.preview import look_ahead, samples_ahead
from cz_gym.baselines.lqg.settings import settings_of
from cz_gym.baselines.policy import Floats, batched, fresh, to_action
from cz_gym.config import Config
from cz_gym.engine.batch import first_key
from cz_gym.episodes.series import draw_episode, draw_factors, new_series, randomised
from cz_gym.observation import HEATER_SCALE, STATE, Measured, scales
from cz_gym.physics.plant import Puller, hidden_load, make_puller

_SMOOTHEST = 0.01
"""Least standard deviation of a fluctuation [K]: a filter that expects none would not see what its model leaves out."""
_TINY = 1e-9
"""Share of the fluctuations' variance by which their sum is taken to be uncertain, for Riccati's equation."""


def pullers_of(config: Config, seeds: Sequence[int]) -> tuple[Puller, ...]:
    """The pullers that those seeds draw in their first episode, by the environment's own functions."""
    pullers = []
    for seed in seeds:
        factors = draw_factors(config.scenario, config.mix, first_key(seed))
        pullers.append(make_puller(randomised(config.parameters, factors), factors.lam, config.meniscus))
    return tuple(pullers)


def roughness_of(config: Config, seeds: Sequence[int]) -> tuple[tuple[float, float], ...]:
    """Standard deviations of fast and slow interface fluctuation [K] of those seeds' first episodes."""
    drawn = (draw_episode(config.scenario, first_key(seed), new_series(1, 0)) for seed in seeds)
    return tuple((float(episode.sd_fast), float(episode.sd_slow)) for episode in drawn)


@dataclass(frozen=True)
class ToldLQG(LQG):
    """The LQG with each slot's own puller as its model: what knowing the parameters is worth.

    With ``roughness`` its filter also has each slot's own interface fluctuation, which is as rough on one crystal as on
    the next on average only. Until it is told, it takes the nominal puller for everyone's, as the LQG does.
    """

    told: Gains | None = None
    roughness: bool = False

    @property
    def gains(self) -> Gains:
        """Gains of the slots' own pullers."""
        return super().gains if self.told is None else self.told

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """The action and what to remember; ValueError for another number of slots than it was told."""
        _check_slots(self.told, observation)
        return super().predict(observation, state, episode_start, deterministic)

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> ToldLQG:
        """The same controller for those episodes, one a slot."""
        settings = [self.settings] * len(seeds)
        if self.roughness:
            settings = [_as_rough(self.settings, *each) for each in roughness_of(config, seeds)]
        told = solve_each(settings, config.control_interval, pullers_of(config, seeds), config.meniscus)
        return replace(self, told=told)


def _as_rough(settings: LQGSettings, fast: float, slow: float) -> LQGSettings:
    """The settings for a melt of that roughness [K]."""
    noise = replace(settings.noise, fast_sd=max(fast, _SMOOTHEST), slow_sd=max(slow, _SMOOTHEST))
    return replace(settings, noise=noise)


def _check_slots(told: Gains | None, observation: Any) -> None:
    slots = len(np.atleast_2d(observation))
    if told is not None and len(told.eye.model.A) != slots:
        raise ValueError(f"told {len(told.eye.model.A)} pullers, got {slots} slots: one puller a slot is needed")


class Memory(NamedTuple):
    """What the full-information regulator remembers."""

    fluctuation: Floats
    """The two parts of the interface fluctuation [K], shape (n, 2)."""
    drift: Floats
    """Drift of the hot zone at the last sample [K], shape (n,)."""
    plan: Floats
    """Recipe ahead, shape (n, 2, samples + 1)."""
    begun: Floats
    """1 once the slot has seen a sample, shape (n,)."""


@dataclass(frozen=True)
class FullInformation:
    """The LQG's regulator on the true state and the present disturbances ("state" observations); no future.

    It is told each slot's puller too. The interface fluctuation is seen as a sum: a noise-free Kalman filter of two
    states parts it into fast and slow. The drift is the one whose static load is seen, its rate the last change.
    """

    law: ToldLQG = field(default_factory=ToldLQG)

    def for_episodes(self, config: Config, seeds: Sequence[int]) -> FullInformation:
        """The same regulator for those episodes, one a slot."""
        return FullInformation(self.law.for_episodes(config, seeds))

    def predict(
        self, observation: Any, state: Memory | None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Memory]:
        """The action and what to remember."""
        array, single = batched(observation)
        _check_slots(self.law.told, observation)
        gains, v_0 = self.law.gains, self.law.parameters.v_0
        p, dt = gains.eye.puller, gains.eye.dt
        seen = dict(zip((channel.name for channel in STATE), (array * scales(STATE, v_0)).T, strict=True))
        n = len(array)
        rest = Memory(np.zeros((n, 2)), np.zeros(n), np.zeros((n, 2, samples_ahead(dt) + 1)), np.zeros(n))
        memory = fresh(state, rest, episode_start)
        begins = memory.begun == 0.0
        fluctuation = _parted(memory.fluctuation, seen["dT_i"], begins, gains.eye.noise, dt)
        drift = _drift(seen["Q_d"], p)
        plan = look_ahead(memory.plan, _recipe(seen), begins, dt)
        x = np.zeros((n, len(STATES)))
        x[:, :PLANT] = np.stack([seen[name] for name in ("r_c_error", "h_c", "T_1", "T_2", "T_b")], axis=-1)
        x[:, 0] += seen["r_ref"]
        x[:, [FAST, SLOW]] = fluctuation
        x[:, DRIFT] = drift
        x[:, DRIFT + 1] = np.where(begins, 0.0, drift - memory.drift) / dt
        applied = np.stack([seen["v_p"], seen["Q_H"]], axis=-1)
        inputs = act(x, plan, applied, gains.regulator, 0.0, v_0)
        action = to_action(inputs[:, 0] / v_0, inputs[:, 1] / HEATER_SCALE, single)
        return action, Memory(fluctuation, drift, plan, np.ones(n))


@lru_cache(maxsize=16)
def _parting(noise: NoiseModel, dt: float) -> tuple[Floats, Floats, Floats]:
    """Decay of the two fluctuations over dt [s], Kalman gain on their exactly seen sum, and gain at the start."""
    keep = np.array([math.exp(-dt / noise.fast_tau), math.exp(-dt / noise.slow_tau)])
    variance = np.array([noise.fast_sd, noise.slow_sd]) ** 2
    tiny = _TINY * variance.sum()
    P = kalman.steady_state(np.diag(keep), np.ones((1, 2)), np.diag((1.0 - keep**2) * variance), np.array([[tiny]]))
    return keep, P.sum(axis=1) / (P.sum() + tiny), variance / variance.sum()


def _parted(old: Floats, total: Floats, begins: npt.NDArray[np.bool_], noise: NoiseModel, dt: float) -> Floats:
    """The fluctuation [K] parted into fast and slow, shape (n, 2)."""
    keep, gain, first = _parting(noise, dt)
    predicted = old * keep
    parted: Floats = predicted + np.where(begins[:, None], first, gain) * (total - predicted.sum(axis=-1))[:, None]
    return parted


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


def lqg_told(law: LQG) -> ToldLQG:
    """Bound: that LQG told each puller's parameters and how rough its melt is."""
    return ToldLQG(law.settings, law.control_interval, law.parameters, law.meniscus, roughness=True)


def lqg_true(config: Config) -> ToldLQG:
    """Bound: the LQG told each puller's parameters."""
    settings = settings_of("lqg", config.scenario.name)
    return ToldLQG(settings, config.control_interval, config.parameters, config.meniscus)


def full_information(config: Config) -> FullInformation:
    """Bound: the LQG's regulator on the true state and the present disturbances."""
    return FullInformation(lqg_true(config))
