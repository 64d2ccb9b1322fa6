"""Recipes: every hyperparameter of every learner. A kind of learner is a dataclass, a recipe one value of it.

A new kind needs a dataclass here, a learner (:class:`.learner.Learner`) and a line in :func:`.learners.make_learner`; a
new recipe needs a line in :data:`RECIPES`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from cz_gym.config import Config, make_config
from cz_gym.cost import WEIGHTS, Weights


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What every recipe has, whatever it learns from."""

    name: str
    """Name of the agents that it trains."""
    steps: int = 0
    """Environment steps of learning from reward or cost; 0 for an imitation."""
    observation: str = "history"
    action: str = "smooth"
    """Meaning of the network's two outputs (:func:`cz_gym.task.drives_of`)."""
    scenario: str = "randomized"
    """Scenario of the training and validation crystals."""
    control_interval: float = 5.0
    """Time between actions [s]."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers, of actor and critic alike."""
    basis: str = "differences"
    """How networks see the past: as "differences" between the means of successive spans, or as these "means"."""
    memory: float = 1200.0
    """Age of the oldest past sample that networks see [s]; 0: only the integral."""
    threads: int = 1
    """Threads that torch computes on."""
    weights: Weights = WEIGHTS
    """Weights of the cost's terms, in training and validation."""
    observable: bool = False
    """Whether the cost's radius error leaves out the offset that no sensor shows."""

    @property
    def config(self) -> Config:
        """The environment that the recipe's agents act in."""
        return make_config(
            self.scenario, observation=self.observation, control_interval=self.control_interval, action=self.action
        )


@dataclass(frozen=True, kw_only=True)
class Imitation(Recipe):
    """DAgger: the network learns to act as a classical controller does, also where its own mistakes lead it.

    The controller may be privileged, that is know more than sensors show. Some crystals are wide: on crystals no worse
    than the scenario's own the network never sees how one is saved.
    """

    hidden: tuple[int, ...] = (128, 128)
    teacher: str = "lqg-at-0.02-privileged"
    """Name of the controller that is imitated."""
    rounds: int = 8
    """Rounds of demonstrations: in the first the teacher controls the crystals, in the others the imitation does."""
    episodes: int = 480
    """Training episodes in a round."""
    wide_share: float = 0.25
    """Share of each round's crystals that are wide [-]."""
    width: float = 2.0
    """Spread of everything random on wide crystals, in units of the scenario's own [-]."""
    noise: tuple[float, float] = (0.06, 0.02)
    """Standard deviation of the noise added to the actions while demonstrating, pull speed and heater [-]."""
    epochs: int = 4
    """Passes through all demonstrations so far, in each round."""
    learning_rate: float = 2e-3
    """Peak of each round's one-cycle schedule."""
    loss_weights: tuple[float, float] = (1.0, 0.0)
    """Weights of the errors in pull speed and heater in the fit by gradient [-]; 0: a drive keeps its regression."""


class Share(NamedTuple):
    """A share of the training crystals."""

    scenario: str
    """Their scenario; "" for the recipe's own."""
    width: float
    """Spread of everything random, in units of the scenario's own [-]."""
    share: float
    """Share of all crystals [-]."""


@dataclass(frozen=True, kw_only=True)
class Gradient(Recipe):
    """Follows the gradient of the cost through policy, memory and plant."""

    name: str = "gradient"
    observation: str = "measured"
    action: str = "rate"
    steps: int = 96_768_000
    num_envs: int = 192
    """Crystals at a time."""
    window: int = 180
    """Steps of a crystal that a gradient goes back through."""
    mixture: tuple[Share, ...] = (
        Share("", 2.0, 0.05),
        Share("hard", 1.0, 0.2),
        Share("sensor-fault", 1.0, 0.2),
        Share("puller", 1.0, 0.25),
    )
    """Shares of other training crystals; the rest are the recipe's scenario's own."""
    start: str = ""
    """Agent of such a recipe that training continues from: a file, a folder of ``train.py --seeds``, or a shipped name,
    of which each training seed takes its own; "": none, random initial weights."""
    hidden: tuple[int, ...] = (64,)
    whitened: bool = False
    """Whether, after a warm-up, the learned weights are those of whitened features."""
    imputes_failed_readings: bool = False
    """Whether a linear regression, learned in the warm-up, replaces readings that fail; else a mean over 23 s does."""
    normalise_cost: bool = False
    """Whether a crystal counts by the root of its cost, as in a mean of RMS errors; else by its cost."""
    learning_rate: float = 1.2e-2
    """Adam's initial learning rate, decayed linearly to zero."""
    beta2: float = 0.9
    """Adam's decay of the squared gradients: the first ones, of lost crystals, are a thousand times those that
    follow."""


