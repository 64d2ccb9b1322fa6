"""Pull a crystal by hand: ``python -m cz_gym.play [--scenario NAME] [--seed N] ...``."""

from __future__ import annotations

import argparse
import os
import pkgutil
import sys
from collections.abc import Sequence

from gymnasium.error import Error

from cz_gym.commands import OneLineParser, between
from cz_gym.config import Config, make_config
from cz_gym.errors import CzError
from cz_gym.rendering.view import Window
from cz_gym.units import MINUTE

from .game import FASTEST, SLOWEST, Game

CONTROLLERS = "cz_gym.baselines.registry:find_controller"
"""Function that finds the paper's controller, looked up by name because this package imports no controller."""
SIZE = (960, 720)
"""Width and height of the window [px]."""
NO_DISPLAY = "no display: a crystal is pulled by hand in a window; set DISPLAY or WAYLAND_DISPLAY"
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
"""Environment variables that can name a display, on systems that have such."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Play until the window is closed; 0 when done, 2 for bad input or without a window, 130 when interrupted."""
    parser = OneLineParser(
        "python -m cz_gym.play",
        "Pull a crystal by hand in a window; the score compares you with the paper's controller on the same crystal.",
        "Keys: up and down the pull speed, right and left the heater (with shift: in large steps), space starts "
        "and pauses, + and - change the speed of time, R begins again, N takes the next crystal, H shows help, Q ends.",
    )
    add = parser.add_argument
    add("--scenario", default="randomized", metavar="NAME", help="scenario (%(default)s)")
    add("--seed", type=between(0, 2**63 - 1), default=1, metavar="N", help="which crystal (%(default)s)")
    add("--speed", type=between(SLOWEST, FASTEST), default=60, metavar="N", help="times faster than real (%(default)s)")
    add("--minutes", type=between(1, 6000), default=180, metavar="M", help="length of the run (%(default)s)")
    return parser.run(_play, arguments, "render")


def settings(arguments: argparse.Namespace) -> Config:
    """The environment's settings."""
    return make_config(arguments.scenario, None, "measured", horizon=arguments.minutes * MINUTE, action="direct")


def _play(arguments: argparse.Namespace) -> None:
    config = settings(arguments)
    if sys.platform.startswith(("linux", "freebsd")) and not any(map(os.environ.get, DISPLAYS)):
        raise CzError(NO_DISPLAY)
    paper = pkgutil.resolve_name(CONTROLLERS)("paper").make(config)
    try:
        window = Window(SIZE, "Cz-v0: pull a crystal")
    except Error as error:
        raise CzError(str(error)) from None
    try:
        if not window.visible:
            raise CzError(NO_DISPLAY)
        scores = Game(window, SIZE, config, arguments.seed, arguments.speed, paper).play()
    finally:
        window.close()
    for score in scores:
        print(score.line())


if __name__ == "__main__":
    sys.exit(main())
