"""The environment: ``gym.make("Cz-v0")``."""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import gymnasium as gym
import numpy as np
import numpy.typing as npt
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.spaces import Box

from cz_gym.body.process import BODY
from cz_gym.camera.view import IMAGE, Camera
from cz_gym.engine.batch import Batch, SlotState, new_key
from cz_gym.engine.layout import Out, check_info
from cz_gym.episodes.mixture import AnyScenario, Mixture
from cz_gym.episodes.scenarios import find_distribution
from cz_gym.errors import CzError
from cz_gym.machine.puller import PullerFile
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.physics.parameters import Parameters
from cz_gym.process import Process
from cz_gym.rendering.canvas import Frame
from cz_gym.rendering.view import FPS, declared_modes, make_view
from cz_gym.support.names import known_keywords, unknown

from .action import MarkedAction, check_marked
from .config import Config, check_config, make_config
from .observation import CAMERA, CLIP, observations

Observation = npt.NDArray[Any]
Action = npt.NDArray[np.float32]
_OPTIONS = ("scenario", "state")
_PLAIN = np.float64, np.bool_, float, bool, str


@dataclass(frozen=True)
class EnvState:
    """The saved state of an environment: its slot and its random stream. Picklable."""

    slot: SlotState
    random: dict[str, Any]


def action_space() -> Any:
    """Pull speed and heater power, each in [-1, 1]: v_p = v_0 (1 + a_0), Q_H = Q_H0 + 10 kW a_1."""
    return Box(-1.0, 1.0, (2,), np.float32)


def observation_space(observation: str, process: Process = BODY) -> Any:
    """The observation's channels, scaled and clipped to +-10, or the camera's grey values."""
    if observation == CAMERA:
        return Box(0, 255, IMAGE, np.uint8)
    return Box(-CLIP, CLIP, (len(observations(process)[observation]),), np.float32)


def check_options(options: dict[str, Any] | None, allowed: tuple[str, ...] = _OPTIONS) -> dict[str, Any]:
    """Return reset's options with the scenario as an object; raise CzError for unknown or conflicting ones."""
    if options is not None and not isinstance(options, Mapping):
        raise CzError(f"reset options must be a dict, not {options!r}")
    given = dict(options or {})
    for key in given:
        if key not in allowed:
            raise CzError(unknown("reset option", key, allowed))
    if "scenario" in given and "state" in given:
        raise CzError("reset options 'scenario' and 'state' exclude each other: a state has its own episode")
    if "scenario" in given:
        given["scenario"] = find_distribution(given["scenario"])
    return given


class Form:
    """Base of the scalar and the batched environment: construction from a config, and pickling."""

    FACTS: tuple[str, ...] = ("_over", "_begun", "_named", "spec", "action_space", "observation_space")
    """Attributes that are pickled besides settings and slots."""
    _setup: Any
    _settings: tuple[Any, ...]
    _batch: Batch
    _out: Out
    _begun: bool

    @classmethod
    def from_config(cls, config: Config, *settings: Any, **named: Any) -> Self:
        """Make the environment from settings that :func:`cz_gym.config.make_config` has checked.

        The other arguments are ``render_mode``, ``render_size`` and ``info`` for :class:`CzEnv`, and ``num_envs``,
        ``autoreset_mode``, ``threads`` and ``info`` for :class:`cz_gym.CzVectorEnv`.
        """
        env = cls.__new__(cls)
        env._setup(check_config(config), *settings, **named)
        return env

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
        """Restart the record of the picture; only the scalar form has one."""


