"""The task: the part of the crystal that an episode grows, and the limits within which it grows."""

from typing import Any

import numpy as np

from cz_gym.body.task import HEIGHT_MAX_IN_A
from cz_gym.episodes.record import FREEZES, Stream
from cz_gym.episodes.rng import uniform
from cz_gym.episodes.scenario import DRAW_SPAN
from cz_gym.jit.compile import jittable, labelled
from cz_gym.process import DONE, GROWS, LOST
from cz_gym.support.units import HOUR, MM

from .plant import State, at_interface
from .recipe import MARGIN, ROWS, look_up, place, spacing
from .shape import in_cone, shape_at

HEIGHT_MIN = 0.6 * MM
"""Lowest meniscus before it freezes [m]."""
CONE_LIMIT = 1.5
"""Largest radius error in the cones, in multiples of the body's [-]."""
LEAST_RADIUS = 0.2
"""Smallest radius, in multiples of the neck's [-]."""
BODY_TIME = 3.0 * HOUR
"""Time of the recipe that the stage "body" grows [s]."""
AFTER_CROWN, BEFORE_TAIL = 60.0 * MM, 50.0 * MM
"""Length of body that the stage "crown" ends with, and that the stage "tail" begins with [m]."""
SHORTEST_CHANGE = 0.05
"""Least share of the body over which a reference changes [-]."""
_START = int(Stream.START)
_LOW, _JUMP = 5.0 * MM, 1.2 * MM


@jittable
def end(p: Any) -> Any:
    """Length of the whole crystal [m]."""
    return p.crown_length + p.body_length + p.tail_length


@jittable
def time_at(L: Any, table: Any, p: Any) -> Any:
    """Time [s] at which the recipe reaches a length."""
    row, share = place(L, p)
    return look_up(table, row, share, 0)


@jittable
def length_at(t: Any, table: Any, p: Any) -> Any:
    """Length [m] that the recipe has reached at a time [s]."""
    row = 1
    while row < ROWS - 2 and table[row + 1, 0] < t:
        row += 1
    share = (t - table[row, 0]) / (table[row + 1, 0] - table[row, 0])
    return (row + share - MARGIN) * spacing(p)


@jittable
def span(stage: Any, u: Any, table: Any, p: Any) -> Any:
    """Lengths [m] at which a stage (its number in :data:`.parameters.STAGES`) begins and ends; u in [0, 1) draws."""
    body_ends = p.crown_length + p.body_length
    if p.begins >= 0.0:
        return p.begins, min(length_at(time_at(p.begins, table, p) + BODY_TIME, table, p), end(p))
    if stage == 0:
        return 0.0, p.crown_length + min(AFTER_CROWN, p.body_length)
    if stage == 1:
        first, last = time_at(p.crown_length, table, p), time_at(body_ends, table, p)
        begins = first + u * max(last - BODY_TIME - first, 0.0)
        return length_at(begins, table, p), min(length_at(begins + BODY_TIME, table, p), body_ends)
    return (body_ends - min(BEFORE_TAIL, p.body_length) if stage == 2 else 0.0), end(p)


@jittable
def draw_stage(slot: Any) -> Any:
    """Number of the stage that the episode grows, and a number in [0, 1) for where it begins."""
    p = slot.puller
    u, v = uniform(slot.streams[_START]), uniform(slot.streams[_START])
    stage = 0
    for upto in (p.crown, p.crown + p.body, p.crown + p.body + p.tail):
        stage += 1 if u >= upto else 0
    return stage, v


@jittable
def reference_along(slot: Any) -> None:
    """Turn the reference's change from times into lengths: three hours are the length of the body."""
    p, e = slot.puller, slot.episode
    start, over = e.reference_start / DRAW_SPAN, max(e.reference_duration / DRAW_SPAN, SHORTEST_CHANGE)
    e.reference_start = p.crown_length + min(start, 1.0 - SHORTEST_CHANGE) * p.body_length
    e.reference_duration = min(over, 1.0 - min(start, 1.0 - SHORTEST_CHANGE)) * p.body_length


