"""Controllers by name: the classical ones of each environment, and those that tools choose by themselves."""

from collections.abc import Callable
from functools import partial

from cz_gym.baselines import tuned_controllers as tuned
from cz_gym.baselines.clairvoyant import Clairvoyant
from cz_gym.baselines.lqg import LQG, LQGDesign, full_information, privileged
from cz_gym.baselines.pid import CompensatedPID
from cz_gym.baselines.policy import OpenLoop, Policy
from cz_gym.baselines.scaling import scale_crystal
from cz_gym.baselines.tuned import TunedController
from cz_gym.body.process import BODY
from cz_gym.config import Config, check_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.evaluation.protocol import Contender, unchanged
from cz_gym.process import Process
from cz_gym.support.errors import CzError, unknown_name_message


def _changed(change: Callable[[LQG], Policy], record: TunedController, config: Config) -> Policy:
    return change(record.make(config))


def _designed(make: Callable[[LQGDesign, Config], Policy], config: Config) -> Policy:
    return make(tuned.BEST_RETURN.settings(config.sole_scenario), config)


_measured = partial(Contender, observation="measured")
_bound = partial(Contender, default=False, privileged=True)
_QUIET, _CALM, _IN_TABLE = (each for each in tuned.LQGS if each.name in ("lqg-quiet", "lqg-at-0.013", tuned.FILTER))
CONTROLLERS: tuple[Contender, ...] = (
    _measured("open-loop", partial(unchanged, OpenLoop()), meaning="nominal pull speed and heater power, no feedback"),
    _measured(
        "paper",
        CompensatedPID().for_config,
        meaning="the paper's compensator and PID as printed, Table 1",
        quoted=True,
        on_puller=True,
    ),
    _measured(
        "paper-here",
        tuned.paper_here,
        meaning="the paper's compensator and PID, designed by its procedure for this puller",
        default=False,
        on_puller=True,
    ),
    _measured(
        "pid-uncompensated",
        CompensatedPID(compensator=None).for_config,
        meaning="the same PID without the compensator: unstable",
    ),
    *(each.contender for each in (*tuned.PIDS, *tuned.LQGS)),
    *(
        _measured(
            f"{each.name}-adaptive",
            partial(_changed, tuned.adaptive, each),
            meaning=f"{each.name} with filters for weaker fluctuations too, weighted by how well they predict",
            default=each.default,
            told=True,
        )
        for each in (_CALM, _IN_TABLE)
    ),
    _bound(
        "lqg-true",
        partial(_changed, partial(privileged, knows_fluctuations=False), tuned.BEST_RETURN),
        "measured",
        "bound: lqg given the puller's parameters",
    ),
    *(
        _bound(
            f"{each.name}-privileged",
            partial(_changed, privileged, each),
            "measured",
            f"bound: {each.name} given the puller's parameters and how strong each crystal's fluctuations are",
        )
        for each in (_QUIET, _CALM, _IN_TABLE)
    ),
    _bound(
        "full-information", partial(_designed, full_information), "state", "bound: lqg's regulator, true state seen"
    ),
    _bound(
        "clairvoyant",
        partial(unchanged, Clairvoyant()),
        "state",
        "bound: the optimal trajectory for a known future",
        slow=True,
    ),
)
"""Every named controller of ``Cz-v0``, in the order of tables."""
CRYSTAL_CONTROLLERS: tuple[Contender, ...] = (
    Contender("recipe", partial(unchanged, OpenLoop()), "measured", "the recipe's pull speed and power, no feedback"),
    Contender(
        "ring-pid",
        partial(scale_crystal, tuned.RING_PID),
        "measured",
        "PID on the bright ring with the body's gains",
    ),
    *(each.contender for each in tuned.CRYSTALS),
    Contender(
        "true-radius",
        partial(scale_crystal, tuned.TRUE_PID),
        "state",
        "bound: the PID on the true radius, which no sensor shows",
        privileged=True,
        on_puller=True,
    ),
)
"""Every named controller of ``CzCrystal-v0``, in the order of tables."""


KNOWN = {BODY.name: CONTROLLERS, CRYSTAL.name: CRYSTAL_CONTROLLERS}
"""Controllers by environment."""


def find_controller(name: str, process: Process = BODY) -> Contender:
    """The controller of that name for a process; CzError lists the known ones for another name."""
    known = KNOWN.get(process.name, CONTROLLERS)
    for entry in known:
        if entry.name == name:
            return entry
    raise CzError(unknown_name_message("controller", name, [entry.name for entry in known]))


def make_controller(name: str, config: Config) -> Policy:
    """The controller of that name for an environment; CzError lists the known ones for another name."""
    controller: Policy = find_controller(name, check_config(config).process).make(config)
    return controller
