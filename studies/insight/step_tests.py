"""Single events on a crystal: how a controller reacts, and the largest event that it survives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cz_gym.config import Config, make_config
from cz_gym.episodes.scenario import Scenario
from cz_gym.errors import CzError
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import Course, Floats, Signals
from cz_gym.units import HOUR, MICRO, MINUTE, MM

MIX = 0.5
"""Share of conduction of the nominal puller here: halfway between Model I and Model II [-]."""
BEGIN = 10.0 * MINUTE
"""When an event happens [s]."""
AT_ONCE = 16
"""Amplitudes tried in one batch."""
JUMPS = np.array([1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 300.0]) * MICRO
"""Sizes of the jumps of the radius [m]."""
DRAWS, CRYSTALS = 5, 32
"""Draws of noise for each limit; crystals over which answers under noise are averaged."""
RIPPLE = 0.1 * MM
"""Amplitude of the ripple [m]."""
ROTATIONS = np.linspace(8.0, 15.0, CRYSTALS) / MINUTE
"""Crystal rotations over which the answer is averaged [rev/s]."""
SPANS = 12
"""Number of spans of ten minutes."""
PROPERTIES: dict[str, tuple[str, tuple[str, ...]]] = {
    "melt loss": ("pullers", ("melt_loss",)),
    "steady drift": ("drift", ("rate",)),
    "pyrometer drift": ("sensor", ("pyrometer_drift",)),
    "ring offset": ("sensor", ("bias_offset", "level_offset")),
    "ripple": ("sensor", ("ripple", "rotation")),
    "latency": ("sensor", ("latency",)),
    "outliers": ("sensor", ("outlier_probability", "outlier_sd")),
    "pull window": ("actuators", ("pull_window",)),
    "pull slew": ("actuators", ("pull_slew",)),
    "heater slew": ("actuators", ("heater_slew",)),
    "heater steps": ("actuators", ("heater_step",)),
}
"""Properties that the scenario puller adds to randomized: the family and its members."""


class Event(NamedTuple):
    """A change of a slot's record, ``change(record, amplitude)``, at a time [s]."""

    at: float
    change: Callable[[Any, float], None]


def _set(*fields: tuple[str, float | None]) -> Callable[[Any, float], None]:
    """A change that sets fields of the episode, to the amplitude where the value is None."""

    def change(slot: Any, amplitude: float) -> None:
        for name, value in fields:
            slot["episode"][name] = amplitude if value is None else value

    return change


def _interface(slot: Any, kelvin: float) -> None:
    """A lasting shift of the temperature that drives the interface's flux."""
    _set(("sd_slow", None), ("keep_slow", 1.0), ("kick_slow", 0.0))(slot, kelvin)
    slot["slow"] = 1.0


def _load(slot: Any, kelvin: float) -> None:
    """A sudden drift of the hot zone by this many kelvin, which the heater recipe does not compensate."""
    for kind, amount in (("drift", kelvin), ("recipe", -kelvin)):
        _set((f"{kind}_start", BEGIN), (f"{kind}_duration", 5.0), (f"{kind}_amount", None))(slot, amount)


def _radius(slot: Any, metres: float) -> None:
    slot["x"]["r_c"] += metres


_reference = _set(("reference_start", BEGIN), ("reference_duration", 30.0 * MINUTE), ("reference_amount", None))
_noise, _silence, _latency = _set(("camera_sd", None)), _set(("camera_sd", 0.0)), _set(("latency", None))
USUAL_NOISE = Event(0.0, _set(("camera_sd", 0.025 * MM), ("pyrometer_sd", 0.05)))
"""Standard deviations in the middle of the randomised scenario's ranges [m, K]."""


class StepTest(NamedTuple):
    """One crystal on which events happen, each with the same amplitude."""

    title: str
    events: tuple[Event, ...]
    amplitude: float
    minutes: float
    """Length [min]."""