@jittable
def stretch(slot: Any, times: Any) -> None:
    """Stretch what a scenario spreads over three hours; what lasts some seconds or minutes keeps its duration."""
    e = slot.episode
    e.drift_start, e.drift_duration, e.drift_rate = (
        e.drift_start * times,
        e.drift_duration * times,
        e.drift_rate / times,
    )
    e.bias_drift_start, e.bias_drift_duration = e.bias_drift_start * times, e.bias_drift_duration * times
    for which in range(FREEZES):
        later = (times - 1.0) * slot.freezes[which, 0]
        slot.freezes[which, 0] += later
        slot.freezes[which, 1] += later


@jittable
def height_inside(h_c: Any, p: Any) -> Any:
    """The meniscus height limited to its range, so that a failed state can still be measured."""
    top = HEIGHT_MAX_IN_A * p.a
    if h_c.real < HEIGHT_MIN:
        return HEIGHT_MIN + 0.0 * h_c
    return top + 0.0 * h_c if h_c.real > top else h_c


@jittable
def within_limits(x: Any, r_ref: Any, limit: Any, p: Any) -> Any:
    """Whether the crystal still grows: meniscus, radius and superheat within their limits; false if one is NaN."""
    radius = (np.abs(x.r_c - r_ref) <= limit) & (x.r_c >= LEAST_RADIUS * p.r_start)
    meniscus = (x.h_c >= HEIGHT_MIN) & (x.h_c <= HEIGHT_MAX_IN_A * p.a)
    return radius & meniscus & (x.T_b >= p.T_m)


WAYS = ("frozen", "detached", "off", "cold")
"""Ways to lose a crystal: meniscus too low, meniscus too high, radius too far off, melt below its melting point."""


def room(at: Any, limit: Any, q: Any) -> Any:
    """Relative distance of logged signals to the limit of each of :data:`WAYS`; the least one says how it was lost.

    After an impossible jump the state is the one before, which is still within all limits. ``limit`` is the largest
    radius error of the body [m], q the parameters.
    """
    a = (2.0 * q.sigma / (q.rho_l * q.g)) ** 0.5
    body_ends = q.crown_length + q.body_length
    cone = np.where((q.crown_length <= at.L) & (body_ends >= at.L), 1.0, CONE_LIMIT)
    radius = np.minimum(1.0 - np.abs(at.r_c - at.r_ref) / (limit * cone), at.r_c / (LEAST_RADIUS * q.r_start) - 1.0)
    return (at.h_c - HEIGHT_MIN) / _LOW, (HEIGHT_MAX_IN_A * a - at.h_c) / a, radius, at.T_b - q.T_m


@jittable
def accept(slot: Any, x: Any, new: Any, u: Any, d: Any, t: Any, dt: Any, limit: Any, m: Any) -> Any:
    """The state after a substep and whether the crystal grows on, is lost, or long enough.

    After an impossible jump it is the state before. Low menisci freeze as those of a body do
    (:func:`cz_gym.body.process.accept_substep`).
    """
    p = slot.puller
    widest = limit * CONE_LIMIT if in_cone(new.L, p) else limit
    inside = within_limits(new, shape_at(new.L, p, slot.episode).r, widest, p)
    grows = inside
    if inside and x.h_c < _LOW:
        grows = x.h_c + 0.5 * dt * (u.v_p - at_interface(x, d, p, m.slope).v_g) >= HEIGHT_MIN
    if not grows and (inside or not (np.abs(new.r_c - x.r_c) < _JUMP and np.abs(new.h_c - x.h_c) < _JUMP)):
        new = labelled(State, x)
    long_enough = DONE if slot.stop <= new.L else GROWS
    return new, (long_enough if grows else LOST)
