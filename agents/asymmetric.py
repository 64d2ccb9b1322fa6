"""Policies of stable-baselines3 that remember hours; most are told the plant's true state while they learn.

What they act on is sensors, and means of these over hours (:class:`cz_gym.sb3.LongMemory`). ``predict`` takes the
observations of the environment as it is, and keeps the means in a memory. Those that are told learn in a
:class:`cz_gym.sb3.CzVecEnv` with ``critic_state``. Their critics read the state; their actors read an estimate of it,
which the callback :class:`LearnState` fits by regression:
``PPO(AsymmetricPolicy, make_vec_env(1024, critic_state=True)).learn(steps, LearnState())``. Needs stable-baselines3.
"""

from collections.abc import Sequence
from functools import cache
from itertools import pairwise, product
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, MlpExtractor, create_mlp
from stable_baselines3.sac.policies import SACPolicy
from torch import nn
from torch.nn.functional import huber_loss

from cz_gym.config import Config
from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.process import Channel, Process
from cz_gym.sb3 import LongMeans, long_channels
from cz_gym.spaces import observations
from cz_gym.support.errors import CzError, require_type

from .residual import ADDED

GAINS = {
    "ring_error": 8.0, "integral": 4.0, "v_p": 8.0, "Q_H": 8.0, "r_c_error": 8.0, "h_c": 8.0, "T_b": 8.0, "dT_i": 2.0,
    "ring_offset": 8.0, "lam": 4.0, "v_p_mean": 2.0, "asked_v_p": 8.0, "asked_Q_H": 8.0,
}  # fmt: skip
"""Factors that bring channels that vary little while a crystal is held to the order of 1; the others need none."""
HARDLY_TOLD = {"r_c_error": 0.3, "dT_i": 0.5, "ring_offset": 0.3, "lam": 0.1}
"""Weights of errors of the estimate that sensors can hardly make smaller, which would drown the others; else 1."""


class Layout(NamedTuple):
    """The channels that an asymmetric policy is given."""

    process: Process
    added: tuple[Channel, ...]
    """Those of :data:`cz_gym.agents.residual.ADDED`, which come first, if the agent adds to a controller."""
    present: int
    """Number of channels that show the present; the last one is the integral of the ring error."""
    unknown: list[int]
    """Places in the true state of what no sensor shows without error."""

    @property
    def sensed(self) -> tuple[Channel, ...]:
        """Channels that the environment shows to the agent."""
        return (*self.added, *observations(self.process)["history"])

    @property
    def seen(self) -> tuple[Channel, ...]:
        """Channels that the actor reads: these, and the means over hours."""
        return (*self.sensed, *long_channels(self.process))

    @property
    def state(self) -> tuple[Channel, ...]:
        """The true state, which follows."""
        return self.process.state


@cache
def layout(width: int, told: bool = True) -> Layout:
    """Find the environment whose "history" and means over hours have that many channels, with the true state if
    ``told``; CzError if none has.
    """
    for process, added in product(ENVIRONMENTS.values(), ((), ADDED)):
        unknown = [i for i, each in enumerate(process.state) if each not in process.measured]
        known = Layout(process, added, len(added) + len(process.measured) + 1, unknown)
        if width == len(known.seen) + told * len(known.state):
            return known
    if told:
        raise CzError("this policy is told the true state: make_vec_env(..., critic_state=True)")
    raise CzError("this policy reads means over hours: cz_gym.sb3.LongMemory(make_vec_env(...))")


