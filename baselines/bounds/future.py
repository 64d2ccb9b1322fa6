"""What will happen in an episode: its puller, its start, its reference and every disturbance to come.

All comes from the environment's own draws and schedules. It is for bounds alone; no controller may read it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats, stack
from cz_gym.config import Config
from cz_gym.engine.batch import first_key
from cz_gym.episodes.draw import randomised
from cz_gym.episodes.record import GRID, Episode
from cz_gym.episodes.schedule import disturbance, reference
from cz_gym.episodes.series import draw_episode, draw_factors, new_series
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.physics.plant import Disturbance, Inputs, Puller, State, make_puller, rk4

_EPS = 1e-9


class Substeps(NamedTuple):
    """How the control intervals fall into integration steps, split at the 5 s grid as the environment does."""

    point: npt.NDArray[np.int64]
    """Grid point whose disturbance holds, shape (steps, substeps)."""
    length: Floats
    """Length [s], 0 where an interval has fewer, shape (steps, substeps)."""


class Future(NamedTuple):
    """n episodes of some steps, known to the end; SI units."""

    puller: Puller
    """Fields of shape (n,)."""
    start: State
    """State at t = 0, fields of shape (n,)."""
    r_ref: Floats
    """Radius reference at the end of each step [m], shape (steps, n)."""
    disturbances: tuple[Disturbance, ...]
    """By substep; fields of shape (steps, n)."""
    lengths: Floats
    """Length of each substep [s], shape (substeps, steps, 1)."""
    meniscus: MeniscusModel

    def advance(self, x: State, u: Inputs, steps: slice) -> State:
        """The state at the end of those steps, each from its own start; fields real or complex, shape (..., n)."""
        for d, dt in zip(self.disturbances, self.lengths, strict=True):
            held = Disturbance(*(value[steps] for value in d))
            x = rk4(x, u, held, self.puller, dt[steps], self.meniscus.slope)
        return x


def pullers_of(config: Config, seeds: Sequence[int]) -> tuple[Puller, ...]:
    """The pullers of the first episodes that those seeds draw."""
    pullers = []
    for seed in seeds:
        factors = draw_factors(config.scenario, config.mix, first_key(seed))
        pullers.append(make_puller(randomised(config.parameters, factors), factors.lam, config.meniscus))
    return tuple(pullers)


def fluctuations_of(config: Config, seeds: Sequence[int]) -> tuple[tuple[float, float], ...]:
    """Standard deviations of fast and slow interface fluctuation [K] of those seeds' first episodes."""
    drawn = (draw_episode(config.scenario, first_key(seed), new_series(1, 0)) for seed in seeds)
    return tuple((float(episode.sd_fast), float(episode.sd_slow)) for episode in drawn)


def future_of(config: Config, seeds: Sequence[int]) -> Future:
    """The future of the first episode that each seed draws."""
    puller = stack(pullers_of(config, seeds))
    substeps = substeps_of(config.control_interval, config.steps)
    points = int(substeps.point.max()) + 1
    drawn = [_drawn(config, seed, points) for seed in seeds]
    e = stack([episode for episode, _ in drawn])
    dT_i = np.stack([interface for _, interface in drawn], axis=1)
    on_grid = disturbance(np.arange(points)[:, None] * GRID, dT_i, e, puller)
    end = np.arange(1, config.steps + 1)[:, None] * config.control_interval
    return Future(
        puller,
        puller.state_0._replace(r_c=puller.r_0 + e.r_c_start),
        puller.r_0 + reference(end, e),
        tuple(Disturbance(*(np.asarray(value)[column] for value in on_grid)) for column in substeps.point.T),
        substeps.length.T[:, :, None],
        config.meniscus,
    )


def substeps_of(interval: float, steps: int) -> Substeps:
    """The substeps of ``steps`` control intervals [s]."""
    most = int(np.ceil(interval / GRID - _EPS)) + 1
    point, length = np.zeros((steps, most), np.int64), np.zeros((steps, most))
    for k in range(steps):
        t, end, at = k * interval, (k + 1) * interval, 0
        while t < end - _EPS:
            point[k, at:] = int(t / GRID + _EPS)
            upto = min((point[k, at] + 1) * GRID, end)
            length[k, at] = upto - t
            t, at = upto, at + 1
    used = length.any(axis=0)
    return Substeps(point[:, used], length[:, used])


def _drawn(config: Config, seed: int, points: int) -> tuple[Episode, Floats]:
    series = new_series(points, 0)
    return draw_episode(config.scenario, first_key(seed), series), series.interface
