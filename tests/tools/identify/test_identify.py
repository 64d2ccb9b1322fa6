"""Identification: exact derivatives and predictions, what a log can and cannot tell; the command and the study."""

import re
import shutil
from dataclasses import replace
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest

from cz_gym import CzEnv, Parameters, make_puller
from cz_gym.baselines.analysis import Lags as AllLags
from cz_gym.baselines.margins import NO_MARGIN, Openings, worst_margins
from cz_gym.baselines.policy import OpenLoop
from cz_gym.config import make_config
from cz_gym.episodes.scenario import Reference
from cz_gym.puller.file import DEFAULT, find_puller, read_puller, write_puller
from cz_gym.spaces import HEATER_RANGE, MEASURED, TargetEnv, decode
from cz_gym.support.errors import CzError
from cz_gym.support.units import MM
from cz_gym.tools import posterior
from cz_gym.tools.identify import Excited, command, identify, read_log, record_log
from cz_gym.tools.identify import model as model_of_log
from cz_gym.tools.identify.command import puller_text
from cz_gym.tools.identify.estimate import HEATER, LAGS, PULL, coloured, misfits
from cz_gym.tools.identify.log import Log, prepare, shift_drives
from cz_gym.tools.identify.model import LAM, Lags, Model, NoiseLevels, heating, predict, sensitivities
from cz_gym.tools.identify.moves import CHIPS, SEQUENCE, measure_excitation
from cz_gym.tools.posterior import Posterior, explained, quantiles
from cz_gym.tools.registry import make_controller
from examples import identify as example
from studies import identify as study
from studies.identify import draw, write_logs
from tests.foreign_puller import SLOW, ZONE, ForeignPuller, Operator, drive, write_log
from tests.other_machine import MACHINE, block_for, file_of, hold
from tests.tools.identify.conftest import OWN, TRUTH


@pytest.mark.parametrize(("interval", "off"), [(5.0, 3e-4), (10.0, 3e-4)])
def test_without_noise_the_filter_of_the_true_puller_predicts_every_reading(interval, off, tmp_path):
    """The filter's first guess parts the ring's offset between camera and radius, by 0.3 mm, which the melt feels."""
    env = CzEnv("nominal", 0.5, "measured", interval, 3600.0, parameters=TRUTH, action="direct", info="all")
    record_log(env, Excited(OpenLoop(), heater=0.01), tmp_path / "log.csv", seed=0)
    log, model = read_log(tmp_path / "log.csv"), Model(("C_1",), TRUTH)
    assert np.ptp(log.T_1) > 1.0
    assert np.abs(predict(log, model, np.zeros(1)).error[1:]).max() < off
    assert np.abs(predict(log, model, np.array([0.05])).error[:, 0]).max() > 0.02


def test_derivatives_are_those_of_the_filter(logs):
    log = Log(*(each[:400] if isinstance(each, np.ndarray) else each for each in read_log(logs[0])))
    model = Model((*HEATER, *LAGS, *PULL, *NoiseLevels._fields), Parameters(), lags=Lags(2.0, 1.3, 2.0))
    theta = model.mean + 0.05
    out, *exact = sensitivities(log, model, theta)
    for j, name in enumerate(model.names):
        step = 1e-3 if name in LAGS else 1e-5
        up, down = (predict(log, model, theta + sign * step * np.eye(len(theta))[j]) for sign in (1.0, -1.0))
        for part in (0, 1):
            differences = (up[part] - down[part]).real / (2.0 * step)
            scale = np.abs(differences).max(axis=0) + 1e-4 * np.sqrt(out.variance).max(axis=0)
            assert np.abs((exact[part][j] - differences) / scale).max() < 2e-3, name


