"""The native batch of environments: ``gym.make_vec("Cz-v0", vectorization_mode="vector_entry_point")``."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.error import InvalidAction, ResetNeeded
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from cz_gym.engine.batch import Batch, new_key
from cz_gym.engine.layout import Out, check_info
from cz_gym.episodes.mixture import AnyScenario, Mixture
from cz_gym.errors import CzError
from cz_gym.support.names import known_keywords
from cz_gym.support.processors import processors

from .action import MarkedAction, check_marked
from .config import Config, make_config, positive_whole
from .env import CzEnv, EnvState, Form, action_space, check_options, check_state, observation_space

Array = npt.NDArray[Any]
Mask = npt.NDArray[np.bool_]


class CzVectorEnv(Form, VectorEnv[Array, Array, Array]):
    """Many pullers at once in one compiled loop; slot i with seed s equals :class:`CzEnv` with seed s bit for bit.

    Arguments are those of :class:`CzEnv`, with ``num_envs``, ``autoreset_mode`` (a
    :class:`gymnasium.vector.AutoresetMode` or its value; each episode is re-drawn from the slot's own stream) and
    ``threads`` (None: one per processor it may use and 256 slots; results do not depend on it). Returned arrays
    are never written again.
    """

    metadata: dict[str, Any] = CzEnv.metadata | {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}
    FACTS = (*Form.FACTS, "_randoms", "_seeds", "_waiting")

    def __init__(
        self,
        num_envs: int = 1,
        scenario: AnyScenario = "randomized",
        *,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        info: str = "lean",
        render_mode: str | None = None,
        **settings: Any,
    ) -> None:
        known_keywords(settings, make_config, CzVectorEnv.__init__)
        config = make_config(scenario, **settings)
        if render_mode is not None:
            raise CzError(f"a batch does not render: render_mode must be None, not {render_mode!r}")
        self._setup(config, num_envs, autoreset_mode, threads, info)

    def _setup(
        self,
        config: Config,
        num_envs: int = 1,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        info: str = "lean",
    ) -> None:
        self._everything, self._settings = check_info(info), (config, num_envs, autoreset_mode, threads, info)
        num_envs = positive_whole("num_envs", num_envs)
        threads = processors() if threads is None else positive_whole("threads", threads)
        self.config, self._made_for = config, config.made_for
        self.render_mode = None
        self.num_envs = num_envs
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_action_space = action_space()
        self.single_observation_space = observation_space(config.observation, config.process)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        rows, lean = config.process.info, config.process.Lean._fields
        self._clipped, self._names = rows.index("action_clipped"), rows if self._everything else lean
        self._rows = tuple(map(rows.index, self._names))
        self._masks = tuple(f"_{name}" for name in self._names)
        self._batch = Batch(self.config, num_envs, threads, self._everything)
        self._out = self._batch.new_out()
        self._everybody: Mask = np.ones(num_envs, np.bool_)
        self._over = self._everybody.copy()
        self._waiting = True
        self._begun, self._named = False, isinstance(config.scenario, Mixture)
        self._randoms: list[np.random.Generator | None] = [None] * num_envs
        self._seeds: list[int | None] = [None] * num_envs

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Draw episodes; slot i is seeded with seed + i, or with seed[i].

        ``options={"scenario": ...}`` draws these episodes from another scenario or mixture, ``{"state": states}`` goes
        on from a value of :meth:`get_state`, ``{"reset_mask": mask}`` resets only some slots. Raises ValueError or
        TypeError for anything else.
        """
        given = check_options(options, ("scenario", "state", "reset_mask"))
        mask = self._reset_mask(given.get("reset_mask"))
        if "state" in given:
            self._check_states(given["state"])
        self._seed(seed, mask)
        previous, self._out = self._out, self._batch.new_out()
        if not mask.all():
            self._keep(previous, ~mask)
        which = np.flatnonzero(mask).tolist()
        if "state" in given:
            self._restore(given["state"], which)
        else:
            self._batch.reset(which, (new_key(self._random(i)) for i in which), self._out, given.get("scenario"))
            self._named = self._named or isinstance(given.get("scenario"), Mixture)
        self._begin()
        return self._observations(), self._infos(self._out, mask)

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """Hold actions, shape (num_envs, 2), for one control interval in every slot.

        Raises InvalidAction for NaN, another shape, and an action made for another environment (:mod:`cz_gym.action`);
        ResetNeeded before the first reset and, with autoreset disabled, while any episode is over.
        """
        if type(actions) is MarkedAction:
            check_marked(actions, self._made_for)
        actions = self._check_actions(actions)
        if not self._begun:
            raise ResetNeeded("call reset() first")
        waiting = self._waiting
        if self.autoreset_mode == AutoresetMode.DISABLED and waiting:
            raise ResetNeeded(f"{int(self._over.sum())} episodes are over: reset them with options['reset_mask']")
        out = self._out = self._batch.new_out()
        infos: dict[str, Any] = {}
        if waiting:
            ended = self._batch.step(actions, out, ~self._over) > 0
            self._redraw(np.flatnonzero(self._over).tolist(), out)
        else:
            ended = self._batch.step(actions, out) > 0
        over = out.terminated | out.truncated if ended else np.zeros(self.num_envs, np.bool_)
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended:
            infos = self._finals(out, over)
            reward, terminated, truncated = out.reward.copy(), out.terminated.copy(), out.truncated.copy()
            self._redraw(np.flatnonzero(over).tolist(), out)
            out = self._out = out._replace(reward=reward, terminated=terminated, truncated=truncated)
            over, ended = np.zeros_like(over), False
        self._over, self._waiting = over, ended
        infos.update(self._infos(out))
        return self._observations(), out.reward, out.terminated.copy(), out.truncated.copy(), infos

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
            seed = [int(seed) + i for i in range(self.num_envs)]
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

    def _check_actions(self, actions: Any) -> npt.NDArray[np.float64]:
        """Copy the actions into the batch's float64 array and return it; raise InvalidAction for anything else."""
        array = self._batch.actions
        try:
            shape = np.shape(actions)
            if shape == array.shape:
                array[:] = actions
        except (TypeError, ValueError):
            raise InvalidAction(f"actions must be numbers of shape {array.shape}, not {actions!r}") from None
        if shape != array.shape:
            raise InvalidAction(f"actions must have shape {array.shape}, not {shape}")
        if math.isnan(array.min()):
            slots = np.flatnonzero(np.isnan(array).any(axis=1))[:10].tolist()
            raise InvalidAction(f"actions must not be NaN; those of slots {slots} are")
        return array

    def _redraw(self, which: list[int], out: Out) -> None:
        self._batch.reset(which, (new_key(self._random(i)) for i in which), out)

    def _check_states(self, states: Any) -> None:
        if not isinstance(states, Sequence) or len(states) != self.num_envs:
            raise CzError(f"expected {self.num_envs} states made by get_state, one a slot")
        for state in states:
            check_state(state, self._batch)

    def _restore(self, states: Sequence[EnvState], which: list[int]) -> None:
        self._batch.restore(which, [states[i].slot for i in which], self._out)
        for i in which:
            self._random(i).bit_generator.state = states[i].random

    def _keep(self, previous: Out, kept: Mask) -> None:
        which = np.flatnonzero(kept)
        for name, old, new in zip(previous._fields, previous, self._out, strict=True):
            index = (slice(None), which) if name == "info" else which
            new[index] = old[index]

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
        if self._everything or clipped.any():
            infos["action_clipped"], infos["_action_clipped"] = clipped, mask if self._everything else clipped.copy()
        if self._named:
            scenarios = self._batch.scenarios.copy()
            scenarios[~mask] = None
            infos["scenario"], infos["_scenario"] = scenarios, mask
        if self._everything and self.config.observation == "history":
            infos["state"] = out.state if whole else np.where(mask[:, None], out.state, np.float32(0))
            infos["_state"] = mask
        return infos
