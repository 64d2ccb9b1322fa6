"""Trials: one crystal, one event, several controllers; and how large an event each of them survives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from cz_gym.config import Config, make_config
from cz_gym.episodes.scenario import Scenario
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import Course, Signals
from cz_gym.units import HOUR, MICRO, MINUTE, MM

Floats = npt.NDArray[np.float64]
MIX = 0.5
"""Share of conduction of the nominal puller here: halfway between Model I and Model II [-]."""
CAMERA_NOISE, PYROMETER_NOISE = 0.025 * MM, 0.05
"""Standard deviations in the middle of the randomised scenario's ranges [m, K]."""
AT_REST = "at rest"
"""Behind an agent's name: linearised without noise."""
BEGIN = 10.0 * MINUTE
"""When an event happens [s]."""
AT_ONCE = 16
"""Amplitudes tried in one batch."""
JUMPS = np.array([1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 300.0]) * MICRO
"""Jumps of the radius whose answers are compared [m]."""
DRAWS = 5
"""Draws of noise that each is tried under."""
NOISES = 32
"""Crystals that an answer under noise is averaged over."""
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
"""What the real puller adds to randomized: family and members of each property."""


class Event(NamedTuple):
    """Something that happens to slots: ``change(slot record, amplitude)`` at a time [s]."""

    at: float
    change: Callable[[Any, float], None]


class Trial(NamedTuple):
    """A crystal with events."""

    name: str
    title: str
    """What happens, for people."""
    events: tuple[Event, ...]
    amplitude: float
    """What the events are given."""
    minutes: float
    """Length [min]."""


def _interface(slot: Any, kelvin: float) -> None:
    """A lasting shift of the temperature that drives the interface's flux."""
    slot["episode"]["sd_slow"], slot["episode"]["keep_slow"], slot["episode"]["kick_slow"] = kelvin, 1.0, 0.0
    slot["slow"] = 1.0


def _load(slot: Any, kelvin: float) -> None:
    """A hot zone that drifts at once, by what this change of the recipe would make up for; the recipe does not know."""
    episode = slot["episode"]
    for kind, amount in (("drift", kelvin), ("recipe", -kelvin)):
        episode[f"{kind}_start"], episode[f"{kind}_duration"], episode[f"{kind}_amount"] = BEGIN, 5.0, amount


def _reference(slot: Any, metres: float) -> None:
    slot["episode"]["reference_start"], slot["episode"]["reference_duration"] = BEGIN, 30.0 * MINUTE
    slot["episode"]["reference_amount"] = metres


def _noise(slot: Any, metres: float) -> None:
    slot["episode"]["camera_sd"] = metres


def _radius(slot: Any, metres: float) -> None:
    slot["x"]["r_c"] += metres


def _latency(slot: Any, seconds: float) -> None:
    slot["episode"]["latency"] = seconds


def _usual_noise(slot: Any, _: float) -> None:
    slot["episode"]["camera_sd"], slot["episode"]["pyrometer_sd"] = CAMERA_NOISE, PYROMETER_NOISE


def _silence(slot: Any, _: float) -> None:
    slot["episode"]["camera_sd"] = 0.0


TRIALS = (
    Trial("interface", "interface 0.3 K hotter", (Event(BEGIN, _interface),), 0.3, 60.0),
    Trial("load", "hot zone 1 K hotter, unannounced", (Event(0.0, _load),), 1.0, 120.0),
    Trial("reference", "reference falls 1 mm in 30 min", (Event(0.0, _reference),), -1.0 * MM, 60.0),
    Trial(
        "noise",
        "camera noise 0.05 mm, 10 min",
        (Event(BEGIN, _noise), Event(20.0 * MINUTE, _silence)),
        0.05 * MM,
        40.0,
    ),
)
"""What the pictures show, on a nominal puller without noise."""


class Limit(NamedTuple):
    """An event that grows until the crystal is lost."""

    name: str
    meaning: str
    unit: str
    scale: float
    """What the unit is in SI."""
    most: float
    """Largest amplitude tried [SI]."""
    events: tuple[Event, ...]


_USUAL = Event(0.0, _usual_noise)
LIMITS = (
    Limit("radius too large", "jump of the true radius", "mm", MM, 7.9 * MM, (_USUAL, Event(BEGIN, _radius))),
    Limit("radius too small", "the same, thinner", "mm", -MM, -7.9 * MM, (_USUAL, Event(BEGIN, _radius))),
    Limit("interface hotter", "lasting step of dT_i", "K", 1.0, 12.0, (_USUAL, Event(BEGIN, _interface))),
    Limit("interface colder", "the same, colder", "K", -1.0, -12.0, (_USUAL, Event(BEGIN, _interface))),
    Limit("heat load", "step of the hot zone's drift", "K", 1.0, 80.0, (_USUAL, Event(0.0, _load))),
    Limit("heat loss", "the same, colder", "K", -1.0, -80.0, (_USUAL, Event(0.0, _load))),
    Limit("camera noise", "standard deviation from the start", "mm", MM, 2.0 * MM, (_USUAL, Event(0.0, _noise))),
    Limit("late camera", "age of the newest frame", "s", 1.0, 60.0, (_USUAL, Event(0.0, _latency))),
)
"""What the table of limits tries, on the nominal puller with the usual noise."""


