"""Tune controllers: ``python -m cz_gym.baselines.tuning --controller paper-tuned --scenario puller``.

``--puller my.toml`` designs for a puller of the user's own: its PIDs and the filter of its LQGs are searched from their
scaled settings (:mod:`cz_gym.baselines.for_puller`), side by side. Half of the crystals have hot zones that are not the
file's, so that what is chosen is robust to them. Choices and histories are kept in a folder beside the file.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from cz_gym.baselines import for_puller
from cz_gym.baselines.tuned_for import file_name, tuned_folder
from cz_gym.config import make_config
from cz_gym.episodes.scenarios import find_scenario
from cz_gym.errors import CzError
from cz_gym.evaluation.processes import in_processes
from cz_gym.machine.puller import PullerFile, chosen_puller
from cz_gym.support.command_line import OneLineParser, between

from .goals import TUNABLE, crystals, crystals_on, goal_of, goal_on, search_for
from .search import Search, measure

PER_PARAMETER = 2, 6
"""Most candidates of a search for a puller, for each of its parameters: of an LQG, of a PID."""


def design(
    puller: PullerFile, controller: str | None, trials: int | None, episodes: int | None, folder: Path | None
) -> None:
    """Search for a puller, several controllers side by side, and print what was chosen."""
    from tqdm import tqdm

    names = [controller] if controller else [for_puller.FILTER, *for_puller.PIDS]
    place, most = folder or tuned_folder(puller), episodes or 20
    config = crystals_on(puller)
    tries = {
        name: trials or PER_PARAMETER[name in for_puller.PIDS] * len(goal_on(name, config).parameters) for name in names
    }
    tasks = [(name, puller, tries[name], most, place) for name in names]
    with tqdm(total=sum(task[2] for task in tasks), unit="candidate", dynamic_ncols=True, disable=None) as bar:

        def look() -> None:
            bar.update(sum(tried(place / f"{name}.json") for name in names) - bar.n)

        for number, chosen in in_processes(search_for, tasks, look):
            look()
            found = chosen.facts["figures"]
            said = f"RMSE {found['rmse_mm']:.3f} mm, {100 * found['failure_rate']:.0f} % lost"
            bar.write(f"{names[number]}: {said} on validation crystals, half of them with other hot zones")
    print(f"wrote {place}: benchmark.py --puller {puller.file or puller.name} runs what was designed")


def tried(path: Path) -> int:
    """Number of candidates in a history."""
    return len(json.loads(path.read_text("utf-8"))["history"]) if path.exists() else 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = OneLineParser("python -m cz_gym.baselines.tuning", "Tune a controller within a budget.")
    add = parser.add_argument
    add("--controller", help=f"{', '.join(TUNABLE)} (with --puller: all that are searched for one)")
    add("--scenario", default="randomized", help="scenario to tune on")
    add("--control-interval", type=float, default=5.0, help="time between actions [s]")
    parser.add_puller("design for it: a controller of its own for each row, minutes of work")
    trials, episodes = between(1, 100_000), between(5, 5000)
    add(
        "--trials",
        type=trials,
        help="candidates to try, those of an earlier run included (100; with --puller at most 10 to 48)",
    )
    add("--episodes", type=episodes, help="training episodes of a candidate (100; with --puller 20)")
    add("--out", type=Path, help="folder of histories and choices (runs/tuning; with --puller beside its file)")
    return parser.run(tune, arguments, "benchmark", "the same command continues from the candidates in its history")


def tune(given: argparse.Namespace) -> None:
    """Search, choose, and print the chosen settings."""
    if given.puller is not None:
        puller = chosen_puller(given.puller)
        return design(puller, given.controller, given.trials, given.episodes, given.out)
    if given.controller is None:
        raise CzError("name a --controller, or a --puller to design for")
    scenario = find_scenario(given.scenario)
    goal, scored_on = goal_of(given.controller, scenario), crystals(given.controller, scenario)
    config = make_config(scored_on, None, "measured", given.control_interval, action="direct")
    search = Search(given.controller, goal, config, given.trials or 100, given.episodes or 100, measure)
    folder = given.out or Path("runs/tuning")
    chosen = search.tune(folder / file_name(given.controller, given.scenario))
    print(f"{given.controller} on {given.scenario}: {chosen.score:.4f} {chosen.facts}")
    print(search.settings(chosen.values))
    return None


if __name__ == "__main__":
    sys.exit(main())
