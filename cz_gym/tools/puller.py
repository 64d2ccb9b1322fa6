"""Operating point, drives and sensors that follow from a puller file: ``cz-gym puller FILE.toml``."""

import argparse
import math
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

from cz_gym.baselines.fallback import fallback
from cz_gym.baselines.margins import HEADS
from cz_gym.baselines.pid import StandardPID
from cz_gym.baselines.tuned_controllers import LQGS, PIDS
from cz_gym.body.process import STATES, linearise, radius_model
from cz_gym.camera.image import wall_edge
from cz_gym.camera.view import camera_for, make_scene, make_view
from cz_gym.config import Config, make_config
from cz_gym.crystal import recipe, sight
from cz_gym.crystal.plant import complete
from cz_gym.crystal.process import lengths, nominal_recipe
from cz_gym.episodes.draw import Episode
from cz_gym.episodes.scenarios import RANDOMIZED
from cz_gym.evaluation.metrics import metrics
from cz_gym.evaluation.protocol import VALIDATION_SEEDS
from cz_gym.evaluation.rollout import rollout
from cz_gym.evaluation.statistics import Resamples, means
from cz_gym.physics.meniscus import HURLE
from cz_gym.physics.parameters import MACHINE, Parameters
from cz_gym.physics.plant import HEIGHT_MAX_IN_A, HEIGHT_MIN, make_puller
from cz_gym.puller.file import PullerFile, defaults_of, doubts, find_puller, value_of
from cz_gym.support.command_line import OneLineParser, filled
from cz_gym.support.errors import CzError
from cz_gym.support.units import CELSIUS, HOUR, KILO, MINUTE, MM, MM_PER_MIN, PERCENT
from cz_gym.tools.posterior import explained, shown
from cz_gym.tools.report.markdown import aligned


def implied(puller: PullerFile) -> dict[str, str]:
    """Describe what follows from a puller's numbers at its operating point, as texts by headings."""
    q, p, pull, power = puller.parameters, make_puller(puller.parameters), puller.pull_room, puller.power_range
    model, chain = radius_model(p), [STATES.index(name) for name in ("T_1", "T_2", "T_b")]
    lags = sorted(-1.0 / np.linalg.eigvals(linearise(p).A[np.ix_(chain, chain)]).real / MINUTE)
    fastest = 2.0 * q.v_0 if math.isinf(pull) else q.v_0 + min(pull, q.v_0)
    temperatures = zip(("heater T_1", "crucible T_2", "melt T_b"), p.state_0[2:], strict=True)
    return {
        "crystal": f"{2 * q.r_0 / MM:.4g} mm in diameter, {q.v_0 / MM_PER_MIN:.4g} mm/min, "
        f"{q.rho_s * math.pi * q.r_0**2 * q.v_0 * HOUR:.3g} kg/h",
        "heater power": f"{p.Q_H_0 / KILO:.4g} kW",
        "temperatures": ", ".join(f"{name} {T:.0f} K ({T - CELSIUS:.0f} °C)" for name, T in temperatures),
        "meniscus": f"{p.h_0 / MM:.3g} mm high, within {HEIGHT_MIN / MM:.3g} to {HEIGHT_MAX_IN_A * p.a / MM:.3g} mm",
        "radius": f"poles {model.poles[0]:.3g} and {model.poles[1]:.3g} rad/s in Model I at a constant melt "
        f"temperature; lost at {puller.radius_limit / MM:.3g} mm from the reference",
        "left alone": ", ".join(f"Model {name} {_left_alone(q, lam)}" for name, lam in (("I", 1.0), ("II", 0.0))),
        "bright ring": f"{p.ring_bias / MM:.3g} mm outside the crystal, zero at {model.zero:.3g} rad/s",
        "ring exists": _ring_exists(puller),
        "hot zone": f"time constants {', '.join(f'{lag:.3g}' for lag in lags)} min",
        "pull speed": f"{(2.0 * q.v_0 - fastest) / MM_PER_MIN:.4g} to {fastest / MM_PER_MIN:.4g} mm/min"
        + _stated(puller, "pull_slew"),
        "heater": f"{max(p.Q_H_0 - power, 0.0) / KILO:.4g} to {(p.Q_H_0 + power) / KILO:.4g} kW"
        + _stated(puller, "heater_slew", "heater_step", "heater_lag", "heater_dead_time"),
        "sensors": f"every {puller.control_interval:g} s"
        + _stated(puller, "camera_noise", "pyrometer_noise", "latency", "pyrometer_filter"),
    }