def crystal(minutes: float, observation: str) -> Config:
    """The nominal puller for that long."""
    return make_config("nominal", MIX, observation, horizon=minutes * MINUTE)


def happen(course: Course, event: Event, amplitudes: Sequence[float]) -> None:
    """Let an event happen to the slots of a course, each in its size."""
    states = []
    for state, amplitude in zip(course.env.get_state(), amplitudes, strict=True):
        record = state.slot.slot.copy()
        event.change(record, amplitude)
        states.append(replace(state, slot=replace(state.slot, slot=record)))
    course.env.set_state(states)


def run_events(
    policy: Any,
    config: Config,
    events: Sequence[Event],
    amplitudes: Sequence[float],
    seeds: Sequence[int] | None = None,
) -> Course:
    """Run a policy on one crystal a slot, each with its amplitude; the finished course. Noise differs by seed alone."""
    course = Course(config, seeds or [VALIDATION_SEEDS[0]] * len(amplitudes))
    for event in sorted(events, key=lambda event: event.at):
        course.run(policy, round(event.at / config.control_interval))
        happen(course, event, amplitudes)
    course.run(policy, config.steps)
    course.finish()
    return course


def respond(policy: Any, config: Config, trial: Trial) -> Signals:
    """Signals of a trial, each of shape (steps,)."""
    signals = run_events(policy, config, trial.events, [trial.amplitude]).signals
    return Signals(*(signal[:, 0] for signal in signals))


class Survival(NamedTuple):
    """How much of an event a controller survives: amplitudes below which every one tried was survived, limit's unit."""

    largest: float
    """Median over the draws of noise."""
    least: float
    most: float
    """The smallest and the largest of them."""
    capped: bool
    """Whether ``most`` is all that was tried."""


def survive(policy: Any, limit: Limit, observation: str) -> Survival:
    """The largest amplitude survived over three hours, in two rounds of :data:`AT_ONCE` amplitudes a draw of noise."""
    config = crystal(3.0 * HOUR / MINUTE, observation)
    low, high = np.zeros(DRAWS), np.full(DRAWS, limit.most)
    whole = np.zeros(DRAWS, np.bool_)
    seeds = np.repeat(VALIDATION_SEEDS[:DRAWS], AT_ONCE).tolist()
    for _ in range(2):
        tried = np.linspace(low, high, AT_ONCE + 1, axis=1)[:, 1:]
        lost = run_events(policy, config, limit.events, tried.ravel().tolist(), seeds).failed.reshape(tried.shape)
        first = np.where(lost.any(axis=1), lost.argmax(axis=1), AT_ONCE)
        steps, draws = np.column_stack([low, tried]), np.arange(DRAWS)
        whole |= (first == AT_ONCE) & (high == limit.most)
        low, high = steps[draws, first], steps[draws, np.minimum(first + 1, AT_ONCE)]
    found = low / limit.scale
    return Survival(float(np.median(found)), float(found.min()), float(found.max()), bool(whole.any()))


def jump_gains(policy: Any, observation: str, noisy: bool) -> Floats:
    """Largest move of the pull speed within 3 min of a jump of the radius, over that jump, shape (sizes,) [1/s].

    The difference to the same crystal without the jump; under noise its mean over :data:`NOISES` crystals.
    """
    config = crystal(BEGIN / MINUTE + 3.0, observation)
    seeds = VALIDATION_SEEDS[: NOISES if noisy else 1]
    sizes = [size for size in (0.0, *JUMPS) for _ in seeds]
    events = (*((_USUAL,) if noisy else ()), Event(BEGIN, _radius))
    v_p = run_events(policy, config, events, sizes, [*seeds] * (len(JUMPS) + 1)).signals.v_p
    mean = v_p.reshape(len(v_p), len(JUMPS) + 1, len(seeds)).mean(axis=2)
    gains: Floats = np.abs(mean[:, 1:] - mean[:, :1]).max(axis=0) / JUMPS
    return gains


def noisy_observations(policy: Any, observation: str) -> Floats:
    """What a policy observes after an hour of the usual noise, one row a seed of :data:`NOISES`."""
    config, seeds = crystal(60.0, observation), VALIDATION_SEEDS[:NOISES]
    found: Floats = run_events(policy, config, (_USUAL,), [0.0] * len(seeds), seeds).observation
    return found


def parts_of(whole: Scenario, base: Scenario) -> dict[str, Scenario]:
    """What ``whole`` adds to ``base``, one property at a time: scenarios by the property's name.

    ValueError if the properties named here are not all that differs.
    """
    found, all_of_it = {}, base
    for name, (family, members) in PROPERTIES.items():
        theirs = {member: getattr(getattr(whole, family), member) for member in members}
        found[name] = replace(base, **{family: replace(getattr(base, family), **theirs)}, name=f"{base.name}: {name}")
        all_of_it = replace(all_of_it, **{family: replace(getattr(all_of_it, family), **theirs)})
    if replace(all_of_it, name=whole.name) != whole:
        raise ValueError(f"{whole.name!r} differs from {base.name!r} in more than {', '.join(PROPERTIES)}")
    return found
