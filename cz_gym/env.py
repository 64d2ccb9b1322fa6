"""The environments ``Cz-v0``, a body, and ``CzCrystal-v0``, a whole crystal: each scalar, and as a native batch.

``gym.make("Cz-v0")`` makes a :class:`CzEnv`, ``gym.make_vec("Cz-v0", vectorization_mode="vector_entry_point")`` a
:class:`CzVectorEnv`. Both are thin shells over :class:`cz_gym.engine.batch.Batch`: arguments are checked by
:func:`cz_gym.config.make_config`, slots hold the crystals.
"""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from inspect import Signature, signature
from typing import Any, Self

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.error import ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from cz_gym.crystal.process import CRYSTAL
from cz_gym.engine.batch import Batch, SlotState, new_key, processors
from cz_gym.engine.kernels import Out, check_info
from cz_gym.episodes.scenario import Distribution, Mixture
from cz_gym.rendering.canvas import Frame
from cz_gym.rendering.picture import FPS, View, declared_modes, make_view
from cz_gym.support.errors import CzError, check_keywords, unknown_name_message

from .config import Config, as_json, check_config, make_config, positive_whole
from .spaces import TaggedAction, action_space, check_action, check_actions, check_tagged, observation_space

Array = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]
APART = 128
"""Bits of an integer seed of a batch: slot i has the seed of the scalar form ``seed + ((i + 1) << APART)``."""


@dataclass(frozen=True)
class EnvState:
    """The saved state of an environment: its slot and its random stream. Picklable."""

    slot: SlotState
    random: dict[str, Any]

    def copy(self) -> Self:
        """A copy that shares nothing with this state."""
        return deepcopy(self)


def shows_settings(cls: Any) -> Any:
    """Give a class the signature of its constructor with what ``*settings`` and ``**settings`` stand for."""
    _, *own = signature(cls.__init__).parameters.values()
    positions = any(each.kind is each.VAR_POSITIONAL for each in own)
    own = [each for each in own if each.kind not in (each.VAR_POSITIONAL, each.VAR_KEYWORD)]
    left_out = {"process", *(each.name for each in own)} if not positions else {each.name for each in own}
    settings = [*signature(make_config if positions else cls.__base__).parameters.values()]
    settings = [each for each in settings if each.name not in left_out]
    settings = settings if positions else [each.replace(kind=each.KEYWORD_ONLY) for each in settings]
    cls.__signature__ = Signature(sorted([*own, *settings], key=lambda each: each.kind))
    return cls


