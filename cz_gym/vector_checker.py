"""A checker of vector environments: ``cz_gym.check_vector_env`` compares one with a vector of its scalar form.

It takes any of Gymnasium's vector environments, not this package's alone. Slot i with seed ``seeds[i]`` must equal the
scalar form with that seed: spaces, observations, rewards, ends, infos and autoreset. A vector that takes one seed
alone, as Gymnasium's own native ones do, must instead repeat itself. Returned arrays must never be written or read
again. The first difference is told in one line.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, nullcontext
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import batch_space, iterate

RESULT = ("observation", "reward", "terminated", "truncated", "info")


class NotConforming(AssertionError):
    """A vector environment differs from a vector of its scalar form; the message is one line."""


class Event(NamedTuple):
    """A call, its result, and the slots whose observation is an episode's first, bool of shape (num_envs,)."""

    call: str
    result: tuple[Any, ...]
    first: Any


@dataclass
class Driver:
    """Runs environments in one autoreset mode, and counts the native form's episodes, failures and kept arrays."""

    make_vector: Callable[[int, AutoresetMode], Any]
    make_scalar: Callable[[], Any]
    num_envs: int
    steps: int
    seed: int
    mode: AutoresetMode
    infos: bool = True
    rtol: float = 0.0
    by_slot: bool = True
    """Each slot is compared with the scalar form; False for a vector that takes no list of seeds."""
    episodes: int = 0
    failures: int = 0
    held: int = 0

    @property
    def seeds(self) -> list[int]:
        """Seeds of the slots."""
        return [self.seed + i for i in range(self.num_envs)]

    def vector(self) -> Any:
        """A new native form, as a context."""
        return closing(self.make_vector(self.num_envs, self.mode))

    def scalars(self) -> Any:
        """A new vector of the scalar form, as a context."""
        return closing(SyncVectorEnv([self.make_scalar] * self.num_envs, autoreset_mode=self.mode))

    def require(self, fact: Any, message: str) -> None:
        """Raise :class:`NotConforming` unless the fact is true."""
        if not fact:
            raise NotConforming(f"[{self.mode.value}] {message}")

    def begin(self, env: Any, seed: Any) -> Any:
        """Reset an environment; :class:`NotConforming` if it does not take seeds as Gymnasium's own vectors do."""
        try:
            return env.reset(seed=seed)
        except (TypeError, ValueError, gym.error.Error) as error:
            said = " ".join(f"{type(error).__name__}: {error}".split())
            raise NotConforming(f"[{self.mode.value}] reset(seed={seed}) raises {said:.200}") from error

    def run(self, env: Any, counts: bool = False, overwrites: bool = False) -> Iterator[Event]:
        """Reset and step with sampled actions, which ``overwrites`` spoils; if ``DISABLED``, reset ended slots."""
        env.action_space.seed(self.seed)
        over, none = np.zeros(self.num_envs, np.bool_), np.zeros(self.num_envs, np.bool_)
        yield self.event("reset", self.begin(env, self.seeds if self.by_slot else self.seed), ~none)
        for k in range(self.steps):
            action = env.action_space.sample()
            given = [(array.value, array.value.copy()) for array in flatten(action)]
            result = env.step(action)
            self.require(all(np.array_equal(a, b) for a, b in given), f"step {k} wrote into the actions it was given")
            if overwrites:
                overwrite(action)
            ended = np.array(result[2] | result[3], np.bool_)
            self.episodes += counts * int(ended.sum())
            self.failures += counts * int(np.sum(result[2]))
            begun = {AutoresetMode.NEXT_STEP: over, AutoresetMode.SAME_STEP: ended}.get(self.mode, none)
            over = ended.copy()
            yield self.event(f"step {k}", result, begun.copy())
            if self.mode == AutoresetMode.DISABLED and over.any():
                mask = over.copy()
                again = env.reset(options={"reset_mask": mask})
                mask[:] = True
                yield self.event(f"reset of ended slots after step {k}", again, over)

    def event(self, call: str, result: tuple[Any, ...], first: Any) -> Event:
        """An event, without the infos unless they are compared."""
        return Event(call, result if self.infos else (*result[:-1], {}), first)

    def takes_lists(self) -> bool:
        """True if the native form takes a seed for each slot; Gymnasium asks for a whole number alone."""
        with self.vector() as env:
            try:
                env.reset(seed=self.seeds)
            except (TypeError, ValueError, AssertionError, gym.error.Error):
                return False
        return True


