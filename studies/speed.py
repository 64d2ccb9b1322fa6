"""Speed of the environments, beside Pendulum-v1 of Gymnasium and EnvPool: ``python -m studies.speed [--json FILE]``.

Every case is measured in turn, the round is repeated, and medians are reported, so that a machine that is busy for a
while slows all cases alike. Steps per second count every slot's step, resets included unless a name says otherwise.
"""

import argparse
import statistics
import sys
import timeit
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from cz_gym.config import make_config
from cz_gym.engine.batch import Batch, processors
from cz_gym.engine.tangents import DifferentiableBatch
from cz_gym.env import CzEnv, CzVectorEnv
from cz_gym.support.command_line import OneLineParser
from cz_gym.support.errors import software
from cz_gym.support.files import check_writable, write_files

from . import to_json

QUICK, FULL = 3, 15
"""Rounds of a measurement."""
THREADS = processors()
"""Threads that the larger cases may use."""
SLOTS, SB3_SLOTS = 1024, 256
"""Slots of the batches that are compared, and of those behind stable-baselines3."""
UNFAILED = 50
"""Steps that every crystal survives in open loop."""


class Stepper(NamedTuple):
    """Environment or loop whose steps are timed."""

    num_envs: int
    step: Callable[[], Any]
    """Makes one step of every slot."""
    close: Callable[[], Any] = lambda: None


RATIOS = {
    "scalar_vs_pendulum": ("Cz-v0 scalar", "Pendulum-v1 scalar", 1.7),
    "vector1024_vs_envpool_pendulum": ("Cz-v0 batch, measured", "EnvPool Pendulum-v1", 5.0),
    "vector1024_vs_kernel": ("Cz-v0 batch without resets, 1 thread", "bare compiled plant and ring, 1 thread", 0.65),
    "sb3_adapter_vs_dummy": ("SB3 adapter over the batch", "SB3 DummyVecEnv", 12.0),
    "derivatives_vs_step": ("step with derivatives", "step without derivatives", 0.125),
}
"""Two rows, each the fastest whose name begins so, and the least ratio of their speeds that is aimed at."""


def cases(slots: int = SLOTS, sb3_slots: int = SB3_SLOTS) -> dict[str, Callable[[], Any]]:
    """List functions that make an environment, scalar or batched, or a :class:`Stepper`, by the name of their row."""
    rows: dict[str, Callable[[], Any]] = {
        f"{name} scalar": partial(gym.make, name) for name in ("Cz-v0", "Pendulum-v1")
    }
    for name, make in (
        ("Cz-v0 batch, measured", our_batch),
        ("Cz-v0 batch without resets", partial(our_batch, resets=False)),
        ("bare compiled plant and ring", bare_plant),
        ("EnvPool Pendulum-v1", envpool),
    ):
        for n in sorted({1, THREADS}):
            rows[f"{name}, {n} thread{'s' * (n > 1)}"] = partial(make, slots, n)
    rows["step without derivatives"] = partial(differentiable, False)
    rows["step with derivatives"] = partial(differentiable, True)
    rows["SB3 adapter over the batch"] = partial(for_sb3, sb3_slots)
    rows["SB3 DummyVecEnv"] = partial(for_sb3, sb3_slots, dummy=True)
    rows["Cz-v0 scalar, camera"] = partial(CzEnv, "nominal", observation="camera")
    return rows


def stepper(env: Any) -> Stepper:
    """Step the environment of any library with actions of zero, and reset it where it does not reset itself."""
    if isinstance(env, Stepper):
        return env
    if getattr(env, "num_envs", None) is not None:
        env.reset()
        return batched(env, env.num_envs)
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, env.action_space.dtype)[()]

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return Stepper(1, step, env.close)


def batched(env: Any, num_envs: int) -> Stepper:
    """Step a batch of any library, after its reset, with actions of zero."""
    space = getattr(env, "single_action_space", env.action_space)
    action = np.zeros((num_envs, *space.shape), space.dtype)
    return Stepper(num_envs, lambda: env.step(action), env.close)


def our_batch(num_envs: int, threads: int, resets: bool = True) -> Stepper:
    """Make the native batch at random steps of its episodes; without ``resets`` it repeats the same first minutes."""
    env = CzVectorEnv(num_envs, observation="measured", threads=threads)
    env.reset(seed=0)
    if not resets:
        return repeated(env._batch, batched(env, num_envs))
    env._batch.memory.slots["k"] = np.random.default_rng(0).integers(0, env.config.steps, num_envs)
    return batched(env, num_envs)


def bare_plant(num_envs: int, threads: int) -> Stepper:
    """Make the compiled plant and bright ring alone, without sensors, observation, reward, info or Python shell."""
    batch = Batch(make_config(observation="measured"), num_envs, threads)
    rings = np.zeros(num_envs)
    batch.reset(range(num_envs), [(i, i) for i in range(num_envs)], batch.new_out())
    return repeated(batch, Stepper(num_envs, lambda: batch.advance(rings), batch.close))