STEP_TESTS = (
    StepTest("interface 0.3 K hotter", (Event(BEGIN, _interface),), 0.3, 60.0),
    StepTest("hot zone 1 K hotter, unannounced", (Event(0.0, _load),), 1.0, 120.0),
    StepTest("reference falls 1 mm in 30 min", (Event(0.0, _reference),), -1.0 * MM, 60.0),
    StepTest("camera noise 0.05 mm, 10 min", (Event(BEGIN, _noise), Event(2.0 * BEGIN, _silence)), 0.05 * MM, 40.0),
)
"""The events of the first figure, on a nominal puller without noise."""


class Limit(NamedTuple):
    """An event whose amplitude grows until the crystal is lost."""

    name: str
    meaning: str
    unit: str
    scale: float
    """The unit in SI."""
    most: float
    """Largest amplitude tried, in that unit."""
    event: Event


LIMITS = (
    Limit("radius too large", "jump of the true radius", "mm", MM, 7.9, Event(BEGIN, _radius)),
    Limit("radius too small", "the same, thinner", "mm", -MM, 7.9, Event(BEGIN, _radius)),
    Limit("interface hotter", "lasting step of dT_i", "K", 1.0, 12.0, Event(BEGIN, _interface)),
    Limit("interface colder", "the same, colder", "K", -1.0, 12.0, Event(BEGIN, _interface)),
    Limit("heat load", "step of the hot zone's drift", "K", 1.0, 80.0, Event(0.0, _load)),
    Limit("heat loss", "the same, colder", "K", -1.0, 80.0, Event(0.0, _load)),
    Limit("camera noise", "standard deviation from the start", "mm", MM, 2.0, Event(0.0, _noise)),
    Limit("late camera", "age of the newest frame", "s", 1.0, 60.0, Event(0.0, _latency)),
)
"""Rows of the table of limits, on the nominal puller with the usual noise."""


class Interface(NamedTuple):
    """Arguments of ``gym.make`` that a policy was made for."""

    observation: str = "measured"
    action: str = "direct"


def crystal(minutes: float, interface: Interface) -> Config:
    """A crystal of that length [min] on the nominal puller."""
    return make_config("nominal", MIX, interface.observation, horizon=minutes * MINUTE, action=interface.action)


def control_interval() -> float:
    """Time between actions [s]."""
    return crystal(1.0, Interface()).control_interval


def run_events(
    policy: Any,
    config: Config,
    events: Sequence[Event],
    amplitudes: Sequence[float],
    seeds: Sequence[int] | None = None,
) -> Course:
    """Run a policy on one crystal for each amplitude; the finished course. Only the seed changes the noise."""
    course = Course(config, seeds or [VALIDATION_SEEDS[0]] * len(amplitudes))
    for event in sorted(events, key=lambda event: event.at):
        course.run(policy, round(event.at / config.control_interval))
        states = []
        for state, amplitude in zip(course.env.get_state(), amplitudes, strict=True):
            record = state.slot.slot.copy()
            event.change(record, amplitude)
            states.append(replace(state, slot=replace(state.slot, slot=record)))
        course.env.set_state(states)
    course.run(policy, config.steps)
    course.finish()
    return course


def respond(policy: Any, config: Config, test: StepTest) -> Signals:
    """Signals of a step test, each of shape (steps,)."""
    return Signals(*(signal[:, 0] for signal in run_events(policy, config, test.events, [test.amplitude]).signals))


class Survival(NamedTuple):
    """Largest amplitude of an event below which every one tried was survived, in the limit's unit."""

    largest: float
    """Median over the draws of noise."""
    least: float
    most: float
    """Largest over the draws."""
    capped: bool
    """Whether ``most`` is the largest amplitude tried."""


