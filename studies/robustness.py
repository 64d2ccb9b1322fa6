"""Robustness of controllers and agents alike, measured on crystals: ``python -m studies.robustness NAME...``.

A wrapper around the policy multiplies the pull speed's move that it asks for, or holds its actions back by whole
control intervals; the drive's reading shows what was applied. The largest change counts at which no crystal is lost and
the mean error at most doubles, by bisection on a grid.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cz_gym.agents import load, shipped_names
from cz_gym.config import Config, make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import TEST_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.support.command_line import between
from cz_gym.support.files import write_files
from cz_gym.support.units import HOUR
from cz_gym.tools.registry import make_controller
from cz_gym.tools.report.tables import markdown

from . import StudyParser

CONTROLLERS = "paper-tuned", "lqg", "lqg-at-0.02", "gradient"
FACTORS = tuple(float(f"{each:.2f}") for each in np.geomspace(1.1, 4.0, 8))
"""Factors on the pull's effect, and divisors of it [-]."""
SAMPLES = tuple(range(1, 17))
"""Extra delays, in control intervals."""
WORSE = 2.0
"""Largest ratio of the radius error to that without a change [-]."""


@dataclass(frozen=True)
class Altered:
    """A policy whose pull moves have another size, and whose actions are late."""

    policy: Any
    factor: float = 1.0
    late: int = 0
    """Number of control intervals."""

    @property
    def made_for(self) -> Any:
        """The environment that the policy was made for."""
        return getattr(self.policy, "made_for", None)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """The action as it reaches the drives; the state holds the policy's own and the actions that wait."""
        own, waiting = state or (None, ())
        action, own = self.policy.predict(observation, own, episode_start, deterministic)
        action = np.array(action, np.float32)
        action[:, 0] = np.clip(self.factor * action[:, 0], -1.0, 1.0)
        waiting = (*(waiting or [np.zeros_like(action)] * self.late), action)
        return waiting[0], (own, waiting[1:])


def policy_and_config(name: str, scenario: str, hours: float) -> tuple[Any, Config]:
    """A controller or a shipped agent, and the environment that it acts in."""
    if name in shipped_names():
        agent = load(name)
        config = make_config(scenario, horizon=hours * HOUR, **agent.settings)
        return load(name, config), config
    config = make_config(scenario, observation="measured", action="direct", horizon=hours * HOUR)
    return make_controller(name, config), config


def largest(grid: Sequence[float], holds: Callable[[float], bool]) -> float | None:
    """The largest value of a rising grid that holds, by bisection; None if not even the first does."""
    low, high = -1, len(grid)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if holds(grid[middle]) else (low, middle)
    return grid[low] if low >= 0 else None


def robustness(policy: Any, config: Config, crystals: int) -> tuple[float, float, float]:
    """Largest factor on the pull's effect, smallest one, and longest extra delay [s]; 1 or 0 where none holds."""

    def error(**change: Any) -> float:
        found = metrics(rollout(Altered(policy, **change), config, TEST_SEEDS[:crystals]))
        return float(found.rmse_mm.mean()) if not found.failure_rate.any() else np.inf

    most = WORSE * error()
    if not np.isfinite(most):
        return 1.0, 1.0, 0.0
    up = largest(FACTORS, lambda factor: error(factor=factor) <= most) or 1.0
    down = largest(FACTORS, lambda factor: error(factor=1.0 / factor) <= most) or 1.0
    late = largest(SAMPLES, lambda samples: error(late=int(samples)) <= most) or 0
    return up, 1.0 / down, late * config.control_interval


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = StudyParser("robustness", __doc__, "results/robustness")
    parser.add_argument("controllers", nargs="*", help=f"names ({', '.join(CONTROLLERS)})")
    parser.add_scenario("%(default)s", "randomized")
    parser.add_argument("--crystals", type=between(1, 500), default=50, help="number of test crystals (%(default)s)")
    parser.add_argument("--hours", type=float, default=1.5, help="length of a crystal [h] (%(default)s)")
    return parser.run(_main, arguments)


def _main(given: argparse.Namespace) -> None:
    rows = []
    for name in given.controllers or CONTROLLERS:
        policy, config = policy_and_config(name, given.scenario, given.hours)
        up, down, late = robustness(policy, config, given.crystals)
        rows.append((name, f"{up:g}", f"{down:.2g}", f"{late:g}"))
        print(*rows[-1], flush=True)
    heads = "controller", "pull's effect up to", "down to", "extra delay [s]"
    about = (
        f"{given.crystals} test crystals of `{given.scenario}`, {given.hours:g} h each: none is lost, and the mean "
        f"radius error is at most {WORSE:g} times as large. The grid ends at {FACTORS[-1]:g}, its inverse "
        f"and {SAMPLES[-1]} control intervals."
    )
    write_files({given.out / "table.md": f"# Robustness, measured\n\n{about}\n\n{markdown(heads, rows)}\n".encode()})


if __name__ == "__main__":
    sys.exit(main())
