"""A leaderboard of submitted agents, each run again on fresh crystals: ``cz-gym leaderboard FOLDER``.

A submission is a folder FOLDER/NAME with the agent's files (``*.onnx``, each with its ``.json``), one a training seed,
and the ``benchmark.json`` that ``benchmark.py --agent NAME=FILE ...`` wrote of them.
"""

import argparse
import secrets
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from cz_gym.agents import OnnxPolicy
from cz_gym.evaluation import protocol
from cz_gym.support.command_line import OneLineParser, between
from cz_gym.support.errors import CzError
from cz_gym.support.files import check_writable, name_file_in_errors, write_files
from cz_gym.support.units import PERCENT
from cz_gym.tools.episodes import Benchmark, by_key, read_estimates
from cz_gym.tools.registry import CONTROLLERS
from cz_gym.tools.report.markdown import summary
from cz_gym.tools.report.tables import RMSE
from cz_gym.tools.report.tables import markdown as table
from cz_gym.tools.report.task_records import contract_hash
from cz_gym.tools.run import check_agents, run, to_json

FRESH = range(3_000_000, 2**31)
"""Seeds that no training, validation or test uses."""
BUDGETS = {"1 M": 1_000_000, "5 M": 5_000_000, "20 M": 20_000_000}
"""Classes of agents by the environment steps of their longest training; the rest is open."""
OVERSHOOT = 1.05
"""Share of a budget that a training may take: it ends with an update, which may end later."""
HEADS = (
    "budget, declared", "place", "agent", "told, declared", "training seeds", "lost here [%]", "cost here",
    f"RMSE on {protocol.CASES[0].name} here [mm]", "claimed [mm]", "contract", "hash",
)  # fmt: skip
DECLARED = """Steps, and what an agent was told, are what its maker declares: nothing measures them, and another maker's
run may not repeat them. The hash is of network and declarations of the first training seed: who changes either changes
it. "Here" is measured."""
TOLD = {
    protocol.GROUPS[protocol.REWARD]: "nothing",
    protocol.GROUPS[protocol.STATE]: "state, in training",
    protocol.GROUPS[protocol.PLANT]: "plant, in training",
}
"""Knowledge of an agent in training, by the heading of its group."""
Claims = Mapping[str, tuple[float, str]]
"""RMSE [mm] on the first case, and the contract, that each submission claims."""


def budget(contender: protocol.Contender) -> str:
    """The smallest budget that the trainings of an agent keep."""
    steps = max(policy.contract.training_steps for policy in contender.trained)
    return next((name for name, most in BUDGETS.items() if steps <= OVERSHOOT * most), "open")


def submission(folder: Path) -> tuple[protocol.Contender, tuple[float, str]]:
    """The agent of a folder, and its claim: RMSE on test crystals of the first case, and contract."""
    files = sorted(folder.glob("*.onnx"))
    if not files:
        raise CzError(f"{folder}: no agent file (*.onnx)")
    claimed = folder / "benchmark.json"
    estimates, contract = read_estimates(claimed, [RMSE.metric])
    claim = by_key(estimates).get((protocol.CASES[0].name, folder.name, RMSE.metric, "mean"))
    if claim is None:
        raise CzError(f"{claimed}: no results of {folder.name!r} on {protocol.CASES[0].name}")
    contender = protocol.agent(folder.name, [OnnxPolicy.load(file) for file in files], own=True)
    return contender, (claim.mean, contract)


def page(benchmark: Benchmark, claims: Claims) -> str:
    """The leaderboard in Markdown: of each budget its agents by crystals lost here, then by cost; claims beside it."""
    here, cases = {each.name: each for each in benchmark.contenders if each.name in claims}, benchmark.cases
    crystals = benchmark.seeds(cases[0])
    lines, places, order = [], Counter[str](), [*BUDGETS, "open"]
    for name in sorted(here, key=lambda name: (order.index(budget(here[name])), benchmark.rank(cases, name))):
        spent, told = budget(here[name]), TOLD[here[name].knows]
        places[spent] += 1
        claim, contract = claims[name]
        own = RMSE.of(benchmark, cases[0], name)
        same = "the same" if contract == contract_hash(cases) else f"other: `{contract or 'unknown'}`"
        lost = sum(benchmark.mean(case, name, "failure_rate") for case in cases) / len(cases) / PERCENT
        figures = f"{lost:.2f}", f"{benchmark.rank(cases, name)[1]:.4f}", own, f"{claim:.3f}"
        seeds = str(len(here[name].training_seeds))
        digest = f"`{here[name].trained[0].contract.hash[:12]}`"
        lines.append((spent, str(places[spent]), name, told, seeds, *figures, same, digest))
    seeds = f"{crystals[0]} to {crystals[-1]}"
    about = (
        f"Submitted agents on {len(crystals)} fresh crystals of each scenario (seeds {seeds}), by crystals lost (the "
        'lower end of the interval), then by cost, both means over the scenarios. "Claimed" is the submission\'s RMSE.'
    )
    beside = "Every scenario, beside classical controllers:"
    return "\n\n".join(["# Leaderboard", about, DECLARED, table(HEADS, lines), beside, summary(benchmark)]) + "\n"


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("cz-gym leaderboard", (__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path, help="folder of the submissions, a folder each")
    about = "fresh crystals a scenario (default: %(default)s)"
    parser.add_argument("--episodes", type=between(2, len(protocol.TEST_SEEDS)), default=100, help=about)
    about = "seed of the first crystal (default: a random one, which the page names)"
    parser.add_argument("--first-seed", type=between(FRESH.start, FRESH.stop - len(protocol.TEST_SEEDS)), help=about)
    about = "folder for leaderboard.md and leaderboard.json (default: %(default)s)"
    parser.add_argument("--out", type=Path, default=Path("runs/leaderboard"), help=about)
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    check_writable(given.out)
    with name_file_in_errors(given.folder):
        submitted = [submission(each) for each in sorted(given.folder.iterdir()) if each.is_dir()]
    if not submitted:
        raise CzError(f"{given.folder}: no submissions: each is a folder with agent files and benchmark.json")
    first = given.first_seed or FRESH[secrets.randbelow(len(FRESH) - len(protocol.TEST_SEEDS))]
    cases = [replace(case, first_seed=first) for case in protocol.RANDOM_CASES]
    agents = [contender for contender, _ in submitted]
    check_agents(agents, cases)
    contenders = [*(each for each in CONTROLLERS if each.quoted), *agents]
    benchmark = run(contenders, cases, given.episodes, given.out)
    text = page(benchmark, {contender.name: claim for contender, claim in submitted})
    command = f"cz-gym leaderboard {given.folder} --episodes {given.episodes} --first-seed {first}"
    files = {"leaderboard.md": text, "leaderboard.json": to_json(benchmark, command)}
    write_files({given.out / name: content.encode() for name, content in files.items()})
    print(text)
