"""Model cards of the shipped agents, with the benchmark's figures: training, results and failures."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cz_gym.agents import shipped_seeds
from cz_gym.agents.agent_file.contract import Contract, read_agent
from cz_gym.atomic_files import check_writable, naming, write_files
from cz_gym.commands import OneLineParser
from cz_gym.errors import CzError
from cz_gym.evaluation.report.tables import markdown as table

AGENTS = {
    "gradient": "analytic policy gradients: the cost's gradient through policy and plant; the plant is known",
    "ppo": "proximal policy optimisation from nothing, from the reward",
    "sac": "soft actor-critic from nothing, from the reward",
}
"""Shipped agents, and how each learned."""
FIGURES = {
    "rmse_mm": "RMSE [mm]",
    "rmse_observable_mm": "observable RMSE [mm]",
    "pull_step_rms_mm_per_min": "pull step RMS [mm/min]",
    "failure_rate": "lost [%]",
}
"""Metrics of a card, and their heads."""
Results = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""The benchmark's estimates, by scenario, controller and metric."""


def read_results(path: Path) -> Results:
    """Results of a benchmark.json with all shipped agents; CzError for another file."""
    try:
        with naming(path):
            results: Results = json.loads(path.read_text("utf-8"))["results"]
        for by_name in results.values():
            for name in AGENTS:
                for metric in FIGURES:
                    float(by_name[name][metric]["mean"])
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError):
        raise CzError(f"{path}: no benchmark.json with {', '.join(AGENTS)}") from None
    return results


def card(name: str, how: str, contracts: Sequence[Contract], results: Results) -> str:
    """An agent's section."""
    first = contracts[0]
    rows = [
        [scenario, *(_estimate(of[name][metric], 100.0 if metric == "failure_rate" else 1.0) for metric in FIGURES)]
        for scenario, of in results.items()
    ]
    fails = [f"`{scenario}`" for scenario, of in results.items() if of[name]["failure_rate"]["mean"] > 0.0]
    return "\n".join(
        [
            f"## `{name}`",
            "",
            f"- How it learned: {how}.",
            f"- Saw: crystals of {first.scenario}; {_steps(contracts)} a run.",
            f"- Reads: `{first.observation}`; acts every {first.control_interval:g} s; its action is `{first.action}`.",
            f"- Training seeds: {len(contracts)}. `agents.load({name!r})` is the one of least validation cost.",
            "- Fails: " + (f"loses crystals of {', '.join(fails)}." if fails else "on none of these."),
            "",
            table(["scenario", *FIGURES.values()], rows),
            "",
        ]
    )


def _steps(contracts: Sequence[Contract]) -> str:
    """Number of environment steps that a run learned from."""
    taken = [contract.training_steps / 1e6 for contract in contracts]
    steps = [f"{least_or_most(taken):.0f}" for least_or_most in (min, max)]
    return f"{' to '.join(dict.fromkeys(steps))} million steps"


def _estimate(found: Mapping[str, Any], scale: float) -> str:
    mean, interval = scale * float(found["mean"]), found.get("ci95")
    digits = 1 if scale > 1.0 else 4
    if interval is None:
        return f"{mean:.{digits}f}"
    low, high = (scale * float(each) for each in interval)
    return f"{mean:.{digits}f} [{low:.{digits}f}, {high:.{digits}f}]"


ABOUT = """# Model cards

What each shipped agent saw, what it reaches and where it fails, on test crystals that took no part in its training. All
training seeds of a name are pooled; in brackets the 95 % interval over crystals and training seeds. The figures are of
[the benchmark](../benchmark/report.md); `python -m studies.cards` wrote this page.

No agent was trained or tested on a real puller: none may control one. The linear loop of `gradient` has an unstable
mode, which its schedule keeps small.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.cards", __doc__)
    for option, default, about in (
        ("--benchmark", "results/benchmark/benchmark.json", "results"),
        ("--out", "results/cards/cards.md", "file to write"),
    ):
        parser.add_argument(option, type=Path, default=Path(default), help=f"{about} (default: %(default)s)")
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    check_writable(given.out.parent)
    results = read_results(given.benchmark)
    cards = [
        card(name, of, [read_agent(each)[0] for each in shipped_seeds(name)], results) for name, of in AGENTS.items()
    ]
    write_files({given.out: "\n".join([ABOUT, *cards]).encode()})
    print(f"wrote {given.out}")


if __name__ == "__main__":
    sys.exit(main())
