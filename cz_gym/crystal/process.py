"""The process of ``CzCrystal-v0``: plant, recipe, signals and task of a whole crystal as one value for the engine."""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.body.process import BODY
from cz_gym.body.signals import Cost, moved_mean
from cz_gym.episodes.draw import Episode, Factors
from cz_gym.episodes.rng import normal
from cz_gym.jit import jittable
from cz_gym.physics.meniscus import MeniscusModel
from cz_gym.physics.parameters import check_parameters
from cz_gym.physics.plant import DRAW_SPAN, HEIGHT_MAX_IN_A, bias_offset, hidden_load
from cz_gym.process import NO_OPERATING_POINT, InImage, Inputs, PerfectReadings, linearise, seen_radius
from cz_gym.support.errors import CzError
from cz_gym.support.units import KILO, MM

from . import plant, recipe, sight, signals
from .plant import (
    APART,
    NO_DISTURBANCE,
    STAGES,
    CrystalState,
    Disturbance,
    check_shape,
    complete,
    parts,
    rates,
)
from .recipe import end, growth_rate, shape_at
from .signals import weight

SLACK = 1.3
"""Time that an episode may last, in multiples of the recipe's [-]."""
Floats = npt.NDArray[np.float64]


class StepMemory(NamedTuple):
    """Numbers besides the state that outlive a step."""

    v_p_mean: Any
    """Exponential mean of the pull speed minus the recipe's over :data:`cz_gym.body.signals.PULL_MEMORY` [m/s]."""
    stop: Any
    """Length at which the episode ends with success [m]."""


class Sensed(NamedTuple):
    """Numbers that load cell and camera write at each sample."""

    load_cell: Any
    """Noise of the load cell's last reading [kg]."""
    ring_error: Any
    """Error of the ring's last valid reading [m]."""
    edge: Any
    """The camera's last reading of the crystal's edge [m]."""
    edge_error: Any
    """Error of the edge's last valid reading [m]."""
    edge_valid: Any
    """1 if the camera reads the edge, else 0."""
    edge_bias: Any
    """Error of the edge that this crystal keeps [m]."""


@lru_cache(maxsize=64)
def nominal_recipe(parameters: Any, meniscus: MeniscusModel, lam: float = 1.0) -> tuple[Any, Floats]:
    """The constants of the design puller and its recipe's table (:class:`cz_gym.crystal.recipe.RecipeRow`)."""
    with np.errstate(all="ignore"):
        p = plant.Crystal(*map(float, plant.derive(parameters, Factors(lam=lam), meniscus)))
        if not np.all(np.isfinite(p)):
            raise CzError(NO_OPERATING_POINT)
        table = np.zeros(recipe.TABLE)
        recipe.fill(table, p, Episode(), meniscus)
    table.setflags(write=False)
    return p, table


def lengths(p: Any) -> Floats:
    """Lengths [m] of the table's rows."""
    return np.asarray((np.arange(recipe.ROWS) - recipe.MARGIN) * recipe.spacing(p))


def check(parameters: Any, meniscus: MeniscusModel) -> Any:
    """Return the parameters; raise CzError, with the length where it fails, unless the whole crystal can be grown."""
    given, growth = parts(parameters)
    checked = parameters._replace(**check_parameters(given)._asdict())
    check_shape(checked)
    p, table = nominal_recipe(checked._replace(**dict.fromkeys(APART, 0.0)), meniscus)
    at = recipe.RecipeRow(*table.T)
    left = growth.M_0 - at.M_s - at.M_men
    for fails, what in (
        (left <= 0.0, f"the charge of {growth.M_0:g} kg is used up: the crystal weighs {at.M_s[-1]:.3g} kg"),
        (~((at.h_c >= recipe.HEIGHT_MIN) & (at.h_c <= HEIGHT_MAX_IN_A * p.a)), "the meniscus is out of its range"),
        (np.isnan(at.ring), f"the meniscus {meniscus.name!r} does not hold ({meniscus.covers})"),
        (~(at.T_b > p.T_m), "the melt would have to be colder than its melting point: less growth rate there"),
        (~(at.v_p > 0.0), "the pull speed is not positive"),
        (~(at.Q_H > 0.0), "the heater's power is not positive"),
        (checked.heater_max < at.Q_H, f"the heater needs more than heater_max_kW = {checked.heater_max / KILO:g}"),
    ):
        if fails.any():
            length = max(float(lengths(p)[np.argmax(fails)]), 0.0) / MM
            raise CzError(f"this crystal cannot be grown: at a length of {length:.0f} mm {what}")
    return checked


