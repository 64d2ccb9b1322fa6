"""Linear-quadratic-Gaussian control of pull speed and heater, jointly.

An extended Kalman filter (:mod:`cz_gym.baselines.lqg.estimator`) on the augmented plant
(:mod:`cz_gym.baselines.lqg.model`), a regulator with costs on input moves and five minutes of recipe preview
(:mod:`cz_gym.baselines.lqg.regulator`). Inputs enter the estimator as the drives applied them, so that limits and slew
rates never wind anything up.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats, batched, fresh, to_action
from cz_gym.observation import HEATER_SCALE, Measured, decode
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.units import KILO

from . import estimator
from .late_ring import RingModel, augmented
from .model import STATES, NoiseModel, PlantModel, plant_model
from .preview import look_ahead, samples_ahead
from .regulator import Regulator, Weights, regulator


@dataclass(frozen=True)
class LQGSettings:
    """Everything that is chosen about an LQG; frozen and hashed."""

    noise: NoiseModel = field(default_factory=NoiseModel)
    weights: Weights = field(default_factory=Weights)
    lam: float = 0.5
    """Share of conduction at the design point [-]."""
    nonlinear: bool = True
    """Whether the filters predict through the plant's equations, or through the linearised ones."""
    gate: float = 4.0
    """Innovations count up to this many standard deviations [-]."""
    heater_slack: float = 0.06 * KILO
    """A heater this close to the power asked for [W] counts as there: the resolution of its drive."""
    ring: RingModel | None = None
    """What is known of a camera that is late or shaken; None for one that is neither."""

    @property
    def hash(self) -> str:
        """SHA-256 of the settings (16 hex digits)."""
        told = {name: value for name, value in asdict(self).items() if value is not None}
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()[:16]


class Gains(NamedTuple):
    """What follows from settings, interval and puller, of one puller or of one a slot."""

    eye: estimator.Eye
    regulator: Regulator
    """Its arrays have a leading axis n for one puller a slot."""


class Memory(NamedTuple):
    """What the controller remembers."""

    mean: Floats
    """Estimated state of the augmented plant, deviations in SI units, shape (n, states)."""
    covariance: Floats
    """Its covariance, shape (n, states, states)."""
    camera_variance: Floats
    """Variance of the camera's noise [m2], shape (n,)."""
    spectrum: Floats
    """As in :class:`cz_gym.baselines.lqg.late_ring.Search`, as the next two."""
    omega: Floats
    samples: Floats
    plan: Floats
    """Recipe ahead, shape (n, 2, samples + 1): r_ref [m] and T_1_ref [K]."""
    asked: Floats
    """Inputs asked for last [m/s, W], deviations, shape (n, 2)."""
    begun: Floats
    """1 once the slot has seen a sample, shape (n,)."""


@lru_cache(maxsize=16)
def solve(settings: LQGSettings, dt: float, puller: Puller, meniscus: MeniscusModel = HURLE) -> Gains:
    """Linearise at that puller's operating point and solve the regulator's Riccati equation."""
    model = plant_model(puller, settings.noise, dt, meniscus)
    if settings.ring is not None:
        model = augmented(model, settings.ring, dt)
    eye = estimator.Eye(puller, model, settings.noise, meniscus, dt, settings.nonlinear, settings.gate, settings.ring)
    return Gains(eye, regulator(model, settings.weights, dt, samples_ahead(dt)))


def solve_each(
    settings: Sequence[LQGSettings], dt: float, pullers: Sequence[Puller], meniscus: MeniscusModel = HURLE
) -> Gains:
    """The same for settings and a puller a slot; settings may differ in the noise that drives the plant."""
    pairs = zip(settings, pullers, strict=True)
    eyes, laws = zip(*(solve.__wrapped__(each, dt, puller, meniscus) for each, puller in pairs), strict=True)
    model = PlantModel(*(np.stack(parts) for parts in zip(*(eye.model for eye in eyes), strict=True)))
    puller = Puller(*(np.array(values) for values in zip(*pullers, strict=True)))  # type: ignore[arg-type]
    law = Regulator(*(np.stack(parts) for parts in zip(*laws, strict=True)))
    return Gains(eyes[0]._replace(puller=puller, model=model), law)


