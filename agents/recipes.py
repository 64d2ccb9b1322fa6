"""Recipes of training, and validation of what is learned. A kind of learner is a dataclass, a recipe one value.

A new recipe needs a line in :data:`RECIPES`; a new kind needs a dataclass here and a case in
:func:`make_algorithm`.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt
import stable_baselines3
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from cz_gym.body.signals import COST_CAP
from cz_gym.config import Config, make_config
from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.env import CzVectorEnv
from cz_gym.evaluation.metrics import Metrics, metrics
from cz_gym.evaluation.protocol import TRAINING_SEEDS, VALIDATION_SEEDS, scenarios
from cz_gym.evaluation.rollout import rollout
from cz_gym.sb3 import ActionRepeat, AddToController, CzVecEnv, LongMemory
from cz_gym.support.errors import CzError, require_type

from . import apg
from .asymmetric import AsymmetricPolicy, AsymmetricSACPolicy, LearnState, RememberingPolicy
from .callbacks import ClipAdvantages, ClipErrors, FadeExploration, NormalNoise
from .contract import Contract, OnnxPolicy
from .residual import Base, Residual

LEAST_ENVS, LEAST_BATCH = 8, 64
"""Least number of crystals at a time, and of samples in a batch, on a small budget."""
BODY_ENV, CRYSTAL_ENV = ENVIRONMENTS
MANY_STEPS = 64_000_000
"""PPO with fewer learns by :data:`FEW_STEPS` [environment steps]. They win at 5 million and lose at 144 million; where
between the two was not measured."""
FEW_STEPS: dict[str, Any] = {"n_epochs": 5, "average": 0.0, "log_std_fall": 0.0, "advantage_quantile": 1.0}
"""Fields of a PPO with fewer steps: more passes, and all of the large advantages, which show what loses a crystal."""
FEW_UPDATES = 50
"""Number of updates below which nothing is learned."""
_SHARES = "gamma", "gae_lambda", "tau", "average", "advantage_quantile", "error_quantile", "action_noise_std"
MOST = {**dict.fromkeys(_SHARES, 1.0), "betas": 0.9999}
"""Largest value of the fields that have one: discounts, what is forgotten at each step, shares, and noise."""


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """Hyperparameters of every learner; fields have the names of stable-baselines3's arguments."""

    name: str
    """Name of the trained agents."""
    steps: int
    """Training budget [environment steps]; each repeat of an action counts."""
    num_envs: int
    """Crystals at a time."""
    learning_rate: float
    """Initial learning rate, decayed linearly."""
    observation: str = "history"
    action: str = "smooth"
    """Meaning of the network's two outputs (:func:`cz_gym.spaces.drives_of`)."""
    scenario: str = "all"
    """Scenario or mixture of the training and validation crystals (:func:`cz_gym.evaluation.protocol.scenarios`)."""
    control_interval: float = 5.0
    """Time between actions on the default puller [s]."""
    puller: str = ""
    """Puller file, or name of a shipped one, which has a control interval of its own; empty: the default puller."""
    environment: str = ""
    """Name of the environment; empty: Cz-v0."""
    stages: tuple[str, ...] = ()
    """Parts of the crystal that the training and validation crystals grow, in equal shares; none on Cz-v0."""

    average: float = 0.0
    """Share of the updates whose weights the kept agent is an exponential mean of; 0: it is the last one."""
    fewest_updates: int
    """Number of updates below which a smaller budget has fewer crystals at a time instead."""

    @property
    def steps_between(self) -> int:
        """Environment steps of each crystal between two updates."""
        raise NotImplementedError

    @property
    def steps_before(self) -> int:
        """Environment steps that the agent which the training begins with has learned for; 0 for random weights."""
        return 0

    @property
    def updates(self) -> int:
        """Number of updates in the budget."""
        return self.steps // (self.num_envs * self.steps_between)

    def with_steps(self, steps: int) -> Self:
        """Return the recipe with another budget; a small one has fewer crystals at a time, so that it still learns."""
        wanted = round(steps / (self.fewest_updates * self.steps_between))
        return replace(self, steps=steps, num_envs=min(self.num_envs, max(wanted, LEAST_ENVS)))

    @property
    def own_callbacks(self) -> list[BaseCallback]:
        """Callbacks that the recipe learns with, whatever a user adds."""
        return []

    @property
    def config(self) -> Config:
        """Environment that the recipe's agents act in."""
        interval, puller = (None, self.puller) if self.puller else (self.control_interval, None)
        return make_config(
            scenarios(self.scenario), None, self.observation, interval, action=self.action, puller=puller,
            process=ENVIRONMENTS[self.environment or BODY_ENV], stage=dict.fromkeys(self.stages, 1.0) or None,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class APG(TrainingConfig):
    """Analytic policy gradients: follows the gradient of the cost through policy, memory and plant."""

    name: str = "gradient"
    steps: int = 129_024_000
    num_envs: int = 96
    """Crystals at a time: at a given number of steps, more updates are worth more than more crystals."""
    learning_rate: float = 4e-3
    observation: str = "measured"
    action: str = "rate"
    window: int = 180
    """Steps of a crystal that a gradient goes back through."""
    start: str = ""
    """Agent file whose weights are learned on; empty: random weights. ``--set start=`` takes a shipped name too."""
    units: int = 128
    """Width of the memory (a gated recurrent unit) and of the hidden layer."""
    fewest_updates: int = 400
    betas: tuple[float, float] = (0.9, 0.9)
    """Adam's decays. The first gradients, of lost crystals, are a thousand times those that follow: their squares must
    be forgotten soon."""

    @property
    def steps_between(self) -> int:
        """Length of the window."""
        return self.window

    @property
    def steps_before(self) -> int:
        """Environment steps of the agent of ``start``."""
        agent = self.begun_with
        return agent.contract.training_steps if agent else 0

    @property
    def begun_with(self) -> OnnxPolicy | None:
        """The agent of ``start``; CzError if the recipe's agents read, act or grow otherwise."""
        if not self.start:
            return None
        agent, environment = OnnxPolicy.load(self.start), self.environment or BODY_ENV
        for what, own in (("environment", environment), ("observation", self.observation), ("action", self.action)):
            if (its := getattr(agent.contract, what)) != own:
                raise CzError(f"start={self.start}: its {what} is {its}, the recipe's is {own}")
        return agent

    def begin(self, algorithm: Any) -> None:
        """Give an algorithm weights and feature statistics of the agent of ``start``, if one is named."""
        if agent := self.begun_with:
            algorithm.warm_up = 0.0
            try:
                algorithm.policy.take_weights(agent.content)
            except CzError as error:
                raise CzError(f"start={self.start}: {error}") from None


@dataclass(frozen=True, kw_only=True)
class Reinforcement(TrainingConfig):
    """Learns from reward, by trying; stable-baselines3's ``VecNormalize`` scales the reward. Observations are scaled by
    the environment: running means would remember the lost crystals of the first minutes, and make a reading that is
    not valid, one in hundreds, an input of -10. Critics that are told read the plant's true state
    (:mod:`cz_gym.agents.asymmetric`); actors never do, but their estimate is fitted to it.
    """

    hidden: tuple[int, ...] = (64, 64)
    """Widths of the actor's hidden layers."""
    critic_hidden: tuple[int, ...] = (64, 64)
    """Widths of the critic's hidden layers."""
    told: bool = True
    """Privileged training: critics read the true state, the actor's estimate is fitted to it."""
    action_repeat: int
    """Environment steps that an action is held for in training: the effect of one of 5 s is lost in the noise."""
    gamma: float = 0.99
    """Discount of an action's steps together."""
    batch_size: int
    n_steps: int
    """Actions on each crystal between updates of PPO; actions whose rewards a target of SAC has."""

    @property
    def own_callbacks(self) -> list[BaseCallback]:
        """The fit of the estimate, where the true state is told."""
        return [LearnState()] if self.told else []

    @property
    def steps_between(self) -> int:
        """Length of PPO's rollout."""
        return self.action_repeat * self.n_steps

    def with_steps(self, steps: int) -> Self:
        """Return the recipe with another budget; batches become smaller as the number of crystals does."""
        fewer = super().with_steps(steps)
        return replace(fewer, batch_size=max(self.batch_size * fewer.num_envs // self.num_envs, LEAST_BATCH))


@dataclass(frozen=True, kw_only=True)
class PPO(Reinforcement):
    """Proximal policy optimisation; the actor reads an estimate of the plant's state
    (:class:`cz_gym.agents.asymmetric.StateEstimator`)."""

    name: str = "ppo"
    hidden: tuple[int, ...] = (32, 32)
    steps: int = 256_000_000
    action: str = "rate"
    """The heater's place on a puller whose meters err is kept by standing still; "smooth" must hold it by a reading."""
    num_envs: int = 1024
    """Many crystals at a time: what an action changes is small beside what the disturbances do."""
    action_repeat: int = 4
    n_steps: int = 32
    fewest_updates: int = 90
    batch_size: int = 1024
    n_epochs: int = 2
    """Few passes through a rollout: new steps take less time, and bring noise of their own."""
    learning_rate: float = 1e-3
    gae_lambda: float = 0.9
    """Lower than stable-baselines3's 0.95: a critic that reads the true state is a good judge."""
    average: float = 0.02
    log_std_init: float = -1.2
    """Logarithm of the standard deviation of the actions in training, at its begin."""
    log_std_fall: float = 1.4
    """Fall of it until the end: first an action must be seen to do something, then the policy must suit what it does
    itself and not what exploration does. No meaning with ``learn_std``."""
    learn_std: bool = False
    """Learn the standard deviation, which then shrinks, as small actions cost less, and hides what an action does; else
    it falls linearly in its logarithm."""
    advantage_quantile: float = 0.98
    """Quantile of the size of a rollout's advantages at which they are clipped; 1 clips none."""

    @property
    def own_callbacks(self) -> list[BaseCallback]:
        """The clipping of advantages, and the exploration that fades, unless it is learned."""
        wanted = super().own_callbacks
        if self.advantage_quantile < 1.0:
            wanted.append(ClipAdvantages(self.advantage_quantile))
        if self.log_std_fall and not self.learn_std:
            wanted.append(FadeExploration(self.log_std_init, self.log_std_fall))
        return wanted

    def with_steps(self, steps: int) -> Self:
        """Return the recipe with another budget, in whole batches; a small one learns by :data:`FEW_STEPS`."""
        fewer = super().with_steps(steps)
        if steps < MANY_STEPS <= self.steps:
            fewer = replace(fewer, **FEW_STEPS)
        collected = fewer.num_envs * fewer.n_steps
        return replace(fewer, batch_size=max(n for n in range(1, fewer.batch_size + 1) if collected % n == 0))


@dataclass(frozen=True, kw_only=True)
class PPOResidual(PPO):
    """PPO of additions to a given controller, within limits (:mod:`cz_gym.agents.residual`)."""

    name: str = "pid-with-learning"
    steps: int = 24_000_000
    action: str = "direct"
    controller: str = "pid-conventional"
    """Name of the controller, or FILE.py:NAME."""
    limits: tuple[float, float] = (0.1, 1.0)
    """Largest additions: to the pull speed, as a share of v_0 [-], and to the heater power [kW]."""


@dataclass(frozen=True, kw_only=True)
class SAC(Reinforcement):
    """Soft actor-critic; its actor has PPO's estimate, its critics read products of state and action
    (:class:`cz_gym.agents.asymmetric.StateCritic`)."""

    name: str = "sac"
    hidden: tuple[int, ...] = (32, 32)
    critic_hidden: tuple[int, ...] = (128, 128)
    steps: int = 130_000_000
    action: str = "rate"
    gamma: float = 0.98
    num_envs: int = 2048
    action_repeat: int = 4
    n_steps: int = 4
    fewest_updates: int = 4000
    buffer_size: int = 1_000_000
    learning_starts: int = 10_000
    """Actions before the first update."""
    batch_size: int = 2048
    gradient_steps: int = 4
    """Updates after each action of all crystals."""
    learning_rate: float = 1e-3
    average: float = 0.02
    n_critics: int = 1
    """Critics, of whose values the lower one counts. One takes half the time: twice as many updates fit into it."""
    tau: float = 0.01
    ent_coef: str = "auto_0.005"
    """Initial weight of the entropy; it adapts."""
    target_entropy: float = 0.5
    """Entropy of an action's distribution that the weight adapts to, at the begin of training; 0.5 is that of
    two normal actions whose standard deviations have a geometric mean of 0.31."""
    entropy_fall: float = 2.8
    """Fall of it until the end."""
    action_noise_std: float = 0.1
    """Standard deviation of what training adds to the policy's actions, so that the critic sees what actions do while
    the policy's own become narrow."""
    error_quantile: float = 0.8
    """Quantile of the size of a batch's errors of the critics at which they are clipped; 1 clips none."""

    @property
    def own_callbacks(self) -> list[BaseCallback]:
        """The clipping of the critics' errors, and the exploration that fades."""
        wanted = super().own_callbacks
        if self.error_quantile < 1.0:
            wanted.append(ClipErrors(self.error_quantile))
        if self.entropy_fall:
            wanted.append(FadeExploration(self.target_entropy, self.entropy_fall))
        return wanted

    @property
    def steps_between(self) -> int:
        """Steps of an action."""
        return self.action_repeat


PLAIN = PPO(name="ppo-plain", told=False, hidden=(64, 64), gamma=0.98, steps=96_000_000, **FEW_STEPS)
"""As ``ppo`` with few steps: five epochs, exploration that stays, all advantages, the last weights; but told nothing,
with a wider actor, a shorter discount and 96 million steps."""
RECIPES: dict[str, TrainingConfig] = {
    recipe.name: recipe for recipe in (PPO(), PLAIN, SAC(), APG(), PPOResidual(**FEW_STEPS))
}
"""Recipes by name: the choices of ``cz-gym train --algo``."""
_learned_std = {"num_envs": 2048, "batch_size": 2048, "log_std_init": -0.7, "learn_std": True, **FEW_STEPS}
_along: dict[str, Any] = {
    "environment": CRYSTAL_ENV,
    "stages": ("crown", "body", "tail"),
    "scenario": "randomized=0.5,hard=0.5",
}
CRYSTAL_RECIPES: dict[str, TrainingConfig] = {
    "ppo": PPO(name="ppo-along", steps=64_000_000, action="smooth", **_learned_std, **_along),
    "gradient": APG(name="gradient-along", units=64, steps=17_280_000, **_along),
}
"""Recipes of CzCrystal-v0: one agent for crown, body and tail."""
DEFAULT_RECIPE = "ppo"
"""Recipe of ``cz-gym train`` unless another is named."""


def make_algorithm(recipe: TrainingConfig, seed: int, done: int = 0, base: Base | None = None) -> BaseAlgorithm:
    """Make the algorithm of a recipe for a training seed; a resumed one has taken ``done`` steps before.

    ``base`` is the controller of a :class:`PPOResidual`.
    """
    torch.set_num_threads(1)  # small networks are quicker so
    torch.manual_seed(seed)
    env, told = _environment(recipe, seed + done, base), isinstance(recipe, Reinforcement) and recipe.told
    kind: Any
    policy: Any
    options = dict[str, Any]()
    match recipe:
        case APG():
            kind, policy = apg.APG, "RecurrentPolicy"
            options = {"betas": recipe.betas, "units": recipe.units, "hidden": recipe.units}
        case PPO():
            kind, policy, critics = stable_baselines3.PPO, AsymmetricPolicy if told else RememberingPolicy, "vf"
            options = {"log_std_init": recipe.log_std_init}
        case SAC():
            kind, policy, critics = stable_baselines3.SAC, AsymmetricSACPolicy, "qf"
            options = {"activation_fn": torch.nn.Tanh, "n_critics": recipe.n_critics}
        case _:
            raise TypeError(f"no algorithm for a {type(recipe).__name__}")
    known = {name for each in kind.__mro__ for name in inspect.signature(each.__init__).parameters}
    settings = {name: getattr(recipe, name) for name in asdict(recipe) if name in known}
    if isinstance(recipe, Reinforcement):
        settings["learning_rate"] = partial(linear_schedule, recipe.learning_rate)
        options["interval"] = recipe.config.control_interval
        options["net_arch"] = {"pi": list(recipe.hidden), critics: list(recipe.critic_hidden)}
    if isinstance(recipe, SAC):  # a resumed one first fills a new replay buffer
        settings["learning_starts"] += done // recipe.action_repeat
        if recipe.action_noise_std:
            size = recipe.num_envs, get_action_dim(env.action_space)
            settings["action_noise"] = NormalNoise(recipe.action_noise_std, *size)
    made: BaseAlgorithm = kind(policy, env, policy_kwargs=options, seed=seed, device="cpu", **settings)
    if isinstance(recipe, PPO):
        made.policy.log_std.requires_grad_(recipe.learn_std)
    if isinstance(recipe, APG):
        recipe.begin(made)
    # The algorithm's constructor has set the slots' seeds to ``seed`` and those after it: neighbouring training seeds
    # would meet the same crystals, and a resumed run its first ones again.
    made.set_random_seed((seed * 10_007 + done) % (len(TRAINING_SEEDS) - recipe.num_envs))
    made.num_timesteps = done // repeat_of(recipe)
    return made


def _environment(recipe: TrainingConfig, stagger: int, base: Base | None) -> VecEnv:
    """The batch of a recipe as its algorithm sees it; ``stagger`` draws where the crystals of a learner begin."""
    if not isinstance(recipe, Reinforcement):
        return CzVecEnv(CzVectorEnv.from_config(recipe.config, recipe.num_envs, AutoresetMode.SAME_STEP, info="lean"))
    info: Any = "all" if recipe.told else "lean"
    batch = CzVectorEnv.from_config(recipe.config, recipe.num_envs, AutoresetMode.SAME_STEP, info=info)
    env: VecEnv = CzVecEnv(batch, stagger, critic_state=recipe.told)
    env = LongMemory(env)
    if isinstance(recipe, PPOResidual):
        env = AddToController(env, Residual(require_type(Base, base, "it is added to"), *recipe.limits))
    return VecNormalize(ActionRepeat(env, recipe.action_repeat), norm_obs=False, gamma=recipe.gamma)


def repeat_of(recipe: TrainingConfig) -> int:
    """Environment steps of each of the algorithm's time steps."""
    return recipe.action_repeat if isinstance(recipe, Reinforcement) else 1


def linear_schedule(start: float, left: float) -> float:
    """Learning rate that falls linearly with the share of training that is left, to a twentieth."""
    return start * (0.05 + 0.95 * left)


Floats = npt.NDArray[np.float64]
SELECTION_SEEDS = VALIDATION_SEEDS[:64]
"""Seeds of the crystals that choose the best agent of a run."""
JUDGING_SEEDS = VALIDATION_SEEDS[64:264]
"""Seeds of the crystals that a finished run's agent is tested on; they choose nothing within a run."""

REFERENCES = {"Cz-v0": ("paper", "paper-tuned", "lqg"), "CzCrystal-v0": ("compensated", "lqg-along")}
"""Classical controllers that an agent is shown beside while it learns, by environment."""
References = Mapping[str, tuple[float, float]]
"""Mean RMSE of each reference [mm], on the crystals of SELECTION_SEEDS and of JUDGING_SEEDS."""
COLUMNS = "steps", "seconds", "validation_cost", "validation_rmse_mm", "pull_step_rms_mm_per_min", "failure_rate"
"""Figures of a validation; those of the references follow, the same in every row (:func:`reference_column`)."""


class Validation(NamedTuple):
    """Mean figures over validation episodes."""

    cost: float
    """Mean cost of a step before it saturates, at most ten; that of a lost crystal is ten [-]."""
    rmse_mm: float
    pull_step_rms_mm_per_min: float
    failure_rate: float

    def put_into(self, contract: Contract) -> Contract:
        """Return an agent's contract with these figures."""
        return replace(contract, validation_cost=self.cost, validation_rmse_mm=self.rmse_mm)


def reference_column(name: str) -> str:
    """Name the column with the RMSE of a reference controller [mm]."""
    return f"{name}_rmse_mm"


def validate(policy: Any, config: Config, seeds: Sequence[int]) -> Validation:
    """Mean figures of a policy over one episode a seed."""
    measured = metrics(rollout(policy, config, seeds))
    figures = (costs(measured), measured.rmse_mm, measured.pull_step_rms_mm_per_min, measured.failure_rate)
    return Validation(*(float(figure.mean()) for figure in figures))


def references(
    make_controller: Callable[[str, Config], Any],
    recipe: TrainingConfig,
    progress: Callable[[int], Any] = lambda crystals: None,
) -> References:
    """RMSEs of classical controllers on a recipe's crystals, each designed for a crystal's own scenario.

    ``make_controller`` makes a controller by its name; ``progress`` is called with the number of crystals done.
    """
    config = replace(recipe.config, observation="measured", action="direct")

    def rmse_mm(name: str, seeds: Sequence[int]) -> float:
        with closing(CzVectorEnv.from_config(config, len(seeds))) as env:
            _, info = env.reset(seed=list(seeds))
        drawn, total = info.get("scenario", [config.scenario.name] * len(seeds)), 0.0
        for scenario in config.scenario.scenarios:
            if own := [seed for seed, each in zip(seeds, drawn, strict=True) if each == scenario.name]:
                alone = config.with_scenario(scenario)
                total += len(own) * validate(make_controller(name, alone), alone, own).rmse_mm
                progress(len(own))
        return total / len(seeds)

    names = REFERENCES[config.process.name]
    return {name: (rmse_mm(name, SELECTION_SEEDS), rmse_mm(name, JUDGING_SEEDS)) for name in names}


def costs(measured: Metrics) -> Floats:
    """Mean cost of a step of each episode [-] (:attr:`Validation.cost`), shape (episodes,)."""
    return np.where(measured.failure_rate > 0, COST_CAP, np.minimum(measured.cost, COST_CAP))


AXES = (("steps", 1e6, "environment steps [million]"), ("seconds", 60.0, "minutes, validation included"))
"""Horizontal axes: column of a run's progress, unit, label."""


def curves(runs: Mapping[str, Sequence[Sequence[Mapping[str, Any]]]]) -> bytes:
    """Validation RMSE [mm] against steps and minutes, a line a run, as PNG; the references are dashed lines across.

    ``runs`` are the rows of ``progress.csv`` of each run, by the name of their agents.
    """
    from cz_gym.evaluation.plots import INK, MARKS, canvas, png, styles  # matplotlib is in another extra

    figure, style = canvas(9.4, 4.6), styles([*runs], learned=[*runs])
    panels = figure.subplots(1, 2, sharey=True)
    last = next(iter(runs.values()))[0][-1]
    for axis, (column, unit, title) in zip(panels, AXES, strict=True):
        for name, several in runs.items():
            for place, rows in enumerate(several):
                spent, error = ([float(row[each]) for row in rows] for each in (column, "validation_rmse_mm"))
                drawn: Any = {"color": style[name].colour, "marker": MARKS[style[name].mark]}
                label = name if place == 0 and axis is panels[0] else None
                axis.plot([each / unit for each in spent], error, ms=3.5, lw=1.0, label=label, **drawn)
        references = {name.removesuffix("_rmse_mm"): float(last[name]) for name in [*last][len(COLUMNS) :]}
        for name, rmse in references.items():
            axis.axhline(rmse, color=INK, lw=0.9, ls="--")
            if axis is panels[0]:
                lowest = rmse == min(references.values())  # lines may be close together
                axis.annotate(name, (0.99, rmse), (0, -2 if lowest else 2), axis.get_yaxis_transform(), color=INK,
                              textcoords="offset points", ha="right", va="top" if lowest else "bottom",
                              fontsize=8)  # fmt: skip
        axis.set(xscale="log", yscale="log", xlabel=title)
        for each in (axis.xaxis, axis.yaxis):
            each.set_major_formatter(lambda value, _: f"{value:g}")
    panels[0].set_ylabel("validation RMSE of the radius [mm]")
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8)
    figure.suptitle("Radius error on validation crystals while learning: a line a training seed", fontsize=11)
    return png(figure)
