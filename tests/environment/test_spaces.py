import math
from dataclasses import replace

import numpy as np
import pytest

from cz_gym import SCENARIOS, CzEnv, Scenario, decode
from cz_gym.episodes.scenario import Sensor
from cz_gym.physics.plant import bias_offset, pyrometer_drift
from cz_gym.spaces import HISTORY, LAGGED, LAGS, MEASURED, OBSERVATIONS, lags
from tests.equations import drawn, fields, hold
from tests.observed import PLAIN


def run(env, steps, pull=0.0, seed=1):
    """Observations, infos and the state saved at the start, under a gentle sine or open loop."""
    observation, info = env.reset(seed=seed)
    start = env.get_state().slot
    rows, infos, p = [observation], [info], fields(start.slot["puller"])
    for k in range(steps):
        feedback = hold(info, p.h_0) if pull else 0.0
        action = np.array([pull * np.sin(k / 9.0) + feedback, pull * np.cos(k / 20.0)], np.float32)
        observation, *_, info = env.step(action)
        rows.append(observation)
        infos.append(info)
    return np.array(rows), infos, start


def column(infos, name):
    return np.array([info[name] for info in infos])


def test_every_channel_is_documented():
    assert [len(channels) for channels in OBSERVATIONS.values()] == [12, 73, 18]
    for channels in OBSERVATIONS.values():
        assert len({channel.name for channel in channels}) == len(channels)
        assert all(channel.unit and channel.meaning and channel.scale > 0 for channel in channels)
    assert [channel.name for channel in HISTORY[:12]] == [channel.name for channel in MEASURED]


@pytest.mark.parametrize("scenario", ["randomized", "puller", "sensor-fault"])
def test_measured_holds_what_the_control_computer_has_and_nothing_else(scenario):
    """Each channel is rebuilt from readings and recipes alone; what no instrument shows does not enter."""
    env = CzEnv(scenario, info="all", **PLAIN)
    rows, infos, start = run(env, 400, 0.05)
    p = start.slot["puller"]
    nominal = {name: float(p[name]) for name in ("r_0", "v_0", "T_1_0", "Q_H_0", "ring_bias")}
    e = fields(start.slot["episode"])
    told = {"T_1_0": nominal["T_1_0"] + e.told_temperature, "Q_H_0": nominal["Q_H_0"] + e.told_power}
    seen = decode(rows)
    ring = column(infos, "r_br_measured") - nominal["ring_bias"]
    np.testing.assert_allclose(seen.ring_error, ring - column(infos, "r_ref"), atol=1e-9)
    np.testing.assert_allclose(seen.r_ref, column(infos, "r_ref") - nominal["r_0"], atol=1e-9)
    np.testing.assert_allclose(seen.T_1_ref, column(infos, "T_1_ref") - told["T_1_0"], atol=1e-5)
    np.testing.assert_allclose(seen.v_p, e.pull_scale * column(infos, "v_p") - nominal["v_0"], atol=1e-11)
    np.testing.assert_allclose(seen.Q_H, e.heater_scale * column(infos, "Q_H") - told["Q_H_0"], atol=1e-2)
    assert (told["Q_H_0"] != nominal["Q_H_0"] and e.heater_scale != 1.0) is (scenario == "puller")
    mean, means = 0.0, [0.0]
    for v_p in column(infos, "v_p")[1:] - nominal["v_0"]:
        mean = math.exp(-5.0 / 1800.0) * mean + (1.0 - math.exp(-5.0 / 1800.0)) * v_p
        means.append(mean)
    np.testing.assert_allclose(column(infos, "v_p_mean") - nominal["v_0"], means, atol=1e-17)
    read = e.pull_scale * (np.array(means) + nominal["v_0"]) - nominal["v_0"]
    np.testing.assert_allclose(seen.v_p_mean, read, rtol=1e-6, atol=1e-15)
    assert np.ptp(means) > 1e-3 * nominal["v_0"]
    t = 5.0 * np.arange(401)
    drift = np.array([pyrometer_drift(now, e) for now in t])
    pyrometer = column(infos, "T_1") + drift + drawn(env).noise[:401, 1] - told["T_1_0"]
    np.testing.assert_allclose(seen.T_1, pyrometer, atol=1e-5)
    assert set(np.unique(seen.valid)) <= {0.0, 1.0}


