"""The settings of an environment: one frozen, checked value, shared by its scalar and its batched form."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import lru_cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from cz_gym.body.process import BODY
from cz_gym.camera.view import Camera, camera_for, camera_sight, check_camera
from cz_gym.crystal.plant import CrystalParameters
from cz_gym.crystal.process import ENVIRONMENTS
from cz_gym.episodes.draw import Factors
from cz_gym.episodes.scenario import FAMILIES, AnyScenario, Distribution, Mixture, Scenario
from cz_gym.episodes.scenarios import RANDOMIZED, adapt_scenario, find_distribution, find_scenario, mix_of
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.parameters import Parameters, Range, pose_for
from cz_gym.puller.file import DEFAULT, PullerFile, find_puller, to_toml
from cz_gym.support.errors import CzError, require_type, unknown_name_message

from .process import Inputs, Process
from .spaces import ACTIONS, CAMERA, OBSERVATIONS, TargetEnv

VERSION = 0
"""Version of the environment's contract; a change of it, or of physics, makes a Cz-v1."""


class Identity(NamedTuple):
    """The settings that a saved state depends on: environments in which they are equal continue each other's states."""

    version: int
    """Version of the environment's contract."""
    plant: str
    """Hash of the plant (:attr:`Config.plant_hash`)."""
    scenario: str
    """Name and hash of the scenario."""
    mix: Range
    """Range of the share of conduction [-]."""
    observation: str
    action: str
    control_interval: float
    """Time between actions [s]."""
    horizon: float
    """Length of an episode [s]."""
    puller: str = DEFAULT.label
    """Name and hash of the puller file."""
    weights: str = ""
    """Weights of the reward's terms."""

    def difference(self, other: Self) -> str | None:
        """The first difference in words; None if there is none."""
        for name, mine, its in zip(self._fields, self, other, strict=True):
            if mine != its:
                return f"{name.replace('_', ' ')} {mine}, not {its}"
        return None