class EnvBase:
    """Base of the scalar and the batched environment: construction from a config, and pickling."""

    FACTS: tuple[str, ...] = ("_over", "_begun", "_named", "spec", "action_space", "observation_space")
    """Attributes that are pickled besides settings and slots."""
    config: Config
    """The checked settings."""
    action_repeat: int
    """Control intervals that an action is held for."""
    _setup: Any
    _settings: tuple[Any, ...]
    _view: View | None = None
    _spec: Any = None

    @property
    def spec(self) -> Any:
        """Gymnasium's specification; its arguments are JSON, so that ``spec.to_json()`` makes the environment again."""
        return self._spec

    @spec.setter
    def spec(self, spec: Any) -> None:
        self._spec = spec and replace(spec, kwargs=as_json(spec.kwargs))

    @classmethod
    def from_config(cls, config: Config, *settings: Any, **named: Any) -> Self:
        """Make the environment from settings that :func:`cz_gym.config.make_config` has checked.

        The other arguments are ``render_mode``, ``render_size``, ``info`` and ``action_repeat`` for :class:`CzEnv`, and
        ``num_envs``, ``autoreset_mode``, ``threads``, ``info`` and ``action_repeat`` for :class:`cz_gym.CzVectorEnv`.
        """
        env = cls.__new__(cls)
        env._setup(check_config(config), *settings, **named)
        return env

    def _prepare(
        self, config: Config, num_envs: int, threads: int, info: str, action_repeat: int, recorded: bool = False
    ) -> None:
        """Make the slots; ``recorded``: all rows of ``info`` are written, whether or not they are returned."""
        self.config, self._made_for, self._everything = config, config.made_for, (everything := check_info(info))
        self.action_repeat = positive_whole("action_repeat", action_repeat)
        rows = config.process.info
        self._clipped, self._cost = rows.index("action_clipped"), rows.index("cost") if "cost" in rows else None
        self._batch = Batch(config, num_envs, threads, everything or recorded)
        self._out = self._batch.new_out()
        self._begun, self._named = False, isinstance(config.scenario, Mixture)

    def _checked(self, options: dict[str, Any] | None, *allowed: str) -> dict[str, Any]:
        """Return reset's options, the scenario on the puller; raise CzError for unknown or conflicting ones."""
        if options is not None and not isinstance(options, Mapping):
            raise CzError(f"reset options must be a dict, not {options!r}")
        given = dict(options or {})
        for key in given:
            if key not in allowed:
                raise CzError(unknown_name_message("reset option", key, allowed))
        if "scenario" in given and "state" in given:
            raise CzError("reset options 'scenario' and 'state' exclude each other: a state has its own episode")
        if "scenario" in given:
            given["scenario"] = self.config.with_scenario(given["scenario"]).scenario
        return given

    def _check_state(self, state: Any) -> None:
        """Raise CzError unless a slot of this environment can continue from the state."""
        if not isinstance(state, EnvState):
            raise CzError(f"expected a state made by get_state, not {type(state).__name__}")
        self._batch.check(state.slot)
        try:
            random: Any = np.random.PCG64(0)
            random.state = state.random
        except (ValueError, TypeError, KeyError, OverflowError):
            raise CzError("this state is damaged: its random stream is not one of PCG64") from None

    def __getstate__(self) -> dict[str, Any]:
        """The settings, the state of every slot, and the attributes named in ``FACTS``."""
        slots = [self._batch.save(i) for i in range(self._batch.num_envs)] if self._begun else None
        return {"settings": self._settings, "slots": slots, "facts": {name: getattr(self, name) for name in self.FACTS}}

    def __setstate__(self, saved: dict[str, Any]) -> None:
        self._setup(*saved["settings"])
        if saved["slots"] is not None:
            self._batch.restore(range(len(saved["slots"])), saved["slots"], self._out)
            self._restart_view()
        for name, fact in saved["facts"].items():
            setattr(self, name, fact)

    def _restart_view(self) -> None:
        """Restart the record of the picture, where there is one."""
        if self._view is not None:
            self._view.begin(self._out.info[:, 0], self._batch.memory.slots[0], self._batch.scenarios[0])