@pytest.mark.parametrize(("dead_time", "lag"), [(0.0, 0.0), (7.5, 0.0), (5.0, 12.0)])
def test_the_heat_is_the_power_late_and_slow(dead_time, lag):
    power, dt, fine = np.repeat([6e4, 7e4, 5e4], 40), 5.0, 100
    parts = [np.full(9, np.nan)] * 7
    log = Log(dt * np.arange(120), *parts[:2], power, *parts[:3], np.zeros(120, bool), np.zeros((120, 2)), dt)
    late, heat, means = np.repeat(power, fine), 6e4, []
    late = np.concatenate([np.full(round(dead_time / dt * fine), 6e4), late])[: len(late)]
    for target in late:
        heat = target if lag == 0.0 else target + (heat - target) * np.exp(-dt / fine / lag)
        means.append(heat)
    exact = np.reshape(means, (-1, fine)).mean(axis=1)
    np.testing.assert_allclose(heating(log, Lags(lag, dead_time)).real, exact, rtol=1e-3)


@pytest.mark.slow
def test_slow_drives_count_and_a_limit_does_not(tmp_path):
    for seed in range(5):
        for moves, limits in ((0.025, SLOW), (0.0, SLOW), (0.0, {})):
            puller = ForeignPuller(seed=seed, **limits)
            rows = drive(puller, Operator(puller, seed, (moves, moves)).setpoints)
            log = read_log(write_log(tmp_path / "log.csv", rows))
            cut = [np.mean(np.abs(move) > 0.98 * np.abs(move).max()) for move in (np.diff(log.v_p), np.diff(log.Q_H))]
            assert not limits or min(cut) > 0.4
            start = replace(DEFAULT, parameters=DEFAULT.parameters._replace(v_0=puller.z.v_0))
            assert (np.array(measure_excitation([log], start)) >= 1.0).all() == (moves > 0.0)


def test_excitation_counts_where_the_pyrometer_shows_the_heater_at_once(tmp_path):
    """A law that sees the heater's effect in seconds follows its steps, though no reading asked for them."""
    start, truth = draw(6)
    excited, passive = (measure_excitation([read_log(log)], start) for log in write_logs(truth, 6, tmp_path))
    assert min(excited) > 5.0
    assert max(passive) < 0.5


def test_steps_of_a_heater_that_no_controller_moves_count(tmp_path):
    env = CzEnv(OWN, 0.5, "measured", parameters=TRUTH, action="direct", info="all")
    pid = make_controller("pid-conventional", env.config)
    by_hand = replace(pid, heater=replace(pid.heater, K=1e-9))
    record_log(env, Excited(by_hand, heater=0.01), tmp_path / "log.csv", seed=3)
    assert min(measure_excitation([read_log(tmp_path / "log.csv")])) > 5.0


@pytest.mark.parametrize("size", [0.015, 0.03])
def test_a_step_test_counts(size, tmp_path):
    """Steps of 3 and 6 % beside a controller, a few in three hours; of 2 % it takes a dozen at the pull."""
    env = CzEnv(OWN, 0.5, "measured", parameters=TRUTH, action="direct", info="all")
    pid = make_controller("pid-conventional", env.config)
    record_log(env, Excited(pid, size, size, clock=600.0, limit=5.0 * MM), tmp_path / "log.csv", seed=3)
    assert min(measure_excitation([read_log(tmp_path / "log.csv")])) >= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper-tuned", "lqg-at-0.02", "pid-conventional"])
def test_controllers_alone_excite_nothing_whatever_their_law(name, tmp_path):
    """The LQG alone leaves pull moves of 25 times what is needed that no linear law explains (seed 7)."""
    for seed in (1, 2, 7, 9):
        env = CzEnv("puller", observation="measured", action="direct", info="all")
        record_log(env, make_controller(name, env.config), tmp_path / "log.csv", seed)
        assert max(measure_excitation([read_log(tmp_path / "log.csv")])) < 0.5


