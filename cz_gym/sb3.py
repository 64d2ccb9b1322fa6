"""stable-baselines3's ``VecEnv`` over the native batch: no processes, no Python loop over slots.

``make_vec_env(16)`` is an environment for any of its algorithms. This module needs stable-baselines3; nothing else of
the package imports it.
"""

import time
from collections.abc import Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, unwrap_vec_wrapper

from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.support.errors import CzError, require_type, unknown_name_message

from .env import CzVectorEnv, EnvState
from .process import Channel, Process
from .spaces import observations


def make_vec_env(
    num_envs: int, stagger: int | None = None, action_repeat: int = 1, critic_state: bool = False, env: str = "Cz-v0",
    **settings: Any,
) -> VecEnv:  # fmt: skip
    """Many environments for stable-baselines3; ``settings`` are the keywords of ``gym.make(env, ...)``.

    ``stagger`` and ``critic_state`` are :class:`CzVecEnv`'s, the latter in a :class:`LongMemory`. With
    ``action_repeat`` above 1 each action is held for as many steps while an agent learns, whose effect is then easier
    to see (:class:`ActionRepeat`); a trained agent acts at every step.
    """
    if env not in ENVIRONMENTS:
        raise CzError(unknown_name_message("environment", env, ENVIRONMENTS))
    settings = {"process": ENVIRONMENTS[env]} | settings | ({"info": "all"} if critic_state else {})
    batch = CzVectorEnv(num_envs, autoreset_mode=AutoresetMode.SAME_STEP, **settings)
    slots: VecEnv = CzVecEnv(batch, stagger, critic_state)
    slots = LongMemory(slots) if critic_state else slots
    return slots if action_repeat == 1 else ActionRepeat(slots, action_repeat)


