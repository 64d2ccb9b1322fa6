"""Behaviour cloning: an actor that begins as the imitation of a teacher.

The teacher controls training episodes while noise disturbs its actions, so that its answers to mistakes are seen too;
then the imitation controls while the teacher says what it would have done (Ross, Gordon, Bagnell 2011). The actor is
fitted to those answers: its linear path by regression on the whitened observation, then all of it by gradient.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from cz_gym import CzVectorEnv
from cz_gym.config import Config
from cz_gym.observation import HISTORY, LAGS

from .networks import DRIVES, Normalise, seen_channels
from .recipes import Clone

Floats = npt.NDArray[np.float32]
RIDGE = 1e-6
"""Regularisation of the regression, in units of the whitened observation's variance."""
VARIANCE_FLOOR = 1e-6
"""Least variance that whitening divides by [-]."""
LEAST = 1e-6
"""Least spread of answers that a loss is divided by."""
EVERY = 4
"""Samples between those that are kept."""
BATCH = 4096


class Shown(NamedTuple):
    """What a teacher answered."""

    observation: Floats
    """Shape (samples, channels)."""
    action: Floats
    """What the teacher would do there, shape (samples, 2)."""
    state: Floats
    """The true state there, shape (samples, state channels)."""


class Views(NamedTuple):
    """How the networks look at what is shown: mean and scaling of the observation, mean and spread of the state."""

    mean: npt.NDArray[np.float64]
    scaling: npt.NDArray[np.float64]
    state_mean: npt.NDArray[np.float64]
    state_spread: npt.NDArray[np.float64]


def demonstrate(
    teacher: Any, config: Config, seeds: Sequence[int], noise: tuple[float, float], driver: Any = None
) -> Shown:
    """Ask the teacher, ``predict`` on "history", at every sample of one episode a seed.

    A teacher with ``for_episodes`` is told what no controller knows of those episodes. It drives itself unless there is
    a ``driver``, a function of the observation; noise of that spread is added.
    """
    n = len(seeds)
    if hasattr(teacher, "for_episodes"):
        teacher = teacher.for_episodes(config, seeds)
    env = CzVectorEnv(n, scenario=config.scenario, observation="history", control_interval=config.control_interval)
    random = np.random.default_rng(seeds[0])
    observation, info = env.reset(seed=list(seeds))
    begins, over, memory = np.ones(n, np.bool_), np.zeros(n, np.bool_), None
    running = np.ones(n, np.bool_)
    kept: list[tuple[Floats, ...]] = []
    for k in range(config.steps):
        answer, memory = teacher.predict(observation, memory, begins)
        if k % EVERY == 0:
            kept.append((observation[running], answer[running], info["state"][running]))
        action = answer if driver is None else driver(observation)
        disturbed = action + random.normal(0.0, noise, action.shape)
        observation, _, terminated, truncated, info = env.step(np.clip(disturbed, -1.0, 1.0).astype(np.float32))
        begins, over = over, terminated | truncated
        running &= ~over
    env.close()
    return Shown(*(np.concatenate(parts).astype(np.float32) for parts in zip(*kept, strict=True)))


def joined(parts: Iterable[Shown]) -> Shown:
    """All of them as one."""
    return Shown(*map(np.concatenate, zip(*parts, strict=True)))


def whitening(observation: Floats) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Mean and symmetric scaling that make the observation's channels uncorrelated, of variance one."""
    variances, axes = np.linalg.eigh(np.cov(observation.T.astype(np.float64)))
    return observation.mean(axis=0, dtype=np.float64), axes / np.sqrt(np.maximum(variances, VARIANCE_FLOOR)) @ axes.T


def imitate(
    policy: Any,
    teacher: Any,
    config: Config,
    wide: Config,
    choice: Clone,
    first_seed: int,
    tell: Callable[[str], None] = lambda _: None,
) -> Views:
    """Make a :class:`.networks.DrivePolicy` act like the teacher; seeds from ``first_seed`` on are shown.

    The first of each round's are crystals of ``wide``, as many as ``choice`` says, the others of ``config``.
    """
    shown: Shown | None = None
    views: Views | None = None
    for turn in range(choice.rounds):
        seeds = range(first_seed + turn * choice.episodes, first_seed + (turn + 1) * choice.episodes)
        tell(f"asks {choice.teacher}, round {turn + 1} of {choice.rounds}")
        driver, many = acts(policy) if turn else None, round(choice.wide_share * choice.episodes)
        parts = [(wide, seeds[:many]), (config, seeds[many:])]
        answers = joined(demonstrate(teacher, of, some, choice.noise, driver) for of, some in parts if some)
        if views is None:
            views = begin_linear(policy, answers)
        shown = joined([shown, answers]) if shown else answers
        tell(f"fits {len(shown.action):,} answers")
        fit(policy, shown, choice)
    if views is None:
        raise ValueError(f"an imitation needs at least one round, not {choice.rounds}")
    return views


