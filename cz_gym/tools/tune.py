"""``cz-gym tune``: search the settings of controllers, on a scenario or for a puller of the user's own.

For a puller its PIDs and the filter of its LQGs are searched from their scaled settings, side by side, half of the
crystals on hot zones that are not the file's; with ``--env CzCrystal-v0`` the controllers of whole crystals.
Choices and histories are stored in a folder beside the file.
"""

import argparse
import json
import shlex
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from cz_gym.baselines import tuned_crystal
from cz_gym.baselines.search import Measure, Search, Trial, measure
from cz_gym.baselines.tuned import Tuned, file_name, folder_of
from cz_gym.baselines.tuned_crystal import CRYSTALS, SCENARIOS, STAGES, TunedCrystal
from cz_gym.baselines.tuned_lqg import LQGS
from cz_gym.baselines.tuned_pid import PIDS
from cz_gym.config import Config, make_config
from cz_gym.crystal.process import CRYSTAL, ENVIRONMENTS
from cz_gym.episodes.scenarios import RANDOMIZED, find_scenario
from cz_gym.evaluation.parallel import side_by_side
from cz_gym.puller.file import FOLDER, PullerFile, chosen_puller
from cz_gym.support.command_line import OneLineParser, between, relative_path
from cz_gym.support.errors import CzError
from cz_gym.support.names import unknown_name_message

