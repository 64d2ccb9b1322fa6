"""The classical controllers by name: what the benchmark can run without a trained agent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from cz_gym.baselines.bounds import lqg as lqg_bounds
from cz_gym.baselines.bounds.clairvoyant import Clairvoyant
from cz_gym.baselines.lqg import settings as lqg_settings
from cz_gym.baselines.lqg.adaptive import adaptive
from cz_gym.baselines.pid.compensated_pid import CompensatedPID
from cz_gym.baselines.pid.open_loop import OpenLoop
from cz_gym.baselines.pid.settings import tuned
from cz_gym.config import Config, check_config
from cz_gym.errors import CzError
from cz_gym.names import unknown

from .policy import Policy


@dataclass(frozen=True)
class Entry:
    """A controller that can be asked for by name."""

    name: str
    make: Callable[[Config], Policy]
    """Builds the controller for an environment's settings."""
    observation: str
    """Observation mode it reads: "measured" or "history"; "state" marks a bound, which no sensor could feed."""
    meaning: str
    """One line for people."""
    default: bool = True
    """Whether a benchmark that names no controllers runs it."""
    privileged: bool = False
    """Whether it knows what no controller can know, which makes it a bound."""
    slow: bool = False
    """Whether it runs only when slow controllers are asked for, on the first few episodes."""

    def __post_init__(self) -> None:
        make = self.make
        object.__setattr__(self, "make", lambda config: make(check_config(config)))


def _paper(config: Config) -> Policy:
    return CompensatedPID(config.control_interval, v_0=config.parameters.v_0)


def _pid_uncompensated(config: Config) -> Policy:
    return CompensatedPID(config.control_interval, compensator=None, v_0=config.parameters.v_0)


def _tuned(name: str, meaning: str) -> Entry:
    return Entry(name, lambda config: tuned(name, config), "measured", meaning)


IN_TABLE = 0.02
"""Pull step RMS [mm/min] of the family's member that runs by default: a table of radius errors is fair only if an LQG
about as active as the agents stands in it. So it is on ``randomized``; on ``hard`` they move more."""


def _lqg(name: str, meaning: str, default: bool = True) -> Entry:
    return Entry(name, partial(lqg_settings.lqg, name), "measured", meaning, default)


def _lqg_at(activity: float) -> Entry:
    meaning = f"the same LQG, tuned for the radius error with pull steps of {activity:g} mm/min at most"
    return _lqg(lqg_settings.family_name(activity), meaning, default=activity == IN_TABLE)


def _adaptive(name: str) -> Entry:
    make = partial(lqg_settings.lqg, name)
    meaning = f"{name} with filters for weak to strong fluctuations, weighed by how well they predict"
    return Entry(f"{name}-adaptive", lambda config: adaptive(make(config)), "measured", meaning, default=False)


def _ekf_mpc(config: Config) -> Policy:
    from cz_gym.baselines.mpc.controller import ekf_mpc

    return ekf_mpc(config)


_bound = partial(Entry, default=False, privileged=True)


def _privileged(name: str) -> Entry:
    make = partial(lqg_settings.lqg, name)
    meaning = f"bound: {name} given the puller's parameters and how strong each crystal's fluctuations are"
    return _bound(f"{name}-privileged", lambda config: lqg_bounds.privileged(make(config)), "measured", meaning)


_TOLD = "lqg-quiet", *map(lqg_settings.family_name, (0.013, IN_TABLE))
"""LQGs that there are privileged ones of; but for the first, adaptive ones too."""
CONTROLLERS: tuple[Entry, ...] = (
    Entry("open-loop", lambda config: OpenLoop(), "measured", "nominal pull speed and heater power, no feedback"),
    Entry("paper", _paper, "measured", "the paper's compensator and PID as printed, Table 1"),
    Entry("pid-uncompensated", _pid_uncompensated, "measured", "the same PID without the compensator: unstable"),
    _tuned("paper-filtered", "the paper's controller with a measurement filter and anti-windup"),
    _tuned("paper-tuned", "compensator and PID re-tuned, with a slow trim of the heater"),
    _tuned("pid-conventional", "tuned PID without compensator, crossover below half the right-half-plane zero"),
    _tuned("industrial", "incremental pull-speed law of a logged puller, with automatic growth control"),
    _lqg("lqg", "Kalman filter and LQ regulator of pull and heater, for the reward"),
    _lqg("lqg-quiet", "the same for low pull activity"),
    *(_lqg_at(activity) for activity in lqg_settings.ACTIVITIES),
    *map(_adaptive, _TOLD[1:]),
    Entry("ekf-mpc", _ekf_mpc, "measured", "nonlinear MPC on a bank of lqg's filters", default=False, slow=True),
    _bound("lqg-true", lqg_bounds.lqg_true, "measured", "bound: lqg given the puller's parameters"),
    *map(_privileged, _TOLD),
    _bound("full-information", lqg_bounds.full_information, "state", "bound: lqg's regulator, true state seen"),
    _bound(
        "clairvoyant",
        lambda config: Clairvoyant(),
        "state",
        "bound: the best trajectory for the whole future known",
        slow=True,
    ),
)
"""Every named controller, in the order of tables."""


def find_controller(name: str) -> Entry:
    """The controller of that name; ValueError names what there is."""
    for entry in CONTROLLERS:
        if entry.name == name:
            return entry
    raise CzError(unknown("controller", name, [entry.name for entry in CONTROLLERS]))


def make_controller(name: str, config: Config) -> Policy:
    """The controller of that name for an environment's settings; ValueError names what there is."""
    return find_controller(name).make(config)
