"""The puller's parameters: one immutable typed set, with unit, meaning and source on each."""

from __future__ import annotations

import math
from numbers import Real
from typing import Annotated, Any, NamedTuple, get_type_hints

from cz_gym.errors import CzError
from cz_gym.support.plausible import (
    IN_CELSIUS,
    IN_DEGREES,
    IN_KILO,
    IN_MILLI,
    IN_MM,
    IN_MM_PER_MIN,
    IN_PERCENT,
    Slip,
    check_plausible,
)
from cz_gym.support.units import MM, MM_PER_MIN


class Quantity(NamedTuple):
    """Unit, meaning, source and plausible range of a parameter."""

    unit: str
    meaning: str
    source: str
    low: float | None = None
    """Smallest plausible value; None: any above zero."""
    high: float = math.inf
    """Largest plausible value."""
    slip: Slip | None = None
    """Unit that users may have meant instead."""


Q = Quantity
_L, _E, _II = "silicon literature", "estimate", "Bukhari, Hovd, Winkler, Part II"
_RIGHT = math.nextafter(math.pi / 2.0, 0.0)
"""Largest angle below a right one [rad]."""


class Parameters(NamedTuple):
    """The parameters of a puller and its material; SI units, kelvin, radians.

    Nominal temperatures, power, meniscus height and heat fluxes are *derived* from these by
    :func:`cz_gym.body.plant.make_puller`. Another puller or material is another instance:
    ``Parameters(r_0=0.1)`` or ``Parameters()._replace(sigma=0.83)``.
    """

    sigma: Annotated[float, Q("N/m", "surface tension of the melt", f"{_L}, 0.72-0.83", 0.01, 5.0, IN_MILLI)] = 0.72
    rho_l: Annotated[float, Q("kg/m3", "density of the melt", f"{_L}, 2510-2570", 100.0, 3e4, IN_KILO)] = 2570.0
    alpha_0: Annotated[float, Q("rad", "contact (growth) angle", _L, 0.0, _RIGHT, IN_DEGREES)] = math.radians(11.0)
    g: Annotated[float, Q("m/s2", "gravity", "fixed", None, 100.0)] = 9.81
    sigma_SB: Annotated[float, Q("W/m2/K4", "Stefan-Boltzmann constant", "CODATA", None, 1e-6)] = 5.670374419e-8
    k_l: Annotated[float, Q("W/m/K", "thermal conductivity of the melt", _L, 0.1, 1e3)] = 62.0
    rho_s: Annotated[float, Q("kg/m3", "density of the crystal", _L, 100.0, 3e4, IN_KILO)] = 2330.0
    dH: Annotated[float, Q("J/kg", "latent heat of fusion", _L, 1e4, 1e8, IN_KILO)] = 1.8e6
    T_m: Annotated[float, Q("K", "melting temperature", _L, 200.0, 5e3, IN_CELSIUS)] = 1685.0
    dT_0: Annotated[
        float, Q("K", "nominal superheat of the melt bulk", f"fitted: stable pole of {_II}", None, 500.0)
    ] = 5.02
    phi_b: Annotated[
        float,
        Q("rad", "effective reflection slope of the bright ring, not a camera pose", f"fitted: G_m of {_II}",
          None, _RIGHT, IN_DEGREES),
    ] = math.radians(3.5)  # fmt: skip
    r_0: Annotated[float, Q("m", "nominal crystal radius", _II, None, 2.0, IN_MM)] = 87.5 * MM
    v_0: Annotated[float, Q("m/s", "nominal pull speed", _II, None, 1e-3, IN_MM_PER_MIN)] = 1.2 * MM_PER_MIN
    C_1: Annotated[float, Q("J/K", "heat capacity of the heater", f"{_E}: 30 kg graphite", 500.0, 1e9, IN_KILO)] = 5.7e4
    C_2: Annotated[
        float, Q("J/K", "heat capacity of susceptor and crucible", f"{_E}: susceptor and quartz", 500.0, 1e9, IN_KILO)
    ] = 1.0e5
    C_b: Annotated[float, Q("J/K", "heat capacity of the melt bulk", f"{_E}: 80 kg melt", 500.0, 1e9, IN_KILO)] = 8.0e4
    kappa_12: Annotated[float, Q("W/K4", "radiative link heater to susceptor", _E, None, 1e-4)] = 2.8e-8
    G_1a: Annotated[float, Q("W/K", "insulation loss of the heater", _E, None, 1e5)] = 30.0
    T_a: Annotated[float, Q("K", "ambient (shell) temperature", _E, 200.0, 2e3, IN_CELSIUS)] = 350.0
    G_2b: Annotated[float, Q("W/K", "conductance of the quartz wall", _E, None, 1e5)] = 200.0
    eps: Annotated[float, Q("1", "emissivity of the melt surface", f"{_E}: liquid silicon", None, 1.0, IN_PERCENT)] = (
        0.2
    )
    R_cr: Annotated[float, Q("m", "inner radius of the crucible", _E, None, 5.0, IN_MM)] = 0.28
    T_e: Annotated[float, Q("K", "effective temperature the melt surface sees", f"{_E}: heat shield", 0.0)] = 1300.0


def describe(kind: type[Any] = Parameters) -> dict[str, Quantity]:
    """Map the name of each field of this kind of tuple to its :class:`Quantity`."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name].__metadata__[0] for name in kind._fields}


def check_numbers(what: str, values: Any) -> None:
    """Raise CzError naming a field of a tuple of quantities that is no number, or no plausible one."""
    for name, value in values._asdict().items():
        unit, _, _, low, high, slip = describe(type(values))[name]
        number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
        if not number or value < 0 or (value == 0 and low != 0):
            raise CzError(f"{what} {name} = {value!r} must be a positive finite number [{unit}]")
        check_plausible(f"{what} {name}", float(value), low or 0.0, high, unit, slip)


def check_parameters(parameters: Parameters) -> Parameters:
    """Return the parameters; raise CzError naming the one that is no plausible number."""
    if not isinstance(parameters, Parameters):
        raise CzError(f"parameters must be a cz_gym.Parameters, not {parameters!r}")
    check_numbers("parameter", parameters)
    r_0, R_cr, T_m, T_e = parameters.r_0, parameters.R_cr, parameters.T_m, parameters.T_e
    if R_cr <= r_0:
        raise CzError(f"the crucible (R_cr = {R_cr} m) must be wider than the crystal (r_0 = {r_0} m)")
    if T_e >= T_m:
        raise CzError(f"parameter T_e = {T_e:g} K, what the melt surface sees, must be below T_m = {T_m:g} K")
    silicon = Parameters()
    if parameters.dH == silicon.dH and abs(T_m + 273.15 - silicon.T_m) < 5.0:
        raise CzError(f"parameter T_m = {T_m:g} K is silicon's in degrees Celsius: did you mean {T_m + 273.15:g}?")
    return Parameters(*map(float, parameters))
