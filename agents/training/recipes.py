"""Recipes: every hyperparameter of every learner. A kind of learner is a dataclass, a recipe one value of it.

A new recipe needs a line in :data:`RECIPES`; a new kind needs a dataclass here and a case in
:func:`.algorithms.make_algorithm`.
"""

from __future__ import annotations

from dataclasses import dataclass

from cz_gym.config import Config, make_config
from cz_gym.cost import WEIGHTS, Weights
from cz_gym.evaluation.user_code import scenarios

QUIET = Weights(pull=0.025, pull_step=0.035, heater_step=1.17)
"""Weights near those of lqg-quiet: pull speed and its steps are cheaper than in the reward, heater steps dearer."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What every recipe has, whatever it learns from; fields have the names of stable-baselines3's arguments."""

    name: str
    """Name of the agents that it trains."""
    steps: int
    """Environment steps that it learns for."""
    num_envs: int
    """Crystals at a time."""
    learning_rate: float
    """Initial learning rate, decayed linearly."""
    observation: str = "history"
    action: str = "smooth"
    """Meaning of the network's two outputs (:func:`cz_gym.task.drives_of`)."""
    scenario: str = "randomized"
    """Scenario or mixture of the training and validation crystals (:func:`cz_gym.evaluation.user_code.scenarios`)."""
    control_interval: float = 5.0
    """Time between actions [s]."""
    weights: Weights = WEIGHTS
    """Weights of the cost's terms, in training and validation."""
    observable: bool = False
    """Whether the cost's radius error leaves out the offset that no sensor shows."""

    @property
    def config(self) -> Config:
        """The environment that the recipe's agents act in."""
        crystals = scenarios(self.scenario)
        return make_config(
            crystals, observation=self.observation, control_interval=self.control_interval, action=self.action
        )


@dataclass(frozen=True, kw_only=True)
class APG(Recipe):
    """Analytic policy gradients: follows the gradient of the cost through policy, memory and plant."""

    name: str = "gradient"
    steps: int = 34_560_000
    num_envs: int = 192
    learning_rate: float = 4e-3
    observation: str = "measured"
    action: str = "rate"
    scenario: str = "randomized=0.35,hard=0.2,sensor-fault=0.2,puller=0.25"
    weights: Weights = QUIET
    observable: bool = True
    window: int = 180
    """Steps of a crystal that a gradient goes back through."""
    betas: tuple[float, float] = (0.9, 0.9)
    """Adam's decays. The first gradients, of lost crystals, are a thousand times those that follow: their squares must
    be forgotten soon."""


@dataclass(frozen=True, kw_only=True)
class Reinforcement(Recipe):
    """Learns from reward, by trying."""

    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers, of actor and critic alike."""
    gamma: float = 0.99
    batch_size: int
    noise: float
    """Standard deviation of the initial exploration [-]."""
    privileged_critic: bool = False
    """Whether the critic also sees the true state."""
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


RECIPES: dict[str, Recipe] = {recipe.name: recipe for recipe in (PPO(), SAC(), APG())}
"""Recipes by name: the choices of ``train.py --algo``."""
DEFAULT = "ppo"
"""The recipe that train.py follows unless another is named."""
