"""The process of ``Cz-v0``: plant, signals, task and cost of a crystal's body as one value, and its linear model."""

from typing import Any, NamedTuple

import numpy as np

from cz_gym.episodes.draw import randomised
from cz_gym.jit import force_inlined, jittable, labelled
from cz_gym.physics import plant
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters, check_parameters
from cz_gym.physics.plant import (
    HEIGHT_MIN,
    NO_DISTURBANCE,
    RADIUS_LIMIT,
    Disturbance,
    Puller,
    State,
    bias_offset,
    check_height,
    growth,
    melt_left,
    reference,
    within_limits,
)
from cz_gym.process import GROWS, LOST, Inputs, PerfectReadings, Process, StateSpace
from cz_gym.process import linearise as linearise_process
from cz_gym.support.units import MM

from . import signals

_LOW = 5.0 * MM
"""Above this height no melt can freeze the meniscus within half a substep [m]."""
_JUMP = HEIGHT_MIN


class StepMemory(NamedTuple):
    """Numbers besides the state that outlive a step."""

    v_p_mean: Any
    """Exponential mean of the applied pull speed over :data:`cz_gym.body.signals.PULL_MEMORY` [m/s]."""


def check(parameters: Parameters, meniscus: MeniscusModel) -> Parameters:
    """Return the parameters; raise CzError unless a crystal can grow with them."""
    checked = check_parameters(parameters)
    check_height(plant.make_puller(checked, meniscus=meniscus))
    return checked


@jittable
def derive(parameters: Any, factors: Any, m: Any) -> Any:
    """Constants of the drawn puller at its own operating point."""
    return plant.derive_puller(randomised(parameters, factors), factors.lam, m.height, m.ring_offset)


@jittable
def begin(slot: Any, m: Any) -> Any:
    """State of the operating point, its radius off by the drawn deviation."""
    p = slot.puller
    slot.v_p_mean = p.v_0
    return State(p.r_0 + slot.episode.r_c_start, p.h_0, p.T_1_0, p.T_2_0, p.T_b_0)


@jittable
def nominal(x: Any, slot: Any, interval: Any) -> Any:
    """Inputs of the operating point, as controllers are told."""
    return Inputs(slot.puller.v_0, slot.puller.Q_H_0 + slot.episode.told_power)


@jittable
def disturb(Q_d: Any, dT_i: Any, t: Any, e: Any) -> Any:
    """Disturbance at t [s], with the share of the melt's heat capacity that is left."""
    return Disturbance(Q_d, dT_i, melt_left(t, e))


@force_inlined
def rates(x: Any, u: Any, d: Any, p: Any, m: Any) -> Any:
    """The plant's rates with this meniscus."""
    return plant.rates(x, u, d, p, m.slope)


@jittable
def accept(slot: Any, x: Any, new: Any, u: Any, d: Any, t: Any, dt: Any, limit: Any, m: Any) -> Any:
    """The state after a substep and whether the crystal still grows, at this moment's reference."""
    p = slot.puller
    new, grows = accept_substep(x, new, u, d, p, dt, p.r_0 + reference(t, slot.episode), m.slope, limit)
    return new, GROWS if grows else LOST


@jittable
def accept_substep(
    x: Any, new: Any, u: Any, d: Any, p: Any, dt: Any, r_ref: Any, slope: Any, radius_limit: Any = RADIUS_LIMIT
) -> Any:
    """The state after a substep and whether the crystal still grows; after an impossible jump the state before it.

    Over a melt far too cold a low meniscus freezes within seconds, and a step across that singularity can end anywhere,
    inside the limits too. There the height falls faster and faster, so half the step at the first rate tells.
    """
    inside = within_limits(new.r_c, new.h_c, r_ref, p.a, radius_limit)
    grows = inside
    if inside and x.h_c < _LOW:
        grows = x.h_c + 0.5 * dt * (u.v_p - growth(x, d, p, slope).v_g) >= HEIGHT_MIN
    if not grows and (inside or not (np.abs(new.r_c - x.r_c) < _JUMP and np.abs(new.h_c - x.h_c) < _JUMP)):
        new = labelled(State, x)
    return new, grows


@jittable
def perfect_readings(x: Any, p: Any, m: Any) -> Any:
    """The bright ring around the crystal, with and without the operator's bias, and the heater."""
    h_c = signals.height_inside(x.h_c, p)
    ring = x.r_c + m.ring_offset(x.r_c, h_c, p)
    return PerfectReadings(ring, ring - p.ring_bias, h_c, x.T_1)


@jittable
def update_memory(memory: Any, u: Any, nominal: Any, interval: Any) -> Any:
    """The mean pull speed after an interval."""
    return StepMemory(signals.moved_mean(memory.v_p_mean, u.v_p, interval))


