"""Slow drives against analytic solutions, and readings of the applied drives that err."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from cz_gym import SCENARIOS, CzEnv, CzVectorEnv, decode
from cz_gym.body.process import BODY
from cz_gym.crystal.process import CRYSTAL
from cz_gym.engine.loop import mean_power
from cz_gym.episodes.scenario import DriveReadings
from cz_gym.support.units import KILO, MM_PER_MIN

NOMINAL, KW = SCENARIOS["nominal"], 1000.0


def slow(lag=0.0, dead_time=0.0, tau=0.0):
    return replace(
        NOMINAL,
        name="slow",
        actuators=replace(NOMINAL.actuators, heater_lag=(lag, lag), heater_dead_time=(dead_time, dead_time)),
        sensor=replace(NOMINAL.sensor, pyrometer_filter=(tau, tau)),
    )


class Slot:
    """A slot's numbers that the heater needs."""

    def __init__(self, lag, dead_time, power):
        self.episode, self.Q_heats = self, power
        self.heater_lag, self.heater_dead_time = lag, dead_time


@pytest.mark.parametrize("lag", [0.0, 3.0, 40.0])
@pytest.mark.parametrize("dead_time", [0.0, 7.3, 20.0])
def test_the_plant_gets_the_energy_of_the_analytic_step_response(lag, dead_time):
    """After a step of 1 kW at t = 10 s, in substeps that no control interval or dead time fits."""
    interval, frames, ends = 10.0, np.full((8, 4), 2.0 * KW), np.cumsum([0.0, *([5.0, 2.0, 3.0] * 6)])
    slot, begin = Slot(lag, dead_time, 2.0 * KW), 10.0 + dead_time

    def energy(t):
        after = np.maximum(t - begin, 0.0)
        lagging = lag * -np.expm1(-after / lag) if lag > 0.0 else 0.0
        return 2.0 * KW * t + 1.0 * KW * (after - lagging)

    for start, stop in pairwise(ends):
        slot.k, slot.Q_H = int(start / interval + 1e-9), 3.0 * KW if start >= 10.0 else 2.0 * KW
        mean = mean_power(slot, frames, start, stop, interval)
        assert mean * (stop - start) == pytest.approx(energy(stop) - energy(start), rel=1e-12)


def test_the_heater_s_temperature_answers_the_delayed_power():
    """As that of a heater at once does, a dead time of two intervals later; with a lag it stays behind, and arrives."""
    runs = {}
    for name, scenario in (("at once", slow()), ("late", slow(dead_time=10.0)), ("lagging", slow(lag=60.0))):
        env = CzEnv(scenario, observation="measured", action="direct", info="all")
        env.reset(seed=0)
        runs[name] = np.array([env.step(np.array([0.0, 0.3 * (k > 0)], np.float32))[4]["T_1"] for k in range(60)])
        assert env._batch.memory.slots["Q_H"][0] == pytest.approx(env._batch.memory.slots["puller"]["Q_H_0"][0] + 3e3)
    np.testing.assert_allclose(runs["late"][2:], runs["at once"][:-2], rtol=0.0, atol=2e-6)
    assert (runs["lagging"][1:] < runs["at once"][1:]).all()


def test_the_pyrometer_reads_the_filtered_temperature():
    """The solution of tau y' = T_1 - y for the temperature that moves straight between samples."""
    tau, interval = 30.0, 5.0
    env = CzEnv(slow(tau=tau), observation="measured", action="direct", info="all")
    env.reset(seed=0)
    slots = env._batch.memory.slots
    last = filtered = float(slots["x"]["T_1"][0])
    for _ in range(80):
        T_1 = env.step(np.array([0.0, 0.5], np.float32))[4]["T_1"]
        times = (np.arange(20_000) + 0.5) * interval / 20_000
        fed = (last + (T_1 - last) * times / interval) * np.exp((times - interval) / tau)
        filtered, last = filtered * np.exp(-interval / tau) + fed.mean() * interval / tau, T_1
        assert slots["T_1"][0] == pytest.approx(filtered, abs=1e-6)