@dataclass(frozen=True)
class Config:
    """Settings of ``gym.make("Cz-v0", ...)``, checked on construction by :func:`make_config`."""

    scenario: Distribution = RANDOMIZED
    """The scenario, or the mixture of scenarios, from which episodes are drawn."""
    model: str | float | None = None
    observation: str = "history"
    action: str = "smooth"
    """Action mode: "direct", "smooth" or "rate" (:func:`cz_gym.spaces.drives_of`)."""
    control_interval: float = 5.0
    """Time between actions [s]."""
    horizon: float = 10800.0
    """Length of an episode [s]."""
    parameters: Parameters = field(default_factory=Parameters)
    meniscus: MeniscusModel = HURLE
    camera: Camera = field(default_factory=Camera)
    """The camera of ``observation="camera"``; a whole crystal's flags follow from where it stands."""
    puller: PullerFile = DEFAULT
    """The machine; scenario, parameters and control interval follow from it in :func:`make_config`."""
    process: Process = field(default=BODY, repr=False)
    """The simulated process."""
    weights: Any = BODY.weights
    """Weights of the reward's terms (:class:`cz_gym.body.signals.Weights`)."""

    @property
    def ranges(self) -> tuple[float, float]:
        """Change of pull speed [m/s] and heater power [W] by an action of 1; both are observed in these scales."""
        return self.parameters.v_0, self.heater_range

    @property
    def heater_range(self) -> float:
        """Change of the heater power by an action of 1 [W]."""
        return self.puller.power_range

    @property
    def radius_limit(self) -> float:
        """Largest |r_c - r_ref| before the crystal is lost [m]."""
        return self.puller.radius_limit

    @property
    def steps(self) -> int:
        """Steps in an episode."""
        return round(self.horizon / self.control_interval)

    @property
    def sole_scenario(self) -> Scenario:
        """The scenario of all episodes; CzError if it is a mixture."""
        return find_scenario(self.scenario)

    @property
    def mix(self) -> Range:
        """Range of the share of conduction [-]."""
        return mix_of(self.model, self.scenario)

    @property
    def plant_hash(self) -> str:
        """SHA-256 of the plant: its parameters, and its results at some points (16 hex digits).

        The hash covers numbers, not code: rewriting an equation does not change it.
        """
        given, apart = self.parameters._asdict(), self.process.apart
        numbers = (0.0 if name in apart else float(value) + 0.0 for name, value in given.items())
        parameters = type(self.parameters)(*numbers)
        return _hash(VERSION, *_without_layer(parameters), *_computed(self.process, self.meniscus, parameters))

    @property
    def reward_hash(self) -> str:
        """SHA-256 of the reward: its weights, and its results at some points (16 hex digits)."""
        process, numbers = self.process, list[float](self.weights)
        carried = process.update_memory(
            process.StepMemory(*[1.0] * len(process.StepMemory._fields)), Inputs(2.0, 3.0), Inputs(0.0, 0.0), 60.0
        )
        for size in (10.0**power for power in range(-6, 5)):
            terms = process.cost_terms(process.Cost(*[size] * len(process.Cost._fields)), self.weights)
            numbers += [*terms, process.reward(terms, True), process.reward(terms, False)]
        return _hash(*numbers, *carried)

    @property
    def made_for(self) -> TargetEnv:
        """Record of this environment that controllers and agents made for it keep."""
        return TargetEnv(self.action, self.control_interval, self.plant_hash, self.puller.label)

    @property
    def hash(self) -> str:
        """SHA-256 of everything a saved state depends on (16 hex digits)."""
        return hashlib.sha256(json.dumps(self.identity).encode()).hexdigest()[:16]

    @property
    def identity(self) -> Identity:
        """The settings that a saved state depends on."""
        grown = "".join(f", {name} {getattr(self.parameters, name):g}" for name in self.process.apart)
        scenario = f"{self.scenario.name!r} ({self.scenario.hash}){grown}"
        low, high = self.mix
        mix = float(low) + 0.0, float(high) + 0.0
        seen = f"camera {tuple(self.camera)}" if self.observation == CAMERA else self.observation
        return Identity(
            *(VERSION, self.plant_hash, scenario, mix, seen, self.action, self.control_interval, self.horizon),
            self.puller.label,
            ", ".join(f"{name} {weight}" for name, weight in self.weights._asdict().items()),
        )

    def with_scenario(self, scenario: AnyScenario) -> Self:
        """The same settings on another scenario or mixture, which is adapted to the puller."""
        return replace(self, scenario=adapt_scenario(self.puller, find_distribution(_scenario_of(scenario))))


def check_config(config: Config) -> Config:
    """Return the config; raise CzError for anything else, such as the name of a scenario."""
    given = repr(config) if isinstance(config, str) else ""
    checked: Config = require_type(
        Config, config, f"cz_gym.config.make_config({given}) makes one, env.unwrapped.config is one"
    )
    return checked


def make_config(
    scenario: AnyScenario = "randomized",
    model: str | float | None = None,
    observation: str = "history",
    control_interval: float | None = None,
    horizon: float | None = None,
    parameters: Parameters | Mapping[str, float] | None = None,
    meniscus: MeniscusModel | str | None = None,
    camera: Camera | Mapping[str, float] | None = None,
    action: str = "smooth",
    puller: str | Path | PullerFile | None = None,
    process: Process | str | None = None,
    weights: Mapping[str, float] | None = None,
    stage: Any = None,
) -> Config:
    """Check the arguments of the environment; CzError names what was given and what is allowed.

    Each may have the form that :func:`as_json` gives it.
    """
    named: Any = ENVIRONMENTS.get(process, process) if isinstance(process, str) else process or BODY
    simulated: Process = require_type(Process, named, "cz_gym.body.process.BODY is one")
    machine, shape = find_puller(puller), _find_meniscus(meniscus)
    scenario, parameters = _scenario_of(scenario), _fields_of((Parameters, CrystalParameters), parameters)
    seen: Camera | None = _fields_of((Camera,), camera)
    if puller is not None and parameters is not None:
        raise CzError(f"parameters are those of the puller {machine.name!r}: give one of both")
    drawn_from = adapt_scenario(machine, find_distribution(scenario))
    mix_of(model, drawn_from)
    _check_modes(observation, action, seen)
    interval = positive("control_interval", machine.control_interval if control_interval is None else control_interval)
    given = machine.parameters if parameters is None else parameters
    checked = simulated.check(simulated.complete(given, machine, stage), shape)
    length = _whole_steps(simulated.duration(checked, shape, interval) if horizon is None else horizon, interval)
    pose = machine.pose(machine.parameters) if parameters is None else pose_for(checked)
    checked_camera = check_camera(camera_for(checked, pose) if seen is None else seen, checked)
    if seen is not None and hasattr(checked, "lens_x"):
        checked = checked._replace(**camera_sight(checked_camera)._asdict())
    return Config(
        *(drawn_from, model, observation, action, interval, length, checked, shape, checked_camera),
        puller=machine,
        process=simulated,
        weights=simulated.weights if weights is None else _weights(weights, simulated.weights),
    )


