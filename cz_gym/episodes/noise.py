"""The random numbers of every step: interface fluctuation, sensor noise, drop-outs and outliers.

``streams`` are the episode's (:mod:`cz_gym.episodes.rng`), ``e`` its :class:`cz_gym.episodes.record.Episode`. Each
kind is drawn in order of time from a stream of its own, so it depends on the episode's key alone, whether drawn step by
step or as a whole series.
"""

from typing import Any

import numpy as np

from cz_gym.jit.compile import jittable

from .record import Stream
from .rng import normal, two_normals, uniform

_INTERFACE, _SENSOR = int(Stream.INTERFACE), int(Stream.SENSOR)
_DROPOUTS, _OUTLIERS = int(Stream.DROPOUTS), int(Stream.OUTLIERS)


@jittable
def first_fluctuation(e: Any, streams: Any) -> Any:
    """The interface's two stationary processes at t = 0 [standard deviations]."""
    return two_normals(streams[_INTERFACE]) if e.sd_fast > 0.0 or e.sd_slow > 0.0 else (0.0, 0.0)


@jittable
def next_fluctuation(e: Any, streams: Any, fast: Any, slow: Any) -> Any:
    """The two processes at the next grid point, discretised exactly: x <- keep x + sqrt(1 - keep^2) n."""
    first, second = two_normals(streams[_INTERFACE]) if e.sd_fast > 0.0 or e.sd_slow > 0.0 else (0.0, 0.0)
    return e.keep_fast * fast + e.kick_fast * first, e.keep_slow * slow + e.kick_slow * second


@jittable
def fluctuation(e: Any, fast: Any, slow: Any) -> Any:
    """dT_i [K] of the two processes."""
    return e.sd_fast * fast + e.sd_slow * slow


@jittable
def sample_noise(e: Any, streams: Any) -> Any:
    """Camera [m] and pyrometer [K] noise of the next sample; a camera's NaN is a drop-out."""
    noisy = e.camera_sd > 0.0 or e.pyrometer_sd > 0.0
    camera, pyrometer = two_normals(streams[_SENSOR]) if noisy else (0.0, 0.0)
    camera, pyrometer = e.camera_sd * camera, e.pyrometer_sd * pyrometer
    if e.outlier_probability > 0.0 and uniform(streams[_OUTLIERS]) < e.outlier_probability:
        camera += e.outlier_sd * normal(streams[_OUTLIERS])
    if e.dropout > 0.0 and uniform(streams[_DROPOUTS]) < e.dropout:
        camera = np.nan
    return camera, pyrometer


@jittable
def draw_series(e: Any, streams: Any, interface: Any, noise: Any) -> None:
    """Write dT_i [K] on the grid, shape (points,), and the noise of each sample, shape (samples, 2)."""
    fast, slow = first_fluctuation(e, streams)
    for j in range(interface.size):
        interface[j] = fluctuation(e, fast, slow)
        fast, slow = next_fluctuation(e, streams, fast, slow)
    for k in range(noise.shape[0]):
        noise[k, 0], noise[k, 1] = sample_noise(e, streams)