def test_the_batch_and_saved_states_know_the_slow_drives():
    settings = {"scenario": slow(20.0, 12.0, 15.0), "observation": "measured", "info": "all"}
    batch, envs = CzVectorEnv(3, **settings), [CzEnv(**settings) for _ in range(3)]
    first = batch.reset(seed=[1, 2, 3])[0], np.stack([env.reset(seed=1 + i)[0] for i, env in enumerate(envs)])
    np.testing.assert_array_equal(*first)
    for k, action in enumerate(np.random.default_rng(0).uniform(-1, 1, (40, 3, 2)).astype(np.float32)):
        if k == 20:
            envs[0].set_state(batch.get_state()[0])
        seen = np.stack([env.step(own)[0] for env, own in zip(envs, action, strict=True)])
        np.testing.assert_array_equal(batch.step(action)[0], seen)


RANDOMIZED = SCENARIOS["randomized"]
ERRING = DriveReadings(
    pull_scale=(0.97, 0.97), pull_offset=(0.04 * MM_PER_MIN, 0.04 * MM_PER_MIN), pull_resolution=0.01 * MM_PER_MIN,
    heater_scale=(1.03, 1.03), heater_offset=(-0.4 * KILO, -0.4 * KILO), heater_resolution=0.1 * KILO, delay=10.0,
)  # fmt: skip


def grown(readings, process=BODY, steps=60):
    """Observations, decoded, and info of one crystal under seeded random actions."""
    env = CzEnv(replace(RANDOMIZED, readings=readings), observation="measured", action="direct", info="all",
                process=process)  # fmt: skip
    rng, seen, told = np.random.default_rng(0), [], []
    observation, info = env.reset(seed=3)
    for _ in range(steps):
        seen.append(decode(observation, *env.config.ranges, process))
        told.append(info)
        observation, *_, info = env.step(rng.uniform(-0.2, 0.2, 2).astype(np.float32))
    return env, seen, told


@pytest.mark.parametrize("process", [BODY, CRYSTAL])
def test_readings_have_scale_offset_resolution_and_delay_and_the_plant_is_the_same(process):
    env, seen, told = grown(ERRING, process)
    _, _, exact = grown(DriveReadings(), process)
    assert [info["r_c"] for info in told] == [info["r_c"] for info in exact]
    for name, scale, offset, step in (("v_p", 0.97, 0.04 * MM_PER_MIN, 0.01 * MM_PER_MIN),
                                      ("Q_H", 1.03, -0.4 * KILO, 0.1 * KILO)):  # fmt: skip
        applied = np.array([told[0][name]] * 2 + [info[name] for info in told])[:-2]
        wanted = step * np.rint((scale * applied + offset) / step)
        puller = env._slots["puller"][0]
        nominal = {"v_p": puller["v_0"], "Q_H": puller["Q_H_0"]}[name]
        if process is CRYSTAL:
            nominal = np.array([info[f"{name}_ref"] for info in told])
        read = np.array([getattr(each, name) for each in seen]) + nominal
        np.testing.assert_allclose(read, wanted, atol=1e-6 * max(abs(wanted)))


def test_a_scale_is_drawn_for_each_crystal_and_drive_and_moves_no_other_draw():
    drawn = CzVectorEnv(500, scenario=replace(RANDOMIZED, readings=DriveReadings(scale_sd=0.01)))
    plain = CzVectorEnv(500, scenario="randomized")
    for env in (drawn, plain):
        env.reset(seed=list(range(500)))
    episodes = [env._batch.memory.slots["episode"] for env in (drawn, plain)]
    scales = np.stack([episodes[0]["pull_scale"], episodes[0]["heater_scale"]])
    np.testing.assert_allclose(scales.mean(axis=1), 1.0, atol=2e-3)
    np.testing.assert_allclose(scales.std(axis=1), 0.01, rtol=0.1)
    assert abs(np.corrcoef(scales)[0, 1]) < 0.1
    assert (episodes[1]["pull_scale"] == 1.0).all()
    for name in set(episodes[0].dtype.names) - {"pull_scale", "heater_scale"}:
        np.testing.assert_array_equal(episodes[0][name], episodes[1][name])


def test_readings_that_are_exact_change_no_hash_and_others_do():
    assert replace(RANDOMIZED, readings=DriveReadings()).hash == RANDOMIZED.hash
    assert replace(RANDOMIZED, readings=DriveReadings(heater_scale=(0.995, 0.995))).hash != RANDOMIZED.hash
    with pytest.raises(ValueError, match=r"readings.heater_scale .*must lie within"):
        replace(RANDOMIZED, readings=DriveReadings(heater_scale=(0.1, 1.0)))