MENISCI = HURLE.name, "young-laplace"
"""Names of the menisci of this package."""


def _find_meniscus(given: Any) -> MeniscusModel:
    """The meniscus of a name, or the user's own; Hurle's by default."""
    if given == MENISCI[1]:
        from cz_gym.physics.young_laplace import YOUNG_LAPLACE  # it reads tables that are seldom needed

        return YOUNG_LAPLACE
    shape = HURLE if given is None or given == HURLE.name else given
    if not isinstance(shape, MeniscusModel):
        raise CzError(f"meniscus must be a cz_gym.MeniscusModel, not {given!r}")
    return shape


def _whole_steps(horizon: Any, interval: float) -> float:
    """The horizon [s], checked to be a whole number of control intervals."""
    length = positive("horizon", horizon)
    steps = length / interval
    if round(steps) < 1 or abs(steps - round(steps)) > 1e-9 * steps:
        raise CzError(f"horizon {length:g} s must be a whole number of control intervals of {interval:g} s")
    return length


def as_json(value: Any) -> Any:
    """An argument of the environment, or a dict or list of them, as JSON that :func:`make_config` reads as the same.

    A scenario becomes a dict of its name and of its numbers off their defaults, a mixture one of its scenarios and
    their shares, a puller the text of its file. A process or a meniscus of the user's own stays as it is.
    """
    if isinstance(value, Scenario | Mixture | MeniscusModel | Process | PullerFile):
        return _own_as_json(value)
    if isinstance(value, Mapping):
        if all(isinstance(key, str) for key in value):
            return {str(key): as_json(each) for key, each in value.items()}
        return as_json(find_distribution(value))
    if isinstance(value, Path | Enum):
        return str(value) if isinstance(value, Path) else value.value
    if hasattr(value, "_asdict"):
        return as_json(value._asdict())
    if isinstance(value, tuple | list | np.ndarray):
        return [as_json(each) for each in value]
    return value.item() if isinstance(value, np.generic) else value


def _own_as_json(value: Any) -> Any:
    """A record of this package as JSON (:func:`as_json`)."""
    match value:
        case Scenario():
            numbers: dict[str, Any] = {"name": value.name, "series": as_json(value.series)} if value.series else {}
            for family, each, number in value.members:
                if number != each.default:
                    numbers.setdefault(family, {})[each.name] = as_json(number)
            return {"name": value.name, **numbers}
        case Mixture():
            return {"scenarios": as_json(value.scenarios), "shares": list(value.shares)}
        case MeniscusModel():
            return value.name if value.name in MENISCI and _find_meniscus(value.name) == value else value
        case Process():
            return value.name if ENVIRONMENTS.get(value.name) == value else value
    return to_toml(value)


