"""Trained agents as contenders of a benchmark."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from cz_gym.contender import Contender, given
from cz_gym.errors import CzError

from .protocol import Row
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
    return Contender(
        name, partial(given, policies[0]), one.observation, meaning,
        action=one.action, own=own, training_seeds=seeds, trained=tuple(policies),
    )  # fmt: skip


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