def stand_beside(policy: Any, teacher: Any, config: Config, choice: Clone, first_seed: int) -> Views:
    """Make a policy whose action is added to the teacher's add nothing yet; it sees as if it had imitated.

    ``config`` is of the wide crystals, whatever their share: they only set how the network looks at what it sees.
    """
    views = views_of(demonstrate(teacher, config, range(first_seed, first_seed + choice.episodes), choice.noise))
    set_views(policy, views)
    _clear(policy)
    return views


def acts(policy: Any) -> Callable[[Floats], Floats]:
    """The policy's mean action as a function of "history" observations."""

    def act(observation: Floats) -> Floats:
        with torch.no_grad():
            action: Floats = policy._predict(_whole(policy, observation), deterministic=True).numpy()
        return action

    return act


def views_of(shown: Shown, memory: float = LAGS[-1]) -> Views:
    """Whitening of what networks with that memory [s] see, and the state's mean and spread."""
    mean, scaling = whitening(shown.observation * seen_channels(len(HISTORY), memory))
    return Views(mean, scaling, shown.state.mean(axis=0), np.maximum(shown.state.std(axis=0), VARIANCE_FLOOR**0.5))


def set_views(policy: Any, views: Views) -> None:
    """Let the policy's networks look that way."""
    normalise: Normalise = policy.features_extractor
    mean, whole, seen = np.zeros(len(normalise.mean)), np.eye(len(normalise.mean)), len(HISTORY)
    mean[:seen], whole[:seen, :seen] = views.mean, views.scaling
    if len(whole) > seen:
        mean[seen:], whole[seen:, seen:] = views.state_mean, np.diag(1.0 / views.state_spread)
    normalise.set(mean, whole)


def begin_linear(policy: Any, shown: Shown) -> Views:
    """Set normalisation and linear path from the answers; the layers add nothing yet."""
    views = views_of(shown, policy.memory)
    set_views(policy, views)
    whitened = _features(policy, shown.observation).numpy().astype(np.float64)
    x = np.column_stack([whitened, np.ones(len(whitened))])
    weights = np.linalg.solve(x.T @ x + RIDGE * len(x) * np.eye(x.shape[1]), x.T @ _outputs(policy, shown))
    _clear(policy)
    direct = policy.mlp_extractor.direct
    with torch.no_grad():
        direct.weight.copy_(torch.as_tensor(weights[:-1].T))
        direct.bias.copy_(torch.as_tensor(weights[-1]))
    return views


def _clear(policy: Any) -> None:
    """Let the network put out nothing."""
    with torch.no_grad():
        for module in (policy.mlp_extractor.direct, policy.action_net.linear):
            module.weight.zero_()
            module.bias.zero_()


def fit(policy: Any, shown: Shown, choice: Clone) -> None:
    """Fit the whole actor to the answers: Huber's loss on outputs of unit spread, one cycle of the learning rate."""
    wanted = _outputs(policy, shown)
    spread = torch.as_tensor(np.maximum(np.quantile(np.abs(wanted), 0.68, axis=0), LEAST).astype(np.float32))
    features = _features(policy, shown.observation)
    targets = torch.as_tensor(wanted / spread.numpy())
    extractor, head = policy.mlp_extractor, policy.action_net
    parameters = [*extractor.actor.parameters(), *extractor.direct.parameters(), *head.linear.parameters()]
    steps = choice.epochs * max(len(wanted) // BATCH, 1)
    optimiser = torch.optim.Adam(parameters, choice.learning_rate)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimiser, choice.learning_rate, total_steps=steps)
    for _ in range(steps):
        rows = torch.randint(len(wanted), (min(BATCH, len(wanted)),))
        x = features[rows]
        outputs = (head.linear(extractor.actor(x)) + extractor.direct(x)) / spread
        loss = torch.nn.functional.huber_loss(outputs, targets[rows])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        cycle.step()


def _whole(policy: Any, observation: Floats) -> torch.Tensor:
    """What the policy reads, with this observation for the actor and nothing for the critic."""
    hidden = policy.observation_space.shape[0] - len(HISTORY)
    return torch.as_tensor(np.pad(observation, ((0, 0), (0, hidden))))


def _features(policy: Any, observation: Floats) -> torch.Tensor:
    """The actor's normalised view, shape (samples, channels)."""
    with torch.no_grad():
        features: torch.Tensor = policy.features_extractor(_whole(policy, observation))
    return features[:, : len(HISTORY)].contiguous()


def _outputs(policy: Any, shown: Shown) -> Floats:
    """What the network must put out for the teacher's answers."""
    head = policy.action_net
    outputs: Floats = (shown.action - head.skip * shown.observation[:, list(DRIVES)]) / head.scale.numpy()
    return outputs
