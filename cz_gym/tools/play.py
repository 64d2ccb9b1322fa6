"""Pull a crystal by hand in Gymnasium's own player: ``cz-gym play [--scenario NAME] [--seed N] ...``."""

import argparse
import os
import sys
import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt

from cz_gym.body.process import BODY
from cz_gym.config import Config, make_config
from cz_gym.crystal.plant import STAGES, named
from cz_gym.crystal.process import CRYSTAL
from cz_gym.env import CzEnv
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import scenarios
from cz_gym.evaluation.rollout import Playback, rollout
from cz_gym.puller.file import chosen_puller
from cz_gym.rendering.canvas import load
from cz_gym.support.command_line import OneLineParser, between, filled
from cz_gym.support.errors import CzError
from cz_gym.support.units import MINUTE

Action = npt.NDArray[np.float32]
SIZE = (960, 720)
"""Width and height of the picture [px]."""
NO_DISPLAY = "no display: a crystal is pulled by hand in a window; set DISPLAY or WAYLAND_DISPLAY"
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
"""Environment variables that can name a display, on systems that have such."""
RIVALS = {BODY.name: ("paper", "the paper's"), CRYSTAL.name: ("compensated", "the compensated")}
"""Controller that a player is compared with by environment: its name, and what a sentence calls it."""
STEP = 0.1
"""Action of a key that is held down, in the mode "rate"; ten times as large with shift [-]."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Play one crystal; 0 when done, 2 for bad input or without a window, 130 when interrupted."""
    parser = OneLineParser(
        "cz-gym play",
        "Pull a crystal by hand in a window; the score compares you with a controller on the same crystal.",
        "Keys: up and down change the pull speed, right and left the heater, ten times as fast with shift; Esc ends.",
    )
    add = parser.add_argument
    add_crystal(parser)
    add("--speed", type=between(5, 300), default=60, metavar="N", help="times faster than real time (%(default)s)")
    add(
        "--minutes",
        type=between(1, 6000),
        metavar="M",
        help="length of the run (180; of a stage 1.3 times its recipe's)",
    )
    parser.add_puller("pull its crystals")
    return parser.run(_play, arguments, "render")


def add_crystal(parser: OneLineParser) -> None:
    """Add the options that say which crystal is pulled."""
    parser.add_scenario("scenario (%(default)s)", "randomized")
    add, about = parser.add_argument, f"part of a whole crystal, CzCrystal-v0: {', '.join(STAGES)}, or a length [m]"
    add("--seed", type=between(0, 2**31 - 1), default=1, metavar="N", help="which crystal (%(default)s)")
    add("--stage", type=named, metavar="STAGE", help=about)


def crystal_config(given: argparse.Namespace, horizon: float | None, action: str) -> Config:
    """The environment of the crystal that the options name, for ``horizon`` [s]."""
    return make_config(
        scenarios(given.scenario), None, "measured", horizon=horizon, action=action,
        puller=chosen_puller(given.puller), process=BODY if given.stage is None else CRYSTAL, stage=given.stage,
    )  # fmt: skip


def keys_to_actions() -> dict[tuple[int, ...], Action]:
    """Map each combination of keys to its action."""
    k, actions = load(), dict[tuple[int, ...], Action]()
    for pull, heat, large in product((0, 1, -1), (0, 1, -1), (1, 10)):
        held = {k.K_UP: pull > 0, k.K_DOWN: pull < 0, k.K_RIGHT: heat > 0, k.K_LEFT: heat < 0, k.K_LSHIFT: large > 1}
        actions[tuple(sorted(key for key in held if held[key]))] = np.array([pull, heat], np.float32) * STEP * large
    del actions[()]  # without a key the drives stay
    return actions


def score(config: Config, seed: int, actions: Sequence[Action], failed: bool) -> str:
    """Score a player's actions beside a controller's on the same crystal: RMSE and return, in one line.

    The controller is the paper's; on a whole crystal it is the one with the paper's compensator along the recipe. A run
    that the player left early ends there for both. A failed one counts to the horizon, as in the benchmark.
    """
    from .registry import find_controller  # a window opens without it

    if not failed:
        config = replace(config, horizon=len(actions) * config.control_interval)
    direct = replace(config, action="direct")
    name, called = RIVALS[config.process.name]
    rival = find_controller(name, config.process).make(direct)
    results = []
    for policy, own in ((Playback(actions), config), (rival, direct)):
        figures = metrics(rollout(policy, own, [seed]))
        lost = ", failed" if figures.failure_rate[0] else ""
        results.append(f"RMSE {figures.rmse_mm[0]:.3f} mm, return {figures.return_[0]:,.0f}{lost}")
    crystal = f"{config.scenario.name}, crystal {seed}, {config.horizon / MINUTE:.0f} min"
    return f"{crystal}: by hand {results[0]}; by {called} controller {results[1]}"


def _play(arguments: argparse.Namespace) -> None:
    pygame = load()
    config = crystal_config(arguments, arguments.minutes and arguments.minutes * MINUTE, "rate")
    if sys.platform.startswith(("linux", "freebsd")) and not any(map(os.environ.get, DISPLAYS)):
        raise CzError(NO_DISPLAY)
    pygame.display.init()
    if pygame.display.get_driver() == "offscreen":  # SDL's last resort: a window that nobody sees
        raise CzError(NO_DISPLAY)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its plots need matplotlib, the game does not
        from gymnasium.utils.play import play
    actions: list[Action] = []
    ended = failed = False

    def watch(
        before: Any, after: Any, action: Action, reward: Any, terminated: bool, truncated: bool, info: Any
    ) -> None:
        nonlocal ended, failed
        actions.append(action)
        ended, failed = terminated or truncated, terminated and not info.get("succeeded", 0.0)
        if ended:
            pygame.event.post(pygame.event.Event(pygame.QUIT))

    fps = max(1, round(arguments.speed / config.control_interval))
    env = CzEnv.from_config(config, "rgb_array", SIZE)
    keys, still = keys_to_actions(), np.zeros(2, np.float32)
    play(env, fps=fps, callback=watch, keys_to_action=keys, seed=arguments.seed, noop=still)
    if actions:
        print(filled(score(config, arguments.seed, actions, failed)))
