"""Millions of random and adversarial steps over the randomised pullers: ``python -m tests.stress``.

Every scenario, control intervals from 0.5 to 60 s, both models and every mix, every observation, the drives of
"puller", and pullers drawn far wider than any named scenario. After each step of each slot everything that leaves the
environment is checked, and the stored heat is balanced against what flowed in and out. The first thing wrong stops
the command with one line that names the case, the step and the slot.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from cz_gym.config import Config, make_config
from cz_gym.episodes.scenario import Interface
from cz_gym.episodes.scenarios import HARD, PULLER, SCENARIOS
from cz_gym.units import HOUR, MM
from cz_gym.vector import CzVectorEnv

from .adversaries import KINDS, Adversaries
from .checks import Broken, Watch

INTERVALS = (0.5, 1.0, 2.0, 5.0, 7.5, 10.0, 20.0, 30.0, 60.0)
"""Control intervals [s]."""
MODELS: tuple[str | None, ...] = (None, "I", "II")
OBSERVATIONS = ("measured", "history", "state")
WIDE = replace(
    HARD,
    name="wide",
    pullers=replace(
        HARD.pullers, capillary=0.1, conductivity=0.3, conductance=0.3, start_radius_sd=2.0 * MM, melt_loss=0.5
    ),
    interface=Interface(sd=(0.0, 5.0)),
    sensor=PULLER.sensor,
    faults=SCENARIOS["sensor-fault"].faults,
    actuators=PULLER.actuators,
)
"""Pullers and disturbances far beyond the named scenarios."""
SHORT, CALLS, CALLS_IF_SHORT = 5.0, 460, 920
"""Steps in a row that a large campaign takes in each case, twice as many at control intervals below ``SHORT`` [s]: the
rest goes into more slots."""


class Totals(NamedTuple):
    """What a campaign has done."""

    steps: int
    episodes: int
    failures: int
    missing_heat: float
    """Largest heat missing from a step's balance, as a share of the nominal heater power."""


def cases() -> list[Config]:
    """Each scenario and "wide" at each interval; models and observations take turns, so that all meet."""
    return [
        make_config(
            scenario, MODELS[(at + turn) % 3], OBSERVATIONS[(at + 2 * turn) % 3], interval, 3.0 * HOUR, action="direct"
        )
        for at, scenario in enumerate((*SCENARIOS, WIDE))
        for turn, interval in enumerate(INTERVALS)
    ]


def run_case(config: Config, steps: int, seed: int) -> Totals:
    """About ``steps`` slot steps of one case, at least one; raises :class:`Broken` at the first thing wrong."""
    row = CALLS_IF_SHORT if config.control_interval < SHORT else CALLS
    n = len(KINDS) * max(1, round(steps / row / len(KINDS)))
    # At short intervals the horizon is cut so that every case meets ends by time as well.
    calls = max(1, round(steps / n))
    config = replace(config, horizon=min(config.horizon, max(1, 2 * calls // 3) * config.control_interval))
    env = CzVectorEnv.from_config(config, n, threads=1, info="all")
    adversaries, watch = Adversaries(n, seed), Watch(env)
    observation, infos = env.reset(seed=seed)
    watch.begin(observation, infos)
    for _ in range(calls):
        actions = adversaries.actions(infos, env._batch.memory.slots["puller"]["h_0"])
        watch.before()
        *result, infos = env.step(actions)
        watch.after(actions, *result, infos)
    env.close()
    return Totals(n * calls, watch.episodes, watch.failures, watch.missing_heat)


def campaign(configs: Sequence[Config], steps: int, seed: int = 0) -> Totals:
    """Share ``steps`` among the cases, each told as it ends; raises :class:`Broken` with its name in front."""
    parts = []
    for number, config in enumerate(configs):
        name = f"{config.scenario.name}, model {config.model}, {config.observation}, {config.control_interval:g} s"
        try:
            part = run_case(config, -(-steps // len(configs)), seed + 1000 * number)
        except Broken as broken:
            raise Broken(f"{name}, seed {seed + 1000 * number}: {broken}") from None
        parts.append(part)
        print(f"{name}: {part.steps} steps, {part.episodes} episodes, {part.failures} failures", flush=True)
    *counts, missing_heat = zip(*parts, strict=True)
    return Totals(*map(sum, counts), max(missing_heat))


def main(argv: Sequence[str] | None = None) -> int:
    """Run a campaign and print what it saw; exit code 1 and one line at the first thing wrong."""
    parser = argparse.ArgumentParser("python -m tests.stress", description="Adversarial steps, checked at each.")
    parser.add_argument("--steps", type=int, default=1_000_000, help="slot steps in all (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of actions and episodes (%(default)s)")
    arguments = parser.parse_args(argv)
    configs, began = cases(), time.perf_counter()
    try:
        totals = campaign(configs, arguments.steps, arguments.seed)
    except Broken as broken:
        print(f"{parser.prog}: {broken}", file=sys.stderr)
        return 1
    print(
        f"{len(configs)} cases, {totals.steps:,} steps, {totals.episodes:,} episodes, {totals.failures:,} failures "
        f"in {time.perf_counter() - began:.0f} s; missing heat {totals.missing_heat:.1e} at most"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
