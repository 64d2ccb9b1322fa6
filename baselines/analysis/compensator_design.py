"""The design of the paper's compensator as a procedure, and the loop that the design is judged by.

Part II, section on the compensator design and appendix on the stable-unstable decomposition: from a linear model of
the plant to the compensator's constants, and from those to margins and closed-loop poles. The decomposition uses
SciPy's ordered Schur form and Sylvester equation; Bode data, margins and poles come from python-control.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import LinAlgError, schur, solve_sylvester
from scipy.signal import ss2tf

from cz_gym.baselines.pid.compensated_pid import Compensator, SeriesPID
from cz_gym.errors import CzError
from cz_gym.physics.linearisation import RadiusModel, StateSpace

CUT_OFF = Compensator().slow
"""The paper's high-pass cut-off [rad/s]."""
_ROUNDING = 1e3 * float(np.finfo(np.float64).eps)


class NoSplitError(CzError):
    """A system has no usable stable part, or its halves cannot be told apart."""


class Split(NamedTuple):
    """Two systems that add up to the one split; each holds half of the direct term, as in the paper."""

    stable: StateSpace
    """Eigenvalues with negative real part."""
    unstable: StateSpace
    """The others; of order 0 if there are none."""


class Margins(NamedTuple):
    """What python-control says about an open loop and its closing."""

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


def split_stable(system: StateSpace) -> Split:
    """Split into a stable and an unstable part in parallel (Part II, appendix).

    An ordered real Schur form puts the stable eigenvalues first; Q from A_11 Q - Q A_22 = -A_12 then decouples the
    blocks. Eigenvalues on the imaginary axis, to rounding, count as unstable. Raises NoSplitError if there is no
    stable part, or if eigenvalues of both parts agree to rounding, so that no Q exists.
    """
    A, B, C, D = system
    axis = _ROUNDING * max(float(np.linalg.norm(A, 2)), float(np.finfo(np.float64).tiny))
    shift = axis * np.eye(len(A))
    try:
        T, Z, stable = schur(A + shift, output="real", sort="lhp")
    except LinAlgError as error:
        raise NoSplitError(f"the stable and unstable eigenvalues cannot be told apart: {error}") from None
    T, n = T - shift, int(stable)
    if n == 0:
        poles = ", ".join(f"{pole:.4g}" for pole in np.linalg.eigvals(A))
        raise NoSplitError(f"no stable part: every eigenvalue ({poles}) has a nonnegative real part")
    B, C = Z.T @ B, C @ Z
    if n == len(A):
        return Split(StateSpace(T, B, C, D / 2), StateSpace(T[n:, n:], B[n:], C[:, n:], D / 2))
    A_11, A_12, A_22 = T[:n, :n], T[:n, n:], T[n:, n:]
    gaps = np.abs(np.subtract.outer(np.linalg.eigvals(A_11), np.linalg.eigvals(A_22)))
    if gaps.min() <= 2.0 * axis:
        raise NoSplitError(f"a stable and an unstable eigenvalue agree to {gaps.min():.1g} rad/s: no split exists")
    Q = solve_sylvester(A_11, -A_22, -A_12)
    return Split(
        StateSpace(A_11, B[:n] - Q @ B[n:], C[:, :n], D / 2),
        StateSpace(A_22, B[n:], C[:, :n] @ Q + C[:, n:], D / 2),
    )


def ideal_compensator(model: RadiusModel) -> StateSpace:
    """G_pc = G_p (1 - G_m): what turns the ring into the radius, unstable poles included."""
    A, B, C, D = model.state_space()
    return StateSpace(A, B, C[:1] - C[1:], D[:1])


def high_passed(system: StateSpace, cut_off: float = CUT_OFF) -> StateSpace:
    """The system driven through s / (s + cut_off), cut_off in rad/s; one input."""
    A, B, C, D = system
    n = len(A)
    return StateSpace(
        np.block([[A, -B], [np.zeros((1, n)), -cut_off * np.eye(1)]]),
        np.vstack([B, [[cut_off]]]),
        np.hstack([C, -D]),
        D,
    )


def design_compensator(model: RadiusModel, cut_off: float = CUT_OFF) -> Compensator:
    """Part II's design from a linear model of the plant and the high-pass cut-off [rad/s].

    Ideal compensator, high-pass filter, stable part, zero steady-state gain. Raises ValueError for a cut-off that is
    not positive, NoSplitError if the stable part is not a second-order lag that a compensator can be made of: Model
    II, whose plant has no stable pole, leaves only the high-pass filter, and removing its gain leaves nothing.
    """
    if not cut_off > 0.0:
        raise CzError(f"cut_off must be a positive frequency [rad/s], not {cut_off!r}")
    stable = split_stable(high_passed(ideal_compensator(model), cut_off)).stable
    poles = np.linalg.eigvals(stable.A)
    if len(poles) != 2 or np.any(np.abs(poles.imag) > 0.0):
        shown = ", ".join(f"{pole:.4g}" for pole in poles)
        raise NoSplitError(f"the stable part needs two real poles, it has {shown}: no compensator comes of this plant")
    slow, fast = sorted(-poles.real)
    numerator = ss2tf(*stable)[0][0]  # its last coefficient, the steady gain, is dropped
    return Compensator(float(numerator[-2]), float(fast), float(slow))


def controller_transfer(pid: SeriesPID) -> Any:
    """K(s) as a python-control transfer function."""
    import control

    numerator = pid.K_p * np.polymul([pid.T_i, 1.0], [pid.T_d, 1.0])
    return control.tf(numerator, np.polymul([pid.T_i, 0.0], [pid.T_d / pid.N, 1.0]))


def compensator_transfer(compensator: Compensator) -> Any:
    """G_pc(s) as a python-control transfer function."""
    import control

    return control.tf([compensator.gain, 0.0], np.poly([-compensator.fast, -compensator.slow]))


def open_loop(model: RadiusModel, compensator: Compensator | None, pid: SeriesPID | None = None) -> Any:
    """L = -K (G_m G_p + G_pc) as a python-control transfer function; minus, since pulling faster thins the crystal."""
    import control

    seen = control.tf([model.numerator * model.lead, model.numerator * model.constant], np.poly(model.poles))
    if compensator is not None:
        seen = seen + compensator_transfer(compensator)
    return -controller_transfer(pid or SeriesPID()) * seen


def margins(model: RadiusModel, compensator: Compensator | None, pid: SeriesPID | None = None) -> Margins:
    """Crossover, phase margin and closed-loop poles of the continuous loop; NaN where the gain never crosses one."""
    import control

    loop = open_loop(model, compensator, pid)
    _, phase, _, crossover = control.margin(loop)
    poles = control.feedback(loop, 1).poles()
    return Margins(float(crossover), float(phase), poles[np.argsort(np.abs(poles))])
