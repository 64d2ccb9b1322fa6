"""Running a benchmark: the episodes that are missing are rolled out, in processes side by side, into one table,
which is written with its report.

The rows of slow controllers are kept in files, one a controller and scenario, with hashes of all that they depend on:
those that are there do not run again. An earlier bound is rows of another benchmark's table.
"""

import csv
import hashlib
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd

from cz_gym.agents import OnnxPolicy
from cz_gym.agents.contract import check_environment
from cz_gym.engine.batch import processors
from cz_gym.evaluation.metrics import OUTSIDE, SPEED, names_of, outside
from cz_gym.evaluation.parallel import run_parallel
from cz_gym.evaluation.protocol import BOUND, REFERENCE, SLOW_EPISODES, Case, Contender, find_case
from cz_gym.evaluation.rollout import check_policy, rollout
from cz_gym.evaluation.statistics import RESAMPLES, SEED, Estimate
from cz_gym.jit import PACKAGE, compiled_sources, hash_files
from cz_gym.support.errors import CzError, software
from cz_gym.support.files import check_writable, name_file_in_errors, write_files

from .episodes import CODE, CONTRACT, GAPS, KEYS, Benchmark, read_episodes, read_estimates, to_csv, values_of
from .registry import agent_hash
from .report.tables import ROBUSTNESS, in_player, typical
from .report.task_records import TASKS, TaskRecord, contract_hash, task_of

PRINTED = 1e-4
"""Relative precision of the figures in the bounds' table, five digits [-]."""
COMPUTING = ("numpy", "scipy", "numba")
"""Packages whose version the figures may depend on."""
PICTURES = ("camera", "rendering")
"""Sub-packages that draw: no cached figure depends on them."""
LONG = 5_000_000
"""Number of steps from which on a run is shared between processes, which take seconds to start."""
PROCESSES = 8
"""Largest number of processes of a run, each of which needs some hundred MB."""
BLOCK = 10
"""Episodes that a slow controller runs at once, and that are cached together."""
Rows = tuple[pd.DataFrame, Any]
"""Rows of the table of episodes, and the signals of their first episode."""
Task = tuple[Contender, Case, Sequence[int], Path]
"""One controller on one scenario, the picklable unit of work: with seeds, and the folder of slow controllers' rows."""


def run(
    contenders: Sequence[Contender],
    cases: Sequence[Case],
    episodes: int,
    cached: Path,
    bounds: Path | None = None,
    quiet: bool = False,
    cluster: str | None = None,
    pictures: bool = False,
) -> Benchmark:
    """Roll every contender out on every case, with a progress bar unless ``quiet``, and estimate.

    For ``pictures`` the typical crystal of each case is rolled out again, to know its signals.

    ``cached`` is the folder of slow controllers' rows, ``bounds`` that of an earlier benchmark whose bound serves a run
    without one. A long run is shared between processes, any run between the workers of a ``cluster``.
    """
    from tqdm import tqdm

    tasks: list[Task] = [
        (each, case, episodes_of(each, case, episodes), cached.absolute()) for case in cases for each in contenders
    ]
    steps = sum(map(_steps, tasks))
    # The first task compiles for all.
    alone = 0 if cluster else 1 if steps > LONG else len(tasks)
    with tqdm(total=steps, unit="step", unit_scale=True, leave=False, disable=quiet or None) as bar:
        done = _run_all(tasks, alone, bar, cluster)
        table = pd.concat([rows for rows, _ in done], ignore_index=True)
        signals = {(task[1].name, task[0].name): first for task, (_, first) in zip(tasks, done, strict=True)}
        earlier = earlier_bound(bounds, table, cases, contenders) if bounds else None
        robust = earlier_robustness(bounds.parent / "robustness" / "robustness.csv") if bounds else {}
        benchmark = Benchmark.of(cases, contenders, table, signals, earlier, robust)
        if pictures:
            more = typical_tasks(benchmark, cached)
            bar.reset(sum(map(_steps, more)))
            done = _run_all(more, 0 if alone < len(tasks) else len(more), bar, cluster)
            signals |= {(task[1].name, task[0].name): first for task, (_, first) in zip(more, done, strict=True)}
    return benchmark


