"""The bound's episodes of an earlier benchmark, for runs in which the bound, which is slow, takes no part."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from .files import EPISODES, RESULTS
from .metrics import metric_names
from .protocol import Row
from .results import BOUND, Controller, Sample


def kept_bound(folder: Path, row: Row) -> Sample | None:
    """The bound on that row, from a folder of benchmark results; signals and time are not kept there.

    None unless the folder's benchmark met the row's own first test episodes: same plant and scenario by their hashes,
    same model, meniscus, interval, horizon and first seeds.
    """
    try:
        made = json.loads((folder / RESULTS).read_text("utf-8"))["provenance"]
        lines = csv.DictReader(io.StringIO((folder / EPISODES).read_text("utf-8")))
        if not _same(made, row):
            return None
        ours = [line for line in lines if (line["scenario"], line["controller"]) == (row.name, BOUND)]
        seeds = tuple(int(line["seed"]) for line in ours)
        values = np.array([[[float(line[name]) for name in metric_names()] for line in ours]])
        told = made["controllers"][BOUND]
        controller = Controller(BOUND, told["observation"], told["meaning"], told=True, slow=True)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if not seeds or seeds != tuple(row.seeds(len(seeds))) or not np.isfinite(values).all():
        return None
    return Sample(controller, seeds, values, float("nan"), (), row.config().control_interval)


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
