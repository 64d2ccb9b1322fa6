"""Rollouts, metrics, statistics and reports: how policies are compared; and a picture of one crystal of a rollout."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cz_gym.support.errors import require_type
from cz_gym.support.files import write_files
from cz_gym.support.units import MM

from .rollout import Rollout

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["plot"]


def plot(run: Rollout, episode: int = 0, path: str | Path | None = None) -> Figure:
    """Radius, bright ring, drives and melt of one episode of a rollout; also written to ``path``, as PNG, if given.

    Needs matplotlib. IndexError for an episode that is not there, ValueError for what is no rollout.
    """
    from .plots import DrawnCrystal, draw, png

    require_type(Rollout, run, "cz_gym.evaluation.rollout.rollout(policy, config, seeds) makes one")
    if not -len(run.seeds) <= episode < len(run.seeds):
        raise IndexError(f"episode must be below {len(run.seeds)}, not {episode}")
    signals, dt = run.episode(episode), run.config.control_interval
    rmse = np.sqrt(np.mean(np.square(signals.r_c - signals.r_ref))) / MM
    crystal = DrawnCrystal(f"RMSE {rmse:.3g} mm", signals, bool(run.failed[episode]))
    figure = draw([crystal], dt, f"{run.config.scenario.name}, seed {run.seeds[episode]}")
    if path is not None:
        write_files({Path(path): png(figure)})
    return figure