@pytest.mark.slow
def test_the_information_of_two_logs_adds_up(logs, found):
    steps: list[int] = []
    both = identify([read_log(logs[0])] * 2, progress=lambda: steps.append(1))
    assert not both.misfits
    assert len(steps) > 1
    assert both.excitation == pytest.approx(np.multiply(2.0, found.excitation))
    assert len(both.log.time) == 2 * len(found.log.time)
    pairs = [pair for pair in zip(found.estimates, both.estimates, strict=True) if pair[0].informed]
    ratios = [two.left / one.left for one, two in pairs if one.left < 0.3]
    assert len(ratios) > 4
    np.testing.assert_allclose(ratios, 0.5**0.5, rtol=0.1)  # the priors of other numbers count once


def test_thinned_rows_are_not_late(logs):
    log = read_log(logs[0])
    thin = prepare(log._replace(interval=1.0, time=log.time / 5.0))
    assert (thin.interval, thin.mean_of) == (11.0, 11)
    ramp = prepare(log._replace(interval=1.0, time=log.time / 5.0, T_1=log.time / 5.0, Q_H=log.time / 5.0))
    np.testing.assert_allclose(ramp.T_1, ramp.time, atol=1e-9)
    np.testing.assert_allclose(ramp.Q_H[2:], ramp.time[2:] - 5.0, atol=1e-9)
    np.testing.assert_array_equal(shift_drives(log).Q_H[1:], log.Q_H[:-1])


def test_a_log_with_excitation_tells_the_hot_zone(found):
    told = {e.name: e for e in found.estimates if e.informed}
    assert found.settled
    assert not found.misfits
    assert not found.delayed
    assert {"C_1", "C_2", "kappa_12", "G_1a", "G_2b", "eps"} <= set(told)
    assert np.mean([e.low < getattr(TRUTH, e.name, LAM * TRUTH.dT_0) < e.high for e in told.values()]) >= 0.85
    learned = found.puller.parameters
    np.testing.assert_allclose([learned.C_1, learned.C_2], [TRUTH.C_1, TRUTH.C_2], rtol=0.05)
    changed = {name for name in Parameters._fields if getattr(learned, name) != getattr(Parameters(), name)}
    assert changed == set(told) - {"lam", *LAGS}, "what the log does not tell keeps its value"
    assert min(found.excitation) > 5.0
    assert max(map(coloured, found.errors.T)) < 0.1


def test_coloured_errors_that_no_camera_would_show_are_no_misfit(found):
    """A log whose camera has no noise shows how exact the model is, to some micrometres."""
    slow = np.convolve(np.random.default_rng(0).standard_normal(len(found.errors)), np.ones(9), "same")
    for size, said in ((0.004 * MM, 0), (0.03 * MM, 1)):
        error = np.stack([found.predicted.error[:, 0], size * slow / slow.std()], axis=1)
        errors = np.stack([found.errors[:, 0], slow], axis=1)
        doubted = replace(found, errors=errors, predicted=found.predicted._replace(error=error))
        puller = make_puller(found.puller.parameters)
        assert sum("ring are coloured" in each for each in misfits(doubted, puller, {})) == said


def test_a_ring_that_is_not_the_file_s_is_a_misfit(found):
    """The file's ring stands elsewhere, or moves otherwise with the meniscus, than the log's."""
    puller = make_puller(found.puller.parameters)
    assert not [each for each in misfits(found, puller, {}) if "ring" in each]
    (said,) = misfits(found, make_puller(found.puller.parameters._replace(sigma=1.09)), {})
    assert said.startswith("its ring is 17.3 mm outside the crystal where the log's is 14.4 mm outside the reference")
    (said,) = misfits(replace(found, ring_gain=(1.6, 0.1)), puller, {})
    assert said == "the log's ring moves 1.6 times as much with the meniscus' height as the file's"
    assert abs(np.log(found.ring_gain[0])) < 2.0 * found.ring_gain[1] < 1.0


