"""Who takes part in a benchmark: controllers, shipped agents, and agents of files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from cz_gym.contender import Contender
from cz_gym.errors import CzError
from cz_gym.names import unknown

from .protocol import SLOW_EPISODES, Row
from .rollout import check_policy


def agent(name: str, policies: Sequence[Any], own: bool = False) -> Contender:
    """An agent from its policies with a ``contract``, one a training seed.

    It is the user's ``own`` if it was given as a file. Raises CzError if the policies are not training seeds of one
    agent.
    """
    contracts = [policy.contract for policy in policies]
    seeds = tuple(contract.training_seed for contract in contracts)
    if len(set(seeds)) < len(seeds):
        raise CzError(f"agent {name!r}: a training seed appears twice among {', '.join(map(str, seeds))}")
    if len({(contract.observation, contract.action) for contract in contracts}) > 1:
        raise CzError(f"agent {name!r}: its training seeds read different observations, or act differently")
    if len({contract.scenario_hash for contract in contracts}) > 1:
        trained = ", ".join(sorted({contract.scenario for contract in contracts}))
        raise CzError(f"agent {name!r}: its training seeds were trained on different scenarios: {trained}")
    one = contracts[0]
    meaning = f"agent trained with {one.algorithm} on {one.scenario}{', given as a file' if own else ''}"
    make, trained_policies = partial(_first, policies[0]), tuple(policies)
    return Contender(
        name, make, one.observation, meaning,
        action=one.action, own=own, training_seeds=seeds, trained=trained_policies,
    )  # fmt: skip


def _first(policy: Any, config: Any) -> Any:
    return policy


def check_agents(contenders: Sequence[Contender], rows: Sequence[Row]) -> None:
    """Raise CzError for an agent that was trained for another environment than a row has, its control interval say."""
    for each in contenders:
        for row in rows:
            config = row.design_config(each.observation, each.action)
            for policy in each.trained:
                try:
                    check_policy(policy, config)
                except CzError as error:
                    raise CzError(f"agent {each.name!r} on {row.name}: {error}") from None


def choose(
    wanted: Sequence[str] | None,
    registered: Sequence[Contender],
    given: Mapping[str, Contender],
    shipped: Mapping[str, Callable[[], Contender]],
    slow: bool,
    is_cached: Callable[[Contender], bool],
) -> list[Contender]:
    """Choose who takes part, classical controllers first.

    ``wanted`` are names, ``["all"]``, or None for the default. Agents that are ``given`` always take part; ``shipped``
    ones, which are loaded here, by default only without any given. Slow controllers take part if ``slow`` ones are
    asked for, or if they are wanted and all their episodes cached. Raises CzError for a name that does not exist and
    for a slow controller that may not run.
    """
    usual = list(given or shipped)
    if wanted is None:
        wanted = [each.name for each in registered if (slow if each.slow else each.default)] + usual
    elif wanted == ["all"]:
        wanted = [each.name for each in registered if not each.slow or slow or is_cached(each)] + usual
    known = list(dict.fromkeys([*(each.name for each in registered), *given, *shipped]))
    for name in wanted:
        if name not in known:
            raise CzError(unknown("controller", name, known, ", or all"))
    chosen = [each for each in registered if each.name in wanted]
    for each in chosen:
        if each.slow and not slow and not is_cached(each):
            raise CzError(f"{each.name!r} is slow: add --slow to run it on the first {SLOW_EPISODES} episodes")
    chosen += given.values()
    return chosen + [load() for name, load in shipped.items() if name in wanted and name not in given]