def duration(parameters: Any, meniscus: MeniscusModel, interval: float) -> float:
    """The longest stage's time along the recipe, times :data:`SLACK`, in whole intervals [s]."""
    p, table = nominal_recipe(parameters._replace(**dict.fromkeys(APART, 0.0)), meniscus)
    p = p._replace(begins=parameters.begins)
    longest = 0.0
    for stage, name in enumerate(STAGES):
        if getattr(parameters, name) > 0.0:
            start, stop = recipe.span(stage, 0.0, table, p)
            longest = max(longest, float(recipe.time_at(stop, table, p) - recipe.time_at(start, table, p)))
    return interval * math.ceil(SLACK * longest / interval)


@jittable
def begin(slot: Any, m: Any) -> Any:
    """The recipe of the drawn puller, and the state on it where the drawn stage begins, the radius off by what was
    drawn."""
    p, table = slot.puller, slot.table
    recipe.reference_along(slot)
    recipe.fill(table, p, slot.episode, m)
    stage, u = recipe.draw_stage(slot)
    slot.edge_bias = sight.EDGE_BIAS * slot.episode.camera_sd * normal(slot.streams[recipe.START])
    slot.ring_error = slot.edge_error = 0.0
    start, stop = recipe.span(stage, u, table, p)
    slot.stop, slot.v_p_mean = stop, 0.0
    recipe.stretch(slot, (recipe.time_at(stop, table, p) - recipe.time_at(start, table, p)) / DRAW_SPAN)
    x = recipe.state_at(start, table, p, slot.episode)
    return CrystalState(x.r_c + slot.episode.r_c_start, x.h_c, x.T_1, x.T_2, x.T_b, x.L, x.A_s, x.M_s, x.N)


@jittable
def nominal(x: Any, slot: Any, interval: Any) -> Any:
    """The recipe's inputs at the length of the interval's middle: held inputs would else lag behind it."""
    p = slot.puller
    row, share = recipe.place(x.L + 0.5 * interval * growth_rate(x.L, p), p)
    power = recipe.look_up(slot.table, row, share, recipe._Q_H) + slot.episode.told_power
    return Inputs(recipe.look_up(slot.table, row, share, recipe._v_p), power)


@jittable
def disturb(Q_d: Any, dT_i: Any, t: Any, e: Any) -> Any:
    """The disturbance: the melt that is left follows from the state."""
    return Disturbance(Q_d, dT_i)


@jittable
def perfect_readings(x: Any, p: Any, m: Any) -> Any:
    """The bright ring around the crystal and the heater; the recipe's ring is subtracted later, at the length grown."""
    h_c = recipe.height_inside(x.h_c, p)
    ring = x.r_c + m.ring_offset(x.r_c, h_c, p)
    return PerfectReadings(ring, ring, h_c, x.T_1)


@jittable
def update_memory(memory: Any, u: Any, nominal: Any, interval: Any) -> Any:
    """The mean pull speed above the recipe's after an interval."""
    mean = moved_mean(memory.v_p_mean, u.v_p - nominal.v_p, interval)
    return StepMemory(mean, memory.stop)


