"""A benchmark as one table of episodes, and the tidy table of estimates that is computed from it.

A row of the episodes is one crystal under one controller: scenario, controller, training seed, seed, every metric, the
time of the policy, and hashes of what the figures rest on. A row of the estimates is one number with its 95 % interval:
scenario, controller, metric, kind, what it is measured against, mean, low, high, number of crystals.
"""

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import pandas as pd

from cz_gym.evaluation.metrics import OUTSIDE, SPEED
from cz_gym.evaluation.protocol import BOUND, REFERENCE, Case, Contender
from cz_gym.evaluation.rollout import Floats
from cz_gym.evaluation.statistics import (
    Estimate,
    Resamples,
    cvar,
    differences,
    means,
    optimality_gap,
    probability_of_improvement,
)
from cz_gym.support.errors import CzError
from cz_gym.support.files import name_file_in_errors

KEYS = ("scenario", "controller", "training_seed", "seed")
"""Columns that name an episode; a controller that is not trained has the training seed ""."""
CONTRACT, CODE = "contract", "code"
"""Columns of the hash of plant, scenario, reward and metrics, and of a slow controller's code and settings."""
GAPS = {"cost": 1, "rmse_mm": 2}
"""Metrics of which optimality gaps are made, with their powers."""
TAIL_METRICS = ("rmse_mm", "rmse_observable_mm", "max_error_mm")
"""Metrics whose worst 5 % are reported."""
LOSSES, COST = "failure_rate", "cost"
"""Metrics that rank controllers: the lower end of the first one's interval, then the second one's mean."""
LARGEST = 0.95
"""Level of the quantiles that are reported of :data:`LARGEST_ERRORS` [-]."""
LARGEST_ERRORS = ("crown_max_mm", "tail_max_mm", "max_error_mm")
ESTIMATES = ("scenario", "controller", "metric", "kind", "against", "mean", "low", "high", "n")
"""Columns of the estimates.

Kinds: "mean"; "cvar", the mean of the worst 5 % of the episodes; "quantile" at :data:`LARGEST`; "difference" of the
means from the reference's on the same crystals; "improvement", the probability of a lower value than the reference's;
"gap" (J - J_bound) / (J_reference - J_bound); "verdict", the difference of an agent's mean from that of the classical
controller that ranks first.
"""
Line = tuple[str, str, str, str, str, float, float, float, int]


def values_of(rows: pd.DataFrame, metrics: Sequence[str]) -> Floats:
    """Return metrics of one controller on one scenario, shape (training seeds, crystals, metrics).

    Raises ValueError if the training seeds did not meet the same number of crystals.
    """
    values = np.ascontiguousarray(rows[[*metrics]].to_numpy(np.float64))
    return values.reshape(rows["training_seed"].nunique(), -1, len(metrics))


def estimates(
    episodes: pd.DataFrame,
    agents: Sequence[str] = (),
    rivals: Sequence[str] = (),
    earlier_bound: pd.DataFrame | None = None,
) -> pd.DataFrame:
    """Estimate means, tails, paired differences, gaps and verdicts of a table of episodes, a scenario at a time.

    Controllers that met the same crystals share their resamples; those that met different numbers are compared on the
    first ones, which all met. Verdicts compare each of the ``agents`` with the best of the ``rivals``. Rows of an
    ``earlier_bound`` stand in where :data:`BOUND` did not take part.
    """
    lines: list[Line] = []
    resamples = cache(Resamples.draw)
    for scenario, rows in episodes.groupby("scenario", sort=False):
        by_name = {str(name): own for name, own in rows.groupby("controller", sort=False)}
        bound = by_name.get(BOUND)
        if bound is None and earlier_bound is not None:
            found = earlier_bound[earlier_bound["scenario"] == scenario]
            bound = found if len(found) else None
        table = _Scenario(by_name, bound, resamples)
        for found in (table.own(), table.compared(), table.verdicts(agents, rivals)):
            lines += [
                (str(scenario), name, metric, kind, against, each.mean, *(each.ci95 or (np.nan, np.nan)), each.n)
                for name, metric, kind, against, each in found
            ]
    return pd.DataFrame(lines, columns=[*ESTIMATES])


