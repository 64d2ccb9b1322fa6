"""The Bode plot of any controller: the design table's margins, and one line where there is none."""

import numpy as np
import pytest

from cz_gym.baselines.analysis import loop_margins
from cz_gym.physics.plant import make_puller
from cz_gym.process import PULL_SCALE
from cz_gym.support.units import MM
from studies import bode

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
    omega, found = bode.frequencies(form.dt), loop_margins(form.free, puller, form.dt, "v_p")
    phase = bode.phase_of(bode.response(bode.opened(form.free, puller, form.dt, "v_p"), form.dt, omega))
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
