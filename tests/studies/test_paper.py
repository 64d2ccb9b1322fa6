"""The command that redoes Part II: its numbers against published and analytic ones, its files, its errors."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from cz_gym import make_puller
from cz_gym.baselines import CompensatedPID
from cz_gym.baselines.pid.compensated_pid import SeriesPID
from cz_gym.body.linearisation import radius_model
from studies.paper import __main__ as paper
from studies.paper import comparison
from studies.paper.experiments import BARE, errors, inverse_response, pull_change, ramp, ramp_numbers, trace
from studies.paper.figures import FIGURES


@pytest.fixture(scope="module")
def numbers():
    return json.loads(json.dumps(comparison.numbers(), allow_nan=False))


def test_the_committed_numbers_come_out(numbers):
    committed = json.loads((Path(__file__).parents[2] / "results" / "paper" / "numbers.json").read_text())
    assert list(numbers) == list(committed)
    for quantity, found in numbers.items():
        assert found["ours"] == pytest.approx(committed[quantity]["ours"], rel=1e-4), quantity


@pytest.mark.slow
def test_the_command_writes_the_report_with_its_figures(tmp_path, numbers, monkeypatch):
    """With two cut-offs, for speed."""
    monkeypatch.setattr(paper, "CUT_OFFS", (2e-4, 2e-3))
    assert paper.main(["--out", str(tmp_path)]) == 0
    assert json.loads((tmp_path / "numbers.json").read_text()) == numbers
    written = (tmp_path / "report.md").read_text()
    assert {path.name for path in tmp_path.iterdir()} == {*FIGURES} | {"report.md", "numbers.json"}
    for figure in FIGURES:
        assert (tmp_path / figure).read_bytes().startswith(b"\x89PNG")
        assert figure in written
    assert "nan" not in written
    for printed in ("0.03275", "do not follow from the", "-0.22517", "0.001884", "3.368e-07", "chain does not depend"):
        assert printed in written


def test_without_the_compensator_the_ramp_loses_the_crystal_or_cycles():
    """Model II is lost; Model I cycles between the pull limits, nearer to its radius than the printed controller."""
    bare = {m: ramp(m, BARE) for m in ("I", "II")}
    assert bare["II"].failed
    assert not bare["I"].failed
    cycle, printed = (ramp_numbers(run) for run in (bare["I"], ramp("I")))
    assert cycle["at_limit"] > 0.3 > 0.001 > printed["at_limit"]
    assert cycle["late_swing_mm"] < 2.0
    assert cycle["rmse_mm"] < 0.5 < printed["rmse_mm"]


def test_inverse_response_against_a_double_integrator():
    """With both poles near zero a small step gives r_br = n dv (lead t + constant t^2 / 2), a parabola."""
    puller = make_puller(lam=0.0)
    model = radius_model(puller)
    change = -1e-3
    depth, recovery = inverse_response(pull_change("II", change, over=1e-6, horizon=300.0), change)
    rate = abs(model.numerator * puller.v_0 * change)
    assert depth == pytest.approx(rate * model.lead**2 / (2.0 * model.constant), rel=0.01)
    assert recovery == pytest.approx(2.0 / model.zero, rel=0.01)


def test_growth_rate_of_model_ii_does_not_depend_on_the_meniscus():
    """Its growth rate does not depend on the meniscus; the thermal chain depends on neither model."""
    v_g = {model: pull_change(model).signals.v_g for model in ("I", "II")}
    assert np.ptp(v_g["II"]) < 1e-12 * v_g["II"][0]
    assert np.ptp(v_g["I"]) > 0.01 * v_g["I"][0]
    for name in ("T_1", "T_1_ref", "T_b"):
        np.testing.assert_array_equal(*(getattr(ramp(m).signals, name) for m in ("I", "II")))


def test_compensated_measurement_is_what_the_controller_saw():
    """r_tilde, through the printed PID, gives back the pull speed that was applied."""
    pid, dt = SeriesPID(), 5.0
    run = trace(CompensatedPID(), "I", "paper-ramp", horizon=3600.0)
    b_0, b_1, a_1 = pid.lead(dt)
    lead = lfilter([b_0, b_1], [1.0, a_1], errors(run)[1])
    integral = lfilter([0.5 * dt / pid.T_i, 0.5 * dt / pid.T_i], [1.0, -1.0], lead)
    expected = run.signals.v_p[0] + pid.K_p * (lead + integral)
    np.testing.assert_allclose(run.signals.v_p[1:], expected[:-1], atol=1e-3 * run.signals.v_p[0])
