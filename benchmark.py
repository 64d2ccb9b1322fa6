"""Controllers and agents on the same disturbed crystals, in one table: ``python benchmark.py --help``."""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Container, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cz_gym.commands import OneLineParser, guarded

if TYPE_CHECKING:
    from cz_gym.agents.agent_file.contract import Contract
    from cz_gym.baselines.registry import Entry
    from cz_gym.config import Config
    from cz_gym.evaluation.protocol import Row
    from cz_gym.evaluation.runner import Contender, Plan

FOLDER = Path(__file__).resolve().parent / "results" / "benchmark"
"""Where the committed results are."""
README = FOLDER.parents[1] / "README.md"
"""Where the committed results are quoted, between two markers."""
KEPT = FOLDER.parent / "cache"
"""Where episodes of slow controllers are kept."""
BOUNDS = FOLDER.parent / "bounds"
"""Committed results of the slow controllers; their bound serves runs without one."""
DEFAULT = "imitation-default"
"""The training seed of ``imitation`` that did best on validation."""
SHIPPED = ("imitation", DEFAULT, "imitation-medium", "imitation-quiet", "imitation-puller", "ppo")
"""Agents that come with the package; all but the default pool their training seeds."""
EPISODES = 500


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line for anything that cannot be meant."""
    parser = OneLineParser(
        prog="benchmark.py",
        description="Run controllers and agents on the same disturbed crystals and compare them.",
        epilog="docs/benchmark.md has the protocol, the formula of every metric and how to add a controller.",
    )
    parser.add_argument(
        "--episodes", type=int, default=EPISODES, metavar="N", help="first N test episodes (%(default)s)"
    )
    parser.add_argument("--controllers", type=_names, metavar="A,B", help='controllers and agents by name, or "all"')
    parser.add_argument("--scenarios", type=_names, metavar="A,B", help="scenarios by name")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (results/benchmark)")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write benchmark.json to FILE, and nothing else unless --out is given"
    )
    parser.add_argument(
        "--agent",
        type=_agent_file,
        action="append",
        metavar="[NAME=]FILE",
        help="agent file, by default in place of the shipped ones; those of one NAME (default: the algorithm's) are "
        "training seeds of one agent",
    )
    parser.add_argument(
        "--slow", action="store_true", help="slow controllers too, on the first 50 episodes; resumed from results/cache"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files that would be kept otherwise")
    parser.add_argument("--quiet", action="store_true", help="no progress bar, no table")
    return parser.parse_args(argv)


def _names(text: str) -> list[str]:
    names = list(dict.fromkeys(name.strip() for name in text.split(",")))
    if not all(names):
        raise argparse.ArgumentTypeError(f"must be names with commas between, not {text!r}")
    return names


def _agent_file(text: str) -> tuple[str, Path]:
    """The name an agent is called by, "" for its algorithm's, and its file."""
    name, equals, file = text.partition("=")
    return (name, Path(file)) if equals and name and "/" not in name else ("", Path(text))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark; 0 when done, 2 for bad input, 130 when interrupted."""
    arguments = parse(argv)
    if arguments.out is None and arguments.json is None:
        arguments.out = FOLDER
    command = shlex.join(["benchmark.py", *(sys.argv[1:] if argv is None else argv)])
    return guarded("benchmark.py", lambda: benchmark(arguments, command), "benchmark")


def benchmark(arguments: argparse.Namespace, command: str) -> int:
    """Check, run, write, show."""
    from cz_gym.evaluation.report.output import check_targets, write
    from cz_gym.evaluation.report.terminal import terminal
    from cz_gym.evaluation.runner import Progress, run

    plan = make_plan(arguments, command)
    partial = is_partial(arguments, plan)
    check_targets(arguments.out, arguments.json, partial, arguments.overwrite)
    if arguments.out is not None:
        import matplotlib  # noqa: F401  (missing? say so before the work, not after it)
        import plotly  # noqa: F401
    with Progress(plan.steps, arguments.quiet) as progress:
        done = run(plan, progress)
    quoted = README if not partial and arguments.out and arguments.out.resolve() == FOLDER else None
    write(arguments.out, arguments.json, done, quoted)
    if not arguments.quiet:
        print(f"{terminal(done)}\nwrote {', '.join(str(path) for path in (arguments.out, arguments.json) if path)}")
        if arguments.controllers == ["all"] and (missing := left_out(plan)):
            print(
                f"left out of all: {', '.join(missing)}, which are slow and not kept for every episode asked for; "
                f"add --slow to run them ({BOUNDS.relative_to(README.parent)}/report.md has what was measured of them)"
            )
    return 0


def make_plan(arguments: argparse.Namespace, command: str) -> Plan:
    """What the command line asks for; ValueError names what was given and what is allowed."""
    from cz_gym.evaluation.protocol import ROWS, check_episodes, find_row
    from cz_gym.evaluation.runner import Plan

    episodes = check_episodes(arguments.episodes)
    if arguments.scenarios is None:
        rows = tuple(row for row in ROWS if row.default)
    else:
        rows = tuple(find_row(name) for name in arguments.scenarios)
    free = kept_names(rows, episodes) if arguments.controllers and not arguments.slow else set()
    slow = slow_names() if arguments.slow else free
    contenders, contracts = choose(arguments.controllers, arguments.agent or [], slow)
    return Plan(contenders, rows, episodes, contracts, command, KEPT, BOUNDS)


def slow_names() -> set[str]:
    """Controllers that run only when asked for: everyone that is slow."""
    from cz_gym.baselines.registry import CONTROLLERS

    return {entry.name for entry in CONTROLLERS if entry.slow}


def kept_names(rows: Sequence[Row], episodes: int) -> set[str]:
    """The slow controllers of which every episode asked for is kept, so that they cost no time."""
    from cz_gym.baselines.registry import CONTROLLERS
    from cz_gym.evaluation.runner import Plan

    found = set()
    for entry in CONTROLLERS:
        if entry.slow:
            try:
                contender = _classical(entry)
            except ImportError:
                continue
            if Plan((contender,), tuple(rows), episodes, kept=KEPT).all_kept(contender):
                found.add(entry.name)
    return found


def left_out(plan: Plan) -> list[str]:
    """Slow controllers that take no part."""
    taking_part = {contender.controller.name for contender in plan.contenders}
    return sorted(slow_names() - taking_part)


def is_partial(arguments: argparse.Namespace, plan: Plan) -> bool:
    """Whether the run holds less than the default one, or another agent than the shipped one."""
    from cz_gym.baselines.registry import CONTROLLERS
    from cz_gym.evaluation.protocol import ROWS

    names = {contender.controller.name for contender in plan.contenders}
    everyone = {entry.name for entry in CONTROLLERS if entry.default} | set(SHIPPED)
    every_row = {row for row in ROWS if row.default}
    return bool(plan.episodes < EPISODES or every_row - set(plan.rows) or everyone - names or arguments.agent)


def choose(
    wanted: list[str] | None, files: Sequence[tuple[str, Path]], slow: Container[str] = ()
) -> tuple[tuple[Contender, ...], tuple[dict[str, Any], ...]]:
    """Who takes part, classical controllers first, and the contracts of the agents among them.

    Agent files, each with a name or "" for its algorithm's, always take part; shipped agents beside them only if they
    are wanted by name, and slow controllers only if ``slow`` names them. Raises ValueError for a name that nobody has,
    and for agent files that cannot be used.
    """
    from cz_gym.agents import OnnxPolicy
    from cz_gym.baselines.registry import CONTROLLERS
    from cz_gym.evaluation.protocol import SLOW_EPISODES

    given: dict[str, list[Any]] = {}
    for called, file in files:
        policy = OnnxPolicy.load(file, _nominal())
        given.setdefault(called or policy.contract.algorithm, []).append(policy)
    classical = [entry.name for entry in CONTROLLERS]
    for name in given:
        if name in classical:
            raise ValueError(f"an agent may not be called {name!r}: a controller has that name; name it NAME=FILE")
    learned = [*given, *(name for name in SHIPPED if name not in given)]
    if wanted is None or wanted == ["all"]:
        some = [entry for entry in CONTROLLERS if entry.name in slow or not entry.slow]
        wanted = [entry.name for entry in some if wanted or entry.slow or entry.default] + list(given or SHIPPED)
    for name in wanted:
        if name not in classical + learned:
            raise ValueError(f"unknown controller {name!r}; choose from {', '.join(classical + learned)}, or all")
    taking_part = [entry for entry in CONTROLLERS if entry.name in wanted]
    for entry in taking_part:
        if entry.slow and entry.name not in slow:
            raise ValueError(f"{entry.name!r} is slow: add --slow to run it on the first {SLOW_EPISODES} episodes")
    contenders = [_classical(entry) for entry in taking_part]
    contracts = []
    for name in learned:
        if name in given or name in wanted:
            policies = given.get(name) or _shipped(name)
            contenders.append(_agent(name, policies, name in given))
            contracts += [_recorded(policy.contract) for policy in policies]
    return tuple(contenders), tuple(contracts)


def _shipped(name: str) -> list[Any]:
    from cz_gym.agents import OnnxPolicy, shipped, shipped_seeds

    return [OnnxPolicy.load(file, _nominal()) for file in ([shipped()] if name == DEFAULT else shipped_seeds(name))]


def _recorded(contract: Contract) -> dict[str, Any]:
    """A contract as it will be written down; ValueError if no JSON or no page can hold it."""
    facts = asdict(contract)
    for name, value in facts.items():
        try:
            json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
        except ValueError:
            raise ValueError(
                f"agent {contract.algorithm!r}: its contract's {name} cannot be written: {value!r:.80}"
            ) from None
    return facts


def _classical(entry: Entry) -> Contender:
    from cz_gym.evaluation.results import Controller
    from cz_gym.evaluation.runner import Contender

    controller = Controller(entry.name, entry.observation, entry.meaning, told=entry.told, slow=entry.slow)
    if entry.slow:
        entry.make(_nominal())  # a package it needs is missing? say so before the work, not after it
    return Contender(controller, lambda config: [entry.make(config)])


def _agent(name: str, policies: Sequence[Any], given: bool) -> Contender:
    """A learned controller: every training seed of one algorithm. Raises ValueError if they are no such set."""
    from cz_gym.agents.policies.resampled import at_interval
    from cz_gym.evaluation.results import Controller
    from cz_gym.evaluation.runner import Contender

    contracts = [policy.contract for policy in policies]
    seeds = tuple(contract.training_seed for contract in contracts)
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"agent {name!r}: a training seed appears twice among {', '.join(map(str, seeds))}")
    if len({contract.observation for contract in contracts}) > 1:
        raise ValueError(f"agent {name!r}: its training seeds read different observations")
    if len({contract.scenario_hash for contract in contracts}) > 1:
        trained = ", ".join(sorted({contract.scenario for contract in contracts}))
        raise ValueError(f"agent {name!r}: its training seeds were trained on different scenarios: {trained}")
    interval = _nominal().control_interval
    for contract in contracts:
        if contract.control_interval != interval:
            raise ValueError(
                f"agent {name!r}: trained at {contract.control_interval:g} s control, the benchmark runs {interval:g} s"
            )
    meaning = f"agent trained with {contracts[0].algorithm} on {contracts[0].scenario}"
    if name == DEFAULT:
        meaning += ", the seed that did best on validation"
    if given:
        meaning += ", given as a file"

    def make(config: Config) -> list[Any]:
        return [at_interval(policy, config.control_interval) for policy in policies]

    return Contender(Controller(name, policies[0].observation, meaning, seeds), make)


def _nominal() -> Config:
    from cz_gym.evaluation.protocol import ROWS

    return ROWS[0].config()


if __name__ == "__main__":
    sys.exit(main())