def _run_all(tasks: Sequence[Task], alone: int, bar: Any, cluster: str | None) -> list[Rows]:
    """Run tasks, the first ``alone`` of them in this process, and the others side by side or on a cluster."""
    done: dict[int, Rows] = {}
    for number, task in enumerate(tasks[:alone]):
        bar.set_description(f"{task[1].name}, {task[0].name}")
        done[number] = run_task(task, bar.update)
    workers = min(processors(), PROCESSES)
    for place, rows in run_parallel(run_task, tasks[alone:], cluster=cluster, processes=workers):
        done[alone + place] = rows
        bar.update(_steps(tasks[alone + place]))
    return [done[number] for number in range(len(tasks))]


def _steps(task: Task) -> int:
    """Number of environment steps of a task, with those of every training seed."""
    contender, case, seeds, _ = task
    return case.config().steps * len(seeds) * max(len(contender.trained), 1)


def typical_tasks(benchmark: Benchmark, cached: Path) -> list[Task]:
    """Return the tasks that give the signals of each case's :func:`.typical` crystal where it is not the first.

    They are of the controllers that pictures show, of an agent with its first training seed.
    """
    numbers = [(case, typical(benchmark, case)) for case in benchmark.cases]
    return [
        (replace(each, trained=each.trained[:1], training_seeds=each.training_seeds[:1]), case,
         [benchmark.seeds(case)[number]], cached.absolute())
        for case, number in numbers if number for each in in_player(benchmark, case)
    ]  # fmt: skip


def run_task(task: Task, progress: Callable[[int], Any] = lambda steps: None) -> Rows:
    """Return the rows of a controller on a scenario.

    Those of a slow controller run in blocks unless they are cached; its first episode always runs, for its signals.
    """
    contender, case, seeds, folder = task
    if not contender.slow:
        return roll_out(contender, case, seeds, progress)
    code, file = code_of(contender, case), folder / f"{contender.name}-{case.name}.csv"
    known, others = cached_rows(file, case, code)
    left = [seeds[0], *sorted({*seeds[1:]} - {*known["seed"]})] if len(known) else list(seeds)
    progress(case.config().steps * (len(seeds) - len(left)))
    signals = None
    for first in range(0, len(left), BLOCK):
        rows, found = roll_out(contender, case, left[first : first + BLOCK], progress, code)
        signals = signals or found
        known = pd.concat([known, rows[~rows["seed"].isin(known["seed"])]], ignore_index=True)
        write_files({file: to_csv(pd.concat([others, known], ignore_index=True))})
    return known[known["seed"].isin(seeds)].sort_values("seed"), signals


def roll_out(
    contender: Contender, case: Case, seeds: Sequence[int], progress: Callable[[int], Any], code: str = ""
) -> Rows:
    """Roll a contender out on some episodes of a case, with each of its training seeds."""
    interface, task = (contender.observation, contender.action), task_of(case)
    config, designed_for = case.config(*interface), case.design_config(*interface)
    parts, signals = [], None
    for number, policy in enumerate(contender.policies(designed_for)):
        run = rollout(policy, config, seeds, progress, designed_for)
        signals = run.episode(0) if signals is None else signals
        trained = str(contender.training_seeds[number]) if contender.training_seeds else ""
        rows = pd.DataFrame(dict(zip(KEYS, (case.name, contender.name, trained, list(run.seeds)), strict=True)))
        rows[list(names_of(task.metrics))] = np.stack(task.measure(run), axis=-1)
        rows[SPEED] = run.microseconds_per_step
        if case.tolerance:
            rows[OUTSIDE] = outside(run, case.tolerance)
        parts.append(rows.assign(**{CONTRACT: contract_hash([case]), CODE: code}))
    return pd.concat(parts, ignore_index=True), signals


