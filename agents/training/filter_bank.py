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

TIMES = tuple(float(time) for time in np.geomspace(10.0, 3600.0, 7))
"""Time constants of the leaky means [s]."""
SIGNALS = ("ring_error", "v_p", "T_1", "Q_H")
"""Channels that are averaged."""
SPREADS = ("ring_error", "T_1")
"""Channels whose spread about their fastest mean is remembered: how noisy sensors and melt are."""
SPREAD_TIME = 300.0
"""Time constant of the spreads [s]."""
SPREAD_SCALE = 1e-3
"""A spread, squared and in scaled units, that counts half of the largest [-]."""
INTEGRAL_TIME = 1000.0
"""A scaled ring error of one held so long gives an integral of one [s]."""
GAINS = (0.2, 0.08)
"""Action for an output of one: pull speed and heater [-]."""
_AT = {channel.name: place for place, channel in enumerate(MEASURED)}
_MEANS, _SPREADS = len(SIGNALS) * len(TIMES), len(SPREADS)
STATE = _MEANS + 1 + _SPREADS
"""Numbers that it remembers: means of each signal, fastest first; the integral of the ring error; spreads."""


class FilterBank(nn.Module):
    """Readings -> leaky means, their differences, spreads -> normalised -> linear map beside tanh layers -> action."""

    keep: torch.Tensor
    gain: torch.Tensor
    features: torch.Tensor
    fast: torch.Tensor
    gains: torch.Tensor
    mean: torch.Tensor
    per_std: torch.Tensor

    def __init__(self, control_interval: float, hidden: tuple[int, ...]) -> None:
        super().__init__()
        keep, gain, features, fast = _filters(control_interval)
        self._constant("keep", keep)
        self._constant("gain", gain)
        self._constant("features", features)
        self._constant("fast", fast)
        self._constant("gains", np.array(GAINS))
        self.spread_share = 1.0 - float(np.exp(-control_interval / SPREAD_TIME))
        width = features.shape[1] + _SPREADS
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("per_std", torch.ones(width))
        self.layers = tanh_layers([width, *hidden])
        self.linear = nn.Linear(width, len(GAINS))
        self.bent = nn.Linear(hidden[-1], len(GAINS), bias=False) if hidden else None
        with torch.no_grad():
            for parameter in (*self.linear.parameters(), *(self.bent.parameters() if self.bent else ())):
                parameter.zero_()

    def _constant(self, name: str, value: Any) -> None:
        self.register_buffer(name, torch.as_tensor(value, dtype=torch.float32), persistent=False)

    def remember(self, measured: torch.Tensor, state: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Features, shape (n, width), and the next state, from readings (n, 11) and the state (n, STATE)."""
        means = state[:, : _MEANS + 1] * self.keep + measured @ self.gain
        seen = torch.cat([measured, means], dim=1)
        fast = seen @ self.fast
        spreads = state[:, _MEANS + 1 :] + self.spread_share * (fast * fast - state[:, _MEANS + 1 :])
        noisy = spreads / (spreads + SPREAD_SCALE)
        return torch.cat([seen @ self.features, noisy], dim=1), torch.cat([means, spreads], dim=1)

    def act(self, features: torch.Tensor) -> torch.Tensor:
        """The action, shape (n, 2), not yet held within its box."""
        x = torch.clamp((features - self.mean) * self.per_std, -NORMALISED_LIMIT, NORMALISED_LIMIT)
        action = self.linear(x)
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
        sizes = graph.constant("sizes", np.array([_MEANS + 1, _SPREADS]))
        graph.nodes_of("Split", ["state", sizes], ["means_before", "spreads_before"], axis=1)
        kept = graph.node("Mul", ["means_before", graph.constant("keep", self.keep)], "kept")
        read = graph.node("MatMul", ["observation", graph.constant("gain", self.gain)], "read")
        means = graph.node("Add", [kept, read], "means")
        seen = graph.node("Concat", ["observation", means], "seen", axis=1)
        fast = graph.node("MatMul", [seen, graph.constant("fast_of", self.fast)], "fast")
        square = graph.node("Mul", [fast, fast], "square")
        change = graph.node("Sub", [square, "spreads_before"], "change")
        moved = graph.node("Mul", [change, graph.constant("share", np.full(1, self.spread_share, np.float32))], "moved")
        spreads = graph.node("Add", ["spreads_before", moved], "spreads")
        above = graph.node("Add", [spreads, graph.constant("scale", np.full(1, SPREAD_SCALE, np.float32))], "above")
        noisy = graph.node("Div", [spreads, above], "noisy")
        plain = graph.node("MatMul", [seen, graph.constant("features_of", self.features)], "plain")
        x = graph.node("Concat", [plain, noisy], "features", axis=1)
        x = graph.node("Sub", [x, graph.constant("mean", self.mean)], "centred")
        x = graph.node("Mul", [x, graph.constant("per_std", self.per_std)], "scaled")
        x = graph.clip(x, -NORMALISED_LIMIT, NORMALISED_LIMIT, "normalised")
        output = graph.linear(x, self.linear.weight, self.linear.bias, "linear")
        if self.bent is not None:
            output = graph.node("Add", [output, graph.through(x, [self.layers, self.bent])], "output")
        output = graph.node("Mul", [output, graph.constant("gains", self.gains)], "asked")
        graph.clip(output, -1.0, 1.0, "action")
        graph.node("Concat", [means, spreads], "next_state", axis=1)
        return graph.finished(len(MEASURED), state=STATE)


def _filters(interval: float) -> tuple[Any, Any, Any, Any]:
    """What is kept of the means a step, what a reading adds, what features are made of both, and what is fast.

    Shapes (means + 1,), (11, means + 1), (11 + means + 1, width), (11 + means + 1, spreads).
    """
    shares = 1.0 - np.exp(-interval / np.array(TIMES))
    n, times = len(MEASURED), len(TIMES)
    keep, gain, seen = np.ones(_MEANS + 1), np.zeros((n, _MEANS + 1)), np.eye(n + _MEANS + 1)
    now = {channel.name: seen[place] for place, channel in enumerate(MEASURED)}
    features, fast = [], []
    for signal, name in enumerate(SIGNALS):
        mine = slice(signal * times, (signal + 1) * times)
        keep[mine], gain[_AT[name], mine] = 1.0 - shares, shares
        slower = [now[name], *seen[n:][mine]]
        features += [one - other for one, other in pairwise(slower)] + slower[-1:]
        if name in SPREADS:
            fast.append(slower[0] - slower[1])
    gain[_AT["ring_error"], _MEANS] = interval / INTEGRAL_TIME
    features += [seen[n + _MEANS], now["valid"], now["r_ref"]]
    features += [now[f"r_ref_{ahead}"] - now["r_ref"] for ahead in ("1min", "5min")]
    features += [now["T_1_ref"] - now["T_1"], *(now[f"T_1_ref_{ahead}"] - now["T_1_ref"] for ahead in ("1min", "5min"))]
    return keep, gain, np.stack(features, axis=1), np.stack(fast, axis=1)
