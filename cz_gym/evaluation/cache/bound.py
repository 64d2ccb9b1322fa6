"""The bound's episodes of an earlier benchmark, for runs in which the bound, which is slow, takes no part."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.evaluation.files import EPISODES, RESULTS
from cz_gym.evaluation.metrics import metric_names
from cz_gym.evaluation.protocol import Row
from cz_gym.evaluation.results import BOUND, Controller, Sample

PRINTED = 1e-4
"""Relative precision of the figures in ``episodes.csv``, five digits [-]."""


def kept_bound(folder: Path, row: Row, samples: Sequence[Sample]) -> Sample | None:
    """The bound on that row, from a folder of benchmark results; signals and time are not kept there.

    None unless the folder's benchmark met the row's own first test episodes: same plant and scenario by their hashes,
    same model, meniscus, interval, horizon and first seeds. And unless each controller that ran then and now, one at
    least, has the same figures on them: other code makes other figures.
    """
    try:
        made = json.loads((folder / RESULTS).read_text("utf-8"))["provenance"]
        lines = csv.DictReader(io.StringIO((folder / EPISODES).read_text("utf-8")))
        if not _same(made, row):
            return None
        by_name: dict[str, list[tuple[int, list[float]]]] = {}
        for line in lines:
            if line["scenario"] == row.name:
                figures = [float(line[name]) for name in metric_names()]
                by_name.setdefault(line["controller"], []).append((int(line["seed"]), figures))
        seeds = tuple(seed for seed, _ in by_name[BOUND])
        values = np.array([[figures for _, figures in by_name[BOUND]]])
        told = made["controllers"][BOUND]
        controller = Controller(BOUND, told["observation"], told["meaning"], told=True, slow=True)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if not seeds or seeds != tuple(row.seeds(len(seeds))) or not np.isfinite(values).all():
        return None
    if not _agrees(by_name, samples):
        return None
    return Sample(controller, seeds, values, float("nan"), (), row.config().control_interval)


def _agrees(kept: Mapping[str, Sequence[tuple[int, list[float]]]], samples: Sequence[Sample]) -> bool:
    """Whether those who ran then and now, one at least, have the same figures on the crystals that they met twice."""
    both = [sample for sample in samples if sample.controller.name in kept and not sample.controller.learned]
    for sample in both:
        now = dict(zip(sample.seeds, sample.values[0], strict=True))
        for seed, figures in kept[sample.controller.name]:
            if seed in now and not np.allclose(now[seed], figures, rtol=PRINTED):
                return False
    return bool(both)


def _same(made: dict[str, Any], row: Row) -> bool:
    """Whether those results are of the row's plant and scenario."""
    config, theirs = row.config(), made["scenarios"][row.name]
    ours = {
        "hash": config.scenario.hash,
        "model": row.model,
        "control_interval_s": config.control_interval,
        "meniscus": row.meniscus.name,
    }
    same_plant = (made["plant_hash"], made["horizon_s"]) == (config.plant_hash, config.horizon)
    return same_plant and all(theirs[name] == value for name, value in ours.items())
