"""The puller as a co-simulation unit, FMI 2.0, which runs Python: this package must be installed where the unit runs.

A step is one control interval or several. The unit begins and ends as :class:`cz_gym.env.CzEnv` does; once its crystal
has ended, its outputs stay.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pythonfmu import Boolean, DefaultExperiment, Fmi2Causality, Fmi2Slave, Fmi2Variability, Integer, Real, String
from pythonfmu.builder import FmuBuilder

from cz_gym.config import Config, make_config
from cz_gym.env import CzEnv
from cz_gym.machine.puller import PullerFile, write_puller
from cz_gym.observation import Measured, decode

from .ports import INPUTS, OUTPUTS, in_plant_units, in_shares, nominal_puller
from .program import Port

SCRIPT = """import ctypes

from cz_gym.machine.export import fmu

ctypes.pythonapi.Py_IncRef(ctypes.py_object(globals()))  # pythonfmu 0.7 gives back one reference to it too many


class CzPuller(fmu.CzPuller):
    scenario, puller = {scenario!r}, {puller!r}
"""
"""The module in a unit, with the defaults of its parameters."""
SHOWN = tuple(port for port in INPUTS if port.name not in ("time_s", "ring_time_s", "automatic"))
"""What the puller shows."""


class CzPuller(Fmi2Slave):  # type: ignore[misc]
    """A puller with one crystal."""

    seed, scenario, puller = 1, "puller", ""

    def __init__(self, **given: Any) -> None:
        super().__init__(**given)
        self.description = "Czochralski puller of cz-gym: one crystal, and what the puller's sensors show"
        beside = "puller file beside this module, name of a shipped one, or empty for the default"
        for kind, name, about in ((Integer, "seed", "which crystal"), (String, "scenario", "its disturbances"),
                                  (String, "puller", beside)):  # fmt: skip
            self._add(kind, name, about, Fmi2Causality.parameter, Fmi2Variability.fixed)
        config = self._config()
        self.default_experiment = DefaultExperiment(0.0, config.horizon, config.control_interval)
        self.__dict__.update(in_plant_units(Measured(*[0.0] * len(Measured._fields)), nominal_puller(config)))
        for port, applied in zip(OUTPUTS, ("pull_speed_mm_per_min", "heater_power_kW"), strict=False):
            setattr(self, port.name, getattr(self, applied))
            self._add(Real, port.name, port.meaning, Fmi2Causality.input)
        self.growing = True
        for port in (*SHOWN, Port("growing", "false once the crystal has ended", 1.0, True)):
            discrete = Fmi2Variability.discrete if port.logical else None
            self._add(Boolean if port.logical else Real, port.name, port.meaning, Fmi2Causality.output, discrete)

    def _add(self, kind: Any, name: str, about: str, causality: Any, variability: Any = None) -> None:
        self.register_variable(kind(name, causality=causality, description=about, variability=variability))

    def _config(self) -> Config:
        beside = Path(self.resources or "") / self.puller
        puller = beside if self.puller and beside.is_file() else self.puller or None
        return make_config(self.scenario, observation="measured", action="direct", puller=puller)

    def exit_initialization_mode(self) -> None:
        """Begin the crystal of the parameters."""
        self.env = CzEnv.from_config(self._config())
        self._show(self.env.reset(seed=self.seed)[0])

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Grow for a whole number of control intervals with the setpoints; False for another step size."""
        interval = self.env.config.control_interval
        steps = round(step_size / interval)
        if steps < 1 or abs(steps * interval - step_size) > 1e-6 * interval:
            self.log(f"a step must be a multiple of the control interval, {interval:g} s, not {step_size:g} s")
            return False
        action = in_shares(vars(self), self.env.config)
        for _ in range(steps):
            if self.growing:
                observation, _, terminated, truncated, _ = self.env.step(action.clip(-1.0, 1.0))
                self.growing = not (terminated or truncated)
                self._show(observation)
        return True

    def _show(self, observation: Any) -> None:
        config = self.env.config
        self.__dict__.update(in_plant_units(decode(observation.astype(float), *config.ranges), nominal_puller(config)))


def build_fmu(folder: Path, scenario: str, puller: PullerFile | None = None) -> Path:
    """Write ``CzPuller.fmu`` into the folder, with these defaults of its parameters; returns its path."""
    with TemporaryDirectory() as name:
        script, file = Path(name) / "cz_puller.py", Path(name) / "puller.toml"
        if puller is not None:
            write_puller(puller, file)
        script.write_text(SCRIPT.format(scenario=scenario, puller=file.name if puller else ""))
        try:
            path: Path = FmuBuilder.build_FMU(script, folder, [file] if puller else [])
        finally:
            sys.modules.pop(script.stem, None)
            sys.path[:] = [place for place in sys.path if place != name]
        return path
