"""A block beside readings that are given: a recorded test vector for a port, and a plant's log for a comparison."""

from typing import Any

import numpy as np

from cz_gym.evaluation.report.tables import markdown
from cz_gym.support.units import KILO, MINUTE, MM, MM_PER_MIN

from .ports import INPUTS, OUTPUTS, Alarm, meanings
from .shell import Block
from .trace import Floats

SAMPLES = 240
"""Calls of a test vector."""
HEAD = ",".join(port.name for port in (*INPUTS, *OUTPUTS))


def test_vector(block: Block) -> str:
    """Inputs and outputs of calls one after the other, as CSV: takeover, bad readings, late calls, gaps, fallback.

    Settings are the defaults, logical inputs 0 and 1; the drives follow the setpoints of the call before.
    """
    random, known = np.random.default_rng(1), {port.name: port.default for port in block.program.settings}
    dt, lines, memory, time = block.config.control_interval, [HEAD], block.start(1), 0.0
    given: dict[str, float] = {port.name: port.default for port in INPUTS}
    given |= {port.name: known["nominal_radius_mm"] for port in INPUTS if port.name.startswith("r_ref")}
    given |= {port.name: known["nominal_T_1_K"] for port in INPUTS if port.name.startswith("T_1")}
    pull, heater = known["nominal_pull_speed_mm_per_min"], known["nominal_heater_power_kW"]
    for k in range(SAMPLES):
        time += dt * {70: 0.3, 72: 2.4, 74: 3.2, 150: 1e3}.get(k, 1.0)
        given |= {"time_s": time, "ring_time_s": time - 30.0 * dt * (k in (80, 81)), "automatic": float(k > 3)}
        ring = known["nominal_radius_mm"] + known["ring_bias_mm"] + random.normal(0.0, 0.03)
        given |= {"ring_radius_mm": ring + 50.0 * (k == 60), "valid": float(k not in (50, 51) and k < 170)}
        given["T_1_K"] = known["nominal_T_1_K"] + random.normal(0.0, 0.1) + 20.0 * (90 <= k < 120)
        given |= {"T_1_K": np.nan} if 120 <= k < 130 else {}
        given |= {"pull_speed_mm_per_min": pull, "heater_power_kW": heater}
        outputs, memory = block.run(given, memory)
        pull, heater, alarms = (float(outputs[port.name][0]) for port in OUTPUTS)
        lines.append(",".join(f"{value:.17g}" for value in (*given.values(), pull, heater, alarms)))
    return "\n".join(lines) + "\n"


def beside(block: Block, log: Any) -> tuple[Floats, Floats]:
    """Setpoints [mm/min, kW] that a block gives on a log, each from the drives of its row, and its alarms; per row."""
    memory, rows = block.start(1), []
    radius, T_1 = (block.ports[name].default for name in ("nominal_radius_mm", "nominal_T_1_K"))
    r_ref = np.where(np.isfinite(log.r_ref), log.r_ref / MM, radius)
    T_1_ref = np.where(np.isfinite(log.T_1_ref), log.T_1_ref, T_1)
    for k, time in enumerate(log.time):
        later = {"": k, "_1min": k + round(MINUTE / log.interval), "_5min": k + round(5.0 * MINUTE / log.interval)}
        given = {f"r_ref{name}_mm": r_ref[min(at, len(r_ref) - 1)] for name, at in later.items()}
        given |= {f"T_1_ref{name}_K": T_1_ref[min(at, len(T_1_ref) - 1)] for name, at in later.items()}
        drives = log.v_p[k] / MM_PER_MIN, log.Q_H[k] / KILO
        given |= {"pull_speed_mm_per_min": drives[0], "heater_power_kW": drives[1], "T_1_K": log.T_1[k]}
        given |= {"time_s": time, "ring_time_s": time, "ring_radius_mm": log.ring[k] / MM}
        memory = memory._replace(pull=np.full(1, drives[0]), heater=np.full(1, drives[1]))
        outputs, memory = block.run(given | {"valid": float(np.isfinite(log.ring[k]))}, memory)
        rows.append([outputs[port.name][0] for port in OUTPUTS])
    outputs_of_rows = np.array(rows)
    return outputs_of_rows[:, :2], outputs_of_rows[:, 2].astype(int)


def shadow(block: Block, log: Any) -> dict[str, str]:
    """A table of the setpoints, as CSV, and a report that compares them with the drives of a log; by file name."""
    setpoints, alarms = beside(block, log)
    drives = np.stack([log.v_p / MM_PER_MIN, log.Q_H / KILO], axis=-1)
    held = np.vstack([drives[1:], drives[-1:]])  # a row's setpoint is what the next row shows as applied
    names, rows = [port.name for port in OUTPUTS[:2]], []
    for name, each in zip(names, (setpoints - held).T, strict=True):
        figures = each.mean(), np.sqrt(np.mean(each**2)), *np.quantile(each, [0.05, 0.95])
        rows.append((name, *(f"{value:.4g}" for value in figures)))
    said = [
        (bit.name, f"{100.0 * np.mean(alarms & bit > 0):.3g}", text)
        for bit, text in meanings(Alarm).items() if np.any(alarms & bit)
    ]  # fmt: skip
    heads = "setpoint", "mean difference", "RMS", "5 % quantile", "95 % quantile"
    report = (
        f"# {block.name} beside a log\n\n{len(log.time)} rows over {log.time[-1] / MINUTE:.4g} min. In every row the "
        "block starts from the applied drives; its setpoint is compared with what the present loop applied next.\n\n"
        f"{markdown(heads, rows)}\n\n{markdown(('alarm', 'share of rows [%]', 'meaning'), said)}\n"
    )
    table = np.column_stack([log.time, held, setpoints, alarms])
    head = ",".join(("time_s", *(f"applied_{name}" for name in names), *names, "alarms"))
    lines = (",".join(f"{value:.10g}" for value in row) for row in table)
    return {"shadow.csv": "\n".join((head, *lines)) + "\n", "README.md": report}
