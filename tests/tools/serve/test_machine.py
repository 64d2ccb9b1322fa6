"""The machine behind the tags: whose setpoints act, what is refused, and a clock that nothing delays."""

import math
import pickle
import time

import numpy as np
import pytest

from cz_gym.config import make_config
from cz_gym.crystal.process import CRYSTAL
from cz_gym.puller.file import PullerFile
from cz_gym.support.errors import CzError
from cz_gym.tools.export.block import SETPOINT_NAMES
from cz_gym.tools.serve.machine import Clock, CrystalMachine, LogFile, Machine, PullerAlarm, StateFile

PULL, HEATER = SETPOINT_NAMES


def machine(watchdog=60.0, log=None, state=None, **settings):
    return Machine(make_config("randomized", None, "measured", action="direct", **settings), 1, watchdog, log, state)


def test_setpoints_act_once_the_step_they_answer_is_written_and_not_before():
    one = machine()
    assert one.write_setpoints({PULL: 1.5}) == {}
    one.step()
    assert one.step()["pull_speed_mm_per_min"] == pytest.approx(1.2, abs=0.1), "the fallback's"
    assert one.write_setpoints({PULL: 1.5, HEATER: 58.0, "watchdog": 2}) == {}
    tags = one.step()
    assert tags["pull_speed_mm_per_min"] == pytest.approx(1.5)
    assert tags["heater_power_kW"] == pytest.approx(58.0)
    assert (tags["control"], tags["alarms"], tags["step"], tags["watchdog"]) == ("client", 0, 3, 2)


def test_a_refused_value_refuses_all_that_came_with_it():
    one = machine()
    low, high = one.limits[HEATER]
    for bad in (math.nan, math.inf, -math.inf, high + 1e-3, low - 1e-3):
        assert list(one.write_setpoints({PULL: 1.5, HEATER: bad, "watchdog": 0})) == [HEATER]
    assert one.answered == -1
    assert one.write_setpoints({PULL: one.limits[PULL][1], HEATER: low, "watchdog": 0}) == {}
    for step in (0, 1):
        assert list(one.write_setpoints({"watchdog": step})) == ["watchdog"], "answered, and not begun"


def test_applied_drives_are_shown_within_their_limits():
    """An action is in single precision: 1.3 mm/min was applied as 1.300000012."""
    one = machine(puller=PullerFile(pull_window=0.1 / 6e4, heater_range=1234.5))
    for end in (0, 1):
        setpoints = {name: float(np.float32(limits[end])) for name, limits in one.limits.items()}
        assert one.write_setpoints(setpoints | {"watchdog": one.k}) == {}, "rounding of a Float is forgiven"
        row = one.step()
        for applied, (low, high) in zip(("pull_speed_mm_per_min", "heater_power_kW"), one.limits.values(), strict=True):
            assert low <= row[applied] <= high
            assert row[applied] == pytest.approx((low, high)[end], rel=1e-7)


def drive(one, steps):
    """Half of the steps have setpoints of a client; the others are held, or the fallback's."""
    for _ in range(steps):
        if one.k % 40 < 20:
            one.write_setpoints({PULL: 1.2 + 0.001 * (one.k % 7), "watchdog": one.k})
        one.step()
    return list(one.hour)


def test_a_crystal_goes_on_from_its_state_as_if_nothing_had_happened(tmp_path):
    """The process ends after a row was logged and before its state was saved; the log is one of many parts."""
    whole = drive(machine(watchdog=30.0, horizon=1500.0), 300)
    log, file = tmp_path / "log.csv", StateFile(tmp_path / "state")
    first = machine(30.0, LogFile(log, 4096), file, horizon=1500.0)
    drive(first, 195)
    first._state = None
    drive(first, 1)
    second = machine(30.0, LogFile(log, 4096), file, horizon=1500.0)
    assert second.k == 195, "the fallback controls, and has a memory"
    assert drive(second, 105) == whole[195:]
    parts = [log, *sorted(tmp_path.glob("log-?.csv"))]
    times = [np.genfromtxt(part, delimiter=",", names=True)["time_s"] for part in parts]
    assert np.concatenate(times).tolist() == [row["time_s"] for row in whole]
    assert len(parts) == 5
    assert max(part.stat().st_size for part in parts) < 4096 + 100
    with pytest.raises(CzError, match="has ended \\(end of the run\\): name another file"):
        machine(30.0, None, file, horizon=1500.0)


