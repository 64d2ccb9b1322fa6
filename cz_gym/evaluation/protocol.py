"""Protocol of the benchmark: its contenders, scenarios and seeds, and the user's own by ``FILE.py:NAME``."""

import importlib.util
import inspect
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

from cz_gym.body.process import BODY
from cz_gym.config import Config, make_config
from cz_gym.crystal.plant import STAGES
from cz_gym.crystal.process import CRYSTAL
from cz_gym.episodes.scenario import Distribution, Scenario
from cz_gym.episodes.scenarios import ALIASES, SCENARIOS, find_distribution, find_scenario
from cz_gym.physics.meniscus import HURLE, MeniscusModel
from cz_gym.physics.young_laplace import YOUNG_LAPLACE
from cz_gym.process import Process
from cz_gym.puller.file import DEFAULT, PullerFile
from cz_gym.support.errors import CzError, unknown_name_message
from cz_gym.support.units import MM, MM_PER_MIN

from .rollout import check_policy, settings_of

REWARD, STATE, PLANT = "reward", "state", "plant"
"""Sources that an agent learned from: the reward alone; the reward, and the true state, told in training; gradients
through the plant's equations."""
GROUPS = {
    REWARD: "learned from the reward",
    STATE: "learned from the reward, state told in training",
    PLANT: "learned, plant known in training",
}
"""Table headings of agents by source, the least information first."""


REFERENCE = "paper"
"""Controller that paired differences are taken against."""
BOUND = "clairvoyant"
"""Controller that optimality gaps are measured from."""


@dataclass(frozen=True)
class Contender:
    """A controller or an agent that can be asked for by name."""

    name: str
    make: Callable[[Config], Any]
    """Builds the policy for an environment's settings, of an agent that of the first training seed; it must pickle."""
    observation: str
    """Observation mode it reads; "state" marks a bound, which no sensor could feed."""
    meaning: str
    """Description in one line, for tables."""
    default: bool = True
    """True if a benchmark that names no controllers runs it."""
    privileged: bool = False
    """True if it knows the puller, the state or the future, which no controller can; that makes it a bound."""
    slow: bool = False
    """True if it meets only the first few episodes, which are cached, and runs only when slow ones are asked for."""
    on_puller: bool = False
    """True if a benchmark on a puller of the user's own that names no controllers runs it."""
    quoted: bool = False
    """True if it stands in short tables and small figures, and beside a controller of the user's own."""
    action: str = "direct"
    """Mode of its actions (:func:`cz_gym.spaces.drives_of`)."""
    told: bool = False
    """True if it has settings for each scenario, and is told which one it meets."""
    own: bool = False
    """True if it comes from the user's own file: figures show it first."""
    training_seeds: tuple[int, ...] = ()
    """Training seeds of an agent, empty for a controller."""
    trained: tuple[Any, ...] = ()
    """Policies of an agent, one a training seed."""

    @property
    def learned(self) -> bool:
        """True if it was trained."""
        return bool(self.training_seeds)

    @property
    def bound(self) -> bool:
        """True for a bound on controllers, which knows or reads something that no sensor shows."""
        return self.privileged or self.observation == "state"

    @property
    def knows(self) -> str:
        """Heading of the contender's group in tables, by its knowledge of the plant."""
        if self.bound:
            return "bounds, told what no sensor shows"
        if not self.learned:
            return "classical"
        sources = {policy.contract.learned_from for policy in self.trained}
        return next((group for source, group in reversed(GROUPS.items()) if source in sources), GROUPS[REWARD])

    def policies(self, config: Config) -> tuple[Any, ...]:
        """Return the policy for an environment's settings; of an agent one a training seed."""
        return self.trained or (self.make(config),)


def agent(name: str, policies: Sequence[Any], own: bool = False) -> Contender:
    """Make the contender of an agent, the user's ``own`` if given as a file, from its policies, one a training seed.

    Raises CzError if the policies are not training seeds of one agent.
    """
    contracts = [policy.contract for policy in policies]
    seeds = tuple(contract.training_seed for contract in contracts)
    if len(set(seeds)) < len(seeds):
        raise CzError(f"agent {name!r}: a training seed appears twice among {', '.join(map(str, seeds))}")
    if len({(contract.observation, contract.action) for contract in contracts}) > 1:
        raise CzError(f"agent {name!r}: its training seeds read different observations, or act differently")
    if len({contract.scenario_hash for contract in contracts}) > 1:
        trained = ", ".join(sorted({contract.scenario for contract in contracts}))
        raise CzError(f"agent {name!r}: its training seeds were trained on different scenarios: {trained}")
    one = contracts[0]
    meaning = f"agent trained with {one.algorithm} on {one.scenario}{', given as a file' if own else ''}"
    return Contender(
        name, partial(unchanged, policies[0]), one.observation, meaning,
        action=one.action, own=own, training_seeds=seeds, trained=tuple(policies),
    )  # fmt: skip


