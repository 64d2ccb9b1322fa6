"""Cost and signals of a crystal's body.

The cost of a step has four terms, each with a scale and a weight; the reward follows from them. Reward, gradients,
regulators, bounds and reports all read this module. The weights are chosen so that most of a good controller's cost is
its radius error; ``python -m studies.frontier`` shows how well the return ranks controllers.

The table of signals holds every number of an observation or of ``info``, and the function that computes it. A signal
is a field of :class:`Measured` (readings and recipe), :class:`TrueState` (the plant) or :class:`Logged` (``info``); its
annotation gives unit, scale and meaning. Channels, decoding, ``info`` and the pages' tables all follow from here.
"""

from typing import Annotated, Any, NamedTuple

import numpy as np

from cz_gym.jit import jittable
from cz_gym.physics.plant import HEIGHT_MAX_IN_A, HEIGHT_MIN, Disturbance, State, bias_offset, growth, recipe, reference
from cz_gym.process import HEATER_SCALE, PULL_SCALE, Past, Relative, read_drives, signals
from cz_gym.process import Channel as Channel
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN


class Cost(NamedTuple):
    """One number for each term of the cost."""

    radius: Any
    """Error of the true radius, less the offset of the bright ring that no sensor shows."""
    pull: Any
    """Deviation of the mean pull speed from v_0, beyond :data:`PULL_TOLERANCE`: it spoils the crystal (v/G)."""
    pull_step: Any
    """Change of the pull speed from the last step to this one."""
    heater_step: Any
    """Change of the heater power from the last step to this one."""


class Weights(NamedTuple):
    """Weights of the four terms [-]; the defaults are the reward's."""

    radius: float = 1.0
    pull: float = 0.5
    pull_step: float = 0.05
    heater_step: float = 0.5


TOLERANCE = 0.5 * MM
"""Half width of the radius' tolerance band [m]."""
PULL_TOLERANCE = 0.03
"""Deviation of the mean pull speed that costs nothing, relative to v_0 [-]."""
PULL_MEMORY = 30.0 * MINUTE
"""Averaging time of the exponential mean of the pull speed [s]."""
SCALES = Cost(TOLERANCE, PULL_TOLERANCE, 0.06 * MM_PER_MIN, 1.0 * KILO)
"""Deviations [m, -, m/s, W] at which a term equals its weight; the mean pull speed's begins at the end of its band."""
WEIGHTS = Weights()
"""The weights of the environment's reward."""
COST_CAP = 10.0
"""Limit of the saturated cost of a step, however large its terms [-]."""
FAILURE_COST = 1000.0
"""Cost of a failure: that of the worst hundred steps, so that dying pays at no discount up to 0.99 [-]."""


@jittable
def newest_share(interval: Any) -> Any:
    """Share of an interval [s] in the exponential mean at its end [-]."""
    return 1.0 - np.exp(-interval / PULL_MEMORY)


@jittable
def moved_mean(mean: Any, value: Any, interval: Any) -> Any:
    """The exponential mean after an interval [s] at this value."""
    return mean + newest_share(interval) * (value - mean)


@jittable
def beyond_band(pull: Any) -> Any:
    """The part of a relative deviation that lies beyond :data:`PULL_TOLERANCE`, with its sign [-]."""
    return (pull - PULL_TOLERANCE) * (pull.real > PULL_TOLERANCE) + (pull + PULL_TOLERANCE) * (
        pull.real < -PULL_TOLERANCE
    )


@jittable
def cost_terms(at: Any, weights: Any = WEIGHTS) -> Any:
    """The weighted terms [-] at a radius error [m], a relative deviation of the mean pull speed [-] and steps of both
    drives [m/s, W]."""
    return Cost(
        weights.radius * (at.radius / SCALES.radius) ** 2,
        weights.pull * (beyond_band(at.pull) / SCALES.pull) ** 2,
        weights.pull_step * (at.pull_step / SCALES.pull_step) ** 2,
        weights.heater_step * (at.heater_step / SCALES.heater_step) ** 2,
    )


@jittable
def cost_slopes(at: Any, weights: Any = WEIGHTS) -> Any:
    """Derivative of each of :func:`cost_terms` by its own number."""
    per_square = coefficients(weights)
    return Cost(
        2.0 * per_square.radius * at.radius,
        2.0 * per_square.pull * beyond_band(at.pull),
        2.0 * per_square.pull_step * at.pull_step,
        2.0 * per_square.heater_step * at.heater_step,
    )


