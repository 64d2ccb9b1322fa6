"""The README's animated picture: ``python -m cz_gym.film [--seed N] [--scenario NAME] [--out FILE]``.

The paper's controller and the shipped agent pull the same crystal side by side. GIF, because it plays everywhere.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gymnasium.error import DependencyNotInstalled

from .commands import OneLineParser, interrupted

if TYPE_CHECKING:
    from .rendering.duel import Side

PROG = "cz_gym.film"
OUT = Path(__file__).resolve().parents[1] / "results" / "media" / "duel.gif"
SEED = 2_000_000
"""The first test crystal, the one in the benchmark's figure."""
RATE = 14
"""Frames a second."""
HOLD = 1.8
"""How long the last frame stays [s]."""
SIZE = (860, 470)
COLOURS = 128


def parse(argv: list[str] | None = None) -> argparse.Namespace:
    """Read the command line; exits with code 2 and one line for anything that cannot be meant."""
    parser = OneLineParser(
        prog="python -m cz_gym.film",
        description="Film the paper's controller and the shipped agent on the same crystal.",
    )
    parser.add_argument("--scenario", default="randomized", metavar="NAME", help="scenario (%(default)s)")
    parser.add_argument("--seed", type=int, default=SEED, metavar="N", help="which crystal (%(default)s)")
    parser.add_argument("--frames", type=int, default=120, metavar="N", help="frames of the film (%(default)s)")
    parser.add_argument("--out", type=Path, default=OUT, metavar="FILE", help="file to write (results/media/duel.gif)")
    return parser.parse_args(argv)


def main(argv: list[str] | None = None) -> int:
    """Film and write; 0 when done, 2 for bad input or a missing package, 130 when interrupted."""
    arguments = parse(argv)
    try:
        if not 2 <= arguments.frames <= 1000:
            raise ValueError(f"--frames must be 2 to 1000, not {arguments.frames}")
        if arguments.seed < 0:
            raise ValueError(f"--seed must not be negative, not {arguments.seed}")
        if arguments.out.suffix != ".gif":
            raise ValueError(f"--out must end in .gif, not {str(arguments.out)!r}")
        import PIL.Image  # noqa: F401  (missing? say so before the work, not after it)

        from .evaluation.files import check_writable, write_files

        check_writable(arguments.out.resolve().parent)
        content = film(arguments.scenario, arguments.seed, arguments.frames)
        write_files({arguments.out.resolve(): content})
    except KeyboardInterrupt:
        return interrupted(PROG)
    except ImportError as error:
        missing = f'{error.name} is missing: pip install "cz-gym[render,benchmark]"' if error.name else error
        print(f"{PROG}: {missing}", file=sys.stderr)
        return 2
    except (ValueError, OSError, DependencyNotInstalled) as error:
        print(f"{PROG}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    print(f"wrote {arguments.out}: {arguments.frames} frames, {len(content) / 1e6:.2f} MB")
    return 0


def film(scenario: str, seed: int, frames: int) -> bytes:
    """The GIF: both sides stepped together, ``frames`` pictures equally far apart in time."""
    from .rendering.duel import Duel
    from .rendering.view import image

    sides = contestants(scenario)
    for side in sides:
        side.begin(seed)
    duel = Duel(*SIZE)
    steps = sides[0].env.config.steps
    pictures = []
    for number in range(frames):
        upto = round((number + 1) * steps / frames)
        for side in sides:
            side.step_to(upto)
        pictures.append(image(duel.draw(sides)))
    return gif(pictures)


def contestants(scenario: str) -> tuple[Side, Side]:
    """The paper's controller and the shipped agent, each with an environment of its own."""
    from .env import CzEnv
    from .rendering.duel import Side
    from .rendering.palette import TEMPERATURE, TRUE
    from .rooms import room

    env = CzEnv(scenario, observation="measured", render_mode="rgb_array")
    paper = room("baselines.registry").find_controller("paper").make(env.config)
    agents = room("agents")
    learned = agents.OnnxPolicy.load(agents.shipped("ppo"), env.config)
    other = CzEnv(scenario, observation=learned.observation, render_mode="rgb_array")
    return Side("the paper's controller", paper, env, TEMPERATURE), Side("learned: ppo", learned, other, TRUE)


def gif(pictures: Sequence[Any]) -> bytes:
    """Pictures as an endless GIF with one palette, so that only what moves is stored again."""
    from PIL import Image

    images = [Image.fromarray(picture) for picture in pictures]
    palette = _with_meanings(pictures[-1], Image).quantize(COLOURS, method=Image.Quantize.MEDIANCUT, dither=0)
    indexed = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in images]
    durations = [round(1000 / RATE)] * (len(images) - 1) + [round(1000 * HOLD)]
    content = io.BytesIO()
    indexed[0].save(
        content, "GIF", save_all=True, append_images=indexed[1:], duration=durations, loop=0, optimize=False, disposal=1
    )
    return content.getvalue()


def _with_meanings(picture: Any, Image: Any) -> Any:
    """A picture with stripes of the colours that mean something and are small in it, for the palette to keep."""
    from .rendering.palette import CAMERA, GLOW, MELT_TOP, mix

    picture = picture.copy()
    for i, colour in enumerate((CAMERA, GLOW, mix(CAMERA, GLOW, 0.5), mix(MELT_TOP, GLOW, 0.5))):
        picture[8 * i : 8 * (i + 1)] = colour
    return Image.fromarray(picture)


if __name__ == "__main__":
    sys.exit(main())
