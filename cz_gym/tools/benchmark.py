"""``cz-gym benchmark``: controllers and agents on the same disturbed crystals, in one table."""

import argparse
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from cz_gym.agents import OnnxPolicy, shipped_names, shipped_seeds
from cz_gym.evaluation.protocol import (
    SLOW_EPISODES,
    Case,
    Contender,
    agent,
    check_apart,
    find_cases,
    user_case,
    user_controller,
)
from cz_gym.puller.file import chosen_puller
from cz_gym.support.command_line import OneLineParser, between, names, relative_path, run_command
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.units import MM
from cz_gym.tools.report.markdown import terminal

from .registry import load_agent
from .report.task_records import TASKS
from .run import check_agents, check_targets, is_cached, run, write

CLONE = Path(__file__).resolve().parents[2]
RESULTS = CLONE / "results" if (CLONE / "results" / "benchmark").is_dir() else Path("runs")
"""Folder of the committed results in a clone, of a user's results elsewhere."""
PAGES = tuple(CLONE / page for page in ("README.md", "docs/benchmark.md", "docs/crystal.md"))
"""Pages of a clone that quote the committed results between two markers."""
OWN = Path("runs")
"""Folder of results with the user's own controllers, agents or scenarios, each in a folder of their names."""
CACHE = RESULTS / "cache"
"""Folder of cached episodes of slow controllers."""
BOUNDS = RESULTS / "bounds"
"""Folder of committed results of the slow controllers; their bound serves runs without one."""
EPISODES = 500
"""Number of test episodes: of the committed results, and the largest there is."""


def parse(argv: Sequence[str]) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line for anything that cannot be meant."""
    parser = OneLineParser(
        prog="cz-gym benchmark",
        description="Run controllers and agents on the same disturbed crystals and compare them.",
        epilog="docs/benchmark.md has the protocol, the formula of every metric and how to add a controller.",
    )
    add = parser.add_argument
    about = "environment (%(default)s); of a whole crystal the scenarios are its stages"
    add("--env", choices=TASKS, default="Cz-v0", help=about)
    about = "first N test episodes (%(default)s)"
    add("--episodes", type=between(1, EPISODES), default=EPISODES, metavar="N", help=about)
    add("--controllers", type=names, metavar="NAME[,NAME]", help='controllers and agents by name, or "all"')
    about = "scenarios by name; FILE.py:NAME, one of your own; FILE.csv, a log's disturbances (identify --series)"
    parser.add_scenario(about, several=True)
    add(
        "--out",
        type=Path,
        metavar="DIR",
        help=f"folder for the results ({relative_path(RESULTS / 'benchmark')}; of your own: runs/NAME)",
    )
    add("--json", type=Path, metavar="FILE", help="write benchmark.json to FILE, and only that unless --out is given")
    agent_help = (
        "agent file, by default in place of the shipped ones; those of one NAME (default: the algorithm's) are "
        "training seeds of one agent"
    )
    add("--agent", type=_agent_file, action="append", default=[], metavar="[NAME=]FILE", help=agent_help)
    beside = ", ".join(each.name for each in TASKS["Cz-v0"].controllers() if each.quoted)
    own = f"controller of your own, beside {beside} unless --controllers names some"
    add("--controller", action="append", default=[], metavar="FILE.py:NAME", help=own)
    parser.add_puller("every case runs on it, with the controllers that are designed for it")
    about = "largest deviation of the diameter that is no scrap, in the report for --puller [mm] (1)"
    add("--tolerance", type=float, metavar="MM", help=about)
    add(
        "--slow", action="store_true", help=f"slow controllers too, on 50 episodes; resumed from {relative_path(CACHE)}"
    )
    parser.add_cluster()
    add("--overwrite", action="store_true", help="replace files of earlier or other runs")
    add("--quiet", action="store_true", help="no progress bar, no table; a bar is shown on a terminal only")
    given = parser.parse_args(argv)
    given.own_scenarios = [name for name in given.scenario or () if ":" in name or name.endswith(".csv")]
    return given


def _agent_file(text: str) -> tuple[str, Path]:
    """Return the name of an agent, "" for its algorithm's, and its file."""
    name, equals, file = text.partition("=")
    return (name, Path(file)) if equals and name and "/" not in name else ("", Path(text))


