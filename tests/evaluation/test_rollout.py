"""Rollouts against the scalar environment, step by step; two controllers on the same melt."""

from dataclasses import replace
from functools import partial
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest

import cz_gym
from cz_gym import CzEnv, CzVectorEnv, Parameters
from cz_gym.agents import load
from cz_gym.baselines import CompensatedPID, OpenLoop
from cz_gym.body.signals import Logged, Measured
from cz_gym.camera import Camera
from cz_gym.config import make_config
from cz_gym.evaluation import plot
from cz_gym.evaluation.protocol import user_controller
from cz_gym.evaluation.rollout import Playback, check_seeds, replay, rollout
from cz_gym.support.errors import CzError
from cz_gym.tools.registry import make_controller
from tests.observed import PLAIN

SHORT = make_config("randomized", horizon=600.0, **PLAIN)


class FullPull:
    """Pulls as fast as it can, which detaches every crystal; notes what it is told."""

    def __init__(self):
        self.told = []

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        self.told.append((np.array(observation), np.array(episode_start)))
        assert deterministic
        assert (state is None) == (len(self.told) == 1)
        return np.tile(np.float32([1.0, 0.2]), (len(observation), 1)), 0


def one_by_one(policy, config, seed):
    """Signals up to the end, return and failure of an episode in the scalar environment."""
    env = CzEnv.from_config(config, info="all")
    observation, _ = env.reset(seed=seed)
    rows = []
    state, total, over, terminated = None, 0.0, False, False
    while not over:
        action, state = policy.predict(observation[None], state, np.array([not rows]), True)
        observation, reward, terminated, truncated, info = env.step(action[0])
        total += reward
        rows.append(info)
        over = terminated or truncated
    return {name: np.array([row[name] for row in rows]) for name in Logged._fields}, total, terminated


def test_a_rollout_looks_through_the_camera_of_its_settings():
    """It was dropped, while the settings' hash said that it was there."""
    near = Camera(tilt=0.4)
    config = make_config("nominal", observation="camera", horizon=10.0, camera=near, action="direct")
    policy = FullPull()
    rollout(policy, config, [3])
    image, _ = CzEnv.from_config(config, info="all").reset(seed=3)
    np.testing.assert_array_equal(policy.told[0][0][0], image)


def check_against_scalar(policy, config, seeds):
    run = rollout(policy, config, seeds)
    for i, seed in enumerate(seeds):
        signals, total, failed = one_by_one(policy, run.config, seed)
        lived = len(signals["r_c"])
        assert run.alive[:, i].sum() == lived
        assert run.alive[:lived, i].all()
        assert run.failed[i] == failed
        assert run.reward[:, i].sum() == pytest.approx(total)
        assert not run.reward[lived:, i].any()
        for name, logged in zip(Logged._fields, run.signals, strict=True):
            np.testing.assert_array_equal(logged[:lived, i], signals[name], err_msg=name)
    return run


def test_every_signal_is_the_scalar_environments():
    check_against_scalar(CompensatedPID(), make_config("sensor-fault", horizon=600.0, **PLAIN), [3, 2_000_000, 17])


def test_failed_episodes_end_where_the_scalar_ones_do():
    run = check_against_scalar(Playback([[1.0, 0.2]]), SHORT, range(5))
    assert run.failed.all()
    assert len(set(run.alive.sum(axis=0).tolist())) > 1


def test_policy_begins_again_where_the_crystal_does():
    """``episode_start`` comes with an episode's first observation: drives at nominal, whatever the policy asks."""
    policy = FullPull()
    run = rollout(policy, SHORT, range(4))
    pull = Measured._fields.index("v_p")
    assert run.failed.all()
    for observation, starts in policy.told:
        np.testing.assert_array_equal(starts, observation[:, pull] == 0.0)
    assert policy.told[0][1].all()
    lived = run.alive.sum(axis=0)
    again = lived < lived.max() - 1  # the rollout ends with the last crystal
    assert sum(starts for _, starts in policy.told[1:]).tolist() == again.tolist()
    assert again.any()


def test_start_is_the_state_before_the_first_step_and_progress_counts_every_step_once():
    counted = []
    run = rollout(OpenLoop(), SHORT, [7, 8, 9], counted.append)
    assert sum(counted) == run.alive.size == 3 * SHORT.steps
    _, info = CzEnv.from_config(SHORT, info="all").reset(seed=7)
    for name, value in zip(Logged._fields, run.start, strict=True):
        assert value[0, 0] == info[name]


