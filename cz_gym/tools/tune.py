"""``cz-gym tune``: search the settings of controllers, on a scenario or for a puller of the user's own.

For a puller its PIDs and the filter of its LQGs are searched from their scaled settings, side by side, half of the
crystals on hot zones that are not the file's; with ``--env CzCrystal-v0`` the controllers of whole crystals.
Choices and histories are stored in a folder beside the file.
"""

import argparse
import json
import shlex
from collections.abc import Sequence
from pathlib import Path

from cz_gym.baselines.margins import MarginLimits, margin_limits
from cz_gym.baselines.search import FINALISTS, Search, Trial
from cz_gym.baselines.tuned import OWN_PULLER, TunedController, file_name, folder_of
from cz_gym.baselines.tuned_controllers import CRYSTALS, LQGS, PIDS
from cz_gym.body.process import BODY
from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.episodes.scenarios import RANDOMIZED, find_scenario
from cz_gym.evaluation.parallel import run_parallel
from cz_gym.evaluation.protocol import scenarios
from cz_gym.puller.file import FOLDER, PullerFile, chosen_puller
from cz_gym.support.command_line import OneLineParser, between, filled, relative_path
from cz_gym.support.errors import CzError, unknown_name_message

TUNABLE: dict[str, TunedController] = {each.name: each for each in (*PIDS, *LQGS, *CRYSTALS)}
Task = tuple[TunedController, PullerFile, int, int, MarginLimits | None, Path]
"""A search for a puller: controller, puller, candidates, episodes, least margins and folder."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = OneLineParser("cz-gym tune", "Tune a controller within a budget.")
    add = parser.add_argument
    add("--controller", help=f"{', '.join(TUNABLE)} (with --puller: all that are searched for one)")
    parser.add_scenario(f"scenario to tune on ({RANDOMIZED.name})")
    add("--control-interval", type=float, help="time between actions [s] (5)")
    parser.add_cluster()
    parser.add_puller("search every controller that is designed for it, minutes of work")
    about = "candidates to try, those of an earlier run included (100; with --puller at most 10 to 48)"
    add("--trials", type=between(1, 100_000), help=about)
    add("--episodes", type=between(5, 5000), help="episodes a candidate (100; with --puller 20, whole crystals 60)")
    add(
        "--env",
        choices=ENVIRONMENTS,
        default=BODY.name,
        help=f"with --puller: whose controllers to search (default: {BODY.name})",
    )
    about = "gain [-], phase [deg] and peak of the sensitivity [-] that a choice keeps at pull, heater and ring, or off"
    add("--margins", type=str, help=f"{about} (with --puller 2,30,2, on a scenario the controller's own)")
    add("--out", type=Path, help="folder of histories and choices (runs/tuning; with --puller beside its file)")
    return parser.run(_tune, arguments, "benchmark", "the same command continues from the candidates in its history")


def _tune(given: argparse.Namespace) -> None:
    from tqdm import tqdm

    if given.puller is not None:
        if given.scenario or given.control_interval:
            raise CzError("a search for a --puller has scenarios and interval of its own: leave both options out")
        for_puller(given, chosen_puller(given.puller))
        return
    if given.cluster:
        raise CzError("--cluster shares the searches for a --puller between machines: one search is one task")
    if given.controller is None:
        raise CzError("name a --controller, or a --puller to design for")
    scenario, known = find_scenario(scenarios(given.scenario or RANDOMIZED.name)), tunable(given)
    tuned = known.get(given.controller)
    if tuned is None:
        raise CzError(unknown_name_message("controller to tune", given.controller, known))
    if tuned.process != BODY and scenario != RANDOMIZED:
        raise CzError(f"{tuned.name} has one search: leave --scenario {scenario.name} out")
    config = tuned.search_config(scenario, given.control_interval)
    margins = asked_margins(given, tuned, tuned.margins)
    budget = given.trials or 100, given.episodes or 100
    search = Search(tuned.name, tuned.objective(scenario), config, *budget, margins=margins)
    path, candidates = (given.out or Path("runs/tuning")) / file_name(tuned.name, scenario.name), budget[0] + FINALISTS
    with tqdm(total=candidates, unit="candidate", leave=False, dynamic_ncols=True, disable=None) as bar:
        search.progress = lambda done: bar.update(done - bar.n)
        chosen = search.tune(path)
    print(f"{tuned.name} on {scenario.name}: score {chosen.score:.4f} on validation crystals")
    for parameter, value in zip(search.objective.parameters, chosen.values, strict=True):
        print(f"  {parameter.path} = {value:.6g}")
    print(f"wrote {relative_path(path)}")


def asked_margins(
    given: argparse.Namespace, tuned: TunedController, unless: MarginLimits | None
) -> MarginLimits | None:
    """The margins of a search: those of the command line, or others; a controller of whole crystals has none."""
    if tuned.process != BODY:
        if given.margins not in (None, "off"):
            raise CzError(f"{tuned.name} has no linear loop along a whole crystal: leave --margins out")
        return None
    return unless if given.margins is None else margin_limits(given.margins)


def tunable(given: argparse.Namespace) -> dict[str, TunedController]:
    """The controllers that may be named: with ``--env CzCrystal-v0`` those of whole crystals alone."""
    return {name: each for name, each in TUNABLE.items() if given.env in (BODY.name, each.process.name)}


def tasks_for(given: argparse.Namespace, puller: PullerFile) -> list[Task]:
    """The searches for a puller that the command line asks for; CzError names what cannot be searched."""
    known = {name: each for name, each in tunable(given).items() if each.near}
    if given.controller not in (None, *known):
        raise CzError(unknown_name_message("controller to tune for a puller", given.controller, known))
    if puller.file and puller.file.resolve().parent == FOLDER.resolve():
        raise CzError(f"{puller.name} ships with what was designed for it: to search anew, copy {puller.file}")
    alike = [each for each in known.values() if each.process.name == given.env]
    searched = [known[given.controller]] if given.controller else alike
    folder = (given.out or folder_of(puller)).absolute()
    return [
        (
            each,
            puller,
            given.trials or each.candidates * len(each.near),
            given.episodes or each.episodes,
            asked_margins(given, each, MarginLimits()),
            folder,
        )
        for each in searched
    ]


def for_puller(given: argparse.Namespace, puller: PullerFile) -> None:
    """Search for a puller, several controllers side by side, and print what was chosen."""
    from tqdm import tqdm

    tasks = tasks_for(given, puller)
    process, folder, beside = tasks[0][0].process, tasks[0][-1], folder_of(puller).absolute()
    with tqdm(total=sum(task[2] for task in tasks), unit="candidate", dynamic_ncols=True, disable=None) as bar:

        def poll_progress() -> None:
            bar.update(sum(tried(folder / f"{task[0].name}.json") for task in tasks) - bar.n)

        for number, chosen in run_parallel(search_for, tasks, poll_progress, given.cluster, folder):
            poll_progress()
            tuned = tasks[number][0]
            found = tuned.objectives[OWN_PULLER].kind(**chosen.facts["figures"])
            bar.write(filled(f"{tuned.name}: {found}", rest="  "))
    command = f"cz-gym benchmark --puller {shlex.quote(str(puller.file or puller.name))}"
    moved = "" if folder == beside else f"moved to {relative_path(beside)}, "
    env = "" if process == BODY else f" --env {process.name}"
    print(f"wrote {relative_path(folder)}: {moved}{command}{env} runs what was designed")


def search_for(task: Task) -> Trial:
    """Search for a puller; the task of a process."""
    tuned, puller, trials, episodes, margins, folder = task
    config = tuned.search_config(RANDOMIZED, puller=puller)
    search = Search(tuned.name, tuned.objective_on(config), config, trials, episodes, quick=True, margins=margins)
    return search.tune(folder / f"{tuned.name}.json")


def tried(path: Path) -> int:
    """Number of candidates in a history; none in a damaged one, which the search refuses."""
    try:
        return len(json.loads(path.read_text("utf-8"))["history"]) if path.exists() else 0
    except (KeyError, TypeError, ValueError):
        return 0
