"""The shape of a crystal and its growth rate against the length L [m] grown since the crown began.

``p`` holds the numbers of a :class:`cz_gym.physics.parameters.Recipe`, ``e`` the episode's change of the reference,
whose start and duration are lengths [m] here. All functions take complex lengths, for derivatives.
"""

from typing import Any, NamedTuple

from cz_gym.episodes.schedule import quintic
from cz_gym.jit.compile import jittable

_OPENS, _ROUNDS = 40.0 / 90.0, 20.0 / 90.0
"""Shares of the crown over which its slope rises and falls."""
_CLOSES, _ENDS = 50.0 / 175.0, 20.0 / 175.0
"""Shares of the tail over which its slope rises and falls."""
_SLOWS, _SPEEDS, _SPEED = 50.0 / 90.0, 75.0 / 90.0, 60.0 / 90.0
"""Shares of the crown over which the growth rate falls, after which it rises, and over which it rises."""
_KNEE = 0.5
"""Length over which the body's falling growth rate begins and ends, in lengths of the crown [-]."""
_TAIL_SPEEDS = 100.0 / 175.0
"""Share of the tail over which the growth rate rises."""


class Shape(NamedTuple):
    """The recipe at a length."""

    r: Any
    """Radius [m]."""
    slope: Any
    """dr/dL, the tangent of the cone angle [-]."""
    v_g: Any
    """Growth rate [m/s]."""


@jittable
def step(L: Any, at: Any, over: Any) -> Any:
    """From 0 to 1 along the quintic of the schedules, over a length from ``at`` on [-]."""
    s = (L - at) / over
    if s.real <= 0.0:
        return 0.0 * s
    return 0.0 * s + 1.0 if s.real >= 1.0 else quintic(s)


@jittable
def ramp(L: Any, at: Any, over: Any) -> Any:
    """Integral of :func:`step` along the length [m]."""
    s = (L - at) / over
    if s.real <= 0.0:
        return 0.0 * s
    return L - at - 0.5 * over if s.real >= 1.0 else over * s * s * s * s * (2.5 + s * (s - 3.0))


@jittable
def shape_at(L: Any, p: Any, e: Any) -> Any:
    """:class:`Shape` at a length; before the crown and after the tail a cylinder."""
    crown, tail, body_ends = p.crown_length, p.tail_length, p.crown_length + p.body_length
    opens, rounds = _OPENS * crown, _ROUNDS * crown
    closes, ends = _CLOSES * tail, _ENDS * tail
    rounds_at, ends_at = crown - rounds, body_ends + tail - ends
    wide = (p.r_0 - p.r_start) / (rounds_at + 0.5 * rounds - 0.5 * opens)
    amount, over = e.reference_amount, e.reference_duration
    narrow = (p.r_0 + amount - p.r_start) / (tail - 0.5 * ends - 0.5 * closes)
    r = (
        p.r_start
        + wide * (ramp(L, 0.0, opens) - ramp(L, rounds_at, rounds))
        + amount * step(L, e.reference_start, over)
        - narrow * (ramp(L, body_ends, closes) - ramp(L, ends_at, ends))
    )
    s = (L - e.reference_start) / over
    bend = 30.0 * (s * (1.0 - s)) ** 2 if 0.0 < s.real < 1.0 else 0.0 * s
    slope = (
        wide * (step(L, 0.0, opens) - step(L, rounds_at, rounds))
        + amount / over * bend
        - narrow * (step(L, body_ends, closes) - step(L, ends_at, ends))
    )
    return Shape(r, slope, growth_rate(L, p))


@jittable
def growth_rate(L: Any, p: Any) -> Any:
    """Growth rate at a length [m/s]."""
    crown, body_ends, knee = p.crown_length, p.crown_length + p.body_length, _KNEE * p.crown_length
    falls_at = (_SPEEDS + _SPEED) * crown
    fall = (p.v_body_end - p.v_body) / (body_ends - knee - falls_at)
    return (
        p.v_start
        + (p.v_crown - p.v_start) * step(L, 0.0, _SLOWS * crown)
        + (p.v_body - p.v_crown) * step(L, _SPEEDS * crown, _SPEED * crown)
        + fall * (ramp(L, falls_at, knee) - ramp(L, body_ends - knee, knee))
        + (p.v_tail - p.v_body_end) * step(L, body_ends, _TAIL_SPEEDS * p.tail_length)
    )


@jittable
def in_cone(L: Any, p: Any) -> Any:
    """Whether a length lies in crown or tail."""
    return (L.real < p.crown_length) | (L.real > p.crown_length + p.body_length)
