"""What a reading of the ring is to be expected, of what a network remembers and of the other readings.

A linear regression over all crystals that are seen while a policy drives them. Where a reading fails, a network takes
what is expected in its place; from step to step, as long as readings fail.
"""

from __future__ import annotations

import torch

from cz_gym.observation import MEASURED

from .filter_bank import MEANS, REMEMBERED, FilterBank

RIDGE = 1e-6
"""Added to the variances of means and readings, as a share of them: the means are much alike [-]."""
_NAMES = [channel.name for channel in MEASURED]
_RING, _VALID = _NAMES.index("ring_error"), _NAMES.index("valid")


class Expectation:
    """Least squares of the readings that did not fail, on means before them and on the other readings."""

    def __init__(self) -> None:
        self.products = torch.zeros(REMEMBERED, REMEMBERED, dtype=torch.float64)
        self.with_ring = torch.zeros(REMEMBERED, dtype=torch.float64)

    @property
    def seen(self) -> bool:
        """Whether readings were seen that were not taught yet."""
        return bool(self.products.any())

    def see(self, memory: torch.Tensor, measured: torch.Tensor) -> None:
        """Readings, shape (n, 11), and what was remembered before them, shape (n, STATE)."""
        x = torch.cat([memory[:, :MEANS], measured], dim=1)[measured[:, _VALID] > 0.5].double()
        ring = x[:, MEANS + _RING].clone()
        x[:, [MEANS + _RING, MEANS + _VALID]] = 0.0
        self.products += x.T @ x
        self.with_ring += x.T @ ring

    def teach(self, network: FilterBank) -> None:
        """Have the network expect what was seen, and forget it; nothing if nothing was."""
        if not self.seen:
            return
        scale = torch.clamp(self.products.diagonal().sqrt(), 1e-12)
        alike = self.products / scale / scale[:, None] + RIDGE * torch.eye(REMEMBERED, dtype=torch.float64)
        network.expected[:, 0] = (torch.linalg.solve(alike, self.with_ring / scale) / scale).float()
        self.products.zero_()
        self.with_ring.zero_()