OF_ONE = SimpleNamespace(predict=lambda observation, **rest: (np.zeros(2, np.float32), None))
WITHOUT_STATE = SimpleNamespace(predict=lambda observation: (np.zeros((len(observation), 2), np.float32), None))
WITHOUT_TUPLE = SimpleNamespace(predict=lambda observation, **rest: np.zeros((len(observation), 2), np.float32))
RATE = SimpleNamespace(predict=OF_ONE.predict, made_for=make_config(action="rate", observation="measured").made_for)


def test_after_import_cz_gym_everything_is_there():
    assert cz_gym.__getattr__("agents") is import_module("cz_gym.agents")
    with pytest.raises(AttributeError, match="no attribute 'agent'"):
        _ = cz_gym.agent


def test_an_agent_of_another_plant_is_refused_unless_that_is_said():
    agent = load("gradient")
    config = make_config("randomized", parameters=Parameters(k_l=66.0), **{**agent.settings, "horizon": 60.0})
    with pytest.raises(CzError, match=f"made for .*; the environment has .*plant {config.plant_hash}: gym.make"):
        rollout(agent, config, [1])
    there = replace(config, parameters=Parameters())
    assert not rollout(agent, config, [1], designed_for=there).failed.any()
    assert not rollout(SimpleNamespace(predict=agent.predict, made_for=None), config, [1]).failed.any()


@pytest.mark.parametrize("seeds", [[3, 4], (3, 4), range(3, 5), np.array([3, 4]), np.array([3, 4], np.uint8)])
def test_seeds_may_be_any_sequence_of_whole_numbers(seeds):
    assert check_seeds(seeds) == (3, 4)
    assert rollout(OpenLoop(), replace(SHORT, horizon=10.0), seeds).seeds == (3, 4)


def test_a_rollout_can_be_looked_at(tmp_path):
    run = rollout(OpenLoop(), SHORT, [1, 2])
    figure = plot(run, 1, tmp_path / "crystal.png")
    assert (tmp_path / "crystal.png").read_bytes().startswith(b"\x89PNG")
    assert figure.axes[0].get_ylabel() == "crystal radius\n[mm]"
    with pytest.raises(ValueError, match=r"needs a Rollout, not 'paper': .*rollout\(policy, config, seeds\) makes one"):
        plot("paper")
    with pytest.raises(IndexError, match="below 2"):
        plot(run, 2)


@pytest.mark.parametrize("value", [np.nan, "a"])
def test_actions_that_are_none_are_one_line_with_the_file_and_line_of_predict(value):
    class Wrong:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.full((len(observation), 2), value), state

    line = Wrong.predict.__code__.co_firstlineno
    with pytest.raises(CzError, match=rf"^Wrong\.predict \(.*test_rollout\.py:{line}\), step 0: actions must"):
        rollout(Wrong(), make_config(horizon=60.0), [0])


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