def unchanged(policy: Any, config: Config) -> Any:
    """Return the policy, whatever the environment is."""
    return policy


# The benchmark's protocol: its scenarios, their episodes and settings.

TRAINING_SEEDS = range(1_000_000)
"""Seeds of the episodes that controllers are tuned and agents are trained on."""
VALIDATION_SEEDS = range(1_000_000, 1_000_500)
"""Seeds of the episodes that selection and early stopping use."""
TEST_SEEDS = range(2_000_000, 2_000_500)
"""Seeds of the test episodes; nothing is tuned, selected or stopped on them."""

SLOW_EPISODES = 50
"""Number of test episodes that a slow controller meets: the first ones."""


@dataclass(frozen=True)
class Case:
    """A scenario with the settings that the benchmark runs it with."""

    name: str
    scenario: str | Scenario
    meaning: str
    """Disturbances of its crystals in one line, for tables."""
    model: str | None = None
    """ "I" or "II", or None for the scenario's own draw."""
    default: bool = True
    """True if a benchmark that names no scenarios runs it."""
    interval: float | None = None
    """Time between actions [s]; None: the puller's."""
    meniscus: MeniscusModel = HURLE
    """Meniscus of the plant; controllers and agents are made for Hurle's, whatever it is."""
    file: str = ""
    """Source of a scenario of the user's own: FILE.py:NAME."""
    puller: PullerFile = DEFAULT
    tolerance: float | None = None
    """Largest radius error that is no scrap [m]: with it, the report is one for a grower."""
    first_seed: int = TEST_SEEDS.start
    """Seed of its first crystal."""
    process: Process = BODY
    """Process that is simulated."""
    stage: Any = None
    """Part of the crystal that is grown, where the process has stages."""
    most: int = len(TEST_SEEDS)
    """Largest number of its crystals."""

    @property
    def control_interval(self) -> float:
        """Time between actions [s]."""
        return self.puller.control_interval if self.interval is None else self.interval

    def config(self, observation: str = "measured", action: str = "direct") -> Config:
        """Return the environment's settings: three hours of this case's scenario, model, interval and meniscus."""
        return replace(self.design_config(observation, action), meniscus=self.meniscus)

    def design_config(self, observation: str = "measured", action: str = "direct") -> Config:
        """Return the settings that a controller is designed for: the same on Hurle's meniscus."""
        interval, puller = self.control_interval, self.puller
        return make_config(
            self.scenario, self.model, observation, interval, action=action, puller=puller, process=self.process,
            stage=self.stage,
        )  # fmt: skip

    @property
    def grown_on(self) -> str:
        """The puller that the crystals grow on, for people: its name, radius, nominal pull speed and plant hash."""
        config = self.config()
        name = "the default puller" if self.puller.label == DEFAULT.label else f"puller {self.puller.label}"
        r_0, v_0 = config.parameters.r_0 / MM, config.parameters.v_0 / MM_PER_MIN
        return f"{name}: radius {r_0:g} mm, pull speed {v_0:g} mm/min, plant {config.plant_hash}"

    @property
    def deterministic(self) -> bool:
        """True if all crystals are the same."""
        return find_scenario(self.scenario).deterministic

    def seeds(self, episodes: int) -> range:
        """Return the seeds of the first ``episodes`` crystals, of one if the scenario is deterministic."""
        number = 1 if self.deterministic else min(episodes, self.most)
        return range(self.first_seed, self.first_seed + number)


_RAMP = (
    "the recipe's temperature rises by 5 K; a drive that ignores the recipe, as open-loop does, meets no disturbance"
)
_FALL = "the radius reference falls by {} mm within 30 min; nothing else happens"

