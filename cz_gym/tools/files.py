"""A benchmark's results as files: JSON, the table of episodes, and the report."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from cz_gym.evaluation.metrics import OUTSIDE
from cz_gym.evaluation.protocol import BOUND, REFERENCE, Case
from cz_gym.evaluation.statistics import RESAMPLES, SEED, Estimate
from cz_gym.support.errors import CzError, software
from cz_gym.support.files import check_writable, name_file_in_errors, write_files

from .episodes import Benchmark, to_csv
from .report.task_records import contract_hash

PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "onnxruntime")
"""Packages whose versions are recorded."""
FACTS = ("name", "observation", "meaning", "training_seeds", "privileged", "slow", "action", "own")
"""Fields of a contender that are recorded."""
RESULTS, EPISODES = "benchmark.json", "episodes.csv"
FILES = (RESULTS, EPISODES, "report.md", "report.html", "crystal.png", "pareto.png")
"""Everything a folder of results may hold."""


def check_targets(folder: Path | None, lone: Path | None, partial: bool, overwrite: bool) -> None:
    """Raise CzError if the results could not be written, or would replace files without ``overwrite``.

    Only a full run into the folder of an earlier benchmark replaces its files unasked.
    """
    renews = folder is not None and not partial and (folder / RESULTS).is_file()
    theirs = [folder / name for name in FILES] if folder and not renews else []
    present = [path for path in (*theirs, lone) if path and path.exists()]
    if lone and lone.is_dir():
        raise CzError(f"--json {lone} is a folder")
    if present and not overwrite:
        raise CzError(f"{present[0]} exists: add --overwrite, or name another --out or --json")
    for place in filter(None, (folder, lone and lone.parent)):
        check_writable(place)


def write(
    folder: Path | None, lone: Path | None, benchmark: Benchmark, command: str, quoted: Sequence[Path] = ()
) -> None:
    """Write the files, ``benchmark.json`` last, and the table into the pages ``quoted`` that exist."""
    text = to_json(benchmark, command).encode()
    files: dict[Path, bytes] = {}
    if folder:
        from cz_gym.tools.report.figures import draw_figures
        from cz_gym.tools.report.markdown import fill_in, markdown
        from cz_gym.tools.report.page import page

        figures = draw_figures(benchmark)
        files |= {folder / name: image for name, image in figures.items()}
        files[folder / EPISODES] = to_csv(benchmark.episodes)
        files[folder / "report.md"] = markdown(benchmark, command, figures).encode()
        files[folder / "report.html"] = page(benchmark, command).encode()
        for each in filter(Path.is_file, quoted):
            with name_file_in_errors(each):
                before = each.read_text("utf-8")
            files[each] = fill_in(before, benchmark).encode()
        files[folder / RESULTS] = text
    if lone:
        files[lone] = text
    write_files(files)


def to_json(benchmark: Benchmark, command: str) -> str:
    """Return the text of ``benchmark.json``: results, paired differences, tails, verdicts and provenance."""
    means, largest = _nested(benchmark, "mean"), _nested(benchmark, "quantile")
    paired, improvement = _nested(benchmark, "difference"), _nested(benchmark, "improvement")
    for case, of in improvement.items():
        for name, each in of.items():
            paired[case][name]["rmse_mm"]["probability_of_improvement"] = each["rmse_mm"]
    gaps = {
        metric: {
            case: {name: found[metric] for name, found in of.items() if metric in found}
            for case, of in _nested(benchmark, "gap").items()
        }
        for metric in ("cost", "rmse_mm")
    }
    data = {
        "results": means,
        "paired": paired,
        "cvar5": _nested(benchmark, "cvar"),
        "largest": {case: {name: largest[case].get(name, {}) for name in of} for case, of in means.items()},
        "optimality_gap": {case: of for case, of in gaps["cost"].items() if of},
        "optimality_gap_radius": {case: of for case, of in gaps["rmse_mm"].items() if of},
        "verdicts": {
            case.name: {
                agent: {
                    "rival": benchmark.rival(case),
                    "rmse_mm_difference": _plain(difference),
                    "wins": difference.ends[1] < 0.0,
                }
                for agent, difference in benchmark.verdicts(case).items()
            }
            for case in benchmark.cases
        },
        "provenance": _provenance(benchmark, command),
    }
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def _nested(benchmark: Benchmark, kind: str) -> dict[str, dict[str, dict[str, Any]]]:
    """The estimates of a kind by scenario, controller and metric."""
    nested: dict[str, dict[str, dict[str, Any]]] = {case.name: {} for case in benchmark.cases}
    frame = benchmark.estimates
    for row in frame[(frame["kind"] == kind) & (frame["metric"] != OUTSIDE)].itertuples(index=False):
        estimate = _plain(Estimate(row.mean, (row.low, row.high), row.n))
        nested[row.scenario].setdefault(row.controller, {})[row.metric] = estimate
    return nested


def _plain(estimate: Estimate) -> dict[str, Any]:
    """An estimate as a dictionary; numbers that do not apply, NaN, as None."""
    ends = estimate.ci95 if estimate.ci95 and all(map(math.isfinite, estimate.ci95)) else None
    return {"mean": estimate.mean if math.isfinite(estimate.mean) else None, "ci95": ends, "n": estimate.n}


def _provenance(benchmark: Benchmark, command: str) -> dict[str, Any]:
    config, contenders, earlier = benchmark.cases[0].config(), benchmark.contenders, benchmark.earlier_bound
    return {
        "command": command,
        **software(PACKAGES),
        "contract": contract_hash(benchmark.cases),
        "plant_hash": config.plant_hash,
        "puller": config.puller.label,
        "parameters": {
            name: value if math.isfinite(value) else None for name, value in config.parameters._asdict().items()
        },
        "control_interval_s": config.control_interval,
        "horizon_s": config.horizon,
        "scenarios": {case.name: _crystals(case, benchmark.seeds(case)) for case in benchmark.cases},
        "controllers": {each.name: {name: getattr(each, name) for name in FACTS} for each in contenders},
        "agents": [asdict(policy.contract) for each in contenders for policy in each.trained],
        "bootstrap": {"resamples": RESAMPLES, "seed": SEED, "paired_against": REFERENCE},
        "gap_measured_from": BOUND,
        "gap_from_cached_episodes": {
            str(name): len(rows) for name, rows in earlier.groupby("scenario", sort=False)
        },
    }  # fmt: skip


def _crystals(case: Case, seeds: Sequence[int]) -> dict[str, Any]:
    scenario = case.config().sole_scenario
    return {
        "scenario": scenario.name,
        "hash": scenario.hash,
        "model": case.model,
        "control_interval_s": case.control_interval,
        "meniscus": case.meniscus.name,
        "first_seed": seeds[0],
        "episodes": len(seeds),
    }
