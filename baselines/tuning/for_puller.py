"""Design for a puller of the user's own: its PIDs and the filter of its LQGs are searched from their scaled settings.

Half of the crystals have hot zones that are not the file's, so that what is chosen is robust to them. Choices and
histories are kept in a folder beside the file, where :mod:`cz_gym.baselines.for_puller` finds them.
"""

from __future__ import annotations

import json
from pathlib import Path

from cz_gym.baselines import for_puller
from cz_gym.config import Config, make_config
from cz_gym.evaluation.processes import in_processes
from cz_gym.puller import PullerFile

from .goals import goal_on
from .search import Search, Trial, measure

TRIALS = {for_puller.FILTER: 12}
"""Candidates of a search; 40 of a PID's."""
Task = tuple[str, PullerFile, int, int, Path]
"""Controller, puller, candidates, episodes and folder of a search."""


def design(
    puller: PullerFile, controller: str | None, trials: int | None, episodes: int | None, folder: Path | None
) -> None:
    """Search for a puller, several controllers side by side, and print what was chosen."""
    from tqdm import tqdm

    names = [controller] if controller else [for_puller.FILTER, *for_puller.PIDS]
    place, most = folder or for_puller.tuned_folder(puller), episodes or 20
    tasks = [(name, puller, trials or TRIALS.get(name, 40), most, place) for name in names]
    for name in names:
        goal_on(name, crystals_on(puller))
    with tqdm(total=sum(task[2] for task in tasks), unit="candidate", dynamic_ncols=True) as bar:

        def look() -> None:
            bar.update(sum(tried(place / f"{name}.json") for name in names) - bar.n)

        for number, chosen in in_processes(search_for, tasks, look):
            look()
            found = chosen.facts["figures"]
            said = f"RMSE {found['rmse_mm']:.3f} mm, {100 * found['failure_rate']:.0f} % lost"
            bar.write(f"{names[number]}: {said} on validation crystals, half of them with other hot zones")
    print(f"wrote {place}: benchmark.py --puller {puller.file or puller.name} runs what was designed")


def crystals_on(puller: PullerFile) -> Config:
    """The crystals that controllers are designed on for a puller: half of them with other hot zones."""
    mixed = {"randomized": 0.5, "hot-zone": 0.5}
    return make_config(mixed, None, "measured", action="direct", puller=puller)


def search_for(task: Task) -> Trial:
    """One search for a puller, in a process of its own."""
    name, puller, trials, episodes, folder = task
    config = crystals_on(puller)
    return Search(name, goal_on(name, config), config, trials, episodes, measure).tune(folder / f"{name}.json")


def tried(path: Path) -> int:
    """Number of candidates in a history."""
    return len(json.loads(path.read_text("utf-8"))["history"]) if path.exists() else 0
