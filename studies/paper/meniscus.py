"""Hurle's closed-form meniscus against the exact one, over the radii a puller grows."""

from __future__ import annotations

import math
from typing import NamedTuple

from cz_gym import HURLE, MeniscusModel, Parameters, make_puller
from cz_gym.physics.linearisation import radius_model
from cz_gym.physics.young_laplace import YOUNG_LAPLACE, solve_height
from cz_gym.units import MM

RADII = tuple(radius * MM for radius in (50.0, 62.5, 75.0, 87.5, 100.0, 112.5, 125.0, 137.5, 150.0))
"""Crystal radii compared [m]."""
RING_SLOPES_DEG = (1.0, 2.0, 3.5, 5.0, 8.0, 12.0)
"""Slopes of the bright ring compared [degrees]; 3.5 is the plant's."""


class Meniscus(NamedTuple):
    """A meniscus at a steady crystal, cone angle zero."""

    h: float
    """Height [m]."""
    slope_rate: float
    """Change of the cone angle with the height [rad/m]."""
    ring_offset: float
    """Bright ring minus radius [m]."""
    zero: float
    """Right half plane zero of G_m at the nominal growth rate [rad/s]."""


class MeniscusPair(NamedTuple):
    """Both menisci at one radius."""

    r_c: float
    """[m]."""
    hurle: Meniscus
    exact: Meniscus


def meniscus_at(r_c: float, model: MeniscusModel) -> Meniscus:
    """That meniscus at a crystal of radius r_c [m], everything else nominal."""
    puller = make_puller(Parameters(r_0=r_c), meniscus=model)
    linear = radius_model(puller, model)
    return Meniscus(puller.h_0, linear.numerator / puller.v_0, puller.ring_bias, linear.zero)


def compare_menisci() -> list[MeniscusPair]:
    """Both menisci at :data:`RADII`."""
    return [MeniscusPair(r_c, meniscus_at(r_c, HURLE), meniscus_at(r_c, YOUNG_LAPLACE)) for r_c in RADII]


class RingSlope(NamedTuple):
    """Coefficient of s in G_m at the operating point, for one slope of the ring."""

    phi_b_deg: float
    """[degrees]."""
    hurle: float
    """[s]."""
    exact: float
    """[s]."""


def compare_ring_slopes() -> list[RingSlope]:
    """How G_m depends on the ring's slope on both menisci."""
    found = []
    for degrees in RING_SLOPES_DEG:
        parameters = Parameters(phi_b=math.radians(degrees))
        leads = [radius_model(make_puller(parameters, meniscus=m), m).lead for m in (HURLE, YOUNG_LAPLACE)]
        found.append(RingSlope(degrees, *leads))
    return found


def exact_height() -> float:
    """Exact height [m] at the operating point, from the shooting itself rather than its table."""
    puller, parameters = make_puller(), Parameters()
    return float(solve_height(puller.r_0, parameters.alpha_0, puller.a))
