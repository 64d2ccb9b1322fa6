"""The puller as a co-simulation unit, FMI 2.0, which runs Python: this package must be installed where the unit runs.

A step is one control interval or several. The unit begins and ends as :class:`cz_gym.env.CzEnv` does; once its crystal
has ended, its outputs stay.
"""

import atexit
import ctypes
import hashlib
import os
import sys
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree.ElementTree import Element, SubElement

from pythonfmu import Boolean, DefaultExperiment, Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real, String
from pythonfmu.builder import FmuBuilder

from cz_gym.body.signals import Measured
from cz_gym.config import Config, make_config
from cz_gym.env import CzEnv
from cz_gym.puller.file import PullerFile, to_toml, write_puller
from cz_gym.spaces import decode
from cz_gym.support.errors import CzError
from cz_gym.support.units import KILO, MM, MM_PER_MIN

from .block import INPUTS, OUTPUTS, SETPOINT_NAMES, in_plant_units, in_shares, nominal_puller
from .trace import Port

SCRIPT = """import ctypes

from cz_gym.tools.export import fmu

ctypes.pythonapi.Py_IncRef(ctypes.py_object(globals()))  # pythonfmu 0.7 gives back one reference to it too many


class CzPuller(fmu.CzPuller):
    scenario, puller = {scenario!r}, {puller!r}
"""
"""The module in a unit, with the defaults of its parameters."""
SHOWN = tuple(port for port in INPUTS if port.name not in ("time_s", "ring_time_s", "automatic"))
"""Readings of the puller's sensors, references and applied drives."""
TRUTH = Port("crystal_radius_mm", "true radius of the crystal; no sensor shows it, so no controller may read it")
UNITS: dict[str, tuple[str, dict[str, Any]]] = {
    "_mm": ("mm", {"m": 1, "factor": MM}),
    "_mm_per_min": ("mm/min", {"m": 1, "s": -1, "factor": MM_PER_MIN}),
    "_K": ("K", {"K": 1}),
    "_kW": ("kW", {"kg": 1, "m": 2, "s": -3, "factor": KILO}),
}
"""Units by the endings of variables: the name, and exponents and factor of the SI unit."""


def end_before_python(resources: str) -> None:
    """End pythonfmu's state before the Python that runs a unit, whose folder of resources is given.

    The C library would free this state twice: first its variable, then, in its own last function, what it pointed to.
    Where a program of another language runs the unit, pythonfmu itself ends Python, and nothing is done here.
    """
    library = Path(resources).with_name("binaries") / "linux64" / f"{CzPuller.__name__}.so"
    if sys.platform == "linux" and sys.orig_argv:
        with suppress(OSError):  # it is loaded under another name
            atexit.register(ctypes.CDLL(str(library), os.RTLD_NOLOAD).finalizePythonInterpreter)


