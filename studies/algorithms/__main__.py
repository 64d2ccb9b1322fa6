"""Algorithms side by side: ``python -m studies.algorithms`` trains each recipe of train.py and judges its agents.

The agents stay in the folders of their runs (``--work``); those that are shipped were made so.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cz_gym.agents.training.recipes import RECIPES
from studies.comparison.command import main as compare
from studies.comparison.variants import Study, Variant

ROWS = (
    Variant(
        RECIPES["gradient-start"],
        "the cost's gradient through policy and plant, from nothing; the plant is known; of its "
        "crystals, 70 % are wide, or of hard, sensor-fault and puller",
    ),
    Variant(RECIPES["ppo"], "proximal policy optimisation from nothing; the critic also sees the true state"),
    Variant(RECIPES["sac"], "soft actor-critic from nothing; both see the past; it learns with actions of 20 s", "ppo"),
    Variant(RECIPES["imitation"], "no reward: DAgger, the teacher is a privileged LQG", "ppo"),
)
"""Every row, in the order of the table."""
STUDY = Study("algorithms", "Algorithms side by side: the recipes of train.py on the same crystals", ROWS, None)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return compare(STUDY, arguments)


if __name__ == "__main__":
    sys.exit(main())