def main(argv: Sequence[str]) -> int:
    """Run the benchmark; 0 when done, 2 for bad input, 130 when interrupted."""
    arguments = parse(argv)
    if arguments.out is None and arguments.json is None:
        mine = [place.rpartition(":")[2] for place in (*arguments.controller, *arguments.own_scenarios)]
        mine += [name or file.stem for name, file in arguments.agent]
        mine += [Path(arguments.puller).stem] if arguments.puller else []
        arguments.out = OWN / "-".join(dict.fromkeys(mine)) if mine else folder_of(arguments)
    command = shlex.join(["cz-gym", "benchmark", *argv])
    return run_command("cz-gym benchmark", lambda: benchmark(arguments, command), "benchmark")


def folder_of(arguments: argparse.Namespace) -> Path:
    """Return the folder of the committed results of an environment."""
    return RESULTS / TASKS[arguments.env].name


def benchmark(arguments: argparse.Namespace, command: str) -> int:
    """Check the arguments, run the benchmark, write and print the results."""
    task, cases = TASKS[arguments.env], cases_of(arguments)
    contenders = contenders_of(arguments, cases)
    smaller = is_partial(arguments, contenders, cases)
    check_targets(arguments.out, arguments.json, smaller, arguments.overwrite)
    if arguments.out is not None:  # a missing package is named before the work, not after it
        import matplotlib  # noqa: F401
    bounds = BOUNDS if task.has_bound and not arguments.puller else None
    how = {"quiet": arguments.quiet, "cluster": arguments.cluster, "pictures": arguments.out is not None}
    found = run(contenders, cases, arguments.episodes, CACHE, bounds, **how)
    renewed = not smaller and arguments.out and arguments.out.resolve() == folder_of(arguments)
    write(arguments.out, arguments.json, found, command, PAGES if renewed else ())
    if not arguments.quiet:
        print(terminal(found))
        slow = {each.name for each in task.controllers() if each.slow} - {each.name for each in contenders}
        print_ending(arguments, slow)
    return 0


def print_ending(arguments: argparse.Namespace, left_out: set[str]) -> None:
    """Print the slow controllers that ``all`` left out, and where the results are."""
    if arguments.controllers == ["all"] and left_out:
        names = ", ".join(sorted(left_out))
        print(f"left out of all: {names}, which are slow and not cached for every episode; add --slow to run them")
    wrote = ", ".join(relative_path(path) for path in (arguments.out, arguments.json) if path)
    print(f"wrote {wrote}" + (f"; open {relative_path(arguments.out / 'report.html')}" if arguments.out else ""))


def cases_of(arguments: argparse.Namespace) -> list[Case]:
    """Return the scenarios that the command line asks for, as cases of the protocol."""
    task = TASKS[arguments.env]
    graded = arguments.puller and task.graded
    if arguments.tolerance is not None and not (graded and 0.0 < arguments.tolerance <= 50.0):
        raise CzError(f"--tolerance {arguments.tolerance:g} must be up to 50 mm, beside --puller FILE.toml, of Cz-v0")
    own = arguments.own_scenarios
    usual = [case.name for case in task.cases if case.default] if arguments.scenario is None else arguments.scenario
    named = [case for name in usual if name not in own for case in find_cases(name, task.cases)]
    cases = [*named, *map(user_case, own)]
    check_apart([case.name for case in cases], "scenario")
    puller = chosen_puller(arguments.puller)
    tolerance = 0.5 * MM * (arguments.tolerance or 1.0) if graded else None
    return [replace(case, puller=puller, tolerance=tolerance, process=task.cases[0].process) for case in cases]