@pytest.mark.parametrize(("interval", "ahead"), [(5.0, (12, 60)), (10.0, (6, 30))])
def test_the_recipe_is_known_one_and_five_minutes_ahead(interval, ahead):
    scenario = Scenario(
        "mine",
        recipe=replace(SCENARIOS["randomized"].recipe, start=(120.0, 120.0)),
        reference=replace(SCENARIOS["reference-b"].reference, start=(60.0, 60.0)),
    )
    seen = decode(run(CzEnv(scenario, control_interval=interval, info="all", **PLAIN), 200)[0])
    assert np.ptp(seen.r_ref) > 0
    assert np.ptp(seen.T_1_ref) > 0
    for now, one, five in ((seen.r_ref, seen.r_ref_1min, seen.r_ref_5min), (seen.T_1_ref, *seen[6:8])):
        np.testing.assert_allclose(one[: -ahead[0]], now[ahead[0] :], rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(five[: -ahead[1]], now[ahead[1] :], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("interval", [2.0, 5.0, 10.0, 60.0])
def test_history_is_differences_of_past_means_and_the_integral(interval):
    arguments = {"control_interval": interval, "info": "all"}
    steps = round(2000 / interval)
    rows, _, _ = run(CzEnv("randomized", observation="history", **arguments), steps, 0.05)
    plain, _, _ = run(CzEnv("randomized", observation="measured", **arguments), steps, 0.05)
    names = [channel.name for channel in HISTORY]
    own = {channel.name: channel.scale for channel in MEASURED}
    ages = lags(interval)
    for channel in LAGGED:
        now_at = [each.name for each in MEASURED].index(channel)
        past = np.full(2000, plain[0, now_at] if channel == "ring_error" else 0.0)
        series = np.concatenate([past, plain[:, now_at].astype(float)])
        for k in (0, 1, 7, len(rows) - 1):
            now, later = 2000 + k, series[2000 + k]
            for lag, newest, oldest in zip(LAGS, *ages, strict=True):
                mean = series[now - oldest : now - newest + 1].mean()
                told = HISTORY[names.index(f"{channel}_{lag:g}s")]
                expected = np.clip((mean - later) * own[channel] / told.scale, -10.0, 10.0)
                assert rows[k, names.index(told.name)] == pytest.approx(expected, rel=1e-4, abs=1e-4), (told.name, k)
                later = mean
    told, known = decode(rows), decode(plain)
    for name, mine, its in zip(told._fields, told, known, strict=True):
        np.testing.assert_allclose(mine, its, rtol=1e-5, atol=1e-6 * max(own[name], 1e-9), err_msg=name)
    steps = np.clip(rows[1:, 0].astype(float), -10, 10) * interval / 1000
    np.testing.assert_allclose(rows[1:, 12], np.cumsum(steps), rtol=1e-4, atol=1e-5)


def test_the_observation_state_is_that_of_the_plant():
    env = CzEnv("puller", observation="state", info="all", action="direct")
    rows, infos, start = run(env, 50, 0.05)
    p, slot = start.slot["puller"], env.get_state().slot.slot
    names = [channel.name for channel in OBSERVATIONS["state"]]
    row = dict(zip(names, rows[-1].astype(float), strict=True))
    assert row["r_c_error"] == pytest.approx((infos[-1]["r_c"] - infos[-1]["r_ref"]) / 1e-3, rel=1e-5)
    assert row["h_c"] == pytest.approx((infos[-1]["h_c"] - p["h_0"]) / 1e-3, rel=1e-5)
    for name in ("T_1", "T_2", "T_b"):
        assert row[name] == pytest.approx((slot["x"][name] - p[f"{name}_0"]) / 5.0, rel=1e-4)
    assert row["dT_i"] == pytest.approx(drawn(env).interface[49], rel=1e-5)
    assert row["Q_d"] == pytest.approx(float(slot["Q_d"]) / 1e3, rel=1e-5)
    assert row["ring_offset"] == pytest.approx(infos[-1]["ring_offset"] / 1e-3, rel=1e-5)
    assert row["lam"] == pytest.approx(float(p["lam"]))


@pytest.mark.parametrize(("interval", "latency"), [(5.0, 5.0), (5.0, 12.0), (2.0, 5.0), (2.0, 60.0), (20.0, 5.0)])
def test_a_late_frame_is_the_newest_old_enough(interval, latency):
    """Frames are taken at samples and on the 5 s grid; the true ring of every second is the oracle."""
    scenario = Scenario("mine", interface=SCENARIOS["hard"].interface, sensor=Sensor(latency=latency))
    every_second = CzEnv(replace(scenario, sensor=Sensor()), control_interval=1.0, info="all", **PLAIN)
    ring = column(run(every_second, 200)[1], "r_br")
    _, infos, _ = run(CzEnv(scenario, control_interval=interval, info="all", **PLAIN), round(200 / interval))
    frames = {*range(0, 201, 5), *range(0, 201, round(interval))}
    for k, measured in enumerate(column(infos, "r_br_measured")):
        t = k * interval
        old_enough = [frame for frame in frames if frame <= t - latency]
        assert measured == pytest.approx(ring[max(old_enough, default=0)], rel=1e-9)
    assert np.ptp(ring) > 1e-5


def test_faulty_camera_shows_the_last_value():
    """Flagged freezes and drop-outs are invalid; the unflagged freeze, outliers and the drifting bias are not."""
    sensor = replace(SCENARIOS["hard"].sensor, outlier_probability=0.01, outlier_sd=1e-3)
    scenario = Scenario("mine", sensor=sensor, faults=SCENARIOS["sensor-fault"].faults)
    env = CzEnv(scenario, info="all", **PLAIN)
    rows, infos, start = run(env, 2160, 0.01, seed=2)
    noise, e, windows = drawn(env).noise, fields(start.slot["episode"]), start.slot["freezes"]
    shown, invalid, silent = np.nan, 0, 0
    for k, info in enumerate(infos):
        t, camera = 5.0 * k, noise[k, 0]
        flagged = any(low <= t < high for low, high in windows[:3])
        frozen = windows[3, 0] <= t < windows[3, 1]
        if not (flagged or frozen or np.isnan(camera)):
            shown = info["r_br"] + bias_offset(t, e) + camera
        assert info["r_br_measured"] == pytest.approx(shown, rel=1e-12)
        assert rows[k, 1] == float(not (flagged or np.isnan(camera)))
        assert info["ring_offset"] == pytest.approx(bias_offset(t, e))
        invalid += flagged or np.isnan(camera)
        silent += frozen
    assert invalid > 6
    assert 6 <= silent <= 12
    assert abs(e.bias_drift_amount) > 0
    assert np.nanmax(np.abs(noise[:, 0])) > 1e-3, "no outlier was drawn"


def test_ring_ripple_is_sampled_at_the_frame():
    scenario = Scenario("mine", sensor=Sensor(ripple=(1e-4, 1e-4), rotation=(11 / 60, 11 / 60)))
    env = CzEnv(scenario, info="all", **PLAIN)
    _, infos, start = run(env, 60)
    phase = float(start.slot["episode"]["ripple_phase"])
    expected = 1e-4 * np.sin(2 * np.pi * 11 / 60 * 5.0 * np.arange(61) + phase)
    np.testing.assert_allclose(column(infos, "r_br_measured") - column(infos, "r_br"), expected, atol=1e-12)


def test_observations_are_clipped_not_lost():
    sensor = Sensor(bias_offset=(5e-3, 5e-3), outlier_probability=1.0, outlier_sd=5e-3)
    observations, infos, _ = run(CzEnv(Scenario("mine", sensor=sensor), info="all", **PLAIN), 50)
    assert column(infos, "r_br_measured").max() > 12e-3 + infos[0]["r_br"]
    assert observations[:, 0].max() == 10.0


def test_decode_takes_any_batch_and_refuses_other_shapes(rng):
    batch = rng.normal(size=(4, 3, 73))
    assert decode(batch).T_1.shape == (4, 3)
    np.testing.assert_allclose(decode(batch).T_1, 5.0 * batch[..., 5] + 2.0 * batch[..., 8])
    np.testing.assert_allclose(decode(batch[..., :12]).T_1, 5.0 * batch[..., 8])
    for wrong in (np.zeros(18), np.zeros(()), np.zeros((12, 2))):
        with pytest.raises(ValueError, match="expected an observation"):
            decode(wrong)