@jittable
def outside(radius_error: Any, pull: Any) -> Any:
    """1 where true radius error [m] or mean pull speed, relative [-], is out of tolerance; else 0."""
    return 1.0 * ((np.abs(radius_error) > TOLERANCE) | (np.abs(pull) > PULL_TOLERANCE))


@jittable
def coefficients(weights: Any = WEIGHTS) -> Any:
    """The factor of the square in each of :func:`cost_terms`: its weight over its squared scale."""
    return Cost(
        weights.radius / SCALES.radius**2,
        weights.pull / SCALES.pull**2,
        weights.pull_step / SCALES.pull_step**2,
        weights.heater_step / SCALES.heater_step**2,
    )


@jittable
def saturated(total: Any) -> Any:
    """The cost of a step that learners see, 10 c / (10 + c) for the sum c of its terms: below 10, never flat."""
    return COST_CAP * total / (COST_CAP + total)


@jittable
def reward(cost: Any, grows: Any) -> Any:
    """The reward of a step with these cost terms: one minus their saturated sum, 1,000 less if the crystal is lost."""
    earned = 1.0 - saturated(cost.radius + cost.pull + cost.pull_step + cost.heater_step)
    return earned if grows else earned - FAILURE_COST


# The table of signals; the function below each class computes its fields by name, in SI units.

PREVIEWS = (0.0, 1.0 * MINUTE, 5.0 * MINUTE)
"""Times ahead for which reference and recipe are observed [s]."""
_IN_1_MIN, _IN_5_MIN = PREVIEWS[1:]
TEMPERATURE_SCALE = 5.0
"""Scale of temperatures [K]."""


class Measured(NamedTuple):
    """Readings and recipe in a puller's control computer, in SI units; arrays of the batch's shape where decoded.

    Temperatures, power and pull speed are deviations from the nominal that controllers are told; radii from r_0.
    """

    ring_error: Annotated[
        Any, Channel("m", MM, "camera reading minus bias minus r_ref; the last valid reading while invalid")
    ]
    valid: Annotated[Any, Channel("1", 1.0, "1 if the camera says this reading is good, else 0")]
    r_ref: Annotated[Any, Channel("m", MM, "radius reference minus r_0, now")]
    r_ref_1min: Annotated[Any, Channel("m", MM, "the same in 1 minute")]
    r_ref_5min: Annotated[Any, Channel("m", MM, "the same in 5 minutes")]
    T_1_ref: Annotated[Any, Channel("K", TEMPERATURE_SCALE, "recipe of the heater temperature minus nominal, now")]
    T_1_ref_1min: Annotated[Any, Channel("K", TEMPERATURE_SCALE, "the same in 1 minute")]
    T_1_ref_5min: Annotated[Any, Channel("K", TEMPERATURE_SCALE, "the same in 5 minutes")]
    T_1: Annotated[Any, Channel("K", TEMPERATURE_SCALE, "pyrometer reading minus nominal")]
    v_p: Annotated[Any, Channel("m/s", PULL_SCALE, "applied pull speed minus v_0; the scale is v_0")]
    Q_H: Annotated[Any, Channel("W", HEATER_SCALE, "applied heater power minus nominal")]
    v_p_mean: Annotated[Any, Channel("m/s", 0.05 * PULL_SCALE, "exponential 30 min mean of v_p; the scale is v_0 / 20")]


@jittable
def measure(x: Any, u: Any, nominal: Any, memory: Any, readings: Any, slot: Any, t: Any) -> Any:
    """Readings and recipe of a slot at the time t of its sample [s]."""
    p, e, read = slot.puller, slot.episode, read_drives(u, slot)
    r_ref = reference(t, e)
    return Measured(
        ring_error=readings.ring - p.r_0 - r_ref,
        valid=slot.valid,
        r_ref=r_ref,
        r_ref_1min=reference(t + _IN_1_MIN, e),
        r_ref_5min=reference(t + _IN_5_MIN, e),
        T_1_ref=recipe(t, e),
        T_1_ref_1min=recipe(t + _IN_1_MIN, e),
        T_1_ref_5min=recipe(t + _IN_5_MIN, e),
        T_1=readings.T_1 - (p.T_1_0 + e.told_temperature),
        v_p=read.v_p - p.v_0,
        Q_H=read.Q_H - (p.Q_H_0 + e.told_power),
        v_p_mean=e.pull_scale * memory.v_p_mean + e.pull_offset - p.v_0,
    )