class CzEnv(Form, gym.Env[Observation, Action]):
    """Czochralski growth of a silicon ingot: hold the true radius, seeing only the camera's bright ring.

    ## Action Space
    ``Box(-1, 1, (2,), float32)``. With ``action="smooth"``, the default, the drives follow it as first-order lags of
    50 s, pull speed towards v_0 (1 + a_0) and heater power towards Q_H0 + 5 kW a_1: noise on the action becomes
    bounded, slow noise of the drives, which is how a learner should explore. With ``action="direct"``, that of the
    classical controllers, it sets the drives: v_p = v_0 (1 + a_0), 0 to 2.4 mm/min, and Q_H = Q_H0 + 10 kW a_1. "rate"
    moves them as "smooth" does, without the return to nominal. Out-of-range actions are clipped and
    ``info["action_clipped"]`` says so; NaN or a wrong shape raises :class:`gymnasium.error.InvalidAction`.

    ## Observation Space
    ``Box(-10, 10, (n,), float32)``; every channel with unit and scale in :mod:`cz_gym.observation`. "measured" (12) is
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
    ``{"pull": 0.1}``; :class:`cz_gym.body.cost.Weights`). Bad values raise ValueError.
    ``render_mode`` is None, "rgb_array" or "human", ``render_size`` the picture's width and height [px]; rendering
    needs the extra ``render``, without which no mode is declared and asking for one raises
    :class:`gymnasium.error.DependencyNotInstalled`.
    """

    metadata: dict[str, Any] = {"render_modes": declared_modes(), "render_fps": FPS}  # noqa: RUF012  (Gymnasium's own)
    FACTS = (*Form.FACTS, "_np_random", "_np_random_seed")

    def __init__(
        self,
        scenario: AnyScenario = "randomized",
        model: str | float | None = None,
        observation: str = "history",
        control_interval: float | None = None,
        horizon: float | None = None,
        render_mode: str | None = None,
        parameters: Parameters | None = None,
        meniscus: MeniscusModel | None = None,
        render_size: tuple[int, int] = (640, 480),
        camera: Camera | None = None,
        action: str = "smooth",
        info: str = "lean",
        puller: str | Path | PullerFile | None = None,
        process: Process | None = None,
        weights: Mapping[str, float] | None = None,
        stage: Any = None,
        **others: Any,
    ) -> None:
        known_keywords(others, type(self).__init__, CzEnv.__init__)
        config = make_config(
            scenario,
            model,
            observation,
            control_interval,
            horizon,
            parameters,
            meniscus,
            camera,
            action,
            puller,
            process,
            weights,
            stage,
        )
        self._setup(config, render_mode, render_size, info)

    def _setup(
        self,
        config: Config,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (640, 480),
        info: str = "lean",
    ) -> None:
        self._everything, self._settings = check_info(info), (config, render_mode, render_size, info)
        self.config, self._made_for = config, config.made_for
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_modes": declared_modes(config.process)}
        self.action_space = action_space()
        self.observation_space = observation_space(config.observation, config.process)
        self._batch = Batch(self.config, 1, everything=self._everything or render_mode is not None)
        self._slots = self._batch.memory.slots
        self._out = self._batch.new_out()
        self._action = np.zeros((1, 2))
        self._shown = self._batch.shown(self._out)[0]
        self._signals, self._valid = self._out.info[:, 0], self._slots["valid"]
        self._step = self._batch.bound_step(self._action, self._out)
        self._over, self._begun, self._named = True, False, isinstance(config.scenario, Mixture)
        names = config.process.info
        self._names, self._clipped = names, names.index("action_clipped")
        self._lean = tuple((name, names.index(name)) for name in config.process.Lean._fields)
        self._view = make_view(render_mode, render_size, self.config)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Draw an episode; see :class:`gymnasium.Env`.

        ``options={"scenario": ...}`` draws this one episode from another scenario or mixture;
        ``options={"state": ...}`` goes on from a value of :meth:`get_state`. Raises ValueError for other options.
        """
        given = check_options(options)
        if "state" in given:
            check_state(given["state"], self._batch)
        super().reset(seed=seed)
        if "state" in given:
            self.set_state(given["state"])
        else:
            self._batch.reset([0], [new_key(self.np_random)], self._out, given.get("scenario"))
            self._named = self._named or isinstance(given.get("scenario"), Mixture)
            self._restart_view()
        self._over, self._begun = bool(self._slots["over"][0]), True
        return self._shown.copy(), self._info()

    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Hold an action, shape (2,), for one control interval; see :class:`gymnasium.Env`.

        Raises InvalidAction for NaN, another shape, and an action made for another environment (:mod:`cz_gym.action`);
        ResetNeeded once the episode is over.
        """
        if self._over:
            raise ResetNeeded("the episode is over (or never began): call reset()")
        if type(action) is MarkedAction:
            check_marked(action, self._made_for)
        self._action[0] = check_action(action)
        self._step()
        out = self._out
        terminated, truncated = out.terminated.item(), out.truncated.item()
        self._over = terminated or truncated
        if self._view is not None:
            self._view.add(self._signals, self._valid.item(), terminated, truncated)
        return self._shown.copy(), out.reward.item(), terminated, truncated, self._info()

    def get_state(self) -> EnvState:
        """A picklable value from which :meth:`set_state` continues bit-exactly, random stream included.

        Raises ResetNeeded before the first reset.
        """
        if not self._begun:
            raise ResetNeeded("there is no crystal yet: call reset()")
        return EnvState(self._batch.save(0), dict(self.np_random.bit_generator.state))

    def set_state(self, state: EnvState) -> None:
        """Continue from a value of :meth:`get_state`; ValueError if it was saved under other settings."""
        check_state(state, self._batch)
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

    def _restart_view(self) -> None:
        if self._view is not None:
            self._view.begin(self._signals, self._slots[0], self._batch.scenarios[0])

    def _info(self) -> dict[str, Any]:
        if self._everything:
            info = Info(zip(self._names, self._signals, strict=True))
            info["action_clipped"] = bool(info["action_clipped"] > 0.0)
        else:
            info = Info()
            for name, row in self._lean:
                info[name] = self._signals[row]
            if self._signals.item(self._clipped) > 0.0:
                info["action_clipped"] = True
        if self._named:
            info["scenario"] = self._batch.scenarios[0]
        if self._everything and self.config.observation == "history":
            info["state"] = self._out.state[0].copy()
        return info


class Info(dict[str, Any]):
    """A step's ``info`` with a fast deep copy: stable-baselines3 makes one at every step."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        for value in self.values():
            if type(value) not in _PLAIN:
                return type(self)(deepcopy(dict(self), memo))
        return type(self)(self)


def check_state(state: Any, batch: Batch) -> None:
    """Raise CzError unless a slot of this batch can continue from the state."""
    if not isinstance(state, EnvState):
        raise CzError(f"expected a state made by get_state, not {type(state).__name__}")
    batch.check(state.slot)
    try:
        random: Any = np.random.PCG64(0)
        random.state = state.random
    except (ValueError, TypeError, KeyError, OverflowError):
        raise CzError("this state is damaged: its random stream is not one of PCG64") from None


def check_action(action: Any) -> Any:
    """Return the action as float64, shape (2,); raise InvalidAction for anything else."""
    try:
        array = np.asarray(action, np.float64)
    except (TypeError, ValueError):
        raise InvalidAction(f"an action must be two numbers in [-1, 1], not {action!r}") from None
    if array.shape != (2,):
        raise InvalidAction(f"an action must have shape (2,), not {array.shape}")
    pull, heat = array.tolist()
    if pull != pull or heat != heat:
        raise InvalidAction(f"an action must not be NaN: {action!r}")
    return array
