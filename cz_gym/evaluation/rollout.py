"""Rollouts: a policy on seeded episodes, all in one batch, every signal logged."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from inspect import signature
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.error import InvalidAction

from cz_gym.config import Config, check_config, make_config
from cz_gym.env import CzVectorEnv
from cz_gym.spaces import mismatch
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.units import MICRO

Floats = npt.NDArray[np.float64]
PREDICT = "predict(observation, state=None, episode_start=None, deterministic=True) -> (action, state)"


@dataclass(frozen=True)
class Rollout:
    """The episodes of a policy on some seeds, with every signal logged."""

    config: Config
    seeds: tuple[int, ...]
    signals: Any
    """The process' ``Logged`` in SI units, each of shape (steps, episodes); row k is the end of step k + 1."""
    reward: Floats
    """Reward, 0 after the end, shape (steps, episodes)."""
    alive: npt.NDArray[np.bool_]
    """True up to and including the last step, shape (steps, episodes)."""
    failed: npt.NDArray[np.bool_]
    """True of an episode that ended in a failure, shape (episodes,)."""
    start: Any
    """Signals at t = 0, each of shape (1, episodes)."""
    seconds_in_policy: float
    """Time spent in ``predict``, and in ``for_episodes`` of a bound, all episodes together [s]."""

    @property
    def microseconds_per_step(self) -> float:
        """Time in ``predict`` per step of one episode, batched [us]."""
        steps = self.alive.any(axis=1).sum() * self.alive.shape[1]
        return float(self.seconds_in_policy / MICRO / steps)

    def episode(self, i: int) -> Any:
        """Signals of episode ``i`` up to its end, each of shape (steps,); a copy."""
        taken = self.alive[:, i]
        return type(self.signals)(*(signal[taken, i] for signal in self.signals))


def rollout(
    policy: Any,
    config: Config,
    seeds: Sequence[int] | npt.NDArray[Any],
    progress: Callable[[int], Any] | None = None,
    designed_for: Config | None = None,
) -> Rollout:
    """Run ``policy.predict`` on one episode a seed, all in one batch.

    Raises CzError without a seed, and for a policy that was made for another environment: other actions, another
    control interval, another plant. To run it there on purpose, say what it is ``designed_for``.

    ``progress`` is called with the number of steps done since its last call. A failed episode stops counting; its
    slot goes on with another crystal, which nothing reads. A bound with a method ``for_episodes(config, seeds)`` is
    replaced by what it returns, which knows those episodes.
    """
    check_policy(policy, config, designed_for)
    seeds = check_seeds(seeds)
    n, shape = len(seeds), (config.steps, len(seeds))
    before = time.perf_counter()
    policy = informed(policy, config, seeds)
    seconds = time.perf_counter() - before
    kind, memory = config.process.Logged, None
    signals = kind(*(np.zeros(shape) for _ in kind._fields))
    reward, alive, failed = np.zeros(shape), np.zeros(shape, np.bool_), np.zeros(n, np.bool_)
    running, begins, over = np.ones(n, np.bool_), np.ones(n, np.bool_), np.zeros(n, np.bool_)
    with closing(CzVectorEnv.from_config(config, n, info="all")) as env:
        observation, info = env.reset(seed=list(seeds))
        start = kind(*(np.array(info[name])[None] for name in kind._fields))
        for k in range(config.steps):
            before = time.perf_counter()
            action, memory = call_policy(policy, observation, memory, begins)
            seconds += time.perf_counter() - before
            # An action may be tagged with what it was made for; check_policy has said what fits.
            try:
                observation, gained, terminated, truncated, info = env.step(np.asarray(action))
            except InvalidAction as error:
                raise CzError(f"{_where(policy)}, step {k}: {error}") from None
            for log, name in zip(signals, kind._fields, strict=True):
                log[k] = info[name]
            reward[k], alive[k] = np.where(running, gained, 0.0), running
            failed |= running & terminated & (np.asarray(info.get("succeeded", 0.0)) == 0.0)
            # A slot that is over is drawn anew by the next step: only then does its policy begin again.
            begins, over = over, terminated | truncated
            running &= ~over
            done = 1 if running.any() else config.steps - k
            if progress is not None:
                progress(done * n)
            if done > 1:
                break
    return Rollout(config, seeds, signals, reward, alive, failed, start, seconds)


