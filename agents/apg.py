"""Analytic policy gradients (APG): a differentiable plant step, its cost, a recurrent policy, and the algorithm."""

import math
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Space
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, Schedule
from torch import nn

from cz_gym.body.signals import Cost, coefficients, cost_terms, saturated
from cz_gym.config import Config
from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.engine.tangents import DifferentiableBatch, Step, smooth
from cz_gym.evaluation.protocol import TRAINING_SEEDS
from cz_gym.process import Process
from cz_gym.spaces import drives_of
from cz_gym.support.errors import CzError

from .window import Window


def advance(state: torch.Tensor, action: torch.Tensor, batch: DifferentiableBatch) -> Any:
    """State and "measured", as of Cz-v0 of shapes (n, 10) and (n, 12), after an action (n, 2), whether each crystal
    grew, and its target.

    ``state`` is the batch's present one; gradients go back through it to the step before. The target (n,) is the radius
    at which sensors would show no error [m]: the reference less the bright ring's offset, which no sensor shows; it
    depends on the state where the reference runs with the length.
    """
    return _PlantStep.apply(state, action, batch)  # type: ignore[no-untyped-call]


class _PlantStep(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, state: torch.Tensor, action: torch.Tensor, batch: DifferentiableBatch) -> Any:
        step, process = batch.step(action.numpy()), batch.config.process
        ctx.jacobian, ctx.measured_by_state = step.jacobian[:, : step.state.shape[1]], batch.measured_by_state
        ctx.reference = process.Measured._fields.index("r_ref")
        ctx.scale = process.measured[ctx.reference].scale
        radius = step.state[:, smooth(process).index("r_c")]
        grows, target = torch.from_numpy(step.grows), torch.from_numpy(radius - step.error - step.offset)
        ctx.mark_non_differentiable(grows)
        return torch.from_numpy(step.state), torch.from_numpy(step.measured), grows, target

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> Any:
        by_state, by_measured, _, by_target = gradients
        by_shown = by_measured.double()
        by_shown[:, ctx.reference] += ctx.scale * by_target
        rows = by_state + (by_shown[:, None] @ torch.from_numpy(ctx.measured_by_state))[:, 0]
        back, states = torch.einsum("ni,nij->nj", rows, torch.from_numpy(ctx.jacobian)), rows.shape[1]
        return back[:, :states], back[:, states:].float(), None


