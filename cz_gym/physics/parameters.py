"""The puller's parameters: one immutable typed set, with unit, meaning and source on each."""

from __future__ import annotations

import math
from collections.abc import Collection
from numbers import Real
from typing import Annotated, Any, NamedTuple, get_type_hints

from cz_gym.errors import CzError
from cz_gym.units import MM, MM_PER_MIN


class Quantity(NamedTuple):
    """What a number is: its unit, its meaning and where its value comes from."""

    unit: str
    meaning: str
    source: str


_LITERATURE = "silicon literature"
_ESTIMATE = "estimate"
_PART_II = "Bukhari, Hovd, Winkler, Part II"


class Parameters(NamedTuple):
    """Everything that is typed in about a puller and its material; SI units, kelvin, radians.

    Nominal temperatures, power, meniscus height and heat fluxes are *derived* from these by
    :func:`cz_gym.physics.plant.make_puller`. Another puller or material is another instance:
    ``Parameters(r_0=0.1)`` or ``Parameters()._replace(sigma=0.83)``.
    """

    sigma: Annotated[float, Quantity("N/m", "surface tension of the melt", f"{_LITERATURE}, 0.72-0.83")] = 0.72
    rho_l: Annotated[float, Quantity("kg/m3", "density of the melt", f"{_LITERATURE}, 2510-2570")] = 2570.0
    alpha_0: Annotated[float, Quantity("rad", "contact (growth) angle", _LITERATURE)] = math.radians(11.0)
    g: Annotated[float, Quantity("m/s2", "gravity", "fixed")] = 9.81
    sigma_SB: Annotated[float, Quantity("W/m2/K4", "Stefan-Boltzmann constant", "CODATA")] = 5.670374419e-8
    k_l: Annotated[float, Quantity("W/m/K", "thermal conductivity of the melt", _LITERATURE)] = 62.0
    rho_s: Annotated[float, Quantity("kg/m3", "density of the crystal", _LITERATURE)] = 2330.0
    dH: Annotated[float, Quantity("J/kg", "latent heat of fusion", _LITERATURE)] = 1.8e6
    T_m: Annotated[float, Quantity("K", "melting temperature", _LITERATURE)] = 1685.0
    dT_0: Annotated[
        float, Quantity("K", "nominal superheat of the melt bulk", f"fitted: stable pole of {_PART_II}")
    ] = 5.02
    phi_b: Annotated[
        float,
        Quantity(
            "rad", "effective reflection slope of the bright ring, not a camera pose", f"fitted: G_m of {_PART_II}"
        ),
    ] = math.radians(3.5)
    r_0: Annotated[float, Quantity("m", "nominal crystal radius", _PART_II)] = 87.5 * MM
    v_0: Annotated[float, Quantity("m/s", "nominal pull speed", _PART_II)] = 1.2 * MM_PER_MIN
    C_1: Annotated[float, Quantity("J/K", "heat capacity of the heater", f"{_ESTIMATE}: 30 kg graphite")] = 5.7e4
    C_2: Annotated[
        float, Quantity("J/K", "heat capacity of susceptor and crucible", f"{_ESTIMATE}: susceptor and quartz")
    ] = 1.0e5
    C_b: Annotated[float, Quantity("J/K", "heat capacity of the melt bulk", f"{_ESTIMATE}: 80 kg melt")] = 8.0e4
    kappa_12: Annotated[float, Quantity("W/K4", "radiative link heater to susceptor", _ESTIMATE)] = 2.8e-8
    G_1a: Annotated[float, Quantity("W/K", "insulation loss of the heater", _ESTIMATE)] = 30.0
    T_a: Annotated[float, Quantity("K", "ambient (shell) temperature", _ESTIMATE)] = 350.0
    G_2b: Annotated[float, Quantity("W/K", "conductance of the quartz wall", _ESTIMATE)] = 200.0
    eps: Annotated[float, Quantity("1", "emissivity of the melt surface", f"{_ESTIMATE}: liquid silicon")] = 0.2
    R_cr: Annotated[float, Quantity("m", "inner radius of the crucible", _ESTIMATE)] = 0.28
    T_e: Annotated[float, Quantity("K", "effective temperature the melt surface sees", f"{_ESTIMATE}: heat shield")] = (
        1300.0
    )


def describe(kind: type[Any] = Parameters) -> dict[str, Quantity]:
    """Name of each parameter of that kind of tuple to its :class:`Quantity`."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name].__metadata__[0] for name in kind._fields}


_MAY_BE_ZERO = frozenset({"alpha_0", "T_a", "T_e"})
MOST_V_0 = 1e-3
"""Largest nominal pull speed [m/s]; silicon is pulled at hundredths of it."""


def check_numbers(what: str, values: Any, may_be_zero: Collection[str]) -> None:
    """ValueError names a field of a tuple of quantities that is no positive finite number."""
    for name, value in values._asdict().items():
        number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
        if not number or value < 0 or (value == 0 and name not in may_be_zero):
            unit = describe(type(values))[name].unit
            raise CzError(f"{what} {name} = {value!r} must be a positive finite number [{unit}]")


def check_parameters(parameters: Parameters) -> Parameters:
    """Return the parameters, or raise ValueError naming the one that is not a usable number."""
    if not isinstance(parameters, Parameters):
        raise CzError(f"parameters must be a cz_gym.Parameters, not {parameters!r}")
    check_numbers("parameter", parameters, _MAY_BE_ZERO)
    if parameters.alpha_0 >= math.pi / 2:
        raise CzError(f"parameter alpha_0 = {parameters.alpha_0!r} rad must be below a right angle: is it in degrees?")
    if parameters.v_0 > MOST_V_0:
        raise CzError(f"parameter v_0 = {parameters.v_0!r} m/s is above {MOST_V_0:g} m/s: is it in mm/min?")
    if parameters.R_cr <= parameters.r_0:
        raise CzError(
            f"the crucible (R_cr = {parameters.R_cr} m) must be wider than the crystal (r_0 = {parameters.r_0} m)"
        )
    return Parameters(*map(float, parameters))
