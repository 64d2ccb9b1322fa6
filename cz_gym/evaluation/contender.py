"""Contenders: controllers and agents by name, and functions that build them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from cz_gym.config import Config
from cz_gym.errors import CzError

REWARD, STATE, PLANT = "reward", "state", "plant"
"""Sources that an agent learned from: the reward alone; the reward, and the true state, told in training; gradients
through the plant's equations."""
GROUPS = {
    REWARD: "learned from the reward",
    STATE: "learned from the reward, state told in training",
    PLANT: "learned, plant known in training",
}
"""Table headings of agents by source, the least information first."""


@dataclass(frozen=True)
class Contender:
    """A controller or an agent that can be asked for by name."""

    name: str
    make: Callable[[Config], Any]
    """Builds the policy for an environment's settings, of an agent that of the first training seed; it must pickle."""
    observation: str
    """Observation mode it reads; "state" marks a bound, which no sensor could feed."""
    meaning: str
    """Description in one line, for tables."""
    default: bool = True
    """Whether a benchmark that names no controllers runs it."""
    privileged: bool = False
    """Whether it knows the puller, the state or the future, which no controller can; that makes it a bound."""
    slow: bool = False
    """Whether it meets only the first few episodes, which are cached, and runs only when slow ones are asked for."""
    on_puller: bool = False
    """Whether a benchmark on a puller of the user's own that names no controllers runs it."""
    quoted: bool = False
    """Whether it stands in short tables and small figures, and beside a controller of the user's own."""
    action: str = "direct"
    """Mode of its actions (:func:`cz_gym.action.drives_of`)."""
    own: bool = False
    """Whether it comes from the user's own file: figures show it first."""
    training_seeds: tuple[int, ...] = ()
    """Training seeds of an agent, empty for a controller."""
    trained: tuple[Any, ...] = ()
    """Policies of an agent, one a training seed."""

    @property
    def learned(self) -> bool:
        """Whether it was trained."""
        return bool(self.training_seeds)

    @property
    def bound(self) -> bool:
        """Whether it is a bound on controllers: it knows or reads something that no sensor shows."""
        return self.privileged or self.observation == "state"

    @property
    def knows(self) -> str:
        """Heading of its group in tables, by its knowledge of the plant."""
        if self.bound:
            return "bounds, told what no sensor shows"
        if not self.learned:
            return "classical"
        sources = {policy.contract.learned_from for policy in self.trained}
        return next((group for source, group in reversed(GROUPS.items()) if source in sources), GROUPS[REWARD])

    def policies(self, config: Config) -> tuple[Any, ...]:
        """Its policy for an environment's settings; of an agent one a training seed."""
        return self.trained or (self.make(config),)


def agent(name: str, policies: Sequence[Any], own: bool = False) -> Contender:
    """An agent, the user's ``own`` if it was given as a file, from its policies, one a training seed.

    Raises CzError if the policies are not training seeds of one agent.
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
        name, partial(unchanged, policies[0]), one.observation, meaning,
        action=one.action, own=own, training_seeds=seeds, trained=tuple(policies),
    )  # fmt: skip


def unchanged(policy: Any, config: Config) -> Any:
    """The policy, whatever the environment is."""
    return policy
