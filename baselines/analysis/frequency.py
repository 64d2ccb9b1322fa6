"""Margins of sampled loops, computed by python-control from their frequency response."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.physics.linearisation import Floats, StateSpace
from cz_gym.physics.plant import Puller

from .sampled_loop import close

SLOWEST = 1e-4
"""Lowest frequency [rad/s]: a period of 17 hours, slower than the drift of any episode."""


class LoopMargins(NamedTuple):
    """Margins of a stable loop at the place where it was opened; NaN where one does not exist."""

    crossover: float
    """Highest frequency where the loop's gain falls through one [rad/s]."""
    gain_up: float
    """Factor by which the gain may grow [-]."""
    gain_down: float
    """Factor by which the gain may fall [-]."""
    phase_deg: float
    """Least phase margin over all crossings [degrees]."""
    delay: float
    """Least delay that destabilises [s]."""
    sensitivity: float
    """Peak of |1/(1 + L)| [-]: 1 over the distance to the critical point."""


def frequencies(dt: float, points: int = 2000) -> Floats:
    """Logarithmic grid [rad/s] from SLOWEST up to the Nyquist frequency."""
    return np.geomspace(SLOWEST, np.pi / dt, points)


def response(system: StateSpace, dt: float, omega: Floats) -> npt.NDArray[np.complex128]:
    """Frequency response of a discrete single-input single-output system, by python-control."""
    import control

    values: npt.NDArray[np.complex128] = control.ss(*system, dt)(np.exp(1j * omega * dt))
    return values


def opened(controller: StateSpace, puller: Puller, dt: float, at: str) -> StateSpace:
    """The open loop L, opened at "camera" (only the plant is uncertain), at "v_p" (as in the paper, where the
    controller's use of its own pull speed counts as plant), or at "Q_H" (only the hot zone is uncertain)."""
    A, B, C, D = close(controller, puller, dt, broken=at).pick("r_br" if at == "camera" else at, (at,))
    return StateSpace(A, B, -C, -D)


def crossover_of(values: npt.NDArray[np.complex128], omega: Floats) -> float:
    """Highest frequency [rad/s] where the gain of an open loop's response falls through one; NaN if it never does."""
    gain = np.log(np.abs(values))
    falls = np.flatnonzero((gain[:-1] > 0.0) & (gain[1:] <= 0.0))
    if not len(falls):
        return float("nan")
    k = falls[-1]
    share = gain[k] / (gain[k] - gain[k + 1])
    return float(omega[k] * (omega[k + 1] / omega[k]) ** share)


def loop_margins(controller: StateSpace, puller: Puller, dt: float, at: str = "camera") -> LoopMargins:
    """Margins of the loop opened there; if the closed loop is unstable, all but the crossover are NaN."""
    omega = frequencies(dt)
    values = response(opened(controller, puller, dt, at), dt, omega)
    return margins_of(values, omega, dt, close(controller, puller, dt).stable)


def margins_of(values: npt.NDArray[np.complex128], omega: Floats, dt: float, stable: bool) -> LoopMargins:
    """Margins of an open loop's response up to the Nyquist frequency; ``stable`` is whether the closed loop is."""
    import control

    found = crossover_of(values, omega)
    if not stable:
        return LoopMargins(found, *[float("nan")] * 5)
    gain, phase, _, _, crossing, _ = control.stability_margins(control.frd(values, omega), returnall=True)
    late = np.append(np.radians(np.mod(phase, 360.0)) / crossing, _late_at_nyquist(values[-1], dt))
    return LoopMargins(
        found,
        _least(gain[gain > 1.0], np.min),
        _least(gain[gain < 1.0], np.max),
        _least(np.abs(phase), np.min),
        _least(late, np.min),
        float(np.max(1.0 / np.abs(1.0 + values))),
    )


def _late_at_nyquist(value: complex, dt: float) -> Floats:
    """Delay [s] that turns a real loop gain above one at the Nyquist frequency to the critical point's side."""
    turn = np.mod(np.angle(value) + np.pi, 2.0 * np.pi)
    return np.array([turn * dt / np.pi] if np.abs(value) > 1.0 else [])


def _least(values: Any, pick: Any) -> float:
    return float(pick(values)) if len(values) else float("nan")