def _ring_exists(puller: PullerFile) -> str:
    """Say where along the crystal the meniscus is steep enough to mirror the crucible's wall into the file's camera: in
    a body, along its recipe, and down to which height of the meniscus.
    """
    q, p = puller.parameters, make_puller(puller.parameters)
    view = make_view(camera_for(q, puller.pose(q)))

    def needed(r_c: float, h_c: float) -> float:
        return wall_edge(make_scene(r_c, h_c, p), view).slope

    steep, slope = math.degrees(0.5 * math.pi - q.alpha_0), math.degrees(needed(q.r_0, p.h_0))
    if math.isnan(slope):
        return f"nowhere in a body: the meniscus rises by {steep:.3g} deg at the crystal, too little for the camera"
    text = f"in a body, whose meniscus rises by {steep:.3g} deg at the crystal (the camera needs {slope:.3g})"
    low, high = HEIGHT_MIN, p.h_0
    for _ in range(20):
        low, high = (middle, high) if math.isnan(needed(q.r_0, middle := 0.5 * (low + high))) else (low, middle)
    text += f" at heights of {high / MM:.3g} mm and more"
    try:
        constants, table = nominal_recipe(complete(q, puller), HURLE)
    except CzError:
        return text
    rows = slice(recipe.MARGIN, recipe.ROWS - recipe.MARGIN, 3)
    along, heights = lengths(constants)[rows], table[rows, recipe.RecipeRow._fields.index("h_c")]
    radii = [float(recipe.shape_at(L, constants, Episode()).r) for L in along]
    seen = [bool(sight.shows_ring(r_c, float(h_c), constants)) for r_c, h_c in zip(radii, heights, strict=True)]
    ends = np.flatnonzero(np.diff(np.concatenate([[0], seen, [0]])))
    parts = ", ".join(f"{along[a] / MM:.0f} to {along[b - 1] / MM:.0f}" for a, b in ends.reshape(-1, 2))
    return f"{text}; along its recipe's crystal at {parts or 'no'} mm"


def _left_alone(parameters: Parameters, lam: float) -> str:
    """Say how a small error grows without a controller, by the fastest pole of the plant with its melt."""
    growth = np.linalg.eigvals(linearise(make_puller(parameters, lam)).A).real.max()
    return f"grows to e times its size in {1.0 / growth / MINUTE:.3g} min" if growth > 0.0 else "dies out"


def _stated(puller: PullerFile, *symbols: str) -> str:
    """Write the numbers of these symbols that the puller's file states, in the shown units."""
    text = ""
    for quantity in (MACHINE[symbol] for symbol in symbols):
        if (value := value_of(puller, quantity)) is not None:
            ends = dict.fromkeys(f"{end / quantity.size:g}" for end in np.atleast_1d(value))
            text += f"; {quantity.symbol.replace('_', ' ')} {' to '.join(ends)} {quantity.shown}"
    return text


def margins(puller: PullerFile) -> str:
    """Margins of the controllers that are searched for a puller, as they are designed for it now, as a table."""
    config = make_config(RANDOMIZED, observation="measured", action="direct", puller=puller)
    rows = [(each.name, *row) for each in (*PIDS, *LQGS) if each.near for row in shown(each.make(config), config)]
    return f"{aligned(('controller', *HEADS), rows)}\n\n{filled(explained(puller))}"


CRYSTALS = 20
"""Validation crystals of a prediction."""


