"""Comparison of a native vector environment with a vector of its scalar form: :func:`check_vector_env`.

It works for any :class:`gymnasium.vector.VectorEnv` that has a scalar counterpart. The reference is Gymnasium's own
:class:`gymnasium.vector.SyncVectorEnv` of the scalars, in every autoreset mode; further checks show that returned
arrays are never written or read again. ``python -m cz_gym.testing.checker`` runs it on ``Cz-v0``.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from contextlib import closing, nullcontext
from copy import deepcopy
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space, iterate

from cz_gym.episodes import scenarios
from cz_gym.errors import CzError
from cz_gym.observation import CAMERA, OBSERVATIONS
from cz_gym.support.command_line import OneLineParser

from .driver import Checked, Driver, MakeScalar, MakeVector, NotConforming
from .nested_arrays import KEEPERS, difference, flatten, keep, overwrite

__all__ = ["Checked", "NotConforming", "check_vector_env"]

_RESULT = ("observation", "reward", "terminated", "truncated", "info")


def check_vector_env(
    make_vector: MakeVector,
    make_scalar: MakeScalar,
    *,
    num_envs: int = 3,
    steps: int = 200,
    seed: int = 0,
    modes: Sequence[AutoresetMode] = tuple(AutoresetMode),
    random_start: bool = True,
) -> Checked:
    """Raise :class:`NotConforming` in one line unless the native form equals a vector of scalars; return the counts.

    ``make_vector(num_envs, mode)`` makes the native form, ``make_scalar()`` one slot of it. ``steps`` batched steps
    with sampled actions must end episodes in every mode (give a short horizon). ``random_start`` says whether first
    observations of different episodes differ.
    Checked in each mode: spaces, shapes and dtypes; seeds (one, a list, none); that autoreset draws a new
    episode; every observation, reward, end, info, final observation and final info against the scalars; that a
    reset mask resets its slots alone and is not kept; that nothing returned is written later, whoever holds it
    (views, buffers, ctypes), and that writing into it or into the actions changes nothing inside.
    """
    if num_envs < 2 or steps < 2 or not modes:
        raise CzError(f"a check needs num_envs >= 2, steps >= 2 and a mode, not {num_envs}, {steps}, {modes!r}")
    total = Checked()
    for mode in modes:
        driver = Driver(make_vector, make_scalar, num_envs, steps, seed, AutoresetMode(mode))
        _check_spaces(driver)
        _check_seeds(driver, random_start)
        _check_equality(driver, random_start)
        _check_kept(driver, every=True)
        _check_kept(driver, every=False)
        _check_writes(driver)
        total += driver.seen
    return total


def _check_spaces(driver: Driver) -> None:
    with driver.vector() as env, closing(driver.make_scalar()) as scalar:
        n = driver.num_envs
        driver.require(env.num_envs == n, f"num_envs is {env.num_envs}, asked for {n}")
        declared = env.metadata.get("autoreset_mode")
        driver.require(declared == driver.mode, f"metadata['autoreset_mode'] is {declared!r}")
        for name in ("action_space", "observation_space"):
            alone, single, batched = getattr(scalar, name), getattr(env, f"single_{name}"), getattr(env, name)
            driver.require(single == alone, f"single_{name} is {single}, the scalar's is {alone}")
            expected = batch_space(single, n)
            driver.require(batched == expected, f"{name} is {batched}, the batch of {n} is {expected}")


def _first(driver: Driver, seed: Any, env: Any = None) -> list[Any]:
    """Copies of the first observation of every slot; of a new environment unless one is given."""
    with driver.vector() if env is None else nullcontext(env) as env:
        return deepcopy(list(iterate(env.observation_space, env.reset(seed=seed)[0])))


def _check_seeds(driver: Driver, random_start: bool) -> None:
    seed, n = driver.seed, driver.num_envs
    expected = _first(driver, seed)
    with driver.vector() as env:
        for what in ("a second environment", "a second reset"):
            again = data_equivalence(_first(driver, seed, env), expected, exact=True)
            driver.require(again, f"seed {seed} gives another first observation in {what}")
        unseeded = _first(driver, None, env)
    seeds = [seed + 7 * (n - i) for i in range(n)]
    for i, slot in enumerate(_first(driver, seeds)):
        with closing(driver.make_scalar()) as scalar:
            differs = difference(flatten(slot), flatten(scalar.reset(seed=seeds[i])[0]))
        driver.require(not differs, f"seed list: slot {i} with seed {seeds[i]} differs from the scalar with that seed")
    if not random_start:
        return
    for other, what in (
        (_first(driver, seed + 1000), f"seeds {seed} and {seed + 1000} give"),
        (unseeded, "a reset without seed repeats the last one: both give"),
        (_first(driver, None), f"no seed and seed {seed} give"),
    ):
        alike = data_equivalence(other, expected, exact=True)
        driver.require(not alike, f"{what} the same first observations")
    for i in range(1, n):
        alike = data_equivalence(expected[i], expected[0], exact=True)
        driver.require(not alike, f"slots 0 and {i} have the same first observation")


def _check_equality(driver: Driver, random_start: bool) -> None:
    """Every result equals the scalars', and every episode of a slot has a first observation of its own."""
    begun: list[list[Any]] = [[] for _ in range(driver.num_envs)]
    with driver.vector() as env, driver.scalars() as oracle:
        for one, other in zip(driver.run(env), driver.run(oracle, oracle=True), strict=True):
            slots = list(iterate(env.observation_space, one.result[0]))
            for i in np.flatnonzero(one.first).tolist() if random_start else ():
                again = any(data_equivalence(slots[i], old, exact=True) for old in begun[i])
                driver.require(not again, f"{one.call}: slot {i} begins again with a first observation it had before")
                begun[i].append(deepcopy(slots[i]))
            driver.require(one.call == other.call, f"{one.call} where the scalars have {other.call}")
            names = _RESULT if len(one.result) == 5 else (_RESULT[0], _RESULT[-1])
            for name, ours, theirs in zip(names, one.result, other.result, strict=True):
                found = difference(flatten(ours, name), flatten(theirs, name), masked=name == "info")
                driver.require(not found, f"{one.call}: {found} (native and scalar)")
    driver.require(
        driver.seen.episodes, f"no episode ended in {driver.steps} steps: give more steps or a shorter horizon"
    )


