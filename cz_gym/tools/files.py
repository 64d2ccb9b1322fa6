"""A benchmark's results as files: JSON and CSV, written with the report, and read back."""

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.evaluation.protocol import contract_hash
from cz_gym.evaluation.results import BOUND, REFERENCE, Result
from cz_gym.evaluation.statistics import RESAMPLES, SEED, Estimate
from cz_gym.support.errors import CzError
from cz_gym.support.files import check_writable, name_file_in_errors, write_files
from cz_gym.support.names import software

PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "onnxruntime")
"""Packages whose versions are recorded."""
FACTS = ("name", "observation", "meaning", "training_seeds", "privileged", "slow", "action", "own")
"""What is recorded of a contender."""
RESULTS, EPISODES = "benchmark.json", "episodes.csv"
FILES = (RESULTS, EPISODES, "report.md", "report.html", "crystal.png", "pareto.png")
"""Everything a folder of results may hold."""
Episodes = dict[str, dict[str, npt.NDArray[np.float64]]]
"""By scenario and controller: metrics of shape (training seeds, crystals, metrics)."""


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
    for place in (folder, lone and lone.parent):
        if place:
            check_writable(place)


def write(
    folder: Path | None, lone: Path | None, results: Sequence[Result], command: str, quoted: Sequence[Path] = ()
) -> None:
    """Write the files, ``benchmark.json`` last, and the table into the pages ``quoted`` that exist."""
    text = to_json(results, command).encode()
    files: dict[Path, bytes] = {}
    if folder:
        from cz_gym.tools.report.figures import draw_figures
        from cz_gym.tools.report.markdown import fill_in, markdown
        from cz_gym.tools.report.page import page

        figures = draw_figures(results)
        files |= {folder / name: image for name, image in figures.items()}
        files[folder / EPISODES] = to_csv(results).encode()
        files[folder / "report.md"] = markdown(results, command, figures).encode()
        files[folder / "report.html"] = page(results, command).encode()
        for each in filter(Path.is_file, quoted):
            with name_file_in_errors(each):
                before = each.read_text("utf-8")
            files[each] = fill_in(before, results).encode()
        files[folder / RESULTS] = text
    if lone:
        files[lone] = text
    write_files(files)


def to_json(results: Sequence[Result], command: str) -> str:
    """Return the text of ``benchmark.json``: results, paired differences, tails, verdicts and provenance."""

    def each(table: Callable[[Result], Mapping[str, Any]]) -> dict[str, Any]:
        return {result.case.name: _plain(table(result)) for result in results}

    data = {
        "results": each(lambda result: result.means),
        "paired": each(_paired),
        "cvar5": each(lambda result: result.cvar5),
        "largest": each(lambda result: result.largest),
        "optimality_gap": _gaps(results, "cost"),
        "optimality_gap_radius": _gaps(results, "rmse_mm"),
        "verdicts": {
            result.case.name: {
                agent: {"rival": result.rival, "rmse_mm_difference": _plain(difference), "wins": result.wins(agent)}
                for agent, difference in result.verdicts.items()
            }
            for result in results
        },
        "provenance": _provenance(results, command),
    }
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    """Estimates as dictionaries, at any depth of a mapping; what does not apply, NaN, as None."""
    if isinstance(value, Mapping):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, Estimate):
        ends = value.ci95 if value.ci95 and all(map(math.isfinite, value.ci95)) else None
        return {"mean": value.mean if math.isfinite(value.mean) else None, "ci95": ends, "n": value.n}
    return value


def _gaps(results: Sequence[Result], metric: str) -> dict[str, Any]:
    """The gaps in one metric, of the scenarios that have any."""
    by_case = {
        result.case.name: {name: _plain(gaps[metric]) for name, gaps in result.gaps.items() if metric in gaps}
        for result in results
    }
    return {case: gaps for case, gaps in by_case.items() if gaps}


def _paired(result: Result) -> dict[str, Any]:
    """The differences, with the probability of improvement beside that of RMSE."""
    differences: dict[str, Any] = _plain(result.paired)
    for name, each in result.improvement.items():
        differences[name]["rmse_mm"]["probability_of_improvement"] = _plain(each["rmse_mm"])
    return differences