def _where(policy: Any) -> str:
    """The method that chose an action, with its file and line."""
    code = getattr(type(policy).predict, "__code__", None)
    place = f" ({code.co_filename}:{code.co_firstlineno})" if code else ""
    return f"{type(policy).__name__}.predict{place}"


def informed(policy: Any, config: Config, seeds: Sequence[int]) -> Any:
    """Return the policy; of a bound, the one that knows these episodes."""
    return policy.for_episodes(config, list(seeds)) if hasattr(policy, "for_episodes") else policy


def check_seeds(seeds: Sequence[int] | npt.NDArray[Any]) -> tuple[int, ...]:
    """Return the seeds of a list, range or array as whole numbers; CzError unless there is at least one, each >= 0."""
    array = np.asarray(seeds)
    if array.ndim != 1 or not len(array) or array.dtype.kind not in "iu" or array.min() < 0:
        raise CzError(f"seeds must be a sequence of at least one whole number from 0 on, as [1], not {seeds!r:.80}")
    return tuple(array.tolist())


def check_policy(policy: Any, config: Config, designed_for: Config | None = None) -> None:
    """Raise CzError unless the policy can run in the environment of these settings.

    Its attribute ``made_for`` and its settings (:func:`settings_of`) must fit ``config``, or what it is
    ``designed_for``; a ``made_for`` of None fits everywhere.
    """
    check_config(config)
    if isinstance(policy, type) or not (hasattr(policy, "predict") or hasattr(policy, "for_episodes")):
        named = f", as make_controller({policy!r}, config) makes one" if isinstance(policy, str) else ""
        raise CzError(f"{policy!r:.80} is no policy: an object with {PREDICT} is needed{named}")
    if hasattr(policy, "predict"):
        try:
            signature(policy.predict).bind(None, state=None, episode_start=None, deterministic=True)
        except TypeError as error:
            raise CzError(f"{type(policy).__name__}.predict: {error}; it must be {PREDICT}") from None
    target, declared = designed_for or config, settings_of(policy)
    own = target.made_for
    said = {name: declared[name] for name in ("action", "control_interval") if name in declared}
    made_for = getattr(policy, "made_for", own._replace(**said))
    if message := mismatch(made_for, own):
        raise CzError(f"{type(policy).__name__}: {message}")
    if made_for is not None:
        _check_settings(policy, declared, target)


INTERFACE = "observation", "action", "control_interval", "puller", "parameters", "meniscus", "camera", "process"
"""Settings that a policy depends on; the others say what it meets there."""


def settings_of(policy: Any) -> dict[str, Any]:
    """Arguments of ``gym.make`` that a policy declares by its attribute ``settings``, a mapping, or by its attributes
    ``observation``, ``action`` and ``control_interval``; CzError where these differ.
    """
    settings, name = getattr(policy, "settings", None), type(policy).__name__
    if settings is not None and not isinstance(settings, Mapping):
        raise CzError(f"{name}: its settings must be a dict of arguments of gym.make, not {settings!r:.80}")
    given = dict(settings or {})
    for each, kind in {"observation": str, "action": str, "control_interval": Real}.items():
        own = getattr(policy, each, None)
        if isinstance(own, kind) and given.setdefault(each, own) != own:
            raise CzError(f"{name}: its {each} is {own!r}, its settings say {given[each]!r}")
        if each in given and not isinstance(given[each], kind):
            wanted = "a time [s]" if kind is Real else "a name"
            raise CzError(f"{name}: its setting {each} must be {wanted}, not {given[each]!r:.80}")
    return given


def _check_settings(policy: Any, declared: Mapping[str, Any], target: Config) -> None:
    """Raise CzError unless an environment has what a policy declares."""
    known = [*signature(make_config).parameters, *_NO_MATTER, "action_repeat"]
    for name in declared:
        if name not in known:
            raise CzError(f"{type(policy).__name__}: {unknown_name_message('setting', name, known)}")
    if declared.get("action_repeat", 1) != 1:
        raise CzError(f"{type(policy).__name__}: it repeats its actions; here a policy acts at every control interval")
    wanted = make_config(**{name: value for name, value in declared.items() if name in INTERFACE})
    readable = getattr(policy, "observations", ())
    for name in INTERFACE:
        has = getattr(target, name)
        if name in declared and has != getattr(wanted, name) and not (name == "observation" and has in readable):
            said = f"was made for {name}={declared[name]!r:.80}; the environment has {getattr(has, 'label', has)!r:.80}"
            raise CzError(f"{type(policy).__name__}: this controller or agent {said}")


