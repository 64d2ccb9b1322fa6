"""The puller's parameters: one immutable typed set; units, meanings, sources and ranges are the machine's table."""

import math
from numbers import Real
from typing import Any, NamedTuple, get_type_hints

from cz_gym.support.errors import CzError
from cz_gym.support.units import CELSIUS, MM, MM_PER_MIN

from .quantities import MACHINE, Quantity

Q = Quantity


class Parameters(NamedTuple):
    """The parameters of a puller and its material; SI units, kelvin, radians.

    Nominal temperatures, power, meniscus height and heat fluxes are *derived* from these by
    :func:`cz_gym.physics.plant.make_puller`. Another puller or material is another instance:
    ``Parameters(r_0=0.1)`` or ``Parameters()._replace(sigma=0.83)``. ``describe`` has each one's unit, meaning,
    source and range.
    """

    sigma: float = 0.72
    rho_l: float = 2570.0
    alpha_0: float = math.radians(11.0)
    g: float = 9.81
    sigma_SB: float = 5.670374419e-8
    k_l: float = 62.0
    rho_s: float = 2330.0
    dH: float = 1.8e6
    T_m: float = 1685.0
    dT_0: float = 5.02
    phi_b: float = math.radians(3.5)
    r_0: float = 87.5 * MM
    v_0: float = 1.2 * MM_PER_MIN
    C_1: float = 5.7e4
    C_2: float = 1.0e5
    C_b: float = 8.0e4
    kappa_12: float = 2.8e-8
    G_1a: float = 30.0
    T_a: float = 350.0
    G_2b: float = 200.0
    eps: float = 0.2
    R_cr: float = 0.28
    T_e: float = 1300.0


class CrystalRecipe(NamedTuple):
    """A whole crystal that a puller grows: charge, shape, growth rate, and the crystal's loss of heat.

    SI units; the numbers of the table ``[recipe]`` of a puller file. Only ``CzCrystal-v0`` reads them.
    """

    M_0: float = 80.0
    neck_length: float = 150.0 * MM
    r_start: float = 10.0 * MM
    crown_length: float = 90.0 * MM
    body_length: float = 1000.0 * MM
    tail_length: float = 175.0 * MM
    v_start: float = 2.0 * MM_PER_MIN
    v_crown: float = 0.75 * MM_PER_MIN
    v_body: float = 1.25 * MM_PER_MIN
    v_body_end: float = 1.0 * MM_PER_MIN
    v_tail: float = 1.8 * MM_PER_MIN
    k_s: float = 22.0
    T_fin: float = 1300.0
    m: float = 0.5
    beta: float = 0.15
    k_0: float = 0.8


def describe(kind: type[Any] = Parameters) -> dict[str, Quantity]:
    """Map the name of each field of this kind of tuple to its :class:`Quantity`."""
    if kind in (Parameters, CrystalRecipe):
        return {name: MACHINE[name] for name in kind._fields}
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name].__metadata__[0] for name in kind._fields}


def check_numbers(what: str, values: Any) -> None:
    """Raise CzError naming a field of a tuple of quantities that is no number, or no plausible one."""
    for (name, quantity), value in zip(describe(type(values)).items(), values, strict=True):
        number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
        if not number or value < 0 or (value == 0 and quantity.low != 0):
            raise CzError(f"{what} {name} = {value!r} must be a positive finite number [{quantity.unit}]")
        quantity.check(f"{what} {name}", float(value))


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
    if parameters.dH == silicon.dH and abs(T_m + CELSIUS - silicon.T_m) < 5.0:
        raise CzError(f"parameter T_m = {T_m:g} K is silicon's in degrees Celsius: did you mean {T_m + CELSIUS:g}?")
    return Parameters(*map(float, parameters))