class CzPuller(Fmi2Slave):  # type: ignore[misc]
    """A puller with one crystal."""

    seed, scenario, puller, growing = 1, "puller", "", True

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        if self.resources:  # none while the unit is built
            end_before_python(self.resources)
        self.description = "Czochralski puller of cz-gym: one crystal, and what the puller's sensors show"
        beside = "puller file beside this module, name of a shipped one, or empty for the default"
        for kind, name, about in ((Integer, "seed", "which crystal"), (String, "scenario", "its disturbances"),
                                  (String, "puller", beside)):  # fmt: skip
            self._add(kind, name, about, Fmi2Causality.parameter, Fmi2Variability.fixed)
        config = self._config()
        self.default_experiment = DefaultExperiment(0.0, config.horizon, config.control_interval)
        self._begin(config)
        for port in OUTPUTS[:2]:
            self._add(Real, port.name, port.meaning, Fmi2Causality.input)
        self._started = {name: getattr(self, name) for name in SETPOINT_NAMES}
        for port in (*SHOWN, TRUTH, Port("growing", "false once the crystal has ended", 1.0, True)):
            discrete = Fmi2Variability.discrete if port.logical else None
            self._add(Boolean if port.logical else Real, port.name, port.meaning, Fmi2Causality.output, discrete)

    def _add(self, kind: Any, name: str, about: str, causality: Any, variability: Any = None) -> None:
        self.register_variable(kind(name, causality=causality, description=about, variability=variability))

    def _config(self) -> Config:
        beside = Path(self.resources or "") / self.puller
        puller = beside if self.puller and beside.is_file() else self.puller or None
        return make_config(self.scenario, observation="measured", action="direct", puller=puller)

    def _begin(self, config: Config) -> None:
        """Set all variables to the operating point of the puller."""
        puller = nominal_puller(config)
        rest = in_plant_units(Measured(*[0.0] * len(Measured._fields)), puller)
        self.__dict__.update(rest, growing=True, **{TRUTH.name: puller.r_0 / MM})
        self.__dict__.update({name: rest[applied] for name, applied in SETPOINT_NAMES.items()})

    def to_xml(self, model_options: dict[str, str] | None = None) -> Element:
        """Return the model description with what pythonfmu leaves out: units, and the unknowns of the initial state."""
        root: Element = super().to_xml(model_options or {})
        units = Element("UnitDefinitions")
        for unit, base in UNITS.values():
            SubElement(SubElement(units, "Unit", name=unit), "BaseUnit", {each: str(n) for each, n in base.items()})
        root.insert(1, units)
        for variable in root.iter("ScalarVariable"):
            name = variable.attrib["name"]
            for real in variable.iter("Real"):
                real.set("unit", next(unit for end, (unit, _) in UNITS.items() if name.endswith(end)))
        for outputs in root.findall("ModelStructure/Outputs"):
            SubElement(root[-1], "InitialUnknowns").extend(outputs)
        return root

    def exit_initialization_mode(self) -> None:
        """Begin the crystal of the parameters; setpoints that nobody has set begin at its puller's operating point."""
        config, given = self._config(), {name: getattr(self, name) for name in SETPOINT_NAMES}
        self._begin(config)
        self.__dict__.update({name: value for name, value in given.items() if value != self._started[name]})
        self.env = CzEnv.from_config(config)
        self._show(*self.env.reset(seed=self.seed))

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Grow for a whole number of control intervals with the setpoints; CzError for another step size."""
        interval = self.env.config.control_interval
        steps = round(step_size / interval)
        if steps < 1 or abs(steps * interval - step_size) > 1e-6 * interval:
            raise CzError(f"a step must be a multiple of the control interval, {interval:g} s, not {step_size:g} s")
        action = in_shares(vars(self), self.env.config)
        for _ in range(steps):
            if self.growing:
                observation, _, terminated, truncated, info = self.env.step(action.clip(-1.0, 1.0))
                self.growing = not (terminated or truncated)
                self._show(observation, info)
        return True

    def _show(self, observation: Any, info: dict[str, Any]) -> None:
        config = self.env.config
        seen = decode(observation.astype(float), *config.ranges)
        self.__dict__.update(in_plant_units(seen, nominal_puller(config)), **{TRUTH.name: info["r_c"] / MM})


def build_fmu(folder: Path, scenario: str, puller: PullerFile | None = None) -> Path:
    """Write ``CzPuller.fmu`` into the folder, with these defaults of its parameters; returns its path."""
    with TemporaryDirectory() as name:
        file = Path(name) / "puller.toml"
        if puller is not None:
            write_puller(puller, file)
        text = SCRIPT.format(scenario=scenario, puller=file.name if puller else "")
        # Python keeps one module of a name: units of one process need names of their own.
        own = hashlib.sha256((text + (to_toml(puller) if puller else "")).encode()).hexdigest()[:12]
        (script := Path(name) / f"cz_puller_{own}.py").write_text(text)
        try:
            path: Path = FmuBuilder.build_FMU(script, folder, [file] if puller else [])
        finally:
            sys.modules.pop(script.stem, None)
            sys.path[:] = [place for place in sys.path if place != name]
        return path
