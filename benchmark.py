"""Controllers and agents on the same disturbed crystals, in one table: ``python benchmark.py --help``."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

try:
    from cz_gym.commands import OneLineParser, guarded, shown
    from cz_gym.errors import CzError
except ModuleNotFoundError as error:
    sys.exit(f"benchmark.py: {error}")

if TYPE_CHECKING:
    from cz_gym.baselines.registry import Entry
    from cz_gym.evaluation.contenders import Contender
    from cz_gym.evaluation.runner import Plan

FOLDER = Path(__file__).resolve().parent / "results" / "benchmark"
"""Where the committed results are."""
README = FOLDER.parents[1] / "README.md"
"""Where the committed results are quoted, between two markers."""
OWN = Path("runs")
"""Results with the user's own controllers, agents or scenarios go into a folder of their names here."""
BESIDE = ["paper", "paper-tuned", "lqg", "lqg-at-0.02"]
"""What runs beside controllers of the user's own, unless others are named."""
CACHE = FOLDER.parent / "cache"
"""Where episodes of slow controllers are cached."""
BOUNDS = FOLDER.parent / "bounds"
"""Committed results of the slow controllers; their bound serves runs without one."""
SHIPPED = ("gradient", "ppo", "sac", "imitation")
"""Shipped agents that take part by default, each with all its training seeds; specialists only if named."""
EPISODES = 500


