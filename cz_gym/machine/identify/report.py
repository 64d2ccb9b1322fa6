"""Report of an identification: Markdown with two pictures."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cz_gym.body.plant import make_puller
from cz_gym.evaluation.report.canvas import COLOURS, GREY, INK, canvas, png
from cz_gym.evaluation.report.tables import markdown
from cz_gym.physics.parameters import describe
from cz_gym.support.units import HOUR, KILO, MM, MM_PER_MIN, PERCENT

from .estimate import Estimate, Identified
from .grid import Log
from .model import Lags
from .verdict import COLOURED, coloured

SENSORS = "pyrometer", "ring"
CALLIPER = 0.05 * MM
"""Error of a calliper's reading of the radius [m]."""
OTHERS = {
    "lam": ("lam dT_0", "K"),
    "camera_sd": ("camera noise", "m"),
    "pyrometer_sd": ("pyrometer noise", "K"),
    "fast_sd": ("melt, fast fluctuation", "K"),
    "slow_sd": ("melt, slow fluctuation", "K"),
    "load_rate": ("hot zone, rate of drift", "1/s"),
    "heater_lag": ("heater's lag", "s"),
    "heater_dead_time": ("heater's dead time", "s"),
    "pyrometer_filter": ("pyrometer's filter", "s"),
}
"""Names and units of the numbers that are no parameters."""
HEADS = "number", "unit", "start", "log", "95 % interval", "uncertainty left [%]", "verdict"


def report(identified: Identified, log: Log | Sequence[Log], source: str, path: Path) -> dict[Path, bytes]:
    """The files of a report, its text at ``path``: what the log ``source`` tells of a puller, and what it does not."""
    readings, numbers = (path.with_name(f"{path.stem}-{name}.png") for name in ("readings", "numbers"))
    told = sum(e.informed for e in identified.estimates)
    moves = zip(("pull speed", "heater"), identified.excitation, strict=True)
    correlations = [f"{name} {coloured(errors):.2f}" for name, errors in zip(SENSORS, identified.errors.T, strict=True)]
    logs = (log,) if isinstance(log, Log) else log
    notes = ["; ".join(each.notes) or "nothing was left out" for each in logs]
    lines = [f"- {len(each.time)} rows of {each.interval:g} s; {note}." for each, note in zip(logs, notes, strict=True)]
    text = f"""# {identified.verdict[0].upper() + identified.verdict[1:]}

The log {source} tells {told} of {len(identified.estimates)} numbers of the puller {identified.start.name};
the others keep the start's values.

{markdown(HEADS, map(_row, (*identified.estimates, *identified.noise)), "---")}

"Uncertainty left" compares the estimate's standard deviation with the start's; below 50 % the log tells the number.
A log gives lam and dT_0 only as their product, the delays of the heater's path best as their sum, and no phi_b.

![start and estimates]({numbers.name})

## Excitation

{chr(10).join(f"- {name}: {_moved(share)}" for name, share in moves)}

## Predicted and measured

![readings and their prediction errors]({readings.name})

Largest correlation of the prediction errors: {", ".join(correlations)}. Above {COLOURED:g} something moves the readings
that the model does not have.

## What one calliper reading would add

{_calliper(identified)}

## The log

{chr(10).join(lines)}
"""
    return {path: text.encode(), readings: _readings(identified), numbers: _numbers(identified)}


def _row(e: Estimate) -> tuple[str, ...]:
    name, unit = OTHERS.get(e.name) or (e.name, describe()[e.name].unit)
    if not e.excited:
        return name, unit, f"{e.prior:.4g}", "-", "-", "-", "not estimated: its drive was not excited"
    verdict = "told" if e.informed else "this log says nothing about it" if e.trusted else "not to be trusted"
    if e.name in Lags._fields and not e.trusted:
        verdict = "no delay, or none that this log shows"
    interval = f"{e.low:.4g} to {e.high:.4g}"
    return name, unit, f"{e.prior:.4g}", f"{e.value:.4g}", interval, f"{e.left / PERCENT:.0f}", verdict


