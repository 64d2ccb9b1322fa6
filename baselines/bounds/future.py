"""The future of an episode, from the environment's own draws and schedules, which only bounds may read."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.policy import Floats
from cz_gym.body.plant import Disturbance, Inputs, Puller, State, disturbance, make_puller, rk4
from cz_gym.config import Config
from cz_gym.engine.batch import Key, first_key
from cz_gym.episodes.draw import randomised
from cz_gym.episodes.scenario import GRID
from cz_gym.episodes.schedule import bias_offset, reference
from cz_gym.episodes.series import draw_episode, draw_factors, new_series
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.support.nested import stack

_EPS = 1e-9


class Future(NamedTuple):
    """n episodes, known to their end; SI units."""

    puller: Puller
    """Fields of shape (n,)."""
    start: State
    """State at t = 0, fields of shape (n,)."""
    target: Floats
    """Radius of no cost at the end of each step [m]: the reference less the ring's hidden offset, shape (steps, n)."""
    disturbances: tuple[Disturbance, ...]
    """Disturbances by substep; fields of shape (steps, n)."""
    lengths: Floats
    """Length of each substep [s], shape (substeps, steps, 1)."""
    meniscus: MeniscusModel

    def advance(self, x: State, u: Inputs, steps: slice) -> State:
        """The state at the end of those steps, each from its own start; fields are real or complex, shape (..., n)."""
        for d, dt in zip(self.disturbances, self.lengths, strict=True):
            held = Disturbance(*(value[steps] for value in d))
            x = rk4(x, u, held, self.puller, dt[steps], self.meniscus.slope)
        return x


def pullers_of(config: Config, seeds: Sequence[int]) -> tuple[Puller, ...]:
    """The pullers of the first episode of each seed."""
    pullers = []
    for key in _keys(seeds):
        factors = draw_factors(config.sole_scenario, config.mix, key)
        pullers.append(make_puller(randomised(config.parameters, factors), factors.lam, config.meniscus))
    return tuple(pullers)


def fluctuations_of(config: Config, seeds: Sequence[int]) -> tuple[tuple[float, float], ...]:
    """Standard deviations of the fast and the slow interface fluctuation [K] in the first episode of each seed."""
    drawn = (draw_episode(config.sole_scenario, key, new_series(1, 0)) for key in _keys(seeds))
    return tuple((float(episode.sd_fast), float(episode.sd_slow)) for episode in drawn)


def future_of(config: Config, seeds: Sequence[int]) -> Future:
    """The future of the first episode of each seed."""
    puller = stack(pullers_of(config, seeds))
    point, length = substeps_of(config.control_interval, config.steps)
    points = int(point.max()) + 1
    series = [new_series(points, 0) for _ in seeds]
    drawn = [draw_episode(config.sole_scenario, *of) for of in zip(_keys(seeds), series, strict=True)]
    e, dT_i = stack(drawn), np.stack([each.interface for each in series], axis=1)
    on_grid = disturbance(np.arange(points)[:, None] * GRID, dT_i, e, puller)
    end = np.arange(1, config.steps + 1)[:, None] * config.control_interval
    start, target = puller.state_0._replace(r_c=puller.r_0 + e.r_c_start), puller.r_0 + reference(end, e)
    held = tuple(Disturbance(*(np.asarray(value)[column] for value in on_grid)) for column in point.T)
    return Future(puller, start, target - bias_offset(end, e), held, length.T[:, :, None], config.meniscus)


def substeps_of(interval: float, steps: int) -> tuple[npt.NDArray[np.int64], Floats]:
    """Integration steps of ``steps`` control intervals [s], split at the 5 s grid as in the environment.

    The grid point whose disturbance holds, and the length [s], 0 where an interval has fewer; shape (steps, substeps).
    """
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
    return point[:, used], length[:, used]


def _keys(seeds: Sequence[int]) -> list[Key]:
    """The key of each seed's first episode; seeds may be an array."""
    return [first_key(int(seed)) for seed in seeds]
