"""``cz-gym tune``: search the settings of controllers, on a scenario or for a puller of the user's own.

For a puller its PIDs and the filter of its LQGs are searched from their scaled settings, side by side, half of the
crystals on hot zones that are not the file's. Choices and histories are stored in a folder beside the file.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

from cz_gym.baselines.tuning import crystal
from cz_gym.baselines.tuning.crystal import CRYSTALS, SCENARIOS, STAGES, TunedCrystal
from cz_gym.baselines.tuning.lqg import LQGS
from cz_gym.baselines.tuning.pid import PIDS
from cz_gym.baselines.tuning.record import Tuned
from cz_gym.baselines.tuning.search import Search, Trial, measure
from cz_gym.baselines.tuning.values import file_name, folder_of
from cz_gym.config import Config, make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.episodes.scenarios import RANDOMIZED, find_scenario
from cz_gym.errors import CzError
from cz_gym.evaluation.processes import side_by_side
from cz_gym.machine.puller import PullerFile, chosen_puller
from cz_gym.support.command_line import OneLineParser, between
from cz_gym.support.names import unknown

_ALL: tuple[Tuned | TunedCrystal, ...] = (*PIDS, *LQGS, *CRYSTALS)
TUNABLE = {each.name: each for each in _ALL}
Task = tuple[Tuned, PullerFile, int, int, Path]
"""A search for a puller: controller, puller, candidates, episodes and folder."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = OneLineParser("cz-gym tune", "Tune a controller within a budget.")
    add = parser.add_argument
    add("--controller", help=f"{', '.join(TUNABLE)} (with --puller: all that are searched for one)")
    add("--scenario", default="randomized", help="scenario to tune on")
    add("--control-interval", type=float, default=5.0, help="time between actions [s]")
    parser.add_cluster()
    parser.add_puller("design for it: a controller of its own for each row, minutes of work")
    about = "candidates to try, those of an earlier run included (100; with --puller at most 10 to 48)"
    add("--trials", type=between(1, 100_000), help=about)
    add("--episodes", type=between(5, 5000), help="training episodes of a candidate (100; with --puller 20)")
    add("--out", type=Path, help="folder of histories and choices (runs/tuning; with --puller beside its file)")
    return parser.run(_tune, arguments, "benchmark", "the same command continues from the candidates in its history")


def _tune(given: argparse.Namespace) -> None:
    if given.puller is not None:
        return for_puller(given, chosen_puller(given.puller))
    if given.cluster:
        raise CzError("--cluster shares the searches for a --puller between machines: one search is one task")
    if given.controller is None:
        raise CzError("name a --controller, or a --puller to design for")
    scenario, tuned = find_scenario(given.scenario), TUNABLE.get(given.controller)
    if tuned is None:
        raise CzError(unknown("controller to tune", given.controller, TUNABLE))
    trials, episodes, interval = given.trials or 100, given.episodes or 100, given.control_interval
    if isinstance(tuned, TunedCrystal):
        if scenario != RANDOMIZED:
            raise CzError(f"{tuned.name} has one search: leave --scenario {given.scenario} out")
        config = make_config(SCENARIOS, None, "measured", interval, action="direct", process=CRYSTAL, stage=STAGES)
        search = Search(tuned.name, tuned.goal, config, trials, episodes, crystal.measure)
    else:
        config = make_config(tuned.crystals(scenario), None, "measured", interval, action="direct")
        search = Search(tuned.name, tuned.goal(scenario), config, trials, episodes, measure)
    chosen = search.tune((given.out or Path("runs/tuning")) / file_name(tuned.name, given.scenario))
    print(f"{tuned.name} on {given.scenario}: {chosen.score:.4f} {chosen.facts}")
    print(search.settings(chosen.values))
    return None


def for_puller(given: argparse.Namespace, puller: PullerFile) -> None:
    """Search for a puller, several controllers side by side, and print what was chosen."""
    from tqdm import tqdm

    searched = {each.name: each for each in (*LQGS, *PIDS) if each.searched_on_puller}
    if given.controller not in (None, *searched):
        raise CzError(unknown("controller to tune for a puller", given.controller, searched))
    config, folder = crystals_on(puller), (given.out or folder_of(puller)).absolute()
    tasks: list[Task] = []
    for each in [searched[given.controller]] if given.controller else searched.values():
        trials = given.trials or each.per_parameter * len(each.goal_on(config).parameters)
        tasks.append((each, puller, trials, given.episodes or 20, folder))
    with tqdm(total=sum(task[2] for task in tasks), unit="candidate", dynamic_ncols=True, disable=None) as bar:

        def look() -> None:
            bar.update(sum(tried(folder / f"{task[0].name}.json") for task in tasks) - bar.n)

        for number, chosen in side_by_side(search_for, tasks, look, given.cluster, folder):
            look()
            figures = chosen.facts["figures"]
            said = f"RMSE {figures['rmse_mm']:.3f} mm, {100 * figures['failure_rate']:.0f} % lost"
            bar.write(f"{tasks[number][0].name}: {said} on validation crystals, half of them with other hot zones")
    print(f"wrote {folder}: cz-gym benchmark --puller {puller.file or puller.name} runs what was designed")


def search_for(task: Task) -> Trial:
    """One search for a puller."""
    tuned, puller, trials, episodes, folder = task
    config = crystals_on(puller)
    search = Search(tuned.name, tuned.goal_on(config), config, trials, episodes, measure, True)
    return search.tune(folder / f"{tuned.name}.json")


def crystals_on(puller: PullerFile) -> Config:
    """The crystals that controllers are designed on for a puller: half of them with other hot zones."""
    mixed = {"randomized": 0.5, "hot-zone": 0.5}
    return make_config(mixed, None, "measured", action="direct", puller=puller)


def tried(path: Path) -> int:
    """Number of candidates in a history."""
    return len(json.loads(path.read_text("utf-8"))["history"]) if path.exists() else 0
