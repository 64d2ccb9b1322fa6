"""Trained agents side by side, several training seeds each: ``python -m studies.algorithms RUNS``.

``RUNS`` are folders of ``train.py``: of one run, or of ``--seeds``. Agents meet validation crystals of every random
scenario that did not choose them; ``--out`` receives the table and the learning curves.
"""

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from cz_gym.errors import CzError
from cz_gym.evaluation.contender import agent
from cz_gym.evaluation.report.markdown import summary
from cz_gym.evaluation.report.tables import markdown
from cz_gym.evaluation.results import Result
from cz_gym.evaluation.runner import run
from cz_gym.support.atomic_files import check_writable, write_files
from cz_gym.support.command_line import OneLineParser
from cz_gym.support.units import MINUTE

from .leaderboard import random_cases

ABOUT = """RMSE of the radius on {crystals} validation crystals of each scenario that did not choose a run's agent; of
each run the agent of least cost on the validation that selects. In brackets: 95 % intervals, bootstrap over training
seeds and crystals; with few training seeds they are somewhat too narrow."""
Runs = Mapping[str, Mapping[int, Sequence[Mapping[str, str]]]]
"""Rows of ``progress.csv`` by recipe and training seed."""


def report(results: Sequence[Result], runs: Runs) -> dict[str, bytes]:
    """``table.md``, ``curves.png`` and ``curves.csv``, by file name."""
    from cz_gym.agents.training.plot import curves
    from cz_gym.agents.training.run_files import to_csv

    spent = []
    for name, seeds in runs.items():
        steps, seconds = (sum(float(rows[-1][each]) for rows in seeds.values()) for each in ("steps", "seconds"))
        spent.append((name, f"{steps / len(seeds) / 1e6:.1f}", f"{seconds / len(seeds) / MINUTE:.0f}", str(len(seeds))))
    text = "\n\n".join([
        "# Algorithms side by side: the recipes of train.py on the same crystals",
        ABOUT.format(crystals=len(results[0].seeds)),
        summary(results),
        markdown(("a training", "million steps", "minutes", "training seeds"), spent),
    ])  # fmt: skip
    listed = ((name, seed, rows) for name, seeds in runs.items() for seed, rows in seeds.items())
    rows = [{"variant": name, "seed": seed, **row} for name, seed, progress in listed for row in progress]
    drawn = curves({name: [*seeds.values()] for name, seeds in runs.items()})
    return {"table.md": f"{text}\n".encode(), "curves.png": drawn, "curves.csv": to_csv(rows)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.algorithms", (__doc__ or "").split("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", help="folder of a finished run of train.py, or of several")
    about = "folder of the results (default: %(default)s)"
    parser.add_argument("--out", type=Path, default=Path("results/algorithms"), help=about)
    return parser.run(_compare, arguments, "agents,benchmark")


def _compare(given: argparse.Namespace) -> None:
    from cz_gym.agents import OnnxPolicy
    from cz_gym.agents.training.run_files import read_rows
    from cz_gym.agents.training.validation import JUDGING

    check_writable(given.out)
    folders = sorted(path.parent for runs in given.runs for path in runs.glob("**/summary.json"))
    if not folders:
        raise CzError(f"no finished run of train.py in {', '.join(map(str, given.runs))}")
    runs: dict[str, dict[int, list[dict[str, str]]]] = {}
    policies: dict[str, list[OnnxPolicy]] = {}
    for folder in folders:
        policy = OnnxPolicy.load(folder / "agent.onnx")
        name, seed = policy.contract.algorithm, policy.contract.training_seed
        policies.setdefault(name, []).append(policy)
        runs.setdefault(name, {})[seed] = read_rows(folder / "progress.csv")
    agents = [agent(name, trained) for name, trained in policies.items()]
    results = run(agents, random_cases(JUDGING[0]), len(JUDGING), given.out)
    write_files({given.out / name: content for name, content in report(results, runs).items()})
    print(f"wrote {given.out / 'table.md'}")


if __name__ == "__main__":
    sys.exit(main())