class _Scenario:
    """The episodes of one scenario as arrays, and their estimates: name, metric, kind, against, estimate."""

    def __init__(self, rows: Mapping[str, pd.DataFrame], bound: pd.DataFrame | None, resamples: Any) -> None:
        self.rows, self.bound, self.resamples = rows, bound, resamples
        others = (*KEYS, SPEED, OUTSIDE, CONTRACT, CODE)
        self.metrics = [name for name in next(iter(rows.values())).columns if name not in others]
        self.values = {name: values_of(own, self.metrics) for name, own in rows.items()}

    def first(self, name: str, crystals: int) -> Floats:
        return self.values[name][:, :crystals]

    def crystals(self, *names: str) -> int:
        return min(len(self.values[name][0]) for name in names)

    def own(self) -> Iterator[tuple[str, str, str, str, Estimate]]:
        """Estimates of each controller alone: means, the worst 5 %, quantiles."""
        for name, values in self.values.items():
            crystals = values.shape[1]
            draw = self.resamples(crystals)
            for metric, estimate in zip(self.metrics, means(values, draw), strict=True):
                yield name, metric, "mean", "", estimate
            yield name, SPEED, "mean", "", Estimate(float(self.rows[name][SPEED].mean()), None, crystals)
            if OUTSIDE in self.rows[name]:
                yield name, OUTSIDE, "mean", "", means(values_of(self.rows[name], [OUTSIDE]), draw)[0]
            for metric in (each for each in TAIL_METRICS if each in self.metrics):
                yield name, metric, "cvar", "", cvar(self.one(name, metric), draw)
            for metric in (each for each in LARGEST_ERRORS if each in self.metrics):
                known = self.one(name, metric)
                if (known := known[~np.isnan(known)]).size:
                    yield name, metric, "quantile", "", Estimate(float(np.quantile(known, LARGEST)), None, crystals)

    def one(self, name: str, metric: str, crystals: int | None = None) -> Floats:
        """One metric, shape (training seeds, crystals)."""
        return self.values[name][:, :crystals, self.metrics.index(metric)]

    def compared(self) -> Iterator[tuple[str, str, str, str, Estimate]]:
        """Differences from the reference, probabilities of improvement, and gaps."""
        if REFERENCE not in self.values:
            return
        for name in self.values:
            both = self.crystals(name, REFERENCE)
            if name != REFERENCE:
                ours, theirs, draw = self.first(name, both), self.first(REFERENCE, both), self.resamples(both)
                for metric, estimate in zip(self.metrics, differences(ours, theirs, draw), strict=True):
                    yield name, metric, "difference", REFERENCE, estimate
                errors = self.one(name, "rmse_mm", both), self.one(REFERENCE, "rmse_mm", both)
                yield name, "rmse_mm", "improvement", REFERENCE, probability_of_improvement(*errors, draw)
            if self.bound is None:
                continue
            best = values_of(self.bound, [*GAPS])
            fewest = min(both, best.shape[1])
            for place, (metric, power) in enumerate(GAPS.items()):
                ours, theirs = (self.one(each, metric, fewest) ** power for each in (name, REFERENCE))
                gap = optimality_gap(ours, theirs, best[:, :fewest, place] ** power, self.resamples(fewest))
                if gap:
                    yield name, metric, "gap", BOUND, gap

    def verdicts(self, agents: Sequence[str], rivals: Sequence[str]) -> Iterator[tuple[str, str, str, str, Estimate]]:
        """Differences of each agent's cost and RMSE from those of the rival that ranks first on their crystals."""
        known = [name for name in self.values if name in rivals]
        if not known:
            return
        fewest = self.crystals(*known)

        def rank(name: str) -> tuple[float, float]:
            lost = means(self.one(name, LOSSES, fewest)[:, :, None], self.resamples(fewest))[0]
            return lost.ends[0], float(self.one(name, COST, fewest).mean())

        rival = min(known, key=rank)
        for name in (each for each in self.values if each in agents):
            both = self.crystals(name, rival)
            for metric in (COST, "rmse_mm"):
                ours, theirs = (self.one(each, metric, both)[:, :, None] for each in (name, rival))
                yield name, metric, "verdict", rival, differences(ours, theirs, self.resamples(both))[0]


