"""Model cards of the shipped agents, with the benchmark's figures: training, results and failures."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from cz_gym.agents import shipped_names, shipped_seeds
from cz_gym.agents.contract import Contract, read_agent
from cz_gym.support.errors import CzError
from cz_gym.support.files import write_files
from cz_gym.tools.episodes import by_key, read_estimates
from cz_gym.tools.report.tables import FAILURES, PULL_STEP, RMSE, Column
from cz_gym.tools.report.tables import markdown as table

from . import StudyParser

TOLD = (
    "its actions from the reward; a network that estimates the state from sensors was fitted to the true state, "
    "which the critic saw too, in training only"
)
AGENTS = {
    "gradient": "analytic policy gradients: the cost's gradient through policy and plant; the plant is known",
    "ppo": f"proximal policy optimisation from nothing, {TOLD}",
    "ppo-plain": "proximal policy optimisation from nothing, from the reward alone",
    "sac": f"soft actor-critic from nothing, {TOLD}",
}
"""Shipped agents, and how each learned."""
FIGURES = (
    RMSE._replace(decimals=4),
    Column("rmse_observable_mm", "observable RMSE [mm]", 4),
    PULL_STEP,
    FAILURES._replace(heading="lost [%]"),
)
"""Columns of a card."""
RETURN = "return"
"""Metric that model hubs show as the mean reward."""


def card(name: str, how: str, contracts: Sequence[Contract], estimates: pd.DataFrame) -> str:
    """An agent's section."""
    first, taken = contracts[0], sorted(contract.training_steps / 1e6 for contract in contracts)
    steps = " to ".join(dict.fromkeys(f"{each:.0f}" for each in (taken[0], taken[-1])))
    known, scenarios = by_key(estimates), estimates["scenario"].unique()
    rows = [[where, *(column.text(known[where, name, column.metric, "mean"]) for column in FIGURES)]
            for where in scenarios]  # fmt: skip
    fails = [f"`{where}`" for where in scenarios if known[where, name, FAILURES.metric, "mean"].mean > 0.0]
    return "\n".join(
        [
            f"## `{name}`\n",
            f"- How it learned: {how}.",
            f"- Declared: trained on crystals of {first.scenario}, kept after {steps} million steps.",
            f"- Reads: `{first.observation}`; acts every {first.control_interval:g} s; its action is `{first.action}`.",
            f"- Training seeds: {len(contracts)}. `agents.load({name!r})` is the one of least validation cost.",
            "- Fails: " + (f"loses crystals of {', '.join(fails)}." if fails else "on none of these."),
            "\n" + table(["scenario", *(column.heading for column in FIGURES)], rows) + "\n",
        ]
    )


ABOUT = """# Model cards

What each shipped agent saw, what it reaches and where it fails, on test crystals that took no part in its training. All
training seeds of a name are pooled; in brackets the 95 % interval over crystals and training seeds. How an agent
learned and in how many steps is declared by its maker, as of every agent; its figures are measured. They are of
[the benchmark](../benchmark/report.md); `python -m studies.cards` wrote this page.

No agent was trained or tested on a real puller: none may control one.
"""


def hub_page(name: str, text: str, estimates: pd.DataFrame) -> str:
    """A card as a model hub reads it: metadata in YAML, with the mean return of each scenario, then the text."""
    metrics = [
        f"  - task: {{type: reinforcement-learning, name: reinforcement-learning}}\n"
        f"    dataset: {{name: Cz-v0 {row.scenario}, type: Cz-v0}}\n"
        f"    metrics: [{{type: mean_reward, value: {row.mean:.1f}, name: mean_reward}}]"
        for row in estimates.query("controller == @name and metric == @RETURN").itertuples()
    ]
    head = ["library_name: cz-gym", "license: mit", "tags: [Cz-v0, reinforcement-learning, control]", "model-index:"]
    head += [f"- name: {name}", "  results:", *metrics]
    return "\n".join(["---", *head, "---", "", text.replace("## ", "# ", 1)])


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = StudyParser("cards", __doc__, "results/cards/cards.md")
    add, results = parser.add_argument, Path("results/benchmark/benchmark.json")
    add("--benchmark", type=Path, default=results, help="results (default: %(default)s)")
    add("--hub", type=Path, metavar="DIR", help="also write a folder an agent, ready for a model hub")
    return parser.run(_main, arguments)


def _main(given: argparse.Namespace) -> None:
    estimates, _ = read_estimates(given.benchmark, [*(column.metric for column in FIGURES), RETURN])
    shipped = {name: how for name, how in AGENTS.items() if name in shipped_names()}
    if estimates.empty or any(shipped.keys() - set(own["controller"]) for _, own in estimates.groupby("scenario")):
        raise CzError(f"{given.benchmark}: no results of {', '.join(shipped)}")
    cards = {
        name: card(name, of, [read_agent(each)[0] for each in shipped_seeds(name)], estimates)
        for name, of in shipped.items()
    }
    write_files({given.out: "\n".join([ABOUT, *cards.values()]).encode()})
    print(f"wrote {given.out}")
    for name, text in cards.items() if given.hub else ():
        files = [path for file in shipped_seeds(name) for path in (file, file.with_suffix(".json"))]
        content = {given.hub / name / path.name: path.read_bytes() for path in files}
        write_files({**content, given.hub / name / "README.md": hub_page(name, text, estimates).encode()})
        print(f"wrote {given.hub / name}")


if __name__ == "__main__":
    sys.exit(main())
