"""Recipes: every hyperparameter of every learner, in one place. A kind of learner is a dataclass, a recipe its value.

A new kind needs a dataclass here, a learner (:class:`.learner.Learner`) and its line in
:func:`.learners.make_learner`; a new recipe only its line in :data:`RECIPES`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from cz_gym.config import Config, make_config


@dataclass(frozen=True)
class CostWeights:
    """Weights of the cost's terms, relative to the environment's reward; what reward and validation count."""

    pull: float = 1.0
    """Of the pull speed's deviation [-]."""
    pull_step: float = 1.0
    """Of its step changes [-]."""
    heater_step: float = 1.0
    """Of the heater's step changes [-]."""
    observable: bool = False
    """Whether the radius error leaves out the offset that no sensor shows."""


OWN_WEIGHTS = CostWeights()
"""The environment's own."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What every recipe has, whatever it learns from."""

    name: str
    """What its agents are called."""
    observation: str = "history"
    action: str = "smooth"
    """What the network's two outputs mean (:func:`cz_gym.task.drives_of`)."""
    scenario: str = "randomized"
    """What training and validation crystals are drawn from."""
    basis: str = "differences"
    """What of the past the networks see standardised: its "differences", or "means" of spans as they are."""
    control_interval: float = 5.0
    """Time between actions [s]."""
    memory: float = 1200.0
    """Age of the oldest samples that the networks see [s]; 0: none, only the integral."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers, of the actor's and of the critic's."""
    threads: int = 1
    """Threads that torch computes on."""
    weights: CostWeights = OWN_WEIGHTS

    @property
    def config(self) -> Config:
        """The environment that the recipe's agents act in."""
        return make_config(
            self.scenario,
            observation=self.observation,
            control_interval=self.control_interval,
            action=self.action,
        )


@dataclass(frozen=True, kw_only=True)
class Imitation(Recipe):
    """DAgger: the network learns to act as a classical controller does, also where its own mistakes lead it.

    The controller may be privileged, knowing more than sensors show: the network learns what its sensors say of that.
    Some crystals are wide: on crystals no worse than the scenario's own it never sees how one is saved.
    """

    hidden: tuple[int, ...] = (128, 128)
    teacher: str = "lqg-at-0.02-privileged"
    """Name of the controller that is imitated."""
    rounds: int = 8
    """Times it demonstrates: first while it controls itself, then while the imitation does."""
    episodes: int = 480
    """Training episodes a round."""
    wide_share: float = 0.25
    """Share of each round's crystals that are wide; the others are the scenario's own [-]."""
    width: float = 2.0
    """How far everything random is spread on wide crystals, in units of the scenario's [-]."""
    noise: tuple[float, float] = (0.06, 0.02)
    """Spread of the noise added to the actions while demonstrating, pull speed and heater [-]."""
    epochs: int = 4
    """Times each round goes through all demonstrations so far."""
    learning_rate: float = 2e-3
    """At the middle of each round's cycle."""
    loss_weights: tuple[float, float] = (1.0, 0.0)
    """Of the errors in pull speed and heater in the fit by gradient [-]; 0: a drive keeps its linear regression."""


@dataclass(frozen=True, kw_only=True)
class Rewarded(Recipe):
    """What recipes that learn from the reward have in common, whether they try or differentiate."""

    steps: int
    """Environment steps."""


@dataclass(frozen=True, kw_only=True)
class Gradient(Rewarded):
    """The gradient of the reward's cost, with ``weights``, through policy, memory and plant; from nothing."""

    name: str = "gradient"
    observation: str = "measured"
    action: str = "rate"
    steps: int = 96_768_000
    num_envs: int = 192
    window: int = 180
    """Steps of a crystal that a gradient goes back through."""
    also: tuple[tuple[str, float, float], ...] = (
        ("", 2.0, 0.05),
        ("hard", 1.0, 0.2),
        ("sensor-fault", 1.0, 0.2),
        ("puller", 1.0, 0.25),
    )
    """Other crystals that it learns on: scenario ("": its own), how far everything random is spread in units of the
    scenario's own, and their share of all."""
    start: str = ""
    """Agent of such a recipe that training continues from: a file, a folder of ``train.py --seeds``, or a shipped name,
    of which each training seed takes its own; "": none, random initial weights."""
    hidden: tuple[int, ...] = (64,)
    scheduled: bool = True
    """Whether the linear map depends on noise, swings, the reference and the crystal's age."""
    whitened: bool = False
    """Whether, after a warm-up, weights are learned as those of whitened features."""
    expects: bool = False
    """Whether a reading that fails is replaced by what is to be expected of means and other readings, as the warm-up
    shows it, instead of by a mean of 23 s."""
    evenly: bool = False
    """Whether a crystal counts by the root of its cost, as in a mean of RMS errors; without, by its cost."""
    learning_rate: float = 1.2e-2
    """Of Adam at the start; it falls linearly to zero."""
    beta2: float = 0.9
    """How much of the squared gradients Adam remembers: the first ones, of lost crystals, are a thousand times those
    that follow."""