def test_a_state_of_other_settings_or_a_damaged_one_is_refused_in_one_line(tmp_path):
    file = StateFile(tmp_path / "state")
    drive(machine(state=file, horizon=1500.0), 2)
    with pytest.raises(CzError, match=r"horizon 1500\.0, not 3000\.0"):
        machine(state=file, horizon=3000.0)
    whole, saved = file.path.read_bytes(), file.load()
    halfway = len(whole) // 2
    for damaged in (b"", whole[:-100], whole[:halfway] + b"CZOCHRALSKI" + whole[halfway + 11 :], pickle.dumps(print)):
        file.path.write_bytes(damaged)
        with pytest.raises(CzError, match="state: no state of a virtual puller"):
            machine(state=file, horizon=1500.0)
    for odd in ({"tags": {}}, {"memory": saved.memory[1:]}, {"attributes": {"step": None}}):
        file.save(saved._replace(**odd))
        with pytest.raises(CzError, match="another version of cz_gym, or damaged"):
            machine(state=file, horizon=1500.0)


def test_setpoints_that_are_not_renewed_are_held_and_then_the_fallback_takes_over_without_a_jump():
    one = machine(watchdog=30.0)
    one.write_setpoints({PULL: 1.5, HEATER: 57.5, "watchdog": 0})
    rows = [one.step() for _ in range(8)]
    assert [row["control"] for row in rows] == ["client", *["held"] * 5, *["fallback"] * 2]
    assert [row["alarms"] for row in rows] == [0, *[PullerAlarm.HELD] * 5, *[PullerAlarm.FALLBACK] * 2]
    assert [row["pull_speed_mm_per_min"] for row in rows[:7]] == pytest.approx([1.5] * 7), "its first is the held one"
    rows += [one.step() for _ in range(1900)]
    moves = np.abs(np.diff([row["pull_speed_mm_per_min"] for row in rows[6:]]))
    assert (moves[:12] <= moves.max() * np.arange(1, 13) / 12.0).all(), "its authority grows over a minute"
    assert moves.max() < 0.25
    assert all(row["state"] == "growing" for row in rows)
    assert abs(rows[-1]["ring_radius_mm"] - rows[-1]["ring_bias_mm"] - rows[-1]["r_ref_mm"]) < 1.5
    one.write_setpoints({PULL: 1.3, HEATER: 57.0, "watchdog": 1908})
    assert one.step()["control"] == "client"


def test_the_operator_takes_control_and_gives_it_back():
    one = machine(watchdog=10.0)
    assert list(one.set_manual({PULL: 9.0, HEATER: 57.0})) == [PULL]
    assert one.set_manual({PULL: 1.4, HEATER: 57.0}) == {}
    assert one.write_setpoints({"watchdog": 0}) == {"watchdog": "the operator has control"}
    rows = [one.step() for _ in range(10)]
    assert {(row["control"], row["alarms"]) for row in rows} == {("manual", PullerAlarm.MANUAL)}
    assert [row["pull_speed_mm_per_min"] for row in rows] == pytest.approx([1.4] * 10)
    assert one.set_manual({}) == {}
    assert [one.step()["control"] for _ in range(3)] == ["held", "fallback", "fallback"]


