"""What is random at every step, drawn as the episode goes: interface fluctuation, sensor noise, drop-outs, outliers.

``s`` is one stream of the episode (:mod:`cz_gym.streams`), ``e`` its :class:`cz_gym.law.Episode`.
"""

from __future__ import annotations

from typing import Any

from ._compile import physics
from .streams import normal, uniform


@physics
def start_fluctuation(e: Any, s: Any) -> Any:
    """Stationary start of the interface's two Ornstein-Uhlenbeck processes, each of unit variance."""
    if e.sd_fast > 0.0 or e.sd_slow > 0.0:
        fast = normal(s)
        return fast, normal(s)
    return 0.0, 0.0


@physics
def move_fluctuation(fast: Any, slow: Any, e: Any, s: Any) -> Any:
    """The processes one grid interval on, discretised exactly: x <- keep x + sqrt(1 - keep^2) n."""
    if e.sd_fast > 0.0 or e.sd_slow > 0.0:
        fast = e.keep_fast * fast + e.kick_fast * normal(s)
        slow = e.keep_slow * slow + e.kick_slow * normal(s)
    return fast, slow


@physics
def interface_temperature(fast: Any, slow: Any, e: Any) -> Any:
    """dT_i [K]."""
    return e.sd_fast * fast + e.sd_slow * slow


@physics
def white_noise(e: Any, s: Any) -> Any:
    """Camera [m] and pyrometer [K] noise of the next sample."""
    if e.camera_sd > 0.0 or e.pyrometer_sd > 0.0:
        camera = e.camera_sd * normal(s)
        return camera, e.pyrometer_sd * normal(s)
    return 0.0, 0.0


@physics
def outlier(e: Any, s: Any) -> Any:
    """Outlier [m] of the next sample, mostly 0."""
    if e.outlier_probability > 0.0 and uniform(s) < e.outlier_probability:
        return e.outlier_sd * normal(s)
    return 0.0


@physics
def drops_out(e: Any, s: Any) -> Any:
    """Whether the camera loses the next sample."""
    return e.dropout > 0.0 and uniform(s) < e.dropout