@dataclass(frozen=True, kw_only=True)
class Reinforcement(Rewarded):
    """What recipes that learn from reward by trying have in common."""

    num_envs: int
    """Slots trained on at once."""
    gamma: float = 0.99
    learning_rate: float
    """At the start; it falls linearly to a twentieth."""
    privileged_critic: bool = False
    """Whether the critic also sees the true state."""
    length: float = 10800.0
    """Length of its crystals while it learns [s]; they are judged whole."""
    failure_costs: bool = True
    """Whether a lost crystal costs what is left of it; without, rewards are positive and end there."""


@dataclass(frozen=True, kw_only=True)
class OnPolicy(Reinforcement):
    """Proximal policy optimisation, whatever the network."""

    batch_size: int
    n_steps: int
    """Steps a slot between updates; of a network with a memory also how far back its gradient sees."""
    n_epochs: int
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    noise: float = 0.5
    """Spread of the exploration at the start [-]."""


@dataclass(frozen=True, kw_only=True)
class PPO(OnPolicy):
    """Proximal policy optimisation from nothing; the critic sees the true state."""

    name: str = "ppo"
    steps: int = 20_000_000
    num_envs: int = 512
    privileged_critic: bool = True
    n_steps: int = 64
    batch_size: int = 2048
    n_epochs: int = 5
    learning_rate: float = 1e-3


@dataclass(frozen=True, kw_only=True)
class SAC(Reinforcement):
    """Soft actor-critic on the same batch, from nothing.

    While it learns, each action is held for 20 s: what one of 5 s changes is lost in its critic's errors.
    """

    name: str = "sac"
    steps: int = 1_500_000
    num_envs: int = 64
    held: int = 4
    """Steps of the environment that an action is held for while it learns; its steps are counted in actions."""
    gamma: float = 0.97
    failure_costs: bool = False
    noise: float = 0.2
    """Spread of the exploration at the start [-]."""
    buffer_size: int = 1_000_000
    learning_starts: int = 10_000
    """Steps before the first update."""
    batch_size: int = 512
    gradient_steps: int = 4
    """Updates after each step of all slots."""
    learning_rate: float = 5e-4
    tau: float = 0.01
    ent_coef: str = "auto_0.005"
    """Weight of the entropy at the start, in units of the reward times 1 - gamma; it adapts."""


LQG_COST = CostWeights(pull=0.0178, pull_step=0.1, heater_step=51.6)
"""The cost that the regulator of lqg-at-0.02 was made for, as multiples of the environment's."""
GRADIENT_COST = CostWeights(pull=0.11, pull_step=0.07, heater_step=23.4, observable=True)
"""The cost that the recipe gradient follows: near that of lqg-quiet, without what no sensor shows."""
RADIUS_COST = replace(GRADIENT_COST, pull=0.018, pull_step=0.14)
"""The cost that agents which go on from others follow: the pull speed may go where it wants."""
_ON = Gradient(start="gradient", steps=Gradient.steps // 4, whitened=True, learning_rate=2e-3, weights=RADIUS_COST)
GRADIENT = Gradient(
    steps=Gradient.steps * 3 // 8,
    also=(("", 2.0, 0.05), ("hard", 1.0, 0.2), ("sensor-fault", 1.0, 0.3), ("puller", 1.0, 0.25)),
    num_envs=64,
    window=540,
    whitened=True,
    expects=True,
    evenly=True,
    learning_rate=3e-3,
    weights=replace(RADIUS_COST, pull=0.05),
)
"""Goes on from an agent of ``gradient-start``. A pull speed at the limits of ``puller`` leaves the rest to the heater,
whose effect shows after more than 15 min: hence the longer windows."""
RECIPES: dict[str, Recipe] = {
    recipe.name: recipe
    for recipe in (
        PPO(),
        SAC(),
        Imitation(name="imitation", weights=LQG_COST),
        Gradient(name="gradient-start", weights=GRADIENT_COST),
        GRADIENT,
        replace(_ON, name="gradient-specialist", also=(("sensor-fault", 1.0, 0.3), ("", 2.0, 0.03))),
    )
}
"""By name: what ``train.py --algo`` offers."""
DEFAULT = "ppo"
"""The recipe that train.py follows unless another is named."""
