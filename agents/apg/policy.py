"""A recurrent policy on "measured": leaky means of the readings, a gated recurrent unit and a small network."""

from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from gymnasium.spaces import Space
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.process import Process

TIMES = tuple(float(time) for time in np.geomspace(3.0, 3600.0, 8))
"""Time constants of the leaky means [s]."""
GAINS = (0.2, 0.08)
"""Actions for a network output of one: pull speed and heater [-]."""
FEATURE_LIMIT = 30.0
"""Standardised features are clipped to +- this [-]."""
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

    def initial_memory(self, n: int) -> torch.Tensor:
        """The memory of n crystals that begin, shape (n, means + units)."""
        return torch.zeros(n, self.means + self.gru.hidden_size)

    def remember(self, measured: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Features, shape (n, features), and leaky means after a reading, shape (n, channels)."""
        means = memory[:, : self.means] * self.keep + measured @ self.gain
        return torch.cat([measured, means], dim=1) @ self.differences, means

    def forward(self, measured: torch.Tensor, memory: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The action, shape (n, 2), unclipped, and the memory after a reading, shape (n, channels)."""
        features, means = self.remember(measured, memory)
        x = torch.clamp((features - self.mean) / self.std.clamp(*STD_RANGE), -FEATURE_LIMIT, FEATURE_LIMIT)
        h = self.gru(x, memory[:, self.means :])
        y = torch.cat([x, h], dim=1)
        action = (self.linear(y) + self.output(torch.tanh(self.layer(y)))) * self.gains
        return action, torch.cat([means, h], dim=1)

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
    features += [now[name] for name in ("alpha_ref", "L", "v_p_ref", "Q_H_ref") if along]
    return np.tile(1.0 - share, len(averaged)), gain, np.stack(features, axis=1)
