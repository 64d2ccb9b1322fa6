"""The classical controllers by name."""

from functools import partial

from cz_gym.baselines.bounds.clairvoyant import Clairvoyant
from cz_gym.baselines.bounds.lqg import full_information, privileged
from cz_gym.baselines.pid.compensated_pid import CompensatedPID
from cz_gym.baselines.tuning.lqg import BEST_RETURN, FILTER, LQGS, TunedLQG, adaptive
from cz_gym.baselines.tuning.pid import PIDS, paper_here
from cz_gym.config import Config, check_config
from cz_gym.errors import CzError
from cz_gym.evaluation.contender import Contender
from cz_gym.support.names import unknown

from .policy import OpenLoop, Policy


def _open_loop(config: Config) -> Policy:
    return OpenLoop()


def _adaptive(plain: TunedLQG, config: Config) -> Policy:
    return adaptive(plain.make(config))


def _privileged(plain: TunedLQG, knows_fluctuations: bool, config: Config) -> Policy:
    return privileged(plain.make(config), knows_fluctuations)


def _full_information(config: Config) -> Policy:
    return full_information(BEST_RETURN.design(config.sole_scenario), config)


def _clairvoyant(config: Config) -> Clairvoyant:
    return Clairvoyant()


def _ekf_mpc(config: Config) -> Policy:
    from cz_gym.baselines.mpc import ekf_mpc

    return ekf_mpc(BEST_RETURN.design(config.sole_scenario), config)


_measured = partial(Contender, observation="measured")
_bound = partial(Contender, default=False, privileged=True)
_QUIET, _CALM, _IN_TABLE = (each for each in LQGS if each.name in ("lqg-quiet", "lqg-at-0.013", FILTER))
CONTROLLERS: tuple[Contender, ...] = (
    _measured("open-loop", _open_loop, meaning="nominal pull speed and heater power, no feedback"),
    _measured(
        "paper",
        CompensatedPID().for_config,
        meaning="the paper's compensator and PID as printed, Table 1",
        quoted=True,
        on_puller=True,
    ),
    _measured(
        "paper-here",
        paper_here,
        meaning="the paper's compensator and PID, designed by its procedure for this puller",
        default=False,
        on_puller=True,
    ),
    _measured(
        "pid-uncompensated",
        CompensatedPID(compensator=None).for_config,
        meaning="the same PID without the compensator: unstable",
    ),
    *(each.contender for each in (*PIDS, *LQGS)),
    *(
        _measured(
            f"{each.name}-adaptive",
            partial(_adaptive, each),
            meaning=f"{each.name} with filters for weaker fluctuations too, weighted by how well they predict",
            default=each.default,
        )
        for each in (_CALM, _IN_TABLE)
    ),
    _measured("ekf-mpc", _ekf_mpc, meaning="nonlinear MPC on a bank of lqg's filters", default=False, slow=True),
    _bound(
        "lqg-true",
        partial(_privileged, BEST_RETURN, False),
        "measured",
        "bound: lqg given the puller's parameters",
    ),
    *(
        _bound(
            f"{each.name}-privileged",
            partial(_privileged, each, True),
            "measured",
            f"bound: {each.name} given the puller's parameters and how strong each crystal's fluctuations are",
        )
        for each in (_QUIET, _CALM, _IN_TABLE)
    ),
    _bound("full-information", _full_information, "state", "bound: lqg's regulator, true state seen"),
    _bound("clairvoyant", _clairvoyant, "state", "bound: the optimal trajectory for a known future", slow=True),
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
    controller: Policy = find_controller(name).make(check_config(config))
    return controller
