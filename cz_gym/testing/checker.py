"""Is a native vector environment what a vector of its scalar form would be? :func:`check_vector_env`.

For any :class:`gymnasium.vector.VectorEnv` that has a scalar counterpart. The oracle is Gymnasium's own
:class:`gymnasium.vector.SyncVectorEnv` of the scalars, in every autoreset mode; what it cannot show, that nothing
returned is written again or read back, is attacked directly. ``python -m cz_gym.testing.checker`` runs it on ``Cz-v0``.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import closing
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from cz_gym.commands import OneLineParser

from .driver import Checked, Event, MakeScalar, MakeVector, NotConforming, Subject, need, play
from .nested_arrays import HOLDERS, Held, Leaf, difference, hold, leaves, spoil

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
    total = Checked(0, 0, 0, 0)
    for mode in modes:
        subject = Subject(make_vector, make_scalar, num_envs, steps, seed, AutoresetMode(mode), random_start, rtol)
        _check_spaces(subject)
        _check_seeds(subject)
        for check in (_check_redraws, _check_equality, _check_aliasing, _check_single_holds, _check_writes):
            total += check(subject)
    return total


def _check_spaces(subject: Subject) -> None:
    with subject.vector() as env, closing(subject.make_scalar()) as scalar:
        n = subject.num_envs
        need(env.num_envs == n, subject, f"num_envs is {env.num_envs}, asked for {n}")
        declared = env.metadata.get("autoreset_mode")
        need(declared == subject.mode, subject, f"metadata['autoreset_mode'] is {declared!r}")
        for name in ("action_space", "observation_space"):
            alone, single, batched = getattr(scalar, name), getattr(env, f"single_{name}"), getattr(env, name)
            need(single == alone, subject, f"single_{name} is {single}, the scalar's is {alone}")
            expected = batch_space(single, n)
            need(batched == expected, subject, f"{name} is {batched}, the batch of {n} is {expected}")


def _check_types(event: Event, env: Any, subject: Subject) -> None:
    """Shapes and dtypes of what a call returned."""
    call, n = event.call, subject.num_envs
    observation, infos = event.result[0], event.result[-1]
    inside = env.observation_space.contains(observation)
    need(inside, subject, f"{call}: the observation is not in observation_space (shape, dtype or bounds)")
    if len(event.result) == 5:
        for name, array, dtype in zip(_RESULT[1:4], event.result[1:4], (np.float64, np.bool_, np.bool_), strict=True):
            fits = isinstance(array, np.ndarray) and array.shape == (n,) and array.dtype == dtype
            found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
            need(fits, subject, f"{call}: {name} must be {np.dtype(dtype)} of shape ({n},), is {found}")
    need(isinstance(infos, dict), subject, f"{call}: infos must be a dict, is {type(infos).__name__}")
    for key in infos:
        mask = infos.get(f"_{key}", None) if not key.startswith("_") else infos[key]
        fits = isinstance(mask, np.ndarray) and mask.shape == (n,) and mask.dtype == np.bool_
        need(fits, subject, f"{call}: info {key!r} needs a mask '_{key.lstrip('_')}', bool of shape ({n},)")


def _first(subject: Subject, seed: Any, env: Any = None) -> list[Leaf]:
    """Copies of the first observation of every slot."""
    if env is None:
        with subject.vector() as fresh:
            return _first(subject, seed, fresh)
    return [leaf.copy() for leaf in leaves(env.reset(seed=seed)[0])]


def _check_seeds(subject: Subject) -> None:
    seed, n = subject.seed, subject.num_envs
    expected = _first(subject, seed)
    with subject.vector() as env:
        for what in ("a second environment", "a second reset"):
            same = difference(_first(subject, seed, env), expected) is None
            need(same, subject, f"seed {seed} gives another first observation in {what}")
        unseeded = _first(subject, None, env)
    listed = [seed + 7 * (n - i) for i in range(n)]
    given = _first(subject, listed)
    for i in range(n):
        with closing(subject.make_scalar()) as scalar:
            alone = leaves(scalar.reset(seed=listed[i])[0])
        same = difference([leaf.at(i) for leaf in given], alone, subject.rtol) is None
        need(same, subject, f"seed list: slot {i} with seed {listed[i]} differs from the scalar with that seed")
    if not subject.random_start:
        return
    for other, what in (
        (_first(subject, seed + 1000), f"seeds {seed} and {seed + 1000} give"),
        (unseeded, "a reset without seed repeats the last one: both give"),
        (_first(subject, None), f"no seed and seed {seed} give"),
    ):
        need(difference(other, expected) is not None, subject, f"{what} the same first observations")
    for i in range(1, n):
        alike = difference([leaf.at(i) for leaf in expected], [leaf.at(0) for leaf in expected]) is None
        need(not alike, subject, f"slots 0 and {i} have the same first observation")


def _check_redraws(subject: Subject) -> Checked:
    """Shapes and dtypes throughout, and a new first observation after every end."""
    begun: list[list[list[Leaf]]] = [[] for _ in range(subject.num_envs)]
    episodes = failures = 0
    with subject.vector() as env:
        for event in play(env, subject):
            _check_types(event, env, subject)
            episodes, failures = episodes + int(event.ended.sum()), failures + int(event.failed.sum())
            for i in np.flatnonzero(event.first).tolist():
                new = [leaf.at(i).copy() for leaf in leaves(event.result[0])]
                again = subject.random_start and any(difference(new, old) is None for old in begun[i])
                need(not again, subject, f"{event.call}: slot {i} begins again with a first observation it had before")
                begun[i].append(new)
    need(episodes, subject, f"no episode ended in {subject.steps} steps: give more steps or a shorter horizon")
    return Checked(subject.steps, episodes, failures, 0)


def _check_equality(subject: Subject) -> Checked:
    episodes = failures = 0
    with subject.vector() as env, subject.scalars() as oracle:
        for one, other in zip(play(env, subject), play(oracle, subject), strict=True):
            need(one.call == other.call, subject, f"{one.call} where the scalars have {other.call}")
            names = _RESULT if len(one.result) == 5 else (_RESULT[0], _RESULT[-1])
            for name, ours, theirs in zip(names, one.result, other.result, strict=True):
                found = difference(leaves(ours, name), leaves(theirs, name), subject.rtol, masked=name == "info")
                need(found is None, subject, f"{one.call}: {found} (native and scalar)")
            episodes, failures = episodes + int(one.ended.sum()), failures + int(one.failed.sum())
    return Checked(subject.steps, episodes, failures, 0)


def _check_aliasing(subject: Subject) -> Checked:
    """Keep everything, each array by another kind of holder, and look again at the end."""
    kept: list[tuple[str, Held]] = []
    with subject.vector() as env:
        for event in play(env, subject):
            for leaf in leaves(event.result, ""):
                kept.append((event.call, hold(leaf, len(kept) % len(HOLDERS))))
        _need_unchanged(kept, subject)
    return Checked(subject.steps, 0, 0, len(kept))


def _check_single_holds(subject: Subject) -> Checked:
    """Keep one array of each call alone, so that whatever is recycled by need is recycled around it."""
    kept: list[tuple[str, Held]] = []
    with subject.vector() as env:
        for number, event in enumerate(play(env, subject)):
            found = leaves(event.result, "")
            kept.append((event.call, hold(found[number // len(HOLDERS) % len(found)], number % len(HOLDERS))))
            del found, event
        _need_unchanged(kept, subject)
    return Checked(subject.steps, 0, 0, len(kept))


def _need_unchanged(kept: list[tuple[str, Held]], subject: Subject) -> None:
    for call, held in kept:
        need(held.unchanged(), subject, f"{call}: {held.name} (kept as {held.holder}) was written by a later call")


def _check_writes(subject: Subject) -> Checked:
    """Overwrite all that one of two equal environments returns, and the actions it was given."""
    with subject.vector() as plain, subject.vector() as spoilt:
        for one, other in zip(play(plain, subject), play(spoilt, subject, spoils=True), strict=True):
            found = difference(leaves(other.result, "result"), leaves(one.result, "result"), masked=True)
            need(found is None, subject, f"{one.call}: writing into earlier results or actions changed {found}")
            spoil(other.result)
    return Checked(subject.steps, 0, 0, 0)


class _Case(NamedTuple):
    """A case of the command."""

    settings: dict[str, Any]
    share: float
    """Of the steps asked for [-]."""
    random_start: bool


def _cz_cases() -> list[_Case]:
    """Every scenario with every observation: short episodes of long steps, so that many end; few images, which cost.

    A first image may be black, as another one: on "sensor-fault" images do not tell episodes apart.
    """
    from cz_gym.episodes.scenarios import SCENARIOS
    from cz_gym.observation import CAMERA, OBSERVATIONS

    random_at_start = {"randomized", "hard", "sensor-fault", "puller", "only-sensor"}
    alike = {("only-sensor", "state"), ("sensor-fault", CAMERA)}
    cases = []
    for scenario in SCENARIOS:
        for observation in (*OBSERVATIONS, CAMERA):
            images = observation == CAMERA
            settings = {
                "scenario": scenario, "observation": observation, "control_interval": 60.0,
                "horizon": 180.0 if images else 1200.0,
            }  # fmt: skip
            random = scenario in random_at_start and (scenario, observation) not in alike
            cases.append(_Case(settings, 0.08 if images else 1.0, random))
    return cases


def main(argv: Sequence[str] | None = None) -> int:
    """Check ``Cz-v0`` on every scenario, observation and autoreset mode; print the counts."""
    parser = OneLineParser(
        "python -m cz_gym.testing.checker", "Check Cz-v0's native vector form against its scalar form."
    )
    parser.add_argument("--steps", type=int, default=50, help="batched steps a case, images fewer (%(default)s)")
    parser.add_argument("--slots", type=int, default=3, help="slots of the batch (%(default)s)")
    arguments = parser.parse_args(argv)
    if arguments.steps < 50 or arguments.slots < 2:
        parser.error(
            f"needs --steps of at least 50 and --slots of at least 2, not {arguments.steps}, {arguments.slots}"
        )
    total, cases = Checked(0, 0, 0, 0), _cz_cases()
    for settings, share, random_start in cases:
        found = check_vector_env(
            lambda n, mode, settings=settings: gym.make_vec(  # type: ignore[misc]
                "Cz-v0", num_envs=n, vectorization_mode="vector_entry_point", autoreset_mode=mode, **settings
            ),
            lambda settings=settings: gym.make("Cz-v0", **settings).unwrapped,  # type: ignore[misc]
            num_envs=arguments.slots,
            steps=max(4, round(share * arguments.steps)),
            random_start=random_start,
        )
        print(f"{settings['scenario']}, {settings['observation']}: {found}", flush=True)
        total += found
    print(f"{len(cases)} cases conform: {total}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