_SHARED = signals(Measured)


class TrueState(NamedTuple):
    """The true state and the disturbances; deviations from the puller's own nominal, SI units; the recipe as told.

    For bounds and for training; no agent acts on it.
    """

    r_c_error: Annotated[Any, Channel("m", MM, "true radius minus r_ref")]
    h_c: Annotated[Any, Channel("m", MM, "true meniscus height minus its nominal")]
    T_1: Annotated[Any, Channel("K", TEMPERATURE_SCALE, "true heater temperature minus nominal")]
    T_2: Annotated[Any, Channel("K", TEMPERATURE_SCALE, "true susceptor temperature minus nominal")]
    T_b: Annotated[Any, Channel("K", TEMPERATURE_SCALE, "true melt temperature minus nominal")]
    r_ref: Annotated[Any, _SHARED["r_ref"]]
    r_ref_1min: Annotated[Any, _SHARED["r_ref_1min"]]
    r_ref_5min: Annotated[Any, _SHARED["r_ref_5min"]]
    T_1_ref: Annotated[Any, _SHARED["T_1_ref"]]
    T_1_ref_1min: Annotated[Any, _SHARED["T_1_ref_1min"]]
    T_1_ref_5min: Annotated[Any, _SHARED["T_1_ref_5min"]]
    v_p: Annotated[Any, _SHARED["v_p"]]
    Q_H: Annotated[Any, _SHARED["Q_H"]]
    v_p_mean: Annotated[Any, _SHARED["v_p_mean"]]
    dT_i: Annotated[Any, Channel("K", 1.0, "interface fluctuation now")]
    Q_d: Annotated[Any, Channel("W", KILO, "heat load on the melt now")]
    ring_offset: Annotated[Any, Channel("m", MM, "offset of the ring that no sensor shows")]
    lam: Annotated[Any, Channel("1", 1.0, "share of conduction: 1 is Model I, 0 is Model II")]


@jittable
def true_state(slot: Any, measured: Any, t: Any) -> Any:
    """True state and disturbances of a slot at the time t of its sample [s]."""
    p, x = slot.puller, slot.x
    return TrueState(
        r_c_error=x.r_c - p.r_0 - measured.r_ref,
        h_c=x.h_c - p.h_0,
        T_1=x.T_1 - p.T_1_0,
        T_2=x.T_2 - p.T_2_0,
        T_b=x.T_b - p.T_b_0,
        r_ref=measured.r_ref,
        r_ref_1min=measured.r_ref_1min,
        r_ref_5min=measured.r_ref_5min,
        T_1_ref=measured.T_1_ref,
        T_1_ref_1min=measured.T_1_ref_1min,
        T_1_ref_5min=measured.T_1_ref_5min,
        v_p=slot.v_p - p.v_0,
        Q_H=slot.Q_H - p.Q_H_0,
        v_p_mean=slot.v_p_mean - p.v_0,
        dT_i=slot.dT_i,
        Q_d=slot.Q_d,
        ring_offset=bias_offset(t, slot.episode),
        lam=p.lam,
    )


class Logged(NamedTuple):
    """The entries of a step's ``info``, in SI units."""

    r_c: Annotated[Any, Channel("m", 1.0, "true crystal radius")]
    r_br: Annotated[Any, Channel("m", 1.0, "true radius of the bright ring")]
    r_ref: Annotated[Any, Channel("m", 1.0, "radius reference")]
    h_c: Annotated[Any, Channel("m", 1.0, "true meniscus height")]
    alpha_c: Annotated[Any, Channel("rad", 1.0, "cone angle of the crystal's wall")]
    v_g: Annotated[Any, Channel("m/s", 1.0, "growth rate")]
    v_p: Annotated[Any, Channel("m/s", 1.0, "applied pull speed")]
    Q_H: Annotated[Any, Channel("W", 1.0, "applied heater power")]
    v_p_mean: Annotated[Any, Channel("m/s", 1.0, "exponential 30 min mean of the applied pull speed")]
    T_1: Annotated[Any, Channel("K", 1.0, "true heater temperature")]
    T_1_ref: Annotated[Any, Channel("K", 1.0, "recipe of the heater temperature")]
    T_b: Annotated[Any, Channel("K", 1.0, "true melt temperature")]
    r_br_measured: Annotated[Any, Channel("m", 1.0, "the camera's reading, with noise and offset")]
    ring_offset: Annotated[Any, Channel("m", 1.0, "offset of the ring that no sensor shows")]
    term_radius: Annotated[Any, Channel("1", 1.0, "the reward's term of the radius error")]
    term_pull: Annotated[Any, Channel("1", 1.0, "the reward's term of the mean pull speed")]
    term_pull_step: Annotated[Any, Channel("1", 1.0, "the reward's term of the step of the pull speed")]
    term_heater_step: Annotated[Any, Channel("1", 1.0, "the reward's term of the step of the heater power")]
    cost: Annotated[
        Any, Channel("1", 1.0, "1 if |r_c - r_ref| > 0.5 mm or v_p_mean is off v_0 by more than 3 %, else 0")
    ]
    action_clipped: Annotated[Any, Channel("bool", 1.0, "whether the action lay outside its box")]


