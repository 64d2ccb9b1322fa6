"""A policy with a memory of its own: leaky means of what is measured, over seconds to an hour, and a small network.

It reads "measured" alone. What it remembers travels in ``state``, so that it is the same in training, in an agent file
and in the benchmark.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import nn

from cz_gym.agents import MODELS
from cz_gym.agents.agent_file.contract import AgentFileError, read_agent
from cz_gym.agents.agent_file.graph import checked
from cz_gym.config import Config
from cz_gym.errors import CzError
from cz_gym.observation import MEASURED

from .export import OnnxGraph
from .networks import NORMALISED_LIMIT, tanh_layers
from .notch import STATE as NOTCH
from .notch import cleaned
from .symbolic import Value, apply, clamp, columns, concat, relu, split

TIMES = tuple(float(time) for time in np.geomspace(3.0, 3600.0, 8))
"""Time constants of the leaky means [s]."""
SIGNALS = ("ring_error", "v_p", "T_1", "Q_H")
"""Channels that are averaged."""
BEGUN = (60.0, 300.0)
"""Time constants of the leaky means of "valid" [s]: how long ago the crystal began, and whether readings failed."""
NOISY = ("ring_error", "T_1")
"""Channels whose white noise is estimated from their second differences: camera and pyrometer."""
NOISE_TIME = 600.0
"""Time constant of the estimates [s]."""
USUAL = 0.01
"""Initial standard deviation of the estimates; its variance maps to a strength of one half [scaled units]."""
LARGE = 0.1
"""The same of a second scale of the camera's noise: ripples and outliers [scaled units]."""
OUTLIER = 9.0
"""Limit of a squared second difference, in multiples of its running mean [-]."""
SWINGS = ((2, 3), (5, 6))
"""Pairs of means of the pull speed (indices into :data:`TIMES`) whose differences measure how the melt fluctuates."""
SWING_TIME = 1200.0
"""Time constant of the squares of these differences [s]."""
USUAL_SWINGS = (1e-3, 2e-4)
"""Squares that map to a strength of one half [scaled units]."""
SCHEDULE_LIMIT = 2.0
"""Scheduling variables are clamped to +-SCHEDULE_LIMIT standard deviations [-]."""
INTEGRAL_TIME = 1000.0
"""Time for which a constant scaled ring error of one gives an integral of one [s]."""
GAINS = (0.2, 0.08)
"""Action for an output of one: pull speed and heater [-]."""
_AT = {channel.name: place for place, channel in enumerate(MEASURED)}
_NOISY = [_AT[name] for name in NOISY]
MEANS = len(SIGNALS) * len(TIMES) + len(BEGUN) + 1
"""Number of means, the integral included."""
CLEANED = 4
"""Number of the fastest :data:`TIMES` over which the signal that :mod:`.notch` removes is averaged too."""
_PARTS = [MEANS, *[len(NOISY)] * 3, len(SWINGS), NOTCH, CLEANED]
STATE = sum(_PARTS)
"""Length of its state: means of each signal, fastest first, and the integral of the ring error; the last readings of
noisy channels, their last differences, and their variances less USUAL**2; the squared swings; the notch's state, and
means of what the notch removes."""
_STRENGTHS = 1 + len(NOISY) + 1 + len(SWINGS)
N_DETACHED = _STRENGTHS + 1 + CLEANED
"""Number of features without gradient: outliers, ripples and scheduling variables."""
HELD = 2
"""Index into :data:`TIMES` of the mean that replaces a failed reading, where no regression is learned."""
REMEMBERED = MEANS + len(MEASURED)
"""Number of means and readings."""
_BEGUN = len(SIGNALS) * len(TIMES)
"""Place of the first mean of "valid"."""
_GROWTH = len(SIGNALS) * (len(TIMES) + 1) + 4
"""Place of r_ref_5min - r_ref among the features."""


