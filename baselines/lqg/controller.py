"""Linear-quadratic-Gaussian control of pull speed and heater, jointly.

An extended Kalman filter (:mod:`cz_gym.baselines.lqg.estimator`) on the augmented plant
(:mod:`cz_gym.baselines.lqg.model`), and a regulator with costs on input moves and five minutes of recipe preview
(:mod:`cz_gym.baselines.lqg.regulator`). Inputs enter the filter as the drives applied them, so that limits and slew
rates never wind anything up.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats, MeasuredController, stack
from cz_gym.observation import HEATER_SCALE, Measured
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters
from cz_gym.physics.plant import Puller, make_puller
from cz_gym.units import KILO

from .estimator import PlantFilter
from .filter_bank import FilterBank, Hypotheses, filter_bank
from .model import STATES, NoiseModel, plant_model
from .preview import look_ahead, samples_ahead
from .regulator import Regulator, Weights, regulator
from .ring_model import RingModel, augmented


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
    """What is known of a camera with latency or a ring with ripple; None for neither."""

    @property
    def hash(self) -> str:
        """SHA-256 of the settings (16 hex digits)."""
        given = {name: value for name, value in asdict(self).items() if value is not None}
        return hashlib.sha256(json.dumps(given, sort_keys=True).encode()).hexdigest()[:16]


class Gains(NamedTuple):
    """What follows from settings, interval and puller, of one puller or of one a slot."""

    filter: PlantFilter
    regulator: Regulator
    """Its arrays have a leading axis n for one puller a slot."""


class Memory(NamedTuple):
    """What the controller remembers."""

    filter: Any
    """State of the filter or of the filter bank."""
    plan: Floats
    """Recipe ahead, shape (n, 2, samples + 1): r_ref [m] and T_1_ref [K]."""
    command: Floats
    """Inputs asked for last [m/s, W], deviations, shape (n, 2)."""
    started: Floats
    """1 once the slot has seen a sample, shape (n,)."""


@lru_cache(maxsize=16)
def solve(settings: LQGSettings, dt: float, puller: Puller, meniscus: MeniscusModel = HURLE) -> Gains:
    """Linearise at that puller's operating point and solve the regulator's Riccati equation."""
    model = plant_model(puller, settings.noise, dt, meniscus)
    if settings.ring is not None:
        model = augmented(model, settings.ring, dt)
    chosen = settings.nonlinear, settings.gate, settings.ring
    state_filter = PlantFilter(puller, model, settings.noise, meniscus, dt, *chosen)
    return Gains(state_filter, regulator(model, settings.weights, dt, samples_ahead(dt)))


def solve_each(
    settings: Sequence[LQGSettings], dt: float, pullers: Sequence[Puller], meniscus: MeniscusModel = HURLE
) -> Gains:
    """The same for settings and a puller a slot; settings may differ in the noise that drives the plant."""
    pairs = zip(settings, pullers, strict=True)
    filters, laws = zip(*(solve.__wrapped__(each, dt, puller, meniscus) for each, puller in pairs), strict=True)
    plant = stack([each.plant for each in filters])
    return Gains(filters[0]._replace(puller=stack(pullers), plant=plant), stack(laws))


@dataclass(frozen=True)
class LQG(MeasuredController):
    """Acts on "measured" (or "history") observations; knows the nominal puller, not this one."""

    settings: LQGSettings = LQGSettings()
    control_interval: float = 5.0
    """Time between actions [s]."""
    parameters: Parameters = field(default_factory=Parameters)
    """Parameters of the nominal puller."""
    meniscus: MeniscusModel = HURLE

    @property
    def v_0(self) -> float:
        """Nominal pull speed [m/s]."""
        return self.parameters.v_0

    @property
    def gains(self) -> Gains:
        """Gains of the design point."""
        return _at_design_point(self.settings, self.control_interval, self.parameters, self.meniscus)

    def bank(self, hypotheses: Hypotheses, n: int) -> FilterBank:
        """A bank of the design point's filters for n slots."""
        return _bank(self.settings, self.control_interval, self.parameters, self.meniscus, hypotheses, n)

    def at_rest(self, seen: Measured) -> Memory:
        """The filter at its initial covariance."""
        return memory_at_rest(len(seen.v_p), self.gains.filter, self.control_interval)

    def step(self, seen: Measured, memory: Memory) -> tuple[Floats, Floats, Memory]:
        """Pull speed and heater power above nominal, and the new memory."""
        return self.step_with(self.gains.filter, self.law, seen, memory)

    def law(self, estimate: Floats, plan: Floats, previous: Floats) -> Floats:
        """The regulator's inputs; arguments as of :func:`optimal_inputs`."""
        return optimal_inputs(
            estimate, plan, previous, self.gains.regulator, self.settings.noise.recipe_share, self.v_0
        )

    def step_with(
        self,
        state_filter: PlantFilter | FilterBank,
        law: Callable[[Floats, Floats, Floats], Floats],
        seen: Measured,
        memory: Memory,
    ) -> tuple[Floats, Floats, Memory]:
        """The same with another filter, and another law from estimate, plan and previous inputs to the inputs."""
        starts = memory.started == 0.0
        applied = np.stack([seen.v_p, seen.Q_H], axis=-1)
        drift_moved = self.settings.noise.recipe_share * (memory.plan[:, 1, 1] - memory.plan[:, 1, 0])
        state = state_filter.step(memory.filter, applied, drift_moved, seen, starts)
        plan = look_ahead(memory.plan, seen, starts, self.control_interval)
        previous = previous_inputs(applied, memory.command, starts, self.settings.heater_slack)
        inputs = law(state.mean, plan, previous)
        return inputs[:, 0], inputs[:, 1], Memory(state, plan, inputs, np.ones(len(inputs)))