def test_material_constants_have_the_priors_of_handbooks(found):
    assert {name: found.sds[name] for name in ("sigma", "k_l", "rho_l", "alpha_0", "C_1")} == {
        "sigma": 0.05, "k_l": 0.1, "rho_l": 0.01, "alpha_0": 0.1, "C_1": 0.35,
    }  # fmt: skip
    sigma = next(e for e in found.estimates if e.name == "sigma")
    assert sigma.high / sigma.low < np.exp(2.0 * 1.97 * 0.05)
    assert found.puller.fluctuation_sd is not None


@pytest.mark.slow
def test_a_log_of_a_controller_alone_tells_nothing(logs):
    passive = identify(read_log(logs[1]))
    assert max(passive.excitation) < 0.5
    assert not any(e.informed or e.excited for e in passive.estimates)
    assert passive.puller.parameters == Parameters()


def test_a_log_quicker_than_its_controller_is_no_more_excited(logs):
    for path, enough in zip(logs, (True, False), strict=True):
        log = read_log(path)
        quick = log._replace(**{name: np.repeat(getattr(log, name), 5) for name in Log._fields[:9]}, interval=1.0)
        assert (min(measure_excitation([quick], DEFAULT)) > 1.0) is enough
        assert (max(measure_excitation([quick], DEFAULT)) > 1.0) is enough


