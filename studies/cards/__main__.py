"""Write a card of each shipped agent from the benchmark's results: what it saw, what it reaches, where it fails."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cz_gym.agents import MODELS, shipped_seeds
from cz_gym.agents.agent_file.contract import Contract, read_agent
from cz_gym.agents.training.recipes import RECIPES, Gradient, Imitation
from cz_gym.atomic_files import check_writable, naming, write_files
from cz_gym.commands import OneLineParser
from cz_gym.errors import CzError
from cz_gym.evaluation.report.tables import markdown as table
from studies.algorithms.variants import ALGORITHMS

_LEARNED = {row.name: row.meaning for row in ALGORITHMS} | {
    "gradient": "continued from `gradient-start`, on all four scenarios"
}
AGENTS = {name: how for name, how in _LEARNED.items() if any(MODELS.glob(f"{name}-seed*.onnx"))}
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


def read_results(paths: Sequence[Path]) -> Results:
    """Results of benchmark.json files, an agent's of the first that has it; ValueError if none has, or another file."""
    try:
        found: dict[str, dict[str, Any]] = {}
        for path in reversed(paths):
            with naming(path):
                text = path.read_text("utf-8")
            for scenario, of in json.loads(text)["results"].items():
                found.setdefault(scenario, {}).update(of)
        for name in AGENTS:
            for of in _seen(name, found).values():
                for metric in FIGURES:
                    float(of[name][metric]["mean"])
    except (json.JSONDecodeError, KeyError, TypeError, AttributeError):
        raise CzError(f"no benchmark.json with {', '.join(AGENTS)}: {', '.join(map(str, paths))}") from None
    return found


def _seen(name: str, results: Results) -> Results:
    """The scenarios that have an agent; KeyError if none has it."""
    found = {scenario: of for scenario, of in results.items() if name in of}
    if not found:
        raise KeyError(name)
    return found


def card(name: str, how: str, contracts: Sequence[Contract], results: Results) -> str:
    """An agent's section."""
    first, seen = contracts[0], _seen(name, results)
    rows = [
        [scenario, *(_estimate(of[name][metric], 100.0 if metric == "failure_rate" else 1.0) for metric in FIGURES)]
        for scenario, of in seen.items()
    ]
    fails = [f"`{scenario}`" for scenario, of in seen.items() if of[name]["failure_rate"]["mean"] > 0.0]
    return "\n".join(
        [
            f"## `{name}`",
            "",
            f"- How it learned: {how}.",
            f"- Saw: {_seen_in_training(name, first)}; {_steps(name, contracts)} a run.",
            f"- Reads: `{first.observation}`; acts every {first.control_interval:g} s; its action is `{first.action}`.",
            f"- Training seeds: {len(contracts)}. `agents.load({name!r})` is the one of least validation cost.",
            "- Fails: " + (f"loses crystals of {', '.join(fails)}." if fails else "on none of these."),
            "",
            table(["scenario", *FIGURES.values()], rows),
            "",
        ]
    )


def _seen_in_training(name: str, contract: Contract) -> str:
    """What its crystals were, with the shares of those that are not the scenario's own."""
    recipe = RECIPES.get(name)
    also = recipe.also if isinstance(recipe, Gradient) else ()
    if isinstance(recipe, Imitation):
        also = (("", recipe.width, recipe.wide_share),)
    others = [
        f"{100.0 * share:.0f} % " + (f"of `{other}`" if other else f"{width:g} times as wide")
        for other, width, share in also
    ]
    return f"crystals of `{contract.scenario}`" + (f", with {', '.join(others)} among them" if others else "")


def _steps(name: str, contracts: Sequence[Contract]) -> str:
    """How many steps a run learned from; a contract counts only those that it learned from by reward."""
    recipe = RECIPES.get(name)
    if isinstance(recipe, Imitation):
        return f"{recipe.rounds * recipe.episodes * recipe.config.steps / 1e6:.1f} million steps of demonstrations"
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
[the benchmark](../benchmark/report.md) and, of agents for one scenario, [the frontier](../frontier/report.md);
`python -m studies.cards` wrote this page.

No agent was trained or tested on a real puller: none may control one. The linear loop of `gradient` has an unstable
mode, which its schedule keeps small ([what it does](../../docs/insight.md)).
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.cards", __doc__)
    results, out = Path("results"), Path("results/cards/cards.md")
    parser.add_argument(
        "--benchmark",
        type=Path,
        nargs="+",
        default=[results / name / "benchmark.json" for name in ("benchmark", "frontier")],
        help="results; an agent's are taken from the first that has it (default: of benchmark and frontier)",
    )
    parser.add_argument("--out", type=Path, default=out, help="file to write (default: %(default)s)")
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
