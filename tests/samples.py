"""Samples of rollouts, as a benchmark makes them of its parts."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

from cz_gym.baselines.lqg import LQG, LQGDesign
from cz_gym.baselines.tuned import with_values
from cz_gym.evaluation.protocol import Contender, find_case
from cz_gym.evaluation.results import Result, Sample, summarise
from cz_gym.evaluation.rollout import Rollout, rollout
from cz_gym.tools.registry import find_controller

NOMINAL_LQG = LQG(
    design=with_values(
        LQGDesign(),
        {
            "weights.pull": 0.008875, "weights.pull_step": 0.025, "weights.heater_step": 2.578,
            "noise.fast_sd": 0.2618, "noise.slow_sd": 0.2928, "noise.drift_rate_sd": 0.000594,
            "noise.drift_rate_tau": 2651.0, "noise.heater_walk": 0.2195, "noise.thermal_walk": 0.001497,
            "noise.pyrometer_sd": 0.04472, "noise.recipe_share": 0.1782,
        },
    )
)  # fmt: skip
"""An LQG tuned on nominal hot zones alone: it is precise there, and unstable on some others."""


def contender(name: str, meaning: str = "", training_seeds: tuple[int, ...] = (), **facts: Any) -> Contender:
    """A contender that is never run; an agent if it has training seeds."""
    policy = SimpleNamespace(contract=SimpleNamespace(learned_from="reward"))
    trained: tuple[Any, ...] = (policy,) * len(training_seeds)
    facts = {"observation": "measured", "make": lambda config: None, **facts}
    return Contender(name, meaning=meaning, training_seeds=training_seeds, trained=trained, **facts)


def result_of(
    name: str, names: Sequence[str], last: str, training_seeds: tuple[int, ...] = (4,), fewer: int = 0
) -> tuple[Result, dict[str, Rollout]]:
    """Results of controllers on three crystals (one of a scenario without randomness), and their rollouts.

    The last is shown as an agent of that name, trained with the given seeds, and meets ``fewer`` crystals less.
    """
    row, samples, runs = find_case(name), [], {}
    config, seeds = row.config(), row.seeds(3)
    for who in names:
        learned = who == names[-1]
        met = seeds[: len(seeds) - fewer * learned] or seeds
        runs[who] = run = rollout(find_controller(who).make(config), config, met)
        agent = contender(last, f"agent trained with {last}", training_seeds)
        shown = agent if learned else contender(who, f"what {who} is", quoted=who == "paper")
        samples.append(Sample.of(shown, [run] * (len(training_seeds) if learned else 1)))
    return summarise(row, samples), runs