Key = tuple[str, str, str, str]
"""Scenario, controller, metric and kind."""


def by_key(frame: pd.DataFrame) -> dict[Key, Estimate]:
    """Return the estimates of a tidy table by scenario, controller, metric and kind."""
    return {
        (row.scenario, row.controller, row.metric, row.kind): Estimate(
            row.mean, None if np.isnan(row.low) else (row.low, row.high), row.n
        )
        for row in frame.itertuples(index=False)
    }


@dataclass(frozen=True)
class Benchmark:
    """Controllers on scenarios: the episodes, what was estimated of them, and who took part."""

    cases: tuple[Case, ...]
    contenders: tuple[Contender, ...]
    episodes: pd.DataFrame
    estimates: pd.DataFrame
    signals: Mapping[tuple[str, str], Any]
    """Logged signals of each scenario's typical crystal by scenario and controller, of the first training seed."""
    earlier_bound: pd.DataFrame
    """Rows of :data:`BOUND` from an earlier run, of scenarios where gaps are measured from them."""
    robustness: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Measured robustness by controller, from an earlier study."""

    @classmethod
    def of(
        cls,
        cases: Sequence[Case],
        contenders: Sequence[Contender],
        episodes: pd.DataFrame,
        signals: Mapping[tuple[str, str], Any],
        earlier_bound: pd.DataFrame | None = None,
        robustness: Mapping[str, tuple[str, ...]] = {},
    ) -> Self:
        """Estimate everything of these episodes."""
        able = [each for each in contenders if not each.bound]
        agents, rivals = ([each.name for each in able if each.learned == learned] for learned in (True, False))
        earlier = episodes.iloc[:0] if earlier_bound is None else earlier_bound
        frame = estimates(episodes, agents, rivals, earlier)
        return cls(tuple(cases), tuple(contenders), episodes, frame, signals, earlier, robustness)

    def only(self, cases: Sequence[Case] | None = None, contenders: Sequence[Contender] | None = None) -> Self:
        """Return the same benchmark with some of its scenarios or controllers."""
        cases, contenders = (self.cases if cases is None else cases), contenders or self.contenders
        return replace(self, cases=tuple(cases), contenders=tuple(contenders))

    @cached_property
    def _known(self) -> dict[Key, Estimate]:
        return by_key(self.estimates)

    @cached_property
    def _groups(self) -> dict[Any, pd.DataFrame]:
        return dict(list(self.episodes.groupby(["scenario", "controller"], sort=False)))

    def get(self, case: Case, name: str, metric: str, kind: str = "mean") -> Estimate | None:
        """Return an estimate; None where there is none."""
        return self._known.get((case.name, name, metric, kind))

    def mean(self, case: Case, name: str, metric: str) -> float:
        """Return the mean of a metric over crystals and training seeds."""
        return self._known[case.name, name, metric, "mean"].mean

    def rank(self, cases: Sequence[Case], name: str) -> tuple[float, float]:
        """Return what ranks a controller on scenarios, the lower the better: crystals lost, then cost.

        Losses count by the lower end of their interval, so that a few lost crystals, which another draw might not have
        lost, decide nothing; both are means over the scenarios.
        """
        lost = (self._known[case.name, name, LOSSES, "mean"].ends[0] for case in cases)
        cost = (self.mean(case, name, COST) for case in cases)
        return round(sum(lost) / len(cases), 9), sum(cost) / len(cases)

    def values(self, case: Case, name: str, metric: str) -> Floats:
        """Return a metric of every episode, shape (training seeds, crystals)."""
        return values_of(self._groups[case.name, name], [metric])[:, :, 0]

    def seeds(self, case: Case, name: str | None = None) -> tuple[int, ...]:
        """Return the seeds of the crystals that a controller met, or of those that anyone met."""
        names = [name] if name else [each.name for each in self.contenders]
        groups = (self._groups[case.name, each] for each in names)
        met = (own["seed"][: len(own) // own["training_seed"].nunique()] for own in groups)
        return tuple(int(seed) for seed in max(met, key=len))

    def rival(self, case: Case) -> str | None:
        """Return the classical controller that the verdicts on a scenario compare with."""
        of = self.estimates[(self.estimates["scenario"] == case.name) & (self.estimates["kind"] == "verdict")]
        return None if of.empty else str(of["against"].iloc[0])

    def verdicts(self, case: Case, metric: str = COST) -> dict[str, Estimate]:
        """Return the difference of each agent's mean of a metric from the rival's, by agent."""
        names = [each.name for each in self.contenders]
        found = {name: self.get(case, name, metric, "verdict") for name in names}
        return {name: each for name, each in found.items() if each}

    def outranks(self, case: Case, agent: str) -> bool | None:
        """Return whether an agent ranks before the rival of its verdict; None where no difference is shown."""
        (lost, _), (rivals, _) = (self.rank([case], name) for name in (agent, str(self.rival(case))))
        low, high = self.verdicts(case)[agent].ends
        if lost != rivals:
            return lost < rivals
        return True if high < 0.0 else False if low > 0.0 else None


# Tables as files.


def to_csv(episodes: pd.DataFrame) -> bytes:
    """Return the text of ``episodes.csv``: every digit, so that it gives the same estimates when it is read back."""
    text: str = episodes.to_csv(index=False, lineterminator="\n", na_rep="nan")
    return text.encode()


def read_episodes(path: Path, columns: Sequence[str] | None = None) -> pd.DataFrame:
    """Read a table of episodes with these columns besides :data:`KEYS` (None: all of them).

    Raises CzError if the file is none of a benchmark's, holds what is no finite number in these columns, or a
    controller's training seeds did not meet the same number of crystals.
    """
    with name_file_in_errors(path):
        text = path.read_text("utf-8")
    try:
        table = pd.read_csv(io.StringIO(text), dtype=str, keep_default_na=False)
        table = table[[*KEYS, *columns]] if columns else table
        numbers = table.columns.difference([*KEYS, CONTRACT, CODE])
        table = table.astype(dict.fromkeys(numbers, float) | {"seed": int})
        for _, rows in table.groupby(["scenario", "controller"]):
            if not np.isfinite(values_of(rows, ["seed", *(columns or ())])).all():
                raise ValueError
    except (KeyError, TypeError, ValueError, csv.Error):
        raise CzError(f"{path}: no episodes of a benchmark, or damaged") from None
    return table


def read_estimates(path: Path, metrics: Sequence[str]) -> tuple[pd.DataFrame, str]:
    """Read a ``benchmark.json``: the means of these metrics as a table of estimates, and the contract's hash.

    The hash is empty in a file of an earlier release. Raises CzError for other files.
    """
    with name_file_in_errors(path):
        text = path.read_text("utf-8")
    try:
        content, lines = json.loads(text), []
        for scenario, of in content["results"].items():
            for name, figures in of.items():
                for metric in metrics:
                    mean, ends = float(figures[metric]["mean"]), figures[metric].get("ci95") or (np.nan, np.nan)
                    low, high = map(float, ends)
                    lines.append((scenario, name, metric, "mean", "", mean, low, high, figures[metric].get("n", 0)))
        return pd.DataFrame(lines, columns=[*ESTIMATES]), str(content.get("provenance", {}).get("contract", ""))
    except (ValueError, KeyError, TypeError, AttributeError):
        raise CzError(f"{path} is no benchmark.json") from None