CASES: tuple[Case, ...] = (
    Case(
        "randomized",
        "randomized",
        "unlike pullers, recipe errors, drift, fluctuations, noise: the training distribution",
    ),
    Case("hard", "hard", "the same families, half as wide again or more"),
    Case("sensor-fault", "sensor-fault", "randomized with frozen frames, drop-outs and a drifting ring"),
    Case("puller", "puller", "randomized with latency, outliers, wrong bias, erring readings and slow, narrow drives"),
    Case("hot-zone", "hot-zone", "randomized on hot zones that differ from the design values by up to a factor of two"),
    Case("paper-ramp-I", "paper-ramp", _RAMP, "I"),
    Case("paper-ramp-II", "paper-ramp", _RAMP, "II"),
    Case("reference-a", "reference-a", _FALL.format(2.5), "I"),
    Case("reference-b", "reference-b", _FALL.format(0.5), "I"),
    Case("nominal", "nominal", "nothing happens", "I", default=False),
    *(
        Case(f"only-{name}", f"only-{name}", f"{what} alone, as wide as in randomized", default=False)
        for name, what in (
            ("recipe", "errors of the recipe"),
            ("drift", "drift of the hot zone"),
            ("interface", "interface fluctuations"),
            ("sensor", "sensor noise"),
            ("reference", "changes of the reference"),
            ("parameters", "unlike pullers"),
        )
    ),
    Case("randomized-I", "randomized", "randomized, every puller conducting only: Model I", "I", default=False),
    Case("randomized-II", "randomized", "randomized, every puller convecting only: Model II", "II", default=False),
    Case("puller-frames", "puller-frames", "puller with a ring read from single, aliased frames", default=False),
    Case("melt-layer", "melt-layer", "randomized over a boundary layer that no controller knows of", default=False),
    Case("randomized-traced", "randomized-traced", "randomized, its ring the edge that rays show", default=False),
    Case("randomized-2s", "randomized", "randomized, an action every 2 s", default=False, interval=2.0),
    Case("randomized-10s", "randomized", "randomized, an action every 10 s", default=False, interval=10.0),
    Case(
        "randomized-exact",
        "randomized",
        "randomized on the exact Young-Laplace meniscus, which no controller knows of",
        default=False,
        meniscus=YOUNG_LAPLACE,
    ),
)
"""Every case, in the order of tables; families of disturbances alone and variants of randomized run when asked for."""
RANDOM_CASES = tuple(case for case in CASES if case.default and not case.deterministic)
"""Cases of several crystals that run unasked."""

_GROWN = {
    "crown": "from the neck to 60 mm of body",
    "body": "three hours from a drawn length of the body on",
    "tail": "from 50 mm before the tail to its end",
    "whole": "from the neck to the tail's end",
}
CRYSTAL_CASES: tuple[Case, ...] = tuple(
    Case(
        stage if scenario == "randomized" else f"{stage}-{scenario}",
        scenario,
        f"{_GROWN[stage]}, {scenario}",
        default=scenario == "randomized" and stage != "whole",
        process=CRYSTAL,
        stage=stage,
        most=SLOW_EPISODES if stage == "whole" else len(TEST_SEEDS),
    )
    for scenario in ("randomized", "hard", "sensor-fault", "puller", "hot-zone", "nominal")
    for stage in STAGES
)
"""Every case of ``CzCrystal-v0``: a stage under a scenario's disturbances; on randomized it has the stage's name."""


def find_case(name: str, cases: Sequence[Case] = CASES) -> Case:
    """Return the case of that name; CzError names those that exist."""
    for case in cases:
        if case.name == ALIASES.get(name, name):
            return case
    raise CzError(unknown_name_message("scenario", name, [case.name for case in cases]))


def find_cases(name: str, cases: Sequence[Case] = CASES) -> list[Case]:
    """Return the case of that name, or all those of the scenario of that name; CzError names the cases that exist."""
    known, alike = {case.name for case in cases}, [case for case in cases if case.scenario == name]
    return alike if alike and name not in known else [find_case(name, cases)]


