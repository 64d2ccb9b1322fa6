"""A batch whose step has derivatives: gradients of a cost through a crystal, for learning, identification, shooting.

The plant is the environment's own; nothing is approximated (:mod:`cz_gym.engine.tangents`).
"""

from collections.abc import Sequence
from dataclasses import replace
from operator import index
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from gymnasium.error import InvalidAction, ResetNeeded

from cz_gym.action import MarkedAction, check_marked
from cz_gym.body.process import BODY
from cz_gym.config import Config, check_config, positive_whole
from cz_gym.engine.batch import Batch, first_key
from cz_gym.engine.buffers import BufferPool
from cz_gym.engine.layout import Out
from cz_gym.engine.tangents import ACTIONS, build_tangents, rows, smooth, work_shape
from cz_gym.episodes.scenario import GRID
from cz_gym.errors import CzError
from cz_gym.process import LOST

Floats = npt.NDArray[np.float64]


class Step(NamedTuple):
    """The result of a step, one row per slot, and its derivatives."""

    state: Floats
    """The differentiable state, of Cz-v0 :data:`STATES`, SI units, shape (n, 10)."""
    measured: npt.NDArray[np.float32]
    """The "measured" observation, shape (n, 12)."""
    cost: Floats
    """The four terms of the cost (:class:`cz_gym.body.cost.Cost`), shape (n, 4)."""
    error: Floats
    """The true radius error r_c - r_ref [m], shape (n,)."""
    offset: Floats
    """Offset of the bright ring that no sensor shows [m], shape (n,)."""
    grows: npt.NDArray[np.bool_]
    """Whether the crystal grew, shape (n,). One that is lost or whose episode is over stays as it is; its cost and its
    derivatives are 0."""
    jacobian: Floats
    """Derivatives of the next state and of the cost's terms, shape (n, 14, 12): rows are state and cost, columns the
    state before and the two actions."""


STATES = smooth(BODY)
"""The differentiable state of Cz-v0: radius, meniscus height [m], T_1, T_2, T_b [K], v_p [m/s], Q_H [W], the mean
of v_p [m/s], the bright ring [m] and the camera's reading of it [m]. All else that a step depends on (disturbances,
noise, time) depends on no action. That of another process is ``smooth(process)``."""