_ALL: tuple[Tuned | TunedCrystal, ...] = (*PIDS, *LQGS, *CRYSTALS)
CZ = "Cz-v0"
TUNABLE = {each.name: each for each in _ALL}
EPISODES = {CZ: 20, CRYSTAL.name: 60}
"""Training episodes of a candidate for a puller, by environment: of whole crystals three in five are crowns."""
Task = tuple[Tuned | TunedCrystal, PullerFile, int, int, Path]
"""A search for a puller: controller, puller, candidates, episodes and folder."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = OneLineParser("cz-gym tune", "Tune a controller within a budget.")
    add = parser.add_argument
    add("--controller", help=f"{', '.join(TUNABLE)} (with --puller: all that are searched for one)")
    add("--scenario", help=f"scenario to tune on ({RANDOMIZED.name})")
    add("--control-interval", type=float, help="time between actions [s] (5)")
    parser.add_cluster()
    parser.add_puller("search every controller that is designed for it, minutes of work")
    about = "candidates to try, those of an earlier run included (100; with --puller at most 10 to 48)"
    add("--trials", type=between(1, 100_000), help=about)
    add("--episodes", type=between(5, 5000), help="episodes a candidate (100; with --puller 20, whole crystals 60)")
    add("--env", choices=ENVIRONMENTS, default=CZ, help=f"with --puller: whose controllers to search (default: {CZ})")
    add("--out", type=Path, help="folder of histories and choices (runs/tuning; with --puller beside its file)")
    return parser.run(_tune, arguments, "benchmark", "the same command continues from the candidates in its history")


def _tune(given: argparse.Namespace) -> None:
    if given.puller is not None:
        if given.scenario or given.control_interval:
            raise CzError("a search for a --puller has scenarios and interval of its own: leave both options out")
        for_puller(given, chosen_puller(given.puller))
        return
    if given.cluster:
        raise CzError("--cluster shares the searches for a --puller between machines: one search is one task")
    if given.controller is None:
        raise CzError("name a --controller, or a --puller to design for")
    name, known = given.scenario or RANDOMIZED.name, tunable(given)
    scenario = find_scenario(name)
    tuned = known.get(given.controller)
    if tuned is None:
        raise CzError(unknown_name_message("controller to tune", given.controller, known))
    trials, episodes, interval = given.trials or 100, given.episodes or 100, given.control_interval or 5.0
    if isinstance(tuned, TunedCrystal):
        if scenario != RANDOMIZED:
            raise CzError(f"{tuned.name} has one search: leave --scenario {name} out")
        config = make_config(SCENARIOS, None, "measured", interval, action="direct", process=CRYSTAL, stage=STAGES)
        search = Search(tuned.name, tuned.goal, config, trials, episodes, tuned_crystal.measure)
    else:
        config = make_config(tuned.crystals(scenario), None, "measured", interval, action="direct")
        search = Search(tuned.name, tuned.goal(scenario), config, trials, episodes, measure)
    path = (given.out or Path("runs/tuning")) / file_name(tuned.name, name)
    chosen = search.tune(path)
    print(f"{tuned.name} on {name}: score {chosen.score:.4f} on validation crystals")
    for parameter, value in zip(search.goal.parameters, chosen.values, strict=True):
        print(f"  {parameter.path} = {value:.6g}")
    print(f"wrote {relative_path(path)}")


def tunable(given: argparse.Namespace) -> dict[str, Tuned | TunedCrystal]:
    """The controllers that may be named: with ``--env CzCrystal-v0`` those of whole crystals alone."""
    return {name: each for name, each in TUNABLE.items() if given.env == CZ or isinstance(each, TunedCrystal)}


def for_puller(given: argparse.Namespace, puller: PullerFile) -> None:
    """Search for a puller, several controllers side by side, and print what was chosen."""
    from tqdm import tqdm

    known = {name: each for name, each in tunable(given).items() if getattr(each, "searched_on_puller", True)}
    if given.controller not in (None, *known):
        raise CzError(unknown_name_message("controller to tune for a puller", given.controller, known))
    alike = [each for each in known.values() if isinstance(each, TunedCrystal) == (given.env != CZ)]
    searched = [known[given.controller]] if given.controller else alike
    crystals = isinstance(searched[0], TunedCrystal)
    beside = folder_of(puller).absolute()
    if puller.file and puller.file.resolve().parent == FOLDER.resolve():
        raise CzError(f"{puller.name} ships with what was designed for it: to search anew, copy {puller.file}")
    folder = (given.out or beside).absolute()
    tasks: list[Task] = []
    for each in searched:
        config, _ = crystals_on(each, puller)
        trials = given.trials or each.per_parameter * len(each.goal_on(config).parameters)
        tasks.append((each, puller, trials, given.episodes or EPISODES[config.process.name], folder))
    with tqdm(total=sum(task[2] for task in tasks), unit="candidate", dynamic_ncols=True, disable=None) as bar:

        def look() -> None:
            bar.update(sum(tried(folder / f"{task[0].name}.json") for task in tasks) - bar.n)

        for number, chosen in side_by_side(search_for, tasks, look, given.cluster, folder):
            look()
            figures = chosen.facts["figures"]
            if crystals:
                said = f"crown's largest errors {figures['crown_mm']:.2f} mm, tail's {figures['tail_mm']:.2f} mm"
                among = "half of them hard"
            else:
                said, among = f"RMSE {figures['rmse_mm']:.3f} mm", "half of them with other hot zones"
            lost = f"{100 * figures['failure_rate']:.0f} % lost"
            bar.write(f"{tasks[number][0].name}: {said}, {lost} on validation crystals, {among}")
    command = f"cz-gym benchmark --puller {shlex.quote(str(puller.file or puller.name))}"
    moved = "" if folder == beside else f"moved to {beside}, "
    print(f"wrote {folder}: {moved}{command}{f' --env {CRYSTAL.name}' if crystals else ''} runs what was designed")


def search_for(task: Task) -> Trial:
    """One search for a puller."""
    tuned, puller, trials, episodes, folder = task
    config, measures = crystals_on(tuned, puller)
    search = Search(tuned.name, tuned.goal_on(config), config, trials, episodes, measures, True)
    return search.tune(folder / f"{tuned.name}.json")


def crystals_on(tuned: Tuned | TunedCrystal, puller: PullerFile) -> tuple[Config, Measure]:
    """The crystals that a controller is designed on for a puller, half of them with other hot zones or ``hard``, and
    what measures it there."""
    if isinstance(tuned, TunedCrystal):
        whole = partial(make_config, process=CRYSTAL, stage=STAGES)
        return whole(SCENARIOS, None, "measured", action="direct", puller=puller), tuned_crystal.measure
    mixed = {"randomized": 0.5, "hot-zone": 0.5}
    return make_config(mixed, None, "measured", action="direct", puller=puller), measure


def tried(path: Path) -> int:
    """Number of candidates in a history; none in a damaged one, which the search refuses."""
    try:
        return len(json.loads(path.read_text("utf-8"))["history"]) if path.exists() else 0
    except (KeyError, TypeError, ValueError):
        return 0
