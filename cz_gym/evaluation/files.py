"""A benchmark's results as JSON and CSV, written and read back."""

from __future__ import annotations

import csv
import io
import json
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.atomic_files import naming
from cz_gym.episodes.scenarios import find_scenario
from cz_gym.errors import CzError

from .metrics import metric_names
from .results import BOUND, REFERENCE, Benchmark, Outcome, ScenarioResult
from .statistics import RESAMPLES, SEED, Estimate

PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "onnxruntime", "casadi")
"""Packages whose versions are recorded."""
RESULTS, EPISODES = "benchmark.json", "episodes.csv"
FILES = (RESULTS, EPISODES, "report.md", "report.html", "crystal.png", "errors.png", "pareto.png")
"""Everything a folder of results may hold."""
Episodes = dict[str, dict[str, npt.NDArray[np.float64]]]
"""By scenario and controller: metrics of shape (training seeds, crystals, metrics)."""


def to_json(benchmark: Benchmark) -> str:
    """``benchmark.json``: results, paired differences, tails, verdicts and provenance."""

    def by_controller(pick: Callable[[Outcome], Any]) -> dict[str, dict[str, Any]]:
        """What each outcome of each scenario holds; outcomes that hold nothing are left out."""
        return {
            scenario.row.name: {each.controller.name: found for each in scenario.outcomes if (found := pick(each))}
            for scenario in benchmark.scenarios
        }

    gaps = by_controller(lambda outcome: _plain(outcome.gap))
    radius_gaps = by_controller(lambda outcome: _plain(outcome.gap_radius))
    data = {
        "results": by_controller(lambda outcome: _by_metric(outcome.means)),
        "paired": by_controller(_paired),
        "cvar5": by_controller(lambda outcome: _by_metric(outcome.cvar5)),
        "optimality_gap": {name: found for name, found in gaps.items() if found},
        "optimality_gap_radius": {name: found for name, found in radius_gaps.items() if found},
        "verdicts": {
            scenario.row.name: {
                verdict.agent: {
                    "rival": verdict.rival,
                    "rmse_mm_difference": _plain(verdict.difference),
                    "wins": verdict.wins,
                }
                for verdict in scenario.verdicts
            }
            for scenario in benchmark.scenarios
        },
        "provenance": _provenance(benchmark),
    }
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def is_benchmark_json(content: bytes) -> bool:
    """Whether these bytes were written by :func:`to_json`, by this release or an earlier one."""
    try:
        data = json.loads(content)
    except (ValueError, RecursionError):
        return False
    return isinstance(data, dict) and {"results", "paired", "cvar5", "verdicts", "provenance"} <= set(data)


def _plain(estimate: Estimate | None) -> dict[str, Any] | None:
    return estimate._asdict() if estimate else None


def _by_metric(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    return {name: _plain(estimate) for name, estimate in estimates.items()}


def _paired(outcome: Outcome) -> dict[str, Any]:
    found = _by_metric(outcome.paired)
    if outcome.improvement is not None:
        found["rmse_mm"]["probability_of_improvement"] = _plain(outcome.improvement)
    return found


def _provenance(benchmark: Benchmark) -> dict[str, Any]:
    config = benchmark.scenarios[0].row.config()
    return {
        "command": benchmark.command,
        **software(PACKAGES),
        "plant_hash": config.plant_hash,
        "control_interval_s": config.control_interval,
        "horizon_s": config.horizon,
        "scenarios": {scenario.row.name: _crystals(scenario) for scenario in benchmark.scenarios},
        "controllers": {controller.name: asdict(controller) for controller in benchmark.controllers},
        "agents": [dict(contract) for contract in benchmark.agents],
        "bootstrap": {"resamples": RESAMPLES, "seed": SEED, "paired_against": REFERENCE},
        "gap_measured_from": BOUND,
        "gap_from_cached_episodes": {
            s.row.name: len(s.earlier_bound.seeds) for s in benchmark.scenarios if s.earlier_bound
        },
    }


def _crystals(scenario: ScenarioResult) -> dict[str, Any]:
    row = scenario.row
    return {
        "scenario": find_scenario(row.scenario).name,
        "hash": find_scenario(row.scenario).hash,
        "model": row.model,
        "control_interval_s": row.control_interval,
        "meniscus": row.meniscus.name,
        "first_seed": scenario.seeds[0],
        "episodes": len(scenario.seeds),
    }


def software(packages: Sequence[str]) -> dict[str, Any]:
    """Versions of Python and of the packages, None for one that is not installed."""
    found: dict[str, str | None] = dict.fromkeys(packages)
    for name in packages:
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return {"python": platform.python_version(), "packages": found}


def to_csv(benchmark: Benchmark) -> str:
    """``episodes.csv``: one line an episode."""
    rows = (
        (scenario.row.name, outcome.controller.name, training_seed, seed, *(f"{value:.5g}" for value in values))
        for scenario in benchmark.scenarios
        for outcome in scenario.outcomes
        for training_seed, episodes in zip(
            outcome.controller.training_seeds or ("",), outcome.sample.values, strict=True
        )
        for seed, values in zip(outcome.sample.seeds, episodes, strict=True)
    )
    return csv_text(("scenario", "controller", "training_seed", "seed", *metric_names()), rows)


def csv_text(heads: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A table as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([heads, *rows])
    return text.getvalue()


def read_episodes(path: Path, columns: Callable[[str], Sequence[str]]) -> Episodes:
    """The columns that are wanted of each scenario in an ``episodes.csv``, crystals in the file's order.

    ValueError if the file is none of a benchmark's, holds what is no finite number, or a controller's training seeds
    did not meet the same number of crystals.
    """
    found: dict[str, dict[str, dict[str, list[list[float]]]]] = {}
    with naming(path):
        text = path.read_text("utf-8")
    try:
        for line in csv.DictReader(io.StringIO(text)):
            by_seed = found.setdefault(line["scenario"], {}).setdefault(line["controller"], {})
            figures = [float(line[name]) for name in columns(line["scenario"])]
            by_seed.setdefault(line["training_seed"], []).append(figures)
        arrays = {
            scenario: {name: np.array([*by_seed.values()]) for name, by_seed in by_name.items()}
            for scenario, by_name in found.items()
        }
        if not all(np.isfinite(values).all() for by_name in arrays.values() for values in by_name.values()):
            raise ValueError
    except (KeyError, TypeError, ValueError, csv.Error):
        raise CzError(f"{path}: no episodes of a benchmark, or damaged") from None
    return arrays