@shows_settings
class CzEnv(EnvBase, gym.Env[Array, Array]):
    """Czochralski growth of a silicon ingot: hold the true radius, seeing only the camera's bright ring.

    ## Action Space
    ``Box(-1, 1, (2,), float32)``. With ``action="smooth"``, the default, the drives follow it as first-order lags of
    50 s, pull speed towards v_0 (1 + a_0) and heater power towards Q_H0 + 5 kW a_1: noise on the action becomes
    bounded, slow noise of the drives, which is how a learner should explore. With ``action="direct"``, that of the
    classical controllers, it sets the drives: v_p = v_0 (1 + a_0), 0 to 2.4 mm/min, and Q_H = Q_H0 + 10 kW a_1. "rate"
    moves them as "smooth" does, without the return to nominal. Out-of-range actions are clipped and
    ``info["action_clipped"]`` says so; NaN or a wrong shape raises :class:`gymnasium.error.InvalidAction`.

    ## Observation Space
    ``Box(-10, 10, (n,), float32)``; every channel with unit and scale in :mod:`cz_gym.spaces`. "measured" (12) is
    what a puller's control computer has. "history" (73), the default, tells the same relative to reference and recipe,
    with the integral of the error and differences of past means: what a learner without memory of its own needs.
    "state" (18) is the true state and the disturbances, for bounds only. "camera" is the camera's image instead,
    ``Box(0, 255, (120, 160, 1), uint8)``; see :mod:`cz_gym.camera`.

    ## Rewards
    1 - c with c = 10 cost / (10 + cost), cost = (e_r / 0.5 mm)^2 + 0.5 (dv / 0.03)^2 + 0.05 (step of v_p /
    0.06 mm/min)^2 + 0.5 (step of Q_H / 1 kW)^2; e_r is the true radius error, less the ring's offset that no sensor
    shows, and dv the part of the relative deviation of the 30 min mean of v_p from v_0 beyond 3 %. The step at which
    the crystal is lost earns 1,000 less. ``info["cost"]`` is 1 in a step with |r_c - r_ref| > 0.5 mm or that mean
    beyond 3 %, else 0: the cost of constrained reinforcement learning.

    ## Starting State
    The drawn puller's own operating point, the radius off by N(0, 0.2 mm) on "randomized".

    ## Episode End
    Terminated when |r_c - r_ref| > 8 mm, or the meniscus freezes (h_c < 1.2 mm) or detaches (h_c > 1.24 a);
    truncated after ``horizon``.

    ## Arguments
    ``scenario`` (name, :class:`cz_gym.Scenario`, a dict of several with their shares of the episodes, or "all"; of
    several, ``info["scenario"]`` names the episode's own), ``model`` ("I", "II", a mix in [0, 1], or None for the
    scenario's draw), ``observation``, ``action`` ("direct", "smooth" or "rate"), ``control_interval`` [s],
    ``horizon`` [s], ``info`` ("lean": true radius, its reference and ``cost``; "all": every signal, see
    :class:`cz_gym.body.signals.Logged`; with observation "history" also the true ``state``, for critics),
    ``render_mode``, ``parameters`` (:class:`cz_gym.Parameters`), ``meniscus`` (:class:`cz_gym.MeniscusModel`),
    ``camera`` (:class:`cz_gym.camera.Camera`, with observation "camera" only), ``puller`` (a file, or the name of a
    shipped one; see docs/extend/puller.md: parameters and control interval are then its own), ``process`` (what is
    simulated, :class:`cz_gym.process.Process`), ``weights`` (those of the reward's terms that are not the usual ones,
    ``{"pull": 0.1}``; :class:`cz_gym.body.signals.Weights`). Bad values raise ValueError.
    ``action_repeat`` holds every action for so many control intervals, or until the episode ends: the reward and
    ``info["cost"]`` are the sums of theirs.
    ``render_mode`` is None, "rgb_array" or "human", ``render_size`` the picture's width and height [px]; rendering
    needs the extra ``render``, without which no mode is declared and asking for one raises
    :class:`gymnasium.error.DependencyNotInstalled`.
    """

    metadata: dict[str, Any] = {"render_modes": declared_modes(), "render_fps": FPS}  # noqa: RUF012  (Gymnasium's own)
    FACTS = (*EnvBase.FACTS, "_np_random", "_np_random_seed")

    def __init__(
        self,
        *settings: Any,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (640, 480),
        info: str = "lean",
        action_repeat: int = 1,
        **named: Any,
    ) -> None:
        check_keywords(named, make_config, CzEnv.__init__)
        self._setup(make_config(*settings, **named), render_mode, render_size, info, action_repeat)

    def _setup(
        self,
        config: Config,
        render_mode: str | None = None,
        render_size: Any = (640, 480),
        info: str = "lean",
        action_repeat: int = 1,
    ) -> None:
        self._settings = config, render_mode, render_size, info, action_repeat
        self._prepare(config, 1, 1, info, action_repeat, recorded=render_mode is not None)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_modes": declared_modes(config.process)}
        self.action_space = action_space()
        self.observation_space = observation_space(config.observation, config.process)
        self._over, self._slots, self._action = True, self._batch.memory.slots, np.zeros((1, 2))
        self._shown = self._batch.shown(self._out)[0]
        self._signals, self._valid = self._out.info[:, 0], self._slots["valid"]
        self._step = self._batch.bound_step(self._action, self._out)
        self._names = config.process.info
        self._lean = tuple((name, self._names.index(name)) for name in config.process.BriefInfo._fields)
        self._view = make_view(render_mode, render_size, self.config)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Draw an episode; see :class:`gymnasium.Env`.

        ``options={"scenario": ...}`` draws this one episode from another scenario or mixture;
        ``options={"state": ...}`` goes on from a value of :meth:`get_state`. Raises ValueError for other options.
        """
        given = self._checked(options, "scenario", "state")
        if "state" in given:
            self._check_state(given["state"])
        super().reset(seed=seed)
        if "state" in given:
            self.set_state(given["state"])
        else:
            self._batch.reset([0], [new_key(self.np_random)], self._out, given.get("scenario"))
            self._named |= isinstance(given.get("scenario"), Mixture)
            self._restart_view()
        self._over, self._begun = bool(self._slots["over"][0]), True
        return self._shown.copy(), self._info()

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold an action, shape (2,), for ``action_repeat`` control intervals; see :class:`gymnasium.Env`.

        Raises InvalidAction for NaN, another shape, and an action made for another environment (:mod:`cz_gym.spaces`);
        ResetNeeded once the episode is over.
        """
        if self._over:
            raise ResetNeeded("the episode is over (or never began): call reset()")
        if type(action) is TaggedAction:
            check_tagged(action, self._made_for)
        self._action[0] = check_action(action)
        out, reward, cost = self._out, 0.0, 0.0
        for _ in range(self.action_repeat):
            self._step()
            terminated, truncated = out.terminated.item(), out.truncated.item()
            self._over, reward = terminated or truncated, reward + out.reward.item()
            if self._view is not None:
                self._view.add(self._signals, self._valid.item(), terminated, truncated)
            if self._cost is not None:
                cost += self._signals[self._cost]
                self._signals[self._cost] = cost
            if self._over:
                break
        return self._shown.copy(), reward, terminated, truncated, self._info()

    def get_state(self) -> EnvState:
        """A picklable value from which :meth:`set_state` continues bit-exactly, random stream included.

        Raises ResetNeeded before the first reset.
        """
        if not self._begun:
            raise ResetNeeded("there is no crystal yet: call reset()")
        return EnvState(self._batch.save(0), dict(self.np_random.bit_generator.state))

    def set_state(self, state: EnvState) -> None:
        """Continue from a value of :meth:`get_state`; ValueError if it was saved under other settings."""
        self._check_state(state)
        self._batch.restore([0], [state.slot], self._out)
        self.np_random.bit_generator.state = state.random
        self._restart_view()
        self._over, self._begun = bool(self._slots["over"][0]), True

    def render(self) -> Frame | None:
        """The picture, uint8 of shape (height, width, 3), for "rgb_array"; "human" shows it at every reset and step.

        Raises ResetNeeded before the first reset.
        """
        if self._view is None:
            gym.logger.warn('nothing to render: make the environment with render_mode="rgb_array" or "human"')
            return None
        return self._view.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._view is not None:
            self._view.close()
        self._batch.close()

    def _info(self) -> dict[str, Any]:
        """A plain dictionary with the same keys at every step, as recorders and trees of arrays need it."""
        if self._everything:
            info = dict(zip(self._names, self._signals, strict=True))
        else:
            info = {name: self._signals[row] for name, row in self._lean}
        # Gymnasium's vectors gather a bool or an array of it, not numpy's bool; TorchRL reads what has a dtype.
        info["action_clipped"] = np.array(self._signals.item(self._clipped) > 0.0)
        if self._named:
            info["scenario"] = self._batch.scenarios[0]
        if self._everything and self.config.observation == "history":
            info["state"] = self._out.state[0].copy()
        return info