class Remembering(BasePolicy):
    """A policy whose actor reads "history" and :class:`cz_gym.sb3.LongMeans`, which it keeps where it acts alone.

    ``interval`` is the time between actions [s] of the environments that it acts in.
    """

    told: ClassVar[bool] = False
    """True if the plant's true state follows what the actor reads."""

    def __init__(self, observation_space: Any, *others: Any, interval: float = 5.0, **named: Any) -> None:
        self.width = observation_space.shape[-1]
        known = layout(self.width, self.told)
        self.channels = len(known.sensed)
        """Number of channels that the environment shows."""
        self.interval = interval
        super().__init__(observation_space, *others, **named)
        self.added = len(known.added)
        for name, matrix in LongMeans.over_hours(known.process, interval)._asdict().items():
            self.register_buffer(f"means_{name}", torch.from_numpy(matrix), persistent=False)

    @property
    def means(self) -> LongMeans:
        """The means over hours that the policy keeps."""
        return LongMeans(*(getattr(self, f"means_{name}") for name in LongMeans._fields))

    def check_interval(self, config: Config) -> None:
        """CzError if the environment has another time between actions."""
        if config.control_interval != (own := self.interval):
            one = config.control_interval
            raise CzError(f"the policy's means are of {own:g} s between actions: policy_kwargs={{'interval': {one:g}}}")

    def look(self, observation: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Map what the environment shows, shape (n, channels), to what the actor reads, and the next memory."""
        means, memory = self.means.after(observation[:, self.added :], memory)
        return torch.cat([observation, means], dim=1), memory

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[Any, Any]:
        """Act as stable-baselines3's policies do on observations of a batch with ``critic_state``.

        Of those of the environment as it is, shape (n, channels) or (channels,), it keeps the means in ``state``.
        """
        if observation.shape[-1] == self.width:
            return super().predict(observation, state, episode_start, deterministic)
        rows = torch.as_tensor(np.atleast_2d(observation))
        memory = torch.zeros(len(rows), len(self.means.keep)) if state is None else torch.as_tensor(state)
        if episode_start is not None:
            memory = torch.where(torch.as_tensor(np.atleast_1d(episode_start))[:, None] > 0, 0.0, memory)
        seen, memory = self.look(rows, memory)
        told = np.zeros((*observation.shape[:-1], self.width), np.float32)
        told[..., : seen.shape[1]] = seen if observation.ndim > 1 else seen[0]
        action, _ = super().predict(told, deterministic=deterministic)
        return action, memory.numpy()

    def _get_constructor_parameters(self) -> dict[str, Any]:
        """Arguments with which :meth:`load` makes the policy again."""
        return {**super()._get_constructor_parameters(), "interval": self.interval}


class RememberingPolicy(Remembering, ActorCriticPolicy):
    """The policy of stable-baselines3's PPO and A2C with a memory of hours; actor and critic read sensors alone."""

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        """Make the scaling of the channels."""
        return ScaledChannels(self.observation_space)


class Asymmetric(Remembering):
    """A policy whose critic reads the plant's true state behind what its actor sees."""

    told = True


class AsymmetricPolicy(Asymmetric, ActorCriticPolicy):
    """The policy of stable-baselines3's PPO and A2C whose critic is told the true state, and whose actor estimates it.

    Give ``learn`` the callback :class:`LearnState`: without it the actor's :class:`StateEstimator` stays random.
    """

    def _build_mlp_extractor(self) -> None:
        self.share_features_extractor = False
        self.pi_features_extractor = self.features_extractor = StateEstimator(self.observation_space)
        self.vf_features_extractor = StateFeatures(self.observation_space)
        self.mlp_extractor, critic = (
            MlpExtractor(each.features_dim, self.net_arch, self.activation_fn, self.device)
            for each in (self.pi_features_extractor, self.vf_features_extractor)
        )
        self.mlp_extractor.value_net = critic.value_net


class AsymmetricSACPolicy(Asymmetric, SACPolicy):
    """The policy of stable-baselines3's SAC whose critics are told the true state, and whose actor estimates it.

    As for :class:`AsymmetricPolicy`, :class:`LearnState` fits the estimate.
    """

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Make the actor, on the sensors and the estimate."""
        return super().make_actor(StateEstimator(self.observation_space))

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
        """Make the critics, on the true state and its products."""
        settings = self._update_features_extractor(self.critic_kwargs, StateFeatures(self.observation_space))
        return StateCritic(**settings).to(self.device)


class StateCritic(ContinuousCritic):
    """Critics of states and actions, and of their products: the value of an action is nearly quadratic in both."""

    def __init__(self, *others: Any, **named: Any) -> None:
        super().__init__(*others, **named)
        sight: Any = self.features_extractor
        actions = get_action_dim(self.action_space)
        width = sight.features_dim + actions * (len(sight.layout.state) + 1 + actions)
        sizes = [width, *named["net_arch"]]
        for place in range(self.n_critics):
            layers = [nn.Sequential(nn.Linear(a, b), nn.LayerNorm(b), nn.SiLU()) for a, b in pairwise(sizes)]
            self.q_networks[place] = nn.Sequential(*layers, nn.Linear(sizes[-1], 1))
            self.add_module(f"qf{place}", self.q_networks[place])

    def forward(self, obs: torch.Tensor, actions: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the value of each critic, of shape (n, 1)."""
        sight: Any = self.features_extractor
        state = torch.cat([sight.state(obs), actions], dim=1)
        products = (actions[:, :, None] * state[:, None, :]).flatten(1)
        x = torch.cat([sight(obs), actions, products], dim=1)
        return tuple(each(x) for each in self.q_networks)


def _gains(channels: Sequence[Channel]) -> torch.Tensor:
    return torch.tensor([GAINS.get(each.name, 1.0) for each in channels])


class ScaledChannels(BaseFeaturesExtractor):
    """Features of a :class:`RememberingPolicy`: all channels, brought to the order of 1."""

    gains: torch.Tensor

    def __init__(self, space: Any) -> None:
        super().__init__(space, space.shape[0])
        self.register_buffer("gains", _gains(layout(space.shape[0], told=False).seen), persistent=False)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Scale observations (n, channels)."""
        return observations * self.gains


class StateEstimator(BaseFeaturesExtractor):
    """Features of an actor: what the sensors show now, and the unknown part of the state as estimated from the past.

    The estimate is a network's, two layers of 128 units beside a linear map, on "history" and the means over hours.
    :class:`LearnState` fits it: the reward does not change it.
    """

    gains: torch.Tensor
    state_gains: torch.Tensor
    weights: torch.Tensor

    def __init__(self, space: Any) -> None:
        known = layout(space.shape[0])
        super().__init__(space, known.present + len(known.unknown))
        self.layout, self.channels = known, len(known.seen)
        self.register_buffer("gains", _gains(known.seen), persistent=False)
        self.register_buffer("state_gains", _gains(known.state)[known.unknown], persistent=False)
        weights = torch.tensor([HARDLY_TOLD.get(known.state[i].name, 1.0) for i in known.unknown])
        self.register_buffer("weights", weights, persistent=False)
        self.network = nn.Sequential(*create_mlp(self.channels, len(known.unknown), [128, 128]))
        self.linear = nn.Linear(self.channels, len(known.unknown))

    def estimate(self, seen: torch.Tensor) -> torch.Tensor:
        """Map scaled channels to the unknown part of the state."""
        estimate: torch.Tensor = self.network(seen) + self.linear(seen)
        return estimate

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Map observations (n, at least the channels that the actor reads) to features (n, features)."""
        seen = observations[:, : self.channels] * self.gains
        with torch.no_grad():
            estimate = self.estimate(seen)
        return torch.cat([seen[:, : self.layout.present], estimate], dim=1)

    def loss(self, observations: torch.Tensor) -> torch.Tensor:
        """Weighted Huber loss of the estimate; the true state follows the channels that the actor reads."""
        seen, state = observations[:, : self.channels], observations[:, self.channels :]
        wanted = state[:, self.layout.unknown] * self.state_gains
        return (self.weights * huber_loss(self.estimate(seen * self.gains), wanted, reduction="none")).mean()


class StateFeatures(BaseFeaturesExtractor):
    """Features of a critic: what the actor reads, the true state, and its products.

    With a linear plant and a quadratic cost the value is quadratic in the state.
    """

    gains: torch.Tensor

    def __init__(self, space: Any) -> None:
        known = layout(space.shape[0])
        self.width = len(known.state)
        super().__init__(space, space.shape[0] + self.width * (self.width + 1) // 2)
        self.layout = known
        self.register_buffer("gains", _gains([*known.seen, *known.state]), persistent=False)

    def state(self, observations: torch.Tensor) -> torch.Tensor:
        """Scale the true state and clip it to +-4, shape (n, channels of the state)."""
        return (observations * self.gains)[:, len(self.layout.seen) :].clamp(-4.0, 4.0)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Map observations (n, channels that the actor reads and of the state) to features (n, features)."""
        state = self.state(observations)
        half = 0.5 * state
        products = [half[:, i : i + 1] * state[:, i:] for i in range(self.width)]  # a fifth of the time of an index
        return torch.cat([observations * self.gains, *products], dim=1)


class LearnState(BaseCallback):
    """Fits the :class:`StateEstimator` of an :class:`Asymmetric` policy while it learns.

    After each update it goes once through the last rollout in batches of 512, at the algorithm's learning rate; not
    before the update, which must meet the actor that acted. An algorithm with a replay buffer gives it a batch for each
    of its ``gradient_steps``, at least one.
    """

    seen: torch.Tensor | None = None

    def _init_callback(self) -> None:
        policy: Any = require_type(Asymmetric, self.model.policy, "LearnState fits the estimate of such a policy alone")
        policy.check_interval(self.training_env.get_attr("config", 0)[0])
        on_policy = isinstance(policy, AsymmetricPolicy)
        self.estimator: StateEstimator = policy.pi_features_extractor if on_policy else policy.actor.features_extractor
        self.optimizer = torch.optim.Adam(self.estimator.parameters())

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        if hasattr(model, "rollout_buffer"):
            self.seen = torch.as_tensor(model.rollout_buffer.observations, device=model.device).flatten(0, 1)
        elif model.num_timesteps > model.learning_starts:
            self.seen = model.replay_buffer.sample(512 * max(model.gradient_steps, 1)).observations

    def _on_rollout_start(self) -> None:
        if self.seen is None:
            return
        for group in self.optimizer.param_groups:
            group["lr"] = self.model.lr_schedule(self.model._current_progress_remaining)
        for batch in torch.split(self.seen[torch.randperm(len(self.seen))], 512):
            loss: Any = self.estimator.loss(batch)
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
