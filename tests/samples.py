"""Benchmarks of a few made-up or quickly rolled out episodes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd

from cz_gym.baselines.lqg import LQG, LQGDesign
from cz_gym.baselines.tuned import with_values
from cz_gym.evaluation.metrics import OUTSIDE, SPEED, names_of, outside
from cz_gym.evaluation.protocol import Case, Contender, find_case
from cz_gym.evaluation.rollout import Rollout, rollout
from cz_gym.tools.episodes import KEYS, Benchmark
from cz_gym.tools.registry import find_controller
from cz_gym.tools.report.tables import typical
from cz_gym.tools.report.task_records import task_of

NOMINAL_LQG = LQG(
    design=with_values(
        LQGDesign(),
        {
            "weights.pull": 0.008875, "weights.pull_step": 0.025, "weights.heater_step": 2.578,
            "noise.fast_sd": 0.2618, "noise.slow_sd": 0.2928, "noise.drift_rate_sd": 0.000594,
            "noise.drift_rate_tau": 2651.0, "noise.heater_walk": 0.2195, "noise.thermal_walk": 0.001497,
            "noise.pyrometer_sd": 0.04472, "noise.recipe_share": 0.1782,
        },
    )
)  # fmt: skip
"""An LQG tuned on nominal hot zones alone: it is precise there, and unstable on some others."""


def contender(name: str, meaning: str = "", training_seeds: tuple[int, ...] = (), **facts: Any) -> Contender:
    """A contender that is never run; an agent if it has training seeds."""
    policy = SimpleNamespace(contract=SimpleNamespace(learned_from="reward"))
    trained: tuple[Any, ...] = (policy,) * len(training_seeds)
    facts = {"observation": "measured", "make": lambda config: None, **facts}
    return Contender(name, meaning=meaning, training_seeds=training_seeds, trained=trained, **facts)


def made_rows(case: Case, who: Contender, values: Mapping[str, Any], seeds: Sequence[int] | None = None) -> Any:
    """Rows of a controller: metrics as arrays of shape (training seeds or 1, crystals); the others are zero."""
    arrays = {name: np.atleast_2d(np.asarray(each, float)) for name, each in values.items()}
    crystals, parts = next(iter(arrays.values())).shape[1], []
    for number, trained in enumerate(who.training_seeds or ("",)):
        rows = pd.DataFrame({"seed": [*(seeds or range(crystals))]})
        rows = rows.assign(scenario=case.name, controller=who.name, training_seed=str(trained))[[*KEYS]]
        rows[list(names_of(task_of(case).metrics))] = 0.0
        for name, each in arrays.items():
            rows[name] = each[min(number, len(each) - 1)]
        parts.append(rows.assign(**{SPEED: 1.0}))
    return pd.concat(parts, ignore_index=True)


def made(cases: Case | Sequence[Case], *samples: tuple[Contender, Mapping[str, Any]], **more: Any) -> Benchmark:
    """A benchmark of made-up metrics, the same on every case."""
    every = [cases] if isinstance(cases, Case) else cases
    rows = pd.concat([made_rows(case, who, values) for case in every for who, values in samples], ignore_index=True)
    return Benchmark.of(every, [who for who, _ in samples], rows, more.pop("signals", {}), **more)


def rolled_out(case: Case, samples: Sequence[tuple[Contender, Rollout]]) -> Benchmark:
    """A benchmark of rollouts on one case; an agent's training seeds all have the same."""
    names, parts = names_of(task_of(case).metrics), []
    for who, run in samples:
        values = dict(zip(names, task_of(case).measure(run), strict=True))
        extra = {OUTSIDE: outside(run, case.tolerance)} if case.tolerance else {}
        parts.append(made_rows(case, who, values | extra, run.seeds))
    known = Benchmark.of([case], [who for who, _ in samples], pd.concat(parts, ignore_index=True), {})
    drawn = typical(known, case)
    return replace(known, signals={(case.name, who.name): run.episode(drawn) for who, run in samples})


def joined(benchmarks: Sequence[Benchmark]) -> Benchmark:
    """One benchmark of the same controllers on several cases."""
    cases, signals = (
        [each.cases[0] for each in benchmarks],
        {k: v for one in benchmarks for k, v in one.signals.items()},
    )
    rows = pd.concat([each.episodes for each in benchmarks], ignore_index=True)
    return Benchmark.of(cases, benchmarks[0].contenders, rows, signals)


def result_of(
    name: str, names: Sequence[str], last: str, training_seeds: tuple[int, ...] = (4,), fewer: int = 0
) -> tuple[Benchmark, dict[str, Rollout]]:
    """A benchmark of controllers on three crystals (one of a scenario without randomness), and their rollouts.

    The last is shown as an agent of that name, trained with the given seeds, and meets ``fewer`` crystals less.
    """
    case, samples, runs = find_case(name), [], {}
    config, seeds = case.config(), case.seeds(3)
    for who in names:
        learned = who == names[-1]
        met = seeds[: len(seeds) - fewer * learned] or seeds
        runs[who] = run = rollout(find_controller(who).make(config), config, met)
        agent = contender(last, f"agent trained with {last}", training_seeds)
        samples.append((agent if learned else contender(who, f"what {who} is", quoted=who == "paper"), run))
    return rolled_out(case, samples), runs