def repeated(batch: Batch, stepper: Stepper) -> Stepper:
    """Return the stepper with slots that go back to their present state before any crystal fails."""
    slots, first = batch.memory.slots, batch.memory.slots.copy()

    def step() -> None:
        stepper.step()
        if slots["k"][0] >= UNFAILED:
            slots[:] = first

    return stepper._replace(step=step)


def differentiable(derivatives: bool) -> Stepper:
    """Make a batch of 256 slots that repeats the same first minutes, with derivatives at each step or without."""
    batch = DifferentiableBatch(make_config(), 256)
    batch.reset(range(256))
    inner, out, action = batch._batch, batch._batch.new_out(), np.zeros((256, 2))
    step = (lambda: batch.step(action)) if derivatives else (lambda: inner.step(action, out))
    return repeated(inner, Stepper(256, step, batch.close))


def for_sb3(num_envs: int, dummy: bool = False) -> Any:
    """Make the adapter for stable-baselines3 over the native batch, or its own vector of scalar environments."""
    from stable_baselines3.common.vec_env import DummyVecEnv

    from cz_gym.sb3 import make_vec_env

    return DummyVecEnv([partial(gym.make, "cz_gym:Cz-v0")] * num_envs) if dummy else make_vec_env(num_envs)


def envpool(num_envs: int, threads: int) -> Stepper:
    """Make a batch of pendulums in EnvPool, whose steps are C++."""
    make = import_module("envpool").make  # it has no wheel for every system, and no types
    env = make("Pendulum-v1", env_type="gymnasium", num_envs=num_envs, num_threads=threads)
    env.reset()
    return batched(env, num_envs)


def measure(wanted: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, Any]:
    """Measure median speeds over interleaved rounds and their ratios; reasons of skipped cases: content of the JSON."""
    from tqdm import tqdm

    running: dict[str, tuple[Stepper, timeit.Timer, int]] = {}
    skipped = {}
    for name, make in wanted.items():
        try:
            timed = stepper(make())
            timed.step()
        except Exception as error:  # a missing or broken peer must not end the run
            skipped[name] = f"{type(error).__name__}: {' '.join(str(error).split())}"[:100]
            continue
        timer = timeit.Timer(timed.step, "import gc; gc.enable()")
        running[name] = timed, timer, timer.autorange()[0]
    speeds: dict[str, list[float]] = {name: [] for name in running}
    for _ in tqdm(range(rounds), desc="rounds", disable=None):
        for name, (timed, timer, calls) in running.items():
            speeds[name].append(calls * timed.num_envs / timer.timeit(calls))
    for timed, *_ in running.values():
        timed.close()
    medians = {name: statistics.median(values) for name, values in speeds.items()}
    rows = [
        {"name": name, "num_envs": running[name][0].num_envs, "steps_per_s": speed} for name, speed in medians.items()
    ]
    ratios = {name: ratio(medians, *pair) for name, (*pair, _) in RATIOS.items()}
    versions = software(("gymnasium", "numpy", "numba", "stable-baselines3", "envpool"))
    return {"ratios": ratios, "rows": rows, "skipped": skipped, "threads": THREADS, "software": versions}


def ratio(speeds: Mapping[str, float], row: str, over: str) -> float | None:
    """Ratio of the fastest rows whose names begin so; None where one is missing."""
    above, below = (
        max((speed for name, speed in speeds.items() if name.startswith(begins)), default=None)
        for begins in (row, over)
    )
    return None if above is None or below is None else above / below


def table(result: Mapping[str, Any]) -> str:
    """Write the result as text."""
    lines = [f"{'':44}{'slots':>7}{'steps/s':>14}{'us/step':>10}"]
    for row in result["rows"]:
        speed = row["steps_per_s"]
        lines.append(f"{row['name']:44}{row['num_envs']:7d}{speed:14,.0f}{1e6 / speed:10.3f}")
    lines += [f"{name:44}skipped: {why}" for name, why in result["skipped"].items()] + [""]
    for name, value in result["ratios"].items():
        shown, aim = "-" if value is None else f"{value:.2f}", RATIOS[name][2]
        lines.append(f"{name:44}{shown:>10} x   (at least {aim:g} x)")
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Measure and print; 2 if the file cannot be written."""
    parser = OneLineParser(prog="python -m studies.speed", description="Measure speed beside installed peers.")
    parser.add_argument("--quick", action="store_true", help="fewer repeats: under 40 s")
    parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures here")
    return parser.run(_main, argv, "benchmark")


def _main(arguments: argparse.Namespace) -> None:
    if arguments.json is not None:
        check_writable(arguments.json.parent)
    result = measure(cases(), QUICK if arguments.quick else FULL)
    print(table(result))
    if arguments.json is not None:
        write_files({arguments.json: to_json(result)})


if __name__ == "__main__":
    sys.exit(main())