def _provenance(results: Sequence[Result], command: str) -> dict[str, Any]:
    config, contenders = results[0].case.config(), [sample.contender for sample in results[0].samples]
    return {
        "command": command,
        **software(PACKAGES),
        "contract": contract_hash([result.case for result in results]),
        "plant_hash": config.plant_hash,
        "puller": config.puller.label,
        "parameters": {
            name: value if math.isfinite(value) else None for name, value in config.parameters._asdict().items()
        },
        "control_interval_s": config.control_interval,
        "horizon_s": config.horizon,
        "scenarios": {result.case.name: _crystals(result) for result in results},
        "controllers": {each.name: {name: getattr(each, name) for name in FACTS} for each in contenders},
        "agents": [asdict(policy.contract) for each in contenders for policy in each.trained],
        "bootstrap": {"resamples": RESAMPLES, "seed": SEED, "paired_against": REFERENCE},
        "gap_measured_from": BOUND,
        "gap_from_cached_episodes": {
            result.case.name: len(result.earlier_bound.seeds) for result in results if result.earlier_bound
        },
    }


def _crystals(result: Result) -> dict[str, Any]:
    case, scenario = result.case, result.case.config().sole_scenario
    return {
        "scenario": scenario.name,
        "hash": scenario.hash,
        "model": case.model,
        "control_interval_s": case.control_interval,
        "meniscus": case.meniscus.name,
        "first_seed": result.seeds[0],
        "episodes": len(result.seeds),
    }


def to_csv(results: Sequence[Result]) -> str:
    """Return the text of ``episodes.csv``, one line an episode."""
    rows = (
        (result.case.name, sample.name, training_seed, seed, *(f"{value:.5g}" for value in values))
        for result in results
        for sample in result.samples
        for training_seed, episodes in zip(sample.contender.training_seeds or ("",), sample.values, strict=True)
        for seed, values in zip(sample.seeds, episodes, strict=True)
    )
    text, heads = io.StringIO(), ("scenario", "controller", "training_seed", "seed", *results[0].samples[0].names)
    csv.writer(text, lineterminator="\n").writerows([heads, *rows])
    return text.getvalue()


def read_results(path: Path, metrics: Sequence[str]) -> tuple[dict[str, dict[str, dict[str, Estimate]]], str]:
    """Read a ``benchmark.json``: the estimates of these metrics by scenario and controller, and the contract's hash.

    The hash is empty in a file of an earlier release. Raises CzError for other files.
    """
    with name_file_in_errors(path):
        text = path.read_text("utf-8")
    try:
        content = json.loads(text)
        results = {
            scenario: {
                name: {metric: _estimate(figures[metric]) for metric in metrics} for name, figures in by_name.items()
            }
            for scenario, by_name in content["results"].items()
        }
        return results, str(content.get("provenance", {}).get("contract", ""))
    except (ValueError, KeyError, TypeError, AttributeError):
        raise CzError(f"{path} is no benchmark.json") from None


def _estimate(saved: Mapping[str, Any]) -> Estimate:
    interval = saved.get("ci95")
    return Estimate(float(saved["mean"]), interval and (float(interval[0]), float(interval[1])), saved.get("n", 0))


def read_episodes(path: Path, columns: Sequence[str]) -> Episodes:
    """Read some columns of an ``episodes.csv``, crystals in the file's order.

    Raises CzError if the file is none of a benchmark's, holds what is no finite number, or a controller's training
    seeds did not meet the same number of crystals.
    """
    lines: dict[str, dict[str, dict[str, list[list[float]]]]] = {}
    with name_file_in_errors(path):
        text = path.read_text("utf-8")
    try:
        for line in csv.DictReader(io.StringIO(text)):
            by_seed = lines.setdefault(line["scenario"], {}).setdefault(line["controller"], {})
            by_seed.setdefault(line["training_seed"], []).append([float(line[name]) for name in columns])
        arrays = {
            scenario: {name: np.array([*by_seed.values()]) for name, by_seed in by_name.items()}
            for scenario, by_name in lines.items()
        }
        if not all(np.isfinite(values).all() for by_name in arrays.values() for values in by_name.values()):
            raise ValueError
    except (KeyError, TypeError, ValueError, csv.Error):
        raise CzError(f"{path}: no episodes of a benchmark, or damaged") from None
    return arrays
