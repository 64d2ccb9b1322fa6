"""Who takes part in a benchmark: controllers and agents, each with the way to build it."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from cz_gym.config import Config
from cz_gym.errors import CzError
from cz_gym.names import unknown

from .protocol import SLOW_EPISODES, Row
from .results import Controller


@dataclass(frozen=True)
class Contender:
    """A controller and how to build it for an environment's settings: one policy a training seed."""

    controller: Controller
    make: Callable[[Config], Sequence[Any]]
    default: bool = True
    """Whether it takes part where no names are given."""
    contracts: tuple[Mapping[str, Any], ...] = ()
    """Contracts of the agent files it is made of."""

    @property
    def name(self) -> str:
        """What it is called."""
        return self.controller.name


def agent(name: str, policies: Sequence[Any], own: bool = False, trained_on: str = "") -> Contender:
    """A learned contender: policies with a ``contract``, one a training seed of the same agent.

    It is the user's ``own`` if it was given as a file. ``trained_on`` says on what, if it was more than the scenario of
    its contract.

    Raises ValueError if they are no such set.
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
    on = trained_on or contracts[0].scenario
    meaning = f"agent trained with {contracts[0].algorithm} on {on}{', given as a file' if own else ''}"
    controller = Controller(name, contracts[0].observation, meaning, seeds, action=contracts[0].action, own=own)
    return Contender(
        controller, lambda config: policies, contracts=tuple(_writable(contract) for contract in contracts)
    )


def check_intervals(contenders: Sequence[Contender], rows: Sequence[Row]) -> None:
    """ValueError for an agent that was trained at another control interval than a row has."""
    for contender in contenders:
        for row in rows:
            for trained in {contract["control_interval"] for contract in contender.contracts} - {row.control_interval}:
                raise CzError(
                    f"agent {contender.name!r}: trained at {trained:g} s control, {row.name} runs at "
                    f"{row.control_interval:g} s"
                )


def _writable(contract: Any) -> dict[str, Any]:
    """A contract's fields; ValueError if JSON cannot hold them."""
    facts = asdict(contract)
    for name, value in facts.items():
        try:
            json.dumps(value, ensure_ascii=False, allow_nan=False).encode()
        except ValueError:
            raise CzError(
                f"agent {contract.algorithm!r}: its contract's {name} cannot be written: {value!r:.80}"
            ) from None
    return facts


def choose(
    wanted: Sequence[str] | None,
    classical: Sequence[Contender],
    given: Mapping[str, Contender],
    shipped: Mapping[str, Callable[[], Contender]],
    usual: Collection[str],
    slow: Collection[str] = (),
) -> tuple[Contender, ...]:
    """Who takes part, classical controllers first.

    ``wanted`` are names, ``["all"]``, or None for the default: of ``shipped`` agents, which are loaded here, the
    ``usual`` ones. Agents that are ``given`` always take part, beside them shipped ones only if they are wanted by
    name, and slow controllers only if ``slow`` has them. Raises ValueError for an unknown name, and for one that a
    controller and an agent share.
    """
    names = [each.name for each in classical]
    learned = list(dict.fromkeys((*given, *shipped)))
    for name in given:
        if name in names:
            raise CzError(f"an agent may not be called {name!r}: a controller has that name; name it NAME=FILE")
    if wanted is None or wanted == ["all"]:
        some = [each for each in classical if each.name in slow or not each.controller.slow]
        wanted = [each.name for each in some if wanted or each.controller.slow or each.default]
        wanted += list(given or usual)
    for name in wanted:
        if name not in names + learned:
            raise CzError(unknown("controller", name, names + learned, ", or all"))
    chosen = [each for each in classical if each.name in wanted]
    for each in chosen:
        if each.controller.slow and each.name not in slow:
            raise CzError(f"{each.name!r} is slow: add --slow to run it on the first {SLOW_EPISODES} episodes")
    for name in learned:
        if name in given:
            chosen.append(given[name])
        elif name in wanted:
            chosen.append(shipped[name]())
    return tuple(chosen)
