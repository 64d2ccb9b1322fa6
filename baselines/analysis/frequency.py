"""Margins of sampled loops, computed by python-control from their frequency response."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.plant import Puller
from cz_gym.physics.linearisation import Floats, StateSpace

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


def loop_margins(
    controller: StateSpace,
    puller: Puller,
    dt: float,
    at: str = "camera",
    stable: bool | None = None,
    points: int = 2000,
) -> LoopMargins:
    """Margins of the loop opened there, on a grid; all but the crossover are NaN if it is not ``stable``."""
    import control

    omega = frequencies(dt, points)
    values = response(opened(controller, puller, dt, at), dt, omega)
    log_gain = np.log(np.abs(values))
    falls = np.flatnonzero((log_gain[:-1] > 0.0) & (log_gain[1:] <= 0.0))[-1:]
    share = log_gain[falls] / (log_gain[falls] - log_gain[falls + 1])
    crossover = _pick(omega[falls] * (omega[falls + 1] / omega[falls]) ** share, np.max)
    if not (close(controller, puller, dt).stable if stable is None else stable):
        return LoopMargins(crossover, *[float("nan")] * 5)
    gain, phase, _, _, crossing, _ = control.stability_margins(control.frd(values, omega), returnall=True)
    # A delay also turns a real loop gain above one at the Nyquist frequency to the critical point's side.
    nyquist = np.mod(np.angle(values[-1:]) + np.pi, 2.0 * np.pi) * dt / np.pi
    late = np.append(np.radians(np.mod(phase, 360.0)) / crossing, nyquist[np.abs(values[-1:]) > 1.0])
    gains = _pick(gain[gain > 1.0], np.min), _pick(gain[gain < 1.0], np.max)
    sensitivity = float(np.max(1.0 / np.abs(1.0 + values)))
    return LoopMargins(crossover, *gains, _pick(np.abs(phase), np.min), _pick(late, np.min), sensitivity)


def _pick(values: Any, which: Any) -> float:
    return float(which(values)) if len(values) else float("nan")
