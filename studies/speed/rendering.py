"""How fast pictures come: ``python -m studies.speed.rendering [--size WxH] [--rounds N]``.

Each round steps and renders a crystal under the paper's controller over the first and the last quarter of an hour of
its 3 h (the longer the record, the more there is to draw), and steps an environment whose observation is the camera's
image. The median round is reported: frames a second by the clock, and in a second of one core's time, which
a busy machine changes less.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from cz_gym.commands import OneLineParser, guarded

PROG = "python -m studies.speed.rendering"
FRAMES = 180
"""Frames of a measurement: a quarter of an hour at 5 s control."""
SEED = 1


class Speed(NamedTuple):
    """Frames a second."""

    by_the_clock: float
    of_one_core: float


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line for anything that cannot be meant."""
    parser = OneLineParser(prog=PROG, description="Frames a second of render() and of the camera.")
    parser.add_argument("--size", default="640x480", metavar="WxH", help="size of the picture in pixels (%(default)s)")
    parser.add_argument("--rounds", type=int, default=5, metavar="N", help="rounds, 1 to 100 (%(default)s)")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Measure and print; 0 when done, 2 for bad input or a missing package, 130 when interrupted."""
    arguments = parse(argv)
    return guarded(PROG, lambda: _measure_all(arguments), "render")


def _measure_all(arguments: argparse.Namespace) -> int:
    if not 1 <= arguments.rounds <= 100:
        raise ValueError(f"--rounds must be 1 to 100, not {arguments.rounds}")
    from cz_gym.rendering.scene import parse_size

    size = parse_size(arguments.size)
    rounds = [measure(size) for _ in range(arguments.rounds)]
    print(f"{'frames a second, median of ' + str(len(rounds)):52} {'clock':>7} {'core':>7}")
    for name in rounds[0]:
        clock, core = (statistics.median(column) for column in zip(*(each[name] for each in rounds), strict=True))
        print(f"{name:52} {clock:7.0f} {core:7.0f}")
    return 0


def measure(size: tuple[int, int]) -> dict[str, Speed]:
    """One round, by what was measured."""
    from cz_gym.baselines.registry import find_controller
    from cz_gym.env import CzEnv

    env = CzEnv("randomized", observation="measured", render_mode="rgb_array", render_size=size)
    paper = find_controller("paper").make(env.config)
    observation, _ = env.reset(seed=SEED)
    state: Any = None

    def step() -> None:
        nonlocal observation, state
        action, state = paper.predict(observation, state)
        observation, *_ = env.step(action)

    def film() -> None:
        step()
        env.render()

    env.render()
    name = f"render() and step() at {size[0]} x {size[1]}"
    found = {f"{name}, first 15 min": timed(film, FRAMES)}
    for _ in range(env.config.steps - 2 * FRAMES):
        step()
    found[f"{name}, last 15 min"] = timed(film, FRAMES)
    camera = CzEnv("nominal", observation="camera")
    camera.reset(seed=SEED)
    rest = 0.0 * camera.action_space.sample()
    camera.step(rest)
    found['step() with observation="camera"'] = timed(lambda: camera.step(rest), FRAMES)
    return found


def timed(frame: Callable[[], Any], frames: int) -> Speed:
    """Frames a second of something done so many times."""
    clock, core = time.perf_counter(), time.process_time()
    for _ in range(frames):
        frame()
    return Speed(frames / (time.perf_counter() - clock), frames / (time.process_time() - core))


if __name__ == "__main__":
    sys.exit(main())