@jittable
def out_of_tolerance(slot: Any, measured: Any) -> Any:
    """Constraint's cost of a step: 1 if radius or mean pull speed is out of tolerance, else 0."""
    error = slot.x.r_c - slot.puller.r_0 - measured.r_ref
    return outside(error, slot.v_p_mean / slot.puller.v_0 - 1.0)


@jittable
def height_inside(h_c: Any, p: Any) -> Any:
    """The meniscus height limited to its range, so that a failed state can still be measured."""
    top = HEIGHT_MAX_IN_A * p.a
    if h_c.real < HEIGHT_MIN:
        return HEIGHT_MIN
    return top if h_c.real > top else h_c


@jittable
def logged(slot: Any, measured: Any, cost: Any, t: Any, ring: Any, m: Any) -> Any:
    """:class:`Logged` of a slot at its sample's time t [s], growth taken at a height within the limits; ``ring`` [m] is
    the true bright ring."""
    p, x = slot.puller, slot.x
    inside = State(x.r_c, height_inside(x.h_c, p), x.T_1, x.T_2, x.T_b)
    at_interface = growth(inside, Disturbance(slot.Q_d, slot.dT_i, 1.0), p, m.slope)
    return Logged(
        r_c=x.r_c,
        r_br=ring,
        r_ref=p.r_0 + measured.r_ref,
        h_c=x.h_c,
        alpha_c=np.arctan(at_interface.tan_alpha),
        v_g=at_interface.v_g,
        v_p=slot.v_p,
        Q_H=slot.Q_H,
        v_p_mean=slot.v_p_mean,
        T_1=x.T_1,
        T_1_ref=p.T_1_0 + slot.episode.told_temperature + measured.T_1_ref,
        T_b=x.T_b,
        r_br_measured=slot.ring + p.ring_bias,
        ring_offset=bias_offset(t, slot.episode),
        term_radius=cost.radius,
        term_pull=cost.pull,
        term_pull_step=cost.pull_step,
        term_heater_step=cost.heater_step,
        cost=out_of_tolerance(slot, measured),
        action_clipped=slot.clipped,
    )


class BriefInfo(NamedTuple):
    """The entries of ``info="lean"``; libraries copy info key by key, which costs more than the step."""

    r_c: Any
    r_ref: Any
    cost: Any


@jittable
def brief_info(slot: Any, measured: Any) -> Any:
    """True radius, its reference, and whether the crystal is out of tolerance."""
    return BriefInfo(slot.x.r_c, slot.puller.r_0 + measured.r_ref, out_of_tolerance(slot, measured))


PAST = (
    Past("ring_error", 0.2 * MM),
    Past("v_p", 0.2 * PULL_SCALE),
    Past("T_1", 0.5),
    Past("Q_H", 0.5 * KILO),
)
"""Signals whose past "history" shows."""
RELATIVE = (
    Relative("r_ref_1min", "r_ref", 0.1 * MM, "change of the radius reference within 1 minute"),
    Relative("r_ref_5min", "r_ref", 0.5 * MM, "change of the radius reference within 5 minutes"),
    Relative("T_1_ref_1min", "T_1_ref", 0.2, "change of the recipe within 1 minute"),
    Relative("T_1_ref_5min", "T_1_ref", 1.0, "change of the recipe within 5 minutes"),
    Relative("T_1", "T_1_ref", 2.0, "pyrometer reading minus recipe"),
)
"""The signals that "history" shows relative to another one."""
INFO_ROWS = tuple(signals(Logged).values())
"""Channels of ``info``."""
