"""Samples of rollouts, as a benchmark makes them of its parts."""

from collections.abc import Sequence

from cz_gym.evaluation.results import EXAMPLES, Controller, Part, Sample
from cz_gym.evaluation.rollout import Rollout


def sample_of(controller: Controller, runs: Sequence[Rollout]) -> Sample:
    """Of a controller's rollouts, one a training seed, all on the same episodes."""
    seeds = runs[0].seeds
    parts = [[Part.of(run, frozenset(seeds[:EXAMPLES]))] for run in runs]
    return Sample.joined(controller, seeds, parts, runs[0].config.control_interval)
