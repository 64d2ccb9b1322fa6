"""Analytic policy gradients (APG) with the interface of stable-baselines3's algorithms.

The plant's step is differentiated exactly (:func:`.plant_step.advance`), so that torch's autograd gives the gradient
of the cost by the policy's weights: back-propagation through time over windows of an episode, in place of a gradient
that is estimated from rewards. The method knows the plant's equations while it trains; the policy reads sensors alone.
"""

import math
from typing import Any, ClassVar, Self

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from cz_gym.config import Config
from cz_gym.differentiable import DifferentiableBatch
from cz_gym.errors import CzError
from cz_gym.evaluation.protocol import TRAINING_SEEDS

from .plant_step import StepCost, advance
from .policy import RecurrentPolicy

WARM_UP = 0.05
"""Share of the training during which the features' statistics are updated."""
CLIP_AT = 2.0
"""Gradient-norm clip, in multiples of the running median norm: the gradient of a crystal that is nearly lost is
thousands of times as large."""
NORMS = 100
"""Number of gradient norms that the running median is taken of."""


class APG(BaseAlgorithm):
    """Analytic policy gradients on Cz-v0 or CzCrystal-v0.

    ``env`` says what is learned: a vector environment with ``observation="measured"``. Training steps a
    differentiable twin of it with as many slots; ``env`` itself is only asked for its settings. ``window`` is the
    number of steps that a gradient goes back through; each update takes ``window * num_envs`` environment steps.
    The cost is :class:`.plant_step.StepCost`; a constant ``learning_rate`` falls linearly to 0.
    The other arguments are stable-baselines3's. Raises CzError for an environment that is not this package's, or reads
    another observation.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"RecurrentPolicy": RecurrentPolicy}
    policy: RecurrentPolicy

    def __init__(
        self,
        policy: str | type[RecurrentPolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 4e-3,
        window: int = 180,
        device: torch.device | str = "cpu",
        _init_setup_model: bool = True,
        **options: Any,
    ) -> None:
        if isinstance(learning_rate, float):
            initial = learning_rate

            def learning_rate(left: float) -> float:
                return initial * left

        super().__init__(policy, env, learning_rate, device=device, support_multi_env=True, **options)
        self.window = window
        self.norms = torch.zeros(NORMS)
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        options = dict(self.policy_kwargs)
        if self.env is not None:
            options.setdefault("interval", self._config().control_interval)
            options.setdefault("environment", self._config().process.name)
        policy: Any = self.policy_class
        self.policy = policy(self.observation_space, self.action_space, self.lr_schedule, **options).to(self.device)

    def _config(self) -> Config:
        """The settings of the environment that is learned on."""
        try:
            config: Config = self.get_env().get_attr("config")[0]  # type: ignore[union-attr]  # None: said below
        except AttributeError:
            raise CzError("APG differentiates the plant of Cz-v0 or CzCrystal-v0: env must be made of these") from None
        if config.observation != "measured":
            raise CzError(f'APG reads observation="measured" and remembers itself, not {config.observation!r}')
        return config

    def learn(
        self, total_timesteps: int, callback: MaybeCallback = None, log_interval: int = 10, tb_log_name: str = "APG",
        reset_num_timesteps: bool = True, progress_bar: bool = False,
    ) -> Self:  # fmt: skip
        """Learn for at least ``total_timesteps`` environment steps; see :meth:`stable_baselines3.PPO.learn`."""
        total_timesteps, watch = self._setup_learn(
            total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
        )
        crystals = _Crystals(self._config(), self.n_envs, self.window, [self.seed or 0, self.num_timesteps])
        memory = self.policy.initial_memory(self.n_envs)
        watch.on_training_start(locals(), globals())
        going, updates = True, 0
        while going and self.num_timesteps < total_timesteps:
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            self._update_learning_rate(self.policy.optimizer)
            watch.on_rollout_start()
            loss, memory, going = self._window(crystals, memory, watch)
            watch.on_rollout_end()
            self._follow(loss)
            lost, over = crystals.renew()
            memory[over] = 0.0
            updates += 1
            self.logger.record("train/cost", loss.item())
            self.logger.record_mean("rollout/lost", lost)
            if updates % log_interval == 0:
                self.logger.dump(self.num_timesteps)
        crystals.batch.close()
        watch.on_training_end()
        return self

    def _window(
        self, crystals: "_Crystals", memory: torch.Tensor, watch: BaseCallback
    ) -> tuple[torch.Tensor, torch.Tensor, bool]:
        """Drive every crystal through a window: its mean cost, differentiable, the memory, and whether to go on."""
        policy, going = self.policy, True
        warm = self._current_progress_remaining > 1.0 - WARM_UP
        policy.set_training_mode(True)
        cost_of = StepCost(self._config())
        state, measured = crystals.state, crystals.measured
        costs, seen = [], []
        for _ in range(self.window):
            if warm:
                with torch.no_grad():
                    seen.append(policy.remember(measured, memory)[0])
            action, memory = policy(measured, memory)
            before = state
            state, measured, grows, target = advance(before, action, crystals.batch)
            costs.append(cost_of(before, action, state, grows, target))
            self.num_timesteps += self.n_envs
            going = watch.on_step() and going
        crystals.state, crystals.measured = state.detach(), measured.detach()
        if warm:
            policy.observe_statistics(torch.cat(seen))
        return torch.stack(costs).mean(), memory.detach(), going

    def _follow(self, loss: torch.Tensor) -> None:
        """Take a step along the gradient, unless it is not finite."""
        self.policy.optimizer.zero_grad()
        torch.autograd.backward(loss)
        norms = self.norms[self.norms > 0.0].numpy()
        limit = CLIP_AT * float(np.median(norms)) if norms.size else math.inf
        norm = float(torch.nn.utils.clip_grad_norm_(self.policy.parameters(), limit))
        if math.isfinite(norm):
            self.norms[1:], self.norms[0] = self.norms[:-1].clone(), norm
            self.policy.optimizer.step()
        self._n_updates += 1
        self.logger.record("train/gradient_norm", norm)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """The action and the policy's memory, to be passed on as ``state``."""
        return self.policy.predict(observation, state, episode_start, deterministic)

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", "policy.optimizer"], ["norms"]


class _Crystals:
    """Crystals of the training seeds in a differentiable batch; slots are at different times of their episodes."""

    def __init__(self, config: Config, n: int, window: int, seed: list[int]) -> None:
        self.batch = DifferentiableBatch(config, n)
        self._random = np.random.default_rng(seed)
        self._windows = max(config.steps // window, 1)
        self._left = self._random.integers(1, self._windows, n, endpoint=True)
        self._draw(list(range(n)))

    def _draw(self, slots: list[int]) -> None:
        seeds = self._random.integers(len(TRAINING_SEEDS), size=len(slots)).tolist()
        self.state, self.measured = map(torch.from_numpy, self.batch.reset(seeds, slots))

    def renew(self) -> tuple[int, list[int]]:
        """Draw new crystals for those that were lost or have grown to their end: how many were lost, and all slots."""
        lost = int(self.batch.lost.sum())
        self._left -= 1
        over = np.flatnonzero(~self.batch.grows | (self._left == 0)).tolist()
        if over:
            self._draw(over)
            self._left[over] = self._windows
        return lost, over