class FilterBank(nn.Module):
    """Readings -> leaky means, their differences, noise -> normalised -> scheduled linear map, tanh layers -> action.

    The linear map is scheduled, as a Kalman filter's gains would be: it is one of the normalised features x and of
    their products with the ring's ripple, the camera's noise n, n^2 - 1, swings and how the reference will change
    within 5 minutes, all normalised; with the camera's noise on the scale of outliers, from 0 to 1; and with how new
    the crystal is or how many readings failed, from 1 to 0 within each of :data:`BEGUN`.
    """

    keep: torch.Tensor
    gain: torch.Tensor
    features: torch.Tensor
    gains: torch.Tensor
    ring: torch.Tensor
    expected: torch.Tensor
    """Linear estimate of a failed ring reading from means and readings, shape (MEANS + 11, 1)."""
    ones: torch.Tensor
    spread: torch.Tensor
    gather: torch.Tensor
    swings: torch.Tensor
    usual: torch.Tensor
    cleaned_keep: torch.Tensor
    cleaned_gain: torch.Tensor
    mean: torch.Tensor
    per_std: torch.Tensor

    def __init__(self, control_interval: float, hidden: tuple[int, ...]) -> None:
        super().__init__()
        keep, gain, features = _filters(control_interval)
        self._constant("keep", keep)
        self._constant("gain", gain)
        self._constant("features", features)
        self._constant("gains", np.array(GAINS))
        self._constant("ring", np.eye(1, len(MEASURED), _AT["ring_error"]))
        self.register_buffer("expected", torch.eye(REMEMBERED, REMEMBERED)[:, HELD : HELD + 1].clone())
        swings = np.zeros((MEANS, len(SWINGS)))
        for band, pair in enumerate(SWINGS):
            swings[len(TIMES) * SIGNALS.index("v_p") + np.array(pair), band] = 1.0, -1.0
        self._constant("swings", swings)
        self._constant("usual", np.array(USUAL_SWINGS))
        self.swing_share = 1.0 - float(np.exp(-control_interval / SWING_TIME))
        self.noise_share = 1.0 - float(np.exp(-control_interval / NOISE_TIME))
        self.interval = control_interval
        shares = 1.0 - np.exp(-control_interval / np.array(TIMES[:CLEANED]))
        self._constant("cleaned_keep", 1.0 - shares)
        self._constant("cleaned_gain", shares[None])
        width = features.shape[1] + N_DETACHED
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("per_std", torch.ones(width))
        self.layers = tanh_layers([width, *hidden])
        schedules = 5 + len(BEGUN) + len(SWINGS)
        self.linear = nn.Linear(width, len(GAINS) * (1 + schedules))
        self._constant("ones", np.tile(np.eye(1, 1 + schedules), len(GAINS)))
        self._constant("spread", np.tile(np.eye(1 + schedules)[1:], len(GAINS)))
        self._constant("gather", np.repeat(np.diag(GAINS), 1 + schedules, axis=0))
        self.bent = nn.Linear(hidden[-1], len(GAINS), bias=False) if hidden else None
        with torch.no_grad():
            for parameter in (*self.linear.parameters(), *(self.bent.parameters() if self.bent else ())):
                parameter.zero_()

    def _constant(self, name: str, value: Any) -> None:
        self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)

    def remember(self, measured: Any, state: Any) -> tuple[Any, Any]:
        """Features, shape (n, width), and the next state, from readings (n, 11) and the state (n, STATE)."""
        means, last, change, excess, squares, notch, taken = split(state, _PARTS)
        first = clamp(columns(means, range(_BEGUN, _BEGUN + 1)) * -1e6 + 1.0, 0.0, 1.0)
        with torch.no_grad():
            ring, valid = (columns(measured, range(_AT[name], _AT[name] + 1)) for name in ("ring_error", "valid"))
            failed = (concat([means, measured]) @ self.expected - ring) * (valid * -1.0 + 1.0)
        measured = measured + failed @ self.ring
        means = means * self.keep + measured @ self.gain
        with torch.no_grad():
            now = columns(measured, _NOISY)
            difference, variance = now - last, excess + USUAL**2
            bend = difference - change
            square = bend * bend * (1.0 / 6.0)
            used = square - relu(square - variance * OUTLIER)
            excess = excess + (used - variance) * valid * self.noise_share
            variance = excess + USUAL**2
            noise = variance / (variance + USUAL**2)
            large = columns(variance, range(1)) / (columns(variance, range(1)) + LARGE**2)
            swings = means @ self.swings
            squares = squares + (swings * swings - squares) * self.swing_share
            strong = squares / (squares + self.usual)
            take, ripple, notch = cleaned(columns(now, range(1)), notch, first, self.interval)
            taken = taken * self.cleaned_keep + take @ self.cleaned_gain
        features = concat([concat([measured, means]) @ self.features, take, taken, ripple, noise, large, strong])
        return features, concat([means, now, difference, excess, squares, notch, taken])

    def back(self, by_features: Any, by_means: Any) -> tuple[Any, Any]:
        """Gradients with respect to readings (n, 11) and means before, from those of features and means after.

        Noise, swings, outliers, ripples and failed readings have no gradient: no action is chosen for its effect on
        their estimates.
        """
        by_seen = by_features[:, :-N_DETACHED] @ self.features.numpy().T
        by_means = by_means + by_seen[:, len(MEASURED) :]
        return by_seen[:, : len(MEASURED)] + by_means @ self.gain.numpy().T, by_means * self.keep.numpy()

    def act(self, features: Any) -> Any:
        """The action, shape (..., 2), not yet clamped to its box, from features of shape (..., width)."""
        x = self.normalised(features)
        lines = apply(x, self.linear)
        lines = lines * (self._schedule(x, features) @ self.spread + self.ones)
        action = lines @ self.gather
        if self.bent is not None:
            action = action + apply(apply(x, self.layers), self.bent) * self.gains
        return action

    def normalised(self, features: Any) -> Any:
        """The features less their mean, in standard deviations, clamped."""
        return clamp((features - self.mean) * self.per_std, -NORMALISED_LIMIT, NORMALISED_LIMIT)

    def _schedule(self, x: Any, features: Any) -> Any:
        """The scheduling variables, each in a column."""
        width = len(self.mean)
        strengths = clamp(columns(x, range(width - _STRENGTHS, width)), -SCHEDULE_LIMIT, SCHEDULE_LIMIT)
        ripple, noise, _, _, *swings = split(strengths, [1] * _STRENGTHS)
        ages = range(width - N_DETACHED - len(BEGUN), width - N_DETACHED)
        large = width - len(SWINGS) - 1
        growth = columns(x, range(_GROWTH, _GROWTH + 1))
        return concat(
            [
                ripple,
                noise,
                noise * noise - 1.0,
                *swings,
                clamp(growth, -SCHEDULE_LIMIT, SCHEDULE_LIMIT),
                columns(features, range(large, large + 1)),
                columns(features, ages) * -1.0 + 1.0,
            ]
        )

    def forward(self, measured: Any, state: Any) -> tuple[Any, Any]:
        """Action and next state."""
        features, after = self.remember(measured, state)
        return self.act(features), after

    def onnx(self) -> bytes:
        """The network as an agent's ONNX model."""
        return self._graph()[1]

    def load(self, content: bytes) -> None:
        """Take the weights of an agent's graph that :meth:`onnx` wrote; ValueError if it is of another network."""
        own = self._graph()[0].tensors
        found = {each.name: each for each in onnx.load_from_string(content).graph.initializer}
        if any(name not in found or list(each.shape) != list(found[name].dims) for name, each in own.items()):
            raise CzError("not an agent of this release's recipe gradient")
        for name, tensor in own.items():
            tensor.copy_(torch.from_numpy(numpy_helper.to_array(found[name]).copy()))

    def _graph(self) -> tuple[OnnxGraph, bytes]:
        graph = OnnxGraph()
        action, after = self.forward(Value(graph, "observation"), Value(graph, "state"))
        graph.clip(action.name, -1.0, 1.0, "action")
        graph.node("Identity", [after.name], "next_state")
        return graph, graph.finished(len(MEASURED), state=STATE)


