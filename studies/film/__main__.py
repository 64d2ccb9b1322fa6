"""The README's animated picture: the paper's controller and an agent pull the same crystal side by side."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cz_gym import agents
from cz_gym.atomic_files import check_writable, write_files
from cz_gym.baselines.registry import make_controller
from cz_gym.commands import OneLineParser
from cz_gym.env import CzEnv
from cz_gym.errors import CzError
from cz_gym.rendering import palette as c
from cz_gym.rendering.canvas import Canvas

from .duel import Side, draw

OUT = Path(__file__).resolve().parents[2] / "results" / "media" / "duel.gif"
SEED = 2_000_000
"""The first test crystal, the one in the benchmark's figure."""
FRAMES = 92
"""Number of pictures."""
RATE = 11
"""Frames a second."""
HOLD = 1.8
"""How long the last frame stays [s]."""
SIZE = (860, 470)
COLOURS = 128
PAPER = (255, 130, 205)
"""Colour of the paper's controller: seen on crystal, melt and gas, and unlike the agent's also to the colour-blind."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("python -m studies.film", "Film the paper's controller and an agent on the same crystal.")
    parser.add_argument("--out", type=Path, default=OUT, metavar="FILE", help="file to write (results/media/duel.gif)")
    return parser.run(_make, arguments, "render,benchmark")


def _make(arguments: argparse.Namespace) -> None:
    if arguments.out.suffix != ".gif":
        raise CzError(f"--out must end in .gif, not {str(arguments.out)!r}")
    import PIL.Image  # noqa: F401  (missing? say so before the work, not after it)

    check_writable(arguments.out.resolve().parent)
    content = film()
    write_files({arguments.out.resolve(): content})
    print(f"wrote {arguments.out}: {FRAMES} frames, {len(content) / 1e6:.2f} MB")


def film() -> bytes:
    """The GIF: both sides stepped together, FRAMES pictures equally far apart in time."""
    sides, canvas = contestants(SEED), Canvas(*SIZE)
    steps = sides[0].env.config.steps
    pictures = []
    for number in range(FRAMES):
        for side in sides:
            side.step_to(round((number + 1) * steps / FRAMES))
        pictures.append(draw(canvas, sides))
    return gif(pictures)


def contestants(seed: int) -> tuple[Side, Side]:
    """The paper's controller and the shipped agent, each with an environment of its own."""
    env = CzEnv(observation="measured", action="direct", render_mode="rgb_array")
    learned = agents.load()
    other = CzEnv(**learned.settings, render_mode="rgb_array")
    name = f"learned: {learned.contract.algorithm}"
    paper = make_controller("paper", env.config)
    return Side("the paper's controller", paper, env, PAPER, seed), Side(name, learned, other, c.TRUE, seed)


def gif(pictures: Sequence[Any]) -> bytes:
    """Pictures as an endless GIF with one palette, so that only what moves is stored again."""
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    palette = _palette(images[-1], Image)
    indexed = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in images]
    durations = [round(1000 / RATE)] * (len(images) - 1) + [round(1000 * HOLD)]
    content = io.BytesIO()
    indexed[0].save(
        content, "GIF", save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=False, disposal=1
    )
    return content.getvalue()


def _palette(picture: Any, Image: Any) -> Any:
    """COLOURS colours: those that mean something, however few their pixels, and the rest as the picture needs them."""
    meaning = (c.BACK, c.PANEL, c.INK, c.TRUE, c.CAMERA, c.REFERENCE, PAPER, c.ALARM)
    needed = picture.quantize(COLOURS - len(meaning), method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    channels = [*needed.getpalette()[: 3 * (COLOURS - len(meaning))], *sum(meaning, ())]
    found = Image.new("P", (1, 1))
    found.putpalette(channels + channels[-3:] * (256 - len(channels) // 3))
    return found


if __name__ == "__main__":
    sys.exit(main())