class StepCost:
    """The cost of a step that APG follows: the reward's, but for moves that a drive cuts off or rounds.

    The pull step is the one that the action asks for, against the recipe's: the one that is taken no longer depends on
    the action there, and a policy that asks for more than the drive does would never learn to ask for less. A heater
    that moves in whole steps costs their mean square over all places that a move may begin at: :func:`mean_square`.
    """

    def __init__(self, batch: DifferentiableBatch) -> None:
        config = batch.config
        self.weights, names = config.weights, smooth(config.process)
        self.heaters = batch._batch.memory.slots["episode"]  # rows that the batch keeps up to date
        self.drives, self.v_0 = drives_of(config.action, config.control_interval), config.parameters.v_0
        self.r_c, self.v_p, self.Q_H, self.mean = (names.index(each) for each in ("r_c", "v_p", "Q_H", "v_p_mean"))
        self.nominal = names.index("v_p_nominal") if config.process.nominal_moves else None

    def __call__(
        self, before: torch.Tensor, action: torch.Tensor, after: torch.Tensor, grows: torch.Tensor, target: torch.Tensor
    ) -> torch.Tensor:
        """The saturated sum of the four terms, shape (n,), from the states before and after; 0 if it does not grow.

        Rows are those of the batch, or of several steps of it, one after the other.
        """
        # Where the nominal speed moves, the mean is of deviations from it.
        nominal, rest = (self.v_0, 1.0) if self.nominal is None else (before[:, self.nominal], 0.0)
        asked = (self.drives.keep - 1.0) * (before[:, self.v_p] - nominal) + self.drives.pull * self.v_0 * action[:, 0]
        error, heater_step = after[:, self.r_c] - target, after[:, self.Q_H] - before[:, self.Q_H]
        terms = cost_terms(Cost(error, after[:, self.mean] / self.v_0 - rest, asked, heater_step), self.weights)
        whole = torch.from_numpy(self.heaters["heater_step"]).repeat(len(before) // len(self.heaters))
        squared = mean_square(heater_step, whole)
        terms = terms._replace(heater_step=coefficients(self.weights).heater_step * squared)
        return torch.where(grows, saturated(sum(terms)), 0.0)


def mean_square(move: torch.Tensor, whole: torch.Tensor) -> torch.Tensor:
    """Mean square of a move that is rounded to multiples of ``whole``, over all places that it may begin at.

    Shapes (n,); the square of the move itself where ``whole`` is 0. Small moves cost their size, not its square.
    """
    steps = move.abs() / torch.where(whole > 0.0, whole, 1.0)
    least = steps.detach().floor()
    rounded = whole**2 * (least**2 + (steps - least) * (2.0 * least + 1.0))
    return torch.where(whole > 0.0, rounded, move**2)


# A recurrent policy on "measured": leaky means of the readings, a gated recurrent unit and a small network.

TIMES = tuple(float(time) for time in np.geomspace(3.0, 3600.0, 8))
"""Time constants of the leaky means [s]."""
GAINS = (0.2, 0.08)
"""Actions for a network output of one: pull speed and heater [-]."""
STD_RANGE = 1e-4, 10.0
"""Range that a feature's standard deviation is clipped to before it divides [-]."""
STATISTICS_RATE = 0.1
"""Smoothing factor of the features' running mean and variance."""


class RecurrentPolicy(BasePolicy):
    """Readings -> leaky means -> differences, standardised -> GRU -> linear map plus tanh layer -> action.

    Its memory, shape (n, ``means + units``), holds the means and the hidden state of the GRU; ``predict`` takes
    and returns it as ``state``. A fresh policy leaves the drives where they are, whatever it sees. ``interval`` is the
    time between actions [s], ``environment`` the name of the one that it acts in.
    """

    feature_limit: ClassVar[float] = 30.0
    """Standardised features are clipped to +- this [-]."""
    keep: torch.Tensor
    gain: torch.Tensor
    differences: torch.Tensor
    gains: torch.Tensor
    mean: torch.Tensor
    std: torch.Tensor

    def __init__(
        self, observation_space: Space[Any], action_space: Space[Any], lr_schedule: Schedule, interval: float = 5.0,
        units: int = 64, hidden: int = 64, betas: tuple[float, float] = (0.9, 0.9), environment: str = "Cz-v0",
    ) -> None:  # fmt: skip
        super().__init__(observation_space, action_space)
        self.options = {
            "interval": interval, "units": units, "hidden": hidden, "betas": betas, "environment": environment,
        }  # fmt: skip
        keep, gain, differences = leaky_means(interval, ENVIRONMENTS[environment])
        self.means, width = len(keep), differences.shape[1]
        fixed = {"keep": keep, "gain": gain, "differences": differences, "gains": np.array(GAINS)}
        for name, value in fixed.items():
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("std", torch.ones(width))
        self.gru = nn.GRUCell(width, units)
        self.layer = nn.Linear(width + units, hidden)
        self.linear = nn.Linear(width + units, len(GAINS))
        self.output = nn.Linear(hidden, len(GAINS), bias=False)
        for parameter in (*self.linear.parameters(), *self.output.parameters()):
            nn.init.zeros_(parameter)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr_schedule(1.0), betas=betas)

    @property
    def usable_std(self) -> torch.Tensor:
        """Standard deviation that features are divided by, shape (features,)."""
        return self.std.clamp(*STD_RANGE)

    def initial_memory(self, n: int) -> torch.Tensor:
        """Memory of n crystals that begin, shape (n, means + units)."""
        return torch.zeros(n, self.means + self.gru.hidden_size)

    def update_means(self, measured: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return features, shape (n, features), and leaky means after a reading, shape (n, channels)."""
        means = memory[:, : self.means] * self.keep + measured @ self.gain
        return torch.cat([measured, means], dim=1) @ self.differences, means

    def forward(self, measured: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the action, shape (n, 2), unclipped, and the memory after a reading, shape (n, channels)."""
        features, means = self.update_means(measured, memory)
        limit = self.feature_limit
        x = torch.clamp((features - self.mean) / self.usable_std, -limit, limit)
        h = self.gru(x, memory[:, self.means :])
        y = torch.cat([x, h], dim=1)
        action = (self.linear(y) + self.output(torch.tanh(self.layer(y)))) * self.gains
        return action, torch.cat([means, h], dim=1)

    def take_weights(self, content: bytes) -> None:
        """Take the weights of an agent file, ONNX ``content``, that such a policy was written to; CzError if it was
        not, or has other widths."""
        import onnx  # comes with the extra "agents"

        graph = onnx.load_from_string(content).graph
        tensors = {each.name: torch.tensor(onnx.numpy_helper.to_array(each)) for each in graph.initializer}
        products = {node.output[0]: node.input[1] for node in graph.node if node.op_type == "MatMul"}
        names = {name: f"policy.{name}" for name in self.state_dict()}
        if (product := products.get("/policy/output/MatMul_output_0")) is not None:  # written as its transpose
            names["output.weight"], tensors[product] = product, tensors[product].T
        try:
            self.load_state_dict({name: tensors[own] for name, own in names.items()})
        except KeyError:
            raise CzError("not the network of an agent that APG trained") from None
        except RuntimeError:
            units = tensors["policy.gru.weight_hh"].shape[1]
            raise CzError(f"has a memory of {units} units, not {self.gru.hidden_size}: --set units={units}") from None

    def observe_statistics(self, features: torch.Tensor) -> None:
        """Move mean and standard deviation of the features towards those of a sample, shape (samples, features)."""
        rate = STATISTICS_RATE if bool(self.mean.any()) else 1.0
        self.mean += rate * (features.mean(dim=0) - self.mean)
        self.std.copy_(torch.sqrt(self.std**2 + rate * (features.var(dim=0) - self.std**2)))

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[npt.NDArray[Any], Any]:
        """The action within its box and the memory, as :meth:`stable_baselines3.PPO.predict`."""
        self.set_training_mode(False)
        measured, batched = self.obs_to_tensor(observation)
        assert isinstance(measured, torch.Tensor)
        memory = self.initial_memory(len(measured)) if state is None else torch.as_tensor(state)
        if episode_start is not None:
            begins = torch.as_tensor(np.atleast_1d(np.asarray(episode_start, np.float32)))
            memory = memory * (1.0 - begins[:, None])
        with torch.no_grad():
            action, memory = self(measured, memory)
        clipped = action.clamp(-1.0, 1.0).numpy()
        return (clipped if batched else clipped[0]), memory.numpy()

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> torch.Tensor:
        raise NotImplementedError("a policy with a memory acts through predict")

    def _get_constructor_parameters(self) -> dict[str, Any]:
        """Arguments with which :meth:`load` makes the policy again."""
        return {**super()._get_constructor_parameters(), **self.options, "lr_schedule": self._dummy_schedule}


def leaky_means(interval: float, process: Process) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]]:
    """The share of the means kept per step, what a reading adds, and the features as differences of both.

    ``interval`` is the time between readings [s]; shapes (means,), (channels, means), (channels + means, features).
    The past enters as differences of successive means, since raw means differ by micrometres under millimetres. Along a
    crystal the temperature is averaged relative to the recipe, which moves, and the weight is averaged too.
    """
    share = 1.0 - np.exp(-interval / np.array(TIMES))
    names, along = process.Measured._fields, process.nominal_moves
    averaged = [each.name for each in process.past] + (["weight"] if along else [])
    gain = np.zeros((len(names), len(averaged) * len(TIMES)))
    rows = np.eye(len(names) + gain.shape[1])
    now = dict(zip(names, rows, strict=False))
    features = []
    for signal, name in enumerate(averaged):
        own = slice(signal * len(TIMES), (signal + 1) * len(TIMES))
        moves = now["T_1_ref"] if along and name == "T_1" else 0.0
        mean_of = now[name] - moves
        gain[:, own] = np.outer(mean_of[: len(names)], share)
        chain = [mean_of, *rows[len(names) :][own]]
        features += [later - earlier for later, earlier in pairwise(chain)] + chain[-1:]
    features += [now["v_p_mean"], now["valid"], now["r_ref"], now["T_1_ref"] - now["T_1"]]
    features += [now[each.name] - now[each.to] for each in process.relative if each.name != "T_1"]
    features += [now[name] for name in ("alpha_ref", "L", "v_p_ref", "Q_H_ref", "edge_valid") if along]
    return np.tile(1.0 - share, len(averaged)), gain, np.stack(features, axis=1)