@pytest.mark.parametrize("action", ["direct", "smooth", "rate"])
def test_the_drives_follow_the_sequence_whatever_the_action_means(action):
    class Rest(OpenLoop):
        """Nominal drives, which are the ones that it sees."""

        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            seen = decode(observation)
            assert abs(seen.v_p) < 1e-10
            assert abs(seen.Q_H) < 1e-2
            return super().predict(observation, state, episode_start, deterministic)

    Rest.action, size = action, 0.003  # what a smooth drive can do in one step
    env = CzEnv("nominal", 0.5, "measured", action=action, info="all")
    excited, state = Excited(Rest(), size, size), None
    observation, start = env.reset(seed=0)
    for k in range(60):
        chosen, state = excited.predict(observation, state)
        observation, _, _, _, info = env.step(chosen)
        assert info["v_p"] / start["v_p"] - 1.0 == pytest.approx(size * SEQUENCE[k // 12], abs=1e-6)
        other = size * SEQUENCE[k // 12 + CHIPS // 2]
        assert info["Q_H"] - start["Q_H"] == pytest.approx(other * start["Q_H"], abs=2e-6 * HEATER_RANGE)


def test_excitation_stops_for_good_beyond_a_radius_error():
    excited = Excited(OpenLoop(), limit=1.5e-3)
    near, far = np.zeros((2, 1, len(MEASURED)), np.float32)
    near[:, 1] = far[:, 1] = 1.0
    far[:, 0] = 1.6
    action, state = excited.predict(near)
    assert np.abs(action).min() > 0.02
    for seen, begins, moves in ((far, False, False), (near, False, False), (near, True, True)):
        action, state = excited.predict(seen, state, np.array([begins]))
        assert bool(np.abs(action).any()) is moves
    with pytest.raises(CzError, match="amplitudes"):
        Excited(OpenLoop(), pull=0.5)
    agent = SimpleNamespace(control_interval=2.0, made_for=TargetEnv("rate", 2.0, "1234", "mine (5678)"))
    with pytest.raises(CzError, match="does not say its puller's numbers"):
        Excited(agent)


def test_coloured_errors_are_told_from_white_ones_and_from_the_rotation_s():
    white = np.random.default_rng(1).standard_normal(2000)
    white[100:150] = np.nan
    ripple = np.sin(2.1 * np.arange(2000))
    assert coloured(white + ripple) < 0.15 < coloured(white[1:] + 0.3 * white[:-1])


def test_a_load_that_warmer_graphite_balances_leaves_the_melt_at_rest(logs):
    """Cooler graphite cools the melt for its own time, then the difference dies out."""
    log, model = read_log(logs[0]), Model(("camera_sd",), TRUTH)
    p = model.puller(np.zeros(1, np.complex128))
    at_rest = np.real([*p.state_0, 0.0, 0.0, -300.0])
    at_rest[3] += 300.0 / TRUTH.G_2b
    at_rest[2] = ((TRUTH.G_2b * (at_rest[3] - at_rest[4])) / TRUTH.kappa_12 + at_rest[3] ** 4) ** 0.25
    assert np.abs(model_of_log.melt_from_start(log, model, np.zeros(1), at_rest)).max() < 0.01
    cooler = at_rest - np.array([0.0, 0.0, 2.0, 2.0, *[0.0] * 4])
    melt = model_of_log.melt_from_start(log, model, np.zeros(1), cooler)
    assert melt[0] == pytest.approx(0.0, abs=1e-9)
    assert -1.5 < melt.min() < -0.3
    assert melt.argmin() < 300


@pytest.mark.slow
def test_the_disturbances_of_a_log_grow_the_same_ring_within_its_noise(tmp_path):
    """Twice the same controller: two logs of equal disturbances differ by the noise of both cameras."""
    own = replace(OWN, reference=Reference())
    env = CzEnv(own, 0.5, "measured", parameters=TRUTH, action="direct", info="all")
    pid = make_controller("pid-conventional", env.unwrapped.config)
    record_log(env, Excited(pid), tmp_path / "log.csv", seed=3)
    words = [str(tmp_path / "log.csv"), "--out", str(tmp_path / "own.toml"), "--series", str(tmp_path / "day.csv")]
    assert command.main(words) == 0
    puller = find_puller(tmp_path / "own.toml")
    again = CzEnv(tmp_path / "day.csv", observation="measured", puller=puller, action="direct", info="all")
    record_log(again, Excited(make_controller("pid-conventional", again.config)), tmp_path / "again.csv", seed=5)
    ring, simulated = (read_log(tmp_path / name).ring for name in ("log.csv", "again.csv"))
    noise = np.sqrt(2.0) * puller.camera_noise[0]
    assert np.std(ring) > 2.0 * puller.camera_noise[0], "there is something to grow again"
    assert np.std(ring - simulated) < 1.2 * noise
    assert np.corrcoef(ring, simulated)[0, 1] > 0.8


# The command: a puller file, a report and pictures; or one line and nothing


def test_the_command_writes_the_puller_and_its_report(logs, found, tmp_path, monkeypatch):
    monkeypatch.setattr(command, "identify", lambda *_, **__: found)
    out = tmp_path / "new" / "my.toml"
    assert command.main([str(logs[0]), "--out", str(out)]) == 0
    files = {file.name for file in out.parent.iterdir()}
    assert files == {"my-numbers.png", "my-readings.png", "my.md", "my.toml"}
    assert (read_puller(out).hash, read_puller(out).name) == (found.puller.hash, "my")
    text = out.with_suffix(".md").read_text()
    assert text.count("| told |") == sum(e.informed for e in (*found.estimates, *found.noise))
    assert "says nothing about it" in text
    assert "calliper" in text
    assert text.startswith("# The model fits the log")


START = """# Line 3, hall B
format = 1
name = "line 3"
[crystal]
radius_mm = 87.5 # drawing 4711
[hot_zone]
C_1_J_per_K = 57000 # graphite, 30 kg
G_2b_W_per_K = 200
"""


def test_the_file_keeps_what_was_known_and_says_where_each_number_is_from(found, tmp_path):
    (tmp_path / "start.toml").write_text(START)
    start = read_puller(tmp_path / "start.toml")
    text = puller_text(replace(found, start=start), "log.csv", "my")
    (tmp_path / "my.toml").write_text(text)
    mine = read_puller(tmp_path / "my.toml")
    assert (mine.name, mine.hash) == ("line 3", found.puller.hash)
    assert {"T_a_K", "sigma_N_per_m"} <= set(mine.missing), "a default is no fact"
    for line in (
        "# Line 3, hall B", "radius_mm = 87.5 # drawing 4711",
        "# identify: T_a_K = 350 (default, nobody has said it)",
        "# identify: sigma_N_per_m = 0.72 (default, nobody has said it; prior, standard deviation 5 % (handbooks of",
    ):  # fmt: skip
        assert f"\n{line}" in f"\n{text}"
    assert re.search(
        r"C_1_J_per_K = [\d.]+ # graphite, 30 kg; identify: estimated, 95 % interval .* start 5.7e\+04\n", text
    )
    assert re.search(r"\[melt\]\nfluctuation_sd_K = \[.*\] # identify: estimated, 95 % intervals: fast .*, slow", text)
    again = puller_text(replace(found, start=mine), "log.csv", "my")
    assert again.count("graphite, 30 kg; identify: ") == 1


def test_margins_are_over_the_posterior_that_the_file_holds(found, tmp_path, capsys):
    (tmp_path / "my.toml").write_text(puller_text(found, "log.csv", "my"))
    mine = read_puller(tmp_path / "my.toml")
    read, told = Posterior.of(mine), found.posterior
    assert (read.names, Posterior.of(found.puller)) == (told.names, None)
    np.testing.assert_allclose(read.covariance, told.covariance, atol=1e-3 * np.diag(told.covariance).max())
    for e in (e for e in found.estimates if e.informed and e.name in Parameters._fields):
        sd = np.sqrt(told.covariance[told.names.index(e.name), told.names.index(e.name)])
        assert np.log(e.high / e.low) == pytest.approx(2 * 1.96 * sd)
    lags = AllLags(5.0, 4.0, 3.0, 2.0)
    draws = [q.C_1 / mine.parameters.C_1 for q, _ in islice(read.draws(mine, lags), 2000)]
    at = read.names.index("C_1")
    assert np.std(np.log(draws)) == pytest.approx(np.sqrt(read.covariance[at, at]), rel=0.1)
    sure = Posterior(("C_1", "heater_dead_time"), np.diag([1e-10, 1e-10]))
    config = make_config("randomized", observation="measured", action="direct", puller=mine)
    lqg = make_controller("lqg", config)
    np.testing.assert_allclose(quantiles(lqg, config, sure, 4), worst_margins(lqg, config, 200), rtol=1e-3)
    late = Posterior(("heater_dead_time",), np.array([[900.0]]))
    assert quantiles(lqg, config, late, 40).heater.delay < quantiles(lqg, config, sure, 4).heater.delay
    assert "drawn from the identification in its file" in explained(mine)
    (tmp_path / "my.toml").write_text("format = 1\n# identify: posterior C_1 x\n")
    with pytest.raises(CzError, match="damaged: identify the puller again"):
        Posterior.of(mine)


def test_a_loop_that_the_posterior_makes_unstable_is_said_to_be(monkeypatch):
    """A phase margin of 0 was printed as "no limit"."""
    config = make_config("randomized", observation="measured", action="direct")
    monkeypatch.setattr(posterior.Posterior, "of", lambda _: posterior)
    monkeypatch.setattr(posterior, "quantiles", lambda *_: Openings(NO_MARGIN, NO_MARGIN, NO_MARGIN))
    rows = posterior.shown(make_controller("lqg", config), config)
    assert len(rows) == 3
    assert all(cell.endswith(" (unstable)") for row in rows for cell in row[1:])


def test_a_model_that_does_not_fit_is_no_result(logs, found, tmp_path, monkeypatch, capsys):
    doubted = [tuple(e._replace(trusted=False) for e in each) for each in (found.estimates, found.noise)]
    odd = replace(found, estimates=doubted[0], noise=doubted[1], misfits=("its T_1 is 1796 K where the log says 1758",))
    monkeypatch.setattr(command, "identify", lambda *_, **__: odd)
    out = tmp_path / "my.toml"
    assert command.main([str(logs[0]), str(logs[0]), "--out", str(out)]) == command.NO_FIT
    assert capsys.readouterr().out.startswith("THE MODEL DOES NOT FIT: its T_1 is 1796 K")
    text = out.with_suffix(".md").read_text()
    assert text.startswith("# THE MODEL DOES NOT FIT: its T_1 is 1796 K")
    assert "| told |" not in text
    assert not out.exists()
    assert command.main([str(logs[0]), "--out", str(out), "--force"]) == command.NO_FIT
    assert read_puller(out).hash == found.puller.hash


@pytest.mark.slow
def test_the_example_goes_from_a_log_to_a_controller(logs, found, tmp_path, monkeypatch):
    monkeypatch.setattr(example, "identify", lambda *_: found)
    out = tmp_path / "my.toml"
    assert 0.0 < example.main(str(logs[0]), out=str(out)) < 0.2
    assert read_puller(out).hash == found.puller.hash
    assert out.with_suffix(".md").is_file()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--out", "my.txt"], "--out must be a file NAME.toml"),
        (["--series", "my.txt"], "--series must be a file NAME.csv"),
        (["--series", "/proc/none/my.csv"], "/proc/none"),
        (["--prior", "C_1"], "--prior C_1: write it as NAME=SD"),
        (["--prior", "C1=0.1"], "did you mean 'C_1'"),
        (["--column", "T_1_K=PYRO"], ".csv has no column PYRO (it has: time_s, ring_radius_mm, "),
        (["--column", "T_1_K=PYRO"], "); --column T_1_K=NAME:K\n"),
        (["--column", "ring_mm=DIA"], "unknown column 'ring_mm': did you mean 'ring_radius_mm'"),
        (["--column", "T_1_K=PYRO:F"], "unknown unit of T_1_K 'F'; choose from K, degC, degF"),
        (["--column", "T_1_K"], "T_1_K: say which column it is"),
        (["--column", "ring_radius_mm=ring_radius_mm:cm"], "is it another puller's log?"),
        (["--puller", "none.toml"], "none.toml: No such file"),
    ],
)
def test_what_is_wrong_is_one_line_and_nothing_is_written(options, said, logs, tmp_path, refused):
    given = options if "--out" in options else [*options, "--out", str(tmp_path / "new" / "my.toml")]
    assert said in refused(command.main, [str(logs[0]), *given])
    assert not (tmp_path / "new").exists()


def test_the_file_to_start_from_is_not_written_over(logs, tmp_path, refused):
    start = tmp_path / "start.toml"
    write_puller(find_puller("default"), start)
    text = start.read_text()
    words = [str(logs[0]), "--puller", str(start), "--out", str(tmp_path / "." / "start.toml")]
    assert "is the file to start from" in refused(command.main, words)
    assert start.read_text() == text


@pytest.mark.slow
def test_the_study_identifies_pullers_that_nobody_knows(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(study, "PULLERS", 3)
    monkeypatch.setattr(study, "CRYSTALS", 4)
    assert study.main(["--out", str(tmp_path)]) == 0
    text = (tmp_path / "pullers.txt").read_text()
    assert text in capsys.readouterr().out
    assert "tell the pull speed's path: 0\n" in text


# A machine that is not ours, from its log to the compiled controller that drives it.

LAG = 10.0
"""The heater's lag, which the start file does not know [s]."""


def held_by(file):
    """Error of a machine under the block exported for a file [mm]."""
    return hold(block_for("lqg", file), ForeignPuller(MACHINE, 100, **SLOW, heater_lag=LAG))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_machine_by_somebody_else_is_logged_identified_designed_for_and_driven(tmp_path):
    puller = ForeignPuller(MACHINE, 1, **SLOW, heater_lag=LAG)
    historian = {"second": 1.0, "jitter": 0.3, "missing_rows": 0.02, "missing_drives": 0.05, "digits": (2, 3, 2, 1)}
    log = write_log(tmp_path / "log.csv", drive(puller, Operator(puller, 1).setpoints), 1, **historian)
    identified = identify(read_log(log), file_of(ZONE))
    assert not identified.misfits
    assert held_by(identified.puller) < 2.0 * held_by(file_of(MACHINE, heater_lag=(LAG, LAG)))