@jittable
def read_sensors(slot: Any, m: Any) -> None:
    """Load cell, edge and flags: a good frame shows either a ring or, where the meniscus is too flat, the edge alone.

    The frame is the one of the ring's reading, with all its errors; the edge has noise and a bias of its own. Random
    numbers are of the stream of the episode's start, which nothing else draws from once it runs.
    """
    p, e, stream = slot.puller, slot.episode, slot.streams[recipe.START]
    slot.load_cell = signals.LOAD_CELL_NOISE * e.camera_sd * normal(stream)
    noise = sight.EDGE_NOISE * e.camera_sd * normal(stream)
    r_c, r_ref = seen_radius(slot.x.r_c, slot.ring, slot.h_seen, p, m), shape_at(slot.x.L, p, e).r
    slot.edge_valid = 0.0 if sight.shows_ring(r_c, slot.h_seen, p) else slot.valid
    slot.valid = slot.valid - slot.edge_valid
    if slot.k_seen == slot.k:
        slot.edge = r_c + slot.edge_bias + noise
    if slot.valid > 0.0:
        slot.ring_error = slot.ring - r_ref - recipe.value(slot.x.L, slot, recipe._ring)
    if slot.edge_valid > 0.0:
        slot.edge_error = slot.edge - r_ref


@jittable
def in_image(slot: Any, m: Any) -> Any:
    """The crystal of the last frame; the image follows the recipe's radius, and is black while nothing is read."""
    p = slot.puller
    r_c = seen_radius(slot.x.r_c, slot.ring, slot.h_seen, p, m)
    return InImage(r_c if slot.valid + slot.edge_valid > 0.0 else np.nan, p.r_0 - shape_at(slot.x.L, p, slot.episode).r)


@jittable
def cost_inputs(x: Any, u: Any, before: Any, memory: Any, slot: Any, t: Any) -> Any:
    """True radius error less what no sensor shows [m], mean pull speed above the recipe's, steps of both drives."""
    p, e = slot.puller, slot.episode
    error = x.r_c - shape_at(x.L, p, e).r + bias_offset(t, e)
    return Cost(error, memory.v_p_mean / p.v_0, u.v_p - before.v_p, u.Q_H - before.Q_H)


def check_points(p: Any) -> list[tuple[CrystalState, Inputs, Disturbance]]:
    """Crystals off the body's operating point, at four lengths, with drives and disturbances off nominal."""
    sides = ((0.15, 0.8, 0.0, 9.0), (0.7, 0.4, 0.2, 4.0), (1.02, 0.9, 0.5, -3.0), (0.5, 1.2, 0.9, 6.0))
    return [
        (
            CrystalState(wide * p.r_0, high * p.h_0, p.T_1_0 + warm, p.T_2_0 + warm, p.T_b_0 + 0.2 * warm,
                         share * recipe.end(p), 0.02 + share, 0.7 * share * p.M_0, 1.0 - 0.6 * share),
            Inputs(wide * p.v_0, high * p.Q_H_0),
            Disturbance(100.0 * warm, 0.1 * warm),
        )
        for wide, high, share, warm in sides
    ]  # fmt: skip


CRYSTAL = BODY._replace(
    Constants=plant.Crystal,
    State=CrystalState,
    Disturbance=Disturbance,
    Measured=signals.Measured,
    TrueState=signals.TrueState,
    Logged=signals.Logged,
    BriefInfo=signals.BriefInfo,
    past=signals.PAST,
    relative=signals.RELATIVE,
    check=check,
    derive=plant.derive,
    begin=begin,
    nominal=nominal,
    disturb=disturb,
    rates=plant.rates,
    accept=recipe.accept,
    perfect_readings=perfect_readings,
    measure=signals.measure,
    true_state=signals.true_state,
    logged=signals.logged,
    brief_info=signals.brief_info,
    cost_inputs=cost_inputs,
    check_points=check_points,
    StepMemory=StepMemory,
    update_memory=update_memory,
    Sensed=Sensed,
    read_sensors=read_sensors,
    in_image=in_image,
    nominal_moves=True,
    name="CzCrystal-v0",
    table=recipe.TABLE,
    complete=complete,
    apart=APART,
    duration=duration,
)
"""The body's process with a recipe: the same drives, sensors and cost."""
ENVIRONMENTS = {each.name: each for each in (BODY, CRYSTAL)}
"""The processes by the names of their environments."""