@lru_cache(maxsize=16)
def _at_design_point(settings: LQGSettings, dt: float, parameters: Parameters, meniscus: MeniscusModel) -> Gains:
    return solve(settings, dt, make_puller(parameters, settings.lam, meniscus), meniscus)


@lru_cache(maxsize=2)
def _bank(
    settings: LQGSettings, dt: float, parameters: Parameters, meniscus: MeniscusModel, hypotheses: Hypotheses, n: int
) -> FilterBank:
    return filter_bank(_at_design_point(settings, dt, parameters, meniscus).filter, hypotheses, n)


def memory_at_rest(n: int, state_filter: PlantFilter | FilterBank, dt: float) -> Memory:
    """Memory before the first sample of n slots, at a control interval of dt [s]."""
    return Memory(state_filter.at_rest(n), np.zeros((n, 2, samples_ahead(dt) + 1)), np.zeros((n, 2)), np.zeros(n))


def previous_inputs(applied: Floats, command: Floats, starts: npt.NDArray[np.bool_], heater_slack: float) -> Floats:
    """The inputs that moves start from: the applied ones, or the heater's command where it is as near as it can be."""
    slack = np.array([0.0, heater_slack])
    previous: Floats = applied + np.where(starts[:, None], 0.0, np.clip(command - applied, -slack, slack))
    return previous


def optimal_inputs(
    estimate: Floats, plan: Floats, previous: Floats, law: Regulator, recipe_share: float, v_0: float
) -> Floats:
    """The regulator's inputs [m/s, W], deviations within the drives' range, shape (n, 2).

    ``estimate`` has shape (n, states), ``plan`` (n, 2, samples + 1), ``previous`` (n, 2); the drift is expected to
    follow ``recipe_share`` of the recipe's movement. ``v_0`` is the nominal pull speed [m/s].
    """
    error = estimate[:, : len(STATES)].copy()
    error[:, 0] -= plan[:, 0, 0]
    ahead = np.diff(plan, axis=-1)
    moves = -(law.feedback @ np.concatenate([error, previous], axis=-1)[..., None])[..., 0]
    moves += (ahead[:, :1] @ law.reference)[:, 0] + recipe_share * (ahead[:, 1:] @ law.drift)[:, 0]
    limit = np.array([v_0, HEATER_SCALE])
    inputs: Floats = np.clip(previous + moves, -limit, limit)
    return inputs