def check_vector_env(
    make_vector: Callable[[int, AutoresetMode], Any],
    make_scalar: Callable[[], Any],
    *,
    mode: AutoresetMode = AutoresetMode.NEXT_STEP,
    num_envs: int = 3,
    steps: int = 200,
    seed: int = 0,
    random_start: bool = True,
    infos: bool = True,
    rtol: float = 0.0,
) -> Driver:
    """Raise :class:`NotConforming` in one line unless a vector environment equals a vector of scalars; return counts.

    ``make_vector(num_envs, mode)`` makes the vector environment, ``make_scalar()`` the environment that each slot must
    equal. ``steps`` batched steps with sampled actions must end episodes (give a short horizon). ``random_start`` says
    whether first observations of different episodes differ, ``infos`` whether infos are looked at too, ``rtol`` by how
    much, relative to them, numbers may differ: 0 means bit for bit. The result's ``by_slot`` says whether slots were
    compared with scalars.
    """
    driver = Driver(make_vector, make_scalar, num_envs, steps, seed, mode, infos, rtol)
    _check_spaces(driver)
    driver.by_slot = driver.takes_lists()
    try:
        _check_seeds(driver, random_start)
        _check_equality(driver, random_start)
    except NotConforming:
        if driver.by_slot:
            _check_scalar(driver)
        raise
    _check_kept(driver)
    _check_writes(driver)
    return driver


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
        return deepcopy(list(iterate(env.observation_space, driver.begin(env, seed)[0])))


def _check_seeds(driver: Driver, random_start: bool) -> None:
    seed, n = driver.seed, driver.num_envs
    expected = _first(driver, seed)
    with driver.vector() as env:
        for what in ("a second environment", "a second reset"):
            again = data_equivalence(_first(driver, seed, env), expected, exact=True)
            driver.require(again, f"seed {seed} gives another first observation in {what}")
        unseeded = _first(driver, None, env)
    seeds = [seed + 7 * (n - i) for i in range(n)]
    for i, slot in enumerate(_first(driver, seeds) if driver.by_slot else ()):
        with closing(driver.make_scalar()) as scalar:
            differs = difference(flatten(slot), flatten(scalar.reset(seed=seeds[i])[0]), rtol=driver.rtol)
        driver.require(not differs, f"seed list: slot {i} with seed {seeds[i]} differs from the scalar with that seed")
    pairs = [
        (_first(driver, seed + 1000), expected, f"seeds {seed} and {seed + 1000} give the same first observations"),
        (unseeded, expected, "a reset without seed repeats the last one: both give the same first observations"),
        (_first(driver, None), expected, f"no seed and seed {seed} give the same first observations"),
        *((expected[i], expected[0], f"slots 0 and {i} have the same first observation") for i in range(1, n)),
    ]
    for one, other, message in pairs if random_start else ():
        driver.require(not data_equivalence(one, other, exact=True), message)


def _check_scalar(driver: Driver) -> None:
    """Nothing can be compared with a scalar form that does not repeat itself."""
    with driver.scalars() as first, driver.scalars() as second:
        for one, other in zip(driver.run(first), driver.run(second), strict=True):
            found = difference(flatten(one.result, "result"), flatten(other.result, "result"), True, driver.rtol)
            driver.require(not found, f"{one.call}: the scalar form differs from itself with the same seed: {found}")


def _check_equality(driver: Driver, random_start: bool) -> None:
    """Every result equals the scalars', and every episode of a slot has a first observation of its own.

    Without a seed for each slot a second native form stands in for the scalars.
    """
    begun: list[list[Any]] = [[] for _ in range(driver.num_envs)]
    against = "native and scalar" if driver.by_slot else "two vectors with one seed"
    with driver.vector() as env, driver.scalars() if driver.by_slot else driver.vector() as oracle:
        for one, other in zip(driver.run(env, counts=True), driver.run(oracle), strict=True):
            fits = driver.by_slot or env.observation_space.contains(one.result[0])
            driver.require(fits, f"{one.call}: the observation is not in observation_space")
            slots = list(iterate(env.observation_space, one.result[0]))
            for i in np.flatnonzero(one.first).tolist() if random_start else ():
                again = any(data_equivalence(slots[i], old, exact=True) for old in begun[i])
                driver.require(not again, f"{one.call}: slot {i} begins again with a first observation it had before")
                begun[i].append(deepcopy(slots[i]))
            driver.require(one.call == other.call, f"{one.call} where the other has {other.call} ({against})")
            names = RESULT if len(one.result) == 5 else (RESULT[0], RESULT[-1])
            for name, ours, theirs in zip(names, one.result, other.result, strict=True):
                found = difference(flatten(ours, name), flatten(theirs, name), name == "info", driver.rtol)
                driver.require(not found, f"{one.call}: {found} ({against})")
    driver.require(driver.episodes, f"no episode ended in {driver.steps} steps: give more, or a shorter horizon")


