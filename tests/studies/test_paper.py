"""Part II redone, and the Bode plot of any controller: published and analytic numbers, files, errors."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from cz_gym import make_puller
from cz_gym.baselines import CompensatedPID, analysis
from cz_gym.baselines.analysis import loop_margins
from cz_gym.baselines.pid import SeriesPID
from cz_gym.body.process import radius_model
from cz_gym.process import PULL_SCALE
from cz_gym.support.units import MM
from cz_gym.tools import bode
from studies.paper import __main__ as paper
from studies.paper.experiments import BARE, errors, inverse_response, pull_change, ramp, ramp_numbers, trace
from studies.paper.figures import FIGURES


@pytest.fixture(scope="module")
def numbers():
    return json.loads(json.dumps(paper.numbers(), allow_nan=False))


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
    for printed in ("0.03275", "do not follow from the", "-0.22517", "0.001884", "3.368e-07"):
        assert printed in written


@pytest.mark.parametrize("model", ["I", "II"])
def test_without_the_compensator_the_ramp_loses_the_crystal_at_the_limits_of_the_pull_speed(model):
    bare, printed = ramp(model, BARE), ramp(model)
    assert bare.failed
    assert not printed.failed
    assert ramp_numbers(bare)["at_limit"] > 0.2 > 0.001 > ramp_numbers(printed)["at_limit"]


def test_inverse_response_against_a_double_integrator():
    """With both poles near zero a small step gives r_br = n dv (lead t + constant t^2 / 2), a parabola."""
    puller = make_puller(lam=0.0)
    model = radius_model(puller)
    change = -1e-3
    depth, recovery = inverse_response(pull_change("II", change, over=1e-6, horizon=300.0), change)
    rate = abs(model.numerator * puller.v_0 * change)
    assert depth == pytest.approx(rate * model.lead**2 / (2.0 * model.constant), rel=0.01)
    assert recovery == pytest.approx(2.0 / model.zero, rel=0.01)


def test_growth_rate_of_model_ii_follows_the_melt_and_not_the_meniscus():
    puller = make_puller(lam=0.0)
    one, two = (pull_change(model).signals for model in ("I", "II"))
    slower = puller.k_l * (two.T_b - puller.T_b_0) / puller.h_0 / puller.rho_dH
    np.testing.assert_allclose(two.v_g, puller.v_0 - slower, rtol=1e-12)
    assert np.ptp(one.v_g) > 0.05 * puller.v_0 > 9.0 * np.ptp(two.v_g)
    first, second = (ramp(model).signals for model in ("I", "II"))
    np.testing.assert_allclose(first.T_b, second.T_b, rtol=0.0, atol=0.1)


def test_compensated_measurement_is_what_the_controller_saw():
    """r_tilde, through the printed PID, gives back the pull speed that was applied."""
    pid, dt = SeriesPID(), 5.0
    run = trace(CompensatedPID(), "I", "paper-ramp", horizon=3600.0)
    b_0, b_1, a_1 = pid.lead(dt)
    lead = lfilter([b_0, b_1], [1.0, a_1], errors(run)[1])
    integral = lfilter([0.5 * dt / pid.T_i, 0.5 * dt / pid.T_i], [1.0, -1.0], lead)
    expected = run.signals.v_p[0] + pid.K_p * (lead + integral)
    np.testing.assert_allclose(run.signals.v_p[1:], expected[:-1], atol=1e-3 * run.signals.v_p[0])


OWN = """
import numpy as np
class Forgetful:
    gains = [0.0, 0.0]
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.outer(np.atleast_2d(observation)[:, 0], self.gains), state
class Gain(Forgetful):
    gains = [0.02, 0.0]
"""


def test_a_controllers_margins_are_the_design_tables(tmp_path, capsys):
    assert bode.main(["lqg", "--out", str(tmp_path / "lqg.png")]) == 0
    assert (tmp_path / "lqg.png").read_bytes().startswith(b"\x89PNG")
    form = bode.form_of("lqg")
    expected = loop_margins(form.controller, make_puller(lam=0.5), form.dt)
    assert f"| ring | {expected.crossover:.2e} | {expected.gain_up:.3g} |" in capsys.readouterr().out


def test_phases_are_read_against_minus_180_degrees():
    """The phase above -180 degrees at a gain of one is python-control's phase margin."""
    form, puller = bode.form_of("paper"), make_puller(lam=1.0)
    omega, found = analysis.frequencies(form.dt), loop_margins(form.free, puller, form.dt, "v_p")
    phase = bode.phase_of(analysis.response(analysis.opened(form.free, puller, form.dt, "v_p"), form.dt, omega))
    assert -360.0 <= phase[0] < 0.0
    at = np.argmin(np.abs(np.log(omega / found.crossover)))
    assert phase[at] + 180.0 == pytest.approx(found.phase_deg, abs=1.0)


def test_a_gain_alone_in_a_file_of_one_s_own_needs_neither_memory_nor_interval(tmp_path):
    (tmp_path / "my.py").write_text(OWN)
    form = bode.form_of(f"{tmp_path / 'my.py'}:Gain")
    assert (form.dt, form.controller.A.shape) == (5.0, (0, 0))
    assert form.controller.D[0, 0] == pytest.approx(0.02 * PULL_SCALE / MM)
    assert loop_margins(form.controller, make_puller(), form.dt).crossover > 0.0


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["lqgg"], "did you mean 'lqg'"),
        (["open-loop"], "there is no loop"),
        (["my.py:Forgetful"], "there is no loop: nothing"),
        (["nowhere.py:Mine"], "no such file"),
        (["lqg", "--mix", "2"], "must lie in"),
    ],
)
def test_a_controller_without_a_bode_plot_is_refused_in_one_line(given, said, tmp_path, monkeypatch, refused):
    (tmp_path / "my.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    assert said in refused(bode.main, given)
