"""The classical controllers by name."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from cz_gym.baselines import for_puller
from cz_gym.baselines.bounds import lqg as lqg_bounds
from cz_gym.baselines.bounds.clairvoyant import Clairvoyant
from cz_gym.baselines.lqg import designs
from cz_gym.baselines.lqg.designs import adaptive
from cz_gym.baselines.pid.compensated_pid import CompensatedPID
from cz_gym.config import Config, check_config
from cz_gym.errors import CzError
from cz_gym.evaluation.contender import Contender
from cz_gym.support.names import unknown

from .policy import OpenLoop, Policy


def _tuned(name: str, meaning: str, quoted: bool = False) -> Contender:
    return Contender(name, partial(for_puller.pid, name), "measured", meaning, quoted=quoted)


IN_TABLE = 0.02
"""Pull step RMS [mm/min] of the family's member that runs by default: on ``randomized`` it is about as active as the
agents, so their radius errors can be compared. On ``hard`` the agents are more active."""


def _lqg(name: str, meaning: str, default: bool = True) -> Contender:
    return Contender(name, partial(for_puller.lqg, name), "measured", meaning, default)


def _lqg_at(activity: float) -> Contender:
    meaning = f"the same LQG, tuned for the radius error with pull steps of {activity:g} mm/min at most"
    found = _lqg(designs.family_name(activity), meaning, default=activity == IN_TABLE)
    return replace(found, quoted=found.default)


def _adaptive(name: str) -> Contender:
    make = partial(for_puller.lqg, name)
    meaning = f"{name} with filters for weaker fluctuations too, weighted by how well they predict"
    default = name == designs.family_name(IN_TABLE)
    return Contender(f"{name}-adaptive", lambda config: adaptive(make(config)), "measured", meaning, default)


def _ekf_mpc(config: Config) -> Policy:
    from cz_gym.baselines.mpc import ekf_mpc

    return ekf_mpc(config)


_bound = partial(Contender, default=False, privileged=True)


def _told(name: str, config: Config, fluctuations: bool = False) -> Policy:
    return lqg_bounds.privileged(for_puller.lqg(name, config), fluctuations)


def _privileged(name: str) -> Contender:
    meaning = f"bound: {name} given the puller's parameters and how strong each crystal's fluctuations are"
    return _bound(f"{name}-privileged", partial(_told, name, fluctuations=True), "measured", meaning)


WITH_ADAPTIVE = tuple(map(designs.family_name, (0.013, IN_TABLE)))
"""LQGs with an adaptive version."""
WITH_PRIVILEGED = ("lqg-quiet", *WITH_ADAPTIVE)
"""LQGs with a privileged version."""
CONTROLLERS: tuple[Contender, ...] = (
    Contender("open-loop", lambda config: OpenLoop(), "measured", "nominal pull speed and heater power, no feedback"),
    Contender(
        "paper",
        CompensatedPID().for_config,
        "measured",
        "the paper's compensator and PID as printed, Table 1",
        quoted=True,
    ),
    Contender(
        "paper-here",
        for_puller.paper_here,
        "measured",
        "the paper's compensator and PID, designed by its procedure for this puller",
        default=False,
    ),
    Contender(
        "pid-uncompensated",
        CompensatedPID(compensator=None).for_config,
        "measured",
        "the same PID without the compensator: unstable",
    ),
    _tuned("paper-filtered", "the paper's controller with a measurement filter and anti-windup"),
    _tuned("paper-tuned", "compensator and PID re-tuned, with a slow trim of the heater", quoted=True),
    _tuned("pid-conventional", "tuned PID without compensator, crossover below half the right-half-plane zero"),
    _tuned("industrial", "incremental pull-speed law of a logged puller, with automatic growth control"),
    _lqg("lqg", "Kalman filter and LQ regulator of pull and heater, for the reward"),
    _lqg("lqg-quiet", "the same for low pull activity"),
    *(_lqg_at(activity) for activity in designs.ACTIVITIES),
    *map(_adaptive, WITH_ADAPTIVE),
    _lqg(designs.TOLD, "lqg-at-0.02 as tuned on nominal hot zones alone: it loses crystals on other ones"),
    Contender("ekf-mpc", _ekf_mpc, "measured", "nonlinear MPC on a bank of lqg's filters", default=False, slow=True),
    _bound("lqg-true", partial(_told, "lqg"), "measured", "bound: lqg given the puller's parameters"),
    *map(_privileged, WITH_PRIVILEGED),
    _bound(
        "lqg-at-0.02-told",
        partial(_told, designs.TOLD),
        "measured",
        f"bound: {designs.TOLD} given the puller's parameters",
    ),
    _bound("full-information", lqg_bounds.full_information, "state", "bound: lqg's regulator, true state seen"),
    _bound(
        "clairvoyant",
        lambda config: Clairvoyant(),
        "state",
        "bound: the optimal trajectory for a known future",
        slow=True,
    ),
)
"""Every named controller, in the order of tables."""


def find_controller(name: str) -> Contender:
    """The controller of that name; CzError lists the known ones for another."""
    for entry in CONTROLLERS:
        if entry.name == name:
            return entry
    raise CzError(unknown("controller", name, [entry.name for entry in CONTROLLERS]))


def make_controller(name: str, config: Config) -> Policy:
    """The controller of that name for an environment; CzError lists the known ones for another name."""
    made: Policy = find_controller(name).make(check_config(config))
    return made