def check_agents(contenders: Sequence[Contender], cases: Sequence[Case]) -> None:
    """Raise CzError for an agent, or the user's own controller, that was made for another environment than a case has,
    its control interval say.
    """
    for each in contenders:
        for case in cases:
            config, kind = case.design_config(each.observation, each.action), "agent" if each.learned else "controller"
            for policy in each.policies(config) if each.own else each.trained:
                try:
                    if isinstance(policy, OnnxPolicy):
                        check_environment(policy.contract, config, "its file")
                    check_policy(policy, config)
                except CzError as error:
                    raise CzError(f"{kind} {each.name!r} on {case.name}: {error}") from None


def episodes_of(contender: Contender, case: Case, episodes: int) -> range:
    """Return the seeds of the episodes of a case that a contender meets."""
    return case.seeds(min(episodes, SLOW_EPISODES) if contender.slow else episodes)


# Rows that are there already.


def is_cached(contender: Contender, cases: Sequence[Case], episodes: int, folder: Path) -> bool:
    """Return whether every episode of a slow controller is in the folder, so that it may take part unasked."""
    try:
        for case in cases:
            known, _ = cached_rows(folder / f"{contender.name}-{case.name}.csv", case, code_of(contender, case))
            if not {*episodes_of(contender, case, episodes)} <= {*known["seed"]}:
                return False
    except ImportError:  # what it needs is not installed
        return False
    return True


def cached_rows(file: Path, case: Case, code: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the rows of a file that this contract and code would give again, and the others; none if it is damaged."""
    columns = [*KEYS, *names_of(task_of(case).metrics), SPEED, *([OUTSIDE] if case.tolerance else []), CONTRACT, CODE]
    empty = pd.DataFrame(columns=columns)
    try:
        table = read_episodes(file)[columns]
    except (CzError, KeyError):
        return empty, empty
    same = (table[CONTRACT] == contract_hash([case])) & (table[CODE] == code)
    return table[same], table[~same]


def code_of(contender: Contender, case: Case) -> str:
    """Hash the settings and the code of a slow controller, whose policy has a ``hash``, and what computes with it."""
    config = case.design_config(contender.observation, contender.action)
    policy, versions = contender.make(config), software(COMPUTING)["packages"]
    parts = [contender.observation, contender.action, policy.hash, code_behind(type(policy).__module__), versions]
    return hashlib.sha256(json.dumps([*parts, case.tolerance]).encode()).hexdigest()[:16]


@cache
def code_behind(module: str) -> str:
    """Hash all code that the episodes of a policy of that module come from, comments and docstrings left out."""
    return hash_files(sources_behind(module))


def sources_behind(module: str) -> list[Path]:
    """Sources of a policy's figures: plant, environment, metrics, and its module, or its package if that is ours."""
    plant = [file for file in compiled_sources() if file.relative_to(PACKAGE).parts[0] not in PICTURES]
    metrics = [PACKAGE / "evaluation" / name for name in ("rollout.py", "metrics.py")]
    package = ".".join(module.split(".")[:2]) if module.startswith("cz_gym.") else module
    file = Path(str(sys.modules[package].__file__))
    return plant + metrics + (sorted(file.parent.rglob("*.py")) if file.name == "__init__.py" else [file])


def earlier_bound(
    folder: Path, episodes: pd.DataFrame, cases: Sequence[Case], contenders: Sequence[Contender]
) -> pd.DataFrame | None:
    """Return the rows of the bound from a folder of benchmark results, of the scenarios where they can be used.

    The bound must not have taken part, must have met a scenario's first episodes, and each classical controller of
    both runs must have the same figures now as then: a plant or code that moves those moves the bound.
    """
    try:
        table = read_episodes(folder / "episodes.csv", [*GAPS])
    except CzError:
        return None
    classical, found = {each.name for each in contenders if not each.learned}, []
    for case in cases:
        now, then = (dict(list(t[t["scenario"] == case.name].groupby("controller"))) for t in (episodes, table))
        bound, both = then.get(BOUND), classical & now.keys() & then.keys()
        if bound is None or BOUND in now or not both:
            continue
        if bound["seed"].tolist() == list(case.seeds(len(bound))) and all(_agree(now[n], then[n]) for n in both):
            found.append(bound)
    return pd.concat(found) if found else None


def earlier_robustness(file: Path) -> dict[str, tuple[str, ...]]:
    """Return the figures of ``studies.robustness`` by controller; none of another contract or agent file."""
    if not file.is_file():
        return {}
    rows = [row for row in csv.DictReader(file.read_text("utf-8").splitlines()) if {"contract", "agent"} <= row.keys()]
    contract = contract_hash([find_case("randomized", TASKS["Cz-v0"].cases)])
    current = [row for row in rows if (row["contract"], row["agent"]) == (contract, agent_hash(row["controller"]))]
    return {row["controller"]: tuple(row[name] for name in ROBUSTNESS) for row in current}


def _agree(now: pd.DataFrame, then: pd.DataFrame) -> bool:
    """Return whether a controller has the figures it had earlier, on the crystals of both."""
    both, columns = min(len(now), len(then)), ["seed", *GAPS]
    ours, theirs = (values_of(rows.iloc[:both], columns) for rows in (now, then))
    return np.allclose(ours, theirs, rtol=PRINTED)


PACKAGES = ("cz-gym", "gymnasium", "numpy", "scipy", "numba", "onnxruntime")
"""Packages whose versions are recorded."""
FACTS = ("name", "observation", "meaning", "training_seeds", "privileged", "slow", "action", "told", "own")
"""Fields of a contender that are recorded."""
RESULTS, EPISODES = "benchmark.json", "episodes.csv"
FILES = (RESULTS, EPISODES, "report.md", "report.html", "result.svg", "crystal.png", "pareto.svg")
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
        raise CzError(f"{present[0]} exists. Use --out runs/NAME (--overwrite would replace it)")
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
                    "cost_difference": _plain(difference),
                    "rmse_mm_difference": _plain(benchmark.verdicts(case, "rmse_mm")[agent]),
                    "wins": benchmark.outranks(case, agent) is True,
                }
                for agent, difference in benchmark.verdicts(case).items()
            }
            for case in benchmark.cases
        },
        "provenance": _provenance(benchmark, command),
    }
    return json.dumps(data, indent=1, allow_nan=False) + "\n"


