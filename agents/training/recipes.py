"""Every hyperparameter of every recipe, in one place."""

from __future__ import annotations

from dataclasses import dataclass, field

CRITIC_SHARE = 2.0 / 3.0
"""Most of all steps that a critic may have for itself [-]: a short run shall not end before its actor learns."""


@dataclass(frozen=True)
class ActionHead:
    """How the network's two outputs become an action: skip * (v_p, Q_H applied) + scale * output."""

    skip: float = 1.0
    """1: the network moves the drives from where they are; 0: it sets them."""
    pull_scale: float = 0.05
    """Action per output, pull speed [-]."""
    heater_scale: float = 0.05
    """Action per output, heater [-]."""


@dataclass(frozen=True)
class CostWeights:
    """The reward that is trained on: the environment's cost with its terms weighted."""

    pull: float = 1.0
    """Of the pull speed's deviation, relative to the environment's [-]."""
    pull_step: float = 1.0
    """Of its step changes [-]."""
    heater_step: float = 1.0
    """Of the heater's step changes [-]."""
    observable: bool = False
    """Whether the radius error leaves out the offset that no sensor shows."""


@dataclass(frozen=True)
class Clone:
    """Behaviour cloning before reinforcement learning."""

    teacher: str
    """Name of the classical controller that is imitated."""
    rounds: int = 3
    """Times it is asked: first about its own episodes, then about the imitation's."""
    episodes: int = 320
    """Training episodes a round."""
    width: float = 2.0
    """How far everything random on wide crystals is spread, in units of the scenario's [-]."""
    wide_share: float = 1.0
    """Share of each round's crystals that are wide; the others are the scenario's own [-]."""
    noise: tuple[float, float] = (0.006, 0.001)
    """Spread of the noise added to the driver's actions, pull speed and heater [-]."""
    epochs: int = 10
    """Times each round goes through all answers so far."""
    learning_rate: float = 2e-3
    """At the middle of each round's cycle."""


@dataclass(frozen=True)
class Recipe:
    """What training shares whatever the algorithm."""

    observation: str = "history"
    scenario: str = "randomized"
    control_interval: float = 5.0
    """Time between actions [s]."""
    num_envs: int = 256
    """Slots trained on at once."""
    memory: float = 1200.0
    """Age of the oldest samples that the networks see [s]; 0: none, only the integral."""
    width: float = 1.0
    """Spread of the pullers trained on, in units of the scenario's [-]; 0: the nominal one in the middle."""
    privileged_critic: bool = True
    """Whether the critic also sees the true state."""
    hidden: tuple[int, ...] = (128, 128)
    """Widths of actor and of critic."""
    threads: int = 1
    """Threads that torch computes on."""
    head: ActionHead = field(default_factory=ActionHead)
    weights: CostWeights = field(default_factory=CostWeights)
    clone: Clone | None = None
    """None: learning starts from nothing."""
    residual: bool = False
    """Whether the network's action is added to the teacher's instead of imitating it."""


@dataclass(frozen=True)
class PPO:
    """Proximal policy optimisation on the native batch, from an imitation of a classical controller.

    The imitation is good, so learning must not lose it: the critic learns first, the actor slowly, and only the last
    weights that move the pull speed. The heater acts over a quarter of an hour, which the discount does not see.
    As they stand, without a name, these are the settings that :mod:`studies.ablation` takes apart and
    :mod:`studies.search` turns; :data:`RECIPES` holds those that ship.
    """

    name: str = "ppo"
    """What agents of these settings are called."""
    recipe: Recipe = field(default_factory=lambda: Recipe(weights=CostWeights(0.2, 0.2), clone=Clone("lqg-at-0.02")))
    steps: int = 600_000
    """Environment steps."""
    critic_steps: int = 200_000
    """The first of them, in which only the critic learns; at most :data:`CRITIC_SHARE` of them."""
    n_steps: int = 128
    """Steps a slot between updates."""
    batch_size: int = 8192
    n_epochs: int = 4
    learning_rate: float = 1e-3
    """At the start; it falls linearly to a twentieth."""
    actor_pace: float = 0.15
    """The actor's learning rate, in units of it [-]."""
    frozen: tuple[str, ...] = ("heater", "layers")
    """What of the actor keeps its first weights: "heater", the heater's output; "layers", the hidden layers."""
    paired: bool = True
    """Whether the teacher's reward on the same crystal is taken off."""
    gamma: float = 0.98
    gae_lambda: float = 0.9
    clip_range: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    noise: tuple[float, float] = (0.006, 0.0003)
    """Spread of the exploration at the start, pull speed and heater [-]."""


