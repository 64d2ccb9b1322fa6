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
BEGUN = (60.0, 300.0)
"""Time constants of the leaky means of "valid" [s]: how long ago the crystal began, and whether readings failed."""
NOISY = ("ring_error", "T_1")
"""Channels whose white noise is estimated from their second differences: camera and pyrometer."""
NOISE_TIME = 600.0
"""Time constant of the estimates [s]."""
USUAL = 0.01
"""Standard deviation that the estimates begin with; a variance so large counts half of the largest [scaled units]."""
OUTLIER = 9.0
"""A squared second difference counts at most so many times what is usual of it [-]."""
SWINGS = ((2, 3), (5, 6))
"""Pairs of the pull speed's means, by their places in :data:`TIMES`, whose differences say how the melt fluctuates."""
SWING_TIME = 1200.0
"""Time constant of the squares of these differences [s]."""
USUAL_SWINGS = (1e-3, 2e-4)
"""Squares that count half of the largest [scaled units]."""
SCHEDULE_LIMIT = 3.0
"""The camera's noise schedules the linear map up to so many standard deviations from its mean [-]."""
INTEGRAL_TIME = 1000.0
"""A scaled ring error of one held so long gives an integral of one [s]."""
GAINS = (0.2, 0.08)
"""Action for an output of one: pull speed and heater [-]."""
_AT = {channel.name: place for place, channel in enumerate(MEASURED)}
_NOISY = [_AT[name] for name in NOISY]
MEANS = len(SIGNALS) * len(TIMES) + len(BEGUN) + 1
"""How many means it remembers, the integral with them."""
_PARTS = [MEANS, *[len(NOISY)] * 3, len(SWINGS)]
STATE = sum(_PARTS)
"""Numbers that it remembers: means of each signal, fastest first, with the integral of the ring error; of noisy
channels the last readings, their last differences, and the variances less the usual ones; the squared swings."""
_STRENGTHS = len(NOISY) + len(SWINGS)


