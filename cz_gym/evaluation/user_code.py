"""Controllers and scenarios from the user's own Python files, by ``FILE.py:NAME``."""

import importlib.util
import inspect
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from cz_gym.config import Config
from cz_gym.episodes.scenario import Distribution, Scenario
from cz_gym.episodes.scenarios import SCENARIOS, find_distribution, find_scenario
from cz_gym.support.errors import CzError, unknown_name_message

from .protocol import Case, Contender


def load(place: str, kind: str, fits: Callable[[Any, str], bool]) -> tuple[str, Any]:
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
        return case(name).scenario if ":" in name else name

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
    """The object there."""

    @classmethod
    def of(cls, place: str) -> Self:
        """Return the maker of a place; CzError if nothing there can be one."""
        return cls(str(Path(place).absolute()), load(place, "controller", _controls)[1])

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self).of, (self.place,)

    def __call__(self, config: Config) -> Any:
        """Make the controller for an environment; a class or function gets the settings that it names."""
        if hasattr(self.source, "predict") and not inspect.isclass(self.source):
            return self.source
        given = {"config": config, "control_interval": config.control_interval}
        known = inspect.signature(self.source).parameters
        return self.source(**{name: value for name, value in given.items() if name in known})


def controller(place: str) -> Contender:
    """Return the contender at ``FILE.py:NAME``: an object with ``predict``, or a class or function that makes one.

    It is made without arguments, with ``config`` (the environment's settings) or ``control_interval`` [s], whichever it
    names. Its attributes ``observation`` and ``action`` say what it reads and what its actions mean; "measured" and
    "direct" without.
    """
    source = (maker := Maker.of(place)).source
    if not (hasattr(source, "predict") or (callable(source) and not inspect.isclass(source))):
        raise CzError(f"{place}: no controller: it has no method predict(observation, state, ...)")
    reads, acts = str(getattr(source, "observation", "measured")), str(getattr(source, "action", "direct"))
    return Contender(place.rpartition(":")[2], maker, reads, f"of {place}", action=acts, own=True)


def _controls(value: Any, module: str) -> bool:
    """Return whether a value is a controller, or a class or function of that module that makes one."""
    own = getattr(value, "__module__", "") == module
    acts = hasattr(value, "predict") and (own or not inspect.isclass(value))
    return acts or (own and inspect.isfunction(value))


def case(place: str) -> Case:
    """Return a case of the scenario at ``FILE.py:NAME``, a :class:`cz_gym.Scenario`, or of a log's series, FILE.csv."""
    if place.endswith(".csv"):
        scenario = find_scenario(place)
        return Case(scenario.name, scenario, f"of {place}", default=False, file=place)
    _, scenario = load(place, "scenario", lambda value, _: isinstance(value, Scenario) and value.name not in SCENARIOS)
    if not isinstance(scenario, Scenario):
        raise CzError(f"{place}: no scenario: a {type(scenario).__name__}, not a cz_gym.Scenario")
    return Case(scenario.name, scenario, f"of {place}", default=False, file=place)


def check_apart(names: Sequence[str], kind: str) -> None:
    """Raise CzError for a name that appears twice."""
    for name in names:
        if names.count(name) > 1:
            raise CzError(f"two {kind}s are called {name!r}: rename yours")
