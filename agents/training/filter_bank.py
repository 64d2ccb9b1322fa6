"""A policy with a memory of its own: leaky means of what is measured, over seconds to an hour, and a small network.

It reads "measured" alone. What it remembers travels in ``state``, so that it is the same in training, in an agent file
and in the benchmark.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import nn

from cz_gym.observation import MEASURED

from .export import OnnxGraph
from .networks import NORMALISED_LIMIT, tanh_layers

TIMES = tuple(float(time) for time in np.geomspace(3.0, 3600.0, 8))
"""Time constants of the leaky means [s]."""
SIGNALS = ("ring_error", "v_p", "T_1", "Q_H")
"""Channels that are averaged."""
NOISY = ("ring_error", "T_1")
"""Channels whose white noise is estimated from their second differences: camera and pyrometer."""
NOISE_TIME = 600.0
"""Time constant of the estimates [s]."""
USUAL = 0.01
"""Standard deviation that the estimates begin with; a variance so large counts half of the largest [scaled units]."""
OUTLIER = 9.0
"""A squared second difference counts at most so many times what is usual of it [-]."""
SCHEDULE_LIMIT = 3.0
"""The camera's noise schedules the linear map up to so many standard deviations from its mean [-]."""
INTEGRAL_TIME = 1000.0
"""A scaled ring error of one held so long gives an integral of one [s]."""
GAINS = (0.2, 0.08)
"""Action for an output of one: pull speed and heater [-]."""
_AT = {channel.name: place for place, channel in enumerate(MEASURED)}
_NOISY = [_AT[name] for name in NOISY]
MEANS = len(SIGNALS) * len(TIMES) + 1
"""How many means it remembers, the integral with them."""
_PARTS = [MEANS] + [len(NOISY)] * 3
STATE = sum(_PARTS)
"""Numbers that it remembers: means of each signal, fastest first, with the integral of the ring error; of noisy
channels the last readings, their last differences, and the variances less the usual ones."""


