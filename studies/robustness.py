"""Robustness of controllers and agents alike, measured on crystals: ``python -m studies.robustness NAME...``.

What is altered stands between the drives and the crystal: the pull speed's deviation from nominal has another size, or
both drives act later by whole control intervals, while every reading shows the drives as they were asked for. An
agent's moves become setpoints first, as in an export: an agent that reads its drives would set a wrong move right, and
seem to bear any. The largest change counts at which no crystal is lost and the mean error at most doubles, by
bisection on a grid.
"""

import argparse
import csv
import io
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cz_gym.agents import load, shipped_names
from cz_gym.body.signals import Measured, moved_mean
from cz_gym.config import Config, make_config
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import CASES, TEST_SEEDS, find_case
from cz_gym.evaluation.rollout import rollout
from cz_gym.process import scales
from cz_gym.spaces import MEASURED, decode
from cz_gym.support.command_line import between
from cz_gym.support.files import write_files
from cz_gym.support.units import HOUR
from cz_gym.tools.export.controllers import Agent
from cz_gym.tools.registry import agent_hash, make_controller
from cz_gym.tools.report.tables import ROBUSTNESS, ROBUSTNESS_MEANS, beyond, markdown
from cz_gym.tools.report.task_records import contract_hash

from . import StudyParser

CONTROLLERS = (
    "paper", "paper-tuned", "pid-conventional", "lqg", "lqg-at-0.02", "lqg-one-design", "lqg-robust",
    "gradient", "ppo", "sac", "ppo-plain",
)  # fmt: skip
SCENARIO = find_case("randomized", CASES)
"""Scenario of the study: drives follow at once, and their readings are exact."""
FACTORS = tuple(float(f"{each:.2f}") for each in np.geomspace(1.1, 4.0, 8))
"""Factors on the pull's effect, and divisors of it [-]."""
SAMPLES = tuple(range(1, 17))
"""Extra delays, in control intervals."""
WORSE = 2.0
"""Largest ratio of the radius error to that without a change [-]."""
PULL, HEATER, MEAN = (Measured._fields.index(name) for name in ("v_p", "Q_H", "v_p_mean"))
"""Places of the drives in "measured"."""


@dataclass(frozen=True)
class Setpoints:
    """An agent whose actions are setpoints of the drives, whatever moves it was trained to make."""

    agent: Agent

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """Shares of the drives' ranges, and the agent's memory."""
        seen = decode(observation, *self.agent.ranges)
        pull, heater, state = self.agent.step(seen, self.agent.at_rest(seen) if state is None else state)
        return np.stack([pull / self.agent.v_0, heater / self.agent.heater_range], axis=-1), state


@dataclass(frozen=True)
class Altered:
    """A policy of setpoints whose pull has another effect, and whose setpoints act late; it reads what it asked for."""

    policy: Any
    config: Config
    factor: float = 1.0
    late: int = 0
    """Number of control intervals."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        """Setpoints as they act; the state holds the policy's own, those last asked for, their mean, those in wait."""
        seen = np.array(observation, np.float64)
        own, asked, mean, waiting = state or (None, np.zeros((len(seen), 2)), np.zeros(len(seen)), None)
        mean = moved_mean(mean, asked[:, 0], self.config.control_interval)
        ranges = self.config.ranges
        of = [PULL, HEATER, MEAN]
        seen[:, of] = np.column_stack([asked, mean]) * [*ranges, ranges[0]] / scales(MEASURED, *ranges)[of]
        action, own = self.policy.predict(seen, own, episode_start, deterministic)
        asked = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        acting = np.clip(asked * [self.factor, 1.0], -1.0, 1.0).astype(np.float32)
        waiting = (*(waiting or [np.zeros_like(acting)] * self.late), acting)
        return waiting[0], (own, asked, mean, waiting[1:])


def policy_and_config(name: str, scenario: str, hours: float) -> tuple[Any, Config]:
    """A controller or a shipped agent, and the environment that it acts in."""
    if name in shipped_names():
        agent = load(name)
        config = make_config(scenario, horizon=hours * HOUR, **agent.settings)
        return load(name, config), config
    config = make_config(scenario, observation="measured", action="direct", horizon=hours * HOUR)
    return make_controller(name, config), config


def with_setpoints(name: str, hours: float) -> tuple[Any, Config]:
    """Return the policy and the environment on :data:`SCENARIO`, with setpoints as actions."""
    policy, config = policy_and_config(name, SCENARIO.name, hours)
    if name not in shipped_names():
        return policy, config
    config = make_config(SCENARIO.name, observation="measured", action="direct", horizon=hours * HOUR)
    return Setpoints(Agent(policy, config)), config


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
        found = metrics(rollout(Altered(policy, config, **change), config, TEST_SEEDS[:crystals]))
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
    parser.add_argument("--crystals", type=between(1, 500), default=50, help="number of test crystals (%(default)s)")
    parser.add_argument("--hours", type=float, default=1.5, help="length of a crystal [h] (%(default)s)")
    return parser.run(_main, arguments)


def _main(given: argparse.Namespace) -> None:
    rows, interval = [], 0.0
    for name in given.controllers or CONTROLLERS:
        policy, config = with_setpoints(name, given.hours)
        interval = config.control_interval
        rows.append((name, *robustness(policy, config, given.crystals)))
        print(*rows[-1], flush=True)
    ends = FACTORS[-1], 1.0 / FACTORS[-1], SAMPLES[-1] * interval
    lines = [(name, *map(beyond, figures, ends)) for name, *figures in rows]
    about = f"{given.crystals} test crystals of `{SCENARIO.name}`, {given.hours:g} h each. {ROBUSTNESS_MEANS}"
    text, table = (
        f"# Robustness, measured\n\n{about}\n\n{markdown(('controller', *ROBUSTNESS), lines)}\n",
        io.StringIO(),
    )
    csv.writer(table, lineterminator="\n").writerows(
        [
            ("controller", *ROBUSTNESS, "contract", "agent"),
            *((*line, contract_hash([SCENARIO]), agent_hash(line[0])) for line in lines),
        ]
    )
    write_files({given.out / "table.md": text.encode(), given.out / "robustness.csv": table.getvalue().encode()})


if __name__ == "__main__":
    sys.exit(main())