def _moved(share: float) -> str:
    if share >= 1.0:
        return f"moves of its own, {share:.3g} times what is needed"
    return (
        f"{share:.2g} of the moves that are needed (the pull speed's count only beside the heater's). The readings "
        "explain the others, as a controller's moves, and such a log misleads: the numbers of this drive were not "
        "estimated. `identify.Excited` makes the moves."
    )


def _calliper(identified: Identified) -> str:
    """What the ring's offset would say of phi_b if the crystal's radius were known."""
    parameters = (identified.start if identified.misfits else identified.puller).parameters
    log, step = identified.log, 1e-4
    ring = make_puller(parameters).ring_bias
    slope = (make_puller(parameters._replace(phi_b=parameters.phi_b + step)).ring_bias - ring) / step
    meant = np.where(np.isfinite(log.r_ref), log.r_ref, parameters.r_0)
    middle = float(np.nanmedian(log.ring - meant))
    return (
        f"The ring is {middle / MM:.2f} mm outside the reference, in the middle of the log; with phi_b = "
        f"{np.degrees(parameters.phi_b):.2f} deg it is {ring / MM:.2f} mm outside the crystal. The log cannot say how "
        f"much of the difference is an error of the radius. A calliper reading of the crystal, to {CALLIPER / MM:g} mm "
        f"of its radius, gives phi_b to {np.degrees(CALLIPER / abs(slope)):.2g} deg, and with it the true radius."
    )


def _readings(identified: Identified) -> bytes:
    """Drives, readings with their predictions, and prediction errors, as PNG."""
    figure, log, hours = canvas(8.0, 8.0), identified.log, identified.log.time / HOUR
    drives, ring, pyrometer, errors = figure.subplots(4, 1, sharex=True)
    drives.plot(hours, log.v_p / MM_PER_MIN, color=COLOURS[1], lw=0.8, label="pull speed [mm/min]")
    power = drives.twinx()
    power.plot(hours, log.Q_H / KILO, color=COLOURS[0], lw=0.8, label="heater power [kW]")
    for axis, values, error, size, label in (
        (ring, log.ring, identified.predicted.error[:, 1], MM, "ring radius [mm]"),
        (pyrometer, log.T_1, identified.predicted.error[:, 0], 1.0, "T_1 [K]"),
    ):
        axis.plot(hours, values / size, ".", color=GREY, ms=2, label="measured")
        axis.plot(hours, (values - error) / size, color=COLOURS[1], lw=0.8, label="predicted")
        axis.set_ylabel(label)
    for sensor, name in enumerate(SENSORS):
        errors.plot(hours, identified.errors[:, sensor], ".", color=COLOURS[sensor], ms=2, label=name)
    drives.set_ylabel("pull speed [mm/min]", color=COLOURS[1])
    power.set_ylabel("heater power [kW]", color=COLOURS[0])
    errors.set(xlabel="time [h]", ylabel="error / its sd [-]", ylim=(-5.0, 5.0))
    for axis in (ring, errors):
        axis.legend(fontsize=7.5, frameon=False, ncols=2)
    return png(figure)


def _numbers(identified: Identified) -> bytes:
    """Start and estimates with their 95 % intervals, relative to the start, as PNG."""
    figure = canvas(7.0, 4.5)
    axis = figure.subplots()
    shown = [e for e in identified.estimates if e.name not in Lags._fields]
    for y, e in enumerate(shown):
        colour = COLOURS[1] if e.informed else GREY
        axis.plot([max(e.low, 0.0) / e.prior, e.high / e.prior], [y, y], color=colour, lw=2)
        axis.plot(e.value / e.prior, y, "o", color=colour)
    axis.axvline(1.0, color=INK, lw=0.8)
    axis.set_yticks(range(len(shown)), [OTHERS.get(e.name, (e.name,))[0] for e in shown])
    axis.invert_yaxis()
    axis.set_xlabel("estimate / start [-]; grey: this log says nothing about it")
    return png(figure)