class FilterBank(nn.Module):
    """Readings -> leaky means, their differences, noise -> normalised -> scheduled linear map, tanh layers -> action.

    The linear map is scheduled, as a Kalman filter's gains would be: it is one of the normalised features x, x n,
    x (n^2 - 1), x s and x b, where n is the camera's noise and s are swings, normalised too, and b falls from 1 to 0
    within each of :data:`BEGUN`.
    """

    keep: torch.Tensor
    gain: torch.Tensor
    features: torch.Tensor
    gains: torch.Tensor
    swings: torch.Tensor
    usual: torch.Tensor
    mean: torch.Tensor
    per_std: torch.Tensor

    def __init__(self, control_interval: float, hidden: tuple[int, ...]) -> None:
        super().__init__()
        keep, gain, features = _filters(control_interval)
        self._constant("keep", keep)
        self._constant("gain", gain)
        self._constant("features", features)
        self._constant("gains", np.array(GAINS))
        swings = np.zeros((MEANS, len(SWINGS)))
        for band, pair in enumerate(SWINGS):
            swings[len(TIMES) * SIGNALS.index("v_p") + np.array(pair), band] = 1.0, -1.0
        self._constant("swings", swings)
        self._constant("usual", np.array(USUAL_SWINGS))
        self.swing_share = 1.0 - float(np.exp(-control_interval / SWING_TIME))
        self.noise_share = 1.0 - float(np.exp(-control_interval / NOISE_TIME))
        width = features.shape[1] + _STRENGTHS
        self.register_buffer("mean", torch.zeros(width))
        self.register_buffer("per_std", torch.ones(width))
        self.layers = tanh_layers([width, *hidden])
        self.linear = nn.Linear((3 + len(BEGUN) + len(SWINGS)) * width, len(GAINS))
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
            _, last, change, excess, swings = torch.split(state, _PARTS, dim=1)
            variance, difference = USUAL**2 + excess, now - last
            square = (difference - change) ** 2 / 6.0
            used = square - torch.relu(square - OUTLIER * variance)
            excess = excess + self.noise_share * (used - variance)
            noise = 1.0 - USUAL**2 / (2.0 * USUAL**2 + excess)
            swings = swings + self.swing_share * ((means @ self.swings) ** 2 - swings)
            strong = swings / (swings + self.usual)
        seen = torch.cat([measured, means], dim=1)
        features = torch.cat([seen @ self.features, noise, strong], dim=1)
        return features, torch.cat([means, now, difference, excess, swings], dim=1)

    def back(self, by_features: Any, by_means: Any) -> tuple[Any, Any]:
        """Gradients with respect to readings (n, 11) and means before, from those of features and means after.

        Arrays. Noise and swings are taken as they are: no action is chosen for what it does to their estimates.
        """
        by_seen = by_features[:, :-_STRENGTHS] @ self.features.numpy().T
        by_means = by_means + by_seen[:, len(MEASURED) :]
        return by_seen[:, : len(MEASURED)] + by_means @ self.gain.numpy().T, by_means * self.keep.numpy()

    def act(self, features: torch.Tensor) -> torch.Tensor:
        """The action, shape (..., 2), not yet held within its box, from features of shape (..., width)."""
        x = torch.clamp((features - self.mean) * self.per_std, -NORMALISED_LIMIT, NORMALISED_LIMIT)
        noise, _, *swings = torch.clamp(x[..., -_STRENGTHS:, None], -SCHEDULE_LIMIT, SCHEDULE_LIMIT).unbind(-2)
        begun = features[..., -_STRENGTHS - len(BEGUN) : -_STRENGTHS, None].unbind(-2)
        schedule = [noise, noise * noise - 1.0, *swings, *(1.0 - each for each in begun)]
        action = self.linear(torch.cat([x, *(x * each for each in schedule)], dim=-1))
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
        kept = ["means_before", "last", "change", "excess", "squares"]
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
        band = node("MatMul", [means, graph.constant("swings_of", self.swings)], "band")
        grown = node("Sub", [node("Mul", [band, band], "band_2"), "squares"], "grown")
        grown = node("Mul", [grown, constant("swing_share", [self.swing_share])], "swing_moved")
        swings = node("Add", ["squares", grown], "next_squares")
        above = node("Add", [swings, graph.constant("usual_swings", self.usual)], "swings_above")
        strong = node("Div", [swings, above], "strong")
        seen = node("Concat", ["observation", means], "seen", axis=1)
        plain = node("MatMul", [seen, graph.constant("features_of", self.features)], "plain")
        x = node("Concat", [plain, noise, strong], "features", axis=1)
        width = self.mean.numel()

        def feature(of: str, back: int, name: str) -> str:
            return node("Gather", [of, graph.constant(f"{name}_at", np.array([width - back]))], name, axis=1)

        begun = [feature(x, _STRENGTHS + back, f"begun_{back}") for back in range(len(BEGUN), 0, -1)]
        x = node("Sub", [x, graph.constant("mean", self.mean)], "centred")
        x = node("Mul", [x, graph.constant("per_std", self.per_std)], "scaled")
        x = graph.clip(x, -NORMALISED_LIMIT, NORMALISED_LIMIT, "normalised")
        strengths = [feature(x, _STRENGTHS - at, f"strength_{at}") for at in (0, *range(len(NOISY), _STRENGTHS))]
        noise, *swinging = (graph.clip(each, -SCHEDULE_LIMIT, SCHEDULE_LIMIT, f"{each}_held") for each in strengths)
        bow = node("Sub", [node("Mul", [noise, noise], "noise_2"), "one"], "bow")
        schedule = [noise, bow, *swinging, *(node("Sub", ["one", each], f"{each}_left") for each in begun)]
        parts = [x, *(node("Mul", [x, each], f"x_{each}") for each in schedule)]
        x_scheduled = node("Concat", parts, "scheduled", axis=1)
        output = graph.linear(x_scheduled, self.linear.weight, self.linear.bias, "linear")
        if self.bent is not None:
            output = node("Add", [output, graph.through(x, [self.layers, self.bent])], "output")
        output = node("Mul", [output, graph.constant("gains", self.gains)], "asked")
        graph.clip(output, -1.0, 1.0, "action")
        node("Concat", [means, now, difference, excess, swings], "next_state", axis=1)
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
    begun = slice(len(SIGNALS) * times, MEANS - 1)
    shares = 1.0 - np.exp(-interval / np.array(BEGUN))
    keep[begun], gain[_AT["valid"], begun] = 1.0 - shares, shares
    gain[_AT["ring_error"], -1] = interval / INTEGRAL_TIME
    features += [seen[-1], now["valid"], now["r_ref"]]
    features += [now[f"r_ref_{ahead}"] - now["r_ref"] for ahead in ("1min", "5min")]
    features += [now["T_1_ref"] - now["T_1"], *(now[f"T_1_ref_{ahead}"] - now["T_1_ref"] for ahead in ("1min", "5min"))]
    features += list(seen[n:][begun])
    return keep, gain, np.stack(features, axis=1)