NOTHING = Playback([[0, 0]])
POLICIES = [
    (CompensatedPID(control_interval=2.0), SHORT, "made for .*control_interval=2,.* has .*control_interval=5,"),
    (OF_ONE, SHORT, r"actions of shape \(1, 2\) for 1 observations, not \(2,\)"),
    (WITHOUT_STATE, SHORT, r"unexpected keyword argument 'state'; it must be predict\(observation, state=None"),
    (CompensatedPID, SHORT, "is no policy: an object with predict"),
    (lambda observation: observation, SHORT, "is no policy: an object with predict"),
    (WITHOUT_TUPLE, SHORT, r"predict must return a tuple \(action, state\), not ndarray"),
    (CompensatedPID(), make_config(action="smooth", observation="measured"), "made for action='direct'.* has action"),
    (RATE, SHORT, r"made for action='rate'.* has action='direct'"),
    ("paper", SHORT, r"as make_controller\('paper', config\) makes one"),
]
WITH_SEED = partial(rollout, OpenLoop(), seeds=[1])
MAKERS = [CzEnv.from_config, partial(make_controller, "lqg"), partial(load, "ppo"), WITH_SEED]
A_CONFIG = r"needs a Config, not 'hard': cz_gym.config.make_config\('hard'\) makes one"
WHOLE = "seeds must be a sequence of at least one whole number from 0 on"
SEQUENCES = [[], 3, 5.0, "12", [1.0], [[1]], [-1], {1}, np.array([True])]
TAKEOVERS = [({"seeds": []}, "at least one whole number")]
TAKEOVERS += [({"at": at}, "must lie in the episode") for at in (-1.0, 601.0, float("nan"))]


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        *((partial(rollout, policy, config, [1]), ValueError, says) for policy, config, says in POLICIES),
        *((partial(make, "hard"), ValueError, A_CONFIG) for make in MAKERS),
        *((partial(rollout, OpenLoop(), SHORT, seeds), CzError, WHOLE) for seeds in SEQUENCES),
        *(
            (partial(replay, NOTHING, NOTHING, **{"config": CONFIG, "seeds": SEEDS, **given}), ValueError, says)
            for given, says in TAKEOVERS
        ),
        *(
            (partial(Playback, log), ValueError, "logged actions must be of shape")
            for log in ([], [1.0, 2.0], np.zeros((3, 3)), np.zeros((0, 2)))
        ),
    ],
)
def test_what_cannot_be_rolled_out_is_refused(call, error, message):
    with pytest.raises(error, match=message):
        call()


SETTINGS = """
from types import SimpleNamespace
import numpy as np

class Base:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        assert observation.shape[1] == 73
        return np.zeros((len(observation), 2), np.float32), state

class OfClass(Base):
    settings = {"observation": "history", "action": "smooth"}

class OfInstance(Base):
    def __init__(self, config):
        self.settings = {"observation": "history", "action": "smooth", "control_interval": 5.0}

class Attributes(Base):
    observation, action = "history", "smooth"

def factory(config):
    return OfInstance(config)

made = OfClass()

class Slow(Base):
    settings = {"observation": "history", "control_interval": 10.0}

class Germanium(Base):
    settings = {"observation": "history", "puller": "germanium"}

class Unsure(Base):
    observation, settings = "measured", {"observation": "history"}

class Typo(Base):
    settings = {"observations": "history"}

class Repeats(Base):
    settings = {"observation": "history", "action_repeat": 4}

class Text(Base):
    settings = {"control_interval": "5"}

class State(Base):
    settings = {"observation": "state"}

def nothing():
    return SimpleNamespace()
"""


@pytest.fixture
def own(tmp_path):
    (tmp_path / "own.py").write_text(SETTINGS)
    return lambda name: f"{tmp_path / 'own.py'}:{name}"


@pytest.mark.parametrize("name", ["OfClass", "OfInstance", "Attributes", "factory", "made"])
def test_settings_say_what_a_controller_reads_wherever_they_stand(own, name):
    """They were read from two attributes of the class alone, and another observation was shown without a word."""
    contender = user_controller(own(name))
    assert (contender.observation, contender.action, contender.bound) == ("history", "smooth", False)
    config = make_config(horizon=60.0, observation="history", action="smooth")
    assert not rollout(contender.make(config), config, [1]).failed.any()
    for other in ({"observation": "measured"}, {"action": "direct"}):
        changed = replace(config, **other)
        with pytest.raises(CzError, match=r"was made for .*; the environment has "):
            rollout(contender.make(changed), changed, [1])


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("Slow", r"own\.py:Slow: Slow: this .* was made for .*control_interval=10.*; the environment has .*=5"),
        ("Germanium", "was made for puller='germanium'; the environment has 'default"),
        ("Unsure", "its observation is 'measured', its settings say 'history'"),
        ("Typo", "unknown setting 'observations': did you mean 'observation'"),
        ("Repeats", "repeats its actions"),
        ("Text", r"its setting control_interval must be a time \[s\], not '5'"),
        ("nothing", "it makes a SimpleNamespace, which has no method predict"),
    ],
)
def test_settings_that_the_benchmark_has_not_are_refused(own, name, says):
    with pytest.raises(CzError, match=says):
        user_controller(own(name))


def test_who_declares_the_state_is_a_bound(own):
    assert user_controller(own("State")).bound


def test_controllers_of_measured_readings_read_them_in_history_too():
    config = make_config(horizon=60.0, action="direct")
    assert config.observation == "history"
    assert not rollout(make_controller("paper", config), config, [1]).failed.any()