@dataclass(frozen=True)
class LQG:
    """Acts on "measured" (or "history") observations; knows the nominal puller, not this one."""

    settings: LQGSettings = LQGSettings()
    control_interval: float = 5.0
    """Time between actions [s]."""
    parameters: Parameters = field(default_factory=Parameters)
    """Parameters of the nominal puller."""
    meniscus: MeniscusModel = HURLE

    @property
    def gains(self) -> Gains:
        """Gains of the design point."""
        return _at_design_point(self.settings, self.control_interval, self.parameters, self.meniscus)

    def predict(
        self, observation: Any, state: Memory | None = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Memory]:
        """The action and what to remember."""
        array, single = batched(observation)
        seen = decode(array, self.parameters.v_0)
        gains = self.gains
        memory = fresh(state, at_rest(len(array), gains), episode_start)
        begins = memory.begun == 0.0
        applied = np.stack([seen.v_p, seen.Q_H], axis=-1)
        belief = self._estimate(memory, seen, applied, begins, gains.eye)
        plan = look_ahead(memory.plan, seen, begins, self.control_interval)
        previous = moved_from(applied, memory.asked, begins, self.settings.heater_slack)
        share = self.settings.noise.recipe_share
        inputs = act(belief.mean, plan, previous, gains.regulator, share, self.parameters.v_0)
        action = to_action(inputs[:, 0] / self.parameters.v_0, inputs[:, 1] / HEATER_SCALE, single)
        return action, Memory(*belief, plan, inputs, np.ones(len(array)))

    def _estimate(
        self, memory: Memory, seen: Measured, applied: Floats, begins: npt.NDArray[np.bool_], eye: estimator.Eye
    ) -> estimator.Belief:
        old = estimator.Belief(*memory[: len(estimator.Belief._fields)])
        moved = self.settings.noise.recipe_share * (memory.plan[:, 1, 1] - memory.plan[:, 1, 0])
        belief = estimator.predict(old, applied, moved, eye)
        if begins.any():
            belief = fresh(belief, old, begins)
        return estimator.correct(belief, seen, eye)


@lru_cache(maxsize=16)
def _at_design_point(settings: LQGSettings, dt: float, parameters: Parameters, meniscus: MeniscusModel) -> Gains:
    return solve(settings, dt, make_puller(parameters, settings.lam, meniscus), meniscus)


def moved_from(applied: Floats, asked: Floats, begins: npt.NDArray[np.bool_], heater_slack: float) -> Floats:
    """The inputs to move from: the applied ones, but what was asked of the heater if it is as near as it can be."""
    slack = np.array([0.0, heater_slack])
    previous: Floats = applied + np.where(begins[:, None], 0.0, np.clip(asked - applied, -slack, slack))
    return previous


def act(estimate: Floats, plan: Floats, previous: Floats, law: Regulator, recipe_share: float, v_0: float) -> Floats:
    """Inputs [m/s, W], deviations within the drives' range, from the previous ones and the plant's state.

    ``estimate`` has shape (n, states), ``plan`` (n, 2, samples + 1); the drift is expected to follow ``recipe_share``
    of the recipe's movement. ``v_0`` is the nominal pull speed [m/s].
    """
    error = estimate[:, : len(STATES)].copy()
    error[:, 0] -= plan[:, 0, 0]
    ahead = np.diff(plan, axis=-1)
    moves = -(law.feedback @ np.concatenate([error, previous], axis=-1)[..., None])[..., 0]
    moves += (ahead[:, :1] @ law.reference)[:, 0] + recipe_share * (ahead[:, 1:] @ law.drift)[:, 0]
    limit = np.array([v_0, HEATER_SCALE])
    inputs: Floats = np.clip(previous + moves, -limit, limit)
    return inputs


def at_rest(n: int, gains: Gains) -> Memory:
    """Memory before the first sample of n slots."""
    belief = estimator.begin(n, gains.eye)
    ahead = gains.regulator.reference.shape[-2]
    return Memory(*belief, np.zeros((n, 2, ahead + 1)), np.zeros((n, 2)), np.zeros(n))
