"""Is a native vector environment what a vector of its scalar form would be? :func:`check_vector_env`.

For any :class:`gymnasium.vector.VectorEnv` that has a scalar counterpart. The oracle is Gymnasium's own
:class:`gymnasium.vector.SyncVectorEnv` of the scalars, in every autoreset mode; what it cannot show, that nothing
returned is written again or read back, is attacked directly. ``python -m cz_gym.testing.checker`` runs it on ``Cz-v0``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from cz_gym.commands import OneLineParser
from cz_gym.episodes import scenarios
from cz_gym.observation import CAMERA, OBSERVATIONS

from .driver import Checked, Event, MakeScalar, MakeVector, NotConforming, Setup, run
from .nested_arrays import KEEPERS, Kept, NamedArray, difference, flatten, keep, overwrite

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
    rtol: float = 0.0,
) -> Checked:
    """Raise :class:`NotConforming` in one line unless the native form equals a vector of scalars; return the counts.

    ``make_vector(num_envs, mode)`` makes the native form, ``make_scalar()`` one slot of it. ``steps`` batched steps
    with sampled actions must end episodes in every mode (give a short horizon). ``random_start`` says whether first
    observations of different episodes differ; ``rtol`` is the tolerance of floats [-], 0 for bit equality.
    Checked in each mode: spaces, shapes and dtypes; seeds (one, a list, none); that autoreset draws a new
    episode; every observation, reward, end, info, final observation and final info against the scalars; that a
    reset mask resets its slots alone and is not kept; that nothing returned is written later, whoever holds it
    (views, buffers, ctypes), and that writing into it or into the actions changes nothing inside.
    """
    if num_envs < 2 or steps < 2 or not modes:
        raise ValueError(f"a check needs num_envs >= 2, steps >= 2 and a mode, not {num_envs}, {steps}, {modes!r}")
    total = Checked()
    for mode in modes:
        setup = Setup(make_vector, make_scalar, num_envs, steps, seed, AutoresetMode(mode), random_start, rtol)
        _check_spaces(setup)
        _check_seeds(setup)
        total += _check_redraws(setup) + _check_equality(setup) + _check_writes(setup)
        total += _check_kept(setup, every=True) + _check_kept(setup, every=False)
    return total


def _check_spaces(setup: Setup) -> None:
    with setup.vector() as env, closing(setup.make_scalar()) as scalar:
        n = setup.num_envs
        setup.require(env.num_envs == n, f"num_envs is {env.num_envs}, asked for {n}")
        declared = env.metadata.get("autoreset_mode")
        setup.require(declared == setup.mode, f"metadata['autoreset_mode'] is {declared!r}")
        for name in ("action_space", "observation_space"):
            alone, single, batched = getattr(scalar, name), getattr(env, f"single_{name}"), getattr(env, name)
            setup.require(single == alone, f"single_{name} is {single}, the scalar's is {alone}")
            expected = batch_space(single, n)
            setup.require(batched == expected, f"{name} is {batched}, the batch of {n} is {expected}")


def _check_types(event: Event, env: Any, setup: Setup) -> None:
    """Shapes and dtypes of what a call returned."""
    call, n = event.call, setup.num_envs
    observation, infos = event.result[0], event.result[-1]
    inside = env.observation_space.contains(observation)
    setup.require(inside, f"{call}: the observation is not in observation_space (shape, dtype or bounds)")
    if len(event.result) == 5:
        for name, array, dtype in zip(_RESULT[1:4], event.result[1:4], (np.float64, np.bool_, np.bool_), strict=True):
            fits = isinstance(array, np.ndarray) and array.shape == (n,) and array.dtype == dtype
            found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
            setup.require(fits, f"{call}: {name} must be {np.dtype(dtype)} of shape ({n},), is {found}")
    setup.require(isinstance(infos, dict), f"{call}: infos must be a dict, is {type(infos).__name__}")
    for key in infos:
        mask = infos[key] if key.startswith("_") else infos.get(f"_{key}")
        fits = isinstance(mask, np.ndarray) and mask.shape == (n,) and mask.dtype == np.bool_
        setup.require(fits, f"{call}: info {key!r} needs a mask '_{key.lstrip('_')}', bool of shape ({n},)")


def _first(setup: Setup, seed: Any, env: Any = None) -> list[list[NamedArray]]:
    """Copies of the first observation of every slot."""
    if env is None:
        with setup.vector() as fresh:
            return _first(setup, seed, fresh)
    arrays = flatten(env.reset(seed=seed)[0])
    return [[array.at(i) for array in arrays] for i in range(setup.num_envs)]


def _check_seeds(setup: Setup) -> None:
    seed, n = setup.seed, setup.num_envs

    def same(one: list[list[NamedArray]], other: list[list[NamedArray]]) -> bool:
        return all(difference(*pair) is None for pair in zip(one, other, strict=True))

    expected = _first(setup, seed)
    with setup.vector() as env:
        for what in ("a second environment", "a second reset"):
            again = same(_first(setup, seed, env), expected)
            setup.require(again, f"seed {seed} gives another first observation in {what}")
        unseeded = _first(setup, None, env)
    listed = [seed + 7 * (n - i) for i in range(n)]
    for i, slot in enumerate(_first(setup, listed)):
        with closing(setup.make_scalar()) as scalar:
            differs = difference(slot, flatten(scalar.reset(seed=listed[i])[0]), setup.rtol)
        setup.require(not differs, f"seed list: slot {i} with seed {listed[i]} differs from the scalar with that seed")
    if not setup.random_start:
        return
    for other, what in (
        (_first(setup, seed + 1000), f"seeds {seed} and {seed + 1000} give"),
        (unseeded, "a reset without seed repeats the last one: both give"),
        (_first(setup, None), f"no seed and seed {seed} give"),
    ):
        setup.require(not same(other, expected), f"{what} the same first observations")
    for i in range(1, n):
        unlike = difference(expected[i], expected[0])
        setup.require(unlike, f"slots 0 and {i} have the same first observation")


def _check_redraws(setup: Setup) -> Checked:
    """Shapes and dtypes throughout, and a new first observation after every end."""
    begun: list[list[list[NamedArray]]] = [[] for _ in range(setup.num_envs)]
    seen = Checked(setup.steps)
    with setup.vector() as env:
        for event in run(env, setup):
            _check_types(event, env, setup)
            seen += _ends(event)
            for i in np.flatnonzero(event.first).tolist():
                new = [array.at(i) for array in flatten(event.result[0])]
                again = setup.random_start and any(difference(new, old) is None for old in begun[i])
                setup.require(not again, f"{event.call}: slot {i} begins again with a first observation it had before")
                begun[i].append(new)
    setup.require(seen.episodes, f"no episode ended in {setup.steps} steps: give more steps or a shorter horizon")
    return seen


def _ends(event: Event) -> Checked:
    return Checked(episodes=int(event.ended.sum()), failures=int(event.failed.sum()))


def _check_equality(setup: Setup) -> Checked:
    seen = Checked(setup.steps)
    with setup.vector() as env, setup.scalars() as oracle:
        for one, other in zip(run(env, setup), run(oracle, setup), strict=True):
            setup.require(one.call == other.call, f"{one.call} where the scalars have {other.call}")
            names = _RESULT if len(one.result) == 5 else (_RESULT[0], _RESULT[-1])
            for name, ours, theirs in zip(names, one.result, other.result, strict=True):
                found = difference(flatten(ours, name), flatten(theirs, name), setup.rtol, masked=name == "info")
                setup.require(not found, f"{one.call}: {found} (native and scalar)")
            seen += _ends(one)
    return seen


def _check_kept(setup: Setup, every: bool) -> Checked:
    """Keep every array, each in another way, or one array of each call alone; look again at the end.

    One alone, because memory that is used again once nobody needs it would be used again around it.
    """
    kept: list[tuple[str, Kept]] = []
    with setup.vector() as env:
        for number, event in enumerate(run(env, setup)):
            arrays = flatten(event.result)
            if every:
                kept += [(event.call, keep(array, len(kept) + i)) for i, array in enumerate(arrays)]
            else:
                kept.append((event.call, keep(arrays[number // len(KEEPERS) % len(arrays)], number)))
            del arrays, event
        for call, array in kept:
            setup.require(array.unchanged, f"{call}: {array.name} (kept as {array.keeper}) was written by a later call")
    return Checked(setup.steps, held=len(kept))


def _check_writes(setup: Setup) -> Checked:
    """Overwrite all that one of two equal environments returns, and the actions it was given."""
    with setup.vector() as plain, setup.vector() as overwritten:
        for one, other in zip(run(plain, setup), run(overwritten, setup, overwrites=True), strict=True):
            found = difference(flatten(other.result, "result"), flatten(one.result, "result"), masked=True)
            setup.require(not found, f"{one.call}: writing into earlier results or actions changed {found}")
            overwrite(other.result)
    return Checked(setup.steps)


def _check_cz(scenario: str, observation: str, num_envs: int, steps: int) -> Checked:
    """Check ``Cz-v0`` in short episodes of long steps, so that many end; few images, which cost."""
    images = observation == CAMERA
    settings: dict[str, Any] = {
        "scenario": scenario, "observation": observation, "control_interval": 60.0,
        "horizon": 180.0 if images else 1200.0,
    }  # fmt: skip
    # A first image may be black, as another one: on "sensor-fault" images do not tell episodes apart.
    alike = {("only-sensor", "state"), ("sensor-fault", CAMERA)}
    random_at_start = scenario in {"randomized", "hard", "sensor-fault", "puller", "only-sensor"}
    return check_vector_env(
        lambda n, mode: gym.make_vec("Cz-v0", n, "vector_entry_point", autoreset_mode=mode, **settings),
        lambda: gym.make("Cz-v0", **settings).unwrapped,
        num_envs=num_envs,
        steps=max(4, round(0.08 * steps)) if images else steps,
        random_start=random_at_start and (scenario, observation) not in alike,
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Check ``Cz-v0`` on every scenario, observation and autoreset mode; print the counts."""
    parser = OneLineParser(
        "python -m cz_gym.testing.checker", "Check Cz-v0's native vector form against its scalar form."
    )
    parser.add_argument("--steps", type=int, default=50, help="batched steps a case, images fewer (%(default)s)")
    parser.add_argument("--slots", type=int, default=3, help="slots of the batch (%(default)s)")
    given = parser.parse_args(argv)
    if given.steps < 50 or given.slots < 2:
        parser.error(f"needs --steps of at least 50 and --slots of at least 2, not {given.steps}, {given.slots}")
    total, cases = Checked(), list(product(scenarios.SCENARIOS, (*OBSERVATIONS, CAMERA)))
    for scenario, observation in cases:
        found = _check_cz(scenario, observation, given.slots, given.steps)
        print(f"{scenario}, {observation}: {found}", flush=True)
        total += found
    print(f"{len(cases)} cases conform: {total}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