class CzVecEnv(VecEnv):
    """A :class:`cz_gym.CzVectorEnv` with the interface of stable-baselines3's vector environments.

    Observations are float32, shape (num_envs, channels); ``infos`` are empty except for slots whose episode ended: they
    hold ``terminal_observation``, ``TimeLimit.truncated`` and ``episode``: return, length and time, as those of
    stable-baselines3's ``Monitor``, and "c", the sum of the steps' ``info["cost"]``. ``cost`` has those of the last
    step, shape (num_envs,). With ``stagger``, a seed, each slot's first episode is cut (truncated) at a random step, so
    that slots are not all in the same minute. With ``critic_state`` the plant's true state
    (the channels of "state") follows the channels of ``observation="history"``, for a
    policy of :mod:`cz_gym.agents.asymmetric`; the batch needs ``info="all"``.
    """

    def __init__(self, env: CzVectorEnv, stagger: int | None = None, critic_state: bool = False) -> None:
        require_type(CzVectorEnv, env, "without wrappers of gymnasium around it")
        if env.autoreset_mode != AutoresetMode.SAME_STEP:
            raise CzError("CzVecEnv needs autoreset_mode=AutoresetMode.SAME_STEP, as stable-baselines3 resets itself")
        self.env = env
        self.render_mode = env.render_mode
        self.critic_state, space = critic_state, env.single_observation_space
        if critic_state:
            if env.config.observation != "history":
                raise CzError(f"critic_state needs observation='history', not {env.config.observation!r}")
            width = len(observations(env.config.process)["history"]) + len(env.config.process.state)
            space = Box(-np.inf, np.inf, (width,), np.float32)
        self.slots = [Slot(self, i) for i in range(env.num_envs)]
        self._given: int | Sequence[int | None] | None = None
        super().__init__(env.num_envs, space, env.single_action_space)
        self._actions = np.zeros((env.num_envs, 2), np.float32)
        self._returns = np.zeros(env.num_envs)
        self._lengths = np.zeros(env.num_envs, np.int64)
        self.cost, self._costs = np.zeros(env.num_envs), np.zeros(env.num_envs)
        self._began = time.time()
        self._k = 0
        self._cuts = np.zeros(env.num_envs, np.int64)
        if stagger is not None:
            self._cuts = np.random.default_rng(stagger).integers(1, env.config.steps, env.num_envs, endpoint=True)

    def seed(self, seed: int | Sequence[int | None] | None = None) -> Sequence[int | None]:
        """Seed the next reset as :meth:`cz_gym.CzVectorEnv.reset` does: by one number for the batch, or one a slot."""
        self._given = int(np.random.randint(0, np.iinfo(np.uint32).max, dtype=np.uint32)) if seed is None else seed
        return [self._given] * self.num_envs if isinstance(self._given, int | np.integer) else list(self._given)

    def reset(self) -> Any:
        """Draw new episodes, with the seeds and options given before; options may be a list, one a slot."""
        own: Any = self._options or [{}]
        alike = all(each is own[0] for each in own) and not isinstance(own[0].get("state"), EnvState)
        observation = self._shown(*self.env.reset(seed=self._given, options=own[0] or None if alike else own))
        self._given = None
        self._reset_options()
        self._returns[:] = self._costs[:] = 0.0
        self._lengths[:] = 0
        self._k = 0
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Advance every slot."""
        observation, reward, terminated, truncated, info = self.env.step(self._actions)
        observation = self._shown(observation, info)
        self._returns += reward
        self._lengths += 1
        self._k += 1
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        done = terminated | truncated
        if "cost" in info:  # not every process has one
            self.cost = np.where(done, info["final_info"]["cost"], info["cost"]) if done.any() else info["cost"]
            self._costs += self.cost
        for i in np.flatnonzero(done).tolist():
            last = self._shown(info["final_obs"][i], {name: of[i] for name, of in info["final_info"].items()})
            infos[i] = self._final(i, last, bool(truncated[i]))
        cut = (self._cuts == self._k) & ~done
        if cut.any():
            for i in np.flatnonzero(cut).tolist():
                infos[i] = self._final(i, observation[i].copy(), True)
            observation[cut] = self._shown(*self.env.reset(options={"reset_mask": cut}))[cut]
            done = done | cut
        self._returns[done] = self._costs[done] = 0.0
        self._lengths[done] = 0
        return observation, reward.astype(np.float32), done, infos

    def _shown(self, observation: np.ndarray, info: dict[str, Any]) -> np.ndarray:
        return np.concatenate([observation, info["state"]], axis=-1) if self.critic_state else observation

    def _final(self, i: int, observation: np.ndarray, truncated: bool) -> dict[str, Any]:
        earned = {"r": float(self._returns[i]), "c": float(self._costs[i])}
        episode = {**earned, "l": int(self._lengths[i]), "t": round(time.time() - self._began, 6)}
        return {"terminal_observation": observation, "TimeLimit.truncated": truncated, "episode": episode}

    def close(self) -> None:
        """Stop the environment's threads."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute of each slot."""
        return [getattr(slot, attr_name) for slot in self._at(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of each slot."""
        for slot in self._at(indices):
            setattr(slot, attr_name, value)

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        """Call a method of each slot: those of :class:`Slot`."""
        return [getattr(slot, method_name)(*method_args, **method_kwargs) for slot in self._at(indices)]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """True for ``Monitor``: each slot reports its episodes as that wrapper does."""
        return [wrapper_class is Monitor for _ in self._at(indices)]

    def _at(self, indices: Any) -> "list[Slot]":
        return [self.slots[i] for i in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """None for each slot: the native batch does not render."""
        return [None] * self.num_envs


class Slot:
    """One crystal of a :class:`CzVecEnv`, as ``get_attr``, ``set_attr`` and ``env_method`` reach it.

    It has the methods of :class:`cz_gym.CzEnv` that concern one crystal alone, and the attributes of the batch.
    """

    def __init__(self, among: CzVecEnv, i: int) -> None:
        self._among, self._i = among, i

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Draw this slot's next episode, as :meth:`cz_gym.CzEnv.reset`; the others go on."""
        among, i, n = self._among, self._i, self._among.num_envs
        given = {**(options or {}), "reset_mask": np.arange(n) == i}
        given |= {"state": (given["state"],) * n} if "state" in given else {}
        observation, info = among.env.reset(seed=[seed] * n, options=given)
        among._returns[i] = among._costs[i] = among._lengths[i] = 0
        own = {name: values[i] for name, values in info.items() if f"_{name}" in info}
        return among._shown(observation, info)[i], own

    def get_state(self) -> EnvState:
        """The state of this slot alone (:meth:`cz_gym.CzEnv.get_state`)."""
        return self._among.env.get_state()[self._i]

    def set_state(self, state: EnvState) -> None:
        """Continue this slot from a state (:meth:`cz_gym.CzEnv.set_state`)."""
        self.reset(options={"state": state})

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # also while a copy is made, which has no attributes yet
            raise AttributeError(f"a slot has no {name!r}")
        batch, own = self._among.env, {"observation_space", "action_space"}
        value = getattr(self._among if name in own else batch, name)
        if callable(value):
            raise AttributeError(f"a slot has no {name!r}; its methods are reset, get_state and set_state")
        return value[self._i] if name.startswith("np_random") else value


LONG = (2400.0, 4800.0, 9600.0)
"""Time constants of the means of a :class:`LongMemory` [s]; "history" ends at 20 minutes."""


def long_channels(process: Process) -> tuple[Channel, ...]:
    """The channels of :class:`LongMeans`: differences of neighbouring means, scaled as those of "history"."""
    units = {each.name: each.unit for each in process.measured}
    later = ("the value now", *(f"that over {time:g} s" for time in LONG))
    return tuple(
        Channel(units[name], scale, f"{name}: leaky mean over {time:g} s, minus {before}", f"{name}_mean_{time:g}s")
        for time, before in zip(LONG, later, strict=False)
        for name, scale in process.past
    )


class LongMeans(NamedTuple):
    """Leaky means of the signals of "history" over hours, in matrix products of NumPy's or torch's arrays.

    A mean is the sum of readings, each weighed by its age, over the sum of the weights, so that it is right from the
    first reading on. The memory has both sums, shape (n, ``len(keep)``), zero where a crystal begins.
    """

    keep: Any
    """Share of the sums that is left after a step, shape (memory,)."""
    pick: Any
    """Takes the signals from "history", shape (channels, signals)."""
    gain: Any
    """What a signal adds to the sums, shape (signals, memory)."""
    one: Any
    """What a step adds to the sums of the weights, shape (memory,)."""
    sums: Any
    """Takes the sums of readings from the memory, shape (memory, means)."""
    weights: Any
    """Takes the sums of the weights, shape (memory, means)."""
    less: Any
    """The value now, which the first means are shown relative to, shape (signals, means)."""
    differences: Any
    """Each mean less the one before, shape (means, means)."""

    @classmethod
    def over_hours(cls, process: Process, interval: float) -> Self:
        """The means over :data:`LONG` of the signals of a process, for an interval between readings [s]."""
        history, past, n = observations(process)["history"], process.past, len(LONG)
        signals, keep = len(past), np.exp(-interval / np.array(LONG))
        names, rows = [each.name for each in history], np.eye(signals + 1)
        pick = np.zeros((len(history), signals))
        for column, each in enumerate(past):
            place = names.index(each.name)
            pick[place, column] = history[place].scale / each.scale
        each_signal = rows[:signals, :signals]
        matrices = (
            np.repeat(keep, signals + 1),
            pick,
            np.kron(1.0 - keep, rows[:signals]),
            np.kron(1.0 - keep, rows[signals]),
            np.kron(np.eye(n), rows[:, :signals]),
            np.kron(np.eye(n), np.outer(rows[signals], np.ones(signals))),
            np.kron(-np.eye(n)[0], each_signal),
            np.kron(np.eye(n) - np.eye(n, k=1), each_signal),
        )
        return cls(*(matrix.astype(np.float32) for matrix in matrices))

    def after(self, history: Any, memory: Any) -> tuple[Any, Any]:
        """Map "history", shape (n, channels), and the memory to :func:`long_channels` and the next memory."""
        now = history @ self.pick
        memory = memory * self.keep + now @ self.gain + self.one
        means = (memory @ self.sums) / (memory @ self.weights)
        return means @ self.differences + now @ self.less, memory


class LongMemory(VecEnvWrapper):
    """Puts the channels of :class:`LongMeans` between those of "history" and the state of a ``critic_state`` batch.

    For policies of :mod:`cz_gym.agents.asymmetric`, which keep the means themselves where they act alone.
    """

    def __init__(self, venv: VecEnv) -> None:
        config = venv.get_attr("config", 0)[0]
        self.channels = len(observations(config.process)["history"])
        self.means = LongMeans.over_hours(config.process, config.control_interval)
        self.memory = np.zeros((venv.num_envs, len(self.means.keep)), np.float32)
        width: Any = np.array(venv.observation_space.shape) + len(long_channels(config.process))
        super().__init__(venv, Box(-np.inf, np.inf, width, np.float32))

    def __reduce__(self) -> tuple[Any, ...]:
        return _remembering, (self.venv, self.memory)  # the wrapper's own state holds what does not pickle

    def reset(self) -> Any:
        """Reset every slot."""
        return self._shown(self.venv.reset(), np.ones(self.num_envs, np.bool_))

    def step_async(self, actions: np.ndarray) -> None:
        """Hand the actions on."""
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Advance every slot."""
        observation, reward, done, infos = self.venv.step_wait()
        for i in np.flatnonzero(done).tolist():
            last = infos[i]["terminal_observation"]
            infos[i]["terminal_observation"] = self._with_means(last[None], self.memory[i : i + 1])[0][0]
        return self._shown(observation, done), reward, done, infos

    def _shown(self, observation: Any, begins: np.ndarray) -> np.ndarray:
        self.memory[begins] = 0.0
        shown, self.memory = self._with_means(observation, self.memory)
        return shown

    def _with_means(self, observation: np.ndarray, memory: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        history, state = np.split(observation, [self.channels], axis=1)
        features, memory = self.means.after(history, memory)
        return np.concatenate([history, features, state], axis=1), memory


def _remembering(venv: VecEnv, memory: np.ndarray) -> LongMemory:
    made = LongMemory(venv)
    made.memory = memory.copy()
    return made


class ActionRepeat(VecEnvWrapper):
    """Repeats each action for ``times`` steps; the reward is the sum of theirs.

    An episode that ends among these steps ends the transition; the steps of the next episode until the action's end
    earn nothing.
    """

    def __init__(self, venv: VecEnv, times: int) -> None:
        super().__init__(venv)
        self.times = times

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.venv, self.times)  # the wrapper's own state holds what does not pickle

    def reset(self) -> Any:
        """Reset every slot."""
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the actions for :meth:`step_wait`."""
        self.actions = actions
        self.venv.step_async(actions)

    def step_wait(self) -> Any:
        """Advance every slot by ``times`` steps."""
        observation, earned, done, infos = self.venv.step_wait()
        for _ in range(self.times - 1):
            self.venv.step_async(self.actions)
            observation, more, over, others = self.venv.step_wait()
            earned = earned + np.where(done, np.float32(0.0), more)
            infos = [one if one else other for one, other in zip(infos, others, strict=True)]
            done = done | over
        return observation, earned, done, infos


class AddToController(VecEnvWrapper):
    """Adds actions to those of a controller, which runs in the batch (:class:`cz_gym.agents.residual.Residual`).

    The controller's channels come first in the observation. It acts at every step: repeat actions around this wrapper.
    """

    def __init__(self, venv: VecEnv, residual: Any) -> None:
        self.residual, self.memory = residual, None
        width: Any = residual.width + np.array(venv.observation_space.shape)
        super().__init__(venv, Box(-np.inf, np.inf, width, np.float32))

    def reset(self) -> Any:
        """Reset every slot."""
        return self._shown(self.venv.reset(), np.ones(self.num_envs, np.bool_))

    def step_async(self, actions: np.ndarray) -> None:
        """Keep the sum of both for :meth:`step_wait`."""
        action, self.memory = self.residual.act(actions, self.memory)
        self.venv.step_async(action)

    def step_wait(self) -> Any:
        """Advance every slot; a last observation has the controller's channels of the step before."""
        observation, reward, done, infos = self.venv.step_wait()
        for i in np.flatnonzero(done).tolist():
            infos[i]["terminal_observation"] = np.concatenate([self.added[i], infos[i]["terminal_observation"]])
        return self._shown(observation, done), reward, done, infos

    def _shown(self, observation: Any, begins: np.ndarray) -> np.ndarray:
        self.added, self.memory = self.residual.read(observation, self.memory, begins)
        return np.concatenate([self.added, observation], axis=1)


def environment_steps(model: BaseAlgorithm) -> int:
    """Training steps of a model [environment steps]; each repeat of an action counts."""
    env = model.get_env()
    if env is None:
        return int(model.num_timesteps)
    repeat = unwrap_vec_wrapper(env, ActionRepeat)
    try:
        own: int = env.get_attr("action_repeat", 0)[0]
    except AttributeError:
        own = 1
    return int(model.num_timesteps) * own * (1 if repeat is None else repeat.times)
