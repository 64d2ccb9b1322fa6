"""What is random at every step, drawn at reset: interface fluctuation, sensor noise, drop-outs, outliers.

``s`` is one stream of the episode (:mod:`cz_gym.streams`), ``e`` its :class:`cz_gym.law.Episode`. Series are drawn
front to back, each on a stream of its own: a longer horizon extends them and changes nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ._compile import physics
from .law import Stream
from .streams import normal, two_normals, uniform

_INTERFACE, _SENSOR = int(Stream.INTERFACE), int(Stream.SENSOR)
_DROPOUTS, _OUTLIERS = int(Stream.DROPOUTS), int(Stream.OUTLIERS)


@physics
def draw_interface(e: Any, s: Any, out: Any) -> None:
    """Write dT_i [K] on the grid: two stationary processes, discretised exactly, x <- keep x + sqrt(1 - keep^2) n."""
    if not (e.sd_fast > 0.0 or e.sd_slow > 0.0):
        out[:] = 0.0
        return
    fast, slow = two_normals(s)
    out[0] = e.sd_fast * fast + e.sd_slow * slow
    for j in range(1, out.size):
        first, second = two_normals(s)
        fast = e.keep_fast * fast + e.kick_fast * first
        slow = e.keep_slow * slow + e.kick_slow * second
        out[j] = e.sd_fast * fast + e.sd_slow * slow


@physics
def draw_noise(e: Any, streams: Any, out: Any) -> None:
    """Write camera [m] and pyrometer [K] noise of each sample, shape (samples, 2); a camera's NaN is a drop-out."""
    s = streams[_SENSOR]
    noisy = e.camera_sd > 0.0 or e.pyrometer_sd > 0.0
    for k in range(out.shape[0]):
        camera, pyrometer = two_normals(s) if noisy else (0.0, 0.0)
        out[k, 0], out[k, 1] = e.camera_sd * camera, e.pyrometer_sd * pyrometer
    if e.outlier_probability > 0.0:
        s = streams[_OUTLIERS]
        for k in range(out.shape[0]):
            if uniform(s) < e.outlier_probability:
                out[k, 0] += e.outlier_sd * normal(s)
    if e.dropout > 0.0:
        s = streams[_DROPOUTS]
        for k in range(out.shape[0]):
            if uniform(s) < e.dropout:
                out[k, 0] = np.nan


@physics
def draw_series(e: Any, streams: Any, interface: Any, noise: Any) -> None:
    """Draw everything that is random at every step of the episode."""
    draw_interface(e, streams[_INTERFACE], interface)
    draw_noise(e, streams, noise)
