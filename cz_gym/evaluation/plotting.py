"""A picture of one crystal of any rollout."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from cz_gym.atomic_files import write_files
from cz_gym.names import needs
from cz_gym.units import KILO, MINUTE, MM, MM_PER_MIN

from .rollout import Rollout

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot(run: Rollout, episode: int = 0, path: str | Path | None = None) -> Figure:
    """Radius error, drives and temperature of one episode of a rollout; also written to ``path``, as PNG, if given.

    The error of the true radius, which no controller sees, stands before that of the bright ring. Needs matplotlib.
    IndexError for an episode that is not there, ValueError for what is no rollout.
    """
    from .report.canvas import COLOURS, GREY, canvas, png

    needs(Rollout, run, "cz_gym.evaluation.rollout.rollout(policy, config, seeds) makes one")
    if not -len(run.seeds) <= episode < len(run.seeds):
        raise IndexError(f"episode must be below {len(run.seeds)}, not {episode}")
    signals, config = run.episode(episode), run.config
    minutes = config.control_interval / MINUTE * np.arange(1, len(signals.r_c) + 1)
    figure = canvas(7.0, 6.5)
    panels = figure.subplots(4, 1, sharex=True)
    apart = run.start.r_br[0, episode] - run.start.r_c[0, episode]
    seen = (signals.r_br_measured - apart - signals.r_ref) / MM
    panels[0].plot(minutes, seen, color=GREY, lw=0.5, label="bright ring as the camera reads it")
    panels[0].plot(minutes, (signals.r_c - signals.r_ref) / MM, color=COLOURS[0], lw=1.2, label="true")
    panels[1].plot(minutes, signals.v_p / MM_PER_MIN, color=COLOURS[1], lw=0.8)
    panels[2].plot(minutes, signals.Q_H / KILO, color=COLOURS[2], lw=0.8)
    panels[3].plot(minutes, signals.T_1, color=COLOURS[3], lw=1.0, label="heater")
    panels[3].plot(minutes, signals.T_1_ref, color=GREY, lw=0.8, label="recipe")
    labels = ("radius error [mm]", "pull speed [mm/min]", "heater [kW]", "T_1 [K]")
    for panel, label in zip(panels, labels, strict=True):
        panel.set_ylabel(label)
    for panel in panels[[0, 3]]:
        panel.legend(loc="upper right", fontsize=7, frameon=False, ncols=2)
    panels[3].set_xlabel("time [min]")
    ended = "lost" if run.failed[episode] else "held"
    figure.suptitle(f"{config.scenario.name}, seed {run.seeds[episode]}: {ended}", fontsize=10)
    if path is not None:
        write_files({Path(path): png(figure)})
    return figure
