"""The design table: what its rows are made of, and the command."""

import math

import numpy as np
import pytest
from scipy.integrate import trapezoid

from cz_gym import make_puller
from cz_gym.baselines.analysis.frequency import loop_margins, response
from cz_gym.baselines.analysis.linear_form import linear_form
from cz_gym.baselines.analysis.sampled_loop import close, late, linear_controller, root_mean_square
from cz_gym.baselines.pid.compensated_pid import CompensatedPID
from cz_gym.baselines.registry import find_controller
from cz_gym.config import make_config
from studies.design_table import __main__ as design_table

pytest.importorskip("control")


def test_settings_of_another_scenario_follow_with_its_latency():
    """A controller with settings of its own on puller has rows for them; one without has none."""
    rows, _ = design_table.table(["paper", "pid-conventional"], 1, ("puller",))
    assert [row.controller for row in rows[::3]] == ["paper", "pid-conventional", "pid-conventional on puller"]
    form = linear_form(find_controller("pid-conventional").make(make_config("puller")))
    expected = loop_margins(late(form.controller, 1), make_puller(lam=0.0), 5.0)
    assert rows[7].plant == "Model II"
    assert rows[7].figures["delay"] == expected.delay


@pytest.mark.parametrize("tau", [30.0, 780.0])
def test_fluctuation_is_the_integral_of_its_spectrum(tau):
    loop = close(linear_controller(CompensatedPID()), make_puller(), 5.0)
    omega = np.concatenate([np.geomspace(1e-7, 1e-3, 2000), np.linspace(1e-3, np.pi / 5.0, 4000)[1:]])
    keep = math.exp(-5.0 / tau)
    spectrum = (1.0 - keep**2) / np.abs(1.0 - keep * np.exp(-5.0j * omega)) ** 2
    gain = np.abs(response(loop.pick("r_c", ("dT_i",)), 5.0, omega))
    variance = trapezoid(gain**2 * spectrum, omega) * 5.0 / np.pi
    assert root_mean_square(design_table.coloured(loop, tau)) == pytest.approx(math.sqrt(variance), rel=1e-3)


def test_worst_takes_each_column_at_its_worst():
    row = design_table.Row("c", "p", dict.fromkeys(design_table.COLUMNS, 1.0))
    other = {"gain_up": 0.5, "gain_down": 0.1, "noise_gain": 3.0, "stable": 0.0, "delay": math.nan}
    found = design_table.worst([row, row._replace(figures=row.figures | other)], "both").figures
    expected = {"gain_up": 0.5, "gain_down": 1.0, "noise_gain": 3.0, "stable": 0.5, "delay": 1.0}
    assert {name: found[name] for name in expected} == expected


def test_command_writes_the_table(tmp_path, capsys):
    assert design_table.main(["--controllers", "paper", "open-loop", "--pullers", "2", "--out", str(tmp_path)]) == 0
    text = (tmp_path / "design.md").read_text()
    assert text == capsys.readouterr().out
    heads, _, *rows = (
        [cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line[:1] == "|"
    )
    assert [row[1] for row in rows] == ["Model I", "Model II", "worst of 2"]
    assert float(rows[0][heads.index("crossover compensated")]) == pytest.approx(0.031, abs=0.001)
    assert text.endswith("No linear form: open-loop: there is no loop.\n")
