"""Bode plot and margins of a controller's loop with the default puller near rest, and the hot zones that it survives.

``cz-gym bode lqg`` takes a shipped controller, ``cz-gym bode my.py:SlowPID`` one of your own,
whose ``state`` must be a NamedTuple of arrays.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cz_gym.baselines import analysis
from cz_gym.config import make_config
from cz_gym.evaluation.protocol import user_controller
from cz_gym.physics.plant import make_puller
from cz_gym.process import StateSpace
from cz_gym.puller.file import DEFAULT, PullerFile, chosen_puller
from cz_gym.support.command_line import OneLineParser
from cz_gym.support.errors import CzError
from cz_gym.support.files import check_writable, write_files
from cz_gym.tools.registry import make_controller
from cz_gym.tools.report.tables import markdown as table

PLACES = {"camera": "ring", "v_p": "pull speed", "Q_H": "heater"}
"""Names of the places where the loop is opened."""


def form_of(name: str, puller: PullerFile = DEFAULT) -> analysis.LinearForm:
    """Linearise a shipped controller, or ``FILE.py:NAME``; ValueError says in one line why it has no linear form."""
    config = make_config("nominal", observation="measured", action="direct", puller=puller)
    sensor = make_config("randomized", puller=puller).sole_scenario.sensor
    policy = user_controller(name).make(config) if ":" in name else make_controller(name, config)
    return analysis.linear_form(policy, sensor)


def phase_of(values: Any) -> Any:
    """Continuous phase of a response [degrees]; it begins between -360 and 0, so that margins are read at -180."""
    phase = np.degrees(np.unwrap(np.angle(values)))
    return phase - 360.0 * (phase[0] // 360.0 + 1.0)


def picture(title: str, dt: float, loops: dict[str, StateSpace]) -> bytes:
    """Draw gain and phase of the loops, by the place where they are opened, and their sensitivity, as PNG."""
    from cz_gym.evaluation.plots import COLOURS, DASHES, GREY, canvas, png

    omega = analysis.frequencies(dt)
    figure = canvas(7.0, 6.5)
    gain, phase, sensitivity = figure.subplots(3, 1, sharex=True)
    for (at, loop), colour, dashes in zip(loops.items(), COLOURS, DASHES, strict=False):
        look: Any = {"color": colour, "lw": 1.2, "ls": (0, dashes) if dashes else "-"}
        values = analysis.response(loop, dt, omega)
        gain.loglog(omega, np.abs(values), **look, label=f"opened at the {PLACES[at]}")
        phase.semilogx(omega, phase_of(values), **look)
        sensitivity.loglog(omega, 1.0 / np.abs(1.0 + values), **look)
    for panel, label in ((gain, "|L| [-]"), (phase, "phase of L [deg]"), (sensitivity, "|1 / (1 + L)| [-]")):
        panel.set_ylabel(label)
        panel.grid(alpha=0.3)
    for panel in (gain, sensitivity):
        panel.axhline(1.0, color=GREY, lw=0.8)
    sensitivity.set_xlabel("angular frequency [rad/s]")
    gain.legend(fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=10)
    return png(figure)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("cz-gym bode", (__doc__ or "").split("\n")[0])
    parser.add_argument("controller", help="name of a shipped controller, or FILE.py:NAME")
    parser.add_argument("--mix", type=float, default=0.5, help="1: Model I, 0: Model II (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("runs/bode.png"), help="picture to write (%(default)s)")
    parser.add_puller("the loop with its plant")
    return parser.run(_main, arguments, "benchmark")


def _main(given: argparse.Namespace) -> None:
    check_writable(given.out.parent)
    if not 0.0 <= given.mix <= 1.0:
        raise CzError(f"--mix must lie in [0, 1], not {given.mix:g}")
    own = chosen_puller(given.puller)
    form, puller = form_of(given.controller, own), make_puller(own.parameters, given.mix)
    heats = form.controller.C[1].any() or form.controller.D[1].any()
    stable = analysis.close(form.controller, puller, form.dt).stable
    heads = ("opened at", "crossover [rad/s]", "gain up", "gain down", "phase [deg]", "delay [s]", "sensitivity")
    rows, loops = [], {}
    for at in PLACES if heats else ("camera", "v_p"):
        controller = form.controller if at == "camera" else form.free
        first, *rest = analysis.loop_margins(controller, puller, form.dt, at, stable)
        rows.append((PLACES[at], f"{first:.2e}", *("none" if np.isnan(value) else f"{value:.3g}" for value in rest)))
        loops[at] = analysis.opened(controller, puller, form.dt, at)
    print(table(heads, rows))
    if not stable:
        print("the closed loop is unstable: it has no margins")
    ranges = {
        name: analysis.stable_range(form.controller, form.dt, of, given.mix, own.parameters)
        for name, of in analysis.HOT_ZONE.items()
    }
    zones = [(name, f"{low:.2f}", f"{high:.2f}") for name, (low, high) in ranges.items()]
    print(table(("factor on", "stable from", "to"), zones))
    title = f"{given.controller}, puller {own.label}, share of conduction {given.mix:g}"
    write_files({given.out: picture(title, form.dt, loops)})
    print(f"wrote {given.out}")
