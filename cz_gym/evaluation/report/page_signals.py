"""The signals of the page's episodes: in the units people read, rounded, packed small.

A packed array is a base64 text of zlib's deflate of variable-length integers: values in steps of the signal's
resolution, then differences along time, zigzag (0, -1, 1, -2, ... become 0, 1, 2, 3, ...), seven bits a byte, the low
ones first. Smooth signals take about half a byte a value; ``html/data.js`` reads them in the browser.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config
from cz_gym.evaluation.results import ScenarioResult
from cz_gym.evaluation.rollout import Signals
from cz_gym.units import KILO, MM, MM_PER_MIN
from cz_gym.vector import CzVectorEnv

Floats = npt.NDArray[np.float64]
Bytes = npt.NDArray[np.uint8]
BITS = 7
"""Bits of a number in each byte; the eighth says that more follow."""


class Curve(NamedTuple):
    """A logged signal as the page shows it."""

    key: str
    unit: str
    scale: float
    """The unit in the signal's own [SI]."""
    resolution: float
    """Values are rounded to a multiple of this [unit]."""
    signal: str = ""
    """Its field of Signals, where that is not the key."""
    ring: bool = False
    """Whether the operator's bias is taken off, as the ring's readings are shown."""

    def value(self, signals: Signals, bias: float) -> Floats:
        """The signal in its unit, the operator's bias in m."""
        logged: Floats = getattr(signals, self.signal or self.key)
        return (logged - bias * self.ring) / self.scale


CURVES = (
    Curve("r_c", "mm", MM, 0.001),
    Curve("camera", "mm", MM, 0.001, "r_br_measured", ring=True),
    Curve("ring", "mm", MM, 0.001, "r_br", ring=True),
    Curve("h_c", "mm", MM, 0.001),
    Curve("alpha_c", "deg", np.pi / 180.0, 0.001),
    Curve("v_p", "mm/min", MM_PER_MIN, 0.0005),
    Curve("v_g", "mm/min", MM_PER_MIN, 0.0005),
    Curve("Q_H", "kW", KILO, 0.001),
    Curve("T_1", "K", 1.0, 0.01),
    Curve("T_b", "K", 1.0, 0.001),
)
"""What a controller does to a crystal."""
SHARED = (
    Curve("r_ref", "mm", MM, 0.001),
    Curve("T_1_ref", "K", 1.0, 0.01),
    Curve("offset", "mm", MM, 0.001, "ring_offset"),
)
"""What is the same for every controller on that crystal."""


def episodes(scenario: ScenarioResult) -> list[dict[str, Any]]:
    """The scenario's kept episodes: seed, what all controllers share, and each controller's curves or None."""
    samples = [outcome.sample for outcome in scenario.outcomes]
    seeds = scenario.seeds[: max(len(sample.examples) for sample in samples)]
    found = []
    for i, (seed, bias) in enumerate(zip(seeds, ring_biases(scenario.row.config(), seeds), strict=True)):
        here = [_finite(sample.examples[i]) if i < len(sample.examples) else None for sample in samples]
        longest = max((signals for signals in here if signals is not None), key=lambda signals: len(signals.r_c))
        found.append(
            {
                "seed": seed,
                "steps": len(longest.r_c),
                "packed": pack([(curve.value(longest, bias), curve.resolution) for curve in SHARED]),
                "runs": [
                    None
                    if signals is None
                    else {
                        "steps": len(signals.r_c),
                        "failed": bool(sample.metric("failure_rate")[0, i]),
                        "rmse_mm": float(f"{sample.metric('rmse_mm')[0, i]:.5g}"),
                        "packed": pack([(curve.value(signals, bias), curve.resolution) for curve in CURVES]),
                    }
                    for sample, signals in zip(samples, here, strict=True)
                ],
            }
        )
    return found


def _finite(signals: Signals) -> Signals:
    """The signals up to the first step at which one of them is no number: a crystal that broke the equations."""
    broken = ~np.isfinite(np.stack(signals)).all(axis=0)
    return Signals(*(signal[: int(broken.argmax())] for signal in signals)) if broken.any() else signals


def ring_biases(config: Config, seeds: Sequence[int]) -> tuple[float, ...]:
    """The operator's bias of each seed's puller [m]: bright ring less radius at its own steady state."""
    env = CzVectorEnv(len(seeds), config.scenario, config.model, parameters=config.parameters, meniscus=config.meniscus)
    env.reset(seed=list(seeds))
    states = env.get_state()
    env.close()
    return tuple(float(state.slot.slot["puller"]["ring_bias"]) for state in states)


def pack(signals: Sequence[tuple[Floats, float]]) -> str:
    """Arrays of one length, each with its resolution, as a text."""
    steps = [np.rint(values / resolution).astype(np.int64) for values, resolution in signals]
    changes = np.concatenate([np.diff(whole, prepend=0) for whole in steps])
    zigzag = np.where(changes < 0, -2 * changes - 1, 2 * changes)
    return base64.b64encode(zlib.compress(_varints(zigzag).tobytes(), 9)).decode("ascii")


def unpack(text: str, resolutions: Sequence[float]) -> tuple[Floats, ...]:
    """The arrays that :func:`pack` packed, rounded to their resolutions."""
    raw = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8)
    ends = np.flatnonzero(raw < 1 << BITS)
    begins = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(len(raw)) - np.repeat(begins, ends - begins + 1)
    parts = (raw & ((1 << BITS) - 1)).astype(np.int64) << (BITS * place)
    zigzag = np.add.reduceat(parts, begins)
    changes = np.where(zigzag % 2, -(zigzag + 1) // 2, zigzag // 2)
    whole = np.cumsum(changes.reshape(len(resolutions), -1), axis=1)
    return tuple(row * resolution for row, resolution in zip(whole, resolutions, strict=True))


def _varints(numbers: npt.NDArray[np.int64]) -> Bytes:
    """Seven bits a byte, the low ones first; the high bit says that more follow."""
    width = max(1, -(-int(numbers.max(initial=0)).bit_length() // BITS))
    shifted = numbers[:, None] >> (BITS * np.arange(width))
    follows = np.concatenate([shifted[:, 1:] > 0, np.zeros((len(numbers), 1), np.bool_)], axis=1)
    digits = (shifted & ((1 << BITS) - 1)) | (follows.astype(np.int64) << BITS)
    used = shifted > 0
    used[:, 0] = True
    packed: Bytes = digits[used].astype(np.uint8)
    return packed