# The crystal's plant along its recipe as control engineers write it: deviations from the recipe at each length.
#
# The references run with the length, so a deviation is that from the recipe at the length that has been reached. With
# L as clock, x' = f(x, u) and L' = v_g(x), it moves by A = df/dx - (f / v_g) dv_g/dx at the recipe, and so does B.

STATES = (*CrystalState._fields[:5], "M_s")
"""Rows and columns of A: what changes within minutes, and the mass, which a load cell weighs; area and dopant are the
recipe's."""
_ROWS = [CrystalState._fields.index(name) for name in STATES]
INPUTS = (*Inputs._fields, "Q_d", "dT_i")
"""Columns of B."""
_POINTS = 256


class LinearRecipe(NamedTuple):
    """The linearisation at lengths L [m], each of shape (points, ...)."""

    L: Floats
    A: Floats
    """Shape (points, 6, 6)."""
    B: Floats
    """Shape (points, 6, 4)."""
    C: Floats
    """The bright ring [m], the load cell [N] and the crystal's edge [m] by the states, shape (points, 3, 6)."""
    shows_ring: npt.NDArray[np.bool_]
    """True where the camera shows a ring on the recipe, shape (points,)."""
    load: float
    """Heat load on the melt per kelvin of drift, which the given recipe follows [W/K]."""

    @property
    def a_h(self) -> Floats:
        """Rate with which the height's deviation dies out [rad/s]."""
        return -self.A[:, 1, 1]

    @property
    def c_h(self) -> Floats:
        """The ring by the height [-]."""
        return self.C[:, 0, 1]

    @property
    def zero(self) -> Floats:
        """Zero from pull speed to ring at constant temperature [rad/s]: the inverse response where it is positive."""
        rate: Floats = self.A[:, 0, 0] - self.C[:, 0, 0] * self.A[:, 0, 1] / self.c_h
        return rate


@lru_cache(maxsize=16)
def linear_recipe(parameters: Any, meniscus: MeniscusModel, lam: float = 1.0) -> LinearRecipe:
    """Linearise the design puller along its recipe, with this share of conduction [-]."""
    p, table = nominal_recipe(parameters._replace(**dict.fromkeys(APART, 0.0)), meniscus, lam)
    lengths = np.linspace(0.0, end(p), _POINTS)
    points = [_at(float(L), table, p, meniscus) for L in lengths]
    load = float(hidden_load(0.5, p) - hidden_load(-0.5, p))
    A, B, C, shows = (np.stack(each) for each in zip(*points, strict=True))
    return LinearRecipe(lengths, A, B, C, shows, load)


def _at(L: float, table: Floats, p: Any, m: MeniscusModel) -> tuple[Floats, Floats, Floats, Any]:
    """A, B and C at a length, and whether the camera shows a ring there."""
    row, share = recipe.place(L, p)
    x = CrystalState(*map(float, recipe.state_at(L, table, p, Episode())))
    u = Inputs(*(float(recipe.look_up(table, row, share, at)) for at in (recipe._v_p, recipe._Q_H)))

    def seen(x: Any, u: Any, d: Any) -> Any:
        return x.r_c + m.ring_offset(x.r_c, x.h_c, p), weight(x, 0.0, p), x.r_c

    model = linearise(CRYSTAL, p, m, (x, u, NO_DISTURBANCE), INPUTS[2:], seen)
    moves, length = np.array(rates(x, u, NO_DISTURBANCE, p, m)), CrystalState._fields.index("L")
    drift = moves / moves[length]
    A, B = model.A - np.outer(drift, model.A[length]), model.B - np.outer(drift, model.B[length])
    return A[np.ix_(_ROWS, _ROWS)], B[_ROWS], model.C[:, _ROWS], sight.shows_ring(x.r_c, x.h_c, p)