class DifferentiableBatch:
    """Many crystals that are stepped together, each step with its derivatives.

    ``config`` is the environment's (:func:`cz_gym.config.make_config`). Its control interval may be up to the
    5 s for which disturbances are held, and its camera's latency must not be longer than the control interval.

    Noise, freezes and drop-outs are those of the environment; a held reading depends on the state at which it was
    taken. The derivatives ignore that the heater moves in whole steps and that observations are rounded; where a
    scenario has a heater's lag or a pyrometer's filter, they are those of a machine without either.
    """

    def __init__(self, config: Config, num_envs: int, threads: int | None = 1) -> None:
        check_config(config)
        self.num_envs = positive_whole("num_envs", num_envs)
        if config.control_interval > GRID:
            raise CzError(f"control_interval must be at most {GRID:g} s, not {config.control_interval:g} s")
        latency = max(scenario.sensor.latency for scenario in config.scenario.scenarios)
        if latency > config.control_interval:
            raise CzError(
                f"the camera's latency of {latency:g} s is longer than the control interval; a puller file's latency_s "
                "stands in place of the scenario's"
            )
        if any(max(each.actuators.heater_dead_time) > 0.0 for each in config.scenario.scenarios):
            raise CzError("a heater with a dead time has no derivatives: heater_dead_time must be 0")
        self.config = config = replace(config, observation="measured")
        self._made_for = config.made_for
        self._batch = Batch(config, self.num_envs, threads)
        self._gather, self._shown, self._tangents = build_tangents(config.process, config.meniscus)
        self._out = self._batch.new_out()
        self._names, info = smooth(config.process), config.process.info
        self._state = np.zeros((num_envs, len(self._names)))
        self._costs = [info.index(f"term_{name}") for name in config.process.Cost._fields]
        self._errors = [info.index(name) for name in (*config.process.Lean._fields[:2], "ring_offset")]
        self.grows, self._begun = np.ones(num_envs, np.bool_), np.zeros(num_envs, np.bool_)
        """Whether each crystal grew in the last step, and whether each slot has one, shape (n,)."""
        self._work = np.zeros(work_shape(config.process))
        self._jacobians = BufferPool((self.num_envs, len(rows(config.process)), len(self._names) + ACTIONS), np.float64)
        shows = len(config.process.measured), len(self._names)
        self._moves = config.process.nominal_moves
        self._shows = BufferPool((self.num_envs if self._moves else 1, *shows), np.float64)
        self.measured_by_state: Floats = np.zeros(shows)
        """Derivatives of the last "measured" observation by the last state, shape (12, 10), the same for all slots and
        steps; (n, 17, 17) on CzCrystal-v0, where references run with the length. Zero before the first reset, and for a
        crystal that is lost."""

    def reset(self, seeds: Sequence[int], which: Sequence[int] | None = None) -> tuple[Floats, npt.NDArray[np.float32]]:
        """Draw the episodes of these seeds, one for each of the slots ``which``, by default all; the others stay.

        Returns state, shape (n, 10), and "measured" observation, shape (n, 12), of all slots. ValueError unless each
        seed is a whole number and each slot there is named once at most.
        """
        slots = list(range(self.num_envs) if which is None else which)
        if len(seeds) != len(slots):
            raise CzError(f"expected a seed for each of {len(slots)} slots, not {len(seeds)}")
        if len(set(slots)) != len(slots) or not set(slots) <= set(range(self.num_envs)):
            raise CzError(f"slots must be different ones of 0 to {self.num_envs - 1}, not {slots!r:.80}")
        try:
            keys = [first_key(index(seed)) for seed in seeds]
        except TypeError:
            raise CzError(f"seeds must be whole numbers, not {seeds!r:.80}") from None
        self._out = self._copied()
        self._batch.reset(slots, keys, self._out)
        self.grows = self.grows.copy()
        self.grows[slots] = self._begun[slots] = True
        self._look(first=True)
        return self._state, self._out.observation

    def step(self, actions: npt.ArrayLike) -> Step:
        """Hold actions, shape (n, 2), for one control interval; crystals that are lost or whose episode is over stay.

        InvalidAction for NaN, another shape, and actions made for another environment;
        ResetNeeded before every slot had its first reset.
        """
        if type(actions) is MarkedAction:
            check_marked(actions, self._made_for)
        if not self._begun.all():
            raise ResetNeeded("every slot needs a crystal: call reset()")
        before, n = self._state, self.num_envs
        given = np.asarray(actions, np.float64)
        if given.shape != (n, ACTIONS) or np.isnan(given).any():
            raise InvalidAction(f"actions must be numbers of shape {(n, ACTIONS)}, not {actions!r:.80}")
        batch, out = self._batch, self._copied()
        slots = batch.memory.slots
        held = np.stack([slots["Q_d"], slots["dT_i"]], axis=1)
        active = self.grows & (batch.memory.slots["k"] < batch.fixed.steps)
        batch.step(given, out, active)
        self.grows = active & ~out.terminated
        self._out = out
        self._look()
        jacobian = self._jacobians.new()
        step = (held, batch.actions, self.grows, batch.fixed, batch.drives)
        self._tangents(batch.memory, before, *step, self._work, jacobian, 0, n)
        info = out.info[:, :n]
        cost = np.where(self.grows, info[self._costs], 0.0).T
        value, reference, offset = info[self._errors]
        return Step(self._state, out.observation, cost, value - reference, offset, self.grows, jacobian)

    def _copied(self) -> Out:
        """A copy of the last step's results in new arrays."""
        out = self._batch.new_out()
        for new, old in zip(out, self._out, strict=True):
            new[...] = old
        return out

    def _look(self, first: bool = False) -> None:
        """Read the slots' states, and how observations depend on them."""
        self._state = self._now()
        if self._moves or first:
            shown, batch = self._shows.new(), self._batch
            self._shown(batch.memory, batch.scales.measured, batch.fixed.interval, shown, 0, len(shown))
            shown[~self.grows[: len(shown)]] = 0.0  # those of a lost crystal may be infinite
            self.measured_by_state = shown if self._moves else shown[0]

    def _now(self) -> Floats:
        state = np.empty((self.num_envs, len(self._names)))
        self._gather(self._batch.memory, state, 0, self.num_envs)
        return state

    @property
    def lost(self) -> npt.NDArray[np.bool_]:
        """Whether each crystal is lost, shape (n,): one that has reached its length does not grow on either."""
        lost: npt.NDArray[np.bool_] = ~self.grows & (self._batch.memory.slots["over"] == LOST)
        return lost

    @property
    def scenarios(self) -> npt.NDArray[Any]:
        """Name of each crystal's scenario, shape (n,)."""
        return self._batch.scenarios.copy()

    def close(self) -> None:
        """Stop the threads."""
        self._batch.close()
