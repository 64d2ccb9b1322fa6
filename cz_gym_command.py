"""The command ``cz-gym``: one word for each thing to do, whose module is imported when it is asked for.

It stands beside the package, whose import takes a second: help comes at once, and Ctrl-C during the import is one line.
"""

import os
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import version
from io import TextIOWrapper
from pathlib import Path
from threading import Timer

COMMANDS = {
    "list": ("cz_gym.tools.registry", "names of controllers, agents, scenarios, pullers, stages"),
    "train": ("cz_gym.tools.train", "train an agent by a training recipe"),
    "benchmark": ("cz_gym.tools.benchmark", "compare controllers and agents on the same crystals"),
    "tune": ("cz_gym.tools.tune", "search settings of controllers, or design them for a puller"),
    "check": ("cz_gym.tools.check", "check an agent or a controller before a run"),
    "leaderboard": ("cz_gym.tools.leaderboard", "run submitted agents again on fresh crystals"),
    "identify": ("cz_gym.tools.identify.command", "estimate a puller's numbers from its log"),
    "bode": ("cz_gym.tools.bode", "margins and Bode plot of a controller's loop"),
    "puller": ("cz_gym.tools.puller", "print what a puller file implies"),
    "recipe": ("cz_gym.tools.recipe", "set points of a whole crystal against its length"),
    "export": ("cz_gym.tools.export.command", "write a controller or agent as code for a PLC"),
    "serve": ("cz_gym.tools.serve", "run a virtual puller on OPC UA"),
    "play": ("cz_gym.tools.play", "pull a crystal by hand"),
    "data": ("cz_gym.tools.datasets", "record datasets for offline learning"),
}
"""For each word its module, whose ``main`` takes the arguments after it, and what it does."""
EXTRAS = {
    **dict.fromkeys(("matplotlib", "tqdm", "pandas", "control", "onnx", "onnxruntime"), "benchmark"),
    **dict.fromkeys(("stable_baselines3", "torch", "filelock"), "agents"),
}
"""Extras of packages that commands import at their beginning."""
SOON = 0.5
"""Time after which a command says that it loads [s]."""
HELP = "\n".join([
    "usage: cz-gym COMMAND ...; cz-gym COMMAND --help has its options",
    "",
    *(f"  {name:11} {about}" for name, (_, about) in COMMANDS.items()),
])  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; returns its exit code, 2 for a word that is none, 130 when its import is interrupted."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal of ASCII shows question marks
    try:
        try:
            return _run(arguments)
        finally:
            sys.stdout.flush()
    except OSError as error:
        try:
            print(flush=True)  # fails again if it was stdout
        except OSError:
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            if isinstance(error, BrokenPipeError):
                return 141
            print(f"cz-gym: the output cannot be written: {error.strerror}", file=sys.stderr)
            return 2
        raise


def _run(arguments: Sequence[str] | None) -> int:
    word, *others = [*(sys.argv[1:] if arguments is None else arguments), "--help"]
    if word in ("-h", "--help"):
        print(HELP)
        return 0
    if word == "--version":
        print(f"cz-gym {version('cz-gym')}")
        return 0
    if word not in COMMANDS:
        close = get_close_matches(word, COMMANDS, 1)
        meant = f": did you mean {close[0]!r}? Choose" if close else "; choose"
        print(f"cz-gym: unknown command {word!r:.80}{meant} from {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    loading = Timer(SOON, print, [f"cz-gym {word}: loading its packages"], {"file": sys.stderr, "flush": True})
    loading.daemon = True
    loading.start()
    try:
        module = import_module(COMMANDS[word][0])
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("cz_gym"):
            raise
        own = "." if (Path(__file__).parent / "pyproject.toml").is_file() else "cz-gym"
        extra = EXTRAS.get((error.name or "").partition(".")[0])
        extra = f': pip install "{own}[{extra}]"' if extra else ""
        print(f"cz-gym {word}: {error}{extra}", file=sys.stderr)
        return 2
    finally:
        loading.cancel()
    code: int = module.main(others[:-1])
    return code