@shows_settings
class CzVectorEnv(EnvBase, VectorEnv[Array, Array, Array]):
    """Many pullers at once in one compiled loop; slot i with seed s[i] equals :class:`CzEnv` with it bit for bit.

    Arguments are those of :class:`CzEnv`, with ``num_envs``, ``autoreset_mode`` (a
    :class:`gymnasium.vector.AutoresetMode` or its value; each episode is re-drawn from the slot's own stream) and
    ``threads`` (None: one per processor it may use and 256 slots; results do not depend on it). Returned arrays
    are never written again.
    """

    metadata: dict[str, Any] = CzEnv.metadata | {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}
    FACTS = (*EnvBase.FACTS, "_randoms", "_seeds", "_waiting")

    def __init__(
        self,
        num_envs: int = 1,
        *settings: Any,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        info: str = "lean",
        render_mode: str | None = None,
        action_repeat: int = 1,
        **named: Any,
    ) -> None:
        check_keywords(named, make_config, CzVectorEnv.__init__)
        config = make_config(*settings, **named)
        if render_mode is not None:
            raise CzError(f"a batch does not render: render_mode must be None, not {render_mode!r}")
        self._setup(config, num_envs, autoreset_mode, threads, info, action_repeat)

    def _setup(
        self,
        config: Config,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        info: str = "lean",
        action_repeat: int = 1,
    ) -> None:
        self._settings = config, num_envs, autoreset_mode, threads, info, action_repeat
        self.num_envs = num_envs = positive_whole("num_envs", num_envs)
        threads = processors() if threads is None else positive_whole("threads", threads)
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.render_mode = None
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space = action_space()
        self.single_observation_space = observation_space(config.observation, config.process)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._prepare(config, num_envs, threads, info, action_repeat)
        rows = config.process.info
        self._names = rows if self._everything else config.process.BriefInfo._fields
        self._rows = tuple(map(rows.index, self._names))
        self._masks = tuple(f"_{name}" for name in self._names)
        self._everybody: Mask = np.ones(num_envs, np.bool_)
        self._over, self._waiting = self._everybody.copy(), True
        self._randoms: list[np.random.Generator | None] = [None] * num_envs
        self._seeds: list[int | None] = [None] * num_envs

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Any = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw episodes; slot i is seeded with seed[i], as the scalar form is.

        A single seed is the batch's own: its episodes are those of no seed below 2**128 of the scalar form, so that
        none of validation or test is among them (slot i has the scalar's seed ``seed + ((i + 1) << 128)``).

        ``options={"scenario": ...}`` draws these episodes from another scenario or mixture, ``{"state": states}`` goes
        on from a value of :meth:`get_state`, ``{"reset_mask": mask}`` resets only some slots. A list has the options of
        :meth:`CzEnv.reset`, one a slot. Raises ValueError or TypeError for anything else.
        """
        if isinstance(options, Sequence) and not isinstance(options, str):
            return self._reset_each(seed, options)
        given = self._checked(options, "scenario", "state", "reset_mask")
        mask = self._reset_mask(given.get("reset_mask"))
        if "state" in given:
            self._check_states(given["state"])
        self._seed(seed, mask)
        previous, self._out = self._out, self._batch.new_out()
        if not mask.all():
            kept = np.flatnonzero(~mask)
            for name, old, new in zip(previous._fields, previous, self._out, strict=True):
                index = (slice(None), kept) if name == "info" else kept
                new[index] = old[index]
        which = np.flatnonzero(mask).tolist()
        if "state" in given:
            self._restore(given["state"], which)
        else:
            self._draw(which, self._out, given.get("scenario"))
            self._named |= isinstance(given.get("scenario"), Mixture)
        self._begin()
        return self._observations(), self._infos(self._out, mask)

    def _reset_each(self, seed: Any, options: Sequence[Any]) -> tuple[Array, dict[str, Any]]:
        """Draw episodes with options for each slot."""
        if len(options) != self.num_envs:
            raise CzError(f"expected options for {self.num_envs} slots, got {len(options)}")
        given = [self._checked(own, "scenario", "state") for own in options]
        for own in given:
            if "state" in own:
                self._check_state(own["state"])
        self._seed(seed, self._everybody)
        self._out = self._batch.new_out()
        for i, own in enumerate(given):
            if "state" in own:
                self._batch.restore([i], [own["state"].slot], self._out)
                self._random(i).bit_generator.state = own["state"].random
            else:
                self._draw([i], self._out, own.get("scenario"))
                self._named |= isinstance(own.get("scenario"), Mixture)
        self._begin()
        return self._observations(), self._infos(self._out)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Hold actions, shape (num_envs, 2), for ``action_repeat`` control intervals in every slot.

        Raises InvalidAction for NaN, another shape, and an action made for another environment (:mod:`cz_gym.spaces`);
        ResetNeeded before the first reset and, with autoreset disabled, while any episode is over.
        """
        if type(actions) is TaggedAction:
            check_tagged(actions, self._made_for)
        actions = check_actions(actions, self._batch.actions)
        if not self._begun:
            raise ResetNeeded("call reset() first")
        waiting = self._waiting
        if self.autoreset_mode == AutoresetMode.DISABLED and waiting:
            raise ResetNeeded(f"{int(self._over.sum())} episodes are over: reset them with options['reset_mask']")
        out = self._out = self._batch.new_out()
        infos: dict[str, Any] = {}
        ended = self._hold(actions, out, ~self._over if waiting else None)
        if waiting:
            self._draw(np.flatnonzero(self._over).tolist(), out)
        over = out.terminated | out.truncated if ended else np.zeros(self.num_envs, np.bool_)
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended:
            infos = self._finals(out, over)
            reward, terminated, truncated = out.reward.copy(), out.terminated.copy(), out.truncated.copy()
            self._draw(np.flatnonzero(over).tolist(), out)
            out = self._out = out._replace(reward=reward, terminated=terminated, truncated=truncated)
            over, ended = np.zeros_like(over), False
        self._over, self._waiting = over, ended
        infos.update(self._infos(out))
        return self._observations(), out.reward, out.terminated.copy(), out.truncated.copy(), infos

    def _hold(self, actions: Array, out: Out, active: Mask | None) -> bool:
        """Advance the active slots (None: all) while their episodes last; tell whether one of these ended."""
        ended = self._batch.step(actions, out, active) > 0
        summed = [out.reward] if self._cost is None else [out.reward, out.info[self._cost, : self.num_envs]]
        for _ in range(self.action_repeat - 1):
            going = ~(out.terminated | out.truncated) & (self._everybody if active is None else active)
            before = [each.copy() for each in summed]
            ended |= self._batch.step(actions, out, going) > 0
            for each, earlier in zip(summed, before, strict=True):
                each[going] += earlier[going]
        return ended

    def get_state(self) -> tuple[EnvState, ...]:
        """Picklable values, one a slot; :meth:`set_state`, also of the scalar form, continues them bit-exactly.

        Raises ResetNeeded before the first reset.
        """
        if not self._begun:
            raise ResetNeeded("there are no crystals yet: call reset()")
        return tuple(
            EnvState(self._batch.save(i), dict(self._random(i).bit_generator.state)) for i in range(self.num_envs)
        )

    def set_state(self, states: Sequence[EnvState]) -> None:
        """Continue from a value of :meth:`get_state`; ValueError if it was saved under other settings."""
        self._check_states(states)
        self._out = self._batch.new_out()
        self._restore(states, list(range(self.num_envs)))
        self._begin()

    def _begin(self) -> None:
        """Note which slots hold a crystal that still grows."""
        self._over = self._batch.memory.slots["over"] > 0
        self._waiting, self._begun = bool(self._over.any()), True

    def close_extras(self, **kwargs: Any) -> None:
        """Stop the threads."""
        # Gymnasium 1.1 also closes an environment whose construction failed.
        if hasattr(self, "_batch"):
            self._batch.close()

    @property  # type: ignore[misc]
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The slots' random streams."""
        return tuple(self._random(i) for i in range(self.num_envs))

    @property
    def np_random_seed(self) -> tuple[int | None, ...]:  # type: ignore[override]
        """The seeds of the slots' random streams."""
        return tuple(self._seeds)

    def _random(self, i: int) -> np.random.Generator:
        random = self._randoms[i]
        if random is None:
            random, self._seeds[i] = seeding.np_random(None)
            self._randoms[i] = random
        return random

    def _seed(self, seed: int | Sequence[int | None] | None, mask: Mask) -> None:
        if seed is None:
            return
        if isinstance(seed, int | np.integer):
            seed = [int(seed) + (i + 1 << APART) for i in range(self.num_envs)]
        seeds = list(seed)
        if len(seeds) != self.num_envs:
            raise CzError(f"expected {self.num_envs} seeds, one a slot, got {len(seeds)}")
        for i in np.flatnonzero(mask).tolist():
            if (own := seeds[i]) is not None:
                self._randoms[i], self._seeds[i] = seeding.np_random(int(own) if isinstance(own, np.integer) else own)

    def _reset_mask(self, mask: Any) -> Mask:
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask'] must be a numpy array of bool, not {mask!r}")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise CzError(f"options['reset_mask'] must have shape ({self.num_envs},) and a True, got {mask!r}")
        if not self._begun and not mask.all():
            raise ResetNeeded("the first reset must be of every slot")
        return mask.copy()

    def _draw(self, which: list[int], out: Out, given: Distribution | None = None) -> None:
        self._batch.reset(which, (new_key(self._random(i)) for i in which), out, given)

    def _check_states(self, states: Any) -> None:
        if not isinstance(states, Sequence) or len(states) != self.num_envs:
            raise CzError(f"expected {self.num_envs} states made by get_state, one a slot")
        for state in states:
            self._check_state(state)

    def _restore(self, states: Sequence[EnvState], which: list[int]) -> None:
        self._batch.restore(which, [states[i].slot for i in which], self._out)
        for i in which:
            self._random(i).bit_generator.state = states[i].random

    def _observations(self) -> Array:
        array: Array = self._batch.shown(self._out)
        return array.copy() if self.autoreset_mode == AutoresetMode.DISABLED else array

    def _finals(self, out: Out, over: Mask) -> dict[str, Any]:
        final_obs = np.full(self.num_envs, None, dtype=object)
        observations = self._observations()
        for i in np.flatnonzero(over).tolist():
            final_obs[i] = observations[i].copy()
        info = self._infos(out._replace(info=out.info.copy(), state=out.state.copy()), over)
        return {"final_obs": final_obs, "_final_obs": over.copy(), "final_info": info, "_final_info": over.copy()}

    def _infos(self, out: Out, mask: Mask | None = None) -> dict[str, Any]:
        whole = mask is None or bool(mask.all())
        mask = self._everybody.copy() if mask is None else mask
        rows: Any = out.info[:, : self.num_envs]
        clipped = (rows[self._clipped] > 0.0) & mask
        shown = [rows[row] for row in self._rows]
        infos: dict[str, Any] = dict.fromkeys(self._masks, mask)
        infos.update(zip(self._names, shown if whole else np.where(mask, shown, 0.0), strict=True))
        infos["action_clipped"], infos["_action_clipped"] = clipped, mask
        if self._named:
            scenarios = self._batch.scenarios.copy()
            scenarios[~mask] = None
            infos["scenario"], infos["_scenario"] = scenarios, mask
        if self._everything and self.config.observation == "history":
            infos["state"] = out.state if whole else np.where(mask[:, None], out.state, np.float32(0))
            infos["_state"] = mask
        return infos


@shows_settings
class CzCrystalEnv(CzEnv):
    """A whole Czochralski crystal: crown, body and tail along a recipe, seeing only what camera and load cell show.

    ## Action Space
    That of ``Cz-v0``, about the recipe's pull speed and heater power at the length grown: an action of zero follows the
    recipe.

    ## Observation Space
    "measured" (19 channels, :class:`cz_gym.crystal.signals.Measured`): ring, temperature and drives against the
    recipe's values at the length grown and 5 and 25 mm later, cone angle, length, weight, and the crystal's edge where
    the camera shows no ring. "history" (95), the default, adds the past, "state" (21) is the true state.

    ## Rewards
    Those of ``Cz-v0``, with the radius of the recipe at this length as reference, and the mean pull speed against the
    recipe's, relative to v_0.

    ## Starting State
    A state on the recipe of the drawn puller where the stage begins, the radius off by N(0, 0.2 mm) on "randomized".

    ## Episode End
    Terminated with ``info["succeeded"] = 1`` when the stage's length is reached. Terminated and lost when
    |r_c - r_ref| > 8 mm (12 mm in crown and tail), r_c < 2 mm, h_c < 0.6 mm or > 1.24 a, or the melt is below T_m.
    Truncated after 1.3 times the recipe's time of the longest stage.

    ## Arguments
    ``stage``: "crown" (from 10 mm radius to 60 mm of body), "body" (3 h from a drawn length), "tail" (from 50 mm before
    it), "whole", a dict of these with their shares of the episodes, or the length [m] at which three hours begin. The
    others are those of :class:`cz_gym.CzEnv`; ``puller``'s table ``[recipe]`` is the crystal.
    """

    def __init__(self, stage: Any = "crown", **settings: Any) -> None:
        super().__init__(process=CRYSTAL, stage=stage, **settings)


@shows_settings
class CzCrystalVectorEnv(CzVectorEnv):
    """Many whole crystals at once; arguments of :class:`CzCrystalEnv` and :class:`cz_gym.CzVectorEnv`."""

    def __init__(self, num_envs: int = 1, stage: Any = "crown", **settings: Any) -> None:
        super().__init__(num_envs, process=CRYSTAL, stage=stage, **settings)