def pid_numbers(puller: PullerFile) -> str:
    """Numbers of the PIDs that are searched for a puller, in the forms of control computers, as a table."""
    config = make_config(RANDOMIZED, observation="measured", action="direct", puller=puller)
    named = [(each.name, each.make(config)) for each in PIDS if each.near] + [("fallback", fallback(config).pid)]
    columns = [{"": name} | _numbers_of(controller, config) for name, controller in named]
    rows = [[head, *(column[head] for column in columns)] for head in list(columns[0])[1:]]
    return aligned(("", *(name for name, _ in named)), [tuple(row) for row in rows])


def _numbers_of(controller: Any, config: Config) -> dict[str, str]:
    """Numbers of one PID, by name."""
    form, compensator, heater = StandardPID.of(controller.pid), controller.compensator, controller.heater
    P, I, D = form.parallel()
    error = metrics(rollout(controller, config, VALIDATION_SEEDS[:CRYSTALS])).rmse_mm
    (mean,) = means(error[None, :, None], Resamples.draw(CRYSTALS))
    pull = config.puller.pull_room
    reach = min(pull, config.parameters.v_0)
    ends = (f"{(config.parameters.v_0 + end) / (MM / HOUR):.4g}" for end in (-reach, reach))
    time = form.filter_share * form.T_d
    per_diameter = 0.5 * HOUR * form.gain
    return {
        "ISA: gain [mm/min per mm of radius]": f"{form.gain * MINUTE:.5g}",
        "ISA: T_i [s], T_d [s]": f"{form.T_i:.5g}, {form.T_d:.5g}",
        "parallel: P [1/s], I [1/s2], D [-]": f"{P:.5g}, {I:.5g}, {D:.5g}",
        "parallel: filter of D [s]": f"{time:.4g}",
        "panel: diameter gain [mm/h per mm]": f"{per_diameter:.5g}",
        "panel: integral [1/min], derivative [min]": f"{MINUTE / form.T_i:.5g}, {form.T_d / MINUTE:.5g}",
        "panel: limits of the lift [mm/h]": " to ".join(ends),
        "PID_Compact: Gain, Ti [s], Td [s]": f"{form.gain * MINUTE:.5g}, {form.T_i:.5g}, {form.T_d:.5g}",
        "PID_Compact: TdFiltRatio; PWeighting, DWeighting": f"{form.filter_share:.4g}; 1, 1",
        "before it: filter of the ring [s]": f"{controller.T_f:.4g}",
        "before it: compensator": "none"
        if compensator is None
        else f"{compensator.gain:.5g} s / ((s + "
        f"{compensator.fast:.4g})(s + {compensator.slow:.4g})) from the pull speed",
        "heater: gain [kW/K], T_i [s] on T_1": f"{heater.K / KILO:.4g}, {heater.T_i:.5g}",
        "heater: share of the recipe that is followed": f"{heater.share:.4g}",
        "heater: its set point by the pull [K per %], T_i [s], filter [s]": "none"
        if heater.K_pull == 0.0
        else f"{heater.K_pull * PERCENT:.4g}, {heater.T_pull:.5g}, {heater.T_mean:.4g}",
        f"predicted RMSE [mm], {CRYSTALS} crystals, 95 %": mean.text(".3f"),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = OneLineParser("cz-gym puller", "Print what a puller file implies.")
    parser.add_argument("puller", metavar="FILE.toml", help="puller file, or the name of a shipped one")
    parser.add_argument("--pid", action="store_true", help="print PIDs in the forms of control computers, and no more")
    return parser.run(_main, arguments, "plant", "nothing printed")


def _main(given: argparse.Namespace) -> None:
    puller = find_puller(given.puller)
    if given.pid:
        print(f"puller {puller.label}\n\n{pid_numbers(puller)}")
        return
    taken, sizes = defaults_of(puller), {each.key: each.size for each in MACHINE.values()}
    lines = implied(puller) | {
        "as the default": ", ".join(f"{key} = {value / sizes[key]:.10g}" for key, value in taken.items()),
        "as the scenario": ", ".join(key for key in puller.missing if key not in taken),
    }
    print(f"puller {puller.label}")
    for heading, text in lines.items():
        print(filled(text or "nothing", f"{heading:<15} ", " " * 16))
    print(f"\n{margins(puller)}")
    for doubt in doubts(puller):
        print(doubt, file=sys.stderr)
