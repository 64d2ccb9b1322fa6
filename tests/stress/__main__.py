"""Millions of random and adversarial steps over the randomised pullers: ``python -m tests.stress``.

Every scenario, control intervals from 0.5 to 60 s, both models and every mix, every observation, the drives of
"puller", and pullers drawn far wider than any named scenario. After each step of each slot everything that leaves the
environment is checked, and the stored heat is balanced against the heat that flowed in and out. The first error stops
the command and names the case, the step and the slot.
"""

import argparse
from dataclasses import replace

from cz_gym.config import make_config
from cz_gym.env import CzVectorEnv
from cz_gym.episodes.scenario import Interface
from cz_gym.episodes.scenarios import HARD, PULLER, SCENARIOS
from cz_gym.support.units import MM

from .adversaries import KINDS, Adversaries
from .checks import Broken, Watch

INTERVALS = (0.5, 1.0, 2.0, 5.0, 7.5, 10.0, 20.0, 30.0, 60.0)
"""Control intervals [s]."""
MODELS = (None, "I", "II")
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
CALLS = 460
"""Steps in a row that a large campaign takes in each case; the rest goes into more slots."""


def cases():
    """Each scenario and "wide" at each interval; models and observations take turns, so that all meet."""
    return [
        make_config(scenario, MODELS[(at + turn) % 3], OBSERVATIONS[(at + 2 * turn) % 3], interval, action="direct")
        for at, scenario in enumerate((*SCENARIOS, WIDE))
        for turn, interval in enumerate(INTERVALS)
    ]


def run_case(config, steps, seed):
    """About ``steps`` slot steps of one case, at least one, all checked; raises :class:`Broken`."""
    n = len(KINDS) * max(1, round(steps / CALLS / len(KINDS)))
    # The horizon is cut so that every case meets ends by time as well.
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
    return watch


def campaign(configs, steps, seed=0):
    """Share ``steps`` among the cases; raises :class:`Broken` with the name of the case in front."""
    watches = []
    for number, config in enumerate(configs):
        try:
            watches.append(run_case(config, -(-steps // len(configs)), seed + number))
        except Broken as broken:
            name = f"{config.scenario.name}, model {config.model}, {config.observation}, {config.control_interval:g} s"
            raise Broken(f"{name}, seed {seed + number}: {broken}") from None
    return watches


if __name__ == "__main__":
    parser = argparse.ArgumentParser("python -m tests.stress", description="Adversarial steps, checked at each.")
    parser.add_argument("--steps", type=int, default=1_000_000, help="slot steps in all (%(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of actions and episodes (%(default)s)")
    arguments = parser.parse_args()
    watches = campaign(cases(), arguments.steps, arguments.seed)
    print(
        f"{len(watches)} cases, {sum(watch.episodes for watch in watches):,} episodes, "
        f"{sum(watch.failures for watch in watches):,} failures; "
        f"missing heat {max(watch.missing_heat for watch in watches):.1e} at most"
    )
