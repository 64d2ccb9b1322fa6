"""The task: the limits within which a crystal grows."""

from typing import Any

import numpy as np

from cz_gym.body.plant import Puller
from cz_gym.errors import CzError
from cz_gym.jit.compile import jittable
from cz_gym.physics.parameters import Parameters
from cz_gym.support.units import MM

RADIUS_LIMIT = 8.0 * MM
"""Largest |r_c - r_ref| of the default puller [m]."""
HEIGHT_MIN = 1.2 * MM
"""Lowest meniscus before it freezes [m]."""
HEIGHT_MAX_IN_A = 1.24
"""Highest meniscus before it detaches [capillary constants]."""


def radius_limit(r_0: Any) -> Any:
    """Largest |r_c - r_ref| of a puller of nominal radius r_0 [m]: :data:`RADIUS_LIMIT`, in proportion to r_0."""
    return RADIUS_LIMIT * (r_0 / Parameters().r_0)


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