def read_benchmark(path: Path) -> Benchmark:
    """Read a ``benchmark.json`` back: means of the metrics that everyone has, and who met what; no signals.

    Raises CzError for other files.
    """
    read_estimates(path, ())
    content = json.loads(path.read_text("utf-8"))
    results, facts = content["results"], content["provenance"]
    task = next((each for each in TASKS.values() if {*results} <= {case.name for case in each.cases}), None)
    if task is None:
        raise CzError(f"{path}: scenarios of the user's own, which are not in the file")
    everyone = [found for of in results.values() for found in of.values()]
    metrics = [name for name in names_of(task.metrics) if all(found[name]["mean"] is not None for found in everyone)]
    met = [
        (case, name, "", facts["scenarios"][case]["first_seed"] + crystal)
        for case, of in results.items() for name, found in of.items() for crystal in range(found[metrics[0]]["n"])
    ]  # fmt: skip
    episodes = pd.DataFrame(met, columns=[*KEYS])
    frame, _ = read_estimates(path, metrics)
    cases = tuple(find_case(name, task.cases) for name in results)
    return Benchmark(cases, tuple(_who_took_part(facts, task)), episodes, frame, {}, episodes.iloc[:0])


def _who_took_part(provenance: Mapping[str, Any], task: TaskRecord) -> Iterator[Contender]:
    """The contenders of a file of results: named controllers, and others that know what they are and cannot run."""
    known, contracts = {each.name: each for each in task.controllers()}, iter(provenance["agents"])
    for each in provenance["controllers"].values():
        seeds = tuple(each["training_seeds"])
        trained = tuple(SimpleNamespace(contract=SimpleNamespace(**next(contracts))) for _ in seeds)
        made = Contender(**{**each, "training_seeds": seeds, "trained": trained, "make": _not_here})
        yield known.get(made.name, made)


def _not_here(config: Any) -> Any:
    raise CzError("a controller of a file of results is not there to run")


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
        "agents": [policy.contract.facts for each in contenders for policy in each.trained],
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
