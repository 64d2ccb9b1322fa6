"""Series of disturbances from logs: what is written is what an episode meets, one series an episode."""

import numpy as np
import pytest

from cz_gym import CzEnv
from cz_gym.config import make_config
from cz_gym.episodes.scenario import to_csv
from cz_gym.episodes.scenarios import find_scenario
from cz_gym.evaluation.user_code import case
from cz_gym.puller.file import find_puller
from cz_gym.support.errors import CzError

TIME = np.array([0.0, 10.0, 30.0])
FIRST = TIME, np.array([0.0, 100.0, 300.0]), np.array([0.5, -0.5, 0.0])
SECOND = TIME, np.array([-50.0, -50.0, -50.0]), np.array([0.1, 0.1, 0.1])


@pytest.fixture
def place(tmp_path):
    path = tmp_path / "day.csv"
    path.write_text(to_csv([FIRST, SECOND]))
    return path


def met(env, seed, steps=9):
    """Load and fluctuation of each step, which it begins with."""
    env.reset(seed=seed)
    disturbances = []
    for _ in range(steps):
        env.step(np.zeros(2))
        slot = env.get_state().slot.slot
        disturbances.append((slot["Q_d"].item(), slot["dT_i"].item()))
    return np.array(disturbances).T


def test_each_episode_meets_one_series_drawn_by_its_seed(place):
    at = np.minimum(5.0 * np.arange(9), 30.0)
    expected = [[np.interp(at, TIME, column) for column in each[1:]] for each in (FIRST, SECOND)]
    for scenario in (place, str(place)):
        env = CzEnv(scenario, action="direct", observation="measured")
        found = [met(env, seed) for seed in range(8)]
        which = [next(k for k in (0, 1) if np.allclose(each, expected[k], atol=1e-12)) for each in found]
        assert set(which) == {0, 1}
        env.reset(seed=0)
        with pytest.raises(CzError, match="series of a log come with the environment"):
            env.reset(options={"scenario": "hard"})


def test_a_puller_of_one_s_own_keeps_them_and_other_contents_are_another_scenario(place):
    one, other = (path.with_name(f"{k}.csv") for k, path in enumerate((place, place)))
    one.write_text(to_csv([FIRST]))
    other.write_text(to_csv([SECOND]))
    scenario = case(str(one)).scenario
    config = make_config(one, puller=find_puller("germanium"))
    assert config.sole_scenario.series == scenario.series == find_scenario(one).series
    assert len(scenario.series) == 7
    assert len({find_scenario(path).hash for path in (one, other)} | {config.scenario.hash}) == 3


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b\n1,2\n", "must be a CSV file with columns series, time_s, load_W, fluctuation_K"),
        ("series,time_s,load_W,fluctuation_K\n", "there must be one"),
        ("series,time_s,load_W,fluctuation_K\n0,0,nan,1\n", "four finite numbers"),
        ("series,time_s,load_W,fluctuation_K\n0,5,1,1\n0,5,1,1\n", "the times of a series must begin"),
    ],
)
def test_a_file_that_holds_no_series_is_refused_in_one_line(text, said, tmp_path):
    (tmp_path / "day.csv").write_text(text)
    with pytest.raises(CzError, match=said) as refusal:
        make_config(tmp_path / "day.csv")
    assert "\n" not in str(refusal.value)
    with pytest.raises(CzError, match="must be a CSV file"):
        make_config(tmp_path / "absent.csv")