def _check_kept(driver: Driver, every: bool) -> None:
    """Keep every array, or one of each call alone, each in another way; all must be unchanged at the end.

    One alone, because an environment that recycles arrays nobody holds would find the others free.
    """
    kept: list[tuple[str, str, Callable[[], bool]]] = []
    with driver.vector() as env:
        for number, event in enumerate(driver.run(env)):
            arrays = flatten(event.result)
            one = number // len(KEEPERS) % len(arrays)
            some = enumerate(arrays, len(kept)) if every else [(number, arrays[one])]
            kept += [(event.call, *keep(array, way)) for way, array in some]
            del arrays, event, some
        for call, name, unchanged in kept:
            driver.require(unchanged(), f"{call}: {name} was written by a later call")
    driver.seen += Checked(held=len(kept))


def _check_writes(driver: Driver) -> None:
    """Overwrite the results and actions of one of two equal environments; both must go on alike."""
    with driver.vector() as plain, driver.vector() as overwritten:
        for one, other in zip(driver.run(plain), driver.run(overwritten, oracle=True, overwrites=True), strict=True):
            found = difference(flatten(other.result, "result"), flatten(one.result, "result"), masked=True)
            driver.require(not found, f"{one.call}: writing into earlier results or actions changed {found}")
            overwrite(other.result)


def _check_cz(scenario: str, observation: str) -> Checked:
    """Check ``Cz-v0`` in short episodes of long steps, so that many end; images, which are slow, for fewer steps."""
    images = observation == CAMERA
    settings: dict[str, Any] = {
        "scenario": scenario, "observation": observation, "control_interval": 60.0,
        "horizon": 180.0 if images else 1200.0,
    }  # fmt: skip
    # Two first images of "sensor-fault" may both be black, so images do not tell its episodes apart.
    alike = {("only-sensor", "state"), ("sensor-fault", CAMERA)}
    random_at_start = scenario in {"randomized", "hard", "sensor-fault", "puller", "only-sensor"}
    return check_vector_env(
        lambda n, mode: gym.make_vec("Cz-v0", n, "vector_entry_point", autoreset_mode=mode, **settings),
        lambda: gym.make("Cz-v0", **settings).unwrapped,
        steps=4 if images else 50,
        random_start=random_at_start and (scenario, observation) not in alike,
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Check ``Cz-v0`` on every scenario, observation and autoreset mode; print the counts."""
    about = "Check Cz-v0's native vector form against its scalar form."
    OneLineParser("python -m cz_gym.testing.checker", about).parse_args(argv)
    total, cases = Checked(), list(product(scenarios.SCENARIOS, (*OBSERVATIONS, CAMERA)))
    for scenario, observation in cases:
        found = _check_cz(scenario, observation)
        print(f"{scenario}, {observation}: {found}", flush=True)
        total += found
    print(f"{len(cases)} cases conform: {total}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