def read_bank(start: str, seed: int, config: Config, hidden: tuple[int, ...]) -> FilterBank:
    """The network of an agent that training continues from: a file, a folder of runs, or a shipped name and this seed.

    AgentFileError for an agent of another recipe, action or control interval.
    """
    path = Path(start)
    if path.is_dir():
        path = path / f"seed{seed}" / "agent.onnx"
    elif not path.suffix:
        path = MODELS / f"{start}-seed{seed}.onnx"
    contract, content = read_agent(path)
    bank = FilterBank(config.control_interval, hidden)
    if (contract.control_interval, contract.action) != (config.control_interval, config.action):
        raise AgentFileError(f"{path}: not an agent of the recipe gradient")
    try:
        bank.load(checked(content, len(MEASURED))[0])
    except ValueError as error:
        raise AgentFileError(f"{path}: {error}") from None
    return bank


def _filters(interval: float) -> tuple[Any, Any, Any]:
    """Matrices of the leaky means: their decay in a step, the gain of readings, and the features of both.

    Shapes (means,), (11, means), (11 + means, width).
    """
    shares = 1.0 - np.exp(-interval / np.array(TIMES))
    n, times = len(MEASURED), len(TIMES)
    keep, gain, seen = np.ones(MEANS), np.zeros((n, MEANS)), np.eye(n + MEANS)
    now = {channel.name: seen[place] for place, channel in enumerate(MEASURED)}
    features = []
    for signal, name in enumerate(SIGNALS):
        mine = slice(signal * times, (signal + 1) * times)
        keep[mine], gain[_AT[name], mine] = 1.0 - shares, shares
        slower = [now[name], *seen[n:][mine]]
        features += [one - other for one, other in pairwise(slower)] + slower[-1:]
    begun = slice(len(SIGNALS) * times, MEANS - 1)
    shares = 1.0 - np.exp(-interval / np.array(BEGUN))
    keep[begun], gain[_AT["valid"], begun] = 1.0 - shares, shares
    gain[_AT["ring_error"], -1] = interval / INTEGRAL_TIME
    features += [seen[-1], now["valid"], now["r_ref"]]
    features += [now[f"r_ref_{ahead}"] - now["r_ref"] for ahead in ("1min", "5min")]
    features += [now["T_1_ref"] - now["T_1"], *(now[f"T_1_ref_{ahead}"] - now["T_1_ref"] for ahead in ("1min", "5min"))]
    features += list(seen[n:][begun])
    return keep, gain, np.stack(features, axis=1)