def load_user_object(place: str, kind: str, fits: Callable[[Any, str], bool]) -> tuple[str, Any]:
    """Return the name and the object at ``FILE.py:NAME``; CzError says why there is none. Bugs of the file are raised.

    ``fits`` says of an object and the module's name whether the file may offer it as one of that ``kind``.
    """
    file, colon, name = place.rpartition(":")
    path = Path(file)
    if not colon or path.suffix != ".py" or not name.isidentifier():
        raise CzError(f"must be FILE.py:NAME, not {place!r:.80}")
    if not path.is_file():
        raise CzError(f"{path}: no such file")
    module_name = f"cz_gym_user_{path.stem}"
    spec: Any = importlib.util.spec_from_file_location(module_name, path)
    # Dataclasses look their module up.
    module = sys.modules[module_name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if not hasattr(module, name):
        offered = [each for each, value in vars(module).items() if each[0] != "_" and fits(value, module_name)]
        raise CzError(f"{path}: {unknown_name_message(kind, name, offered)}")
    return name, getattr(module, name)


def scenarios(text: str) -> Distribution:
    """Return the scenario or mixture that a text names; CzError if there is none.

    It is a scenario's name, "all", ``FILE.py:NAME``, or several scenarios with their shares: "randomized=0.6,hard=0.4".
    """

    def one(name: str) -> Any:
        return user_case(name).scenario if ":" in name else name

    if "=" not in text:
        return find_distribution(one(text))
    shares = {}
    for part in text.split(","):
        name, _, share = part.rpartition("=")
        try:
            number = float(share)
        except ValueError:
            raise CzError(f"{part!r} in {text!r:.80} is no scenario with its share, such as hard=0.4") from None
        shares[one(name)] = number
    return find_distribution(shares)


@dataclass(frozen=True)
class Maker:
    """The controllers of ``FILE.py:NAME``; another process reads the file again."""

    place: str
    source: Any
    """Controller at the place, or a class or function that makes one."""

    @classmethod
    def of(cls, place: str) -> Self:
        """Return the maker of a place; CzError if nothing there can be one."""
        return cls(str(Path(place).absolute()), load_user_object(place, "controller", _controls)[1])

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).of, (self.place,)

    def __call__(self, config: Config) -> Any:
        """Make the controller for an environment; a class or function gets the settings that it names."""
        if hasattr(self.source, "predict") and not inspect.isclass(self.source):
            return self.source
        given = {"config": config, "control_interval": config.control_interval}
        known = inspect.signature(self.source).parameters
        return self.source(**{name: value for name, value in given.items() if name in known})


def user_controller(place: str, config: Config | None = None) -> Contender:
    """Return the contender at ``FILE.py:NAME``: an object with ``predict``, or a class or function that makes one.

    It is made without arguments, with ``config`` (the environment's settings) or ``control_interval`` [s], whichever it
    names. Once made, here for ``config``, its settings say what it reads and what its actions mean
    (:func:`cz_gym.evaluation.rollout.settings_of`); "measured" and "direct" without.
    """
    source = (maker := Maker.of(place)).source
    if not (hasattr(source, "predict") or (callable(source) and not inspect.isclass(source))):
        raise CzError(f"{place}: no controller: it has no method predict(observation, state, ...)")
    usual = config or make_config(observation="measured", action="direct")
    made = maker(usual)
    if not (hasattr(made, "predict") or hasattr(made, "for_episodes")):
        raise CzError(f"{place}: no controller: it makes a {type(made).__name__}, which has no method predict")
    settings = {"observation": "measured", "action": "direct"} | settings_of(made)
    fitting = replace(usual, observation=settings["observation"], action=settings["action"])
    try:
        check_policy(maker(fitting), fitting)
    except CzError as error:
        raise CzError(f"{place}: {error}") from None
    reads, acts = settings["observation"], settings["action"]
    return Contender(place.rpartition(":")[2], maker, reads, f"of {place}", action=acts, own=True)


def _controls(value: Any, module: str) -> bool:
    """Return whether a value is a controller, or a class or function of that module that makes one."""
    own = getattr(value, "__module__", "") == module
    acts = hasattr(value, "predict") and (own or not inspect.isclass(value))
    return acts or (own and inspect.isfunction(value))


def user_case(place: str) -> Case:
    """Return a case of the scenario at ``FILE.py:NAME``, a :class:`cz_gym.Scenario`, or of a log's series, FILE.csv."""
    if place.endswith(".csv"):
        scenario = find_scenario(place)
        return Case(scenario.name, scenario, f"of {place}", default=False, file=place)
    _, scenario = load_user_object(
        place, "scenario", lambda value, _: isinstance(value, Scenario) and value.name not in SCENARIOS
    )
    if not isinstance(scenario, Scenario):
        raise CzError(f"{place}: no scenario: a {type(scenario).__name__}, not a cz_gym.Scenario")
    return Case(scenario.name, scenario, f"of {place}", default=False, file=place)


def check_apart(names: Sequence[str], kind: str) -> None:
    """Raise CzError for a name that appears twice."""
    for name in names:
        if names.count(name) > 1:
            raise CzError(f"two {kind}s are called {name!r}: rename yours")