def contenders_of(arguments: argparse.Namespace, cases: Sequence[Case]) -> list[Contender]:
    """Return the controllers and agents asked for, classical controllers first; CzError for unknown ones.

    Those of the user's files always take part, shipped agents by default if no agent is given, slow controllers if
    ``--slow`` asks for them, or if they are named and all their episodes cached.
    """
    usual = cases[0].design_config() if cases else None
    own, given = [user_controller(place, usual) for place in arguments.controller], given_agents(arguments)
    controllers, shipped = TASKS[arguments.env].controllers(), shipped_names(arguments.env)
    known = [*(each.name for each in controllers), *(name for name in given if name not in shipped), *shipped]
    check_apart([*known, *(each.name for each in own)], "controller")
    wanted = wanted_names(arguments, cases, [*given] or ([] if arguments.puller else shipped))
    check_known(wanted, known)
    chosen = [each for each in controllers if each.name in wanted]
    check_quick(chosen, arguments, cases)
    chosen += agents_of(given, shipped, wanted)
    check_agents([*chosen, *own], cases)
    if not (chosen or own):
        raise CzError("no controller takes part: name some with --controllers")
    return [*chosen, *own]


def check_known(wanted: Sequence[str], known: Sequence[str]) -> None:
    """Raise CzError for the first wanted name that is not known; it says so where another environment has it."""
    for name in wanted:
        if name not in known:
            for env, task in TASKS.items():
                if name in shipped_names(env) or name in [each.name for each in task.controllers()]:
                    raise CzError(f"{name!r} is for {env}: add --env {env}")
            raise CzError(unknown_name_message("controller", name, known, ", or all"))


def agents_of(given: Mapping[str, Contender], shipped: Sequence[str], wanted: Sequence[str]) -> list[Contender]:
    """Return the agents of the user's files, then the shipped ones that are wanted and that no file replaces."""
    files = {name: shipped_seeds(name) for name in shipped if name in wanted and name not in given}
    return [*given.values(), *(agent(name, [*map(load_agent, some)]) for name, some in files.items())]


def check_quick(chosen: Sequence[Contender], arguments: argparse.Namespace, cases: Sequence[Case]) -> None:
    """Raise CzError for a slow controller that may not run."""
    for each in chosen:
        if not may_run(each, arguments, cases):
            raise CzError(f"{each.name!r} is slow: add --slow to run it on the first {SLOW_EPISODES} episodes")


def may_run(contender: Contender, arguments: argparse.Namespace, cases: Sequence[Case]) -> bool:
    """Return whether a controller is quick, asked for with ``--slow``, or cached."""
    return not contender.slow or arguments.slow or is_cached(contender, cases, arguments.episodes, CACHE)


def wanted_names(arguments: argparse.Namespace, cases: Sequence[Case], agents: Sequence[str]) -> list[str]:
    """Return the names that ``--controllers`` has or means; without it fewer on a puller, or beside the user's own."""
    controllers = TASKS[arguments.env].controllers()
    if arguments.controllers == ["all"]:
        return [*(each.name for each in controllers if may_run(each, arguments, cases)), *agents]
    if arguments.controllers:
        return [*arguments.controllers]
    if arguments.puller:
        return [*(each.name for each in controllers if each.on_puller), *agents]
    if arguments.controller and not arguments.slow:
        return [each.name for each in controllers if each.quoted]
    usual = [each.name for each in controllers if (arguments.slow if each.slow else each.default)]
    return [*usual, *agents]


def given_agents(arguments: argparse.Namespace) -> dict[str, Contender]:
    """Return the agents of files by name: the files of one name are its training seeds."""
    policies: dict[str, list[OnnxPolicy]] = {}
    for name, file in arguments.agent:
        if str(file) in shipped_names(arguments.env) and not file.exists():
            raise CzError(f"--agent takes a file; {file} is shipped and runs by its name: --controllers {file}")
        policy = load_agent(file, chosen_puller(arguments.puller), arguments.controller)
        policies.setdefault(name or policy.contract.algorithm, []).append(policy)
    return {name: agent(name, some, own=True) for name, some in policies.items()}


def is_partial(arguments: argparse.Namespace, contenders: Sequence[Contender], cases: Sequence[Case]) -> bool:
    """Return whether the run holds less than the default one, or something of the user's own."""
    usual = {each.name for each in TASKS[arguments.env].controllers() if each.default and not each.slow}
    usual |= set(shipped_names(arguments.env))
    usual_cases = {case for case in TASKS[arguments.env].cases if case.default}
    missing = usual - {each.name for each in contenders} or usual_cases - set(cases)
    own = arguments.agent or arguments.controller or arguments.own_scenarios or arguments.puller
    return bool(arguments.episodes < EPISODES or missing or own)
