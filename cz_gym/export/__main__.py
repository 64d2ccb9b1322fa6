"""Write a controller for a plant: ``python -m cz_gym.export CONTROLLER --to c|st --out DIR``."""

from __future__ import annotations

import argparse
import pkgutil
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cz_gym.atomic_files import write_files
from cz_gym.commands import OneLineParser, shown
from cz_gym.config import Config, make_config
from cz_gym.errors import CzError
from cz_gym.names import unknown
from cz_gym.observation import CLIP
from cz_gym.units import KILO, MM_PER_MIN

from .agent import Agent
from .program import Program
from .shell import Alarm, shelled
from .text import meanings, write_c, write_st

REGISTRY, AGENTS = "cz_gym.baselines.registry", "cz_gym.agents"
"""Modules that know controllers and agents, looked up by name because this package imports neither."""
FALLBACK = "paper-tuned"
"""The PID that takes over."""
WRITERS = {"c": write_c, "st": write_st}
"""Writers by the name of their language."""
README = """# {name}: a controller for Czochralski growth

{about}

| file | what it is |
|---|---|
{files}

The block is called with the readings and returns setpoints and alarms. It takes a sample when {interval:g} s have
passed since the last one and answers with the same setpoints in between, so it may stand in a faster task. Everything
is in the units of the names: mm, mm/min, kW, K, s.

## Inputs

| name | meaning |
|---|---|
{inputs}

A reading counts if it is finite and within the range that the controller knows: the ring within 10 mm of its reference
and radii within 10 mm of nominal, temperatures within 50 K of nominal, drives within {pull:g} mm/min and {heater:g} kW
of nominal. The last good reading stands in for one that does not.

## Settings and their defaults

| name | meaning |
|---|---|
{settings}

Write in the nominal values of your own puller, and limits that it can bear.

## Alarms

| bit | name | meaning |
|---|---|---|
{alarms}

## Before it meets a puller

- **No controller or agent of this project was tested on a real puller.** All figures come from a simulation whose
  numbers are traced to the literature.
- Radius control by pull speed and heater power is the subject of patents, US 9,340,897 among them: check them before
  industrial use.
- Compile without options that drop NaN and infinity (`-ffast-math`): the checks of the readings need them.
- Limits, interlocks and an emergency stop that do not depend on this block belong to the plant.
- First run it beside the present controller with `automatic` not set, and read its alarms.
"""


class Chosen(NamedTuple):
    """A controller to be exported."""

    name: str
    controller: Any
    config: Config
    notes: tuple[str, ...]


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the files; 0 when done, 2 for bad input."""
    parser = OneLineParser(
        "python -m cz_gym.export", "Write a controller, with what a plant needs around it, as C99 or structured text."
    )
    add = parser.add_argument
    add("controller", help="a classical controller, a shipped agent, or an agent file (.onnx)")
    add("--to", choices=sorted(WRITERS), required=True, help="c: C99; st: IEC 61131-3 structured text")
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    parser.add_puller("its nominal values, its drives' limits, what is designed for it")
    add("--scenario", default="puller", metavar="NAME", help="scenario whose tuned settings it has (%(default)s)")
    add("--real", choices=("double", "float"), default="double", help="precision of the numbers (%(default)s)")
    return parser.run(_export, arguments, "benchmark")


def _export(given: argparse.Namespace) -> None:
    config = make_config(given.scenario, observation="measured", action="direct", puller=given.puller)
    program = export_program(given.controller, config)
    if given.real == "float" and program.needs_double:
        raise CzError(f"{given.controller}: its filter works on temperatures in kelvin and needs --real double")
    texts = WRITERS[given.to](program, given.real == "float")
    texts["README.md"] = readme(program, config, list(texts))
    write_files({given.out / name: text.encode() for name, text in texts.items()})
    for name in texts:
        print(shown(given.out / name))


def export_program(name: str, config: Config) -> Program:
    """The program of a controller or agent in its shell; its fallback is the re-tuned PID of the same settings."""
    chosen = choose(name, config)
    pid = pkgutil.resolve_name(f"{REGISTRY}:make_controller")(FALLBACK, config)
    return shelled(chosen.name, chosen.controller, pid, chosen.config, chosen.notes)


def choose(name: str, config: Config) -> Chosen:
    """The controller of that name, with the facts for the header."""
    agents: Any = pkgutil.resolve_name(AGENTS)
    known = [entry.name for entry in pkgutil.resolve_name(f"{REGISTRY}:CONTROLLERS") if not entry.bound]
    plant = f"Puller {config.puller.label}; plant {config.plant_hash}; control interval {config.control_interval:g} s."
    identifier = re.sub(r"\W+", "_", Path(name).stem.lower())
    if name in known:
        entry = pkgutil.resolve_name(f"{REGISTRY}:find_controller")(name)
        tuned = f"Settings tuned for scenario {config.scenario.name} ({config.scenario.hash}). {plant}"
        controller = entry.make(config)
        if not (hasattr(controller, "at_rest") and hasattr(controller, "step")):
            raise CzError(f"{name} cannot be exported: it solves an optimisation problem, or has no feedback")
        return Chosen(identifier, controller, config, (f"Controller {name}: {entry.meaning}.", tuned))
    if name not in agents.shipped_names() and Path(name).suffix != ".onnx":
        raise CzError(unknown("controller or agent", name, [*known, *agents.shipped_names()]))
    policy = agents.load(name)
    contract = policy.contract
    if contract.puller != config.puller.label:
        raise CzError(f"{name} was trained for the puller {contract.puller}, not for {config.puller.label}")
    if contract.plant_hash != config.plant_hash:
        raise CzError(f"{name} was trained on plant {contract.plant_hash}, this puller is {config.plant_hash}")
    if contract.control_interval != config.control_interval:
        raise CzError(f"{name} acts every {contract.control_interval:g} s, not every {config.control_interval:g} s")
    facts = (
        f"Agent {name}: {contract.algorithm}, seed {contract.training_seed}, trained on {contract.scenario} "
        f"({contract.scenario_hash}).",
        f"File {contract.sha256}; observation {contract.observation} {contract.observation_hash}. {plant}",
    )
    return Chosen(identifier, Agent(policy, config), config, facts)


def readme(program: Program, config: Config, files: list[str]) -> str:
    """The README beside the files."""
    kinds = {".h": "declarations", ".c": "the block", ".st": "the function block"}
    return README.format(
        name=program.name,
        about="  \n".join(program.notes),
        files="\n".join(f"| `{name}` | {kinds[Path(name).suffix]} |" for name in files),
        interval=config.control_interval,
        pull=CLIP * config.parameters.v_0 / MM_PER_MIN,
        heater=CLIP * config.heater_range / KILO,
        inputs="\n".join(f"| `{port.name}` | {port.meaning} |" for port in program.inputs),
        settings="\n".join(f"| `{port.name}` | {port.meaning}: {port.default:.10g} |" for port in program.settings),
        alarms="\n".join(f"| {bit.value} | `{bit.name}` | {text} |" for bit, text in meanings(Alarm).items()),
    )


if __name__ == "__main__":
    raise SystemExit(main())
