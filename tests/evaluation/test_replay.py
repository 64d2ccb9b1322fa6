import numpy as np
import pytest

from cz_gym import CzVectorEnv
from cz_gym.baselines import CompensatedPID
from cz_gym.config import make_config
from cz_gym.evaluation.rollout import Playback, replay, rollout
from tests.observed import PLAIN

CONFIG = make_config("puller", horizon=600.0, **PLAIN)
SEEDS = [3, 4, 5]


def equal(one, other, first=0, last=None):
    for a, b in zip(one.signals, other.signals, strict=True):
        np.testing.assert_array_equal(a[first:last], b[first:last])
    np.testing.assert_array_equal(one.reward[first:last], other.reward[first:last])


def actions(steps=120):
    return np.random.default_rng(0).uniform(-0.2, 0.2, (steps, len(SEEDS), 2)).astype(np.float32)


def test_from_the_start_both_are_rollouts_on_the_same_melt():
    found = replay(Playback(actions()), CompensatedPID(), CONFIG, np.array(SEEDS))  # an array, as rollout takes one
    equal(found.actual, rollout(Playback(actions()), CONFIG, SEEDS))
    equal(found.instead, rollout(CompensatedPID(), CONFIG, SEEDS))


@pytest.mark.parametrize("at", [5.0, 300.0, 600.0])
@pytest.mark.parametrize("watches", [False, True])
def test_the_same_controller_instead_changes_nothing(at, watches):
    """A log played back has no memory but its place; a controller that watched itself goes on as it was."""
    found = replay(CompensatedPID(), CompensatedPID(), CONFIG, SEEDS, at, watches)
    equal(found.actual, rollout(CompensatedPID(), CONFIG, SEEDS))
    equal(found.actual, found.instead, 0, round(at / 5.0))
    if watches:
        equal(found.actual, found.instead)


def test_both_runs_are_equal_until_the_takeover_and_share_the_disturbances_after_it():
    found = replay(Playback(actions()), Playback(np.zeros((1, 2))), CONFIG, SEEDS, 300.0)
    equal(found.actual, found.instead, 0, 60)
    assert found.at == 300.0
    assert not np.array_equal(found.actual.signals.r_c[60:], found.instead.signals.r_c[60:])
    for name in ("r_ref", "T_1_ref", "ring_offset"):
        np.testing.assert_array_equal(getattr(found.actual.signals, name), getattr(found.instead.signals, name))
    # By hand: the same actions, then none, on the same seeds.
    env = CzVectorEnv(len(SEEDS), CONFIG.scenario, horizon=600.0, **PLAIN)
    env.reset(seed=SEEDS)
    for k in range(120):
        *_, info = env.step(actions()[k] if k < 60 else np.zeros((len(SEEDS), 2)))
    np.testing.assert_array_equal(found.instead.signals.r_c[-1], info["r_c"])


def test_a_failed_episode_stays_failed():
    config = make_config("hard", horizon=1800.0, **PLAIN)
    found = replay(Playback([[1.0, 0.0]]), Playback([[0.0, 0.0]]), config, SEEDS, 900.0)
    assert found.actual.failed.all()
    np.testing.assert_array_equal(found.instead.failed, found.actual.failed)
    np.testing.assert_array_equal(found.instead.alive, found.actual.alive)


@pytest.mark.parametrize("arguments", [{"seeds": []}, {"at": -1.0}, {"at": 601.0}, {"at": float("nan")}])
def test_bad_arguments_are_refused(arguments):
    with pytest.raises(ValueError, match=r"at least one whole number|must lie in the episode"):
        replay(Playback([[0, 0]]), Playback([[0, 0]]), **{"config": CONFIG, "seeds": SEEDS, **arguments})
    for log in ([], [1.0, 2.0], np.zeros((3, 3)), np.zeros((0, 2))):
        with pytest.raises(ValueError, match="logged actions must be of shape"):
            Playback(log)
