"""Write a controller for a plant, or the plant for a simulator: ``cz-gym export``."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cz_gym.config import make_config
from cz_gym.evaluation.protocol import scenarios
from cz_gym.spaces import CLIP
from cz_gym.support.command_line import OneLineParser, relative_path
from cz_gym.support.errors import CzError
from cz_gym.support.files import write_files
from cz_gym.support.units import KILO, MM_PER_MIN
from cz_gym.tools.identify.log import add_log_options, read_given

from .block import Alarm, meanings
from .controllers import make_block
from .shell import Block
from .text import fill_template, memory_of, shadow, test_vector, write_c, write_st
from .trace import Program

WRITERS: dict[str, Any] = {"c": write_c, "st": write_st}


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the files; 0 when done, 2 for bad input."""
    about = "Write a controller, and what a plant needs around it, as C99 or structured text; or the puller as FMU."
    parser = OneLineParser("cz-gym export", about)
    add = parser.add_argument
    add("controller", nargs="?", help="a classical controller, a shipped agent, or an agent file (.onnx)")
    add("--plant", action="store_true", help="the puller in place of a controller (--to fmu)")
    add("--to", choices=("c", "fmu", "st"), help="C99, FMI, IEC 61131-3 structured text")
    add("--shadow", type=Path, metavar="LOG", help="in place of --to: run the controller beside a log, and report")
    add_log_options(parser)
    add("--out", type=Path, required=True, metavar="DIR", help="folder for the files")
    parser.add_puller("its nominal values, its drives' limits, what is designed for it")
    parser.add_scenario("scenario whose tuned settings a controller has, or that a plant begins with (puller)")
    add("--real", choices=("double", "float"), default="double", help="precision of c and st (%(default)s)")
    return parser.run(_export, arguments, "plant")


def _export(given: argparse.Namespace) -> None:
    fmu, asked = given.to == "fmu", bool(given.to) != bool(given.shadow)
    if not asked or given.plant != fmu or given.plant == bool(given.controller):
        raise CzError("name a controller and --to c or st, or --shadow LOG; or --plant --to fmu")
    if given.scenario and given.puller and not given.plant:
        raise CzError("--scenario is for the default puller: a puller file has settings whatever the scenario")
    scenario = scenarios(given.scenario or "puller")
    config = make_config(scenario, observation="measured", action="direct", puller=given.puller)
    if given.plant:
        from .fmu import build_fmu

        print(relative_path(build_fmu(given.out, config.scenario.name, config.puller if given.puller else None)))
        return
    block = make_block(given.controller, config)
    if given.shadow:
        files = shadow(block, read_given(given.shadow, given))
    else:
        files = WRITERS[given.to](block.program, given.real == "float") | {"vector.csv": test_vector(block)}
        files["README.md"] = readme(block, list(files), given.real == "float")
        _check_own(given.out, block.program)
    write_files({given.out / name: text.encode() if isinstance(text, str) else text for name, text in files.items()})
    print(*(relative_path(given.out / name) for name in files), sep="\n")


def _check_own(folder: Path, program: Program) -> None:
    """Raise CzError for a folder with the README of another block, or of the same on another puller: its test vector
    would be taken for this one's.
    """
    path = folder / "README.md"
    text = path.read_text("utf-8", "replace") if path.exists() else ""
    own = text.startswith(f"# {program.name}:") and "  \n".join(program.notes) in text
    if text and not own:
        raise CzError(f"{path} is of another block: name another folder")


def readme(block: Block, files: list[str], single: bool) -> str:
    """The README beside the files."""
    memory, stack = memory_of(block.program, single)
    kinds = {
        ".h": "declarations", ".c": "the block", ".st": "the function block",
        ".csv": "a test vector: inputs and outputs of calls one after the other, with the default settings, for a port",
    }  # fmt: skip
    program, config = block.program, block.config
    parts = {
        "files": "\n".join(f"| `{name}` | {kinds[Path(name).suffix]} |" for name in files),
        "memory": f"{memory.itemsize / 1024:.0f}",
        "stack": f"{stack / 1024:.0f}",
        "interval": f"{config.control_interval:g}",
        "pull": f"{CLIP * config.parameters.v_0 / MM_PER_MIN:g}",
        "heater": f"{CLIP * config.heater_range / KILO:g}",
        "inputs": "\n".join(f"| `{port.name}` | {port.meaning} |" for port in program.inputs),
        "settings": "\n".join(f"| `{port.name}` | {port.meaning}: {port.default:.10g} |" for port in program.settings),
        "alarms": "\n".join(f"| {bit.value} | `{bit.name}` | {text} |" for bit, text in meanings(Alarm).items()),
    }
    return fill_template("block.md", parts | {"name": program.name, "about": "  \n".join(program.notes)})