def parse(argv: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line for anything that cannot be meant."""
    parser = OneLineParser(
        prog="benchmark.py",
        description="Run controllers and agents on the same disturbed crystals and compare them.",
        epilog="docs/benchmark.md has the protocol, the formula of every metric and how to add a controller.",
    )
    add = parser.add_argument
    add("--episodes", type=int, default=EPISODES, metavar="N", help="first N test episodes (%(default)s)")
    add("--controllers", type=_names, metavar="A,B", help='controllers and agents by name, or "all"')
    add("--scenarios", type=_names, metavar="A,B", help="scenarios by name")
    add("--out", type=Path, metavar="DIR", help="folder for the results (results/benchmark; of your own: runs/NAME)")
    add("--json", type=Path, metavar="FILE", help="write benchmark.json to FILE, and only that unless --out is given")
    agent_help = (
        "agent file, by default in place of the shipped ones; those of one NAME (default: the algorithm's) are "
        "training seeds of one agent"
    )
    add("--agent", type=_agent_file, action="append", default=[], metavar="[NAME=]FILE", help=agent_help)
    add(
        "--controller",
        action="append",
        default=[],
        metavar="FILE.py:NAME",
        help=f"controller of your own, beside others: {', '.join(BESIDE)} unless --controllers names some",
    )
    add(
        "--scenario",
        action="append",
        default=[],
        metavar="FILE.py:NAME",
        help="scenario of your own, in place of others",
    )
    add("--slow", action="store_true", help="slow controllers too, on 50 episodes; resumed from results/cache")
    add(
        "--ray",
        nargs="?",
        const="",
        metavar="HOST:PORT",
        help="run on a Ray cluster; without an address on this machine's",
    )
    add("--overwrite", action="store_true", help="replace files of earlier or other runs")
    add("--quiet", action="store_true", help="no progress bar, no table")
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
        mine = [place.rpartition(":")[2] for place in (*arguments.controller, *arguments.scenario)]
        mine += [name or file.stem for name, file in arguments.agent]
        arguments.out = OWN / "-".join(dict.fromkeys(mine)) if mine else FOLDER
    if arguments.controller and not (arguments.controllers or arguments.slow):
        arguments.controllers = BESIDE
    command = shlex.join(["benchmark.py", *(sys.argv[1:] if argv is None else argv)])
    return guarded("benchmark.py", lambda: benchmark(arguments, command), "benchmark")


def benchmark(arguments: argparse.Namespace, command: str) -> int:
    """Check, run, write, print."""
    from tqdm import tqdm

    from cz_gym.evaluation.report.output import check_targets, write
    from cz_gym.evaluation.report.terminal import terminal
    from cz_gym.evaluation.runner import in_turn, on_cluster, run

    plan = make_plan(arguments, command)
    smaller = is_partial(arguments, plan)
    check_targets(arguments.out, arguments.json, smaller, arguments.overwrite)
    # A package that is missing is named before the work, not after it.
    if arguments.out is not None:
        import matplotlib  # noqa: F401
        import plotly  # noqa: F401
    if arguments.ray is not None:
        from cz_gym.evaluation.cluster import connect

        connect(arguments.ray)
    for contender in plan.contenders:
        if contender.controller.slow:
            contender.make(plan.rows[0].config())
    with tqdm(total=plan.steps, unit="step", unit_scale=True, leave=False, disable=arguments.quiet) as bar:
        done = run(plan, bar, in_turn if arguments.ray is None else on_cluster)
    quoted = README if not smaller and arguments.out and arguments.out.resolve() == FOLDER else None
    write(arguments.out, arguments.json, done, quoted)
    if not arguments.quiet:
        print(terminal(done))
        if arguments.controllers == ["all"] and (missing := left_out(plan)):
            print(
                f"left out of all: {', '.join(missing)}, which are slow and not cached for every episode asked for; "
                f"add --slow to run them ({BOUNDS.relative_to(README.parent)}/report.md has their earlier results)"
            )
        wrote = ", ".join(shown(path) for path in (arguments.out, arguments.json) if path)
        print(f"wrote {wrote}" + (f"; open {shown(arguments.out / 'report.html')}" if arguments.out else ""))
    return 0


def make_plan(arguments: argparse.Namespace, command: str) -> Plan:
    """What the command line asks for; ValueError names what was given and what is allowed."""
    from cz_gym.agents import shipped_names
    from cz_gym.evaluation import user_code
    from cz_gym.evaluation.contenders import check_intervals, choose
    from cz_gym.evaluation.protocol import ROWS, check_episodes, find_row
    from cz_gym.evaluation.runner import Plan

    episodes = check_episodes(arguments.episodes)
    names = arguments.scenarios or [row.name for row in ROWS if row.default and not arguments.scenario]
    rows = [*map(find_row, names), *map(user_code.row, arguments.scenario)]
    user_code.check_apart([row.name for row in rows], "scenario")
    plan = Plan((), tuple(rows), episodes, command, CACHE, BOUNDS)
    own = [user_code.controller(place) for place in arguments.controller]
    controllers = classical()
    names = list(dict.fromkeys((*SHIPPED, *shipped_names())))
    reserved = [*(each.name for each in controllers), *names, *{name for name, _ in arguments.agent if name}]
    user_code.check_apart([*reserved, *(each.name for each in own)], "controller")
    slow = [each for each in controllers if each.controller.slow]
    if not arguments.slow:
        slow = [each for each in slow if arguments.controllers and plan.is_cached(each)]
    shipped = {name: partial(_shipped, name) for name in names}
    slowly = [each.name for each in slow]
    chosen = choose(arguments.controllers, controllers, _given(arguments.agent), shipped, SHIPPED, slowly)
    check_intervals(chosen, plan.rows)
    return replace(plan, contenders=(*chosen, *own))


def classical() -> list[Contender]:
    """The classical controllers."""
    from cz_gym.baselines.registry import CONTROLLERS

    return [_classical(entry) for entry in CONTROLLERS]


def _classical(entry: Entry) -> Contender:
    from cz_gym.evaluation.contenders import Contender
    from cz_gym.evaluation.results import Controller

    controller = Controller(entry.name, entry.observation, entry.meaning, privileged=entry.privileged, slow=entry.slow)
    return Contender(controller, lambda config: [entry.make(config)], entry.default)


def _given(files: Sequence[tuple[str, Path]]) -> dict[str, Contender]:
    """The agents of files, each with a name or "" for its algorithm's."""
    from cz_gym.agents import shipped_names

    policies: dict[str, list[Any]] = {}
    for name, file in files:
        if str(file) in shipped_names() and not file.exists():
            raise CzError(f"--agent takes a file; {file} is shipped and runs by its name: --controllers {file}")
        policy = _load(file)
        policies.setdefault(name or policy.contract.algorithm, []).append(policy)
    return {name: _agent(name, some, own=True) for name, some in policies.items()}


def _shipped(name: str) -> Contender:
    from cz_gym.agents import shipped_seeds

    return _agent(name, [_load(file) for file in shipped_seeds(name)])


def _agent(name: str, policies: Sequence[Any], own: bool = False) -> Contender:
    from cz_gym.agents.training.run_files import trained_on
    from cz_gym.evaluation.contenders import agent

    contract = policies[0].contract
    return agent(name, policies, own, trained_on(contract.algorithm, contract.scenario))


def _load(file: Path) -> Any:
    from cz_gym.agents import OnnxPolicy
    from cz_gym.evaluation.protocol import ROWS

    return OnnxPolicy.load(file, ROWS[0].config())


def left_out(plan: Plan) -> list[str]:
    """Slow controllers that take no part."""
    taking_part = {contender.name for contender in plan.contenders}
    return sorted(each.name for each in classical() if each.controller.slow and each.name not in taking_part)


def is_partial(arguments: argparse.Namespace, plan: Plan) -> bool:
    """Whether the run holds less than the default one, or agents of the user's own."""
    from cz_gym.evaluation.protocol import ROWS

    everyone = {each.name for each in classical() if each.default} | set(SHIPPED)
    missing = everyone - {contender.name for contender in plan.contenders}
    rows = {row for row in ROWS if row.default} - set(plan.rows)
    more = arguments.agent or arguments.controller or arguments.scenario
    return bool(plan.episodes < EPISODES or missing or rows or more)


if __name__ == "__main__":
    sys.exit(main())
