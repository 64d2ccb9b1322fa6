"""Several scenarios at once: each episode is drawn from one of them."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

from cz_gym.errors import CzError

from .scenario import Scenario


@dataclass(frozen=True)
class Mixture:
    """Scenarios with their shares of the episodes; frozen, comparable, hashed.

    An episode's scenario follows from its key, on a random stream of its own: it is bit for bit the episode that the
    same seed has in that scenario alone.
    """

    scenarios: tuple[Scenario, ...]
    """The scenarios, ordered by name."""
    shares: tuple[float, ...]
    """Each scenario's share of the episodes [-]; the sum is 1."""

    @property
    def name(self) -> str:
        """Shares and names."""
        return " + ".join(f"{share:.4g} {each.name}" for share, each in zip(self.shares, self.scenarios, strict=True))

    @property
    def hash(self) -> str:
        """SHA-256 of the scenarios' contents and their shares (16 hex digits)."""
        contents = [[each.hash, share] for each, share in zip(self.scenarios, self.shares, strict=True)]
        return hashlib.sha256(json.dumps(contents).encode()).hexdigest()[:16]

    @property
    def deterministic(self) -> bool:
        """Whether all its episodes are the same."""
        return len(self.scenarios) == 1 and self.scenarios[0].deterministic


Distribution = Scenario | Mixture
"""What episodes are drawn from."""
AnyScenario = str | Path | Scenario | Mixture | Mapping[Any, float]
"""The environment's ``scenario`` argument: a name, a scenario, scenarios or names with their shares, or a CSV file of
disturbances from logs."""


def make_mixture(shares: list[tuple[Scenario, Any]]) -> Mixture:
    """Scenarios with positive shares, of whatever sum, as a mixture; CzError for anything else."""
    for scenario, share in shares:
        number = isinstance(share, Real) and not isinstance(share, bool)
        if not (number and 0.0 < share < math.inf):
            raise CzError(f"a mixture's shares must be positive numbers: that of {scenario.name!r} is {share!r}")
    ordered = sorted(shares, key=lambda pair: pair[0].name)
    scenarios = tuple(scenario for scenario, _ in ordered)
    names = [scenario.name for scenario in scenarios]
    if not names:
        raise CzError("a mixture needs at least one scenario with its share")
    if twice := [name for name in dict.fromkeys(names) if names.count(name) > 1]:
        raise CzError(f"a mixture's scenarios need different names: {twice[0]!r} is there twice")
    whole = math.fsum(float(share) for _, share in ordered)
    return Mixture(scenarios, tuple(float(share) / whole for _, share in ordered))