def _check_kept(driver: Driver) -> None:
    """Keep every array that was handed out: all must be unchanged at the end."""
    with driver.vector() as env:
        kept = [
            (event.call, array, array.value.tobytes()) for event in driver.run(env) for array in flatten(event.result)
        ]
        for call, array, content in kept:
            driver.require(array.value.tobytes() == content, f"{call}: {array.name} was written by a later call")
    driver.held += len(kept)


def _check_writes(driver: Driver) -> None:
    """Overwrite the results and actions of one of two equal environments; both must go on alike."""
    with driver.vector() as plain, driver.vector() as overwritten:
        for one, other in zip(driver.run(plain), driver.run(overwritten, overwrites=True), strict=True):
            found = difference(flatten(other.result, "result"), flatten(one.result, "result"), masked=True)
            driver.require(not found, f"{one.call}: writing into earlier results or actions changed {found}")
            overwrite(other.result)


class NamedArray(NamedTuple):
    """One array of a nested result; ``mask`` says which slots of an info have a value, None: all."""

    name: str
    value: Any
    mask: Any = None


def flatten(value: Any, name: str = "") -> list[NamedArray]:
    """The arrays of nested mappings, sequences and object arrays, in order; those of an info with its mask."""
    if isinstance(value, dict):
        return [array for key in sorted(value, key=str) for array in _flatten_key(value, key, name)]
    if isinstance(value, tuple | list) or (isinstance(value, np.ndarray) and value.dtype == object and value.ndim > 0):
        return [array for i, part in enumerate(value) if part is not None for array in flatten(part, f"{name}[{i}]")]
    return [NamedArray(name, value if isinstance(value, np.ndarray) else np.asarray(value))]


def _flatten_key(value: dict[Any, Any], key: Any, name: str) -> list[NamedArray]:
    """The arrays of a mapping's key, those of an info with the mask of its slots."""
    by_slot = isinstance(value[key], dict) or np.asarray(value[key]).dtype != object
    mask = value.get(f"_{key}") if isinstance(key, str) and by_slot else None
    found = flatten(value[key], f"{name}[{key!r}]" if name else str(key))
    return [array if array.mask is not None or mask is None else array._replace(mask=mask) for array in found]


def difference(
    one: Sequence[NamedArray], other: Sequence[NamedArray], masked: bool = False, rtol: float = 0.0
) -> str | None:
    """The first difference in words, or None; ``masked`` compares infos where masks are true, of any dtype but bool."""
    names = [[array.name for array in arrays] for arrays in (one, other)]
    if names[0] != names[1]:
        odd = sorted(set(names[0]) ^ set(names[1]))
        return f"{', '.join(odd[:3]) or 'the order of parts'} is in one only"
    for (name, a, _), (_, b, mask) in zip(one, other, strict=True):
        if a.shape != b.shape or (a.dtype != b.dtype and (not masked or b.dtype == np.bool_)):
            return f"{name} is {a.dtype} {a.shape} and {b.dtype} {b.shape}"
        unlike = _unlike(a, b, mask if masked else None, rtol)
        if unlike.any():
            at = tuple(int(i) for i in np.argwhere(unlike)[0])
            return f"{name}{f' of slot {at[0]}' if at else ''} is {a[at]} and {b[at]}"
    return None


def _unlike(a: Any, b: Any, mask: Any, rtol: float) -> Any:
    """Where two arrays of one shape differ, bool of that shape; NaN is like NaN."""
    unlike = np.asarray((a != b) & ((a == a) | (b == b)))
    if rtol and a.dtype.kind == "f":
        unlike &= ~np.isclose(a, b, rtol=rtol, atol=rtol, equal_nan=True)
    if mask is not None and a.ndim > 0 and mask.shape == a.shape[:1]:
        unlike &= mask.reshape(-1, *[1] * (a.ndim - 1))
    return unlike


def overwrite(value: Any) -> None:
    """Overwrite every writeable array of a nested value with ones."""
    for array in flatten(value):
        if array.value.flags.writeable and array.value.dtype != object:
            array.value[...] = 1