def _scenario_of(given: Any) -> Any:
    """A scenario or mixture in JSON's form (:func:`as_json`) as such; anything else as it is."""
    if not isinstance(given, Mapping):
        return given
    if isinstance(given.get("shares"), list) and isinstance(given.get("scenarios"), list):
        return Mixture(tuple(map(_scenario_of, given["scenarios"])), tuple(given["shares"]))
    if not isinstance(given.get("name"), str):
        return given
    parts: dict[str, Any] = {"name": given["name"]}
    for family, numbers in given.items():
        if family == "series":
            parts[family] = tuple(map(tuple, numbers))
        elif family != "name":
            if family not in FAMILIES:
                raise CzError(unknown_name_message("family of a scenario", family, FAMILIES))
            known = FAMILIES[family].__dataclass_fields__
            for name in require_type(Mapping, numbers, "{'camera_noise': [0.0, 5e-5]}"):
                if name not in known:
                    raise CzError(unknown_name_message(f"number of {family}", name, known))
            pairs = {name: tuple(each) if isinstance(each, list) else each for name, each in numbers.items()}
            parts[family] = FAMILIES[family](**pairs)
    return Scenario(**parts)


def _fields_of(kinds: Sequence[Any], given: Any) -> Any:
    """A record of numbers, of one of these kinds, given as a mapping of its fields; anything else as it is."""
    for kind in kinds if isinstance(given, Mapping) else ():
        if set(given) == set(kind._fields):
            return kind(**given)
    return given


def _check_modes(observation: Any, action: Any, camera: Camera | None) -> None:
    """Raise CzError for an observation or an action mode that is none, and for a camera that nothing observes."""
    if not isinstance(observation, str) or observation not in (*OBSERVATIONS, CAMERA):
        raise CzError(unknown_name_message("observation", observation, [*OBSERVATIONS, CAMERA]))
    if action not in ACTIONS:
        raise CzError(unknown_name_message("action", action, ACTIONS))
    if camera is not None and observation != CAMERA:
        raise CzError(f'a camera is of use with observation="camera" only, not with {observation!r}')


def _weights(given: Any, usual: Any) -> Any:
    """The usual weights with the given ones in their place."""
    named = (
        given._asdict() if hasattr(given, "_asdict") else dict(require_type(Mapping, given, "weights={'pull': 0.1}"))
    )
    for name, weight in named.items():
        if name not in usual._fields:
            raise CzError(unknown_name_message("weight", name, usual._fields))
        number = isinstance(weight, Real)
        if not number or not 0.0 <= weight < math.inf:
            raise CzError(f"the weight {name!r} must be a number of at least 0, not {weight!r}")
    return usual._replace(**{name: float(weight) for name, weight in named.items()})


def _hash(*numbers: float) -> str:
    """SHA-256 of numbers, to ten digits (16 hex digits)."""
    text = " ".join(f"{float(number) + 0.0:.10g}" for number in numbers)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@lru_cache(maxsize=64)
def _computed(process: Process, meniscus: MeniscusModel, parameters: Parameters) -> tuple[float, ...]:
    """Numbers that a process computes on a meniscus: constants of a puller; rates, ring, hidden load at its points."""
    numbers = list[float]()
    with np.errstate(all="ignore"):
        for lam in (0.0, 0.4, 1.0):
            p = process.derive(parameters, Factors(lam=lam), meniscus)
            numbers += [*_without_layer(p), process.hidden_load(3.0, p)]
            for x, u, d in process.check_points(p):
                numbers += [*process.rates(x, u, d, p, meniscus), *process.perfect_readings(x, p, meniscus)]
    return tuple(numbers)


def _without_layer(numbers: Any) -> list[float]:
    """The numbers of a puller; those of the boundary layer, younger than published hashes, only where there is one."""
    return [value for name, value in numbers._asdict().items() if name not in ("R", "layer") or value]


def positive_whole(name: str, value: int) -> int:
    """Return the value as an int; raise CzError unless it is a positive whole number."""
    if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
        raise CzError(f"{name} must be a positive whole number, not {value!r}")
    return int(value)


def positive(name: str, value: float) -> float:
    """Return the value as a float; raise CzError unless it is a positive, finite number of seconds."""
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value <= 0:
        raise CzError(f"{name} must be a positive number of seconds, not {value!r}")
    return float(value)
