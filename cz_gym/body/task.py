"""The task: the limits within which a crystal grows, and the effect of an action on the drives."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from cz_gym.body.plant import Puller
from cz_gym.errors import CzError
from cz_gym.jit.compile import jittable
from cz_gym.support.units import KILO, MM

RADIUS_LIMIT = 8.0 * MM
"""Largest |r_c - r_ref| of the default puller [m]; another one's is in proportion to its r_0."""
HEIGHT_MIN = 1.2 * MM
"""Lowest meniscus before it freezes [m]."""
HEIGHT_MAX_IN_A = 1.24
"""Highest meniscus before it detaches [capillary constants]."""
HEATER_RANGE = 10.0 * KILO
"""Range of the default puller's heater drive [W]: Q_H = Q_H0 +- HEATER_RANGE."""
HEATER_SLACK = 0.6
"""Difference between commanded and applied power that is due to the heater's resolution, in units of it [-]."""
SMOOTH_TIME = 50.0
"""Time constant with which ``action="smooth"`` moves both drives [s]."""
SMOOTH_PULL, SMOOTH_HEATER = 1.0, 0.5
"""Drive deviations that a held smooth action of 1 settles at, in shares of v_0 and of the heater's range [-]."""


class Drives(NamedTuple):
    """How an action moves the drives, in shares of v_0 and of the heater's range: keep * applied + gain * action."""

    keep: float
    """Share of the present deviation that is left after one step [-]."""
    pull: float
    """Gain from the action to the pull speed [-]."""
    heater: float
    """Gain from the action to the heater power [-]."""
    power: float = HEATER_RANGE
    """Range of the heater's drive [W]."""

    def asked(self, wanted: Any, applied: Any) -> Any:
        """The action that moves the drives from ``applied`` to ``wanted``, shape (..., 2), in shares of their ranges.

        It may lie outside the box of actions.
        """
        return (wanted - self.keep * applied) / np.array([self.pull, self.heater])


DIRECT = Drives(0.0, 1.0, 1.0)
"""The drives of ``action="direct"``: the action is their deviation from nominal."""
ACTIONS = ("direct", "smooth", "rate")
"""The action modes."""


def drives_of(action: str, control_interval: float, heater_range: float = HEATER_RANGE) -> Drives:
    """The effect of actions in this mode on the drives, at this control interval [s], with this heater range [W].

    "smooth": first-order lags. A held action a brings the pull speed to v_0 (1 + a) and the heater to
    Q_H0 + 5 kW a with a time constant of 50 s; left alone they return to nominal. So noise on the action is bounded,
    coloured noise of the drives, whatever the control interval. "rate": the same without the return to nominal; a held
    action of 1 moves the drives by v_0 and 5 kW every 50 s.
    """
    if action == "direct":
        return DIRECT._replace(power=heater_range)
    share = control_interval / SMOOTH_TIME
    keep, share = (1.0, share) if action == "rate" else (math.exp(-share), 1.0 - math.exp(-share))
    return Drives(keep, SMOOTH_PULL * share, SMOOTH_HEATER * share, heater_range)


@jittable
def within_limits(r_c: Any, h_c: Any, r_ref: Any, a: Any, radius_limit: Any = RADIUS_LIMIT) -> Any:
    """Whether the crystal still grows; false if the meniscus freezes or detaches, the radius is lost, or one is NaN."""
    return (np.abs(r_c - r_ref) <= radius_limit) & (h_c >= HEIGHT_MIN) & (h_c <= HEIGHT_MAX_IN_A * a)


def check_height(puller: Puller) -> None:
    """Raise CzError unless the meniscus is within its limits at the puller's operating point."""
    highest = HEIGHT_MAX_IN_A * puller.a
    if not HEIGHT_MIN <= puller.h_0 <= highest:
        raise CzError(
            f"the nominal meniscus height {puller.h_0 / MM:.3g} mm of these parameters lies outside its limits, "
            f"{HEIGHT_MIN / MM:.3g} to {highest / MM:.3g} mm; check r_0, alpha_0, sigma and rho_l"
        )