SCRATCH = PPO(
    name="ppo-scratch",
    recipe=Recipe(),
    steps=10_000_000,
    critic_steps=0,
    n_steps=64,
    batch_size=2048,
    n_epochs=5,
    actor_pace=1.0,
    frozen=(),
    paired=False,
    gamma=0.99,
    gae_lambda=0.95,
    noise=(0.05, 0.05),
)
"""PPO from nothing."""


@dataclass(frozen=True)
class SAC:
    """Soft actor-critic on the same batch."""

    name: str = "sac"
    """What agents of these settings are called."""
    recipe: Recipe = field(default_factory=lambda: Recipe(num_envs=16, privileged_critic=False))
    steps: int = 400_000
    """Environment steps."""
    buffer_size: int = 400_000
    learning_starts: int = 10_000
    batch_size: int = 512
    gradient_steps: int = 4
    """Updates after each step of all slots."""
    learning_rate: float = 5e-4
    gamma: float = 0.99
    tau: float = 0.01


@dataclass(frozen=True)
class RecurrentPPO:
    """Proximal policy optimisation of a network that remembers (an LSTM), from nothing."""

    name: str = "ppo-recurrent"
    """What agents of these settings are called."""
    recipe: Recipe = field(default_factory=lambda: Recipe(num_envs=64, privileged_critic=False, hidden=(64,)))
    steps: int = 1_000_000
    """Environment steps."""
    units: int = 64
    """Of the actor's LSTM and of the critic's."""
    n_steps: int = 128
    """Steps a slot between updates; also how far back its gradient sees."""
    batch_size: int = 2048
    n_epochs: int = 4
    learning_rate: float = 1e-3
    """At the start; it falls linearly to a twentieth."""
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    ent_coef: float = 0.0
    vf_coef: float = 0.5
    max_grad_norm: float = 0.5
    noise: float = 1.0
    """Spread of the exploration at the start, in the network's outputs [-]."""


Choice = PPO | SAC | RecurrentPPO
"""Settings of any algorithm."""


def _told(teacher: str) -> Clone:
    """Imitation of an LQG that is told each crystal's puller and roughness: what it shows has to be found out.

    Wide crystals show how it saves one, the others how it controls those that the agent is for.
    """
    return Clone(f"{teacher}-told", rounds=8, episodes=480, wide_share=0.25, epochs=4)


def _weighed(pull_step: float) -> CostWeights:
    """The cost that an LQG's regulator was made for (baselines/lqg/settings.py), as multiples of the environment's."""
    return CostWeights(pull=0.11, pull_step=pull_step, heater_step=23.4)


RECIPES: dict[str, Choice] = {
    choice.name: choice
    for choice in (
        PPO(recipe=Recipe(weights=_weighed(0.049), clone=_told("lqg-at-0.02"))),
        PPO("ppo-medium", Recipe(weights=_weighed(0.295), clone=_told("lqg-at-0.013"))),
        PPO("ppo-quiet", Recipe(weights=_weighed(1.22), clone=_told("lqg-quiet"))),
        PPO(
            "ppo-puller",
            Recipe(
                scenario="puller",
                weights=CostWeights(0.5, 0.5, observable=True),
                clone=Clone("lqg-quiet", rounds=5, width=1.0),
            ),
        ),
        SCRATCH,
        SAC(),
        RecurrentPPO(),
    )
}
"""By name: what ``train.py --algo`` offers."""
