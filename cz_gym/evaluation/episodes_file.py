"""Reading a benchmark's ``episodes.csv``, one line a crystal, back into arrays."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

Episodes = dict[str, dict[str, npt.NDArray[np.float64]]]
"""By scenario and controller: metrics of shape (training seeds, crystals, metrics)."""


def read_episodes(path: Path, metrics: Callable[[str], Sequence[str]]) -> Episodes:
    """The metrics that are wanted of each scenario, crystals in the file's order.

    ValueError if the file is none of a benchmark's, holds what is no finite number, or a controller's training seeds
    did not meet the same number of crystals.
    """
    found: dict[str, dict[str, dict[str, list[list[float]]]]] = {}
    try:
        for line in csv.DictReader(io.StringIO(path.read_text(encoding="utf-8"))):
            by_seed = found.setdefault(line["scenario"], {}).setdefault(line["controller"], {})
            figures = [float(line[name]) for name in metrics(line["scenario"])]
            by_seed.setdefault(line["training_seed"], []).append(figures)
        arrays = {
            scenario: {name: np.array([*by_seed.values()]) for name, by_seed in by_name.items()}
            for scenario, by_name in found.items()
        }
        if not all(np.isfinite(values).all() for by_name in arrays.values() for values in by_name.values()):
            raise ValueError
    except (KeyError, TypeError, ValueError, csv.Error):
        raise ValueError(f"{path}: no episodes of a benchmark, or damaged") from None
    return arrays
