"""Ridge regression that imputes failed ring readings from a network's means and from the other readings.

It is fitted on all crystals that a policy drives in the warm-up. Where a reading fails, the network uses the estimate
in its place, step after step as long as readings fail.
"""

from __future__ import annotations

import torch

from cz_gym.observation import MEASURED

from .filter_bank import MEANS, REMEMBERED, FilterBank

RIDGE = 1e-6
"""Ridge, relative to the variances of means and readings, which are strongly correlated [-]."""
_NAMES = [channel.name for channel in MEASURED]
_RING, _VALID = _NAMES.index("ring_error"), _NAMES.index("valid")


class Expectation:
    """Least squares of the valid ring readings on the means before them and on the other readings."""

    def __init__(self) -> None:
        self.products = torch.zeros(REMEMBERED, REMEMBERED, dtype=torch.float64)
        self.with_ring = torch.zeros(REMEMBERED, dtype=torch.float64)

    @property
    def seen(self) -> bool:
        """Whether it holds readings that no network has been given yet."""
        return bool(self.products.any())

    def see(self, memory: torch.Tensor, measured: torch.Tensor) -> None:
        """Add readings, shape (n, 11), with the states before them, shape (n, STATE)."""
        x = torch.cat([memory[:, :MEANS], measured], dim=1)[measured[:, _VALID] > 0.5].double()
        ring = x[:, MEANS + _RING].clone()
        x[:, [MEANS + _RING, MEANS + _VALID]] = 0.0
        self.products += x.T @ x
        self.with_ring += x.T @ ring

    def teach(self, network: FilterBank) -> None:
        """Fit the regression, give it to the network and start anew; nothing without readings."""
        if not self.seen:
            return
        scale = torch.clamp(self.products.diagonal().sqrt(), 1e-12)
        alike = self.products / scale / scale[:, None] + RIDGE * torch.eye(REMEMBERED, dtype=torch.float64)
        network.expected[:, 0] = (torch.linalg.solve(alike, self.with_ring / scale) / scale).float()
        self.products.zero_()
        self.with_ring.zero_()