@jittable
def cost_inputs(x: Any, u: Any, before: Any, memory: Any, slot: Any, t: Any) -> Any:
    """True radius error less what no sensor shows [m], mean pull speed above nominal [-], steps of both drives."""
    p, e = slot.puller, slot.episode
    error = x.r_c - p.r_0 - reference(t, e) + bias_offset(t, e)
    return signals.Cost(error, memory.v_p_mean / p.v_0 - 1.0, u.v_p - before.v_p, u.Q_H - before.Q_H)


def check_points(p: Puller) -> list[tuple[State, Inputs, Disturbance]]:
    """Three crystals off their operating point, with drives and disturbances off nominal."""
    sides = ((1.02, 0.9, 4.0, 0.3), (0.97, 1.1, -3.0, -0.5), (1.0, 1.3, 9.0, 1.1))
    return [
        (
            State(wide * p.r_0, high * p.h_0, p.T_1_0 + warm, p.T_2_0 + 0.5 * warm, p.T_b_0 + 0.2 * warm),
            Inputs(wide * p.v_0, high * p.Q_H_0),
            Disturbance(100.0 * warm, dT_i, 0.9),
        )
        for wide, high, warm, dT_i in sides
    ]


BODY = Process(
    Constants=Puller,
    State=State,
    Disturbance=Disturbance,
    Measured=signals.Measured,
    TrueState=signals.TrueState,
    Logged=signals.Logged,
    BriefInfo=signals.BriefInfo,
    Cost=signals.Cost,
    past=signals.PAST,
    relative=signals.RELATIVE,
    check=check,
    derive=derive,
    begin=begin,
    nominal=nominal,
    hidden_load=plant.hidden_load,
    disturb=disturb,
    rates=rates,
    accept=accept,
    perfect_readings=perfect_readings,
    measure=signals.measure,
    true_state=signals.true_state,
    logged=signals.logged,
    brief_info=signals.brief_info,
    cost_inputs=cost_inputs,
    cost_terms=signals.cost_terms,
    cost_slopes=signals.cost_slopes,
    reward=signals.reward,
    check_points=check_points,
    weights=signals.WEIGHTS,
    StepMemory=StepMemory,
    update_memory=update_memory,
    name="Cz-v0",
)


# The body's plant as control engineers write it: its state space, and G_p and G_m of the growth dynamics.

STATES = State._fields
"""Rows and columns of A."""
LOADS = ("Q_d", "dT_i")
INPUTS = (*Inputs._fields, *LOADS)
"""Columns of B and D: both inputs, then both disturbances."""
OUTPUTS = ("r_c", "r_br", "v_g", "alpha_c")
"""Rows of C and D."""


class RadiusModel(NamedTuple):
    """Pull speed to bright ring at constant melt temperature, as a series of two transfer functions.

    G_p(s) = numerator / ((s - poles[0]) (s - poles[1])) from v_p to r_c, G_m(s) = lead s + constant from r_c to r_br.
    """

    numerator: float
    """Gain of G_p [1/s]."""
    poles: tuple[float, float]
    """Poles of G_p, that of the cone angle first, then that of the meniscus height [rad/s]."""
    lead: float
    """Coefficient of s in G_m [s]."""
    constant: float
    """Static gain of G_m [-]."""

    @property
    def zero(self) -> float:
        """Zero of G_m [rad/s]; in the right half plane it is the inverse response."""
        return -self.constant / self.lead


def linearise(
    puller: Puller,
    meniscus: MeniscusModel = HURLE,
    x: State | None = None,
    u: Inputs | None = None,
    d: Disturbance = NO_DISTURBANCE,
) -> StateSpace:
    """Linearise the plant and its bright ring at a state, by default the operating point.

    States :data:`STATES`, inputs :data:`INPUTS`, outputs :data:`OUTPUTS`.
    """

    def seen(x: Any, u: Any, d: Any) -> Any:
        at_interface = growth(x, d, puller, meniscus.slope)
        ring = x.r_c + meniscus.ring_offset(x.r_c, x.h_c, puller)
        return x.r_c, ring, at_interface.v_g, np.arctan(at_interface.tan_alpha)

    at = x or puller.state_0, u or puller.inputs_0, d
    return linearise_process(BODY, puller, meniscus, at, LOADS, seen)


def radius_model(puller: Puller, meniscus: MeniscusModel = HURLE) -> RadiusModel:
    """G_p and G_m at the operating point, melt temperature held (Part II, section on the linearised model).

    With r_c' = A_rr r_c + A_rh h_c and h_c' = A_hh h_c + v_p (the height does not feel the radius), G_p's numerator is
    A_rh and its poles are A_rr and A_hh; eliminating h_c from r_br = C_r r_c + C_h h_c gives G_m.
    """
    A, B, C, _ = linearise(puller, meniscus)
    r, h = STATES.index("r_c"), STATES.index("h_c")
    C_r, C_h = C[OUTPUTS.index("r_br"), [r, h]]
    lead = C_h / A[r, h]
    return RadiusModel(
        numerator=float(A[r, h] * B[h, INPUTS.index("v_p")]),
        poles=(float(A[r, r]), float(A[h, h])),
        lead=float(lead),
        constant=float(C_r - lead * A[r, r]),
    )
