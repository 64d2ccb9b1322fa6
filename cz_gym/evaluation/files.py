"""The benchmark's results as files: JSON and CSV, written whole or not at all."""

from __future__ import annotations

import csv
import io
import json
import platform
from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from cz_gym.atomic_files import check_writable as check_writable
from cz_gym.atomic_files import write_files as write_files
from cz_gym.episodes.scenarios import SCENARIOS

from .metrics import metric_names
from .results import BOUND, REFERENCE, Benchmark, Outcome
from .statistics import RESAMPLES, SEED, Estimate

PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "onnxruntime", "casadi")
"""Packages whose versions are recorded."""
RESULTS, EPISODES = "benchmark.json", "episodes.csv"
FILES = (RESULTS, EPISODES, "report.md", "report.html", "crystal.png", "errors.png", "pareto.png")
"""Everything a folder of results may hold."""


def to_json(benchmark: Benchmark) -> str:
    """``benchmark.json``: results, paired differences, tails, verdicts and provenance."""
    results: dict[str, Any] = {}
    paired: dict[str, Any] = {}
    tails: dict[str, Any] = {}
    for scenario in benchmark.scenarios:
        name = scenario.row.name
        results[name] = {outcome.controller.name: _estimates(outcome.means) for outcome in scenario.outcomes}
        tails[name] = {outcome.controller.name: _estimates(outcome.cvar5) for outcome in scenario.outcomes}
        paired[name] = {outcome.controller.name: _paired(outcome) for outcome in scenario.outcomes if outcome.paired}
    verdicts = {
        scenario.row.name: {
            verdict.agent: {
                "rival": verdict.rival,
                "rmse_mm_difference": _estimate(verdict.difference),
                "wins": verdict.wins,
            }
            for verdict in scenario.verdicts
        }
        for scenario in benchmark.scenarios
    }
    data = {
        "results": results,
        "paired": paired,
        "cvar5": tails,
        "optimality_gap": _by_scenario(benchmark, lambda outcome: outcome.gap),
        "optimality_gap_radius": _by_scenario(benchmark, lambda outcome: outcome.gap_radius),
        "verdicts": verdicts,
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


def _by_scenario(benchmark: Benchmark, pick: Callable[[Outcome], Estimate | None]) -> dict[str, Any]:
    """One estimate an outcome; scenarios without any are left out."""
    found = {
        scenario.row.name: {o.controller.name: _estimate(one) for o in scenario.outcomes if (one := pick(o))}
        for scenario in benchmark.scenarios
    }
    return {name: estimates for name, estimates in found.items() if estimates}


def _paired(outcome: Outcome) -> dict[str, Any]:
    found: dict[str, Any] = _estimates(outcome.paired)
    if outcome.improvement is not None:
        found["rmse_mm"]["probability_of_improvement"] = _estimate(outcome.improvement)
    return found


def _estimates(estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    return {name: _estimate(estimate) for name, estimate in estimates.items()}


def _estimate(estimate: Estimate) -> dict[str, Any]:
    return {"mean": estimate.mean, "ci95": list(estimate.ci95) if estimate.ci95 else None, "n": estimate.n}


def _provenance(benchmark: Benchmark) -> dict[str, Any]:
    config = benchmark.scenarios[0].row.config()
    return {
        "command": benchmark.command,
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "plant_hash": config.plant_hash,
        "control_interval_s": config.control_interval,
        "horizon_s": config.horizon,
        "scenarios": {
            scenario.row.name: {
                "scenario": scenario.row.scenario,
                "hash": SCENARIOS[scenario.row.scenario].hash,
                "model": scenario.row.model,
                "control_interval_s": scenario.row.control_interval,
                "meniscus": scenario.row.meniscus.name,
                "first_seed": scenario.seeds[0],
                "episodes": len(scenario.seeds),
            }
            for scenario in benchmark.scenarios
        },
        "controllers": {controller.name: asdict(controller) for controller in benchmark.controllers},
        "agents": [dict(contract) for contract in benchmark.agents],
        "bootstrap": {"resamples": RESAMPLES, "seed": SEED, "paired_against": REFERENCE},
        "gap_measured_from": BOUND,
        "gap_from_kept_episodes": {s.row.name: len(s.kept_bound.seeds) for s in benchmark.scenarios if s.kept_bound},
    }


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def to_csv(benchmark: Benchmark) -> str:
    """``episodes.csv``: one line an episode."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("scenario", "controller", "training_seed", "seed", *metric_names()))
    for scenario in benchmark.scenarios:
        for outcome in scenario.outcomes:
            trained = outcome.controller.training_seeds or ("",)
            for training_seed, episodes in zip(trained, outcome.sample.values, strict=True):
                for seed, values in zip(outcome.sample.seeds, episodes, strict=True):
                    numbers = (f"{value:.5g}" for value in values)
                    writer.writerow((scenario.row.name, outcome.controller.name, training_seed, seed, *numbers))
    return text.getvalue()