# Analytic policy gradients (APG) with the interface of stable-baselines3's algorithms.
#
# The plant's step is differentiated exactly, so that the gradient of the cost by the policy's weights is
# back-propagation through time over windows of an episode (:class:`cz_gym.agents.window.Window`; :func:`advance` gives
# the same to torch's autograd), in place of a gradient that is estimated from rewards. The method knows the plant's
# equations while it trains; the policy reads sensors alone.

WARM_UP = 0.05
"""Share of a training from random weights during which the features' statistics are updated."""
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
    During the first share ``warm_up`` of the training the mean and standard deviation of the features are updated.
    The cost is :class:`StepCost`; a constant ``learning_rate`` falls linearly to 0.
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
        warm_up: float = WARM_UP,
        device: torch.device | str = "cpu",
        _init_setup_model: bool = True,
        **options: Any,
    ) -> None:
        if isinstance(learning_rate, float):
            initial = learning_rate

            def learning_rate(left: float) -> float:
                return initial * left

        super().__init__(policy, env, learning_rate, device=device, support_multi_env=True, **options)
        self.window, self.warm_up = window, warm_up
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
        """Settings of the environment that is learned on."""
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
        window = Window(self.policy, StepCost(crystals.batch), crystals.batch, self.window)
        memory = self.policy.initial_memory(self.n_envs)
        watch.on_training_start(locals(), globals())
        going, updates = True, 0
        while going and self.num_timesteps < total_timesteps:
            self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
            self._update_learning_rate(self.policy.optimizer)
            watch.on_rollout_start()
            going = self._grow(crystals, memory, window, watch)
            watch.on_rollout_end()
            cost, memory = window.backward(), window.memory
            self._descend()
            lost, over = crystals.replace_finished()
            memory[over] = 0.0
            updates += 1
            self.logger.record("train/cost", cost)
            self.logger.record_mean("rollout/lost", lost)
            if updates % log_interval == 0:
                self.logger.dump(self.num_timesteps)
        crystals.batch.close()
        watch.on_training_end()
        return self

    def _grow(self, crystals: "_Crystals", memory: torch.Tensor, window: Window, watch: BaseCallback) -> bool:
        """Drive every crystal through a window: whether to go on."""
        policy, going, seen = self.policy, True, []
        warm = self._current_progress_remaining > 1.0 - self.warm_up
        window.begin(torch.from_numpy(crystals.state), memory)
        for _ in range(self.window):
            action = window.act(torch.from_numpy(crystals.measured))
            if warm:
                seen.append(window.features)
            window.record(crystals.step(action.numpy()))
            self.num_timesteps += self.n_envs
            going = watch.on_step() and going
        if warm:
            policy.observe_statistics(torch.cat(seen))
        return going

    def _descend(self) -> None:
        """Take a step along the gradient, unless it is not finite."""
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
        """Return the action and the policy's memory, to be passed on as ``state``."""
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
        self.state, self.measured = self.batch.reset(seeds, slots)

    def step(self, action: npt.NDArray[np.float32]) -> Step:
        """Hold actions, shape (n, 2), for one control interval."""
        step = self.batch.step(action)
        self.state, self.measured = step.state, step.measured
        return step

    def replace_finished(self) -> tuple[int, list[int]]:
        """Draw new crystals for those that were lost or have grown to their end: how many were lost, and all slots."""
        lost = int(self.batch.lost.sum())
        self._left -= 1
        over = np.flatnonzero(~self.batch.grows | (self._left == 0)).tolist()
        if over:
            self._draw(over)
            self._left[over] = self._windows
        return lost, over