def test_a_lost_crystal_raises_an_alarm():
    one = machine()
    while not one.over:
        one.write_setpoints({PULL: 0.0, "watchdog": one.k})
        tags = one.step()
    assert tags["alarms"] & PullerAlarm.ENDED
    assert "frozen" in tags["state"] or "lost" in tags["state"]


def test_a_clock_makes_up_for_what_it_missed_and_does_not_drift():
    """A publisher that blocks for 0.3 s, more than twenty steps, costs none of them."""
    one, times = machine(), []

    def published(tags):
        times.append(time.monotonic())
        if tags["step"] == 20:
            time.sleep(0.3)

    clock = Clock(one, 400.0, True, published)
    clock.start()
    time.sleep(0.1)
    assert one.k == 0, "it waits for the first setpoints"
    one.write_setpoints({"watchdog": 0})
    begin = time.monotonic()
    while one.k < 120:
        time.sleep(0.001)
    clock.stopped.set()
    clock.join()
    lag = np.array(times) - begin - np.arange(1, len(times) + 1) * 5.0 / 400.0
    assert lag.min() > -0.02
    assert lag[60:].min() < 0.05, "it has caught up"
    assert any(row["alarms"] & PullerAlarm.LATE for row in one.hour)
    assert [row["step"] for row in one.hour] == list(range(one.k + 1))


def test_an_error_in_the_clock_reaches_whoever_waits():
    sent = []
    one = machine(horizon=10.0)
    one.step = lambda: 1 / 0
    clock = Clock(one, 1e6, False, sent.append)
    clock.start()
    clock.join(10.0)
    assert sent == [{}]
    assert isinstance(clock.error, ZeroDivisionError)


@pytest.mark.slow
def test_a_crown_without_setpoints_completes_under_the_fallback_and_goes_on_from_its_state(tmp_path):
    file = StateFile(tmp_path / "state")

    def grown(last, state=None):
        config = make_config("puller", None, "measured", action="direct", process=CRYSTAL, stage="crown")
        one = CrystalMachine(config, 1, 60.0, None, state)
        return [one.step() for _ in iter(lambda: one.over or one.k >= last, True)]

    whole = grown(10_000)
    assert grown(400, file) == whole[:400]
    assert grown(10_000, file) == whole[400:], "the fallback has a memory"
    assert whole[-1]["state"] == "grown: the length is reached"
    assert {row["control"] for row in whole} == {"fallback"}
    assert [*dict.fromkeys(row["stage"] for row in whole)] == ["crown", "body"]
    assert (np.diff([row["length_mm"] for row in whole]) > 0.0).all()
    assert whole[-1]["weight_kg"] > 5.0 > 0.2 > whole[0]["weight_kg"]
    assert max(abs(row["ring_radius_mm"] - row["ring_bias_mm"] - row["r_ref_mm"]) for row in whole) < 8.0


def test_setpoints_of_a_crystal_are_absolute_and_those_of_the_recipe_follow_it():
    config = make_config("nominal", None, "measured", action="direct", process=CRYSTAL, stage="crown")
    one = CrystalMachine(config, 1, 60.0)
    for _ in range(200):
        recipe = [one.hour[-1][name] for name in ("pull_speed_recipe_mm_per_min", "heater_power_recipe_kW")]
        assert one.write_setpoints(dict(zip(SETPOINT_NAMES, recipe, strict=True)) | {"watchdog": one.k}) == {}
        row = one.step()
        assert [row[applied] for applied in SETPOINT_NAMES.values()] == pytest.approx(recipe, rel=1e-6)
        assert row["ring_radius_mm"] - row["ring_bias_mm"] == pytest.approx(row["r_ref_mm"], abs=0.05)
    assert one.write_setpoints({PULL: 2.0, HEATER: 50.0, "watchdog": one.k}) == {}
    row = one.step()
    assert (row["pull_speed_mm_per_min"], row["heater_power_kW"]) == pytest.approx((2.0, 50.0))
    assert list(one.write_setpoints({PULL: 4.0})) == [PULL]
