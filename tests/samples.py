"""Samples of rollouts, as a benchmark makes them of its parts."""

from collections.abc import Sequence

from cz_gym.baselines.registry import find_controller
from cz_gym.evaluation.protocol import find_row
from cz_gym.evaluation.results import EXAMPLES, Controller, Part, Sample, ScenarioResult, summarise
from cz_gym.evaluation.rollout import Rollout, rollout


def sample_of(controller: Controller, runs: Sequence[Rollout]) -> Sample:
    """Of a controller's rollouts, one a training seed, all on the same episodes."""
    seeds = runs[0].seeds
    parts = [[Part.of(run, frozenset(seeds[:EXAMPLES]))] for run in runs]
    return Sample.joined(controller, seeds, parts, runs[0].config.control_interval)


def scenario_of(
    name: str, names: Sequence[str], last: str, training_seeds: tuple[int, ...] = (4,), fewer: int = 0
) -> tuple[ScenarioResult, dict[str, Rollout]]:
    """What controllers make of three crystals (one of a scenario without randomness), and their rollouts.

    The last is shown as an agent of that name, trained with the given seeds, and meets so many crystals less.
    """
    row, samples, runs = find_row(name), [], {}
    config, seeds = row.config(), row.seeds(3)
    for who in names:
        learned = who == names[-1]
        runs[who] = run = rollout(
            find_controller(who).make(config), config, seeds[: len(seeds) - fewer * learned] or seeds
        )
        agent = Controller(last, "measured", f"agent trained with {last}", training_seeds)
        shown = agent if learned else Controller(who, "measured", f"what {who} is")
        samples.append(sample_of(shown, [run] * (len(training_seeds) if learned else 1)))
    return summarise(row, samples), runs
