"""Controllers by name, those of each environment; ``cz-gym list`` prints the names that commands take."""

import argparse
import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, replace
from functools import partial
from inspect import signature
from pathlib import Path
from textwrap import wrap

from cz_gym.agents import shipped, shipped_names, shipped_seeds
from cz_gym.agents.contract import OnnxPolicy, read_agent
from cz_gym.agents.residual import Base
from cz_gym.baselines import tuned_controllers as tuned
from cz_gym.baselines.clairvoyant import Clairvoyant
from cz_gym.baselines.lqg import LQG, LQGDesign, full_information, privileged
from cz_gym.baselines.pid import CompensatedPID
from cz_gym.baselines.policy import OpenLoop, Policy
from cz_gym.baselines.scaling import scale_crystal
from cz_gym.baselines.tuned import TunedController
from cz_gym.body.process import BODY
from cz_gym.config import Config, check_config, make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.episodes.scenarios import ALL, RANDOMIZED, SCENARIOS
from cz_gym.evaluation.protocol import CASES, CRYSTAL_CASES, GROUPS, Contender, unchanged, user_controller
from cz_gym.process import Process
from cz_gym.puller.file import FOLDER, PullerFile
from cz_gym.support.command_line import OneLineParser
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
        "ring-pid", partial(scale_crystal, tuned.RING_PID), "measured", "PID on the bright ring with the body's gains"
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


def make_base(name: str, config: Config) -> Base:
    """The controller of that name, or at FILE.py:NAME, for an agent to add to in an environment (its puller and control
    interval); it is the one for the scenario "randomized" whatever the scenario is. CzError if none can be added to.
    """
    design = replace(config.with_scenario(RANDOMIZED), observation="measured", action="direct")
    file, own, _ = name.rpartition(":")
    contender = user_controller(name, design) if own else find_controller(name, design.process)
    if contender.bound or contender.action != "direct" or contender.observation not in ("measured", "history"):
        raise CzError(f"{name}: an agent adds to controllers that read sensors and act directly")
    if own:
        content = Path(file).read_bytes()
    else:  # what belongs to the plant is in the agent's contract
        controller, plant = contender.make(design), signature(make_config).parameters
        names = [each.name for each in fields(controller) if each.name not in plant]
        content = repr([(each, getattr(controller, each)) for each in names]).encode()
    return Base(f"{Path(name).name} {hashlib.sha256(content).hexdigest()[:16]}", contender.make, design)


def load_agent(path: str | Path, puller: PullerFile | None = None, controllers: Sequence[str] = ()) -> OnnxPolicy:
    """An agent file, with the controller that it adds to if there is one.

    A controller of the user's own must be among those given by their places, FILE.py:NAME: no agent file has code run
    that was not named. AgentFileError or CzError says why the agent is refused.
    """
    contract, _ = read_agent(Path(path))
    name, _, _ = contract.controller.rpartition(" ")
    if not name:
        return OnnxPolicy.load(path)
    place = next((each for each in controllers if Path(each).name == name), name)
    if place not in controllers and ":" in name:
        raise CzError(f"{path}: adds to the controller {name}: name its file too, --controller FILE.py:NAME")
    config = make_config("randomized", puller=puller, control_interval=contract.control_interval)
    return OnnxPolicy.load(path, base=make_base(place, config))


def agent_hash(name: str) -> str:
    """Hash of the shipped agent file that this name loads (12 hex digits); empty for a controller."""
    return read_agent(shipped(name))[0].hash[:12] if name in shipped_names() else ""


# The names that commands take, each with the line that its registry has on it.

WIDTH = 80
"""Width of the lines [characters]."""
Section = tuple[str, list[tuple[str, str]]]
"""Heading, and names with a line each."""


def controllers() -> Iterator[Section]:
    """Classical controllers of each environment."""
    for environment, known in KNOWN.items():
        yield f"controllers of {environment}", [(each.name, each.meaning) for each in known]


def scenarios() -> Iterator[Section]:
    """Scenarios of crystals, and those that the benchmark alone knows."""
    told = dict[str, str]()
    for case in CASES:
        for name in (str(case.scenario), case.name):
            told.setdefault(name, case.meaning)
    yield (
        "scenarios",
        [(name, told[name]) for name in told if name in SCENARIOS] + [("all", f"in training: {ALL.name}")],
    )
    yield "scenarios of the benchmark alone", [(name, told[name]) for name in told if name not in SCENARIOS]


def stages() -> Iterator[Section]:
    """Parts of a whole crystal."""
    grown = [case for case in CRYSTAL_CASES if case.scenario == "randomized"]
    others = dict.fromkeys(f"-{case.scenario}" for case in CRYSTAL_CASES if case.scenario != "randomized")
    heading = f"stages of CzCrystal-v0; scenarios of its benchmark, with {', '.join(others)} too"
    yield heading, [(case.name, case.meaning) for case in grown]


def pullers() -> Iterator[Section]:
    """Shipped pullers, each with the first sentence of its file."""
    files = {path.stem: path.read_text("utf-8").splitlines() for path in sorted(FOLDER.glob("*.toml"))}
    heads = {name: " ".join(line.strip("# ") for line in lines if line[:1] == "#") for name, lines in files.items()}
    yield "pullers", [(name, head.partition(". ")[0]) for name, head in heads.items()]


def shipped_agents() -> Iterator[Section]:
    """Shipped agents of each environment."""
    for environment in KNOWN:
        lines = []
        for name in shipped_names(environment):
            seeds = shipped_seeds(name)
            contract = read_agent(seeds[0])[0]
            source = GROUPS.get(contract.learned_from, contract.learned_from)
            trained_on = "all" if contract.scenario == ALL.name else contract.scenario
            lines.append((name, f"{source}; {len(seeds)} training seeds, on {trained_on}"))
        yield f"agents of {environment}", lines


KINDS: dict[str, Callable[[], Iterator[Section]]] = {
    "controllers": controllers, "scenarios": scenarios, "stages": stages, "pullers": pullers, "agents": shipped_agents,
}  # fmt: skip
"""Lists by the word that asks for them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("cz-gym list", "List the names that commands take, with a line on each.")
    add, about = parser.add_argument, f"{', '.join(KINDS)} (all of them)"
    add("kinds", nargs="*", metavar="KIND", help=about)
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    if unknown := [kind for kind in given.kinds if kind not in KINDS]:
        raise CzError(unknown_name_message("list", unknown[0], KINDS))
    for kind in given.kinds or KINDS:
        for heading, lines in KINDS[kind]():
            column = max(len(name) for name, _ in lines) + 4
            texts = [(f"{heading}:", ""), *((f"  {name:<{column - 2}}{about}", " " * column) for name, about in lines)]
            for text, indent in texts:
                print(*wrap(text, WIDTH, subsequent_indent=indent, break_on_hyphens=False), sep="\n")
            print()
