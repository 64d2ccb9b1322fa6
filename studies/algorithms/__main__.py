"""Algorithms side by side: ``python -m studies.algorithms`` trains each on the same observations and crystals."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from cz_gym.agents.training.recipes import RECIPES
from studies.comparison.command import main as compare
from studies.comparison.variants import Study, Variant

ROWS = (
    Variant(RECIPES["ppo"], "PPO from nothing; the critic also sees the true state"),
    Variant(RECIPES["ppo-recurrent"], "PPO of an LSTM from nothing; actor and critic see what is measured", "ppo"),
    Variant(RECIPES["sac"], "soft actor-critic from nothing; both see what is measured", "ppo"),
    Variant(RECIPES["imitation"], "no reward: DAgger, the teacher is a privileged LQG", "ppo"),
)
"""Every row, in the order of the table."""
STUDY = Study("algorithms", "Algorithms side by side: the recipes of train.py on the same crystals", ROWS, 400_000)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return compare(STUDY, arguments)


if __name__ == "__main__":
    sys.exit(main())