class FilterBank(nn.Module):
    """Readings -> leaky means, their differences, noise -> normalised -> scheduled linear map, tanh layers -> action.

    The linear map is one for quiet and one for noisy cameras, and what lies between: of the normalised features x, of
    x n and of x (n^2 - 1), where n is the camera's normalised noise.
    """

    keep: torch.Tensor
    gain: torch.Tensor
    features: torch.Tensor
    gains: torch.Tensor
    mean: torch.Tensor
    per_std: torch.Tensor

    def __init__(self, control_interval: float, hidden: tuple[int, ...]) -> None:
        super().__init__()
        keep, gain, features = _filters(control_interval)
        self._constant("keep", keep)
        self._constant("gain", gain)
        self._constant("features", features)
        self._constant("gains", np.array(GAINS))
        self.noise_share = 1.0 - float(np.exp(-control_interval / NOISE_TIME))
        width = features.shape[1] + len(NOISY)
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("per_std", torch.ones(width))
        self.layers = tanh_layers([width, *hidden])
        self.linear = nn.Linear(3 * width, len(GAINS))
        self.bent = nn.Linear(hidden[-1], len(GAINS), bias=False) if hidden else None
        with torch.no_grad():
            for parameter in (*self.linear.parameters(), *(self.bent.parameters() if self.bent else ())):
                parameter.zero_()

    def _constant(self, name: str, value: Any) -> None:
        self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)

    def remember(self, measured: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Features, shape (n, width), and the next state, from readings (n, 11) and the state (n, STATE)."""
        means = state[:, :MEANS] * self.keep + measured @ self.gain
        with torch.no_grad():
            now = measured[:, _NOISY]
            _, last, change, excess = torch.split(state, _PARTS, dim=1)
            variance, difference = USUAL**2 + excess, now - last
            square = (difference - change) ** 2 / 6.0
            used = square - torch.relu(square - OUTLIER * variance)
            excess = excess + self.noise_share * (used - variance)
            noise = 1.0 - USUAL**2 / (2.0 * USUAL**2 + excess)
        seen = torch.cat([measured, means], dim=1)
        features = torch.cat([seen @ self.features, noise], dim=1)
        return features, torch.cat([means, now, difference, excess], dim=1)

    def back(self, by_features: Any, by_means: Any) -> tuple[Any, Any]:
        """Gradients with respect to readings (n, 11) and means before, from those of features and means after.

        Arrays. The noise is taken as it is: no action is chosen for what it does to an estimate of noise.
        """
        by_seen = by_features[:, : -len(NOISY)] @ self.features.numpy().T
        by_means = by_means + by_seen[:, len(MEASURED) :]
        return by_seen[:, : len(MEASURED)] + by_means @ self.gain.numpy().T, by_means * self.keep.numpy()

    def act(self, features: torch.Tensor) -> torch.Tensor:
        """The action, shape (..., 2), not yet held within its box, from features of shape (..., width)."""
        x = torch.clamp((features - self.mean) * self.per_std, -NORMALISED_LIMIT, NORMALISED_LIMIT)
        noise = torch.clamp(x[..., -len(NOISY), None], -SCHEDULE_LIMIT, SCHEDULE_LIMIT)
        action = self.linear(torch.cat([x, x * noise, x * (noise * noise - 1.0)], dim=-1))
        if self.bent is not None:
            action = action + self.bent(self.layers(x))
        return torch.mul(action, self.gains)

    def forward(self, measured: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Action and next state."""
        features, after = self.remember(measured, state)
        return self.act(features), after

    def onnx(self) -> bytes:
        """The same as an agent's graph."""
        graph = OnnxGraph()

        def constant(name: str, value: list[float]) -> str:
            return graph.constant(name, np.array(value, np.float32))

        node = graph.node
        kept = ["means_before", "last", "change", "excess"]
        graph.nodes_of("Split", ["state", graph.constant("parts", np.array(_PARTS))], kept, axis=1)
        means = node("Mul", ["means_before", graph.constant("keep", self.keep)], "kept")
        read = node("MatMul", ["observation", graph.constant("gain", self.gain)], "read")
        means = node("Add", [means, read], "means")
        now = node("Gather", ["observation", graph.constant("noisy", np.array(_NOISY))], "now", axis=1)
        variance = node("Add", ["excess", constant("usual", [USUAL**2])], "variance")
        difference = node("Sub", [now, "last"], "difference")
        bend = node("Sub", [difference, "change"], "bend")
        square = node("Mul", [node("Mul", [bend, bend], "bend_2"), constant("sixth", [1.0 / 6.0])], "square")
        most = node("Mul", [variance, constant("outlier", [OUTLIER])], "most")
        above = node("Relu", [node("Sub", [square, most], "over")], "above")
        off = node("Sub", [node("Sub", [square, above], "used"), variance], "off")
        moved = node("Mul", [off, constant("share", [self.noise_share])], "moved")
        excess = node("Add", ["excess", moved], "next_excess")
        half = node("Add", [excess, constant("twice", [2.0 * USUAL**2])], "half")
        noise = node("Sub", [constant("one", [1.0]), node("Div", ["usual", half], "quiet")], "noise")
        seen = node("Concat", ["observation", means], "seen", axis=1)
        plain = node("MatMul", [seen, graph.constant("features_of", self.features)], "plain")
        x = node("Concat", [plain, noise], "features", axis=1)
        x = node("Sub", [x, graph.constant("mean", self.mean)], "centred")
        x = node("Mul", [x, graph.constant("per_std", self.per_std)], "scaled")
        x = graph.clip(x, -NORMALISED_LIMIT, NORMALISED_LIMIT, "normalised")
        width = self.mean.numel()
        camera = graph.constant("camera", np.array([width - len(NOISY)]))
        n = graph.clip(node("Gather", [x, camera], "camera_noise", axis=1), -SCHEDULE_LIMIT, SCHEDULE_LIMIT, "n")
        bow = node("Sub", [node("Mul", [n, n], "n_2"), "one"], "bow")
        parts = [x, node("Mul", [x, n], "x_n"), node("Mul", [x, bow], "x_bow")]
        output = graph.linear(
            node("Concat", parts, "scheduled", axis=1), self.linear.weight, self.linear.bias, "linear"
        )
        if self.bent is not None:
            output = node("Add", [output, graph.through(x, [self.layers, self.bent])], "output")
        output = node("Mul", [output, graph.constant("gains", self.gains)], "asked")
        graph.clip(output, -1.0, 1.0, "action")
        node("Concat", [means, now, difference, excess], "next_state", axis=1)
        return graph.finished(len(MEASURED), state=STATE)


def _filters(interval: float) -> tuple[Any, Any, Any]:
    """What is kept of the means a step, what a reading adds, and what features are made of both.

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
    gain[_AT["ring_error"], -1] = interval / INTEGRAL_TIME
    features += [seen[-1], now["valid"], now["r_ref"]]
    features += [now[f"r_ref_{ahead}"] - now["r_ref"] for ahead in ("1min", "5min")]
    features += [now["T_1_ref"] - now["T_1"], *(now[f"T_1_ref_{ahead}"] - now["T_1_ref"] for ahead in ("1min", "5min"))]
    return keep, gain, np.stack(features, axis=1)
