"""Readings of the applied drives that err: scale, offset, resolution, delay; exact, and nothing else, by default."""

from dataclasses import replace

import numpy as np
import pytest

from cz_gym import SCENARIOS, CzEnv, CzVectorEnv, decode
from cz_gym.body.process import BODY
from cz_gym.crystal.process import CRYSTAL
from cz_gym.episodes.scenario import DriveReadings
from cz_gym.support.units import KILO, MM_PER_MIN

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
