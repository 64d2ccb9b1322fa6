"""Pull a crystal by hand: ``python -m cz_gym.play [--scenario NAME] [--seed N] [--speed FACTOR] [--minutes M]``."""

from __future__ import annotations

import argparse
import math
import os
import pkgutil
import sys
from typing import TYPE_CHECKING

from cz_gym.commands import OneLineParser, interrupted
from cz_gym.units import MINUTE

if TYPE_CHECKING:
    from cz_gym.config import Config

PROG = "python -m cz_gym.play"
CONTROLLER = "cz_gym.baselines.registry:find_controller"
"""Who makes the rival: looked up by name, since the packages of controllers stand on this one."""
SPEED = 60.0
"""Seconds of growth a second of watching, unless told."""
NO_DISPLAY = "no display: a crystal is pulled by hand in a window; set DISPLAY or WAYLAND_DISPLAY"
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
"""Environment variables one of which names a display, on systems that have such."""


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line for anything that cannot be meant."""
    parser = OneLineParser(
        prog=PROG,
        description="Pull a crystal by hand, in a window, and be compared with the paper's controller on the same one.",
        epilog="Keys: up and down the pull speed, right and left the heater (with shift: in large steps), space starts "
        "and pauses, + and - change the speed of time, R begins again, N takes the next crystal, H shows help, Q ends.",
    )
    parser.add_argument("--scenario", default="randomized", metavar="NAME", help="scenario (%(default)s)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="which crystal (%(default)s)")
    parser.add_argument(
        "--speed", type=float, default=SPEED, metavar="FACTOR", help="times faster than real (%(default)g)"
    )
    parser.add_argument("--minutes", type=float, default=180.0, metavar="M", help="length of the run (%(default)g)")
    parser.add_argument("--size", default="960x720", metavar="WxH", help="size of the window in pixels (%(default)s)")
    return parser.parse_args(argv)


def settings(arguments: argparse.Namespace) -> tuple[Config, tuple[int, int]]:
    """The environment's settings and the window's size; ValueError names what was given and what is allowed."""
    from cz_gym.config import make_config
    from cz_gym.rendering.scene import parse_size

    from .game import FASTEST, SLOWEST

    if not SLOWEST <= arguments.speed <= FASTEST:
        raise ValueError(f"--speed must be {SLOWEST:g} to {FASTEST:g}, not {arguments.speed:g}")
    if not (math.isfinite(arguments.minutes) and 1.0 <= arguments.minutes <= 6000.0):
        raise ValueError(f"--minutes must be 1 to 6000, not {arguments.minutes:g}")
    if arguments.seed < 0:
        raise ValueError(f"--seed must not be negative, not {arguments.seed}")
    config = make_config(arguments.scenario, horizon=arguments.minutes * MINUTE)
    return config, parse_size(arguments.size)


def main(argv: list[str] | None = None) -> int:
    """Play until the window is closed; 0 when done, 2 for bad input or without window, 130 when interrupted."""
    arguments = parse(argv)
    try:
        config, size = settings(arguments)
        paper = pkgutil.resolve_name(CONTROLLER)("paper").make(config)
        if sys.platform.startswith(("linux", "freebsd")) and not any(map(os.environ.get, DISPLAYS)):
            raise ValueError(NO_DISPLAY)
        from cz_gym.rendering.view import Window

        from .game import Game
        from .score import Outcome

        window = Window(size, "Cz-v0: pull a crystal")
    except KeyboardInterrupt:
        return interrupted(PROG)
    except Exception as error:
        if not _expected(error):
            raise
        print(f"{PROG}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    try:
        if not window.visible:
            print(f"{PROG}: {NO_DISPLAY}", file=sys.stderr)
            return 2
        outcomes: list[Outcome] = Game(window, size, config, arguments.seed, arguments.speed, paper).play()
    except KeyboardInterrupt:
        return interrupted(PROG)
    finally:
        window.close()
    for outcome in outcomes:
        print(outcome.line())
    return 0


def _expected(error: Exception) -> bool:
    """Whether an error is the user's or the machine's, told in one line."""
    from gymnasium.error import Error

    return isinstance(error, (ValueError, ImportError, Error))


if __name__ == "__main__":
    sys.exit(main())