@dataclass(frozen=True, kw_only=True)
class Reinforcement(Recipe):
    """Learns from reward, by trying; further fields have the names of stable-baselines3's arguments."""

    num_envs: int
    """Crystals at a time."""
    gamma: float = 0.99
    learning_rate: float
    """Initial learning rate, decayed linearly to a twentieth."""
    batch_size: int
    noise: float
    """Standard deviation of the initial exploration [-]."""
    privileged_critic: bool = False
    """Whether the critic also sees the true state."""
    episode_length: float = 10800.0
    """Length of the training episodes [s]; validation episodes have their full length."""
    failure_costs: bool = True
    """Whether a lost crystal costs what is left of it; without, rewards are positive and end there."""


@dataclass(frozen=True, kw_only=True)
class PPO(Reinforcement):
    """Proximal policy optimisation; the critic sees the true state."""

    name: str = "ppo"
    steps: int = 20_000_000
    num_envs: int = 512
    privileged_critic: bool = True
    n_steps: int = 64
    """Steps of each crystal between updates."""
    batch_size: int = 2048
    n_epochs: int = 5
    learning_rate: float = 1e-3
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    noise: float = 0.5


@dataclass(frozen=True, kw_only=True)
class SAC(Reinforcement):
    """Soft actor-critic.

    While it learns, each action is repeated for 20 s: the effect of one action of 5 s is lost in the critic's errors.
    """

    name: str = "sac"
    steps: int = 1_500_000
    """Actions, each of which is repeated."""
    num_envs: int = 64
    action_repeat: int = 4
    """Environment steps that an action is repeated for in training."""
    gamma: float = 0.97
    failure_costs: bool = False
    noise: float = 0.2
    buffer_size: int = 1_000_000
    learning_starts: int = 10_000
    """Actions before the first update."""
    batch_size: int = 512
    gradient_steps: int = 4
    """Updates after each step of all crystals."""
    learning_rate: float = 5e-4
    tau: float = 0.01
    ent_coef: str = "auto_0.005"
    """Initial weight of the entropy, in units of the reward times 1 - gamma; it adapts."""


def relative(pull: float, pull_step: float, heater_step: float) -> Weights:
    """The environment's weights with those of pull speed, pull steps and heater steps multiplied."""
    factors = 1.0, pull, pull_step, heater_step
    return Weights(*(factor * weight for factor, weight in zip(factors, WEIGHTS, strict=True)))


LQG_COST = relative(0.0178, 0.1, 51.6)
"""Weights that the regulator of lqg-at-0.02 was designed for."""
START_COST = relative(0.11, 0.07, 23.4)
"""Weights near those of lqg-quiet."""
_CONTINUED = Gradient(start="gradient", whitened=True, observable=True)
RECIPES: dict[str, Recipe] = {
    recipe.name: recipe
    for recipe in (
        PPO(),
        SAC(),
        Imitation(name="imitation", weights=LQG_COST),
        Gradient(name="gradient-start", weights=START_COST, observable=True),
        # On ``puller`` the pull speed is often at its limits; the heater, which then has to act, takes over 15 min.
        replace(
            _CONTINUED,
            start="",
            steps=Gradient.steps * 3 // 8,
            mixture=(
                Share("", 2.0, 0.05),
                Share("hard", 1.0, 0.2),
                Share("sensor-fault", 1.0, 0.3),
                Share("puller", 1.0, 0.25),
            ),
            num_envs=64,
            window=540,
            imputes_failed_readings=True,
            normalise_cost=True,
            learning_rate=3e-3,
            weights=relative(0.05, 0.14, 23.4),
        ),
        replace(
            _CONTINUED,
            name="gradient-specialist",
            steps=Gradient.steps // 4,
            mixture=(Share("sensor-fault", 1.0, 0.3), Share("", 2.0, 0.03)),
            learning_rate=2e-3,
            weights=relative(0.018, 0.14, 23.4),
        ),
    )
}
"""Recipes by name: the choices of ``train.py --algo``."""
DEFAULT = "ppo"
"""The recipe that train.py follows unless another is named."""