def survive(policy: Any, limit: Limit, interface: Interface) -> Survival:
    """The largest amplitude survived over three hours, in two rounds of :data:`AT_ONCE` amplitudes a draw of noise."""
    config = crystal(3.0 * HOUR / MINUTE, interface)
    low, high = np.zeros(DRAWS), np.full(DRAWS, limit.most)
    capped = np.zeros(DRAWS, np.bool_)
    seeds = np.repeat(VALIDATION_SEEDS[:DRAWS], AT_ONCE).tolist()
    for _ in range(2):
        tried = np.linspace(low, high, AT_ONCE + 1, axis=1)[:, 1:]
        amplitudes = (limit.scale * tried).ravel().tolist()
        lost = run_events(policy, config, (USUAL_NOISE, limit.event), amplitudes, seeds).failed.reshape(tried.shape)
        first = np.where(lost.any(axis=1), lost.argmax(axis=1), AT_ONCE)
        steps, draws = np.column_stack([low, tried]), np.arange(DRAWS)
        capped |= (first == AT_ONCE) & (high == limit.most)
        low, high = steps[draws, first], steps[draws, np.minimum(first + 1, AT_ONCE)]
    return Survival(float(np.median(low)), float(low.min()), float(low.max()), bool(capped.any()))


def jump_gains(policy: Any, interface: Interface, noisy: bool) -> Floats:
    """Largest move of the pull speed within 3 min of a jump of the radius, over that jump, shape (sizes,) [1/s].

    The difference to the same crystal without the jump; under noise its mean over :data:`CRYSTALS` crystals.
    """
    config = crystal(BEGIN / MINUTE + 3.0, interface)
    seeds = VALIDATION_SEEDS[: CRYSTALS if noisy else 1]
    sizes = [size for size in (0.0, *JUMPS) for _ in seeds]
    events = (*((USUAL_NOISE,) if noisy else ()), Event(BEGIN, _radius))
    v_p = run_events(policy, config, events, sizes, [*seeds] * (len(JUMPS) + 1)).signals.v_p
    mean = v_p.reshape(len(v_p), len(JUMPS) + 1, len(seeds)).mean(axis=2)
    gains: Floats = np.abs(mean[:, 1:] - mean[:, :1]).max(axis=0) / JUMPS
    return gains


def ripple_gains(policy: Any, interface: Interface) -> Floats:
    """RMS of the pull speed's answer to a ripple over the RMS of the ripple, shape (SPANS,) [1/s].

    The difference to the same crystal without the ripple, ten minutes at a time, over all :data:`ROTATIONS`.
    """
    config = crystal(SPANS * BEGIN / MINUTE, interface)

    def turned(slot: Any, rotation: float) -> None:
        slot["episode"]["ripple_amplitude"] = RIPPLE if rotation else 0.0
        slot["episode"]["ripple_omega"] = 2.0 * np.pi * rotation

    rotations = [*ROTATIONS, *np.zeros(CRYSTALS)]
    seeds = [*VALIDATION_SEEDS[:CRYSTALS]] * 2
    v_p = run_events(policy, config, (USUAL_NOISE, Event(0.0, turned)), rotations, seeds).signals.v_p
    answer = (v_p[:, :CRYSTALS] - v_p[:, CRYSTALS:]).reshape(SPANS, -1)
    found: Floats = np.sqrt(2.0 * (answer**2).mean(axis=1)) / RIPPLE
    return found


def usual_noise(policy: Any, interface: Interface) -> Course:
    """An hour on CRYSTALS crystals with the usual noise and no event."""
    seeds = VALIDATION_SEEDS[:CRYSTALS]
    return run_events(policy, crystal(60.0, interface), (USUAL_NOISE,), [0.0] * CRYSTALS, seeds)


def parts_of(whole: Scenario, base: Scenario) -> dict[str, Scenario]:
    """Scenarios by property: ``base`` with one property of ``whole`` each.

    CzError if PROPERTIES does not cover every difference of the two.
    """

    def with_part(scenario: Scenario, family: str, members: tuple[str, ...], name: str) -> Scenario:
        theirs = {member: getattr(getattr(whole, family), member) for member in members}
        return replace(scenario, **{family: replace(getattr(scenario, family), **theirs)}, name=name)

    found, all_of_it = {}, base
    for name, (family, members) in PROPERTIES.items():
        found[name] = with_part(base, family, members, f"{base.name}: {name}")
        all_of_it = with_part(all_of_it, family, members, whole.name)
    if all_of_it != whole:
        raise CzError(f"{whole.name!r} differs from {base.name!r} in more than {', '.join(PROPERTIES)}")
    return found
