"""Part II's design of the compensator from a linear model of the plant, and the margins of its continuous loop."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.baselines.pid.compensated_pid import Compensator, SeriesPID
from cz_gym.body.linearisation import RadiusModel
from cz_gym.errors import CzError

CUT_OFF = Compensator().slow
"""The paper's high-pass cut-off [rad/s]."""
_ROUNDING = 1e-9
"""Smallest pole that is stable, in units of the largest [-]."""


class Margins(NamedTuple):
    """Margins of an open loop and the poles of the closed one."""

    crossover: float
    """Frequency where the loop's gain is one [rad/s]."""
    phase_margin_deg: float
    """Phase above -180 degrees there [degrees]."""
    poles: npt.NDArray[np.complex128]
    """Closed-loop poles, slowest first [rad/s]."""

    @property
    def stable(self) -> bool:
        """Whether every closed-loop pole lies in the left half plane."""
        return bool(np.all(self.poles.real < 0.0))


def design_compensator(model: RadiusModel, cut_off: float = CUT_OFF) -> Compensator:
    """Part II's design from a linear model of the plant and the high-pass cut-off [rad/s].

    The ideal compensator G_p (1 - G_m) turns the ring into the radius. It is high-pass filtered by s / (s + cut_off),
    its partial fractions with stable poles are kept, and their steady-state gain is removed. CzError unless
    the stable part has two poles: Model II has none of its own, so only that of the filter would remain.
    """
    if not cut_off > 0.0:
        raise CzError(f"cut_off must be a positive frequency [rad/s], not {cut_off!r}")
    poles = np.array([*model.poles, -cut_off])
    stable = np.unique(poles[poles < -_ROUNDING * np.abs(poles).max()])
    if len(stable) != 2:
        shown = ", ".join(f"{pole:.4g}" for pole in poles)
        raise CzError(f"a compensator needs two stable poles; those of plant and filter are {shown} rad/s")
    numerator = model.numerator * np.array([-model.lead, 1.0 - model.constant, 0.0])
    residues = [np.polyval(numerator, pole) / np.prod(pole - poles[poles != pole]) for pole in stable]
    fast, slow = -stable
    return Compensator(float(sum(residues)), float(fast), float(slow))


def controller_transfer(pid: SeriesPID) -> Any:
    """K(s) as a python-control transfer function."""
    import control

    numerator = pid.K_p * np.polymul([pid.T_i, 1.0], [pid.T_d, 1.0])
    return control.tf(numerator, np.polymul([pid.T_i, 0.0], [pid.T_d / pid.N, 1.0]))


def open_loop(model: RadiusModel, compensator: Compensator | None, pid: SeriesPID) -> Any:
    """L = -K (G_m G_p + G_pc) as a python-control transfer function; minus, since pulling faster thins the crystal."""
    import control

    seen = control.tf([model.numerator * model.lead, model.numerator * model.constant], np.poly(model.poles))
    if compensator is not None:
        seen += control.tf([compensator.gain, 0.0], np.poly([-compensator.fast, -compensator.slow]))
    return -controller_transfer(pid) * seen


def margins(model: RadiusModel, compensator: Compensator | None, pid: SeriesPID) -> Margins:
    """Crossover, phase margin and closed-loop poles of the continuous loop; NaN where the gain never crosses one."""
    import control

    loop = open_loop(model, compensator, pid)
    _, phase, _, crossover = control.margin(loop)
    poles = control.feedback(loop, 1).poles()
    return Margins(float(crossover), float(phase), poles[np.argsort(np.abs(poles))])
