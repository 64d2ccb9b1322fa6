"""README's moving picture: ``python -m studies.picture``; with a benchmark.json its result plot and pages instead.

One crystal of ``randomized`` from a training seed, under a PID on the bright ring without the compensator and under
an LQG, each with the camera's view in a corner.
"""

import argparse
import io
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from cz_gym.camera.image import picture
from cz_gym.camera.view import camera_for, make_view
from cz_gym.env import CzEnv
from cz_gym.rendering import canvas as palette
from cz_gym.rendering.canvas import Box, Canvas, Frame
from cz_gym.rendering.picture import Ending, Record, draw, record_of
from cz_gym.support.files import name_file_in_errors, write_files
from cz_gym.support.units import MINUTE, MM
from cz_gym.tools.benchmark import PAGES
from cz_gym.tools.registry import make_controller
from cz_gym.tools.report import vector
from cz_gym.tools.report.markdown import fill_in
from cz_gym.tools.run import read_benchmark

from . import StudyParser

SEED = 23
SIDES = {"pid-uncompensated": "PID on the ring", "lqg-one-design": "LQG with a model of the ring"}
"""Controllers, left and right, and their headings."""
TIME, EVERY = 24.0 * MINUTE, 3
"""Length of the picture [s], and control intervals between its frames."""
SIZE, PANEL, CHART = (414, 366), Box(4.0, 34.0, 406.0, 226.0), Box(44.0, 268.0, 362.0, 74.0)
"""Pixels of a side, of its cross-section, and of its chart."""
LARGEST = 5.0 * MM
"""Radius error at the chart's ends [m]."""
FRAME, END = 80, 2000
"""Time of a frame, and of the end, which is shown first and last [ms]."""


def frames(seed: int = SEED, time: float = TIME) -> Iterator[Frame]:
    """Grow the crystal under both controllers, and draw every third sample, then the end with how each ended."""
    sides = [CzEnv("randomized", observation="measured", action="direct", render_mode="rgb_array") for _ in SIDES]
    policies = [make_controller(name, env.config) for name, env in zip(SIDES, sides, strict=True)]
    seen, states = [env.reset(seed=seed)[0] for env in sides], [None, None]
    view = make_view(camera_for(sides[0].config.parameters))
    for step in range(round(time / sides[0].config.control_interval)):
        for number, env in enumerate(sides):
            if record_of(env).ending is None:
                action, states[number] = policies[number].predict(
                    seen[number][None], states[number], np.array([step == 0])
                )
                seen[number] = env.step(action[0])[0]
        if step % EVERY == 0:
            yield _both(sides, view, time, False)
    yield _both(sides, view, time, True)


def _both(sides: Sequence[CzEnv], view: Any, time: float, ended: bool) -> Frame:
    halves = [_side(record_of(env), name, view, time, ended) for env, name in zip(sides, SIDES.values(), strict=True)]
    return np.concatenate(halves, axis=1)


def _side(record: Record, name: str, view: Any, time: float, ended: bool) -> Frame:
    """One controller's half of a frame."""
    canvas = Canvas(*SIZE)
    canvas.unit, canvas.box = 1.0, Box(0.0, 0.0, *map(float, SIZE))
    canvas.begin()
    canvas.text(8, 8, name, size=15, bold=True)
    canvas.text(canvas.box.right - 8, 10, f"{record.t[-1] / MINUTE:.0f} min", palette.FAINT, 13, 1.0)
    draw(canvas, PANEL, record)
    canvas.text(PANEL.right - 8.0, PANEL.y + 128.0, "camera's view", palette.FAINT, 10, 1.0)
    if ended or record.ending is not None:
        lost = {None: "HELD", Ending.FROZEN: "LOST: frozen to the melt"}.get(record.ending, "LOST")
        band = Box(PANEL.x, PANEL.bottom - 52.0, PANEL.w, 34.0)
        canvas.rectangle(palette.WELL if record.ending is None else palette.ALARM, band)
        words = f"{lost}, {record.error[-1] / MM:+z.1f} mm off"
        canvas.text(band.x + band.w / 2.0, band.y + 6.0, words, palette.BACK, 18, 0.5, bold=True)
    _chart(canvas, record, time)
    frame = canvas.finish().copy()
    image = picture(record.last("r_c"), record.last("h_c"), record.puller, view)[:, :, 0]
    top, right = round(PANEL.y) + 6, SIZE[0] - 10
    frame[top : top + image.shape[0], right - image.shape[1] : right] = image[..., None]
    return frame


def _chart(canvas: Canvas, record: Record, time: float) -> None:
    """True radius error, and that by the camera."""
    canvas.rectangle(palette.PANEL, CHART)

    def y(error: Any) -> Any:
        return CHART.y + CHART.h * (0.5 - 0.5 * np.clip(error / LARGEST, -1.0, 1.0))

    x = CHART.x + CHART.w * record.t / time
    canvas.lines(palette.FAINT, [CHART.x, CHART.right], y(0.0))
    for error in (LARGEST, 0.0, -LARGEST):
        canvas.text(CHART.x - 5.0, y(error) - 6.0, f"{error / MM:+.0f}" if error else "0 mm", palette.FAINT, 10, 1.0)
    known = np.isfinite(record.camera_error)
    canvas.lines(palette.CAMERA, x[known], y(record.camera_error[known]), 1.4)
    canvas.lines(palette.TRUE, x, y(record.error), 2.2)
    said = record.camera_error[known][-1] / MM
    for place, words, value, colour in (
        (8, "camera", said, palette.CAMERA),
        (212, "true", record.error[-1] / MM, palette.TRUE),
    ):
        canvas.text(place, CHART.bottom + 5.0, f"{words} {value:+z.1f} mm", colour, 13, bold=True)


def moving(every: Sequence[Frame]) -> bytes:
    """Return frames as an animated GIF of one palette; its first is the end, for those who see one picture alone."""
    shown = Image.fromarray(np.concatenate([every[0], every[len(every) // 2], every[-1]])).quantize(96)
    images = [Image.fromarray(each).quantize(palette=shown, dither=Image.Dither.NONE) for each in every]
    file, times = io.BytesIO(), [END, *[FRAME] * (len(images) - 1), END]
    images[-1].save(file, "gif", save_all=True, append_images=images, duration=times, loop=0, optimize=True)
    return file.getvalue()


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = StudyParser("picture", __doc__, "docs/_static/lost-and-held.gif")
    parser.add_argument("results", nargs="?", type=Path, help="benchmark.json whose plots and pages are written anew")
    return parser.run(_body, arguments, "render")


def _body(given: argparse.Namespace) -> None:
    if given.results is None:
        write_files({given.out: moving([*frames()])})
        return
    benchmark = read_benchmark(given.results)
    drawn = {"result.svg": vector.result(benchmark), "pareto.svg": vector.pareto(benchmark)}
    files = {given.results.parent / name: vector.as_file(each) for name, each in drawn.items()}
    for page in PAGES:
        with name_file_in_errors(page):
            files[page] = fill_in(page.read_text("utf-8"), benchmark).encode()
    write_files(files)


if __name__ == "__main__":
    sys.exit(main())