_NO_MATTER = "info", "render_mode", "render_size", "num_envs", "autoreset_mode", "threads"


def call_policy(policy: Any, observation: Any, state: Any, begins: Any) -> tuple[Any, Any]:
    """Return actions, shape (n, 2), and the policy's memory; CzError if ``predict`` returns anything else."""
    answer = policy.predict(observation, state=state, episode_start=begins, deterministic=True)
    if not (isinstance(answer, tuple) and len(answer) == 2):
        raise CzError(f"predict must return a tuple (action, state), not {type(answer).__name__}")
    if np.shape(answer[0]) != (len(observation), 2):
        raise CzError(
            f"predict must return actions of shape {(len(observation), 2)} for {len(observation)} observations, "
            f"not {np.shape(answer[0])}"
        )
    return answer


# Counterfactuals: the same episodes, bit for bit, with another controller from some moment on.


@dataclass(frozen=True)
class Counterfactual:
    """Episodes under one controller, and the same episodes under another one from some moment on."""

    at: float
    """Moment at which the other controller takes over [s]."""
    actual: Rollout
    instead: Rollout
    """Rollout with the other controller; equal to ``actual`` up to ``at``."""


class Playback:
    """Policy that plays logged actions back without reading observations; it holds the last one at the end."""

    def __init__(self, actions: npt.ArrayLike) -> None:
        """``actions`` has shape (steps, 2), for every episode alike, or (steps, episodes, 2); CzError otherwise."""
        self.actions = np.array(actions, np.float32)
        if self.actions.ndim not in (2, 3) or self.actions.shape[-1] != 2 or len(self.actions) == 0:
            raise CzError(
                f"logged actions must be of shape (steps, 2) or (steps, episodes, 2), not {self.actions.shape}"
            )

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[np.float32], Any]:
        """Return the next logged action of each episode; ``state`` is the number of actions played."""
        k = 0 if state is None else state
        action = self.actions[min(k, len(self.actions) - 1)]
        return np.broadcast_to(action, (len(observation), 2)).copy(), k + 1


def replay(
    policy: Any,
    instead: Any,
    config: Config,
    seeds: Sequence[int] | npt.NDArray[Any],
    at: float = 0.0,
    watches: bool = False,
) -> Counterfactual:
    """Run ``policy`` on one episode a seed, and again with ``instead`` from ``at`` [s] on.

    ``policy`` may be a :class:`Playback` of logged actions. ``instead`` begins with an empty memory at ``at``, as in a
    new episode, unless it ``watches``: then it has seen every observation before, and its actions were not taken.
    ``at`` is rounded to the control interval. Raises CzError without a seed, for a moment outside the horizon, and for
    policies that were made for another environment.
    """
    for one in (policy, instead):
        check_policy(one, config)
    seeds = check_seeds(seeds)
    if not 0.0 <= at <= config.horizon:
        raise CzError(f"at must lie in the episode, 0 to {config.horizon:g} s, not {at!r}")
    policy, instead = (informed(one, config, seeds) for one in (policy, instead))
    takeover = round(at / config.control_interval)
    actual = rollout(_Handover(policy, instead, config.steps, False), config, seeds)
    other = rollout(_Handover(policy, instead, takeover, watches), config, seeds)
    return Counterfactual(takeover * config.control_interval, actual, other)


@dataclass(frozen=True)
class _Handover:
    """One policy until a step, then another one, which may have watched before; memory: step, and that of each."""

    first: Any
    second: Any
    step: int
    watches: bool

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        k, first, second = state or (0, None, None)
        if k >= self.step:
            begins = episode_start if self.watches or k > self.step else np.ones(len(observation), np.bool_)
            action, second = call_policy(self.second, observation, second, begins)
            return action, (k + 1, first, second)
        if self.watches:
            _, second = call_policy(self.second, observation.copy(), second, episode_start)
        action, first = call_policy(self.first, observation, first, episode_start)
        return action, (k + 1, first, second)
